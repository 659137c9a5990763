"""Rules and figures in sentences: a figure with its unit, or in words where its digits say nothing, and why a
rule does not pass."""

import math
from collections.abc import Sequence

from pipeline.report.temperature.contestants import in_a_sentence
from pipeline.verdict.digits import band, beyond_meaning, quantity, with_unit
from pipeline.verdict.verdict import FAILED, Figure, Missing, Question, Rule, row_places

OFF_THE_SCALE = "off the scale"
# what an infinite figure is called
INFINITE = {"settling": "never settles", "disk": "unlimited", "delay_s": "unlimited", "data": "unlimited"}


def places_of(question: Question, figures: Sequence[Figure | Missing]) -> int:
    """Decimals of a row: as its bands support, two at most, but enough to show the smallest figure at all."""
    places = row_places(question, figures)
    small = [f.value for f in figures if isinstance(f, Figure) and f.value and round(f.value, 2) == 0]
    return places if small else min(places, 2)


def worded(question: Question, value: float, places: int) -> str:
    """A figure with its unit; in words where its digits say nothing."""
    if math.isinf(value):
        return INFINITE.get(question.key, "unstable")
    if beyond_meaning(value, question.unit) or abs(value) > 1e4:
        return OFF_THE_SCALE
    return quantity(value, question.unit, places)


def banded(question: Question, figure: Figure, places: int) -> str:
    """The band of a figure, "" where it is none or one of its ends says nothing."""
    ends = worded(question, figure.low, places), worded(question, figure.high, places)
    if OFF_THE_SCALE in ends or any(map(math.isinf, (figure.low, figure.high))):
        return "" if ends[0] == ends[1] else " to ".join(ends).replace("never settles", "never")
    return band(figure.low, figure.high, places, unit=question.unit)


def name_first(name: str) -> str:
    text = in_a_sentence(name) if name else "it"
    return f"{text[:1].upper()}{text[1:]}"


def reason(rule: Rule, name: str = "") -> str:
    """Why a rule does not pass, with figure and limit."""
    question, figure = rule.question, rule.figure
    if isinstance(figure, Missing):
        return figure.sentence()
    if question is None:
        return ""
    if question.key == "data":
        return f"{figure.note}."
    places = places_of(question, [figure])
    value = worded(question, figure.value, places)
    limit = with_unit(question.limit, question.unit, places)
    who, quantile = name_first(name), "at the 90 % quantile of all cases"
    lost = math.isinf(figure.value) or value == OFF_THE_SCALE
    sentence = {
        "settled_error": f"{who} settles {value} from its reference {quantile}; the rule allows {limit}.",
        "settling": f"{who} needs {value} to settle {quantile}; the rule allows {limit}.",
        "overshoot": f"{who} overshoots by {value} {quantile}; the rule allows {limit}.",
        "at_limits": f"{who} is at a limit {value} of the time {quantile}; the rule allows {limit}.",
        "disk": f"{who} has a disk margin of {value} on the median plant; the rule asks for {limit}.",
        "delay_s": f"{who} bears {value} of extra delay on the median plant; the rule asks for {limit}.",
        "crossings": f"{who} takes an output beyond its low or high: {value} {figure.note}.",
    }[question.key]
    if lost:
        sentence = f"{who} {_lost(question.key, value)} {quantile}; the rule allows {limit}."
    if rule.state == FAILED:
        return sentence
    return f"{sentence} The band of that quantile, {banded(question, figure, places)}, straddles the limit."


def _lost(key: str, value: str) -> str:
    """What a contestant does whose figure has no digits."""
    if key == "settling" and value != OFF_THE_SCALE:
        return "never settles"
    return f"is {value} in {key.replace('_', ' ')}" if value == OFF_THE_SCALE else f"is {value}"
