"""The records of the nightly job: what a night found of drift, what is in production, and what was decided.

.beadline/nights.json, reports/metrics/nightly.json and champion.json hold them, and the page reads them.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeVar

import pydantic

from pipeline.statistics import Paired
from pipeline.verdict.verdict import Verdict

R = TypeVar("R")


def to_json(value: Any) -> Any:
    """A record as JSON: its fields by name, tuples as lists. JSON knows no infinity: it is null."""
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return {name: to_json(field) for name, field in value._asdict().items()}
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
    and `channel` are the cause for a machine to read, empty where it has none: gain, time constant, delay,
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


class ParameterChange(NamedTuple):
    """Change of one parameter of the plant in percent, half of its 90 % band in percent, and in sigmas."""

    percent: float
    band_percent: float
    sigmas: float


class InnovationChange(NamedTuple):
    """Of one output: by how much its noise has grown in percent, and by how many °C of its steady level it is
    off what the model expects of it; both also in sigmas."""

    noise_percent: float
    noise_sigmas: float
    mean_degC: float
    mean_sigmas: float


class ClosedLoopChange(NamedTuple):
    """By how much a figure of the closed loop has moved, in its own unit and in sigmas."""

    moved: float
    sigmas: float


class RecordingFigures(NamedTuple):
    """What the champion's observer measured on one recording, against the champion's own: by parameter of the
    plant, by output, and by figure of the closed loop. `not_applicable` is why the closed loop was not asked,
    empty where it was. `least` says the smallest changes that the recording could have shown."""

    parameters: Mapping[str, ParameterChange]
    innovation: Mapping[str, InnovationChange] = {}
    closed_loop: Mapping[str, ClosedLoopChange] = {}
    not_applicable: str = ""
    least: str = ""


class LoopDrift(NamedTuple):
    """Of one loop: alarms, what would be one if it stayed, and the plant's figures by recording.
    `quarantined` has the reason of each recording that was set aside."""

    loop: str
    alarms: list[Alarm]
    watched: list[Alarm]
    figures: dict[str, RecordingFigures]
    quarantined: dict[str, str]
    notes: list[str]

    @classmethod
    def none(cls, loop: str) -> "LoopDrift":
        return cls(loop, [], [], {}, {}, [])


class NightDrift(NamedTuple):
    """Drift of every loop of a night. What is said of a loop is read off its own entry, `of(loop)`."""

    loops: dict[str, LoopDrift]

    def of(self, loop: str) -> LoopDrift:
        return self.loops.get(loop) or LoopDrift.none(loop)

    @property
    def alarms(self) -> list[Alarm]:
        """A sensor that stands still first."""
        alarms = [alarm for drift in self.loops.values() for alarm in drift.alarms]
        return sorted(alarms, key=lambda alarm: alarm.kind != SENSOR)

    @property
    def watched(self) -> list[Alarm]:
        return [alarm for drift in self.loops.values() for alarm in drift.watched]

    @property
    def figures(self) -> dict[str, RecordingFigures]:
        return {path: figures for drift in self.loops.values() for path, figures in drift.figures.items()}

    @property
    def quarantined(self) -> dict[str, str]:
        return {path: reason for drift in self.loops.values() for path, reason in drift.quarantined.items()}

    @property
    def notes(self) -> list[str]:
        return [note for drift in self.loops.values() for note in drift.notes]

    def metrics(self) -> dict[str, Any]:
        """As reports/metrics/nightly.json has it."""
        return to_json({"alarms": self.alarms, "watched": self.watched, "figures": self.figures})


class RecordShare(NamedTuple):
    """The shares of a new recording in percent of its samples: used in learning; masked by `ingest`; cut."""

    used_percent: float
    masked_percent: float
    cut_percent: float


# ---- production: champion.json

ROLLED_BACK, DRIFT_ACCEPTED = "rolled back", "drift accepted"  # events of the history, beside promotions


def candidate_of(loop: str) -> str:
    """The folder below champion/ that a loop's candidate lies in."""
    return f"{loop}.candidate"


class Lineage(NamedTuple):
    """What a champion was made from: the commit, and what lay uncommitted on it. Then SHA-256 of dvc.lock, of
    the files of parameters, and of each loop's recordings by path."""

    commit: str = ""
    uncommitted: tuple[str, ...] = ()
    dvc_lock: str = ""
    params: Mapping[str, str] = {}
    recordings: Mapping[str, Mapping[str, str]] = {}


class ChampionMetrics(NamedTuple):
    """What the judge measured of a champion when it was promoted: the panel's name, mean cost of its cases
    (None if one of them fails), and {guard: figure}."""

    panel: str
    mean_cost: float | None
    guards: Mapping[str, float]


class Champion(NamedTuple):
    """One loop's champion, or a candidate: the night that made it, when and why; what DVC's pointer says of
    its folder, and MD5 of its files by path; figures and lineage. `since` is the time of a rollback to it.

    `contestant` is the controller that runs, by its name on the pages. `rehearsal`: it was judged on
    simulated data alone. `verdict` is what the page said of it then.
    """

    run: str
    when: str
    why: str = ""
    folder: Mapping[str, Any] = {}
    files: Mapping[str, str] = {}
    metrics: ChampionMetrics | None = None
    lineage: Lineage = Lineage()
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


# ---- decisions

PROMOTED, KEPT, FIRST = "promoted", "kept", "first champion"
CANDIDATE = "candidate"  # of a challenger that does not pass the page's rules of its loop
# how a night ends; PROMOTED, KEPT and CANDIDATE too
FAILED, QUARANTINED, NOTHING_NEW = "failed", "quarantined", "nothing new"


class Guard(NamedTuple):
    """A guard's figure of champion and challenger, less is better, and how much more is allowed. None: there
    is no champion to compare with, or no figure."""

    champion: float | None
    challenger: float | None
    allowed: float | None


class LoopDecision(NamedTuple):
    """What was decided of one loop's challenger, and why: promoted, kept, first champion or candidate.
    `paired` is the test of challenger against champion, None if they were not compared. `verdict` is the
    page's on this loop without its rules, None if it has no page."""

    decision: str
    reasons: list[str]
    paired: Paired | None = None
    guards: Mapping[str, Guard] = {}
    verdict: Verdict | None = None

    @property
    def promotes(self) -> bool:
        return self.decision in (PROMOTED, FIRST)


class Night(NamedTuple):
    """One night: its number, name and time; how it ended and why, and what else is to be said.

    New recordings by loop, and how much of them was used; drift; the reason of each recording that was set
    aside. What was decided of each loop, and which were promoted. The commit, whether its artifacts have yet
    to reach the remote, and how long the night took in s. The branch that its promotions wait on, empty if
    they are in production. `idle`: nights in a row without a new recording, this one among them.
    """

    number: int
    run: str
    when: str
    outcome: str = ""
    reasons: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    new_recordings: Mapping[str, list[str]] = {}
    used: Mapping[str, RecordShare] = {}
    drift: NightDrift = NightDrift({})
    quarantined: Mapping[str, str] = {}
    decisions: Mapping[str, LoopDecision] = {}
    promoted: tuple[str, ...] = ()
    commit: str = ""
    unpushed: bool = False
    seconds: float = 0.0
    branch: str = ""
    idle: int = 0

    @property
    def lost(self) -> list[str]:
        """The loops whose stages failed, or that could not be judged."""
        return [name for name, decision in self.decisions.items() if decision.decision == FAILED]

    @property
    def candidates(self) -> dict[str, str]:
        """The loops whose challenger is a candidate, and what the page says of each."""
        return {
            name: "; ".join(decision.reasons)
            for name, decision in self.decisions.items()
            if decision.decision == CANDIDATE
        }

    def noted(self, *notes: str) -> "Night":
        return self._replace(notes=(*self.notes, *notes))

    def ended(self, outcome: str, *reasons: str) -> "Night":
        return self._replace(outcome=outcome, reasons=reasons)

    def metrics(self, state: ChampionState) -> dict[str, Any]:
        """As reports/metrics/nightly.json has it, with what is in production."""
        production, candidates = (
            {
                name: {key: getattr(one, key) for key in ("run", "when", "why", "contestant", "rehearsal")}
                for name, one in champions.items()
            }
            for champions in (state.champions, state.candidates)
        )
        fields = to_json(self._replace(drift=NightDrift({})))
        named = {"decision": self.outcome, "night": self.number, "drift": self.drift.metrics()}
        return fields | named | {"champion": production, "candidates": candidates}


# ---- memory


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


class Remembered(NamedTuple):
    """The last night: its number, time of the last success (empty before the first), and the digest of all
    that it was made from. `unpushed`: its artifacts have yet to reach the remote. `recordings` is {loop:
    {path: digest}}; `hashes` is {path: [size, time of change, inode, digest]}; `idle` as of a night."""

    night: int = 0
    success: str = ""
    inputs: str = ""
    unpushed: bool = False
    recordings: Mapping[str, Mapping[str, str]] = {}
    drift: DriftMemory = DriftMemory()
    hashes: Mapping[str, list[int | str]] = {}
    idle: int = 0
