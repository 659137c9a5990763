"""The page of the temperature loop: verdict, tables, findings,
figures, what was declared, words, provenance."""

from pipeline.report.identification.model import trust
from pipeline.report.index import page as index_page
from pipeline.report.shared import headline, page, pictures, tables, words
from pipeline.report.shared.sources import Sources
from pipeline.report.temperature import evidence, findings, pairs, recording, study, trades
from pipeline.report.temperature.answers import aimed_unclipped, featured, repetitions
from pipeline.report.temperature.judgement import Judgement, verdict_parts
from pipeline.temperature.workflow.contestants import CONTESTANTS

WORDS = (
    *(contestant.name for contestant in CONTESTANTS),
    "study",
    "gap",
    "band",
    "settled",
    "settling",
    "overshoot",
    "at_limits",
    "margin_disk",
    "margin_delay",
    "spread",
    "worst",
    "data",
    "step",
    "hash",
)
# controllers that not every machine has: explained where they stand in the table
SOME = {contestant.name for contestant in CONTESTANTS if not contestant.role}


def render(sources: Sources, judged: Judgement) -> str:
    """The text of temperature.html."""
    yardstick = tables.yardstick(sources, judged.asked)
    shown = {head.mark for head in yardstick.heads}
    return page.render(
        "temperature.html",
        here="temperature",
        title=f"Temperature: {judged.verdict.decision.rstrip('.')}",
        verdict=verdict_parts(judged, claim=headline.claim(sources, ("temperature",))),
        featured=featured(sources),
        repetitions=repetitions(sources),
        yardstick=yardstick,
        aimed_unclipped=aimed_unclipped(sources, "there"),
        pairs=pairs.compared(sources),
        study=study.part(sources),
        findings=findings.findings(sources),
        at_work=[
            pictures.trajectories(sources),
            pictures.errors(sources),
            pictures.costs(sources),
            pictures.inputs(sources),
            trades.tradeoff(sources),
            trades.plants(sources),
        ],
        learning=[
            evidence.orders(sources),
            evidence.holdout(sources),
            evidence.tuning(sources),
            trades.candidates(sources),
        ],
        record=[recording.excitation(sources), recording.record(sources)],
        flaws=recording.flaws(sources),
        panel=tables.panel(sources),
        weights=tables.weights(sources),
        identified=tables.identified(sources),
        trusted=trust(sources),
        words=words.chosen(sources, tuple(word for word in WORDS if word in shown or word not in SOME)),
        sources=list(sources.read.values()),
        absent=sources.absent,
        hashes=index_page.hashes(sources),
        from_scorecard=sources.source("scorecard", "evaluate_temperature"),
        from_quality=sources.source("quality"),
        from_weights=sources.source("weights"),
        from_model=sources.source("identify_plant", "plant"),
    )
