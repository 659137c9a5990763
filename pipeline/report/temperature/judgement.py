"""What both pages say of the temperature loop: questions, figures by contestant, verdict, and how the figures
moved since the accepted run."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from pipeline.report.shared.difference import Difference, Move, difference, moves
from pipeline.report.shared.sources import Sources
from pipeline.verdict.controllers import YARDSTICKS, heading, in_a_sentence, kind
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
from pipeline.verdict.digits import count, listed, short
from pipeline.verdict.evidence import Figures, entry
from pipeline.verdict.night import Drift, drift, in_production
from pipeline.verdict.pairs import pair_names, pair_sentence, reference_of
from pipeline.verdict.temperature import comparison, of_controller
from pipeline.verdict.verdict import OPEN, Answers, Figure, PairSentence, Question, Verdict
from pipeline.verdict.wording import name_first


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


def heads(names: Sequence[str]) -> list[dict[str, str]]:
    """The contestants above columns of rules or figures."""
    return [{"mark": name, "name": heading(name), "kind": kind(name)} for name in names]


def verdict_parts(judged: Judgement, *, claim: str = "") -> dict[str, Any]:
    """The head of the page: decision, reason, remedy, rules with the numbers of their answers and their
    states for the two contestants, and what changed since the accepted run; `claim` says under which
    condition it holds."""
    verdict = judged.verdict
    parameters = judged.changed.parameters if judged.changed else []
    changed = f"{count(len(parameters), 'parameter').capitalize()} changed since the accepted run"
    return {
        "state": verdict.word,
        "decision": verdict.decision,
        "lead": verdict.lead,
        "reason": verdict.reason,
        "remedy": verdict.remedy,
        "heads": heads((judged.subject, judged.rival)),
        "rules": [
            {
                "rule": line[0].name[:1].upper() + line[0].name[1:],
                "answers": groups()[line[0].name][1],
                "states": [rule.state for rule in line],
                "first": line[0].name == verdict.rule,
            }
            for line in verdict.rules
        ],
        "claim": claim,
        "changed": changed if parameters else "",
    }


def shown(judged: Judgement) -> dict[str, dict[str, dict[str, float | None]]]:
    """The figures of the pages as numbers, for the metrics: later runs are held against them. None is
    without end."""
    return {
        name: {
            key: {
                end: value if math.isfinite(value) else None
                for end, value in zip(("median", "low", "high"), figure[:3], strict=True)
            }
            for key, figure in answers.items()
            if isinstance(figure, Figure)
        }
        for name, answers in judged.answers.items()
    }


def deciding_sentence(figures: Figures, winner: str | None) -> str:
    """Which case decides, and the verdict without its plant."""
    case = entry(comparison(figures), "deciding")
    if not isinstance(case, Mapping) or entry(case, "plant") is None:
        return ""
    compared, plant = comparison(figures), case["plant"]
    kind = f", {reference_of(case)}" if case.get("kind") else ""
    changes = []
    if entry(compared, "best") == winner and case.get("best_without") != winner:
        other = case.get("best_without")
        changes.append(f"the best would be {in_a_sentence(other)}" if other else "nobody would pass")
    pair = entry(compared, "pair", "winner")
    if case.get("pair_without") != pair:
        other = case.get("pair_without")
        changes.append(
            f"the pair would go to {in_a_sentence(other)}" if other else "the pair would be undecided"
        )
    without = " and ".join(changes) if changes else "the verdict is the same"
    return f"Deciding case: plant {plant}{kind}. Without plant {plant} {without}."


def best_sentence(figures: Figures, held: Mapping[str, Standing], winner: str | None) -> str:
    """The best of all contestants, beside the pair."""
    if winner is None:
        cheapest = entry(comparison(figures), "best_reason", "leading")
        costs = f" {name_first(cheapest)} costs least." if cheapest in held else ""
        return f"Best of all: nobody passes every rule.{costs}"
    others = [
        in_a_sentence(name)
        for name, standing in held.items()
        if standing.passes and name != winner and name not in YARDSTICKS
    ]
    beside = f"; {listed(others)} {'passes' if len(others) == 1 else 'pass'} too" if others else ""
    cheapest = entry(comparison(figures), "best")
    if cheapest in held and cheapest != winner:
        return (
            f"On this record {in_a_sentence(cheapest)} is the best{_ahead(figures, cheapest)}; "
            f"named is {in_a_sentence(winner)}{beside}."
        )
    return f"Best of all that pass: {in_a_sentence(winner)}{_ahead(figures, winner)}{beside}."


def _ahead(figures: Figures, winner: str) -> str:
    """By how much the winner is cheaper than the cheapest other that passes, or that chance may be it."""
    reason = entry(comparison(figures), "best_reason")
    percent, p = entry(reason, "improvement_percent"), entry(reason, "p")
    if entry(comparison(figures), "best") != winner or not isinstance(percent, int | float):
        return ""
    nearest = in_a_sentence(entry(reason, "nearest"))
    if isinstance(p, int | float) and p < 0.05 and percent > 0:
        return f", {short(percent, 2)}\u00a0% cheaper than {nearest}"
    chance = f", the simplest; {nearest} is cheaper by no more than chance"
    return chance if percent < 0 else f"; {nearest} is next"
