"""One file a stage. `run` is the frame of each: parameters, pins, and the switch of its loop."""

import importlib
import json
import os
import re
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).absolute().parents[1]
# for each section of params.yaml and params.expert.yaml the class that knows all its keys
SECTIONS = {
    "camera": "pipeline.deposition.settings:Camera",
    "certify": "stages.certify:Certify",
    "compose_parts": "pipeline.deposition.settings:ComposeParts",
    "evaluate_setpoint": "pipeline.setpoint.settings:EvaluateSetpoint",
    "evaluate_temperature": "stages.evaluate_temperature:EvaluateTemperature",
    "execution": "pipeline.store.params:Execution",
    "generate_probing": "pipeline.temperature.settings:GenerateProbing",
    "identify_plant": "stages.identify_plant:IdentifyPlant",
    "ingest": "stages.ingest:Ingest",
    "learn_kernel": "stages.learn_kernel:LearnKernel",
    "loops": "pipeline.store.params:Loops",
    "nightly": "pipeline.nightly.settings:Nightly",
    "panel": "pipeline.temperature.settings:Panel",
    "plant": "pipeline.temperature.settings:Plant",
    "printer": "pipeline.deposition.settings:Printer",
    "render_frames": "stages.render_frames:RenderFrames",
    "report": "pipeline.verdict.settings:ReportRules",
    "segment_library": "stages.segment_library:SegmentLibrary",
    "setpoint_material": "pipeline.setpoint.settings:SetpointMaterial",
    "tracking": "pipeline.temperature.settings:Tracking",
    "train_classifier": "pipeline.setpoint.settings:TrainClassifier",
    "train_ilc": "pipeline.deposition.settings:TrainIlc",
    "tune_weights": "pipeline.temperature.settings:TuneWeights",
}
# what a stage writes instead of its results if its loop is switched off
NOT_ASKED = {"asked": False}
# beside params.yaml: the digest of the files that were checked last, and their loops
CHECKED = ".dvc/tmp/params_checked.json"


def run(main: Callable[[], Any], stage: str, loop: str = "") -> None:
    """Runs a stage, or writes that it was not asked if `loops` switches its loop off. Bad parameters end the
    process with status 1 and one line."""
    from pipeline.store.pins import check_pins

    try:
        check_pins(stage)
        loops = check_parameters()
    except ValueError as error:
        from pipeline.store.printable import printable

        print(printable(f"{stage}: {'; '.join(str(error).splitlines())}"), file=sys.stderr)
        raise SystemExit(1) from None
    if loop and not loops[loop]:
        leave_out(stage)
    else:
        main()


def leave_out(stage: str) -> None:
    """Puts {"asked": false} in the place of everything that dvc.yaml names of a stage's results."""
    from pipeline.store import artifacts

    pipeline = Path("dvc.yaml").read_text(encoding="utf-8") if Path("dvc.yaml").exists() else ""
    metrics = artifacts.REPORTS / "metrics" / f"{stage}.json"
    with artifacts.stage(stage) as folder:
        for name in {"figures.json", *re.findall(rf"\bdatasets/{stage}/([\w./-]*\.\w+)", pipeline)}:
            artifacts.write_json(folder / name, NOT_ASKED)
        if str(metrics) in pipeline:
            artifacts.write_json(metrics, NOT_ASKED)


# ---- parameters


def check_parameters(path: str | Path = "params.yaml") -> dict[str, bool]:
    """Section `loops`, once every section of params.yaml and its neighbour fits its class.

    Raises ValueError with a line for each problem. Files that were checked once are not checked again.
    """
    if loops := checked_loops(path):
        return loops
    from pipeline.store import params

    params.check({section: model(section) for section in SECTIONS}, path)
    loops = params.load(params.Loops, "loops", path).model_dump()
    _remember(Path(path).parent / CHECKED, {"digest": _digest(path), "loops": loops})
    return loops


def checked_loops(path: str | Path = "params.yaml") -> dict[str, bool]:
    """Section `loops` of files that have not changed since they were checked; {} of others."""
    try:
        checked = json.loads((Path(path).parent / CHECKED).read_bytes())
        return checked["loops"] if checked["digest"] == _digest(path) else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}  # no memory, or not a whole one


def _digest(path: str | Path) -> int:
    """Of both files, and of the code that checks them."""
    modules = sorted({module.partition(":")[0] for module in SECTIONS.values()})
    code = [Path(__file__), *(ROOT / f"{module.replace('.', '/')}.py" for module in modules)]
    files = [Path(path), Path(path).with_name("params.expert.yaml"), *code]
    return zlib.crc32(b"\0".join(file.read_bytes() if file.is_file() else b"" for file in files))


def model(section: str) -> Any:
    """The class of a section."""
    module, _, name = SECTIONS[section].partition(":")
    return getattr(importlib.import_module(module), name)


def _remember(memory: Path, checked: dict[str, Any]) -> None:
    """Keeps what was checked, if this is a project of DVC that can be written."""
    beside = memory.with_name(f".{memory.name}.{os.getpid()}")
    try:
        if memory.parents[1].is_dir():
            memory.parent.mkdir(exist_ok=True)
            beside.write_text(json.dumps(checked))
            beside.replace(memory)
    except OSError:
        beside.unlink(missing_ok=True)
