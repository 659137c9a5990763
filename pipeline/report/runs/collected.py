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
Lock = Mapping[str, str]  # {stage: its block} of a dvc.lock
# of one run; a file with more holds no parameters of ours
MOST_PARAMETERS, LONGEST_VALUE = 5000, 120


class Run(NamedTuple):
    """One run. Its kind: accepted, night, experiment, revision (committed, and nobody accepted it), files
    (not committed). `name` is a night's or an experiment's. {dotted key: value in words} of its parameters,
    or why there are none in `no_parameters`. `made`: md5 of each stage's folder by its dvc.lock; `base` the
    commit that an experiment began from. `note`: how a night ended."""

    kind: str
    name: str
    commit: str
    date: str
    subject: str
    measured: Measured
    parameters: Mapping[str, str] = {}
    no_parameters: str = ""
    made: Mapping[str, str] = {}
    base: str = ""
    note: str = ""


class Collected(NamedTuple):
    """Runs, the oldest first, and a sentence for each thing that could not be read."""

    runs: list[Run]
    troubles: list[str]


class _Read(NamedTuple):
    """Files of runs: {REVISION:PATH: object}, each object's text, and of each dvc.lock its stages."""

    objects: Mapping[str, str]
    texts: Mapping[str, bytes]
    locks: Mapping[str, Lock]

    def text(self, place: str) -> bytes | None:
        """None where the file is not there."""
        name = self.objects.get(place, "")
        return self.texts.get(name) if name else None

    def lock(self, commit: str) -> Lock:
        """The stages of a commit's dvc.lock; none where it has none."""
        return self.locks.get(self.objects.get(f"{commit}:{LOCK}", ""), {})


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


def _read(commits: Sequence[Commit], names: Sequence[str]) -> _Read:
    paths = [f"{METRICS}/{name}.json" for name in names]
    places = [f"{commit.hash}:{path}" for commit in commits for path in (*paths, NIGHTLY, *PARAMETERS, LOCK)]
    places += [f"{commit.base}:{LOCK}" for commit in commits if commit.base]
    objects = stored.objects(places)
    at = dict(zip(places, objects, strict=True))
    wiring = {name for place, name in at.items() if place.endswith(f":{LOCK}")}
    texts, locks, same = {}, {}, {}
    for name, text in stored.contents(objects):
        if name in wiring:
            # a block that many runs share is kept once
            found = stages(text.decode(errors="replace"))
            locks[name] = {stage: same.setdefault(block, block) for stage, block in found.items()}
        else:
            texts[name] = text
    return _Read(at, texts, locks)


# ---- one run


class _Memory:
    """What is parsed once though many runs share it: figures by their files, parameters by theirs."""

    def __init__(self, asked: Sequence[Column]):
        self.asked = asked
        self.stages = tuple(dict.fromkeys([*FILES, *(column.stage for column in asked)]))
        self.files: dict[tuple[str, bytes], dict] = {}
        self.measured: dict[Any, Measured] = {}
        self.parameters: dict[Any, tuple[Mapping[str, str], str]] = {}

    def file(self, name: str, text: bytes) -> dict:
        """A stage's metrics under today's names; {} of what is no JSON."""
        if (name, text) not in self.files:
            self.files[name, text] = today({name: history.plain(text)})[name]
        return self.files[name, text]


def _run(commit: Commit, read: _Read, known: _Memory) -> Run:
    lock = read.lock(commit.hash)
    stale = _stale(read.lock(commit.base), lock) if commit.base else {}
    objects = tuple(read.objects[f"{commit.hash}:{METRICS}/{name}.json"] for name in known.stages)
    texts = {name: read.texts.get(key) for name, key in zip(known.stages, objects, strict=True)}
    key = (objects, tuple(stale.items()))
    if key not in known.measured:
        known.measured[key] = _measured(texts, stale, known)
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
        made=folders(lock),
        base=commit.base,
        note=str(night.get("decision") or ""),
    )


def _measured(texts: Mapping[str, bytes | None], stale: Mapping[str, str], known: _Memory) -> Measured:
    """The figures of {stage: its file}, and why others are not there."""
    gone, files = {}, {}
    for name, text in texts.items():
        files[name] = {} if text is None or name in stale else known.file(name, text)
        if name in stale:
            gone[name] = f"{name} was not run again after {stale[name]} changed"
        elif text is None:
            gone[name] = f"there is no {name}.json"
        elif not files[name]:
            gone[name] = f"{name}.json is empty, or damaged"
    return measured(files, gone, known.asked)


def _now(known: _Memory) -> Run:
    """The files as they lie there."""
    texts = {name: _bytes(Path(f"{METRICS}/{name}.json")) for name in known.stages}
    found, why = parameters([_bytes(Path(path)) for path in PARAMETERS])
    own = _measured(texts, {}, known)
    return Run("files", "", "", "", "not committed", own, found, why, made=folders(lock_now()))


def lock_now() -> Lock:
    """The stages of dvc.lock as it lies there."""
    return stages((_bytes(Path(LOCK)) or b"").decode(errors="replace"))


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


def _stale(before: Lock, now: Lock) -> dict[str, str]:
    """{stage whose figures are the base's, though what it reads changed: the stage that changed}, off the
    dvc.lock of an experiment and of the commit that it began from. DVC runs no stage behind the target."""
    if not before or not now:
        return {}
    changed = {
        out: stage
        for stage, block in now.items()
        if block != before.get(stage)
        for out, md5 in outs(block).items()
        if outs(before.get(stage, "")).get(out) != md5
    }
    left = {stage: block for stage, block in now.items() if block == before.get(stage)}
    stale: dict[str, str] = {}
    while more := {
        stage: changed[min(hit)] for stage, block in left.items() if (hit := changed.keys() & _read_by(block))
    }:
        stale |= more
        changed |= {out: source for stage, source in more.items() for out in outs(left.pop(stage))}
    return stale


def stages(lock: str) -> Lock:
    """{stage: its block} of the text of a dvc.lock."""
    return {head.strip().rstrip(":"): block for head, block in stored.blocks(lock, 2).items()}


# as DVC writes the files of a stage
FILE = re.compile(r"^    - path: (.+)\n(?:      (?!md5:).*\n)*      md5: (\S+)", re.MULTILINE)


@functools.lru_cache(maxsize=5000)
def outs(block: str) -> Mapping[str, str]:
    """{path: md5} of what a stage made, by its block of a dvc.lock."""
    return dict(FILE.findall(_part(block, "    outs:")))


@functools.lru_cache(maxsize=5000)
def _read_by(block: str) -> frozenset[str]:
    """The paths that a stage read, and the folders that these lie in."""
    paths = [path for path, _ in FILE.findall(_part(block, "    deps:"))]
    ends = [[*range(len(path)), len(path)] for path in paths]
    return frozenset(
        path[:end]
        for path, places in zip(paths, ends, strict=True)
        for end in places
        if end == len(path) or path[end] == "/"
    )


def _part(block: str, head: str) -> str:
    return stored.blocks(block, 4).get(head, "")


def folders(lock: Lock) -> dict[str, str]:
    """{stage: md5 of datasets/STAGE} of a dvc.lock."""
    found = {stage: outs(block).get(f"datasets/{stage}", "") for stage, block in lock.items()}
    return {stage: md5 for stage, md5 in found.items() if md5}


def varied(runs: Sequence[Run]) -> list[str]:
    """Keys of parameters that are not the same in all of these runs."""
    sets = [run.parameters for run in runs if run.parameters]
    keys = dict.fromkeys(key for each in sets for key in each)
    return [key for key in keys if len({each.get(key) for each in sets}) > 1]
