"""Trials -> learned commands: reads datasets/raw/deposition where the source is recordings;
writes datasets/train_ilc: trials.parquet, lessons.parquet, filmed.parquet, models.json,
recordings of the first and the last trial, frames of these with the measured edges, and, for a
real machine, the command of the next one in next/."""

import stages
from pipeline.deposition.learning import training
from pipeline.deposition.workflow import train_ilc, trial_video
from pipeline.deposition.workflow.settings import Camera, Printer, TrainIlc
from pipeline.deposition.workflow.tables import FILMED, LESSONS, TRIALS
from pipeline.store import artifacts, params


def main() -> None:
    with artifacts.stage("train_ilc") as out:
        settings, printer, camera = (
            params.load(TrainIlc, "train_ilc"),
            params.load(Printer, "printer"),
            params.load(Camera, "camera"),
        )
        execution, recorded = params.load(params.Execution, "execution"), "datasets/raw/deposition"
        done = train_ilc.trained(settings, printer, camera, execution, recorded=recorded, out=out)
        artifacts.write_table(out / "trials.parquet", TRIALS, training.trial_rows(done.sequences))
        artifacts.write_table(out / "lessons.parquet", LESSONS, training.sample_rows(done.sequences))
        artifacts.write_table(out / "filmed.parquet", FILMED, trial_video.rows(done.measured))
        artifacts.write_json(out / "models.json", done.models)
        artifacts.write_json(
            out / "frames/frames.json",
            train_ilc.shown(settings, camera, execution, recorded=recorded, out=out),
        )
        artifacts.write_metrics("train_ilc", done.metrics)


if __name__ == "__main__":
    stages.run(main, "train_ilc", loop="deposition")
