"""What compose_parts and `beadline compose` do: a part program read, planned and composed from the library,
judged where the machine is known, and reported."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from pipeline.deposition import drive
from pipeline.deposition.parts import composition, conformance, evaluation, extrusion
from pipeline.deposition.parts.composition import Composed, Learned, PartSettings, Stream
from pipeline.deposition.parts.conformance import Conformance
from pipeline.deposition.parts.evaluation import Judging, Score
from pipeline.deposition.toolpath import gcode, motion
from pipeline.deposition.workflow import laws, part_motion, part_programs
from pipeline.deposition.workflow.segment_library import finite_or_none
from pipeline.deposition.workflow.settings import ComposeParts, Printer, TrainIlc
from pipeline.deposition.workflow.tables import LINES, SCORES, SIGNALS, TASKS
from pipeline.store import artifacts


class Part(NamedTuple):
    """A part program read, planned, composed, and whether it will print."""

    name: str
    program: gcode.Program
    planned: motion.Motion
    composed: Composed
    conformance: Conformance
    printer: Printer
    extruded: extrusion.Extruded


def compose_all(
    folder: Path, learned: Learned, printer: Printer, settings: ComposeParts
) -> tuple[list[Part], dict[str, str]]:
    """Every part program in `folder`, and the reasons of those that
    cannot be composed; raises ValueError where none can."""
    parts, refused = [], {}
    for path in programs(folder):
        try:
            parts.append(compose(path, learned, printer, settings))
        except ValueError as error:
            refused[path.stem] = str(error)
    if not parts:
        raise ValueError(
            f"{folder}: none of {len(refused)} part programs can be composed; the first: "
            f"{next(iter(refused.values()))}"
        )
    return parts, refused


def programs(folder: Path) -> list[Path]:
    """The part programs in a folder, by name. Raises ValueError where there is none."""
    paths = sorted(
        path for path in folder.glob("*") if path.suffix.lower() in {".gcode", ".gco", ".g", ".nc"}
    )
    if not paths:
        raise ValueError(f"{folder}: expected part programs (*.gcode), found none; copy one there")
    return paths


def judged(
    parts: Sequence[Part],
    learned: Learned,
    models: dict[str, Any],
    printer: Printer,
    settings: ComposeParts,
    training: TrainIlc,
) -> list[tuple[Part, list[Score]]]:
    """Every part with the scores of its composers, on the extruders of
    models.json and with the noise of train_ilc."""
    judging = Judging(
        nominals=laws.extruders(models, "nominal"),
        plants=laws.extruders(models, "plant"),
        laws=laws.law_settings(training, printer),
        noise=laws.noise(training),
        updates=settings.full_part_updates,
        bead_area_mm2=printer.bead_area_mm2,
        shortest_s=settings.shortest_s,
    )
    rng = np.random.default_rng(settings.seed)
    return [
        (part, upper_ends(part, evaluation.evaluate(learned, part.composed, judging, rng), judging))
        for part in tqdm(parts, desc="compose_parts: parts", mininterval=2)
    ]


def upper_ends(part: Part, scores: Sequence[Score], judging: Judging) -> list[Score]:
    """The scores; of a machine whose true flow nobody knows the worst line of the chosen composer is the
    farther end of its interval, for the flow of the chain that made the command is no measure of it."""
    lines, streams = part.conformance.lines, part.composed.streams
    long_enough = lines.duration_s >= judging.shortest_s - 1e-9
    ends = np.maximum(np.abs(lines.low_percent), np.abs(lines.high_percent))
    out = []
    for score in scores:
        mine = long_enough & (lines.tool == streams[score.stream].tool)
        real = score.chosen and streams[score.stream].material not in judging.plants
        worst = float(ends[mine].max()) if real and mine.any() else score.worst_line_volume_percent
        out.append(score._replace(worst_line_volume_percent=worst))
    return out


# ---- one part


def compose(
    path: Path,
    learned: Learned,
    printer: Printer,
    settings: ComposeParts,
    asked: part_programs.Asked = part_programs.AS_IT_IS,
) -> Part:
    """A part program, composed. Raises ValueError naming the file, and the line where there is one."""
    learned_s = learned.library.sample_time_s
    if learned_s != printer.sample_time_s:
        raise ValueError(
            f"params.yaml: printer.sample_time_s is {printer.sample_time_s:g} but the library was learned "
            f"at {learned_s:g} s; "
            "learn it again with ./run dvc repro"
        )
    program = part_programs.read(path, asked)
    extruded = part_programs.extruded(program, printer, asked)
    with artifacts.about(path):
        planned = part_motion.planned(program.moves, printer, learned)
        part_settings = PartSettings(
            printer.nozzle_mm,
            printer.bead_area_mm2,
            printer.ramp_s,
            settings.corner_deg,
            settings.longest_pause_s,
            printer.limits,
        )
        materials = {material.tool: material.name for material in printer.materials}
        part_programs.check_duration(program.moves, planned)
        # a printed line is as long as the declared bead would be of the volume that E asks for
        beads = extrusion.as_lengths(program, extruded, bead_area_mm2=printer.bead_area_mm2)
        composed = composition.compose(learned, beads, planned, part_settings, materials=materials)
        report = conformance.conform(
            composed,
            learned,
            bead_area_mm2=printer.bead_area_mm2,
            ramp_s=printer.ramp_s,
            drive=printer.limits,
            shortest_s=settings.shortest_s,
            largest_error_percent=settings.largest_error_percent,
        )
        if not all(one.enough for one in report.saturation.values()):
            ramp_s = part_motion.ramp_that_would_do(program.moves, printer, learned)
            report = report._replace(ramp_that_would_do_s=dict.fromkeys(report.saturation, ramp_s))
        report = part_programs.in_percent(
            report, program.moves, composed, shortest_s=settings.shortest_s,
            least_mm3=printer.bead_area_mm2 * printer.nozzle_mm,
        )  # fmt: skip
    return Part(path.stem, program, planned, composed, report, printer, extruded)


def summary_lines(part: Part) -> str:
    """The conformance report in words, line by line."""
    checks, composed = part.conformance, part.composed
    lines, text = checks.lines, []
    duration = len(composed.streams[0].u) * composed.sample_time_s
    text.append(
        f"{part.name}: {len(lines.line)} printed lines in {int(composed.lines.run[-1]) + 1} runs, "
        f"{duration:.1f} s; "
        f"the gantry sets out {composed.lead_in_s:.2f} s after the signal"
    )
    slow = part_motion.slowed_to(part.planned, part.program.moves)
    if slow is not None:
        text.append(
            f"for the drive, printed lines begin and end at rest and change speed at {slow:.3g} mm/s^2: "
            f"run the gantry so (M204 P{slow:.3g}), as the signal was made for it"
        )
    for stream in composed.streams:
        text.append(forecast_sentence(composed, stream))
        sat = checks.saturation[stream.tool]
        if not sat.enough:
            ramp = checks.ramp_that_would_do_s[stream.tool]
            do = (
                f"ramps of {ramp:.2f} s would do"
                if math.isfinite(ramp)
                else "no ramp would do: print slower, or take a drive of more than printer.drive declares"
            )
            text.append(
                f"  the command reaches its limit {sat.share_percent:.1f} % of the printing time (peak "
                f"{sat.peak_over_steady:.1f} x steady); {do}"
            )
    if checks.judged:
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
    text += part_programs.summary(part.program, part.extruded, part.printer)
    text += part_programs.refused(checks, part.program)
    return "\n".join(text)


def forecast_sentence(composed: Composed, stream: Stream) -> str:
    """The forecast of each composer in words, the least upper end first, or why it is not judged."""
    intervals = sorted(
        (q for q in composed.predictions if q.tool == stream.tool), key=lambda prediction: prediction.high
    )
    others = ", ".join(f"{q.composer} {q.low:.1f} to {q.high:.1f} %" for q in intervals)
    text = f"T{stream.tool} {stream.material}: by {stream.composer}; "
    if not stream.judged.judged:
        return f"{text}forecast not judged: {stream.judged.reason}; to judge it, {stream.judged.trial}"
    return f"{text}flow error forecast (90 %), of on-off control's: {others}"


# ---- as tables


def signal_rows(part: Part, scores: Sequence[Score]) -> dict[str, np.ndarray]:
    """One row a sample of every stream, the gantry beside it, and the flow of every composer."""
    composed = part.composed
    Ts, ahead = composed.sample_time_s, round(composed.lead_in_s / composed.sample_time_s)
    position = motion.sampled(part.planned, part.program.moves, sample_time_s=Ts).position
    n = len(composed.streams[0].r)
    at = np.clip(np.arange(n) - ahead, 0, len(position) - 1)
    parts = []
    for i, stream in enumerate(composed.streams):
        flows = {f"{score.composer}_mm3_per_s": score.y for score in scores if score.stream == i}
        parts.append({
            "part": np.full(n, part.name, object), "tool": np.full(n, stream.tool),
            "material": np.full(n, stream.material, object),
            "time_s": np.arange(n) * Ts,
            "x_mm": position[at, 0], "y_mm": position[at, 1], "wanted_mm3_per_s": stream.r,
            "command_mm": stream.u,
            "predicted_mm3_per_s": stream.y,
            **{column.name: flows.get(column.name, np.full(n, np.nan)) for column in SIGNALS.columns[9:]},
        })  # fmt: skip
    return {name: np.concatenate([one[name] for one in parts]) for name in parts[0]}


def score_rows(part: Part, scores: Sequence[Score]) -> dict[str, list]:
    materials = [part.composed.streams[score.stream].material for score in scores]
    values = [(part.name, material, *score[1:6]) for material, score in zip(materials, scores, strict=True)]
    return {
        column.name: list(column_values)
        for column, column_values in zip(SCORES.columns, zip(*values, strict=True), strict=True)
    }


def task_rows(part: Part) -> dict[str, np.ndarray]:
    tasks = part.composed.tasks
    values = [np.full(len(tasks.task), part.name, object), *tasks, part.composed.error_percent]
    return dict(zip([column.name for column in TASKS.columns], values, strict=True))


def line_rows(part: Part) -> dict[str, np.ndarray]:
    lines = part.conformance.lines
    values = [np.full(len(lines.line), part.name, object), *lines]
    return dict(zip([column.name for column in LINES.columns], values, strict=True))


def rows(done: Sequence[tuple[Part, Sequence[Score]]]) -> dict[str, dict[str, np.ndarray]]:
    """Columns of schemas SIGNALS, SCORES, TASKS and LINES of all parts."""
    return {
        "signals": stacked([signal_rows(*one) for one in done]),
        "scores": stacked([score_rows(*one) for one in done]),
        "tasks": stacked([task_rows(part) for part, _ in done]),
        "lines": stacked([line_rows(part) for part, _ in done]),
    }  # fmt: skip


def stacked(tables: Sequence[dict[str, Any]]) -> dict[str, np.ndarray]:
    """Tables of equal columns, one below the other."""
    return {name: np.concatenate([np.asarray(table[name]) for table in tables]) for name in tables[0]}


def reports(done: Sequence[tuple[Part, Sequence[Score]]], refused: dict[str, str]) -> dict[str, Any]:
    """Conformance by part, and why others were refused."""
    return {part.name: report(part) for part, _ in done} | {
        name: {"refused": why} for name, why in refused.items()
    }


def report(part: Part) -> dict[str, Any]:
    """What the conformance report says, as JSON."""
    checks, composed = part.conformance, part.composed
    lines, refused = (
        checks.lines,
        [one._asdict() for one in part_programs.grouped(checks, part.program.refusals)],
    )
    return {
        "lines_of_the_program": part.program.lines,
        "printed_lines": len(lines.line),
        "runs": int(composed.lines.run[-1]) + 1,
        "duration_s": len(composed.streams[0].r) * composed.sample_time_s,
        "printing_acceleration_mm_per_s2": part_motion.slowed_to(part.planned, part.program.moves),
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
            name: {key: finite_or_none(value) for key, value in one._asdict().items()}
            for name, one in _by_material(part, checks.saturation)
        },
        "ramp_that_would_do_s": {
            name: finite_or_none(value) for name, value in _by_material(part, checks.ramp_that_would_do_s)
        },
        "refused": refused,
        "unknown_words": sum(one.count for one in part.program.told if not one.what),
        "program": part_programs.told(part.program, part.extruded, part.printer),
    }


def _by_material(part: Part, of_tool: dict[int, Any]) -> list[tuple[str, Any]]:
    return [(stream.material, of_tool[stream.tool]) for stream in part.composed.streams]


def figures(judged: Sequence[tuple[Part, Sequence[Score]]]) -> dict[str, Any]:
    """By part, material and composer: the error of the true flow in % of on-off
    control's, the worst line's volume, and which was chosen; and what its command asks of the drive."""
    return {
        part.name: {
            stream.material: _by_composer([score for score in scores if score.stream == i])
            | _forecast(part.composed, stream, [score for score in scores if score.stream == i])
            | _asked(stream, part.composed.sample_time_s)
            | {"least_reachable_percent": part.conformance.saturation[stream.tool].least_percent}
            for i, stream in enumerate(part.composed.streams)
        }
        for part, scores in judged
    }


def forecast_of(composed: Composed, stream: Stream) -> dict[str, Any]:
    """Forecast error of the signal as it is sent, in % of on-off control's, and whether it may be
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


def _forecast(composed: Composed, stream: Stream, scores: Sequence[Score]) -> dict[str, Any]:
    """The forecast beside the true error, which a simulated machine has, and whether it may be believed."""
    told = forecast_of(composed, stream)
    del told["composers"]
    judged = {name: told.pop(name) for name in ("judged", "reason", "trial")}
    simulated = any(score.composer == evaluation.FULL_PART_ILC for score in scores)
    true = next((score.rms_percent_of_on_off for score in scores if score.chosen), None)
    figures = {"forecast": told, "judged": judged}
    return figures | ({"true": true} if simulated and true is not None else {})


def _asked(stream: Stream, sample_time_s: float) -> dict[str, float]:
    """The largest command and speed of the signal as it is sent."""
    most = drive.asked(stream.u, sample_time_s=sample_time_s)
    return {"largest_command_mm": most.command_mm, "largest_speed_mm_per_s": most.speed_mm_per_s}


def _by_composer(scores: Sequence[Score]) -> dict[str, Any]:
    """The figures of one stream."""
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
