"""The setpoint loop on page one: a baseline, the model-based and the data-driven controller, among them the
default; and the cases of the rule that decides."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.report.setpoint import deciding as deciding_case
from pipeline.report.shared import page
from pipeline.report.shared.card import (
    Card,
    Deciding,
    best_of,
    cell,
    entrant,
    in_order,
    of_verdict,
    or_no_figures,
    step,
)
from pipeline.report.shared.difference import Move, move
from pipeline.report.shared.sources import Sources
from pipeline.setpoint.agents.criteria import FLOW_BAND
from pipeline.setpoint.controllers import NO_CONTROL as DOES_NOTHING
from pipeline.verdict.digits import THIN, band
from pipeline.verdict.evidence import (
    Absent,
    entry,
    instead,
    known,
    lookup,
    need,
    need_figure,
    or_empty,
    or_gap,
    or_nothing,
)
from pipeline.verdict.setpoint import (
    Board,
    Case,
    Cell,
    Harm,
    bars,
    board,
    harm_of,
    lasting,
    role,
    share_text,
    within,
    worst,
)
from pipeline.verdict.verdict import FAILED, PASSED, Figure, Missing, Question, Verdict

MOVES = "Nozzle camera to setpoints"


def card(sources: Sources, verdict: Verdict) -> Card:
    """Settling, staying and harm of the three."""
    return of_verdict(verdict, MOVES, _step(verdict), **_figures(sources, verdict))


@or_no_figures
def _figures(sources: Sources, verdict: Verdict) -> dict[str, Any]:
    scores = need(board(sources.evidence, sources.subject("setpoint")))
    if not verdict.winner:
        raise Absent(Missing("not measured", verdict.reason))
    names, asked = shown(scores), sources.declared.rules
    limits = bars(sources.evidence, scores)
    harms = [harm_of(scores, name, limits) for name in names]
    # one limit a case
    allowed = sorted({harm.limit for harm in harms if isinstance(harm, Harm)})
    return {
        "entrants": [entrant(role(scores, name), name, scores.kinds[name]) for name in names],
        "rows": [
            _shares("Settles", scores, names, "settled", asked.settled_percent),
            _shares("Stays", scores, names, "stay", asked.stay_percent),
            {
                "title": "Good prints moved",
                "limit": f"≤ {' or '.join(f'{limit:g}' for limit in allowed)}{THIN}%" if allowed else "",
                "cells": _harm_cells(harms),
            },
        ],
        "basis": f"Worst case of each; small: 95{THIN}% interval",
        "cost": _cost(sources),
        "picture": deciding(sources, verdict),
        "sources": sources.source("scoreboard"),
    }


def shown(scores: Board) -> list[str]:
    """The best baseline that does something, the model-based and the data-driven controller, among them the
    default."""
    of_kind: dict[str, str] = {}
    for name in (scores.default, *scores.names):
        if name and name != DOES_NOTHING:
            of_kind.setdefault(scores.kinds[name], name)
    return list(in_order({name: scores.kinds[name] for name in of_kind.values()}))


@or_nothing
def _cost(sources: Sources) -> str:
    """Segments of prints and pictures that were learned from."""
    data = need_figure(sources.metrics["train_classifier"], "data")
    return f"{data['segments']:,} segments, {data['frames']:,} pictures"


def _shares(title: str, scores: Board, names: Sequence[str], what: str, limit: float) -> dict[str, Any]:
    figures = [worst(scores, name, what)[0] for name in names]
    best = best_of([f.value if isinstance(f, Figure) else None for f in figures], at_least=True)
    return {
        "title": title,
        "limit": f"≥ {limit:g}{THIN}%",
        "cells": [_share(f, best, bad=isinstance(f, Figure) and f.high < limit) for f in figures],
    }


@instead(lambda gap: cell(gap.state))
def _share(figure: Figure | Missing, best: float | None, *, bad: bool) -> dict[str, Any]:
    share = need(figure)
    return cell(share_text(share), band(share.low, share.high, 1), best=share.value == best, bad=bad)


def _harm_cells(harms: Sequence[Harm | Missing]) -> list[dict[str, Any]]:
    """The harm of each in the case that decides for it."""
    best = best_of([h.figure.value if isinstance(h, Harm) else None for h in harms], at_least=False)
    return [
        _share(harm.figure, best, bad=harm.state == FAILED) if isinstance(harm, Harm) else cell(harm.state)
        for harm in harms
    ]


def _step(verdict: Verdict) -> dict[str, str]:
    if not verdict.winner:
        return step("Run the stages of this loop.", "./run dvc repro evaluate_setpoint")
    if verdict.rehearsal:
        return step(
            "Film the training print; frames go to datasets/raw/setpoint.",
            "./run beadline experiment setpoint training.gcode",
        )
    if verdict.state == PASSED:
        return step("Watch a print without steering it.", "./run beadline shadow FRAMES")
    return step(f"{verdict.remedy.split('To try: ')[-1].split('. ')[0].rstrip('.')}.", "./run dvc repro")


# ---- the cases of the rule that decides


@or_gap
def deciding(sources: Sources, verdict: Verdict) -> Deciding | Missing:
    """The case that decides, decision by decision, of the three of the card."""
    scores = need(board(sources.evidence, sources.subject("setpoint")))
    if not scores.default:
        return Missing("not measured", "No controller was chosen")
    stays, names = verdict.rule.startswith("Stays"), shown(scores)
    what = "stay" if stays else "settled"
    cases = [case for case, cell in scores.counting(scores.default) if isinstance(_of(cell, what), Figure)]
    if not cases:
        return Missing("not measured", "no case counts")
    first = min(cases, key=lambda case: _value(scores, names[0], case, what))
    # as the answer above it counts them
    listed = ", ".join(f"{name} {_text(scores, name, first, 'stay')}" for name in names)
    low, high = deciding_case.MIDDLE
    return Deciding(
        f"Runs that settle and stay in {within(first)}: {listed}.",
        need(deciding_case.panel(sources, scores, first, names)),
        deciding_case.key(scores, names)
        + f". Median and {high - low}{THIN}% of the runs; dashed: ±{FLOW_BAND:g}{THIN}%.",
        page.linked(sources.source("paths"), short=True),
    )


def _of(cell, what: str) -> Figure | Missing:
    return cell.settled if what == "settled" else lasting(cell)


def _value(scores: Board, name: str, case: Case, what: str) -> float:
    cell = scores.cells.get((name, case))
    figure = None if cell is None else _of(cell, what)
    return figure.value if isinstance(figure, Figure) else np.inf


def _text(scores: Board, name: str, case: Case, what: str) -> str:
    cell = scores.cells.get((name, case))
    return "not run" if cell is None else share_text(_of(cell, what))


# points closer than this are one: the accepted figures are kept rounded
SAME = 0.05


def change(sources: Sources, case: Case, cell: Cell | None) -> Move:
    """How the settled runs of the default moved since the accepted run. Its figure has the interval of
    today's: of as many runs, clustered as they are."""
    question = Question(0, "", "Settled", "%", sources.declared.rules.settled_percent, True, "")
    now = cell.settled if cell else Missing("not measured", "this case was not run")
    if not known(sources.accepted, None) or isinstance(now, Missing):
        return Move(question, None, now, False, "first run")
    stage = lookup(sources.accepted, "metrics.evaluate_setpoint")
    before = entry(stage, str(entry(stage, "default")), *case, "settled")
    if before is None:
        return move(question, None, now)
    by = 0.0 if abs(now.value - before) < SAME else before - now.value
    return move(question, Figure(now.value + by, now.low + by, now.high + by), now)


@or_empty
def changes(sources: Sources) -> list[tuple[str, Move]]:
    """Every case of the default that counts, with how its settled runs moved."""
    scores = need(board(sources.evidence, sources.subject("setpoint")))
    counting = scores.counting(scores.default) if scores.default else []
    return [(within(case), change(sources, case, cell)) for case, cell in counting]
