"""Li and Pattinson 2025 beside us: the agent of the paper on the paper's own simulator, phase by phase, the
single runs that it shows, both readings of its rho, and how long to wait.

`./run dvc repro datasets/papers/dvc.yaml:setpoint` writes datasets/papers/setpoint.json, which
reports/papers.html shows. It takes the agent from datasets/memo/train_agent where that was trained with the
same settings, else it trains it, and once more with rho read the other way: minutes. The paper prints neither
delta, alpha nor sigma of its simulator: ours are in pipeline/setpoint/published.py.
"""

import itertools
import math
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import joblib
import numpy as np

from pipeline.papers import files
from pipeline.setpoint.agents import agent, score, trials
from pipeline.setpoint.published import PHASES, ROTATION
from pipeline.setpoint.simulation.simulator import (
    EpisodeConditions,
    Trajectory,
    nominal,
    paper_windows,
    reward,
    rollout,
)
from pipeline.setpoint.vision.vision_transformer import PAPER, parameters, vision_transformer
from pipeline.store import artifacts, params
from stages import train_agent
from stages.train_agent import Li2025, TrainAgent

COMMAND = "./run dvc repro datasets/papers/dvc.yaml:setpoint"
MEMO = Path("datasets/memo/train_agent")
RUNS, STEPS, SHOWN, RESTING, TRAINING_SEEDS = 100, 200, 100, 20, 1
# what the paper does not print of phase 4, searched: exploration as it begins, episodes at once, and the
# share of the learning rate that is left at its end
SEARCH = {
    "explore": ([1.0, 0.3, 0.3, 0.3], [1.0, 0.3, 0.3, 1.0]),
    "environments": (8, 32),
    "rate_at_end": (1.0, 0.05),
}
SEARCHED = "published phase 4 1"
# start of the single runs: flow in percent, temperature in °C
SINGLE = {
    "figure_3": (191.0, 213.3),
    "figure_7": (232.0, 190.0),
    "case_1": (300.0, 230.0),
    "case_2": (30.0, 190.0),
}
PICTURES = {
    ("phase_3", "figure_3_100"),
    *((f"phase_{i}", "figure_7_100") for i in (1, 2, 3)),
    *((f"phase_{i}", "figure_7_70") for i in (3, 4)),
    ("phase_4", "case_1_70"),
    ("phase_4", "case_2_70"),
}
# waits, and the time until a picture shows only what was laid after a move, which the paper does not print
WAITS_S, VIEWS_S = (3.0, 6.0), (0.0, 6.0, 9.0)
SHOWN_VIEW_S = 6.0
RHO, BETTER = 0.7, 0.85
CLASSIFIER = "datasets/kept/train_classifier/figures.json"


class PhaseNetworks(NamedTuple):
    """The networks after each phase, the fourth with the class right with probability 0.7 and with 0.3, and
    the mean reward of a step of each phase."""

    by_name: dict[str, agent.QNetwork]
    rewards: list[np.ndarray]


def measured() -> float:
    """How often the shipped classifier names a window right."""
    return float(artifacts.read_json(CLASSIFIER)["window_accuracy"])


def trained(settings: TrainAgent) -> PhaseNetworks:
    """The paper's agent, and the one whose phase 4 takes rho for the probability of a wrong class."""
    other = settings.model_copy(update={"li_2025": settings.li_2025.model_copy(update={"accuracy": 1 - RHO})})
    MEMO.mkdir(parents=True, exist_ok=True)
    as_read, otherwise = (
        train_agent.published_agent(one, MEMO, lambda *_: None) for one in (settings, other)
    )
    by_name = {f"phase_{i + 1}": network for i, network in enumerate(as_read.networks)}
    by_name["phase_4_rho_wrong"] = otherwise.networks[-1]
    return PhaseNetworks(by_name, [np.asarray(part) for part in as_read.rewards])


def asked() -> tuple[EpisodeConditions, dict[str, slice]]:
    """Everything that each agent is asked, as one batch, and where in it."""
    parts, places, end = [], {}, 0

    def add(name: str, part: EpisodeConditions) -> None:
        nonlocal end
        parts.append(part)
        places[name] = slice(end, end + part.flow.shape[0])
        end += part.flow.shape[0]

    for accuracy in (1.0, RHO, 1 - RHO, BETTER, measured()):
        add(f"starts_{100 * accuracy:.0f}", trials.starts(20, accuracy=accuracy))
    for name, (flow, temperature) in SINGLE.items():
        for accuracy in (1.0, RHO):
            add(f"{name}_{100 * accuracy:.0f}", nominal(np.full(RUNS, flow), temperature, accuracy=accuracy))
    for wait_s in WAITS_S:
        for view_s in VIEWS_S:
            part = nominal(np.full(RUNS, SINGLE["case_2"][0]), SINGLE["case_2"][1], accuracy=1.0)
            ones = jnp.ones(RUNS)
            add(
                f"wait_{wait_s:.0f}_view_{view_s:.0f}",
                part._replace(wait_s=wait_s * ones, view_s=view_s * ones),
            )
    return jax.tree.map(lambda *fields: jnp.concatenate(fields), *parts), places


def single(path: Trajectory, place: slice, *, shown: bool) -> dict[str, Any]:
    """One start: where it rests, how far it goes past once it came near, and the first of its runs."""
    q, u = (np.asarray(a, float)[place, : SHOWN + 1] for a in (path.flow, path.temperature))
    since = np.maximum.accumulate(np.abs(q - 100.0) <= 10.0 + 1e-3, axis=1)
    came = since.any(axis=1)
    least, most = (
        float(np.median(bound(np.where(since, q, fill), axis=1)[came])) if came.any() else None
        for bound, fill in ((np.min, np.inf), (np.max, -np.inf))
    )
    shares = np.asarray(path.shares, float)[place.start, :SHOWN]
    run = {
        "flow": [round(float(v), 2) for v in q[0]],
        "temperature": [round(float(v), 2) for v in u[0]],
        "shares": [[round(float(v), 3) for v in row / row.max()] for row in shares],
    }
    return {
        "rests_at": float(np.median(q[:, -RESTING:].mean(axis=1))),
        "rests_at_degC": float(np.median(u[:, -RESTING:].mean(axis=1))),
        "least": least,
        "most": most,
        "least_degC": float(np.median(u.min(axis=1))),
        "flow_range": float(np.median(np.ptp(q[:, SHOWN // 2 :], axis=1))),
        "temperature_range": float(np.median(np.ptp(u[:, SHOWN // 2 :], axis=1))),
    } | ({"run": run} if shown else {})


def starts(path: Trajectory, place: slice) -> dict[str, Any]:
    """The 21 starts: settled and staying, in percent, and settled by start."""
    q, u = (np.asarray(a)[place] for a in (path.flow, path.temperature))
    told = score.judge(q, u)
    settled = score.outcomes(q, u).settled
    by_start = {
        f"{flow:g}, {temperature:g}": 100.0
        * float(settled[(q[:, 0] == flow) & (np.abs(u[:, 0] - temperature) < 1e-3)].mean())
        for temperature in trials.START_TEMPERATURES
        for flow in trials.START_FLOWS
    }
    return {
        "runs": told.runs,
        "settled": told.settled.percent,
        "stay": told.stay.percent,
        "median_steps": float(told.median_steps) if np.isfinite(told.median_steps) else None,
        "by_start": by_start,
        "by_figure": {
            name: float(np.mean([by_start[f"{flow:g}, {temperature:g}"] for flow in flows]))
            for name, (flows, temperature) in APPENDIX.items()
        },
    }


# the starts of each figure of the appendix: flows in percent, temperature in °C
LOW, HIGH = (30.0, 60.0, 80.0), (120.0, 150.0, 200.0, 300.0)
APPENDIX = {
    "a_1": (LOW[1:], 190.0),
    "a_2": (LOW, 210.0),
    "a_3": (LOW, 230.0),
    "a_4": (HIGH, 190.0),
    "a_5": (HIGH, 210.0),
    "a_6": (HIGH[:3], 230.0),
}


def waits(path: Trajectory, places: dict[str, slice]) -> dict[str, Any]:
    """Steps from (30 %, 190 °C) until a run is in the band for good, and how many get there."""
    out: dict[str, dict[str, Any]] = {}
    for name, place in places.items():
        if name.startswith("wait"):
            of = score.outcomes(np.asarray(path.flow)[place], np.asarray(path.temperature)[place])
            out[name] = {
                "settled": 100.0 * float(of.settled.mean()),
                "steps": float(np.median(of.entered[of.settled])) if of.settled.any() else None,
            }
            if name.endswith(f"view_{SHOWN_VIEW_S:.0f}"):
                flow = np.asarray(path.flow)[place.start, : SHOWN + 1]
                out[name]["flow"] = [round(float(v), 2) for v in flow]
    return out


def waiting_helps(of: dict[str, Any]) -> bool:
    """Whether by the long wait more runs settle, or as many in fewer steps, if pictures show the line of
    before the move for a while."""
    three, six = (of[f"wait_{wait_s:.0f}_view_{SHOWN_VIEW_S:.0f}"] for wait_s in WAITS_S)
    if three["settled"] != six["settled"]:
        return six["settled"] > three["settled"]
    return (six["steps"] or math.inf) < (three["steps"] or math.inf)


def scaled(shares: list[list[float]]) -> bool:
    """Whether every window has its largest share at one, and the others are noisy below it."""
    table = np.array(shares)
    others = np.sort(table, axis=1)[:, :2]
    return bool((table.max(axis=1) == 1).all() and others.std() > 0.05 and others.mean() < 0.5)


def reward_figures() -> dict[str, float]:
    """(14)-(16) at the points that check the turn of the ellipse."""
    points = {"at_110_205": (110.0, 205.0), "at_110_215": (110.0, 215.0)}
    a, b = PHASES[0]
    return {name: float(reward(jnp.array(q), jnp.array(u), a=a, b=b)) for name, (q, u) in points.items()}


def rewards_of(agents: PhaseNetworks, episode: int) -> dict[str, Any]:
    """Figure 6: the mean reward of a step times the steps of an episode, 50 means a phase."""
    phases = [
        [round(episode * float(part.mean()), 3) for part in np.array_split(values, 50)]
        for values in agents.rewards
    ]
    ends = {f"phase_{i + 1}": {"begins": part[0], "ends": part[-1]} for i, part in enumerate(phases)}
    falls = [after[0] < before[-1] for before, after in itertools.pairwise(phases)]
    learns = [part[-1] > part[0] for part in phases]
    shape = {"as_told": all(falls) and all(learns)}
    return {"by_phase": phases, "updates": [len(part) for part in agents.rewards], **ends, **shape}


class SearchedRun(NamedTuple):
    """Phase 4 by one setting from one seed: the updates before its best checkpoint, as validation chose it,
    and the shares in percent of fresh runs at accuracy RHO that settle, and that settle and stay, of it and
    of the phase's end."""

    updates: int
    settled: float
    stay: float
    settled_at_end: float
    stay_at_end: float


def searched_run(
    own: Li2025, seed: int, third: Callable[[], tuple[agent.DqnState, jax.Array]]
) -> SearchedRun:
    """Phase 4 by these settings after the third phase of the seed; what the same code trained is in the
    memo."""
    code = [artifacts.sha256(train_agent.LOOP / name) for name in train_agent.PUBLISHED_CODE]
    entry = MEMO / f"phase_4_{joblib.hash((own.model_dump(), seed, code, jax.__version__))}.safetensors"
    if entry.is_file():
        _, told = artifacts.read_weights(entry, SEARCHED)
        return SearchedRun(int(told["updates"]), *(float(told[name]) for name in SearchedRun._fields[1:]))
    (train_state, key), training = third(), train_agent.published_training(own)
    result = agent.published_phase(train_state, key, training, len(PHASES))
    best = agent.best_checkpoint(result, key, training)
    controller = agent.greedy(agent.paper_encoder(own.history))
    told = [
        trials.evaluate(
            controller,
            network,
            paper_windows(),
            trials.starts(RUNS, accuracy=RHO),
            jax.random.key(1000 + seed),
        )
        for network in (best.network, result.train_state.network)
    ]
    shares = [share.percent for one in told for share in (one.settled, one.stay)]
    run = SearchedRun(best.after * own.updates[-1] // agent.CHECKPOINTS, *shares)
    MEMO.mkdir(parents=True, exist_ok=True)
    numbers = {name: repr(value) for name, value in run._asdict().items()}
    artifacts.write_weights(entry, SEARCHED, agent.weights(best.network), numbers)
    print(seed, own.explore[-1], own.environments, own.rate_at_end, numbers, flush=True)
    return run


def search(settings: Li2025, first_seed: int) -> dict[str, Any]:
    """Phase 4 by every setting from every seed, and the best setting: the one whose seeds stay most on
    average."""

    def third(seed: int) -> tuple[agent.DqnState, jax.Array]:
        training = train_agent.published_training(settings)
        train_state, key = agent.begin_published(jax.random.fold_in(jax.random.key(seed), 0), training)
        for i in range(len(PHASES)):
            train_state = agent.published_phase(train_state, key, training, i).train_state
        return train_state, key

    grid = [dict(zip(SEARCH, values, strict=True)) for values in itertools.product(*SEARCH.values())]
    runs: list[list[SearchedRun]] = [[] for _ in grid]
    for seed in range(first_seed, first_seed + TRAINING_SEEDS):
        once = cache(lambda seed=seed: third(seed))
        for changes, found in zip(grid, runs, strict=True):
            found.append(searched_run(settings.model_copy(update=changes), seed, once))
    best = max(range(len(grid)), key=lambda k: np.mean([run.stay for run in runs[k]]))
    rows: list[dict[str, Any]] = [
        changes | {name: [getattr(run, name) for run in found] for name in SearchedRun._fields}
        for changes, found in zip(grid, runs, strict=True)
    ]
    settled, stay = rows[best]["settled"], rows[best]["stay"]
    ends = [at_end for row in rows for at_end in row["stay_at_end"]]
    return {
        "settings": len(grid), "seeds": TRAINING_SEEDS, "updates": settings.updates[-1], "rows": rows,
        "best": grid[best], "settled": settled, "stay": stay, "settled_least": min(settled),
        "settled_most": max(settled), "stay_least": min(stay), "stay_most": max(stay),
        "stay_at_end_least": min(ends), "stay_at_end_most": max(ends),
    }  # fmt: skip


def table_2(settings: TrainAgent) -> dict[str, float]:
    """What table 2 lists, as it was used here."""
    own = settings.li_2025
    return {
        "gamma": own.gamma,
        "tau": own.tau,
        "flow_actions": own.flow_actions,
        "batch": own.batch,
        "learning_rate": own.learning_rate,
        "episode": own.episode,
        "a": PHASES[0][0],
        "b": PHASES[0][1],
        "rotation_deg": math.degrees(ROTATION),
        "history": own.history,
    }


def arithmetic() -> dict[str, Any]:
    """Numbers of the paper that follow from others of it."""
    seen, valid, combinations, each = 69_668, 56_225, 15, 300
    steps, seconds = (95, 40), (6.44, 9.43)
    rests, least, most = 95.0, 75.0, 130.0
    return {
        "valid_percent": 100 * valid / seen,
        "pictures": [combinations * each, valid - combinations * each],
        "minutes": [count * each_s / 60 for count, each_s in zip(steps, seconds, strict=True)],
        "case_1_percent": [100 * (1 - least / rests), 100 * (most / rests - 1)],
    }


def sizes(networks: PhaseNetworks) -> dict[str, Any]:
    """Parameters of the networks, and what table 1 lists."""
    classifier = vision_transformer(PAPER, np.random.default_rng(0))
    return {
        "head": parameters(classifier.head),
        "vision_transformer_millions": parameters(classifier.body) / 1e6,
        "layers": PAPER.layers,
        "width": PAPER.width,
        "patch": PAPER.patch[0],
        "heads": PAPER.heads,
        "dqn": sum(np.size(leaf) for leaf in jax.tree.leaves(networks.by_name["phase_1"])),
    }


def main() -> None:
    settings = params.load(TrainAgent, "train_agent")
    agents, (conditions, places) = trained(settings), asked()
    controller = agent.greedy(agent.paper_encoder(settings.li_2025.history))
    conditions = conditions._replace(
        flow_actions=settings.li_2025.flow_actions * jnp.ones_like(conditions.flow)
    )
    key = jax.random.key(settings.seed + 2)
    result: dict[str, Any] = {"command": COMMAND, "agents": {}}
    for name, network in agents.by_name.items():
        path = rollout(controller, network, paper_windows(), conditions, key, steps=STEPS)
        row = {place: starts(path, where) for place, where in places.items() if place.startswith("starts")}
        row |= {
            place: single(path, where, shown=(name, place) in PICTURES)
            for place, where in places.items()
            if place.startswith(("case", "figure"))
        }
        result["agents"][name] = row | {"waits": waits(path, places)}
        print(
            name, {place: round(of["settled"], 1) for place, of in row.items() if "settled" in of}, flush=True
        )
    starts_of = result["agents"]["phase_4"]
    result |= {
        "reward": reward_figures(),
        "learning": rewards_of(agents, settings.li_2025.episode),
        "search": search(settings.li_2025, settings.seed),
        "waiting_helps": waiting_helps(starts_of["waits"]),
        "measured": starts_of[f"starts_{100 * measured():.0f}"],
        "parameters": sizes(agents),
        "table_2": table_2(settings),
        "arithmetic": arithmetic(),
        "distribution_is_scaled": scaled(result["agents"]["phase_3"]["figure_3_100"]["run"]["shares"]),
        "settings": {
            "right_percent": 100 * RHO,
            "better_percent": 100 * BETTER,
            "measured_percent": 100 * measured(),
            "runs": RUNS,
            "shown": SHOWN,
            "resting": RESTING,
            "starts": {name: list(start) for name, start in SINGLE.items()},
            "waits_s": list(WAITS_S),
            "view_s": SHOWN_VIEW_S,
            "views_s": list(VIEWS_S),
            "semi_axes": [length for pair in PHASES for length in pair],
        },
        "guesses": train_agent.guesses(settings.li_2025),
    }
    files.write("setpoint", result)


if __name__ == "__main__":
    main()
