"""The paper's network and learning rule, and its phases as one program."""

from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.tree_util import Partial

from pipeline.setpoint.agents import trials
from pipeline.setpoint.agents.agent import (
    CHECKPOINTS,
    DqnProblem,
    DqnSettings,
    DqnState,
    EnvSpec,
    PhaseResult,
    PublishedTraining,
    QNetwork,
    ReplayRows,
    _mean_gradient,
    _packed,
    _unpacked,
    _updated,
    anywhere,
    best_checkpoint,
    dqn_target,
    ellipse,
    paper_encoder,
    phase,
    train_published,
    untrained,
    weights,
    with_weights,
)
from pipeline.setpoint.simulation.simulator import STAND, Observation, begin, nominal, paper_windows

SMALL = DqnSettings(gamma=0.99, tau=0.005, batch=64, capacity=512, environments=8, episode=100)
PUBLISHED = PublishedTraining(
    dqn=SMALL, learning_rate=1e-4, updates=(20, 20), accuracy=0.7, explore=(1.0, 0.3, 0.3, 0.3), least=0.05
)


def observation(named=1, flow_move=0.0, temperature=210.0, target=210.0, step=0):
    shares = np.full(3, 0.15)
    shares[named] = 0.7
    as_float = (
        jnp.asarray(shares, jnp.float32),
        jnp.asarray(named),
        *(jnp.asarray(x, jnp.float32) for x in (np.nan, flow_move, temperature, target)),
    )
    return Observation(*as_float, jnp.asarray(step))


# ---- the paper's network


def test_the_network_has_the_papers_47082_parameters():
    assert sum(leaf.size for leaf in jax.tree.leaves(QNetwork(jax.random.key(0)))) == 47_082


def test_the_network_sees_30_classes_the_scaled_distribution_and_both_temperatures():
    encoder = paper_encoder()
    history, x = encoder.encode(None, encoder.start(), observation(named=2, temperature=195.0, target=225.0))
    np.testing.assert_allclose(x[:30], 1 / 3, rtol=1e-6)  # float32
    np.testing.assert_allclose(x[30:], [0.15 / 0.7, 0.15 / 0.7, 1.0, -0.5, 0.5], rtol=1e-6)
    assert history[-1] == pytest.approx(2 / 3)


def test_both_first_layers_as_one_product_are_the_two_layers():
    network, x = QNetwork(jax.random.key(3)), jax.random.normal(jax.random.key(4), (35,))
    camera, hot = jax.nn.relu(network.vision(x[:33])), jax.nn.relu(network.temperature(x[33:]))
    Q = network.heads(jax.nn.relu(network.joint(jnp.concatenate([camera, hot]))))
    np.testing.assert_allclose(network(x).ravel(), Q, atol=1e-6)  # float32 sums in another order


# ---- the learning rule


def one_row(network, reward, after, masked=False):
    doubled = jax.tree.map(lambda w: 2 * w, network)
    train_state = DqnState(network, doubled, optax.sgd(0.0).init(network))
    row = ReplayRows(
        jnp.zeros((1, 35)),
        after[None],
        jnp.array([[4, STAND]], jnp.int8),
        jnp.array([reward]),
        jnp.array([masked]),
    )
    return train_state, row


@pytest.mark.parametrize("masked", [False, True])
def test_each_head_learns_from_its_own_target_or_from_standing_where_the_next_action_is_masked(masked):
    network, after = QNetwork(jax.random.key(1)), jax.random.normal(jax.random.key(2), (35,))
    train_state, row = one_row(network, [0.5, -0.5], after, masked)
    ahead = np.asarray(train_state.target_network(after))
    y = np.array([0.5, -0.5]) + 0.9 * np.array(
        [ahead[0].max(), ahead[1, STAND] if masked else ahead[1].max()]
    )
    Q = np.asarray(network(jnp.zeros(35)))
    error = np.array([Q[0, 4], Q[1, STAND]]) - y  # gradient of the mean of two squares is the error itself
    optimiser = optax.sgd(1.0)
    train_state = train_state._replace(opt_state=optimiser.init(network))
    problem = DqnProblem(None, None, optimiser, dqn_target, SMALL._replace(gamma=0.9, tau=0.1))
    step = _updated(train_state, row, problem)
    change = np.asarray(step.network.heads.bias - network.heads.bias).reshape(2, 5)
    np.testing.assert_allclose([change[0, 4], change[1, STAND]], -error, rtol=1e-5)  # float32
    assert np.count_nonzero(change) == 2
    expected = 0.1 * np.asarray(step.network.heads.bias) + 0.9 * 2 * np.asarray(network.heads.bias)  # (13)
    np.testing.assert_allclose(step.target_network.heads.bias, expected, rtol=1e-5)


def test_both_heads_are_paid_by_the_ellipse():
    at = nominal(110.0, 205.0, accuracy=1.0)
    state, _ = begin(paper_windows(), at, jax.random.key(0))
    np.testing.assert_allclose(
        ellipse(40.0, 20.0, state), [0.394, 0.394], atol=5e-4
    )  # the check value has three digits


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes_and_another_seed_others():
    one, again, other = (train_published(jax.random.key(seed), PUBLISHED) for seed in (0, 0, 1))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    assert np.abs(one.networks[-1].heads.bias - other.networks[-1].heads.bias).max() > 1e-3


def test_transitions_survive_the_replay_buffer():
    rng = np.random.default_rng(0)
    rows = ReplayRows(
        *(jnp.asarray(rng.normal(size=(6, 35)), jnp.float32) for _ in range(2)),
        jnp.asarray(rng.integers(0, 5, (6, 2)), jnp.int8),
        jnp.asarray(rng.normal(size=(6, 2)), jnp.float32),
        jnp.arange(6) % 2 == 0,
    )
    for before, after in zip(rows, _unpacked(_packed(rows)), strict=True):
        assert before.dtype == after.dtype
        np.testing.assert_array_equal(before, after)


def test_the_checkpoint_is_kept_whose_runs_stay_most_and_of_equal_ones_the_last(monkeypatch):
    stays = np.zeros(CHECKPOINTS)
    stays[[3, 9]] = 80.0
    network = QNetwork(jax.random.key(0))
    checkpoints = jax.tree.map(lambda leaf: jnp.stack([leaf] * CHECKPOINTS), network)
    checkpoints = eqx.tree_at(
        lambda of: of.heads.bias, checkpoints, jnp.arange(CHECKPOINTS)[:, None] * jnp.ones(10)
    )

    def evaluate(controller, network, windows, conditions, key):
        stay = float(stays[int(network.heads.bias[0])])
        return SimpleNamespace(settled=SimpleNamespace(percent=90.0), stay=SimpleNamespace(percent=stay))

    monkeypatch.setattr(trials, "evaluate", evaluate)
    result = PhaseResult(None, jnp.zeros(1), checkpoints)
    best = best_checkpoint(result, jax.random.key(1), PUBLISHED)
    assert (best.after, best.stay, float(best.network.heads.bias[0])) == (10, 80.0, 9.0)


@pytest.mark.slow
def test_a_phase_does_not_depend_on_how_long_the_longest_is():
    network, optimiser = QNetwork(jax.random.key(0)), optax.adam(1e-3)
    env = EnvSpec(
        paper_windows(),
        Partial(anywhere, jnp.asarray(1.0)),
        Partial(ellipse, jnp.asarray(40.0), jnp.asarray(20.0)),
    )
    train_state = DqnState(network, network, optimiser.init(network))
    problem = DqnProblem(paper_encoder(), env, optimiser, dqn_target, SMALL)
    (one, rewards), (other, rewards_alike) = (
        phase(train_state, jax.random.key(1), problem, updates=12, longest=longest, epsilon=(1.0, 0.1))
        for longest in (12, 30)
    )
    np.testing.assert_array_equal(rewards, rewards_alike)
    np.testing.assert_array_equal(one.network.joint.weight, other.network.joint.weight)
    assert (
        np.abs(one.network.joint.weight - network.joint.weight).max() > 1e-4
    )  # Adam moves each weight by some 1e-3 a step


def test_learning_raises_the_reward_from_its_first_to_its_last_steps():
    dqn = SMALL._replace(batch=256, capacity=2**15, environments=32)
    settings = PUBLISHED._replace(dqn=dqn, learning_rate=1e-3, updates=(600,), accuracy=1.0)
    rewards = train_published(jax.random.key(0), settings).rewards[0]
    # at random the flow wanders over 20-310 %, where the mean reward is about -0.55
    assert rewards[-100:].mean() > rewards[:100].mean() + 0.2


# ---- weights


def test_weights_find_their_places_by_shapes_alone():
    network = QNetwork(jax.random.key(0), 4)
    shapes = untrained(QNetwork, 4)
    found = with_weights(shapes, weights(network))
    assert jax.tree.all(jax.tree.map(lambda a, b: bool((a == b).all()), found, network))
    with pytest.raises(ValueError, match=r"'vision.weight' is of shape \(256, 8\) in this network"):
        with_weights(untrained(QNetwork, 5), weights(network))


def test_weights_return_to_the_network_they_came_from_and_no_other():
    network = QNetwork(jax.random.key(0))
    arrays = weights(network)
    assert arrays["heads.weight"].shape == (10, 128)
    back = with_weights(QNetwork(jax.random.key(1)), arrays)
    np.testing.assert_array_equal(back.joint.weight, network.joint.weight)
    with pytest.raises(
        ValueError, match="weights of another architecture: 'heads.weight' (.* found|is of shape)"
    ):
        with_weights(network, {**arrays, "heads.weight": np.zeros((3, 3))})
    with pytest.raises(
        ValueError, match="weights of another architecture: 'extra' is unknown in this network"
    ):
        with_weights(network, {**arrays, "extra": np.zeros(1)})


def test_a_long_batch_is_summed_in_short_slices_to_the_same_gradient():
    """Longer sums are cut by the size of the CPU's cache: their last bits would differ between machines."""
    lengths = []

    def loss(w, x):
        lengths.append(len(x))
        return ((x @ w) ** 2).mean()

    x = jax.random.normal(jax.random.key(0), (512, 3))
    w = jnp.array([1.0, -2.0, 0.5])
    gradient = _mean_gradient(loss, w, x)
    assert lengths == [256, 256]
    np.testing.assert_allclose(gradient, 2 * x.T @ (x @ w) / 512, rtol=1e-5)  # float32 sums of 512
