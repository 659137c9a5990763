"""`beadline compose PART --verify`: the shortest prints that show whether the forecast of a part holds, and
the next command of a part whose print was measured."""

from pathlib import Path

import numpy as np

from pipeline.commands import compose
from pipeline.deposition.parts import forecast, part_report
from pipeline.deposition.parts.composition import LearnedLibrary
from pipeline.deposition.parts.part import ComposedPart
from pipeline.deposition.settings import ComposeParts, Printer
from pipeline.recordings.part_files import COLUMNS, COMMAND, print_name, print_path, read_measured
from pipeline.store import artifacts
from stages.compose_parts import compose_part


def write(
    part: ComposedPart, learned: LearnedLibrary, printer: Printer, settings: ComposeParts, folder: Path
) -> str:
    """For each material of the part its verification print, as G-code and, composed as any part is, as
    command, tasks and report, in `folder`; in words what was written and what each is forecast to come to."""
    sentences, composed = [], part.composed
    for stream in composed.streams:
        material, Ts = stream.learned, composed.sample_time_s
        flows = forecast.flows(material.chain, material.missed, stream.u, stream.r, sample_time_s=Ts)
        hardest = forecast.windows(flows, stream.r, composed.lines, stream.tool, sample_time_s=Ts)
        text, duration_s = forecast.verification_program(
            part.name, hardest, composed.lines, stream.tool, bead_area_mm2=printer.bead_area_mm2
        )
        path = folder / f"{part.name}_verify_{stream.material}.gcode"
        artifacts.write_text(path, text)
        print_ = compose_part(path, learned, printer, settings)
        files = compose.write(print_, folder)
        events = ", ".join(window.event for window in hardest)
        sentences.append(
            f"verification of {part.name}, {stream.material}: {events} in {duration_s:.0f} s: {path}, "
            + ", ".join(str(file) for file in files)
        )
        sentences.append(part_report.forecast_sentence(print_.composed, print_.composed.streams[0]))
        sentences.append(
            f"print it; copy it and its measured flow, as {print_name(path.stem, stream.material)} with "
            f"columns {' and '.join(COLUMNS)} (or .parquet, or .mcap with the plunger's topic), to "
            "datasets/parts: the page then shows it beside the forecast"
        )
    return "\n".join(sentences)


# ---- learning on


def next_commands(
    part: ComposedPart, learned: LearnedLibrary, printer: Printer, folder: Path
) -> dict[str, np.ndarray]:
    """For each material whose print was measured the command (T,) in mm of the next one: the command that was
    printed, and beside it what makes up for half of what the print lacked. The printed command is the
    composed one, unless the file holds another."""
    commands = {}
    for stream in part.composed.streams:
        path = print_path(folder, part.name, stream.material)
        if path:
            y, u = read_measured(path, len(stream.r), part.composed.sample_time_s)
            commands[stream.material] = forecast.next_command(
                stream.learned.chain.extruder,
                stream.u if u is None else u,
                y,
                stream.r,
                drive=printer.limits,
                sample_time_s=part.composed.sample_time_s,
            )
    return commands


def write_next(
    part: ComposedPart, learned: LearnedLibrary, printer: Printer, measured: Path, folder: Path
) -> str:
    """The commands that follow from the measured prints of the part in `measured`, as CSV in `folder`; in
    words what was written."""
    text = []
    for material, u in next_commands(part, learned, printer, measured).items():
        path = folder / f"{part.name}_{material}_next.csv"
        clock = np.arange(len(u)) * part.composed.sample_time_s
        artifacts.write_csv(path, {COLUMNS[0]: clock, COMMAND: u})
        text.append(f"the next command for {material}, learned from its measured print: {path}")
    names = ", ".join(print_name(part.name, stream.material) for stream in part.composed.streams)
    return "\n".join(text) or f"to learn on from this command, put the measured flow beside the part: {names}"
