"""Does a replay abstain where it should, and only there? Logs of machines of the controller's own spread,
logs that are wired wrong, and logs of machines of another structure; and how long a million rows take.

`./run python -m benchmarks.replay` prints the table and writes benchmarks/results/replay.json. The study's
machine is that of datasets/; the small machines (tests/temperature/small_machines.py: watts, radiation, dead
time, lagging sensors) are identified from their records, and each meets fresh logs of itself, and logs of
every other machine with as many signals. Where the folder is present, records of real kits are logs of
another structure too.
"""

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.small_machines import Recording, of_machine, real_records
from pipeline.runtime import replay, support
from pipeline.runtime.machine import Exported, read
from pipeline.runtime.replay import Log
from pipeline.runtime.workflow import replay as replaying
from pipeline.store import params
from pipeline.temperature import panel
from pipeline.temperature.plant import baam
from pipeline.temperature.workflow import cases, learned
from pipeline.temperature.workflow.settings import Panel, Plant
from tests.temperature import small_machines
from tests.temperature.small_machines import MACHINES, SmallMachine

RESULTS = Path(__file__).parent / "results" / "replay.json"
FOLDER = Path("datasets/export_controllers/temperature")
ROWS = 1_000_000
EVERY = 5  # of the panel's cases


def share(within: support.Support, logs: Sequence[Log]) -> float:
    watches = support.watches_of(within)
    return float(np.mean([support.told(within, log, watches).abstains for log in logs]))


# ---- small machines, written apart


def fresh(machine: SmallMachine, seed: int) -> Log:
    """Another record of the same owner, from another seed."""
    u, y = small_machines.record(machine, seed)
    return Log(u, y, y)


def of_record(recording: Recording) -> support.Support:
    """Support as it follows from a record alone: plants of its bootstrap, and the record in pieces."""
    limits = np.zeros(recording.u.shape[1]), np.full(recording.u.shape[1], 100.0)
    of = small_machines.identified_record(
        np.clip(recording.u, *limits), recording.y, recording.sample_time_s, limits
    )
    spread = panel.Spread(0.15, 0.2, 0.0, 0.5, 0.0)
    rng = np.random.default_rng(1)
    plants = panel.padded(panel.drawn(of.family, 16, spread, cells=False, rng=rng))
    steps = support.horizon(plants)
    pieces = max(min(8, len(recording.u) // (5 * steps)), 1)
    logs = [
        Log(u, y, y)
        for u, y in zip(np.array_split(recording.u, pieces), np.array_split(recording.y, pieces), strict=True)
    ]
    noise = np.full(recording.y.shape[1], 0.1)
    return support.support(plants, logs, noise)


def small(seeds: range) -> dict[str, Any]:
    """By machine, the share of its own fresh logs and of others' logs on which its replay abstains."""
    records = {machine.name: of_machine(machine) for machine in MACHINES}
    fresh_logs = {machine.name: [fresh(machine, seed) for seed in seeds] for machine in MACHINES}
    foreign = {name: Log(r.u, r.y, r.y) for name, r in real_records().items()}
    table = {}
    for machine in MACHINES:
        within = of_record(records[machine.name])
        others = [
            log
            for other in MACHINES
            if other.name != machine.name and (other.m, other.p) == (machine.m, machine.p)
            for log in fresh_logs[other.name]
        ]
        others += [
            log for log in foreign.values() if (log.u.shape[1], log.y.shape[1]) == (machine.m, machine.p)
        ]
        table[machine.name] = {
            "own": share(within, fresh_logs[machine.name]),
            "others": share(within, others) if others else None,
            "logs": [len(fresh_logs[machine.name]), len(others)],
        }
        print(machine.name, table[machine.name], flush=True)
    return table


# ---- the study's machine


def judged_logs(made: Exported) -> list[Log]:
    """What each plant of the judging half would have logged under the exported controller."""
    machine, declared = params.load(Plant, "plant"), params.load(Panel, "panel")
    learnt = learned.read_learned(
        "datasets/identify_plant/plant.parquet",
        "datasets/identify_plant/spread.parquet",
        "datasets/learn_kernel",
        "datasets/ingest/printer_pid.json",
        machine,
    )
    rehearsal = cases.declared(declared, machine, baam(), [learnt.model, *learnt.spread])
    half, limits = rehearsal.judging, made.controller.limits
    run = panel.rolled_out(
        made.controller, half, panel.aims(made.controller.law, panel.rests(made.model, half, limits), half)
    )
    noise, logs = panel.noise_of(half)[: half.hold], []
    for case in range(len(half.plant)):
        plant = half.plants[half.plant[case]]
        held = plant.C @ half.x0[case] + plant.d + noise[:, case]
        still = np.repeat(run.r[:1, case], half.hold, axis=0)
        u = np.vstack([np.tile(half.u0[case], (half.hold, 1)), run.u[:, case]])
        logs.append(Log(u, np.vstack([held, run.measured[:, case]]), np.vstack([still, run.r[:, case]])))
    return logs


def study() -> dict[str, Any]:
    """Logs of plants of the judging half under the exported controller, and the same logs wired wrong."""
    made = read(FOLDER)[0]
    within = replaying.read_support(FOLDER, made)
    if within is None:
        raise ValueError(
            f"{FOLDER}: it has no support; make it again with ./run dvc repro export_controllers"
        )
    logs = judged_logs(made)[::EVERY]
    wrong = {
        "sensors 1 and 2 swapped": lambda log: log._replace(y=log.y[:, [1, 0, 2, 3, 4]]),
        "sensors 4 and 5 swapped": lambda log: log._replace(y=log.y[:, [0, 1, 2, 4, 3]]),
        "heaters 1 and 2 swapped": lambda log: log._replace(u=log.u[:, [1, 0, 2, 3, 4, 5, 6]]),
        "commands of 0 to 1": lambda log: log._replace(u=log.u / 100),
        "commands halved": lambda log: log._replace(u=log.u / 2),
        "degrees Fahrenheit": lambda log: log._replace(y=1.8 * log.y + 32),
        "every other sample": lambda log: Log(*(part[::2] for part in log)),
        "every sample twice": lambda log: Log(*(np.repeat(part, 2, axis=0) for part in log)),
    }
    table = {"own": share(within, logs), "logs": len(logs)}
    table |= {name: share(within, [change(log) for log in logs[::2]]) for name, change in wrong.items()}
    long = Log(*(np.tile(part, (ROWS // len(part) + 1, 1))[:ROWS] for part in logs[3]))
    started = time.process_time()
    support.told(within, long, support.watches_of(within))
    replay.replayed(made.controller, made.model, long)
    return table | {"rows": ROWS, "cpu_s": round(time.process_time() - started, 1)}


def main() -> None:
    own = study()
    print(own, flush=True)
    machines = small(range(11, 14))
    pairs = [row for row in machines.values() if row["others"] is not None]
    wrong = [value for name, value in own.items() if name not in ("own", "logs", "rows", "cpu_s")]
    result = {
        "command": "./run python -m benchmarks.replay",
        "study": own,
        "small_machines": machines,
        "on_support_abstains": float(np.mean([own["own"], *(row["own"] for row in machines.values())])),
        "off_support_abstains": float(np.mean([*wrong, *(row["others"] for row in pairs)])),
    }
    print({key: result[key] for key in ("on_support_abstains", "off_support_abstains")})
    RESULTS.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
