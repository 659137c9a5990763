"""Is the choice of the default the same on other segments, and do printed intervals hold?

`./run python -m benchmarks.setpoint_choice 12 200` (after `./run dvc repro evaluate_setpoint`) chooses the
default on 12 redraws of the segments to choose on, by the numbers of params.expert.yaml. Then it rolls out
a simple controller and the default on 200 redraws of the segments to judge on, as many runs on each as a
printed figure has, and counts by case how many of the 200 figures lie within the printed interval; Wilson's
of as many runs stands beside it. Writes benchmarks/results/setpoint_choice.json; 0 in place of either number
leaves there what was found before.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pipeline.setpoint import judging
from pipeline.setpoint.recorded import WindowTable
from pipeline.setpoint.workflow import contestants, evaluate_setpoint
from pipeline.setpoint.workflow.agent_files import restore_agents
from pipeline.setpoint.workflow.contestants import ControllerSpec
from pipeline.setpoint.workflow.settings import EvaluateSetpoint
from pipeline.setpoint.workflow.tables import WINDOWS
from pipeline.setpoint.workflow.windows import window_tables
from pipeline.statistics import wilson
from pipeline.store import artifacts, params

RESULTS = Path(__file__).parent / "results" / "setpoint_choice.json"
SIMPLE = "filtered proportional"
ASKED = ("recorded, sticky, half clog", "in band", "recorded, sticky, clog")


def redraw(table: WindowTable, seed: int) -> WindowTable:
    return judging.redraw(table, np.random.default_rng([2000, seed]))


def choices(
    specs: dict[str, ControllerSpec], table: WindowTable, settings: EvaluateSetpoint, redraws: int
) -> list[dict[str, Any]]:
    found = []
    drawn = [redraw(table, seed) for seed in range(redraws)]
    room = judging.room(drawn) if drawn else 0  # one program for all
    for seed, one in enumerate(drawn):
        choice = evaluate_setpoint.chosen(specs, one, settings, room=room)
        found.append({"name": choice.name, "margin": choice.margin, "sentence": choice.sentence})
        print(f"redraw {seed}: {choice.sentence}", flush=True)
        # a run that is stopped keeps what it found
        keep({"redraws": len(found), "choices": found, "same": None})
    return found


def held(
    spec: ControllerSpec, table: WindowTable, settings: EvaluateSetpoint, repeats: int
) -> dict[str, dict[str, float]]:
    """Percent of repeated figures within the printed interval, and within Wilson's."""
    name, redraws, room = "controller", settings.redraws * settings.rounds, judging.room([table])
    printed = evaluate_setpoint.contest({name: spec}, table, settings, name, room=room).scores[name]
    cases = judging.all_cases(settings.runs, segment_mean_decisions=settings.segment_mean_decisions)
    rows = {}
    for number, case in enumerate(ASKED):
        again = []
        for repeat in range(repeats):
            one = judging.redrawn(table, 1, np.random.default_rng([3000, repeat]), room=room)
            keys = jax.random.split(jax.random.fold_in(jax.random.key(repeat), number), redraws)
            same = one._replace(table=jax.tree.map(lambda leaf: np.repeat(leaf, redraws, axis=0), one.table))
            of = judging.ask(spec.controller, spec.parameters, cases[case], same, keys)
            again.append(100.0 * float((of.stay if judging.counts(case) else of.beyond[:, 0]).mean()))
        told = printed[case].stay if judging.counts(case) else printed[case].beyond[0]
        plain = wilson(np.arange(printed[case].runs) < round(told.percent / 100 * printed[case].runs))
        rows[case] = {
            "percent": told.percent, "low": told.low, "high": told.high, "runs": printed[case].runs,
            "deviation": float(np.std(again)),
            "held": 100.0 * float(np.mean([told.low <= share <= told.high for share in again])),
            "held_by_wilson": 100.0 * float(np.mean([plain.low <= share <= plain.high for share in again])),
        }  # fmt: skip
        print(case, rows[case], flush=True)
    return rows


def keep(results: dict[str, Any]) -> None:
    """These beside what the file has of earlier runs."""
    before = json.loads(RESULTS.read_text()) if RESULTS.is_file() else {}
    RESULTS.write_text(json.dumps(before | results, indent=1) + "\n")


def main(redraws: int, repeats: int) -> None:
    settings = params.load(EvaluateSetpoint, "evaluate_setpoint")
    tables = window_tables(artifacts.read_table("datasets/train_classifier/windows.parquet", WINDOWS))
    agents = restore_agents("datasets/train_agent/weights.safetensors")
    specs = contestants.controllers(contestants.Problem(settings.baselines, agents, tables["learn"]))
    default = json.loads(Path("datasets/evaluate_setpoint/choice.json").read_text())["name"]
    if redraws:
        began = time.process_time()
        found = choices(specs, tables["choose"], settings, redraws)
        cost = (time.process_time() - began) / redraws
        same = sum(row["name"] == default for row in found)
        keep({"default": default, "same": same, "choice_cpu_s": round(cost, 1)})
    rows: dict[str, Any] = {}
    for name in dict.fromkeys((SIMPLE, default)) if repeats else ():
        rows[name] = held(specs[name], tables["judge"], settings, repeats)
        keep({"repeats": repeats, "held": rows})


if __name__ == "__main__":
    main(*(int(argument) for argument in sys.argv[1:3]) if len(sys.argv) > 2 else (12, 200))
