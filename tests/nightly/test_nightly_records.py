"""Records come back from their files as they were."""

import json

import pytest

from pipeline.nightly.records import (
    Alarm,
    ChampionState,
    DriftMemory,
    Guard,
    Night,
    Remembered,
    from_json,
    to_json,
)
from tests.report.test_nightly_page import ALARM, FIRST, STATE

LAST = {
    "night": 14,
    "recordings": {"toy": {"datasets/raw/toy/fifth.csv": "e0b04046"}},
    "drift": {"alarms": [{"loop": "toy", "key": "k", "recording": "a", "cause": "c", "sigmas": 9.0}]},
    "hashes": {"dvc.yaml": [123, 1700000000000000000, 42, "0" * 64]},
}


@pytest.mark.parametrize(
    ("record", "fields"), [(ChampionState, STATE), (Night, FIRST), (Night, ALARM), (Remembered, LAST)]
)
def test_a_record_is_read_as_it_was_written(record, fields):
    value = from_json(record, fields)
    assert from_json(record, json.loads(json.dumps(to_json(value)))) == value


def test_a_record_has_its_fields_by_name_and_no_infinity():
    memory = DriftMemory(("k",), (Alarm("toy", "k", "a.csv", "the gain fell", 9.0, ("it settles low",)),))
    written = to_json(memory)
    assert written["pending"] == ["k"] and written["alarms"][0]["consequences"] == ["it settles low"]
    assert to_json(Guard(1.0, float("inf"), None)) == {"champion": 1.0, "challenger": None, "allowed": None}


def test_a_file_of_another_form_is_refused_by_the_place_in_it():
    with pytest.raises(ValueError, match="found champions.toy.when of another form"):
        from_json(ChampionState, {"champions": {"toy": {"run": "night-0001"}}})
