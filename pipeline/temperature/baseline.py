"""The simple rule that every learned controller must beat: one PI controller a zone, tuned by SIMC from the
model's step response (Skogestad 2003).

It gets the care that our own laws get: the feasible target of the model as feed-forward, an integrator that
the way up does not wind up, one input a zone.
"""

from typing import NamedTuple

import numpy as np
import scipy.optimize

from pipeline.temperature.plant import Plant, markov_parameters, strictly_proper
from pipeline.temperature.tracking import Controller, Law


class Pairing(NamedTuple):
    """Input of each output (p,), and SIMC's gain in percent per °C and reset time in samples of each pair;
    inputs in no pair rest at their target."""

    inputs: np.ndarray
    gain: np.ndarray
    reset: np.ndarray


def pairing(plant: Plant, low: np.ndarray, high: np.ndarray, *, horizon: int) -> Pairing:
    """Pairs whose full range heats fastest, one input an output; SIMC on the slope k'
    and the dead time theta of each pair's step response:

    K_c = 1 / (k' (tau_c + theta)), T_i = 4 (tau_c + theta), tau_c = theta >= 1 sample: the rule for
    near-integrating plants (Skogestad 2003, table 1). The slope is the secant over the second half of the way
    to the point t* where the line from the step's origin touches the response; t* is no earlier than a
    hundredth of `horizon`, so that a ripple of the first Markov parameters is not taken for the plant. Raises
    ValueError where an output obeys no input of its own.
    """
    if plant.m < plant.p:
        raise ValueError(f"PI needs an input for each of the {plant.p} outputs; found {plant.m} inputs")
    rise = np.concatenate(
        [np.zeros((1, plant.p, plant.m)), np.cumsum(markov_parameters(plant, horizon), axis=0)]
    )
    # the way an output goes in the end is its direction: a first answer
    # the other way counts as dead time, as SIMC has it
    forward = rise * np.where(rise[-1] < 0, -1.0, 1.0)
    t = np.arange(horizon + 1)[:, None, None]
    shortest = max(horizon // 100, 2)
    touch = shortest + (forward[shortest:] / t[shortest:]).argmax(axis=0)
    at, half = (np.take_along_axis(rise, when[None], axis=0)[0] for when in (touch, touch // 2))
    slope = (at - half) / (touch - touch // 2)
    effect = np.abs(slope) * (high - low)
    outputs, inputs = scipy.optimize.linear_sum_assignment(-effect)
    if (effect[outputs, inputs] <= 1e-9 * effect.max()).any():
        raise ValueError(
            f"PI needs an input for each of the {plant.p} outputs; "
            "found an output that none of the free inputs moves"
        )
    slope, at, touch = slope[outputs, inputs], at[outputs, inputs], touch[outputs, inputs]
    theta = np.maximum(touch - at / slope, 1.0)
    return Pairing(inputs, 1 / (2 * theta * slope), 8 * theta)


def pi_law(pairs: Pairing, *, inputs: int) -> Law:
    """u = u_target + K_c (r + xi - y) on each pair, xi(t+1) = xi + (r - y) /
    T_i with the slowest pair's T_i; no other memory."""
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
        integral=1 / pairs.reset.max(),
    )


def controller(plant: Plant, limits: tuple[np.ndarray, np.ndarray], *, horizon: int) -> Controller:
    """PI a zone, tuned by SIMC; the weights mean nothing to it. `limits` low and high (m,)."""
    plant = strictly_proper(plant)
    law = pi_law(pairing(plant, *limits, horizon=horizon), inputs=plant.m)
    return Controller("baseline", lambda q, r, integral: law, plant, own_feed_forward=False)
