"""Makes the verdict on the identified model from its figures: what the model may be used for, in words."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from pipeline.verdict.digits import THIN, band, count, decimals, listed, number, quantity, short
from pipeline.verdict.evidence import Evidence, entry, gap_of, instead, known, lookup, need, need_figure
from pipeline.verdict.rules import Reading, ask, rows
from pipeline.verdict.verdict import (
    FAILED,
    PASSED,
    UNDECIDED,
    Figure,
    Missing,
    Question,
    Rule,
    Verdict,
    count_of,
    deciding,
    overall,
    state,
    worst_state,
)

LOOP = "identification"
# the beginning of the decision if a model is good for no use
UNTRUSTED = "Do not trust this model"
AHEAD, GAINS = "ahead", "gains"


class Fit(NamedTuple):
    """The fits of one output on the hold-out in percent: simulated; some steps ahead; and for comparison with
    the last value held constant."""

    name: str
    simulated: Figure | Missing
    ahead: Figure | Missing
    held: Figure | Missing


def trust(evidence: Evidence) -> Verdict:
    """Returns for which uses the model is good. A use passes if each rule that it needs passes."""
    ahead = ahead_words(evidence)
    heats = any(signal.heats for signal in evidence.machine.inputs)
    rules = {key: _rule(evidence, key) for key in rows(LOOP) if key != GAINS or heats}
    uses = {
        words: worst_state([rule.state for key, rule in rules.items() if _needed(key, rule, use)])
        for use, words in (
            ("design", "to design controllers"),
            ("predict", f"to predict {ahead}"),
            ("simulate", "to simulate"),
        )
    }
    # rules that the design needs come first, then those that another use needs, then warnings
    first = None
    for use in ("design", "predict", "simulate"):
        first = first or deciding([rule for key, rule in rules.items() if _needed(key, rule, use)])
    first = first or deciding(rules.values())
    ended = overall(list(uses.values()))
    if first is None:
        weakest, least = min(
            ((fit.name, need(fit.simulated)) for fit in fits(evidence)), key=lambda pair: pair[1].value
        )
        lead = f"All {count(len(rules), 'rule')} passed;"
        reason = f"weakest in simulation: {weakest}, {percent_of(least)} (at least {least_fit():g}{THIN}%)."
        remedy = "Valid for the range of inputs and temperatures that the record covers."
    else:
        word = "failed" if first.state == FAILED else "undecided"
        place = "First" if ended != PASSED else "One reservation, the first"
        lead = f"{place} {word} rule: {first.name[:1].lower()}{first.name[1:]}."
        reason, remedy = first.reason, first.remedy
    return Verdict(
        loop=LOOP,
        state=ended,
        decision=_decision(uses),
        lead=lead,
        reason=reason,
        remedy=remedy,
        rule=first.name if first else "",
        winner=None,
        rules=tuple((rule,) for rule in rules.values()),
    )


def least_fit() -> float:
    """Returns the fit below which a model misses more than half of an output's movement."""
    return float(rows(LOOP)["simulation"].at_least or 0)


def _needed(key: str, rule: Rule, use: str) -> bool:
    """Returns whether a use cannot pass without the rule. If a gain's value is impossible but its band
    reaches possible values, its sign or size is unknown. This is a warning only."""
    return use in rows(LOOP)[key].needed_for and not (key == GAINS and rule.state == UNDECIDED)


def _rule(evidence: Evidence, key: str) -> Rule:
    row = rows(LOOP)[key]
    own = (lambda question: FIGURES[key](evidence, question)) if key in FIGURES else None
    if key == AHEAD:
        words = ahead_words(evidence)
        row = row.model_copy(update={"name": words[:1].upper() + words[1:]})
    rule = ask(LOOP, key, evidence, own, row=row)
    if isinstance(rule.figure, Figure):
        undecided = rule.question and rule.state == UNDECIDED and row.unit == "%"
        return rule._replace(remedy=_longer(rule.question, rule.figure)) if undecided else rule
    gap = rule.figure
    return rule._replace(
        reason=gap.reason.rstrip(".") + ".", remedy=gap.remedy and gap.remedy.rstrip(".") + "."
    )


def _decision(uses: Mapping[str, str]) -> str:
    good, bad = (
        [use for use, ended in uses.items() if (ended == PASSED) == wanted] for wanted in (True, False)
    )
    if not good:
        return f"{UNTRUSTED}." if FAILED in uses.values() else f"{UNTRUSTED} yet."
    groups = [
        (word, [use for use in bad if (uses[use] == FAILED) == failed])
        for word, failed in (("not", True), ("not yet", False))
    ]
    return (
        "Trust this model "
        f"{listed(good)}{''.join(f', {word} {listed(group)}' for word, group in groups if group)}."
    )


# ---- the figures


def fits(evidence: Evidence) -> list[Fit]:
    """Returns every output's fits on the hold-out."""
    model = evidence.figures["identify_plant"]
    return [
        Fit(
            output.name,
            *(
                fit_figure(model, key, output.name)
                for key in ("fit_holdout", "fit_holdout_ahead", "fit_holdout_held")
            ),
        )
        for output in evidence.machine.outputs
    ]


def fit_figure(model: Any, key: str, name: str) -> Figure | Missing:
    """Returns the fit `key` of an output in percent, with its band."""
    value = lookup(model, f"{key}.{name}")
    if gap := gap_of(value):
        if gap_of(model) or key not in ("fit_holdout_ahead", "fit_holdout_held"):
            return gap
        return Missing(
            "not measured",
            "no stretch of the hold-out outlasts the start-up of the prediction",
            "Record longer, or lower ahead_steps",
        )
    return Figure(value, *known(lookup(model, f"{key}_band.{name}"), [value, value]))


@instead(lambda gap: "ahead")
def ahead_words(evidence: Evidence) -> str:
    """Returns "60 s ahead"."""
    steps = need_figure(evidence.figures["identify_plant"], "ahead_steps")
    return f"{steps * evidence.machine.sample_time_s:g}{THIN}s\u00a0ahead"


def percent_of(figure: Figure | Missing) -> str:
    """Returns a fit with its unit; its state if it is missing."""
    if isinstance(figure, Missing):
        return figure.state
    return quantity(figure.value, "%", min(decimals(figure.low, figure.high, value=figure.value), 1))


def band_of(figure: Figure | Missing) -> str:
    """Returns the ends of a fit's band; "" if they are equal, or if the fit is missing."""
    if isinstance(figure, Missing):
        return ""
    places = min(decimals(figure.low, figure.high, value=figure.value), 1)
    return band(figure.low, figure.high, places, unit="%")


def _with_band(figure: Figure) -> str:
    ends = band_of(figure)
    return percent_of(figure) + (f" ({ends})" if ends else "")


# ---- what the rules ask for


def _weakest(
    fits: Sequence[Fit], values: Sequence[Figure], asked: Sequence[Question]
) -> tuple[Fit, Figure, Question]:
    """Returns, of the outputs in the gravest state, the one furthest below its limit."""
    states = [state(question, value) for question, value in zip(asked, values, strict=True)]
    ended = worst_state(states)
    rows = zip(fits, values, asked, states, strict=True)
    return min((row[:3] for row in rows if row[3] == ended), key=lambda row: row[1].value - row[2].limit)


def _simulation(evidence: Evidence, question: Question) -> Reading:
    outputs = fits(evidence)
    values = [need(fit.simulated) for fit in outputs]
    fit, figure, _ = _weakest(outputs, values, [question] * len(values))
    return figure, {
        "text": f"{fit.name} {percent_of(figure)}",
        "output": fit.name,
        "value": _with_band(figure),
    }


def _ahead(evidence: Evidence, question: Question) -> Reading:
    """Returns the reading of the fit some steps ahead. The limit of each output is the fit with its last
    value held constant, but at least the least fit."""
    outputs = fits(evidence)
    values, held = (
        [need(part) for part in parts]
        for parts in zip(*((fit.ahead, fit.held) for fit in outputs), strict=True)
    )
    asked = [question._replace(limit=max(figure.value, question.limit)) for figure in held]
    fit, figure, bar = _weakest(outputs, values, asked)
    return figure, {
        "limit": bar.limit,
        "text": f"{fit.name} {percent_of(figure)}",
        "output": fit.name,
        "steps": ahead_words(evidence),
        "value": _with_band(figure),
        "held": percent_of(need(fit.held)),
        "least": f"{question.limit:g}{THIN}%",
    }


def _longer(question: Question, figure: Figure) -> str:
    """Returns how long a hold-out would decide: a band shrinks with the root of the number of samples."""
    limit = question.limit
    reach = limit - figure.low if figure.value > limit else figure.high - limit
    away = abs(figure.value - limit)
    times = ((reach + away) / away) ** 2 if away > 0 else math.inf
    if times > 12:
        return "Only a far longer record would decide."
    return f"A hold-out {count(math.ceil(times), 'time', 'times')} as long would decide."


def _residuals(evidence: Evidence, rows: np.ndarray) -> Reading:
    """Returns the reading of how many correlations of the residuals leave their bands, and of the one that
    leaves it furthest."""
    table = need(evidence.tables["residuals"])
    worst, excess = _worst_lag(table, rows)
    if worst is None:
        return count_of(0), {}
    correlation = float(table["correlation"][worst])
    words = {
        "output": table["output"][worst],
        "input": table["against"][worst],
        "correlation": f"{'+' if correlation > 0 else ''}{number(correlation, 2)}",
        "lag": int(table["lag"][worst]),
        "times": short(excess, 2),
    }
    return count_of(int(rows.sum())), words


def _inputs_left(evidence: Evidence, question: Question) -> Reading:
    table = need(evidence.tables["residuals"])
    # in closed loop u(t) responds to the error of y(t), so lag 0 comes from the controller
    closed = lookup(evidence.figures["identify_plant"], "closed_loop.closed") is True
    pairs = (table["against"] != table["output"]) & (table["lag"] >= int(closed))
    figure, words = _residuals(evidence, pairs & ~table["passed"])
    inputs = count(len(set(table["against"][pairs])), "input")
    return figure, {**words, "text": f"{words['output']} after {words['input']}" if words else inputs}


def _whiteness(evidence: Evidence, question: Question) -> Reading:
    table = need(evidence.tables["residuals"])
    coloured = (table["against"] == table["output"]) & (table["lag"] > 0) & ~table["passed"]
    figure, words = _residuals(evidence, coloured)
    return figure, {**words, "text": f"{words['output']}, lag {words['lag']}" if words else "noise only"}


def _worst_lag(table: Mapping[str, np.ndarray], rows: np.ndarray) -> tuple[int | None, float]:
    """Returns the row with the correlation that leaves its band furthest, and its size in bands."""
    if not rows.any():
        return None, 0.0
    excess = np.where(
        rows, np.nan_to_num(np.abs(table["correlation"]) / np.maximum(table["band"], 1e-300)), -1.0
    )
    return int(excess.argmax()), float(excess.max())


def _excitation(evidence: Evidence, question: Question) -> Reading:
    model = evidence.figures["identify_plant"]
    rank, full = need_figure(model, "excitation.rank"), need_figure(model, "excitation.full")
    lags, poor = entry(model, "excitation", "lags"), ""
    if rank < full and lags is not None:
        weak = [key for key, part in model["excitation"]["inputs"].items() if part["rank"] < lags]
        poor = (
            f" Too poor on its own: {listed(weak)}."
            if weak
            else " Each is rich enough alone, but they move alike."
        )
    words = {"limit": full, "rank": rank, "full": full, "poor": poor, "text": f"rank {rank} of {full}"}
    return count_of(rank), words


def _effects(evidence: Evidence, question: Question) -> Reading:
    table = need(evidence.tables["dynamics"])
    signed = f"{int(table['seen'].sum())} of {len(table['seen'])}"
    names = [signal.name for signal in evidence.machine.inputs]
    blind = [name for name in names if not table["seen"][table["input"] == name].any()]
    words = {"signed": signed, "inputs": listed(blind) if blind else ""}
    return count_of(len(blind)), {**words, "text": f"{blind[0]}: sign unknown" if blind else signed}


def _stability(evidence: Evidence, question: Question) -> Reading:
    radius = need_figure(evidence.figures["identify_plant"], "largest_pole")
    pole = number(radius, 4 if abs(radius - 1) > 1e-4 else 6)
    refinement = evidence.params.get("identify_plant", {}).get("refinement")
    return count_of(radius), {
        "pole": pole,
        "text": f"largest pole {pole}",
        "case": "validated" if refinement == "validated" else "other",
    }


def _gains(evidence: Evidence, question: Question) -> Reading:
    """Returns the reading of gains with a sign or a size that physics forbids. If a band reaches possible
    values, the rule is undecided."""
    gains = need_figure(evidence.figures["identify_plant"], "forbidden_gains")
    if not gains:
        return count_of(0), {"text": "none forbidden", "case": "none", "flagged": ""}
    worst = max(gains, key=lambda gain: (gain["certain"], abs(gain["gain"])))
    certain = sum(gain["certain"] for gain in gains)
    return Figure(len(gains), certain, len(gains)), {
        "text": f"{worst['input']} on {worst['output']}",
        "case": "certain" if certain else "possible",
        "flagged": flagged_sentence(gains),
    }


FIGURES = {
    "simulation": _simulation,
    AHEAD: _ahead,
    "inputs_left": _inputs_left,
    "whiteness": _whiteness,
    "excitation": _excitation,
    "effects": _effects,
    "stability": _stability,
    GAINS: _gains,
}


def flagged_remedy(gains: Sequence[Mapping[str, Any]]) -> str:
    """Returns what to do before a controller is designed from the model."""
    remedy = rows(LOOP)[GAINS].remedy
    case = "certain" if any(gain["certain"] for gain in gains) else "possible"
    return remedy if isinstance(remedy, str) else remedy[case]


def flagged_sentence(gains: Sequence[Mapping[str, Any]]) -> str:
    """Returns what physics forbids in the model: a sentence with the gravest gain."""
    worst = max(gains, key=lambda gain: (gain["certain"], abs(gain["gain"])))
    places = decimals(worst["low"], worst["high"], value=worst["gain"])
    ends = band(worst["low"], worst["high"], places)
    flagged = count(len(gains), "gain is flagged", "gains are flagged").capitalize()
    return (
        f"{flagged}: {worst['input']} on {worst['output']}, {number(worst['gain'], places)}"
        f"{f' ({ends})' if ends else ''} °C per %, {'is' if worst['certain'] else 'would be'} "
        f"{worst['reason']}."
    )
