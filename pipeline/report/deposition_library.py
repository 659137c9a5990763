"""The library of the deposition page: its signals with their lead, the paper's four assumptions in figures, the identified chains, and the table of columns."""

from typing import Any

import numpy as np
from markupsafe import Markup

from pipeline.report import charts, page
from pipeline.report.digits import THIN, number, percent, short
from pipeline.report.pictures import Column, Picture, hole
from pipeline.report.sources import Sources, Table, lookup
from pipeline.report.verdict import Missing

TASKS = ("Start", "Corner", "Stop")
MATERIALS, MOST = 4, 80
CHAIN = (
    ("gain", "Gain, mm³/s per mm"),
    ("time_constant_s", "Time constant, s"),
    ("delay_s", "Delay, s"),
    ("lag_hz", "Lag, Hz"),
    ("play", "Play, mm"),
    ("yield_", "Yield, mm³/s"),
    ("creep_share", "Creep, share"),
)


def _step(sources: Sources) -> float:
    found = lookup(sources.tables["learned"], "sample_time_s")
    return float("nan") if isinstance(found, Missing) else float(found)


def signals(sources: Sources) -> Picture:
    """Each basis signal from its lead to its end, materials beside one another."""
    table, title = sources.tables["library"], "Its signals"
    if isinstance(table, Missing) or isinstance(sources.tables["learned"], Missing):
        return hole("signals", title, table if isinstance(table, Missing) else sources.tables["learned"])
    Ts = _step(sources)
    shown: list[Column] = []
    leads: dict[str, float] = {}
    materials = [str(name) for name in dict.fromkeys(table["material"])][:MATERIALS]
    for i, material in enumerate(materials):
        panels = []
        for task in TASKS:
            rows = np.flatnonzero((table["material"] == material) & (table["task"] == task))
            if not len(rows):
                continue
            leads[task] = max(leads.get(task, 0.0), Ts * float(table["lead"][rows].max()))
            panels.append(_panel(table, rows, task, material, Ts, titled=i == 0 and not panels))
        shown.append(Column(f"Material {material}", "", "", panels))
    text = ", ".join(f"{task} {number(seconds, 2)}{THIN}s" for task, seconds in leads.items())
    return Picture(
        "signals",
        title,
        f"Each signal begins ahead of its event: {text}. A line shorter than the lead of Stop has no room for it.",
        shown,
        "Plunger command in multiples of the steady one, against time from the event (0) in s; grey: the lead. Thick: the fastest speed trained, thin: the others; dashed: the shorter pauses of a corner.",
        page.origin(sources.source("library", "learned")),
    )


def _steady(table: Table, material: str, speed: float) -> float:
    rows = (table["material"] == material) & (table["task"] == "Steady-State") & (table["speed_mm_per_s"] == speed)
    found = [float(np.mean(signal)) for signal in table["signal_mm"][rows]]
    return abs(found[0]) if found and found[0] else 1.0


def _panel(table: Table, rows: np.ndarray, task: str, material: str, Ts: float, *, titled: bool) -> Markup:
    # the whole task is drawn: the samples that it begins ahead, and those that follow
    scaled = {int(k): np.asarray(table["signal_mm"][k], float) / _steady(table, material, table["speed_mm_per_s"][k]) for k in rows}
    lead = Ts * float(table["lead"][rows].max())
    end = max(Ts * (len(scaled[int(k)]) - float(table["lead"][k])) for k in rows)
    low, high = (float(find([find(values) for values in scaled.values()])) for find in (np.min, np.max))
    room = 0.08 * max(high - low, 1.0)
    frame = charts.Frame(charts.linear(-max(lead, Ts), max(end, Ts), ticks=6), charts.linear(min(low, 0) - room, max(high, 1) + room, ticks=4), 568, 170, 30)
    fastest, longest = float(table["speed_mm_per_s"][rows].max()), float(table["pause_s"][rows].max())
    layers = [charts.interval(frame, -lead, 0.0)]
    for k in rows:
        t = Ts * (np.arange(len(scaled[int(k)])) - float(table["lead"][k]))
        css = "line" if table["speed_mm_per_s"][k] == fastest else "line thin"
        layers.append(charts.line(frame, t, scaled[int(k)], css + (" dash" if table["pause_s"][k] < longest else "")))
    peak = max(scaled.values(), key=lambda values: float(np.abs(values).max()))
    most = float(peak[np.argmax(np.abs(peak))])
    layers.append(charts.label(frame, frame.x.high, frame.y.high, f"{task}: peak {short(most, 2)} ×, lead {number(lead, 2)} s", anchor="end", dy=8))
    alt = f"{task} of material {material}: begins {number(lead, 2)} s ahead of its event and peaks at {short(most, 2)} times the steady command"
    return charts.panel(frame, layers, alt=alt, css="mb wide", title="× steady" if titled else "")


def assumptions(sources: Sources) -> dict[str, Any]:
    """The paper's assumptions 1 to 4: what was found of each, by material, against the largest predicted error that compose_parts lets pass."""
    checks = lookup(sources.tables["learned"], "checks", what="the check of the assumptions")
    if isinstance(checks, Missing):
        return {"missing": checks, "rows": [], "materials": []}
    limit = sources.declared.everything.get("compose_parts", {}).get("largest_error_percent", 20)
    materials = [str(m) for m in dict.fromkeys(one["material"] for one in checks)][:MATERIALS]
    rows: dict[tuple[int, str], dict[str, Any]] = {}
    for one in checks:
        row = rows.setdefault((one["assumption"], one["claim"]), {"number": one["assumption"], "claim": str(one["claim"]), "cells": {}})
        value = one["percent"]
        row["cells"][str(one["material"])] = {"text": "not tested" if value is None else percent(float(value), 2), "bad": value is not None and value > limit}
    for row in rows.values():
        name, _, what = row["claim"].partition(": ")
        row |= {"name": name, "what": what, "cells": [row["cells"].get(m, {"text": "not tested", "bad": False}) for m in materials]}
        row["holds"] = not any(cell["bad"] for cell in row["cells"])
    return {"missing": None, "rows": list(rows.values()), "materials": materials, "limit": f"{limit:g}{THIN}%"}


def chains(sources: Sources) -> dict[str, Any]:
    """Parameters of each machine: as known beforehand, as identified, and, where it is simulated, as it truly is."""
    models, learned = sources.tables["models"], lookup(sources.tables["learned"], "materials")
    for found in (learned, models):
        if isinstance(found, Missing):
            return {"missing": found, "rows": [], "heads": []}
    heads, values = [], []
    for known in learned[:MATERIALS]:
        name = str(known["material"])
        nominal, true = (models.get(name, {}).get(key) for key in ("nominal", "plant"))
        for word, found in (("beforehand", nominal), ("identified", known["chain"]["extruder"]), ("true", true)):
            if found:
                heads.append({"material": name, "word": word})
                values.append(found)
    rows = [
        {"title": title, "cells": ["none" if found.get(key) is None else short(float(found[key]), 3) for found in values]}
        for key, title in CHAIN
        if any(found.get(key) for found in values)
    ]
    fits = [
        f"{known['material']}: on trials that it was not fitted to the chain misses {percent(known['chain']['held_out_percent'], 2)} of the flow’s movement"
        for known in learned[:MATERIALS]
        if known["chain"].get("held_out_percent") is not None
    ]
    return {"missing": None, "rows": rows, "heads": heads, "fit": "; ".join(fits)}


def columns(sources: Sources) -> dict[str, Any]:
    """The matrix (3), a row for each of its columns."""
    table = sources.tables["library"]
    if isinstance(table, Missing):
        return {"missing": table, "rows": [], "more": 0}
    Ts, rows = _step(sources), []
    for k in range(min(len(table["task"]), MOST)):
        signal = np.asarray(table["signal_mm"][k], float)
        extreme = float(signal[np.argmax(np.abs(signal))]) if len(signal) else 0.0
        rows.append(
            {
                "task": str(table["task"][k]),
                "material": str(table["material"][k]),
                "nozzle": f"{table['nozzle_mm'][k]:g}",
                "speed": f"{table['speed_mm_per_s'][k]:g}",
                "pause": f"{table['pause_s'][k]:g}" if table["pause_s"][k] else "",
                "lead": f"{number(Ts * int(table['lead'][k]), 2)} ({int(table['lead'][k])})",
                "length": f"{number(Ts * int(table['length'][k]), 2)} ({int(table['length'][k])})",
                "extreme": short(extreme, 3) if extreme else "0",
            }
        )
    return {"missing": None, "rows": rows, "more": max(len(table["task"]) - MOST, 0)}
