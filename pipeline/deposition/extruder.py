"""The extruder, from plunger command to flow: the nominal first-order model (Hoelzle 2009, eq. 1), the harder
chain that trials run on, random extruders of that kind, and the training routine."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import scipy.signal

from pipeline.deposition.drive import UNLIMITED, Drive, obeyed

# damping of the second-order lag: a position loop tuned without overshoot to speak of
DAMPING = 0.7
# off by these shares, either way: gain and time constant
MISMATCH = (0.10, 0.30)
DELAY_S, LAG_HZ = (0.050, 0.150), (3.0, 6.0)
# share of the steady command, share of the steady flow
PLAY, YIELD = (0.01, 0.04), (0.02, 0.10)


class Extruder(NamedTuple):
    """Plunger command u (mm) -> flow y (mm^3/s), in this order:

        the drive's limits and backlash
        transport delay
        lag: w^2 / (s^2 + 2 zeta w s + w^2)
        play: backlash of full width `play`, mm of command
        K ((1 - c) / (tau s + 1) + c / (T s + 1)), c the share of the gain that creeps with T
        yield dead band: y = max(x - yield, 0), mm^3/s

    `gain` K in mm^3/s per mm. The defaults are the nominal model (1): no delay, no lag, no play, no yield, no
    creep.
    """

    gain: float
    time_constant_s: float
    delay_s: float = 0.0
    lag_hz: float = math.inf
    play: float = 0.0
    yield_: float = 0.0
    creep_share: float = 0.0
    creep_time_s: float = 20.0


def to_json(extruder: Extruder) -> dict[str, float | None]:
    """Returns an extruder as JSON; no lag is null."""
    return {name: float(value) if np.isfinite(value) else None for name, value in extruder._asdict().items()}


def from_json(values: Mapping[str, float | None]) -> Extruder:
    """Returns the extruder that `to_json` wrote."""
    return Extruder(**{name: np.inf if value is None else value for name, value in values.items()})


class Routine(NamedTuple):
    """The training routine (Hoelzle 2009, section III). All arrays are (T,), one sample each `sample_time_s`.

    r is the wanted flow in mm^3/s, speed the gantry's in mm/s, position in mm along the line from the start
    of the trial. The gantry runs at the printing speed before the start and after the stop too, so that ooze
    there lies on the line and is visible. It halts in the pause. printing is True where r > 0. The ramps are
    centred on the events start_s, pause_s = (begin, end) and stop_s. number counts the training routines; the
    reference is 0.
    """

    time_s: np.ndarray
    r: np.ndarray
    speed: np.ndarray
    position: np.ndarray
    printing: np.ndarray
    start_s: float
    pause_s: tuple[float, float]
    stop_s: float
    number: int = 0

    @property
    def plan(self) -> dict[str, float]:
        """The values that distinguish this routine from others: its number, its speed in mm/s, and the times
        in s of off, on, pause and the final off."""
        end_s = len(self.time_s) * float(self.time_s[1])
        off_s, on_s, pause_s, _, tail_s = np.diff(
            [0.0, self.start_s, *self.pause_s, self.stop_s, end_s]
        ).round(9)
        return {
            "routine": self.number, "speed_mm_per_s": float(self.speed.max()), "off_s": float(off_s),
            "on_s": float(on_s), "pause_s": float(pause_s), "tail_s": float(tail_s),
        }  # fmt: skip


def ramp(t: np.ndarray, width_s: float) -> np.ndarray:
    """Returns the unit step at t = 0 after two moving averages of `width_s`: 0 before -width, 1 after width,
    slope 1 / width at 0."""
    s = np.clip(np.asarray(t, float) / width_s, -1.0, 1.0)
    return np.where(s < 0, (1 + s) ** 2 / 2, 1 - (1 - s) ** 2 / 2)


def ramp_of_gantry(t: np.ndarray, width_s: float, gantry_s: float) -> np.ndarray:
    """Returns `ramp` for a gantry that takes gantry_s from rest to its speed at constant acceleration: the
    mean of `ramp` over that time around t. If gantry_s is 0, this is `ramp` itself."""
    if gantry_s == 0:
        return ramp(t, width_s)
    early, late = (_ramp_sum(np.asarray(t, float) + half, width_s) for half in (-gantry_s / 2, gantry_s / 2))
    return np.clip((late - early) / gantry_s, 0.0, 1.0)


def _ramp_sum(t: np.ndarray, width_s: float) -> np.ndarray:
    """Returns the integral of `ramp` up to t, in s."""
    s = np.clip(t / width_s, -1.0, 1.0)
    return width_s * np.where(s < 0, (1 + s) ** 3 / 6, s + (1 - s) ** 3 / 6) + np.maximum(t - width_s, 0.0)


def routine(
    *,
    off_s: float,
    on_s: float,
    pause_s: float,
    tail_s: float,
    speed: float,
    bead_area_mm2: float,
    ramp_s: float,
    gantry_ramp_s: float = 0.0,
    sample_time_s: float,
) -> Routine:
    """Returns the routine off, on, pause, on, off, with r = bead area x speed while printing. `speed` in
    mm/s; the gantry reaches it in gantry_ramp_s at constant acceleration, and two boxes of `ramp_s` shape
    every change in addition.

    Raises ValueError if a ramp does not fit before the start or after the stop. If the ramps are longer than
    the pause, only a dip remains of it.
    """
    shortest, before = min(off_s, tail_s), ramp_s + gantry_ramp_s / 2
    if not (0 < ramp_s and 0 <= gantry_ramp_s and before <= shortest):
        raise ValueError(
            f"routine: expected a ramp above 0 s and at most {shortest:g} s, "
            f"the shorter of the phases before the start and after the stop, but found {before:g} s; "
            "shorten the ramp or lengthen them"
        )
    events = np.cumsum([off_s, on_s, pause_s, on_s])
    t = np.arange(round((events[-1] + tail_s) / sample_time_s)) * sample_time_s
    start, halt, go, stop = (ramp_of_gantry(t - event, ramp_s, gantry_ramp_s) for event in events)
    share = start - halt + go - stop
    moving = 1 - halt + go
    r = bead_area_mm2 * speed * np.where(share > 1e-12, share, 0.0)
    v = speed * np.where(moving > 1e-12, moving, 0.0)
    position = np.concatenate([[0.0], np.cumsum((v[1:] + v[:-1]) / 2 * sample_time_s)])
    return Routine(
        t, r, v, position, r > 0, float(events[0]), (float(events[1]), float(events[2])), float(events[3])
    )


def _lag_ramp(t: np.ndarray, lag_hz: float) -> np.ndarray:
    """Returns the response of the second-order lag to the unit ramp at times t (s), 0 before 0. It is the
    integral of the step response."""
    t = np.maximum(t, 0.0)
    if math.isinf(lag_hz):
        return t
    w = 2 * math.pi * lag_hz
    damped = w * math.sqrt(1 - DAMPING**2)
    swing = 2 * DAMPING / w * np.cos(damped * t) + (2 * DAMPING**2 - 1) / damped * np.sin(damped * t)
    return t - 2 * DAMPING / w + np.exp(-DAMPING * w * t) * swing


def lag_filter(delay_s: float, lag_hz: float, sample_time_s: float) -> tuple[int, np.ndarray, np.ndarray]:
    """Returns (whole samples of delay, numerator, denominator) of the delay and the lag, from an input
    constant between samples to the mean of the output over the sample.

    The pulse response is the second difference of the ramp response at n Ts - delay. Its denominator is
    known, so a few numerator coefficients describe all of it.
    """
    whole, fraction = divmod(delay_s / sample_time_s, 1.0)
    means = np.diff(_lag_ramp((np.arange(5) - fraction) * sample_time_s, lag_hz)) / sample_time_s
    denominator = np.array([1.0])
    if not math.isinf(lag_hz):
        w = 2 * math.pi * lag_hz * sample_time_s
        decay = math.exp(-DAMPING * w)
        denominator = np.array([1.0, -2 * decay * math.cos(w * math.sqrt(1 - DAMPING**2)), decay**2])
    return (
        int(whole),
        np.convolve(np.diff(means, prepend=0.0), denominator)[: len(denominator) + 1],
        denominator,
    )


def lagged(u: np.ndarray, delay_s: float, lag_hz: float, sample_time_s: float) -> np.ndarray:
    """Returns u (..., T), constant between samples, after the delay and the second-order lag, as its mean
    from each sample to the next. This is exact for any delay."""
    whole, numerator, denominator = lag_filter(delay_s, lag_hz, sample_time_s)
    late = np.zeros(u.shape)
    late[..., whole:] = u[..., : max(u.shape[-1] - whole, 0)]
    return scipy.signal.lfilter(numerator, denominator, late)


def backlash(x: np.ndarray, play: np.ndarray | float) -> np.ndarray:
    """Returns x (..., T) after play of full width `play` (...,) along the last axis: the output is constant
    until x differs from it by half the play. y(-1) = 0 and

        y(t) = min(max(y(t-1), x(t) - play/2), x(t) + play/2)

    Each step clips y to [x - play/2, x + play/2], and a sequence of clips is again a clip. So blocks of the
    time axis are computed side by side and then joined.
    """
    if not np.any(play):
        return x
    rows, length = math.prod(x.shape[:-1]), x.shape[-1]
    block = max(1, math.isqrt(length // 4) if rows < 64 else length)
    blocks = -(-length // block)
    padded = np.pad(x.reshape(rows, length), ((0, 0), (0, blocks * block - length)), mode="edge")
    half = np.repeat(np.broadcast_to(play, x.shape[:-1]).ravel() / 2, blocks)
    steps = np.ascontiguousarray(padded.reshape(rows * blocks, block).T)
    del padded
    low, high = np.full(rows * blocks, -np.inf), np.full(rows * blocks, np.inf)
    if blocks > 1:
        for step in steps:
            a, b = step - half, step + half  # np.clip takes twice as long
            low, high = np.minimum(np.maximum(low, a), b), np.minimum(np.maximum(high, a), b)
    start, y = np.zeros((rows, blocks)), np.zeros(rows)
    for k, (a, b) in enumerate(zip(low.reshape(rows, blocks).T, high.reshape(rows, blocks).T, strict=True)):
        start[:, k] = y
        y = np.minimum(np.maximum(y, a), b)
    y, out = start.ravel(), np.empty_like(steps)
    for step, row in zip(steps, out, strict=True):
        y = np.minimum(np.maximum(y, step - half), step + half, out=row)
    del steps, step
    return out.T.reshape(rows, blocks * block)[:, :length].reshape(x.shape)


def _modes(extruder: Extruder) -> list[tuple[float, float]]:
    """Returns (share of the gain, time constant) of the parallel first-order modes."""
    c = extruder.creep_share
    return [(1 - c, extruder.time_constant_s)] + ([(c, extruder.creep_time_s)] if c > 0 else [])


def pressed(
    extruder: Extruder, u: np.ndarray, *, sample_time_s: float, drive: Drive = UNLIMITED
) -> np.ndarray:
    """Returns x (..., T) in mm^3/s from rest: the flow that the command u (..., T) in mm would press out if
    the ink had no yield. Below the yield nothing comes out.

    u is constant between samples, and the drive follows it within its limits. The drive's backlash comes
    before delay and lag, in series with the extruder's own play. Each block takes its input as constant at
    its mean over the sample.
    """
    v = backlash(obeyed(u, drive, sample_time_s=sample_time_s), drive.backlash_mm)
    v = backlash(lagged(v, extruder.delay_s, extruder.lag_hz, sample_time_s), extruder.play)
    x = np.zeros(v.shape)
    for share, tau in _modes(extruder):
        a = math.exp(-sample_time_s / tau)
        x += scipy.signal.lfilter([0.0, extruder.gain * share * (1 - a)], [1.0, -a], v)
    return x


def flow(extruder: Extruder, u: np.ndarray, *, sample_time_s: float, drive: Drive = UNLIMITED) -> np.ndarray:
    """Returns the true flow y = max(x - yield, 0) (T,) in mm^3/s for the command u (T,) in mm from rest, as
    the drive follows it; x as in `pressed`."""
    return np.maximum(pressed(extruder, u, sample_time_s=sample_time_s, drive=drive) - extruder.yield_, 0.0)


def frequency_response(extruder: Extruder, frequency_hz: np.ndarray, *, sample_time_s: float) -> np.ndarray:
    """Returns P(e^(j 2 pi f Ts)) (F,) from samples of u to samples of x: delay, lag and first order, exactly
    as in `pressed`, without play and yield."""
    z = np.exp(-2j * np.pi * np.asarray(frequency_hz, float) * sample_time_s)
    whole, numerator, denominator = lag_filter(extruder.delay_s, extruder.lag_hz, sample_time_s)
    P = z**whole * np.polyval(numerator[::-1], z) / np.polyval(denominator[::-1], z)
    slow = [(share, math.exp(-sample_time_s / tau)) for share, tau in _modes(extruder)]
    return P * extruder.gain * sum(share * (1 - a) * z / (1 - a * z) for share, a in slow)


def disturb(
    flow: np.ndarray, rng: np.random.Generator, *, steady_flow: float, white: float, drift: float, gain: float
) -> np.ndarray:
    """Returns the measured flow (T,): the true flow plus disturbances that do not repeat from trial to trial,
    as shares of `steady_flow` (mm^3/s).

        (1 + gain w) y + steady_flow (drift walk + white v)

    w is drawn once per trial, v at each sample; walk is a random walk, and the r.m.s. of drift walk over the
    trial is `drift`.
    """
    steps = len(flow)
    walk = np.cumsum(rng.standard_normal(steps)) * math.sqrt(2 / steps)
    noise = drift * walk + white * rng.standard_normal(steps)
    return (1 + gain * rng.standard_normal()) * flow + steady_flow * noise


def draw(
    rng: np.random.Generator,
    *,
    gain: float,
    time_constant_s: float,
    steady_flow: float,
    creep_share: float = 0.0,
) -> Extruder:
    """Returns a random extruder around nominal gain (mm^3/s per mm) and time constant: each is off by 10-30
    %, up or down, and it has delay, lag, play and yield, which (1) leaves out; creep as given."""
    off = [1 + rng.choice([-1, 1]) * rng.uniform(*MISMATCH) for _ in range(2)]
    K = float(gain * off[0])
    return Extruder(
        gain=K,
        time_constant_s=float(time_constant_s * off[1]),
        delay_s=rng.uniform(*DELAY_S),
        lag_hz=rng.uniform(*LAG_HZ),
        play=float(rng.uniform(*PLAY) * steady_flow / K),
        yield_=float(rng.uniform(*YIELD) * steady_flow),
        creep_share=creep_share,
    )
