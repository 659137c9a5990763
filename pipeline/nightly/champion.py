"""Who is in production: `champion.json` and `champion/<loop>.dvc`; promoted,
checked, put back to an earlier one bit by bit."""

import hashlib
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from pipeline.nightly.processes import dvc, fresh_index, git
from pipeline.store import artifacts

FILE, FOLDER = Path("champion.json"), Path("champion")
EMPTY: dict[str, Any] = {"schema": "champion", "version": 1, "champions": {}, "history": []}


def read() -> dict[str, Any]:
    """champion.json, or one without champions where there is none yet."""
    return artifacts.read_json(FILE) if FILE.exists() else {**EMPTY, "champions": {}, "history": []}


def md5s(folder: Path) -> dict[str, str]:
    """{path below the folder: MD5}, the hash that DVC's cache goes by."""
    files = sorted(file for file in folder.rglob("*") if file.is_file()) if folder.is_dir() else []
    return {file.relative_to(folder).as_posix(): _md5(file) for file in files}


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


def install(loop: str, files: Sequence[str], beside: Mapping[str, Any]) -> dict[str, Any]:
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
    return {"folder": pointer(loop), "files": md5s(FOLDER / loop), "outs": locked(files)}


def md5_of(files: Sequence[str]) -> dict[str, str]:
    """`md5s` of a folder that these files were installed in."""
    return {name.removeprefix("datasets/"): _md5(Path(name)) for name in sorted(files)}


def same(md5s: Mapping[str, str], files: Sequence[str]) -> bool:
    """Whether a champion's files are these, byte for byte."""
    return all(md5s.get(name) == md5 for name, md5 in md5_of(files).items())


def rolled_back(state: Mapping[str, Any], loop: str, files: Sequence[str]) -> str:
    """The run whose champion these very files are, where somebody has
    rolled it back since; empty otherwise."""
    run = ""
    for line in (line for line in state["history"] if line["loop"] == loop):
        if line["event"] == "rolled back" and same(line["replaced"], files):
            run = line["before"]
        elif same(line["champion"]["files"], files):
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


def promoted(state: Mapping[str, Any], loop: str, entry: Mapping[str, Any], *, event: str) -> dict[str, Any]:
    """champion.json with `entry` in production, and one more line of its history."""
    before = state["champions"].get(loop, {}).get("run")
    line = {
        "run": entry["run"],
        "loop": loop,
        "event": event,
        "when": entry["when"],
        "why": entry["why"],
        "before": before,
        "champion": dict(entry),
    }
    if event == "rolled back":
        line["replaced"] = state["champions"][loop]["files"]
    return {
        **state,
        "champions": {**state["champions"], loop: dict(entry)},
        "history": [*state["history"], line],
    }


# ---- the way back


def paths() -> list[str]:
    """What a commit of the champion holds."""
    return [str(FILE), f"{FOLDER}/.gitignore", *sorted(str(path) for path in FOLDER.glob("*.dvc"))]


def earlier(state: Mapping[str, Any], run: str, loop: str) -> dict[str, dict[str, Any]]:
    """{loop: entry} to go back to: those that were in production in `run`, or, where `run` is empty, before
    the present ones. Raises ValueError where there is none."""
    history = [line for line in state["history"] if not loop or line["loop"] == loop]
    entries: dict[str, dict[str, Any]] = {}
    for line in history:
        present = state["champions"][line["loop"]]
        if line["run"] == run or (not run and line["champion"]["folder"]["md5"] != present["folder"]["md5"]):
            entries[line["loop"]] = line["champion"]
    if run and entries:
        return entries
    if not run and entries:
        # only what was changed last goes back, unless a loop was named
        last = next(line["loop"] for line in reversed(history) if line["loop"] in entries)
        return {last: entries[last]}
    runs = ", ".join(dict.fromkeys(f"{line['run']} ({line['loop']})" for line in state["history"])) or "none"
    raise ValueError(
        f"{FILE}: expected {f'a champion of {run}' if run else 'an earlier champion'} to go back to, "
        f"found none; known are: {runs}"
    )


def put_back(loop: str, entry: Mapping[str, Any]) -> None:
    """champion/<loop> as `entry` has it: from DVC's cache, or pulled. Raises ValueError where a file is not
    what it was, and leaves the present champion then."""
    path = FOLDER / f"{loop}.dvc"
    present = path.read_bytes() if path.exists() else b""
    artifacts.write_text(path, yaml.safe_dump({"outs": [dict(entry["folder"])]}, sort_keys=False))
    try:
        _fetch(path)
        wrong = sorted(set(md5s(FOLDER / loop).items()) ^ set(entry["files"].items()))
        if wrong:
            raise ValueError(
                f"{FOLDER / loop}: {wrong[0][0]} is not what it was in {entry['run']}; "
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
    head = set(git("ls-tree", "-r", "--name-only", "HEAD", "--", str(FILE), str(FOLDER)).splitlines())
    for path in {*head, *paths()}:
        if path not in head and Path(path).exists():
            Path(path).unlink()
            mended.append(f"{path} was never committed and is removed")
    changed = git("diff", "--name-only", "HEAD", "--", str(FILE), str(FOLDER)).splitlines() if head else []
    if changed:
        git("checkout", "-q", "HEAD", "--", *changed)
        mended.append(f"{', '.join(changed)} put back to the last commit")
    if mended:
        fresh_index([str(FILE), str(FOLDER)])
    for left in FOLDER.glob(".*.new"):
        shutil.rmtree(left)
    for left in FOLDER.glob(".*.old"):
        shutil.rmtree(left)
    for loop, entry in read()["champions"].items():
        if md5s(FOLDER / loop) != entry["files"]:
            put_back(loop, entry)
            mended.append(f"{FOLDER / loop} put back to {entry['run']}")
    for folder in FOLDER.iterdir() if FOLDER.is_dir() else ():
        if folder.is_dir() and folder.name not in read()["champions"] and not folder.name.startswith("."):
            shutil.rmtree(folder)
            mended.append(f"{folder} was never committed and is removed")
    return mended
