"""What train_agent does: the agent of Li and Pattinson (2025) in its phases, and the belief DQN on the belief
of a filter fitted to the classifier's recorded windows."""

import contextlib
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import joblib
import numpy as np
from tqdm import tqdm

from pipeline.setpoint.agents import agent, bayes, belief_agent, judging
from pipeline.setpoint.agents.belief_agent import Belief
from pipeline.setpoint.published import ALPHA, DELTA, SIGMA
from pipeline.setpoint.score import Score
from pipeline.setpoint.simulation.recorded import WindowTable
from pipeline.setpoint.simulation.simulator import (
    FLOW_LIMITS,
    TEMPERATURE_LIMITS,
    nominal,
    paper_windows,
    rollout,
)
from pipeline.setpoint.workflow.agent_files import Agents, restore_published, store_published
from pipeline.setpoint.workflow.settings import BeliefDqn, Learning, Li2025, RobustFilter, TrainAgent
from pipeline.store import artifacts

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
        history=settings.history,
        flow_actions=settings.flow_actions,
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
    """The filter on recorded windows, which tells when the camera is not theirs, and the value of each move
    were the flow observed."""
    robust = bayes.watching_filter(windows, error_model(settings.filter))
    values = belief_agent.observed_values(belief_agent.Costs(**settings.costs.model_dump()), settings.gamma)
    return Belief(robust, jnp.asarray(values, jnp.float32), settings.gamma)


# the code that decides what the agent of Li and Pattinson (2025) comes to, which sees no recorded window
HERE = Path(__file__).parents[1]
PUBLISHED_CODE = ("agent.py", "simulator.py", "actuation.py", "published.py")


def published_agent(
    settings: TrainAgent, memo: Path | None, on_step: Callable[..., object]
) -> agent.Published:
    """The agent of Li and Pattinson (2025): trained, or taken from the memo where the same settings were
    trained by the same code. A damaged entry is trained again."""
    own = settings.li_2025
    code = [artifacts.sha256(HERE / name) for name in PUBLISHED_CODE]
    entry = (
        memo and memo / f"{joblib.hash((own.model_dump(), settings.seed, code, jax.__version__))}.safetensors"
    )
    if entry and entry.is_file():
        with contextlib.suppress(ValueError):
            return restore_published(entry)
    key = jax.random.fold_in(jax.random.key(settings.seed), 0)
    published = agent.train_published(key, published_training(own), on_step=on_step)
    if entry:
        store_published(entry, published.networks, published.rewards)
    return published


def train_agents(settings: TrainAgent, windows: WindowTable, *, memo: Path | None = None) -> TrainedAgents:
    """Both agents, trained from keys of one seed, ours on the windows to learn from; a memo keeps the
    published one, so that other windows do not train it again."""
    key, updates, rounds = jax.random.key(settings.seed), settings.li_2025.updates, settings.belief_dqn.rounds
    curve: list[tuple[str, int, int, float]] = []
    with tqdm(total=len(updates) + rounds, desc="train_agent: phases", mininterval=2) as bar:
        published = published_agent(settings, memo, lambda *_: bar.update())
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


def metrics(settings: TrainAgent, trained: TrainedAgents) -> dict[str, Any]:
    """The agent of Li and Pattinson (2025) after three phases and after the last one, where the class is
    always right and where it is not, on the paper's simulator, and what the paper claims of it; the belief
    DQN at the same accuracies."""
    key, agents, own = jax.random.key(settings.seed + 1), trained.agents, settings.li_2025
    right, noisy = (judging.starts(settings.runs, accuracy=accuracy) for accuracy in (1.0, 0.7))
    published = agent.greedy(agent.paper_encoder(own.history))
    on_belief = agent.greedy(belief_agent.belief_encoder(agents.belief))
    judged = {"phase3": (published, agents.li_2025[2], right)}
    if len(agents.li_2025) > 3:
        judged |= {
            "phase4": (published, agents.li_2025[3], noisy),
            "phase4_at_1": (published, agents.li_2025[3], right),
        }
    judged = {
        name: (controller, network, asked._replace(flow_actions=own.flow_actions * jnp.ones_like(asked.flow)))
        for name, (controller, network, asked) in (
            judged | {"phase3_at_0.7": (published, agents.li_2025[2], noisy)}
        ).items()
    }
    judged |= {
        "belief_dqn": (on_belief, agents.belief_dqn, right),
        "belief_dqn_at_0.7": (on_belief, agents.belief_dqn, noisy),
    }
    figures = {
        name: _figures(judging.evaluate(controller, network, paper_windows(), conditions, key))
        for name, (controller, network, conditions) in judged.items()
    }
    return figures | {
        "parameters": {"li_2025": _size(agents.li_2025[0]), "belief_dqn": _size(agents.belief_dqn)},
        "kept_round": trained.best_round,
        "validation": list(trained.validation),
        "rounds": settings.belief_dqn.rounds,
        "claims": claims(settings, agents.li_2025),
        "guesses": guesses(own),
    }


# of the claims: runs from each start, and decisions at the end over which a run has come to rest
CLAIM_RUNS, RESTING = 100, 20


def claims(settings: TrainAgent, networks: Sequence[agent.QNetwork]) -> dict[str, dict[str, Any]]:
    """What Li and Pattinson (2025) tell of single starts (sections 3.3 and 3.4, figures 7 and 8), beside what
    CLAIM_RUNS runs of ours come to: medians, in percent of flow and °C.

    rests_at: mean flow of the last decisions; least and most: of the flow after it first came within 10 % of
    100 %; flow_range and temperature_range: from least to most over the second half of the run.
    """
    last, deployed = networks[-1], settings.li_2025.accuracy if len(networks) > 3 else 1.0
    told = {
        "300 %, 230 °C": ({"rests_at": 95.0, "least": 75.0, "most": 130.0}, last, 300.0, 230.0, deployed),
        "30 %, 190 °C": ({"rests_at": 100.0, "most": 130.0}, last, 30.0, 190.0, deployed),
    } | {
        f"232 %, 190 °C after phase {number}": (printed, networks[number - 1], 232.0, 190.0, 1.0)
        for number, printed in (
            (1, {}),
            (2, {"temperature_range": 0.0}),
            (3, {"flow_range": 0.0, "temperature_range": 0.0}),
        )
    }
    return {
        name: {"printed": printed, "measured": _single_start(settings, network, *start)}
        for name, (printed, network, *start) in told.items()
    }


def _single_start(
    settings: TrainAgent, network: agent.QNetwork, flow: float, temperature: float, accuracy: float
) -> dict[str, float | None]:
    own = settings.li_2025
    conditions = nominal(np.full(CLAIM_RUNS, flow), temperature, accuracy=accuracy)
    conditions = conditions._replace(flow_actions=own.flow_actions * jnp.ones(CLAIM_RUNS))
    controller = agent.greedy(agent.paper_encoder(own.history))
    key = jax.random.key(settings.seed + 2)
    path = rollout(controller, network, paper_windows(), conditions, key, steps=own.episode)
    q, u = np.asarray(path.flow, float), np.asarray(path.temperature, float)
    since = np.maximum.accumulate(np.abs(q - 100.0) <= 10.0 + 1e-3, axis=1)
    came, half = since.any(axis=1), own.episode // 2
    least, most = (
        float(np.median(bound(np.where(since, q, fill), axis=1)[came])) if came.any() else None
        for bound, fill in ((np.min, np.inf), (np.max, -np.inf))
    )
    return {
        "rests_at": float(np.median(q[:, -RESTING:].mean(axis=1))),
        "least": least,
        "most": most,
        "flow_range": float(np.median(np.ptp(q[:, half:], axis=1))),
        "temperature_range": float(np.median(np.ptp(u[:, half:], axis=1))),
    }


def guesses(settings: Li2025) -> dict[str, Any]:
    """What the paper does not print and we set, by its name there or in words."""
    return {
        "delta": DELTA,
        "alpha": ALPHA,
        "sigma": SIGMA,
        "flow_limits_percent": list(FLOW_LIMITS),
        "target_limits_degC": list(TEMPERATURE_LIMITS),
        "target_at_the_start": "as the temperature",
        "updates_by_phase": settings.updates,
        "environments": settings.environments,
        "replay_capacity": settings.capacity,
        "explore_by_phase": [settings.explore, *[settings.explore_again] * (len(settings.updates) - 1)],
        "explore_least": settings.least,
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
