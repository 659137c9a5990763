"""The figures of the temperature page that show the data: what was excited, the record
signal by signal, and what was found strange in it."""

from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from pipeline.report.shared import charts, page
from pipeline.report.shared.pictures import Picture, PictureColumn, as_picture, as_table
from pipeline.report.shared.sources import Sources
from pipeline.temperature.tables import set_point_of
from pipeline.verdict.digits import THIN, count, number, short
from pipeline.verdict.evidence import Absent, Table, entry, known, lookup, need, need_figure, or_nothing
from pipeline.verdict.verdict import UNJUDGED, Missing


def excitation(sources: Sources) -> Picture:
    """How strongly each input was moved, by frequency."""
    title = "What the next experiment would excite" if sources.recorded else "What the probing excites"
    return as_picture("excitation", title)(_excitation)(sources)


def _excitation(sources: Sources) -> Picture:
    stage = "generate_probing" if sources.recorded else "probe_machine"
    metrics = (
        lookup(sources.metrics[stage], "next_experiment") if sources.recorded else sources.metrics[stage]
    )
    if sources.recorded and entry(metrics, "written") is False:
        raise Absent(Missing(UNJUDGED, f"Not written: {metrics['reason']}"))
    levels, machine = np.array(need_figure(metrics, "level_percent_per_band")), sources.declared.machine
    y = charts.linear(0, 1.1 * float(levels.max()), ticks=3)
    names = (
        [signal.name for signal in machine.inputs]
        if levels.shape[1] == len(machine.inputs)
        else [f"input {i + 1}" for i in range(levels.shape[1])]
    )
    shown = []
    for i, name in enumerate(names):
        edges = np.linspace(0, 1, len(levels) + 1)
        frame = charts.Frame(charts.Axis(0, 1, ((0, "0"), (1, "π"))), y, width=150, height=96, left=24)
        layer = charts.line(frame, edges, np.append(levels[:, i], levels[-1, i]), steps=True)
        alt = (
            f"{name}: level {number(float(levels[:, i].min()), 2)} to "
            f"{number(float(levels[:, i].max()), 2)} % "
            "in eight bands from 0 to π rad a step"
        )
        shown.append(
            PictureColumn(
                name,
                "",
                "",
                [charts.panel(frame, [layer], alt=alt, title="%" if i == 0 else "", units=("of π", "%"))],
            )
        )
    rank, full, order = (lookup(metrics, f"excitation_{key}") for key in ("rank", "full_rank", "order"))
    condition, limited = entry(metrics, "excitation_condition"), entry(metrics, "limited_share")
    text = f"Exciting of order {order}: rank {rank} of {full}" + (
        "." if condition is None else f", condition {short(condition)}."
    )
    if limited is not None:
        text += (
            f" {number(100 * limited, 0)}{THIN}% of all commands met a limit of amplitude, rate or machine"
        )
        text += "." if sources.recorded else "; what was applied is what is recorded."
    if sources.recorded:
        text = f"The experiment that is designed to be run next, not what was recorded. {text}"
    return Picture(
        text,
        shown,
        "R.m.s. level in per cent within equal bands of frequency, 0 to π rad a step.",
        page.origin(sources.source(stage)),
    )


LINES = 8  # that a link into the viewer opens at most
NO_FLAGS: Table = dict.fromkeys(("signal", "start_s", "end_s", "kind"), np.empty(0, object))


@as_picture("record", "The record, with what was flagged and masked")
def record(sources: Sources) -> Picture:
    """Every signal of the record, what is masked and what was found strange."""
    table, quality = need(sources.tables["record"]), known(sources.tables["quality"], NO_FLAGS)
    machine, time = sources.declared.machine, _elapsed(table, sources.declared.machine.sample_time_s)
    set_points = known(sources.tables["set_points"], {})
    masked_total = 0
    halves: list[list[Markup]] = [[], []]
    for half, signals in enumerate((machine.inputs, machine.outputs)):
        for i, signal in enumerate(signals):
            values, masked = table[signal.name], table[f"{signal.name}_masked"]
            masked_total += int(masked.sum())
            set_point = set_points.get(set_point_of(signal.name))
            last = i == len(signals) - 1
            halves[half].append(_signal(signal, time, values, masked, quality, set_point, last=last))
    recordings = count(len(np.unique(table["recording"])), "recording")
    masks = (
        f"{count(masked_total, 'value is', 'values are')} masked and not used"
        if masked_total
        else "nothing is masked"
    )
    text = (
        f"{number(len(time), 0)} samples of {recordings}; {masks}. {_quarantined(sources.metrics['ingest'])}"
    )
    heads = (("Inputs", f"{machine.inputs[0].unit}, as applied"), ("Outputs", "°C, as measured"))
    shown = [
        PictureColumn(head, small, "", panels) for (head, small), panels in zip(heads, halves, strict=True)
    ]
    return Picture(
        text,
        shown,
        (
            "Against time in s, recordings one after the other; at most 480 points a signal, highest and "
            "lowest of each stretch kept. Grey: flagged; vermillion, without a line: masked."
            + (" Dashed: what the output was to be." if set_points else "")
        ),
        page.origin(
            sources.source("record", "quality"), y=[output.name for output in machine.outputs][:LINES]
        ),
    )


@or_nothing
def _quarantined(metrics: Any) -> str:
    quarantined = need_figure(metrics, "quarantined")
    return (
        "No recording is quarantined."
        if quarantined == 0
        else f"{count(quarantined, 'recording is', 'recordings are').capitalize()} quarantined: see the "
        "findings."
    )


def _elapsed(table: Table, step: float) -> np.ndarray:
    return step * np.arange(len(table["time_s"]))


def _signal(
    signal,
    time: np.ndarray,
    values: np.ndarray,
    masked: np.ndarray,
    quality: Table,
    set_point: np.ndarray | None,
    *,
    last: bool,
) -> Markup:
    shown = values if set_point is None else np.concatenate([values, set_point])
    finite = shown[np.isfinite(shown)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    frame = charts.Frame(
        charts.linear(0, float(time[-1]) or 1.0),
        charts.Axis(low, high, ((low, short(low, 3)), (high, short(high, 3))))
        if high > low
        else charts.linear(low, high),
        width=540,
        height=80 if last else 66,
        left=44,
        below=16 if last else 4,
        above=22,
    )
    layers = [] if set_point is None else [charts.line(frame, time, set_point, "ref")]
    layers += [charts.line(frame, time, np.where(masked, np.nan, values), "line thin")]
    stretches = charts.stretches(masked)
    layers += [charts.interval(frame, float(time[a]), float(time[b - 1]), "gone") for a, b in stretches[:200]]
    mine = np.flatnonzero(quality["signal"] == signal.name)
    # a flag that spans the record says where it is in words, not in grey over everything
    short_ones = [i for i in mine if quality["end_s"][i] - quality["start_s"][i] < 0.5 * float(time[-1])]
    layers = [
        charts.interval(frame, float(quality["start_s"][i]), float(quality["end_s"][i]))
        for i in short_ones[:100]
    ] + layers
    flags = ", ".join(sorted({str(quality["kind"][i]) for i in mine}))
    unit = {"degC": "°C"}.get(signal.unit, signal.unit)
    alt = (
        f"{signal.name}: {short(low)} to {short(high)} {unit}, {count(int(masked.sum()), 'sample')} masked"
    ) + (f"; flagged {flags}" if flags else "")
    title = signal.name + (f": {flags}" if flags else "")
    return charts.panel(frame, layers, alt=alt, css="mb", title=title, x_ticks=last, units=("s", unit))


@as_table(rows=[], more=0)
def flaws(sources: Sources, most: int = 40) -> dict[str, Any]:
    """The quality findings, those of quarantined recordings first."""
    table = need(sources.tables["quality"])
    quality = pd.DataFrame(table)
    quality = quality.assign(used=quality["kind"] != "quarantined", start=quality["start_s"].fillna(0.0))
    quality = quality.sort_values(["used", "recording", "signal", "kind", "start"])
    rows = [
        {
            "recording": str(row["recording"]),
            "signal": str(row["signal"]) or "whole recording",
            "kind": str(row["kind"]),
            "place": (
                ""
                if np.isnan(row["start_s"])
                else f"{_seconds(row['start_s'])} to {_seconds(row['end_s'])}{THIN}s"
            ),
            "samples": number(float(row["count"]), 0),
            "message": str(row["message"]),
            "bad": row["kind"] == "quarantined",
        }
        for row in quality.head(most).to_dict("records")
    ]
    return {"rows": rows, "more": max(len(quality) - most, 0), "missing": None}


def _seconds(value: float) -> str:
    return number(float(value), 0 if float(value).is_integer() or abs(value) >= 1000 else 2)
