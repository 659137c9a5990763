"""Runs git and dvc as child processes of a nightly run."""

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
# runs DVC for the nightly run whose process id is its first argument. If that run is killed, the kernel
# signals it, if it can (PR_SET_PDEATHSIG of prctl), and DVC ends together with its stages, which are in its
# process group. The stages themselves get no such signal
DVC = """
import ctypes, os, runpy, signal, sys
signal.signal(signal.SIGTERM, lambda *_: os.killpg(0, signal.SIGKILL))
prctl = getattr(ctypes.CDLL(None), "prctl", None)
prctl and prctl(1, signal.SIGTERM)
if os.getppid() != int(sys.argv.pop(1)):
    sys.exit("the night was killed before the kernel was asked")
runpy.run_module("dvc", run_name="__main__", alter_sys=True)
"""
FULL_MB = 10.0  # a disk with less room is the likeliest cause of what failed
FALLBACK = {"GIT_AUTHOR_NAME": "beadline nightly", "GIT_AUTHOR_EMAIL": "nightly@beadline.invalid"}


class TooLongError(ValueError):
    """A command took longer than allowed, and was ended."""


def git(
    *arguments: str, env: Mapping[str, str] | None = None, check: bool = True, place: Path | str = "", text=""
) -> str:
    """Returns the standard output of `git ...`, in the worktree `place` if given; `text` is its input. Raises
    ValueError with git's own reason if it fails and `check` is true."""
    ended = subprocess.run(
        ["git", *(("-C", str(place)) if place else ()), *arguments],
        check=False,
        capture_output=True,
        encoding="utf-8",
        errors="surrogateescape",  # as Python represents file names that are no text
        # a recording may be called [1].csv, which git would read as a pattern
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
    """Returns the paths that `git ... -z` prints, whatever characters they have. Raises ValueError if it
    fails."""
    return [name for name in git(command, "-z", *rest, env=env, place=place).split("\0") if name]


def configure(settings: Mapping[str, str]) -> dict[str, str]:
    """Returns the environment in which git uses these settings, in addition to those already in the
    environment."""
    before = int(os.environ.get("GIT_CONFIG_COUNT", "0") or 0)
    env = {"GIT_CONFIG_COUNT": str(before + len(settings))}
    for number, (key, value) in enumerate(settings.items(), start=before):
        env |= {f"GIT_CONFIG_KEY_{number}": key, f"GIT_CONFIG_VALUE_{number}": value}
    return env


def identity() -> dict[str, str]:
    """Returns the user's name in git, or the job's own if none is set, as on a build machine."""
    author = {} if git("config", "user.email", check=False) else FALLBACK
    return author | {key.replace("AUTHOR", "COMMITTER"): value for key, value in author.items()}


def dvc(*arguments: str, log: Path | None = None, limit_s: float = 3600) -> None:
    """Runs `dvc ...` with this Python on the code of this folder; `log` gets its output. Raises ValueError
    with its own sentence if it fails, and TooLongError if it takes longer than `limit_s`; then its process
    group ends with it."""
    target = log or STATE / "dvc.log"
    target.parent.mkdir(parents=True, exist_ok=True)
    first = {"PATH": str(Path(sys.executable).parent), "PYTHONPATH": str(Path.cwd())}
    paths = {key: os.pathsep.join([path, os.environ.get(key, "")]) for key, path in first.items()}
    descriptor = os.open(target, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    try:
        child = subprocess.Popen(
            [sys.executable, "-c", DVC, str(os.getpid()), *arguments],
            stdout=descriptor,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            start_new_session=True,
            env=os.environ | paths,
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
    if status:
        # on a full disk the log is incomplete and gives no reason
        free_mb = shutil.disk_usage(Path()).free / 1e6
        full = f"; no space left on device ({free_mb:.1f} MB); free some" if free_mb < FULL_MB else ""
        text = target.read_text(encoding="utf-8", errors="replace")
        raise ValueError(f"dvc {arguments[0]} failed: {find_sentence(text)}{full}")


def find_sentence(text: str) -> str:
    """Returns from the output of dvc and its stages the stage's own sentence if it has one, else dvc's last
    error."""
    lines = [line.strip() for line in text.replace("\r", "\n").splitlines() if line.strip()]
    stages = [line.split("'")[1] for line in lines if line.startswith("Running stage '")]
    own = [line for line in lines if stages and line.startswith(f"{stages[-1]}: ") and "|" not in line]
    errors = [line.removeprefix("ERROR: ") for line in lines if line.startswith("ERROR:")]
    reason = (own or errors or lines or ["it said nothing"])[-1]
    # a traceback or a full disk shows in the line before dvc's own
    before = [line for line in lines if "Error" in line and not line.startswith("ERROR:")]
    return reason if own or not before else f"{before[-1]} ({reason})"


def remove_stale_locks() -> None:
    """Removes half-written files of a killed DVC, and git's lock files if no git is running here. An editor
    may be open for hours during `git commit -a`, which holds its lock."""
    rwlock = Path(".dvc/tmp/rwlock")
    try:
        json.loads(rwlock.read_bytes() if rwlock.exists() else b"{}")
    except ValueError:  # half written: no later DVC would start
        rwlock.unlink(missing_ok=True)
    folder = Path(git("rev-parse", "--git-common-dir"))
    locks = [
        *folder.glob("*.lock"),
        *folder.glob("refs/heads/**/*.lock"),
        *folder.glob("refs/tags/**/*.lock"),
    ]
    if locks and not _git_works():
        for path in locks:
            path.unlink(missing_ok=True)


def _git_works() -> bool:
    """Returns whether a git process is running in the project; True if the system cannot tell."""
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if (entry / "comm").read_text().strip() != "git":
                continue
            folder = Path(os.readlink(entry / "cwd"))
        except PermissionError:  # it is another user's
            return True
        except OSError:  # it has ended
            continue
        if Path.cwd() in (folder, *folder.parents):
            return True
    return not Path("/proc/self").exists()
