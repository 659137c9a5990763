"""The temperature loop on page one: a baseline, the model-based and the data-driven controller, with the one
that the verdict is about among them; and the case that decides."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from pipeline.report.shared import charts, page
from pipeline.report.shared.card import PICTURE, Card, Deciding, cell, entrant, of_verdict, step
from pipeline.report.shared.sources import Sources
from pipeline.report.temperature.judgement import Judgement
from pipeline.report.temperature.pictures import IDLE, PI, contestants, runs_of, until_settled
from pipeline.verdict.controllers import heading
from pipeline.verdict.digits import THIN, count, number, short
from pipeline.verdict.evidence import Table, entry, gap_of, need, need_figure, or_gap, or_nothing
from pipeline.verdict.temperature import comparison, finite
from pipeline.verdict.verdict import FAILED, OPEN, PASSED, Figure, Missing, Question, Verdict, state
from pipeline.verdict.wording import OFF_THE_SCALE, banded, limit_text, places_of, worded

MOVES = "Heaters and motor to barrel temperatures"
# the first two figures of the card; the third is the one that decides, else overshoot
FIGURES = ("settled_error", "settling")
NOT_JUDGED = Missing(OPEN, "It was not judged")
WITHOUT_GCODE = "printed_file"  # what ingest flags: the file of a print is not beside the log


def card(sources: Sources, judged: Judgement, verdict: Verdict) -> Card:
    """Three figures of a baseline, the model-based and the data-driven controller."""
    names = contestants(sources, judged)
    asked = {question.key: question for question in judged.asked}
    third = next((q.key for q in judged.asked if verdict.rule and q.rule == verdict.rule), "overshoot")
    keys = [*FIGURES, "overshoot" if third in FIGURES else third]
    told = [name for name in names if judged.answers.get(name)]
    gap = gap_of(sources.metrics["evaluate_temperature"])
    return of_verdict(
        verdict,
        MOVES,
        _step(sources, verdict),
        entrants=[
            entrant(name, heading(name), f"{note}{failure(judged, name, keys)}")
            for name, note in names.items()
        ],
        rows=[_row(asked[key], judged, list(names)) for key in keys if key in asked] if told else [],
        basis=f"90{THIN}% quantile; small: 90{THIN}% band",
        beside=beside_plain(sources, judged),
        cost=_cost(sources),
        picture=deciding(sources, judged),
        sources=sources.source("evaluate_temperature"),
        missing=gap.sentence() if gap else "",
    )


def failure(judged: Judgement, name: str, shown: Sequence[str]) -> str:
    """The first rule that a controller fails, if none of the figures `shown` says so."""
    answers = judged.answers.get(name, {})
    failed = [
        question
        for question in judged.asked
        if state(question, answers.get(question.key, NOT_JUDGED)) == FAILED
    ]
    if not failed or any(question.key in shown for question in failed):
        return ""
    # "Margin: disk, of the weakest tenth" -> "disk margin"
    return f"; fails {' '.join(reversed(failed[0].title.split(', ')[0].lower().split(': ')))}"


def beside_plain(sources: Sources, judged: Judgement) -> str:
    """What a PI by SIMC's rules, which nobody tuned, costs beside the subject of the verdict, and the first
    rule that it fails; "" if it is the subject or was not judged."""
    plain = PI[0]
    compared = entry(comparison(sources.metrics), "contestants") or {}
    ours, theirs = (finite(entry(compared, name, "cost", "median")) for name in (judged.subject, plain))
    if judged.subject == plain or not ours < math.inf > theirs:
        return ""
    less = 100 * (1 - theirs / ours)
    share = number(abs(less), 0)
    amount = f"{share}{THIN}% {'cheaper' if less > 0 else 'dearer'} than" if share != "0" else "as cheap as"
    return f"{heading(plain)}: {amount} {heading(judged.subject)}{failure(judged, plain, ())}."


@or_nothing
def _cost(sources: Sources) -> str:
    """Minutes of record that were learned from."""
    samples = need_figure(sources.metrics["ingest"], "samples")
    minutes = samples * sources.declared.machine.sample_time_s / 60
    return f"{short(minutes, 3)} minutes of record"


def _row(question: Question, judged: Judgement, names: Sequence[str]) -> dict[str, Any]:
    figures = [judged.answers.get(name, {}).get(question.key, NOT_JUDGED) for name in names]
    places = places_of(question, figures)
    # doing nothing is no contestant: it never overshoots
    values = [
        figure.value
        for name, figure in zip(names, figures, strict=True)
        if isinstance(figure, Figure) and name != IDLE
    ]
    best = (max if question.at_least else min)(values, default=math.nan)
    # a row in which all are alike has no best one
    led = len({worded(question, value, places) for value in values}) > 1
    return {
        "title": question.title.split(", ")[0],
        "limit": limit_text(question),
        "cells": [
            _cell(question, figure, places, best, leads=led and name != IDLE)
            for name, figure in zip(names, figures, strict=True)
        ],
    }


def _cell(
    question: Question, figure: Figure | Missing, places: int, best: float, *, leads: bool
) -> dict[str, Any]:
    if isinstance(figure, Missing):
        return cell(figure.state, bad=figure.state == FAILED)
    text = worded(question, figure.value, places)
    best_one = (
        leads and math.isfinite(best) and text == worded(question, best, places) and text != OFF_THE_SCALE
    )
    return cell(
        text,
        banded(question, figure, places),
        best=best_one,
        bad=math.isfinite(question.limit) and state(question, figure) == FAILED,
    )


def _step(sources: Sources, verdict: Verdict) -> dict[str, str]:
    if gap_of(sources.metrics["evaluate_temperature"]):
        return step("Run the stages of this loop.", "./run dvc repro evaluate_temperature")
    if not sources.recorded:
        return step("Record your own machine.", "./run beadline init RECORDING.csv --copy")
    if verdict.state == PASSED:
        folder = "datasets/export_controllers/temperature"
        return step(
            "Replay it on a recording before a trial.", f"./run beadline replay {folder} RECORDING.csv"
        )
    # how many prints of the recordings have no G-code file beside them
    if unrecorded := int(entry(sources.metrics["ingest"], "findings", "recording", WITHOUT_GCODE) or 0):
        return step(
            "Put the printed G-code files beside klippy.log: without them part fan and filament feed of "
            f"{count(unrecorded, 'print')} are not recorded.",
            "./run beadline init klippy.log --copy --force",
        )
    return step("Record the next experiment.", "./run beadline experiment temperature")


@or_gap
def deciding(
    sources: Sources, judged: Judgement, size: tuple[int, int] = PICTURE, lead: str = ""
) -> Deciding | Missing:
    """The output furthest from its reference in the deciding case, a line a contestant; `lead` begins the
    finding."""
    table = need(sources.tables["trajectories"])
    runs, zone = runs_of(sources, judged, table)
    if not runs:
        return Missing("not measured", "no trajectory of the deciding case was recorded")
    seconds = until_settled(table, runs, zone)
    early = {who: rows[table["time_s"][rows] <= seconds] for who, rows in runs.items()}
    label = sources.zone([o.name for o in sources.declared.machine.outputs].index(zone))
    styles, limit = page.line_styles({who: who for who in runs}), sources.declared.rules.settled_error_degC
    finding = f"{lead}The last second in which {label} is off its reference by more than {limit:g}{THIN}°C"
    until = {who: f"{heading(who)} {_last_off(table, rows, zone, limit)}" for who, rows in early.items()}
    key = page.line_key([*((until[who], styles[who]) for who in until), ("limit", "lim")])
    alt = f"{finding}: {', '.join(until.values())}."
    return Deciding(
        f"{finding}:",
        _drawn(table, early, zone, limit, alt, size, styles),
        key,
        page.in_viewer("trajectories", case_name=["deciding"], contestant=list(runs), y=[zone]),
    )


def _last_off(table: Table, rows: np.ndarray, zone: str, limit: float) -> str:
    """The last time, in s, at which the zone is off its reference by more than `limit`."""
    time, off = table["time_s"][rows], np.abs(table[zone][rows] - table[f"{zone}_reference"][rows])
    outside = time[~(off <= limit)]
    if len(outside) and outside[-1] == time[-1]:
        return f"beyond {time[-1]:,.4g}{THIN}s"
    return f"{outside[-1]:,.4g}{THIN}s" if len(outside) else "none"


def _drawn(
    table: Table, runs: dict[str, np.ndarray], zone: str, limit: float, alt: str, size: tuple[int, int],
    styles: dict[str, str],
) -> Markup:  # fmt: skip
    """By how much the zone is off its reference, log scale, the controllers over one another; the level
    line is the limit of the settled error."""
    time, rows = table["time_s"], np.concatenate(list(runs.values()))
    off = np.abs(table[zone] - table[f"{zone}_reference"])
    finite = off[rows][np.isfinite(off[rows])]
    most = float(min(max(finite.max(initial=1.0), 2 * limit), 1e4))
    ticks = tuple((tick, f"{tick:g}") for tick in (0.01, 0.1, limit, 10.0, 100.0) if tick < most)
    frame = charts.Frame(
        charts.linear(0, float(time[rows].max()) or 1.0), charts.Axis(0.01, most, ticks, True),
        *size, 40, 34, 22, 14,
    )  # fmt: skip
    layers = [charts.level(frame, limit, "lim")]
    for who, mine in runs.items():
        layers.append(charts.line(frame, time[mine], np.maximum(off[mine], 0.01), styles[who], most=120))
    return charts.panel(
        frame, layers, alt=alt, css="mb lead-picture", title="off the reference, °C, log", across="time, s",
        units=("s", "°C"),
    )  # fmt: skip
