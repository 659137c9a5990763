"""The deposition loop on page one: the composer in use, the other one and on-off control; and the part on
which the composer in use fares worst."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pipeline.report.deposition.parts import KIND, MARK, around_worst, draw_flows, flow_key, lines_of, real
from pipeline.report.shared import page
from pipeline.report.shared.card import (
    PICTURE,
    Card,
    Deciding,
    best_of,
    cell,
    entrant,
    in_order,
    of_verdict,
    or_no_figures,
    step,
)
from pipeline.report.shared.difference import Move, move
from pipeline.report.shared.sources import Sources
from pipeline.verdict.deposition import (
    BASELINE,
    COMPOSERS,
    FIRST_TRIALS,
    NAMES,
    NOT_JUDGED,
    OURS,
    SAME,
    Structure,
    data_driven,
    structures,
    worst,
)
from pipeline.verdict.digits import THIN, band, count, decimals, number, percent
from pipeline.verdict.evidence import known, lookup, need, or_gap, or_nothing
from pipeline.verdict.verdict import PASSED, Figure, Missing, Question, Verdict, count_of

MOVES = "Plunger command to flow at the nozzle"
# how long a stretch of a part is drawn, s
STRETCH_S = 6.0
Read = Callable[[Structure, str], float | None]


def card(sources: Sources, verdict: Verdict) -> Card:
    """Flow error, line volume and what learning the part itself would gain, of three composers."""
    return of_verdict(verdict, MOVES, _step(sources, verdict), **_figures(sources, verdict))


@or_no_figures
def _figures(sources: Sources, verdict: Verdict) -> dict[str, Any]:
    parts = need(structures(sources.evidence))
    asked, names = sources.declared.rules, shown(verdict.winner or "", parts)
    streams = [part for part in parts if part.known()]
    kinds = {name: KIND[name] for name in names}
    return {
        "entrants": [
            # "Library", by its better rule
            entrant(MARK[name], "Library" if KIND[name] == "data-driven" else NAMES[name], note)
            for name, note in in_order(kinds).items()
        ],
        "rows": [
            _row("Flow error", streams, names, Structure.error, asked.flow_error_percent, "≤", "%"),
            _row("Line volume", streams, names, Structure.worst_line, asked.line_volume_percent, "±", "%"),
            _row("Above learned part", streams, names, _above, asked.above_whole_points, "≤", "pts"),
        ],
        "basis": f"Worst of {count(len(streams), 'stream')}; small: range",
        "cost": _cost(sources),
        "picture": deciding(sources, verdict),
        "sources": sources.source("scores"),
    }


def shown(winner: str, parts: Sequence[Structure]) -> list[str]:
    """The best baseline beside on-off control, which is 100 % of itself, the model-based composer and the
    data-driven one, among them the one in use."""
    errors = {
        name: pair[0]
        for name in COMPOSERS
        if KIND[name] == "baseline" and name != BASELINE and (pair := worst(parts, name))
    }
    best = min(errors, key=lambda name: errors[name], default=BASELINE)
    of_kind = {"baseline": best, "model-based": OURS, "data-driven": data_driven(parts)}
    return list((of_kind | ({KIND[winner]: winner} if winner in KIND else {})).values())


@or_nothing
def _cost(sources: Sources) -> str:
    """Prints that were learned from."""
    table = need(sources.tables["trials"])
    if not len(table["trial"]):
        return ""
    law = "model_inverse" if (table["law"] == "model_inverse").any() else "pixels"
    mine = table["law"] == law
    # the reference routine judges, unless there is no other
    mine &= (table["routine"] > 0) | ~(table["routine"][mine] > 0).any()
    materials = len(set(table["material"][mine].tolist()))
    return f"{int(mine.sum())} prints of training routines, {count(materials, 'material')}"


# ---- the figures


def _above(part: Structure, name: str) -> float | None:
    """Points above what learned this very part; None where nothing did."""
    both = name in part.scores and "ilc" in part.scores
    return part.scores[name].error - part.scores["ilc"].error if both else None


def _row(
    title: str, parts: Sequence[Structure], names: Sequence[str], read: Read, limit: float, sign: str,
    unit: str,
) -> dict[str, Any]:  # fmt: skip
    """The largest figure of each composer, the range over all streams beside it."""
    each = {name: [value for part in parts if (value := read(part, name)) is not None] for name in names}
    most = [max(values) if values else None for values in each.values()]
    best = best_of(most, at_least=False)
    places = max((_places(values) for values in each.values() if values), default=0)
    limit_text = f"{sign}{'' if sign == '±' else ' '}{limit:g}{THIN}{unit}"
    return {
        "title": title,
        "limit": limit_text,
        "cells": [
            _cell(values, unit, places, best=max(values, default=None) == best is not None, limit=limit)
            for values in each.values()
        ],
    }


def _places(values: Sequence[float]) -> int:
    return min(decimals(min(values), max(values), value=max(values)), 1)


def _cell(values: Sequence[float], unit: str, places: int, *, best: bool, limit: float) -> dict[str, Any]:
    if not values:
        return cell("not measured")
    low, high = min(values), max(values)
    text = f"{number(high, places)}{THIN}{unit}"
    return cell(text, band(low, high, places), best=best, bad=high > limit)


def _step(sources: Sources, verdict: Verdict) -> dict[str, str]:
    if verdict.remedy == FIRST_TRIALS:
        return step(verdict.remedy, "./run dvc repro")
    if not verdict.winner and not verdict.remedy:
        return step("Run the stages of this loop.", "./run dvc repro compose_parts")
    if verdict.state != PASSED and verdict.remedy:
        return step(f"{verdict.remedy.rstrip('.')}; then run it again.", "./run dvc repro")
    if real(sources):
        return step("Compose the commands of a part.", "./run beadline compose PART.gcode")
    return step("Compose a part of your own.", "./run beadline compose PART.gcode --verify")


# ---- the part that decides


@or_gap
def deciding(sources: Sources, verdict: Verdict) -> Deciding | Missing:
    """Six seconds of the part on which the composer in use fares worst, about its largest error."""
    parts, table = need(structures(sources.evidence)), need(sources.tables["signals"])
    names = shown(verdict.winner or "", parts)
    used = verdict.winner or names[0]
    found = worst(parts, used)
    part = found[1] if found else None
    rows = around_worst(table, part.part, part.material, used, STRETCH_S) if part else ()
    if part is None or not np.isfinite(table[f"{used}_mm3_per_s"][rows]).any():
        return Missing("not measured", "no flow of the part that decides was kept")
    stretch = {key: table[key][rows] for key in table}
    drawn = [name for name in names if np.isfinite(stretch.get(f"{name}_mm3_per_s", np.nan)).any()]
    finding = f"{part.part}, material {part.material}, about the largest error:"
    listed = ", ".join(
        f"{NAMES[name]} leaves {percent(part.scores[name].error, 2)}" for name in drawn if name in part.scores
    )
    return Deciding(
        finding,
        draw_flows(stretch, drawn, f"{finding} {listed}", PICTURE),
        flow_key(drawn),
        page.in_viewer("signals", part=[part.part], material=[part.material], y=lines_of(drawn)),
    )


def moves(sources: Sources, parts: Sequence[Structure]) -> list[Move]:
    """Of every structure and material the flow error of the composer in use. These errors have no bands: one
    simulated print each, the same at every run; so noise is what the choice between composers calls equal.
    """
    return [_move(sources, part) for part in parts] if known(sources.accepted, None) else []


def _move(sources: Sources, structure: Structure) -> Move:
    question = Question(
        0,
        "flow_error_percent",
        f"Flow error, {structure.part}, {structure.material}",
        "%",
        structure.asked.flow_error_percent,
        False,
        "",
    )
    score = structure.known().get(structure.chosen)
    why = NOT_JUDGED if structure.unknown() else "not measured"
    now = Missing(why, "nothing to compare") if score is None else count_of(score.error)
    return move(question, _accepted(sources, structure), now, SAME)


def _accepted(sources: Sources, structure: Structure) -> Figure | None:
    """The error of the composer that was in use then, which may be another one."""
    parts = known(lookup(sources.accepted, "metrics.compose_parts"), {})
    then = parts.get(structure.part, {}).get(structure.material, {})
    score = then.get(then.get("chosen"))
    return count_of(float(score["rms_percent_of_on_off"])) if score else None
