"""The setpoint loop's classifier and the controller that decides there, written for a machine without jax,
and how far the exported readers are from the networks."""

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pipeline.deploy import to_setpoint
from pipeline.deploy.to_setpoint import BeliefAgent, Decider
from pipeline.setpoint.agents.bayes import Filter
from pipeline.setpoint.agents.belief_agent import Belief, BeliefNetwork, belief_encoder
from pipeline.setpoint.published import FLOW_MOVES
from pipeline.setpoint.simulation.simulator import TEMPERATURE_LIMITS, Observation
from pipeline.setpoint.vision.calibrated_classifier import CalibratedClassifier, read_frames

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


def write(
    folder: Path, name: str, model: CalibratedClassifier, decides: Decider | None, seed: int
) -> dict[str, Any]:
    """Writes the files of to_setpoint.write. Returns why there is no certificate, and how far the readers are
    from the networks."""
    if decides is None:
        why = f"{name} has no filter whose tables could be exported."
        return {"controller": name, "measured": False, "why": why, "largest_difference": {}}
    to_setpoint.write(folder, to_setpoint.weights(model, decides))
    difference = {"log_flow": of_reader(folder, model, np.random.default_rng(seed))}
    if isinstance(decides, BeliefAgent):
        difference["values"] = of_agent(folder, decides, np.random.default_rng(seed))
    return {"controller": name, "measured": True, "why": WHY, "largest_difference": difference}


def of_reader(folder: Path, model: CalibratedClassifier, rng: np.random.Generator) -> float:
    """The largest difference in log(flow / 100 %) between the exported reader and the network."""
    reader, weights = _reader(folder, "flow_reader.py", to_setpoint.CLASSIFIER)
    images = rng.integers(0, 256, (FRAMES, 16, 48)).astype(np.float32)
    temperature = rng.uniform(180.0, 240.0, FRAMES).astype(np.float32)
    shown = reader.outputs(weights, images, temperature)[1]
    return float(np.abs(shown - np.asarray(read_frames(model, images, temperature).log_flow)).max())


def of_agent(folder: Path, agent: BeliefAgent, rng: np.random.Generator) -> float:
    """The largest difference in the values of actions between the exported reader and the agent over windows
    that follow one another, relative to the largest value."""
    reader, weights = _reader(folder, "agent_reader.py", to_setpoint.AGENT)
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
