"""Learned trials -> library -> parts, at the edge: what segment_library stores and compose_parts and `beadline compose` read; one part program composed and reported."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field

from pipeline import artifacts, gcode, schemas
from pipeline.deposition import composition, conformance, motion
from pipeline.deposition.chain import Chain
from pipeline.deposition.composition import Composed, Learned
from pipeline.deposition.conformance import Conformance
from pipeline.deposition.evaluation import Score
from pipeline.deposition.extruder import Extruder, Routine
from pipeline.deposition.library import Basis, Check, Library, Training
from pipeline.params import Section
from pipeline.printer import Printer


class ComposeParts(Section):
    """Section `compose_parts`."""

    seed: int = Field(ge=0, le=2**31)
    corner_deg: float = Field(gt=0, le=180)
    longest_pause_s: float = Field(ge=0, le=600)
    shortest_s: float = Field(ge=0, le=600)
    largest_error_percent: float = Field(gt=0, le=1000)
    whole_updates: int = Field(ge=1, le=1000)


class Part(NamedTuple):
    """A part program read, planned, composed, and whether it will print."""

    name: str
    program: gcode.Program
    planned: motion.Motion
    composed: Composed
    conformance: Conformance


# ---- lessons -> trainings


def trainings(lessons: dict[str, np.ndarray], law: str, routines: Sequence[Routine], nozzle_mm: float) -> list[Training]:
    """All trials of a law, by material and routine; those of the reference routine only where there is no other. Raises ValueError where there is none."""
    mine = lessons["law"] == law
    if not mine.any():
        there = ", ".join(sorted(set(lessons["law"])))
        do = "print the commands in datasets/train_ilc/next, and put their recordings into datasets/raw/deposition"
        raise ValueError(
            f"datasets/train_ilc/lessons.parquet: expected trials of law {law} (segment_library.law), "
            + (f"found {there}; name one of those" if there else f"found none yet; {do}")
        )
    found = []
    for material in sorted(set(lessons["material"][mine])):
        numbers = sorted(set(lessons["routine"][mine & (lessons["material"] == material)].tolist()))
        for number in [n for n in numbers if n > 0] or numbers:
            here = mine & (lessons["material"] == material) & (lessons["routine"] == number)
            if here.any():
                shape = (-1, len(routines[number].r))
                u, y = (lessons[name][here].reshape(shape) for name in ("command_mm", "measured_mm3_per_s"))
                found.append(Training(material, nozzle_mm, routines[number], u, y))
    return found


# ---- what was learned, stored


def stored(learned: Learned) -> tuple[dict[str, list], dict[str, Any]]:
    """Columns of the library's table, and the rest as JSON."""
    rows = [(b.task, b.material, b.nozzle_mm, b.speed, b.pause_s, b.lead, len(b.signal), b.signal) for b in learned.library.columns]
    table = {column.name: list(values) for column, values in zip(schemas.LIBRARY.columns, zip(*rows, strict=True), strict=True)}
    materials = [
        known._asdict()
        | {"chain": known.chain._asdict() | {"extruder": {k: _finite(v) for k, v in known.chain.extruder._asdict().items()}}}
        for known in learned.materials
    ]
    rest = {
        "sample_time_s": learned.library.sample_time_s,
        "marks": {name: list(pair) for name, pair in learned.library.marks.items()},
        "materials": [
            {key: _finite(value) for key, value in known.items() if key != "chain"}
            | {"chain": {k: _finite(v) for k, v in known["chain"].items()}}
            for known in materials
        ],
        "checks": [{key: _finite(value) for key, value in check._asdict().items()} for check in learned.checks],
    }
    return table, rest


def _finite(value: Any) -> Any:
    return None if isinstance(value, float | np.floating) and not math.isfinite(value) else value


def restored(table: dict[str, np.ndarray], rest: dict[str, Any]) -> Learned:
    """What `stored` made."""
    names = ("task", "material", "nozzle_mm", "speed_mm_per_s", "pause_s", "lead", "signal_mm")
    columns = tuple(
        Basis(str(task), str(material), float(nozzle), float(speed), float(pause), int(lead), np.array(signal, float))
        for task, material, nozzle, speed, pause, lead, signal in zip(*(table[name] for name in names), strict=True)
    )
    library = Library(columns, rest["sample_time_s"], {name: (pair[0], pair[1]) for name, pair in rest["marks"].items()})
    materials = []
    for known in rest["materials"]:
        extruder = known["chain"]["extruder"]
        extruder = Extruder(**{key: math.inf if value is None else value for key, value in extruder.items()})
        chain = Chain(**(known["chain"] | {"extruder": extruder}))
        materials.append(composition.Material(**(known | {"chain": chain})))
    checks = [Check(**(check | {"percent": math.nan if check["percent"] is None else check["percent"]})) for check in rest["checks"]]
    return Learned(library, tuple(materials), checks)


def read_learned(table: str, rest: str) -> Learned:
    """Library and chains of segment_library, from its two files."""
    columns, known = artifacts.read_table(table, schemas.LIBRARY), artifacts.read_json(rest)
    try:
        return restored(columns, known)
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        raise ValueError(
            f"{rest} is not what segment_library writes ({error}); make it again with ./run dvc repro segment_library"
        ) from None


# ---- one part


def compose(path: Path, learned: Learned, printer: Printer, p: ComposeParts) -> Part:
    """A part program, composed. Raises ValueError naming the file, and the line where there is one."""
    learned_s = learned.library.sample_time_s
    if learned_s != printer.sample_time_s:
        raise ValueError(
            f"params.yaml: printer.sample_time_s is {printer.sample_time_s:g} but the library was learned at {learned_s:g} s; learn it again with ./run dvc repro"
        )
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path} cannot be read ({error.strerror}); name a part program (G-code)") from None
    with artifacts.about(path):
        program = gcode.parse(data)
        if program.refusals and not np.any(program.moves.kind == gcode.Kind.EXTRUDE):
            first = program.refusals[0]
            raise ValueError(f"line {first.line}: {first.why}; it was left out, and nothing of the program that could be read prints")
        planned = motion.plan(
            program.moves, acceleration=printer.acceleration_mm_per_s2, junction_deviation_mm=printer.junction_deviation_mm,
            speed_limit=printer.speed_limit_mm_per_s, unset_feed=printer.speed_mm_per_s, tool_change_s=printer.tool_change_s,
        )  # fmt: skip
        settings = {"bead_area_mm2": printer.bead_area_mm2, "ramp_s": printer.ramp_s, "limit": printer.limit}
        composed = composition.compose(
            learned, program, planned, materials={m.tool: m.name for m in printer.materials}, nozzle_mm=printer.nozzle_mm,
            corner_deg=p.corner_deg, longest_pause_s=p.longest_pause_s, **settings,
        )  # fmt: skip
        report = conformance.conform(
            composed, learned, shortest_s=p.shortest_s, largest_error_percent=p.largest_error_percent, refusals=program.refusals, **settings
        )
    return Part(path.stem, program, planned, composed, report)


def compose_all(folder: Path, learned: Learned, printer: Printer, p: ComposeParts) -> tuple[list[Part], dict[str, str]]:
    """Every part program in `folder`, and the reasons of those that cannot be composed; raises ValueError where none can."""
    parts, refused = [], {}
    for path in programs(folder):
        try:
            parts.append(compose(path, learned, printer, p))
        except ValueError as error:
            refused[path.stem] = str(error)
    if not parts:
        raise ValueError(f"{folder}: none of {len(refused)} part programs can be composed; the first: {next(iter(refused.values()))}")
    return parts, refused


def write(part: Part, folder: Path) -> list[Path]:
    """The commands of all tools and the tasks as CSV, and the conformance report as JSON, beside one another in `folder`."""
    composed = part.composed
    signal = {"time_s": np.arange(len(composed.streams[0].u)) * composed.sample_time_s}
    signal |= {f"T{stream.tool}_{stream.material}_mm": stream.u for stream in composed.streams}
    files = [folder / f"{part.name}.{kind}" for kind in ("signal.csv", "tasks.csv", "conformance.json")]
    artifacts.write_csv(files[0], signal)
    artifacts.write_csv(files[1], task_rows(part))
    lines = line_rows(part)
    rows = [
        {name: _finite(values[i].item() if hasattr(values[i], "item") else values[i]) for name, values in lines.items() if name != "part"}
        for i in range(len(lines["line"]))
    ]
    artifacts.write_json(files[2], report(part) | {"lines": rows})
    return files


def told(part: Part) -> str:
    """The conformance report in words."""
    found, composed = part.conformance, part.composed
    lines, text = found.lines, []
    duration = len(composed.streams[0].u) * composed.sample_time_s
    text.append(
        f"{part.name}: {len(lines.line)} printed lines in {int(composed.lines.run[-1]) + 1} runs, {duration:.1f} s; the gantry sets out {composed.lead_in_s:.2f} s after the signal"
    )
    for stream in composed.streams:
        predicted = {q.composer: q.rms_percent_of_on_off for q in composed.predictions if q.tool == stream.tool}
        others = ", ".join(f"{name} {percent:.1f} %" for name, percent in sorted(predicted.items(), key=lambda item: item[1]))
        text.append(f"T{stream.tool} {stream.material}: by {stream.composer}; predicted flow error, of on-off control's: {others}")
        sat = found.saturation[stream.tool]
        if not sat.enough:
            ramp = found.ramp_that_would_do_s[stream.tool]
            do = f"ramps of {ramp:.2f} s would do" if math.isfinite(ramp) else "no ramp would do: print slower, or raise printer.limit_mm"
            text.append(
                f"  the command reaches its limit {sat.share_percent:.1f} % of the printing time (peak {sat.peak_over_steady:.1f} x steady); {do}"
            )
    if found.judged:
        worst = int(np.argmax(np.where(lines.duration_s >= 0, np.abs(lines.error_percent), 0)))
        text.append(
            f"volume of {found.judged} lines within {found.worst_line_volume_percent:.1f} % of the plan; "
            f"of all lines the worst is line {lines.line[worst]}: {lines.error_percent[worst]:+.1f} % of {lines.planned_mm3[worst]:.3g} mm^3"
        )
    if np.any(lines.shorter_than_lead):
        text.append(
            f"{int(np.sum(lines.shorter_than_lead))} lines belong to runs shorter than the lead of Stop: the priority rule would not print them"
        )
    text += [f"line {one.line}: {one.why}" for one in found.refused]
    return "\n".join(text)


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
            "part": np.full(n, part.name, object), "tool": np.full(n, stream.tool), "material": np.full(n, stream.material, object), "time_s": np.arange(n) * Ts,
            "x_mm": position[at, 0], "y_mm": position[at, 1], "wanted_mm3_per_s": stream.r, "command_mm": stream.u, "predicted_mm3_per_s": stream.y,
            **{column.name: flows.get(column.name, np.full(n, np.nan)) for column in schemas.SIGNALS.columns[9:]},
        })  # fmt: skip
    return {name: np.concatenate([one[name] for one in parts]) for name in parts[0]}


def score_rows(part: Part, scores: Sequence[Score]) -> dict[str, list]:
    materials = [part.composed.streams[score.stream].material for score in scores]
    values = [(part.name, material, *score[1:6]) for material, score in zip(materials, scores, strict=True)]
    return {
        column.name: list(column_values) for column, column_values in zip(schemas.SCORES.columns, zip(*values, strict=True), strict=True)
    }


def task_rows(part: Part) -> dict[str, np.ndarray]:
    tasks = part.composed.tasks
    values = [np.full(len(tasks.task), part.name, object), tasks.task.astype(object), *tasks[1:], part.composed.error_percent]
    return dict(zip([column.name for column in schemas.TASKS.columns], values, strict=True))


def line_rows(part: Part) -> dict[str, np.ndarray]:
    lines = part.conformance.lines
    values = [np.full(len(lines.line), part.name, object), *lines]
    return dict(zip([column.name for column in schemas.LINES.columns], values, strict=True))


def stacked(tables: Sequence[dict[str, Any]]) -> dict[str, np.ndarray]:
    """Tables of equal columns, one below the other."""
    return {name: np.concatenate([np.asarray(table[name]) for table in tables]) for name in tables[0]}


def report(part: Part) -> dict[str, Any]:
    """What the conformance report says, as JSON."""
    found, composed = part.conformance, part.composed
    lines, refused = found.lines, [one._asdict() for one in found.refused]
    return {
        "lines_of_the_program": part.program.lines,
        "printed_lines": len(lines.line),
        "runs": int(composed.lines.run[-1]) + 1,
        "duration_s": len(composed.streams[0].r) * composed.sample_time_s,
        "worst_line_volume_percent": _finite(found.worst_line_volume_percent),
        "judged_lines": found.judged,
        "shorter_than_lead": int(np.sum(lines.shorter_than_lead)),
        "composer": {stream.material: stream.composer for stream in composed.streams},
        "predicted_percent": {
            p.material: {q.composer: _finite(q.rms_percent_of_on_off) for q in composed.predictions if q.material == p.material}
            for p in composed.predictions
        },
        "saturation": {
            name: {key: _finite(value) for key, value in one._asdict().items()} for name, one in _by_material(part, found.saturation)
        },
        "ramp_that_would_do_s": {name: _finite(value) for name, value in _by_material(part, found.ramp_that_would_do_s)},
        "refused": refused,
        "unknown_words": len(part.program.other_line),
    }


def _by_material(part: Part, of_tool: dict[int, Any]) -> list[tuple[str, Any]]:
    return [(stream.material, of_tool[stream.tool]) for stream in part.composed.streams]


def figures(judged: Sequence[tuple[Part, Sequence[Score]]]) -> dict[str, Any]:
    """By part, material and composer: the error of the true flow in % of on-off control's, the worst line's volume, and which was chosen."""
    found: dict[str, Any] = {}
    for part, scores in judged:
        for score in scores:
            material = part.composed.streams[score.stream].material
            one = found.setdefault(part.name, {}).setdefault(material, {})
            one[score.composer] = {
                "rms_percent_of_on_off": score.rms_percent_of_on_off,
                "worst_line_volume_percent": _finite(score.worst_line_volume_percent),
                "predicted_percent": _finite(score.predicted_percent),
            }
            if score.chosen:
                one["chosen"] = score.composer
    return found


def programs(folder: Path) -> list[Path]:
    """The part programs in a folder, by name. Raises ValueError where there is none."""
    found = sorted(path for path in folder.glob("*") if path.suffix.lower() in {".gcode", ".gco", ".g", ".nc"})
    if not found:
        raise ValueError(f"{folder}: expected part programs (*.gcode), found none; copy one there")
    return found
