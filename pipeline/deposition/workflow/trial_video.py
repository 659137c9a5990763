"""A trial in pictures: a simulated machine filmed into one recording, and a recording, ours or a machine's
own, measured to the flow that a law learns from."""

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import scipy.signal

from pipeline.deposition import bead, flow, rendering
from pipeline.deposition.extruder import Extruder, Routine, disturb
from pipeline.deposition.extruder import flow as true_flow
from pipeline.deposition.ilc import Trial
from pipeline.deposition.training import Noise
from pipeline.deposition.workflow import trial_files
from pipeline.deposition.workflow.settings import Camera, Material, Printer
from pipeline.store.artifacts import about, write_jpeg

SCENES = {"nominal": rendering.NOMINAL, "hard": rendering.HARD}
# a recording may begin and end so much later and earlier than its routine
SLACK_S = 0.2
# frames measured together
TOGETHER = 16
# frames of each known width, spread over the stage
CALIBRATION_FRAMES = 12


class Watched(NamedTuple):
    """What the frames of one trial told: the trial as a law sees it, the flow with its uncertainty, frames
    seen, and frames without a usable bead by reason."""

    trial: Trial
    flow: flow.Flow
    frames: int
    rejected: dict[str, int]


def view(camera: Camera) -> flow.View:
    """Where the camera looks."""
    return flow.View(camera.mm_per_px, camera.nozzle_column)


def scene(camera: Camera, rng: np.random.Generator) -> rendering.Camera:
    """What the simulated camera looks at."""
    return rendering.Camera(SCENES[camera.scene], rng)


def calibrate(scene: rendering.Camera, camera: Camera, rng: np.random.Generator) -> bead.Calibration:
    """Pixels to mm on pictures of the known widths of section `camera`."""
    known = np.repeat(camera.known_widths_mm, CALIBRATION_FRAMES)
    frames = [
        scene.frame(width / abs(camera.mm_per_px), stage_px=int(rng.integers(0, 10_000))) for width in known
    ]
    seen = [
        bead.measure(frame, columns=tuple(camera.columns), longest_blur_px=camera.longest_blur_px)
        for frame in frames
    ]
    bad = [f"{width:g} mm: {one.reason}" for width, one in zip(known, seen, strict=True) if one.reason]
    if bad:
        reasons = ", ".join(
            f"{bad.count(what)} of {CALIBRATION_FRAMES} of {what}" for what in dict.fromkeys(bad)
        )
        raise ValueError(
            f"camera: known widths should be seen in every picture but are not ({reasons}); "
            "fit camera.known_widths_mm to what is seen at "
            f"{abs(camera.mm_per_px):g} mm per px, or raise camera.longest_blur_px"
        )
    return bead.calibrate(np.array([one.width for one in seen]), known)


def film(
    path: str | Path,
    conditions: trial_files.Conditions,
    plant: Extruder,
    routine: Routine,
    u: np.ndarray,
    *,
    printer: Printer,
    camera: Camera,
    scene: rendering.Camera,
    noise: Noise,
    rng: np.random.Generator,
) -> None:
    """Runs the command u (T,) in mm on a simulated machine before the
    camera, and records it with its true flow.

    What is filmed is the true flow with what does not repeat from
    trial to trial; a law is judged by the true flow alone.
    """
    truth = true_flow(plant, u, sample_time_s=printer.sample_time_s, limit=printer.limit)
    laid = np.maximum(
        disturb(
            truth, rng, steady_flow=routine.r.max(), white=noise.white, drift=noise.drift, gain=noise.gain
        ),
        0.0,
    )
    pictures = scene.trial(
        routine.time_s, laid, routine.position, view=view(camera), frame_rate_hz=camera.frames_per_s,
        nozzle_mm=(printer.nozzle_mm / 2, printer.nozzle_outer_mm / 2),
        contact_angle_deg=camera.contact_angle_deg,
    )  # fmt: skip
    trial_files.write_trial(
        path, conditions, pictures, time_s=routine.time_s, position_mm=routine.position,
        speed_mm_per_s=routine.speed,
        command_mm=np.clip(u, -printer.limit, printer.limit), flow_mm3_per_s=truth, encoding=camera.encoding,
    )  # fmt: skip


def watch(path: str | Path, routine: Routine, *, printer: Printer, camera: Camera) -> Watched:
    """The trial of a recording on the clock of its routine. Raises ValueError, naming the file, where it
    says nothing of its conditions or shows no bead."""
    recording = trial_files.read_trial(path, unreadable_share=camera.unreadable_share)
    known = recording.conditions
    if known is None:
        raise ValueError(
            f"{path}: expected metadata with material, trial and calibration (record "
            "beadline.trial), found none; "
            "write it as the commands in datasets/train_ilc/next have it"
        )
    if not known.px_per_mm > 0 or known.trial < 0:
        raise ValueError(
            f"{path}: expected a scale px_per_mm above 0 and a trial from 0 on, "
            f"found {known.px_per_mm:g} and {known.trial}; "
            f"mend the metadata record {trial_files.SCHEMA}"
        )
    late = _late(*recording.signals["position_mm"], routine)
    recording = recording._replace(
        signals={name: (time_s - late, values) for name, (time_s, values) in recording.signals.items()}
    )
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
    asked, travelled = np.ptp(routine.position), np.ptp(signals["position_mm"])
    if not 0.9 * asked < travelled < 1.1 * asked:
        raise ValueError(
            f"{path}: expected the gantry to travel {asked:.4g} mm, as its routine has it, "
            f"found {travelled:.4g} mm; "
            "check topic and unit of its position, or record the trial again"
        )
    rejected: dict[str, int] = {}
    times, columns, widths = [], None, []
    for time, found in _beads(recording, camera):
        times.append(time - late)
        columns = found.columns
        widths.append(np.where(found.widths == 0, 0.0, (found.widths - known.offset_px) / known.px_per_mm))
        if found.reason:
            rejected[found.reason] = rejected.get(found.reason, 0) + 1
    if not times:
        raise ValueError(f"{path}: expected frames but none could be read; record the trial again")
    if not any(np.any(width > 0) for width in widths):
        reasons = ", ".join(f"{reason} in {count}" for reason, count in sorted(rejected.items()))
        raise ValueError(
            f"{path}: none of {len(times)} frames shows a usable bead ({reasons}); check light, focus, "
            "calibration and camera.columns, "
            "or record the trial again"
        )
    try:
        seen = flow.sections(
            np.interp(times, *recording.signals["position_mm"]), columns, np.array(widths),
            view=flow.View(known.mm_per_px, known.nozzle_column),
            nozzle_radius_mm=printer.nozzle_mm / 2, contact_angle_deg=known.contact_angle_deg,
        )  # fmt: skip
        found = flow.estimate(
            routine.time_s,
            signals["position_mm"],
            seen,
            nozzle_radius_mm=printer.nozzle_mm / 2,
            shapes=routine.r[None],
            contact_angle_deg=known.contact_angle_deg,
            width_deviation_mm=camera.width_deviation_mm,
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    # within a pause only its volume was measured: a law learns nothing there
    y = np.where(found.observable, found.flow, np.nan)
    return Watched(
        Trial(signals["command_mm"], y, signals.get("flow_mm3_per_s")), found, len(times), rejected
    )


def _beads(recording: trial_files.Trial, camera: Camera) -> Iterator[tuple[float, bead.Bead]]:
    """Beads of a few frames at a time: memory stays flat, and what a
    frame costs beyond its decoding is shared."""
    frames = iter(recording.frames)
    while batch := list(itertools.islice(frames, TOGETHER)):
        times, pictures = zip(*batch, strict=True)
        with about(recording.path):
            found = bead.measure_all(
                pictures, columns=tuple(camera.columns), longest_blur_px=camera.longest_blur_px
            )
        yield from zip(times, found, strict=True)


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
    found: dict[str, list[tuple[int, Path]]] = {}
    for path in paths:
        known = trial_files.read_trial(path, unreadable_share=camera.unreadable_share).conditions
        if known:
            found.setdefault(known.material, []).append((known.trial, path))
    return sorted({path for done in found.values() for _, path in (min(done), max(done))})


def shown(path: Path, folder: Path, camera: Camera) -> list[dict[str, Any]]:
    """Writes a few frames of a recording with the measured edges drawn in as JPEG to `folder`, start, steady
    line, corner, and the first that was rejected for each reason, and returns a row for each: where it is
    from, what was measured, and why it was rejected."""
    recording = trial_files.read_trial(path, unreadable_share=camera.unreadable_share)
    known, beads = recording.conditions, list(_beads(recording, camera))
    if known is None or not beads:
        return []
    wanted = _places(recording, beads, camera)
    rows = []
    for k, (time, frame) in enumerate(recording.frames):
        if k not in wanted:
            continue
        found, name = beads[k][1], f"{path.stem}_{k:05d}.jpg"
        _save(folder / name, bead.drawn(frame, found), found)
        width = {
            "width_mm": (found.width - known.offset_px) / known.px_per_mm,
            "deviation_px": found.deviation,
        }
        conditions = {
            "material": known.material,
            "trial": known.trial,
            "recording": path.name,
            "topic": recording.frames.topic,
        }
        rows.append(
            {
                "file": name,
                "place": wanted[k],
                **conditions,
                "time_s": round(time, 6),
                "reason": found.reason,
                "blur_px": found.blur_px,
                **width,
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
    full = np.median([found.width for _, found in beads if not found.reason] or [0.0])
    good = [k for k, (_, found) in enumerate(beads) if not found.reason and found.width > 0.7 * full]
    rejected = {found.reason: k for k, (_, found) in reversed(list(enumerate(beads))) if found.reason}
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


def _save(path: Path, picture: np.ndarray, found: bead.Bead) -> None:
    """The picture (h, w, 3) in RGB as JPEG, cut to its middle half
    around the bead, at three quarters of its size."""
    h = picture.shape[0]
    rows = np.concatenate([found.top, found.bottom])
    middle = float(np.nanmean(rows)) if np.isfinite(rows).any() and not found.reason else h / 2
    first = int(np.clip(middle - h / 4, 0, h - h // 2))
    cut = cv2.resize(picture[first : first + h // 2], None, fx=0.75, fy=0.75, interpolation=cv2.INTER_AREA)
    write_jpeg(path, cut)


# ---- as a table


def rows(watched: dict[tuple[str, int], list[Watched]]) -> dict[str, np.ndarray]:
    """One row a filmed trial, by (material, number of the routine)."""
    found = []
    for (material, index), trials_ in watched.items():
        for j, w in enumerate(trials_):
            reasons = ", ".join(f"{reason} {count}" for reason, count in sorted(w.rejected.items()))
            seen = (float(np.median(w.flow.deviation)), float(np.mean(w.flow.observable)), w.flow.outliers)
            found.append((material, index, j, w.frames, sum(w.rejected.values()), reasons, *seen))
    names = (
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
    return {
        name: list(values)
        for name, values in zip(names, zip(*found, strict=True) if found else [[]] * len(names), strict=True)
    }
