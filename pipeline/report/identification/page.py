"""The page of the identification: what the model may be used for, every output's fits, what to do, the
pictures behind it, and what the record lost on the way."""

import math
from typing import Any

from pipeline.report.identification import how_identified, pictures
from pipeline.report.shared import charts, page, words
from pipeline.report.shared.pictures import as_table
from pipeline.report.shared.sources import Sources
from pipeline.verdict.digits import MINUS, count, number
from pipeline.verdict.evidence import (
    entry,
    gap_of,
    instead,
    known,
    lookup,
    need,
    need_figure,
    or_gap,
    or_none,
)
from pipeline.verdict.identification import Fit, ahead_words, band_of, fit_figure, fits, least_fit, percent_of
from pipeline.verdict.verdict import FAILED, PASSED, UNDECIDED, Figure, Missing, Question, Verdict, state

WORDS = (
    "trusted",
    "fit",
    "simulation",
    "ahead",
    "held",
    "free_mean",
    "closed_loop",
    "feedthrough",
    "first_order",
    "simc",
    "holdout",
    "fit_band",
    "whiteness",
    "inputs_left",
    "excitation",
    "identified_spread",
    "accepted",
)


def render(sources: Sources) -> str:
    """The text of identification.html."""
    judged_fits, judged, ahead = fits(sources.evidence), sources.model, ahead_words(sources.evidence)
    return page.render(
        "identification.html",
        here="identification",
        sources=sources,
        title=f"Identification: {judged.decision.rstrip('.')}",
        trust=judged,
        ahead=ahead[:1].upper() + ahead[1:],
        answers=[answer(sources, fit, ahead) for fit in judged_fits],
        judged_on=_judged_on(sources),
        advice=advice(sources, judged),
        taken=how_identified.loop_state(sources),
        flagged=how_identified.flagged(sources),
        by_output=how_identified.fit_table(sources, judged_fits),
        heaters=how_identified.heater_table(sources),
        chosen=how_identified.chosen(sources),
        band_of=band_of,
        percent_of=percent_of,
        holdout=pictures.holdout(sources, judged_fits, ahead),
        white=pictures.whiteness(sources),
        cross=pictures.cross(sources),
        steps=pictures.steps(sources),
        order=pictures.order(sources),
        poles=pictures.poles(sources),
        excitation=pictures.excitation(sources),
        planned=next_experiment(sources),
        from_planned=sources.source("generate_probing"),
        losses=losses(sources),
        used=used(sources),
        from_metrics=sources.source("identify_plant", "holdout", "residuals"),
        from_fits=sources.source("identify_plant"),
        from_heaters=sources.source("first_order", "ingest"),
        from_record=sources.source("record", "quality", "ingest", "identify_plant"),
        words=words.chosen(sources, WORDS),
    )


@or_none
def _judged_on(sources: Sources) -> dict[str, Any]:
    """The share of every stretch that the model is judged on, and the samples held out, of all."""
    metrics = sources.metrics["identify_plant"]
    return {
        "share": need_figure(sources.declared.everything, "identify_plant.holdout_share"),
        "held": need_figure(metrics, "samples_holdout"),
        "samples": need_figure(metrics, "samples"),
    }


# ---- a row for each output


def answer(sources: Sources, fit: Fit, ahead: str) -> dict[str, Any]:
    """Fits with bands, the yardstick, the share that is missed as a strip, what the
    residuals say, and the change since the accepted run."""
    question = Question(0, "", fit.name, "%", least_fit(), True, "")
    states = [state(question, fit.simulated), _ahead_state(fit, question)]
    shown = [
        ("Simulation", "mb", _missed(fit.simulated)),
        (ahead, "mb hollow", _missed(fit.ahead)),
        ("Holding the last value", "acc", _missed(fit.held)),
    ]
    before = _accepted(sources, fit.name)
    change, moved = since(before, fit.simulated)
    return {
        "name": fit.name,
        "note": _residual_note(sources, fit.name),
        "state": next(
            (wanted for wanted in (FAILED, UNDECIDED) if wanted in states),
            PASSED if states == [PASSED, PASSED] else "not measured",
        ),
        "cells": [
            _fit_cell("dd", "Simulation", fit.simulated, states[0]),
            _fit_cell("mb", ahead[:1].upper() + ahead[1:], fit.ahead, states[1]),
        ],
        "held": percent_of(fit.held),
        "strip": charts.strip(
            Question(0, "", fit.name, "%", 100 - least_fit(), False, ""), shown, (11, 23, 23)
        ),
        "change": change,
        "moved": moved,
    }


@instead(lambda gap: gap.state)
def _ahead_state(fit: Fit, question: Question) -> str:
    """Whether the prediction is better than holding the last value, and good enough."""
    return state(question._replace(limit=max(need(fit.held).value, question.limit)), need(fit.ahead))


def _fit_cell(css: str, name: str, fit: Figure | Missing, outcome: str) -> dict[str, Any]:
    return {
        "css": css,
        "name": name,
        "state": outcome.replace(" ", "-"),
        "missing": gap_of(fit),
        "value": percent_of(fit),
        "band": band_of(fit),
    }


@or_gap
def _missed(figure: Figure | Missing) -> Figure:
    """The share of the movement that the fit misses; none is 0, the mean misses 100 %."""
    fit = need(figure)
    return Figure(100 - fit.value, 100 - fit.high, 100 - fit.low)


@instead(lambda gap: "residuals not measured")
def _residual_note(sources: Sources, name: str) -> str:
    table = need(sources.tables["residuals"])
    failed = table["against"][(table["output"] == name) & ~table["passed"]]
    left = sorted({str(a) for a in failed} - {name})
    parts = ["errors not noise"] * (name in failed) + (
        [f"{left[0]}{f' and {len(left) - 1} more' if left[1:] else ''} left in them"] if left else []
    )
    return "; ".join(parts) or "errors are noise"


def _accepted(sources: Sources, name: str) -> Figure | None:
    if sources.another_machine:
        return None
    return known(fit_figure(lookup(sources.accepted, "metrics.identify_plant"), "fit_holdout", name), None)


def since(before: Figure | None, now: Figure | Missing) -> tuple[str, bool]:
    """The change of a fit in points and whether it is beyond the bands of both runs."""
    if gap := gap_of(now):
        return gap.state, False
    if before is None:
        return "first run", False
    if math.isclose(before.value, now.value, rel_tol=1e-6):
        return f"unchanged, {percent_of(before)}", False
    if before.low <= now.high and now.low <= before.high:
        return f"within noise of {percent_of(before)}", False
    change = now.value - before.value
    return (
        f"{'+' if change > 0 else MINUS}{number(abs(change), 1)} points · "
        f"{'better' if change > 0 else 'worse'}",
        True,
    )


# ---- what to do


def advice(sources: Sources, judged: Verdict) -> list[str]:
    """The identification's own sentences, then the remedies of rules that they do not speak of."""
    model = sources.metrics["identify_plant"]
    sentences = [_sentence(text) for text in entry(model, "advice") or []]
    spoken = {"Inputs used up", "Whiteness", "Excitation"} if sentences else set()
    spoken |= {"Simulation"} if any("hold-out fit" in text for text in sentences) else set()
    sentences += [
        f"{rule.name}: {rule.remedy}"
        for (rule,) in judged.rules
        if rule.state != PASSED and rule.remedy and rule.name not in spoken
    ]
    notes = dict.fromkeys(entry(model, "notes") or [])
    return [*sentences, *(f"Noted while fitting: {text}." for text in notes)]


def _sentence(text: str) -> str:
    text = text.strip().rstrip(".").replace(" -", f" {MINUS}")
    return f"{text[:1].upper()}{text[1:]}."


# ---- tables


@as_table(rows=[])
def losses(sources: Sources) -> dict[str, Any]:
    """For each signal: samples, how many are masked, and what was flagged."""
    table = need(sources.tables["record"])
    flags = lookup(sources.metrics["ingest"], "findings")
    rows = []
    for signal in [*sources.declared.machine.inputs, *sources.declared.machine.outputs]:
        masked, total = int(table[f"{signal.name}_masked"].sum()), len(table["time_s"])
        rows.append((signal.name, total, masked, known(flags, {}).get(signal.name, {})))
    return {"rows": rows, "judged": not gap_of(flags)}


def used(sources: Sources) -> list[tuple[str, str]]:
    """What became of the samples between the recordings and the fit."""
    ingested, identified = sources.metrics["ingest"], sources.metrics["identify_plant"]
    items = (
        (ingested, "recordings", "Recordings read"),
        (ingested, "quarantined", "Recordings quarantined, not used"),
        (ingested, "segments", "Stretches without a gap"),
        (identified, "samples", "Samples of the record"),
        (identified, "samples_cut", "Cut out: an input masked, or no output at all"),
        (identified, "samples_holdout", "Held out to judge"),
        (identified, "rows", "Rows of the regression"),
        (identified, "dropped_rows", "Rows left out: their window touches a masked sample"),
        (identified, "past", "Window, in samples"),
    )
    rows = [
        (title, gap.state if (gap := gap_of(value)) else number(value, 0))
        for value, title in ((lookup(data, key), title) for data, key, title in items)
    ]
    delays = entry(identified, "delays")
    late = [f"{name} {count(steps, 'sample')}" for name, steps in (delays or {}).items() if steps]
    none = "not measured" if delays is None else "none beyond one sample"
    return [*rows, ("Dead time found", ", ".join(late) or none)]


@as_table()
def next_experiment(sources: Sources) -> dict[str, Any]:
    """What generate_probing says of the next experiment, and of the moves to add to a controller's."""
    metrics = sources.metrics["generate_probing"]
    return {
        "told": need_figure(metrics, "next_experiment"),
        "added": need_figure(metrics, "closed_loop"),
        "outputs": [output.name for output in sources.declared.machine.outputs],
    }
