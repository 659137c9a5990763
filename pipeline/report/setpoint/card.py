"""The setpoint loop's card on page one: Bayes filter, agent and proportional control, the winner in words."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd
from markupsafe import Markup

from pipeline.report.index.cards import Card, Cell, Row, heads, unbuilt
from pipeline.report.setpoint.agent import CASES
from pipeline.report.setpoint.verdict import (
    BASELINE,
    PASSED,
    Board,
    board,
    case_text,
    named,
    share_text,
    verdict,
    within,
    worst,
)
from pipeline.report.shared import charts, page
from pipeline.report.shared.digits import number
from pipeline.report.shared.sources import Sources, Table
from pipeline.report.shared.verdict import ROLES, Figure, Missing
from pipeline.setpoint.workflow.tables import BEST_FLOW, FLOW_BAND

FLOOR, CEILING = 1.0, 300.0
ORDER = ("model_based", "data_driven", "baseline")


def controllers(scores: Board) -> dict[str, str]:
    """Who stands for each role: the best Bayes filter, the agent that competes, the best proportional
    control, or else the best of the other baselines."""

    def first(fits: Callable[[str], bool]) -> str:
        return next(
            (name for name in scores.names if scores.kinds[name] == BASELINE and fits(name.lower())), ""
        )

    bayes = first(lambda name: "bayes" in name)
    plain = first(lambda name: "proportional" in name) or first(lambda name: "bayes" not in name)
    return {"model_based": bayes, "data_driven": scores.learned(), "baseline": plain}


def setpoint(sources: Sources) -> Card:
    judged, scores = verdict(sources), board(sources)
    if isinstance(scores, Missing) or not judged.winner:
        why = scores.sentence() if isinstance(scores, Missing) else judged.reason
        return unbuilt("setpoint", why)._replace(link="setpoint.html")
    who = controllers(scores)
    role = next((role for role, name in who.items() if name == judged.winner), "baseline")
    table = sources.tables["paths"]
    case = CASES[1]
    rules = sources.declared.rules
    passed, winner = judged.state == PASSED, ROLES[role]
    who_wins = "The baseline" if role == "baseline" else winner.capitalize().replace("-", "\u2011")
    sparks = zip((who[role] for role in ORDER), ("mb", "dd", "bl"), strict=True)
    return Card(
        id="setpoint",
        name="Setpoint",
        link="setpoint.html",
        moves="Nozzle camera to flow and temperature setpoints",
        state=judged.decision.split(":")[0].rstrip("."),
        mark=role if passed else None,
        win=(f"{who_wins} wins.", _win(scores, judged.winner)) if passed else (judged.lead, judged.reason),
        caption="Flow’s distance from 100\u00a0%, 90th percentile of 21 starts over 100 decisions, log "
        f"scale {FLOOR:g} to {CEILING:g}\u00a0%: {case_text(case, whole=True)}. Grey: within "
        f"{FLOW_BAND:g}\u00a0%.",
        panels=[_spark(table, name, case, css, named=i == 0) for i, (name, css) in enumerate(sparks)],
        heads=heads(ORDER, [who[role] or "none judged" for role in ORDER]),
        rows=[
            Row(title, _cells([worst(scores, who[role], what)[0] for role in ORDER], limit))
            for title, what, limit in (
                ("Settle, worst case", "settled", rules.settled_percent),
                ("Settle and stay, worst case", "stay", rules.stay_percent),
                ("Recover from a clog", "recovered", rules.settled_percent),
            )
        ],
        note=judged.note,
        sources=sources.source("scoreboard", "paths", "choice"),
    )


def _win(scores: Board, default: str) -> str:
    """The default's worst case beside those of the others."""
    mine, place = worst(scores, default, "lasting")
    if place is None:
        return ""
    name = named(scores, default)
    others = [
        f"{named(scores, other)} {share_text(worst(scores, other, 'lasting')[0])}"
        for other in scores.names
        if other != default
    ][:2]
    beside = f"; next in their own worst cases: {', '.join(others)}" if others else ""
    return (
        f"{name[:1].upper()}{name[1:]}: {share_text(mine)} of runs settle and stay in its worst case "
        f"({within(place)}){beside}."
    )


def _cells(figures: Sequence[Figure | Missing], limit: float) -> list[Cell]:
    most = max((figure.value for figure in figures if isinstance(figure, Figure)), default=math.nan)
    return [
        Cell(
            share_text(figure),
            best=isinstance(figure, Figure) and figure.value == most,
            bad=isinstance(figure, Figure) and figure.high < limit,
        )
        for figure in figures
    ]


def _spark(table: Table | Missing, name: str, case: tuple[str, str], css: str, *, named: bool) -> Markup:
    gap = (
        table
        if isinstance(table, Missing)
        else Missing("not measured", f"no way of {name or 'any controller'} was kept")
    )
    rows = (
        None
        if isinstance(table, Missing)
        else (table["controller"] == name) & (table["simulator"] == case[0]) & (table["case"] == case[1])
    )
    if rows is None or not rows.any():
        return Markup('<div class="hole">{}</div>').format(page.missing(gap))
    off = pd.Series(np.abs(table["flow_percent"][rows] - BEST_FLOW)).groupby(table["step"][rows])
    reached = off.quantile(0.9)
    steps, curve = reached.index.to_numpy(), reached.to_numpy()
    bad = bool(curve[-1] > FLOW_BAND)
    alt = (
        f"{name}: nine of ten starts are within {number(float(curve[-1]), 1)} % of full flow after "
        f"{int(steps[-1])} decisions, {'outside' if bad else 'inside'} the {FLOW_BAND:g} % asked for"
    )
    axis = charts.logarithmic(FLOOR, CEILING)._replace(low=FLOOR, high=CEILING)
    return charts.spark(
        steps.astype(float),
        np.maximum(curve, FLOOR),
        axis,
        css=css,
        limit=FLOW_BAND,
        alt=alt,
        limit_label=f"limit {FLOW_BAND:g}" if named else "",
        units=("decisions", "%"),
    )
