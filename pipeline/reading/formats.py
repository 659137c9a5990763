"""What a recording is written in, and what all formats have in common: columns on a clock, and how a column shows that it is the time."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.reading.signals import nearest_names

# a number beyond that is no time in seconds but an epoch in ms, us or ns (1e11 s is the year 5138)
_EPOCHS = ((1e17, 1e9, "ns"), (1e14, 1e6, "us"), (1e11, 1e3, "ms"))
_TIME_NAMES = (
    "t",
    "time",
    "elapsed",
    "elapsed_time",
    "seconds",
    "timestamp",
    "time_stamp",
    "stamp",
    "log_time",
    "datetime",
    "date_time",
    "date",
    "index",
)
_PER_SECOND = {"s": 1.0, "sec": 1.0, "secs": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e3, "msec": 1e3, "us": 1e6, "µs": 1e6,
               "usec": 1e6, "ns": 1e9, "nsec": 1e9, "min": 1 / 60, "h": 1 / 3600}  # fmt: skip

_PARQUET = b"PAR1"
_STRANGERS = {
    b"\x1f\x8b": ("gzip", "unpack it with gunzip"),
    b"PK\x03\x04": ("zip or Excel", "unpack it, or save the sheet as CSV"),
    b"\x28\xb5\x2f\xfd": ("zstd", "unpack it with zstd -d"),
    b"\x04\x22\x4d\x18": ("lz4", "unpack it with lz4 -d"),
    b"BZh": ("bzip2", "unpack it with bunzip2"),
    b"\xfd7zXZ": ("xz", "unpack it with unxz"),
    b"#ROSBAG V": ("a ROS 1 bag", "convert it with: mcap convert FILE.bag FILE.mcap"),
    b"SQLite format 3": ("SQLite (a rosbag2 .db3)", "convert it with: ros2 bag convert, storage mcap"),
    b"\x89HDF": ("HDF5 or MATLAB 7.3", "save the signals as CSV or Parquet"),
    b"MATLAB 5.0": ("a MATLAB file", "save the signals as CSV or Parquet"),
    b"\x80\x04": ("a pickle", "save the signals as CSV or Parquet"),
    b"<": ("HTML or XML", "save the signals as CSV or Parquet"),
}


class Columns(NamedTuple):
    """Columns on one clock: time_s (n,) or, where it is on a calendar, time_ns (n,); `place(i)` says where sample i stands in the file."""

    name: str
    time: np.ndarray
    values: dict[str, np.ndarray]
    place: Callable[[int], str]


class Column(NamedTuple):
    """A column there is; `unit` where the file says it."""

    name: str
    type: str
    unit: str


# ---- format


def file_format(path: Path) -> str:
    """ "mcap", "parquet" or "csv", by the file's first bytes, whatever its name ends in. Raises ValueError for what is none of them."""
    if path.is_dir():
        raise ValueError(f"{path} is a folder but should be one recording; name a file in it")
    try:
        with path.open("rb") as stream:
            start = stream.read(512)
    except FileNotFoundError:
        raise ValueError(f"{path} is missing; check the name, or put the recording there") from None
    except OSError as error:
        raise ValueError(f"{path} cannot be opened ({error.strerror}); make it readable") from None
    if not start:
        raise ValueError(f"{path} is empty (0 bytes) but should be MCAP, Parquet or CSV; copy the recording again")
    if b"MCAP0" in start[:8]:
        return "mcap"
    if start.startswith(_PARQUET):
        return "parquet"
    for magic, (name, remedy) in _STRANGERS.items():
        if start.startswith(magic):
            raise ValueError(f"{path} is {name} but should be MCAP, Parquet or CSV; {remedy}")
    if not start.strip(b"\0"):
        raise ValueError(f"{path} begins with {len(start)} zero bytes but should be MCAP, Parquet or CSV; copy the recording again")
    if path.suffix in (".mcap", ".parquet"):
        raise ValueError(
            f"{path}: the bytes at offset 0 are {start[:8].hex(' ')}, which begin no {path.suffix[1:]} file; copy the"
            f" recording again as binary"
        )
    return "csv"


# ---- time


def time_column(path: Path, names: Sequence[str], time: str) -> str:
    """The column `time`, or the first that is called like a time. Raises ValueError naming what there is."""
    if time:
        if time not in names:
            raise ValueError(f"{path}: there is no time column {time!r}; {nearest_names(time, names)}")
        return time
    ranked = [(rank, name) for name in names if (rank := _time_rank(name)) is not None]
    if not ranked:
        shown = ", ".join(names[:12])
        raise ValueError(
            f"{path}: no column is called like a time (t_s, time, timestamp, ...) among {shown}; name it, or write time: every 1.0 s"
        )
    return min(ranked)[1]


def column_place(path: Path, names: Sequence[str], name: str) -> int:
    if name not in names:
        raise ValueError(f"{path}: there is no column {name!r}; {nearest_names(name, [known for known in names if known])}")
    if names.count(name) > 1:
        raise ValueError(f"{path}: {names.count(name)} columns are called {name!r}; give each a name of its own")
    return names.index(name)


def is_time_name(name: str) -> bool:
    """Whether a column of that name is likely to be the time."""
    return _time_rank(name) is not None


def _time_rank(name: str) -> tuple[bool, int] | None:
    """A column with a unit of time comes before one without; None is no time."""
    base, unit = _time_unit(name)
    return (not unit, _TIME_NAMES.index(base)) if base in _TIME_NAMES else None


def _time_unit(name: str) -> tuple[str, str]:
    """("time", "ms") of "Time [ms]", "time_ms" and the like."""
    found = re.match(r"^(.*?)[\s_.]*[(\[/_\s]\s*(\w+)\s*[)\]]?$", name.strip().casefold())
    if found and found[2] in _PER_SECOND:
        return re.sub(r"\W+", "_", found[1]).strip("_"), found[2]
    return re.sub(r"\W+", "_", name.strip().casefold()).strip("_"), ""


def seconds(name: str, numbers: np.ndarray) -> tuple[np.ndarray, str]:
    """Time in seconds from numbers in the unit of the column's name; without one, in seconds or in what the size of an epoch tells (then
    said)."""
    unit = _time_unit(name)[1]
    if unit:
        return numbers / _PER_SECOND[unit], ""
    largest = np.nanmax(np.abs(numbers), initial=0.0)
    for limit, per_second, unit in _EPOCHS:
        if largest > limit:
            return numbers / per_second, f"column {name} holds numbers up to {largest:.3g} and was taken as an epoch in {unit}"
    return numbers, ""


def check_clock(path: Path, group: Columns) -> None:
    """Raises ValueError where a time is missing, repeated or before the one ahead of it, with the place."""
    time = group.time
    if np.issubdtype(time.dtype, np.floating) and not np.isfinite(time).all():
        i = int(np.flatnonzero(~np.isfinite(time))[0])
        missing = int((~np.isfinite(time)).sum())
        raise ValueError(f"{path}: {group.place(i)} should have a time but has none, the first of {missing}; fill it in or remove the row")
    steps = np.diff(time)
    if (steps > 0).all():
        return
    i = int(np.flatnonzero(steps <= 0)[0])
    unit = 1e9 if time.dtype == np.int64 else 1.0
    start = time[0] if unit == 1e9 else 0
    now, before = (float(time[j] - start) / unit for j in (i + 1, i))
    since = " after the first" if start else ""
    count = int((steps <= 0).sum())
    if steps[i] == 0:
        said = f"has the same time as the sample before it, {now:.9g} s{since}"
        remedy = "name a finer clock, or separate two devices that write under one name"
    else:
        said = f"is at {now:.9g} s{since}, which is before the sample ahead of it at {before:.9g} s"
        remedy = (
            "split the recording where its clock was set back"
            if group.name == "rows"
            else "sort it with: mcap sort, or split it where its clock was set back"
        )
    times = f", the first of {count}" if count > 1 else ""
    raise ValueError(f"{path}: {group.place(i + 1)} {said}{times}, but time should only run forward; {remedy}")


def every(time: str) -> float | None:
    """The interval of "every 0.5 s", the time of a table that has none; None for a column's name."""
    found = re.fullmatch(r"every\s+([0-9.eE+-]+)\s*s", time.strip())
    try:
        interval = float(found[1]) if found else None
    except ValueError:
        return None
    return interval if interval is not None and 0 < interval < np.inf else None
