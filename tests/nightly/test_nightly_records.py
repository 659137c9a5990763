"""Records come back from their files as they were."""

import json

import pytest

from pipeline.nightly.records import ChampionState, Memory, Night, from_json, to_json
from tests.report.test_nightly_page import ALARM, FIRST, STATE

LAST = {
    "night": 14,
    "recordings": {"toy": {"datasets/raw/toy/fifth.csv": "e0b04046"}},
    "alarms": [{"loop": "toy", "key": "k", "recording": "a", "cause": "c", "sigmas": 9.0}],
    "hashes": {"dvc.yaml": [123, 1700000000000000000, 42, "0" * 64]},
    "nights": [FIRST, ALARM],
}


@pytest.mark.parametrize(
    ("record", "fields"), [(ChampionState, STATE), (Night, FIRST), (Night, ALARM), (Memory, LAST)]
)
def test_a_record_is_read_as_it_was_written(record, fields):
    value = from_json(record, fields)
    written = to_json(value)
    assert from_json(record, json.loads(json.dumps(written))) == value


def test_json_knows_no_infinity():
    assert to_json({"guard": (1.0, float("inf"), None)}) == {"guard": [1.0, None, None]}


def test_a_file_of_another_form_is_refused_by_the_place_in_it():
    with pytest.raises(ValueError, match="found champions.toy.when of another form"):
        from_json(ChampionState, {"champions": {"toy": {"run": "night-0001"}}})
