"""`./run beadline quick`: a first page at small sizes. The stages run as under DVC, in one process and a
folder of its own, at the sizes of params.quick.yaml. No network is trained, and nothing is exported."""

import contextlib
import copy
import importlib
import os
import shutil
import subprocess
import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ruamel.yaml import YAML

from pipeline.deposition.settings import TrainIlc
from pipeline.report.shared.sources import QUICK_LOOK
from pipeline.setpoint.settings import EvaluateSetpoint
from pipeline.store import artifacts, params, params_text
from pipeline.temperature.settings import Panel, TuneWeights
from stages.evaluate_temperature import EvaluateTemperature
from stages.identify_plant import IdentifyPlant

SIZES, FOLDER = Path("params.quick.yaml"), Path("quick")
# the sections whose sizes a quick look may set; what a machine is and what is good enough stay as they are
SECTIONS: Mapping[str, type[params.Section]] = {
    "evaluate_setpoint": EvaluateSetpoint,
    "evaluate_temperature": EvaluateTemperature,
    "identify_plant": IdentifyPlant,
    "panel": Panel,
    "train_ilc": TrainIlc,
    "tune_weights": TuneWeights,
}
# what takes minutes of training, taken from a full run that git keeps; frames are only rendered to train on
KEPT, TRAINED = Path("datasets/kept"), ("train_classifier", "train_agent")
# and what leaves the house only from a full run
LEFT_OUT = ("render_frames", *TRAINED, "export_controllers")
# read where it lies; of the code the pages show the digest
LINKED = ("datasets/raw", "datasets/parts", "datasets/papers", "datasets/published", "pipeline", "stages")


class Took(NamedTuple):
    """Seconds of one stage: on the wall, and of this process's CPU (its workers' not among them)."""

    stage: str
    wall_s: float
    cpu_s: float


class Sizes(NamedTuple):
    """Both params files with the smaller values in place, by file name; and (key, value here, value of a full
    run) of each."""

    files: dict[str, dict[str, Any]]
    smaller: list[tuple[str, str, str]]


def quick() -> str:
    """Makes FOLDER anew, or leaves it as it was where a stage fails. What to print: the verdict of each loop,
    the page, and seconds by stage.

    Raises ValueError for a key of SIZES that no full run has or may be made smaller, and for kept files that
    are not whole; a stage that refuses its input ends the process as it does under DVC.
    """
    begun = time.perf_counter()
    sizes, root = smaller_sizes(), Path.cwd()
    order = stages(sizes)
    with _fresh() as folder:
        _furnish(folder, sizes, root)
        with contextlib.chdir(folder):
            took = [_timed(name) for name in order]
            report = artifacts.read_metrics("report")
        for name in ("pipeline", "stages"):
            (folder / name).unlink()
    return summary(report["verdicts"], took, time.perf_counter() - begun)


# ---- sizes


def smaller_sizes(path: Path = Path(params.FILE), sizes: Path = SIZES) -> Sizes:
    """params.yaml at `path` and its neighbour with the values of `sizes` in place. Raises ValueError with a
    line for each key that is unknown, of another section than SECTIONS, or out of bounds."""
    whole = params.files(path)
    files, found, problems = copy.deepcopy(whole), [], []
    for section, keys in params.files(sizes)[str(sizes)].items():
        if section not in SECTIONS:
            problems.append(
                f"{sizes}: {section} is no section that a quick look makes smaller; "
                f"those are {', '.join(SECTIONS)}"
            )
            continue
        for dotted, value in _leaves(section, keys):
            home = params.home(dotted, path)
            if not home or dotted == section:
                problems.append(
                    f"{sizes}: {dotted} is unknown; remove it, or write a key of {path} or its neighbour"
                )
                continue
            before = _put(files[home], dotted.split("."), value)
            found.append((dotted, _shown(value), _shown(before)))
    if problems:
        raise ValueError("\n".join(problems))
    return Sizes({Path(name).name: sections for name, sections in files.items()}, found)


def _leaves(dotted: str, value: Any) -> Iterator[tuple[str, Any]]:
    """(dotted key, value) of everything below a section."""
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            yield from _leaves(f"{dotted}.{key}", inner)
    else:
        yield dotted, value


def _put(sections: dict[str, Any], keys: Sequence[str], value: Any) -> Any:
    """Sets the value at these keys; what stood there."""
    *parents, last = keys
    for parent in parents:
        sections = sections[parent]
    before, sections[last] = sections[last], value
    return before


def _shown(value: Any) -> str:
    return params_text.written(value, flow=True).removesuffix("...\n").strip()


def _check(folder: Path) -> None:
    """Raises ValueError where a value of SIZES is out of its bounds, as the stage would, by the name of the
    file that has it."""
    for section, model in SECTIONS.items():
        try:
            params.load(model, section, folder / params.FILE)
        except ValueError as error:
            told = str(error).replace(f"{folder}/{params.EXPERT}", f"{SIZES} or {params.EXPERT}")
            raise ValueError(told.replace(f"{folder}/{params.FILE}", f"{SIZES} or {params.FILE}")) from None


# ---- the folder


@contextlib.contextmanager
def _fresh() -> Generator[Path]:
    """An empty folder that becomes FOLDER when the body ends well. What killed calls left is removed."""
    for left in Path().glob(f".{FOLDER}.*.tmp"):
        pid = left.name.split(".")[2]
        if pid.isdigit() and int(pid) != os.getpid() and Path(f"/proc/{pid}").exists():
            continue
        if left.name.endswith(".old.tmp") and not FOLDER.exists():
            left.rename(FOLDER)
        else:
            shutil.rmtree(left)
    folder, retired = (Path(f".{FOLDER}.{os.getpid()}{end}.tmp") for end in ("", ".old"))
    folder.mkdir()
    try:
        yield folder
        if FOLDER.exists():
            FOLDER.rename(retired)
        folder.rename(FOLDER)
    finally:
        if retired.exists() and not FOLDER.exists():
            retired.rename(FOLDER)
        for left in (folder, retired):
            shutil.rmtree(left, ignore_errors=True)


def stages(sizes: Sizes) -> list[str]:
    """The stages of dvc.yaml in its order, each after those whose results it reads, without LEFT_OUT. A
    classifier of somebody's own frames cannot be kept here: their setpoint loop is left out."""
    names = YAML(typ="safe").load(Path("dvc.yaml").read_text(encoding="utf-8"))["stages"]
    skipped = {*LEFT_OUT, *(() if _rendered(sizes) else ("evaluate_setpoint",))}
    return [name for name in names if name not in skipped]


def _source(sizes: Sizes, section: str) -> Any:
    return next(
        (keys[section]["source"] for keys in sizes.files.values() if "source" in keys.get(section, {})), ""
    )


def _rendered(sizes: Sizes) -> bool:
    return _source(sizes, "train_classifier") != "recordings"


def _furnish(folder: Path, sizes: Sizes, root: Path) -> None:
    """Params, links to what is only read, the kept artifacts, and what every page says of a quick look."""
    for name, sections in sizes.files.items():
        artifacts.write_text(folder / name, params_text.written(sections))
    _check(folder)
    (folder / "datasets").mkdir()
    for name in LINKED:
        (folder / name).symlink_to(root / name)
    notes = ["Nothing is exported and no controller gets a certificate."]
    if _source(sizes, "train_ilc") != "recordings":
        notes.append("The deposition loop learns from its measured flow: nothing is filmed.")
    if _rendered(sizes):
        commit = _copy_kept(folder)
        notes.append(
            f"Classifier and agents are those of a full run, of commit {commit}: nothing is trained."
        )
    else:
        notes.append(
            "The setpoint loop is left out: its classifier learns from your recordings in a full run."
        )
    artifacts.write_json(folder / QUICK_LOOK, {"notes": notes, "smaller": sizes.smaller})


# ---- what is kept


def _copy_kept(folder: Path) -> str:
    """The kept artifacts in the places of their stages; the commit that they were made at. Raises ValueError
    where one is missing or not as it was kept."""
    index = KEPT / "kept.json"
    kept = artifacts.read_json(index) if artifacts.exists(index) else None
    if not isinstance(kept, dict) or not isinstance(kept.get("files"), dict):
        raise ValueError(f"{index}: expected commit and files of what is kept; git checkout {KEPT}")
    for name, digest in kept["files"].items():
        if not artifacts.exists(KEPT / name) or artifacts.sha256(KEPT / name) != digest:
            raise ValueError(
                f"{KEPT / name}: expected SHA-256 {digest[:8]} of kept.json; git checkout {KEPT}"
            )
        target = folder / (name if name.startswith("reports/") else f"datasets/{name}")
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(KEPT / name, target)
    return str(kept.get("commit"))


def keep() -> str:
    """Puts the classifier and the agents of this checkout's full run into KEPT, in place of those before.
    Raises ValueError where there is none."""
    found = [
        path
        for stage in TRAINED
        for path in sorted(Path("datasets", stage).rglob("*"))
        if path.is_file() and "live" not in path.parts
    ]
    figures = [Path("reports/metrics", f"{stage}.json") for stage in TRAINED]
    absent = [
        stage for stage in TRAINED if not artifacts.exists(Path("datasets", stage, "weights.safetensors"))
    ]
    if absent:
        raise ValueError(
            f"datasets/{absent[0]}: expected what training left, found none; ./run dvc repro {absent[0]}"
        )
    for name in (*TRAINED, "reports"):
        shutil.rmtree(KEPT / name, ignore_errors=True)
    names = {path.relative_to("datasets").as_posix(): path for path in found}
    names |= {path.as_posix(): path for path in figures}
    for name, path in names.items():
        (KEPT / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, KEPT / name)
    files = {name: artifacts.sha256(KEPT / name) for name in names}
    head = subprocess.run(
        ["git", "rev-parse", "--short=8", "HEAD"], capture_output=True, text=True, check=False
    )
    made = f"./run dvc repro {' '.join(TRAINED)}; ./run beadline quick --keep"
    artifacts.write_json(KEPT / "kept.json", {"commit": head.stdout.strip(), "made_by": made, "files": files})
    return f"{KEPT}: {len(files)} files kept of commit {head.stdout.strip()}; commit them"


# ---- the stages


def _timed(name: str) -> Took:
    """Runs one stage, its imports among its seconds."""
    wall, cpu = time.perf_counter(), time.process_time()
    importlib.import_module(f"stages.{name}").main()
    return Took(name, time.perf_counter() - wall, time.process_time() - cpu)


def summary(verdicts: Mapping[str, Mapping[str, Any]], took: Sequence[Took], whole_s: float) -> str:
    """Seconds by stage, a sentence a loop, and where the page lies."""
    rows = [f"{one.stage:<22}{one.wall_s:>7.1f} s {one.cpu_s:>7.1f} s CPU" for one in took]
    told = [f"{loop}: {of['decision']} {of['lead']}".rstrip() for loop, of in verdicts.items()]
    page = f"{FOLDER}/reports/index.html"
    return "\n".join(
        [*rows, f"{'whole':<22}{whole_s:>7.1f} s", *told, f"{page}: a quick look, not a full run"]
    )
