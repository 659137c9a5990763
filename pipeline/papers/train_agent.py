"""The agent of Li and Pattinson (2025), trained in its own simulator by the best setting from the best seed
of search_agent: writes datasets/papers/train_agent/, which every loop, page and quick look reads.

`./run dvc repro datasets/papers/dvc.yaml:train_agent`; minutes. weights.safetensors: its network after each
phase; agents.parquet: the learning curves; figures.json: what it comes to. No recording changes it.
"""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.papers import made
from pipeline.papers.search_agent import TrainAgent, first_key, training
from pipeline.setpoint.agents import agent, claims
from pipeline.setpoint.agents.files import store_published
from pipeline.setpoint.published import ALPHA, DELTA, SIGMA
from pipeline.setpoint.simulation.simulator import FLOW_LIMITS, TEMPERATURE_LIMITS
from pipeline.setpoint.tables import AGENT_CURVE
from pipeline.store import artifacts, params
from pipeline.store.pins import check_pins

FOLDER = Path("datasets/papers/train_agent")
# points of a learning curve that a page has room for, of each phase
POINTS = 50


def learning_curve(published: agent.PublishedAgent) -> dict[str, list]:
    """Columns of schema AGENT_CURVE: the mean reward of a step over POINTS stretches of each phase."""
    points: list[tuple[str, int, int, float]] = []
    before = 0
    for i, rewards in enumerate(published.rewards):
        values = np.asarray(rewards, float)
        ends = np.unique(np.linspace(0, len(values), POINTS + 1).round().astype(int))
        points += [
            ("li_2025", i + 1, before + int(b), float(values[a:b].mean()))
            for a, b in itertools.pairwise(ends)
        ]
        before += len(values)
    names = ("agent", "phase", "update", "reward")
    return dict(zip(names, map(list, zip(*points, strict=True)), strict=True))


def figures(how: agent.PublishedTraining, networks: Sequence[agent.QNetwork]) -> dict[str, Any]:
    """The agent after three phases and after the last one, if the class is always right and if it is not, on
    the paper's simulator; what the paper claims of it; and what the paper does not print."""
    return claims.simulated_figures(networks) | {
        "parameters": {"li_2025": claims.parameters(networks[0])},
        "claims": claims.compare_starts(networks, accuracy=how.accuracy),
        "guesses": guesses(how),
    }


def guesses(how: agent.PublishedTraining) -> dict[str, Any]:
    """What the paper does not print and we set, by its name there or in words."""
    return {
        "delta": DELTA,
        "alpha": ALPHA,
        "sigma": SIGMA,
        "flow_limits_percent": list(FLOW_LIMITS),
        "target_limits_degC": list(TEMPERATURE_LIMITS),
        "target_at_the_start": "as the temperature",
        "updates_by_phase": list(how.updates),
        "environments": how.dqn.environments,
        "replay_capacity": how.dqn.capacity,
        "explore_by_phase": list(how.explore),
        "explore_least": how.least,
    }


def main() -> None:
    check_pins("train_agent")
    searched = artifacts.read_json("datasets/papers/search_agent.json")
    how = training(params.load(TrainAgent, "train_agent", params.PAPERS), searched["best"])
    published = agent.train_published(first_key(searched["seed"]), how)
    FOLDER.mkdir(parents=True, exist_ok=True)
    store_published(FOLDER / "weights.safetensors", published.networks)
    artifacts.write_table(FOLDER / "agents.parquet", AGENT_CURVE, learning_curve(published))
    artifacts.write_json(FOLDER / "figures.json", figures(how, published.networks))
    made.record("train_agent")


if __name__ == "__main__":
    main()
