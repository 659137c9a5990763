"""Tune every contestant by itself, by Bayesian optimisation: reads what identify_plant and learn_kernel
wrote; writes datasets/tune_weights/weights.json and history.parquet. No data stage is touched by new
weights."""

import stages
from pipeline.store import artifacts, params
from pipeline.temperature.workflow import learned, tables, tune_weights
from pipeline.temperature.workflow.settings import Panel, Plant, Tracking, TuneWeights


def main() -> None:
    with artifacts.stage("tune_weights") as out:
        settings, machine = params.load(TuneWeights, "tune_weights"), params.load(Plant, "plant")
        tracking, panel = params.load(Tracking, "tracking"), params.load(Panel, "panel")
        execution = params.load(params.Execution, "execution")
        simulated = params.value("generate_probing.source", one_of=("simulated", "recordings")) == "simulated"
        made = learned.read_learned(
            "datasets/identify_plant/plant.parquet",
            "datasets/identify_plant/spread.parquet",
            "datasets/learn_kernel",
            "datasets/ingest/printer_pid.json",
            machine,
        )
        record = "datasets/ingest/record.parquet"
        posed = learned.posed(made, machine, panel, tracking, settings, record, simulated=simulated)
        tuned = tune_weights.tuned(settings, posed.problem, posed.setting, execution)
        artifacts.write_json(out / "weights.json", tuned.weights)
        artifacts.write_table(out / "history.parquet", tables.TUNING, tuned.history)
        artifacts.write_learning_curve(
            out / "live", tuned.history, of="contestant", step="evaluation", figures=("cost", "incumbent")
        )
        artifacts.write_metrics("tune_weights", tuned.metrics)


if __name__ == "__main__":
    stages.run(main, "tune_weights", loop="temperature")
