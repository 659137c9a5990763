"""Practical tuning of the model-based controller: the declared engineering cost of its weights, and what each
candidate trades, error for effort."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pipeline.temperature.judging import Deployment, Limits, targets
from pipeline.temperature.plant import Plant
from pipeline.temperature.scorecard import (
    Figures,
    Panel,
    Yardstick,
    cost,
    feed_forward,
    figures,
    margins,
    optimum,
    optimum_run,
    regret,
    simulate,
)
from pipeline.temperature.tracking import Controller, model_based
from pipeline.temperature.tuning import Result


class ErrorEffort(NamedTuple):
    """Of a candidate: r.m.s. tracking error in °C and r.m.s. effort in percent, means over the scenarios."""

    tracking_degC: float
    effort_percent: float


def deployed(
    plant: Plant, scenarios: Panel, deployment: Deployment, *, gamma: float, least_disk_margin: float
) -> Callable[[np.ndarray], Figures]:
    """The figures of theta = [q; r; tau]: weights and observer of the
    model's controller, as deployed on the training panel.

    A candidate whose disk margin on its own model is below `least_disk_margin` fails (ValueError): figures in
    simulation are no reason to give robustness away.
    """
    limits, band, integral, integral_limit = deployment
    aims, p, m = targets(plant, scenarios.r, limits), plant.p, plant.m

    def run(theta: np.ndarray) -> Figures:
        law = model_based(plant, gamma, tau=theta[-1]).design(theta[:p], theta[p : p + m], integral)
        disk = margins([plant], law, grid=80)[0].disk
        if disk < least_disk_margin:
            raise ValueError(f"the disk margin is {disk:.2f}, below the least of {least_disk_margin:.2f}")
        rollout = simulate(
            scenarios, law, feed_forward(scenarios, law, aims), limits=limits, integral_band=integral_limit
        )
        return figures(scenarios, rollout, limits=limits, band=band, sample_time_s=plant.sample_time_s)

    return run


def error_effort_of(results: Figures) -> ErrorEffort:
    return ErrorEffort(float(results.tracking_degC.mean()), float(results.effort_percent.mean()))


def optimum_error_effort(
    scenarios: Panel, yardstick: Yardstick, *, limits: Limits, band: float
) -> ErrorEffort:
    """Of the Riccati law of each scenario's own plant, told the state and left
    unclipped: what no controller undercuts on the yardstick."""
    return error_effort_of(
        figures(
            scenarios,
            optimum_run(scenarios, yardstick),
            limits=limits,
            band=band,
            sample_time_s=scenarios.plants[0].sample_time_s,
        )
    )


def value_or_none(function: Callable[[np.ndarray], object], theta: np.ndarray):
    """What theta gives, None where it fails: default weights may fail on somebody
    else's plant, and the search is not lost for that."""
    try:
        return function(theta)
    except ValueError:
        return None


def yardstick_regret(
    controller: Controller, scenarios: Panel, yardstick: Yardstick, q: np.ndarray, r: np.ndarray
) -> float:
    """What weights q, r cost on the common yardstick: median regret, unclipped,
    on the quietest scenarios of the nominal plant."""
    law = controller.design(q, r, 0.0)
    regrets = regret(
        cost(scenarios, simulate(scenarios, law, feed_forward(scenarios, law, None), limits=None), yardstick),
        optimum(scenarios, yardstick),
    )
    return float(np.median(regrets[(scenarios.plant == 0) & (scenarios.noise == scenarios.noise.min())]))


def histories(
    results: Mapping[str, Result], trades: Mapping[str, Sequence[ErrorEffort | None]]
) -> dict[str, list | np.ndarray]:
    """The candidates of several searches as columns, one row a candidate; `trades` as
    many a search, None for a candidate that failed."""
    of = {mode: result.history for mode, result in results.items()}
    traded = np.array(
        [[np.nan] * 2 if one is None else one for mode in of for one in trades[mode]], float
    ).reshape(-1, 2)
    return {
        "mode": [mode for mode, history in of.items() for _ in history.cost],
        "evaluation": [k + 1 for history in of.values() for k in range(len(history.cost))],
        "cost": np.concatenate([history.cost for history in of.values()]),
        "incumbent": np.concatenate([history.incumbent for history in of.values()]),
        "tracking_degC": traded[:, 0],
        "effort_percent": traded[:, 1],
        "chosen": np.concatenate(
            [(result.history.theta == result.theta).all(axis=1) for result in results.values()]
        ),
        "failure": [reason for history in of.values() for reason in history.failed],
    }
