"""Manages production: champion.json and champion/<loop>.dvc in git, champion/<loop> beside them. The last
commit decides, and the folders follow it."""

import contextlib
import ctypes
import hashlib
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from pipeline.nightly import worktree
from pipeline.nightly.processes import STATE, dvc, git, names
from pipeline.nightly.records import (
    DRIFT_ACCEPTED,
    ROLLED_BACK,
    Champion,
    ChampionState,
    HistoryLine,
    from_json,
)
from pipeline.nightly.worktree import COPY, Snapshot
from pipeline.store import artifacts

FILE, FOLDER = Path("champion.json"), Path("champion")
EXCHANGE, HERE = 2, -100  # RENAME_EXCHANGE and AT_FDCWD of renameat2


def read(commit: str = "HEAD") -> ChampionState:
    """Returns champion.json of a commit, or a state without champions if it has none. Raises ValueError if
    the file is broken."""
    text = git("show", f"{commit}:{FILE}", check=False)
    try:
        fields = json.loads(text or "{}", object_hook=_drop_metrics)
        return from_json(ChampionState, fields)
    except (ValueError, TypeError) as error:
        raise ValueError(
            f"{FILE} of the last commit: {error}; take the file of a good commit (git log {FILE}), "
            "and commit it"
        ) from None


def _drop_metrics(fields: dict[str, Any]) -> dict[str, Any]:
    """Removes the metrics that older versions of champion.json contain."""
    return {key: value for key, value in fields.items() if key != "metrics"}


def md5s(folder: Path) -> dict[str, str]:
    """Returns {path below the folder: MD5}, the hash that DVC's cache uses."""
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    return {file.relative_to(folder).as_posix(): md5_of(file) for file in files}


def md5_of(path: Path | str) -> str:
    with Path(path).open("rb") as stream:
        return hashlib.file_digest(stream, "md5").hexdigest()


def same(md5_by_path: Mapping[str, str], files: Sequence[str]) -> bool:
    """Returns whether a champion's files are identical to these."""
    return all(md5_by_path.get(name.removeprefix("datasets/")) == md5_of(name) for name in files)


def missing(files: Sequence[str]) -> list[str]:
    return [name for name in files if not Path(name).is_file()]


# ---- in the copy


def hand_over(
    folder: str, files: Sequence[str], beside: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, str]]:
    """Copies the files into champion/<folder>, writes the contents of `beside` there as JSON by name, and
    adds the folder to DVC. Returns what its pointer says, and MD5 by path."""
    place = FOLDER / folder
    for name in files:
        target = place / name.removeprefix("datasets/")
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(name, target)
    for name, content in beside.items():
        (place / name).unlink(missing_ok=True)  # it may be a link into DVC's cache
        artifacts.write_json(place / name, content)
    dvc("add", "--quiet", str(place))
    pointer = yaml.safe_load((FOLDER / f"{folder}.dvc").read_text(encoding="utf-8"))["outs"][0]
    hashes = md5s(place)
    # the cache files from which `bring` restores are on the disk before a commit names them
    for md5 in {pointer["md5"], *hashes.values()}:
        _write_through(Path(".dvc/cache/files/md5", md5[:2], md5[2:]))
    return pointer, hashes


def remove(folder: str) -> None:
    """Removes champion/<folder> and its pointer; DVC's cache keeps the files."""
    (FOLDER / f"{folder}.dvc").unlink(missing_ok=True)
    shutil.rmtree(FOLDER / folder, ignore_errors=True)


def bring(folder: str, champion: Champion) -> None:
    """Restores champion/<folder> exactly as it was for `champion`, from DVC's cache or by a pull. Raises
    ValueError if a file differs."""
    path = FOLDER / f"{folder}.dvc"
    pointer = yaml.safe_dump({"outs": [dict(champion.folder)]}, sort_keys=False)
    artifacts.write_text(path, pointer)
    if md5s(FOLDER / folder) == champion.files:
        return
    try:
        dvc("checkout", "--quiet", "--force", str(path))
    except ValueError:
        with contextlib.suppress(ValueError):
            dvc("pull", "--quiet", "--force", str(path))
    wrong = sorted(set(md5s(FOLDER / folder).items()) ^ set(champion.files.items()))
    if wrong:
        raise ValueError(
            f"{FOLDER / folder}: {wrong[0][0]} is not what it was in {champion.run}; "
            "bring DVC's cache or remote back, and run it again"
        )


def paths(state: ChampionState) -> list[str]:
    """Returns the paths that a commit of the champions contains. A deleted pointer is committed as
    deleted."""
    before = {path for path in names("ls-files", "--", str(FOLDER)) if path.endswith(".dvc")}
    after = {f"{FOLDER}/{folder}.dvc" for folder in state.folders}
    return [str(FILE), f"{FOLDER}/.gitignore", *sorted(before | after)]


# ---- in the project


def follow() -> list[str]:
    """Brings champion/ to the state of champion.json in the last commit, and returns which loops it changed.
    Each folder is replaced by a single rename, once all new files are on the disk."""
    state = read()
    stale = {name: one for name, one in state.folders.items() if md5s(FOLDER / name) != one.files}
    if stale and not COPY.exists():
        head = git("rev-parse", "HEAD")
        worktree.make_bare(Snapshot(head, head))
    for name, champion in stale.items():
        new = STATE / "production" / name
        with contextlib.chdir(COPY):
            bring(name, champion)
        shutil.rmtree(new, ignore_errors=True)
        shutil.copytree(COPY / FOLDER / name, new, copy_function=shutil.copyfile)
        for path in (*new.rglob("*"), new):
            _write_through(path)
        FOLDER.mkdir(exist_ok=True)
        exchange(new, FOLDER / name)
        _write_through(FOLDER)
    shutil.rmtree(STATE / "production", ignore_errors=True)
    for old in FOLDER.glob("*.candidate"):
        if old.name not in state.folders:
            shutil.rmtree(old)
    return [f"{FOLDER / name} is that of {one.run}" for name, one in stale.items()]


def exchange(new: Path, target: Path) -> None:
    """Exchanges `new` and `target`, by one rename if the system can, else by two."""
    rename = getattr(ctypes.CDLL(None), "renameat2", None)
    if target.exists() and rename and not rename(HERE, os.fsencode(new), HERE, os.fsencode(target), EXCHANGE):
        return
    if target.exists():
        target.rename(new.with_name(f"{new.name}.old"))
    new.rename(target)


def _write_through(path: Path) -> None:
    """Waits until a file or a folder's entries are on the disk, which a rename alone does not guarantee."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


# ---- what was in production before


def promote(
    state: ChampionState, loop: str, champion: Champion, *, event: str, when: str = "", why: str = ""
) -> ChampionState:
    """Returns the state with `champion` in production, and one more line of history. `when` and `why`: of
    this change; if they are empty, the champion's own are used."""
    before = state.champions.get(loop)
    replaced = before.files if before and event == ROLLED_BACK else {}
    line = HistoryLine(
        champion.run, loop, event, when or champion.when, why or champion.why,
        before.run if before else None, champion, replaced,
    )  # fmt: skip
    return state._replace(champions={**state.champions, loop: champion}, history=(*state.history, line))


def find_rolled_back(state: ChampionState, loop: str, files: Sequence[str]) -> str:
    """Returns the run whose champion has exactly these files, if somebody has rolled it back since; else
    ""."""
    run = ""
    for line in (line for line in state.history if line.loop == loop):
        if line.event == ROLLED_BACK and same(line.replaced, files):
            run = line.before or ""
        elif same(line.champion.files, files):
            run = ""
    return run


def stack(state: ChampionState, loop: str) -> list[tuple[int, Champion]]:
    """Returns the champions of a loop in the order of promotion, the present one last, each with the number
    of its line in the history. A champion that was rolled back is left out unless it was put back."""
    champions: list[tuple[int, Champion]] = []
    for number, line in enumerate(state.history):
        at = [k for k, (_, one) in enumerate(champions) if one.md5 == line.champion.md5]
        if line.loop != loop:
            continue
        if line.event == ROLLED_BACK and at:
            champions = champions[: at[-1] + 1]  # up to the one that was put back
        elif line.event == DRIFT_ACCEPTED:
            champions[-1] = (champions[-1][0], line.champion)
        else:
            champions.append((number, line.champion))
    return champions


def find_earlier(state: ChampionState, run: str, loop: str) -> dict[str, Champion]:
    """Returns {loop: champion} to go back to: those that were in production in `run`. If `run` is empty,
    returns the previous champion of `loop`, or of the loop with the latest promotion if `loop` is empty.
    Raises ValueError if there is none, or no such loop."""
    if loop and loop not in state.champions:
        loops = ", ".join(state.champions) or "none"
        raise ValueError(
            f"{FILE}: expected a loop with a champion, found {loop}; loops with a champion are: {loops}"
        )
    if run:
        lines = [line for line in state.history if line.run == run and loop in ("", line.loop)]
        champions = {line.loop: line.champion for line in lines}
        if champions and all(state.champions[name].md5 == former.md5 for name, former in champions.items()):
            raise ValueError(f"{FILE}: {run} is in production already; nothing is to be put back")
    else:
        stacks = {name: stack(state, name) for name in ([loop] if loop else state.champions)}
        latest = max(((one[-1][0], name) for name, one in stacks.items() if len(one) > 1), default=(0, ""))[1]
        champions = {latest: stacks[latest][-2][1]} if latest else {}
    if champions:
        return champions
    runs = ", ".join(dict.fromkeys(f"{line.run} ({line.loop})" for line in state.history)) or "none"
    raise ValueError(
        f"{FILE}: expected {f'a champion of {run}' if run else 'an earlier champion'} to go back to, "
        f"found none; known are: {runs}"
    )
