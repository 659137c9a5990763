"""What a newcomer waits for: the whole of `dvc repro` in a fresh clone, stage by stage, then a run that finds
nothing to do, one more recording, and the quick look.

`./run python -m benchmarks.stages` clones this checkout at HEAD, makes everything at full size with nothing
kept from before (compiled code among it), and writes its part of benchmarks/results.json; `--small` takes the
sizes of .ci/params.yaml and prints only. Where dvc.yaml says `python`, DVC finds a watcher that starts the
real one and notes what the stage took: seconds on the clock and of CPU with its children, the largest process
and the most memory of all at once (shared pages counted once, looked at five times a second). Imports are
timed afterwards, in processes that import the stage and do nothing.

One more recording: ten CSV files of 600 samples were read before, and `dvc repro ingest` meets an eleventh.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from benchmarks import growth, results
from benchmarks.results import Row
from pipeline.store import artifacts, params

ROOT = Path(__file__).resolve().parents[1]
LOOPS = ("temperature", "deposition", "setpoint")
LOOP_BARS = {"temperature": 80, "deposition": 60, "setpoint": 130}
LIMIT_S = 3600.0
# what stands in for `python` in a stage's command: light, so that what it costs is not the stage's
WATCHER = """#!{python} -I
import json, os, subprocess, sys, threading, time
from pathlib import Path

def tree(pid):
    found = [pid]
    for one in found:
        try:
            for task in Path(f"/proc/{{one}}/task").glob("*/children"):
                found += map(int, task.read_text().split())
        except OSError:
            pass
    return found

def together_MB(pid):
    kB = 0
    for one in tree(pid):
        try:
            lines = Path(f"/proc/{{one}}/smaps_rollup").read_text().splitlines()
            kB += sum(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
        except (OSError, IndexError):
            pass
    return kB / 1024

def watch(pid):
    while not over.wait(0.2):
        most[0] = max(most[0], together_MB(pid))

begun, over, most = time.monotonic(), threading.Event(), [0.0]
child = subprocess.Popen([{python!r}, *sys.argv[1:]])
threading.Thread(target=watch, args=(child.pid,), daemon=True).start()
_, status, used = os.wait4(child.pid, 0)
wall_s = time.monotonic() - begun
over.set()
row = {{
    "stage": sys.argv[-1].removeprefix("stages."), "wall_s": round(wall_s, 2),
    "cpu_s": round(used.ru_utime + used.ru_stime, 2),
    "largest_process_MB": round(used.ru_maxrss / 1024),
    "together_MB": round(max(most[0], used.ru_maxrss / 1024)),
}}
with open({log!r}, "a") as stream:
    stream.write(json.dumps(row) + "\\n")
sys.exit(os.waitstatus_to_exitcode(status))
"""


class Clone(NamedTuple):
    """A fresh clone: its folder, the environment in which DVC finds the watcher, and the watcher's notes."""

    folder: Path
    environment: dict[str, str]
    notes: Path


def watcher(place: Path, notes: Path) -> Path:
    """The folder with a `python` that starts this one and adds a line of JSON to `notes`."""
    place.mkdir()
    shim = place / "python"
    shim.write_text(WATCHER.format(python=sys.executable, log=str(notes)))
    shim.chmod(0o755)
    return place


def set_parameters(folder: Path, changes: dict[str, Any]) -> None:
    """These keys of params.yaml and params.expert.yaml, each where it lives."""
    by_file = params.files(folder / "params.yaml")
    for dotted, value in changes.items():
        *parents, key = dotted.split(".")
        inner = by_file[params.home(dotted, folder / "params.yaml")]
        for parent in parents:
            inner = inner[parent]
        inner[key] = value
    for name, sections in by_file.items():
        artifacts.write_text(Path(name), yaml.safe_dump(sections, sort_keys=False, allow_unicode=True))


def cloned(place: Path, *, small: bool) -> Clone:
    """This checkout at HEAD with nothing made: no outputs, no lock, no compiled code of an earlier run."""
    folder, notes = place / "clone", place / "notes.jsonl"
    subprocess.run(["git", "clone", "-q", "--no-hardlinks", str(ROOT), str(folder)], check=True)
    if small:
        set_parameters(folder, params.read(ROOT / ".ci/params.yaml"))
    (folder / "dvc.lock").unlink(missing_ok=True)
    path = f"{watcher(place / 'bin', notes)}{os.pathsep}{os.environ['PATH']}"
    return Clone(folder, os.environ | {"PATH": path, "PYTHONPATH": str(folder)}, notes)


def timed(clone: Clone, *command: str) -> float:
    """Seconds on the clock of `python COMMAND` in the clone. Raises SystemExit where it fails."""
    begun = time.monotonic()
    done = subprocess.run(
        [sys.executable, *command], cwd=clone.folder, env=clone.environment, timeout=LIMIT_S,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    if done.returncode:
        said = " ".join(done.stdout[-1500:].split())
        raise SystemExit(f"benchmarks.stages: {' '.join(command)} ended with {done.returncode}: {said}")
    return time.monotonic() - begun


def imports_s(clone: Clone, stage: str) -> float:
    """CPU seconds of a process that imports the stage and does nothing."""
    code = f"import time, stages.{stage}; print(time.process_time())"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=clone.folder, env=clone.environment, check=True,
        capture_output=True, text=True,
    )  # fmt: skip
    return float(done.stdout)


def loop_of(stage: str, root: Path = ROOT) -> str:
    """The loop that the stage names where it is run; "" for a stage of no loop."""
    named = re.search(
        r'stages\.run\(.*loop="(\w*)"', (root / f"stages/{stage}.py").read_text(encoding="utf-8")
    )
    return named[1] if named else ""


def by_loop(rows: list[dict[str, Any]], whole_s: float) -> dict[str, float]:
    """Seconds on the clock: the stages of each loop, and all the rest, which is export, pages and DVC."""
    seconds = {loop: sum(row["wall_s"] for row in rows if row["loop"] == loop) for loop in LOOPS}
    return seconds | {"pages_and_dvc": whole_s - sum(seconds.values())}


def one_more(clone: Clone) -> float:
    """Seconds of `dvc repro ingest` that meets an eleventh recording."""
    path = clone.folder / params.FILE
    sections = yaml.safe_load(path.read_text())
    sections["generate_probing"]["source"] = "recordings"
    path.write_text(yaml.safe_dump(sections, sort_keys=False, allow_unicode=True))
    raw = clone.folder / "datasets/raw/temperature"
    for k in range(10):
        growth.write_recording(raw / f"{k:05}.csv", k, 600)
    timed(clone, "-m", "dvc", "repro", "ingest")
    growth.write_recording(raw / "00010.csv", 10, 600)
    return timed(clone, "-m", "dvc", "repro", "ingest")


def measured(place: Path, *, small: bool) -> dict[str, Any]:
    clone = cloned(place, small=small)
    whole_s = timed(clone, "-m", "dvc", "repro")
    rows = [json.loads(line) for line in clone.notes.read_text().splitlines()]
    rows = [
        {**row, "loop": loop_of(row["stage"], clone.folder), "imports_cpu_s": imports_s(clone, row["stage"])}
        for row in rows
    ]
    nothing_s = timed(clone, "-m", "dvc", "repro")
    quick_s = timed(clone, "-m", "pipeline.cli", "quick")
    more_s = one_more(clone)
    return {
        "whole_s": round(whole_s, 1),
        "loops_s": {loop: round(seconds, 1) for loop, seconds in by_loop(rows, whole_s).items()},
        "quick_s": round(quick_s, 1),
        "nothing_to_do_s": round(nothing_s, 2),
        "one_more_recording_s": round(more_s, 2),
        "peak_MB": max(row["together_MB"] for row in rows),
        "stages": rows,
    }


def rows(found: dict[str, Any]) -> list[Row]:
    """Seconds on the clock; each stage with its CPU seconds and memory."""
    figures = [
        ("the whole of the first `dvc repro`", found["whole_s"], 300),
        *((f"stages of the {loop} loop", found["loops_s"][loop], bar) for loop, bar in LOOP_BARS.items()),
        ("export, pages and DVC", found["loops_s"]["pages_and_dvc"], 30),
        ("`beadline quick`, to its first page", found["quick_s"], 120),
        ("`dvc repro` with nothing to do", found["nothing_to_do_s"], 3.5),
        ("one more recording read", found["one_more_recording_s"], 8),
    ]
    out = [
        Row(what, f"{value:g} s", f"at most {bar:g} s", "met" if value <= bar else "missed")
        for what, value, bar in figures
    ]
    out += [
        Row(
            f"`{one['stage']}`",
            f"{one['wall_s']:g} s",
            "",
            f"{one['cpu_s']:g} CPU s, {one['together_MB']:,} MB",
        )
        for one in sorted(found["stages"], key=lambda one: -one["wall_s"])
    ]
    return out


def main() -> None:
    small = sys.argv[1:] == ["--small"]
    with tempfile.TemporaryDirectory(prefix="stages-") as place:
        found = measured(Path(place), small=small)
    if small:
        print(json.dumps(found, indent=1))
    else:
        results.write("stages", rows(found))


if __name__ == "__main__":
    main()
