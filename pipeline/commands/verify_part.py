"""What `beadline compose PART --verify` adds: the shortest prints that show whether the forecast holds, and
what was measured of a print beside its forecast."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.deposition.parts import forecast, verification
from pipeline.deposition.parts.composition import Composed, Learned, Material, Stream
from pipeline.deposition.workflow import compose_parts, exports
from pipeline.deposition.workflow.compose_parts import Part
from pipeline.deposition.workflow.settings import ComposeParts, Printer
from pipeline.deposition.workflow.trial_files import COMMAND as COMMAND_TOPIC
from pipeline.reading import recordings
from pipeline.reading.formats import file_format
from pipeline.reading.mcap_columns import topics
from pipeline.reading.parquet_files import parquet_columns
from pipeline.reading.signals import Source
from pipeline.store import artifacts

COLUMNS, COMMAND = ("time_s", "flow_mm3_per_s"), "command_mm"
ENDINGS = (".csv", ".parquet", ".mcap")


class Measured(NamedTuple):
    """A measured print at the clock of the command: flow y (T,) in mm^3/s, NaN where it was not seen, and the
    command u (T,) in mm that was printed, where the file has it."""

    y: np.ndarray
    u: np.ndarray | None


def write(part: Part, learned: Learned, printer: Printer, settings: ComposeParts, folder: Path) -> str:
    """For each material of the part its verification print, as G-code and, composed as any part is, as
    command, tasks and report, in `folder`; in words what was written and what each is forecast to come to."""
    told = []
    for stream in part.composed.streams:
        hardest = verification.windows(
            _flows(part.composed, stream, learned),
            stream.r,
            part.composed.lines,
            stream.tool,
            sample_time_s=part.composed.sample_time_s,
        )
        made = verification.program(
            part.name, hardest, part.composed.lines, stream.tool, bead_area_mm2=printer.bead_area_mm2
        )
        path = folder / f"{part.name}_verify_{stream.material}.gcode"
        artifacts.write_text(path, made.text)
        composed = compose_parts.compose(path, learned, printer, settings)
        files = exports.write(composed, folder)
        events = ", ".join(window.event for window in hardest)
        told.append(
            f"verification of {part.name}, {stream.material}: {events} in {made.duration_s:.0f} s: {path}, "
            + ", ".join(str(file) for file in files)
        )
        told.append(compose_parts.forecast_sentence(composed.composed, composed.composed.streams[0]))
        told.append(
            f"print it; copy it and its measured flow, as {measured_name(path.stem, stream.material)} with "
            f"columns {' and '.join(COLUMNS)} (or .parquet, or .mcap with the plunger's topic), to "
            "datasets/parts: the page then shows it beside the forecast"
        )
    return "\n".join(told)


def _flows(composed: Composed, stream: Stream, learned: Learned) -> np.ndarray:
    material = _material(learned, stream)
    Ts = composed.sample_time_s
    return forecast.flows(material.chain, material.missed, stream.u, stream.r, sample_time_s=Ts)


def _material(learned: Learned, stream: Stream) -> Material:
    return next(
        one
        for one in learned.materials
        if (one.material, one.nozzle_mm) == (stream.material, stream.nozzle_mm)
    )


# ---- what was measured


def measured_name(part: str, material: str, ending: str = ".csv") -> str:
    """The file that holds the measured flow of a part's print."""
    return f"{part}_{material}_measured{ending}"


def measured_path(folder: Path, part: str, material: str) -> Path | None:
    """The file in `folder` with the measured flow of a part's print, whatever its form; None where there is
    none. Raises ValueError where there are two."""
    paths = [folder / measured_name(part, material, ending) for ending in ENDINGS]
    there = [path for path in paths if path.exists()]
    if len(there) > 1:
        names = " and ".join(path.name for path in there)
        raise ValueError(
            f"{folder}: expected one measured print of {part}, {material}, found {names}; keep one"
        )
    return there[0] if there else None


def with_measured(reports: dict[str, Any], parts: Sequence[Part], folder: Path) -> dict[str, Any]:
    """The conformance reports with measured_percent beside the forecast of each material whose print was
    measured."""
    for part in parts:
        for stream in part.composed.streams:
            path = measured_path(folder, part.name, stream.material)
            if path:
                y = read_measured(path, len(stream.r), part.composed.sample_time_s).y
                with artifacts.about(path):
                    percent = verification.measured_percent(y, stream.on_off, stream.r)
                reports[part.name]["forecast"][stream.material]["measured_percent"] = percent
    return reports


def read_measured(path: Path, samples: int, sample_time_s: float) -> Measured:
    """A measured print, (samples,) at the clock of the command; the flow is NaN before the first, after the
    last row and in gaps longer than five samples. Time 0 is where the command begins: of a table as it
    stands, of an MCAP recording the first message of the plunger. Raises ValueError naming file and place."""
    flow, command = _rows(path) if path.suffix == ".csv" else _recorded(path)
    t, y = flow
    clock = np.arange(samples) * sample_time_s
    after = np.clip(np.searchsorted(t, clock), 1, len(t) - 1)
    seen = (clock >= t[0] - 1e-9) & (clock <= t[-1] + 1e-9)
    seen &= t[after] - t[after - 1] <= 5 * max(sample_time_s, float(np.median(np.diff(t))))
    u = None if command is None else np.interp(clock, *command)
    if u is not None and not np.isfinite(u).all():
        raise ValueError(
            f"{path}: expected a number in each row of {COMMAND}, found some without; fill them in"
        )
    return Measured(np.where(seen, np.interp(clock, t, y), np.nan), u)


# a signal on its own clock: time_s (n,), rising, and its values (n,)
Series = tuple[np.ndarray, np.ndarray]


def _recorded(path: Path) -> tuple[Series, Series | None]:
    """Flow and, where it has one, command of a Parquet table or an MCAP recording."""
    kind, wanted = file_format(path), [Source(COLUMNS[1], COLUMNS[1], "mm^3/s")]
    if kind == "mcap":
        plunger = topics(path).get(COMMAND_TOPIC.source.partition(":")[0])
        wanted += [COMMAND_TOPIC] if plunger and plunger.count else []
    elif kind == "parquet":
        wanted += [Source(COMMAND, COMMAND, "mm")] * any(one.name == COMMAND for one in parquet_columns(path))
    else:
        raise ValueError(f"{path}: expected a Parquet table or an MCAP recording, found {kind}; name it so")
    raw = recordings.read(path, wanted, time="" if kind == "mcap" else COLUMNS[0])
    if raw.breaks:
        raise ValueError(f"{path}: its clock starts over after {raw.breaks[0]:g} s; keep one print of it")
    flow, command = raw.signals[COLUMNS[1]], raw.signals.get(COMMAND)
    start = 0.0
    if kind == "mcap" and command is not None:
        start = float(command[0][0])
    elif any(note.kind == "clock" for note in raw.notes):
        raise ValueError(
            f"{path}: expected the command, {COMMAND_TOPIC.source}, for its first message is time 0 of the "
            "flow; record it too, or write a table with time 0 where the command begins"
        )
    if len(flow[0]) < 2:
        raise ValueError(f"{path}: expected at least two samples of {COLUMNS[1]}, found {len(flow[0])}")
    return (flow[0] - start, flow[1]), None if command is None else (command[0] - start, command[1])


def _rows(path: Path) -> tuple[Series, Series | None]:
    """Flow and, where it has one, command of a CSV table."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    names = tuple(name.strip() for name in rows[0]) if rows else ()
    if names not in (COLUMNS, (*COLUMNS, COMMAND)):
        found = ",".join(rows[0]) if rows else "an empty file"
        raise ValueError(
            f"{path}: expected the columns {','.join(COLUMNS)} but found {found}; write them as the first row"
        )
    values = []
    for number, row in enumerate(rows[1:], 2):
        try:
            figures = [float(cell) for cell in row]
        except ValueError:
            figures = []
        if len(figures) != len(names):
            raise ValueError(
                f"{path}, row {number}: expected {len(names)} numbers but found {','.join(row)}; mend it "
                "or leave the row out"
            )
        values.append(figures)
    t, y, *u = np.array(values, float).reshape(-1, len(names)).T
    if len(t) < 2 or np.any(np.diff(t) <= 0) or not np.isfinite(t).all():
        raise ValueError(
            f"{path}: expected at least two rows whose {COLUMNS[0]} rises; sort them, and leave out repeats"
        )
    return (t, y), (t, u[0]) if u else None


# ---- learning on


def next_command(part: Part, learned: Learned, printer: Printer, folder: Path) -> dict[str, np.ndarray]:
    """For each material whose print was measured the command (T,) in mm of the next one: that which was
    printed, and beside it what makes up for half of what the print lacked. That command is the composed one,
    unless the file tells another."""
    commands = {}
    for stream in part.composed.streams:
        path = measured_path(folder, part.name, stream.material)
        if path:
            measured = read_measured(path, len(stream.r), part.composed.sample_time_s)
            commands[stream.material] = verification.next_command(
                _material(learned, stream).chain.extruder,
                stream.u if measured.u is None else measured.u,
                measured.y,
                stream.r,
                drive=printer.limits,
                sample_time_s=part.composed.sample_time_s,
            )
    return commands


def write_next(part: Part, learned: Learned, printer: Printer, measured: Path, folder: Path) -> str:
    """The commands that follow from the measured prints of the part in `measured`, as CSV in `folder`; in
    words what was written."""
    commands, told = next_command(part, learned, printer, measured), []
    for material, u in commands.items():
        path = folder / f"{part.name}_{material}_next.csv"
        clock = np.arange(len(u)) * part.composed.sample_time_s
        artifacts.write_csv(path, {COLUMNS[0]: clock, COMMAND: u})
        told.append(f"the next command for {material}, learned from its measured print: {path}")
    names = ", ".join(measured_name(part.name, stream.material) for stream in part.composed.streams)
    return "\n".join(told) or f"to learn on from this command, put the measured flow beside the part: {names}"
