import numpy as np
import pytest

from pipeline.first_order import fit_record, fit_steps, response


def test_response_to_a_step_is_the_textbook_one_also_for_a_fraction_of_a_sample_of_delay():
    u = np.r_[0.0, np.ones(40)]
    y = response(u, time_constant_s=5.0, delay_s=2.3, sample_time_s=1.0)
    t = np.arange(41.0) - 1.0 - 2.3
    np.testing.assert_allclose(y, np.where(t > 0, 1 - np.exp(-t / 5.0), 0.0), atol=1e-12)  # exact discretisation: rounding only


def test_a_noise_free_record_gives_its_own_constants_back():
    u = np.repeat([0.0, 2.0, -1.0, 3.0], 60)
    y = 7.0 + 1.5 * (response(u, 8.0, 3.4, 0.5))
    model = fit_record([u], [y], sample_time_s=0.5)
    # limited by the finite differences of the search, not by the data
    np.testing.assert_allclose([model.gain, model.time_constant_s, model.delay_s, model.offset], [1.5, 8.0, 3.4, 7.0], rtol=1e-4)


def test_true_constants_lie_within_four_deviations_under_noise():
    u = np.tile(np.repeat([0.0, 10.0], 80), 4)
    y = 20.0 + 0.8 * response(u, 12.0, 4.0, 1.0) + 0.3 * np.random.default_rng(5).standard_normal(len(u))
    model = fit_record([u], [y], sample_time_s=1.0)
    z = np.abs(np.subtract([0.8, 12.0, 4.0], [model.gain, model.time_constant_s, model.delay_s])) / model.deviations
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
    y = [2.0 * response(u[0], 6.0, 1.0, 1.0), 2.0 + 2.0 * response(u[1], 6.0, 1.0, 1.0) + 3.0 * np.exp(-np.arange(100) / 6.0)]
    model = fit_record(u, y, sample_time_s=1.0)
    np.testing.assert_allclose([model.gain, model.time_constant_s, model.delay_s], [2.0, 6.0, 1.0], rtol=1e-4)


def test_up_and_downward_steps_are_told_apart():
    u = np.repeat([0.0, 1.0, 0.0], 100)
    up = response(u[:200], 5.0, 2.0, 1.0)
    y = np.r_[up, up[-1] + response(np.repeat([1.0, 0.0], 100), 15.0, 2.0, 1.0)[100:]]
    first, second = fit_steps(u, y, sample_time_s=1.0)
    assert (first.step, second.step) == (1.0, -1.0)
    np.testing.assert_allclose([first.model.time_constant_s, second.model.time_constant_s], [5.0, 15.0], rtol=1e-3)


def test_an_input_that_never_moves_is_refused_with_its_remedy():
    with pytest.raises(ValueError, match="never moves, so its gain is not identified; record a step"):
        fit_record([np.ones(50)], [np.arange(50.0)], sample_time_s=1.0)


def test_a_record_that_is_too_short_says_how_many_samples_are_missing():
    with pytest.raises(ValueError, match="record 4 samples more"):
        fit_record([np.arange(6.0)], [np.arange(6.0)], sample_time_s=1.0)


def test_steps_held_too_briefly_are_refused():
    with pytest.raises(ValueError, match="no step of the input is held for 20 samples"):
        fit_steps(np.tile([0.0, 1.0], 30), np.arange(60.0), sample_time_s=1.0)
