"""Measures a trial from its pictures: readings of its frames and signals of its recording -> the flow that a
law learns from, at the times of its routine."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.signal

from pipeline.deposition.camera import flow
from pipeline.deposition.camera.line import Mounting
from pipeline.deposition.camera.readings import Latency, Readings
from pipeline.deposition.extruder import Routine
from pipeline.deposition.learning.ilc import Trial

# a recording may begin this much later, and end this much earlier, than its routine
SLACK_S = 0.2
# largest share of the frames that should show the line that may have no usable bead
REJECTED = 0.5
# the stage must be bare this far ahead of the line, mm: what oozes before lies nearer
AHEAD_MM = 1.0
# a line that looks wider at one end of the columns than at the other by this share is seen askew
ASKEW = 0.04
# error in px of the widths of a calibrated and of an uncalibrated camera, beyond what blur and light explain
CALIBRATED_PX, UNCALIBRATED_PX = 0.2, 0.4


class MeasuredTrial(NamedTuple):
    """One trial measured from its frames. `trial`: as a law gets it; `flow`: with its uncertainty; `frames`:
    number of frames; `rejected`: number of frames without a usable bead, by reason; `latency`: the camera's
    latency from these frames; `of_camera`: the latency used for the correction."""

    trial: Trial
    flow: flow.Flow
    frames: int
    rejected: dict[str, int]
    latency: Latency
    of_camera: Latency


def measure_trial(
    readings: Readings,
    signals: Mapping[str, tuple[np.ndarray, np.ndarray]],
    routine: Routine,
    mounting: Mounting,
    *,
    scale: tuple[float, float],
    view: flow.View,
    latency: Latency,
    nozzle_mm: float,
    contact_angle_deg: float,
    width_deviation_mm: float,
) -> MeasuredTrial:
    """Returns the trial of one recording, from the readings of its frames and signals {name: (time_s (n,),
    values (n,))}, each with times of its own. scale is (px_per_mm, offset_px) of the widths. Raises
    ValueError if no frame shows a bead, if most frames that show the line have no usable bead, if the stage
    ahead of the line is not bare, if the camera looks askew, and if signals do not cover the routine."""
    px_per_mm, offset_px = scale
    widths_mm = (mounting.true_px(readings.widths) - offset_px) / px_per_mm
    widths_mm = np.where(readings.widths == 0, 0.0, widths_mm)
    late = clock_shift(*signals["position_mm"], routine)
    shifted = {name: (time_s - late, values) for name, (time_s, values) in signals.items()}
    at = on_routine_clock(shifted, routine)
    position = np.interp(readings.time_s - late - latency.latency_s, *shifted["position_mm"])
    _check_beads(readings)
    ends = np.interp([routine.start_s, routine.stop_s], routine.time_s, at["position_mm"])
    place = position + (float(np.mean(readings.columns)) - view.nozzle_column) * view.mm_per_px
    along = (place - ends[0]) / (ends[1] - ends[0])
    _check_rejected(np.array(readings.reasons)[(along >= 0) & (along <= 1)])
    _check_bare(widths_mm, along < -AHEAD_MM / abs(ends[1] - ends[0]))
    trend = flow.column_trend(position, readings.columns, widths_mm, view)
    _check_askew(trend)
    usual_px = px_per_mm * float(np.median(widths_mm[widths_mm > 0]))
    doubt_px = math.hypot(
        readings.edge_px,
        CALIBRATED_PX if mounting.edge_bias or offset_px else UNCALIBRATED_PX,
        mounting.bias_deviation_px(usual_px),
        usual_px * trend / math.sqrt(12),
    )
    sections = flow.sections(
        position, readings.columns, widths_mm, view=view,
        nozzle_radius_mm=nozzle_mm / 2, contact_angle_deg=contact_angle_deg,
    )  # fmt: skip
    estimate = flow.estimate(
        routine.time_s, at["position_mm"], sections, nozzle_radius_mm=nozzle_mm / 2, shapes=routine.r[None],
        contact_angle_deg=contact_angle_deg,
        width_deviation_mm=math.hypot(width_deviation_mm, doubt_px / px_per_mm),
    )  # fmt: skip
    # within a pause only its volume was measured: a law learns nothing there
    y = np.where(estimate.observable, estimate.flow, np.nan)
    trial = Trial(at["command_mm"], y, at.get("flow_mm3_per_s"))
    rejected = counts(readings.reasons)
    return MeasuredTrial(trial, estimate, len(readings.time_s), rejected, readings.latency, latency)


def counts(reasons: Sequence[str]) -> dict[str, int]:
    """Returns the number of frames without a usable bead, by reason."""
    return {reason: list(reasons).count(reason) for reason in dict.fromkeys(reasons) if reason}


def _check_beads(readings: Readings) -> None:
    if not len(readings.time_s):
        raise ValueError("expected frames but none could be read; record the trial again")
    if not (readings.widths > 0).any():
        rejected = counts(readings.reasons)
        reasons = ", ".join(f"{reason} in {count}" for reason, count in sorted(rejected.items()))
        raise ValueError(
            f"none of {len(readings.time_s)} frames shows a usable bead ({reasons}); "
            "check light, focus, calibration and camera.columns, or record the trial again"
        )


def _check_bare(widths_mm: np.ndarray, before: np.ndarray) -> None:
    """Raises ValueError if most of the widths (F, m) in the frames `before` (F,) the line are at least half
    as wide as the line, because then the bead that is measured is not the line."""
    usual_mm, bare = float(np.median(widths_mm[widths_mm > 0])), widths_mm[before]
    share = float(np.mean(bare > usual_mm / 2)) if before.any() else 0.0
    if share > REJECTED:
        wide_mm = float(np.median(bare[bare > 0]))
        raise ValueError(
            f"expected a bare stage before the line begins but {100 * share:.0f} % of what the camera reads "
            f"there is a bead, {wide_mm:.2g} mm wide: light, dirt or another line passes for it; check light "
            "and camera.columns, and record the trial again"
        )


def _check_askew(trend: float) -> None:
    """Raises ValueError if the line looks wider at one end of the columns than at the other by more than
    ASKEW."""
    if abs(trend) > ASKEW:
        raise ValueError(
            "expected a line that looks as wide at one end of the measured columns as at the other but it "
            f"looks {100 * abs(trend):.0f} % wider ({100 * ASKEW:g} % allowed); turn the camera square to "
            "the stage and calibrate it, or measure fewer columns (camera.columns)"
        )


def _check_rejected(reasons: np.ndarray) -> None:
    """Raises ValueError if most of the frames that show the line have no usable bead. `reasons` (F,): why, ""
    for a usable bead."""
    rejected = counts(reasons.tolist())
    share = sum(rejected.values()) / max(len(reasons), 1)
    if share > REJECTED:
        said = ", ".join(f"{reason} in {count}" for reason, count in sorted(rejected.items()))
        raise ValueError(
            f"expected a bead in most of the {len(reasons)} frames that show the line but "
            f"{100 * share:.0f} % have none that can be measured ({said}); check light, focus, calibration "
            "and camera.columns, and record the trial again"
        )


def on_routine_clock(
    signals: Mapping[str, tuple[np.ndarray, np.ndarray]], routine: Routine
) -> dict[str, np.ndarray]:
    """Returns the signals (T,) of a recording at the samples of its routine. Raises ValueError if the
    recording is too short, has gaps, or shows another travel."""
    for name, (time_s, _) in signals.items():
        if len(time_s) == 0 or time_s[0] > SLACK_S or time_s[-1] < routine.time_s[-1] - SLACK_S:
            span = f"{time_s[0]:.2f} to {time_s[-1]:.2f} s" if len(time_s) else "nothing"
            raise ValueError(
                f"expected {name} from 0 to {routine.time_s[-1]:.2f} s, as its routine has it, found {span}; "
                "record the whole trial, from its start"
            )
    at = {name: np.interp(routine.time_s, *signal) for name, signal in signals.items()}
    for name in ("position_mm", "command_mm"):
        if gaps := int(np.count_nonzero(~np.isfinite(at[name]))):
            raise ValueError(
                f"expected {name} at every moment but {gaps} of {len(routine.time_s)} are missing; "
                "record the trial again"
            )
    expected, travelled = np.ptp(routine.position), np.ptp(at["position_mm"])
    if not 0.9 * expected < travelled < 1.1 * expected:
        raise ValueError(
            f"expected the gantry to travel {expected:.4g} mm, as its routine has it, "
            f"found {travelled:.4g} mm; check topic and unit of its position, or record the trial again"
        )
    return at


def clock_shift(time_s: np.ndarray, position: np.ndarray, routine: Routine) -> float:
    """Returns by how many s a recording's clock is later than its routine's: the shift with the least

        sum_t (|v(t)| - v_routine(t))^2

    of the gantry's speed v; 0 if the record is shorter than the routine. A recorder starts before the routine
    does, and a calendar clock counts from its whole second.
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


# ---- figures


def latency_figures(measured: Sequence[MeasuredTrial]) -> dict[str, float | None]:
    """Returns the camera's latency as corrected in the last trial, and its standard deviation, in s. Both are
    None if the pictures do not show it; then the flow near corners and pauses may be off by the whole
    latency."""
    last = measured[-1].of_camera
    known = np.isfinite(last.deviation_s)
    return {
        "latency_s": last.latency_s if known else None,
        "latency_deviation_s": last.deviation_s if known else None,
    }


def flow_errors(measured: Sequence[MeasuredTrial], routine: Routine) -> dict[str, float]:
    """Returns how well pictures measure the flow, over all trials: r.m.s. error in % of the steady flow, in
    the whole trial and around its pause, and the share of frames without a bead in %."""
    errors = np.array([one.flow.flow - one.trial.truth for one in measured]) / routine.r.max()
    near = (routine.time_s > routine.pause_s[0] - 0.3) & (routine.time_s < routine.pause_s[1] + 0.3)
    trial, corner = (100 * np.sqrt(np.mean(part**2, axis=1)) for part in (errors, errors[:, near]))
    frames = sum(one.frames for one in measured)
    rejected = sum(sum(one.rejected.values()) for one in measured)
    return {
        "flow_error_percent": float(np.median(trial)),
        "flow_error_corner_percent": float(np.median(corner)),
        "rejected_percent": 100 * rejected / frames,
    }


def filmed_rows(measured: Mapping[tuple[str, int], Sequence[MeasuredTrial]]) -> dict[str, list]:
    """Returns the columns of filmed.parquet: one row per measured trial, by (material, number of the
    routine)."""
    names = ("material", "routine", "trial", "frames", "rejected", "reasons")
    names += ("deviation_mm3_per_s", "observable", "outliers")
    rows = [
        (
            material, index, number, one.frames, sum(one.rejected.values()),
            ", ".join(f"{reason} {count}" for reason, count in sorted(one.rejected.items())),
            float(np.median(one.flow.deviation)), float(np.mean(one.flow.observable)), one.flow.outliers,
        )
        for (material, index), trials in measured.items()
        for number, one in enumerate(trials)
    ]  # fmt: skip
    return {name: [row[k] for row in rows] for k, name in enumerate(names)}
