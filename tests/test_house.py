"""Who may know whom, and what dvc.yaml must name: both read off the syntax tree."""

import ast
import importlib
import typing
from pathlib import Path
from typing import Annotated

import pytest
import yaml
from pydantic import Field

from pipeline.store import artifacts, params
from tests import house
from tests.house import ROOT

PIPELINE = yaml.safe_load((ROOT / "dvc.yaml").read_text(encoding="utf-8"))
SECOND = yaml.safe_load((ROOT / house.PAPERS).read_text(encoding="utf-8"))


# ---- the house as it stands


@pytest.mark.parametrize(
    "rule",
    [
        house.misplaced,
        house.forbidden_imports,
        house.forbidden_files,
        house.forbidden_randomness,
        house.unframed,
    ],
)
def test_the_house_keeps_the_rule(rule):
    assert rule(ROOT) == []


def test_few_class_names_stand_in_two_modules():
    doubles = house.doubles(ROOT)
    assert len(doubles) <= house.DOUBLES, doubles


def test_every_stage_stands_in_dvc_yaml_after_those_that_it_reads():
    assert sorted(PIPELINE["stages"]) == house.stages(ROOT)
    made = set()
    for stage, entry in PIPELINE["stages"].items():
        for dep in entry["deps"]:
            parts = dep.split("/")
            assert parts[0] != "datasets" or parts[1] in made or parts[1] not in PIPELINE["stages"], (
                stage,
                dep,
            )
        made.add(stage)


@pytest.mark.parametrize("stage", house.stages(ROOT))
def test_dvc_yaml_names_what_the_stage_reads_and_writes(stage):
    entry = PIPELINE["stages"][stage]
    assert house.differences(stage, entry, house.expected(ROOT, stage)) == []
    assert entry["cmd"] == f"python -m stages.{stage}"
    if stage != "report":  # its pages show the digest of all code
        assert house.coarse(stage, entry["deps"]) == []


@pytest.mark.parametrize("stage", house.papers(ROOT))
def test_the_second_pipeline_names_what_its_modules_read_and_has_no_outs(stage):
    entry = SECOND["stages"][stage]
    assert house.differences(stage, entry, house.expected_of_paper(ROOT, stage)) == []
    assert (entry["cmd"], entry["wdir"]) == (f"python -m pipeline.papers.{stage}", "../..")
    assert not {"outs", "metrics", "plots"} & entry.keys()


@pytest.mark.parametrize("file", ["dvc.yaml", house.PAPERS])
def test_the_pipelines_can_be_read(file):
    lines = (ROOT / file).read_text(encoding="utf-8").splitlines()
    assert len(lines) <= house.MOST_LINES and max(map(len, lines)) <= house.WIDEST


def test_plots_are_the_learning_curves_that_stages_write():
    curves = [
        {f"datasets/{stage}/live/plots/metrics": {"x": "step"}}
        for stage in PIPELINE["stages"]
        if "write_learning_curve" in (ROOT / f"stages/{stage}.py").read_text(encoding="utf-8")
    ]
    assert PIPELINE["plots"] == curves


# ---- metrics


def leaves(data) -> int:
    inner = data.values() if isinstance(data, dict) else data
    return sum(map(leaves, inner)) if isinstance(data, dict | list) else 1


def test_metrics_are_few_and_no_digests():
    files = [path for path in (ROOT / "reports/metrics").glob("*.json") if path.stem != "nightly"]
    assert sum(leaves(artifacts.read_json(path)) for path in files) <= 800
    assert not [path.name for path in files if house.digests(path.read_text(encoding="utf-8"))]


@pytest.mark.parametrize("stage", house.stages(ROOT))
def test_every_pattern_of_metrics_finds_a_figure_in_the_committed_run(stage):
    metrics = house.constant(ROOT, stage, "METRICS")
    kept = ROOT / f"reports/metrics/{stage}.json"
    assert bool(metrics) == kept.exists()
    if metrics:
        figures = artifacts.read_json(kept)
        unused = [one for one in metrics if not artifacts.matching(figures, [one.split(".")])]
        assert not unused and artifacts.matching(figures, [one.split(".") for one in metrics]) == figures


def test_the_headline_of_a_loop_fits_into_a_table_of_200_columns():
    """`dvc exp show --only-changed` of one loop: names of the run, time, and two parameters take 90."""
    values = artifacts.read_json(ROOT / house.HEADLINE)
    loop, widths = "", {}
    for name, value in values.items():
        loop = name if isinstance(value, str) else loop
        if not isinstance(value, dict):
            widths[loop] = (
                widths.get(loop, 0) + 2 + max(len(name), len(value) if isinstance(value, str) else 10)
            )
    assert list(widths) == list(house.LOOPS) and max(widths.values()) <= 110


# ---- parameters


@pytest.mark.parametrize("stage", house.stages(ROOT))
def test_the_parameters_of_a_stage_are_bounded_and_others_are_refused_by_name(stage, tmp_path):
    module = importlib.import_module(f"stages.{stage}")
    tree = ast.parse((ROOT / f"stages/{stage}.py").read_text(encoding="utf-8"))
    for model, section in house.loads(stage, tree):
        if not model:
            continue
        kind = getattr(params if model.startswith("params.") else module, model.removeprefix("params."))
        assert house.unbounded(kind, section) == []
        params.load(kind, section, ROOT / "params.yaml")
        if kind.model_config.get("extra") == "ignore":
            # a part of the section of the stage of that name, which refuses what nobody knows
            assert section != stage and section in house.stages(ROOT)
            continue
        sections = params.read(ROOT / "params.yaml")
        sections[section]["colour"] = 1
        (tmp_path / "params.yaml").write_text(yaml.safe_dump(sections))
        with pytest.raises(ValueError, match=rf"params.yaml: {section}.colour is unknown; "):
            params.load(kind, section, tmp_path / "params.yaml")


def test_every_section_of_either_file_is_read_by_a_stage():
    listed = {key for stage in house.stages(ROOT) for key in house.expected(ROOT, stage).params}
    for file, entries in params.files(ROOT / "params.yaml").items():
        begin = f"{params.EXPERT}: " if Path(file).name == params.EXPERT else ""
        ours = {name for name in entries if not name.startswith("x_")}
        read = {key.removeprefix(begin).split(".")[0] for key in listed if (": " in key) == bool(begin)}
        assert ours - {"plant", "execution", "nightly"} <= read  # the job reads its own
        assert read <= entries.keys()


def test_the_owner_of_a_machine_has_few_numbers_to_set():
    owner, expert = map(leaves, params.files(ROOT / "params.yaml").values())
    assert owner <= 70 and expert > 5 * owner


# ---- the rules see what they should see


def write(root: Path, files: dict[str, str]) -> Path:
    """A project of these files."""
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


METHOD, BAD = "import numpy as np\nfrom pipeline import statistics\n", "pipeline/temperature/bad.py"
ALLOWED = {
    "pipeline/statistics.py": "import numpy as np",
    "pipeline/store/artifacts.py": "import pyarrow",
    "pipeline/reading/csv.py": "from pipeline.store import artifacts",
    "pipeline/temperature/plant.py": METHOD,
    "pipeline/temperature/kernel.py": "from pipeline.temperature import plant",
    "pipeline/temperature/settings.py": "from pipeline.store import artifacts",
    "pipeline/temperature/controllers.py": "from pipeline.temperature import kernel",
    "pipeline/temperature/nets/files.py": "from pipeline.temperature import kernel\nimport pathlib\n"
    "from pipeline.store import artifacts",
    "pipeline/deposition/ilc.py": "import scipy.linalg",
    "pipeline/verdict/rules.py": "from pipeline.temperature import controllers, settings\n"
    "from pipeline import statistics",
    "pipeline/runtime/machine.py": "import time\nfrom pipeline.temperature import kernel\n"
    "from pipeline.verdict import rules",
    "pipeline/report/page.py": "from pipeline.verdict import rules\nfrom pipeline.temperature import controllers",
    "pipeline/nightly/night.py": "from pipeline.commands import watch\nfrom pipeline.verdict import rules",
    "pipeline/commands/watch.py": "from pipeline.reading import csv\nfrom pipeline.deposition import ilc",
    "pipeline/papers/study.py": "from stages import learn",
    "pipeline/cli.py": "from pipeline.report import page\nfrom pipeline.commands import watch",
    "stages/learn.py": "from pipeline.report import page\nfrom pipeline.deposition import ilc",
}


@pytest.mark.parametrize(
    ("name", "line", "reason"),
    [
        (BAD, "import time", "knows arrays, nothing of files, clocks, processes or figures"),
        (BAD, "from . import plant", "write the whole name"),
        (BAD, "from pipeline.store import artifacts", "temperature must not know store"),
        (BAD, "from pipeline.deposition import ilc", "temperature must not know deposition"),
        (BAD, "from pipeline.temperature import settings", "temperature must not know temperature/plain"),
        (BAD, "from pipeline.temperature.nets import files", "temperature must not know temperature/files"),
        (BAD, "from pipeline.runtime import machine", "temperature must not know runtime"),
        ("pipeline/statistics.py", "import pathlib", "knows arrays, nothing of files"),
        ("pipeline/store/tables.py", "from pipeline.reading import csv", "store must not know reading"),
        (
            "pipeline/store/tables.py",
            "from pipeline.temperature import settings",
            "must not know temperature/plain",
        ),
        (
            "pipeline/reading/log.py",
            "from pipeline.temperature import plant",
            "reading must not know temperature",
        ),
        ("pipeline/deposition/tables.py", "import jax", "what other rooms read imports nothing heavy"),
        (
            "pipeline/verdict/figures.py",
            "from pipeline.temperature import plant",
            "verdict must not know temperature",
        ),
        ("pipeline/verdict/figures.py", "from pipeline.report import page", "verdict must not know report"),
        (
            "pipeline/report/chart.py",
            "from pipeline.temperature import plant",
            "report must not know temperature",
        ),
        ("pipeline/report/chart.py", "from pipeline.reading import csv", "report must not know reading"),
        ("pipeline/runtime/c.py", "from pipeline.reading import csv", "runtime must not know reading"),
        ("pipeline/runtime/c.py", "from pipeline.report import page", "runtime must not know report"),
        ("pipeline/nightly/drift.py", "from pipeline.report import page", "nightly must not know report"),
        ("pipeline/commands/init.py", "from pipeline.report import page", "commands must not know report"),
        ("stages/export.py", "from pipeline.commands import watch", "stages must not know commands"),
        ("pipeline/quick.py", "from tests import house", "nothing imports a test or a benchmark"),
        ("stages/export.py", "import benchmarks.results", "nothing imports a test or a benchmark"),
    ],
)
def test_an_import_that_the_table_forbids_is_seen(tmp_path, name, line, reason):
    write(tmp_path, {**ALLOWED, "tests/house.py": "", "pipeline/store/params.py": ""})
    assert house.forbidden_imports(tmp_path) == []
    write(tmp_path, {name: f"import math\n{line}"})
    (sentence,) = house.forbidden_imports(tmp_path)
    assert sentence.startswith(f"{name}:2 imports ") and reason in sentence


def test_a_file_of_no_room_a_folder_of_workflows_and_a_double_name_are_seen(tmp_path):
    write(
        tmp_path,
        {
            "pipeline/loose.py": "class Row: pass",
            "pipeline/temperature/workflow/ingest.py": "class Row: pass\nclass Other: pass",
        },
    )
    assert house.misplaced(tmp_path) == [
        "pipeline/loose.py: which room is it of?",
        "pipeline/temperature/workflow: a stage is one file; its methods lie in the loop",
    ]
    assert house.doubles(tmp_path) == {
        "Row": ["pipeline/loose.py", "pipeline/temperature/workflow/ingest.py"]
    }


def test_a_file_opened_or_a_global_seed_outside_the_edge_is_seen(tmp_path):
    write(
        tmp_path,
        {
            "pipeline/store/artifacts.py": "open('a', 'w')",
            "pipeline/reading/recordings.py": "open('a', 'rb')\nopen('a', 'wb')\npath.open()\npath.write_text('')",
            "pipeline/temperature/bad.py": "open('a')\nnp.load('a')\npath.write_text('')\n"
            "np.random.seed(0)\nnp.random.default_rng()\nnp.random.default_rng(1)",
            "stages/ingest.py": "artifacts.write_text('a', '')\nparams.load(A, 'a')\npath.read_text()",
        },
    )
    assert [sentence.split(" ")[0] for sentence in house.forbidden_files(tmp_path)] == [
        "pipeline/reading/recordings.py:2",
        "pipeline/reading/recordings.py:4",
        "pipeline/temperature/bad.py:1",
        "pipeline/temperature/bad.py:2",
        "pipeline/temperature/bad.py:3",
        "stages/ingest.py:3",
    ]
    assert [sentence.split(" ")[0] for sentence in house.forbidden_randomness(tmp_path)] == [
        "pipeline/temperature/bad.py:4",
        "pipeline/temperature/bad.py:5",
    ]


def test_input_read_outside_the_frame_of_a_stage_is_seen(tmp_path):
    good = "def main():\n    with artifacts.stage('good') as out:\n        params.load(Good, 'good')"
    bad = (
        "def main():\n    p = params.load(Bad, 'bad')\n    with artifacts.stage('bad') as out:\n        pass"
    )
    write(tmp_path, {"stages/good.py": good, "stages/bad.py": bad})
    assert house.unframed(tmp_path) == [
        "stages/bad.py:2 params.load(Bad, 'bad'): move it into `with artifacts.stage(...)`"
    ]


STAGE = '''"""Reads datasets/raw/temperature; writes datasets/learn."""
import stages
from pipeline.store import artifacts, params
from pipeline.report import page
params.load(Learn, "learn")
params.value("probe.source", one_of=("a",))
with artifacts.stage("learn") as out:
    artifacts.read_table("datasets/ingest/record.parquet", RECORD)
    artifacts.read_figures("ingest")
    memo = "datasets/memo/learn"
    artifacts.write_text("reports/learn.html", "")
    artifacts.write_metrics("learn", {}, METRICS)
stages.run(main, "learn", loop="temperature")
'''
KEPT, IN_GIT = {"persist": True}, {"cache": False, "persist": True}
ENTRY = {
    "deps": [
        *("stages/__init__.py", "stages/learn.py", "pipeline/store", "pipeline/report"),
        *("datasets/ingest/figures.json", "datasets/ingest/record.parquet"),
    ],
    "params": ["learn", "loops.temperature", {"params.expert.yaml": ["learn", "probe.source"]}],
    "outs": [{"datasets/learn": KEPT}, {"reports/learn.html": KEPT}, {"reports/metrics/learn.json": IN_GIT}],
}


@pytest.fixture
def toy(tmp_path):
    return write(
        tmp_path,
        {
            "stages/__init__.py": "def run(main, name, loop=''):\n    params.load(params.Loops, 'loops')",
            "stages/learn.py": STAGE,
            "pipeline/store/artifacts.py": "import pyarrow",
            "pipeline/store/params.py": "",
            "pipeline/report/page.py": "import pipeline.store.tables",
            "pipeline/report/templates/page.html": "",
            "pipeline/report/__pycache__/page.pyc": "",
            "pipeline/store/tables.py": "import numpy",
            "pipeline/unused/other.py": "1",
            "params.yaml": "learn: {seed: 1}\nloops: {temperature: true}\n",
            "params.expert.yaml": "learn: {order: 2}\nprobe: {source: a}\n",
        },
    )


def test_what_a_stage_reads_and_writes_is_read_off_its_code(toy):
    reads = house.expected(toy, "learn")
    assert reads.code >= {"stages/learn.py", "pipeline/report/page.py", "pipeline/report/templates/page.html"}
    assert house.differences("learn", ENTRY, reads) == []


@pytest.mark.parametrize(
    ("kind", "place", "entry", "sentences"),
    [
        ("deps", 2, "pipeline/store/tables.py", ["deps lacks pipeline/store/artifacts.py"]),
        ("deps", 3, "pipeline/report/page.py", ["deps lacks pipeline/report/templates/page.html"]),
        ("deps", 3, "pipeline/unused", ["deps lacks pipeline/report/page.py", "deps has pipeline/unused"]),
        (
            "deps",
            5,
            "datasets/ingest",
            ["deps lacks datasets/ingest/record.parquet", "deps has datasets/ingest"],
        ),
        ("params", 1, "learn", ["params lacks loops.temperature"]),
        ("params", 2, "probe", ["params lacks params.expert.yaml: learn", "params has probe"]),
        (
            "outs",
            0,
            "datasets/learn",
            ["outs lacks datasets/learn [('persist', True)]", "outs has datasets/learn []"],
        ),
    ],
)
def test_an_entry_that_lacks_or_has_too_much_is_seen(toy, kind, place, entry, sentences):
    changed = {**ENTRY, kind: [*ENTRY[kind]]}
    changed[kind][place] = entry
    told = house.differences("learn", changed, house.expected(toy, "learn"))
    assert {f"learn: {sentence}" for sentence in sentences} <= set(told)


def test_parameters_read_whole_are_deps_of_both_files(toy):
    with (toy / "stages/learn.py").open("a") as file:
        file.write("params.read()\n")
    assert {"params.yaml", "params.expert.yaml"} <= house.expected(toy, "learn").data


def test_a_loop_named_whole_too_many_methods_and_a_part_of_a_shared_room_are_seen():
    nine = [f"pipeline/setpoint/{name}.py" for name in "abcdefghi"]
    assert house.coarse("learn", [*nine[:8], "pipeline/setpoint/tables.py", "pipeline/store"]) == []
    assert house.coarse("learn", [*nine, "pipeline/deposition", "pipeline/store/params.py"]) == [
        "learn: name the methods of pipeline/deposition that it imports",
        "learn: 9 methods of pipeline/setpoint; name folders",
        "learn: name pipeline/store whole",
    ]


@pytest.mark.parametrize(
    "line",
    [
        "params.load(Learn, name)",
        "artifacts.read_figures(name)",
        "artifacts.read_json(f'datasets/{name}/a.json')",
    ],
)
def test_a_path_or_section_that_cannot_be_read_off_is_refused(toy, line):
    (toy / "stages/learn.py").write_text(STAGE + f"{line}\n")
    with pytest.raises(AssertionError, match=r"stages/learn.py:14 .* out, so that one can grep for it"):
        house.expected(toy, "learn")


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

    assert set(house.unbounded(Outer, "learn")) == {
        "learn.other has a default",
        "learn.seed has no lower bound",
        "learn.seed has no upper bound",
        "learn.loose has no lower bound",
        "learn.loose has no upper bound",
        "learn.inner.gain has no upper bound",
    }
