"""The page of the temperature loop: verdict, the pair, the scorecard, three pictures, findings, the record,
words."""

from pipeline.report.shared import headline, page, words
from pipeline.report.shared.difference import accepted_on
from pipeline.report.shared.pictures import Picture, PictureColumn, as_picture
from pipeline.report.shared.sources import Sources
from pipeline.report.temperature import findings, pictures, recording, scorecard, twelve
from pipeline.report.temperature.card import deciding
from pipeline.report.temperature.judgement import Judgement, heads, verdict_parts
from pipeline.verdict.controllers import BY_NAME
from pipeline.verdict.evidence import need
from pipeline.verdict.temperature import comparison, refused
from pipeline.verdict.temperature import names as names_judged

WORDS = (
    "verdict",
    "pair",
    "quantile",
    "settled",
    "peak",
    "settling",
    "heating",
    "overshoot",
    "at_limits",
    "cost",
    "crossings",
    "false_stops",
    "gap",
    "margin_disk",
    "margin_delay",
    "spread",
    "data",
    "step",
    "hash",
)


@as_picture("worst-zone", "The case that decides: error of the worst zone")
def worst_zone(sources: Sources, judged: Judgement) -> Picture:
    """The controllers over one another in the case that decides: the error of the worst zone."""
    found = need(deciding(sources, judged, (566, 230)))
    column = PictureColumn("", "", "", [found.drawn])
    return Picture(found.finding, [column], "", found.origin)


def render(sources: Sources, judged: Judgement) -> str:
    """The text of temperature.html."""
    contestants = [
        name for name in (*names_judged(sources.metrics), *refused(sources.metrics)) if name in BY_NAME
    ]
    return page.render(
        "temperature.html",
        here="temperature",
        sources=sources,
        title=f"Temperature: {judged.verdict.decision.rstrip('.')}",
        verdict=verdict_parts(judged, claim=headline.claim(sources, ("temperature",))),
        answers=twelve.rows(sources, judged),
        setting=scorecard.setting(comparison(sources.metrics)),
        heads=heads(judged),
        drift=judged.drifted,
        drift_state=twelve.drift_state(judged),
        accepted_on=accepted_on(sources),
        pair=judged.pair,
        best=judged.best,
        deciding=judged.deciding,
        scorecard=scorecard.scorecard(sources, judged, words.ANSWERS_WORDS),
        infeasible=scorecard.infeasible(sources),
        at_work=[worst_zone(sources, judged), pictures.plants(sources), pictures.record_length(sources)],
        cases=[pictures.case(sources, judged, name) for name in ("typical", "deciding")],
        findings=findings.findings(sources),
        record=[recording.excitation(sources), recording.record(sources)],
        flaws=recording.flaws(sources),
        panel=scorecard.declared_panel(sources),
        weights=scorecard.weights(sources),
        trusted=sources.model,
        words=words.chosen(sources, (*dict.fromkeys(contestants), *WORDS)),
        from_scorecard=sources.source("evaluate_temperature", "cases"),
        from_quality=sources.source("quality"),
        from_weights=sources.source("weights"),
        from_model=sources.source("identify_plant", "plant"),
    )
