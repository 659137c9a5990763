"""The page of the deposition loop: whose signal prints the parts, what it leaves of on-off control's error,
what that took, and the pictures behind it."""

import itertools
from typing import Any

import numpy as np
from markupsafe import Markup

from pipeline.report.deposition import change as deposition_change
from pipeline.report.deposition import learning as deposition_learning
from pipeline.report.deposition import parts as deposition_parts
from pipeline.report.deposition.rules import (
    HEADS,
    LIBRARY,
    MARK,
    NAMES,
    OURS,
    PAPER,
    Structure,
    gamma,
    real,
    structures,
)
from pipeline.report.deposition.verdict import verdict
from pipeline.report.shared import charts, headline, page, words
from pipeline.report.shared.difference import Move
from pipeline.report.shared.digits import THIN, number, percent, short
from pipeline.report.shared.pictures import Column, Picture, placeholder
from pipeline.report.shared.sources import Sources, Table, digest, lookup
from pipeline.report.shared.verdict import Figure, Missing, Question, ReportRules

WORDS = (
    "on_off",
    "basis",
    "library",
    "priority",
    "superposition",
    "whole",
    "forecast",
    "lead",
    "trial",
    "through_pictures",
    "gamma",
    "saturation",
    "line_volume",
    "accepted",
)
TASKS = ("Start", "Corner", "Stop")
# materials beside one another, and columns of the library, that are shown
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
SECTIONS = ("printer", "camera", "train_ilc", "segment_library", "compose_parts")


def render(sources: Sources) -> str:
    """The text of deposition.html."""
    judged, parts = verdict(sources), structures(sources)
    measured = [] if isinstance(parts, Missing) else parts
    return page.render(
        "deposition.html",
        here="deposition",
        title=f"Deposition: {judged.decision.rstrip('.')}",
        verdict=judged,
        heads_of_rules=HEADS,
        claim=headline.claim(sources, ("deposition",)),
        verdict_mark=MARK.get(judged.winner, "data_driven"),
        beforehand=_beforehand(sources),
        real=real(sources),
        no_scores=parts if isinstance(parts, Missing) else None,
        answers=[
            _answer(one) | since(move)
            for one, move in itertools.zip_longest(measured, deposition_change.moves(sources, measured))
        ],
        scoreboard=scoreboard(measured, sources.declared.rules),
        learning=deposition_learning.pictures(sources),
        frames=deposition_learning.frames(sources),
        measured=deposition_learning.measured(sources),
        camera=deposition_learning.camera(sources),
        signals=signals(sources),
        assumptions=assumptions(sources),
        chains=chains(sources),
        columns=columns(sources),
        maps=deposition_parts.maps(sources),
        stretches=deposition_parts.stretches(sources),
        lines=deposition_parts.lines(sources),
        forecasts=deposition_parts.forecasts(sources),
        refused=deposition_parts.refused(sources),
        declared=declared(sources),
        words=words.chosen(sources, WORDS),
        sources=list(sources.read.values()),
        absent=sources.absent,
        hashes=hashes(sources),
        from_scores=sources.source("scores", "compose_parts"),
        from_film=sources.source("filmed", "models", "train_ilc"),
        from_library=sources.source("library", "learned", "models"),
        from_lines=sources.source("lines", "conformance"),
    )


def hashes(sources: Sources) -> list[tuple[str, str]]:
    """Short digests by which two pages can be told to be of one run."""
    tables = {source.name: source.sha256 for source in sources.read.values()}
    artifacts = [
        (word, tables.get(name, "missing"))
        for word, name in (("trials", "trials"), ("library", "library"), ("scores", "scores"))
    ]
    return [
        (name, value[:8])
        for name, value in [
            *artifacts,
            ("parameters", digest(sources.declared.everything)),
            ("code", sources.code),
        ]
    ]


def _beforehand(sources: Sources) -> str:
    before = gamma(sources)
    if before is None:
        return (
            "The convergence of the paper’s law was not tested beforehand; the model inversion identifies "
            "the machine in its first trials and goes back to the best one where the error rises."
        )
    return (
        "Tested before anything ran: with γ = max |Q² (1 − L P)| below 1 the paper’s law shrinks the error "
        f"at every trial. γ is {number(before['gamma'], 2)} on the nominal plant and up to "
        f"{number(before['gamma_worst'], 2)} over its family, above 1 on "
        f"{percent(before['gamma_above_1_percent'], 2)} of it: there the law may look fine for a dozen "
        "trials and then diverge. "
        "The model inversion identifies the machine in its first trials, and goes back to the best one "
        "where the error rises."
    )


# ---- the first screen: a row for each structure and material


def _answer(one: Structure) -> dict[str, Any]:
    """The basis functions beside the library on one scale, the strip's limit in its middle; the
    worst line's volume of the composer that was chosen."""
    question = Question(0, "", one.part, "%", one.asked.flow_error_percent, False, "")
    shown = [
        (
            NAMES[name],
            css,
            Figure(*3 * (one.scores[name].error,))
            if name in one.scores
            else Missing("not measured", "no score"),
        )
        for name, css in ((OURS, "dd"), (LIBRARY, "mb"), ("ilc", "acc"))
    ]
    chosen = one.scores.get(one.chosen)
    line = chosen.worst_line if chosen else None
    best = one.best()
    return {
        "part": one.part,
        "material": one.material,
        "state": one.state(),
        "cells": [
            {
                "css": css,
                "name": NAMES[name],
                "value": percent(one.scores[name].error, 2) if name in one.scores else "not measured",
                "band": _forecast(one.scores[name].predicted) if name in one.scores else "",
                "bad": name in one.scores and one.scores[name].error > one.asked.flow_error_percent,
                "best": name == best,
            }
            for css, name in (("dd", OURS), ("mb", LIBRARY))
        ],
        "whole": percent(one.scores["ilc"].error, 2) if "ilc" in one.scores else "none",
        "strip": charts.strip(question, shown, (9, 25, 17)),
        "line": "no line" if line is None else percent(line, 2),
        "line_bad": line is not None and line > one.asked.line_volume_percent,
        "chosen": NAMES.get(one.chosen, one.chosen),
    }


def since(move: Move | None) -> dict[str, Any]:
    """How the figure of the composer in use moved since the accepted run."""
    if move is None:
        return {"change": "first run", "moved": False, "worse": False}
    return {"change": move.text(), "moved": move.moved, "worse": move.word == "worse"}


def _forecast(value: float | None) -> str:
    return "" if value is None else f"forecast {percent(value, 2)}"


def scoreboard(parts: list[Structure], asked: ReportRules) -> dict[str, Any]:
    """Structures and materials down, composers across: true error,
    what was forecast, and the worst line's volume."""
    names = ("basis", "priority", "superposition", "on_off", "ilc")
    heads = [{"mark": MARK[name], "name": NAMES[name], "method": PAPER[name]} for name in names]
    rows = []
    for one in parts:
        best = one.best()
        cells = []
        for name in names:
            score = one.scores.get(name)
            if score is None:
                cells.append(
                    {
                        "value": "not measured",
                        "band": "",
                        "line": "",
                        "best": False,
                        "bad": False,
                        "chosen": False,
                        "line_bad": False,
                    }
                )
                continue
            cells.append(
                {
                    "value": percent(score.error, 2),
                    "band": _forecast(score.predicted),
                    "line": "no line long enough"
                    if score.worst_line is None
                    else f"worst line {percent(score.worst_line, 2)}",
                    "best": name == best,
                    "bad": score.error > one.asked.flow_error_percent and name != "on_off",
                    "line_bad": score.worst_line is not None
                    and score.worst_line > one.asked.line_volume_percent
                    and name != "on_off",
                    "chosen": name == one.chosen,
                }
            )
        rows.append({"part": one.part, "material": one.material, "cells": cells})
    return {
        "heads": heads,
        "rows": rows,
        "limit": f"{asked.flow_error_percent:g}{THIN}%",
        "line": f"±{asked.line_volume_percent:g}{THIN}%",
    }


def declared(sources: Sources) -> list[tuple[str, list[tuple[str, str]]]]:
    """Sections of the parameters that this loop reads, flattened, as text."""
    return [(section, flat(sources.declared.everything.get(section, {}))) for section in SECTIONS]


def flat(data: Any, name: str = "") -> list[tuple[str, str]]:
    if isinstance(data, dict):
        return [
            pair for key, value in data.items() for pair in flat(value, f"{name}.{key}" if name else str(key))
        ]
    if isinstance(data, list) and any(isinstance(item, dict) for item in data):
        return [
            (f"{name}[{i}]", ", ".join(f"{key} {value}" for key, value in item.items()))
            for i, item in enumerate(data)
        ]
    if isinstance(data, list):
        return [(name, ", ".join(map(str, data)))]
    return [(name, "none" if data is None else str(data))]


# ---- the library


def _step(sources: Sources) -> float:
    step_s = lookup(sources.tables["learned"], "sample_time_s")
    return float("nan") if isinstance(step_s, Missing) else float(step_s)


def signals(sources: Sources) -> Picture:
    """Each basis signal from its lead to its end, materials beside one another."""
    table, title = sources.tables["library"], "Its signals"
    if isinstance(table, Missing) or isinstance(sources.tables["learned"], Missing):
        return placeholder(
            "signals", title, table if isinstance(table, Missing) else sources.tables["learned"]
        )
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
        f"Each signal begins ahead of its event: {text}. A line shorter than the lead of "
        "Stop has no room for it.",
        shown,
        "Plunger command in multiples of the steady one, against time from the event (0) in s; grey: "
        "the lead. Thick: the fastest speed trained, thin: the others; dashed: "
        "the shorter pauses of a corner.",
        page.origin(sources.source("library", "learned")),
    )


def _steady(table: Table, material: str, speed: float) -> float:
    rows = (
        (table["material"] == material)
        & (table["task"] == "Steady-State")
        & (table["speed_mm_per_s"] == speed)
    )
    levels = [float(np.mean(signal)) for signal in table["signal_mm"][rows]]
    return abs(levels[0]) if levels and levels[0] else 1.0


def _panel(table: Table, rows: np.ndarray, task: str, material: str, Ts: float, *, titled: bool) -> Markup:
    # the whole task is drawn: the samples that it begins ahead, and those that follow
    scaled = {
        int(k): np.asarray(table["signal_mm"][k], float)
        / _steady(table, material, table["speed_mm_per_s"][k])
        for k in rows
    }
    lead = Ts * float(table["lead"][rows].max())
    end = max(Ts * (len(scaled[int(k)]) - float(table["lead"][k])) for k in rows)
    low, high = (float(find([find(values) for values in scaled.values()])) for find in (np.min, np.max))
    room = 0.08 * max(high - low, 1.0)
    frame = charts.Frame(
        charts.linear(-max(lead, Ts), max(end, Ts), ticks=6),
        charts.linear(min(low, 0) - room, max(high, 1) + room, ticks=4),
        568,
        170,
        30,
    )
    fastest, longest = float(table["speed_mm_per_s"][rows].max()), float(table["pause_s"][rows].max())
    layers = [charts.interval(frame, -lead, 0.0)]
    for k in rows:
        t = Ts * (np.arange(len(scaled[int(k)])) - float(table["lead"][k]))
        css = "line" if table["speed_mm_per_s"][k] == fastest else "line thin"
        layers.append(
            charts.line(frame, t, scaled[int(k)], css + (" dash" if table["pause_s"][k] < longest else ""))
        )
    peak = max(scaled.values(), key=lambda values: float(np.abs(values).max()))
    most = float(peak[np.argmax(np.abs(peak))])
    layers.append(
        charts.label(
            frame,
            frame.x.high,
            frame.y.high,
            f"{task}: peak {short(most, 2)} ×, lead {number(lead, 2)} s",
            anchor="end",
            dy=8,
        )
    )
    alt = (
        f"{task} of material {material}: begins {number(lead, 2)} s ahead of its event "
        f"and peaks at {short(most, 2)} times the steady command"
    )
    return charts.panel(
        frame, layers, alt=alt, css="mb wide", title="× steady" if titled else "", units=("s", "×")
    )


def assumptions(sources: Sources) -> dict[str, Any]:
    """The paper's assumptions 1 to 4: what was found of each, by material, against the largest predicted
    error that compose_parts lets pass."""
    checks = lookup(sources.tables["learned"], "checks", what="the check of the assumptions")
    if isinstance(checks, Missing):
        return {"missing": checks, "rows": [], "materials": []}
    limit = sources.declared.everything.get("compose_parts", {}).get("largest_error_percent", 20)
    materials = [str(m) for m in dict.fromkeys(one["material"] for one in checks)][:MATERIALS]
    rows: dict[tuple[int, str], dict[str, Any]] = {}
    for one in checks:
        row = rows.setdefault(
            (one["assumption"], one["claim"]),
            {"number": one["assumption"], "claim": str(one["claim"]), "cells": {}},
        )
        value = one["percent"]
        row["cells"][str(one["material"])] = {
            "text": "not tested" if value is None else percent(float(value), 2),
            "bad": value is not None and value > limit,
        }
    for row in rows.values():
        name, _, what = row["claim"].partition(": ")
        row |= {
            "name": name,
            "what": what,
            "cells": [row["cells"].get(m, {"text": "not tested", "bad": False}) for m in materials],
        }
        row["holds"] = not any(cell["bad"] for cell in row["cells"])
    return {
        "missing": None,
        "rows": list(rows.values()),
        "materials": materials,
        "limit": f"{limit:g}{THIN}%",
    }


def chains(sources: Sources) -> dict[str, Any]:
    """Parameters of each machine: as known beforehand, as identified,
    and, where it is simulated, as it truly is."""
    models, learned = sources.tables["models"], lookup(sources.tables["learned"], "materials")
    for missing in (learned, models):
        if isinstance(missing, Missing):
            return {"missing": missing, "rows": [], "heads": []}
    heads, values = [], []
    for material in learned[:MATERIALS]:
        name = str(material["material"])
        nominal, true = (models.get(name, {}).get(key) for key in ("nominal", "plant"))
        for word, extruder in (
            ("beforehand", nominal),
            ("identified", material["chain"]["extruder"]),
            ("true", true),
        ):
            if extruder:
                heads.append({"material": name, "word": word})
                values.append(extruder)
    rows = [
        {
            "title": title,
            "cells": [
                "none" if extruder.get(key) is None else short(float(extruder[key]), 3) for extruder in values
            ],
        }
        for key, title in CHAIN
        if any(extruder.get(key) for extruder in values)
    ]
    fits = [
        f"{material['material']}: on trials that it was not fitted to the chain misses "
        f"{percent(material['chain']['held_out_percent'], 2)} of the flow’s movement"
        for material in learned[:MATERIALS]
        if material["chain"].get("held_out_percent") is not None
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
