"""Learned commands -> library: reads datasets/train_ilc/lessons.parquet; writes datasets/segment_library: library.parquet, the columns of the paper's matrix (3), and
learned.json, the identified chain of each material, the demarcation and the paper's four assumptions in figures."""

from typing import Literal

from pipeline import artifacts, composing, params, schemas
from pipeline.deposition import composition
from pipeline.printer import Printer


class SegmentLibrary(params.Section):
    law: Literal["ours", "pixels"]


def main() -> None:
    with artifacts.stage("segment_library") as out:
        p, printer = params.load(SegmentLibrary, "segment_library"), params.load(Printer, "printer")
        filmed = params.value("train_ilc.source", one_of=("simulated", "recordings")) == "recordings"
        lessons = artifacts.read_table("datasets/train_ilc/lessons.parquet", schemas.LESSONS)
        trainings = composing.trainings(lessons, "pixels" if filmed else p.law, printer.trained(), printer.nozzle_mm)
        with artifacts.about("datasets/train_ilc/lessons.parquet"):
            learned = composition.learn(trainings, sample_time_s=printer.sample_time_s)
        table, rest = composing.stored(learned)
        artifacts.write_table(out / "library.parquet", schemas.LIBRARY, table)
        artifacts.write_json(out / "learned.json", rest)
        artifacts.write_metrics("segment_library", {"columns": len(table["task"]), **rest})


if __name__ == "__main__":
    main()
