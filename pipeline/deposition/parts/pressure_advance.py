"""Pressure advance, the controller that printer owners have: a command in proportion to the wanted flow and
to its rate of change, smoothed. It is tuned on the identified chain, so it needs no further print."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.optimize
import scipy.signal

from pipeline.deposition.parts import basis, forecast
from pipeline.deposition.parts.chain import Chain, simulate

# composers by whether they have a lead
LEADS = {"pressure_advance": False, "pressure_advance_lead": True}
# Klipper's smooth time if none is set
SMOOTH_S = 0.04
# ln gain, advance, smooth time (Klipper takes no more) and lead
LOW, HIGH = np.array([math.log(1e-3), 0.0, 0.0, 0.0]), np.array([math.log(1e3), 100.0, 0.2, 1.0])
SCALE = np.array([0.1, 1.0, 0.1, 0.1])
# for 50 unfamiliar extruders an interval twice as wide contains the best advance in 96 %, the single one in
# 76 %
WIDER = 2.0
# midpoints of the triangular window, in halves of it
NODES = (np.arange(256) + 0.5) / 128 - 1


class PressureAdvance(NamedTuple):
    """The numbers of a slicer and a firmware, and the lead, which neither has."""

    gain: float  # steady flow over command, mm^3/s per mm
    advance_s: float
    smooth_s: float  # full width of the triangular window
    lead_s: float  # by which all of it is sent ahead


class TunedAdvance(NamedTuple):
    """The tuned pressure advance, and the ends of the 90 % interval of each of its numbers."""

    low: PressureAdvance
    tuned: PressureAdvance
    high: PressureAdvance


def command(pa: PressureAdvance, r: np.ndarray, *, sample_time_s: float) -> np.ndarray:
    """Returns the command u (..., T) in mm for the wanted flow r (..., T) in mm^3/s, 0 beyond its ends:

        u(t) = 1/K integral of w(s) x(t + lead + s) ds,  x = r + advance r'
        w(s) = (h - |s|) / h^2 for |s| < h,  h = smooth / 2

    That is the speed of an extruder whose position is the nominal one plus advance times its speed, smoothed
    (Klipper, docs/Kinematics.md, pressure advance).
    """
    weight, Ts = 1 - np.abs(NODES), sample_time_s
    ahead = (pa.lead_s + pa.smooth_s / 2 * NODES) / Ts
    n = math.ceil(ahead[-1]) + 1
    window = weight @ np.maximum(1 - np.abs(np.arange(-n, n + 1) + ahead[:, None]), 0.0) / weight.sum()
    x = (r + pa.advance_s * np.gradient(r, Ts, axis=-1)) / pa.gain
    around = [(0, 0)] * (x.ndim - 1) + [(n, n)]
    return scipy.signal.oaconvolve(
        np.pad(x, around), window.reshape((1,) * (x.ndim - 1) + (-1,)), "valid", axes=-1
    )


def tune(
    chain: Chain, missed: forecast.Missed, wanted: Sequence[np.ndarray], *, lead: bool, sample_time_s: float
) -> TunedAdvance:
    """Returns the numbers with the least squared error of the chain's flow from the wanted flows, each (T,)
    in mm^3/s: gain, advance and smooth time, or, with a lead, gain, advance and lead at Klipper's smooth
    time. The drive is left out, because at its limits the best advance would be the largest, which is no
    property of the extruder.

    The interval reaches WIDER times as far as the numbers for the other possible flows (`forecast.flows`),
    each by one step of Gauss-Newton within the bounds.
    """
    r = np.zeros((len(wanted), max(map(len, wanted))))
    for row, one in zip(r, wanted, strict=True):
        row[: len(one)] = one
    extruder, free = chain.extruder, [0, 1, 3 if lead else 2]
    late_s = extruder.delay_s + basis.mean_lag_s(extruder) if lead else 0.0
    start = np.array([math.log(extruder.gain), extruder.time_constant_s, SMOOTH_S, late_s])
    start = np.clip(start, LOW, HIGH)

    def numbers(x: np.ndarray) -> PressureAdvance:
        z = start.copy()
        z[free] = x
        return PressureAdvance(math.exp(z[0]), *z[1:].tolist())

    def commands(x: np.ndarray) -> np.ndarray:
        return command(numbers(x), r, sample_time_s=sample_time_s)

    def errors(x: np.ndarray) -> np.ndarray:
        return (simulate([extruder], commands(x), sample_time_s=sample_time_s)[0] - r).ravel()

    bounds = LOW[free], HIGH[free]
    found = scipy.optimize.least_squares(
        errors, start[free], bounds=bounds, x_scale=SCALE[free], diff_step=1e-3
    )
    x, (Q, R) = found.x, np.linalg.qr(found.jac)
    rows = [
        forecast.flows(chain, missed, u, row, sample_time_s=sample_time_s) - row
        for u, row in zip(commands(x), r, strict=True)
    ]
    within = LOW[free] - x - 1e-9, HIGH[free] - x + 1e-9
    moved = [scipy.optimize.lsq_linear(R, -e @ Q, bounds=within).x for e in np.concatenate(rows, axis=1)]
    ends = [np.clip(x + WIDER * end(moved, axis=0, initial=0.0), *bounds) for end in (np.min, np.max)]
    return TunedAdvance(numbers(ends[0]), numbers(x), numbers(ends[1]))


def slicer_settings(advance: TunedAdvance, on_off_gain: float) -> dict[str, str | list[float]]:
    """Returns the numbers for a slicer and a firmware, each with the ends of its 90 % interval around it, and
    the lines that set them: Klipper, Marlin (M900 has no smooth time) and OrcaSlicer.

    The flow ratio is the gain with which on-off control started, divided by the tuned one, both in mm^3/s per
    mm.
    """
    of_each = list(zip(*advance, strict=True))
    ratios = sorted(on_off_gain / gain for gain in of_each[0])
    tuned, ratio = advance.tuned, on_off_gain / advance.tuned.gain
    return {
        "pressure_advance_s": list(of_each[1]),
        "smooth_time_s": list(of_each[2]),
        "flow_ratio": ratios,
        "Klipper": f"SET_PRESSURE_ADVANCE ADVANCE={tuned.advance_s:.4f} SMOOTH_TIME={tuned.smooth_s:.3f}",
        "Marlin": f"M900 K{tuned.advance_s:.4f}",
        "OrcaSlicer": f"enable_pressure_advance = 1; pressure_advance = {tuned.advance_s:.4f}; "
        f"filament_flow_ratio = {ratio:.4f}",
    }
