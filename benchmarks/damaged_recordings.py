"""What damaged and hostile recordings do: the outcomes of damage by chance in each format, and seconds and
peak memory of inspect and ingest on every hostile file, each in a fresh child.

`./run python -m benchmarks.damaged_recordings [COUNT]` prints the figures beside the bars and writes
benchmarks/results/damaged_recordings.json. COUNT is of damaged files, 1,000 by default.
"""

import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pipeline.reading import isolated as children
from pipeline.reading.inspection import inspect
from pipeline.reading.isolated import Budget, isolated
from pipeline.store import artifacts
from pipeline.temperature.workflow import ingest
from pipeline.temperature.workflow.settings import Plant
from tests.reading import damaging, hostile

RESULTS = Path(__file__).parent / "results" / "damaged_recordings.json"
BUDGET = Budget(60.0, 2000.0)
LONGEST_S, LARGEST_MB = 60.0, 2000.0
MACHINE = Plant.model_validate(
    {
        "sample_time_s": 1.0,
        "inputs": [{"name": "heater", "unit": "percent", "low": 0.0, "high": 100.0}],
        "outputs": [{"name": "zone", "unit": "degC", "reference": 50.0}],
    }
)


def measured(work: Callable[..., Any], *arguments: Any, shown: Path) -> dict[str, Any]:
    """Seconds and peak in MB of one call in a fresh child, and how it was answered. A child that its budget
    ended has no peak."""
    while children._waiting:
        children._end(children._waiting.pop())
    isolated(len, "", shown=shown, budget=BUDGET)
    status = Path(f"/proc/{children._waiting[0].process.pid}/status")
    start, answer = time.perf_counter(), "answered"
    try:
        reply = isolated(work, *arguments, shown=shown, budget=BUDGET)
        if work is not inspect and reply:
            answer = "refused: " + reply.replace(f"{shown.parent}/", "")
    except ValueError as error:
        answer = "refused: " + str(error).replace(f"{shown.parent}/", "")
    seconds, peak = time.perf_counter() - start, None
    if children._waiting:
        peak = next(
            int(line.split()[1]) / 1024 for line in status.read_text().splitlines() if "VmHWM" in line
        )
    return {"s": round(seconds, 1), "peak_mb": None if peak is None else round(peak), "answer": answer[:300]}


def by_chance(count: int) -> dict[str, dict[str, int]]:
    """{format: {outcome: files}} of `count` files, a quarter of each format."""
    outcomes = {}
    for kind in damaging.GOOD:
        with tempfile.TemporaryDirectory() as folder:
            results = damaging.outcomes(Path(folder), kind, count // len(damaging.GOOD), seed=16)
            outcomes[kind] = dict(sorted(Counter(outcome for outcome, _ in results).items()))
        print(f"{kind:<10} {outcomes[kind]}", flush=True)
    return outcomes


def hostile_files() -> dict[str, dict[str, Any]]:
    """{file: figures of inspect and ingest}."""
    spec, figures = ingest.IngestSpec(MACHINE, {}, "", 5.0), {}
    for name in [*hostile.FILES, *hostile.SPARSE]:
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            path = hostile.write(folder, name)
            figures[name] = {
                "inspect": measured(inspect, path, shown=path),
                "ingest": measured(ingest._one, path, path, folder, "key", spec, folder / "memo", shown=path),
            }
        print(f"{name:<28} {figures[name]}", flush=True)
    return figures


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    chance, files = by_chance(count), hostile_files()
    runs = [run for figures in files.values() for run in figures.values()]
    summary = {
        "damaged_files": count,
        "ended_the_process": sum(outcome.get(damaging.ENDED, 0) for outcome in chance.values())
        + sum("ended the process" in run["answer"] for run in runs),
        "silently_wrong_with_checksums": sum(
            chance[kind].get(damaging.SILENT, 0) for kind in ("mcap", "parquet")
        ),
        "hostile_files": len(files),
        "longest_s": max(run["s"] for run in runs),
        "largest_mb": max(run["peak_mb"] or 0 for run in runs),
        "ended_by_their_budget": sum("that a recording may take" in run["answer"] for run in runs),
    }
    artifacts.write_json(RESULTS, {"summary": summary, "by_chance": chance, "hostile": files})
    print(summary)
    print(f"bars: 0 ended, 0 silently wrong, {LONGEST_S:g} s, {LARGEST_MB:g} MB beyond the child's own")


if __name__ == "__main__":
    main()
