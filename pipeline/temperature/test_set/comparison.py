"""The comparison: which contestant is best, what tells model-based and data-driven apart, and which plant
decides. Cases of one plant stand or fall together: plants are the blocks of every test and of every band."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from pipeline.statistics import Paired, paired

LEVEL = 0.05


class ControllerChoice(NamedTuple):
    """`best` is None where nobody passes; `nearest` is the cheapest of the others that pass, None where
    there is none, and `against` the test of the best one against it."""

    best: str | None
    nearest: str | None
    against: Paired | None


def chosen(
    costs: Mapping[str, np.ndarray], plant: np.ndarray, passes: Mapping[str, bool], *, seed: int
) -> ControllerChoice:
    """The first of those that pass, in the order of `costs` (simplest first), that no more complex one beats:
    one replaces it where its costs (s,) are lower beyond chance, paired by plant, one-sided at LEVEL."""
    able = [name for name in costs if passes[name]]
    if not able:
        return ControllerChoice(None, None, None)
    best = able[0]
    for name in able[1:]:
        if between(costs[best], costs[name], plant, seed=seed).p < LEVEL:
            best = name
    others = [name for name in able if name != best]
    if not others:
        return ControllerChoice(best, None, None)
    nearest = min(others, key=lambda name: float(costs[name].mean()))
    return ControllerChoice(best, nearest, between(costs[nearest], costs[best], plant, seed=seed))


def between(champion: np.ndarray, challenger: np.ndarray, plant: np.ndarray, *, seed: int) -> Paired:
    """The challenger's improvement over the champion on the same cases, paired by plant."""
    floor = 1e-9
    return paired(
        np.maximum(champion, floor),
        np.maximum(challenger, floor),
        [str(index) for index in plant],
        rng=np.random.default_rng(seed),
    )


class Pair(NamedTuple):
    """Of two contestants a and b the cheaper one beyond chance, None where nobody is; by how many percent of
    the other's cost, with the ends of the 90 % interval and the two-sided p."""

    a: str
    b: str
    winner: str | None
    difference: float
    low: float
    high: float
    p: float


def pair(a: str, b: str, costs: Mapping[str, np.ndarray], plant: np.ndarray, *, seed: int) -> Pair:
    """The pair's difference is that of the cheaper one, whether or not it is beyond chance."""
    forward = between(costs[b], costs[a], plant, seed=seed)
    backward = between(costs[a], costs[b], plant, seed=seed)
    cheaper, result = (a, forward) if forward.improvement_percent >= 0 else (b, backward)
    p = min(1.0, 2 * result.p)
    winner = cheaper if p < LEVEL else None
    return Pair(a, b, winner, result.improvement_percent, result.low_percent, result.high_percent, p)


def deciding_plant(a: np.ndarray, b: np.ndarray, plant: np.ndarray) -> int:
    """The plant on which the costs (s,) of two contestants differ most in the direction in which they differ
    on the whole: without it the verdict is told too."""
    ratio = np.log(np.maximum(a, 1e-9) / np.maximum(b, 1e-9))
    by_plant = np.array([ratio[plant == index].mean() for index in np.unique(plant)])
    return int(np.unique(plant)[(np.sign(by_plant.sum() or 1.0) * by_plant).argmax()])


class QuantileBand(NamedTuple):
    """Median and 90 % quantile over all cases, the 90 % band of that quantile with plants resampled as
    blocks, the worst, and the case that has it; inf where a run never settles."""

    median: float
    q90: float
    low: float
    high: float
    worst: float
    worst_case: int


def banded(values: np.ndarray, plant: np.ndarray, *, seed: int, resamples: int = 200) -> QuantileBand:
    """Of a figure (s,); NaN where it does not apply. Less is better."""
    applies = np.flatnonzero(~np.isnan(values))
    values, plant = values[applies], plant[applies]
    median, q90 = np.quantile(values, [0.5, 0.9], method="nearest")
    blocks = [values[plant == index] for index in np.unique(plant)]
    drawn = np.random.default_rng(seed).integers(0, len(blocks), (resamples, len(blocks)))
    quantiles = [
        np.quantile(np.concatenate([blocks[k] for k in row]), 0.9, method="nearest") for row in drawn
    ]
    low, high = np.quantile(quantiles, [0.05, 0.95], method="nearest")
    worst = int(np.argmax(values))
    return QuantileBand(
        float(median), float(q90), float(low), float(high), float(values[worst]), int(applies[worst])
    )


def mean_and_worst(costs: np.ndarray, plant: np.ndarray, *, weight: float) -> float:
    """One number for a search: the geometric mean of the plants' costs, as the paired test counts them, and
    with `weight` that of the costliest quarter, which moves smoothly where the single worst plant would jump.
    One plant that no controller holds cannot set the gains of all."""
    by_plant = np.sort([np.log(max(costs[plant == index].mean(), 1e-9)) for index in np.unique(plant)])
    tail = by_plant[-max(1, len(by_plant) // 4) :].mean()
    return float(np.exp((by_plant.mean() + weight * tail) / (1 + weight)))
