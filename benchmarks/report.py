"""Time, memory and size of the pages from the artifacts that are there, and of the history from git.

`./run python -m benchmarks.report` prints the figures beside the bars and writes
benchmarks/results/report.json. The stage runs as a process of its own, start and
imports included, in a folder that shares the artifacts: nothing in reports/ is touched.
Seconds are the best of three rounds, CPU and wall.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from pipeline.report.runs import history, trend
from pipeline.report.shared.verdict import ReportRules
from pipeline.store import params
from pipeline.temperature.workflow.settings import Panel

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks/results/report.json"
ROUNDS = 3
BARS = {"pages_s": 5.0, "index_bytes": 1_000_000, "page_bytes": 1_500_000, "history_s": 10.0}


def shared(folder: Path) -> Path:
    """A folder that has the project's artifacts, parameters and code, and reports of its own."""
    for name in ("datasets", "params.yaml", "params.expert.yaml", "pipeline", "stages"):
        (folder / name).symlink_to(ROOT / name)
    shutil.copytree(ROOT / "reports/metrics", folder / "reports/metrics")
    if (ROOT / "reports/accepted.json").exists():
        shutil.copy(ROOT / "reports/accepted.json", folder / "reports/accepted.json")
    return folder


def stage(folder: Path) -> tuple[float, float, float]:
    """Wall and CPU seconds and peak memory in MB of the report stage."""
    started = time.perf_counter()
    child = subprocess.Popen([sys.executable, "-m", "stages.report"], cwd=folder)
    _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit("benchmarks.report: the report stage failed; run ./run dvc repro first")
    return time.perf_counter() - started, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def past() -> tuple[int, float]:
    """Runs that git holds, and the seconds from git to the text of the page."""
    started = time.perf_counter()
    found = list(history.revisions(500))
    trend.render(
        found, params.load(ReportRules, "report"), band_degC=params.load(Panel, "panel").band_degC, pages=[]
    )
    return len(found), time.perf_counter() - started


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = shared(Path(name))
        rounds = [stage(folder) for _ in range(ROUNDS)]
        sizes = json.loads((folder / "reports/metrics/report.json").read_text())["bytes"]
    wall, cpu, memory = (min(values) for values in zip(*rounds, strict=True))
    runs, seconds = past()
    found = {
        "pages": {
            "wall_s": round(wall, 2),
            "cpu_s": round(cpu, 2),
            "peak_MB": round(memory),
            "bar_s": BARS["pages_s"],
        },
        "bytes": sizes | {"bar_index": BARS["index_bytes"], "bar_page": BARS["page_bytes"]},
        "history": {"runs": runs, "wall_s": round(seconds, 3), "bar_s": BARS["history_s"]},
    }
    RESULTS.write_text(json.dumps(found, indent=2) + "\n")
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
