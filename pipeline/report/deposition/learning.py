"""The learning of the deposition page: error against trial, commands, flow before
and after, what the camera saw and what it told."""

from collections.abc import Callable
from typing import Any

import numpy as np
from markupsafe import Markup

from pipeline.report.deposition.rules import real
from pipeline.report.shared import charts, page
from pipeline.report.shared.digits import THIN, count, number, percent, short
from pipeline.report.shared.pictures import Column, Picture, hole
from pipeline.report.shared.sources import Sources, Table, lookup
from pipeline.report.shared.verdict import Missing

# law -> head, what it is, class of its line; the order of every row of panels
LAWS = {
    "paper": ("The paper’s law", "nominal model, Q both ways", "mb", "model_based"),
    "ours": ("Ours", "identified model, inverted", "dd", "data_driven"),
    "pixels": ("Ours, through pictures", "flow measured from camera frames", "dd", "kernel"),
}
# more materials than this, and the rest stands in the tables alone
MATERIALS = 4
# commands beyond this many times the steady one run along the edge
REACH = 12.0


def pictures(sources: Sources) -> list[Picture]:
    return [errors(sources), commands(sources), corner(sources)]


def _materials(table: Table) -> list[str]:
    return [str(name) for name in dict.fromkeys(table["material"])][:MATERIALS]


def _laws(table: Table) -> list[str]:
    there = set(table["law"].tolist())
    return [law for law in LAWS if law in there]


def _trial(table: Table, material: str, law: str, trial: int) -> Table:
    """The samples of one trial of the reference routine."""
    rows = (
        (table["material"] == material)
        & (table["law"] == law)
        & (table["routine"] == 0)
        & (table["trial"] == trial)
    )
    return {name: values[rows] for name, values in table.items()}


def _trials(table: Table, material: str, law: str) -> Table:
    rows = (table["material"] == material) & (table["law"] == law) & (table["routine"] == 0)
    return {name: values[rows] for name, values in table.items()}


def _columns(found: list[str], draw: Callable[[str, int], list[Markup]]) -> list[Column]:
    return [Column(*LAWS[law][:2], LAWS[law][3], draw(law, i)) for i, law in enumerate(found)]


# ---- error against trial


def errors(sources: Sources) -> Picture:
    """Both errors after every update, as share of trial 0's."""
    table, title = sources.tables["trials"], "Error after each trial"
    if isinstance(table, Missing):
        return hole("learning-error", title, table)
    materials, laws, machine = _materials(table), _laws(table), real(sources)
    last = max(int(table["trial"].max()), 1)
    y = charts.Axis(0.3, 200.0, ((1.0, "1"), (10.0, "10"), (20.0, "20"), (100.0, "100")), True)
    ends: dict[str, list[str]] = {law: [] for law in laws}

    def draw(law: str, column: int) -> list[Markup]:
        panels = []
        for i, material in enumerate(materials):
            mine = _trials(table, material, law)
            if not len(mine["trial"]):
                continue
            bottom = i == len(materials) - 1
            frame = charts.Frame(
                charts.linear(0, last, ticks=5), y, 368, 150 if bottom else 138, 30, 16 if bottom else 6
            )
            measured = 100 * mine["rms_measured"] / max(float(mine["rms_measured"][0]), 1e-12)
            true = 100 * mine["ratio"]
            best = int(np.argmin(true))
            ends[law].append(f"{material} {percent(float(true[best]), 2)}")
            first = np.flatnonzero(true < 20)
            alt = (
                f"{LAWS[law][0]}, material {material}: {percent(float(true[best]), 2)} of trial 0’s error at "
                f"best, at trial {int(mine['trial'][best])}; "
                + (
                    f"below 20 % from trial {int(mine['trial'][first[0]])}"
                    if len(first)
                    else "never below 20 %"
                )
            )
            layers = [
                charts.level(frame, 20, "lim"),
                charts.level(frame, 10, "lim"),
                *([charts.dots(frame, mine["trial"], measured, "try", 1.8)] if not machine else []),
                charts.line(frame, mine["trial"], true),
                charts.dots(
                    frame, mine["trial"][best : best + 1], true[best : best + 1], f"dot {LAWS[law][2]}", 3
                ),
                charts.label(frame, last, 130, f"material {material}", anchor="end"),
            ]
            panels.append(
                charts.panel(
                    frame,
                    layers,
                    alt=alt,
                    css=LAWS[law][2],
                    title="% of trial 0, log" if column == i == 0 else "",
                    x_ticks=bottom,
                    units=("trials", "%"),
                )
            )
        return panels

    shown = _columns(laws, draw)
    text = "; ".join(f"{LAWS[law][0]} reaches {', '.join(found)}" for law, found in ends.items() if found)
    floor = (
        "Line: error measured from pictures; nobody knows the true flow of a real machine."
        if machine
        else "Line: r.m.s. error of the true flow; grey dots: of the measured one, which ends higher because noise that does not repeat counts in it, and cannot be learned away."
    )
    return Picture(
        "learning-error",
        title,
        f"{text}.",
        shown,
        f"{floor} In % of trial 0’s, log scale, against the trial; the lines at 20 and 10 are the guides. "
        "Filled dot: the best trial.",
        page.origin(sources.source("trials")),
    )


# ---- commands


def commands(sources: Sources) -> Picture:
    """What the plunger is asked for: first, second and last trial."""
    table, title = sources.tables["lessons"], "What the plunger is asked for"
    if isinstance(table, Missing):
        return hole("commands", title, table)
    materials = _materials(table)
    law = next((name for name in ("ours", "pixels") if name in set(table["law"].tolist())), None)
    if law is None:
        return hole("commands", title, Missing("not measured", "no trial of our law is there"))
    last = int(_trials(table, materials[0], law)["trial"].max(initial=0))
    peaks: list[str] = []
    y = charts.Axis(-REACH, REACH, ((-10.0, "−10"), (0.0, "0"), (10.0, "10")))

    def draw(trial: int, column: int) -> list[Markup]:
        panels = []
        for i, material in enumerate(materials):
            first, mine = (_trial(table, material, law, k) for k in (0, trial))
            if not len(mine["time_s"]):
                continue
            steady = float(
                np.median(
                    first["command_mm"][first["wanted_mm3_per_s"] > 0.9 * first["wanted_mm3_per_s"].max()]
                )
            )
            u = mine["command_mm"] / steady
            peak = float(np.abs(u).max())
            if trial == last:
                peaks.append(f"{material} {number(peak, 0)} times")
            bottom = i == len(materials) - 1
            frame = charts.Frame(
                charts.linear(0, float(mine["time_s"][-1]), ticks=5),
                y,
                368,
                132 if bottom else 120,
                30,
                16 if bottom else 6,
            )
            layers = [
                charts.line(frame, mine["time_s"], u, most=500),
                charts.label(
                    frame,
                    float(mine["time_s"][-1]),
                    10,
                    f"material {material}: peak {short(peak, 2)} ×",
                    anchor="end",
                ),
            ]
            alt = f"Trial {trial}, material {material}: the command peaks at {short(peak, 2)} times the steady one"
            panels.append(
                charts.panel(
                    frame,
                    layers,
                    alt=alt,
                    css="dd",
                    title="× steady" if column == i == 0 else "",
                    x_ticks=bottom,
                    units=("s", "×"),
                )
            )
        return panels

    heads = {0: "on\u2011off control", 1: "after one update", last: "the last"}
    shown = [
        Column(f"Trial {trial}", heads[trial], "", draw(trial, i))
        for i, trial in enumerate(dict.fromkeys((0, min(1, last), last)))
    ]
    return Picture(
        "commands",
        title,
        f"At the end the command peaks at {', '.join(peaks)} the steady one: a push at every start, "
        "a pull at every stop. A drive that gives less needs longer ramps.",
        shown,
        "Plunger command of our law, in multiples of the steady command, against time in s. "
        f"Beyond ± {REACH:g} it runs along the edge.",
        page.origin(sources.source("lessons")),
    )


# ---- the corner, before and after


def _pause(one: Table) -> tuple[float, float]:
    """Begin and end of the pause of a routine: the gap in its wanted flow."""
    on = np.flatnonzero(one["wanted_mm3_per_s"] > 0.02 * one["wanted_mm3_per_s"].max())
    gaps = np.flatnonzero(np.diff(on) > 1)
    if not len(gaps):
        middle = float(one["time_s"][on[len(on) // 2]])
        return middle, middle
    return float(one["time_s"][on[gaps[0]]]), float(one["time_s"][on[gaps[0] + 1]])


def corner(sources: Sources) -> Picture:
    """Wanted and true flow around the pause, before and after."""
    table, title = sources.tables["lessons"], "Flow around the corner, before and after learning"
    if isinstance(table, Missing):
        return hole("corner", title, table)
    materials, laws, kind = (
        _materials(table),
        _laws(table),
        "measured_mm3_per_s" if real(sources) else "true_mm3_per_s",
    )
    stories = [("On\u2011off control", "before learning: trial 0", "baseline", "bl", laws[-1], False)]
    stories += [(*LAWS[law][:2], LAWS[law][3], LAWS[law][2], law, True) for law in laws]
    low: dict[str, float] = {}

    def draw(law: str, css: str, after: bool, column: int) -> list[Markup]:
        panels = []
        for i, material in enumerate(materials):
            trials = _trials(table, material, law)["trial"]
            if not len(trials):
                continue
            mine = _trial(table, material, law, int(trials.max()) if after else 0)
            begin, end = _pause(mine)
            near = (mine["time_s"] >= begin - 1.0) & (mine["time_s"] <= end + 1.5)
            t, flow, wanted = mine["time_s"][near] - begin, mine[kind][near], mine["wanted_mm3_per_s"][near]
            top, bottom = 1.45 * float(wanted.max()), i == len(materials) - 1
            frame = charts.Frame(
                charts.linear(-1.0, end - begin + 1.5, ticks=4),
                charts.linear(0, top, ticks=3),
                270,
                128 if bottom else 116,
                26,
                16 if bottom else 6,
            )
            error = 100 * float(np.sqrt(np.nanmean((flow - wanted) ** 2))) / float(wanted.max())
            low[f"{law}{after}"] = max(low.get(f"{law}{after}", 0.0), error)
            alt = f"{'After learning' if after else 'Before learning'}, {LAWS[law][0] if after else 'on-off control'}, material {material}: the flow misses the wanted one by {percent(error, 2)} of a full line, r.m.s."
            layers = [
                charts.line(frame, t, wanted, "ref"),
                charts.line(frame, t, flow),
                charts.label(
                    frame,
                    frame.x.high,
                    top,
                    f"material {material}: {percent(error, 2)} off",
                    anchor="end",
                    dy=8,
                ),
            ]
            panels.append(
                charts.panel(
                    frame,
                    layers,
                    alt=alt,
                    css=css,
                    title="mm³/s" if column == i == 0 else "",
                    x_ticks=bottom,
                    units=("s", "mm³/s"),
                )
            )
        return panels

    shown = [
        Column(head, small, mark, draw(law, css, after, i))
        for i, (head, small, mark, css, law, after) in enumerate(stories)
    ]
    after = [
        f"{LAWS[law][0].lower() if law == 'paper' else LAWS[law][0]} {percent(low[f'{law}True'], 2)}"
        for law in laws
        if f"{law}True" in low
    ]
    before = low.get(f"{laws[-1]}False")
    return Picture(
        "corner",
        title,
        f"Through the corner on\u2011off control misses the wanted flow by {percent(before or 0.0, 2)} of a "
        f"full line; after the last trial: {', '.join(after)}, the worse material each.",
        shown,
        f"{'Measured' if real(sources) else 'True'} flow in mm³/s against time since the gantry’s pause "
        "began, in s; dashed: wanted.",
        page.origin(sources.source("lessons")),
    )


# ---- what the camera saw


def frames(sources: Sources) -> dict[str, Any]:
    """Frames with the measured edges drawn in, and those that were rejected with the reason."""
    found = sources.tables["frames"]
    if isinstance(found, Missing):
        return {"missing": found, "shown": [], "origin": Markup("")}
    # the corner tells most, then what was rejected
    order = {"start": 0, "steady line": 1, "corner": 2, "rejected": 3}
    rows = sorted(found, key=lambda one: (one["material"], one["trial"], order.get(one["place"], 9)))
    shown = [
        {
            "uri": Markup("{}").format(one["uri"]),
            "head": f"Material {one['material']}, trial {one['trial']}, {one['place']}",
            "figure": f"rejected: {one['reason']}"
            if one["reason"]
            else f"{number(one['width_mm'], 3)}{THIN}mm wide",
            "bad": bool(one["reason"]),
            "foot": (one["recording"], f"{one['topic']} at {number(one['time_s'], 2)}{THIN}s"),
            "alt": (
                f"Frame of material {one['material']}, trial {one['trial']}, "
                f"at {number(one['time_s'], 2)} s, "
                + (
                    f"rejected: {one['reason']}"
                    if one["reason"]
                    else f"the bead’s edges found, {number(one['width_mm'], 3)} mm apart"
                )
            ),
        }
        for one in rows
    ]
    return {"missing": None, "shown": shown, "origin": page.origin(sources.source("frames"))}


def measured(sources: Sources) -> Picture:
    """The flow that pictures told, with its band, against the true one."""
    table, film, title = (
        sources.tables["lessons"],
        sources.tables["filmed"],
        "The flow that the pictures told",
    )
    for found in (table, film):
        if isinstance(found, Missing):
            return hole("told", title, found)
    if "pixels" not in _laws(table):
        return hole(
            "told", title, Missing("not measured", "no trial was filmed", "Run ./run dvc repro train_ilc")
        )
    materials, machine = _materials(table), real(sources)

    def draw(material: str, column: int) -> list[Markup]:
        last = int(_trials(table, material, "pixels")["trial"].max(initial=0))
        panels = []
        for trial in dict.fromkeys((0, last)):
            mine = _trial(table, material, "pixels", trial)
            here = (film["material"] == material) & (film["routine"] == 0) & (film["trial"] == trial)
            if len(mine["time_s"]) and here.any():
                panels += _told(
                    mine,
                    1.645 * float(film["deviation_mm3_per_s"][here][0]),
                    f"Material {material}, trial {trial}",
                    machine,
                    titled=column == 0 and not panels,
                )
        return panels

    shown = [
        Column(f"Material {material}", "first and last filmed trial", "", draw(material, i))
        for i, material in enumerate(materials)
    ]
    figures = [
        f"{name} {percent(float(whole), 2)}, around the corner {percent(float(near), 2)}"
        for name, one in (
            sources.metrics["train_ilc"] if isinstance(sources.metrics["train_ilc"], dict) else {}
        ).items()
        if not isinstance(whole := lookup(one, "pixels.flow_error_percent"), Missing)
        and not isinstance(near := lookup(one, "pixels.flow_error_corner_percent"), Missing)
    ]
    finding = (
        f"Over all trials the measured flow is off by, r.m.s. of a full line’s: {'; '.join(figures)}. "
        f"At most 2.5{THIN}% and 6{THIN}% are asked for."
        if figures
        else "No true flow to compare with: the machine is a real one."
    )
    return Picture(
        "told",
        title,
        finding,
        shown,
        "Measured flow in mm³/s against time in "
        f"s{'' if machine else '; below it measured less true, in % of a full line’s flow, with the band in which 90 % of the measurement’s own uncertainty lies. The camera rightly sees what does not repeat from trial to trial, too; the true flow here is without it'}. "
        "Grey: the gantry stands, only the volume of the pause is seen, and nothing is learned there.",
        page.origin(sources.source("lessons", "filmed")),
    )


def _told(mine: Table, wide: float, name: str, machine: bool, *, titled: bool) -> list[Markup]:
    """The measured flow of a trial, and, where it is known, its distance
    from the true one with the band of its uncertainty."""
    t, seen, true, steady = (
        mine["time_s"],
        mine["measured_mm3_per_s"],
        mine["true_mm3_per_s"],
        float(mine["wanted_mm3_per_s"].max()),
    )
    frame = charts.Frame(
        charts.linear(0, float(t[-1]), ticks=5),
        charts.linear(0, 1.4 * steady, ticks=3),
        568,
        112,
        28,
        6 if not machine else 16,
    )
    blind = [(float(t[a]), float(t[min(b, len(t) - 1)])) for a, b in charts.stretches(np.isnan(seen))]
    alt = f"{name}: the flow as measured, between {number(float(np.nanmin(seen)), 1)} and {number(float(np.nanmax(seen)), 1)} mm³/s; standard deviation {short(wide / 1.645, 2)}"
    text = charts.label(frame, float(t[-1]), 1.4 * steady, name, anchor="end", dy=6)
    layers = [
        *(charts.interval(frame, *stretch) for stretch in blind),
        charts.line(frame, t, seen, most=400),
        text,
    ]
    panels = [
        charts.panel(
            frame,
            layers,
            alt=alt,
            css="dd wide",
            title="mm³/s" if titled else "",
            x_ticks=machine,
            units=("s", "mm³/s"),
        )
    ]
    if machine:
        return panels
    error, band = 100 * (seen - true) / steady, 100 * wide / steady
    off = float(np.sqrt(np.nanmean(error**2)))
    frame = charts.Frame(
        frame.x, charts.Axis(-12.0, 12.0, ((-10.0, "−10"), (0.0, "0"), (10.0, "10"))), 568, 84, 28
    )
    text = charts.label(
        frame, float(t[-1]), 12, f"measured less true: {percent(off, 2)}, r.m.s.", anchor="end", dy=6
    )
    layers = [charts.tint(frame, -band, band), charts.line(frame, t, error, "line thin", most=400), text]
    alt = f"{name}: measured less true is {percent(off, 2)} of a full line’s flow, r.m.s., of which its own uncertainty explains ±{percent(band, 2)}"
    return [
        *panels,
        charts.panel(frame, layers, alt=alt, css="dd wide", title="%" if titled else "", units=("s", "%")),
    ]


def camera(sources: Sources) -> dict[str, Any]:
    """By material: frames read and rejected, uncertainty, and what the calibration left."""
    film, models = sources.tables["filmed"], sources.tables["models"]
    if isinstance(film, Missing):
        return {"missing": film, "rows": []}
    rows = []
    for material in dict.fromkeys(film["material"]):
        mine = film["material"] == material
        reasons: dict[str, int] = {}
        for text in film["reasons"][mine]:
            for item in filter(None, str(text).split(", ")):
                name, _, n = item.rpartition(" ")
                reasons[name] = reasons.get(name, 0) + int(n) if n.isdigit() else 1
        known = (
            lookup(models, f"{material}.calibration")
            if "." not in str(material)
            else Missing("not measured", "")
        )
        frames_, rejected = int(film["frames"][mine].sum()), int(film["rejected"][mine].sum())
        rows.append(
            {
                "material": str(material),
                "trials": count(int(mine.sum()), "trial"),
                "frames": number(frames_, 0),
                "rejected": f"{number(rejected, 0)} ({percent(100 * rejected / max(frames_, 1), 2)})",
                "why": ", ".join(f"{name} {number(n, 0)}" for name, n in sorted(reasons.items())) or "none",
                "deviation": f"{short(1000 * float(np.median(film['deviation_mm3_per_s'][mine])), 2)}{THIN}·10⁻³ mm³/s",
                "seen": percent(100 * float(np.mean(film["observable"][mine])), 3),
                "outliers": number(int(film["outliers"][mine].sum()), 0),
                "calibration": "as recorded"
                if isinstance(known, Missing)
                else f"{number(1000 * known['gain'], 3)}{THIN}µm/px, residual {number(1000 * known['deviation'], 2)}{THIN}µm ({number(known['deviation'] / known['gain'], 2)}{THIN}px)",
            }
        )
    return {"missing": None, "rows": rows}
