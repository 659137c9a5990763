"""What the bands of the identified plant leave open of a closed loop, by designing its controller anew."""

from collections.abc import Mapping

import numpy as np

from pipeline.temperature.controllers.problem import DesignProblem
from pipeline.temperature.controllers.table import BY_NAME
from pipeline.temperature.plant import Plant
from pipeline.temperature.test_set.cases import CaseConditions, play
from pipeline.temperature.test_set.panel import costs, rests

REDESIGNS = 7  # plants of the spread that a controller is designed from anew


def redesign_excess(
    name: str, problem: DesignProblem, values: Mapping[str, float], setting: CaseConditions
) -> float:
    """What the bands of the identified plant leave open of a controller's closed loop: the extra cost

        mean of max(J_k / J - 1, 0)

    with J the mean cost of the controller on the training cases, and J_k that of the same controller designed
    from plant k of the spread: `REDESIGNS` of them. Infinite if one of them allows no controller.

    A PI controller takes gain and lag from a plant, a model-based one all of it: each is charged with the
    doubt in what it takes. The spread is resampled in blocks, so the colour of the residuals is in it."""
    cases = setting.rehearsal.training

    def cost(plant: Plant) -> float:
        made = BY_NAME[name].design(problem._replace(plant=plant), values)
        if made is None:
            return float("inf")
        figures = play(made, rests(made.model, cases, setting.limits), cases, setting)[1]
        return float(costs(figures, setting.allowance).mean())

    own = cost(problem.plant)
    try:
        others = np.array([cost(plant) for plant in problem.family[1 : 1 + REDESIGNS]])
    except ValueError:  # a plant of the spread that no controller can be designed for
        return float("inf")
    return float(np.maximum(others / own - 1.0, 0.0).mean())
