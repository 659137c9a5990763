"""The records of the nightly job: what a night found of drift, what is in production, and what was decided.

.beadline/nights.json, reports/metrics/nightly.json and champion.json hold them, and the page reads them.
"""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from pipeline.verdict.verdict import Verdict

if TYPE_CHECKING:  # it imports scipy, and a night with nothing new is done without
    from pipeline.statistics import Paired

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

    @classmethod
    def read(cls, entry: Mapping[str, Any]) -> "Alarm":
        """An alarm as `to_json` gave it. If somebody edited the file, a missing field is empty."""
        return cls(
            str(entry.get("loop", "")),
            str(entry.get("key", "")),
            str(entry.get("recording", "")),
            str(entry.get("cause", "")),
            entry.get("sigmas", 0.0),
            tuple(entry.get("consequences", ())),
            str(entry.get("kind", "")),
            str(entry.get("channel", "")),
        )

    def to_json(self) -> dict[str, Any]:
        fields = {
            key: value for key, value in self._asdict().items() if value or key not in ("kind", "channel")
        }
        return fields | {"consequences": list(self.consequences)}


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
    empty where it was."""

    parameters: Mapping[str, ParameterChange]
    innovation: Mapping[str, InnovationChange] = {}
    closed_loop: Mapping[str, ClosedLoopChange] = {}
    not_applicable: str = ""

    @classmethod
    def read(cls, fields: Mapping[str, Any]) -> "RecordingFigures":
        loop = fields.get("closed_loop") or {}
        return cls(
            {name: ParameterChange(**change) for name, change in (fields.get("parameters") or {}).items()},
            {name: InnovationChange(**change) for name, change in (fields.get("innovation") or {}).items()},
            {name: ClosedLoopChange(**moved) for name, moved in loop.items() if isinstance(moved, dict)},
            loop.get("not_applicable") or "",
        )

    def to_json(self) -> dict[str, Any]:
        loop: dict[str, Any] = {name: moved._asdict() for name, moved in self.closed_loop.items()}
        return {
            "parameters": {name: change._asdict() for name, change in self.parameters.items()},
            "innovation": {name: change._asdict() for name, change in self.innovation.items()},
            "closed_loop": {"not_applicable": self.not_applicable} if self.not_applicable else loop,
        }


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

    def to_json(self) -> dict[str, Any]:
        """As reports/metrics/nightly.json and .beadline/nights.json have it."""
        return {
            "alarms": [alarm.to_json() for alarm in self.alarms],
            "watched": [alarm.to_json() for alarm in self.watched],
            "figures": {path: figures.to_json() for path, figures in self.figures.items()},
            "notes": self.notes,
        }

    @classmethod
    def read(cls, drift: Mapping[str, Any] | None) -> "NightDrift":
        """The record that `to_json` gave; empty if a night measured none."""
        night, drift = cls({}), drift or {}
        for key in ("alarms", "watched"):
            for alarm in map(Alarm.read, drift.get(key) or []):
                loop = night.loops.setdefault(alarm.loop, LoopDrift.none(alarm.loop))
                getattr(loop, key).append(alarm)
        for path, figures in (drift.get("figures") or {}).items():
            plant = night.loops.setdefault(PLANT, LoopDrift.none(PLANT))
            plant.figures[path] = RecordingFigures.read(figures)
        return night


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

    @classmethod
    def read(cls, fields: Mapping[str, Any]) -> "Lineage":
        lineage = cls(**{name: fields[name] for name in cls._fields if name in fields})
        return lineage._replace(uncommitted=tuple(lineage.uncommitted))

    def to_json(self) -> dict[str, Any]:
        return self._asdict() | {"uncommitted": list(self.uncommitted)}


class Installed(NamedTuple):
    """The files of champion/<loop>: what DVC's pointer says of the folder, MD5 by path, and of the outs of
    dvc.lock that they were copied from."""

    folder: Mapping[str, Any]
    files: Mapping[str, str] = {}
    outs: Mapping[str, str] = {}


class ChampionMetrics(NamedTuple):
    """What the judge measured of a champion when it was promoted: the panel's name, mean cost of its cases
    (None where one of them fails), and {guard: figure}."""

    panel: str
    mean_cost: float | None
    guards: Mapping[str, float]


class Champion(NamedTuple):
    """One loop's champion: the night that promoted it, when and why, its files, figures and lineage. `since`
    is the time of a rollback to it, empty where there was none.

    `contestant` is the controller that runs, by its name on the pages; of earlier versions it is empty.
    `rehearsal`: it was judged on simulated data alone. `verdict` is what the page said of it then. A
    candidate is written alike: a challenger that the page's rules kept out of production.
    """

    run: str
    when: str
    why: str
    installed: Installed
    metrics: ChampionMetrics | None = None
    lineage: Lineage = Lineage()
    since: str = ""
    contestant: str = ""
    rehearsal: bool = False
    verdict: str = ""

    @property
    def md5(self) -> str:
        """DVC's hash of the whole folder."""
        return self.installed.folder["md5"]

    @classmethod
    def read(cls, fields: Mapping[str, Any]) -> "Champion":
        metrics = fields.get("metrics")
        return cls(
            fields["run"],
            fields["when"],
            fields.get("why", ""),
            Installed(fields["folder"], fields.get("files", {}), fields.get("outs", {})),
            ChampionMetrics(metrics["panel"], metrics["mean_cost"], metrics["guards"]) if metrics else None,
            Lineage.read(fields.get("lineage", {})),
            fields.get("since", ""),
            fields.get("contestant", ""),
            fields.get("rehearsal", False),
            fields.get("verdict", ""),
        )

    def to_json(self) -> dict[str, Any]:
        return {
            "run": self.run,
            "when": self.when,
            "why": self.why,
            **self.installed._asdict(),
            "metrics": self.metrics._asdict() if self.metrics else {},
            "lineage": self.lineage.to_json(),
        } | self._nonempty("since", "contestant", "rehearsal", "verdict")

    def _nonempty(self, *names: str) -> dict[str, Any]:
        return {name: value for name in names if (value := getattr(self, name))}


class HistoryLine(NamedTuple):
    """One change of production: which loop, what happened, when and why, and the champion from then on.
    `before` is the run of the champion until then, None where there was none. `replaced` are the files of
    the champion that a rollback took out, MD5 by path."""

    run: str
    loop: str
    event: str
    when: str
    why: str
    before: str | None
    champion: Champion
    replaced: Mapping[str, str] | None = None

    @classmethod
    def read(cls, fields: Mapping[str, Any]) -> "HistoryLine":
        plain = (fields[name] for name in ("run", "loop", "event", "when", "why", "before"))
        return cls(*plain, Champion.read(fields["champion"]), fields.get("replaced"))

    def to_json(self) -> dict[str, Any]:
        fields = self._asdict() | {"champion": self.champion.to_json()}
        if self.replaced is None:
            del fields["replaced"]
        return fields


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
        return {
            **self.champions,
            **{candidate_of(loop): candidate for loop, candidate in self.candidates.items()},
        }

    @classmethod
    def read(cls, fields: Mapping[str, Any]) -> "ChampionState":
        """Raises ValueError where the file lacks a field that production cannot be known without."""
        try:
            champions = {loop: Champion.read(entry) for loop, entry in fields["champions"].items()}
            candidates = {
                loop: Champion.read(entry) for loop, entry in (fields.get("candidates") or {}).items()
            }
            return cls(champions, tuple(map(HistoryLine.read, fields["history"])), candidates)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                "champion.json: expected champions and history, each with run, when and folder, "
                f"found no {error}; take the file of the last good commit (git log champion.json)"
            ) from None

    def to_json(self) -> dict[str, Any]:
        candidates = {loop: candidate.to_json() for loop, candidate in self.candidates.items()}
        return {
            "schema": "champion",
            "version": 1,
            "champions": {loop: champion.to_json() for loop, champion in self.champions.items()},
            "history": [line.to_json() for line in self.history],
        } | ({"candidates": candidates} if candidates else {})


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
    `paired` is the test of challenger against champion, None where they were not compared. `guards` go by
    name, None where nothing was judged. `verdict` is the page's on this loop, None where it has no page."""

    decision: str
    reasons: list[str]
    paired: "Paired | None" = None
    guards: Mapping[str, Guard] | None = None
    verdict: Verdict | None = None

    @property
    def promotes(self) -> bool:
        return self.decision in (PROMOTED, FIRST)

    @classmethod
    def read(cls, fields: Mapping[str, Any]) -> "LoopDecision":
        guards = {
            name: Guard(*(figures.get(key) for key in Guard._fields))
            for name, figures in fields.get("guards", {}).items()
        }
        page = fields.get("verdict")
        verdict = Verdict.read(page.get("loop", ""), page) if page else None
        return cls(fields["decision"], fields["reasons"], _paired(fields.get("paired")), guards, verdict)

    def to_json(self) -> dict[str, Any]:
        fields: dict[str, Any] = {"decision": self.decision, "reasons": self.reasons}
        if self.paired:
            fields["paired"] = self.paired._asdict()
        if self.guards is not None:
            # a first champion has a challenger's figure alone
            keys = Guard._fields if self.paired else ("challenger",)
            fields["guards"] = {
                name: {key: _finite(getattr(guard, key)) for key in keys}
                for name, guard in self.guards.items()
            }
        if self.verdict:
            fields["verdict"] = {"loop": self.verdict.loop, **self.verdict.metrics()}
        return fields


def _finite(figure: float | None) -> float | None:
    """JSON knows no infinity."""
    return figure if figure is not None and math.isfinite(figure) else None


def _placed(champion: Champion) -> dict[str, Any]:
    """A champion or a candidate as the night's metrics have it."""
    names = ("run", "when", "why", "contestant", "rehearsal")
    return {name: getattr(champion, name) for name in names}


def _paired(test: Mapping[str, Any] | None) -> "Paired | None":
    if not test:
        return None
    from pipeline.statistics import Paired

    return Paired(*(test[name] for name in Paired._fields))


# ---- the night


class Night(NamedTuple):
    """One night, as .beadline/nights.json and reports/metrics/nightly.json have it.

    Its number, name and time; how it ended, and why. What was new by loop, and whether that was held against
    the champions (`screened`). The drift of every loop, and the reason of each recording that was set aside.
    What was decided of each loop, and which were promoted. The commit, whether its artifacts have yet to
    reach the remote, and how long it took in s (None while it runs). The branch that its promotions wait on,
    empty where they are in production.
    """

    number: int
    run: str
    when: str
    outcome: str = ""
    reasons: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    new_recordings: Mapping[str, list[str]] = {}
    screened: bool = False
    drift: NightDrift = NightDrift({})
    quarantined: Mapping[str, str] = {}
    decisions: Mapping[str, LoopDecision] = {}
    promoted: tuple[str, ...] = ()
    commit: str = ""
    unpushed: bool = False
    seconds: float | None = None
    branch: str = ""

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

    def without_measurement(self) -> "Night":
        """The night before its recordings were looked at; what was set aside stays set aside."""
        notes = tuple(note for note in self.notes if note not in self.drift.notes)
        return self._replace(new_recordings={}, screened=False, drift=NightDrift({}), notes=notes)

    @classmethod
    def read(cls, fields: Mapping[str, Any]) -> "Night":
        decisions = {name: LoopDecision.read(entry) for name, entry in fields.get("decisions", {}).items()}
        return cls(
            number=fields["night"],
            run=fields["run"],
            when=fields["when"],
            outcome=fields["outcome"],
            reasons=tuple(fields.get("reasons", ())),
            notes=tuple(fields.get("notes", ())),
            new_recordings=fields.get("new_recordings", {}),
            screened="drift" in fields,
            drift=NightDrift.read(fields.get("drift")),
            quarantined=fields.get("quarantined", {}),
            decisions=decisions,
            promoted=tuple(fields.get("promoted", ())),
            commit=fields.get("commit", ""),
            unpushed=fields.get("unpushed", False),
            seconds=fields.get("seconds"),
            branch=fields.get("branch", ""),
        )

    def to_json(self) -> dict[str, Any]:
        """As .beadline/nights.json has it: what the night did not come to is not there."""
        fields = {"night": self.number, "run": self.run, "when": self.when, "outcome": self.outcome}
        fields["notes"] = list(self.notes)
        if self.screened or self.new_recordings:
            fields["new_recordings"] = dict(self.new_recordings)
        if self.screened:
            fields["drift"] = self.drift.to_json()
        if self.screened or self.quarantined:
            fields["quarantined"] = dict(self.quarantined)
        if self.decisions:
            fields["decisions"] = self._decisions()
            fields["promoted"] = list(self.promoted)
        fields["reasons"] = list(self.reasons)
        later = {"commit": self.commit, "unpushed": self.unpushed, "branch": self.branch}
        fields |= {name: value for name, value in later.items() if value}
        return fields | ({} if self.seconds is None else {"seconds": self.seconds})

    def metrics(self, state: ChampionState) -> dict[str, Any]:
        """As reports/metrics/nightly.json has it, with what is in production."""
        production, candidates = (
            {name: _placed(champion) for name, champion in champions.items()}
            for champions in (state.champions, state.candidates)
        )
        return {
            "decision": self.outcome,
            "reasons": list(self.reasons),
            "decisions": self._decisions(),
            "drift": self.drift_row(),
            "champion": production,
            "candidates": candidates,
            "night": self.number,
            "run": self.run,
            "when": self.when,
            "seconds": self.seconds,
            "notes": list(self.notes),
            "new_recordings": dict(self.new_recordings),
            "quarantined": dict(self.quarantined),
        }

    def drift_row(self) -> dict[str, Any]:
        return self.drift.to_json() if self.screened else {}

    def _decisions(self) -> dict[str, Any]:
        return {name: decision.to_json() for name, decision in self.decisions.items()}
