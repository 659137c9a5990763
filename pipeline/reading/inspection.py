"""A recording described in words, and a mapping to paste into params.yaml.

The words give its format, its clocks with rate, jitter and gaps, its signals with their ranges, and damage.
"""

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.reading.csv_files import csv_columns, csv_layout, read_csv
from pipeline.reading.formats import Columns, check_clock, file_format, is_time_name
from pipeline.reading.mcap_columns import Topic, mcap_columns, topics
from pipeline.reading.parquet_files import parquet_columns, read_parquet
from pipeline.reading.quality import ROOM_KELVIN, quantisation_step
from pipeline.reading.resampling import GAP_INTERVALS
from pipeline.reading.signals import Note, intervals

MOST_FIELDS = 64
_NO_TIME = (
    "no column is called like a time; write its name, or time: every 1.0 s with the sample time, "
    "beside the mapping"
)
_SET_POINT = r"set.?point|target|reference|\bsp\b|_sp$|^sp_"
_TEMPERATURE = (
    r"temp|celsius|deg_?c|°c|hot.?end|nozzle|barrel|zone|\bbed\b|^bed|thermo|tool_?\d|chamber|"
    r"^t_?\d+|^t[_\[(]|_[ckf]$|[\[(][ckf°]"
)
# a temperature whatever else the name says, such as heater_bed.temperature
_SURELY_TEMPERATURE = r"temperature|celsius|deg_?c|°c|(?<!set)[\s._](temp|actual)$"
_INPUT = r"heat|duty|pwm|power|percent|pct|%|^q_?\d|^u_?\d*$|motor|screw|rpm|fan|voltage|current"
_MOVER = r"motor|screw|rpm|fan"
_STAMP = r"(^|\.)(sec|secs|seconds|nsec|nsecs|nanosec|nanos|seq|sequence)$|class$|(^|_)(id|num|index)$"
# unit that a name carries -> what makes our unit of it
_UNITS = (
    (r"(pct|percent|%)", ("percent", 1.0, 0.0)),
    (r"(deg_?c|°c|celsius|[_\[(]c[\])]?$)", ("degC", 1.0, 0.0)),
    (r"(kelvin|[_\[(]k[\])]?$)", ("degC", 1.0, -273.15)),
    (r"(deg_?f|°f|fahrenheit|[_\[(]f[\])]?$)", ("degC", 0.555556, -17.7778)),
)


class _Signal(NamedTuple):
    """A column: its source, the unit that the file gives, its numbers, and its role in the proposal."""

    source: str
    unit: str
    values: np.ndarray
    role: str = ""


def inspect(path: str | Path) -> str:
    """The recording in words, and at the end YAML to paste under `ingest.mapping` and `plant`.

    Raises ValueError if nothing can be read.
    """
    path = Path(path)
    kind = file_format(path)
    if kind == "mcap":
        lines, groups, units, notes = _mcap(path)
    else:
        lines, groups, units, notes = _table(path, kind)
    signals = []
    for group, prefix in groups:
        lines += ["", *_clock(path, group)]
        for name, values in group.values.items():
            lines.append(f"  {name:<32} {_range(values)}")
            signals.append(_Signal(prefix + name, units.get(name, ""), values))
    lines += [
        "",
        "Findings:" if notes else "Findings: none",
        *(f"  {note.kind}: {note.message}" for note in notes),
    ]
    proposal = _proposal(signals, groups)
    if any(note.message == _NO_TIME for note in notes):
        proposal.insert(
            2,
            "  time: every 1.0 s    # write the sample time here, for the file does not say it; "
            "or the name of a column",
        )
    return "\n".join([f"{path}: {kind}, {path.stat().st_size} bytes", *lines, "", *proposal]) + "\n"


# ---- formats


def _table(path: Path, kind: str) -> tuple[list[str], list[tuple[Columns, str]], dict[str, str], list[Note]]:
    columns = csv_columns(path) if kind == "csv" else parquet_columns(path)
    numeric = [column.name for column in columns if column.type == "number" and column.name]
    lines = []
    if kind == "csv":
        layout = csv_layout(path)
        lines.append(
            f"{layout.encoding}, delimiter {layout.delimiter!r}, decimal mark {layout.decimal!r}, "
            f"data from line {layout.skip + 1}"
        )
    others = [
        f"{column.name or '(no name)'} ({column.type})" for column in columns if column.name not in numeric
    ]
    lines += [f"{len(columns)} columns, {len(numeric)} of them numbers"] + (
        [f"not numbers: {', '.join(others[:20])}"] if others else []
    )
    names = [column.name for column in columns]
    twice = [
        f"{name} ({names.count(name)} times)"
        for name in dict.fromkeys(names)
        if name and names.count(name) > 1
    ]
    lines += (
        [f"the same name twice, so that none of them can be mapped; give each its own: {', '.join(twice)}"]
        if twice
        else []
    )
    wanted = [name for name in numeric if names.count(name) == 1]
    signals = [name for name in wanted if not is_time_name(name)]
    if not signals:
        examples = f" ({', '.join(others[:6] + twice)})" if others or twice else ""
        raise ValueError(
            f"{path}: none of its {len(columns)} columns holds numbers beside the time{examples}; "
            "write numbers without units, with one decimal mark, and a name for each column"
        )
    reader: Callable = read_csv if kind == "csv" else read_parquet
    try:
        group, notes = reader(path, signals, "")
    except ValueError as error:
        if "no column is called like a time" not in str(error):
            raise
        group, notes = reader(path, wanted, "every 1.0 s")
        notes.append(Note("clock", "", 1, _NO_TIME))
    return lines, [(group, "")], {column.name: column.unit for column in columns}, notes


def _mcap(path: Path) -> tuple[list[str], list[tuple[Columns, str]], dict[str, str], list[Note]]:
    by_name = topics(path)
    lines, groups, units, notes = [f"{len(by_name)} topics"], [], {}, []
    bare = [field for topic in by_name.values() for field in topic.fields]
    for topic in by_name.values():
        schemas = sorted(
            {f"{channel.encoding}, {channel.schema_name or 'no schema'}" for channel in topic.channels}
        )
        content = (
            f"cannot be read: {topic.unreadable}"
            if topic.unreadable
            else f"{len(topic.fields)} numbers"
            if topic.fields
            else "no numbers"
        )
        lines.append(f"  {topic.name}: {topic.count} messages, {'; '.join(schemas)}, {content}")
        if topic.fields and topic.count:
            group, more = _topic(path, topic)
            notes += [note for note in more if note not in notes]
            if group is not None:
                groups.append(
                    (group, "" if all(bare.count(field) == 1 for field in topic.fields) else f"{topic.name}:")
                )
                for channel in topic.channels:
                    units |= {
                        key[: -len(".unit")]: unit
                        for key, unit in channel.metadata.items()
                        if key.endswith(".unit")
                    }
    return lines, groups, units, notes


def _topic(path: Path, topic: Topic) -> tuple[Columns | None, list[Note]]:
    shown = topic.fields[:MOST_FIELDS]
    notes = [
        Note(
            "fields",
            "",
            len(topic.fields),
            f"{topic.name} has {len(topic.fields)} numbers; the first {MOST_FIELDS} are shown",
        )
    ]
    try:
        columns, places, _, more = mcap_columns(path, [f"{topic.name}:{field}" for field in shown], "")
    except ValueError as error:
        return None, [Note("unreadable", "", topic.count, str(error))]
    values = {field: columns[0].values[field] for _, field in places.values()}
    return columns[0]._replace(values=values), (notes if len(shown) < len(topic.fields) else []) + more


# ---- clocks and ranges


def _clock(path: Path, group: Columns) -> list[str]:
    count = len(group.time)
    try:
        check_clock(path, group)
    except ValueError as error:
        return [f"{group.name}: {count} samples", f"  {error}"]
    if count < 2:
        return [f"{group.name}: {count} sample"]
    time = group.time / 1e9 if group.time.dtype == np.int64 else group.time
    time = time - time[0]
    limit = GAP_INTERVALS * float(np.median(np.diff(time)))
    jitter = intervals(time, limit)
    gaps = np.flatnonzero(np.diff(time) > limit)
    line = (
        f"{group.name}: {count} samples in {time[-1]:.6g} s, "
        f"every {jitter.interval_s:.6g} s ({1 / jitter.interval_s:.4g} per second)"
    )
    timing = f"  jitter {jitter.std_s:.2g} s (standard), {jitter.max_s:.2g} s (largest)"
    if len(gaps):
        longest = gaps[np.argmax(np.diff(time)[gaps])]
        timing += (
            f"; {len(gaps)} gaps beyond {limit:.3g} s, "
            f"the longest {np.diff(time)[longest]:.4g} s at {time[longest]:.6g} s"
        )
    else:
        timing += f"; no gap beyond {limit:.3g} s"
    return [line, timing]


def _range(values: np.ndarray) -> str:
    finite = values[np.isfinite(values)]
    lost = len(values) - len(finite)
    missing = f", {lost} missing" if lost else ""
    if not len(finite):
        return f"no value{missing}"
    if np.ptp(finite) == 0:
        return f"constant {finite[0]:g}{missing}"
    step = quantisation_step(finite)
    levels = len(np.unique(finite))
    steps = f", {levels} levels" if levels <= 12 else f", steps of {step:.3g}" if step else ""
    return f"{finite.min():g} to {finite.max():g}, median {np.median(finite):g}{steps}{missing}"


# ---- the proposal


def _proposal(signals: Sequence[_Signal], groups: Sequence[tuple[Columns, str]]) -> list[str]:
    """YAML for `ingest.mapping` and `plant`, guessed from names, units and ranges."""
    taken = [signal._replace(role=_role(signal)) for signal in signals]
    how = "names and ranges"
    if not any(signal.role in ("input", "output") for signal in taken):
        taken, how = (
            [signal._replace(role=_behaviour(signal)) for signal in signals],
            "the values alone: look at each line",
        )
    mapping, inputs, outputs, names = [], [], [], set()
    for signal in taken:
        if signal.role not in ("input", "output"):
            continue
        name = _name(signal, names)
        unit, scale, offset = _conversion(signal)
        mapping.append(
            f"    {name}: {{source: {_yaml(signal.source)}, unit: {unit}, scale: {scale!r}, "
            f"offset: {offset!r}}}"
        )
        ours = signal.values[np.isfinite(signal.values)] * scale + offset
        if signal.role == "input":
            high = 100 if ours.max() <= 100 else int(np.ceil(ours.max()))
            inputs.append(
                f"    - {{name: {name}, unit: {unit}, low: {min(0, int(np.floor(ours.min())))}, "
                f"high: {high}}}"
            )
        else:
            outputs.append(
                f"    - {{name: {name}, unit: {unit}, reference: {float(np.round(np.median(ours))) + 0.0!r}}}"
            )
    if not mapping:
        return ["# no column looks like an input or an output of the machine; write the mapping by hand"]
    left = [signal.source for signal in taken if signal.role == "set-point"]
    lines = [f"# a proposal from {how}", "ingest:", "  mapping:", *mapping]
    lines += [f"# set-points, which a plant's model has no use for: {', '.join(left)}"] if left else []
    lines += (
        [
            "# nothing looks like a heater or a motor: map the inputs by hand, "
            "a plant cannot be identified without"
        ]
        if not inputs
        else []
    )
    lines += [
        "plant:",
        "  inputs:" if inputs else "  inputs: []",
        *inputs,
        "  outputs:" if outputs else "  outputs: []",
        *outputs,
    ]
    return [*lines, f"  sample_time_s: {_sample_time(groups)!r}"]


def _bare(source: str) -> str:
    return source.rpartition(":")[2].strip().casefold()


def _role(signal: _Signal) -> str:
    name, unit = _bare(signal.source), signal.unit.casefold()
    finite = signal.values[np.isfinite(signal.values)]
    if re.search(_STAMP, name) or not len(finite) or np.ptp(finite) == 0:
        return ""
    if re.search(_SET_POINT, name):
        return "set-point"
    power = re.search(r"duty|pwm|power|pct|%", name)
    warm = not power and (
        re.search(_SURELY_TEMPERATURE, name) or (re.search(_TEMPERATURE, name) and "heater" not in name)
    )
    if warm or unit in ("degc", "°c", "k", "°f", "degf"):
        return "output"
    return "input" if unit in ("%", "percent") or re.search(_INPUT, name) else ""


def _behaviour(signal: _Signal) -> str:
    """The role by the values alone. Commands rest and jump between few levels; measurements do neither. A
    counter has no role."""
    finite = signal.values[np.isfinite(signal.values)]
    if (
        len(finite) < 2
        or np.ptp(finite) == 0
        or np.ptp(np.diff(finite)) == 0
        or re.search(_STAMP, _bare(signal.source))
    ):
        return ""
    return (
        "input"
        if len(np.unique(np.round(finite, 1))) <= max(10, len(finite) // 100)
        and not quantisation_step(finite) < 0.1
        else "output"
    )


def _name(signal: _Signal, names: set[str]) -> str:
    """heater_1, temperature_1, ...; a motor or fan keeps its own name in letters, digits and _."""
    bare = _bare(signal.source)
    own = re.sub(r"\W+", "_", bare, flags=re.ASCII).strip("_")
    number = re.search(r"\d+", bare)
    if re.search(_MOVER, bare):
        base = own if re.match(r"[a-z]", own) else f"motor_{own}"
    else:
        base = f"{'heater' if signal.role == 'input' else 'temperature'}_{number[0] if number else 1}"
    name, i = base, 1
    while name in names:
        i += 1
        name = f"{re.sub(r'_[0-9]+$', '', base)}_{i}"
    names.add(name)
    return name


def _conversion(signal: _Signal) -> tuple[str, float, float]:
    bare, unit = _bare(signal.source), signal.unit.casefold()
    finite = signal.values[np.isfinite(signal.values)]
    low, high = finite.min(), finite.max()
    conversion = next(
        (ours for pattern, ours in _UNITS if re.search(pattern, bare) or re.search(rf"^{pattern}$", unit)),
        None,
    )
    if conversion is None and unit in ("k", "f"):
        conversion = ("degC", 1.0, -273.15) if unit == "k" else ("degC", 0.555556, -17.7778)
    if signal.role == "input" and (conversion is None or conversion[0] == "percent"):
        if low >= 0 and high <= 1:
            return "percent", 100.0, 0.0
        integer = bool((finite == np.rint(finite)).all())
        full = next((top for top in (255, 1023, 4095) if 100 < high <= top and low >= 0 and integer), None)
        return "percent", float(f"{100 / full:.6g}") if full and conversion is None else 1.0, 0.0
    if conversion is None:
        return "degC", 1.0, -273.15 if ROOM_KELVIN[0] <= finite[0] <= ROOM_KELVIN[1] and low > 250 else 0.0
    return conversion


def _yaml(source: str) -> str:
    """A YAML scalar, quoted if it could be taken for anything else."""
    return (
        source
        if re.fullmatch(r"[A-Za-z_]\w*|/[\w/.:]*\w", source) and ": " not in source
        else json.dumps(source, ensure_ascii=False)
    )


def _sample_time(groups: Sequence[tuple[Columns, str]]) -> float:
    """The largest of the clocks' median intervals, to two digits."""
    medians = []
    for group, _ in groups:
        if len(group.time) > 1:
            steps = np.diff(group.time) / (1e9 if group.time.dtype == np.int64 else 1.0)
            medians.append(float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0)
    return float(f"{max(medians, default=1.0):.2g}")
