"""Controllers of setpoints on one yardstick: 21 starts x runs judged by the true flow,
and the choice of the default by its worst case."""

from typing import NamedTuple

import jax
import numpy as np

from pipeline.setpoint.score import CLOG_STEP, STEPS, Score, judge
from pipeline.setpoint.simulator import Conditions, Controller, Windows, nominal, paper_windows, rollout

START_FLOWS, START_TEMPERATURES = (
    (30.0, 60.0, 80.0, 120.0, 150.0, 200.0, 300.0),
    (190.0, 210.0, 230.0),
)  # section 3.4


class Choice(NamedTuple):
    """The default: worst is the share of runs (percent) that settle and stay in its worst case, margin the
    points by which that exceeds the next controller's worst."""

    name: str
    worst: float
    case: str
    margin: float
    sentence: str


def starts(runs: int, *, accuracy: float) -> Conditions:
    """The 21 starts of the paper, `runs` times each (21 runs,), on a machine that does as it is told."""
    flow, temperature = (
        a.ravel() for a in np.meshgrid(np.repeat(START_FLOWS, runs), START_TEMPERATURES, indexing="ij")
    )
    return nominal(flow, temperature, accuracy=accuracy)


def cases(
    recorded: Windows, *, runs: int, segment_mean_decisions: float
) -> dict[str, tuple[Windows, Conditions]]:
    """What every controller is judged on, by name: both simulators, with the actuator at 0.6 of its gain, and
    with a clog (flow x 0.6 from step 60).

    recorded: from `recorded_windows`; its conditions last segment_mean_decisions in the sticky cases.
    """
    paper, rough, fresh = paper_windows(), starts(runs, accuracy=0.7), starts(runs, accuracy=1.0)
    one = jax.numpy.ones_like(fresh.flow)
    sticky = fresh._replace(persistence=segment_mean_decisions * one)
    weak, clog = {"gain": 0.6 * one}, {"clog": 0.6 * one, "clog_step": CLOG_STEP * one}
    return {
        **{
            f"accuracy {accuracy:g}": (paper, starts(runs, accuracy=accuracy))
            for accuracy in (1.0, 0.9, 0.8, 0.7)
        },
        "accuracy 0.7, gain 0.6": (paper, rough._replace(**weak)),
        "accuracy 0.7, clog": (paper, rough._replace(**clog)),
        "recorded, fresh": (recorded, fresh),
        "recorded, sticky": (recorded, sticky),
        "recorded, fresh, gain 0.6": (recorded, fresh._replace(**weak)),
        "recorded, sticky, gain 0.6": (recorded, sticky._replace(**weak)),
        "recorded, fresh, clog": (recorded, fresh._replace(**clog)),
        "recorded, sticky, clog": (recorded, sticky._replace(**clog)),
    }


def evaluate(
    controller: Controller, parameters, windows: Windows, conditions: Conditions, key: jax.Array
) -> Score:
    """Roll out and judge."""
    trajectory = rollout(controller, parameters, windows, conditions, key, steps=STEPS)
    return judge(trajectory.flow, trajectory.temperature)


def choose(scores: dict[str, dict[str, Score]]) -> Choice:
    """The controller with the best worst case: scores[controller][case], read by the share that settles and
    stays, of two alike the one with the better mean.

    Raises ValueError where controllers were not judged on the same cases.
    """
    cases = {frozenset(by_case) for by_case in scores.values()}
    if len(cases) != 1:
        raise ValueError(
            "choose: expected every controller judged on the same cases, "
            f"found {sorted(sorted(c) for c in cases)}; judge all on all"
        )
    figures = {
        name: sorted((score.stay.percent, case) for case, score in by_case.items())
        for name, by_case in scores.items()
    }
    ranked = sorted(
        figures,
        key=lambda name: (figures[name][0][0], np.mean([stay for stay, _ in figures[name]])),
        reverse=True,
    )
    (worst, case), *others = (figures[name][0] for name in ranked)
    sentence = (
        f"{ranked[0]} is the default: in its worst case ({case}) {worst:.1f} % of the runs settle and stay"
    )
    if not others:
        return Choice(ranked[0], worst, case, float("nan"), f"{sentence}; nothing else was judged.")
    next_worst, next_case = others[0]
    margin = worst - next_worst
    return Choice(
        ranked[0],
        worst,
        case,
        margin,
        f"{sentence}, {margin:.1f} points more than of {ranked[1]} in its worst ({next_case}, "
        f"{next_worst:.1f} %).",
    )
