"""Promotions that wait on a branch for a person: `promotion: branch`.

What is in production is what HEAD holds, and what a challenger is held against. A promotion is committed on
the branch, on top of those that wait there already, so that none is lost; merging the branch puts the last of
them into production, with the history of all.
"""

from pathlib import Path
from typing import NamedTuple

from pipeline.nightly import champion
from pipeline.nightly.processes import check_attached, commit, contains, git
from pipeline.nightly.records import CANDIDATE, KEPT, PROMOTED, Champion, ChampionState, HistoryLine, Night
from pipeline.nightly.settings import Nightly


class Waiting(NamedTuple):
    """The last commit of the branch; what will be in production once it is merged; and of that, the champions
    that HEAD does not have, by loop. Empty where there is no branch, or nothing on it that HEAD lacks."""

    tip: str = ""
    state: ChampionState = ChampionState()
    champions: dict[str, Champion] = {}


def check(settings: Nightly) -> None:
    """Raises ValueError where a night's commit would be lost, or would move a branch under the checkout."""
    if settings.promotion == "at_once":
        check_attached()
        return
    branch = settings.branch
    if not git("check-ref-format", "--branch", branch, check=False):
        raise ValueError(f"nightly.branch: expected the name of a branch, found {branch!r}; write nightly")
    if where := _checked_out(branch):
        raise ValueError(
            f"nightly.branch: expected a branch apart from the one that is in production, found {branch}, "
            f"which is checked out in {where}; git switch to the other one there, or name another branch"
        )


def _checked_out(branch: str) -> str:
    """The folder in which a branch is checked out, this or another worktree; empty where it is in none."""
    for entry in git("worktree", "list", "--porcelain").split("\n\n"):
        folder, *lines = entry.splitlines()
        place = folder.removeprefix("worktree ")
        if f"branch refs/heads/{branch}" in lines and Path(place).exists():
            return place
    return ""


def waiting(settings: Nightly) -> Waiting:
    """What waits on nightly.branch, or on a remote's of that name where this clone has none or an older
    one."""
    if settings.promotion != "branch":
        return Waiting()
    tip = _tip(settings.branch)
    present = champion.of_branch("HEAD")
    state = joined(present, champion.of_branch(tip)) if tip else present
    later = {
        loop: there
        for loop, there in state.champions.items()
        if loop not in present.champions or there.md5 != present.champions[loop].md5
    }
    return Waiting(tip, state, later)


def _tip(branch: str) -> str:
    tip = git("rev-parse", "-q", "--verify", f"refs/heads/{branch}", check=False)
    for remote in git("remote").split():
        theirs = git("rev-parse", "-q", "--verify", f"refs/remotes/{remote}/{branch}", check=False)
        if theirs and (not tip or contains(theirs, tip)):
            tip = theirs
    return tip


def joined(mine: ChampionState, theirs: ChampionState) -> ChampionState:
    """One production of two: the history of both by time. A loop's champion is theirs where their history of
    the loop holds all of ours, and goes on from there; otherwise ours, where there is one. Its candidate is
    the later of the two, where that is later than its champion."""
    known = {_key(line) for line in mine.history}
    both = [*mine.history, *(line for line in theirs.history if _key(line) not in known)]
    champions = dict(mine.champions)
    for loop, there in theirs.champions.items():
        if loop not in champions or _lines(mine, loop) <= _lines(theirs, loop):
            champions[loop] = there
    candidates = dict(theirs.candidates)
    for loop, one in mine.candidates.items():
        candidates[loop] = max(one, candidates.get(loop, one), key=lambda candidate: candidate.when)
    candidates = {
        loop: one
        for loop, one in candidates.items()
        if loop not in champions or one.when > champions[loop].when
    }
    return ChampionState(champions, tuple(sorted(both, key=lambda line: line.when)), candidates)


def _key(line: HistoryLine) -> tuple[str, str, str]:
    return line.loop, line.when, line.champion.md5


def _lines(state: ChampionState, loop: str) -> set[tuple[str, str, str]]:
    return {_key(line) for line in state.history if line.loop == loop}


# ---- a night's promotions beside those that wait


def beside(night: Night, state: ChampionState, there: Waiting) -> tuple[Night, ChampionState]:
    """The night without the promotions that add nothing to what waits: the same files, or a mean cost on the
    same panel that is no lower. Then what will be in production once the branch is merged, with tonight's
    promotions on top."""
    outranked = {
        loop: reason
        for loop in night.promoted
        if (reason := _outranked(state.champions[loop], there.champions.get(loop)))
    }
    promoted = tuple(loop for loop in night.promoted if loop not in outranked)
    joint = there.state._replace(candidates=state.candidates)
    for loop in promoted:
        event = night.decisions[loop].decision
        joint = champion.in_production(joint, loop, state.champions[loop], event=event)
    if not outranked:
        return night, joint
    decisions = {
        loop: decision._replace(decision=KEPT, reasons=[outranked[loop]]) if loop in outranked else decision
        for loop, decision in night.decisions.items()
    }
    reasons = [f"{loop}: {reason}" for loop, one in decisions.items() for reason in one.reasons]
    night = night._replace(decisions=decisions, promoted=promoted)
    outcome = PROMOTED if promoted else CANDIDATE if night.candidates else KEPT
    return night.ended(outcome, *reasons), joint


def _outranked(challenger: Champion, there: Champion | None) -> str:
    """Why a challenger that beats the champion is not added to what waits; empty where it is."""
    if there is None:
        return ""
    if _controller(challenger) == _controller(there):
        return f"the challenger is that of {there.run}, byte for byte, which waits on the branch"
    ours, theirs = challenger.metrics, there.metrics
    if not (ours and theirs) or ours.panel != theirs.panel:
        return ""
    if ours.mean_cost is not None and theirs.mean_cost is not None and ours.mean_cost >= theirs.mean_cost:
        return (
            f"the challenger is better than the champion, but no better than that of {there.run}, which "
            f"waits "
            f"on the branch: mean cost {ours.mean_cost:.4g} beside {theirs.mean_cost:.4g}"
        )
    return ""


def _controller(one: Champion) -> tuple[str, dict[str, str]]:
    """Which contestant it is, and its files; what its recordings said lies beside them, and is none of it."""
    from pipeline.nightly.screening import REFERENCE

    return one.contestant, {name: md5 for name, md5 in one.installed.files.items() if name != REFERENCE}


def committed(settings: Nightly, paths: list[str], message: str, night: Night, there: Waiting) -> str:
    """The night's commit on the branch: HEAD with these paths, tonight's champions, and the others that wait.
    Its hash. `champion.as_committed` puts the checkout's champions back."""
    for loop, former in there.champions.items():
        if loop not in night.promoted:
            champion.write_pointer(loop, former)
    return commit([*paths, *champion.paths()], message, branch=settings.branch, tip=there.tip)


def told(settings: Nightly, night: Night, there: Waiting) -> list[str]:
    """What waits, and the command that merges it."""
    if settings.promotion != "branch":
        return []
    runs = [
        f"{former.run} ({loop})" for loop, former in there.champions.items() if loop not in night.promoted
    ]
    runs += [f"{night.run} ({loop})" for loop in night.promoted]
    if not runs:
        return []
    return [
        f"on branch {settings.branch} wait{'s' if len(runs) == 1 else ''} {', '.join(runs)}: "
        f"./run beadline nightly --merge {settings.branch} puts {'it' if len(runs) == 1 else 'them'} into "
        f"production (in another clone: git merge {settings.branch}, and dvc pull)"
    ]
