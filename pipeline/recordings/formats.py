"""Recognises the format of a recording. Holds what all formats share: records passed from a file to the
learners, columns on a clock, the choice of the time column, and tables small enough to be read whole."""

import collections
import difflib
import re
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np


class Source(NamedTuple):
    """`signal` in `unit` is `scale` times the recording's `source`, plus `offset`.

    A source is a column, or "/topic:field.sub[2]" in MCAP. There, a field's name alone is enough if only one
    topic has it.
    """

    signal: str
    source: str
    unit: str
    scale: float = 1.0
    offset: float = 0.0


class Note(NamedTuple):
    """A reader's remark on `count` messages, chunks, values or lines. `signal` is empty if it concerns the
    whole recording."""

    kind: str
    signal: str
    count: int
    message: str


class Raw(NamedTuple):
    """A recording as it was made: {signal: (time_s (n,), values (n,))}, each signal with its own clock. A
    missing value is NaN.

    `messages`: number of messages of each topic, or number of rows. `breaks`: times at which the clock had
    started over. No value is held or interpolated across a break.
    """

    path: str
    signals: dict[str, tuple[np.ndarray, np.ndarray]]
    messages: dict[str, int]
    notes: list[Note]
    breaks: tuple[float, ...] = ()


class Flag(NamedTuple):
    """A finding: what (`kind`), where (start_s to end_s), how many samples, and one sentence. `signal` is
    empty if it concerns the whole recording."""

    signal: str
    kind: str
    start_s: float
    end_s: float
    count: int
    message: str


class Jitter(NamedTuple):
    """Intervals of one clock, without those across gaps: their median, and their standard and largest
    deviation from it."""

    interval_s: float
    std_s: float
    max_s: float


class Table(NamedTuple):
    """A recording on one sample time: T samples in segments without a gap.

    `values`: as measured, never changed. `masked`: marks values that must not be used. `jitter`: of each
    signal's own clock before resampling.
    """

    recording: str
    segment: np.ndarray
    time_s: np.ndarray
    values: dict[str, np.ndarray]
    masked: dict[str, np.ndarray]
    flags: list[Flag]
    jitter: dict[str, Jitter]


# comparing names takes 10 us each
MOST_COMPARED = 50_000


def nearest_names(name: str, names: Iterable[str]) -> str:
    """Returns "the nearest names are a, b" with names like `name`, or the first ten existing names."""
    names = sorted(set(names))
    if not names:
        return "it has none that can be read as a number"
    if len(names) > MOST_COMPARED:
        return f"it has {', '.join(names[:10])} and {len(names) - 10} more"
    # "/topic:field" is found by its field alone too
    aliases = [
        (part, full)
        for full in names
        for part in sorted({full.casefold(), full.casefold().rpartition(":")[2]})
    ]
    close = difflib.get_close_matches(name.casefold(), sorted({part for part, _ in aliases}), n=3, cutoff=0.5)
    close += [name.casefold().rpartition(":")[2]]
    close = list(dict.fromkeys(full for wanted in close for part, full in aliases if part == wanted))
    if close:
        return f"the nearest names are {', '.join(close[:5])}"
    return f"it has {', '.join(names[:10])}{' and more' if len(names) > 10 else ''}"


# the configuration that a klippy.log begins with after a rollover has some 30 kB
OPENING_BYTES = 1 << 17
METADATA = "metadata.yaml"
_KLIPPY = (b"Starting Klippy", b"Start printer at", b"===== Config file =====", b"== Log rollover at")
_STATS = re.compile(rb"^(INFO:root:)?Stats \d+\.\d+: .*=", re.MULTILINE)
# OctoPrint's serial.log, with a firmware's temperature report among its first lines
_REPORT = re.compile(rb"^.*\bRecv:.*[\s:]T\d?:\s*-?\d", re.MULTILINE)
_SERIAL = re.compile(rb"^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} - (Recv|Send|Changing|Connect)", re.MULTILINE)


def is_bag(path: Path) -> bool:
    """Returns whether a folder is a ROS 2 bag."""
    return path.is_dir() and (path / METADATA).is_file()


def other_format(path: Path, start: bytes) -> str:
    """Returns "xlsx", "MATLAB", "Moonraker JSON", "klippy.log" or "serial.log", from the first 512 bytes and,
    for a text, the first OPENING_BYTES; "" for anything else."""
    if start.startswith(b"PK\x03\x04"):
        return "xlsx" if _is_workbook(path) else ""
    if start.startswith(b"MATLAB 5.0"):
        return "MATLAB"
    if b"\0" in start:
        return ""
    with path.open("rb") as stream:
        opening = stream.read(OPENING_BYTES)
    if opening.lstrip()[:1] == b"{":
        return "Moonraker JSON" if b'"temperatures"' in opening else ""
    if any(mark in opening for mark in _KLIPPY) or _STATS.search(opening):
        return "klippy.log"
    return "serial.log" if _REPORT.search(opening) or _SERIAL.match(opening) else ""


def _is_workbook(path: Path) -> bool:
    """Returns whether a zip file is a workbook. For a damaged file the name decides."""
    try:
        with zipfile.ZipFile(path) as archive:
            return "xl/workbook.xml" in archive.namelist()
    except (zipfile.BadZipFile, OSError, NotImplementedError, ValueError):
        return path.suffix.casefold() in (".xlsx", ".xlsm")


# a number above the first one of a row is not in seconds. It is an epoch in ms, us, ns, or in 100 ns since
# 1601 as in Windows (1e11 s would be the year 5138)
_EPOCHS = (
    (5e17, 1e9, 0, "ns"),
    (1e17, 1e7, 11_644_473_600, "100 ns since 1601"),
    (1e14, 1e6, 0, "us"),
    (1e11, 1e3, 0, "ms"),
)
# ticks of .NET, 100 ns since the year 1, from 1965 to 2124; in ns since 1970 that would be 1989 to 1991
_TICKS, _SINCE_YEAR_1_S = (6.2e17, 6.7e17), 62_135_596_800
# seconds since 1904, as LabVIEW counts, from 2015 to 2040
_SINCE_1904_S, _LABVIEW = 2_082_844_800, (3.5e9, 4.3e9)
# days since 1899-12-30 (since 1904 if the column says so) and since the year 0: their values from 1954 to
# 2119, and that of 1970-01-01
_SERIAL_DAYS = ((20_000, 80_000, 25_569, "spreadsheets"), (713_000, 774_000, 719_529, "MATLAB"))
# fractions of a day, and Julian dates from 1858 to 2132
_DAYS = ((0, 2), (2_400_000, 2_500_000))
_TIME_NAMES = (
    "t",
    "time",
    "elapsed",
    "elapsed_time",
    "relative_time",
    "seconds",
    "timestamp",
    "time_stamp",
    "stamp",
    "ts",
    "log_time",
    "_time",
    "datetime",
    "date_time",
    "zeitstempel",
    "zeit",
    "uhrzeit",
    "heure",
    "hora",
    "ora",
    "x_value",
    "epoch",
    "unix_time",
    "unixtime",
    "uptime",
    "runtime",
    "timestring",
    "tout",
    "date",
    "datum",
    "fecha",
    "index",
)
# Italian "data" is a date beside a time of day alone
DATE_NAMES = ("date", "datum", "fecha", "data")
# names of dates and times in languages that write the day before the month
_DAY_FIRST = ("datum", "fecha", "data", "heure", "hora", "ora", "uhrzeit", "zeit", "zeitstempel")
# times from a start; a date column beside them does not belong to them
_ELAPSED = ("elapsed", "elapsed_time", "relative_time", "uptime", "runtime")
# what pandas calls the index of a table where nobody named it
INDEX_NAMES = ("", "Unnamed: 0", "__index_level_0__", "index")
_PER_SECOND = {"s": 1.0, "sec": 1.0, "secs": 1.0, "second": 1.0, "seconds": 1.0,
               "ms": 1e3, "msec": 1e3, "us": 1e6, "µs": 1e6,
               "usec": 1e6, "ns": 1e9, "nsec": 1e9, "min": 1 / 60, "mins": 1 / 60, "minutes": 1 / 60,
               "h": 1 / 3600, "hours": 1 / 3600,
               "d": 1 / 86400, "days": 1 / 86400}  # fmt: skip

# names that are a time and its unit in one
_COUNTS = {"millis": "ms", "milliseconds": "ms", "micros": "us", "microseconds": "us", "nanoseconds": "ns"}

_PARQUET = b"PAR1"
# the format that a suffix stands for, and the names of formats
SUFFIXES = {".csv": "csv", ".parquet": "parquet", ".xlsx": "xlsx", ".mat": "MATLAB"}
NAMES = {"csv": "CSV", "parquet": "Parquet", "mcap": "MCAP"}
# text has tabs, line ends and form feeds, and sometimes the end mark of an old system; other control
# characters are of binary files
CONTROL = bytes(set(range(32)) - set(b"\t\n\r\f\x1a"))
_OTHER_FORMATS = {
    b"\x1f\x8b": ("gzip", "unpack it with gunzip"),
    b"PK\x03\x04": ("a zip file", "unpack it, or save the sheet as .xlsx or CSV"),
    b"\x28\xb5\x2f\xfd": ("zstd", "unpack it with zstd -d"),
    b"\x04\x22\x4d\x18": ("lz4", "unpack it with lz4 -d"),
    b"BZh": ("bzip2", "unpack it with bunzip2"),
    b"\xfd7zXZ": ("xz", "unpack it with unxz"),
    b"#ROSBAG V": ("a ROS 1 bag", "convert it with: mcap convert FILE.bag FILE.mcap"),
    b"SQLite format 3": ("SQLite (a rosbag2 .db3)", "convert it with: ros2 bag convert, storage mcap"),
    b"\x89HDF": ("HDF5 or MATLAB 7.3", "save the signals as CSV or Parquet"),
    b"MATLAB 7.3": ("a MATLAB 7.3 file (HDF5)", "save it with save(..., '-v7'), or write CSV with h5py"),
    b"\x80\x04": ("a pickle", "save the signals as CSV or Parquet"),
    b"<": ("HTML or XML", "save the signals as CSV or Parquet"),
    b"{": ("JSON", "save the signals as CSV or Parquet"),
    b"[{": ("JSON", "save the signals as CSV or Parquet"),
    b"\x89PNG": ("a PNG picture", "name the recording"),
    b"\xff\xd8\xff": ("a JPEG picture", "name the recording"),
    b"GIF8": ("a GIF picture", "name the recording"),
    b"%PDF": ("a PDF document", "export the numbers as CSV"),
    b"\x7fELF": ("a program (ELF)", "name the recording"),
    b"\x93NUMPY": ("a NumPy array", "save the signals as CSV or Parquet"),
    b"TDSm": ("TDMS of LabVIEW", "export it as CSV"),
    b"\xd0\xcf\x11\xe0": ("Excel 97 or a workbook with a password", "save it as .xlsx without one"),
    b"ARROW1": ("an Arrow file", "write it as Parquet"),
    b"PARE": ("an encrypted Parquet file", "write it without encryption"),
}


class FileColumns(NamedTuple):
    """Columns on one clock.

    `time`: time_s (n,), or time_ns (n,) if the clock is a calendar's; `place(i)`: names the place of sample i
    in the file; `zone`: the calendar's time zone, empty if the file does not give it; `units`: those that the
    file gives.
    """

    name: str
    time: np.ndarray
    values: dict[str, np.ndarray]
    place: Callable[[int], str]
    zone: str = "UTC"
    units: Mapping[str, str] = MappingProxyType({})

    @property
    def second(self) -> float:
        """One second in the unit of `time`."""
        return 1e9 if self.time.dtype == np.int64 else 1.0


class FileColumn(NamedTuple):
    """A column of a file; `unit` is empty if the file does not give it."""

    name: str
    type: str
    unit: str


# ---- format


def file_format(path: Path) -> str:
    """Returns "mcap", "parquet", "csv", "bag" or a name of `LOADERS`, from the first bytes. Text is "csv",
    but text named .mcap is refused.

    Raises ValueError for any other format.
    """
    if is_bag(path):
        return "bag"
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
        raise ValueError(
            f"{path} is empty (0 bytes) but should be MCAP, Parquet or CSV; copy the recording again"
        )
    if b"MCAP0" in start[:8]:
        return "mcap"
    if start.startswith(_PARQUET):
        return "parquet"
    if kind := other_format(path, start):
        return kind
    for magic, (name, remedy) in _OTHER_FORMATS.items():
        if start.startswith(magic):
            raise ValueError(f"{path} is {name} but should be MCAP, Parquet or CSV; {remedy}")
    if not start.strip(b"\0"):
        raise ValueError(
            f"{path} begins with {len(start)} zero bytes but should be MCAP, Parquet or CSV; "
            "copy the recording again"
        )
    is_binary = len(start) - len(start.translate(None, CONTROL)) > len(start) // 100
    if path.suffix == ".mcap" or (path.suffix == ".parquet" and is_binary):
        raise ValueError(
            f"{path}: the bytes at offset 0 are {start[:8].hex(' ')}, "
            f"which begin no {path.suffix[1:]} file; copy the recording again as binary, "
            "or, if it is text such as CSV, give it the suffix .csv"
        )
    return "csv"


# ---- time


def time_column(path: Path, names: Sequence[str], time: str) -> str:
    """Returns the column `time` or, if `time` is empty, the column with the likeliest name of a time. Raises
    ValueError with the existing names."""
    if time:
        if time not in names:
            raise ValueError(f"{path}: there is no time column {time!r}; {nearest_names(time, names)}")
        return time
    ranked = [(rank, name) for name in names if (rank := _time_rank(name)) is not None]
    # an index stands first in CSV, last in Parquet
    index = [name for name in (names[0], names[-1]) if name in INDEX_NAMES]
    if not ranked and index:
        return index[0]
    if not ranked:
        raise ValueError(
            f"{path}: no column is called like a time (t_s, time, timestamp, ...) among "
            f"{', '.join(names[:12])}; name it, or write time: every 1.0 s"
        )
    return min(ranked)[1]


def column_place(path: Path, names: Sequence[str], name: str) -> int:
    if name not in names:
        raise ValueError(
            f"{path}: there is no column {name!r}; {nearest_names(name, [other for other in names if other])}"
        )
    if names.count(name) > 1:
        raise ValueError(
            f"{path}: {names.count(name)} columns are called {name!r}; give each a name of its own"
        )
    return names.index(name)


def column_places(path: Path, names: Sequence[str], wanted: Sequence[str]) -> list[int]:
    """Returns the places of the wanted columns, in one pass over the names. Raises ValueError if a name is
    missing or exists twice."""
    counts = collections.Counter(names)
    at = {name: i for i, name in enumerate(names)}
    return [at[name] if counts[name] == 1 else column_place(path, names, name) for name in wanted]


def is_time_name(name: str) -> bool:
    """Returns whether a column of that name is likely to be the time."""
    return _time_rank(name) is not None


def _time_rank(name: str) -> tuple[bool, int] | None:
    """Returns the rank of a column as the time, None if it is no time. A name with a unit of time comes
    first."""
    if name.strip() == "T":  # more often a temperature
        return True, len(_TIME_NAMES)
    base, unit = _time_unit(name)
    return (not unit, _TIME_NAMES.index(base)) if base in _TIME_NAMES else None


def _time_unit(name: str) -> tuple[str, str]:
    """Returns ("time", "ms") for "Time [ms]", "time_ms" and the like. A time zone at the end is not part of
    the name."""
    plain = re.sub(r"[\s_.]*[(\[/_\s]\s*(utc|gmt|local)\s*[)\]]?$", "", name.strip().casefold())
    if plain in _COUNTS:
        return "time", _COUNTS[plain]
    match = re.match(r"^(.*?)[\s_.]*[(\[/_\s]\s*(\w+)\s*[)\]]?$", plain)
    base, unit = (match[1], match[2]) if match and match[2] in _PER_SECOND else (plain, "")
    return base if base in _TIME_NAMES else re.sub(r"\W+", "_", base).strip("_"), unit


def date_column(names: Sequence[str], clock: str) -> str | None:
    """Returns the column of the date beside a column of the time of day; None if there is none, or if the
    time counts from a start."""
    if _time_unit(clock)[0] in _ELAPSED:
        return None
    return next((name for name in names if name != clock and _time_unit(name)[0] in DATE_NAMES), None)


def writes_day_first(names: Iterable[str]) -> bool:
    """Returns whether a column of a time or a date is named in a language that writes the day before the
    month."""
    return any(_time_unit(name)[0] in _DAY_FIRST for name in names)


def seconds(name: str, numbers: np.ndarray, written: str = "") -> tuple[np.ndarray, str]:
    """Returns time in seconds, and a remark if the unit was guessed.

    The unit is that of the column's name, or the one `written` beside it, as in a row of units. If neither
    gives a unit, it is guessed from the size of the numbers: an epoch, a spreadsheet's days, or otherwise
    seconds.
    """
    if unit := _unit_of_time(name, written):
        return numbers / _PER_SECOND[unit], ""
    finite = numbers[np.isfinite(numbers)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)
    if _TICKS[0] < low and high < _TICKS[1]:
        remark = f"column {name} was taken as ticks of .NET (100 ns since the year 1)"
        return numbers / 1e7 - _SINCE_YEAR_1_S, remark
    for limit, per_second, epoch, unit in _EPOCHS:
        if high > limit:
            return (
                numbers / per_second - epoch,
                f"column {name} holds numbers up to {high:.3g} and was taken as an epoch in {unit}",
            )
    if _LABVIEW[0] < low and high < _LABVIEW[1] and np.median(np.abs(np.diff(finite))) < 3600:
        return (
            numbers - _SINCE_1904_S,
            f"column {name} was taken as seconds since 1904, as LabVIEW counts them",
        )
    for first, last, epoch, program in _SERIAL_DAYS:
        epoch = 24_107 if "1904" in name and program == "spreadsheets" else epoch
        if (
            first <= low
            and high <= last
            and len(finite) > 1
            and (_time_unit(name)[0] in DATE_NAMES or _in_days(float(np.median(np.abs(np.diff(finite))))))
        ):
            remark = (
                f"column {name} holds {low:.8g} to {high:.8g} and was taken as days, as {program} count them"
            )
            # to the microsecond, a double's resolution there
            return np.round((numbers - epoch) * 86400, 6), remark
    return numbers, ""


def clock_seconds(
    path: Path, name: str, numbers: np.ndarray, unit: str, notes: list[Note], *, is_declared: bool
) -> np.ndarray:
    """Returns the time column in seconds (n,). A guessed unit is noted. Raises ValueError if the numbers may
    be fractions of a day or, unless the column was declared, if they only count the rows."""
    times, remark = seconds(name, numbers, unit)
    if remark:
        notes.append(Note("clock", "", 1, remark))
    has_unit = _unit_of_time(name, unit) or len(times) < 3
    step = 0.0 if has_unit else float(np.median(np.abs(np.diff(times))))
    # a time of day in a spreadsheet, or a Julian date: as seconds, more than 11,000 samples a second
    of_days = any(first <= times.min() and times.max() < last for first, last in _DAYS)
    if of_days and 0 < step * 86400 < 8:
        raise ValueError(
            f"{path}: time {name} runs from {times.min():.6g} to {times.max():.6g} in steps of {step:.3g}, "
            f"which may be seconds, or days with {step * 86400:.3g} s between samples; "
            f"write its unit into its name, as in {name}_s or {name}_days"
        )
    if not is_declared and name in INDEX_NAMES and times[0] in (0, 1) and (np.diff(times) == 1).all():
        raise ValueError(
            f"{path}: no column is called like a time, and {name or 'the column without a name'} counts the "
            "rows 0, 1, 2, ..., which is no time; write time: every 1.0 s with the sample time, or its name"
        )
    return times


def _unit_of_time(name: str, written: str) -> str:
    """Returns the unit in the name of a time, or the one `written` beside it, "" for none."""
    unit = _time_unit(name)[1] or written.strip(" ()[]").casefold()
    return unit if unit in _PER_SECOND else ""


def _in_days(interval: float) -> bool:
    """Returns whether an interval is in days: up to 8 s, or whole seconds up to a minute. The same number in
    seconds would mean 11 kHz or more, or a rate that no such machine has: 1 kHz would be 86.4 s."""
    in_seconds = interval * 86400
    return 0 < in_seconds < 8 or (in_seconds < 61 and abs(in_seconds - round(in_seconds)) < 0.02)


# ---- which way the time runs


def forward(columns: FileColumns, notes: list[Note]) -> FileColumns:
    """Returns the columns with the oldest sample first. Columns with the newest sample first are reversed,
    and this is noted. Nothing else is sorted."""
    last = len(columns.time) - 1
    if last < 1 or not (np.diff(columns.time) < 0).all():
        return columns
    message = "the newest sample stands first: the rows were read from the last to the first"
    notes.append(Note("clock", "", last + 1, message))
    values = {name: column[::-1] for name, column in columns.values.items()}
    return columns._replace(time=columns.time[::-1], values=values, place=lambda i: columns.place(last - i))


def every(time: str) -> float | None:
    """Returns the interval in "every 0.5 s", for a table without a time column; None for a column's name."""
    match = re.fullmatch(r"every\s+(\+?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*s", time.strip())
    interval = float(match[1]) if match else 0.0
    return interval if 0 < interval < np.inf else None


# a clock that begins after more than three years is a calendar's. It is counted from the record's first whole
# second, so floats hold nanoseconds
CALENDAR_S = 1e8


# most bytes unpacked from one spreadsheet or MATLAB file; a print log of a day has 100 MB
LARGEST_UNPACKED = 1 << 29
MOST_COLUMNS = 2000
# numbers of one table: 0.8 GB
MOST_VALUES = 100_000_000


class WholeTable(NamedTuple):
    """Numbers of n rows by name, with the unit that the file gives ("" for none).

    `time`: the file's own clock, time_s (n,) or time_ns (n,) if the clock is a calendar's, None if a column
    holds the time; `limits`: lowest and highest value that the machine's own settings allow, by column;
    `texts`: columns that are not numbers, with what they hold.
    """

    values: dict[str, np.ndarray]
    units: dict[str, str]
    time: np.ndarray | None
    zone: str
    place: Callable[[int], str]
    notes: list[Note]
    limits: dict[str, tuple[float, float]]
    texts: dict[str, str]
    stamps: dict[str, np.ndarray]

    def columns(self) -> list[FileColumn]:
        """Returns the columns as `inspect` lists them."""
        return [
            *(FileColumn(name, "number", self.units.get(name, "")) for name in self.values),
            *(FileColumn(name, "time", "") for name in self.stamps),
            *(FileColumn(name, kind, "") for name, kind in self.texts.items()),
        ]


def select(path: Path, table: WholeTable, wanted: Sequence[str], time: str) -> tuple[FileColumns, list[Note]]:
    """Returns the wanted columns on the clock that `time` names ("" for the table's own, a column, or "every
    1 s"), and notes.

    Raises ValueError if a column is missing or holds no numbers, or if the table has no rows.
    """
    names = [column.name for column in table.columns()]
    column_places(path, names, wanted)
    for name in wanted:
        if name not in table.values:
            raise ValueError(
                f"{path}: column {name} should hold numbers but holds {table.texts.get(name, 'times')}; "
                "write numbers, or map another column"
            )
    count = len(next(iter(table.values.values()), ()))
    if not count:
        raise ValueError(f"{path}: the table should have rows but has none; record it again or remove it")
    interval, notes = every(time), list(table.notes)
    if interval:
        clock, zone = np.arange(count) * interval, ""
    elif table.time is not None and not time:
        clock, zone = table.time, table.zone
    else:
        clock, zone = _clock(path, table, names, time, notes)
    values = {name: table.values[name] for name in wanted}
    return forward(FileColumns("rows", clock, values, table.place, zone, table.units), notes), notes


def _clock(
    path: Path, table: WholeTable, names: Sequence[str], time: str, notes: list[Note]
) -> tuple[np.ndarray, str]:
    """Returns (time, zone) from the column that `time` names, or from the first column with the name of a
    time."""
    if not time and table.stamps:
        # if there are dates, a temperature or a counter is not the time
        called = [
            name
            for name in (*table.stamps, *table.values)
            if is_time_name(name) and name not in ("T", *INDEX_NAMES)
        ]
        time = time_column(path, called, "") if called else next(iter(table.stamps))
    name = time_column(path, names, time)
    if name in table.stamps:
        return table.stamps[name], ""
    if name not in table.values:
        raise ValueError(
            f"{path}: time {name} should be seconds or a date but holds {table.texts[name]}; convert it, "
            "or name another column"
        )
    unit = table.units.get(name, "")
    return clock_seconds(path, name, table.values[name], unit, notes, is_declared=bool(time)), "UTC"


def check_values(path: Path, rows: int, columns: int) -> None:
    """Raises ValueError if a table has more numbers than are read into memory."""
    if rows * columns > MOST_VALUES:
        raise ValueError(
            f"{path}: {rows} rows of {columns} columns are more than the {MOST_VALUES} numbers "
            "that are read; split the recording"
        )


def check_width(path: Path, count: int) -> None:
    """Raises ValueError if a table has more columns than a machine has signals."""
    if count > MOST_COLUMNS:
        raise ValueError(
            f"{path}: {count} columns are more than the {MOST_COLUMNS} that are read; "
            "save the machine's signals alone"
        )
