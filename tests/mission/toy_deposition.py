"""A small project of an owner of a deposition machine: short routines, one material, own topics and a turned
camera. Its stages run as `./run dvc repro STAGE` runs them."""

import contextlib
import html
import importlib
import io
import re
import shutil
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import yaml

from pipeline import cli
from tests.foreign.bead_camera import BeadCamera
from tests.foreign.deposition_machine import TOPICS, DepositionMachine, Printed
from tests.foreign.syringe import PneumaticSyringe

ROOT = Path(__file__).resolve().parents[2]
RECORDED, NEXT = Path("datasets/raw/deposition"), Path("datasets/train_ilc/next")
AREA_MM2, RAMP_S = 0.304, 0.15
SHORT = {"off_s": 1.0, "on_s": 2.5, "tail_s": 2.0}
REFERENCE = {"speed_mm_per_s": 8.0, "pause_s": 0.6, **SHORT}
# as the shipped ones: the first shares speed and pause with the reference, and prints longer
LIKE_THE_SHIPPED = [
    {"speed_mm_per_s": 8.0, "pause_s": 0.6, **SHORT, "on_s": 4.0},
    {"speed_mm_per_s": 5.0, "pause_s": 0.6, **SHORT, "on_s": 4.0},
]
CAMERA, SYRINGE = BeadCamera(), PneumaticSyringe()
SMALL = {
    "printer.drive": {"amplitude_mm": 1e3, "speed_mm_per_s": 1e5, "backlash_mm": 0.0},
    "printer.reference": REFERENCE,
    "printer.routines": [],
    "printer.materials": [{"name": "A", "tool": 0, "gain_mm3_per_s_per_mm": 1.08, "time_constant_s": 0.8}],
    "train_ilc.source": "simulated",
    "train_ilc.trials": 6,
    "train_ilc.pixel_trials": 2,
    "train_ilc.family_plants": 10,
    "compose_parts.full_part_updates": 4,
    "execution.jobs": 1,
}
# the owner's camera, turned, with the tip where it is in the picture
OWN = SMALL | {
    "train_ilc.source": "recordings",
    "segment_library.law": "pixels",
    "camera.mm_per_px": -CAMERA.mm_per_px,
    "camera.rotation_deg": None,
    "camera.tip_px": list(CAMERA.tip),
    "camera.nozzle_column": 20,
    "camera.columns": [90, 280],
    "camera.topics": TOPICS,
}


class Refused(Exception):
    """A stage ended with status 1; its one sentence."""


class Played(NamedTuple):
    """A command of next/ that was played: its name, the number of its routine, and what was printed."""

    name: str
    routine: int
    printed: Printed


def lay_out(changes: dict[str, Any], parts: tuple[str, ...] = ("fig9",)) -> None:
    """Code, parts, an empty folder of recordings and both files of parameters in the working folder."""
    for name in ("pipeline", "stages"):
        Path(name).symlink_to(ROOT / name)
    Path("datasets/parts").mkdir(parents=True)
    RECORDED.mkdir(parents=True)
    for name in parts:
        shutil.copy(ROOT / f"datasets/parts/{name}.gcode", "datasets/parts")
    files = {
        name: yaml.safe_load((ROOT / name).read_text()) for name in ("params.yaml", "params.expert.yaml")
    }
    for dotted, value in changes.items():
        section, key = dotted.split(".")
        places = [sections for sections in files.values() if key in sections.get(section, {})]
        places[0][section][key] = value
    for name, sections in files.items():
        Path(name).write_text(yaml.safe_dump(sections, sort_keys=False))


def run_stage(name: str) -> None:
    """What `./run dvc repro` runs, verdicts before the pages that read them. Raises Refused with the last
    line that the stage printed."""
    with _quiet():
        for stage in ("verdict", "report") if name == "report" else (name,):
            importlib.import_module(f"stages.{stage}").main()


def beadline(*arguments: object) -> str:
    """What `./run beadline ...` prints. Raises Refused with its last line."""
    with pytest.MonkeyPatch.context() as patch, _quiet() as printed:
        patch.setattr(sys, "argv", ["beadline", *map(str, arguments)])
        cli.main()
    return printed.getvalue()


@contextlib.contextmanager
def _quiet():
    """What is printed, kept; an exit of the command becomes Refused."""
    printed, refused = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(refused):
            yield printed
    except SystemExit:
        raise Refused(refused.getvalue().strip().splitlines()[-1]) from None


def page_text(path: Path) -> str:
    """The words and figures of a page, without its pictures; every kind of space is one space."""
    text = path.read_text(encoding="utf-8")
    for element in ("style", "script", "svg"):
        text = re.sub(rf"<{element}\b.*?</{element}>", " ", text, flags=re.DOTALL)
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", text)).split())


def machine(extruder: PneumaticSyringe = SYRINGE, frames_hz: float = 20.0) -> DepositionMachine:
    """The owner's machine."""
    return DepositionMachine(extruder, CAMERA, AREA_MM2, RAMP_S, frames_hz)


def play_all(foreign: DepositionMachine, routines: list[dict[str, float]], seed: int) -> list[Played]:
    """Every command of next/ played and recorded, as README.md of datasets/raw/deposition says."""
    return [play(foreign, command, routines, seed) for command in sorted(NEXT.glob("*.csv"))]


def play(foreign: DepositionMachine, command: Path, routines: list[dict[str, float]], seed: int) -> Played:
    """One command of next/ played and recorded."""
    number = int(re.fullmatch(r"A_routine_(\d+)_trial_\d+", command.stem).group(1))
    path = RECORDED / f"print_of_{command.stem}.mcap"
    rng = np.random.default_rng([seed, number])
    printed = foreign.record(path, command.with_suffix(""), routines[number], rng)
    return Played(command.stem, number, printed)
