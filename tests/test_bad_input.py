"""What bad input gets: exit status 1 and one sentence with file, place, expected, found and remedy; the last
good artifacts stay as they were."""

import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from pipeline.store import artifacts, params
from pipeline.temperature.identification import model_choice as identification
from pipeline.temperature.plant import plant, simulate

SAMPLES = 600


def signals(samples: int = SAMPLES, *, seed: int = 1) -> dict[str, np.ndarray]:
    """Two heaters that are switched, two zones that follow, with noise."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([30.0, 50.0], size=(-(-samples // 5), 2)), 5, axis=0)[:samples]
    machine = plant([[0.95, 0.02], [0.01, 0.9]], [[0.02, 0.0], [0.0, 0.04]], np.eye(2), d=[20.0, 20.0])
    y = simulate(machine, u, np.array([16.0, 16.0]))[1] + 0.02 * rng.standard_normal((samples, 2))
    return {
        "t_s": np.arange(samples, dtype=float),
        "Q1": u[:, 0],
        "Q2": u[:, 1],
        "T1": y[:, 0],
        "T2": y[:, 1],
    }


def record(tree: Path, columns: dict[str, np.ndarray]) -> None:
    artifacts.write_csv(tree / "datasets/raw/temperature/rig.csv", columns)


def declare(tree: Path, changes: dict, of: Path | None = None) -> None:
    """The parameters of a project (the tree itself) with {dotted key:
    value} changed, as the tree's params.yaml."""
    sections = params.read((of or tree) / "params.yaml")
    for dotted, value in changes.items():
        *parents, key = dotted.split(".")
        inner = sections
        for parent in parents:
            inner = inner[parent]
        inner[key] = value
    (tree / "params.yaml").write_text(yaml.safe_dump(sections, sort_keys=False))


def run(tree: Path, stage: str, monkeypatch) -> int:
    """`python -m stages.<stage>` in the tree, in this process: the imports are paid once."""
    with monkeypatch.context() as inside:
        inside.chdir(tree)
        inside.setattr(sys, "argv", [stage])
        inside.delitem(sys.modules, f"stages.{stage}", raising=False)
        try:
            runpy.run_module(f"stages.{stage}", run_name="__main__", alter_sys=True)
        except SystemExit as ended:
            return ended.code
    return 0


def good(tree: Path) -> dict[str, bytes]:
    """Everything that stages wrote; the recordings and the memo are not theirs to lose."""
    return {
        path.relative_to(tree).as_posix(): path.read_bytes()
        for path in tree.rglob("*")
        if path.is_file()
        and not path.is_relative_to(tree / "datasets/raw")
        and not path.is_relative_to(tree / "datasets/memo")
    }


@pytest.fixture(scope="module")
def ready(root, tmp_path_factory) -> Path:
    """A project whose record was ingested, identified and learned well."""
    tree = tmp_path_factory.mktemp("project")
    declare(
        tree,
        {
            "plant.inputs": [
                {"name": f"heater_{i}", "unit": "percent", "low": 0, "high": 100} for i in (1, 2)
            ],
            "plant.outputs": [
                {"name": f"zone_{i}", "unit": "degC", "reference": 35, "low": 0, "high": 90} for i in (1, 2)
            ],
            "generate_probing.source": "recordings",
            "ingest.mapping": {
                ours: {"source": theirs, "unit": unit, "scale": 1.0, "offset": 0.0}
                for ours, theirs, unit in (
                    ("heater_1", "Q1", "percent"),
                    ("heater_2", "Q2", "percent"),
                    ("zone_1", "T1", "degC"),
                    ("zone_2", "T2", "degC"),
                )
            },
            "identify_plant.max_order": 3,
            "learn_kernel.longest_window": 6,
            "panel.steps": 60,
        },
        of=root,
    )
    record(tree, signals())
    with pytest.MonkeyPatch.context() as monkeypatch:
        for stage in ("ingest", "identify_plant", "learn_kernel"):
            assert run(tree, stage, monkeypatch) == 0
    return tree


@pytest.fixture
def tree(ready, tmp_path) -> Path:
    return Path(shutil.copytree(ready, tmp_path / "tree"))


@pytest.fixture
def refused(monkeypatch, capfd):
    def refused(tree: Path, stage: str) -> str:
        """The sentence with which the stage ends, once it is seen to
        be one, and to have left everything as it was."""
        before = good(tree)
        capfd.readouterr()
        assert run(tree, stage, monkeypatch) == 1
        printed = capfd.readouterr()
        assert printed.out == ""
        assert printed.err.count("\n") == 1, printed.err
        assert printed.err.startswith(f"{stage}: ")
        assert "; " in printed.err or " must be " in printed.err, "neither a remedy nor a bound"
        assert good(tree) == before
        return printed.err

    return refused


def changed(**columns: tuple[int | slice, float]) -> dict[str, np.ndarray]:
    """The good record with {column: (where, value)} written over it."""
    made = signals()
    for name, (where, value) in columns.items():
        made[name][where] = value
    return made


# ---- params.yaml


@pytest.mark.parametrize(
    ("stage", "key", "value", "said"),
    [
        (
            "ingest",
            "ingest.colour",
            1,
            "params.yaml: ingest.colour is unknown; remove it, or use mapping, time, decimal, max_gap_s, "
            "longest_s, largest_mb, strict",
        ),
        (
            "ingest",
            "ingest.max_gaps",
            5.0,
            "params.yaml: ingest.max_gaps is unknown; did you mean max_gap_s?",
        ),
        ("ingest", "ingest.max_gap_s", -1.0, "params.yaml: ingest.max_gap_s is -1.0 but must be more than 0"),
        (
            "identify_plant",
            "identify_plant.order",
            61,
            "params.yaml: identify_plant.order is 61 but must be at most 60",
        ),
        ("learn_kernel", "tracking.gamma", 1.5, "params.yaml: tracking.gamma is 1.5 but must be at most 1"),
        (
            "identify_plant",
            "plant.sample_time_s",
            "one",
            'params.yaml: plant.sample_time_s is "one" but must be a number',
        ),
        ("ingest", "generate_probing.source", "recording", "did you mean recordings?"),
    ],
)
def test_a_parameter_that_cannot_be_is_refused_by_name(tree, refused, stage, key, value, said):
    declare(tree, {key: value})
    assert said in refused(tree, stage)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        (
            "heater_1.source",
            "Q3",
            "datasets/raw/temperature/rig.csv: there is no column 'Q3'; the nearest names are Q2, Q1",
        ),
        (
            "zone_1.unit",
            "degF",
            "params.yaml: ingest.mapping.zone_1.unit is degF but the plant's zone_1 is in degC; "
            "convert with scale and offset, and write unit: degC",
        ),
        (
            "zone_1.scale",
            0.0,
            "rig.csv: the mapping of zone_1 has scale 0 and offset 0; both must be finite, scale not 0",
        ),
    ],
)
def test_a_mapping_to_a_missing_column_or_in_a_wrong_unit_is_refused(tree, refused, key, value, said):
    declare(tree, {f"ingest.mapping.{key}": value})
    assert said in refused(tree, "ingest")


def test_a_mapping_that_names_no_signal_is_refused_with_the_nearest_names(tree, refused):
    declare(
        tree, {"ingest.mapping.heater_11": {"source": "Q1", "unit": "percent", "scale": 1.0, "offset": 0.0}}
    )
    assert (
        "params.yaml: ingest.mapping.heater_11 is no signal of the plant; "
        "the nearest names are heater_1, heater_2" in refused(tree, "ingest")
    )


# ---- recordings


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        (
            changed(t_s=(300, 20.0)),
            (
                "line 302 is at 20 s, which is before the sample ahead of it at 299 s, "
                "but time should only run forward; "
                "split the recording where its clock was set back"
            ),
        ),
        (
            changed(t_s=(slice(300, 320), 299.0)),
            (
                "line 302 has the same time as the sample before it, 299 s, the first of 20, "
                "but time should only run forward; "
                "name a finer clock, or give each device or tag that writes here a column of its own"
            ),
        ),
        (
            changed(T1=(slice(None), np.nan)),
            "T1 should hold numbers for zone_1 but all of its 600 values are missing; map another source",
        ),
        (signals(1), "output zone_1 should have at least two samples but has 1; record longer"),
    ],
    ids=["backwards", "many at one time", "NaN only", "one sample"],
)
def test_a_recording_that_is_no_record_is_refused_with_its_place(tree, refused, columns, said):
    record(tree, columns)
    assert f"datasets/raw/temperature/rig.csv: {said}" in refused(tree, "ingest")


def test_no_recording_at_all_is_refused_with_the_folder(tree, refused):
    (tree / "datasets/raw/temperature/rig.csv").unlink()
    assert (
        "datasets/raw/temperature: expected at least one recording (CSV, Parquet or MCAP), found none"
        in refused(tree, "ingest")
    )


def test_strict_makes_one_broken_recording_among_good_ones_fatal(tree, refused):
    (tree / "datasets/raw/temperature/broken.csv").write_text("t_s,Q1,Q2,T1\n0,1,1,20\n1,1,1,20\n")
    declare(tree, {"ingest.strict": True})
    said = refused(tree, "ingest")
    assert "datasets/raw/temperature/broken.csv: there is no column 'T2'" in said
    assert "(1 of 2 recordings are broken)" in said


# ---- what a record does not say


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        (
            changed(Q1=(slice(None), 30.0)),
            r"input (u1|heater_1) is constant, so its column of B is not identified; "
            r"excite it, or leave it out",
        ),
        (
            signals() | {"Q2": signals()["Q1"]},
            r"input (u2|heater_2) is a linear combination of (u1|heater_1), "
            r"so its column of B is not identified; move it independently",
        ),
        # 28 of the 40 samples identify, the others judge
        (
            signals(40),
            r"the record is too short for order 1: expected at least 48 complete samples, found 28; "
            r"record 20 samples more",
        ),
    ],
    ids=["a constant input", "a collinear input", "too few samples"],
)
def test_a_record_that_does_not_determine_the_plant_is_refused(tree, refused, monkeypatch, columns, said):
    record(tree, columns)
    assert run(tree, "ingest", monkeypatch) == 0
    assert re.search(said, refused(tree, "identify_plant"))


def test_an_order_that_the_record_cannot_carry_is_refused_with_what_it_lacks(tree, refused):
    declare(tree, {"identify_plant.order": 40})
    said = refused(tree, "identify_plant")
    assert (
        "the record is too short for order 40: expected at least 504 complete samples, found 420; "
        "record 84 samples more" in said
    )


def test_a_state_that_never_shows_is_left_out(tree, monkeypatch):
    """As the delays of an input leave some that no output answers."""
    hidden = plant(
        [[0.95, 0.0], [0.0, 0.9]], [[0.02, 0.0], [0.0, 0.04]], [[1.0, 0.0], [2.0, 0.0]], d=[20.0, 20.0]
    )
    found = identification.refit

    def hiding(*signals, **settings):
        return found(*signals, **settings)._replace(plant=hidden)

    monkeypatch.setattr(identification, "refit", hiding)
    assert run(tree, "identify_plant", monkeypatch) == 0
    kept = artifacts.read_arrays(tree / "datasets/identify_plant/plant.parquet", "plant", 1)
    assert kept["A"].shape == (1, 1, 1) and kept["A"][0, 0, 0] == pytest.approx(0.95)


# ---- artifacts of another stage


@pytest.mark.parametrize("damage", ["missing", "cut"])
def test_an_artifact_that_is_missing_or_damaged_is_refused_with_the_command_that_makes_it(
    tree, refused, damage
):
    path = tree / "datasets/ingest/record.parquet"
    content = path.read_bytes()
    path.unlink()
    if damage == "cut":
        path.write_bytes(content[:-100])
    said = refused(tree, "identify_plant")
    assert said.startswith("identify_plant: datasets/ingest/record.parquet is ")
    assert said.endswith("make it again with ./run dvc repro ingest\n")


# ---- as a command


def test_the_command_ends_with_status_1_and_one_sentence_without_a_traceback(tree, root):
    record(tree, changed(t_s=(300, 20.0)))
    before = good(tree)
    environment = os.environ | {"PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"}
    ended = subprocess.run(
        [sys.executable, "-m", "stages.ingest"],
        cwd=tree,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert ended.returncode == 1
    assert re.fullmatch(
        r"ingest: datasets/raw/temperature/rig\.csv: line 302 is at 20 s, .*; split the recording .*\n",
        ended.stderr,
    )
    assert good(tree) == before
