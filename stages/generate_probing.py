"""The next experiment: reads datasets/identify_plant and datasets/ingest/record.parquet; writes
datasets/generate_probing: next_experiment.csv, what to play on the machine next, and
next_experiment_closed_loop.csv, what to add to its controller's commands. Either is left out where no
forecast holds it within the limits; forecast.json says why."""

import stages
from pipeline.store import artifacts, params
from pipeline.temperature import plant
from pipeline.temperature.workflow import generate_probing
from pipeline.temperature.workflow.settings import GenerateProbing, Plant, Tracking, check_output_limits


def main() -> None:
    with artifacts.stage("generate_probing") as out:
        settings, machine = params.load(GenerateProbing, "generate_probing"), params.load(Plant, "plant")
        tracking = params.load(Tracking, "tracking")
        check_output_limits(machine, settings.source)
        shapes = {"D": (None, len(machine.outputs), len(machine.inputs))}
        plants = plant.restored(
            artifacts.read_arrays("datasets/identify_plant/plant.parquet", "plant", 1, shapes=shapes)
        ) + plant.restored(
            artifacts.read_arrays("datasets/identify_plant/spread.parquet", "spread", 1, shapes=shapes)
        )
        result = generate_probing.designed(
            settings, machine, tracking, plants, "datasets/ingest/record.parquet"
        )
        if result.commands:
            artifacts.write_csv(out / "next_experiment.csv", result.commands)
        if result.dither:
            artifacts.write_csv(out / "next_experiment_closed_loop.csv", result.dither)
        artifacts.write_json(out / "forecast.json", result.metrics)
        artifacts.write_metrics("generate_probing", result.metrics)


if __name__ == "__main__":
    stages.run(main, "generate_probing", loop="temperature")
