"""The paper's agent: what is searched and how the best is chosen, what is kept of it, and what is told of the
paper's claims."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pipeline.papers import search_agent, train_agent
from pipeline.papers.search_agent import SearchedRun, TrainAgent, training
from pipeline.setpoint.agents import agent, claims
from pipeline.setpoint.agents.agent import Checkpoint, QNetwork
from pipeline.setpoint.simulation.simulator import Trajectory
from pipeline.store import params

CHOSEN = {"explore": [1.0, 0.3, 0.3, 0.3], "environments": 4, "rate_at_end": 0.5}
SMALL = {"updates": [5, 5, 5, 32], "batch": 16, "capacity": 1000, "episode": 10}


@pytest.fixture
def settings(root) -> TrainAgent:
    declared = params.load(TrainAgent, "train_agent", root / params.PAPERS)
    return declared.model_copy(update=SMALL)


def test_the_history_is_the_width_of_the_network_s_camera_input(settings):
    how = training(settings.model_copy(update={"history": 7}), CHOSEN)
    assert (how.dqn.environments, how.rate_at_end, how.updates) == (4, 0.5, (5, 5, 5, 32))
    networks = agent.train_published(jax.random.key(0), how).networks
    assert [network.vision.in_features for network in networks] == [7 + 3] * 4
    assert {agent.history_of(network) for network in networks} == {7}
    told = claims.compare_starts(networks, accuracy=0.7)
    assert told["300 %, 230 °C"]["printed"] == {"rests_at": 95.0, "least": 75.0, "most": 130.0}
    assert all(np.isfinite(claim["measured"]["rests_at"]) for claim in told.values())


def test_a_searched_run_is_the_best_checkpoint_that_the_kept_agent_is_trained_to(
    settings, root, tmp_path, monkeypatch
):
    """The search trains phases 1 to 3 once for all settings; the kept agent is trained from the beginning."""
    monkeypatch.setattr(search_agent, "MEMO", tmp_path)
    monkeypatch.setattr(search_agent, "LOOP", root / "pipeline/setpoint")
    judged, checkpoints = [], []

    def run_starts(network, *, accuracy):
        judged.append(network)
        return Trajectory(np.full((1, 201), 100.0), np.full((1, 201), 210.0), *[None] * 4)

    def best(result, key, how):
        network = jax.tree.map(lambda leaf: leaf[3], result.checkpoints)
        checkpoints.append(network)
        return Checkpoint(network, 4, 70.0, 60.0)

    monkeypatch.setattr(agent, "run_starts", run_starts)
    monkeypatch.setattr(agent, "best_checkpoint", best)
    run = search_agent.searched_run(settings, CHOSEN, 1)
    assert run == SearchedRun(8, 70.0, 60.0, 100.0, 100.0, 100.0, 100.0)  # 4 of 16 parts of 32 updates
    published = agent.train_published(search_agent.first_key(1), training(settings, CHOSEN))
    for found, kept in zip(*map(jax.tree.leaves, (judged[0], published.networks[-1])), strict=True):
        np.testing.assert_array_equal(found, kept)
    # what was searched is remembered; other settings and another seed are not
    assert search_agent.searched_run(settings, CHOSEN, 1) == run and len(checkpoints) == 2
    search_agent.searched_run(settings, CHOSEN | {"rate_at_end": 1.0}, 1)
    search_agent.searched_run(settings, CHOSEN, 2)
    assert len(checkpoints) == 4


def test_validation_alone_chooses_setting_and_seed(settings, monkeypatch):
    """Every judged figure is better where validation is worse: it must choose nothing."""

    def found(settings, chosen, seed):
        validated = (
            50.0 + 10.0 * (chosen["environments"] == 32) + (seed == 2) - (chosen["rate_at_end"] == 1.0)
        )
        validated += 20.0 * (chosen["explore"][-1] == 0.3)
        return SearchedRun(seed, 0.0, validated, 0.0, 100.0 - validated, 0.0, 0.0)

    monkeypatch.setattr(search_agent, "searched_run", found)
    told = search_agent.search(settings)
    assert told["best"] == {"explore": [1.0, 0.3, 0.3, 0.3], "environments": 32, "rate_at_end": 0.05}
    assert (told["seed"], told["kept"]["updates"], told["kept"]["validated_stay"]) == (2, 2, 81.0)
    assert (told["settings"], told["seeds"], len(told["rows"])) == (8, 3, 8)
    assert (told["stay_min"], told["stay_max"], told["best_stay_min"]) == (19.0, 51.0, 19.0)


def test_the_learning_curve_has_as_many_stretches_of_each_phase():
    rewards = (jnp.arange(100.0), jnp.ones(50))
    curve = train_agent.learning_curve(agent.PublishedAgent((), rewards))
    assert curve["phase"] == [1] * 50 + [2] * 50 and set(curve["agent"]) == {"li_2025"}
    assert (curve["update"][:2], curve["update"][-1]) == ([2, 4], 150)
    assert (curve["reward"][:2], curve["reward"][-1]) == ([0.5, 2.5], 1.0)


def test_a_start_is_told_as_the_paper_tells_it(monkeypatch):
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

    def claimed():
        told = claims.compare_starts(networks, accuracy=0.7)
        return told["300 %, 230 °C"]["measured"]

    assert claimed() == {"rests_at": 95, "least": 75, "most": 130, "flow_range": 0, "temperature_range": 5}
    assert started[0] == (300.0, pytest.approx(0.7))
    q[2:] = 200
    assert claimed()["most"] is None


def test_what_the_paper_does_not_print_is_named(settings):
    told = train_agent.guesses(training(settings.model_copy(update={"updates": [9, 8, 7, 6]}), CHOSEN))
    assert (told["delta"], told["alpha"], told["sigma"]) == (5.0, 1.5, 0.15)
    assert told["updates_by_phase"] == [9, 8, 7, 6]
    assert told["explore_by_phase"] == [1.0, 0.3, 0.3, 0.3]
