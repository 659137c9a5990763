"""The temperature loop on page one: the contestant that the verdict is about, its rival, and what runs now,
PI or doing nothing; and the case that decides."""

import math
from collections.abc import Sequence

import numpy as np

from pipeline.report.shared import charts, page
from pipeline.report.shared.card import (
    Card,
    CardCell,
    CardRow,
    CardStep,
    Deciding,
    Entrant,
    note_of,
    of_verdict,
)
from pipeline.report.shared.sources import Sources
from pipeline.report.temperature.deciding import degrees, runs_of, until_settled
from pipeline.report.temperature.judgement import Judgement, named_before
from pipeline.report.temperature.scorecard import setting
from pipeline.verdict.controllers import heading, kind
from pipeline.verdict.digits import THIN, count, declared, short, with_unit
from pipeline.verdict.evidence import Table, lookup
from pipeline.verdict.temperature import comparison
from pipeline.verdict.verdict import FAILED, OPEN, PASSED, Figure, Missing, Question, Verdict, state
from pipeline.verdict.wording import OFF_THE_SCALE, banded, places_of, worded

MOVES = "Heaters and motor to barrel temperatures"
# who stands beside the pair where nobody runs yet: PI, or doing nothing where the verdict is about PI
PI, IDLE = ("pi_simc", "pi"), "hold"
# the first two figures of the card; the third is the one that decides, else overshoot
FIGURES = ("settled_error", "settling")
NOT_JUDGED = Missing(OPEN, "It was not judged")
WITHOUT_GCODE = "printed_file"  # what ingest flags: the file of a print is not beside the log
STYLES = {"dd": "line dd", "mb": "line", "bl": "line bl"}


def card(sources: Sources, judged: Judgement, verdict: Verdict) -> Card:
    """Three figures of the contestant, its rival and a yardstick."""
    names = contestants(sources, judged)
    asked = {question.key: question for question in judged.asked}
    third = next((q.key for q in judged.asked if verdict.rule and q.rule == verdict.rule), "overshoot")
    keys = [*FIGURES, "overshoot" if third in FIGURES else third]
    told = [name for name in names if judged.answers.get(name)]
    gap = sources.metrics["evaluate_temperature"]
    return of_verdict(
        verdict,
        MOVES,
        _step(sources, verdict),
        entrants=[Entrant(name, heading(name), note) for name, note in names.items()],
        rows=[_row(asked[key], judged, list(names)) for key in keys if key in asked] if told else [],
        basis=f"90{THIN}% quantile of {setting(comparison(sources.metrics))}; small: its 90{THIN}% band.",
        beside=verdict.short_answer,
        sources=sources.source("evaluate_temperature"),
        missing=gap.sentence() if isinstance(gap, Missing) else "",
    )


def contestants(sources: Sources, judged: Judgement) -> dict[str, str]:
    """Whom the card shows, and what each is here."""
    runs = named_before(sources)
    champion = isinstance(sources.nightly, dict) and runs
    runs_now = "runs now" if champion else "as before"
    names = {judged.subject: runs_now if judged.subject == runs else note_of(judged.verdict)}
    names[judged.rival] = runs_now if judged.rival == runs else kind(judged.rival)
    yardsticks = (IDLE,) if set(names) & set(PI) else (*PI, IDLE)
    third = next(
        (name for name in (runs, *yardsticks) if name and name not in names and judged.answers.get(name)), ""
    )
    return names | ({third: runs_now if third == runs else "yardstick"} if third else {})


def _row(question: Question, judged: Judgement, names: Sequence[str]) -> CardRow:
    figures = [judged.answers.get(name, {}).get(question.key, NOT_JUDGED) for name in names]
    places = places_of(question, figures[:2])
    # doing nothing is no contestant: it never overshoots
    values = [
        figure.value
        for name, figure in zip(names, figures, strict=True)
        if isinstance(figure, Figure) and name != IDLE
    ]
    best = (max if question.at_least else min)(values, default=math.nan)
    limit = (
        f"{'≥' if question.at_least else '≤'} "
        f"{with_unit(question.limit, question.unit, declared(question.limit))}"
        if math.isfinite(question.limit)
        else ""
    )
    # a row in which all are alike has no best one
    led = len({worded(question, value, places) for value in values}) > 1
    return CardRow(
        question.title.split(", ")[0],
        limit,
        [
            _cell(question, figure, places, best, leads=led and name != IDLE)
            for name, figure in zip(names, figures, strict=True)
        ],
    )


def _cell(question: Question, figure: Figure | Missing, places: int, best: float, *, leads: bool) -> CardCell:
    if isinstance(figure, Missing):
        return CardCell(figure.state, bad=figure.state == FAILED)
    text = worded(question, figure.value, places)
    best_one = (
        leads and math.isfinite(best) and text == worded(question, best, places) and text != OFF_THE_SCALE
    )
    bad = math.isfinite(question.limit) and state(question, figure) == FAILED
    return CardCell(text, banded(question, figure, places), best_one, bad)


def _step(sources: Sources, verdict: Verdict) -> CardStep:
    if isinstance(sources.metrics["evaluate_temperature"], Missing):
        return CardStep("Run the stages of this loop.", "./run dvc repro evaluate_temperature")
    if not sources.recorded:
        return CardStep("Record your own machine.", "./run beadline init RECORDING.csv --copy")
    if verdict.state == PASSED:
        folder = "datasets/export_controllers/temperature"
        return CardStep(
            "Replay it on a recording before a trial.", f"./run beadline replay {folder} RECORDING.csv"
        )
    if unrecorded := _without_gcode(sources):
        return CardStep(
            "Put the printed G-code files beside klippy.log: without them part fan and filament feed of "
            f"{count(unrecorded, 'print')} are not recorded.",
            "./run beadline init klippy.log --copy --force",
        )
    return CardStep("Record the next experiment.", "./run beadline first-experiment")


def _without_gcode(sources: Sources) -> int:
    """How many prints of the recordings have no G-code file beside them."""
    found = lookup(sources.metrics["ingest"], "findings")
    if isinstance(found, Missing):
        return 0
    return int(found.get("recording", {}).get(WITHOUT_GCODE, 0))


def deciding(sources: Sources, judged: Judgement) -> Deciding | Missing:
    """The output furthest from its reference in the deciding case, a line a contestant."""
    table = sources.tables["trajectories"]
    if isinstance(table, Missing):
        return table
    runs, zone = runs_of(sources, judged, table)
    if not runs:
        return Missing("not measured", "no trajectory of the deciding case was recorded")
    seconds = until_settled(table, runs, zone)
    early = {who: rows[table["time_s"][rows] <= seconds] for who, rows in runs.items()}
    label = sources.zone([o.name for o in sources.declared.machine.outputs].index(zone))
    ends = {
        who: float(np.abs(table[zone] - table[f"{zone}_reference"])[rows[-1]]) for who, rows in runs.items()
    }
    listed = ", ".join(f"{i} {heading(who)} {short(end, 2)}" for i, (who, end) in enumerate(ends.items(), 1))
    finding = (
        f"{label[:1].upper()}{label[1:]} ends off its reference (dashed) by, in °C: {listed}. "
        f"{judged.deciding}"
    )
    step = sources.declared.machine.sample_time_s
    convention = "" if sources.recorded else f" One step counts as {step:g}{THIN}s, by convention."
    wide, narrow = (_drawn(table, early, zone, finding, size) for size in ((566, 212), (350, 240)))
    return Deciding(
        "Temperature, the case that decides",
        finding,
        wide,
        narrow,
        convention.strip(),
        page.in_viewer("trajectories", case_name=["deciding"], contestant=list(runs), y=[zone]),
    )


def _drawn(table: Table, runs: dict[str, np.ndarray], zone: str, alt: str, size: tuple[int, int]):
    time, rows = table["time_s"], np.concatenate(list(runs.values()))
    frame = charts.Frame(
        charts.linear(0, float(time[rows].max()) or 1.0), degrees(table, rows, zone), *size, 40, 34, 22, 14
    )
    first = next(iter(runs.values()))
    layers = [charts.line(frame, time[first], table[f"{zone}_reference"][first], "ref")]
    used = set()
    for i, (who, mine) in enumerate(runs.items(), 1):
        style, y = STYLES.get(page.MARKS.get(who, "bl"), "line"), table[zone][mine]
        layers.append(charts.line(frame, time[mine], y, style + (" dash" if style in used else ""), most=120))
        used.add(style)
        # a number of its own height each, where the line comes by
        at = int(np.argmax(np.abs(y - y[0]) >= np.ptp(y) * i / (len(runs) + 1)))
        layers.append(charts.label(frame, time[mine[at]], y[at], str(i), dx=5, dy=4))
    return charts.panel(
        frame, layers, alt=alt, css="mb lead-picture", title="temperature, °C", across="time, s",
        units=("s", "°C"),
    )  # fmt: skip
