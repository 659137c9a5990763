"""Stores the networks of Li and Pattinson (2025) after each phase, which train_agent of the second pipeline
trains, in one file, and restores them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

import numpy as np

from pipeline.setpoint.agents import agent
from pipeline.setpoint.agents.agent import QNetwork
from pipeline.setpoint.simulation.simulator import CLASSES, HISTORY
from pipeline.store import artifacts
from pipeline.store.artifacts import read_weights, write_weights

PUBLISHED_SCHEMA = "published agent 1"


def store_published(path: Path, networks: Sequence[QNetwork]) -> None:
    """Writes the networks of Li and Pattinson (2025) after each phase."""
    arrays = {
        f"phase{i + 1}.{name}": a for i, n in enumerate(networks) for name, a in agent.weights(n).items()
    }
    write_weights(path, PUBLISHED_SCHEMA, arrays, {"phases": str(len(networks))})


def restore_published(path: Path | str) -> agent.PublishedAgent:
    """Returns the agent that `store_published` wrote, without rewards. Raises ValueError if the file holds
    none."""
    arrays, about = read_weights(path, PUBLISHED_SCHEMA)
    with artifacts.about(path):
        parts = [_part(arrays, f"phase{i + 1}") for i in range(int(about["phases"]))]
        return agent.PublishedAgent(tuple(_network(part) for part in parts), ())


def _network(part: dict[str, np.ndarray]) -> QNetwork:
    """Returns the network with these arrays; the length of its history follows from their shapes."""
    numbers = np.shape(part.get("vision.weight", np.zeros((256, HISTORY + CLASSES))))
    shapes = agent.untrained(QNetwork, max(numbers[-1] - CLASSES, 1))
    return cast(QNetwork, agent.with_weights(shapes, part))


def _part(arrays: Mapping[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    return {key.removeprefix(f"{name}."): a for key, a in arrays.items() if key.startswith(f"{name}.")}
