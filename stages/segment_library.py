"""Learned commands -> library: reads datasets/train_ilc/lessons.parquet; writes datasets/segment_library:
library.parquet, the columns of the paper's matrix (3), and learned.json, the identified chain of each
material, the demarcation and the paper's four assumptions in figures."""

from pathlib import Path
from typing import Any, Literal

import stages
from pipeline.deposition.settings import Printer
from pipeline.deposition.tables import LESSONS, LIBRARY
from pipeline.store import artifacts, params

# figures of control that git keeps and that runs are compared by
METRICS = (
    "columns",
    "materials.*.chain.residual_percent",
    "materials.*.chain.held_out_percent",
    "materials.*.learned_percent",
    "checks.*.percent",
)


class SegmentLibrary(params.Section):
    """Section `segment_library`."""

    law: Literal["model_inverse", "pixels"]


def main() -> None:
    from pipeline.deposition.parts import composition, stored
    from pipeline.deposition.parts.library import TooFewTrials

    with artifacts.stage("segment_library") as out:
        settings = params.load(SegmentLibrary, "segment_library")
        printer = params.load(Printer, "printer")
        # the recordings of a real machine have but one law
        recorded = params.value("train_ilc.source", one_of=("simulated", "recordings")) == "recordings"
        law, routines = "pixels" if recorded else settings.law, printer.training_routines()
        samples = artifacts.read_table("datasets/train_ilc/lessons.parquet", LESSONS)
        with artifacts.about("datasets/train_ilc/lessons.parquet"):
            try:
                trainings = stored.trainings(samples, law, routines, printer.nozzle_mm)
                learned = composition.learn(trainings, sample_time_s=printer.sample_time_s)
            except TooFewTrials as too_few:
                if not recorded:
                    raise
                return wait(out, "segment_library", str(too_few))
        rest = stored.to_json(learned)
        artifacts.write_table(out / "library.parquet", LIBRARY, stored.to_table(learned.library))
        artifacts.write_json(out / "learned.json", rest)
        figures = {"columns": len(learned.library.columns)} | rest
        figures["materials"] = [material_figures(material) for material in rest["materials"]]
        artifacts.write_metrics("segment_library", figures, METRICS)


def wait(out: Path, stage: str, why: str) -> None:
    """Writes to a stage's folder only what it waits for: the machine's next recordings. The pages then say
    which files are missing."""
    artifacts.write_json(out / "waits.json", {"why": why})
    artifacts.write_json(artifacts.REPORTS / "metrics" / f"{stage}.json", {})
    print(f"{stage}: waits: {why}")


def material_figures(material: dict[str, Any]) -> dict[str, Any]:
    """What was learned of a material, without the chains that the trials cannot tell apart and without what
    they missed place by place."""
    chain = {name: value for name, value in material["chain"].items() if name not in ("left_out", "members")}
    missed = {name: value for name, value in material["missed"].items() if name != "by_place"}
    return material | {"chain": chain, "missed": missed}


if __name__ == "__main__":
    stages.run(main, "segment_library", loop="deposition")
