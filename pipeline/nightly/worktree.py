"""The temporary copy in which a run works: a git worktree below .beadline, with the project's files as they
are, its recordings, DVC's cache and its other caches. A run that is killed at any moment has changed
nothing."""

import contextlib
import fcntl
import os
import shutil
import time
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import NamedTuple

from pipeline.nightly import inputs
from pipeline.nightly.processes import STATE, configure, dvc, git, identity, names, remove_stale_locks
from pipeline.nightly.reproducing import read_stages
from pipeline.store import artifacts

LOCK, COPY, OLD = STATE / "lock", STATE / "copy", STATE / "copy.old"
LINKED = ("datasets/raw", "datasets/holdout")
# a younger recording may still grow: it is copied as it is, and the next run finds it changed
YOUNG_S = 600.0
LOCKED_S = 10  # how long to wait for a git that is running in the project


class BusyError(ValueError):
    """Another nightly run is in progress."""


class Snapshot(NamedTuple):
    """`head`: commit of HEAD when a run began; `files`: a commit of the tracked files as they were in the
    project then; `branch`: reference of the branch that was checked out, empty if there was none."""

    head: str
    files: str
    branch: str = ""


@contextlib.contextmanager
def locked() -> Generator[None]:
    """Holds the run's lock; the kernel releases it if the process dies. Raises BusyError if another run holds
    it, and ValueError if a file is in the place of a needed folder."""
    for folder, purpose in ((STATE, "in which nights are remembered"), (COPY, "in which a night works")):
        if folder.exists() and not folder.is_dir():
            raise ValueError(
                f"{folder}: expected the folder {purpose}, found a file; move it away, and run it again"
            )
    STATE.mkdir(exist_ok=True)
    if not (STATE / ".gitignore").exists():
        artifacts.write_text(STATE / ".gitignore", "*\n")
    descriptor = os.open(LOCK, os.O_RDWR | os.O_CREAT)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    except BlockingIOError:
        raise BusyError(
            "another night is at work; this one changed nothing; run it again when that has ended"
        ) from None
    finally:
        os.close(descriptor)


# ---- the copy


def take() -> Snapshot:
    """Returns a snapshot of the project. Raises ValueError if the project is no repository of its own, a
    merge in it is unfinished, git has files below a folder that is now a link, or git's lock is not
    released."""
    head = git("rev-parse", "--verify", "-q", "HEAD", check=False)
    if not head or git("rev-parse", "--show-prefix"):
        raise ValueError(
            "expected a git repository in this folder with at least one commit, found none; run git init, "
            "and commit the project"
        )
    lock = Path(git("rev-parse", "--git-path", "index.lock"))
    for _ in range(LOCKED_S):
        if lock.exists():
            time.sleep(1)
    if lock.exists():
        raise ValueError(
            f"{lock} is there: git works in the project, or was killed there; remove the file if no git "
            "runs, and run it again"
        )
    if unmerged := names("diff", "--name-only", "--diff-filter=U"):
        raise ValueError(f"{unmerged[0]}: a merge is half done in git; finish it, and run it again")
    folders = {folder for name in names("ls-files", "--", *LINKED) for folder in Path(name).parents}
    if links := sorted(str(folder) for folder in folders if folder.is_symlink()):
        raise ValueError(
            f"{links[0]} is a link, but the last commit has files below it; git add {links[0]}, and commit it"
        )
    branch = git("symbolic-ref", "-q", "HEAD", check=False)
    return Snapshot(head, git("stash", "create", env=identity()) or head, branch)


def make(snapshot: Snapshot, sources: Sequence[str]) -> None:
    """Makes the copy with everything that a run needs: the files that git has or does not have yet, those of
    `sources` that git ignores, recordings, caches, and the outputs of the stages."""
    make_bare(snapshot)
    for place in map(Path, LINKED):
        if (COPY / place).is_symlink():
            (COPY / place).unlink()
        shutil.rmtree(COPY / place, ignore_errors=True)
        if place.exists():
            link(place, COPY / place, sources)
    for name in (*names("ls-files", "--others", "--exclude-standard"), *sources):
        if Path(name).is_file() and not (COPY / name).exists():
            (COPY / name).parent.mkdir(parents=True, exist_ok=True)
            link(Path(name), COPY / name)
    memo = Path("datasets/memo")
    memo.mkdir(parents=True, exist_ok=True)
    (COPY / memo).parent.mkdir(exist_ok=True)
    (COPY / memo).symlink_to(memo.resolve())
    with contextlib.chdir(COPY), contextlib.suppress(ValueError):  # outputs in no cache are made again
        checkout([*read_stages("dvc.lock")], *map(str, Path("champion").glob("*.dvc")))


def make_bare(snapshot: Snapshot) -> None:
    """Makes the copy with only the files that git has, and DVC's settings."""
    remove()
    # hooks, such as DVC's own, are for the checkout and not for the copy
    quiet = configure({"core.hooksPath": "/dev/null"})
    # twice: also replaces a copy that was killed while git made it
    twice = ("--force", "--force")
    git("worktree", "add", "--quiet", "--detach", *twice, str(COPY), snapshot.files, env=quiet)
    _share_dvc()


def checkout(stages: Sequence[str], *pointers: str) -> None:
    """Restores the outputs of these stages as in dvc.lock, and those of these pointers. Raises ValueError if
    one is in no cache."""
    wired, locked_stages = read_stages("dvc.yaml"), read_stages("dvc.lock")
    known = [name for name in stages if name in wired and name in locked_stages]
    if known or pointers:
        dvc("checkout", "--quiet", "--force", *known, *pointers)


def _share_dvc() -> None:
    """Lets DVC in the copy use the project's cache and remotes, with absolute paths."""
    from dvc.config import Config

    shared = Config(dvc_dir=str(Path(".dvc").resolve()))
    local = Path(".dvc/config.local")
    if local.exists():
        shutil.copyfile(local, COPY / local)
    folder = str(shared["cache"].get("dir") or Path(".dvc/cache").resolve())
    cache = {**shared["cache"], "dir": folder, "type": ["reflink", "hardlink", "copy"]}
    (COPY / ".dvc/cache").symlink_to(folder)
    with Config(dvc_dir=str((COPY / ".dvc").resolve())).edit("local") as settings:
        settings["cache"] = cache
        settings["remote"] = {name: dict(remote) for name, remote in shared["remote"].items()}
    # DVC names its folder of known hashes after the age of this file, so the age must be the same in every
    # run
    btime = COPY / ".dvc/tmp/btime"
    btime.parent.mkdir(exist_ok=True)
    btime.touch()
    os.utime(btime, (0, 0))


def link(source: Path, target: Path, sources: Sequence[str] = ()) -> None:
    """Reproduces the tree of `source` with hard links, because DVC adds nothing below a folder that is itself
    a link. A file on another disk becomes a link. A file that may still grow is copied as it is; things that
    are no files are left out. A folder that is a link remains one, unless the run reads something below it
    (`sources`). Then what the run moves there is not the project's own file."""
    is_read = any(inputs.lies_in(name, [str(source)]) for name in sources)
    if source.is_dir() and source.is_symlink() and not is_read:
        target.symlink_to(source.resolve())
    elif source.is_dir():
        target.mkdir(parents=True, exist_ok=True)
        for entry in source.iterdir():
            link(entry, target / entry.name, sources)
    elif source.is_file() and 0 <= time.time() - source.stat().st_mtime < YOUNG_S:
        shutil.copy2(source, target)
    elif source.is_file():
        try:
            os.link(source.resolve(), target)
        except OSError:
            target.symlink_to(source.resolve())


def remove() -> None:
    """Removes the copy. It is renamed first, so that a stage of a killed run that still writes for a moment
    does not write into the next copy."""
    shutil.rmtree(OLD, ignore_errors=True)
    if COPY.is_symlink():
        COPY.unlink()
    with contextlib.suppress(OSError):  # no copy, or no space: then it is removed in place
        COPY.rename(OLD)
    for place in (OLD, COPY):
        shutil.rmtree(place, ignore_errors=True)
    git("worktree", "prune", check=False)


def clear_killed() -> list[str]:
    """Removes what a killed run left, and returns a note if there was any."""
    if not COPY.exists():
        return []
    remove_stale_locks()
    remove()
    return ["the night before was killed"]
