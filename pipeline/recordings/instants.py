"""Converts times written as text to nanoseconds on one calendar: ISO 8601, the dates of other countries,
times of day."""

import calendar
import contextlib
import datetime
import functools
import itertools
import re
import zoneinfo
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

# a clock is steady if it has at least FEWEST_STEPS and none is longer than STEADY medians. Steps within a
# date are the same in either order, so FIRST_STEPS of them are enough
STEADY, FEWEST_STEPS, FIRST_STEPS = 1.5, 5, 1000
DAY_NS = 86_400 * 10**9
_EPOCH = datetime.date(1970, 1, 1).toordinal()
_MONTHS = {name: i for i, name in enumerate(calendar.month_abbr)}
_DATE = (
    r"(?P<date>\d{4}(?P<m>[-/.])\d{1,2}(?P=m)\d{1,2}|\d{8}|"
    r"\d{1,2}(?P<k>[./-])(?:\d{1,2}|[A-Za-z]{3})(?P=k)(?:\d{4}|\d{2}))"
)
_TIME = (
    r"(?P<hours>\d+):(?P<minutes>\d\d)(?::(?P<seconds>\d\d)(?:(?:[.,:]|-(?=\d{3}\s*$))(?P<fraction>\d+))?)?"
    r"\s*(?P<half>[AaPp]\.?[Mm]\.?)?"
)
_TEXT = re.compile(
    rf"\s*(?:{_DATE}(?:[T,\s]+|$))?(?:{_TIME})?\s*(?P<zone>Z|z|[+-]\d\d(?::?\d\d)?|[A-Z]{{3,5}}|[A-Z]\w+(?:/[\w+-]+)+)?\s*$"
)
_PARTS = ("date", "hours", "minutes", "seconds", "fraction", "half", "zone")
# 20251121130000 and 20251121130000250, as controllers stamp
_COMPACT = re.compile(r"\s*((?:19|20)\d\d(?:0[1-9]|1[0-2])[0-3]\d)([0-2]\d)([0-5]\d)([0-5]\d)(\d{3})?\s*$")
# the digits after the seconds and a hyphen: a fraction as in CAXTON's camera program, or a zone
_HYPHEN = re.compile(r"(:\d\d)-(\d{1,6})\s*$")
# zones by the letters that programs write after a time; each says whether it is summer
_ZONE_HOURS = {
    "UTC": 0, "GMT": 0, "WET": 0, "WEST": 1, "BST": 1, "CET": 1, "CEST": 2, "MEZ": 1, "MESZ": 2,
    "EET": 2, "EEST": 3, "MSK": 3, "JST": 9, "KST": 9, "AEST": 10, "AEDT": 11,
    "EST": -5, "EDT": -4, "CST": -6, "CDT": -5, "MST": -7, "MDT": -6, "PST": -8, "PDT": -7,
}  # fmt: skip
EXPECTED = "seconds or ISO 8601 such as 2025-11-21T13:00:00.5"


class Instants(NamedTuple):
    """ns (n,) since 1970, or since midnight if the text has no date. `zoned`: every time names its zone."""

    ns: np.ndarray
    zoned: bool
    dated: bool


def is_compact(text: str) -> bool:
    """Returns whether a number is a date and a time without separators, 20251121130000."""
    return bool(_COMPACT.match(text))


def is_date(text: str) -> bool:
    """Returns whether a text begins with a date."""
    return bool(re.match(rf"\s*{_DATE}", text))


def instants(
    path: Path,
    name: str,
    fields: Sequence[str],
    lines: Sequence[int] | np.ndarray,
    *,
    month_first: bool | None,
    hyphen_fraction: bool = False,
) -> Instants:
    """Returns the instants that `fields` name. `month_first` decides 05/03/2025; None refuses it.
    `hyphen_fraction` decides 13:12:54-05: five hundredths of a second, or else five hours west.

    In a zone such as Europe/Berlin the end of summer time repeats an hour. Its second one is used if the
    first would not be later than the previous field. Raises ValueError with the line if a field is not a
    time.
    """
    ns = np.empty(len(fields), np.int64)
    zoned, dated, previous = True, False, None
    for i, (field, line) in enumerate(zip(fields, lines, strict=True)):
        try:
            written = _HYPHEN.sub(r"\1.\2", field) if hyphen_fraction else field
            previous, has_zone, dated = _instant(written, month_first, previous)
            ns[i] = previous
        except (ValueError, OverflowError) as error:
            hint = f" ({error}?)" if str(error).startswith(("day", "hours", "zone")) else ""
            raise ValueError(
                f"{path}: line {line}, time {name} should be {EXPECTED} but is {field.strip()[:40]!r}{hint}; "
                "convert it, or name another column"
            ) from None
        zoned = zoned and has_zone
    return Instants(ns, zoned, dated)


def _instant(field: str, month_first: bool | None, previous: int | None) -> tuple[int, bool, bool]:
    """Returns (ns, has a zone, has a date) of one text. Raises ValueError if the text is not a time."""
    compact = _COMPACT.match(field)
    if compact:
        date, hours, minutes, seconds, fraction = compact.groups()
        half, zone = None, None
    else:
        match = _TEXT.match(field)
        if not match or not (match["date"] or match["hours"]):
            return _iso(field)
        date, hours, minutes, seconds, fraction, half, zone = match.group(*_PARTS)
        if not date and seconds is None:
            raise ValueError("hours and minutes, or minutes and seconds")
    hours, minutes, seconds = int(hours or 0), int(minutes or 0), int(seconds or 0)
    if minutes > 59 or seconds > 60 or (date and hours > 24) or (half and not 1 <= hours <= 12):
        raise ValueError
    if half:
        hours = hours % 12 + 12 * (half[0] in "Pp")
    ns = ((hours * 60 + minutes) * 60 + seconds) * 10**9 + int(f"{fraction or 0:0<9}"[:9])
    ns += _day(date, month_first) * DAY_NS if date else 0
    return ns - _offset_ns(zone or "", ns, previous), bool(zone), bool(date)


def _iso(field: str) -> tuple[int, bool, bool]:
    """Returns the same for the rarer forms of ISO 8601, such as 20251121T130000Z."""
    instant = datetime.datetime.fromisoformat(field.strip())
    zone = instant.utcoffset()
    since = instant.replace(tzinfo=None) - datetime.datetime(1970, 1, 1) - (zone or datetime.timedelta())
    return since // datetime.timedelta(microseconds=1) * 1000, zone is not None, True


@functools.lru_cache(maxsize=4096)
def _day(date: str, month_first: bool | None) -> int:
    """Returns the days since 1970 of one date; recordings have few different dates."""
    parts = [date[:4], date[4:6], date[6:]] if date.isdigit() else re.split(r"[-/.]", date)
    if len(parts[0]) == 4:
        year, month, day = map(int, parts)
    else:
        day, month = int(parts[0]), _MONTHS.get(parts[1].title()) or int(parts[1])
        year = int(parts[2]) + (2000 if len(parts[2]) == 2 else 0)
        may_be_month = parts[1].isdigit() and "." not in date and day <= 12 and day != month
        if may_be_month and month <= 12 and month_first is None:
            dates = f"{year}-{month:02}-{day:02} or {year}-{day:02}-{month:02}"
            raise ValueError(f"day or month first: {dates}")
        if may_be_month and month_first is not False:
            day, month = month, day
    return datetime.date(year, month, day).toordinal() - _EPOCH


def month_first(dates: Iterable[str], sample: str) -> bool | None:
    """Returns whether dates such as 05/03/2025 begin with the month, None if nothing decides it.

    A date that can be read only one way decides. So do the am and pm of `sample` if the days continue within
    one month: 11/03 before 12/03 is the next day in Australia, and a month later in America. A single day is
    the same either way.
    """
    pairs = {
        (int(match[1]), int(match[2]))
        for date in dates
        if (match := re.match(r"\s*(\d{1,2})[/-](\d{1,2})[/-]\d", date))
    }
    if any(first > 12 for first, _ in pairs):
        return False
    american = re.search(r"\d\s*[AaPp]\.?[Mm]", sample) and len({second for _, second in pairs}) > 1
    return True if american or len(pairs) == 1 or any(second > 12 for _, second in pairs) else None


def steady_order(stamps: Iterable[str]) -> bool | None:
    """Returns whether the month comes first in dates that can be read both ways. The order is used if only
    its reading runs forward in nearly equal steps; None if neither does or both do.

    Only the first steps and those at which the date changes are used. Text that is not a time is skipped.
    """
    steps: dict[bool, list[int]] = {False: [], True: []}
    for earlier, later in itertools.pairwise(stamps):
        if len(steps[False]) >= FIRST_STEPS and earlier.split()[:1] == later.split()[:1]:
            continue
        with contextlib.suppress(ValueError, OverflowError):
            step = {
                order: _instant(later, order, None)[0] - _instant(earlier, order, None)[0] for order in steps
            }
            for order, size in step.items():
                steps[order].append(size)
    steady = [
        order
        for order, sizes in steps.items()
        if len(sizes) >= FEWEST_STEPS and min(sizes) > 0 and max(sizes) <= STEADY * np.median(sizes)
    ]
    return steady[0] if len(steady) == 1 else None


def hyphen_fraction(fields: Iterable[str]) -> bool:
    """Returns whether the digits after hyphens, as in 14:12:33-797, are fractions of a second.

    One field that cannot be a zone decides for all, because zones are written as -HH or -HHMM, up to 14
    hours. Fields are checked up to this one, or up to one without such digits.
    """
    matches = itertools.takewhile(bool, map(_HYPHEN.search, fields))
    return any(not _is_offset(match[2]) for match in matches if match)


def _is_offset(digits: str) -> bool:
    """Returns whether a zone may be HH or HHMM away from UTC."""
    hours, minutes = int(digits[:2]), int(digits[2:] or 0)
    return len(digits) in (2, 4) and minutes < 60 and hours * 60 + minutes <= 14 * 60


def _offset_ns(zone: str, local_ns: int, previous: int | None) -> int:
    """Returns by how much a clock of that zone is ahead of UTC at its time `local_ns`. Raises ValueError if
    it is not a zone."""
    if zone in ("", "Z", "z"):
        return 0
    if zone in _ZONE_HOURS:
        return _ZONE_HOURS[zone] * 3600 * 10**9
    if zone[0] not in "+-":
        first, second = _region_offsets_ns(zone, local_ns // (900 * 10**9))
        return second if first > second and previous is not None and local_ns - first <= previous else first
    digits = zone[1:].replace(":", "")
    if not _is_offset(digits):
        raise ValueError
    minutes = int(digits[:2]) * 60 + int(digits[2:] or 0)
    return (-1 if zone[0] == "-" else 1) * minutes * 60 * 10**9


@functools.lru_cache(maxsize=4096)
def _region_offsets_ns(zone: str, quarter: int) -> tuple[int, int]:
    """Returns the two offsets of a zone such as Europe/Berlin in a quarter of an hour of its own clock since
    1970.

    They differ in an hour that is repeated or left out.
    """
    try:
        region = zoneinfo.ZoneInfo(zone)
    except (zoneinfo.ZoneInfoNotFoundError, ValueError, OSError):
        raise ValueError(f"zone {zone}") from None
    local = datetime.datetime(1970, 1, 1, tzinfo=region) + datetime.timedelta(minutes=15 * quarter)
    first, second = (local.replace(fold=fold).utcoffset() or datetime.timedelta() for fold in (0, 1))
    return first // datetime.timedelta(seconds=1) * 10**9, second // datetime.timedelta(seconds=1) * 10**9


def over_midnight(ns: np.ndarray) -> tuple[np.ndarray, int]:
    """Returns times of day that continue over midnight, and the number of midnights. A day is added after
    each fall by more than half a day."""
    midnights = np.cumsum(np.r_[0, np.diff(ns) < -DAY_NS // 2])
    return ns + midnights * DAY_NS, int(midnights[-1])
