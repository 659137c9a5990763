"""Better beyond noise, and the rule that promotes."""

import numpy as np
import pytest

from pipeline.nightly.decision import FIRST, KEPT, PROMOTED, CaseCosts, decide
from pipeline.nightly.records import Alarm
from pipeline.nightly.settings import PromotionRule
from pipeline.statistics import blocks_needed, paired

RULE = PromotionRule(
    level=0.01,
    least_improvement_percent=5,
    worst_case_percent=5,
    settled_error_degC=0.05,
    least_disk_margin=0.5,
    holdout_error_percent=5,
)


def test_chance_alone_promotes_as_seldom_as_the_level_says():
    """Two equal controllers, 16 plants of 4 noisy cases: p is uniform, so that it falls below 0.05 in 5 % of
    400 panels, give or take 1.1 (one sigma)."""
    rng = np.random.default_rng(1)
    block = [f"plant {k}" for k in np.repeat(np.arange(16), 4)]
    p = [
        paired(*np.exp(0.1 * rng.standard_normal((2, 64))), block, rng=rng, draws=2000).p for _ in range(400)
    ]
    assert 0.02 < np.mean(np.array(p) < 0.05) < 0.09


def test_ten_percent_better_is_found_among_ten_percent_of_noise():
    rng = np.random.default_rng(2)
    champion = np.exp(0.1 * rng.standard_normal(64)) * np.repeat(rng.uniform(1, 5, 16), 4)
    result = paired(
        champion,
        0.9 * champion * np.exp(0.02 * rng.standard_normal(64)),
        [str(k // 4) for k in range(64)],
        rng=rng,
    )
    assert result.p < 0.001 and result.low_percent < 10 < result.high_percent


def test_cases_of_one_plant_count_once():
    """A thousand copies of one plant's case are one block: no evidence at all."""
    result = paired(np.ones(1000), np.full(1000, 0.5), ["one plant"] * 1000, rng=np.random.default_rng(0))
    assert result.p == 0.5 and result.blocks == 1


def test_the_sign_flip_test_worked_by_hand():
    # three blocks, all better by the same: of 8 signs only +++ does as well
    result = paired(np.ones(3), np.full(3, 0.8), ["a", "b", "c"], rng=np.random.default_rng(0))
    assert result.p == 1 / 8 and result.improvement_percent == pytest.approx(20)
    assert blocks_needed(0.01) == 7  # 2^-7 = 0.0078


def test_costs_that_are_none_are_refused():
    with pytest.raises(ValueError, match="expected costs above 0 of at least one case that both ran"):
        paired(np.array([0.0]), np.array([1.0]), ["a"], rng=np.random.default_rng(0))


GAIN_ALARM = Alarm("temperature", "gain", "shift.csv", "the gain from heater_1 has changed", 6.0)


def _evidence(cost: float, **guards: float) -> CaseCosts:
    return CaseCosts(
        "panel",
        {f"case {k}": (f"plant {k}", cost * (1 + k)) for k in range(8)},
        {"worst_case": 10.0, "unstable_plants": 0.0} | guards,
    )


def _decide(champion, challenger, alarms=()):
    return decide(champion, challenger, RULE, allowed={"worst_case": 0.5}, alarms=list(alarms), seed=1)


def test_the_rule_promotes_what_is_better_and_nothing_else():
    assert _decide(None, _evidence(1.0)).decision == FIRST
    assert _decide(_evidence(1.0), _evidence(0.9)).decision == PROMOTED
    assert _decide(_evidence(1.0), _evidence(1.0)).decision == KEPT
    assert _decide(_evidence(1.0), _evidence(1.1)).decision == KEPT


@pytest.mark.parametrize(
    ("challenger", "alarms", "reason"),
    [
        (_evidence(0.97), (), "at least 5 % is worth a change"),
        (_evidence(0.9, worst_case=10.6), (),
        "guard worst_case is 10.6 against 10; at most 0.5 more is allowed"),
        (_evidence(0.9, unstable_plants=1.0), (), "unstable_plants is 1; none is allowed"),
        (_evidence(0.9)._replace(panel="another"), (), "judged on different cases"),
        (_evidence(0.9), (GAIN_ALARM,),
        "drift: the gain from heater_1 has changed"),
        (_evidence(0.9)._replace(cases={f"case {k}": ("plant", 0.9) for k in range(8)}), (),
        "blocks cannot tell at level 0.01; at least 7 are needed"),
        (_evidence(0.9)._replace(guards={}), (), "guard worst_case is inf"),
    ],
)  # fmt: skip
def test_a_better_mean_alone_does_not_promote(challenger, alarms, reason):
    champion = (
        _evidence(1.0)
        if challenger.cases["case 0"][0] != "plant"
        else _evidence(1.0)._replace(cases={f"case {k}": ("plant", 1.0) for k in range(8)})
    )
    result = _decide(champion, challenger, alarms)
    assert result.decision == KEPT and any(reason in sentence for sentence in result.reasons), result.reasons


def test_a_first_challenger_that_is_unstable_somewhere_is_no_champion():
    result = _decide(None, _evidence(1.0, unstable_plants=2.0))
    assert result.decision == KEPT and "unstable_plants is 2" in result.reasons[0]


def test_a_challenger_that_fails_cases_is_no_better():
    worse = _evidence(0.8)
    worse.cases["case 3"] = ("plant 3", float("inf"))
    assert _decide(_evidence(1.0), worse).decision == KEPT
