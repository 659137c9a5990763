"""Champion and challenger on the same cases -> promote or keep, with every number that decided."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pipeline.nightly.records import FIRST, KEPT, PROMOTED, Alarm, LoopDecision
from pipeline.nightly.settings import PromotionRule
from pipeline.statistics import Paired, blocks_needed, paired
from pipeline.verdict.digits import THIN, beyond_meaning


class CaseCosts(NamedTuple):
    """What the judge measured of one controller: {case: (block, cost)}, {guard: figure, less is better}, and
    the name of the panel, which two must share to be compared."""

    panel: str
    cases: dict[str, tuple[str, float]]
    guards: dict[str, float]


def decide(
    champion: CaseCosts | None,
    challenger: CaseCosts,
    rule: PromotionRule,
    *,
    allowed: Mapping[str, float],
    alarms: Sequence[Alarm],
    seed: int,
) -> LoopDecision:
    """Promote if the paired test finds the challenger better by at least `rule.least_improvement_percent`,
    no guard is worse by more than `allowed`, and nothing has drifted: `alarms` are those of this loop
    alone."""
    if champion is None:
        return _first(challenger)
    if champion.panel != challenger.panel:
        names = f"{champion.panel[:12]}, {challenger.panel[:12]}"
        reason = f"the two were judged on different cases ({names}): they cannot be compared"
        return LoopDecision(KEPT, [reason])
    shared = [case for case in champion.cases if case in challenger.cases]
    test = paired(
        np.array([champion.cases[case][1] for case in shared]),
        np.array([challenger.cases[case][1] for case in shared]),
        [champion.cases[case][0] for case in shared],
        rng=np.random.default_rng(seed),
    )
    against = _against(test, rule) + _guards(champion, challenger, allowed) + _unfit(challenger)
    against += [f"drift: {alarm.cause}; what the panel stands for has changed" for alarm in alarms]
    guards = {
        name: {"champion": before, "challenger": challenger.guards[name], "allowed": allowed.get(name, 0.0)}
        for name, before in champion.guards.items()
        if name in challenger.guards
    }
    if against:
        return LoopDecision(KEPT, against, test, guards)
    better = (
        f"{_percent(test.improvement_percent)} better ({_band(test.low_percent, test.high_percent)}, "
        f"{_chance(test)}) on {test.cases} cases of {test.blocks} blocks"
    )
    return LoopDecision(PROMOTED, [better, "no guard is worse"], test, guards)


def _first(challenger: CaseCosts) -> LoopDecision:
    """If there is no champion, a challenger that is fit becomes one."""
    failing = [case for case, (_, cost) in challenger.cases.items() if not np.isfinite(cost)]
    reasons = _unfit(challenger)
    if not challenger.cases:
        reasons.append("it was judged on no case")
    if failing:
        reasons.append(f"{len(failing)} of {len(challenger.cases)} cases fail, such as {failing[0]}")
    guards = {
        name: {"champion": None, "challenger": figure, "allowed": None}
        for name, figure in challenger.guards.items()
    }
    if not reasons:
        return LoopDecision(FIRST, ["there was no champion to compare with"], guards=guards)
    start = "there is no champion, and the challenger is not fit to be one: "
    return LoopDecision(KEPT, [start + "; ".join(reasons)], guards=guards)


def _unfit(challenger: CaseCosts) -> list[str]:
    return [
        f"{name} is {figure:g}; none is allowed"
        for name, figure in challenger.guards.items()
        if name.startswith("unstable") and not figure <= 0
    ]


def _percent(value: float) -> str:
    """ "5.0 %"; "beyond 1,000 %" if the figure says nothing."""
    return beyond_meaning(value, "%").replace(THIN, " ") or f"{_tenths(value)} %"


def _tenths(value: float) -> str:
    """ "5.0"; of what rounds to nothing no sign."""
    return f"{round(value, 1) + 0.0:.1f}"


def _band(low: float, high: float) -> str:
    """ "4.0 to 6.0 %"."""
    return f"{_percent(low) if beyond_meaning(low, '%') else _tenths(low)} to {_percent(high)}"


def _chance(test: Paired) -> str:
    return "p < 0.0001" if test.p < 1e-4 else f"p = {test.p:.2g}"


def _against(test: Paired, rule: PromotionRule) -> list[str]:
    if test.blocks < blocks_needed(rule.level):
        return [
            f"{test.blocks} blocks cannot tell at level {rule.level:g}; "
            f"at least {blocks_needed(rule.level)} are needed"
        ]
    band = _band(test.low_percent, test.high_percent)
    margin = f"{_percent(test.improvement_percent)} ({band}, {_chance(test)})"
    if test.improvement_percent <= 0:
        return [
            f"the challenger is no better: its cases cost {_percent(-test.improvement_percent)} more "
            f"({_band(-test.high_percent, -test.low_percent)})"
        ]
    if test.improvement_percent < rule.least_improvement_percent:
        return [
            f"the challenger is better by {margin}; at least {rule.least_improvement_percent:g} "
            "% is worth a change"
        ]
    if test.p > rule.level:
        return [f"the challenger is better by {margin}, within noise at level {rule.level:g}"]
    return []


def _guards(champion: CaseCosts, challenger: CaseCosts, allowed: Mapping[str, float]) -> list[str]:
    sentences = []
    for name, before in champion.guards.items():
        now = challenger.guards.get(name, np.inf)
        # figures that differ by rounding are equal
        if not now <= before + allowed.get(name, 0.0) + 1e-9 * abs(before):
            sentences.append(
                f"guard {name} is {now:.4g} against {before:.4g}; "
                f"at most {allowed.get(name, 0.0):.3g} more is allowed"
            )
    return sentences
