"""Compares model-based with data-driven control in a sentence, from the figures of the comparison."""

from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.temperature.controllers.table import BY_NAME, answering_pair
from pipeline.verdict.controllers import in_a_sentence
from pipeline.verdict.digits import band, number
from pipeline.verdict.evidence import Figures, entry
from pipeline.verdict.temperature import comparison, finite, names, refused
from pipeline.verdict.verdict import PairSentence


def pair_names(figures: Figures) -> tuple[str, str]:
    """Returns the model-based controller and the data-driven one, or a second model-based one if every
    data-driven one is refused."""
    pair = entry(comparison(figures), "pair")
    if isinstance(pair, Mapping) and {"a", "b"} <= pair.keys():
        return str(pair["a"]), str(pair["b"])
    return answering_pair(names(figures), {})


def pair_sentence(figures: Figures) -> PairSentence:
    """Returns the comparison in words: "subspace + LQG costs 6 % less than the learned kernel on the same 60
    plants (90 % interval 3-9 %, by structure of the machine 4-8 %)", or that there is no difference."""
    pair = entry(comparison(figures), "pair")
    a, b = pair_names(figures)
    compared = b not in BY_NAME or BY_NAME[b].kind == "data-driven"
    reasons = {name: why for name, why in refused(figures).items() if BY_NAME[name].kind == "data-driven"}
    instead = "" if compared else " ".join(_refusal(*one) for one in reasons.items())
    head = (
        "Model-based against data-driven:" if compared else "No data-driven controller; two model-based ones:"
    )
    if not isinstance(pair, Mapping) or (pair.get("winner") is None and pair.get("difference") is None):
        gap = refused(figures).get(a) or refused(figures).get(b) or "not measured"
        return PairSentence(f"{head} {gap.rstrip('.')}.", None, note=instead)
    plants = entry(pair, "plants") or entry(comparison(figures), "plants")
    winner = entry(pair, "winner")
    by_structure = _by_structure(entry(pair, "by_structure") or [])
    better, worse = (in_a_sentence(n) for n in ((a, b) if winner != b else (b, a)))
    if winner not in (a, b):
        # a 90 % interval may exclude zero if p is between 0.05 and 0.1, so the level is stated
        saved = abs(finite(entry(pair, "difference")))
        interval = _interval(pair) if saved <= 90 else ""
        saves = f"the cheaper one saves {number(saved, 1)} %" if interval else ""
        level = "at the 5 % level" if entry(pair, "kept") else "that another machine would keep"
        text = f"no difference {level} between {better} and {worse} on the same {plants} plants"
        told = f"{head} {text}{_bracket(saves, interval, by_structure)}."
        return PairSentence(told, None, f"{head} no difference {level}{_bracket(saves)}.", instead)
    gain = abs(finite(entry(pair, "difference")))
    amount = "far less" if not gain <= 90 else f"{number(gain, 0 if gain >= 10 else 1)} % less"
    interval = _interval(pair) if gain <= 90 else ""
    text = f"{better} costs {amount} than {worse} on the same {plants} plants"
    short = f"{head} {better}, {amount.replace('less', 'lower')} cost than {worse}{_bracket(interval)}."
    short = f"{short} {instead}".strip()
    return PairSentence(f"{head} {text}{_bracket(interval, by_structure)}.", str(winner), short, instead)


def curve_sentence(figures: Figures) -> str:
    """Returns at which length of the record the pair changes places, or that it does not within the record;
    "" if no controller was learned again from a part of it."""
    compared = comparison(figures)
    curve, step = entry(compared, "cost_curve"), entry(compared, "sample_time_s")
    if not isinstance(curve, Mapping):
        return ""
    a, b = curve["pair"]
    known = [
        (length, *costs)
        for length, *costs in zip(
            curve["samples"],
            *(entry(curve, "controllers", name, "cost") or [] for name in (a, b)),
            strict=False,
        )
        if None not in costs
    ]
    if len(known) < 2:
        return "One of the pair could not be learned from less than this record."
    minutes = [number(length * step / 60, 0) for length, *_ in known]
    ahead = [in_a_sentence(a if one < other else b) for _, one, other in known]
    crossing = curve["crossing"]
    if crossing["samples"] is None:
        return (
            f"{ahead[-1][:1].upper()}{ahead[-1][1:]} costs less at every length from {minutes[0]} to "
            f"{minutes[-1]} min. The pair does not change places within this record."
        )
    at = number(crossing["samples"] * step / 60, 0)
    ends = [crossing[end] and crossing[end] * step / 60 for end in ("low", "high")]
    if None in ends:
        return (
            f"The pair changes places at {at} min on average, which is not sure: the 90 % interval does not "
            "end within this record."
        )
    interval = f"90 % interval {band(*ends, 0) or number(ends[0], 0)} min"
    return f"The pair changes places at {at} min ({interval}): from there on {ahead[-1]} costs less."


def _refusal(name: str, why: str) -> str:
    subject = in_a_sentence(name)
    return f"{subject[:1].upper()}{subject[1:]} is refused: {why.rstrip('.')}."


def _interval(pair: Mapping[str, Any]) -> str:
    ends = sorted(finite(entry(pair, end)) for end in ("low", "high"))
    if not all(abs(end) <= 1000 for end in ends):
        return ""
    places = 0 if max(map(abs, ends)) >= 20 else 1
    return f"90 % interval {band(*ends, places) or number(ends[0], places)} %"


def _by_structure(differences: Sequence[float]) -> str:
    """Returns the range of a difference in percent over the structures of the machine."""
    ends = [finite(min(differences)), finite(max(differences))] if differences else []
    if not ends or max(map(abs, ends)) > 1000:
        return ""
    places = 0 if max(map(abs, ends)) >= 20 else 1
    return f"by structure of the machine {band(*ends, places) or number(ends[0], places)} %"


def _bracket(*parts: str) -> str:
    inside = ", ".join(filter(None, parts))
    return f" ({inside})" if inside else ""


def reference_of(case: Mapping[str, Any]) -> str:
    """Returns "a constant reference", "a ramp"."""
    kind = str(case.get("kind") or "")
    return f"a {kind}{' reference' if kind == 'constant' else ''}" if kind else ""
