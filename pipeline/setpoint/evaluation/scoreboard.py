"""Turns test results into tables and figures: columns of schemas SCOREBOARD, PATHS and DECISIONS."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from pipeline.setpoint.agents.criteria import BEYOND, STEPS
from pipeline.setpoint.agents.score import RunScore, summary
from pipeline.setpoint.agents.trials import START_FLOWS, START_TEMPERATURES, STARTS
from pipeline.setpoint.controllers import KINDS
from pipeline.setpoint.deployment import deployment, pixels
from pipeline.setpoint.evaluation import judging
from pipeline.setpoint.evaluation.judging import DefaultChoice, Runs
from pipeline.setpoint.evaluation.pixel_rollouts import DWELL, PixelRollouts
from pipeline.setpoint.simulation import actuation
from pipeline.statistics import PooledShare, wilson

# cases whose runs are stored for every controller besides the deciding case, and their number of decisions
PATHS_OF, PATH_STEPS = ("accuracy 0.7", "recorded, sticky"), 100


class Contest(NamedTuple):
    """Results of every controller, by name, on the test segments, which are used once: `scores` by case, and
    `paths`, the first run from each start of the cases that count."""

    scores: dict[str, dict[str, RunScore]]
    paths: dict[str, dict[str, Runs]]


def simulator(case: str) -> str:
    """Returns the source of a case's windows: "paper", "recorded", or "harm" for recorded windows from good
    starts."""
    if not judging.counts(case):
        return "harm"
    return "recorded" if case.startswith("recorded") else "paper"


def scores(judged: Mapping[str, judging.Judged], pools: int) -> dict[str, dict[str, RunScore]]:
    """Returns scores by name and case. On the paper's simulator all runs are independent, so there are no
    pools."""
    return {
        name: {
            case: summary(outcomes, pools=None if simulator(case) == "paper" else pools)
            for case, outcomes in by_case.items()
        }
        for name, by_case in judged.items()
    }


def first_of_each(of: Runs) -> Runs:
    """Returns the first run (21, STEPS + 1) from each of the `starts`, on the first pool."""
    shape = len(START_FLOWS), -1, len(START_TEMPERATURES), STEPS + 1
    return Runs(*(a[0].reshape(shape)[:, 0].reshape(STARTS, STEPS + 1).copy() for a in of))


def scoreboard(contest: Contest, rollouts: PixelRollouts) -> dict[str, list]:
    """Columns of schema SCOREBOARD."""
    rows = [
        _score_row(name, case, score)
        for name, by_case in contest.scores.items()
        for case, score in by_case.items()
    ]
    return _columns(rows + [_pixel_row(name, "calm", episodes) for name, episodes in rollouts.calm.items()])


def _score_row(name: str, case: str, score: RunScore) -> dict[str, Any]:
    clogged = case.endswith("clog")
    shares: dict[str, PooledShare | None] = {
        "settled": score.settled,
        "stay": score.stay,
        "recovered": score.recovered if clogged else None,
        "back": score.back if clogged else None,
    }
    harmed = score.beyond if not judging.counts(case) else [None] * len(BEYOND)
    shares |= {f"beyond_{points}": share for points, share in zip(BEYOND, harmed, strict=True)}
    return {
        "controller": name,
        "kind": KINDS[name],
        "simulator": simulator(case),
        "case": case,
        "counts": judging.counts(case),
        "runs": score.runs,
        **{column: value for key, share in shares.items() for column, value in _ends(key, share).items()},
        "median_steps": score.median_steps,
        "p90_steps": score.p90_steps,
        "recovery_p95_steps": score.recovery_p95 if clogged else np.nan,
        "overshoot_p95_percent": score.overshoot_p95,
        "flow_error_percent": score.flow_error,
        "worst_start_flow_percent": score.worst_start[0],
        "worst_start_temperature_degC": score.worst_start[1],
        "worst_start_settled_percent": score.worst_start[2],
    }


def _ends(key: str, share: PooledShare | None) -> dict[str, float]:
    """Returns the four columns of a share; NaN if there is none."""
    values = (np.nan,) * 4 if share is None else share
    names = (f"{key}_percent", f"{key}_low_percent", f"{key}_high_percent", f"{key}_n_eff")
    return dict(zip(names, values, strict=True))


def _columns(rows: list[dict[str, Any]]) -> dict[str, list]:
    return {name: [row[name] for row in rows] for name in rows[0]}


def paths(contest: Contest, choice: DefaultChoice, rollouts: PixelRollouts) -> dict[str, Any]:
    """Returns columns of schema PATHS: one run from each of the 21 starts. These are PATH_STEPS decisions of
    the cases PATHS_OF, STEPS decisions of the case that decided the choice, and the runs through pixels."""
    pieces = []
    for case in dict.fromkeys((*PATHS_OF, choice.case)):
        last = STEPS if case == choice.case else PATH_STEPS
        for name, kept in contest.paths.items():
            flow, temperature = (np.asarray(a[:, : last + 1], float) for a in kept[case])
            pieces.append(((name, simulator(case), case), flow, temperature))
    for name, episodes in rollouts.calm.items():
        pieces.append(((name, "pixels", "calm"), episodes.flow, episodes.temperature))
    texts = {
        name: [words[i] for words, flow, _ in pieces for _ in range(flow.size)]
        for i, name in enumerate(("controller", "simulator", "case"))
    }
    places = [np.indices(flow.shape) for _, flow, _ in pieces]
    return texts | {
        "start": np.concatenate([start.ravel() for start, _ in places]),
        "step": np.concatenate([step.ravel() for _, step in places]),
        "flow_percent": np.concatenate([flow.ravel() for _, flow, _ in pieces]),
        "temperature_degC": np.concatenate([temperature.ravel() for _, _, temperature in pieces]),
    }


def _pixel_row(name: str, case: str, episodes: pixels.Episodes) -> dict[str, Any]:
    """Returns a row of schema SCOREBOARD. An episode is settled if it keeps the target to its end, for at
    least DWELL decisions."""
    since, runs, last = pixels.settled_since(episodes), len(episodes.flow), episodes.flow.shape[1] - 1
    settled = since <= last - DWELL
    share = PooledShare(*wilson(settled), len(settled))
    past = np.sign(100.0 - episodes.flow[:, :1]) * (episodes.flow - 100.0)
    starts = episodes.setpoint[:, 0]
    worst = starts[int(since.argmax())]
    nothing: dict[str, float] = {}
    for key in ("stay", "recovered", "back", *(f"beyond_{points}" for points in BEYOND)):
        nothing |= _ends(key, None)
    return {
        "controller": name,
        "kind": KINDS[name],
        "simulator": "pixels",
        "case": case,
        "counts": False,
        "runs": runs,
        **_ends("settled", share),
        **nothing,
        "median_steps": float(np.median(since[settled])) if settled.any() else np.nan,
        "p90_steps": float(np.percentile(since[settled], 90)) if settled.any() else np.nan,
        "recovery_p95_steps": np.nan,
        "overshoot_p95_percent": float(np.percentile(past.max(axis=1).clip(0), 95)),
        "flow_error_percent": float(np.abs(episodes.flow[:, -DWELL:] - 100.0).mean()),
        "worst_start_flow_percent": float(worst[0]),
        "worst_start_temperature_degC": float(worst[1]),
        "worst_start_settled_percent": 100.0 * float(settled[(starts == worst).all(axis=1)].mean()),
    }


def decisions(name: str, rollouts: PixelRollouts) -> dict[str, list]:
    """Returns columns of schema DECISIONS for the disturbed episodes; nothing if there are none."""
    rows, episodes = [], rollouts.disturbed
    if episodes is None:
        return {}
    for i, words in enumerate(rollouts.words):
        for d in range(episodes.time_s.shape[1]):
            window = deployment.JudgedWindow(*(field[:, d] for field in episodes.windows))
            prob, score, sent = window.p[i], window.score[i], episodes.sent[i, d]
            rows.append(
                {
                    "episode": words,
                    "controller": name,
                    "step": d,
                    "time_s": episodes.time_s[i, d],
                    "flow_percent": episodes.flow[i, d],
                    "temperature_degC": episodes.temperature[i, d],
                    "flow_setpoint_percent": episodes.setpoint[i, d, 0],
                    "target_degC": episodes.setpoint[i, d, 1],
                    "p_under": prob[0],
                    "p_good": prob[1],
                    "p_over": prob[2],
                    "frames": int(window.used[i]),
                    "distance": score if np.isfinite(score) else np.nan,
                    "flow_move_percent": sent[0],
                    "temperature_move_degC": sent[1],
                    "held": bool(window.reason[i] != actuation.ACTS),
                    "why": deployment.why(episodes.time_s[i, d], window, i, sent),
                }
            )
    return _columns(rows)


def metrics(
    contest: Contest, choice: DefaultChoice, pair: Mapping[str, Any], rollouts: PixelRollouts
) -> dict[str, Any]:
    """Returns figures by controller, simulator and case; then the default controller, its cases, and how it
    disturbs good prints."""
    figures: dict[str, Any] = {
        name: {
            source: {
                case: _figures(case, score) for case, score in by_case.items() if simulator(case) == source
            }
            for source in dict.fromkeys(map(simulator, by_case))
        }
        for name, by_case in contest.scores.items()
    }
    for name, episodes in rollouts.calm.items():
        row = _pixel_row(name, "calm", episodes)
        figures[name]["pixels"] = {
            "calm": {
                "settled": row["settled_percent"],
                "median_steps": _plain(row["median_steps"]),
                "overshoot_p95": row["overshoot_p95_percent"],
                "flow_error": row["flow_error_percent"],
            }
        }
    default = contest.scores[choice.name]
    return figures | {
        "default": choice.name,
        "worst": choice.worst,
        "case": choice.case,
        "pair": dict(pair),
        "sentence": choice.sentence,
        "cases": {case: _shares(case, score) for case, score in default.items() if judging.counts(case)},
        "harm": {case: _harm(score) for case, score in default.items() if not judging.counts(case)},
    }


def _shares(case: str, score: RunScore) -> dict[str, float | int | None]:
    """Returns the figures of the default controller in one case. `low` and `high`: 95 % interval of the runs
    that keep the target."""
    figures: dict[str, float | int | None] = {
        "runs": score.runs,
        "settled": score.settled.percent,
        "stay": score.stay.percent,
        "low": score.stay.low,
        "high": score.stay.high,
        "n_eff": score.stay.n,
    }
    if case.endswith("clog"):
        figures |= {
            "recovered": score.recovered.percent,
            "recovery_p95_steps": _plain(score.recovery_p95),
            "back_within_15": score.back.percent,
        }
    return figures


def _harm(score: RunScore) -> dict[str, float | int]:
    """Returns the percentages of runs from good starts that leave +-10, 15 and 25 % within 200 decisions,
    with intervals."""
    named = {f"beyond_{points}": share for points, share in zip(BEYOND, score.beyond, strict=True)}
    return (
        {"runs": score.runs}
        | {name: share.percent for name, share in named.items()}
        | {f"{name}_low": share.low for name, share in named.items()}
        | {f"{name}_high": share.high for name, share in named.items()}
    )


def _figures(case: str, score: RunScore) -> dict[str, float | None]:
    if not judging.counts(case):
        return {f"beyond_{points}": share.percent for points, share in zip(BEYOND, score.beyond, strict=True)}
    return {
        "settled": score.settled.percent,
        "stay": score.stay.percent,
        "median_steps": _plain(score.median_steps),
        "overshoot_p95": score.overshoot_p95,
        "clog_recovered": score.recovered.percent if case.endswith("clog") else None,
        "flow_error": score.flow_error,
    }


def _plain(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
