"""What a night found of drift: the record that the nightly job writes, and that the pages read."""

from collections.abc import Mapping
from typing import Any, NamedTuple

PLANT = "temperature"  # the loop whose recordings tell of the plant's parameters


class Alarm(NamedTuple):
    """A change of one loop: the key by which the next night knows it again, and the recording that shows it.
    Then its cause in words, how sure it is in sigmas, and what follows from it in words."""

    loop: str
    key: str
    recording: str
    cause: str
    sigmas: float
    consequences: tuple[str, ...] = ()


class LoopDrift(NamedTuple):
    """Of one loop: alarms, what would be one if it stayed, and the plant's figures by recording.
    `quarantined` has the reason of each recording that was set aside."""

    loop: str
    alarms: list[Alarm]
    watched: list[Alarm]
    figures: dict[str, Any]
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
        return [alarm for one in self.loops.values() for alarm in one.alarms]

    @property
    def watched(self) -> list[Alarm]:
        return [alarm for one in self.loops.values() for alarm in one.watched]

    @property
    def figures(self) -> dict[str, Any]:
        return {path: figures for one in self.loops.values() for path, figures in one.figures.items()}

    @property
    def quarantined(self) -> dict[str, str]:
        return {path: reason for one in self.loops.values() for path, reason in one.quarantined.items()}

    def written(self) -> dict[str, Any]:
        """As reports/metrics/nightly.json and .beadline/nights.json have it."""
        return {
            "alarms": [written(alarm) for alarm in self.alarms],
            "watched": [written(alarm) for alarm in self.watched],
            "figures": self.figures,
            "notes": [note for one in self.loops.values() for note in one.notes],
        }


def written(alarm: Alarm) -> dict[str, Any]:
    return alarm._asdict() | {"consequences": list(alarm.consequences)}


def alarm_of(entry: Mapping[str, Any]) -> Alarm:
    """An alarm as it was written. Of a file that somebody edited, what is missing is empty."""
    return Alarm(
        str(entry.get("loop", "")),
        str(entry.get("key", "")),
        str(entry.get("recording", "")),
        str(entry.get("cause", "")),
        entry.get("sigmas", 0.0),
        tuple(entry.get("consequences", ())),
    )


def read(drift: Mapping[str, Any] | None) -> NightDrift:
    """The record that `NightDrift.written` wrote; empty where a night measured none."""
    night, drift = NightDrift({}), drift or {}
    for key in ("alarms", "watched"):
        for alarm in map(alarm_of, drift.get(key) or []):
            loop = night.loops.setdefault(alarm.loop, LoopDrift.none(alarm.loop))
            getattr(loop, key).append(alarm)
    if drift.get("figures"):
        night.loops.setdefault(PLANT, LoopDrift.none(PLANT)).figures.update(drift["figures"])
    return night
