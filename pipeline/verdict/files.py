"""Reads the evidence of a run from the files of its stages."""

from collections.abc import Callable
from typing import Any

from pipeline.deposition.tables import PRINTS, SCORES
from pipeline.setpoint.tables import SCOREBOARD
from pipeline.store import artifacts, params
from pipeline.temperature.settings import Plant, recorded
from pipeline.temperature.tables import DYNAMICS, RESIDUALS
from pipeline.verdict.deposition import of_recorded_trials
from pipeline.verdict.evidence import OFF, Evidence, switched_off
from pipeline.verdict.settings import QUICK_LOOK, ReportRules
from pipeline.verdict.verdict import Missing, read_certificates

# stages whose figures the rules may ask for
FIGURES = {
    "ingest": "datasets/ingest/figures.json",
    "identify_plant": "datasets/identify_plant/figures.json",
    "learn_kernel": "datasets/learn_kernel/figures.json",
    "tune_weights": "datasets/tune_weights/figures.json",
    "evaluate_temperature": "datasets/evaluate_temperature/figures.json",
    "train_ilc": "datasets/train_ilc/figures.json",
    "segment_library": "datasets/segment_library/figures.json",
    "compose_parts": "datasets/compose_parts/figures.json",
    "train_classifier": "datasets/train_classifier/figures.json",
    "evaluate_setpoint": "datasets/evaluate_setpoint/figures.json",
}
TABLES = {
    "residuals": ("datasets/identify_plant/residuals.parquet", RESIDUALS),
    "dynamics": ("datasets/identify_plant/dynamics.parquet", DYNAMICS),
    "scores": ("datasets/compose_parts/scores.parquet", SCORES),
    "prints": ("datasets/compose_parts/prints.parquet", PRINTS),
    "conformance": ("datasets/compose_parts/conformance.json", None),
    "scoreboard": ("datasets/evaluate_setpoint/scoreboard.parquet", SCOREBOARD),
    "choice": ("datasets/evaluate_setpoint/choice.json", None),
}


def read_evidence(stored: str = "") -> Evidence:
    """Returns what the stages of the run wrote. A Missing takes the place of each file that is missing or
    broken. `stored`: folder of the stage verdict, if the figures that it computes from the limits already
    exist."""
    paths = FIGURES | ({"verdict": f"{stored}/figures.json"} if stored else {})
    figures = {stage: _read(path, stage, artifacts.read_json) for stage, path in paths.items()}
    off = {stage for stage in paths if switched_off(figures[stage])}
    places = {name: (path, path.split("/")[1], _reader(schema)) for name, (path, schema) in TABLES.items()}
    figures |= dict.fromkeys(off, OFF)
    tables = {name: OFF if place[1] in off else _read(*place) for name, place in places.items()}
    if params.read()["train_ilc"]["source"] == "recordings":
        tables = of_recorded_trials(figures, tables)
    return Evidence(
        figures,
        tables,
        recorded(params.load(Plant, "plant"), "datasets/ingest/record.parquet"),
        params.load(ReportRules, "report"),
        params.read(),
        artifacts.exists(QUICK_LOOK),
        read_certificates(stored) if stored else {},
    )


def _reader(schema: Any) -> Callable[[str], Any]:
    return artifacts.read_json if schema is None else lambda path: artifacts.read_table(path, schema)


def _read(path: str, stage: str, reader: Callable[[str], Any]) -> Any:
    if not artifacts.exists(path):
        name = path.rsplit("/", 1)[-1]
        return Missing("not measured", f"{name} of {stage} is not there", f"Run ./run dvc repro {stage}")
    try:
        return reader(path)
    except ValueError as error:
        return Missing("failed", str(error))
