"""What tune_weights does: it tunes every contestant by itself, with the same search, budget and cost, on the
same training half of the panel, as it would be deployed."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from joblib import delayed
from tqdm import tqdm

from pipeline.store.execution import run_all
from pipeline.store.params import Execution
from pipeline.temperature.controllers import controller
from pipeline.temperature.test_set import comparison, panel, scorecard, tuning
from pipeline.temperature.workflow import contestants
from pipeline.temperature.workflow.cases import Setting, played
from pipeline.temperature.workflow.settings import TuneWeights

# of a parameter's range, in logarithms: so near to an end the search is called bound by it
AT_BOUND = 0.02
# of the cost, for a parameter moved from its start by its whole range: of two candidates as good as each
# other the one nearer to the start is taken, so that a direction in which the cost is flat has one end
NEARER = 0.05
# of the candidates, the last, by a pattern search from the best: without it two seeds end 6 % apart
POLISHED = 1 / 3


class Tuned(NamedTuple):
    """The parameters of every contestant, the candidates as columns, metrics, and why others are refused."""

    weights: dict[str, Any]
    history: dict[str, Any]
    metrics: dict[str, Any]


def tuned(
    settings: TuneWeights, problem: contestants.Problem, setting: Setting, execution: Execution
) -> Tuned:
    """Every contestant with something to tune; one that cannot be designed at its start is refused."""
    searched = [one for one in contestants.CONTESTANTS if one.parameters]
    calls = [delayed(_searched)(one.name, settings, problem, setting) for one in searched]
    results = dict(
        tqdm(run_all(calls, execution), total=len(calls), desc="tune_weights: contestants", mininterval=2)
    )
    found = {name: result for name, result in results.items() if isinstance(result, tuning.Result)}
    refused = {name: result for name, result in results.items() if isinstance(result, str)}
    if not found:
        raise ValueError(
            "tune_weights: expected a controller that can be designed, found none: "
            + "; ".join(f"{name}: {reason}" for name, reason in refused.items())
            + "; record the machine longer, or change its inputs in section plant of params.yaml"
        )
    best = {name: _values(name, result, problem) for name, result in found.items()}
    return Tuned(
        {
            "design": {"horizon_steps": problem.horizon, "noise_degC": problem.noise.tolist()},
            "contestants": best,
        },
        _history(found, problem),
        {
            "contestants": {
                name: {key: value for key, value in one.items() if key not in ("q", "r")}
                for name, one in best.items()
            },
            "refused": {name: reason for name, reason in refused.items() if reason},
        },
    )


def _searched(
    name: str, settings: TuneWeights, problem: contestants.Problem, setting: Setting
) -> tuple[str, tuning.Result | str]:
    """One search; a sentence where the contestant cannot be designed, empty where the record has it not."""
    contestant = contestants.BY_NAME[name]
    low, start, high = bounds(contestant, problem)
    try:
        design = contestant.design(problem, dict(zip(_names(contestant), start, strict=True)))
    except ValueError as reason:
        return name, str(reason)
    if design is None:
        return name, ""
    rests = panel.rests(design.model, setting.rehearsal.training, setting.limits)

    def cost(theta: np.ndarray) -> float:
        made = contestant.design(problem, dict(zip(_names(contestant), theta, strict=True)))
        far = np.log(theta / start) / np.log(high / low)
        return _cost(made, rests, settings, setting) * (1 + NEARER * float(far @ far))

    first = tuning.History(start[None], *_first(cost, start))
    initial, evaluations = settings.practical_initial, settings.practical_evaluations
    last = min(round(POLISHED * evaluations), evaluations - initial)
    try:
        found = tuning.minimise(
            cost,
            low,
            high,
            tuning.SearchSettings(initial, evaluations - last),
            rng=np.random.default_rng(settings.seed),
            start=first,
        )
        return name, tuning.polished(cost, found, low, high, evaluations=last)
    except ValueError as reason:  # every candidate failed: the others go on
        return name, str(reason)


def _first(cost, start: np.ndarray) -> tuple[np.ndarray, tuple[str, ...], np.ndarray]:
    """The declared start as the first candidate."""
    try:
        value, reason = cost(start), ""
    except ValueError as failure:
        value, reason = np.nan, str(failure)
    return np.array([value]), (reason,), np.array([value])


def _cost(
    design: contestants.Design, rests: Sequence[controller.Rest], settings: TuneWeights, setting: Setting
) -> float:
    """The declared cost of a candidate. Raises ValueError where its margins on the identified plant, its
    inputs a sample late, are below the least: figures in simulation are no reason to give robustness away."""
    margin = scorecard.margins([setting.late], design.law, grid=80)[0]
    least_delay_s = setting.faster * settings.least_delay_margin_s
    if not (margin.disk >= settings.least_disk_margin and margin.delay_s >= least_delay_s):
        raise ValueError(
            f"on the identified plant, its inputs a sample late, the disk margin is {margin.disk:.2f} and "
            f"the delay margin {margin.delay_s:.2f} s, where {settings.least_disk_margin:g} and "
            f"{least_delay_s:g} s are the least"
        )
    training = setting.rehearsal.training
    figures = played(design, rests, training, setting)[1]
    costs = panel.costs(figures, setting.allowance)
    return comparison.mean_and_worst(costs, training.plant, weight=settings.worst_case)


def _names(contestant: contestants.Contestant) -> list[str]:
    return [parameter.name for parameter in contestant.parameters]


def bounds(
    contestant: contestants.Contestant, problem: contestants.Problem
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lowest, start and highest of each parameter (d,)."""
    scale = [problem.effect if one.of_effect else 1.0 for one in contestant.parameters]
    table = np.array([(one.low, one.start, one.high) for one in contestant.parameters]).T * scale
    return table[0], table[1], table[2]


def _values(name: str, result: tuning.Result, problem: contestants.Problem) -> dict[str, Any]:
    """The parameters by name, the weights that they stand for, the cost, and which of them lie at a bound."""
    contestant = contestants.BY_NAME[name]
    low, _, high = bounds(contestant, problem)
    share = np.log(result.theta / low) / np.log(high / low)
    values = dict(zip(_names(contestant), result.theta.tolist(), strict=True))
    if "effort_weight" in values:
        values["q"], values["r"] = (weight.tolist() for weight in contestants.weights(problem, values))
    return values | {
        "cost": result.cost,
        "cost_at_start": None if np.isnan(result.history.cost[0]) else float(result.history.cost[0]),
        "failed": int(np.isnan(result.history.cost).sum()),
        "evaluations": len(result.history.cost),
        "at_bound": [
            key
            for key, place in zip(_names(contestant), share, strict=True)
            if not AT_BOUND < place < 1 - AT_BOUND
        ],
    }


def _history(results: Mapping[str, tuning.Result], problem: contestants.Problem) -> dict[str, Any]:
    """The candidates of all searches as columns, one row a candidate."""
    columns: dict[str, list] = {
        key: [] for key in ("contestant", "evaluation", "cost", "incumbent", "chosen", "failure", "values")
    }
    for name, result in results.items():
        history, names = result.history, _names(contestants.BY_NAME[name])
        for k, theta in enumerate(history.theta):
            columns["contestant"].append(name)
            columns["evaluation"].append(k + 1)
            columns["cost"].append(history.cost[k])
            columns["incumbent"].append(history.incumbent[k])
            columns["chosen"].append(bool((theta == result.theta).all()))
            columns["failure"].append(history.failed[k])
            columns["values"].append(
                ", ".join(f"{key} {value:.4g}" for key, value in zip(names, theta, strict=True))
            )
    return columns
