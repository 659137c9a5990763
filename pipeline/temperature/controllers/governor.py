"""The governor (output limiter): keeps the predicted worst output of a family of plants within the limits of
the outputs, whatever the law commands.

It works like a braking distance in each output. The command is changed as little as possible, so that from
the next step on every member of the family could still be stopped: below `high` by its lowest inputs, and
above `low` by its highest. Members that the record contradicts are left out. In the terms of a reference
governor (Garone, Di Cairano, Kolmanovsky 2017): the reference moves to the one for which the law would give
that command, and back-calculation corrects the integrator.

The strength of a member's inputs is known only as a range. Its forecast is linear in that strength, so it
carries two forecasts: one for the strongest, and one for the difference between strongest and weakest. Least
squares on its innovations shows, output by output, where between them the machine is. A member that explains
the innovations worse than another at any strength (for example, by a delay that does not exist) does not
count for a while.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg

from pipeline.temperature.controllers.law import ActuatorLimits, Governor, Plant, Strength
from pipeline.temperature.plant import markov_parameters
from pipeline.temperature.tracking import reached_state, riccati


class OutputLimits(NamedTuple):
    """low, high (p,) in °C, -inf and inf if none is declared. `margin` (p,) in °C is kept from both, for the
    sensors' noise (three standard deviations). `overshoot` in °C: how far an output may be predicted beyond
    its target."""

    low: np.ndarray
    high: np.ndarray
    margin: np.ndarray
    overshoot: float


# largest number of steps ahead
LONGEST = 120
# shares of a pulse response's peak: examined from REACHED on, in small steps up to SHOULDER
REACHED, SHOULDER = 0.2, 0.9
# shares that are forgotten per step, of the sums over innovations and of the drift. These and the observer's
# constants hold for a furthest look ahead of UNHURRIED steps; they are scaled for a machine that needs more
FORGETS, LEAK, UNHURRIED = 0.005, 1e-4, 16
# an output that has arrived may be LET_GO overshoots beyond its target, if the whole range of the inputs for
# one sample moves it by fewer than BARELY overshoots
LET_GO, BARELY = 4.0, 20.0


def governor(
    family: Sequence[Plant],
    limits: ActuatorLimits,
    outputs: OutputLimits,
    strength: Strength,
    *,
    tau: float = 0.2,
    drift: float = 0.06,
) -> Governor:
    """Returns the governor of a family of plants of one order (their feed-through made a delay), for inputs
    of any `strength` within its range.

    The uncertainty of the innovations follows the sensors' noise, at least a tenth of a degree. The observer
    assumes that process noise enters through the inputs, and that sensor noise is as large as the effect of
    tau percent^2 on every input. It assumes that the drift w changes per step by `drift` of the largest
    effect of a percent of every input. So units do not matter. A machine that responds more slowly is
    observed for longer, in proportion to the furthest instant ahead.
    """
    at, unsure = instants(family), np.maximum(outputs.margin, 0.1)
    slower = max(at[-1] / UNHURRIED, 1.0)
    members = [
        {
            **_watching(plant, strength, tau * slower**2, drift / slower, LEAK / slower),
            **_ahead(plant, limits, strength, at),
        }
        for plant in family
    ]
    return Governor(
        **{name: np.stack([member[name] for member in members]) for name in members[0]},
        low=outputs.low + outputs.margin,
        high=outputs.high - outputs.margin,
        surprise=3 * unsure,
        doubt=4 * unsure,
        near=_near(family[0], limits, outputs.overshoot, strength),
        forgets=FORGETS / slower,
        strength=strength,
        overshoot=outputs.overshoot,
    )


def _near(plant: Plant, limits: ActuatorLimits, overshoot: float, strength: Strength) -> np.ndarray:
    """Returns how far (p,) in °C an output that has arrived at its target may be predicted beyond it.

    This is `overshoot` if one sample can have a large effect. If it has little effect, the law's own small
    changes are as large as the errors of the forecast, and a tight limit would turn these into a steady
    error.
    """
    pulse = np.abs(markov_parameters(plant, LONGEST)).max(axis=0)
    most = strength.strongest * pulse @ (limits.high - limits.low)
    return np.where(most < BARELY * overshoot, LET_GO, 1.0) * overshoot


def instants(family: Sequence[Plant]) -> np.ndarray:
    """Returns the steps ahead at which the members are examined. The first is now. The next begin when an
    output's pulse response first reaches REACHED of its peak, grow by a quarter, and end when every output's
    has reached SHOULDER of its peak. Then ever wider steps follow, from the first peak to four times the step
    of the slowest member's strongest peak, at least 16 and at most LONGEST.

    Heat that is already on its way peaks in an output sooner than a pulse from now does. A search that starts
    at the pulse's peak finds it too late. Nearer than REACHED a command has so little effect that every error
    of the forecast would shut the inputs.
    """
    pulses = [np.abs(markov_parameters(plant, LONGEST)).max(axis=2) for plant in family]
    first = 1 + min(int(pulse.argmax(axis=0).min()) for pulse in pulses)
    peak = 1 + max(int(pulse.max(axis=1).argmax()) for pulse in pulses)
    last = min(max(4 * peak, 16), LONGEST)
    shares = [pulse / np.maximum(pulse.max(axis=0), 1e-300) for pulse in pulses]
    near = [1 + min(int((share >= REACHED).argmax(axis=0).min()) for share in shares)]
    full = 1 + max(int((share >= SHOULDER).argmax(axis=0).max()) for share in shares)
    while near[-1] < max(first, full):
        near.append(near[-1] + max(1, near[-1] // 4))
    between = np.r_[near, first, first + 2 ** np.arange(7)]
    return np.unique(np.r_[0, between[between < last], last])


def drifting(plant: Plant, leak: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Returns A, C of the state [x; w]. w (p,), in °C a step, warms the outputs along the state that inputs
    most likely reach. It leaks, so that none of its modes is both constant and unobservable."""
    n, p = plant.n, plant.p
    A = np.block([[plant.A, reached_state(plant)], [np.zeros((p, n)), (1 - leak) * np.eye(p)]])
    return A, np.hstack([plant.C, np.zeros((p, p))])


def observer(
    plant: Plant, *, tau: float, drift: float, leak: float, lags: int = LONGEST
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns A, C of the state [x; w], and M (n + p, p), the immediate correction of the state per
    innovation. Process noise enters through the inputs. Sensor noise is as large as the effect of tau
    percent^2 on every input. The drift changes per step by `drift` of the largest effect of a percent of
    every input within `lags` steps."""
    A, C = drifting(plant, leak)
    pulse = (np.abs(markov_parameters(plant, lags)).max(axis=0) ** 2).sum(axis=1)
    noise = scipy.linalg.block_diag(plant.B @ plant.B.T, drift**2 * np.diag(pulse))
    sensors = tau * pulse.mean() * np.eye(plant.p)
    P = riccati(A.T, C.T, noise, sensors)
    return A, C, P @ C.T @ np.linalg.inv(C @ P @ C.T + sensors)


def _watching(
    plant: Plant, strength: Strength, tau: float, drift: float, leak: float
) -> dict[str, np.ndarray]:
    """Returns the part of a Governor with which one member follows the machine."""
    n, m, p = plant.n, plant.m, plant.p
    likely = reached_state(plant)
    A, C, L = observer(plant, tau=tau, drift=drift, leak=leak)
    less, none = strength.strongest - strength.weakest, np.zeros((p, m))
    quick, slow = (np.vstack(parts) for parts in ((L[:n], 0 * L[n:]), (0 * L[:n], L[n:])))
    one, other = np.array([[1.0], [0.0]]), np.array([[0.0], [1.0]])
    return {
        "see": scipy.linalg.block_diag(C, C).T,
        "offset": plant.d,
        "correct": np.hstack([np.kron(which, part) for which in (one, -other) for part in (quick, slow)]).T,
        "move": scipy.linalg.block_diag(A, A).T,
        "push": np.vstack([strength.strongest * plant.B, none, less * plant.B, none]).T,
        "rest": np.r_[plant.b, np.zeros(n + 2 * p)],
        "start": np.vstack([likely, np.zeros((n + 2 * p, p))]).T,
        "start_0": np.r_[-likely @ plant.d, np.zeros(n + 2 * p)],
    }


def _ahead(plant: Plant, limits: ActuatorLimits, strength: Strength, at: np.ndarray) -> dict[str, np.ndarray]:
    """Returns the rows of a Governor for one member. A rate limit slows the stop: inputs go from u to the
    limit on a straight line. An input that helps is assumed to act less than one that hurts, within the range
    that `each` leaves open."""
    n, m, p = plant.n, plant.m, plant.p
    A, C = drifting(plant)
    B, b = np.vstack([plant.B, np.zeros((p, m))]), np.r_[plant.b, np.zeros(p)]
    rows = {name: [] for name in ("x", "u", "left", "right")}
    power, driven, left, right = np.eye(n + p), np.zeros((n + p, m)), np.zeros((n + p, m)), np.zeros(n + p)
    for step in range(at[-1] + 1):
        if step in at:
            for name, part in zip(rows, (power, driven, left, right), strict=True):
                rows[name].append(C @ part)
        share = np.maximum(0.0, 1.0 - step * limits.rate / (limits.high - limits.low)) if step else 1.0
        power, driven = A @ power, A @ driven + B * share
        left, right = A @ left + B * (1.0 - share), A @ right + b
    x, u, left, right = (np.stack(rows[name], axis=1).reshape(p * len(at), -1) for name in rows)
    most, least = strength.strongest, strength.weakest
    rest, weaker = right[:, 0] + np.repeat(plant.d, len(at)), (1 - strength.each) / (1 + strength.each)
    return {
        "ahead": scipy.linalg.block_diag(x, x).T,
        "above": rest + most * left @ limits.low,
        "below": rest + least * left @ limits.high,
        "rise": np.where(u < 0, weaker * u, u).T,
        "fall": np.where(u < 0, u / weaker, u).T,
    }
