"""A card a loop: the winner in words, three small multiples on one scale, three
figures. A loop that is not measured keeps its frame."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from markupsafe import Markup

from pipeline.report.deposition import rules as deposition_rules
from pipeline.report.deposition import verdict as deposition_verdict
from pipeline.report.identification.model import trust
from pipeline.report.shared import charts, page
from pipeline.report.shared.digits import number, percent, shortened
from pipeline.report.shared.sources import Source, Sources, Table
from pipeline.report.shared.verdict import (
    FAILED,
    OPEN,
    PASSED,
    Figure,
    Missing,
    Question,
    ReportRules,
    Verdict,
    state,
)
from pipeline.report.temperature.answers import comparison, refused
from pipeline.report.temperature.contestants import heading, kind
from pipeline.report.temperature.judgement import Judgement
from pipeline.report.temperature.pairs import pair_names
from pipeline.report.temperature.scorecard import UNRULED, setting
from pipeline.report.temperature.wording import OFF_THE_SCALE, places_of, worded

NAMES = {"data_driven": "Data\u2011driven", "model_based": "Model\u2011based", "baseline": "Baseline"}

# composer of the deposition loop -> its place in the card
ROLE = {
    "basis": "data_driven",
    "priority": "model_based",
    "superposition": "model_based",
    "on_off": "baseline",
}


class Cell(NamedTuple):
    """A figure of one controller in words; `best` of its row, `bad` where it failed."""

    text: str
    best: bool
    bad: bool


class Row(NamedTuple):
    title: str
    cells: list[Cell]


class Head(NamedTuple):
    """Who stands for a role: its mark, the role's name, the method."""

    mark: str
    name: str
    method: str


class Card(NamedTuple):
    """One loop on page one. `mark` is the role of the controller that should run, None where none should;
    `win` says who wins and by what; `missing`: nothing was measured."""

    id: str
    name: str
    link: str
    moves: str
    state: str
    mark: str | None
    win: tuple[str, str]
    caption: str
    panels: list[Markup]
    heads: list[Head]
    rows: list[Row]
    note: str
    sources: list[Source]
    model: Any = None
    missing: bool = False


def heads(roles: Sequence[str], methods: Sequence[str]) -> list[Head]:
    """The roles of a card, each with its method."""
    return [Head(role, NAMES[role], method) for role, method in zip(roles, methods, strict=True)]


def temperature(sources: Sources, judged: Judgement) -> Card:
    """The pair and one beside it: the contestant that the verdict is about, or PI."""
    pair = pair_names(sources.metrics)
    order = (*pair, "pi" if judged.subject in pair else judged.subject)
    asked = {question.key: question for question in (*judged.asked, *UNRULED)}
    rows = []
    for key in ("settled_error", "settling", "cost"):
        figures = [judged.answers.get(name, {}).get(key, NOT_JUDGED) for name in order]
        rows.append(Row(asked[key].title, _card_cells(asked[key], figures)))
    passed = judged.verdict.state == PASSED
    return Card(
        id="temperature",
        name="Temperature",
        link="temperature.html",
        moves="Heaters and motor to barrel temperatures",
        state=judged.verdict.decision.split(":")[0].rstrip("."),
        mark=judged.verdict.winner if passed else None,
        win=(f"{judged.verdict.decision}", f"{judged.pair.text} {judged.best} {judged.deciding}".strip()),
        caption=(
            f"Worst zone’s true error in a typical case, log scale {_FLOOR:g} to "
            f"{number(_CEILING, 0)}\u00a0°C. "
            f"Grey: what the rule allows once settled. Figures: 90\u00a0% quantile of {_setting(sources)}."
        ),
        panels=[
            _spark(sources, name, limit=asked["settled_error"].limit, named=i == 0)
            for i, name in enumerate(order)
        ],
        heads=[Head(name, heading(name), kind(name)) for name in order],
        rows=rows,
        note=judged.pair.note
        or (
            "Judged on plants of the identified spread."
            if sources.recorded
            else "Simulated plants on which nothing was fitted."
        ),
        sources=sources.source("evaluate_temperature", "trajectories"),
        model=trust(sources),
    )


NOT_JUDGED = Missing(OPEN, "It was not judged")


def _setting(sources: Sources) -> str:
    return setting(comparison(sources.metrics))


def _card_cells(question: Question, figures: Sequence[Figure | Missing]) -> list[Cell]:
    places = places_of(question, figures[:2])
    values = [f.value if isinstance(f, Figure) else math.inf for f in figures]
    best = min(values)
    cells = []
    for figure, value in zip(figures, values, strict=True):
        if isinstance(figure, Missing):
            cells.append(Cell(figure.state, best=False, bad=False))
            continue
        text = worded(question, value, places)
        ruled = math.isfinite(question.limit)
        leads = math.isfinite(best) and text == worded(question, best, places) and text != OFF_THE_SCALE
        cells.append(Cell(text, leads, bad=ruled and state(question, figure) == FAILED))
    return cells


_FLOOR, _CEILING = 0.01, 300.0


def _spark(sources: Sources, name: str, *, limit: float, named: bool) -> Markup:
    error = _worst_error(sources, sources.tables["trajectories"], name)
    if isinstance(error, Missing):
        return Markup('<div class="hole">{}</div>').format(page.missing(error))
    time, values = error
    last = f"{number(float(values[-1]), 2)} °C" if values[-1] <= 1e4 else "too far to say"
    alt = (
        f"{heading(name)}: worst zone {last} from its reference "
        f"after {number(float(time[-1]), 0)} s, {'above' if values[-1] > limit else 'below'} the {limit:g} "
        "°C limit"
    )
    return charts.spark(
        time,
        values,
        charts.logarithmic(_FLOOR, _CEILING)._replace(low=_FLOOR, high=_CEILING),
        css=page.MARKS.get(name, "bl"),
        limit=limit,
        alt=alt,
        limit_label=f"limit {limit:g}" if named else "",
        units=("s", "°C"),
    )


def _worst_error(
    sources: Sources, table: Table | Missing, name: str
) -> tuple[np.ndarray, np.ndarray] | Missing:
    if reason := refused(sources.metrics).get(name):
        return Missing(FAILED, reason)
    if isinstance(table, Missing):
        return table
    rows = (table["contestant"] == name) & (table["case_name"] == "typical")
    if not rows.any():
        return Missing(OPEN, f"no trajectory of {heading(name)}")
    outputs = sources.declared.machine.outputs
    errors = np.stack([np.abs(table[o.name][rows] - table[f"{o.name}_reference"][rows]) for o in outputs])
    return table["time_s"][rows], np.nan_to_num(errors.max(axis=0), nan=_CEILING)


def deposition(sources: Sources) -> Card:
    """In this loop's terms: model-based is the paper's law and its library by priority, data-driven our law
    and the basis functions, baseline on-off control."""
    judged, structures = deposition_verdict.verdict(sources), deposition_rules.structures(sources)
    if isinstance(structures, Missing):
        return unbuilt("deposition", structures.sentence())._replace(link="deposition.html")
    role = ROLE.get(judged.winner)
    trials = [_learned(sources, law) for law in ("hoelzle_2009", "model_inverse", "")]
    return Card(
        id="deposition",
        name="Deposition",
        link="deposition.html",
        moves="Plunger command to flow at the nozzle",
        state=judged.decision.split(":")[0].rstrip("."),
        mark=role if judged.state == PASSED else None,
        win=_deposition_win(structures, judged, role),
        caption=(
            "Error while learning, in % of on\u2011off control’s, log scale 0.3 to 200\u00a0%, the worse "
            "material: the paper’s law, model inversion, none. Grey: what is asked for."
        ),
        panels=[
            _learning_spark(curve, css, sources.declared.rules.learned_percent, named=i == 1)
            for i, (curve, css) in enumerate(zip(trials, ("mb", "dd", "bl"), strict=True))
        ],
        heads=heads(
            ("model_based", "data_driven", "baseline"),
            ("library + priority", "basis functions", "on\u2011off control"),
        ),
        rows=_deposition_rows(structures, sources.declared.rules),
        note="Forecasts of the identified machine: the true flow of a real one is not known."
        if deposition_rules.real(sources)
        else "Judged by the true flow of simulated machines that nothing was fitted to.",
        sources=sources.source("scores", "trials"),
    )


def _deposition_rows(structures: Sequence[deposition_rules.Structure], allowed: ReportRules) -> list[Row]:
    """Flow error of the two parts on which the library fares worst, which say most, and the worst line."""
    names = ("priority", "basis", "on_off")
    scores = pd.DataFrame(
        [
            (structure.part, name, score.error, score.worst_line)
            for structure in structures
            if not structure.unknown()
            for name, score in structure.scores.items()
        ],
        columns=["part", "composer", "error", "line"],
    ).astype({"error": float, "line": float})
    errors = scores.pivot_table(index="part", columns="composer", values="error", aggfunc="max", sort=False)
    errors = errors.reindex(columns=names)
    hardest = errors.sort_values("priority", ascending=False, kind="stable").head(2)
    lines = scores.groupby("composer").line.max().reindex(names)
    return [
        *(
            Row(f"Flow error, {shortened(part, 30)}", _worst(list(values), allowed.flow_error_percent))
            for part, *values in hardest.itertuples()
        ),
        Row("Worst line’s volume", _worst(lines.tolist(), allowed.line_volume_percent)),
    ]


def _deposition_win(
    structures: Sequence[deposition_rules.Structure], judged: Verdict, role: str | None
) -> tuple[str, str]:
    if judged.state != PASSED or role is None:
        return judged.lead or judged.decision, judged.reason
    name = "The baseline" if role == "baseline" else NAMES[role]
    mine, _ = deposition_rules.worst(structures, judged.winner) or (0.0, None)
    other = deposition_rules.worst(structures, "priority" if judged.winner == "basis" else "basis")
    beside = (
        f" {deposition_rules.USE['priority' if judged.winner == 'basis' else 'basis'].capitalize()}: "
        f"{percent(other[0], 2)}."
        if other
        else ""
    )
    price = judged.note.split(". ")[0].rstrip(".")
    return (
        f"{name} wins.",
        f"{deposition_rules.NAMES[judged.winner]}: at most {percent(mine, 2)} of on\u2011off control’s "
        f"flow error on any part.{beside} {price}."
        if price
        else "",
    )


def _worst(values: Sequence[float], limit: float) -> list[Cell]:
    """A cell for each value, the least of all bold; NaN is not measured."""
    least = min((value for value in values if math.isfinite(value)), default=math.nan)
    return [
        Cell(
            percent(value, 2) if math.isfinite(value) else "not measured",
            best=value == least,
            bad=limit < value < math.inf,
        )
        for value in values
    ]


def _learned(sources: Sources, law: str) -> np.ndarray | Missing:
    """The larger of the materials' errors after each trial of the reference routine,
    in % of trial 0's; on-off control learns nothing."""
    table = sources.tables["trials"]
    if isinstance(table, Missing):
        return table
    if not law:
        return np.full(2, 100.0)
    law = law if (table["law"] == law).any() else "pixels"
    rows = (table["law"] == law) & (table["routine"] == 0)
    if not rows.any():
        return Missing("not measured", "this law was not run")
    return 100 * pd.Series(table["ratio"][rows]).groupby(table["trial"][rows]).max().to_numpy()


def _learning_spark(curve: np.ndarray | Missing, css: str, limit: float, *, named: bool) -> Markup:
    if isinstance(curve, Missing):
        return Markup('<div class="hole">{}</div>').format(page.missing(curve))
    curve = curve if len(curve) > 1 else np.repeat(curve, 2)
    finding = (
        "On-off control learns nothing"
        if css == "bl"
        else f"The error ends at {percent(float(curve[-1]), 2)} of trial 0’s after {len(curve) - 1} trials"
    )
    alt = f"{finding}, {'above' if curve[-1] > limit else 'below'} the {limit:g} % asked for"
    return charts.spark(
        np.arange(float(len(curve))),
        curve,
        charts.logarithmic(0.3, 200.0)._replace(low=0.3, high=200.0),
        css=css,
        limit=limit,
        alt=alt,
        limit_label=f"learned to {limit:g}" if named else "",
        units=("trials", "%"),
    )


def unbuilt(key: str, why: str) -> Card:
    """A loop without figures: the same frame, and the sentence in it."""
    loops = {
        "deposition": (
            "Deposition",
            "Plunger command to flow at the nozzle",
            ("library + priority", "basis functions", "on-off control"),
        ),
        "setpoint": (
            "Setpoint",
            "Nozzle camera to flow and temperature setpoints",
            ("Bayes filter", "Q-learning agent", "proportional"),
        ),
    }
    name, moves, methods = loops[key]
    hole = Markup('<div class="hole">{}not measured</div>').format(page.glyph(OPEN))
    return Card(
        id=key,
        name=name,
        link="",
        moves=moves,
        state="Not measured",
        mark=None,
        win=("Not measured.", why),
        caption="Nothing is shown before it is measured.",
        panels=[hole] * len(methods),
        heads=heads(("model_based", "data_driven", "baseline"), methods),
        rows=[],
        note="No figure, so no claim.",
        sources=[],
        missing=True,
    )
