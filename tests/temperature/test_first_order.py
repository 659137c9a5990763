import numpy as np
import pytest

from pipeline.temperature.first_order import fit_record, fit_steps, of_step_responses, response, simc_pid


def test_response_to_a_step_is_the_textbook_one_also_for_a_fraction_of_a_sample_of_delay():
    u = np.r_[0.0, np.ones(40)]
    y = response(u, time_constant_s=5.0, delay_s=2.3, sample_time_s=1.0)
    t = np.arange(41.0) - 1.0 - 2.3
    # exact discretisation: rounding only
    np.testing.assert_allclose(y, np.where(t > 0, 1 - np.exp(-t / 5.0), 0.0), atol=1e-12)


def test_a_noise_free_record_gives_its_own_constants_back():
    u = np.repeat([0.0, 2.0, -1.0, 3.0], 60)
    y = 7.0 + 1.5 * (response(u, 8.0, 3.4, 0.5))
    model = fit_record([u], [y], sample_time_s=0.5)
    # limited by the finite differences of the search, not by the data
    np.testing.assert_allclose(
        [model.gain, model.time_constant_s, model.delay_s, model.offset], [1.5, 8.0, 3.4, 7.0], rtol=1e-4
    )


def test_true_constants_lie_within_four_deviations_under_noise():
    u = np.tile(np.repeat([0.0, 10.0], 80), 4)
    y = 20.0 + 0.8 * response(u, 12.0, 4.0, 1.0) + 0.3 * np.random.default_rng(5).standard_normal(len(u))
    model = fit_record([u], [y], sample_time_s=1.0)
    z = (
        np.abs(np.subtract([0.8, 12.0, 4.0], [model.gain, model.time_constant_s, model.delay_s]))
        / model.deviations
    )
    assert (z < 4).all()  # four deviations: one in 5,000 by chance


def test_masked_samples_do_not_move_the_fit():
    u = np.repeat([0.0, 2.0, -1.0], 60)
    y = 1.5 * response(u, 8.0, 2.0, 1.0)
    y[50:55], y[100] = 1e6, -1e6
    y[50:55], y[100] = np.nan, np.nan
    model = fit_record([u], [y], sample_time_s=1.0)
    np.testing.assert_allclose([model.gain, model.time_constant_s], [1.5, 8.0], rtol=1e-4)


def test_two_segments_share_one_model_and_have_their_own_start():
    u = [np.repeat([0.0, 1.0], 50), np.repeat([1.0, 0.0], 50)]
    y = [
        2.0 * response(u[0], 6.0, 1.0, 1.0),
        2.0 + 2.0 * response(u[1], 6.0, 1.0, 1.0) + 3.0 * np.exp(-np.arange(100) / 6.0),
    ]
    model = fit_record(u, y, sample_time_s=1.0)
    np.testing.assert_allclose([model.gain, model.time_constant_s, model.delay_s], [2.0, 6.0, 1.0], rtol=1e-4)


def test_up_and_downward_steps_are_told_apart():
    u = np.repeat([0.0, 1.0, 0.0], 100)
    up = response(u[:200], 5.0, 2.0, 1.0)
    y = np.r_[up, up[-1] + response(np.repeat([1.0, 0.0], 100), 15.0, 2.0, 1.0)[100:]]
    first, second = fit_steps(u, y, sample_time_s=1.0)
    assert (first.step, second.step) == (1.0, -1.0)
    np.testing.assert_allclose(
        [first.model.time_constant_s, second.model.time_constant_s], [5.0, 15.0], rtol=1e-3
    )


def test_a_step_counts_only_as_long_as_the_other_inputs_stand_still():
    u, other = np.repeat([0.0, 1.0], 100), np.repeat([0.0, 2.0], [150, 50])
    y = response(u, 5.0, 2.0, 1.0) + 3.0 * response(other, 5.0, 2.0, 1.0)
    (step,) = fit_steps(u, y, sample_time_s=1.0, others=other[:, None])
    np.testing.assert_allclose([step.model.gain, step.model.time_constant_s], [1.0, 5.0], rtol=1e-3)
    # blind to the other input, its effect is taken for u's
    assert abs(fit_steps(u, y, sample_time_s=1.0)[0].model.gain - 1.0) > 1.0


def test_each_step_of_the_two_heater_kit_says_what_its_hold_can_say(shared):
    record = np.genfromtxt(
        shared("data/tclab_apmonitor/energy_balance_mimo.csv"), delimiter=",", skip_header=1
    )
    u, y = record[:, 1:3], record[:, 3:5]
    steps = fit_steps(u[:, 1], y[:, 1], sample_time_s=1.0, others=u[:, :1])
    assert [step.step for step in steps] == [50.0, 30.0, -70.0]
    assert all(step.model.fit_percent > 88 for step in steps)
    gains, deviations = (
        [value(step.model) for step in steps]
        for value in (lambda model: model.gain, lambda model: model.deviations[0])
    )
    # holds of 100 s against time constants of 150 to 350 s: the gains agree, 0.23 to 0.29 °C per percent,
    # within three of their wide deviations
    assert all(abs(gain - 0.27) < 3 * deviation for gain, deviation in zip(gains, deviations, strict=True))


def test_an_input_that_never_moves_is_refused_with_its_remedy():
    with pytest.raises(ValueError, match="never moves, so its gain is not identified; record a step"):
        fit_record([np.ones(50)], [np.arange(50.0)], sample_time_s=1.0)


def test_a_record_that_is_too_short_says_how_many_samples_are_missing():
    with pytest.raises(ValueError, match="record 4 samples more"):
        fit_record([np.arange(6.0)], [np.arange(6.0)], sample_time_s=1.0)


def test_steps_held_too_briefly_are_refused():
    with pytest.raises(ValueError, match="no step of the input is held for 20 samples"):
        fit_steps(np.tile([0.0, 1.0], 30), np.arange(60.0), sample_time_s=1.0)


def test_step_responses_of_first_order_with_delay_give_their_constants_back():
    t = np.arange(1, 600)
    expected = [(2.0, 40.0, 5.0), (-0.3, 100.0, 0.0)]
    responses = np.column_stack(
        [K * (1 - np.exp(-np.maximum(t - theta, 0) / tau)) for K, tau, theta in expected]
    )
    models = of_step_responses(t, responses)
    # the grid's ratios are a tenth
    np.testing.assert_allclose(models.gain, [2.0, -0.3], rtol=0.03)
    np.testing.assert_allclose(models.time_constant, [40.0, 100.0], rtol=0.1)
    np.testing.assert_allclose(models.delay, [5.0, 0.0], atol=3.0)
    assert (models.fit_percent > 95).all()


def test_simc_by_hand():
    pid = simc_pid(2.0, 40.0, 5.5, sample_time_s=1.0)
    # theta 6, K_c = 40 / (2 x 12) = 1.667, tau_I = min(40, 48), tau_D = 2
    assert pid.Kp == pytest.approx(40 / 24 * (1 + 2 / 40))
    assert pid.Ki == pytest.approx(40 / 24 / 40)
    assert pid.Kd == pytest.approx(40 / 24 * 2)


def test_simc_holds_a_first_order_plant_without_much_overshoot():
    K, tau, delay = 2.0, 60.0, 4
    pid, x, integral, last = simc_pid(K, tau, delay, sample_time_s=1.0), 0.0, 0.0, None
    u, y = [0.0] * (delay + 1), []
    for _ in range(400):
        y.append(x)
        e = 1.0 - x
        integral += pid.Ki * e
        u.append(pid.Kp * e + integral - pid.Kd * (0.0 if last is None else x - last))
        last = x
        x += (K * u[-1 - delay] - x) / tau
    assert abs(y[-1] - 1) < 1e-3
    assert max(y) < 1.3  # SIMC promises some quarter at tau_c = theta
