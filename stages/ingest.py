"""Recordings -> one table: reads datasets/generate_probing (simulated) or every file below datasets/raw/temperature (recordings); writes datasets/ingest/record.parquet
and quality.parquet. A recording that was processed before, with the same parameters and code, is taken from a memo; a broken one is quarantined with its reason."""

import sys
from pathlib import Path

from pydantic import Field

from pipeline import artifacts, params
from pipeline.ingestion import Job, collect, process


class Ingest(params.Section):
    mapping: dict[str, params.Mapped]
    time: str = Field(max_length=300)
    max_gap_s: float = Field(gt=0, le=86400)
    strict: bool


def main() -> None:
    with artifacts.stage("ingest") as out:
        p, machine, execution = (
            params.load(Ingest, "ingest"),
            params.load(params.Plant, "plant"),
            params.load(params.Execution, "execution"),
        )
        source = params.value("generate_probing.source", one_of=("simulated", "recordings"))
        folder = Path({"simulated": "datasets/generate_probing", "recordings": "datasets/raw/temperature"}[source])
        mapping = p.mapping if source == "recordings" else {}
        job = Job(machine, {name: (m.source, m.unit, m.scale, m.offset) for name, m in mapping.items()}, p.time, p.max_gap_s)
        results = process(folder, job, execution, memo=Path("datasets/memo/ingest"))
        record, quality, metrics = collect(results, machine, strict=p.strict or "--strict" in sys.argv)
        artifacts.write_table(out / "record.parquet", record.schema, record.columns)
        artifacts.write_table(out / "quality.parquet", quality.schema, quality.columns)
        artifacts.write_metrics("ingest", metrics)


if __name__ == "__main__":
    main()
