"""The nearest flow that a drive of limited travel and speed can reach, and the shortest ramp of the gantry at
which the drive loses little."""

import functools
import math
from collections.abc import Sequence

import numpy as np
import scipy.linalg
import scipy.signal

from pipeline.deposition.drive import Drive
from pipeline.deposition.extruder import Extruder, ramp_of_gantry

# a drive follows if it adds at most this share of on-off control's error to that of the unlimited command
LOSS = 0.02
# a longer signal is solved in pieces, each with MARGIN samples beyond its end, after which later samples have
# no effect. If the limits act on the next piece differently by more than JOINED, in the unit of x or as a
# share of the largest, the margin doubles, up to a PIECE
PIECE, MARGIN, JOINED = 8192, 512, 0.02
# settings of the interior-point method on a piece: mean product of slack and multiplier at the begin and at
# the end, the share of it at which a step aims, the share of the way to the nearest bound that a step goes,
# and the largest number of steps
FIRST_GAP, LAST_GAP, AIM, MOST_OF_WAY, MOST_STEPS = 30.0, 1e-6, 0.2, 0.99, 100


def nearest(
    target: np.ndarray,
    free: np.ndarray,
    *,
    pole: float,
    bound: float,
    step: float = math.inf,
    rest: np.ndarray | None = None,
    piece: int = PIECE,
    margin: int = MARGIN,
) -> np.ndarray:
    """Returns x (N,), from rest, that is nearest to `target` (N,) among all with |v(t)| <= bound and |v(t) -
    v(t-1)| <= step, v(t) = x(t) - pole x(t-1). These are all x that a first-order extruder can press.

    If `free` (N,) is True, only x above the target costs, because no flow is wanted and none comes below the
    yield; below it x settles at `rest` (N,), or at the target if rest is None. x, bound and step are in
    mm^3/s: bound is K (1 - pole) times the amplitude, step is K (1 - pole) times the speed and the sample
    time.

    A long signal is solved piece by piece. Each piece starts where the last one ended, so x keeps the limits
    across the joins, and looks far enough ahead that looking further would not change it.
    """
    if not (math.isfinite(bound) or math.isfinite(step)):
        return np.array(target, float)
    N, c = len(target), min(bound, step / (1 - pole))
    below = target if rest is None else rest
    x, begin, before, ahead, least = np.empty(N), 0, 0, None, margin
    while True:
        upto = min(begin + piece + margin, N)
        first, second = (x[begin - k] / c if begin else 0.0 for k in (1, 2))
        z, hold = _piece(
            target[begin:upto] / c, free[begin:upto], below[begin:upto] / c, pole=pole,
            bound=bound / c, step=step / c, x=first, v=first - pole * second,
        )  # fmt: skip
        if ahead is not None and margin < piece and not _same(hold, ahead):
            begin, margin, ahead = before, 2 * margin, None
            continue
        margin = margin if ahead is None else max(least, margin // 2)
        if upto == N:
            x[begin:] = c * z
            return x
        x[begin : begin + piece], ahead = c * z[:piece], hold[:, piece:]
        before, begin = begin, begin + piece


@functools.cache
def ramp_that_loses_little(
    extruder: Extruder,
    drive: Drive,
    *,
    steady_flow: float,
    ramp_s: float,
    longest_s: float,
    sample_time_s: float,
) -> float:
    """Returns the shortest time in s, 0 or more, in which the gantry may speed up and slow down so that the
    drive loses at most LOSS on a line; inf if no time up to longest_s is enough.

    The flow is bead area x speed. It follows the gantry's ramp up to `steady_flow` in mm^3/s and down again,
    shaped by two boxes of ramp_s. The loss is the r.m.s. error of the nearest flow within amplitude and
    speed, as share of that of on-off control r / K without limits; the unlimited command has no loss. The
    yield is loaded before, over as long as it takes, and costs nothing. Delay, lag and creep are left out.
    Bisected to 1 %.
    """
    if math.isinf(drive.amplitude_mm) and math.isinf(drive.speed_mm_per_s):
        return 0.0

    def loses_little(slow_s: float) -> bool:
        return (
            lost(extruder, _line(extruder, steady_flow, slow_s, ramp_s, sample_time_s), drive, sample_time_s)
            <= LOSS
        )

    if loses_little(0.0):
        return 0.0
    low, high = 0.0, min(0.1, longest_s)
    while not loses_little(high):
        if high == longest_s:
            return math.inf
        low, high = high, min(2 * high, longest_s)
    while high - low > 0.01 * high:
        middle = (low + high) / 2
        low, high = (low, middle) if loses_little(middle) else (middle, high)
    return high


def ramp_of_all(
    extruders: Sequence[Extruder],
    drive: Drive,
    *,
    steady_flow: float,
    ramp_s: float,
    longest_s: float,
    sample_time_s: float,
) -> float:
    """Returns the time in s in which the gantry may reach a printing speed so that the drive follows the flow
    of each of the extruders (`ramp_that_loses_little`), rounded up to hundredths; at most longest_s."""
    ramps = [
        ramp_that_loses_little(
            extruder, drive, steady_flow=steady_flow, ramp_s=ramp_s, longest_s=longest_s,
            sample_time_s=sample_time_s,
        )
        for extruder in extruders
    ]  # fmt: skip
    return min(math.ceil(100 * min(max(ramps), longest_s)) / 100, longest_s)


def flow(extruder: Extruder, r: np.ndarray, drive: Drive, sample_time_s: float) -> np.ndarray:
    """Returns the flow (T,) in mm^3/s nearest to r (T,) that the drive can press out of the extruder's gain,
    time constant and yield. Delay and lag are left out, because a command can be sent earlier, and so are
    play and creep. (A lag overshoots its input by 5 %, so about a percent more may be reachable.)"""
    a, yield_ = math.exp(-sample_time_s / extruder.time_constant_s), extruder.yield_
    scale = extruder.gain * (1 - a)
    x = nearest(
        r + yield_,
        r <= 0,
        pole=a,
        bound=scale * drive.amplitude_mm,
        step=scale * drive.speed_mm_per_s * sample_time_s,
    )
    return np.maximum(x - yield_, 0.0)


def lost(extruder: Extruder, r: np.ndarray, drive: Drive, sample_time_s: float) -> float:
    """Returns the r.m.s. error of the nearest flow to r (T,) in mm^3/s that the drive allows, as share of
    that of on-off control r / K without limits."""
    a = math.exp(-sample_time_s / extruder.time_constant_s)
    on_off = np.linalg.norm(scipy.signal.lfilter([0.0, 1 - a], [1.0, -a], r) - r)
    least = np.linalg.norm(flow(extruder, r, drive, sample_time_s) - r)
    return float(least / max(on_off, 1e-300))


def _line(
    extruder: Extruder, steady_flow: float, slow_s: float, ramp_s: float, sample_time_s: float
) -> np.ndarray:
    """Returns the wanted flow (T,) of a line whose plateau lasts two time constants, with a rest of the same
    length before it."""
    rest = 2 * extruder.time_constant_s + ramp_s
    t = np.arange(round((3 * rest + 2 * slow_s) / sample_time_s)) * sample_time_s
    up, down = (
        ramp_of_gantry(t - event, ramp_s, slow_s) for event in (rest + slow_s / 2, 2 * rest + 1.5 * slow_s)
    )
    r = steady_flow * (up - down)
    return np.where(r > 1e-9 * steady_flow, r, 0.0)


def _same(hold: np.ndarray, ahead: np.ndarray) -> bool:
    """Returns whether the limits act on the begin of a piece as strongly as the piece before predicted. Later
    samples affect earlier ones in no other way."""
    n = min(8, hold.shape[1], ahead.shape[1])
    off = np.abs(hold[:, :n] - ahead[:, :n])
    return bool(off.max() <= JOINED * max(1.0, np.abs(hold[:, :n]).max()))


def _piece(
    s: np.ndarray,
    free: np.ndarray,
    below: np.ndarray,
    *,
    pole: float,
    bound: float,
    step: float,
    x: float,
    v: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Returns x (N,) nearest to s (N,), or to `below` if `free` and below s, that continues from the last x
    and v within the limits; and how strongly the limits act on v and on its change (2, N), in the unit of x.

    A primal-dual interior-point method on slack and multiplier of each limit (Wright 1997, Primal-Dual
    Interior-Point Methods). It needs half the iterations of the barrier method, each O(N) too.
    """
    most = np.array([[1 / bound], [1 / step]])  # a limit that there is not: 0
    # the start is within the limits: the command goes to 0 at half of the speed
    slow = min(step / 2, abs(v))
    command = math.copysign(1.0, v) * np.maximum(abs(v) - slow * np.arange(1, len(s) + 1), 0.0)
    z = scipy.signal.lfilter([1.0], [1.0, -pole], command, zi=[pole * x])[0]
    share = most * np.stack([command, np.diff(command, prepend=v)])
    slack = np.concatenate([1 - share, 1 + share])
    force, gap, aim = FIRST_GAP / slack, FIRST_GAP, AIM
    gone, nowhere = np.empty_like(slack), not free.any()
    for _ in range(MOST_STEPS):
        low = free & (z <= s)
        w = 1.0 if nowhere else np.where(low, 1e-3, 1.0)
        gradient = z - s if nowhere else w * (z - np.where(low, below, s))
        near = 1 / slack
        firm, pull = force * near, aim * gap * (near[:2] - near[2:]) * most
        firm = (firm[:2] + firm[2:]) * most**2
        gradient += _sent(pull[0] + _sent(pull[1], 1.0), pole)
        dz = -_solved(_band(w, firm, pole), gradient)
        dv = _change(dz, pole)
        dv = most * np.stack([dv, _change(dv, 1.0)])
        # shares of slack and force: what a step takes of the one and of the other
        np.multiply(dv, near[:2], out=gone[:2])
        np.multiply(-dv, near[2:], out=gone[2:])
        grown = aim * gap / (force * slack) - 1 + gone
        length = min(1.0, MOST_OF_WAY / max(gone.max(), -grown.min()))
        z += length * dz
        dv *= length
        slack[:2] -= dv
        slack[2:] += dv
        grown *= length
        force += force * grown
        gap = float(np.vdot(force, slack)) / slack.size
        if gap < LAST_GAP:
            break
        aim = min(max((1 - length) ** 2, AIM), 0.8)
    return z, (force[:2] - force[2:]) * most


def _change(z: np.ndarray, pole: float) -> np.ndarray:
    """Returns z(t) - pole z(t-1) (N,), from rest."""
    v = z.copy()
    v[1:] -= pole * z[:-1]
    return v


def _sent(y: np.ndarray, pole: float) -> np.ndarray:
    """Returns the transpose of `_change` applied to y (N,)."""
    z = y.copy()
    z[:-1] -= pole * y[1:]
    return z


def _band(w: np.ndarray | float, firm: np.ndarray, pole: float) -> np.ndarray:
    """Returns the lower bands (3, N) of diag(w) + A' (diag(firm[0]) + C' diag(firm[1]) C) A. C is the matrix
    of `_change` with pole 1 and A the one with `pole`; firm (2, N)."""
    a, band = pole, np.zeros((3, firm.shape[1]))
    still, next_ = firm[0] + firm[1], firm[1, 1:]
    still[:-1] += next_  # the inner bands: still, and -next_ beside it
    band[0] = still + w
    band[0, :-1] += a * (2 * next_ + a * still[1:])
    band[1, :-1] = -next_ - a * still[1:]
    band[1, :-2] -= a * a * next_[1:]
    band[2, :-2] = a * next_[1:]
    return band


def _solved(band: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """Returns Newton's step (N,) for the lower bands (B, N). If rounding makes them indefinite (poles near 1
    in a row), the diagonal is increased, which gives a shorter step of the same descent. Raises ValueError if
    that is not enough."""
    for share in (0.0, 1e-13, 1e-11, 1e-9):
        try:
            whole = np.vstack([band[:1] * (1 + share), band[1:]])
            return scipy.linalg.solveh_banded(whole, gradient, lower=True, check_finite=False)
        except np.linalg.LinAlgError:
            continue
    raise ValueError(
        "reachable: the limits of the drive leave the nearest flow undetermined; "
        "expected a time constant, an amplitude and a speed above 0"
    )
