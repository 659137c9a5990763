import datetime
from pathlib import Path

import numpy as np
import pytest

from pipeline.recordings.instants import Instants, hyphen_fraction, instants, month_first, over_midnight

NOON = int(datetime.datetime(2025, 11, 21, 12, tzinfo=datetime.UTC).timestamp()) * 10**9


def read(*fields: str, order: bool | None = None) -> Instants:
    return instants(
        Path("rig.csv"),
        "time",
        fields,
        range(2, 2 + len(fields)),
        month_first=order,
        hyphen_fraction=hyphen_fraction(fields),
    )


@pytest.mark.parametrize(
    "text",
    [
        "2025-11-21T12:00:00",
        "2025-11-21 12:00:00.000",
        "2025/11/21 12:00",
        "20251121T120000",
        "20251121120000",
        "21.11.2025 12:00:00,000",
        "21.11.25 12:00:00",
        "21-Nov-2025 12:00:00",
        "21/11/2025 12:00:00",
        "11/21/2025 12:00:00 PM",
        " 2025-11-21T12:00:00Z ",
        "2025-11-21T13:00:00+01:00",
        "2025-11-21T06:30:00-0530",
        "2025-11-21 12:00:00 UTC",
        "2025-11-21 13:00:00 CET",
        "2025-11-21 13:00:00 Europe/Berlin",
        "21.11.2025 01:00:00 PM CET",
        "2025-11-21 07:00:00 America/New_York",
    ],
)
def test_one_instant_is_the_same_however_it_is_written(text):
    assert read(text).ns.tolist() == [NOON]


def test_fractions_are_kept_to_the_nanosecond():
    assert (read("2025-11-21T12:00:00.123456789").ns - NOON).tolist() == [123456789]
    assert (read("20251121120000250").ns - NOON).tolist() == [250_000_000]


@pytest.mark.parametrize(
    ("digits", "ns"),
    [
        ("7", 700_000_000),
        ("34", 340_000_000),
        ("797", 797_000_000),
        # 79 minutes are no zone's
        ("0479", 47_900_000),
        ("01234", 12_340_000),
        ("050000", 50_000_000),
    ],
)
def test_digits_behind_a_hyphen_that_are_no_zone_are_a_fraction(digits, ns):
    clock = read(f"2025-11-21T12:00:00-{digits}")
    assert (clock.ns - NOON).tolist() == [ns]
    assert not clock.zoned


def test_one_fraction_behind_a_hyphen_tells_how_those_that_look_like_zones_are_read():
    """The camera program of CAXTON: hundredths, of which 00 to 14 might be hours."""
    clock = read("2025-11-21T12:00:00-05", "2025-11-21T12:00:00-52", "2025-11-21T12:00:01-14")
    assert (clock.ns - NOON).tolist() == [50_000_000, 520_000_000, 1_140_000_000]
    hours = read("2025-11-21T12:00:00-05", "2025-11-21T12:00:01-05")
    assert hours.zoned
    assert (hours.ns - NOON).tolist() == [5 * 3600 * 10**9, (5 * 3600 + 1) * 10**9]


def test_the_zone_counts_as_known_only_where_every_time_names_it():
    assert read("2025-11-21T12:00:00Z").zoned
    assert not read("2025-11-21T12:00:00Z", "2025-11-21T12:00:01").zoned


def test_times_of_day_count_from_midnight_and_run_on_over_the_next():
    clock = read("23:59:58", "23:59:59.5", "0:00:01")
    assert not clock.dated
    times, midnights = over_midnight(clock.ns)
    np.testing.assert_allclose(np.diff(times) / 1e9, [1.5, 1.5], rtol=1e-12)
    assert midnights == 1
    # an elapsed time may have more than 24 hours
    assert read("25:00:00").ns.tolist() == [25 * 3600 * 10**9]


def test_day_and_month_are_told_by_a_date_that_can_be_only_one_of_both():
    assert month_first(["05/03/2025", "13/03/2025"], "05/03/2025") is False
    assert month_first(["05/03/2025", "05/13/2025"], "05/03/2025") is True
    # the days of one month run on in the second place where the month comes first
    assert month_first(["03/05/2025", "03/06/2025"], "03/05/2025 1:00:00 PM") is True
    assert month_first(["05/03/2025", "06/03/2025"], "05/03/2025 1:00:00 PM") is None
    assert month_first(["05/03/2025", "06/03/2025"], "05/03/2025 13:00:00") is None
    # of one day alone only the time of day matters
    assert month_first(["05/03/2025"], "05/03/2025") is not None


def test_the_hour_that_the_end_of_summer_time_repeats_is_read_in_its_order():
    local = [
        f"2025-10-26 {hour}:{minute:02d}:00"
        for hour in ("01", "02", "02", "03")
        for minute in range(0, 60, 10)
    ]
    named = local[:12], local[12:18], local[18:]
    for fields in (
        [f"{text} Europe/Berlin" for text in local],
        [
            f"{text} {zone}"
            for texts, zone in zip(named, ("CEST", "CET", "CET"), strict=True)
            for text in texts
        ],
    ):
        assert (np.diff(read(*fields).ns) == 600 * 10**9).all()


def test_the_hour_that_the_begin_of_summer_time_leaves_out_is_no_gap():
    clock = read("2025-03-30 01:59:00 Europe/Berlin", "2025-03-30 03:00:00 Europe/Berlin")
    assert np.diff(clock.ns).tolist() == [60 * 10**9]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("warm", "is 'warm'; convert it"),
        (
            "05/03/2025 12:00",
            "is '05/03/2025 12:00' (day or month first: 2025-03-05 or 2025-05-03?); convert it",
        ),
        ("12:34", "is '12:34' (hours and minutes, or minutes and seconds?)"),
        ("31.02.2025 12:00", "is '31.02.2025 12:00' (day is out of range for month?); convert it"),
        ("2025-11-21 12:00:00 Mars/Olympus", "(zone Mars/Olympus?)"),
        ("2025-11-21 12:00:00 XYZ", "(zone XYZ?)"),
        ("2263-11-21T12:00:00", "is '2263-11-21T12:00:00'"),
        ("2025-11-21T12:61:00", "is '2025-11-21T12:61:00'"),
        # behind a first time without digits behind a hyphen, they can only be a zone
        ("2025-11-21T12:00:00-34", "is '2025-11-21T12:00:00-34'"),
        ("2025-11-21T12:00:00+34", "is '2025-11-21T12:00:00+34'"),
    ],
)
def test_what_is_no_time_is_refused_with_its_line(text, reason):
    with pytest.raises(
        ValueError, match=r"^rig\.csv: line 3, time time should be seconds or ISO 8601"
    ) as refusal:
        read("2025-11-21T12:00:00", text)
    assert reason in str(refusal.value)
    assert str(refusal.value).endswith("; convert it, or name another column")
