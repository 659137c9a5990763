"""Belief DQN: deep Q-learning on a belief. The Bayes filter of bayes.py turns windows and moves into a belief
of the flow, so that a small network meets a problem that is nearly Markov. It starts from the value
that the belief would have were the flow observed from the next step on, and double Q-learning in disturbed
episodes adds what that leaves out: hesitation while moves are cheap to regret, haste after a clog, and
distrust of the filter where the machine is none of its hypotheses.

Nothing tells the agent the classifier's accuracy, the actuator's gain or the setpoint:
accuracies and gains are hypotheses of the filter.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.tree_util import Partial

from pipeline.setpoint.agents import bayes
from pipeline.setpoint.agents.agent import (
    ACTIONS,
    TEMPERATURE_SCALE,
    DqnProblem,
    DqnSettings,
    DqnState,
    EnvSpec,
    ObservationEncoder,
    double_dqn_target,
    greedy,
    phase,
)
from pipeline.setpoint.published import (
    BEST_FLOW,
    BEST_TEMPERATURE,
    DELTA,
    FLOW_MOVES,
    LAMBDA,
    PHASES,
    TEMPERATURE_MOVES,
)
from pipeline.setpoint.simulation.recorded import WindowTable, recorded_windows
from pipeline.setpoint.simulation.simulator import (
    FLOW_LIMITS,
    GOOD,
    STAND,
    TEMPERATURE_LIMITS,
    EpisodeConditions,
    MachineState,
    Observation,
    SetpointController,
    WindowSource,
    flow_class,
    nominal,
    paper_windows,
    reward,
    rollout,
)

SINGLE = (
    60.0,
    150.0,
)  # percent of flow between which the network sees every point of the grid; outside it sees groups of GROUP
GROUP = 4
VALIDATION = 384  # episodes, the same after each round: the mean cost of a step to about 2 %
AT_REST = 0.1  # by which a move's value lies below standing's where the filter rests
AHEAD = 40  # steps after which a heater of (6) has 1e-4 of its way left


class Belief(NamedTuple):
    """filter: of bayes.py; values (5, N): of each flow action were the flow observed, under the discount
    gamma."""

    filter: bayes.Filter
    values: jax.Array
    gamma: float


class StepCosts(NamedTuple):
    """Of a step: |q - 100 %| / scale, `outside` where the class is not good, and `move` for every percent
    that the setpoint moved; in percent of flow where not bare."""

    scale: float
    outside: float
    move: float


def flow_reward(costs: StepCosts, flow: jax.Array, move: jax.Array) -> jax.Array:
    """- |q - q*| / scale - outside [class not good] - move cost |a|: a median is sought where (14) seeks a
    mode, so far flows that are in doubt weigh as much as near ones."""
    return (
        -jnp.abs(flow - BEST_FLOW) / costs.scale
        - costs.outside * (flow_class(flow) != GOOD)
        - costs.move * jnp.abs(move)
    )


def rewards(costs: StepCosts, state: MachineState) -> jax.Array:
    """(2,) for the heads: the flow's and the temperature's. Neither
    moves the other, so neither is blamed for it."""
    return jnp.stack([flow_reward(costs, state.flow, state.flow_move), temperature_reward(state.temperature)])


def temperature_reward(temperature: jax.Array) -> jax.Array:
    """The third ellipse (14) cut along q*."""
    a, b = PHASES[-1]
    return reward(BEST_FLOW, temperature, a=a, b=b)


def observed_values(costs: StepCosts, gamma: float) -> np.ndarray:
    """Q (5, N) were the flow observed: Q(a, q) = r(q + a, a) + gamma max_a' Q(a',
    q + a), by value iteration on the filter's grid."""
    moves = np.array(FLOW_MOVES)[:, None]
    after = np.clip(np.arange(len(bayes.GRID)) + (moves / bayes.SPACING).astype(int), 0, len(bayes.GRID) - 1)
    r = np.asarray(flow_reward(costs, jnp.asarray(bayes.GRID)[after], jnp.asarray(moves)), float)
    Q = np.zeros(after.shape)
    while True:
        better = r + gamma * Q.max(axis=0)[after]
        if np.abs(better - Q).max() < 1e-6:
            return better
        Q = better


def _pooling() -> np.ndarray:
    """(N, pools) of zeros and ones: which points of the grid the network sees together."""
    single = (bayes.GRID >= SINGLE[0]) & (bayes.GRID <= SINGLE[1])
    first = np.r_[True, single[1:] | single[:-1] | (np.arange(1, len(single)) % GROUP == 0)]
    return np.eye(first.sum())[np.cumsum(first) - 1]


POOLING = _pooling()


def slower(gamma: float) -> float:
    """The temperature's discount a step, gamma^(1/lambda): from one of its actions to the next as much is
    lost as from one action of the flow to the next."""
    return gamma ** (1 / LAMBDA)


def standing_values(observation: Observation, gamma: float) -> jax.Array:
    """(5,) of each temperature action were the target to stand thereafter: sum over k of gamma^(k-1) r(u_k),
    with u_k - target = (1 - 1/delta)^k (u_hat - target) by (6).

    Where lambda's clock heeds no action, each is worth what standing is.
    """
    heeded = observation.step % LAMBDA == 0
    target = jnp.clip(
        observation.target + jnp.where(heeded, jnp.asarray(TEMPERATURE_MOVES), 0.0), *TEMPERATURE_LIMITS
    )
    k = jnp.arange(1, AHEAD + 1)[:, None]
    u = target + (1 - 1 / DELTA) ** k * (observation.temperature - target)
    return (gamma ** (k - 1) * temperature_reward(u)).sum(axis=0) + gamma**AHEAD / (
        1 - gamma
    ) * temperature_reward(target)


def belief_encoder(of: Belief) -> ObservationEncoder:
    """x = [whether the filter itself would rest, values of the flow's actions (5), pooled belief, hypotheses
    (H), values of the temperature's actions (5), u_hat, u_bar, clock, heeded]."""
    # the belief's tables are arguments: as constants each of them would be compiled anew
    return ObservationEncoder(
        Partial(bayes.initial_state, of.filter.evidence.shape[0]), Partial(_encoded, of)
    )


def _encoded(of: Belief, network, state: bayes.FilterState, observation: Observation):
    state = bayes.filter_update(of.filter, state, observation)
    belief = state.belief
    flow, clock = belief.sum(axis=0), observation.step % LAMBDA
    temperatures = (
        jnp.stack([observation.temperature, observation.target]) - BEST_TEMPERATURE
    ) / TEMPERATURE_SCALE
    rest = [
        standing_values(observation, slower(of.gamma)),
        temperatures,
        jnp.stack([clock / LAMBDA, clock == 0]),
    ]
    pooled = flow @ jnp.asarray(POOLING, jnp.float32)
    rests = bayes.expected_loss(of.filter, belief, observation.flow_move).argmin() == STAND
    values = of.values @ flow
    return state, jnp.concatenate(
        [rests[None].astype(values.dtype), values, pooled, belief.sum(axis=1), *rest]
    )


class Correction(eqx.Module):
    """What is added to the values of five actions: a common part and a part of each with mean zero (dueling:
    Wang and others 2016), both zero before training."""

    hidden: tuple[eqx.nn.Linear, ...]
    last: eqx.nn.Linear

    def __init__(self, sizes: tuple[int, ...], key: jax.Array):
        keys = jax.random.split(key, len(sizes))
        self.hidden = tuple(
            eqx.nn.Linear(m, n, key=k) for m, n, k in zip(sizes[:-1], sizes[1:], keys[:-1], strict=True)
        )
        self.last = jax.tree.map(jnp.zeros_like, eqx.nn.Linear(sizes[-1], ACTIONS + 1, key=keys[-1]))

    def __call__(self, x: jax.Array) -> jax.Array:
        for layer in self.hidden:
            x = jax.nn.relu(layer(x))
        common, *_ = out = self.last(x)
        return common + out[1:] - out[1:].mean()


class BeliefNetwork(eqx.Module):
    """Q (2, 5): of each head the values that it starts from and their correction; the
    temperature's sees temperatures and clock alone. No move of the flow is best where the filter rests."""

    flow: Correction
    temperature: Correction

    def __init__(self, hypotheses: int, key: jax.Array):
        keys = jax.random.split(key, 2)
        self.flow = Correction((ACTIONS + POOLING.shape[1] + hypotheses, 128, 64), keys[0])
        self.temperature = Correction((ACTIONS + 4, 32), keys[1])

    def __call__(self, x: jax.Array) -> jax.Array:
        rests, flow_part, temperature_part = x[0] > 0, x[1 : -ACTIONS - 4], x[-ACTIONS - 4 :]
        values, temperature_values = flow_part[:ACTIONS], temperature_part[:ACTIONS]
        heeded = temperature_part[-1] > 0
        correction = self.temperature(temperature_part)
        Q = values + self.flow(flow_part.at[:ACTIONS].add(-values.max()))
        # where the filter rests so does the agent: it may do less harm than the filter, and no more
        below = jnp.minimum(Q, jax.lax.stop_gradient(Q[STAND]) - AT_REST)
        Q = jnp.where(rests & (jnp.arange(ACTIONS) != STAND), below, Q)
        return jnp.stack(
            [Q, temperature_values + jnp.where(heeded, correction, correction[STAND])]
        )  # what is not heeded is standing


# ---- training


class EpisodeDisturbances(NamedTuple):
    """What training episodes meet, each drawn uniformly: the share of episodes on recorded windows (the rest
    on the paper's) and how long a segment may last; from which accuracy, gain and clog up to 1, clogs in a
    share of the episodes and at any step; drift a step up to +- this."""

    recorded_share: float
    longest_segment: float
    accuracy: float
    gain: float
    clog: float
    clog_share: float
    drift: float


def paper_or_recorded(table: WindowTable) -> WindowSource:
    """The paper's windows where a segment lasts no time (persistence 0), recorded
    ones otherwise: one source for a world of both."""
    paper, recorded = paper_windows(), recorded_windows(table)

    def draw(arrays, conditions, flow, segment, u):
        recorded_now = conditions.persistence > 0
        both = (
            recorded.draw(arrays, conditions, flow, segment, u),
            paper.draw((), conditions, flow, segment, u),
        )
        return tuple(jnp.where(recorded_now, *pair) for pair in zip(*both, strict=True))

    return WindowSource(draw, recorded.table)


def disturbed(disturbances: EpisodeDisturbances, length: int, key: jax.Array) -> EpisodeConditions:
    """Conditions of one episode; starts are uniform in the logarithm
    of the flow, as errors of extrusion are ratios."""
    u = jax.random.uniform(key, (10,))
    low, high = np.log(FLOW_LIMITS)
    as_told = nominal(
        jnp.exp(low + (high - low) * u[0]),
        TEMPERATURE_LIMITS[0] + (TEMPERATURE_LIMITS[1] - TEMPERATURE_LIMITS[0]) * u[1],
        accuracy=disturbances.accuracy + (1 - disturbances.accuracy) * u[2],
    )
    return as_told._replace(
        persistence=jnp.where(u[3] < disturbances.recorded_share, disturbances.longest_segment ** u[4], 0.0),
        gain=disturbances.gain + (1 - disturbances.gain) * u[5],
        clog=disturbances.clog + (1 - disturbances.clog) * u[6],
        clog_step=jnp.where(u[7] < disturbances.clog_share, jnp.floor(length * u[8]), -1.0),
        drift=disturbances.drift * (2 * u[9] - 1),
    )


class BeliefTraining(NamedTuple):
    """What a step costs, what episodes meet, and how deep Q-learning goes: `rounds` of `updates`; epsilon
    falls from `explore` to `least` in each."""

    costs: StepCosts
    disturbances: EpisodeDisturbances
    dqn: DqnSettings
    learning_rate: float
    updates: int
    rounds: int
    explore: float
    least: float


class TrainedBeliefDqn(NamedTuple):
    """The network kept; validation: mean cost-less-reward a step of validation episodes before training and
    after each round, the best of which (best_round) it is; rewards of each training step."""

    network: BeliefNetwork
    validation: tuple[float, ...]
    best_round: int
    rewards: jax.Array


def train(
    key: jax.Array, of: Belief, table: WindowTable, settings: BeliefTraining, *, on_step=None
) -> TrainedBeliefDqn:
    """Double Q-learning in disturbed episodes on the paper's windows and on recorded ones, Adam with a rate
    that falls by a cosine to zero over all rounds.

    After each of the rounds the network is judged on VALIDATION episodes drawn as the
    training's are, and the best is kept: what it started from, if nothing was better.
    on_step(round, network, judged) is called after each.
    """
    dqn, updates, rounds = settings.dqn, settings.updates, settings.rounds
    k_network, k_judge, key = jax.random.split(key, 3)
    encoder, env = belief_encoder(of), _environment(table, settings)
    network, optimiser = (
        BeliefNetwork(of.filter.evidence.shape[0], k_network),
        optax.adam(optax.cosine_decay_schedule(settings.learning_rate, rounds * updates)),
    )
    train_state = DqnState(network, network, optimiser.init(network))
    episodes, controller = jax.vmap(env.conditions)(jax.random.split(k_judge, VALIDATION)), greedy(encoder)

    def judge(network):
        trajectory = rollout(controller, network, env.windows, episodes, k_judge, steps=dqn.episode)
        moves = jnp.asarray(FLOW_MOVES)[trajectory.action.flow]
        return float(
            flow_reward(settings.costs, trajectory.flow[:, 1:], moves).mean()
            + temperature_reward(trajectory.temperature[:, 1:]).mean()
        )

    dqn = dqn._replace(gamma=jnp.array([dqn.gamma, slower(dqn.gamma)]))
    problem = DqnProblem(encoder, env, optimiser, double_dqn_target, dqn)
    networks, validation, all_rewards = [network], [judge(network)], []
    for i in range(rounds):
        train_state, mean_rewards, _ = phase(
            train_state,
            jax.random.fold_in(key, i),
            problem,
            updates=updates,
            longest=updates,
            epsilon=(settings.explore, settings.least),
        )
        networks.append(train_state.network)
        validation.append(judge(train_state.network))
        all_rewards.append(mean_rewards)
        if on_step is not None:
            on_step(i + 1, train_state.network, validation[-1])
    best = int(np.argmax(validation))
    return TrainedBeliefDqn(networks[best], tuple(validation), best, jnp.concatenate(all_rewards))


def _environment(table: WindowTable, settings: BeliefTraining) -> EnvSpec:
    """Disturbed episodes on the paper's windows and on recorded ones, paid by what a step costs."""
    return EnvSpec(
        paper_or_recorded(table),
        Partial(disturbed, settings.disturbances, settings.dqn.episode),
        Partial(rewards, settings.costs),
    )


def _strange(of: bayes.Filter, network: BeliefNetwork, memory: bayes.FilterState) -> jax.Array:
    return bayes.strange(of, memory)


def build(
    settings: Mapping[str, Any], agents: Any, windows: WindowTable
) -> tuple[SetpointController, BeliefNetwork]:
    """The row of controllers.CONTROLLERS: the network on the belief of its filter, which also tells whether
    the camera is another."""
    controller = greedy(belief_encoder(agents.belief))
    return controller._replace(strange=Partial(_strange, agents.belief.filter)), agents.belief_dqn
