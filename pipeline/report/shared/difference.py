"""This run against the accepted one: what changed, and which figures moved beyond their noise."""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from pipeline.report.shared.sources import Sources, digest
from pipeline.verdict.digits import MINUS, THIN, beyond_meaning, count, decimals, number, short
from pipeline.verdict.evidence import known
from pipeline.verdict.verdict import Figure, Missing, Question


class Move(NamedTuple):
    """A figure in both runs. `moved`: its bands no longer overlap; `word`: better, worse, within noise,
    unchanged, or why it cannot be said.
    """

    question: Question
    before: Figure | None
    now: Figure | Missing
    moved: bool
    word: str

    def text(self) -> str:
        """ "+0.39 °C · worse"; a change of a percentage is in points."""
        if not self.moved:
            return self.word
        change = self.now.value - self.before.value
        unit = self.question.unit
        ends = (self.before.value, self.now.value)
        if not math.isfinite(change) or any(beyond_meaning(end, unit) for end in ends):
            return self.word
        places = min(decimals(f.low, f.high, value=f.value) for f in (self.before, self.now))
        exact = all(f.low == f.high for f in (self.before, self.now))
        size = short(abs(change), 3) if exact else number(abs(change), places)
        unit = {"%": "points", "×": "×"}.get(self.question.unit, self.question.unit)
        sign = "+" if change > 0 else MINUS
        return f"{sign}{size}{THIN + unit if unit else ''} · {self.word}"


class Difference(NamedTuple):
    """Recordings (`inputs`), `parameters` (name, before, now), `code` (changed, unchanged, not recorded) and
    `artifacts` that are not those of the accepted run. `machine`: the accepted run's, if nothing but the
    machine can differ from it, else {}.
    """

    inputs: list[str]
    parameters: list[tuple[str, str, str]]
    code: str
    artifacts: list[str]
    machine: Mapping[str, Any]

    @property
    def empty(self) -> bool:
        return not (self.inputs or self.parameters or self.artifacts or self.code == "changed")


def accepted_on(sources: Sources) -> str:
    """The day of the accepted run; "" without one."""
    run = sources.accepted if isinstance(sources.accepted, dict) else {}
    return str((run.get("accepted") or {}).get("on", ""))[:40]


def difference(sources: Sources) -> Difference | None:
    """None where no run was accepted yet."""
    before = known(sources.accepted, None)
    if before is None:
        return None
    hashes = before.get("hashes") or {}
    now = {path: source.sha256 for path, source in sources.read.items() if path.startswith("datasets/")}
    then = {path: value for path, value in hashes.items() if path.startswith("datasets/")}
    recorded = {path.split("/", 1)[0] for path in then}
    now = {path: value for path, value in now.items() if path.split("/", 1)[0] in recorded}
    changed = [path for path in sorted(now) if then.get(path) != now[path]]
    # no page reads the other files, so that they are not hashed again; whether they exist is known
    folders_read = {path.rsplit("/", 1)[0] for path in now}
    changed += [
        path
        for path in sorted(then)
        if path not in now and path.rsplit("/", 1)[0] in folders_read and not Path(path).exists()
    ]
    inputs = [
        path
        for path in changed
        if path.split("/")[1] == "raw" or path.split("/")[1:] == ["ingest", "record.parquet"]
    ]
    # the accepted run may know the code by its folders, as it knows artifacts
    folders = {path: value for path, value in hashes.items() if path in ("pipeline", "stages")}
    code = digest(folders) if folders else None
    everything = sources.declared.everything
    parameters = list(changed_parameters(before.get("params") or {}, everything))
    alike = code == sources.code and not inputs and not parameters
    # recordings of these loops are read into no table that is compared: they may have changed unseen
    sections = [everything.get(stage) or {} for stage in ("train_ilc", "train_classifier")]
    alike = alike and not any(section.get("source") == "recordings" for section in sections)
    machine = before.get("machine")
    return Difference(
        inputs,
        parameters,
        "not recorded" if code is None else "unchanged" if code == sources.code else "changed",
        [path for path in changed if path not in inputs],
        machine if alike and isinstance(machine, dict) else {},
    )


def changed_parameters(before: Mapping, now: Mapping) -> Iterator[tuple[str, str, str]]:
    """(dotted key, value before, value now) of each parameter that differs."""
    # a section that is new or gone is one change
    for name in sorted(before.keys() ^ now.keys()):
        values = count(len(list(_flat("", before.get(name, now.get(name))))), "value")
        yield (
            name,
            *(
                ("no section", f"a section of {values}")
                if name in now
                else (f"a section of {values}", "no section")
            ),
        )
    both = before.keys() & now.keys()
    old, new = (dict(_flat("", {name: part[name] for name in both})) for part in (before, now))
    for name in sorted(old.keys() | new.keys()):
        if old.get(name) != new.get(name):
            yield name, _shown(old, name), _shown(new, name)


def _shown(values: Mapping[str, Any], name: str) -> str:
    return "none" if name not in values else "null" if values[name] is None else str(values[name]) or "empty"


def _flat(prefix: str, data: Any) -> Iterator[tuple[str, Any]]:
    items = (
        data.items()
        if isinstance(data, Mapping) and data
        else enumerate(data)
        if isinstance(data, list) and data
        else None
    )
    if items is None:
        yield prefix, data
        return
    for key, value in items:
        place = f"{prefix}[{key}]" if isinstance(data, list) else f"{prefix}.{key}" if prefix else str(key)
        yield from _flat(place, value)


def moves(
    sources: Sources, asked: list[Question], answers: Mapping[str, Mapping[str, Figure | Missing]]
) -> dict[str, list[Move]]:
    """{controller: every figure against the accepted run's}. A run that kept none of a figure, such as one of
    an earlier comparison, leaves it new."""
    before = _recorded(sources.accepted.get("figures") or {})
    return {
        name: [
            move(question, before.get(name, {}).get(question.key), mine[question.key]) for question in asked
        ]
        for name, mine in answers.items()
    }


def _recorded(figures: Mapping[str, Any]) -> dict[str, dict[str, Figure | Missing]]:
    """The figures as the accepted pages showed them; null is without end."""
    return {
        name: {
            key: Figure(*(math.inf if f[end] is None else f[end] for end in ("median", "low", "high")))
            for key, f in bands.items()
        }
        for name, bands in figures.items()
    }


def move(question: Question, before: Figure | None, now: Figure | Missing, same: float = 0.0) -> Move:
    """A figure moves if its band and the earlier one do not overlap, and lie further apart than `same`."""
    if isinstance(now, Missing):
        return Move(question, None, now, False, now.state)
    if before is None:
        return Move(question, None, now, False, "new")
    if before[:3] == now[:3]:
        return Move(question, before, now, False, "unchanged")
    if now.low <= before.high + same and before.low <= now.high + same:
        return Move(question, before, now, False, "within noise")
    return Move(
        question, before, now, True, "better" if (now.value < before.value) != question.at_least else "worse"
    )
