"""Controllers of setpoints on one yardstick: 21 starts x runs judged by the true flow, and the choice of the default by its worst case."""

from typing import NamedTuple

import jax
import numpy as np
import scipy.special

from pipeline.setpoint.reward import BEST_FLOW, BEST_TEMPERATURE
from pipeline.setpoint.simulator import Conditions, Controller, Trajectory, Windows, nominal, paper_windows, rollout

START_FLOWS, START_TEMPERATURES = (30.0, 60.0, 80.0, 120.0, 150.0, 200.0, 300.0), (190.0, 210.0, 230.0)  # section 3.4
FLOW_BAND, TEMPERATURE_BAND = 10.0, 5.0  # about 100 % and 210 °C
SETTLED_BY, DWELL_UNTIL, STEPS = 90, 100, 200  # inside from some step <= 90 until 100; never out from 100 to 200 is staying
CLOG_STEP, RECOVERED_UNTIL = 60, 120


class Share(NamedTuple):
    """A share of runs in percent with its 95 % Wilson interval."""

    percent: float
    low: float
    high: float


class Score(NamedTuple):
    """n runs. Shares of all runs: settled (inside 90-110 % and 210 +- 5 °C from some step <= 90 until 100), stay (settled, and never out from 100 to 200), recovered
    (inside from some step <= 90 until 120: the one to read where something befalls the machine at step 60).

    median_steps and p90_steps of the settled runs until they are inside for good (NaN where none settled); overshoot_p95 of the points of flow past 100 % on the far
    side of the start, before step 60; flow_error the mean of |q - 100 %| over steps 100 to 200; worst_start names the start with the fewest settled, with its percent.
    """

    runs: int
    settled: Share
    stay: Share
    recovered: Share
    median_steps: float
    p90_steps: float
    overshoot_p95: float
    flow_error: float
    worst_start: tuple[float, float, float]


class Choice(NamedTuple):
    """The default: worst is the share of runs (percent) that settle and stay in its worst case, margin the points by which that exceeds the next controller's worst."""

    name: str
    worst: float
    case: str
    margin: float
    sentence: str


def starts(runs: int, *, accuracy: float) -> Conditions:
    """The 21 starts of the paper, `runs` times each (21 runs,), on a machine that does as it is told."""
    flow, temperature = (a.ravel() for a in np.meshgrid(np.repeat(START_FLOWS, runs), START_TEMPERATURES, indexing="ij"))
    return nominal(flow, temperature, accuracy=accuracy)


def cases(recorded: Windows, *, runs: int, segment: float) -> dict[str, tuple[Windows, Conditions]]:
    """What every controller is judged on, by name: both simulators, with the actuator at 0.6 of its gain, and with a clog (flow x 0.6 from step 60).

    recorded: from `recorded_windows`; segment: decisions that its conditions last on average in the sticky cases.
    """
    paper, rough, fresh = paper_windows(), starts(runs, accuracy=0.7), starts(runs, accuracy=1.0)
    one = jax.numpy.ones_like(fresh.flow)
    sticky = fresh._replace(persistence=segment * one)
    weak, clog = {"gain": 0.6 * one}, {"clog": 0.6 * one, "clog_step": CLOG_STEP * one}
    return {
        **{f"accuracy {accuracy:g}": (paper, starts(runs, accuracy=accuracy)) for accuracy in (1.0, 0.9, 0.8, 0.7)},
        "accuracy 0.7, gain 0.6": (paper, rough._replace(**weak)),
        "accuracy 0.7, clog": (paper, rough._replace(**clog)),
        "recorded, fresh": (recorded, fresh),
        "recorded, sticky": (recorded, sticky),
        "recorded, fresh, gain 0.6": (recorded, fresh._replace(**weak)),
        "recorded, sticky, gain 0.6": (recorded, sticky._replace(**weak)),
        "recorded, fresh, clog": (recorded, fresh._replace(**clog)),
        "recorded, sticky, clog": (recorded, sticky._replace(**clog)),
    }


def judge(trajectory: Trajectory) -> Score:
    """The score of n trajectories of at least 200 decisions, by their true flow and temperature.

    Raises ValueError for shorter ones.
    """
    flow, temperature = np.asarray(trajectory.flow, float), np.asarray(trajectory.temperature, float)
    if flow.shape[1] <= STEPS:
        raise ValueError(f"judge: expected trajectories of {STEPS} decisions, found {flow.shape[1] - 1}; roll out with steps={STEPS}")
    # float32 sums of moves end a hair outside a border that they are on
    inside = (np.abs(flow - BEST_FLOW) <= FLOW_BAND + 1e-3) & (np.abs(temperature - BEST_TEMPERATURE) <= TEMPERATURE_BAND + 1e-3)
    entered = _inside_since(inside, DWELL_UNTIL)
    settled, stay = entered <= SETTLED_BY, (entered <= SETTLED_BY) & inside[:, DWELL_UNTIL : STEPS + 1].all(axis=1)
    recovered = _inside_since(inside, RECOVERED_UNTIL) <= SETTLED_BY
    past = np.sign(BEST_FLOW - flow[:, :1]) * (flow[:, :CLOG_STEP] - BEST_FLOW)
    median, p90 = np.percentile(entered[settled], [50, 90]) if settled.any() else (np.nan, np.nan)
    return Score(
        runs=len(flow),
        settled=wilson(settled),
        stay=wilson(stay),
        recovered=wilson(recovered),
        median_steps=float(median),
        p90_steps=float(p90),
        overshoot_p95=float(np.percentile(past.max(axis=1).clip(0), 95)),
        flow_error=float(np.abs(flow[:, DWELL_UNTIL : STEPS + 1] - BEST_FLOW).mean()),
        worst_start=_worst_start(flow[:, 0], temperature[:, 0], settled),
    )


def evaluate(controller: Controller, parameters, windows: Windows, conditions: Conditions, key: jax.Array) -> Score:
    """Roll out and judge."""
    return judge(rollout(controller, parameters, windows, conditions, key, steps=STEPS))


def _inside_since(inside: np.ndarray, until: int) -> np.ndarray:
    """The first step (n,) from which each run is inside through step `until`; until + 1 where it is outside then."""
    out = ~inside[:, until::-1]
    return np.where(out.any(axis=1), until + 1 - out.argmax(axis=1), 0)


def _worst_start(flow: np.ndarray, temperature: np.ndarray, settled: np.ndarray) -> tuple[float, float, float]:
    pairs, which = np.unique(np.stack([flow, temperature], axis=1), axis=0, return_inverse=True)
    percent = 100.0 * np.bincount(which.ravel(), weights=settled) / np.bincount(which.ravel())
    worst = int(percent.argmin())
    return float(pairs[worst, 0]), float(pairs[worst, 1]), float(percent[worst])


def wilson(happened: np.ndarray) -> Share:
    """The share of True (n,) in percent with the interval of Wilson 1927 at 95 %: (p + z^2 / 2n +- z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n)."""
    n, p, z = len(happened), float(np.mean(happened)), float(scipy.special.ndtri(0.975))
    centre, half = (p + z**2 / (2 * n)) / (1 + z**2 / n), z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2)) / (1 + z**2 / n)
    return Share(100.0 * p, float(100.0 * max(centre - half, 0.0)), float(100.0 * min(centre + half, 1.0)))


def choose(scores: dict[str, dict[str, Score]]) -> Choice:
    """The controller with the best worst case: scores[controller][case], read by the share that settles and stays, of two alike the one with the better mean.

    Raises ValueError where controllers were not judged on the same cases.
    """
    cases = {frozenset(of) for of in scores.values()}
    if len(cases) != 1:
        raise ValueError(
            f"choose: expected every controller judged on the same cases, found {sorted(sorted(c) for c in cases)}; judge all on all"
        )
    figures = {name: sorted((score.stay.percent, case) for case, score in of.items()) for name, of in scores.items()}
    ranked = sorted(figures, key=lambda name: (figures[name][0][0], np.mean([stay for stay, _ in figures[name]])), reverse=True)
    (worst, case), *others = (figures[name][0] for name in ranked)
    sentence = f"{ranked[0]} is the default: in its worst case ({case}) {worst:.1f} % of the runs settle and stay"
    if not others:
        return Choice(ranked[0], worst, case, float("nan"), f"{sentence}; nothing else was judged.")
    next_worst, next_case = others[0]
    margin = worst - next_worst
    return Choice(
        ranked[0],
        worst,
        case,
        margin,
        f"{sentence}, {margin:.1f} points more than of {ranked[1]} in its worst ({next_case}, {next_worst:.1f} %).",
    )


def rows(scores: dict[str, dict[str, Score]]) -> list[dict[str, str | float | int]]:
    """One flat row a controller and case: each field of the score, shares as percent, low and high."""
    return [
        {
            "controller": name,
            "case": case,
            **{key: value for field, entry in zip(score._fields, score, strict=True) for key, value in _flat(field, entry)},
        }
        for name, of in scores.items()
        for case, score in of.items()
    ]


def _flat(field: str, entry) -> list[tuple[str, float | int]]:
    if isinstance(entry, Share):
        return [(field, entry.percent), (f"{field}_low", entry.low), (f"{field}_high", entry.high)]
    if isinstance(entry, tuple):
        return [(f"{field}_{part}", value) for part, value in zip(("flow", "temperature", "settled"), entry, strict=True)]
    return [(field, entry)]
