"""`beadline init`: recordings of a new machine -> the values of the params files that fit it.

The mapping and the signals are those that `inspect` proposes. Times follow from the slowest and the fastest
output's time constant, temperatures from what was recorded. What a rehearsal asks, and how fast it must
settle, is not written: it follows from the record wherever recordings are the source (scenario_defaults).
"""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from pipeline.recordings.formats import every, file_format
from pipeline.recordings.inspection import CODE, Inspected, look
from pipeline.recordings.klipper_logs import printed_files
from pipeline.recordings.printed_gcode import NOT_RECORDED, UNITS
from pipeline.recordings.proposals import (
    BELOW_CUT_OFF_DEGC,
    Proposal,
    Proposed,
    mapping_lines,
    plant_lines,
    propose,
)
from pipeline.recordings.quality import stands_still
from pipeline.recordings.recordings import Source, read
from pipeline.recordings.resampling import resample
from pipeline.store import artifacts, params
from pipeline.store.params_text import inserted, replaced
from pipeline.temperature import tables
from pipeline.temperature.identification.first_order import time_constant

RAW = Path("datasets/raw/temperature")
# what the files hold before anybody has touched them: the study's machine
SHIPPED: dict[str, Any] = {
    "loops.temperature": True,
    "loops.deposition": True,
    "loops.setpoint": True,
    "plant.sample_time_s": 1.0,
    "plant.inputs": [
        {"name": name, "unit": "percent", "low": 0, "high": 100}
        for name in (*(f"heater_{i}" for i in range(1, 7)), "motor")
    ],
    "plant.disturbances": [],
    "plant.outputs": [
        {"name": f"sensor_{i}", "unit": "degC", "reference": reference, "low": 0, "high": 250}
        for i, reference in enumerate((150, 160, 170, 175, 180), 1)
    ],
    "generate_probing.source": "simulated",
    "generate_probing.signal": "multisine",
    "generate_probing.samples": 6000,
    "generate_probing.amplitude_percent": 5.0,
    "generate_probing.shortest_steps": 1,
    "ingest.mapping": {},
    "ingest.time": "",
    "ingest.max_gap_s": 5.0,
    "report.overshoot_degC": 5.0,
}
# samples a time constant of the fastest output: as many are taken if the clock allows, and at least as many
MOST_SAMPLES, FEWEST_SAMPLES = 200, 10
# what firmware without limits in its log leaves to the owner
FIRMWARE_KINDS = ("klippy.log", "Moonraker JSON", "serial.log")
GAP_SAMPLES = 3  # shortest gap of samples that ends a segment
ABSOLUTE_ZERO_DEGC = -273.15
# the next experiment: no move smaller or larger, in percent; samples that the stage takes
MOVES_PERCENT, PROBING_SAMPLES = (1.0, 20.0), (300, 100_000)


class MachinePace(NamedTuple):
    """The machine's pace and range: time constants in s by output, the record's own clock and the sample time
    that suits both, the lowest and highest temperature of the record, and the standard deviation of each
    input."""

    time_constants_s: dict[str, float]
    clock_s: float
    sample_time_s: float
    coldest_degC: float
    hottest_degC: float
    input_spread_percent: list[float]


class Initialised(NamedTuple):
    """The lines of each key that is to be written, and sentences on what a person must decide."""

    values: dict[str, list[str]]
    open_questions: list[str]


def proposed(paths: Sequence[Path], *, sample_time: str = "") -> Initialised:
    """What the params files should hold for the machine of these recordings; `sample_time`, such as
    "every 0.08 s", is that of files which do not say it.

    Raises ValueError for recordings of different machines, and for one without a heater or a temperature.
    """
    recordings = [look(path) for path in paths]
    proposal = _widest(recordings)
    if sample_time:
        proposal = proposal._replace(time=sample_time, sample_time_s=_interval(sample_time))
    for role, word in (("input", "a heater or a motor"), ("output", "a temperature")):
        if not any(signal.role == role for signal in proposal.signals):
            raise ValueError(
                f"{paths[0]}: nothing in it looks like {word}, without which no plant can be identified; "
                "if it was not recorded, record it; if it was, name its column so (heater_1_pct, "
                "zone_1_C), or write ingest.mapping and plant in params.yaml by hand"
            )
    for path, recording in zip(paths, recordings, strict=True):
        sources = {signal.source for signal in recording.signals}
        lacking = [signal.source for signal in proposal.signals if signal.source not in sources]
        if lacking:
            reasons = [note.message for note in recording.notes if note.kind == NOT_RECORDED]
            if reasons and lacking[0] in UNITS:
                raise ValueError(f"{path}: {reasons[0]}; another of the recordings has them")
            raise ValueError(
                f"{path}: there is no {lacking[0]}, which another of the recordings has; "
                "give recordings of one machine"
            )
    kind = recordings[0].kind
    remarks = [note.message for one in recordings for note in one.notes if note.kind in (CODE, NOT_RECORDED)]
    scale = _scale(paths, proposal)
    return Initialised(
        _values(proposal, scale),
        [*remarks, *_open_questions(proposal, scale, kind, timed=not proposal.time or bool(sample_time))],
    )


def _interval(sample_time: str) -> float:
    """Seconds of "every 0.08 s". Raises ValueError for anything else."""
    interval = every(sample_time)
    if interval is None:
        raise ValueError(f"--time is {sample_time!r} but should be such as 'every 0.08 s'; write it so")
    return interval


def _widest(recordings: Sequence[Inspected]) -> Proposal:
    """The proposal of the recording that shows the most signals at work."""
    proposals = [propose(one.signals, one.groups, one.time) for one in recordings]
    return max(proposals, key=lambda proposal: len(proposal.signals))


# ---- pace and range


def sample_time_s(clock_s: float, fastest_s: float) -> float:
    """The sample time in s: the multiple of the record's own clock with MOST_SAMPLES in the fastest time
    constant, if the clock has as many."""
    return _rounded(clock_s * max(1, round(fastest_s / MOST_SAMPLES / clock_s)))


def _rounded(time_s: float) -> float:
    return float(f"{time_s:.9g}")


def _scale(paths: Sequence[Path], proposal: Proposal) -> MachinePace:
    inputs = [s.name for s in proposal.signals if s.role == "input"]
    outputs = [s for s in proposal.signals if s.role == "output"]
    sources = [Source(s.name, s.source, s.unit, s.scale, s.offset) for s in proposal.signals]
    interval = proposal.sample_time_s
    wanted = {tables.set_point_of(s.name): s for s in outputs if s.set_point}
    sources += [Source(name, s.set_point, s.unit, s.scale, s.offset) for name, s in wanted.items()]
    u, y = [], {output.name: [] for output in outputs}
    targets: dict[str, list[np.ndarray]] = {name: [] for name in wanted}
    for path in paths:
        raw = read(path, sources, time=proposal.time)
        for name in wanted:
            targets[name].append(raw.signals.pop(name, (np.empty(0), np.empty(0)))[1])
        table = resample(
            raw, sample_time_s=interval, inputs=inputs, outputs=list(y), max_gap_s=_gap_s(interval)
        )
        for segment in np.unique(table.segment):
            rows = table.segment == segment
            u.append(np.nan_to_num(np.column_stack([table.values[name][rows] for name in inputs])))
            for name in y:
                y[name].append(np.where(table.masked[name][rows], np.nan, table.values[name][rows]))
    constants = {}
    for name, segments in y.items():
        try:
            constants[name] = time_constant(u, segments, sample_time_s=interval)
        except ValueError as error:
            raise ValueError(f"{paths[0]}: {name}: {error}") from None
    # a zone that is held all the time shows the pace of its noise
    set_points = {name: np.concatenate(parts) for name, parts in targets.items()}
    still = [
        name
        for name, segments in y.items()
        if stands_still(_finite(segments), set_points.get(tables.set_point_of(name)))
    ]
    if len(still) < len(y):
        constants = {name: tau for name, tau in constants.items() if name not in still}
    sample_time = sample_time_s(interval, min(constants.values()))
    lows = [np.nanmin(np.concatenate(segments)) for segments in y.values()]
    highs = [np.nanmax(np.concatenate(segments)) for segments in y.values()]
    rows = np.vstack(u)
    return MachinePace(
        constants, interval, sample_time, float(np.min(lows)), float(np.max(highs)), rows.std(axis=0).tolist()
    )


def _finite(segments: Sequence[np.ndarray]) -> np.ndarray:
    values = np.concatenate(segments)
    return values[np.isfinite(values)]


def _gap_s(sample_time_s: float) -> float:
    return max(SHIPPED["ingest.max_gap_s"], GAP_SAMPLES * sample_time_s)


# ---- values


def _values(proposal: Proposal, scale: MachinePace) -> dict[str, list[str]]:
    """The lines of each key."""
    references = [s.reference for s in proposal.signals if s.reference is not None]
    # a machine that is only ever warmed by 20 °C may not overshoot by five
    coldest = max(scale.coldest_degC, ABSOLUTE_ZERO_DEGC)
    reach = max(min(*references, scale.hottest_degC) - coldest, 1.0)
    inputs, disturbances, outputs = plant_lines(proposal)
    return {
        "plant.sample_time_s": [repr(scale.sample_time_s)],
        "plant.inputs": ["- " + line for line in inputs],
        "plant.disturbances": ["- " + line for line in disturbances] or ["[]"],
        "plant.outputs": ["- " + line for line in outputs],
        "generate_probing.source": ["recordings"],
        **_next_experiment(scale),
        "ingest.mapping": mapping_lines(proposal),
        "ingest.time": [proposal.time or '""'],
        "ingest.max_gap_s": [repr(_gap_s(scale.sample_time_s))],
        "report.overshoot_degC": [repr(float(f"{max(0.5, 0.05 * reach):.1g}"))],
    }


def loops_to_run(recorded: Sequence[str], path: str | Path = params.FILE) -> dict[str, list[str]]:
    """The lines of section `loops`: on for each loop that has recordings: these, those that section
    train_ilc or train_classifier names as its source, and those below datasets/raw. Once the temperature
    loop has recordings the switches are the owner's, and stay."""
    sections = params.read(path)
    if sections["generate_probing"]["source"] == "recordings":
        return {}
    sources = {"deposition": "train_ilc", "setpoint": "train_classifier"}
    lines = {}
    for loop in params.Loops.model_fields:
        source = (sections.get(sources.get(loop, "")) or {}).get("source")
        files = (file for file in (RAW.parent / loop).rglob("*") if file.is_file())
        has_files = any(file.name != "README.md" and not file.name.startswith(".") for file in files)
        runs = loop in recorded or source == "recordings" or has_files
        lines[f"loops.{loop}"] = ["true" if runs else "false"]
    return lines


def _next_experiment(scale: MachinePace) -> dict[str, list[str]]:
    """A random binary sequence at the machine's pace, no wider than the inputs moved; its centre is left to
    the identified model.

    Switching every half of the fastest time constant puts the power where outputs
    answer. It lasts for 20 of the slowest, and for 60 chances to switch.
    """
    fastest, slowest = (pick(scale.time_constants_s.values()) for pick in (min, max))
    moves = [spread for spread in scale.input_spread_percent if spread >= MOVES_PERCENT[0]]
    hold = int(np.clip(round(fastest / 2 / scale.sample_time_s), 1, 10_000))
    samples = int(np.clip(max(np.ceil(20 * slowest / scale.sample_time_s), 60 * hold), *PROBING_SAMPLES))
    return {
        "generate_probing.signal": ["prbs"],
        "generate_probing.samples": [str(samples)],
        "generate_probing.amplitude_percent": [
            repr(float(f"{np.clip(min(moves, default=0.0), *MOVES_PERCENT):.2g}"))
        ],
        "generate_probing.shortest_steps": [str(hold)],
    }


def _open_questions(proposal: Proposal, scale: MachinePace, kind: str, *, timed: bool) -> list[str]:
    """What a person must decide; `kind` is the file's format, `timed`: the sample time was recorded or
    given."""
    questions = []
    if proposal.how != "names and ranges":
        questions.append(
            "which column is what: the file names nothing, and the mapping was guessed by values"
        )
    if not timed:
        questions.append(
            "the sample time: the file has no time, and 1.0 s was assumed, on which all times rest that were "
            "written; if it is another, run init again with --time 'every 0.08 s' --force"
        )
    questions += _questions_on_time(scale)
    questions += _questions_on_inputs([s for s in proposal.signals if s.role == "input"])
    questions += _questions_on_disturbances(proposal)
    questions += _questions_on_limits([s for s in proposal.signals if s.role == "output"], kind)
    references = [f"{s.name} {s.reference:g}" for s in proposal.signals if s.role == "output"]
    questions.append(f"plant.outputs reference, where each should settle: now {', '.join(references)} °C")
    questions.append(
        "generate_probing: whether the machine may be moved so; the next experiment switches each input "
        "by at most amplitude_percent, and is written only if its forecast stays within low and high"
    )
    paces = [f"{name} {float(f'{tau:.2g}'):g} s" for name, tau in scale.time_constants_s.items()]
    questions.append(f"report: whether the rules suit you; the time constants are {', '.join(paces)}")
    return questions


def _questions_on_time(scale: MachinePace) -> list[str]:
    """How the record comes to the sample time, if it is not the record's own, and whether it is too long."""
    clock, time, fastest = scale.clock_s, scale.sample_time_s, min(scale.time_constants_s.values())
    nth = {1: "each", 2: "every 2nd", 3: "every 3rd"}.get(round(time / clock), f"every {time / clock:.0f}th")
    questions = []
    if time > clock:
        questions.append(
            f"plant.sample_time_s {time:g} s: the file has a sample every {clock:g} s; {nth} is taken"
        )
    if time > fastest / FEWEST_SAMPLES:
        questions.append(
            f"plant.sample_time_s {time:g} s is more than a tenth of the fastest time constant "
            f"({fastest:.2g} s): record faster, at {_rounded(float(f'{fastest / FEWEST_SAMPLES:.1g}')):g} s"
        )
    return questions


def _questions_on_disturbances(proposal: Proposal) -> list[str]:
    names = [s.name for s in proposal.signals if s.role == "disturbance"]
    if not names:
        return []
    return [
        f"plant.disturbances {', '.join(names)}: does the controller move it, or is it only recorded? Move "
        "to plant.inputs, in percent, what a controller moves; leave out what does not act on the "
        "temperatures. The controller is to be told these signals, and makes up for what they do"
    ]


def _questions_on_limits(outputs: Sequence[Proposed], kind: str) -> list[str]:
    """Between which temperatures the machine must stay: what is proposed, and what nothing says."""
    margin = f"{BELOW_CUT_OFF_DEGC:g} °C below the firmware's cut-off (max_temp)"
    limited = [f"{s.name} {s.low:g} to {s.high:g}" for s in outputs if s.low is not None]
    cut = [f"{s.name} {s.cut_off:g}" for s in outputs if s.cut_off is not None]
    unlimited = [s.name for s in outputs if s.low is None]
    questions = []
    if limited:
        because = (
            f"; high is {margin}, at which it switches everything off: {', '.join(cut)} °C" if cut else ""
        )
        questions.append(
            f"plant.outputs low and high, between which °C the machine must stay: now {', '.join(limited)} °C"
            + because
        )
    if unlimited:
        advice = f"; set high {margin}, which the log does not hold" if kind in FIRMWARE_KINDS else ""
        questions.append(
            f"plant.outputs low and high of {', '.join(unlimited)}: between which °C the machine must stay"
            + advice
        )
    return questions


def _questions_on_inputs(inputs: Sequence[Proposed]) -> list[str]:
    """What the recording cannot tell of the inputs: what 100 % is, the limits, and which can only warm."""
    questions = []
    # 0 to 1 is a duty, and one in percent is taken as it is
    scaled = [f"{s.source} {100 / s.scale:.4g}" for s in inputs if s.scale not in (1.0, 100.0)]
    if scaled:
        questions.append(f"ingest.mapping scale, what is 100 % of the input: now {', '.join(scaled)}")
    odd = [f"{s.name} {s.low:g} to {s.high:g}" for s in inputs if (s.low, s.high) != (0.0, 100.0)]
    if odd:
        questions.append(
            "plant.inputs low and high, what the machine can give: now what was recorded, " + ", ".join(odd)
        )
    unmarked = [s.name for s in inputs if not s.heats]
    if unmarked:
        questions.append(
            f"plant.inputs heats of {', '.join(unmarked)}: write heats: true beside each that can only warm; "
            "an identified gain of the wrong sign is flagged then"
        )
    return questions


# ---- files


def write(
    values: dict[str, list[str]], *, force: bool, dry_run: bool = False, path: str | Path = params.FILE
) -> tuple[list[str], list[str]]:
    """Writes the values into params.yaml and params.expert.yaml beside it; returns the keys that were
    written, and those that a person edited. With `dry_run` the keys are returned and nothing is written.

    A key that holds neither what was shipped nor what is written now was edited: without `force` it stays,
    and nothing is written, for the keys of a machine belong together.
    """
    sections = params.read(path)
    changes = {dotted: lines for dotted, lines in values.items() if _at(sections, dotted) != _parsed(lines)}
    edited = [dotted for dotted in changes if _at(sections, dotted) != SHIPPED[dotted]]
    if edited and not force:
        return [], edited
    for file in params.files(path):
        before = text = Path(file).read_text(encoding="utf-8")
        for dotted, lines in changes.items():
            if params.home(dotted, path) == file:
                text = replaced(text, dotted, lines)
            elif dotted == "plant.disturbances" and params.home("plant.inputs", path) == file:
                text = inserted(text, dotted, lines)
        if text != before and not dry_run:
            artifacts.write_text(file, text)
    return list(changes), []


def _parsed(lines: Sequence[str]) -> Any:
    return yaml.safe_load("\n".join(lines))


def _at(sections: dict, dotted: str) -> Any:
    value: Any = sections
    for key in dotted.split("."):
        value = value.get(key) if isinstance(value, dict) else None
    return [] if value is None and dotted == "plant.disturbances" else value


def copy(paths: Sequence[Path], folder: Path = RAW) -> list[Path]:
    """The recordings copied into `folder`, a klippy.log with the printed files that it was read with; one
    that lies there already stays. Raises ValueError for another file of the same name."""
    folder.mkdir(parents=True, exist_ok=True)
    copied = []
    printed = [file for path in paths if file_format(path) == "klippy.log" for file in printed_files(path)]
    for path in [*paths, *dict.fromkeys(printed)]:
        target = folder / path.name
        if target.resolve() == path.resolve():
            continue
        if target.exists() and (path.is_dir() or target.read_bytes() != path.read_bytes()):
            raise ValueError(f"{target} is there already with other content; rename one of the two")
        if path.is_dir():
            shutil.copytree(path, target)
        elif not target.exists():
            shutil.copyfile(path, target)
        copied.append(target)
    return copied


def summary(
    initialised: Initialised,
    changed: Sequence[str],
    edited: Sequence[str],
    paths: Sequence[Path],
    copied: bool,
) -> str:
    """What was written, or would replace what was edited, and what is left to a person."""
    lines = [f"written: {', '.join(changed)}" if changed else "nothing to change: the files say so already"]
    if edited:
        lines = [f"kept as they are: {', '.join(edited)}. Nothing was written. With --force they would be:"]
        lines += [f"  {dotted}: {' '.join(initialised.values[dotted])}" for dotted in edited]
    off = [loop for loop, on in params.load(params.Loops, "loops").model_dump().items() if not on]
    if off:
        lines.append(f"off: {' and '.join(off)}, without recordings; loops in params.yaml switches a loop on")
    lines += ["to decide:", *(f"  {question}" for question in initialised.open_questions)]
    if not copied and any(RAW.resolve() not in path.resolve().parents for path in paths):
        lines.append(f"  put the recordings into {RAW} (or give --copy)")
    return "\n".join([*lines, "then: ./run dvc repro"])
