"""Recorded windows -> agents: reads datasets/train_classifier/windows.parquet; writes datasets/train_agent:
weights.safetensors of the agent of Li and Pattinson (2025) after each phase and of the belief DQN with its
filter, and agents.parquet, the learning curves."""

import contextlib
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from pydantic import Field

import stages
from pipeline.setpoint.settings import RobustFilter
from pipeline.setpoint.tables import AGENT_CURVE, WINDOW_PARTS, WINDOWS
from pipeline.store import artifacts, params
from pipeline.store.params import Section

if TYPE_CHECKING:
    from pipeline.setpoint.agents import agent, belief_agent
    from pipeline.setpoint.agents.files import Agents
    from pipeline.setpoint.simulation.recorded import WindowTable

MEMO = Path("datasets/memo/train_agent")
# points of a learning curve that a page has room for, of each phase
POINTS = 50
# the code that decides what the agent of Li and Pattinson (2025) comes to, which sees no recorded window
LOOP = Path(__file__).parents[1] / "pipeline/setpoint"
PUBLISHED_CODE = ("agents/agent.py", "simulation/simulator.py", "simulation/actuation.py", "published.py")


class Learning(Section):
    """Deep Q-learning: environments stepped together, batch, transitions remembered, steps of an episode,
    Adam's rate, discount, the target network's step, and how much is explored."""

    environments: int = Field(ge=1, le=100_000)
    batch: int = Field(ge=1, le=100_000)
    capacity: int = Field(ge=1000, le=10_000_000)
    episode: int = Field(ge=10, le=10_000)
    learning_rate: float = Field(gt=0, le=1)
    gamma: float = Field(ge=0, lt=1)
    tau: float = Field(gt=0, le=1)
    explore: float = Field(ge=0, le=1)
    least: float = Field(ge=0, le=1)


class Li2025(Learning):
    """The agent of Li and Pattinson (2025): updates of its phases, exploration again from the second on,
    accuracy of the last and the share of the learning rate left at its end; classes of its history, eta, and
    flow actions to one of temperature, lambda."""

    history: int = Field(ge=1, le=1000)
    flow_actions: int = Field(ge=1, le=50)

    updates: list[Annotated[int, Field(ge=1, le=10_000_000)]] = Field(min_length=3, max_length=4)
    explore_again: float = Field(ge=0, le=1)
    accuracy: float = Field(gt=0.34, le=1)
    rate_at_end: float = Field(gt=0, le=1)


class Costs(Section):
    """Of a step, belief_agent.Costs."""

    scale: float = Field(gt=0, le=1000)
    outside: float = Field(ge=0, le=1000)
    move: float = Field(ge=0, le=10)


class Disturbances(Section):
    """What training episodes meet, belief_agent.Disturbances."""

    recorded_share: float = Field(ge=0, le=1)
    longest_segment: float = Field(ge=1, le=10_000)
    accuracy: float = Field(gt=0.34, le=1)
    gain: float = Field(gt=0, le=1)
    clog: float = Field(gt=0, le=1)
    clog_share: float = Field(ge=0, le=1)
    drift: float = Field(ge=0, le=0.1)


class BeliefDqn(Learning):
    """Belief DQN: the filter whose belief the network reads, what a step costs, what episodes meet,
    and rounds of updates, the best of which is kept."""

    filter: RobustFilter
    costs: Costs
    disturbances: Disturbances
    updates: int = Field(ge=1, le=10_000_000)
    rounds: int = Field(ge=1, le=1000)


class TrainAgent(Section):
    """Section `train_agent`."""

    seed: int = Field(ge=0, le=2**31)
    runs: int = Field(ge=1, le=10_000)
    li_2025: Li2025
    belief_dqn: BeliefDqn


# figures of control that git keeps and that runs are compared by
METRICS = ("*.settled*", "*.stay", "*.overshoot_p95", "*.median_steps", "*.runs")


def main() -> None:
    with artifacts.stage("train_agent") as out:
        settings = params.load(TrainAgent, "train_agent")
        from pipeline.setpoint.agents.files import store_agents
        from pipeline.setpoint.simulation.recorded import window_tables

        table = artifacts.read_table("datasets/train_classifier/windows.parquet", WINDOWS)
        trained = train_agents(settings, window_tables(table, WINDOW_PARTS)["learn"], memo=MEMO)
        store_agents(out / "weights.safetensors", trained.agents)
        artifacts.write_table(out / "agents.parquet", AGENT_CURVE, trained.curve)
        artifacts.write_learning_curve(
            out / "live", trained.curve, of="agent", step="update", figures=("reward",)
        )
        artifacts.write_metrics("train_agent", metrics(settings, trained), METRICS)


class TrainedAgents(NamedTuple):
    agents: "Agents"
    best_round: int  # of the belief DQN, the round that was kept
    validation: tuple[float, ...]  # what each round was worth
    curve: dict[str, list]  # columns of schema AGENT_CURVE: both learning curves


def train_agents(settings: TrainAgent, windows: "WindowTable", *, memo: Path | None = None) -> TrainedAgents:
    """Both agents, trained from keys of one seed, the belief DQN on the windows to learn from; a memo keeps
    the published one, so that other windows do not train it again."""
    import jax
    import numpy as np
    from tqdm import tqdm

    from pipeline.setpoint.agents import belief_agent
    from pipeline.setpoint.agents.files import Agents

    key, updates, rounds = jax.random.key(settings.seed), settings.li_2025.updates, settings.belief_dqn.rounds
    curve: list[tuple[str, int, int, float]] = []
    with tqdm(total=len(updates) + rounds, desc="train_agent: phases", mininterval=2) as bar:
        published = published_agent(settings, memo, lambda *_: bar.update())
        for i, rewards in enumerate(published.rewards):
            curve += curve_points("li_2025", i + 1, sum(updates[:i]), rewards)
        belief = filter_belief(settings.belief_dqn, windows)
        trained = belief_agent.train(
            jax.random.fold_in(key, 1),
            belief,
            windows,
            belief_training(settings.belief_dqn),
            on_step=lambda *_: bar.update(),
        )
    for i, rewards in enumerate(np.split(np.asarray(trained.rewards), rounds)):
        curve += curve_points("belief_dqn", i + 1, i * settings.belief_dqn.updates, rewards)
    names = ("agent", "phase", "update", "reward")
    columns = dict(zip(names, map(list, zip(*curve, strict=True)), strict=True))
    agents = Agents(published.networks, belief, trained.network)
    return TrainedAgents(agents, trained.best_round, trained.validation, columns)


def published_agent(
    settings: TrainAgent, memo: Path | None, on_step: Callable[..., object]
) -> "agent.PublishedAgent":
    """The agent of Li and Pattinson (2025): trained, or taken from the memo if the same settings were trained
    by the same code. A damaged entry is trained again."""
    import jax
    import joblib

    from pipeline.setpoint.agents import agent
    from pipeline.setpoint.agents.files import restore_published, store_published

    own = settings.li_2025
    code = [artifacts.sha256(LOOP / name) for name in PUBLISHED_CODE]
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


def filter_belief(settings: BeliefDqn, windows: "WindowTable") -> Any:
    """The Belief: the filter on recorded windows, which tells when the camera is not theirs, and the value of
    each move were the flow observed."""
    import jax.numpy as jnp

    from pipeline.setpoint.agents import bayes, belief_agent

    model = bayes.CameraErrorModel(**settings.filter.model_dump())
    costs = belief_agent.StepCosts(**settings.costs.model_dump())
    values = belief_agent.observed_values(costs, settings.gamma)
    robust = bayes.watching_filter(windows, model)
    return belief_agent.Belief(robust, jnp.asarray(values, jnp.float32), settings.gamma)


# ---- settings as the methods take them


def dqn_settings(settings: Learning) -> "agent.DqnSettings":
    from pipeline.setpoint.agents import agent

    return agent.DqnSettings(**settings.model_dump(include={*agent.DqnSettings._fields}))


def published_training(settings: Li2025) -> "agent.PublishedTraining":
    from pipeline.setpoint.agents import agent

    numbers = settings.model_dump(include={*agent.PublishedTraining._fields})
    numbers["updates"] = tuple(settings.updates)
    return agent.PublishedTraining(dqn=dqn_settings(settings), **numbers)


def belief_training(settings: BeliefDqn) -> "belief_agent.BeliefTraining":
    from pipeline.setpoint.agents import belief_agent

    return belief_agent.BeliefTraining(
        costs=belief_agent.StepCosts(**settings.costs.model_dump()),
        disturbances=belief_agent.EpisodeDisturbances(**settings.disturbances.model_dump()),
        dqn=dqn_settings(settings),
        learning_rate=settings.learning_rate,
        updates=settings.updates,
        rounds=settings.rounds,
        explore=settings.explore,
        least=settings.least,
    )


# ---- figures


def curve_points(name: str, phase: int, before: int, rewards: Any) -> list[tuple[str, int, int, float]]:
    """(agent, phase, update, reward): means of at most POINTS stretches of a phase."""
    import numpy as np

    values = np.atleast_2d(np.asarray(rewards, float).reshape(len(rewards), -1).T).mean(axis=0)
    ends = np.unique(np.linspace(0, len(values), POINTS + 1).round().astype(int))
    return [
        (name, phase, int(before + b), float(values[a:b].mean()))
        for a, b in itertools.pairwise(ends)
        if b > a
    ]


def metrics(settings: TrainAgent, trained: TrainedAgents) -> dict[str, Any]:
    """The agent of Li and Pattinson (2025) after three phases and after the last one, if the class is always
    right and if it is not, on the paper's simulator, and what the paper claims of it; the belief DQN at the
    same accuracies."""
    import jax

    from pipeline.setpoint.agents import claims

    agents, own = trained.agents, settings.li_2025
    key = jax.random.key(settings.seed + 1)
    return claims.simulated_figures(agents, key, settings.runs, own.history, own.flow_actions) | {
        "parameters": {
            "li_2025": claims.parameters(agents.li_2025[0]),
            "belief_dqn": claims.parameters(agents.belief_dqn),
        },
        "kept_round": trained.best_round,
        "validation": list(trained.validation),
        "rounds": settings.belief_dqn.rounds,
        "claims": paper_claims(settings, agents.li_2025),
        "guesses": guesses(own),
    }


def paper_claims(settings: TrainAgent, networks: Any) -> dict[str, dict[str, Any]]:
    """What the paper prints of single starts beside what runs of ours come to (claims.compare_starts)."""
    import jax

    from pipeline.setpoint.agents import claims

    own = settings.li_2025
    deployed = own.accuracy if len(networks) > 3 else 1.0
    key = jax.random.key(settings.seed + 2)
    return claims.compare_starts(
        networks,
        key,
        accuracy=deployed,
        history=own.history,
        flow_actions=own.flow_actions,
        steps=own.episode,
    )


def guesses(settings: Li2025) -> dict[str, Any]:
    """What the paper does not print and we set, by its name there or in words."""
    from pipeline.setpoint.published import ALPHA, DELTA, SIGMA
    from pipeline.setpoint.simulation.simulator import FLOW_LIMITS, TEMPERATURE_LIMITS

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


if __name__ == "__main__":
    stages.run(main, "train_agent", loop="setpoint")
