"""Tune Q and R by Bayesian optimisation: reads datasets/identify_plant/plant.parquet; writes datasets/tune_weights/weights.json and history.parquet.

Parity mode: the paper's (37) on its own machine. Practical mode: the declared engineering cost of the identified plant on the training half of the panel. No data
stage is touched by new weights."""

from typing import Literal

import numpy as np
from pydantic import Field
from tqdm import tqdm

from pipeline import artifacts, params, schemas
from pipeline.temperature import engineering, judging, plant, scorecard, study, tuning


class TuneWeights(params.Section):
    seed: int = Field(ge=0, le=2**31)
    initial: int = Field(ge=4, le=5000)
    evaluations: int = Field(ge=8, le=5000)
    practical_initial: int = Field(ge=4, le=5000)
    practical_evaluations: int = Field(ge=8, le=5000)
    acquisition: Literal["expected_improvement", "upper_confidence_bound"]
    q_low: float = Field(gt=0, le=1e6)
    q_high: float = Field(gt=0, le=1e6)
    r_low: float = Field(gt=0, le=1e6)
    r_high: float = Field(gt=0, le=1e6)
    tau_low: float = Field(gt=0, le=1e6)
    tau_high: float = Field(gt=0, le=1e6)
    allow_settling_s: float = Field(gt=0, le=1e6)
    allow_overshoot_degC: float = Field(gt=0, le=1000)
    allow_settled_error_degC: float = Field(gt=0, le=1000)
    allow_at_limits_percent: float = Field(gt=0, le=100)
    allow_effort_percent: float = Field(gt=0, le=100)
    worst_case: float = Field(ge=0, le=1000)
    least_disk_margin: float = Field(ge=0, le=2)


def main() -> None:
    with artifacts.stage("tune_weights") as out:
        p, machine, tracking = (
            params.load(TuneWeights, "tune_weights"),
            params.load(params.Plant, "plant"),
            params.load(params.Tracking, "tracking"),
        )
        declared = params.load(params.Panel, "panel")
        reference, limits = np.array([o.reference for o in machine.outputs]), tuple(np.array([(i.low, i.high) for i in machine.inputs]).T)
        model = plant.restored(artifacts.read_arrays("datasets/identify_plant/plant.parquet", "plant", 1))[0]
        scenarios = scorecard.panel(
            plant.spread(model, input_gain=declared.input_gain, loss=declared.loss), starts=declared.training.starts_degC,
            references=[reference + offset for offset in declared.training.reference_offsets_degC], noise=declared.noise_degC, seeds=declared.training.seeds,
            steps=declared.steps, hold=declared.hold_steps, cells=False,
        )  # fmt: skip
        allowance = scorecard.Allowance(*(getattr(p, f"allow_{name}") for name in scorecard.Allowance._fields[:-1]), p.worst_case)
        settings = {
            "gamma": tracking.gamma,
            "limits": limits,
            "band": declared.band_degC,
            "integral": tracking.integral,
            "integral_limit": tracking.integral_limit_degC,
        }
        run, traded = engineering.deployed(model, scenarios, least_disk_margin=p.least_disk_margin, **settings), {}

        def practical_cost(theta: np.ndarray) -> float:
            found = run(theta)
            cost = scorecard.engineering_cost(found, scenarios.plant, allowance, longest_s=scenarios.steps * model.sample_time_s)
            traded[theta.tobytes()] = engineering.trade(found)
            return cost

        parity = _search(
            "parity", study.tuning_objective, p, p.initial, p.evaluations, [p.q_low] * 5 + [p.r_low] * 7, [p.q_high] * 5 + [p.r_high] * 7
        )
        practical = _search(
            "practical",
            practical_cost,
            p,
            p.practical_initial,
            p.practical_evaluations,
            *([q] * model.p + [r] * model.m + [tau] for q, r, tau in ((p.q_low, p.r_low, p.tau_low), (p.q_high, p.r_high, p.tau_high))),
        )
        default = np.array([tracking.yardstick_q] * model.p + [tracking.yardstick_r] * model.m + [tracking.observer_tau])
        q, r, tau = np.split(practical.theta, [model.p, model.p + model.m])
        yardstick = scorecard.Yardstick(*np.split(default[:-1], [model.p]), tracking.gamma)
        tuned = judging.model_based(model, tracking.gamma, tau=float(tau[0]))
        artifacts.write_json(
            out / "weights.json",
            {"practical": {"q": q, "r": r, "observer_tau": float(tau[0])}, "parity": {"q": parity.theta[:5], "r": parity.theta[5:]}},
        )
        searches = {"parity": parity, "practical": practical}
        trades = {
            "parity": [None if failed else engineering.Trade(*study.tuning_parts(theta)) for theta, failed in zip(parity.history.theta, parity.history.failed, strict=True)],
            "practical": [traded.get(theta.tobytes()) for theta in practical.history.theta],
        }  # fmt: skip
        history = engineering.histories(searches, trades)
        artifacts.write_table(out / "history.parquet", schemas.TUNING, history)
        artifacts.write_course(out / "live", history, of="mode", step="evaluation", figures=("cost", "incumbent"))
        default_cost = engineering.found_or_none(practical_cost, default)
        metrics = {
            "parity": {
                "best_cost_perfect_state": parity.cost, "optimum": study.tuning_objective(np.ones(12)), "scaled_weights": study.scaled_weights(),
                "trade": {"optimum": engineering.Trade(*study.tuning_parts(np.ones(12)))},
            },
            "practical": {
                "cost": practical.cost, "cost_default": default_cost, "regret_identity": engineering.yardstick_regret(tuned, scenarios, yardstick, q, r),
                "failed": int(np.isnan(practical.history.cost).sum()), "q": q, "r": r, "observer_tau": float(tau[0]),
                "trade": {"default": traded.get(default.tobytes()), "optimum": engineering.optimum_trade(scenarios, yardstick, limits=limits, band=declared.band_degC)},
            },
        }  # fmt: skip
        artifacts.write_metrics("tune_weights", metrics)


def _search(name: str, cost, p: TuneWeights, initial: int, evaluations: int, low: list[float], high: list[float]) -> tuning.Result:
    with tqdm(total=evaluations, desc=f"tune_weights: {name}", unit="candidate", mininterval=2) as bar:
        rng, sizes = np.random.default_rng(p.seed), {"initial": initial, "evaluations": evaluations}
        return tuning.minimise(
            cost, np.array(low), np.array(high), rng=rng, acquisition=p.acquisition, on_step=lambda _: bar.update(), **sizes
        )


if __name__ == "__main__":
    main()
