"""The record of a night: what .beadline/nights.json and reports/metrics/nightly.json hold, and what the page
reads."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from pipeline.report.nightly.production import Champion, ChampionState
from pipeline.report.shared import night as drift_records
from pipeline.report.shared.night import NightDrift
from pipeline.verdict.verdict import Verdict

if TYPE_CHECKING:  # it imports scipy, and a night with nothing new is done without
    from pipeline.statistics import Paired

PROMOTED, KEPT, FIRST = "promoted", "kept", "first champion"
CANDIDATE = "candidate"  # of a challenger that does not pass the page's rules of its loop
# how a night ends; PROMOTED, KEPT and CANDIDATE too
FAILED, QUARANTINED, NOTHING_NEW = "failed", "quarantined", "nothing new"

# ---- what was decided


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

    def written(self) -> dict[str, Any]:
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
        return self._replace(new_recordings={}, screened=False, drift=NightDrift({}))

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
            drift=drift_records.read(fields.get("drift")),
            quarantined=fields.get("quarantined", {}),
            decisions=decisions,
            promoted=tuple(fields.get("promoted", ())),
            commit=fields.get("commit", ""),
            unpushed=fields.get("unpushed", False),
            seconds=fields.get("seconds"),
            branch=fields.get("branch", ""),
        )

    def written(self) -> dict[str, Any]:
        """As .beadline/nights.json has it: what the night did not come to is not there."""
        fields = {"night": self.number, "run": self.run, "when": self.when, "outcome": self.outcome}
        fields["notes"] = list(self.notes)
        if self.screened or self.new_recordings:
            fields["new_recordings"] = dict(self.new_recordings)
        if self.screened:
            fields["drift"] = self.drift.written()
        if self.screened or self.quarantined:
            fields["quarantined"] = dict(self.quarantined)
        if self.decisions:
            fields["decisions"] = self._decisions_written()
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
            "decisions": self._decisions_written(),
            "drift": self.drift_written(),
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

    def drift_written(self) -> dict[str, Any]:
        return self.drift.written() if self.screened else {}

    def _decisions_written(self) -> dict[str, Any]:
        return {name: decision.written() for name, decision in self.decisions.items()}
