"""The figures of the identification page that show the model itself: step responses, order, poles, and the
excitation that it was learned from."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from markupsafe import Markup

from pipeline.report.identification.how_identified import left_out_words, loop_state
from pipeline.report.identification.model_errors import Room, as_matrix, matrix, room
from pipeline.report.shared import charts, page
from pipeline.report.shared.pictures import Picture, PictureColumn, as_picture
from pipeline.report.shared.sources import Sources
from pipeline.report.temperature import evidence
from pipeline.verdict.digits import DASH, THIN, band, count, decimals, number, short
from pipeline.verdict.evidence import Table, entry, known, lookup, need, need_figure, or_empty

MOST_DOTS = 600  # of the cloud of poles


# ---- step responses


@as_matrix("steps", "What each input does: step responses")
def steps(sources: Sources) -> dict[str, Any]:
    """Response of each output to a step of each input, with the
    spread's band, and gain, time constant and delay."""
    table, dynamics = need(sources.tables["steps"]), need(sources.tables["dynamics"])
    size = room(len(sources.declared.machine.inputs))
    scales = {o.name: _reach(table, table["output"] == o.name) for o in sources.declared.machine.outputs}

    def cell(output: str, name: str) -> tuple[float, Callable[[], dict[str, Any]]]:
        mine = (table["output"] == output) & (table["input"] == name)
        row = int(np.flatnonzero((dynamics["output"] == output) & (dynamics["input"] == name))[0])
        strength = float(np.abs(table["response"][mine]).max())
        return strength, lambda: _response(table, mine, dynamics, row, scales[output], size)

    rows, more = matrix(sources, cell)
    plants = _members(sources)
    sure, end = int(dynamics["seen"].sum()), float(table["time_s"].max())
    every = len(dynamics["seen"])
    text = (
        (
            f"{sure} of {every} effects are sure in sign; of the others the band over {plants} holds zero. "
            if sure < every
            else "Every effect is sure in sign. "
        )
        + "The figure is the largest excursion, with its band; for an effect that turns back or still rises "
        "at the end, also its steady value."
    )
    caption = (
        f"Answer in °C to one per cent of the input, over {short(end)}{THIN}s from rest; "
        f"the panels of an output share one scale. Band: 90{THIN}% of {plants}, "
        "wider where fits without one quarter of the record differ more, "
        f"cut where it leaves the panel. τ: 1.5 times the way from 28.3 to 63.2{THIN}% of the largest "
        f"excursion; delay: what is left of the time to 63.2{THIN}%.{more}"
    )
    origin = page.origin(sources.source("steps", "dynamics"), y="response")
    return {"finding": text, "rows": rows, "caption": caption, "origin": origin, "across": size.across}


def _members(sources: Sources) -> str:
    poles = known(sources.tables["poles"], None)
    return (
        f"{count(int(poles['member'].max()), 'plant')} of the spread" if poles else "the plants of the spread"
    )


def _reach(table: Table, rows: np.ndarray) -> charts.Axis:
    """Room for the model's responses, and for half as much of their bands."""
    low, high = float(table["response"][rows].min()), float(table["response"][rows].max())
    room = 0.5 * max(high - low, 1e-12)
    low, high = (
        max(float(table["low"][rows].min()), low - room),
        min(float(table["high"][rows].max()), high + room),
    )
    return charts.linear(min(low, 0.0), max(high, 0.0) or 1e-12, ticks=3)


def _response(
    table: Table, rows: np.ndarray, dynamics: Table, row: int, y: charts.Axis, size: Room
) -> dict[str, Any]:
    time, sure = table["time_s"][rows], bool(dynamics["seen"][row])
    end = float(time[-1])
    frame = charts.Frame(
        charts.Axis(0, end, ((0.0, "0"), (end, short(end)))),
        y,
        width=size.width,
        height=size.height + 8,
        left=size.left + 2,
        above=6,
    )
    layers = [
        charts.ribbon(frame, time, table["low"][rows], table["high"][rows]),
        charts.level(frame, 0.0, "tk"),
        charts.line(frame, time, table["response"][rows], "line" if sure else "ref"),
    ]
    output, name = str(dynamics["output"][row]), str(dynamics["input"][row])
    gain, peak = (
        tuple(float(dynamics[f"{key}{side}"][row]) for side in ("", "_low", "_high"))
        for key in ("gain", "peak")
    )
    if not sure:
        alt = f"{output} after {name}: sign not known, {_span(peak)} °C per %"
        return {
            "head": name,
            "figure": _span(gain),
            "panel": charts.panel(frame, layers, alt=alt, css=size.css, units=("s", "°C")),
            "foot": "sign not known",
        }
    tau, delay = (f"{short(float(dynamics[key][row]), 2)}{THIN}s" for key in ("time_constant_s", "delay_s"))
    elsewhere = not 0.8 < gain[0] / peak[0] < 1.05
    figure = f"{number(peak[0], _places(peak))} ({_span(peak)})" + (
        f", then {number(gain[0], _places(gain))} ({_span(gain)})" if elsewhere else ""
    )
    alt = f"{output} after {name}: {figure} °C per %; time constant {tau}, delay {delay}"
    return {
        "head": name,
        "figure": figure,
        "panel": charts.panel(frame, layers, alt=alt, css=size.css, units=("s", "°C")),
        "foot": f"τ {tau}, delay {delay}",
    }


def _places(values: tuple[float, float, float]) -> int:
    value, low, high = values
    return decimals(low, high, value=value)


def _span(values: tuple[float, float, float]) -> str:
    return band(values[1], values[2], _places(values))


# ---- order and poles


@as_picture("order", "How many states the record asks for")
def order(sources: Sources) -> Picture:
    """Singular values and the error of each order."""
    table = need(sources.tables["order"])
    shown = [evidence.singular(table), evidence.left_out(table)]
    chosen = int(table["order"][table["chosen"]][0]) if table["chosen"].any() else 0
    given = sources.declared.everything.get("identify_plant", {}).get("order") or 0
    tried = np.isfinite(table["error"]).any()
    tolerance = entry(sources.metrics["identify_plant"], "order_tolerance_percent")
    near = "near the best" if tolerance is None else f"within {tolerance:g}{THIN}% of the best"
    if given:
        text = f"Order {chosen}, as identify_plant.order asks; the data were not asked."
    elif tried:
        text = f"Order {chosen}: the fewest free numbers whose error on what was left out is {near}."
    else:
        text = f"Order {chosen}: the record is noise-free, and its rank decides."
    edge = short(float(table["noise_edge"][0]), 3)
    caption = (
        f"The rule: orders whose singular value rises above what noise alone reaches, {edge}, are tried; "
        f"each is identified with {left_out_words(sources)} and simulated on it"
        f"{', and predicted one step ahead' if loop_state(sources)['closed'] else ''}. "
        f"Of those whose error is {near}, the one with the fewest free numbers wins. "
        "Window, feed-through, order and refinement were chosen together."
    )
    return Picture(text, shown, caption if tried else "", page.origin(sources.source("order")))


@as_picture("poles", "Poles, and how surely they are known")
def poles(sources: Sources) -> Picture:
    """Poles of the model with the spread's cloud: the whole circle, and where they crowd."""
    table = need(sources.tables["poles"])
    mine = table["member"] == 0
    others = np.flatnonzero(~mine)[:: max(1, -(-int((~mine).sum()) // MOST_DOTS))]
    of_mine, extra = others[table["pole"][others] >= 0], others[table["pole"][others] < 0]
    real, imag = table["real"], table["imag"]
    size = np.hypot(real[mine], imag[mine])
    slowest = float(size.max())
    shown = []
    for head, small, near in (
        ("The unit circle", "real part right, imaginary part up", False),
        ("Where they are", "enlarged, equal scales", True),
    ):
        frame = (
            _window(real, imag, mine)
            if near
            else charts.Frame(
                charts.linear(-1.1, 1.1, ticks=3),
                charts.linear(-1.1, 1.1, ticks=3),
                width=270,
                height=256,
                left=30,
                above=6,
            )
        )
        layers = (
            [charts.line(frame, *charts.CIRCLE, "lim line thin", most=charts.CIRCLE.shape[1])]
            if not near
            else [_arc(frame)]
        )
        layers += [
            charts.dots(frame, *charts.inside(frame, real[part], imag[part]), css, 1.7)
            for part, css in ((extra, "try pale"), (of_mine, "try"))
        ]
        layers.append(charts.crosses(frame, real[mine], imag[mine]))
        alt = (
            f"{head}: {int(mine.sum())} poles, the largest of size {number(slowest, 4)}, "
            f"{'inside' if slowest < 1 else 'on or outside'} the unit circle"
        )
        shown.append(PictureColumn(head, small, "", [charts.panel(frame, layers, alt=alt)]))
    plants = int(table["member"].max())
    text = (
        f"{count(int(mine.sum()), 'pole').capitalize()}, the largest of size {number(slowest, 4)}: "
        f"{'stable' if slowest < 1 else 'not stable'}."
    )
    caption = (
        f"Crosses: the model; dots: {count(plants, 'plant')} of the spread, each with one state more than "
        "the model, whose pole is pale."
    )
    bandwidth = lookup(sources.metrics["identify_plant"], "bandwidth_rad_s")
    if isinstance(bandwidth, float):
        caption += (
            f" Bandwidth by singular values: {short(bandwidth, 3)} rad/s, a time constant of "
            f"{short(1 / bandwidth, 3)} s."
        )
    return Picture(text, shown, caption, page.origin(sources.source("poles")))


def _window(real: np.ndarray, imag: np.ndarray, shown: np.ndarray) -> charts.Frame:
    """The model's poles, nearly all of those of the spread that belong to them, and one, at equal scales."""
    width, height, left = 420, 256, 46
    low, high = float(np.quantile(real[shown], 0.02)), max(float(np.quantile(real[shown], 0.98)), 1.0)
    wide, tall = width - left - 6, height - 22
    half = max(0.6 * (high - low), 1.2 * float(np.quantile(np.abs(imag[shown]), 0.98)) * wide / tall, 2e-3)
    middle, up = (low + high) / 2, half * tall / wide
    return charts.Frame(
        charts.linear(middle - half, middle + half, ticks=4),
        charts.linear(-up, up, ticks=3),
        width=width,
        height=height,
        left=left,
        above=6,
    )


def _arc(frame: charts.Frame) -> Markup:
    """The part of the unit circle that the frame shows, at the right."""
    reach = np.arcsin(min(frame.y.high, 1.0))
    angle = np.linspace(-reach, reach, 61)
    inside = (np.cos(angle) >= frame.x.low) & (np.cos(angle) <= frame.x.high)
    return charts.line(frame, np.cos(angle), np.where(inside, np.sin(angle), np.nan), "lim line thin")


@or_empty
def pole_table(sources: Sources) -> list[dict[str, str]]:
    """Each pole of the model, a pair in one row: size, time constant
    with its band over the spread, period."""
    table, step = need(sources.tables["poles"]), sources.declared.machine.sample_time_s
    rows = []
    for k in np.flatnonzero((table["member"] == 0) & (table["imag"] >= 0)):
        value = complex(table["real"][k], table["imag"][k])
        others = (table["pole"] == table["pole"][k]) & (table["member"] > 0)
        sizes = np.hypot(table["real"][others], table["imag"][others])
        constant = _constant(abs(value), step)
        low, high = (
            np.sort([_constant(size, step) for size in np.quantile(sizes, [0.05, 0.95])])
            if len(sizes)
            else (np.nan, np.nan)
        )
        again = low <= constant <= high
        rows.append(
            {
                "size": number(abs(value), 4),
                "pair": "pair" if value.imag else "",
                "constant": f"{short(constant, 3)}{THIN}s" if np.isfinite(constant) else "none",
                "band": ""
                if np.isnan(low + high)
                else f"{short(low, 3)}{DASH}{short(high, 3)}"
                if again
                else "not found again",
                "period": f"{short(2 * np.pi * step / abs(np.angle(value)), 3)}{THIN}s"
                if value.imag or value.real < 0
                else "",
            }
        )
    return rows


def _constant(size: float, step: float) -> float:
    """-Ts / ln |pole|."""
    return -step / np.log(size) if 0 < size < 1 else np.nan


# ---- excitation


@as_picture("excitation", "How well the record excites the machine")
def excitation(sources: Sources) -> Picture:
    """How strongly the record moved each input, by frequency."""
    table, excited = (
        need(sources.tables["levels"]),
        need_figure(sources.metrics["identify_plant"], "excitation"),
    )
    y, shown = charts.linear(0, 1.1 * float(table["level"].max()) or 1.0, ticks=3), []
    size = room(len(sources.declared.machine.inputs))
    for signal in sources.declared.machine.inputs:
        mine = table["input"] == signal.name
        edges, level = np.append(table["low_rad"][mine], table["high_rad"][mine][-1]), table["level"][mine]
        frame = charts.Frame(
            charts.Axis(0, float(np.pi), ((0.0, "0"), (float(np.pi), "π"))),
            y,
            width=size.width,
            height=size.height,
            left=size.left,
            above=8,
        )
        own: Mapping = excited["inputs"].get(signal.name, {})
        small = f"{short(own['level'], 2)}{THIN}%, rank {own['rank']} of {excited['lags']}" if own else ""
        alt = (
            f"{signal.name}: {small}; level {short(float(level.min()), 2)} to "
            f"{short(float(level.max()), 2)} % in {len(level)} bands"
        )
        shown.append(
            PictureColumn(
                signal.name,
                small,
                "",
                [
                    charts.panel(
                        frame,
                        [charts.line(frame, edges, np.append(level, level[-1]), steps=True)],
                        alt=alt,
                        css=size.css,
                    )
                ],
            )
        )
    condition = excited.get("condition")
    text = (
        f"Together the inputs move in {excited['rank']} of {excited['full']} directions over a window of "
        f"{excited['lags']} samples"
        + (
            "."
            if condition is None
            else f"; the strongest has {short(condition, 2)} times the power of the weakest."
        )
    )
    return Picture(
        text,
        shown,
        "R.m.s. level in per cent within eight equal bands of frequency, 0 to π rad a sample.",
        page.origin(sources.source("levels")),
    )
