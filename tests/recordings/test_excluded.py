"""Recordings that are listed as excluded are read by no loop, for as long as they are what they were."""

from pathlib import Path

import pytest

from pipeline.recordings import excluded, recording_folders, trial_files
from tests import nozzle_folders
from tests.temperature.test_ingest import BUDGET, INLINE, JOB, folder


def test_an_excluded_bag_is_left_out_whole_and_a_broken_list_is_named(tmp_path):
    bag = tmp_path / "run"
    bag.mkdir()
    (bag / "run_0.mcap").write_bytes(b"1")
    (tmp_path / "good.mcap").write_bytes(b"2")
    excluded.exclude(bag, tmp_path, "swapped")
    every = [bag, bag / "run_0.mcap", tmp_path / "good.mcap"]
    assert excluded.readable(every, tmp_path) == [tmp_path / "good.mcap"]
    (bag / "run_0.mcap").write_bytes(b"mended")
    assert excluded.readable(every, tmp_path) == every
    (tmp_path / excluded.FILE).write_text("<<<<<<< HEAD\nrun: {")
    with pytest.raises(
        ValueError, match=r"excluded.yaml: expected paths, each with sha256 and reason, found "
    ):
        excluded.readable(every, tmp_path)


def test_a_second_entry_keeps_the_first_and_any_name_and_reason_come_back(tmp_path):
    names = {"a.csv": "°F, 30 times better", "deep/b: c.csv": 'has "quotes"\nand lines', "ü #.csv": "- x"}
    for name, reason in names.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
        excluded.exclude(tmp_path / name, tmp_path, reason)
    assert {name: entry["reason"] for name, entry in excluded.read_list(tmp_path).items()} == names
    assert excluded.exclusions(tmp_path) == {tmp_path / name for name in names}


def test_temperatures_are_ingested_without_an_excluded_recording_until_it_is_mended(tmp_path):
    raw = folder(tmp_path, 3)

    def read() -> list[str]:
        results = recording_folders.read_folder(raw, JOB, INLINE, memo=tmp_path / "memo", budget=BUDGET)
        assert not [result.reason for result in results if result.reason]
        return [result.name for result in results]

    excluded.exclude(raw / "001.csv", raw, "swapped")
    assert read() == ["000.csv", "002.csv"]
    (raw / "001.csv").write_text((raw / "001.csv").read_text().replace("\n60.0,", "\n60.00,"))
    assert read() == ["000.csv", "001.csv", "002.csv"]


def test_trials_and_prints_are_read_without_an_excluded_one(tmp_path):
    for name in ("good.mcap", "bad.mcap", ".hidden.mcap"):
        (tmp_path / name).write_bytes(name.encode())
    excluded.exclude(tmp_path / "bad.mcap", tmp_path, "half a file")
    assert trial_files.trial_paths(tmp_path) == [tmp_path / "good.mcap"]
    raw: Path = nozzle_folders.folder(tmp_path / "raw")
    before = nozzle_folders.read(raw)
    (raw / "bad.csv").write_text("no table of images")
    with pytest.raises(ValueError, match=r"bad.csv"):
        nozzle_folders.read(raw)
    excluded.exclude(raw / "bad.csv", raw, "no table of images")
    after = nozzle_folders.read(raw)
    assert after.source == before.source and nozzle_folders.notes(after) == nozzle_folders.notes(before)
