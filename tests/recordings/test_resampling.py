import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.recordings.recordings import Raw, Source, Table, read, resample
from pipeline.recordings.resampling import hold


def recorded(**signals: tuple) -> Raw:
    return Raw(
        "rig.csv",
        {
            name: (np.asarray(time, float), np.asarray(values, float))
            for name, (time, values) in signals.items()
        },
        {},
        [],
    )


def table(raw: Raw, sample_time_s: float = 1.0, **options) -> Table:
    inputs = [name for name in raw.signals if name.startswith("u")]
    return resample(
        raw,
        sample_time_s=sample_time_s,
        inputs=inputs,
        outputs=[name for name in raw.signals if name.startswith("y")],
        **options,
    )


def kinds(resampled: Table) -> dict[str, int]:
    return {flag.kind: flag.count for flag in resampled.flags}


def test_a_record_on_the_grid_passes_unaltered_and_without_a_finding():
    rng = np.random.default_rng(0)
    time, u, y = 5 + 0.1 * np.arange(500), rng.normal(size=500), rng.normal(size=500)
    resampled = table(recorded(u=(time, u), y=(time, y)), 0.1)
    np.testing.assert_array_equal(resampled.values["u"], u)
    np.testing.assert_array_equal(resampled.values["y"], y)
    np.testing.assert_allclose(resampled.time_s, time, rtol=1e-15)
    assert resampled.flags == []
    assert not resampled.segment.any()
    assert not resampled.masked["u"].any()
    assert not resampled.masked["y"].any()


def test_outputs_follow_the_line_between_neighbours_and_inputs_hold():
    """By hand: y = 10 t on a jittered clock; u steps from 1 to 2 at 1.4 s."""
    time = np.array([0, 0.9, 1.4, 2.2, 3.0])
    resampled = table(recorded(u=(time, [1, 1, 2, 2, 2]), y=(time, 10 * time)))
    # a straight line is its own interpolation; floats round at 1e-16
    np.testing.assert_allclose(resampled.values["y"], [0, 10, 20, 30], rtol=1e-14)
    assert resampled.values["u"].tolist() == [1, 1, 2, 2]
    flags = {flag.kind: flag for flag in resampled.flags}
    assert (flags["step_inside"].signal, flags["step_inside"].start_s, flags["step_inside"].count) == (
        "u",
        1.4,
        1,
    )
    assert "0.6 s later on average" in flags["step_inside"].message
    assert flags["interpolated"].count == 2
    assert "filled" not in flags


@given(st.integers(0, 10_000), st.floats(0.3, 3.0))
def test_every_value_lies_between_its_neighbours_and_every_command_was_given(seed, sample_time_s):
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.5, 1.5, 60))
    raw = recorded(u=(time, rng.integers(0, 4, 60)), y=(time, rng.normal(size=60)))
    resampled = table(raw, sample_time_s)
    y = raw.signals["y"][1]
    # a sample within a hundredth of the sample time is on the grid: it is its own neighbour on both sides
    before = np.searchsorted(time, resampled.time_s + 0.01 * sample_time_s, side="right") - 1
    after = np.minimum(np.searchsorted(time, resampled.time_s - 0.01 * sample_time_s), 59)
    low, high = np.minimum(y[before], y[after]), np.maximum(y[before], y[after])
    assert (
        (resampled.values["y"] >= low - 1e-12) & (resampled.values["y"] <= high + 1e-12)
    ).all()  # the line rounds at 1e-16
    np.testing.assert_array_equal(resampled.values["u"], raw.signals["u"][1][before])


def test_nothing_is_interpolated_or_held_across_a_gap():
    time = np.r_[0:10, 20:30].astype(float)
    resampled = table(recorded(u=(time, time), y=(time, time)))
    assert resampled.segment.tolist() == [0] * 10 + [1] * 10
    np.testing.assert_array_equal(resampled.time_s, time)
    np.testing.assert_array_equal(resampled.values["y"], time)
    (gap,) = resampled.flags
    assert (gap.kind, gap.start_s, gap.end_s) == ("gap", 9, 20)
    # a limit beyond the hole makes it a stretch to fill, and says so
    filled = table(recorded(u=(time, time), y=(time, time)), max_gap_s=12.0)
    assert not filled.segment.any()
    assert kinds(filled)["filled"] == 10
    # the input holds its last command in the hole
    assert filled.values["u"][10:20].tolist() == [9] * 10


def test_two_missing_samples_are_no_gap_but_three_sample_times_and_more_are():
    time = np.r_[0:10, 12:20, 23.5:30].astype(float)
    resampled = table(recorded(y=(time, time)))
    assert resampled.segment[-1] == 1
    assert [(flag.start_s, flag.end_s) for flag in resampled.flags if flag.kind == "gap"] == [(19, 23.5)]


def test_missing_values_are_masked_with_what_is_interpolated_from_them():
    time = np.arange(6.0)
    on_grid = table(recorded(u=(time, [1, np.nan, 1, 1, 1, 1]), y=(time, [0, 1, np.nan, 3, 4, 5])))
    assert on_grid.masked["y"].tolist() == [False, False, True, False, False, False]
    assert on_grid.masked["u"].tolist() == [False, True, False, False, False, False]
    assert kinds(on_grid) == {"missing": 1}
    between = table(recorded(y=(time + [0, 0.5, 0.5, 0.5, 0.5, 0.5], [0, 1, np.nan, 3, 4, 5])))
    assert between.masked["y"].tolist() == [False, False, True, True, False, False]


def test_clocks_are_aligned_over_their_common_time():
    slow, fast = np.arange(0.0, 50), np.arange(3.05, 40, 0.1)
    resampled = table(recorded(u=(slow, slow), y=(fast, 2 * fast)))
    assert resampled.time_s[0] == pytest.approx(3.05)
    assert resampled.time_s[-1] <= fast[-1] + 1e-9
    np.testing.assert_allclose(resampled.values["y"], 2 * resampled.time_s, rtol=1e-12)
    np.testing.assert_array_equal(resampled.values["u"], np.floor(resampled.time_s))
    assert {"trimmed", "rate"} <= set(kinds(resampled))
    assert "2 clocks were aligned over their common time 3.05 to 39.95 s" in " ".join(
        flag.message for flag in resampled.flags
    )


def test_commands_that_come_as_events_are_held_however_long():
    time = np.arange(0.0, 1000)
    events = np.array([0.0, 100, 105, 400, 408, 410])
    resampled = table(recorded(u=(events, [1, 2, 3, 4, 5, 6]), y=(time, time)))
    assert not resampled.segment.any()
    np.testing.assert_array_equal(resampled.values["u"], 1 + np.searchsorted(events, time, side="right") - 1)


def test_commands_that_others_overtake_are_counted_as_lost():
    time = np.arange(0.0, 10)
    resampled = table(recorded(u=([0, 2.2, 2.4, 2.6, 7.5], [0, 1, 2, 3, 4]), y=(time, time)))
    assert resampled.values["u"].tolist() == [0, 0, 0, 3, 3, 3, 3, 3, 4, 4]
    assert kinds(resampled)["step_lost"] == 2
    assert kinds(resampled)["step_inside"] == 4


def test_jitter_is_that_of_the_recording_s_clock_without_its_gaps():
    rng = np.random.default_rng(0)
    time = np.arange(2000.0) + rng.uniform(-0.1, 0.1, 2000)
    time[1000:] += 500
    jitter = table(recorded(y=(time, time))).jitter["y"]
    # the difference of two uniform deviations of +-0.1 has standard
    # deviation 0.2 / sqrt(6); 5 % for 2000 draws
    assert jitter.std_s == pytest.approx(0.2 / np.sqrt(6), rel=0.05)
    assert 0.15 < jitter.max_s < 0.21
    assert jitter.interval_s == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    ("signals", "options", "sentence"),
    [
        (
            {"y": ([0, 1], [1, 2]), "u": ([5, 6], [1, 2])},
            {},
            "the signals have no time in common (y from 0 to 1 s; u from 5 to 6 s)",
        ),
        (
            {"y": ([0.0, 10, 20], [1, 2, 3])},
            {"max_gap_s": 5.0},
            "should have two samples 1 s apart without a gap but its longest stretch is 0 s",
        ),
        ({"y": ([0.0], [1])}, {}, "output y should have at least two samples but has 1; record longer"),
        ({"u": ([0.0, 1], [1, 2])}, {}, "no output is wanted"),
        (
            {"y": ([0.0, 1], [1, 2])},
            {"max_gap_s": 0.5},
            "the gap limit 0.5 s should be at least the sample time 1 s; raise it",
        ),
        (
            {"y": ([0.0, 1], [1, 2])},
            {"sample_time_s": 0.0},
            "the sample time should be more than 0 s but is 0",
        ),
    ],
)
def test_what_cannot_be_resampled_is_refused(signals, options, sentence):
    with pytest.raises(ValueError, match="^rig.csv: ") as refusal:
        table(recorded(**signals), **options)
    assert sentence in str(refusal.value)


def test_a_printer_s_log_with_holes_becomes_segments(shared):
    path = shared("data/caxton_print0_log/caxton_print0_early.csv")
    resampled = table(read(path, [Source("u", "target_hotend", "degC"), Source("y", "hotend", "degC")]), 0.5)
    # twelve holes of some seven seconds, where the data set's makers left rows out
    assert resampled.segment[-1] == 12
    assert all(7 < flag.end_s - flag.start_s < 8 for flag in resampled.flags if flag.kind == "gap")


def flags_of(time: np.ndarray, *kinds: str) -> list:
    signals = {"u": (time, np.zeros(len(time))), "y": (time, np.sqrt(np.arange(len(time))))}
    table = resample(
        Raw("rig.csv", signals, {}, []), sample_time_s=1.0, inputs=["u"], outputs=["y"], max_gap_s=5.0
    )
    return [one for one in table.flags if one.kind in kinds]


def test_jitter_is_told_with_its_size_and_place_and_a_steady_clock_has_none():
    time = np.arange(300.0)
    assert flags_of(time, "jitter") == []
    assert flags_of(time + 0.01 * np.random.default_rng(0).standard_normal(300), "jitter") == []
    (flag,) = flags_of(time + np.random.default_rng(0).uniform(-0.3, 0.3, 300), "jitter")
    assert "the intervals of y, u differ from" in flag.message
    assert "two devices" not in flag.message
    late = time.copy()
    late[100] += 0.6
    (flag,) = flags_of(late, "jitter")
    assert (flag.start_s, flag.end_s, flag.count) == (99.0, 101.0, 2)


def test_two_clocks_one_behind_the_other_are_told():
    (flag,) = flags_of(np.sort(np.r_[np.arange(100.0), np.arange(100) + 0.3]), "jitter")
    assert "by turns longer and shorter: two devices may write under one name" in flag.message


def test_a_gap_of_an_hour_and_an_interval_may_be_summer_time():
    time = np.arange(300.0)
    time[150:] += 3600
    (flag,) = flags_of(time, "gap")
    assert "where summer time begins" in flag.message
    time[150:] += 60
    (flag,) = flags_of(time, "gap")
    assert "summer" not in flag.message


def test_a_set_point_is_held_from_its_own_instants_and_missing_before_the_first():
    at_s = np.array([0.0, 1.9, 2.0, 4.9, 5.0, 90.0])
    held = hold(np.array([2.0, 5.0]), np.array([200.0, 0.0]), at_s)
    np.testing.assert_array_equal(held, [np.nan, np.nan, 200.0, 200.0, 0.0, 0.0])
