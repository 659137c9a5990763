"""Puts a run's results into the project: one commit of what it made in its copy, one tag for each promoted
loop, all references moved in one step. Then the project's files follow, production last. A note in .beadline
records a landing in progress, so that the next run, or a rollback, can finish it if it was killed."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from pipeline.nightly import champion, inputs, worktree
from pipeline.nightly.processes import STATE, configure, git, identity, names
from pipeline.nightly.records import from_json, to_json
from pipeline.nightly.worktree import COPY, Snapshot
from pipeline.store import artifacts

NOTE = STATE / "landing.json"
# written to the disk before the run reports it: git's default leaves loose objects in memory
DURABLE = {"core.fsync": "all"}


class Landing(NamedTuple):
    """A commit on its way into the project. `branch`, and `before`, its previous commit; `files`: the
    project's files when the run began; `tags` by name; `quarantined`: recordings that are set aside, {path:
    (loop, reason, digest)}; `lists` of excluded recordings that are not moved, {path: text}."""

    commit: str
    branch: str
    before: str
    files: str
    tags: Mapping[str, str]
    quarantined: Mapping[str, tuple[str, str, str]] = {}
    lists: Mapping[str, str] = {}


def get_branch() -> str:
    """Returns the reference of the branch that is checked out. Raises ValueError if there is none, because a
    commit would be lost with the next checkout."""
    branch = git("symbolic-ref", "-q", "HEAD", check=False)
    if not branch:
        raise ValueError(
            "expected a branch to be checked out, found a detached HEAD, where the night's commit would be "
            "lost; git switch to the branch that is in production, and run it again"
        )
    return branch


def check_head(snapshot: Snapshot, places: Sequence[str]) -> str:
    """Returns the present commit of HEAD. Raises ValueError if a commit since the snapshot changes something
    below `places`, which the run reads or writes, or if another branch is checked out."""
    head, branch = git("rev-parse", "HEAD"), git("symbolic-ref", "-q", "HEAD", check=False)
    if branch != snapshot.branch:
        raise ValueError(
            f"{branch or 'a detached HEAD'} was checked out while the night ran; nothing is changed, and the "
            "next night works from what is checked out then"
        )
    for name in names("diff", "--name-only", "--no-renames", snapshot.head, head):
        if inputs.lies_in(name, places):
            raise ValueError(
                f"{name} was committed while the night ran; nothing is changed, and the next night works "
                "from it"
            )
    return head


def commit(paths: Sequence[str], message: str, parents: Sequence[str]) -> str:
    """Commits these paths as they are in the copy, on the tree of the first parent. Returns the commit; "" if
    nothing differs. Moves no reference, and does not touch the user's index."""
    index = STATE / "index"
    Path(f"{index}.lock").unlink(missing_ok=True)  # of a git that was killed with its night
    env = {"GIT_INDEX_FILE": str(index.resolve())} | configure(DURABLE)
    git("read-tree", parents[0], env=env, place=COPY)
    tracked = names("ls-files", "--", *paths, env=env, place=COPY)
    existing = [
        path
        for path in paths
        if ((COPY / path).exists() or any(inputs.lies_in(name, [path]) for name in tracked))
        and not git("check-ignore", path, check=False, place=COPY)
        and not _is_linked(COPY, path)
    ]
    if existing:
        git("add", "-A", "--", *existing, env=env, place=COPY)
    # a link to another disk in the copy is a file in the project, and the other way round
    staged = names("diff", "--cached", "--name-only", "--no-renames", parents[0], env=env, place=COPY)
    linked = [name for name in staged if _is_linked(COPY, name) or _is_linked(Path(), name)]
    _call_with_paths("reset", "-q", parents[0], paths=linked, env=env, place=COPY)
    tree = git("write-tree", env=env, place=COPY)
    index.unlink()
    if tree == git("rev-parse", f"{parents[0]}^{{tree}}"):
        return ""
    ancestors = [word for parent in parents for word in ("-p", parent)]
    return git("commit-tree", tree, *ancestors, "-m", message, env=identity() | configure(DURABLE))


def _is_linked(root: Path, name: str) -> bool:
    """Returns whether a path below `root` is a link, or lies behind one."""
    return any((root / path).is_symlink() for path in (name, *Path(name).parents))


def move(references: Mapping[str, tuple[str, str]], message: str) -> None:
    """Moves references {name: (new, old)}, all or none; an old value of "" is not checked. Raises ValueError
    if one has moved meanwhile."""
    lines = [f"update {name} {new} {old}".rstrip() for name, (new, old) in references.items()]
    text = "\n".join(["start", *lines, "prepare", "commit", ""])
    git("update-ref", "-m", message, "--stdin", text=text, env=configure(DURABLE))


def land(landing: Landing, message: str) -> None:
    """Moves the branch and the tags to the commit; `finish` then brings the project's files to it."""
    artifacts.write_json(NOTE, to_json(landing))
    tags = {name: (commit, "") for name, commit in landing.tags.items()}
    move({landing.branch: (landing.commit, landing.before)} | tags, message)


def finish() -> list[str]:
    """Brings the project's files to a commit of a run, except files edited since. If the branch never reached
    that commit, drops it. Returns what was done, as sentences."""
    if not NOTE.exists():
        return []
    landing = from_json(Landing, artifacts.read_json(NOTE))
    if git("merge-base", landing.commit, landing.branch, check=False) != landing.commit:
        for name in landing.tags:
            git("update-ref", "-d", name, landing.commit, check=False)
        NOTE.unlink()
        return []
    for name, commit in landing.tags.items():
        git("update-ref", name, commit)
    notes = []
    if landing.branch == git("symbolic-ref", "-q", "HEAD", check=False):
        notes += _bring_files(landing)
        worktree.checkout(_changed_stages(landing))
    set_aside(landing.quarantined, landing.lists)
    champion.follow()
    NOTE.unlink()
    return notes


def _bring_files(landing: Landing) -> list[str]:
    """Brings the files of the commit into the project and its index."""

    def differ(*between: str) -> list[str]:
        return names("diff", "--name-only", "--no-renames", *between)

    paths = differ(landing.before, landing.commit)
    deleted = differ("--diff-filter=D", landing.before, landing.commit)
    staged = differ("--cached", landing.before)
    # no reference points to that commit, so git's clean-up may have removed it
    files = git("rev-parse", "-q", "--verify", f"{landing.files}^{{commit}}", check=False) or landing.before
    edited = differ(files)
    tracked = {*names("ls-tree", "-r", "--name-only", files)}
    # a file that git did not know when the run began, such as a new recording, is already there
    bring = [name for name in paths if name not in edited and (name in tracked or not Path(name).exists())]
    for name in {*bring} & {*deleted}:
        Path(name).unlink(missing_ok=True)
    written = [name for name in bring if name not in deleted]
    _call_with_paths("checkout", "-q", landing.commit, paths=written)
    unstaged = [name for name in paths if name not in staged and name not in written]
    _call_with_paths("reset", "-q", landing.commit, paths=unstaged)
    both = {*paths} & {*edited} & {*differ(landing.commit)}
    return [f"{name} was edited meanwhile and is left as it is" for name in sorted(both)]


def _changed_stages(landing: Landing) -> list[str]:
    """Returns the stages that ran; DVC's cache has their outputs."""
    before, after = (
        (yaml.safe_load(git("show", f"{commit}:dvc.lock", check=False) or "{}") or {}).get("stages", {})
        for commit in (landing.before, landing.commit)
    )
    return [name for name, entry in after.items() if before.get(name) != entry]


def _call_with_paths(*command: str, paths: Sequence[str], **how: Any) -> None:
    if paths:
        git(*command, "--pathspec-from-file=-", "--pathspec-file-nul", text="\0".join(paths), **how)


def set_aside(quarantined: Mapping[str, tuple[str, str, str]], lists: Mapping[str, str]) -> None:
    """Sets the project's recordings aside, each only if it is still the file that was judged, and writes the
    lists of those that are not moved."""
    for path, text in lists.items():
        if not Path(path).exists() or Path(path).read_text(encoding="utf-8") != text:
            artifacts.write_text(path, text)
    for path, (loop, reason, digest) in quarantined.items():
        if Path(path).exists() and artifacts.sha256(path) == digest:
            inputs.move_aside(path, loop, reason)
