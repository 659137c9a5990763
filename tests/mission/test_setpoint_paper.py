"""The figures that Li and Pattinson 2025 print, made again by our methods, to the printed digit: sizes of the
networks, settings, the paper's own counts."""

import math
import tomllib

import jax
import numpy as np
import pytest

from pipeline.papers.search_agent import TrainAgent
from pipeline.setpoint.agents.agent import QNetwork
from pipeline.setpoint.published import LAMBDA, PHASES, ROTATION
from pipeline.setpoint.vision.vision_transformer import PAPER, parameters, vision_transformer
from pipeline.store import params


@pytest.fixture(scope="module")
def printed(root) -> dict[str, float]:
    """What tables 1 and 2 print, by the name of the entry."""
    paper = tomllib.loads((root / "datasets/papers/setpoint.toml").read_text(encoding="utf-8"))
    tables = [row["entries"] for row in paper["row"] if row["at"] in ("Table 1", "Table 2")]
    return {entry["name"]: entry["printed"] for entries in tables for entry in entries}


def test_the_networks_have_as_many_parameters_as_table_1_prints(printed):
    network = vision_transformer(PAPER, np.random.default_rng(0))
    assert parameters(network.head) == printed["Parameters of the head"]
    millions = round(parameters(network.body) / 1e6, 1)
    assert millions == printed["Parameters of the transformer, millions"]
    assert (PAPER.layers, PAPER.width, PAPER.patch[0], PAPER.heads) == tuple(
        printed[name] for name in ("Layers", "Hidden width", "Patch size, px", "Heads")
    )


def test_the_agent_is_trained_with_the_settings_of_table_2(printed, root):
    own = params.load(TrainAgent, "train_agent", root / params.PAPERS)
    network = QNetwork(jax.random.key(0))
    ours = {
        "Discount γ": own.gamma,
        "Soft update τ": own.tau,
        "Flow actions to one of temperature λ": LAMBDA,
        "Batch size": own.batch,
        "Learning rate": own.learning_rate,
        "Episode, steps": own.episode,
        "Semi-major axis a": PHASES[0][0],
        "Semi-minor axis b": PHASES[0][1],
        "Rotation, degrees": round(math.degrees(ROTATION)),
        "Former classes η": own.history,
        "Parameters of the network": sum(np.size(leaf) for leaf in jax.tree.leaves(network)),
    }
    assert ours == {name: printed[name] for name in ours}
