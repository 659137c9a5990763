"""Who is in production: `champion.json` and `champion/<loop>.dvc`; promoted,
checked, put back to an earlier one bit by bit."""

import hashlib
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from pipeline.nightly.processes import dvc, fresh_index, git, names
from pipeline.nightly.records import (
    DRIFT_ACCEPTED,
    ROLLED_BACK,
    Champion,
    ChampionState,
    HistoryLine,
    Installed,
)
from pipeline.store import artifacts

FILE, FOLDER = Path("champion.json"), Path("champion")


def read() -> ChampionState:
    """champion.json, or one without champions where there is none yet."""
    return ChampionState.read(artifacts.read_json(FILE)) if FILE.exists() else ChampionState()


def of_branch(branch: str) -> ChampionState:
    """champion.json as the last commit of `branch` has it."""
    text = git("show", f"{branch}:{FILE}", check=False)
    return ChampionState.read(json.loads(text)) if text else ChampionState()


def write(state: ChampionState) -> None:
    """champion.json; on the disk, with the pointers and the files that it speaks of, before this returns."""
    artifacts.write_json(FILE, state.to_json())
    for path in (*map(Path, paths()), *_files(FOLDER), *_cached(state)):
        if path.exists():
            _sync(path)
    for folder in (Path(), *([FOLDER, *(path for path in FOLDER.rglob("*") if path.is_dir())])):
        if folder.is_dir():
            _sync(folder)


def _sync(path: Path) -> None:
    """Waits until a file or a folder's entries are on the disk, which a rename alone does not ask for."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _cached(state: ChampionState) -> list[Path]:
    """Where DVC's own cache keeps the champions' files, which `put_back` takes them from."""
    champions = state.folders.values()
    hashes = {md5 for champion in champions for md5 in (champion.md5, *champion.installed.files.values())}
    return [Path(".dvc/cache/files/md5") / md5[:2] / md5[2:] for md5 in sorted(hashes)]


def write_state(state: ChampionState, place: Path) -> None:
    """champion.json and the pointers of what it names, and no others, below `place`."""
    artifacts.write_json(place / FILE, state.to_json())
    for pointer in (place / FOLDER).glob("*.dvc"):
        if pointer.stem not in state.folders:
            pointer.unlink()
    for folder, champion in state.folders.items():
        write_pointer(folder, champion, place)


def write_pointer(loop: str, champion: Champion, place: Path = Path()) -> None:
    """champion/<loop>.dvc of this champion, below `place`, and its line in champion/.gitignore."""
    folder = place / FOLDER
    outs = {"outs": [dict(champion.installed.folder)]}
    artifacts.write_text(folder / f"{loop}.dvc", yaml.safe_dump(outs, sort_keys=False))
    ignored = folder / ".gitignore"
    lines = ignored.read_text(encoding="utf-8").splitlines() if ignored.exists() else []
    if f"/{loop}" not in lines:
        artifacts.write_text(ignored, "\n".join([*lines, f"/{loop}"]) + "\n")


def md5s(folder: Path) -> dict[str, str]:
    """{path below the folder: MD5}, the hash that DVC's cache goes by."""
    return {file.relative_to(folder).as_posix(): _md5(file) for file in _files(folder)}


def _files(folder: Path) -> list[Path]:
    return sorted(file for file in folder.rglob("*") if file.is_file()) if folder.is_dir() else []


def _md5(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "md5").hexdigest()


def locked(paths: Sequence[str]) -> dict[str, str]:
    """{out: hash} as dvc.lock has them, of the outs that hold these files."""
    lock = yaml.safe_load(Path("dvc.lock").read_text(encoding="utf-8"))
    outs = {
        out["path"]: out["md5"]
        for stage in lock.get("stages", {}).values()
        for out in stage.get("outs", [])
        if "md5" in out
    }
    return {out: outs[out] for out in sorted(outs) if any(f"{path}/".startswith(f"{out}/") for path in paths)}


# ---- promotion


def install(loop: str, files: Sequence[str], beside: Mapping[str, Any]) -> Installed:
    """Copies the files into champion/<loop>, with what is to lie beside them as JSON by name, and hands the
    folder to DVC; what `put_back` needs to have it again.

    A file is copied beside and renamed whole; until the commit, HEAD still has the champion before it.
    """
    new = FOLDER / f".{loop}.new"
    shutil.rmtree(new, ignore_errors=True)
    for name in files:
        target = new / name.removeprefix("datasets/")
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(name, target)
    for name, content in beside.items():
        artifacts.write_json(new / name, content)
    _swap(new, FOLDER / loop)
    dvc("add", "--quiet", str(FOLDER / loop))
    return Installed(pointer(loop), md5s(FOLDER / loop), locked(files))


def removed(folder: str) -> None:
    """champion/<folder> and its pointer are gone; DVC's cache keeps the files."""
    if (FOLDER / f"{folder}.dvc").exists():
        dvc("remove", "--quiet", str(FOLDER / f"{folder}.dvc"))
    shutil.rmtree(FOLDER / folder, ignore_errors=True)


def md5_of(files: Sequence[str]) -> dict[str, str]:
    """`md5s` of a folder that these files were installed in."""
    return {name.removeprefix("datasets/"): _md5(Path(name)) for name in sorted(files)}


def same(md5s: Mapping[str, str], files: Sequence[str]) -> bool:
    """Whether a champion's files are these, byte for byte."""
    return all(md5s.get(name) == md5 for name, md5 in md5_of(files).items())


def rolled_back(state: ChampionState, loop: str, files: Sequence[str]) -> str:
    """The run whose champion these very files are, where somebody has
    rolled it back since; empty otherwise."""
    run = ""
    for line in (line for line in state.history if line.loop == loop):
        if line.event == ROLLED_BACK and same(line.replaced or {}, files):
            run = line.before or ""
        elif same(line.champion.installed.files, files):
            run = ""
    return run


def missing(files: Sequence[str]) -> list[str]:
    return [name for name in files if not Path(name).is_file()]


def _swap(new: Path, target: Path) -> None:
    old = new.with_name(f".{target.name}.old")
    shutil.rmtree(old, ignore_errors=True)
    if target.exists():
        target.rename(old)
    new.rename(target)
    shutil.rmtree(old, ignore_errors=True)


def pointer(loop: str) -> dict[str, Any]:
    """What champion/<loop>.dvc says of the folder."""
    return yaml.safe_load((FOLDER / f"{loop}.dvc").read_text(encoding="utf-8"))["outs"][0]


def in_production(
    state: ChampionState, loop: str, champion: Champion, *, event: str, when: str = "", why: str = ""
) -> ChampionState:
    """The state with `champion` in production, and one more line of its history: `when` and `why` it went
    there, which are the champion's own where they are empty."""
    before = state.champions.get(loop)
    line = HistoryLine(
        champion.run,
        loop,
        event,
        when or champion.when,
        why or champion.why,
        before.run if before else None,
        champion,
        before.installed.files if before and event == ROLLED_BACK else None,
    )
    champions = {**state.champions, loop: champion}
    return state._replace(champions=champions, history=(*state.history, line))


# ---- the way back


def paths() -> list[str]:
    """What a commit of the champion holds; a pointer that is gone is committed as gone."""
    tracked = {path for path in names("ls-files", "--", str(FOLDER)) if path.endswith(".dvc")}
    return [
        str(FILE),
        f"{FOLDER}/.gitignore",
        *sorted(tracked | {str(path) for path in FOLDER.glob("*.dvc")}),
    ]


def standing(state: ChampionState, loop: str) -> list[tuple[int, Champion]]:
    """Champions of a loop in the order in which they were promoted, the present one last, each with the
    number of its line in the history. One that was rolled back is none of them any more, unless it was put
    back."""
    stack: list[tuple[int, Champion]] = []
    for number, line in enumerate(state.history):
        if line.loop != loop:
            continue
        if line.event == ROLLED_BACK:
            # down to the one that was put back; where that had gone itself, it comes on top
            at = [k for k, (_, champion) in enumerate(stack) if champion.md5 == line.champion.md5]
            stack = stack[: at[-1] + 1] if at else [*stack, (number, line.champion)]
        elif line.event == DRIFT_ACCEPTED and stack:
            stack[-1] = (stack[-1][0], line.champion)
        else:
            stack.append((number, line.champion))
    return stack


def earlier(state: ChampionState, run: str, loop: str) -> dict[str, Champion]:
    """{loop: champion} to go back to: those that were in production in `run`. Where `run` is empty, the one
    before the present one: of the loop whose present one was promoted last, unless `loop` is named. Raises
    ValueError where there is none, or no such loop."""
    if loop and loop not in state.champions:
        loops = ", ".join(state.champions) or "none"
        raise ValueError(
            f"{FILE}: expected a loop with a champion, found {loop}; loops with a champion are: {loops}"
        )
    history = [line for line in state.history if not loop or line.loop == loop]
    if run:
        champions = {line.loop: line.champion for line in history if line.run == run}
        if champions and all(state.champions[name].md5 == former.md5 for name, former in champions.items()):
            raise ValueError(f"{FILE}: {run} is in production already; nothing is to be put back")
    else:
        stacks = {name: standing(state, name) for name in ([loop] if loop else state.champions)}
        latest = max(((stack[-1][0], name) for name, stack in stacks.items() if len(stack) > 1), default=None)
        champions = {latest[1]: stacks[latest[1]][-2][1]} if latest else {}
    if champions:
        return champions
    runs = ", ".join(dict.fromkeys(f"{line.run} ({line.loop})" for line in state.history)) or "none"
    raise ValueError(
        f"{FILE}: expected {f'a champion of {run}' if run else 'an earlier champion'} to go back to, "
        f"found none; known are: {runs}"
    )


def put_back(loop: str, champion: Champion) -> None:
    """champion/<loop> as it was of `champion`: from DVC's cache, or pulled. Raises ValueError where a file is
    not what it was, and leaves the present champion then."""
    path = FOLDER / f"{loop}.dvc"
    present = path.read_bytes() if path.exists() else b""
    write_pointer(loop, champion)
    try:
        _fetch(path)
        wrong = sorted(set(md5s(FOLDER / loop).items()) ^ set(champion.installed.files.items()))
        if wrong:
            raise ValueError(
                f"{FOLDER / loop}: {wrong[0][0]} is not what it was in {champion.run}; "
                "bring DVC's cache or remote back, and run it again"
            )
    except ValueError:
        if present:
            artifacts.write_text(path, present.decode())
            _fetch(path)
        raise


def _fetch(path: Path) -> None:
    try:
        dvc("checkout", "--quiet", "--force", str(path))
    except ValueError:
        dvc("pull", "--quiet", "--force", str(path))


def as_committed() -> list[str]:
    """Puts champion.json, champion/*.dvc and the folders back to what HEAD says, which is what a killed
    promotion never was; what it mended, as sentences."""
    mended = []
    head = set(names("ls-tree", "-r", "--name-only", "HEAD", "--", str(FILE), str(FOLDER)))
    for path in {*head, *paths()}:
        if path not in head and Path(path).exists():
            Path(path).unlink()
            mended.append(f"{path} was never committed and is removed")
    changed = names("diff", "--name-only", "HEAD", "--", str(FILE), str(FOLDER)) if head else []
    if changed:
        git("checkout", "-q", "HEAD", "--", *changed)
        mended.append(f"{', '.join(changed)} put back to the last commit")
    if mended or names("diff", "--cached", "--name-only", "HEAD", "--", str(FILE), str(FOLDER)):
        # where git's index was locked after a promotion, it still stages the champion before
        fresh_index([str(FILE), str(FOLDER)])
    for unfinished in (*FOLDER.glob(".*.new"), *FOLDER.glob(".*.old")):
        shutil.rmtree(unfinished)
    champions = read().folders
    for loop, champion in champions.items():
        if md5s(FOLDER / loop) != champion.installed.files:
            put_back(loop, champion)
            mended.append(f"{FOLDER / loop} put back to {champion.run}")
    for folder in FOLDER.iterdir() if FOLDER.is_dir() else ():
        if folder.is_dir() and folder.name not in champions and not folder.name.startswith("."):
            shutil.rmtree(folder)
            mended.append(f"{folder} was never committed and is removed")
    return mended
