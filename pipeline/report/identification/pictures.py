"""The figures of the identification page that show the model's errors: on the
hold-out, with themselves, and with the inputs."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from pipeline.report.identification.how_identified import MOST_INPUTS, left_out_words, loop_state
from pipeline.report.shared import charts, page
from pipeline.report.shared.pictures import Picture, PictureColumn, as_picture, as_table
from pipeline.report.shared.sources import Sources
from pipeline.verdict.digits import THIN, band, count, decimals, number, short
from pipeline.verdict.evidence import Table, entry, known, lookup, need, need_figure
from pipeline.verdict.identification import Fit, percent_of

# width and height in px of each of so many panels beside one another
SIZES = {4: (272, 120), 5: (213, 104), 6: (173, 92), 7: (152, 88)}


def across(panels: int) -> int:
    """How many panels stand beside one another: four at least, so that few do not grow into posters."""
    return min(max(panels, 4), MOST_INPUTS)


def small_frame(
    panels: int, x: charts.Axis, y: charts.Axis, above: int = 6, more: int = 0
) -> tuple[charts.Frame, str]:
    """The frame of one of so many panels, with `more` px on the left, and its class."""
    width, height = SIZES[across(panels)]
    wide = width > SIZES[6][0]
    left = (34 if wide else 28) + more
    frame = charts.Frame(x, y, width=width, height=height + 4 * more, left=left, above=above)
    return frame, "mb wide" if wide else "mb"


def as_matrix(id: str, title: str) -> Callable[[Callable[..., dict]], Callable[..., dict]]:
    """A decorator: a matrix of panels with its id and title; if it needs something that is absent, the
    reason."""
    empty = {"rows": [], "origin": Markup(""), "across": 0}
    named = {"id": id, "title": title, "finding": "", "caption": "", "columns": []}
    return lambda draw: lambda sources: named | as_table(**empty)(draw)(sources)


# ---- the hold-out


@as_picture("holdout", "Measured against simulated, on the part of the record that the model did not see")
def holdout(sources: Sources, fits: Sequence[Fit], ahead: str) -> Picture:
    """Every output of the hold-out: measured, simulated, and predicted so many steps ahead."""
    table = need(sources.tables["holdout"])
    shown, points = [], max(60, 240 * 10 // max(len(fits), 10))
    for fit in fits:
        parts = [("simulated", fit.simulated), (ahead, fit.ahead)]
        small = ", ".join(f"{name} {percent_of(part)}" for name, part in parts)
        shown.append(
            PictureColumn(fit.name, f"fit: {small}", "", _stretch(sources, table, fit.name, small, points))
        )
    segments = len(np.unique(table["segment"]))
    masked = sum(int((~np.isfinite(table[f"{fit.name}_measured"])).sum()) for fit in fits)
    text = (
        f"{number(len(table['time_s']), 0)} samples in {count(segments, 'stretch', 'stretches')}, "
        "the last part of each; "
        + (
            f"{count(masked, 'measured value is', 'measured values are')} masked and not scored."
            if masked
            else "none of them masked."
        )
        + f" Simulated: the model runs from the inputs alone. {ahead[:1].upper()}{ahead[1:]}: it also "
        "knows the outputs until then."
    )
    caption = (
        "Above, °C against time in s, stretches one after the other: grey measured, ink simulated. "
        f"Below, measured less predicted: ink simulated, grey {ahead}. Vermillion: masked. Upright lines: "
        "where a stretch ends."
    )
    return Picture(text, shown, caption, page.origin(sources.source("holdout")))


def _stretch(sources: Sources, table: Table, name: str, small: str, points: int) -> list[Markup]:
    step = sources.declared.machine.sample_time_s
    time = step * np.arange(len(table["segment"]))
    measured, simulated, ahead = (table[f"{name}_{kind}"] for kind in ("measured", "simulated", "ahead"))
    values = np.concatenate([measured, simulated])
    values = values[np.isfinite(values)]
    y = (
        charts.linear(float(values.min()), float(values.max()), ticks=3)
        if len(values)
        else charts.linear(0, 1)
    )
    x = charts.linear(0, float(time[-1]) or 1.0, ticks=6)
    above = charts.Frame(x, y, width=568, height=160, left=40, below=4, above=24)
    error = [measured - simulated, measured - ahead]
    reach = 1.05 * float(np.nanmax(np.abs(error[0]), initial=0.0)) or 1.0
    below = charts.Frame(x, charts.balanced(reach), width=568, height=130, left=40)
    ends = np.flatnonzero(np.diff(table["segment"])) + 1
    masked = charts.stretches(~np.isfinite(measured))

    def drawn(frame: charts.Frame, lines: Sequence[tuple[np.ndarray, str]]) -> list[Markup]:
        marks = [charts.interval(frame, float(time[a]), float(time[b - 1]), "gone") for a, b in masked[:200]]
        marks += [charts.interval(frame, float(time[at]), float(time[at]), "end") for at in ends[:100]]
        # a line breaks where one stretch ends and another begins
        return marks + [
            charts.line(
                frame, np.insert(time, ends, time[ends]), np.insert(v, ends, np.nan), css, most=points
            )
            for v, css in lines
        ]

    size, late = (
        float(np.sqrt(np.nanmean(part**2))) if np.isfinite(part).any() else np.nan for part in error
    )
    alt_of_error = f"{name}: error of simulation {short(size, 2)} °C r.m.s., ahead " + (
        f"{short(late, 2)} °C" if np.isfinite(late) else "not measured"
    )
    return [
        charts.panel(
            above,
            drawn(above, [(measured, "line seen"), (simulated, "line thin")]),
            alt=f"{name} on the hold-out: fit {small}; "
            f"{count(int((~np.isfinite(measured)).sum()), 'sample')} masked",
            css="mb wide",
            title="°C",
            x_ticks=False,
            units=("s", "°C"),
        ),
        charts.panel(
            below,
            drawn(below, [(error[1], "line seen"), (error[0], "line thin")]),
            alt=alt_of_error,
            css="mb wide",
            title="error, °C",
            units=("s", "°C"),
        ),
    ]


# ---- residuals


@as_picture("white", "What the model leaves over: is it noise?")
def whiteness(sources: Sources) -> Picture:
    """Autocorrelation of the one-step errors of each output, with its 99 % band."""
    table = need(sources.tables["residuals"])
    names = [output.name for output in sources.declared.machine.outputs]
    mine = {
        name: (table["output"] == name) & (table["against"] == name) & (table["lag"] > 0) for name in names
    }
    y = _correlations(table, np.any(list(mine.values()), axis=0))
    shown = []
    for name in names:
        passed = bool(table["passed"][mine[name]].all())
        panel = _stems(table, mine[name], y, len(names), f"{name}, errors with themselves")
        shown.append(PictureColumn(name, "passed: noise" if passed else "failed: not noise", "", [panel]))
    bad = [name for name in names if not table["passed"][mine[name]].all()]
    text = (
        "Yes: the one-step errors of every output are noise, by Ljung and Box’s test at 99 %."
        if not bad
        else f"Not for {', '.join(bad)}: the next error can be told in part from the ones before, so the "
        "observer could do better."
    )
    caption = (
        "Autocorrelation of the one-step errors on the hold-out against lag in samples. Grey: the "
        f"99{THIN}% band; one lag in a hundred may leave it by chance. Vermillion: lags outside where the "
        "test failed."
    )
    return Picture(text, shown, caption, page.origin(sources.source("residuals")))


@as_matrix("followed", "Do the errors still follow an input?")
def cross(sources: Sources) -> dict[str, Any]:
    """Correlation of each output's one-step errors with each input."""
    table = need(sources.tables["residuals"])
    other, panels = table["against"] != table["output"], len(sources.declared.machine.inputs)
    y = _correlations(table, other)
    strength = np.nan_to_num(np.abs(table["correlation"]) / np.maximum(table["band"], 1e-300))

    def cell(output: str, name: str) -> tuple[float, Callable[[], dict[str, Any]]]:
        mine = other & (table["output"] == output) & (table["against"] == name)
        passed = bool(table["passed"][mine].all())

        def draw() -> dict[str, Any]:
            return {
                "head": name,
                "figure": "" if passed else "failed",
                "panel": _stems(table, mine, y, panels, f"{output} after {name}"),
                "foot": "",
            }

        return float(strength[mine & (table["lag"] >= 0)].max(initial=0)), draw

    rows, more = matrix(sources, cell)
    feedback = lookup(sources.metrics["identify_plant"], "closed_loop.closed") is True
    closed = "at zero a controller answers too, and the test begins at one; " if feedback else ""
    failed = sorted(
        {
            (str(o), str(a))
            for o, a in zip(
                table["output"][other & ~table["passed"]],
                table["against"][other & ~table["passed"]],
                strict=True,
            )
        }
    )
    pairs = ", ".join(f"{output} after {name}" for output, name in failed[:6]) + (
        f" and {len(failed) - 6} more" if len(failed) > 6 else ""
    )
    text = (
        f"Yes: {pairs}. There the model misses something that an input does."
        if failed
        else "No: what the inputs do, the model explains."
    )
    return {
        "finding": text,
        "rows": rows,
        "caption": f"Correlation of the one-step errors with the input, lag in samples; {closed}"
        f"right of zero the input came first. Grey: the 99{THIN}% band of a single lag; "
        "the test widens it for the number of lags. Left of zero, pale: feedback from errors to inputs, "
        f"no fault of the model.{more}",
        "origin": page.origin(sources.source("residuals")),
        "across": across(panels),
    }


def _correlations(table: Table, rows: np.ndarray) -> charts.Axis:
    """One scale for all panels: the largest correlation, or three bands."""
    largest = np.nan_to_num(np.abs(table["correlation"][rows])).max(initial=0.0)
    reach = min(max(1.1 * float(largest), 2.0 * float(table["band"][rows].max(initial=0.0)), 1e-3), 1.0)
    return charts.balanced(reach)


def _stems(table: Table, rows: np.ndarray, y: charts.Axis, panels: int, name: str) -> Markup:
    lag, value, limit = table["lag"][rows], table["correlation"][rows], float(table["band"][rows][0])
    ends = dict.fromkeys((float(lag.min()), float(max(lag.min(), 0)), float(lag.max())))
    x = charts.Axis(float(lag.min()) - 1, float(lag.max()) + 1, tuple((k, number(k, 0)) for k in ends))
    frame, css = small_frame(panels, x, y)
    # a lag outside of the band is marked only where the test over all
    # lags failed: one in a hundred leaves it by chance
    outside, judged = np.abs(np.nan_to_num(value)) > limit, lag >= 0
    marked = outside & ~table["passed"][rows]
    layers = [charts.tint(frame, -limit, limit), charts.level(frame, 0.0, "tk")]
    layers += [
        charts.stems(frame, lag[part], value[part], stem)
        for part, stem in ((judged & ~marked, "stem"), (judged & marked, "stem bad"), (~judged, "stem pale"))
    ]
    worst = int(np.abs(np.nan_to_num(np.where(judged, value, 0.0))).argmax())
    return charts.panel(
        frame,
        layers,
        alt=f"{name}: {int((outside & judged).sum())} of {int(judged.sum())} lags outside of "
        f"±{number(limit, 2)}, most {number(float(np.nan_to_num(value[worst])), 2)} at lag "
        f"{int(lag[worst])}",
        css=css,
        units=("samples", ""),
    )


def matrix(
    sources: Sources, cell: Callable[[str, str], tuple[float, Callable[[], dict[str, Any]]]]
) -> tuple[list[dict[str, Any]], str]:
    """Rows of cells; where the machine has many inputs, of each output the strongest ones, in their order."""
    machine = sources.declared.machine
    rows = []
    for output in machine.outputs:
        cells = [cell(output.name, i.name) for i in machine.inputs]
        largest = sorted(sorted(range(len(cells)), key=lambda k: -cells[k][0])[:MOST_INPUTS])
        rows.append({"output": output.name, "cells": [cells[k][1]() for k in largest]})
    left = len(machine.inputs) - MOST_INPUTS
    return (
        rows,
        f" Of {len(machine.inputs)} inputs the {MOST_INPUTS} strongest of each output are shown."
        if left > 0
        else "",
    )


# ---- step responses


@as_matrix("steps", "What each input does: step responses")
def steps(sources: Sources) -> dict[str, Any]:
    """Response of each output to a step of each input, with the
    spread's band, and gain, time constant and delay."""
    table, dynamics = need(sources.tables["steps"]), need(sources.tables["dynamics"])
    panels = len(sources.declared.machine.inputs)
    scales = {o.name: _reach(table, table["output"] == o.name) for o in sources.declared.machine.outputs}

    def cell(output: str, name: str) -> tuple[float, Callable[[], dict[str, Any]]]:
        mine = (table["output"] == output) & (table["input"] == name)
        row = int(np.flatnonzero((dynamics["output"] == output) & (dynamics["input"] == name))[0])
        strength = float(np.abs(table["response"][mine]).max())
        return strength, lambda: _response(table, mine, dynamics, row, scales[output], panels)

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
    return {
        "finding": text,
        "rows": rows,
        "caption": f"Answer in °C to one per cent of the input, over {short(end)}{THIN}s from rest; "
        f"the panels of an output share one scale. Band: 90{THIN}% of {plants}, "
        "wider where fits without one quarter of the record differ more, "
        f"cut where it leaves the panel. τ: 1.5 times the way from 28.3 to 63.2{THIN}% of the largest "
        f"excursion; delay: what is left of the time to 63.2{THIN}%.{more}",
        "origin": page.origin(sources.source("steps", "dynamics"), y="response"),
        "across": across(panels),
    }


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
    table: Table, rows: np.ndarray, dynamics: Table, row: int, y: charts.Axis, panels: int
) -> dict[str, Any]:
    time, sure = table["time_s"][rows], bool(dynamics["seen"][row])
    end = float(time[-1])
    frame, css = small_frame(panels, charts.Axis(0, end, ((0.0, "0"), (end, short(end)))), y, more=2)
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
    if sure:
        tau, delay = (
            f"{short(float(dynamics[key][row]), 2)}{THIN}s" for key in ("time_constant_s", "delay_s")
        )
        elsewhere = not 0.8 < gain[0] / peak[0] < 1.05
        figure = f"{number(peak[0], _places(peak))} ({_span(peak)})" + (
            f", then {number(gain[0], _places(gain))} ({_span(gain)})" if elsewhere else ""
        )
        foot, told = f"τ {tau}, delay {delay}", f"{figure} °C per %; time constant {tau}, delay {delay}"
    else:
        figure, foot, told = _span(gain), "sign not known", f"sign not known, {_span(peak)} °C per %"
    alt = f"{output} after {name}: {told}"
    return {
        "head": name,
        "figure": figure,
        "panel": charts.panel(frame, layers, alt=alt, css=css, units=("s", "°C")),
        "foot": foot,
    }


def _places(values: Sequence[float]) -> int:
    value, low, high = values
    return decimals(low, high, value=value)


def _span(values: Sequence[float]) -> str:
    return band(values[1], values[2], _places(values))


# ---- order and poles


@as_matrix("order", "How many states the record asks for")
def order(sources: Sources) -> dict[str, Any]:
    """The orders with the rule that chose one: what each keeps, costs and leaves unexplained."""
    table = pd.DataFrame(need(sources.tables["order"]))
    tried = table.error.notna()
    chosen = int(table.order[table.chosen].max()) if table.chosen.any() else 0
    last = max(chosen + 3, int(table.order[tried].max()) if tried.any() else 0)
    table["tried"], table["above"] = tried, (table.error / table.error.min() - 1).fillna(0.0)
    return {
        "rows": table[table.order <= last].to_dict("records"),
        "chosen": chosen,
        "given": sources.declared.everything.get("identify_plant", {}).get("order"),
        "tried": bool(tried.any()),
        "tolerance": entry(sources.metrics["identify_plant"], "order_tolerance_percent"),
        "edge": float(table.noise_edge[0]),
        "left_out": left_out_words(sources),
        "closed": loop_state(sources)["closed"],
        "origin": page.origin(sources.source("order")),
    }


@as_matrix("poles", "Poles, and how surely they are known")
def poles(sources: Sources) -> dict[str, Any]:
    """Each pole of the model, a pair in one row: size, time constant with its 90 % band over the spread, and
    period in s; how many poles and plants there are, the largest size, the bandwidth, and what the sensors
    see of the states."""
    table, step = pd.DataFrame(need(sources.tables["poles"])), sources.declared.machine.sample_time_s
    table["size"] = np.hypot(table["real"], table["imag"])
    table["constant_s"] = [_constant(size, step) for size in table["size"]]
    sizes = table[table.member > 0].groupby("pole")["size"]
    ends = {pole: [_constant(end, step) for end in mine.quantile([0.05, 0.95])] for pole, mine in sizes}
    model = table[table.member == 0]
    rows = model[model["imag"] >= 0].to_dict("records")
    for row in rows:
        row["band"] = ends.get(row["pole"], [math.nan, math.nan])
        row["period_s"] = 2 * math.pi * step / max(abs(math.atan2(row["imag"], row["real"])), 1e-300)
    return {
        "rows": rows,
        "of": len(model),
        "largest": float(model["size"].max()),
        "plants": int(table.member.max()),
        "bandwidth": entry(sources.metrics["identify_plant"], "bandwidth_rad_s"),
        "record_s": step * (entry(sources.metrics["ingest"], "samples") or math.inf),
        "seen": states_seen(known(sources.tables["plant"], None)),
        "origin": page.origin(sources.source("poles")),
    }


def states_seen(plant: Table | None) -> dict[str, int] | None:
    """The rank of the observability matrix [C; CA; ...] of a plant stored as A (1, n, n) and C (1, p, n), n,
    and the samples in a row that reach that rank."""
    if plant is None:
        return None
    A, C = (np.asarray(plant[name], float)[0] for name in "AC")
    matrix = np.vstack([C @ np.linalg.matrix_power(A, i) for i in range(len(A))])
    ranks = [int(np.linalg.matrix_rank(matrix[: len(C) * blocks])) for blocks in range(1, len(A) + 1)]
    return {"rank": ranks[-1], "of": len(A), "samples": ranks.index(ranks[-1]) + 1}


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
    band_axis = charts.Axis(0, float(np.pi), ((0.0, "0"), (float(np.pi), "π")))
    frame, css = small_frame(len(sources.declared.machine.inputs), band_axis, y, above=8)
    for signal in sources.declared.machine.inputs:
        mine = table["input"] == signal.name
        edges, level = np.append(table["low_rad"][mine], table["high_rad"][mine][-1]), table["level"][mine]
        own: Mapping = excited["inputs"].get(signal.name, {})
        small = f"{short(own['level'], 2)}{THIN}%, rank {own['rank']} of {excited['lags']}" if own else ""
        shown.append(
            PictureColumn(
                signal.name,
                small,
                "",
                [
                    charts.panel(
                        frame,
                        [charts.line(frame, edges, np.append(level, level[-1]), steps=True)],
                        alt=f"{signal.name}: {small}; level {short(float(level.min()), 2)} to "
                        f"{short(float(level.max()), 2)} % in {len(level)} bands",
                        css=css,
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
