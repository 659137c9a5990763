"""Runs the benchmarks that have a goal of speed, each as a process of its own, and writes what they say.

`./run --group peers python -m benchmarks` takes some 25 minutes on two idle cores, and writes
benchmarks/results/summary.json, summary.html and the tables of README.md;

`--only kernel,growth` runs these and leaves the results of the others; `--quick` leaves out what takes more
than a minute on two idle cores; `--gather` runs nothing. A benchmark that takes longer than six times its
minutes is ended, and its last result stays. `--peer PYTHON` is of an environment with stable-baselines3 and a
CPU build of torch; without it, and without nfoursid (group `peers`), what is measured beside them is left as
it was. Kills, fuzzing and mutants take hours: their tables are gathered, and the page names their commands.
Exit status: 0; 1 where a benchmark failed.
"""

import argparse
import contextlib
import importlib.util
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks import summary, summary_page
from benchmarks.summary import BENCHMARKS, FILE, IDENTIFICATION, RESULTS, Benchmark
from pipeline.store import artifacts

ROOT = Path(__file__).resolve().parents[1]
SPARE = 6  # times its minutes, before a benchmark is ended
QUICK_MINUTES = 1.0


def machine(told: Path = Path("/proc/cpuinfo")) -> dict[str, Any]:
    """The CPU's name, with family and model (makers give several generations one name), and how many cores
    this process may use."""
    pairs = (line.partition(":") for line in told.read_text().split("\n\n")[0].splitlines())
    says = {key.strip(): value.strip() for key, _, value in pairs}
    name = says.get("model name", os.uname().machine)
    if {"cpu family", "model"} <= says.keys():
        name += f" (family {says['cpu family']}, model {says['model']})"
    return {"cpu": name, "cores": len(os.sched_getaffinity(0))}


def lacks(benchmark: Benchmark, peer: str | None) -> str:
    """What a benchmark needs and this environment has not; "" where nothing."""
    if benchmark.needs_peer and not (peer and Path(peer).exists()):
        return "no python of an environment with stable-baselines3 is named (--peer)"
    if benchmark.arguments == IDENTIFICATION and importlib.util.find_spec("nfoursid") is None:
        return "nfoursid is not installed; start with ./run --group peers"
    return ""


def ran(benchmark: Benchmark, peer: str | None) -> str:
    """Runs it; why it gave nothing, or "". What it started ends with it."""
    limit_s = 60 * SPARE * benchmark.minutes
    arguments = [peer or "" if one == "{peer}" else one for one in benchmark.arguments]
    command = [sys.executable, "-m", *arguments]
    child = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip
    try:
        said = child.communicate(timeout=limit_s)[1].strip().splitlines()
    except subprocess.TimeoutExpired:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)
        child.communicate()
        return f"took longer than {limit_s:.0f} s and was ended"
    except KeyboardInterrupt:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)
        raise
    return (said[-1] if said else f"ended with status {child.returncode}") if child.returncode else ""


def chosen(only: list[str], *, quick: bool) -> list[str]:
    """The benchmarks to run, in their order. Raises ValueError for a name that is none."""
    if unknown := [name for name in only if name not in BENCHMARKS]:
        raise ValueError(f"--only: {unknown[0]} is no benchmark; choose among {', '.join(BENCHMARKS)}")
    return [
        name
        for name, one in BENCHMARKS.items()
        if (not only or name in only) and not (quick and one.minutes > QUICK_MINUTES)
    ]


def write(runs: dict[str, Any]) -> None:
    """The record, the page, and the README's table."""
    gathered = summary.gathered(RESULTS, runs)
    artifacts.write_json(FILE, gathered)
    artifacts.write_text(FILE.with_suffix(".html"), summary_page.render(gathered))
    readme = ROOT / "README.md"
    text = summary.in_readme(readme.read_text(encoding="utf-8"), summary.block(gathered))
    artifacts.write_text(readme, text)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", default="", metavar="NAME,NAME", help=f"of {', '.join(BENCHMARKS)}")
    parser.add_argument("--quick", action="store_true", help="what takes a minute at most")
    parser.add_argument("--gather", action="store_true", help="run nothing")
    parser.add_argument("--peer", metavar="PYTHON", help="of an environment with stable-baselines3")
    asked = parser.parse_args()
    try:
        names = [] if asked.gather else chosen([*filter(None, asked.only.split(","))], quick=asked.quick)
    except ValueError as error:
        parser.error(str(error))
    runs = dict(artifacts.read_json(FILE)["runs"]) if FILE.exists() else {}
    failed = 0
    for name in names:
        benchmark, begun = BENCHMARKS[name], time.monotonic()
        why = lacks(benchmark, asked.peer)
        if why:
            print(f"{name:15} left as it was: {why}", flush=True)
            continue
        print(f"{name:15} {benchmark.command}", flush=True)
        why = ran(benchmark, asked.peer)
        failed += bool(why)
        print(f"{'':15} {why or 'done'}, {time.monotonic() - begun:.0f} s", flush=True)
        if not why:
            data = summary.found(summary.read(benchmark.file, RESULTS), benchmark.part)
            runs[name] = {"machine": machine(), "digest": summary.digest(data)}
        write(runs)
    write(runs)
    print(f"{FILE.relative_to(ROOT)}, summary.html and README.md written")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
