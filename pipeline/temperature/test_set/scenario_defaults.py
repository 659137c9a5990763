"""Chooses by stated defaults the cases of a simulation on a user's record: from how fast the machine is,
where it was recorded, and what its inputs can hold.

A bed with a time constant of 230 s cannot be judged by the 60 s of another machine, nor started at 15 °C in a
room of 22 °C. Each default has its reason beside its name; none is a setting.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.optimize

from pipeline.temperature.controllers.baseline import rises
from pipeline.temperature.identification.first_order import time_constant
from pipeline.temperature.identification.refinement import one_step_errors, simulated
from pipeline.temperature.plant import Plant, hold_output, strictly_proper

RANGE = (0.01, 0.99)  # quantiles of the recorded range, so that a spike or one sample does not set it
ONE_DEVIATION = (0.1587, 0.8413)  # normal quantiles one standard deviation below and above the median
MIDDLE = 0.5  # of the recorded span: the middle start
LOWER_SHARE = 0.15  # of the recorded span: how far the second reference lies below the first
# time of an open loop to come within 5 % of its end; the delay counts twice, for the step and its response
SETTLING = (3.0, 2.0)  # time constants, delays
BAND_NOISE = 3.0  # standard deviations: noise alone leaves the band once in 370 samples
BAND_SHARE = 0.01  # of the recorded span, if a sensor is better than the machine needs
# a smaller difference does not show in a print. More noise does not widen the band: true outputs are judged
WIDEST_BAND_DEGC = 1.0
TIME_CONSTANTS = 8.0  # in a case: 3 to settle, 3 to settle again, and the last sixth, the settled window
STEPS = (600, 3000)
# time constants in a period of the sinusoid: two periods fit; its heat flow is twice that of holding still
PERIOD = 4.0
REACHED_DEGC = 0.1  # a reference missed by less counts as reached: no sensor here shows the difference
# of an input's limit, kept free at a reference that the owner did not choose: it can still be held with 15 %
# less gain
HEADROOM = 0.15
# of an input's range, kept free above its lowest: a reference can still be held in a slightly warmer room
FLOOR_SHARE = 0.05
BEYOND = 1e3  # crossing a declared limit of an output costs this many times as much as missing a reference
LEAK = 1e-9  # assumed leak per step of a plant that only integrates, so that it has a steady state


class MachineScale(NamedTuple):
    """Speed, temperature range and noise of a machine, per output (p,).

    time_constant_s: the first-order lag that explains the record; delay_s: effective dead time of the
    strongest input, including lags of sensors. low_degC..high_degC: recorded range. noise_degC: standard
    deviation of what neither the model nor the previous reading predicts one step ahead. ambient_degC_spread:
    the largest difference between recordings in the mean simulation error (another room, another day); 0 with
    one recording.
    """

    time_constant_s: np.ndarray
    delay_s: np.ndarray
    low_degC: np.ndarray
    high_degC: np.ndarray
    noise_degC: np.ndarray
    ambient_degC_spread: np.ndarray


class Infeasible(NamedTuple):
    """A reference of output `output` that cannot be held, alone or together with the others. `reachable_degC`
    is the nearest one within limits.

    `input` is the one at its `limit` "low" or "high" that would move the output most. It is None if the limit
    is not that of an input: "output low" or "output high" for the machine's own limits, or "inputs" if there
    are fewer than the references need.
    """

    output: int
    asked_degC: float
    reachable_degC: float
    input: int | None
    limit: str


class CaseDefaults(NamedTuple):
    """The cases of a simulation. Starts (k, p), at which the plant is held, and references (j, p), in °C;
    both are steady states within the limits of inputs and outputs by the model. settling_s: limit of the
    settling time; band_degC: band of settling; ramp_degC_per_step (p,): from the lower reference, one ramp
    per run; `sequence` (3, p) in °C."""

    starts: np.ndarray
    references: np.ndarray
    infeasible: list[Infeasible]
    settling_s: float
    band_degC: float
    steps: int
    ramp_degC_per_step: np.ndarray
    sinusoid: tuple[np.ndarray, int]  # about the middle of the two references: amplitude (p,) in °C, steps
    sequence: np.ndarray


# ---- the machine, from its record


def machine_scale(
    u: Sequence[np.ndarray],
    y: Sequence[np.ndarray],
    model: Plant,
    sample_time_s: float,
    recording_of_segment: Sequence[int],
) -> MachineScale:
    """Returns the scale of a machine from segments u (T, m), y (T, p), their model, and the recording of each
    segment.

    Time constants come from the record, because a model's slowest pole may be a drift. None is longer than
    the longest segment, which could not show it. Raises ValueError if no input moves.
    """
    p = model.p
    longest = max(map(len, y)) * sample_time_s
    taus = [time_constant(u, [b[:, o] for b in y], sample_time_s=sample_time_s) for o in range(p)]
    low, high = np.nanquantile(np.vstack(y), RANGE, axis=0)
    below, above = np.nanquantile(np.vstack(one_step_errors(model, u, y)), ONE_DEVIATION, axis=0)
    # errors larger than the change since the last reading come from the model, not from the sensor
    repeated = np.sqrt(np.nanmean(np.vstack([np.diff(b, axis=0) for b in y]) ** 2, axis=0))
    return MachineScale(
        np.minimum(taus, longest),
        sample_time_s * _delays(model, np.ptp(np.vstack(u), axis=0), max(map(len, y))),
        low,
        high,
        np.minimum((above - below) / 2, repeated),
        _ambient_spread(u, y, model, recording_of_segment),
    )


def _delays(model: Plant, moved: np.ndarray, horizon: int) -> np.ndarray:
    """Returns the dead time (p,) in samples of the input that acts most on each output over its recorded
    range `moved` (m,)."""
    strongest = [
        row[int(np.argmax([abs(rise.slope) * d for rise, d in zip(row, moved, strict=True)]))]
        for row in rises(model, horizon)
    ]
    return np.array([rise.delay for rise in strongest])


def _ambient_spread(u, y, model: Plant, recording_of_segment: Sequence[int]) -> np.ndarray:
    """Returns the range (p,) of the mean simulation error over the recordings. The start of each segment is
    fitted together with its mean, because a start fitted alone would hide part of the effect of another
    room."""
    errors: dict[int, list[np.ndarray]] = {}
    for a, b, recording in zip(u, y, recording_of_segment, strict=True):
        errors.setdefault(int(recording), []).append(b - simulated(model, a, b, means_removed=True))
    means = [np.nanmean(np.vstack(parts), axis=0) for parts in errors.values()]
    return np.ptp(np.stack(means), axis=0)


# ---- the cases, from the machine


def defaults(
    scale: MachineScale,
    model: Plant,
    limits: tuple[np.ndarray, np.ndarray],
    asked_reference: np.ndarray,
    output_low: np.ndarray,
    output_high: np.ndarray,
    sample_time_s: float,
) -> CaseDefaults:
    """Returns starts, references and rules for one machine. `limits`: low and high (m,) of the inputs in
    percent; output_low and output_high (p,) in °C, infinite if the owner declares none.

    starts: the coldest state of the record, as when a machine is switched on, and the middle of its range, or
    the nearest that the inputs can hold. references: the declared one if it can be held; otherwise the
    nearest that leaves HEADROOM to inputs and the band to declared limits of outputs; and a second one,
    LOWER_SHARE of the recorded span below. ramp: from the lower to the higher in one run. sinusoid: about
    their middle, so small that it needs no more heat than the change between them does. sequence: lower,
    higher, middle. All references lie between two states that can be held, so they can be held too.
    """
    span = scale.high_degC - scale.low_degC
    widest = np.maximum(BAND_NOISE * scale.noise_degC, BAND_SHARE * span).max()
    band, bounds = float(min(widest, WIDEST_BAND_DEGC)), Bounds(*limits, output_low, output_high)
    careful = _drawn_in(bounds, band)
    middle = _nearest(model, scale.low_degC + MIDDLE * span, careful)[0]
    asked = np.asarray(asked_reference, float)
    reached, u = _nearest(model, asked, bounds)
    first, entries = asked, []
    if (missed := np.abs(reached - asked) > REACHED_DEGC).any():
        held_back = np.where(missed, _nearest(model, asked, careful)[0], asked)
        first, u_first = _nearest(model, held_back, bounds)
        # a zone within reach may need the heat of a zone whose reference is lowered
        entries = [
            _missed(model, int(o), asked, reached, first, (u if missed[o] else u_first), bounds)
            for o in np.flatnonzero(missed | (np.abs(first - asked) > REACHED_DEGC))
        ]
    lower = _nearest(model, first - LOWER_SHARE * span, careful)[0]
    slowest, delay = float(scale.time_constant_s.max()), float(scale.delay_s.max())
    needed = int(np.ceil((TIME_CONSTANTS * slowest + 2 * delay) / sample_time_s))
    steps = min(max(needed, STEPS[0]), STEPS[1])
    return CaseDefaults(
        starts=np.stack([scale.low_degC, middle]),
        references=np.stack([first, lower]),
        infeasible=entries,
        settling_s=SETTLING[0] * slowest + SETTLING[1] * delay,
        band_degC=band,
        steps=steps,
        ramp_degC_per_step=(first - lower) / steps,
        sinusoid=(
            np.abs(first - lower) / 2 / np.hypot(1, 2 * np.pi / PERIOD),
            max(round(PERIOD * slowest / sample_time_s), 4),
        ),
        sequence=np.stack([lower, first, (first + lower) / 2]),
    )


def heat_up_s(model: Plant, cold: np.ndarray, reference: np.ndarray, high: np.ndarray) -> float:
    """Returns the time in s in which the inputs at `high` (m,) heat the outputs from `cold` (p,), where they
    are held, past `reference` (p,) in °C, each zone at least once. Returns STEPS[1] samples if one never gets
    there."""
    model = strictly_proper(model)
    x, _ = hold_output(model, cold)
    past = model.C @ x + model.d >= reference - REACHED_DEGC
    for t in range(STEPS[1]):
        if past.all():
            return t * model.sample_time_s
        x = model.A @ x + model.B @ high + model.b
        past |= model.C @ x + model.d >= reference - REACHED_DEGC
    return STEPS[1] * model.sample_time_s


def unreachable(
    model: Plant,
    limits: tuple[np.ndarray, np.ndarray],
    asked_reference: np.ndarray,
    output_low: np.ndarray,
    output_high: np.ndarray,
) -> list[Infeasible]:
    """Returns the references that a machine cannot hold, if they are judged as requested; arguments as in
    `defaults`."""
    bounds = Bounds(*limits, output_low, output_high)
    asked = np.asarray(asked_reference, float)
    reached, u = _nearest(model, asked, bounds)
    missed = np.flatnonzero(np.abs(reached - asked) > REACHED_DEGC)
    return [_missed(model, int(o), asked, reached, reached, u, bounds) for o in missed]


class Bounds(NamedTuple):
    """Limits of inputs (m,) in percent and of outputs (p,) in °C, infinite if none is declared."""

    low: np.ndarray
    high: np.ndarray
    output_low: np.ndarray
    output_high: np.ndarray


def _drawn_in(bounds: Bounds, band: float) -> Bounds:
    """Returns narrower limits: inputs by HEADROOM towards zero, and FLOOR_SHARE above a lowest value of zero
    or more; outputs by the band, or to their middle if the limits are less than two bands apart."""
    raised = bounds.low + FLOOR_SHARE * (bounds.high - bounds.low)
    low = np.where(bounds.low < 0, (1 - HEADROOM) * bounds.low, raised)
    high = np.where(bounds.high > 0, np.maximum((1 - HEADROOM) * bounds.high, low), bounds.high)
    room = np.minimum(band, (bounds.output_high - bounds.output_low) / 2)
    return Bounds(low, high, bounds.output_low + room, bounds.output_high - room)


def steady_map(model: Plant) -> tuple[np.ndarray, np.ndarray]:
    """Returns G (p, m) and g (p,) of the steady outputs y = G u + g. A plant that only integrates is assumed
    to leak LEAK per step."""
    model = strictly_proper(model)
    balance = np.eye(model.n) - model.A
    if np.linalg.cond(balance) > 1e13:
        balance = balance + LEAK * np.eye(model.n)
    return (
        model.C @ np.linalg.solve(balance, model.B),
        model.C @ np.linalg.solve(balance, model.b) + model.d,
    )


def _nearest(model: Plant, r: np.ndarray, bounds: Bounds) -> tuple[np.ndarray, np.ndarray]:
    """Returns the steady outputs (p,) nearest to r by the sum of misses, and inputs (m,) for them, within
    limits. Solves a linear programme over [u; miss; beyond]. Limits of outputs are crossed only if no input
    keeps them. Raises ValueError if there is no solution.

    The sum of misses is used, not of their squares, so that a zone that cannot be reached does not pull
    others off their references.
    """
    G, g = steady_map(model)
    p, m, one = model.p, model.m, np.eye(model.p)
    none, size = np.zeros((p, p)), 1 / np.maximum(np.abs(G).max(axis=0), np.finfo(float).tiny)
    G = G * size  # inputs in units of their effect in °C
    rows = np.vstack([np.hstack([G, -one, none]), np.hstack([-G, -one, none])])
    right = np.r_[r - g, g - r]
    for sign, limit in ((1.0, bounds.output_high), (-1.0, bounds.output_low)):
        some = np.isfinite(limit)
        rows = np.vstack([rows, np.hstack([sign * G, none, -one])[some]])
        right = np.r_[right, (sign * (limit - g))[some]]
    free = [(0.0, None)] * (2 * p)
    inputs = list(zip(bounds.low / size, bounds.high / size, strict=True))
    price = np.r_[np.zeros(m), np.ones(p), np.full(p, BEYOND)]
    solved = scipy.optimize.linprog(price, A_ub=rows, b_ub=right, bounds=inputs + free, method="highs-ds")
    if solved.x is None:
        raise ValueError(
            f"no steady input of the identified model could be found for references {r.tolist()} °C "
            f"({solved.message}); identify the plant on a longer record"
        )
    return G @ solved.x[:m] + g, solved.x[:m] * size


def _missed(
    model: Plant,
    o: int,
    asked: np.ndarray,
    reached: np.ndarray,
    judged: np.ndarray,
    u: np.ndarray,
    bounds: Bounds,
) -> Infeasible:
    """Returns what keeps output o from its reference: a declared limit of its own, or an input in u that is
    at its limit in the direction that would help. Of several inputs, it is the one whose range moves the
    output most."""
    figures = o, float(asked[o]), float(reached[o])
    if asked[o] > bounds.output_high[o]:
        return Infeasible(*figures, None, "output high")
    if asked[o] < bounds.output_low[o]:
        return Infeasible(*figures, None, "output low")
    helps, slack = (asked[o] - judged[o]) * steady_map(model)[0][o], 1e-6 * (bounds.high - bounds.low)
    stuck = np.where(helps > 0, u >= bounds.high - slack, u <= bounds.low + slack) & (helps != 0)
    if not stuck.any():
        return Infeasible(*figures, None, "inputs")
    i = int(np.where(stuck, np.abs(helps) * (bounds.high - bounds.low), 0.0).argmax())
    return Infeasible(*figures, i, "high" if helps[i] > 0 else "low")
