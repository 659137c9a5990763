"""git and dvc as they are, run as children of the night."""

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

STATE = Path(".beadline")
# in the environment of every child, so that the next night finds what a killed one left running
TOKEN = "BEADLINE_NIGHT"
FULL_MB = 10.0  # a disk with less room is the likeliest cause of what failed
FALLBACK = {"GIT_AUTHOR_NAME": "beadline nightly", "GIT_AUTHOR_EMAIL": "nightly@beadline.invalid"}


class TooLongError(ValueError):
    """What was run took longer than it may, and was ended."""


def git(
    *arguments: str, env: Mapping[str, str] | None = None, check: bool = True, place: Path | str = "", text=""
) -> str:
    """Standard output of `git ...`, in the worktree `place` if it is named; `text` is its input. Raises
    ValueError with git's own reason if it fails and `check` is on."""
    ended = subprocess.run(
        ["git", *(("-C", str(place)) if place else ()), *arguments],
        check=False,
        capture_output=True,
        encoding="utf-8",
        errors="surrogateescape",  # as Python names files whose names are no text
        # a recording may be called [1].csv, which git would take for a pattern
        env={**os.environ, "GIT_LITERAL_PATHSPECS": "1", **(env or {})},
        input=text,
    )
    if check and ended.returncode:
        lines = [line.strip() for line in ended.stderr.splitlines() if line.strip()]
        why = [line for line in lines if line.startswith(("fatal:", "error:"))] or lines
        raise ValueError(
            f"git {arguments[0]} failed: {why[-1] if why else f'exit status {ended.returncode}'}"
        )
    return "" if ended.returncode else ended.stdout.rstrip("\n")


def names(
    command: str, *rest: str, env: Mapping[str, str] | None = None, place: Path | str = ""
) -> list[str]:
    """The paths that `git ... -z` prints, whatever characters they have. Raises ValueError if it fails."""
    return [name for name in git(command, "-z", *rest, env=env, place=place).split("\0") if name]


def changed(*places: str, untracked: str = "no") -> list[str]:
    """Paths below `places` (none: everywhere) that differ from the last commit; both names of one that was
    renamed. `untracked` is git's word: no, normal or all."""
    how = ("--porcelain", "--no-renames", f"--untracked-files={untracked}")
    # two letters and a blank, either letter a blank too
    return [entry[3:] for entry in names("status", *how, "--", *places)]


def configure(settings: Mapping[str, str]) -> dict[str, str]:
    """The environment in which git goes by these settings, beside those that the environment has already."""
    before = int(os.environ.get("GIT_CONFIG_COUNT", "0") or 0)
    env = {"GIT_CONFIG_COUNT": str(before + len(settings))}
    for number, (key, value) in enumerate(settings.items(), start=before):
        env |= {f"GIT_CONFIG_KEY_{number}": key, f"GIT_CONFIG_VALUE_{number}": value}
    return env


def identity() -> dict[str, str]:
    """The user's name in git, or the job's own if none is set, as on a build machine."""
    author = {} if git("config", "user.email", check=False) else FALLBACK
    return author | {key.replace("AUTHOR", "COMMITTER"): value for key, value in author.items()}


def dvc(*arguments: str, log: Path | None = None, limit_s: float = 3600) -> str:
    """What `dvc ...` printed, run by this Python on the code of this folder. Raises ValueError with its own
    sentence if it fails, and TooLongError if it takes longer than `limit_s`; its process group ends with
    it."""
    target = log or STATE / "dvc.log"
    target.parent.mkdir(parents=True, exist_ok=True)
    env = os.environ | {
        "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")]),
        "PYTHONPATH": os.pathsep.join([str(Path.cwd()), os.environ.get("PYTHONPATH", "")]),
    }
    descriptor = os.open(target, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    try:
        child = subprocess.Popen(
            [sys.executable, "-m", "dvc", *arguments],
            stdout=descriptor,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            start_new_session=True,
            env=env,
        )
    finally:
        os.close(descriptor)
    try:
        status = child.wait(limit_s)
    except subprocess.TimeoutExpired:
        raise TooLongError(
            f"dvc {shlex.join(arguments)} was ended after {limit_s / 3600:.2g} h (nightly.longest_h)"
        ) from None
    finally:
        if child.poll() is None:
            os.killpg(child.pid, signal.SIGKILL)
            child.wait()
    text = target.read_text(encoding="utf-8", errors="replace")
    if status:
        # on a full disk the log is cut off, and says nothing
        free_mb = shutil.disk_usage(Path()).free / 1e6
        full = f"; no space left on device ({free_mb:.1f} MB); free some" if free_mb < FULL_MB else ""
        raise ValueError(f"dvc {arguments[0]} failed: {find_sentence(text)}{full}")
    return text


def find_sentence(text: str) -> str:
    """Of what dvc and its stages printed: the stage's own sentence if it has one, else dvc's last error."""
    lines = [line.strip() for line in text.replace("\r", "\n").splitlines() if line.strip()]
    stages = [line.split("'")[1] for line in lines if line.startswith("Running stage '")]
    own = [line for line in lines if stages and line.startswith(f"{stages[-1]}: ") and "|" not in line]
    errors = [line.removeprefix("ERROR: ") for line in lines if line.startswith("ERROR:")]
    reason = (own or errors or lines or ["it said nothing"])[-1]
    # a traceback or a full disk shows in the line before dvc's own
    before = [line for line in lines if "Error" in line and not line.startswith("ERROR:")]
    return reason if own or not before else f"{before[-1]} ({reason})"


# ---- what a killed night left


def end_orphans() -> int:
    """Ends what a killed night left running, for it would write beside this one; call with the lock held.
    How many there were; 0 if the system has no /proc."""
    ended = 0
    for entry in Path("/proc").glob("[0-9]*"):
        pid = int(entry.name)
        try:
            environment = (entry / "environ").read_bytes()
            if pid not in (os.getpid(), os.getppid()) and f"{TOKEN}={Path.cwd()}\0".encode() in environment:
                os.kill(pid, signal.SIGKILL)
                ended += 1
        except OSError:
            continue
    return ended


def remove_stale_locks() -> None:
    """Removes what a killed DVC left half written, and lock files of git if no git is at work here."""
    rwlock = Path(".dvc/tmp/rwlock")
    try:
        json.loads(rwlock.read_bytes() if rwlock.exists() else b"{}")
    except ValueError:  # half written: no later DVC would start
        rwlock.unlink(missing_ok=True)
    if not Path("/proc/self").exists() or any(map(_works_here, Path("/proc").glob("[0-9]*"))):
        return
    folder = Path(git("rev-parse", "--git-common-dir"))
    for pattern in ("*.lock", "refs/heads/**/*.lock", "refs/tags/**/*.lock"):
        for path in folder.glob(pattern):
            path.unlink(missing_ok=True)


def _works_here(entry: Path) -> bool:
    try:
        return (entry / "comm").read_text().strip() == "git" and (entry / "cwd").resolve() == Path.cwd()
    except OSError:
        return False
