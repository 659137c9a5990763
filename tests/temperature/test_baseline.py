"""The PI baseline: SIMC's settings by hand, a pairing that makes sense, and a loop that settles."""

import re

import numpy as np
import pytest

from pipeline.temperature.baseline import pairing, pi_law
from pipeline.temperature.plant import baam, plant, spread
from pipeline.temperature.published import REFERENCE
from pipeline.temperature.scorecard import feed_forward, figures, panel, simulate
from pipeline.temperature.tracking import feasible_target

LOW, HIGH = np.zeros(7), np.full(7, 100.0)


def test_simc_by_hand_on_an_integrator_with_dead_time():
    """y(t+1) = y(t) + 0.5 u(t-2): slope 0.5 from lag 3 on, so theta = 2 and, with
    tau_c = theta, K_c = 1 / (0.5 x 4) and T_i = 16."""
    A = np.array([[1.0, 0.5, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    pairs = pairing(
        plant(A, [[0.0], [0.0], [1.0]], [[1.0, 0.0, 0.0]]), np.zeros(1), np.full(1, 100.0), horizon=40
    )
    np.testing.assert_allclose([pairs.gain[0], pairs.reset[0]], [0.5, 16.0], rtol=1e-12)  # rounding


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


def test_the_law_is_the_pi_equation():
    pairs = pairing(baam(), LOW, HIGH, horizon=600)
    law = pi_law(pairs, inputs=7)
    y, r, xi = np.linspace(100, 120, 5), REFERENCE, np.linspace(-1, 1, 5)
    u = -law.D @ y - law.K_r @ (r + xi) - law.k
    expected = np.zeros(7)
    expected[pairs.inputs] = pairs.gain * (r + xi - y)
    np.testing.assert_allclose(u, expected, atol=1e-12)  # rounding at 100 percent
    assert law.integral == pytest.approx(1 / pairs.reset.max())


def test_the_baseline_settles_on_every_plant_of_the_spread():
    plants = spread(baam(), input_gain=0.15, extra_heat_loss=0.005)
    scenarios = panel(
        plants, starts=[20.0], references=[REFERENCE], noise=[0.0], seeds=[0], steps=600, hold=0, cells=True
    )
    law, target = (
        pi_law(pairing(baam(), LOW, HIGH, horizon=600), inputs=7),
        feasible_target(baam(), REFERENCE, LOW, HIGH),
    )
    run = simulate(
        scenarios,
        law,
        feed_forward(scenarios, law, {REFERENCE.tobytes(): (target.u, target.y)}),
        limits=(LOW, HIGH),
        integral_band=1.0,
    )
    results = figures(scenarios, run, limits=(LOW, HIGH), band=1.0, sample_time_s=1.0)
    assert results.settled_error_degC.max() < 1.0
    assert not np.isnan(results.settling_s).any()


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
