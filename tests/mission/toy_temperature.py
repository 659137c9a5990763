"""Project folders of the temperature loop at toy sizes, in which the stages run in this process, as they do
under `./run dvc repro`; and the runs that the mission's tests share."""

import contextlib
import importlib
import io
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from pipeline import cli
from tests.foreign import hot_end

ROOT = Path(__file__).resolve().parents[2]
PARAMS = ("params.yaml", "params.expert.yaml")
# stages of the other loops, and the paper's own study, which no recording touches
OTHERS = {
    "train_ilc", "segment_library", "compose_parts", "render_frames", "train_classifier", "evaluate_setpoint",
    "reproduce_study",
}  # fmt: skip
# read where they lie
LINKED = ("datasets/published", "datasets/papers", "datasets/parts", "pipeline", "stages")
TOY: dict[str, Any] = {
    "execution.jobs": 1,
    "panel.steps": 300,
    "panel.judging.plants": 6,
    "panel.judging.starts_degC": [20],
    "panel.judging.sequence_offsets_degC": [0, 5],
    "panel.training.plants": 4,
    "panel.training.starts_degC": [20],
    "panel.training.sequence_offsets_degC": [],
    "tune_weights.practical_initial": 6,
    "tune_weights.practical_evaluations": 8,
    "evaluate_temperature.resamples": 20,
    "certify.plants": 60,
    "certify.resamples": 20,
}
# what no recording tells, and `init` asks the owner for
LIMITS = {"reference": 205, "low": 0, "high": 280}
HOT_END = ("heater_1", "temperature_hotend")


def begin(folder: Path, source: Path = ROOT) -> Path:
    """A project folder with the params files of `source` and the code of this checkout."""
    for name in ("datasets/raw/temperature", "reports"):
        (folder / name).mkdir(parents=True)
    for name in PARAMS:
        shutil.copy(source / name, folder)
    for name in LINKED:
        if (ROOT / name).exists():
            (folder / name).symlink_to(ROOT / name)
    if (ROOT / "datasets/kept/train_classifier").exists():
        shutil.copytree(ROOT / "datasets/kept/train_classifier", folder / "datasets/train_classifier")
    # the export asks who decides in the setpoint loop, which is not played here
    (folder / "datasets/evaluate_setpoint").mkdir()
    (folder / "datasets/evaluate_setpoint/choice.json").write_text('{"name": "bayes"}')
    return folder


def declare(folder: Path, changes: Mapping[str, Any]) -> None:
    """Sets dotted keys of the params files; each must stand in one of them."""
    files = {name: yaml.safe_load((folder / name).read_text(encoding="utf-8")) for name in PARAMS}
    for dotted, value in changes.items():
        *parents, key = dotted.split(".")
        sections = [_descend(sections, parents) for sections in files.values()]
        homes = [section for section in sections if key in section]
        if len(homes) != 1:
            raise KeyError(f"{dotted} should stand in one of {PARAMS}, and stands in {len(homes)}")
        homes[0][key] = value
    for name, sections in files.items():
        text = yaml.safe_dump(sections, sort_keys=False, allow_unicode=True)
        (folder / name).write_text(text, encoding="utf-8")


def _descend(sections: Any, keys: Iterable[str]) -> dict[str, Any]:
    for key in keys:
        sections = sections.get(key, {}) if isinstance(sections, dict) else {}
    return sections


def declared(folder: Path, section: str) -> dict[str, Any]:
    """A section of params.yaml."""
    return yaml.safe_load((folder / "params.yaml").read_text(encoding="utf-8"))[section]


class Refused(Exception):
    """A command or a stage ended with another exit status than 0; its last line says why."""


def _call(name: str, main: Callable[[], Any], folder: Path) -> str:
    printed = io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        try:
            main()
        except SystemExit as ended:
            if ended.code not in (0, None):
                lines = f"{printed.getvalue()}\n{ended.code}".strip().splitlines()
                said = [line for line in lines if line.strip() and line != str(ended.code)] or lines
                raise Refused(f"{name}: {said[-1]}") from None
    return printed.getvalue()


def beadline(folder: Path, *arguments: str) -> str:
    """What `./run beadline ...` prints in a project folder. Raises Refused with its last line."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["beadline", *arguments])
        return _call(f"beadline {arguments[0]}", cli.main, folder)


def play(folder: Path, *stages: str) -> None:
    """Runs these stages one after the other, as `python -m stages.NAME`. Raises Refused."""
    for stage in stages:
        if stage in OWN_PROCESS:
            _play_alone(folder, stage)
            continue
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", [stage])
            _call(stage, importlib.import_module(f"stages.{stage}").main, folder)


# a reader waits in a child process, which keeps the folder that it was started in
OWN_PROCESS = {"ingest"}


def _play_alone(folder: Path, stage: str) -> None:
    ended = subprocess.run(
        [sys.executable, "-m", f"stages.{stage}"],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300,
    )
    if ended.returncode:
        raise Refused(f"{stage}: {(ended.stderr or ended.stdout).strip().splitlines()[-1]}")


def stages_between(first: str, last: str) -> list[str]:
    """The temperature loop's stages in the order of dvc.yaml, from `first` to `last`."""
    wired = yaml.safe_load((ROOT / "dvc.yaml").read_text(encoding="utf-8"))["stages"]
    names = [name for name in wired if name not in OTHERS]
    return names[names.index(first) : names.index(last) + 1]


def accept_recording(folder: Path, recording: Path) -> None:
    """`init` on one recording of the hot end, and the limits that its owner writes."""
    beadline(folder, "init", str(recording.resolve()), "--copy")
    (output,) = declared(folder, "plant")["outputs"]
    declare(folder, TOY | {"plant.outputs": [output | LIMITS]})


# ---- runs that several tests share


@pytest.fixture(scope="session")
def hot_end_record() -> hot_end.Record:
    """What the owner of the hot end recorded."""
    return hot_end.record(np.random.default_rng(1))


@pytest.fixture(scope="session")
def hot_end_project(made_once, hot_end_record) -> Path:
    """The owner's path for the hot end, from its CSV to the judged controllers. Shared: copy it before you
    change it."""

    def make(folder: Path) -> None:
        begin(folder)
        hot_end.write_csv(folder / "log.csv", hot_end_record)
        accept_recording(folder, folder / "log.csv")
        play(folder, *stages_between("ingest", "evaluate_temperature"))

    return made_once("hot_end", make)


@pytest.fixture(scope="session")
def exported_project(made_once, hot_end_project) -> Path:
    """The same with the controller that the verdict names, certified and exported."""

    def make(folder: Path) -> None:
        shutil.copytree(hot_end_project, folder, symlinks=True)
        play(folder, *stages_between("evaluate_temperature", "export_controllers")[1:])

    return made_once("hot_end_exported", make)
