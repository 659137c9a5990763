"""A branch into the one that is checked out where nights run: promotions that wait, or the nights and commits
of somebody else. The next night judges what both together teach.

The merge is made in a worktree of its own, below .beadline. The checkout is brought to it when it is whole,
and may have what nights leave there: dvc.lock and metrics of a night that committed nothing, and new
recordings.
"""

import contextlib
import shutil
from collections.abc import Generator
from pathlib import Path

from pipeline.nightly import champion, guarding
from pipeline.nightly.branches import joined
from pipeline.nightly.processes import (
    LITERAL,
    STATE,
    check_attached,
    configured,
    contains,
    dvc,
    fresh_index,
    git,
    identity,
    names,
)
from pipeline.nightly.records import ChampionState
from pipeline.recordings import excluded

PLACE = STATE / "merge"
# made by nights: where both sides have them anew ours stay, and the next night makes them again
MADE = ("dvc.lock", "reports/metrics")
# a checkout's hooks, as DVC's own, are of the checkout and not of the worktree
QUIET = {"core.hooksPath": "/dev/null"}


def merge(branch: str) -> str:
    """Merges `branch`, and says what is in production then. Of what nights make, the side that has it anew
    counts, and ours where both have; of champions, as `branches.joined` says. Raises ValueError, with nothing
    changed, where people's own files conflict, or are changed here and not committed."""
    with guarding.alone():
        check_attached()
        theirs = git("rev-parse", "-q", "--verify", f"{branch}^{{commit}}", check=False)
        if not theirs:
            raise ValueError(f"{branch} is no branch of this repository; git branch -a lists them")
        head = git("rev-parse", "HEAD")
        if contains(head, theirs):
            return f"{branch} has nothing that is not here already"
        with _worktree(head):
            new = _merged(branch, head, theirs)
        behind = _bring(head, new, branch)
        mended = champion.as_committed()
        present = champion.read().champions
        runs = ", ".join(f"{name} is {one.run}" for name, one in present.items()) or "no loop has a champion"
        wrong = [sentence for sentence in (*behind, *mended) if "could not" in sentence]
        return "; ".join([f"{branch} is merged: {runs}", *wrong])


@contextlib.contextmanager
def _worktree(head: str) -> Generator[None]:
    """A worktree of HEAD at PLACE, gone afterwards; one that a killed merge left is gone before."""
    _remove()
    try:
        git("worktree", "add", "--quiet", "--detach", str(PLACE), head, env=configured(QUIET))
        yield
    finally:
        _remove()


def _remove() -> None:
    shutil.rmtree(PLACE, ignore_errors=True)
    git("worktree", "prune", check=False)


# ---- in the worktree


def _merged(branch: str, head: str, theirs: str) -> str:
    """The merge's commit; the branch's own where it holds all of HEAD."""
    place, env = str(PLACE), identity() | configured(QUIET)
    base = git("merge-base", head, theirs, check=False)
    if not base:
        raise ValueError(f"{branch} has no commit in common with this branch; merge it by hand")
    git("merge", "--no-commit", "--no-ff", "--no-edit", theirs, check=False, env=env, place=place)
    if not git("rev-parse", "-q", "--verify", "MERGE_HEAD", check=False, place=place):
        raise ValueError(f"{branch} cannot be merged; try it by hand: git merge {branch}")
    ours_anew = bool(git("diff", "--name-only", base, head, "--", *MADE))
    _take(head if ours_anew else theirs, MADE)
    _take(head, (str(champion.FILE), str(champion.FOLDER)))
    state = joined(champion.of_branch(head), champion.of_branch(theirs))
    if state != ChampionState():
        champion.write_state(state, PLACE)
    for path in _conflicts():
        if Path(path).name == excluded.FILE:
            both = [excluded.parse(git("show", f"{side}:{path}")) for side in (theirs, head)]
            excluded.write((PLACE / path).parent, both[0] | both[1])
            git("add", "--", path, place=place)
    if conflicts := _conflicts():
        raise ValueError(
            f"{branch} and this branch both changed {', '.join(conflicts)}; "
            f"merge them by hand (git merge {branch}), then run ./run beadline nightly"
        )
    git("add", "-A", "--", str(champion.FILE), str(champion.FOLDER), place=place, check=False)
    if base == head and git("write-tree", place=place) == git("rev-parse", f"{theirs}^{{tree}}"):
        return theirs
    git("commit", "-q", "--no-edit", "--no-verify", env=env, place=place)
    return git("rev-parse", "HEAD", place=place)


def _take(side: str, places: tuple[str, ...]) -> None:
    """These places as `side` has them; what it lacks stays as the merge made it."""
    if tracked := names("ls-tree", "-r", "--name-only", side, "--", *places):
        git("checkout", "-q", side, "--", *tracked, place=str(PLACE))


def _conflicts() -> list[str]:
    return [
        path
        for path in git("diff", "--name-only", "-z", "--diff-filter=U", place=str(PLACE)).split("\0")
        if path
    ]


# ---- in the checkout


def _bring(head: str, new: str, branch: str) -> list[str]:
    """HEAD and the checkout from `head` to `new`: files first, then the reference. What a killed one did of
    it is done when it runs again. Files of a night that committed nothing stay as they are. Raises ValueError
    where a file that the merge brings is another one here. What is left to do, as sentences."""
    paths = names("diff", "--name-only", "--no-renames", head, new)
    here = set(_different(head, paths))
    wanted = set(_different(new, paths))
    nights_own = {path for path in paths if any(f"{path}/".startswith(f"{made}/") for made in MADE)}
    blocked = sorted((here & wanted) - nights_own)
    if blocked:
        more = f" and {len(blocked) - 1} more" if len(blocked) > 1 else ""
        raise ValueError(
            f"{blocked[0]}{more}: expected as it was committed, found changed here, and {branch} brings "
            f"another; "
            "commit it, or move it away, and run it again"
        )
    there = set(names("ls-tree", "-r", "--name-only", new))
    update = sorted(wanted - (here & nights_own))
    for some in _pieces([path for path in update if path in there]):
        git("checkout", "-q", new, "--", *some, env=configured(QUIET) | LITERAL)
    for path in (path for path in update if path not in there):
        Path(path).unlink(missing_ok=True)
    git("update-ref", "-m", f"merge {branch}", "HEAD", new, head)
    for some in _pieces(paths):
        fresh_index(some)
    pointers = [
        path for path in update if path.endswith(".dvc") and not path.startswith(f"{champion.FOLDER}/")
    ]
    try:
        if pointers := [path for path in pointers if path in there]:
            dvc("checkout", "--quiet", *pointers)
    except ValueError as error:
        return [f"{', '.join(pointers)} could not be checked out ({error}); run dvc pull"]
    return []


def _different(commit: str, paths: list[str]) -> list[str]:
    """Those of `paths` whose file here is another than that of `commit`, or is there in one of the two
    alone."""
    index = Path(git("rev-parse", "--git-dir")).resolve() / "beadline-index.merge"
    env = {"GIT_INDEX_FILE": str(index)} | LITERAL
    try:
        git("read-tree", commit, env=env)
        differ = {
            path for some in _pieces(paths) for path in names("diff", "--name-only", "--", *some, env=env)
        }
        listed = {path for some in _pieces(paths) for path in names("ls-files", "--", *some, env=env)}
    finally:
        index.unlink(missing_ok=True)
    return [path for path in paths if path in differ or (path not in listed and _there(path))]


def _there(path: str) -> bool:
    return Path(path).exists() or Path(path).is_symlink()


def _pieces(paths: list[str]) -> list[list[str]]:
    """Few enough at a time for one command line."""
    return [paths[k : k + 200] for k in range(0, len(paths), 200)]
