"""The setpoint loop's exported readers against the networks and the filter that they stand for."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pipeline.commands import export
from pipeline.deploy import agent_reader, flow_filter, flow_reader, to_setpoint
from pipeline.setpoint.agents import agent, bayes, belief_agent
from pipeline.setpoint.frames.familiar import NAMES
from pipeline.setpoint.published import FLOW_MOVES, TEMPERATURE_MOVES
from pipeline.setpoint.simulation.simulator import TEMPERATURE_LIMITS, Observation
from pipeline.setpoint.vision import classifier, window_flow
from pipeline.setpoint.vision.calibrated_classifier import CalibratedClassifier
from pipeline.setpoint.vision.calibration import ClassifierCalibration, Familiar
from pipeline.setpoint.vision.proof import CameraProof
from pipeline.setpoint.vision.vision_transformer import SMALL, vision_transformer
from pipeline.setpoint.vision.window_flow import KNOTS_PERCENT, FlowCalibration
from pipeline.store import artifacts

PROVEN = CameraProof(0.9, 0.8, 0.6, 400, 40, 400, False)
WINDOWS, FRAMES = 1000, 2
FEATURES = 114  # of the last layer
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
    measures = np.linspace(1.0, 2.0, len(NAMES))
    looks = window_flow.LookCorrection(measures, measures / 10, 0.02 * np.sin(10 * measures), 0.05)
    flow = FlowCalibration(0.8 * knots + 0.02, np.linspace(0.8, 1.4, len(knots)), 0.3, looks)
    familiar = Familiar(np.zeros((3, FEATURES)), np.eye(FEATURES))
    network = vision_transformer(SMALL, np.random.default_rng(1))
    return CalibratedClassifier(network, ClassifierCalibration(1.3, familiar, 9.0, flow, PROVEN))


def written(model: CalibratedClassifier, folder: Path) -> tuple[dict, dict]:
    """Both files, read by the exported reader."""
    to_setpoint.write(folder, to_setpoint.weights(model, bayes.class_filter(**CLASS_FILTER)))
    files = ("classifier.safetensors", "filter.safetensors")
    first, second = (flow_reader.read_safetensors(folder / name) for name in files)
    return first, second


def test_of_a_camera_that_cannot_be_judged_nothing_is_exported_and_it_is_said_why(model, tmp_path):
    decides = bayes.class_filter(**CLASS_FILTER)
    fitted = model.calibration._replace(proof=PROVEN._replace(low=0.5))
    said = to_setpoint.write_checked(tmp_path, "Bayes", model._replace(calibration=fitted), decides, 1)
    assert not said["measured"] and said["why"].startswith(
        "The classifier cannot judge this camera: right in 90 %"
    )
    assert not list(tmp_path.iterdir())
    assert to_setpoint.write_checked(tmp_path, "Bayes", model, decides, 1)["measured"]


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
    looks = rng.normal(1.5, 0.5, (WINDOWS, len(NAMES)))
    looks[::3] = np.nan
    valid = np.ones_like(log_flow, bool)
    seen = window_flow.window_flow(log_flow, deviation, valid, looks, model.calibration.flow)
    for i in range(WINDOWS):
        known = None if i % 6 == 0 else looks[i]
        flow, spread, prob = flow_reader.window(weights, log_flow[i], deviation[i], known)
        # doubles: the same formulas, with erfc in place of ndtr
        assert np.allclose((flow, spread), (seen.flow_seen[i], seen.spread[i]), rtol=1e-12)
        assert np.allclose(prob, seen.prob[i], atol=1e-12)


def test_the_filter_believes_and_moves_as_the_filter(model, tmp_path):
    tables = written(model, tmp_path)[1]
    parameters = bayes.class_filter(**CLASS_FILTER)
    step = jax.jit(lambda state, seen: bayes.filter_update(parameters, state, seen))
    losses = jax.jit(lambda state, last: bayes.expected_loss(parameters, state.belief, last))
    rng, state, mine, move = np.random.default_rng(3), bayes.initial_state(1), flow_filter.start(tables), 0.0
    for t in range(200):
        shares = rng.dirichlet([1, 3, 1] if t < 100 else [4, 1, 1])
        named, flow = int(shares.argmax()), float(rng.uniform(40, 180)) if t % 3 else np.nan
        numbers = (jnp.float32(number) for number in (flow, move, 210.0, 210.0))
        seen = Observation(jnp.asarray(shares, jnp.float32), jnp.int32(named), *numbers, jnp.int32(t))
        state = step(state, seen)
        mine = flow_filter.update(tables, mine, shares, named, flow, move)
        assert np.abs(np.asarray(state.belief) - mine["belief"]).max() < SINGLE
        loss = np.asarray(losses(state, move))
        mine_now = flow_filter.move(tables, mine, move)
        move = float(bayes.FLOW_MOVES[int(loss.argmin())])
        # where two moves cost the same in single precision either is best
        assert mine_now == move or np.diff(np.sort(loss)[:2]) < 1e-4


def test_a_correction_that_goes_on_has_paid_its_fixed_cost():
    """Two steps of a correction cost move_fixed_cost once: with a belief between, only what goes on moves."""
    parameters = bayes.class_filter(**CLASS_FILTER | {"move_fixed_cost": 8.0, "outside_cost": 0.0})
    tables = to_setpoint.filter_arrays(parameters)
    belief = np.where(bayes.GRID == 95.0, 1.0, 0.0)[None]
    state = flow_filter.start(tables) | {"belief": belief}
    for last, expected in ((0.0, 0.0), (-5.0, 0.0), (5.0, 5.0)):
        loss = bayes.expected_loss(parameters, jnp.asarray(belief, jnp.float32), last)
        assert FLOW_MOVES[int(loss.argmin())] == flow_filter.move(tables, state, last) == expected


def test_the_readers_need_numpy_and_the_language_only():
    for _, reader in to_setpoint.FILES.values():
        text = Path(str(reader.__file__)).read_text(encoding="utf-8")
        assert set(re.findall(r"^(?:import|from) (\w+)", text, re.M)) <= {"json", "math", "numpy"}


# ---- our agent


@pytest.fixture(scope="module")
def our_agent() -> to_setpoint.BeliefAgent:
    """Of a filter with two hypotheses, with a correction that weighs as much as a trained one's."""
    one = bayes.class_filter(**CLASS_FILTER)
    both = {
        "evidence": jnp.concatenate(
            [one.evidence, bayes.class_filter(**CLASS_FILTER | {"accuracy": 0.95}).evidence]
        )
    }
    both |= {"transition": jnp.array([[0.98, 0.02], [0.01, 0.99]]), "after_jump": jnp.eye(2)}
    both |= {"gains": jnp.array([1.0, 0.6]), "window_repeat_probability": jnp.array([0.3, 0.1])}
    two = one._replace(**both, prior=jnp.tile(one.prior, (2, 1)) / 2)
    costs = belief_agent.StepCosts(10.0, 1.0, 0.02)
    values = jnp.asarray(belief_agent.observed_values(costs, 0.8), jnp.float32)
    network = belief_agent.BeliefNetwork(2, jax.random.key(3))
    rng = np.random.default_rng(5)
    last = {f"{head}.last.{part}" for head in ("flow", "temperature") for part in ("weight", "bias")}
    arrays = {
        name: rng.normal(0, 0.7, array.shape).astype(np.float32) if name in last else array
        for name, array in agent.weights(network).items()
    }
    return to_setpoint.BeliefAgent(belief_agent.Belief(two, values, 0.8), agent.with_weights(network, arrays))


def test_from_key_areas_on_our_agent_decides_as_exported(model, our_agent, tmp_path):
    """2,000 windows of two frames each, one after the other: the networks, the filter and the agent here; the
    exported files there, with readers that know numpy alone. Only what was sent is shared."""
    to_setpoint.write(tmp_path, to_setpoint.weights(model, our_agent))
    w, f, a = (flow_reader.read_safetensors(tmp_path / name) for name in to_setpoint.FILES)
    rng, n, of = np.random.default_rng(6), 2000, our_agent.belief
    profile = 60 * np.exp(-(((np.arange(16) - 8) / rng.uniform(1, 6, n * FRAMES)[:, None]) ** 2))
    areas = np.clip(rng.normal(100, 20, (n * FRAMES, 16, 48)) + profile[:, :, None], 0, 255).astype(np.uint8)
    temperature = rng.uniform(*TEMPERATURE_LIMITS, n * FRAMES)
    theirs = classifier.predict(model.network, areas, temperature)
    frames = [part.reshape(n, FRAMES).astype(float) for part in (theirs.log_flow, theirs.deviation)]
    # an untrained network calls every window alike: what it says is spread over all flows
    spread = 15.0
    frames[0] = spread * (frames[0] - theirs.log_flow.mean())
    valid, unknown = np.ones((n, FRAMES), bool), np.full((n, len(NAMES)), np.nan)
    shown = window_flow.window_flow(*frames, valid, unknown, model.calibration.flow)
    _, log_flow, deviation = flow_reader.outputs(w, areas, temperature)
    log_flow = spread * (log_flow - theirs.log_flow.mean())
    log_flow, deviation = log_flow.reshape(n, FRAMES), deviation.reshape(n, FRAMES)
    encoder = belief_agent.belief_encoder(of)

    @jax.jit
    def acts(memory, seen):
        memory, x = encoder.encode(our_agent.network, memory, seen)
        loss = bayes.expected_loss(of.filter, memory.belief, seen.flow_move)
        return memory, our_agent.network(x), jnp.sort(loss)[:2]

    memory, state, sent, ties, moved = encoder.start(), flow_filter.start(f), 0.0, 0, set()
    for t in range(n):
        u, target = float(temperature[FRAMES * t]), float(temperature[FRAMES * t + 1])
        numbers = (jnp.float32(number) for number in (shown.flow_seen[t], sent, u, target))
        shares = jnp.asarray(shown.prob[t], jnp.float32)
        memory, Q, losses = acts(memory, Observation(shares, shares.argmax(), *numbers, jnp.int32(t)))
        flow, _, prob = flow_reader.window(w, log_flow[t], deviation[t])
        state = flow_filter.update(f, state, prob, int(prob.argmax()), flow, sent)
        rests = flow_filter.move(f, state, sent) == 0
        mine = agent_reader.moves(a, state["belief"], rests, u, target, t)
        best = np.asarray(Q).argmax(axis=1)
        heeded = t % 10 == 0
        expected = (FLOW_MOVES[best[0]], heeded * TEMPERATURE_MOVES[best[1]])
        # where two moves are worth the same in single precision either is best
        gaps = [*np.diff(np.sort(np.asarray(Q), axis=1)[:, -2:])[:, 0], losses[1] - losses[0]]
        tie = min(gaps[:: 1 if heeded else 2]) < 1e-3
        ties += tie
        assert mine == expected or tie, f"window {t}: {mine}, expected {expected}, {gaps}"
        sent = float(FLOW_MOVES[best[0]])
        moved.add(sent)
    assert len(moved) > 3 and ties < n / 100


def test_the_stage_exports_what_was_chosen(model, our_agent, tmp_path):
    """Our agent with its network where it is the default, the filter where a filter is, nothing else."""
    parameters = {
        to_setpoint.BELIEF: our_agent.network,
        "Bayes": bayes.class_filter(**CLASS_FILTER),
        "proportional": (),
    }
    found = []
    for name, values in parameters.items():
        decides = to_setpoint.decider(name, values, our_agent.belief, our_agent.network)
        found.append(to_setpoint.write_checked(tmp_path / name, name, model, decides, 1))
    learned, filtered, none = found
    files = [{path.name for path in (tmp_path / name).glob("*")} for name in parameters]
    both = {"agent.safetensors", "agent_reader.py"}
    assert both < files[0] and files[0] - both == files[1]
    assert learned["largest_difference"]["values"] < SINGLE
    assert "values" not in filtered["largest_difference"]
    assert not files[2] and "has no filter" in none["why"]


def test_another_network_is_told_by_its_values(our_agent, model, tmp_path):
    to_setpoint.write(tmp_path, to_setpoint.weights(model, our_agent))
    other = our_agent._replace(network=belief_agent.BeliefNetwork(2, jax.random.key(4)))
    assert to_setpoint.of_agent(tmp_path, other, np.random.default_rng(1)) > 1e-3


def test_the_command_exports_the_folder_of_the_stage(model, our_agent, tmp_path):
    to_setpoint.write(tmp_path / "made", to_setpoint.weights(model, our_agent))
    told = export.export(tmp_path / "made", "python", tmp_path / "out", "extruder")
    assert told.startswith("classifier, filter, agent. It has no certificate")
    names = {path.name for path in (tmp_path / "made").iterdir()}
    assert {path.name for path in (tmp_path / "out").iterdir()} == names and len(names) == 6
    for name in names:
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "made" / name).read_bytes()
    with pytest.raises(ValueError, match="run in Python alone, found --to c; write --to python"):
        export.export(tmp_path / "made", "c", None, "extruder")
    artifacts.write_text(tmp_path / "made" / "filter.safetensors", "broken")
    with pytest.raises(ValueError, match=r"filter.safetensors holds no whole weights"):
        export.export(tmp_path / "made", "python", None, "extruder")
