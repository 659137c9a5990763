"""`./run beadline COMMAND`: what is not a stage."""

import argparse
import datetime
import importlib.metadata
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.nightly import commands as nights
from pipeline.store import artifacts, params
from pipeline.store.printable import printable
from pipeline.temperature.settings import Plant
from stages.ingest import Ingest

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.commands.shadow.deploy import Ready
    from pipeline.nightly.records import ChampionState, Night
    from pipeline.nightly.settings import Nightly


def accept(_: argparse.Namespace) -> None:
    """Mark the figures of this run as good: later reports show their differences against them."""
    from pipeline.report.shared.sources import machine

    metrics = {
        path.parent.name: artifacts.read_json(path)
        for path in sorted(Path("datasets").glob("[a-z]*/figures.json"))
        if path.parent.name != "report"
    }
    if not metrics:
        raise ValueError("datasets: expected the figures of a run, found none; run ./run dvc repro first")
    files = sorted(
        path
        for path in Path("datasets").rglob("*")
        if path.is_file() and path.parts[1] not in {"memo", "report"} and not path.parts[1].startswith(".")
    )
    hashes = {path.as_posix(): artifacts.sha256(path) for path in [*files, Path("pipeline"), Path("stages")]}
    run = {
        "accepted": _today(),
        "machine": machine("reports/machine.js"),
        "metrics": metrics,
        "params": params.read(),
        "hashes": hashes,
    }
    artifacts.write_json("reports/accepted.json", run | _shown())
    print(
        f"reports/accepted.json: accepted {len(metrics)} stages' figures and {len(hashes)} artifacts; "
        "commit it to keep it"
    )


def _today() -> dict[str, str]:
    """The day, and the commit that is checked out; "none" where there is none."""
    head = subprocess.run(
        ["git", "rev-parse", "--short=8", "HEAD"], capture_output=True, text=True, check=False
    )
    return {
        "on": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "commit": head.stdout.strip() if head.returncode == 0 else "none",
    }


def _shown() -> dict:
    """What the pages show: figures with their bands, the verdict of each loop, which controller of the
    temperature loop the verdict names, and the curves; nothing if no page was made. Raises ValueError if the
    pages are of another run."""
    if not artifacts.exists("datasets/report/figures.json"):
        return {"figures": {}, "winner": None, "verdicts": {}, "curves": {}}
    report = artifacts.read_figures("report")
    stale = [
        path
        for path, recorded in report["read"].items()
        if not artifacts.exists(path) or artifacts.sha256(path) != recorded
    ]
    if stale:
        raise ValueError(
            f"reports: the pages are of another run than {stale[0]}; run ./run dvc repro, "
            "look at them, and accept then"
        )
    return {
        "figures": report["figures"],
        "winner": report["verdict"]["winner"],
        "verdicts": report["verdicts"],
        "curves": artifacts.read_json("reports/data/curves.json"),
    }


def screenshots(arguments: argparse.Namespace) -> None:
    """Take the pictures of the README: page one and the viewer, as they are in reports/."""
    from pipeline.report import screenshots as pictures

    print(f"written: {', '.join(path.as_posix() for path in pictures.take(arguments.folder))}")


def runs(arguments: argparse.Namespace) -> None:
    """Write a page of two runs side by side: figures with bands, and parameters that differ. A and B are
    commits, tags, branches or DVC experiments whose metrics git has."""
    from pipeline.report.runs import commits
    from pipeline.report.runs import page as runs_page
    from pipeline.verdict.settings import ReportRules

    a, b = (commits.run_of(name) for name in (arguments.a, arguments.b))
    path = (
        "-".join(["reports/runs", *(commits.commit_of(name)[:8] for name in (arguments.a, arguments.b))])
        + ".html"
    )
    artifacts.write_text(path, runs_page.render_two(a, b, params.load(ReportRules, "report")))
    print(path)


def inspect(arguments: argparse.Namespace) -> None:
    """What is in a recording: signals, rates, jitter, gaps, ranges,
    damage; and a mapping to paste into params.yaml."""
    from pipeline.recordings.inspection import inspect as describe
    from pipeline.recordings.isolated import Budget, isolated
    from pipeline.recordings.plain_files import check_plain_file

    here = Path(params.FILE) if Path(params.FILE).exists() else Path(__file__).parents[1] / params.FILE
    declared = params.load(Ingest, "ingest", here)
    check_plain_file(arguments.file)
    budget = Budget(declared.longest_s, declared.largest_mb)
    print(printable(isolated(describe, arguments.file, shown=arguments.file, budget=budget)))


def quick(arguments: argparse.Namespace) -> None:
    """Write a first page to quick/: every loop at the sizes of params.quick.yaml,
    with a classifier that git keeps. datasets/, reports/ and dvc.lock stay as they are."""
    from pipeline import quick as looking

    print(printable(looking.keep() if arguments.keep else looking.quick()))


def init(arguments: argparse.Namespace) -> None:
    """Recordings of a new machine into params.yaml: mapping, plant, panel and rules that fit its pace, the
    loops that they serve; and what a person must still decide."""
    from pipeline.commands import propose_params

    initialised = propose_params.proposed(arguments.recordings, sample_time=arguments.time)
    values = propose_params.loops_to_run(["temperature"]) | initialised.values
    changed, edited = propose_params.write(values, force=arguments.force)
    if arguments.copy:
        propose_params.copy(arguments.recordings)
    initialised = initialised._replace(values=values)
    print(propose_params.summary(initialised, changed, edited, arguments.recordings, arguments.copy))


def first_experiment(arguments: argparse.Namespace) -> None:
    """An experiment for a machine of which there is no good record: for Klipper G-code of targets, for any
    other machine a staircase of inputs with the temperatures at which to stop. No model is behind it."""
    from pipeline.commands import first_experiment as first
    from pipeline.temperature.settings import check_output_limits
    from stages.ingest import Ingest

    machine = params.load(Plant, "plant")
    check_output_limits(machine, "recordings")
    if heaters := first.heaters(machine, params.load(Ingest, "ingest").mapping):
        plan, file = first.targets(heaters, arguments.minutes), arguments.out.with_suffix(".gcode")
        artifacts.write_text(file, first.gcode(plan, arguments.ramp))
        print(first.printed(plan, str(file)))
        return
    steps = first.staircase(machine, arguments.hold)
    artifacts.write_csv(arguments.out, first.columns(steps))
    print(first.instructions(steps, str(arguments.out)))


def compose(arguments: argparse.Namespace) -> None:
    """A part program into plunger commands (CSV, Parquet, MCAP, G-code with leads), tasks and lines as
    Parquet, and whether it will print."""
    from pipeline.commands import compose as command
    from pipeline.deposition.parts.part_report import summary_lines
    from pipeline.deposition.settings import ComposeParts, Printer
    from stages.compose_parts import compose_part

    if arguments.out.exists() and not arguments.out.is_dir():
        raise ValueError(
            f"--out {arguments.out}: should be a folder but is a file; name a folder, "
            "which is made where it is missing"
        )
    request = command.request(
        scale=arguments.scale, speed=arguments.speed, filament_mm=arguments.filament_mm,
        extruder=arguments.extruder, bead=arguments.bead,
    )  # fmt: skip
    formats, learned = command.formats(arguments.formats), command.read_learned()
    printer, settings = params.load(Printer, "printer"), params.load(ComposeParts, "compose_parts")
    part = compose_part(arguments.part, learned, printer, settings, **request)
    arguments.out.mkdir(parents=True, exist_ok=True)
    files = command.write(part, arguments.out, formats)
    print(summary_lines(part))
    print("written: " + ", ".join(str(file) for file in files))
    if arguments.verify:
        from pipeline.commands import verify_part

        print(verify_part.write(part, learned, printer, settings, arguments.out))
        print(verify_part.write_next(part, learned, printer, arguments.part.parent, arguments.out))


def calibrate_tip(arguments: argparse.Namespace) -> None:
    """A picture of the nozzle's camera into a page on which a click gives the
    tip; with --tip, what the front end makes of it."""
    from pipeline.commands.calibrate_tip import calibrate

    sections = params.read()
    try:
        least_score = float(sections["train_classifier"]["least_score"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{params.home('train_classifier.least_score') or params.EXPERT}: "
            f"train_classifier.least_score should be a number of gray levels ({error}); write one such as 10"
        ) from None
    topics = sections["train_classifier"].get("topics")
    topic = str(topics.get("image") or "") if isinstance(topics, dict) else ""
    out = arguments.out or Path(f"{arguments.image.stem}.tip.html")
    print(calibrate(arguments.image, out, arguments.tip, least_score=least_score, topic=topic))


def calibrate_camera(arguments: argparse.Namespace) -> None:
    """Pictures of printed lines of known widths into section camera of params.yaml:
    size of a pixel, rotation, measured columns, edge bias by width; and a page."""
    from pipeline.commands import calibrate_camera as camera

    request = camera.CalibrationRequest(
        arguments.images,
        camera.numbers(arguments.widths, "--widths", "0.5,0.9,1.3"),
        camera.pixel(arguments.tip),
        arguments.pitch,
    )
    out = arguments.out or Path(f"{arguments.images[0].stem}.camera.html")
    print(camera.calibrate(request, out, write=arguments.write))


def shadow(arguments: argparse.Namespace) -> None:
    """Watch a printer's camera: what the controller would do in each window and why,
    as MCAP and a local page. Nothing is sent."""
    from pipeline.commands.shadow import deploy

    _watch(arguments, deploy.ready(str(arguments.levels or "")))


def _watch(arguments: argparse.Namespace, ready: "Ready") -> None:
    """Watches a source of frames with the loop that is ready."""
    from pipeline.commands import shadow as watching
    from pipeline.commands.shadow import deploy
    from pipeline.recordings.watch_sources import display_name, source
    from pipeline.setpoint.vision.proof import verdict

    asked = deploy.asked(
        arguments.flow, arguments.temperature, arguments.tip, once=arguments.once, settings=ready
    )
    frames = source(arguments.source, ready.topics, rate_hz=deploy.bounded("--rate", arguments.rate))
    place = display_name(arguments.source)
    print(f"{place}: {verdict(ready.deployed.proof)}", flush=True)
    print(f"{place}: open {arguments.out / 'index.html'}; Ctrl-C ends the watch", flush=True)
    with watching.until_told() as stopped:
        watched = watching.watch(frames, ready.deployed, asked, arguments.out, place=place, stopped=stopped)
    if watched.unreadable:
        raise ValueError(f"{place}: none of {watched.frames} frames can be read: {watched.unreadable}")
    print(watching.summary_lines(watched, place))


def record_levels(arguments: argparse.Namespace) -> None:
    """Flows that were held for a minute each before a printer's camera into the correction for that camera,
    and a page."""
    from functools import partial

    from pipeline.commands import record_levels as levels
    from pipeline.commands.shadow import deploy
    from pipeline.commands.training_print import numbers
    from pipeline.recordings.watch_sources import RecordingSource
    from pipeline.setpoint.recordings import read_options
    from pipeline.setpoint.settings import SetpointMaterial
    from pipeline.setpoint.vision.calibrated_classifier import read_frames
    from pipeline.setpoint.vision.window_flow import window_flow

    eye = deploy.trained()
    options, fitted = read_options(eye.view), eye.model.calibration
    material = params.load(SetpointMaterial, "setpoint_material").material()
    protocol = levels.Protocol(
        numbers(arguments.flows, "--flows"),
        deploy.bounded("--hold", arguments.hold),
        deploy.bounded("--settle", arguments.settle),
        deploy.bounded("--temperature", arguments.temperature),
        deploy.pixel(arguments.tip) if arguments.tip else options.tip_px,
    )
    place = arguments.source
    source = levels.source_of(place, lambda path: RecordingSource(path, options.topics))
    levels_eye = levels.Eye(
        partial(read_frames, eye.model), partial(window_flow, fitted=fitted.flow), eye.view.window,
        eye.view.least_score, eye.digest, eye.view.false_alarms, material,
    )  # fmt: skip
    recorded, told = levels.record(source, protocol, levels_eye, place=str(place))
    print(levels.write(recorded, told, arguments.out, str(place), material))


def training_print(arguments: argparse.Namespace) -> None:
    """The G-code of a print from which the classifier learns: flows and temperatures in steps,
    with a layer at 100 % between; and a table of which setting holds from which line on."""
    from pipeline.commands import training_print as printing
    from pipeline.commands.shadow.deploy import pixel

    def one(flag: str) -> float:
        return printing.numbers(str(getattr(arguments, flag[2:].replace("-", "_"))), flag, 1)[0]

    def pair(flag: str) -> tuple[float, float]:
        x, y = printing.numbers(getattr(arguments, flag[2:]), flag, 2)
        return x, y

    asked = printing.TrainingPrint(
        flows=printing.numbers(arguments.flows, "--flows"),
        temperatures=printing.numbers(arguments.temperatures, "--temperatures"),
        bed=pair("--bed"), height=one("--height"), size=pair("--size"), nozzle=one("--nozzle"),
        layer=one("--layer"), filament=one("--filament"), speed=one("--speed"), travel=one("--travel"),
        bed_temperature=one("--bed-temperature"), best_temperature=one("--best-temperature"),
        melt=one("--melt"),
    )  # fmt: skip
    print(printing.write(asked, arguments.out, pixel(arguments.tip) if arguments.tip else None))


def export(arguments: argparse.Namespace) -> None:
    """A certified controller as C99 without heap, as one file of Python, or as settings for Klipper and
    Kalico; what sees and decides in the setpoint loop as weights with readers that need numpy alone."""
    from pipeline.commands.export import export as write

    print(write(arguments.controller, arguments.to, arguments.out, arguments.section))


def replay(arguments: argparse.Namespace) -> None:
    """A recording, and what a certified controller would have asked on it and why not: as MCAP with a layout
    for Foxglove, and a page. Frames of the nozzle's camera go through the loop of shadow with the classifier
    and the filter of CONTROLLER. Nothing is sent."""
    from pipeline.commands import export as exports

    if exports.shows_frames(arguments.controller):
        from pipeline.commands import replay_camera

        arguments.source, arguments.rate, arguments.once = str(arguments.recording), 5.0, True
        _watch(arguments, replay_camera.ready(arguments.controller))
        return
    from pipeline.commands import replay as replaying
    from pipeline.report.replay import page

    done, made, told = replaying.replay_recording(
        arguments.controller, arguments.recording, arguments.out, replaying.temperatures(arguments.reference)
    )
    inputs, outputs = ([one.name for one in side] for side in (made.machine.inputs, made.machine.outputs))
    shown = page.ReplayData(
        done.time_s, done.applied, done.asked, done.measured, done.reference, done.off, inputs, outputs, told
    )
    artifacts.write_text(arguments.out / "index.html", page.render(shown))
    print(f"{arguments.recording}: {told['samples']} samples. {page.decision(told)}")
    print(f"written: {arguments.out}/index.html, replay.mcap, layout.json, replay.json")


def render_night(nights: "Sequence[Night]", state: "ChampionState", settings: "Nightly") -> str:
    """The page of a night: of every night that is remembered, and of what is in production."""
    from pipeline.report.nightly import page

    return page.render(nights, state, settings)


def version() -> str:
    """The version that pyproject.toml beside the code states; without one, that of the installed package."""
    project = Path(__file__).resolve().parents[1] / "pyproject.toml"
    if project.exists():
        return tomllib.loads(project.read_text(encoding="utf-8"))["project"]["version"]
    return importlib.metadata.version("beadline")


def _add_print(command: argparse.ArgumentParser) -> None:
    """What frames may not say of the print."""
    command.add_argument("--tip", default="", metavar="X,Y", help="the nozzle's tip in pixels of the frames")
    command.add_argument(
        "--flow", type=float, default=100.0, help="flow setpoint in %% where frames have none (100)"
    )
    command.add_argument(
        "--temperature", type=float, default=210.0, help="of the nozzle in °C where frames have none (210)"
    )


def _add_shadow(commands: argparse._SubParsersAction) -> None:
    command = commands.add_parser("shadow", help=shadow.__doc__, description=shadow.__doc__)
    command.add_argument(
        "source",
        help="a folder that fills with pictures, an MCAP file that grows, or the address of a snapshot",
    )
    command.add_argument(
        "--out", type=Path, default=Path("shadow"), metavar="DIR", help="for page and decisions (shadow)"
    )
    _add_print(command)
    command.add_argument(
        "--levels",
        type=Path,
        metavar="FILE",
        help="of record-levels (datasets/levels/levels.parquet, if there)",
    )
    command.add_argument("--rate", type=float, default=5.0, metavar="HZ", help="snapshots a second (5)")
    command.add_argument("--once", action="store_true", help="end where the source ends")
    command.set_defaults(run=shadow)


def _add_record_levels(commands: argparse._SubParsersAction) -> None:
    command = commands.add_parser(
        "record-levels", help=record_levels.__doc__, description=record_levels.__doc__
    )
    command.add_argument(
        "source", type=Path, metavar="FOLDER|MCAP",
        help="pictures, each of the time when its file was written, or a recording",
    )  # fmt: skip
    command.add_argument(
        "--flows", default="60,80,100,125,160", metavar="PERCENT,...",
        help="in the order in which they were held (60,80,100,125,160)",
    )  # fmt: skip
    command.add_argument(
        "--hold",
        type=float,
        default=60.0,
        metavar="S",
        help="how long each was held, from the first frame on (60)",
    )
    command.add_argument(
        "--settle",
        type=float,
        default=10.0,
        metavar="S",
        help="after each change, in which the melt follows (10)",
    )
    command.add_argument(
        "--temperature", type=float, default=210.0, help="of the nozzle in °C where the source has none (210)"
    )
    command.add_argument("--tip", default="", metavar="X,Y", help="the nozzle's tip in pixels")
    command.add_argument(
        "--out", type=Path, default=Path("datasets/levels/levels.parquet"), metavar="FILE",
        help="where shadow looks for it (datasets/levels/levels.parquet)",
    )  # fmt: skip
    command.set_defaults(run=record_levels)


def _add_training_print(commands: argparse._SubParsersAction) -> None:
    words = str(training_print.__doc__).replace("%", "%%")
    command = commands.add_parser("training-print", help=words, description=words)
    command.add_argument("out", type=Path, metavar="OUT.gcode", help="the table stands beside it")
    for flag, default, metavar, words in (
        ("--flows", "40,60,75,85,92,100,108,115,125,150,200", "PERCENT,...", "steps of the flow"),
        ("--temperatures", "190,200,210,220,230", "DEGC,...", "steps of the nozzle's temperature"),
        ("--bed", "220,220", "MM,MM", "the bed along x and y"),
        ("--height", "250", "MM", "room above the bed"),
        ("--size", "50,20", "MM,MM", "the cuboid along x and y"), ("--nozzle", "0.4", "MM", "its diameter"),
        ("--layer", "0.2", "MM", "height of a layer"), ("--filament", "1.75", "MM", "its diameter"),
        ("--speed", "20", "MM/S", "of lines"), ("--travel", "100", "MM/S", "between them"),
        ("--bed-temperature", "60", "DEGC", "of the bed"),
        ("--best-temperature", "210", "DEGC", "of the layers between"),
        ("--melt", "12", "MM^3/S", "the most that the hot end melts"),
    ):  # fmt: skip
        command.add_argument(flag, default=default, metavar=metavar, help=f"{words} ({default})")
    command.add_argument("--tip", default="", metavar="X,Y", help="the nozzle's tip in pixels, for the table")
    command.set_defaults(run=training_print)


def _add_runs(commands: argparse._SubParsersAction) -> None:
    command = commands.add_parser("runs", help=runs.__doc__, description=runs.__doc__)
    command.add_argument("a", metavar="A", help="the run before")
    command.add_argument("b", metavar="B", help="the run after")
    command.set_defaults(run=runs)


def _add_export(commands: argparse._SubParsersAction) -> None:
    command = commands.add_parser("export", help=export.__doc__, description=export.__doc__)
    command.add_argument("controller", type=Path, metavar="CONTROLLER", help="a folder of export_controllers")
    command.add_argument("--to", required=True, choices=("c", "python", "klipper"))
    command.add_argument("--out", type=Path, metavar="DIR", help="(CONTROLLER/c, .../python, .../klipper)")
    command.add_argument(
        "--section", default="extruder", choices=("extruder", "heater_bed"), help="of printer.cfg (extruder)"
    )
    command.set_defaults(run=export)


def _add_replay(commands: argparse._SubParsersAction) -> None:
    command = commands.add_parser("replay", help=replay.__doc__, description=replay.__doc__)
    command.add_argument("controller", type=Path, metavar="CONTROLLER", help="a folder of export_controllers")
    command.add_argument(
        "recording",
        type=Path,
        metavar="RECORDING",
        help="CSV, Parquet, MCAP, klippy.log; of frames a folder of pictures or an MCAP",
    )
    command.add_argument("--out", type=Path, default=Path("replay"), metavar="DIR", help="(replay)")
    command.add_argument(
        "--reference", default="", metavar="DEGC,...", help="one an output, where the recording has none"
    )
    _add_print(command)
    command.set_defaults(run=replay)


# what stands behind ./run beadline COMMAND in the example of its --help
EXAMPLES = {
    "accept": "",
    "screenshots": "",
    "inspect": "log.csv",
    "quick": "",
    "init": "log.csv --copy",
    "first-experiment": "--hold 200",
    "compose": "part.gcode --as csv,gcode --out jobs",
    "calibrate-tip": "frame.png --tip 320,240",
    "calibrate-camera": "lines.png --widths 0.4,0.6,0.8 --pitch 3",
    "shadow": "frames --once",
    "record-levels": "frames --flows 60,80,100,125,160",
    "training-print": "training.gcode",
    "export": "datasets/export_controllers/temperature --to c",
    "replay": "datasets/export_controllers/temperature log.csv",
    "nightly": "",
    "rollback": "night-0042",
    "runs": "HEAD~1 HEAD",
}
STATUSES = "0 done; 1 refused, and one sentence says why; 2 a wrong option"
OTHER_STATUSES = {
    "nightly": "0 promoted, kept or nothing new; 1 the night or one loop failed; 3 drift alarm; "
    "4 recordings set aside; 75 another night is at work"
}


def _tell(name: str, command: argparse.ArgumentParser) -> None:
    """Behind a command's options: an example and the exit statuses."""
    example = f"./run beadline {name} {EXAMPLES.get(name, '')}".rstrip()
    command.epilog = f"Example: {example} | Exit status: {OTHER_STATUSES.get(name, STATUSES)}"


def parser() -> argparse.ArgumentParser:
    """Every command with its options."""
    parser = argparse.ArgumentParser(
        prog="beadline", description="Extrusion-printer recordings into controllers that can be trusted."
    )
    parser.add_argument("--version", action="version", version=f"beadline {version()}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    commands.add_parser("accept", help=accept.__doc__, description=accept.__doc__).set_defaults(run=accept)
    _add_runs(commands)
    command = commands.add_parser("screenshots", help=screenshots.__doc__, description=screenshots.__doc__)
    command.add_argument("--folder", type=Path, default=Path("reports"), metavar="DIR", help="(reports)")
    command.set_defaults(run=screenshots)
    command = commands.add_parser("inspect", help=inspect.__doc__, description=inspect.__doc__)
    command.add_argument("file", type=Path)
    command.set_defaults(run=inspect)
    command = commands.add_parser("quick", help=quick.__doc__, description=quick.__doc__)
    command.add_argument(
        "--keep", action="store_true", help="keep the classifier of this checkout's full run for it"
    )
    command.set_defaults(run=quick)
    command = commands.add_parser("init", help=init.__doc__, description=init.__doc__)
    command.add_argument("recordings", type=Path, nargs="+", metavar="RECORDING")
    command.add_argument("--copy", action="store_true", help="copy them into datasets/raw/temperature")
    command.add_argument("--force", action="store_true", help="overwrite values that were edited")
    command.add_argument(
        "--time",
        default="",
        metavar="'every 0.08 s'",
        help="the sample time of recordings that do not say it",
    )
    command.set_defaults(run=init)
    command = commands.add_parser(
        "first-experiment", help=first_experiment.__doc__, description=first_experiment.__doc__
    )
    command.add_argument("--minutes", type=float, default=60.0, help="length of the G-code (60)")
    command.add_argument(
        "--ramp", type=float, default=0.0, help="°C a minute of the G-code's targets (0: none)"
    )
    command.add_argument(
        "--hold", type=float, default=300.0, help="seconds of a step of inputs at most (300)"
    )
    command.add_argument("--out", type=Path, default=Path("first_experiment.csv"), metavar="FILE")
    command.set_defaults(run=first_experiment)
    command = commands.add_parser("compose", help=compose.__doc__, description=compose.__doc__)
    command.add_argument("part", type=Path, help="the part program (G-code)")
    command.add_argument("--out", type=Path, default=Path("."), help="folder for signal, tasks and report")
    command.add_argument(
        "--as",
        dest="formats",
        default="csv",
        metavar="csv,parquet,mcap,gcode",
        help="the commands' formats; gcode: with leads, for machines that play no signal (csv)",
    )
    command.add_argument(
        "--scale", type=float, default=1.0, help="X, Y and Z times this, E's volume with them (1)"
    )
    command.add_argument("--speed", type=float, default=1.0, help="feeds times this (1)")
    command.add_argument(
        "--filament-mm",
        type=float,
        metavar="MM",
        help="diameter of what E pushes; default: as the program says",
    )
    command.add_argument(
        "--extruder", default="", metavar="WORD", help="what drives the extrusion: E, U, 'M42 P4', ..."
    )
    command.add_argument(
        "--bead",
        choices=("e", "declared"),
        default="e",
        help="volume of a line: by E where it counts, or the declared bead's (e)",
    )
    command.add_argument(
        "--verify", action="store_true", help="also the shortest print that shows whether the forecast holds"
    )
    command.set_defaults(run=compose)
    command = commands.add_parser(
        "calibrate-tip", help=calibrate_tip.__doc__, description=calibrate_tip.__doc__
    )
    command.add_argument("image", type=Path, help="a frame of the nozzle's camera")
    command.add_argument(
        "--tip", default="", metavar="X,Y", help="the tip in pixels, from the left and from the top"
    )
    command.add_argument("--out", type=Path, metavar="FILE", help="the page; default IMAGE.tip.html here")
    command.set_defaults(run=calibrate_tip)
    command = commands.add_parser(
        "calibrate-camera", help=calibrate_camera.__doc__, description=calibrate_camera.__doc__
    )
    command.add_argument(
        "images", type=Path, nargs="+", metavar="PICTURE",
        help="a picture or an MCAP recording for each line, or one picture of all lines",
    )  # fmt: skip
    command.add_argument(
        "--widths", required=True, metavar="MM,MM,MM", help="the lines' widths in the order of the pictures"
    )
    command.add_argument("--tip", default="", metavar="X,Y", help="the nozzle's tip in pixels")
    command.add_argument(
        "--pitch", type=float, default=float("nan"), metavar="MM", help="distance of lines in one picture"
    )
    command.add_argument("--write", action="store_true", help="write the values into params.yaml")
    command.add_argument(
        "--out", type=Path, metavar="FILE", help="the page; default PICTURE.camera.html here"
    )
    command.set_defaults(run=calibrate_camera)
    _add_shadow(commands)
    _add_record_levels(commands)
    _add_training_print(commands)
    _add_export(commands)
    _add_replay(commands)
    nights.add(commands, render_night)
    for name, command in commands.choices.items():
        _tell(name, command)
    return parser


def main() -> None:
    arguments = parser().parse_args()
    try:
        arguments.run(arguments)
    except (ValueError, OSError, MemoryError) as error:
        print(f"beadline: {printable(' '.join(artifacts.reason(error).split()))}", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()
