"""The comparison: ties go to the simpler, plants are blocks, and bands hold what they say, by simulation of
known distributions."""

import numpy as np
import pytest

from pipeline.temperature.test_set.scorecard import (
    banded,
    between,
    chosen,
    deciding_plant,
    mean_and_worst,
    pair,
)

PLANTS, EACH = 30, 4
PLANT = np.repeat(np.arange(PLANTS), EACH)
ALIKE = 0 * PLANT  # all plants of one structure


def costs(seed: int, *, times: float = 1.0, plants: int = PLANTS, each: int = EACH, own: float = 0.1):
    """Costs of one contestant: each plant's own level, what differs by plant from one contestant to another
    (`own`, in logarithms), and the same by case."""
    level = np.random.default_rng(0).normal(1.0, 0.5, plants)
    rng = np.random.default_rng(seed)
    by_plant = level + own * rng.standard_normal(plants)
    return times * np.exp(np.repeat(by_plant, each) + 0.05 * rng.standard_normal(plants * each))


EVERYBODY = dict.fromkeys(("simple", "middle", "complex", "a", "b"), True)

# so few that all signs are tried, which is quick
FEW = np.repeat(np.arange(10), 2)


def alike(k: int) -> dict[str, np.ndarray]:
    """Two contestants of the same distribution on a panel of FEW plants."""
    return {name: costs(2 * k + i, plants=10, each=2) for i, name in enumerate("ab")}


# ---- the best


@pytest.mark.parametrize("seed", range(5))
def test_a_tie_goes_to_the_simpler_though_its_mean_is_higher(seed):
    """1 % of cost lies within what plants differ by: 0.14 / sqrt(30) = 2.6 %."""
    one = costs(2 * seed + 1)
    rivals = {"simple": one, "middle": one * np.exp(0.14 * np.random.default_rng(seed).standard_normal(120))}
    rivals["middle"] *= 0.99 * one.mean() / rivals["middle"].mean()
    best, nearest, against = chosen(rivals, PLANT, EVERYBODY, seed=1)
    assert (best, nearest) == ("simple", "middle")
    # told as the simpler one against it: no better, and nobody claims it
    assert against == between(rivals["middle"], one, PLANT, seed=1) and against.p > 0.05


def test_what_is_equal_case_by_case_is_no_better():
    same = costs(1)
    assert chosen(dict.fromkeys(("simple", "complex"), same), PLANT, EVERYBODY, seed=1)[0] == "simple"


def test_a_more_complex_one_that_is_better_beyond_chance_replaces_the_simpler_and_must_itself_be_beaten():
    rivals = {"simple": costs(1), "middle": costs(2, times=0.8), "complex": costs(3, times=0.79)}
    assert chosen(rivals, PLANT, EVERYBODY, seed=1)[:2] == ("middle", "complex")
    *names, against = chosen(rivals | {"complex": costs(3, times=0.6)}, PLANT, EVERYBODY, seed=1)
    assert names == ["complex", "middle"] and against.p < 0.05


def test_who_breaks_a_rule_is_never_the_best_however_cheap():
    rivals = {"simple": costs(1), "middle": costs(2, times=0.1), "complex": costs(3, times=0.5)}
    assert chosen(rivals, PLANT, EVERYBODY | {"middle": False}, seed=1)[0] == "complex"
    nobody = chosen(rivals, PLANT, dict.fromkeys(EVERYBODY, False), seed=1)
    assert nobody == (None, None, None)


def test_more_cases_of_the_same_plants_are_no_more_evidence():
    """Each case three times over: the same blocks, the same probability."""
    a, b = costs(1), costs(2, times=0.97)
    once = between(a, b, PLANT, seed=1)
    thrice = between(np.repeat(a, 3), np.repeat(b, 3), np.repeat(PLANT, 3), seed=1)
    assert thrice.p == once.p and thrice.blocks == once.blocks == PLANTS
    assert thrice.improvement_percent == pytest.approx(once.improvement_percent, rel=1e-12)
    # taken for plants of their own they would tell the two apart with more certainty than there is
    assert between(np.repeat(a, 3), np.repeat(b, 3), np.arange(3 * len(a)), seed=1).p < once.p


def test_of_two_alike_the_more_complex_is_best_in_one_of_twenty_panels():
    """One-sided at 0.05, over 400 panels: 0.011 is a standard deviation."""
    replaced = [chosen(alike(k), FEW, EVERYBODY, seed=k)[0] == "b" for k in range(400)]
    assert abs(np.mean(replaced) - 0.05) < 0.035


# ---- the pair


def test_the_pair_has_the_same_winner_whoever_is_named_first():
    both = {"model": costs(1), "data": costs(2, times=0.9)}
    one, other = (
        pair(*names, both, PLANT, ALIKE, seed=1) for names in (("model", "data"), ("data", "model"))
    )
    assert one["winner"] == other["winner"] == "data"
    assert list(one.values())[3:] == list(other.values())[3:]
    # by the logarithms of the costs, plant by plant
    saved = np.log(both["model"] / both["data"]).reshape(PLANTS, EACH).mean(axis=1)
    assert one["difference"] == pytest.approx(100 * (1 - np.exp(-saved.mean())), rel=1e-9)
    assert 0 < one["low"] < one["difference"] < one["high"]


def test_a_pair_within_chance_has_a_difference_and_no_winner():
    result = pair("a", "b", {"a": costs(1), "b": costs(2)}, PLANT, ALIKE, seed=1)
    assert result["winner"] is None and result["p"] >= 0.05 and result["difference"] >= 0


def test_a_difference_that_the_structure_of_a_machine_turns_round_is_none_that_another_would_keep():
    structure = PLANT % 5
    a, b = costs(1, own=0.01), costs(2, own=0.01)
    alike_everywhere = pair("a", "b", {"a": a, "b": 0.9 * b}, PLANT, structure, seed=1)
    assert alike_everywhere["winner"] == "b" and alike_everywhere["kept"]
    assert max(alike_everywhere["by_structure"]) - min(alike_everywhere["by_structure"]) < 3
    # as large on the whole, but by structure +40, +10, +5, 0 and -8 %
    shares = np.array([0.6, 0.9, 0.95, 1.0, 1.08])
    turned = pair("a", "b", {"a": a, "b": shares[structure] * b}, PLANT, structure, seed=1)
    assert turned["difference"] > 8 and turned["p"] < 0.05
    # three deviations of what differs by case: 0.05 sqrt(2 / 24)
    np.testing.assert_allclose(turned["by_structure"], 100 * (1 - shares), atol=4.5)
    assert not turned["kept"] and turned["winner"] is None


def test_a_difference_beyond_the_deviation_over_structures_is_kept_and_one_within_is_not():
    structure = PLANT % 5
    a, b = costs(1, own=0.01), costs(1, own=0.01)
    for shares, kept in (
        # by structure 15, 10, 7, 5 and 1 %: 7.6 on the whole, deviation 5.3, range 14
        ([0.85, 0.9, 0.93, 0.95, 0.99], True),
        # 15, 10, 3, 0 and -5 %: 4.6 on the whole, deviation 7.9
        ([0.85, 0.9, 0.97, 1.0, 1.05], False),
    ):
        of = pair("a", "b", {"a": a, "b": np.array(shares)[structure] * b}, PLANT, structure, seed=1)
        np.testing.assert_allclose(of["by_structure"], 100 * (1 - np.array(shares)), atol=1e-6)
        assert of["p"] < 0.05 and of["kept"] == kept and of["winner"] == ("b" if kept else None)


def test_of_two_alike_one_wins_in_one_of_twenty_panels_and_the_interval_holds_zero_in_nine_of_ten():
    """Over 400 panels: 0.011 is a standard deviation of the first, 0.015 of the second; the difference is
    that of the cheaper one, so that only its lower end can miss zero, at either side."""
    results = [pair("a", "b", alike(k), FEW, 0 * FEW, seed=k) for k in range(400)]
    assert abs(np.mean([r["winner"] is not None for r in results]) - 0.05) < 0.035
    assert abs(np.mean([r["low"] <= 0 for r in results]) - 0.9) < 0.045


# ---- the plant that decides


def test_the_deciding_plant_is_that_without_which_the_difference_is_least():
    plant = np.repeat([0, 1, 2, 5], 2)
    a, b = np.ones(8), np.array([1.1, 1.1, 3.0, 1.0, 0.2, 0.9, 1.2, 1.2])
    # logarithms of a / b by plant: -0.1, -0.55, +0.86, -0.18: on the whole a is dearer, by plant 2 alone
    assert deciding_plant(a, b, plant) == 2
    assert deciding_plant(b, a, plant) == 2
    mine = {index: np.log(a / b)[plant != index].mean() for index in (0, 1, 2, 5)}
    assert min(mine, key=lambda index: mine[index]) == 2


def test_where_one_plant_decides_the_answer_without_it_is_another():
    a, b = costs(1, own=0.02), costs(2, own=0.02)
    a[PLANT == 7] *= 1e4
    assert deciding_plant(a, b, PLANT) == 7
    left = PLANT != 7
    assert pair("a", "b", {"a": a, "b": b}, PLANT, ALIKE, seed=1)["difference"] > 20
    assert pair("a", "b", {"a": a[left], "b": b[left]}, PLANT[left], ALIKE[left], seed=1)["difference"] < 2


# ---- bands


def test_a_band_by_hand():
    values = np.array([1.0, 2.0, np.nan, 4.0, 3.0, 10.0])
    band, worst = banded(values, np.array([0, 0, 0, 1, 1, 1]), seed=1)
    # of 1, 2, 3, 4, 10: nine tenths of the way from place 0 to 4 is 3.6, nearest to the last, which is case 5
    assert (band["median"], band["q90"], band["worst"], worst) == (3.0, 10.0, 10.0, 5)
    assert band["low"] in values and band["high"] == 10.0


def test_what_never_settles_is_infinitely_late_and_sorts_last():
    band, _ = banded(np.r_[np.arange(18.0), np.inf, np.inf, np.inf], np.arange(21), seed=1)
    assert (band["median"], band["q90"], band["worst"]) == (10.0, np.inf, np.inf)
    assert np.isfinite(band["low"]) and band["high"] == np.inf


@pytest.mark.parametrize(("between_plants", "within"), [(1.0, 0.3), (0.1, 1.0)])
def test_a_band_holds_the_true_quantile_in_nine_of_ten_panels(between_plants, within):
    """Logarithms normal by plant and by case: the 90 % quantile of all cases of all plants is known. 150
    panels of 60 plants: 0.025 is a standard deviation; resampling few plants covers a little less."""
    true = np.exp(1.2815515655446004 * np.hypot(between_plants, within))
    plant, rng, hits = np.repeat(np.arange(60), 5), np.random.default_rng(1), []
    for seed in range(150):
        level = np.repeat(between_plants * rng.standard_normal(60), 5)
        band, _ = banded(np.exp(level + within * rng.standard_normal(300)), plant, seed=seed)
        hits.append(band["low"] <= true <= band["high"])
    assert 0.8 < np.mean(hits) < 0.97


def test_cases_taken_for_plants_of_their_own_would_make_the_band_too_narrow():
    level = np.repeat(np.random.default_rng(1).standard_normal(60), 5)
    values = np.exp(level + 0.1 * np.random.default_rng(2).standard_normal(300))
    blocks, _ = banded(values, np.repeat(np.arange(60), 5), seed=1)
    cases, _ = banded(values, np.arange(300), seed=1)
    assert [blocks[key] for key in ("median", "q90")] == [cases[key] for key in ("median", "q90")]
    # five alike count as one: sqrt(5), and what the quantile's steps blur
    assert np.log(blocks["high"] / blocks["low"]) > 1.5 * np.log(cases["high"] / cases["low"])


# ---- one number for a search


def test_a_searchs_cost_is_the_geometric_mean_and_the_costliest_quarter_by_hand():
    plant = np.repeat(np.arange(8), 2)
    by_plant = np.array([1.0, 2, 3, 4, 5, 6, 7, 12])
    values = np.repeat(by_plant, 2) * np.tile([0.5, 1.5], 8)
    mean, tail = np.log(by_plant).mean(), np.log([7.0, 12.0]).mean()
    assert mean_and_worst(values, plant, weight=0.5) == pytest.approx(np.exp((mean + 0.5 * tail) / 1.5))
    assert mean_and_worst(values, plant, weight=0.0) == pytest.approx(np.exp(mean))
