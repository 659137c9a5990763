"""G-code held against programs in the dialects of slicers and bioprinters, against gcodeparser, and against
the clock; the gantry's plan on a long job.

`./run python -m benchmarks.gcode` writes its part of benchmarks/results.json. The programs are made here,
seeded: one path, written as each slicer writes it, with its start and end scripts; what they extrude and how
far they print is known from the making. The tests' reader of one line at a time, which shares no code, reads
the same text, as gcodeparser does (group `peers`) where it can. Times are CPU seconds, the best of five; jobs
run in processes of their own, in seconds of the clock and MB above the imports. `beadline compose` needs the
library of a finished run.
"""

import importlib.util
import os
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
import yaml

from benchmarks import results
from benchmarks.results import Row
from pipeline.deposition.parts import extrusion
from pipeline.deposition.toolpath import gcode, motion
from pipeline.deposition.toolpath.gcode import Kind
from tests.deposition.dialects import DIALECTS, Dialect, Made, made
from tests.deposition.reprap_reader import Reader

BARS = {
    "lines_per_s": 400_000, "refused_share": 1e-3, "extruded_error": 1e-3, "job_s": 0.7,
    "reader_length_error": 1e-6, "reader_volume_error": 1e-3,
    "compose_65k_s": 2.0, "compose_65k_mb": 250, "million_lines_mb": 600,
}  # fmt: skip
# a process of its own: seconds and MB of what it does, above those of its imports
WATCHED = """
import re, sys, time
from pathlib import Path
from pipeline import cli
from pipeline.deposition.toolpath import gcode, motion
from pipeline.commands import compose
from pipeline.deposition.parts import part, part_report, stored
# of this process alone: the peak that getrusage tells began in its parent
peak = lambda: int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) / 1024
imports, begin, cpu, path = peak(), time.perf_counter(), time.process_time(), sys.argv[2]
if sys.argv[1] == "read":
    program = gcode.parse(Path(path).read_bytes())
    motion.plan(program.moves, acceleration=500.0, junction_deviation_mm=0.02, speed_limit=200.0,
                unset_feed=25.0, tool_change_s=2.0)
else:
    sys.argv = ["beadline", "compose", path, "--out", sys.argv[3]]
    cli.main()
seconds, cpu = time.perf_counter() - begin, time.process_time() - cpu
print(f"\\n{seconds:.2f} {cpu:.2f} {peak() - imports:.0f} {peak():.0f}")
"""
LIMITS = {
    "acceleration": 500.0,
    "junction_deviation_mm": 0.02,
    "speed_limit": 200.0,
    "unset_feed": 25.0,
    "tool_change_s": 2.0,
}


def best(function, repeats: int = 5) -> tuple[object, float]:
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        result = function()
        seconds.append(time.process_time() - start)
    return result, min(seconds)


def read(name: str, dialect: Dialect, runs: int) -> dict:
    """One dialect: how much was refused, and how far the printed E and length are from what was written."""
    program = made(dialect, np.random.default_rng(1), runs=runs)
    program_read, seconds = best(lambda: gcode.parse(program.text), 3)
    m = program_read.moves
    out = m.kind == Kind.EXTRUDE
    wanted = program.printed if program_read.extruder.startswith("M") else program.extruded
    row = {
        "lines": program_read.lines,
        "extruder": program_read.extruder,
        "refused": len(program_read.refusals),
        "other_words": len(set(program_read.other_word.tolist())),
        "extruded_error": float(abs(m.e[out].sum() / wanted - 1)),
        "length_error": float(abs(m.length[out].sum() / program.printed - 1)),
        "lines_per_s": round(program_read.lines / seconds),
    }
    # the reader follows one letter or one pin; valves that open by words of their own are not RepRap's
    if program_read.extruder == "E":
        row |= by_reader(program.text, {})
    return row | peer(program, m)


def by_reader(text: str, options: dict) -> dict:
    """Our columns against the tests' reader: whether every line is accounted for alike, the largest relative
    difference of a length, and of a volume by E."""
    program, read = gcode.parse(text), Reader({0: 1.75, 1: 1.75}, **options).run(text)
    m, classes = program.moves, program.accounted._asdict()
    same = classes == {name: read.classes.count(name) for name in classes}
    alike = m.line.tolist() == [row.line for row in read.rows]
    if not alike:
        return {"every_line_accounted": False}
    length = np.array([row.length for row in read.rows])
    volume = np.array([row.volume for row in read.rows])
    ours = extrusion.volumes(program, {0: 1.75, 1: 1.75})
    lettered = bool(program.extruder) and program.extruder.isalpha()
    return {
        "every_line_accounted": same,
        "reader_length_error": float(np.max(np.abs(m.length - length) / np.maximum(length, 1e-3))),
        "reader_volume_error": float(np.max(np.abs(ours - volume) / np.maximum(np.abs(volume), 1e-3)))
        if lettered
        else 0.0,
    }


def slicer_job(lines: int) -> str:
    """Lines as a slicer writes them: legs of 1 mm at 20 mm/s, 120 to a run, E for a filament of 1.75 mm."""
    rng = np.random.default_rng(5)
    out, at = ["G21", "G90", "M83", "G28", "; filament_diameter = 1.75"], np.array([100.0, 100.0])
    while len(out) < lines:
        at = np.round(rng.uniform(20, 180, 2), 3)
        out += [f"G1 X{at[0]:.3f} Y{at[1]:.3f} F4800", "G1 E.8 F1500", "G1 F1200"]
        steps = np.round(rng.normal(0, 0.7, (120, 2)), 3)
        e, path = np.hypot(*steps.T) * 0.304 / 2.405, np.cumsum(steps, axis=0) + at
        out += [f"G1 X{x:.3f} Y{y:.3f} E{k:.5f}" for (x, y), k in zip(path.tolist(), e.tolist(), strict=True)]
        out.append("G1 E-.8 F2100")
    return "\n".join(out[:lines]) + "\n"


def watched(what: str, text: str, *, drive: bool = False) -> dict:
    """Seconds and MB of a process that reads, or composes, such a program, with the drive as declared or
    undeclared: what a drive costs is not the program's."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "job.gcode"
        path.write_text(text)
        for name in ("params.yaml", "params.expert.yaml"):
            sections = yaml.safe_load(Path(name).read_text())
            if name == "params.yaml" and not drive:
                sections["printer"]["drive"] = None
            (Path(folder) / name).write_text(yaml.safe_dump(sections, sort_keys=False))
        (Path(folder) / "datasets").symlink_to(Path("datasets").resolve())
        done = subprocess.run(
            [sys.executable, "-c", WATCHED, what, str(path), folder], cwd=folder,
            env=os.environ | {"PYTHONPATH": str(Path.cwd())}, capture_output=True, text=True, check=True,
        )  # fmt: skip
    names = ("seconds", "cpu_seconds", "mb_above_imports", "mb")
    figures = map(float, done.stdout.split("\n")[-2].split())
    return {"lines": text.count("\n"), **dict(zip(names, figures, strict=True))}


def peer(program: Made, moves: gcode.Moves) -> dict:
    """gcodeparser's words X and Y against where our printed moves end;
    it keeps no state, so that E cannot be compared."""
    if importlib.util.find_spec("gcodeparser") is None:
        return {}
    from gcodeparser import GcodeParser

    start = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            lines = GcodeParser(program.text).lines
    except (ValueError, KeyError, IndexError, TypeError, AttributeError) as failure:
        return {"gcodeparser": {"failed": f"{type(failure).__name__}: {str(failure)[:80]}"}}
    seconds = time.process_time() - start
    drawn = moves.kind == Kind.EXTRUDE
    own = dict(zip(moves.line[drawn].tolist(), moves.end[drawn, :2].tolist(), strict=True))
    theirs = {
        line.line_index + 1: [line.params["X"], line.params["Y"]]
        for line in lines
        if line.command in (("G", 0), ("G", 1), ("G", 2), ("G", 3)) and {"X", "Y"} <= set(line.params)
    }
    both = own.keys() & theirs.keys()
    return {
        "gcodeparser": {
            "lines_per_s": round(program.text.count("\n") / seconds),
            "printed_moves_in_both": len(both),
            "of_ours": len(own),
            "largest_difference_mm": max(
                (float(np.abs(np.subtract(own[k], theirs[k])).max()) for k in both), default=0.0
            ),
        }
    }


def plain(lines: int) -> bytes:
    rng = np.random.default_rng(0)
    rows = np.column_stack([rng.uniform(0, 200, (lines, 2)), rng.uniform(0, 1, lines)]).tolist()
    return "".join(f"G1 X{x:.3f} Y{y:.3f} E{e:.5f}\n" for x, y, e in rows).encode()


def job(lines: int) -> dict:
    """A two-material job of so many lines at 8 mm/s: text to a 50 Hz signal of the gantry."""
    two = Dialect(
        "G90\nM83\nG28",
        "M84",
        travel="G0 X{x:.3f} Y{y:.3f} F900",
        feed="G1 F480",
        retract="G1 E-.5 F1800",
        restore="G1 E.5 F1800",
        tool="T{tool}\nG4 P500",
        relative=True,
    )
    text = made(two, np.random.default_rng(2), runs=lines // 16).text.encode()
    program, parsing = best(lambda: gcode.parse(text))
    plan, planning = best(lambda: motion.plan(program.moves, **LIMITS))
    signal, sampling = best(lambda: motion.sampled(plan, program.moves, sample_time_s=0.02))
    parts = {"parse_s": parsing, "plan_s": planning, "sample_s": sampling}
    return {
        "lines": program.lines,
        "moves": len(program.moves.line),
        "samples": len(signal.time_s),
        "hours": round(signal.time_s[-1] / 3600, 2),
        **{name: round(seconds, 3) for name, seconds in parts.items()},
        "job_s": round(sum(parts.values()), 3),
    }


def composed() -> dict:
    """`beadline compose` of a slicer's job: 65,000 lines without and with a declared drive, and a million."""
    million = slicer_job(1_000_000)
    return {
        "compose_65k": watched("compose", slicer_job(65_000)),
        "compose_65k_drive": watched("compose", slicer_job(65_000), drive=True),
        "read_million": watched("read", million),
        "compose_million": watched("compose", million),
    }


def read_dialects() -> dict:
    dialects = {name: read(name, dialect, runs=400) for name, dialect in DIALECTS.items()}
    return {
        "dialects": dialects,
        "worst": {
            "reader_length_error": max(row.get("reader_length_error", 0.0) for row in dialects.values()),
            "reader_volume_error": max(row.get("reader_volume_error", 0.0) for row in dialects.values()),
            "lines_not_accounted": [
                name for name, row in dialects.items() if row.get("every_line_accounted") is False
            ],
            "refused_share": max(row["refused"] / row["lines"] for row in dialects.values()),
            "extruded_error": max(row["extruded_error"] for row in dialects.values()),
        },
    }


def rows(found: dict) -> list[Row]:
    """Reading, composing with and without the declared drive, and what each dialect came to."""
    free, driven, million = (
        found.get(name) for name in ("compose_65k", "compose_65k_drive", "compose_million")
    )
    out = [
        Row(
            f"{found['plain']['lines']:,} plain lines read",
            f"{found['plain']['lines_per_s']:,} lines/s",
            f"at least {BARS['lines_per_s']:,}",
        ),
        Row(
            f"job of {found['job']['lines']:,} lines: read, planned, sampled at 50 Hz",
            f"{found['job']['job_s']:g} s",
            f"at most {BARS['job_s']:g} s",
        ),
    ]
    for one, what, limit in (
        (driven, "composed with the drive that params.yaml declares", BARS["compose_65k_s"]),
        (free, "composed without a drive", BARS["compose_65k_s"]),
        (million, "composed without a drive", None),
        (found.get("read_million"), "read and planned", None),
    ):
        if one:
            beside = f"at most {limit:g} s" if limit else ""
            seconds = f"{one['seconds']:g} s, {one['cpu_seconds']:g} CPU s"
            memory = f"{one['mb_above_imports']:,.0f} MB above the imports"
            out.append(Row(f"{one['lines']:,} lines {what}", seconds, beside, memory))
    worst = found["worst"]
    out.append(
        Row(
            f"{len(found['dialects'])} dialects: largest error of the extruded length",
            f"{worst['extruded_error']:.1g}",
            f"at most {BARS['extruded_error']:g}",
            f"{100 * worst['refused_share']:g} % of the lines refused; "
            f"lines not accounted for: {', '.join(worst['lines_not_accounted']) or 'none'}",
        )
    )
    return out


def main() -> None:
    text = plain(400_000)
    _, seconds = best(lambda: gcode.parse(text))
    plainly = {"lines": 400_000, "seconds": round(seconds, 3), "lines_per_s": round(400_000 / seconds)}
    found = {"plain": plainly, "job": job(62_000), **composed(), **read_dialects()}
    results.write("gcode", rows(found))


if __name__ == "__main__":
    main()
