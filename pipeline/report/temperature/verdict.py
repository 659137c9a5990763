"""Metrics and rules of the temperature loop -> verdict: whether the best contestant passes, the first rule
that failed or is open, and what to do. Pure: no page, no file.

The night reads the same record: `decide` is a function of metrics and rules alone. Which contestant runs
today is told to it as `incumbent`; no stage that judges knows it.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from pipeline.report.temperature.answers import (
    Metrics,
    comparison,
    entry,
    finite,
    judged,
    of_contestant,
    unstable,
)
from pipeline.report.temperature.contestants import YARDSTICKS, heading, in_a_sentence
from pipeline.report.temperature.pairs import pair_names, pair_sentence, reference_of
from pipeline.report.temperature.wording import name_first, places_of, reason, worded
from pipeline.verdict.digits import short, with_unit
from pipeline.verdict.settings import ReportRules
from pipeline.verdict.verdict import (
    FAILED,
    FAILED_FIRST,
    OPEN,
    PASSED,
    TRIAL,
    UNDECIDED,
    UNJUDGED,
    Answers,
    Figure,
    Missing,
    Question,
    Rule,
    Verdict,
    Words,
    deciding,
    share,
    words_for,
)

LOOP = "temperature"
NEVER = Missing(OPEN, "The nightly job measures it and has not run")
# the five lines of the head of a page, the rules in each, and the answers of page one that show them
GROUPS = {
    "settled error": (("settled error",), "4"),
    "limits": (("settling", "overshoot", "time at limits", "disk margin", "delay margin"), "5\u20138"),
    "crossings": (("crossings",), "9"),
    "data sufficiency": (("data sufficiency",), "10"),
    "drift": (("drift",), "11"),
}
# judged on the median plant
MARGINS = ("disk", "delay_s")
# rules without which a contestant may pass: only the machine itself shows drift, once the controller runs
LATER = ("drift",)


# ---- the rules


def questions(rules: ReportRules, compared: Mapping[str, Any]) -> list[Question]:
    """What every contestant is asked, in its fixed order. The comparison resolves three limits for the
    machine: those that were declared, or those of a recorded machine's own pace."""

    def limit(name: str, declared: float | None) -> float:
        own = finite(entry(compared, "limits", name))
        return own if math.isfinite(own) and own > 0 else math.inf if declared is None else declared

    settled = limit("settled_error_degC", rules.settled_error_degC)
    settling, overshoot = limit("settling_s", rules.settling_s), limit("overshoot_degC", rules.overshoot_degC)
    return [
        Question(4, "settled_error", "Settled error, worst zone", "°C", settled, False, "settled error"),
        Question(5, "settling", "Settling", "s", settling, False, "settling"),
        Question(6, "overshoot", "Overshoot", "°C", overshoot, False, "overshoot"),
        Question(7, "at_limits", "Time at limits", "%", rules.at_limits_percent, False, "time at limits"),
        Question(8, "disk", "Margin: disk", "", rules.disk_margin, True, "disk margin", "unlimited"),
        Question(8, "delay_s", "Margin: delay", "s", rules.delay_margin_s, True, "delay margin", "unlimited"),
        Question(9, "crossings", "Crossings of low or high", "", 0.0, False, "crossings"),
        Question(
            10, "data", "Data: samples, of those needed", "×", 1.0, True, "data sufficiency", "unlimited"
        ),
    ]


def rules_of(
    asked: Sequence[Question], answers: Answers, drift: Figure | Missing, name: str = ""
) -> list[Rule]:
    """Every rule for one contestant, drift last; `name` speaks in the sentences."""
    held = []
    for question in asked:
        figure = answers[question.key]
        if isinstance(figure, Missing) and figure.state == UNJUDGED:
            held.append(Rule(question.rule, None, Figure(math.inf, math.inf, math.inf), text=figure.reason))
        else:
            rule = Rule(question.rule, question, figure, place=question.key)
            held.append(rule._replace(reason="" if rule.state == PASSED else reason(rule, name)))
    return [*held, Rule("drift", None, drift)]


def passes(held: Sequence[Rule]) -> bool:
    return all(
        rule.state == PASSED or (rule.name in LATER and rule.state in (OPEN, UNDECIDED)) for rule in held
    )


def first_in(held: Sequence[Rule]) -> Rule | None:
    """The rule that is named: the first that failed, else the first that is open; drift only where it
    failed. None where the contestant passes."""
    binding = [rule for rule in held if rule.name not in LATER or rule.state == FAILED]
    return deciding(binding, FAILED_FIRST)


def grouped(held: Sequence[Rule]) -> list[Rule]:
    """One rule a line of GROUPS: the one that decides in it, its first where all passed."""
    lines = []
    for group, (names, _) in GROUPS.items():
        mine = [rule for rule in held if rule.name in names]
        lines.append((deciding(mine, FAILED_FIRST) or mine[0])._replace(name=group))
    return lines


def group_of(rule: str) -> str:
    return next((group for group, (names, _) in GROUPS.items() if rule in names), rule)


# ---- who is judged


class Standing(NamedTuple):
    """One contestant before the rules."""

    name: str
    answers: Answers
    rules: list[Rule]

    @property
    def passes(self) -> bool:
        return passes(self.rules)


def standings(
    metrics: Metrics, rules: ReportRules, *, undeclared: Sequence[str] = (), drift: Figure | Missing = NEVER
) -> dict[str, Standing]:
    """Every contestant that was judged, in the order of simplicity, the yardstick last."""
    asked = questions(rules, comparison(metrics))
    held = {}
    for name in judged(metrics):
        answers = of_contestant(metrics, name, undeclared)
        own = [
            rule._replace(reason=_unstable_sentence(metrics, name) or rule.reason)
            if rule.state == FAILED and rule.name in ("settled error", "disk margin", "delay margin")
            else rule
            for rule in rules_of(asked, answers, drift, name)
        ]
        held[name] = Standing(name, answers, own)
    return held


def _unstable_sentence(metrics: Metrics, name: str) -> str:
    lost, of = unstable(entry(comparison(metrics), "contestants", name))
    return f"{name_first(name)} is unstable on {lost} of {of} plants." if lost else ""


def choose(metrics: Metrics, held: Mapping[str, Standing], incumbent: str = "") -> str | None:
    """Who should run: the best that passes, ties to the simpler; the incumbent if none is better beyond the
    bands of the cost. None if nobody passes."""
    fit = [name for name, standing in held.items() if standing.passes and name not in YARDSTICKS]
    if not fit:
        return None
    best = entry(comparison(metrics), "best")
    if best not in fit:
        cheapest = min(fit, key=lambda name: _cost(held[name]).value)
        best = next(name for name in fit if _cost(held[name]).low <= _cost(held[cheapest]).high)
    if incumbent in fit and _cost(held[incumbent]).low <= _cost(held[best]).high:
        return incumbent
    return best


def _cost(standing: Standing) -> Figure:
    cost = standing.answers["cost"]
    return cost if isinstance(cost, Figure) else Figure(math.inf, math.inf, math.inf)


def closest(held: Mapping[str, Standing]) -> str:
    """Of contestants that do not pass, the one with the fewest rules against it, then of the lowest cost."""

    def against(name: str) -> tuple[int, int, float]:
        states = [rule.state for rule in held[name].rules if rule.name not in LATER]
        return states.count(FAILED), len(states) - states.count(PASSED), _cost(held[name]).value

    competing = [name for name in held if name not in YARDSTICKS and name != "hold"]
    return min(competing or held, key=against)


def rival(metrics: Metrics, subject: str) -> str:
    """Who stands beside the contestant that the verdict is about: the other one of the pair, else its
    model-based one."""
    a, b = pair_names(metrics)
    return b if subject == a else a


# ---- the verdict


def decide(
    metrics: Metrics,
    rules: ReportRules,
    *,
    recorded: bool,
    undeclared: Sequence[str] = (),
    drift: Figure | Missing = NEVER,
    incumbent: str = "",
    named: str = "",
    quick: bool = False,
) -> Verdict:
    """The verdict on the temperature loop; `undeclared` are outputs without low and high. If somebody has
    `named` the contestant that runs, the verdict is about that one alone.

    `rules` of the verdict has a line for each of GROUPS with the contestant that it is about and its rival.
    """
    words = words_for(recorded=recorded, quick=quick)
    held = standings(metrics, rules, undeclared=undeclared, drift=drift)
    if not held or set(held) <= set(YARDSTICKS) or (named and named not in held):
        return _nothing(metrics, rules, words, drift, named)
    if named:
        best = named if held[named].passes else None
    else:
        best = choose(metrics, held, incumbent)
    subject = best or named or closest(held)
    beside = rival(metrics, subject)
    asked = questions(rules, comparison(metrics))
    theirs = (
        held[beside].rules
        if beside in held
        else rules_of(asked, of_contestant(metrics, beside, undeclared), drift, beside)
    )
    lines = tuple(zip(grouped(held[subject].rules), grouped(theirs), strict=True))
    if best:
        lost = "" if named else _beaten(metrics, held)
        verdict = _passed(metrics, held[best], words, lines, "" if lost else incumbent, recorded=recorded)
        return verdict._replace(reason=" ".join(filter(None, [lost, verdict.reason])))
    return _not_passed(metrics, held[subject], words, lines, named=bool(named))


def _beaten(metrics: Metrics, held: Mapping[str, Standing]) -> str:
    """Why the best of this record is not named, where it is one that does not pass; else ""."""
    best = entry(comparison(metrics), "best")
    first = first_in(held[best].rules) if best in held else None
    if first is None:
        return ""
    return f"{name_first(best)} is the best of this record and does not pass: {first.name} is {first.state}."


def _nothing(
    metrics: Metrics, rules: ReportRules, words: Words, drift: Figure | Missing, named: str
) -> Verdict:
    asked, (a, b) = questions(rules, comparison(metrics)), pair_names(metrics)
    pair = [rules_of(asked, of_contestant(metrics, name), drift, name) for name in (a, b)]
    lines = tuple(zip(*map(grouped, pair), strict=True))
    gap = metrics.get("evaluate_temperature")
    nobody = f"{name_first(named)} was not judged" if named else "No contestant was judged"
    why = gap if isinstance(gap, Missing) else Missing(OPEN, nobody)
    first = GROUPS_FIRST
    verdict = Verdict(
        LOOP,
        OPEN,
        words.undecided,
        f"First undecided rule: {first}.",
        why.sentence(),
        "",
        first,
        None,
        rules=lines,
    )
    return verdict._replace(subject=named or a)


GROUPS_FIRST = next(iter(GROUPS))


def _passed(
    metrics: Metrics,
    winner: Standing,
    words: Words,
    lines: tuple[tuple[Rule, ...], ...],
    incumbent: str,
    *,
    recorded: bool,
) -> Verdict:
    compared = comparison(metrics)
    everything = all(rule.state == PASSED for rule in winner.rules)
    plants = f"{entry(compared, 'plants')} {'plants' if recorded else 'simulated plants'}"
    lead = f"{'All rules' if everything else 'Every rule measured so far'} passed on {plants}."
    drift = winner.rules[-1]
    best = entry(compared, "best")
    stays = (
        f"It was named before, and {in_a_sentence(best)} is not better beyond the bands."
        if winner.name == incumbent != best and best
        else ""
    )
    later = "" if everything or not isinstance(drift.figure, Missing) else _drift_sentence(drift)
    next_step = (
        "Next: a supervised trial, somebody at the machine throughout."
        if recorded
        else "Next: record your own machine."
    )
    return Verdict(
        LOOP,
        PASSED,
        words.passed.format(heading(winner.name)),
        lead,
        " ".join(filter(None, [_closest_limit(winner), _worst_margins(compared, winner), stays])),
        " ".join(filter(None, [later, next_step])),
        "",
        winner.name,
        note=pair_sentence(metrics).text,
        rules=lines,
        subject=winner.name,
    )


def _not_passed(
    metrics: Metrics, subject: Standing, words: Words, lines: tuple[tuple[Rule, ...], ...], *, named: bool
) -> Verdict:
    first = first_in(subject.rules)
    failed = first.state == FAILED
    comes = (
        f"{name_first(subject.name)} is named to run, and does not pass."
        if named
        else f"No contestant passes; {in_a_sentence(subject.name)} comes closest."
    )
    # drift is of the machine, not of a contestant
    who = "" if first.name == "drift" else comes
    why = first.reason or _drift_sentence(first)
    open_too = [rule.name for rule in subject.rules if rule.state == OPEN and rule.name not in LATER]
    also = f"Undecided too: {', '.join(open_too)}." if failed and open_too else ""
    where = _worst_case(metrics, subject.name, first) if failed else ""
    return Verdict(
        LOOP,
        FAILED if failed else OPEN,
        words.failed if failed else words.undecided,
        f"First {'failed' if failed else 'undecided'} rule: {first.name}.",
        " ".join(filter(None, [why, who])),
        " ".join(filter(None, [where, also, "Keep what runs on the machine now." if words is TRIAL else ""])),
        group_of(first.name),
        None,
        note=pair_sentence(metrics).text,
        rules=lines,
        subject=subject.name,
    )


def _worst_case(metrics: Metrics, name: str, rule: Rule) -> str:
    """ "Its worst case: plant 48, a ramp." """
    key = rule.question.key if rule.question else ""
    case = entry(comparison(metrics), "contestants", name, key, "worst_case")
    if not isinstance(case, Mapping) or case.get("plant") is None:
        return ""
    parts = [f"plant {case['plant']}", reference_of(case)]
    return f"Its worst case: {', '.join(filter(None, parts))}."


def _drift_sentence(rule: Rule) -> str:
    figure = rule.figure
    if not isinstance(figure, Missing):
        return ""
    return figure.sentence() if rule.state == FAILED else f"Drift is {rule.state}. {figure.sentence()}"


def _closest_limit(standing: Standing) -> str:
    """The figure that is closest to its limit."""
    asked = [
        (rule.question, rule.figure)
        for rule in standing.rules
        if rule.question is not None
        and rule.question.limit
        and rule.question.key != "data"
        and isinstance(rule.figure, Figure)
    ]
    if not asked:
        return ""
    question, figure = min(asked, key=lambda pair: -share(pair[0], _worst_end(*pair)))
    places = places_of(question, [figure])
    whose = " of the median plant" if question.key in MARGINS else ""
    return (
        f"Closest to its limit: {question.rule}{whose}, {worded(question, figure.value, places)} of "
        f"at {'least' if question.at_least else 'most'} {with_unit(question.limit, question.unit, places)}."
    )


def _worst_margins(compared: Mapping[str, Any], winner: Standing) -> str:
    """The margins of the worst plant where they are below the limits, which hold for the median plant."""
    parts = []
    for rule in winner.rules:
        question = rule.question
        if question is None or question.key not in MARGINS:
            continue
        worst = finite(entry(compared, "contestants", winner.name, "margins", question.key, "worst"))
        if worst < question.limit:
            least = with_unit(question.limit, question.unit, 2)
            parts.append(f"{question.rule} {with_unit(worst, question.unit, 2)} of {least}")
    return f"Below the limit on the worst plant: {', '.join(parts)}." if parts else ""


def _worst_end(question: Question, figure: Figure) -> float:
    return figure.low if question.at_least else figure.high


# ---- beside the verdict


def best_sentence(metrics: Metrics, held: Mapping[str, Standing], winner: str | None) -> str:
    """The best of all contestants, beside the pair."""
    if winner is None:
        cheapest = entry(comparison(metrics), "best_reason", "leading")
        costs = f" {name_first(cheapest)} costs least." if cheapest in held else ""
        return f"Best of all: nobody passes every rule.{costs}"
    others = [
        in_a_sentence(name)
        for name, standing in held.items()
        if standing.passes and name != winner and name not in YARDSTICKS
    ]
    beside = f"; {_listed(others)} {'passes' if len(others) == 1 else 'pass'} too" if others else ""
    cheapest = entry(comparison(metrics), "best")
    if cheapest in held and cheapest != winner:
        return (
            f"On this record {in_a_sentence(cheapest)} is the best{_ahead(metrics, cheapest)}; "
            f"named is {in_a_sentence(winner)}{beside}."
        )
    return f"Best of all that pass: {in_a_sentence(winner)}{_ahead(metrics, winner)}{beside}."


def _ahead(metrics: Metrics, winner: str) -> str:
    """By how much the winner is cheaper than the cheapest other that passes, or that chance may be it."""
    reason = entry(comparison(metrics), "best_reason")
    percent, p = entry(reason, "improvement_percent"), entry(reason, "p")
    if entry(comparison(metrics), "best") != winner or not isinstance(percent, int | float):
        return ""
    nearest = in_a_sentence(entry(reason, "nearest"))
    if isinstance(p, int | float) and p < 0.05 and percent > 0:
        return f", {short(percent, 2)}\u00a0% cheaper than {nearest}"
    chance = f", the simplest; {nearest} is cheaper by no more than chance"
    return chance if percent < 0 else f"; {nearest} is next"


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
