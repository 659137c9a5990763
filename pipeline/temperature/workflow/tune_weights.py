"""What tune_weights does: Q and R by Bayesian optimisation, twice. Parity: the
paper's (37) on its own machine. Practical: the declared engineering cost of the
identified plant on the training half of the panel."""

from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from pipeline.temperature import engineering, judging, plant, scorecard, study, tuning
from pipeline.temperature.workflow.settings import Panel, Tracking, TuneWeights
from pipeline.temperature.workflow.settings import Plant as Machine

# of the paper's machine
OUTPUTS, INPUTS = 5, 7


class Tuned(NamedTuple):
    """Weights of both modes, the candidates of both searches as columns, and metrics."""

    weights: dict[str, Any]
    history: dict[str, Any]
    metrics: dict[str, Any]


class Search(NamedTuple):
    """A search and what its candidates trade, None for one that failed; metrics of its mode."""

    found: tuning.Result
    trades: list[engineering.Trade | None]
    metrics: dict[str, Any]


def tuned(p: TuneWeights, machine: Machine, tracking: Tracking, panel: Panel, model: plant.Plant) -> Tuned:
    """Both searches; `model` is the identified plant."""
    scenarios = scorecard.panel(
        plant.spread(model, input_gain=panel.input_gain, loss=panel.loss), starts=panel.training.starts_degC,
        references=[np.array([o.reference for o in machine.outputs]) + offset for offset in panel.training.reference_offsets_degC],
        noise=panel.noise_degC, seeds=panel.training.seeds, steps=panel.steps, hold=panel.hold_steps,
        cells=False,
    )  # fmt: skip
    parity = _parity(p)
    practical = _practical(p, machine, tracking, panel, model, scenarios)
    q, r, tau = np.split(practical.found.theta, [model.p, model.p + model.m])
    theta = parity.found.theta
    return Tuned(
        {
            "practical": {"q": q, "r": r, "observer_tau": float(tau[0])},
            "parity": {"q": theta[:OUTPUTS], "r": theta[OUTPUTS:]},
        },
        engineering.histories(
            {"parity": parity.found, "practical": practical.found},
            {"parity": parity.trades, "practical": practical.trades},
        ),
        {"parity": parity.metrics, "practical": practical.metrics},
    )


def _parity(p: TuneWeights) -> Search:
    low, high = ([q] * OUTPUTS + [r] * INPUTS for q, r in ((p.q_low, p.r_low), (p.q_high, p.r_high)))
    found = _search("parity", study.tuning_objective, p, p.initial, p.evaluations, low, high)
    trades = [
        None if failed else engineering.Trade(*study.tuning_parts(theta))
        for theta, failed in zip(found.history.theta, found.history.failed, strict=True)
    ]
    optimum = np.ones(OUTPUTS + INPUTS)
    metrics = {
        "best_cost_perfect_state": found.cost, "optimum": study.tuning_objective(optimum),
        "scaled_weights": study.scaled_weights(),
        "trade": {"optimum": engineering.Trade(*study.tuning_parts(optimum))},
    }  # fmt: skip
    return Search(found, trades, metrics)


def _practical(
    p: TuneWeights,
    machine: Machine,
    tracking: Tracking,
    panel: Panel,
    model: plant.Plant,
    scenarios: scorecard.Panel,
) -> Search:
    limits = tuple(np.array([(i.low, i.high) for i in machine.inputs]).T)
    allowance = scorecard.Allowance(
        *(getattr(p, f"allow_{name}") for name in scorecard.Allowance._fields[:-1]), p.worst_case
    )
    run = engineering.deployed(
        model, scenarios, gamma=tracking.gamma, limits=limits, band=panel.band_degC,
        integral=tracking.integral,
        integral_limit=tracking.integral_limit_degC, least_disk_margin=p.least_disk_margin,
    )  # fmt: skip
    traded: dict[bytes, engineering.Trade] = {}

    def cost(theta: np.ndarray) -> float:
        found = run(theta)
        value = scorecard.engineering_cost(
            found, scenarios.plant, allowance, longest_s=scenarios.steps * model.sample_time_s
        )
        traded[theta.tobytes()] = engineering.trade(found)
        return value

    low, high = (
        [q] * model.p + [r] * model.m + [tau]
        for q, r, tau in ((p.q_low, p.r_low, p.tau_low), (p.q_high, p.r_high, p.tau_high))
    )
    found = _search("practical", cost, p, p.practical_initial, p.practical_evaluations, low, high)
    trades = [traded.get(theta.tobytes()) for theta in found.history.theta]
    default = np.array(
        [tracking.yardstick_q] * model.p + [tracking.yardstick_r] * model.m + [tracking.observer_tau]
    )
    yardstick = scorecard.Yardstick(*np.split(default[:-1], [model.p]), tracking.gamma)
    q, r, tau = np.split(found.theta, [model.p, model.p + model.m])
    observed = judging.model_based(model, tracking.gamma, tau=float(tau[0]))
    default_cost = engineering.found_or_none(cost, default)
    metrics = {
        "cost": found.cost, "cost_default": default_cost,
        "regret_identity": engineering.yardstick_regret(observed, scenarios, yardstick, q, r),
        "failed": int(np.isnan(found.history.cost).sum()), "q": q, "r": r, "observer_tau": float(tau[0]),
        "trade": {
            "default": traded.get(default.tobytes()),
            "optimum": engineering.optimum_trade(scenarios, yardstick, limits=limits, band=panel.band_degC),
        },
    }  # fmt: skip
    return Search(found, trades, metrics)


def _search(
    name: str, cost, p: TuneWeights, initial: int, evaluations: int, low: list[float], high: list[float]
) -> tuning.Result:
    with tqdm(total=evaluations, desc=f"tune_weights: {name}", unit="candidate", mininterval=2) as bar:
        rng, sizes = np.random.default_rng(p.seed), {"initial": initial, "evaluations": evaluations}
        return tuning.minimise(
            cost,
            np.array(low),
            np.array(high),
            rng=rng,
            acquisition=p.acquisition,
            on_step=lambda _: bar.update(),
            **sizes,
        )
