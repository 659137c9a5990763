"""What both pages say of the temperature loop: questions, answers, verdict, and how the figures moved."""

import math
from collections.abc import Mapping
from typing import NamedTuple

from pipeline.report.identification.model import UNTRUSTED, trust
from pipeline.report.shared.difference import Difference, Move, difference, moves
from pipeline.report.shared.digits import count
from pipeline.report.shared.sources import Sources
from pipeline.report.shared.verdict import OPEN, PASSED, Figure, Missing, Question, Verdict
from pipeline.report.temperature.answers import CONTROLLERS, all_answers
from pipeline.report.temperature.drifted import Drift, drift
from pipeline.report.temperature.verdict import ANSWERS, decide, questions

NAMES = {"data_driven": "Data\u2011driven", "model_based": "Model\u2011based", "baseline": "Baseline"}


class Judgement(NamedTuple):
    """What both pages say: questions, answers by controller and by role, the verdict, and the difference;
    None too where the accepted run is of another machine."""

    asked: list[Question]
    by_name: Mapping[str, Mapping[str, Figure | Missing]]
    roles: Mapping[str, Mapping[str, Figure | Missing]]
    verdict: Verdict
    changed: Difference | None
    moved: Mapping[str, list[Move]]
    drifted: Drift


def judgement(sources: Sources) -> Judgement:
    asked = questions(sources.declared.rules, band_degC=sources.declared.panel.band_degC)
    drifted = drift(sources)
    # of the machine, and so of every controller that was learned from its record
    by_name = {
        name: {**answers, "drift": drifted.answer} for name, answers in all_answers(sources, asked).items()
    }
    roles = {role: by_name[name] for role, name in CONTROLLERS.items()}
    changed = None if sources.another_machine else difference(sources)
    moves_of = moves(sources, asked, by_name) if changed else {}
    moved = {role: moves_of[name] for role, name in CONTROLLERS.items()} if changed else {}
    verdict = decide("temperature", asked, roles)
    if sources.recorded:
        verdict = trust_first(verdict, trust(sources))
    return Judgement(asked, by_name, roles, verdict, changed, moved, drifted)


def trust_first(verdict: Verdict, model: Verdict) -> Verdict:
    """The verdict on controllers that were judged on an identified model. Where that model is good for no
    use, this comes before every rule that its figures pass or fail, and no controller is deployed."""
    if not model.decision.startswith(UNTRUSTED):
        return verdict
    first = verdict._replace(lead=model.decision, reason=f"{model.lead} {model.reason}", rule="trust")
    if verdict.state == PASSED:
        return first._replace(
            state=OPEN, decision="Do not decide yet.", remedy=_remedy(model, ""), winner=None
        )
    return first._replace(remedy=_remedy(model, f"On that model: {verdict.lead} {verdict.reason}"))


def _remedy(model: Verdict, then: str) -> str:
    return f"{model.remedy} {then}".strip()


class RuleLine(NamedTuple):
    """A rule with the number of its answers, and its state for the two controllers that compete."""

    rule: str
    answers: str
    states: tuple[str, str]
    first: bool


class VerdictParts(NamedTuple):
    """The head of the page: decision, reason, remedy, rules, and what changed since the accepted run."""

    state: str
    decision: str
    lead: str
    reason: str
    remedy: str
    rules: list[RuleLine]
    claim: str
    changed: str


def verdict_parts(judged: Judgement, *, claim: str = "") -> VerdictParts:
    """The verdict in words; `claim` says under which condition it holds."""
    verdict = judged.verdict
    rules = [
        RuleLine(
            learned.name[:1].upper() + learned.name[1:],
            ANSWERS[learned.name],
            (learned.state, designed.state),
            first=learned.name == verdict.rule,
        )
        for learned, designed, _ in verdict.rules
    ]
    parameters = judged.changed.parameters if judged.changed else []
    changed = f"{count(len(parameters), 'parameter').capitalize()} changed since the accepted run"
    return VerdictParts(
        verdict.word,
        verdict.decision,
        verdict.lead,
        verdict.reason,
        verdict.remedy,
        rules,
        claim,
        changed if parameters else "",
    )


def shown(judged: Judgement) -> dict[str, dict[str, dict[str, float | None]]]:
    """The figures of the pages as numbers, for the metrics: later runs are held against them."""
    return {
        name: {
            key: {"median": _plain(f.value), "low": _plain(f.low), "high": _plain(f.high)}
            for key, f in answers.items()
            if isinstance(f, Figure) and key != "drift"
        }
        for name, answers in judged.by_name.items()
    }


def _plain(value: float) -> float | None:
    return value if math.isfinite(value) else None
