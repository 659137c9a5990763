"""What train_agent leaves: the agents and the belief that ours sees, to one file and back."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pipeline.setpoint import agent, bayes
from pipeline.setpoint.agent import QNetwork
from pipeline.setpoint.belief_agent import Belief, BeliefNetwork
from pipeline.store import artifacts
from pipeline.store.artifacts import read_weights, write_weights

AGENTS_SCHEMA = "agents 2"


class Agents(NamedTuple):
    """The paper's networks after each phase, our belief and network."""

    paper: tuple[QNetwork, ...]
    belief: Belief
    ours: BeliefNetwork


def store_agents(path: Path, done: Agents) -> None:
    """Every network, and our belief, by name in one file."""
    arrays = {
        f"phase{i + 1}.{name}": a
        for i, network in enumerate(done.paper)
        for name, a in agent.weights(network).items()
    }
    arrays |= {f"ours.{name}": a for name, a in agent.weights(done.ours).items()} | {
        f"belief.{name}": a for name, a in agent.weights(done.belief).items()
    }
    write_weights(path, AGENTS_SCHEMA, arrays, {"phases": str(len(done.paper))})


def restore_agents(path: str) -> Agents:
    """What `store_agents` wrote."""
    arrays, about = read_weights(path, AGENTS_SCHEMA)
    with artifacts.about(path):
        parts = {
            name: _part(arrays, name)
            for name in [*(f"phase{i + 1}" for i in range(int(about["phases"]))), "ours", "belief"]
        }
        found = parts.pop("belief")
        hypotheses = found["filter.evidence"].shape[0]
        numbers = {name: jnp.asarray(a) for name, a in found.items()}
        model = bayes.Filter(*(numbers[f"filter.{name}"] for name in bayes.Filter._fields))
        ours = agent.with_weights(BeliefNetwork(hypotheses, jax.random.key(0)), parts.pop("ours"))
        paper = tuple(agent.with_weights(QNetwork(jax.random.key(0)), part) for part in parts.values())
        return Agents(paper, Belief(model, *(numbers[name] for name in Belief._fields[1:])), ours)


def _part(arrays: Mapping[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    return {key.removeprefix(f"{name}."): a for key, a in arrays.items() if key.startswith(f"{name}.")}
