"""A change that is meant to stay: what the champion is held against becomes the recordings of the nights that
raised the alarm; the champion itself stays as it is."""

import datetime

from pipeline.nightly import champion, guarding, screening, watch
from pipeline.nightly.processes import commit, dvc
from pipeline.nightly.settings import Nightly
from pipeline.store import artifacts, params


def accept(loop: str, why: str) -> str:
    """Measures the champion's reference anew from the recordings since the drift, and commits it with the
    reason. Raises ValueError where the loop has no alarm."""
    settings = params.load(Nightly, "nightly")
    with guarding.alone():
        state, remembered = champion.read(), watch.last()
        recordings = remembered.get("drift", {}).get("drifted", {}).get(loop, [])
        if loop not in state["champions"] or not recordings:
            drifted = remembered.get("drift", {}).get("drifted", {})
            names = ", ".join(name for name, paths in drifted.items() if paths) or "none"
            raise ValueError(
                f"{loop}: expected a loop with a champion and a drift alarm, found none; "
                f"loops with an alarm: {names}"
            )
        folder = champion.FOLDER / loop
        reference = screening.reference(settings.loops[loop], folder, only=recordings)
        if reference is None:
            raise ValueError(
                f"{', '.join(recordings)}: too short, or gone, to hold later nights against; "
                "record a longer shift, and run a night first"
            )
        artifacts.write_json(folder / screening.REFERENCE, reference)
        dvc("add", "--quiet", str(folder))
        entry = state["champions"][loop] | {"folder": champion.pointer(loop), "files": champion.md5s(folder)}
        state = champion.promoted(state, loop, entry, event="drift accepted")
        state["history"][-1] |= {"when": watch.stamp(datetime.datetime.now(datetime.UTC)), "why": why}
        artifacts.write_json(champion.FILE, state)
        memory = remembered["drift"] | {
            "alarms": [],
            "pending": [],
            "drifted": remembered["drift"]["drifted"] | {loop: []},
        }
        made = commit(champion.paths(), f"drift accepted: {loop}: {why}")
        artifacts.write_json(watch.LAST, remembered | {"drift": memory})
        return f"{loop}: the champion is held against {', '.join(recordings)} from now on; commit {made[:12]}"
