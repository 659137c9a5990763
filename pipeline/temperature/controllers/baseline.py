"""The baseline that every learned controller must beat: one PI controller per zone, tuned by SIMC from the
model's step response (Skogestad 2003).

It gets the same care as the other controllers: the feasible target of the model as feed-forward, an
integrator that does not wind up while heating up, and one input per zone.

A step response is read where it has risen, not at its first samples, because in a model identified from a
record those are ripple. Read from them, both loops of a two-heater kit got gains of the wrong sign.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.optimize

from pipeline.temperature.plant import Plant, markov_parameters, strictly_proper
from pipeline.temperature.tracking import Law

RISEN = 0.8  # of the largest excursion: a response is fitted up to there; beyond, a slow tail would set tau
LEVEL = 0.9  # level of the band over a family: a sign is certain if the band excludes zero
WEAKEST = 1e-9  # of the strongest effect: below it an input does not move an output
# of an input's range: a standard deviation of 3 percent of duty neither wears a relay nor adds heat
NOISE_SHARE = 0.03
MOST_POINTS = 150  # largest number of points of a response in one fit
LONGEST_TAU = 5.0  # times the fitted stretch: for any longer tau a straight line is used


class Pairing(NamedTuple):
    """Input of each output (p,), with SIMC's gain in percent per °C and reset time in samples of each pair
    (p,). Inputs in no pair stay at their target.

    `slope` in °C per percent and sample, `time_constant` (infinite if the response is a ramp) and `delay` in
    samples, each (p,): the first-order models from which the settings are computed.
    """

    inputs: np.ndarray
    gain: np.ndarray
    reset: np.ndarray
    slope: np.ndarray
    time_constant: np.ndarray
    delay: np.ndarray


class Rise(NamedTuple):
    """The model slope tau (1 - exp(-(t - delay) / tau)) of one step response, with times in samples. `until`
    is the last sample that was fitted."""

    slope: float
    time_constant: float
    delay: float
    until: int


def pairing(
    plant: Plant,
    low: np.ndarray,
    high: np.ndarray,
    *,
    horizon: int,
    family: Sequence[Plant] = (),
    noise_degC: np.ndarray | None = None,
    gain_factor: float | np.ndarray = 1.0,
    reset_factor: float | np.ndarray = 1.0,
) -> Pairing:
    """Pairs each output with the input that heats it, and tunes each pair by SIMC. The pairs are those whose
    full input ranges heat fastest: the product of their slopes is the largest, whatever the units. With k =
    slope tau, tau and theta of each pair's step response,

    K_c = tau / (k (tau_c + theta))
    T_i = min(tau, 4 (tau_c + theta))
    tau_c = max(theta, one sample)

    (Skogestad 2003, table 1). A held input is late by half a sample, which theta includes; theta is at least
    one sample. A search may multiply K_c and T_i by `gain_factor` and `reset_factor`, each one number or one
    per output (p,). tau_c is longer if a standard deviation of the sensor noise (p,) would otherwise move the
    input by more than `NOISE_SHARE` of its range, because the record does not support so fast a loop.

    A pair counts only if its sign is certain: its response goes one way, and the band of the rise over
    `family` does not include zero. Modes slower than 2 `horizon` samples count as integrators. `low`, `high`
    (m,): limits of the inputs in percent. Raises ValueError if there are fewer inputs than outputs, or an
    output has no such input of its own.
    """
    if plant.m < plant.p:
        raise ValueError(f"PI needs an input for each of the {plant.p} outputs; found {plant.m} inputs")
    fitted = rises(plant, horizon)
    slope = np.array([[rise.slope for rise in row] for row in fitted])
    stretch = _stretch(plant, horizon)[0]
    responses, *others = (_responses(member, stretch) for member in (plant, *family))
    inputs = _assigned(np.abs(slope) * (high - low), _certain(responses, fitted, others))
    # inverse of the gain in percent per °C at which noise moves the input by its share; it may be zero
    noise = np.zeros(plant.p) if noise_degC is None else noise_degC
    per_gain = noise / (NOISE_SHARE * (high - low)[inputs])
    return _settings(
        [fitted[o][i] for o, i in enumerate(inputs)], inputs, per_gain, gain_factor, reset_factor
    )


def rises(plant: Plant, horizon: int) -> list[list[Rise]]:
    """Returns the rise of each output (p lists) after a step of each input (m each); the slope has the sign
    of the response. `horizon` as in `pairing`."""
    stretch, decayed = _stretch(plant, horizon)
    responses = _responses(plant, stretch)
    direction = _direction(responses, decayed)
    if decayed and stretch > horizon:
        # beyond `horizon` an identified slow mode may reverse a response: if it reverses that of an
        # output's strongest input, responses are followed as for an integrator
        early = _responses(plant, _tenth(horizon))
        strongest = np.abs(early[-1]).argmax(axis=1)
        first, outputs = _direction(early, False), np.arange(plant.p)
        if (first[outputs, strongest] != direction[outputs, strongest]).any():
            responses, direction = early, first
    return [
        [_rise(direction[o, i] * responses[:, o, i], direction[o, i]) for i in range(plant.m)]
        for o in range(plant.p)
    ]


def _responses(plant: Plant, horizon: int) -> np.ndarray:
    """Returns step responses (horizon + 1, p, m) from rest, zero at the sample of the step."""
    rise = np.cumsum(markov_parameters(strictly_proper(plant), horizon), axis=0)
    return np.concatenate([np.zeros((1, *rise.shape[1:])), rise])


def _stretch(plant: Plant, horizon: int) -> tuple[int, bool]:
    """Returns the number of samples over which responses are followed, and whether every mode has decayed by
    then. It is three time constants of the slowest mode.

    A mode more than twice as slow as `horizon` looks like an integrator, whose response has no end. Only a
    tenth of the horizon is then followed, so that the slope is that of the rise and not of what neighbours do
    much later (as in `trust.horizon`).
    """
    radius = np.abs(np.linalg.eigvals(strictly_proper(plant).A)).max()
    slowest = -1 / np.log(np.clip(radius, 1e-6, 1 - 1e-12)) if radius < 1 else np.inf
    if slowest > 2 * horizon:
        return _tenth(horizon), False
    return max(int(np.ceil(3 * slowest)), 20), True


def _tenth(horizon: int) -> int:
    return max(horizon // 10, min(20, horizon))


def _direction(responses: np.ndarray, decayed: bool) -> np.ndarray:
    """Returns the direction (p, m) of each output: that of its final value if all modes have `decayed`,
    otherwise that of its largest excursion. A first response in the other direction counts as dead time."""
    largest = np.take_along_axis(responses, np.abs(responses).argmax(axis=0)[None], axis=0)[0]
    return np.where((responses[-1] if decayed else largest) < 0, -1.0, 1.0)


def _rise(forward: np.ndarray, sign: float) -> Rise:
    """Fits the model of one upward response (horizon + 1,) by least squares, up to where it first reaches
    RISEN of its peak. `sign` restores the sign of the slope."""
    peak = int(forward.argmax())
    if not forward[peak] > 0:
        return Rise(0.0, np.inf, 0.0, len(forward) - 1)
    until = max(int(np.argmax(forward >= RISEN * forward[peak])), min(5, len(forward) - 1))
    t = np.unique(np.linspace(0, until, MOST_POINTS).round())
    target = forward[t.astype(int)]
    taus = np.r_[np.geomspace(0.5, LONGEST_TAU * until, 60), np.inf]
    delays = np.unique((0.8 * until * np.linspace(0, 1, 50) ** 2).round())
    tau, delay = _nearest(t, target, taus, delays)
    if np.isfinite(tau):
        taus = tau * np.geomspace(0.85, 1.15, 25)
        width = np.diff(delays, prepend=0.0)[delays == delay].max() + 1
        delays = np.r_[delay, np.clip(np.linspace(delay - width, delay + width, 25), 0.0, None)]
        tau, delay = _nearest(t, target, taus, delays)
    shape = _shapes(t, np.array([tau]), np.array([delay]))[:, 0]
    return Rise(float(sign * (shape @ target) / (shape @ shape)), float(tau), float(delay), until)


def _shapes(t: np.ndarray, tau: np.ndarray, delay: np.ndarray) -> np.ndarray:
    """Returns tau (1 - exp(-(t - delay) / tau)), of slope one, (T, k); a ramp if tau is infinite."""
    late = np.maximum(t[:, None] - delay, 0.0)
    bounded = np.where(np.isfinite(tau), tau, 1.0)
    return np.where(np.isfinite(tau), -bounded * np.expm1(-late / bounded), late)


def _nearest(t, target, taus, delays) -> tuple[float, float]:
    """Returns tau and delay of the grid point nearest in least squares; the slope is free but not
    negative."""
    delay, tau = (part.ravel() for part in np.meshgrid(delays, taus, indexing="ij"))
    shapes = _shapes(t, tau, delay)
    products = np.maximum(target @ shapes, 0.0)
    best = int((products**2 / np.maximum(np.sum(shapes**2, axis=0), np.finfo(float).tiny)).argmax())
    return float(tau[best]), float(delay[best])


def _certain(responses: np.ndarray, fitted: list[list[Rise]], others: list[np.ndarray]) -> np.ndarray:
    """Returns whether the sign of each pair (p, m) is certain: its excursions in the other direction are
    smaller than the response itself, and the mean of the rise has the same sign over LEVEL of the family."""
    certain = np.zeros(responses.shape[1:], bool)
    for (o, i), _ in np.ndenumerate(certain):
        rise, forward = fitted[o][i], responses[:, o, i] * np.sign(fitted[o][i].slope)
        certain[o, i] = rise.slope != 0 and forward[: rise.until + 1].min() > -forward.max()
        if others and certain[o, i]:
            means = [np.sign(rise.slope) * one[: rise.until + 1, o, i].mean() for one in others]
            certain[o, i] = np.quantile(means, (1 - LEVEL) / 2) > 0
    return certain


def _assigned(effect: np.ndarray, certain: np.ndarray) -> np.ndarray:
    """Returns the input of each output (p,) with the largest product of effects (p, m). Raises ValueError if
    an output has no certain input left."""
    moves = effect > WEAKEST * effect.max()
    allowed = moves & certain
    # a forbidden pair costs more than all allowed pairs together could save
    cost = -np.log(np.where(allowed, effect, 1.0))
    worst = (np.ptp(cost[allowed]) + 1.0) * len(effect) if allowed.any() else 1.0
    inputs = scipy.optimize.linear_sum_assignment(np.where(allowed, cost, cost.max() + worst))[1]
    unpaired = np.flatnonzero(~allowed[np.arange(len(effect)), inputs])
    if unpaired.size:
        o = unpaired[0]
        reason = (
            f"the sign of the effect of input {int(np.where(moves[o], effect[o], 0).argmax()) + 1} on output "
            f"{o + 1} is not certain; record longer holds of that input"
            if moves[inputs].any() and (moves[o] & ~certain[o]).any()
            else "an output that none of the free inputs moves"
        )
        raise ValueError(f"PI needs an input for each of the {len(effect)} outputs; found {reason}")
    return inputs


def _settings(
    fitted: list[Rise],
    inputs: np.ndarray,
    per_gain: np.ndarray,
    gain_factor: float | np.ndarray,
    reset_factor: float | np.ndarray,
) -> Pairing:
    """Tunes each pair by SIMC, with tau_c so long that no gain in percent per °C exceeds 1 / `per_gain`
    (p,)."""
    slope, tau, delay = (
        np.array([getattr(rise, name) for rise in fitted]) for name in ("slope", "time_constant", "delay")
    )
    theta = np.maximum(delay + 0.5, 1.0)
    tau_c = np.maximum(theta, per_gain / np.abs(slope) - theta)
    gain = gain_factor / (slope * (tau_c + theta))
    reset = reset_factor * np.minimum(tau, 4 * (tau_c + theta))
    return Pairing(inputs, gain, reset, slope, tau, delay)


def pi_law(pairs: Pairing, *, inputs: int) -> Law:
    """Returns the PI controllers of all pairs as one law:

    u = u_target + K_c (r + xi - y)
    xi(t+1) = xi + (r - y) / T_i

    Each zone has its own T_i, and there is no other memory. `inputs`: number of inputs of the plant.
    """
    p = len(pairs.inputs)
    to_input = np.zeros((inputs, p))
    to_input[pairs.inputs, np.arange(p)] = pairs.gain
    none = np.zeros((0, 0))
    return Law(
        A=none,
        B_u=np.zeros((0, inputs)),
        B_y=np.zeros((0, p)),
        B_r=np.zeros((0, p)),
        c=np.zeros(0),
        K=np.zeros((inputs, 0)),
        D=to_input,
        K_r=-to_input,
        k=np.zeros(inputs),
        start_u=np.zeros((0, inputs)),
        start_y=np.zeros((0, p)),
        start=np.zeros(0),
        integral=1 / pairs.reset,
    )
