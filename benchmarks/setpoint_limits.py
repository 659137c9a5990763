"""What holds the robust filter below its bars: the same filter told what it cannot know.

`./run python -m benchmarks.setpoint_limits` (after `./run dvc repro train_agent`) plays it on 12 redraws of
the segments to judge on: as deployed; told at which decision the nozzle clogs (there its belief jumps for
certain); without the watch that takes a camera for another; without a fixed cost of a correction; and with
the table of the very segments that it is judged on. Writes benchmarks/results/setpoint_limits.json.
"""

import json
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pipeline.setpoint import bayes, judging
from pipeline.setpoint.score import BEYOND, CLOG_STEP
from pipeline.setpoint.simulator import Controller, Observation
from pipeline.setpoint.workflow import contestants
from pipeline.setpoint.workflow.agent_files import restore_agents
from pipeline.setpoint.workflow.settings import EvaluateSetpoint
from pipeline.setpoint.workflow.tables import WINDOWS
from pipeline.setpoint.workflow.windows import window_tables
from pipeline.store import artifacts, params

RESULTS = Path(__file__).parent / "results" / "setpoint_limits.json"
FILTER, REDRAWS = "Bayes, robust", 12
CLOGS, GOOD = ("recorded, fresh, clog", "recorded, sticky, half clog"), "in band"


class Told(NamedTuple):
    """The filter, and whether it is told of the clog: 1, or 0."""

    filter: bayes.Filter
    knows: jax.Array


def informed(hypotheses: int) -> Controller:
    """The filter's controller with parameters `Told`: the update of the first window after the clog is made
    as if the flow had jumped for certain."""
    plain = bayes.bayes(hypotheses)

    def act(told: Told, state: bayes.FilterState, observation: Observation, key: jax.Array):
        now = (told.knows > 0) & (observation.step == CLOG_STEP + 1)
        hazard = jnp.where(now, 1.0, told.filter.hazard)
        return plain.act(told.filter._replace(hazard=hazard), state, observation, key)

    return Controller(plain.start, act, lambda told, state: bayes.strange(told.filter, state))


def variants(learned: bayes.Filter, of_judged: bayes.Filter) -> dict[str, bayes.Filter]:
    """The filter as deployed, and with less to lose or more to know."""
    unwatched = {"unlikely_limit": float("inf"), "likely_limit": float("inf")}
    return {
        "as deployed": learned,
        "without the watch": learned._replace(**unwatched),
        "without watch and fixed cost": learned._replace(**unwatched, move_fixed_cost=0.0),
        "the table of the judged segments": of_judged,
        "their table, without the watch": of_judged._replace(**unwatched),
    }


def main() -> None:
    settings = params.load(EvaluateSetpoint, "evaluate_setpoint")
    tables = window_tables(artifacts.read_table("datasets/train_classifier/windows.parquet", WINDOWS))
    agents = restore_agents("datasets/train_agent/weights.safetensors")
    learned, of_judged = (
        contestants.controllers(contestants.Problem(settings.baselines, agents, tables[name]))[
            FILTER
        ].parameters
        for name in ("learn", "judge")
    )
    controller = informed(len(learned.gains))
    recorded = judging.redrawn(tables["judge"], REDRAWS, np.random.default_rng([settings.seed, 1]))
    cases = judging.all_cases(settings.runs, segment_mean_decisions=settings.segment_mean_decisions)
    keys, rows = jax.random.split(jax.random.key(5), REDRAWS), []
    for name, filter_ in variants(learned, of_judged).items():
        for case, knows in [(case, knows) for case in CLOGS for knows in (0, 1)] + [(GOOD, 0)]:
            told = Told(jax.tree.map(jnp.asarray, filter_), jnp.int32(knows))
            of = judging.ask(controller, told, cases[case], recorded, keys)
            shares = {"settled": of.settled, "stay": of.stay} if judging.counts(case) else {
                f"beyond_{points}": beyond for points, beyond in zip(BEYOND, of.beyond.T, strict=True)
            }  # fmt: skip
            rows.append(
                {"filter": name, "case": case, "told_of_the_clog": bool(knows), "runs": len(of.flow)}
                | {figure: round(100.0 * float(share.mean()), 1) for figure, share in shares.items()}
            )
            print(rows[-1], flush=True)
    RESULTS.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
