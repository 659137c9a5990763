"""A change that is meant to stay: what the champion is held against becomes the recordings of the nights that
raised the alarm; the champion itself stays as it is."""

import datetime
from pathlib import Path

from pipeline.nightly import champion, guarding, remembered, screening, watch
from pipeline.nightly.processes import check_attached, commit, dvc
from pipeline.nightly.records import DRIFT_ACCEPTED
from pipeline.nightly.settings import Nightly, NightlyLoop
from pipeline.store import artifacts, params


def accept(loop: str, why: str) -> str:
    """Measures the champion's reference anew from the recordings since the drift, and commits it with the
    reason. Raises ValueError where the loop has no alarm."""
    settings = params.load(Nightly, "nightly")
    with guarding.alone():
        check_attached()
        state, last = champion.read(), remembered.last()
        recordings = last.drift.drifted.get(loop, [])
        if loop not in state.champions or not recordings:
            names = ", ".join(name for name, paths in last.drift.drifted.items() if paths) or "none"
            raise ValueError(
                f"{loop}: expected a loop with a champion and a drift alarm, found none; "
                f"loops with an alarm: {names}"
            )
        folder = champion.FOLDER / loop
        _refer(settings.loops[loop], folder, recordings)
        files = state.champions[loop].installed._replace(
            folder=champion.pointer(loop), files=champion.md5s(folder)
        )
        present = state.champions[loop]._replace(installed=files)
        when = watch.stamp(datetime.datetime.now(datetime.UTC))
        champion.write(champion.in_production(state, loop, present, event=DRIFT_ACCEPTED, when=when, why=why))
        made = commit(champion.paths(), f"drift accepted: {loop}: {why}")
        drift = last.drift._replace(alarms=(), pending=(), drifted={**last.drift.drifted, loop: []})
        remembered.remember(last._replace(drift=drift))
        return f"{loop}: the champion is held against {', '.join(recordings)} from now on; commit {made[:12]}"


def _refer(loop: NightlyLoop, folder: Path, recordings: list[str]) -> None:
    """Writes the champion's reference from these recordings, and hands the folder to DVC."""
    reference = screening.reference(loop, folder, only=recordings)
    if reference is None:
        raise ValueError(
            f"{', '.join(recordings)}: too short, or gone, to hold later nights against; "
            "record a longer shift, and run a night first"
        )
    artifacts.write_json(folder / screening.REFERENCE, reference)
    dvc("add", "--quiet", str(folder))
