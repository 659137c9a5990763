"""Tables as other people's programs write them: the unit of the time, dates beside times of day, and rows
that hold several signals are read as they are meant, or refused."""

import datetime

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipeline.recordings.formats import file_format
from pipeline.recordings.instants import DAY_NS
from pipeline.recordings.recordings import Source, inspect, read
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


def test_a_table_that_is_named_like_another_format_is_read_by_what_it_begins_with(tmp_path):
    text = "time_s,T1\n" + "".join(f"{i},{ZONE[i]}\n" for i in range(40))
    raw = read(write(tmp_path, text, "rig.parquet"), [Source("zone", "T1", "degC")])
    np.testing.assert_array_equal(raw.signals["zone"][1], ZONE)
    assert [n.message for n in raw.notes] == [
        "the file is named .parquet but begins as CSV does, and was read as that"
    ]
    pq.write_table(pa.table({"time_s": np.arange(40.0), "T1": ZONE}), tmp_path / "rig.CSV")
    raw = read(tmp_path / "rig.CSV", [Source("zone", "T1", "degC")])
    np.testing.assert_array_equal(raw.signals["zone"][1], ZONE)
    assert [n.message for n in raw.notes] == [
        "the file is named .csv but begins as Parquet does, and was read as that"
    ]


def test_a_damaged_parquet_file_is_not_taken_for_text(tmp_path):
    path = tmp_path / "rig.parquet"
    path.write_bytes(b"time" + bytes(range(1, 200)) * 3)
    with pytest.raises(ValueError, match=r"begin no parquet file; copy the recording again as binary"):
        file_format(path)


# ---- code pages


JAPANESE = "時刻[s],温度[℃],ヒータ出力[%]\n"
KOREAN = "시간,온도(℃),히터 출력(%)\n"


@pytest.mark.parametrize(
    ("header", "encoding", "time", "source"),
    [
        (JAPANESE, "cp932", "時刻[s]", "温度[℃]"),
        ("時刻,表ポ温度\n", "cp932", "時刻", "表ポ温度"),  # 0x5c and 0x7c are second bytes
        (KOREAN, "cp949", "시간", "온도(℃)"),
    ],
)
def test_japanese_and_korean_code_pages_are_read(tmp_path, header, encoding, time, source):
    path = tmp_path / "rig.csv"
    rest = ",30" * (header.count(",") - 1)
    path.write_bytes((header + "".join(f"{i},{ZONE[i]}{rest}\n" for i in range(40))).encode(encoding))
    raw = read(path, [Source("zone", source, "degC")], time=time)
    np.testing.assert_array_equal(raw.signals["zone"][1], ZONE)
    assert encoding in next(n.message for n in raw.notes if n.kind == "encoding")


@pytest.mark.parametrize(
    "name",
    [
        "Düsentemperatur °C",
        "Lösung für Öl ß",
        "Températures relevées à l’entrée",
        "créée, été",
        "“Größe” – ä…",
        "Ø Wärme µm²",
        "ÄÖÜ ÉÈ ÀÂ",
        "€ ‰ °C",
        "l’air d’été",
    ],
)
def test_german_and_french_files_are_not_taken_for_japanese_or_korean(tmp_path, name):
    path = tmp_path / "rig.csv"
    path.write_bytes((f"time_s;{name}\n" + "".join(f"{i};{ZONE[i]}\n" for i in range(40))).encode("cp1252"))
    raw = read(path, [Source("zone", name, "degC")])
    np.testing.assert_array_equal(raw.signals["zone"][1], ZONE)
    assert "Windows-1252" in next(n.message for n in raw.notes if n.kind == "encoding")


# ---- dates and times of day in other languages


@pytest.mark.parametrize(
    ("date", "time"),
    [("Datum", "Uhrzeit"), ("Datum", "Zeit"), ("Date", "Heure"), ("Data", "Ora"), ("Fecha", "Hora")]
    + [("Date", "Time"), ("DATUM", "UHRZEIT"), ("Uhrzeit", "Datum")],
)
def test_a_date_and_a_time_of_day_in_two_columns_are_one_time(tmp_path, date, time):
    begin, halves = datetime.datetime(2025, 11, 21, 23, 59, 50), range(40)
    stamps = [begin + datetime.timedelta(seconds=0.5 * i) for i in halves]
    forms = {date: "%d.%m.%Y", time: "%H:%M:%S.%f"}
    if date == "Uhrzeit":
        forms = {"Uhrzeit": "%H:%M:%S.%f", "Datum": "%d.%m.%Y"}
    lines = [";".join(f"{at:{form}}" for form in forms.values()) for at in stamps]
    text = f"{date};{time};T1\n" + "".join(f"{line};{ZONE[i]}\n" for i, line in enumerate(lines))
    path = write(tmp_path, text)
    np.testing.assert_allclose(np.diff(zone(path)[0]), 0.5)
    notes = read(path, [Source("zone", "T1", "degC")]).notes
    assert any("time is counted from 2025-11-21T23:59:50" in note.message for note in notes)


def test_a_data_column_of_numbers_is_no_date(tmp_path):
    lines = [f"13:00:{i:02d},{i},{ZONE[i]}\n" for i in range(40)]
    np.testing.assert_array_equal(
        np.diff(zone(write(tmp_path, "time,data,T1\n" + "".join(lines)))[0]), np.ones(39)
    )


@pytest.mark.parametrize("names", ["Fecha;Hora", "Date;Heure", "Data;Ora"])
def test_the_day_stands_first_in_dates_of_languages_that_write_it_first(tmp_path, names):
    lines = [f"{5 + i // 20:02d}/03/2025;{13 + i // 20}:00:{i % 20:02d};{ZONE[i]}\n" for i in range(40)]
    path = write(tmp_path, f"{names};T1\n" + "".join(lines))
    assert zone(path)[0][20] == 86_400 + 3600
    messages = [note.message for note in read(path, [Source("zone", "T1", "degC")]).notes]
    assert any("read with the day first, as its language writes them" in message for message in messages)


# ---- long logs of Siemens, and times of each signal of Beckhoff


def siemens(rows: list[tuple[str, int, float]], *, valid: str = "1", decimal: str = ",") -> str:
    """A long log of WinCC in TIA Portal: rows (variable, half second, value)."""
    begin, lines = datetime.datetime(2025, 11, 21, 13), []
    for name, k, value in rows:
        at = begin + datetime.timedelta(seconds=0.5 * k)
        days = (at - datetime.datetime(1899, 12, 30)) / datetime.timedelta(days=1)
        number, count = (f"{x}".replace(".", decimal) for x in (value, f"{days * 1e6:.6f}"))
        lines.append(f'"{name}";"{at:%d.%m.%Y %H:%M:%S}";{number};{valid};{count}\n')
    return '"VarName";"TimeString";"VarValue";"Validity";"Time_ms"\n' + "".join(lines)


def test_a_long_log_of_tia_portal_is_read_by_its_variables(tmp_path):
    rows = [(name, i, ZONE[i] + add) for i in range(40) for name, add in (("Zone_1", 0), ("DB1.Zone 2", 9))]
    text = siemens(rows) + '"$RT_OFF$";"21.11.2025 13:00:20";0;2;45982541898,148148\n'
    path = write(tmp_path, text)
    raw = read(path, [Source("a", "Zone_1", "degC"), Source("b", "DB1.Zone 2", "degC")])
    for signal, add in (("a", 0), ("b", 9)):
        time, values = raw.signals[signal]
        np.testing.assert_array_equal(values, ZONE + add)
        np.testing.assert_allclose(time, np.arange(40) / 2, atol=1e-6)
    assert any("1 rows are events of the panel ($RT_OFF$)" in note.message for note in raw.notes)
    with pytest.raises(ValueError, match="there is no column 'Zone_3'; the nearest names are"):
        zone(path, source="Zone_3")
    assert "Zone_1" in inspect(path)


def test_values_of_a_long_log_that_are_not_valid_are_missing(tmp_path):
    rows = [("Zone_1", i, ZONE[i]) for i in range(40)]
    bad = siemens(rows[20:21], valid="0").splitlines(keepends=True)[1]
    lines = siemens(rows).splitlines(keepends=True)
    raw = read(write(tmp_path, "".join([*lines[:21], bad, *lines[22:]])), [Source("zone", "Zone_1", "degC")])
    time, values = raw.signals["zone"]
    assert np.isnan(values[20]) and np.isfinite(np.delete(values, 20)).all()
    np.testing.assert_allclose(time, np.arange(40) / 2, atol=1e-6)


def test_a_long_log_without_its_count_of_days_has_the_seconds_of_its_text(tmp_path):
    lines = siemens([("A", 2 * i, ZONE[i]) for i in range(40)]).splitlines()
    text = "".join(line.rsplit(";", 1)[0] + "\n" for line in lines)
    time, values = zone(write(tmp_path, text), source="A")
    np.testing.assert_array_equal(values, ZONE)
    np.testing.assert_array_equal(time, np.arange(40))


def test_a_word_in_place_of_a_value_of_a_long_log_is_refused_with_its_line(tmp_path):
    text = siemens([("A", i, ZONE[i]) for i in range(40)]).replace(";201,0;", ";hot;")
    with pytest.raises(ValueError, match=r"line \d+, column VarValue should be a number but is 'hot'"):
        zone(write(tmp_path, text), source="A")


def test_a_long_log_with_a_row_without_time_or_a_variable_without_a_whole_row_is_refused(tmp_path):
    lines = siemens([("A", i, ZONE[i]) for i in range(40)]).splitlines(keepends=True)
    no_time = lines[20].rpartition(";")[0] + ";\n"
    path = write(tmp_path, "".join([*lines[:20], no_time, *lines[21:]]))
    with pytest.raises(ValueError, match=r"line 21, time Time_ms should be millionths .* but is ''; mend"):
        zone(path, source="A")
    with pytest.raises(ValueError, match="B should have values but no whole row holds one; map another"):
        zone(write(tmp_path, "".join([*lines, '"B";"21.11.2025 13:00:30"'])), source="B")


def scope(*, unit: float = 1.0, samples_ms: tuple[int, int] = (500, 1000), mark: str = "\t") -> str:
    """An export of TwinCAT Scope: a head, then time and value of each signal; the second is half as fast."""
    head = "Name\tRig\nFile\tC:\\rig.tcscopex\nStarttime of export\t134082108000000000\tFreitag\n\n"
    for key, left, right in (
        ("Name", "Zone 1", "Heater"),
        ("Data-Type", "REAL64", "REAL64"),
        ("SampleTime[ms]", *map(str, samples_ms)),
        ("Port", "851", "851"),
    ):
        head += f"{key}\t{left}\t{key}\t{right}\n"
    rows = []
    for i in range(40):
        first = f"{500 * i * unit:g}\t{ZONE[i]}"
        second = f"{1000 * i * unit:g}\t{float(i)}" if i < 20 else "\t"
        rows.append(f"{first}\t{second}\n")
    return (head + "\n" + "".join(rows)).replace("\t", mark)


@pytest.mark.parametrize("mark", ["\t", ";"])
@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e4])
def test_an_export_of_twincat_scope_has_a_clock_for_each_signal(tmp_path, unit, mark):
    path = write(tmp_path, scope(unit=unit, mark=mark))
    raw = read(path, [Source("zone", "Zone 1", "degC"), Source("u", "Heater", "percent")])
    for signal, interval, values in (("zone", 0.5, ZONE), ("u", 1.0, np.arange(20.0))):
        np.testing.assert_allclose(raw.signals[signal][0], interval * np.arange(len(values)), atol=1e-9)
        np.testing.assert_array_equal(raw.signals[signal][1], values)
    assert "Heater" in inspect(path)


def test_an_export_of_twincat_scope_whose_unit_of_time_nothing_tells_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"Zone 1 .* 0\.35 .*\[ms\] is 500; export .* milliseconds"):
        zone(write(tmp_path, scope(unit=0.0007)), source="Zone 1")


def test_two_signals_of_one_name_in_an_export_of_twincat_scope_are_refused(tmp_path):
    path = write(tmp_path, scope().replace("Heater", "Zone 1"))
    with pytest.raises(ValueError, match="2 columns are called 'Zone 1'; give each a name of its own"):
        zone(path, source="Zone 1")


# ---- units and epochs that would be read wrongly


FAHRENHEIT = 32 + 1.8 * ZONE


@pytest.mark.parametrize("name", ["T1 [°F]", "T1 (F)", "T1_degF", "T1 (Fahrenheit)", "T1 °F"])
def test_a_column_in_fahrenheit_is_not_taken_as_celsius(tmp_path, name):
    path = write(tmp_path, f"time_s,{name}\n" + "".join(f"{i},{v:.2f}\n" for i, v in enumerate(FAHRENHEIT)))
    with pytest.raises(ValueError, match=r"is in °F .*set scale: 0\.555556 and offset: -17\.7778"):
        zone(path, source=name)
    right = read(path, [Source("zone", name, "degC", 0.5556, -17.78)]).signals["zone"][1]
    np.testing.assert_allclose(right, ZONE, atol=0.1)
    read(path, [Source("zone", name, "degF")])


@pytest.mark.parametrize("name", ["Zone F", "zone_F", "T1 (°C)"])
def test_an_f_at_the_end_of_a_name_is_no_unit_without_brackets(tmp_path, name):
    path = write(tmp_path, f"time_s,{name}\n" + "".join(f"{i},{v}\n" for i, v in enumerate(ZONE)))
    np.testing.assert_array_equal(zone(path, source=name)[1], ZONE)


def test_fahrenheit_in_the_cells_in_a_row_of_units_and_in_other_formats_is_refused_too(tmp_path):
    cells = "time_s,T1\n" + "".join(f"{i},{v:.2f} °F\n" for i, v in enumerate(FAHRENHEIT))
    units = "time,T1\ns,°F\n" + "".join(f"{i},{v:.2f}\n" for i, v in enumerate(FAHRENHEIT))
    fields = [pa.field("time_s", pa.float64()), pa.field("T1", pa.float64(), metadata={"unit": "degF"})]
    pq.write_table(pa.table([np.arange(40.0), FAHRENHEIT], pa.schema(fields)), tmp_path / "rig.parquet")
    rows = [["time", "T1"], ["s", "°F"], *([float(i), float(v)] for i, v in enumerate(FAHRENHEIT))]
    (tmp_path / "rig.xlsx").write_bytes(workbook(sheet(rows)))
    for path in (write(tmp_path, cells), write(tmp_path, units, "units.csv"), tmp_path / "rig.parquet",
                 tmp_path / "rig.xlsx"):  # fmt: skip
        with pytest.raises(ValueError, match=r"T1 is in °F .*set scale: 0\.555556 and offset: -17\.7778"):
            zone(path)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_ticks_of_dotnet_are_read_as_such(tmp_path, suffix):
    since = datetime.datetime(2025, 11, 21, 13) - datetime.datetime(1, 1, 1)
    ticks = since // datetime.timedelta(seconds=1) * 10**7 + np.arange(40, dtype=np.int64) * 5_000_000
    path = tmp_path / f"rig{suffix}"
    if suffix == ".csv":
        write(tmp_path, "timestamp,T1\n" + "".join(f"{t},{v}\n" for t, v in zip(ticks, ZONE, strict=True)))
    else:
        pq.write_table(pa.table({"timestamp": ticks, "T1": ZONE}), path)
    raw = read(path, [Source("zone", "T1", "degC")])
    np.testing.assert_allclose(raw.signals["zone"][0], np.arange(40) / 2, atol=2e-5)
    messages = [note.message for note in raw.notes]
    assert any("ticks of .NET (100 ns since the year 1)" in message for message in messages)
    assert any("time is counted from 2025-11-21T13:00:00" in message for message in messages)
