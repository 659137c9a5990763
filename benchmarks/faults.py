"""Does the supervisor see each fault in time, name it, and keep quiet where nothing is wrong?

`./run python -m benchmarks.faults` writes benchmarks/results/faults.json, machine by machine. Every kind of
fault is played 50 times on the study's machine (the panel's 60 plants, with their noise) and on machines
written apart from `Plant`: a hot end of one heater and one sensor, and one of two zones, with radiation, a
fan, dead time, a sensor's lag and a converter's steps; their models are identified from a record as a user's
would be. Then 200 hours without a fault (120 on the study's machine): references that change, disturbances of
the allowed size. `--cases 5 --hours 2` plays fewer, `--machines study` only these.

A fault is seen in time where a safe mode is asked for within 10 samples of the moment the innovation first
passes 5 deviations of an honest one; a slow kind before its zone errs by 5 degC from what it would do without
the fault. `right` counts the first cause named, 10 samples after the safe mode; `said` those too where the
cause is the one that the sentence names beside it. Cases whose fault shows nowhere (a heater that is off
while it is told nothing) are `silent`, and counted apart; `unseen` are those for which no safe mode was asked
although the zone erred by 5 degC.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import joblib
import numpy as np

from pipeline.runtime import supervisor
from pipeline.runtime.machine import Exported, Machine, Signal
from pipeline.store import params
from pipeline.temperature import baseline, controller, governor
from pipeline.temperature import plant as plants
from pipeline.temperature.plant import Plant, strictly_proper
from pipeline.temperature.workflow import cases, evaluate_temperature, learned, settings
from tests.temperature.small_machines import identified_record

RESULTS = Path(__file__).parent / "results" / "faults.json"
SIGMA, WITHIN, ZONE_DEGC = 5.0, 10, 5.0
SLOW_KINDS = ("sensor_slow", "heater_weak", "sensor_drift")
# what is named for a fault that is played: its kind, first, and what shows the same
SAME = {"sensor_drift": ("sensor_offset",), "command_read_back": ("command_not_applied",)}
# what one record cannot tell apart, as the sentence of the cause that is named says
SAID = {
    ("sensor_drift", "heater_weak"),  # "or its zone loses as much more heat than the model knows"
    ("heater_weak", "sensor_offset"),  # "or its zone gains or loses heat that no input explains"
    ("heater_stuck_off", "sensor_offset"),
    ("command_not_applied", "heater_stuck_on"),  # "or goes on with an older command"
    ("command_not_applied", "heater_stuck_off"),
    ("command_not_applied", "heater_weak"),
    ("sensor_drift", "heater_stuck_off"),
    ("model_no_longer_right", "sensor_offset"),
    ("model_no_longer_right", "heater_weak"),
    ("model_no_longer_right", "sensor_slow"),  # "or its zone has become slower"
}
FAULTS = (
    "thermal_runaway",
    "sensor_frozen",
    "sensor_nan",
    "out_of_range",
    "sensor_noisy",
    "sensor_slow",
    "sensor_offset",
    "sensor_drift",
    "heater_stuck_on",
    "heater_stuck_off",
    "heater_weak",
    "deadline_missed",
    "clock_jump",
    "command_not_applied",
    "command_read_back",
    "model_no_longer_right",
    "reference_out_of_reach",
)


class Simulated:
    """A machine that runs: `measured` its true outputs in degC, `advance` one sample with inputs in percent;
    `spoil` makes it another machine, `disturb` changes its surroundings by the allowed size."""

    def __init__(self, noise_degC: float, step_degC: float):
        self.noise_degC, self.step_degC = noise_degC, step_degC

    def outputs(self) -> np.ndarray:
        raise NotImplementedError

    def read(self, rng: np.random.Generator) -> np.ndarray:
        y = self.outputs()
        return y + self.noise_degC * rng.standard_normal(len(y))


class Linear(Simulated):
    """A plant of the panel, held at rest by u (m,) from x (n,)."""

    def __init__(self, plant: Plant, x: np.ndarray, u: np.ndarray):
        super().__init__(0.1, 0.0)
        self.plant, self.x, self.u = plant, x.copy(), u.copy()
        self.ambient = np.zeros(plant.n)

    def outputs(self) -> np.ndarray:
        return self.plant.C @ self.x + self.plant.d

    def advance(self, u: np.ndarray) -> None:
        self.x = self.plant.A @ self.x + self.plant.B @ u + self.plant.b + self.ambient

    def spoil(self, rng: np.random.Generator) -> None:
        """Every heater acts as another one would."""
        gains = rng.choice([0.45, 0.55, 1.6, 1.8], self.plant.m)
        self.plant = self.plant._replace(B=self.plant.B * gains, A=_regained(self.plant, gains))

    def disturb(self, rng: np.random.Generator) -> None:
        """The room gets warmer or colder by up to 8 degC, within 8 degC of what it was at first; 0.8 % of
        that a step reach each zone."""
        n, before = self.plant.n - self.plant.m, self.ambient[0] / 0.008
        room = np.clip(before + rng.uniform(-8, 8), -8, 8)
        self.ambient = np.r_[np.full(n, 0.008 * room), np.zeros(self.plant.m)]


def _regained(plant: Plant, gains: np.ndarray) -> np.ndarray:
    """A of a plant with a sample of delay, whose late inputs stand in A."""
    A, n = plant.A.copy(), plant.n - plant.m
    A[:n, n:] *= gains
    A[n:, n:] = 0.0
    return A


class HotParts(NamedTuple):
    """Zones (z,): capacity J/K, loss W/K, radiates W/K^4, power W at full duty, between W/K to the next one,
    lag_s of the sensor, delay_s of the heat to it, noise and step of the converter in degC."""

    capacity: tuple[float, ...]
    loss: tuple[float, ...]
    radiates: tuple[float, ...]
    power: tuple[float, ...]
    between: float
    lag_s: float
    delay_s: float
    noise_degC: float
    step_degC: float
    sample_time_s: float
    reference: tuple[float, ...]


HOT_END = HotParts((14.0,), (0.11,), (6e-11,), (40.0,), 0.0, 1.2, 0.9, 0.06, 0.05, 0.3, (205.0,))
TWO_ZONES = HotParts(
    (30.0, 22.0), (0.14, 0.11), (7e-11, 6e-11), (60.0, 45.0), 0.25, 1.5, 1.2, 0.08, 0.06, 1.0, (190.0, 215.0)
)
KELVIN, ROOM, SUBSTEP_S = 273.15, 22.0, 0.3


class HotEnd(Simulated):
    """Heat in watts, Euler's method in steps of 0.3 s at most."""

    def __init__(self, parts: HotParts, rng: np.random.Generator | None):
        super().__init__(parts.noise_degC, parts.step_degC)
        self.parts, z = parts, len(parts.capacity)
        differs = (lambda by: 1 + by * rng.uniform(-1, 1, z)) if rng is not None else (lambda by: np.ones(z))
        self.capacity, self.loss = parts.capacity * differs(0.05), parts.loss * differs(0.1)
        self.power, self.radiates = parts.power * differs(0.05), np.array(parts.radiates)
        self.mass, self.sensor = np.full(z, ROOM), np.full(z, ROOM)
        self.count = int(np.ceil(parts.sample_time_s / SUBSTEP_S - 1e-9))
        self.dt = parts.sample_time_s / self.count
        self.way = [np.full(z, ROOM)] * (1 + round(parts.delay_s / self.dt))
        self.fan, self.room = 0.0, ROOM

    def outputs(self) -> np.ndarray:
        return self.sensor.copy()

    def read(self, rng: np.random.Generator) -> np.ndarray:
        return np.round(super().read(rng) / self.step_degC) * self.step_degC

    def advance(self, u: np.ndarray) -> None:
        p, dt = self.parts, self.dt
        room = self.radiates * (self.room + KELVIN) ** 4
        for _ in range(self.count):
            heat = self.power * u / 100 - (self.loss + self.fan) * (self.mass - self.room)
            heat += room - self.radiates * (self.mass + KELVIN) ** 4
            if len(u) > 1:
                heat += p.between * (self.mass[::-1] - self.mass)
            self.mass = self.mass + dt * heat / self.capacity
            self.sensor = self.sensor + dt * (self.way[-1] - self.sensor) / p.lag_s
            self.way = [self.mass, *self.way[:-1]]

    def spoil(self, rng: np.random.Generator) -> None:
        """Another block and another cartridge: half the mass, twice the power."""
        self.capacity, self.power = 0.5 * self.capacity, 1.9 * self.power

    def disturb(self, rng: np.random.Generator) -> None:
        """Fan, melt and room: up to 8 % more heat lost, up to 4 degC of room."""
        self.fan = 0.08 * float(self.loss.mean()) * rng.uniform(0, 1)
        self.room = ROOM + rng.uniform(-4, 4)


class Rig(NamedTuple):
    """A machine with its exported controller: `begin` makes one of its plants, with the inputs that hold it;
    reference (p,) in degC; its
    share of the quiet hours."""

    name: str
    exported: Exported
    reference: np.ndarray
    begin: Callable[[np.random.Generator], tuple[Simulated, np.ndarray]]
    change_degC: float
    share: float


def study(contestant: str = "subspace_lqg") -> Rig:
    """The study's machine under a contestant as it was judged, from what the stages left in datasets/."""
    machine = params.load(settings.Plant, "plant")
    tracking = params.load(settings.Tracking, "tracking")
    pan, tuning = params.load(settings.Panel, "panel"), params.load(settings.TuneWeights, "tune_weights")
    made = learned.read_learned(
        "datasets/identify_plant/plant.parquet",
        "datasets/identify_plant/spread.parquet",
        "datasets/learn_kernel",
        "datasets/ingest/printer_pid.json",
        machine,
    )
    truth = plants.baam()._replace(sample_time_s=machine.sample_time_s)
    rehearsal = cases.rehearsed(pan, machine, truth, [made.model, *made.spread], "")
    setting = cases.shared(tuning, machine, tracking, pan, rehearsal, [made.model, *made.spread])
    problem = learned.problem(made, tracking, setting, truth)
    weights = evaluate_temperature.read_weights("datasets/tune_weights/weights.json", machine)
    designs = evaluate_temperature.designed(problem, weights)[0]
    wired = Machine(
        tuple(Signal(i.name, "percent", i.low, i.high) for i in machine.inputs),
        tuple(Signal(o.name, "degC", *_limits(o)) for o in machine.outputs),
        machine.sample_time_s,
    )
    exported = Exported(
        contestant,
        wired,
        cases.as_deployed(designs[contestant], setting),
        designs[contestant].model,
        cases.as_deployed(designs["pi_simc"], setting),
        supervisor.supervision(made.model, problem.family, wired, rehearsal.noise),
        True,
        "",
        "",
    )
    asked = rehearsal.judging

    def begin(rng: np.random.Generator) -> tuple[Simulated, np.ndarray]:
        row = int(rng.integers(len(asked.plant)))
        return Linear(asked.plants[asked.plant[row]], asked.x0[row], asked.u0[row]), asked.u0[row]

    return Rig("study", exported, np.array([o.reference for o in machine.outputs]), begin, 8.0, 0.6)


def _limits(output: Any) -> tuple[float, float]:
    low, high = output.low, output.high
    return -np.inf if low is None else low, np.inf if high is None else high


def hot_end(name: str, parts: HotParts) -> Rig:
    """A hot end under PI by SIMC, its plant identified from a record of steps."""
    z, T = len(parts.capacity), parts.sample_time_s
    rng = np.random.default_rng(7)
    held = _holding(parts)
    machine, count = HotEnd(parts, None), round(1200 / max(T, 0.6))
    u, y = np.empty((count, z)), np.empty((count, z))
    level, left = held.copy(), np.zeros(z, int)
    for t in range(count):
        for i in range(z):
            if left[i] == 0:
                level[i], left[i] = held[i] * rng.uniform(0.6, 1.4), rng.integers(10, 80)
            left[i] -= 1
        y[t], u[t] = machine.read(rng), level if t * T > 5 else 0
        machine.advance(u[t])
    limits = np.zeros(z), np.full(z, 100.0)
    found = identified_record(u, y, T, limits)
    model, family = strictly_proper(found.plant), [strictly_proper(one) for one in found.family]
    noise = np.maximum(found.noise_degC, 0.02)
    made = baseline.controller(model, limits, horizon=count // 3, family=family, noise_degC=noise)
    law = made.design(np.ones(z), np.ones(z), 0.0)
    within = governor.Limits(*limits, np.full(z, np.inf))
    deployed = controller.deployed(law, within, integral_limit=2.0)
    wired = Machine(
        tuple(Signal(f"heater_{i + 1}", "percent", 0.0, 100.0) for i in range(z)),
        tuple(Signal(f"zone_{i + 1}", "degC", 5.0, 290.0) for i in range(z)),
        T,
    )
    watched = supervisor.supervision(model, family, wired, noise)
    exported = Exported(name, wired, deployed, made.model, deployed, watched, True, "", "")

    def begin(rng: np.random.Generator) -> tuple[Simulated, np.ndarray]:
        return HotEnd(parts, rng), np.zeros(z)

    return Rig(name, exported, np.array(parts.reference), begin, 6.0, 0.1 if T < 1 else 0.3)


def _holding(parts: HotParts) -> np.ndarray:
    """Duty in percent that holds the reference."""
    at = np.array(parts.reference)
    heat = parts.loss * (at - ROOM) + parts.radiates * ((at + KELVIN) ** 4 - (ROOM + KELVIN) ** 4)
    if len(at) > 1:
        heat -= parts.between * (at[::-1] - at)
    return 100 * heat / np.array(parts.power)


# ---- one run


class Fault(NamedTuple):
    """A kind of FAULTS that begins at sample `begins` on input or output `signal`, with a size and a sign."""

    kind: str
    begins: int
    input: int
    output: int
    size: float
    sign: float


class Injected:
    """What a fault does to readings, to commands and to the clock, sample by sample."""

    def __init__(self, fault: Fault, machine: Simulated, rig: Rig):
        self.fault, self.machine, self.rig = fault, machine, rig
        self.frozen: float | None = None
        self.slow: float | None = None
        self.last = np.zeros(0)

    def reading(self, y: np.ndarray, t: int, rng: np.random.Generator) -> np.ndarray:
        f, j, since = self.fault, self.fault.output, t - self.fault.begins
        if since < 0:
            return y
        y, T = y.copy(), self.rig.exported.machine.sample_time_s
        noise = self.rig.exported.supervision.noise_degC[j]
        if f.kind == "sensor_frozen":
            self.frozen = y[j] if self.frozen is None else self.frozen
            y[j] = self.frozen
        elif f.kind == "sensor_nan":
            y[j] = np.nan
        elif f.kind == "out_of_range":
            y[j] = 400.0 if f.sign > 0 else -40.0
        elif f.kind == "sensor_noisy":
            y[j] += 10 * noise * rng.standard_normal()
        elif f.kind == "sensor_slow":
            true = self.machine.outputs()[j]
            self.slow = true if self.slow is None else self.slow + (true - self.slow) / (8 + 12 * f.size)
            y[j] += self.slow - true
        elif f.kind == "sensor_offset":
            y[j] += f.sign * (3 + 4 * f.size)
        elif f.kind == "sensor_drift":
            y[j] += f.sign * (since + 1) * T * (0.3 + 0.2 * f.size)
        elif f.kind == "thermal_runaway":
            y[j] = 25 + (y[j] - 25) * np.exp(-(since + 1) * T / (4 + 6 * f.size))
        return y

    def command(self, u: np.ndarray, t: int) -> np.ndarray:
        f, i = self.fault, self.fault.input
        if t < f.begins:
            self.last = u.copy()
            return u
        u = u.copy()
        if f.kind == "heater_stuck_on":
            u[i] = 100.0
        elif f.kind == "heater_stuck_off":
            u[i] = 0.0
        elif f.kind == "heater_weak":
            u[i] *= 0.35 + 0.25 * f.size
        elif f.kind in ("command_not_applied", "command_read_back"):
            return self.last
        return u

    def gap_s(self, t: int) -> float:
        f, T = self.fault, self.rig.exported.machine.sample_time_s
        if t == f.begins and f.kind == "clock_jump":
            return T + f.sign * 3600
        return T * (2.0 + 4 * f.size) if t == f.begins and f.kind == "deadline_missed" else T


class Outcome(NamedTuple):
    """One case: samples from the fault to the safe mode (None: none; negative: before it), from the 5th
    deviation on, the zone's largest error in degC by then, the cause named first, and whether its signal is
    the right one; how far the zone got in all."""

    late: int | None
    after: int | None
    erred_degC: float
    named: str
    beside: str
    signal: bool
    mode: str
    mains: bool
    worst_degC: float


def played(rig: Rig, kind: str, seed: int) -> Outcome:
    """One case: a run with the fault, and the same without it."""
    rng = np.random.default_rng([FAULTS.index(kind), seed])
    (p, m) = rig.exported.supervision.peak.shape
    heaters = min(m, 6) if rig.name == "study" else m
    T = rig.exported.machine.sample_time_s
    warm = 90 if rig.name == "study" else round(170 / T)
    begins = warm + int(rng.integers(10, 60))
    fault = Fault(
        kind,
        begins,
        int(rng.integers(heaters)),
        int(rng.integers(p)),
        float(rng.uniform()),
        float(rng.choice([-1.0, 1.0])),
    )
    changes = [
        (begins + int(rng.integers(-40, 20)), rig.change_degC * rng.uniform(-1, 1, 1)),
        (begins + int(rng.integers(40, 60)), rig.change_degC * rng.choice([-1, 1]) * rng.uniform(0.6, 1, 1)),
    ]
    run = int(rng.integers(2**31))
    steps = begins + (150 if kind in SLOW_KINDS or kind.startswith("command") else 90)
    faulty = _run(rig, fault, changes, run, steps)
    told = kind not in SLOW_KINDS and faulty["safe"] is not None
    healthy = faulty if told else _run(rig, None, changes, run, min(steps, faulty["end"]))
    return _outcome(rig, fault, faulty, healthy)


def _run(rig: Rig, fault: Fault | None, changes, seed: int, steps: int) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    machine, u = rig.begin(rng)
    supervised = supervisor.Supervised(rig.exported, rehearsal=True)
    for _ in range(30):
        supervised.watch(u, machine.read(rng), rig.reference)
        machine.advance(u)
    supervised.hand_over(machine.read(rng))
    injected = Injected(fault or Fault("none", 10**9, 0, 0, 0.0, 1.0), machine, rig)
    t_s, applied, safe, passed, decision = 0.0, None, None, None, None
    y, causes = [], ()
    p = len(rig.reference)
    for t in range(steps):
        r = rig.reference.copy()
        for at, by in changes:
            r = rig.reference + by if t >= at else r
        if fault is not None and fault.kind == "reference_out_of_reach" and t >= fault.begins:
            r[fault.output] += 130
        if fault is not None and t == fault.begins and fault.kind == "model_no_longer_right":
            machine.spoil(rng)
        t_s += injected.gap_s(t)
        y.append(machine.outputs())
        reading = injected.reading(machine.read(rng), t, rng)
        readback = applied if fault is not None and fault.kind == "command_read_back" else None
        decision = supervised.step(reading, r, t_s, applied=readback)
        applied = injected.command(decision.u, t)
        missed = round(injected.gap_s(t + 1) / rig.exported.machine.sample_time_s)
        for _ in range(missed if 1 < missed < 20 else 1):
            machine.advance(applied)
        m = len(applied)
        z = np.abs(supervised.memory.ring[-1, 2 * m : 2 * m + p]).max()
        if fault is not None and t >= fault.begins and passed is None and z > SIGMA:
            passed = t
        if decision.mode != "law" and safe is None:
            safe = t
        if safe is not None and t <= safe + WITHIN and decision.causes:
            causes = decision.causes
        if safe is not None and t >= safe + WITHIN + 4:
            break
    return {"y": np.array(y), "safe": safe, "passed": passed, "causes": causes, "end": len(y)}


def _outcome(rig: Rig, fault: Fault, faulty: dict[str, Any], healthy: dict[str, Any]) -> Outcome:
    n = min(len(faulty["y"]), len(healthy["y"]))
    off = np.abs(faulty["y"][:n] - healthy["y"][:n]).max(axis=1)
    safe, machine = faulty["safe"], rig.exported.machine
    until = n if safe is None else min(safe + 1, n)
    first = faulty["causes"][0] if faulty["causes"] else None
    signals = {"input": machine.inputs[fault.input].name, "output": machine.outputs[fault.output].name}
    whole = (
        fault.kind in ("deadline_missed", "clock_jump", "model_no_longer_right") or "command" in fault.kind
    )
    right = first is not None and (whole or first.signal in signals.values())
    if first is not None and (fault.kind, first.kind) in SAID:
        # the zone of the heater, or the heater of the zone
        peak = rig.exported.supervision.peak
        names = [i.name for i in machine.inputs], [o.name for o in machine.outputs]
        if first.signal in names[0] and fault.kind == "sensor_drift":
            right = peak[fault.output, names[0].index(first.signal)] > 0.1 * peak[fault.output].max()
        elif first.signal in names[1] and fault.kind.startswith("heater"):
            right = peak[names[1].index(first.signal), fault.input] > 0.1 * peak[:, fault.input].max()
    beside = ""
    if first is not None and "would show the same" in first.sentence:
        beside = first.sentence.split("; ")[-1].split(" would show")[0].replace(" ", "_")
    return Outcome(
        None if safe is None else safe - fault.begins,
        None if safe is None or faulty["passed"] is None else safe - faulty["passed"],
        float(off[fault.begins : until].max(initial=0.0)),
        "" if first is None else first.kind,
        beside,
        bool(right),
        "",
        first is not None and "mains" in first.sentence,
        float(off.max(initial=0.0)),
    )


def summary(kind: str, outcomes: list[Outcome]) -> dict[str, Any]:
    """The figures of one kind on one machine."""
    shown = [o for o in outcomes if not (o.late is None and o.worst_degC < ZONE_DEGC)]
    early = [o for o in shown if o.late is not None and o.late < 0]
    seen = [o for o in shown if o.late is not None and o.late >= 0]
    names = SAME.get(kind, (kind,))
    right = [o for o in seen if o.named in names and o.signal]
    said = [
        o for o in seen if o.signal and (o.named in names or o.beside in names or (kind, o.named) in SAID)
    ]
    slow = kind in SLOW_KINDS
    in_time = [
        o for o in seen if (o.erred_degC < ZONE_DEGC if slow else (o.after is None or o.after <= WITHIN))
    ]
    others = [f"{o.named}{'' if o.signal else ' (other signal)'}" for o in seen if o not in right]
    return {
        "cases": len(outcomes),
        "silent": len(outcomes) - len(shown),
        "before_the_fault": len(early),
        "seen": len(seen),
        "unseen": len(shown) - len(early) - len(seen),
        "in_time": len(in_time),
        "right": len(right),
        "said": len(said),
        "samples_median": float(np.median([o.late for o in seen])) if seen else None,
        "samples_after_5_sigma_most": max((o.after for o in seen if o.after is not None), default=None),
        "erred_degC_q90": float(np.quantile([o.erred_degC for o in seen], 0.9)) if seen else None,
        "mains_named": sum(o.mains for o in seen),
        "named_instead": {name: others.count(name) for name in sorted(set(others))},
    }


# ---- quiet hours


def quiet(rig: Rig, hours: float, seed: int) -> dict[str, Any]:
    """Hours of one machine after another, 30 minutes each, with references that change every few minutes and
    disturbances of the allowed size: how often the law was left."""
    T = rig.exported.machine.sample_time_s
    alarms, total, what = 0, round(hours * 3600 / T), []
    rng = np.random.default_rng([999, seed])
    done = 0
    while done < total:
        machine, u = rig.begin(rng)
        supervised = supervisor.Supervised(rig.exported, rehearsal=True)
        for _ in range(30):
            supervised.watch(u, machine.read(rng), rig.reference)
            machine.advance(u)
        supervised.hand_over(machine.read(rng))
        r, law = rig.reference.copy(), True
        for t in range(min(round(1800 / T), total - done)):
            if rng.uniform() < T / 200:
                r = rig.reference + rig.change_degC * rng.uniform(-1, 1)
            if rng.uniform() < T / 300:
                machine.disturb(rng)
            decision = supervised.step(machine.read(rng), r, t * T)
            machine.advance(decision.u)
            if decision.mode != "law" and law:
                alarms += 1
                what.append(f"{t}: {decision.causes[0].kind}")
            law = decision.mode == "law"
            done += 1
    return {"hours": done * T / 3600, "alarms": alarms, "what": what}


def step_us(rig: Rig, steps: int = 1500) -> dict[str, float]:
    """Microseconds a step: the whole, and the law alone."""
    rng = np.random.default_rng(3)
    machine, u = rig.begin(rng)
    whole = supervisor.Supervised(rig.exported, rehearsal=True)
    law = controller.RunningController(rig.exported.controller, rig.exported.model)
    for _ in range(30):
        y = machine.read(rng)
        whole.watch(u, y, rig.reference)
        law.watch(u, y, rig.reference)
    whole.hand_over(y)
    law.hand_over(y)
    taken: dict[str, list[float]] = {"whole": [], "law": []}
    for t in range(steps):
        y = machine.read(rng)
        at = time.perf_counter()
        decision = whole.step(y, rig.reference, t * rig.exported.machine.sample_time_s)
        between = time.perf_counter()
        law.step(y, rig.reference, t)
        taken["law"].append(time.perf_counter() - between)
        taken["whole"].append(between - at)
        machine.advance(decision.u)
    return {
        f"{name}_{label}": round(1e6 * float(np.quantile(values, q)), 1)
        for name, values in taken.items()
        for label, q in (("quickest", 0.02), ("median", 0.5))
    }


RIGS: dict[str, Callable[[], Rig]] = {
    "study": study,
    "hot end": lambda: hot_end("hot end", HOT_END),
    "hot end of two zones": lambda: hot_end("hot end of two zones", TWO_ZONES),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=50)
    parser.add_argument("--seed", type=int, default=5000, help="of the first case and of the quiet hours")
    parser.add_argument("--hours", type=float, default=200.0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--machines", nargs="*", default=list(RIGS))
    parser.add_argument("--kinds", nargs="*", default=list(FAULTS))
    arguments = parser.parse_args()
    for name in arguments.machines:
        row = one_machine(RIGS[name](), arguments)
        print(name, json.dumps({key: row[key] for key in ("total", "quiet", "step_us")}), flush=True)
        if arguments.kinds == list(FAULTS):
            done = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
            done[name] = row
            RESULTS.write_text(json.dumps({key: done[key] for key in RIGS if key in done}, indent=1) + "\n")


def one_machine(rig: Rig, arguments: argparse.Namespace) -> dict[str, Any]:
    calls = [
        (kind, seed)
        for kind in arguments.kinds
        for seed in range(arguments.seed, arguments.seed + arguments.cases)
    ]
    outcomes = joblib.Parallel(n_jobs=arguments.jobs)(
        joblib.delayed(_played_on)(rig.name, kind, seed) for kind, seed in calls
    )
    by_kind = {
        kind: summary(kind, [o for (of, _), o in zip(calls, outcomes, strict=True) if of == kind])
        for kind in arguments.kinds
    }
    for kind, row in by_kind.items():
        print(f"{rig.name:22}{kind:24}{json.dumps({k: v for k, v in row.items() if v})}", flush=True)
    parts = joblib.Parallel(n_jobs=arguments.jobs)(
        joblib.delayed(_quiet_on)(rig.name, rig.share * arguments.hours / 8, arguments.seed + part)
        for part in range(8)
    )
    hours, alarms = sum(part["hours"] for part in parts), sum(part["alarms"] for part in parts)
    total = {
        key: sum(row[key] for row in by_kind.values())
        for key in ("cases", "silent", "seen", "unseen", "in_time", "right", "said", "before_the_fault")
    }
    return {
        "faults": by_kind,
        "total": total,
        "quiet": {"hours": hours, "alarms": alarms, "what": [w for part in parts for w in part["what"]]},
        "step_us": step_us(rig),
    }


_RIG: dict[str, Rig] = {}


def _rig(name: str) -> Rig:
    """Each process makes a machine once."""
    if name not in _RIG:
        _RIG[name] = RIGS[name]()
    return _RIG[name]


def _played_on(name: str, kind: str, seed: int) -> Outcome:
    return played(_rig(name), kind, seed)


def _quiet_on(name: str, hours: float, seed: int) -> dict[str, Any]:
    return quiet(_rig(name), hours, seed)


if __name__ == "__main__":
    main()
