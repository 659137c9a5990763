"""What the benchmarks' results say beside their goals: one record of all, the README's tables, and what a
larger house would take. Nothing is measured here: a result that is not there reads "not measured", with the
command that makes it.
"""

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from pipeline.report.shared.digits import short
from pipeline.store import artifacts

RESULTS = Path(__file__).parent / "results"
FILE = RESULTS / "summary.json"
BEGIN, END = "<!-- speed: written by ./run python -m benchmarks -->", "<!-- /speed -->"

# beside nfoursid, which is of no default environment
IDENTIFICATION = ("benchmarks.identification", "speed")


class Benchmark(NamedTuple):
    """A module with its arguments, the result file and the part of it that it makes ("": all), minutes on two
    idle cores; {peer} among the arguments is the python of an environment with stable-baselines3."""

    arguments: tuple[str, ...]
    file: str
    part: str
    minutes: float

    @property
    def command(self) -> str:
        group = "--group peers " if self.arguments == IDENTIFICATION else ""
        return f"./run {group}python -m {' '.join(self.arguments)}".replace("{peer}", "PYTHON")

    @property
    def needs_peer(self) -> bool:
        return "{peer}" in self.arguments


BENCHMARKS: Mapping[str, Benchmark] = {
    "kernel": Benchmark(("benchmarks.kernel",), "kernel", "", 2.5),
    "agent": Benchmark(("benchmarks.agent", "speed"), "agent", "speed", 0.5),
    "agent_peer": Benchmark(("benchmarks.agent", "speed", "{peer}"), "agent", "peer", 1.0),
    "trial_frames": Benchmark(("benchmarks.trial_frames",), "trial_frames", "", 0.8),
    "classifier": Benchmark(("benchmarks.classifier", "speed"), "classifier", "speed", 0.8),
    "identification": Benchmark(IDENTIFICATION, "identification", "speed", 1.5),
    "gcode": Benchmark(("benchmarks.gcode", "compose"), "gcode", "compose_65k", 1.0),
    "reading_speed": Benchmark(
        ("benchmarks.reading_speed", "csv", "csv_checked"), "reading_speed", "csv", 1.5
    ),
    "stages": Benchmark(("benchmarks.stages",), "stages", "", 9.0),
    "growth": Benchmark(("benchmarks.growth",), "growth", "", 6.0),
}


class Goal(NamedTuple):
    """A measured figure: what it is, the benchmark that makes it, where it stands in its file (dots; numbers
    count in a list), its goal (None: only stated) and on which side of it is well, and its unit."""

    key: str
    what: str
    benchmark: str
    at: str
    goal: float | None
    side: str
    unit: str


# issue by issue: hot paths, then the default run
HOT_PATHS = (
    Goal("kernel", "kernel, N = 6, 15,000 samples, against the vectorised Kronecker form", "kernel",
         "figures.0.value", 60.0, "at least", "times faster"),
    Goal("kernel_syrk", "its Gram matrix, of the rate of BLAS syrk", "kernel", "figures.1.value", None, "",
         ""),
    Goal("agent_products", "DQN: updates against the bare products of an update", "agent",
         "speed.share_of_products", 0.85, "at least", "of their rate"),
    Goal("agent_loop", "DQN: whole loop against stable-baselines3", "agent_peer", "peer.ratio_whole_loop_s",
         4.0, "at least", "times faster"),
    Goal("frames", "raw frames of an MCAP recording to the bead's area", "trial_frames",
         "raw.raw_measured_per_s", 2500.0, "at least", "frames/s"),
    Goal("frames_decoded", "of these, only read and checked", "trial_frames", "raw.decoded_per_s", None, "",
         "frames/s"),
    Goal("transformer", "transformer, forward and backward, against its bare products", "classifier",
         "speed.share_of_products", 0.9, "at least", "of their rate"),
    Goal("transformer_images", "transformer of the paper's size, learned from", "classifier",
         "speed.images_per_s_wall", None, "", "images/s"),
    Goal("identification", "identification against nfoursid", "identification",
         "speed.times_faster_validated", 2.0, "at least", "times faster"),
    Goal("identification_none", "identification without refinement against nfoursid", "identification",
         "speed.times_faster_none", 10.0, "at least", "times faster"),
    Goal("compose", "65,000 lines of G-code composed", "gcode", "compose_65k.seconds", 2.0, "at most", "s"),
    Goal("compose_memory", "memory of that above the imports", "gcode", "compose_65k.mb_above_imports", 250.0,
         "at most", "MB"),
    Goal("compose_million", "memory of a million lines above the imports", "gcode",
         "compose_million.mb_above_imports", 600.0, "at most", "MB"),
    Goal("csv", "CSV of a million rows and 12 columns, against pyarrow", "reading_speed", "csv.ratio", 1.5,
         "at most", "times its time"),
)  # fmt: skip
DEFAULT_RUN = (
    Goal("temperature", "stages of the temperature loop", "stages", "loops_s.temperature", 80.0, "at most",
         "s"),
    Goal("deposition", "stages of the deposition loop", "stages", "loops_s.deposition", 60.0, "at most", "s"),
    Goal("setpoint", "stages of the setpoint loop", "stages", "loops_s.setpoint", 130.0, "at most", "s"),
    Goal("pages", "export, pages and DVC", "stages", "loops_s.pages_and_dvc", 30.0, "at most", "s"),
    Goal("whole", "the whole of the first `dvc repro`", "stages", "whole_s", 300.0, "at most", "s"),
    Goal("quick", "`beadline quick`, to its first page", "stages", "quick_s", 120.0, "at most", "s"),
    Goal("nothing", "`dvc repro` where nothing changed", "stages", "nothing_to_do_s", 3.5, "at most", "s"),
    Goal("one_more", "one more recording read", "stages", "one_more_recording_s", 8.0, "at most", "s"),
    Goal("peak", "most memory of a stage with its children", "stages", "peak_MB", 2000.0, "at most", "MB"),
)  # fmt: skip
GOALS = (*HOT_PATHS, *DEFAULT_RUN)
MUTANTS_GOAL, BRANCHES_GOAL, EXPONENT_GOAL = 0.9, 0.92, 1.1
ENDURANCE = {
    "killed_repros": "./run python -m benchmarks.killed_repros --kills 50",
    "killed_nights": "./run python -m benchmarks.killed_nights",
    "fuzz": "./run python -m benchmarks.fuzz --hours 1",
    "mutants": "./run python -m benchmarks.mutants",
    "branches": "./run --group peers python -m benchmarks.branches",
}
CORE_H = 3600.0
NIGHT_H, DAY_GB, MACHINES = 8.0, 100.0, 1000


# ---- what there is


def found(data: Any, at: str) -> Any:
    """data["a"][0] of "a.0", or None where that is not there; "" is all of it."""
    for key in at.split(".") if at else ():
        if isinstance(data, list):
            data = data[int(key)] if key.isdigit() and int(key) < len(data) else None
        else:
            data = data.get(key) if isinstance(data, Mapping) else None
    return data


def read(name: str, folder: Path) -> Any:
    path = folder / f"{name}.json"
    return artifacts.read_json(path) if path.exists() else None


def digest(data: Any) -> str:
    """Of a result, so that a machine is named only beside what was measured on it."""
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]


def met(value: float | None, goal: Goal) -> bool | None:
    """Whether the goal is met; None where there is no figure or no goal."""
    if value is None or goal.goal is None:
        return None
    return value >= goal.goal if goal.side == "at least" else value <= goal.goal


def row(goal: Goal, folder: Path, runs: Mapping[str, Any]) -> dict[str, Any]:
    """One figure beside its goal, with the command and the machine that made it."""
    benchmark = BENCHMARKS[goal.benchmark]
    data = read(benchmark.file, folder)
    value = found(data, goal.at)
    known = isinstance(value, int | float) and math.isfinite(value)
    run = runs.get(goal.benchmark, {})
    same = known and run.get("digest") == digest(found(data, benchmark.part))
    return {
        "what": goal.what,
        "value": float(f"{value:.4g}") if known else None,
        "unit": goal.unit,
        "goal": goal.goal,
        "side": goal.side,
        "met": met(float(value) if known else None, goal),
        "command": benchmark.command,
        "machine": run["machine"] if same else None,
        **({} if known else {"why": "not measured"}),
    }


def gathered(folder: Path = RESULTS, runs: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Everything that the results in `folder` say. `runs` {benchmark: {machine, digest}}: on which machine
    each result was measured, while its digest is that of the result."""
    runs = runs or {}
    figures = {goal.key: row(goal, folder, runs) for goal in GOALS}
    stages, growth = read("stages", folder), read("growth", folder)
    return {
        "hot_paths": {goal.key: figures[goal.key] for goal in HOT_PATHS},
        "default_run": {goal.key: figures[goal.key] for goal in DEFAULT_RUN},
        "stages": found(stages, "stages") or not_measured(BENCHMARKS["stages"].command),
        "growth": grown(growth) if growth else not_measured(BENCHMARKS["growth"].command),
        **endurance(folder),
        "scale": scale(folder),
        "runs": dict(runs),
    }


def not_measured(command: str) -> dict[str, str]:
    return {"why": "not measured", "command": command}


def grown(sweeps: Mapping[str, Any]) -> dict[str, Any]:
    """Every sweep beside the limit of its exponent."""
    return {
        name: {**sweep, "limit": EXPONENT_GOAL, "met": _within(sweep.get("exponent"), EXPONENT_GOAL)}
        for name, sweep in sweeps.items()
    }


def _within(value: float | None, most: float) -> bool | None:
    return None if value is None else value <= most


def endurance(folder: Path) -> dict[str, Any]:
    """The tables of kills, fuzzing, mutants and branches: what matters of each file."""
    out: dict[str, Any] = {}
    for name, command in ENDURANCE.items():
        data = read(name, folder)
        out[name] = {**TABLES[name](data), "command": command} if data else not_measured(command)
    return out


def _kills(data: Mapping[str, Any]) -> dict[str, Any]:
    same = data["repros_with_the_same_bytes"]
    names = ("kills", "whole_tree", "stages_made", "files", "repros", "repros_with_the_same_bytes", "seed")
    return {name: data[name] for name in names} | {"met": same == data["repros"] and data["kills"] >= 50}


def _nights(data: Mapping[str, Any]) -> dict[str, Any]:
    kills = {name: {k: one[k] for k in ("kills", "passed")} for name, one in data.items() if "kills" in one}
    troubles = data.get("troubles", {})
    passed = sum(bool(one["passed"]) for one in troubles.values())
    every = all(one["kills"] == one["passed"] for one in kills.values()) and passed == len(troubles)
    return {"kills": kills, "troubles": len(troubles), "troubles_passed": passed, "met": every}


def _fuzz(data: Mapping[str, Any]) -> dict[str, Any]:
    files = sum(sum(answers.values()) for answers in data["files"].values())
    figures = {name: data[name] for name in ("hours", "seeds", "tracebacks", "hangs")}
    met = data["tracebacks"] == data["hangs"] == 0 and data["hours"] >= 1
    return figures | {"kinds": len(data["files"]), "files": files, "met": met}


def _mutants(data: Mapping[str, Any]) -> dict[str, Any]:
    names = ("mutants", "killed", "equivalent", "share_killed")
    modules = {module: {name: one[name] for name in names} for module, one in data.items()}
    enough = all(one["share_killed"] >= MUTANTS_GOAL for one in modules.values())
    return {"goal": MUTANTS_GOAL, "modules": modules, "met": enough}


def _branches(data: Mapping[str, Any]) -> dict[str, Any]:
    figures = {name: data[name] for name in ("branches", "taken", "share_taken")}
    return {"goal": BRANCHES_GOAL, **figures, "met": data["share_taken"] >= BRANCHES_GOAL}


TABLES = {
    "killed_repros": _kills, "killed_nights": _nights, "fuzz": _fuzz, "mutants": _mutants,
    "branches": _branches,
}  # fmt: skip


# ---- a larger house


def scale(folder: Path) -> dict[str, Any]:
    """Core-hours of a day with DAY_GB of recordings and of MACHINES that relearn every night, by the rates of
    one core in the results; None where a rate is not measured."""
    frames, tables, stages = (read(name, folder) for name in ("trial_frames", "reading_speed", "stages"))
    csv_MB_per_s = _per(found(tables, "csv_checked.MB"), found(tables, "csv_checked.ours_s"))
    film = {}
    for name in ("raw", "jpeg"):
        taken_s = _per(450.0, found(frames, f"{name}.measured_per_s"))
        film[name] = _per(found(frames, f"{name}.MB"), taken_s)
    day = {"csv": csv_MB_per_s, "raw frames": film["raw"], "JPEG frames": film["jpeg"]}
    rows = found(stages, "stages") or []
    loops = {
        loop: sum(one["cpu_s"] for one in rows if one["loop"] == loop) or None
        for loop in ("temperature", "deposition", "setpoint")
    }
    return {
        "MB_per_core_s": {name: _rounded(rate) for name, rate in day.items()},
        "core_h_a_day": {
            name: _rounded(DAY_GB * 1000 / rate / CORE_H) if rate else None for name, rate in day.items()
        },
        "loop_core_s": {loop: _rounded(seconds) for loop, seconds in loops.items()},
        "machines_core_h": {
            loop: _rounded(MACHINES * seconds / CORE_H) if seconds else None
            for loop, seconds in loops.items()
        },
    }


def _per(amount: float | None, by: float | None) -> float | None:
    return None if amount is None or not by else amount / by


def _rounded(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.3g}")


# ---- in words


def worded(value: float | None, unit: str) -> str:
    if value is None:
        return "not measured"
    return f"{short(value)} {unit}".rstrip()


def goal_worded(figure: Mapping[str, Any]) -> str:
    return f"{figure['side']} {figure['goal']:,g}" if figure["goal"] is not None else ""


def state(figure: Mapping[str, Any]) -> str:
    """ "met" or "missed"; nothing where there is no figure or no goal."""
    return {True: "met", False: "missed", None: ""}[figure["met"]]


def machines(summary: Mapping[str, Any]) -> str:
    """Where the figures come from, in a sentence."""
    figures = [*summary["hot_paths"].values(), *summary["default_run"].values()]
    known = [figure["machine"] for figure in figures if figure["value"] is not None]
    named = sorted({f"{one['cpu']}, {one['cores']} cores" for one in known if one})
    unknown = sum(one is None for one in known)
    if not named:
        return "On which machine is not recorded." if known else ""
    rest = f"; of {unknown} figures the machine is not recorded" if unknown else ""
    return f"Measured on {' and '.join(named)}{rest}."


def block(summary: Mapping[str, Any]) -> str:
    """What stands in the README between BEGIN and END."""
    figures = [*summary["hot_paths"].values(), *summary["default_run"].values()]
    lines = [
        BEGIN,
        "| | measured | goal | |",
        "|---|---|---|---|",
        *(
            f"| {one['what']} | {worded(one['value'], one['unit'])} | {goal_worded(one)} | {state(one)} |"
            for one in figures
        ),
        "",
        machines(summary),
        "",
        *growth_lines(summary["growth"]),
        "",
        "### Scale",
        "",
        *(f"- {sentence}" for sentence in scale_sentences(summary["scale"])),
        END,
    ]
    return "\n".join(lines).replace("\u202f", " ").replace("\u00a0", " ")


def growth_lines(growth: Mapping[str, Any]) -> list[str]:
    """A table of how time grows, or that it is not measured."""
    fitted = [one for one in growth.values() if isinstance(one, Mapping) and "exponent" in one]
    if not fitted:
        return [f"How time and memory grow is not measured: `{BENCHMARKS['growth'].command}`."]
    return [
        f"Exponent of CPU time over size: 1 is linear, at most {EXPONENT_GOAL:g} is asked.",
        "",
        "| | from, to | exponent | steepest step | memory at the largest | |",
        "|---|---|---|---|---|---|",
        *(
            f"| {one['what']} | {span(one)} {one['unit']} | {one['exponent']:.2f} | {one['steepest']:.2f} | "
            f"{short(known(one)[-1]['above_MB'])} MB | {state(one)} |"
            for one in fitted
        ),
    ]


def known(sweep: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The sizes that could be measured."""
    return [point for point in sweep["points"] if "cpu_s" in point]


def span(sweep: Mapping[str, Any]) -> str:
    """Its smallest and largest size that could be measured."""
    points = known(sweep)
    return f"{points[0]['size']:,} to {points[-1]['size']:,}"


def scale_sentences(told: Mapping[str, Any]) -> list[str]:
    """What DAY_GB a day and MACHINES would take, a sentence each."""
    sentences = [
        f"{DAY_GB:g} GB a day, read and checked as {name}: {_hours(hours)} of one core "
        f"({short(told['MB_per_core_s'][name])} MB/s)."
        for name, hours in told["core_h_a_day"].items()
        if hours is not None
    ]
    nights = [
        f"{MACHINES:,} machines that relearn the {loop} loop every night: {_hours(hours)} of one core, "
        f"{math.ceil(hours / NIGHT_H)} cores for {NIGHT_H:g} h."
        for loop, hours in told["machines_core_h"].items()
        if hours is not None
    ]
    lacking = f"What {MACHINES:,} machines take is not measured: `{BENCHMARKS['stages'].command}`."
    rest = "Reckoned from the rates of one core. Network, disks and a cluster were not measured."
    return [*sentences, *(nights or [lacking]), rest]


def _hours(hours: float) -> str:
    return f"{short(hours)} h" if hours >= 1 else f"{short(60 * hours)} min"


def _plain(text: str) -> str:
    """Spaces that a text file can be searched by."""
    return text.replace("\u202f", " ").replace("\u00a0", " ")


def in_readme(readme: str, text: str) -> str:
    """The README with another block. Raises ValueError where it has no place for one."""
    if BEGIN not in readme or END not in readme:
        raise ValueError(f"README.md: expected the lines {BEGIN} and {END}, found none; put them back")
    before, rest = readme.split(BEGIN, 1)
    return f"{before}{text}{rest.split(END, 1)[1]}"
