"""Proposes a mapping and a plant from the names, units and ranges of a recording's signals."""

import json
import math
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.recordings.formats import FileColumns
from pipeline.recordings.quality import ROOM_KELVIN, quantisation_step
from pipeline.recordings.signal_names import (
    ACTUAL,
    COMMAND,
    COOLER,
    DEVICE,
    DUTY,
    ELECTRIC,
    HEATER,
    MOVER,
    OUTPUT,
    PLACE,
    QUANTITY,
    ROOM,
    SET_POINT,
    SETTING,
    SPEED,
    TEMPERATURE,
    Name,
    any_of,
    loop_letter,
    read_name,
    says,
    split,
)

# levels and steps are searched in about this many values of a signal
LOOKED_AT = 6000
# records of commands without names have 0.88 to 1.0, measurements of a dryer, a furnace, an evaporator and a
# kit 0.29 to 0.57
TWO_LEVELS = 0.7
FEWEST_ROWS = 20
# a clock's interval is taken from at most this many samples
CLOCK_SAMPLES = 100_000
_STAMP = r"(^|\.)(sec|secs|seconds|nsec|nsecs|nanosec|nanos|seq|sequence)$|class$|(^|_)(id|num|index)$"
# a machine's own times and counts: an event counter, a time stamp in any unit
_COUNTER = (
    r"time.?stamp|(^|[._])(stamp|time|clock|uptime|millis|micros|ticks?|counter|epoch)(_?(s|ms|us|ns))?$"
)
_STATUS = (
    r"e[\s_-]?stop|emergency|alarm|fault|error|status[^.]*$|(^|[._\s])(state|mode|ok|ready)$|enabled?|door|lamp|"
    r"interlock|warning|running|connected|valid|busy|homed|watchdog|heartbeat"
)
_SILENT = re.compile(rf"{_STAMP}|{_COUNTER}|{_STATUS}")
# field names that say nothing; the topic's name is used instead
_BARE_FIELDS = ("data", "value", "val", "reading", "measurement", "float", "double")
_COMMON_WORDS = {
    "temp", "temperature", "actual", "pwm", "duty", "power", "percent", "pct", "value", "data", "heater",
    "measured", "celsius", "degc", "deg", "c", "k", "f", "val", "sensor", "heat", "output", "cycle",
}  # fmt: skip
_TIMES = ("temps", "heure", "hora", "ora", "fecha")
# an input with such a name can only heat; Klipper calls the hot end's heater "extruder"
_HEATED = re.compile(r"\b(hot ?end|nozzle|barrel|bed)\b|^extruder.* pwm$")
_TAKEN_NAMES = ("recording", "segment", "time_s")  # columns of the table of the record
_TELLING = any_of(SET_POINT, TEMPERATURE, HEATER, DUTY, OUTPUT, PLACE, SPEED, MOVER, ACTUAL)
# unit -> scale and offset to °C
_CELSIUS = {"degC": (1.0, 0.0), "K": (1.0, -273.15), "degF": (0.555556, -17.7778)}
# an owner's limit is this far below the temperature at which the firmware switches everything off
BELOW_CUT_OFF_DEGC = 15.0
MOST_DISTURBANCES = 16
# a set-point is constant in more than this share of its steps, and has few levels compared with its measured
# signal
RESTING_SHARE, MORE_LEVELS = 0.95, 4


class RecordedSignal(NamedTuple):
    """A column: its source, the unit and the limits that the file gives, its finite numbers, and its role in
    the proposal."""

    source: str
    unit: str
    values: np.ndarray
    limits: tuple[float, float] | None = None
    role: str = ""

    @property
    def name(self) -> Name:
        return read_name(telling_name(self.source), self.unit)


class Proposed(NamedTuple):
    """A signal of the plant with its source and conversion. `role`: "input", "disturbance" or "output". A
    limit or a reference is None if the recording does not give it. `heats`: its name says that it can only
    heat. `set_point`: the column of an output's set-point, "" for none. `cut_off`: temperature in °C at which
    the firmware switches off, None if the file does not give it."""

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
    set_point: str = ""
    cut_off: float | None = None


class Proposal(NamedTuple):
    """A proposal for `ingest.mapping` and `plant`. `how`: what it was guessed from; `time`: ingest.time;
    `sample_time_s`: from the recording's clock; `set_points`: those of no output; `unheated`: temperatures
    that nothing heats."""

    signals: list[Proposed]
    how: str
    time: str
    sample_time_s: float
    set_points: list[str]
    unheated: list[str]


def propose(
    signals: Sequence[RecordedSignal], groups: Sequence[tuple[FileColumns, str]], time: str
) -> Proposal:
    """Returns the proposal for the signals of a recording, which have the clocks of `groups`."""
    signals, how = _with_roles(signals)
    targets = _targets(signals)
    used = {target.source for target in targets.values()}
    prefixes = {role: _common_words(signals, role) for role in ("input", "disturbance", "output")}
    names: set[str] = set()
    proposed = []
    for signal in signals:
        if signal.role in prefixes:
            name = _name(signal, prefixes[signal.role], names)
            guessed = how != "names and ranges"
            proposed.append(_propose_signal(signal, name, targets.get(signal.source), guessed=guessed))
    set_points = [s.source for s in signals if s.role == "set-point" and s.source not in used]
    unheated = [s.source for s in signals if s.role == "beside"]
    return Proposal(proposed, how, time, _sample_time(groups), set_points, unheated)


def yaml_lines(proposal: Proposal) -> list[str]:
    """Returns the proposal as lines of YAML to paste under `ingest` and `plant`."""
    if not proposal.signals:
        return ["# no column looks like an input or an output of the machine; write the mapping by hand"]
    inputs, disturbances, outputs = plant_lines(proposal)
    lines = [f"# a proposal from {proposal.how}", "ingest:"]
    if proposal.time:
        lines.append(
            f"  time: {proposal.time}    # write the sample time here and at sample_time_s below, "
            "for the file does not say it; or the name of a column"
        )
    lines += ["  mapping:", *(f"    {line}" for line in mapping_lines(proposal))]
    if proposal.set_points:
        lines.append(f"# set-points of no output of the plant, left out: {', '.join(proposal.set_points)}")
    if proposal.unheated:
        lines.append(f"# temperatures that nothing heats, left out: {', '.join(proposal.unheated)}")
    if not inputs:
        lines.append(
            "# nothing looks like a heater or a motor: map the inputs by hand, "
            "a plant cannot be identified without; if the duty is not in the recording, record it"
        )
    lines += ["plant:", "  inputs:" if inputs else "  inputs: []", *(f"    - {line}" for line in inputs)]
    if disturbances:
        lines.append(
            "  disturbances:    # recorded, and moved by no controller; move to inputs what one moves"
        )
        lines += [f"    - {line}" for line in disturbances]
    lines += ["  outputs:" if outputs else "  outputs: []", *(f"    - {line}" for line in outputs)]
    if any(signal.cut_off is not None for signal in proposal.signals):
        lines.append(f"  # high is {BELOW_CUT_OFF_DEGC:g} °C below the firmware's cut-off (max_temp)")
    if any(signal.role == "output" and signal.low is None for signal in proposal.signals):
        lines.append("  # low and high of an output: between which °C the machine must stay; fill them in")
    lines.append("  # the file's own clock; init takes the multiple of it that suits machine and firmware")
    return [*lines, f"  sample_time_s: {proposal.sample_time_s!r}"]


def mapping_lines(proposal: Proposal) -> list[str]:
    """Returns the lines of `ingest.mapping`, one line per signal."""
    return [
        f"{s.name}: {{source: {_yaml(s.source)}, "
        + (f"set_point: {_yaml(s.set_point)}, " if s.set_point else "")
        + f"unit: {_yaml(s.unit)}, scale: {s.scale!r}, offset: {s.offset!r}}}"
        for s in proposal.signals
    ]


def plant_lines(proposal: Proposal) -> tuple[list[str], list[str], list[str]]:
    """Returns the lines of `plant.inputs`, `plant.disturbances` and `plant.outputs`, one line per signal."""
    inputs = [
        f"{{name: {s.name}, unit: {s.unit}, low: {_number(s.low)}, high: {_number(s.high)}"
        + (", heats: true}" if s.heats else "}")
        for s in proposal.signals
        if s.role == "input"
    ]
    disturbances = [
        f"{{name: {s.name}, unit: {_yaml(s.unit)}}}" for s in proposal.signals if s.role == "disturbance"
    ]
    outputs = [
        f"{{name: {s.name}, unit: {s.unit}, reference: {s.reference!r}, low: {_number(s.low)}, "
        f"high: {_number(s.high)}}}"
        for s in proposal.signals
        if s.role == "output"
    ]
    return inputs, disturbances, outputs


def _number(value: float | None) -> str:
    return "null" if value is None else f"{value:.10g}"


# ---- roles


def telling_name(source: str) -> str:
    """Returns the words that name a signal: its field or, if the field says nothing ("data"), its topic's
    last part. The index of a topic's field counts from 1: "/zone_temperature:data[0]" is
    zone_temperature_1."""
    topic, _, field = source.rpartition(":")
    name, index = field.strip(), None
    if topic.startswith("/") and (index := re.search(r"\[(\d+)\]$", name)):
        name = name[: index.start()]
    if name.casefold() in _BARE_FIELDS and topic:
        parts = [part for part in topic.split("/") if part]
        name = next((part for part in reversed(parts) if part.casefold() not in _BARE_FIELDS), name)
    return f"{name}_{int(index[1]) + 1}" if index else name


def telling(sources: Sequence[str], limit: int) -> list[str]:
    """Returns at most `limit` of the sources, in their order. Sources with names that suggest a heater, a
    motor, a temperature or a set-point are taken first."""
    if len(sources) <= limit:
        return list(sources)
    tells = [_is_telling(source) for source in sources]
    chosen = sorted(range(len(sources)), key=lambda i: (not tells[i], i))[:limit]
    return [sources[i] for i in sorted(chosen)]


def _is_telling(source: str) -> bool:
    text = telling_name(source)
    name = read_name(text)
    return (bool(name.kind) or says(_TELLING, name.words)) and not _SILENT.search(text.casefold())


def has_bare_field(fields: Sequence[str]) -> bool:
    """Returns whether one of a topic's fields says nothing without the topic's name."""
    return any(field.casefold() in _BARE_FIELDS for field in fields)


def sample(values: np.ndarray) -> np.ndarray:
    """Returns every k-th of the values, with k so large that fewer than twice LOOKED_AT remain."""
    return values[:: max(1, len(values) // LOOKED_AT)]


def _is_switch(signal: RecordedSignal) -> bool:
    """Returns whether a signal has only the values 0 and 1."""
    few = sample(signal.values)
    return bool(((few == 0) | (few == 1)).all()) and bool(np.isin(signal.values, (0.0, 1.0)).all())


def _is_constant(signal: RecordedSignal) -> bool:
    values = signal.values
    return not len(values) or bool(np.ptp(sample(values)) == 0 and np.ptp(values) == 0)


def _with_roles(signals: Sequence[RecordedSignal]) -> tuple[list[RecordedSignal], str]:
    """Returns the signals with their roles, and what the roles were guessed from."""
    named = _with_commands_y([signal._replace(role=_role(signal)) for signal in signals])
    named = _without_hidden_set_points(named)
    roles = {signal.role for signal in named}
    # a heater's volts are its command if there is no other input; the room's temperature is an output if
    # there is no other
    if "input" not in roles:
        named = [s._replace(role="input") if s.role == "electric" else s for s in named]
    if "output" not in roles:
        named = [s._replace(role="output") if s.role == "disturbance" and _is_warm(s) else s for s in named]
    if {"input", "output"} & {signal.role for signal in named}:
        named = _without_strangers(_without_unheated(named))
        surplus = [s.source for s in named if s.role == "disturbance"][MOST_DISTURBANCES:]
        return [s._replace(role="") if s.source in surplus else s for s in named], "names and ranges"
    moving = [signal._replace(role=_behaviour(signal)) for signal in signals]
    if not all(_is_switch(signal) for signal in moving if signal.role == "input"):
        moving = [s._replace(role="") if s.role == "input" and _is_switch(s) else s for s in moving]
    return moving, "the values alone: look at each line"


def _with_commands_y(signals: Sequence[RecordedSignal]) -> Sequence[RecordedSignal]:
    """Returns the signals with Y1, Y2 as inputs, the controller's commands (DIN 19226), if there is a
    set-point and no other input. Otherwise y is a measured output."""
    roles = {signal.role for signal in signals}
    outputs = [signal for signal in signals if signal.role == "output"]
    commands = [
        signal.source
        for signal in outputs
        if re.search(r"^y( \d+)?$", read_name(telling_name(signal.source)).words)
        and signal.values.min() >= 0.0
        and signal.values.max() <= 100.0
    ]
    if "input" in roles or "set-point" not in roles or len(commands) == len(outputs):
        return signals
    return [s._replace(role="input") if s.source in commands else s for s in signals]


def _without_unheated(signals: Sequence[RecordedSignal]) -> list[RecordedSignal]:
    """Returns the signals with new roles for temperatures that nothing heats. If some devices of the
    recording have a duty, the temperatures of devices without one are sensors of the board ("beside"). A
    chamber without a heater is the air around the machine ("disturbance"). Names are "device.temp" and
    "device.pwm"."""
    heated = {s.source.rpartition(".")[0] for s in signals if s.source.endswith(".pwm")}
    chamber = {s.source for s in signals if "chamber" in split(s.source).split()}
    inputs = {s.source for s in signals if s.role == "input"}
    roles = {}
    for signal in signals:
        device, _, field = signal.source.rpartition(".")
        if inputs and not inputs & chamber and signal.source in chamber:
            roles[signal.source] = "disturbance"
        elif heated and field == "temp" and device not in heated:
            roles[signal.source] = "beside"
    return [s._replace(role=roles.get(s.source, s.role)) if s.role == "output" else s for s in signals]


def _without_strangers(signals: Sequence[RecordedSignal]) -> Sequence[RecordedSignal]:
    """Returns the signals; inputs that belong to no temperature become disturbances, for example the command
    of a drive among the commands of zones. An input belongs to an output with the same numbers or with one of
    its words. It also belongs if its name means a heater, a cooler or a place."""
    outputs = [(_numbers(s.source), _plain_words(s.source)) for s in signals if s.role == "output"]
    inputs = [s for s in signals if s.role == "input"]
    shared = set.intersection(*(_plain_words(s.source) for s in inputs)) if inputs else set()
    strangers = []
    for signal in inputs:
        numbers, words = _numbers(signal.source), _plain_words(signal.source) - shared
        belongs = any((numbers and numbers == own) or words & plain for own, plain in outputs)
        belongs = belongs or any(says(pattern, signal.name.words) for pattern in (COOLER, HEATER, PLACE))
        is_named = any(word.isalpha() and not _is_common(word) for word in words)
        if is_named and not belongs and signal.source != "motor":
            strangers.append(signal.source)
    if len(strangers) == len(inputs):
        return signals
    return [s._replace(role="disturbance") if s.source in strangers else s for s in signals]


def _is_warm(signal: RecordedSignal) -> bool:
    name = signal.name
    return name.kind in _CELSIUS or (not name.kind and says(TEMPERATURE, name.words))


def _role(signal: RecordedSignal) -> str:
    """Returns the role, from the words of the name, its unit and the range of its values: "set-point",
    "input", "electric" (an input if there is no other), "disturbance", "output", "beside" (a temperature that
    nothing heats) or ""."""
    text = telling_name(signal.source)
    if not len(signal.values) or _SILENT.search(text.casefold()):
        return ""
    if signal.source == "motor" and signal.unit == "percent":  # as our own files name the study's
        return "" if _is_constant(signal) else "input"
    role = _role_of_name(signal.name, signal)
    topic = signal.source.rpartition(":")[0]
    if role or not topic or says(SETTING, signal.name.words):
        return role
    return _role_of_name(read_name(f"{topic.rpartition('/')[2]} {text}", signal.unit), signal)


def _role_of_name(name: Name, signal: RecordedSignal) -> str:
    """Returns the role that the first matching rule gives."""
    words, kind, values = name.words, name.kind, signal.values
    low, high, is_constant = values.min(), values.max(), _is_constant(signal)
    says_heater, says_place = says(HEATER, words), says(PLACE, words)
    letter = loop_letter(words)
    warm = kind in _CELSIUS or (not kind and (says(TEMPERATURE, words) or words == "b"))  # Marlin's bed
    temperature = "disturbance" if says(ROOM, words) and not says_heater else "output"
    moves = says(SPEED, words) or (says(MOVER, words) and not says_heater and not says_place)
    duty = kind == "percent" or says(DUTY, words) or bool(re.search(r"\b[a-z\d]+ y$", words))
    duty = duty or (not warm and words.startswith("u "))
    # "current" is the present temperature: no heater of such machines takes 40 A
    electric = says(ELECTRIC, words) and not (re.search(r"\bcurrent$", words) and high > 40.0)
    # the output of a temperature's controller: TIC_1_Out, of 0 to 100
    in_percent = bool(low <= 0.0 and high <= 100.0)
    commands = says(OUTPUT, words) and (says_heater or says(COOLER, words) or in_percent)
    # signals that neither a word nor a unit calls a temperature
    symbol = re.search(r"^[qu]( \d+)?$", words)
    measured = says(ACTUAL, words) or bool(re.search(r"\b(x|current)$", words))
    converted = low == 0 and bool((values == np.rint(values)).all())  # whole numbers that rest at 0
    rules = (
        (says(SETTING, words) or words in _TIMES, ""),
        (warm and says(DEVICE, words), "" if is_constant else "beside"),
        (_is_set_point(words, warm), "set-point"),
        (is_constant or kind == "other" or (says(QUANTITY, words) and not warm) or letter in ("p", "l"), ""),
        (kind in _CELSIUS, temperature),
        (kind == "speed" or letter in ("s", "f"), "disturbance"),
        (kind == "electric" or electric, "" if moves else "electric"),
        (warm and not duty and not commands, temperature),
        (moves or (says(ROOM, words) and not duty), "disturbance"),
        (_is_switch(signal) and not duty and not says_heater, "input" if symbol else ""),
        (duty or symbol or (says(OUTPUT, words) and " " in words) or says(COMMAND, words), "input"),
        (says_heater and not measured and (high <= 110.0 or converted), "input"),
        (says_heater or measured or says_place or re.search(r"^y( \d+)?$", words), "output"),
        (says(COOLER, words), "input"),
    )
    return next((role for holds, role in rules if holds), "")


def _is_set_point(words: str, warm: bool) -> bool:
    """Returns whether the words mean a set-point: a word for it, the command of a temperature, w beside x and
    y (DIN 19226), or a tool's active or standby temperature (RepRapFirmware)."""
    heated = warm or says(HEATER, words) or says(PLACE, words)
    return (
        says(SET_POINT, words)
        or (warm and says(COMMAND, words) and not says(HEATER, words))
        or (bool(re.search(r"\d w$|^w \d+$", words)) and not says(HEATER, words))
        or (heated and bool(re.search(r"\b(active|standby)$", words)))
    )


def _behaviour(signal: RecordedSignal) -> str:
    """Returns the role from the values alone. Commands are often constant and jump between few levels, or
    stay near two levels; measurements do neither. A counter has no role, and neither does a table of a few
    rows."""
    finite = signal.values
    if (
        _SILENT.search(telling_name(signal.source).casefold())
        or _is_constant(signal)
        or len(finite) < FEWEST_ROWS
        or np.ptp(np.diff(finite)) < 1e-9 * np.ptp(finite)
    ):
        return ""
    if _bimodality(sample(finite)) > TWO_LEVELS:
        return "input"
    few = len(np.unique(np.round(sample(finite), 1))) <= max(10, min(len(finite), LOOKED_AT) // 100)
    return "input" if few and not quantisation_step(sample(finite)) < 0.1 else "output"


def _bimodality(values: np.ndarray) -> float:
    """Returns (skewness^2 + 1) / kurtosis: 1 for two levels, 5/9 for a uniform distribution, 1/3 for a normal
    one (Pearson)."""
    values = values / np.abs(values).max()
    spread = values.std()
    if not spread > 0:
        return 0.0
    z = (values - values.mean()) / spread
    return float((np.mean(z**3) ** 2 + 1) / np.mean(z**4))


# ---- set-points


def _rests(values: np.ndarray) -> bool:
    return len(values) >= FEWEST_ROWS and float(np.mean(np.diff(values) == 0)) > RESTING_SHARE


def _without_hidden_set_points(signals: Sequence[RecordedSignal]) -> list[RecordedSignal]:
    """Returns the signals with hidden set-points marked. An output that stays at few levels is the set-point
    of a measured output with the same numbers, around the same temperature, whatever its name is."""
    outputs = [(s, _numbers(s.source), np.unique(sample(s.values))) for s in signals if s.role == "output"]
    moving = [entry for entry in outputs if not _rests(entry[0].values)]
    hidden = {
        signal.source
        for signal, numbers, levels in outputs
        if _rests(signal.values)
        for _, own, course in moving
        if numbers == own and len(course) > MORE_LEVELS * len(levels)
        # the set-point lies within the measured range, extended by a tenth of it on both sides
        if course[0] - 0.1 * np.ptp(course) <= np.median(signal.values) <= course[-1] + 0.1 * np.ptp(course)
    }
    return [s._replace(role="set-point") if s.source in hidden else s for s in signals]


def _numbers(source: str) -> tuple[str, ...]:
    return tuple(re.findall(r"\d+", re.sub(r"\bpt 1000?\b", "", read_name(source).words)))


def _plain_words(source: str) -> set[str]:
    """Returns the words of a name, and its numbers, without the words for a temperature or its set-point."""
    words = read_name(source).words
    for pattern in (SET_POINT, ACTUAL, TEMPERATURE):
        words = pattern.sub(" ", words)
    return set(words.split())


def _targets(signals: Sequence[RecordedSignal]) -> dict[str, RecordedSignal]:
    """Returns {output: its set-point}. The set-point has the output's numbers and the most words in common
    with it. If no output has the same numbers, words and numbers count equally."""
    outputs = {s.source: (_numbers(s.source), _plain_words(s.source)) for s in signals if s.role == "output"}
    targets: dict[str, tuple[float, RecordedSignal]] = {}
    for signal in signals:
        name = signal.name
        if signal.role != "set-point" or name.kind not in ("", *_CELSIUS) or says(SPEED, name.words):
            continue
        numbers, words = _numbers(signal.source), _plain_words(signal.source)
        likeness = {
            source: len(words & plain) / len(words | plain) if words | plain else 1.0
            for source, (_, plain) in outputs.items()
        }
        equal = [source for source, (own, _) in outputs.items() if own == numbers]
        candidates = sorted(equal or outputs, key=lambda source: -likeness[source])
        # if nothing is in common, the choice is a guess unless there is only one candidate
        if not candidates or (len(candidates) > 1 and likeness[candidates[0]] == 0.0):
            continue
        best = candidates[0]
        if likeness[best] >= targets.get(best, (-1.0, signal))[0]:
            targets[best] = likeness[best], signal
    return {source: signal for source, (_, signal) in targets.items()}


# ---- names, units, limits


def _propose_signal(
    signal: RecordedSignal, name: str, target: RecordedSignal | None, *, guessed: bool
) -> Proposed:
    unit, scale, offset = _conversion(signal)
    low = high = reference = cut_off = None
    if signal.limits is not None and np.isfinite(signal.limits).all():
        low, high = (limit * scale + offset for limit in signal.limits)
    elif signal.role == "input":
        low, high = _input_limits(signal.values * scale + offset, guessed=guessed and scale == 1.0)
    if signal.role == "output":
        reference = _reference(sample(signal.values) * scale + offset, target, scale, offset)
        if high is not None:
            cut_off, high = high, max(high - BELOW_CUT_OFF_DEGC, reference)
    words = signal.name.words
    heated = says(HEATER, words) or _HEATED.search(words) is not None
    heats = signal.role == "input" and heated and not says(COOLER, words) and not says(SPEED, words)
    set_point = target.source if target is not None else ""
    return Proposed(
        name, signal.role, signal.source, unit, scale, offset, low, high, reference, heats, set_point, cut_off
    )


def _input_limits(percent: np.ndarray, *, guessed: bool) -> tuple[float, float]:
    """Returns the limits: 0 to 100 percent, or from below zero if negative values were recorded. For a
    `guessed` input nothing says that it is in percent. Its limits are the whole numbers around the recorded
    values, so that no experiment goes beyond them."""
    low, high = max(-100.0, float(np.floor(percent.min()))), min(100.0, float(np.ceil(percent.max())))
    return (low, high) if guessed else (min(0.0, low), 100.0)


def _reference(celsius: np.ndarray, target: RecordedSignal | None, scale: float, offset: float) -> float:
    """Returns the set-point that was held longest, or the median of the temperature if there is no
    set-point."""
    wanted = target.values if target is not None else np.empty(0)
    levels, counts = np.unique(wanted[wanted > 0], return_counts=True)
    if len(levels):
        return float(np.round(levels[counts.argmax()] * scale + offset, 1)) + 0.0
    return float(np.round(np.median(celsius))) + 0.0


def _words_of(signal: RecordedSignal) -> list[str]:
    """Returns the words of the topic's last part and of the telling name; the topic's are left out if that
    name begins with them."""
    topic, words = signal.source.rpartition(":")[0].rpartition("/")[2], signal.name.words.split()
    return words if telling_name(signal.source).startswith(topic) else [*split(topic).split(), *words]


def _common_words(signals: Sequence[RecordedSignal], role: str) -> int:
    """Returns how many of the first words are the same in the names of all signals of a role."""
    names = [_words_of(signal) for signal in signals if signal.role == role]
    shared = [len(set(column)) == 1 for column in zip(*names, strict=False)]
    return shared.index(False) if len(names) > 1 and False in shared else 0


def _name(signal: RecordedSignal, prefix: int, names: set[str]) -> str:
    """Returns a new name: heater_1, temperature_bed, ... An array of a topic, a motor and a disturbance keep
    their own names, in letters, digits and _. The number is the first one after the words that all signals of
    the role share."""
    words = _words_of(signal)
    number = next((word for word in [*words[prefix:], *words] if word.isdigit()), "")
    text = " ".join(words)
    kind = "temperature" if signal.role == "output" else "cooler" if says(COOLER, text) else "heater"
    own = re.sub(r"\W+", "_", text, flags=re.ASCII).strip("_")
    is_array = signal.source.startswith("/") and signal.source.endswith("]")
    if signal.role == "disturbance" or is_array or signal.source == "motor":
        base = (own if re.match(r"[a-z]", own) else f"signal_{own}")[:40].strip("_")
    elif number:
        base = f"{kind}_{number}"
    else:
        own_words = [word for word in words if re.fullmatch(r"[a-z]{2,}", word) and not _is_common(word)]
        base = "_".join([kind, *dict.fromkeys(own_words)])[:40] if own_words else f"{kind}_1"
    base = f"{base}_1" if base in _TAKEN_NAMES else base
    name, i = base, 1
    while name in names:
        i += 1
        name = f"{re.sub(r'_[0-9]+$', '', base)}_{i}"
    names.add(name)
    return name


def _is_common(word: str) -> bool:
    """Returns whether a word says only what the role is, and nothing about the place."""
    return word in _COMMON_WORDS or any(
        says(pattern, word) for pattern in (SET_POINT, ACTUAL, DUTY, OUTPUT, COMMAND)
    )


def _conversion(signal: RecordedSignal) -> tuple[str, float, float]:
    """Returns our unit, and the scale and offset that convert to it."""
    name, finite = signal.name, signal.values
    low, high = finite.min(), finite.max()
    if signal.role == "disturbance" and not _is_warm(signal):
        if name.kind != "percent":
            return name.unit[:20] or "1", 1.0, 0.0
        return "percent", 100.0 if low >= 0 and high <= 1 else 1.0, 0.0
    if signal.role == "input":
        if low >= 0 and high <= 1 and signal.limits is None:
            return "percent", 100.0, 0.0
        integer = high > 100 and bool((finite == np.rint(finite)).all())
        full = next((top for top in (255, 1023, 4095) if 100 < high <= top and low >= 0 and integer), None)
        if full is None and max(high, -low) > 100:
            full = max(high, -low)  # mV, W: percent of the largest
        return "percent", _to_percent(full) if full and name.kind != "percent" else 1.0, 0.0
    if name.kind in _CELSIUS:
        return "degC", *_CELSIUS[name.kind]
    return "degC", 1.0, -273.15 if ROOM_KELVIN[0] <= finite[0] <= ROOM_KELVIN[1] and low > 250 else 0.0


def _to_percent(full: float) -> float:
    """Returns 100 / full to six digits, rounded down, so that the largest recorded value stays within 100
    %."""
    unit = 10.0 ** (math.floor(math.log10(100 / full)) - 5)
    return float(f"{math.floor(100 / full / unit) * unit:.6g}")


def _yaml(source: str) -> str:
    """Returns a YAML scalar, quoted if YAML could read it as something else."""
    return (
        source
        if re.fullmatch(r"[A-Za-z_]\w*|/[\w/.:]*\w", source) and ": " not in source
        else json.dumps(source, ensure_ascii=False)
    )


def _sample_time(groups: Sequence[tuple[FileColumns, str]]) -> float:
    """Returns the largest of the clocks' median intervals, to two digits."""
    medians = []
    for group, _ in groups:
        if len(group.time) > 1:
            steps = np.diff(group.time[:CLOCK_SAMPLES]) / group.second
            medians.append(float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0)
    return float(f"{max(medians, default=1.0):.2g}")
