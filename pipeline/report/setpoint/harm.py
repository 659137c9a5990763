"""What controllers of setpoints take of good prints, against what they recover of clogs."""

from typing import Any

import numpy as np
from markupsafe import Markup

from pipeline.report.shared import charts, page
from pipeline.report.shared.pictures import Picture, PictureColumn, placeholder
from pipeline.report.shared.sources import Sources
from pipeline.setpoint.agents.criteria import BEYOND, CLOG_STEP, SETTLED_BY, STEPS
from pipeline.setpoint.controllers import NO_CONTROL as DOES_NOTHING
from pipeline.verdict.digits import THIN
from pipeline.verdict.evidence import Absent, instead, need
from pipeline.verdict.setpoint import Board, Harm, bars, harm_of, role, share_text
from pipeline.verdict.verdict import Figure, Missing

HARM_TITLE = "Harm against recovery"
# a clog that halves the evidence: to 0.6 of the flow, and to 0.75
CLOG, HALF_CLOG = ("recorded", "recorded, sticky, clog"), ("recorded", "recorded, sticky, half clog")
# ends of the axis of harm in percent: the first that holds every controller, else the last
AXES = (5.0, 10.0, 20.0, 50.0, 100.0)


@instead(lambda gap: {"picture": placeholder("harm", HARM_TITLE, gap), "harms": {}})
def harms(sources: Sources, board: Board | Missing) -> dict[str, Any]:
    """The chart, and the harm of each contestant: those that may run first; the cells of both clogs, by name;
    who recovers most; minutes a decision takes as deployed, until the deadline, and until the end."""
    board = need(board)
    limits = bars(sources.evidence, board)
    found = {name: harm_of(board, name, limits) for name in board.names}
    known = {name: harm for name, harm in found.items() if isinstance(harm, Harm)}
    if not known:
        remedy = "Run ./run dvc repro evaluate_setpoint"
        raise Absent(Missing("not measured", "no run from a good start", remedy))
    shares = {name: share for name in known if isinstance(share := _recovered(board, name), Figure)}
    column = PictureColumn(
        "Runs recovered from a clog", "in per cent, against harm", "", [_chart(board, known)]
    )
    origin = page.origin(sources.source("scoreboard", "choice"))
    minutes = decision_seconds(sources) / 60
    return {
        "picture": Picture("", [column], "", origin, "harm", HARM_TITLE),
        "harms": known,
        "clogged": {name: [board.cells.get((name, case)) for case in (CLOG, HALF_CLOG)] for name in known},
        "clog": CLOG,
        "shown_first": [name for name in dict.fromkeys((board.default, DOES_NOTHING)) if name in known],
        "most": max(shares, key=lambda name: shares[name].value, default=""),
        "nothing": DOES_NOTHING,
        "minutes": minutes,
        "deadline": (SETTLED_BY - CLOG_STEP) * minutes,
        "whole": (STEPS - CLOG_STEP) * minutes,
        "clustered": any(n_eff > 0 for cell in board.cells.values() for n_eff in cell.n_eff.values()),
    }


def _recovered(board: Board, name: str) -> Figure | Missing:
    cell = board.cells.get((name, CLOG))
    return Missing("not measured", "this case was not run") if cell is None else cell.recovered


def decision_seconds(sources: Sources) -> float:
    """How long a decision takes as deployed: the wait, and the window of frames."""
    everything = sources.declared.everything
    pixels = everything["evaluate_setpoint"]["pixels"]
    return pixels["wait_s"] + everything["train_classifier"]["window"] / pixels["frame_rate_hz"]


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
        else f"{board.default} takes {share_text(mine.figure)} of good prints beyond ±{BEYOND[-1]}{THIN}% of "
        "flow and recovers "
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
