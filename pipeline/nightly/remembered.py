"""What the job remembers from night to night: .beadline/last.json, and nights.json for the page. Losing
either costs one repeated night; a broken one is set aside."""

import datetime
import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import pydantic
import yaml

from pipeline.nightly import records
from pipeline.nightly.processes import STATE, git
from pipeline.nightly.records import Alarm, Night
from pipeline.nightly.settings import Nightly
from pipeline.store import artifacts, params

LAST, NIGHTS, METRICS = STATE / "last.json", STATE / "nights.json", Path("reports/metrics/nightly.json")
LONGEST_HISTORY = 1000
SECRET = ("webhook", "heartbeat")
# how a file that is JSON, but not what was written there, shows itself when it is read
MISSHAPEN = (
    *(ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError),
    IsADirectoryError,
)
T = TypeVar("T")


class DriftMemory(NamedTuple):
    """Of the last night with recordings: keys of what was watched or raised an alarm, and its alarms.
    `drifted` are the recordings of each loop since its alarm; `night` is 0 before the first. `recent` is what
    the last nights named of each loop: {loop: {"reference": digest of what they were held against, "nights":
    [{change: [size, standard deviation]}]}}, over which a change is pooled; "seeming" is the same of
    what nights left unnamed."""

    pending: tuple[str, ...] = ()
    alarms: tuple[Alarm, ...] = ()
    drifted: Mapping[str, list[str]] = {}
    night: int = 0
    recent: Mapping[str, Mapping[str, Any]] = {}

    @classmethod
    def read(cls, fields: Mapping[str, Any]) -> "DriftMemory":
        alarms = tuple(map(Alarm.read, fields.get("alarms", ())))
        pending = tuple(fields.get("pending", ()))
        return cls(
            pending, alarms, fields.get("drifted", {}), fields.get("night", 0), fields.get("recent", {})
        )

    def to_json(self) -> dict[str, Any]:
        if self == DriftMemory():
            return {}
        fields = self._asdict() | {
            "pending": list(self.pending),
            "alarms": [alarm.to_json() for alarm in self.alarms],
        }
        return {key: value for key, value in fields.items() if key != "recent" or value}


class Remembered(NamedTuple):
    """The last night: its number, time of the last success (None before the first), and the digest of all
    that it was made from. `unpushed`: its artifacts have yet to reach the remote. `recordings` is {loop:
    {path: digest}}; `hashes` is {path: [size, time of change, inode, digest]}. `settings`: the section of the
    parameters when it could last be read, by which somebody is woken where it cannot be."""

    night: int = 0
    success: str | None = None
    inputs: str | None = None
    unpushed: bool = False
    recordings: Mapping[str, Mapping[str, str]] = {}
    drift: DriftMemory = DriftMemory()
    hashes: Mapping[str, list[int | str]] = {}
    settings: Mapping[str, Any] = {}

    @classmethod
    def read(cls, fields: Mapping[str, Any]) -> "Remembered":
        """Raises one of MISSHAPEN where the file is not what `to_json` gave."""
        read = cls(
            night=fields["night"],
            success=fields.get("success"),
            inputs=fields.get("inputs"),
            unpushed=fields.get("unpushed", False),
            recordings=fields.get("recordings", {}),
            drift=DriftMemory.read(fields.get("drift", {})),
            hashes=fields.get("hashes", {}),
            settings=fields.get("settings", {}),
        )
        if read.success and datetime.datetime.fromisoformat(read.success).tzinfo is None:
            raise ValueError(f"success {read.success} has no time zone")
        if odd := [path for path, stamp in read.hashes.items() if len(stamp) != 4]:
            raise ValueError(f"expected size, time, inode and digest of {odd[0]}")
        return pydantic.TypeAdapter(cls).validate_python(read)

    def to_json(self) -> dict[str, Any]:
        fields = self._asdict() | {"drift": self.drift.to_json()}
        return fields if self.settings else {key: fields[key] for key in fields if key != "settings"}

    def known(self) -> Nightly | None:
        """The parameters as they were last known, the addresses that may hold a secret as the last commit
        has them; None if they never were known, or are of another version."""
        if not self.settings:
            return None
        try:
            return Nightly.model_validate_json(json.dumps({**self.settings, **_committed_addresses()}))
        except pydantic.ValidationError:
            return None


def without_secrets(settings: Nightly) -> dict[str, Any]:
    """The settings as a state file may hold them: whoever knows an address can write to it."""
    return settings.model_copy(update=dict.fromkeys(SECRET, "")).model_dump(mode="json")


def _committed_addresses() -> dict[str, str]:
    try:
        sections = yaml.safe_load(git("show", f"HEAD:{params.FILE}", check=False)) or {}
        return {key: str(sections["nightly"][key]) for key in SECRET}
    except (yaml.YAMLError, KeyError, TypeError):
        return dict.fromkeys(SECRET, "")


def _rows(rows: Sequence[Mapping[str, Any]]) -> Sequence[Mapping[str, Any]]:
    """The rows of nights.json. Raises one of MISSHAPEN where a night cannot be read off each."""
    if not isinstance(rows, list):
        raise TypeError(f"expected a list of nights, found {type(rows).__name__}")
    for night in map(Night.read, rows):
        if type(night.number) is not int or datetime.datetime.fromisoformat(night.when).tzinfo is None:
            raise ValueError(f"expected a night's number and time, found {night.number!r} and {night.when!r}")
    return rows


def _of_metrics(metrics: Mapping[str, Any]) -> Remembered:
    return Remembered.read({"night": metrics["night"], "success": metrics["when"]})


# ---- the files


def _file(path: Path, read: Callable[[Any], T], empty: T) -> T:
    """What a file holds, `empty` where there is none. Raises ValueError where it is broken."""
    if not path.exists():
        return empty
    try:
        return read(artifacts.read_json(path))
    except ValueError as error:
        sentence = str(error) if str(path) in str(error) else f"{path} is not what a night writes ({error})"
    except MISSHAPEN as error:
        sentence = f"{path} is not what a night writes ({type(error).__name__}: {error})"
    raise ValueError(sentence.removesuffix(f"; {artifacts.remedy(path)}"))


def last() -> Remembered:
    """The last night as the job itself remembers it; on a fresh clone, as the committed metrics do. Raises
    ValueError where the file is broken."""
    if LAST.exists():
        return _file(LAST, Remembered.read, Remembered())
    try:
        rows, committed = nights(), _file(METRICS, _of_metrics, Remembered())
    except ValueError:  # neither is the memory itself
        rows, committed = [], Remembered()
    successes = [night.when for night in rows if night.outcome != records.FAILED]
    number = max(committed.night, *(night.number for night in rows)) if rows else committed.night
    return Remembered(night=number, success=max([committed.success or "", *successes]) or None)


def nights() -> list[Night]:
    """Every night that this checkout remembers, the oldest first. Raises ValueError where the file is
    broken."""
    return [Night.read(row) for row in _file(NIGHTS, _rows, [])]


def broken() -> list[str]:
    """What is wrong with the files that nights remember by, a sentence each."""
    sentences = []
    for path, read in ((LAST, Remembered.read), (NIGHTS, _rows)):
        try:
            _file(path, read, None)
        except ValueError as error:
            sentences.append(str(error))
    return sentences


def opened() -> tuple[Remembered, list[str]]:
    """The last night, and a sentence for each broken file, which lies beside as .broken from then on. A night
    that had to set one aside begins nothing; the next one looks at everything anew."""
    aside = []
    for path, read in ((LAST, Remembered.read), (NIGHTS, _rows)):
        try:
            _file(path, read, None)
        except ValueError as error:
            aside.append(f"{error}; {set_aside(path)}, and the next night looks at everything anew")
    return last(), aside


def set_aside(path: Path) -> str:
    """Renames a broken file to .broken in the job's own folder; says so."""
    target = STATE / f"{path.name}.broken"
    if target.is_dir():
        shutil.rmtree(target)
    path.replace(target)
    return f"it is set aside as {target}"


def remember(night: Remembered) -> None:
    artifacts.write_json(LAST, night.to_json())


def add(night: Night) -> None:
    """One more night for the page."""
    rows = [*_file(NIGHTS, _rows, []), night.to_json()]
    artifacts.write_json(NIGHTS, rows[-LONGEST_HISTORY:])
