"""Composition without learning again, on plants of the family: every error is of the true flow under commands
made from measured, noisy trials of the training routine.

`./run python -m benchmarks.composition` prints the tables with their bars and writes
benchmarks/results/composition.json; `... composition 4 1` takes 4 plants a material and one seed. Training:
two speeds, two pauses, 20 updates by the model inverse. Errors are r.m.s. in % of on-off control r /
K_nominal on the same structure, over plants and seeds as median and worst. The yardstick is full-part ILC:
learning on the part itself with the same law and as many trials. Times are CPU seconds.
"""

import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.deposition import basis, gcode, ilc
from pipeline.deposition.composition import (
    Composed,
    Learned,
    PartSettings,
    compose,
    learn,
    priority,
    superposition,
)
from pipeline.deposition.conformance import conform, line_volumes, saturation
from pipeline.deposition.drive import UNLIMITED, Drive, obeyed
from pipeline.deposition.extruder import Extruder, disturb, draw, flow, routine
from pipeline.deposition.library import CORNER, NO_FLOW, START, STEADY, STOP, Training
from pipeline.deposition.motion import plan
from pipeline.deposition.tasks import DWELL

RESULTS = Path(__file__).parent / "results" / "composition.json"
PARTS = Path(__file__).parents[1] / "datasets" / "parts"
TS, AREA, NOZZLE, RAMP = 0.02, 0.304, 0.6, 0.15
MATERIALS = {"A": Extruder(1.08, 2.7), "B": Extruder(0.89, 4.5)}
SPEEDS, PAUSES, UPDATES = (8.0, 5.0), (0.6, 0.3), 20
NOISE = {"white": 0.03, "drift": 0.01, "gain": 0.01}
INVERSE = ilc.InverseSettings(identify_trials=3, floor=0.1, order=4, cutoff_hz=5.0)
MACHINE = {
    "acceleration": 1000.0,
    "junction_deviation_mm": 0.05,
    "speed_limit": 100.0,
    "unset_feed": 8.0,
    "tool_change_s": 2.0,
}
PART = PartSettings(NOZZLE, AREA, RAMP, corner_deg=30.0, longest_pause_s=1.0, drive=UNLIMITED)
BARS = {
    "tic_tac_toe": (3.0, 5.0),
    "dashes": (6.0, 6.0),
    "pause_0.2": (4.0, 5.0),
    "speed_0.5x": (6.0, None),
    "speed_1.5x": (6.0, None),
}
FIG_9 = [
    "No-Flow",
    "Start",
    "Steady-State",
    "Corner",
    "Steady-State",
    "Corner",
    "Steady-State",
    "Stop",
    "No-Flow",
]


# fig. 8 within a material; Dwell stands for the switch of the system
ALLOWED = {
    NO_FLOW: (START, DWELL),
    START: (STEADY, STOP),
    STEADY: (CORNER, STOP),
    CORNER: (STEADY, STOP),
    STOP: (NO_FLOW, START, DWELL),
    DWELL: (START,),
}


def forbidden(tasks: Sequence[str], tools: Sequence[int]) -> np.ndarray:
    """The indices (F,) of tasks that may not follow the one before them (fig. 8): another tool comes only by
    Dwell, Steady-State never goes to No-Flow."""
    tasks, tools = np.asarray(tasks), np.asarray(tools)
    names = np.array(list(ALLOWED))
    table = np.array([[after in ALLOWED[before] for after in names] for before in names])
    order = np.argsort(names)
    code = order[np.searchsorted(names, tasks, sorter=order)]
    fine = table[code[:-1], code[1:]] & ((tools[1:] == tools[:-1]) | (tasks[:-1] == DWELL))
    return np.flatnonzero(~fine) + 1


def learned_trials(
    plant: Extruder, nominal: Extruder, r: np.ndarray, rng: np.random.Generator, *, drive: Drive = UNLIMITED
) -> list[ilc.Trial]:
    law = ilc.InverseLaw(r, INVERSE, drive=drive, sample_time_s=TS)

    def measure(u):
        y = flow(plant, u, sample_time_s=TS, drive=drive)
        return ilc.Trial(
            obeyed(u, drive, sample_time_s=TS), disturb(y, rng, steady_flow=float(r.max()), **NOISE), y
        )

    return ilc.learn(
        law, measure, obeyed(r / nominal.gain, drive, sample_time_s=TS), r, trials=UPDATES, rise=0.1
    )


def train(plant: Extruder, name: str, rng: np.random.Generator) -> list[Training]:
    out = []
    for speed in SPEEDS:
        for pause in PAUSES:
            task = routine(
                off_s=4,
                on_s=14,
                pause_s=pause,
                tail_s=8,
                speed=speed,
                bead_area_mm2=AREA,
                ramp_s=RAMP,
                sample_time_s=TS,
            )
            trials = learned_trials(plant, MATERIALS[name], task.r, rng)
            out.append(
                Training(name, NOZZLE, task, np.array([t.u for t in trials]), np.array([t.y for t in trials]))
            )
    return out


def protocol(speed: float, pause_s: float, ramp_s: float = RAMP) -> np.ndarray:
    return routine(
        off_s=4,
        on_s=6,
        pause_s=pause_s,
        tail_s=8,
        speed=speed,
        bead_area_mm2=AREA,
        ramp_s=ramp_s,
        sample_time_s=TS,
    ).r


def program(name: str, tool: int) -> gcode.Program:
    """A part with all its lines on one tool (None: as it is), so that
    each material prints the whole of it."""
    text = (PARTS / f"{name}.gcode").read_text()
    if tool is not None:
        text = text.replace("T1", f"T{tool}").replace("T0", f"T{tool}")
    return gcode.parse(text)


def part(learned: Learned, name: str, material: str) -> Composed:
    read = program(name, 0)
    return compose(learned, read, plan(read.moves, **MACHINE), PART, materials={0: material})


def percent(plant: Extruder, nominal: Extruder, u: np.ndarray, r: np.ndarray) -> float:
    on_off = flow(plant, r / nominal.gain, sample_time_s=TS) - r
    return 100 * float(np.linalg.norm(flow(plant, u, sample_time_s=TS) - r) / np.linalg.norm(on_off))


def one(plant: Extruder, name: str, rng: np.random.Generator) -> dict[str, float]:
    """All figures of one plant, keyed structure.composer."""
    nominal, learned = MATERIALS[name], learn(train(plant, name, rng), sample_time_s=TS)
    out = {}
    for structure in ("fig9", "tic_tac_toe", "dashes"):
        made = part(learned, structure, name)
        stream = made.streams[0]
        where = (learned.library, name, NOZZLE, made.tasks, made.lines, 0)
        commands = {
            "chosen": stream.u,
            "basis": basis.compose(learned.materials[0].chain.extruder, stream.r, sample_time_s=TS),
            "priority": priority(*where, samples=len(stream.r)),
            "superposition": superposition(*where, samples=len(stream.r)),
            "ilc": learned_trials(plant, nominal, stream.r, rng)[-1].u,
        }
        for composer, u in commands.items():
            out[f"{structure}.{composer}"] = percent(plant, nominal, u, stream.r)
        for prediction in made.predictions:
            out[f"{structure}.{prediction.composer}_predicted"] = prediction.median
        out[f"{structure}.over_ilc"] = out[f"{structure}.chosen"] - out[f"{structure}.ilc"]
        true = made._replace(streams=(stream._replace(y=flow(plant, stream.u, sample_time_s=TS)),))
        volumes = line_volumes(true, learned.library, bead_area_mm2=AREA)
        out[f"{structure}.line_volume"] = float(
            np.abs(volumes.error_percent[volumes.duration_s >= 0.4 - 1e-9]).max()
        )
    for label, r in {
        "pause_0.2": protocol(8.0, 0.2),
        "speed_0.5x": protocol(4.0, 0.6),
        "speed_1.5x": protocol(12.0, 0.6),
    }.items():
        out[f"{label}.basis"] = percent(
            plant, nominal, basis.compose(learned.materials[0].chain.extruder, r, sample_time_s=TS), r
        )
    return out


def family(plants: int, seeds: int, creep_share: float) -> dict:
    """Median and worst of every figure, per material."""
    table: dict[str, dict[str, list[float]]] = {name: {} for name in MATERIALS}
    for seed in range(seeds):
        rng = np.random.default_rng(100 + seed)
        for name, nominal in MATERIALS.items():
            for _ in range(plants):
                plant = draw(
                    rng,
                    gain=nominal.gain,
                    time_constant_s=nominal.time_constant_s,
                    steady_flow=AREA * SPEEDS[0],
                    creep_share=creep_share,
                )
                for key, value in one(plant, name, rng).items():
                    table[name].setdefault(key, []).append(value)
    return {
        name: {
            key: {"median": round(float(np.median(v)), 2), "worst": round(float(np.max(v)), 2)}
            for key, v in rows.items()
        }
        for name, rows in table.items()
    }


def bars(result: dict) -> dict:
    """Each bar beside the worst over plants, seeds and materials."""
    out = {}
    for place, label in enumerate(("no_creep", "creep_12_percent")):
        rows = result[label].values()
        for structure, bar in BARS.items():
            worst = max(
                row[f"{structure}.{'chosen' if f'{structure}.chosen' in row else 'basis'}"]["worst"]
                for row in rows
            )
            out[f"{label}.{structure}"] = {"worst": worst, "bar": bar[place]}
        for structure in ("tic_tac_toe", "dashes"):
            out[f"{label}.{structure}.over_ilc"] = {
                "worst": max(row[f"{structure}.over_ilc"]["worst"] for row in rows),
                "bar": 1.0,
            }
        out[f"{label}.line_volume"] = {
            "worst": max(
                row[f"{s}.line_volume"]["worst"] for row in rows for s in ("fig9", "tic_tac_toe", "dashes")
            ),
            "bar": 3.0,
        }
    return out


def saturations(plants: int) -> dict:
    """Forecast by the chain of the training against the true plant: the same command, and the model
    inverse learning under the same limit. Points of percent of on-off."""
    rng, rows = np.random.default_rng(7), []
    for name, nominal in MATERIALS.items():
        for _ in range(plants):
            plant = draw(
                rng, gain=nominal.gain, time_constant_s=nominal.time_constant_s, steady_flow=AREA * SPEEDS[0]
            )
            extruder = learn(train(plant, name, rng), sample_time_s=TS).materials[0].chain.extruder
            for ramp_s in (0.15, 0.3, 0.5, 1.0, 2.0):
                on = protocol(8.0, 0.6, 1e-9)
                r = basis.boxed(on, ramp_s, TS)
                for times in (3.0, 5.0, 10.0, 20.0):
                    drive = Drive(times * r.max() / nominal.gain, np.inf, 0.0)
                    predicted = saturation(
                        extruder, on, on_off_gain=nominal.gain, ramp_s=ramp_s, drive=drive, sample_time_s=TS
                    )
                    on_off = np.linalg.norm(
                        flow(plant, obeyed(r / nominal.gain, drive, sample_time_s=TS), sample_time_s=TS) - r
                    )
                    u = basis.compose(extruder, r, sample_time_s=TS, drive=drive)
                    forecast = predicted.rms_percent_of_on_off
                    same = 100 * np.linalg.norm(flow(plant, u, sample_time_s=TS, drive=drive) - r) / on_off
                    trials = learned_trials(plant, nominal, r, rng, drive=drive)
                    law = 100 * np.mean([np.linalg.norm(t.truth - r) for t in trials[-3:]]) / on_off
                    rows.append((name, ramp_s, times, forecast, float(same), float(law)))
    return {
        "worst_points_same_command": round(max(abs(row[3] - row[4]) for row in rows), 2),
        "worst_points_learning": round(max(abs(row[3] - row[5]) for row in rows), 2),
        "bar": 3.0,
        "rows": [[*row[:3], *(round(v, 2) for v in row[3:])] for row in rows],
    }


def sequences(programs: int) -> dict:
    """Random programs: no forbidden transition; those that would need
    Steady-State -> No-Flow are refused by line number."""
    from tests.deposition.test_tasks import random_tasks

    rng, forbidden_pairs, refused = np.random.default_rng(0), 0, 0
    for _ in range(programs):
        tasks = random_tasks(rng)
        refused += tasks is None
        forbidden_pairs += 0 if tasks is None else len(forbidden(tasks.task, tasks.tool))
    return {"programs": programs, "forbidden": forbidden_pairs, "refused": refused}


def job(lines: int) -> str:
    """A slicer's job: layers of short and long lines, tools in turn."""
    rng, text, x, y = np.random.default_rng(0), ["G21", "G90", "M83"], 0.0, 0.0
    for k in range(lines):
        if k % 2000 == 0:
            text += [f"T{k // 2000 % 2}", "G4 P3000"]
        travel = k % 9 == 0
        dx, dy = rng.uniform(-12, 12, 2) if travel else rng.uniform(-3, 3, 2)
        x, y = x + dx, y + dy
        text.append(
            f"G0 X{x:.3f} Y{y:.3f} F3000" if travel else f"G1 X{x:.3f} Y{y:.3f} E{np.hypot(dx, dy):.4f} F480"
        )
    return "\n".join(text)


def speed(learned: Learned) -> dict:
    """A job of 62,000 lines in two materials: reading, planning, composing, and the report."""
    text, times = job(62_000), []
    for _ in range(3):
        marks = [time.process_time()]
        read = gcode.parse(text)
        marks.append(time.process_time())
        motion = plan(read.moves, **MACHINE)
        marks.append(time.process_time())
        made = compose(learned, read, motion, PART, materials={0: "A", 1: "B"})
        marks.append(time.process_time())
        conform(
            made,
            learned,
            bead_area_mm2=AREA,
            ramp_s=RAMP,
            drive=UNLIMITED,
            shortest_s=0.4,
            largest_error_percent=20.0,
        )
        marks.append(time.process_time())
        times.append(np.diff(marks))
    best = np.min(times, axis=0)
    samples = len(made.streams[0].u)
    return {
        "samples": samples,
        **dict(zip(("parse_s", "plan_s", "compose_s", "conform_s"), best.round(3).tolist(), strict=True)),
        "bar_total_s": 2.0,
    }


def main() -> None:
    plants, seeds = (int(a) for a in sys.argv[1:3]) if len(sys.argv) > 2 else (14, 2)
    result = {"plants": plants, "seeds": seeds}
    rng = np.random.default_rng(1)
    learned = learn(
        [t for name, e in MATERIALS.items() for t in train(e._replace(delay_s=0.1, lag_hz=4.0), name, rng)],
        sample_time_s=TS,
    )
    result["speed"] = speed(learned)
    tasks = part(learned, "fig9", "A").tasks
    read = program("tic_tac_toe", None)
    crosses = compose(learned, read, plan(read.moves, **MACHINE), PART, materials={0: "A", 1: "B"})
    result["sequences"] = {
        "fig9_exact": tasks.task.tolist() == FIG_9,
        "tic_tac_toe_runs": int(crosses.lines.run[-1]) + 1,
        "tic_tac_toe_dwells": int(np.sum(crosses.tasks.task == DWELL)),
        **sequences(10_000),
    }
    result["no_creep"] = family(plants, seeds, 0.0)
    result["creep_12_percent"] = family(plants, seeds, 0.12)
    result["saturation"] = saturations(max(1, plants // 4))
    result["bars"] = bars(result)
    print(
        json.dumps(
            {**result, "saturation": {k: v for k, v in result["saturation"].items() if k != "rows"}}, indent=2
        )
    )
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
