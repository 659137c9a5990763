"""The setpoint loop's eyes and what decides there for a machine without jax: classifier.safetensors with
flow_reader.py, filter.safetensors with flow_filter.py, and of our agent agent.safetensors with
agent_reader.py. The readers need numpy only."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.deploy import agent_reader, flow_filter, flow_reader
from pipeline.setpoint.agents import agent, bayes, belief_agent
from pipeline.setpoint.agents.belief_agent import Belief, BeliefNetwork
from pipeline.setpoint.published import (
    BEST_TEMPERATURE,
    DELTA,
    FLOW_MOVES,
    LAMBDA,
    PHASES,
    ROTATION,
    TEMPERATURE_MOVES,
)
from pipeline.setpoint.simulation.simulator import GOOD_BORDERS, STAND, TEMPERATURE_LIMITS
from pipeline.setpoint.vision.calibrated_classifier import CalibratedClassifier
from pipeline.setpoint.vision.vision_transformer import VisionTransformer, named_arrays
from pipeline.setpoint.vision.window_flow import KNOTS_PERCENT
from pipeline.store import artifacts

CLASSIFIER_SCHEMA, FILTER_SCHEMA, AGENT_SCHEMA = "flow classifier 1", "flow filter 1", "belief agent 1"
CLASSIFIER, FILTER, AGENT = (f"{name}.safetensors" for name in ("classifier", "filter", "agent"))
# each file of weights with its schema and its reader
FILES = {
    CLASSIFIER: (CLASSIFIER_SCHEMA, flow_reader),
    FILTER: (FILTER_SCHEMA, flow_filter),
    AGENT: (AGENT_SCHEMA, agent_reader),
}


class BeliefAgent(NamedTuple):
    """What our agent decides by: the belief that it sees, and its network."""

    belief: Belief
    network: BeliefNetwork


Decider = bayes.Filter | BeliefAgent
Weights = dict[str, dict[str, np.ndarray]]  # arrays by name, of each file of FILES that there is


def weights(model: CalibratedClassifier, decider: Decider) -> Weights:
    """Arrays of the classifier, of the filter, and of the agent where that decides."""
    if isinstance(decider, BeliefAgent):
        more = [filter_arrays(decider.belief.filter), agent_arrays(decider)]
    else:
        more = [filter_arrays(decider)]
    return dict(zip(FILES, [classifier_arrays(model), *more], strict=False))


def write(folder: str | Path, made: Weights) -> None:
    """Each file of weights, and its reader beside it."""
    for name, arrays in made.items():
        schema, reader = FILES[name]
        source = Path(str(reader.__file__))
        artifacts.write_weights(Path(folder) / name, schema, arrays, {"reader": source.name})
        artifacts.write_text(Path(folder) / source.name, source.read_text(encoding="utf-8"))


def classifier_arrays(model: CalibratedClassifier) -> dict[str, np.ndarray]:
    """Weights, form and calibration. Raises ValueError for a network that the reader does not know."""
    body = model.network.body
    if not isinstance(body, VisionTransformer):
        raise ValueError(
            f"the exported reader knows a vision transformer but the classifier is a {type(body).__name__}; "
            "train one with train_classifier.size small or paper"
        )
    fitted = model.calibration
    return named_arrays(model.network) | {
        "patch": np.array(body.patch),
        "heads": np.array(body.blocks[0].heads),
        "layers": np.array(len(body.blocks)),
        "temperature": np.array(fitted.temperature),
        "flow_knots": np.log(np.array(KNOTS_PERCENT) / 100),
        "flow_shown": np.asarray(fitted.flow.shown, float),
        "flow_scale": np.asarray(fitted.flow.scale, float),
        "flow_correlation": np.array(fitted.flow.correlation),
        "foreign_above": np.array(fitted.foreign_above),
        "means": np.asarray(fitted.familiar.means, float),
        "whitening": np.asarray(fitted.familiar.whitening, float),
    }


def filter_arrays(parameters: bayes.Filter) -> dict[str, np.ndarray]:
    """The filter's tables, and the grid, codes and moves that they are of."""
    tables = {
        name: np.asarray(value, float)
        for name, value in parameters._asdict().items()
        if np.all(np.isfinite(value))
    }
    return tables | {
        "grid": bayes.GRID,
        "grid_prior": bayes.PRIOR,
        "class_codes": np.array(bayes.CLASS_CODES),
        "levels": np.array(bayes.LEVELS),
        "faintest": np.array(bayes.FAINTEST),
        "first_good": np.array(bayes.FIRST_GOOD),
        "flow_code_width": np.array(float(bayes.FLOW_CODE_WIDTH)),
        "good_border": np.array(float(GOOD_BORDERS[0])),
        "corrections": np.asarray(bayes.CORRECTIONS, float),
        "begins": np.asarray(bayes.BEGINS),
        "flow_moves": np.array(FLOW_MOVES),
    }


def agent_arrays(of: BeliefAgent) -> dict[str, np.ndarray]:
    """The network's weights by name, what it starts from, and the moves, clock and scales that it knows."""
    a, b = PHASES[-1]
    layers = {
        f"{head}.layers": np.array(len(getattr(of.network, head).hidden)) for head in ("flow", "temperature")
    }
    return (
        agent.weights(of.network)
        | layers
        | {
            "values": np.asarray(of.belief.values, float),
            "slow_gamma": np.array(belief_agent.slower(float(of.belief.gamma))),
            "pooling": belief_agent.POOLING,
            "at_rest": np.array(belief_agent.AT_REST),
            "ahead": np.array(belief_agent.AHEAD),
            # reward (14) at q* is 2 / (1 + |u - u*| / width) - 1
            "reward_width": np.array(1 / math.hypot(math.sin(ROTATION) / a, math.cos(ROTATION) / b)),
            "best_temperature": np.array(BEST_TEMPERATURE),
            "temperature_scale": np.array(agent.TEMPERATURE_SCALE),
            "temperature_limits": np.array(TEMPERATURE_LIMITS),
            "temperature_moves": np.array(TEMPERATURE_MOVES),
            "flow_moves": np.array(FLOW_MOVES),
            "stand": np.array(STAND),
            "clock": np.array(LAMBDA),
            "delta": np.array(DELTA),
        }
    )
