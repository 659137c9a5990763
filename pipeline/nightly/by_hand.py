"""Manual changes of production: back to an earlier champion, or accepting a drift as the new normal."""

import contextlib
import datetime
from collections.abc import Callable, Generator

from pipeline.nightly import champion, landing, remembered, screening, watch, worktree
from pipeline.nightly.landing import Landing
from pipeline.nightly.records import DRIFT_ACCEPTED, ROLLED_BACK, ChampionState, to_json
from pipeline.nightly.settings import Nightly
from pipeline.nightly.worktree import COPY, Snapshot
from pipeline.store import artifacts, params


def named(word: str) -> tuple[str, str]:
    """(run, loop), each "" if it is not named, of RUN, LOOP, LOOP/RUN or the tag production/LOOP/RUN."""
    loop, slash, run = word.removeprefix("production/").rpartition("/")
    if not slash and run in champion.read().champions:
        return "", run
    return run, loop


def rollback(run: str, loop: str, *, dry_run: bool = False) -> str:
    """Puts the identical champion of an earlier run back into production, and returns what was done. With
    `dry_run`, returns what would be done and changes nothing."""
    params.load(Nightly, "nightly")
    if dry_run:
        earlier = champion.find_earlier(champion.read(), run, loop)
        names = ", ".join(f"{name} would be {former.run}" for name, former in earlier.items())
        return f"rollback, dry run: {names} again; nothing was changed"
    with _alone() as state:
        earlier = champion.find_earlier(state, run, loop)
        when = watch.stamp(datetime.datetime.now(datetime.UTC))

        def change(state: ChampionState) -> ChampionState:
            for name, former in earlier.items():
                champion.bring(name, former)
                again = former._replace(why=f"rolled back to {former.run} by hand", since=when)
                state = champion.promote(state, name, again, event=ROLLED_BACK, when=when, why="by hand")
            return state

        names = ", ".join(f"{name} is {former.run}" for name, former in earlier.items())
        made = _change(state, change, f"rollback: {names}")
        return f"rollback: {names} again, every file as it was; commit {made[:12]}"


def accept(loop: str, why: str) -> str:
    """Makes a new reference for the champion from the recordings since the drift, and commits it with the
    reason; the champion itself is kept. Raises ValueError if the loop has no alarm, or if these recordings
    are too short or gone."""
    settings = params.load(Nightly, "nightly")
    with _alone() as state:
        memory = remembered.read()
        recordings = memory.drifted.get(loop, [])
        if loop not in state.champions or not recordings:
            names = ", ".join(name for name, paths in memory.drifted.items() if paths) or "none"
            raise ValueError(
                f"{loop}: expected a loop with a champion and a drift alarm, found none; "
                f"loops with an alarm: {names}"
            )
        reference = screening.reference(settings.loops[loop], champion.FOLDER / loop, only=recordings)
        if reference is None:
            raise ValueError(
                f"{', '.join(recordings)}: too short, or gone, to hold later nights against; "
                "record a longer shift, and run a night first"
            )
        when = watch.stamp(datetime.datetime.now(datetime.UTC))

        def change(state: ChampionState) -> ChampionState:
            champion.bring(loop, state.champions[loop])
            folder, files = champion.hand_over(loop, [], {screening.REFERENCE: reference})
            present = state.champions[loop]._replace(folder=folder, files=files)
            return champion.promote(state, loop, present, event=DRIFT_ACCEPTED, when=when, why=why)

        made = _change(state, change, f"drift accepted: {loop}: {why}")
        memory.alarms, memory.pending, memory.drifted[loop] = [], [], []
        remembered.write(memory)
        return f"{loop}: the champion is held against {', '.join(recordings)} from now on; commit {made[:12]}"


@contextlib.contextmanager
def _alone() -> Generator[ChampionState]:
    """Holds the lock, repairs what a killed run left, and gives the state of production."""
    with worktree.locked():
        landing.get_branch()
        worktree.clear_killed()
        landing.finish()
        champion.follow()
        try:
            yield champion.read()
        finally:
            worktree.remove()


def _change(state: ChampionState, change: Callable[[ChampionState], ChampionState], message: str) -> str:
    """Changes production in a copy, puts the change into the project, and returns the commit."""
    snapshot = worktree.take()
    worktree.make_bare(Snapshot(snapshot.head, snapshot.head))
    with contextlib.chdir(COPY):
        state = change(state)
        artifacts.write_json(champion.FILE, to_json(state))
        paths = champion.paths(state)
    made = landing.commit(paths, message, [snapshot.head])
    landing.land(Landing(made, landing.get_branch(), snapshot.head, snapshot.files, {}), message)
    landing.finish()
    return made
