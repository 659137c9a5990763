"""What no recording changes is a pipeline of its own: a method that is edited starts none of its stages from
the root, and each of them is run by its name."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from pipeline.papers import made, relearned
from tests.house import PAPERS

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def clone(tmp_path_factory):
    """A repository with both pipelines and the code, without any artifact."""
    folder = tmp_path_factory.mktemp("clone")
    for name in (
        "datasets/papers",
        "datasets/parts",
        "datasets/published",
        "datasets/raw",
        "pipeline",
        "stages",
    ):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "*.tmp"))
    for name in ("dvc.yaml", "params.yaml", "params.expert.yaml", ".dvcignore"):
        shutil.copy(ROOT / name, folder / name)
    subprocess.run(["git", "init", "-q"], cwd=folder, check=True)
    dvc(folder, "init", "-q")
    return folder


def dvc(folder, *command):
    """What DVC prints; it may end with an error, as a root without artifacts does."""
    ended = subprocess.run(
        [sys.executable, "-m", "dvc", *command], cwd=folder, capture_output=True, text=True, timeout=120
    )
    return ended.stdout + ended.stderr


def stale(folder, stage):
    return f"{PAPERS}:{stage}" in dvc(folder, "status", f"{PAPERS}:{stage}")


def test_an_edited_method_starts_no_stage_of_the_papers_from_the_root(clone):
    assert not dvc(clone, "commit", "-q", "-f", f"{PAPERS}:deposition")
    assert not stale(clone, "deposition")
    method = clone / "pipeline/deposition/learning/ilc.py"
    method.write_text(method.read_text() + "\n# another method\n")
    assert stale(clone, "deposition")
    planned = dvc(clone, "repro", "--dry", "--keep-going")
    assert "Running stage 'train_ilc'" in planned  # of the root, which reads the method too
    assert "papers/dvc.yaml" not in planned
    # and by its name it is run
    assert f"Running stage '{PAPERS}:deposition'" in dvc(clone, "repro", "--dry", f"{PAPERS}:deposition")


def test_a_declared_out_would_start_it_from_the_root(clone):
    """What the rule is for: with an out that `report` reads, the root runs the stage."""
    path = clone / PAPERS
    kept = path.read_text()
    entries = yaml.safe_load(kept)
    entries["stages"]["deposition"]["outs"] = [{"datasets/papers/deposition.json": {"cache": False}}]
    path.write_text(yaml.safe_dump(entries))
    try:
        assert f"Running stage '{PAPERS}:deposition'" in dvc(clone, "repro", "--dry", "--keep-going")
    finally:
        path.write_text(kept)


def test_one_relearning_at_toy_size_is_of_the_shape_that_is_on_file(monkeypatch):
    """The stages themselves, in a folder of their own: nothing of this checkout is written."""
    monkeypatch.chdir(ROOT)
    sizes = {
        "generate_probing.samples": 1500,
        "panel.steps": 150,
        "panel.settled_steps": 40,
        "panel.judging.plants": 4,
        "panel.judging.starts_degC": [20],
        "panel.judging.sequence_offsets_degC": [],
        "panel.training.plants": 3,
        "panel.training.starts_degC": [20],
        "panel.training.sequence_offsets_degC": [],
        "tune_weights.practical_initial": 4,
        "tune_weights.practical_evaluations": 8,
    }
    kept = (ROOT / "reports/metrics/evaluate_temperature.json").read_bytes()
    run = relearned.relearn(relearned.seeds(1000), sizes)
    assert (ROOT / "reports/metrics/evaluate_temperature.json").read_bytes() == kept
    on_file = json.loads((ROOT / "datasets/papers/relearned.json").read_text())
    figures = relearned.figures([run])
    # relearning takes hours: a controller may be newer than the file if the page says that the file is older
    newer = set(figures) - set(on_file["contestants"])
    table = "pipeline/temperature/controllers/table.py"
    assert not newer or table in made.changed("relearned")
    assert not newer or "the method has changed since" in made.sentence("relearned")
    assert "subspace_lqg" in figures
    assert set(relearned.answers([run])) == set(on_file["answers"])
    band = figures["subspace_lqg"]["cost"]["q90"]
    assert band["low"] == band["median"] == band["high"] > 0
    assert set(run["tuned_cost"]) <= set(run["contestants"])
