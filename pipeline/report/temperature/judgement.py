"""What both pages say of the temperature loop: questions, figures by contestant, verdict, and how the figures
moved since the accepted run."""

import math
from collections.abc import Mapping
from typing import NamedTuple

from pipeline.report.identification.model import UNTRUSTED, trust
from pipeline.report.shared.difference import Difference, Move, difference, moves
from pipeline.report.shared.digits import count
from pipeline.report.shared.sources import Declared, Sources, Table
from pipeline.report.shared.verdict import (
    OPEN,
    PASSED,
    Answers,
    Figure,
    Missing,
    Question,
    ReportRules,
    Verdict,
)
from pipeline.report.temperature.answers import Metrics, comparison, entry, of_contestant
from pipeline.report.temperature.contestants import YARDSTICKS, heading, kind
from pipeline.report.temperature.drifted import Drift, drift
from pipeline.report.temperature.pairs import PairSentence, deciding_sentence, pair_names, pair_sentence
from pipeline.report.temperature.verdict import (
    GROUPS,
    Standing,
    best_sentence,
    choose,
    closest,
    decide,
    questions,
    rival,
    standings,
)
from pipeline.temperature.settings import Plant


class Judgement(NamedTuple):
    """What both pages say.

    `subject` is the contestant that the verdict is about, the best or the closest to passing; `rival` stands
    beside it. `held` are all contestants before the rules. `changed` is None without an accepted run, and
    where that is of another machine.
    """

    asked: list[Question]
    held: Mapping[str, Standing]
    subject: str
    rival: str
    answers: Mapping[str, Answers]
    verdict: Verdict
    pair: PairSentence
    deciding: str
    best: str
    changed: Difference | None
    moved: Mapping[str, list[Move]]
    drifted: Drift


def winner(
    metrics: Metrics,
    rules: ReportRules,
    machine: Plant,
    *,
    recorded: bool,
    model: Mapping[str, Table | Missing],
) -> Verdict:
    """The verdict that the run gives by itself: without a night's drift, and without who runs today; `model`
    are the tables by which page one trusts a recorded machine's model, "residuals" and "dynamics"."""
    verdict = decide(metrics, rules, recorded=recorded, undeclared=undeclared_outputs(machine))
    if not recorded:
        return verdict
    return trust_first(
        verdict, trust(Sources(Declared(rules, machine, {}), metrics, model, {}, {}, None, ""))
    )


def judgement(sources: Sources, *, named: str = "") -> Judgement:
    """What the pages say; where somebody has `named` the contestant that runs, the verdict is about it."""
    metrics, rules = sources.metrics, sources.declared.rules
    drifted = drift(sources)
    undeclared = undeclared_outputs(sources.declared.machine)
    asked = questions(rules, comparison(metrics))
    held = standings(metrics, rules, undeclared=undeclared, drift=drifted.answer)
    incumbent = in_production(sources)
    best = choose(metrics, held, incumbent)
    competing = [name for name in held if name not in YARDSTICKS]
    subject = best or (closest(held) if competing else pair_names(metrics)[0])
    beside = rival(metrics, subject)
    answers = {name: of_contestant(metrics, name, undeclared) for name in (*held, subject, beside)}
    changed = None if sources.another_machine else difference(sources)
    moved = moves(sources, asked, answers) if changed else {}
    verdict = decide(
        metrics,
        rules,
        recorded=sources.recorded,
        undeclared=undeclared,
        drift=drifted.answer,
        incumbent=incumbent,
        named=named,
        quick=sources.quick,
    )
    if sources.recorded:
        verdict = trust_first(verdict, trust(sources))
    return Judgement(
        asked,
        held,
        subject,
        beside,
        answers,
        verdict,
        pair_sentence(metrics),
        deciding_sentence(metrics, best),
        best_sentence(metrics, held, best),
        changed,
        moved,
        drifted,
    )


def undeclared_outputs(machine: Plant) -> list[str]:
    """Outputs whose lowest or highest allowed temperature nobody declared."""
    return [output.name for output in machine.outputs if output.low is None or output.high is None]


def in_production(sources: Sources) -> str:
    """The contestant that runs, as the nightly job wrote it; "" if no night has promoted one."""
    runs = entry(sources.nightly, "champion", "temperature", "contestant")
    return runs if isinstance(runs, str) else ""


def named_before(sources: Sources) -> str:
    """The contestant in production, else the one that the accepted run of this machine named; "" if there is
    neither. A page shows the accepted one beside the others; it decides nothing, because `export_controllers`
    does not read it and the two would name different controllers."""
    if runs := in_production(sources):
        return runs
    if not isinstance(sources.accepted, dict) or sources.another_machine:
        return ""
    return str(sources.accepted.get("winner") or "")


def trust_first(verdict: Verdict, model: Verdict) -> Verdict:
    """The verdict on contestants that were judged on an identified model. Where that model is good for no
    use, this comes before every rule that its figures pass or fail, and nothing is ready."""
    if not model.decision.startswith(UNTRUSTED):
        return verdict
    first = verdict._replace(lead=model.decision, reason=f"{model.lead} {model.reason}", rule="trust")
    if verdict.state == PASSED:
        return first._replace(state=OPEN, decision="Not ready.", remedy=_remedy(model, ""), winner=None)
    return first._replace(remedy=_remedy(model, f"On that model: {verdict.lead} {verdict.reason}"))


def _remedy(model: Verdict, then: str) -> str:
    return f"{model.remedy} {then}".strip()


class RuleLine(NamedTuple):
    """A rule with the number of its answers, and its state for the two contestants that are shown."""

    rule: str
    answers: str
    states: tuple[str, ...]
    first: bool


class RulesHead(NamedTuple):
    """The contestant above a column of rules or answers."""

    mark: str
    name: str
    kind: str


class VerdictParts(NamedTuple):
    """The head of the page: decision, reason, remedy, rules, and what changed since the accepted run."""

    state: str
    decision: str
    lead: str
    reason: str
    remedy: str
    heads: list[RulesHead]
    rules: list[RuleLine]
    claim: str
    changed: str


def heads(judged: Judgement) -> list[RulesHead]:
    return [RulesHead(name, heading(name), kind(name)) for name in (judged.subject, judged.rival)]


def verdict_parts(judged: Judgement, *, claim: str = "") -> VerdictParts:
    """The verdict in words; `claim` says under which condition it holds."""
    verdict = judged.verdict
    rules = [
        RuleLine(
            line[0].name[:1].upper() + line[0].name[1:],
            GROUPS[line[0].name][1],
            tuple(rule.state for rule in line),
            first=line[0].name == verdict.rule,
        )
        for line in verdict.rules
    ]
    parameters = judged.changed.parameters if judged.changed else []
    changed = f"{count(len(parameters), 'parameter').capitalize()} changed since the accepted run"
    return VerdictParts(
        verdict.word,
        verdict.decision,
        verdict.lead,
        verdict.reason,
        verdict.remedy,
        heads(judged),
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
            if isinstance(f, Figure)
        }
        for name, answers in judged.answers.items()
    }


def _plain(value: float) -> float | None:
    return value if math.isfinite(value) else None
