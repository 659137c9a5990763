"""How controllers of setpoints fare, drawn: ways from the 21 starts over the reward, their flow step by step,
and training of the paper's agent."""

import math
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from pipeline.papers import made
from pipeline.report.shared import charts, page
from pipeline.report.shared.pictures import Picture, PictureColumn, as_picture, as_table, placeholder
from pipeline.report.shared.sources import Sources
from pipeline.setpoint.agents.criteria import (
    BEYOND,
    CLOG_STEP,
    FLOW_BAND,
    SETTLED_BY,
    STEPS,
    TEMPERATURE_BAND,
)
from pipeline.setpoint.controllers import NO_CONTROL as DOES_NOTHING
from pipeline.setpoint.published import BEST_FLOW, BEST_TEMPERATURE, PHASES, ROTATION
from pipeline.verdict.digits import THIN, band, number, percent, quantity
from pipeline.verdict.evidence import Absent, Table, instead, need, need_figure, or_empty, or_gap
from pipeline.verdict.setpoint import Board, Case, Harm, bars, case_text, harm_of, role, share_text
from pipeline.verdict.verdict import Figure, Missing

# rewards whose lines are drawn, of the last phase
LEVELS = (0.5, 0.0, -0.5, -0.8)
FLOW, TEMPERATURE = charts.linear(0, 320, ticks=6), charts.linear(180, 240, ticks=6)
# starts that a panel has room for
MOST = 42
CASES = (("recorded", "recorded, sticky"), ("paper", "accuracy 0.7"))
# key of the agent's figures -> who, after what
TAUGHT = {
    "phase3": ("The paper’s agent", "phases 1 to 3, judged with classes that are always right"),
    "phase3_at_0.7": ("The paper’s agent", f"phases 1 to 3, judged with 70{THIN}% right"),
    "phase4": ("The paper’s agent", f"all four phases, judged with 70{THIN}% right"),
    "phase4_at_1": ("The paper’s agent", "all four phases, judged with classes that are always right"),
}


# ---- from the 21 starts


def shown(board: Board, table: Table, case: Case) -> list[str]:
    """The default first, then the model-based and the data-driven controller, as far as their ways were
    kept."""
    in_paths = {
        str(name)
        for name in table["controller"][(table["simulator"] == case[0]) & (table["case"] == case[1])]
    }
    names = (board.default or board.names[0], board.baseline(), board.learned())
    return [name for name in dict.fromkeys(names) if name in in_paths]


@instead(lambda gap: [placeholder("ways", "From 21 starts to the best setpoint", gap)])
def ways(sources: Sources, board: Board | Missing) -> list[Picture]:
    """For each simulator whose ways were kept, everybody's ways over
    the reward and their flow step by step."""
    board, table = need(board), need(sources.tables["paths"])
    run = list(
        pd.DataFrame(table)[["simulator", "case"]].drop_duplicates().itertuples(index=False, name=None)
    )
    wanted = (*CASES, *(case for case in run if case[0] == "pixels"))
    cases = [case for case in wanted if case in run][:3] or run[:1]
    if not cases:
        raise Absent(Missing("not measured", "no way was kept", "Run ./run dvc repro evaluate_setpoint"))
    return [_ways(sources, board, table, case, i) for i, case in enumerate(cases)]


def _ways(sources: Sources, board: Board, table: Table, case: Case, i: int) -> Picture:
    columns, sentences = [], []
    for name in shown(board, table, case):
        mine = (table["controller"] == name) & (table["simulator"] == case[0]) & (table["case"] == case[1])
        flow, temperature = _by_start(table, mine, "flow_percent"), _by_start(table, mine, "temperature_degC")
        inside = _inside(flow, temperature)
        ends = sum(way[min(len(way) - 1, SETTLED_BY) :].all() for way in inside)
        mark, css = role(board, name), page.MARKS[role(board, name)]
        sentences.append(f"{name} {ends} of {len(flow)}")
        first = not columns
        panels = [_surface(name, flow, temperature, ends, css, first), _steps(name, flow, inside, css, first)]
        columns.append(
            PictureColumn(
                name, "runs by default" if name == board.default else board.kinds[name], mark, panels
            )
        )
    where = case_text(case, whole=True)
    return Picture(
        f"Inside by decision {SETTLED_BY} and to the end: {'; '.join(sentences)}.",
        columns,
        "One run from each start. Above: temperature against true flow, over the paper’s reward with a, "
        f"b = {PHASES[-1][0]:g}, {PHASES[-1][1]:g}; lines of equal reward "
        f"{', '.join(number(level, 1) for level in LEVELS)} outwards. Ring: start; filled: end, "
        f"vermillion outside. Grey: {BEST_FLOW - FLOW_BAND:g}–{BEST_FLOW + FLOW_BAND:g}{THIN}% and "
        f"{BEST_TEMPERATURE:g}{THIN}±{THIN}{TEMPERATURE_BAND:g}{THIN}°C. Below: flow against decisions.",
        page.origin(
            sources.source("paths"), simulator=case[0], case=case[1], controller=shown(board, table, case)
        ),
        f"ways-{i}",
        f"{where}: from 21 starts to the best setpoint",
    )


def _by_start(table: Table, mine: np.ndarray, column: str) -> list[np.ndarray]:
    from_start = pd.Series(table[column][mine]).groupby(table["start"][mine])
    ways = [way.to_numpy() for _, way in from_start]
    return ways[:: -(-len(ways) // MOST)]


def _inside(flow: list[np.ndarray], temperature: list[np.ndarray]) -> list[np.ndarray]:
    return [
        (np.abs(q - BEST_FLOW) <= FLOW_BAND + 1e-3)
        & (np.abs(u - BEST_TEMPERATURE) <= TEMPERATURE_BAND + 1e-3)
        for q, u in zip(flow, temperature, strict=True)
    ]


def equal_reward(level: float, *, a: float, b: float) -> tuple[np.ndarray, np.ndarray]:
    """Flow and temperature where (14)-(16) give `level`: the ellipse with semi-axes
    (a, b) times 2 / (1 + level) - 1, turned by theta."""
    t, scale = np.linspace(0, 2 * math.pi, 121), 2 / (1 + level) - 1
    q_r, u_r = scale * a * np.cos(t), scale * b * np.sin(t)
    cos, sin = math.cos(ROTATION), math.sin(ROTATION)
    return BEST_FLOW + q_r * cos + u_r * sin, BEST_TEMPERATURE - q_r * sin + u_r * cos


def _surface(
    name: str, flow: list[np.ndarray], temperature: list[np.ndarray], ends: int, css: str, titled: bool
) -> Markup:
    frame = charts.Frame(FLOW, TEMPERATURE, 368, 244, 30, above=22)
    layers = [_rings(frame)]
    box = [
        float(v)
        for v in (
            *frame.px([BEST_FLOW - FLOW_BAND, BEST_FLOW + FLOW_BAND]),
            *frame.py([BEST_TEMPERATURE + TEMPERATURE_BAND, BEST_TEMPERATURE - TEMPERATURE_BAND]),
        )
    ]
    layers.append(
        Markup('<rect class="flag" x="{:.1f}" width="{:.1f}" y="{:.1f}" height="{:.1f}"/>').format(
            box[0], box[1] - box[0], box[2], box[3] - box[2]
        )
    )
    for q, u in zip(flow, temperature, strict=True):
        layers.append(charts.line(frame, q, u, "line way"))
    layers += [charts.dots(frame, q[:1], u[:1], "begin", 2.4) for q, u in zip(flow, temperature, strict=True)]
    last = [way[-1] for way in _inside(flow, temperature)]
    layers += [
        charts.dots(frame, q[-1:], u[-1:], "dot whole" if ok else "dot off", 2.8)
        for q, u, ok in zip(flow, temperature, last, strict=True)
    ]
    return charts.panel(
        frame,
        layers,
        alt=f"{name}: of {len(flow)} starts {ends} end inside 90–110 % and 205–215 °C and stay there",
        css=f"{css} surface",
        title="°C against % of flow" if titled else "",
        units=("%", "°C"),
    )


def _rings(frame: charts.Frame) -> Markup:
    """The reward as nested grey areas, cut at the panel's edge."""
    paths = []
    for level in sorted(LEVELS):
        q, u = equal_reward(level, a=PHASES[-1][0], b=PHASES[-1][1])
        # unclipped, so that an ellipse that leaves the panel keeps its shape
        px = frame.left + (q - frame.x.low) / (frame.x.high - frame.x.low) * (
            frame.width - frame.left - frame.right
        )
        py = (
            frame.height
            - frame.below
            - (u - frame.y.low) / (frame.y.high - frame.y.low) * (frame.height - frame.below - frame.above)
        )
        paths.append(
            Markup('<path class="iso" d="M{}Z"/>').format(
                "L".join(f"{x:.1f} {y:.1f}" for x, y in zip(px[:-1], py[:-1], strict=True))
            )
        )
    wide, high = frame.width - frame.left - frame.right, frame.height - frame.below - frame.above
    return Markup('<svg x="{0}" y="{1}" width="{2}" height="{3}" viewBox="{0} {1} {2} {3}">{4}</svg>').format(
        frame.left, frame.above, wide, high, Markup("").join(paths)
    )


def _steps(name: str, flow: list[np.ndarray], inside: list[np.ndarray], css: str, titled: bool) -> Markup:
    last = max(len(q) for q in flow) - 1
    frame = charts.Frame(
        charts.linear(0, max(last, 1), ticks=5), charts.linear(0, 320, ticks=4), 368, 132, 30
    )
    since = [int(np.flatnonzero(~way)[-1]) + 1 if not way.all() else 0 for way in inside]
    done = [k for k, way in zip(since, inside, strict=True) if way[-1]]
    text = f"half of them inside after {int(np.median(done))} decisions" if done else "none inside at the end"
    layers = [charts.tint(frame, BEST_FLOW - FLOW_BAND, BEST_FLOW + FLOW_BAND)]
    layers += [charts.line(frame, np.arange(len(q)), q, "line way") for q in flow]
    layers.append(charts.label(frame, last, 320, text, anchor="end", dy=8))
    lowest, highest = (end(float(end(q[len(q) // 2 :])) for q in flow) for end in (min, max))
    return charts.panel(
        frame,
        layers,
        alt=f"{name}: {text}; in the second half flows lie between {number(lowest, 0)} and "
        f"{number(highest, 0)} %",
        css=css,
        title="% of flow" if titled else "",
        units=("decisions", "%"),
    )


# ---- what the agents learned


@as_picture("agents", "The paper’s agent in training, phase after phase")
def training(sources: Sources) -> Picture:
    """Mean reward while the paper's agent learns, phase after phase (figure 6 of the paper)."""
    table = need(sources.tables["agents"])
    course = pd.DataFrame(table)
    values = ", ".join(number(end, 2) for end in course.groupby("phase").reward.last().tolist())
    return Picture(
        f"Its phases end at a mean reward of {values}.",
        [PictureColumn("The paper’s agent", "as published", "data_driven", [_course(course, values)])],
        "Mean reward of a step, in the reward of its phase, against thousands of updates: "
        f"{', then '.join(f'a, b = {a:g}, {b:g}' for a, b in PHASES)}, "
        "then the last with classes that are wrong at times. Rewards of two phases do not compare.",
        page.origin(sources.source("agents")),
    )


def _course(mine: pd.DataFrame, reward_text: str) -> Markup:
    updates, reward = mine["update"] / 1000, mine.reward
    span = max(float(reward.max() - reward.min()), 0.2)
    y = charts.linear(float(reward.min()) - 0.25 * span, float(reward.max()) + 0.1 * span, ticks=4)
    frame = charts.Frame(charts.linear(0, float(updates.max()) or 1.0, ticks=5), y, 568, 180, 34)
    layers = []
    phases = mine.groupby("phase")
    for i, (k, here) in enumerate(phases.indices.items()):
        begin = float(updates.iloc[here].min()) if i else 0.0
        x = float(frame.px(begin))
        if i:
            layers.append(
                Markup('<line class="lim" x1="{0:.1f}" x2="{0:.1f}" y1="{1}" y2="{2}"/>').format(
                    x, frame.above, frame.height - frame.below
                )
            )
        layers.append(charts.label(frame, begin, y.low, f"phase {k}", dx=3, dy=-4))
        layers.append(charts.line(frame, updates.to_numpy()[here], reward.to_numpy()[here]))
    return charts.panel(
        frame,
        layers,
        alt=f"The paper’s agent: mean reward at the end of each phase {reward_text}, "
        f"after {number(float(mine['update'].max()), 0)} updates in all",
        css="dd wide",
        title="mean reward",
        units=("thousand updates", ""),
    )


def kept_sentence() -> str:
    """Since when the agent is kept, and how it is trained anew."""
    kept, command = made.sentence("train_agent"), made.command("train_agent")
    anew = "" if command in kept else f" {command} trains it anew."
    return f"All pages show one agent, which no recording changes. {kept}{anew}"


@as_table()
def phases(sources: Sources) -> dict[str, Any]:
    """What training came to: settled, staying and steps, by what was trained."""
    metrics = need(sources.metrics["train_agent"])
    rows = []
    for name, (head, small) in TAUGHT.items():
        figures = metrics.get(name)
        if not isinstance(figures, dict):
            continue
        steps, runs, stay = (figures.get(key) for key in ("median_steps", "runs", "stay"))
        rows.append(
            {
                "name": head,
                "small": small,
                "mark": "data_driven",
                "settled": percent(float(figures["settled"]), 3),
                "stay": "not measured" if stay is None else percent(float(stay), 3),
                "steps": "none settled" if steps is None else number(float(steps), 0),
                "runs": "not said" if runs is None else f"{runs:,}",
            }
        )
    if not rows:
        raise Absent(Missing("not measured", "figures.json of train_agent holds no run"))
    return {"rows": rows}


# ---- what the paper claims of its agent, and what it does not print


# figures of a single start, in the order of the table: their words and their unit
CLAIMED = {
    "rests_at": ("rests at, flow", "%"),
    "least": ("least flow once near 100 %", "%"),
    "most": ("most flow once near 100 %", "%"),
    "flow_range": ("range of flow, second half", "%"),
    "temperature_range": ("range of temperature, second half", "°C"),
}
RANGES = ("flow_range", "temperature_range")


@or_gap
def claims(sources: Sources) -> list[dict[str, Any]] | Missing:
    """What Li and Pattinson (2025) tell of single starts beside our agent trained as they say."""
    found = need_figure(sources.metrics["train_agent"], "claims")
    rows = []
    for start, pair in found.items():
        printed, measured = pair.get("printed") or {}, pair.get("measured") or {}
        ranges = not printed or any(key in printed for key in RANGES)
        keys = RANGES if ranges else ("rests_at", "least", "most", "flow_range")
        for key in keys:
            words, unit = CLAIMED[key]
            value, ours = printed.get(key), measured.get(key)
            rows.append(
                {
                    "start": str(start),
                    "first": key == keys[0],
                    "figure": words,
                    "printed": "not printed" if value is None else quantity(float(value), unit, 0),
                    "ours": "never near 100\u202f%" if ours is None else quantity(float(ours), unit, 0),
                }
            )
    return rows


GUESSED = {
    "delta": "delta of (6), steps",
    "alpha": "alpha of (7)",
    "sigma": "sigma of (7)",
    "flow_limits_percent": "limits of flow, %",
    "target_limits_degC": "limits of the target, °C",
    "target_at_the_start": "target at the start",
    "updates_by_phase": "updates, phase by phase",
    "environments": "environments side by side",
    "replay_capacity": "replay buffer, steps",
    "explore_by_phase": "exploration at the start of each phase",
    "explore_least": "least exploration",
}


@or_empty
def guesses(sources: Sources) -> list[tuple[str, str]]:
    """What the paper does not print and we set; [] where nothing was trained."""
    found = need_figure(sources.metrics["train_agent"], "guesses")
    return [(GUESSED.get(name, str(name)), _plain(value)) for name, value in found.items()]


def _plain(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(_plain, value))
    return (
        f"{value:,}" if isinstance(value, int) else f"{value:g}" if isinstance(value, float) else str(value)
    )


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
