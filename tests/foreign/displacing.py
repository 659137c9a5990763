"""Extruders that displace volume: filament, auger, and a lead-screw syringe by speed or by place, and what
goes wrong with them; integrated in steps of 2 ms. Nothing here comes from pipeline.deposition."""

import math
from typing import NamedTuple

import numpy as np

STEP_S = 0.002
# kinds that repeat, and kinds that do not
STEADY_KINDS = ("filament", "auger", "syringe")
CHANGING_KINDS = ("drifting_viscosity", "free_phase", "random_waits")


class DisplacingExtruder(NamedTuple):
    """tau x' = w - q(x), q = level (max(x - yield, 0) / level)^exponent: what is pressed in and does not come
    out stays, as pressure x in mm^3/s; below 0 the nozzle is empty by as much.

    w = area v (1 + ripple sin(2 pi place / turn_mm + phase)) (1 - slip x / level), v the speed of the drive:
    it follows a commanded speed, or a commanded place, within speed_limit and acceleration, in steps of
    step_mm. `drift` is the share by which tau and slip grow from trial to trial; free_phase: each trial
    begins at a phase of its own; emptied: the nozzle has lost up to so much x before each trial.
    """

    kind: str
    area: float  # mm^3/s a mm/s
    tau_s: float
    delay_s: float
    level: float  # steady flow, mm^3/s
    speed_limit: float
    acceleration: float
    exponent: float = 1.0
    yield_: float = 0.0
    slip: float = 0.0
    ripple: float = 0.0
    turn_mm: float = 1.0
    phase: float = 0.0
    step_mm: float = 0.0
    drift: float = 0.0
    free_phase: bool = False
    emptied: float = 0.0


def drawn(
    kind: str, rng: np.random.Generator, *, gain: float, time_constant_s: float, steady_flow: float
) -> DisplacingExtruder:
    """One of `kind` around a nominal gain (mm^3/s a mm/s) and time constant."""
    side = rng.choice([-1.0, 1.0], 2)
    area, tau = np.array([gain, time_constant_s]) * (1 + side * rng.uniform(0.10, 0.30, 2))
    speed = steady_flow / area
    plain = DisplacingExtruder(
        kind, float(area), float(tau), float(rng.uniform(0.02, 0.12)), steady_flow,
        float(speed * rng.uniform(3, 8)), float(speed * rng.uniform(15, 60)),
    )  # fmt: skip
    a, b, c = rng.uniform(size=3).tolist()
    filament = {"exponent": 1 + 0.5 * a, "slip": 0.02 + 0.06 * b, "step_mm": 0.002 * speed * (1 + c)}
    auger = {
        "ripple": 0.03 + 0.07 * a, "turn_mm": speed * (0.8 + 1.5 * b), "slip": 0.02 + 0.08 * c,
        "phase": 2 * math.pi * float(rng.uniform()),
    }  # fmt: skip
    change = {
        "filament": filament,
        "auger": auger,
        "syringe": {"yield_": (0.05 + 0.15 * a) * steady_flow, "exponent": 1 + 0.5 * b},
        "drifting_viscosity": filament | {"drift": float(side[0]) * (0.005 + 0.015 * a)},
        "free_phase": auger | {"free_phase": True},
        "random_waits": filament | {"emptied": (0.1 + 0.3 * a) * steady_flow},
    }[kind]
    return plain._replace(**change)


def speed_obeyed(e: DisplacingExtruder, wanted: np.ndarray, step: float, *, place: bool) -> np.ndarray:
    """Speed (n,) of the drive in steps of `step` s, for a commanded speed (n,) or place (n,)."""
    v = at = told = 0.0
    out, most = np.empty(len(wanted)), e.acceleration * step
    for k, value in enumerate(wanted.tolist()):
        towards = (value - at) / 0.02 if place else value
        towards = min(max(towards, -e.speed_limit), e.speed_limit)
        v += min(max(towards - v, -most), most)
        at += step * v
        moved = v
        if e.step_mm:
            whole = e.step_mm * round(at / e.step_mm)
            moved, told = (whole - told) / step, whole
        out[k] = moved
    return out


def flow(
    e: DisplacingExtruder,
    command: np.ndarray,
    *,
    sample_time_s: float,
    trial: int = 0,
    rng: np.random.Generator | None = None,
    place: bool = False,
) -> np.ndarray:
    """True flow (T,) of trial number `trial`, each sample the mean over it, under the speed in mm/s or the
    place in mm, `command` (T,), held between samples (a place: linear between them); `rng` draws what does
    not repeat."""
    fine = max(1, round(sample_time_s / STEP_S))
    step, n = sample_time_s / fine, len(command) * fine
    held = np.repeat(np.asarray(command, float), fine)
    if place:
        held = np.interp(np.arange(1, n + 1) / fine, np.arange(len(command) + 1), np.append(0.0, command))
    v = speed_obeyed(e, held, step, place=place)
    late = round(e.delay_s / step)
    v = np.concatenate([np.zeros(late), v])[:n]
    grown = (1 + e.drift) ** trial
    phase = e.phase + (2 * math.pi * rng.uniform() if rng is not None and e.free_phase else 0.0)
    x = -e.emptied * rng.uniform() if rng is not None else 0.0
    rippled = e.area * v * (1 + e.ripple * np.sin(2 * math.pi * np.cumsum(v) * step / e.turn_mm + phase))
    tau, slip, out = e.tau_s * grown, e.slip * grown / e.level, np.empty(n)
    for k, w in enumerate(rippled.tolist()):
        over = x - e.yield_
        q = e.level * (over / e.level) ** e.exponent if over > 0 else 0.0
        x += step / tau * (w * (1 - slip * max(x, 0.0)) - q)
        out[k] = q
    return out.reshape(-1, fine).mean(axis=1)
