"""Who may know whom, and dvc.yaml: both read off the syntax tree. `./run python -m tests.test_house` prints
the dvc.yaml that the stages ask for, `... test_house papers` that of datasets/papers."""

import ast
import importlib
import sys
import typing
from pathlib import Path
from typing import Annotated

import pytest
import yaml
from pydantic import Field

from pipeline.store import params
from tests.house import (
    PAPERS,
    differences,
    expected,
    forbidden_files,
    forbidden_imports,
    forbidden_randomness,
    loads,
    misplaced,
    pipeline,
    second_pipeline,
    stages,
    unbounded,
    unframed,
)

ROOT = Path(__file__).resolve().parents[1]


# ---- the house as it stands


@pytest.mark.parametrize(
    "rule", [misplaced, forbidden_imports, forbidden_files, forbidden_randomness, unframed]
)
def test_the_house_keeps_the_rule(rule):
    assert rule(ROOT) == []


def test_dvc_yaml_is_what_the_stages_import_and_open():
    path = ROOT / "dvc.yaml"
    entries, wanted = yaml.safe_load(path.read_text(encoding="utf-8")), pipeline(ROOT)
    assert entries["plots"] == wanted["plots"]
    assert differences(entries["stages"], wanted["stages"]) == [], (
        "paste the output of ./run python -m tests.test_house into dvc.yaml"
    )


def test_the_second_pipeline_is_what_its_modules_import_and_declares_no_outs():
    entries = yaml.safe_load((ROOT / PAPERS).read_text(encoding="utf-8"))["stages"]
    assert differences(entries, second_pipeline(ROOT)["stages"]) == [], (
        f"paste the output of ./run python -m tests.test_house papers into {PAPERS}"
    )
    assert not any(kind in entry for entry in entries.values() for kind in ("outs", "metrics", "plots"))


@pytest.mark.parametrize("stage", stages(ROOT))
def test_the_parameters_of_a_stage_are_bounded_and_others_are_refused_by_name(stage, tmp_path):
    module = importlib.import_module(f"stages.{stage}")
    tree = ast.parse((ROOT / f"stages/{stage}.py").read_text(encoding="utf-8"))
    for model, section in loads(stage, tree):
        if not model:
            continue
        kind = getattr(params if model.startswith("params.") else module, model.removeprefix("params."))
        assert unbounded(kind, section) == []
        params.load(kind, section, ROOT / "params.yaml")
        if kind.model_config.get("extra") == "ignore":
            # a part of the section of the stage of that name, which refuses what nobody knows
            assert section != stage and section in stages(ROOT)
            continue
        sections = params.read(ROOT / "params.yaml")
        sections[section]["colour"] = 1
        (tmp_path / "params.yaml").write_text(yaml.safe_dump(sections))
        with pytest.raises(ValueError, match=rf"params.yaml: {section}.colour is unknown; "):
            params.load(kind, section, tmp_path / "params.yaml")


def test_every_section_of_either_file_is_read_by_a_stage():
    for file, entries in params.files(ROOT / "params.yaml").items():
        listed = [entry for stage in stages(ROOT) for entry in expected(ROOT, stage).get("params", [])]
        if Path(file).name == params.EXPERT:
            listed = [key for entry in listed if isinstance(entry, dict) for key in entry[params.EXPERT]]
        read = {entry.split(".")[0] for entry in listed if isinstance(entry, str)}
        ours = {name for name in entries if not name.startswith("x_")}
        assert ours - {"plant", "execution", "nightly"} <= read  # the job reads its own
        assert read <= entries.keys()


def test_the_owner_of_a_machine_has_few_numbers_to_set():
    def leaves(entries) -> int:
        return sum(map(leaves, entries.values())) if isinstance(entries, dict) and entries else 1

    owner, expert = map(leaves, params.files(ROOT / "params.yaml").values())
    assert owner <= 60 and expert > 5 * owner


# ---- the rules see what they should see


def house(root: Path, **sources: str) -> Path:
    """A project of the files given, `__` in a name for a slash."""
    for name, text in sources.items():
        path = root / (name.replace("__", "/") + ".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


def test_what_the_five_rules_forbid_is_seen(tmp_path):
    house(
        tmp_path,
        pipeline__store__artifacts="import pyarrow\nfrom pipeline.reading import csv_layout",
        pipeline__store__tables="from pipeline.temperature.workflow import tables",
        pipeline__reading__csv_layout="from pipeline.temperature import plant",
        pipeline__statistics="import numpy as np\nimport pathlib",
        pipeline__temperature__plant="import numpy as np\nfrom pipeline import "
        "statistics\nfrom pipeline.temperature import plant",
        pipeline__temperature__bad="import time\nfrom pipeline.store import artifacts\n"
        "from pipeline.deposition.ilc import law\n"
        "from . import plant\n"
        "from pipeline.temperature.workflow import settings\nfrom pipeline.runtime import guard\n"
        "from pipeline.temperature.workflow import contestants",
        pipeline__temperature__workflow__contestants="from pipeline.temperature import plant",
        pipeline__temperature__workflow__settings="import jax\nfrom pipeline.store import artifacts",
        pipeline__temperature__workflow__tables="from pipeline.temperature.workflow import ingest",
        pipeline__temperature__workflow__ingest="import joblib\nfrom pipeline.temperature import "
        "plant\nfrom pipeline.reading import "
        "csv_layout\n"
        "from pipeline.deposition import ilc\nfrom pipeline.report import page",
        pipeline__deposition__ilc="import scipy.linalg\nfrom stages import ingest",
        pipeline__runtime__guard="import time\nfrom pipeline.temperature import "
        "plant\nfrom pipeline.store import artifacts\n"
        "from pipeline.temperature.workflow import ingest\nfrom pipeline.reading import csv_layout",
        pipeline__runtime__workflow__settings="from pipeline.store import artifacts\n"
        "from pipeline.runtime import guard",
        pipeline__runtime__workflow__replay="from pipeline.temperature.workflow import ingest\n"
        "from pipeline.reading import csv_layout\nfrom pipeline.runtime import guard\n"
        "from pipeline.report import page",
        pipeline__report__page="from pipeline.temperature.workflow import contestants, tables, "
        "settings\nfrom pipeline.temperature import "
        "plant\nfrom pipeline.nightly import night",
        pipeline__nightly__night="from pipeline.temperature import plant\nfrom pipeline.report import page",
        pipeline__cli="import argparse\nfrom pipeline.nightly import night",
        pipeline__loose="",
        stages__ingest="import json\nfrom pipeline.store import artifacts",
        stages__learn="from stages import ingest",
    )
    places = [sentence.split(": ")[0] for sentence in forbidden_imports(tmp_path)]
    assert places == [
        "pipeline/deposition/ilc.py:2 imports stages.ingest",
        "pipeline/reading/csv_layout.py:1 imports pipeline.temperature.plant",
        "pipeline/report/page.py:2 imports pipeline.temperature.plant",
        "pipeline/report/page.py:3 imports pipeline.nightly.night",
        "pipeline/runtime/guard.py:4 imports pipeline.temperature.workflow.ingest",
        "pipeline/runtime/guard.py:5 imports pipeline.reading.csv_layout",
        "pipeline/runtime/workflow/replay.py:4 imports pipeline.report.page",
        "pipeline/runtime/workflow/settings.py:2 imports pipeline.runtime.guard",
        "pipeline/statistics.py:2 imports pathlib",
        "pipeline/store/tables.py:1 imports pipeline.temperature.tables",
        "pipeline/temperature/bad.py:1 imports time",
        "pipeline/temperature/bad.py:2 imports pipeline.store.artifacts",
        "pipeline/temperature/bad.py:3 imports pipeline.deposition.ilc.law",
        "pipeline/temperature/bad.py:4 imports .plant",
        "pipeline/temperature/bad.py:5 imports pipeline.temperature.settings",
        "pipeline/temperature/bad.py:6 imports pipeline.runtime.guard",
        "pipeline/temperature/bad.py:7 imports pipeline.temperature.workflow.contestants",
        "pipeline/temperature/workflow/ingest.py:4 imports pipeline.deposition.ilc",
        "pipeline/temperature/workflow/ingest.py:5 imports pipeline.report.page",
        "pipeline/temperature/workflow/settings.py:1 imports jax",
        "pipeline/temperature/workflow/tables.py:1 imports pipeline.temperature.workflow.ingest",
        "stages/ingest.py:1 imports json",
        "stages/learn.py:1 imports stages.ingest",
    ]
    assert misplaced(tmp_path) == ["pipeline/loose.py: which room is it of?"]


def test_a_file_opened_or_a_global_seed_outside_the_edge_is_seen(tmp_path):
    house(
        tmp_path,
        pipeline__store__artifacts="open('a', 'w')",
        pipeline__reading__recordings="open('a', 'rb')\nopen('a', 'wb')\npath.open()\npath.write_text('')",
        pipeline__temperature__bad="open('a')\nnp.load('a')\npath.write_text('')\n"
        "np.random.seed(0)\nnp.random.default_rng()\n"
        "np.random.default_rng(1)",
        stages__ingest="artifacts.write_text('a', '')\nparams.load(A, 'a')\npath.read_text()",
    )
    assert [
        sentence.split(":")[0] + sentence.split(":")[1][:2] for sentence in forbidden_files(tmp_path)
    ] == [
        "pipeline/reading/recordings.py2 ",
        "pipeline/reading/recordings.py4 ",
        "pipeline/temperature/bad.py1 ",
        "pipeline/temperature/bad.py2 ",
        "pipeline/temperature/bad.py3 ",
        "stages/ingest.py3 ",
    ]
    assert [sentence.split(" ")[0] for sentence in forbidden_randomness(tmp_path)] == [
        "pipeline/temperature/bad.py:4",
        "pipeline/temperature/bad.py:5",
    ]


def test_input_read_outside_the_frame_of_a_stage_is_seen(tmp_path):
    house(
        tmp_path,
        stages__good="def main():\n    with artifacts.stage('good') as "
        "out:\n        params.load(Good, 'good')",
        stages__bad="def main():\n    p = params.load(Bad, 'bad')\n    "
        "with artifacts.stage('bad') as out:\n       "
        " artifacts.read_json('a')",
    )
    assert unframed(tmp_path) == [
        "stages/bad.py:2 params.load(Bad, 'bad'): move it into `with artifacts.stage(...)`"
    ]


def test_judging_needs_no_kernel_that_the_record_may_not_determine():
    assert "datasets/learn_kernel" in expected(ROOT, "evaluate_temperature")["deps"]


STAGE = '''"""Reads datasets/raw/temperature; writes datasets/learn."""
from pipeline.store import artifacts, params
from pipeline.report import page
params.load(Learn, "learn")
params.value("probe.source", one_of=("a",))
with artifacts.stage("learn") as out:
    artifacts.read_table("datasets/ingest/record.parquet", RECORD)
    artifacts.read_metrics("ingest")
    memo = "datasets/memo/learn"
    artifacts.write_text("reports/learn.html", "")
    artifacts.write_metrics("learn", {})
'''


@pytest.fixture
def toy(tmp_path):
    house(
        tmp_path,
        pipeline__store__artifacts="import pyarrow",
        pipeline__store__params="",
        pipeline__report__page="import pipeline.store.tables",
        pipeline__store__tables="import numpy",
        pipeline__unused="1",
        stages__learn=STAGE,
        stages__ingest="from pipeline.store import artifacts\nwith artifacts.stage('ingest') as out:\n    "
        "artifacts.write_metrics('ingest', {})\n",
    )
    (tmp_path / "pipeline/report/templates").mkdir()
    (tmp_path / "pipeline/report/templates/page.html").write_text("")
    (tmp_path / "pipeline/report/__pycache__").mkdir()
    (tmp_path / "pipeline/report/__pycache__/page.pyc").write_text("")
    return tmp_path


def test_an_entry_of_dvc_yaml_is_derived_from_the_stage(toy):
    assert expected(toy, "learn") == {
        "cmd": "python -m stages.learn",
        "deps": [
            "stages/learn.py",
            "pipeline/report/page.py",
            "pipeline/store/artifacts.py",
            "pipeline/store/tables.py",
            "pipeline/report/templates",
            "datasets/ingest/record.parquet",
            "reports/metrics/ingest.json",
        ],
        "params": ["learn", "probe.source"],
        "outs": [{"datasets/learn": {"persist": True}}, {"reports/learn.html": {"persist": True}}],
        "metrics": [{"reports/metrics/learn.json": {"cache": False, "persist": True}}],
    }
    assert list(pipeline(toy)["stages"]) == ["ingest", "learn"]


def test_a_stage_lists_each_parameter_under_the_files_in_which_it_stands(toy):
    (toy / "params.yaml").write_text("learn: {seed: 1}\nprobe: {seed: 1}\n")
    (toy / "params.expert.yaml").write_text("learn: {order: 2}\nprobe: {source: a}\n")
    assert expected(toy, "learn")["params"] == ["learn", {"params.expert.yaml": ["learn", "probe.source"]}]
    (toy / "params.expert.yaml").write_text("probe: {source: a}\n")
    assert expected(toy, "learn")["params"] == ["learn", {"params.expert.yaml": ["probe.source"]}]
    with (toy / "stages/learn.py").open("a") as file:
        file.write("    params.read()\n")
    assert {"params.yaml", "params.expert.yaml"} <= set(expected(toy, "learn")["deps"])


def test_a_dvc_yaml_that_lacks_or_has_too_much_is_seen(toy):
    wanted = pipeline(toy)["stages"]
    entries = yaml.safe_load(yaml.safe_dump(wanted))
    assert differences(entries, wanted) == []
    entries["learn"]["deps"].remove("pipeline/store/tables.py")
    entries["learn"]["outs"][0] = "datasets/learn"
    entries["learn"]["always_changed"] = "yes"
    entries["old"] = {}
    assert differences(entries, wanted) == [
        "old: stage is not in stages/",
        "learn: always_changed has yes",
        "learn: deps lacks pipeline/store/tables.py",
        "learn: outs lacks {datasets/learn: {persist: true}}",
        "learn: outs has datasets/learn",
    ]


@pytest.mark.parametrize(
    "line",
    [
        "params.load(Learn, name)",
        "artifacts.read_metrics(name)",
        "artifacts.read_json(f'datasets/{name}/a.json')",
    ],
)
def test_a_path_or_section_that_cannot_be_read_off_is_refused(toy, line):
    (toy / "stages/learn.py").write_text(STAGE + f"    {line}\n")
    with pytest.raises(AssertionError, match=r"stages/learn.py:12 .* out, so that one can grep for it"):
        expected(toy, "learn")


def test_a_number_without_bounds_and_a_default_are_seen():
    class Inner(params.Section):
        gain: float = Field(ge=0)

    class Outer(params.Section):
        seed: int
        good: int = Field(ge=0, le=9)
        several: tuple[Annotated[float, Field(gt=0, lt=1)], ...]
        loose: list[float] = Field(min_length=1)
        maybe: int | None = Field(ge=0, le=9)
        method: typing.Literal[1, 2]
        inner: list[Inner]
        other: bool = True

    assert unbounded(Outer, "learn") == [
        "learn.other has a default",
        "learn.seed has no lower bound",
        "learn.seed has no upper bound",
        "learn.loose has no lower bound",
        "learn.loose has no upper bound",
        "learn.inner.gain has no upper bound",
    ]


if __name__ == "__main__":
    wanted = second_pipeline(ROOT) if sys.argv[1:] == ["papers"] else pipeline(ROOT)
    yaml.safe_dump(wanted, sys.stdout, sort_keys=False, width=200)
