"""Recordings -> one table: reads datasets/probe_machine (simulated) or every file below
datasets/raw/temperature (recordings); writes datasets/ingest/record.parquet,
quality.parquet and printer_pid.json. A recording that was processed before, with the same
parameters and code, is taken from a memo; a broken one is quarantined with its reason."""

import sys
from pathlib import Path

import stages
from pipeline.store import artifacts, params
from pipeline.temperature.workflow import ingest
from pipeline.temperature.workflow.settings import Ingest, Plant, check_output_limits


def main() -> None:
    with artifacts.stage("ingest") as out:
        settings, machine, execution = (
            params.load(Ingest, "ingest"),
            params.load(Plant, "plant"),
            params.load(params.Execution, "execution"),
        )
        source = params.value("generate_probing.source", one_of=("simulated", "recordings"))
        check_output_limits(machine, source)
        folder = Path(
            {"simulated": "datasets/probe_machine", "recordings": "datasets/raw/temperature"}[source]
        )
        spec = ingest.spec_of(settings, machine, source)
        budget = ingest.Budget(settings.longest_s, settings.largest_mb)
        results = ingest.process(folder, spec, execution, memo=Path("datasets/memo/ingest"), budget=budget)
        record, quality, metrics = ingest.collect(
            results, machine, strict=settings.strict or "--strict" in sys.argv
        )
        done = ingest.work_done(results)
        print(f"ingest: {done['processed']} recordings read, {done['reused']} taken from the memo")
        artifacts.write_table(out / "record.parquet", record.schema, record.columns)
        artifacts.write_table(out / "quality.parquet", quality.schema, quality.columns)
        artifacts.write_json(out / "printer_pid.json", ingest.printer_pids(folder, results, spec))
        artifacts.write_metrics("ingest", metrics)


if __name__ == "__main__":
    stages.run(main, "ingest", loop="temperature")
