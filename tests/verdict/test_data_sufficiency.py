"""Each controller is charged with what its own estimator leaves open of the closed loop, and with nothing of
the others'."""

import pytest

from pipeline.verdict.temperature import data
from pipeline.verdict.verdict import OPEN, Figure, Missing
from tests.report import made

LEARNED_FROM_THE_PLANT = ("pi_simc", "pi", "subspace_lqg")


@pytest.fixture
def figures():
    return made.metrics()


@pytest.mark.parametrize("name", LEARNED_FROM_THE_PLANT)
def test_the_samples_of_a_window_are_not_charged_to_a_controller_without_one(figures, name):
    figures["learn_kernel"] |= {"samples_needed_for_noise": 11_934, "window": 24}
    figures["identify_plant"]["past"] = 116
    figure = data(figures, name)
    assert isinstance(figure, Figure) and figure.value == 380 / 19
    assert data(figures, "varx_riccati").note == "380 of 11,934 samples; record 11,554 more"


def test_a_controller_needs_the_samples_at_which_its_extra_cost_is_allowed(figures):
    figures["evaluate_temperature"]["redesigned"]["pi"]["excess_percent"] = 20.0
    assert data(figures, "pi").note == "380 of 760 samples; record 380 more"
    assert data(figures, "subspace_lqg").value > 1
    figures["learn_kernel"]["candidates"] = {"predicted state": {"gap_on_window_model_percent": 3.0}}
    assert data(figures, "learned_kernel").note == "380 of 1,140 samples; record 760 more"


def test_predictive_control_is_charged_with_its_own_half_record_or_with_its_refusal(figures):
    assert data(figures, "predictive_control").note == "336 of 120 samples"
    figures["learn_kernel"]["predictive"] = {"refused": "too few stretches; record longer"}
    gap = data(figures, "predictive_control")
    assert isinstance(gap, Missing) and (gap.state, gap.reason) == (
        "failed",
        "too few stretches; record longer",
    )


@pytest.mark.parametrize("name", LEARNED_FROM_THE_PLANT)
def test_a_plant_that_predicts_too_little_leaves_the_data_undecided(figures, name):
    figures["identify_plant"]["fit_holdout_ahead"]["zone_2"] = 30.0
    figures["identify_plant"]["fit_holdout_ahead_band"]["zone_2"] = [20.0, 40.0]
    gap = data(figures, name)
    assert isinstance(gap, Missing) and gap.state == OPEN
    assert gap.reason == "zone_2 is predicted with a fit of 30 % (limit 50 %)"
    assert "twice as long" in gap.remedy


def test_a_heater_that_cools_leaves_the_data_undecided(figures):
    wrong = {"output": "zone_1", "input": "heater_2", "gain": -1.0, "low": -2.0, "high": -0.5}
    wrong |= {"certain": True, "reason": "a heater that cools"}
    figures["identify_plant"]["forbidden_gains"] = [wrong]
    gap = data(figures, "pi")
    assert isinstance(gap, Missing) and gap.state == OPEN
    assert gap.reason == "heater_2 on zone_1 is a heater that cools"
    assert isinstance(data(figures, "varx_riccati"), Figure)
