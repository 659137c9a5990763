"""What evaluate_setpoint does: every controller behind one interface, judged on both simulators and through pixels."""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from pipeline.setpoint import agent, baselines, bayes, belief_agent, deployment, eyes, judging, pixels
from pipeline.setpoint.eyes import Eyes
from pipeline.setpoint.judging import Choice
from pipeline.setpoint.recorded import WindowTable, recorded_windows
from pipeline.setpoint.score import Score
from pipeline.setpoint.simulator import FLOW_LIMITS, TEMPERATURE_LIMITS, Controller, rollout
from pipeline.setpoint.workflow.agent_files import Agents
from pipeline.setpoint.workflow.settings import Baselines, EvaluateSetpoint, TrainClassifier
from pipeline.statistics import wilson

# ---- every controller behind the one interface


class Seat(NamedTuple):
    """A controller with its parameters; kind is agent, baseline or paper."""

    kind: str
    controller: Controller
    parameters: Any


class Seen(NamedTuple):
    """Episodes through pixels: undisturbed ones by controller, two troubled ones of the default, and these two in words."""

    calm: dict[str, pixels.Episodes]
    shown: pixels.Episodes
    words: tuple[str, ...]


def seats(p: Baselines, agents: Agents, learned: WindowTable) -> dict[str, Seat]:
    """Every controller by name: those that learn nothing but the evidence of recorded windows, the paper's
    agent after its third and its last phase, and ours."""
    without = {
        "proportional": (baselines.proportional(), baselines.Proportional(**p.proportional.model_dump())),
        "filtered proportional": (
            baselines.proportional(),
            baselines.Proportional(**p.filtered_proportional.model_dump()),
        ),
        "sequential test": (
            baselines.sequential_test(),
            baselines.SequentialTest(**p.sequential_test.model_dump()),
        ),
        "Bayes, exact model": (bayes.bayes(1), bayes.class_filter(**p.bayes_exact.model_dump())),
        "Bayes with leak": (bayes.bayes(1), bayes.class_filter(**p.bayes_leak.model_dump())),
        "Bayes, robust": (
            bayes.bayes(p.bayes_robust.hypotheses()),
            bayes.robust_filter(learned, **p.bayes_robust.model_dump()),
        ),
    }
    paper = agent.greedy(agent.paper_sight())
    found = {
        name: Seat("baseline", one, jax.tree.map(partial(jnp.asarray, dtype=jnp.float32), settings))
        for name, (one, settings) in without.items()
    }
    found |= {
        f"paper's agent, {i + 1} phases": Seat("paper", paper, network)
        for i, network in enumerate(agents.paper)
        if i >= 2
    }
    return found | {
        "our agent": Seat("agent", agent.greedy(belief_agent.belief_sight(agents.belief)), agents.ours)
    }


def chosen(found: Mapping[str, Mapping[str, Score]]) -> Choice:
    """The default: the best worst case."""
    return judging.choose({name: dict(of) for name, of in found.items()})


# ---- on the simulators


def scores(seats: Mapping[str, Seat], judge: WindowTable, p: EvaluateSetpoint) -> dict[str, dict[str, Score]]:
    """Every controller in every case of judging.cases: 21 starts x p.runs, from one key a case."""
    found: dict[str, dict[str, Score]] = {name: {} for name in seats}
    cases = judging.cases(recorded_windows(judge), runs=p.runs, segment=p.segment)
    with tqdm(
        total=len(seats) * len(cases), desc="evaluate_setpoint: controllers x cases", mininterval=2
    ) as bar:
        for number, (case, (windows, conditions)) in enumerate(cases.items()):
            key = jax.random.fold_in(jax.random.key(p.seed), number)
            for name, seat in seats.items():
                found[name][case] = judging.evaluate(
                    seat.controller, seat.parameters, windows, conditions, key
                )
                bar.update()
    return found


def simulator(case: str) -> str:
    return "recorded" if case.startswith("recorded") else "paper"


def scoreboard(
    seats: Mapping[str, Seat], found: Mapping[str, Mapping[str, Score]], seen: Seen
) -> dict[str, list]:
    """Columns of schema SCOREBOARD."""
    rows = []
    for name, of in found.items():
        for case, score in of.items():
            clogged = case.endswith("clog")
            shares = {
                "settled": score.settled,
                "stay": score.stay,
                "recovered": score.recovered if clogged else None,
            }
            rows.append(
                {
                    "controller": name, "kind": seats[name].kind, "simulator": simulator(case), "case": case, "counts": True,
                    "runs": score.runs,
                    **{
                        f"{key}_{end}percent": np.nan if share is None else getattr(share, end.strip("_") or "percent")
                        for key, share in shares.items() for end in ("", "low_", "high_")
                    },
                    "median_steps": score.median_steps, "p90_steps": score.p90_steps, "overshoot_p95_percent": score.overshoot_p95,
                    "flow_error_percent": score.flow_error,
                    "worst_start_flow_percent": score.worst_start[0], "worst_start_temperature_degC": score.worst_start[1],
                    "worst_start_settled_percent": score.worst_start[2],
                }
            )  # fmt: skip
    return _columns(
        rows + [_pixel_row(name, seats[name].kind, "calm", one) for name, one in seen.calm.items()]
    )


def _columns(rows: list[dict[str, Any]]) -> dict[str, list]:
    return {name: [row[name] for row in rows] for name in rows[0]}


def paths(seats: Mapping[str, Seat], judge: WindowTable, p: EvaluateSetpoint, seen: Seen) -> dict[str, Any]:
    """Columns of schema PATHS: one run from each of the 21 starts, at accuracy 0.7 on the paper's simulator and on
    fresh recorded windows, and those through pixels."""
    pieces = []
    cases = judging.cases(recorded_windows(judge), runs=1, segment=p.segment)
    for case in ("accuracy 0.7", "recorded, fresh"):
        windows, conditions = cases[case]
        for name, seat in seats.items():
            done = rollout(
                seat.controller, seat.parameters, windows, conditions, jax.random.key(p.seed), steps=100
            )
            flow, temperature = np.asarray(done.flow, float), np.asarray(done.temperature, float)
            start, step = np.indices(flow.shape)
            pieces.append(
                (name, simulator(case), case, start.ravel(), step.ravel(), flow.ravel(), temperature.ravel())
            )
    for name, episodes in seen.calm.items():
        start, step = np.indices(episodes.flow.shape)
        pieces.append(
            (
                name,
                "pixels",
                "calm",
                start.ravel(),
                step.ravel(),
                episodes.flow.ravel(),
                episodes.temperature.ravel(),
            )
        )
    sizes = [len(piece[3]) for piece in pieces]
    texts = {
        name: [piece[i] for piece, n in zip(pieces, sizes, strict=True) for _ in range(n)]
        for i, name in enumerate(("controller", "simulator", "case"))
    }
    numbers = ("start", "step", "flow_percent", "temperature_degC")
    return texts | {
        name: np.concatenate([piece[3 + i] for piece in pieces]) for i, name in enumerate(numbers)
    }


# ---- through pixels

# decisions at the end of an episode that it must be inside for, to count as settled
DWELL = 10


def pixel_runs(
    seats: Mapping[str, Seat], choice: Choice, known: Eyes, p: EvaluateSetpoint, view: TrainClassifier
) -> Seen:
    """The default, and our agent or the robust filter beside it, from some starts; and two
    episodes in which something befalls the default."""
    names = dict.fromkeys((choice.name, "our agent", "Bayes, robust"))
    start, disturbances, words = _troubled(p)
    at = some_starts(p)
    with tqdm(total=3, desc="evaluate_setpoint: through pixels", mininterval=2) as bar:
        calm = {}
        for name in list(names)[:2]:
            calm[name] = _through(seats[name], known, at, p, view, pixels.calm(len(at)), seed=1)
            bar.update()
        shown = _through(seats[choice.name], known, start, p, view, disturbances, seed=2)
        bar.update()
    return Seen(calm, shown, words)


def _through(
    seat: Seat,
    known: Eyes,
    start: np.ndarray,
    p: EvaluateSetpoint,
    view: TrainClassifier,
    disturbances: pixels.Disturbances,
    *,
    seed: int,
) -> pixels.Episodes:
    """Episodes from setpoints start (E, 2), with limits of what one action and one minute may change."""
    q, calibrated = p.pixels, known.known
    machine = pixels.Machine(q.heater_s, q.heater_delay_s, q.melt_s, q.softening_per_degC)
    limits = deployment.Limits(
        *(np.array(pair) for pair in zip(FLOW_LIMITS, TEMPERATURE_LIMITS, strict=True)),
        np.array(q.per_action),
        np.array(q.per_minute),
    )
    judge = partial(
        deployment.judge_window, least_frames=q.least_frames, correlation=calibrated.correlation, foreign_above=calibrated.foreign_above,
        conformal_level=calibrated.level,
    )  # fmt: skip
    loop = pixels.Loop(
        view.window,
        q.frame_rate_hz,
        deployment.Waits(q.wait_s, q.wait_s, q.idle_wait_s),
        limits,
        judge,
        view.least_score,
        q.tip_tolerance_px,
        q.segment_s,
    )
    rng = np.random.default_rng([p.seed, seed])
    return pixels.run(
        seat.controller,
        seat.parameters,
        partial(eyes.see, known),
        start,
        machine,
        loop,
        disturbances,
        decisions=q.decisions,
        rng=rng,
    )


def some_starts(p: EvaluateSetpoint) -> np.ndarray:
    """(E, 2) flow in percent and temperature in °C: p.pixels.starts of the 21, spread over
    flows and temperatures, p.pixels.runs times each."""
    everything = judging.starts(1, accuracy=1.0)
    chosen = np.unique(np.linspace(0, 20, p.pixels.starts).round().astype(int))
    return np.repeat(
        np.stack([np.asarray(everything.flow)[chosen], np.asarray(everything.temperature)[chosen]], axis=1),
        p.pixels.runs,
        axis=0,
    ).astype(float)


def _pixel_row(name: str, kind: str, case: str, found: pixels.Episodes) -> dict[str, Any]:
    """A row of schema SCOREBOARD: settled is inside to the end from at least DWELL decisions before it."""
    since, runs, last = pixels.settled_since(found), len(found.flow), found.flow.shape[1] - 1
    done = since <= last - DWELL
    share = wilson(done)
    past = np.sign(100.0 - found.flow[:, :1]) * (found.flow - 100.0)
    worst = int(since.argmax())
    nothing = dict.fromkeys(
        (f"{key}_{end}percent" for key in ("stay", "recovered") for end in ("", "low_", "high_")), np.nan
    )
    return {
        "controller": name, "kind": kind, "simulator": "pixels", "case": case, "counts": False, "runs": runs,
        "settled_percent": share.percent, "settled_low_percent": share.low, "settled_high_percent": share.high, **nothing,
        "median_steps": float(np.median(since[done])) if done.any() else np.nan,
        "p90_steps": float(np.percentile(since[done], 90)) if done.any() else np.nan,
        "overshoot_p95_percent": float(np.percentile(past.max(axis=1).clip(0), 95)),
        "flow_error_percent": float(np.abs(found.flow[:, -DWELL:] - 100.0).mean()),
        "worst_start_flow_percent": float(found.setpoint[worst, 0, 0]), "worst_start_temperature_degC": float(found.setpoint[worst, 0, 1]),
        "worst_start_settled_percent": 100.0 * float(done[(found.setpoint[:, 0] == found.setpoint[worst, 0]).all(axis=1)].mean()),
    }  # fmt: skip


def _troubled(p: EvaluateSetpoint) -> tuple[np.ndarray, pixels.Disturbances, tuple[str, str]]:
    """The two episodes that the page shows, whatever comes of them: the hardest start, and a clog with pictures out of focus later."""
    D = p.pixels.decisions
    calm, never = pixels.calm(2), np.iinfo(int).max
    befalls = calm._replace(
        clog=np.array([1.0, 0.6]),
        clog_at=np.array([never, D // 3]),
        blur_px=np.array([0.0, 5.0]),
        burst_at=np.array([never, 3 * D // 4]),
        burst_for=np.array([0, 5]),
    )
    return (
        np.array([[30.0, 190.0], [120.0, 210.0]]),
        befalls,
        ("from 30 % and 190 °C", f"clogged to 60 % at decision {D // 3}, out of focus from {3 * D // 4}"),
    )


def decisions(name: str, seen: Seen) -> dict[str, list]:
    """Columns of schema DECISIONS: the two troubled episodes."""
    rows, found = [], seen.shown
    for i, words in enumerate(seen.words):
        for d in range(found.time_s.shape[1]):
            window = deployment.Window(*(field[:, d] for field in found.windows))
            p = window.p[i]
            rows.append(
                {
                    "episode": words, "controller": name, "step": d, "time_s": found.time_s[i, d], "flow_percent": found.flow[i, d],
                    "temperature_degC": found.temperature[i, d], "flow_setpoint_percent": found.setpoint[i, d, 0],
                    "target_degC": found.setpoint[i, d, 1],
                    "p_under": p[0], "p_good": p[1], "p_over": p[2], "frames": int(window.used[i]),
                    "distance": window.score[i] if np.isfinite(window.score[i]) else np.nan,
                    "flow_move_percent": found.sent[i, d, 0], "temperature_move_degC": found.sent[i, d, 1],
                    "held": bool(window.reason[i] != deployment.ACTS),
                    "why": deployment.why(found.time_s[i, d], window, i, found.sent[i, d]),
                }
            )  # fmt: skip
    return _columns(rows)


# ---- metrics


def metrics(
    seats: Mapping[str, Seat], found: Mapping[str, Mapping[str, Score]], choice: Choice, seen: Seen
) -> dict[str, Any]:
    """By controller, simulator and case; then the default."""
    figures: dict[str, Any] = {}
    for name, of in found.items():
        for case, score in of.items():
            figures.setdefault(name, {}).setdefault(simulator(case), {})[case] = {
                "settled": score.settled.percent, "stay": score.stay.percent, "median_steps": _plain(score.median_steps),
                "overshoot_p95": score.overshoot_p95,
                "clog_recovered": score.recovered.percent if case.endswith("clog") else None, "flow_error": score.flow_error,
            }  # fmt: skip
    for row in (_pixel_row(name, seats[name].kind, "calm", one) for name, one in seen.calm.items()):
        figures.setdefault(row["controller"], {}).setdefault("pixels", {})[row["case"]] = {
            "settled": row["settled_percent"], "median_steps": _plain(row["median_steps"]), "overshoot_p95": row["overshoot_p95_percent"],
            "flow_error": row["flow_error_percent"],
        }  # fmt: skip
    return figures | {
        "default": choice.name,
        "worst": choice.worst,
        "case": choice.case,
        "margin": _plain(choice.margin),
        "sentence": choice.sentence,
    }


def _plain(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
