"""Pictures of the temperature page: how the pair compares plant by plant, what less of the record costs, and
the record."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from pipeline.report.shared import charts, page
from pipeline.report.shared.card import in_order
from pipeline.report.shared.pictures import Picture, PictureColumn, as_picture, as_table
from pipeline.report.shared.sources import Sources
from pipeline.report.temperature.judgement import Judgement, named_before
from pipeline.temperature.tables import set_point_of
from pipeline.verdict.controllers import BY_NAME, YARDSTICKS, heading, in_a_sentence
from pipeline.verdict.digits import THIN, count, number, short
from pipeline.verdict.evidence import Absent, Table, entry, known, need, need_figure, or_nothing
from pipeline.verdict.pairs import curve_sentence, pair_names
from pipeline.verdict.temperature import comparison, names
from pipeline.verdict.verdict import Missing

# the baseline that stands beside the pair if nobody runs yet
PI, IDLE = ("pi_simc", "pi"), "hold"


def contestants(sources: Sources, judged: Judgement) -> dict[str, str]:
    """Whom the card shows, and what each is here: the pair, the one that the verdict is about, and what runs
    now or a PI if there is room."""
    runs = named_before(sources)
    champion = runs if isinstance(sources.nightly, dict) else ""
    wanted = [judged.subject, *pair_names(sources.metrics), *([runs] if runs else []), *PI, IDLE]
    there = [name for name in dict.fromkeys(wanted) if name == judged.subject or judged.answers.get(name)]
    kinds = {name: BY_NAME[name].kind if name in BY_NAME else "" for name in there[:3]}
    return in_order(kinds, champion)


# ---- plant by plant


@as_picture("plants", "Plant by plant")
def plants(sources: Sources) -> Picture:
    """Cost of the pair on every plant, a line a plant; and the cost of all cases of each contestant."""
    table = need(sources.tables["cases"])
    cases = pd.DataFrame({key: table[key] for key in ("contestant", "plant", "cost")})
    cases = cases[np.isfinite(cases["cost"]) & (cases["cost"] > 0) & (cases["cost"] < 1e9)]
    a, b = pair_names(sources.metrics)
    by_plant = cases.groupby(["plant", "contestant"])["cost"].mean().unstack("contestant")
    shown = []
    finding, left = "The pair did not run the same plants.", ""
    if {a, b} <= set(by_plant):
        both = by_plant[[a, b]].dropna()
        cheaper = int((both[a] < both[b]).sum())
        finding = (
            f"{heading(a)[:1].upper()}{heading(a)[1:]} costs less than {in_a_sentence(b)} on {cheaper} of "
            f"{count(len(both), 'plant')}."
        )
        if cheaper < len(both):
            left = f"Left, blue and dashed: {in_a_sentence(b)} costs less. "
        shown.append(
            PictureColumn(
                "The pair", "mean cost on each plant, a line a plant", "", [_slopes(both, a, b, finding)]
            )
        )
    drawn_names = [
        name for name in names(sources.metrics) if name in set(cases["contestant"]) and name not in YARDSTICKS
    ]
    if not drawn_names:
        raise Absent(Missing("not measured", "no case has a cost"))
    shown.append(PictureColumn("All contestants", "cost of every case", "", [_boxes(cases, drawn_names)]))
    return Picture(
        finding,
        shown,
        f"Cost as deployed, log scale. {left}Right: bar from the 5{THIN}% to the 95{THIN}% quantile, box the "
        f"middle half, line the median, dot the 90{THIN}% quantile.",
        page.origin(sources.source("cases")),
    )


def _costs(values: np.ndarray) -> charts.Axis:
    """A scale of decades, but no wider than the costs; ticks at 1, 2 and 5, or closer."""
    low, high = float(values.min()) / 1.05, float(values.max()) * 1.05
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    steps = (1, 2, 5) if last - first <= 3 else (1,)
    steps = (1, 1.5, 2, 3, 5, 7) if high < 10 * low else steps
    every = [k * 10.0**decade for decade in range(first, last + 1) for k in steps]
    ticks = tuple((value, f"{value:g}") for value in every if low <= value <= high)
    return charts.Axis(low, high, ticks, log=True)


def _slopes(both: pd.DataFrame, a: str, b: str, finding: str) -> Markup:
    values = both.to_numpy().ravel()
    y = _costs(values) if len(values) else charts.linear(0, 1)
    frame = charts.Frame(
        charts.Axis(0, 1, ((0.15, heading(a)), (0.85, heading(b)))),
        y,
        width=420,
        height=210,
        left=44,
        above=20,
    )
    layers = []
    for one, other in both.to_numpy():
        css = "line thin dd" if other < one else "line thin"
        layers.append(charts.line(frame, [0.15, 0.85], [one, other], css))
    layers.append(charts.dots(frame, np.full(len(both), 0.15), both[a].to_numpy(), "dot", 2.2))
    layers.append(charts.dots(frame, np.full(len(both), 0.85), both[b].to_numpy(), "dot dd", 2.2))
    return charts.panel(frame, layers, alt=finding, css="mb slopes", title="cost, log")


def _boxes(cases: pd.DataFrame, names: list[str]) -> Markup:
    values = cases["cost"].to_numpy()
    x = _costs(values)
    frame = charts.Frame(
        x,
        charts.Axis(-0.5, len(names) - 0.5, ()),
        width=560,
        height=34 * len(names) + 40,
        left=165,
        above=10,
        below=22,
        right=14,
    )
    layers, words = [], []
    for lane, name in enumerate(names):
        at, mine = len(names) - 1 - lane, cases[cases["contestant"] == name]["cost"].to_numpy()
        low, first, middle, third, nine, high = np.quantile(mine, [0.05, 0.25, 0.5, 0.75, 0.9, 0.95])
        a, b, c, d, e = (float(frame.px(v)) for v in (low, first, middle, third, high))
        y = float(frame.py(at))
        layers += [
            charts.label(frame, x.low, at, heading(name), anchor="end", dx=-8, dy=3.5),
            Markup('<line class="ax" x1="{:.1f}" x2="{:.1f}" y1="{:.1f}" y2="{:.1f}"/>').format(a, e, y, y),
            Markup('<rect class="allow" x="{:.1f}" width="{:.1f}" y="{:.1f}" height="14"/>').format(
                b, d - b, y - 7
            ),
            Markup('<line class="med" x1="{:.1f}" x2="{:.1f}" y1="{:.1f}" y2="{:.1f}"/>').format(
                c, c, y - 8, y + 8
            ),
            charts.dots(frame, [nine], [at], f"dot {page.MARKS.get(name, '')}", 3.2),
        ]
        words.append(f"{heading(name)} {short(float(middle), 2)}")
    return charts.panel(
        frame, layers, alt=f"Median cost of all cases: {', '.join(words)}", css="mb wide", title=""
    )


# ---- less of the record


@as_picture("record_length", "Less of the record")
def record_length(sources: Sources) -> Picture:
    """Cost against the length of the record, a curve a controller, and where the pair changes places."""
    curve = entry(comparison(sources.metrics), "cost_curve")
    if not curve or not curve["controllers"]:
        off = "evaluate_temperature.cost_curve is false in params.expert.yaml"
        why = "No model-based or data-driven controller was learned" if curve else off
        raise Absent(Missing("not measured", why))
    step, finding = sources.declared.machine.sample_time_s, curve_sentence(sources.metrics)
    lacking = [
        f"From {number(int(length) * step / 60, 0)} min {in_a_sentence(name)} cannot be learned: {why}."
        for length, reasons in curve["refused"].items()
        for name, why in reasons.items()
    ]
    return Picture(
        finding,
        [
            PictureColumn(
                "Cost", "learned from the beginning of the record", "", [cost_curve(curve, step, finding)]
            )
        ],
        cost_key(curve)
        + ". Each controller learned again from the beginning of the record, its weights kept, on "
        f"{curve['plants']} plants; bands: 90{THIN}% over plants. Nothing is said of longer records. "
        f"{' '.join(lacking)}",
        page.origin(sources.source("evaluate_temperature")),
    )


def cost_curve(curve: Mapping[str, Any], step: float, alt: str) -> Markup:
    """Cost against the length of the record, as record_length.curves has it: a curve and a band a controller,
    and the interval in which the pair changes places. `step` is the sample time in seconds."""
    minutes = np.array(curve["samples"]) * step / 60
    styles = cost_styles(curve)
    named = {
        name: {key: np.array(values, float) for key, values in curve["controllers"][name].items()}
        for name in styles
    }
    every = np.concatenate([values for own in named.values() for values in own.values()])
    ticks = tuple((float(value), number(float(value), 0)) for value in minutes)
    frame = charts.Frame(
        charts.Axis(minutes[0] / 1.2, minutes[-1] * 1.1, ticks, log=True),
        _costs(every[np.isfinite(every)]),
        width=720,
        height=220,
        left=44,
        below=34,
        above=20,
    )
    layers = []
    crossing = entry(curve, "crossing") or {}
    if crossing.get("low"):
        ends = (crossing[end] * step / 60 for end in ("low", "high"))
        layers.append(charts.interval(frame, *ends))
    for name, own in named.items():
        known = np.isfinite(own["cost"])
        layers.append(
            charts.ribbon(
                frame,
                minutes[known],
                own["low"][known],
                own["high"][known],
                f"ribbon {page.MARKS.get(name, '')}",
            )
        )
        layers.append(charts.line(frame, minutes[known], own["cost"][known], styles[name]))
        layers.append(
            charts.dots(frame, minutes[known], own["cost"][known], f"dot {page.MARKS.get(name, '')}")
        )
    return charts.panel(
        frame, layers, alt=alt, css="mb lead-picture", title="cost, log", across="minutes of the record, log"
    )


def cost_key(curve: Mapping[str, Any]) -> Markup:
    """Which line is whose in `cost_curve`."""
    return page.line_key((heading(name), css) for name, css in cost_styles(curve).items())


def cost_styles(curve: Mapping[str, Any]) -> dict[str, str]:
    """By controller with a known cost the class of its line."""
    drawn = [name for name, own in curve["controllers"].items() if any(v is not None for v in own["cost"])]
    return page.line_styles({name: name for name in drawn})


def runs_of(sources: Sources, judged: Judgement, table: Table) -> tuple[dict[str, np.ndarray], str]:
    """Rows of the deciding case under those whom page one's table shows, in the order of simplicity, and the
    output that the subject of the verdict leaves furthest from its reference."""
    shown = contestants(sources, judged)
    runs = {
        who: np.flatnonzero((table["contestant"] == who) & (table["case_name"] == "deciding"))
        for who in names(sources.metrics)
        if who in shown
    }
    runs = {who: rows for who, rows in runs.items() if len(rows)}
    outputs = [output.name for output in sources.declared.machine.outputs]
    if not runs:
        return {}, outputs[0]
    rows = runs.get(judged.subject, next(iter(runs.values())))
    settled = entry(comparison(sources.metrics), "settled_steps")
    last = rows[-(settled if isinstance(settled, int) else max(len(rows) // 10, 1)) :]
    apart = [float(np.abs(np.mean(table[name][last] - table[f"{name}_reference"][last]))) for name in outputs]
    return runs, outputs[int(np.argmax(np.nan_to_num(apart, nan=np.inf)))]


def until_settled(table: Table, runs: dict[str, np.ndarray], zone: str) -> float:
    """Three times as long as the slowest takes to come within 2 % of its way to a constant reference; to the
    end of one that moves."""
    rows = np.concatenate(list(runs.values()))
    time, away = table["time_s"][rows], np.abs(table[zone][rows] - table[f"{zone}_reference"][rows])
    if np.ptp(table[f"{zone}_reference"][rows]) > 0 or not np.isfinite(away).all():
        return float(time.max())
    outside = time[away > 0.02 * away.max()]
    return float(min(3 * outside.max(initial=0.0) + 1, time.max()))


LINES = 8  # that a link into the viewer opens at most
NO_FLAGS: Table = dict.fromkeys(("signal", "start_s", "end_s", "kind"), np.empty(0, object))


@as_picture("record", "The record, with what was flagged and masked")
def record(sources: Sources) -> Picture:
    """Every signal of the record, what is masked and what was found strange."""
    table, quality = need(sources.tables["record"]), known(sources.tables["quality"], NO_FLAGS)
    machine, time = sources.declared.machine, np.arange(len(table["time_s"]))
    time = machine.sample_time_s * time
    set_points = known(sources.tables["set_points"], {})
    masked_total = 0
    halves: list[list[Markup]] = [[], []]
    for half, signals in enumerate((machine.inputs, machine.outputs)):
        for i, signal in enumerate(signals):
            values, masked = table[signal.name], table[f"{signal.name}_masked"]
            masked_total += int(masked.sum())
            set_point = set_points.get(set_point_of(signal.name))
            halves[half].append(
                _signal(signal, time, values, masked, quality, set_point, last=i == len(signals) - 1)
            )
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
    return charts.panel(
        frame,
        layers,
        alt=f"{signal.name}: {short(low)} to {short(high)} {unit}, {count(int(masked.sum()), 'sample')} "
        f"masked{f'; flagged {flags}' if flags else ''}",
        css="mb",
        title=signal.name + (f": {flags}" if flags else ""),
        x_ticks=last,
        units=("s", unit),
    )


FLAWS = 40  # of a record that the page lists at most


@as_table(rows=[], more=0)
def flaws(sources: Sources) -> dict[str, Any]:
    """The quality findings, those of quarantined recordings first."""
    table = need(sources.tables["quality"])
    quality = pd.DataFrame(table)
    quality = quality.assign(used=quality["kind"] != "quarantined", start=quality["start_s"].fillna(0.0))
    quality = quality.sort_values(["used", "recording", "signal", "kind", "start"])
    return {"rows": quality.head(FLAWS).to_dict("records"), "more": max(len(quality) - FLAWS, 0)}
