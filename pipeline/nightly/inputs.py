"""What a night depends on, as one digest, so that a night with nothing new ends in seconds; which recordings
are new, and where those go that cannot be learned from."""

import hashlib
import itertools
import shutil
from collections.abc import Mapping
from pathlib import Path

import yaml

from pipeline.nightly.settings import Loop
from pipeline.reading.signatures import METADATA
from pipeline.store import artifacts, params

QUARANTINE = Path("datasets/quarantine")


def sources() -> list[str]:
    """Files and folders that dvc.yaml's stages read and none of them writes;
    the files of parameters and dvc.yaml with them."""
    stages = yaml.safe_load(Path("dvc.yaml").read_text(encoding="utf-8")).get("stages", {})
    made = {
        name
        for stage in stages.values()
        for kind in ("outs", "metrics", "plots")
        for out in stage.get(kind, [])
        for name in _names(out)
    }
    read = {dep for stage in stages.values() for dep in stage.get("deps", [])} | {
        params.FILE,
        params.EXPERT,
        "dvc.yaml",
    }
    return sorted(
        dep
        for dep in read
        if not any(f"{dep}/".startswith(f"{out}/") for out in made) and dep != "reports/accepted.json"
    )


def _names(out: str | Mapping) -> list[str]:
    return [out] if isinstance(out, str) else list(out)


class Hashes:
    """SHA-256 by path, remembered with size and time of change, so that a
    gigabyte that did not change is not read every night."""

    def __init__(self, remembered: Mapping[str, list]):
        self.remembered = dict(remembered)
        self.now: dict[str, list] = {}

    def of(self, path: Path) -> str:
        status = path.stat()
        stamp = [status.st_size, status.st_mtime_ns, status.st_ino]
        before = self.remembered.get(str(path))
        same = bool(before) and before[:3] == stamp
        self.now[str(path)] = before if same else [*stamp, artifacts.sha256(path)]
        return self.now[str(path)][3]

    def below(self, place: str) -> dict[str, str]:
        """{path: digest} of a file, or of every file below a folder that a stage would read."""
        path = Path(place)
        files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
        relevant = [
            file
            for file in files
            if not any(part.startswith(".") or part == "__pycache__" for part in file.parts)
            and file.suffix != ".pyc"
        ]
        return {file.as_posix(): self.of(file) for file in relevant}


def contents(hashes: Hashes, places: list[str]) -> dict[str, str]:
    """{path: digest} of all that lies at `places`."""
    return {name: content for place in places for name, content in hashes.below(place).items()}


def digest(digests: Mapping[str, str]) -> str:
    """One digest over names and contents."""
    total = hashlib.sha256()
    for name, content in digests.items():
        total.update(f"{name}\0{content}\n".encode())
    return total.hexdigest()


def recordings(digests: Mapping[str, str], loop: Loop) -> dict[str, str]:
    """{path: digest} of the recordings below a loop's folder, of all that was found; notes and files of dvc
    are none. A bag of ROS 2 is one recording, as `ingest` reads it, under the path of its folder."""
    folder, notes = loop.recordings, (".md", ".txt", ".yaml", ".dvc")
    below = {name: content for name, content in digests.items() if folder and within(name, folder)}
    bags: dict[str, dict[str, str]] = {}
    if loop.judge == "temperature":
        parents = {str(Path(name).parent) for name in below if Path(name).name == METADATA} - {folder}
        # of a bag within a bag, the outer one is read
        bags = {bag: {} for bag in parents if not any(within(bag, other) for other in parents)}
    single: dict[str, str] = {}
    for name, content in below.items():
        bag = next((str(parent) for parent in Path(name).parents if str(parent) in bags), "")
        if bag:
            bags[bag][name] = content
        elif not name.lower().endswith(notes):
            single[name] = content
    return single | {bag: digest(files) for bag, files in bags.items()}


def within(name: str, folder: str) -> bool:
    """Whether a path lies below a folder."""
    return name.startswith(f"{folder}/")


def quarantine(path: str, loop: str, reason: str) -> str:
    """Moves the recording, a file or a bag, unchanged, to datasets/quarantine, where no stage looks and git
    does not either, its reason beside it; nothing there is overwritten. The reason."""
    name, folder = Path(path), QUARANTINE / loop
    folder.mkdir(parents=True, exist_ok=True)
    if not (QUARANTINE / ".gitignore").exists():
        artifacts.write_text(QUARANTINE / ".gitignore", "*\n")
    names = itertools.chain([name.name], (f"{name.stem}.{k}{name.suffix}" for k in itertools.count(2)))
    target = next(folder / free for free in names if not (folder / free).exists())
    shutil.move(path, target)
    artifacts.write_text(f"{target}.reason.txt", reason + "\n")
    return reason
