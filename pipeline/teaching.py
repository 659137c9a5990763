"""What train_agent does: the paper's agent in its phases, and ours on the belief of a filter that knows the classifier's recorded windows; both to a file and back."""

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field
from tqdm import tqdm

from pipeline import artifacts, weights
from pipeline.params import Section
from pipeline.setpoint import agent, bayes, belief_agent, judging
from pipeline.setpoint.agent import QNetwork
from pipeline.setpoint.belief_agent import Belief, BeliefNetwork
from pipeline.setpoint.recorded import WindowTable, recorded_windows
from pipeline.setpoint.score import Score

SCHEMA = "agents 2"
# points of the course of training that a page has room for, of each phase
POINTS = 50


class Learning(Section):
    """Deep Q-learning: environments stepped together, batch, transitions remembered, steps of an episode, Adam's rate, discount, the slow copy's step, and how much is explored."""

    environments: int = Field(ge=1, le=100_000)
    batch: int = Field(ge=1, le=100_000)
    capacity: int = Field(ge=1000, le=10_000_000)
    episode: int = Field(ge=10, le=10_000)
    learning_rate: float = Field(gt=0, le=1)
    gamma: float = Field(ge=0, lt=1)
    tau: float = Field(gt=0, le=1)
    explore: float = Field(ge=0, le=1)
    least: float = Field(ge=0, le=1)

    def setting(self) -> agent.Setting:
        return agent.Setting(self.gamma, self.tau, self.batch, self.capacity, self.environments, self.episode)


class Paper(Learning):
    """The published agent: updates of its phases, exploration again from the second on, accuracy of the last."""

    updates: list[Annotated[int, Field(ge=1, le=10_000_000)]] = Field(min_length=3, max_length=4)
    explore_again: float = Field(ge=0, le=1)
    accuracy: float = Field(gt=0.34, le=1)


class RobustFilter(Section):
    """Settings of bayes.robust_filter."""

    accuracies: list[Annotated[float, Field(gt=0.34, lt=1)]] = Field(min_length=1, max_length=20)
    gains: list[Annotated[float, Field(gt=0, le=10)]] = Field(min_length=1, max_length=20)
    looks: int = Field(ge=1, le=51)
    look: float = Field(gt=0, le=1)
    floor: float = Field(gt=0, lt=1)
    smoothing: float = Field(gt=0, le=100)
    segment: float = Field(ge=1, le=10_000)
    switch: float = Field(gt=0, lt=1)
    repeats: float = Field(ge=0, lt=1)
    hazard: float = Field(ge=0, lt=1)
    move_cost: float = Field(ge=0, le=10)
    outside_cost: float = Field(ge=0, le=1000)

    def hypotheses(self) -> int:
        return len(self.gains) * (len(self.accuracies) + self.looks)


class Costs(Section):
    """Of a step, belief_agent.Costs."""

    scale: float = Field(gt=0, le=1000)
    outside: float = Field(ge=0, le=1000)
    move: float = Field(ge=0, le=10)


class Troubles(Section):
    """What training episodes meet, belief_agent.Troubles."""

    recorded_share: float = Field(ge=0, le=1)
    longest_segment: float = Field(ge=1, le=10_000)
    accuracy: float = Field(gt=0.34, le=1)
    gain: float = Field(gt=0, le=1)
    clog: float = Field(gt=0, le=1)
    clog_share: float = Field(ge=0, le=1)
    drift: float = Field(ge=0, le=0.1)


class Ours(Learning):
    """Our agent: the filter whose belief it sees, what a step costs, what it meets, and rounds of updates, the best of which is kept."""

    filter: RobustFilter
    costs: Costs
    troubles: Troubles
    updates: int = Field(ge=1, le=10_000_000)
    rounds: int = Field(ge=1, le=1000)


class TrainAgent(Section):
    """Section `train_agent`."""

    seed: int = Field(ge=0, le=2**31)
    runs: int = Field(ge=1, le=10_000)
    paper: Paper
    ours: Ours


class Taught(NamedTuple):
    """The paper's networks after each phase, our belief and network, and the course of both as rows (agent, phase, update, reward)."""

    paper: tuple[QNetwork, ...]
    belief: Belief
    ours: BeliefNetwork
    kept: int
    judged: tuple[float, ...]
    course: list[tuple[str, int, int, float]]


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
            jax.random.fold_in(key, 0), setting=q.setting(), rate=q.learning_rate, updates=tuple(q.updates), accuracy=q.accuracy,
            explore=q.explore, explore_again=q.explore_again, least=q.least, on_step=lambda *_: bar.update(),
        )  # fmt: skip
        for i, rewards in enumerate(published.rewards):
            course += _course("paper", i + 1, sum(q.updates[:i]), rewards)
        sees = belief(p.ours, learned)
        ours = belief_agent.train(
            jax.random.fold_in(key, 1), sees, learned, costs=belief_agent.Costs(**p.ours.costs.model_dump()),
            troubles=belief_agent.Troubles(**p.ours.troubles.model_dump()), setting=p.ours.setting(), rate=p.ours.learning_rate, updates=p.ours.updates,
            rounds=p.ours.rounds, explore=p.ours.explore, least=p.ours.least, on_step=lambda *_: bar.update(),
        )  # fmt: skip
    for i, rewards in enumerate(np.split(np.asarray(ours.rewards), p.ours.rounds)):
        course += _course("ours", i + 1, i * p.ours.updates, rewards)
    return Taught(published.networks, sees, ours.network, ours.kept, ours.judged, course)


def _course(name: str, phase: int, before: int, rewards) -> list[tuple[str, int, int, float]]:
    """Means of at most POINTS stretches of a phase."""
    values = np.atleast_2d(np.asarray(rewards, float).reshape(len(rewards), -1).T).mean(axis=0)
    ends = np.unique(np.linspace(0, len(values), POINTS + 1).round().astype(int))
    return [(name, phase, int(before + b), float(values[a:b].mean())) for a, b in itertools.pairwise(ends) if b > a]


def course_rows(taught: Taught) -> dict[str, list]:
    """Columns of schema AGENT_COURSE."""
    return dict(zip(("agent", "phase", "update", "reward"), map(list, zip(*taught.course, strict=True)), strict=True))


def metrics(p: TrainAgent, done: Taught, judge: WindowTable) -> dict[str, Any]:
    """The paper's agent after three phases where the class is always right, and after the last one where it is not; ours at the same accuracies."""
    key = jax.random.key(p.seed + 1)
    cases = judging.cases(recorded_windows(judge), runs=p.runs, segment=10.0)
    right, noisy = cases["accuracy 1"], cases["accuracy 0.7"]
    paper, ours = agent.greedy(agent.paper_sight()), agent.greedy(belief_agent.belief_sight(done.belief))
    wanted = {f"phase{i + 1}": (paper, network, right if i < 3 else noisy) for i, network in enumerate(done.paper) if i >= 2}
    wanted |= {"phase3_at_0.7": (paper, done.paper[2], noisy), "ours": (ours, done.ours, right), "ours_at_0.7": (ours, done.ours, noisy)}
    figures = {name: _figures(judging.evaluate(controller, network, *case, key)) for name, (controller, network, case) in wanted.items()}
    return figures | {
        "parameters": {"paper": _size(done.paper[0]), "ours": _size(done.ours)}, "kept_round": done.kept, "validation": list(done.judged), "rounds": p.ours.rounds,
    }  # fmt: skip


def _size(network) -> int:
    return sum(np.size(leaf) for leaf in jax.tree.leaves(network))


def _figures(score: Score) -> dict[str, Any]:
    steps = {
        name: float(value) if np.isfinite(value) else None
        for name, value in (("median_steps", score.median_steps), ("p90_steps", score.p90_steps))
    }
    return {
        "runs": score.runs, "settled": score.settled.percent, "settled_low": score.settled.low, "stay": score.stay.percent, "overshoot_p95": score.overshoot_p95, **steps,
    }  # fmt: skip


# ---- to a file and back


def store(path: Path, done: Taught) -> None:
    """Every network, and our belief, by name in one file."""
    arrays = {f"phase{i + 1}.{name}": a for i, network in enumerate(done.paper) for name, a in agent.weights(network).items()}
    arrays |= {f"ours.{name}": a for name, a in agent.weights(done.ours).items()} | {
        f"belief.{name}": a for name, a in agent.weights(done.belief).items()
    }
    weights.write_weights(path, SCHEMA, arrays, {"phases": str(len(done.paper))})


class Agents(NamedTuple):
    """The paper's networks after each phase, our belief and network."""

    paper: tuple[QNetwork, ...]
    belief: Belief
    ours: BeliefNetwork


def restore(path: str) -> Agents:
    """What `store` wrote."""
    arrays, about = weights.read_weights(path, SCHEMA)
    with artifacts.about(path):
        parts = {name: _part(arrays, name) for name in [*(f"phase{i + 1}" for i in range(int(about["phases"]))), "ours", "belief"]}
        found = parts.pop("belief")
        hypotheses = found["filter.evidence"].shape[0]
        numbers = {name: jnp.asarray(a) for name, a in found.items()}
        model = bayes.Filter(*(numbers[f"filter.{name}"] for name in bayes.Filter._fields))
        ours = agent.with_weights(BeliefNetwork(hypotheses, jax.random.key(0)), parts.pop("ours"))
        paper = tuple(agent.with_weights(QNetwork(jax.random.key(0)), part) for part in parts.values())
        return Agents(paper, Belief(model, *(numbers[name] for name in Belief._fields[1:])), ours)


def _part(arrays: Mapping[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    return {key.removeprefix(f"{name}."): a for key, a in arrays.items() if key.startswith(f"{name}.")}
