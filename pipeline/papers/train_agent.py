"""The agent of Li and Pattinson (2025), trained in its own simulator by the best settings that search_agent
found: writes datasets/papers/train_agent/, which every loop, page and quick look reads.

`./run dvc repro datasets/papers/dvc.yaml:train_agent`; minutes. weights.safetensors: its network after each
phase; agents.parquet: the learning curves; figures.json: what it comes to. No recording changes it.
"""

import itertools
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
from pydantic import Field

from pipeline.papers import made
from pipeline.setpoint.agents import agent, claims
from pipeline.setpoint.agents.files import AGENT_FOLDER, store_published
from pipeline.setpoint.published import ALPHA, DELTA, SIGMA
from pipeline.setpoint.simulation.simulator import FLOW_LIMITS, TEMPERATURE_LIMITS
from pipeline.setpoint.tables import AGENT_CURVE
from pipeline.store import artifacts, params
from pipeline.store.params import Section

# points of a learning curve that a page has room for, of each phase
POINTS = 50


class Li2025(Section):
    """The agent of Li and Pattinson (2025): environments stepped together, batch, transitions remembered,
    steps of an episode, Adam's rate and the share of it left at the end of the last phase, discount, the
    target network's step; of each phase its updates, and how much is explored as it begins and in the end;
    accuracy of the last phase; classes of its history, eta."""

    environments: int = Field(ge=1, le=100_000)
    batch: int = Field(ge=1, le=100_000)
    capacity: int = Field(ge=1000, le=10_000_000)
    episode: int = Field(ge=10, le=10_000)
    learning_rate: float = Field(gt=0, le=1)
    rate_at_end: float = Field(gt=0, le=1)
    gamma: float = Field(ge=0, lt=1)
    tau: float = Field(gt=0, le=1)
    updates: list[Annotated[int, Field(ge=1, le=10_000_000)]] = Field(min_length=3, max_length=4)
    explore: list[Annotated[float, Field(ge=0, le=1)]] = Field(min_length=4, max_length=4)
    least: float = Field(ge=0, le=1)
    accuracy: float = Field(gt=0.25, le=1)
    history: int = Field(ge=1, le=1000)

    def training(self) -> agent.PublishedTraining:
        """These settings as the method takes them."""
        dqn = agent.DqnSettings(**self.model_dump(include={*agent.DqnSettings._fields}))
        numbers = self.model_dump(include={*agent.PublishedTraining._fields})
        numbers |= {"updates": tuple(self.updates), "explore": tuple(self.explore)}
        return agent.PublishedTraining(dqn=dqn, **numbers)


class TrainAgent(Section):
    """Section `train_agent`."""

    seed: int = Field(ge=0, le=2**31)
    li_2025: Li2025


def first_key(seed: int) -> jax.Array:
    """The key that training from this seed begins with."""
    return jax.random.fold_in(jax.random.key(seed), 0)


def learning_curve(settings: Li2025, published: agent.PublishedAgent) -> dict[str, list]:
    """Columns of schema AGENT_CURVE: the mean reward of a step over POINTS stretches of each phase."""
    points: list[tuple[str, int, int, float]] = []
    for i, rewards in enumerate(published.rewards):
        values, before = np.asarray(rewards, float), sum(settings.updates[:i])
        ends = np.unique(np.linspace(0, len(values), POINTS + 1).round().astype(int))
        points += [
            ("li_2025", i + 1, int(before + b), float(values[a:b].mean()))
            for a, b in itertools.pairwise(ends)
        ]
    names = ("agent", "phase", "update", "reward")
    return dict(zip(names, map(list, zip(*points, strict=True)), strict=True))


def figures(settings: TrainAgent, networks: tuple[agent.QNetwork, ...]) -> dict[str, Any]:
    """The agent after three phases and after the last one, if the class is always right and if it is not, on
    the paper's simulator; what the paper claims of it; and what the paper does not print."""
    own, key = settings.li_2025, jax.random.key(settings.seed + 2)
    deployed = own.accuracy if len(networks) > 3 else 1.0
    return claims.simulated_figures(networks) | {
        "parameters": {"li_2025": claims.parameters(networks[0])},
        "claims": claims.compare_starts(networks, key, accuracy=deployed, steps=own.episode),
        "guesses": guesses(own),
    }


def guesses(settings: Li2025) -> dict[str, Any]:
    """What the paper does not print and we set, by its name there or in words."""
    return {
        "delta": DELTA,
        "alpha": ALPHA,
        "sigma": SIGMA,
        "flow_limits_percent": list(FLOW_LIMITS),
        "target_limits_degC": list(TEMPERATURE_LIMITS),
        "target_at_the_start": "as the temperature",
        "updates_by_phase": settings.updates,
        "environments": settings.environments,
        "replay_capacity": settings.capacity,
        "explore_by_phase": settings.explore[: len(settings.updates)],
        "explore_least": settings.least,
    }


def main(folder: Path = AGENT_FOLDER) -> None:
    settings = params.load(TrainAgent, "train_agent", params.PAPERS)
    published = agent.train_published(first_key(settings.seed), settings.li_2025.training())
    folder.mkdir(parents=True, exist_ok=True)
    store_published(folder / "weights.safetensors", published.networks)
    curve = learning_curve(settings.li_2025, published)
    artifacts.write_table(folder / "agents.parquet", AGENT_CURVE, curve)
    artifacts.write_json(folder / "figures.json", figures(settings, published.networks))
    made.record("train_agent")


if __name__ == "__main__":
    main()
