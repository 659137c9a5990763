"""What E presses out: mm^3 of every move by RepRap's arithmetic, the diameter of what E pushes, and the
declared bead beside it."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from pipeline.deposition.toolpath.gcode import Kind, Moves, PartProgram


class Extruded(NamedTuple):
    """What is wanted of every printed move: volume_mm3 (N,), by E where the diameter of what it pushes is
    known, else bead area x length, NaN for moves that do not print; by_e (N,) tells which. source: in words
    by tool where the diameter is from, or why E does not count. area_mm2: by tool the volume in mm^3 of 1 mm
    of E, if that is known."""

    volume_mm3: np.ndarray
    by_e: np.ndarray
    source: dict[int, str]
    area_mm2: dict[int, float]


class VolumeDifference(NamedTuple):
    """E of one tool beside the declared bead: volumes in mm^3 of the lines that E counts for, and the 5 %,
    50 % and 95 % quantiles of their bead area in mm^2, weighted by length."""

    tool: int
    by_e_mm3: float
    declared_mm3: float
    area_mm2: tuple[float, float, float]


def volumes(program: PartProgram, diameter_mm: Mapping[int, float]) -> np.ndarray:
    """mm^3 (N,) that E of every move presses out: e x flow x pi d^2 / 4, and e x flow where M200 makes E
    count mm^3; NaN where neither is known, and where no letter drives the extrusion."""
    moves = program.moves
    if not _lettered(program):
        return np.full(len(moves.line), np.nan)
    area = np.full(len(moves.line), np.nan)
    for tool, d in diameter_mm.items():
        area[moves.tool == tool] = np.pi * d**2 / 4
    return moves.e * program.flow * np.where(program.volumetric, 1.0, area)


def wanted(
    program: PartProgram,
    *,
    bead_area_mm2: float,
    asked_mm: float | None = None,
    declared_mm: Mapping[int, float] | None = None,
    declared_bead: bool = False,
) -> Extruded:
    """The volume of every printed move; with declared_bead the declared bead's for all. A tool's diameter is
    what was asked for, else what the program says (a slicer's comment, M200), else what the machine declares;
    without one its lines are declared beads."""
    moves, said = program.moves, program.diameter_mm
    printed = (moves.kind == Kind.EXTRUDE) & (moves.length > 0)
    diameter, source, area = {}, {}, {}
    for tool in np.unique(moves.tool[printed]).tolist():
        choices = (
            (asked_mm, "as asked"), (said.get(tool), "as the program says"),
            ((declared_mm or {}).get(tool), "as declared"),
        )  # fmt: skip
        d, where = next(((d, where) for d, where in choices if d), (None, ""))
        if declared_bead:
            source[tool] = "the declared bead was asked for"
        elif not _lettered(program):
            source[tool] = f"{program.extruder or 'nothing'} drives the extrusion, which tells no volume"
        elif np.all(program.volumetric[printed & (moves.tool == tool)]):
            source[tool], area[tool] = "E counts mm^3 (M200)", 1.0
        elif d is None:
            source[tool] = f"the diameter of what {program.extruder} pushes is not known"
        else:
            diameter[tool], source[tool] = d, f"diameter {d:g} mm, {where}"
            area[tool] = math.pi * d**2 / 4
    e = volumes(program, diameter)
    by_e = printed & np.isfinite(e) & (not declared_bead)
    volume = np.where(by_e, e, np.where(printed, bead_area_mm2 * moves.length, np.nan))
    return Extruded(volume, by_e, source, area)


def _lettered(program: PartProgram) -> bool:
    """Whether letters drive the extrusion, not a switch."""
    return bool(program.extruder) and program.extruder.isalpha()


def differences(moves: Moves, extruded: Extruded, *, bead_area_mm2: float) -> list[VolumeDifference]:
    """E beside the declared bead, of each tool whose lines E counts for."""
    found = []
    for tool in np.unique(moves.tool[extruded.by_e]).tolist():
        at = extruded.by_e & (moves.tool == tool)
        length, volume = moves.length[at], extruded.volume_mm3[at]
        order = np.argsort(volume / length, kind="stable")
        share = np.cumsum(length[order]) / length.sum()
        low, middle, high = ((volume / length)[order][np.searchsorted(share, q)] for q in (0.05, 0.5, 0.95))
        declared = bead_area_mm2 * float(length.sum())
        found.append(
            VolumeDifference(tool, float(volume.sum()), declared, (float(low), float(middle), float(high)))
        )
    return found


def as_lengths(program: PartProgram, extruded: Extruded, *, bead_area_mm2: float) -> PartProgram:
    """The program with every printed move as long as the declared bead would be of its volume: what a
    composer, which wants bead area x length, then presses out is what E asks for."""
    moves = program.moves
    length = np.where(extruded.by_e, extruded.volume_mm3 / bead_area_mm2, moves.length)
    return program._replace(moves=moves._replace(length=length))
