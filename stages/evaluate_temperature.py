"""Judge every temperature controller on one panel: reads what the temperature stages wrote and datasets/published; writes datasets/evaluate_temperature:
scorecard.parquet, trajectories.parquet, study.parquet and summary.json."""

import numpy as np
from joblib import delayed
from pydantic import Field
from tqdm import tqdm

from pipeline import artifacts, params, schemas
from pipeline.execution import run_all
from pipeline.temperature import judging, kernel, plant, published, scorecard, study, window


class EvaluateTemperature(params.Section):
    seed: int = Field(ge=0, le=2**31)
    data_sets: int = Field(ge=1, le=1000)
    report_noise_degC: float = Field(ge=0, le=50)


def main() -> None:
    with artifacts.stage("evaluate_temperature") as out:
        p, machine, tracking = (
            params.load(EvaluateTemperature, "evaluate_temperature"),
            params.load(params.Plant, "plant"),
            params.load(params.Tracking, "tracking"),
        )
        declared, execution = params.load(params.Panel, "panel"), params.load(params.Execution, "execution")
        simulated = params.value("generate_probing.source", one_of=("simulated", "recordings")) == "simulated"
        if p.report_noise_degC not in declared.noise_degC:
            raise ValueError(
                f"params.yaml: evaluate_temperature.report_noise_degC is {p.report_noise_degC:g} but must be one of panel.noise_degC {declared.noise_degC}; change one of the two"
            )
        reference, limits = np.array([o.reference for o in machine.outputs]), tuple(np.array([(i.low, i.high) for i in machine.inputs]).T)
        inputs, outputs = [i.name for i in machine.inputs], [o.name for o in machine.outputs]
        yardstick = scorecard.Yardstick(
            np.full(len(outputs), tracking.yardstick_q), np.full(len(inputs), tracking.yardstick_r), tracking.gamma
        )
        model = plant.restored(artifacts.read_arrays("datasets/identify_plant/plant.parquet", "plant", 1))[0]
        long = window.restored(artifacts.read_arrays("datasets/learn_kernel/window.parquet", "window", 1))
        has_kernel = artifacts.exists("datasets/learn_kernel/kernel.parquet")
        learned = kernel.restored(artifacts.read_arrays("datasets/learn_kernel/kernel.parquet", "kernel", 1)) if has_kernel else None
        weights = {name: np.array(w) for name, w in artifacts.read_json("datasets/tune_weights/weights.json")["practical"].items()}
        observers = {"tau": float(weights["observer_tau"]), "exact_tau": tracking.observer_tau}
        truth = plant.baam()._replace(sample_time_s=machine.sample_time_s) if simulated else None
        spread = plant.restored(artifacts.read_arrays("datasets/identify_plant/spread.parquet", "spread", 1))
        plants = plant.spread(truth, input_gain=declared.input_gain, loss=declared.loss) if simulated else spread
        scenarios = scorecard.panel(
            plants, starts=declared.judging.starts_degC, references=[reference + offset for offset in declared.judging.reference_offsets_degC],
            noise=declared.noise_degC, seeds=declared.judging.seeds, steps=declared.steps, hold=declared.hold_steps, cells=simulated,
        )  # fmt: skip
        compared = judging.controllers(
            model, long, learned, limits=limits, gamma=tracking.gamma, **observers, horizon=declared.steps, truth=truth
        )
        settings = {
            "limits": limits,
            "band": declared.band_degC,
            "integral": tracking.integral,
            "integral_limit": tracking.integral_limit_degC,
        }
        refused = judging.refusals(compared, [(yardstick.q, yardstick.r), (weights["q"], weights["r"])])
        kept = [c for c in compared if c.name not in refused]
        judged = [
            judging.judge(c, scenarios, yardstick=yardstick, q=weights["q"], r=weights["r"], **settings)
            for c in tqdm(kept, desc="evaluate_temperature: controllers", mininterval=2)
        ]
        summary = {j.name: judging.summary(j, scenarios, noise=p.report_noise_degC) for j in judged}
        K0, u, y = artifacts.read_published("datasets/published")
        sets_u, sets_y = study.data_sets(np.random.default_rng(p.seed), 15_000, p.data_sets)
        work = [(noise, i) for noise in study.NOISE for i in range(p.data_sets)]
        calls = [delayed(study.under_noise)(sets_u[:, i], sets_y[:, i], noise=noise, seed=i) for noise, i in work]
        found = list(tqdm(run_all(calls, execution), total=len(work), desc="evaluate_temperature: noisy data sets", mininterval=2))
        noisy, noise_free = study.rows(work, found), study.noise_free(u[1:], y[1:], np.random.default_rng(p.seed))
        figures = study.metrics(
            published.figures(K0, u, y), study.exact(), noise_free, noisy, failures=published.algorithm_1_failures(300), starts=300
        )
        shown = judging.trajectories(judged, scenarios, inputs, outputs, noise=p.report_noise_degC, yardstick=yardstick)
        artifacts.write_table(out / "scorecard.parquet", schemas.SCORECARD, judging.rows(judged, scenarios, outputs))
        artifacts.write_table(out / "trajectories.parquet", schemas.trajectories(machine.inputs, machine.outputs), shown)
        artifacts.write_table(out / "study.parquet", schemas.STUDY, noisy)
        artifacts.write_json(
            out / "summary.json",
            {"noise_degC": p.report_noise_degC, "scenarios": len(scenarios.r), "plants": len(plants), "controllers": summary},
        )
        artifacts.write_metrics("evaluate_temperature", figures | {"controllers": summary, "refused": refused})


if __name__ == "__main__":
    main()
