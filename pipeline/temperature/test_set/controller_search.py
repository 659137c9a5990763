"""The search for the parameters of one controller. Every controller has the same search, budget and cost, on
the same training half of the panel, as it would be deployed."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.temperature.controllers import table
from pipeline.temperature.controllers.law import Rest
from pipeline.temperature.controllers.problem import Design, DesignProblem, weights
from pipeline.temperature.settings import TuneWeights
from pipeline.temperature.test_set import panel, scorecard, tuning
from pipeline.temperature.test_set.panel import CaseConditions, play

# share of a parameter's range, in logarithms: a result this near to an end lies at a bound
AT_BOUND = 0.02
# share of the cost added for a parameter that is its whole range away from its start: of two equally good
# candidates the one nearer to the start is taken, so that the result is unique where the cost is flat
NEARER = 0.05
# share of the candidates, the last ones, for a pattern search from the best: without it two seeds end 6 %
# apart
POLISHED = 1 / 3


def search(
    name: str, settings: TuneWeights, problem: DesignProblem, setting: CaseConditions
) -> tuple[str, tuning.SearchResult | str]:
    """Returns the name of a controller and the result of its search. Instead of a result, returns a sentence
    if it cannot be designed or every candidate fails, and an empty one if the record does not allow it."""
    controller = table.BY_NAME[name]
    low, start, high = table.bounds(controller, problem)
    # a kernel may have no minimum at the start, but one with a larger weight on inputs
    for theta in (start, np.sqrt(start * high), high):
        try:
            design = controller.design(problem, table.parameters(controller, theta))
            break
        except ValueError as reason:
            refusal = str(reason)
    else:
        return name, refusal
    if design is None:
        return name, ""
    rests = panel.rests(design.model, setting.rehearsal.training, setting.limits)

    def cost(theta: np.ndarray) -> float:
        candidate = controller.design(problem, table.parameters(controller, theta))
        if candidate is None:
            raise ValueError("the record does not allow this candidate")
        far = np.log(theta / start) / np.log(high / low)
        return _cost(candidate, rests, settings, setting) * (1 + NEARER * float(far @ far))

    value, reason = tuning.evaluate(cost, start)
    first = tuning.History(start[None], np.array([value]), (reason,), np.array([value]))
    initial, evaluations = settings.practical_initial, settings.practical_evaluations
    last = min(round(POLISHED * evaluations), evaluations - initial)
    try:
        result = tuning.minimise(
            cost,
            low,
            high,
            initial=initial,
            evaluations=evaluations - last,
            rng=np.random.default_rng(settings.seed),
            start=first,
        )
        return name, tuning.polished(cost, result, low, high, evaluations=last)
    except ValueError as failure:  # every candidate failed; other controllers continue
        return name, str(failure)


def _cost(design: Design, rests: Sequence[Rest], settings: TuneWeights, setting: CaseConditions) -> float:
    """Returns the declared cost of a candidate. Raises ValueError if one of its margins, at the 10 % quantile
    over the training plants, is below the least allowed. Better figures in simulation do not justify less
    robustness."""
    training = setting.rehearsal.training
    margins = scorecard.margins(training.plants, design.law, grid=80)
    disk, delay_s = (
        float(np.quantile([getattr(one, key) for one in margins], 0.1, method="nearest"))
        for key in ("disk", "delay_s")
    )
    least_delay_s = setting.faster * settings.least_delay_margin_s
    if not (disk >= settings.least_disk_margin and delay_s >= least_delay_s):
        raise ValueError(
            f"on the weakest tenth of plants the disk margin is {disk:.2f} and the delay margin "
            f"{delay_s:.2f} s, where {settings.least_disk_margin:g} and {least_delay_s:g} s are the least"
        )
    figures = play(design, rests, training, setting)[1]
    costs = panel.costs(figures, setting.allowance)
    return scorecard.mean_and_worst(costs, training.plant, weight=settings.worst_case)


def tuned_values(name: str, result: tuning.SearchResult, problem: DesignProblem) -> dict[str, Any]:
    """Returns the parameters by name, the weights that follow from them, the cost, and which parameters lie
    at a bound."""
    controller = table.BY_NAME[name]
    low, _, high = table.bounds(controller, problem)
    share = np.log(result.theta / low) / np.log(high / low)
    values: dict[str, Any] = table.parameters(controller, result.theta.tolist())
    names = list(values)
    if "effort_weight" in values:
        values["q"], values["r"] = (weight.tolist() for weight in weights(problem, values))
    return values | {
        "cost": result.cost,
        "cost_at_start": None if np.isnan(result.history.cost[0]) else float(result.history.cost[0]),
        "failed": int(np.isnan(result.history.cost).sum()),
        "evaluations": len(result.history.cost),
        "at_bound": [
            key for key, place in zip(names, share, strict=True) if not AT_BOUND < place < 1 - AT_BOUND
        ],
    }
