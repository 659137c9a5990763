"""The records of the nightly job: drift that a run found, what is in production, and what was decided.

They are stored in .beadline/memory.json, reports/metrics/nightly.json and champion.json, and the page reads
them.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import pydantic

from pipeline.statistics import Paired
from pipeline.verdict.verdict import Verdict

R = TypeVar("R")


def to_json(value: Any) -> Any:
    """Returns a record as JSON: its fields by name, tuples as lists. Numbers that are not finite become null,
    since JSON has no infinity."""
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        value = value._asdict()
    elif dataclasses.is_dataclass(value):
        value = vars(value)
    if isinstance(value, Mapping):
        return {name: to_json(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def from_json(record: type[R], fields: Any) -> R:
    """Returns the record from what `to_json` gave; missing fields get their defaults. Raises ValueError if a
    field without a default is missing, or if a field has another type."""
    try:
        return pydantic.TypeAdapter(record).validate_python(fields)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the whole"
        raise ValueError(f"expected a {record.__name__}, found {place} of another form") from None


# ---- drift

PLANT = "temperature"  # the loop whose recordings show the plant's parameters
SENSOR = "sensor"  # the most urgent kind of alarm: a sensor that stands still


class Alarm(NamedTuple):
    """A change in one loop. `key`: by which the next run recognises it; `recording`: that shows it; `cause`:
    in words; `sigmas`: distance from no change; `consequences`: in words. `kind` and `channel` give the
    cause for a machine to read, and are empty if there is none. `kind`: gain, time constant, delay,
    saturation, offset, noise, ambient, sensor, or several joined by "or"; `channel`: a signal's name, or
    "every input"."""

    loop: str
    key: str
    recording: str
    cause: str
    sigmas: float
    consequences: tuple[str, ...] = ()
    kind: str = ""
    channel: str = ""


def sort_alarms(alarms: Sequence[Alarm]) -> list[Alarm]:
    """Returns the alarms, with sensors that stand still first."""
    return sorted(alarms, key=lambda alarm: alarm.kind != SENSOR)


@dataclasses.dataclass
class NightDrift:
    """Drift of machines and cameras in new recordings: alarms; `watched`, what becomes an alarm if it
    persists; reasons why recordings were set aside; notes.

    `figures`: what the champion's observer measured on each recording, compared with the champion's own
    recordings. `parameters` of the plant {percent, band_percent (half of the 90 % band), sigmas};
    `innovation` of each output {noise_percent, noise_sigmas, mean_degC, mean_sigmas}; `closed_loop` {moved,
    sigmas}; `not_applicable`, why the closed loop was not compared; `least`, the smallest changes that would
    have shown.
    """

    alarms: list[Alarm] = dataclasses.field(default_factory=list)
    watched: list[Alarm] = dataclasses.field(default_factory=list)
    figures: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)
    quarantined: dict[str, str] = dataclasses.field(default_factory=dict)
    notes: list[str] = dataclasses.field(default_factory=list)


# ---- production: champion.json

ROLLED_BACK, DRIFT_ACCEPTED = "rolled back", "drift accepted"  # events of the history, beside promotions


def candidate_of(loop: str) -> str:
    """Returns the folder below champion/ that holds a loop's candidate."""
    return f"{loop}.candidate"


class Champion(NamedTuple):
    """A loop's champion (the controller in production), or a candidate: the run that made it, when and why;
    `folder`, what DVC's pointer says of its folder; `files`, MD5 of its files by path. `since`: time of a
    rollback to it.

    `lineage`: the `commit` from which the run worked, and its `uncommitted` changes. `contestant`: the
    controller that runs, by its name on the pages. `rehearsal`: it was judged on simulated data only.
    `verdict`: what the page said of it then.
    """

    run: str
    when: str
    why: str = ""
    folder: Mapping[str, Any] = {}
    files: Mapping[str, str] = {}
    lineage: Mapping[str, Any] = {}
    since: str = ""
    contestant: str = ""
    rehearsal: bool = False
    verdict: str = ""

    @property
    def md5(self) -> str:
        """Returns DVC's hash of the whole folder."""
        return self.folder["md5"]


class HistoryLine(NamedTuple):
    """One change of production: loop, event, when and why, and the champion from then on. `before`: run of
    the previous champion, None if there was none. `replaced`: files of the champion that a rollback removed,
    MD5 by path."""

    run: str
    loop: str
    event: str
    when: str
    why: str
    before: str | None
    champion: Champion
    replaced: Mapping[str, str] = {}


class ChampionState(NamedTuple):
    """Content of champion.json: {loop: champion}, and every change of production, the oldest first.
    `candidates`: for each loop the last challenger that did not pass the page's rules; its files lie in
    champion/<loop>.candidate, and nothing runs them."""

    champions: Mapping[str, Champion] = {}
    history: tuple[HistoryLine, ...] = ()
    candidates: Mapping[str, Champion] = {}

    @property
    def folders(self) -> dict[str, Champion]:
        """Returns what lies below champion/, by folder."""
        waiting = {candidate_of(loop): candidate for loop, candidate in self.candidates.items()}
        return {**self.champions, **waiting}


# ---- nights

PROMOTED, KEPT, FIRST = "promoted", "kept", "first champion"
CANDIDATE = "candidate"  # of a challenger that does not pass the page's rules of its loop
# how a night ends; PROMOTED, KEPT and CANDIDATE too
FAILED, QUARANTINED, NOTHING_NEW = "failed", "quarantined", "nothing new"


class LoopDecision(NamedTuple):
    """The decision on one loop's challenger, and why: promoted, kept, first champion, candidate or failed.
    `paired`: test of challenger against champion, None if they were not compared. `guards`: figures of which
    less is better, {name: {champion, challenger, allowed}}, None if a figure does not exist. `verdict`: the
    page's on this loop without its rules, None if it has no page."""

    decision: str
    reasons: list[str]
    paired: Paired | None = None
    guards: Mapping[str, Mapping[str, float | None]] = {}
    verdict: Verdict | None = None

    @property
    def promotes(self) -> bool:
        return self.decision in (PROMOTED, FIRST)


@dataclasses.dataclass
class Night:
    """One nightly run: `number`, `run` (its name) and `when`; `outcome`, `reasons` and `notes`.

    `new_recordings` by loop; `used`, {path: {used_percent, masked_percent, cut_percent}} of them; `drift`;
    `decisions` on each loop. `commit`; `unpushed`, whether its artifacts have yet to reach the remote;
    `seconds` that the run took. `branch`: on which its promotions wait, empty if they are in production.
    `idle`: successive runs without a new recording, including this one.
    """

    number: int
    run: str
    when: str
    outcome: str = ""
    reasons: list[str] = dataclasses.field(default_factory=list)
    notes: list[str] = dataclasses.field(default_factory=list)
    new_recordings: dict[str, list[str]] = dataclasses.field(default_factory=dict)
    used: dict[str, dict[str, float]] = dataclasses.field(default_factory=dict)
    drift: NightDrift = dataclasses.field(default_factory=NightDrift)
    decisions: dict[str, LoopDecision] = dataclasses.field(default_factory=dict)
    commit: str = ""
    unpushed: bool = False
    seconds: float = 0.0
    branch: str = ""
    idle: int = 0

    def end(self, outcome: str, *reasons: str) -> None:
        self.outcome, self.reasons = outcome, list(reasons)

    @property
    def promoted(self) -> list[str]:
        return [name for name, decision in self.decisions.items() if decision.promotes]

    @property
    def lost(self) -> list[str]:
        """Returns the loops whose stages failed, or that could not be judged."""
        return [name for name, decision in self.decisions.items() if decision.decision == FAILED]

    @property
    def candidates(self) -> dict[str, str]:
        """Returns the loops whose challenger is a candidate, and what the page says of each."""
        waiting = {name: one for name, one in self.decisions.items() if one.decision == CANDIDATE}
        return {name: "; ".join(decision.reasons) for name, decision in waiting.items()}

    def metrics(self, state: ChampionState) -> dict[str, Any]:
        """Returns the run as in reports/metrics/nightly.json, with what is in production."""
        keys = ("run", "when", "why", "contestant", "rehearsal")
        production, candidates = (
            {name: {key: getattr(one, key) for key in keys} for name, one in champions.items()}
            for champions in (state.champions, state.candidates)
        )
        named = {"decision": self.outcome, "night": self.number, "promoted": self.promoted}
        return to_json(self) | named | {"champion": production, "candidates": candidates}


@dataclasses.dataclass
class Memory:
    """What the job remembers from run to run, .beadline/memory.json. `night`: number of the last run;
    `success`: time of the last success (empty before the first); `inputs`: digest of everything that it was
    made from; `unpushed`: whether its artifacts have yet to reach the remote; `idle`: as in `Night`.

    `recordings`: {loop: {path: digest}}; `hashes`: {path: [size, time of change, inode, digest]}; `nights`:
    every run, the oldest first. From the last run with recordings: `alarms`, and `pending`, the keys that it
    watched or alarmed. `drifted`: recordings of each loop since its alarm. `recent`: changes that the last
    runs named for each loop, over which a change is pooled: {loop: {"reference": digest of what they were
    compared with, "nights": [{change: [size, standard deviation]}]}}.
    """

    night: int = 0
    success: str = ""
    inputs: str = ""
    unpushed: bool = False
    idle: int = 0
    recordings: dict[str, dict[str, str]] = dataclasses.field(default_factory=dict)
    hashes: dict[str, list[int | str]] = dataclasses.field(default_factory=dict)
    nights: list[Night] = dataclasses.field(default_factory=list)
    alarms: list[Alarm] = dataclasses.field(default_factory=list)
    pending: list[str] = dataclasses.field(default_factory=list)
    drifted: dict[str, list[str]] = dataclasses.field(default_factory=dict)
    recent: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)
