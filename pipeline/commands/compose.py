"""`beadline compose PART`: a part program into plunger commands as CSV, Parquet, MCAP and G-code with leads;
tasks and lines as Parquet; whether it will print as JSON."""

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.deposition import drive
from pipeline.deposition.parts import leads, part_report, stored
from pipeline.deposition.parts.composition import Composed, LearnedLibrary
from pipeline.deposition.parts.part import ComposedPart
from pipeline.deposition.tables import LIBRARY, LINES, TASKS
from pipeline.recordings.formats import Source
from pipeline.recordings.images import tables_of, write_frames
from pipeline.recordings.trial_files import COMMAND, TYPES
from pipeline.store import artifacts
from pipeline.store.tables import FLOAT, Column, Schema

FORMATS = ("csv", "parquet", "mcap", "gcode")
WIDEST_MM = 200.0  # of a filament or plunger


def read_learned() -> LearnedLibrary:
    """Library and chains, as segment_library wrote them. Raises ValueError while it waits for trials."""
    if artifacts.exists(waits := "datasets/segment_library/waits.json"):
        raise ValueError(f"nothing is learned yet: {artifacts.read_json(waits)['why']}")
    table = artifacts.read_table("datasets/segment_library/library.parquet", LIBRARY)
    return stored.restore(table, artifacts.read_json("datasets/segment_library/learned.json"))


def formats(text: str) -> tuple[str, ...]:
    """The formats of a list such as "csv,mcap". Raises ValueError for one that there is not."""
    names = tuple(name.strip().lower() for name in text.split(",") if name.strip())
    wrong = [name for name in names if name not in FORMATS]
    if wrong or not names:
        raise ValueError(f"--as: expected some of {', '.join(FORMATS)}, found {', '.join(wrong) or 'none'}")
    return names


def request(*, filament_mm: float | None, extruder: str, bead: str) -> dict[str, Any]:
    """What a person requests on the command line: keywords of `compose_parts.compose_part`. Raises ValueError
    naming the flag."""
    if filament_mm is not None and not 0 < filament_mm <= WIDEST_MM:
        raise ValueError(
            f"--filament-mm: expected a number above 0, at most {WIDEST_MM:g}, found {filament_mm:g}; "
            "write the diameter in mm"
        )
    return {
        "filament_mm": filament_mm,
        "extruder": extruder.strip().upper(),
        "declared_bead": bead == "declared",
    }


def write(part: ComposedPart, folder: Path, formats: Collection[str] = ("csv",)) -> list[Path]:
    """The commands of all tools in each format, tasks and lines as Parquet, and the conformance report as
    JSON, beside one another in `folder`: all of them, or none."""
    with artifacts.together(folder) as place:
        files = _write_commands(part, place, formats)
        # one after the other: a long part's tables are as long as itself
        for schema, rows in ((TASKS, part_report.task_rows), (LINES, part_report.line_rows)):
            files.append(place / f"{part.name}.{schema.name}.parquet")
            artifacts.write_table(files[-1], schema, rows(part))
        files.append(place / f"{part.name}.conformance.json")
        artifacts.write_json(files[-1], part_report.report(part))
    return [folder / file.name for file in files]


def _write_commands(part: ComposedPart, folder: Path, formats: Collection[str]) -> list[Path]:
    """The commands of all tools on one clock, in each of the formats."""
    composed, files = part.composed, []
    time_s = np.arange(len(composed.streams[0].u)) * composed.sample_time_s
    unit = "mm/s" if composed.command == "speed" else "mm"
    columns = {"time_s": time_s} | {
        f"T{stream.tool}_{stream.material}_{unit.replace('/', '_per_')}": drive.sent(
            stream.u, composed.command, sample_time_s=composed.sample_time_s
        )
        for stream in composed.streams
    }
    if "csv" in formats:
        files.append(folder / f"{part.name}.signal.csv")
        artifacts.write_csv(files[-1], columns)
    if "parquet" in formats:
        files.append(folder / f"{part.name}.signal.parquet")
        time = Column("time_s", FLOAT, "s", "time since the plunger may move first")
        tools = [Column(name, FLOAT, unit, "plunger command of the tool") for name in list(columns)[1:]]
        artifacts.write_table(files[-1], Schema("commands", 1, (time, *tools)), columns)
    if "mcap" in formats:
        files.append(folder / f"{part.name}.signal.mcap")
        sources = zip(_sources(composed), list(columns.values())[1:], strict=True)
        tables = tables_of(files[-1], time_s, list(sources))
        write_frames(files[-1], tables, dict.fromkeys(tables, TYPES["/plunger"]), time_s, None)
    if "gcode" in formats:
        files.append(folder / f"{part.name}.leads.gcode")
        artifacts.write_lines(files[-1], with_leads(part))
    return files


def _sources(composed: Composed) -> list[Source]:
    """Where the commands stand in a recording: the trials' topic if there is one tool, else one a tool."""
    field = COMMAND.source.partition(":")[2]
    if len(composed.streams) == 1:
        return [COMMAND]
    return [COMMAND._replace(source=f"/plunger/T{stream.tool}:{field}") for stream in composed.streams]


def with_leads(part: ComposedPart) -> Iterator[str]:
    """The part's lines of G-code whose E is what is pushed, and at its end the volume of the part over area
    and identified flow ratio (`leads.lines`). A pressure has no flow ratio: E counts the program's own
    filament, and is the plunger's place if its diameter is not known."""
    program, composed, area = part.program, part.composed, part.extruded.area_mm2
    commands = {stream.tool: stream.u for stream in composed.streams}
    speeds = composed.command != "pressure" or all(tool in area for tool in commands)
    if composed.command == "pressure" and speeds:
        commands = {
            one.tool: one.u * (one.r.sum() / (area[one.tool] * one.u.sum())) for one in composed.streams
        }
    return leads.lines(
        program.moves, part.planned, commands, speeds=speeds,
        letter=program.extruder if len(program.extruder) == 1 and program.extruder.isalpha() else "E",
        lead_in_s=composed.lead_in_s, sample_time_s=composed.sample_time_s,
    )  # fmt: skip
