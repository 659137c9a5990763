"""A part program as it is found: read, resized, with the volumes that E wants, and told in words."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.deposition.parts import extrusion
from pipeline.deposition.parts.composition import Composed
from pipeline.deposition.parts.conformance import Conformance
from pipeline.deposition.parts.extrusion import Extruded
from pipeline.deposition.toolpath import gcode
from pipeline.deposition.toolpath.gcode_words import Refusals
from pipeline.deposition.toolpath.motion import Motion
from pipeline.deposition.workflow.settings import Printer
from pipeline.reading.plain_files import check_plain_file
from pipeline.store import artifacts

LARGEST_MB, LONGEST_H = 1000, 72
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
    mm, tools = printer.filament_mm, [material.tool for material in printer.materials]
    declared = {} if mm is None else dict.fromkeys(tools, mm)
    found = extrusion.wanted(
        program, bead_area_mm2=printer.bead_area_mm2, asked_mm=asked.filament_mm,
        declared_mm=declared, scale=asked.scale,
    )  # fmt: skip
    if asked.declared_bead:
        return found._replace(source=dict.fromkeys(found.source, "the declared bead was asked for"))
    return found


def check_duration(moves: gcode.Moves, planned: Motion) -> None:
    """Raises ValueError, naming the line, for a plan longer than any print: an F or a dwell slipped."""
    hours = float(planned.duration_s.sum()) / 3600
    if not hours <= LONGEST_H:
        slow = int(planned.duration_s.argmax())
        raise ValueError(
            f"expected a print of at most {LONGEST_H} h, found {hours:.3g} h, of which line "
            f"{moves.line[slow]} takes {planned.duration_s[slow] / 3600:.3g} h; check its F or its dwell, "
            "or cut the program"
        )


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


def grouped(report: Conformance, refusals: Sequence[gcode.Refusal]) -> list[gcode.Refusal]:
    """What was not composed as it stands, by kind, each with its first line and how many there are: what
    the report refuses, and what the reader did."""
    kinds = Refusals()
    for one in report.refused:
        kinds.add([one.line], one.why)
    return sorted([*kinds.grouped(), *refusals])


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
    share = one.by_e_mm3 / one.declared_mm3
    return (
        f"T{one.tool}: E asks for {one.by_e_mm3:.4g} mm^3, {share:.2f} of the declared bead's "
        f"{one.declared_mm3:.4g} mm^3; its lines have {low:.3g} to {high:.3g} mm^2, half of the length below "
        f"{middle:.3g}, declared {bead_area_mm2:g}"
    )


def refused(report: Conformance, program: gcode.Program) -> list[str]:
    """The refusals by kind, the first SHOWN of them."""
    kinds = grouped(report, program.refusals)
    more = [f"and {len(kinds) - SHOWN:,} more kinds in the report"] if len(kinds) > SHOWN else []
    return [f"line {one.line}: {one.why}" for one in kinds[:SHOWN]] + more


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
