"""Nozzle frames -> classifier of the flow: renders them, or reads datasets/raw/setpoint; writes datasets/train_classifier: weights.safetensors and calibration.parquet of the
vision transformer, classified.parquet and reliability.parquet of the frames it is judged on, course.parquet, windows.parquet for the simulator, and frames for the page."""

from pipeline import artifacts, classifying, params, seeing, setpoint_schemas
from pipeline.seeing import TrainClassifier


def main() -> None:
    with artifacts.stage("train_classifier") as out:
        p, execution = params.load(TrainClassifier, "train_classifier"), params.load(params.Execution, "execution")
        found, read = seeing.parts(p, "datasets/raw/setpoint", execution)
        networks = classifying.trained(p, found)
        done = classifying.judged(p, found, networks)
        tables = classifying.recorded(p, done.eyes, seeing.to_record(p, found, execution))
        classifying.store(out, p, done.eyes)
        artifacts.write_table(out / "classified.parquet", setpoint_schemas.CLASSIFIED, classifying.classified(done, found["judged"].flow))
        artifacts.write_table(out / "reliability.parquet", setpoint_schemas.RELIABILITY, classifying.reliability_rows(p, done))
        course = classifying.course_rows(networks)
        artifacts.write_table(out / "course.parquet", setpoint_schemas.COURSE, course)
        artifacts.write_course(out / "live", course, of="learner", step="epoch", figures=("training_loss", "held_out_loss", "held_out_accuracy"))
        artifacts.write_table(out / "windows.parquet", setpoint_schemas.WINDOWS, seeing.window_rows(tables))
        artifacts.write_json(out / "frames/frames.json", classifying.shown(p, done.eyes, out / "frames"))
        artifacts.write_metrics("train_classifier", classifying.metrics(p, done, networks, read))


if __name__ == "__main__":
    main()
