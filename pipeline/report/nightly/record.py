"""The record of a night: what .beadline/nights.json and reports/metrics/nightly.json hold, and what the page
reads."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from pipeline.report.nightly.production import ChampionState
from pipeline.report.shared import night as drift_records
from pipeline.report.shared.night import NightDrift

if TYPE_CHECKING:  # it imports scipy, and a night with nothing new is done without
    from pipeline.statistics import Paired

PROMOTED, KEPT, FIRST = "promoted", "kept", "first champion"
# how a night ends; PROMOTED and KEPT too
FAILED, QUARANTINED, NOTHING_NEW = "failed", "quarantined", "nothing new"

# ---- what was decided


class Guard(NamedTuple):
    """A guard's figure of champion and challenger, less is better, and how much more is allowed. None: there
    is no champion to compare with, or no figure."""

    champion: float | None
    challenger: float | None
    allowed: float | None


class LoopDecision(NamedTuple):
    """What was decided of one loop's challenger, and why: promoted, kept or first champion. `paired` is the
    test of challenger against champion, None where they were not compared. `guards` go by name, None where
    nothing was judged."""

    decision: str
    reasons: list[str]
    paired: "Paired | None" = None
    guards: Mapping[str, Guard] | None = None

    @property
    def promotes(self) -> bool:
        return self.decision in (PROMOTED, FIRST)

    @classmethod
    def read(cls, fields: Mapping[str, Any]) -> "LoopDecision":
        guards = {
            name: Guard(*(figures.get(key) for key in Guard._fields))
            for name, figures in fields.get("guards", {}).items()
        }
        return cls(fields["decision"], fields["reasons"], _paired(fields.get("paired")), guards)

    def written(self) -> dict[str, Any]:
        fields: dict[str, Any] = {"decision": self.decision, "reasons": self.reasons}
        if self.paired:
            fields["paired"] = self.paired._asdict()
        if self.guards is not None:
            # a first champion has a challenger's figure alone
            keys = Guard._fields if self.paired else ("challenger",)
            fields["guards"] = {
                name: {key: getattr(guard, key) for key in keys} for name, guard in self.guards.items()
            }
        return fields


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
    reach the remote, and how long it took in s (None while it runs).
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
        later = {"commit": self.commit, "unpushed": self.unpushed}
        fields |= {name: value for name, value in later.items() if value}
        return fields | ({} if self.seconds is None else {"seconds": self.seconds})

    def metrics(self, state: ChampionState) -> dict[str, Any]:
        """As reports/metrics/nightly.json has it, with what is in production."""
        production = {
            name: {"run": champion.run, "when": champion.when, "why": champion.why}
            for name, champion in state.champions.items()
        }
        return {
            "decision": self.outcome,
            "reasons": list(self.reasons),
            "decisions": self._decisions_written(),
            "drift": self.drift_written(),
            "champion": production,
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
