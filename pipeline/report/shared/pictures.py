"""The figures of the temperature page that show controllers at work:
trajectories, errors, cost and inputs."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from pipeline.report.shared import charts, page
from pipeline.report.shared.digits import THIN, beyond_meaning, number, percent, quantity, short
from pipeline.report.shared.sources import Sources, Table, lookup
from pipeline.report.shared.verdict import Missing
from pipeline.report.temperature.answers import LABELS, YARDSTICKS, aimed_unclipped, featured, without_figures

# of the study's machine
SPAN_S, CARD_SPAN_S = 40.0, 60.0


class Column(NamedTuple):
    """Panels below one head."""

    head: str
    small: str
    mark: str
    panels: list[Markup]


class Picture(NamedTuple):
    """A figure with its finding as the sentence above it; in the place
    of what cannot be drawn, the reason."""

    id: str
    title: str
    finding: str
    columns: list[Column]
    caption: str
    origin: Markup
    missing: Missing | None = None


def placeholder(id: str, title: str, missing: Missing) -> Picture:
    return Picture(id, title, "", [], "", Markup(""), missing)


def span(sources: Sources, simulated: float = SPAN_S) -> float:
    """Seconds that the pictures of a way to a reference show: of a user's machine 1.5 times the slowest
    settling of its controllers, rounded up to a readable number, within the run."""
    panel, machine = sources.declared.panel, sources.declared.machine
    if not sources.recorded:
        return simulated
    run = panel.steps * machine.sample_time_s
    medians = [
        lookup(sources.metrics["evaluate_temperature"], f"controllers.{name}.settling_s.median")
        for name in LABELS
        if name not in YARDSTICKS
    ]
    settled = [float(median) for median in medians if not isinstance(median, Missing)]
    if not settled or max(settled) <= 0:
        return run
    wanted = 1.5 * max(settled)
    power = 10.0 ** math.floor(math.log10(wanted))
    return min(next(k * power for k in (1, 2, 3, 4, 5, 6, 8, 10) if k * power >= wanted * (1 - 1e-9)), run)


class Run(NamedTuple):
    """One controller's trajectory of the featured scenario."""

    name: str
    css: str
    time: np.ndarray
    rows: Table


def runs(sources: Sources, mode: str) -> list[Run] | Missing:
    table = sources.tables["trajectories"]
    if isinstance(table, Missing):
        return table
    recorded = []
    for name in LABELS:
        rows = (table["controller"] == name) & (table["mode"] == mode)
        if rows.any():
            trajectory = {key: values[rows] for key, values in table.items()}
            recorded.append(Run(name, page.MARKS[name], trajectory["time_s"], trajectory))
    return recorded or Missing("not measured", f"no {mode} trajectory was recorded")


def columns(sources: Sources, recorded: list[Run], draw: Callable[[Run, int], list[Markup]]) -> list[Column]:
    """A column a controller, in the table's order. One that was refused keeps its place, with the reason."""
    drawn = {run.name: draw(run, i) for i, run in enumerate(recorded)}
    for name in LABELS.keys() - drawn.keys():
        if why := without_figures(sources, name):
            drawn[name] = [Markup('<div class="hole">{}</div>').format(page.missing(why))]
    return [Column(*LABELS[name], name, drawn[name]) for name in LABELS if name in drawn]


# ---- at work


def trajectories(sources: Sources) -> Picture:
    """Every zone under every controller, with its reference."""
    recorded = runs(sources, "deployed")
    title = "Every zone on its way to its reference"
    if isinstance(recorded, Missing):
        return placeholder("trajectories", title, recorded)
    machine, span_s = sources.declared.machine, span(sources)
    offset = sources.declared.panel.judging.reference_offsets_degC[0]
    lowest = min(
        float(np.nanmin(run.rows[o.name][run.time <= span_s])) for run in recorded for o in machine.outputs
    )
    highest = max(
        float(np.nanmax(run.rows[o.name][run.time <= span_s])) for run in recorded for o in machine.outputs
    )
    y = charts.linear(min(lowest, 0.0), min(highest, 2 * max(o.reference for o in machine.outputs)) * 1.02)

    def draw(run: Run, column: int) -> list[Markup]:
        panels, early = [], run.time <= span_s
        for i, output in enumerate(machine.outputs):
            last = i == len(machine.outputs) - 1
            frame = charts.Frame(
                charts.linear(0, span_s, ticks=3), y, height=92 if last else 78, below=16 if last else 4
            )
            values, reference = run.rows[output.name][early], output.reference + offset
            past = float(np.nanmax(np.sign(reference - values[0]) * (values - reference)))
            alt = (
                f"{LABELS[run.name][0]}, {sources.zone(i)}: from {number(float(values[0]), 0)} to "
                f"{number(float(values[-1]), 1)} °C of {reference:g} °C in {span_s:g} s, "
                f"{number(max(past, 0), 1)} "
                "°C past it"
            )
            layers = [
                charts.level(frame, reference, "ref"),
                charts.line(frame, run.time[early], values),
                charts.label(frame, span_s, y.low, f"{sources.zone(i)}: {reference:g}", anchor="end", dy=-5),
            ]
            panels.append(
                charts.panel(
                    frame,
                    layers,
                    alt=alt,
                    css=run.css,
                    title="°C" if i == 0 else "",
                    x_ticks=last,
                    units=("s", "°C"),
                )
            )
        return panels

    return Picture(
        "trajectories",
        title,
        _reach(recorded, machine, offset),
        columns(sources, recorded, draw),
        (
            f"True temperature in °C over the first {span_s:g} s as deployed (inputs "
            "clipped, feasible target, "
            f"integrator); dashed: reference. One run: {featured(sources)}."
        ),
        page.origin(sources.source("trajectories")),
    )


def _reach(recorded: list[Run], machine, offset: float) -> str:
    parts = []
    for run in recorded:
        if run.name in YARDSTICKS:
            continue
        past = max(
            float(
                np.nanmax(
                    np.sign(o.reference + offset - run.rows[o.name][0])
                    * (run.rows[o.name] - o.reference - offset)
                )
            )
            for o in machine.outputs
        )
        parts.append(f"{LABELS[run.name][0]} {quantity(max(past, 0.0), '°C', 1)}")
    return f"Largest way past a reference in this run: {', '.join(parts)}."


def errors(sources: Sources) -> Picture:
    """The worst zone's error over the whole run."""
    recorded = runs(sources, "deployed")
    title = "The worst zone’s error at each moment, noise and ripple in it"
    if isinstance(recorded, Missing):
        return placeholder("errors", title, recorded)
    machine, offset, limit = (
        sources.declared.machine,
        sources.declared.panel.judging.reference_offsets_degC[0],
        sources.declared.rules.settled_error_degC,
    )
    last: dict[str, float] = {}

    def draw(run: Run, column: int) -> list[Markup]:
        error = np.max([np.abs(run.rows[o.name] - o.reference - offset) for o in machine.outputs], axis=0)
        frame = charts.Frame(
            charts.linear(0, float(run.time[-1]), ticks=3), charts.logarithmic(0.01, 300), height=120
        )
        late = float(np.median(error[2 * len(error) // 3 :]))
        last[LABELS[run.name][0]] = late
        alt = (
            f"{LABELS[run.name][0]}: worst zone {short(late, 2)} °C from its reference over the last third, "
            f"{'above' if late > limit else 'below'} the {limit:g} °C limit"
        )
        layers = [
            charts.tint(frame, 0.01, limit),
            _band(frame, run),
            charts.level(frame, limit, "lim", f"limit {limit:g}" if column == 0 else ""),
            charts.line(frame, run.time, error),
        ]
        return [
            charts.panel(
                frame, layers, alt=alt, css=run.css, title="°C, log" if column == 0 else "", units=("s", "°C")
            )
        ]

    shown = columns(sources, recorded, draw)
    text = (
        "At a moment of the last third, median, noise and ripple in it: "
        f"{', '.join(f'{name} {short(value, 2)}{THIN}°C' for name, value in last.items())}; the rule "
        f"allows {limit:g}{THIN}°C of settled error, which is of the mean over that third and so smaller."
    )
    return Picture(
        "errors",
        title,
        text,
        shown,
        "Largest distance of a zone from its reference, in °C, log scale, against time in s, "
        "noise and ripple in it. Line: one run; band: 90 of 100 runs on the nominal plant, all starts, "
        "references and seeds. Grey: what the rule allows of the settled error, "
        "which is of the mean over the last third.",
        page.origin(sources.source("trajectories")),
    )


def _band(frame: charts.Frame, run: Run) -> Markup:
    """The range of 90 of 100 runs, decimated: the lowest low and the highest high of every few samples."""
    low, high = run.rows["error_low_degC"], run.rows["error_high_degC"]
    of = max(len(low) // 150, 1)
    keep = len(low) // of * of
    ends = [
        pick(values[:keep].reshape(-1, of), axis=1) for pick, values in ((np.nanmin, low), (np.nanmax, high))
    ]
    return (
        charts.ribbon(frame, run.time[:keep:of], *ends, f"ribbon {run.css}")
        if np.isfinite(ends).all()
        else Markup("")
    )


def costs(sources: Sources) -> Picture:
    """Cost so far of the unclipped run, beside the controller that was told the true plant."""
    recorded = runs(sources, "unclipped")
    title = "Cost so far, on the common yardstick"
    if isinstance(recorded, Missing):
        return placeholder("costs", title, recorded)
    exact = next((run for run in recorded if run.name in YARDSTICKS), None)
    finals = {run.name: float(run.rows["cost"][-1]) for run in recorded}
    first_step = min(float(run.rows["cost"][0]) for run in recorded)
    y = charts.linear(0.97 * first_step / 1000, 1.03 * max(finals.values()) / 1000)

    def draw(run: Run, column: int) -> list[Markup]:
        frame = charts.Frame(charts.logarithmic(1, 1000), y, height=120)
        mine = charts.line(frame, run.time + 1, run.rows["cost"] / 1000)
        other = (
            [charts.line(frame, exact.time + 1, exact.rows["cost"] / 1000, "ref")]
            if exact and run is not exact
            else []
        )
        above = finals[run.name] / finals[exact.name] - 1 if exact else 0.0
        text = (
            f"{_amount(finals[run.name] / 1000, 1)}"
            f"{f', {_signed(100 * above)}' if exact and run is not exact else ''}"
        )
        end = charts.label(
            frame,
            1000,
            finals[run.name] / 1000,
            text,
            anchor="end",
            dy=14 if finals[run.name] / 1000 > 0.85 * y.high else -5,
        )
        alt = (
            f"{LABELS[run.name][0]}: cost {_amount(finals[run.name], 0)} after "
            f"{number(float(run.time[-1]) + 1, 0)} s"
            + (f", {_signed(100 * above)} against the exact model" if exact else "")
        )
        return [
            charts.panel(
                frame,
                [*other, mine, end],
                alt=alt,
                css=run.css,
                title="thousands" if column == 0 else "",
                units=("s", "thousand"),
            )
        ]

    shown = columns(sources, recorded, draw)
    first = float(recorded[0].rows["cost"][0]) / finals[recorded[0].name]
    return Picture(
        "costs",
        title,
        (
            f"The first step alone makes {number(100 * first, 0)}{THIN}% of the "
            f"{LABELS[recorded[0].name][0].lower()} controller’s cost: the way up is long, whoever steers."
        ),
        shown,
        (
            "Discounted cost at the yardstick’s weights (Q = "
            f"{sources.declared.tracking.yardstick_q:g} I, R = "
            f"{sources.declared.tracking.yardstick_r:g} I, γ = {sources.declared.tracking.gamma:g}), "
            "unclipped, true outputs, in thousands, against time in s (log). Dashed: exact model. "
            f"{aimed_unclipped(sources, 'here')}"
        ).rstrip(),
        page.origin(sources.source("trajectories")),
    )


def _signed(value: float) -> str:
    return ("+" if value >= 0 and not beyond_meaning(value, "%") else "") + percent(value, 2)


def _amount(value: float, places: int) -> str:
    """A cost; of one that only an unstable run has, the power of ten alone."""
    return number(value, places) if abs(value) < 1e9 else short(value, 2)


def inputs(sources: Sources) -> Picture:
    """What each controller asks of each input, against the limits."""
    recorded = runs(sources, "deployed")
    title = "Inputs against their limits"
    if isinstance(recorded, Missing):
        return placeholder("inputs", title, recorded)
    machine, span_s = sources.declared.machine, span(sources)
    low, high = min(i.low for i in machine.inputs), max(i.high for i in machine.inputs)
    room = 0.35 * (high - low)
    y = charts.Axis(low - room, high + room, ((low, number(low, 0)), (high, number(high, 0))))

    def draw(run: Run, column: int) -> list[Markup]:
        panels, early = [], run.time <= span_s
        for i, signal in enumerate(machine.inputs):
            last = i == len(machine.inputs) - 1
            frame = charts.Frame(
                charts.linear(0, span_s, ticks=3),
                y,
                height=74 if last else 60,
                below=16 if last else 4,
                above=10 if i else 14,
            )
            command = run.rows[f"{signal.name}_command"]
            outside = 100 * float(((command < signal.low) | (command > signal.high)).mean())
            alt = (
                f"{LABELS[run.name][0]}, {signal.name}: asked for {number(float(np.nanmin(command)), 0)} to "
                f"{number(float(np.nanmax(command)), 0)} %, beyond its limits "
                f"{number(outside, 1)} % of the time"
            )
            layers = [
                charts.tint(frame, signal.low, signal.high),
                charts.line(frame, run.time[early], command[early], steps=True),
                charts.label(frame, span_s, signal.high, signal.name, anchor="end", dy=10),
            ]
            panels.append(
                charts.panel(
                    frame,
                    layers,
                    alt=alt,
                    css=run.css,
                    title="%" if i == 0 else "",
                    x_ticks=last,
                    units=("s", "%"),
                )
            )
        return panels

    free = [
        (
            LABELS[run.name][0],
            lookup(
                sources.metrics["evaluate_temperature"],
                f"controllers.{run.name}.outside_limits_percent.median",
            ),
        )
        for run in recorded
    ]
    shares = ", ".join(
        f"{name} {number(value, 0)}{THIN}%" for name, value in free if not isinstance(value, Missing)
    )
    return Picture(
        "inputs",
        title,
        (
            "Left unclipped, as the published law is, the controllers ask for what no machine can give (heat "
            f"below 0, a motor that cools): {shares} of their commands lie outside the limits."
        ),
        columns(sources, recorded, draw),
        (
            f"Command in per cent over the first {span_s:g} s as deployed; grey: "
            "what the machine can give, to "
            "which a command is clipped. A command far outside runs along the edge."
        ),
        page.origin(sources.source("trajectories")),
    )
