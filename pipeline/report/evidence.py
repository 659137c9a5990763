"""The figures of the temperature page that show what the learning rests on: orders, optimiser, excitation, and the record with its flaws."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from markupsafe import Markup

from pipeline.report import charts, page
from pipeline.report.digits import THIN, count, number, percent, short
from pipeline.report.pictures import Column, Picture, hole
from pipeline.report.sources import Sources, Table, lookup
from pipeline.report.verdict import Missing

QUALITY, RECORD = "datasets/ingest/quality.parquet", "datasets/ingest/record.parquet"
WINDOW, KERNEL, PLANT, HISTORY = (
    "datasets/learn_kernel/window.parquet", "datasets/learn_kernel/kernel.parquet", "datasets/identify_plant/plant.parquet", "datasets/tune_weights/history.parquet",
)  # fmt: skip


def orders(sources: Sources) -> Picture:
    """How long a window, how many states: Akaike's criterion, the kernel's singular values, the identified poles."""
    shown = [_criterion(sources), _singular(sources), _poles(sources)]
    model = sources.metrics["identify_plant"]
    parts = [
        (f"window of {lookup(sources.metrics['learn_kernel'], 'window')} samples", lookup(sources.metrics["learn_kernel"], "window")),
        (f"kernel on the {lookup(sources.metrics['learn_kernel'], 'state')}", lookup(sources.metrics["learn_kernel"], "state")),
        (f"model of order {lookup(model, 'order')}", lookup(model, "order")),
    ]
    said = ", ".join(text for text, value in parts if not isinstance(value, Missing))
    return Picture("orders", "How much memory the data ask for", f"Chosen from the record alone: {said or 'nothing'}.", shown, "", page.origin(sources.source(WINDOW, KERNEL, PLANT)))


def _holed(head: str, small: str, missing: Missing, mark: str = "") -> Column:
    return Column(head, small, mark, [Markup('<div class="hole">{}</div>').format(page.missing(missing))])


def _criterion(sources: Sources) -> Column:
    head, small = "Length of the window", "Akaike’s criterion, above its least value; log"
    window = sources.tables["window"]
    if isinstance(window, Missing):
        return _holed(head, small, window, "window")
    table = window["table"]
    above = table[:, 2] - table[:, 2].min() + 1
    chosen = float(table[above.argmin(), 0])
    frame = charts.Frame(charts.linear(0, float(table[-1, 0])), charts.logarithmic(1, float(above.max())), width=360, height=170, left=44)
    layers = [charts.line(frame, table[:, 0], above), charts.dots(frame, table[:, 0], above, "dot dd"), charts.label(frame, chosen, 1, f"{chosen:g} samples", anchor="end", dx=-6, dy=-6)]
    alt = f"Akaike’s criterion is least at a window of {chosen:g} samples, {'the longest tried' if chosen == table[-1, 0] else f'of up to {table[-1, 0]:g} tried'}"
    return Column(head, small, "window", [charts.panel(frame, layers, alt=alt, css="dd", title="criterion + 1 − least")])


def _singular(sources: Sources) -> Column:
    head, small = "State of the kernel", "singular values of the record, r.m.s.; log"
    kernel = sources.tables["kernel"]
    if isinstance(kernel, Missing):
        refused = lookup(sources.metrics["learn_kernel"], "refused")
        return _holed(head, small, kernel if isinstance(refused, Missing) else Missing("failed", str(refused)), "kernel")
    values = kernel["singular_values"]
    values = values[values > 0]
    index = np.arange(1, len(values) + 1)
    kept = int(kernel["rank"]) - len(kernel["u_scale"])
    frame = charts.Frame(charts.linear(0, len(values) + 1, ticks=min(len(values) + 1, 6)), charts.logarithmic(float(values.min()), float(values.max())), width=360, height=170, left=44)
    layers = [charts.dots(frame, index[:kept], values[:kept], "dot dd", 3.2), charts.dots(frame, index[kept:], values[kept:], "try", 3.2)]
    alt = f"{len(values)} singular values from {short(float(values.max()))} down to {short(float(values.min()))}; {kept} directions are kept"
    return Column(head, f"{small}; {kept} kept", "kernel", [charts.panel(frame, layers, alt=alt, css="dd")])


def _poles(sources: Sources) -> Column:
    head, small = "Poles of the identified model", "real part against imaginary part; line: unit circle"
    plant = sources.tables["plant"]
    if isinstance(plant, Missing):
        return _holed(head, small, plant, "model_based")
    poles = np.linalg.eigvals(plant["A"][0])
    largest = float(np.abs(poles).max())
    # the poles of a barrel crowd at one: the picture shows where they are, at equal scales
    left, height = float(min(poles.real.min(), 0.9)), 0.5 * (1.02 - min(poles.real.min(), 0.9)) * (170 - 30) / (360 - 50)
    reach = max(height, 1.1 * float(np.abs(poles.imag).max()))
    frame = charts.Frame(charts.linear(left - 0.01, 1.02), charts.linear(-reach, reach), width=360, height=170, left=44)
    angle = np.linspace(-np.arcsin(min(reach, 1)), np.arcsin(min(reach, 1)), 60)
    layers = [charts.line(frame, np.cos(angle), np.sin(angle), "lim line thin"), charts.dots(frame, poles.real, poles.imag, "dot", 3.2)]
    alt = f"{len(poles)} poles, the largest of size {number(largest, 4)}, {'inside' if largest < 1 else 'on or outside'} the unit circle"
    return Column(head, small, "model_based", [charts.panel(frame, layers, alt=alt, css="mb")])


# ---- the optimiser


def tuning(sources: Sources) -> Picture:
    """The best cost so far in both modes, each beside its yardstick."""
    table, found, title = sources.tables["tuning"], sources.metrics["tune_weights"], "The optimiser’s progress"
    if isinstance(table, Missing):
        return hole("tuning", title, table)
    best, optimum = lookup(found, "parity.best_cost_perfect_state"), lookup(found, "parity.optimum")
    cost, identity = lookup(found, "practical.cost"), lookup(found, "practical.cost_identity")
    shown = [
        _progress(table, "parity", "The study’s objective", "excess over the optimum in %, log", optimum, excess=True),
        _progress(table, "practical", "The declared engineering cost", "cost, beside equal weights", identity, excess=False),
    ]
    said = []
    if not isinstance(best, Missing) and not isinstance(optimum, Missing):
        said.append(f"On the study’s objective the search ends {percent(100 * (best / optimum - 1), 2)} above the optimum, {number(optimum, 0)}, which is Q = R = I itself.")
    if not isinstance(cost, Missing) and not isinstance(identity, Missing):
        said.append(f"On the engineering cost it gains {percent(100 * (1 - cost / identity), 2)} over equal weights, on the training half of the panel.")
    return Picture("tuning", title, " ".join(said), shown, "Dots: candidates; line: best so far. Crosses at the foot: candidates that failed.", page.origin(sources.source(HISTORY)))


def _progress(table: Table, mode: str, head: str, small: str, level: Any, *, excess: bool) -> Column:
    rows = table["mode"] == mode
    if not rows.any() or isinstance(level, Missing):
        return _holed(head, small, level if isinstance(level, Missing) else Missing("not measured", f"no {mode} search was recorded"))
    at, cost, best = (table[name][rows].astype(float) for name in ("evaluation", "cost", "incumbent"))
    if excess:
        cost, best = (100 * (values / level - 1) for values in (cost, best))
        y = charts.logarithmic(max(float(np.nanmin(np.maximum(best, 1e-6))), 1e-6), float(np.nanmax(cost)))
    else:
        y = charts.linear(0.98 * min(float(np.nanmin(best)), level), min(float(np.nanmax(cost)), 2 * level))
    frame = charts.Frame(charts.linear(0, float(at[-1])), y, width=540, height=190, left=44)
    failed = at[np.isnan(cost)]
    layers = [charts.dots(frame, at, cost, "try", 1.8), charts.line(frame, at, best, "line"), charts.dots(frame, failed, np.full(len(failed), y.low), "gone", 2)]
    if not excess:
        layers.append(charts.level(frame, level, "ref", f"equal weights {short(level)}"))
    end = float(best[-1])
    layers.append(charts.label(frame, float(at[-1]), end, f"{percent(end, 2)} above" if excess else short(end), anchor="end", dy=-7))
    alt = f"{head}: after {count(len(at), 'evaluation')} " + (f"the best is {percent(end, 2)} above the optimum" if excess else f"the best costs {short(end)}, equal weights {short(level)}")
    return Column(head, small, "", [charts.panel(frame, layers, alt=alt, css="mb")])


# ---- the record


def excitation(sources: Sources) -> Picture:
    """How strongly each input was moved, by frequency."""
    found, title = sources.metrics["generate_probing"], "What the probing excites"
    levels = lookup(found, "level_percent_per_band")
    if isinstance(levels, Missing):
        return hole("excitation", title, levels)
    levels, machine = np.array(levels), sources.declared.machine
    y = charts.linear(0, 1.1 * float(levels.max()), ticks=3)
    names = [signal.name for signal in machine.inputs] if levels.shape[1] == len(machine.inputs) else [f"input {i + 1}" for i in range(levels.shape[1])]
    shown = []
    for i, name in enumerate(names):
        edges = np.linspace(0, 1, len(levels) + 1)
        frame = charts.Frame(charts.Axis(0, 1, ((0, "0"), (1, "π"))), y, width=150, height=96, left=24)
        layer = charts.line(frame, edges, np.append(levels[:, i], levels[-1, i]), steps=True)
        alt = f"{name}: level {number(float(levels[:, i].min()), 2)} to {number(float(levels[:, i].max()), 2)} % in eight bands from 0 to π rad a step"
        shown.append(Column(name, "", "", [charts.panel(frame, [layer], alt=alt, title="%" if i == 0 else "")]))
    rank, full, order = (lookup(found, f"excitation_{key}") for key in ("rank", "full_rank", "order"))
    condition, limited = lookup(found, "excitation_condition"), lookup(found, "limited_share")
    text = f"Exciting of order {order}: rank {rank} of {full}" + ("." if isinstance(condition, Missing) else f", condition {short(condition)}.")
    text += "" if isinstance(limited, Missing) else f" {number(100 * limited, 0)}{THIN}% of all commands met a limit of amplitude, rate or machine; what was applied is what is recorded."
    return Picture("excitation", title, text, shown, "R.m.s. level in per cent within equal bands of frequency, 0 to π rad a step.", page.origin(sources.source("reports/metrics/generate_probing.json")))


def record(sources: Sources) -> Picture:
    """Every signal of the record, what is masked and what was found strange."""
    table, quality, title = sources.tables["record"], sources.tables["quality"], "The record, with what was flagged and masked"
    if isinstance(table, Missing):
        return hole("record", title, table)
    machine, time = sources.declared.machine, _elapsed(table, sources.declared.machine.sample_time_s)
    masked_total = 0
    halves: list[list[Markup]] = [[], []]
    for half, signals in enumerate((machine.inputs, machine.outputs)):
        for i, signal in enumerate(signals):
            values, masked = table[signal.name], table[f"{signal.name}_masked"]
            masked_total += int(masked.sum())
            halves[half].append(_signal(signal, time, values, masked, quality, last=i == len(signals) - 1))
    recordings = count(len(np.unique(table["recording"])), "recording")
    text = f"{number(len(time), 0)} samples of {recordings}; {count(masked_total, 'value is', 'values are')} masked and not used. {_found(sources.metrics['ingest'])}"
    heads = (("Inputs", f"{machine.inputs[0].unit}, as applied"), ("Outputs", "°C, as measured"))
    shown = [Column(head, small, "", panels) for (head, small), panels in zip(heads, halves, strict=True)]
    return Picture("record", title, text, shown, "Against time in s, recordings one after the other; at most 480 points a signal, highest and lowest of each stretch kept. Grey: flagged; vermillion: masked.", page.origin(sources.source(RECORD, QUALITY)))


def _found(metrics: Any) -> str:
    quarantined = lookup(metrics, "quarantined")
    if isinstance(quarantined, Missing):
        return ""
    return "No recording is quarantined." if quarantined == 0 else f"{count(quarantined, 'recording is', 'recordings are').capitalize()} quarantined: see the findings."


def _elapsed(table: Table, step: float) -> np.ndarray:
    return step * np.arange(len(table["time_s"]))


def _signal(signal, time: np.ndarray, values: np.ndarray, masked: np.ndarray, quality: Table | Missing, *, last: bool) -> Markup:
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    frame = charts.Frame(charts.linear(0, float(time[-1]) or 1.0), charts.linear(low, high, ticks=2), width=540, height=70 if last else 56, left=44, below=16 if last else 4, above=13)
    layers = [charts.line(frame, time, np.where(masked, np.nan, values), "line thin")]
    stretches = _stretches(masked)
    layers += [charts.interval(frame, float(time[a]), float(time[b - 1]), "gone") for a, b in stretches[:200]]
    mine = [] if isinstance(quality, Missing) else np.flatnonzero(quality["signal"] == signal.name)
    # a flag that spans the record says where it is in words, not in grey over everything
    short_ones = [i for i in mine if quality["end_s"][i] - quality["start_s"][i] < 0.5 * float(time[-1])]
    layers = [charts.interval(frame, float(quality["start_s"][i]), float(quality["end_s"][i])) for i in short_ones[:100]] + layers
    flags = ", ".join(sorted({str(quality["kind"][i]) for i in mine}))
    alt = f"{signal.name}: {short(low)} to {short(high)} {'°C' if signal.unit == 'degC' else signal.unit}, {count(int(masked.sum()), 'sample')} masked" + (f"; flagged {flags}" if flags else "")
    return charts.panel(frame, layers, alt=alt, css="mb", title=signal.name + (f": {flags}" if flags else ""), x_ticks=last)


def _stretches(mask: np.ndarray) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def findings(sources: Sources, most: int = 40) -> tuple[list[Mapping[str, str]], int, Missing | None]:
    """The quality findings as rows, quarantined recordings first, and how many more there are."""
    table = sources.tables["quality"]
    if isinstance(table, Missing):
        return [], 0, table
    order = sorted(range(len(table["kind"])), key=lambda i: (table["kind"][i] != "quarantined", str(table["recording"][i]), str(table["signal"][i]), str(table["kind"][i]), float(np.nan_to_num(table["start_s"][i]))))
    rows = [
        {
            "recording": str(table["recording"][i]), "signal": str(table["signal"][i]) or "whole recording", "kind": str(table["kind"][i]),
            "place": "" if np.isnan(table["start_s"][i]) else f"{short(float(table['start_s'][i]), 5)} to {short(float(table['end_s'][i]), 5)}{THIN}s",
            "count": number(float(table["count"][i]), 0), "message": str(table["message"][i]), "bad": table["kind"][i] == "quarantined",
        }
        for i in order[:most]
    ]  # fmt: skip
    return rows, max(len(order) - most, 0), None
