"""The tables of the temperature page: every controller on the common yardstick, the study's figures as
published, panel, weights, and the findings in words."""

import math
from typing import Any

from pipeline.report.shared.digits import MINUS, THIN, band, decimals, number, percent, quantity, short
from pipeline.report.shared.pictures import ORDER
from pipeline.report.shared.sources import Sources, lookup
from pipeline.report.shared.verdict import FAILED, UNDECIDED, Figure, Missing, Question, state
from pipeline.report.shared.words import FIXED, explaining
from pipeline.report.temperature.answers import LABELS, all_answers

EXTRA = (
    ("tracking_degC", "Tracking error, r.m.s.", "°C"),
    ("effort_percent", "Effort, r.m.s. input", "%"),
    ("outside_limits_percent", "Commands outside limits, if unclipped", "%"),
)


def yardstick(sources: Sources, asked: list[Question]) -> dict[str, Any]:
    """Rows are figures, columns controllers; the rule's limit beside them."""
    answers = all_answers(sources, asked)
    names = [name for name in ORDER if name in answers or name == "kernel"]
    heads = [
        {"mark": name, "word": FIXED[name][0], "name": LABELS[name][0], "method": LABELS[name][1]}
        for name in names
    ]
    rows = [
        _row(
            question, names, [answers.get(name, {}).get(question.key, _no_kernel(sources)) for name in names]
        )
        for question in asked
    ]
    for key, title, unit in EXTRA:
        question = Question(0, key, title, unit, math.inf, False, "")
        rows.append(_row(question, names, [_extra(sources, name, key) for name in names]))
    stable = [
        lookup(sources.metrics["evaluate_temperature"], f"controllers.{name}.stable_plants") for name in names
    ]
    cells = [
        {
            "value": s.state if isinstance(s, Missing) else f"{s['count']} of {s['of']}",
            "band": "",
            "bad": not isinstance(s, Missing) and s["count"] < s["of"],
            "best": False,
            "title": "",
        }
        for s in stable
    ]
    rows.append(
        {"title": "Plants of the spread held stable", "word": "Plant spread", "limit": "", "cells": cells}
    )
    return {"heads": heads, "rows": rows}


def _no_kernel(sources: Sources) -> Missing:
    learned = sources.metrics["learn_kernel"]
    refused = learned.get("refused") if isinstance(learned, dict) else None
    return Missing("failed", str(refused)) if refused else Missing("not measured", "there is no kernel")


def _extra(sources: Sources, name: str, key: str) -> Figure | Missing:
    found = lookup(sources.metrics["evaluate_temperature"], f"controllers.{name}.{key}")
    if isinstance(found, Missing):
        return found
    return Figure(*(math.inf if found.get(end) is None else found[end] for end in ("median", "low", "high")))


def _row(question: Question, names: list[str], figures: list[Figure | Missing]) -> dict[str, Any]:
    # the controller that was told the truth is a yardstick, not a competitor
    values = [
        f.value
        for name, f in zip(names, figures, strict=True)
        if isinstance(f, Figure) and name != "exact_model"
    ]
    best = (max if question.at_least else min)(values, default=math.nan)
    finite = [f for f in figures if isinstance(f, Figure) and math.isfinite(f.value)]
    limit_places = max((decimals(f.low, f.high, value=f.value) for f in finite), default=1)
    cells = []
    for name, figure in zip(names, figures, strict=True):
        if isinstance(figure, Missing):
            cells.append(
                {
                    "value": figure.state,
                    "band": "",
                    "bad": figure.state == FAILED,
                    "best": False,
                    "title": figure.sentence(),
                }
            )
            continue
        places = (
            0
            if question.key == "data" and figure.value >= 10
            else decimals(figure.low, figure.high, value=figure.value)
        )
        held = state(question, figure) if math.isfinite(question.limit) else ""
        note = figure.note if question.key in ("data", "settled_error_degC") else ""
        bands = band(figure.low, figure.high, places, beyond=question.beyond)
        cells.append(
            {
                "value": quantity(figure.value, question.unit, places, beyond=question.beyond),
                "band": ", ".join(
                    filter(None, [bands, note.split(" samples")[0], held if held == UNDECIDED else ""])
                ),
                "bad": held == FAILED,
                "best": figure.value == best and name != "exact_model" and question.key != "data",
                "title": "",
            }
        )
    limit = (
        ""
        if math.isinf(question.limit)
        else (
            f"{'≥' if question.at_least else '≤'} "
            f"{quantity(question.limit, question.unit, min(limit_places, 1 if question.limit < 10 else 0))}"
        )
    )
    return {"title": question.title, "word": explaining(question.key), "limit": limit, "cells": cells}


# ---- as published

CONVENTIONS = {
    "model_based": (
        "Model-based, Q = R = I",
        (
            "J counts the observer’s temperatures, not the barrel’s, its first stage twice; the observer "
            "starts at 50 °C; “100” is the 100th sample."
        ),
    ),
    "model_based_tuned": (
        "Model-based, tuned",
        "The same, and J weighs with the tuned Q and R: another currency. The fifth q is 0.0514, "
        "not the printed 0.514.",
    ),
    "data_driven": (
        "Data-driven, Q = R = I",
        "Seven start-up steps first drive the barrel to 0 °C, and make 80 % of J; u′Ru is not discounted; "
        "all data are divided by 1000.",
    ),
    "data_driven_tuned": (
        "Data-driven, tuned",
        "The same; J weighs u with R = I although the controller was tuned for another R.",
    ),
}


def published(sources: Sources) -> dict[str, Any]:
    """The study's four columns, printed and reproduced, with the convention that it takes."""
    printed, found = (
        lookup(sources.metrics["evaluate_temperature"], key) for key in ("printed", "as_published")
    )
    gap = next((part for part in (printed, found) if isinstance(part, Missing)), None)
    if gap:
        return {"missing": gap, "rows": []}
    rows = []
    for key, (title, convention) in CONVENTIONS.items():
        if key in printed and key in found:
            cells = []
            for name, places in (("J100", 1), ("J1000", 1), ("error", 4)):
                theirs, ours = printed[key][name], found[key][name]
                off = abs(ours / theirs - 1)
                cells.append(
                    {
                        "printed": number(theirs, places),
                        "ours": number(ours, places),
                        "off": percent(100 * off, 2) if off > 1e-3 else "",
                    }
                )
            rows.append({"title": title, "convention": convention, "cells": cells})
    return {"missing": None, "rows": rows}


def honest(sources: Sources) -> list[tuple[str, str]]:
    """The same machine, counted once: true outputs, Q = R = I, from 20 °C."""
    found = sources.metrics["evaluate_temperature"]
    items = (
        ("optimal.J1000", "Exact optimum, J over 1,000 steps", 1),
        ("observer.J1000", "Observer started from the first measurement", 1),
        ("observer.J1000_from_50_degC", "Observer started at 50 °C, as published", 1),
    )
    rows = [
        (title, value.state if isinstance(value := lookup(found, key), Missing) else number(value, places))
        for key, title, places in items
    ]
    gaps = (
        ("kernel.gap", "Kernel, noise-free, 500 samples: gap"),
        ("kernel.gap_window_6", "Kernel, window of 6, 1,610 samples: gap"),
        ("kernel.any_reference_gap", "Kernel, 20 random references from 540 samples: worst gap"),
        ("takeover.zero_history_gap", "Taking over with an empty history: gap"),
    )
    return rows + [
        (title, value.state if isinstance(value := lookup(found, key), Missing) else percent(100 * value, 2))
        for key, title in gaps
    ]


# ---- what was declared


def panel(sources: Sources) -> list[tuple[str, str]]:
    """The panel as the parameters declare it."""
    p, machine, tracking = sources.declared.panel, sources.declared.machine, sources.declared.tracking

    def listed(values, unit: str = "") -> str:
        return ", ".join(short(float(v), 4).replace("-", MINUS) for v in values) + (
            THIN + unit if unit else ""
        )

    def half(part) -> str:
        return (
            f"held at {listed(part.starts_degC, '°C')}; references "
            f"{listed(part.reference_offsets_degC, '°C')} "
            f"off the ones below; seeds {', '.join(map(str, part.seeds))}"
        )

    plants = lookup(sources.tables["summary"], "plants")
    simulated = sources.declared.everything.get("generate_probing", {}).get("source") == "simulated"
    spread = (
        f"each column of B by 1 ± {p.input_gain:g} and A {MINUS} {p.extra_heat_loss_per_step:g} I"
        if simulated
        else "the identified model’s uncertainty"
    )
    return [
        (
            "Judged on",
            (
                f"{'' if isinstance(plants, Missing) else f'{plants} plants: '}"
                f"{'the study’s machine and ' if simulated else ''}its "
                f"spread, {spread}"
            ),
        ),
        ("Judging half", half(p.judging)),
        ("Training half", f"{half(p.training)}; weights are tuned here and nowhere else"),
        ("References", ", ".join(f"{o.name} {o.reference:g}" for o in machine.outputs) + f"{THIN}°C"),
        ("Noise", f"{listed(p.noise_degC, '°C')}, seen by the controller, not by the judge"),
        (
            "Run",
            f"{p.hold_steps} steps of watching the plant held, then {number(p.steps, 0)} steps of "
            f"{machine.sample_time_s:g}{THIN}s",
        ),
        (
            "Settled",
            f"every zone within {p.band_degC:g}{THIN}°C for good; "
            "the settled error is the mean of the last third",
        ),
        (
            "Yardstick",
            f"Q = {tracking.yardstick_q:g} I, R = {tracking.yardstick_r:g} I, "
            f"γ = {tracking.gamma:g}, true outputs",
        ),
        (
            "As deployed",
            (
                f"commands clipped to {min(i.low for i in machine.inputs):g} to "
                f"{max(i.high for i in machine.inputs):g}{THIN}%; feasible target; outer integrator "
                f"{tracking.integral:g} a step on errors up to {tracking.integral_limit_degC:g}{THIN}°C"
            ),
        ),
    ]


def weights(sources: Sources) -> dict[str, Any]:
    """The tuned weights, a row a mode."""
    found, machine = sources.tables["weights"], sources.declared.machine
    heads = [o.name for o in machine.outputs], [i.name for i in machine.inputs]
    if isinstance(found, Missing):
        return {"missing": found, "heads": heads, "rows": []}
    names = {"practical": "practical, deployed", "parity": "the study’s objective"}
    rows = [
        {
            "title": names[mode],
            "q": [short(v, 2) for v in found[mode]["q"]],
            "r": [short(v, 2) for v in found[mode]["r"]],
        }
        for mode in names
        if mode in found and len(found[mode]["q"]) == len(heads[0]) and len(found[mode]["r"]) == len(heads[1])
    ]
    return {"missing": None, "heads": heads, "rows": rows}


def identified(sources: Sources) -> list[tuple[str, str]]:
    """What identification says about its model."""
    found = sources.metrics["identify_plant"]
    if isinstance(found, Missing):
        return [("Model", f"{found.state}: {found.sentence()}")]
    rows = [
        (title, str(found[key]))
        for key, title in (
            ("order", "Order"),
            ("past", "Past samples used"),
            ("rows", "Rows of the regression"),
            ("dropped_rows", "Rows left out"),
        )
        if key in found
    ]
    fit = found.get("fit_holdout")
    if isinstance(fit, dict):
        rows.append(
            (
                "Fit on the hold-out",
                ", ".join(
                    f"{name} {number(value, 1)}{THIN}%"
                    if isinstance(value, int | float)
                    else f"{name} {value}"
                    for name, value in fit.items()
                ),
            )
        )
    else:
        rows.append(("Fit on the hold-out", "not measured"))
    ahead = found.get("fit_holdout_ahead")
    if isinstance(ahead, dict):
        rows.append(
            (
                f"Fit {found.get('ahead_steps', '')} steps ahead",
                ", ".join(f"{name} {number(value, 1)}{THIN}%" for name, value in ahead.items()),
            )
        )
    white = found.get("whiteness_passed")
    words = {
        True: "passed: what the model leaves over looks like noise",
        False: "failed: the model leaves something over that it should explain",
    }
    rows.append(
        (
            "Whiteness of the residuals",
            words.get(white, "not measured")
            if not isinstance(white, dict)
            else ", ".join(f"{k} {'passed' if v else 'failed'}" for k, v in white.items()),
        )
    )
    return rows + [
        (title, str(note))
        for key, title in (("notes", "Note"), ("advice", "Advice"))
        for note in found.get(key) or []
    ]
