"""Accepted runs, nights, DVC experiments and other revisions of the figures -> one list of runs, each with
its figures, its parameters, and where its artifacts are."""

import datetime
import functools
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from pipeline.report.runs import history, stored
from pipeline.report.runs.figures import FILES, Column, Measured, measured, today
from pipeline.report.runs.stored import ACCEPTED, METRICS, NIGHTLY, Commit
from pipeline.report.shared.digits import shortened
from pipeline.store import artifacts, params, renamed

KINDS = ("accepted", "night", "experiment", "revision", "files")
NIGHTS = Path(".beadline/nights.json")
LOCK = "dvc.lock"
PARAMETERS = (params.FILE, params.EXPERT)
# of one run; a file with more holds no parameters of ours
MOST_PARAMETERS, LONGEST_VALUE = 5000, 120


class Run(NamedTuple):
    """One run. Its kind: accepted, night, experiment, revision (committed, and nobody accepted it), files
    (not committed). `name` is a night's or an experiment's. {dotted key: value in words} of its parameters,
    or why there are none in `no_parameters`. `lock` is its dvc.lock; `base` the commit that an experiment
    began from. `note`: how a night ended."""

    kind: str
    name: str
    commit: str
    date: str
    subject: str
    measured: Measured
    parameters: Mapping[str, str] = {}
    no_parameters: str = ""
    lock: str = ""
    base: str = ""
    note: str = ""


class Collected(NamedTuple):
    """Runs, the oldest first, and a sentence for each thing that could not be read."""

    runs: list[Run]
    troubles: list[str]


class _Read(NamedTuple):
    """Files of runs: {REVISION:PATH: object}, and each object's text."""

    objects: Mapping[str, str]
    texts: Mapping[str, bytes]

    def text(self, place: str) -> bytes | None:
        """None where the file is not there."""
        name = self.objects.get(place, "")
        return self.texts.get(name) if name else None


def collected(most: int, asked: Sequence[Column]) -> Collected:
    """At most `most` runs, the newest of them. Raises ValueError without git, and where there is no run."""
    revisions, tried = stored.commits(most, METRICS, ACCEPTED), stored.experiments(most)
    if not revisions:
        raise ValueError(
            f"{METRICS}: git has no revision of it; commit the figures of a run first (git add {METRICS})"
        )
    commits = sorted([*revisions, *tried], key=lambda commit: commit.date)[-most:]
    known = _Memory(asked)
    last = revisions[-1]
    read = _read([*commits, last], known.stages)
    runs = [_run(commit, read, known) for commit in commits]
    now = _now(known)
    # an experiment leaves the files as they are
    if now.measured.figures and now.measured.figures != _run(last, read, known).measured.figures:
        runs.append(now)
    nights, troubles = _nights({run.name for run in runs if run.kind == "night"} | _said(runs), asked)
    runs = sorted([*runs, *nights], key=lambda run: (not run.date, _instant(run.date)))
    return Collected(runs[-most:], troubles)


def _said(runs: Sequence[Run]) -> set[str]:
    return {match[0] for run in runs if (match := re.match(r"night-\d+", run.name))}


def _instant(date: str) -> str:
    """Dates of one zone in the order of time; git writes each author's own."""
    try:
        return datetime.datetime.fromisoformat(date).astimezone(datetime.UTC).isoformat()
    except ValueError:
        return ""


def _read(commits: Sequence[Commit], stages: Sequence[str]) -> _Read:
    paths = [f"{METRICS}/{name}.json" for name in stages]
    places = [f"{commit.hash}:{path}" for commit in commits for path in (*paths, NIGHTLY, *PARAMETERS, LOCK)]
    places += [f"{commit.base}:{LOCK}" for commit in commits if commit.base]
    objects = stored.objects(places)
    return _Read(dict(zip(places, objects, strict=True)), dict(stored.contents(objects)))


# ---- one run


class _Memory:
    """What is parsed once though many runs share it: figures by their files, parameters by theirs."""

    def __init__(self, asked: Sequence[Column]):
        self.asked = asked
        self.stages = tuple(dict.fromkeys([*FILES, *(column.stage for column in asked)]))
        self.measured: dict[Any, Measured] = {}
        self.parameters: dict[Any, tuple[Mapping[str, str], str]] = {}


def _run(commit: Commit, read: _Read, known: _Memory) -> Run:
    stale = _stale(read.text(f"{commit.base}:{LOCK}"), read.text(f"{commit.hash}:{LOCK}"))
    objects = tuple(read.objects[f"{commit.hash}:{METRICS}/{name}.json"] for name in known.stages)
    texts = {name: read.texts.get(key) for name, key in zip(known.stages, objects, strict=True)}
    key = (objects, tuple(stale.items()))
    if key not in known.measured:
        known.measured[key] = _measured(texts, stale if commit.base else {}, known.asked)
    files = tuple(read.objects[f"{commit.hash}:{path}"] for path in PARAMETERS)
    if files not in known.parameters:
        known.parameters[files] = parameters([read.text(f"{commit.hash}:{path}") for path in PARAMETERS])
    night = history.plain(read.text(f"{commit.hash}:{NIGHTLY}") or b"") if NIGHTLY in commit.changed else {}
    kind = (
        "experiment" if commit.base
        else "accepted" if ACCEPTED in commit.changed
        else "night" if night
        else "revision"
    )  # fmt: skip
    return Run(
        kind,
        commit.name or str(night.get("run") or ""),
        commit.hash,
        commit.date,
        commit.subject,
        known.measured[key],
        *known.parameters[files],
        lock=(read.text(f"{commit.hash}:{LOCK}") or b"").decode(errors="replace"),
        base=commit.base,
        note=str(night.get("decision") or ""),
    )


def _measured(
    texts: Mapping[str, bytes | None], stale: Mapping[str, str], asked: Sequence[Column]
) -> Measured:
    """The figures of {stage: its file}, and why others are not there."""
    gone, files = {}, {}
    for name, text in texts.items():
        files[name] = {} if text is None or name in stale else history.plain(text)
        if name in stale:
            gone[name] = f"{name} was not run again after {stale[name]} changed"
        elif text is None:
            gone[name] = f"there is no {name}.json"
        elif not files[name]:
            gone[name] = f"{name}.json is empty, or damaged"
    return measured(today(files), gone, asked)


def _now(known: _Memory) -> Run:
    """The files as they lie there."""
    texts = {name: _bytes(Path(f"{METRICS}/{name}.json")) for name in known.stages}
    found, why = parameters([_bytes(Path(path)) for path in PARAMETERS])
    lock = (_bytes(Path(LOCK)) or b"").decode(errors="replace")
    return Run("files", "", "", "", "not committed", _measured(texts, {}, known.asked), found, why, lock)


def _bytes(path: Path) -> bytes | None:
    try:
        return path.read_bytes() if path.stat().st_size <= stored.LARGEST else None
    except OSError:
        return None


def _nights(told: set[str], asked: Sequence[Column]) -> tuple[list[Run], list[str]]:
    """Nights that this checkout remembers and git does not have: they failed, or kept what was there."""
    if not NIGHTS.exists():
        return [], []
    try:
        rows = artifacts.read_json(NIGHTS)
    except (ValueError, OSError) as error:
        return [], [f"Nights without a commit are left out: {' '.join(str(error).split())}."]
    runs = []
    for row in rows if isinstance(rows, list) else []:
        name, date = (
            (str(row.get(key) or "") for key in ("run", "when")) if isinstance(row, dict) else ("", "")
        )
        if not name or name in told or not _instant(date):
            continue
        outcome, reasons = str(row.get("outcome") or "ended"), row.get("reasons")
        said = "; ".join(map(str, reasons)) if isinstance(reasons, list) else ""
        missing = {column.key: f"this night ended as {outcome}, and committed no figures" for column in asked}
        gap = "this night committed no parameters"
        runs.append(
            Run("night", name, "", date, said, Measured({}, missing, {}, {}), no_parameters=gap, note=outcome)
        )
    damaged = not isinstance(rows, list)
    return runs, [f"Nights without a commit are left out: {NIGHTS} is no list."] if damaged else []


# ---- parameters


def parameters(texts: Sequence[bytes | None]) -> tuple[Mapping[str, str], str]:
    """{dotted key of today: value} of the text of both files of parameters, and why there are none."""
    if texts[0] is None:
        return {}, f"there is no {PARAMETERS[0]}"
    found: dict[str, str] = {}
    for path, text in zip(PARAMETERS, texts, strict=True):
        try:
            found |= _flat_text((text or b"").decode())
        except (ValueError, yaml.YAMLError, RecursionError):
            return {}, f"{path} cannot be read"
        if len(found) > MOST_PARAMETERS:
            return {}, f"{path} has more than {MOST_PARAMETERS} values"
    return found, ""


def _flat_text(text: str) -> dict[str, str]:
    """A file of sections. Each is parsed once, however many runs have it."""
    sections = stored.blocks(text)
    try:
        parts = [_flat_section(block) for block in sections.values()]
    except (ValueError, yaml.YAMLError):  # an alias of another section
        parts = [_flat_section(text)]
    return {key: value for part in parts for key, value in part.items()}


@functools.lru_cache(maxsize=5000)
def _flat_section(text: str) -> Mapping[str, str]:
    data = yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    if not isinstance(data, dict):
        raise ValueError("no section")
    found: dict[str, str] = {}
    _flatten("", data, found)
    today = {key: _new_name(key) for key in found}
    return {name: found[key] for key, name in today.items() if name not in renamed.RETIRED}


@functools.lru_cache(maxsize=20000)
def _new_name(key: str) -> str:
    return renamed.new_name(key, renamed.PARAMETERS)


def _flatten(place: str, data: Any, found: dict[str, str]) -> None:
    if len(found) > MOST_PARAMETERS:
        return
    if isinstance(data, Mapping) and data:
        for key, value in data.items():
            _flatten(f"{place}.{key}" if place else str(key), value, found)
    elif isinstance(data, list) and any(isinstance(item, Mapping | list) for item in data):
        for index, value in enumerate(data):
            _flatten(f"{place}[{index}]", value, found)
    else:
        text = data if isinstance(data, str) else json.dumps(data, ensure_ascii=False, default=str)
        found[place] = shortened(" ".join(text.split()), LONGEST_VALUE)


# ---- what an experiment did not run again


def _stale(base: bytes | None, own: bytes | None) -> dict[str, str]:
    """{stage whose figures are the base's, though what it reads changed: the stage that changed}, off the
    dvc.lock of an experiment and of the commit that it began from. DVC runs no stage behind the target."""
    if base is None or own is None or base == own:
        return {}
    before, now = (stages(text.decode(errors="replace")) for text in (base, own))
    made = {stage: _places(block, "outs") for stage, block in now.items()}
    changed = {stage: stage for stage, block in now.items() if block != before.get(stage)}
    stale: dict[str, str] = {}
    left = [stage for stage in now if stage not in changed]
    while True:
        more = {}
        for stage in left:
            read = _places(now[stage], "deps")
            sources = [
                other
                for other in (*changed, *stale)
                if any(
                    path == out or path.startswith(f"{out}/")
                    for path in read
                    for out, md5 in made[other].items()
                    if other in stale or _places(before.get(other, ""), "outs").get(out) != md5
                )
            ]
            if sources:
                more[stage] = stale.get(sources[0], sources[0])
        if not more:
            return stale
        stale |= more
        left = [stage for stage in left if stage not in more]


def stages(lock: str) -> Mapping[str, str]:
    """{stage: its block} of a dvc.lock."""
    return {head.strip().rstrip(":"): block for head, block in stored.blocks(lock, 2).items()}


@functools.lru_cache(maxsize=5000)
def _places(block: str, what: str) -> Mapping[str, str]:
    """{path: md5} of the deps or outs of a stage's block; {} where it is none."""
    try:
        data = yaml.load(block, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except yaml.YAMLError:
        return {}
    entries = next(iter(data.values()), {}) if isinstance(data, dict) else {}
    listed = entries.get(what) if isinstance(entries, dict) else None
    rows = [row for row in listed or [] if isinstance(row, dict)]
    return {str(row.get("path")): str(row.get("md5")) for row in rows}


def outs(lock: str, stage: str) -> Mapping[str, str]:
    """{path: md5} of what a stage made, by the dvc.lock of a run."""
    return _places(stages(lock).get(stage, ""), "outs")


def varied(runs: Sequence[Run]) -> list[str]:
    """Keys of parameters that are not the same in all of these runs."""
    sets = [run.parameters for run in runs if run.parameters]
    keys = dict.fromkeys(key for each in sets for key in each)
    return [key for key in keys if len({each.get(key) for each in sets}) > 1]
