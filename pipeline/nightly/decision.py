"""Champion and challenger on the same cases -> promote or keep, with every number that decided."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from pipeline.nightly.settings import Rule
from pipeline.statistics import blocks_needed, paired

PROMOTED, KEPT, FIRST = "promoted", "kept", "first champion"


class Evidence(NamedTuple):
    """What the judge measured of one controller: {case: (block, cost)}, {guard: figure, less is better}, and
    the name of the panel, which two must share to be compared."""

    panel: str
    cases: dict[str, tuple[str, float]]
    guards: dict[str, float]


class Decision(NamedTuple):
    decision: str
    reasons: list[str]
    figures: dict[str, Any]

    @property
    def promotes(self) -> bool:
        return self.decision in (PROMOTED, FIRST)


def decide(
    champion: Evidence | None,
    challenger: Evidence,
    rule: Rule,
    *,
    allowed: Mapping[str, float],
    alarms: list[str],
    seed: int,
) -> Decision:
    """Promote where the paired test finds the challenger better by at least `rule.least_improvement_percent`,
    no guard is worse by more than `allowed`, and nothing has drifted."""
    infinite = [case for case, (_, cost) in challenger.cases.items() if not np.isfinite(cost)]
    unfit = [
        f"{name} is {figure:g}; none is allowed"
        for name, figure in challenger.guards.items()
        if name.startswith("unstable") and figure > 0
    ]
    if champion is None:
        reasons = unfit + (
            [f"{len(infinite)} of {len(challenger.cases)} cases fail, such as {infinite[0]}"]
            if infinite
            else []
        )
        figures = {"guards": {name: {"challenger": figure} for name, figure in challenger.guards.items()}}
        return (
            Decision(
                KEPT,
                ["there is no champion, and the challenger is not fit to be one: " + "; ".join(reasons)],
                figures,
            )
            if reasons
            else Decision(FIRST, ["there was no champion to compare with"], figures)
        )
    if champion.panel != challenger.panel:
        return Decision(
            KEPT,
            [
                f"the two were judged on different cases ({champion.panel[:12]}, {challenger.panel[:12]}): "
                "they cannot be compared"
            ],
            {},
        )
    shared = [case for case in champion.cases if case in challenger.cases]
    found = paired(
        np.array([champion.cases[case][1] for case in shared]),
        np.array([challenger.cases[case][1] for case in shared]),
        [champion.cases[case][0] for case in shared], rng=np.random.default_rng(seed),
    )  # fmt: skip
    against = _against(found, rule) + _guards(champion, challenger, allowed) + unfit
    against += [f"drift: {alarm}; what the panel stands for has changed" for alarm in alarms]
    figures = {
        "paired": found._asdict(),
        "guards": {
            name: {
                "champion": champion.guards[name],
                "challenger": challenger.guards[name],
                "allowed": allowed.get(name, 0.0),
            }
            for name in champion.guards
            if name in challenger.guards
        },
    }
    better = f"{found.improvement_percent:.1f} % better ({found.low_percent:.1f} to {found.high_percent:.1f} %, {_chance(found)}) on {found.cases} cases of {found.blocks} blocks"
    return (
        Decision(KEPT, against, figures)
        if against
        else Decision(PROMOTED, [better, "no guard is worse"], figures)
    )


def _chance(found) -> str:
    return "p < 0.0001" if found.p < 1e-4 else f"p = {found.p:.2g}"


def _against(found, rule: Rule) -> list[str]:
    if found.blocks < blocks_needed(rule.level):
        return [
            f"{found.blocks} blocks cannot tell at level {rule.level:g}; "
            f"at least {blocks_needed(rule.level)} are needed"
        ]
    told = f"{found.improvement_percent:.1f} % ({found.low_percent:.1f} to {found.high_percent:.1f} %, {_chance(found)})"
    if found.improvement_percent <= 0:
        return [
            f"the challenger is no better: its cases cost {-found.improvement_percent:.1f} % more "
            f"({-found.high_percent:.1f} to {-found.low_percent:.1f} %)"
        ]
    if found.improvement_percent < rule.least_improvement_percent:
        return [
            f"the challenger is better by {told}; at least {rule.least_improvement_percent:g} "
            "% is worth a change"
        ]
    if found.p > rule.level:
        return [f"the challenger is better by {told}, within noise at level {rule.level:g}"]
    return []


def _guards(champion: Evidence, challenger: Evidence, allowed: Mapping[str, float]) -> list[str]:
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
