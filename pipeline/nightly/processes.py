"""git and dvc as they are, run as children of the night; a commit that
never touches what the user has staged."""

import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

STATE = Path(".beadline")
# in the environment of every child, so that the next night finds what a killed one left running
TOKEN = "BEADLINE_NIGHT"
FALLBACK = {"GIT_AUTHOR_NAME": "beadline nightly", "GIT_AUTHOR_EMAIL": "nightly@beadline.invalid"}


# commits are on the disk before the night says so: git's default leaves loose objects in memory
DURABLE = {"core.fsync": "all"}
# a recording may be called [1].csv, which git would take for a pattern
LITERAL = {"GIT_LITERAL_PATHSPECS": "1"}


class TooLongError(ValueError):
    """What was run took longer than it may, and was ended."""


def git(*arguments: str, env: dict[str, str] | None = None, check: bool = True, place: str = "") -> str:
    """Standard output of `git ...`, in the worktree `place` where it is named. Raises ValueError with git's
    own reason where it fails and `check` is on."""
    return _output(arguments, env or {}, check=check, place=place).strip()


def names(*arguments: str, env: dict[str, str] | None = None) -> list[str]:
    """The paths that `git ... -z` prints, whatever characters they have. Raises ValueError where it fails."""
    command, *rest = arguments
    return [
        name for name in _output((command, "-z", *rest), env or {}, check=True, place="").split("\0") if name
    ]


def changed(*places: str, untracked: str = "no") -> list[str]:
    """Paths below `places` (none: everywhere) that differ from the last commit; both names of one that was
    renamed. `untracked` is git's word: no, normal or all."""
    entries = iter(names("status", "--porcelain", f"--untracked-files={untracked}", "--", *places))
    paths = []
    for entry in entries:
        paths.append(entry[3:])  # two letters and a blank, either letter a blank too
        if "R" in entry[:2] or "C" in entry[:2]:
            paths.append(next(entries))
    return paths


def _output(arguments: Sequence[str], env: dict[str, str], *, check: bool, place: str) -> str:
    ended = subprocess.run(
        ["git", *(("-C", place) if place else ()), *arguments],
        check=False,
        capture_output=True,
        encoding="utf-8",
        errors="surrogateescape",  # as Python names files whose names are no text
        env=os.environ | env,
        stdin=subprocess.DEVNULL,
    )
    if check and ended.returncode:
        raise ValueError(
            f"git {arguments[0]} failed: {_reason(ended.stderr) or f'exit status {ended.returncode}'}"
        )
    return ended.stdout if ended.returncode == 0 else ""


def configured(settings: dict[str, str]) -> dict[str, str]:
    """The environment in which git goes by these settings, beside those that the environment has already."""
    before = int(os.environ.get("GIT_CONFIG_COUNT", "0") or 0)
    env = {"GIT_CONFIG_COUNT": str(before + len(settings))}
    for number, (key, value) in enumerate(settings.items(), start=before):
        env |= {f"GIT_CONFIG_KEY_{number}": key, f"GIT_CONFIG_VALUE_{number}": value}
    return env


def dvc(*arguments: str, log: Path | None = None, limit_s: float = 3600) -> str:
    """What `dvc ...` printed. Raises ValueError with its own sentence where it fails, and TooLongError
    where it takes longer than `limit_s`; its whole process group ends with it."""
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
        raise TooLongError(
            f"dvc {shlex.join(arguments)} was ended after {limit_s / 3600:.2g} h (nightly.longest_h)"
        ) from None
    finally:
        if child.poll() is None:
            os.killpg(child.pid, signal.SIGKILL)
            child.wait()
    text = target.read_text(encoding="utf-8", errors="replace")
    if status:
        raise ValueError(f"dvc {arguments[0]} failed: {sentence(text)}")
    return text


def sentence(text: str) -> str:
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


def _reason(text: str) -> str:
    """What git died of; its last line where it does not say so."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return ([line for line in lines if line.startswith(("fatal:", "error:"))] or lines or [""])[-1]


# ---- commits


def identity() -> dict[str, str]:
    """The user's name in git, or the job's own where none is set, as on a build machine."""
    author = {} if git("config", "user.email", check=False) else FALLBACK
    return author | {key.replace("AUTHOR", "COMMITTER"): value for key, value in author.items()}


def contains(later: str, earlier: str) -> bool:
    """Whether commit `earlier` is `later`, or lies behind it."""
    return git("merge-base", earlier, later, check=False) == git("rev-parse", f"{earlier}^{{commit}}")


def check_attached() -> None:
    """Raises ValueError where HEAD is on no branch: what is committed there is lost with the next
    checkout."""
    if not git("symbolic-ref", "-q", "HEAD", check=False):
        raise ValueError(
            "expected a branch to be checked out, found a detached HEAD, where the night's commit would be "
            "lost; "
            "git switch to the branch that is in production, and run it again"
        )


def commit(paths: Sequence[str], message: str, *, branch: str = "", tip: str = "") -> str:
    """A commit of these paths as they are on disk over HEAD's tree. It moves HEAD; or `branch` where that is
    named, whose last commit so far is `tip`, and which then holds all that HEAD and `tip` hold. Its hash,
    empty where nothing differs. Raises ValueError where HEAD is to move and is on no branch.

    Built beside the user's index, so that what is staged stays staged; the last
    step is one reference that moves whole or not at all.
    """
    if not branch:
        check_attached()
    base = git("rev-parse", "HEAD")
    index = Path(git("rev-parse", "--git-dir")) / f"beadline-index.{os.getpid()}"
    durable = configured(DURABLE)
    env = {"GIT_INDEX_FILE": str(index.resolve())} | durable
    try:
        git("read-tree", base, env=env)
        tracked = names("ls-files", "--", *paths, env=env)
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
    if tree == git("rev-parse", f"{tip or base}^{{tree}}"):
        return ""
    parents = [
        parent
        for parent, other in ((base, tip), (tip, base))
        if parent and not (other and parent != other and contains(other, parent))
    ]
    made = git(
        "commit-tree", tree, *(word for parent in dict.fromkeys(parents) for word in ("-p", parent)),
        "-m", message, env=identity() | durable,
    )  # fmt: skip
    if branch:
        before = git("rev-parse", "-q", "--verify", f"refs/heads/{branch}", check=False)
        git("update-ref", "-m", message, f"refs/heads/{branch}", made, before or "0" * len(made), env=durable)
    else:
        git("update-ref", "-m", message, "HEAD", made, base, env=durable)
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


def stale_git_locks(*, older_than_s: float) -> list[Path]:
    """Lock files of git where no git is at work in this repository: a
    killed one's, which git itself never removes."""
    if not Path("/proc/self").exists() or any(_works_here(entry) for entry in Path("/proc").glob("[0-9]*")):
        return []
    folder = Path(git("rev-parse", "--git-dir"))
    return [
        path
        for pattern in ("*.lock", "refs/heads/**/*.lock", "beadline-index.*")
        for path in folder.glob(pattern)
        if time.time() - path.stat().st_mtime >= older_than_s
    ]


def _works_here(entry: Path) -> bool:
    try:
        return (entry / "comm").read_text().strip() == "git" and (entry / "cwd").resolve() == Path.cwd()
    except OSError:
        return False
