"""Compares champion and challenger of each loop. A challenger that does not pass the rules of its page
becomes a candidate, which is stored but not run. One that passes goes into production if it is better than
the champion, or if there is no champion.

The verdict of each loop is that of this run, with this run's drift and with the controllers in production.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.nightly import champion, judge, records, reporting, screening
from pipeline.nightly.decision import decide
from pipeline.nightly.processes import dvc
from pipeline.nightly.records import (
    CANDIDATE,
    KEPT,
    Champion,
    ChampionState,
    LoopDecision,
    Night,
    candidate_of,
)
from pipeline.nightly.remembered import METRICS
from pipeline.nightly.reproducing import read_stages
from pipeline.nightly.settings import Nightly, NightlyLoop
from pipeline.store import artifacts
from pipeline.verdict import night as verdict_night
from pipeline.verdict import verdict as verdicts
from pipeline.verdict.files import read_evidence
from pipeline.verdict.verdict import PASSED, Verdict

STORED = "datasets/verdict"
REPORT = "datasets/report/figures.json"
# artifacts that only some controllers are designed from, and that a record may not determine
OPTIONAL = {f"datasets/{path}" for path in judge.DESIGNED_FROM.values()}
# the certified controller of the temperature loop, stored beside the artifacts that it was designed from
CERTIFYING, EXPORTED = "export_controllers", "datasets/export_controllers/temperature"
CERTIFICATE = f"{EXPORTED}/certificate.json"
CERTIFIED = (f"{EXPORTED}/controller.json", f"{EXPORTED}/arrays.safetensors", CERTIFICATE)


def judge_all(
    settings: Nightly, night: Night, state: ChampionState, lineage: Mapping[str, Any]
) -> ChampionState:
    """Decides on each loop and returns the new state of production and candidates. Their files then lie in
    champion/<loop> and champion/<loop>.candidate. Raises ValueError if no loop can be judged."""
    by_loop = read_verdicts(settings, night)
    for name in settings.loops:
        verdict = by_loop.get(name)
        try:
            decision = judge_loop(settings, name, night, state, verdict)
        except reporting.REFUSALS as error:  # a loop that cannot be judged stops no other loop
            why = " ".join(str(error).split())
            decision = LoopDecision(records.FAILED, [f"it cannot be judged, and its champion stays: {why}"])
        decision = decision._replace(verdict=verdict and verdict._replace(rules=()))
        night.decisions[name] = decision
        waits = decision.decision == CANDIDATE
        if decision.promotes or waits:
            state = _place(settings.loops[name], name, night, state, lineage)
        if name in state.candidates and not waits and verdict and verdict.state == PASSED:
            # the earlier candidate, which did not pass, is no longer needed
            champion.remove(candidate_of(name))
            others = {loop: one for loop, one in state.candidates.items() if loop != name}
            state = state._replace(candidates=others)
    if night.lost == list(night.decisions):
        raise ValueError("; ".join(f"{name}: {one.reasons[0]}" for name, one in night.decisions.items()))
    outcome = records.PROMOTED if night.promoted else CANDIDATE if night.candidates else KEPT
    reasons = (f"{name}: {reason}" for name, one in night.decisions.items() for reason in one.reasons)
    night.end(outcome, *reasons)
    return state


# ---- the verdicts that the night obeys


def read_verdicts(settings: Nightly, night: Night) -> dict[str, Verdict]:
    """Returns the verdict of each loop that has a page, as on the pages. A loop judged by a file of costs has
    none; the guards of that file are its rules. If nightly.holdout.controller names a controller, the
    temperature loop's verdict is about that one. Raises ValueError if a verdict is missing."""
    loops = [name for name, loop in settings.loops.items() if loop.judge != "cases"]
    if not loops:
        return {}
    evidence, stored, named = read_evidence(STORED), verdicts.read(STORED), settings.holdout.controller
    tonight = artifacts.read_json(METRICS) if artifacts.exists(METRICS) else None
    by_loop = verdict_night.verdicts(evidence, stored, tonight)
    _make_pages_agree(by_loop, night)
    if named != judge.PAGE:
        by_loop = verdict_night.verdicts(evidence, stored, tonight, named=named)
    if lacking := [name for name in loops if name not in by_loop]:
        raise ValueError(
            f"{STORED}/{lacking[0]}.json: expected the verdict of this run, found none; "
            "run ./run dvc repro verdict, or switch the loop off in section loops"
        )
    return {name: by_loop[name] for name in loops}


def _make_pages_agree(pages: Mapping[str, Verdict], night: Night) -> None:
    """Renders the pages again if they were made before drift or production changed, so that they agree with
    this run."""
    shown = (artifacts.read_json(REPORT).get("verdicts") or {}) if artifacts.exists(REPORT) else None
    if shown is None or all(shown.get(loop) == verdict.metrics() for loop, verdict in pages.items()):
        return
    try:
        dvc("repro", "--single-item", "--force", "report")
    except ValueError as error:
        night.notes.append(f"the pages are not of tonight ({error}); run ./run dvc repro --force report")


# ---- one loop


def judge_loop(
    settings: Nightly, name: str, night: Night, state: ChampionState, verdict: Verdict | None
) -> LoopDecision:
    """Returns the decision on the challenger of one loop; `verdict` is None if the loop has no page."""
    loop, present, files = settings.loops[name], state.champions.get(name), list_files(settings.loops[name])
    contestant = verdict.subject if verdict else ""
    runs = (present.contestant if present else "") or contestant
    if lacking := champion.missing([path for path in loop.artifacts if path not in OPTIONAL]):
        return _keep(f"the challenger lacks {lacking[0]}; its stage did not write it")
    passes = verdict is None or verdict.state == PASSED
    if present and champion.same(present.files, files) and (runs == contestant or not passes):
        does_not = "" if passes else f", which does not pass: {verdict.sentence}"
        return _keep(f"the challenger is the champion, byte for byte{does_not}")
    if run := champion.find_rolled_back(state, name, files):
        return _keep(f"the challenger is that of {run}, which was rolled back by hand")
    why = find_missing_certificate(loop, contestant) if passes else verdict.sentence
    if verdict and why:
        return LoopDecision(CANDIDATE, [why])
    own = f"datasets/{judge.DESIGNED_FROM[contestant]}" if contestant in judge.DESIGNED_FROM else ""
    if own and own not in loop.artifacts:
        return _keep(
            f"{contestant} is designed from {own}, which the champion would lack; add it to "
            f"nightly.loops.{name}.artifacts"
        )
    judging = judge.judge(loop, settings)
    try:
        challenger = judging.measure(Path("datasets"), contestant)
        before = judging.measure(champion.FOLDER / name, runs) if present else None
    except judge.NotComparable as reason:
        return _keep(f"champion and challenger cannot be compared: {reason}")
    return decide(
        before,
        challenger,
        settings.rule,
        allowed=judging.allowed(before) if before else {},
        alarms=[alarm for alarm in night.drift.alarms if alarm.loop == name],
        seed=night.number,
    )


def _keep(reason: str) -> LoopDecision:
    return LoopDecision(KEPT, [reason])


def list_files(loop: NightlyLoop) -> list[str]:
    """Returns the artifacts of a loop, without optional ones that its record did not determine."""
    return [path for path in loop.artifacts if path not in OPTIONAL or Path(path).is_file()]


def find_missing_certificate(loop: NightlyLoop, contestant: str) -> str:
    """Returns why a challenger of the temperature loop that passes the page's rules has no certificate.
    Returns "" if it has one, or if the project has no stage that certifies."""
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
    """Returns whether a loop's champion needs a certificate: only that of the temperature loop, if the
    project has the stage that certifies."""
    return loop.judge == "temperature" and CERTIFYING in read_stages("dvc.yaml")


# ---- what lies in champion/


def _place(
    loop: NightlyLoop, name: str, night: Night, state: ChampionState, lineage: Mapping[str, Any]
) -> ChampionState:
    """Puts a challenger into production, or stores it as the candidate, and returns the new state. Its files
    then lie in that folder."""
    decision = night.decisions[name]
    waits, verdict = not decision.promotes, decision.verdict
    files, why = list_files(loop), "; ".join(decision.reasons)
    before = state.candidates.get(name) if waits else None
    if before and champion.same(before.files, files):
        one = before._replace(why=why)
    else:
        reference = None if waits else screening.reference(loop, Path("datasets"))
        beside = {screening.REFERENCE: reference} if reference else {}
        certified = [path for path in CERTIFIED if _asks_for_one(loop) and Path(path).is_file()]
        folder = candidate_of(name) if waits else name
        champion.remove(folder)
        pointer, hashes = champion.hand_over(folder, [*files, *certified], beside)
        one = Champion(night.run, night.when, why, pointer, hashes, lineage)
    if verdict:
        one = one._replace(contestant=verdict.subject, rehearsal=verdict.rehearsal, verdict=verdict.sentence)
    if waits:
        return state._replace(candidates={**state.candidates, name: one})
    return champion.promote(state, name, one, event=decision.decision)
