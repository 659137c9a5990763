import numpy as np
import pytest

from pipeline.temperature.identification.validation import (
    dynamics_rows,
    excitation,
    fit_figures,
    fit_of_held_inputs,
    fit_with_band,
    held,
    holdout,
    holdout_rows,
    horizon,
    input_levels,
    level_rows,
    outcome_figures,
    pole_rows,
    residual_lags,
    residual_rows,
    residual_tests,
    step_response,
    step_rows,
    steps,
    two_points,
)
from pipeline.temperature.plant import plant, simulate
from tests.temperature.fits import nrmse, predict_fit, simulate_fit
from tests.temperature.test_validation import HEATER, innovations_record


def first_order(gain, tau, delay=0):
    """y of gain / (tau s + 1), zero-order hold, after `delay` samples; tau in samples."""
    a = np.exp(-1 / tau)
    A, B, C = np.zeros((delay + 1, delay + 1)), np.zeros((delay + 1, 1)), np.zeros((1, delay + 1))
    A[0, 0], C[0, 0] = a, 1.0
    if delay == 0:
        B[0] = gain * (1 - a)
    else:
        A[0, delay], B[1] = gain * (1 - a), 1.0
        A[2:, 1:-1] = np.eye(delay - 1)
    return plant(A, B, C)


# ---- what a prediction must beat


def test_the_last_value_seen_is_held_over_a_gap_and_nothing_is_known_before_there_is_one():
    y = np.array([[1.0], [2.0], [np.nan], [4.0], [5.0]])
    np.testing.assert_array_equal(held(y, 2), [[np.nan], [np.nan], [1.0], [2.0], [2.0]])
    assert np.isnan(held(y, 9)).all()


def test_fits_are_those_of_validation_and_lie_in_their_bands():
    u, y = innovations_record(HEATER, 900, 0.1, 3)
    y[200:210] = np.nan
    us, ys = [u[:500], u[500:]], [y[:500], y[500:]]
    judged = holdout(HEATER, us, ys, 7, block=20, rng=np.random.default_rng(0))
    np.testing.assert_allclose(judged.fits["fit_holdout"][0], simulate_fit(HEATER, us, ys), rtol=1e-12)
    np.testing.assert_allclose(
        judged.fits["fit_holdout_ahead"][0], predict_fit(HEATER, us, ys, 7), rtol=1e-12
    )
    for part in (judged.fits["fit_holdout"], judged.fits["fit_holdout_ahead"]):
        assert (part[1] < part[0]).all() and (part[0] < part[2]).all()
    # the start-up of predict_fit: 30 samples and the steps, in each segment
    assert np.flatnonzero(np.isfinite(judged.ahead[0][:, 0]))[0] == 37
    last = [np.where(np.isfinite(judged.ahead[k]), held(ys[k], 7), np.nan) for k in range(2)]
    np.testing.assert_allclose(
        judged.fits["fit_holdout_held"][0],
        nrmse(np.vstack([b[37:] for b in ys]), np.vstack([b[37:] for b in last])),
        rtol=1e-12,
    )


def test_a_free_mean_moves_the_simulation_that_is_shown_and_draws_no_ramp():
    t = np.arange(200.0)
    slow = plant([[0.999]], [[0.001]], [[1.0]])
    u = np.zeros((200, 1))
    y = (3.0 - 0.02 * t)[:, None] + 0.02 * np.random.default_rng(0).standard_normal((200, 1))
    judged = holdout(slow, [u], [y], 7, block=20, rng=np.random.default_rng(0))
    moved = judged.simulated[0] + (y - judged.simulated[0]).mean(axis=0)
    np.testing.assert_allclose(judged.fits["fit_holdout_free_mean"][0], nrmse(y, moved), rtol=1e-12)
    # a state fitted beside a constant drew the ramp of 4 °C with a fit of 90 %
    assert judged.fits["fit_holdout_free_mean"][0, 0] < 20


def test_where_inputs_stand_still_the_fit_is_that_of_held_inputs_and_elsewhere_it_is_not():
    u, y = innovations_record(HEATER, 600, 0.05, 3)
    still = np.repeat(u[::100], 100, axis=0)
    x = [simulate(HEATER, part, np.array([5.0, -3.0]))[1] for part in np.split(still, 6)]
    judged = holdout(HEATER, np.split(still, 6), x, 7, block=20, rng=np.random.default_rng(0))
    # both are the same simulation: rounding
    np.testing.assert_allclose(
        fit_of_held_inputs(HEATER, np.split(still, 6), x), judged.fits["fit_holdout"][0], atol=1e-6
    )
    assert fit_of_held_inputs(HEATER, [u[200:]], [y[200:]])[0] < 30


def test_the_band_of_a_fit_holds_the_fit_of_another_hold_out_of_that_length_nine_times_in_ten():
    rng, inside = np.random.default_rng(1), 0
    long = rng.standard_normal((200_000, 1))
    truth = fit_with_band([long], [long + 0.3 * rng.standard_normal(long.shape)], block=10, rng=rng, draws=2)[
        0, 0
    ]
    for _ in range(100):
        y = rng.standard_normal((400, 1))
        _, low, high = fit_with_band([y], [y + 0.3 * rng.standard_normal(y.shape)], block=10, rng=rng)[:, 0]
        inside += low <= truth <= high
    # binomial of 0.9 over 100: 99.9 % lie in 80 to 98
    assert 80 <= inside <= 98


def test_a_hold_out_without_a_segment_long_enough_has_no_fit_ahead_and_is_written_as_none():
    u, y = innovations_record(HEATER, 60, 0.1, 3)
    judged = holdout(HEATER, [u], [y], 60, block=20, rng=np.random.default_rng(0))
    figures = fit_figures(judged, ["T1"])
    assert figures["fit_holdout"]["T1"] == judged.fits["fit_holdout"][0, 0]
    assert (
        figures["fit_holdout_ahead"] is None
        and figures["fit_holdout_ahead_band"] is None
        and figures["fit_holdout_held"] is None
    )


def test_as_many_lags_as_the_hold_out_carries():
    assert residual_lags([np.zeros((1000, 1))]) == 25
    u, y = innovations_record(HEATER, 60, 0.1, 3)
    assert residual_lags([u]) == 15
    residual_tests(HEATER, [u], [y], lags=15)


# ---- step responses


def test_time_constant_and_delay_of_a_first_order_plant_with_delay_are_read_off_its_response():
    response = step_response(first_order(2.0, 40.0, delay=6), 600)
    tau, delay = two_points(response)
    # straight lines between samples of an exponential: an error of some hundredths of a sample
    np.testing.assert_allclose([tau[0, 0], delay[0, 0]], [40.0, 6.0], atol=0.1)


def test_a_response_downward_has_the_same_times_as_one_upward_and_none_has_none():
    response = step_response(first_order(2.0, 40.0), 600)
    np.testing.assert_array_equal(two_points(-response), two_points(response))
    assert np.isfinite(two_points(0 * response)).all()


def test_the_horizon_ends_when_all_responses_have_settled():
    # within 5 % after 3 time constants, and a third more
    assert horizon(first_order(2.0, 40.0), 5000) == pytest.approx(160, abs=2)
    assert horizon(first_order(2.0, 40.0), 100) == 100


def test_a_mode_slower_than_the_record_is_followed_over_a_tenth_of_it():
    assert horizon(first_order(2.0, 6000.0), 5000) == 500
    assert horizon(first_order(2.0, 4000.0), 5000) == 5000


def test_of_an_unstable_plant_three_time_constants_are_shown():
    assert horizon(plant([[1.01]], [[1.0]], [[1.0]]), 5000) <= int(np.ceil(3 / np.log(1.01)))


def test_steps_hold_the_truth_and_say_where_the_sign_is_not_known():
    nominal = plant(np.diag([0.95, 0.9]), np.diag([1.0, 0.01]), [[1.0, 1.0]])
    family = [nominal._replace(B=np.diag([b, 0.01 * c])) for b, c in ((0.9, 2.0), (1.0, -1.0), (1.1, -2.0))]
    responses = steps(nominal, family, 500)
    assert responses.significant.tolist() == [[True, False]]
    # 1 / (1 - 0.95) = 20, less what is left after 1.33 settling times
    np.testing.assert_allclose(responses.gain[0, 0, 0], 20.0, rtol=0.03)
    assert (responses.low[1:, 0, 0] < responses.response[1:, 0, 0]).all() and (
        responses.response[1:, 0, 0] < responses.high[1:, 0, 0]
    ).all()
    # -1 / ln 0.95 = 19.5
    np.testing.assert_allclose(responses.time_constant[0, 0, 0], 19.5, rtol=0.05)
    assert np.isnan(responses.time_constant[:, 0, 1]).all() and np.isnan(responses.delay[:, 0, 1]).all()


def test_a_gain_is_where_the_response_settles_and_of_an_integrator_to_the_record_where_it_ends():
    slow = plant([[0.9, 0.0], [0.0, 0.999]], [[0.1], [0.0001]], [[1.0, 1.0]])
    others = [slow._replace(B=scale * slow.B) for scale in np.linspace(0.9, 1.1, 21)]
    settled = steps(slow, others, 2000).gain[:, 0, 0]
    assert settled[0] == pytest.approx(1.1, abs=1e-9)  # 0.1 / (1 - 0.9) + 0.0001 / (1 - 0.999)
    assert settled[1:] == pytest.approx([0.91 * 1.1, 1.09 * 1.1], abs=1e-9)
    short = steps(slow, others, 500)
    assert short.gain[0, 0, 0] == step_response(slow, short.samples[-1] + 1)[-1, 0, 0] < 1.06


def test_a_response_that_turns_back_has_its_peak_beside_its_end():
    # fast up, slow back: 10 (0.9) against -8 (0.98) of the same input
    responses = steps(
        plant(np.diag([0.9, 0.98]), [[1.0], [-0.16]], [[1.0, 1.0]]), [first_order(1.0, 5.0)], 2000
    )
    assert responses.peak[0, 0, 0] > 1.5 * responses.gain[0, 0, 0] > 0


# ---- as tables


def test_poles_of_the_spread_are_assigned_to_the_nearest_of_the_model_and_the_rest_to_none():
    nominal, member = (
        plant(np.diag([0.9, 0.5]), np.ones((2, 1)), np.ones((1, 2))),
        plant(np.diag([0.1, 0.52, 0.88]), np.ones((3, 1)), np.ones((1, 3))),
    )
    rows = pole_rows(nominal, [member])
    assert rows["real"][:2].tolist() == [0.9, 0.5] and rows["member"].tolist() == [0, 0, 1, 1, 1]
    assert {round(x, 2): int(k) for x, k in zip(rows["real"][2:], rows["pole"][2:], strict=True)} == {
        0.1: -1,
        0.52: 1,
        0.88: 0,
    }


def test_the_level_of_a_sine_lies_in_its_band_and_all_bands_together_have_its_power():
    t = np.arange(4000.0)
    levels = input_levels([3.0 * np.sin(1.0 * t)[:2000, None] + 50, 3.0 * np.sin(1.0 * t)[:, None] + 50])
    # 1 rad a sample is in the third of eight bands; some leaks beside it
    assert levels[:, 0].argmax() == 2
    np.testing.assert_allclose(np.sqrt((levels**2).sum()), 3 / np.sqrt(2), rtol=0.01)
    rows = level_rows(levels, ["heater"])
    assert rows["level"].tolist() == levels[:, 0].tolist() and rows["high_rad"][-1] == np.pi


def test_tables_name_each_pair_and_keep_their_values():
    u, y = innovations_record(HEATER, 600, 0.1, 5)
    tests, excited = residual_tests(HEATER, [u], [y], lags=4), excitation([u], 3)
    rows = residual_rows(tests, ["T1"], ["a", "b"])
    assert len(rows["lag"]) == 5 + 2 * 9
    at = rows["against"].index("b")
    assert (rows["lag"][at], rows["correlation"][at]) == (-4, tests.cross_correlation[0, 1, 0])
    figures = outcome_figures(tests, excited, ["T1"], ["a", "b"])
    assert figures["independence_passed"]["T1"] == {"a": True, "b": True}
    assert figures["excitation"]["inputs"]["b"]["rank"] == 3 and figures["excitation"]["lags"] == 3
    responses = steps(HEATER, [HEATER, HEATER], 300)
    rows, summary = (
        step_rows(responses, ["T1"], ["a", "b"], 2.0),
        dynamics_rows(responses, ["T1"], ["a", "b"], 2.0),
    )
    np.testing.assert_array_equal(rows["response"][len(responses.samples) :], responses.response[:, 0, 1])
    assert rows["time_s"][1] == 2.0 * responses.samples[1] and summary["input"] == ["a", "b"]
    np.testing.assert_array_equal(summary["time_constant_s"], 2.0 * responses.time_constant[0, 0])
    judged = holdout(HEATER, [u], [y], 5, block=20, rng=np.random.default_rng(0))
    columns = holdout_rows([y], judged, ["T1"], 2.0)
    np.testing.assert_array_equal(columns["T1_simulated"], judged.simulated[0][:, 0])
    assert columns["time_s"][-1] == 2.0 * 599


def test_a_condition_beyond_all_numbers_is_written_as_none():
    u, y = innovations_record(HEATER, 200, 0.1, 5)
    excited = excitation([u], 3)._replace(condition=np.inf)
    assert (
        outcome_figures(residual_tests(HEATER, [u], [y], lags=3), excited, ["T1"], ["a", "b"])["excitation"][
            "condition"
        ]
        is None
    )
