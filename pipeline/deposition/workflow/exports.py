"""What a part program asks for and what becomes of it: read as it is found, with the volumes that E wants, in
words, and its commands as files (CSV, Parquet, MCAP, G-code with leads)."""

import math
from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.deposition import extrusion, gcode, leads, motion
from pipeline.deposition.composition import Composed
from pipeline.deposition.conformance import Conformance
from pipeline.deposition.extrusion import Extruded
from pipeline.deposition.workflow.settings import Printer
from pipeline.deposition.workflow.trial_files import COMMAND, TYPES
from pipeline.reading.plain_files import check_plain_file
from pipeline.store import artifacts
from pipeline.store.mcap_frames import tables_of, write_frames
from pipeline.store.tables import FLOAT, Column, Schema

FORMATS = ("csv", "parquet", "mcap", "gcode")
LARGEST_MB = 1000
LEAD_SHARE = 0.005  # of the largest command: how near G-code with leads follows it
SHOWN = 12  # refusals and words told in the summary


class Asked(NamedTuple):
    """What a person asked of a part program: X, Y and Z `scale` times as large, feeds `speed` times as fast,
    the diameter of what E pushes, what drives the extrusion, and the declared bead instead of E."""

    scale: float = 1.0
    speed: float = 1.0
    filament_mm: float | None = None
    extruder: str = ""
    declared_bead: bool = False


AS_IT_IS = Asked()


def asked(*, scale: float, speed: float, filament_mm: float | None, extruder: str, bead: str) -> Asked:
    """What was asked for on the command line. Raises ValueError naming the flag."""
    for flag, value, most in (
        ("--scale", scale, 1e3),
        ("--speed", speed, 1e3),
        ("--filament-mm", filament_mm, 200),
    ):
        if value is not None and not 0 < value <= most:
            raise ValueError(f"{flag}: expected a number above 0, at most {most:g}, found {value:g}")
    return Asked(scale, speed, filament_mm, extruder.strip().upper(), bead == "declared")


def formats(text: str) -> tuple[str, ...]:
    """The formats of a list such as "csv,mcap". Raises ValueError for one that there is not."""
    names = tuple(name.strip().lower() for name in text.split(",") if name.strip())
    wrong = [name for name in names if name not in FORMATS]
    if wrong or not names:
        raise ValueError(f"--as: expected some of {', '.join(FORMATS)}, found {', '.join(wrong) or 'none'}")
    return names


def read(path: Path, asked: Asked = AS_IT_IS) -> gcode.Program:
    """The part program, resized as asked. Raises ValueError for what is no plain file, too large, or no
    program of which something prints."""
    check_plain_file(path)
    try:
        size = path.stat().st_size / 1e6
        data = path.read_bytes() if size <= LARGEST_MB else b""
    except OSError as error:
        raise ValueError(f"{path} cannot be read ({error.strerror}); name a part program (G-code)") from None
    with artifacts.about(path):
        if size > LARGEST_MB:
            raise ValueError(f"expected at most {LARGEST_MB:,} MB of G-code, found {size:,.0f} MB; cut it")
        program = gcode.parse(data, extruder=asked.extruder)
        del data
        if not np.any(program.moves.kind == gcode.Kind.EXTRUDE) and program.refusals:
            first = program.refusals[0]
            raise ValueError(
                f"line {first.line}: {first.why}; it was left out, "
                "and nothing of the program that could be read prints"
            )
    return extrusion.resized(program, scale=asked.scale, speed=asked.speed)


def extruded(program: gcode.Program, printer: Printer, asked: Asked = AS_IT_IS) -> Extruded:
    """The volume of every move: by E where its diameter is known, else the declared bead's."""
    if asked.declared_bead:
        program = program._replace(extruder="")
    found = extrusion.wanted(
        program, bead_area_mm2=printer.bead_area_mm2, asked_mm=asked.filament_mm,
        declared_mm={} if printer.filament_mm is None else {m.tool: printer.filament_mm for m in printer.materials},
        scale=asked.scale,
    )  # fmt: skip
    if asked.declared_bead:
        return found._replace(source=dict.fromkeys(found.source, "the declared bead was asked for"))
    return found


def in_percent(
    report: Conformance, moves: gcode.Moves, composed: Composed, *, shortest_s: float, least_mm3: float
) -> Conformance:
    """The report with the lines' own lengths, and without a percent for lines of less than least_mm3: of a
    dot it tells nothing."""
    lines = report.lines
    error = np.where(lines.planned_mm3 >= least_mm3, lines.error_percent, np.nan)
    judged = (lines.duration_s >= shortest_s - 1e-9) & np.isfinite(error)
    worst = float(np.abs(error[judged]).max()) if judged.any() else math.nan
    lines = lines._replace(length_mm=moves.length[composed.lines.move], error_percent=error)
    return report._replace(lines=lines, judged=int(judged.sum()), worst_line_volume_percent=worst)


# ---- in words


def summary(program: gcode.Program, found: Extruded, printer: Printer) -> list[str]:
    """What the program drives and what E asks for beside the declared bead; words that are no moves, each
    told once; what was refused, grouped."""
    by = program.accounted
    text = [
        f"{program.lines:,} lines of the program: {by.moved:,} move, {by.read:,} set or repeat, {by.other:,} "
        f"hold other words, {by.blank:,} are empty or comment, {by.refused:,} were refused"
    ]
    text += [f"T{tool}: {volume_source(why)}" for tool, why in found.source.items()]
    text += [difference(one, printer.bead_area_mm2) for one in differences(program, found, printer)]
    text += [
        f"{one.word}, {one.count:,} x, first in line {one.line}: {one.what or 'unknown; left out'}"
        for one in program.told[:SHOWN]
    ]
    if len(program.told) > SHOWN:
        text.append(f"and {len(program.told) - SHOWN} more words that are no moves")
    return text


def volume_source(why: str) -> str:
    return f"volumes by E, {why}" if why.startswith(("diameter", "E counts")) else f"declared bead: {why}"


def differences(program: gcode.Program, found: Extruded, printer: Printer) -> list[extrusion.Difference]:
    return extrusion.differences(program.moves, found, bead_area_mm2=printer.bead_area_mm2)


def difference(one: extrusion.Difference, bead_area_mm2: float) -> str:
    low, middle, high = one.area_mm2
    return (
        f"T{one.tool}: E asks for {one.by_e_mm3:.4g} mm^3, {one.by_e_mm3 / one.declared_mm3:.2f} of the declared "
        f"bead's {one.declared_mm3:.4g} mm^3 (lines of {low:.3g} to {high:.3g} mm^2, half of the length below "
        f"{middle:.3g}; declared {bead_area_mm2:g})"
    )


def refused(report: Conformance) -> list[str]:
    """The refusals, the first SHOWN of them."""
    lines = [f"line {one.line}: {one.why}" for one in report.refused[:SHOWN]]
    return lines + (
        [f"and {len(report.refused) - SHOWN:,} more in the report"] if len(report.refused) > SHOWN else []
    )


def told(program: gcode.Program, found: Extruded, printer: Printer) -> dict[str, Any]:
    """The same for the report."""
    return {
        "lines": program.accounted._asdict(),
        "extruder": program.extruder,
        "volumes": {f"T{tool}": volume_source(why) for tool, why in found.source.items()},
        "e_beside_declared_bead": [one._asdict() for one in differences(program, found, printer)],
        "words": [one._asdict() for one in program.told],
        "refused": [one._asdict() for one in program.refusals],
    }


# ---- as files


def write_commands(
    folder: Path,
    name: str,
    program: gcode.Program,
    planned: motion.Motion,
    composed: Composed,
    formats: Collection[str],
) -> list[Path]:
    """The commands of all tools on one clock, in each of the formats."""  # fmt: skip
    time_s = np.arange(len(composed.streams[0].u)) * composed.sample_time_s
    files = []
    if "csv" in formats:
        files.append(folder / f"{name}.signal.csv")
        columns = {f"T{stream.tool}_{stream.material}_mm": stream.u for stream in composed.streams}
        artifacts.write_csv(files[-1], {"time_s": time_s, **columns})
    if "parquet" in formats:
        files.append(folder / f"{name}.signal.parquet")
        artifacts.write_table(files[-1], commands_schema(composed), {
            "time_s": time_s, **{f"T{stream.tool}_{stream.material}_mm": stream.u for stream in composed.streams},
        })  # fmt: skip
    if "mcap" in formats:
        files.append(folder / f"{name}.signal.mcap")
        sources = _sources(composed)
        tables = tables_of(
            files[-1], time_s, [(s, stream.u) for s, stream in zip(sources, composed.streams, strict=True)]
        )
        write_frames(files[-1], tables, {topic: TYPES["/plunger"] for topic in tables}, time_s, None)
    if "gcode" in formats:
        files.append(folder / f"{name}.leads.gcode")
        artifacts.write_text(files[-1], with_leads(program, planned, composed))
    return files


def _sources(composed: Composed) -> list[Any]:
    """Where the commands stand in a recording: the trials' topic where there is one tool, else one a tool."""
    field = COMMAND.source.partition(":")[2]
    if len(composed.streams) == 1:
        return [COMMAND]
    return [COMMAND._replace(source=f"/plunger/T{stream.tool}:{field}") for stream in composed.streams]


def commands_schema(composed: Composed) -> Schema:
    columns = [
        Column(f"T{stream.tool}_{stream.material}_mm", FLOAT, "mm", "plunger command of the tool")
        for stream in composed.streams
    ]
    time = Column("time_s", FLOAT, "s", "time since the plunger may move first")
    return Schema("commands", 1, (time, *columns))


def with_leads(program: gcode.Program, planned: motion.Motion, composed: Composed) -> str:
    """The part as G-code whose E is the plunger's place, so that it primes ahead of each line and lets back
    ahead of its end; with what no program can hold said in its head."""
    letter = program.extruder if len(program.extruder) == 1 and program.extruder.isalpha() else "E"
    peak = max(float(np.abs(stream.u).max()) for stream in composed.streams)
    found = leads.legs(
        program.moves, planned, {stream.tool: stream.u for stream in composed.streams},
        lead_in_s=composed.lead_in_s, sample_time_s=composed.sample_time_s, tolerance_mm=LEAD_SHARE * peak,
    )  # fmt: skip
    head = [
        f"; {letter} is the plunger's place in mm (absolute), no filament; it moves ahead of the lines.",
        "; Feeds are means over each leg: firmware that rounds them off by its own acceleration comes late.",
    ]
    if found.lost_mm > LEAD_SHARE * peak:
        head.append(f"; Left out: {found.lost_mm:.3g} mm of a tool's command while another tool was in use.")
    return "\n".join([*head, *leads.program(found, letter=letter), ""])
