"""Champion and challenger of each loop. A challenger that does not pass the rules of its page is a candidate,
which nothing runs; one that passes goes in production where it is better than the champion, or there is none.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.nightly import champion, judge, records, reporting, screening, verdicts
from pipeline.nightly.decision import CaseCosts, decide
from pipeline.nightly.records import (
    CANDIDATE,
    KEPT,
    Champion,
    ChampionState,
    LoopDecision,
    Night,
    candidate_of,
)
from pipeline.nightly.reproducing import read_stages
from pipeline.nightly.settings import Nightly, NightlyLoop
from pipeline.store import artifacts
from pipeline.verdict.verdict import PASSED, Verdict

# artifacts that only some contestants are designed from, and that a record may not determine
OPTIONAL = {f"datasets/{path}" for path in judge.DESIGNED_FROM.values()}
# the certified controller of the temperature loop, installed beside what it was designed from
CERTIFYING, EXPORTED = "export_controllers", "datasets/export_controllers/temperature"
CERTIFICATE = f"{EXPORTED}/certificate.json"
CERTIFIED = (f"{EXPORTED}/controller.json", f"{EXPORTED}/arrays.safetensors", CERTIFICATE)


# what was decided of a loop's challenger, and what the judge measured of it, if it was measured
JudgedLoop = tuple[LoopDecision, Mapping[str, Any] | None]


def judge_all(
    settings: Nightly, night: Night, state: ChampionState, lineage: Mapping[str, Any]
) -> ChampionState:
    """What is in production, and the candidates beside it; the night has a decision on each loop. Their files
    lie in champion/<loop> and champion/<loop>.candidate by then. Raises ValueError if no loop can be
    judged."""
    by_loop = verdicts.read_verdicts(settings, night)
    made_from = {**lineage, "dvc_lock": artifacts.sha256("dvc.lock")} if lineage else {}
    for name in settings.loops:
        verdict = by_loop.get(name)
        try:
            decision, metrics = judge_loop(settings, name, night, state, verdict)
        except reporting.REFUSALS as error:  # what cannot be judged stops no other loop
            why = " ".join(str(error).split())
            decision = LoopDecision(records.FAILED, [f"it cannot be judged, and its champion stays: {why}"])
            metrics = None
        decision = decision._replace(verdict=verdict and verdict._replace(rules=()))
        night.decisions[name] = decision
        waits = decision.decision == CANDIDATE
        if decision.promotes or waits:
            state = _place(settings, name, night, state, (decision, metrics), made_from)
        if name in state.candidates and not waits and verdict and verdict.state == PASSED:
            state = _drop_candidate(state, name)
    if night.lost == list(night.decisions):
        raise ValueError("; ".join(f"{name}: {one.reasons[0]}" for name, one in night.decisions.items()))
    outcome = records.PROMOTED if night.promoted else CANDIDATE if night.candidates else KEPT
    reasons = (f"{name}: {reason}" for name, one in night.decisions.items() for reason in one.reasons)
    night.end(outcome, *reasons)
    return state


# ---- one loop


def judge_loop(
    settings: Nightly, name: str, night: Night, state: ChampionState, verdict: Verdict | None
) -> JudgedLoop:
    """What becomes of the challenger of one loop, with what it measured; `verdict` is None if the loop has no
    page."""
    loop, present = settings.loops[name], state.champions.get(name)
    files = list_files(loop)
    contestant = verdict.subject if verdict else _declared(settings, name)
    if lacking := champion.missing([path for path in loop.artifacts if path not in OPTIONAL]):
        return _keep(f"the challenger lacks {lacking[0]}; its stage did not write it")
    passes = verdict is None or verdict.state == PASSED
    same = present is not None and champion.same(present.files, files)
    if same and (not passes or runs(settings, name, present, contestant) == contestant):
        does_not = "" if passes else f", which does not pass: {verdict.sentence}"
        return _keep(f"the challenger is the champion, byte for byte{does_not}")
    if run := champion.find_rolled_back(state, name, files):
        return _keep(f"the challenger is that of {run}, which was rolled back by hand")
    judging = judge.judge(loop, settings)
    why = find_missing_certificate(loop, contestant) if passes else verdict.sentence
    if verdict and why:
        return _candidate(judging, verdict, state.candidates.get(name), files, why)
    own = f"datasets/{judge.DESIGNED_FROM[contestant]}" if contestant in judge.DESIGNED_FROM else ""
    if own and own not in loop.artifacts:
        return _keep(
            f"{contestant} is designed from {own}, which the champion would lack; add it to "
            f"nightly.loops.{name}.artifacts"
        )
    try:
        challenger = judging.measure(Path("datasets"), contestant)
        before = None
        if present:
            before = judging.measure(champion.FOLDER / name, runs(settings, name, present, contestant))
    except judge.NotComparable as reason:
        return _keep(f"champion and challenger cannot be compared: {reason}")
    decision = decide(
        before,
        challenger,
        settings.rule,
        allowed=judging.allowed(before) if before else {},
        alarms=[alarm for alarm in night.drift.alarms if alarm.loop == name],
        seed=night.number,
    )
    return decision, _metrics(challenger)


def list_files(loop: NightlyLoop) -> list[str]:
    """The artifacts of a loop without the optional ones that its record did not determine."""
    return [path for path in loop.artifacts if path not in OPTIONAL or Path(path).is_file()]


def runs(settings: Nightly, loop: str, present: Champion, contestant: str) -> str:
    """The contestant that a champion runs as. A loop without a page has none: it is the declared one, or
    the challenger's."""
    return present.contestant or _declared(settings, loop) or contestant


def _declared(settings: Nightly, loop: str) -> str:
    return judge.declared(settings.holdout) if settings.loops[loop].judge == "temperature" else ""


def _keep(reason: str) -> JudgedLoop:
    return LoopDecision(KEPT, [reason]), None


def _metrics(evidence: CaseCosts) -> dict[str, Any]:
    mean_cost = float(np.mean([cost for _, cost in evidence.cases.values()]))
    return {
        "panel": evidence.panel,
        "mean_cost": mean_cost if np.isfinite(mean_cost) else None,
        "guards": {name: figure for name, figure in evidence.guards.items() if np.isfinite(figure)},
    }


def find_missing_certificate(loop: NightlyLoop, contestant: str) -> str:
    """Why a challenger of the temperature loop that passes the page's rules has no certificate; empty if it
    has one, and if the project has no stage that certifies."""
    if not _asks_for_one(loop):
        return ""
    if not artifacts.exists(CERTIFICATE):
        return f"no certificate: {CERTIFYING} wrote none of {contestant}"
    shown = artifacts.read_json(CERTIFICATE)
    if shown.get("controller") != contestant:
        return f"no certificate: that of {CERTIFYING} is of {shown.get('controller')}, not of {contestant}"
    if shown.get("verdict") != "passed":
        return f"certificate refused by its rule {str(shown.get('first_failed')).replace('_', ' ')}"
    lacking = champion.missing(CERTIFIED)
    return f"no certified controller: {lacking[0]} is missing" if lacking else ""


def _asks_for_one(loop: NightlyLoop) -> bool:
    """Whether a loop's champion needs a certificate: that of the temperature loop, if the project has the
    stage that certifies."""
    return loop.judge == "temperature" and CERTIFYING in read_stages("dvc.yaml")


def _candidate(
    judging: judge.Judge, verdict: Verdict, before: Champion | None, files: list[str], why: str
) -> JudgedLoop:
    """A challenger that the page's rules or its certificate keep out of production, and `why`, with what it
    measures all the same."""
    decision = LoopDecision(CANDIDATE, [why])
    if before and before.contestant == verdict.subject and champion.same(before.files, files):
        return decision, before.metrics
    try:
        evidence = judging.measure(Path("datasets"), verdict.subject)
    except ValueError as reason:
        return decision._replace(reasons=[why, f"not measured: {reason}"]), None
    guards = {
        name: {"champion": None, "challenger": figure, "allowed": None}
        for name, figure in evidence.guards.items()
    }
    return decision._replace(guards=guards), _metrics(evidence)


# ---- what lies in champion/


def _place(
    settings: Nightly,
    name: str,
    night: Night,
    state: ChampionState,
    judged: JudgedLoop,
    lineage: Mapping[str, Any],
) -> ChampionState:
    """The state with a challenger in production or as the candidate; its files lie in that folder then."""
    decision, metrics = judged
    loop, verdict, waits = settings.loops[name], decision.verdict, not decision.promotes
    files, why = list_files(loop), "; ".join(decision.reasons)
    before = state.candidates.get(name) if waits else None
    if before and champion.same(before.files, files):
        one = before._replace(why=why, metrics=metrics)
    else:
        reference = None if waits else screening.reference(loop, Path("datasets"))
        beside = {screening.REFERENCE: reference} if reference else {}
        certified = [path for path in CERTIFIED if _asks_for_one(loop) and Path(path).is_file()]
        folder = candidate_of(name) if waits else name
        pointer, md5s = champion.install(folder, [*files, *certified], beside)
        one = Champion(night.run, night.when, why, pointer, md5s, metrics, lineage)
    if verdict:
        one = one._replace(contestant=verdict.subject, rehearsal=verdict.rehearsal, verdict=verdict.sentence)
    if waits:
        return state._replace(candidates={**state.candidates, name: one})
    return champion.promote(state, name, one, event=decision.decision)


def _drop_candidate(state: ChampionState, name: str) -> ChampionState:
    """The state after a challenger has passed: what did not pass before it is of no more use."""
    champion.remove(candidate_of(name))
    return state._replace(candidates={loop: one for loop, one in state.candidates.items() if loop != name})
