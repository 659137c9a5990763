"""A mapping and a plant proposed from the names, units and ranges of a recording's signals."""

import json
import math
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.recordings.formats import FileColumns
from pipeline.recordings.quality import ROOM_KELVIN, quantisation_step

# levels and steps are looked up in so many values of a signal
LOOKED_AT = 6000
# records of commands without names have 0.88 to 1.0, measurements of a dryer, a furnace, an evaporator and a
# kit 0.29 to 0.57
TWO_LEVELS = 0.7
FEWEST_ROWS = 20
# a clock's interval is that of so many samples
CLOCK_SAMPLES = 100_000
_SET_POINT = r"set.?point|target|reference|\bsp\b|_sp$|^sp_"
_TEMPERATURE = (
    r"temp|celsius|deg_?c|°c|hot.?end|nozzle|barrel|zone|\bbed\b|^bed|thermo|tool_?\d|chamber|"
    r"^[ty]$|^[ty]_?\d+|^t[_\[(]|_[ckf]$|[\[(][ckf°]"
)
# a temperature whatever else the name says, such as heater_bed.temperature
_SURELY_TEMPERATURE = r"temperature|celsius|deg_?c|°c|(?<!set)(^|[\s._])(temp|actual)$"
_HEATING = r"duty|pwm|power|heat|pct|percent|%"
_INPUT = r"heat|duty|pwm|power|percent|pct|%|^q_?\d|^u_?\d*$|motor|screw|rpm|fan|voltage|current"
_MOVER = r"motor|screw|rpm|fan"
# an input of such a name can only warm; Klipper calls the hot end's heater "extruder"
_HEATER = r"heat|hot.?end|nozzle|barrel|(^|[\s._])bed|^extruder.*\.pwm$"
_COOLER = r"cool|chill|exchang|fan"
_STAMP = r"(^|\.)(sec|secs|seconds|nsec|nsecs|nanosec|nanos|seq|sequence)$|class$|(^|_)(id|num|index)$"
# times and counts of a machine's own: an event counter, a time stamp in any unit
_COUNTER = (
    r"time.?stamp|(^|[._])(stamp|time|clock|uptime|millis|micros|ticks?|counter|epoch)(_?(s|ms|us|ns))?$"
)
_STATUS = (
    r"e[\s_-]?stop|emergency|alarm|fault|error|status|(^|[._\s])(state|mode|ok|ready)$|enabled?|door|lamp|"
    r"interlock|warning|running|connected|valid|busy|homed|watchdog|heartbeat"
)
_TELLING = re.compile(rf"{_SET_POINT}|{_TEMPERATURE}|{_INPUT}")
_SILENT = re.compile(rf"{_STAMP}|{_COUNTER}|{_STATUS}")
# fields that say nothing: their topic's name does
_BARE_FIELDS = ("data", "value", "val", "reading", "measurement", "float", "double")
_COMMON_WORDS = {
    "temp", "temperature", "actual", "pwm", "duty", "power", "percent", "pct", "value", "data", "heater",
    "measured", "celsius", "degc", "deg", "c", "k", "f", "val", "sensor", "heat", "output", "cycle",
}  # fmt: skip
# unit that a name carries -> what makes our unit of it
_UNITS = (
    (r"(pct|percent|%)", ("percent", 1.0, 0.0)),
    (r"(deg_?c|°c|celsius|[_\[(]c[\])]?$)", ("degC", 1.0, 0.0)),
    (r"(kelvin|[_\[(]k[\])]?$)", ("degC", 1.0, -273.15)),
    (r"(deg_?f|°f|fahrenheit|[_\[(]f[\])]?$)", ("degC", 0.555556, -17.7778)),
)


class RecordedSignal(NamedTuple):
    """A column: its source, the unit that the file gives, its finite numbers, the limits that the file gives,
    and its role in the proposal."""

    source: str
    unit: str
    values: np.ndarray
    limits: tuple[float, float] | None = None
    role: str = ""


class Proposed(NamedTuple):
    """A signal of the plant, "input" or "output", with its source and conversion. A limit or a reference that
    nothing tells is None. `heats`: its name says that it can only warm."""

    name: str
    role: str
    source: str
    unit: str
    scale: float
    offset: float
    low: float | None
    high: float | None
    reference: float | None
    heats: bool = False


class Proposal(NamedTuple):
    """What `ingest.mapping` and `plant` could be; `how` says what it was guessed from, `time` is ingest.time,
    and the rest was left out."""

    signals: list[Proposed]
    how: str
    time: str
    sample_time_s: float
    set_points: list[str]
    beside: list[str]


def propose(
    signals: Sequence[RecordedSignal], groups: Sequence[tuple[FileColumns, str]], time: str
) -> Proposal:
    """The proposal for the signals of a recording, which have the clocks of `groups`."""
    taken = [signal._replace(role=_role(signal)) for signal in signals]
    how = "names and ranges"
    if not any(signal.role in ("input", "output") for signal in taken):
        taken = [signal._replace(role=_behaviour(signal)) for signal in signals]
        how = "the values alone: look at each line"
        if not all(_is_switch(signal) for signal in taken if signal.role == "input"):
            taken = [s._replace(role="") if s.role == "input" and _is_switch(s) else s for s in taken]
    beside = _beside(taken)
    targets = {_stem(s.source, _SET_POINT): s for s in taken if s.role == "set-point"}
    names: set[str] = set()
    proposed, guessed = [], how != "names and ranges"
    for signal in taken:
        if signal.role in ("input", "output") and signal.source not in beside:
            target = targets.get(_stem(signal.source, r"temperature|temp|actual|measured"))
            proposed.append(_proposed(signal, target, names, guessed=guessed))
    set_points = [signal.source for signal in taken if signal.role == "set-point"]
    return Proposal(proposed, how, time, _sample_time(groups), set_points, beside)


def yaml_lines(proposal: Proposal) -> list[str]:
    """The proposal as YAML to paste under `ingest` and `plant`."""
    if not proposal.signals:
        return ["# no column looks like an input or an output of the machine; write the mapping by hand"]
    inputs, outputs = plant_lines(proposal)
    lines = [f"# a proposal from {proposal.how}", "ingest:"]
    if proposal.time:
        lines.append(
            f"  time: {proposal.time}    # write the sample time here and at sample_time_s below, "
            "for the file does not say it; or the name of a column"
        )
    lines += ["  mapping:", *(f"    {line}" for line in mapping_lines(proposal))]
    if proposal.set_points:
        shown = ", ".join(proposal.set_points)
        lines.append(f"# set-points, which a plant's model has no use for: {shown}")
    if proposal.beside:
        lines.append(f"# temperatures that nothing heats, left out: {', '.join(proposal.beside)}")
    if not inputs:
        lines.append(
            "# nothing looks like a heater or a motor: map the inputs by hand, "
            "a plant cannot be identified without; if the duty is not in the recording, record it"
        )
    lines += ["plant:", "  inputs:" if inputs else "  inputs: []", *(f"    - {line}" for line in inputs)]
    lines += ["  outputs:" if outputs else "  outputs: []", *(f"    - {line}" for line in outputs)]
    if any(signal.low is None for signal in proposal.signals):
        lines.append("  # low and high of an output: between which °C the machine must stay; fill them in")
    return [*lines, f"  sample_time_s: {proposal.sample_time_s!r}"]


def mapping_lines(proposal: Proposal) -> list[str]:
    """`ingest.mapping`, a line a signal."""
    return [
        f"{s.name}: {{source: {_yaml(s.source)}, unit: {s.unit}, scale: {s.scale!r}, offset: {s.offset!r}}}"
        for s in proposal.signals
    ]


def plant_lines(proposal: Proposal) -> tuple[list[str], list[str]]:
    """`plant.inputs` and `plant.outputs`, a line a signal."""
    inputs = [
        f"{{name: {s.name}, unit: {s.unit}, low: {_number(s.low)}, high: {_number(s.high)}"
        + (", heats: true}" if s.heats else "}")
        for s in proposal.signals
        if s.role == "input"
    ]
    outputs = [
        f"{{name: {s.name}, unit: {s.unit}, reference: {s.reference!r}, low: {_number(s.low)}, "
        f"high: {_number(s.high)}}}"
        for s in proposal.signals
        if s.role == "output"
    ]
    return inputs, outputs


def _number(value: float | None) -> str:
    return "null" if value is None else f"{value:.10g}"


# ---- roles


def words(source: str) -> str:
    """What names a signal: its field, or its topic's last part where the field says nothing ("data")."""
    topic, _, field = source.rpartition(":")
    field = field.strip().casefold()
    if field in _BARE_FIELDS and topic:
        parts = [part for part in topic.casefold().split("/") if part]
        return next((part for part in reversed(parts) if part not in _BARE_FIELDS), field)
    return field


def telling(sources: Sequence[str], most: int) -> list[str]:
    """At most `most` of the sources, in their order: first those whose names tell a heater, a motor, a
    temperature or a set-point."""
    if len(sources) <= most:
        return list(sources)
    tells = [bool(_TELLING.search(name := words(s)) and not _SILENT.search(name)) for s in sources]
    chosen = sorted(range(len(sources)), key=lambda i: (not tells[i], i))[:most]
    return [sources[i] for i in sorted(chosen)]


def has_bare_field(fields: Sequence[str]) -> bool:
    """Whether one of a topic's fields says nothing without the topic."""
    return any(field.casefold() in _BARE_FIELDS for field in fields)


def sampled(values: np.ndarray) -> np.ndarray:
    """At most LOOKED_AT of the values, from one end to the other."""
    return values[:: max(1, len(values) // LOOKED_AT)]


def _is_switch(signal: RecordedSignal) -> bool:
    """Whether a signal has the values 0 and 1 alone."""
    few = sampled(signal.values)
    return bool(((few == 0) | (few == 1)).all()) and bool(np.isin(signal.values, (0.0, 1.0)).all())


def _has_no_role(signal: RecordedSignal) -> bool:
    name, finite = words(signal.source), signal.values
    return bool(
        re.search(_STAMP, name)
        or re.search(_COUNTER, name)
        or re.search(_STATUS, name)
        or not len(finite)
        or (np.ptp(sampled(finite)) == 0 and np.ptp(finite) == 0)
    )


def _role(signal: RecordedSignal) -> str:
    name, unit = words(signal.source), signal.unit.casefold()
    if _has_no_role(signal):
        return ""
    if re.search(_SET_POINT, name):
        return "set-point"
    power = re.search(r"duty|pwm|power|pct|%", name)
    warm = not power and (
        re.search(_SURELY_TEMPERATURE, name) or (re.search(_TEMPERATURE, name) and "heater" not in name)
    )
    if _is_switch(signal) and not re.search(_HEATING, name):
        return "input" if re.search(r"^q_?\d|^u_?\d*$", name) else ""
    if warm or unit in ("degc", "°c", "k", "°f", "degf"):
        return "output"
    return "input" if unit in ("%", "percent") or re.search(_INPUT, name) else ""


def _behaviour(signal: RecordedSignal) -> str:
    """The role by the values alone. Commands rest and jump between few levels, or stay near two of them;
    measurements do neither. A counter has no role, nor has a table of a few rows."""
    finite = signal.values
    if _has_no_role(signal) or len(finite) < FEWEST_ROWS or np.ptp(np.diff(finite)) < 1e-9 * np.ptp(finite):
        return ""
    if _bimodality(sampled(finite)) > TWO_LEVELS:
        return "input"
    few = len(np.unique(np.round(sampled(finite), 1))) <= max(10, min(len(finite), LOOKED_AT) // 100)
    return "input" if few and not quantisation_step(sampled(finite)) < 0.1 else "output"


def _bimodality(values: np.ndarray) -> float:
    """(skewness^2 + 1) / kurtosis: 1 for two levels, 5/9 for a uniform distribution, 1/3 for a normal one
    (Pearson)."""
    values = values / np.abs(values).max()
    spread = values.std()
    if not spread > 0:
        return 0.0
    z = (values - values.mean()) / spread
    return float((np.mean(z**3) ** 2 + 1) / np.mean(z**4))


def _beside(taken: Sequence[RecordedSignal]) -> list[str]:
    """Temperatures of devices that have no duty, where others of the same recording have one: the board's own
    sensor beside heaters. Names are "device.temp" and "device.pwm"."""
    heated = {s.source.rpartition(".")[0] for s in taken if s.source.endswith(".pwm")}
    return [
        s.source
        for s in taken
        if heated
        and s.role == "output"
        and s.source.endswith(".temp")
        and s.source.rpartition(".")[0] not in heated
    ]


def _stem(source: str, pattern: str) -> str:
    """What is left of a name without the words that tell a temperature from its set-point."""
    return re.sub(r"[\W_]+", "", re.sub(pattern, "", source.casefold()))


# ---- names, units, limits


def _proposed(
    signal: RecordedSignal, target: RecordedSignal | None, names: set[str], *, guessed: bool
) -> Proposed:
    unit, scale, offset = _conversion(signal)
    low = high = reference = None
    if signal.limits is not None and np.isfinite(signal.limits).all():
        low, high = (limit * scale + offset for limit in signal.limits)
    elif signal.role == "input":
        low, high = _input_limits(signal.values * scale + offset, guessed=guessed and scale == 1.0)
    if signal.role == "output":
        reference = _reference(sampled(signal.values) * scale + offset, target, scale, offset)
    bare = words(signal.source)
    heats = signal.role == "input" and bool(re.search(_HEATER, bare)) and not re.search(_COOLER, bare)
    name = _name(signal, names)
    return Proposed(name, signal.role, signal.source, unit, scale, offset, low, high, reference, heats)


def _input_limits(ours: np.ndarray, *, guessed: bool) -> tuple[float, float]:
    """0 to 100 percent, or from below zero where it was recorded there. Of a `guessed` input nothing says
    that it is percent: the whole numbers around what was recorded, so that no experiment asks for more."""
    low, high = max(-100.0, float(np.floor(ours.min()))), min(100.0, float(np.ceil(ours.max())))
    return (low, high) if guessed else (min(0.0, low), 100.0)


def _reference(ours: np.ndarray, target: RecordedSignal | None, scale: float, offset: float) -> float:
    """The set-point that was held longest, or the median where there is none."""
    held = target.values if target is not None else np.empty(0)
    held = held[held > 0]
    if len(held):
        levels, counts = np.unique(held, return_counts=True)
        return float(np.round(levels[counts.argmax()] * scale + offset, 1)) + 0.0
    return float(np.round(np.median(ours))) + 0.0


def _name(signal: RecordedSignal, names: set[str]) -> str:
    """heater_1, temperature_bed, ...; a motor or fan keeps its own name in letters, digits and _."""
    bare = words(signal.source)
    own = re.sub(r"\W+", "_", bare, flags=re.ASCII).strip("_")
    topic = signal.source.rpartition(":")[0].rpartition("/")[2].casefold()
    number = re.search(r"\d+", bare) or re.search(r"\d+", topic)
    kind = "heater" if signal.role == "input" else "temperature"
    if re.search(_MOVER, bare):
        base = own if re.match(r"[a-z]", own) else f"motor_{own}"
    elif number:
        base = f"{kind}_{number[0]}"
    else:
        rest = [word for word in re.findall(r"[a-z]{2,}", f"{topic} {bare}") if word not in _COMMON_WORDS]
        base = "_".join([kind, *dict.fromkeys(rest)])[:40] if rest else f"{kind}_1"
    name, i = base, 1
    while name in names:
        i += 1
        name = f"{re.sub(r'_[0-9]+$', '', base)}_{i}"
    names.add(name)
    return name


def _conversion(signal: RecordedSignal) -> tuple[str, float, float]:
    bare, unit = words(signal.source), signal.unit.casefold()
    finite = signal.values
    low, high = finite.min(), finite.max()
    conversion = next(
        (ours for pattern, ours in _UNITS if re.search(pattern, bare) or re.search(rf"^{pattern}$", unit)),
        None,
    )
    if conversion is None and unit in ("k", "f"):
        conversion = ("degC", 1.0, -273.15) if unit == "k" else ("degC", 0.555556, -17.7778)
    if signal.role == "input" and (conversion is None or conversion[0] == "percent"):
        if low >= 0 and high <= 1 and signal.limits is None:
            return "percent", 100.0, 0.0
        integer = high > 100 and bool((finite == np.rint(finite)).all())
        full = next((top for top in (255, 1023, 4095) if 100 < high <= top and low >= 0 and integer), None)
        if conversion is None and full is None and max(high, -low) > 100:
            full = max(high, -low)  # rpm, mV: percent of the largest
        return "percent", _to_percent(full) if full and conversion is None else 1.0, 0.0
    if conversion is None:
        return "degC", 1.0, -273.15 if ROOM_KELVIN[0] <= finite[0] <= ROOM_KELVIN[1] and low > 250 else 0.0
    return conversion


def _to_percent(full: float) -> float:
    """100 / full to six digits, rounded down: the largest recorded value stays within 100 %."""
    unit = 10.0 ** (math.floor(math.log10(100 / full)) - 5)
    return float(f"{math.floor(100 / full / unit) * unit:.6g}")


def _yaml(source: str) -> str:
    """A YAML scalar, quoted if it could be taken for anything else."""
    return (
        source
        if re.fullmatch(r"[A-Za-z_]\w*|/[\w/.:]*\w", source) and ": " not in source
        else json.dumps(source, ensure_ascii=False)
    )


def _sample_time(groups: Sequence[tuple[FileColumns, str]]) -> float:
    """The largest of the clocks' median intervals, to two digits."""
    medians = []
    for group, _ in groups:
        if len(group.time) > 1:
            steps = np.diff(group.time[:CLOCK_SAMPLES]) / (1e9 if group.time.dtype == np.int64 else 1.0)
            medians.append(float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0)
    return float(f"{max(medians, default=1.0):.2g}")
