"""Parts composed for, and forecast on, extruders of kinds that the chain did not draw."""

import math
from typing import NamedTuple

import numpy as np

from benchmarks import foreign_extruders as foreign
from benchmarks.foreign_extruders import STEP_S, ForeignExtruder

# kinds with more than one fault at once, and kinds whose law the chain has no parameter for
OUTSIDE = ("mixed", "compressible", "thixotropic")


class Outsider(NamedTuple):
    """A plain extruder whose time constant is (1 + compressible (1 - |p| / level)) times as long while little
    is pressed, as trapped air makes it, and whose gain is (1 + thixotropic (1 - s)) times as large: s, the
    ink's structure, is broken down by flow within 1 s and builds up within rest_s."""

    plain: ForeignExtruder
    compressible: float = 0.0
    thixotropic: float = 0.0
    rest_s: float = 6.0


def drawn(
    kind: str, rng: np.random.Generator, *, gain: float, time_constant_s: float, steady_flow: float
) -> ForeignExtruder | Outsider:
    """One of `kind` around a nominal gain (mm^3/s per mm) and time constant."""
    nominal = {"gain": gain, "time_constant_s": time_constant_s, "steady_flow": steady_flow}
    if kind not in OUTSIDE:
        return foreign.drawn(kind, rng, **nominal)
    plain = foreign.drawn("plain", rng, **nominal)
    share, side = float(rng.uniform()), float(rng.choice([-1.0, 1.0]))
    if kind == "mixed":
        return plain._replace(
            kind=kind, tau_down_s=plain.tau_up_s * (1 + 0.1 * side), lags_s=(0.05, 0.1 + 0.1 * share),
            creep=0.06, exponent=0.85 + 0.3 * share, yield_=0.05 * steady_flow, soft=0.02 * steady_flow,
        )  # fmt: skip
    if kind == "compressible":
        return Outsider(plain, compressible=0.15 + 0.25 * share)
    return Outsider(plain, thixotropic=0.1 + 0.2 * share)


def flow(
    extruder: ForeignExtruder | Outsider, u: np.ndarray, *, sample_time_s: float, trial: int
) -> np.ndarray:
    """True flow (T,) in mm^3/s of trial number `trial` under u (T,) in mm, held between samples."""
    if isinstance(extruder, ForeignExtruder):
        return foreign.flow(extruder, u, sample_time_s=sample_time_s, trial=trial)
    e, fine = extruder.plain, max(1, round(sample_time_s / STEP_S))
    step = sample_time_s / fine
    late = round(e.delay_s / step)
    held = np.repeat(np.asarray(u, float), fine)
    held = np.concatenate([np.zeros(late), held])[: len(held)]
    p, structure, out = 0.0, 1.0, np.empty(len(held))
    for k, value in enumerate(held.tolist()):
        tau = e.tau_up_s * (1 + extruder.compressible * max(1 - abs(p) / e.level, 0.0))
        p += step / tau * (value - p)
        broken = min(abs(p) / e.level, 2.0)
        structure += step * ((1 - structure) / extruder.rest_s - broken * structure)
        out[k] = max(e.gain * p * (1 + extruder.thixotropic * (0.5 - structure)), 0.0)
    return out.reshape(-1, fine).mean(axis=1)
