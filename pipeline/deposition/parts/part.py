"""A part program composed: volumes by E, the gantry's plan, the commands of all tools, and whether it will
print."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from pipeline.deposition.parts import composition, conformance, extrusion, part_motion
from pipeline.deposition.parts.composition import Composed, LearnedLibrary, PartSettings
from pipeline.deposition.parts.conformance import Conformance
from pipeline.deposition.parts.extrusion import Extruded
from pipeline.deposition.toolpath import gcode
from pipeline.deposition.toolpath.gcode import PartProgram
from pipeline.deposition.toolpath.motion import Motion


class ComposedPart(NamedTuple):
    """A part program read, planned, composed, and whether it will print."""

    name: str
    program: PartProgram
    planned: Motion
    composed: Composed
    conformance: Conformance
    extruded: Extruded
    bead_area_mm2: float


def parse(data: bytes, *, scale: float = 1.0, speed: float = 1.0, extruder: str = "") -> PartProgram:
    """The part program with X, Y and Z `scale` times as large and feeds `speed` times as fast. Raises
    ValueError if nothing of it prints because what would was refused."""
    program = gcode.parse(data, extruder=extruder)
    if not np.any(program.moves.kind == gcode.Kind.EXTRUDE) and program.refusals:
        first = program.refusals[0]
        raise ValueError(
            f"line {first.line}: {first.why}; it was left out, "
            "and nothing of the program that could be read prints"
        )
    return extrusion.resized(program, scale=scale, speed=speed)


def volumes(
    program: PartProgram,
    *,
    bead_area_mm2: float,
    declared_mm: Mapping[int, float],
    filament_mm: float | None = None,
    scale: float = 1.0,
    declared_bead: bool = False,
) -> Extruded:
    """The volume of every move: by E if its diameter is known, requested as filament_mm or declared by tool,
    else the declared bead's; with declared_bead the latter for all."""
    if declared_bead:
        program = program._replace(extruder="")
    extruded = extrusion.wanted(
        program, bead_area_mm2=bead_area_mm2, asked_mm=filament_mm, declared_mm=declared_mm, scale=scale
    )
    if declared_bead:
        return extruded._replace(source=dict.fromkeys(extruded.source, "the declared bead was asked for"))
    return extruded


def compose(
    name: str,
    program: PartProgram,
    extruded: Extruded,
    learned: LearnedLibrary,
    settings: PartSettings,
    gantry: Mapping[str, float],
    *,
    longest_ramp_s: float | None,
    materials: dict[int, str],
    shortest_s: float,
    largest_error_percent: float,
) -> ComposedPart:
    """A part program, composed; `materials` are the tools' names. Raises ValueError naming the line if there
    is one."""
    area, moves = settings.bead_area_mm2, program.moves
    planned = part_motion.plan_part(moves, gantry, settings, learned, materials, longest_ramp_s)
    # a printed line is as long as the declared bead would be of the volume that E asks for
    beads = extrusion.as_lengths(program, extruded, bead_area_mm2=area)
    composed = composition.compose(learned, beads, planned, settings, materials=materials)
    report = conformance.conform(
        composed, learned, bead_area_mm2=area, ramp_s=settings.ramp_s, drive=settings.drive,
        shortest_s=shortest_s, largest_error_percent=largest_error_percent,
        least_mm3=area * settings.nozzle_mm,
    )  # fmt: skip
    # the lines' own lengths, not those of their beads
    report = report._replace(lines=report.lines._replace(length_mm=moves.length[composed.lines.move]))
    if not all(one.enough for one in report.saturation.values()):
        ramp_s = part_motion.sufficient_ramp(moves, gantry, settings, learned, materials)
        report = report._replace(ramp_that_would_do_s=ramp_s)
    return ComposedPart(name, program, planned, composed, report, extruded, area)
