"""The setpoint loop from frames to verdict, and `beadline shadow` on a printer and camera of another
structure."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from tests.foreign import nozzle_pictures
from tests.mission.conftest import Project

KEPT = "datasets/kept"
SHOTS = 4
RECIPE = {"epochs": 2, "cycle_epochs": 2, "warmup_epochs": 0, "batch": 16}
# a few frames of everything
SMALL = {
    "execution.jobs": 1,
    "train_classifier.window": SHOTS,
    "train_classifier.false_alarms": 0.1,
    **{f"train_classifier.small.{key}": value for key, value in RECIPE.items()},
    "evaluate_setpoint.runs": 1,
    "evaluate_setpoint.pixels.starts": 1,
    "evaluate_setpoint.pixels.decisions": 20,
    "evaluate_setpoint.pixels.least_frames": 2,
}  # fmt: skip
RENDERED = {
    "render_frames.segments": {"learned": 3, "held_out": 1, "calibration": 2, "judged": 2},
    "render_frames.frames": {"learned": 1, "held_out": 2, "calibration": SHOTS, "judged": SHOTS},
    "render_frames.sweeps": {"learn": 1, "choose": 1, "judge": 1},
    "render_frames.sweep_windows": {"learn": 1.0, "choose": 1.0, "judge": 1.0},
    "render_frames.camera_segments": 240,
}
STAGES = ("render_frames", "train_classifier", "evaluate_setpoint")


# ---- frames -> classifier -> agent -> verdict


@pytest.fixture(scope="session")
def simulated(made_once) -> Project:
    """A project whose setpoint loop was made from rendered frames, and its pages."""

    def make(folder: Path) -> None:
        project = Project(folder).make().keep_stages(*STAGES).declare(SMALL | RENDERED).commit()
        project.run("dvc", "repro")
        project.run("python", "-m", "stages.verdict")
        project.run("python", "-m", "stages.report")

    return Project(made_once("simulated_setpoint", make))


@pytest.mark.full
def test_frames_become_a_classifier_an_agent_and_a_verdict(simulated):
    report = json.loads((simulated.folder / "datasets/report/figures.json").read_text())
    choice = json.loads((simulated.folder / "datasets/evaluate_setpoint/choice.json").read_text())
    verdict = report["verdicts"]["setpoint"]
    assert verdict["subject"] == choice["name"]
    assert verdict["state"] in ("passed", "failed", "not measured") and verdict["rule"]
    page = words(simulated.folder / "reports/setpoint.html")
    assert plain(verdict["decision"]) in page and plain(verdict["lead"]) in page


def words(page: Path) -> str:
    return plain(re.sub(r"<[^>]+>", "", page.read_text(encoding="utf-8")))


def plain(text: str) -> str:
    return " ".join(text.replace("&amp;", "&").split())


# ---- shadow on a camera that nobody here drew


@pytest.fixture
def kept(root, tmp_path) -> Project:
    """A project with the classifier that git keeps; nothing was trained here."""
    project = decided_by_the_filter(Project(tmp_path / "kept").make())
    shutil.copytree(root / KEPT / "train_classifier", project.folder / "datasets/train_classifier")
    return project


def decided_by_the_filter(project: Project) -> Project:
    """The project with the default of the bundled study."""
    choice = project.folder / "datasets/evaluate_setpoint/choice.json"
    choice.parent.mkdir()
    choice.write_text(json.dumps({"name": "Bayes filter"}))
    return project


def watched(project: Project, flow_percent: float, windows: int, frames: int) -> tuple[str, list[dict]]:
    """What `beadline shadow` printed of a foreign film at one true flow, and its decisions."""
    rng = np.random.default_rng(3)
    camera = nozzle_pictures.draw_camera(rng)
    film = nozzle_pictures.film(camera, flow_percent, windows * frames, rng)
    nozzle_pictures.write_frames(project.folder / "film", film)
    x, y = camera.tip
    ended = project.beadline("shadow", "film", "--once", "--tip", f"{x:.1f},{y:.1f}", "--out", "shadow")
    rows = []
    for path in sorted((project.folder / "shadow").glob("decisions-*.mcap")):
        with path.open("rb") as stream:
            rows += [json.loads(message.data) for _, _, message in make_reader(stream).iter_messages()]
    return ended.stdout, rows


def test_shadow_moves_nothing_at_a_true_100_percent_of_a_foreign_camera(kept):
    said, rows = watched(kept, 100.0, windows=4, frames=20)
    assert len(rows) == 4
    assert [row["valid"] for row in rows] == [20] * 4, "the line must be found, or nothing was asked"
    assert [row["would_flow_move_percent"] for row in rows] == [0] * 4
    assert "0 would have changed a setpoint" in said


@pytest.fixture(scope="session")
def own_pictures(made_once) -> Project:
    """A project whose classifier learned from an owner's small folder of pictures and nothing else."""

    def make(folder: Path) -> None:
        project = Project(folder).make().keep_stages(*STAGES)
        raw, flows = folder / "datasets/raw/setpoint", (60.0, 100.0, 160.0)
        nozzle_pictures.write_prints(raw, 12, flows, 2 * SHOTS, np.random.default_rng(3))
        project.declare(SMALL | {"train_classifier.source": "recordings"}).commit()
        project.run("dvc", "repro", "train_classifier")
        decided_by_the_filter(project)

    return Project(made_once("own_pictures", make))


@pytest.mark.full
def test_a_classifier_of_few_own_pictures_holds_everything_and_says_so(own_pictures, tmp_path):
    project = own_pictures.copy(tmp_path / "project")
    said, rows = watched(project, 100.0, windows=5, frames=SHOTS)
    assert rows
    held = all(row["would"] == "hold" for row in rows)
    assert held and "cannot judge this camera" in said, (said, [row["reason"] for row in rows])
