"""The agent of Li and Pattinson (2025), trained in its own simulator: writes datasets/train_agent:
weights.safetensors of its network after each phase, and agents.parquet, the learning curves."""

import contextlib
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

import stages
from pipeline.setpoint.tables import AGENT_CURVE
from pipeline.store import artifacts, params
from pipeline.store.params import Section

if TYPE_CHECKING:
    from pipeline.setpoint.agents import agent

MEMO = Path("datasets/memo/train_agent")
# points of a learning curve that a page has room for, of each phase
POINTS = 50
# the code that decides what the agent of Li and Pattinson (2025) comes to, which sees no recorded window
LOOP = Path(__file__).parents[1] / "pipeline/setpoint"
PUBLISHED_CODE = (
    "agents/agent.py", "agents/criteria.py", "agents/score.py", "agents/trials.py", "simulation/simulator.py",
    "simulation/actuation.py", "published.py",
)  # fmt: skip


class Li2025(Section):
    """The agent of Li and Pattinson (2025): environments stepped together, batch, transitions remembered,
    steps of an episode, Adam's rate and the share of it left at the end of the last phase, discount, the
    target network's step; of each phase its updates, and how much is explored as it begins and in the end;
    accuracy of the last phase; classes of its history, eta, and flow actions to one of temperature, lambda.
    """

    environments: int = Field(ge=1, le=100_000)
    batch: int = Field(ge=1, le=100_000)
    capacity: int = Field(ge=1000, le=10_000_000)
    episode: int = Field(ge=10, le=10_000)
    learning_rate: float = Field(gt=0, le=1)
    rate_at_end: float = Field(gt=0, le=1)
    gamma: float = Field(ge=0, lt=1)
    tau: float = Field(gt=0, le=1)
    updates: list[Annotated[int, Field(ge=1, le=10_000_000)]] = Field(min_length=3, max_length=4)
    explore: list[Annotated[float, Field(ge=0, le=1)]] = Field(min_length=4, max_length=4)
    least: float = Field(ge=0, le=1)
    accuracy: float = Field(gt=0.34, le=1)
    history: int = Field(ge=1, le=1000)
    flow_actions: int = Field(ge=1, le=50)


class TrainAgent(Section):
    """Section `train_agent`."""

    seed: int = Field(ge=0, le=2**31)
    runs: int = Field(ge=1, le=10_000)
    li_2025: Li2025


# figures of control that git keeps and that runs are compared by
METRICS = ("*.settled*", "*.stay", "*.overshoot_p95", "*.median_steps", "*.runs")


def main() -> None:
    with artifacts.stage("train_agent") as out:
        settings = params.load(TrainAgent, "train_agent")
        from tqdm import tqdm

        from pipeline.setpoint.agents.files import store_published

        with tqdm(total=len(settings.li_2025.updates), desc="train_agent: phases", mininterval=2) as bar:
            published = published_agent(settings, MEMO, lambda *_: bar.update())
        curve = learning_curve(settings.li_2025, published)
        store_published(out / "weights.safetensors", published.networks)
        artifacts.write_table(out / "agents.parquet", AGENT_CURVE, curve)
        artifacts.write_learning_curve(out / "live", curve, of="agent", step="update", figures=("reward",))
        artifacts.write_metrics("train_agent", metrics(settings, published.networks), METRICS)


def learning_curve(settings: Li2025, published: "agent.PublishedAgent") -> dict[str, list]:
    """Columns of schema AGENT_CURVE: the mean reward of a step, phase after phase."""
    points: list[tuple[str, int, int, float]] = []
    for i, rewards in enumerate(published.rewards):
        points += curve_points("li_2025", i + 1, sum(settings.updates[:i]), rewards)
    names = ("agent", "phase", "update", "reward")
    return dict(zip(names, map(list, zip(*points, strict=True)), strict=True))


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


# ---- settings as the methods take them


def dqn_settings(settings: Li2025) -> "agent.DqnSettings":
    from pipeline.setpoint.agents import agent

    return agent.DqnSettings(**settings.model_dump(include={*agent.DqnSettings._fields}))


def published_training(settings: Li2025) -> "agent.PublishedTraining":
    from pipeline.setpoint.agents import agent

    numbers = settings.model_dump(include={*agent.PublishedTraining._fields})
    numbers |= {"updates": tuple(settings.updates), "explore": tuple(settings.explore)}
    return agent.PublishedTraining(dqn=dqn_settings(settings), **numbers)


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


def metrics(settings: TrainAgent, networks: Any) -> dict[str, Any]:
    """The agent of Li and Pattinson (2025) after three phases and after the last one, if the class is always
    right and if it is not, on the paper's simulator, and what the paper claims of it."""
    import jax

    from pipeline.setpoint.agents import claims

    own, key = settings.li_2025, jax.random.key(settings.seed + 1)
    return claims.simulated_figures(networks, key, settings.runs, own.history, own.flow_actions) | {
        "parameters": {"li_2025": claims.parameters(networks[0])},
        "claims": paper_claims(settings, networks),
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
        "explore_by_phase": settings.explore[: len(settings.updates)],
        "explore_least": settings.least,
    }


if __name__ == "__main__":
    stages.run(main, "train_agent", loop="setpoint")
