"""Figures of the identification -> what the model may be used for: seven rules, an eighth where inputs are
declared to heat, three uses, the verdict in words. No page, no file."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from pipeline.report.shared.sources import Sources, lookup
from pipeline.verdict.digits import THIN, band, count, decimals, number, quantity, short
from pipeline.verdict.verdict import (
    BELOW_ONE,
    FAILED,
    OPEN,
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

# below this fit a model misses more than half of an output's movement: the size
# of its error is more than half of the movement's
LEAST_FIT = 50.0


# how the decision on a model begins that is good for no use
UNTRUSTED = "Do not trust this model"
WHITENESS, POSSIBLE = "Whiteness", "Gains possible"


class Fit(NamedTuple):
    """One output on the hold-out: fits in percent, simulated and so many steps
    ahead, and what the last value gives when it is held."""

    name: str
    simulated: Figure | Missing
    ahead: Figure | Missing
    held: Figure | Missing


def trust(sources: Sources) -> Verdict:
    """Which uses the model is good for. A use is passed where each rule that it needs is passed."""
    outputs, ahead = fits(sources), ahead_words(sources)
    rules = (
        _simulation(outputs),
        _ahead(outputs, ahead),
        _inputs_left(sources),
        _whiteness(sources),
        _excitation(sources),
        _effects(sources),
        _stability(sources),
        *_possible_gains(sources),
    )
    simulation, prediction, inputs_left, _, excitation, effects, stability, *gains = (
        rule.state for rule in rules
    )
    # a gain that is forbidden by its value alone is one of unknown sign or size: a reservation
    gains = [outcome for outcome in gains if outcome != UNDECIDED]
    uses = {
        "to design controllers": worst_state(
            [prediction, inputs_left, excitation, effects, stability, *gains]
        ),
        f"to predict {ahead}": prediction,
        "to simulate": worst_state([simulation, stability]),
    }
    # a rule that some use needs comes before one that is only a reservation
    first = deciding(rule for rule in rules if not _reservation(rule)) or deciding(rules)
    ended = overall(list(uses.values()))
    if first is None:
        weakest = min(outputs, key=lambda fit: fit.simulated.value)
        lead = f"All {count(len(rules), 'rule')} passed;"
        reason = (
            f"weakest in simulation: {weakest.name}, {percent_of(weakest.simulated)} "
            f"of at least {LEAST_FIT:g}{THIN}%."
        )
        remedy = "Valid for the range of inputs and temperatures that the record covers."
    else:
        word = "failed" if first.state == FAILED else "undecided"
        place = "First" if ended != PASSED else "One reservation, the first"
        lead = f"{place} {word} rule: {first.name[:1].lower()}{first.name[1:]}."
        reason, remedy = first.reason, first.remedy
    return Verdict(
        loop="identification",
        state=ended,
        decision=_decision(uses),
        lead=lead,
        reason=reason,
        remedy=remedy,
        rule=first.name if first else "",
        winner=None,
        rules=tuple((rule,) for rule in rules),
    )


def _reservation(rule: Rule) -> bool:
    """Whether a rule that does not pass takes no use away."""
    return rule.name == WHITENESS or (rule.name == POSSIBLE and rule.state == UNDECIDED)


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
        f"{_listed(good)}{''.join(f', {word} {_listed(group)}' for word, group in groups if group)}."
    )


def _listed(items: Sequence[str]) -> str:
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}"


# ---- the figures


def fits(sources: Sources) -> list[Fit]:
    """Every output's fits on the hold-out."""
    metrics = sources.metrics["identify_plant"]
    return [
        Fit(
            output.name,
            *(
                fit_figure(metrics, key, output.name)
                for key in ("fit_holdout", "fit_holdout_ahead", "fit_holdout_held")
            ),
        )
        for output in sources.declared.machine.outputs
    ]


def fit_figure(metrics: Any, key: str, name: str) -> Figure | Missing:
    """The fit `key` of an output in percent, with its band."""
    value = lookup(metrics, f"{key}.{name}")
    if isinstance(value, Missing):
        if isinstance(metrics, Missing) or key not in ("fit_holdout_ahead", "fit_holdout_held"):
            return value
        return Missing(
            "not measured",
            "no stretch of the hold-out outlasts the start-up of the prediction",
            "Record longer, or lower ahead_steps",
        )
    ends = lookup(metrics, f"{key}_band.{name}")
    return Figure(value, *([value, value] if isinstance(ends, Missing) else ends))


def ahead_words(sources: Sources) -> str:
    """ "60 s ahead"."""
    steps = lookup(sources.metrics["identify_plant"], "ahead_steps")
    return (
        "ahead"
        if isinstance(steps, Missing)
        else f"{steps * sources.declared.machine.sample_time_s:g}{THIN}s\u00a0ahead"
    )


def percent_of(figure: Figure) -> str:
    return quantity(figure.value, "%", min(decimals(figure.low, figure.high, value=figure.value), 1))


def band_of(figure: Figure) -> str:
    """Its ends, empty where they are one."""
    places = min(decimals(figure.low, figure.high, value=figure.value), 1)
    return band(figure.low, figure.high, places, unit="%")


def _with_band(figure: Figure) -> str:
    ends = band_of(figure)
    return percent_of(figure) + (f" ({ends})" if ends else "")


def _missing_rule(name: str, place: str, gap: Missing) -> Rule:
    gap = gap if gap.state == FAILED else gap._replace(state=OPEN)
    remedy = gap.remedy and gap.remedy.rstrip(".") + "."
    return Rule(name, None, gap, place=place, reason=gap.reason.rstrip(".") + ".", remedy=remedy)


def _none(name: str, place: str, number: int, text: str, reason: str, remedy: str = "") -> Rule:
    """A rule that allows none of what was counted."""
    question = Question(0, "", name, "", 0.0, False, "")
    return Rule(name, question, count_of(number), text=text, place=place, reason=reason, remedy=remedy)


# ---- the rules


def _simulation(outputs: Sequence[Fit]) -> Rule:
    name, place = "Simulation", "holdout"
    gap = next((fit.simulated for fit in outputs if isinstance(fit.simulated, Missing)), None)
    if gap:
        return _missing_rule(name, place, gap)
    asked = Question(0, "", name, "%", LEAST_FIT, True, "")
    ended = worst_state([state(asked, fit.simulated) for fit in outputs])
    weakest = min(
        (fit for fit in outputs if state(asked, fit.simulated) == ended), key=lambda fit: fit.simulated.value
    )
    figure = weakest.simulated
    remedy = (
        "Look for an input or a disturbance that is not recorded; where outputs are measured, predict from "
        "them instead."
    )
    return Rule(
        name,
        asked,
        figure,
        text=f"{weakest.name} {percent_of(figure)}",
        place=place,
        reason=(
            f"{weakest.name} is simulated with a fit of {_with_band(figure)}; the rule asks for "
            f"{LEAST_FIT:g}{THIN}%, its mean alone gives 0."
        ),
        remedy=_longer(figure, LEAST_FIT) if ended == UNDECIDED else remedy,
    )


def _longer(figure: Figure, limit: float) -> str:
    """How long a hold-out would decide: a band shrinks with the root of the samples."""
    reach = limit - figure.low if figure.value > limit else figure.high - limit
    away = abs(figure.value - limit)
    times = math.ceil(((reach + away) / away) ** 2) if away > 0 else math.inf
    return (
        f"A hold-out {count(times, 'time', 'times')} as long would decide."
        if times <= 12
        else "Only a far longer record would decide."
    )


def _ahead(outputs: Sequence[Fit], words: str) -> Rule:
    name, place = words[:1].upper() + words[1:], "holdout"
    gap = next((part for fit in outputs for part in (fit.ahead, fit.held) if isinstance(part, Missing)), None)
    if gap:
        return _missing_rule(name, place, gap)
    # the bar of each output: what holding its last value gives, and the least fit
    asked = [Question(0, "", name, "%", max(fit.held.value, LEAST_FIT), True, "") for fit in outputs]
    states = [state(question, fit.ahead) for question, fit in zip(asked, outputs, strict=True)]
    ended = worst_state(states)
    weakest, question = min(
        (pair for pair, own in zip(zip(outputs, asked, strict=True), states, strict=True) if own == ended),
        key=lambda pair: pair[0].ahead.value - pair[1].limit,
    )
    figure = weakest.ahead
    remedy = "Record longer, or ask for fewer steps ahead (identify_plant.ahead_steps)."
    return Rule(
        name,
        question,
        figure,
        text=f"{weakest.name} {percent_of(figure)}",
        place=place,
        reason=(
            f"{weakest.name} is predicted {words} with a fit of {_with_band(figure)}; holding its last value "
            f"gives {percent_of(weakest.held)}, the rule asks for more, and for {LEAST_FIT:g}{THIN}%."
        ),
        remedy=_longer(figure, question.limit) if ended == UNDECIDED else remedy,
    )


def _inputs_left(sources: Sources) -> Rule:
    name, place = "Inputs used up", "followed"
    table = sources.tables["residuals"]
    if isinstance(table, Missing):
        return _missing_rule(name, place, table)
    # in closed loop u(t) answers the error of y(t): lag 0 is the controller's
    closed = lookup(sources.metrics["identify_plant"], "closed_loop.closed") is True
    pairs = (table["against"] != table["output"]) & (table["lag"] >= int(closed))
    left = pairs & ~table["passed"]
    worst, excess = _worst_lag(table, left)
    if worst is None:
        inputs = count(len(set(table["against"][pairs])), "input")
        return _none(name, place, 0, inputs, "The errors follow no input.")
    output, against, lag = table["output"][worst], table["against"][worst], int(table["lag"][worst])
    reason = (
        f"The errors of {output} still follow {against}: correlation "
        f"{_signed(table['correlation'][worst])} at lag {lag}, {short(excess, 2)} times its 99{THIN}% band."
    )
    remedy = (
        "Check the dead time of that input, and whether its effect is linear. Where identify_plant.order is "
        "given, raise it."
    )
    return _none(name, place, int(left.sum()), f"{output} after {against}", reason, remedy)


def _whiteness(sources: Sources) -> Rule:
    name, place = WHITENESS, "white"
    table = sources.tables["residuals"]
    if isinstance(table, Missing):
        return _missing_rule(name, place, table)
    coloured = (table["against"] == table["output"]) & (table["lag"] > 0) & ~table["passed"]
    worst, excess = _worst_lag(table, coloured)
    if worst is None:
        return _none(name, place, 0, "noise only", "The errors are noise.")
    output, lag = table["output"][worst], int(table["lag"][worst])
    reason = (
        f"The one-step errors of {output} are not noise: correlation "
        f"{_signed(table['correlation'][worst])} at lag {lag}, {short(excess, 2)} times its 99{THIN}% band."
    )
    remedy = (
        "The observer could predict better: lengthen the window, or model the disturbance. "
        "What the fits measure they measure all the same."
    )
    return _none(name, place, int(coloured.sum()), f"{output}, lag {lag}", reason, remedy)


def _worst_lag(table: Mapping[str, np.ndarray], rows: np.ndarray) -> tuple[int | None, float]:
    """The row whose correlation leaves its band furthest, and how many bands that is."""
    if not rows.any():
        return None, 0.0
    excess = np.where(
        rows, np.nan_to_num(np.abs(table["correlation"]) / np.maximum(table["band"], 1e-300)), -1.0
    )
    return int(excess.argmax()), float(excess.max())


def _signed(value: float) -> str:
    return ("+" if value > 0 else "") + number(float(value), 2)


def _excitation(sources: Sources) -> Rule:
    name, place = "Excitation", "excitation"
    metrics = sources.metrics["identify_plant"]
    rank, full = lookup(metrics, "excitation.rank"), lookup(metrics, "excitation.full")
    gap = next((part for part in (rank, full) if isinstance(part, Missing)), None)
    if gap:
        return _missing_rule(name, place, gap)
    lags = lookup(metrics, "excitation.lags")
    reason = f"The inputs move in {rank} of {full} directions over the window."
    if rank < full and not isinstance(lags, Missing):
        weak = [key for key, part in metrics["excitation"]["inputs"].items() if part["rank"] < lags]
        reason += (
            f" Too poor on its own: {_listed(weak)}."
            if weak
            else " Each is rich enough alone, but they move alike."
        )
    return Rule(
        name,
        Question(0, "", name, "", full, True, ""),
        count_of(rank),
        text=f"rank {rank} of {full}",
        place=place,
        reason=reason,
        remedy="Move each input with a sequence of its own, at more frequencies.",
    )


def _effects(sources: Sources) -> Rule:
    name, place = "Effects known", "steps"
    table = sources.tables["dynamics"]
    if isinstance(table, Missing):
        return _missing_rule(name, place, table)
    signed = f"{int(table['seen'].sum())} of {len(table['seen'])}"
    blind = [
        i.name for i in sources.declared.machine.inputs if not table["seen"][table["input"] == i.name].any()
    ]
    if not blind:
        reason = f"The sign of {signed} effects is known, and of each input at least one."
        return _none(name, place, 0, signed, reason)
    reason = (
        f"What {_listed(blind)} does is not known, not even in sign: the bands of the spread hold zero for "
        "every output."
    )
    remedy = f"Move {_listed(blind)} more, or longer, and record again."
    return _none(name, place, len(blind), f"{blind[0]}: sign unknown", reason, remedy)


def _stability(sources: Sources) -> Rule:
    name, place = "Stability", "poles"
    radius = lookup(sources.metrics["identify_plant"], "largest_pole")
    if isinstance(radius, Missing):
        return _missing_rule(name, place, radius)
    shown = number(radius, 4 if abs(radius - 1) > 1e-4 else 6)
    rule = Rule(
        name,
        Question(0, "", name, "", BELOW_ONE, False, ""),
        count_of(radius),
        text=f"largest pole {shown}",
        place=place,
        reason="Every pole lies inside the unit circle.",
    )
    if rule.state == PASSED:
        return rule
    return rule._replace(
        reason=(
            f"The largest pole, {shown}, is not inside the unit circle: simulated far ahead, "
            "the model runs away."
        ),
        remedy=(
            "Record longer."
            if sources.declared.everything.get("identify_plant", {}).get("refinement") == "validated"
            else "Record longer, or set identify_plant.refinement to validated."
        ),
    )


def _possible_gains(sources: Sources) -> list[Rule]:
    """No gain has a sign or a size that physics forbids: a rule where inputs are declared to heat. A gain
    whose band reaches what is possible leaves the rule undecided."""
    name, place = POSSIBLE, "flagged"
    heaters = [signal.name for signal in sources.declared.machine.inputs if signal.heats]
    if not heaters:
        return []
    gains = lookup(sources.metrics["identify_plant"], "forbidden_gains")
    if isinstance(gains, Missing):
        return [_missing_rule(name, place, gains)]
    if not gains:
        return [_none(name, place, 0, "none forbidden", "Every heater heats, by a size that is possible.")]
    worst = max(gains, key=lambda gain: (gain["certain"], abs(gain["gain"])))
    text = f"{worst['input']} on {worst['output']}"
    rule = _none(name, place, len(gains), text, flagged_sentence(gains), flagged_remedy(gains))
    certain = sum(gain["certain"] for gain in gains)
    return [rule._replace(figure=Figure(len(gains), certain, len(gains)))]


def flagged_remedy(gains: Sequence[Mapping[str, Any]]) -> str:
    """What to do before a controller is designed from the model."""
    if any(gain["certain"] for gain in gains):
        return (
            "Design no controller from this model before each is explained: check source and scale in "
            "ingest.mapping, then record again with every input moved on its own."
        )
    return (
        "Its band reaches what is possible, so that the effect is not known: move that input on its own and "
        "record again before a controller relies on it."
    )


def flagged_sentence(gains: Sequence[Mapping[str, Any]]) -> str:
    """What physics forbids of the model, in a sentence with the gravest gain."""
    worst = max(gains, key=lambda gain: (gain["certain"], abs(gain["gain"])))
    places = decimals(worst["low"], worst["high"], value=worst["gain"])
    ends = band(worst["low"], worst["high"], places)
    flagged = count(len(gains), "gain is flagged", "gains are flagged").capitalize()
    return (
        f"{flagged}: {worst['input']} on {worst['output']}, {number(worst['gain'], places)}"
        f"{f' ({ends})' if ends else ''} °C per %, {'is' if worst['certain'] else 'would be'} "
        f"{worst['reason']}."
    )
