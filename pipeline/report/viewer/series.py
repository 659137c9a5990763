"""Which tables of a run the viewer shows, and how: what tells their runs apart, which column is time, and
what every other one is. Rows of equal keys are one run; what happens in it are its events.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from pipeline.report.deposition.learning import LAWS
from pipeline.report.setpoint.deciding import Clog, clog
from pipeline.report.shared.charts import stretches
from pipeline.report.shared.page import MARKS
from pipeline.report.shared.sources import Sources
from pipeline.setpoint.controllers import KINDS
from pipeline.verdict.controllers import heading
from pipeline.verdict.evidence import Table, gap_of, known, need, or_empty

UNITS = {"degC": "°C", "percent": "%", "mm^3/s": "mm³/s", "1": "", "degC per percent": "°C/%"}


class Key(NamedTuple):
    """A column that tells runs apart. `words`: how a value reads, where not as it stands; `one`: where a
    link names none, one value is shown."""

    name: str
    label: str
    words: Callable[[str], str] = str
    one: bool = True


class SeriesLine(NamedTuple):
    """A column of numbers. Lines of one `panel` share axes. `beside`: the line that this one is drawn with
    (a reference); `steps`: a value holds until the next; `group`: the heading it is chosen under."""

    name: str
    label: str
    unit: str
    panel: str
    group: str
    beside: str = ""
    steps: bool = False


class Event(NamedTuple):
    """What happened from `start` to `end`, in the unit of x, in words; `panel`: that of the lines that it
    concerns, "" for all."""

    start: float
    end: float
    text: str
    panel: str = ""


class ViewerTable(NamedTuple):
    """A table of the viewer. `name` is that of the pages' source; `books`: so many leading keys tell apart
    what is loaded together; `who`: the key whose values have marks; `events` of the rows of one run."""

    name: str
    title: str
    note: str
    x: tuple[str, str, str]
    keys: tuple[Key, ...]
    lines: tuple[SeriesLine, ...]
    books: int = 0
    who: str = ""
    marks: Callable[[str], str] = lambda name: ""
    events: Callable[[Table], list[Event]] = lambda rows: []


def counted(word: str) -> Callable[[str], str]:
    """How a number of something reads: "trial 3"."""
    return lambda value: f"{word} {value}"


def tables(sources: Sources) -> list[ViewerTable]:
    """All tables that the viewer knows, whether they could be read or not."""
    machine = sources.declared.machine
    inputs = [(signal.name, signal.unit) for signal in machine.inputs]
    outputs = [(o.name, o.unit, sources.zone(i)) for i, o in enumerate(machine.outputs)]
    return [
        _trajectories(inputs, outputs),
        _record(sources, inputs, outputs),
        _holdout(outputs),
        _steps(),
        _trials(),
        _lessons(),
        _signals(sources),
        _decisions(sources),
        _paths(sources),
        _agents(),
    ]


# ---- temperature


def _trajectories(inputs: Sequence[tuple[str, str]], outputs: Sequence[tuple[str, str, str]]) -> ViewerTable:
    lines = []
    for name, unit, label in outputs:
        lines += [
            SeriesLine(name, label, unit, name, "Temperature"),
            SeriesLine(f"{name}_reference", f"{label} reference", unit, name, "Temperature", beside=name),
        ]
    for name, unit in inputs:
        lines.append(
            SeriesLine(f"{name}_applied", f"{name} given", unit, name, "Command as given", steps=True)
        )
    for name, unit in inputs:
        lines.append(
            SeriesLine(f"{name}_command", f"{name} asked", unit, name, "Command as asked", steps=True)
        )
    return ViewerTable(
        "trajectories",
        "Temperature: contestants at work",
        "True temperatures, references and commands of two cases under every contestant, as deployed.",
        ("time_s", "time since the contestant took over", "s"),
        (Key("case_name", "Case"), Key("contestant", "Contestant", heading, one=False)),
        tuple(lines),
        who="contestant",
        marks=lambda name: MARKS.get(name, ""),
        events=lambda rows: _limits(rows, [name for name, _ in inputs]) + _jumps(rows, outputs),
    )


def _limits(rows: Table, inputs: Sequence[str]) -> list[Event]:
    """Stretches in which an input was given something else than was asked: at a limit, or by the governor."""
    time = rows["time_s"]
    return [
        Event(float(time[a]), float(time[b - 1]), f"{name} not given as asked", name)
        for name in inputs
        for a, b in stretches(rows[f"{name}_command"] != rows[f"{name}_applied"])
    ]


def _jumps(rows: Table, outputs: Sequence[tuple[str, str, str]]) -> list[Event]:
    """Where a reference jumps: it changes in one step, and in neither step beside it."""
    time, events = rows["time_s"], []
    for name, unit, label in outputs:
        reference = rows[f"{name}_reference"]
        moved = np.concatenate([[False], np.diff(reference) != 0, [False]])
        for at in np.flatnonzero(moved[1:-1] & ~moved[:-2] & ~moved[2:]) + 1:
            text = f"{label} is to be {reference[at]:g} {UNITS.get(unit, unit)}"
            events.append(Event(float(time[at]), float(time[at]), text, name))
    return events


def _record(
    sources: Sources, inputs: Sequence[tuple[str, str]], outputs: Sequence[tuple[str, str, str]]
) -> ViewerTable:
    acting = [(signal.name, signal.unit) for signal in sources.declared.machine.acting]
    lines = [SeriesLine(name, label, unit, name, "Temperature") for name, unit, label in outputs]
    lines += [SeriesLine(name, name, unit, name, "Command", steps=True) for name, unit in acting]
    quality = known(sources.tables["quality"], None)

    def events(rows: Table) -> list[Event]:
        time, found = rows["time_s"], []
        if quality:
            for i in np.flatnonzero(quality["recording"] == rows["recording"][0]):
                start, end = float(quality["start_s"][i]), float(quality["end_s"][i])
                if start <= time[-1] and end >= time[0]:
                    signal, message = str(quality["signal"][i]), str(quality["message"][i])
                    inside = max(start, float(time[0])), min(end, float(time[-1]))
                    found.append(Event(*inside, f"{quality['kind'][i]}: {message}", signal))
        for line in lines:
            found += [
                Event(float(time[a]), float(time[b - 1]), f"{line.label} masked", line.name)
                for a, b in stretches(rows[f"{line.name}_masked"])
            ]
        return found

    return ViewerTable(
        "record",
        "Temperature: the record",
        "What was recorded, before anything is left out; masked samples stand as they were recorded.",
        ("time_s", "time since the recording began", "s"),
        (Key("recording", "Recording"), Key("segment", "Stretch without a gap", counted("stretch"))),
        tuple(lines),
        books=1,
        events=events,
    )


def _holdout(outputs: Sequence[tuple[str, str, str]]) -> ViewerTable:
    kinds = ("measured", "simulated", "ahead")
    return ViewerTable(
        "holdout",
        "Temperature: the model on the hold-out",
        "Measured, simulated from the inputs alone, and predicted some steps ahead.",
        ("time_s", "time since the hold-out began", "s"),
        (Key("segment", "Stretch of the record", counted("stretch")),),
        tuple(
            SeriesLine(f"{name}_{kind}", f"{label} {kind}", unit, name, kind.capitalize())
            for kind in kinds
            for name, unit, label in outputs
        ),
    )


def _steps() -> ViewerTable:
    ends = (("response", "response"), ("low", "band, lower end"), ("high", "band, upper end"))
    return ViewerTable(
        "steps",
        "Temperature: step responses of the model",
        "Answer to one per cent more of an input, from rest, and its 90 % band.",
        ("time_s", "time since the step", "s"),
        (Key("output", "Output"), Key("input", "Input", one=False)),
        tuple(SeriesLine(name, label, "degC per percent", "response", "Response") for name, label in ends),
    )


# ---- deposition

MATERIAL, ROUTINE = (
    Key("material", "Material", counted("material")),
    Key("routine", "Routine", counted("routine")),
)


def law_in_words(name: str) -> str:
    """As the deposition page has it; the paper's law on its own nominal model is not drawn there."""
    if name == "hoelzle_2009_nominal":
        return f"{LAWS['hoelzle_2009'][0]}, nominal model only"
    return LAWS[name][0] if name in LAWS else name


def law_mark(name: str) -> str:
    return LAWS[name.removesuffix("_nominal")][2] if name.removesuffix("_nominal") in LAWS else ""


def _trials() -> ViewerTable:
    figures = (
        ("rms_true", "error of the true flow, r.m.s.", "mm^3/s"),
        ("rms_measured", "error of the measured flow, r.m.s.", "mm^3/s"),
        ("ratio", "error as share of trial 0's", "1"),
        ("peak_over_steady", "largest command over the steady one", "1"),
        ("saturated", "share of time at a limit of the drive", "1"),
    )
    return ViewerTable(
        "trials",
        "Deposition: error trial by trial",
        "What each training routine came to, trial by trial.",
        ("trial", "updates before the trial", ""),
        (MATERIAL, ROUTINE, Key("law", "Law", law_in_words, one=False)),
        tuple(SeriesLine(name, label, unit, name, "Figure") for name, label, unit in figures),
        who="law",
        marks=law_mark,
    )


def _lessons() -> ViewerTable:
    return ViewerTable(
        "lessons",
        "Deposition: every trial",
        "Wanted, measured and true flow and the plunger's command of every trial of every routine.",
        ("time_s", "time since the trial began", "s"),
        (MATERIAL, ROUTINE, Key("law", "Law", law_in_words), Key("trial", "Trial", counted("trial"))),
        (
            SeriesLine("true_mm3_per_s", "true flow", "mm^3/s", "flow", "Flow"),
            SeriesLine("wanted_mm3_per_s", "wanted flow", "mm^3/s", "flow", "Flow", beside="true_mm3_per_s"),
            SeriesLine("measured_mm3_per_s", "measured flow", "mm^3/s", "flow", "Flow"),
            SeriesLine("command_mm", "plunger command", "mm", "command", "Command"),
        ),
        books=2,
        who="law",
        marks=law_mark,
    )


COMPOSERS = (
    ("predicted", "flow predicted for the chosen command"),
    ("on_off", "on-off"),
    ("pressure_advance", "pressure advance"),
    ("pressure_advance_lead", "pressure advance with a lead"),
    ("priority", "library by priority"),
    ("superposition", "library by superposition"),
    ("basis", "basis functions"),
    ("ilc", "full-part ILC"),
)


def _signals(sources: Sources) -> ViewerTable:
    lines = [SeriesLine("wanted_mm3_per_s", "wanted flow", "mm^3/s", "flow", "Flow")]
    lines += [SeriesLine(f"{name}_mm3_per_s", label, "mm^3/s", "flow", "Flow") for name, label in COMPOSERS]
    lines += [SeriesLine("command_mm", "plunger command", "mm", "command", "Command")]
    lines += [SeriesLine(f"{axis}_mm", f"gantry {axis}", "mm", "gantry", "Gantry") for axis in "xy"]

    @or_empty
    def events(rows: Table) -> list[Event]:
        tasks = need(sources.tables["tasks"])
        mine = (tasks["part"] == rows["part"][0]) & (tasks["tool"] == rows["tool"][0])
        return [
            Event(float(tasks["begin_s"][i]), float(tasks["end_s"][i]), str(tasks["task"][i]))
            for i in np.flatnonzero(mine)
        ]

    return ViewerTable(
        "signals",
        "Deposition: parts",
        "Wanted flow, flow under every composer, command and gantry of every composed part.",
        ("time_s", "time since the plunger may move first", "s"),
        (Key("part", "Part"), Key("tool", "Tool", counted("tool")), MATERIAL),
        tuple(lines),
        events=events,
    )


# ---- setpoint


def _setpoint_marks(sources: Sources) -> Callable[[str], str]:
    """The mark of a controller by its kind; none without a scoreboard."""
    if gap_of(sources.tables["scoreboard"]):
        return lambda name: ""
    marks = {"data-driven": "dd", "model-based": "mb", "reference": "mb"}
    return lambda name: marks.get(KINDS.get(name, ""), "bl")


def _decisions(sources: Sources) -> ViewerTable:
    def events(rows: Table) -> list[Event]:
        return [
            Event(float(time), float(time), f"{'held: ' if held else ''}{' '.join(str(why).split())}")
            for time, held, why in zip(rows["time_s"], rows["held"], rows["why"], strict=True)
        ]

    shares = (("p_under", "too little"), ("p_good", "good"), ("p_over", "too much"))
    return ViewerTable(
        "decisions",
        "Setpoint: decisions and what was believed",
        "Flow, temperature and setpoints window by window, with the camera's calibrated class shares.",
        ("time_s", "time since the start", "s"),
        (Key("episode", "Episode"), Key("controller", "Controller")),
        (
            SeriesLine("flow_percent", "true flow", "percent", "flow", "Flow and temperature"),
            SeriesLine(
                "flow_setpoint_percent",
                "flow setpoint",
                "percent",
                "flow",
                "Flow and temperature",
                steps=True,
            ),
            SeriesLine(
                "temperature_degC", "nozzle temperature", "degC", "temperature", "Flow and temperature"
            ),
            SeriesLine(
                "target_degC", "target temperature", "degC", "temperature", "Flow and temperature", steps=True
            ),
            *(SeriesLine(name, f"belief: {label}", "1", "belief", "Belief") for name, label in shares),
            SeriesLine("distance", "distance from what was learned", "1", "distance", "Camera"),
            SeriesLine("frames", "frames that count", "1", "frames", "Camera"),
            SeriesLine("flow_move_percent", "move of the flow setpoint", "percent", "flow move", "Moves"),
            SeriesLine("temperature_move_degC", "move of the target", "degC", "temperature move", "Moves"),
        ),
        who="controller",
        marks=_setpoint_marks(sources),
        events=events,
    )


def _paths(sources: Sources) -> ViewerTable:
    table = sources.tables["paths"]

    @functools.cache
    def happens(case: tuple[str, str]) -> Clog | None:
        return clog(need(table), case)

    def events(rows: Table) -> list[Event]:
        found = happens((str(rows["simulator"][0]), str(rows["case"][0])))
        text = "" if found is None else f"a clog leaves {found.left:.0f} % of the flow"
        return [] if found is None else [Event(found.step, found.step, text, "flow")]

    return ViewerTable(
        "paths",
        "Setpoint: runs from every start",
        "True flow and nozzle temperature, decision by decision, of runs that were judged; of the case that "
        "decides to decision 200.",
        ("step", "decision", ""),
        (
            Key("simulator", "Simulator"),
            Key("case", "Case"),
            Key("start", "Start", counted("start")),
            Key("controller", "Controller", one=False),
        ),
        (
            SeriesLine("flow_percent", "true flow", "percent", "flow", "Quantity"),
            SeriesLine("temperature_degC", "nozzle temperature", "degC", "temperature", "Quantity"),
        ),
        who="controller",
        marks=_setpoint_marks(sources),
        events=events,
    )


def _agents() -> ViewerTable:
    return ViewerTable(
        "agents",
        "Setpoint: training of the agents",
        "Mean reward of a step while the agents learned, in the reward of each phase.",
        ("update", "updates done in all phases", ""),
        (Key("agent", "Agent", one=False), Key("phase", "Phase", counted("phase"), one=False)),
        (SeriesLine("reward", "mean reward of a step", "1", "reward", "Figure"),),
    )


def runs(shown: ViewerTable, table: Mapping[str, np.ndarray]) -> list[tuple[tuple[str, ...], np.ndarray]]:
    """(values of the keys, rows in order) of every run, in the order in which they come first."""
    columns = [np.asarray(table[key.name]) for key in shown.keys]
    if not len(table[shown.x[0]]):
        return []
    codes = np.zeros(len(columns[0]), np.int64)
    for values in columns:
        place, different = pd.factorize(values)
        codes = codes * len(different) + place
    order = np.argsort(codes, kind="stable")
    cuts = np.flatnonzero(np.diff(codes[order])) + 1
    found = sorted(np.split(order, cuts), key=lambda rows: rows[0])
    return [(tuple(str(values[rows[0]]) for values in columns), rows) for rows in found]
