"""Describes a recording in words, and proposes a mapping to paste into params.yaml.

The description gives its format, its clocks with rate, jitter and gaps, its signals with their ranges, and
damage.
"""

import collections
import contextlib
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.recordings.clocks import check_clock, repair_topics
from pipeline.recordings.csv_files import csv_columns, csv_layout, read_csv
from pipeline.recordings.formats import (
    FileColumn,
    FileColumns,
    Note,
    file_format,
    is_time_name,
    select,
    time_column,
)
from pipeline.recordings.mcap_files import Topic, bag_parts, survey
from pipeline.recordings.mcap_files import join_parts as joined
from pipeline.recordings.mcap_files import merge_topics as merged
from pipeline.recordings.missing_codes import missing_codes
from pipeline.recordings.other_formats import LOADERS
from pipeline.recordings.parquet_files import parquet_columns, read_parquet
from pipeline.recordings.proposals import (
    CLOCK_SAMPLES,
    RecordedSignal,
    has_bare_field,
    propose,
    sample,
    telling,
    yaml_lines,
)
from pipeline.recordings.quality import quantisation_step
from pipeline.recordings.resampling import GAP_INTERVALS, intervals

# most numbers of a topic, and most columns of a table, that are described; the others are only counted
MOST_FIELDS, MOST_SIGNALS = 64, 128
CODE = "missing code"  # kind of the note on numbers that stand for a missing value
_NO_TIME = (
    "no column is called like a time; write its name, or time: every 1.0 s with the sample time, "
    "beside the mapping"
)
_NOTHING = "# no number could be read, so nothing is proposed; see the findings, and copy the recording again"
# words, columns with the prefix of their sources, units, notes
_Content = tuple[list[str], list[tuple[FileColumns, str]], dict[str, str], list[Note]]
_Read = Callable[[Sequence[str], str], tuple[FileColumns, list[Note]]]


class Inspected(NamedTuple):
    """A recording after one look: its format, words on its content, columns with the prefix of their sources,
    their signals, and notes. `time`: what ingest.time must be, "" if the clock was found."""

    kind: str
    lines: list[str]
    groups: list[tuple[FileColumns, str]]
    signals: list[RecordedSignal]
    notes: list[Note]
    time: str


def inspect(path: str | Path) -> str:
    """Returns the recording in words, and at the end YAML to paste under `ingest` and `plant`.

    Raises ValueError if nothing can be read.
    """
    path = Path(path)
    looked = look(path)
    lines, groups = list(looked.lines), [group for group, _ in looked.groups]
    with contextlib.suppress(ValueError):
        repaired = repair_topics(path, groups, one_clock=True) if groups else []
        groups = [group for group, _, _ in repaired]
        looked.notes.extend(note for _, _, notes in repaired for note in notes)
    for group in groups:
        lines += ["", *_clock(path, group)]
        lines += [f"  {name:<32} {_range(values)}" for name, values in group.values.items()]
    lines += ["", "Findings:" if looked.notes else "Findings: none"]
    lines += [f"  {note.kind}: {note.message}" for note in looked.notes]
    proposal = propose(looked.signals, looked.groups, looked.time)
    size = sum(part.stat().st_size for part in path.iterdir()) if path.is_dir() else path.stat().st_size
    proposed = yaml_lines(proposal) if looked.signals else [_NOTHING]
    return "\n".join([f"{path}: {looked.kind}, {size} bytes", *lines, "", *proposed]) + "\n"


def look(path: Path) -> Inspected:
    """Reads the recording once, for its description and for a proposal. Raises ValueError if nothing can be
    read."""
    kind = file_format(path)
    limits: dict[str, tuple[float, float]] = {}
    if kind in ("mcap", "bag"):
        lines, groups, units, notes = _mcap(path)
    elif kind in LOADERS:
        table = LOADERS[kind](path)
        limits = table.limits
        read = functools.partial(select, path, table)
        lines, groups, units, notes = _table(path, table.columns(), table.time is not None, read)
    elif kind == "csv":
        layout = csv_layout(path)
        lines, groups, units, notes = _table(
            path, csv_columns(path), False, functools.partial(read_csv, path)
        )
        lines.insert(
            0,
            f"{layout.encoding}, delimiter {layout.delimiter!r}, decimal mark {layout.decimal!r}, "
            f"data from line {layout.skip + 1}",
        )
    else:
        read = functools.partial(read_parquet, path)
        lines, groups, units, notes = _table(path, parquet_columns(path), False, read)
    signals = []
    for group, prefix in groups:
        for name, values in group.values.items():
            numbers = finite(values)
            for code in missing_codes(numbers):
                notes.append(_code_note(prefix + name, code, values))
                numbers = numbers[numbers != code]
            signals.append(RecordedSignal(prefix + name, units.get(name, ""), numbers, limits.get(name)))
    time = "every 1.0 s" if any(note.message == _NO_TIME for note in notes) else ""
    return Inspected(kind, lines, groups, signals, notes, time)


# ---- formats


def _table(path: Path, columns: Sequence[FileColumn], has_clock: bool, read: _Read) -> _Content:
    """Returns words, columns, units and notes of a table that `read` reads. `has_clock`: it has a clock of
    its own."""
    names = [column.name for column in columns]
    numeric = [column.name for column in columns if column.type == "number" and column.name]
    numbers = set(numeric)
    texts = [
        f"{column.name or '(no name)'} ({column.type})" for column in columns if column.name not in numbers
    ]
    counts = collections.Counter(names)
    twice = [f"{name} ({count} times)" for name, count in counts.items() if name and count > 1]
    lines = [f"{len(columns)} columns, {len(numeric)} of them numbers"]
    lines += [f"not numbers: {', '.join(texts[:20])}"] if texts else []
    if twice:
        lines.append(
            "the same name twice, so that none of them can be mapped; give each its own: "
            + ", ".join(twice[:20])
        )
    clock = ""
    with contextlib.suppress(ValueError):  # no column is called like a time
        clock = "" if has_clock else time_column(path, names, "")
    every_signal = [name for name in numeric if counts[name] == 1 and name != clock]
    signals = telling(every_signal, MOST_SIGNALS)
    wanted = [*([clock] if clock in numbers and counts[clock] == 1 else []), *signals]
    if not signals:
        examples = f" ({', '.join(texts[:6] + twice)})" if texts or twice else ""
        raise ValueError(
            f"{path}: none of its {len(columns)} columns holds numbers beside the time{examples}; "
            "write numbers without units, with one decimal mark, and a name for each column"
        )
    untimed = not (has_clock or clock or any(column.type == "time" for column in columns))
    broken = []
    try:
        group, notes = read(signals, "") if not untimed else read(wanted, "every 1.0 s")
    except ValueError as error:
        if untimed or f"time {clock}" not in str(error):
            raise
        broken, untimed = [Note("clock", "", 1, str(error).removeprefix(f"{path}: "))], True
        group, notes = read([name for name in wanted if name != clock], "every 1.0 s")
    if clock == "T" and not (np.diff(group.time) > 0).all():  # a temperature after all
        untimed = True
        group, notes = read(wanted, "every 1.0 s")
    notes += broken
    if len(signals) < len(every_signal):
        message = (
            f"{len(every_signal)} columns hold numbers; {len(signals)} are shown, those first whose names "
            "tell what they are"
        )
        notes.append(Note("fields", "", len(every_signal), message))
    if untimed:
        notes.append(Note("clock", "", 1, _NO_TIME))
    notes += _unit_note(clock, group)
    # a second time column is no signal
    values = {
        name: column
        for name, column in group.values.items()
        if not (is_time_name(name) and (np.diff(column) >= 0).all() and np.ptp(column) > 0)
    }
    return lines, [(group._replace(values=values), "")], {c.name: c.unit for c in columns}, notes


def _unit_note(clock: str, group: FileColumns) -> list[Note]:
    """Returns a note on a clock that is probably not in seconds. Its samples would be minutes apart, as for
    ms without their unit; or they would be too many per second for a log of temperatures, as for hours."""
    time = group.time[:CLOCK_SAMPLES]
    if not clock or time.dtype == np.int64 or len(time) < 3:
        return []
    step = float(np.median(np.diff(time)))  # NaN where a time is missing
    of_hours = 3600 * float(time[-1] - time[0]) / (len(time) - 1)  # the mean: digits are few
    if step >= 50 and step % 60 and (time == np.rint(time)).all():
        unit = "ms" if step < 2e4 else "us" if step < 2e7 else "ns"
    elif 0 < step and 0.99 < of_hours < 6.5 and abs(of_hours - round(of_hours)) < 0.01:
        unit = "h"
    else:
        return []
    message = (
        f"{clock} steps by {step:g}, read as seconds; if it counts {unit}, name the column {clock}_{unit}"
    )
    return [Note("clock", "", 1, message)]


def _mcap(path: Path) -> _Content:
    """Returns words, columns, units and notes of an MCAP file or a bag, reading each part once."""
    surveys = [survey(part, MOST_FIELDS) for part in (bag_parts(path) if path.is_dir() else [path])]
    by_name = merged([part.topics for part in surveys])
    lines, groups, units = [f"{len(by_name)} topics"], [], {}
    notes = list(dict.fromkeys(note for part in surveys for note in part.notes))
    bare = collections.Counter(field for topic in by_name.values() for field in topic.fields)
    for topic in by_name.values():
        lines.append(f"  {topic.name}: {_content(topic)}")
        if len(topic.fields) > MOST_FIELDS:
            message = f"{topic.name} has {len(topic.fields)} numbers; the first {MOST_FIELDS} are shown"
            notes.append(Note("fields", "", len(topic.fields), message))
        columns = [group for part in surveys for group in part.columns if group.name == topic.name]
        if not columns:
            continue
        alone = all(bare[field] == 1 for field in topic.fields) and not has_bare_field(topic.fields)
        groups.append((joined(path, columns), "" if alone else f"{topic.name}:"))
        for channel in topic.channels:
            metadata = channel.metadata.items()
            units |= {key.removesuffix(".unit"): unit for key, unit in metadata if key.endswith(".unit")}
    return lines, groups, units, notes


def _content(topic: Topic) -> str:
    """Returns count, encodings and numbers of a topic, or why it cannot be read."""
    schemas = {f"{channel.encoding}, {channel.schema_name or 'no schema'}" for channel in topic.channels}
    content = f"{len(topic.fields)} numbers" if topic.fields else "no numbers"
    if topic.unreadable:
        content = f"cannot be read: {topic.unreadable}"
    return f"{topic.count} messages, {'; '.join(sorted(schemas))}, {content}"


# ---- clocks and ranges


def _clock(path: Path, group: FileColumns) -> list[str]:
    count = len(group.time)
    try:
        check_clock(path, group)
    except ValueError as error:
        return [f"{group.name}: {count} samples", f"  {error}"]
    if count < 2:
        return [f"{group.name}: {count} sample"]
    time = (group.time - group.time[0]) / group.second
    steps = np.diff(time)
    limit = GAP_INTERVALS * float(np.median(steps))
    jitter = intervals(time, limit)
    gaps = np.flatnonzero(steps > limit)
    line = (
        f"{group.name}: {count} samples in {time[-1]:.6g} s, "
        f"every {jitter.interval_s:.6g} s ({1 / jitter.interval_s:.4g} per second)"
    )
    timing = f"  jitter {jitter.std_s:.2g} s (standard), {jitter.max_s:.2g} s (largest)"
    if len(gaps):
        longest = gaps[np.argmax(steps[gaps])]
        timing += (
            f"; {len(gaps)} gaps beyond {limit:.3g} s, "
            f"the longest {steps[longest]:.4g} s at {time[longest]:.6g} s"
        )
    else:
        timing += f"; no gap beyond {limit:.3g} s"
    return [line, timing]


def finite(values: np.ndarray) -> np.ndarray:
    """Returns the values that are finite; they are not copied if all are."""
    if len(values) and np.isfinite(values.min()) and np.isfinite(values.max()):
        return values
    return values[np.isfinite(values)]


def _code_note(name: str, code: float, values: np.ndarray) -> Note:
    count, total = int(np.count_nonzero(values == code)), len(finite(values))
    message = (
        f"{name} is exactly {code:g} in {100 * count / total:.2g} % of its values ({count} of {total}), far "
        "from the others: a code for a missing value; write an empty cell (NaN) in its place, or it is "
        "taken for a measurement"
    )
    return Note(CODE, name, count, message)


def _range(values: np.ndarray) -> str:
    numbers = finite(values)
    lost = len(values) - len(numbers)
    missing = f", {lost} missing" if lost else ""
    if not len(numbers):
        return f"no value{missing}"
    low, high = numbers.min(), numbers.max()
    if low == high:
        return f"constant {low:g}{missing}"
    ordered = np.sort(sample(numbers))
    levels = 1 + np.count_nonzero(ordered[1:] != ordered[:-1])
    step = quantisation_step(ordered) if 12 < levels <= len(ordered) / 3 else 0.0
    if levels <= 12 and len(ordered) < len(numbers):
        levels = len(np.unique(numbers))
    median = (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2
    steps = f", {levels} levels" if levels <= 12 else f", steps of {step:.3g}" if step else ""
    return f"{low:g} to {high:g}, median {median:g}{steps}{missing}"
