"""The parts of the deposition page: each one coloured by its flow error, the flow of every composer over its
worst stretch, its lines, what limits it, and what was refused."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from pipeline.deposition.controllers import COMPOSERS
from pipeline.report.shared import charts, page
from pipeline.report.shared.pictures import Picture, PictureColumn, as_picture, as_table, placeholder
from pipeline.report.shared.sources import Sources
from pipeline.verdict.deposition import (
    BASELINE,
    NAMES,
    NOT_JUDGED,
    OURS,
    REFERENCE,
    asked_of_the_drive,
    data_driven,
    pair_sentence,
    structures,
    unknown_streams,
)
from pipeline.verdict.digits import THIN, count, percent, short
from pipeline.verdict.evidence import Absent, Table, entry, instead, known, need
from pipeline.verdict.verdict import Missing

# parts and streams that are drawn; the others stand in the tables
PARTS, STREAMS = 4, 8
# share of the steady flow above which the nozzle prints; of it that is
# neither too little nor too much, and that is much
PRINTING, RIGHT, FAR = 0.2, 0.03, 0.10
STRETCH_S, WORST, REFUSED = 4.0, 10, 20
# ticks of an axis of prints
TICKS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0)
# places of a part that are drawn: of a longer one the worst of each stretch
POINTS = 4000
CLASSES = (
    ("far less", "lack2"),
    ("less", "lack1"),
    ("right", "right"),
    ("more", "over1"),
    ("far more", "over2"),
)


def _streams(table: Table) -> list[tuple[str, str]]:
    """(part, material) in the order of the table."""
    return list(dict.fromkeys(zip(table["part"].tolist(), table["material"].tolist(), strict=True)))


def _judged(sources: Sources, name: str) -> Table:
    """The rows of a table of forecasts whose stream is simulated or judged: no other has a figure."""
    table, unknown = sources.tables[name], unknown_streams(sources.evidence)
    if not unknown:
        return need(table)
    tools = {one["tool"]: one["name"] for one in sources.declared.everything["printer"]["materials"]}
    materials = [tools.get(tool) for tool in need(table)["tool"].tolist()]
    streams = zip(table["part"].tolist(), materials, strict=True)
    rows = np.array([stream not in unknown for stream in streams])
    if not rows.any():
        raise Absent(Missing(NOT_JUDGED, "The verdict says which trial judges it"))
    return {column: values[rows] for column, values in need(table).items()}


# ---- the picture of a part


@instead(lambda gap: [placeholder("maps", "The parts, coloured by flow error", gap)])
def maps(sources: Sources) -> list[Picture]:
    """Every part from above, coloured by the error of the flow where it prints."""
    table = _judged(sources, "signals")
    parts = list(dict.fromkeys(table["part"].tolist()))
    return [
        _map(sources, table, str(part), i, last=part == parts[:PARTS][-1])
        for i, part in enumerate(parts[:PARTS])
    ]


def _library(sources: Sources) -> str:
    """The library's better rule, which answers for data-driven composers."""
    return data_driven(known(structures(sources.evidence), []))


def _map(sources: Sources, table: Table, part: str, i: int, *, last: bool) -> Picture:
    rows = table["part"] == part
    mine = {name: values[rows] for name, values in table.items()}
    wanted = mine["wanted_mm3_per_s"]
    steady = float(wanted.max()) or 1.0
    prints = wanted > PRINTING * steady
    shown, shares = [], []
    for name in (_library(sources), OURS, BASELINE):
        error = (mine[f"{name}_mm3_per_s"] - wanted) / steady
        right = 100 * float(np.mean(np.abs(error[prints]) <= RIGHT)) if prints.any() else 0.0
        lack = 100 * float(np.mean(error[prints] < -RIGHT)) if prints.any() else 0.0
        shares.append(f"{NAMES[name]} {percent(right, 2)}")
        alt = (
            f"{NAMES[name]}, {part}: {percent(right, 2)} of the printing time within {100 * RIGHT:g} % of a "
            f"full line’s flow, {percent(lack, 2)} with less, "
            f"{percent(max(100 - right - lack, 0.0), 2)} with more"
        )
        panel = _drawn(mine, error, prints, alt)
        shown.append(PictureColumn(NAMES[name], PAPER[name], MARK[name], [panel, _shares(error[prints])]))
    return Picture(
        f"Share of the printing time within ±{100 * RIGHT:g}{THIN}% of a full line’s flow: "
        f"{', '.join(shares)}.",
        shown,
        ""
        if not last
        else "The nozzle’s path from above where it should print, in mm. "
        "Brown, broken: too little; teal, thick: too much; grey: right. Dashes and light beyond "
        f"±{100 * RIGHT:g}{THIN}%, dots and dark beyond ±{100 * FAR:g}{THIN}% of a full line’s flow; "
        "of a long part the worst of each stretch. "
        f"{'Forecast.' if real(sources) else 'True flow of the simulated machine.'}",
        page.origin(sources.source("signals"), part=part, y=lines_of((_library(sources), OURS, BASELINE))),
        f"part-{i}",
        part,
    )


def _classes(error: np.ndarray) -> np.ndarray:
    return np.searchsorted([-FAR, -RIGHT, RIGHT, FAR], error)


def _shares(error: np.ndarray) -> Markup:
    """The legend of a map: how much of the time is of each class."""
    shares = np.bincount(_classes(error), minlength=5) / max(len(error), 1)
    items = [
        Markup(
            '<span><svg class="key" aria-hidden="true" viewBox="0 0 18 8"><path class="{}" d="M1 '
            '4H17"/></svg>{} {}</span>'
        ).format(css, word, percent(100 * float(share), 2))
        for (word, css), share in zip(CLASSES, shares, strict=True)
        if share > 0
    ]
    return Markup('<div class="keys">{}</div>').format(Markup("").join(items))


def _drawn(mine: Table, error: np.ndarray, prints: np.ndarray, alt: str) -> Markup:
    """Paths of one class each, in a view of fixed width whose units are a third of a pixel."""
    at, classes, prints = _thinned(error, prints)
    x, y, tool = (mine[name][at] for name in ("x_mm", "y_mm", "tool"))
    here = prints if prints.any() else np.ones(len(x), bool)
    left, right, low, high = x[here].min(), x[here].max(), y[here].min(), y[here].max()
    span = max(right - left, high - low, 1e-6)
    width, room = 360.0, 12.0
    scale = min((width - 2 * room) / max(right - left, 1e-6), 230.0 / max(high - low, 1e-6))
    height = max(scale * (high - low), 12.0) + 2 * room + 14
    px = (width - scale * (right - left)) / 2 + scale * (x - left)
    py = room + scale * (high - y)
    kind = np.where(prints, classes, -1)
    # a line changes its pen with the class, the tool, and where it does not print
    change = (
        np.flatnonzero(
            (np.diff(kind) != 0)
            | (np.diff(tool) != 0)
            | (np.hypot(np.diff(px), np.diff(py)) > 0.2 * scale * span + 2)
        )
        + 1
    )
    paths: dict[int, list[str]] = {}
    for piece in np.split(np.arange(len(kind)), change):
        if kind[piece[0]] >= 0:
            # up to the next piece's first sample where that prints too, so that no gap is left
            end = piece[-1] + 1
            joined = (
                np.append(piece, end)
                if end < len(kind)
                and kind[end] >= 0
                and abs(px[end] - px[end - 1]) + abs(py[end] - py[end - 1]) < 8
                else piece
            )
            paths.setdefault(int(kind[piece[0]]), []).append(_path(px[joined], py[joined]))
    layers = [
        Markup('<path class="{}" d="{}"/>').format(CLASSES[k][1], "".join(paths[k]))
        for k in (2, 1, 3, 0, 4)
        if k in paths
    ]
    bar = _round(span / 4)
    start = f"{room:.0f}", f"{height - 5:.0f}", f"{scale * bar:.1f}"
    # the script draws another round length where a part of the map is seen
    ruler = Markup(
        '<path class="ruler" data-at="{} {} {}" data-mm="{:g}" d="M{} {}h{}"/><text x="{}" y="{}">{} mm'
        "</text>"
    ).format(*start, bar, *start, f"{room + scale * bar + 5:.1f}", f"{height - 1:.0f}", short(bar, 2))
    size = f"{width:.0f}", f"{height:.0f}"
    return Markup(
        '<svg class="plot map" style="--w:{}px" viewBox="0 0 {} {}" role="img" aria-label="{}">{}{}</svg>'
    ).format(size[0], *size, alt, Markup("").join(layers), ruler)


def _thinned(error: np.ndarray, prints: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of at most POINTS stretches the number of the first sample that prints, the class of
    the worst error, and whether any sample prints."""
    size = -(-len(error) // POINTS)
    pad = -len(error) % size
    some = np.append(prints, np.zeros(pad, bool)).reshape(-1, size)
    errors = np.where(some, np.append(error, np.zeros(pad)).reshape(-1, size), 0.0)
    each = np.arange(len(some))
    return (
        each * size + some.argmax(axis=1),
        _classes(errors[each, np.abs(errors).argmax(axis=1)]),
        some.any(axis=1),
    )


def _round(value: float) -> float:
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(f * power for f in (1, 2, 5) if f * power <= value))


def _path(px: np.ndarray, py: np.ndarray) -> str:
    """Points less than a pixel from the one before are left out, the ends never."""
    points = [0]
    for i in range(1, len(px)):
        if abs(px[i] - px[points[-1]]) + abs(py[i] - py[points[-1]]) >= 1.2:
            points.append(i)
    points += [len(px) - 1] if points[-1] != len(px) - 1 or len(points) == 1 else []
    return "M" + "L".join(f"{px[i]:.1f} {py[i]:.1f}" for i in points)


# ---- the worst stretch


@as_picture("stretches", "Flow where the chosen signal errs most")
def stretches(sources: Sources) -> Picture:
    """Wanted flow and that of every composer where the chosen one errs most, a row for each stream."""
    table, parts = _judged(sources, "signals"), known(structures(sources.evidence), [])
    chosen = {(one.part, one.material): one.chosen for one in parts if one.chosen}
    streams = _streams(table)[:STREAMS]
    errors = {stream: _errors(table, *stream, chosen.get(stream, "basis")) for stream in streams}
    shown_first = (OURS, _library(sources), REFERENCE, BASELINE)
    names = [name for name in shown_first if any(name in off for _, off in errors.values())]
    columns = []
    for (part, material), (rows, off) in errors.items():
        told = ", ".join(
            f"{NAMES[name].lower()} {percent(off.get(name, 0.0), 2)}"
            f"{' (chosen)' * (name == chosen.get((part, material), 'basis'))}"
            for name in names
        )
        alt = f"{part}, {material}: off the wanted flow, in % of a full line’s: {told}"
        near = {key: values[rows] for key, values in table.items()}
        columns.append(
            PictureColumn(f"{part}, {material}", "", "", [draw_flows(near, names, alt, (566, 212))])
        )
    worst = {name: max(off.get(name, 0.0) for _, off in errors.values()) for name in names}
    return Picture(
        f"In its worst {STRETCH_S:g}{THIN}s, of any structure, the flow is off by at most: "
        f"{', '.join(f'{NAMES[name]} {percent(off, 2)}' for name, off in worst.items())} of "
        "a full line’s, r.m.s.",
        columns,
        f"{'Forecast' if real(sources) else 'True'} flow in mm³/s against time in s, "
        f"the {STRETCH_S:g} s around the largest error of the signal that was chosen: " + flow_key(names),
        page.origin(sources.source("signals"), y=lines_of(names)),
    )


def _errors(table: Table, part: str, material: str, chosen: str) -> tuple[np.ndarray, dict[str, float]]:
    """Rows of the stretch about the largest error of the chosen composer, and the r.m.s. error there of every
    one whose flow is known, in % of the steady flow."""
    rows = around_worst(table, part, material, chosen, STRETCH_S)
    stream = (table["part"] == part) & (table["material"] == material)
    steady = float(table["wanted_mm3_per_s"][stream].max()) or 1.0
    flows = {name: table[f"{name}_mm3_per_s"][rows] for name in NAMES if f"{name}_mm3_per_s" in table}
    off = {name: flow - table["wanted_mm3_per_s"][rows] for name, flow in flows.items()}
    return rows, {
        name: 100 * float(np.sqrt(np.nanmean(error**2))) / steady
        for name, error in off.items()
        if np.isfinite(error).any()
    }


def around_worst(table: Table, part: str, material: str, name: str, seconds: float) -> np.ndarray:
    """Rows of a stream within so many seconds about where the composer's flow is furthest from the wanted."""
    mine = np.flatnonzero((table["part"] == part) & (table["material"] == material))
    if not len(mine):
        return mine
    off = np.abs(np.nan_to_num(table[f"{name}_mm3_per_s"][mine]) - table["wanted_mm3_per_s"][mine])
    time = table["time_s"][mine]
    begin, end, middle = time.min(), time.max(), time[int(np.argmax(off))]
    start = min(max(middle - seconds / 2, begin), max(end - seconds, begin))
    return mine[(time >= start) & (time <= start + seconds)]


def lines_of(names: Sequence[str]) -> list[str]:
    """The wanted flow and that of these composers, as the table of signals calls them."""
    return [f"{name}_mm3_per_s" for name in ("wanted", *names)]


def flow_key(names: Sequence[str]) -> Markup:
    """Which line is whose in `draw_flows`."""
    return page.line_key([("wanted", "want"), *((NAMES[name].lower(), LINE[name]) for name in names)])


def draw_flows(
    table: Mapping[str, np.ndarray], names: Sequence[str], alt: str, size: tuple[int, int]
) -> Markup:
    """Flow of the composers over one another, and the wanted one."""
    flows = {name: table[f"{name}_mm3_per_s"] for name in ("wanted", *names)}
    finite = np.concatenate([values[np.isfinite(values)] for values in flows.values()])
    room = 0.06 * float(np.ptp(finite)) or 1.0
    time = table["time_s"]
    frame = charts.Frame(
        charts.linear(float(time[0]), float(time[-1])),
        charts.linear(float(finite.min()) - room, float(finite.max()) + room),
        *size, 40, 34, 22, 14,
    )  # fmt: skip
    layers = [charts.line(frame, time, flows["wanted"], "want", most=120)]
    layers += [charts.line(frame, time, flows[name], LINE[name], most=120) for name in names]
    return charts.panel(
        frame, layers, alt=alt, css="mb lead-picture", title="flow, mm³/s", across="time, s",
        units=("s", "mm³/s"),
    )  # fmt: skip


# ---- by the prints that were learned from


@as_picture("by-prints", "Model-based or data-driven, by prints spent")
def by_prints(sources: Sources) -> Picture:
    """Flow error of the composers over one another by the prints that each had learned from."""
    table = need(sources.tables["prints"])
    names = (OURS, _library(sources), REFERENCE, "pressure_advance_lead")
    frame = pd.DataFrame(table)
    drawn = [name for name in names if name in set(frame.composer)]
    columns = [
        PictureColumn(f"{part}, material {material}", "", "", [_spent_panel(rows, drawn, sources)])
        for part, material in _streams(table)[:STREAMS]
        for rows in [frame[(frame.part == part) & (frame.material == material)]]
    ]
    if not columns:
        raise Absent(Missing("not measured", "No simulated machine tells it"))
    key = page.line_key([*((NAMES[name].lower(), LINE[name]) for name in drawn), ("limit", "lim")])
    return Picture(
        pair_sentence(sources.evidence).note,
        columns,
        key
        + ". Flow error in % of on\u2011off control’s against prints, both log scale. Prints are those of "
        f"training routines of the material, and for “{NAMES[REFERENCE].lower()}” those of the part itself.",
        page.origin(sources.source("prints")),
    )


def _spent_panel(rows: pd.DataFrame, names: Sequence[str], sources: Sources) -> Markup:
    """The composers of one stream."""
    limit = sources.declared.rules.flow_error_percent
    errors, most = rows.rms_percent_of_on_off.clip(lower=0.1), max(float(rows.prints.max()), 2.0)
    frame = charts.Frame(
        charts.Axis(1.0, most, tuple((tick, f"{tick:g}") for tick in TICKS if tick <= most), True),
        charts.Axis(
            float(min(errors.min() * 0.8, limit)), float(max(errors.max() * 1.3, 100.0)),
            ((1.0, "1"), (limit, f"{limit:g}"), (30.0, "30"), (100.0, "100")), True,
        ),
        368, 190, 34, 34, 22, 30,
    )  # fmt: skip
    layers, ends = [charts.level(frame, limit, "lim")], []
    for name in names:
        mine = rows[rows.composer == name].sort_values("prints")
        if mine.empty:
            continue
        x, y = mine.prints.to_numpy(float), mine.rms_percent_of_on_off.to_numpy(float)
        layers.append(charts.line(frame, x, y, LINE[name]))
        ends.append(f"{NAMES[name]} {percent(float(y[-1]), 2)} after {int(x[-1])}")
    return charts.panel(
        frame, layers, alt=f"Flow error by prints: {', '.join(ends)}", css="mb lead-picture",
        title="% of on-off’s, log", across="prints", units=("prints", "%"),
    )  # fmt: skip


# ---- the lines


@as_table()
def lines(sources: Sources) -> dict[str, Any]:
    """The lines that are furthest from their volume, the worst first."""
    table = _judged(sources, "lines")
    allowed = sources.declared.rules.line_volume_percent
    printed = pd.DataFrame(table).fillna({"error_percent": 0.0})
    off = printed.error_percent.abs()
    return {
        "rows": printed.loc[off.nlargest(WORST).index].to_dict("records"),
        "of": len(printed),
        "beyond": int((off > allowed).sum()),
        "short": int(printed.shorter_than_lead.sum()),
    }


# ---- what limits a part, and what was refused


@as_table()
def forecasts(sources: Sources) -> dict[str, Any]:
    """By part and material: composer, saturation and the ramp that would do, and lines that need a look."""
    conformance = need(sources.tables["conformance"])
    unknown, parts = unknown_streams(sources.evidence), known(structures(sources.evidence), [])
    # the verdict gives the reason of the first; here it would stand again
    said = next((part.why for part in parts if part.unknown()), "")
    rows = [
        {
            "part": part,
            "material": material,
            "report": report,
            "drive": drive,
            "asked": asked_of_the_drive(part, material, drive),
            "unknown": (part, material) in unknown,
            "forecast": entry(report, "forecast", material),
            "composer": entry(report, "composer", material) or "",
            "ramp": entry(report, "ramp_that_would_do_s", material),
        }
        for part, report in conformance.items()
        for material, drive in report.get("saturation", {}).items()
    ]
    return {"rows": rows, "said": said}


@as_table()
def extruded(sources: Sources) -> dict[str, Any]:
    """By part and tool the volume that E asks for beside the declared bead's, or why E does not count."""
    conformance = need(sources.tables["conformance"])
    told = [(part, report["program"]) for part, report in conformance.items() if "program" in report]
    if not told:
        earlier = "the conformance report is of an earlier version"
        raise Absent(Missing("not measured", earlier, "Run ./run dvc repro compose_parts"))
    rows, shares = [], []
    for part, program in told:
        found = {f"T{one['tool']}": one for one in program["e_beside_declared_bead"]}
        rows += [(part, tool, source, found.get(tool)) for tool, source in program["volumes"].items()]
        shares += [one["by_e_mm3"] / one["declared_mm3"] for one in found.values() if one["declared_mm3"] > 0]
    return {"rows": rows, "shares": shares}


@as_table()
def refused(sources: Sources) -> dict[str, Any]:
    """Lines and whole parts that were refused, each with its sentence."""
    conformance = need(sources.tables["conformance"])
    rows = []
    for part, report in conformance.items():
        why = report.get("refused", [])
        rows += (
            [{"part": part, "where": "whole", "why": why}]
            if isinstance(why, str)
            else [{"part": part, "where": f"line {line['line']}", "why": str(line["why"])} for line in why]
        )
    unknown = [
        f"{part}: {count(report['unknown_words'], 'word')}"
        for part, report in conformance.items()
        if report.get("unknown_words")
    ]
    return {"rows": rows[:REFUSED], "more": max(len(rows) - REFUSED, 0), "unknown": ", ".join(unknown)}


# what stands below a heading
PAPER = {row.name: row.explanation for row in COMPOSERS}
# marks of the other pages by kind, the second of a kind hollow: circle data-driven, square model-based and
# the reference, ring on-off control, a shape of its own every other baseline
_MARKS = {
    "model-based": ("model_based", "exact_model"),
    "data-driven": ("data_driven", "kernel"),
    "baseline": ("baseline", "triangle", "diamond"),
    "reference": ("exact_model",),
}
_OF_KIND = {kind: [row.name for row in COMPOSERS if row.kind == kind] for kind in _MARKS}
MARK = {row.name: _MARKS[row.kind][_OF_KIND[row.kind].index(row.name)] for row in COMPOSERS}
KIND = {row.name: row.kind for row in COMPOSERS}
# of composers that are drawn over one another; of the data-driven ones blue
LINE = {
    "basis": "line",
    "priority": "line dd",
    "superposition": "line dd dash",
    "pressure_advance": "line bl dash",
    "pressure_advance_lead": "line bl dash",
    "on_off": "line bl",
    "ilc": "line dd dots",
}
# what the two columns of its rules are, the mark of the second and that of the first
HEADS = ("Model\u2011based", "Data\u2011driven", "data_driven", "model_based")


def real(sources: Sources) -> bool:
    """Whether the trials are a machine's own, so that nobody knows its true flow."""
    return sources.evidence.recorded("train_ilc")
