"""New recordings before anything learns from them: what cannot be read or is not what it says goes to
quarantine; what has changed since the champion was made is drift."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pipeline.nightly import champion, pictures, temperature_drift
from pipeline.nightly.records import SENSOR, DriftMemory, LoopDrift, NightDrift
from pipeline.nightly.settings import Nightly, NightlyLoop
from pipeline.nightly.temperature_drift import REFERENCE
from pipeline.store import artifacts, params


class Screening(NamedTuple):
    """Of one night: the drift of every loop, and what the next night must remember of it."""

    drift: NightDrift
    memory: DriftMemory


def look(
    settings: Nightly,
    champions: Collection[str],
    new: Mapping[str, Mapping[str, str]],
    memory: DriftMemory,
    *,
    night: int,
) -> Screening:
    """New recordings {loop: {path: digest}} held against those of each loop's champion; `champions` are the
    loops that have one, `memory` is that of the night before. A loop's alarms say nothing of another loop."""
    loops, recent = {}, dict(memory.recent)
    for name in settings.loops:
        paths = list(new.get(name, ()))
        loops[name], remembered = _loop_drift(settings, name, paths, memory, has_champion=name in champions)
        if remembered is not None:
            recent[name] = remembered
    drift = NightDrift(loops)
    if not any(new.values()):
        # nothing was recorded: what was found last still stands
        for alarm in memory.alarms:
            loops.setdefault(alarm.loop, LoopDrift.none(alarm.loop)).alarms.append(alarm)
        return Screening(drift, memory)
    # what each loop recorded since its alarm: a person may accept that as how things are
    since = dict(memory.drifted)
    for name in (name for name, recorded in new.items() if recorded):
        raised = [alarm.recording for alarm in drift.of(name).alarms if alarm.kind != SENSOR]
        since[name] = list(dict.fromkeys([*since.get(name, []), *raised])) if raised else []
    keys = tuple(alarm.key for alarm in (*drift.watched, *drift.alarms))
    return Screening(drift, DriftMemory(keys, tuple(drift.alarms), since, night, recent))


def _loop_drift(
    settings: Nightly, name: str, paths: Sequence[str], memory: DriftMemory, *, has_champion: bool
) -> tuple[LoopDrift, dict[str, Any] | None]:
    """Drift of one loop by its new recordings, and what the next night must remember of it. Both are empty if
    there is no new recording, or nothing to compare it with."""
    loop, own, pending = settings.loops[name], champion.FOLDER / name, set(memory.pending)
    none = LoopDrift.none(name)
    if not paths:
        return none, None
    if loop.judge == "temperature" and loop.recordings and _recorded():
        return temperature_drift.look(
            settings.drift, name, loop.recordings, paths, own if has_champion else None, pending,
            memory.recent.get(name, {}),
        )  # fmt: skip
    if loop.judge == "deposition":
        return pictures.trials_drift(settings.drift, name, paths, _read(own), pending), None
    if loop.judge == "setpoint":
        reference = _read(own).get("camera", [])
        return pictures.prints_drift(settings.drift, name, loop.recordings, paths, reference, pending), None
    return none, None


# ---- the champion's own recordings


def reference(loop: NightlyLoop, folder: Path, only: Sequence[str] = ()) -> dict[str, Any] | None:
    """What the recordings that a challenger was made of say of its own model, for
    champion/<loop>/reference.json: a night's figures mean something only beside those of nights
    that are known to be good; `only` these recordings, or prints, where any are named. None
    where the loop has no recordings, or too short ones."""
    if not loop.recordings or not Path(loop.recordings).is_dir():
        return None
    if loop.judge in ("deposition", "setpoint"):
        figures_of = {"deposition": pictures.of_trials, "setpoint": pictures.of_prints}[loop.judge]
        rows = figures_of(Path(loop.recordings), temperature_drift.NIGHTS, only)
        return {"schema": "reference", "version": 1, "camera": rows} if rows else None
    if loop.judge != "temperature" or not _recorded():
        return None
    return temperature_drift.reference(loop, folder, only)


def _read(folder: Path) -> dict[str, Any]:
    return artifacts.read_json(folder / REFERENCE) if (folder / REFERENCE).exists() else {}


def _recorded() -> bool:
    return params.value("generate_probing.source", one_of=("simulated", "recordings")) == "recordings"
