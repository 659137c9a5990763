"""Who may know whom, and what dvc.yaml must name: both read off the syntax tree."""

import importlib
from pathlib import Path

import pytest
import yaml

from pipeline.store import artifacts, params
from tests import house
from tests.house import ROOT

PIPELINE, SECOND = (yaml.safe_load((ROOT / file).read_text()) for file in ("dvc.yaml", house.PAPERS))
RULES = [house.misplaced, house.forbidden_imports, house.forbidden_files]
RULES += [house.forbidden_randomness, house.unframed]


# ---- the house as it stands


@pytest.mark.parametrize("rule", RULES)
def test_the_house_keeps_the_rule(rule):
    assert rule(ROOT) == []


def test_few_class_names_stand_in_two_modules():
    assert len(house.doubles(ROOT)) <= 40, house.doubles(ROOT)


def test_every_stage_stands_in_dvc_yaml_after_those_that_it_reads():
    order = list(PIPELINE["stages"])
    assert sorted(order) == house.stages(ROOT)
    for stage, entry in PIPELINE["stages"].items():
        before = {dep.split("/")[1] for dep in entry["deps"] if dep.startswith("datasets/")} & {*order}
        assert before <= set(order[: order.index(stage)]), stage


@pytest.mark.parametrize("stage", house.stages(ROOT))
def test_dvc_yaml_names_what_the_stage_reads_and_writes(stage):
    entry = PIPELINE["stages"][stage]
    assert house.differences(stage, entry, house.expected(ROOT, f"stages/{stage}.py")) == []
    assert entry["cmd"] == f"python -m stages.{stage}"
    assert (
        stage == "report" or house.coarse(stage, entry["deps"]) == []
    )  # its pages show the digest of all code


@pytest.mark.parametrize("stage", SECOND["stages"])
def test_the_second_pipeline_names_what_its_modules_read_and_has_no_outs(stage):
    entry = SECOND["stages"][stage]
    assert house.differences(stage, entry, house.expected_of_paper(ROOT, stage)) == []
    assert (entry["cmd"], entry["wdir"]) == (f"python -m pipeline.papers.{stage}", "../..")
    assert not {"outs", "metrics", "plots"} & entry.keys()


@pytest.mark.parametrize("file", ["dvc.yaml", house.PAPERS])
def test_people_can_read_the_pipeline(file):
    lines = (ROOT / file).read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 320 and max(map(len, lines)) <= 120


def test_plots_are_the_learning_curves_that_stages_write():
    writers = [stage for stage in PIPELINE["stages"] if "write_learning_curve" in source(stage)]
    assert PIPELINE["plots"] == [{f"datasets/{stage}/live/plots/metrics": {"x": "step"}} for stage in writers]


def source(stage: str) -> str:
    return (ROOT / f"stages/{stage}.py").read_text(encoding="utf-8")


def test_every_section_of_either_file_is_read_by_a_stage():
    wanted = [house.expected(ROOT, f"stages/{stage}.py") for stage in house.stages(ROOT)]
    read = {key.rpartition(": ")[2].split(".")[0] for one in wanted for key in one["params"]}
    sections = {
        name for file in (params.FILE, params.EXPERT) for name in yaml.safe_load((ROOT / file).read_text())
    }
    assert {name for name in sections if not name.startswith("x_")} - {"execution", "nightly"} == read


# ---- metrics


def leaves(data) -> int:
    inner = data.values() if isinstance(data, dict) else data
    return sum(map(leaves, inner)) if isinstance(data, dict | list) else 1


def test_metrics_are_few_figures_and_each_pattern_finds_one():
    total = 0
    for stage in [stage for stage in house.stages(ROOT) if "write_metrics" in source(stage)]:
        metrics, kept = (
            importlib.import_module(f"stages.{stage}").METRICS,
            Path(f"reports/metrics/{stage}.json"),
        )
        figures = artifacts.read_json(ROOT / kept)
        for pattern in metrics:
            assert artifacts.matching(figures, [pattern.split(".")]), f"{stage}: {pattern} finds nothing"
        assert artifacts.matching(figures, [pattern.split(".") for pattern in metrics]) == figures
        total += leaves(figures)
    assert total <= 800


def test_the_headline_of_a_loop_fits_into_a_table_of_200_columns():
    """`dvc exp show --only-changed`: the run, its time and two parameters take 90."""
    values, widths = artifacts.read_json(ROOT / house.HEADLINE), {}
    for name, value in [(name, value) for name, value in values.items() if name != "bands"]:
        loop = name if name in house.LOOPS else list(widths)[-1]
        widths[loop] = widths.get(loop, 0) + 2 + max(len(name), len(str(value)) if name == loop else 8)
    assert list(widths) == [*house.LOOPS] and max(widths.values()) <= 110


# ---- the rules see what they should see


def write(root: Path, files: dict[str, str]) -> Path:
    """A project of these files."""
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


ALLOWED = {
    "pipeline/statistics.py": "import numpy as np",
    "pipeline/store/artifacts.py": "import pyarrow",
    "pipeline/recordings/csv.py": "from pipeline.store import artifacts",
    "pipeline/temperature/plant.py": "import numpy as np\nfrom pipeline import statistics",
    "pipeline/temperature/kernel.py": "from pipeline.temperature import plant",
    "pipeline/temperature/settings.py": "from pipeline.store import artifacts",
    "pipeline/temperature/controllers.py": "from pipeline.temperature import kernel",
    "pipeline/temperature/nets/files.py": "import pathlib\nfrom pipeline.store import artifacts",
    "pipeline/temperature/design.py": "from pipeline.temperature import controllers",
    "pipeline/deposition/ilc.py": "import scipy.linalg",
    "pipeline/deposition/controllers.py": "",
    "pipeline/verdict/rules.py": "from pipeline.temperature import controllers, settings",
    "pipeline/deploy/machine.py": "import time\nfrom pipeline.temperature import kernel",
    "pipeline/report/page.py": "from pipeline.verdict import rules",
    "pipeline/nightly/night.py": "from pipeline.commands import watch\nfrom pipeline.verdict import rules",
    "pipeline/commands/watch.py": "from pipeline.recordings import csv\nfrom pipeline.deposition import ilc",
    "pipeline/papers/study.py": "from stages import learn",
    "pipeline/cli.py": "from pipeline.report import page\nfrom pipeline.commands import watch",
    "stages/learn.py": "from pipeline.report import page\nfrom pipeline.deposition import ilc",
    "tests/house.py": "",
}


@pytest.mark.parametrize(
    ("room", "line", "reason"),
    [
        ("temperature", "import time", "knows arrays, nothing of files, clocks, processes or figures"),
        ("temperature", "from . import plant", "write the whole name"),
        ("temperature", "from pipeline.store import artifacts", "temperature must not know store"),
        ("temperature", "from pipeline.deposition import ilc", "temperature must not know deposition"),
        ("temperature", "from pipeline.deposition import controllers", "must not know deposition/constants"),
        ("temperature", "from pipeline.temperature import settings", "must not know temperature/plain"),
        ("temperature", "from pipeline.temperature.nets import files", "must not know temperature/files"),
        ("temperature", "from pipeline.deploy import machine", "temperature must not know deploy"),
        ("store", "from pipeline.recordings import csv", "store must not know recordings"),
        ("store", "from pipeline.temperature import settings", "store must not know temperature/plain"),
        ("recordings", "from pipeline.temperature import plant", "recordings must not know temperature"),
        ("verdict", "from pipeline.temperature import plant", "verdict must not know temperature"),
        ("verdict", "from pipeline.report import page", "verdict must not know report"),
        ("report", "from pipeline.temperature import plant", "report must not know temperature"),
        ("report", "from pipeline.recordings import csv", "report must not know recordings"),
        ("deploy", "from pipeline.recordings import csv", "deploy must not know recordings"),
        ("nightly", "from pipeline.report import page", "nightly must not know report"),
        ("commands", "from pipeline.report import page", "commands must not know report"),
        ("report", "from stages import learn", "report must not know stages"),
        ("deploy", "from pipeline.commands import watch", "deploy must not know commands"),
        ("nightly", "from tests import house", "nothing imports a test or a benchmark"),
        ("commands", "import benchmarks.results", "nothing imports a test or a benchmark"),
    ],
)
def test_an_import_that_the_table_forbids_is_seen(tmp_path, room, line, reason):
    write(tmp_path, ALLOWED)
    assert house.forbidden_imports(tmp_path) == []
    write(tmp_path, {f"pipeline/{room}/bad.py": f"import math\n{line}"})
    (sentence,) = house.forbidden_imports(tmp_path)
    assert sentence.startswith(f"pipeline/{room}/bad.py:2 imports ") and reason in sentence


def test_a_file_of_no_room_a_folder_of_workflows_and_a_double_name_are_seen(tmp_path):
    loose, workflow = "pipeline/loose.py", "pipeline/temperature/workflow/ingest.py"
    write(tmp_path, {loose: "class Row: pass", workflow: "class Row: pass\nclass Other: pass"})
    assert house.misplaced(tmp_path) == [
        "pipeline/loose.py: which room is it of?",
        "pipeline/temperature/workflow: a stage is one file; its methods lie in the loop",
    ]
    assert house.doubles(tmp_path) == {"Row": [loose, workflow]}


def test_a_file_opened_or_a_global_seed_outside_the_edge_is_seen(tmp_path):
    write(
        tmp_path,
        {
            "pipeline/store/artifacts.py": "open('a', 'w')",
            "pipeline/recordings/a.py": "open('a', 'rb')\nopen('a', 'wb')\npath.open()\npath.write_text('')",
            "pipeline/temperature/bad.py": "open('a')\nnp.load('a')\npath.write_text('')\n"
            "np.random.seed(0)\nnp.random.default_rng()\nnp.random.default_rng(1)",
            "stages/ingest.py": "artifacts.write_text('a', '')\nparams.load(A, 'a')\npath.read_text()",
        },
    )
    places = ["pipeline/recordings/a.py:2", "pipeline/recordings/a.py:4"]
    places += [f"pipeline/temperature/bad.py:{line}" for line in (1, 2, 3)] + ["stages/ingest.py:3"]
    assert [sentence.split(" ")[0] for sentence in house.forbidden_files(tmp_path)] == places
    seeds = [f"pipeline/temperature/bad.py:{line}" for line in (4, 5)]
    assert [sentence.split(" ")[0] for sentence in house.forbidden_randomness(tmp_path)] == seeds


def test_input_read_outside_the_frame_of_a_stage_is_seen(tmp_path):
    good = "def main():\n    with artifacts.stage('good') as out:\n        params.load(Good, 'good')"
    bad = "def main():\n    p = params.load(Bad, 'bad')\n    with artifacts.stage('bad'):\n        pass"
    write(tmp_path, {"stages/good.py": good, "stages/bad.py": bad})
    assert house.unframed(tmp_path) == [
        "stages/bad.py:2 params.load(Bad, 'bad'): move it into `with artifacts.stage(...)`"
    ]


STAGE = '''"""Reads datasets/raw/temperature; writes datasets/learn."""
import stages
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
ENTRY = """
deps: [stages/__init__.py, stages/learn.py, pipeline/store, pipeline/report,
  datasets/ingest/figures.json, datasets/ingest/record.parquet]
params: [learn, loops.temperature, params.expert.yaml: [learn, probe.source]]
outs: [datasets/learn: {persist: true}, reports/learn.html: {persist: true},
  reports/metrics/learn.json: {cache: false, persist: true}]
"""
TOY = {
    "stages/__init__.py": "def run(main, name, loop=''):\n    params.load(params.Loops, 'loops')",
    "stages/learn.py": STAGE,
    "pipeline/report/page.py": "import pipeline.store.tables",
    "pipeline/report/templates/page.html": "",
    "pipeline/report/__pycache__/page.pyc": "",
    "pipeline/store/tables.py": "import numpy",
    "pipeline/unused/other.py": "1",
    "params.yaml": "learn: {seed: 1}\nloops: {temperature: true}\n",
    "params.expert.yaml": "learn: {order: 2}\nprobe: {source: a}\n",
}


@pytest.mark.parametrize(
    ("before", "after", "sentences"),
    [
        ("", "", []),
        ("pipeline/store,", "", ["deps lacks pipeline/store/tables.py"]),
        ("pipeline/report,", "pipeline/report/page.py,", ["deps lacks pipeline/report/templates/page.html"]),
        ("pipeline/report,", "pipeline/report, pipeline/unused,", ["deps has pipeline/unused"]),
        ("ingest/record.parquet", "ingest/quality.parquet", [
            "deps lacks datasets/ingest/record.parquet", "deps has datasets/ingest/quality.parquet",
        ]),
        ("loops.temperature, ", "", ["params lacks loops.temperature"]),
        (": [learn, probe.source]", ": [learn]", ["params lacks params.expert.yaml: probe.source"]),
        ("learn: {persist: true}", "learn: {}", [
            "outs lacks datasets/learn persist", "outs has datasets/learn",
        ]),
    ],
)  # fmt: skip
def test_an_entry_that_lacks_or_has_too_much_is_seen(tmp_path, before, after, sentences):
    wanted = house.expected(write(tmp_path, TOY), "stages/learn.py")
    entry = yaml.safe_load(ENTRY.replace(before, after) if before else ENTRY)
    assert house.differences("learn", entry, wanted) == [f"learn: {sentence}" for sentence in sentences]


def test_parameters_that_are_read_whole_are_deps_of_both_files(tmp_path):
    write(tmp_path, {**TOY, "stages/learn.py": STAGE + "params.read()\n"})
    assert {"params.yaml", "params.expert.yaml"} <= house.expected(tmp_path, "stages/learn.py")["deps"]


def test_a_loop_named_whole_too_many_methods_and_a_part_of_a_shared_room_are_seen():
    nine = [f"pipeline/setpoint/{name}.py" for name in "abcdefghi"]
    assert house.coarse("learn", [*nine[:8], "pipeline/setpoint/tables.py", "pipeline/store"]) == []
    assert house.coarse("learn", [*nine, "pipeline/deposition", "pipeline/store/params.py"]) == [
        "learn: name pipeline/store whole",
        "learn: name at most 8 files or folders of pipeline/deposition",
        "learn: name at most 8 files or folders of pipeline/setpoint",
    ]


@pytest.mark.parametrize(
    "line",
    ["params.load(Learn, name)", "artifacts.read_figures(name)", "read_json(f'datasets/{name}/a.json')"],
)
def test_a_path_or_section_that_cannot_be_read_off_is_refused(tmp_path, line):
    write(tmp_path, {**TOY, "stages/learn.py": f"{STAGE}{line}\n"})
    with pytest.raises(AssertionError, match=r"stages/learn.py:13 .* out, so that one can grep for it"):
        house.expected(tmp_path, "stages/learn.py")
