"""What the pages are made of: every artifact that is there, read and
hashed; in the place of one that is not, the reason."""

import base64
import hashlib
import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from pipeline.deposition.tables import FILMED, LESSONS, LIBRARY, LINES, PRINTS, SCORES, SIGNALS, TASKS, TRIALS
from pipeline.setpoint.tables import (
    AGENT_CURVE,
    CLASSIFIED,
    CLASSIFIER_CURVE,
    DECISIONS,
    PATHS,
    RELIABILITY,
    SCOREBOARD,
)
from pipeline.store import artifacts
from pipeline.temperature import tables as schemas
from pipeline.temperature.settings import Plant
from pipeline.verdict import night
from pipeline.verdict.deposition import of_recorded_trials
from pipeline.verdict.evidence import OFF, Evidence, Table, need, or_gap, switched_off
from pipeline.verdict.settings import QUICK_LOOK, ReportRules
from pipeline.verdict.verdict import LOOPS, Missing, Verdict, read_certificates
from pipeline.verdict.verdict import read as read_verdicts

VERDICTS = "datasets/verdict"


class Declared(NamedTuple):
    """What the parameters say: the sections that figures are labelled
    with, and all of it as text for the difference."""

    rules: ReportRules
    machine: Plant
    everything: dict[str, Any]


class SourceFile(NamedTuple):
    """One file that the pages show: what it is called here (a table's name, or the stage of metrics), the
    stage that wrote it, the digest of its bytes, and where it is found from the pages."""

    name: str
    path: str
    stage: str
    sha256: str
    link: str = ""


class Sources(NamedTuple):
    """`metrics` by stage and `tables` by name, each with a Missing where it could not be read; `read`: what
    was; `absent`: what was not, by path; `accepted`: the accepted run, or None; `nightly`: what the last
    night measured, None before the first; `quick`: the run is a quick look; `stored`: its verdicts;
    `certified`: which certificates pass.
    """

    declared: Declared
    metrics: Mapping[str, dict | Missing]
    tables: Mapping[str, Table | Missing]
    read: Mapping[str, SourceFile]
    absent: Mapping[str, Missing]
    accepted: dict | Missing | None
    code: str
    nightly: dict | Missing | None = None
    quick: bool = False
    stored: Mapping[str, Verdict] = {}
    certified: Mapping[str, Any] = {}

    @property
    def evidence(self) -> Evidence:
        """What the figures of a verdict are found in."""
        declared = self.declared
        return Evidence(
            self.metrics,
            self.tables,
            declared.machine,
            declared.rules,
            declared.everything,
            self.quick,
            self.certified,
        )

    @property
    def verdicts(self) -> dict[str, Verdict]:
        """The verdict of each loop that is on, as the stage `verdict` stored it, with what the last night
        measured."""
        loops = {loop: verdict for loop, verdict in self.stored.items() if loop in LOOPS}
        return loops if self.nightly is None else night.verdicts(self.evidence, loops, self.nightly)

    @property
    def model(self) -> Verdict:
        """The verdict on the identified model."""
        return self.stored["identification"]

    def subject(self, loop: str) -> str:
        """The controller that a loop's verdict is about; "" without a verdict."""
        return self.stored[loop].subject if loop in self.stored else ""

    @property
    def recorded(self) -> bool:
        """Whether the temperature loop's record is a user's, not that of the study's machine, simulated."""
        return self.declared.everything.get("generate_probing", {}).get("source") == "recordings"

    @property
    def another_machine(self) -> bool:
        """Whether the accepted run's temperature loop is of a machine with other inputs or outputs."""
        if not isinstance(self.accepted, dict):
            return False
        plant = (self.accepted.get("params") or {}).get("plant")
        if not isinstance(plant, dict):
            return False
        machine = self.declared.machine
        return any(
            {signal.get("name") for signal in plant.get(kind) or []} != {signal.name for signal in signals}
            for kind, signals in (("inputs", machine.inputs), ("outputs", machine.outputs))
        )

    @property
    def measured(self) -> dict[str, dict]:
        """The figures of the stages that could be read."""
        return {stage: found for stage, found in self.metrics.items() if not isinstance(found, Missing)}

    def zone(self, place: int) -> str:
        """A zone by its number; of a user's machine by the name of its output."""
        return self.declared.machine.outputs[place].name if self.recorded else f"zone {place + 1}"

    def source(self, *names: str) -> list[SourceFile]:
        """Those of the files that could be read."""
        return [source for name in names for source in self.read.values() if source.name == name]


# what the nightly job writes after the pages: no dependency of theirs (DVC would ask for it before the first
# night), they show the night before
NIGHTLY = "reports/metrics/nightly.json"


def collect(
    declared: Declared,
    metrics: Mapping[str, str],
    folders: Mapping[str, str],
    accepted: str,
    code: tuple[str, ...],
    verdicts: str = VERDICTS,
) -> Sources:
    """Reads the files of figures and the folders of stages, {stage: path} each. What is missing or broken is
    no error here: its place on the page says so."""
    read: dict[str, SourceFile] = {}
    absent: dict[str, Missing] = {}
    figures: dict[str, Any] = {}
    tables: dict[str, Any] = {}
    for stage, path in metrics.items():
        figures[stage] = _read(read, path, stage, stage, artifacts.read_json)
        if switched_off(figures[stage]):
            figures[stage] = OFF
            del read[path]
        elif isinstance(figures[stage], Missing):
            absent[path] = figures[stage]
    for name, stage, file, reader in _tables(declared.machine):
        if figures.get(stage) is OFF:
            tables[name] = OFF
            continue
        path = f"{folders[stage]}/{file}"
        if name == "set_points" and not artifacts.exists(path):
            tables[name] = {}  # no set-point was recorded
            continue
        tables[name] = _read(read, path, name, stage, reader)
        if name == "printer_pid" and not tables[name]:
            del read[path]
        elif isinstance(tables[name], Missing):
            absent[path] = tables[name]
    if declared.everything["train_ilc"]["source"] == "recordings":
        tables = of_recorded_trials(figures, tables)
    # the pages show one routine, a third of all rows; the viewer shows every one
    tables["every_lesson"], tables["lessons"] = tables["lessons"], first_routine(tables["lessons"])
    for name, stage in (("frames", "train_ilc"), ("nozzle_frames", "train_classifier")):
        for frame in [] if isinstance(tables[name], Missing) else tables[name]:
            path = frame["path"]
            read[path] = SourceFile("frame", path, stage, artifacts.sha256(path))
    before = (
        _read(read, accepted, "accepted", "accept", read_accepted) if artifacts.exists(accepted) else None
    )
    night = (
        _read(read, NIGHTLY, "nightly", "nightly", artifacts.read_json) if artifacts.exists(NIGHTLY) else None
    )
    folders_of_code = digest({folder: artifacts.sha256(folder) for folder in code})
    read = linked(read)
    return Sources(
        declared, figures, tables, read, absent, before, folders_of_code, night,
        quick=artifacts.exists(QUICK_LOOK), stored=read_verdicts(verdicts, (*LOOPS, "identification")),
        certified=read_certificates(verdicts),
    )  # fmt: skip


# bytes of a file, and of all files together, that are copied beside the pages
LARGEST_COPY, LARGEST_COPIES = 4_000_000, 10_000_000


def linked(read: Mapping[str, SourceFile]) -> dict[str, SourceFile]:
    """The same with the link to each file: where it lies below reports/; else a copy in reports/data, so that
    the folder of the pages is whole by itself, where the file is small; else its place below datasets/."""
    room, taken, found = LARGEST_COPIES, set(), {}
    for path, source in read.items():
        name, size = f"{source.stage}.{Path(path).name}", Path(path).stat().st_size
        if path.startswith("reports/"):
            link = path.removeprefix("reports/")
        elif size <= min(LARGEST_COPY, room) and name not in taken:
            link, room = f"data/{name}", room - size
            taken.add(name)
        else:
            link = f"../{path}"
        found[path] = source._replace(link=link)
    return found


def copies(sources: Sources) -> dict[str, bytes]:
    """Name in reports/data -> bytes of every file that the pages link to there."""
    return {
        source.link.removeprefix("data/"): Path(path).read_bytes()
        for path, source in sources.read.items()
        if source.link.startswith("data/")
    }


def machine(path: str) -> dict[str, Any]:
    """What `run` wrote beside the pages of the machine it ran on; {} where it did not. Raises ValueError
    where the file holds another line."""
    if not artifacts.exists(path):
        return {}
    line = re.fullmatch(
        r"window\.beadline = (\{.*\});\s*", Path(path).read_text(encoding="utf-8", errors="replace")
    )
    try:
        return dict(json.loads(line[1])["machine"])
    except (TypeError, ValueError, KeyError):
        raise ValueError(
            f"{path}: expected the line that ./run writes, found another; run ./run dvc repro, "
            "which writes it anew"
        ) from None


def digest(data: Any) -> str:
    """SHA-256 of the canonical JSON of plain data."""
    return hashlib.sha256(json.dumps(data, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def _tables(machine: Plant) -> list[tuple[str, str, str, Callable[[str], Any]]]:
    """(name, stage, file, reader) of every table that the pages show."""

    def table(schema: schemas.Schema) -> Callable[[str], Table]:
        return lambda path: artifacts.read_table(path, schema)

    def arrays(path: str) -> Table:
        return artifacts.read_arrays(path, "plant", 1)

    return [
        ("record", "ingest", "record.parquet", table(schemas.record(machine.acting, machine.outputs))),
        ("set_points", "ingest", "set_points.parquet", table(schemas.set_points(machine.outputs))),
        ("quality", "ingest", "quality.parquet", table(schemas.QUALITY)),
        ("printer_pid", "ingest", "printer_pid.json", artifacts.read_json),
        ("plant", "identify_plant", "plant.parquet", arrays),
        ("order", "identify_plant", "order.parquet", table(schemas.ORDER)),
        ("holdout", "identify_plant", "holdout.parquet", table(schemas.holdout(machine.outputs))),
        ("residuals", "identify_plant", "residuals.parquet", table(schemas.RESIDUALS)),
        ("steps", "identify_plant", "steps.parquet", table(schemas.STEPS)),
        ("dynamics", "identify_plant", "dynamics.parquet", table(schemas.DYNAMICS)),
        ("first_order", "identify_plant", "first_order.parquet", table(schemas.FIRST_ORDER)),
        ("poles", "identify_plant", "poles.parquet", table(schemas.POLES)),
        ("levels", "identify_plant", "levels.parquet", table(schemas.LEVELS)),
        ("weights", "tune_weights", "weights.json", artifacts.read_json),
        ("tuning", "tune_weights", "history.parquet", table(schemas.TUNING)),
        ("cases", "evaluate_temperature", "cases.parquet", table(schemas.CASES)),
        (
            "trajectories",
            "evaluate_temperature",
            "trajectories.parquet",
            table(schemas.trajectories(machine.inputs, machine.outputs)),
        ),
        ("trials", "train_ilc", "trials.parquet", table(TRIALS)),
        ("lessons", "train_ilc", "lessons.parquet", table(LESSONS)),
        ("filmed", "train_ilc", "filmed.parquet", table(FILMED)),
        ("models", "train_ilc", "models.json", artifacts.read_json),
        ("frames", "train_ilc", "frames/frames.json", _frames),
        ("library", "segment_library", "library.parquet", table(LIBRARY)),
        ("learned", "segment_library", "learned.json", artifacts.read_json),
        ("signals", "compose_parts", "signals.parquet", table(SIGNALS)),
        ("scores", "compose_parts", "scores.parquet", table(SCORES)),
        ("prints", "compose_parts", "prints.parquet", table(PRINTS)),
        ("tasks", "compose_parts", "tasks.parquet", table(TASKS)),
        ("lines", "compose_parts", "lines.parquet", table(LINES)),
        ("conformance", "compose_parts", "conformance.json", artifacts.read_json),
        ("classified", "train_classifier", "classified.parquet", table(CLASSIFIED)),
        ("reliability", "train_classifier", "reliability.parquet", table(RELIABILITY)),
        ("course", "train_classifier", "course.parquet", table(CLASSIFIER_CURVE)),
        ("nozzle_frames", "train_classifier", "frames/frames.json", _frames),
        ("agents", "train_agent", "agents.parquet", table(AGENT_CURVE)),
        ("scoreboard", "evaluate_setpoint", "scoreboard.parquet", table(SCOREBOARD)),
        ("paths", "evaluate_setpoint", "paths.parquet", table(PATHS)),
        ("decisions", "evaluate_setpoint", "decisions.parquet", table(DECISIONS)),
        ("choice", "evaluate_setpoint", "choice.json", artifacts.read_json),
        ("certificate", "export_controllers", "temperature/certificate.json", artifacts.read_json),
    ]


@or_gap
def first_routine(table: Table | Missing) -> Table | Missing:
    """The rows of each material's first recorded routine, the reference if that is recorded."""
    table = need(table)
    if not len(table["routine"]):
        return Missing("not measured", "no trial is recorded yet")
    first = pd.Series(table["routine"]).groupby(np.asarray(table["material"])).transform("min")
    rows = table["routine"] == first.to_numpy()
    return {name: values[rows] for name, values in table.items()}


# frames that a page has room for
FRAMES = 24


def _frames(path: str) -> list[dict[str, Any]]:
    """The first rows of an index of frames, each with its picture's path and the picture as a data URI.
    Raises ValueError where one is missing or no JPEG."""
    frames, stage = artifacts.read_json(path)[:FRAMES], Path(path).parent.parent.name
    for frame in frames:
        picture = Path(path).with_name(Path(frame["file"]).name)
        try:
            data = picture.read_bytes()
        except OSError as error:
            raise ValueError(
                f"{picture} cannot be read ({error.strerror}); run ./run dvc repro {stage}"
            ) from None
        if not data.startswith(b"\xff\xd8"):
            raise ValueError(f"{picture} is no JPEG; run ./run dvc repro {stage}")
        frame |= {
            "path": picture.as_posix(),
            "uri": "data:image/jpeg;base64," + base64.b64encode(data).decode(),
        }
    return frames


def _read(read: dict[str, SourceFile], path: str, name: str, stage: str, reader: Callable[[str], Any]) -> Any:
    if not artifacts.exists(path):
        kept = Path(path).parts[1] == "papers"
        remedy = "git checkout datasets/papers" if kept else f"./run dvc repro {stage}"
        return Missing("not measured", f"{Path(path).name} of {stage} is not there", f"Run {remedy}")
    try:
        content = reader(path)
    except ValueError as error:
        return Missing("failed", str(error))
    read[path] = SourceFile(name, path, stage, artifacts.sha256(path))
    return content


# what `./run beadline accept` writes
OF_ACCEPTED = ("accepted", "machine", "metrics", "params", "hashes", "figures", "winner")


def read_accepted(path: str) -> dict:
    """The accepted run. Raises ValueError if another version of beadline wrote it."""
    run = artifacts.read_json(path)
    if not isinstance(run, dict) or not run.keys() >= set(OF_ACCEPTED):
        raise ValueError(
            f"{path} was written by another version of beadline; "
            "accept a run of this version with ./run beadline accept"
        )
    return run
