"""Page one: what was run, the three loops with their verdicts, the case that decides each and what its data
cost, what changed since the accepted run, what to do next, and which file to load."""

from collections.abc import Mapping
from typing import Any

from pipeline.report.about import page as about_page
from pipeline.report.certificate import exported
from pipeline.report.deposition import card as deposition_card
from pipeline.report.setpoint import card as setpoint_card
from pipeline.report.shared import headline, page, words
from pipeline.report.shared.card import Card
from pipeline.report.shared.difference import accepted_on
from pipeline.report.shared.sources import Sources
from pipeline.report.temperature import card as temperature_card
from pipeline.report.temperature.judgement import Judgement
from pipeline.report.temperature.page import drift_state
from pipeline.verdict.evidence import entry, need, or_no_entries
from pipeline.verdict.verdict import FAILED, PASSED, Verdict


def render(sources: Sources, judged: Judgement) -> str:
    """The text of index.html."""
    loops, verdicts = headline.loops(sources), sources.verdicts
    told = about_page.changes(sources, judged)
    return page.render(
        "index.html",
        here="index",
        sources=sources,
        title=headline.decision(loops, quick=sources.quick).rstrip("."),
        decision=headline.decision(loops, quick=sources.quick),
        state=headline.state(loops),
        data=headline.data(sources, list(verdicts)),
        claim=f"{headline.claim(sources, list(verdicts))} {drifts(judged)}",
        cards=cards(sources, judged, verdicts),
        change=told,
        accepted_on=accepted_on(sources),
        accepted_at=entry(sources.accepted, "accepted", "commit"),
        machine=judged.changed.machine if judged.changed else {},
        files=files(sources, judged.verdict),
        words=words.chosen(sources, words.INDEX),
    )


def cards(sources: Sources, judged: Judgement, verdicts: Mapping[str, Verdict]) -> list[Card]:
    """Temperature, deposition, setpoint, without a loop that is switched off."""
    drawn = {
        "temperature": lambda verdict: temperature_card.card(sources, judged, verdict),
        "deposition": lambda verdict: deposition_card.card(sources, verdict),
        "setpoint": lambda verdict: setpoint_card.card(sources, verdict),
    }
    return [drawn[loop](verdict) for loop, verdict in verdicts.items()]


def drifts(judged: Judgement) -> str:
    """Drift of the three loops in a sentence; only the temperature loop's is measured, by the nightly job."""
    if drift_state(judged) not in (PASSED, FAILED):
        return "Drift is not measured in any loop."
    word = judged.drifted.word
    return f"Drift: temperature {word[:1].lower()}{word[1:].rstrip('.')}, not measured in the others."


@or_no_entries
def files(sources: Sources, verdict: Verdict) -> dict[str, dict[str, Any]]:
    """{loop: what leaves the house}; {} if nothing was exported."""
    lines = need(exported.lines(sources, verdict))
    return {line["loop"]: line | {"link": exported.link(sources, line)} for line in lines}
