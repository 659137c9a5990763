"""What the job remembers from night to night: .beadline/last.json. Losing it costs one repeated night."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from pipeline.nightly.processes import STATE
from pipeline.report.shared.night import Alarm, alarm_of, written
from pipeline.store import artifacts

LAST, METRICS = STATE / "last.json", Path("reports/metrics/nightly.json")


class DriftMemory(NamedTuple):
    """Of the last night with recordings: keys of what was watched or raised an alarm, and its alarms.
    `drifted` are the recordings of each loop since its alarm; `night` is 0 before the first."""

    pending: tuple[str, ...] = ()
    alarms: tuple[Alarm, ...] = ()
    drifted: Mapping[str, list[str]] = {}
    night: int = 0

    @classmethod
    def read(cls, fields: Mapping[str, Any]) -> "DriftMemory":
        alarms = tuple(map(alarm_of, fields.get("alarms", ())))
        pending = tuple(fields.get("pending", ()))
        return cls(pending, alarms, fields.get("drifted", {}), fields.get("night", 0))

    def written(self) -> dict[str, Any]:
        if self == DriftMemory():
            return {}
        return self._asdict() | {
            "pending": list(self.pending),
            "alarms": [written(alarm) for alarm in self.alarms],
        }


class Remembered(NamedTuple):
    """The last night: its number, time of the last success (None before the first), and the digest of all
    that it was made from. `unpushed`: its artifacts have yet to reach the remote. `recordings` is {loop:
    {path: digest}}; `hashes` is {path: [size, time of change, inode, digest]}."""

    night: int = 0
    success: str | None = None
    inputs: str | None = None
    unpushed: bool = False
    recordings: Mapping[str, Mapping[str, str]] = {}
    drift: DriftMemory = DriftMemory()
    hashes: Mapping[str, list] = {}

    @classmethod
    def read(cls, fields: Mapping[str, Any]) -> "Remembered":
        return cls(
            night=int(fields["night"]),
            success=fields.get("success"),
            inputs=fields.get("inputs"),
            unpushed=fields.get("unpushed", False),
            recordings=fields.get("recordings", {}),
            drift=DriftMemory.read(fields.get("drift", {})),
            hashes=fields.get("hashes", {}),
        )

    def written(self) -> dict[str, Any]:
        return self._asdict() | {"drift": self.drift.written()}


def last() -> Remembered:
    """The last night as the job itself remembers it; on a fresh clone, as the committed metrics do."""
    if LAST.exists():
        return Remembered.read(artifacts.read_json(LAST))
    if METRICS.exists():
        metrics = artifacts.read_json(METRICS)
        return Remembered(night=int(metrics["night"]), success=metrics["when"])
    return Remembered()


def remember(night: Remembered) -> None:
    artifacts.write_json(LAST, night.written())
