"""Part programs -> plunger commands and what will become of them: reads datasets/parts, datasets/segment_library and datasets/train_ilc/models.json; writes
datasets/compose_parts: signals.parquet, tasks.parquet, lines.parquet, scores.parquet and conformance.json."""

from pathlib import Path

import numpy as np
from tqdm import tqdm

from pipeline import artifacts, composing, learning, params, schemas
from pipeline.composing import ComposeParts
from pipeline.deposition import evaluation
from pipeline.learning import TrainIlc
from pipeline.printer import Printer


def main() -> None:
    with artifacts.stage("compose_parts") as out:
        p, printer, taught = (
            params.load(ComposeParts, "compose_parts"),
            params.load(Printer, "printer"),
            params.load(TrainIlc, "train_ilc"),
        )
        learned = composing.read_learned("datasets/segment_library/library.parquet", "datasets/segment_library/learned.json")
        models = artifacts.read_json("datasets/train_ilc/models.json")
        parts, refused = composing.compose_all(Path("datasets/parts"), learned, printer, p)
        settings = {
            "nominals": learning.extruders(models, "nominal"), "plants": learning.extruders(models, "plant"), "noise": taught.noise.shares(), "s": taught.settings(printer),
            "updates": p.whole_updates, "bead_area_mm2": printer.bead_area_mm2, "shortest_s": p.shortest_s,
        }  # fmt: skip
        rng = np.random.default_rng(p.seed)
        scores = [
            evaluation.evaluate(learned, part.composed, rng=rng, **settings)
            for part in tqdm(parts, desc="compose_parts: parts", mininterval=2)
        ]
        both = list(zip(parts, scores, strict=True))
        artifacts.write_table(out / "signals.parquet", schemas.SIGNALS, composing.stacked([composing.signal_rows(*one) for one in both]))
        artifacts.write_table(out / "scores.parquet", schemas.SCORES, composing.stacked([composing.score_rows(*one) for one in both]))
        artifacts.write_table(out / "tasks.parquet", schemas.TASKS, composing.stacked([composing.task_rows(part) for part in parts]))
        artifacts.write_table(out / "lines.parquet", schemas.LINES, composing.stacked([composing.line_rows(part) for part in parts]))
        artifacts.write_json(
            out / "conformance.json",
            {part.name: composing.report(part) for part in parts} | {name: {"refused": why} for name, why in refused.items()},
        )
        artifacts.write_metrics("compose_parts", composing.figures(both) | {"refused": refused})


if __name__ == "__main__":
    main()
