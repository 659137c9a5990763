"""The basis-function composer: a command for any wanted flow as a weighted sum of functions of it. The
weights and the advance follow from the identified chain."""

import math

import numpy as np
import scipy.ndimage
import scipy.signal

from pipeline.deposition import reachable
from pipeline.deposition.drive import UNLIMITED, Drive, demand, follows, obeyed
from pipeline.deposition.extruder import DAMPING, Extruder, ramp
from pipeline.deposition.parts.chain import IdentifiedExtruder, fronts

# the yield is loaded this long before the flow begins and kept through gaps of twice that: long against the
# lag, short against a pause between lines
LOAD_S = 0.25
# or, if the drive cannot follow that, over this many times as long: below the yield nothing flows
LOADS = (1, 2, 4, 8)
# dither: slow enough to pass a lag of a few Hz, fast enough that a time constant of
# seconds leaves some 0.1 % of the steady flow of it
DITHER_HZ = 2.5
# and it fades over some cycles: a play left off its middle by a stop would offset the next start
DITHER_S = 1.0
# the inverse of delay and lag is cut beyond these seconds, and frequencies at which the lag passes less than
# FLOOR of the power are not inverted
SPAN_S, FLOOR = 2.0, 1e-3


def boxed(x: np.ndarray, ramp_s: float, sample_time_s: float) -> np.ndarray:
    """Returns x (T,), constant from each sample to the next, after two moving averages of ramp_s, centred, at
    the samples. A step becomes extruder.ramp.

    Beyond its ends x counts as 0; the sum is kept.
    """
    n = math.ceil(ramp_s / sample_time_s)
    kernel = np.diff(ramp(np.arange(-n - 1, n + 2) * sample_time_s, ramp_s))
    return np.convolve(x, kernel)[n : n + len(x)]


def loaded(r: np.ndarray, margin_s: float, sample_time_s: float) -> np.ndarray:
    """Returns an on-indicator (T,): 1 while r > 0 and through gaps up to 2 margin_s, rising before and
    falling after within 2 margin_s."""
    n = max(1, round(margin_s / sample_time_s))
    near = scipy.ndimage.maximum_filter1d(
        (r > 1e-9 * r.max(initial=0.0)).astype(float), 2 * n + 1, mode="constant"
    )
    for origin in (0, (n + 1) % 2 * -1):  # two boxes of an even length lie half a sample to either side
        near = scipy.ndimage.uniform_filter1d(near, n, mode="constant", origin=origin)
    return np.clip(near, 0.0, 1.0)


def advance(extruder: Extruder | IdentifiedExtruder, sample_time_s: float) -> np.ndarray:
    """Returns the centred impulse response of conj(H) / (|H|^2 + FLOOR), scaled to gain 1, with H of delay
    and lags. It sends a signal as much earlier as the chain delays it."""
    half = round(SPAN_S / sample_time_s)
    impulse = np.zeros(4 * half)
    impulse[0] = 1.0
    H = np.fft.rfft(fronts([IdentifiedExtruder(*extruder)], impulse[None], sample_time_s)[0, 0])
    h = np.roll(np.fft.irfft(np.conj(H) / (np.abs(H) ** 2 + FLOOR), len(impulse)), half)[: 2 * half + 1]
    return h / h.sum()


def mean_lag_s(extruder: Extruder | IdentifiedExtruder) -> float:
    """Returns the mean delay in s of the lags: 2 zeta / w of the second-order one plus the second lag."""
    return DAMPING / (math.pi * extruder.lag_hz) + IdentifiedExtruder(*extruder).second_lag_s


def shift(extruder: Extruder | IdentifiedExtruder, sample_time_s: float) -> np.ndarray:
    """Returns the centred impulse response that sends a signal earlier by the delay and the mean delay of the
    lag, and never beyond its limits."""
    half = round(SPAN_S / sample_time_s)
    late = min((extruder.delay_s + mean_lag_s(extruder)) / sample_time_s, half - 1.0)
    h = np.zeros(2 * half + 1)
    whole = math.floor(late)
    h[half - whole - 1 : half - whole + 1] = late - whole, 1 - late + whole
    return h


def compose(
    extruder: Extruder | IdentifiedExtruder, r: np.ndarray, *, sample_time_s: float, drive: Drive = UNLIMITED
) -> np.ndarray:
    """Returns the command u (T,) in mm for the wanted flow r (T,) in mm^3/s, as functions of r and of the
    on-indicator p, with x = r + yield p:

        u(t) = advance * [ rate x'(t) + level x(t) + slow <x>(t) + play q(t) sin(2 pi f t) ]
        <x> = x / (sigma s + 1)

    The weights invert the chain, with c the creeping share:

        sigma = (1 - c) T + c tau
        rate = tau T / (sigma K)
        level = (tau + T - tau T / sigma) / (sigma K)
        level + slow = 1 / K

    Without creep rate = tau / K, level = 1 / K, slow = 0. With an exponent x is the pressed value that gives
    r. If flow falls with another time constant than it rises, tau is that of each sample's direction. It is
    computed in its exact discrete form. The dither is as wide as the play. It moves through the play from any
    position, so that its mean position is the command's (Zames and Shneydor 1976); q lets it fade after a
    stop.

    The yield is loaded over as long as the drive needs. If the drive still cannot follow u, the command with
    the nearest flow is returned: it starts early and catches up late. The limits for it are those that remain
    after the dither.
    """
    if not np.any(r > 0):
        return np.zeros(len(r))
    extruder = IdentifiedExtruder(*extruder)
    ahead, dithered = advance(extruder, sample_time_s), dither(extruder, r, sample_time_s)
    u = np.zeros(len(r))
    for times in LOADS if extruder.yield_ > 0 else LOADS[:1]:
        x = r + extruder.yield_ * loaded(r, times * LOAD_S, sample_time_s)
        v = _inverse(extruder, pressed_of(extruder, x), sample_time_s)
        u = scipy.signal.oaconvolve(v + dithered, ahead, "same")
        if follows(u, drive, sample_time_s=sample_time_s):
            return u
    x = r + extruder.yield_ * loaded(r, LOAD_S, sample_time_s)
    v = _inverse(extruder, pressed_of(extruder, x), sample_time_s)
    ahead = shift(extruder, sample_time_s)
    v = reached(extruder, v, r, _beside(dithered, ahead, drive, sample_time_s), sample_time_s)
    return obeyed(scipy.signal.oaconvolve(v + dithered, ahead, "same"), drive, sample_time_s=sample_time_s)


def dither(extruder: Extruder | IdentifiedExtruder, r: np.ndarray, sample_time_s: float) -> np.ndarray:
    """Returns q(t) sin(2 pi f t) (T,) in mm, as wide as the play; q fades after a stop."""
    fading = extruder.play * loaded(r, DITHER_S, sample_time_s)
    return fading * np.sin(2 * np.pi * DITHER_HZ * sample_time_s * np.arange(len(r)))


def _beside(dithered: np.ndarray, ahead: np.ndarray, drive: Drive, sample_time_s: float) -> Drive:
    """Returns the limits of the drive that remain beside the dither, sent ahead; never less than half of the
    drive's."""
    command_mm, speed = demand(scipy.signal.oaconvolve(dithered, ahead, "same"), sample_time_s=sample_time_s)
    return drive._replace(
        amplitude_mm=max(drive.amplitude_mm - command_mm, drive.amplitude_mm / 2),
        speed_mm_per_s=max(drive.speed_mm_per_s - speed, drive.speed_mm_per_s / 2),
    )


def pressed_of(extruder: IdentifiedExtruder, x: np.ndarray) -> np.ndarray:
    """Returns p (T,) in mm whose flow without yield is x (T,) >= 0: the inverse of `chain.flow_of`."""
    if extruder.exponent == 1.0:
        return x / extruder.gain
    full = extruder.gain * extruder.level
    return extruder.level * np.maximum(x / full, 0.0) ** (1 / extruder.exponent)


def _modes(extruder: IdentifiedExtruder, sample_time_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns share and pole of the fast and of the creeping mode. Each is m(t+1) = pole m(t) + share v(t),
    and p is their sum."""
    poles = np.exp(-sample_time_s / np.array([extruder.time_constant_s, extruder.creep_time_s]))
    return np.array([1 - extruder.creep_share, extruder.creep_share]) * (1 - poles), poles


def _inverse(extruder: IdentifiedExtruder, p: np.ndarray, sample_time_s: float) -> np.ndarray:
    """Returns v (T,), constant between samples, for which the sum of both modes is p at every next sample."""
    (g, h), (a, b) = _modes(extruder, sample_time_s)
    if extruder.fall_ratio == 1.0:
        v = scipy.signal.lfilter(np.convolve([1.0, -a], [1.0, -b]), [g + h, -g * b - h * a], p)
        return np.append(v[1:], p[-1])
    d, c = math.exp(-sample_time_s / (extruder.time_constant_s * extruder.fall_ratio)), extruder.creep_share
    fast = slow = 0.0
    out = []
    for wanted in [*p[1:].tolist(), float(p[-1])]:
        v = (wanted - (1 - c) * a * fast - b * c * slow) / (g + h)
        pole = a
        if v < fast:
            v = (wanted - (1 - c) * d * fast - b * c * slow) / ((1 - c) * (1 - d) + h)
            pole = d
        fast, slow = v + (fast - v) * pole, v + (slow - v) * b
        out.append(v)
    return np.array(out)


def reached(
    extruder: Extruder | IdentifiedExtruder, v: np.ndarray, r: np.ndarray, drive: Drive, sample_time_s: float
) -> np.ndarray:
    """Returns v (T,) that the drive can follow and whose fast mode is nearest to that of the unlimited v.
    Where no flow r (T,) is wanted, only what rises above the yield costs. Delay and lag act before v."""
    extruder = IdentifiedExtruder(*extruder)
    (share, creeping), (a, b) = _modes(extruder, sample_time_s)
    g, h = share * extruder.gain, creeping * extruder.gain
    fast, slow = (scipy.signal.lfilter([gain], [1.0, -pole], v) for gain, pole in ((g, a), (h, b)))
    still = extruder.gain * pressed_of(extruder, np.array(extruder.yield_))
    free = np.append(r[1:], 0.0) <= 0
    x = reachable.nearest(
        np.where(free, np.maximum(fast, still - slow), fast),
        free,
        pole=a,
        bound=g * drive.amplitude_mm,
        step=g * drive.speed_mm_per_s * sample_time_s,
        rest=fast,
    )
    return obeyed((x - a * np.append(0.0, x[:-1])) / g, drive, sample_time_s=sample_time_s)
