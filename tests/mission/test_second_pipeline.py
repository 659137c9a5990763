"""What no recording changes is a pipeline of its own: a method that is edited starts none of its stages from
the root, and each of them is run by its name."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from pipeline.papers import made, relearned
from pipeline.temperature.controllers.table import CONTROLLERS
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
        "evaluate_temperature.cost_curve": False,
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
    # it takes an hour: a controller may be newer than the file if the page says that the file is older
    newer = set(run["costs"]) - set(on_file["curve"]["controllers"])
    compared = [one.name for one in CONTROLLERS if one.kind in ("model-based", "data-driven")]
    table = "pipeline/temperature/controllers/table.py"
    if newer & set(compared):
        assert table in made.changed("relearned")
        assert "the method has changed since" in made.sentence("relearned")
    found = relearned.by_length({1500: [run], 6000: [run]}, compared, seed=1)
    assert set(found) == set(on_file["curve"])
    assert set(found["answers"]["1500"]) == set(on_file["curve"]["answers"]["6000"])
    mine = found["controllers"]["subspace_lqg"]
    assert mine["low"] == mine["cost"] == mine["high"] > [0, 0]
    assert mine["cost"][0] == pytest.approx(np.exp(run["costs"]["subspace_lqg"]))


def test_a_relearning_counts_costs_plant_by_plant_and_leaves_out_who_has_none():
    """Means over the cases of a plant, then over the logarithms: sqrt(2 * 8) by hand."""
    cases = {
        "contestant": np.array(["pi", "pi", "pi", "hold", "hold"]),
        "plant": np.array([0, 0, 3, 0, 3]),
        "cost": np.array([1.0, 3.0, 8.0, 1.0, np.nan]),
    }
    found = relearned.mean_log_costs(cases)
    assert set(found) == {"pi"}
    assert np.exp(found["pi"]) == pytest.approx(4.0)
