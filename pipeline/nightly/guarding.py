"""One night at a time, and a clean table: the lock, what a killed night left, room on the
disk, and what a failed night changed put back."""

import contextlib
import fcntl
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import yaml

from pipeline.nightly import champion
from pipeline.nightly.processes import STATE, TOKEN, dvc, end_orphans, fresh_index, git, stale_git_locks
from pipeline.store import artifacts

LOCK, RUNNING, RESERVE, BEFORE = STATE / "lock", STATE / "running.json", STATE / "reserve", STATE / "before"
RESERVE_BYTES = 1 << 20
METRICS = Path("reports/metrics")


class BusyError(ValueError):
    """Another night is at work."""


@contextlib.contextmanager
def alone() -> Iterator[list[str]]:
    """The night's lock, and what the one before left behind, as sentences. Raises BusyError where another
    night holds it; the kernel lets go when a process dies."""
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
        mended = _after_a_kill()
        os.environ[TOKEN] = str(Path.cwd())
        RUNNING.touch()
        try:
            yield mended
        except ValueError:  # refused in a sentence, not killed
            RUNNING.unlink(missing_ok=True)
            raise
        RUNNING.unlink(missing_ok=True)
    finally:
        os.environ.pop(TOKEN, None)
        os.close(descriptor)


def _after_a_kill() -> list[str]:
    """What a night that never ended left: its processes, git's locks,
    an index beside the user's, half a promotion."""
    killed = RUNNING.exists()
    mended = []
    if killed:
        if ended := end_orphans():
            mended.append(
                f"the night before was killed and had left {ended} processes running; they were ended"
            )
        for path in stale_git_locks():
            path.unlink(missing_ok=True)
            mended.append(f"{path} was left by a killed git and is removed")
        for pattern in (
            ".champion.json.*",
            "champion/.*.dvc.*",
            "reports/.nightly.html.*",
            "reports/metrics/.nightly.json.*",
        ):
            for path in Path().glob(pattern):
                path.unlink(missing_ok=True)
        mended.append("the night before was killed")
    mended += champion.as_committed()
    if killed:
        fresh_index(["dvc.lock", str(METRICS), str(champion.FILE), str(champion.FOLDER)])
    return mended


def ready(least_free_mb: float) -> None:
    """Raises ValueError where a night cannot end well: no git, a merge or rebase half done, too little room.
    Keeps a reserve that a full disk's report is written from."""
    if not git("rev-parse", "--verify", "-q", "HEAD", check=False):
        raise ValueError(
            "expected a git repository with at least one commit, found none; run git init, "
            "and commit the project"
        )
    folder = Path(git("rev-parse", "--git-dir"))
    for name, word in (("MERGE_HEAD", "merge"), ("rebase-merge", "rebase"), ("rebase-apply", "rebase")):
        if (folder / name).exists():
            raise ValueError(
                f"a {word} is under way in git; finish it (or give it up with git {word} "
                "--abort), and run it again"
            )
    free = shutil.disk_usage(Path()).free / 1e6
    if free < least_free_mb:
        raise ValueError(
            f"the disk has {free:.0f} MB left, but a night needs {least_free_mb:g} MB "
            "(nightly.least_free_mb); free some space, or run dvc gc --all-commits"
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


def back_to_before() -> list[str]:
    """A failed night changes nothing but the report: dvc.lock, metrics and
    what stages wrote to datasets are as before it."""
    for path in METRICS.glob("*.json"):
        if not (BEFORE / path).exists() and path.name != "nightly.json":
            path.unlink()
    for path in (file for file in BEFORE.rglob("*") if file.is_file()):
        shutil.copyfile(path, path.relative_to(BEFORE))
    if not (BEFORE / "dvc.lock").exists():
        Path("dvc.lock").unlink(missing_ok=True)
        return []
    stages = (yaml.safe_load(Path("dvc.lock").read_text(encoding="utf-8")) or {}).get("stages")
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
