"""Learn controllers from the record alone: reads datasets/ingest/record.parquet; writes
datasets/learn_kernel/window.parquet and, where the record determines it, kernel.parquet: what the data say
whatever the weights, so that new weights need no pass over the data."""

import stages
from pipeline.store import artifacts, params
from pipeline.temperature.controllers import window
from pipeline.temperature.workflow import learn_kernel
from pipeline.temperature.workflow.settings import LearnKernel, Panel, Plant, Tracking


def main() -> None:
    with artifacts.stage("learn_kernel") as out:
        settings, machine = params.load(LearnKernel, "learn_kernel"), params.load(Plant, "plant")
        tracking, panel = params.load(Tracking, "tracking"), params.load(Panel, "panel")
        simulated = params.value("generate_probing.source", one_of=("simulated", "recordings")) == "simulated"
        learned = learn_kernel.learned(
            settings, machine, tracking, panel, "datasets/ingest/record.parquet", simulated=simulated
        )
        artifacts.write_arrays(out / "window.parquet", "window", 1, window.stored(learned.window))
        if learned.best.learned is not None:
            artifacts.write_arrays(out / "kernel.parquet", "kernel", 1, learned.best.learned.stored())
        artifacts.write_metrics("learn_kernel", learned.metrics)


if __name__ == "__main__":
    stages.run(main, "learn_kernel", loop="temperature")
