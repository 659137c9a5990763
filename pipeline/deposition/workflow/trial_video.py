"""A trial in pictures: the recording of a simulated machine, and the flow that a law learns from, measured
from a recording, ours or a machine's own."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import scipy.signal

from pipeline.deposition.camera import bead, flow, latency, rendering
from pipeline.deposition.camera.latency import Latency
from pipeline.deposition.drive import obeyed
from pipeline.deposition.extruder import Extruder, Routine, disturb
from pipeline.deposition.extruder import flow as true_flow
from pipeline.deposition.learning.ilc import Trial
from pipeline.deposition.learning.training import Noise
from pipeline.deposition.workflow import trial_files, trial_readings
from pipeline.deposition.workflow.settings import Camera, Material, Printer, TrialTopics
from pipeline.deposition.workflow.trial_readings import Readings
from pipeline.store.artifacts import write_jpeg

SCENES = {"nominal": rendering.NOMINAL, "hard": rendering.HARD}
# a recording may begin and end so much later and earlier than its routine
SLACK_S = 0.2
# a latency known to this is taken off; one that is less known is told to be unknown
LATENCY_KNOWN_S = 0.005
# frames of each known width, spread over the stage
CALIBRATION_FRAMES = 12


class MeasuredTrial(NamedTuple):
    """One trial measured from its frames: the trial as a law sees it, the flow with its uncertainty, the
    number of frames, frames without a usable bead by reason, and the camera's latency: as these frames tell
    it, and as it was corrected."""

    trial: Trial
    flow: flow.Flow
    frames: int
    rejected: dict[str, int]
    latency: Latency
    of_camera: Latency


class SimulatedMachine(NamedTuple):
    """A simulated machine before a simulated camera: true extruder, sections `printer` and `camera`, the
    scene that the camera sees, and what does not repeat from trial to trial."""

    plant: Extruder
    printer: Printer
    camera: Camera
    scene: rendering.Camera
    noise: Noise


def view(camera: Camera) -> flow.View:
    """Where the camera looks."""
    return flow.View(camera.mm_per_px, camera.nozzle_column)


def scene(camera: Camera, rng: np.random.Generator) -> rendering.Camera:
    """What the simulated camera looks at."""
    return rendering.Camera(SCENES[camera.scene], rng)


def calibrate(scene: rendering.Camera, camera: Camera, rng: np.random.Generator) -> bead.Calibration:
    """Pixels to mm on pictures of the known widths of section `camera`."""
    widths_mm = np.repeat(camera.known_widths_mm, CALIBRATION_FRAMES)
    frames = [
        scene.frame(width / abs(camera.mm_per_px), stage_px=int(rng.integers(0, 10_000)))
        for width in widths_mm
    ]
    beads = [
        bead.measure(frame, columns=tuple(camera.columns), longest_blur_px=camera.longest_blur_px)
        for frame in frames
    ]
    bad = [f"{width:g} mm: {one.reason}" for width, one in zip(widths_mm, beads, strict=True) if one.reason]
    if bad:
        reasons = ", ".join(
            f"{bad.count(what)} of {CALIBRATION_FRAMES} of {what}" for what in dict.fromkeys(bad)
        )
        raise ValueError(
            f"camera: known widths should be seen in every picture but are not ({reasons}); "
            "fit camera.known_widths_mm to what is seen at "
            f"{abs(camera.mm_per_px):g} mm per px, or raise camera.longest_blur_px"
        )
    return bead.calibrate(np.array([one.width for one in beads]), widths_mm)


def simulate_recording(
    path: str | Path,
    conditions: trial_files.Conditions,
    machine: SimulatedMachine,
    routine: Routine,
    u: np.ndarray,
    rng: np.random.Generator,
) -> None:
    """Runs the command u (T,) in mm on a simulated machine before its camera, and records it with its true
    flow.

    The camera sees the true flow with what does not repeat from trial to trial. A law is judged by the true
    flow alone.
    """
    printer, camera, noise = machine.printer, machine.camera, machine.noise
    truth = true_flow(machine.plant, u, sample_time_s=printer.sample_time_s, drive=printer.limits)
    laid = np.maximum(
        disturb(
            truth, rng, steady_flow=routine.r.max(), white=noise.white, drift=noise.drift, gain=noise.gain
        ),
        0.0,
    )
    pictures = machine.scene.trial(
        routine.time_s, laid, routine.position, view=view(camera), frame_rate_hz=camera.frames_per_s,
        nozzle_mm=(printer.nozzle_mm / 2, printer.nozzle_outer_mm / 2),
        contact_angle_deg=camera.contact_angle_deg,
    )  # fmt: skip
    applied = obeyed(u, printer.limits, sample_time_s=printer.sample_time_s)
    signals = trial_files.Signals(routine.time_s, routine.position, routine.speed, applied, truth)
    trial_files.write_trial(path, conditions, pictures, signals, encoding=camera.encoding)


def measure_trial(
    path: str | Path,
    routine: Routine,
    *,
    printer: Printer,
    camera: Camera,
    memo: Path | None = None,
    earlier: Sequence[Latency] = (),
) -> MeasuredTrial:
    """The trial of a recording on the clock of its routine; its frames are read once, and kept in `memo`.

    The camera's latency is that of section `camera`; without one, what the motion in the pictures of this
    recording and of `earlier` ones tells, none where it is not told. Raises ValueError, naming the file,
    where it says nothing of its conditions or shows no bead.
    """
    recording = trial_readings.opened(path, camera)
    conditions = _checked_conditions(path, recording)
    late = _late(*recording.signals["position_mm"], routine)
    readings = trial_readings.read(recording, camera, memo=memo)
    of_camera = _of_camera(camera, [*earlier, readings.latency])
    recording = recording._replace(
        signals={name: (time_s - late, values) for name, (time_s, values) in recording.signals.items()}
    )
    signals = _on_routine_clock(path, recording, routine)
    widths = _widths_mm(path, readings, conditions, camera)
    try:
        sections = flow.sections(
            np.interp(readings.time_s - late - of_camera.latency_s, *recording.signals["position_mm"]),
            readings.columns, widths,
            view=flow.View(conditions.mm_per_px, conditions.nozzle_column),
            nozzle_radius_mm=printer.nozzle_mm / 2, contact_angle_deg=conditions.contact_angle_deg,
        )  # fmt: skip
        estimate = flow.estimate(
            routine.time_s,
            signals["position_mm"],
            sections,
            nozzle_radius_mm=printer.nozzle_mm / 2,
            shapes=routine.r[None],
            contact_angle_deg=conditions.contact_angle_deg,
            width_deviation_mm=camera.width_deviation_mm,
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    # within a pause only its volume was measured: a law learns nothing there
    y = np.where(estimate.observable, estimate.flow, np.nan)
    trial = Trial(signals["command_mm"], y, signals.get("flow_mm3_per_s"))
    return MeasuredTrial(
        trial, estimate, len(readings.time_s), _counts(readings.reasons), readings.latency, of_camera
    )


def told_latency(path: str | Path, camera: Camera, memo: Path | None) -> Latency:
    """The camera's latency as one recording tells it."""
    return trial_readings.read(trial_readings.opened(path, camera), camera, memo=memo).latency


def _of_camera(camera: Camera, told: Sequence[Latency]) -> Latency:
    """The latency that is taken off: as given, or as the recordings together tell it to LATENCY_KNOWN_S."""
    if camera.latency_s is not None:
        return Latency(camera.latency_s, 0.0)
    together = latency.pooled(told)
    return together if together.deviation_s <= LATENCY_KNOWN_S else latency.UNTOLD


def latency_figures(measured: Sequence[MeasuredTrial]) -> dict[str, Any]:
    """How late the camera is, as it was corrected in the last trial, and its standard deviation, s; None
    where the pictures do not tell it: then flow near corners and pauses may err by all of it."""
    last = measured[-1].of_camera
    told = np.isfinite(last.deviation_s)
    return {
        "latency_s": last.latency_s if told else None,
        "latency_deviation_s": last.deviation_s if told else None,
    }


def _counts(reasons: Sequence[str]) -> dict[str, int]:
    return {reason: list(reasons).count(reason) for reason in dict.fromkeys(reasons) if reason}


def _checked_conditions(path: str | Path, recording: trial_files.Trial) -> trial_files.Conditions:
    """What a recording was made with. Raises ValueError where it does not say, or says what cannot be."""
    conditions = recording.conditions
    if conditions is None:
        raise ValueError(
            f"{path}: expected metadata with material, trial and calibration (record "
            "beadline.trial), found none; "
            "write it as the commands in datasets/train_ilc/next have it"
        )
    if not conditions.px_per_mm > 0 or conditions.trial < 0:
        raise ValueError(
            f"{path}: expected a scale px_per_mm above 0 and a trial from 0 on, "
            f"found {conditions.px_per_mm:g} and {conditions.trial}; "
            f"mend the metadata record {trial_files.SCHEMA}"
        )
    return conditions


def _on_routine_clock(
    path: str | Path, recording: trial_files.Trial, routine: Routine
) -> dict[str, np.ndarray]:
    """The signals (T,) of a recording at the samples of its routine. Raises ValueError where the recording
    is too short, has gaps, or shows another travel."""
    for name, (time_s, _) in recording.signals.items():
        if len(time_s) == 0 or time_s[0] > SLACK_S or time_s[-1] < routine.time_s[-1] - SLACK_S:
            span = f"{time_s[0]:.2f} to {time_s[-1]:.2f} s" if len(time_s) else "nothing"
            raise ValueError(
                f"{path}: expected {name} from 0 to {routine.time_s[-1]:.2f} s, "
                f"as its routine has it, found {span}; "
                "record the whole trial, from its start"
            )
    signals = {name: np.interp(routine.time_s, *at) for name, at in recording.signals.items()}
    for name in ("position_mm", "command_mm"):
        if gaps := int(np.count_nonzero(~np.isfinite(signals[name]))):
            raise ValueError(
                f"{path}: expected {name} at every moment but {gaps} of {len(routine.time_s)} are missing; "
                "record the trial again"
            )
    expected, travelled = np.ptp(routine.position), np.ptp(signals["position_mm"])
    if not 0.9 * expected < travelled < 1.1 * expected:
        raise ValueError(
            f"{path}: expected the gantry to travel {expected:.4g} mm, as its routine has it, "
            f"found {travelled:.4g} mm; "
            "check topic and unit of its position, or record the trial again"
        )
    return signals


def _widths_mm(
    path: str | Path, readings: Readings, conditions: trial_files.Conditions, camera: Camera
) -> np.ndarray:
    """Widths (F, m) in mm of each frame: less what a bead of this width looks wider than it is, through the
    scale of the recording. Raises ValueError where no frame shows a usable bead."""
    if not len(readings.time_s):
        raise ValueError(f"{path}: expected frames but none could be read; record the trial again")
    if not (readings.widths > 0).any():
        rejected = _counts(readings.reasons)
        reasons = ", ".join(f"{reason} in {count}" for reason, count in sorted(rejected.items()))
        raise ValueError(
            f"{path}: none of {len(readings.time_s)} frames shows a usable bead ({reasons}); "
            "check light, focus, calibration and camera.columns, or record the trial again"
        )
    true_px = width_px(readings.widths, camera)
    return np.where(readings.widths == 0, 0.0, (true_px - conditions.offset_px) / conditions.px_per_mm)


def width_px(measured_px: np.ndarray, camera: Camera) -> np.ndarray:
    """Widths in px without the edge bias that calibration found, straight between the known widths."""
    if not camera.edge_bias_px:
        return measured_px
    bias = np.array(camera.edge_bias_px)
    return measured_px - np.interp(
        measured_px, np.array(camera.known_widths_mm) / abs(camera.mm_per_px) + bias, bias
    )


def simulated(camera: Camera) -> Camera:
    """The camera of a simulated machine, which stands straight and errs as `calibrate` finds."""
    straight = {
        "rotation_deg": 0.0, "tip_px": None, "mask_px": [], "bead": "", "edge_bias_px": [],
        "topics": TrialTopics(image="", time="", mapping={}),
    }  # fmt: skip
    return camera.model_copy(update=straight)


def _late(time_s: np.ndarray, position: np.ndarray, routine: Routine) -> float:
    """How much later than its routine a recording's clock runs, in s: where sum (|v| - v_routine)^2 of the
    gantry's speed is least; 0 for a record shorter than that.

    A recorder begins before the routine does, and a clock of the calendar is counted from its whole second.
    """
    Ts = float(routine.time_s[1] - routine.time_s[0])
    spare = round(SLACK_S / Ts)
    grid = np.arange(time_s[0], time_s[-1] + Ts / 2, Ts) if np.isfinite(position).all() else np.zeros(0)
    if len(grid) < max(len(routine.time_s) - spare, 2):
        return 0.0
    speed = np.pad(np.abs(np.gradient(np.interp(grid, time_s, position), Ts)), spare)
    both = scipy.signal.correlate(speed, routine.speed, "valid", method="fft")
    own = np.convolve(speed**2, np.ones(len(routine.speed)), "valid")
    return float(time_s[0]) + (int(np.argmin(own - 2 * both)) - spare) * Ts


def conditions(
    material: Material,
    routine: Routine,
    trial: int,
    law: str,
    *,
    printer: Printer,
    camera: Camera,
    calibration: bead.Calibration,
) -> trial_files.Conditions:
    """What the recording of a trial says of itself."""
    pause = routine.pause_s[1] - routine.pause_s[0]
    return trial_files.Conditions(
        material.name, f"{printer.nozzle_mm:g}", trial, law, float(routine.speed.max()), round(pause, 9),
        printer.bead_area_mm2,
        1 / calibration.gain,
        -calibration.offset / calibration.gain, camera.contact_angle_deg, camera.mm_per_px,
        camera.nozzle_column,
    )  # fmt: skip


# ---- a few frames for the page


def first_and_last(paths: Sequence[Path], camera: Camera) -> list[Path]:
    """Of recordings with conditions those of the first and the last
    trial of each material, in the order of their names."""
    by_material: dict[str, list[tuple[int, Path]]] = {}
    for path in paths:
        conditions = trial_readings.opened(path, camera).conditions
        if conditions:
            by_material.setdefault(conditions.material, []).append((conditions.trial, path))
    return sorted({path for trials in by_material.values() for _, path in (min(trials), max(trials))})


def shown(path: Path, folder: Path, camera: Camera) -> list[dict[str, Any]]:
    """Writes a few frames of a recording with the measured edges drawn in as JPEG to `folder`, start, steady
    line, corner, and the first that was rejected for each reason, and returns a row for each: where it is
    from, what was measured, and why it was rejected."""
    recording = trial_readings.opened(path, camera)
    conditions = recording.conditions
    beads = [(time, one) for time, _, one in trial_readings.beads(recording, camera)]
    if conditions is None or not beads:
        return []
    places = _places(recording, beads, camera)
    rows = []
    for k, (time, frame, one) in enumerate(trial_readings.beads(recording, camera)):
        if k not in places:
            continue
        name = f"{path.stem}_{k:05d}.jpg"
        _save(folder / name, bead.drawn(frame, one), one)
        rows.append(
            {
                "file": name,
                "place": places[k],
                "material": conditions.material,
                "trial": conditions.trial,
                "recording": path.name,
                "topic": recording.frames.topic,
                "time_s": round(time, 6),
                "reason": one.reason,
                "blur_px": one.blur_px,
                "width_mm": float(width_px(np.array(one.width), camera) - conditions.offset_px)
                / conditions.px_per_mm,
                "deviation_px": one.deviation,
            }
        )
    return [
        {
            key: None if isinstance(value, float) and not np.isfinite(value) else value
            for key, value in row.items()
        }
        for row in rows
    ]


def _places(
    recording: trial_files.Trial, beads: Sequence[tuple[float, bead.Bead]], camera: Camera
) -> dict[int, str]:
    """Numbers of the frames to show, and what they show. After the pause of the gantry the corner takes a
    while to come to the middle of what is measured."""
    time_s, speed = recording.signals["speed_mm_per_s"]
    full = np.median([one.width for _, one in beads if not one.reason] or [0.0])
    good = [k for k, (_, one) in enumerate(beads) if not one.reason and one.width > 0.7 * full]
    rejected = {one.reason: k for k, (_, one) in reversed(list(enumerate(beads))) if one.reason}
    places = dict.fromkeys(rejected.values(), "rejected")
    if not good:
        return places
    begin = beads[good[0]][0]
    still = time_s[(speed < 0.05 * speed.max()) & (time_s > begin)]
    pause = float(still[0]) if len(still) else beads[good[-1]][0]
    # the gantry stands at the end too: the pause ends where its first stretch does
    ends = np.flatnonzero(np.diff(still) > 1.5 * np.median(np.diff(time_s))) if len(still) else []
    resumed = float(still[ends[0]]) if len(ends) else float(still[-1]) if len(still) else pause
    travelled = (
        (np.mean(camera.columns) - camera.nozzle_column)
        * abs(camera.mm_per_px)
        / max(float(speed.max()), 1e-9)
    )
    for place, at in (
        ("start", begin),
        ("steady line", (begin + pause) / 2),
        ("corner", resumed + travelled),
    ):
        places.setdefault(min(good, key=lambda k: abs(beads[k][0] - at)), place)
    return places


def _save(path: Path, picture: np.ndarray, measured: bead.Bead) -> None:
    """The picture (h, w, 3) in RGB as JPEG, cut to its middle half
    around the bead, at three quarters of its size."""
    h = picture.shape[0]
    edges = np.concatenate([measured.top, measured.bottom])
    middle = float(np.nanmean(edges)) if np.isfinite(edges).any() and not measured.reason else h / 2
    first = int(np.clip(middle - h / 4, 0, h - h // 2))
    cut = cv2.resize(picture[first : first + h // 2], None, fx=0.75, fy=0.75, interpolation=cv2.INTER_AREA)
    write_jpeg(path, cut)


# ---- as a table


def rows(measured: dict[tuple[str, int], list[MeasuredTrial]]) -> dict[str, list]:
    """One row a measured trial, by (material, number of the routine)."""
    columns: dict[str, list] = {
        name: []
        for name in (
            "material",
            "routine",
            "trial",
            "frames",
            "rejected",
            "reasons",
            "deviation_mm3_per_s",
            "observable",
            "outliers",
        )
    }
    for (material, index), trials in measured.items():
        for j, one in enumerate(trials):
            reasons = ", ".join(f"{reason} {count}" for reason, count in sorted(one.rejected.items()))
            deviation, observable = float(np.median(one.flow.deviation)), float(np.mean(one.flow.observable))
            rejected = sum(one.rejected.values())
            row = (
                material, index, j, one.frames, rejected, reasons, deviation, observable, one.flow.outliers
            )  # fmt: skip
            for name, value in zip(columns, row, strict=True):
                columns[name].append(value)
    return columns
