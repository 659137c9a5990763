"""`./run beadline quick`: a first page at small sizes. The stages run as under DVC, in one process and a
folder of its own, at the sizes of params.quick.yaml. No network is trained, and nothing is exported."""

import contextlib
import copy
import importlib
import os
import resource
import shutil
import subprocess
import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

import stages
from pipeline.store import artifacts, params, params_text
from pipeline.verdict.settings import QUICK_LOOK

SIZES, FOLDER = Path("params.quick.yaml"), Path("quick")
# the sections whose sizes a quick look may set; what a machine is and what is good enough stay as they are
SECTIONS = (
    "evaluate_setpoint", "evaluate_temperature", "identify_plant", "panel", "train_ilc", "tune_weights",
)  # fmt: skip
# what takes minutes of training, taken from a full run that git keeps; frames are only rendered to train on
KEPT, TRAINED = Path("datasets/kept"), "train_classifier"
# certificates and exports come from a full run only
LEFT_OUT = ("render_frames", TRAINED, "certify", "export_controllers")
# folders that are only read; of the code the pages show the digest
LINKED = ("datasets/raw", "datasets/parts", "datasets/papers", "datasets/published", "pipeline", "stages")

Files = dict[str, dict[str, Any]]  # {name of a params file: its sections}


def quick() -> str:
    """Makes FOLDER anew, or leaves it as it was if a stage fails. What to print: the verdict of each loop,
    the page, and seconds by stage.

    Raises ValueError for a key of SIZES that no full run has or that may not be made smaller, and for kept
    files that are not whole; a stage that refuses its input ends the process as it does under DVC.
    """
    begun = time.perf_counter()
    files, smaller = smaller_sizes()
    root, rows = Path.cwd(), []
    with _fresh() as folder:
        loops = _furnish(folder, files, smaller, root)
        with contextlib.chdir(folder):
            for name, is_on in chosen_stages(files, loops, root / "dvc.yaml").items():
                rows.append(_run(name, is_on=is_on))
            report = artifacts.read_figures("report")
        for name in ("pipeline", "stages"):
            (folder / name).unlink()
    return summary(report["verdicts"], rows, time.perf_counter() - begun)


# ---- sizes


def smaller_sizes(
    path: Path = Path(params.FILE), sizes: Path = SIZES
) -> tuple[Files, list[tuple[str, str, str]]]:
    """Both params files with the smaller values in place, by file name; and (key, value here, value of a full
    run) of each. Raises ValueError for a section that is none of SECTIONS; other problems are those of the
    files that come out of it."""
    files, rows = copy.deepcopy(params.files(path)), []
    for section, keys in params.files(sizes)[str(sizes)].items():
        if section not in SECTIONS:
            raise ValueError(
                f"{sizes}: {section} is no section that a quick look makes smaller; "
                f"those are {', '.join(SECTIONS)}"
            )
        for dotted, value in _leaves(section, keys):
            home = params.home(dotted, path) or params.home(section, path)
            before = _put(files[home], dotted.split("."), value)
            rows.append((dotted, _shown(value), _shown(before)))
    return {Path(name).name: sections for name, sections in files.items()}, rows


def _leaves(dotted: str, value: Any) -> Iterator[tuple[str, Any]]:
    """(dotted key, value) of everything below a section."""
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            yield from _leaves(f"{dotted}.{key}", inner)
    else:
        yield dotted, value


def _put(sections: dict[str, Any], keys: Sequence[str], value: Any) -> Any:
    """Sets the value at these keys, which need not be known; what stood there."""
    *parents, last = keys
    for parent in parents:
        sections = sections.setdefault(parent, {})
    before, sections[last] = sections.get(last), value
    return before


def _shown(value: Any) -> str:
    return params_text.written(value, flow=True).removesuffix("...\n").strip()


def _check(folder: Path) -> dict[str, bool]:
    """Section `loops` of the files in the folder. Raises ValueError with a line for each problem of a
    section, as a stage does, by the names of the files that may have it."""
    try:
        return stages.check_parameters(folder / params.FILE)
    except ValueError as error:
        sentences = str(error)
        for name in (params.EXPERT, params.FILE):
            sentences = sentences.replace(f"{folder}/{name}", f"{SIZES} or {name}")
        raise ValueError(sentences) from None


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


def chosen_stages(files: Files, loops: Mapping[str, bool], pipeline: Path) -> dict[str, bool]:
    """{stage: whether its loop is on} in the order of dvc.yaml, in which each stands behind those whose
    results it reads, without LEFT_OUT. A classifier of somebody's own frames cannot be kept here: their
    setpoint loop is left out."""
    entries = YAML(typ="safe").load(pipeline.read_text(encoding="utf-8"))["stages"]
    skipped = {*LEFT_OUT, *(() if _renders(files) else ("evaluate_setpoint",))}
    switches = {f"loops.{loop}": is_on for loop, is_on in loops.items()}
    chosen = {}
    for name, entry in entries.items():
        keys = [key for key in entry.get("params", ()) if isinstance(key, str)]
        is_on = all(switches.get(key, True) for key in keys)
        if not is_on or name not in skipped:
            chosen[name] = is_on
    return chosen


def _source(files: Files, section: str) -> Any:
    return next((keys[section]["source"] for keys in files.values() if "source" in keys.get(section, {})), "")


def _renders(files: Files) -> bool:
    return _source(files, "train_classifier") != "recordings"


def _furnish(folder: Path, files: Files, smaller: list[tuple[str, str, str]], root: Path) -> dict[str, bool]:
    """Params, links to what is only read, the kept artifacts, and what every page says of a quick look; the
    loops that are on."""
    for name, sections in files.items():
        artifacts.write_text(folder / name, params_text.written(sections))
    loops = _check(folder)
    (folder / "datasets").mkdir()
    for name in LINKED:
        (folder / name).symlink_to(root / name)
    notes = ["Nothing is exported and no controller gets a certificate."]
    if loops["deposition"] and _source(files, "train_ilc") != "recordings":
        notes.append("The deposition loop learns from its measured flow: nothing is filmed.")
    if not _renders(files):
        notes.append(
            "The setpoint loop is left out: its classifier learns from your recordings in a full run."
        )
    elif loops["setpoint"]:
        commit = _copy_kept(folder)
        notes.append(
            f"The classifier is that of a full run, of commit {commit}, and the paper's agent the one "
            "of every run: nothing is trained."
        )
    artifacts.write_json(folder / QUICK_LOOK, {"notes": notes, "smaller": smaller})
    return loops


# ---- what is kept


def _copy_kept(folder: Path) -> str:
    """The kept artifacts in the places of their stages; the commit that they were made at. Raises ValueError
    if one is missing or not as it was kept."""
    index = KEPT / "kept.json"
    kept = artifacts.read_json(index) if artifacts.exists(index) else None
    if not isinstance(kept, dict) or not isinstance(kept.get("files"), dict):
        raise ValueError(f"{index}: expected commit and files of what is kept; git checkout {KEPT}")
    for name, digest in kept["files"].items():
        if not artifacts.exists(KEPT / name) or artifacts.sha256(KEPT / name) != digest:
            raise ValueError(
                f"{KEPT / name}: expected SHA-256 {digest[:8]} of kept.json; git checkout {KEPT}"
            )
        target = folder / "datasets" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(KEPT / name, target)
    return str(kept.get("commit"))


def keep() -> str:
    """Puts the classifier of this checkout's full run into KEPT, in place of the one before. Raises
    ValueError if there is none."""
    folder = Path("datasets", TRAINED)
    if not artifacts.exists(folder / "weights.safetensors"):
        raise ValueError(f"{folder}: expected what training left, found none; ./run dvc repro {TRAINED}")
    shutil.rmtree(KEPT / TRAINED, ignore_errors=True)
    found = (path for path in sorted(folder.rglob("*")) if path.is_file() and "live" not in path.parts)
    names = {path.relative_to("datasets").as_posix(): path for path in found}
    for name, path in names.items():
        (KEPT / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, KEPT / name)
    files = {name: artifacts.sha256(KEPT / name) for name in names}
    head = subprocess.run(
        ["git", "rev-parse", "--short=8", "HEAD"], capture_output=True, text=True, check=False
    )
    made = f"./run dvc repro {TRAINED}; ./run python -m pipeline.quick"
    artifacts.write_json(KEPT / "kept.json", {"commit": head.stdout.strip(), "made_by": made, "files": files})
    return f"{KEPT}: {len(files)} files kept of commit {head.stdout.strip()}; commit them"


# ---- the stages


def _run(name: str, *, is_on: bool) -> tuple[str, float, float]:
    """Runs one stage. Its name and its seconds, imports among them: on the wall, and of the CPU, that of its
    worker processes too."""
    wall, cpu = time.perf_counter(), cpu_s()
    if is_on:
        importlib.import_module(f"stages.{name}").main()
    else:
        stages.leave_out(name)
    return name, time.perf_counter() - wall, cpu_s() - cpu


def cpu_s() -> float:
    """CPU seconds of this process and of all processes below it: of those that were waited for, and, as
    workers outlive the stage that they work for, of those that live or were killed and not waited for. If
    the system has no /proc, the latter are missing."""
    waited_for = resource.getrusage(resource.RUSAGE_CHILDREN)
    ticks = sum(_ticks(pid) for pid in _children(os.getpid()))
    own = time.process_time() + waited_for.ru_utime + waited_for.ru_stime
    return own + ticks / os.sysconf("SC_CLK_TCK")


def _children(pid: int) -> list[int]:
    """The processes that `pid` started and has not waited for."""
    pids: list[int] = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):  # the thread has ended
            pids += map(int, task.read_text().split())
    return pids


def _ticks(pid: int) -> int:
    """CPU of a process, of the children that it waited for, and of all processes below it, in clock ticks."""
    below = sum(_ticks(child) for child in _children(pid))
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except OSError:  # it has ended
        return below
    # behind the name in brackets, which may hold blanks: utime, stime, cutime, cstime
    return below + sum(map(int, stat.rpartition(")")[2].split()[11:15]))


def summary(
    verdicts: Mapping[str, Mapping[str, Any]], rows: Sequence[tuple[str, float, float]], whole_s: float
) -> str:
    """Seconds by stage, a sentence a loop, and where the page lies."""
    lines = [f"{name:<22}{wall_s:>7.1f} s {cpu_s:>7.1f} s CPU" for name, wall_s, cpu_s in rows]
    sentences = [
        f"{loop}: {verdict['decision']} {verdict['lead']}".rstrip() for loop, verdict in verdicts.items()
    ]
    whole = f"{'whole':<22}{whole_s:>7.1f} s {sum(cpu_s for _, _, cpu_s in rows):>7.1f} s CPU"
    page = f"{FOLDER}/reports/index.html"
    return "\n".join([*lines, whole, *sentences, f"{page}: a quick look, not a full run"])


if __name__ == "__main__":  # for makers: git keeps the classifier that a full run of this checkout trained
    print(keep())
