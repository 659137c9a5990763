"""Rules and figures of the temperature loop -> verdict: which controller to run, the first rule that
failed or is open, and what to do instead. No page, no file."""

import functools
import math
from collections.abc import Mapping, Sequence

from pipeline.report.shared.digits import band, count, decimals, number, quantity, with_unit
from pipeline.report.shared.verdict import (
    FAILED,
    FAILED_FIRST,
    OPEN,
    PASSED,
    ROLES,
    UNDECIDED,
    Answers,
    Figure,
    Missing,
    Question,
    ReportRules,
    Rule,
    Verdict,
    deciding,
    row_places,
    share,
)

RULES = ("gap", "settled error", "limits", "data sufficiency", "drift")
ANSWERS = {"gap": "2", "settled error": "4", "limits": "5\u20139", "data sufficiency": "10", "drift": "11"}
NEVER = Missing(OPEN, "The nightly job measures it and has not run")


def questions(rules: ReportRules, *, band_degC: float) -> list[Question]:
    """Answers 2 and 4 to 10, in their fixed order."""
    return [
        Question(2, "gap_percent", "Gap to the optimum", "%", rules.gap_percent, False, "gap"),
        Question(
            4,
            "settled_error_degC",
            "Worst settled zone error",
            "°C",
            rules.settled_error_degC,
            False,
            "settled error",
        ),
        Question(
            5,
            "settling_s",
            f"Settling to within {number(band_degC, decimals(0, 0, value=band_degC))}\u00a0°C",
            "s",
            rules.settling_s,
            False,
            "limits",
        ),
        Question(6, "overshoot_degC", "Overshoot", "°C", rules.overshoot_degC, False, "limits"),
        Question(7, "at_limits_percent", "Time at limits", "%", rules.at_limits_percent, False, "limits"),
        Question(8, "disk", "Margin: disk", "", rules.disk_margin, True, "limits", "unlimited"),
        Question(8, "delay_s", "Margin: delay", "s", rules.delay_margin_s, True, "limits", "unlimited"),
        Question(
            9,
            "worst_case_gap_percent",
            "Worst case over plant spread",
            "%",
            rules.worst_case_gap_percent,
            False,
            "limits",
        ),
        Question(
            10, "data", "Data: samples, of those needed", "×", 1.0, True, "data sufficiency", "unlimited"
        ),
    ]


def rule(name: str, asked: Sequence[Question], answers: Answers) -> Rule:
    """The rule for one controller: of its questions the one that decides, the first where all passed.
    Drift is no question of a limit: the nightly job says whether there is any."""
    if name == "drift":
        return Rule(name, None, answers.get("drift", NEVER))
    mine = [Rule(name, question, answers[question.key]) for question in asked if question.rule == name]
    return deciding(mine) or next(iter(mine), Rule(name, None, Missing(OPEN, "Nothing is asked")))


def rules(asked: Sequence[Question], answers: Answers) -> list[Rule]:
    """The five rules, in their fixed order."""
    return [rule(name, asked, answers) for name in RULES]


def passes(judged: Sequence[Rule]) -> bool:
    """Every rule; drift may be open, for only the machine itself shows it, once the controller runs on it."""
    return all(
        rule.state == PASSED or (rule.name == "drift" and rule.state in (OPEN, UNDECIDED)) for rule in judged
    )


# what tells two controllers apart that both pass, in this order, where their bands separate
PREFERENCE = ("settled_error_degC", "gap_percent", "worst_case_gap_percent")


def preferred(answers: Mapping[str, Answers], a: str, b: str) -> tuple[str, str]:
    """The better of two roles, and the figure that tells them apart; an
    empty text where only the medians of the gap do."""
    for key in PREFERENCE:
        of_a, of_b = answers[a][key], answers[b][key]
        if of_a.high < of_b.low or of_b.high < of_a.low:
            return (a if of_a.value < of_b.value else b), key
    return (a if answers[a]["gap_percent"].value <= answers[b]["gap_percent"].value else b), ""


def winner(asked: Sequence[Question], answers: Mapping[str, Answers]) -> str | None:
    """Of the controllers that pass, the one with the smallest settled error. Within its noise the smallest
    gap decides, then the smallest worst case.
    """
    fit = [role for role in ROLES if passes(rules(asked, answers[role]))]
    return functools.reduce(lambda best, role: preferred(answers, best, role)[0], fit) if fit else None


def decide(loop: str, asked: Sequence[Question], answers: Mapping[str, Answers]) -> Verdict:
    """The verdict on the data-driven controller of a loop, with what to run instead
    where it does not pass or is not the best that does."""
    judged = {role: rules(asked, answers[role]) for role in ROLES}
    best, lines = winner(asked, answers), tuple(zip(*judged.values(), strict=True))
    mine = judged["data_driven"]
    if passes(mine):
        return _deploy(loop, asked, answers, judged, best)._replace(rules=lines)
    first = deciding(mine, FAILED_FIRST)
    failed = first.state == FAILED
    keep = (
        f"{'Keep' if failed else 'Until then keep'} the {ROLES[best]} controller: {_record(judged[best])}."
        if best
        else _none_passes(judged)
    )
    return Verdict(
        loop=loop,
        state=FAILED if failed else OPEN,
        decision=f"Do not deploy the data\u2011driven {loop} controller." if failed else "Do not decide yet.",
        lead=f"First {'failed' if failed else 'open'} rule: {first.name}.",
        reason=reason(first, answers),
        remedy=keep,
        rule=first.name,
        winner=best,
        rules=lines,
    )


def _deploy(
    loop: str,
    asked: Sequence[Question],
    answers: Mapping[str, Answers],
    judged: Mapping[str, Sequence[Rule]],
    best: str,
) -> Verdict:
    all_pass = all(rule.state == PASSED for rule in judged[best])
    other = "model_based" if best == "data_driven" else "data_driven"
    drift = "" if all_pass else f"Drift is {drift_state(answers[best])}. {_drift_sentence(answers[best])}"
    against = deciding(rule for rule in judged[other] if rule.name != "drift")
    apart = (
        _difference(asked, answers, best, other)
        if against is None
        else f"{_name(other)} {'fails' if against.state == FAILED else 'is open'} on {against.name}."
    )
    return Verdict(
        loop=loop,
        state=PASSED,
        decision=f"Deploy the {ROLES[best].replace('-', chr(0x2011))} {loop} controller.",
        lead="All five rules passed." if all_pass else "It passes every rule measured so far.",
        reason=apart,
        remedy=f"{_closest(asked, answers, best, other)} {drift}".strip(),
        rule="",
        winner=best,
    )


def _closest(asked: Sequence[Question], answers: Mapping[str, Answers], best: str, other: str) -> str:
    """The figure of the best controller that is closest to its limit, beside the other's."""
    question, figure = min(
        ((q, answers[best][q.key]) for q in asked if q.rule != "data sufficiency"),
        key=lambda pair: -share(pair[0], _worst_end(*pair)),
    )
    places = row_places(question, [answers[role][question.key] for role in ("data_driven", "model_based")])
    theirs = answers[other][question.key]
    beside = (
        f" ({ROLES[other]}: {quantity(theirs.value, question.unit, places, beyond=question.beyond)})"
        if isinstance(theirs, Figure)
        else ""
    )
    return (
        f"Closest to its limit: {BRIEF[question.key]}, "
        f"{quantity(figure.value, question.unit, places, beyond=question.beyond)} of "
        f"{_rule_allows(question, places)}{beside}."
    )


def _name(role: str) -> str:
    return ROLES[role][:1].upper() + ROLES[role][1:]


def drift_state(answers: Answers) -> str:
    """Passed where the nightly job measured drift and found none, otherwise its word for it."""
    return rule("drift", (), answers).state


def _drift_sentence(answers: Answers) -> str:
    drift = answers.get("drift", NEVER)
    return drift.sentence() if isinstance(drift, Missing) else NEVER.sentence()


def _difference(asked: Sequence[Question], answers: Mapping[str, Answers], best: str, other: str) -> str:
    """Why the better of two that pass is the better one."""
    key = preferred(answers, best, other)[1]
    if not key:
        return f"{_name(other)} passes too and is as good within noise; the smaller median gap decides."
    alike = [BRIEF[figure] for figure in PREFERENCE[: PREFERENCE.index(key)]]
    noise = f"{' and '.join(alike)} {'is' if len(alike) == 1 else 'are'} within noise, so " if alike else ""
    question = next(q for q in asked if q.key == key)
    mine, theirs = answers[best][key], answers[other][key]
    places = min(decimals(figure.low, figure.high, value=figure.value) for figure in (mine, theirs))
    figures = [quantity(figure.value, question.unit, places) for figure in (theirs, mine)]
    return f"{_name(other)} passes too; {noise}the {BRIEF[key]} decides: {figures[1]} against {figures[0]}."


def _worst_end(question: Question, figure: Figure) -> float:
    return figure.low if question.at_least else figure.high


def _record(judged: Sequence[Rule]) -> str:
    return (
        "it passes all five rules"
        if all(rule.state == PASSED for rule in judged)
        else "it passes every rule measured so far"
    )


def _none_passes(judged: Mapping[str, Sequence[Rule]]) -> str:
    first = {role: deciding(judged[role], FAILED_FIRST) for role in ("model_based", "baseline")}
    others = [
        f"the {ROLES[role]} one {'fails' if rule.state == FAILED else 'is open'} on {rule.name}"
        for role, rule in first.items()
    ]
    return f"No controller passes: {', '.join(others)}. Keep what runs on the machine now."


BRIEF = {
    "gap_percent": "gap",
    "settled_error_degC": "settled error",
    "settling_s": "settling",
    "overshoot_degC": "overshoot",
    "at_limits_percent": "time at limits",
    "disk": "disk margin",
    "delay_s": "delay margin",
    "worst_case_gap_percent": "worst case over plant spread",
    "data": "data",
}


def _rule_allows(question: Question, places: int) -> str:
    return f"at {'least' if question.at_least else 'most'} {with_unit(question.limit, question.unit, places)}"


def reason(first: Rule, answers: Mapping[str, Answers]) -> str:
    """The data-driven controller's figure of a rule that failed or is
    open, and its limit, in one or two sentences."""
    question, figure = first.question, first.figure
    if question is None:
        return _drift_sentence(answers["data_driven"])
    if isinstance(figure, Missing):
        return figure.sentence()
    if question.key == "data":
        return f"{figure.note} needed." if not figure.note.endswith(".") else figure.note
    places = row_places(question, [figure, answers["model_based"][question.key]])
    value = quantity(figure.value, question.unit, places, beyond=question.beyond)
    limit = with_unit(question.limit, question.unit, places)
    settles = "never settles" if math.isinf(figure.value) else f"needs {value} to settle"
    sentence = {
        "gap_percent": f"It costs {value} more than the optimum; the rule allows {limit}.",
        "settled_error_degC": (
            f"{figure.note[:1].upper()}{figure.note[1:] or 'The worst zone'} settles {value} from its "
            f"reference; the rule allows {limit}."
        ),
        "settling_s": f"It {settles}; the rule allows {limit}.",
        "overshoot_degC": f"It overshoots by {value}; the rule allows {limit}.",
        "at_limits_percent": (
            f"Its commands lie beyond the limits {value} of the time; the rule allows {limit}."
        ),
        "disk": f"Its disk margin is {value}; the rule asks for {limit}.",
        "delay_s": f"It bears {value} of extra delay; the rule asks for {limit}.",
        "worst_case_gap_percent": (
            f"In the worst case of the plant spread it costs {value} more than the optimum; "
            f"the rule allows {limit}."
        ),
    }[question.key]
    return sentence if first.state == FAILED else f"{sentence} {undecided(question, figure)}"


def undecided(question: Question, figure: Figure) -> str:
    """What more runs would do for a band that straddles its limit: enough of them tell, at 95 %, whether more
    than one run in twenty lies outside.
    """
    places = decimals(figure.low, figure.high, value=figure.value)
    ends = band(figure.low, figure.high, places, unit=question.unit, beyond=question.beyond)
    straddles = f"Its band, {ends}, straddles that"
    runs = len(figure.runs)
    if not runs:
        return f"{straddles}; more runs would narrow it."
    outside = sum(
        (run < question.limit) if question.at_least else (run > question.limit) for run in figure.runs
    )
    share_outside, allowed = outside / runs, 0.05
    if share_outside <= allowed:
        return f"{straddles}; {outside} of {runs} runs lie outside."
    needed = math.ceil(1.645**2 * share_outside * (1 - share_outside) / (share_outside - allowed) ** 2)
    if needed <= runs:
        return f"{straddles}: {outside} of {runs} runs lie outside, and more runs would not change that."
    more = count(needed - runs, "more run", "more runs")
    return f"{straddles}: {outside} of {runs} runs lie outside; {more} would decide."
