"""Artifacts: equal inputs give equal bytes, what is damaged is refused,
and whatever goes wrong the last good ones stay."""

import errno
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import mcap.reader
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipeline.store import artifacts, tables
from pipeline.temperature.settings import Input, Output
from pipeline.temperature.tables import record

RECORD = record(
    [Input(name="heater_1", unit="percent", low=0, high=100)],
    [Output(name="zone_1", unit="°C", reference=200)],
)
SCORES = tables.Schema(
    "scores",
    1,
    (
        tables.Column("controller", tables.TEXT, "1", "who"),
        tables.Column(
            "share", tables.FLOAT, "percent", "of the time at a limit", low=0, high=100, nullable=True
        ),
        tables.Column("steps", tables.COUNT, "1", "how many", low=1),
    ),
)


@pytest.fixture(autouse=True)
def project(tmp_path, monkeypatch):
    """An empty project, as the working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def columns(rows=4):
    return {
        "recording": np.array(["a.csv"] * rows),
        "segment": np.zeros(rows, int),
        "time_s": np.arange(rows) * 0.5,
        "heater_1": np.linspace(0, 100, rows),
        "heater_1_masked": np.zeros(rows, bool),
        "zone_1": np.array([20.0] * (rows - 1) + [np.nan]),
        "zone_1_masked": [False] * (rows - 1) + [True],
    }


def scores(**changed):
    return {"controller": ["learned", "optimal"], "share": np.array([3.0, np.nan]), "steps": [5, 6]} | changed


def everything(folder):
    """Relative name -> bytes of all files."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }


# ---- tables


def test_a_table_comes_back_as_it_was_written():
    artifacts.write_table("datasets/ingest/record.parquet", RECORD, columns())
    table = artifacts.read_table("datasets/ingest/record.parquet", RECORD)
    for name, values in columns().items():
        np.testing.assert_array_equal(table[name], values)
    kinds = {
        "recording": "O",
        "segment": "i",
        "time_s": "f",
        "heater_1": "f",
        "heater_1_masked": "b",
        "zone_1": "f",
        "zone_1_masked": "b",
    }
    assert {name: values.dtype.kind for name, values in table.items()} == kinds
    assert list(table) == [column.name for column in RECORD.columns]


def test_the_file_says_its_schema_and_each_field_its_unit_and_meaning():
    artifacts.write_table("record.parquet", RECORD, columns())
    schema = pq.read_schema("record.parquet")
    assert (schema.metadata[b"schema"], schema.metadata[b"schema_version"]) == (b"record", b"1")
    assert schema.field("zone_1").metadata[b"unit"].decode() == "°C"
    assert schema.field("heater_1").metadata[b"meaning"] == b"input heater_1"


def test_equal_tables_are_equal_bytes_whatever_container_they_came_in():
    artifacts.write_table("one.parquet", SCORES, scores())
    lists = {"steps": pa.array([5, 6]), "share": [3.0, None], "controller": np.array(["learned", "optimal"])}
    artifacts.write_table("two.parquet", SCORES, lists)
    assert artifacts.sha256("one.parquet") == artifacts.sha256("two.parquet")


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        (
            {"share": np.array([3.0, 101.0])},
            "column share is 101 percent in row 1 but must be at most 100 percent; the file was not written",
        ),
        (
            {"share": np.array([-np.inf, 1.0])},
            "column share is -inf percent in row 0 but must be at least 0 percent",
        ),
        ({"steps": [5, 0]}, "column steps is 0 in row 1 but must be at least 1"),
        ({"steps": np.array([5.5, 6])}, "column steps does not fit int64 (Float value 5.5"),
        ({"steps": np.array([5, np.nan])}, "column steps has no value (NaN) in row 1, the first of 1"),
        ({"controller": ["a", None]}, "column controller has no value (NaN) in row 1"),
        ({"share": ["x", "y"]}, "column share does not fit double"),
        ({"share": np.zeros((2, 2))}, "column share does not fit double"),
        (
            {"share": [1.0]},
            "columns should have one length but have {'controller': 2, 'share': 1, 'steps': 2}",
        ),
        (
            {"extra": [1, 2]},
            "table scores version 1 has extra too many; give exactly the columns of the schema",
        ),
    ],
)
def test_a_table_that_breaks_its_schema_is_not_written(project, changed, sentence):
    with pytest.raises(ValueError, match=re.escape(f"scores.parquet: {sentence}")):
        artifacts.write_table("scores.parquet", SCORES, scores(**changed))
    assert not everything(project)


def table(schema=SCORES, share=(3.0, None)) -> pa.Table:
    return pa.table(scores(share=list(share)), schema=tables.arrow(schema))


def with_column(number, **changed):
    columns = list(SCORES.columns)
    columns[number] = columns[number]._replace(**changed)
    return SCORES._replace(columns=tuple(columns))


@pytest.mark.parametrize(
    ("other", "sentence"),
    [
        (
            table(SCORES._replace(version=2)),
            " holds schema scores version 2 but scores version 1 is expected",
        ),
        (
            table(SCORES._replace(name="tuning")),
            " holds schema tuning version 1 but scores version 1 is expected",
        ),
        (pa.table({"a": [1]}), " holds no schema but scores version 1 is expected"),
        (table().drop_columns("share"), ": table scores version 1 lacks share"),
        (table(with_column(1, unit="1")), ": column share is in 1 but should be in percent"),
        (table(with_column(2, type="int32")), ": column steps is int32 but should be int64"),
        (table(share=[3.0, 200.0]), ": column share is 200 percent in row 1 but must be at most 100 percent"),
    ],
)
def test_a_table_of_another_schema_is_refused_with_the_command_that_makes_it_again(project, other, sentence):
    """The file is written past `write_table`, as an older version or another tool leaves it."""
    path = "datasets/evaluate_temperature/scores.parquet"
    (project / path).parent.mkdir(parents=True)
    pq.write_table(other, path)
    with pytest.raises(
        ValueError,
        match=f"^{re.escape(path + sentence)}; make it again with ./run dvc repro evaluate_temperature$",
    ):
        artifacts.read_table(path, SCORES)


def test_a_missing_table_is_one_sentence():
    with pytest.raises(
        ValueError,
        match=r"^datasets/ingest/record.parquet is missing; make it again with ./run dvc repro ingest$",
    ):
        artifacts.read_table("datasets/ingest/record.parquet", RECORD)


@pytest.mark.parametrize("length", [0, 3, 200, -20, -1])
def test_a_truncated_table_is_refused(project, length):
    artifacts.write_table("datasets/ingest/record.parquet", RECORD, columns())
    whole = (project / "datasets/ingest/record.parquet").read_bytes()
    (project / "datasets/ingest/record.parquet").write_bytes(whole[:length])
    with pytest.raises(
        ValueError,
        match=r"record.parquet is not a whole Parquet file .*; make it again with ./run dvc repro ingest$",
    ):
        artifacts.read_table("datasets/ingest/record.parquet", RECORD)


def test_a_flipped_bit_never_changes_a_value(project):
    """Pages carry checksums; a flip in a name, unit or statistic is refused or read
    past, but the values are those that were written."""
    artifacts.write_table("record.parquet", RECORD, columns())
    whole = (project / "record.parquet").read_bytes()
    good, refused = artifacts.read_table("record.parquet", RECORD), 0
    positions = range(4, len(whole), max(1, len(whole) // 400))
    for position in positions:
        damaged = bytearray(whole)
        damaged[position] ^= 1 << position % 8
        (project / "damaged.parquet").write_bytes(damaged)
        try:
            table = artifacts.read_table("damaged.parquet", RECORD)
        except ValueError:
            refused += 1
        else:
            for name, values in good.items():
                np.testing.assert_array_equal(table[name], values)
    assert refused > len(positions) / 3


def test_arrays_of_any_shape_come_back():
    A = np.array([[0.1, np.nan], [1e-300, -0.0]])
    arrays = {
        "A": (A, "1", "state matrix"),
        "order": (np.array(6), "1", "states"),
        "none": (np.zeros((0, 4)), "°C", "nothing"),
        "on": (A > 0, "1", ""),
    }
    artifacts.write_arrays("model.parquet", "model", 1, arrays)
    stored = artifacts.read_arrays("model.parquet", "model", 1)
    assert list(stored) == list(arrays)
    for name, (array, _, _) in arrays.items():
        assert stored[name].shape == array.shape
        np.testing.assert_array_equal(stored[name], array)
    artifacts.write_arrays("model.parquet", "model", 1, {})
    assert artifacts.read_arrays("model.parquet", "model", 1) == {}


def test_arrays_that_are_not_finite_real_numbers_are_refused():
    with pytest.raises(
        ValueError,
        match=r"model.parquet: array poles is complex128 but should be real numbers; write real and "
        r"imaginary part",
    ):
        artifacts.write_arrays("model.parquet", "model", 1, {"poles": (np.array([1j]), "1", "")})
    with pytest.raises(
        ValueError, match=r"array A holds an infinite number; write NaN where there is no value"
    ):
        artifacts.write_arrays("model.parquet", "model", 1, {"A": (np.array([np.inf]), "1", "")})
    artifacts.write_arrays("model.parquet", "model", 1, {"A": (np.eye(2), "1", "")})
    with pytest.raises(
        ValueError, match=r"model.parquet holds schema model version 1 but model version 2 is expected"
    ):
        artifacts.read_arrays("model.parquet", "model", 2)


# ---- JSON


class Score(NamedTuple):
    gap: float
    stable: bool


def test_json_keeps_order_and_every_digit():
    data = {
        "b": np.float64(0.1) + 0.2,
        "a": [np.int32(3), np.array([[1.5]]), (1, None)],
        "é": Score(1e-9, np.bool_(True)),
    }
    artifacts.write_json("a.json", data)
    assert artifacts.read_json("a.json") == {
        "b": 0.30000000000000004,
        "a": [3, [[1.5]], [1, None]],
        "é": {"gap": 1e-9, "stable": True},
    }
    text = Path("a.json").read_text(encoding="utf-8")
    assert text.startswith('{\n  "b": 0.30000000000000004,\n  "a": [')
    assert text.endswith("}\n")
    assert '"é"' in text


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (
            {"kernel": {"gap": [0.0, np.nan]}},
            "kernel.gap[1] is nan but must be finite; write null where there is no figure, "
            "and say why beside it",
        ),
        ({"kernel": np.array([np.inf])}, "kernel[0] is inf but must be finite"),
        ({"kernel": {1: 2}}, "key 1 of kernel should be text but is int"),
        ({"kernel": {"set": {1}}}, "kernel.set is set, which JSON does not know"),
        ({"kernel": 1j}, "kernel is complex, which JSON does not know"),
    ],
)
def test_what_json_cannot_hold_is_refused_by_its_key(project, data, sentence):
    with pytest.raises(ValueError, match=re.escape(f"a.json: {sentence}")):
        artifacts.write_json("a.json", data)
    assert not everything(project)


def test_broken_json_is_refused_with_its_place(project):
    artifacts.write_metrics("ingest", {"a": 1})
    whole = (project / "reports/metrics/ingest.json").read_text()
    (project / "reports/metrics/ingest.json").write_text(whole[:-4])
    with pytest.raises(
        ValueError,
        match=r"reports/metrics/ingest.json is not whole JSON \(.*line 2.*\); make it again with ./run dvc "
        r"repro ingest",
    ):
        artifacts.read_json("reports/metrics/ingest.json")
    with pytest.raises(
        ValueError, match=r"reports/metrics/report.json is missing; make it again with ./run dvc repro report"
    ):
        artifacts.read_json("reports/metrics/report.json")


FIGURES = {
    "machine": "ab12",
    "cases": {"gain 0.6": {"settled": 97.5, "stay": 90.0}, "clog": {"settled": 50.0, "runs": [1, 2]}},
    "harm": {"perfect": {"beyond_25": 0.0}},
    "parts": [{"name": "a", "volume": 1.5}, {"name": "b", "volume": 2.5}],
}


@pytest.mark.parametrize(
    ("metrics", "chosen"),
    [
        (("*",), FIGURES),
        (("cases.*.settled",), {"cases": {"gain 0.6": {"settled": 97.5}, "clog": {"settled": 50.0}}}),
        (("harm", "cases.clog.r*"), {"cases": {"clog": {"runs": [1, 2]}}, "harm": FIGURES["harm"]}),
        (("cases.gain 0*.stay", "settled"), {"cases": {"gain 0.6": {"stay": 90.0}}}),
        (("parts.*.volume",), {"parts": [{"volume": 1.5}, {"volume": 2.5}]}),
        ((), {}),
    ],
)
def test_metrics_are_the_figures_that_match_a_pattern(project, metrics, chosen):
    with artifacts.stage("evaluate"):
        artifacts.write_metrics("evaluate", FIGURES, metrics)
    assert artifacts.read_figures("evaluate") == FIGURES
    kept = artifacts.read_json("reports/metrics/evaluate.json")
    assert kept == chosen and list(kept) == list(chosen)
    assert set(everything(project)) == {"datasets/evaluate/figures.json", "reports/metrics/evaluate.json"}


# ---- learning curves and recordings


def test_a_learning_curve_is_a_table_a_figure_without_the_missing_values(project):
    curve = {
        "agent": ["ours", "ours", "the paper"],
        "update": [10, 20, 10],
        "reward": [0.1, None, 1 / 3],
        "cost": [1.0, 2.0, float("nan")],
    }
    for folder in ("a", "b"):
        artifacts.write_learning_curve(folder, curve, of="agent", step="update", figures=("reward", "cost"))
    files = {
        path.relative_to("a/plots/metrics").as_posix(): path.read_text()
        for path in Path("a/plots").rglob("*.tsv")
    }
    assert files == {
        "ours/reward.tsv": "step\treward\n10\t0.1\n",
        "ours/cost.tsv": "step\tcost\n10\t1.0\n20\t2.0\n",
        "the_paper/reward.tsv": "step\treward\n10\t0.3333333333333333\n",
    }
    assert artifacts.sha256("a") == artifacts.sha256("b") and not (project / "dvc.yaml").exists()


def test_csv_keeps_every_digit_under_a_line_of_names(project):
    artifacts.write_csv("next.csv", {"time_s": np.array([0, 1]), "heater_1": np.array([0.1, 1 / 3])})
    assert (project / "next.csv").read_text() == "time_s,heater_1\n0,0.1\n1,0.3333333333333333\n"


def write_recording(path, samples=3000):
    time = np.arange(samples) * 0.1
    heater, zone = np.random.default_rng(0).normal(size=(2, samples))
    signals = {"heater_1": (heater, "percent", "duty"), 'zone "1" %s': (zone, "°C", "temperature")}
    artifacts.write_recording(path, time, signals)
    return time, signals


def test_a_recording_is_what_any_mcap_reader_reads():
    time, signals = write_recording("machine.mcap")
    with open("machine.mcap", "rb") as stream:
        reader = mcap.reader.make_reader(stream, validate_crcs=True)
        messages = list(reader.iter_messages())
        assert reader.get_header().library == "beadline"
    schema, channel, _ = messages[0]
    assert (channel.topic, channel.message_encoding, schema.encoding) == ("/machine", "json", "jsonschema")
    assert channel.metadata["heater_1.unit"] == "percent"
    assert channel.metadata['zone "1" %s.meaning'] == "temperature"
    assert (channel.metadata["schema"], channel.metadata["schema_version"]) == ("recording", "1")
    assert json.loads(schema.data)["properties"]["heater_1"]["type"] == "number"
    assert [message.log_time for _, _, message in messages] == [round(t * 1e9) for t in time]
    rows = [json.loads(message.data) for _, _, message in messages]
    for name, (values, _, _) in signals.items():
        np.testing.assert_array_equal([row[name] for row in rows], values)


def test_equal_recordings_are_equal_bytes():
    write_recording("one.mcap")
    write_recording("two.mcap")
    assert artifacts.sha256("one.mcap") == artifacts.sha256("two.mcap")


@pytest.mark.parametrize(
    ("time", "values", "sentence"),
    [
        ([0, 1], [1.0], r"heater_1 should have one value for each of 2 times but has shape \(1,\)"),
        ([0, 1], [1.0, np.nan], "heater_1 is not finite at sample 1; leave that sample out"),
        ([0, np.inf], [1.0, 1.0], "time_s is not finite at sample 1"),
        ([-1, 0], [1.0, 1.0], "time_s begins at -1 s but MCAP counts from 0; shift the time"),
    ],
)
def test_a_recording_of_bad_numbers_is_not_written(project, time, values, sentence):
    with pytest.raises(ValueError, match=f"machine.mcap: {sentence}"):
        artifacts.write_recording(
            "machine.mcap", np.array(time, float), {"heater_1": (np.array(values), "percent", "")}
        )
    assert not everything(project)


# ---- digests


def test_the_digest_of_a_folder_is_of_names_and_contents_without_dot_files(project):
    artifacts.write_text("a/b/one.txt", "1")
    artifacts.write_text("a/two.txt", "2")
    digest = artifacts.sha256("a")
    artifacts.write_text("a/.gitignore", "x")
    artifacts.write_text("a/__pycache__/one.pyc", "x")
    assert artifacts.sha256("a") == digest
    (project / "a/two.txt").rename(project / "a/three.txt")
    assert artifacts.sha256("a") != digest
    assert (
        artifacts.sha256("a/b/one.txt") == "6b86b273ff34fce19d6b804eff5a3f5747ada4eaa22f1d49c01e52ddb7875b4b"
    )


# ---- all or nothing


@pytest.fixture
def last_good(project):
    """What the last run of stage `learn_kernel` left."""
    artifacts.write_text("datasets/learn_kernel/kernel.txt", "good")
    artifacts.write_text("datasets/learn_kernel/obsolete.txt", "good")
    artifacts.write_text("reports/index.html", "good")
    artifacts.write_metrics("learn_kernel", {"rank": 406})
    return everything(project)


def learn(error=None):
    with artifacts.stage("learn_kernel") as out:
        artifacts.write_text(out / "kernel.txt", "new")
        artifacts.write_text("reports/index.html", "new")
        artifacts.write_metrics("learn_kernel", {"rank": 56})
        if error:
            raise error


def test_a_stage_that_ends_well_replaces_all_that_it_writes(project, last_good):
    learn()
    contents = everything(project)
    assert set(contents) == set(last_good) - {"datasets/learn_kernel/obsolete.txt"}
    assert contents["datasets/learn_kernel/kernel.txt"] == contents["reports/index.html"] == b"new"
    assert artifacts.read_json("reports/metrics/learn_kernel.json") == {"rank": 56}


def test_a_stage_that_writes_only_a_report_has_no_folder(project):
    with artifacts.stage("report"):
        artifacts.write_text("reports/index.html", "new")
    assert list(everything(project)) == ["reports/index.html"]


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (ValueError("gamma is unknown\n  horizon is 0"), "gamma is unknown; horizon is 0"),
        (np.linalg.LinAlgError("singular"), "singular"),
        (pa.ArrowInvalid("bad page"), "bad page"),
        (
            OSError(errno.ENOSPC, "No space left on device", "datasets/x"),
            "datasets/x: No space left on device; free some space and run it again",
        ),
    ],
)
def test_bad_input_is_one_line_and_status_1_and_nothing_is_touched(project, last_good, capsys, error, line):
    with pytest.raises(SystemExit) as end:
        learn(error)
    assert end.value.code == 1
    assert capsys.readouterr().err == f"learn_kernel: {line}\n"
    assert everything(project) == last_good


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ZeroDivisionError("a bug")])
def test_a_bug_and_an_interrupt_are_passed_on_and_nothing_is_touched(project, last_good, error):
    with pytest.raises(type(error)):
        learn(error)
    assert everything(project) == last_good
    assert sorted(path.name for path in project.rglob(".*")) == []


def test_a_file_is_on_the_disk_before_it_takes_its_name_and_the_name_after(project, monkeypatch):
    Path("a.json").write_text("1")
    synced, sync = [], os.fsync

    def watched(descriptor):
        folder = Path(os.readlink(f"/proc/self/fd/{descriptor}")).is_dir()
        synced.append(("folder" if folder else "file", Path("a.json").read_text()))
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", watched)
    artifacts.write_json("a.json", 2)
    assert synced == [("file", "1"), ("folder", "2\n")]


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space"), KeyboardInterrupt()])
def test_a_writer_that_fails_half_way_leaves_the_last_good_file_alone(project, monkeypatch, error):
    artifacts.write_table("scores.parquet", SCORES, scores())
    before = everything(project)

    def half(table, path, **_):
        path.write_bytes(b"half")
        raise error

    monkeypatch.setattr(pq, "write_table", half)
    sentence = (
        r"scores.parquet cannot be written \(No space left on device\); free some space"
        if isinstance(error, OSError)
        else None
    )
    with pytest.raises(type(error), match=sentence):
        artifacts.write_table("scores.parquet", SCORES, scores(steps=[7, 8]))
    assert everything(project) == before


def run(root, script) -> subprocess.CompletedProcess:
    environment = os.environ | {"PYTHONPATH": str(root)}
    return subprocess.run(
        [sys.executable, "-c", script],
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


FULL_DISK = """
import resource, numpy as np
from pipeline.store import artifacts
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
with artifacts.stage("learn_kernel") as out:
    {write}
"""


@pytest.mark.parametrize(
    ("write", "name"),
    [
        (
            "artifacts.write_arrays(out / 'a.parquet', 'a', 1, {'a': "
            "(np.random.default_rng(0).normal(size=9999), '1', '')})",
            "a.parquet",
        ),
        (
            "artifacts.write_recording(out / 'a.mcap', np.arange(9999.), {'a': "
            "(np.random.default_rng(0).normal(size=9999), '1', '')})",
            "a.mcap",
        ),
        ("artifacts.write_text(out / 'a.txt', 'a' * 9999)", "a.txt"),
    ],
)
def test_a_write_that_the_system_cuts_off_is_one_line(root, project, last_good, write, name):
    """The limit of a file's size is the one full disk that a test can have without being root."""
    end = run(root, FULL_DISK.format(write=write))
    assert end.returncode == 1
    assert re.fullmatch(
        rf"learn_kernel: datasets/learn_kernel/{name} cannot be written \(File too large\); .+\n", end.stderr
    )
    assert everything(project) == last_good


READ_ONLY = """
import os
from pipeline.store import artifacts
if os.geteuid() == 0:
    os.setuid(65534)  # root writes to read-only folders
with artifacts.stage("learn_kernel") as out:
    artifacts.write_text(out / "kernel.txt", "new")
"""


def test_a_read_only_folder_is_one_line(root, project, last_good):
    project.chmod(0o755)
    (project / "datasets").chmod(0o555)
    end = run(root, READ_ONLY)
    (project / "datasets").chmod(0o755)
    assert (end.returncode, end.stderr) == (
        1,
        "learn_kernel: datasets/learn_kernel: Permission denied; make datasets writable\n",
    )
    assert everything(project) == last_good


LITTLE_MEMORY = """
import resource, sys
import numpy as np
from pipeline.store import artifacts
from tests.store.test_artifacts import LONG
pages = int(open("/proc/self/statm").read().split()[0])
resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + 20_000_000,) * 2)
with artifacts.stage("learn_kernel") as out:
    {work}
"""
LONG = tables.Schema("long", 1, (tables.Column("value", tables.FLOAT, "1", "one after the other"),))


@pytest.mark.parametrize("work", ["artifacts.read_table('long.parquet', LONG)", "np.zeros((30_000, 1_000))"])
def test_memory_that_runs_out_is_one_line_and_blames_no_file(root, project, last_good, work):
    artifacts.write_table("long.parquet", LONG, {"value": np.zeros(6_000_000)})
    before = everything(project)
    end = run(root, LITTLE_MEMORY.format(work=work))
    assert end.returncode == 1
    assert re.fullmatch(
        r"learn_kernel: there is not enough memory \(.+\); end other programs, or lower execution\.jobs in "
        r"params\.yaml, and run it again\n",
        end.stderr,
    )
    assert everything(project) == before


def test_the_memory_of_other_libraries_is_told_from_their_mistakes(project, last_good, capsys):
    with pytest.raises(SystemExit):
        learn(RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 80000000000 bytes."))
    assert "learn_kernel: there is not enough memory (RESOURCE_EXHAUSTED" in capsys.readouterr().err
    with pytest.raises(RuntimeError, match="a bug"):
        learn(RuntimeError("a bug"))
    assert everything(project) == last_good


# ---- files that belong together


def several(count: int, size: int = 10) -> None:
    with artifacts.together(Path("jobs")) as place:
        for k in range(count):
            artifacts.write_text(place / f"{k}.txt", f"{count}" * size)


def test_files_that_belong_together_come_together_or_not_at_all(project, monkeypatch):
    Path("jobs").mkdir()
    Path("jobs/of_somebody.txt").write_text("stays")
    several(2)
    before = everything(project)
    assert set(before) == {"jobs/0.txt", "jobs/1.txt", "jobs/of_somebody.txt"}
    written = artifacts.write_text

    def full(path, text):
        if path.name == "2.txt":
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        written(path, text)

    with monkeypatch.context() as disk:
        disk.setattr(artifacts, "write_text", full)
        with pytest.raises(
            OSError, match=r"^jobs/2.txt: No space left on device; free some space and run it"
        ):
            several(3)
    assert everything(project) == before
    killed = Path(f"jobs/.together.{dead_process()}")
    killed.mkdir()
    several(3)
    assert set(everything(project)) == {*before, "jobs/2.txt"} and not killed.exists()


def test_a_file_in_the_way_of_a_folder_is_one_line(project, capsys):
    artifacts.write_text("datasets", "a file")
    with pytest.raises(SystemExit):
        learn()
    assert "learn_kernel: datasets" in capsys.readouterr().err
    assert everything(project) == {"datasets": b"a file"}


def dead_process() -> int:
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    process.send_signal(signal.SIGKILL)
    process.wait()
    return process.pid


def test_what_a_killed_run_left_is_removed_and_a_running_one_is_left_alone(project, last_good):
    pid = dead_process()
    for end in (f"{pid}", f"{pid}.reports", f"{pid}.old", f"{os.getppid()}"):
        artifacts.write_text(f"datasets/.learn_kernel.{end}/half.txt", "half")
    learn()
    assert sorted(path.name for path in project.rglob(".*")) == [f".learn_kernel.{os.getppid()}"]


def test_a_run_killed_between_its_two_renames_loses_nothing(project, last_good):
    (project / "datasets/learn_kernel").rename(project / f"datasets/.learn_kernel.{dead_process()}.old")
    with pytest.raises(SystemExit):
        learn(ValueError("no"))
    assert everything(project) == last_good


def test_a_rename_that_fails_puts_the_last_good_folder_back(project, last_good, monkeypatch):
    rename = artifacts.Path.rename

    def failing(self, target):
        if re.fullmatch(r"\.learn_kernel\.\d+", self.name):
            raise OSError(errno.EIO, "Input/output error", str(self))
        return rename(self, target)

    monkeypatch.setattr(artifacts.Path, "rename", failing)
    with pytest.raises(SystemExit):
        learn()
    assert everything(project) == last_good


def test_arrays_of_another_machine_and_of_another_version_are_refused_with_both_and_the_command():
    path = "datasets/identify_plant/plant.parquet"
    artifacts.write_arrays(path, "plant", 1, {"D": (np.zeros((1, 2, 3)), "1", "feed-through")})
    assert artifacts.read_arrays(path, "plant", 1, shapes={"D": (None, 2, 3)})["D"].shape == (1, 2, 3)
    for shapes, sentence in (
        ({"D": (None, 5, 7)}, "array D has the shape 1 x 2 x 3 but any x 5 x 7 is expected"),
        ({"D": (2, 3)}, "array D has the shape 1 x 2 x 3 but 2 x 3 is expected"),
        ({"E": (None,)}, "array E is not there but any is expected"),
    ):
        with pytest.raises(ValueError, match=sentence) as refused:
            artifacts.read_arrays(path, "plant", 1, shapes=shapes)
        assert "of another machine or another run; make it again with ./run dvc repro identify_plant" in str(
            refused.value
        )
    with pytest.raises(ValueError, match="holds schema plant version 1 but plant version 2 is expected"):
        artifacts.read_arrays(path, "plant", 2)
