"""Rules and figures -> verdict: which controller to run, the first rule that failed
or is open, what to do instead. No page, no file."""

import functools
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from pydantic import Field

from pipeline.report.shared.digits import band, count, decimals, number, quantity
from pipeline.store import params

PASSED, FAILED, UNDECIDED, OPEN = "passed", "failed", "undecided", "not measured"


class ReportRules(params.Section):
    """Section `report`: what a controller must hold to be deployed; the worst case
    is the largest gap over the plants of the panel."""

    gap_percent: float = Field(gt=0, le=1e6)
    settled_error_degC: float = Field(gt=0, le=1000)
    settling_s: float = Field(gt=0, le=1e6)
    overshoot_degC: float = Field(gt=0, le=1000)
    at_limits_percent: float = Field(gt=0, le=100)
    disk_margin: float = Field(gt=0, le=2)
    delay_margin_s: float = Field(gt=0, le=1e6)
    worst_case_gap_percent: float = Field(gt=0, le=1e6)
    flow_error_percent: float = Field(gt=0, le=1e6)
    line_volume_percent: float = Field(gt=0, le=1e6)
    above_whole_points: float = Field(ge=0, le=1e6)
    learned_percent: float = Field(gt=0, le=1e6)
    settled_percent: float = Field(gt=0, le=100)
    stay_percent: float = Field(gt=0, le=100)
    image_accuracy: float = Field(gt=0, le=1)
    window_accuracy: float = Field(gt=0, le=1)
    ece_image: float = Field(gt=0, le=1)
    ece_window: float = Field(gt=0, le=1)


class Figure(NamedTuple):
    """A median and its 90 % band; infinite where a run never settles, or no delay breaks a loop. `runs` are
    the repetitions behind them, where they are known.
    """

    value: float
    low: float
    high: float
    runs: tuple[float, ...] = ()
    note: str = ""


class Missing(NamedTuple):
    """In the place of a figure: its state (not measured, failed, not
    applicable, stale), why, and what to do."""

    state: str
    reason: str
    remedy: str = ""

    def sentence(self) -> str:
        return " ".join(part for part in (_ended(self.reason), _ended(self.remedy)) if part)


def _ended(text: str) -> str:
    text = text.strip()
    return text if not text or text.endswith((".", "!", "?")) else text + "."


class Question(NamedTuple):
    """One row of page one: the answer's number, the figure's key, what is asked, its unit, its limit, and
    which of the five rules it belongs to.
    """

    answer: int
    key: str
    title: str
    unit: str
    limit: float
    at_least: bool
    rule: str
    beyond: str = "never"


RULES = ("gap", "settled error", "limits", "data sufficiency", "drift")
ANSWERS = {"gap": "2", "settled error": "4", "limits": "5\u20139", "data sufficiency": "10", "drift": "11"}


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


Answers = Mapping[str, Figure | Missing]


def state(question: Question, figure: Figure | Missing) -> str:
    """Passed: the whole band is inside the limit; failed: the whole
    band is outside; undecided: it straddles."""
    if isinstance(figure, Missing):
        return FAILED if figure.state == FAILED else OPEN
    best, worst = (figure.high, figure.low) if question.at_least else (figure.low, figure.high)
    inside = (lambda end: end >= question.limit) if question.at_least else (lambda end: end <= question.limit)
    return PASSED if inside(worst) else UNDECIDED if inside(best) else FAILED


def row_places(question: Question, figures: Sequence[Figure | Missing]) -> int:
    """One number of decimals for a row: what the widest band supports,
    but enough to show the smallest value at all."""
    mine = [(f, decimals(f.low, f.high, value=f.value)) for f in figures if isinstance(f, Figure)]
    if question.key == "data":
        return 0 if all(f.value >= 10 for f, _ in mine) else 2
    if not mine:
        return decimals(0, 0, value=question.limit)
    places = min(found for _, found in mine)
    return max([places, *(found for f, found in mine if f.value and round(f.value, places) == 0)])


def share(question: Question, value: float) -> float:
    """Share of the allowance used: value / limit, or required / actual where more is better."""
    if question.at_least:
        return math.inf if value <= 0 else 0.0 if math.isinf(value) else question.limit / value
    return math.inf if math.isinf(value) else value / question.limit


class Outcome(NamedTuple):
    """A rule's state for one controller, and the first question that decided it."""

    rule: str
    state: str
    question: Question | None


def outcome(rule: str, asked: Sequence[Question], answers: Answers) -> Outcome:
    """Failed before open before passed; drift is no question of a
    limit: the nightly job says whether there is any."""
    if rule == "drift":
        return Outcome(rule, drift_state(answers), None)
    mine = [question for question in asked if question.rule == rule]
    states = [state(question, answers[question.key]) for question in mine]
    for wanted in (FAILED, UNDECIDED, OPEN):
        if wanted in states:
            return Outcome(rule, wanted, mine[states.index(wanted)])
    return Outcome(rule, PASSED, None) if mine else Outcome(rule, OPEN, None)


def drift_state(answers: Answers) -> str:
    found = answers.get("drift")
    return found.state if isinstance(found, Missing) else OPEN if found is None else PASSED


def outcomes(asked: Sequence[Question], answers: Answers) -> list[Outcome]:
    return [outcome(rule, asked, answers) for rule in RULES]


def passes(found: Sequence[Outcome]) -> bool:
    """Every rule; drift may be open, for only the machine itself shows it, once the controller runs on it."""
    return all(o.state == PASSED or (o.rule == "drift" and o.state in (OPEN, UNDECIDED)) for o in found)


class Verdict(NamedTuple):
    """`state` colours the page; decision, reason and remedy are whole
    sentences. `winner` is the role that should run, or None."""

    state: str
    decision: str
    lead: str
    reason: str
    remedy: str
    rule: str
    winner: str | None


ROLES = {"data_driven": "data-driven", "model_based": "model-based", "baseline": "baseline"}


# what tells two controllers apart that both pass, in this order, where their bands separate
PREFERENCE = ("settled_error_degC", "gap_percent", "worst_case_gap_percent")


def preferred(answers: Mapping[str, Answers], a: str, b: str) -> tuple[str, str]:
    """The better of two roles, and the figure that tells them apart; an
    empty text where only the medians of the gap do."""
    for key in PREFERENCE:
        one, two = answers[a][key], answers[b][key]
        if one.high < two.low or two.high < one.low:
            return (a if one.value < two.value else b), key
    return (a if answers[a]["gap_percent"].value <= answers[b]["gap_percent"].value else b), ""


def winner(asked: Sequence[Question], answers: Mapping[str, Answers]) -> str | None:
    """Of the controllers that pass, the one with the smallest settled error; within its
    noise the smallest gap, then the smallest worst case.
    """
    fit = [role for role in ROLES if passes(outcomes(asked, answers[role]))]
    return functools.reduce(lambda best, role: preferred(answers, best, role)[0], fit) if fit else None


def decide(loop: str, asked: Sequence[Question], answers: Mapping[str, Answers]) -> Verdict:
    """The verdict on the data-driven controller of a loop, with what to run instead
    where it does not pass or is not the best that does."""
    found = {role: outcomes(asked, answers[role]) for role in ROLES}
    best = winner(asked, answers)
    mine = found["data_driven"]
    if passes(mine):
        return _deploy(loop, asked, answers, found, best)
    failed = next((o for o in mine if o.state == FAILED), None)
    first = failed or next(o for o in mine if o.state != PASSED)
    decision = f"Do not deploy the data\u2011driven {loop} controller." if failed else "Do not decide yet."
    lead = f"First {'failed' if failed else 'open'} rule: {first.rule}."
    keep = (
        f"{'Keep' if failed else 'Until then keep'} the {ROLES[best]} controller: {_record(found[best])}."
        if best
        else _none_passes(asked, answers, found)
    )
    return Verdict(
        FAILED if failed else OPEN, decision, lead, reason(first.question, answers), keep, first.rule, best
    )


def _deploy(
    loop: str,
    asked: Sequence[Question],
    answers: Mapping[str, Answers],
    found: Mapping[str, Sequence[Outcome]],
    best: str,
) -> Verdict:
    decision = f"Deploy the {ROLES[best].replace('-', chr(0x2011))} {loop} controller."
    whole = all(o.state == PASSED for o in found[best])
    lead = "All five rules passed." if whole else "It passes every rule measured so far."
    question, figure = min(
        ((q, answers[best][q.key]) for q in asked if q.rule != "data sufficiency"),
        key=lambda pair: -share(pair[0], _worst_end(*pair)),
    )
    places = row_places(question, [answers[role][question.key] for role in ("data_driven", "model_based")])
    other = "model_based" if best == "data_driven" else "data_driven"
    theirs = answers[other][question.key]
    beside = (
        f" ({ROLES[other]}: {quantity(theirs.value, question.unit, places, beyond=question.beyond)})"
        if isinstance(theirs, Figure)
        else ""
    )
    closest = (
        f"Closest to its limit: {BRIEF[question.key]}, "
        f"{quantity(figure.value, question.unit, places, beyond=question.beyond)} of "
        f"{_rule_allows(question, places)}{beside}."
    )
    drift = "" if whole else f"Drift is {drift_state(answers[best])}. {_watched(answers[best])}"
    first = next(
        (
            o
            for wanted in (FAILED, UNDECIDED, OPEN)
            for o in found[other]
            if o.state == wanted and o.rule != "drift"
        ),
        None,
    )
    told = (
        _told_apart(asked, answers, best, other)
        if first is None
        else f"{_name(other)} {'fails' if first.state == FAILED else 'is open'} on {first.rule}."
    )
    return Verdict(PASSED, decision, lead, told, f"{closest} {drift}".strip(), "", best)


def _name(role: str) -> str:
    return ROLES[role][:1].upper() + ROLES[role][1:]


def _watched(answers: Answers) -> str:
    found = answers.get("drift")
    return found.sentence() if isinstance(found, Missing) else "The nightly job measures it and has not run."


def _told_apart(asked: Sequence[Question], answers: Mapping[str, Answers], best: str, other: str) -> str:
    """Why the better of two that pass is the better one."""
    key = preferred(answers, best, other)[1]
    if not key:
        return f"{_name(other)} passes too and is as good within noise; the smaller median gap decides."
    alike = [BRIEF[one] for one in PREFERENCE[: PREFERENCE.index(key)]]
    noise = f"{' and '.join(alike)} {'is' if len(alike) == 1 else 'are'} within noise, so " if alike else ""
    question = next(q for q in asked if q.key == key)
    mine, theirs = answers[best][key], answers[other][key]
    places = min(decimals(figure.low, figure.high, value=figure.value) for figure in (mine, theirs))
    figures = [quantity(figure.value, question.unit, places) for figure in (theirs, mine)]
    return f"{_name(other)} passes too; {noise}the {BRIEF[key]} decides: {figures[1]} against {figures[0]}."


def _worst_end(question: Question, figure: Figure) -> float:
    return figure.low if question.at_least else figure.high


def _record(found: Sequence[Outcome]) -> str:
    return (
        "it passes all five rules"
        if all(o.state == PASSED for o in found)
        else "it passes every rule measured so far"
    )


def _none_passes(
    asked: Sequence[Question], answers: Mapping[str, Answers], found: Mapping[str, Sequence[Outcome]]
) -> str:
    others = []
    for role in ("model_based", "baseline"):
        first = next((o for o in found[role] if o.state == FAILED), None) or next(
            o for o in found[role] if o.state != PASSED
        )
        others.append(
            f"the {ROLES[role]} one {'fails' if first.state == FAILED else 'is open'} on {first.rule}"
        )
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
    return f"at {'least' if question.at_least else 'most'} {quantity(question.limit, question.unit, places)}"


def reason(question: Question | None, answers: Mapping[str, Answers]) -> str:
    """The data-driven controller's figure of a rule that failed or is
    open, and its limit, in one or two sentences."""
    if question is None:
        found = answers["data_driven"].get("drift")
        return (
            found.sentence() if isinstance(found, Missing) else "The nightly job measures it and has not run."
        )
    figure = answers["data_driven"][question.key]
    if isinstance(figure, Missing):
        return figure.sentence()
    if question.key == "data":
        return f"{figure.note} needed." if not figure.note.endswith(".") else figure.note
    places = row_places(question, [figure, answers["model_based"][question.key]])
    value, limit = (
        quantity(v, question.unit, places, beyond=question.beyond) for v in (figure.value, question.limit)
    )
    said = {
        "gap_percent": f"It costs {value} more than the optimum; the rule allows {limit}.",
        "settled_error_degC": (
            f"{figure.note[:1].upper()}{figure.note[1:] or 'The worst zone'} settles {value} from its "
            f"reference; the rule allows {limit}."
        ),
        "settling_s": f"It {'never settles' if math.isinf(figure.value) else f'needs {value} to settle'}; the rule allows {limit}.",
        "overshoot_degC": f"It overshoots by {value}; the rule allows {limit}.",
        "at_limits_percent": f"Its commands lie beyond the limits {value} of the time; the rule allows {limit}.",
        "disk": f"Its disk margin is {value}; the rule asks for {limit}.",
        "delay_s": f"It bears {value} of extra delay; the rule asks for {limit}.",
        "worst_case_gap_percent": f"In the worst case of the plant spread it costs {value} more than the optimum; the rule allows {limit}.",
    }[question.key]
    return said if state(question, figure) == FAILED else f"{said} {undecided(question, figure)}"


def undecided(question: Question, figure: Figure) -> str:
    """What more runs would do for a band that straddles its limit: enough of them tell, at 95 %, whether more
    than one run in twenty lies outside.
    """
    places = decimals(figure.low, figure.high, value=figure.value)
    straddles = f"Its band, {band(figure.low, figure.high, places, beyond=question.beyond)}, straddles that"
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
    return f"{straddles}: {outside} of {runs} runs lie outside; {count(needed - runs, 'more run', 'more runs')} would decide."
