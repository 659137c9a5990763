"""What a night found of drift: the record that the nightly job writes, and that the pages read."""

from collections.abc import Mapping
from typing import Any, NamedTuple

PLANT = "temperature"  # the loop whose recordings tell of the plant's parameters


class Alarm(NamedTuple):
    """A change of one loop: the key by which the next night knows it again, and the recording that shows it.
    Then its cause in words, how many sigmas it is from no change, and what follows from it in words. `kind`
    and `channel` are the cause for a machine to read, empty where it has none: gain, time constant, delay,
    saturation, offset, noise, ambient, or several with "or" between; a signal's name, or "every input"."""

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

    def written(self) -> dict[str, Any]:
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
        return [alarm for drift in self.loops.values() for alarm in drift.alarms]

    @property
    def watched(self) -> list[Alarm]:
        return [alarm for drift in self.loops.values() for alarm in drift.watched]

    @property
    def figures(self) -> dict[str, RecordingFigures]:
        return {path: figures for drift in self.loops.values() for path, figures in drift.figures.items()}

    @property
    def quarantined(self) -> dict[str, str]:
        return {path: reason for drift in self.loops.values() for path, reason in drift.quarantined.items()}

    def written(self) -> dict[str, Any]:
        """As reports/metrics/nightly.json and .beadline/nights.json have it."""
        return {
            "alarms": [written(alarm) for alarm in self.alarms],
            "watched": [written(alarm) for alarm in self.watched],
            "figures": {path: figures.written() for path, figures in self.figures.items()},
            "notes": [note for drift in self.loops.values() for note in drift.notes],
        }


def written(alarm: Alarm) -> dict[str, Any]:
    named = {key: value for key, value in alarm._asdict().items() if value or key not in ("kind", "channel")}
    return named | {"consequences": list(alarm.consequences)}


def alarm_of(entry: Mapping[str, Any]) -> Alarm:
    """An alarm as it was written. Of a file that somebody edited, what is missing is empty."""
    return Alarm(
        str(entry.get("loop", "")),
        str(entry.get("key", "")),
        str(entry.get("recording", "")),
        str(entry.get("cause", "")),
        entry.get("sigmas", 0.0),
        tuple(entry.get("consequences", ())),
        str(entry.get("kind", "")),
        str(entry.get("channel", "")),
    )


def read(drift: Mapping[str, Any] | None) -> NightDrift:
    """The record that `NightDrift.written` wrote; empty where a night measured none."""
    night, drift = NightDrift({}), drift or {}
    for key in ("alarms", "watched"):
        for alarm in map(alarm_of, drift.get(key) or []):
            loop = night.loops.setdefault(alarm.loop, LoopDrift.none(alarm.loop))
            getattr(loop, key).append(alarm)
    for path, figures in (drift.get("figures") or {}).items():
        plant = night.loops.setdefault(PLANT, LoopDrift.none(PLANT))
        plant.figures[path] = RecordingFigures.read(figures)
    return night
