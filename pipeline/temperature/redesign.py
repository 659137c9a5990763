"""What the bands of the identified plant leave open of a closed loop, by designing its controller anew."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from pipeline.temperature.controllers.problem import DesignProblem
from pipeline.temperature.controllers.table import BY_NAME
from pipeline.temperature.plant import Plant
from pipeline.temperature.test_set.cases import CaseConditions, play
from pipeline.temperature.test_set.panel import costs, rests

REDESIGNS = 7  # plants of the spread that a controller is designed from anew
BROKEN = 2.0  # times the cost, from which a record that cannot be told from this one gives another controller


class Redesigned(NamedTuple):
    """`excess`: the median extra cost as a share; `broken` of `of` plants give a controller that costs BROKEN
    times as much, or none."""

    excess: float
    broken: int
    of: int


def redesigned(
    name: str, problem: DesignProblem, values: Mapping[str, float], setting: CaseConditions
) -> Redesigned:
    """What the bands of the identified plant leave open of a controller's closed loop: with J the mean cost
    of the controller on the training cases, and J_k that of the same controller designed from plant k of the
    spread, REDESIGNS of them, the median of max(J_k / J - 1, 0).

    A PI controller takes gain and lag from a plant, a model-based one all of it: each is charged with the
    doubt in what it takes. The spread is resampled in blocks, so the colour of the residuals is in it."""
    cases = setting.rehearsal.training

    def cost(plant: Plant) -> float:
        try:
            made = BY_NAME[name].design(problem._replace(plant=plant), values)
        except ValueError:  # this plant allows no such controller
            return float("inf")
        if made is None:
            return float("inf")
        figures = play(made, rests(made.model, cases, setting.limits), cases, setting)[1]
        return float(costs(figures, setting.allowance).mean())

    own = cost(problem.plant)
    ratios = np.array([cost(plant) for plant in problem.family[1 : 1 + REDESIGNS]]) / own
    if not ratios.size:
        return Redesigned(float("inf"), 0, 0)
    excess = float(np.quantile(np.maximum(ratios - 1.0, 0.0), 0.5, method="nearest"))
    return Redesigned(excess, int((ratios >= BROKEN).sum()), len(ratios))
