"""A trial in pictures: a simulated machine filmed into one recording, and a recording, ours or a machine's own, measured to the flow that a law learns from."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline import trials
from pipeline.deposition import bead, flow, rendering
from pipeline.deposition.extruder import Extruder, Routine, disturb
from pipeline.deposition.extruder import flow as true_flow
from pipeline.deposition.ilc import Trial
from pipeline.deposition.training import Noise
from pipeline.printer import Camera, Material, Printer

SCENES = {"nominal": rendering.NOMINAL, "hard": rendering.HARD}
# a recording may begin and end so much later and earlier than its routine
SLACK_S = 0.2
# frames of each known width, spread over the stage
CALIBRATION_FRAMES = 12


class Watched(NamedTuple):
    """What the frames of one trial told: the trial as a law sees it, the flow with its uncertainty, frames seen, and frames without a usable bead by reason."""

    trial: Trial
    flow: flow.Flow
    frames: int
    rejected: dict[str, int]


def scene(camera: Camera, rng: np.random.Generator) -> rendering.Camera:
    """What the simulated camera looks at."""
    return rendering.Camera(SCENES[camera.scene], rng)


def calibrate(scene: rendering.Camera, camera: Camera, rng: np.random.Generator) -> bead.Calibration:
    """Pixels to mm on pictures of the known widths of section `camera`."""
    known = np.repeat(camera.known_widths_mm, CALIBRATION_FRAMES)
    frames = [scene.frame(width / abs(camera.mm_per_px), stage_px=int(rng.integers(0, 10_000))) for width in known]
    measured = [bead.measure(frame, columns=tuple(camera.columns), longest_blur_px=camera.longest_blur_px).width for frame in frames]
    return bead.calibrate(np.array(measured), known)


def film(
    path: str | Path,
    conditions: trials.Conditions,
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
    """Runs the command u (T,) in mm on a simulated machine before the camera, and records it with its true flow.

    What is filmed is the true flow with what does not repeat from trial to trial; a law is judged by the true flow alone.
    """
    truth = true_flow(plant, u, sample_time_s=printer.sample_time_s, limit=printer.limit)
    laid = np.maximum(disturb(truth, rng, steady_flow=routine.r.max(), white=noise.white, drift=noise.drift, gain=noise.gain), 0.0)
    pictures = scene.trial(
        routine.time_s, laid, routine.position, view=camera.view, frame_rate_hz=camera.frames_per_s,
        nozzle_mm=(printer.nozzle_mm / 2, printer.nozzle_outer_mm / 2), contact_angle_deg=camera.contact_angle_deg,
    )  # fmt: skip
    trials.write_trial(
        path, conditions, pictures, time_s=routine.time_s, position_mm=routine.position, speed_mm_per_s=routine.speed,
        command_mm=np.clip(u, -printer.limit, printer.limit), flow_mm3_per_s=truth, encoding=camera.encoding,
    )  # fmt: skip


def watch(path: str | Path, routine: Routine, *, printer: Printer, camera: Camera) -> Watched:
    """The trial of a recording on the clock of its routine. Raises ValueError, naming the file, where it says nothing of its conditions or shows no bead."""
    recording = trials.read_trial(path, unreadable_share=camera.unreadable_share)
    known = recording.conditions
    if known is None:
        raise ValueError(
            f"{path}: expected metadata with material, trial and calibration (record beadline.trial), found none; write it as the commands in datasets/train_ilc/next have it"
        )
    for name, (time_s, _) in recording.signals.items():
        if len(time_s) == 0 or time_s[0] > SLACK_S or time_s[-1] < routine.time_s[-1] - SLACK_S:
            span = f"{time_s[0]:.2f} to {time_s[-1]:.2f} s" if len(time_s) else "nothing"
            raise ValueError(
                f"{path}: expected {name} from 0 to {routine.time_s[-1]:.2f} s, as its routine has it, found {span}; record the whole trial, from its start"
            )
    signals = {name: np.interp(routine.time_s, *at) for name, at in recording.signals.items()}
    rejected: dict[str, int] = {}
    times, columns, widths = [], None, []
    for time, found in _beads(recording, camera):
        times.append(time)
        columns = found.columns
        widths.append(np.where(found.widths == 0, 0.0, (found.widths - known.offset_px) / known.px_per_mm))
        if found.reason:
            rejected[found.reason] = rejected.get(found.reason, 0) + 1
    if not times:
        raise ValueError(f"{path}: expected frames but none could be read; record the trial again")
    try:
        seen = flow.sections(
            np.interp(times, *recording.signals["position_mm"]), columns, np.array(widths), view=flow.View(known.mm_per_px, known.nozzle_column),
            nozzle_radius_mm=printer.nozzle_mm / 2, contact_angle_deg=known.contact_angle_deg,
        )  # fmt: skip
        found = flow.estimate(
            routine.time_s,
            signals["position_mm"],
            seen,
            nozzle_radius_mm=printer.nozzle_mm / 2,
            shapes=routine.r[None],
            contact_angle_deg=known.contact_angle_deg,
            width_deviation_mm=0.0,
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    # within a pause only its volume was measured: a law learns nothing there
    y = np.where(found.observable, found.flow, np.nan)
    return Watched(Trial(signals["command_mm"], y, signals.get("flow_mm3_per_s")), found, len(times), rejected)


def _beads(recording: trials.Trial, camera: Camera) -> Iterator[tuple[float, bead.Bead]]:
    for time, frame in recording.frames:
        yield time, bead.measure(frame, columns=tuple(camera.columns), longest_blur_px=camera.longest_blur_px)


def conditions(
    material: Material, routine: Routine, trial: int, law: str, *, printer: Printer, camera: Camera, calibration: bead.Calibration
) -> trials.Conditions:
    """What the recording of a trial says of itself."""
    pause = routine.pause_s[1] - routine.pause_s[0]
    return trials.Conditions(
        material.name, f"{printer.nozzle_mm:g}", trial, law, float(routine.speed.max()), round(pause, 9), printer.bead_area_mm2, 1 / calibration.gain,
        -calibration.offset / calibration.gain, camera.contact_angle_deg, camera.mm_per_px, camera.nozzle_column,
    )  # fmt: skip


def rows(watched: dict[tuple[str, int], list[Watched]]) -> dict[str, np.ndarray]:
    """One row a filmed trial, by (material, number of the routine)."""
    found = []
    for (material, index), trials_ in watched.items():
        for j, w in enumerate(trials_):
            reasons = ", ".join(f"{reason} {count}" for reason, count in sorted(w.rejected.items()))
            seen = (float(np.median(w.flow.deviation)), float(np.mean(w.flow.observable)), w.flow.outliers)
            found.append((material, index, j, w.frames, sum(w.rejected.values()), reasons, *seen))
    names = ("material", "routine", "trial", "frames", "rejected", "reasons", "deviation_mm3_per_s", "observable", "outliers")
    return {name: list(values) for name, values in zip(names, zip(*found, strict=True) if found else [[]] * len(names), strict=True)}
