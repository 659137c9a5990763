"""The page of the deposition loop: whose signal prints the parts, what it leaves of on-off control's error,
what that took, and the pictures behind it."""

import itertools
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from pipeline.report.deposition import card as deposition_card
from pipeline.report.deposition import learning as deposition_learning
from pipeline.report.deposition import parts as deposition_parts
from pipeline.report.deposition.parts import HEADS, KIND, MARK, PAPER, real
from pipeline.report.shared import charts, headline, page, words
from pipeline.report.shared.difference import Move
from pipeline.report.shared.pictures import Picture, PictureColumn, as_picture, as_table
from pipeline.report.shared.sources import Sources
from pipeline.verdict.deposition import NAMES, NOT_JUDGED, OURS, Structure, data_driven, gamma, structures
from pipeline.verdict.digits import THIN, number, short
from pipeline.verdict.evidence import Table, entry, gap_of, known, need, need_figure, or_empty
from pipeline.verdict.verdict import Missing, Question, count_of

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
# materials beside one another that are shown
MATERIALS = 4
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


def render(sources: Sources) -> str:
    """The text of deposition.html."""
    judged, parts = sources.verdicts["deposition"], structures(sources.evidence)
    measured, lessons = known(parts, []), known(sources.tables["lessons"], None)
    rule = data_driven(measured)
    return page.render(
        "deposition.html",
        here="deposition",
        sources=sources,
        title=f"Deposition: {judged.decision.rstrip('.')}",
        verdict=judged,
        heads_of_rules=_heads_of_rules(judged.winner),
        claim=headline.claim(sources, ("deposition",)),
        verdict_mark=MARK.get(judged.winner, "model_based"),
        before=gamma(sources.evidence),
        routines=sorted(set(lessons["routine"].tolist()) - {0}) if lessons else [],
        laws=known(sources.metrics["train_ilc"], {}),
        real=real(sources),
        no_scores=gap_of(parts),
        answers=[
            _answer(part, move, rule)
            for part, move in itertools.zip_longest(measured, deposition_card.moves(sources, measured))
        ],
        board=BOARD,
        composers=NAMES,
        marks=MARK,
        methods=PAPER,
        rules=sources.declared.rules,
        structures=measured,
        learning=deposition_learning.errors(sources),
        frames=deposition_learning.frames(sources),
        measured=deposition_learning.measured(sources),
        camera=deposition_learning.camera(sources),
        signals=signals(sources),
        assumptions=assumptions(sources),
        chains=chains(sources),
        slicer=slicer(sources),
        maps=deposition_parts.maps(sources),
        stretches=deposition_parts.stretches(sources),
        by_prints=deposition_parts.by_prints(sources),
        library=rule,
        compared=any(one.error(rule) is not None for one in measured),
        lines=deposition_parts.lines(sources),
        forecasts=deposition_parts.forecasts(sources),
        extruded=deposition_parts.extruded(sources),
        refused=deposition_parts.refused(sources),
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


# ---- the first screen: a row for each structure and material


def _answer(structure: Structure, move: Move | None, library: str) -> dict[str, Any]:
    """The basis functions beside the library's better rule on one scale, the strip's limit in its middle."""
    scores, limit = structure.known(), structure.asked.flow_error_percent
    question = Question(0, "", structure.part, "%", limit, False, "")
    gap = Missing("not measured", "no score")
    library_css = "dd hollow" if MARK[library] in page.HOLLOW else "dd"
    shown = [
        (NAMES[name], css, count_of(scores[name].error) if name in scores else gap)
        for name, css in ((OURS, "mb"), (library, library_css), ("ilc", "acc"))
    ]
    return {"structure": structure, "move": move, "strip": charts.strip(question, shown, (9, 25, 17))}


BOARD = ("basis", "priority", "superposition", "pressure_advance", "pressure_advance_lead", "on_off", "ilc")


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
    rows = [
        (place, *claim.partition(": ")[::2], percents.tolist())
        for (place, claim), percents in measured.iterrows()
    ]
    return {"rows": rows, "materials": list(measured.columns), "limit": limit}


@as_table()
def chains(sources: Sources) -> dict[str, Any]:
    """Parameters of each machine: as known beforehand, as identified,
    and, where it is simulated, as it truly is."""
    learned, models = need_figure(sources.tables["learned"], "materials"), need(sources.tables["models"])
    machines = [
        (str(material["material"]), word, extruder)
        for material in learned[:MATERIALS]
        for word, extruder in (
            ("beforehand", entry(models, material["material"], "nominal")),
            ("identified", material["chain"]["extruder"]),
            ("true", entry(models, material["material"], "plant")),
        )
        if extruder
    ]
    rows = [(key, title) for key, title in CHAIN if any(one.get(key) for *_, one in machines)]
    fitted = {material["material"]: material["chain"].get("held_out_percent") for material in learned}
    missed = {name: share for name, share in list(fitted.items())[:MATERIALS] if share is not None}
    return {"machines": machines, "rows": rows, "missed": missed}


@or_empty
def slicer(sources: Sources) -> list[dict[str, Any]]:
    """Pressure advance of each material as a slicer takes it, each number with its 90 % interval, and the
    lines that set it; no number of a material if no forecast of it is judged."""
    materials = need_figure(sources.tables["learned"], "slicer")
    streams = known(structures(sources.evidence), [])
    judged = {stream.material for stream in streams if not stream.unknown()}
    unknown = {stream.material for stream in streams} - judged
    return [
        {"material": name, "lines": NOT_JUDGED} | dict.fromkeys(SLICER)
        if name in unknown
        else {"material": name, "lines": "\n".join(f"{key}: {values[key]}" for key in SLICERS)}
        | {key: [f"{one:.{places}f}" for one in values[key]] for key, places in SLICER.items()}
        for name, values in list(materials.items())[:MATERIALS]
    ]
