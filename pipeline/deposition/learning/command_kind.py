"""Finds from its first trials what a machine responds to: a pressure, the speed of what is pushed, or its
place. Each kind is fitted to the command as it was sent; the machine's kind is the one with the least
error."""

import math
from collections.abc import Callable, Sequence
from typing import get_args

import numpy as np
import scipy.optimize
import scipy.signal

from pipeline.deposition.drive import CommandKind, speed

KINDS: tuple[CommandKind, ...] = get_args(CommandKind)
# a flow above this many times the wanted one counts as this, because a drive or a camera is at its limit
# there
MOST = 2.5
# gain and time constant are known beforehand within this factor
KNOWN = 3.0
# start values of a fit: (factor of the time constant, share of the flow that is the yield); the best STARTS
# are used
GRID = tuple((factor, share) for factor in (0.4, 1.0, 2.5) for share in (0.0, 0.15))
STARTS = 2
# the declared kind is wrong if its squared error is this many times the least, with a place among the two or
# not
WRONG_PLACE, WRONG = 2.0, 1.15
# a kind names a machine only if it leaves no more than this share of the flow's squares
UNEXPLAINED = 0.4
ANSWERS = {
    "pressure": "its command as to a pressure",
    "speed": "the speed of its plunger",
    "place": "the place of its plunger",
}

Response = Callable[[np.ndarray, float, float, float, float], np.ndarray]


def relaxing(w: np.ndarray, tau: float, yield_: float, exponent: float, _: float) -> np.ndarray:
    """Returns the flow (T,), divided by the steady one, for a given pressure w (T,), with tau in samples:

    tau x' = w - x,   q = max(x - yield, 0)^exponent
    """
    a = math.exp(-1 / tau)
    return np.maximum(scipy.signal.lfilter([0.0, 1 - a], [1.0, -a], w) - yield_, 0.0) ** exponent


def conserving(w: np.ndarray, tau: float, yield_: float, exponent: float, leak: float) -> np.ndarray:
    """Returns the flow (T,), divided by the steady one, for the pushed volume w (T,). Volume that does not
    come out remains as pressure x; tau in samples:

        tau x' = w (1 - leak max(x, 0)) - q,   q = max(x - yield, 0)^exponent
    """
    x, out = 0.0, []
    for pushed in w.tolist():
        over = max(x - yield_, 0.0)
        # no more than there is
        q = min(over**exponent, tau * over + max(pushed, 0.0))
        x += (pushed * (1 - leak * max(x, 0.0)) - q) / tau
        out.append(q)
    return np.array(out)


def errors(
    sent: Sequence[np.ndarray], y: Sequence[np.ndarray], r: Sequence[np.ndarray], *, gain: float,
    time_constant_s: float, sample_time_s: float,
) -> dict[CommandKind, float]:  # fmt: skip
    """Returns the share of the flows' sum of squares that each kind, fitted to all trials, does not explain.
    Each trial has: the sent command (T,), in mm or mm/s, measured flow y (T,) and wanted r (T,) in mm^3/s.
    Flows above MOST count as MOST. gain and time_constant_s are the values known beforehand. Two speeds
    separate the kinds better than one."""
    steady, slow = max(float(one.max()) for one in r), math.log(time_constant_s / sample_time_s)
    observable = [np.isfinite(flow) for flow in y]
    told = [np.minimum(flow[mask] / steady, MOST) for flow, mask in zip(y, observable, strict=True)]
    power = max(float(np.sum(np.concatenate(told) ** 2)), np.finfo(float).tiny)
    low = np.array([-math.log(KNOWN), slow - math.log(KNOWN), 0.0, 0.0, 0.7, 0.0])
    high = np.array([math.log(KNOWN), slow + math.log(KNOWN), 0.5, 0.6, 1.8, 0.15])

    def squares(commands: Sequence[np.ndarray], response: Response) -> float:
        def left(theta: np.ndarray) -> np.ndarray:
            K, tau = np.exp(theta[:2]).tolist()
            parts = []
            for command, mask, flow in zip(commands, observable, told, strict=True):
                t = np.arange(len(command)) * sample_time_s
                w = K * gain / steady * np.interp(t - theta[2], t, command, left=0.0)
                parts.append(np.minimum(response(w, tau, *theta[3:].tolist())[mask], MOST) - flow)
            return np.concatenate(parts)

        starts = [
            np.array([math.log1p(share), slow + math.log(factor), 0.06, share + 0.01, 1.1, 0.03])
            for factor, share in GRID
        ]
        starts.sort(key=lambda theta: float(np.sum(left(theta) ** 2)))
        return min(
            2 / power * scipy.optimize.least_squares(
                left, start, bounds=(low, high), x_scale=[0.1, 0.1, 0.02, 0.05, 0.1, 0.03], diff_step=1e-4,
                max_nfev=25,
            ).cost
            for start in starts[:STARTS]
        )  # fmt: skip

    return {
        "pressure": squares(sent, relaxing),
        "speed": squares(sent, conserving),
        "place": squares([speed(one, sample_time_s=sample_time_s) for one in sent], conserving),
    }


def wrong_kind(squares: dict[CommandKind, float], declared: CommandKind) -> tuple[str, bool]:
    """Returns the sentence that names the kind of the machine if it differs from the declared one, else "";
    and whether nothing can be learned with the declared one.

    A pressure and a speed both give a steady flow for a steady command. They differ only by the effects of
    the ink's yield and its thinning. A machine without these effects fits both kinds, and neither is reported
    as wrong. A command sent as a place hardly separates them.
    """
    best = min(KINDS, key=squares.__getitem__)
    places = "place" in (declared, best)
    if squares[best] > UNEXPLAINED or squares[declared] < (WRONG_PLACE if places else WRONG) * squares[best]:
        return "", False
    answers, to = ANSWERS[best], str(best)
    if declared == "place":
        answers = f"{ANSWERS['speed']} or to {ANSWERS['pressure'].removeprefix('its command as to ')}"
        to = "speed for filament or a screw, to pressure for compressed air"
    sentence = (
        f"this machine answers to {answers}, not to {ANSWERS[declared]}; set printer.command to {to}, "
        "delete the recordings of this kind, and start again"
    )
    return sentence, places
