from pathlib import Path

import numpy as np
import pytest

from pipeline.recordings.clocks import repair
from pipeline.recordings.formats import FileColumns
from pipeline.recordings.recordings import Source, read, resample
from tests.mcap_writing import Written

SOURCES = [Source("u", "u", "percent"), Source("y", "y", "degC")]


def opened(tmp_path, times, u=None, y=None, name: str = "t"):
    """A recording with these times; u counts the rows as they stand in the file, y is smooth."""
    count = len(times)
    u = np.arange(count) if u is None else u
    y = 20 + 5 * np.sin(np.arange(count) / 30) if y is None else y
    rows = "".join(f"{at},{a!r},{b!r}\n" for at, a, b in zip(times, u.tolist(), y.tolist(), strict=True))
    (tmp_path / "a.csv").write_text(f"{name},u,y\n{rows}")
    return read(tmp_path / "a.csv", SOURCES)


def segments(raw) -> list[float]:
    table = resample(raw, sample_time_s=1.0, inputs=["u"], outputs=["y"])
    starts = np.flatnonzero(np.r_[True, np.diff(table.segment) > 0])
    return table.values["u"][starts].tolist()


@pytest.mark.parametrize("late", [1, 3, 7])
def test_a_row_that_came_late_is_sorted_back_and_counted(tmp_path, late):
    order = np.arange(200)
    order[50 : 51 + late] = np.roll(order[50 : 51 + late], -1)  # row 50 stands behind `late` others
    raw = opened(tmp_path, np.arange(200.0)[order], u=order, y=np.sin(order / 9))
    np.testing.assert_array_equal(raw.signals["u"][0], np.arange(200.0))
    np.testing.assert_array_equal(raw.signals["u"][1], np.arange(200))
    message = f"1 rows came late and were sorted back, the first in line {52 + late}"
    assert [(note.kind, note.count, note.message) for note in raw.notes] == [("sorted", 1, message)]


def test_exact_repeats_are_dropped_and_counted_however_many_they_are(tmp_path):
    raw = opened(tmp_path, np.repeat(np.arange(50.0), 2), u=np.repeat(np.arange(50), 2), y=np.zeros(100))
    np.testing.assert_array_equal(raw.signals["u"][0], np.arange(50.0))
    np.testing.assert_array_equal(raw.signals["u"][1], np.arange(50))
    assert [(note.kind, note.count) for note in raw.notes] == [("repeated", 50)]
    assert "the first in line 3" in raw.notes[0].message


def test_one_time_stamp_that_two_rows_have_costs_one_row(tmp_path):
    times = np.arange(100.0)
    times[40] = 39
    raw = opened(tmp_path, times)
    np.testing.assert_array_equal(raw.signals["u"][1], np.delete(np.arange(100), 40))
    message = "1 rows have the time of the row before and other values: the first of each stays"
    assert [note.message for note in raw.notes] == [f"{message}, the first in line 42"]


@pytest.mark.parametrize("count", [2, 5])
@pytest.mark.parametrize("calendar", [False, True])
def test_stamps_of_whole_seconds_with_several_rows_each_are_spread(tmp_path, count, calendar):
    rng = np.random.default_rng(0)
    truth = 0.2 + np.arange(300) / count  # the first second has begun
    stamps = np.floor(truth).astype(int)
    shown = [f"2025-11-21 13:{k // 60:02d}:{k % 60:02d}" for k in stamps] if calendar else stamps
    raw = opened(tmp_path, shown, y=np.cumsum(rng.normal(size=300)))
    # a stamp tells the time to a second; of its rows it is known to one interval
    np.testing.assert_allclose(raw.signals["y"][0], truth, rtol=0, atol=1 / count)
    np.testing.assert_allclose(np.diff(raw.signals["y"][0]), 1 / count, rtol=1e-6)
    assert raw.notes[-1 if not calendar else 0].kind == "spread"


def test_two_devices_that_share_each_stamp_are_not_spread(tmp_path):
    rng = np.random.default_rng(0)
    y = np.tile([20.0, 60.0], 100) + rng.normal(size=200)
    with pytest.raises(ValueError, match="has the same time as the sample before it"):
        opened(tmp_path, np.repeat(np.arange(100), 2), y=y)


def test_a_clock_that_starts_over_29_times_is_30_segments(tmp_path):
    raw = opened(tmp_path, np.tile(np.arange(40.0), 30))
    assert segments(raw) == [40.0 * k for k in range(30)]
    message = "the clock starts over 29 times: segments begin there, the first in line 42"
    assert [(note.kind, note.count, note.message) for note in raw.notes] == [("restart", 29, message)]
    assert len(raw.signals["y"][0]) == 1200


def test_a_clock_that_is_set_back_begins_a_segment_and_a_command_is_not_held_across(tmp_path):
    rows = [f"{k},{7 if k == 3 else ''},{k}" for k in range(30)] + [
        f"{k},{9 if k == 5 else ''},{k}" for k in range(30)
    ]
    (tmp_path / "a.csv").write_text("t,u,y\n" + "\n".join(rows) + "\n")
    table = resample(read(tmp_path / "a.csv", SOURCES), sample_time_s=1.0, inputs=["u"], outputs=["y"])
    assert table.segment.tolist() == [0] * 27 + [1] * 25
    assert table.values["u"].tolist() == [7.0] * 27 + [9.0] * 25
    assert table.values["y"].tolist() == [*range(3, 30), *range(5, 30)]


def test_the_hour_that_summer_time_repeats_is_counted_on_without_a_zone(tmp_path):
    times = [f"2025-10-26 {h}:{m:02d}:00" for h in ("01", "02", "02", "03") for m in range(60)]
    raw = opened(tmp_path, times, name="time")
    np.testing.assert_array_equal(np.diff(raw.signals["u"][0]), 60.0)
    assert [note.message for note in raw.notes][0] == (
        "an hour is repeated, as where summer time ends, and was counted on, the first in line 122"
    )


def test_one_row_with_a_time_from_long_ago_is_refused_with_its_line(tmp_path):
    times = np.arange(600.0)
    times[300] = 20.5
    with pytest.raises(
        ValueError, match="line 302 is at 20.5 s, which is before the sample ahead of it at 299 s"
    ):
        opened(tmp_path, times)


def test_a_clock_that_starts_over_soon_is_no_late_row(tmp_path):
    assert segments(opened(tmp_path, np.r_[np.arange(4.0), np.arange(100.0)])) == [0, 4]


def test_two_clocks_that_take_turns_are_refused(tmp_path):
    with pytest.raises(ValueError, match="two devices with clocks of their own seem to write under one name"):
        opened(tmp_path, np.arange(40) + 100.0 * (np.arange(40) % 2))


def test_many_rows_with_the_time_of_another_are_refused(tmp_path):
    times = np.arange(100.0) + 0.5
    times[10:40:5] -= 1
    with pytest.raises(ValueError, match="has the same time as the sample before it, 9.5 s, the first of 6"):
        opened(tmp_path, times)


def test_a_clock_that_falls_by_more_than_half_of_all_counts_is_refused_in_one_sentence():
    time = np.array([2**63 - 2, 2**63 - 1, -(2**63), 1 - 2**63])
    group = FileColumns("/zone", time, {"T": np.arange(4.0)}, lambda i: f"message {i + 1}")
    with pytest.raises(ValueError, match="message 3 is at .* which is before the sample ahead of it"):
        repair(Path("rig.mcap"), group, may_restart=False)


# ---- MCAP: the recorder's clock, or one that each message carries

STARTS = (0, 12)


EVERY, EVENTS = range(60), (0, 5, 7, 20, 33)


def printed_twice(tmp_path, *, time="", commands=EVERY, motor_late=0):
    """/zone and /motor for 60 s and 40 s, and in between the clock starts over; /motor at `commands`."""
    made = Written()
    zone, motor = made.topic("/zone", "json"), made.topic("/motor", "json")
    logged = 0
    for start, count in zip(STARTS, (60, 40), strict=True):
        for k in range(start, start + count):
            log = k if not time else logged
            made.message(zone, log, {"stamp": k, "y": float(k)})
            if k - start in commands:
                made.message(motor, log, {"stamp": k + motor_late * (start > 0), "u": float(k)})
            logged += 1
    path = tmp_path / "print.mcap"
    path.write_bytes(made.bytes())
    return read(path, [Source("y", "/zone:y", "degC"), Source("u", "/motor:u", "percent")], time=time)


@pytest.mark.parametrize("commands", [EVERY, EVENTS])
def test_a_recorder_s_clock_that_starts_over_begins_a_segment_of_every_topic(tmp_path, commands):
    raw = printed_twice(tmp_path, commands=commands)
    table = resample(raw, sample_time_s=1.0, inputs=["u"], outputs=["y"])
    assert np.flatnonzero(np.diff(table.segment)).tolist() == [59]
    np.testing.assert_array_equal(table.values["y"], [*range(60), *range(12, 52)])
    start = np.where(table.segment == 0, *STARTS)
    last = [max(k for k in commands if k <= since) for since in table.values["y"] - start]
    np.testing.assert_array_equal(table.values["u"], start + last)
    assert [note.kind for note in raw.notes].count("restart") == 2


def test_where_one_topic_does_not_show_that_the_clock_started_over_the_recording_is_refused(tmp_path):
    with pytest.raises(ValueError, match="message 61 of /zone is at 12 s"):
        printed_twice(tmp_path, commands=(0,))


def test_stamps_of_two_topics_that_start_over_together_are_one_clock(tmp_path):
    raw = printed_twice(tmp_path, time="stamp")
    assert len(raw.breaks) == 1
    np.testing.assert_array_equal(raw.signals["y"][0], raw.signals["u"][0])


def test_stamps_that_start_over_at_other_times_are_of_two_clocks_and_refused(tmp_path):
    with pytest.raises(ValueError, match="which is before the sample ahead of it"):
        printed_twice(tmp_path, time="stamp", motor_late=-8)
