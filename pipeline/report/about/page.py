"""The page of the words."""

from collections.abc import Sequence
from typing import NamedTuple

from pipeline.report.deposition import card as deposition_card
from pipeline.report.setpoint import card as setpoint_card
from pipeline.report.shared import page, words
from pipeline.report.shared.difference import Difference, Move
from pipeline.report.shared.sources import Sources
from pipeline.report.temperature.judgement import Judgement
from pipeline.verdict.controllers import in_a_sentence
from pipeline.verdict.deposition import structures
from pipeline.verdict.digits import count
from pipeline.verdict.evidence import gap_of, known
from pipeline.verdict.verdict import Figure


def render_words(sources: Sources) -> str:
    """The text of words.html: every word of every page, in alphabetical order."""
    meanings: dict[str, list[str]] = {}
    for word, meaning in words.glossary(sources).values():
        meanings.setdefault(word, []).append(meaning)
    every = sorted(meanings.items(), key=lambda pair: pair[0].lower())
    return page.render("words.html", here="words", sources=sources, title="Words", words=every)


def render_off(sources: Sources) -> str:
    """The text of the page of a loop that is switched off."""
    return page.render("off.html", here="", sources=sources, title="Switched off")


ANOTHER = "The accepted run is of another machine: nothing to compare."


class LoopChange(NamedTuple):
    """One loop: the figures that moved beyond their noise ("settled error +0.39 °C · worse"), of how many
    that both runs have."""

    loop: str
    moved: Sequence[str]
    of: int


class Changes(NamedTuple):
    """Page one's answer: `strong`, then `text`; `alone` stands in the place of `strong` where the page finds,
    by script, that nothing but the machine differs. Then the loops."""

    strong: str
    text: str = ""
    alone: str = ""
    loops: Sequence[LoopChange] = ()


def changes(sources: Sources, judged: Judgement) -> Changes:
    """What changed since the accepted run, of all loops."""
    accepted = sources.accepted
    if sources.quick:
        return Changes("A quick look is compared with no run.")
    if gap := gap_of(accepted):
        return Changes("The accepted run cannot be read.", gap.sentence())
    if accepted is None:
        return Changes("First run: nothing to compare with.", "./run beadline accept marks this one as good.")
    loops = of_loops(sources, judged)
    moved, compared = sum(len(loop.moved) for loop in loops), sum(loop.of for loop in loops)
    beside = inputs(judged.changed) if judged.changed else ""
    if sources.another_machine:
        others = " and ".join(loop for loop in sources.verdicts if loop != "temperature")
        sentence = f"{others} {'are' if ' and ' in others else 'is'} compared.".capitalize()
        return Changes(ANOTHER, sentence if others else "", loops=loops)
    if not moved:
        nothing = judged.changed is not None and judged.changed.empty and all(loop.of for loop in loops)
        strong = "Nothing changed; no figure moved." if nothing else "No figure moved beyond its noise."
        return Changes(strong, "" if nothing else beside, loops=loops)
    figures = f"{moved} of {compared} figures moved"
    return Changes(f"{figures} beyond their noise.", beside, f"{figures} with the machine alone.", loops)


def of_loops(sources: Sources, judged: Judgement) -> list[LoopChange]:
    """Temperature: figures of the contestant and its rival; deposition: flow error of every stream; setpoint:
    settled runs of every case of the default that counts."""
    mine = [
        (name, move)
        for name in dict.fromkeys((judged.subject, judged.rival))
        for move in judged.moved.get(name, [])
    ]
    temperature = [
        _moved(move, "" if name == judged.subject else f" of {in_a_sentence(name)}")
        for name, move in mine
        if move.moved
    ]
    streams = deposition_card.moves(sources, known(structures(sources.evidence), []))
    cases = setpoint_card.changes(sources)
    loops = [
        LoopChange("temperature", temperature, _both([move for _, move in mine])),
        LoopChange("deposition", [_moved(move) for move in streams if move.moved], _both(streams)),
        LoopChange(
            "setpoint",
            [f"{name} {change.text}" for name, change in cases if change.moved],
            sum(change.text not in ("first run", "new") for _, change in cases),
        ),
    ]
    return [loop for loop in loops if loop.loop in sources.verdicts]


def _both(moves: Sequence[Move]) -> int:
    """How many figures both runs have."""
    return sum(move.before is not None and isinstance(move.now, Figure) for move in moves)


def _moved(move: Move, whose: str = "") -> str:
    title = f"{move.question.title}{whose}"
    return f"{title[:1].lower()}{title[1:]} {move.text()}"


def inputs(changed: Difference) -> str:
    """ "Changed: code, 4 parameters." """
    parts = [
        count(len(changed.inputs), "recording") if changed.inputs else "",
        count(len(changed.parameters), "parameter") if changed.parameters else "",
        "code" if changed.code == "changed" else "",
        count(len(changed.artifacts), "artifact") if changed.artifacts else "",
    ]
    return f"Changed: {', '.join(filter(None, parts))}." if any(parts) else "Nothing else changed."
