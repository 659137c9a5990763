"""What train_agent does: the agent of Li and Pattinson (2025) in its phases, and the belief DQN on the belief
of a filter fitted to the classifier's recorded windows."""

import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from pipeline.setpoint import agent, bayes, belief_agent, judging
from pipeline.setpoint.belief_agent import Belief
from pipeline.setpoint.recorded import WindowTable, recorded_windows
from pipeline.setpoint.score import Score
from pipeline.setpoint.workflow.agent_files import Agents
from pipeline.setpoint.workflow.settings import BeliefDqn, Learning, Li2025, RobustFilter, TrainAgent

# points of a learning curve that a page has room for, of each phase
POINTS = 50


class TrainedAgents(NamedTuple):
    """The agents; of the belief DQN the round that was kept and what each was worth; and the learning curves
    of both as rows (agent, phase, update, reward)."""

    agents: Agents
    best_round: int
    validation: tuple[float, ...]
    curve: list[tuple[str, int, int, float]]


def dqn_settings(settings: Learning) -> agent.DqnSettings:
    """The numbers of deep Q-learning."""
    return agent.DqnSettings(
        settings.gamma,
        settings.tau,
        settings.batch,
        settings.capacity,
        settings.environments,
        settings.episode,
    )


def published_training(settings: Li2025) -> agent.PublishedTraining:
    """The numbers of the published phases."""
    return agent.PublishedTraining(
        dqn=dqn_settings(settings),
        learning_rate=settings.learning_rate,
        updates=tuple(settings.updates),
        accuracy=settings.accuracy,
        explore=settings.explore,
        explore_again=settings.explore_again,
        least=settings.least,
    )


def belief_training(settings: BeliefDqn) -> belief_agent.BeliefTraining:
    """The numbers of training on the belief."""
    return belief_agent.BeliefTraining(
        costs=belief_agent.Costs(**settings.costs.model_dump()),
        disturbances=belief_agent.Disturbances(**settings.disturbances.model_dump()),
        dqn=dqn_settings(settings),
        learning_rate=settings.learning_rate,
        updates=settings.updates,
        rounds=settings.rounds,
        explore=settings.explore,
        least=settings.least,
    )


def error_model(settings: RobustFilter) -> bayes.CameraErrorModel:
    """The numbers of the robust filter."""
    return bayes.CameraErrorModel(**settings.model_dump())


def belief(settings: BeliefDqn, windows: WindowTable) -> Belief:
    """The filter on recorded windows, and the value of each move were the flow observed."""
    robust = bayes.robust_filter(windows, error_model(settings.filter))
    values = belief_agent.observed_values(belief_agent.Costs(**settings.costs.model_dump()), settings.gamma)
    return Belief(robust, jnp.asarray(values, jnp.float32), settings.gamma)


def train_agents(settings: TrainAgent, windows: WindowTable) -> TrainedAgents:
    """Both agents, trained from keys of one seed on the windows to learn from."""
    key, updates, rounds = jax.random.key(settings.seed), settings.li_2025.updates, settings.belief_dqn.rounds
    curve: list[tuple[str, int, int, float]] = []
    with tqdm(total=len(updates) + rounds, desc="train_agent: phases", mininterval=2) as bar:
        published = agent.train_published(
            jax.random.fold_in(key, 0), published_training(settings.li_2025), on_step=lambda *_: bar.update()
        )
        for i, rewards in enumerate(published.rewards):
            curve += _curve("li_2025", i + 1, sum(updates[:i]), rewards)
        of = belief(settings.belief_dqn, windows)
        trained = belief_agent.train(
            jax.random.fold_in(key, 1),
            of,
            windows,
            belief_training(settings.belief_dqn),
            on_step=lambda *_: bar.update(),
        )
    for i, rewards in enumerate(np.split(np.asarray(trained.rewards), rounds)):
        curve += _curve("belief_dqn", i + 1, i * settings.belief_dqn.updates, rewards)
    agents = Agents(published.networks, of, trained.network)
    return TrainedAgents(agents, trained.best_round, trained.validation, curve)


def _curve(name: str, phase: int, before: int, rewards) -> list[tuple[str, int, int, float]]:
    """Means of at most POINTS stretches of a phase."""
    values = np.atleast_2d(np.asarray(rewards, float).reshape(len(rewards), -1).T).mean(axis=0)
    ends = np.unique(np.linspace(0, len(values), POINTS + 1).round().astype(int))
    return [
        (name, phase, int(before + b), float(values[a:b].mean()))
        for a, b in itertools.pairwise(ends)
        if b > a
    ]


def curve_rows(trained: TrainedAgents) -> dict[str, list]:
    """Columns of schema AGENT_CURVE."""
    return dict(
        zip(("agent", "phase", "update", "reward"), map(list, zip(*trained.curve, strict=True)), strict=True)
    )


def metrics(settings: TrainAgent, trained: TrainedAgents, windows: WindowTable) -> dict[str, Any]:
    """The agent of Li and Pattinson (2025) after three phases where the class is always right, and after the
    last one where it is not; the belief DQN at the same accuracies. All on the windows to judge by."""
    key = jax.random.key(settings.seed + 1)
    cases = judging.cases(recorded_windows(windows), runs=settings.runs, segment_mean_decisions=10.0)
    right, noisy = cases["accuracy 1"], cases["accuracy 0.7"]
    agents = trained.agents
    published = agent.greedy(agent.paper_encoder())
    on_belief = agent.greedy(belief_agent.belief_encoder(agents.belief))
    judged = {
        f"phase{i + 1}": (published, network, right if i < 3 else noisy)
        for i, network in enumerate(agents.li_2025)
        if i >= 2
    }
    judged |= {
        "phase3_at_0.7": (published, agents.li_2025[2], noisy),
        "belief_dqn": (on_belief, agents.belief_dqn, right),
        "belief_dqn_at_0.7": (on_belief, agents.belief_dqn, noisy),
    }
    figures = {
        name: _figures(judging.evaluate(controller, network, *case, key))
        for name, (controller, network, case) in judged.items()
    }
    return figures | {
        "parameters": {"li_2025": _size(agents.li_2025[0]), "belief_dqn": _size(agents.belief_dqn)},
        "kept_round": trained.best_round,
        "validation": list(trained.validation),
        "rounds": settings.belief_dqn.rounds,
    }


def _size(network) -> int:
    return sum(np.size(leaf) for leaf in jax.tree.leaves(network))


def _figures(score: Score) -> dict[str, Any]:
    steps = {
        name: float(value) if np.isfinite(value) else None
        for name, value in (("median_steps", score.median_steps), ("p90_steps", score.p90_steps))
    }
    return {
        "runs": score.runs,
        "settled": score.settled.percent,
        "settled_low": score.settled.low,
        "stay": score.stay.percent,
        "overshoot_p95": score.overshoot_p95,
        **steps,
    }
