"""The tables of the temperature page: every controller on the common yardstick, panel, weights, and what
identification says."""

import math
from typing import Any, NamedTuple

from pipeline.report.shared.digits import MINUS, THIN, band, decimals, number, quantity, short, with_unit
from pipeline.report.shared.sources import Sources, lookup
from pipeline.report.shared.verdict import FAILED, UNDECIDED, Figure, Missing, Question, state
from pipeline.report.shared.words import FIXED, explaining
from pipeline.report.temperature.answers import LABELS, YARDSTICKS, all_answers, own_integral, without_figures

EXTRA = (
    ("tracking_degC", "Tracking error, r.m.s.", "°C"),
    ("effort_percent", "Effort, r.m.s. input", "%"),
    ("outside_limits_percent", "Commands outside limits, if unclipped", "%"),
)


class Head(NamedTuple):
    """A controller above its column: mark, the word that explains it, heading, method."""

    mark: str
    word: str
    name: str
    method: str


class Cell(NamedTuple):
    """A figure with what stands below it; `title` says why there is none."""

    value: str
    band: str = ""
    bad: bool = False
    best: bool = False
    title: str = ""


class Row(NamedTuple):
    """A figure of every controller, with the word that explains it and the rule's limit."""

    title: str
    word: str
    limit: str
    cells: list[Cell]


class Yardstick(NamedTuple):
    """Rows are figures, columns controllers."""

    heads: list[Head]
    rows: list[Row]


def yardstick(sources: Sources, asked: list[Question]) -> Yardstick:
    """Every controller that was judged or refused; the rule's limit beside them."""
    answers = all_answers(sources, asked)
    gaps = {name: without_figures(sources, name) for name in LABELS}
    names = [name for name in LABELS if name in answers or gaps[name]]
    rows = [
        _row(question, names, [answers.get(name, {}).get(question.key, gaps[name]) for name in names])
        for question in asked
    ]
    for key, title, unit in EXTRA:
        question = Question(0, key, title, unit, math.inf, False, "")
        rows.append(_row(question, names, [_extra(sources, name, key, gaps[name]) for name in names]))
    stable = [
        lookup(sources.metrics["evaluate_temperature"], f"controllers.{name}.stable_plants") for name in names
    ]
    rows.append(
        Row(
            "Plants of the spread held stable",
            "Plant spread",
            "",
            [_stable(s, gaps[name]) for name, s in zip(names, stable, strict=True)],
        )
    )
    return Yardstick([Head(name, FIXED[name][0], *LABELS[name]) for name in names], rows)


def _stable(plants: Any, gap: Missing | None) -> Cell:
    if isinstance(plants, Missing):
        why = gap or plants
        return Cell(why.state, bad=why.state == FAILED, title=why.sentence() if gap else "")
    return Cell(f"{plants['count']} of {plants['of']}", bad=plants["count"] < plants["of"])


def _extra(sources: Sources, name: str, key: str, gap: Missing | None) -> Figure | Missing:
    ends = lookup(sources.metrics["evaluate_temperature"], f"controllers.{name}.{key}")
    if isinstance(ends, Missing):
        return gap or ends
    return Figure(*(math.inf if ends.get(end) is None else ends[end] for end in ("median", "low", "high")))


def _row(question: Question, names: list[str], figures: list[Figure | Missing]) -> Row:
    # a controller that was told the truth is a yardstick, not a competitor
    values = [
        f.value
        for name, f in zip(names, figures, strict=True)
        if isinstance(f, Figure) and name not in YARDSTICKS
    ]
    best = (max if question.at_least else min)(values, default=math.nan)
    finite = [f for f in figures if isinstance(f, Figure) and math.isfinite(f.value)]
    limit_places = max((decimals(f.low, f.high, value=f.value) for f in finite), default=1)
    cells = [
        Cell(figure.state, bad=figure.state == FAILED, title=figure.sentence())
        if isinstance(figure, Missing)
        else _cell(question, figure, best=figure.value == best and name not in YARDSTICKS)
        for name, figure in zip(names, figures, strict=True)
    ]
    limit = (
        ""
        if math.isinf(question.limit)
        else (
            f"{'≥' if question.at_least else '≤'} "
            f"{with_unit(question.limit, question.unit, min(limit_places, 1 if question.limit < 10 else 0))}"
        )
    )
    return Row(question.title, explaining(question.key), limit, cells)


def _cell(question: Question, figure: Figure, *, best: bool) -> Cell:
    samples = question.key == "data"
    places = 0 if samples and figure.value >= 10 else decimals(figure.low, figure.high, value=figure.value)
    held = state(question, figure) if math.isfinite(question.limit) else ""
    note = figure.note if question.key in ("data", "settled_error_degC") else ""
    bands = band(figure.low, figure.high, places, unit=question.unit, beyond=question.beyond)
    below = [bands, note.split(" samples")[0], held if held == UNDECIDED else ""]
    return Cell(
        quantity(figure.value, question.unit, places, beyond=question.beyond),
        ", ".join(filter(None, below)),
        bad=held == FAILED,
        best=best and not samples,
    )


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
                f"{tracking.integral:g} a step{own_integral(sources)} on errors up to "
                f"{tracking.integral_limit_degC:g}{THIN}°C"
            ),
        ),
    ]


class Diagonals(NamedTuple):
    """Diagonals of Q and R as one mode of tuning left them."""

    title: str
    q: list[str]
    r: list[str]


class Weights(NamedTuple):
    """The tuned weights, a row a mode, a column an output or an input."""

    missing: Missing | None
    outputs: list[str]
    inputs: list[str]
    rows: list[Diagonals]


def weights(sources: Sources) -> Weights:
    """The tuned weights; those of another machine are left out."""
    tuned, machine = sources.tables["weights"], sources.declared.machine
    outputs, inputs = [o.name for o in machine.outputs], [i.name for i in machine.inputs]
    if isinstance(tuned, Missing):
        return Weights(tuned, outputs, inputs, [])
    names = {"practical": "practical, deployed"}
    rows = [
        Diagonals(title, *([short(weight, 2) for weight in tuned[mode][key]] for key in ("q", "r")))
        for mode, title in names.items()
        if mode in tuned and [len(tuned[mode][key]) for key in ("q", "r")] == [len(outputs), len(inputs)]
    ]
    return Weights(None, outputs, inputs, rows)


def identified(sources: Sources) -> list[tuple[str, str]]:
    """What identification says about its model."""
    metrics = sources.metrics["identify_plant"]
    if isinstance(metrics, Missing):
        return [("Model", f"{metrics.state}: {metrics.sentence()}")]
    rows = [
        (title, str(metrics[key]))
        for key, title in (
            ("order", "Order"),
            ("past", "Past samples used"),
            ("rows", "Rows of the regression"),
            ("dropped_rows", "Rows left out"),
        )
        if key in metrics
    ]
    fit = metrics.get("fit_holdout")
    if isinstance(fit, dict):
        rows.append(
            (
                "Fit on the hold-out",
                ", ".join(
                    f"{name} {quantity(value, '%', 1)}"
                    if isinstance(value, int | float)
                    else f"{name} {value}"
                    for name, value in fit.items()
                ),
            )
        )
    else:
        rows.append(("Fit on the hold-out", "not measured"))
    ahead = metrics.get("fit_holdout_ahead")
    if isinstance(ahead, dict):
        rows.append(
            (
                f"Fit {metrics.get('ahead_steps', '')} steps ahead",
                ", ".join(f"{name} {quantity(value, '%', 1)}" for name, value in ahead.items()),
            )
        )
    white = metrics.get("whiteness_passed")
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
        for note in metrics.get(key) or []
    ]
