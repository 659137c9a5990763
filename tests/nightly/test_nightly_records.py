"""Files that nights of version 0.1 wrote are read as today's records, and written again byte for byte."""

import json
from pathlib import Path

import pytest

from pipeline.nightly.remembered import DriftMemory, Remembered
from pipeline.report.nightly.production import ChampionState
from pipeline.report.nightly.record import Night
from pipeline.report.shared.night import Alarm

# written by version 0.1 on the toy project: a first champion, one promoted, rolled back, its drift accepted
OLD = Path(__file__).parent / "version_0_1"


def text(data) -> str:
    return json.dumps(data, indent=2, ensure_ascii=False) + "\n"


def test_a_champion_file_of_version_0_1_is_read_and_written_byte_for_byte():
    before = (OLD / "champion.json").read_text(encoding="utf-8")
    state = ChampionState.read(json.loads(before))
    assert text(state.written()) == before
    events = [line.event for line in state.history]
    assert events == ["first champion", "promoted", "rolled back", "drift accepted"]
    assert state.history[2].replaced == state.history[1].champion.installed.files


def test_nights_of_version_0_1_are_read_and_written_byte_for_byte():
    before = (OLD / "nights.json").read_text(encoding="utf-8")
    nights = [Night.read(row) for row in json.loads(before)]
    rows = [night.written() for night in nights]
    # the figures of a machine belong to the temperature loop, whichever loop raised the alarm
    assert text(rows) == before
    outcomes = [night.outcome for night in nights]
    assert outcomes == ["promoted", "nothing new", "kept", "failed", "promoted", "kept"]
    assert [alarm.cause for alarm in nights[-1].drift.of("toy").alarms] == ["the gain has changed"]


def test_what_version_0_1_remembered_is_read_and_written_byte_for_byte():
    before = (OLD / "last.json").read_text(encoding="utf-8")
    last = Remembered.read(json.loads(before))
    assert text(last.written()) == before
    assert last.drift.drifted == {"toy": ["datasets/raw/toy/fifth.csv"]}


def test_an_alarm_that_lacks_fields_is_remembered_with_empty_ones():
    memory = DriftMemory.read({"alarms": [{"loop": "deposition"}]})
    assert memory.alarms == (Alarm("deposition", "", "", "", 0.0),) and memory.drifted == {}
    assert DriftMemory.read({}).written() == {}


@pytest.mark.parametrize("lacking", ["champions", "history"])
def test_a_champion_file_without_its_fields_is_refused(lacking):
    fields = {"champions": {}, "history": []}
    del fields[lacking]
    with pytest.raises(
        ValueError, match=f"champion.json: expected champions and history.* found no '{lacking}'; "
    ):
        ChampionState.read(fields)
