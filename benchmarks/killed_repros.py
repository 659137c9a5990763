"""A repro that is killed at random moments: whether the next one gives the bytes of one left alone.

`./run python -m benchmarks.killed_repros --kills 50` clones this checkout, takes the small sizes of
.ci/params.yaml, and makes temperature and deposition once undisturbed. Then, in a second clone with a cache
of its own, `./run dvc repro` is killed (SIGKILL, to all it started or to its process group alone) at moments
drawn between nothing and all of the undisturbed time, run on and killed again, `--a-repro 6` times, before it
is let end; then all made files are compared, and a third clone begins. `--stages learn_kernel` plays these
and what they need. Results: benchmarks/results/killed_repros.json, written after every repro: a call that is
ended goes on behind them when it is made again with the same commit, stages and seed.
"""

import argparse
import contextlib
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from benchmarks import killed_nights
from pipeline.store import artifacts, params
from tests.nightly.toy_nights import Project

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks/results/killed_repros.json"
STAGES = ("evaluate_temperature", "reproduce_study", "compose_parts")
LIMIT_S = 7200.0


class Kill(NamedTuple):
    """Seconds into the repro, whether all it had started went too, and the stages that it had locked."""

    after_s: float
    tree: bool
    made: int


def clone(folder: Path) -> Project:
    """This checkout at HEAD, at small sizes, with nothing made."""
    subprocess.run(["git", "clone", "-q", "--no-hardlinks", str(ROOT), str(folder)], check=True)
    killed_nights._set(folder, params.read(ROOT / ".ci/params.yaml"))
    (folder / "dvc.lock").unlink(missing_ok=True)
    project = Project(folder)
    # the environment at hand, by way of the clone's own ./run
    (folder / ".venv").symlink_to(sys.prefix)
    path = f"{project.env['PATH']}{os.pathsep}{ROOT / '.uv/bin'}"
    project.env |= {"PYTHONPATH": str(folder), "UV_NO_SYNC": "1", "PATH": path}
    return project


def repro(project: Project, stages: list[str]) -> subprocess.Popen:
    return subprocess.Popen(
        [str(project.folder / "run"), "dvc", "repro", *stages], cwd=project.folder, env=project.env,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
    )  # fmt: skip


def ended(child: subprocess.Popen) -> str:
    """What a repro said that must end well. Raises RuntimeError where it does not."""
    said, _ = child.communicate(timeout=LIMIT_S)
    if child.returncode != 0:
        raise RuntimeError(f"dvc repro ended with {child.returncode}: {' '.join(said[-1500:].split())}")
    return said


def made(folder: Path) -> dict[str, str]:
    """SHA-256 of every file that stages make: datasets but for raw and memo, reports, and dvc.lock. A
    left-over of a killed stage is a file too many."""
    kept = (folder / "datasets/raw", folder / "datasets/memo")
    paths = [folder / "dvc.lock"]
    for room in ("datasets", "reports"):
        paths += [path for path in (folder / room).rglob("*") if path.is_file()]
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(paths)
        if path.exists() and not any(path.is_relative_to(one) for one in kept) and path.name != "machine.js"
    }


def finished(folder: Path) -> int:
    """Stages in dvc.lock."""
    with contextlib.suppress(OSError, yaml.YAMLError):
        return len((yaml.safe_load((folder / "dvc.lock").read_text()) or {}).get("stages", {}))
    return 0


def moments(rng: np.random.Generator, whole_s: list[float]) -> Iterator[tuple[float, bool]]:
    """Seconds up to the least of `whole_s`, to which the caller may add, and whether all goes."""
    while True:
        yield float(rng.uniform(0.02, 1.0) * min(whole_s)), bool(rng.uniform() < 0.5)


def gone(processes: list[int], seconds: float = 20.0) -> None:
    """Waits while any of them still dies: DVC takes a lock for held as long as its process is there. Workers
    outside the group may live on."""
    until = time.monotonic() + seconds
    while time.monotonic() < until and any(_dvc(pid) for pid in processes):
        time.sleep(0.05)


def _dvc(pid: int) -> bool:
    """Whether a process is there that is DVC itself, or is dead and not yet waited for."""
    with contextlib.suppress(OSError):
        command = Path(f"/proc/{pid}/cmdline").read_bytes()
        return not command or b"/dvc\0" in command
    return False


def disturbed(
    project: Project, stages: list[str], kills: int, at: Iterator[tuple[float, bool]], whole_s: list[float]
) -> list[Kill]:
    """A repro that is killed so many times at most, and then ends; done before its moment, it counts as
    no kill. One that nothing disturbed adds to `whole_s` what it took."""
    rows: list[Kill] = []
    for _ in range(kills):
        after_s, tree = next(at)
        began, child = time.monotonic(), repro(project, stages)
        try:
            said, _ = child.communicate(timeout=after_s)
        except subprocess.TimeoutExpired:
            group = killed_nights._descendants(child.pid)
            killed_nights.killed(child, tree=tree)
            child.communicate()
            gone(group)
        else:
            if child.returncode != 0:
                raise RuntimeError(f"dvc repro after a kill: {' '.join(said[-1500:].split())}")
            whole_s += [] if rows else [time.monotonic() - began]
            break
        rows.append(Kill(round(time.monotonic() - began, 1), tree, finished(project.folder)))
        print(f"  {rows[-1]}", flush=True)
    ended(repro(project, stages))
    return rows


class Played(NamedTuple):
    """What a call asks for, and every repro that was killed: its kills, and the files that differed."""

    asked: dict[str, Any]
    repros: list[tuple[list[Kill], list[str]]]

    @property
    def kills(self) -> list[Kill]:
        return [kill for kills, _ in self.repros for kill in kills]


def played(path: Path, asked: dict[str, Any]) -> Played:
    """What an earlier call with the same commit, stages and seed has left; else nothing."""
    if artifacts.exists(path):
        before = artifacts.read_json(path)
        if {key: before.get(key) for key in asked} == asked:
            rows = before["each_repro"]
            return Played(asked, [([Kill(**kill) for kill in one["kills"]], one["differ"]) for one in rows])
    return Played(asked, [])


def play(path: Path, stages: list[str], kills: int, a_repro: int, seed: int) -> dict[str, Any]:
    """Undisturbed bytes, kills, and the files that differ after each repro that had been killed, at `path`
    after each."""
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True)
    done = played(path, {"commit": head.stdout.strip(), "stages": stages, "seed": seed})
    # moments of their own for what is played after what is there
    rng = np.random.default_rng([seed, len(done.kills)])
    with tempfile.TemporaryDirectory(prefix="killed_repros-") as place:
        whole = clone(Path(place) / "whole")
        began = time.monotonic()
        ended(repro(whole, stages))
        whole_s, wanted = [time.monotonic() - began], made(whole.folder)
        what = f"{finished(whole.folder)} stages, {len(wanted)} files"
        print(f"undisturbed: {whole_s[0]:.0f} s, {what}", flush=True)
        at = moments(rng, whole_s)
        while len(done.kills) < kills:
            project = clone(Path(place) / f"killed_{len(done.kills)}")
            rows = disturbed(project, stages, min(a_repro, kills - len(done.kills)), at, whole_s)
            found = made(project.folder)
            others = sorted(name for name in wanted | found if wanted.get(name) != found.get(name))
            done.repros.append((rows, others))
            artifacts.write_json(path, told(done, wanted, min(whole_s)))
            shutil.rmtree(project.folder)
            print(f"after {len(done.kills)} kills: {others or 'the same bytes'}", flush=True)
        return told(done, wanted, min(whole_s))


def told(done: Played, wanted: dict[str, str], whole_s: float) -> dict[str, Any]:
    """The results' file."""
    return done.asked | {
        "stages_made": finished_of(wanted),
        "files": len(wanted),
        "undisturbed_s": round(whole_s, 1),
        "kills": len(done.kills),
        "whole_tree": sum(row.tree for row in done.kills),
        "repros": len(done.repros),
        "repros_with_the_same_bytes": sum(not others for _, others in done.repros),
        "files_that_differ": sorted(set().union(*(others for _, others in done.repros))),
        "each_repro": [{"kills": kills, "differ": others} for kills, others in done.repros],
    }


def finished_of(files: dict[str, str]) -> int:
    """Stages that left a folder below datasets."""
    return len({name.split("/")[1] for name in files if name.startswith("datasets/")})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--a-repro", type=int, default=6, help="kills before a repro is let end")
    parser.add_argument("--stages", default=",".join(STAGES), metavar="STAGE,STAGE")
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    result = play(RESULTS, asked.stages.split(","), asked.kills, asked.a_repro, asked.seed)
    sys.exit(0 if result["repros"] == result["repros_with_the_same_bytes"] else 1)


if __name__ == "__main__":
    main()
