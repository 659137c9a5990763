"""The PI baseline: SIMC's settings by hand, a pairing that makes sense, signs that are certain, and a loop
that settles."""

import re

import numpy as np
import pytest

from pipeline.papers.published import REFERENCE
from pipeline.temperature.controllers.baseline import NOISE_SHARE, pairing, pi_law
from pipeline.temperature.plant import baam, plant

LOW, HIGH = np.zeros(7), np.full(7, 100.0)


def first_order(gain: float, time_constant: float, delay: int):
    """gain / (time_constant s + 1), held inputs late by `delay` samples more."""
    a = np.exp(-1 / time_constant)
    A = np.diag(np.r_[a, np.zeros(delay)])
    A[np.arange(delay), np.arange(1, delay + 1)] = np.r_[gain * (1 - a), np.ones(delay - 1)][:delay]
    B = np.zeros((delay + 1, 1))
    B[-1] = 1.0 if delay else gain * (1 - a)
    return plant(A, B, np.eye(1, delay + 1))


def test_simc_by_hand_on_an_integrator_with_dead_time():
    """y(t+1) = y(t) + 0.5 u(t-2): slope 0.5 and dead time 2, half a sample more as u is held: theta = 2.5
    and, with tau_c = theta, K_c = 1 / (0.5 x 5) and T_i = 20."""
    A = np.array([[1.0, 0.5, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    pairs = pairing(
        plant(A, [[0.0], [0.0], [1.0]], [[1.0, 0.0, 0.0]]), np.zeros(1), np.full(1, 100.0), horizon=40
    )
    assert np.isinf(pairs.time_constant[0])
    np.testing.assert_allclose([pairs.gain[0], pairs.reset[0]], [0.4, 20.0], rtol=1e-12)  # rounding


def test_simc_by_hand_on_a_first_order_lag_with_dead_time():
    """k = 2, tau = 20, dead time 3: theta = 3.5, K_c = 20 / (2 x 7), T_i = min(20, 28)."""
    pairs = pairing(first_order(2.0, 20.0, 3), np.zeros(1), np.full(1, 100.0), horizon=200)
    # the grid of the fit is that fine
    np.testing.assert_allclose([pairs.gain[0], pairs.reset[0]], [20 / 14, 20.0], rtol=0.02)
    np.testing.assert_allclose([pairs.time_constant[0], pairs.delay[0]], [20.0, 3.0], rtol=0.02)


def test_a_search_may_tune_the_gain_and_the_reset_time_of_each_zone():
    machine = plant(np.diag([0.95, 0.9]), np.diag([0.1, 0.2]), np.eye(2))
    limits = np.zeros(2), np.full(2, 100.0)
    simc = pairing(machine, *limits, horizon=200)
    tuned = pairing(machine, *limits, horizon=200, gain_factor=np.array([2.0, 0.5]), reset_factor=3.0)
    np.testing.assert_allclose(tuned.gain, simc.gain * [2.0, 0.5])
    np.testing.assert_allclose(tuned.reset, 3 * simc.reset)


def test_the_first_samples_of_an_identified_response_do_not_decide():
    """A ripple that takes the first samples below zero and dies within twenty; sign, gain and reset time stay
    near those without it."""
    steady = plant([[0.99]], [[0.02]], [[1.0]])
    rippled = plant(np.diag([0.99, -0.75]), [[0.02], [-0.1]], [[1.0, 1.0]])
    limits = np.zeros(1), np.full(1, 100.0)
    one, other = (pairing(machine, *limits, horizon=600) for machine in (steady, rippled))
    assert other.gain[0] > 0
    # the ripple's mean is -0.06 of a peak of 2: as late as three samples at a slope of 0.02
    np.testing.assert_allclose(1 / other.gain, 1 / one.gain, atol=2 * 3.5 * 0.02)
    np.testing.assert_allclose(other.slope, one.slope, rtol=0.1)


def test_a_slow_machine_is_followed_as_long_as_it_rises():
    """tau of 400 samples and a horizon of 300: a fit to what has hardly risen would give another tau."""
    pairs = pairing(first_order(2.0, 400.0, 5), np.zeros(1), np.full(1, 100.0), horizon=300)
    np.testing.assert_allclose(pairs.slope * pairs.time_constant, 2.0, rtol=0.03)  # the fit's grid


def test_a_sign_that_the_family_does_not_know_is_refused_in_one_sentence():
    limits = np.zeros(1), np.full(1, 100.0)
    machine = first_order(0.5, 20.0, 2)
    family = [first_order(gain, 20.0, 2) for gain in np.linspace(-0.4, 1.4, 20)]
    with pytest.raises(ValueError, match="the sign of the effect of input 1 on output 1 is not certain"):
        pairing(machine, *limits, horizon=200, family=family)
    sure = [first_order(gain, 20.0, 2) for gain in np.linspace(0.1, 0.9, 20)]
    assert pairing(machine, *limits, horizon=200, family=sure).gain[0] > 0


def test_an_input_of_uncertain_sign_is_left_for_a_weaker_one_that_is_certain():
    def machine(stronger):
        return plant([[0.95]], [[stronger, 0.1]], [[1.0]])

    limits = np.zeros(2), np.full(2, 100.0)
    assert pairing(machine(0.3), *limits, horizon=200).inputs[0] == 0
    family = [machine(gain) for gain in np.linspace(-0.2, 0.8, 20)]
    assert pairing(machine(0.3), *limits, horizon=200, family=family).inputs[0] == 1


def test_a_noisy_sensor_gets_a_slower_loop():
    """A model without dead time asks for K_c = 1 / (2 slope); 0.1 °C of noise may move the input by 2 % of
    its range and no more."""
    machine, limits = plant([[0.993]], [[0.002]], [[1.0]]), (np.zeros(1), np.full(1, 100.0))
    sharp = pairing(machine, *limits, horizon=600)
    quiet = pairing(machine, *limits, horizon=600, noise_degC=np.array([0.1]))
    assert sharp.gain[0] > 200
    np.testing.assert_allclose(quiet.gain[0] * 0.1, NOISE_SHARE * 100)
    assert quiet.reset[0] > sharp.reset[0]


def test_units_of_the_outputs_change_no_pair():
    machine = plant(np.eye(2) * 0.95, [[1.0, 0.9], [0.8, 0.1]], np.eye(2))
    limits = np.zeros(2), np.full(2, 100.0)
    for scale in (1e-3, 1.0, 1e3):
        scaled = machine._replace(C=np.diag([1.0, scale]) @ machine.C)
        np.testing.assert_array_equal(pairing(scaled, *limits, horizon=200).inputs, [1, 0])


def test_a_cooling_input_gets_a_negative_gain():
    pairs = pairing(plant([[1.0]], [[-0.5]], [[1.0]]), np.zeros(1), np.ones(1), horizon=10)
    assert pairs.gain[0] == pytest.approx(-1.0)  # theta at its least, one sample


def test_each_output_gets_the_input_whose_range_moves_it_fastest():
    machine = plant(np.eye(2), [[1.0, 0.2, 0.0], [0.1, 1.0, 5.0]], np.eye(2))
    np.testing.assert_array_equal(
        pairing(machine, np.zeros(3), np.array([100.0, 100, 100]), horizon=5).inputs, [0, 2]
    )
    np.testing.assert_array_equal(
        pairing(machine, np.zeros(3), np.array([100.0, 100, 10]), horizon=5).inputs, [0, 1]
    )


def test_the_study_s_sensors_are_paired_with_heaters():
    inputs = pairing(baam(), LOW, HIGH, horizon=600).inputs
    assert len(set(inputs)) == 5
    assert 6 not in inputs  # the motor
    np.testing.assert_array_equal(inputs[:3], [0, 1, 2])


def test_the_study_s_settings_do_not_hang_on_how_long_its_responses_are_followed():
    """Its responses turn back after some hundred samples; followed for 1,500, zone 2 once got a gain of the
    wrong sign."""
    short, long = (pairing(baam(), LOW, HIGH, horizon=horizon) for horizon in (600, 1500))
    np.testing.assert_array_equal(short.inputs, long.inputs)
    # a first-order lag fitted to 60 and to 150 samples of what is none
    np.testing.assert_allclose(short.gain, long.gain, rtol=0.05)


def test_the_law_is_the_pi_equation():
    pairs = pairing(baam(), LOW, HIGH, horizon=600)
    law = pi_law(pairs, inputs=7)
    y, r, xi = np.linspace(100, 120, 5), REFERENCE, np.linspace(-1, 1, 5)
    u = -law.D @ y - law.K_r @ (r + xi) - law.k
    expected = np.zeros(7)
    expected[pairs.inputs] = pairs.gain * (r + xi - y)
    np.testing.assert_allclose(u, expected, atol=1e-12)  # rounding at 100 percent
    np.testing.assert_allclose(law.integral, 1 / pairs.reset)  # each zone its own


def test_an_output_that_no_free_input_moves_is_refused():
    sentence = "PI needs an input for each of the 2 outputs; found "
    for B, reason in (
        ([[1.0], [1.0]], "1 inputs"),
        ([[1.0, 1.0], [0.0, 0.0]], "an output that none of the free inputs moves"),
    ):
        with pytest.raises(ValueError, match=re.escape(sentence + reason)):
            pairing(
                plant(np.diag([0.9, 0.9]), B, np.eye(2)), np.zeros(len(B[0])), np.ones(len(B[0])), horizon=5
            )
