import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline.recordings import plain_files, recording_folders
from pipeline.recordings.isolated import Budget, isolated
from pipeline.recordings.recording_folders import RecordingWish, count_work, join, read_folder
from pipeline.store import artifacts, params
from pipeline.temperature import tables as schemas
from pipeline.temperature.settings import Plant, recorded
from stages.ingest import Ingest, MappedSignal, recording_wish, sources, still_zones, without
from tests.mcap_writing import NO, chunks, flipped
from tests.recordings import hostile
from tests.recordings.klipper_machine import EXTRUDER, print_log
from tests.recordings.test_bag_folders import bag
from tests.temperature import long_readings

MACHINE = Plant.model_validate(
    {
        "sample_time_s": 1.0,
        "inputs": [{"name": "heater", "unit": "percent", "low": 0.0, "high": 100.0}],
        "outputs": [{"name": "zone", "unit": "degC", "reference": 50.0}],
    }
)

SETTINGS = Ingest(
    mapping={}, time="", decimal="", max_gap_s=5.0, longest_s=60.0, largest_mb=2000, strict=False
)


def wish(machine: Plant = MACHINE, **mapping: tuple[str, str, float, float]) -> RecordingWish:
    """What the stage takes from every recording with this mapping."""
    keys = ("source", "unit", "scale", "offset")
    signals = {name: MappedSignal(**dict(zip(keys, to, strict=True))) for name, to in mapping.items()}
    settings = SETTINGS.model_copy(update={"mapping": signals})
    return recording_wish(settings, machine, settings.mapping)


JOB = wish()
BUDGET = Budget(60.0, 2000)
INLINE = params.Execution(backend="loky", jobs=1, scheduler="")
LOKY = params.Execution(backend="loky", jobs=2, scheduler="")
NAMES = ("record.parquet", "quality.parquet", "metrics.json")


def recording(path: Path, seed: int, samples: int = 120) -> Path:
    """A heater that is switched now and then, and the zone that follows it, with noise."""
    rng = np.random.default_rng(seed)
    heater = np.repeat(rng.choice([20.0, 40.0], size=-(-samples // 15)), 15)[:samples]
    zone = (
        20
        + np.convolve(heater, 0.02 * 0.95 ** np.arange(samples))[:samples]
        + 0.05 * rng.standard_normal(samples)
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    artifacts.write_csv(path, {"time_s": np.arange(samples, dtype=float), "heater": heater, "zone": zone})
    return path


def folder(root: Path, count: int) -> Path:
    for k in range(count):
        recording(root / "raw" / f"{k:03d}.csv", seed=k)
    return root / "raw"


def ingested(
    raw: Path,
    out: Path,
    execution=INLINE,
    job=JOB,
    memo: Path | None = None,
    strict: bool = False,
    waits: bool = False,
) -> dict:
    """What the stage does with a folder; the tables land in `out` for a look at their bytes."""
    results = read_folder(raw, job, execution, memo=memo or out / "memo", budget=BUDGET, waits=waits)
    record, quality, metrics = join(results, job, strict=strict)
    artifacts.write_table(out / "record.parquet", job.record, record)
    artifacts.write_table(out / "quality.parquet", job.quality, quality)
    artifacts.write_json(out / "metrics.json", metrics)
    return metrics | count_work(results)


def tables(out: Path) -> list[bytes]:
    return [(out / name).read_bytes() for name in NAMES]


def done(metrics: dict) -> tuple[int, int, int]:
    return metrics["processed"], metrics["reused"], metrics["quarantined"]


# ---- the memo


def test_one_recording_more_among_a_hundred_costs_one(tmp_path, monkeypatch):
    raw = folder(tmp_path, 100)
    assert done(ingested(raw, tmp_path / "a")) == (100, 0, 0)
    recording(raw / "new.csv", seed=1000)
    worked = []

    def counted(work, *arguments, **where):
        worked.append(where["shown"])
        return isolated(work, *arguments, **where)

    monkeypatch.setattr(recording_folders, "isolated", counted)
    assert done(ingested(raw, tmp_path / "b", memo=tmp_path / "a/memo")) == (1, 100, 0)
    assert worked == [raw / "new.csv"]
    ingested(raw, tmp_path / "fresh")
    assert tables(tmp_path / "b") == tables(tmp_path / "fresh")


def test_a_changed_recording_parameter_mapping_or_name_is_read_again_and_nothing_else(tmp_path):
    raw, memo = folder(tmp_path, 3), tmp_path / "memo"
    ingested(raw, tmp_path, memo=memo)
    recording(raw / "001.csv", seed=99)
    assert done(ingested(raw, tmp_path, memo=memo)) == (1, 2, 0)
    (raw / "002.csv").rename(raw / "other.csv")
    assert done(ingested(raw, tmp_path, memo=memo)) == (1, 2, 0)
    assert done(ingested(raw, tmp_path, memo=memo, job=JOB._replace(max_gap_s=7.0))) == (3, 0, 0)
    turned = wish(zone=("zone", "degC", 1.0, -0.5))
    assert done(ingested(raw, tmp_path, memo=memo, job=turned)) == (3, 0, 0)
    assert done(ingested(raw, tmp_path, memo=memo)) == (0, 3, 0)


def test_changed_code_reads_everything_again(tmp_path, monkeypatch):
    raw = folder(tmp_path, 2)
    ingested(raw, tmp_path)
    code = tmp_path / "code"
    code.mkdir()
    (code / "recordings.py").write_text("another version")
    monkeypatch.setattr(recording_folders, "CODE", code)
    assert done(ingested(raw, tmp_path)) == (2, 0, 0)


@pytest.mark.parametrize("part", ["record.parquet", "quality.parquet", "json"])
@pytest.mark.parametrize("damage", ["cut", "flipped", "empty", "gone", "another's"])
def test_a_damaged_entry_of_the_memo_is_read_again_and_never_trusted(tmp_path, part, damage):
    raw, memo = folder(tmp_path, 2), tmp_path / "memo"
    ingested(raw, tmp_path, memo=memo)
    before = tables(tmp_path)
    entry, other = sorted(memo.glob(f"*.{part}"))[:2]
    content = entry.read_bytes()
    middle = len(content) // 2
    damaged = {
        "cut": content[:middle],
        "flipped": content[:middle] + bytes([content[middle] ^ 4]) + content[middle + 1 :],
        "empty": b"",
        "another's": other.read_bytes(),
    }
    entry.unlink()
    if damage in damaged:
        entry.write_bytes(damaged[damage])
    # the findings of two such recordings are the same bytes where neither has any
    same = damage in damaged and damaged[damage] == content
    assert done(ingested(raw, tmp_path, memo=memo)) == ((0, 2, 0) if same else (1, 1, 0))
    assert tables(tmp_path) == before
    assert done(ingested(raw, tmp_path, memo=memo)) == (0, 2, 0)


KILLED = """
import os, signal, sys
from pathlib import Path
from pipeline.store import artifacts
from pipeline.recordings import recording_folders
from tests.temperature.test_ingest import BUDGET, INLINE, JOB

write_table, written = artifacts.write_table, []

def killed_in_the_second_entry(path, schema, columns):
    if len(written) == int(sys.argv[3]):
        os.kill(os.getpid(), signal.SIGKILL)
    written.append(path)
    write_table(path, schema, columns)

artifacts.write_table = killed_in_the_second_entry
recording_folders.isolated = lambda work, *arguments, shown, budget: work(*arguments)
recording_folders.read_folder(Path(sys.argv[1]), JOB, INLINE, memo=Path(sys.argv[2]), budget=BUDGET)
"""


@pytest.mark.parametrize("tables_before", [2, 3])
def test_a_killed_run_leaves_whole_entries_only_and_they_are_kept(tmp_path, root, tables_before):
    raw, memo = folder(tmp_path, 3), tmp_path / "memo"
    ended = subprocess.run(
        [sys.executable, "-c", KILLED, raw, memo, str(tables_before)], cwd=root, check=False
    )
    assert ended.returncode == -signal.SIGKILL
    assert done(ingested(raw, tmp_path / "after", memo=memo)) == (2, 1, 0)
    ingested(raw, tmp_path / "fresh")
    assert tables(tmp_path / "after") == tables(tmp_path / "fresh")


# ---- quarantine


def broken(raw: Path) -> None:
    (raw / "backwards.csv").write_text("time_s,heater,zone\n0,1,20\n2,1,20\n1,1,20\n")
    (raw / "lacks.csv").write_text("time_s,heater\n0,1\n1,1\n")


def test_broken_recordings_are_quarantined_with_their_reasons_and_the_others_go_on(tmp_path):
    raw = folder(tmp_path, 3)
    ingested(raw, tmp_path / "good")
    broken(raw)
    assert done(ingested(raw, tmp_path / "all")) == (3, 0, 2)
    assert tables(tmp_path / "all")[0] == tables(tmp_path / "good")[0]
    quality = artifacts.read_table(tmp_path / "all/quality.parquet", JOB.quality)
    reasons = {
        name: text
        for name, kind, text in zip(quality["recording"], quality["kind"], quality["message"], strict=True)
        if kind == "quarantined"
    }
    assert set(reasons) == {"backwards.csv", "lacks.csv"}
    assert "before" in reasons["backwards.csv"]
    assert "zone" in reasons["lacks.csv"]
    # what was refused once is refused again, and is no reuse
    assert done(ingested(raw, tmp_path / "all")) == (0, 3, 2)


def test_the_child_changes_no_byte(tmp_path, monkeypatch):
    raw = folder(tmp_path, 3)
    broken(raw)
    ingested(raw, tmp_path / "child", LOKY)
    monkeypatch.setattr(
        recording_folders, "isolated", lambda work, *arguments, shown, budget: work(*arguments)
    )
    ingested(raw, tmp_path / "here")
    for name in NAMES:
        assert (tmp_path / "child" / name).read_bytes() == (tmp_path / "here" / name).read_bytes()


@pytest.mark.parametrize(
    ("reader", "budget", "reason"),
    [
        # milliseconds and a little memory for the others, and for the long one no end: no machine is too slow
        (long_readings.wait_for_ever, Budget(5.0, 2000), "long.csv: reading it takes longer than the 5 s"),
        (long_readings.take_for_ever, Budget(60.0, 50), "long.csv: reading it needs more memory than the 50"),
    ],
)
def test_a_recording_beyond_its_budget_is_quarantined_and_the_others_go_on(
    tmp_path, monkeypatch, reader, budget, reason
):
    raw = folder(tmp_path, 2)
    # what is loaded at the first call counts there: the budget is that of a warm child
    read_folder(raw, JOB, INLINE, memo=tmp_path / "warm", budget=BUDGET)
    recording(raw / "long.csv", seed=7)
    monkeypatch.setattr(recording_folders, "_one", reader)
    results = read_folder(raw, JOB, INLINE, memo=tmp_path / "memo", budget=budget)
    assert [result.name for result in results if result.reason] == ["long.csv"]
    assert reason in results[2].reason
    assert "in params.expert.yaml" in results[2].reason


def kinds(out: Path) -> dict[tuple[str, str], str]:
    """{(recording, kind): message} of the findings."""
    quality = artifacts.read_table(out / "quality.parquet", JOB.quality)
    rows = zip(quality["recording"], quality["kind"], quality["message"], strict=True)
    return {(str(name), str(kind)): str(message) for name, kind, message in rows}


def test_copies_that_are_not_complete_are_passed_over_with_a_note_and_not_quarantined(tmp_path, monkeypatch):
    raw = folder(tmp_path, 2)
    ingested(raw, tmp_path / "before")
    for name in ("001.csv.part", "002.csv.crdownload", "~$rig.xlsx", "Thumbs.db"):
        (raw / name).write_bytes(b"half")
    growing = recording(raw / "new.csv", seed=7)
    monkeypatch.setattr(plain_files, "REST_S", 10.0)
    monkeypatch.setattr(plain_files.time, "sleep", lambda _: growing.write_text("time_s,heater,zone\n"))
    settled = ingested(raw, tmp_path / "after", strict=True, waits=True)
    assert (settled["recordings"], settled["quarantined"]) == (2, 0)
    assert tables(tmp_path / "after")[0] == tables(tmp_path / "before")[0]
    messages = kinds(tmp_path / "after")
    assert "is still being written" in messages["new.csv", "passed_over"]
    assert "is a copy that is not complete" in messages["001.csv.part", "passed_over"]
    assert len([kind for _, kind in messages if kind == "passed_over"]) == 5


def test_a_recording_that_was_copied_a_moment_ago_is_read_when_it_has_rested(tmp_path, monkeypatch):
    raw, slept = folder(tmp_path, 1), []
    monkeypatch.setattr(plain_files, "REST_S", 10.0)
    monkeypatch.setattr(plain_files.time, "sleep", slept.append)
    assert done(ingested(raw, tmp_path, waits=True)) == (1, 0, 0)
    assert len(slept) == 1
    assert 0 < slept[0] <= 10
    monkeypatch.setattr(
        plain_files.time, "sleep", lambda _: (raw / "000.csv").write_text("time_s,heater,zone\n")
    )
    os.utime(raw / "000.csv")
    with pytest.raises(
        ValueError, match=r"found none but .*000\.csv is still being written; wait until its copy"
    ):
        ingested(raw, tmp_path, waits=True)


def test_a_folder_of_copies_that_are_not_complete_has_no_recording(tmp_path):
    (tmp_path / "raw").mkdir()
    (tmp_path / "raw/rig.csv.part").write_bytes(b"half")
    with pytest.raises(ValueError, match=r"found none but .*rig\.csv\.part is a copy that is not comp"):
        ingested(tmp_path / "raw", tmp_path)


@pytest.mark.parametrize(("cut", "share"), [(4, 0.0), (12, 9.1)])
def test_a_record_that_is_cut_by_more_than_a_twentieth_says_by_how_much(tmp_path, cut, share):
    raw = folder(tmp_path, 1)
    with (raw / "000.csv").open("a") as stream:
        stream.write("a total,of the\n" * cut)
    figures = ingested(raw, tmp_path)
    assert figures.get("cut_percent", {}) == ({"000.csv": share} if share else {})
    messages = kinds(tmp_path)
    assert (("000.csv", "cut") in messages) == bool(share)
    if share:
        assert messages["000.csv", "cut"].startswith("9.1 % of the recording was left out (limit 5 %)")


def test_an_mcap_that_lost_a_tenth_of_its_messages_says_so(tmp_path):
    raw = folder(tmp_path, 1)
    content = hostile.good_mcap(compression=NO)
    parts = chunks(content)
    (raw / "rig.mcap").write_bytes(content)
    assert "cut_percent" not in ingested(raw, tmp_path)
    (raw / "rig.mcap").write_bytes(flipped(content, parts[2][1] + 50, 0))
    assert ingested(raw, tmp_path)["cut_percent"] == {"rig.mcap": pytest.approx(100 / len(parts), abs=2.0)}


def test_a_signal_that_ends_early_cuts_the_record(tmp_path):
    raw = folder(tmp_path, 1)
    lines = (raw / "000.csv").read_text().splitlines()
    # the last quarter has no zone and less than half of the rows have its own clock: two files of a scope
    head = "Name\theater\tName\tzone\nData-Type\tREAL64\tData-Type\tREAL64\n"
    head += "SampleTime[ms]\t1000\tSampleTime[ms]\t1000\n"
    rows = [line.split(",") for line in lines[1:]]
    text = "".join(
        f"{float(t) * 1000:g}\t{u}\t" + (f"{float(t) * 1000:g}\t{y}\n" if i < 90 else "\t\n")
        for i, (t, u, y) in enumerate(rows)
    )
    (raw / "000.csv").write_text(head + text)
    assert ingested(raw, tmp_path)["cut_percent"] == {"000.csv": 25.0}


def test_strict_and_a_folder_of_broken_recordings_alone_end_with_the_first_reason(tmp_path):
    raw = folder(tmp_path, 1)
    broken(raw)
    with pytest.raises(ValueError, match=r"backwards\.csv.*\(2 of 3 recordings are broken\)"):
        ingested(raw, tmp_path, strict=True)
    (raw / "000.csv").unlink()
    with pytest.raises(ValueError, match=r"backwards\.csv.*\(2 of 2 recordings are broken\)"):
        ingested(raw, tmp_path)
    with pytest.raises(
        ValueError, match=r"expected at least one recording \(CSV, Parquet or MCAP\), found none"
    ):
        ingested(tmp_path / "nothing", tmp_path)


def test_a_copy_of_a_recording_is_quarantined_for_it_would_count_twice(tmp_path):
    raw = folder(tmp_path, 2)
    ingested(raw, tmp_path / "before")
    (raw / "copy.csv").write_bytes((raw / "001.csv").read_bytes())
    assert done(ingested(raw, tmp_path / "after", memo=tmp_path / "before/memo")) == (0, 2, 1)
    assert tables(tmp_path / "after")[0] == tables(tmp_path / "before")[0]
    with pytest.raises(
        ValueError, match=r"copy\.csv is 001\.csv once more, byte for byte; remove one of the two"
    ):
        ingested(raw, tmp_path / "after", strict=True)


def test_two_devices_in_one_recording_are_quarantined_with_the_place_and_in_a_part_of_it_masked(tmp_path):
    def mixed(path: Path, start: int) -> None:
        columns = np.genfromtxt(recording(path, seed=1, samples=600), delimiter=",", names=True)
        zone = np.where(
            (np.arange(600) >= start) & (np.arange(600) % 2 == 0), columns["zone"] + 9, columns["zone"]
        )
        artifacts.write_csv(path, {"time_s": columns["time_s"], "heater": columns["heater"], "zone": zone})

    raw = folder(tmp_path, 1)
    mixed(raw / "all.csv", 0)
    mixed(raw / "end.csv", 450)
    assert done(ingested(raw, tmp_path)) == (2, 0, 1)
    quality = artifacts.read_table(tmp_path / "quality.parquet", JOB.quality)
    columns = {
        (str(quality["recording"][i]), str(quality["kind"][i])): str(quality["message"][i])
        for i in range(len(quality["kind"]))
    }
    assert (
        "from 0 to 599 s, masked: two devices seem to write under one name"
        in columns["all.csv", "quarantined"]
    )
    assert "to 599 s, masked: two devices" in columns["end.csv", "mixed"]
    record = artifacts.read_table(tmp_path / "record.parquet", JOB.record)
    masked = record["zone_masked"][record["recording"] == "end.csv"]
    assert masked[-150:].all()
    assert not masked[:400].any()


def test_a_mapping_that_names_no_signal_gives_the_nearest_names():
    with pytest.raises(
        ValueError, match=r"ingest\.mapping\.zoone is no signal of the plant; the nearest names are zone"
    ):
        wish(zoone=("zone", "degC", 1.0, 0.0))


def test_a_set_point_is_declared_beside_an_output_and_beside_nothing_else():
    mapped = MappedSignal(source="T1_Ist", unit="degC", scale=1.0, offset=0.0, set_point="T1_Soll")
    assert [source.source for source in sources(MACHINE, {"zone": mapped})] == ["heater", "T1_Ist", "T1_Soll"]
    with pytest.raises(
        ValueError, match="heater.set_point is for outputs alone, but heater is none; take it"
    ):
        sources(MACHINE, {"heater": mapped})


# ---- more than one process


def test_two_workers_of_this_machine_give_the_bytes_of_one(tmp_path):
    raw = folder(tmp_path, 6)
    broken(raw)
    ingested(raw, tmp_path / "one", INLINE)
    ingested(raw, tmp_path / "two", LOKY)
    for name in NAMES:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


def test_a_dask_cluster_of_two_workers_gives_the_bytes_of_one_machine(tmp_path, cluster, monkeypatch):
    raw = folder(tmp_path, 6)
    broken(raw)
    monkeypatch.chdir(tmp_path)  # as the stage names them: relative paths
    ingested(Path("raw"), Path("one"))
    ingested(Path("raw"), Path("cluster"), cluster.execution)
    for name in NAMES:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "cluster" / name).read_bytes()


KILLER = """
import os, sys, time

print("waiting", flush=True)
while not os.listdir(sys.argv[1]):
    time.sleep(0.001)
os.kill(int(sys.argv[2]), 9)
print(sum(name.endswith(".json") for name in os.listdir(sys.argv[1])))
"""


def test_a_set_point_is_held_from_its_own_samples_and_missing_before_the_first(tmp_path):
    rows = ["time_s,heater,Soll,zone"]
    rows += [f"{t},20,{'' if t < 50 else 41 if t < 130 else 45},{40 + t / 10}" for t in range(200)]
    (tmp_path / "raw").mkdir()
    (tmp_path / "raw/a.csv").write_text("\n".join(rows))
    zone = MappedSignal(source="zone", unit="degC", scale=1.8, offset=32.0, set_point="Soll")
    settings = SETTINGS.model_copy(update={"mapping": {"zone": zone}})
    job = recording_wish(settings, MACHINE, settings.mapping)
    results = read_folder(tmp_path / "raw", job, INLINE, memo=tmp_path / "memo", budget=BUDGET)
    record, quality, _ = join(results, job, strict=False)
    held = record["zone_set_point"]
    assert np.isnan(held[:50]).all()
    np.testing.assert_allclose(held[50:], 1.8 * np.where(np.arange(50, 200) < 130, 41, 45) + 32)
    assert not record["zone_masked"].any()
    missing = quality["message"][quality["signal"] == "zone_set_point"]
    assert list(missing) == ["50 of 200 values of Soll are missing, the first in line 2; they are masked"]


def test_a_worker_killed_at_its_work_costs_nothing_but_time(tmp_path, mortal_cluster):
    raw = tmp_path / "raw"
    for k in range(6):
        recording(raw / f"{k:02d}.csv", seed=k, samples=10_000)
    ingested(raw, tmp_path / "one")
    # the second worker is killed as soon as anything is in the memo, with most of the work before it
    memo = tmp_path / "cluster/memo"
    memo.mkdir(parents=True)
    killer = subprocess.Popen(
        [sys.executable, "-c", KILLER, memo, str(mortal_cluster.workers[1].pid)], stdout=subprocess.PIPE
    )
    assert killer.stdout.readline() == b"waiting\n"
    metrics = ingested(raw, tmp_path / "cluster", mortal_cluster.execution)
    # entries that were whole when it died: there was work left
    assert int(killer.communicate(timeout=300)[0]) < 6
    mortal_cluster.workers[1].join(timeout=300)
    assert mortal_cluster.workers[1].exitcode == -signal.SIGKILL
    assert mortal_cluster.workers[0].is_alive()
    for name in NAMES:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "cluster" / name).read_bytes()
    assert done(metrics) == (6, 0, 0)


@pytest.mark.slow  # waits the 20 s that a scheduler is given
def test_no_scheduler_at_the_address_is_one_sentence(tmp_path):
    with pytest.raises(
        ValueError,
        match=r"execution\.scheduler: expected a dask scheduler with a worker at tcp://127\.0\.0\.1:9, found "
        r"none",
    ):
        ingested(
            folder(tmp_path, 2),
            tmp_path,
            params.Execution(backend="dask", jobs=2, scheduler="tcp://127.0.0.1:9"),
        )


def test_a_bag_is_one_recording_among_files(tmp_path):
    """Its parts and its metadata are no recordings of their own."""
    raw = folder(tmp_path, 1)
    bag(raw / "night" / "run")
    mapped = {
        "heater": ("/heater/duty:data", "percent", 1.0, 0.0),
        "zone": ("/zone_1/temperature:data", "degC", 1.0, 0.0),
    }
    results = read_folder(raw, wish(**mapped), INLINE, memo=tmp_path / "memo", budget=BUDGET)
    assert [result.name for result in results] == ["000.csv", "night/run"]
    assert "there is no column '/heater/duty:data'" in results[0].reason
    assert results[1].reason == "" and len(results[1].record["zone"]) == 80


def test_a_file_whose_name_is_no_text_is_quarantined_and_the_others_are_ingested(tmp_path):
    raw = folder(tmp_path, 2)
    strange = raw / os.fsdecode(b"line\xff.csv")
    try:
        recording(strange, seed=7)
    except OSError:
        pytest.skip("this file system takes names of UTF-8 alone")
    metrics = ingested(raw, tmp_path)
    assert done(metrics) == (2, 0, 1)
    reasons = [
        result.reason for result in read_folder(raw, JOB, INLINE, memo=tmp_path / "memo", budget=BUDGET)
    ]
    assert [r for r in reasons if r] == [
        f"{raw}/line\\udcff.csv: its name should be UTF-8 but has other bytes; rename the file"
    ]


# ---- the printer's own PID


PRINTER = Plant.model_validate(
    {
        "sample_time_s": 1.0,
        "inputs": [{"name": "nozzle_duty", "unit": "percent", "low": 0.0, "high": 100.0}],
        "outputs": [{"name": "nozzle", "unit": "degC", "reference": 200.0}],
    }
)


def test_the_printers_own_pid_comes_with_its_log_in_the_units_of_our_signals(tmp_path):
    (tmp_path / "klippy.log").write_text(print_log([(0, 200, 60)], longest_s=60))
    mapping = {
        "nozzle_duty": ("extruder.pwm", "percent", 0.5, 0.0),
        "nozzle": ("extruder.temp", "degC", 2.0, 0.0),
    }
    good = recording_folders.RecordingTable("klippy.log", {}, {}, "", False)
    sources = wish(PRINTER, **mapping).sources
    (pid,) = recording_folders.printer_pids(tmp_path, [good], sources, ["nozzle_duty"])["heaters"]
    assert (pid["recording"], pid["input"], pid["output"]) == ("klippy.log", "nozzle_duty", "nozzle")
    # percent for a duty of 0 to 255; half the input's unit over twice the output's
    expected = np.array(EXTRUDER.pid) * 100 / 255 * 0.5 / 2
    np.testing.assert_allclose([pid["Kp"], pid["Ki"], pid["Kd"]], expected, rtol=1e-12)  # rounding
    assert (
        recording_folders.printer_pids(tmp_path, [good._replace(reason="broken")], sources, ["nozzle_duty"])
        == {}
    )


def test_a_heater_that_is_no_signal_of_ours_and_another_format_have_no_pid(tmp_path):
    (tmp_path / "klippy.log").write_text(print_log([(0, 200, 60)], longest_s=60))
    recording(tmp_path / "a.csv", seed=0)
    results = [recording_folders.RecordingTable(name, {}, {}, "", False) for name in ("klippy.log", "a.csv")]
    assert recording_folders.printer_pids(tmp_path, results, JOB.sources, ["heater"]) == {}


def test_the_figures_of_the_probing_are_no_recording(tmp_path):
    raw = folder(tmp_path, 1)
    (raw / "figures.json").write_text("{}")
    results = read_folder(raw, JOB, INLINE, memo=tmp_path / "memo", budget=BUDGET, ignored=["figures.json"])
    assert [result.name for result in results] == ["000.csv"]


TWO_HEATERS = Plant.model_validate(
    {
        "sample_time_s": 1.0,
        "inputs": [
            {"name": name, "unit": "percent", "low": 0.0, "high": 100.0}
            for name in ("heater_extruder", "heater_bed")
        ],
        "disturbances": [{"name": "fan", "unit": "percent"}],
        "outputs": [
            {"name": name, "unit": "degC", "reference": 60.0}
            for name in ("temperature_bed", "temperature_extruder")
        ],
    }
)


def printed_record(bed_degC: np.ndarray, extruder_degC: np.ndarray) -> dict[str, np.ndarray]:
    """The columns of ingest, with the set-points of a bed that is held at 60 °C."""
    rng, samples = np.random.default_rng(0), len(bed_degC)
    values = {
        "temperature_bed": bed_degC + rng.normal(0, 0.05, samples),
        "temperature_extruder": extruder_degC + rng.normal(0, 0.05, samples),
        **{name: rng.uniform(0, 100, samples) for name in ("heater_extruder", "heater_bed", "fan")},
    }
    columns = {"recording": np.full(samples, "klippy.log", object), "segment": np.zeros(samples, np.int64)}
    columns |= {"time_s": np.arange(float(samples)), **values}
    columns |= {f"{name}_masked": np.zeros(samples, bool) for name in values}
    return columns | {"temperature_bed_set_point": np.full(samples, 60.0)}


def test_a_bed_that_is_held_all_night_is_left_out_and_the_hot_end_is_not(tmp_path):
    still, moved = np.full(3000, 60.0), 200 + 20 * np.sin(np.arange(3000) / 300)
    record = printed_record(still, moved)
    zones = still_zones(TWO_HEATERS, record, [])
    assert zones == {"temperature_bed": "heater_bed"}
    assert still_zones(TWO_HEATERS, printed_record(moved, moved), []) == {}
    assert still_zones(TWO_HEATERS, printed_record(still, still), []) == {}, "then no zone would be left"
    pid = {"input": "heater_extruder", "output": "temperature_bed"}
    assert still_zones(TWO_HEATERS, record, [pid]) == {"temperature_bed": "heater_extruder"}
    kept = without(TWO_HEATERS, zones)
    path = tmp_path / "record.parquet"
    schema = schemas.record(kept.acting, kept.outputs)
    artifacts.write_table(path, schema, {column.name: record[column.name] for column in schema.columns})
    assert recorded(TWO_HEATERS, str(path)) == kept
    assert [signal.name for signal in kept.acting] == ["heater_extruder", "fan"]
    assert recorded(TWO_HEATERS, str(tmp_path / "none.parquet")) == TWO_HEATERS
    assert recorded(MACHINE, str(path)) == MACHINE, "a table of another machine"
