"""Extruders of kinds that the chain of the deposition loop did not draw, and their training: what the chain
has no parameter for (trapped air, an ink that thins), several faults at once, or a plant that changes."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pipeline.deposition.drive import UNLIMITED
from pipeline.deposition.extruder import Extruder, routine
from pipeline.deposition.learning import ilc
from pipeline.deposition.parts.library import Training
from tests.foreign import extruders
from tests.foreign.extruders import STEP_S, ForeignExtruder

TS, AREA, NOZZLE, RAMP = 0.02, 0.304, 0.6, 0.15
MATERIALS = {"A": Extruder(1.08, 2.7), "B": Extruder(0.89, 4.5)}
SPEEDS, PAUSES = (8.0, 5.0), (0.6, 0.3)
UPDATES, STEADY = 12, AREA * SPEEDS[0]
INVERSE = ilc.InverseSettings(identify_trials=2, floor=0.1, order=4, cutoff_hz=5.0)
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
        return extruders.drawn(kind, rng, **nominal)
    plain = extruders.drawn("plain", rng, **nominal)
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
        return extruders.flow(extruder, u, sample_time_s=sample_time_s, trial=trial)
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


Plant = Callable[[np.ndarray, int], np.ndarray]


def plant_of(kind: str, rng: np.random.Generator, material: str) -> Plant:
    """True flow (T,) of a drawn plant under a command (T,) in the trial of that number."""
    nominal = MATERIALS[material]
    around = {"gain": nominal.gain, "time_constant_s": nominal.time_constant_s, "steady_flow": STEADY}
    other = drawn(kind, rng, **around)
    return lambda u, trial: flow(other, u, sample_time_s=TS, trial=trial)


class Machine:
    """Runs commands one after the other, and sees what comes out as a camera does."""

    def __init__(self, plant: Plant, rng: np.random.Generator, steady_flow: float):
        self.plant, self.rng, self.steady_flow, self.trials = plant, rng, steady_flow, 0

    def __call__(self, u: np.ndarray) -> ilc.Trial:
        y = self.plant(u, self.trials)
        self.trials += 1
        return ilc.Trial(u, extruders.seen(y, self.rng, steady_flow=self.steady_flow), y)


def train(plant: Plant, material: str, rng: np.random.Generator) -> list[Training]:
    """Trials of the four routines of params.expert.yaml, each from on-off control."""
    out = []
    for speed in SPEEDS:
        for pause_s in PAUSES:
            task = routine(
                off_s=4, on_s=14, pause_s=pause_s, tail_s=8, speed=speed, bead_area_mm2=AREA,
                ramp_s=RAMP, sample_time_s=TS,
            )  # fmt: skip
            law = ilc.InverseLaw(task.r, INVERSE, drive=UNLIMITED, sample_time_s=TS)
            u0 = task.r / MATERIALS[material].gain
            trials = ilc.learn(
                law, Machine(plant, rng, float(task.r.max())), u0, task.r, trials=UPDATES, rise=0.1
            )
            u, y = (np.array(rows) for rows in zip(*((t.u, t.y) for t in trials), strict=True))
            out.append(Training(material, NOZZLE, task, u, y))
    return out
