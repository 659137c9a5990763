"""What controllers of setpoints take of good prints, against what they recover of clogs."""

import math
from typing import Any

import numpy as np
from markupsafe import Markup

from pipeline.report.shared import charts, page
from pipeline.report.shared.pictures import Picture, PictureColumn, placeholder
from pipeline.report.shared.sources import Sources
from pipeline.setpoint.agents.criteria import BEYOND, CLOG_STEP, SETTLED_BY, STEPS
from pipeline.setpoint.controllers import NO_CONTROL as DOES_NOTHING
from pipeline.verdict.digits import THIN, band, number
from pipeline.verdict.evidence import Absent, instead, need
from pipeline.verdict.setpoint import Board, Case, Harm, bars, case_text, harm_of, role, share_text
from pipeline.verdict.verdict import Figure, Missing

HARM_TITLE = "Harm against recovery"
# a clog that halves the evidence: to 0.6 of the flow, and to 0.75
CLOG, HALF_CLOG = ("recorded", "recorded, sticky, clog"), ("recorded", "recorded, sticky, half clog")
# ends of the axis of harm in percent: the first that holds every controller, else the last
AXES = (5.0, 10.0, 20.0, 50.0, 100.0)


@instead(lambda gap: {"picture": placeholder("harm", HARM_TITLE, gap), "rows": (), "clustered": ""})
def harms(sources: Sources, board: Board | Missing) -> dict[str, Any]:
    """The chart, and the contestants as a table: those that may run first."""
    board = need(board)
    limits = bars(sources.evidence, board)
    found = {name: harm_of(board, name, limits) for name in board.names}
    known = {name: harm for name, harm in found.items() if isinstance(harm, Harm)}
    if not known:
        remedy = "Run ./run dvc repro evaluate_setpoint"
        raise Absent(Missing("not measured", "no run from a good start", remedy))
    seconds = decision_seconds(sources)
    clog = case_text(CLOG, whole=True)
    caption = (
        f"Across: runs from good starts that leave ±{BEYOND[-1]}{THIN}% of flow within 200 decisions, in "
        f"the case that is nearest to its bar, or most beyond it. Up: runs "
        f"that are inside again 60 decisions after a clog ({clog}). Crosses: 95{THIN}% intervals of those "
        "that may run. Grey: harm that is allowed in some case."
    )
    return {
        "picture": Picture(
            _finding(board, known, limits),
            [
                PictureColumn(
                    "Runs recovered from a clog", "in per cent, against harm", "", [_chart(board, known)]
                )
            ],
            caption,
            page.origin(sources.source("scoreboard", "choice")),
            "harm",
            HARM_TITLE,
        ),
        "rows": [_row(board, name, harm, seconds) for name, harm in known.items()],
        "clustered": clustered(board),
    }


def clustered(board: Board) -> str:
    """How the intervals of the scoreboard were made."""
    if not any(n_eff > 0 for cell in board.cells.values() for n_eff in cell.n_eff.values()):
        return f"Intervals are Wilson’s, 95{THIN}%."
    return (
        f"Intervals, 95{THIN}%, are Wilson’s of n_eff runs: as many runs that share nothing as these are "
        "worth. The recorded segments are parted into pools that share none. How much the shares of the "
        "pools differ says what the segments weigh."
    )


def start_text(case: Case) -> str:
    """ "in band, stuck 30" -> "in-band start, stuck 30"."""
    return case_text(case).replace("perfect", "perfect start").replace("in band", "in-band start")


def _recovered(board: Board, name: str, what: str = "recovered", case: Case = CLOG) -> Figure | Missing:
    cell = board.cells.get((name, case))
    return Missing("not measured", "this case was not run") if cell is None else getattr(cell, what)


def decision_seconds(sources: Sources) -> float:
    """How long a decision takes as deployed: the wait, and the window of frames."""
    everything = sources.declared.everything
    pixels = everything["evaluate_setpoint"]["pixels"]
    return pixels["wait_s"] + everything["train_classifier"]["window"] / pixels["frame_rate_hz"]


def minutes_back(board: Board, name: str, case: Case, decision_s: float) -> str:
    """ "95 % back after 7 min", beside the deadline."""
    cell = board.cells.get((name, case))
    if cell is None:
        return ""
    deadline = (SETTLED_BY - CLOG_STEP) * decision_s / 60
    late = f"not within {number((STEPS - CLOG_STEP) * decision_s / 60, 0)}"
    after = (
        late if math.isnan(cell.recovery_p95) else f"after {number(cell.recovery_p95 * decision_s / 60, 1)}"
    )
    return f"95{THIN}% back {after} min (deadline {number(deadline, 1)} min)"


def _row(board: Board, name: str, harm: Harm, decision_s: float) -> dict[str, Any]:
    share, back = _recovered(board, name), _recovered(board, name, "back", HALF_CLOG)
    n_eff = board.cells[name, harm.case].n_eff.get(f"beyond_{BEYOND[-1]}", math.nan)
    worth = "" if math.isnan(n_eff) else f", n_eff {number(n_eff, 0)}"
    return {
        "name": name,
        "mark": role(board, name),
        "default": name == board.default,
        "harm": share_text(harm.figure),
        "harm_band": f"{band(harm.figure.low, harm.figure.high, 1)}{worth}",
        "bad": harm.state == "failed",
        "where": f"{start_text(harm.case)}, ≤\u00a0{harm.limit:g}{THIN}%",
        "recovered": share_text(share),
        "recovered_band": band(share.low, share.high, 1) if isinstance(share, Figure) else "",
        "minutes": minutes_back(board, name, CLOG, decision_s),
        "half_minutes": minutes_back(board, name, HALF_CLOG, decision_s),
        "back": share_text(back),
        "back_band": band(back.low, back.high, 1) if isinstance(back, Figure) else "",
        "why": "may not run" if name in board.refused else "",
    }


def _finding(board: Board, known: dict[str, Harm], limits: dict[Case, float]) -> str:
    """The default, then doing nothing, then the controller that recovers most, with its harm."""
    sentences = []
    for name in dict.fromkeys((board.default, DOES_NOTHING)):
        if name in known:
            harm = known[name]
            sentences.append(
                f"{_said(name)} takes {_taken(harm)} ({start_text(harm.case)}; at most {harm.limit:g}{THIN}% "
                f"may be), and {share_text(board.cells[name, harm.case].beyond[0])} beyond "
                f"±{BEYOND[0]}{THIN}%. It recovers "
                f"{share_text(_recovered(board, name))} of clogs."
            )
    shares = {name: share for name in known if isinstance(share := _recovered(board, name), Figure)}
    most = max(shares, key=lambda name: shares[name].value, default="")
    if most and most not in (board.default, DOES_NOTHING):
        sentences.append(
            f"Most clogs, {share_text(shares[most])}, are recovered by {most}. It takes "
            f"{_taken(known[most])}."
        )
    return " ".join(sentences)


def _taken(harm: Harm) -> str:
    return f"{share_text(harm.figure)} of good prints beyond ±{BEYOND[-1]}{THIN}% of flow"


def _said(name: str) -> str:
    return "Doing nothing" if name == DOES_NOTHING else name[:1].upper() + name[1:]


def _chart(board: Board, known: dict[str, Harm]) -> Markup:
    """A point for each controller, with both intervals."""
    most = max(harm.figure.value for harm in known.values())
    end = next((end for end in AXES if end >= most), AXES[-1])
    x = charts.Axis(0, end, tuple((float(v), f"{v:g}") for v in np.linspace(0, end, 6)))
    y = charts.Axis(-4, 104, tuple((float(v), str(v)) for v in (0, 25, 50, 75, 100)))
    frame = charts.Frame(x, y, 568, 340, 42, 20, 24, right=12)
    allowed = max(harm.limit for harm in known.values())
    layers: list[Markup] = [charts.interval(frame, 0.0, allowed, "allow")]
    taken: list[tuple[float, float]] = []
    shares = {name: share for name in known if isinstance(share := _recovered(board, name), Figure)}
    # from the top down: names that give way to one another keep the order of their points
    for name, share in sorted(shares.items(), key=lambda one: -one[1].value):
        harm = known[name]
        a, low, high = (float(v) for v in frame.px([harm.figure.value, harm.figure.low, harm.figure.high]))
        b, bottom, top = (float(v) for v in frame.py([share.value, share.low, share.high]))
        if name not in board.refused:
            layers.append(
                Markup('<path class="whisk pale" d="M{:.1f} {:.1f}H{:.1f}M{:.1f} {:.1f}V{:.1f}"/>').format(
                    low, b, high, a, bottom, top
                )
            )
        mark = page.MARKS[role(board, name)]
        layers.append(charts.dots(frame, harm.figure.value, share.value, f"dot whole {mark}", 4.0))
        layers.append(_name(frame, name, a, b, taken))
    mine = known.get(board.default)
    return charts.panel(
        frame,
        layers,
        alt="Harm against recovery"
        if mine is None
        else f"{board.default} takes {_taken(mine)} and recovers "
        f"{share_text(_recovered(board, board.default))} of clogs",
        css="mb wide big",
        title="% of clogs recovered, against % harmed",
        units=("%", "%"),
    )


def _name(frame: charts.Frame, name: str, a: float, b: float, taken: list[tuple[float, float]]) -> Markup:
    """A name beside its point, on the side that has room on a phone too; below names that are there."""
    left, y = a + 14 + 9.5 * len(name) > frame.width, b - 6
    while any(abs(y - other) < 18 and abs(a - where) < 200 for where, other in taken):
        y += 6
    taken.append((a, y))
    return Markup('<text x="{:.1f}" y="{:.1f}" text-anchor="{}">{}</text>').format(
        a - 7 if left else a + 7, y, "end" if left else "start", name
    )
