"""The table of the temperature page: every contestant as deployed over all plants, median and 90 %
quantile, and what stands below it: bounds that bind, who was refused."""

import math
from collections.abc import Mapping
from typing import Any

from pipeline.report.shared.pictures import as_table
from pipeline.report.shared.sources import Sources
from pipeline.report.temperature.judgement import Judgement, heads
from pipeline.verdict.controllers import BY_NAME, YARDSTICKS, heading
from pipeline.verdict.digits import THIN, count, short
from pipeline.verdict.evidence import Absent, entry, gap_of, need
from pipeline.verdict.temperature import comparison, finite, names, refused, unstable
from pipeline.verdict.verdict import FAILED, UNDECIDED, Figure, Missing, Question, state
from pipeline.verdict.wording import banded, limit_text, places_of, worded

# figures without a rule
UNRULED = (
    Question(0, "energy", "Energy, mean input", "%", math.inf, False, ""),
    Question(0, "travel", "Travel of the input that moves most, a sample", "%", math.inf, False, ""),
    Question(0, "dip", "Largest error under door, fan and another room", "°C", math.inf, False, ""),
    Question(0, "cost", "Cost as deployed", "", math.inf, False, ""),
)
ORDER = (
    "settled_error",
    "peak",
    "settling",
    "heating",
    "overshoot",
    "dip",
    "at_limits",
    "energy",
    "travel",
    "cost",
    "crossings",
    "supervisor",
    "disk",
    "delay_s",
    "data",
)


@as_table()
def scorecard(sources: Sources, judgement: Judgement, words: Mapping[str, str]) -> dict[str, Any]:
    """Every contestant that was judged, in the order of simplicity, and those that were refused."""
    metrics = sources.metrics
    compared = comparison(metrics)
    judged = names(metrics)
    if not judged:
        gap = gap_of(metrics["evaluate_temperature"])
        raise Absent(gap or Missing("not measured", "No contestant was judged"))
    asked = {question.key: question for question in (*judgement.asked, *UNRULED)}
    return {
        "heads": heads(judged),
        "rows": [
            _row(sources, asked[key], judged, judgement, words.get(key, "")) for key in ORDER if key in asked
        ],
        "source": entry(compared, "limits", "source") or "declared",
        "bounds": [(name, entry(compared, "contestants", name, "at_bound")) for name in judged],
        "broken": [(name, entry(compared, "redesigned", name)) for name in judged],
        "refused": refused(metrics),
    }


def setting(compared: Mapping[str, Any]) -> str:
    """ "60 plants, 900 cases, 0.1 °C of noise"."""
    parts = [
        count(value, one) if isinstance(value, int) else ""
        for value, one in ((entry(compared, "plants"), "plant"), (entry(compared, "cases"), "case"))
    ]
    noise = entry(compared, "noise_degC")
    levels = sorted({float(level) for level in (noise if isinstance(noise, list) else [noise]) if level})
    listed = " to ".join(short(level, 2) for level in dict.fromkeys(levels[:1] + levels[-1:]))
    parts.append(f"{listed}{THIN}°C of sensor noise" if listed else "")
    return ", ".join(filter(None, parts)) or "its panel"


def _row(
    sources: Sources, question: Question, names: list[str], judgement: Judgement, word: str
) -> dict[str, Any]:
    figures = [judgement.answers[name][question.key] for name in names]
    values = [
        figure.value
        for name, figure in zip(names, figures, strict=True)
        if isinstance(figure, Figure) and _competes(name) and math.isfinite(figure.value)
    ]
    best = (max if question.at_least else min)(values, default=math.nan)
    places = places_of(question, figures)
    alike = len(set(values)) < 2 or question.key == "data"
    return {
        "key": question.key,
        "title": question.title,
        "word": word,
        "limit": "none" if question.key in ("crossings", "supervisor") else limit_text(question),
        "cells": [
            _cell(
                sources,
                question,
                name,
                figure,
                places,
                best=not alike and getattr(figure, "value", None) == best,
            )
            for name, figure in zip(names, figures, strict=True)
        ],
    }


def _competes(name: str) -> bool:
    """Who may be the best of a row: neither who was told the truth, nor who does nothing."""
    return name != "hold" and name not in YARDSTICKS


def _cell(
    sources: Sources, question: Question, name: str, figure: Figure | Missing, places: int, *, best: bool
) -> dict[str, Any]:
    if isinstance(figure, Missing):
        return {
            "value": figure.state,
            "notes": (),
            "bad": figure.state == FAILED,
            "best": False,
            "title": figure.sentence(),
        }
    own = entry(comparison(sources.metrics), "contestants", name)
    held = state(question, figure) if math.isfinite(question.limit) else ""
    lost, of = unstable(own)
    text = worded(question, figure.value, places)
    if lost and (text == "unstable" or question.key in ("disk", "delay_s")):
        text = f"unstable on {lost} of {of} plants"
    notes = [held if held == UNDECIDED else ""]
    if question.key in ("crossings", "supervisor", "data"):
        notes.insert(0, figure.note.split(" samples")[0])
    else:
        notes = [banded(question, figure, places), *_beside(question, own, places), *notes]
    return {
        "value": text,
        "notes": [note for note in notes if note],
        "bad": held == FAILED,
        "best": best and _competes(name),
        "title": _worst_title(own, question.key),
    }


def _beside(question: Question, own: Any, places: int) -> list[str]:
    """Median, and the worst case with its plant."""
    if question.key in ("disk", "delay_s"):
        plain = question._replace(unit="")
        ends = {end: entry(own, "margins", question.key, end) for end in ("median", "worst")}
        found = [f"{end} {worded(plain, finite(value), places)}" for end, value in ends.items() if value]
        return ["weakest tenth of plants", *found]
    figures = entry(own, question.key)
    if not isinstance(figures, Mapping):
        return []
    notes = []
    bare = question._replace(unit="")
    for key in ("median", "worst"):
        # what never settles on most cases does not in the worst either
        if key in figures and (math.isfinite(finite(figures[key])) or math.isfinite(finite(figures["q90"]))):
            notes.append(f"{key} {worded(bare, finite(figures[key]), places)}")
    lost = entry(own, "never_settled_percent") if question.key == "settling" else None
    if isinstance(lost, int | float) and lost > 0:
        notes.append(f"{short(float(lost), 3)}{THIN}% of cases never")
        return notes
    plant = entry(figures, "worst_case", "plant")
    if notes and "worst" in figures and plant is not None:
        notes.append(f"{notes.pop()}, plant {plant}")
    return notes


def _worst_title(own: Any, key: str) -> str:
    """ "Worst case 412: plant 17, ramp, from 20 °C"."""
    case = entry(own, key, "worst_case")
    if not isinstance(case, Mapping):
        return ""
    start = case.get("start_degC")
    parts = [
        f"plant {case['plant']}" if "plant" in case else "",
        str(case.get("kind") or ""),
        f"from {start:g}{THIN}°C" if isinstance(start, int | float) and abs(start) < 1e4 else "",
    ]
    return f"Worst case {case.get('case', '')}: {', '.join(filter(None, parts))}"


# ---- below the table


def infeasible(sources: Sources) -> list[Mapping[str, Any]]:
    """References that the machine cannot hold, each with the actuator that binds."""
    found = entry(comparison(sources.metrics), "infeasible") or []
    ends = ("asked_degC", "reachable_degC")
    return [one for one in found if all(abs(finite(one.get(end))) < 1e4 for end in ends)]


# ---- what was tuned and declared


@as_table(rows=[])
def weights(sources: Sources) -> dict[str, Any]:
    """The tuned values of every contestant, from the weights that were stored."""
    table = need(sources.tables["weights"])
    tuned = entry(table, "contestants") or {}
    rows = [
        (
            heading(name),
            "; ".join(
                f"{key} {_listed(value)}"
                for key, value in tuned[name].items()
                if key != "at_bound" and value is not None
            ),
        )
        for name in (*BY_NAME, *(name for name in tuned if name not in BY_NAME))
        if isinstance(tuned.get(name), Mapping)
    ]
    if not rows:
        raise Absent(Missing("not measured", "no contestant was tuned"))
    return {"rows": rows}


def _listed(value: Any) -> str:
    if isinstance(value, list) and len(value) > 1 and len(set(map(str, value))) == 1:
        return f"{_listed(value[0])} each"
    values = value if isinstance(value, list) else [value]
    return ", ".join(short(v, 3) if isinstance(v, float) else str(v) for v in values)


def declared_panel(sources: Sources) -> dict[str, Any]:
    """How contestants were compared."""
    compared, machine = comparison(sources.metrics), sources.declared.machine
    return {
        "setting": setting(compared),
        "steps": entry(compared, "steps"),
        "band": entry(compared, "band_degC"),
        "seed": entry(compared, "seed"),
        "machine": machine,
        "low": min(i.low for i in machine.inputs),
        "high": max(i.high for i in machine.inputs),
    }
