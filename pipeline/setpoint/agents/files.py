"""What train_agent leaves: the agents and the belief that the belief DQN reads, to one file and back."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from pipeline.setpoint.agents import agent, bayes
from pipeline.setpoint.agents.agent import QNetwork
from pipeline.setpoint.agents.belief_agent import Belief, BeliefNetwork
from pipeline.setpoint.simulation.simulator import CLASSES, HISTORY
from pipeline.store import artifacts
from pipeline.store.artifacts import read_weights, write_weights

AGENTS_SCHEMA, PUBLISHED_SCHEMA = "agents 2", "published agent 1"
# names of arrays in the file, which stay as they were first written: the belief network, and a field of the
# filter
OURS, FILE_NAMES = "ours", {"filter.window_repeat_probability": "filter.repeats"}


class Agents(NamedTuple):
    """The networks of Li and Pattinson (2025) after each phase; the belief, and the network that reads it."""

    li_2025: tuple[QNetwork, ...]
    belief: Belief
    belief_dqn: BeliefNetwork


def store_agents(path: Path, agents: Agents) -> None:
    """Every network, and the belief, by name in one file."""
    arrays = {
        f"phase{i + 1}.{name}": a
        for i, network in enumerate(agents.li_2025)
        for name, a in agent.weights(network).items()
    }
    arrays |= {f"{OURS}.{name}": a for name, a in agent.weights(agents.belief_dqn).items()} | {
        f"belief.{FILE_NAMES.get(name, name)}": a for name, a in agent.weights(agents.belief).items()
    }
    write_weights(path, AGENTS_SCHEMA, arrays, {"phases": str(len(agents.li_2025))})


def restore_agents(path: str) -> Agents:
    """What `store_agents` wrote."""
    arrays, about = read_weights(path, AGENTS_SCHEMA)
    with artifacts.about(path):
        parts = {
            name: _part(arrays, name)
            for name in [*(f"phase{i + 1}" for i in range(int(about["phases"]))), OURS, "belief"]
        }
        belief = {name: jnp.asarray(a) for name, a in parts.pop("belief").items()}
        model = bayes.Filter(
            *(
                belief[FILE_NAMES.get(name, name)]
                for name in (f"filter.{field}" for field in bayes.Filter._fields)
            )
        )
        hypotheses = model.evidence.shape[0]
        shapes = agent.untrained(lambda key: BeliefNetwork(hypotheses, key))
        network = agent.with_weights(shapes, parts.pop(OURS))
        li_2025 = tuple(_network(part) for part in parts.values())
        return Agents(li_2025, Belief(model, *(belief[name] for name in Belief._fields[1:])), network)


def store_published(path: Path, networks: Sequence[QNetwork], rewards: Sequence[jax.Array]) -> None:
    """The networks of Li and Pattinson (2025) after each phase, and the rewards of its steps, for a memo."""
    arrays = {
        f"phase{i + 1}.{name}": a for i, n in enumerate(networks) for name, a in agent.weights(n).items()
    }
    arrays |= {f"phase{i + 1}.rewards": np.asarray(r) for i, r in enumerate(rewards)}
    write_weights(path, PUBLISHED_SCHEMA, arrays, {"phases": str(len(networks))})


def restore_published(path: Path) -> agent.PublishedAgent:
    """What `store_published` wrote. Raises ValueError where the file is none."""
    arrays, about = read_weights(path, PUBLISHED_SCHEMA)
    with artifacts.about(path):
        parts = [_part(arrays, f"phase{i + 1}") for i in range(int(about["phases"]))]
        rewards = tuple(jnp.asarray(part.pop("rewards")) for part in parts)
        return agent.PublishedAgent(tuple(_network(part) for part in parts), rewards)


def _network(part: dict[str, np.ndarray]) -> QNetwork:
    """The network of these arrays, whose history is as long as they say."""
    numbers = np.shape(part.get("vision.weight", np.zeros((256, HISTORY + CLASSES))))
    shapes = agent.untrained(QNetwork, max(numbers[-1] - CLASSES, 1))
    return cast(QNetwork, agent.with_weights(shapes, part))


def _part(arrays: Mapping[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    return {key.removeprefix(f"{name}."): a for key, a in arrays.items() if key.startswith(f"{name}.")}
