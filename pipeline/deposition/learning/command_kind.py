"""What a machine answers to, from its first trial: a pressure, the speed of what is pushed, or its place.
Each kind is fitted to the command as it was sent; the kind with the least error names the machine."""

import math
from collections.abc import Callable
from typing import get_args

import numpy as np
import scipy.optimize
import scipy.signal

from pipeline.deposition.drive import CommandKind, speed

KINDS: tuple[CommandKind, ...] = get_args(CommandKind)
# a flow above so many times the wanted one is at least that: a drive or a camera is at its end there
MOST = 2.5
# what is known beforehand of gain and time constant holds within this factor
KNOWN = 3.0
# (factor of the time constant, share of the flow that is the yield) from which a fit sets out; the best
# STARTS are followed
GRID = tuple((factor, share) for factor in (0.4, 1.0, 2.5) for share in (0.0, 0.15))
STARTS = 2
# a kind fits worse if the squares of its error are so many times the least
WORSE, WRONG = 1.04, 2.0
ANSWERS = {
    "pressure": "its command as to a pressure",
    "speed": "the speed of its plunger",
    "place": "the place of its plunger",
}

Response = Callable[[np.ndarray, float, float, float], np.ndarray]


def relaxing(w: np.ndarray, tau: float, yield_: float, exponent: float) -> np.ndarray:
    """Flow (T,) over the steady one under a pressure w (T,) that is given, tau in samples:

    tau x' = w - x,   q = max(x - yield, 0)^exponent
    """
    a = math.exp(-1 / tau)
    return np.maximum(scipy.signal.lfilter([0.0, 1 - a], [1.0, -a], w) - yield_, 0.0) ** exponent


def conserving(w: np.ndarray, tau: float, yield_: float, exponent: float) -> np.ndarray:
    """Flow (T,) over the steady one under the volume w (T,) that is pushed, of which what does not come out
    stays as pressure x; tau in samples:

    tau x' = w - q,   q = max(x - yield, 0)^exponent
    """
    x, out = 0.0, []
    for pushed in w.tolist():
        over = max(x - yield_, 0.0)
        # no more than there is
        q = min(over**exponent, tau * over + max(pushed, 0.0))
        x += (pushed - q) / tau
        out.append(q)
    return np.array(out)


def errors(
    sent: np.ndarray, y: np.ndarray, r: np.ndarray, *, gain: float, time_constant_s: float,
    sample_time_s: float,
) -> dict[CommandKind, float]:  # fmt: skip
    """Sum of squares that each kind leaves of the flow y (T,) in mm^3/s under what was sent (T,), in mm or
    mm/s, wanted r (T,), as shares of the steady flow; flows above MOST count as MOST. gain and
    time_constant_s are what is known beforehand."""
    observable, steady = np.isfinite(y), float(r.max())
    told = np.minimum(y[observable] / steady, MOST)
    t, slow = np.arange(len(r)) * sample_time_s, math.log(time_constant_s / sample_time_s)
    low = np.array([-math.log(KNOWN), slow - math.log(KNOWN), 0.0, 0.0, 0.7])
    high = np.array([math.log(KNOWN), slow + math.log(KNOWN), 0.5, 0.6, 1.8])

    def squares(command: np.ndarray, response: Response) -> float:
        def left(theta: np.ndarray) -> np.ndarray:
            K, tau = np.exp(theta[:2]).tolist()
            w = K * gain / steady * np.interp(t - theta[2], t, command, left=0.0)
            return np.minimum(response(w, tau, *theta[3:].tolist())[observable], MOST) - told

        starts = [
            np.array([math.log1p(share), slow + math.log(factor), 0.06, share + 0.01, 1.1])
            for factor, share in GRID
        ]
        starts.sort(key=lambda theta: float(np.sum(left(theta) ** 2)))
        return min(
            2 * scipy.optimize.least_squares(
                left, start, bounds=(low, high), x_scale=[0.1, 0.1, 0.02, 0.05, 0.1], diff_step=1e-4,
                max_nfev=25,
            ).cost
            for start in starts[:STARTS]
        )  # fmt: skip

    moved = speed(sent, sample_time_s=sample_time_s)
    return {
        "pressure": squares(sent, relaxing),
        "speed": squares(sent, conserving),
        "place": squares(moved, conserving),
    }


def wrong_kind(squares: dict[CommandKind, float], declared: CommandKind) -> tuple[str, bool]:
    """The sentence that names the kind of the machine if it is another than the declared one, else ""; and
    whether nothing can be learned by the declared one.

    A pressure and a speed both give a steady flow for a steady command. They differ by what the ink's yield
    and its thinning do, so that a machine without either fits both, and neither is named wrong. A command
    sent as a place does not part them at all.
    """
    best = min(KINDS, key=squares.__getitem__)
    ratio = squares[declared] / max(squares[best], np.finfo(float).tiny)
    if ratio < WORSE:
        return "", False
    answers = ANSWERS[best]
    if declared == "place":
        answers = f"{ANSWERS['speed']} or to {ANSWERS['pressure'].removeprefix('its command as to ')}"
    sentence = (
        f"this machine answers to {answers}, not to {ANSWERS[declared]}; set printer.command to {best}, "
        "delete the recordings of this kind, and start again"
    )
    return sentence, ratio >= WRONG and "place" in (declared, best)
