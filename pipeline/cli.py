"""`./run beadline COMMAND`: what is not a stage."""

import argparse
import datetime
import difflib
import importlib.metadata
import json
import os
import re
import subprocess
import sys
import textwrap
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

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
    """The figures of this run become the reference: later reports show their differences against them."""
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
    """The day, and the commit that is checked out; "none" if there is none."""
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


def runs(arguments: argparse.Namespace) -> None:
    """A page of two runs side by side: figures with bands, and parameters that differ. A and B are commits,
    tags, branches or DVC experiments whose metrics git has."""
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
    """The signals of a recording with units, rates, gaps and ranges, its damage, and a mapping to paste into
    params.yaml."""
    from pipeline.commands.inspection_json import as_json
    from pipeline.recordings.inspection import inspect as describe
    from pipeline.recordings.isolated import Budget, isolated
    from pipeline.recordings.plain_files import check_plain_file

    declared = params.load(Ingest, "ingest", _settings_file())
    check_plain_file(arguments.file)
    budget = Budget(declared.longest_s, declared.largest_mb)
    form = as_json if arguments.json else describe
    print(printable(isolated(form, arguments.file, shown=arguments.file, budget=budget)))


def _settings_file() -> Path:
    """The parameters of this folder, or those beside the code: some commands need no project."""
    return Path(params.FILE) if Path(params.FILE).exists() else Path(__file__).parents[1] / params.FILE


def quick(_: argparse.Namespace) -> None:
    """Every loop at the sizes of params.quick.yaml, with a classifier that git keeps. The pages go to quick/;
    datasets/, reports/ and dvc.lock stay as they are."""
    from pipeline import quick as looking

    print(printable(looking.quick()))


def init(arguments: argparse.Namespace) -> None:
    """Mapping, signals, limits, test set and rules that fit the pace of the recorded machine, and the loops
    that the recordings serve. It prints what a person must still decide."""
    from pipeline.commands import propose_params

    initialised = propose_params.proposed(arguments.recordings, sample_time=arguments.time)
    values = propose_params.loops_to_run(["temperature"]) | initialised.values
    dry_run = arguments.dry_run
    changed, edited = propose_params.write(values, force=arguments.force, dry_run=dry_run)
    copied = arguments.copy and not dry_run
    if copied:
        propose_params.copy(arguments.recordings)
    initialised = initialised._replace(values=values)
    if dry_run and changed:
        print("dry run: nothing is written; what would be:")
    print(propose_params.summary(initialised, changed, edited, arguments.recordings, arguments.copy))


def temperature_experiment(arguments: argparse.Namespace) -> None:
    """An experiment for a machine without a good recording: G-code of targets if the temperatures come from
    Klipper, else a staircase of inputs with the temperatures at which to stop. No model stands behind it."""
    from pipeline.commands import first_experiment as first
    from pipeline.temperature.settings import check_output_limits

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


def setpoint_experiment(arguments: argparse.Namespace) -> None:
    """The G-code of a print from which the classifier learns: one layer for each flow and temperature, with a
    layer at 100 % and the material's best temperature between. A table beside it says which lines have which
    setting, and has the tip of params.yaml."""
    from pipeline.commands import training_print as printing
    from pipeline.setpoint.settings import SetpointMaterial, TrainClassifier

    best = params.load(SetpointMaterial, "setpoint_material", _settings_file()).best_temperature_degC
    tip_px = params.load(TrainClassifier, "train_classifier", _settings_file()).tip_px
    print(printing.write(printing.read(vars(arguments), best), arguments.out, tip_px))


def compose(arguments: argparse.Namespace) -> None:
    """The plunger command of a part program, its tasks and lines as Parquet, and a forecast, line by line, of
    whether it will print."""
    from pipeline.commands import compose as command
    from pipeline.deposition.parts.part_report import summary_lines
    from pipeline.deposition.settings import ComposeParts, Printer
    from stages.compose_parts import compose_part

    if arguments.out.exists() and not arguments.out.is_dir():
        raise ValueError(
            f"--out {arguments.out}: should be a folder but is a file; name a folder, "
            "which is made if it is missing"
        )
    request = command.request(
        filament_mm=arguments.filament_mm, extruder=arguments.extruder, bead=arguments.bead
    )
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
    """A page with a picture of the nozzle's camera. A click on it gives the tip. With --tip it shows what the
    front end sees, or why it rejects the picture."""
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
    out = Path(f"{arguments.image.stem}.tip.html")
    print(calibrate(arguments.image, out, arguments.tip, least_score=least_score, topic=topic))


def calibrate_camera(arguments: argparse.Namespace) -> None:
    """Section camera of params.yaml from pictures of printed lines of known widths: size of a pixel,
    rotation, measured columns and edge bias; and a page."""
    from pipeline.commands import calibrate_camera as camera

    request = camera.CalibrationRequest(
        arguments.images,
        camera.numbers(arguments.widths, "--widths", "0.5,0.9,1.3"),
        camera.pixel(arguments.tip),
        arguments.pitch,
    )
    out = Path(f"{arguments.images[0].stem}.camera.html")
    print(camera.calibrate(request, out, write=arguments.write))


def shadow(arguments: argparse.Namespace) -> None:
    """What the default controller would do in each window of frames, and why, as MCAP and as a page on this
    machine. Nothing is sent."""
    from pipeline.commands.shadow import deploy

    _watch(arguments, deploy.ready(""))


def _watch(arguments: argparse.Namespace, ready: "Ready", *, in_json: bool = False) -> None:
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
    if not in_json:
        print(f"{place}: {verdict(ready.deployed.proof)}", flush=True)
        print(f"{place}: open {arguments.out / 'index.html'}; Ctrl-C ends the watch", flush=True)
    with watching.until_told() as stopped:
        watched = watching.watch(frames, ready.deployed, asked, arguments.out, place=place, stopped=stopped)
    if watched.unreadable:
        raise ValueError(f"{place}: none of {watched.frames} frames can be read: {watched.unreadable}")
    print(json.dumps(watched._asdict(), default=str) if in_json else watching.summary_lines(watched, place))


def calibrate_levels(arguments: argparse.Namespace) -> None:
    """The correction of the classifier for another camera, from flows that were held for a minute each, and a
    page. `shadow` uses it from then on."""
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
    hold_s = deploy.bounded("--hold", arguments.hold)
    protocol = levels.Protocol(
        numbers(arguments.flows, "--flows"),
        hold_s,
        levels.SETTLES * hold_s,
        material.best_temperature_degC,
        deploy.pixel(arguments.tip) if arguments.tip else options.tip_px,
    )
    place = arguments.source
    source = levels.source_of(place, lambda path: RecordingSource(path, options.topics))
    levels_eye = levels.Eye(
        partial(read_frames, eye.model), partial(window_flow, fitted=fitted.flow), eye.view.window,
        eye.view.least_score, eye.digest, eye.view.false_alarms, material,
    )  # fmt: skip
    recorded, told = levels.record(source, protocol, levels_eye, place=str(place))
    print(levels.write(recorded, told, Path("datasets/levels/levels.parquet"), str(place), material))


def export(arguments: argparse.Namespace) -> None:
    """A certified controller as C99 without heap, as one file of Python, or as a module for Klipper and
    Kalico. The camera loop is exported as weights with readers that need NumPy alone."""
    from pipeline.commands.export import export as write

    print(write(arguments.controller, arguments.to, arguments.out))


def replay(arguments: argparse.Namespace) -> None:
    """What a certified controller would request on a recording, and why it would not, as MCAP with a layout
    for Foxglove and as a page. Frames of the nozzle camera go through the loop of `shadow`. Nothing is
    sent."""
    from pipeline.commands import export as exports

    if exports.shows_frames(arguments.controller):
        from pipeline.commands import replay_camera

        recorded = {"source": str(arguments.recording), "rate": 5.0, "once": True}
        unrecorded = {"flow": 100.0, "temperature": None, "tip": ""}
        _watch(
            argparse.Namespace(**vars(arguments) | recorded | unrecorded),
            replay_camera.ready(arguments.controller),
            in_json=arguments.json,
        )
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
    if arguments.json:
        print(json.dumps(told))
        return
    print(f"{arguments.recording}: {told['samples']} samples. {page.decision(told)}")
    print(f"written: {arguments.out}/index.html, replay.mcap, layout.json, replay.json")


def nightly(arguments: argparse.Namespace) -> None:
    """New recordings, dvc repro, comparison with production, then promote or keep: see reports/nightly.html.
    A loop that fails keeps its controller; the others are judged."""
    from pipeline.nightly import commands

    status, sentence = commands.run(arguments, render_night)
    print(printable(sentence), file=sys.stderr if status else sys.stdout)
    sys.exit(status)


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


# ---- the commands with their options

# group in --help -> command -> its line there
GROUPS = {
    "Start": {
        "quick": "Make a first report from bundled data in minutes",
        "init": "Write params.yaml for the recordings of a machine",
    },
    "Data": {
        "inspect": "List signals, rates and damage of a recording",
        "experiment": "Write an experiment or a training print to record",
    },
    "Parts": {"compose": "Compute the command that prints a part, with a forecast"},
    "Camera": {
        "calibrate": "Calibrate a camera: nozzle tip, line widths or flow",
        "shadow": "Watch a nozzle camera and show each decision",
    },
    "Deploy": {
        "export": "Write a certified controller as C, Python or for Klipper",
        "replay": "Show what a controller would request on a recording",
    },
    "Runs": {
        "accept": "Make this run the reference of later reports",
        "runs": "Compare two runs on one page",
        "nightly": "Learn from new recordings and promote what is better",
    },
}
# command within a command -> its line there
WITHIN = {
    "experiment temperature": "Write an experiment for a machine without a recording",
    "experiment setpoint": "Write a print that trains the nozzle camera",
    "calibrate tip": "Show a picture on which a click gives the nozzle tip",
    "calibrate camera": "Measure pixels and edges on lines of known widths",
    "calibrate levels": "Correct the flow that another camera shows",
}
# exit status -> meaning and what to do
STATUSES = {
    0: ("done", "nothing"),
    1: ("refused; one sentence says why", "follow the sentence"),
    2: ("wrong command or option", "see --help"),
}
NIGHTLY_STATUSES = {
    0: ("promoted, kept, candidate stored, or nothing new", "nothing"),
    1: ("the run, the push, or the stages of one loop failed", "read the summary or reports/nightly.html"),
    2: STATUSES[2],
    3: ("drift alarm", "look at the machine; that loop is not promoted while the alarm lasts"),
    4: ("done, but recordings were set aside", "repair them in datasets/quarantine and put them back"),
    75: ("another nightly run is at work", "wait for it"),
}


class Command(NamedTuple):
    """A command: what it runs, an example of what stands behind its name, its arguments as `argument` returns
    them, and its exit statuses."""

    run: Callable[[argparse.Namespace], None]
    example: str
    arguments: tuple[tuple[tuple[str, ...], dict[str, Any]], ...] = ()
    statuses: dict[int, tuple[str, str]] = STATUSES


def argument(*names: str, **settings: Any) -> tuple[tuple[str, ...], dict[str, Any]]:
    """What `ArgumentParser.add_argument` takes."""
    return names, settings


TIP = argument("--tip", default="", metavar="X,Y", help="nozzle tip in pixels of the pictures")
CONTROLLER = argument("controller", type=Path, metavar="CONTROLLER", help="folder of export_controllers")
JSON = argument("--json", action="store_true", help="print JSON")
COMMANDS = {
    "quick": Command(quick, ""),
    "init": Command(
        init,
        "log.csv --copy",
        (
            argument(
                "recordings", type=Path, nargs="+", metavar="RECORDING", help="CSV, MCAP, klippy.log, ..."
            ),
            argument("--copy", action="store_true", help="copy them into datasets/raw/temperature"),
            argument("--force", action="store_true", help="overwrite values that were edited"),
            argument(
                "--time", default="", metavar="'every 0.08 s'", help="sample time if the files have none"
            ),
            argument("--dry-run", action="store_true", help="write nothing; print what would be written"),
        ),
    ),
    "inspect": Command(inspect, "log.csv", (argument("file", type=Path, help="a recording"), JSON)),
    "experiment temperature": Command(
        temperature_experiment,
        "--hold 200",
        (
            argument("--minutes", type=float, default=60.0, help="length of the G-code"),
            argument("--ramp", type=float, default=0.0, help="°C a minute of the targets; 0: no limit"),
            argument("--hold", type=float, default=300.0, help="longest step of the inputs in seconds"),
            argument(
                "--out", type=Path, default=Path("first_experiment.csv"), metavar="FILE", help="the file"
            ),
        ),
    ),
    "experiment setpoint": Command(
        setpoint_experiment,
        "training.gcode",
        (
            argument(
                "out", type=Path, metavar="OUT.gcode", help="the G-code; the table is written beside it"
            ),
            argument("--flows", default="40,60,75,85,92,100,108,115,125,150,200", help="flows in %%"),
            argument("--temperatures", default="190,200,210,220,230", help="nozzle temperatures in °C"),
            argument("--bed", default="220,220,250", metavar="MM,MM,MM", help="room along x, y and z"),
            argument("--nozzle", default="0.4", metavar="MM", help="its diameter; layers are half as high"),
            argument("--filament", default="1.75", metavar="MM", help="its diameter"),
            argument("--bed-temperature", default="60", metavar="DEGC", help="of the bed"),
            argument(
                "--melt", default="12", metavar="MM3/S", help="most that the hot end melts; limits speed"
            ),
        ),
    ),
    "compose": Command(
        compose,
        "part.gcode --as csv,gcode --out jobs",
        (
            argument("part", type=Path, help="the part program (G-code)"),
            argument("--out", type=Path, default=Path("."), help="folder for signal, tasks and report"),
            argument(
                "--as",
                dest="formats",
                default="csv",
                metavar="csv,parquet,mcap,gcode",
                help="formats; gcode is for machines that play no signal",
            ),
            argument(
                "--filament-mm", type=float, metavar="MM", help="diameter of what E pushes, if not stated"
            ),
            argument("--extruder", default="", metavar="WORD", help="what extrudes: E, U, 'M42 P4', ..."),
            argument(
                "--bead", choices=("e", "declared"), default="e", help="volume of a line by E or as declared"
            ),
            argument(
                "--verify", action="store_true", help="also write the shortest print that tests the forecast"
            ),
        ),
    ),
    "calibrate tip": Command(
        calibrate_tip,
        "frame.png --tip 320,240",
        (argument("image", type=Path, help="a picture of the nozzle's camera"), TIP),
    ),
    "calibrate camera": Command(
        calibrate_camera,
        "lines.png --widths 0.4,0.6,0.8 --pitch 3",
        (
            argument(
                "images", type=Path, nargs="+", metavar="PICTURE", help="one for each line, or one of all"
            ),
            argument("--widths", required=True, metavar="MM,MM,MM", help="of the lines, in their order"),
            TIP,
            argument(
                "--pitch", type=float, default=float("nan"), metavar="MM", help="between lines of one picture"
            ),
            argument("--write", action="store_true", help="write the values into params.yaml"),
        ),
    ),
    "calibrate levels": Command(
        calibrate_levels,
        "frames --flows 60,80,100,125,160",
        (
            argument("source", type=Path, metavar="FOLDER|MCAP", help="pictures of the held flows"),
            argument("--flows", default="60,80,100,125,160", metavar="PERCENT,...", help="in their order"),
            argument(
                "--hold",
                type=float,
                default=60.0,
                metavar="S",
                help="how long each was held; its first sixth is left out",
            ),
            TIP,
        ),
    ),
    "shadow": Command(
        shadow,
        "frames --once",
        (
            argument("source", help="folder that fills, growing MCAP file, or snapshot's address"),
            argument(
                "--out", type=Path, default=Path("shadow"), metavar="DIR", help="for page and decisions"
            ),
            TIP,
            argument("--flow", type=float, default=100.0, help="flow setpoint in %% if the frames have none"),
            argument(
                "--temperature",
                type=float,
                metavar="DEGC",
                help="nozzle if the frames have none, else the best of params.yaml",
            ),
            argument("--rate", type=float, default=5.0, metavar="HZ", help="snapshots a second"),
            argument("--once", action="store_true", help="end when the source ends"),
        ),
    ),
    "export": Command(
        export,
        "datasets/export_controllers/temperature --to c",
        (
            CONTROLLER,
            argument("--to", required=True, choices=("c", "python", "klipper"), help="the form"),
            argument("--out", type=Path, metavar="DIR", help="the folder, else CONTROLLER/FORM"),
        ),
    ),
    "replay": Command(
        replay,
        "datasets/export_controllers/temperature log.csv",
        (
            CONTROLLER,
            argument(
                "recording", type=Path, metavar="RECORDING", help="a log, or a folder or MCAP of frames"
            ),
            argument("--out", type=Path, default=Path("replay"), metavar="DIR", help="for page and signals"),
            argument("--reference", default="", metavar="DEGC,...", help="of each output, if not recorded"),
            JSON,
        ),
    ),
    "accept": Command(accept, ""),
    "runs": Command(
        runs,
        "HEAD~1 HEAD",
        (
            argument("a", metavar="A", help="the earlier run"),
            argument("b", metavar="B", help="the later run"),
        ),
    ),
    "nightly": Command(
        nightly,
        "--dry-run",
        (
            argument("--watch", action="store_true", help="only check that the last success is recent"),
            argument(
                "--rollback",
                nargs="?",
                const="",
                metavar="LOOP/RUN",
                help="back to the controllers of RUN, else to the one before",
            ),
            argument(
                "--accept-drift", nargs=2, metavar=("LOOP", "WHY"), help="take the drift of LOOP as intended"
            ),
            argument("--dry-run", action="store_true", help="change nothing; print what would be done"),
        ),
        NIGHTLY_STATUSES,
    ),
}


class Help(argparse.RawDescriptionHelpFormatter):
    """Help that shows defaults and keeps the lines of examples."""

    def _get_help_string(self, action: argparse.Action) -> str:
        default = action.default
        shown = (
            action.option_strings and default is not argparse.SUPPRESS and default not in (None, "", False)
        )
        return (
            f"{action.help or ''} (default: %(default)s)"
            if shown and default == default
            else action.help or ""
        )


class Parser(argparse.ArgumentParser):
    """A parser that says which command or option is closest to a mistyped one."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(formatter_class=Help, **settings)

    def error(self, message: str) -> NoReturn:
        """Ends the process with status 2."""
        if typed := re.search(r"invalid choice: '([^']*)'|unrecognized arguments: (\S+)", message):
            names = list(choices(self))
            for word in sys.argv[1:]:
                names += choices(self).get(word, self)._option_string_actions
            nearest = difflib.get_close_matches(typed[1] or typed[2].partition("=")[0], names, 1)
            message += f"; did you mean {nearest[0]}?" if nearest else ""
        super().error(message)


def choices(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """The commands of a parser by their names, those within a command too."""
    actions = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    inner = {name: command for action in actions for name, command in action.choices.items()}
    return inner | {name: one for command in inner.values() for name, one in choices(command).items()}


def parser() -> argparse.ArgumentParser:
    """Every command with its options."""
    lines = [
        f"{group}:\n" + "\n".join(f"  {name:<12}{line}" for name, line in commands.items())
        for group, commands in GROUPS.items()
    ]
    parser = Parser(
        prog="beadline",
        usage="beadline COMMAND ...",
        description="Turn recordings of an extrusion printer into controllers.\n\n" + "\n\n".join(lines),
        epilog="beadline COMMAND --help shows the options of a command, an example and its exit statuses.",
    )
    parser.add_argument("--version", action="version", version=f"beadline {version()}")
    commands = parser.add_subparsers(
        required=True, metavar="COMMAND", prog="beadline", help=argparse.SUPPRESS
    )
    within = {}
    for name in [name for commands in GROUPS.values() for name in commands]:
        parts = [part for part in COMMANDS if part.split()[0] == name]
        if parts != [name]:
            command = commands.add_parser(name, description=f"{_line(name)}.", epilog=_ending(parts[0]))
            within[name] = command.add_subparsers(required=True, metavar="WHAT")
        for part in parts:
            inner = within.get(name, commands)
            about = " ".join(str(COMMANDS[part].run.__doc__).split()).replace("%", "%%")
            command = inner.add_parser(
                part.split()[-1],
                help=_line(part),
                description=f"{_line(part)}.\n\n{textwrap.fill(about, 78)}",
                epilog=_ending(part),
            )
            for names, settings in COMMANDS[part].arguments:
                command.add_argument(*names, **settings)
            command.set_defaults(run=COMMANDS[part].run)
    return parser


def _line(name: str) -> str:
    return next(lines[name] for lines in (*GROUPS.values(), WITHIN) if name in lines)


def _ending(name: str) -> str:
    """Behind a command's options: an example and the exit statuses."""
    statuses = "\n".join(f"  {code:<4}{meaning}" for code, (meaning, _) in COMMANDS[name].statuses.items())
    example = f"./run beadline {name} {COMMANDS[name].example}".rstrip()
    return f"Example: {example}\n\nExit status:\n{statuses}"


def main() -> None:
    arguments = parser().parse_args()
    try:
        arguments.run(arguments)
        sys.stdout.flush()
    except BrokenPipeError:  # who reads our output has gone; Python would complain once more at its end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(CLOSED_PIPE)
    except (ValueError, OSError, MemoryError) as error:
        print(f"beadline: {printable(' '.join(artifacts.reason(error).split()))}", file=sys.stderr)
        sys.exit(1)


# as of a process that SIGPIPE ends
CLOSED_PIPE = 141


if __name__ == "__main__":
    main()
