"""The published agent's stage: what its memo keeps, what is swept, and what is told of the paper's claims."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pipeline.setpoint.agents import agent, claims
from pipeline.setpoint.agents.agent import PublishedAgent, QNetwork
from pipeline.setpoint.simulation.simulator import (
    Action,
    SetpointController,
    Trajectory,
    nominal,
    paper_windows,
    rollout,
)
from pipeline.store import params
from stages import train_agent
from stages.train_agent import TrainAgent


@pytest.fixture
def settings(root) -> TrainAgent:
    declared = params.load(TrainAgent, "train_agent", root / params.FILE)
    small = {"updates": [5, 5, 5, 5], "environments": 4, "batch": 16, "capacity": 1000, "episode": 10}
    return declared.model_copy(update={"li_2025": declared.li_2025.model_copy(update=small)})


def of(settings: TrainAgent, **changes) -> TrainAgent:
    return settings.model_copy(update={"li_2025": settings.li_2025.model_copy(update=changes)})


def test_history_and_lambda_are_swept(settings):
    """Eta is the width of the network's camera input; lambda is the clock by which targets move."""
    swept = of(settings, history=7, flow_actions=4)
    trained = train_agent.published_agent(swept, None, lambda *_: None)
    assert [network.vision.in_features for network in trained.networks] == [7 + 3] * 4
    assert {agent.history_of(network) for network in trained.networks} == {7}
    conditions = nominal(np.full(2, 100.0), 190.0, accuracy=1.0)._replace(flow_actions=jnp.full(2, 4.0))
    up = SetpointController(lambda: (), lambda p, m, o, key: (m, Action(jnp.int32(2), jnp.int32(3))))
    path = rollout(up, (), paper_windows(), conditions, jax.random.key(0), steps=10)
    np.testing.assert_array_equal(np.flatnonzero(np.diff(path.target[0])), [0, 4, 8])
    told = train_agent.paper_claims(swept, trained.networks)
    assert told["300 %, 230 °C"]["printed"] == {"rests_at": 95.0, "least": 75.0, "most": 130.0}
    assert all(np.isfinite(claim["measured"]["rests_at"]) for claim in told.values())


def test_the_published_agent_is_trained_once_for_all_windows(settings, tmp_path, monkeypatch):
    calls = []

    def train(key, how, *, on_step):
        calls.append(how)
        network = QNetwork(key, how.history)
        return PublishedAgent((network,) * 4, (jnp.arange(5.0),) * 4)

    monkeypatch.setattr(agent, "train_published", train)
    first = train_agent.published_agent(settings, tmp_path, print)
    again = train_agent.published_agent(settings, tmp_path, print)
    assert len(calls) == 1
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    # other settings, another seed and other code are trained; a damaged entry is trained again
    train_agent.published_agent(of(settings, history=9), tmp_path, print)
    train_agent.published_agent(settings.model_copy(update={"seed": 5}), tmp_path, print)
    assert len(calls) == 3
    monkeypatch.setattr(train_agent, "PUBLISHED_CODE", ("agents/agent.py",))
    train_agent.published_agent(settings, tmp_path, print)
    assert len(calls) == 4
    for path in tmp_path.glob("*.safetensors"):
        path.write_bytes(path.read_bytes()[:500])
    train_agent.published_agent(settings, tmp_path, print)
    train_agent.published_agent(settings, tmp_path, print)
    assert len(calls) == 5


def test_a_start_is_told_as_the_paper_tells_it(settings, monkeypatch):
    """By hand: one run crosses 100 %, falls to 75, rises to 130 and rests at 95; it is cold for a while."""
    q = np.array([300, 200, 105, 75, 130, 95, 95, 95, 95, 95, 95.0])
    u = np.array([230, 220, 210, 200, 200, 205, 210, 210, 210, 210, 210.0])
    started = []

    def path(controller, network, windows, conditions, key, *, steps):
        started.append((float(conditions.flow[0]), float(conditions.accuracy[0])))
        empty = [None] * (len(Trajectory._fields) - 2)
        return Trajectory(np.tile(q, (100, 1)), np.tile(u, (100, 1)), *empty)

    monkeypatch.setattr(claims, "rollout", path)
    monkeypatch.setattr(claims, "RESTING", 4)
    networks = [QNetwork(jax.random.key(0))] * 4
    told = train_agent.paper_claims(settings, networks)["300 %, 230 °C"]["measured"]
    assert told == {"rests_at": 95, "least": 75, "most": 130, "flow_range": 0, "temperature_range": 5}
    assert started[0] == (300.0, pytest.approx(0.7))
    q[2:] = 200
    assert train_agent.paper_claims(settings, networks)["300 %, 230 °C"]["measured"]["most"] is None


def test_what_the_paper_does_not_print_is_named(settings):
    told = train_agent.guesses(of(settings, updates=[9, 8, 7]).li_2025)
    assert (told["delta"], told["alpha"], told["sigma"]) == (5.0, 1.5, 0.15)
    assert told["updates_by_phase"] == [9, 8, 7]
    assert told["explore_by_phase"] == [1.0, 0.3, 0.3]
