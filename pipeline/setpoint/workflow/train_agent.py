"""What train_agent does: the paper's agent in its phases, and ours on the belief of a
filter that knows the classifier's recorded windows."""

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
from pipeline.setpoint.workflow.settings import Learning, Ours, TrainAgent

# points of the course of training that a page has room for, of each phase
POINTS = 50


class Taught(NamedTuple):
    """The agents; of ours the round that was kept and what each was worth; and the course
    of both as rows (agent, phase, update, reward)."""

    agents: Agents
    kept: int
    judged: tuple[float, ...]
    course: list[tuple[str, int, int, float]]


def setting(p: Learning) -> agent.Setting:
    """The numbers of deep Q-learning."""
    return agent.Setting(p.gamma, p.tau, p.batch, p.capacity, p.environments, p.episode)


def belief(p: Ours, learned: WindowTable) -> Belief:
    """The filter on recorded windows, and the value of each move were the flow seen."""
    found = bayes.robust_filter(learned, **p.filter.model_dump())
    values = belief_agent.seen_values(belief_agent.Costs(**p.costs.model_dump()), p.gamma)
    return Belief(found, jnp.asarray(values, jnp.float32), p.gamma)


def taught(p: TrainAgent, learned: WindowTable) -> Taught:
    """Both agents, taught from keys of one seed."""
    key, q = jax.random.key(p.seed), p.paper
    course: list[tuple[str, int, int, float]] = []
    with tqdm(total=len(q.updates) + p.ours.rounds, desc="train_agent: phases", mininterval=2) as bar:
        published = agent.train_published(
            jax.random.fold_in(key, 0), setting=setting(q), rate=q.learning_rate, updates=tuple(q.updates),
            accuracy=q.accuracy,
            explore=q.explore, explore_again=q.explore_again, least=q.least, on_step=lambda *_: bar.update(),
        )  # fmt: skip
        for i, rewards in enumerate(published.rewards):
            course += _course("paper", i + 1, sum(q.updates[:i]), rewards)
        sees = belief(p.ours, learned)
        ours = belief_agent.train(
            jax.random.fold_in(key, 1), sees, learned, costs=belief_agent.Costs(**p.ours.costs.model_dump()),
            troubles=belief_agent.Troubles(**p.ours.troubles.model_dump()), setting=setting(p.ours),
            rate=p.ours.learning_rate,
            updates=p.ours.updates,
            rounds=p.ours.rounds, explore=p.ours.explore, least=p.ours.least, on_step=lambda *_: bar.update(),
        )  # fmt: skip
    for i, rewards in enumerate(np.split(np.asarray(ours.rewards), p.ours.rounds)):
        course += _course("ours", i + 1, i * p.ours.updates, rewards)
    return Taught(Agents(published.networks, sees, ours.network), ours.kept, ours.judged, course)


def _course(name: str, phase: int, before: int, rewards) -> list[tuple[str, int, int, float]]:
    """Means of at most POINTS stretches of a phase."""
    values = np.atleast_2d(np.asarray(rewards, float).reshape(len(rewards), -1).T).mean(axis=0)
    ends = np.unique(np.linspace(0, len(values), POINTS + 1).round().astype(int))
    return [
        (name, phase, int(before + b), float(values[a:b].mean()))
        for a, b in itertools.pairwise(ends)
        if b > a
    ]


def course_rows(taught: Taught) -> dict[str, list]:
    """Columns of schema AGENT_COURSE."""
    return dict(
        zip(("agent", "phase", "update", "reward"), map(list, zip(*taught.course, strict=True)), strict=True)
    )


def metrics(p: TrainAgent, done: Taught, judge: WindowTable) -> dict[str, Any]:
    """The paper's agent after three phases where the class is always right, and after the last
    one where it is not; ours at the same accuracies."""
    key = jax.random.key(p.seed + 1)
    cases = judging.cases(recorded_windows(judge), runs=p.runs, segment=10.0)
    right, noisy = cases["accuracy 1"], cases["accuracy 0.7"]
    agents = done.agents
    paper, ours = agent.greedy(agent.paper_sight()), agent.greedy(belief_agent.belief_sight(agents.belief))
    wanted = {
        f"phase{i + 1}": (paper, network, right if i < 3 else noisy)
        for i, network in enumerate(agents.paper)
        if i >= 2
    }
    wanted |= {
        "phase3_at_0.7": (paper, agents.paper[2], noisy),
        "ours": (ours, agents.ours, right),
        "ours_at_0.7": (ours, agents.ours, noisy),
    }
    figures = {
        name: _figures(judging.evaluate(controller, network, *case, key))
        for name, (controller, network, case) in wanted.items()
    }
    return figures | {
        "parameters": {"paper": _size(agents.paper[0]), "ours": _size(agents.ours)}, "kept_round": done.kept,
        "validation": list(done.judged), "rounds": p.ours.rounds,
    }  # fmt: skip


def _size(network) -> int:
    return sum(np.size(leaf) for leaf in jax.tree.leaves(network))


def _figures(score: Score) -> dict[str, Any]:
    steps = {
        name: float(value) if np.isfinite(value) else None
        for name, value in (("median_steps", score.median_steps), ("p90_steps", score.p90_steps))
    }
    return {
        "runs": score.runs, "settled": score.settled.percent, "settled_low": score.settled.low,
        "stay": score.stay.percent,
        "overshoot_p95": score.overshoot_p95, **steps,
    }  # fmt: skip
