"""`beadline experiment setpoint`: the G-code of a print from which the classifier learns, and which setting
holds from which line on.

A cuboid, as Li and Pattinson (2025) and CAXTON (Brion and Pattinson 2022) print them: each combination of
flow (M221) and temperature (M109) has a layer of lines laid back and forth, and between two of these a layer
at 100 % and the best temperature, so that all are laid on the same ground.
"""

import csv
import io
import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.setpoint.simulation.simulator import FLOW_LIMITS
from pipeline.store import artifacts

# least and largest of each flag, with its unit
BOUNDS = {
    "--bed": (10.0, 2000.0, "mm"), "--nozzle": (0.1, 2.0, "mm"), "--filament": (1.0, 3.5, "mm"),
    "--bed-temperature": (0.0, 150.0, "degC"),
    "--temperatures": (150.0, 320.0, "degC"), "--flows": (*FLOW_LIMITS, "percent"),
    "--melt": (0.5, 200.0, "mm^3/s"),
}  # fmt: skip
# how many numbers a flag takes; one if it does not stand here, 0: any
COUNTS = {"--bed": 3, "--flows": 0, "--temperatures": 0}
# mm along x and y of the cuboid, if the bed has room for it, and the least of which anything can be seen
CUBOID, LEAST = (50.0, 20.0), 10.0
# mm/s of lines, if the hot end melts as much, and between them; height of a layer as a share of the nozzle
SPEED, TRAVEL, LAYER = 20.0, 100.0, 0.5
# of the lines: wider than the nozzle by this; layers of ground below the first setting; mm from the bed's
# edge
WIDER, GROUND, MARGIN = 1.2, 2, 5.0
# the nozzle waits for its temperature so far beside the part and above it
ASIDE, LIFT = 12.0, 2.0
# mm of the bed that are not the cuboid's
ROOM = 2 * (ASIDE + 2 * MARGIN)
RETRACT, LIFT_SPEED = 1.0, 10.0
MOST_SETTINGS = 400
COLUMNS = (
    "img_path", "timestamp", "flow_rate", "feed_rate", "z_offset", "target_hotend", "hotend", "bed",
    "nozzle_tip_x", "nozzle_tip_y", "print_id", "collect", "layer", "line_from", "line_to", "seconds",
)  # fmt: skip


class TrainingPrint(NamedTuple):
    """What is printed: flows in percent, temperatures in degC; bed (x, y) and height, size (x, y) of the
    cuboid, nozzle, layer and filament in mm; speeds in mm/s; bed and best temperature in degC."""

    flows: tuple[float, ...]
    temperatures: tuple[float, ...]
    bed: tuple[float, float]
    height: float
    size: tuple[float, float]
    nozzle: float
    layer: float
    filament: float
    speed: float
    travel: float
    bed_temperature: float
    best_temperature: float


class PrintLayer(NamedTuple):
    """A layer at z mm: its flow in percent and temperature in degC, whether pictures of it are to be learned
    from, the lines of the program (from 1) that lay it, and the seconds of its extruding moves."""

    flow: float
    temperature: float
    collect: bool
    z: float
    line_from: int
    line_to: int
    seconds: float


class PrintProgram(NamedTuple):
    """The lines of the G-code, and the settings in their order."""

    lines: list[str]
    settings: list[PrintLayer]


def numbers(text: str, flag: str, count: int = 0) -> tuple[float, ...]:
    """The numbers of a flag, such as 60,80,100, each within its bounds; as many as `count`, if not 0."""
    low, high, unit = BOUNDS[flag]
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if not values or (count and len(values) != count) or not all(low <= value <= high for value in values):
        how = f"{count} numbers" if count > 1 else "one number" if count else "numbers"
        raise ValueError(
            f"{flag}: expected {how} from {low:g} to {high:g} {unit}, with commas between, found {text!r}; "
            "write them so"
        )
    return values


def read(options: Mapping[str, object], best_temperature: float) -> TrainingPrint:
    """The print that the command's options ask for, each a text, and the material's best temperature in degC.
    The lines are as fast as the hot end melts at the largest flow. Raises ValueError, one sentence, for an
    option outside its bounds."""
    found = {
        flag: numbers(str(options[flag[2:].replace("-", "_")]), flag, COUNTS.get(flag, 1)) for flag in BOUNDS
    }
    x, y, height = found["--bed"]
    (nozzle,), (filament,), (melt,) = found["--nozzle"], found["--filament"], found["--melt"]
    (bed,) = found["--bed-temperature"]
    asked = TrainingPrint(
        flows=found["--flows"], temperatures=found["--temperatures"], bed=(x, y), height=height,
        size=(min(CUBOID[0], x - ROOM), min(CUBOID[1], y - ROOM)), nozzle=nozzle, layer=LAYER * nozzle,
        filament=filament, speed=SPEED, travel=TRAVEL, bed_temperature=bed, best_temperature=best_temperature,
    )  # fmt: skip
    most = melt / (_line_area(asked) * max(*asked.flows, 100.0) / 100.0)
    return asked._replace(speed=min(SPEED, most))


def check(asked: TrainingPrint) -> None:
    """Raises ValueError, one sentence, for what does not fit onto the bed or through the nozzle, and for
    settings of which nothing can be learned."""
    for name, values in (("--flows", asked.flows), ("--temperatures", asked.temperatures)):
        if len(set(values)) != len(values):
            raise ValueError(f"{name}: expected different numbers, found one twice; leave it out")
    count = len(asked.flows) * len(asked.temperatures)
    if count > MOST_SETTINGS:
        raise ValueError(f"expected at most {MOST_SETTINGS} settings, found {count}; print in two parts")
    for axis, size, bed in zip("xy", asked.size, asked.bed, strict=True):
        if size < LEAST:
            raise ValueError(
                f"--bed: expected at least {LEAST + ROOM:g} mm along {axis}, for a cuboid of {LEAST:g} mm "
                f"and the nozzle's place to wait, found {bed:g}; print on a larger bed"
            )
    top = _tops(asked)[-1] + LIFT
    if top > asked.height:
        raise ValueError(
            f"the cuboid of {count} settings ends at {top:.1f} mm but --bed leaves {asked.height:g}; ask "
            "for fewer settings"
        )


def program(asked: TrainingPrint) -> PrintProgram:
    """The G-code. Raises ValueError as `check` does."""
    check(asked)
    lines = _begin(asked)
    settings: list[PrintLayer] = []
    for number, ((flow, temperature, collect), z) in enumerate(
        zip(_layers(asked), _tops(asked), strict=True)
    ):
        what = f"layer {number} flow {flow:g} target {temperature:g} collect {int(collect)}"
        lines += _heat(asked, settings[-1] if settings else None, temperature, z)
        # in the program, and as it runs in the host's log, which tells when
        lines += [f"; {what}", f"M118 beadline {what}"]
        first = len(lines) + 1
        moves, length = _raster(asked, z, flow, along_x=number % 2 == GROUND % 2)
        lines += moves
        settings.append(PrintLayer(flow, temperature, collect, z, first, len(lines), length / asked.speed))
    return PrintProgram(lines + _end(asked, settings[-1].z), settings)


def write(asked: TrainingPrint, out: Path, tip: tuple[float, float] | None) -> str:
    """Writes the program to `out` and its settings beside it as CSV; what a person is told."""
    made = program(asked)
    beside = out.with_suffix(".settings.csv")
    artifacts.write_text(out, "\n".join(made.lines) + "\n")
    artifacts.write_text(beside, _table(asked, made, out.stem, tip))
    collected = [setting for setting in made.settings if setting.collect]
    minutes = sum(setting.seconds for setting in made.settings) / 60
    return (
        f"{out}: {len(collected)} settings of flow and temperature, {len(made.settings)} layers, "
        f"{made.settings[-1].z:.1f} mm high, about {minutes:.0f} minutes without heating\n"
        f"{beside}: which setting holds from which line on; give each picture of a layer with collect 1 its "
        "line of it, with img_path, and put both into datasets/raw/setpoint\n"
        "Look through the program before it runs: it was written for the bed, nozzle and filament that were "
        "told, and has not been printed."
    )


# ---- the layers


def _layers(asked: TrainingPrint) -> list[tuple[float, float, bool]]:
    """(flow, temperature, whether it is collected) of each layer. Within a temperature flows follow one
    another so that too much and too little take turns: no trend over the height is one over the flow."""
    between = (100.0, asked.best_temperature, False)
    layers = [between] * GROUND
    for temperature in asked.temperatures:
        left, excess = list(asked.flows), 0.0
        while left:
            flow = min(left, key=lambda f, excess=excess: (abs(excess + f - 100.0), f))
            left.remove(flow)
            excess += flow - 100.0
            layers += [(flow, temperature, True), between]
    return layers


def _tops(asked: TrainingPrint) -> list[float]:
    """z of the nozzle in each layer, mm: above a layer with too much in it there is less room, so the next is
    higher by what was laid."""
    heights = [asked.layer * max(1.0, flow / 100.0) for flow, _, _ in _layers(asked)]
    return [asked.layer, *(asked.layer + z for z in np.cumsum(heights[:-1]).tolist())]


def _line_area(asked: TrainingPrint) -> float:
    """mm^2 of a line's cross-section: as far apart as the lines lie times the layer's height, so that 100 %
    fills the cuboid."""
    return _spacing(asked) * asked.layer


def _spacing(asked: TrainingPrint) -> float:
    """mm between lines with round sides, 1.2 nozzles wide, that touch: w - h (1 - pi / 4)."""
    return WIDER * asked.nozzle - asked.layer * (1 - np.pi / 4)


def _corner(asked: TrainingPrint) -> tuple[float, float]:
    return (asked.bed[0] - asked.size[0]) / 2, (asked.bed[1] - asked.size[1]) / 2


def _raster(asked: TrainingPrint, z: float, flow: float, *, along_x: bool) -> tuple[list[str], float]:
    """Lines back and forth over the cuboid at this flow, and their length in mm. What is drawn back between
    layers is so at 100 %, or more would come forward than went back."""
    corner, size = _corner(asked), asked.size if along_x else asked.size[::-1]
    count = max(2, round(size[1] / _spacing(asked)))
    spacing = size[1] / count
    per_mm = spacing * asked.layer / (np.pi / 4 * asked.filament**2)
    across = (np.arange(count) + 0.5) * spacing
    moves, length, at = [], 0.0, None
    for k, offset in enumerate(across):
        ends = [(spacing / 2, float(offset)), (size[0] - spacing / 2, float(offset))]
        for point in ends[:: 1 if k % 2 == 0 else -1]:
            x, y = point if along_x else point[::-1]
            word = f"X{corner[0] + x:.3f} Y{corner[1] + y:.3f}"
            if at is None:
                moves += [f"G0 Z{z + LIFT:.3f} F{60 * LIFT_SPEED:g}", f"G0 {word} F{60 * asked.travel:g}"]
                moves += [f"G0 Z{z:.3f} F{60 * LIFT_SPEED:g}", f"G1 E{RETRACT:.5f} F1800"]
                moves += [f"M221 S{flow:g}", f"G1 F{60 * asked.speed:g}"]
            else:
                step = float(np.hypot(x - at[0], y - at[1]))
                moves.append(f"G1 {word} E{step * per_mm:.5f}")
                length += step
            at = (x, y)
    return [*moves, "M221 S100", f"G1 E{-RETRACT:.5f} F1800"], length


def _heat(asked: TrainingPrint, before: PrintLayer | None, temperature: float, z: float) -> list[str]:
    """If the temperature of a layer is another one, the nozzle waits for it beside the part; R waits for
    cooling too."""
    if before is not None and before.temperature == temperature:
        return []
    x, y = _corner(asked)
    return [
        f"G0 Z{z + LIFT:.3f} F{60 * LIFT_SPEED:g}",
        f"G0 X{x - ASIDE:.3f} Y{y:.3f} F{60 * asked.travel:g}",
        f"M109 {'S' if before is None or before.temperature < temperature else 'R'}{temperature:g}",
    ]


def _begin(asked: TrainingPrint) -> list[str]:
    """Units, heat, home, and a line along the front that fills the nozzle."""
    per_mm = _line_area(asked) / (np.pi / 4 * asked.filament**2)
    length = min(asked.bed[0] - 4 * MARGIN, 100.0)
    flows, temperatures = (",".join(f"{v:g}" for v in vs) for vs in (asked.flows, asked.temperatures))
    return [
        f"; training print: flows {flows} %, temperatures {temperatures} degC",
        f"; nozzle {asked.nozzle:g} mm, filament_diameter = {asked.filament:g}, layer {asked.layer:g} mm",
        "G21", "G90", "M83", "M220 S100", "M221 S100",
        f"M140 S{asked.bed_temperature:g}", f"M104 S{asked.best_temperature:g}", "G28",
        f"M190 S{asked.bed_temperature:g}", f"M109 S{asked.best_temperature:g}", "G92 E0",
        f"G0 Z{asked.layer:.3f} F600", f"G0 X{2 * MARGIN:g} Y{MARGIN:g} F{60 * asked.travel:g}",
        f"G1 X{2 * MARGIN + length:g} Y{MARGIN:g} E{2 * length * per_mm:.5f} F{60 * asked.speed:g}",
        f"G1 E{-RETRACT:.5f} F1800",
    ]  # fmt: skip


def _end(asked: TrainingPrint, z: float) -> list[str]:
    x, y = _corner(asked)
    return [
        f"G0 Z{z + LIFT:.3f} F600", f"G0 X{x - ASIDE:.3f} Y{y:.3f} F{60 * asked.travel:g}",
        "M104 S0", "M140 S0", "M84",
    ]  # fmt: skip


def _table(asked: TrainingPrint, made: PrintProgram, print_id: str, tip: tuple[float, float] | None) -> str:
    """The columns that a folder of frames needs, a line for each layer; timestamp in seconds of extruding
    moves since the first layer began, without heating and travel."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    began = [0.0, *itertools.accumulate(setting.seconds for setting in made.settings)]
    x, y = ("", "") if tip is None else tip
    for number, (setting, at) in enumerate(zip(made.settings, began, strict=False)):
        writer.writerow([
            "", f"{at:.2f}", f"{setting.flow:g}", "100", "0", f"{setting.temperature:g}", "",
            f"{asked.bed_temperature:g}", x, y, print_id, int(setting.collect), number, setting.line_from,
            setting.line_to, f"{setting.seconds:.2f}",
        ])  # fmt: skip
    return stream.getvalue()
