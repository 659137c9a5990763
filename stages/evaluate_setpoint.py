"""Agents and classifier -> who sets flow and temperature: reads datasets/train_classifier and datasets/train_agent; writes datasets/evaluate_setpoint: scoreboard.parquet,
paths.parquet of one run from each start, decisions.parquet of two episodes through pixels, and choice.json, the default with its worst case."""

from pipeline import artifacts, classifying, deciding, params, seeing, setpoint_schemas, teaching
from pipeline.deciding import EvaluateSetpoint
from pipeline.seeing import TrainClassifier


def main() -> None:
    with artifacts.stage("evaluate_setpoint") as out:
        p, view = params.load(EvaluateSetpoint, "evaluate_setpoint"), params.load(TrainClassifier, "train_classifier")
        known = classifying.restore("datasets/train_classifier/weights.safetensors", "datasets/train_classifier/calibration.parquet")
        tables = seeing.window_tables(artifacts.read_table("datasets/train_classifier/windows.parquet", setpoint_schemas.WINDOWS))
        seats = deciding.seats(p.baselines, teaching.restore("datasets/train_agent/weights.safetensors"), tables["learn"])
        scores = deciding.scores(seats, tables["judge"], p)
        choice = deciding.chosen(scores)
        pixels = deciding.pixel_runs(seats, choice, known, p, view)
        artifacts.write_table(out / "scoreboard.parquet", setpoint_schemas.SCOREBOARD, deciding.scoreboard(seats, scores, pixels))
        artifacts.write_table(out / "paths.parquet", setpoint_schemas.PATHS, deciding.paths(seats, tables["judge"], p, pixels))
        artifacts.write_table(out / "decisions.parquet", setpoint_schemas.DECISIONS, deciding.decisions(choice.name, pixels))
        artifacts.write_json(out / "choice.json", choice)
        artifacts.write_metrics("evaluate_setpoint", deciding.metrics(seats, scores, choice, pixels))


if __name__ == "__main__":
    main()
