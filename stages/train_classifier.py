"""Nozzle frames -> classifier of the flow: renders them, or reads datasets/raw/setpoint; writes
datasets/train_classifier: weights.safetensors and calibration.parquet of the vision transformer,
classified.parquet and reliability.parquet of the frames it is judged on, course.parquet, windows.parquet for
the simulator, and frames for the page."""

from pipeline.setpoint.workflow import parts, train_classifier
from pipeline.setpoint.workflow.classifier_files import store_classifier
from pipeline.setpoint.workflow.settings import TrainClassifier
from pipeline.setpoint.workflow.tables import CLASSIFIED, COURSE, RELIABILITY, WINDOWS
from pipeline.setpoint.workflow.windows import window_rows
from pipeline.store import artifacts, params


def main() -> None:
    with artifacts.stage("train_classifier") as out:
        p, execution = (
            params.load(TrainClassifier, "train_classifier"),
            params.load(params.Execution, "execution"),
        )
        found, read = parts.parts(p, "datasets/raw/setpoint", execution)
        networks = train_classifier.trained(p, found)
        done = train_classifier.judged(p, found, networks)
        tables = train_classifier.recorded(p, done.eyes, parts.to_record(p, found, execution))
        store_classifier(out, p, done.eyes)
        artifacts.write_table(
            out / "classified.parquet", CLASSIFIED, train_classifier.classified(done, found["judged"].flow)
        )
        artifacts.write_table(
            out / "reliability.parquet", RELIABILITY, train_classifier.reliability_rows(p, done)
        )
        course = train_classifier.course_rows(networks)
        artifacts.write_table(out / "course.parquet", COURSE, course)
        artifacts.write_course(
            out / "live",
            course,
            of="learner",
            step="epoch",
            figures=("training_loss", "held_out_loss", "held_out_accuracy"),
        )
        artifacts.write_table(out / "windows.parquet", WINDOWS, window_rows(tables))
        artifacts.write_json(out / "frames/frames.json", train_classifier.shown(p, done.eyes, out / "frames"))
        artifacts.write_metrics("train_classifier", train_classifier.metrics(p, done, networks, read))


if __name__ == "__main__":
    main()
