"""The inputs of a nightly run, as one digest, so that a run with nothing new ends in seconds. Also finds
which recordings are new, moves those that cannot be learned from, and lists changes that are in no commit."""

import hashlib
import itertools
import json
import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path

import yaml

from pipeline.nightly.processes import git, names
from pipeline.nightly.reproducing import outs_of, read_stages
from pipeline.nightly.settings import Nightly, NightlyLoop
from pipeline.recordings import excluded, plain_files
from pipeline.recordings.formats import METADATA
from pipeline.store import artifacts, params

QUARANTINE = Path("datasets/quarantine")


def sources() -> list[str]:
    """Returns the files and folders that dvc.yaml's stages read and no stage writes, with the parameter files
    and dvc.yaml."""
    stages = read_stages("dvc.yaml").values()
    made = [out for stage in stages for out in outs_of(stage)]
    read = {dep for stage in stages for dep in stage.get("deps", [])}
    read |= {params.FILE, params.EXPERT, "dvc.yaml"}
    return sorted(
        dep
        for dep in read
        if not any(f"{dep}/".startswith(f"{out}/") for out in made) and dep != "reports/accepted.json"
    )


def contents(places: Iterable[str], stamps: dict[str, list]) -> dict[str, str]:
    """Returns {path: SHA-256} of all files at or below `places` that a stage would read. `stamps` caches
    {path: [size, time of change, inode, digest]}, so that unchanged gigabytes are not read in every run.
    Raises ValueError for a name that is no text, for something that is no file, and for a file that cannot be
    read."""
    found = [path for place in places for path in (Path(place), *sorted(Path(place).rglob("*")))]
    files = [path for path in found if path.is_symlink() or (path.exists() and not path.is_dir())]
    digests = {}
    for file in files:
        hidden = any(part.startswith(".") or part == "__pycache__" for part in file.parts)
        if hidden or file.suffix == ".pyc" or plain_files.is_partial(file.name) or file.is_dir():
            continue
        _check(file)
        path, status = file.as_posix(), file.stat()
        stamp = [status.st_size, status.st_mtime_ns, status.st_ino]
        if stamps.get(path, [])[:3] != stamp:
            try:
                stamps[path] = [*stamp, artifacts.sha256(file)]
            except OSError as error:
                raise ValueError(
                    f"{path} cannot be read ({error.strerror}); make it readable, or move it away"
                ) from None
        digests[path] = stamps[path][3]
    return digests


def _check(file: Path) -> None:
    """Raises ValueError if a file's name is no text, which JSON cannot store, or if it is not a regular
    file."""
    try:
        file.as_posix().encode()
    except UnicodeEncodeError:
        shown = os.fsencode(file).decode("utf-8", "backslashreplace")
        raise ValueError(f"{shown}: expected a name in UTF-8, found bytes that are none; rename it") from None
    if not file.is_file():
        kind = "a link that leads nowhere" if file.is_symlink() else "a pipe or a device"
        raise ValueError(f"{file}: expected a file, found {kind}; move it away")


def digest(digests: Mapping[str, str]) -> str:
    """Returns one digest over names and contents."""
    total = hashlib.sha256()
    for name, content in sorted(digests.items()):
        total.update(f"{name}\0{content}\n".encode())
    return total.hexdigest()


def recordings(digests: Mapping[str, str], loop: NightlyLoop) -> dict[str, str]:
    """Returns {path: digest} of the recordings below a loop's folder. Notes, files of dvc and excluded
    recordings are left out. A ROS 2 bag is one recording, as `ingest` reads it, under the path of its
    folder."""
    folder, notes = loop.recordings, (".md", ".txt", ".yaml", ".dvc")
    if not folder:
        return {}
    below = {name: content for name, content in digests.items() if within(name, folder)}
    parents = {str(Path(name).parent) for name in below if Path(name).name == METADATA} - {folder}
    # of a bag within a bag, the outer one is read
    bags = [
        bag for bag in parents if loop.judge == "temperature" and not any(within(bag, one) for one in parents)
    ]
    every = {bag: digest({name: below[name] for name in below if within(name, bag)}) for bag in bags}
    every |= {
        name: content
        for name, content in below.items()
        if not lies_in(name, bags) and not name.lower().endswith(notes)
    }
    left_out = {path.as_posix() for path in excluded.exclusions(folder)}
    return {name: content for name, content in every.items() if not lies_in(name, left_out)}


def within(name: str, folder: str) -> bool:
    """Returns whether a path lies below a folder."""
    return name.startswith(f"{folder}/")


def lies_in(name: str, places: Iterable[str]) -> bool:
    """Returns whether a path is one of these, or lies below one."""
    return any(name == place or within(name, place) for place in places)


# ---- what cannot be learned from


def quarantine(path: str, loop: str, reason: str) -> str:
    """Sets a recording aside, a file or a bag, and returns the reason. It is moved unchanged to
    datasets/quarantine. If git or DVC keeps it, it is not moved but listed in excluded.yaml of its loop's
    folder. If it is still being written, it is left in place, and counts as another recording once
    complete."""
    if plain_files.wait_until_still([Path(path)]):
        return f"{reason} (it is still being written: it stays, and is looked at again)"
    if kept_by := keeper(Path(path)):
        folder = params.load(Nightly, "nightly").loops[loop].recordings
        excluded.exclude(path, folder, reason)
        return f"{reason} ({kept_by} keeps it: it stays, and is listed in {folder}/{excluded.FILE})"
    move_aside(path, loop, reason)
    return reason


def move_aside(path: str, loop: str, reason: str) -> None:
    """Moves a recording to datasets/quarantine, which stages and git ignore, and writes the reason beside it.
    Nothing there is overwritten."""
    name, aside = Path(path), QUARANTINE / loop
    aside.mkdir(parents=True, exist_ok=True)
    if not (QUARANTINE / ".gitignore").exists():
        artifacts.write_text(QUARANTINE / ".gitignore", "*\n")
    free = itertools.chain([name.name], (f"{name.stem}.{k}{name.suffix}" for k in itertools.count(2)))
    target = next(aside / free_name for free_name in free if not (aside / free_name).exists())
    shutil.move(path, target)
    artifacts.write_text(f"{target}.reason.txt", reason + "\n")


def keeper(path: Path) -> str:
    """Returns who has a version of what lies here: "git", "DVC", or "" for nobody. If the cache lacks the
    list of a folder's files, DVC is assumed to have it, so that nothing is lost."""
    if git("ls-files", "--", str(path), check=False):
        return "git"
    pointers = [folder.with_name(f"{folder.name}.dvc") for folder in (path, *path.parents) if folder.name]
    pointer = next((pointer for pointer in pointers if pointer.is_file()), None)
    if not pointer:
        return ""
    md5 = str(yaml.safe_load(pointer.read_text(encoding="utf-8"))["outs"][0]["md5"])
    files = Path(".dvc/cache/files/md5", md5[:2], md5[2:])
    if not md5.endswith(".dir") or not files.is_file():
        return "DVC"
    name = path.relative_to(pointer.with_suffix("")).as_posix()
    kept = [entry["relpath"] for entry in json.loads(files.read_text(encoding="utf-8"))]
    return "DVC" if any(lies_in(file, [name]) for file in kept) else ""


def read_lists(settings: Nightly, copy: Path) -> dict[str, str]:
    """Returns {path: text} of the lists of excluded recordings in the copy."""
    paths = [Path(loop.recordings) / excluded.FILE for loop in settings.loops.values() if loop.recordings]
    lists = [path for path in paths if (copy / path).is_file()]
    return {path.as_posix(): (copy / path).read_text(encoding="utf-8") for path in lists}


# ---- what no commit holds


def recorded_places(settings: Nightly) -> list[str]:
    """Returns the places of recordings. For a folder that DVC keeps, this is the pointer in git."""
    places = [*(loop.recordings for loop in settings.loops.values()), settings.holdout.recordings]
    pointers = {place: f"{place}.dvc" for place in places if place}
    return [pointer if Path(pointer).exists() else place for place, pointer in pointers.items()]


def find_uncommitted(settings: Nightly) -> list[str]:
    """Returns code, parameters and other sources that differ from the last commit, or are in none. Files that
    a run commits itself, such as recordings, are left out."""
    own = [
        "dvc.lock",
        "reports",
        "champion.json",
        "champion",
        "datasets/.gitignore",
        *recorded_places(settings),
    ]
    own += [loop.recordings for loop in settings.loops.values() if loop.recordings]
    paths = {*names("diff", "--name-only", "--no-renames", "HEAD")}
    code = [name for name in sources() if not lies_in(name, own)]
    paths |= {*(names("ls-files", "--others", "--exclude-standard", "--", *code) if code else ())}
    return sorted(path for path in paths if not lies_in(path, own))
