"""git and dvc as they are, run as children of the night; a commit that
never touches what the user has staged."""

import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

STATE = Path(".beadline")
# in the environment of every child, so that the next night finds what a killed one left running
TOKEN = "BEADLINE_NIGHT"
FALLBACK = {"GIT_AUTHOR_NAME": "beadline nightly", "GIT_AUTHOR_EMAIL": "nightly@beadline.invalid"}


def git(*arguments: str, env: dict[str, str] | None = None, check: bool = True) -> str:
    """Standard output of `git ...`. Raises ValueError with git's last
    line where it fails and `check` is on."""
    ended = subprocess.run(
        ["git", *arguments],
        check=False,
        capture_output=True,
        text=True,
        env=os.environ | (env or {}),
        stdin=subprocess.DEVNULL,
    )
    if check and ended.returncode:
        raise ValueError(
            f"git {arguments[0]} failed: {_last(ended.stderr) or f'exit status {ended.returncode}'}"
        )
    return ended.stdout.strip() if ended.returncode == 0 else ""


def dvc(*arguments: str, log: Path | None = None, limit_s: float = 3600) -> str:
    """What `dvc ...` printed. Raises ValueError with its own sentence where it fails or takes longer than
    `limit_s`; its whole process group ends with it."""
    command = [sys.executable, "-m", "dvc", *arguments]
    target = log or STATE / "dvc.log"
    target.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(target, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    try:
        child = subprocess.Popen(
            command,
            stdout=descriptor,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )
    finally:
        os.close(descriptor)
    try:
        status = child.wait(limit_s)
    except subprocess.TimeoutExpired:
        raise ValueError(
            f"dvc {shlex.join(arguments)} was ended after {limit_s / 3600:.2g} h (nightly.longest_h)"
        ) from None
    finally:
        if child.poll() is None:
            os.killpg(child.pid, signal.SIGKILL)
            child.wait()
    text = target.read_text(encoding="utf-8", errors="replace")
    if status:
        raise ValueError(f"dvc {arguments[0]} failed: {_sentence(text)}")
    return text


def _sentence(text: str) -> str:
    """Of what dvc and its stages printed: the stage's own sentence
    where it has one, dvc's last error otherwise."""
    lines = [line.strip() for line in text.replace("\r", "\n").splitlines() if line.strip()]
    stages = [line.split("'")[1] for line in lines if line.startswith("Running stage '")]
    own = [line for line in lines if stages and line.startswith(f"{stages[-1]}: ") and "|" not in line]
    errors = [line.removeprefix("ERROR: ") for line in lines if line.startswith("ERROR:")]
    reason = (own or errors or lines or ["it said nothing"])[-1]
    # a traceback or a full disk shows in the line before dvc's own
    before = [line for line in lines if "Error" in line and not line.startswith("ERROR:")]
    return reason if own or not before else f"{before[-1]} ({reason})"


def _last(text: str) -> str:
    return next((line.strip() for line in reversed(text.splitlines()) if line.strip()), "")


# ---- commits


def identity() -> dict[str, str]:
    """The user's name in git, or the job's own where none is set, as on a build machine."""
    author = {} if git("config", "user.email", check=False) else FALLBACK
    return author | {key.replace("AUTHOR", "COMMITTER"): value for key, value in author.items()}


def commit(paths: Sequence[str], message: str, *, branch: str = "") -> str:
    """A commit of these paths as they are on disk, on top of HEAD; moves HEAD, or `branch` where it is named.
    Its hash, empty where nothing differs.

    Built beside the user's index, so that what is staged stays staged; the last
    step is one reference that moves whole or not at all.
    """
    base = git("rev-parse", "HEAD")
    index = Path(git("rev-parse", "--git-dir")) / f"beadline-index.{os.getpid()}"
    env = {"GIT_INDEX_FILE": str(index.resolve())}
    try:
        git("read-tree", base, env=env)
        tracked = set(git("ls-files", "--", *paths).splitlines())
        there = [
            path
            for path in paths
            if Path(path).exists() or any(name == path or name.startswith(f"{path}/") for name in tracked)
        ]
        if there:
            git("add", "-A", "--", *there, env=env)
        tree = git("write-tree", env=env)
    finally:
        index.unlink(missing_ok=True)
    if tree == git("rev-parse", f"{base}^{{tree}}"):
        return ""
    made = git("commit-tree", tree, "-p", base, "-m", message, env=identity())
    if branch:
        git("update-ref", "-m", message, f"refs/heads/{branch}", made)
    else:
        git("update-ref", "-m", message, "HEAD", made, base)
        fresh_index(paths)
    return made


def fresh_index(paths: Sequence[str]) -> None:
    """The user's index as HEAD has these paths: after a commit beside it,
    and after a night that was killed between the two."""
    git("reset", "-q", "HEAD", "--", *paths, check=False)


# ---- what a killed night left


def orphans() -> list[int]:
    """Processes with an earlier night's token in their environment; empty where the system has no /proc."""
    mine, pids = os.getpid(), []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if (
                int(entry.name) != mine
                and f"{TOKEN}={Path.cwd()}\0".encode() in (entry / "environ").read_bytes()
            ):
                pids.append(int(entry.name))
        except OSError:
            continue
    return pids


def end_orphans() -> int:
    """Ends what a killed night left running, for it would write beside this
    one; call with the lock held. How many there were."""
    pids = [pid for pid in orphans() if pid != os.getppid()]
    for pid in pids:
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            continue
    return len(pids)


def stale_git_locks() -> list[Path]:
    """Lock files of git where no git is at work in this repository: a
    killed one's, which git itself never removes."""
    if not Path("/proc/self").exists() or any(_works_here(entry) for entry in Path("/proc").glob("[0-9]*")):
        return []
    folder = Path(git("rev-parse", "--git-dir"))
    return [
        path
        for pattern in ("*.lock", "refs/heads/**/*.lock", "beadline-index.*")
        for path in folder.glob(pattern)
    ]


def _works_here(entry: Path) -> bool:
    try:
        return (entry / "comm").read_text().strip() == "git" and (entry / "cwd").resolve() == Path.cwd()
    except OSError:
        return False
