"""The setpoint loop's exported readers against the networks and the filter that they stand for."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pipeline.runtime.export import flow_filter, flow_reader, setpoint
from pipeline.setpoint import bayes, classifier, window_flow
from pipeline.setpoint.calibrated_classifier import CalibratedClassifier
from pipeline.setpoint.calibration import Calibration, Familiar
from pipeline.setpoint.simulator import Observation
from pipeline.setpoint.vision_transformer import SMALL, convolutional, vision_transformer
from pipeline.setpoint.window_flow import KNOTS_PERCENT, FlowCalibration

WINDOWS, FRAMES = 1000, 2
# float32 through two layers: the sums are taken in another order
SINGLE = 1e-5
CLASS_FILTER = {
    "accuracy": 0.8,
    "hazard": 0.02,
    "move_cost": 0.1,
    "outside_cost": 5.0,
    "move_fixed_cost": 0.5,
}


@pytest.fixture(scope="module")
def model() -> CalibratedClassifier:
    knots = np.log(np.array(KNOTS_PERCENT) / 100)
    flow = FlowCalibration(0.8 * knots + 0.02, np.linspace(0.8, 1.4, len(knots)), 0.3)
    familiar = Familiar(np.zeros((3, 2)), np.eye(2))
    network = vision_transformer(SMALL, np.random.default_rng(1))
    return CalibratedClassifier(network, Calibration(1.3, 0.2, 0.1, familiar, 9.0, flow))


def written(model: CalibratedClassifier, folder: Path) -> tuple[dict, dict]:
    """Both files, read by the exported reader."""
    setpoint.write(folder, setpoint.exported(model, bayes.class_filter(**CLASS_FILTER)))
    files = ("classifier.safetensors", "filter.safetensors")
    first, second = (flow_reader.read_safetensors(folder / name) for name in files)
    return first, second


def test_a_thousand_windows_read_as_by_the_network(model, tmp_path):
    rng, n = np.random.default_rng(2), WINDOWS * FRAMES
    profile = 60 * np.exp(-(((np.arange(16) - 8) / rng.uniform(1, 6, n)[:, None]) ** 2))
    areas = np.clip(rng.normal(100, 20, (n, 16, 48)) + profile[:, :, None], 0, 255).astype(np.uint8)
    temperature = rng.uniform(180, 240, n)
    weights = written(model, tmp_path)[0]
    theirs = classifier.predict(model.network, areas, temperature)
    logits, log_flow, deviation = flow_reader.outputs(weights, areas, temperature)
    for one, other in ((logits, theirs.logits), (log_flow, theirs.log_flow), (deviation, theirs.deviation)):
        assert np.abs(one - other).max() < SINGLE
    frames = (theirs.log_flow.astype(float), theirs.deviation.astype(float))
    log_flow, deviation = (part.reshape(WINDOWS, FRAMES) for part in frames)
    seen = window_flow.window_flow(log_flow, deviation, np.ones_like(log_flow, bool), model.calibration.flow)
    for i in range(WINDOWS):
        flow, spread, prob = flow_reader.window(weights, log_flow[i], deviation[i])
        # doubles: the same formulas, with erfc in place of ndtr
        assert np.allclose((flow, spread), (seen.flow_seen[i], seen.spread[i]), rtol=1e-12)
        assert np.allclose(prob, seen.prob[i], atol=1e-12)


def test_the_filter_believes_and_moves_as_the_filter(model, tmp_path):
    tables = written(model, tmp_path)[1]
    parameters = bayes.class_filter(**CLASS_FILTER)
    step = jax.jit(lambda state, seen: bayes.filter_update(parameters, state, seen))
    losses = jax.jit(lambda state: bayes.expected_loss(parameters, state.belief))
    rng, state, mine, move = np.random.default_rng(3), bayes.initial_state(1), flow_filter.start(tables), 0.0
    for t in range(200):
        shares = rng.dirichlet([1, 3, 1] if t < 100 else [4, 1, 1])
        named, flow = int(shares.argmax()), float(rng.uniform(40, 180)) if t % 3 else np.nan
        numbers = (jnp.float32(number) for number in (flow, move, 210.0, 210.0))
        seen = Observation(jnp.asarray(shares, jnp.float32), jnp.int32(named), *numbers, jnp.int32(t))
        state = step(state, seen)
        mine = flow_filter.update(tables, mine, shares, named, flow, move)
        assert np.abs(np.asarray(state.belief) - mine["belief"]).max() < SINGLE
        loss = np.sort(np.asarray(losses(state)))
        move = float(bayes.FLOW_MOVES[int(np.asarray(losses(state)).argmin())])
        # where two moves cost the same in single precision either is best
        assert flow_filter.move(tables, mine) == move or loss[1] - loss[0] < 1e-4


def test_both_readers_need_numpy_and_the_language_only(model):
    made = setpoint.exported(model, bayes.class_filter(**CLASS_FILTER))
    for text in made.readers.values():
        assert set(re.findall(r"^(?:import|from) (\w+)", text, re.M)) <= {"json", "math", "numpy"}


def test_a_network_that_the_reader_does_not_know_is_refused(model):
    other = model._replace(network=convolutional(np.random.default_rng(1)))
    with pytest.raises(ValueError, match="knows a vision transformer but the classifier is a Convolutional"):
        setpoint.classifier_arrays(other)
