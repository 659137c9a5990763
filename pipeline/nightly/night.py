"""One night: recordings in, `dvc repro`, judge, promote or keep, say so.

Exit status 0: promoted, kept, or nothing new; 1: the night failed; 3: drift alarm; 4: recordings were set
aside; 75: another night is at work.
"""

import contextlib
import datetime
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

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
from pipeline.nightly.records import ChampionState, DriftMemory, Lineage, Night, Remembered
from pipeline.nightly.remembered import METRICS
from pipeline.nightly.settings import Nightly, NightlyLoop
from pipeline.nightly.worktree import COPY, Snapshot
from pipeline.store import artifacts, params

# the loop whose recordings are learned from if this parameter says so
RECORDED = "recordings"
SOURCES = {
    "temperature": "generate_probing.source",
    "deposition": "train_ilc.source",
    "setpoint": "train_classifier.source",
}
CUT_PERCENT = 5.0  # of a recording; more is a note


class Work(NamedTuple):
    """A night under way: its record, and what the next one must remember of drift. What it is made from
    {path: digest}, what is in production and what will be, and the loops that are switched off."""

    night: Night
    memory: DriftMemory
    digests: Mapping[str, str] = {}
    state: ChampionState = ChampionState()
    off: Sequence[str] = ()

    def noted(self, *notes: str) -> "Work":
        return self._replace(night=self.night.noted(*notes))

    def ended(self, outcome: str, *reasons: str) -> "Work":
        return self._replace(night=self.night.ended(outcome, *reasons))

    def fail(self, error: Exception) -> "Work":
        """The night after what ended it. One that has made its commit stays what it was, and the next one
        finishes it."""
        why = reporting.tell(error, self.night.run)
        if self.night.commit:
            return self._replace(night=self.night._replace(unpushed=True).noted(why))
        night = self.night._replace(decisions={}, promoted=(), branch="")
        return self._replace(night=night.ended(records.FAILED, why))


def nightly(render: reporting.Render, now: datetime.datetime | None = None) -> tuple[int, str]:
    """Exit status and the one-line summary of a night; `render` makes its page. Somebody learns of the night,
    whatever happens."""
    started = now or datetime.datetime.now(datetime.UTC)
    try:
        with worktree.locked():
            return _run(started, render)
    except worktree.BusyError as busy:
        return reporting.BUSY, f"nightly: refused: {busy}"
    except Exception as error:  # nothing may end a night without a word
        return reporting.last_resort(error, started)


def _run(now: datetime.datetime, render: reporting.Render) -> tuple[int, str]:
    clock = time.monotonic()
    notes = remembered.set_broken_aside()
    last = remembered.last()
    night = Night(last.night + 1, f"night-{last.night + 1:04d}", watch.stamp(now)).noted(*notes)
    if last.success and now < datetime.datetime.fromisoformat(last.success):
        night = night.noted(
            f"the clock was set back: it is {night.when}, and the last success was at {last.success}"
        )
    work, settings, hashes = Work(night, last.drift), None, inputs.Hashes(last.hashes)
    try:
        try:
            settings = params.load(Nightly, "nightly")
        finally:  # what a killed night left is put right whatever the parameters are
            work = work.noted(*worktree.clear_killed(), *landing.finish(), *champion.follow())
        for step in _work(settings, last, hashes, work):
            work = step
    except Exception as error:  # refused in a sentence, or a mistake of this program
        work = work.fail(error)
    worktree.remove()  # on a full disk, what follows needs the room
    night = work.night._replace(seconds=round(time.monotonic() - clock, 1))
    if last.success and settings and (overdue := watch.find_overdue(now, last.success, settings.watch_h)):
        night = night.noted(f"watch: {overdue}")
    memory = _remember(settings, last, work, hashes)
    return reporting.report(night, memory, settings, render)


def _work(settings: Nightly, last: Remembered, hashes: inputs.Hashes, work: Work) -> Iterator[Work]:
    """The work after each step. What a step raises ends the night, which keeps what the steps before it came
    to."""
    work, settings = _leave_out_loops(settings, work)
    if not settings.loops:
        yield work.ended(records.NOTHING_NEW, "section loops switches off every loop")
        return
    yield work
    _check(settings)
    places = _list_places(settings)
    digests = inputs.contents(hashes, places)
    if _is_known(digests, last):
        yield _end_idle(work._replace(digests=digests), last)
        return
    snapshot, uncommitted = worktree.take(), inputs.uncommitted(settings)
    worktree.make(snapshot, [*digests, *places])
    state = champion.read()
    with contextlib.chdir(COPY):
        for name, one in state.folders.items():
            champion.bring(name, one)
        work = work._replace(digests=inputs.contents(hashes, places), state=state)
        new = {name: _find_new(work.digests, loop, last, name) for name, loop in settings.loops.items()}
        work = _compare(settings, last, work, new)
        yield work
        work = _screen(settings, work, new, hashes)
    quarantined = _list_moved(settings, work.night)
    yield work
    if _is_known(work.digests, last):
        work = work.ended(records.QUARANTINED, "all that was new is quarantined")
    else:
        with contextlib.chdir(COPY):
            work = _learn(settings, work, hashes, lambda: _lineage(settings, work.digests, uncommitted))
        yield work
    work = work.noted(*_tell_uncommitted(uncommitted))
    for step in _land(settings, work, state, snapshot, places, quarantined):
        work = step
        yield work
    yield _push(settings, work)


# ---- before the stages


def _leave_out_loops(settings: Nightly, work: Work) -> tuple[Work, Nightly]:
    """The work and the settings without the loops that section `loops` switches off. Checks every section of
    the parameters."""
    switches = stages.check_parameters()
    off = [name for name in settings.loops if not switches.get(name, True)]
    if not off:
        return work, settings
    loops = {name: loop for name, loop in settings.loops.items() if name not in off}
    alarms = tuple(alarm for alarm in work.memory.alarms if alarm.loop not in off)
    work = work._replace(off=off, memory=work.memory._replace(alarms=alarms))
    return (
        work.noted(f"no part of the night, by section loops: {', '.join(off)}"),
        settings.model_copy(update={"loops": loops}),
    )


def _check(settings: Nightly) -> None:
    """Raises ValueError if the night cannot end well."""
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


def _list_places(settings: Nightly) -> list[str]:
    """All that a night is made from."""
    recordings = [loop.recordings for loop in settings.loops.values() if loop.recordings]
    return [*inputs.sources(), settings.holdout.recordings, *recordings]


def _is_known(digests: Mapping[str, str], last: Remembered) -> bool:
    return inputs.digest(digests) == last.inputs and not last.unpushed


def _end_idle(work: Work, last: Remembered) -> Work:
    night = work.night._replace(idle=last.idle + 1).noted(_tell_idle(last.idle + 1))
    reason = "no recording, parameter or code has changed since the last night"
    return work._replace(night=night.ended(records.NOTHING_NEW, reason))


def _tell_idle(nights: int) -> str:
    running = f" for {nights} nights" if nights > 1 else ""
    return f"no new recording{running}: drift was not measured"


def _find_new(digests: Mapping[str, str], loop: NightlyLoop, last: Remembered, name: str) -> dict[str, str]:
    """The recordings of a loop whose content was not there the night before."""
    seen_before = last.recordings.get(name, {}).values()
    recordings = inputs.recordings(digests, loop).items()
    return {path: content for path, content in recordings if content not in seen_before}


def _compare(settings: Nightly, last: Remembered, work: Work, new: Mapping[str, Mapping[str, str]]) -> Work:
    """The night with its new recordings, or how long there was none."""
    paths = {name: sorted(recordings) for name, recordings in new.items() if recordings}
    night = work.night._replace(new_recordings=paths, idle=0 if paths else last.idle + 1)
    unused = [_tell_unused(settings.loops[name], recordings) for name, recordings in paths.items()]
    idle = [_tell_idle(night.idle)] if night.idle else []
    return work._replace(night=night.noted(*filter(None, unused), *idle))


def _tell_unused(loop: NightlyLoop, recordings: Sequence[str]) -> str:
    """That new recordings of a loop are not learned from, and what would change that; empty if they are."""
    dotted = SOURCES.get(loop.judge, "")
    section, _, key = dotted.partition(".")
    source = params.read().get(section, {}).get(key, RECORDED)
    if source == RECORDED:
        return ""
    are = "is" if len(recordings) == 1 else "are"
    return (
        f"{_name_few(recordings)} {are} not used, for {dotted} is {source}; "
        f"set {dotted}: {RECORDED} in {params.home(dotted)} to learn from what is recorded"
    )


def _screen(
    settings: Nightly, work: Work, new: Mapping[str, Mapping[str, str]], hashes: inputs.Hashes
) -> Work:
    """New recordings held against the champions; what cannot be learned from is out of the copy then."""
    from pipeline.nightly import judge, screening  # they take seconds to import

    night = work.night
    screened = screening.look(settings, work.state.champions, new, work.memory, night=night.number)
    quarantined = screened.drift.quarantined
    digests = inputs.after_quarantine(work.digests, quarantined, settings.loops, hashes)
    used = judge.measure_shares(
        settings, [p for found in new.values() for p in found if p not in quarantined]
    )
    cut = [
        f"{path}: {share.cut_percent:.0f} % of it is cut, {share.used_percent:.0f} % is used"
        for path, share in used.items()
        if share.cut_percent > CUT_PERCENT
    ]
    night = night._replace(drift=screened.drift, quarantined=quarantined, used=used)
    return work._replace(
        night=night.noted(*screened.drift.notes, *cut), memory=screened.memory, digests=digests
    )


def _list_moved(settings: Nightly, night: Night) -> dict[str, tuple[str, str, str]]:
    """{recording: (loop, reason, digest)} of what is to be set aside in the project."""
    return {
        path: (name, reason, artifacts.sha256(path))
        for name in settings.loops
        for path, reason in night.drift.of(name).quarantined.items()
        if Path(path).exists() and not (COPY / path).exists()
    }


# ---- the stages, and the judge


def _learn(settings: Nightly, work: Work, hashes: inputs.Hashes, lineage: Callable[[], Lineage]) -> Work:
    """Runs the stages in the copy, and judges what they made. Raises ValueError if a recording changed
    meanwhile."""
    from pipeline.nightly import promoting

    # the pages of tonight show tonight's drift, and judge by it
    artifacts.write_json(METRICS, work.night.metrics(work.state))
    for loop in settings.loops.values():
        # large recordings are DVC's: the pointer beside the folder moves with it
        if loop.recordings and Path(f"{loop.recordings}.dvc").exists():
            dvc("add", "--quiet", loop.recordings)
    logs = Path("..").resolve() / "logs"
    for old in sorted(logs.glob("*.log"))[:-60]:
        old.unlink()
    lost, notes = reproducing.reproduce(
        settings.loops, logs / f"{work.night.run}.log", limit_s=settings.longest_h * 3600
    )
    digests = inputs.contents(hashes, _list_places(settings))
    if moved := sorted({name for name, _ in work.digests.items() ^ digests.items()}):
        raise ValueError(
            f"{moved[0]} changed while the stages ran; nothing is changed, and the next night learns from it"
        )
    loops = {name: loop for name, loop in settings.loops.items() if name not in lost}
    rest = settings.model_copy(update={"loops": loops})
    night, state = promoting.judge_all(rest, work.night.noted(*notes), work.state, lineage=lineage)
    failed = {
        name: records.LoopDecision(records.FAILED, [f"its champion stays: {why}"])
        for name, why in lost.items()
    }
    reasons = [f"{name}: failed, {decision.reasons[0]}" for name, decision in failed.items()]
    night = night._replace(decisions=failed | dict(night.decisions))
    return work._replace(night=night.ended(night.outcome, *reasons, *night.reasons), state=state)


def _lineage(settings: Nightly, digests: Mapping[str, str], uncommitted: Sequence[str]) -> Lineage:
    """What the challengers were made from: the commit, what lay uncommitted on it, dvc.lock, parameters and
    recordings."""
    files = [name for name in (params.FILE, params.EXPERT) if artifacts.exists(name)]
    return Lineage(
        commit=git("rev-parse", "HEAD"),
        uncommitted=tuple(uncommitted),
        dvc_lock=artifacts.sha256("dvc.lock"),
        params={name: artifacts.sha256(name) for name in files},
        recordings={name: inputs.recordings(digests, loop) for name, loop in settings.loops.items()},
    )


def _tell_uncommitted(paths: Sequence[str]) -> list[str]:
    """That the night's result cannot be made again from its commit, if sources lie there uncommitted."""
    if not paths:
        return []
    return [f"not committed: {_name_few(paths)}; no commit alone makes this night's result again"]


def _name_few(paths: Sequence[str]) -> str:
    """ "a, b, c and 2 more"."""
    return ", ".join(paths[:3]) + (f" and {len(paths) - 3} more" if len(paths) > 3 else "")


# ---- the commit, which is the promotion


def _land(
    settings: Nightly,
    work: Work,
    before: ChampionState,
    snapshot: Snapshot,
    places: Sequence[str],
    quarantined: Mapping[str, tuple[str, str, str]],
) -> Iterator[Work]:
    """The night's commit, and the project brought to it; or the commit on a branch on which promotions wait.
    A night that changed nothing but its own figures makes none."""
    by_branch = settings.promotion == "branch"
    tracked = ["dvc.lock", "reports/metrics", "datasets/.gitignore", *inputs.recorded_places(settings)]
    night = work.night._replace(branch=settings.branch if by_branch and work.night.promoted else "")
    with contextlib.chdir(COPY):
        if work.state != before:
            champion.write(work.state)
            tracked += champion.paths(work.state)
        if not by_branch or night.promoted:
            artifacts.write_json(METRICS, night.metrics(work.state))
    lists = inputs.read_lists(settings, COPY)
    head = landing.check_head(snapshot, [*places, "dvc.lock", str(champion.FILE), str(champion.FOLDER)])
    outcome = f"promoted {', '.join(night.promoted)}" if night.promoted else "kept the champions"
    message = f"nightly {night.run}: {outcome}\n\n" + "\n".join(night.reasons)
    tips = _find_tips(settings) if by_branch else {}
    waiting = [tip for tip in tips.values() if git("merge-base", tip, head, check=False) != tip]
    made = landing.commit(tracked, message, [head, *dict.fromkeys(waiting)])
    if (
        not made
        or {*names("diff", "--name-only", head, made)} <= {METRICS}
        or (by_branch and not night.promoted)
    ):
        landing.set_aside(quarantined, lists)
        yield work
        return
    work = work._replace(night=night._replace(commit=made))
    if by_branch:
        branch = f"refs/heads/{settings.branch}"
        landing.move({branch: (made, tips.get(branch, "0" * len(made)))}, message)
        work = work.noted(
            f"on branch {settings.branch} waits {night.run}: git merge {settings.branch} takes it over, and "
            "the night after puts it into production"
        )
        yield work
        landing.set_aside(quarantined, lists)
        return
    tags = {f"refs/tags/production/{loop}/{night.run}": made for loop in night.promoted}
    landing.land(Landing(made, landing.get_branch(), head, snapshot.files, tags, quarantined, lists), message)
    yield work
    yield work.noted(*landing.finish())


def _find_tips(settings: Nightly) -> dict[str, str]:
    """{reference: commit} of the branch on which promotions wait, here and on the remotes of git: it only
    moves forward."""
    references = [f"refs/remotes/{remote}/{settings.branch}" for remote in git("remote").split()]
    references.append(f"refs/heads/{settings.branch}")
    tips = {name: git("rev-parse", "-q", "--verify", name, check=False) for name in references}
    return {name: tip for name, tip in tips.items() if tip}


def _push(settings: Nightly, work: Work) -> Work:
    """The artifacts to DVC's remote, and a branch on which promotions wait to git's."""
    night = work.night
    try:
        if settings.remote:
            with contextlib.chdir(COPY):
                dvc("push", "--quiet", "--remote", settings.remote)
        if night.branch and (remotes := git("remote").split()):
            git("push", "--quiet", remotes[0], f"refs/heads/{night.branch}")
    except ValueError as error:
        night = night._replace(unpushed=True).noted(
            f"what was made is not on the remote: {error}; the next night tries again"
        )
    return work._replace(night=night)


# ---- what is remembered


def _remember(settings: Nightly | None, last: Remembered, work: Work, hashes: inputs.Hashes) -> Remembered:
    night = work.night
    if night.outcome == records.FAILED or settings is None:
        # a recording of a failed night is new again the next one, and must not count as two
        return last._replace(night=night.number, hashes=hashes.now or last.hashes)
    loops = settings.loops.items()
    return Remembered(
        night=night.number,
        success=last.success if night.lost else _success(night.when, last.success, settings.watch_h),
        # a night that lost a loop is repeated
        inputs="" if night.lost else inputs.digest(work.digests),
        unpushed=night.unpushed,
        # those of a loop that is switched off are no news when it is switched on
        recordings={
            name: last.recordings.get(name, {}) if name in work.off else inputs.recordings(work.digests, loop)
            for name, loop in loops
        },
        drift=work.memory,
        hashes=hashes.now,
        idle=night.idle,
    )


def _success(when: str, before: str, watch_h: float) -> str:
    """The time of the last success. A clock that was set back does not make it older, unless the one before
    lies so far ahead that the watchdog would wait for it: one of the two clocks was wrong."""
    if before and watch.hours_since(before, datetime.datetime.fromisoformat(when)) < -watch_h:
        return when
    return max(when, before)
