"""The simple rule that every learned controller must beat: one PI controller a zone, tuned by SIMC from the model's step response (Skogestad 2003)."""

from typing import NamedTuple

import numpy as np
import scipy.optimize

from pipeline.temperature.plant import Plant, markov_parameters
from pipeline.temperature.tracking import Law


class Pairing(NamedTuple):
    """Input of each output (p,), and SIMC's gain in percent per °C and reset time in samples of each pair; inputs in no pair rest at their lower limit."""

    inputs: np.ndarray
    gain: np.ndarray
    reset: np.ndarray


def pairing(plant: Plant, low: np.ndarray, high: np.ndarray, *, horizon: int) -> Pairing:
    """Pairs with the largest total effect of full range after `horizon` samples, one input an output; SIMC on the steepest slope k' and the dead time theta:

    K_c = 1 / (k' (tau_c + theta)),  T_i = 4 (tau_c + theta),  tau_c = max(theta, 1 sample), the rule for near-integrating plants (Skogestad 2003, table 1).
    Raises ValueError where an output obeys no input of its own.
    """
    step = np.cumsum(markov_parameters(plant, horizon), axis=0)
    effect = np.abs(step[-1]) * (high - low)
    outputs, inputs = scipy.optimize.linear_sum_assignment(-effect)
    if len(outputs) < plant.p or (effect[outputs, inputs] <= 1e-9 * effect.max()).any():
        raise ValueError(f"PI needs an input for each of the {plant.p} outputs; found {plant.m} inputs, or an output that none of the free ones moves")
    gain, reset = np.empty(plant.p), np.empty(plant.p)
    for output, channel in zip(outputs, inputs, strict=True):
        response = step[:, output, channel]
        slope = np.diff(np.concatenate([[0.0], response]))
        steepest = int(np.abs(slope).argmax())
        theta = max(steepest + 1 - response[steepest] / slope[steepest], 1.0)
        gain[output] = 1 / (slope[steepest] * 2 * theta)
        reset[output] = 8 * theta
    return Pairing(inputs, gain, reset)


def pi_law(pairs: Pairing, low: np.ndarray, *, inputs: int) -> Law:
    """u = K_c (r - y) + z on each pair, z following what was really applied: z(t+1) = (K_c / T_i - K_c) (r - y) + u_applied, so that limits wind nothing up."""
    p, m = len(pairs.inputs), inputs
    to_input = np.zeros((m, p))
    to_input[pairs.inputs, np.arange(p)] = 1.0
    gain, change = np.diag(pairs.gain), np.diag(pairs.gain / pairs.reset - pairs.gain)
    free = np.setdiff1d(np.arange(m), pairs.inputs)
    k = np.zeros(m)
    k[free] = -low[free]
    zero = np.zeros((p, p))
    return Law(
        A=zero, B_u=to_input.T, B_y=-change, B_r=change, c=np.zeros(p), K=-to_input, D=to_input @ gain, K_r=-to_input @ gain, k=k,
        start_u=to_input.T, start_y=zero, start=np.zeros(p),
    )  # fmt: skip
