"""The deposition loop on page one: the composer in use, the other one and on-off control; and the part on
which the composer in use fares worst."""

from collections.abc import Callable, Sequence

import numpy as np

from pipeline.report.deposition.marks import KIND, MARK, real
from pipeline.report.deposition.parts import draw_flows
from pipeline.report.shared import page
from pipeline.report.shared.card import (
    Card,
    CardCell,
    CardRow,
    CardStep,
    Deciding,
    Entrant,
    best_of,
    note_of,
    of_verdict,
)
from pipeline.report.shared.sources import Sources
from pipeline.verdict.deposition import FIRST_TRIALS, NAMES, OURS, Structure, data_driven, structures, worst
from pipeline.verdict.digits import THIN, band, count, decimals, number, percent
from pipeline.verdict.evidence import Table
from pipeline.verdict.verdict import PASSED, Missing, Verdict

MOVES = "Plunger command to flow at the nozzle"
# how long a stretch of a part is drawn, s
STRETCH_S = 6.0
Read = Callable[[Structure, str], float | None]


def card(sources: Sources, verdict: Verdict) -> Card:
    """Flow error, line volume and what learning the part itself would gain, of three composers."""
    parts = structures(sources.evidence)
    step = _step(sources, verdict)
    if isinstance(parts, Missing):
        return of_verdict(
            verdict, MOVES, step, entrants=[], rows=[], basis="", beside="", sources=[],
            missing=parts.sentence(),
        )  # fmt: skip
    asked, names = sources.declared.rules, shown(verdict.winner or "", parts)
    known = [part for part in parts if part.known()]
    whose = "forecasts of the identified machine" if real(sources) else "true flow of simulated machines"
    return of_verdict(
        verdict,
        MOVES,
        step,
        entrants=[
            # "Library", by its better rule
            Entrant(MARK[name], NAMES[name].split(",")[0], _note(name) if i else note_of(verdict))
            for i, name in enumerate(names)
        ],
        rows=[
            _row("Flow error", known, names, _error, asked.flow_error_percent, "≤", "%"),
            _row("Line volume", known, names, _volume, asked.line_volume_percent, "±", "%"),
            _row("Above learning it", known, names, _above, asked.above_whole_points, "≤", "pts"),
        ],
        basis=f"Worst of {count(len(known), 'stream')}, {whose}; small: range. "
        "% of on\u2011off’s error, pts: points of it.",
        beside=verdict.short_answer,
        sources=sources.source("scores"),
    )


def shown(winner: str, parts: Sequence[Structure]) -> list[str]:
    """The composer in use, the other one of the pair, on-off control."""
    library = data_driven(parts)
    if winner == "on_off":
        return ["on_off", OURS, library]
    return [winner or OURS, library if winner in (OURS, "") else OURS, "on_off"]


def _note(name: str) -> str:
    return "yardstick" if KIND[name] == "baseline" else KIND[name]


# ---- the figures


def _error(part: Structure, name: str) -> float | None:
    return part.error(name)


def _volume(part: Structure, name: str) -> float | None:
    return part.worst_line(name)


def _above(part: Structure, name: str) -> float | None:
    """Points above what learned this very part; None where nothing did."""
    both = name in part.scores and "ilc" in part.scores
    return part.scores[name].error - part.scores["ilc"].error if both else None


def _row(
    title: str, parts: Sequence[Structure], names: Sequence[str], read: Read, limit: float, sign: str,
    unit: str,
) -> CardRow:  # fmt: skip
    """The largest figure of each composer, the range over all streams beside it."""
    each = {name: [value for part in parts if (value := read(part, name)) is not None] for name in names}
    most = [max(values) if values else None for values in each.values()]
    best = best_of(most, at_least=False)
    cells = [
        _cell(values, unit, best=max(values, default=None) == best is not None, limit=limit)
        for values in each.values()
    ]
    return CardRow(title, f"{sign}{'' if sign == '±' else ' '}{limit:g}{THIN}{unit}", cells)


def _cell(values: Sequence[float], unit: str, *, best: bool, limit: float) -> CardCell:
    if not values:
        return CardCell("not measured")
    low, high = min(values), max(values)
    places = min(decimals(low, high, value=high), 1)
    return CardCell(f"{number(high, places)}{THIN}{unit}", band(low, high, places), best, bad=high > limit)


def _step(sources: Sources, verdict: Verdict) -> CardStep:
    if verdict.remedy == FIRST_TRIALS:
        return CardStep(verdict.remedy, "./run dvc repro")
    if not verdict.winner and not verdict.remedy:
        return CardStep("Run the stages of this loop.", "./run dvc repro compose_parts")
    if verdict.state != PASSED and verdict.remedy:
        return CardStep(f"{verdict.remedy.rstrip('.')}; then run it again.", "./run dvc repro")
    if real(sources):
        return CardStep("Compose the commands of a part.", "./run beadline compose PART.gcode")
    return CardStep("Compose a part of your own.", "./run beadline compose PART.gcode --verify")


# ---- the part that decides


def deciding(sources: Sources, verdict: Verdict) -> Deciding | Missing:
    """Six seconds of the part on which the composer in use fares worst, about its largest error."""
    parts, table = structures(sources.evidence), sources.tables["signals"]
    if isinstance(parts, Missing):
        return parts
    if isinstance(table, Missing):
        return table
    names = shown(verdict.winner or "", parts)
    found = worst(parts, names[0])
    rows = [] if found is None else _stretch(table, found[1], names[0])
    if found is None or not len(rows):
        return Missing("not measured", "no flow of the part that decides was kept")
    part = found[1]
    stretch = {key: table[key][rows] for key in table}
    drawn = [name for name in names if np.isfinite(stretch.get(f"{name}_mm3_per_s", np.nan)).any()]
    listed = ", ".join(
        f"{i} {NAMES[name].lower()} {percent(part.scores[name].error, 2)}"
        for i, name in enumerate(drawn, 1)
        if name in part.scores
    )
    finding = (
        f"{part.part}, material {part.material}, about the largest error: wanted flow dashed. "
        f"Error in per cent of on\u2011off control’s: {listed}."
    )
    wide, narrow = (draw_flows(stretch, drawn, finding, size) for size in ((566, 212), (350, 240)))
    seen = [f"{name}_mm3_per_s" for name in ("wanted", *drawn)]
    return Deciding(
        "Deposition, the part that decides",
        finding,
        wide,
        narrow,
        "",
        page.in_viewer("signals", part=[part.part], material=[part.material], y=seen),
    )


def _stretch(table: Table, part: Structure, name: str) -> np.ndarray:
    """Rows of the part within STRETCH_S about where the composer's flow is furthest from the wanted."""
    mine = np.flatnonzero((table["part"] == part.part) & (table["material"] == part.material))
    off = np.abs(table[f"{name}_mm3_per_s"][mine] - table["wanted_mm3_per_s"][mine])
    if not len(mine) or not np.isfinite(off).any():
        return mine[:0]
    time = table["time_s"][mine]
    middle = time[int(np.nanargmax(off))]
    start = min(max(middle - STRETCH_S / 2, time.min()), max(time.max() - STRETCH_S, time.min()))
    return mine[(time >= start) & (time <= start + STRETCH_S)]
