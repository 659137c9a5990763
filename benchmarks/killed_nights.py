"""Nights that end badly: killed at random moments, on a full disk, with broken files, with nobody to tell.

`./run python -m benchmarks.killed_nights` plays a toy project (two stages of a second, 4 s a night on an idle
machine): `--kills 30`, and each of the troubles. `--real` plays the project itself, a clone of this
checkout with the small sizes of .ci/params.yaml and one more loop whose challenger is better every night;
`--cache DIR` takes from a DVC cache, such as .dvc/cache, what need not be made anew, and leaves deposition
and setpoint at full size there. `--only lock_markers,kills` plays these. Results go to
benchmarks/results/killed_nights.json.

After a kill: production as HEAD has it is that of before, or one whole commit further; a fresh clone gets it
bit by bit; the next night works. In trouble: the champion stays bit by bit, status 1, somebody is woken,
the summary and the alarm name the cause, no traceback is shown, and once mended the next night works.
"""

import argparse
import contextlib
import json
import os
import re
import resource
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from pipeline.nightly import champion
from pipeline.store import artifacts, params
from tests.nightly.toy_nights import Project

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks/results/killed_nights.json"
TOYS = 6  # kills that a toy project sees: each needs a challenger that is better by 6 %
WORKED = (0, 3, 4)  # exit statuses of a night that did its work
PROBED = 5  # every so many nights of the real project the machine is probed anew
LATE = 0.4  # share of the kills that wait until the stages are done: a promotion takes seconds of a night
# the sections of .ci/params.yaml that the temperature loop reads
TEMPERATURE = ("generate_probing", "panel", "reproduce_study", "tune_weights")

IMPROVE = """
import json, pathlib
made = pathlib.Path("datasets/tune_weights/weights.json").read_bytes()
night = int(pathlib.Path("improve.txt").read_text())
cost = 100 * 0.9**night
cases = {f"case {k}": {"block": f"plant {k}", "cost": cost + 0.001 * k} for k in range(8)}
guards = {"worst": {"value": cost, "allowed": 0.1}, "unstable": {"value": 0, "allowed": 0}}
out = pathlib.Path("datasets/improve")
out.mkdir(parents=True, exist_ok=True)
(out / "cases.json").write_text(json.dumps({"panel": "kills 1", "cases": cases, "guards": guards}))
(out / "weights.bin").write_bytes(made * 20)
"""


class Play(NamedTuple):
    """A project whose nights are played: the loop that is promoted, what makes its challenger better in night
    k, which nights rerun much, the file that the last stage writes, and where it is told that somebody was
    woken."""

    project: Project
    loop: str
    news: Callable[[int], None]
    long: Callable[[int], bool]
    done: Path
    woken: Path


class Ended(NamedTuple):
    """A night: exit status, what it said, and how long it took."""

    status: int
    said: str
    seconds: float


def night(play: Play, limit_s: float = 7200, **how) -> Ended:
    began = time.monotonic()
    child = play.project.start(start_new_session=True, **how)
    try:
        out, err = child.communicate(timeout=limit_s)
    except subprocess.TimeoutExpired:
        killed(child, tree=True)
        out, err = child.communicate()
        err += f" [ended after {limit_s:g} s]"
    return Ended(child.returncode, " ".join((out + err).split()), time.monotonic() - began)


# ---- projects


def toy(folder: Path) -> Play:
    project = Project(folder).make()
    play = Play(
        project, "toy", lambda k: _better(project, k), lambda k: False,
        folder / "datasets/evaluate/cases.json", folder.parent / f"{folder.name}.woken",
    )  # fmt: skip
    set_toy(play)
    return play


def set_toy(play: Play, **changes) -> None:
    """Its parameters, committed: an alarm that is written down, and these."""
    play.project.set(alarm=_alarm(play.woken), **changes)
    play.project.run("git", "commit", "-qam", "parameters", check=False)


def _alarm(woken: Path) -> str:
    """A command that keeps the alarm's file, a line each."""
    keep = f"import sys; open('{woken}', 'a').write(' '.join(open(sys.argv[1]).read().split()) + chr(10))"
    return shlex.join([sys.executable, "-c", keep])


def _better(project: Project, k: int) -> None:
    """One more recording, so that all together are 6 % nearer to what they should be than after k - 1."""
    values = [
        float(line)
        for path in sorted((project.folder / "datasets/raw/toy").glob("*.csv"))
        for line in path.read_text().split()
    ]
    wanted = 9.0 + 2.0 * 0.94**k
    project.record(f"shift_{k:03d}", [(len(values) + 1) * wanted - sum(values)])


def real(folder: Path, cache: Path | None) -> Play:
    """A clone of this checkout at HEAD, small, with one more stage and loop; nothing is run yet."""
    subprocess.run(["git", "clone", "-q", "--no-hardlinks", str(ROOT), str(folder)], check=True)
    project = Project(folder)
    project.env |= {"PYTHONPATH": str(folder)}
    project.run("git", "config", "user.email", "somebody@example.com")
    project.run("git", "config", "user.name", "Somebody")
    woken = folder.parent / f"{folder.name}.woken"
    _small(folder, woken, whole=cache is None)
    wiring = yaml.safe_load((folder / "dvc.yaml").read_text())
    wiring["stages"]["improve"] = {
        "cmd": "python improve.py",
        "deps": ["improve.py", "improve.txt", "datasets/tune_weights/weights.json"],
        "outs": [{"datasets/improve": {"persist": True}}],
    }
    (folder / "dvc.yaml").write_text(yaml.safe_dump(wiring, sort_keys=False))
    (folder / "improve.py").write_text(IMPROVE)
    (folder / "improve.txt").write_text("0")
    project.run("git", "add", "-A")
    project.run("git", "commit", "-qm", "small, with a loop that is better every night")
    if cache:
        shutil.copytree(cache, folder / ".dvc/cache", dirs_exist_ok=True)
        project.run(sys.executable, "-m", "dvc", "checkout", "-q", "--force", check=False)

    def probed(k: int) -> bool:
        return k % PROBED == 0

    def news(k: int) -> None:
        (folder / "improve.txt").write_text(str(k))
        if probed(k):  # which runs the whole temperature loop
            _set(folder, {"generate_probing.seed": 1000 + k})
        project.run("git", "commit", "-qam", f"news {k}")

    return Play(project, "kills", news, probed, folder / "datasets/improve/cases.json", woken)


def _small(folder: Path, woken: Path, *, whole: bool) -> None:
    """The sizes of .ci/params.yaml, and the job's settings."""
    sizes = params.read(ROOT / ".ci/params.yaml")
    _set(folder, {key: size for key, size in sizes.items() if whole or key.split(".")[0] in TEMPERATURE})
    loops = params.read(folder / "params.yaml")["nightly"]["loops"]
    files = [
        "datasets/tune_weights/weights.json",
        "datasets/improve/weights.bin",
        "datasets/improve/cases.json",
    ]
    one = {"artifacts": files, "judge": "cases", "cases": files[-1], "recordings": ""}
    _set(folder, {"nightly.loops": {"temperature": loops["temperature"], "kills": one},
        "nightly.least_free_mb": 1, "nightly.alarm": _alarm(woken)})  # fmt: skip


def _set(folder: Path, changes: dict[str, Any]) -> None:
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


# ---- what is in production


class Production(NamedTuple):
    """HEAD, the run and files {name: MD5} of its champion, and the files as they lie on disk."""

    head: str
    run: str
    files: dict[str, str]
    disk: dict[str, str]


def production(play: Play) -> Production:
    at_head = play.project.champion_of(play.loop)
    disk = champion.md5s(play.project.folder / "champion" / play.loop)
    return Production(play.project.head(), at_head.get("run", ""), at_head.get("files", {}), disk)


def cloned(play: Play) -> dict[str, str]:
    """The champion's files {name: MD5} as a fresh clone of HEAD gets them from DVC's cache."""
    with tempfile.TemporaryDirectory(prefix="clone-") as place:
        copy = Project(Path(place) / "copy")
        copy.run("git", "clone", "-q", str(play.project.folder), str(copy.folder))
        cache = str(play.project.folder / ".dvc/cache")
        copy.run(sys.executable, "-m", "dvc", "cache", "dir", "--local", cache)
        copy.run(sys.executable, "-m", "dvc", "checkout", "-q", f"champion/{play.loop}.dvc")
        return champion.md5s(copy.folder / "champion" / play.loop)


def left_running(play: Play) -> int:
    """Processes of a night of this project that still run."""
    mark, count = f"BEADLINE_NIGHT={play.project.folder}\0".encode(), 0
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            count += mark in (entry / "environ").read_bytes()
    return count


# ---- kills


def killed(child: subprocess.Popen, *, tree: bool) -> None:
    """SIGKILL to the night's process group; to all that descends from it too where `tree`."""
    whole = _descendants(child.pid) if tree else []
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child.pid, signal.SIGKILL)
    for pid in whole:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def _descendants(pid: int) -> list[int]:
    parents = {}
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            parents[int(entry.name)] = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
    found = [pid]
    for one in found:
        found += [child for child, parent in parents.items() if parent == one]
    return found[1:]


class Kill(NamedTuple):
    """One kill: seconds into the night, whether it waited for the stages to be done, what HEAD was then, and
    what must hold."""

    after_s: float
    late: bool
    tree: bool
    promoted: bool
    on_disk_at_once: bool
    old_or_new: bool
    clone_whole: bool
    next_works: bool
    next_whole: bool
    said: str

    @property
    def passed(self) -> bool:
        return self.old_or_new and self.clone_whole and self.next_works and self.next_whole


class Pace(NamedTuple):
    """Of a night that ends well: how long it takes, and how much of that follows on its stages."""

    whole_s: float
    tail_s: float


def pace(play: Play, k: int) -> Pace:
    """A night with news, not killed. Raises AssertionError where it does not work."""
    play.news(k)
    ended = night(play)
    assert ended.status in WORKED and production(play).run, ended
    return Pace(ended.seconds, max(time.time() - play.done.stat().st_mtime, 0.5))


def kill(play: Play, k: int, rng: np.random.Generator, usual: Pace) -> Kill:
    """Night k, killed, and the next one."""
    play.news(k)
    before = production(play)
    stamp = play.done.stat().st_mtime_ns
    late, tree = bool(rng.uniform() < LATE), bool(rng.uniform() < 0.5)
    began = time.monotonic()
    child = play.project.start(start_new_session=True)
    if late:
        while child.poll() is None and play.done.exists() and play.done.stat().st_mtime_ns == stamp:
            time.sleep(0.005)
        time.sleep(rng.uniform(0.0, usual.tail_s))
    else:
        time.sleep(rng.uniform(0.02, 1.0) * usual.whole_s)
    killed(child, tree=tree)
    child.communicate()
    after_s = time.monotonic() - began
    at_kill = production(play)
    stayed = (at_kill.head, at_kill.run, at_kill.files) == (before.head, before.run, before.files)
    parent = play.project.run("git", "rev-parse", "HEAD^").stdout.strip()
    old_or_new = stayed or (parent == before.head and at_kill.run > before.run)
    clone_whole = cloned(play) == at_kill.files
    ended = night(play)
    after = production(play)
    tidy = after.disk == after.files and not left_running(play)
    return Kill(
        after_s, late, tree, not stayed, at_kill.disk in (before.files, at_kill.files), old_or_new,
        clone_whole, ended.status in WORKED and after.run > before.run, tidy, ended.said,
    )  # fmt: skip


def kills(make: Callable[[str], Play], count: int, seed: int, most: int) -> dict[str, Any]:
    """`count` kills, at most `most` of one project."""
    rng, rows, play = np.random.default_rng(seed), [], None
    for number in range(count):
        if number % most == 0:
            play = make(f"kills_{number}")
            first = night(play)
            assert first.status in WORKED, first
            paces = {play.long(k): pace(play, k) for k in (1, PROBED)}
            begins = PROBED + 1
            print(f"  nights take {', '.join(f'{one.whole_s:.0f} s' for one in paces.values())}", flush=True)
        k = begins + number % most
        one = kill(play, k, rng, paces[play.long(k)])
        rows.append(one)
        print(
            f"  {'ok  ' if one.passed else 'FAIL'} {one.after_s:6.1f} s {'late ' if one.late else 'early'} "
            f"{'tree ' if one.tree else 'group'} {'promoted' if one.promoted else 'as before'}"
            f"{'' if one.passed else f' {one}'}: {one.said[:110]}",
            flush=True,
        )
        if number % most == most - 1 or number == count - 1:
            play.project.run("git", "fsck", "--strict")
    return {
        "kills": count, "passed": sum(row.passed for row in rows), "promoted": sum(r.promoted for r in rows),
        "whole_on_disk_at_once": sum(row.on_disk_at_once for row in rows), "seed": seed,
        "failed": [row._asdict() for row in rows if not row.passed],
    }  # fmt: skip


# ---- troubles


class Trouble(NamedTuple):
    """What goes wrong: `spoil` does it, and gives how the night is started and what mends it; the cause must
    be named as `cause` (regex) has it, within `limit_s`. `may_work`: the job may know a way around it."""

    spoil: Callable[[Play], tuple[dict[str, Any], Callable[[], None]]]
    cause: str
    limit_s: float = 60.0
    may_work: bool = False


def _broken(name: str, text: bytes) -> Callable:
    """A file of the project that holds something else."""

    def spoil(play: Play):
        path = play.project.folder / name
        whole = path.read_bytes()
        path.write_bytes(text if text != MARKERS else _markers(whole))
        return {}, lambda: path.write_bytes(whole)

    return spoil


MARKERS = b"markers"


def _markers(whole: bytes) -> bytes:
    """As a merge leaves it: the last line twice, between markers."""
    *head, last = whole.rstrip(b"\n").split(b"\n")
    return b"\n".join([*head, b"<<<<<<< HEAD", last, b"=======", last, b">>>>>>> nightly", b""])


def _state(name: str, text: bytes) -> Callable:
    """A state file of the job; the job itself mends it."""

    def spoil(play: Play):
        (play.project.folder / ".beadline" / name).write_bytes(text)
        return {}, lambda: None

    return spoil


def _unknown_key(play: Play):
    path = play.project.folder / "params.yaml"
    whole = path.read_text()
    sections = yaml.safe_load(whole)
    sections["nightly"]["colour"] = 1
    path.write_text(yaml.safe_dump(sections))
    return {}, lambda: path.write_text(whole)


def _small_files(play: Play):
    """No file may grow beyond 200 kB: what a quota or a full disk does in the middle of a write."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)

    return {"preexec_fn": limit}, lambda: None


def _full(left_kb: int) -> Callable:
    """A disk with so much left (the project lies on one of its own, `on_a_small_disk`)."""

    def spoil(play: Play):
        filler = play.project.folder / ".git/filler"
        free = shutil.disk_usage(play.project.folder).free
        filler.write_bytes(bytes(max(free - 1000 * left_kb, 0)))
        return {}, lambda: filler.unlink()

    return spoil


def _webhook(answers: bool) -> Callable:
    """A webhook that refuses, or takes the call and never answers, on a night with a recording that fails."""

    def spoil(play: Play):
        server = socket.socket()
        server.bind(("127.0.0.1", 0))
        if answers:
            server.listen(8)
        url = f"http://127.0.0.1:{server.getsockname()[1]}/woken"
        before = (play.project.folder / "params.yaml").read_text()
        _change(play, {"nightly.webhook": url})
        bad = play.project.folder / "datasets/raw/toy/garbage.csv"
        bad.write_text("not a number")

        def mend() -> None:
            bad.unlink()
            server.close()
            (play.project.folder / "params.yaml").write_text(before)
            play.project.run("git", "commit", "-qam", "parameters as before", check=False)

        return {}, mend

    return spoil


def _change(play: Play, changes: dict[str, Any]) -> None:
    path = play.project.folder / "params.yaml"
    sections = yaml.safe_load(path.read_text())
    for dotted, value in changes.items():
        section, key = dotted.split(".")
        sections[section][key] = value
    path.write_text(json.dumps(sections, indent=1))
    play.project.run("git", "commit", "-qam", "parameters", check=False)


def troubles() -> dict[str, Trouble]:
    last, room = r"last\.json", r"(?i)no space|MB left"
    return {
        "state_empty": Trouble(_state("last.json", b""), last),
        "state_garbage": Trouble(_state("last.json", b"\xff\x00{"), last),
        "state_types": Trouble(
            _state("last.json", b'{"night": "seven", "success": 7, "recordings": [1], "drift": 3}'), last,
        ),
        "state_list": Trouble(_state("last.json", b"[1, 2]"), last),
        "nights_garbage": Trouble(_state("nights.json", b"[{"), r"nights\.json"),
        "nights_types": Trouble(_state("nights.json", b'{"a": 1}'), r"nights\.json"),
        "champion_garbage": Trouble(_broken("champion.json", b"{"), r"champion\.json", may_work=True),
        "lock_markers": Trouble(_broken("dvc.lock", MARKERS), r"dvc\.lock"),
        "lock_garbage": Trouble(_broken("dvc.lock", b"\x00\xff: ["), r"dvc\.lock"),
        "wiring_gone": Trouble(_gone("dvc.yaml"), r"dvc\.yaml"),
        "params_syntax": Trouble(_broken("params.yaml", b"nightly: {a: [1, \n b: }"), r"params\.yaml"),
        "params_markers": Trouble(_broken("params.yaml", MARKERS), r"params\.yaml"),
        "params_bytes": Trouble(_broken("params.yaml", b"nightly: {branch: \xff\xfe}"), r"params\.yaml"),
        "params_unknown_key": Trouble(_unknown_key, r"nightly\.colour"),
        "disk_quota": Trouble(_small_files, r"(?i)too large|no space|quota"),
        "disk_1_MB": Trouble(_full(1100), room, may_work=True),
        "disk_1.6_MB": Trouble(_full(1600), room, may_work=True),
        "disk_2_MB": Trouble(_full(2100), room, may_work=True),
        "disk_0.5_MB": Trouble(_full(500), room, may_work=True),
        "webhook_refuses": Trouble(_webhook(False), r"webhook.*(?i:refused)"),
        "webhook_hangs": Trouble(_webhook(True), r"webhook.*(timed out|no answer)", 120.0),
    }  # fmt: skip


def _gone(name: str) -> Callable:
    def spoil(play: Play):
        path = play.project.folder / name
        whole = path.read_bytes()
        path.unlink()
        return {}, lambda: path.write_bytes(whole)

    return spoil


class Outcome(NamedTuple):
    """What must hold of a night in trouble, and what it said."""

    champion_same: bool
    status_1: bool
    woken: bool
    named: bool
    no_traceback: bool
    in_time: bool
    next_works: bool
    said: str
    next_said: str

    @property
    def passed(self) -> bool:
        return all(self[:-2])


def troubled(play: Play, trouble: Trouble, k: int) -> Outcome:
    """A night with news in trouble, and the next one, mended. The project has a champion."""
    play.woken.unlink(missing_ok=True)
    before = production(play)
    play.news(k)
    how, mend = trouble.spoil(play)
    ended = night(play, **how)
    after = production(play)
    told = play.woken.read_text() if play.woken.exists() else ""
    mend()
    again = night(play)
    learned = production(play)
    same = (before.run, before.files, before.disk) == (after.run, after.files, after.disk)
    around = trouble.may_work and ended.status in WORKED
    return Outcome(
        champion_same=after.disk == after.files if around else same,
        status_1=around or ended.status == 1,
        woken=around or bool(told),
        named=around or bool(re.search(trouble.cause, ended.said)),
        no_traceback="Traceback" not in ended.said,
        in_time=ended.seconds < trouble.limit_s,
        next_works=again.status in WORKED and learned.run > before.run and learned.disk == learned.files,
        said=ended.said,
        next_said=again.said,
    )


@contextlib.contextmanager
def on_a_small_disk(place: Path, size_mb: int = 64) -> Iterator[bool]:
    """A file system of that size at `place`; False where this user may not mount one."""
    place.mkdir(parents=True)
    mounted = not subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size_mb}m", "beadline", str(place)],
        capture_output=True,
        check=False,
    ).returncode
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "-l", str(place)], check=False)


def play_troubles(place: Path, only: Sequence[str], start: Callable[[Path], Play]) -> dict[str, Any]:
    """Each trouble in a project of its own, which has had its first night."""
    found = {}
    for name, trouble in troubles().items():
        if only and name not in only:
            continue
        with contextlib.ExitStack() as stack:
            if (
                name.startswith("disk_")
                and name != "disk_quota"
                and not stack.enter_context(on_a_small_disk(place / name))
            ):
                print(f"  skipped {name}: this user may not mount a file system", flush=True)
                continue
            play = start(place / name / "project")
            one = troubled(play, trouble, 1)
        found[name] = {"passed": one.passed, **one._asdict()}
        wrong = [key for key, value in one._asdict().items() if value is False]
        print(f"  {'ok  ' if one.passed else 'FAIL'} {name} {' '.join(wrong)}: {one.said[:200]}", flush=True)
        if not one.next_works:
            print(f"       next: {one.next_said[:200]}", flush=True)
    return found


def begun(folder: Path) -> Play:
    """A toy project after its first night."""
    play = toy(folder)
    first = night(play)
    assert first.status == 0, first
    return play


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", default="", help="names with commas between; kills is one")
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--real", action="store_true", help="kills in the project itself, at small sizes")
    parser.add_argument("--cache", type=Path, help="a DVC cache to copy from, with --real")
    a = parser.parse_args()
    only = [name for name in a.only.split(",") if name]
    if unknown := set(only) - {*troubles(), "kills"}:
        parser.error(
            f"{sorted(unknown)[0]} is nothing to play; there are {', '.join([*troubles(), 'kills'])}"
        )
    found: dict[str, Any] = {}
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="killed-") as name:
        place = Path(name).resolve()
        if not only or "kills" in only:
            make = (lambda at: real(place / at, a.cache)) if a.real else (lambda at: toy(place / at))
            found["real_kills" if a.real else "kills"] = kills(
                make, a.kills, a.seed, 1000 if a.real else TOYS
            )
        if not a.real and [name for name in only if name != "kills"] or not only and not a.real:
            found["troubles"] = play_troubles(place, only, begun)
    if "troubles" in found:
        rows = found["troubles"].values()
        print(f"  = troubles passed: {sum(row['passed'] for row in rows)} of {len(rows)}")
    for key in ("kills", "real_kills"):
        if key in found:
            print(f"  = {key}: {found[key]['passed']} of {found[key]['kills']} (bar all)")
    print(f"  {time.monotonic() - began:.0f} s")
    known = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    if "troubles" in found:
        found["troubles"] = known.get("troubles", {}) | found["troubles"]
    artifacts.write_json(RESULTS, known | found)


if __name__ == "__main__":
    main()
