"""Does a replay abstain where it should, and only there? And how long do a million rows take?

`./run python -m benchmarks.replay [PART ...]` prints a table by kind of log and writes what was asked for
into benchmarks/results/replay.json: `study`, `rows` (a million of them), names of small machines; all without
PART.

The study's machine: the controller and the support of datasets/export_controllers. Its honest logs are of
plants, noise, ambients and references drawn anew, under the controller. Those that are off support are of
other machines, other set points, other materials, wired wrong, or of actuators that fail.

Small machines (tests/temperature/small_machines.py: watts, radiation, dead time, lagging sensors, coarse
converters) have another structure than every plant that the support is made of. Each is identified from one
record, as an owner would; its honest logs have other inputs, noise and rooms. The others are of a machine
whose parts are changed, wired wrong, or of another machine with as many signals; records of real kits are
among these where the folder is present.
"""

import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.small_machines import Recording, of_machine, real_records
from pipeline.runtime import replay, support
from pipeline.runtime.machine import Exported, read
from pipeline.runtime.replay import Log
from pipeline.runtime.workflow import replay as replaying
from pipeline.store import params
from pipeline.temperature import panel
from pipeline.temperature.plant import Plant, baam
from pipeline.temperature.workflow import cases, learned
from pipeline.temperature.workflow.settings import Panel
from pipeline.temperature.workflow.settings import Plant as Machine
from tests.temperature import small_machines
from tests.temperature.small_machines import MACHINES, SmallMachine

RESULTS = Path(__file__).parent / "results" / "replay.json"
FOLDER = Path("datasets/export_controllers/temperature")
ROWS = 1_000_000
SEED, PLANTS = 3307, 20  # of the study's machine, drawn anew
SEEDS = range(31, 35)  # of the small machines' logs


class Counted(NamedTuple):
    """Of one kind of log: how many, and the shares on which the replay abstains and says that hardly anything
    moves."""

    logs: int
    abstains: float
    still: float


def counted(within: support.Support, watch: support.Watch, logs: Sequence[Log]) -> Counted:
    said = [support.told(within, log, watch) for log in logs]
    return Counted(
        len(logs),
        float(np.mean([one.abstains for one in said])),
        float(np.mean([one.still and not one.abstains for one in said])),
    )


# ---- what is wrong with a log, whatever the machine


def wired_wrong(m: int, p: int) -> dict[str, Callable[[Log], Log]]:
    kinds: dict[str, Callable[[Log], Log]] = {
        "commands of 0 to 1": lambda log: log._replace(u=log.u / 100),
        "commands of 0 to 255": lambda log: log._replace(u=log.u * 2.55),
        "degrees Fahrenheit": lambda log: log._replace(y=1.8 * log.y + 32),
        "kelvin": lambda log: log._replace(y=log.y + 273.15),
        "every other sample": lambda log: Log(*(part[::2] for part in log)),
        "every sample twice": lambda log: Log(*(np.repeat(part, 2, axis=0) for part in log)),
    }
    if p > 1:
        kinds["two sensors swapped"] = lambda log: log._replace(y=_swapped(log.y))
    if m > 1:
        kinds["two heaters swapped"] = lambda log: log._replace(u=_swapped(log.u))
    return kinds


def _swapped(part: np.ndarray) -> np.ndarray:
    """Neighbours swapped; which, follows from the log."""
    first = int(np.abs(part).sum()) % (part.shape[1] - 1)
    order = np.arange(part.shape[1])
    order[[first, first + 1]] = first + 1, first
    return part[:, order]


# ---- the study's machine


class Played(NamedTuple):
    """A log, the plant that it is of, and where it began."""

    log: Log
    plant: Plant
    x0: np.ndarray


def drawn_anew() -> tuple[panel.Cases, learned.Learned]:
    """The judging half with another seed, fewer plants, and other references."""
    machine, declared = params.load(Machine, "plant"), params.load(Panel, "panel")
    learnt = learned.read_learned(
        "datasets/identify_plant/plant.parquet",
        "datasets/identify_plant/spread.parquet",
        "datasets/learn_kernel",
        "datasets/ingest/printer_pid.json",
        machine,
    )
    offsets = [0.8 * offset + 1.5 for offset in declared.judging.reference_offsets_degC]
    half = declared.judging.model_copy(
        update={"seed": SEED, "plants": PLANTS, "reference_offsets_degC": offsets}
    )
    declared = declared.model_copy(update={"judging": half})
    return cases.declared(declared, machine, baam(), [learnt.model, *learnt.spread]).judging, learnt


def honest_logs(made: Exported, half: panel.Cases) -> list[Played]:
    """What each plant would have logged under the exported controller."""
    limits = made.controller.limits
    run = panel.rolled_out(
        made.controller, half, panel.aims(made.controller.law, panel.rests(made.model, half, limits), half)
    )
    noise, played = panel.noise_of(half)[: half.hold], []
    for case in range(len(half.plant)):
        plant = half.plants[half.plant[case]]
        held = plant.C @ half.x0[case] + plant.d + noise[:, case]
        still = np.repeat(run.r[:1, case], half.hold, axis=0)
        u = np.vstack([np.tile(half.u0[case], (half.hold, 1)), run.u[:, case]])
        log = Log(u, np.vstack([held, run.measured[:, case]]), np.vstack([still, run.r[:, case]]))
        played.append(Played(log, plant, half.x0[case]))
    return played


def answered(one: Played, u: np.ndarray) -> Log:
    """The log of the same commands where the machine was really given u (T, m)."""
    plant, x, y = one.plant, np.zeros(one.plant.n), one.log.y.copy()
    for t, more in enumerate(u - one.log.u):
        y[t] += plant.C @ x
        x = plant.A @ x + plant.B @ more
    return one.log._replace(y=y)


def of_another(one: Played, other: Plant, x0: np.ndarray, rng: np.random.Generator) -> Log:
    """The log of another plant under the same commands."""
    x, y = x0, np.empty_like(one.log.y)
    for t, u in enumerate(one.log.u):
        y[t] = other.C @ x + other.d + 0.1 * rng.standard_normal(other.p)
        x = other.A @ x + other.B @ u + other.b
    return one.log._replace(y=y)


def slower(one: Played, times: float, rng: np.random.Generator) -> Log:
    """Every time constant `times` as long: a heavier barrel, another material in it."""
    plant = one.plant
    A = np.eye(plant.n) + (plant.A - np.eye(plant.n)) / times
    return of_another(one, plant._replace(A=A, B=plant.B / times, b=plant.b / times), one.x0, rng)


def another_machine(one: Played, rng: np.random.Generator) -> Log:
    """Zones of more mass and other heaters, each its own: at rest where the log begins, its ambient so."""
    plant = one.plant
    mass, power = np.exp(rng.uniform(0, 1.5, plant.n)), np.exp(rng.uniform(-1, 1, plant.m))
    A = np.eye(plant.n) + (plant.A - np.eye(plant.n)) / mass[:, None]
    B = plant.B * power / mass[:, None]
    b = one.x0 - A @ one.x0 - B @ one.log.u[0]
    return of_another(one, plant._replace(A=A, B=B, b=b), one.x0, rng)


def other_set_points(one: Played, degC: float) -> Log:
    """The whole log so much hotter, with the inputs that hold it there."""
    plant = one.plant
    steady = plant.C @ np.linalg.solve(np.eye(plant.n) - plant.A, plant.B)
    more = np.linalg.lstsq(steady, np.full(plant.p, degC), rcond=None)[0]
    return Log(one.log.u + more, one.log.y + degC, one.log.r + degC)


def stuck(one: Played, heater: int) -> Log:
    """One heater stays from a third of the log on where it was at its start."""
    u = one.log.u.copy()
    u[len(u) // 3 :, heater] = u[0, heater]
    return answered(one, u)


def drifted(one: Played, to: float) -> Log:
    """Every heater's gain drifts to so much of itself within the first half of the log."""
    share = np.interp(np.arange(len(one.log.u)), [0, len(one.log.u) / 2], [1.0, to])
    return answered(one, one.log.u * share[:, None])


def deployed() -> tuple[Exported, support.Support]:
    """The exported controller and its support."""
    made = read(FOLDER)[0]
    within = replaying.read_support(FOLDER, made)
    if within is None:
        raise ValueError(
            f"{FOLDER}: it has no support; make it again with ./run dvc repro export_controllers"
        )
    return made, within


def study() -> dict[str, Any]:
    """By kind of log `Counted`."""
    made, within = deployed()
    watch, rng = support.watched_by(within.spread, within.steps), np.random.default_rng(SEED)
    played = honest_logs(made, drawn_anew()[0])
    some, m, p = played[::3], made.controller.limits.low.size, made.model.p
    kinds = {name: [change(one.log) for one in some] for name, change in wired_wrong(m, p).items()}
    kinds |= {
        "other set points, 40 degC hotter": [other_set_points(one, 40.0) for one in some],
        "twice as slow": [slower(one, 2.0, rng) for one in some],
        "twice as fast": [slower(one, 0.5, rng) for one in some],
        "another machine": [another_machine(one, rng) for one in some],
        "a heater stuck": [stuck(one, i % m) for i, one in enumerate(some)],
        "gains drift to 1.6": [drifted(one, 1.6) for one in some],
        "gains drift to 0.5": [drifted(one, 0.5) for one in some],
    }
    table = {"own": counted(within, watch, [one.log for one in played])}
    print("study, own", table["own"], flush=True)
    for name, logs in kinds.items():
        table[name] = counted(within, watch, logs)
        print("study,", name, table[name], flush=True)
    return {"plants": PLANTS, "seed": SEED, "kinds": {name: row._asdict() for name, row in table.items()}}


def million_rows() -> dict[str, float]:
    """CPU seconds in one thread of judging and replaying a log, repeated until it has ROWS."""
    made, within = deployed()
    log = honest_logs(made, drawn_anew()[0])[3].log
    long = Log(*(np.tile(part, (ROWS // len(part) + 1, 1))[:ROWS] for part in log))
    started = time.process_time()
    support.told(within, long, support.watched_by(within.spread, within.steps))
    replay.replayed(made.controller, made.model, long)
    return {"rows": ROWS, "cpu_s": round(time.process_time() - started, 1)}


# ---- small machines, written apart

# what a log is driven by, and its centre as a share of the record's: no hotter than the record
INPUTS = (("steps", 0.95), ("staircase", 0.8), ("walk", 0.75))
ROOMS_DEGC = (-2.0, 0.0, 2.0)  # a bench kit's record spans 20 degC


def fresh(machine: SmallMachine, seed: int, within: tuple[np.ndarray, np.ndarray]) -> Log:
    """Another log of the same owner: other inputs (T, m) `within` those of the record, another season."""
    record, share = INPUTS[seed % 3]
    machine = machine._replace(
        record=record,
        centre=tuple(share * level for level in machine.centre),
        room_degC=machine.room_degC + ROOMS_DEGC[seed // 3 % 3],
    )
    rng = np.random.default_rng(seed)
    u = np.clip(small_machines.inputs(machine, rng), *within)
    state, y = small_machines.at_rest(machine, np.zeros(machine.m)), np.empty((len(u), machine.p))
    for t, applied in enumerate(u):
        y[t] = small_machines.measured(machine, state, rng)
        state = small_machines.advanced(machine, state, applied)
    return Log(u, y, y)


def changed(machine: SmallMachine) -> dict[str, SmallMachine]:
    """The same machine with other parts."""
    scaled = {name: tuple(2.0 * value for value in getattr(machine, name)) for name in ("capacity", "loss")}
    power = np.asarray(machine.power)
    return {
        "twice the mass": machine._replace(capacity=scaled["capacity"]),
        "twice the loss": machine._replace(loss=scaled["loss"]),
        "half the power": machine._replace(power=tuple(map(tuple, 0.5 * power))),
    }


def of_record(recording: Recording) -> support.Support:
    """Support as it follows from a record alone: plants of its bootstrap, and the record itself."""
    limits = np.zeros(recording.u.shape[1]), np.full(recording.u.shape[1], 100.0)
    of = small_machines.identified_record(
        np.clip(recording.u, *limits), recording.y, recording.sample_time_s, limits
    )
    spread = panel.Spread(0.15, 0.2, 0.0, 0.5, 0.0)
    rng = np.random.default_rng(1)
    plants = panel.padded(panel.drawn(of.family, 16, spread, cells=False, rng=rng))
    log = Log(recording.u, recording.y, recording.y)
    return support.support(plants, [], np.full(recording.y.shape[1], 0.1), [log])


def of_small(
    machine: SmallMachine, records: dict[str, Recording], real: dict[str, Log]
) -> dict[str, Counted]:
    recording = records[machine.name]
    within, span = of_record(recording), (recording.u.min(axis=0), recording.u.max(axis=0))
    watch = support.watched_by(within.spread, within.steps)
    logs = [fresh(machine, seed, span) for seed in SEEDS]
    table = {"own": counted(within, watch, logs)}
    for name, other in changed(machine).items():
        table[name] = counted(within, watch, [fresh(other, seed, span) for seed in SEEDS])
    for name, change in wired_wrong(machine.m, machine.p).items():
        table[name] = counted(within, watch, [change(log) for log in logs])
    others = [
        fresh(other, seed, span)
        for other in MACHINES
        if other.name != machine.name and (other.m, other.p) == (machine.m, machine.p)
        for seed in (SEEDS[0], SEEDS[1])
    ]
    others += [log for log in real.values() if (log.u.shape[1], log.y.shape[1]) == (machine.m, machine.p)]
    if others:
        table["another machine"] = counted(within, watch, others)
    return table


def small(asked: Sequence[SmallMachine]) -> dict[str, dict[str, Counted]]:
    records = {machine.name: of_machine(machine) for machine in asked}
    real = {name: Log(r.u, r.y, r.y) for name, r in real_records().items()}
    tables = {}
    for machine in asked:
        tables[machine.name] = of_small(machine, records, real)
        print(
            machine.name,
            {name: round(row.abstains, 2) for name, row in tables[machine.name].items()},
            flush=True,
        )
    return tables


def pooled(tables: Sequence[dict[str, Counted]]) -> dict[str, dict[str, Any]]:
    """By kind, over machines, every log counted once."""
    names = dict.fromkeys(name for table in tables for name in table)
    rows = {name: [table[name] for table in tables if name in table] for name in names}
    return {
        name: {
            "logs": sum(row.logs for row in found),
            "abstains": sum(row.logs * row.abstains for row in found) / sum(row.logs for row in found),
            "still": sum(row.logs * row.still for row in found) / sum(row.logs for row in found),
        }
        for name, found in rows.items()
    }


def shares(kinds: dict[str, dict[str, Any]]) -> dict[str, float]:
    """On-support logs on which it abstains; off-support ones, every kind counted alike."""
    off = [row["abstains"] for name, row in kinds.items() if name != "own"]
    return {"on_support_abstains": kinds["own"]["abstains"], "off_support_abstains": float(np.mean(off))}


def main() -> None:
    by_name = {machine.name: machine for machine in MACHINES}
    parts = sys.argv[1:] or ["rows", "study", *by_name]
    unknown = sorted({*parts} - {"rows", "study", *by_name})
    if unknown:
        raise ValueError(f"expected rows, study or {', '.join(by_name)}, found {', '.join(unknown)}")
    result = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    result["command"] = "./run python -m benchmarks.replay"
    if "rows" in parts:
        result["rows"] = million_rows()
        print(result["rows"])
    if "study" in parts:
        own = study()
        result["study"] = own | shares(own["kinds"])
    asked = [by_name[name] for name in parts if name in by_name]
    if asked:
        tables = small(asked)
        kinds = pooled(list(tables.values()))
        own = {name: table["own"].abstains for name, table in tables.items()}
        result["small_machines"] = {"own": own, "kinds": kinds, **shares(kinds)}
        for name, row in kinds.items():
            print(f"{name:24s} {row['logs']:4d} {row['abstains']:.2f} {row['still']:.2f}")
    for name in ("study", "small_machines"):
        print(name, {key: value for key, value in result.get(name, {}).items() if "abstains" in key})
    RESULTS.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
