"""The evidence of a run, read from what its stages wrote."""

from collections.abc import Callable, Mapping
from typing import Any

from pipeline.deposition.workflow.tables import SCORES
from pipeline.setpoint.workflow.tables import SCOREBOARD
from pipeline.store import artifacts, params
from pipeline.temperature.workflow.settings import Plant
from pipeline.temperature.workflow.tables import DYNAMICS, RESIDUALS
from pipeline.verdict.evidence import Evidence
from pipeline.verdict.settings import ReportRules
from pipeline.verdict.verdict import Missing

# what `beadline quick` writes before the verdict: what is smaller than in a full run
QUICK_LOOK = "reports/quick_look.json"
# stages whose figures the rules may ask for
STAGES = (
    "ingest",
    "identify_plant",
    "learn_kernel",
    "tune_weights",
    "evaluate_temperature",
    "train_ilc",
    "segment_library",
    "compose_parts",
    "train_classifier",
    "train_agent",
    "evaluate_setpoint",
)
TABLES = {
    "residuals": ("datasets/identify_plant/residuals.parquet", RESIDUALS),
    "dynamics": ("datasets/identify_plant/dynamics.parquet", DYNAMICS),
    "scores": ("datasets/compose_parts/scores.parquet", SCORES),
    "conformance": ("datasets/compose_parts/conformance.json", None),
    "scoreboard": ("datasets/evaluate_setpoint/scoreboard.parquet", SCOREBOARD),
    "choice": ("datasets/evaluate_setpoint/choice.json", None),
}


def read_evidence(certified: Mapping[str, Mapping[str, Any]]) -> Evidence:
    """What the stages that ran wrote; a Missing in the place of each file that is not there."""
    return Evidence(
        {stage: _read(f"datasets/{stage}/figures.json", stage, artifacts.read_json) for stage in STAGES},
        {name: _read(path, path.split("/")[1], _reader(schema)) for name, (path, schema) in TABLES.items()},
        params.load(Plant, "plant"),
        params.load(ReportRules, "report"),
        params.read(),
        artifacts.exists(QUICK_LOOK),
        certified,
    )


def _reader(schema: Any) -> Callable[[str], Any]:
    return artifacts.read_json if schema is None else lambda path: artifacts.read_table(path, schema)


def _read(path: str, stage: str, reader: Callable[[str], Any]) -> Any:
    if not artifacts.exists(path):
        name = path.rsplit("/", 1)[-1]
        return Missing("not measured", f"{name} of {stage} is not there", f"Run ./run dvc repro {stage}")
    return reader(path)
