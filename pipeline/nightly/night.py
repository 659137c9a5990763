"""One night: recordings in, `dvc repro`, judge, promote or keep, say so.

Exit status 0: promoted, kept, or nothing new; 1: the night failed; 3: drift alarm; 4: recordings were set
aside; 75: another night is at work.
"""

import datetime
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import stages
from pipeline.nightly import (
    branches,
    champion,
    guarding,
    inputs,
    records,
    remembered,
    reporting,
    reproducing,
    watch,
)
from pipeline.nightly.processes import STATE, changed, check_attached, commit, dvc, git
from pipeline.nightly.records import ROLLED_BACK, ChampionState, Lineage, LoopDecision, Night
from pipeline.nightly.remembered import METRICS, DriftMemory, Remembered
from pipeline.nightly.settings import Nightly, NightlyLoop
from pipeline.store import artifacts, params

OK, FAILED, BUSY = reporting.OK, reporting.FAILED, reporting.BUSY
DRIFTED, QUARANTINED = reporting.DRIFTED, reporting.QUARANTINED
# the loop whose recordings are learned from where this parameter says so
RECORDED = "recordings"
SOURCES = {
    "temperature": "generate_probing.source",
    "deposition": "train_ilc.source",
    "setpoint": "train_classifier.source",
}


class Job(NamedTuple):
    """What a night works by: the settings, what is remembered of the night before, hashes of files that have
    not changed since. `restarted`: the inputs have changed once already while the stages ran."""

    settings: Nightly
    last: Remembered
    hashes: inputs.Hashes
    restarted: bool = False


class NightWork(NamedTuple):
    """A night under way: its record, what it is made from {path: digest}, new recordings {loop: {path:
    digest}}, the memory of drift, and what is in production.

    `moved` are inputs that changed while the stages ran. `lost` is {loop: why its stages failed}, `off` are
    the loops that section `loops` switches off. `done`: no further step follows.
    """

    night: Night
    memory: DriftMemory
    digests: Mapping[str, str] = {}
    new: Mapping[str, Mapping[str, str]] = {}
    state: ChampionState = ChampionState()
    moved: tuple[str, ...] = ()
    lost: Mapping[str, str] = {}
    off: tuple[str, ...] = ()
    done: bool = False

    def ended(self, outcome: str, *reasons: str) -> "NightWork":
        return self._replace(night=self.night.ended(outcome, *reasons), done=True)

    def failed(self, error: Exception) -> "NightWork":
        """The night after what ended it. A night that has made its commit stays what it was, and is repeated
        in the morning after."""
        why = reporting.told(error, self.night.run)
        if self.night.commit:
            return self._replace(night=self.night._replace(unpushed=True).noted(why), done=True)
        nothing = self.night._replace(decisions={}, promoted=(), branch="")
        return self._replace(night=nothing).ended(records.FAILED, why)


def nightly(render: reporting.Render, now: datetime.datetime | None = None) -> tuple[int, str]:
    """Exit status and the one-line summary of a night; `render` makes its page. Somebody learns of the night,
    whatever happens."""
    started = now or datetime.datetime.now(datetime.UTC)
    try:
        with guarding.locked():
            return _night(started, render)
    except guarding.BusyError as busy:
        return BUSY, f"nightly: refused: {busy}"
    except Exception as error:  # nothing may end a night without a word
        return reporting.last_resort(error, started)


def _night(now: datetime.datetime, render: reporting.Render) -> tuple[int, str]:
    clock = time.monotonic()
    last, aside = remembered.opened()
    night = Night(last.night + 1, f"night-{last.night + 1:04d}", watch.stamp(now))
    settings, refused = reporting.settings_or_known(last, night.run)
    if last.success and now < datetime.datetime.fromisoformat(last.success):
        night = night.noted(
            f"the clock was set back: it is {night.when}, and the last success was at {last.success}"
        )
    overdue = watch.overdue(now, last.success, settings.watch_h) if last.success and settings else ""
    job = Job(settings, last, inputs.Hashes(last.hashes)) if settings else None
    work, mended = _mended(NightWork(night, last.drift), [*aside, *refused])
    if mended:
        guarding.RUNNING.touch()
    if job and not work.done:
        work = _worked(job, work)
    if work.night.outcome == records.FAILED:
        guarding.RESERVE.unlink(missing_ok=True)  # on a full disk, what follows is written from it
    night = work.night._replace(seconds=round(time.monotonic() - clock, 1))
    night = night.noted(f"watch: {overdue}") if overdue else night
    tonight = _to_remember(job, work) if job else last._replace(night=night.number)
    status, summary = reporting.report(night, tonight, settings, render)
    if mended:
        guarding.RUNNING.unlink(missing_ok=True)
    return status, summary


# ---- the night, step by step


def _mended(work: NightWork, broken: Sequence[str]) -> tuple[NightWork, bool]:
    """What a killed night left, put right; whether that could be done. The night ends where a file that it
    works by is broken, which its sentences say."""
    whole, broken = True, list(broken)
    try:
        guarding.unmerged()
    except Exception as error:
        return work.ended(records.FAILED, *broken, reporting.told(error, work.night.run)), False
    for mend in (guarding.broken_champion, guarding.mend):
        try:
            said = mend()
        except Exception as error:
            whole = False
            broken.append(reporting.told(error, work.night.run))
            continue
        if mend is guarding.broken_champion:
            broken += said
        else:
            work = work._replace(night=work.night.noted(*said))
    return (work.ended(records.FAILED, *dict.fromkeys(broken)) if broken else work), whole


def _worked(job: Job, work: NightWork) -> NightWork:
    """The night itself. Each step returns the work with more in it; one that fails ends the night, which
    keeps what the steps before it came to."""
    steps = (
        *(_ready, _unchanged, _compared, _screened, _learned, _put_back, _restarted),
        *(_committed, _pushed),
    )
    for step in steps:
        if work.done:
            break
        try:
            work = step(_without(job, (*work.lost, *work.off)), work)
        except Exception as error:  # refused in a sentence, or a mistake of this program
            work = work.failed(error)
            # until the stages have run nothing is changed, and after that production may be
            work = _undone(work) if step in (_committed, _pushed) else work
    return work


def _undone(work: NightWork, *undo: Callable[[], list[str]]) -> NightWork:
    """What a failed night changed is put back, production last."""
    for back in (*undo, champion.as_committed):
        try:
            work = work._replace(night=work.night.noted(*back()))
        except Exception as error:
            work = work._replace(night=work.night.noted(reporting.told(error, work.night.run)))
    return work


def _without(job: Job, names: Collection[str]) -> Job:
    """The job without these loops: nothing of them is judged or committed."""
    if not names:
        return job
    loops = {name: loop for name, loop in job.settings.loops.items() if name not in names}
    return job._replace(settings=job.settings.model_copy(update={"loops": loops}))


def _ready(job: Job, work: NightWork) -> NightWork:
    """Checks every section of the parameters before a stage runs, and leaves out the loops that are switched
    off."""
    guarding.ready(job.settings.least_free_mb)
    branches.check(job.settings)
    switches = stages.check_parameters()
    off = tuple(name for name in job.settings.loops if not switches.get(name, True))
    if not off:
        return work
    alarms = tuple(alarm for alarm in work.memory.alarms if alarm.loop not in off)
    night = work.night.noted(f"no part of the night, by section loops: {', '.join(off)}")
    work = work._replace(off=off, memory=work.memory._replace(alarms=alarms), night=night)
    if len(off) == len(job.settings.loops):
        return work.ended(records.NOTHING_NEW, "section loops switches off every loop")
    return work


def _unchanged(job: Job, work: NightWork) -> NightWork:
    """Reads what the night is made from; the night ends where that is what the last one was made from."""
    digests = inputs.contents(job.hashes, _places(job.settings))
    work = work._replace(digests=digests)
    if not _nothing_new(digests, job.last):
        return work
    return work.ended(
        records.QUARANTINED if work.night.quarantined else records.NOTHING_NEW,
        "no recording, parameter or code has changed since the last night",
    )


def _compared(job: Job, work: NightWork) -> NightWork:
    """The recordings of each loop whose content was not there the night before."""
    new = {
        name: _new(work.digests, loop, job.last.recordings.get(name, {}))
        for name, loop in job.settings.loops.items()
    }
    paths = {name: sorted(recordings) for name, recordings in new.items() if recordings}
    night = work.night._replace(new_recordings=paths)
    unused = [_unused(job.settings.loops[name], recordings) for name, recordings in paths.items()]
    idle = [] if paths else ["no new recording: drift was not measured"]
    return work._replace(new=new, night=night.noted(*filter(None, unused), *idle))


def _screened(job: Job, work: NightWork) -> NightWork:
    """New recordings held against the champions; the night ends where all that was new is quarantined."""
    from pipeline.nightly import screening  # it takes seconds to import, and so does what judges

    state, night = champion.read(), work.night
    screened = screening.look(job.settings, state.champions, work.new, work.memory, night=night.number)
    quarantined = {**night.quarantined, **screened.drift.quarantined}
    night = night.noted(*screened.drift.notes)
    digests = inputs.after_quarantine(work.digests, quarantined, job.settings.loops, job.hashes)
    work = work._replace(
        night=night._replace(screened=True, drift=screened.drift, quarantined=quarantined),
        memory=screened.memory,
        digests=digests,
        state=state,
    )
    if _nothing_new(digests, job.last):
        return work.ended(records.QUARANTINED, "all that was new is quarantined")
    return work


def _learned(job: Job, work: NightWork) -> NightWork:
    """Runs the stages, and judges what they made. What a refused run changed is put back."""
    guarding.remember_before()
    try:
        # the pages of tonight show tonight's drift, and judge by it
        artifacts.write_json(METRICS, work.night.metrics(work.state))
        lost, notes = _reproduce(job.settings, work.night.run)
        # what came or changed meanwhile may be in some stages and not in others, and
        # nobody has looked whether it is fit to learn from
        now = inputs.contents(job.hashes, _places(job.settings))
        moved = tuple(sorted({name for name, _ in work.digests.items() ^ now.items()}))
        if moved and (job.restarted or any(name.endswith(".py") for name in moved)):
            raise ValueError(
                f"{moved[0]} changed{' again' if job.restarted else ''} while the stages ran; "
                "start the night when nothing is recorded or edited"
            )
        if moved:
            return work._replace(moved=moved)
        work = work._replace(lost=lost, night=work.night.noted(*notes))
        return _with_lost(_judge(_without(job, work.lost), work))
    except Exception as error:
        return _undone(work.failed(error), guarding.back_to_before)


def _with_lost(work: NightWork) -> NightWork:
    """The night's record with the loops whose stages failed, told first; their champions stay."""
    lost = {
        name: LoopDecision(records.FAILED, [f"its champion stays: {why}"]) for name, why in work.lost.items()
    }
    night = work.night._replace(decisions={**lost, **work.night.decisions})
    reasons = [f"{name}: {decision.decision}, {decision.reasons[0]}" for name, decision in lost.items()]
    return work._replace(night=night.ended(night.outcome, *reasons, *night.reasons))


def _put_back(job: Job, work: NightWork) -> NightWork:
    """Where inputs changed while the stages ran: all as it was before the night, and nothing decided."""
    if not work.moved:
        return work
    night = work.night.noted(
        *guarding.back_to_before(),
        f"{', '.join(work.moved[:3])} changed while the stages ran: the night began once again",
    )
    return work._replace(night=night.without_measurement(), memory=job.last.drift)


def _restarted(job: Job, work: NightWork) -> NightWork:
    """The whole night once more, by the parameters as they are now."""
    if not work.moved:
        return work
    again = job._replace(settings=params.load(Nightly, "nightly"), restarted=True)
    return _worked(again, NightWork(work.night, work.memory))._replace(done=True)


def _places(settings: Nightly) -> list[str]:
    """All that a night is made from."""
    recordings = [loop.recordings for loop in settings.loops.values() if loop.recordings]
    return [*inputs.sources(), settings.holdout.recordings, *recordings]


def _nothing_new(digests: Mapping[str, str], last: Remembered) -> bool:
    return inputs.digest(digests) == last.inputs and not last.unpushed


def _new(digests: Mapping[str, str], loop: NightlyLoop, before: Mapping[str, str]) -> dict[str, str]:
    """The recordings of a loop whose content was not there the night before."""
    return {
        name: content
        for name, content in inputs.recordings(digests, loop).items()
        if content not in before.values()
    }


def _unused(loop: NightlyLoop, recordings: Sequence[str]) -> str:
    """That new recordings of a loop are not learned from, and what would change that; empty where they
    are."""
    section, _, key = SOURCES.get(loop.judge, "").partition(".")
    source = params.read().get(section, {}).get(key, RECORDED)
    if source == RECORDED:
        return ""
    first, more = ", ".join(recordings[:3]), f" and {len(recordings) - 3} more" if len(recordings) > 3 else ""
    dotted = f"{section}.{key}"
    return (
        f"{first}{more} {'is' if len(recordings) == 1 else 'are'} not used, for {dotted} is {source}; "
        f"set {dotted}: {RECORDED} in {params.home(dotted)} to learn from what is recorded"
    )


def _reproduce(settings: Nightly, run: str) -> tuple[Mapping[str, str], Sequence[str]]:
    """{loop: why its stages failed}, and notes."""
    for loop in settings.loops.values():
        # large recordings are DVC's: the pointer beside the folder moves with it
        if loop.recordings and Path(f"{loop.recordings}.dvc").exists():
            dvc("add", "--quiet", loop.recordings)
    for old in sorted((STATE / "logs").glob("*.log"))[:-60]:
        old.unlink()
    return reproducing.reproduce(settings.loops, run, limit_s=settings.longest_h * 3600)


# ---- champion and challenger


def _judge(job: Job, work: NightWork) -> NightWork:
    """Each loop's challenger before the rules of its page and against its champion, and what is promoted."""
    from pipeline.nightly import promoting

    night, state = promoting.judged(
        job.settings, work.night, work.state, lineage=lambda: _lineage(job.settings, work.digests)
    )
    return work._replace(night=night, state=state)


def _lineage(settings: Nightly, made_from: Mapping[str, str]) -> Lineage:
    """What the challengers were made from: the commit, what lay
    uncommitted on it, dvc.lock, parameters and recordings."""
    return Lineage(
        commit=git("rev-parse", "HEAD"),
        uncommitted=inputs.uncommitted(settings),
        dvc_lock=artifacts.sha256("dvc.lock"),
        params={
            name: artifacts.sha256(name) for name in (params.FILE, params.EXPERT) if artifacts.exists(name)
        },
        recordings={name: inputs.recordings(made_from, loop) for name, loop in settings.loops.items()},
    )


# ---- the commit, which is the promotion


def _committed(job: Job, work: NightWork) -> NightWork:
    """The night's commit: of HEAD; or on a branch beside what waits there, where promotions wait."""
    settings = job.settings
    work = work._replace(night=work.night.noted(*_uncommitted(settings)))
    there = branches.waiting(settings)
    night, state = work.night, work.state
    moved = state != champion.read()  # a champion or a candidate
    if settings.promotion == "branch":
        night, state = branches.beside(night, state, there)
        night = night.noted(*branches.told(settings, night, there))
        night = night._replace(branch=settings.branch if night.promoted else "")
        moved = moved and bool(night.promoted or night.candidates)
    if moved:
        champion.write(state)
    tracked = _tracked(settings, promoted=moved)
    elsewhere = [path for path in tracked if path != str(METRICS) and Path(path).exists()]
    # of the metrics, the night's own change every night
    anything = moved or set(changed(*elsewhere, untracked="normal")) - {str(METRICS)}
    work = work._replace(night=night)
    if not anything or (settings.promotion == "branch" and not moved):
        return work
    artifacts.write_json(METRICS, night.metrics(state))
    outcome = f"promoted {', '.join(night.promoted)}" if night.promoted else "kept the champions"
    message = f"nightly {night.run}: {outcome}\n\n" + "\n".join(night.reasons)
    if settings.promotion == "branch":
        made = branches.committed(settings, tracked, message, night, there)
    else:
        made = commit(tracked, message)
    return work._replace(night=night._replace(commit=made))


def _uncommitted(settings: Nightly) -> list[str]:
    """That the night's result cannot be made again from its commit, where sources lie there uncommitted."""
    paths = inputs.uncommitted(settings)
    if not paths:
        return []
    more = f" and {len(paths) - 3} more" if len(paths) > 3 else ""
    return [f"not committed: {', '.join(paths[:3])}{more}; no commit alone makes this night's result again"]


def _tracked(settings: Nightly, *, promoted: bool) -> list[str]:
    """What a night's commit holds."""
    return [
        "dvc.lock",
        "reports/metrics",
        "datasets/.gitignore",
        *inputs.recorded_places(settings),
        *(champion.paths() if promoted else []),
    ]


def _pushed(job: Job, work: NightWork) -> NightWork:
    """The artifacts to the remote; where promotions wait on a branch, production as it was."""
    settings, night = job.settings, work.night
    if settings.remote:
        try:
            dvc("push", "--quiet", "--remote", settings.remote)
        except ValueError as error:
            night = night._replace(unpushed=True).noted(
                f"the artifacts are not on remote {settings.remote}: {error}; the next night tries again"
            )
    if settings.promotion == "branch":
        champion.as_committed()
    return work._replace(night=night)


# ---- what is remembered


def _to_remember(job: Job, work: NightWork) -> Remembered:
    night, last = work.night, job.last
    known = remembered.without_secrets(job.settings)
    if night.outcome == records.FAILED:
        # a recording of a failed night is new again the next one, and must not count as two
        return last._replace(
            night=night.number, unpushed=night.unpushed, hashes=job.hashes.now or last.hashes, settings=known
        )
    return Remembered(
        night=night.number,
        success=last.success if night.lost else _success(night.when, last.success, job.settings.watch_h),
        # a night that lost a loop is repeated
        inputs=None if night.lost else inputs.digest(work.digests),
        unpushed=night.unpushed,
        # those of a loop that is switched off are no news when it is switched on
        recordings={
            name: last.recordings.get(name, {}) if name in work.off else inputs.recordings(work.digests, loop)
            for name, loop in job.settings.loops.items()
        },
        drift=work.memory,
        hashes=job.hashes.now,
        settings=known,
    )


def _success(when: str, before: str | None, watch_h: float) -> str:
    """The time of the last success. A clock that was set back does not make it older, unless the one before
    lies so far ahead that the watchdog would wait for it: one of the two clocks was wrong."""
    if before and watch.hours_since(before, datetime.datetime.fromisoformat(when)) < -watch_h:
        return when
    return max(when, before or "")


# ---- the way back


def rollback(run: str, loop: str) -> str:
    """Puts the champion of an earlier run back into production, bit by bit, and says what was done."""
    params.load(Nightly, "nightly")
    with guarding.alone():
        check_attached()
        state = champion.read()
        earlier = champion.earlier(state, run, loop)
        when = watch.stamp(datetime.datetime.now(datetime.UTC))
        for name, former in earlier.items():
            champion.put_back(name, former)
            again = former._replace(why=f"rolled back to {former.run} by hand", since=when)
            state = champion.in_production(state, name, again, event=ROLLED_BACK, when=when, why="by hand")
        champion.write(state)
        names = ", ".join(f"{name} is {former.run}" for name, former in earlier.items())
        made = commit(champion.paths(), f"rollback: {names}")
        return f"rollback: {names} again, every file as it was; commit {made[:12]}"
