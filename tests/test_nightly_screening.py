"""New recordings of the temperature loop before anything learns from them: set aside, or measured against the champion's own nights."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from benchmarks import nights
from pipeline import artifacts, params
from pipeline.nightly import screening
from pipeline.nightly.settings import Nightly
from pipeline.temperature import identification, plant

STATE = {"champions": {"temperature": {}}}
RAW = Path("datasets/raw/temperature")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Four good shifts of a machine of two zones, the model identified from them, and what they say of it: the champion's folder."""
    folder = tmp_path_factory.mktemp("screening")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        Path("params.yaml").write_text(yaml.safe_dump(nights.settings()))
        shifts = [nights.a_night(1, k) for k in range(4)]
        for k, columns in enumerate(shifts):
            nights.write(RAW / f"shift_{k}.csv", columns)
        u, y = ([np.column_stack([one[f"{kind}_1"], one[f"{kind}_2"]]) for one in shifts] for kind in ("heater", "sensor"))
        model = identification.identify(u, y, sample_time_s=1.0, max_order=3, names=["heater_1", "heater_2"]).plant
        champion = Path("champion/temperature")
        artifacts.write_arrays(champion / "identify_plant/plant.parquet", "plant", 1, plant.stored([model]))
        artifacts.write_json(champion / "tune_weights/weights.json", {"practical": {"q": [1.0, 1.0], "r": [1.0, 1.0], "observer_tau": 1.0}})
        artifacts.write_json(
            champion / screening.REFERENCE, screening.reference(params.load(Nightly, "nightly").loops["temperature"], champion)
        )
    return folder


@pytest.fixture
def look(made, monkeypatch):
    """look(columns, memory): the screening of one new shift."""
    monkeypatch.chdir(made)
    path = RAW / "new.csv"

    def one(columns, memory=None):
        nights.write(path, columns)
        return screening.look(params.load(Nightly, "nightly"), STATE, {"temperature": {str(path): "new"}}, memory or {}, night=9)

    yield one
    path.unlink(missing_ok=True)


def test_a_good_shift_raises_nothing(look):
    for k in range(5):
        found = look(nights.a_night(1, 100 + k))
        assert found["alarms"] == [] and found["quarantined"] == {}, found


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"gain": (0.9, 1.0)}, "gain from heater_1"),
        ({"gain": (1.0, 1.1)}, "gain from heater_2"),
        ({"slower": (1.1, 1.1)}, "time constants of what answers to every input"),
    ],
)
def test_ten_percent_of_drift_is_named_within_two_nights(look, changes, words):
    memory = {}
    for k in (200, 201):
        found = look(nights.a_night(1, k, **changes), memory)
        memory = found["memory"]
        if found["alarms"]:
            break
    assert any(words in alarm["cause"] for alarm in found["alarms"]), found["alarms"]


def test_swapped_sensors_are_set_aside_with_the_reason_beside_them(look):
    good = nights.a_night(1, 300)
    found = look(good | {"sensor_1": good["sensor_2"], "sensor_2": good["sensor_1"]})
    assert "the sensors sensor_1 and sensor_2 are swapped" in found["quarantined"][str(RAW / "new.csv")]
    assert not (RAW / "new.csv").exists() and (screening.QUARANTINE / "temperature/new.csv").exists()
    assert "swapped" in (screening.QUARANTINE / "temperature/new.csv.reason.txt").read_text()


def test_a_night_without_recordings_keeps_the_alarm_of_the_one_before(look):
    alarm = {"loop": "temperature", "cause": "the gain from heater_1 has changed by -10 %"}
    found = screening.look(params.load(Nightly, "nightly"), STATE, {"temperature": {}}, {"alarms": [alarm]}, night=9)
    assert found["alarms"] == [alarm]
