"""Sentences beside the temperature loop's verdict: the case that decides, and the best of all controllers."""

from collections.abc import Mapping, Sequence

from pipeline.verdict.controllers import YARDSTICKS, in_a_sentence
from pipeline.verdict.decide import Standing
from pipeline.verdict.digits import short
from pipeline.verdict.evidence import Figures, entry
from pipeline.verdict.pairs import reference_of
from pipeline.verdict.temperature import comparison
from pipeline.verdict.wording import name_first


def deciding_sentence(figures: Figures, winner: str | None) -> str:
    """Which case decides, and the verdict without its plant."""
    case = entry(comparison(figures), "deciding")
    if not isinstance(case, Mapping) or entry(case, "plant") is None:
        return ""
    compared, plant = comparison(figures), case["plant"]
    kind = f", {reference_of(case)}" if case.get("kind") else ""
    changes = []
    if entry(compared, "best") == winner and case.get("best_without") != winner:
        other = case.get("best_without")
        changes.append(f"the best would be {in_a_sentence(other)}" if other else "nobody would pass")
    pair = entry(compared, "pair", "winner")
    if case.get("pair_without") != pair:
        other = case.get("pair_without")
        changes.append(
            f"the pair would go to {in_a_sentence(other)}" if other else "the pair would be undecided"
        )
    without = " and ".join(changes) if changes else "the same"
    return f"Deciding case: plant {plant}{kind}. Without plant {plant} {without}."


def best_sentence(figures: Figures, held: Mapping[str, Standing], winner: str | None) -> str:
    """The best of all contestants, beside the pair."""
    if winner is None:
        cheapest = entry(comparison(figures), "best_reason", "leading")
        costs = f" {name_first(cheapest)} costs least." if cheapest in held else ""
        return f"Best of all: nobody passes every rule.{costs}"
    others = [
        in_a_sentence(name)
        for name, standing in held.items()
        if standing.passes and name != winner and name not in YARDSTICKS
    ]
    beside = f"; {_listed(others)} {'passes' if len(others) == 1 else 'pass'} too" if others else ""
    cheapest = entry(comparison(figures), "best")
    if cheapest in held and cheapest != winner:
        return (
            f"On this record {in_a_sentence(cheapest)} is the best{_ahead(figures, cheapest)}; "
            f"named is {in_a_sentence(winner)}{beside}."
        )
    return f"Best of all that pass: {in_a_sentence(winner)}{_ahead(figures, winner)}{beside}."


def _ahead(figures: Figures, winner: str) -> str:
    """By how much the winner is cheaper than the cheapest other that passes, or that chance may be it."""
    reason = entry(comparison(figures), "best_reason")
    percent, p = entry(reason, "improvement_percent"), entry(reason, "p")
    if entry(comparison(figures), "best") != winner or not isinstance(percent, int | float):
        return ""
    nearest = in_a_sentence(entry(reason, "nearest"))
    if isinstance(p, int | float) and p < 0.05 and percent > 0:
        return f", {short(percent, 2)}\u00a0% cheaper than {nearest}"
    chance = f", the simplest; {nearest} is cheaper by no more than chance"
    return chance if percent < 0 else f"; {nearest} is next"


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
