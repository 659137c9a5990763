"""What evaluate_setpoint does: every controller behind one interface, judged on both simulators and through
pixels."""

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from tqdm import tqdm

from pipeline.setpoint.agents import judging
from pipeline.setpoint.agents.judging import Case, Choice, Judged, Runs
from pipeline.setpoint.deployment import deployment, pixels
from pipeline.setpoint.frames import familiar
from pipeline.setpoint.frames.familiar import Camera
from pipeline.setpoint.score import BEYOND, DOES_NOTHING, STEPS, Outcomes, Score, harm_bar, summary
from pipeline.setpoint.simulation import actuation
from pipeline.setpoint.simulation.recorded import WindowTable
from pipeline.setpoint.simulation.simulator import FLOW_LIMITS, TEMPERATURE_LIMITS, Controller, Windows
from pipeline.setpoint.vision.calibrated_classifier import CalibratedClassifier, read_frames
from pipeline.setpoint.vision.window_flow import window_flow
from pipeline.setpoint.workflow.camera_files import FALSE_ALARMS
from pipeline.setpoint.workflow.contestants import THROUGH_PIXELS, ControllerSpec
from pipeline.setpoint.workflow.settings import EvaluateSetpoint, TrainClassifier
from pipeline.setpoint.workflow.tables import DECISIONS
from pipeline.statistics import Mean, Share, shared_variance, wilson


class PixelRollouts(NamedTuple):
    """Episodes through pixels: undisturbed ones by controller, two disturbed ones of the default, and these
    two in words; nothing of them where none was asked for."""

    calm: dict[str, pixels.Episodes]
    disturbed: pixels.Episodes | None
    words: tuple[str, ...]


# ---- on the simulators


class Contest(NamedTuple):
    """Scores of every controller in every case, on segments that are read once; its runs there, and of each
    how many redraws of them these are on; by controller and case that counts the first run from each start.
    """

    scores: dict[str, dict[str, Score]]
    judged: dict[str, Judged]
    redraws: dict[str, int]
    paths: dict[str, Mapping[str, Runs]]


# the cases of which runs of every controller are kept beside the deciding one, and so many decisions of them
PATHS_OF, PATH_STEPS = ("accuracy 0.7", "recorded, fresh"), 100


def bars(settings: EvaluateSetpoint) -> dict[str, float]:
    """Percent of runs that may leave +-25 % by case: from good starts with the camera right, stuck or blind.
    A camera of another make, or with moved borders, is told and bars nobody: no rule can know better."""
    most = settings.most_harmed
    of_each = {
        name: harm_bar(name, perfect=most.perfect_percent, in_band=most.in_band_percent)
        for name in judging.all_cases(1, segment_mean_decisions=1.0)
    }
    return {name: bar for name, bar in of_each.items() if bar is not None}


def chosen(
    specs: Mapping[str, ControllerSpec], windows: WindowTable, settings: EvaluateSetpoint, *, room: int = 0
) -> Choice:
    """The default, by the segments to choose on. In each of settings.rounds every contestant that may still
    win runs on settings.redraws further redraws of them; the others run no more."""
    limits, rounds = bars(settings), settings.rounds
    asked = {name: case for name, case in _cases(settings).items() if not case.good or name in limits}
    rng = np.random.default_rng([settings.seed, 0])
    recorded = judging.redrawn(windows, rounds * settings.redraws, rng, room=room)
    found: dict[str, dict[str, Outcomes]] = {name: {} for name in specs}
    left = list(specs)
    judged: dict[str, Judged] = {}
    for number in range(rounds):
        key = jax.random.fold_in(jax.random.key(settings.seed), number)
        part = _of_round(recorded, number, settings.redraws)
        with _bar(f"choose, round {number + 1}", len(left) * len(asked)) as bar:
            runs = partial(_asked, cases=asked, part=part, redraws=settings.redraws, key=key, bar=bar)
            for name, now in _each(specs, left, lambda name, runs=runs: runs(specs[name])).items():
                found[name] = _with(found[name], now.outcomes)
                judged[name] = _judged(found[name], asked, (number + 1) * settings.redraws)
        if number + 1 < rounds:
            left = [name for name in judging.still_in(judged, limits) if name in left]
    return judging.choose(judged, simplest_first=list(specs), bars=limits)


def contest(
    specs: Mapping[str, ControllerSpec],
    windows: WindowTable,
    settings: EvaluateSetpoint,
    default: str,
    *,
    room: int = 0,
) -> Contest:
    """Figures on segments that nothing was trained, tuned or chosen on: the default on all redraws of them,
    the others on those of one round."""
    rounds, asked = settings.rounds, _cases(settings)
    rng = np.random.default_rng([settings.seed, 1])
    recorded = judging.redrawn(windows, rounds * settings.redraws, rng, room=room)
    of_each = {name: rounds if name == default else 1 for name in specs}
    parts = [_of_round(recorded, number, settings.redraws) for number in range(rounds)]

    def runs(name: str) -> tuple[dict[str, Score], Judged, Mapping[str, Runs]]:
        found: dict[str, Outcomes] = {}
        paths: Mapping[str, Runs] = {}
        for number in range(of_each[name]):
            key = jax.random.fold_in(jax.random.key(settings.seed), rounds + number)
            now = _asked(specs[name], asked, parts[number], settings.redraws, key, bar)
            found, paths = _with(found, now.outcomes), paths or now.paths
        redraws = of_each[name] * settings.redraws
        return _summaries(found, redraws), _judged(found, asked, redraws), paths

    with _bar("judge", sum(of_each.values()) * len(asked)) as bar:
        done = _each(specs, list(specs), runs)
    redraws = {name: count * settings.redraws for name, count in of_each.items()}
    return Contest(
        {name: scores for name, (scores, _, _) in done.items()},
        {name: judged for name, (_, judged, _) in done.items()},
        redraws,
        {name: paths for name, (_, _, paths) in done.items()},
    )


T = TypeVar("T")


def _each(
    specs: Mapping[str, ControllerSpec], names: Sequence[str], work: Callable[[str], T]
) -> dict[str, T]:
    """work(name) of each contestant, on every core at once. Those of one controller follow each other, as
    they share what is compiled; the elaborate ones begin. What comes out does not depend on the cores."""
    alike: dict[Controller, list[str]] = {}
    for name in names:
        alike.setdefault(specs[name].controller, []).append(name)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        done = pool.map(lambda group: {name: work(name) for name in group}, [*alike.values()][::-1])
        found = {name: one for group in done for name, one in group.items()}
    return {name: found[name] for name in names}


def _bar(words: str, total: int) -> tqdm:
    return tqdm(total=total, desc=f"evaluate_setpoint: {words}", mininterval=2)


def _summaries(outcomes: Mapping[str, Outcomes], redraws: int) -> dict[str, Score]:
    """The scores of one controller; what runs on one redraw share is told by all cases alike."""
    figures: dict[str, list[np.ndarray]] = {"fresh": [], "sticky": []}
    for case, of in outcomes.items():
        shares = [of.settled, of.stay] if judging.counts(case) else list(of.beyond.T)
        if group := judging.alike(case):
            figures[group] += [share.reshape(redraws, -1) for share in shares]
    shared = {group: shared_variance(blocks) for group, blocks in figures.items()}
    return {
        case: summary(of, redraws=redraws, shared=shared[judging.alike(case)])
        if judging.alike(case)
        else summary(of)
        for case, of in outcomes.items()
    }


def _cases(settings: EvaluateSetpoint) -> dict[str, Case]:
    return judging.all_cases(settings.runs, segment_mean_decisions=settings.segment_mean_decisions)


def _of_round(recorded: Windows, number: int, redraws: int) -> Windows:
    """The redraws of one round, as many in each, so that all rounds are one program."""
    part = slice(number * redraws, (number + 1) * redraws)
    return recorded._replace(table=jax.tree.map(lambda leaf: leaf[part], recorded.table))


class Asked(NamedTuple):
    """By case what became of one controller's runs; and the first of them from each start, of cases that
    count: which of these decides is known when all are judged."""

    outcomes: dict[str, Outcomes]
    paths: dict[str, Runs]


def _asked(
    spec: ControllerSpec, cases: Mapping[str, Case], part: Windows, redraws: int, key: jax.Array, bar: tqdm
) -> Asked:
    """One controller's runs in all cases, on each redraw of a round."""
    found, paths = {}, {}
    for number, (name, case) in enumerate(cases.items()):
        keys = jax.random.split(jax.random.fold_in(key, number), redraws)
        of = judging.runs(spec.controller, spec.parameters, case, part, keys)
        found[name] = judging.become(of)
        if judging.counts(name):
            # a copy, so that the other runs can be let go
            paths[name] = jax.tree.map(np.copy, judging.first_of_each(of))
        bar.update()
    return Asked(found, paths)


def _with(before: Mapping[str, Outcomes], now: Mapping[str, Outcomes]) -> dict[str, Outcomes]:
    """Runs of a further round behind those of earlier ones."""
    if not before:
        return dict(now)
    return {case: jax.tree.map(lambda *a: np.concatenate(a), before[case], of) for case, of in now.items()}


def _judged(outcomes: Mapping[str, Outcomes], cases: Mapping[str, Case], redraws: int) -> Judged:
    def blocks(happened: np.ndarray) -> np.ndarray:
        return happened.reshape(redraws, -1)

    return Judged(
        {name: blocks(outcomes[name].stay) for name, case in cases.items() if not case.good},
        {name: blocks(outcomes[name].beyond[:, -1]) for name, case in cases.items() if case.good},
    )


def told(choice: Choice, contest: Contest) -> Choice:
    """The choice with its figures on the segments that are read once; the margin there over the strongest
    other, with its interval, is of the redraws that both ran on. Its sentence says what it was chosen by, and
    then these."""
    mine = contest.judged[choice.name]
    case = judging.worst_case(mine)[1]
    stay = contest.scores[choice.name][case].stay
    others = [of for name, of in contest.judged.items() if name not in (choice.name, *choice.refused)]
    nothing = Mean(*3 * (float("nan"),))
    margin = judging.lead(mine, max(others, key=lambda of: judging.worst_case(of)[0])) if others else nothing
    sentence = (
        f"{choice.sentence} On segments that it was not chosen on, {stay.percent:.1f} % ({stay.low:.1f} to "
        f"{stay.high:.1f}) of its runs settle and stay in its worst case ({case})."
    )
    return choice._replace(
        worst=stay.percent,
        case=case,
        margin=margin.value,
        margin_low=margin.low,
        margin_high=margin.high,
        sentence=sentence,
    )


def choice_record(choice: Choice) -> dict[str, Any]:
    """What choice.json holds: null where there is no figure, as of a margin where nothing else may run."""
    return {
        name: _plain(value) if isinstance(value, float) else value for name, value in choice._asdict().items()
    }


def simulator(case: str) -> str:
    """Whose windows a case has: paper or recorded; harm, recorded ones from good starts."""
    if not judging.counts(case):
        return "harm"
    return "recorded" if case.startswith("recorded") else "paper"


def scoreboard(
    specs: Mapping[str, ControllerSpec], contest: Contest, rollouts: PixelRollouts
) -> dict[str, list]:
    """Columns of schema SCOREBOARD."""
    rows = [
        _score_row(name, specs[name].kind, case, score, contest.redraws[name])
        for name, by_case in contest.scores.items()
        for case, score in by_case.items()
    ]
    return _columns(
        rows
        + [_pixel_row(name, specs[name].kind, "calm", episodes) for name, episodes in rollouts.calm.items()]
    )


def _score_row(name: str, kind: str, case: str, score: Score, redraws: int) -> dict[str, Any]:
    clogged = case.endswith("clog")
    shares: dict[str, Share | None] = {
        "settled": score.settled,
        "stay": score.stay,
        "recovered": score.recovered if clogged else None,
        "back": score.back if clogged else None,
    }
    harmed = score.beyond if not judging.counts(case) else [None] * len(BEYOND)
    shares |= {f"beyond_{points}": share for points, share in zip(BEYOND, harmed, strict=True)}
    return {
        "controller": name,
        "kind": kind,
        "simulator": simulator(case),
        "case": case,
        "counts": judging.counts(case),
        "runs": score.runs,
        "redraws": 1 if simulator(case) == "paper" else redraws,
        **{column: value for key, share in shares.items() for column, value in _ends(key, share).items()},
        "median_steps": score.median_steps,
        "p90_steps": score.p90_steps,
        "recovery_steps": score.recovery_steps if clogged else np.nan,
        "overshoot_p95_percent": score.overshoot_p95,
        "flow_error_percent": score.flow_error,
        "worst_start_flow_percent": score.worst_start[0],
        "worst_start_temperature_degC": score.worst_start[1],
        "worst_start_settled_percent": score.worst_start[2],
    }


def _ends(key: str, share: Share | None) -> dict[str, float]:
    """The three columns of a share, missing where it is none."""
    values = (np.nan,) * 3 if share is None else share
    return dict(zip((f"{key}_percent", f"{key}_low_percent", f"{key}_high_percent"), values, strict=True))


def _columns(rows: list[dict[str, Any]]) -> dict[str, list]:
    return {name: [row[name] for row in rows] for name in rows[0]}


def compared(specs: Mapping[str, ControllerSpec], contest: Contest, choice: Choice) -> list[str]:
    """Who is set beside the default in its worst case, in the contestants' order: doing nothing, the
    strongest simple rule and the strongest agent of ours. The strongest keeps most in its own worst case;
    who may not run gives way to who may."""
    names = {choice.name, DOES_NOTHING}
    for kind in ("baseline", "agent"):
        others = [name for name in contest.judged if specs[name].kind == kind and name not in names]
        others.sort(key=lambda name: (name in choice.refused, -judging.worst_case(contest.judged[name])[0]))
        names |= {*others[:1]}
    return [name for name in contest.judged if name in names]


def paths(
    specs: Mapping[str, ControllerSpec], contest: Contest, choice: Choice, rollouts: PixelRollouts
) -> dict[str, Any]:
    """Columns of schema PATHS: one run from each of the 21 starts, of those judged. Of every controller
    PATH_STEPS decisions of the cases PATHS_OF; of those that are compared STEPS of the choice's case, which
    decides. And the runs through pixels."""
    pieces = []
    for case in dict.fromkeys((*PATHS_OF, choice.case)):
        names = contest.paths if case in PATHS_OF else compared(specs, contest, choice)
        last = STEPS if case == choice.case else PATH_STEPS
        for name in names:
            flow, temperature = (np.asarray(a[:, : last + 1], float) for a in contest.paths[name][case])
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


# ---- through pixels

# decisions at the end of an episode that it must be inside for, to count as settled
DWELL = 10


def pixel_rollouts(
    specs: Mapping[str, ControllerSpec],
    choice: Choice,
    model: CalibratedClassifier,
    settings: EvaluateSetpoint,
    view: TrainClassifier,
    known: Camera | None,
) -> PixelRollouts:
    """The default, and our agent or the robust filter beside it, from some starts; and two
    episodes in which something befalls the default. Windows that are not of the known camera are held.
    Nothing runs where no start is asked for."""
    if not settings.pixels.starts:
        return PixelRollouts({}, None, ())
    names = dict.fromkeys((choice.name, *THROUGH_PIXELS))
    start, disturbances, words = _disturbed(settings)
    at, loop = some_starts(settings), _loop(model, settings, view, known)
    with tqdm(total=3, desc="evaluate_setpoint: through pixels", mininterval=2) as bar:
        calm = {}
        for name in list(names)[:2]:
            calm[name] = _through(specs[name], loop, at, settings, pixels.calm(len(at)), seed=1)
            bar.update()
        disturbed = _through(specs[choice.name], loop, start, settings, disturbances, seed=2)
        bar.update()
    return PixelRollouts(calm, disturbed, words)


def _through(
    spec: ControllerSpec,
    loop: pixels.Loop,
    start: np.ndarray,
    settings: EvaluateSetpoint,
    disturbances: pixels.Disturbances,
    *,
    seed: int,
) -> pixels.Episodes:
    """Episodes from setpoints start (E, 2)."""
    return pixels.run(
        spec.controller,
        spec.parameters,
        start,
        loop,
        disturbances,
        decisions=settings.pixels.decisions,
        rng=np.random.default_rng([settings.seed, seed]),
    )


def _loop(
    model: CalibratedClassifier, settings: EvaluateSetpoint, view: TrainClassifier, known: Camera | None
) -> pixels.Loop:
    """The loop as deployed, with limits of what one action and one minute may change."""
    q, fitted = settings.pixels, model.calibration
    return pixels.Loop(
        machine=pixels.Machine(q.heater_s, q.heater_delay_s, q.melt_s, q.softening_per_degC),
        classify=partial(read_frames, model),
        frames=view.window,
        frame_rate_hz=q.frame_rate_hz,
        waits=actuation.Waits(q.wait_s, q.wait_s, q.idle_wait_s),
        limits=actuation.Limits(
            *(np.array(pair) for pair in zip(FLOW_LIMITS, TEMPERATURE_LIMITS, strict=True)),
            np.array(q.per_action),
            np.array(q.per_minute),
        ),
        judge=partial(
            deployment.judge_window,
            least_frames=q.least_frames,
            correlation=fitted.correlation,
            foreign_above=fitted.foreign_above,
            conformal_level=fitted.level,
        ),
        least_score=view.least_score,
        tip_tolerance_px=q.tip_tolerance_px,
        segment_mean_s=q.segment_mean_s,
        window_flow=partial(window_flow, fitted=fitted.flow),
        foreign=known and partial(familiar.foreign, known, false_alarms=FALSE_ALARMS),
    )


def some_starts(settings: EvaluateSetpoint) -> np.ndarray:
    """(E, 2) flow in percent and temperature in °C: settings.pixels.starts of the 21, spread over
    flows and temperatures, settings.pixels.runs times each."""
    starts = judging.starts(1, accuracy=1.0)
    chosen = np.unique(np.linspace(0, 20, settings.pixels.starts).round().astype(int))
    return np.repeat(
        np.stack([np.asarray(starts.flow)[chosen], np.asarray(starts.temperature)[chosen]], axis=1),
        settings.pixels.runs,
        axis=0,
    ).astype(float)


def _pixel_row(name: str, kind: str, case: str, episodes: pixels.Episodes) -> dict[str, Any]:
    """A row of schema SCOREBOARD: settled is inside to the end from at least DWELL decisions before it."""
    since, runs, last = pixels.settled_since(episodes), len(episodes.flow), episodes.flow.shape[1] - 1
    settled = since <= last - DWELL
    share = wilson(settled)
    past = np.sign(100.0 - episodes.flow[:, :1]) * (episodes.flow - 100.0)
    starts = episodes.setpoint[:, 0]
    worst = starts[int(since.argmax())]
    nothing: dict[str, float] = {}
    for key in ("stay", "recovered", "back", *(f"beyond_{points}" for points in BEYOND)):
        nothing |= _ends(key, None)
    return {
        "controller": name,
        "kind": kind,
        "simulator": "pixels",
        "case": case,
        "counts": False,
        "runs": runs,
        "redraws": 1,
        **_ends("settled", share),
        **nothing,
        "median_steps": float(np.median(since[settled])) if settled.any() else np.nan,
        "p90_steps": float(np.percentile(since[settled], 90)) if settled.any() else np.nan,
        "recovery_steps": np.nan,
        "overshoot_p95_percent": float(np.percentile(past.max(axis=1).clip(0), 95)),
        "flow_error_percent": float(np.abs(episodes.flow[:, -DWELL:] - 100.0).mean()),
        "worst_start_flow_percent": float(worst[0]),
        "worst_start_temperature_degC": float(worst[1]),
        "worst_start_settled_percent": 100.0 * float(settled[(starts == worst).all(axis=1)].mean()),
    }


def _disturbed(settings: EvaluateSetpoint) -> tuple[np.ndarray, pixels.Disturbances, tuple[str, str]]:
    """The two episodes that the page shows, whatever comes of them: the hardest start, and a clog with
    pictures out of focus later."""
    D = settings.pixels.decisions
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


def decisions(name: str, rollouts: PixelRollouts) -> dict[str, list]:
    """Columns of schema DECISIONS: the two disturbed episodes."""
    rows, episodes = [], rollouts.disturbed
    if episodes is None:
        return {column.name: [] for column in DECISIONS.columns}
    for i, words in enumerate(rollouts.words):
        for d in range(episodes.time_s.shape[1]):
            window = deployment.Window(*(field[:, d] for field in episodes.windows))
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


# ---- metrics


def metrics(
    specs: Mapping[str, ControllerSpec], contest: Contest, choice: Choice, rollouts: PixelRollouts
) -> dict[str, Any]:
    """By controller, simulator and case; then the default, its cases and what it does to good prints."""
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
        row = _pixel_row(name, specs[name].kind, "calm", episodes)
        figures[name]["pixels"] = {
            "calm": {
                "settled": row["settled_percent"],
                "median_steps": _plain(row["median_steps"]),
                "overshoot_p95": row["overshoot_p95_percent"],
                "flow_error": row["flow_error_percent"],
            }
        }
    mine = contest.scores[choice.name]
    return figures | {
        "default": choice.name,
        "worst": choice.worst,
        "case": choice.case,
        "margin": _plain(choice.margin),
        "margin_low": _plain(choice.margin_low),
        "margin_high": _plain(choice.margin_high),
        "sentence": choice.sentence,
        "cases": {case: _shares(case, score) for case, score in mine.items() if judging.counts(case)},
        "harm": {case: _harm(score) for case, score in mine.items() if not judging.counts(case)},
    }


def _shares(case: str, score: Score) -> dict[str, float | int | None]:
    """Of a case of the default: low and high are the ends of the 95 % interval of the runs that stay."""
    figures: dict[str, float | int | None] = {
        "runs": score.runs,
        "settled": score.settled.percent,
        "stay": score.stay.percent,
        "low": score.stay.low,
        "high": score.stay.high,
    }
    if case.endswith("clog"):
        figures |= {
            "recovered": score.recovered.percent,
            "recovery_steps": _plain(score.recovery_steps),
            "back_within_15": score.back.percent,
        }
    return figures


def _harm(score: Score) -> dict[str, float | int]:
    """Percent of runs from good starts that leave +-10, 15 and 25 % within 200 decisions, with intervals."""
    named = {f"beyond_{points}": share for points, share in zip(BEYOND, score.beyond, strict=True)}
    return (
        {"runs": score.runs}
        | {name: share.percent for name, share in named.items()}
        | {f"{name}_low": share.low for name, share in named.items()}
        | {f"{name}_high": share.high for name, share in named.items()}
    )


def _figures(case: str, score: Score) -> dict[str, float | None]:
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
