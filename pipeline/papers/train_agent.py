"""Trains the agent of Li and Pattinson (2025) in its own simulator, with the best setting and the best seed
of search_agent. Writes datasets/papers/train_agent/, which every loop, page and quick look reads. The stored
agent is kept if more of its validation runs stay, because a paper is judged by its best known agent.

`./run dvc repro datasets/papers/dvc.yaml:train_agent`; it takes minutes. weights.safetensors: its network
after each phase; agents.parquet: the learning curves; figures.json: its results. No recording changes it.
"""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pipeline.papers import made
from pipeline.papers.search_agent import TrainAgent, first_key, training
from pipeline.setpoint.agents import agent, claims, trials
from pipeline.setpoint.agents.files import restore_published, store_published
from pipeline.setpoint.published import ALPHA, DELTA, SIGMA
from pipeline.setpoint.simulation.simulator import FLOW_LIMITS, TEMPERATURE_LIMITS
from pipeline.setpoint.tables import AGENT_CURVE
from pipeline.store import artifacts, params
from pipeline.store.pins import check_pins

FOLDER = Path("datasets/papers/train_agent")
# seed of the runs that choose between the trained and the stored agent
VALIDATED_SEED = 20
# points of a learning curve that a page has room for, of each phase
POINTS = 50


def learning_curve(published: agent.PublishedAgent) -> dict[str, list]:
    """Returns the columns of schema AGENT_CURVE: the mean reward of a step over POINTS stretches of each
    phase."""
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
    """Returns figures of the agent after three phases and after the last one on the paper's simulator, if the
    class is always right and if it is not; the paper's claims about it; and the values that the paper does
    not give."""
    return claims.simulated_figures(networks) | {
        "parameters": {"li_2025": claims.parameters(networks[0])},
        "claims": claims.compare_starts(networks, accuracy=how.accuracy),
        "guesses": guesses(how),
    }


def guesses(how: agent.PublishedTraining) -> dict[str, Any]:
    """Returns the values that the paper does not give and that we set, by their name there or in words."""
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


def validated_stay(network: agent.QNetwork, key: jax.Array, how: agent.PublishedTraining) -> float:
    """Returns the percentage of the validation runs, with random numbers of their own, that settle and
    stay."""
    conditions = trials.starts(agent.VALIDATION_RUNS, accuracy=how.accuracy)
    windows = agent.paper_windows()
    return trials.evaluate(agent.published(network), network, windows, conditions, key).stay.percent


def main() -> None:
    check_pins("train_agent")
    searched = artifacts.read_json("datasets/papers/search_agent.json")
    how = training(params.load(TrainAgent, "train_agent", params.PAPERS), searched["best"])
    path, key = FOLDER / "weights.safetensors", jax.random.key(VALIDATED_SEED)
    published = agent.train_published(first_key(searched["seed"]), how)
    networks, stay = published.networks, validated_stay(published.networks[-1], key, how)
    kept: dict[str, Any] = {
        "kept_from": "this search",
        "validated_stay": stay,
        "validated_stay_searched": stay,
    }
    if path.is_file():
        known = restore_published(path).networks
        if (known_stay := validated_stay(known[-1], key, how)) > stay:
            networks, kept["guesses"] = known, artifacts.read_json(FOLDER / "figures.json")["guesses"]
            kept |= {"kept_from": "an earlier search", "validated_stay": known_stay}
    FOLDER.mkdir(parents=True, exist_ok=True)
    if networks is published.networks:
        store_published(path, networks)
        artifacts.write_table(FOLDER / "agents.parquet", AGENT_CURVE, learning_curve(published))
    artifacts.write_json(FOLDER / "figures.json", figures(how, networks) | kept)
    made.record("train_agent")


if __name__ == "__main__":
    main()
