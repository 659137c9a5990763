"""Extruders of other kinds than the project's chain, integrated in steps of 2 ms, with a camera's noise: what
the deposition loop is judged on. Nothing here comes from pipeline.deposition, so that no structure is shared.

Each kind has one thing that the chain's linear core has not, beside a gain and a time constant that are
10-30 % off what is known beforehand and a delay of 20-120 ms. Plunger displacement u in mm, flow in mm^3/s.
"""

import math
from typing import NamedTuple

import numpy as np

STEP_S = 0.002
# kinds whose law stays the same from trial to trial, and kinds that change
STATIC = ("plain", "up_down", "exponent", "third_order", "creep", "yield", "late", "sticky")
CHANGING = ("gain_step", "gain_drift")


class ForeignExtruder(NamedTuple):
    """tau dp/dt = u(t - delay) - p, tau_up_s where p rises and tau_down_s where it falls; further lags in a
    row (s); a share creep of p follows with creep_s; the plunger's seal holds until u has moved by stick_mm;
    flow = gain level (p / level)^exponent less the yield (mm^3/s), smooth at zero over `soft` mm^3/s; `level`
    mm is the steady command. From trial step_at on the gain is (1 + step) times as large, and every trial
    (1 + drift) times that of the one before."""

    kind: str
    gain: float
    tau_up_s: float
    tau_down_s: float
    delay_s: float
    level: float
    lags_s: tuple[float, ...] = ()
    creep: float = 0.0
    creep_s: float = 20.0
    stick_mm: float = 0.0
    exponent: float = 1.0
    yield_: float = 0.0
    soft: float = 1e-3
    step_at: int = 10
    step: float = 0.0
    drift: float = 0.0


def drawn(
    kind: str, rng: np.random.Generator, *, gain: float, time_constant_s: float, steady_flow: float
) -> ForeignExtruder:
    """One of `kind` around a nominal gain (mm^3/s per mm) and time constant."""
    side = rng.choice([-1.0, 1.0], 3)
    off = 1 + side[:2] * rng.uniform(0.10, 0.30, 2)
    K, tau = gain * off[0], time_constant_s * off[1]
    plain = ForeignExtruder(kind, K, tau, tau, float(rng.uniform(0.02, 0.12)), steady_flow / K)
    share = float(rng.uniform())
    change = {
        "plain": {},
        "up_down": {"tau_down_s": tau * (1 + side[2] * 0.15)},
        "exponent": {"exponent": 0.8 + 0.5 * share},
        "third_order": {"lags_s": (0.05 + 0.05 * share, 0.15 + 0.1 * share)},
        "creep": {"creep": 0.12, "creep_s": 15 + 10 * share},
        "yield": {"yield_": (0.05 + 0.10 * share) * steady_flow, "soft": 0.02 * steady_flow},
        "late": {"delay_s": 0.12 + 0.13 * share},
        "sticky": {"stick_mm": (0.01 + 0.03 * share) * plain.level},
        "gain_step": {"step": 0.2 * side[2]},
        "gain_drift": {"drift": 0.01 * side[2]},
    }[kind]
    return plain._replace(**change)


def flow(extruder: ForeignExtruder, u: np.ndarray, *, sample_time_s: float, trial: int = 0) -> np.ndarray:
    """True flow (T,) of trial number `trial`, each sample the mean over it, under u (T,) held between
    samples, from rest."""
    e, fine = extruder, max(1, round(sample_time_s / STEP_S))
    step = sample_time_s / fine
    held = np.repeat(np.asarray(u, float), fine)
    late = round(e.delay_s / step)
    held = np.concatenate([np.zeros(late), held])[: len(held)]
    lags = [0.0] * len(e.lags_s)
    shares = [1 - math.exp(-step / tau) for tau in e.lags_s]
    up, down, slow = (1 - math.exp(-step / tau) for tau in (e.tau_up_s, e.tau_down_s, e.creep_s))
    stuck = p = crept = 0.0
    out = np.empty(len(held))
    for k, value in enumerate(held.tolist()):
        if abs(value - stuck) > e.stick_mm:
            stuck = value - math.copysign(e.stick_mm, value - stuck)
        moved = stuck
        for i, share in enumerate(shares):
            lags[i] += share * (moved - lags[i])
            moved = lags[i]
        p += (up if moved > p else down) * (moved - p)
        crept += slow * (moved - crept)
        out[k] = (1 - e.creep) * p + e.creep * crept
    gain = e.gain * (1 + e.step * (trial >= e.step_at)) * (1 + e.drift) ** trial
    x = gain * e.level * np.sign(out) * np.abs(out / e.level) ** e.exponent - e.yield_
    softly = (x + np.sqrt(x**2 + e.soft**2)) / 2 - (math.hypot(e.yield_, e.soft) - e.yield_) / 2
    return np.maximum(softly, 0.0).reshape(-1, fine).mean(axis=1)


def seen(
    truth: np.ndarray,
    rng: np.random.Generator,
    *,
    steady_flow: float,
    white: float = 0.03,
    walk: float = 0.01,
    gain: float = 0.01,
) -> np.ndarray:
    """What a camera reads of a true flow (T,): white noise, a wandering offset and the scale of one trial, as
    shares of the steady flow."""
    n = len(truth)
    wander = np.cumsum(rng.standard_normal(n)) / math.sqrt(n)
    noise = white * rng.standard_normal(n) + walk * wander
    return truth * (1 + gain * rng.standard_normal()) + steady_flow * noise * (truth > 0)
