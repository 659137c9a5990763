"""New recordings before anything learns from them: what cannot be read or is not what it says goes to
quarantine; what has changed since the champion was made is drift."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.nightly import champion, pictures, temperature_drift
from pipeline.nightly.records import SENSOR, Memory, NightDrift, sort_alarms
from pipeline.nightly.settings import Nightly, NightlyLoop
from pipeline.nightly.temperature_drift import REFERENCE
from pipeline.store import artifacts, params


def look(
    settings: Nightly, champions: Collection[str], new: Mapping[str, Sequence[str]], memory: Memory
) -> NightDrift:
    """New recordings {loop: paths} held against those of each loop's champion; `champions` are the loops that
    have one. `memory`, that of the night before, then has what the next night must know of this one. A loop's
    alarms say nothing of another loop. If nothing was recorded, what was found last still stands."""
    drift = NightDrift()
    if not new:
        drift.alarms += memory.alarms
        return drift
    recent, drifted = dict(memory.recent), dict(memory.drifted)
    for name, paths in new.items():
        loop, own, limits = settings.loops[name], champion.FOLDER / name, settings.drift
        if loop.judge == "temperature" and _learns_from(loop):
            present = own if name in champions else None
            recent[name] = temperature_drift.look(
                drift, limits, name, loop.recordings, paths, present, memory
            )
        elif loop.judge == "deposition":
            pictures.find_trials_drift(drift, limits, name, paths, _read(own), memory.pending)
        elif loop.judge == "setpoint":
            pictures.find_prints_drift(
                drift, limits, name, loop.recordings, paths, own, _read(own), memory.pending
            )
        # what each loop recorded since its alarm: a person may accept that as how things are
        raised = [a.recording for a in drift.alarms if a.loop == name and a.kind != SENSOR]
        drifted[name] = list(dict.fromkeys([*drifted.get(name, []), *raised])) if raised else []
    drift.alarms = sort_alarms(drift.alarms)
    memory.pending = [alarm.key for alarm in (*drift.watched, *drift.alarms)]
    memory.alarms, memory.drifted, memory.recent = drift.alarms, drifted, recent
    return drift


def reference(loop: NightlyLoop, folder: Path, only: Sequence[str] = ()) -> dict[str, Any] | None:
    """What the recordings that a challenger was made of say of its own model, for
    champion/<loop>/reference.json: a night's figures mean something only beside those of nights that are
    known to be good; `only` these recordings, or prints, if any are named. None if the loop has no
    recordings, or too short ones."""
    if not loop.recordings or not Path(loop.recordings).is_dir():
        return None
    if loop.judge in ("deposition", "setpoint"):
        recordings, most = Path(loop.recordings), temperature_drift.NIGHTS
        rows = (
            pictures.of_trials(recordings, most, only)
            if loop.judge == "deposition"
            else pictures.of_prints(recordings, folder, most, only)
        )
        return {"schema": "reference", "version": 1, "camera": rows} if rows else None
    if loop.judge != "temperature" or not _learns_from(loop):
        return None
    return temperature_drift.reference(loop, folder, only)


def _read(folder: Path) -> list[Any]:
    """What reference.json says of the camera."""
    path = folder / REFERENCE
    return artifacts.read_json(path).get("camera", []) if path.exists() else []


def _learns_from(loop: NightlyLoop) -> bool:
    source = params.value("generate_probing.source", one_of=("simulated", "recordings"))
    return bool(loop.recordings) and source == "recordings"
