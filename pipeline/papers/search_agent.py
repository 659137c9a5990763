"""What Li and Pattinson (2025) do not print of their fourth phase, searched: every setting of SEARCH from every
seed of SEEDS, all four phases, of the fourth the best checkpoint.

`./run dvc repro datasets/papers/dvc.yaml:search_agent` writes datasets/papers/search_agent.json; an hour. Runs
that the same code trained are taken from datasets/memo/search_agent. Setting and seed are chosen by validation
runs alone: those that are judged, from JUDGED_SEED, choose nothing.
"""

import itertools
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import joblib
import numpy as np

from pipeline.papers import files, made
from pipeline.papers.train_agent import Li2025, TrainAgent, first_key
from pipeline.setpoint.agents import agent, score
from pipeline.setpoint.published import PHASES
from pipeline.store import artifacts, params

MEMO = Path("datasets/memo/search_agent")
SEEDS = (1, 2, 3)
# exploration as each phase begins, episodes at once, and the share of the learning rate left at the end
SEARCH = {
    "explore": ([1.0, 0.3, 0.3, 0.3], [1.0, 0.3, 0.3, 1.0]),
    "environments": (8, 32),
    "rate_at_end": (1.0, 0.05),
}
LOOP = Path("pipeline/setpoint")
# the code that decides what an agent comes to, which sees no recorded window
CODE = (
    "agents/agent.py", "agents/criteria.py", "agents/score.py", "agents/trials.py", "simulation/simulator.py",
    "simulation/actuation.py", "published.py",
)  # fmt: skip


class SearchedRun(NamedTuple):
    """One setting from one seed: updates of phase 4 before its best checkpoint, as validation chose it, and
    the percent of validation runs that settle, and that settle and stay; the same of fresh runs, of the best
    checkpoint and of the phase's end."""

    updates: int
    validated_settled: float
    validated_stay: float
    settled: float
    stay: float
    settled_at_end: float
    stay_at_end: float


@cache
def third_phase(seed: int, training: agent.PublishedTraining) -> tuple[agent.DqnState, jax.Array]:
    """The train state after phase 3, and the key of all phases."""
    train_state, key = agent.begin_published(first_key(seed), training)
    for i in range(len(PHASES)):
        train_state = agent.published_phase(train_state, key, training, i).train_state
    return train_state, key


def searched_run(own: Li2025, seed: int) -> SearchedRun:
    """Phase 4 by these settings from this seed."""
    code = [made.code_digest((LOOP / name).read_text(encoding="utf-8")) for name in CODE]
    entry = MEMO / f"{joblib.hash((own.model_dump(), seed, code, jax.__version__))}.json"
    if entry.is_file():
        return SearchedRun(**artifacts.read_json(entry))
    training = own.training()
    # what phase 4 alone sees is left as it is for all, so that phases 1 to 3 are trained once
    shared = training._replace(rate_at_end=1.0, explore=(*training.explore[:3], 1.0))
    train_state, key = third_phase(seed, shared)
    result = agent.published_phase(train_state, key, training, len(PHASES))
    best = agent.best_checkpoint(result, key, training)
    shares = []
    for network in (best.network, result.train_state.network):
        path = agent.run_starts(network, accuracy=own.accuracy)
        told = score.judge(np.asarray(path.flow), np.asarray(path.temperature))
        shares += [told.settled.percent, told.stay.percent]
    updates = best.after * own.updates[-1] // agent.CHECKPOINTS
    run = SearchedRun(updates, best.settled, best.stay, *shares)
    MEMO.mkdir(parents=True, exist_ok=True)
    artifacts.write_json(entry, run._asdict())
    print(seed, own.explore[-1], own.environments, own.rate_at_end, run, flush=True)
    return run


def search(settings: Li2025) -> dict[str, Any]:
    """Every setting from every seed; the setting whose seeds stay most on average in validation, and of it
    the seed that stays most there."""
    grid = [dict(zip(SEARCH, values, strict=True)) for values in itertools.product(*SEARCH.values())]
    runs: list[list[SearchedRun]] = [[] for _ in grid]
    for seed in SEEDS:
        for changes, found in zip(grid, runs, strict=True):
            found.append(searched_run(settings.model_copy(update=changes), seed))
    rows: list[dict[str, Any]] = [
        changes | {name: [getattr(run, name) for run in found] for name in SearchedRun._fields}
        for changes, found in zip(grid, runs, strict=True)
    ]
    best = max(range(len(grid)), key=lambda k: np.mean(rows[k]["validated_stay"]))
    seed = int(np.argmax(rows[best]["validated_stay"]))
    of_all = {name: [value for row in rows for value in row[name]] for name in SearchedRun._fields}
    return {
        "settings": len(grid), "seeds": len(SEEDS), "updates": settings.updates[-1], "rows": rows,
        "best": grid[best] | {"seed": SEEDS[seed]},
        "kept": {name: rows[best][name][seed] for name in SearchedRun._fields},
        "best_least": min(rows[best]["stay"]), "best_most": max(rows[best]["stay"]),
        **{f"{name}_least": min(values) for name, values in of_all.items()},
        **{f"{name}_most": max(values) for name, values in of_all.items()},
    }  # fmt: skip


def main() -> None:
    files.write("search_agent", search(params.load(TrainAgent, "train_agent", params.PAPERS).li_2025))


if __name__ == "__main__":
    main()
