"""Checks new recordings before anything learns from them. A recording that cannot be read or has a recording
mistake is quarantined; a change since the champion was made is drift."""

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
    """Compares new recordings {loop: paths} with those of each loop's champion; `champions`: the loops that
    have one. `memory` is that of the run before, and is updated for the next run. A loop's alarms do not
    concern other loops. If there is no new recording, the last alarms are still valid."""
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
        # recordings of each loop since its alarm: a person may accept these as the new normal
        raised = [a.recording for a in drift.alarms if a.loop == name and a.kind != SENSOR]
        drifted[name] = list(dict.fromkeys([*drifted.get(name, []), *raised])) if raised else []
    drift.alarms = sort_alarms(drift.alarms)
    memory.pending = [alarm.key for alarm in (*drift.watched, *drift.alarms)]
    memory.alarms, memory.drifted, memory.recent = drift.alarms, drifted, recent
    return drift


def reference(loop: NightlyLoop, folder: Path, only: Sequence[str] = ()) -> dict[str, Any] | None:
    """Returns the content of champion/<loop>/reference.json: results of a challenger's own recordings with
    its own model. Figures of a night are meaningful only if compared with nights that are known to be good.
    `only`: these recordings, or prints, if any are named. Returns None if the loop has no recordings, or too
    short ones."""
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
    """Returns the camera's figures in reference.json."""
    path = folder / REFERENCE
    return artifacts.read_json(path).get("camera", []) if path.exists() else []


def _learns_from(loop: NightlyLoop) -> bool:
    source = params.value("generate_probing.source", one_of=("simulated", "recordings"))
    return bool(loop.recordings) and source == "recordings"
