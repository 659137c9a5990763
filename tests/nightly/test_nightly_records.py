"""Files that nights wrote are read as records, and written again byte for byte."""

import json

import pytest

from pipeline.nightly.records import Alarm, ChampionState, Night
from pipeline.nightly.remembered import DriftMemory, Remembered
from tests.report.test_nightly_page import ALARM, FIRST, STATE

CAUSE = {"cause": "the gain has changed", "sigmas": 9.0, "consequences": ["it settles elsewhere"]}
LAST = {
    "night": 14,
    "success": "2030-01-03T21:00:00+00:00",
    "inputs": "a92d03c9",
    "unpushed": False,
    "recordings": {"toy": {"datasets/raw/toy/fifth.csv": "e0b04046"}},
    "drift": {
        "pending": ["toy: k"],
        "alarms": [{"loop": "toy", "key": "toy: k", "recording": "datasets/raw/toy/fifth.csv"} | CAUSE],
        "drifted": {"toy": ["datasets/raw/toy/fifth.csv"]},
        "night": 3,
    },
    "hashes": {"dvc.yaml": [123, 1700000000000000000, 42, "0" * 64]},
}


@pytest.mark.parametrize(("record", "fields"), [(ChampionState, STATE), (Night, FIRST), (Night, ALARM)])
def test_what_a_record_writes_is_read_and_written_byte_for_byte(record, fields):
    written = json.dumps(record.read(fields).to_json())
    assert json.dumps(record.read(json.loads(written)).to_json()) == written
    assert record.read(json.loads(written)) == record.read(fields)


def test_what_a_night_remembers_is_read_and_written_byte_for_byte():
    last = Remembered.read(json.loads(json.dumps(LAST)))
    assert json.dumps(last.to_json()) == json.dumps(LAST)
    assert last.drift.drifted == {"toy": ["datasets/raw/toy/fifth.csv"]}


def test_an_alarm_that_lacks_fields_is_remembered_with_empty_ones():
    memory = DriftMemory.read({"alarms": [{"loop": "deposition"}]})
    assert memory.alarms == (Alarm("deposition", "", "", "", 0.0),) and memory.drifted == {}
    assert DriftMemory.read({}).to_json() == {}


@pytest.mark.parametrize("lacking", ["champions", "history"])
def test_a_champion_file_without_its_fields_is_refused(lacking):
    fields = {"champions": {}, "history": []}
    del fields[lacking]
    with pytest.raises(
        ValueError, match=f"champion.json: expected champions and history.* found no '{lacking}'; "
    ):
        ChampionState.read(fields)
