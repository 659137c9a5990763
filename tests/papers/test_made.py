"""What a file of the second pipeline was made of: equal in every clone, and older than its method once that
changes."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from pipeline.papers import made

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def copy(tmp_path, monkeypatch):
    """A folder with the second pipeline, its files and all that they were made of."""
    for name in ("datasets/papers", "datasets/parts", "datasets/published", "pipeline", "stages"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("params.yaml", "params.expert.yaml"):
        shutil.copy(ROOT / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_stage_of_the_second_pipeline_has_a_file_and_says_what_it_was_made_of(copy):
    assert set(made.stages()) == set(json.loads(made.MADE.read_text()))
    for stage in made.stages():
        assert (made.FOLDER / f"{stage}.json").exists() or (made.FOLDER / stage).is_dir()
        assert made.sentence(stage).startswith("Made at commit ")


def test_a_method_that_changes_makes_its_file_old_and_no_other(copy):
    made.record("deposition")
    made.record("temperature")
    assert made.changed("deposition") == made.changed("temperature") == []
    assert made.sentence("deposition").endswith("the method has not changed since.")
    method = copy / "pipeline/deposition/learning/ilc.py"
    method.write_text(method.read_text() + "\nANOTHER = 'method'\n")
    assert made.changed("deposition") == ["pipeline/deposition/learning/ilc.py"]
    assert made.changed("temperature") == []
    assert (
        "the method has changed since: pipeline/deposition/learning/ilc.py. "
        "./run dvc repro datasets/papers/dvc.yaml:deposition makes it anew." in made.sentence("deposition")
    )


METHOD = '"""Words."""\nimport numpy as np\n\n\ndef law(x):\n    """More."""\n    return 2 * x\n'


@pytest.mark.parametrize(
    ("source", "same"),
    [
        (METHOD.replace("import numpy as np", "from pipeline.deposition import drive"), True),
        (METHOD.replace("Words", "Other words").replace("    return", "    # why\n    return"), True),
        (METHOD.replace("2 * x", "3 * x"), False),
        (METHOD.replace("law(x)", "law(x, y=1)"), False),
        (METHOD.replace("return 2", "import math\n    return 2"), True),
    ],
)
def test_moved_imports_and_other_words_are_the_same_method(source, same):
    assert (made.code_digest(source) == made.code_digest(METHOD)) == same


def test_a_parameter_is_part_of_what_a_file_was_made_of(copy):
    made.record("reproduce_study")
    path = copy / "datasets/papers/params.yaml"
    path.write_text(path.read_text().replace("data_sets: 20", "data_sets: 21"))
    assert made.changed("reproduce_study") == ["datasets/papers/params.yaml: reproduce_study"]


def test_what_nothing_was_noted_of_says_how_to_make_it(copy):
    made.MADE.unlink()
    assert made.sentence("temperature") == (
        "Nothing says of which method it was made; run ./run dvc repro datasets/papers/dvc.yaml:temperature."
    )


def test_the_release_check_names_what_is_older_than_its_method(copy):
    """`.ci/release.py`, which a release runs and `./run pytest` does not."""
    (copy / ".ci").mkdir()
    shutil.copy(ROOT / ".ci/release.py", copy / ".ci/release.py")
    for stage in made.stages():
        made.record(stage)
    command = ["python", ".ci/release.py"]
    assert subprocess.run(command, cwd=copy, capture_output=True).returncode == 0
    method = copy / "pipeline/setpoint/agents/agent.py"
    method.write_text(method.read_text() + "\nANOTHER = 1\n")
    ended = subprocess.run(command, cwd=copy, capture_output=True, text=True)
    assert (
        ended.returncode == 1
        and "setpoint" in ended.stdout
        and "pipeline/setpoint/agents/agent.py" in ended.stdout
    )
