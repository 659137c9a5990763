"""Part programs -> plunger commands and what will become of them: reads datasets/parts,
datasets/segment_library and datasets/train_ilc/models.json; writes datasets/compose_parts: signals.parquet,
tasks.parquet, lines.parquet, scores.parquet and conformance.json."""

from pathlib import Path

import stages
from pipeline.deposition.workflow import compose_parts, verify_part
from pipeline.deposition.workflow.segment_library import read_learned
from pipeline.deposition.workflow.settings import ComposeParts, Printer, TrainIlc
from pipeline.deposition.workflow.tables import LINES, SCORES, SIGNALS, TASKS
from pipeline.store import artifacts, params


def main() -> None:
    with artifacts.stage("compose_parts") as out:
        settings, printer, training = (
            params.load(ComposeParts, "compose_parts"),
            params.load(Printer, "printer"),
            params.load(TrainIlc, "train_ilc"),
        )
        learned = read_learned(
            "datasets/segment_library/library.parquet", "datasets/segment_library/learned.json"
        )
        models = artifacts.read_json("datasets/train_ilc/models.json")
        parts, refused = compose_parts.compose_all(Path("datasets/parts"), learned, printer, settings)
        done = compose_parts.judged(parts, learned, models, printer, settings, training)
        rows = compose_parts.rows(done)
        for name, schema in (("signals", SIGNALS), ("scores", SCORES), ("tasks", TASKS), ("lines", LINES)):
            artifacts.write_table(out / f"{name}.parquet", schema, rows[name])
        reports = verify_part.with_measured(
            compose_parts.reports(done, refused), parts, Path("datasets/parts")
        )
        artifacts.write_json(out / "conformance.json", reports)
        artifacts.write_metrics("compose_parts", compose_parts.figures(done) | {"refused": refused})


if __name__ == "__main__":
    stages.run(main, "compose_parts", loop="deposition")
