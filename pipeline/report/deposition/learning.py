"""The learning of the deposition page: error against trial, commands, flow before
and after, what the camera saw and what was measured from it."""

from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from pipeline.report.deposition.parts import real
from pipeline.report.shared import charts, page
from pipeline.report.shared.pictures import Picture, PictureColumn, as_picture, as_table
from pipeline.report.shared.sources import Sources, first_routine
from pipeline.verdict.digits import THIN, number, percent, short
from pipeline.verdict.evidence import Absent, Table, entry, known, lookup, need
from pipeline.verdict.verdict import Missing

# law -> head, what it is, class of its line; the order of every row of panels
LAWS = {
    "hoelzle_2009": ("The paper’s law", "nominal model, Q both ways", "mb", "model_based"),
    "model_inverse": ("Model inversion", "identified model, inverted", "dd", "data_driven"),
    "pixels": ("Model inversion through pictures", "flow measured from camera frames", "dd", "kernel"),
}
# more materials than this, and the rest stands in the tables alone
MATERIALS = 4


def _materials(table: Table) -> list[str]:
    return [str(name) for name in dict.fromkeys(table["material"])][:MATERIALS]


def _laws(table: Table) -> list[str]:
    there = set(table["law"].tolist())
    return [law for law in LAWS if law in there]


def _rows(table: Table, material: str, law: str, trial: int | None = None) -> Table:
    """The rows of a law on a material, of one trial or of all."""
    rows = (table["material"] == material) & (table["law"] == law)
    rows &= True if trial is None else table["trial"] == trial
    return {name: values[rows] for name, values in table.items()}


# ---- error against trial


@as_picture("learning-error", "Error after each trial")
def errors(sources: Sources) -> Picture:
    """Both errors after every update, as share of trial 0's."""
    table = need(first_routine(sources.tables["trials"]))
    materials, laws, machine = _materials(table), _laws(table), real(sources)
    last = max(int(table["trial"].max()), 1)
    curves = {law: {name: _rows(table, name, law) for name in materials} for law in laws}
    curves = {
        law: {name: mine for name, mine in of_law.items() if len(mine["trial"])}
        for law, of_law in curves.items()
    }

    def draw(law: str, column: int) -> list[Markup]:
        return [
            _error_panel(
                curves[law][material],
                law,
                material,
                last,
                machine,
                column == i == 0,
                i == len(materials) - 1,
                _restarts(sources, law, material),
            )
            for i, material in enumerate(materials)
            if material in curves[law]
        ]

    shown = [PictureColumn(*LAWS[law][:2], LAWS[law][3], draw(law, i)) for i, law in enumerate(laws)]
    text = "; ".join(
        f"{LAWS[law][0]} ends at {', '.join(_ends(sources, law, of_law))}"
        for law, of_law in curves.items()
        if of_law
    )
    floor = (
        "Line: error measured from pictures; nobody knows the true flow of a real machine."
        if machine
        else "Line: r.m.s. error of the true flow; grey dots: of the measured one, which ends higher because "
        "noise that does not repeat counts in it, and cannot be learned away."
    )
    return Picture(
        f"{text}.{_changes(sources, curves)}",
        shown,
        f"{floor} In % of trial 0’s, log scale, against the trial; the lines at 20 and 10 are the guides. "
        "Filled dot: the best trial of the machine as it is now.",
        page.origin(sources.source("trials")),
    )


def _restarts(sources: Sources, law: str, material: str) -> list[int]:
    """The trials at which a machine was found changed on the shown routine; none in metrics of before."""
    of_law = known(sources.metrics["train_ilc"], {}).get(material, {}).get(law, {})
    return [int(trial) for trial in of_law.get("restarts", [])]


def _now(mine: Table, restarts: list[int]) -> np.ndarray:
    """Which rows are of the machine as it is now."""
    return mine["trial"] >= (restarts[-1] if restarts else 0)


def _ends(sources: Sources, law: str, of_law: dict[str, Table]) -> list[str]:
    """The last error of each material, and the best where it differs."""
    texts = []
    for material, mine in of_law.items():
        now = 100 * mine["ratio"][_now(mine, _restarts(sources, law, material))]
        last, best = percent(float(now[-1]), 2), percent(float(now.min()), 2)
        texts.append(f"{material} {last}" + ("" if last == best else f" (best {best})"))
    return texts


def _changes(sources: Sources, curves: dict[str, dict[str, Table]]) -> str:
    """Where a machine was found changed, a sentence each."""
    return "".join(
        f" {LAWS[law][0]}, material {material}: the machine changed at trial "
        f"{', '.join(str(trial) for trial in restarts)}, and was learned anew."
        for law, of_law in curves.items()
        for material in of_law
        if (restarts := _restarts(sources, law, material))
    )


def _error_panel(
    mine: Table,
    law: str,
    material: str,
    last: int,
    machine: bool,
    titled: bool,
    bottom: bool,
    restarts: list[int],
) -> Markup:
    """Errors of one law on one material against the trial."""
    name, css = LAWS[law][0], LAWS[law][2]
    y = charts.Axis(0.3, 200.0, ((1.0, "1"), (10.0, "10"), (20.0, "20"), (100.0, "100")), True)
    frame = charts.Frame(
        charts.linear(0, last, ticks=5), y, 368, 150 if bottom else 138, 30, 16 if bottom else 6
    )
    trial, true = mine["trial"], 100 * mine["ratio"]
    measured = 100 * mine["rms_measured"] / max(float(mine["rms_measured"][0]), 1e-12)
    best = int(np.argmin(np.where(_now(mine, restarts), true, np.inf)))
    below = np.flatnonzero(true < 20)
    since = f"below 20 % from trial {int(trial[below[0]])}" if len(below) else "never below 20 %"
    changed = f"; the machine changed at trial {', '.join(map(str, restarts))}" if restarts else ""
    layers = [
        *(charts.interval(frame, at - 0.15, at + 0.15) for at in restarts),
        charts.level(frame, 20, "lim"),
        charts.level(frame, 10, "lim"),
        *([charts.dots(frame, trial, measured, "try", 1.8)] if not machine else []),
        charts.line(frame, trial, true),
        charts.dots(frame, trial[best : best + 1], true[best : best + 1], f"dot {css}", 3),
        charts.label(frame, last, 130, f"material {material}", anchor="end"),
    ]
    return charts.panel(
        frame,
        layers,
        alt=f"{name}, material {material}: {percent(float(true[best]), 2)} of trial 0’s error at "
        f"best, at trial {int(trial[best])}; {percent(float(true[-1]), 2)} at the last; {since}{changed}",
        css=css,
        title="% of trial 0, log" if titled else "",
        x_ticks=bottom,
        units=("trials", "%"),
    )


# ---- what the camera saw


@as_table()
def frames(sources: Sources) -> dict[str, Any]:
    """Frames with the measured edges drawn in, and those that were rejected with the reason."""
    pictures = need(sources.tables["frames"])
    # the corner tells most, then what was rejected
    order = {"start": 0, "steady line": 1, "corner": 2, "rejected": 3}
    rows = sorted(pictures, key=lambda row: (row["material"], row["trial"], order.get(row["place"], 9)))
    return {"shown": rows, "origin": page.origin(sources.source("frames"))}


@as_picture("told", "The flow that the pictures told")
def measured(sources: Sources) -> Picture:
    """The flow measured from pictures, with its band, against the true one."""
    table, filmed = need(sources.tables["lessons"]), need(first_routine(sources.tables["filmed"]))
    if "pixels" not in _laws(table):
        raise Absent(Missing("not measured", "no trial was filmed", "Run ./run dvc repro train_ilc"))
    materials, machine = _materials(table), real(sources)

    def draw(material: str, column: int) -> list[Markup]:
        last = int(_rows(table, material, "pixels")["trial"].max(initial=0))
        panels = []
        for trial in dict.fromkeys((0, last)):
            mine = _rows(table, material, "pixels", trial)
            here = (filmed["material"] == material) & (filmed["trial"] == trial)
            if len(mine["time_s"]) and here.any():
                panels += _measured_panels(
                    mine,
                    1.645 * float(filmed["deviation_mm3_per_s"][here][0]),
                    f"Material {material}, trial {trial}",
                    machine,
                    titled=column == 0 and not panels,
                )
        return panels

    shown = [
        PictureColumn(f"Material {material}", "first and last filmed trial", "", draw(material, i))
        for i, material in enumerate(materials)
    ]
    below = (
        ""
        if machine
        else "; below it measured less true, in % of a full line’s flow, with the band in which 90 % of the "
        "measurement’s own uncertainty lies. The camera rightly sees what does not repeat from trial to "
        "trial, too; the true flow here is without it"
    )
    return Picture(
        _flow_error(sources),
        shown,
        f"Measured flow in mm³/s against time in s{below}. "
        "Grey: the gantry stands, only the volume of the pause is seen, and nothing is learned there.",
        page.origin(
            sources.source("lessons", "filmed"),
            material=materials,
            routine=[str(routine) for routine in np.unique(table["routine"])],
            law="pixels",
            trial="0",
        ),
    )


def _flow_error(sources: Sources) -> str:
    """How far the measured flow is off the true one, by material, in a sentence."""
    figures = [
        f"{name} {percent(float(in_all), 2)}, around the corner {percent(float(near), 2)}"
        for name, laws in known(sources.metrics["train_ilc"], {}).items()
        if (in_all := entry(laws, "pixels", "flow_error_percent")) is not None
        and (near := entry(laws, "pixels", "flow_error_corner_percent")) is not None
    ]
    return (
        f"Over all trials the measured flow is off by, r.m.s. of a full line’s: {'; '.join(figures)}. "
        f"At most 2.5{THIN}% and 6{THIN}% are asked for."
        if figures
        else "No true flow to compare with: the machine is a real one."
    )


def _measured_panels(mine: Table, wide: float, name: str, machine: bool, *, titled: bool) -> list[Markup]:
    """The measured flow of a trial, and, where it is known, its distance
    from the true one with the band of its uncertainty."""
    t, measured, true, steady = (
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
    blind = [(float(t[a]), float(t[min(b, len(t) - 1)])) for a, b in charts.stretches(np.isnan(measured))]
    least, most = (number(float(of(measured)), 1) for of in (np.nanmin, np.nanmax))
    alt = (
        f"{name}: the flow as measured, between {least} and {most} mm³/s; "
        f"standard deviation {short(wide / 1.645, 2)}"
    )
    text = charts.label(frame, float(t[-1]), 1.4 * steady, name, anchor="end", dy=6)
    layers = [
        *(charts.interval(frame, *stretch) for stretch in blind),
        charts.line(frame, t, measured, most=400),
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
    error, band = 100 * (measured - true) / steady, 100 * wide / steady
    off = float(np.sqrt(np.nanmean(error**2)))
    frame = charts.Frame(
        frame.x, charts.Axis(-12.0, 12.0, ((-10.0, "−10"), (0.0, "0"), (10.0, "10"))), 568, 84, 28
    )
    text = charts.label(
        frame, float(t[-1]), 12, f"measured less true: {percent(off, 2)}, r.m.s.", anchor="end", dy=6
    )
    layers = [charts.tint(frame, -band, band), charts.line(frame, t, error, "line thin", most=400), text]
    alt = (
        f"{name}: measured less true is {percent(off, 2)} of a full line’s flow, r.m.s., "
        f"of which its own uncertainty explains ±{percent(band, 2)}"
    )
    return [
        *panels,
        charts.panel(frame, layers, alt=alt, css="dd wide", title="%" if titled else "", units=("s", "%")),
    ]


@as_table(untold=[])
def camera(sources: Sources) -> dict[str, Any]:
    """By material: frames read and rejected, uncertainty, and what the calibration left."""
    filmed, models = need(sources.tables["filmed"]), sources.tables["models"]
    by_material = pd.DataFrame(filmed).groupby("material", sort=False).agg(
        trials=("trial", "size"),
        frames=("frames", "sum"),
        rejected=("rejected", "sum"),
        reasons=("reasons", _reasons),
        deviation=("deviation_mm3_per_s", "median"),
        observable=("observable", "mean"),
        outliers=("outliers", "sum"),
    )  # fmt: skip
    rows = [row | _told(sources, row["material"]) for row in by_material.reset_index().to_dict("records")]
    for row in rows:
        row["calibration"] = entry(models, row["material"], "calibration")
    untold = [row["material"] for row in rows if any(late["s"] is None for late in row["latencies"])]
    given = entry(sources.declared.everything, "camera", "latency_s") is not None
    return {"rows": rows, "untold": untold, "given": given}


def _told(sources: Sources, material: str) -> dict[str, Any]:
    """How late the camera is against the gantry, of each routine that was learned through pictures, and the
    identified delay from plunger to flow, which is not the camera's; both in s, None if not told."""
    laws = known(sources.metrics["train_ilc"], {}).get(material, {})
    latencies = [
        {"s": figures["latency_s"], "deviation_s": figures.get("latency_deviation_s")}
        for law, figures in laws.items()
        if law.startswith("pixels") and "latency_s" in figures
    ]
    learned = known(lookup(sources.tables["learned"], "materials"), [])
    chain = next((one["chain"] for one in learned if one["material"] == material), {})
    return {"latencies": latencies, "delay_s": entry(chain, "extruder", "delay_s")}


def _reasons(texts: Iterable[str]) -> str:
    """How many frames were rejected for what: "blur 3", "dark 1, blur 2" -> "blur 5, dark 1"."""
    frames_of: Counter[str] = Counter()
    for reason in filter(None, ", ".join(texts).split(", ")):
        name, _, frames = reason.rpartition(" ")
        frames_of[name] += int(frames) if frames.isdigit() else 1
    return ", ".join(f"{name} {number(frames, 0)}" for name, frames in sorted(frames_of.items())) or "none"
