"""Controllers simulated in every case on redrawn segments, round by round, and who is left after a round."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from pipeline.setpoint.agents.criteria import harm_bar
from pipeline.setpoint.agents.score import Outcomes, RunScore, summary
from pipeline.setpoint.evaluation import judging
from pipeline.setpoint.evaluation.judging import Case, DefaultChoice, JudgedRuns, Runs
from pipeline.setpoint.simulation.simulator import SetpointController, WindowSource
from pipeline.statistics import Mean, shared_variance


class Contest(NamedTuple):
    """Every controller on segments that are read once, by name."""

    scores: dict[str, dict[str, RunScore]]  # by case
    judged: dict[str, JudgedRuns]
    redraws: dict[str, int]  # of the segments, that its runs are on
    paths: dict[str, Mapping[str, Runs]]  # by case that counts, the first run from each start


def harm_limits(*, perfect: float, in_band: float) -> dict[str, float]:
    """Percent of runs that may leave +-25 % by case: from good starts with the camera right, stuck or blind.
    With a camera of another make, or with moved borders, harm is reported and bars nobody: no rule can know
    better."""
    limits = {
        name: harm_bar(name, perfect=perfect, in_band=in_band)
        for name in judging.all_cases(1, segment_mean_decisions=1.0)
    }
    return {name: limit for name, limit in limits.items() if limit is not None}


def simulate(
    controller: SetpointController,
    parameters: Any,
    cases: Mapping[str, Case],
    windows: WindowSource,
    redraws: int,
    key: jax.Array,
    on_case: Callable[[], object],
) -> tuple[dict[str, Outcomes], dict[str, Runs]]:
    """What became of one controller's runs by case, on each redraw of a round; and the first run from each
    start, of cases that count: which of these decides is known when all are judged."""
    outcomes, paths = {}, {}
    for number, (name, case) in enumerate(cases.items()):
        keys = jax.random.split(jax.random.fold_in(key, number), redraws)
        runs = judging.runs(controller, parameters, case, windows, keys)
        outcomes[name] = judging.become(runs)
        if judging.counts(name):
            # a copy, so that the other runs can be let go
            paths[name] = jax.tree.map(np.copy, judging.first_of_each(runs))
        on_case()
    return outcomes, paths


def one_round(redrawn: WindowSource, number: int, redraws: int) -> WindowSource:
    """The redraws of one round, as many in each, so that all rounds are one program."""
    part = slice(number * redraws, (number + 1) * redraws)
    return redrawn._replace(table=jax.tree.map(lambda leaf: leaf[part], redrawn.table))


def append(before: Mapping[str, Outcomes], batch: Mapping[str, Outcomes]) -> dict[str, Outcomes]:
    """Runs of a further round behind those of earlier ones, by case."""
    if not before:
        return dict(batch)
    return {case: jax.tree.map(lambda *a: np.concatenate(a), before[case], of) for case, of in batch.items()}


def judge(outcomes: Mapping[str, Outcomes], cases: Mapping[str, Case], redraws: int) -> JudgedRuns:
    """A controller's runs by case, block by block: kept from wrong starts, harmed from good ones."""

    def blocks(happened: np.ndarray) -> np.ndarray:
        return happened.reshape(redraws, -1)

    return JudgedRuns(
        {name: blocks(outcomes[name].stay) for name, case in cases.items() if not case.good},
        {name: blocks(outcomes[name].beyond[:, -1]) for name, case in cases.items() if case.good},
    )


def eliminate(
    survivors: Sequence[str], judged: Mapping[str, JudgedRuns], limits: Mapping[str, float]
) -> list[str]:
    """Those of the survivors that may still become the default."""
    return [name for name in judging.still_in(judged, limits) if name in survivors]


def summaries(outcomes: Mapping[str, Outcomes], redraws: int) -> dict[str, RunScore]:
    """The scores of one controller by case; all cases alike tell how much the runs on one redraw share."""
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


def with_figures(choice: DefaultChoice, contest: Contest) -> DefaultChoice:
    """The choice with its figures on the segments that are read once; the margin there over the strongest
    other, with its interval, is of the redraws that both ran on. Its sentence says what it was chosen by, and
    then these."""
    default = contest.judged[choice.name]
    case = judging.worst_case(default)[1]
    stay = contest.scores[choice.name][case].stay
    others = [of for name, of in contest.judged.items() if name not in (choice.name, *choice.refused)]
    margin = Mean(*3 * (float("nan"),))
    if others:
        margin = judging.lead(default, max(others, key=lambda of: judging.worst_case(of)[0]))
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
