"""The frame of a stage: its parameters, its pins, the switch of its loop, and what its import costs."""

import json
import os
import re
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import stages
from pipeline.store import artifacts, params
from pipeline.store.pins import INSTRUCTIONS, THREADS, check_pins

ROOT = Path(__file__).parents[1]
STAGES = sorted(path.stem for path in (ROOT / "stages").glob("*.py") if path.stem != "__init__")
# CPU seconds on an idle machine with Zen 5; a slower or a loaded one takes up to so many times as long
IMPORT_S, LEFT_OUT_S, SLOWER = 0.15, 0.2, 2
HEAVY = {"numpy", "scipy", "pandas", "pyarrow", "jax", "cv2", "mcap", "sklearn", "control", "joblib"}


@pytest.fixture
def project(tmp_path, monkeypatch) -> Path:
    """The parameters and the pipeline of this checkout, as in a project of DVC."""
    for name in ("params.yaml", "params.expert.yaml", "dvc.yaml"):
        shutil.copy(ROOT / name, tmp_path)
    (tmp_path / ".dvc").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def change(project: Path, name: str, old: str, new: str) -> None:
    text = (project / name).read_text(encoding="utf-8")
    assert old in text
    (project / name).write_text(text.replace(old, new, 1), encoding="utf-8")


# ---- sections


def test_every_section_has_the_class_that_knows_all_its_keys():
    declared = params.read(ROOT / "params.yaml")
    assert set(stages.SECTIONS) == set(declared) == set(params.SECTIONS)
    for section in stages.SECTIONS:
        assert set(stages.model(section).model_fields) >= set(declared[section])
    assert stages.check_parameters(ROOT / "params.yaml") == dict.fromkeys(params.Loops.model_fields, True)


def test_all_problems_of_all_sections_are_told_at_once(project):
    change(project, "params.yaml", "  settled_error_degC:", "  settled_eror_degC:")
    change(project, "params.yaml", "  watch_h: 36.0", "  watch_h: -1.0")
    change(project, "params.expert.yaml", "  max_order: 12", "  max_order: twelve")
    with pytest.raises(ValueError) as refused:
        stages.check_parameters()
    assert sorted(str(refused.value).splitlines()) == [
        'params.expert.yaml: identify_plant.max_order is "twelve" but must be a whole number',
        "params.yaml: nightly.watch_h is -1.0 but must be more than 0",
        "params.yaml: report.settled_eror_degC is unknown; did you mean settled_error_degC?",
    ]


def test_a_machine_without_any_loop_is_refused(project):
    for loop in params.Loops.model_fields:
        change(project, "params.yaml", f"  {loop}: true", f"  {loop}: false")
    with pytest.raises(ValueError, match=r"^params.yaml: loops switches every loop off; set temperature"):
        stages.check_parameters()


def test_a_misspelt_section_is_one_problem(project):
    change(project, "params.yaml", "\nreport:", "\nreprot:")
    with pytest.raises(ValueError, match=r"^params.yaml: reprot is no section; did you mean report\?$"):
        stages.check_parameters()


def test_parameters_that_were_checked_are_not_checked_again_until_they_change(project, monkeypatch):
    stages.check_parameters()
    monkeypatch.setattr(params, "check", lambda *_: pytest.fail("checked again"))
    assert stages.check_parameters()["setpoint"]
    change(project, "params.yaml", "setpoint: true", "setpoint: false")
    with pytest.raises(pytest.fail.Exception):
        stages.check_parameters()


@pytest.mark.parametrize("text", ["", "[]", "{", "3", '{"digest": 3}'])
def test_a_broken_memory_is_none(project, text):
    change(project, "params.yaml", "  watch_h:", "  wach_h:")
    (project / stages.CHECKED).parent.mkdir()
    (project / stages.CHECKED).write_text(text)
    with pytest.raises(ValueError, match="nightly.wach_h is unknown; did you mean watch_h"):
        stages.check_parameters()


# ---- a stage


def test_a_stage_with_bad_parameters_ends_in_one_line(project, capsys):
    change(project, "params.yaml", "  watch_h:", "  wach_h:")
    with pytest.raises(SystemExit) as ended:
        stages.run(lambda: pytest.fail("ran"), "train_ilc", loop="deposition")
    assert ended.value.code == 1
    sentence = "train_ilc: params.yaml: nightly.wach_h is unknown; did you mean watch_h?\n"
    assert capsys.readouterr().err == sentence


def test_a_stage_whose_loop_is_on_runs(project):
    ran = []
    stages.run(lambda: ran.append("train_ilc"), "train_ilc", loop="deposition")
    stages.run(lambda: ran.append("report"), "report")
    assert ran == ["train_ilc", "report"]


def test_a_stage_whose_loop_is_off_writes_every_file_that_another_stage_reads(project):
    change(project, "params.yaml", "deposition: true", "deposition: false")
    (project / "datasets/train_ilc/frames").mkdir(parents=True)
    (project / "datasets/train_ilc/frames/last.jpg").touch()
    stages.run(lambda: pytest.fail("ran"), "train_ilc", loop="deposition")
    pipeline = (project / "dvc.yaml").read_text(encoding="utf-8")
    read = {name for name in re.findall(r"datasets/train_ilc/[\w./-]*", pipeline) if "." in name}
    assert read
    written = {str(path.relative_to(project)) for path in project.glob("datasets/**/*") if path.is_file()}
    assert written == read | {"datasets/train_ilc/figures.json"}
    for name in (*written, "datasets/train_ilc/figures.json"):
        assert json.loads((project / name).read_text()) == {"asked": False}


def test_a_stage_that_is_left_out_keeps_the_last_results_if_it_cannot_write(project, monkeypatch):
    (project / "datasets/segment_library").mkdir(parents=True)
    (project / "datasets/segment_library/library.parquet").write_text("last")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(artifacts, "write_json", full)
    with pytest.raises(SystemExit):
        stages.leave_out("segment_library")
    assert (project / "datasets/segment_library/library.parquet").read_text() == "last"


# ---- pins


@pytest.fixture
def pinned(monkeypatch, tmp_path):
    """pinned(flags, *without): this environment on a CPU with these flags, without some of the pins."""

    def pinned(flags: str, *without: str) -> None:
        (tmp_path / "cpuinfo").write_text(f"model name\t: Toy\nflags\t\t: {flags}\n")
        monkeypatch.setenv("BEADLINE_CPUINFO", str(tmp_path / "cpuinfo"))
        for name in (*THREADS, *INSTRUCTIONS):
            monkeypatch.setenv(name, "1")
        for name in without:
            monkeypatch.delenv(name)

    return pinned


@pytest.mark.parametrize("without", [(), INSTRUCTIONS])
def test_a_cpu_without_avx2_needs_no_pins_of_instructions(pinned, without):
    pinned("fpu avx", *without)
    check_pins("ingest")


@pytest.mark.parametrize("name", [*THREADS, *INSTRUCTIONS])
def test_a_missing_pin_is_refused_with_the_command(pinned, name):
    pinned("fpu avx avx2 fma", name)
    with pytest.raises(ValueError, match=rf"^{name} is not set.*; start it with ./run dvc repro ingest$"):
        check_pins("ingest")


# ---- seconds


def cpu_s(tmp_path: Path, *command: str, enough: float = 0.0, times: int = 10) -> float:
    """CPU seconds of a process at its best of some times, with the bytecode of the first. It is run again
    until it is fast enough: other work on the machine slows it down."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONPYCACHEPREFIX": str(tmp_path / "bytecode")}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    spent = []
    for _ in range(times):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, *command], check=True, env=environment)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        spent.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
        if min(spent) <= enough:
            break
    return min(spent)


@pytest.mark.parametrize("stage", STAGES)
def test_the_import_of_a_stage_is_cheap(stage, tmp_path):
    code = f"import sys, stages.{stage}; assert not {HEAVY!r} & sys.modules.keys()"
    limit_s = cpu_s(tmp_path, "-c", "pass") + SLOWER * IMPORT_S
    assert cpu_s(tmp_path, "-c", code, enough=limit_s) <= limit_s


def loop_of(stage: str) -> str:
    """The loop of a stage, "" for a stage of all loops."""
    text = (ROOT / "stages" / f"{stage}.py").read_text(encoding="utf-8")
    called = re.search(rf'stages\.run\(main, "{stage}"(?:, loop="(\w+)")?\)\n$', text)
    assert called, f"stages/{stage}.py ends otherwise than by stages.run"
    return called[1] or ""


def test_every_loop_has_stages():
    assert {loop_of(stage) for stage in STAGES} == {"", *params.Loops.model_fields}


@pytest.mark.parametrize("stage", [stage for stage in STAGES if loop_of(stage)])
def test_a_stage_that_is_left_out_ends_at_once(stage, project, tmp_path):
    change(project, "params.yaml", f"{loop_of(stage)}: true", f"{loop_of(stage)}: false")
    assert cpu_s(tmp_path, "-m", f"stages.{stage}", enough=SLOWER * LEFT_OUT_S) <= SLOWER * LEFT_OUT_S
    assert yaml.safe_load(Path("datasets", stage, "figures.json").read_text()) == {"asked": False}
