"""The strip "why it acted": what each window of frames said, flow and temperature beside their bands, what
was sent, and where nothing was, with the reason."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from pipeline.report.shared import charts, page
from pipeline.report.shared.pictures import as_table
from pipeline.report.shared.sources import Sources
from pipeline.setpoint.agents.criteria import FLOW_BAND, TEMPERATURE_BAND
from pipeline.setpoint.published import BEST_FLOW, BEST_TEMPERATURE
from pipeline.verdict.digits import THIN, count, number
from pipeline.verdict.evidence import Table, need
from pipeline.verdict.verdict import Missing

EPISODES, WIDTH, LEFT = 2, 1112, 36
# decisions that are told in words
MOST_SENTENCES = 200
# colours of the deposition page: too little, right, too much
SHARES = (("p_under", "too-little"), ("p_good", "flag"), ("p_over", "too-much"))


@as_table()
def strips(sources: Sources) -> dict[str, Any]:
    """The episodes in the order of the table."""
    table = need(sources.tables["decisions"])
    episodes = itertools.islice(pd.DataFrame(table).groupby("episode", sort=False), EPISODES)
    shown = [
        _strip({str(column): values.to_numpy() for column, values in rows.items()}, str(name), i)
        for i, (name, rows) in enumerate(episodes)
    ]
    gap = Missing("not measured", "no episode was kept", "Run ./run dvc repro evaluate_setpoint")
    return {
        "missing": None if shown else gap,
        "shown": shown,
        "origin": page.origin(sources.source("decisions")),
    }


def reason(why: str) -> str:
    """Why nothing was sent, out of the sentence."""
    return why.rsplit("held: ", 1)[-1].strip()


def _strip(mine: Table, name: str, i: int) -> dict[str, Any]:
    """One episode: its name, its finding, its panels, and its decisions in words, of which `more` are not
    shown."""
    t = mine["time_s"]
    edges = np.append(t, t[-1] + (t[-1] - t[-2] if len(t) > 1 else 1.0))
    x = charts.linear(float(t[0]), float(edges[-1]), ticks=10)
    held = [(a, b, reason(str(mine["why"][a]))) for a, b in _alike(mine)]
    inside = (np.abs(mine["flow_percent"] - BEST_FLOW) <= FLOW_BAND) & (
        np.abs(mine["temperature_degC"] - BEST_TEMPERATURE) <= TEMPERATURE_BAND
    )
    first = int(np.flatnonzero(~inside)[-1]) + 1 if not inside.all() else 0
    end = (
        f"inside for good from decision {first}, {number(float(t[first]), 0)}{THIN}s"
        if inside[-1]
        else "outside at the end"
    )
    sent = int((mine["flow_move_percent"] != 0).sum())
    windows = (
        pd.DataFrame(held, columns=["begin", "end", "reason"])
        .groupby("reason", sort=False)[["begin", "end"]]
        .sum()
    )
    holds = "; ".join(f"{why}, {count(end - begin, 'window')}" for why, begin, end in windows.itertuples())
    finding = (
        f"{end[:1].upper()}{end[1:]}; the flow was moved {number(sent, 0)} times in "
        f"{count(len(t), 'decision')}, {f'and held for: {holds}' if holds else 'and never held'}."
    )
    moved = (mine["flow_move_percent"] != 0) | (mine["temperature_move_degC"] != 0)
    sentences = [str(text) for text in mine["why"][moved | mine["held"]]]
    panels = [_shares(mine, x, edges, held), _flow(mine, x, held, edges), _temperature(mine, x)]
    return {
        "id": f"why-{i}",
        "head": name,
        "controller": str(mine["controller"][0]),
        "finding": finding,
        "panels": [*panels, _moves(mine, x)],
        "rows": sentences[:MOST_SENTENCES],
        "more": len(sentences[MOST_SENTENCES:]),
    }


def _alike(mine: Table) -> list[tuple[int, int]]:
    """Stretches of windows that were held for one reason."""
    stretches = []
    for a, b in charts.stretches(np.asarray(mine["held"], bool)):
        cuts = [
            a,
            *(k for k in range(a + 1, b) if reason(str(mine["why"][k])) != reason(str(mine["why"][k - 1]))),
            b,
        ]
        stretches += itertools.pairwise(cuts)
    return stretches


def _frame(x: charts.Axis, y: charts.Axis, height: int, *, last: bool = False) -> charts.Frame:
    return charts.Frame(x, y, WIDTH, height, LEFT, 16 if last else 6, 16)


def _shares(mine: Table, x: charts.Axis, edges: np.ndarray, held: Sequence[tuple[int, int, str]]) -> Markup:
    frame = _frame(x, charts.Axis(0, 1, ((0.0, "0"), (0.5, "0.5"), (1.0, "1"))), 112)
    px, low = frame.px(edges), np.zeros(len(mine["time_s"]))
    layers = []
    for column, css in SHARES:
        top, bottom = frame.py(low + mine[column]), frame.py(low)
        boxes = "".join(
            f"M{px[k]:.1f} {top[k]:.1f}H{px[k + 1]:.1f}V{bottom[k]:.1f}H{px[k]:.1f}Z" for k in range(len(low))
        )
        layers.append(Markup('<path class="{}" d="{}"/>').format(css, boxes))
        low = low + mine[column]
    layers += [_hatch(frame, float(px[begin]), float(px[end])) for begin, end, _ in held]
    return charts.panel(
        frame,
        layers,
        alt=f"Shares of under, good and over-extruded over {len(low)} windows: "
        f"under peaks at {number(float(mine['p_under'].max()), 2)}, "
        f"over at {number(float(mine['p_over'].max()), 2)}; "
        f"{sum(end - begin for begin, end, _ in held)} windows were held",
        css="mb strip-why",
        title="share of under (brown), good (grey), over (green); hatched: nothing may be sent",
        x_ticks=False,
        units=("s", ""),
    )


def _hatch(frame: charts.Frame, a: float, b: float) -> Markup:
    top, bottom = frame.above, frame.height - frame.below
    height = bottom - top
    strokes = []
    for x in np.arange(a - height, b, 6.0):
        # the part of a line at 45 degrees that lies between a and b
        first, last = max(x, a), min(x + height, b)
        if last > first:
            strokes.append(f"M{first:.1f} {bottom - (first - x):.1f}L{last:.1f} {bottom - (last - x):.1f}")
    return Markup(
        '<rect class="veil" x="{:.1f}" width="{:.1f}" y="{}" height="{}"/><path class="hatch" d="{}"/>'
    ).format(a, max(b - a, 1.0), top, height, "".join(strokes))


def _flow(mine: Table, x: charts.Axis, held: Sequence[tuple[int, int, str]], edges: np.ndarray) -> Markup:
    highest = max(160.0, float(max(mine["flow_percent"].max(), mine["flow_setpoint_percent"].max())) * 1.3)
    frame = _frame(x, charts.linear(0, highest, ticks=4), 150)
    t = mine["time_s"]
    layers = [
        charts.tint(frame, BEST_FLOW - FLOW_BAND, BEST_FLOW + FLOW_BAND),
        charts.line(frame, t, mine["flow_setpoint_percent"], "ref", steps=True),
        charts.line(frame, t, mine["flow_percent"]),
    ]
    free = -1e9
    for begin, _, text in held:
        # at the right end it begins earlier; what would run into the one before it is left to the words below
        start = min(float(frame.px(edges[begin])), WIDTH - 6.2 * (len(text) + 6))
        if start < free:
            continue
        layers.append(
            Markup('<text x="{:.1f}" y="{}">{}</text>').format(start, frame.above + 9, f"held: {text}")
        )
        free = start + 6.2 * (len(text) + 8)
    return charts.panel(
        frame,
        layers,
        alt=f"True flow from {number(float(mine['flow_percent'][0]), 0)} to "
        f"{number(float(mine['flow_percent'][-1]), 0)} %, between "
        f"{number(float(mine['flow_percent'].min()), 0)} and "
        f"{number(float(mine['flow_percent'].max()), 0)} %",
        css="dd strip-why",
        title="true flow, % (dashed: setpoint; grey: what is asked for)",
        x_ticks=False,
        units=("s", "%"),
    )


def _temperature(mine: Table, x: charts.Axis) -> Markup:
    values = np.concatenate(
        [mine["temperature_degC"], mine["target_degC"], [BEST_TEMPERATURE - 12, BEST_TEMPERATURE + 12]]
    )
    frame = _frame(x, charts.linear(float(values.min()) - 2, float(values.max()) + 2, ticks=3), 104)
    layers = [
        charts.tint(frame, BEST_TEMPERATURE - TEMPERATURE_BAND, BEST_TEMPERATURE + TEMPERATURE_BAND),
        charts.line(frame, mine["time_s"], mine["target_degC"], "ref", steps=True),
        charts.line(frame, mine["time_s"], mine["temperature_degC"]),
    ]
    return charts.panel(
        frame,
        layers,
        alt=f"Nozzle temperature from {number(float(mine['temperature_degC'][0]), 0)} to "
        f"{number(float(mine['temperature_degC'][-1]), 0)} °C",
        css="dd strip-why",
        title="nozzle, °C (dashed: target)",
        x_ticks=False,
        units=("s", "°C"),
    )


def _moves(mine: Table, x: charts.Axis) -> Markup:
    reach = max(10.0, float(np.abs(mine["flow_move_percent"]).max()))
    frame = _frame(
        x,
        charts.Axis(
            -1.25 * reach, 1.25 * reach, ((-reach, number(-reach, 0)), (0.0, "0"), (reach, number(reach, 0)))
        ),
        92,
        last=True,
    )
    moves = np.where(mine["flow_move_percent"] == 0, np.nan, mine["flow_move_percent"])
    warm = [
        (float(t), float(move))
        for t, move in zip(mine["time_s"], mine["temperature_move_degC"], strict=True)
        if move
    ]
    layers = [charts.level(frame, 0, "ax"), charts.stems(frame, mine["time_s"], moves)]
    for t, move in warm:
        # text on the free side of its tick
        layers.append(
            Markup('<path class="warm" d="M{0:.1f} {1}v{2}"/><text x="{3:.1f}" y="{4}">{5}</text>').format(
                float(frame.px(t)),
                frame.above,
                frame.height - frame.below - frame.above,
                float(frame.px(t)) + 3,
                frame.above + 8,
                f"{'+' if move > 0 else '−'}{number(abs(move), 0)} °C",
            )
        )
    return charts.panel(
        frame,
        layers,
        alt=f"{int(np.isfinite(moves).sum())} moves of the flow setpoint, {len(warm)} of the target "
        "temperature",
        css="dd strip-why",
        title="moves that were sent: flow, points (strokes); target (lines with their °C)",
        units=("s", "points"),
    )
