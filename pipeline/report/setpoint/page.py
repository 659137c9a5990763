"""The page of the setpoint loop: who sets flow and temperature by default, what each controller makes of each
case, and what the camera's classifier is worth."""

from typing import Any

from pipeline.report.setpoint import card as setpoint_card
from pipeline.report.setpoint import deciding as setpoint_deciding
from pipeline.report.setpoint import harm as setpoint_harm
from pipeline.report.setpoint import vision as setpoint_vision
from pipeline.report.setpoint import why as setpoint_why
from pipeline.report.shared import charts, page, words
from pipeline.report.shared.sources import Sources
from pipeline.setpoint.agents.criteria import BEYOND
from pipeline.verdict.digits import band
from pipeline.verdict.evidence import gap_of, known
from pipeline.verdict.setpoint import (
    DATA_DRIVEN,
    MODEL_BASED,
    SIMULATORS,
    Board,
    Case,
    Cell,
    board,
    case_text,
    lasting,
    of_classifier,
    role,
    share_text,
    summary,
    worst,
)
from pipeline.verdict.verdict import FAILED, OPEN, PASSED, Figure, Missing, Question, state

# what the two columns of its rules are, and the mark of the second
HEADS = ("Data\u2011driven", "Baseline", "baseline")

WORDS = (
    "window_of_frames",
    "settles",
    "stays",
    "recovers",
    "agent",
    "as_published",
    "bayes",
    "sequential",
    "recorded_windows",
    "sticky",
    "segment",
    "clog",
    "good_starts",
    "faulty_camera",
    "accuracy",
    "worst_case",
    "interval",
    "key_area",
    "calibrated",
    "held_window",
    "foreign",
    "reward",
    "accepted",
)
MOST = 12
GOOD = 1  # of the classes under, good, over
LANES = {"data_driven": "dd", "model_based": "mb", "baseline": "acc"}


def render(sources: Sources) -> str:
    """The text of setpoint.html."""
    judged, scores = sources.verdicts["setpoint"], board(sources.evidence, sources.subject("setpoint"))
    judged_scores, classified = known(scores, None), known(sources.tables["classified"], None)
    return page.render(
        "setpoint.html",
        here="setpoint",
        sources=sources,
        title=f"Setpoint: {judged.decision.rstrip('.')}",
        verdict=judged,
        heads_of_rules=HEADS
        if judged_scores is None
        else (
            HEADS[0],
            {MODEL_BASED: "Model\u2011based"}.get(
                judged_scores.kinds.get(judged_scores.baseline(), ""), HEADS[1]
            ),
            role(judged_scores, judged_scores.baseline()) if judged_scores.baseline() else HEADS[2],
        ),
        seeing=[line[0].name for line in judged.rules if of_classifier(line[0])],
        second=judged_scores is not None
        and bool(judged_scores.default)
        and judged_scores.kinds[judged_scores.default] != DATA_DRIVEN,
        summary=summary(sources.evidence, judged_scores) if judged_scores and judged_scores.default else "",
        no_board=gap_of(scores),
        heads=heads(judged_scores),
        answers=answers(sources, judged_scores) if judged_scores else [],
        # cases that the first screen has no room for: those in which the default fares best
        better=max(len(_counting(judged_scores)) - MOST, 0) if judged_scores else 0,
        deciding=setpoint_deciding.picture(sources, scores),
        boards=boards(judged_scores) if judged_scores else [],
        worsts=worsts(judged_scores) if judged_scores else [],
        harms=setpoint_harm.harms(sources, scores),
        choice=known(sources.tables["choice"], {}),
        strips=setpoint_why.strips(sources),
        good=classified["named"][classified["label"] == GOOD] == GOOD if classified else [],
        by_flow=setpoint_vision.by_flow(sources),
        yardsticks=setpoint_vision.yardsticks(sources),
        reliability=setpoint_vision.reliability(sources),
        frames=setpoint_vision.frames(sources),
        classes=setpoint_vision.CLASSES,
        places=("rejected", *setpoint_vision.CLASSES, *setpoint_vision.GROUPS),
        scores=judged_scores,
        rules=sources.declared.rules,
        beyond=BEYOND,
        simulators=SIMULATORS,
        **{function.__name__: function for function in (share_text, case_text, lasting, role, worst)},
        data=setpoint_vision.data(sources),
        words=words.chosen(sources, WORDS),
        from_board=sources.source("scoreboard", "choice"),
        from_classifier=sources.source("train_classifier", "classified"),
    )


def heads(scores: Board | None) -> list[dict[str, Any]]:
    """The two controllers of the first screen: what learned, and a baseline: the default or the best."""
    pair = ("", "") if scores is None else (scores.learned(), scores.baseline())
    return [
        {
            "name": name or "none",
            "default": bool(name) and scores is not None and name == scores.default,
            "mark": role(scores, name) if name else fallback,
            "css": css,
        }
        for name, fallback, css in zip(pair, ("data_driven", "baseline"), ("dd", "mb"), strict=True)
    ]


# ---- the first screen: a row for each case that counts


def answers(sources: Sources, scores: Board) -> list[dict[str, Any]]:
    """Runs that settle and stay of what learned and of a baseline, the worst case of the default first; the
    strip shows the runs that are lost, as a share of those that may be."""
    pair = (scores.learned(), scores.baseline())
    mine, cases = scores.default or pair[0] or pair[1], _counting(scores)
    _, lowest = worst(scores, mine, "lasting")
    cases.sort(key=lambda case: _share_of(scores.cells.get((mine, case))))
    lost = Question(0, "", "Runs lost", "%", 100 - sources.declared.rules.settled_percent, False, "")
    gone = Question(0, "", "Runs that leave", "%", 100 - sources.declared.rules.stay_percent, False, "")
    rows = []
    for case in cases[:MOST]:
        cells = [scores.cells.get((name, case)) for name in pair]
        shown = [
            (name, LANES[role(scores, name)], _lost(cell))
            for name, cell in zip(pair, cells, strict=True)
            if name
        ]
        own = scores.cells.get((mine, case))
        states = [state(lost, _lost(own)), state(gone, _lost(own, "stay"))] if own else [OPEN] * 2
        change = setpoint_card.change(sources, case, own)
        rows.append(
            {
                "simulator": SIMULATORS.get(case[0], case[0]),
                "case": case_text(case),
                "state": next((verdict for verdict in states if verdict != PASSED), PASSED),
                "cells": [
                    _reading(name, cell, lost, css)
                    for name, cell, css in zip(pair, cells, ("dd", "mb"), strict=True)
                ],
                "strip": charts.strip(lost, shown),
                "stay": share_text(own.stay) if own else "not measured",
                "stay_bad": states[1] == FAILED,
                "change": change,
                "worse": change.word == "worse" and state(change.question, change.now) == FAILED,
                "decides": case == lowest,
            }
        )
    return rows


def _counting(scores: Board) -> list[Case]:
    """The cases that count for one of the two controllers of the first screen."""
    pair = (scores.learned(), scores.baseline())
    return [
        case
        for case in scores.cases
        if any((cell := scores.cells.get((name, case))) and cell.counts for name in pair)
    ]


def _share_of(cell: Cell | None) -> float:
    """The share by which a case is read; 101 where it was not run."""
    share = Missing("not measured", "") if cell is None else lasting(cell)
    return share.value if isinstance(share, Figure) else 101.0


def _lost(cell: Cell | None, what: str = "settled") -> Figure | Missing:
    share = Missing("not measured", "this case was not run") if cell is None else getattr(cell, what)
    ends = () if gap_of(share) else (share.value, share.high, share.low)
    return gap_of(share) or Figure(*(max(100 - end, 0.0) for end in ends))


def _reading(name: str, cell: Cell | None, lost: Question, css: str) -> dict[str, Any]:
    if cell is None or not isinstance(cell.settled, Figure):
        return {"css": css, "name": name, "value": "not measured", "band": "", "bad": False}
    interval = band(cell.settled.low, cell.settled.high, 1)
    return {
        "css": css,
        "name": name,
        "value": share_text(cell.settled),
        "band": interval,
        "bad": state(lost, _lost(cell)) == FAILED,
    }


# ---- the scoreboard


def boards(scores: Board) -> list[dict[str, Any]]:
    """A table for each simulator: controllers down, cases across."""
    tables = []
    for simulator in dict.fromkeys(case[0] for case in scores.cases):
        cases = [case for case in scores.cases if case[0] == simulator]
        cells = [cell for (_, case), cell in scores.cells.items() if case[0] == simulator]
        tables.append(
            {
                "simulator": simulator,
                "cases": cases,
                "names": [
                    name for name in scores.names if any((name, case) in scores.cells for case in cases)
                ],
                "counts": any(cell.counts for cell in cells),
                "runs": sorted({cell.runs for cell in cells}),
            }
        )
    return tables


def worsts(scores: Board) -> list[tuple[str, Case, Cell, float]]:
    """Everybody's worst case and its cell, the best first, with the mean share over the cases that count."""
    rows = []
    for name in scores.names:
        _, case = worst(scores, name, "lasting")
        shares = [lasting(cell) for _, cell in scores.counting(name)]
        values = [share.value for share in shares if isinstance(share, Figure)]
        if case is not None:
            rows.append((name, case, scores.cells[name, case], sum(values) / len(values)))
    return rows
