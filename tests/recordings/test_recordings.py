import datetime
import gzip

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipeline.recordings.csv_files import csv_layout, read_csv
from pipeline.recordings.recordings import Source, inspect, nearest_names, read
from pipeline.store.artifacts import write_recording
from tests.mcap_writing import Written

SOURCES = [Source("u", "u", "percent"), Source("y", "y", "degC")]


def opened(tmp_path, content: bytes | str, sources=SOURCES, name: str = "recording.csv", **options):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read(path, sources, **options)


def refusal(tmp_path, content: bytes | str, sources=SOURCES, name: str = "recording.csv", **options) -> str:
    with pytest.raises(ValueError, match=name) as error:
        opened(tmp_path, content, sources, name, **options)
    assert "\n" not in str(error.value)
    return str(error.value)


# ---- the same record in every format


def test_one_record_reads_alike_from_csv_parquet_and_mcap(tmp_path):
    rng = np.random.default_rng(0)
    time, u, y = np.arange(200) * 0.1, rng.normal(size=200), rng.normal(size=200)
    rows = zip(time.tolist(), u.tolist(), y.tolist(), strict=True)
    (tmp_path / "a.csv").write_text("time_s,u,y\n" + "".join(f"{a!r},{b!r},{c!r}\n" for a, b, c in rows))
    pq.write_table(pa.table({"time_s": time, "u": u, "y": y}), tmp_path / "a.parquet", row_group_size=37)
    write_recording(tmp_path / "a.mcap", time, {"u": (u, "percent", ""), "y": (y, "degC", "")})
    for name in ("a.csv", "a.parquet", "a.mcap"):
        raw = read(tmp_path / name, SOURCES)
        np.testing.assert_array_equal(raw.signals["u"][1], u)
        np.testing.assert_array_equal(raw.signals["y"][1], y)
        # MCAP counts whole nanoseconds
        np.testing.assert_allclose(raw.signals["y"][0], time, rtol=0, atol=0.5e-9 if name == "a.mcap" else 0)
        assert raw.notes == []


def test_scale_and_offset_turn_kelvin_and_duty_into_our_units(tmp_path):
    raw = opened(
        tmp_path,
        "t,u,y\n0,0.5,293.15\n1,1,300\n",
        [Source("u", "u", "percent", 100.0), Source("y", "y", "degC", 1.0, -273.15)],
    )
    np.testing.assert_allclose(raw.signals["u"][1], [50, 100], rtol=1e-15)
    np.testing.assert_allclose(raw.signals["y"][1], [20, 26.85], rtol=1e-14)


# ---- CSV as it comes


@pytest.mark.parametrize(
    "content",
    [
        "t_s,u,y\n0,1.5,2\n1,2.5,3\n",
        "\ufefft_s,u,y\r\n0,1.5,2\r\n1,2.5,3\r\n",
        "t_s;u;y\n0;1,5;2\n1;2,5;3\n",
        "t_s\tu\ty\n0\t1.5\t2\n1\t2.5\t3",
        "t_s u   y\n0  1.5 2\n1  2.5 3\n",
        "# made by a logger\n\nt_s, u, y,\n0, 1.5, 2,\n# a remark\n\n1, 2.5, 3,\n",
        "# t_s,u,y\n0,1.5,2\n1,2.5,3\n",
        "Device: rig 7\nt_s,u,y\ns,%,C\n0,1.5,2\n1,2.5,3\n",
        '"t_s","u","y"\n"0","1.5","2"\n"1","2.5","3"\n',
        "y,note,Time [ms],u\n2,first,0,1.5\n3,second,1000,2.5\n",
        "timestamp,u,y\n2025-11-21T13:00:00Z,1.5,2\n2025-11-21 14:00:01+01:00,2.5,3\n",
        "timestamp,u,y\n1763730000000,1.5,2\n1763730001000,2.5,3\n",
        "time_min,u,y\n0,1.5,2\n0.016666666666666666,2.5,3\n",
        # of controllers, spreadsheets and historians
        "Recorder;R-7\nSerial;12345\n\nDatum;Uhrzeit;u;y\n;;%;C\n21.11.2025;13:00:00;1,5;2\n"
        "21.11.2025;13:00:01;2,5;3\n",
        "sep=;\nZeit;u;y\n21.11.2025 23:59:59,5;1,5;2,0\n22.11.2025 00:00:00,5;2,5;3,0\n",
        "time,u,y\n23:59:59,1.5,2\n00:00:00,2.5,3\n",
        "Timestamp (UTC),u,y\n11/21/2025 01:00:00 PM,1.5,2\n11/21/2025 01:00:01 PM,2.5,3\n",
        "stamp,u,y\n20251121130000,1.5,2\n20251121130001,2.5,3\n",
        "Date,u,y\n45982.5416666667,1.5,2\n45982.5416782407,2.5,3\n",
        '"t","u","y"\n"0,0","1,5","2,0"\n"1,0","2,5","3,0"\n',
        "t,u,y\n0,1.5,2\nt,u,y\n1,2.5,3\n",
        "t,u,y\n0,1.5,2\n1,2.5,3\n\nTotal,,\nAverage,2,2.5\n-- end of log --\n",
        "timestamp,u,y\n2025-11-21 13:00:01,2.5,3\n2025-11-21 13:00:00,1.5,2\n",
        "time,1,u,y\n0,7,1.5,2\n1,7,2.5,3\n",
    ],
)
def test_csv_of_many_programs_is_the_same_record(tmp_path, content):
    raw = opened(tmp_path, content)
    # a minute's sixtieth is rounded; ten digits of a spreadsheet's day are 9 us
    time = raw.signals["u"][0]
    np.testing.assert_allclose(
        time - np.floor(time[0]),
        np.array([0, 1]) + time[0] % 1,
        rtol=1e-15,
        atol=9e-6 if "Date," in content else 0,
    )
    assert raw.signals["u"][1].tolist() == [1.5, 2.5]
    assert raw.signals["y"][1].tolist() == [2, 3]


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "cp1252", "utf-8-sig"])
def test_csv_in_other_encodings_keeps_its_names(tmp_path, encoding):
    content = "t_s,Düse °C\n0,1.5\n1,2.5\n" * 1
    raw = opened(tmp_path, content.encode(encoding), [Source("y", "Düse °C", "degC")])
    assert raw.signals["y"][1].tolist() == [1.5, 2.5]


def test_a_table_without_header_or_time_is_read_by_column_and_interval(tmp_path):
    raw = opened(
        tmp_path,
        "  1.0e+00\t  4.5\t\n  2.0e+00\t  5.5\t\n",
        [Source("y", "column_2", "1")],
        name="dryer.dat",
        time="every 0.08 s",
    )
    np.testing.assert_allclose(raw.signals["y"][0], [0, 0.08], rtol=0)
    assert raw.signals["y"][1].tolist() == [4.5, 5.5]
    assert [note.kind for note in raw.notes] == ["header"]


def test_missing_values_are_nan_and_counted_with_the_first_place(tmp_path):
    raw = opened(tmp_path, "t,u,y\n0,1,2\n1,,3\n2,NaN,4\n3,n/a,5\n4,inf,6\n5,2,7\n6,3,8\n7,4,8\n8,5,8\n")
    np.testing.assert_array_equal(raw.signals["u"][1], [1, np.nan, np.nan, np.nan, np.nan, 2, 3, 4, 5])
    message = "4 of 9 values of u are missing (1 of them infinite), the first in line 3; they are masked"
    assert [(note.kind, note.signal, note.count, note.message) for note in raw.notes] == [
        ("missing", "u", 4, message)
    ]


@pytest.mark.parametrize("header", ["t,u,y", "t_x,u,y"])
def test_the_first_rows_count_where_most_rows_end_with_an_empty_field(tmp_path, header):
    raw = opened(tmp_path, f"{header}\n0,1,2\n1,2,4\n2,3,\n3,4,\n4,5,\n5,6,\n", time=header[: -len(",u,y")])
    assert raw.signals["u"][1].tolist() == [1, 2, 3, 4, 5, 6]


def test_a_column_that_is_filled_now_and_then_has_its_own_clock(tmp_path):
    rows = "".join(f"{k},{k if k % 5 == 0 else ''},{k}\n" for k in range(20))
    raw = opened(tmp_path, "t,u,y\n" + rows)
    assert raw.signals["u"][0].tolist() == [0, 5, 10, 15]
    assert [(note.kind, note.signal, note.count) for note in raw.notes] == [("sparse", "u", 16)]


def test_what_is_passed_over_or_taken_for_granted_is_noted_with_its_place(tmp_path):
    def notes(content: str) -> list[tuple[str, int, str]]:
        return [(note.kind, note.count, note.message) for note in opened(tmp_path, content).notes]

    assert notes("t,u,y\n0,1,2\nt,u,y\n1,2,3\n") == [
        ("header", 1, "the header is repeated 1 times, first in line 3")
    ]
    tail = "2 lines behind the data were left out, from line 4 on, which is 'Total,,'"
    assert notes("t,u,y\n0,1,2\n1,2,3\nTotal,,\nMax,2,3\n") == [("trailing", 2, tail)]
    midnight = "the time of day runs over midnight 1 times: a day was added each time"
    assert notes("time,u,y\n23:59:59,1,2\n00:00:00,2,3\n") == [("clock", 1, midnight)]
    newest = ("clock", 2, "the newest sample stands first: the rows were read from the last to the first")
    assert notes("t,u,y\n1,2,3\n0,1,2\n") == [newest]
    switch = ("words", 1, "u is written as OFF and ON, which were read as 1 and 0")
    assert notes("t,u,y\n0,OFF,2\n1,ON,3\n") == [switch]
    serial = "column Date holds 45982.542 to 45982.542 and was taken as days, as spreadsheets count them"
    assert notes("Date,u,y\n45982.541666667,1,2\n45982.541678241,2,3\n")[0] == ("clock", 1, serial)
    assert notes("time,u,y\n2025-11-21T13:00:00,1,2\n")[0][2].endswith(
        "13:00:00 (of no zone, as the recording's clock says)"
    )


def test_an_epoch_of_another_program_counts_to_its_own_year(tmp_path):
    def calendar(stamps: str, name: str = "timestamp") -> str:
        rows = "".join(f"{stamp},1,2\n" for stamp in stamps.split())
        return opened(tmp_path, f"{name},u,y\n{rows}").notes[-1].message[len("time is counted from ") :][:19]

    for stamps in (
        "1763730000000 1763730001000",
        "1763730000000000 1763730001000000",
        "1763730000000000000 1763730001000000000",
        "134082036000000000 134082036010000000",  # Windows: 100 ns since 1601
        "45982.541666667 45982.541678241",  # spreadsheets: days since 1899-12-30
        "739942.541666667 739942.541678241",  # MATLAB: days since the year 0
    ):
        assert calendar(stamps) == "2025-11-21T13:00:00"


@pytest.mark.parametrize("rate", [1, 50, 100, 500, 1000, 2000, 5000, 10_000])
def test_seconds_since_a_machine_was_switched_on_are_no_days(tmp_path, rate):
    """45,000 s are half a day of work, and as days they are the year 2023."""
    raw = opened(tmp_path, "t,u,y\n" + "".join(f"{45000 + k / rate:.6f},1,2\n" for k in range(100)))
    assert raw.notes == []
    np.testing.assert_allclose(raw.signals["u"][0], 45000 + np.arange(100) / rate, rtol=0, atol=1e-9)


def test_words_of_a_historian_for_no_value_are_missing_and_counted(tmp_path):
    raw = opened(tmp_path, "t,u,y\n0,1,2\n1,Bad,3\n2,No Data,3\n3,#REF!,3\n4,2,3\n5,2,3\n6,2,3\n")
    np.testing.assert_array_equal(raw.signals["u"][1], [1, np.nan, np.nan, np.nan, 2, 2, 2])
    assert [(note.kind, note.count) for note in raw.notes] == [("missing", 3)]


def test_a_last_line_that_breaks_off_is_left_out_and_noted(tmp_path):
    raw = opened(tmp_path, "t,u,y\n0,1,2\n1,2,3\n2,3")
    assert raw.signals["u"][1].tolist() == [1, 2]
    assert [note.message for note in raw.notes] == [
        "line 4, the last, breaks off after 2 of 3 fields and was left out"
    ]


def test_zeros_after_a_power_failure_are_left_out_and_noted(tmp_path):
    raw = opened(tmp_path, b"t,u,y\n0,1,2\n1,2,3\n" + bytes(500))
    assert raw.signals["u"][1].tolist() == [1, 2]
    assert [note.kind for note in raw.notes] == ["truncated"]


# ---- refusals: file, place, expected, found, remedy


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (
            "t,u,y\n0,1,2\n2,1,2\n1,1,2\n",
            "line 4 is at 1 s, which is before the sample ahead of it at 2 s, "
            "but time should only run forward; split",
        ),
        (
            "t,u,y\n0,1,2\n1,1,2\n1,1,3\n2,1,2\n2,1,3\n",
            "line 4 has the same time as the sample before it, 1 s, the first of 2, but time",
        ),
        (
            "t,u,y\n0,1,2\n,1,2\n2,1,2\n",
            "line 3 should have a time in t but has none; mend or remove that line",
        ),
        (
            "t,u,y\n0,1,2\nTotal,1,2\n2,1,2\n",
            "line 3 should have a time in t but has 'Total'; mend or remove that line",
        ),
        (
            "t,u,y\n0,1,2\n1,warm,2\n",
            "line 3, column u should be a number but is 'warm'; mend that line, or leave the field empty",
        ),
        (
            "t,u,y\n0,1,2\n1,1\n2,1,2\n",
            "line 3 has 2 fields but the header has 3 columns; mend or remove that line",
        ),
        (
            "t,u,y\n0,1,2\n1,1,2\nt,u,y\n0,1,2\n",
            "line 5 is at 0 s, which is before the sample ahead of it at 1 s",
        ),
        (
            "t,u,y\n0,1,2\n1,20 %,2\n",
            "line 3, column u should be a number but is '20 %'; write the numbers without their unit",
        ),
        (
            "t;u;y\n0;1234,5;2\n1;1.234,5;2\n",
            "line 3, column u should be a number but is '1.234,5'; "
            "write the numbers without marks between thousands",
        ),
        (
            "t;u;y\n0;1,5;2\n1;1.234;2\n2;2,5;2\n",
            "line 3, column u should be a number but is '1.234'; it may be 1.234 or 1234: "
            "declare ingest.decimal, or write the numbers without marks between thousands",
        ),
        (
            "t;u;y\n0;1,500;2\n1;1,250;2\n",
            "line 2, column u: 1,500 may be 1.500 or 1500, as every fraction in the file has three digits; "
            'declare ingest.decimal: "," for 1.500, or "." for 1500',
        ),
        ("t\tu\ty\n0\t1.500\t2\n1\t1.250\t2\n", "1.500 may be 1.500 or 1500, as every fraction"),
        ('t,u,y\n0,"1,500",2\n1,"1,250",2\n', "it may be 1.500 or 1500: declare ingest.decimal"),
        (
            "t,u,y\n" + "".join(f"{k + 100 * (k % 2)},1,2\n" for k in range(40)),
            "the first of 19, but time should only run forward; two devices with clocks of their own seem to "
            "write under one name",
        ),
        (
            "t,u,y\n0,,2\n1,,2\n",
            "u should hold numbers for u but all of its 2 values are missing; map another source",
        ),
        ("t,u,z\n0,1,2\n", "there is no column 'y'; it has t, u, z"),
        ("t,u,yy\n0,1,2\n", "there is no column 'y'; the nearest names are yy"),
        ("t,u,y,y\n0,1,2,3\n", "2 columns are called 'y'; give each a name of its own"),
        (
            "a,u,y\n0,1,2\n1,1,2\n",
            "no column is called like a time (t_s, time, timestamp, ...) among a, u, y; name it, "
            "or write time: every 1.0 s",
        ),
        (
            "time,u,y\n05/03/2025 13:00,1,2\n06/03/2025 13:00,1,2\n",
            "line 2, time time should be seconds or ISO 8601 such as 2025-11-21T13:00:00.5 but is "
            "'05/03/2025 13:00' (day or month first: 2025-03-05 or 2025-05-03?)",
        ),
        ("t,u,y\n", "the file has a header and no data"),
        ("t,u,y\n0,7\n8,1.5\n0,\n", "no row behind line 1 has a time and the 3 fields of the header"),
        ("name,owner\n" + "rig,bob\n" * 20, "the file has 21 lines of text and no data"),
        ("a word, and 3 more.\nThen nothing\n7 dwarfs,\n\nthe end of 1 tale\n" * 9, "is text but no table"),
        ('{"t": 0, "u": 1}\n', "is JSON but should be MCAP, Parquet or CSV"),
        (
            b"\x89PNG\r\n\x1a\n" + bytes(100),
            "is a PNG picture but should be MCAP, Parquet or CSV; name the recording",
        ),
        ("\n\n# nothing\n", "the file has only blank or comment lines and no data"),
        ("", "is empty (0 bytes) but should be MCAP, Parquet or CSV; copy the recording again"),
        (bytes(3000), "begins with 512 zero bytes"),
        (
            gzip.compress(b"t,u,y\n0,1,2\n", mtime=0),
            "is gzip but should be MCAP, Parquet or CSV; unpack it with gunzip",
        ),
        (b"PK\x03\x04 and so on", "is a zip file"),
        (
            b"#ROSBAG V2.0\n",
            "is a ROS 1 bag but should be MCAP, Parquet or CSV; convert it with: mcap convert",
        ),
        (b"t,u,y\n0,1,2\n" + bytes(500) + b"1,2,3\n", "are neither text nor Parquet nor MCAP"),
        (np.random.default_rng(0).bytes(5000), "recording.csv"),
    ],
)
def test_bad_tables_are_refused_with_the_place_and_the_remedy(tmp_path, content, sentence):
    assert sentence in refusal(tmp_path, content)


HEADERS = {"with a time": "t,u,y", "without": "index,u,y"}


def short_table(header: str, rows: int, place: int, more: str) -> tuple[str, list[str]]:
    """A table of so many rows, of which the one at `place` (from 1) has a field more or, if `more` is empty,
    less; and its names."""
    lines = [f"{k},{k + 0.5},{k + 20}" for k in range(rows)]
    lines[place - 1] = f"{lines[place - 1]}{more}" if more else lines[place - 1].rpartition(",")[0]
    return "\n".join([header, *lines]) + "\n", header.split(",")


@pytest.mark.parametrize("header", HEADERS)
@pytest.mark.parametrize(("rows", "more"), [(2, ",7"), (3, ",7"), (30, ",7"), (2, ""), (3, ""), (30, "")])
def test_a_last_row_that_is_too_wide_or_too_narrow_is_left_out_and_keeps_the_names(
    tmp_path, header, rows, more
):
    content, names = short_table(HEADERS[header], rows, rows, more)
    path = tmp_path / "log.csv"
    path.write_text(content)
    layout = csv_layout(path)
    assert (layout.names, layout.skip) == (names, 1)
    columns, notes = read_csv(path, names[1:], "" if header == "with a time" else "every 1 s")
    assert columns.values["y"].tolist() == [20.0 + k for k in range(rows - 1)]
    sentence = (
        f"line {rows + 1} has 4 fields but the header has 3 columns; it is the last and was left out"
        if more
        else f"line {rows + 1}, the last, breaks off after 2 of 3 fields and was left out"
    )
    assert [note.message for note in notes] == [sentence]


@pytest.mark.parametrize("header", HEADERS)
@pytest.mark.parametrize("more", [",7", ""], ids=["wider", "narrower"])
@pytest.mark.parametrize(("rows", "place"), [(2, 1), (3, 1), (3, 2), (30, 1), (30, 15)])
def test_another_row_of_another_width_is_refused_with_its_line(tmp_path, header, rows, place, more):
    content, names = short_table(HEADERS[header], rows, place, more)
    path = tmp_path / "log.csv"
    path.write_text(content)
    sentence = f"line {place + 1} has {4 if more else 2} fields but the header has 3 columns; mend or remove"
    with pytest.raises(ValueError, match=sentence):
        read_csv(path, names[1:], "" if header == "with a time" else "every 1 s")


@pytest.mark.parametrize("more", [",7", ""], ids=["wider", "narrower"])
def test_a_single_row_of_another_width_is_refused_with_its_line(tmp_path, more):
    found = refusal(tmp_path, short_table("t,u,y", 1, 1, more)[0])
    assert f"(line 2 has {4 if more else 2} fields but the header has 3 columns); mend the rows" in found


@pytest.mark.parametrize(
    ("above", "names"),
    [
        ("", ["column_1", "column_2", "column_3"]),
        ("Logger X1\nrun 7, noon\n\n", ["column_1", "column_2", "column_3"]),
        ("u,y\n", ["column_1", "column_2", "column_3"]),  # as R writes names: none above the rows' own
    ],
    ids=["no header", "a preamble", "a name less than columns"],
)
def test_rows_without_names_above_them_are_named_by_their_places(tmp_path, above, names):
    path = tmp_path / "log.csv"
    path.write_text(above + "0,1,2\n1,2,3\n2,3,4\n")
    assert csv_layout(path).names == names
    assert read_csv(path, ["column_3"], "every 1 s")[0].values["column_3"].tolist() == [2, 3, 4]


def test_one_row_is_a_record_of_one_sample(tmp_path):
    assert opened(tmp_path, "t,u,y\n0,1,2\n").signals["y"][1].tolist() == [2]


def test_what_a_file_holds_counts_and_not_what_its_name_ends_in(tmp_path):
    pq.write_table(pa.table({"t": [0.0, 1.0], "u": [1, 2], "y": [3.0, None]}), tmp_path / "wrong.csv")
    np.testing.assert_array_equal(read(tmp_path / "wrong.csv", SOURCES).signals["y"][1], [3, np.nan])
    assert "begin no mcap file; copy the recording again as binary" in refusal(
        tmp_path, "t,u,y\n0,1,2\n", name="text.mcap"
    )


def test_a_folder_and_a_missing_file_are_refused(tmp_path):
    with pytest.raises(ValueError, match="is a folder but should be one recording"):
        read(tmp_path, SOURCES)
    with pytest.raises(ValueError, match=r"none\.csv is missing"):
        read(tmp_path / "none.csv", SOURCES)


def test_mappings_that_make_no_sense_are_refused(tmp_path):
    for sources, sentence in (
        ([], "the mapping names no signal"),
        ([SOURCES[0], SOURCES[0]], "gives u more than one source"),
        ([Source("u", "u", "percent", 0.0)], "has scale 0 and offset 0; both must be finite, scale not 0"),
    ):
        assert sentence in refusal(tmp_path, "t,u,y\n0,1,2\n", sources)


# ---- Parquet


def test_parquet_with_structures_time_stamps_nulls_and_decimals_is_read(tmp_path):
    start = datetime.datetime(2025, 1, 1, tzinfo=datetime.UTC)
    columns = {
        "when": pa.array(
            [start + datetime.timedelta(seconds=k) for k in range(3)], pa.timestamp("us", "UTC")
        ),
        "zone": pa.array([{"y": 1.5, "name": "a"}, None, {"y": 2.5, "name": "b"}]),
        "u.dotted": pa.array([1, 2, 3]),
    }
    pq.write_table(pa.table(columns), tmp_path / "a.parquet")
    raw = read(tmp_path / "a.parquet", [Source("y", "zone.y", "degC"), Source("u", "u.dotted", "1")])
    assert raw.signals["u"][0].tolist() == [0, 1, 2]
    assert raw.signals["u"][1].tolist() == [1, 2, 3]
    np.testing.assert_array_equal(raw.signals["y"][1], [1.5, np.nan, 2.5])
    assert [note.kind for note in raw.notes] == ["clock", "missing"]
    with pytest.raises(ValueError, match="column zone.name should hold numbers but is of type string"):
        read(tmp_path / "a.parquet", [Source("y", "zone.name", "1")])


def test_parquet_damaged_or_truncated_or_empty_is_refused(tmp_path):
    rng = np.random.default_rng(0)
    table = pa.table({"t": np.arange(5000.0), "u": rng.normal(size=5000), "y": rng.normal(size=5000)})
    pq.write_table(table, tmp_path / "a.parquet", write_page_checksum=True)
    content = (tmp_path / "a.parquet").read_bytes()
    for end in (4, 100, len(content) // 2, len(content) - 1):
        assert "is not a whole Parquet file" in refusal(tmp_path, content[:end], name="cut.parquet")
    changed = bytearray(content)
    changed[len(content) // 2] ^= 4
    assert "the file is damaged" in refusal(tmp_path, bytes(changed), name="damaged.parquet")
    pq.write_table(table.slice(0, 0), tmp_path / "empty.parquet")
    with pytest.raises(ValueError, match="the table should have rows but has none"):
        read(tmp_path / "empty.parquet", SOURCES)


# ---- clocks


def test_a_clock_of_the_calendar_counts_from_the_first_second_to_the_nanosecond(tmp_path):
    made = Written()
    fast, slow = (made.topic(name, "json") for name in ("/fast", "/slow"))
    start = 1_763_730_000_000_000_000
    for k in range(5):
        made.writer.add_message(fast, start + 250_000_001 + k * 10**9, b'{"u": 1}', 0)
        made.writer.add_message(slow, start + 500_000_000 + k * 10**9, b'{"y": 1}', 0)
    raw = opened(tmp_path, made.bytes(), name="epoch.mcap")
    assert raw.signals["u"][0].tolist() == [k + 0.250000001 for k in range(5)]
    assert raw.signals["y"][0].tolist() == [k + 0.5 for k in range(5)]
    assert [note.message for note in raw.notes] == [
        "time is counted from 2025-11-21T13:00:00 (UTC, as the recording's clock says)"
    ]


@pytest.mark.parametrize(
    ("step", "sentence"),
    [
        (-1.0, "is at 3 s, which is before the sample ahead of it at 4 s"),
        (0.0, "has the same time as the sample before it, 4 s"),
    ],
)
def test_mcap_whose_clock_does_not_run_forward_is_refused_with_the_message(tmp_path, step, sentence):
    made = Written()
    channel = made.topic("/machine", "json")
    for k in range(5):
        made.message(channel, k, {"u": k, "y": k})
    made.message(channel, 4 + step, {"u": 0, "y": 0})
    assert f"message 6 of /machine {sentence}" in refusal(tmp_path, made.bytes(), name="back.mcap")


# ---- names, and real records


def test_nearest_names_look_at_the_field_behind_a_topic_too():
    names = ["/zone:degC", "/zone:duty", "heater_1", "Temperature 1 (degC)"]
    assert nearest_names("dutty", names) == "the nearest names are /zone:duty"
    assert nearest_names("heater1", names) == "the nearest names are heater_1"
    assert nearest_names("xyz", names).startswith("it has /zone:degC, /zone:duty")


def test_the_two_heater_kit_is_read_as_it_was_recorded(shared):
    path = shared("data/tclab_mlid_prbs/prbs.csv")
    raw = read(path, [Source("heater_1", "Q1_pct", "percent"), Source("temperature_1", "T1_C", "degC")])
    assert raw.messages == {"rows": 5100}
    assert raw.notes == []
    assert raw.signals["temperature_1"][1][1789] == 40.718


def test_recordings_of_others_are_read_by_topic_and_field(shared):
    raw = read(shared("data/mcap_ros2/talker.mcap"), [Source("line", "line", "1")], time="stamp")
    assert raw.signals["line"][1].tolist() == [38] * 10
    # the talker publishes twice a second
    np.testing.assert_allclose(np.diff(raw.signals["line"][0]), 0.5, atol=0.01)
    raw = read(
        shared("data/mcap_ros2/custom-camera-model.mcap"), [Source("focal", "/camera_calibration:K[0]", "px")]
    )
    assert raw.signals["focal"][1].tolist() == [800] * 10
    with pytest.raises(ValueError, match="no topic with numbers could be read"):
        read(shared("data/mcap_ros2/wbag_0.mcap"), [Source("y", "data", "1")])


@pytest.mark.parametrize(("written", "order"), [("%d/%m/%Y %H:%M:%S", "day"), ("%m/%d/%Y %H:%M:%S", "month")])
@pytest.mark.parametrize("rows", [2000, 40])
def test_of_two_orders_of_day_and_month_the_one_is_read_in_which_the_clock_is_steady(
    tmp_path, written, order, rows
):
    """A night's recording, 5 to 6 March: the other order has a month between two rows."""
    start = datetime.datetime(2025, 3, 6) - datetime.timedelta(seconds=30 * (rows // 2))
    stamps = [start + datetime.timedelta(seconds=30 * k) for k in range(rows)]
    lines = [f"{stamp.strftime(written)},{k % 3},{20 + k % 7}\n" for k, stamp in enumerate(stamps)]
    (tmp_path / "a.csv").write_text("time,u,y\n" + "".join(lines))
    raw = read(tmp_path / "a.csv", SOURCES)
    np.testing.assert_array_equal(np.diff(raw.signals["y"][0]), 30.0)
    assert f"were read with the {order} first" in raw.notes[0].message


def test_two_orders_of_day_and_month_are_refused_where_a_pause_hides_which_is_meant(tmp_path):
    days = [(5, hour) for hour in range(9, 17)] + [(6, hour) for hour in range(9, 17)]
    lines = [f"{day:02d}/03/2025 {hour:02d}:00,1,{20 + hour}\n" for day, hour in days]
    (tmp_path / "a.csv").write_text("time,u,y\n" + "".join(lines))
    with pytest.raises(ValueError, match=r"\(day or month first: 2025-03-05 or 2025-05-03\?\)"):
        read(tmp_path / "a.csv", SOURCES)


@pytest.mark.parametrize("delimiter", [",", ";"])
def test_a_table_whose_names_are_longer_than_the_opening_is_read(tmp_path, delimiter):
    """Names of 80 kB; the layout was sought in the first 64 kB."""
    names = ["t", *(f"zone_{j:05d}_temperature_C" for j in range(3500))]
    rows = [delimiter.join([str(k), *(f"{20 + j % 7}.5" for j in range(3500))]) for k in range(6)]
    (tmp_path / "a.csv").write_text("\n".join([delimiter.join(names), *rows]) + "\n")
    raw = read(tmp_path / "a.csv", [Source("y", names[3500], "degC")])
    np.testing.assert_array_equal(raw.signals["y"][1], 20.5 + 3499 % 7)
    assert "3501 columns, 3501 of them numbers" in inspect(tmp_path / "a.csv")


def test_a_first_line_without_end_is_refused_in_a_sentence(tmp_path):
    (tmp_path / "a.csv").write_bytes(b"1," * (1 << 21))
    with pytest.raises(ValueError, match="its first line has more than 2097152 bytes"):
        read(tmp_path / "a.csv", SOURCES)


@pytest.mark.parametrize("blank", [1, 10, 90, 300])
def test_the_first_rows_count_if_they_alone_end_with_an_empty_field(tmp_path, blank):
    """A set-point that is written from the first change on."""
    rows = ["time_s,heater,zone,Soll"]
    rows += [f"{t},20,{40 + t / 10},{'' if t < blank else 41}" for t in range(600)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(rows))
    raw = read(path, [Source("zone", "zone", "degC"), Source("soll", "Soll", "degC")])
    assert [len(time_s) for time_s, _ in raw.signals.values()] == [600, 600]
    assert np.isnan(raw.signals["soll"][1][:blank]).all()
    assert [(note.kind, note.count) for note in raw.notes] == [("missing", blank)]
