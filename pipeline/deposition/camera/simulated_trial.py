"""A trial on a simulated machine before a simulated camera."""

from collections.abc import Iterator, Mapping

import numpy as np

from pipeline.deposition.camera.flow import View
from pipeline.deposition.camera.rendering import SimulatedCamera
from pipeline.deposition.drive import Drive, obeyed
from pipeline.deposition.extruder import Extruder, Routine, disturb, flow


def simulate_trial(
    plant: Extruder,
    camera: SimulatedCamera,
    routine: Routine,
    u: np.ndarray,
    rng: np.random.Generator,
    *,
    noise: Mapping[str, float],
    drive: Drive,
    sample_time_s: float,
    view: View,
    frame_rate_hz: float,
    nozzle_mm: tuple[float, float],
    contact_angle_deg: float,
) -> tuple[Iterator[tuple[float, np.ndarray]], np.ndarray, np.ndarray]:
    """Runs the command u (T,) in mm: (time, picture) of each frame, the command (T,) as the drive applied it,
    and the true flow (T,) in mm^3/s.

    The camera sees that flow with what does not repeat from trial to trial, `noise` by `extruder.disturb`; a
    law is judged by the true flow alone. nozzle_mm are the inner and the outer radius.
    """
    truth = flow(plant, u, sample_time_s=sample_time_s, drive=drive)
    laid = np.maximum(disturb(truth, rng, steady_flow=routine.r.max(), **noise), 0.0)
    pictures = camera.trial(
        routine.time_s, laid, routine.position, view=view, frame_rate_hz=frame_rate_hz,
        nozzle_mm=nozzle_mm, contact_angle_deg=contact_angle_deg,
    )  # fmt: skip
    return pictures, obeyed(u, drive, sample_time_s=sample_time_s), truth
