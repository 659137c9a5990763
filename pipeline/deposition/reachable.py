"""The nearest flow that a drive of limited travel and speed can reach, and the ramp of the gantry from which
on little is lost to it."""

import functools
import math
from collections.abc import Sequence

import numpy as np
import scipy.linalg
import scipy.signal

from pipeline.deposition.drive import Drive
from pipeline.deposition.extruder import Extruder, ramp_of_gantry

# sum_k taps[k](t) z(t-k) from rest: each tap one number, or (N,) where it changes with time
Taps = Sequence[float | np.ndarray]
# a drive follows where it adds at most this share of on-off control's error to that of the unlimited command
LOSS = 0.02
# of Newton's method at one barrier: 12 were too few for a limit of twice the steady command, and left 25 %
# more error than there need be
MOST_STEPS = 50


def nearest(
    target: np.ndarray,
    free: np.ndarray,
    *,
    pole: float,
    bound: float,
    step: float = math.inf,
    rest: np.ndarray | None = None,
) -> np.ndarray:
    """x (N,) from rest that is nearest to `target` (N,) among all with |v(t)| <= bound and |v(t) - v(t-1)| <=
    step, v(t) = x(t) - pole x(t-1): all that a first-order extruder can press.

    Where `free` (N,) is True only what lies above the target costs (no-flow: below the yield all is well),
    and below it x settles at `rest` (N,), the target where none is given. x, bound and step in mm^3/s: K (1 -
    pole) times the amplitude, and times the speed and the sample time.
    """
    if not (math.isfinite(bound) or math.isfinite(step)):
        return np.array(target, float)
    return nearest_response(
        target, free, output=(1.0,), command=(1.0, -pole), bound=bound, step=step, rest=rest
    )


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
    """The shortest time in s, 0 or more, in which the gantry speeds up and slows down such that the drive
    loses at most LOSS on a line; inf where none up to longest_s does.

    The flow is bead area x speed: it follows the gantry's ramp up to `steady_flow` in mm^3/s and down again,
    shaped by two boxes of ramp_s. Lost is the r.m.s. error of the nearest flow within amplitude and speed, as
    share of that of on-off control r / K without limits; the unlimited command has none. The yield is loaded
    before, over as long as it takes, and costs nothing. Delay, lag and creep are left out. Bisected to 1 %.
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


def flow(extruder: Extruder, r: np.ndarray, drive: Drive, sample_time_s: float) -> np.ndarray:
    """The flow (T,) in mm^3/s nearest to r (T,) that the drive lets the extruder's gain, time constant and
    yield press out; its delay and lag, which a command can be sent ahead of, its play and creep are left
    out (a lag overshoots its input by 5 %, so that a percent more may be in reach)."""
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
    """r.m.s. error of the nearest flow to r (T,) in mm^3/s that the drive allows, as share of that of on-off
    control r / K without limits."""
    a = math.exp(-sample_time_s / extruder.time_constant_s)
    on_off = np.linalg.norm(scipy.signal.lfilter([0.0, 1 - a], [1.0, -a], r) - r)
    least = np.linalg.norm(flow(extruder, r, drive, sample_time_s) - r)
    return float(least / max(on_off, 1e-300))


def _line(
    extruder: Extruder, steady_flow: float, slow_s: float, ramp_s: float, sample_time_s: float
) -> np.ndarray:
    """Wanted flow (T,) of a line whose plateau lasts two time constants, at rest for as long before it."""
    rest = 2 * extruder.time_constant_s + ramp_s
    t = np.arange(round((3 * rest + 2 * slow_s) / sample_time_s)) * sample_time_s
    up, down = (
        ramp_of_gantry(t - event, ramp_s, slow_s) for event in (rest + slow_s / 2, 2 * rest + 1.5 * slow_s)
    )
    r = steady_flow * (up - down)
    return np.where(r > 1e-9 * steady_flow, r, 0.0)


def nearest_response(
    target: np.ndarray,
    free: np.ndarray,
    *,
    output: Taps,
    command: Taps,
    bound: float,
    step: float = math.inf,
    weight: np.ndarray | float = 1.0,
    rest: np.ndarray | None = None,
) -> np.ndarray:
    """z (N,) from rest whose output y = B z is nearest to `target` (N,) among all whose command v = A z keeps
    |v(t)| <= bound and |v(t) - v(t-1)| <= step; A and B are the taps `command` and `output`.

    At least one limit is finite. y = A^-1 B v is any linear extruder of finite order, without the inverse: A
    and B are banded, and so is the Hessian of Newton's method on a log barrier (Boyd and Vandenberghe 2004,
    ch. 11): an iteration is O(N). Where `free` (N,) is True only what lies above the target costs, and below
    it a trace of weight draws y to `rest`, or to the target; `weight` (N,) of the squares.
    """
    limits = [(command, bound), (_changes(command), step)]
    limits = [(taps, most) for taps, most in limits if math.isfinite(most)]
    N = len(target)
    # the unit of z: of the size that the nearer limit leaves it
    still = abs(float(np.mean(sum(command))))
    c = min(bound / float(np.mean(command[0])), step / max(still, 1e-300))
    within = [(taps, most / c) for taps, most in limits]
    bands = max(len(output), *(len(taps) for taps, _ in within))
    s, z, barrier = target / c, np.zeros(N), 1.0
    below = s if rest is None else rest / c
    while barrier > 1e-7:
        for _ in range(MOST_STEPS):
            # a trace of weight below the target keeps z determined there
            y = _of(z, output)
            counts = ~free | (y > s)
            w = weight * np.where(counts, 1.0, 1e-3)
            gradient, band = _back(w * (y - np.where(counts, s, below)), output), np.zeros((bands, N))
            _add_squares(band, np.broadcast_to(w, N), output)
            for taps, most in within:
                v = _of(z, taps) / most
                slack = 1 - v * v
                gradient += _back(2 * barrier * v / slack / most, taps)
                _add_squares(band, 2 * barrier * (1 + v * v) / slack**2 / most**2, taps)
            dz = -_solved(band, gradient)
            # every bound holds: at most 0.95 of the way to the nearest
            reach = max(_reach(_of(z, taps) / most, _of(dz, taps) / most) for taps, most in within)
            length = min(1.0, 0.95 / max(reach, 1e-300))
            z = z + length * dz
            if length == 1.0 and gradient @ -dz < 1e-3 * N * barrier:
                break
        barrier *= 0.1
    return c * z


def _solved(band: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """Newton's step (N,) of the lower bands (B, N); a larger diagonal where rounding makes them indefinite
    (poles near 1 in a row): a shorter step of the same descent."""
    for share in (0.0, 1e-13, 1e-11, 1e-9):
        try:
            whole = np.vstack([band[:1] * (1 + share), band[1:]])
            return scipy.linalg.solveh_banded(whole, gradient, lower=True, check_finite=False)
        except np.linalg.LinAlgError:
            continue
    raise ValueError(
        "reachable: the taps of output and command leave the response undetermined; "
        "expected poles inside the unit circle"
    )


def _changes(taps: Taps) -> Taps:
    """The taps of v(t) - v(t-1), v those of `taps`."""
    late = [np.append(0.0, tap[:-1]) if isinstance(tap, np.ndarray) else tap for tap in taps]
    return [taps[0], *(tap - before for tap, before in zip(taps[1:], late, strict=False)), -late[-1]]


def _of(z: np.ndarray, taps: Taps) -> np.ndarray:
    """sum_k taps[k] z(t-k) (N,), from rest."""
    v = taps[0] * z
    for k, tap in enumerate(taps[1:], 1):
        v[k:] += _from(tap, k) * z[:-k]
    return v


def _from(tap: float | np.ndarray, k: int) -> float | np.ndarray:
    return tap[k:] if isinstance(tap, np.ndarray) else tap


def _back(y: np.ndarray, taps: Taps) -> np.ndarray:
    """The transpose of `_of` on y (N,)."""
    z = taps[0] * y
    for k, tap in enumerate(taps[1:], 1):
        z[:-k] += _from(tap, k) * y[k:]
    return z


def _add_squares(band: np.ndarray, h: np.ndarray, taps: Taps) -> None:
    """Adds D' diag(h) D to the lower bands (B, N), D the matrix of `_of`; h (N,)."""
    N = len(h)
    for i, first in enumerate(taps):
        for k in range(i + 1):
            # row t of D holds taps[i] in column t - i and taps[k] in column t - k
            band[i - k, : N - i] += _from(first, i) * _from(taps[k], i) * h[i:]


def _reach(v: np.ndarray, dv: np.ndarray) -> float:
    """How far a step dv (N,) goes towards the nearer of the bounds +-1 of v (N,), as a share of the way."""
    return float(np.max(np.maximum(dv / (1 - v), -dv / (1 + v))))
