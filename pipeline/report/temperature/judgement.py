"""What both pages say of the temperature loop: questions, figures by contestant, verdict, and how the figures
moved since the accepted run."""

import math
from collections.abc import Mapping
from typing import NamedTuple

from pipeline.report.shared.difference import Difference, Move, difference, moves
from pipeline.report.shared.sources import Sources
from pipeline.report.temperature.beside import best_sentence, deciding_sentence
from pipeline.verdict.controllers import heading, kind
from pipeline.verdict.decide import (
    LOOP,
    Standing,
    choose,
    groups,
    questions,
    rival,
    standings,
    undeclared_outputs,
)
from pipeline.verdict.digits import count
from pipeline.verdict.night import Drift, drift, in_production
from pipeline.verdict.pairs import pair_names, pair_sentence
from pipeline.verdict.temperature import comparison, of_controller
from pipeline.verdict.verdict import OPEN, Answers, Figure, PairSentence, Question, Verdict


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


def judgement(sources: Sources) -> Judgement:
    """What the pages say of the verdict, and the figures that stand behind it."""
    evidence, drifted = sources.evidence, drift(sources.nightly)
    figures = evidence.figures
    # of a loop that is switched off the pages still know the names
    off = Verdict(LOOP, OPEN, "", "", "", "", "", None, subject=pair_names(figures)[0])
    verdict = sources.verdicts.get(LOOP, off)
    asked = questions(evidence.rules, comparison(figures))
    held = standings(evidence, drifted.answer)
    subject, beside = verdict.subject, rival(figures, verdict.subject)
    undeclared = undeclared_outputs(evidence)
    answers = {name: of_controller(figures, name, undeclared) for name in (*held, subject, beside)}
    changed = None if sources.another_machine else difference(sources)
    best = (
        verdict.winner if verdict.rule != "trust" else choose(figures, held, in_production(sources.nightly))
    )
    return Judgement(
        asked,
        held,
        subject,
        beside,
        answers,
        verdict,
        pair_sentence(figures),
        deciding_sentence(figures, best),
        best_sentence(figures, held, best),
        changed,
        moves(sources, asked, answers) if changed else {},
        drifted,
    )


def named_before(sources: Sources) -> str:
    """The contestant in production, else the one that the accepted run of this machine named; "" if there is
    neither. A page shows the accepted one beside the others; it decides nothing, because `export_controllers`
    does not read it and the two would name different controllers."""
    if runs := in_production(sources.nightly):
        return runs
    if not isinstance(sources.accepted, dict) or sources.another_machine:
        return ""
    return str(sources.accepted.get("winner") or "")


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
            groups()[line[0].name][1],
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
