"""One nightly run: takes new recordings, runs `dvc repro`, judges, promotes or keeps, and reports.

Exit status 0: promoted, kept, or nothing new; 1: the run failed; 3: drift alarm; 4: recordings were set
aside; 75: another run is in progress.
"""

import contextlib
import copy
import datetime
import shutil
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import stages
from pipeline.nightly import (
    champion,
    inputs,
    landing,
    records,
    remembered,
    reporting,
    reproducing,
    watch,
    worktree,
)
from pipeline.nightly.landing import Landing
from pipeline.nightly.processes import dvc, git, names
from pipeline.nightly.records import ChampionState, LoopDecision, Memory, Night, to_json
from pipeline.nightly.remembered import METRICS
from pipeline.nightly.settings import Nightly, NightlyLoop
from pipeline.nightly.worktree import COPY, Snapshot
from pipeline.store import artifacts, params

# loop -> the parameter that decides whether its recordings are used for learning
RECORDED = "recordings"
SOURCES = {
    "temperature": "generate_probing.source",
    "deposition": "train_ilc.source",
    "setpoint": "train_classifier.source",
}
CUT_PERCENT = 5.0  # of a recording; more is a note


def nightly(render: reporting.Render, now: datetime.datetime | None = None) -> tuple[int, str]:
    """Returns exit status and one-line summary of a nightly run; `render` makes its page. Whatever happens,
    the run is reported."""
    started = now or datetime.datetime.now(datetime.UTC)
    try:
        with worktree.locked():
            return _run(started, render)
    except worktree.BusyError as busy:
        return reporting.BUSY, f"nightly: refused: {busy}"
    except Exception as error:  # no run may end without a report
        return reporting.last_resort(error, started)


def preview() -> str:
    """Returns, in a sentence, what a run would do now: whether there is anything to learn from, and which
    recordings are new. Changes nothing. Raises ValueError if a run would be refused."""
    last = remembered.read()
    night = Night(last.night + 1, f"night-{last.night + 1:04d}", "")
    settings = _leave_out_loops(params.load(Nightly, "nightly"), copy.copy(last), night)
    _check(settings)
    digests = inputs.contents(_list_places(settings), dict(last.hashes))
    if inputs.digest(digests) == last.inputs and not last.unpushed:
        return "nightly, dry run: no recording, parameter or code has changed; a run would do nothing"
    _find_new(settings, last, digests, night)
    new = [path for paths in night.new_recordings.values() for path in paths]
    recordings = (
        f"new recordings: {_name_few(new)}" if new else "no new recording; parameters or code changed"
    )
    return f"nightly, dry run: {recordings}; a run would learn and compare {', '.join(settings.loops)}"


def _run(now: datetime.datetime, render: reporting.Render) -> tuple[int, str]:
    clock = time.monotonic()
    last, notes = remembered.read_or_set_aside()
    number = last.night + 1
    night = Night(number, f"night-{number:04d}", watch.stamp(now), notes=notes)
    memory, settings = copy.copy(last), None
    memory.hashes = {path: stamp for path, stamp in last.hashes.items() if Path(path).exists()}
    try:
        try:
            settings = params.load(Nightly, "nightly")
        finally:  # repairs what a killed run left, whatever the parameters are
            night.notes += [*worktree.clear_killed(), *landing.finish(), *champion.follow()]
        _work(settings, last, memory, night)
    except Exception as error:  # a refusal in a sentence, or an error of this program
        night.notes += _fail(night, reporting.tell(error, night.run))
    worktree.remove()  # on a full disk, the following steps need the space
    night.seconds = round(time.monotonic() - clock, 1)
    if last.success and settings and (overdue := watch.find_overdue(now, last.success, settings.watch_h)):
        night.notes.append(f"watch: {overdue}")
    if night.outcome == records.FAILED:
        # a recording of a failed run is new again in the next one, and must not count twice
        last.hashes, memory = memory.hashes, last
    else:
        memory.unpushed, memory.idle = night.unpushed, night.idle
        # a run that lost a loop is repeated
        memory.inputs, memory.success = ("", last.success) if night.lost else (memory.inputs, night.when)
    memory.night = number
    return reporting.report(night, memory, settings, render)


def _fail(night: Night, why: str) -> list[str]:
    """Records a failure, and returns the notes to add. A run that has already made its commit keeps it, and
    the next one finishes it."""
    if night.commit:
        night.unpushed = True
        return [why]
    night.decisions, night.branch = {}, ""
    night.end(records.FAILED, why)
    return []


def _work(settings: Nightly, last: Memory, memory: Memory, night: Night) -> None:
    """Does the work of a run; results go to `night` and `memory`. An exception ends the run, which keeps its
    results so far."""
    settings = _leave_out_loops(settings, memory, night)
    if not settings.loops:
        night.end(records.NOTHING_NEW, "section loops switches off every loop")
        return
    _check(settings)
    places = _list_places(settings)
    digests = inputs.contents(places, memory.hashes)

    def is_known() -> bool:
        return inputs.digest(digests) == last.inputs and not last.unpushed

    if is_known():
        _note_idle(night, last.idle + 1)
        night.end(records.NOTHING_NEW, "no recording, parameter or code has changed since the last night")
        return
    snapshot, uncommitted = worktree.take(), inputs.find_uncommitted(settings)
    worktree.make(snapshot, [*digests, *places])
    state = before = champion.read()
    with contextlib.chdir(COPY):
        for name, one in state.folders.items():
            champion.bring(name, one)
        digests = inputs.contents(places, memory.hashes)
        _find_new(settings, last, digests, night)
        _screen(settings, state, memory, night)
        digests = inputs.contents(places, memory.hashes)
    recordings = {name: inputs.recordings(digests, loop) for name, loop in settings.loops.items()}
    memory.recordings, memory.inputs = last.recordings | recordings, inputs.digest(digests)
    # recordings that were set aside in the copy must be moved out of the project, too
    moved = [path for path in night.drift.quarantined if Path(path).exists() and not (COPY / path).exists()]
    aside = {path: artifacts.sha256(path) for path in moved}
    if is_known():
        night.end(records.QUARANTINED, "all that was new is quarantined")
    else:
        lineage = {"commit": snapshot.head, "uncommitted": uncommitted}
        with contextlib.chdir(COPY):
            state = _learn(settings, state, night, lineage)
            changed = sorted(
                {name for name, _ in digests.items() ^ inputs.contents(places, memory.hashes).items()}
            )
        if changed:
            raise ValueError(
                f"{changed[0]} changed while the stages ran; nothing is changed, and the next night learns "
                "from it"
            )
    if uncommitted:
        night.notes.append(
            f"not committed: {_name_few(uncommitted)}; no commit alone makes this night's result again"
        )
    _land(settings, night, before, state, snapshot, places, aside)
    _push(settings, night)


# ---- before the stages


def _list_places(settings: Nightly) -> list[str]:
    """Returns the files and folders that a run reads."""
    folders = [loop.recordings for loop in settings.loops.values() if loop.recordings]
    return [*inputs.sources(), settings.holdout.recordings, *folders]


def _leave_out_loops(settings: Nightly, memory: Memory, night: Night) -> Nightly:
    """Returns the settings without the loops that section `loops` switches off. Checks every section of the
    parameters."""
    switches = stages.check_parameters()
    loops = {name: loop for name, loop in settings.loops.items() if switches.get(name, True)}
    if off := [name for name in settings.loops if name not in loops]:
        night.notes.append(f"no part of the night, by section loops: {', '.join(off)}")
    memory.alarms = [alarm for alarm in memory.alarms if alarm.loop not in off]
    return settings.model_copy(update={"loops": loops})


def _check(settings: Nightly) -> None:
    """Raises ValueError if the run cannot succeed: too little disk space, broken stage files, or a wrong
    branch."""
    free = shutil.disk_usage(Path()).free / 1e6
    if free < settings.least_free_mb:
        raise ValueError(
            f"the disk has {free:.0f} MB left, but a night needs {settings.least_free_mb:g} MB "
            "(nightly.least_free_mb); free some, or run ./run dvc gc --all-commits, which removes what no "
            "commit names"
        )
    for name in ("dvc.yaml", "dvc.lock"):
        reproducing.read_stages(name)
    if settings.promotion == "at_once":
        landing.get_branch()
    elif f"refs/heads/{settings.branch}" == git("symbolic-ref", "-q", "HEAD", check=False):
        raise ValueError(
            f"nightly.branch: expected a branch apart from the one that is in production, found "
            f"{settings.branch}, which is checked out; git switch to the other one, or name another branch"
        )


def _note_idle(night: Night, nights: int) -> None:
    night.idle = nights
    running = f" for {nights} nights" if nights > 1 else ""
    night.notes.append(f"no new recording{running}: drift was not measured")


def _find_new(settings: Nightly, last: Memory, digests: Mapping[str, str], night: Night) -> None:
    """Finds the recordings of each loop that are new since the last run; if there are none, notes for how
    many runs."""
    for name, loop in settings.loops.items():
        known = last.recordings.get(name, {}).values()
        recordings = inputs.recordings(digests, loop).items()
        if new := sorted(path for path, content in recordings if content not in known):
            night.new_recordings[name] = new
            night.notes += _tell_unused(loop, new)
    if not night.new_recordings:
        _note_idle(night, last.idle + 1)


def _tell_unused(loop: NightlyLoop, recordings: Sequence[str]) -> list[str]:
    """Returns a note if new recordings of a loop are not used for learning, and how to change that."""
    dotted = SOURCES.get(loop.judge, "")
    section, _, key = dotted.partition(".")
    source = params.read().get(section, {}).get(key, RECORDED)
    if source == RECORDED:
        return []
    are = "is" if len(recordings) == 1 else "are"
    return [
        f"{_name_few(recordings)} {are} not used, for {dotted} is {source}; "
        f"set {dotted}: {RECORDED} in {params.home(dotted)} to learn from what is recorded"
    ]


def _name_few(paths: Sequence[str]) -> str:
    """Returns "a, b, c and 2 more"."""
    return ", ".join(paths[:3]) + (f" and {len(paths) - 3} more" if len(paths) > 3 else "")


def _screen(settings: Nightly, state: ChampionState, memory: Memory, night: Night) -> None:
    """Compares new recordings with the champions'. Recordings that cannot be learned from are removed from
    the copy."""
    from pipeline.nightly import judge, screening  # they take seconds to import

    night.drift = screening.look(settings, state.champions, night.new_recordings, memory)
    new = [path for paths in night.new_recordings.values() for path in paths]
    night.used = judge.measure_shares(settings, [path for path in new if path not in night.drift.quarantined])
    night.notes += night.drift.notes
    night.notes += [
        f"{path}: {share['cut_percent']:.0f} % of it is cut, {share['used_percent']:.0f} % is used"
        for path, share in night.used.items()
        if share["cut_percent"] > CUT_PERCENT
    ]


# ---- the stages, and the judge


def _learn(
    settings: Nightly, state: ChampionState, night: Night, lineage: Mapping[str, Any]
) -> ChampionState:
    """Runs the stages in the copy, and judges the results."""
    from pipeline.nightly import promoting

    # the pages of this run show its drift, and use it in their verdicts
    artifacts.write_json(METRICS, night.metrics(state))
    for loop in settings.loops.values():
        # large recordings are DVC's: the pointer beside the folder moves with it
        if loop.recordings and Path(f"{loop.recordings}.dvc").exists():
            dvc("add", "--quiet", loop.recordings)
    logs = Path("..").resolve() / "logs"
    for old in sorted(logs.glob("*.log"))[:-60]:
        old.unlink()
    lost, notes = reproducing.reproduce(
        settings.loops, logs / f"{night.run}.log", limit_s=settings.longest_h * 3600
    )
    night.notes += notes
    night.decisions = {
        name: LoopDecision(records.FAILED, [f"failed, its champion stays: {why}"])
        for name, why in lost.items()
    }
    loops = {name: loop for name, loop in settings.loops.items() if name not in lost}
    return promoting.judge_all(settings.model_copy(update={"loops": loops}), night, state, lineage)


# ---- the commit, which is the promotion


def _land(
    settings: Nightly,
    night: Night,
    before: ChampionState,
    state: ChampionState,
    snapshot: Snapshot,
    places: Sequence[str],
    aside: Mapping[str, str],
) -> None:
    """Makes the run's commit and brings the project to it, or puts the commit on the branch of waiting
    promotions. Makes no commit if only the run's own figures changed. `aside`: {path: digest} of recordings
    to move out of the project."""
    by_branch, promoted = settings.promotion == "branch", night.promoted
    tracked = ["dvc.lock", "reports/metrics", "datasets/.gitignore", *inputs.recorded_places(settings)]
    night.branch = settings.branch if by_branch and promoted else ""
    with contextlib.chdir(COPY):
        if state != before:
            artifacts.write_json(champion.FILE, to_json(state))
            tracked += champion.paths(state)
        if not by_branch or promoted:
            artifacts.write_json(METRICS, night.metrics(state))
    loop_of = {path: name for name, paths in night.new_recordings.items() for path in paths}
    quarantined = {
        path: (loop_of[path], night.drift.quarantined[path], digest) for path, digest in aside.items()
    }
    lists = inputs.read_lists(settings, COPY)
    head = landing.check_head(snapshot, [*places, "dvc.lock", str(champion.FILE), str(champion.FOLDER)])
    outcome = f"promoted {', '.join(promoted)}" if promoted else "kept the champions"
    message = f"nightly {night.run}: {outcome}\n\n" + "\n".join(night.reasons)
    tips = _find_tips(settings) if by_branch else {}
    waiting = [tip for tip in tips.values() if git("merge-base", tip, head, check=False) != tip]
    made = landing.commit(tracked, message, [head, *dict.fromkeys(waiting)])
    figures_alone = made and {*names("diff", "--name-only", head, made)} <= {METRICS}
    if made and not figures_alone and (promoted or not by_branch):
        night.commit = made
    if night.commit and not by_branch:
        tags = {f"refs/tags/production/{loop}/{night.run}": made for loop in promoted}
        branch = landing.get_branch()
        landing.land(Landing(made, branch, head, snapshot.files, tags, quarantined, lists), message)
        night.notes += landing.finish()
        return
    if night.commit:
        branch = f"refs/heads/{settings.branch}"
        landing.move({branch: (made, tips.get(branch, "0" * len(made)))}, message)
        night.notes.append(
            f"on branch {settings.branch} waits {night.run}: git merge {settings.branch} takes it over, and "
            "the night after puts it into production"
        )
    landing.set_aside(quarantined, lists)


def _find_tips(settings: Nightly) -> dict[str, str]:
    """Returns {reference: commit} of the branch of waiting promotions, here and on git's remotes. This branch
    only moves forward."""
    references = [f"refs/remotes/{remote}/{settings.branch}" for remote in git("remote").split()]
    references.append(f"refs/heads/{settings.branch}")
    tips = {name: git("rev-parse", "-q", "--verify", name, check=False) for name in references}
    return {name: tip for name, tip in tips.items() if tip}


def _push(settings: Nightly, night: Night) -> None:
    """Pushes the artifacts to DVC's remote, and a branch of waiting promotions to git's."""
    try:
        if settings.remote:
            with contextlib.chdir(COPY):
                dvc("push", "--quiet", "--remote", settings.remote)
        if night.branch and (remotes := git("remote").split()):
            git("push", "--quiet", remotes[0], f"refs/heads/{night.branch}")
    except ValueError as error:
        night.unpushed = True
        night.notes.append(f"what was made is not on the remote: {error}; the next night tries again")
