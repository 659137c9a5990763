"""The quick look: its sizes, its folder, what is kept for it, and that its pages say what they are."""

import contextlib
import errno
import os
import shutil
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import joblib
import pytest
import yaml

from pipeline import quick
from pipeline.report.shared.headline import Loop, decision
from pipeline.setpoint.agents.files import restore_published
from pipeline.setpoint.frames.files import CAMERA_FILE, restore_camera
from pipeline.setpoint.simulation.recorded import window_tables
from pipeline.setpoint.tables import WINDOW_PARTS, WINDOWS
from pipeline.setpoint.vision.files import restore_classifier
from pipeline.store import artifacts, execution, params
from pipeline.store.params import Execution
from pipeline.verdict.settings import QUICK_LOOK
from pipeline.verdict.verdict import words_for

ALL_ON = dict.fromkeys(params.Loops.model_fields, True)
ROOT = Path(__file__).resolve().parents[1]
PAGES = (
    *("certificate", "deposition", "identification", "index", "papers", "runs"),
    *("setpoint", "temperature", "viewer", "words"),
)
# the first stages and the pages: what is missing between has its place there
SHORT = ("probe_machine", "ingest", "verdict", "report")


def lay_out(folder: Path, stages: tuple[str, ...] = SHORT) -> Path:
    """A checkout with these stages, a short probing, and results of an earlier full run."""
    for name in (params.FILE, params.EXPERT, "params.quick.yaml"):
        shutil.copy(ROOT / name, folder)
    expert = folder / params.EXPERT
    expert.write_text(expert.read_text().replace("samples: 6000", "samples: 600"))
    (folder / "dvc.yaml").write_text(
        yaml.safe_dump({"stages": {name: {} for name in stages}}, sort_keys=False)
    )
    (folder / "dvc.lock").write_text("stages: of the full run\n")
    for name in ("datasets/ingest/record.parquet", "reports/index.html"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("of the full run\n")
    for name in ("raw", "parts", "published", "kept"):
        (folder / "datasets" / name).symlink_to(ROOT / "datasets" / name)
    for name in ("pipeline", "stages"):
        (folder / name).symlink_to(ROOT / name)
    return folder


def written(folder: Path) -> dict[str, bytes]:
    """Every file that the folder holds itself."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.is_symlink()
    }


@pytest.fixture(scope="module")
def looked(tmp_path_factory):
    """A checkout in which a quick look ended well; what it told, and the checkout's own files before."""
    folder = lay_out(tmp_path_factory.mktemp("looked"))
    before = written(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        return folder, quick.quick(), before


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return lay_out(tmp_path)


# ---- a whole one


def test_a_quick_look_writes_its_own_folder_and_nothing_else(looked):
    folder, told, before = looked
    after = written(folder)
    assert {name: after[name] for name in after if not name.startswith("quick/")} == before
    assert {path.stem for path in (folder / "quick/reports").glob("*.html")} == set(PAGES)
    assert (folder / "quick/datasets/ingest/record.parquet").stat().st_size > 1000
    assert (
        not (folder / "quick/pipeline").exists()
        and not (folder / "quick/datasets/export_controllers").exists()
    )
    assert told.splitlines()[-1].startswith("quick/reports/index.html")
    assert all(f"\n{name}" in f"\n{told}" for name in (*SHORT, "whole", "temperature: Quick look undecided."))


def test_every_page_of_a_quick_look_says_so(looked):
    for name in PAGES:
        text = (looked[0] / f"quick/reports/{name}.html").read_text()
        assert text.count('role="note"><strong>Quick look.</strong>') == 1
        assert "panel.judging.plants" in text and "that of a full run, of commit" in text
        assert not any(f"{word} (simulation)" in text for word in ("Pass", "Fail", "Undecided"))


def test_the_same_inputs_give_the_same_bytes_and_take_the_place_of_the_last(looked, monkeypatch):
    folder, _, _ = looked
    monkeypatch.chdir(folder)
    before = written(folder / "quick")
    (folder / "quick/left.txt").write_text("of the last quick look")
    quick.quick()
    assert written(folder / "quick") == before


# ---- CPU seconds

BURN = """
import time
begun = time.process_time()
while time.process_time() < begun + 0.5: pass
print(flush=True)
"""
# how a stage leaves a worker that has taken half a second: a line of the worker, and what the stage does
WORKERS = {
    "it lives on": ("time.sleep(60)", lambda worker: None),
    "it ended and nobody waited": ("", lambda worker: None),
    "it was killed and nobody waited": ("time.sleep(60)", lambda worker: os.kill(worker.pid, signal.SIGKILL)),
    "it was killed and waited for": ("time.sleep(60)", lambda worker: (worker.kill(), worker.wait())),
    "it has a worker of its own": (
        "import subprocess, sys\n"
        f"subprocess.run([sys.executable, '-c', {BURN!r}])\nprint(flush=True)\ntime.sleep(60)",
        lambda worker: worker.stdout.readline(),
    ),
}


@pytest.mark.parametrize("left", WORKERS)
def test_the_cpu_of_a_stage_is_that_of_its_workers_too(monkeypatch, left):
    last, leave = WORKERS[left]
    workers = []

    def main() -> None:
        worker = subprocess.Popen([sys.executable, "-c", BURN + last], stdout=subprocess.PIPE)
        workers.append(worker)
        worker.stdout.readline()
        leave(worker)

    monkeypatch.setitem(sys.modules, "stages.toy", types.SimpleNamespace(main=main))
    _, _, cpu_s = quick._run("toy", is_on=True)
    _, _, next_s = quick._run("toy", is_on=True)
    for worker in workers:
        worker.kill()
        worker.communicate()
    taken = 1.0 if "own" in left else 0.5
    assert taken - 0.1 < cpu_s < taken + 0.4 and taken - 0.1 < next_s < taken + 0.4, "once, and no more"


def test_the_cpu_of_joblib_s_workers_counts_for_the_stage_that_they_work_for(monkeypatch):
    two = Execution(backend="loky", jobs=2, scheduler="")

    def main() -> None:
        assert len(list(execution.run_all(2 * [joblib.delayed(exec)(BURN)], two))) == 2

    monkeypatch.setitem(sys.modules, "stages.toy", types.SimpleNamespace(main=main))
    assert quick._run("toy", is_on=True)[2] > 0.8


# ---- one that does not end


KILLED = """
import time
from pipeline import quick
quick._run = lambda name, **_: time.sleep(60)
quick.quick()
"""


def test_a_killed_quick_look_shows_nothing_and_the_next_starts_clean(looked, monkeypatch):
    folder, _, _ = looked
    monkeypatch.chdir(folder)
    before = written(folder / "quick")
    child = subprocess.Popen([sys.executable, "-c", KILLED], cwd=folder)
    half = folder / f".quick.{child.pid}.tmp"
    while not (half / "datasets/train_classifier/weights.safetensors").exists() and child.poll() is None:
        time.sleep(0.02)
    child.send_signal(signal.SIGKILL)
    child.wait()
    assert half.exists() and written(folder / "quick") == before
    with quick._fresh() as fresh:
        assert not half.exists() and not any(fresh.iterdir())
        (fresh / "page.html").touch()
    assert [path.name for path in Path("quick").iterdir()] == ["page.html"]
    assert not list(Path().glob(".quick.*"))


def test_a_stage_that_fails_leaves_the_last_quick_look(checkout, capsys):
    (checkout / "quick").mkdir()
    (checkout / "quick/page.html").write_text("of the last quick look")
    owner = checkout / params.FILE
    owner.write_text(owner.read_text().replace("  source: simulated", "  source: recordings", 1))
    with pytest.raises(SystemExit) as ended:
        quick.quick()
    assert ended.value.code == 1 and capsys.readouterr().err.startswith("ingest: ")
    assert written(checkout / "quick") == {"page.html": b"of the last quick look"}
    assert not list(checkout.glob(".quick.*")) and Path.cwd() == checkout


def test_a_full_disk_at_the_last_step_leaves_the_last_quick_look(checkout, monkeypatch):
    (checkout / "quick").mkdir()
    (checkout / "quick/page.html").write_text("of the last quick look")
    rename = Path.rename

    def full(self, target):
        if self.name == f".quick.{os.getpid()}.tmp":
            raise OSError(errno.ENOSPC, "No space left on device", str(self))
        return rename(self, target)

    with monkeypatch.context() as disk:
        disk.setattr(Path, "rename", full)
        with pytest.raises(OSError, match="No space left"), quick._fresh():
            pass
    assert written(checkout / "quick") == {"page.html": b"of the last quick look"}
    # killed between its two renames
    (checkout / "quick").rename(checkout / ".quick.99999999.old.tmp")
    with pytest.raises(RuntimeError), quick._fresh():
        raise RuntimeError("the next one fails")
    assert written(checkout / "quick") == {"page.html": b"of the last quick look"}
    assert not list(checkout.glob(".quick.*"))


def test_a_quick_look_beside_another_leaves_its_folder_alone(checkout):
    other = Path(f".quick.{os.getppid()}.tmp")
    other.mkdir()
    with quick._fresh() as fresh:
        assert other.exists() and fresh != other


# ---- sizes


def test_the_sizes_replace_values_of_a_full_run_and_none_grows():
    files, rows = quick.smaller_sizes(ROOT / params.FILE, ROOT / quick.SIZES)
    smaller = {name: (yaml.safe_load(here), yaml.safe_load(whole)) for name, here, whole in rows}
    assert smaller["panel.judging.plants"] < (60, 60) and "train_ilc.pixel_trials" in smaller
    for name, (here, whole) in smaller.items():
        count = len if isinstance(here, list) else int
        assert count(here) < count(whole), name
    assert files[params.EXPERT]["panel"]["judging"]["plants"] == smaller["panel.judging.plants"][0]
    assert files[params.FILE] == params.files(ROOT / params.FILE)[str(ROOT / params.FILE)]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            "panel: {judging: {plant: 6}}",
            "params.quick.yaml or params.expert.yaml: panel.judging.plant is unknown; did you mean plants?",
        ),
        (
            "panel: {plants: 6}",
            "params.quick.yaml or params.expert.yaml: panel.plants is unknown; remove it, or use noise_degC",
        ),
        ("panel: 6", "params.quick.yaml or params.expert.yaml: panel must be a section with keys below it"),
        ("panl: {}", "params.quick.yaml: panl is no section that a quick look makes smaller"),
        (
            "report: {disk_margin: 0.1}",
            "params.quick.yaml: report is no section that a quick look makes smaller",
        ),
        (
            "panel: {judging: {plants: 0}}",
            "params.quick.yaml or params.expert.yaml: panel.judging.plants is 0 but",
        ),
        ("panel: [", "params.quick.yaml: line 1"),
    ],
)
def test_a_size_that_is_none_is_refused_in_one_sentence_and_nothing_is_written(
    checkout, beadline, text, sentence
):
    os.chdir(checkout)
    Path("params.quick.yaml").write_text(text)
    before = written(checkout)
    status, _, told = beadline("quick")
    assert status == 1 and told.startswith(f"beadline: {sentence}") and "Traceback" not in told
    assert written(checkout) == before


def test_a_classifier_of_recorded_frames_is_not_replaced_by_the_kept_one(checkout):
    whole = (ROOT / params.FILE).read_text()
    head, tail = whole.split("train_classifier:", 1)
    Path(params.FILE).write_text(f"{head}train_classifier:{tail.replace('simulated ', 'recordings', 1)}")
    Path("dvc.yaml").write_text((ROOT / "dvc.yaml").read_text())
    files, smaller = quick.smaller_sizes()
    assert "evaluate_setpoint" not in quick.chosen_stages(files, ALL_ON, Path("dvc.yaml"))
    Path("look").mkdir()
    quick._furnish(Path("look"), files, smaller, checkout)
    assert not Path("look/datasets/train_classifier").exists()
    assert "The setpoint loop is left out" in Path("look", QUICK_LOOK).read_text()


def test_of_a_loop_that_is_off_nothing_is_kept_and_no_stage_runs(checkout):
    owner = Path(params.FILE)
    owner.write_text(owner.read_text().replace("setpoint: true", "setpoint: false"))
    Path("look").mkdir()
    files, smaller = quick.smaller_sizes()
    loops = quick._furnish(Path("look"), files, smaller, checkout)
    assert loops == {"temperature": True, "deposition": True, "setpoint": False}
    assert not Path("look/datasets/train_classifier").exists()
    assert "of a full run, of commit" not in Path("look", QUICK_LOOK).read_text()
    with contextlib.chdir("look"):
        quick._run("evaluate_setpoint", is_on=False)
        assert artifacts.read_figures("evaluate_setpoint") == {"asked": False}


def test_every_stage_but_training_and_export_runs_after_what_it_reads(monkeypatch):
    monkeypatch.chdir(ROOT)
    files, _ = quick.smaller_sizes()
    order = list(quick.chosen_stages(files, ALL_ON, Path("dvc.yaml")))
    every = {path.stem for path in Path("stages").glob("*.py")} - {"__init__"}
    assert set(order) == every - set(quick.LEFT_OUT)
    off = quick.chosen_stages(files, ALL_ON | {"setpoint": False}, Path("dvc.yaml"))
    assert [name for name, is_on in off.items() if not is_on] == [
        *("render_frames", "train_classifier", "evaluate_setpoint")
    ]
    assert off["report"] and off["train_ilc"]
    wires = yaml.safe_load(Path("dvc.yaml").read_text())["stages"]
    for at, name in enumerate(order):
        read = {dep.split("/")[1] for dep in wires[name]["deps"] if dep.startswith("datasets/")}
        assert not read & set(order[at:]), name


# ---- what is kept


def test_what_is_kept_is_whole_and_read_by_the_code_of_today():
    kept = ROOT / quick.KEPT
    listed = artifacts.read_json(kept / "kept.json")
    there = {path.relative_to(kept).as_posix() for path in kept.rglob("*") if path.is_file()}
    assert there - {"kept.json", "README.md"} == set(listed["files"]) and len(listed["commit"]) == 8
    assert sum((kept / name).stat().st_size for name in there) < 4e6
    model = kept / "train_classifier"
    restore_classifier(str(model / "weights.safetensors"), str(model / "calibration.parquet"))
    restore_camera(str(model / CAMERA_FILE))
    assert {"learn", "choose", "judge"} <= set(
        window_tables(artifacts.read_table(model / "windows.parquet", WINDOWS), WINDOW_PARTS)
    )
    assert len(restore_published(ROOT / "datasets/papers/train_agent/weights.safetensors").networks) == 4


def test_a_kept_file_that_differs_is_refused_by_name(checkout, beadline):
    os.chdir(checkout)
    Path("datasets/kept").unlink()
    shutil.copytree(ROOT / "datasets/kept", "datasets/kept")
    with Path("datasets/kept/train_classifier/weights.safetensors").open("r+b") as file:
        file.seek(4000)
        file.write(b"!")
    status, _, told = beadline("quick")
    assert status == 1 and "datasets/kept/train_classifier/weights.safetensors: expected SHA-256" in told
    for content in ("[]", "{}", None):
        index = Path("datasets/kept/kept.json")
        index.unlink() if content is None else index.write_text(content)
        status, _, told = beadline("quick")
        assert status == 1 and "kept.json: expected commit and files" in told and "git checkout" in told
    assert not Path("quick").exists() and not list(Path().glob(".quick.*"))


# ---- words


def test_no_quick_look_passes_a_simulation_or_is_ready_for_a_trial():
    for recorded in (True, False):
        assert words_for(recorded=recorded, quick=True).passed.startswith("Quick look passed")
    assert words_for(recorded=False, quick=False).passed.startswith("Pass (simulation)")
    states = ("passed", "failed", "passed")
    loops = [
        Loop(name, state, recorded)
        for name, state, recorded in zip(
            ("temperature", "deposition", "setpoint"), states, (True, False, False), strict=True
        )
    ]
    assert (
        decision(loops, quick=True) == "Quick look passed: temperature; passed: setpoint; failed: deposition."
    )
