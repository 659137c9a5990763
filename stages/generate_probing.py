"""The next experiment: writes datasets/generate_probing/next_experiment.csv, what to play on the machine
next."""

from pipeline.store import artifacts, params
from pipeline.temperature.workflow import generate_probing
from pipeline.temperature.workflow.settings import GenerateProbing, Plant, check_output_limits


def main() -> None:
    with artifacts.stage("generate_probing") as out:
        settings, machine = params.load(GenerateProbing, "generate_probing"), params.load(Plant, "plant")
        check_output_limits(machine, settings.source)
        result = generate_probing.planned(settings, machine)
        artifacts.write_csv(out / "next_experiment.csv", result.columns)
        artifacts.write_metrics("generate_probing", result.metrics)


if __name__ == "__main__":
    main()
