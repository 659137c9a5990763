"""Tables as other people's programs write them: the unit of the time, dates beside times of day, and rows
that hold several signals are read as they are meant, or refused."""

import datetime

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipeline.recordings.formats import file_format
from pipeline.recordings.instants import DAY_NS
from pipeline.recordings.recordings import Source, read
from pipeline.recordings.spreadsheets import _join_dates, load_spreadsheet
from tests.recordings.test_spreadsheets import sheet, workbook

MINUTES = np.arange(40) / 4
ZONE = 200 + np.arange(40) % 7 * 0.5


def zone(path, *, source: str = "T1", time: str = "") -> tuple[np.ndarray, np.ndarray]:
    raw = read(path, [Source("zone", source, "degC")], time=time)
    return raw.signals["zone"]


def write(tmp_path, text: str, name: str = "rig.csv"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


# ---- the unit of the time


@pytest.mark.parametrize("blank", ["", "\n"])
@pytest.mark.parametrize(("unit", "in_a_minute"), [("min", 1), ("(ms)", 60_000), ("[s]", 60), ("h", 1 / 60)])
def test_a_row_of_units_gives_the_unit_of_the_time(tmp_path, unit, in_a_minute, blank):
    lines = [
        f"{float(minute * in_a_minute)!r},{value}\n" for minute, value in zip(MINUTES, ZONE, strict=True)
    ]
    path = write(tmp_path, f"Time,T1\n{unit},degC\n{blank}" + "".join(lines))
    # a quotient and a product of doubles: a few last bits of 600 s
    np.testing.assert_allclose(zone(path)[0], MINUTES * 60, atol=1e-9)


def test_the_unit_below_the_time_of_a_workbook_and_in_a_parquet_field_counts(tmp_path):
    rows = [["Time", "T1"], ["min", "degC"], *zip(MINUTES.tolist(), ZONE.tolist(), strict=True)]
    book = tmp_path / "rig.xlsx"
    book.write_bytes(workbook(sheet(rows)))
    np.testing.assert_allclose(zone(book)[0], MINUTES * 60, atol=1e-9)
    fields = [pa.field("time", pa.float64(), metadata={"unit": "min"}), pa.field("T1", pa.float64())]
    pq.write_table(pa.table([MINUTES, ZONE], pa.schema(fields)), tmp_path / "rig.parquet")
    np.testing.assert_allclose(zone(tmp_path / "rig.parquet")[0], MINUTES * 60, atol=1e-9)


def test_a_julian_date_is_not_read_as_seconds(tmp_path):
    rows = "".join(f"{2_461_001 + i / 86400:.9f},{ZONE[i]}\n" for i in range(40))
    with pytest.raises(ValueError, match="may be seconds, or days with 1 s between samples"):
        zone(write(tmp_path, "time,T1\n" + rows))


def test_a_time_that_may_be_the_fraction_of_a_day_is_refused_unless_its_name_has_a_unit(tmp_path):
    days = 0.5 + np.arange(40) / 86400
    rows = "".join(f"{day:.9f},{value}\n" for day, value in zip(days, ZONE, strict=True))
    with pytest.raises(ValueError, match=r"may be seconds, or days with 1 s between .* Time_s or Time_days$"):
        zone(write(tmp_path, "Time,T1\n" + rows))
    # nine decimals of a day are 0.1 ms
    np.testing.assert_allclose(np.diff(zone(write(tmp_path, "Time_days,T1\n" + rows))[0]), 1.0, atol=2e-4)
    assert np.ptp(zone(write(tmp_path, "Time_s,T1\n" + rows))[0]) < 1e-3


# ---- dates and times of day


def test_a_date_and_a_time_of_day_of_a_workbook_are_one_time():
    seconds = np.array([86_398, 86_399, 86_400, 86_401]) * 10**9
    stamps, others = {"Date": np.array([3, 3, 4, 4]) * DAY_NS, "Time": seconds}, {}
    _join_dates(stamps, {"Time"}, others)
    np.testing.assert_array_equal(stamps["Time"], 3 * DAY_NS + seconds)
    assert list(stamps) == ["Time"]


def test_a_date_beside_an_elapsed_time_is_not_added_to_it(tmp_path):
    begin = datetime.datetime(2025, 11, 21, 20)
    lines = [
        f"{begin + datetime.timedelta(minutes=10 * i):%Y-%m-%d},{i // 6}:{i % 6 * 10:02d}:00,{ZONE[i]}\n"
        for i in range(40)
    ]
    path = write(tmp_path, "Date,Elapsed,T1\n" + "".join(lines))
    np.testing.assert_array_equal(np.diff(zone(path)[0]), 600.0)


def test_a_column_called_like_a_time_comes_before_dates_of_another_name(tmp_path):
    rows = [["calibrated", "time_s", "T1"], *([40_000 + i, i * 0.5, float(ZONE[i])] for i in range(40))]
    path = tmp_path / "rig.xlsx"
    path.write_bytes(workbook(sheet(rows, dates=(0,))))
    assert "calibrated" in load_spreadsheet(path).stamps
    np.testing.assert_array_equal(zone(path)[0], np.arange(40) * 0.5)


# ---- which mark splits the rows


def test_a_table_with_tabs_is_not_split_at_the_blanks_of_its_names(tmp_path):
    lines = [f"{i}\t11/21/2025\t13:00:{i:02d}\t{ZONE[i]}\tC\n" for i in range(40)]
    path = write(tmp_path, "OMEGA HH806\nNo.\tDate\tTime\tT1\tUnit\n" + "".join(lines), "rig.txt")
    np.testing.assert_array_equal(zone(path)[1], ZONE)
    units = "Seconds\tT1\n\tAve. (C)\n" + "".join(f"{i}\t{ZONE[i]}\n" for i in range(40))
    np.testing.assert_array_equal(zone(write(tmp_path, units, "rig.txt"))[1], ZONE)


def test_a_comma_in_the_fraction_of_a_second_is_no_mark_between_columns(tmp_path):
    values = [f"{value:.2f}".replace(".", ",") for value in ZONE]
    lines = [f"21.11.25;13:00:{i:02d},5;{value}\n" for i, value in enumerate(values)]
    path = write(tmp_path, "Datum;Uhrzeit;T1\n" + "".join(lines))
    time, read_values = zone(path)
    np.testing.assert_array_equal(read_values, ZONE)
    np.testing.assert_array_equal(np.diff(time), 1.0)


# ---- rows of several signals


@pytest.mark.parametrize("name", ["entity_id", "_field", "VarName", "tag"])
def test_rows_that_a_column_gives_to_several_signals_are_refused(tmp_path, name):
    lines = [f"zone{i % 2},{i},{ZONE[i]}\n" for i in range(40)]
    path = write(tmp_path, f"{name},time,value\n" + "".join(lines))
    with pytest.raises(ValueError, match=rf"line 3, column {name} names 'zone1' but the rows before 'zone0'"):
        zone(path, source="value")
    one = write(tmp_path, f"{name},time,value\n" + "".join(lines).replace("zone1", "zone0"), "one.csv")
    np.testing.assert_array_equal(zone(one, source="value")[1], ZONE)


def test_series_of_influxdb_in_one_column_are_refused(tmp_path):
    head = ",result,table,_time,_value\n"
    series = [[f",,{k},2025-11-21T12:00:{i:02d}Z,{ZONE[i] + k}\n" for i in range(40)] for k in range(2)]
    with pytest.raises(ValueError, match="column table names '1' but the rows before '0'"):
        zone(write(tmp_path, head + "".join(sum(series, []))), source="_value")
    np.testing.assert_array_equal(zone(write(tmp_path, head + "".join(series[0])), source="_value")[1], ZONE)


def test_rows_of_several_signals_in_parquet_and_workbooks_are_refused(tmp_path):
    columns = {"time": np.arange(40.0), "value": ZONE, "tag": ["a"] * 30 + ["b"] * 10}
    pq.write_table(pa.table(columns), tmp_path / "rig.parquet")
    with pytest.raises(ValueError, match="row 30, column tag names 'b' but the rows before 'a'"):
        zone(tmp_path / "rig.parquet", source="value")
    rows = [["time", "tag", "value"], *([float(i), "ab"[i > 29], float(ZONE[i])] for i in range(40))]
    (tmp_path / "rig.xlsx").write_bytes(workbook(sheet(rows)))
    with pytest.raises(ValueError, match="row 32, column tag names 'b' but the rows before 'a'"):
        zone(tmp_path / "rig.xlsx", source="value")


# ---- formats


def test_an_encrypted_parquet_file_is_called_so(tmp_path):
    path = tmp_path / "rig.parquet"
    path.write_bytes(b"PARE" + bytes(range(200)) + b"PARE")
    with pytest.raises(ValueError, match="is an encrypted Parquet file .*; write it without encryption$"):
        file_format(path)


def test_a_refusal_does_not_repeat_a_long_text_of_the_file(tmp_path):
    pq.write_table(pa.table({"time": [0.0, 1.0], "T1": ["x" * 100_000] * 2}), tmp_path / "rig.parquet")
    with pytest.raises(ValueError, match="column T1 should hold numbers") as refused:
        zone(tmp_path / "rig.parquet")
    assert len(str(refused.value)) < 600
