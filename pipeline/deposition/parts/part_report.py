"""Reports composed parts: tables, the conformance report, figures, and the summary in words."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.deposition import drive
from pipeline.deposition.controllers import COMPOSERS
from pipeline.deposition.parts import extrusion
from pipeline.deposition.parts.composition import Composed, Stream
from pipeline.deposition.parts.conformance import Conformance
from pipeline.deposition.parts.evaluation import FULL_PART_ILC, ComposerScore, Learning
from pipeline.deposition.parts.extrusion import Extruded
from pipeline.deposition.parts.part import ComposedPart, slowed_to
from pipeline.deposition.parts.stored import finite, finite_or_none
from pipeline.deposition.toolpath import motion
from pipeline.deposition.toolpath.gcode import PartProgram
from pipeline.deposition.toolpath.gcode_words import LineRefusal, Refusals

LONGEST_LIST = 12  # refusals and words in the summary


# ---- in words


def summary_lines(part: ComposedPart) -> str:
    """Returns the conformance report in words, line by line."""
    checks, composed = part.conformance, part.composed
    lines, text = checks.lines, []
    duration = len(composed.streams[0].u) * composed.sample_time_s
    text.append(
        f"{part.name}: {len(lines.line)} printed lines in {int(composed.lines.run[-1]) + 1} runs, "
        f"{duration:.1f} s; "
        f"the gantry sets out {composed.lead_in_s:.2f} s after the signal"
    )
    slow = slowed_to(part.planned, part.program.moves)
    if slow is not None:
        text.append(
            f"for the drive, printed lines begin and end at rest and change speed at {slow:.3g} mm/s^2: "
            f"run the gantry so (M204 P{slow:.3g}), as the signal was made for it"
        )
    for stream in composed.streams:
        text.append(forecast_sentence(composed, stream))
        sat = checks.saturation[stream.tool]
        if not sat.enough:
            ramp = checks.ramp_that_would_do_s
            do = (
                f"ramps of {ramp:.2f} s would do"
                if ramp is not None and math.isfinite(ramp)
                else "no ramp would do: print slower, or take a drive of more than printer.drive declares"
            )
            text.append(
                f"  the command reaches its limit {sat.share_percent:.1f} % of the printing time (peak "
                f"{sat.peak_over_steady:.1f} x steady); {do}"
            )
    if checks.judged and all(stream.judged.judged for stream in composed.streams):
        worst = int(np.argmax(np.nan_to_num(np.abs(lines.error_percent))))
        text.append(
            f"volume of {checks.judged} lines within {checks.worst_line_volume_percent:.1f} % of the plan; "
            f"of all lines the worst is line {lines.line[worst]}: {lines.error_percent[worst]:+.1f} % of "
            f"{lines.planned_mm3[worst]:.3g} mm^3"
        )
    if short := int(np.sum(lines.shorter_than_lead)):
        text.append(
            f"{short:,} {'line belongs to a run' if short == 1 else 'lines belong to runs'} shorter than the "
            f"lead of Stop: the priority rule would not print {'it' if short == 1 else 'them'}"
        )
    text += _program_lines(part)
    kinds = grouped(checks, part.program.refusals)
    text += [f"line {one.line}: {one.why}" for one in kinds[:LONGEST_LIST]]
    if len(kinds) > LONGEST_LIST:
        text.append(f"and {len(kinds) - LONGEST_LIST:,} more kinds in the report")
    return "\n".join(text)


def _program_lines(part: ComposedPart) -> list[str]:
    """Returns in words what the program drives, E's volume compared with the declared bead, and the words
    that are no moves, each reported once."""
    program, by = part.program, part.program.accounted
    text = [
        f"{program.lines:,} lines of the program: {by.moved:,} move, {by.read:,} set or repeat, {by.other:,} "
        f"hold other words, {by.blank:,} are empty or comment, {by.refused:,} were refused"
    ]
    text += [f"T{tool}: {_volume_source(why)}" for tool, why in part.extruded.source.items()]
    area = part.bead_area_mm2
    for one in extrusion.differences(program.moves, part.extruded, bead_area_mm2=area):
        low, middle, high = one.area_mm2
        text.append(
            f"T{one.tool}: E asks for {one.by_e_mm3:.4g} mm^3, {one.by_e_mm3 / one.declared_mm3:.2f} of the "
            f"declared bead's {one.declared_mm3:.4g} mm^3; its lines have {low:.3g} to {high:.3g} mm^2, half "
            f"of the length below {middle:.3g}, declared {area:g}"
        )
    text += [
        f"{one.word}, {one.count:,} x, first in line {one.line}: {one.what or 'unknown; left out'}"
        for one in program.told[:LONGEST_LIST]
    ]
    if len(program.told) > LONGEST_LIST:
        text.append(f"and {len(program.told) - LONGEST_LIST} more words that are no moves")
    return text


def _volume_source(why: str) -> str:
    return f"volumes by E, {why}" if why.startswith(("diameter", "E counts")) else f"declared bead: {why}"


def grouped(report: Conformance, refusals: Sequence[LineRefusal]) -> list[LineRefusal]:
    """Returns what was not composed as written, by kind, each with its first line and the number of lines:
    the refusals of the report, and those of the reader."""
    kinds = Refusals()
    for one in report.refused:
        kinds.add([one.line], one.why)
    return sorted([*kinds.grouped(), *refusals])


def forecast_sentence(composed: Composed, stream: Stream) -> str:
    """Returns the forecast of each composer in words, the lowest upper end first, or why there is no valid
    forecast."""
    intervals = sorted(
        (q for q in composed.predictions if q.tool == stream.tool), key=lambda prediction: prediction.high
    )
    others = ", ".join(f"{q.composer} {q.low:.1f} to {q.high:.1f} %" for q in intervals)
    text = f"T{stream.tool} {stream.material}: by {stream.composer}; "
    if not stream.judged.judged:
        return f"{text}forecast not judged: {stream.judged.reason}; to judge it, {stream.judged.trial}"
    return f"{text}flow error forecast (90 %), of on-off control's: {others}"


# ---- as tables


def signal_rows(part: ComposedPart, scores: Sequence[ComposerScore]) -> dict[str, np.ndarray]:
    """Returns one row per sample of every stream, with the gantry's place and the flow of every composer."""
    composed = part.composed
    Ts, ahead = composed.sample_time_s, round(composed.lead_in_s / composed.sample_time_s)
    position = motion.sampled(part.planned, part.program.moves, sample_time_s=Ts).position
    n = len(composed.streams[0].r)
    at = np.clip(np.arange(n) - ahead, 0, len(position) - 1)
    parts, names = [], [f"{composer.name}_mm3_per_s" for composer in COMPOSERS]
    for i, stream in enumerate(composed.streams):
        flows = {f"{score.composer}_mm3_per_s": score.y for score in scores if score.stream == i}
        parts.append({
            "part": np.full(n, part.name, object), "tool": np.full(n, stream.tool),
            "material": np.full(n, stream.material, object),
            "time_s": np.arange(n) * Ts,
            "x_mm": position[at, 0], "y_mm": position[at, 1], "wanted_mm3_per_s": stream.r,
            "command_mm": stream.u,
            "predicted_mm3_per_s": stream.y,
            **{name: flows.get(name, np.full(n, np.nan)) for name in names},
        })  # fmt: skip
    return {name: np.concatenate([one[name] for one in parts]) for name in parts[0]}


def score_rows(part: ComposedPart, scores: Sequence[ComposerScore]) -> dict[str, list]:
    """Returns one row per composer of every stream."""
    columns = {name: [getattr(score, name) for score in scores] for name in ComposerScore._fields[1:6]}
    materials = [part.composed.streams[score.stream].material for score in scores]
    return {"part": [part.name] * len(scores), "material": materials} | columns


def print_rows(part: ComposedPart, learning: Sequence[Learning]) -> dict[str, list]:
    """Returns one row per composer of every stream of a part, after each number of prints."""
    columns = {name: [getattr(one, name) for one in learning] for name in Learning._fields[1:]}
    materials = [part.composed.streams[one.stream].material for one in learning]
    return {"part": [part.name] * len(learning), "material": materials} | columns


def task_rows(part: ComposedPart) -> dict[str, np.ndarray]:
    """Returns one row per task."""
    tasks = part.composed.tasks
    return {
        "part": np.full(len(tasks.task), part.name, object),
        "task": tasks.task, "tool": tasks.tool, "line": tasks.line, "begin_s": tasks.begin_s,
        "end_s": tasks.end_s, "speed_mm_per_s": tasks.speed, "pause_s": tasks.pause_s,
        "error_percent": part.composed.error_percent,
    }  # fmt: skip


def line_rows(part: ComposedPart) -> dict[str, np.ndarray]:
    """Returns one row per printed line."""
    lines = part.conformance.lines
    return {"part": np.full(len(lines.line), part.name, object)} | lines._asdict()


def rows(judged: Sequence[tuple[ComposedPart, Sequence[ComposerScore]]]) -> dict[str, dict[str, np.ndarray]]:
    """Returns the columns of the tables signals, scores, tasks and lines of all parts."""
    return {
        "signals": stacked([signal_rows(*one) for one in judged]),
        "scores": stacked([score_rows(*one) for one in judged]),
        "tasks": stacked([task_rows(part) for part, _ in judged]),
        "lines": stacked([line_rows(part) for part, _ in judged]),
    }


def stacked(tables: Sequence[dict[str, Any]]) -> dict[str, np.ndarray]:
    """Returns tables of equal columns, one below the other."""
    return {name: np.concatenate([np.asarray(table[name]) for table in tables]) for name in tables[0]}


def report(part: ComposedPart) -> dict[str, Any]:
    """Returns the conformance report of a part, as JSON."""
    checks, composed = part.conformance, part.composed
    lines = checks.lines
    return {
        "lines_of_the_program": part.program.lines,
        "printed_lines": len(lines.line),
        "runs": int(composed.lines.run[-1]) + 1,
        "duration_s": len(composed.streams[0].r) * composed.sample_time_s,
        "printing_acceleration_mm_per_s2": slowed_to(part.planned, part.program.moves),
        "worst_line_volume_percent": finite_or_none(checks.worst_line_volume_percent),
        "judged_lines": checks.judged,
        "shorter_than_lead": int(np.sum(lines.shorter_than_lead)),
        "composer": {stream.material: stream.composer for stream in composed.streams},
        "predicted_percent": {
            p.material: {
                q.composer: finite_or_none(q.median) for q in composed.predictions if q.material == p.material
            }
            for p in composed.predictions
        },
        "forecast": {stream.material: forecast_of(composed, stream) for stream in composed.streams},
        "saturation": {
            stream.material: finite(checks.saturation[stream.tool]._asdict()) for stream in composed.streams
        },
        "ramp_that_would_do_s": {
            stream.material: finite_or_none(checks.ramp_that_would_do_s)
            for stream in composed.streams
            if checks.ramp_that_would_do_s is not None
        },
        "refused": [one._asdict() for one in grouped(checks, part.program.refusals)],
        "unknown_words": sum(one.count for one in part.program.told if not one.what),
        "program": program_report(part.program, part.extruded, bead_area_mm2=part.bead_area_mm2),
    }


def program_report(program: PartProgram, extruded: Extruded, *, bead_area_mm2: float) -> dict[str, Any]:
    """Returns the contents of the program and E's volume compared with the declared bead, as JSON."""
    differences = extrusion.differences(program.moves, extruded, bead_area_mm2=bead_area_mm2)
    return {
        "lines": program.accounted._asdict(),
        "extruder": program.extruder,
        "volumes": {f"T{tool}": _volume_source(why) for tool, why in extruded.source.items()},
        "e_beside_declared_bead": [one._asdict() for one in differences],
        "words": [one._asdict() for one in program.told],
        "refused": [one._asdict() for one in program.refusals],
    }


def figures(judged: Sequence[tuple[ComposedPart, Sequence[ComposerScore]]]) -> dict[str, Any]:
    """Returns by part, material and composer: the error of the true flow in % of on-off control's, the worst
    line's volume, and which was chosen; also what its command demands of the drive."""
    return {
        part.name: {
            stream.material: _by_composer([score for score in scores if score.stream == i])
            | _forecast(part.composed, stream, [score for score in scores if score.stream == i])
            | _demand(stream, part.composed.sample_time_s)
            | {"least_reachable_percent": part.conformance.saturation[stream.tool].least_percent}
            for i, stream in enumerate(part.composed.streams)
        }
        for part, scores in judged
    }


def forecast_of(composed: Composed, stream: Stream) -> dict[str, Any]:
    """Returns the forecast error of the signal as it is sent, in % of on-off control's, and whether it may be
    believed."""
    chosen = next(q for q in composed.predictions if q.tool == stream.tool and q.chosen)
    return {
        "low": finite_or_none(chosen.low),
        "median": finite_or_none(chosen.median),
        "high": finite_or_none(chosen.high),
        "composers": {
            q.composer: {"low": finite_or_none(q.low), "high": finite_or_none(q.high)}
            for q in composed.predictions
            if q.tool == stream.tool
        },
    } | stream.judged._asdict()


def _forecast(composed: Composed, stream: Stream, scores: Sequence[ComposerScore]) -> dict[str, Any]:
    """Returns the forecast, whether it may be believed, and the true error if the machine is simulated."""
    forecast = forecast_of(composed, stream)
    del forecast["composers"]
    judged = {name: forecast.pop(name) for name in ("judged", "reason", "trial")}
    simulated = any(score.composer == FULL_PART_ILC for score in scores)
    true = next((score.rms_percent_of_on_off for score in scores if score.chosen), None)
    figures = {"forecast": forecast, "judged": judged}
    return figures | ({"true": true} if simulated and true is not None else {})


def _demand(stream: Stream, sample_time_s: float) -> dict[str, float]:
    """Returns the largest command and speed of the signal as it is sent."""
    command_mm, speed = drive.demand(stream.u, sample_time_s=sample_time_s)
    return {"largest_command_mm": command_mm, "largest_speed_mm_per_s": speed}


def _by_composer(scores: Sequence[ComposerScore]) -> dict[str, Any]:
    """Returns the figures of one stream."""
    errors = {
        score.composer: {
            "rms_percent_of_on_off": score.rms_percent_of_on_off,
            "worst_line_volume_percent": finite_or_none(score.worst_line_volume_percent),
            "predicted_percent": finite_or_none(score.predicted_percent),
        }
        for score in scores
    }
    chosen = [score.composer for score in scores if score.chosen]
    return errors | {"chosen": chosen[-1]} if chosen else errors
