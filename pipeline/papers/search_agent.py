"""Searches the values that Li and Pattinson (2025) do not give for their fourth phase: every setting of
SEARCH from every seed of SEEDS, all four phases, and the best checkpoint of the fourth.

`./run dvc repro datasets/papers/dvc.yaml:search_agent` writes datasets/papers/search_agent.json, from which
train_agent takes setting and seed; it takes an hour. Runs that the same code has trained are kept in
datasets/memo/search_agent. Only validation runs choose checkpoint, setting and seed. The runs by which an
agent is judged choose nothing.
"""

import itertools
from functools import cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple, cast

import jax
import joblib
import numpy as np
from pydantic import Field

from pipeline.papers import files, made
from pipeline.setpoint.agents import agent, score
from pipeline.setpoint.published import PHASES
from pipeline.store import artifacts, params
from pipeline.store.params import Section
from pipeline.store.pins import check_pins

MEMO = Path("datasets/memo/search_agent")
SEEDS = (1, 2, 3)
# exploration as each phase begins, episodes at once, and the share of the learning rate left at the end
SEARCH: dict[str, tuple[Any, ...]] = {
    "explore": ([1.0, 0.3, 0.3, 0.3], [1.0, 0.3, 0.3, 1.0]),
    "environments": (8, 32),
    "rate_at_end": (1.0, 0.05),
}
LOOP = Path("pipeline/setpoint")
# the code that decides the results of an agent; it sees no recorded window
CODE = (
    "agents/agent.py", "agents/criteria.py", "agents/score.py", "agents/trials.py", "simulation/simulator.py",
    "simulation/actuation.py", "published.py",
)  # fmt: skip


class TrainAgent(Section):
    """Section `train_agent`, the agent of Li and Pattinson (2025) without the searched values: batch,
    transitions remembered, steps of an episode, Adam's rate, discount, the target network's step, updates of
    each phase, exploration in the end, accuracy of the last phase, classes of its history (eta)."""

    batch: int = Field(ge=1, le=100_000)
    capacity: int = Field(ge=1000, le=10_000_000)
    episode: int = Field(ge=10, le=10_000)
    learning_rate: float = Field(gt=0, le=1)
    gamma: float = Field(ge=0, lt=1)
    tau: float = Field(gt=0, le=1)
    updates: list[Annotated[int, Field(ge=1, le=10_000_000)]] = Field(min_length=4, max_length=4)
    least: float = Field(ge=0, le=1)
    accuracy: float = Field(gt=0.34, le=1)
    history: int = Field(ge=1, le=1000)


def training(settings: TrainAgent, chosen: dict[str, Any]) -> agent.PublishedTraining:
    """Returns these settings with a choice of SEARCH, in the form that the method takes."""
    numbers = settings.model_dump() | chosen
    numbers |= {name: tuple(numbers[name]) for name in ("updates", "explore")}
    dqn = agent.DqnSettings(**{name: numbers[name] for name in agent.DqnSettings._fields})
    own = {name: numbers[name] for name in agent.PublishedTraining._fields if name in numbers}
    return agent.PublishedTraining(dqn=dqn, **own)


def first_key(seed: int) -> jax.Array:
    """Returns the key with which training from this seed begins."""
    return jax.random.fold_in(jax.random.key(seed), 0)


class SearchedRun(NamedTuple):
    """One setting from one seed. `updates`: updates of phase 4 before its best checkpoint, chosen by
    validation; the percentage of validation runs that settle, and that settle and stay; the same of fresh
    runs, for the best checkpoint and for the end of the phase."""

    updates: int
    validated_settled: float
    validated_stay: float
    settled: float
    stay: float
    settled_at_end: float
    stay_at_end: float


@cache
def third_phase(seed: int, how: agent.PublishedTraining) -> tuple[agent.DqnState, jax.Array]:
    """Returns the train state after phase 3, and the key of all phases."""
    train_state, key = agent.begin_published(first_key(seed), how)
    for i in range(len(PHASES)):
        train_state = agent.published_phase(train_state, key, how, i).train_state
    return train_state, key


def searched_run(settings: TrainAgent, chosen: dict[str, Any], seed: int) -> SearchedRun:
    """Trains all phases with these settings from this seed."""
    code = [made.code_digest((LOOP / name).read_text(encoding="utf-8")) for name in CODE]
    digest = joblib.hash((settings.model_dump() | chosen, seed, code, jax.__version__))
    entry = MEMO / f"{digest}.json"
    if entry.is_file():
        return SearchedRun(**artifacts.read_json(entry))
    how = training(settings, chosen)
    # settings that only phase 4 uses are the same here for all, so that phases 1 to 3 are trained once
    shared = how._replace(rate_at_end=1.0, explore=(*how.explore[:3], 1.0))
    train_state, key = third_phase(seed, shared)  # ty: ignore[invalid-argument-type]
    result = agent.published_phase(train_state, key, how, len(PHASES))
    best = agent.best_checkpoint(result, key, how)
    shares = []
    for network in (best.network, cast(agent.QNetwork, result.train_state.network)):
        path = agent.run_starts(network, accuracy=how.accuracy)
        told = score.judge(np.asarray(path.flow), np.asarray(path.temperature))
        shares += [told.settled.percent, told.stay.percent]
    updates = best.after * how.updates[-1] // agent.CHECKPOINTS
    run = SearchedRun(updates, best.settled, best.stay, *shares)
    MEMO.mkdir(parents=True, exist_ok=True)
    artifacts.write_json(entry, run._asdict())
    print(seed, chosen, run, flush=True)
    return run


def search(settings: TrainAgent) -> dict[str, Any]:
    """Runs every setting from every seed. Returns the setting whose seeds stay most on average in validation,
    and its seed that stays most there."""
    grid = [dict(zip(SEARCH, values, strict=True)) for values in itertools.product(*SEARCH.values())]
    runs: list[list[SearchedRun]] = [[] for _ in grid]
    for seed in SEEDS:
        for chosen, found in zip(grid, runs, strict=True):
            found.append(searched_run(settings, chosen, seed))
    rows: list[dict[str, Any]] = [
        chosen | {name: [getattr(run, name) for run in found] for name in SearchedRun._fields}
        for chosen, found in zip(grid, runs, strict=True)
    ]
    best = max(rows, key=lambda row: np.mean(row["validated_stay"]))
    k = int(np.argmax(best["validated_stay"]))
    ends = {
        f"{name}_{end.__name__}": end(value for row in rows for value in row[name])
        for name in ("settled", "stay", "stay_at_end")
        for end in (min, max)
    }
    return {
        "settings": len(grid), "seeds": len(SEEDS), "updates": settings.updates[-1], "rows": rows,
        "best": {name: best[name] for name in SEARCH}, "seed": SEEDS[k],
        "kept": {name: best[name][k] for name in SearchedRun._fields},
        "best_stay_min": min(best["stay"]), "best_stay_max": max(best["stay"]), **ends,
    }  # fmt: skip


def main() -> None:
    # another order of sums, another agent: the last digits of a step decide what a phase ends at
    check_pins("search_agent")
    files.write("search_agent", search(params.load(TrainAgent, "train_agent", params.PAPERS)))


if __name__ == "__main__":
    main()
