"""One file a stage. `run` is the frame of each: parameters, pins, and the switch of its loop."""

import importlib
import json
import re
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

# for each section of params.yaml and params.expert.yaml the class that knows all its keys
SECTIONS = {
    "camera": "pipeline.deposition.workflow.settings:Camera",
    "compose_parts": "pipeline.deposition.workflow.settings:ComposeParts",
    "evaluate_setpoint": "pipeline.setpoint.workflow.settings:EvaluateSetpoint",
    "evaluate_temperature": "pipeline.temperature.workflow.settings:EvaluateTemperature",
    "execution": "pipeline.store.params:Execution",
    "export_controllers": "pipeline.runtime.workflow.settings:ExportControllers",
    "generate_probing": "pipeline.temperature.workflow.settings:GenerateProbing",
    "identify_plant": "pipeline.temperature.workflow.settings:IdentifyPlant",
    "ingest": "pipeline.temperature.workflow.settings:Ingest",
    "learn_kernel": "pipeline.temperature.workflow.settings:LearnKernel",
    "loops": "pipeline.store.params:Loops",
    "nightly": "pipeline.nightly.settings:Nightly",
    "panel": "pipeline.temperature.workflow.settings:Panel",
    "plant": "pipeline.temperature.workflow.settings:Plant",
    "printer": "pipeline.deposition.workflow.settings:Printer",
    "render_frames": "pipeline.setpoint.workflow.settings:RenderFrames",
    "report": "pipeline.verdict.settings:ReportRules",
    "segment_library": "pipeline.deposition.workflow.settings:SegmentLibrary",
    "setpoint_material": "pipeline.setpoint.workflow.settings:SetpointMaterial",
    "tracking": "pipeline.temperature.workflow.settings:Tracking",
    "train_agent": "pipeline.setpoint.workflow.settings:TrainAgent",
    "train_classifier": "pipeline.setpoint.workflow.settings:TrainClassifier",
    "train_ilc": "pipeline.deposition.workflow.settings:TrainIlc",
    "tune_weights": "pipeline.temperature.workflow.settings:TuneWeights",
}
# what a stage writes instead of its results if its loop is switched off
NOT_ASKED = {"asked": False}
# beside params.yaml: digests of the files that were checked last, and the loops
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
    memory = Path(path).parent / CHECKED
    try:
        checked = json.loads(memory.read_bytes())
        if all(_digest(file) == digest for file, digest in checked["files"].items()):
            return checked["loops"]
    except (OSError, ValueError, KeyError, AttributeError, TypeError):
        pass  # no memory, or not a whole one
    from pipeline.store import params

    params.check({section: model(section) for section in SECTIONS}, path)
    loops = params.load(params.Loops, "loops", path).model_dump()
    files = [str(Path(path).absolute()), str(Path(path).with_name(params.EXPERT).absolute())]
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] in ("pipeline", "stages") and module.__file__:
            files.append(module.__file__)
    _remember(memory, {"files": {file: _digest(file) for file in files}, "loops": loops})
    return loops


def model(section: str) -> Any:
    """The class of a section."""
    module, _, name = SECTIONS[section].partition(":")
    return getattr(importlib.import_module(module), name)


def _digest(file: str) -> int:
    return zlib.crc32(Path(file).read_bytes())


def _remember(memory: Path, checked: dict[str, Any]) -> None:
    """Keeps what was checked, if this is a project of DVC that can be written."""
    import os

    beside = memory.with_name(f".{memory.name}.{os.getpid()}")
    try:
        if memory.parents[1].is_dir():
            memory.parent.mkdir(exist_ok=True)
            beside.write_text(json.dumps(checked))
            beside.replace(memory)
    except OSError:
        beside.unlink(missing_ok=True)
