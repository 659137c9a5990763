"""A loop on page one: its verdict, the controller that it is about against what stands beside it in three
figures, the picture of the case that decides, and what to do next."""

import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from markupsafe import Markup

from pipeline.verdict.evidence import instead
from pipeline.verdict.verdict import Verdict

# letters of a reason that a card has room for in the widest font
ROOM = 200


Card = dict[str, Any]


def entrant(mark: str, name: str, note: str = "") -> dict[str, str]:
    """A controller above its column: its mark, its name, and what it is here (named, runs now, yardstick)."""
    return {"mark": mark, "name": name, "note": note}


def cell(text: str, band: str = "", *, best: bool = False, bad: bool = False) -> dict[str, Any]:
    """A figure with its band in words; `best` of its row, `bad` where it failed."""
    return {"text": text, "band": band, "best": best, "bad": bad}


def step(sentence: str, command: str) -> dict[str, str]:
    """What to do next: a sentence, and the command."""
    return {"sentence": sentence, "command": command}


# width and height of a card's picture, px
PICTURE = (332, 118)


class Deciding(NamedTuple):
    """The case that decides a loop as a picture in which its controllers lie over one another. `key` says
    which line is whose and what else there is to read; `origin` leads to its data."""

    finding: str
    drawn: Markup
    key: Markup
    origin: Markup


NEXT = re.compile(r"(?<=[.!?]) (?=[A-Z])")


def first_sentence(text: str) -> str:
    """The first sentence; up to its first semicolon where that is long, and cut where that is too."""
    sentence = NEXT.split(text, maxsplit=1)[0]
    if len(sentence) > ROOM:
        sentence = sentence.split("; ", 1)[0].rstrip(".") + "."
    return sentence if len(sentence) <= ROOM else sentence[: ROOM - 1].rstrip() + "…"


def of_verdict(verdict: Verdict, moves: str, step: dict[str, str], **rest: Any) -> Card:
    """The card of a loop with this verdict. `rest`: its entrants and rows; `basis` says what the small
    figures are; `picture` is the case that decides, or why there is none; `cost` is what the data cost;
    `beside` sets a simple controller beside it;
    `sources`; or `missing`, why there are no figures."""
    return {
        "loop": verdict.loop,
        "moves": moves,
        "state": verdict.word,
        "decision": verdict.decision,
        "lead": verdict.lead,
        "reason": first_sentence(verdict.reason),
        "answer": verdict.short_answer,
        "step": step,
        "beside": "",
        "missing": "",
    } | rest


or_no_figures = instead(lambda gap: {"missing": gap.sentence()})


def best_of(values: Sequence[float | None], *, at_least: bool) -> float | None:
    """The best value that is known; None where fewer than two are."""
    known = [value for value in values if value is not None]
    return (max if at_least else min)(known) if len(known) > 1 else None


def in_order(kinds: Mapping[str, str], runs_now: str = "") -> dict[str, str]:
    """{controller: its kind}, baselines first, then model-based, then data-driven, with the one that runs now
    named so."""
    order = ("baseline", "model-based", "data-driven")
    ranked = sorted(kinds, key=lambda name: order.index(kinds[name]) if kinds[name] in order else len(order))
    return {name: f"{kinds[name]}, runs now" if name == runs_now else kinds[name] for name in ranked}
