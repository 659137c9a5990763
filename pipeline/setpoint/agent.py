"""Deep Q-learning of setpoints as published (Li and Pattinson 2025, eqs. 10-13, tables 1 and 2): network,
replay, one phase as one program, and the four phases.

What the network sees is a `Sight`, so that the paper's 35 numbers and ours (belief_agent.py) train by the
same lines. Two heads, one for the flow and one for the temperature, each with one maximum and a one-step
target of its own; step 100 ends an episode without ending the task, so its target still looks ahead.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.tree_util import Partial

from pipeline.setpoint.published import BEST_TEMPERATURE, LAMBDA, PHASES
from pipeline.setpoint.reward import reward
from pipeline.setpoint.simulator import (
    CHANCES,
    FLOW_LIMITS,
    HISTORY,
    STAND,
    TEMPERATURE_LIMITS,
    Action,
    Conditions,
    Controller,
    Observation,
    State,
    Windows,
    begin,
    first_history,
    nominal,
    paper_state,
    paper_windows,
    remembered,
    stepped,
)

VISION = HISTORY + 3  # numbers of the state that come from the camera; the rest are temperatures
ACTIONS = 5  # of each head
SHORT = 256  # rows that one product sums: the linear algebra under XLA cuts longer sums by the size of the CPU's first cache (288 numbers in 32 kB)
TEMPERATURE_SCALE = 30.0  # °C, half the range of the targets: degrees as they come drown the camera's numbers


class QNetwork(eqx.Module):
    """The paper's network, 47,082 parameters: camera 33 -> 256 and temperatures 2 -> 32,
    together 288 -> 128 -> 5 + 5, rectified linear."""

    vision: eqx.nn.Linear
    temperature: eqx.nn.Linear
    joint: eqx.nn.Linear
    heads: eqx.nn.Linear

    def __init__(self, key: jax.Array):
        keys = jax.random.split(key, 4)
        self.vision = eqx.nn.Linear(VISION, 256, key=keys[0])
        self.temperature = eqx.nn.Linear(2, 32, key=keys[1])
        self.joint = eqx.nn.Linear(288, 128, key=keys[2])
        self.heads = eqx.nn.Linear(128, 2 * ACTIONS, key=keys[3])

    def __call__(self, state: jax.Array) -> jax.Array:
        """Q (2, 5) of the flow's and the temperature's actions at a
        state (35,) of (9), temperatures already scaled."""
        # both first layers as one product, zeros where one does not see the other's numbers: for a batch that
        # is dearer in sums and cheaper in moving them
        both = jax.scipy.linalg.block_diag(self.vision.weight, self.temperature.weight)
        seen = jax.nn.relu(both @ state + jnp.concatenate([self.vision.bias, self.temperature.bias]))
        return self.heads(jax.nn.relu(self.joint(seen))).reshape(2, ACTIONS)


class Sight(NamedTuple):
    """What a network sees: start() -> memory; see(parameters, memory,
    observation) -> (memory, x (d,)). Pure, for one episode."""

    start: Callable[[], Any]
    see: Callable[[Any, Any, Observation], tuple[Any, jax.Array]]


def paper_sight() -> Sight:
    """The state (9): 30 former classes, the scaled distribution, and both temperatures as (u - 210) / 30."""

    def see(network, history, observation):
        state = paper_state(history, observation)
        return remembered(history, observation.named), state.at[VISION:].add(-BEST_TEMPERATURE).at[
            VISION:
        ].divide(TEMPERATURE_SCALE)

    return Sight(first_history, see)


def greedy(sight: Sight) -> Controller:
    """The controller that takes the best action of each head; its parameters are the network. The simulator
    heeds the temperature's every 10th step."""

    def act(network, memory, observation, key):
        memory, x = sight.see(network, memory, observation)
        best = network(x).argmax(axis=1)
        return memory, Action(best[0], best[1])

    return Controller(sight.start, act)


# ---- learning


class Learner(NamedTuple):
    """Network, its slow copy (13), and the optimiser's state: all that goes from one phase to the next. The
    replay does not: its rewards are of the old phase."""

    network: eqx.Module
    slow: eqx.Module
    moments: Any


class Setting(NamedTuple):
    """Numbers of table 2 and those it leaves open: `updates` of a phase, each
    after one step of `environments` episodes at once.

    gamma of both heads, or (2,) of each.
    """

    gamma: float | jax.Array
    tau: float
    batch: int
    capacity: int
    environments: int
    episode: int


class Replay(NamedTuple):
    """Transitions: x and what followed (n, d), action and reward of both heads (n, 2), and
    whether lambda's clock heeds no temperature action next (n,): then the temperature stands,
    and the target says so; a maximum there would make waiting free. The ring keeps them as
    rows of 2 d + 5 numbers: one place to look up each."""

    x: jax.Array
    after: jax.Array
    action: jax.Array
    reward: jax.Array
    waits: jax.Array


def _packed(rows: Replay) -> jax.Array:
    return jnp.concatenate([rows.x, rows.after, rows.action, rows.reward, rows.waits[:, None]], axis=1)


def _unpacked(table: jax.Array) -> Replay:
    d = (table.shape[1] - 5) // 2
    x, after, action, reward, waits = jnp.split(table, (d, 2 * d, 2 * d + 2, 2 * d + 4), axis=1)
    return Replay(x, after, action.astype(jnp.int8), reward, waits[:, 0] > 0)


class World(NamedTuple):
    """Where experience comes from: windows, conditions(key) of a new
    episode, and rewards(state) -> (2,) of both heads."""

    windows: Windows
    conditions: Callable[[jax.Array], Conditions]
    rewards: Callable[[State], jax.Array]


def greatest(network, slow, after: jax.Array) -> jax.Array:
    """max_a Q(s', a; slow) of each head (11)."""
    return slow(after).max(axis=1)


def double(network, slow, after: jax.Array) -> jax.Array:
    """Q(s', argmax_a Q(s', a); slow): the network chooses, the slow
    copy values (van Hasselt, Guez and Silver 2016)."""
    return jnp.take_along_axis(slow(after), network(after).argmax(axis=1)[:, None], axis=1)[:, 0]


def _fresh(world: World, sight: Sight, network, keys):
    """New episodes, one a key: conditions, state, memory and what the network sees."""

    def one(key):
        conditions = world.conditions(key)
        state, observation = begin(world.windows, conditions, key)
        return conditions, state, *sight.see(network, sight.start(), observation)

    return jax.vmap(one)(keys)


def _stepped(world: World, sight: Sight, network, episodes, epsilon, u: jax.Array, key, length: int):
    """One step of all episodes under the epsilon-greedy policy, by u (n, 4 + CHANCES) uniform in [0, 1) ->
    (episodes, their transitions); those that are over start anew, from the key."""
    conditions, state, memory, x = episodes
    explores, at_random, befalls = u[:, :2] < epsilon, (ACTIONS * u[:, 2:4]).astype(jnp.int32), u[:, 4:]
    action = jnp.where(explores, at_random, jax.vmap(network)(x).argmax(axis=2))
    action = action.at[:, 1].set(
        jnp.where(state.step % LAMBDA == 0, action[:, 1], STAND)
    )  # what is not heeded is standing
    state, observation = jax.vmap(Partial(stepped, world.windows))(
        conditions, state, Action(action[:, 0], action[:, 1]), befalls
    )
    memory, after = jax.vmap(Partial(sight.see, network))(memory, observation)
    rewards = jax.vmap(world.rewards)(state)
    over, waits = state.step >= length, state.step % LAMBDA != 0

    def renewed(going):
        again = _fresh(world, sight, network, jax.random.split(key, len(x)))
        return jax.tree.map(
            lambda new, old: jnp.where(over.reshape(-1, *[1] * (old.ndim - 1)), new, old), again, going
        )

    episodes = jax.lax.cond(over.any(), renewed, lambda going: going, (conditions, state, memory, after))
    return episodes, Replay(x, after, action.astype(jnp.int8), rewards, waits)


def _updated(
    learner: Learner, rows: Replay, optimiser, bootstrap, gamma: float | jax.Array, tau: float
) -> Learner:
    """One step on (12) for a batch, then (13)."""
    ahead = jax.vmap(Partial(bootstrap, learner.network, learner.slow))(rows.after)
    standing = jax.vmap(learner.slow)(rows.after)[:, 1, STAND]
    y = rows.reward + gamma * ahead.at[:, 1].set(jnp.where(rows.waits, standing, ahead[:, 1]))
    taken = jax.nn.one_hot(rows.action, ACTIONS)

    def loss(network, x, taken, y):
        return ((y - (jax.vmap(network)(x) * taken).sum(axis=2)) ** 2).mean()

    gradient = _mean_gradient(loss, learner.network, rows.x, taken, y)
    change, moments = optimiser.update(gradient, learner.moments)
    network = optax.apply_updates(learner.network, change)
    slow = jax.tree.map(lambda old, new: tau * new + (1 - tau) * old, learner.slow, network)
    return Learner(network, slow, moments)


def _mean_gradient(loss: Callable, network, *batch: jax.Array):
    """Gradient of the mean of `loss` over the rows of `batch`, as the mean over slices of at most SHORT rows:
    sums of the same order on every CPU."""
    parts = next(
        n for n in range(1, len(batch[0]) + 1) if len(batch[0]) % n == 0 and len(batch[0]) <= n * SHORT
    )
    slices = zip(*(jnp.split(a, parts) for a in batch), strict=True)
    return jax.tree.map(lambda *g: sum(g) / parts, *(jax.grad(loss)(network, *rows) for rows in slices))


def phase(
    learner: Learner, key: jax.Array, *, sight: Sight, world: World, optimiser: optax.GradientTransformation,
    bootstrap: Callable, setting: Setting,
    updates: int, longest: int, epsilon: tuple[float, float],
) -> tuple[Learner, jax.Array]:  # fmt: skip
    """A whole phase as one program -> the learner after it and the mean reward of each step (updates,);
    epsilon falls in a line over the first third.

    A step of all episodes, one batch from an empty replay, one update, `updates` times. Episodes start at
    different steps, so that they do not end together. Phases with the same `longest`, the updates of the
    longest of them, are one program compiled once.
    """
    learner, rewards = _phase(
        learner, key, jnp.asarray(updates), jnp.asarray(epsilon), sight=sight, world=world,
        optimiser=optimiser, bootstrap=bootstrap, setting=setting, longest=longest
    )  # fmt: skip
    return learner, rewards[:updates]


@eqx.filter_jit
def _phase(
    learner,
    key,
    updates,
    epsilon,
    *,
    sight: Sight,
    world: World,
    optimiser,
    bootstrap,
    setting: Setting,
    longest: int,
):
    k_start, k_clock, key = jax.random.split(key, 3)
    n, capacity = setting.environments, setting.capacity
    conditions, state, memory, x = _fresh(world, sight, learner.network, jax.random.split(k_start, n))
    state = state._replace(step=LAMBDA * jax.random.randint(k_clock, (n,), 0, setting.episode // LAMBDA))
    # a step draws some thousand numbers: by XLA's own generator
    # (Philox), which costs a tenth of jax's default there
    fast = jax.random.wrap_key_data(jnp.tile(jax.random.key_data(key), 2), impl="rbg")

    def one(i, carry):
        learner, episodes, ring, paid = carry
        k_step, k_batch = (jax.random.fold_in(fast, 2 * i + j) for j in (0, 1))
        now = epsilon[0] + (epsilon[1] - epsilon[0]) * jnp.minimum(3.0 * i / updates, 1.0)
        episodes, new = _stepped(
            world,
            sight,
            learner.network,
            episodes,
            now,
            jax.random.uniform(k_step, (n, 4 + CHANCES)),
            jax.random.fold_in(key, i),
            setting.episode,
        )
        ring = jax.lax.dynamic_update_slice_in_dim(ring, _packed(new), i * n % capacity, 0)
        filled = jnp.minimum((i + 1) * n, capacity).astype(jnp.uint32)
        chosen = (jax.random.bits(k_batch, (setting.batch,)) % filled).astype(jnp.int32)
        learner = _updated(learner, _unpacked(ring[chosen]), optimiser, bootstrap, setting.gamma, setting.tau)
        return learner, episodes, ring, paid.at[i].set(new.reward.mean())

    ring = jnp.zeros((capacity, 2 * x.shape[1] + 5))
    learner, _, _, rewards = jax.lax.fori_loop(
        0, updates, one, (learner, (conditions, state, memory, x), ring, jnp.zeros(longest))
    )
    return learner, rewards


# ---- the paper's four phases


class Published(NamedTuple):
    """Networks after phases 1 to 4, and the mean reward of each step of each phase."""

    networks: tuple[QNetwork, ...]
    rewards: tuple[jax.Array, ...]


def ellipse(a, b, state: State) -> jax.Array:
    """(2,): the reward (14) of the state, the same for both heads."""
    return jnp.tile(reward(state.flow, state.temperature, a=a, b=b), 2)


def anywhere(accuracy, key: jax.Array) -> Conditions:
    """A machine that does as it is told, from a flow and temperature uniform within the limits."""
    u = jax.random.uniform(key, (2,))
    low, high = jnp.array([FLOW_LIMITS, TEMPERATURE_LIMITS]).T
    flow, temperature = low + (high - low) * u
    return nominal(flow, temperature, accuracy=accuracy)


def train_published(
    key: jax.Array,
    *,
    setting: Setting,
    rate: float,
    updates: tuple[int, ...],
    accuracy: float,
    explore: float,
    explore_again: float,
    least: float,
    on_step=None,
) -> Published:
    """The four phases: reward shapes (40, 20), (40, 10), (20, 10) on windows that are always right, then the
    last shape with `accuracy`; Adam at one rate throughout.

    epsilon falls from `explore` in phase 1, from `explore_again` in the later ones, to
    `least`; `updates` of each phase, as many phases as there are numbers.
    on_step(phase, network, rewards) is called after each phase.
    """
    k_network, key = jax.random.split(key)
    network, optimiser, sight, windows = QNetwork(k_network), optax.adam(rate), paper_sight(), paper_windows()
    learner = Learner(network, network, optimiser.init(eqx.filter(network, eqx.is_array)))
    networks, all_rewards = [], []
    for i, count in enumerate(updates):
        a, b = PHASES[min(i, len(PHASES) - 1)]
        right = 1.0 if i < len(PHASES) else accuracy
        world = World(
            windows, Partial(anywhere, jnp.asarray(right)), Partial(ellipse, jnp.asarray(a), jnp.asarray(b))
        )
        learner, rewards = phase(
            learner, jax.random.fold_in(key, i), sight=sight, world=world, optimiser=optimiser,
            bootstrap=greatest, setting=setting, updates=count,
            longest=max(updates), epsilon=(explore if i == 0 else explore_again, least),
        )  # fmt: skip
        networks.append(learner.network)
        all_rewards.append(rewards)
        if on_step is not None:
            on_step(i + 1, learner.network, rewards)
    return Published(tuple(networks), tuple(all_rewards))


# ---- weights by name


def weights(network: eqx.Module) -> dict[str, np.ndarray]:
    """The network's arrays by their place in it, for the edge to write."""
    return {
        jax.tree_util.keystr(path, simple=True, separator="."): np.asarray(leaf)
        for path, leaf in jax.tree_util.tree_leaves_with_path(network)
    }


def with_weights(network: eqx.Module, arrays: dict[str, np.ndarray]) -> eqx.Module:
    """The network with these arrays in the places of its own.

    Raises ValueError where names or shapes are those of another architecture.
    """
    own = weights(network)
    wrong = sorted(own.keys() ^ arrays.keys()) or [
        name for name in own if own[name].shape != np.shape(arrays[name])
    ]
    if wrong:
        found = f"shape {np.shape(arrays[wrong[0]])}" if wrong[0] in arrays else "none"
        raise ValueError(
            f"weights of another architecture: {wrong[0]!r} is "
            f"{f'of shape {own[wrong[0]].shape}' if wrong[0] in own else 'unknown'} in this "
            f"network and {found} in "
            "the file; train again, or load them into the network that they were trained in"
        )
    return jax.tree.unflatten(jax.tree.structure(network), [jnp.asarray(arrays[name]) for name in own])
