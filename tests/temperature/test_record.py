"""The record of ingest as the learners take it."""

import numpy as np

from pipeline.store import artifacts
from pipeline.temperature import tables
from pipeline.temperature.identification.segments import segments
from pipeline.temperature.settings import Input, Output

HEATER, ZONE = (
    Input(name="heater_1", unit="percent", low=0, high=100),
    Output(name="zone_1", unit="degC", reference=200),
)


def test_a_record_is_cut_at_gaps_and_recordings_and_masked_samples_are_missing(tmp_path):
    record = {
        "recording": ["a", "a", "a", "b", "b", "b"],
        "segment": [0, 0, 1, 1, 1, 1],
        "time_s": np.arange(6) * 0.5,
        "heater_1": np.linspace(0, 100, 6),
        "heater_1_masked": np.arange(6) == 1,
        "zone_1": np.array([20.0] * 5 + [np.nan]),
        "zone_1_masked": np.arange(6) == 5,
    }
    artifacts.write_table(tmp_path / "record.parquet", tables.record([HEATER], [ZONE]), record)
    table = artifacts.read_table(tmp_path / "record.parquet", tables.record([HEATER], [ZONE]))
    u, y, recordings = segments(table, ["heater_1"], ["zone_1"])
    assert recordings == ["a", "a", "b"]
    assert [segment.shape for segment in u] == [segment.shape for segment in y] == [(2, 1), (1, 1), (3, 1)]
    np.testing.assert_array_equal(np.concatenate(u)[:, 0], [0, np.nan, 40, 60, 80, 100])
    np.testing.assert_array_equal(y[2][:, 0], [20, 20, np.nan])
