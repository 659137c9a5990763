"""Deep Q-learning of setpoints as published (Li and Pattinson 2025, eqs. 10-13, tables 1 and 2): network,
replay buffer, one training phase as one compiled program, and the four phases.

An `ObservationEncoder` turns observations into the network's input, the paper's 35 numbers. The network has
two heads, one for the flow and one for the temperature; each has its own maximum and its own one-step target.
An episode ends at step 100, but the task goes on, so the target of that step still looks ahead.
"""

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.tree_util import Partial

from pipeline.setpoint.agents import trials
from pipeline.setpoint.agents.criteria import STEPS
from pipeline.setpoint.published import BEST_TEMPERATURE, LAMBDA, PHASES
from pipeline.setpoint.simulation.simulator import (
    CHANCES,
    CLASSES,
    FLOW_LIMITS,
    HISTORY,
    STAND,
    TEMPERATURE_LIMITS,
    Action,
    EpisodeConditions,
    MachineState,
    Observation,
    SetpointController,
    Trajectory,
    WindowSource,
    begin,
    first_history,
    nominal,
    paper_state,
    paper_windows,
    remembered,
    reward,
    rollout,
    stepped,
)

ACTIONS = 5  # of each head
# rows in one matrix product: the linear algebra under XLA splits longer sums by the size of the CPU's first
# cache (288 numbers in 32 kB), so that results would differ between CPUs
SHORT = 256
VALIDATION_RUNS = 20  # from each of the 21 starts, to choose a checkpoint by
RUNS, JUDGED_SEED = 100, 1000  # test runs from each of them; and the seed of their random numbers
CHECKPOINTS = 16  # equal parts of a phase; the network is kept after each
TEMPERATURE_SCALE = 30.0  # °C, half the range of the targets: unscaled, they would dominate the camera inputs


class QNetwork(eqx.Module):
    """The paper's network, 47,082 parameters, rectified linear: camera 33 -> 256 and temperatures 2 -> 32,
    joined 288 -> 128 -> 5 + 5. The 33 camera inputs are the class history (30) and the class distribution of
    eq. 4 (3)."""

    vision: eqx.nn.Linear
    temperature: eqx.nn.Linear
    joint: eqx.nn.Linear
    heads: eqx.nn.Linear

    def __init__(self, key: jax.Array, history: int = HISTORY):
        keys = jax.random.split(key, 4)
        self.vision = eqx.nn.Linear(history + CLASSES, 256, key=keys[0])
        self.temperature = eqx.nn.Linear(2, 32, key=keys[1])
        self.joint = eqx.nn.Linear(288, 128, key=keys[2])
        self.heads = eqx.nn.Linear(128, 2 * ACTIONS, key=keys[3])

    def __call__(self, state: jax.Array) -> jax.Array:
        """Returns Q (2, 5) of the flow's and the temperature's actions. `state` (history + 5,): eq. 9, with
        temperatures already scaled."""
        # both first layers as one product, with zeros between them: for a batch this needs more arithmetic
        # but less memory traffic
        both = jax.scipy.linalg.block_diag(self.vision.weight, self.temperature.weight)
        hidden = jax.nn.relu(both @ state + jnp.concatenate([self.vision.bias, self.temperature.bias]))
        return self.heads(jax.nn.relu(self.joint(hidden))).reshape(2, ACTIONS)


def history_of(network: QNetwork) -> int:
    """Returns the number of former classes that the network takes as input."""
    return network.vision.weight.shape[1] - CLASSES


class ObservationEncoder(NamedTuple):
    """Turns observations into the network's input: start() -> memory; encode(parameters, memory, observation)
    -> (memory, x (d,)). Both are pure functions, for one episode."""

    start: Callable[[], Any]
    encode: Callable[[Any, Any, Observation], tuple[Any, jax.Array]]


@cache
def paper_encoder(history: int = HISTORY) -> ObservationEncoder:
    """Returns the encoder of the paper's state (9): `history` former classes, the scaled class distribution,
    and both temperatures as (u - 210) / 30."""

    def encode(network, classes, observation):
        state, camera = paper_state(classes, observation), history + CLASSES
        temperatures = state.at[camera:].add(-BEST_TEMPERATURE).at[camera:].divide(TEMPERATURE_SCALE)
        return remembered(classes, observation.named), temperatures

    return ObservationEncoder(Partial(first_history, history), Partial(encode))


@cache  # one controller for all networks, so that its compiled program is used again
def greedy(encoder: ObservationEncoder) -> SetpointController:
    """Returns the controller that takes the best action of each head; its parameters are the network. The
    simulator applies the temperature's action at every 10th step only."""
    return SetpointController(encoder.start, Partial(_best_action, encoder.encode))


def _best_action(encode, network, memory, observation, key):
    memory, x = encode(network, memory, observation)
    best = network(x).argmax(axis=1)
    return memory, Action(best[0], best[1])


# ---- learning


class DqnState(NamedTuple):
    """Network, its target network (13), and the optimiser's state: everything that one phase passes to the
    next. The replay buffer is not passed on, because its rewards belong to the old phase."""

    network: eqx.Module
    target_network: eqx.Module
    opt_state: Any


class DqnSettings(NamedTuple):
    """Settings of table 2, and those that the table leaves open. Each update follows one step of
    `environments` parallel episodes. `gamma`: discount, one for both heads or (2,) for each."""

    gamma: float | jax.Array
    tau: float
    batch: int
    capacity: int
    environments: int
    episode: int


class ReplayRows(NamedTuple):
    """Transitions: `x` and `after` (n, d), the network's input before and after; `action` and `reward` (n, 2)
    of both heads; `temperature_action_masked` (n,), true if the next temperature action is not applied
    (lambda's clock).

    If it is masked, the temperature's target value is that of "no move"; a maximum there would make waiting
    free. The replay buffer stores each transition as one row of 2 d + 5 numbers, so that one look-up finds
    it.
    """

    x: jax.Array
    after: jax.Array
    action: jax.Array
    reward: jax.Array
    temperature_action_masked: jax.Array


def _packed(rows: ReplayRows) -> jax.Array:
    masked = rows.temperature_action_masked
    return jnp.concatenate([rows.x, rows.after, rows.action, rows.reward, masked[:, None]], axis=1)


def _unpacked(table: jax.Array) -> ReplayRows:
    d = (table.shape[1] - 5) // 2
    x, after, action, reward, masked = jnp.split(table, (d, 2 * d, 2 * d + 2, 2 * d + 4), axis=1)
    return ReplayRows(x, after, action.astype(jnp.int8), reward, masked[:, 0] > 0)


class EnvSpec(NamedTuple):
    """The environment: `windows`; `conditions(key)` of a new episode; `rewards(state)` -> (2,), one for each
    head."""

    windows: WindowSource
    conditions: Callable[[jax.Array], EpisodeConditions]
    rewards: Callable[[MachineState], jax.Array]


class DqnProblem(NamedTuple):
    """What a phase trains on: `encoder` of the network's input; `env`; `optimiser`; `bootstrap(network,
    target_network, x (d,))` -> values (2,); `settings`."""

    encoder: ObservationEncoder
    env: EnvSpec
    optimiser: optax.GradientTransformation
    bootstrap: Callable
    settings: DqnSettings


def dqn_target(network, target_network, after: jax.Array) -> jax.Array:
    """Returns max_a Q(s', a; target network) of each head (2,) (11)."""
    return target_network(after).max(axis=1)


def _fresh(problem: DqnProblem, network, keys):
    """Starts one episode for each key. Returns conditions, state, memory and the network's input."""
    env, encoder = problem.env, problem.encoder

    def one(key):
        conditions = env.conditions(key)
        state, observation = begin(env.windows, conditions, key)
        return conditions, state, *encoder.encode(network, encoder.start(), observation)

    return jax.vmap(one)(keys)


def _stepped(problem: DqnProblem, network, episodes, epsilon, u: jax.Array, key):
    """One step of all episodes under the epsilon-greedy policy. `u` (n, 4 + CHANCES): uniform in [0, 1).
    Returns (episodes, their transitions); finished episodes are restarted from `key`."""
    env = problem.env
    conditions, state, memory, x = episodes
    explores, at_random, befalls = u[:, :2] < epsilon, (ACTIONS * u[:, 2:4]).astype(jnp.int32), u[:, 4:]
    action = jnp.where(explores, at_random, jax.vmap(network)(x).argmax(axis=2))
    action = action.at[:, 1].set(
        jnp.where(state.step % LAMBDA == 0, action[:, 1], STAND)
    )  # an action that is not applied is recorded as no move
    state, observation = jax.vmap(Partial(stepped, env.windows))(
        conditions, state, Action(action[:, 0], action[:, 1]), befalls
    )
    memory, after = jax.vmap(Partial(problem.encoder.encode, network))(memory, observation)
    rewards = jax.vmap(env.rewards)(state)
    over, masked = state.step >= problem.settings.episode, state.step % LAMBDA != 0

    def renewed(going):
        again = _fresh(problem, network, jax.random.split(key, len(x)))
        return jax.tree.map(
            lambda new, old: jnp.where(over.reshape(-1, *[1] * (old.ndim - 1)), new, old), again, going
        )

    episodes = jax.lax.cond(over.any(), renewed, lambda going: going, (conditions, state, memory, after))
    return episodes, ReplayRows(x, after, action.astype(jnp.int8), rewards, masked)


def _updated(train_state: DqnState, rows: ReplayRows, problem: DqnProblem) -> DqnState:
    """Makes one gradient step on the loss (12) for a batch, then updates the target network (13)."""
    network, target_network = train_state.network, train_state.target_network
    gamma, tau = problem.settings.gamma, problem.settings.tau
    ahead = jax.vmap(Partial(problem.bootstrap, network, target_network))(rows.after)
    standing = jax.vmap(target_network)(rows.after)[:, 1, STAND]
    masked = rows.temperature_action_masked
    y = rows.reward + gamma * ahead.at[:, 1].set(jnp.where(masked, standing, ahead[:, 1]))
    taken = jax.nn.one_hot(rows.action, ACTIONS)

    def loss(network, x, taken, y):
        return ((y - (jax.vmap(network)(x) * taken).sum(axis=2)) ** 2).mean()

    gradient = _mean_gradient(loss, network, rows.x, taken, y)
    change, opt_state = problem.optimiser.update(gradient, train_state.opt_state)
    network = optax.apply_updates(network, change)
    target_network = jax.tree.map(lambda old, new: tau * new + (1 - tau) * old, target_network, network)
    return DqnState(network, target_network, opt_state)


def _mean_gradient(loss: Callable, network, *batch: jax.Array):
    """Returns the gradient of the mean of `loss` over the rows of `batch`. It is the mean over slices of at
    most SHORT rows, so that sums have the same order on every CPU."""
    parts = next(
        n for n in range(1, len(batch[0]) + 1) if len(batch[0]) % n == 0 and len(batch[0]) <= n * SHORT
    )
    slices = zip(*(jnp.split(a, parts) for a in batch), strict=True)
    return jax.tree.map(lambda *g: sum(g) / parts, *(jax.grad(loss)(network, *rows) for rows in slices))


class PhaseResult(NamedTuple):
    """The train state after a phase; the mean reward of each step (updates,); and the networks after each of
    the CHECKPOINTS equal parts of the phase, with leaves (CHECKPOINTS, ...)."""

    train_state: DqnState
    rewards: jax.Array
    checkpoints: Any


def phase(
    train_state: DqnState,
    key: jax.Array,
    problem: DqnProblem,
    *,
    updates: int,
    longest: int,
    epsilon: tuple[float, float],
) -> PhaseResult:
    """Trains a whole phase as one compiled program. Epsilon falls linearly over the first third of the
    updates.

    Starts with an empty replay buffer, then `updates` times: one step of all episodes, one batch, one update.
    Episodes start at different steps, so that they do not end together. `longest`: the updates of the longest
    phase; phases with the same `longest` share one program, compiled once.
    """
    train_state, rewards, checkpoints = _phase(
        train_state, key, problem, jnp.asarray(updates), jnp.asarray(epsilon), longest=longest
    )
    return PhaseResult(train_state, rewards[:updates], checkpoints)


@eqx.filter_jit
def _phase(train_state: DqnState, key, problem: DqnProblem, updates, epsilon, *, longest: int):
    settings = problem.settings
    k_start, k_clock, key = jax.random.split(key, 3)
    n, capacity = settings.environments, settings.capacity
    conditions, state, memory, x = _fresh(problem, train_state.network, jax.random.split(k_start, n))
    state = state._replace(step=LAMBDA * jax.random.randint(k_clock, (n,), 0, settings.episode // LAMBDA))
    # a step draws some thousand random numbers, so XLA's own generator
    # (Philox) is used, which costs a tenth of jax's default here
    fast = jax.random.wrap_key_data(jnp.tile(jax.random.key_data(key), 2), impl="rbg")

    def one(i, carry):
        train_state, episodes, replay_buffer, rewards = carry
        k_step, k_batch = (jax.random.fold_in(fast, 2 * i + j) for j in (0, 1))
        now = epsilon[0] + (epsilon[1] - epsilon[0]) * jnp.minimum(3.0 * i / updates, 1.0)
        u = jax.random.uniform(k_step, (n, 4 + CHANCES))
        episodes, new = _stepped(problem, train_state.network, episodes, now, u, jax.random.fold_in(key, i))
        replay_buffer = jax.lax.dynamic_update_slice_in_dim(replay_buffer, _packed(new), i * n % capacity, 0)
        filled = jnp.minimum((i + 1) * n, capacity).astype(jnp.uint32)
        chosen = (jax.random.bits(k_batch, (settings.batch,)) % filled).astype(jnp.int32)
        train_state = _updated(train_state, _unpacked(replay_buffer[chosen]), problem)
        return train_state, episodes, replay_buffer, rewards.at[i].set(new.reward.mean())

    def part(carry, k):
        carry = jax.lax.fori_loop(k * updates // CHECKPOINTS, (k + 1) * updates // CHECKPOINTS, one, carry)
        return carry, carry[0].network

    replay_buffer = jnp.zeros((capacity, 2 * x.shape[1] + 5))
    (train_state, _, _, rewards), checkpoints = jax.lax.scan(
        part,
        (train_state, (conditions, state, memory, x), replay_buffer, jnp.zeros(longest)),
        jnp.arange(CHECKPOINTS),
    )
    return train_state, rewards, checkpoints


# ---- the paper's four phases


class PublishedAgent(NamedTuple):
    """The networks after phases 1 to 4 (for phase 4 the best checkpoint), and the mean reward of each step of
    each phase."""

    networks: tuple[QNetwork, ...]
    rewards: tuple[jax.Array, ...]


def ellipse(a, b, state: MachineState) -> jax.Array:
    """Returns the reward (14) of the state, repeated for both heads (2,)."""
    return jnp.tile(reward(state.flow, state.temperature, a=a, b=b), 2)


def anywhere(accuracy, key: jax.Array) -> EpisodeConditions:
    """Returns the conditions of an undisturbed machine that starts at a flow and temperature uniform within
    the limits."""
    u = jax.random.uniform(key, (2,))
    low, high = jnp.array([FLOW_LIMITS, TEMPERATURE_LIMITS]).T
    flow, temperature = low + (high - low) * u
    return nominal(flow, temperature, accuracy=accuracy)


class PublishedTraining(NamedTuple):
    """`updates`: of each phase, one number for each phase; `accuracy`: of the windows in the last phase.

    In each phase epsilon falls from its `explore` to `least`. `history`: eta of (8). The learning rate of
    phase 4 falls linearly to the fraction `rate_at_end` (1: it does not fall).
    """

    dqn: DqnSettings
    learning_rate: float
    updates: tuple[int, ...]
    accuracy: float
    explore: tuple[float, ...]
    least: float
    rate_at_end: float = 1.0
    history: int = HISTORY


def train_published(key: jax.Array, settings: PublishedTraining) -> PublishedAgent:
    """Trains the four phases with Adam. Reward shapes are (40, 20), (40, 10) and (20, 10) with windows that
    are always right; phase 4 keeps the last shape, with windows of the given `accuracy`, and keeps its best
    checkpoint."""
    train_state, key = begin_published(key, settings)
    networks, all_rewards = [], []
    for i in range(len(settings.updates)):
        result = published_phase(train_state, key, settings, i)
        train_state = result.train_state
        network = train_state.network if i < len(PHASES) else best_checkpoint(result, key, settings).network
        networks.append(network)
        all_rewards.append(result.rewards)
    return PublishedAgent(tuple(networks), tuple(all_rewards))


def begin_published(key: jax.Array, settings: PublishedTraining) -> tuple[DqnState, jax.Array]:
    """Returns the train state before phase 1, and the key of all phases."""
    k_network, key = jax.random.split(key)
    network = QNetwork(k_network, settings.history)
    moments = _adam(settings.learning_rate).init(eqx.filter(network, eqx.is_array))
    return DqnState(network, network, moments), key


@cache  # one for equal phases, so that their compiled program is used again
def _adam(
    rate: float, at_end: float = 1.0, updates: int = 1, before: int = 0
) -> optax.GradientTransformation:
    """Returns Adam with a learning rate that falls linearly to the fraction `at_end` within `updates`
    updates, after the `before` updates of earlier phases."""
    return optax.adam(optax.linear_schedule(rate, rate * at_end, updates, before))


def published_phase(
    train_state: DqnState, key: jax.Array, settings: PublishedTraining, i: int
) -> PhaseResult:
    """Trains phase i + 1, starting from the train state of the phase before."""
    a, b = PHASES[min(i, len(PHASES) - 1)]
    last = i == len(PHASES)
    right, before = settings.accuracy if last else 1.0, sum(settings.updates[:i])
    start = Partial(anywhere, jnp.asarray(right))
    env = EnvSpec(paper_windows(), start, Partial(ellipse, jnp.asarray(a), jnp.asarray(b)))
    falls = (settings.rate_at_end, settings.updates[i], before) if last else ()
    return phase(
        train_state,
        jax.random.fold_in(key, i),
        DqnProblem(
            paper_encoder(settings.history),
            env,
            _adam(settings.learning_rate, *falls),
            dqn_target,
            settings.dqn,
        ),
        updates=settings.updates[i],
        longest=max(settings.updates),
        epsilon=(settings.explore[i], settings.least),
    )


class Checkpoint(NamedTuple):
    """A network in the middle of a phase; `after`, how many of the CHECKPOINTS parts are done; and the
    percentages of validation runs from the 21 starts that reach the target (`settled`), and that reach and
    keep it (`stay`)."""

    network: QNetwork
    after: int
    settled: float
    stay: float


def best_checkpoint(result: PhaseResult, key: jax.Array, settings: PublishedTraining) -> Checkpoint:
    """Returns the checkpoint of a phase with most validation runs that keep the target. A tie goes to the
    most runs that reach it, then to the last checkpoint."""
    conditions = trials.starts(VALIDATION_RUNS, accuracy=settings.accuracy)
    key, found = jax.random.fold_in(key, 100), []
    for k in range(CHECKPOINTS):
        network: QNetwork = jax.tree.map(lambda leaf, k=k: leaf[k], result.checkpoints)
        told = trials.evaluate(published(network), network, paper_windows(), conditions, key)
        found.append(Checkpoint(network, k + 1, told.settled.percent, told.stay.percent))
    return max(found, key=lambda one: (one.stay, one.settled, one.after))


def run_starts(network: QNetwork, *, accuracy: float) -> Trajectory:
    """Simulates RUNS episodes from each of the 21 starts, with random numbers used neither in training nor in
    validation. Every page's figures for an agent on the paper's simulator come from these runs."""
    key, conditions = jax.random.key(JUDGED_SEED), trials.starts(RUNS, accuracy=accuracy)
    return rollout(published(network), network, paper_windows(), conditions, key, steps=STEPS)


# ---- weights by name


def weights(network: eqx.Module) -> dict[str, np.ndarray]:
    """Returns the network's arrays, named by their place in it, to be written to a file."""
    return {_place(path): np.asarray(leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(network)}


def _place(path) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")


def untrained(make: Callable[..., eqx.Module], *sizes: int) -> eqx.Module:
    """Returns make(key, *sizes) with the shapes of its arrays only, for `with_weights`. Drawing random
    weights takes long to compile, and they would be thrown away."""
    return eqx.filter_eval_shape(lambda key: make(key, *sizes), jax.random.key(0))


def with_weights(network: eqx.Module, arrays: dict[str, np.ndarray]) -> eqx.Module:
    """Returns the network with these arrays in place of its own; shapes suffice for its own (`untrained`).

    Raises ValueError if names or shapes belong to another architecture.
    """
    own = {_place(path): np.shape(leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(network)}
    wrong = sorted(own.keys() ^ arrays.keys()) or [
        name for name in own if own[name] != np.shape(arrays[name])
    ]
    if wrong:
        shape = f"shape {np.shape(arrays[wrong[0]])}" if wrong[0] in arrays else "none"
        raise ValueError(
            f"weights of another architecture: {wrong[0]!r} is "
            f"{f'of shape {own[wrong[0]]}' if wrong[0] in own else 'unknown'} in this "
            f"network and {shape} in "
            "the file; train again, or load them into the network that they were trained in"
        )
    return jax.tree.unflatten(jax.tree.structure(network), [jnp.asarray(arrays[name]) for name in own])


# ---- rows of controllers.CONTROLLERS: settings, agents and recorded windows -> controller and parameters


def published(network: QNetwork) -> SetpointController:
    """Returns the controller of the paper's agent; its parameters are this network."""
    return greedy(paper_encoder(history_of(network)))


def build(
    settings: Mapping[str, Any], agents: PublishedAgent, windows: Any
) -> tuple[SetpointController, QNetwork]:
    """Returns the agent of Li and Pattinson (2025) after its last trained phase."""
    network = agents.networks[-1]
    return published(network), network
