"""Tune Q and R by Bayesian optimisation: reads datasets/identify_plant/plant.parquet; writes
datasets/tune_weights/weights.json and history.parquet. No data stage is touched by new weights."""

from pipeline.store import artifacts, params
from pipeline.temperature import plant
from pipeline.temperature.workflow import tables, tune_weights
from pipeline.temperature.workflow.settings import Panel, Plant, Tracking, TuneWeights


def main() -> None:
    with artifacts.stage("tune_weights") as out:
        settings, machine = params.load(TuneWeights, "tune_weights"), params.load(Plant, "plant")
        tracking, panel = params.load(Tracking, "tracking"), params.load(Panel, "panel")
        shapes = {"D": (None, len(machine.outputs), len(machine.inputs))}
        arrays = artifacts.read_arrays("datasets/identify_plant/plant.parquet", "plant", 1, shapes=shapes)
        model = plant.restored(arrays)[0]
        tuned = tune_weights.tuned(settings, machine, tracking, panel, model)
        artifacts.write_json(out / "weights.json", tuned.weights)
        artifacts.write_table(out / "history.parquet", tables.TUNING, tuned.history)
        artifacts.write_learning_curve(
            out / "live", tuned.history, of="mode", step="evaluation", figures=("cost", "incumbent")
        )
        artifacts.write_metrics("tune_weights", tuned.metrics)


if __name__ == "__main__":
    main()
