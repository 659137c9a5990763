"""One night at a time, and a clean table: the lock, what a killed night left, files that are broken, room on
the disk, and what a failed night changed put back."""

import contextlib
import fcntl
import json
import os
import shutil
import time
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from pipeline.nightly import champion, remembered
from pipeline.nightly.processes import (
    STATE,
    TOKEN,
    commit,
    dvc,
    end_orphans,
    fresh_index,
    git,
    stale_git_locks,
)
from pipeline.store import artifacts

LOCK, RUNNING, RESERVE, BEFORE = STATE / "lock", STATE / "running.json", STATE / "reserve", STATE / "before"
RESERVE_BYTES = 1 << 20
LOCKED_S = 3600.0  # no git holds a lock for so long
METRICS, LOCKED = Path("reports/metrics"), "dvc.lock"
MARKERS = ("<<<<<<< ", ">>>>>>> ", "||||||| ")


class BusyError(ValueError):
    """Another night is at work."""


@contextlib.contextmanager
def alone() -> Iterator[list[str]]:
    """The night's lock, and what the one before left behind, as sentences. Raises BusyError where another
    night holds it, and ValueError where a merge is half done."""
    with locked():
        unmerged()
        mended = mend()
        RUNNING.touch()
        try:
            yield mended
        except ValueError:  # refused in a sentence, not killed
            RUNNING.unlink(missing_ok=True)
            raise
        RUNNING.unlink(missing_ok=True)


@contextlib.contextmanager
def locked() -> Iterator[None]:
    """The night's lock alone. Raises BusyError where another night holds it; the kernel lets go when a
    process dies."""
    if STATE.exists() and not STATE.is_dir():
        raise ValueError(
            f"{STATE}: expected the folder in which nights are remembered, found a file; "
            "move it away, and run it again"
        )
    STATE.mkdir(exist_ok=True)
    if not (STATE / ".gitignore").exists():
        artifacts.write_text(STATE / ".gitignore", "*\n")
    descriptor = os.open(LOCK, os.O_RDWR | os.O_CREAT)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(descriptor, 100, 0).decode(errors="replace").strip() or "unknown"
            raise BusyError(
                f"another night is at work (process {holder}); this one changed nothing; "
                "run it again when that has ended"
            ) from None
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        os.environ[TOKEN] = str(Path.cwd())
        yield
    finally:
        os.environ.pop(TOKEN, None)
        os.close(descriptor)


def mend() -> list[str]:
    """What a night that never ended left: its processes, git's locks,
    an index beside the user's, half a promotion."""
    killed = RUNNING.exists()
    mended = []
    if killed:
        if ended := end_orphans():
            mended.append(
                f"the night before was killed and had left {ended} processes running; they were ended"
            )
        for pattern in (
            ".champion.json.*",
            "champion/.*.dvc.*",
            "reports/.nightly.html.*",
            "reports/metrics/.nightly.json.*",
        ):
            for path in Path().glob(pattern):
                path.unlink(missing_ok=True)
        mended.append("the night before was killed")
    for path in stale_git_locks(older_than_s=0 if killed else LOCKED_S):
        path.unlink(missing_ok=True)
        mended.append(f"{path} was left by a killed git and is removed")
    mended += unreadable_rwlock()
    mended += champion.as_committed()
    if killed:
        fresh_index(["dvc.lock", str(METRICS), str(champion.FILE), str(champion.FOLDER)])
    return mended


def unreadable_rwlock() -> list[str]:
    """DVC's list of who reads and writes, where a DVC was killed in the middle of writing it: every later DVC
    refuses to start, and none mends it. One that is just being written is whole a second later."""
    path = Path(".dvc/tmp/rwlock")
    for wait_s in (1.0, 0.0):
        try:
            json.loads(path.read_bytes())
            return []
        except FileNotFoundError:
            return []
        except ValueError:
            time.sleep(wait_s)
    path.unlink(missing_ok=True)
    return [f"{path} was left half written by a killed DVC and is removed"]


def broken_champion() -> list[str]:
    """What is wrong with champion.json as it lies here, as sentences; a broken one is set aside, and put back
    as the last commit has it, or as the last one that has a whole one. Raises ValueError where none has."""
    try:
        champion.read()
        return []
    except remembered.MISSHAPEN as error:
        sentence = f"{error}".removesuffix(f"; {artifacts.remedy(champion.FILE)}")
        sentence = f"{sentence}; {remembered.set_aside(champion.FILE)}"
    whole = _last_whole_champion()
    if whole == "HEAD":
        return [f"{sentence}, and put back to the last commit"]
    paths = [str(champion.FILE), str(champion.FOLDER)]
    there = git("ls-tree", "-r", "--name-only", whole, "--", *paths).splitlines()
    git("checkout", "-q", whole, "--", *there)
    commit(champion.paths(), f"champion: as of {whole[:12]}, for champion.json was broken")
    return [f"{sentence}, and put back to that of commit {whole[:12]}"]


def _last_whole_champion() -> str:
    """HEAD, or the last commit before it whose champion.json can be read. Raises ValueError where there is
    none."""
    for revision in ("HEAD", *git("rev-list", "HEAD", "--", str(champion.FILE)).splitlines()):
        with contextlib.suppress(*remembered.MISSHAPEN):
            if champion.of_branch(revision).champions or revision == "HEAD":
                return revision
    raise ValueError(f"{champion.FILE}: no commit has a whole one; look at git log {champion.FILE}")


def whole_text(*names: str) -> None:
    """Raises ValueError, with file, line and remedy, where a file that the night is made from is missing or
    is not text, or where git's markers of a merge still stand in it."""
    for name in names:
        path = Path(name)
        if not path.is_file():
            raise ValueError(f"{name} is missing; restore it with git checkout HEAD -- {name}")
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except UnicodeDecodeError as error:
            raise ValueError(f"{name}: byte {error.start} is not UTF-8; {_remedy(name)}") from None
        if marked := next((k for k, line in enumerate(lines, 1) if line.startswith(MARKERS)), 0):
            raise ValueError(
                f"{name}: line {marked}: a merge was left half done, and its marker "
                f"{lines[marked - 1][:7]} still stands there; {_remedy(name)}"
            )


def whole_wiring() -> None:
    """Raises ValueError where dvc.yaml or dvc.lock is broken, in a sentence that dvc would not say."""
    for name in ("dvc.yaml", *([LOCKED] if Path(LOCKED).exists() else [])):
        whole_text(name)
        if problem := _no_stages(Path(name).read_text(encoding="utf-8")):
            raise ValueError(f"{name}: {problem}; {_remedy(name)}")


def _no_stages(text: str) -> str:
    """What is wrong with the text of a dvc.yaml or dvc.lock, empty where nothing is."""
    try:
        entries = yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None)
        return f"line {mark.line + 1}: {problem}" if mark else " ".join(str(error).split())
    stages = (entries.get("stages") or {}) if isinstance(entries, dict) else entries or {}
    whole = isinstance(stages, dict) and all(isinstance(stage, dict) for stage in stages.values())
    return "" if whole else "expected stages with keys below them, found none"


def _remedy(name: str) -> str:
    """How a broken file is mended: by its last whole version, where git has one."""
    for revision in ("HEAD", *git("rev-list", "HEAD", "--", name, check=False).splitlines()):
        text = git("show", f"{revision}:{name}", check=False)
        marked = any(line.startswith(MARKERS) for line in text.splitlines())
        if text and not marked and not _no_stages(text):
            return f"mend it, or take its last whole version (git checkout {revision[:12]} -- {name})"
    return "keep one of its two sides, and take the markers out"


def unmerged() -> None:
    """Raises ValueError where there is no git, or a merge, a rebase or the like is half done: nothing may be
    put right then."""
    if not git("rev-parse", "--verify", "-q", "HEAD", check=False):
        raise ValueError(
            "expected a git repository with at least one commit, found none; run git init, "
            "and commit the project"
        )
    folder = Path(git("rev-parse", "--git-dir"))
    for name, word in (
        ("MERGE_HEAD", "merge"),
        ("rebase-merge", "rebase"),
        ("rebase-apply", "rebase"),
        ("CHERRY_PICK_HEAD", "cherry-pick"),
        ("REVERT_HEAD", "revert"),
    ):
        if (folder / name).exists():
            raise ValueError(
                f"a {word} is under way in git; finish it (or give it up with git {word} "
                "--abort), and run it again"
            )


def ready(least_free_mb: float) -> None:
    """Raises ValueError where a night cannot end well: dvc's files are broken, or there is too little room.
    Keeps a reserve that a full disk's report is written from."""
    whole_wiring()
    free = shutil.disk_usage(Path()).free / 1e6
    if free < least_free_mb:
        raise ValueError(
            f"the disk has {free:.0f} MB left, but a night needs {least_free_mb:g} MB "
            "(nightly.least_free_mb); free some, or run ./run dvc gc --all-commits, which removes what no "
            "commit names"
        )
    if not RESERVE.exists() or RESERVE.stat().st_size < RESERVE_BYTES:
        artifacts.write_text(RESERVE, "0" * RESERVE_BYTES)


def remember_before() -> None:
    """dvc.lock and the metrics as they were before the night."""
    shutil.rmtree(BEFORE, ignore_errors=True)
    BEFORE.mkdir(parents=True)
    for path in (Path("dvc.lock"), *METRICS.glob("*.json")):
        if path.exists():
            (BEFORE / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, BEFORE / path)


def back_to_before(*, only: Collection[str] | None = None) -> list[str]:
    """A failed night changes nothing but the report: dvc.lock, metrics and what stages wrote to datasets are
    as before it. `only`: of these stages, those of the loops that failed; the others' stay as they are."""
    wiring = {} if only is None else _stages_of("dvc.yaml")
    names = None if only is None else {path for stage in only for path in _metrics(wiring.get(stage, {}))}
    for path in METRICS.glob("*.json"):
        ours = path.name != "nightly.json" if names is None else path.as_posix() in names
        if ours and not (BEFORE / path).exists():
            path.unlink()
    for path in (file.relative_to(BEFORE) for file in BEFORE.rglob("*") if file.is_file()):
        if path.as_posix() != LOCKED and (names is None or path.as_posix() in names):
            _put(BEFORE / path, path)
    before = _stages_of(BEFORE / LOCKED)
    if only is not None:
        now = {name: entry for name, entry in _stages_of(LOCKED).items() if name not in only}
        entries = now | {name: entry for name, entry in before.items() if name in only}
        artifacts.write_text(
            LOCKED, yaml.safe_dump({"schema": "2.0", "stages": entries}, sort_keys=False, allow_unicode=True)
        )
    elif (BEFORE / LOCKED).exists():
        _put(BEFORE / LOCKED, Path(LOCKED))
    else:
        Path(LOCKED).unlink(missing_ok=True)
    stages = [name for name in before if only is None or name in only]
    if not stages:
        return []
    try:
        # what the stages made, and no more: recordings that DVC keeps may hold what it has not seen yet
        dvc("checkout", "--quiet", "--force", *stages)
    except ValueError as error:
        return [
            f"datasets could not be put back to the last good run ({error}); "
            "the next dvc repro makes them again"
        ]
    return []


def _put(source: Path, target: Path) -> None:
    with artifacts.beside(target) as temporary:
        shutil.copyfile(source, temporary)


def _stages_of(path: str | Path) -> dict[str, Any]:
    """The stages of dvc.yaml or of a dvc.lock; none where there is no such file."""
    text = Path(path).read_text(encoding="utf-8") if Path(path).exists() else ""
    return (yaml.safe_load(text) or {}).get("stages") or {}


def _metrics(stage: Mapping[str, Any]) -> list[str]:
    entries = [*stage.get("outs", []), *stage.get("metrics", [])]
    return [name for entry in entries for name in (entry if isinstance(entry, dict) else [entry])]
