import numpy as np
import pytest

from pipeline.temperature.identification.first_order import of_step_responses, response, simc_pid


def test_response_to_a_step_is_the_textbook_one_also_for_a_fraction_of_a_sample_of_delay():
    u = np.r_[0.0, np.ones(40)]
    y = response(u, time_constant_s=5.0, delay_s=2.3, sample_time_s=1.0)
    t = np.arange(41.0) - 1.0 - 2.3
    # exact discretisation: rounding only
    np.testing.assert_allclose(y, np.where(t > 0, 1 - np.exp(-t / 5.0), 0.0), atol=1e-12)


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
    Kp, Ki, Kd = simc_pid(2.0, 40.0, 5.5, sample_time_s=1.0)
    # theta 6, K_c = 40 / (2 x 12) = 1.667, tau_I = min(40, 48), tau_D = 2
    assert Kp == pytest.approx(40 / 24 * (1 + 2 / 40))
    assert Ki == pytest.approx(40 / 24 / 40)
    assert Kd == pytest.approx(40 / 24 * 2)


def test_simc_holds_a_first_order_plant_without_much_overshoot():
    K, tau, delay = 2.0, 60.0, 4
    Kp, Ki, Kd = simc_pid(K, tau, delay, sample_time_s=1.0)
    x, integral, last = 0.0, 0.0, None
    u, y = [0.0] * (delay + 1), []
    for _ in range(400):
        y.append(x)
        e = 1.0 - x
        integral += Ki * e
        u.append(Kp * e + integral - Kd * (0.0 if last is None else x - last))
        last = x
        x += (K * u[-1 - delay] - x) / tau
    assert abs(y[-1] - 1) < 1e-3
    assert max(y) < 1.3  # SIMC promises some quarter at tau_c = theta
