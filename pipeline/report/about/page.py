"""The page of the words."""

from collections.abc import Sequence
from typing import Any

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


def change(strong: str, text: str = "", alone: str = "", loops: Sequence[dict] = ()) -> dict[str, Any]:
    """Page one's answer: `strong`, then `text`; `alone` stands in the place of `strong` where the page finds,
    by script, that nothing but the machine differs. Then the loops."""
    return {"strong": strong, "text": text, "alone": alone, "loops": loops}


def changes(sources: Sources, judged: Judgement) -> dict[str, Any]:
    """What changed since the accepted run, of all loops."""
    accepted = sources.accepted
    if sources.quick:
        return change("A quick look is compared with no run.")
    if gap := gap_of(accepted):
        return change("The accepted run cannot be read.", gap.sentence())
    if accepted is None:
        return change("First run: nothing to compare with.", "./run beadline accept marks this one as good.")
    loops = of_loops(sources, judged)
    moved, compared = sum(len(loop["moved"]) for loop in loops), sum(loop["of"] for loop in loops)
    beside = inputs(judged.changed) if judged.changed else ""
    if sources.another_machine:
        others = " and ".join(loop for loop in sources.verdicts if loop != "temperature")
        sentence = f"{others} {'are' if ' and ' in others else 'is'} compared.".capitalize()
        return change(ANOTHER, sentence if others else "", loops=loops)
    if not moved:
        nothing = judged.changed is not None and judged.changed.empty and all(loop["of"] for loop in loops)
        strong = "Nothing changed; no figure moved." if nothing else "No figure moved beyond its noise."
        return change(strong, "" if nothing else beside, loops=loops)
    figures = f"{moved} of {compared} figures moved"
    return change(f"{figures} beyond their noise.", beside, f"{figures} with the machine alone.", loops)


def of_loops(sources: Sources, judged: Judgement) -> list[dict[str, Any]]:
    """The figures that moved beyond their noise ("settled error +0.39 °C · worse"), of how many that both
    runs have. Temperature: figures of the contestant and its rival; deposition: flow error of every stream;
    setpoint: settled runs of every case of the default that counts."""
    temperature = [
        (_titled(move, "" if name == judged.subject else f" of {in_a_sentence(name)}"), move)
        for name in dict.fromkeys((judged.subject, judged.rival))
        for move in judged.moved.get(name, [])
    ]
    streams = deposition_card.moves(sources, known(structures(sources.evidence), []))
    compared = {
        "temperature": temperature,
        "deposition": [(_titled(move), move) for move in streams],
        "setpoint": setpoint_card.changes(sources),
    }
    return [
        {
            "loop": loop,
            "moved": [f"{title} {move.text()}" for title, move in moves if move.moved],
            "of": sum(move.before is not None and isinstance(move.now, Figure) for _, move in moves),
        }
        for loop, moves in compared.items()
        if loop in sources.verdicts
    ]


def _titled(move: Move, whose: str = "") -> str:
    title = f"{move.question.title}{whose}"
    return f"{title[:1].lower()}{title[1:]}"


def inputs(changed: Difference) -> str:
    """ "Changed: code, 4 parameters." """
    parts = [
        count(len(changed.inputs), "recording") if changed.inputs else "",
        count(len(changed.parameters), "parameter") if changed.parameters else "",
        "code" if changed.code == "changed" else "",
        count(len(changed.artifacts), "artifact") if changed.artifacts else "",
    ]
    return f"Changed: {', '.join(filter(None, parts))}." if any(parts) else "Nothing else changed."
