"""The records of the nightly job: what a night found of drift, what is in production, and what was decided.

.beadline/memory.json, reports/metrics/nightly.json and champion.json hold them, and the page reads them.
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
    """A record as JSON: its fields by name, tuples as lists. JSON knows no infinity: it is null."""
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
    """What `to_json` gave of a record; fields that are missing are as declared. Raises ValueError if one is
    missing that has no value otherwise, or is of another kind."""
    try:
        return pydantic.TypeAdapter(record).validate_python(fields)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the whole"
        raise ValueError(f"expected a {record.__name__}, found {place} of another form") from None


# ---- drift

PLANT = "temperature"  # the loop whose recordings tell of the plant's parameters
SENSOR = "sensor"  # kind of an alarm that stands above every other: a sensor that stands still


class Alarm(NamedTuple):
    """A change of one loop: the key by which the next night knows it again, and the recording that shows it.
    Then its cause in words, how many sigmas it is from no change, and what follows from it in words. `kind`
    and `channel` are the cause for a machine to read, empty if it has none: gain, time constant, delay,
    saturation, offset, noise, ambient, sensor, or several with "or" between; a signal's name, or "every
    input"."""

    loop: str
    key: str
    recording: str
    cause: str
    sigmas: float
    consequences: tuple[str, ...] = ()
    kind: str = ""
    channel: str = ""


def sort_alarms(alarms: Sequence[Alarm]) -> list[Alarm]:
    """A sensor that stands still first."""
    return sorted(alarms, key=lambda alarm: alarm.kind != SENSOR)


@dataclasses.dataclass
class NightDrift:
    """What new recordings say of the machines and cameras: alarms, what would be one if it stayed, and why
    recordings were set aside; notes.

    `figures` has what the champion's observer measured on each recording against the champion's own:
    `parameters` of the plant {percent, band_percent (half of the 90 % band), sigmas}; `innovation` of each
    output {noise_percent, noise_sigmas, mean_degC, mean_sigmas}; `closed_loop` {moved, sigmas};
    `not_applicable`, why the closed loop was not asked; `least`, the smallest changes that would have shown.
    """

    alarms: list[Alarm] = dataclasses.field(default_factory=list)
    watched: list[Alarm] = dataclasses.field(default_factory=list)
    figures: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)
    quarantined: dict[str, str] = dataclasses.field(default_factory=dict)
    notes: list[str] = dataclasses.field(default_factory=list)


# ---- production: champion.json

ROLLED_BACK, DRIFT_ACCEPTED = "rolled back", "drift accepted"  # events of the history, beside promotions


def candidate_of(loop: str) -> str:
    """The folder below champion/ that a loop's candidate lies in."""
    return f"{loop}.candidate"


class Champion(NamedTuple):
    """One loop's champion, or a candidate: the night that made it, when and why; what DVC's pointer says of
    its folder, and MD5 of its files by path. `since` is the time of a rollback to it.

    `lineage`: the `commit` that the night worked from, and what lay `uncommitted` on it. `contestant` is the
    controller that runs, by its name on the pages. `rehearsal`: it was judged on simulated data alone.
    `verdict` is what the page said of it then.
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
        """DVC's hash of the whole folder."""
        return self.folder["md5"]


class HistoryLine(NamedTuple):
    """One change of production: which loop, what happened, when and why, and the champion from then on.
    `before` is the run of the champion until then, None if there was none. `replaced` are the files of the
    champion that a rollback took out, MD5 by path."""

    run: str
    loop: str
    event: str
    when: str
    why: str
    before: str | None
    champion: Champion
    replaced: Mapping[str, str] = {}


class ChampionState(NamedTuple):
    """champion.json: {loop: champion}, and every change of production, the oldest first. `candidates`: of
    each loop the last challenger that did not pass the page's rules; its files lie in
    champion/<loop>.candidate, and nothing runs them."""

    champions: Mapping[str, Champion] = {}
    history: tuple[HistoryLine, ...] = ()
    candidates: Mapping[str, Champion] = {}

    @property
    def folders(self) -> dict[str, Champion]:
        """What lies below champion/, by folder."""
        waiting = {candidate_of(loop): candidate for loop, candidate in self.candidates.items()}
        return {**self.champions, **waiting}


# ---- nights

PROMOTED, KEPT, FIRST = "promoted", "kept", "first champion"
CANDIDATE = "candidate"  # of a challenger that does not pass the page's rules of its loop
# how a night ends; PROMOTED, KEPT and CANDIDATE too
FAILED, QUARANTINED, NOTHING_NEW = "failed", "quarantined", "nothing new"


class LoopDecision(NamedTuple):
    """What was decided of one loop's challenger, and why: promoted, kept, first champion, candidate or
    failed. `paired` is the test of challenger against champion, None if they were not compared. `guards` are
    figures of which less is better, {name: {champion, challenger, allowed}}, None if there is no such figure.
    `verdict` is the page's on this loop without its rules, None if it has no page."""

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
    """One night: its number, name and time; how it ended and why, and what else is to be said.

    New recordings by loop, and {path: {used_percent, masked_percent, cut_percent}} of them; drift. What was
    decided of each loop. The commit, whether its artifacts have yet to reach the remote, and how long the
    night took in s. The branch that its promotions wait on, empty if they are in production. `idle`: nights
    in a row without a new recording, this one among them.
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
        """The loops whose stages failed, or that could not be judged."""
        return [name for name, decision in self.decisions.items() if decision.decision == FAILED]

    @property
    def candidates(self) -> dict[str, str]:
        """The loops whose challenger is a candidate, and what the page says of each."""
        waiting = {name: one for name, one in self.decisions.items() if one.decision == CANDIDATE}
        return {name: "; ".join(decision.reasons) for name, decision in waiting.items()}

    def metrics(self, state: ChampionState) -> dict[str, Any]:
        """As reports/metrics/nightly.json has it, with what is in production."""
        keys = ("run", "when", "why", "contestant", "rehearsal")
        production, candidates = (
            {name: {key: getattr(one, key) for key in keys} for name, one in champions.items()}
            for champions in (state.champions, state.candidates)
        )
        named = {"decision": self.outcome, "night": self.number, "promoted": self.promoted}
        return to_json(self) | named | {"champion": production, "candidates": candidates}


@dataclasses.dataclass
class Memory:
    """What the job remembers from night to night, .beadline/memory.json: the last night's number, the time of
    the last success (empty before the first), the digest of all that it was made from, whether its artifacts
    have yet to reach the remote, and `idle` as of a night.

    `recordings` is {loop: {path: digest}}; `hashes` is {path: [size, time of change, inode, digest]};
    `nights` is every night, the oldest first. Of the last night with recordings: its alarms, and the keys
    that it watched or alarmed (`pending`). `drifted` are the recordings of each loop since its alarm.
    `recent` is what the last nights named of each loop, over which a change is pooled: {loop: {"reference":
    digest of what they were held against, "nights": [{change: [size, standard deviation]}]}}.
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
