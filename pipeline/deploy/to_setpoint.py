"""The setpoint loop's eyes and what decides there for a machine without jax: classifier.safetensors with
flow_reader.py, filter.safetensors with flow_filter.py, and of our agent agent.safetensors with
agent_reader.py. The readers need numpy only."""

import importlib.util
import math
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pipeline.deploy import agent_reader, flow_filter, flow_reader
from pipeline.setpoint.agents import agent, bayes, belief_agent
from pipeline.setpoint.agents.bayes import Filter
from pipeline.setpoint.agents.belief_agent import Belief, BeliefNetwork, belief_encoder
from pipeline.setpoint.published import (
    BEST_TEMPERATURE,
    DELTA,
    FLOW_MOVES,
    LAMBDA,
    PHASES,
    ROTATION,
    TEMPERATURE_MOVES,
)
from pipeline.setpoint.simulation.simulator import GOOD_BORDERS, STAND, TEMPERATURE_LIMITS, Observation
from pipeline.setpoint.vision.calibrated_classifier import CalibratedClassifier, read_frames
from pipeline.setpoint.vision.proof import may_judge, verdict
from pipeline.setpoint.vision.vision_transformer import named_arrays
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
    """Weights, form and calibration."""
    body, fitted = model.network.body, model.calibration
    return named_arrays(model.network) | {
        "patch": np.array(body.patch),
        "heads": np.array(body.blocks[0].heads),
        "layers": np.array(len(body.blocks)),
        "temperature": np.array(fitted.temperature),
        "flow_knots": np.log(np.array(KNOTS_PERCENT) / 100),
        "flow_shown": np.asarray(fitted.flow.shown, float),
        "flow_scale": np.asarray(fitted.flow.scale, float),
        "flow_correlation": np.array(fitted.flow.correlation),
        **{f"looks_{name}": np.asarray(value, float) for name, value in fitted.flow.looks._asdict().items()},
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


BELIEF = "our agent"  # sees what its own filter believes
FRAMES = 64  # drawn key areas on which reader and network are compared
DECISIONS = 200  # drawn windows, one after the other, on which reader and agent are compared
WHY = (
    "What sees and what decides have no certificate: evaluate_setpoint judged them with the camera's watch, "
    "held windows, waits and limits, which are not in these files."
)


def decider(name: str, parameters: Any, belief: Belief, network: BeliefNetwork) -> Decider | None:
    """What the default controller decides by: our agent by `belief` and `network`, another by its parameters;
    None if these are no filter."""
    if name == BELIEF:
        return BeliefAgent(belief, network)
    return parameters if isinstance(parameters, Filter) else None


def write_checked(
    folder: Path, name: str, model: CalibratedClassifier, decides: Decider | None, seed: int
) -> dict[str, Any]:
    """Writes the files, none if the classifier cannot judge its camera. Returns why there is no certificate,
    and how far the readers are from the networks."""
    why = "" if decides else f"{name} has no filter whose tables could be exported."
    if not may_judge(model.calibration.proof):
        why = f"The classifier {verdict(model.calibration.proof)}."
    if why or decides is None:
        return {"controller": name, "measured": False, "why": why, "largest_difference": {}}
    write(folder, weights(model, decides))
    difference = {"log_flow": of_reader(folder, model, np.random.default_rng(seed))}
    if isinstance(decides, BeliefAgent):
        difference["values"] = of_agent(folder, decides, np.random.default_rng(seed))
    return {"controller": name, "measured": True, "why": WHY, "largest_difference": difference}


def of_reader(folder: Path, model: CalibratedClassifier, rng: np.random.Generator) -> float:
    """The largest difference in log(flow / 100 %) between the exported reader and the network."""
    reader, weights = _reader(folder, "flow_reader.py", CLASSIFIER)
    images = rng.integers(0, 256, (FRAMES, 16, 48)).astype(np.float32)
    temperature = rng.uniform(180.0, 240.0, FRAMES).astype(np.float32)
    shown = reader.outputs(weights, images, temperature)[1]
    return float(np.abs(shown - np.asarray(read_frames(model, images, temperature).log_flow)).max())


def of_agent(folder: Path, agent: BeliefAgent, rng: np.random.Generator) -> float:
    """The largest difference in the values of actions between the exported reader and the agent over windows
    that follow one another, relative to the largest value."""
    reader, weights = _reader(folder, "agent_reader.py", AGENT)
    encoder = belief_encoder(agent.belief)

    @jax.jit
    def valued(memory, seen):
        memory, x = encoder.encode(agent.network, memory, seen)
        return memory, x[0] > 0, agent.network(x)

    memory, move, theirs, mine = encoder.start(), 0.0, [], []
    for t in range(DECISIONS):
        seen = drawn(rng, move, t)
        memory, rests, Q = valued(memory, seen)
        belief, u, target = np.asarray(memory.belief, float), float(seen.temperature), float(seen.target)
        theirs.append(np.asarray(Q))
        mine.append(reader.values(weights, belief, bool(rests), u, target, t))
        move = FLOW_MOVES[int(theirs[-1][0].argmax())]
    return float(np.abs(np.array(theirs) - mine).max() / np.abs(theirs).max())


def drawn(rng: np.random.Generator, move: float, step: int) -> Observation:
    """A window after a move of the flow, at random: every third shows classes only."""
    shares = rng.dirichlet([1.0, 2.0, 1.0])
    flow = float(rng.uniform(40.0, 200.0)) if step % 3 else np.nan
    u, target = rng.uniform(*TEMPERATURE_LIMITS, 2)
    numbers = (jnp.float32(number) for number in (flow, move, u, target))
    return Observation(
        jnp.asarray(shares, jnp.float32), jnp.int32(shares.argmax()), *numbers, jnp.int32(step)
    )


def _reader(folder: Path, code: str, weights: str) -> tuple[ModuleType, dict[str, np.ndarray]]:
    """An exported reader, and the arrays of its file as the exported reader of files reads them."""
    return _module(folder / code), _module(folder / "flow_reader.py").read_safetensors(folder / weights)


def _module(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
