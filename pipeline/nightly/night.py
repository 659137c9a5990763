"""One night: recordings in, `dvc repro`, judge, promote or keep, say so.

Exit status 0: promoted, kept, or nothing new; 1: the night failed; 3: drift alarm; 4: recordings were set
aside; 75: another night is at work.
"""

import datetime
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.nightly import champion, guarding, inputs, remembered, watch
from pipeline.nightly.processes import STATE, commit, dvc, git
from pipeline.nightly.remembered import METRICS, DriftMemory, Remembered
from pipeline.nightly.settings import Loop, Nightly
from pipeline.report.nightly import record
from pipeline.report.nightly.production import ROLLED_BACK, Champion, ChampionMetrics, ChampionState, Lineage
from pipeline.report.nightly.record import KEPT, LoopDecision, Night
from pipeline.store import artifacts, params

OK, FAILED, DRIFTED, QUARANTINED, BUSY = 0, 1, 3, 4, 75
NIGHTS = STATE / "nights.json"
LONGEST_HISTORY = 1000
# what ends a night in a sentence; anything else is a mistake of this program, and shows its traceback
REFUSALS = (ValueError, OSError, np.linalg.LinAlgError)


class Job(NamedTuple):
    """What a night works by: the settings, what is remembered of the night before, hashes of files that have
    not changed since. `restarted`: the inputs have changed once already while the stages ran."""

    settings: Nightly
    last: Remembered
    hashes: inputs.Hashes
    restarted: bool = False


class Work(NamedTuple):
    """A night under way: its record, what it is made from {path: digest}, new recordings {loop: {path:
    digest}}, the memory of drift, and what is in production.

    `moved` are inputs that changed while the stages ran. `done`: no further step follows.
    """

    night: Night
    memory: DriftMemory
    digests: Mapping[str, str] = {}
    new: Mapping[str, Mapping[str, str]] = {}
    state: ChampionState = ChampionState()
    moved: tuple[str, ...] = ()
    done: bool = False

    def ended(self, outcome: str, *reasons: str) -> "Work":
        return self._replace(night=self.night.ended(outcome, *reasons), done=True)

    def failed(self, error: Exception) -> "Work":
        return self.ended(record.FAILED, " ".join(str(error).split()))


def nightly(now: datetime.datetime | None = None) -> tuple[int, str]:
    """Exit status and the one-line summary of a night. Raises
    ValueError where the parameters do not say what to do."""
    settings = params.load(Nightly, "nightly")
    started = now or datetime.datetime.now(datetime.UTC)
    try:
        with guarding.alone() as mended:
            return _night(settings, started, mended)
    except guarding.BusyError as busy:
        return BUSY, f"nightly: refused: {busy}"


def _night(settings: Nightly, now: datetime.datetime, mended: Iterable[str]) -> tuple[int, str]:
    last, clock = remembered.last(), time.monotonic()
    number = last.night + 1
    night = Night(number, f"night-{number:04d}", watch.stamp(now)).noted(*mended)
    if last.success and now < datetime.datetime.fromisoformat(last.success):
        night = night.noted(
            f"the clock was set back: it is {night.when}, and the last success was at {last.success}"
        )
    overdue = watch.overdue(now, settings.watch_h) if last.success else ""
    job = Job(settings, last, inputs.Hashes(last.hashes))
    work = Work(night, last.drift)
    try:
        guarding.ready(settings.least_free_mb)
    except REFUSALS as error:
        work = work.failed(error)
    work = _worked(job, work)
    if work.night.outcome == record.FAILED:
        guarding.RESERVE.unlink(missing_ok=True)  # on a full disk, what follows is written from it
    night = work.night._replace(seconds=round(time.monotonic() - clock, 1))
    night = night.noted(f"watch: {overdue}") if overdue else night
    return _report(job, work._replace(night=night))


# ---- the night, step by step


def _worked(job: Job, work: Work) -> Work:
    """The night itself. Each step returns the work with more in it; one that is refused ends the night, which
    keeps what the steps before it came to."""
    for step in (_unchanged, _compared, _screened, _learned, _put_back, _restarted, _committed, _pushed):
        if work.done:
            break
        try:
            work = step(job, work)
        except REFUSALS as error:
            work = work.failed(error)
    return work


def _unchanged(job: Job, work: Work) -> Work:
    """Reads what the night is made from; the night ends where that is what the last one was made from."""
    digests = inputs.contents(job.hashes, _places(job.settings))
    work = work._replace(digests=digests)
    if not _nothing_new(digests, job.last):
        return work
    return work.ended(
        record.QUARANTINED if work.night.quarantined else record.NOTHING_NEW,
        "no recording, parameter or code has changed since the last night",
    )


def _compared(job: Job, work: Work) -> Work:
    """The recordings of each loop whose content was not there the night before."""
    new = {
        name: _new(work.digests, loop, job.last.recordings.get(name, {}))
        for name, loop in job.settings.loops.items()
    }
    paths = {name: sorted(recordings) for name, recordings in new.items() if recordings}
    return work._replace(new=new, night=work.night._replace(new_recordings=paths))


def _screened(job: Job, work: Work) -> Work:
    """New recordings held against the champions; the night ends where all that was new is quarantined."""
    from pipeline.nightly import screening  # it takes seconds to import, and so does what judges

    state, night = champion.read(), work.night
    screened = screening.look(job.settings, state.champions, work.new, work.memory, night=night.number)
    quarantined = {**night.quarantined, **screened.drift.quarantined}
    digests = {
        name: content
        for name, content in work.digests.items()
        if name not in quarantined and not any(inputs.within(name, bag) for bag in quarantined)
    }
    work = Work(
        night._replace(screened=True, drift=screened.drift, quarantined=quarantined),
        screened.memory,
        digests,
        work.new,
        state,
    )
    if _nothing_new(digests, job.last):
        return work.ended(record.QUARANTINED, "all that was new is quarantined")
    return work


def _learned(job: Job, work: Work) -> Work:
    """Runs the stages, and judges what they made. What a refused run changed is put back."""
    guarding.remember_before()
    try:
        _reproduce(job.settings, work.night.run)
        # what came or changed meanwhile may be in some stages and not in others, and
        # nobody has looked whether it is fit to learn from
        now = inputs.contents(job.hashes, _places(job.settings))
        moved = tuple(sorted({name for name, _ in work.digests.items() ^ now.items()}))
        if moved and (job.restarted or any(name.endswith(".py") for name in moved)):
            raise ValueError(
                f"{moved[0]} changed{' again' if job.restarted else ''} while the stages ran; "
                "start the night when nothing is recorded or edited"
            )
        return work._replace(moved=moved) if moved else _judge(job, work)
    except REFUSALS as error:
        mended = guarding.back_to_before() + champion.as_committed()
        return work._replace(night=work.night.noted(*mended)).failed(error)


def _put_back(job: Job, work: Work) -> Work:
    """Where inputs changed while the stages ran: all as it was before the night, and nothing decided."""
    if not work.moved:
        return work
    night = work.night.noted(
        *guarding.back_to_before(),
        f"{', '.join(work.moved[:3])} changed while the stages ran: the night began once again",
    )
    return work._replace(night=night.without_measurement(), memory=job.last.drift)


def _restarted(job: Job, work: Work) -> Work:
    """The whole night once more, by the parameters as they are now."""
    if not work.moved:
        return work
    again = job._replace(settings=params.load(Nightly, "nightly"), restarted=True)
    return _worked(again, Work(work.night, work.memory))._replace(done=True)


def _places(settings: Nightly) -> list[str]:
    """All that a night is made from."""
    recordings = [loop.recordings for loop in settings.loops.values() if loop.recordings]
    return [*inputs.sources(), settings.holdout.recordings, *recordings]


def _nothing_new(digests: Mapping[str, str], last: Remembered) -> bool:
    return inputs.digest(digests) == last.inputs and not last.unpushed


def _new(digests: Mapping[str, str], loop: Loop, before: Mapping[str, str]) -> dict[str, str]:
    """The recordings of a loop whose content was not there the night before."""
    return {
        name: content
        for name, content in inputs.recordings(digests, loop).items()
        if content not in before.values()
    }


def _reproduce(settings: Nightly, run: str) -> None:
    log = STATE / "logs" / f"{run}.log"
    for loop in settings.loops.values():
        # large recordings are DVC's: the pointer beside the folder moves with it
        if loop.recordings and Path(f"{loop.recordings}.dvc").exists():
            dvc("add", "--quiet", loop.recordings)
    dvc("repro", log=log, limit_s=settings.longest_h * 3600)
    for old in sorted((STATE / "logs").glob("*.log"))[:-60]:
        old.unlink()


# ---- champion and challenger


class JudgedLoop(NamedTuple):
    """What was decided of a loop's challenger, and what it measured; None where it was not measured."""

    decision: LoopDecision
    metrics: ChampionMetrics | None = None


def _judge(job: Job, work: Work) -> Work:
    """Each loop's challenger against its champion; production with those that are promoted, whose files lie
    in champion/<loop> by then."""
    state, night = work.state, work.night
    decisions: dict[str, LoopDecision] = {}
    lineage = _lineage(job.settings, work.digests)
    for name in job.settings.loops:
        decision, metrics = _decide(job.settings, name, state.champions.get(name), work)
        decisions[name] = decision
        if decision.promotes:
            promoted = _install(job.settings, name, night, decision)
            promoted = promoted._replace(metrics=metrics, lineage=lineage)
            state = champion.in_production(state, name, promoted, event=decision.decision)
    promoted_loops = tuple(name for name, decision in decisions.items() if decision.promotes)
    night = night._replace(decisions=decisions, promoted=promoted_loops).ended(
        record.PROMOTED if promoted_loops else KEPT,
        *(f"{name}: {reason}" for name, decision in decisions.items() for reason in decision.reasons),
    )
    return work._replace(state=state, night=night)


def _install(settings: Nightly, name: str, night: Night, decision: LoopDecision) -> Champion:
    """Copies the challenger and the reference of its recordings to champion/<loop>."""
    from pipeline.nightly import screening

    loop = settings.loops[name]
    reference = screening.reference(loop, Path("datasets"))
    beside = {screening.REFERENCE: reference} if reference else {}
    files = champion.install(name, loop.artifacts, beside)
    return Champion(night.run, night.when, "; ".join(decision.reasons), files)


def _decide(settings: Nightly, name: str, present: Champion | None, work: Work) -> JudgedLoop:
    from pipeline.nightly import judge
    from pipeline.nightly.decision import decide

    loop = settings.loops[name]
    if lacking := champion.missing(loop.artifacts):
        reason = f"the challenger lacks {lacking[0]}; its stage did not write it"
        return JudgedLoop(LoopDecision(KEPT, [reason]))
    if present and champion.same(present.installed.files, loop.artifacts):
        return JudgedLoop(LoopDecision(KEPT, ["the challenger is the champion, byte for byte"]))
    if run := champion.rolled_back(work.state, name, loop.artifacts):
        reason = f"the challenger is that of {run}, which was rolled back by hand"
        return JudgedLoop(LoopDecision(KEPT, [reason]))
    judged = judge.judge(loop, settings)
    try:
        challenger = judged.measure(Path("datasets"))
        before = judged.measure(champion.FOLDER / name) if present else None
    except judge.NotComparable as reason:
        return JudgedLoop(LoopDecision(KEPT, [f"champion and challenger cannot be compared: {reason}"]))
    mean_cost = float(np.mean([cost for _, cost in challenger.cases.values()]))
    decision = decide(
        before,
        challenger,
        settings.rule,
        allowed=judged.allowed(before) if before else {},
        alarms=work.night.drift.of(name).alarms,
        seed=work.night.number,
    )
    return JudgedLoop(decision, ChampionMetrics(challenger.panel, mean_cost, challenger.guards))


def _lineage(settings: Nightly, made_from: Mapping[str, str]) -> Lineage:
    """What the challengers were made from: the commit, what lay
    uncommitted on it, dvc.lock, parameters and recordings."""
    changed = [line[3:] for line in git("status", "--porcelain", "--untracked-files=no").splitlines()]
    nights_own = ("reports/", "champion")
    return Lineage(
        commit=git("rev-parse", "HEAD"),
        uncommitted=tuple(path for path in changed if path != "dvc.lock" and not path.startswith(nights_own)),
        dvc_lock=artifacts.sha256("dvc.lock"),
        params={
            name: artifacts.sha256(name) for name in (params.FILE, params.EXPERT) if artifacts.exists(name)
        },
        recordings={name: inputs.recordings(made_from, loop) for name, loop in settings.loops.items()},
    )


# ---- the commit, which is the promotion


def _branch(settings: Nightly, night: Night) -> str:
    """The branch that a promotion waits on; empty where the night's commit is HEAD's."""
    return settings.branch if settings.promotion == "branch" and night.promoted else ""


def _committed(job: Job, work: Work) -> Work:
    settings, night = job.settings, work.night
    if night.promoted:
        champion.write(work.state)
    tracked = _tracked(settings, promoted=bool(night.promoted))
    elsewhere = [path for path in tracked if path != str(METRICS) and Path(path).exists()]
    changed = bool(git("status", "--porcelain", "--", *elsewhere)) or night.promoted
    branch = _branch(settings, night)
    if not changed or not (branch or settings.promotion == "at_once"):
        return work
    artifacts.write_json(METRICS, night.metrics(work.state))
    outcome = f"promoted {', '.join(night.promoted)}" if night.promoted else "kept the champions"
    message = f"nightly {night.run}: {outcome}\n\n" + "\n".join(night.reasons)
    return work._replace(night=night._replace(commit=commit(tracked, message, branch=branch)))


def _tracked(settings: Nightly, *, promoted: bool) -> list[str]:
    """What a night's commit holds."""
    recordings = [*(loop.recordings for loop in settings.loops.values()), settings.holdout.recordings]
    return [
        "dvc.lock",
        "reports/metrics",
        "datasets/.gitignore",
        # of a folder that DVC keeps, git keeps the pointer alone
        *(pointer if Path(pointer := f"{place}.dvc").exists() else place for place in recordings if place),
        *(champion.paths() if promoted else []),
    ]


def _pushed(job: Job, work: Work) -> Work:
    """The artifacts to the remote; where the promotion waits on a branch, production as it was."""
    settings, night = job.settings, work.night
    if settings.remote:
        try:
            dvc("push", "--quiet", "--remote", settings.remote)
        except ValueError as error:
            night = night._replace(unpushed=True).noted(
                f"the artifacts are not on remote {settings.remote}: {error}; the next night tries again"
            )
    if branch := _branch(settings, night):
        night = night.noted(f"the promotion waits on branch {branch}: git merge {branch}")
        champion.as_committed()
    return work._replace(night=night)


# ---- what is remembered and reported


def _report(job: Job, work: Work) -> tuple[int, str]:
    """State, page, alarm; the exit status and the summary. On a disk without room the summary still comes."""
    night, settings = work.night, job.settings
    status = _status(night)
    troubles: list[str] = []
    try:
        _remember(job, work)
        if night.outcome != record.NOTHING_NEW:
            from pipeline.report.nightly import page

            artifacts.write_text("reports/nightly.html", page.render(nights(), champion.read(), settings))
    except OSError as error:
        troubles.append(str(error))
    if status != OK:
        kind, reasons = _alarm(night, status)
        details = {
            "night": night.run,
            "when": night.when,
            "status": status,
            "drift": night.drift_written(),
            "quarantined": dict(night.quarantined),
            "log": f".beadline/logs/{night.run}.log",
        }
        troubles += watch.wake(kind, reasons, details, command=settings.alarm, webhook=settings.webhook)
    return status, _summary(night, troubles)


def _status(night: Night) -> int:
    """What a scheduler is told: the gravest of what the night met."""
    if night.outcome == record.FAILED or night.unpushed:
        return FAILED
    if night.drift.alarms:
        return DRIFTED
    return QUARANTINED if night.quarantined else OK


def _alarm(night: Night, status: int) -> tuple[str, list[str]]:
    """What somebody is woken for, and why."""
    if status == FAILED:  # or could not push, which its notes say
        return "failed", list(night.reasons if night.outcome == record.FAILED else night.notes)
    if status == DRIFTED:
        return "drift", [alarm.cause for alarm in night.drift.alarms]
    return "quarantined", list(night.quarantined.values())


def _remember(job: Job, work: Work) -> None:
    night, last = work.night, job.last
    if night.outcome == record.FAILED:
        # a recording of a failed night is new again the next one, and must not count as two
        remembered.remember(last._replace(night=night.number, unpushed=night.unpushed, hashes=job.hashes.now))
    else:
        if night.outcome != record.NOTHING_NEW and not night.commit:
            artifacts.write_json(METRICS, night.metrics(champion.read()))
        tonight = Remembered(
            night=night.number,
            # a clock that was set back must not make the last success look older than it is
            success=max(night.when, last.success or ""),
            inputs=inputs.digest(work.digests),
            unpushed=night.unpushed,
            recordings={
                name: inputs.recordings(work.digests, loop) for name, loop in job.settings.loops.items()
            },
            drift=work.memory,
            hashes=job.hashes.now,
        )
        remembered.remember(tonight)
    artifacts.write_json(NIGHTS, [*_rows(), night.written()][-LONGEST_HISTORY:])


def _rows() -> list[dict[str, Any]]:
    return artifacts.read_json(NIGHTS) if NIGHTS.exists() else []


def nights() -> list[Night]:
    """Every night that this checkout remembers, the oldest first."""
    return [Night.read(row) for row in _rows()]


def _summary(night: Night, troubles: list[str]) -> str:
    alarms = [alarm.cause for alarm in night.drift.alarms]
    parts = [f"nightly: {night.run} {night.outcome}"]
    if night.promoted:
        parts.append(f"promoted {', '.join(night.promoted)}")
    if alarms:
        parts.append(f"drift: {'; '.join(alarms)}")
    if not (night.promoted or alarms) or night.outcome == record.FAILED:
        parts.append("; ".join(night.reasons))
    if night.quarantined:
        parts.append("quarantined: " + "; ".join(night.quarantined.values()))
    text = " ".join(" | ".join([*parts, *night.notes, *troubles, f"{night.seconds:g} s"]).split())
    return text if len(text) <= 1000 else text[:999] + "…"


def watchdog() -> tuple[int, str]:
    """Whether somebody should look, because no night has succeeded for too long; the alarm goes out with it.
    Takes no lock: a night that hangs is seen too."""
    settings, now = params.load(Nightly, "nightly"), datetime.datetime.now(datetime.UTC)
    late = watch.overdue(now, settings.watch_h)
    if not late:
        return OK, f"nightly: watch: the last success was at {remembered.last().success}"
    STATE.mkdir(exist_ok=True)
    troubles = watch.wake(
        "watch", [late], {"when": watch.stamp(now)}, command=settings.alarm, webhook=settings.webhook
    )
    return FAILED, " | ".join([f"nightly: watch: {late}", *troubles])


# ---- the way back


def rollback(run: str, loop: str) -> str:
    """Puts the champion of an earlier run back into production, bit by bit, and says what was done."""
    params.load(Nightly, "nightly")
    with guarding.alone():
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
