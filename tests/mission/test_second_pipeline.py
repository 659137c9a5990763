"""What no recording changes is a pipeline of its own: a method that is edited starts none of its stages from
the root, and each of them is run by its name."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

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
    method = clone / "pipeline/deposition/ilc.py"
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
