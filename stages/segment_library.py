"""Learned commands -> library: reads datasets/train_ilc/lessons.parquet; writes datasets/segment_library:
library.parquet, the columns of the paper's matrix (3), and learned.json, the identified chain of each
material, the demarcation and the paper's four assumptions in figures."""

import stages
from pipeline.deposition.workflow import segment_library
from pipeline.deposition.workflow.settings import Printer, SegmentLibrary
from pipeline.deposition.workflow.tables import LIBRARY
from pipeline.store import artifacts, params


def main() -> None:
    with artifacts.stage("segment_library") as out:
        settings = params.load(SegmentLibrary, "segment_library")
        printer = params.load(Printer, "printer")
        recorded = params.value("train_ilc.source", one_of=("simulated", "recordings")) == "recordings"
        learned = segment_library.learned(
            settings, printer, "datasets/train_ilc/lessons.parquet", recorded=recorded
        )
        table, rest = segment_library.stored(learned)
        artifacts.write_table(out / "library.parquet", LIBRARY, table)
        artifacts.write_json(out / "learned.json", rest)
        artifacts.write_metrics(
            "segment_library", {"columns": len(table["task"]), **segment_library.figures(rest)}
        )


if __name__ == "__main__":
    stages.run(main, "segment_library", loop="deposition")
