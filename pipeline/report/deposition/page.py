"""The page of the deposition loop: whose signal prints the parts, what it leaves of on-off control's error,
what that took, and the pictures behind it."""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from pipeline.report.deposition import card as deposition_card
from pipeline.report.deposition import learning as deposition_learning
from pipeline.report.deposition import parts as deposition_parts
from pipeline.report.deposition.parts import HEADS, KIND, MARK, PAPER, real
from pipeline.report.shared import charts, headline, page, words
from pipeline.report.shared.difference import Change, Move
from pipeline.report.shared.pictures import Picture, PictureColumn, as_picture, as_table
from pipeline.report.shared.sources import Sources
from pipeline.verdict.deposition import (
    NAMES,
    NOT_JUDGED,
    OURS,
    Score,
    Structure,
    data_driven,
    gamma,
    structures,
)
from pipeline.verdict.digits import THIN, number, percent, short
from pipeline.verdict.evidence import Table, gap_of, known, lookup, need, need_figure, or_empty
from pipeline.verdict.settings import ReportRules
from pipeline.verdict.verdict import Figure, Missing, Question

WORDS = (
    "on_off",
    "pressure_advance",
    "basis",
    "library",
    "priority",
    "superposition",
    "whole",
    "forecast",
    "lead",
    "trial",
    "stream",
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
# what a slicer takes, with decimals, and who takes it as a line
SLICER = {"pressure_advance_s": 4, "smooth_time_s": 3, "flow_ratio": 3}
SLICERS = ("Klipper", "Marlin", "OrcaSlicer")
SECTIONS = ("printer", "camera", "train_ilc", "segment_library", "compose_parts")


def render(sources: Sources) -> str:
    """The text of deposition.html."""
    judged, parts = sources.verdicts["deposition"], structures(sources.evidence)
    measured = known(parts, [])
    return page.render(
        "deposition.html",
        here="deposition",
        sources=sources,
        title=f"Deposition: {judged.decision.rstrip('.')}",
        verdict=judged,
        heads_of_rules=_heads_of_rules(judged.winner),
        claim=headline.claim(sources, ("deposition",)),
        verdict_mark=MARK.get(judged.winner, "model_based"),
        beforehand=_beforehand(sources),
        real=real(sources),
        no_scores=gap_of(parts),
        answers=[
            _answer(part, move, data_driven(measured))
            for part, move in itertools.zip_longest(measured, deposition_card.moves(sources, measured))
        ],
        scoreboard=scoreboard(measured, sources.declared.rules),
        learning=deposition_learning.errors(sources),
        frames=deposition_learning.frames(sources),
        measured=deposition_learning.measured(sources),
        camera=deposition_learning.camera(sources),
        signals=signals(sources),
        assumptions=assumptions(sources),
        chains=chains(sources),
        slicer=slicer(sources),
        columns=columns(sources),
        maps=deposition_parts.maps(sources),
        stretches=deposition_parts.stretches(sources),
        by_prints=deposition_parts.by_prints(sources),
        library={
            "rule": NAMES[data_driven(measured)],
            "mark": MARK[data_driven(measured)],
            "compared": any(one.error(data_driven(measured)) is not None for one in measured),
        },
        lines=deposition_parts.lines(sources),
        forecasts=deposition_parts.forecasts(sources),
        extruded=deposition_parts.extruded(sources),
        refused=deposition_parts.refused(sources),
        declared=declared(sources),
        words=words.chosen(sources, WORDS),
        from_scores=sources.source("scores", "compose_parts"),
        from_film=sources.source("filmed", "models", "train_ilc", "learned"),
        from_library=sources.source("library", "learned", "models"),
        from_lines=sources.source("lines", "conformance"),
    )


def _heads_of_rules(winner: str) -> tuple[str, ...]:
    """Of the two columns of rules; the second is of the baseline in use, if one is."""
    if winner == "on_off" or KIND.get(winner) != "baseline":
        return HEADS
    return HEADS[0], NAMES[winner], MARK[winner], HEADS[3]


def _beforehand(sources: Sources) -> str:
    before, lessons = gamma(sources.evidence), known(sources.tables["lessons"], None)
    other = sorted(set(lessons["routine"].tolist()) - {0}) if lessons else []
    instead = f"Shown is routine {other[0]}: the reference is not recorded. " if other else ""
    instead += _floor(sources)
    if before is None:
        return (
            f"{instead}The convergence of the paper’s law was not tested beforehand; the model inversion "
            "identifies the machine in its first trials, and returns to the best command if the error rises."
        )
    return (
        f"{instead}Tested before anything ran: with γ = max |Q² (1 − L P)| below 1 the paper’s law shrinks "
        f"the error at every trial. γ is {number(before['gamma'], 2)} on the nominal plant and up to "
        f"{number(before['gamma_worst'], 2)} over its family, above 1 on "
        f"{percent(before['gamma_above_1_percent'], 2)} of it: there the law may look fine for a dozen "
        "trials and then diverge. "
        "The model inversion identifies the machine in its first trials; its γ counts what its model leaves "
        "of them, too. If the error rises, it goes a smaller share of its way from the best command; if the "
        "best command itself gives a larger error, the machine has changed, and it learns anew."
    )


def _floor(sources: Sources) -> str:
    """Another kind of machine than printer.command says, and the least error that the declared drive allows,
    the worst of materials and routines."""
    materials = known(sources.metrics["train_ilc"], {})
    ratios = [
        headroom["least_ratio"]
        for material in materials.values()
        for headroom in material.get("actuator_headroom", [])
    ]
    named = "".join(
        f"Material {name}: {material['command_kind']}. "
        for name, material in materials.items()
        if material.get("command_kind")
    )
    if not ratios:
        return named
    return named + (
        f"No command within printer.drive leaves less than {percent(100 * max(ratios), 2)} of on-off "
        "control’s error, says the model known beforehand (worst routine). "
    )


# ---- the first screen: a row for each structure and material


def _answer(structure: Structure, move: Move | None, library: str) -> dict[str, Any]:
    """The basis functions beside the library's better rule on one scale, the strip's limit in its middle; the
    worst line's volume of the composer that was chosen."""
    scores, limit = structure.known(), structure.asked.flow_error_percent
    question = Question(0, "", structure.part, "%", limit, False, "")
    shown = [
        (
            NAMES[name],
            css,
            Figure(*3 * (scores[name].error,)) if name in scores else Missing("not measured", "no score"),
        )
        for name, css in ((OURS, "mb"), (library, "dd"), ("ilc", "acc"))
    ]
    chosen = scores.get(structure.chosen)
    line = chosen.worst_line if chosen else None
    best = structure.best()
    return {
        "part": structure.part,
        "material": structure.material,
        "state": structure.state(),
        "cells": [
            {
                "css": css,
                "name": NAMES[name],
                "value": _value(structure, name),
                "band": _interval(scores[name]) if name in scores else "",
                "bad": name in scores and scores[name].error > limit,
                "best": name == best,
            }
            for css, name in (("mb", OURS), ("dd", library))
        ],
        "whole": percent(scores["ilc"].error, 2) if "ilc" in scores else "none",
        "strip": charts.strip(question, shown, (9, 25, 17)),
        "line": NOT_JUDGED if structure.unknown() else "no line" if line is None else f"±{percent(line, 2)}",
        "line_bad": line is not None and line > structure.asked.line_volume_percent,
        "change": Change("first run")
        if move is None
        else Change(move.text(), move.moved, move.word == "worse"),
    }


def _value(structure: Structure, name: str) -> str:
    """The flow error of a composer; of a real machine no figure that its forecast does not stand behind."""
    error = structure.error(name)
    if error is None:
        return NOT_JUDGED if name in structure.scores else "not measured"
    return percent(error, 2)


def _interval(score: Score) -> str:
    """The 90 % interval of the forecast beside a figure, as short as a band of the other pages."""
    if score.predicted is None or (score.judged and (score.low is None or score.high is None)):
        return ""
    return f"{number(score.low, 2)}–{number(score.high, 2)}" if score.judged else NOT_JUDGED


BOARD = ("basis", "priority", "superposition", "pressure_advance", "pressure_advance_lead", "on_off", "ilc")


def scoreboard(parts: list[Structure], asked: ReportRules) -> dict[str, Any]:
    """True error, what was forecast, and the worst line's volume."""
    return {
        "heads": [{"mark": MARK[name], "name": NAMES[name], "method": PAPER[name]} for name in BOARD],
        "rows": [
            {"part": part.part, "material": part.material, "cells": [_cell(part, name) for name in BOARD]}
            for part in parts
        ],
        "limit": f"{asked.flow_error_percent:g}{THIN}%",
        "line": f"±{asked.line_volume_percent:g}{THIN}%",
    }


def _cell(structure: Structure, name: str) -> dict[str, Any]:
    score = structure.known().get(name)
    if score is None:
        return {
            "value": _value(structure, name),
            "band": "",
            "line": "",
            "best": False,
            "bad": False,
            "line_bad": False,
            "chosen": name in structure.scores and name == structure.chosen,
        }
    line, asked = score.worst_line, structure.asked
    return {
        "value": _value(structure, name),
        "band": _interval(score),
        "line": "no line long enough" if line is None else f"worst line {percent(line, 2)}",
        "best": name == structure.best(),
        "bad": score.error > asked.flow_error_percent and name != "on_off",
        "line_bad": line is not None and line > asked.line_volume_percent and name != "on_off",
        "chosen": name == structure.chosen,
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


@as_picture("signals", "Its signals")
def signals(sources: Sources) -> Picture:
    """Each basis signal from its lead to its end, materials beside one another."""
    table, Ts = need(sources.tables["library"]), float(need(sources.tables["learned"])["sample_time_s"])
    shown: list[PictureColumn] = []
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
        shown.append(PictureColumn(f"Material {material}", "", "", panels))
    text = ", ".join(f"{task} {number(seconds, 2)}{THIN}s" for task, seconds in leads.items())
    return Picture(
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
    low, high = (float(of([of(values) for values in scaled.values()])) for of in (np.min, np.max))
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
    return charts.panel(
        frame,
        layers,
        alt=f"{task} of material {material}: begins {number(lead, 2)} s ahead of its event "
        f"and peaks at {short(most, 2)} times the steady command",
        css="mb wide",
        title="× steady" if titled else "",
        units=("s", "×"),
    )


@as_table()
def assumptions(sources: Sources) -> dict[str, Any]:
    """The paper's assumptions 1 to 4: what was found of each, by material, against the largest predicted
    error that compose_parts lets pass."""
    checks = need_figure(sources.tables["learned"], "checks", what="the check of the assumptions")
    limit = sources.declared.everything.get("compose_parts", {}).get("largest_error_percent", 20)
    tests = pd.DataFrame(checks, columns=["assumption", "claim", "material", "percent"])
    by_claim = tests.set_index(["assumption", "claim", "material"])["percent"].astype(float)
    measured = by_claim.unstack(sort=False).iloc[:, :MATERIALS]
    rows = []
    for (place, claim), percents in measured.iterrows():
        name, _, what = claim.partition(": ")
        cells = [
            {"text": "not tested" if math.isnan(value) else percent(value, 2), "bad": value > limit}
            for value in percents
        ]
        rows.append(
            {
                "number": place,
                "name": name,
                "what": what,
                "cells": cells,
                "holds": not any(cell["bad"] for cell in cells),
            }
        )
    return {"rows": rows, "materials": list(measured.columns), "limit": f"{limit:g}{THIN}%"}


@as_table()
def chains(sources: Sources) -> dict[str, Any]:
    """Parameters of each machine: as known beforehand, as identified,
    and, where it is simulated, as it truly is."""
    learned, models = need_figure(sources.tables["learned"], "materials"), need(sources.tables["models"])
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
    fits = [
        f"{material['material']}: on trials that it was not fitted to the chain misses "
        f"{percent(material['chain']['held_out_percent'], 2)} of the flow’s movement"
        for material in learned[:MATERIALS]
        if material["chain"].get("held_out_percent") is not None
    ]
    return {
        "rows": [
            {
                "title": title,
                "cells": [
                    "none" if extruder.get(key) is None else short(float(extruder[key]), 3)
                    for extruder in values
                ],
            }
            for key, title in CHAIN
            if any(extruder.get(key) for extruder in values)
        ],
        "heads": heads,
        "fit": "; ".join(fits),
    }


@or_empty
def slicer(sources: Sources) -> list[dict[str, str]]:
    """Pressure advance of each material as a slicer takes it, each number with its 90 % interval, and the
    lines that set it; no number of a material if no forecast of it is judged."""
    materials = need_figure(sources.tables["learned"], "slicer")
    streams = known(structures(sources.evidence), [])
    judged = {stream.material for stream in streams if not stream.unknown()}
    unknown = {stream.material for stream in streams} - judged
    return [
        {"material": name, "lines": NOT_JUDGED} | dict.fromkeys(SLICER, NOT_JUDGED)
        if name in unknown
        else {"material": name, "lines": "\n".join(f"{key}: {values[key]}" for key in SLICERS)}
        | {key: _with_ends(values[key], places) for key, places in SLICER.items()}
        for name, values in list(materials.items())[:MATERIALS]
    ]


def _with_ends(values: Sequence[float], places: int) -> str:
    low, value, high = (f"{one:.{places}f}" for one in values)
    return f"{value} ({low} to {high})"


@as_table()
def columns(sources: Sources) -> dict[str, Any]:
    """The matrix (3), a row for each of its columns."""
    table = need(sources.tables["library"])
    library = pd.DataFrame(table)
    Ts = float(known(lookup(sources.tables["learned"], "sample_time_s"), math.nan))
    return {
        "rows": [_signal(row, Ts) for row in library.head(MOST).itertuples()],
        "more": max(len(library) - MOST, 0),
    }


def _signal(row: Any, Ts: float) -> dict[str, Any]:
    """A row of the library, sampled every Ts seconds."""
    command = np.asarray(row.signal_mm, float)
    extreme = float(command[np.argmax(np.abs(command))]) if len(command) else 0.0
    return {
        "task": row.task,
        "material": row.material,
        "nozzle": f"{row.nozzle_mm:g}",
        "speed": f"{row.speed_mm_per_s:g}",
        "pause": f"{row.pause_s:g}" if row.pause_s else "",
        "lead": f"{number(Ts * row.lead, 2)} ({row.lead})",
        "length": f"{number(Ts * row.length, 2)} ({row.length})",
        "extreme": short(extreme, 3) if extreme else "0",
    }
