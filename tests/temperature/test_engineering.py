"""What the tuning's candidates trade, and a history that keeps it beside the candidates."""

import numpy as np
import pytest

from pipeline.temperature import engineering, judging, plant, scorecard, tuning
from pipeline.temperature.published import GAMMA


def small():
    machine = plant.baam()
    scenarios = scorecard.panel(
        [machine],
        starts=[20.0],
        references=[np.full(5, 150.0)],
        noise=[0.0],
        seeds=[1],
        steps=60,
        hold=5,
        cells=True,
    )
    limits = (np.zeros(7), np.full(7, 100.0))
    return machine, scenarios, judging.Deployment(limits, band=1.0, integral=0.02, integral_limit=1.0)


def test_a_candidates_trade_is_that_of_its_run_and_a_fragile_one_fails():
    machine, scenarios, deployment = small()
    theta = np.append(np.ones(12), 1.0)
    run = engineering.deployed(machine, scenarios, deployment, gamma=GAMMA, least_disk_margin=0.0)
    error_effort = engineering.error_effort_of(run(theta))
    assert error_effort == engineering.ErrorEffort(
        float(run(theta).tracking_degC.mean()), float(run(theta).effort_percent.mean())
    )
    # weights that spare the heaters take less of them, and more error
    spared = engineering.error_effort_of(run(np.concatenate([np.full(5, 0.01), np.full(7, 10.0), [1.0]])))
    assert (
        spared.effort_percent < error_effort.effort_percent
        and spared.tracking_degC > error_effort.tracking_degC
    )
    fragile = engineering.deployed(machine, scenarios, deployment, gamma=GAMMA, least_disk_margin=1.9)
    with pytest.raises(ValueError, match="below the least of 1.90"):
        fragile(theta)
    assert engineering.value_or_none(fragile, theta) is None


def test_the_optimum_is_the_run_whose_cost_no_controller_undercuts():
    _, scenarios, deployment = small()
    yardstick = scorecard.Yardstick(np.ones(5), np.ones(7), GAMMA)
    best = scorecard.cost(scenarios, scorecard.optimum_run(scenarios, yardstick), yardstick)
    np.testing.assert_array_equal(best.J, scorecard.optimum(scenarios, yardstick).J)
    error_effort = engineering.optimum_error_effort(scenarios, yardstick, limits=deployment.limits, band=1.0)
    assert error_effort.tracking_degC > 0 and error_effort.effort_percent > 0


def test_a_history_has_each_candidates_trade_and_marks_the_chosen_one():
    theta = np.array([[1.0], [2.0], [3.0]])
    history = tuning.History(
        theta, np.array([5.0, np.nan, 4.0]), ("", "unstable", ""), np.array([5.0, 5.0, 4.0])
    )
    columns = engineering.histories(
        {"practical": tuning.Result(theta[2], 4.0, history)},
        {"practical": [engineering.ErrorEffort(1.0, 2.0), None, engineering.ErrorEffort(3.0, 4.0)]},
    )
    assert columns["evaluation"] == [1, 2, 3] and columns["chosen"].tolist() == [False, False, True]
    np.testing.assert_array_equal(columns["tracking_degC"], [1.0, np.nan, 3.0])
    np.testing.assert_array_equal(columns["effort_percent"], [2.0, np.nan, 4.0])
