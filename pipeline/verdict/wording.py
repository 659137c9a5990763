"""Puts figures of the temperature loop into sentences: with their unit, or in words if their digits say
nothing."""

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from pipeline.verdict.controllers import in_a_sentence
from pipeline.verdict.digits import band, beyond_meaning, decimals, declared, quantity, with_unit
from pipeline.verdict.verdict import Figure, Missing, Question

OFF_THE_SCALE = "off the scale"
# words for an infinite figure
INFINITE = {"settling": "never settles", "disk": "unlimited", "delay_s": "unlimited", "data": "unlimited"}
MOST_PLACES = 6


def places_of(question: Question, figures: Sequence[Figure | Missing]) -> int:
    """Returns the decimals of a row: those that its narrowest band supports, but at most two unless a figure
    would then have less than two digits. More are used until any two figures with separate bands look
    different."""
    known = [f for f in figures if isinstance(f, Figure) and not _out_of_words(f.value, question.unit)]
    if question.key == "data":
        return 0 if all(f.value >= 10 for f in known) else 2
    if not known:
        return min(decimals(0, 0, value=question.limit), 2)
    supported = max(decimals(f.low, f.high, value=f.value) for f in known)
    smallest = min((abs(f.value) for f in known if f.value), default=1.0)
    places = min(supported, max(2, 1 - math.floor(math.log10(smallest))))
    known.sort(key=lambda figure: figure.value)
    while places < MOST_PLACES and any(
        a.high < b.low and round(a.value, places) == round(b.value, places) for a, b in pairwise(known)
    ):
        places += 1
    return places


def _out_of_words(value: float, unit: str) -> bool:
    return math.isinf(value) or bool(beyond_meaning(value, unit)) or abs(value) > 1e4


def worded(question: Question, value: float, places: int) -> str:
    """Returns a figure with its unit, or in words if its digits say nothing."""
    if math.isinf(value):
        return INFINITE.get(question.key, "unstable")
    if _out_of_words(value, question.unit):
        return OFF_THE_SCALE
    return quantity(value, question.unit, places)


def banded(question: Question, figure: Figure, places: int) -> str:
    """Returns the band of a figure, with an end in words if its digits say nothing; "" if both ends are the
    same."""
    ends = worded(question, figure.low, places), worded(question, figure.high, places)
    if OFF_THE_SCALE in ends or any(map(math.isinf, (figure.low, figure.high))):
        return "" if ends[0] == ends[1] else " to ".join(ends).replace("never settles", "never")
    return band(figure.low, figure.high, places, unit=question.unit)


def limit_text(question: Question) -> str:
    """Returns "≤ 0.5 °C", with the decimals that were declared: "10.000 %" could be read as ten thousand. ""
    if there is no limit."""
    if math.isinf(question.limit):
        return ""
    sign = "≥" if question.at_least else "≤"
    return f"{sign} {with_unit(question.limit, question.unit, declared(question.limit))}"


def name_first(name: str) -> str:
    text = in_a_sentence(name) if name else "it"
    return f"{text[:1].upper()}{text[1:]}"


LOST = "{who} {lost} at the 90 % quantile of all cases; the rule allows {limit}."


def words_of(question: Question, figure: Figure, name: str) -> dict[str, Any]:
    """Returns the words for a rule's sentence on a controller: who, its value and the limit. `fails` is the
    sentence for a figure without digits."""
    places = places_of(question, [figure])
    value = worded(question, figure.value, places)
    # a limit too small for the figure's decimals is shown with its own decimals
    exact = (
        places
        if math.isinf(question.limit) or round(question.limit, places) or not question.limit
        else declared(question.limit)
    )
    words = {
        "limit": question.limit,
        "who": name_first(name),
        "value": value,
        "limit_words": with_unit(question.limit, question.unit, exact),
        "note": figure.note,
        "text": "",
    }
    if question.key == "data" or not (math.isinf(figure.value) or value == OFF_THE_SCALE):
        return words
    key = f" in {question.key.replace('_', ' ')}" if value == OFF_THE_SCALE else ""
    return words | {"fails": LOST, "lost": value if value == INFINITE["settling"] else f"is {value}{key}"}


def straddling(question: Question, figure: Figure, words: Mapping[str, Any]) -> str:
    """Returns the sentence that the limit lies within the band of a quantile."""
    ends = banded(question, figure, places_of(question, [figure]))
    return f" The band of that quantile, {ends}, straddles the limit."
