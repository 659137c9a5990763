"""Three large pictures of the temperature page: a typical case and the deciding one under the contestants
that matter, and how the pair compares plant by plant."""

import math
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
from pipeline.verdict.controllers import BY_NAME, YARDSTICKS, heading, in_a_sentence, kind
from pipeline.verdict.digits import THIN, count, number, short
from pipeline.verdict.evidence import Absent, Table, entry, known, lookup, need, need_figure, or_nothing
from pipeline.verdict.pairs import curve_sentence, pair_names, reference_of
from pipeline.verdict.temperature import comparison, names, refused
from pipeline.verdict.verdict import UNJUDGED, Missing

# the baseline that stands beside the pair if nobody runs yet
PI, IDLE = ("pi_simc", "pi"), "hold"

CASES = {"typical": "A typical case", "deciding": "The case that decides"}
# a cost or temperature beyond it is of a loop that is lost; it is drawn at the edge
LARGEST = 1e4


def contestants(sources: Sources, judged: Judgement) -> dict[str, str]:
    """Whom the card shows, and what each is here: the pair, the one that the verdict is about, and what runs
    now or a PI if there is room."""
    runs = named_before(sources)
    champion = runs if isinstance(sources.nightly, dict) else ""
    wanted = [judged.subject, *pair_names(sources.metrics), *([runs] if runs else []), *PI, IDLE]
    there = [name for name in dict.fromkeys(wanted) if name == judged.subject or judged.answers.get(name)]
    kinds = {name: BY_NAME[name].kind if name in BY_NAME else "" for name in there[:3]}
    return in_order(kinds, champion)


def list_drawn(sources: Sources, judgement: Judgement) -> list[str]:
    """Who has a column of a case: the pair, the best, and PI, in the order of simplicity."""
    wanted = {*pair_names(sources.metrics), judgement.subject, "pi"}
    return [name for name in (*names(sources.metrics), *refused(sources.metrics)) if name in wanted]


def case(sources: Sources, judgement: Judgement, name: str) -> Picture:
    """Temperatures with their references and commands of one case, a column a contestant."""
    return as_picture(name, CASES[name])(_case)(sources, judgement, name)


def _case(sources: Sources, judgement: Judgement, name: str) -> Picture:
    table = need(sources.tables["trajectories"])
    without = refused(sources.metrics)
    rows = {
        who: (table["contestant"] == who) & (table["case_name"] == name)
        for who in list_drawn(sources, judgement)
    }
    runs = {
        who: {key: values[mask] for key, values in table.items()}
        for who, mask in rows.items()
        if mask.any() and who not in without
    }
    if not runs:
        raise Absent(Missing("not measured", f"no trajectory of the {name} case was recorded"))
    settled = entry(comparison(sources.metrics), "settled_steps")
    ends = {
        who: _past(run, [o.name for o in sources.declared.machine.outputs], settled)
        for who, run in runs.items()
    }
    _, zone = ends.get(judgement.subject, next(iter(ends.values())))
    whole, runs = runs, _early(runs, next(q.limit for q in judgement.asked if q.key == "settling"))
    y = _temperatures(sources, list(runs.values()))
    most = max(
        float(np.nanmax(run[f"{i.name}_applied"]))
        for run in runs.values()
        for i in sources.declared.machine.inputs
    )
    shown = []
    for who in rows:
        panels = (
            [
                _heat(sources, who, runs[who], y, ends[who], first=not shown),
                _commands(sources, who, runs[who], most, first=not shown),
            ]
            if who in runs
            else [page.hole(Missing("failed", without.get(who, "no trajectory was recorded")))]
        )
        shown.append(PictureColumn(heading(who), kind(who), who, panels))
    return Picture(
        _finding(sources, name, ends),
        shown,
        f"{_extent(whole, runs)}Above: true temperature of every zone in °C, dashed its reference. Below: "
        "every command in per cent as the machine was given it; grey: within its limits. Against time in s.",
        page.origin(sources.source("trajectories"), case_name=name, contestant=list(runs), y=zone),
    )


def _early(runs: dict[str, Table], settling_s: float) -> dict[str, Table]:
    """Of constant references the first part, half as long again as settling may last; of others all of it."""
    first = next(iter(runs.values()))
    constant = all(np.ptp(values) == 0 for key, values in first.items() if key.endswith("_reference"))
    span = 1.5 * settling_s if constant and math.isfinite(settling_s) else math.inf
    return {
        who: {key: values[run["time_s"] <= span] for key, values in run.items()} for who, run in runs.items()
    }


def _extent(whole: dict[str, Table], runs: dict[str, Table]) -> str:
    """What part of the runs is drawn; "" where all of it is."""
    drawn_s, all_s = (next(iter(part.values()))["time_s"][-1] for part in (runs, whole))
    return f"The first {short(drawn_s, 2)} of {short(all_s, 2)} s. " if drawn_s < all_s else ""


def _temperatures(sources: Sources, runs: list[Table]) -> charts.Axis:
    names = [o.name for o in sources.declared.machine.outputs]
    values = np.concatenate([run[key] for run in runs for n in names for key in (n, f"{n}_reference")])
    values = values[np.isfinite(values) & (np.abs(values) < LARGEST)]
    if not len(values):
        return charts.linear(0, 1)
    room = 0.04 * (float(values.max() - values.min()) or 1.0)
    return charts.linear(float(values.min()) - room, float(values.max()) + room)


def _heat(
    sources: Sources, who: str, run: Table, y: charts.Axis, end: tuple[float, str], *, first: bool
) -> Markup:
    time, outputs = run["time_s"], sources.declared.machine.outputs
    frame = charts.Frame(charts.linear(0, float(time[-1]) or 1.0, ticks=3), y, width=360, height=210, left=32)
    past, zone = end
    layers = [charts.line(frame, time, run[f"{o.name}_reference"], "ref") for o in outputs]
    layers += [charts.line(frame, time, np.clip(run[o.name], -LARGEST, LARGEST), "line") for o in outputs]
    return charts.panel(
        frame,
        layers,
        alt=f"{heading(who)}: {zone} ends {_degrees(past)} from its reference, worst of {len(outputs)} zones",
        css=page.MARKS.get(who, "bl"),
        title="°C" if first else "",
        units=("s", "°C"),
    )


def _past(run: Table, names: list[str], settled: object) -> tuple[float, str]:
    """The settled error of a run, over as many steps as the rule's (a tenth where that is not known): how far
    the furthest zone's mean lies from its reference, and whose it is."""
    steps = settled if isinstance(settled, int) else len(run["time_s"]) // 10
    last = slice(-max(steps, 1), None)
    apart = {name: float(np.abs(np.mean((run[name] - run[f"{name}_reference"])[last]))) for name in names}
    zone = max(apart, key=lambda name: apart[name] if math.isfinite(apart[name]) else math.inf)
    return apart[zone], zone


def _degrees(value: float) -> str:
    return f"{short(value, 2)} °C" if value < LARGEST else "too far to say 1 figure"


def _commands(sources: Sources, who: str, run: Table, most: float, *, first: bool) -> Markup:
    machine, time = sources.declared.machine, run["time_s"]
    low, high = min(i.low for i in machine.inputs), max(i.high for i in machine.inputs)
    reach = min(high, most)
    room = 0.08 * ((reach - low) or 1.0)
    y = charts.linear(low, reach + room, ticks=3)._replace(low=low - room)
    frame = charts.Frame(charts.linear(0, float(time[-1]) or 1.0, ticks=3), y, width=360, height=130, left=32)
    layers = [charts.tint(frame, low, min(high, y.high))]
    layers += [
        charts.line(frame, time, run[f"{i.name}_applied"], "line thin", steps=True) for i in machine.inputs
    ]
    given = np.stack([run[f"{i.name}_applied"] for i in machine.inputs])
    at = np.stack(
        [(run[f"{i.name}_applied"] <= i.low) | (run[f"{i.name}_applied"] >= i.high) for i in machine.inputs]
    )
    return charts.panel(
        frame,
        layers,
        alt=f"{heading(who)}: commands from {number(float(np.nanmin(given)), 0)} to "
        f"{number(float(np.nanmax(given)), 0)} %, "
        f"at a limit {number(100 * float(at.mean()), 1)} % of the time",
        css=page.MARKS.get(who, "bl"),
        title="%" if first else "",
        units=("s", "%"),
    )


def _finding(sources: Sources, name: str, ends: dict[str, tuple[float, str]]) -> str:
    parts = [f"{in_a_sentence(who)} {_degrees(value)}" for who, (value, _) in ends.items() if value < LARGEST]
    where = ""
    decides = entry(comparison(sources.metrics), "deciding")
    if name == "deciding" and entry(decides, "plant") is not None:
        where = f"Plant {decides['plant']}{', ' + reference_of(decides) if decides.get('kind') else ''}. "
    if not parts:
        return f"{where}No contestant ends near its reference."
    return f"{where}Settled error of the worst zone: {', '.join(parts)}."


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
    finding = "The pair did not run the same plants."
    if {a, b} <= set(by_plant):
        both = by_plant[[a, b]].dropna()
        cheaper = int((both[a] < both[b]).sum())
        finding = (
            f"{heading(a)[:1].upper()}{heading(a)[1:]} costs less than {in_a_sentence(b)} on {cheaper} of "
            f"{count(len(both), 'plant')}."
        )
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
        f"Cost as deployed, log scale. Left: ink where model-based costs less, blue and dashed where "
        "data-driven does. Right: bar "
        f"from the 5{THIN}% to the 95{THIN}% quantile, box the middle half, line the median, dot the "
        f"90{THIN}% quantile.",
        page.origin(sources.source("cases")),
    )


def _costs(values: np.ndarray) -> charts.Axis:
    """A scale of decades, but no wider than the costs; ticks at 1, 2 and 5."""
    low, high = float(values.min()) / 1.05, float(values.max()) * 1.05
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    steps = (1, 2, 5) if last - first <= 3 else (1,)
    every = [k * 10.0**decade for decade in range(first, last + 1) for k in steps]
    ticks = tuple((value, short(value, 1)) for value in every if low <= value <= high)
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
        left=130,
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
    minutes = np.array(curve["samples"]) * sources.declared.machine.sample_time_s / 60
    named = {
        name: {key: np.array(values, float) for key, values in own.items()}
        for name, own in curve["controllers"].items()
        if any(value is not None for value in own["cost"])
    }
    every = np.concatenate([values for own in named.values() for values in own.values()])
    ticks = tuple((float(value), number(float(value), 0)) for value in minutes)
    frame = charts.Frame(
        charts.Axis(minutes[0] / 1.2, minutes[-1] * 1.9, ticks, log=True),
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
        ends = (crossing[end] * sources.declared.machine.sample_time_s / 60 for end in ("low", "high"))
        layers.append(charts.interval(frame, *ends))
    for name, own in named.items():
        css = f"line {page.MARKS.get(name, '')}{' dash' if BY_NAME[name].hollow else ''}"
        known = np.isfinite(own["cost"])
        layers.append(charts.ribbon(frame, minutes[known], own["low"][known], own["high"][known]))
        layers.append(charts.line(frame, minutes[known], own["cost"][known], css))
        layers.append(
            charts.dots(frame, minutes[known], own["cost"][known], f"dot {page.MARKS.get(name, '')}")
        )
        last = np.flatnonzero(known)[-1]
        layers.append(charts.label(frame, minutes[last], own["cost"][last], heading(name), dx=6, dy=4))
    lacking = [
        f"From {number(int(length) * sources.declared.machine.sample_time_s / 60, 0)} min "
        f"{in_a_sentence(name)} cannot be learned: {why}."
        for length, reasons in curve["refused"].items()
        for name, why in reasons.items()
    ]
    finding = curve_sentence(sources.metrics)
    drawn_picture = charts.panel(
        frame, layers, alt=finding, css="mb wide", title="cost, log", across="minutes of the record, log"
    )
    return Picture(
        finding,
        [PictureColumn("Cost", "learned from the beginning of the record", "", [drawn_picture])],
        "Each controller learned again from the beginning of the record, its weights kept, on "
        f"{curve['plants']} plants; bands: 90{THIN}% over plants. Nothing is said of longer records. "
        f"{' '.join(lacking)}",
        page.origin(sources.source("evaluate_temperature")),
    )


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
        raise Absent(Missing(UNJUDGED, f"Not written: {entry(metrics, 'reason')}"))
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
        shown.append(
            PictureColumn(
                name,
                "",
                "",
                [
                    charts.panel(
                        frame,
                        [layer],
                        alt=f"{name}: level {number(float(levels[:, i].min()), 2)} to "
                        f"{number(float(levels[:, i].max()), 2)} % "
                        "in eight bands from 0 to π rad a step",
                        title="%" if i == 0 else "",
                        units=("of π", "%"),
                    )
                ],
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


@as_table(rows=[], more=0)
def flaws(sources: Sources, most: int = 40) -> dict[str, Any]:
    """The quality findings, those of quarantined recordings first."""
    table = need(sources.tables["quality"])
    quality = pd.DataFrame(table)
    quality = quality.assign(used=quality["kind"] != "quarantined", start=quality["start_s"].fillna(0.0))
    quality = quality.sort_values(["used", "recording", "signal", "kind", "start"])
    return {
        "rows": [
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
        ],
        "more": max(len(quality) - most, 0),
        "missing": None,
    }


def _seconds(value: float) -> str:
    return number(float(value), 0 if float(value).is_integer() or abs(value) >= 1000 else 2)
