"""A composed part as files: its commands as CSV, Parquet, MCAP and G-code with leads; tasks and lines as
Parquet; whether it will print as JSON."""

from collections.abc import Collection
from pathlib import Path

import numpy as np

from pipeline.deposition.parts import leads
from pipeline.deposition.parts.composition import Composed
from pipeline.deposition.workflow import compose_parts
from pipeline.deposition.workflow.compose_parts import Part
from pipeline.deposition.workflow.tables import LINES, TASKS
from pipeline.deposition.workflow.trial_files import COMMAND, TYPES
from pipeline.reading.mcap_frames import tables_of, write_frames
from pipeline.reading.signals import Source
from pipeline.store import artifacts
from pipeline.store.tables import FLOAT, Column, Schema

FORMATS = ("csv", "parquet", "mcap", "gcode")
LEAD_SHARE = 0.005  # of the largest command: how near G-code with leads follows it


def formats(text: str) -> tuple[str, ...]:
    """The formats of a list such as "csv,mcap". Raises ValueError for one that there is not."""
    names = tuple(name.strip().lower() for name in text.split(",") if name.strip())
    wrong = [name for name in names if name not in FORMATS]
    if wrong or not names:
        raise ValueError(f"--as: expected some of {', '.join(FORMATS)}, found {', '.join(wrong) or 'none'}")
    return names


def write(part: Part, folder: Path, formats: Collection[str] = ("csv",)) -> list[Path]:
    """The commands of all tools in each format, tasks and lines as Parquet, and the conformance report as
    JSON, beside one another in `folder`: all of them, or none."""
    with artifacts.together(folder) as place:
        files = _commands(part, place, formats)
        # one after the other: a long part's tables are as long as itself
        for schema, rows in ((TASKS, compose_parts.task_rows), (LINES, compose_parts.line_rows)):
            files.append(place / f"{part.name}.{schema.name}.parquet")
            artifacts.write_table(files[-1], schema, rows(part))
        files.append(place / f"{part.name}.conformance.json")
        artifacts.write_json(files[-1], compose_parts.report(part))
    return [folder / file.name for file in files]


def _commands(part: Part, folder: Path, formats: Collection[str]) -> list[Path]:
    """The commands of all tools on one clock, in each of the formats."""
    composed, files = part.composed, []
    time_s = np.arange(len(composed.streams[0].u)) * composed.sample_time_s
    columns = {"time_s": time_s} | {
        f"T{stream.tool}_{stream.material}_mm": stream.u for stream in composed.streams
    }
    if "csv" in formats:
        files.append(folder / f"{part.name}.signal.csv")
        artifacts.write_csv(files[-1], columns)
    if "parquet" in formats:
        files.append(folder / f"{part.name}.signal.parquet")
        time = Column("time_s", FLOAT, "s", "time since the plunger may move first")
        tools = [Column(name, FLOAT, "mm", "plunger command of the tool") for name in list(columns)[1:]]
        artifacts.write_table(files[-1], Schema("commands", 1, (time, *tools)), columns)
    if "mcap" in formats:
        files.append(folder / f"{part.name}.signal.mcap")
        sources = zip(_sources(composed), [stream.u for stream in composed.streams], strict=True)
        tables = tables_of(files[-1], time_s, list(sources))
        write_frames(files[-1], tables, dict.fromkeys(tables, TYPES["/plunger"]), time_s, None)
    if "gcode" in formats:
        files.append(folder / f"{part.name}.leads.gcode")
        artifacts.write_text(files[-1], with_leads(part))
    return files


def _sources(composed: Composed) -> list[Source]:
    """Where the commands stand in a recording: the trials' topic where there is one tool, else one a tool."""
    field = COMMAND.source.partition(":")[2]
    if len(composed.streams) == 1:
        return [COMMAND]
    return [COMMAND._replace(source=f"/plunger/T{stream.tool}:{field}") for stream in composed.streams]


def with_leads(part: Part) -> str:
    """The part as G-code whose E is the plunger's place, so that it primes ahead of each line and lets back
    ahead of its end; with what no program can hold said in its head."""
    program, composed = part.program, part.composed
    letter = program.extruder if len(program.extruder) == 1 and program.extruder.isalpha() else "E"
    peak = max(float(np.abs(stream.u).max()) for stream in composed.streams)
    found = leads.legs(
        program.moves, part.planned, {stream.tool: stream.u for stream in composed.streams},
        lead_in_s=composed.lead_in_s, sample_time_s=composed.sample_time_s, tolerance_mm=LEAD_SHARE * peak,
    )  # fmt: skip
    head = [
        f"; {letter} is the plunger's place in mm (absolute), no filament; it moves ahead of the lines.",
        "; Feeds are means over short legs, ramps too: a firmware that accelerates slower comes late.",
    ]
    if found.lost_mm > LEAD_SHARE * peak:
        head.append(f"; Left out: {found.lost_mm:.3g} mm of a tool's command while another tool was in use.")
    return "\n".join([*head, *leads.program(found, letter=letter), ""])
