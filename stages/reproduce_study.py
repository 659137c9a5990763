"""The study's own part on its simulated machine: reads datasets/published and no recording; writes
datasets/reproduce_study: study.parquet and parity.parquet."""

from pipeline.store import artifacts, params
from pipeline.temperature.workflow import reproduce_study, tables
from pipeline.temperature.workflow.settings import ReproduceStudy


def main() -> None:
    with artifacts.stage("reproduce_study") as out:
        settings = params.load(ReproduceStudy, "reproduce_study")
        execution = params.load(params.Execution, "execution")
        reproduce_study.check(settings)
        reproduced = reproduce_study.reproduced(settings, execution, "datasets/published")
        artifacts.write_table(out / "study.parquet", tables.STUDY, reproduced.study)
        artifacts.write_table(out / "parity.parquet", tables.PARITY, reproduced.parity)
        artifacts.write_metrics("reproduce_study", reproduced.metrics)


if __name__ == "__main__":
    main()
