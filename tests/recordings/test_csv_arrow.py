"""The fast way of reading text gives what the slow way gives, to the last bit, and leaves it all else."""

import contextlib
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.recordings import csv_files
from pipeline.recordings.csv_files import read_csv


def outcome(path, *, slow: bool, time: str = "", wanted=("u", "y")):
    """Bytes of times and values, places of the first and last row, zone and notes; or the refusal."""
    without = (
        mock.patch.object(csv_files, "read_plain", lambda *_: None) if slow else contextlib.nullcontext()
    )
    try:
        with without:
            columns, notes = read_csv(path, wanted, time)
    except ValueError as refusal:
        return str(refusal)
    last = len(columns.time) - 1
    values = [columns.values[name].tobytes() for name in wanted]
    return columns.time.tobytes(), values, columns.place(0), columns.place(last), columns.zone, notes


def is_fast(path, time: str = "", wanted=("u", "y")) -> bool:
    read = []

    def watched(*arguments):
        read.append(csv_files_read_plain(*arguments))
        return read[-1]

    csv_files_read_plain = csv_files.read_plain
    with mock.patch.object(csv_files, "read_plain", watched):
        read_csv(path, wanted, time)
    return bool(read) and read[0] is not None


NUMBERS = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False).map(repr),
    st.integers(-(10**20), 10**20).map(str),
    st.decimals(allow_nan=False, allow_infinity=False, places=25).map(str),
    st.sampled_from(
        "1. .5 +3 -0 1e400 1e-400 1E5 0x1F 1_0 nan NaN -nan nan(x) inf -Infinity 1,000 1.000 1'000 1d3 1e n/a"
        " NULL Bad ON off - -- 00012 4.9e-324 2.2250738585072011e-308 9007199254740993 0.1".split()
    ),
    st.sampled_from(["", " ", " 1.5", "2 ", "\t3", "#4", '"5"', '"6', "7\n8", "\u00a09", "\u0661", "\x0c1"]),
)
TIMES = st.one_of(
    st.integers(0, 10**6).map(str),
    st.datetimes().map(str),
    st.datetimes().map(lambda at: at.isoformat() + "Z"),
    st.datetimes().map(lambda at: at.isoformat(" ", "milliseconds") + "+05:30"),
    st.sampled_from(
        "2025-11-21 2025-11-21T13 2025-11-21T13:00 2025-11-21T24:00:00 20251121T130000"
        " 2025-11-21T13:00:00.123456789 2025-11-21T13:00:00.1234567891 2025-11-21T13:00:00-34"
        " 1500-01-01T00:00:00 2025-11-21T13:00:00+15:00 2025-11-21T13:00:00+14:30"
        " 2025-11-21T13:00:60Z 2025-11-21T13:00:00,5 # t".split()
    ),
)
LAYOUTS = st.tuples(
    st.sampled_from([",", ";", "\t"]),
    st.sampled_from(["\n", "\r\n", "\r"]),
    st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"]),
    st.sampled_from(["t,u,y", "# rig\n\nt,u,y", "t,u,y\ns,%,C", "t,u,y,", "note,t,u,y", "\u00b0,t,u,y"]),
)
# rows of one manner, among them a strange one now and then
TABLES = st.one_of(
    st.lists(st.tuples(TIMES, NUMBERS, NUMBERS), min_size=2, max_size=12),
    st.lists(st.tuples(st.integers(0, 99).map(str), NUMBERS, st.just("1.5")), min_size=2, max_size=12),
)


@settings(max_examples=400, deadline=None, derandomize=True)
@given(LAYOUTS, TABLES, st.booleans(), st.sampled_from([0, 0, 0, 1, 2, 3, 5, 8]))
def test_fast_and_slow_reading_agree_to_the_bit_and_in_every_refusal(
    tmp_path_factory, layout, table, ended, cut
):
    delimiter, end, encoding, header = layout
    path = tmp_path_factory.mktemp("csv") / "a.csv"
    first = ["a"] if header.split("\n")[0].count(",") == 3 and header[-1] != "," else []
    tail = [""] if header.endswith(",") else []
    lines = [line.replace(",", delimiter) for line in header.split("\n")]
    lines += [delimiter.join([*first, *row, *tail]) for row in table]
    text = end.join(lines) + (end if ended else "")
    text = text[: len(text) - cut]
    path.write_bytes(text.encode(encoding, errors="ignore"))
    assert outcome(path, slow=False) == outcome(path, slow=True)


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize("clock", ["{:.3f}", "2025-11-21T13:{:02d}:00", "2025-11-21 13:{:02d}:00.25Z"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_tables_of_plain_numbers_are_read_the_fast_way_with_correctly_rounded_values(
    tmp_path, delimiter, clock, encoding
):
    rng = np.random.default_rng(0)
    values = rng.normal(size=50) * 10.0 ** rng.integers(-300, 300, 50)
    lines = [delimiter.join(["Düse °C", "t", "u", "y"])]
    lines += [
        delimiter.join(
            ["a", clock.format(float(k) if "f" in clock else k), repr(float(value)), "" if k % 7 else "NaN"]
        )
        for k, value in enumerate(values)
    ]
    (tmp_path / "a.csv").write_bytes("\n".join(lines).encode(encoding))
    columns, _ = read_csv(tmp_path / "a.csv", ["u"], "")
    assert columns.values["u"].tobytes() == values.tobytes()
    assert is_fast(tmp_path / "a.csv", wanted=["u", "y"])
    assert outcome(tmp_path / "a.csv", slow=False) == outcome(tmp_path / "a.csv", slow=True)


@pytest.mark.parametrize(
    "fault", ["1.5,warm,2", "1.5,2", "1.5,2,3,4", "Total,1,2", '1.5,"2,3', "\0", "1.5,\xff,2"]
)
def test_a_fault_behind_many_blocks_is_named_with_its_line(tmp_path, fault):
    rows = [f"{k}.0,{k}.25,{k}.5" for k in range(120_000)]
    rows.insert(110_000, fault)
    (tmp_path / "a.csv").write_bytes(("t,u,y\n" + "\n".join(rows) + "\n").encode("latin-1"))
    refusal = outcome(tmp_path / "a.csv", slow=False)
    assert isinstance(refusal, str)
    assert "line 110002" in refusal or "byte 0xff is not utf-8" in refusal


def test_a_table_of_many_blocks_is_the_same_on_both_ways(tmp_path):
    rng = np.random.default_rng(1)
    values = rng.normal(size=(90_000, 2))
    rows = "".join(f"{k / 100},{u!r},{y!r}\n" for k, (u, y) in enumerate(values.tolist()))
    (tmp_path / "a.csv").write_text("t,u,y\n" + rows)
    assert is_fast(tmp_path / "a.csv")
    assert outcome(tmp_path / "a.csv", slow=False) == outcome(tmp_path / "a.csv", slow=True)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_a_last_line_that_breaks_off_is_left_out_on_the_fast_way_too(tmp_path, end):
    rows = [f"{k},{k}.25,{k}.5" for k in range(120_000)]
    (tmp_path / "a.csv").write_bytes(end.join(["t,u,y", *rows, "120000,1"]).encode())
    assert is_fast(tmp_path / "a.csv")
    assert outcome(tmp_path / "a.csv", slow=False) == outcome(tmp_path / "a.csv", slow=True)
    _, notes = read_csv(tmp_path / "a.csv", ["u"], "")
    assert [note.message for note in notes] == [
        "line 120002, the last, breaks off after 2 of 3 fields and was left out"
    ]
