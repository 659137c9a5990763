"""What tune_weights does: Q and R by Bayesian optimisation of the declared engineering cost of the
identified plant on the training half of the panel."""

from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from pipeline.temperature import engineering, judging, plant, scorecard, tuning
from pipeline.temperature.tracking import model_based
from pipeline.temperature.workflow.settings import Panel, Tracking, TuneWeights
from pipeline.temperature.workflow.settings import Plant as Machine


class Tuned(NamedTuple):
    """The weights, the candidates of the search as columns, and metrics."""

    weights: dict[str, Any]
    history: dict[str, Any]
    metrics: dict[str, Any]


class Search(NamedTuple):
    """A search, error and effort of its candidates (None for one that failed), and metrics."""

    result: tuning.Result
    trades: list[engineering.ErrorEffort | None]
    metrics: dict[str, Any]


def tuned(
    settings: TuneWeights, machine: Machine, tracking: Tracking, panel: Panel, model: plant.Plant
) -> Tuned:
    """The search; `model` is the identified plant, its feed-through one sample late."""
    model = plant.strictly_proper(model)
    training, reference = panel.training, np.array([o.reference for o in machine.outputs])
    scenarios = scorecard.panel(
        plant.spread(model, input_gain=panel.input_gain, extra_heat_loss=panel.extra_heat_loss_per_step),
        starts=training.starts_degC,
        references=[reference + offset for offset in training.reference_offsets_degC],
        noise=panel.noise_degC,
        seeds=training.seeds,
        steps=panel.steps,
        hold=panel.hold_steps,
        cells=False,
    )
    practical = _practical(settings, machine, tracking, panel, model, scenarios)
    q, r, tau = np.split(practical.result.theta, [model.p, model.p + model.m])
    return Tuned(
        {"practical": {"q": q, "r": r, "observer_tau": float(tau[0])}},
        engineering.histories({"practical": practical.result}, {"practical": practical.trades}),
        {"practical": practical.metrics},
    )


def _practical(
    settings: TuneWeights,
    machine: Machine,
    tracking: Tracking,
    panel: Panel,
    model: plant.Plant,
    scenarios: scorecard.Panel,
) -> Search:
    limits = tuple(np.array([(i.low, i.high) for i in machine.inputs]).T)
    allowance = scorecard.Allowance(
        *(getattr(settings, f"allow_{name}") for name in scorecard.Allowance._fields[:-1]),
        settings.worst_case,
    )
    deployment = judging.Deployment(limits, panel.band_degC, tracking.integral, tracking.integral_limit_degC)
    figures_of = engineering.deployed(
        model, scenarios, deployment, gamma=tracking.gamma, least_disk_margin=settings.least_disk_margin
    )
    error_effort: dict[bytes, engineering.ErrorEffort] = {}

    def cost(theta: np.ndarray) -> float:
        result = figures_of(theta)
        value = scorecard.engineering_cost(
            result, scenarios.plant, allowance, longest_s=scenarios.steps * model.sample_time_s
        )
        error_effort[theta.tobytes()] = engineering.error_effort_of(result)
        return value

    low, high = _bounds(settings, model)
    result = _search(
        "practical", cost, settings, settings.practical_initial, settings.practical_evaluations, low, high
    )
    trades = [error_effort.get(theta.tobytes()) for theta in result.history.theta]
    default = np.array(
        [tracking.yardstick_q] * model.p + [tracking.yardstick_r] * model.m + [tracking.observer_tau]
    )
    yardstick = scorecard.Yardstick(*np.split(default[:-1], [model.p]), tracking.gamma)
    q, r, tau = np.split(result.theta, [model.p, model.p + model.m])
    observed = model_based(model, tracking.gamma, tau=float(tau[0]))
    default_cost = engineering.value_or_none(cost, default)
    metrics = {
        "cost": result.cost,
        "cost_default": default_cost,
        "regret_identity": engineering.yardstick_regret(observed, scenarios, yardstick, q, r),
        "failed": int(np.isnan(result.history.cost).sum()),
        "q": q,
        "r": r,
        "observer_tau": float(tau[0]),
        "trade": {
            "default": error_effort.get(default.tobytes()),
            "optimum": engineering.optimum_error_effort(
                scenarios, yardstick, limits=limits, band=panel.band_degC
            ),
        },
    }
    return Search(result, trades, metrics)


def _bounds(settings: TuneWeights, model: plant.Plant) -> tuple[list[float], list[float]]:
    """Lowest and highest [q; r; tau]."""
    low = [settings.q_low] * model.p + [settings.r_low] * model.m + [settings.tau_low]
    high = [settings.q_high] * model.p + [settings.r_high] * model.m + [settings.tau_high]
    return low, high


def _search(
    name: str,
    cost,
    settings: TuneWeights,
    initial: int,
    evaluations: int,
    low: list[float],
    high: list[float],
) -> tuning.Result:
    with tqdm(total=evaluations, desc=f"tune_weights: {name}", unit="candidate", mininterval=2) as bar:
        return tuning.minimise(
            cost,
            np.array(low),
            np.array(high),
            tuning.SearchSettings(initial, evaluations, settings.acquisition),
            rng=np.random.default_rng(settings.seed),
            on_step=lambda _: bar.update(),
        )
