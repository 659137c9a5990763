import numpy as np
import pytest

from pipeline.temperature.identification.model_choice import Settings, identify
from pipeline.temperature.identification.refinement import drives, estimate_state, prediction_form
from pipeline.temperature.identification.validation import (
    advice,
    bootstrap_spread,
    excitation,
    left_out_plants,
    predicted_ahead,
    residual_tests,
    simulated,
    spread_bands,
    step_response,
)
from pipeline.temperature.plant import plant, simulate
from tests.temperature.fits import nrmse, predict_fit, simulate_fit


def innovations_record(true, T, noise, seed):
    rng = np.random.default_rng(seed)
    u = rng.integers(0, 2, (T, true.m)).astype(float)
    x, y = np.zeros(true.n), np.empty((T, true.p))
    for t in range(T):
        e = noise * rng.standard_normal(true.p)
        y[t] = true.C @ x + true.D @ u[t] + true.d + e
        x = true.A @ x + true.B @ u[t] + true.b + true.K @ e
    return u, y


HEATER = plant(
    [[0.9, 0.1], [0.0, 0.6]], [[0.0, 0.2], [0.5, 0.0]], [[1.0, 0.0]], b=[0.5, 0.0], d=[20.0], K=[[0.3], [0.0]]
)


def test_nrmse_by_hand():
    y = np.array([[0.0], [1.0], [2.0], [np.nan]])
    # |y - mean| = sqrt 2; errors 0, 0, 1 and one masked
    np.testing.assert_allclose(
        nrmse(y, np.array([[0.0], [1.0], [1.0], [9.0]])), 100 * (1 - 1 / np.sqrt(2)), rtol=1e-12
    )


def test_a_constant_error_costs_nothing_where_means_are_removed():
    y = np.arange(10.0)[:, None]
    np.testing.assert_allclose(nrmse(y, y + 5.0, means_removed=True), 100.0, rtol=1e-12)


def test_the_true_plant_simulates_its_own_noise_free_record_in_full_from_any_start():
    u = np.random.default_rng(0).standard_normal((300, 2))
    y = simulate(HEATER, u, np.array([3.0, -4.0]))[1]
    # x0 by least squares: rounding
    np.testing.assert_allclose(simulate_fit(HEATER, [u], [y]), 100.0, atol=1e-6)


def test_prediction_ahead_is_the_kalman_recursion_written_out():
    u, y = innovations_record(HEATER, 60, 0.1, 1)
    model, first = prediction_form(HEATER, []), 30
    predicted = predicted_ahead(HEATER, u, y, 3)
    t, x = 40, estimate_state(model, drives("prediction", u[:first], y[:first]), y[:first])
    for k in range(t - 2):  # x(t-2 | y up to t-3)
        x = HEATER.A @ x + HEATER.B @ u[k] + HEATER.b + HEATER.K @ (y[k] - HEATER.C @ x - HEATER.d)
    for k in (t - 2, t - 1):
        x = HEATER.A @ x + HEATER.B @ u[k] + HEATER.b
    np.testing.assert_allclose(predicted[t], HEATER.C @ x + HEATER.d, rtol=1e-10)


def test_prediction_ahead_does_not_look_at_outputs_that_are_not_there_yet():
    u, y = innovations_record(HEATER, 100, 0.1, 1)
    later = y.copy()
    later[61:] += 100.0
    before, after = predicted_ahead(HEATER, u, y, 10), predicted_ahead(HEATER, u, later, 10)
    np.testing.assert_array_equal(before[:71], after[:71])
    assert np.abs(before[71] - after[71]) > 1.0


def test_a_drift_that_simulation_misses_is_followed_ahead():
    u, y = innovations_record(HEATER, 2000, 0.02, 2)
    y = y + np.cumsum(0.02 * np.random.default_rng(3).standard_normal((2000, 1)), axis=0)
    identified = identify(
        [u[:1400]], [y[:1400]], sample_time_s=1.0, settings=Settings(refinement="prediction")
    )
    assert (
        predict_fit(identified.plant, [u[1400:]], [y[1400:]], 5)[0]
        > simulate_fit(identified.plant, [u[1400:]], [y[1400:]])[0]
    )


def test_residuals_of_the_true_plant_pass_and_those_of_a_lower_order_do_not():
    u, y = innovations_record(HEATER, 4000, 0.1, 4)
    true = residual_tests(HEATER, [u], [y])
    assert true.whiteness_passed.all() and true.independence_passed.all()
    low = residual_tests(identify([u], [y], sample_time_s=1.0, settings=Settings(order=1)).plant, [u], [y])
    assert not low.independence_passed.all()


def test_a_controller_that_answers_at_once_fails_independence_only_where_the_loop_is_not_known_closed():
    rng, gain = np.random.default_rng(0), 2.0 / 60
    u, y, x = np.empty((2000, 1)), np.empty((2000, 1)), 0.0
    for t in range(2000):
        y[t] = x + 0.1 * rng.standard_normal()
        u[t] = -3.0 * y[t] + rng.standard_normal()
        x = x * (1 - 1 / 60) + gain * u[t, 0]
    heater = plant([[1 - 1 / 60]], [[gain]], [[1.0]], K=[[0.0]], sample_time_s=1.0)
    assert not residual_tests(heater, [u], [y]).independence_passed.all()
    assert residual_tests(heater, [u], [y], closed=True).independence_passed.all()


def test_advice_names_the_output_the_input_and_the_lag():
    u, y = innovations_record(HEATER, 4000, 0.1, 4)
    y[3:] += u[:-3, :1] * 0.5
    sentences = advice(
        residual_tests(HEATER, [u], [y]),
        excitation([u], 5),
        np.array([80.0]),
        outputs=["T2"],
        inputs=["heater_1", "heater_2"],
    )
    assert any(
        s.startswith("the residuals of T2 correlate with heater_1 at lag 3: check the dead time of heater_1")
        for s in sentences
    )
    assert not any("heater_2" in s for s in sentences)


def test_pairs_are_grouped_and_the_order_is_a_remedy_only_where_it_was_given():
    rng = np.random.default_rng(0)
    u, e = rng.standard_normal((2000, 2)), rng.standard_normal((2000, 3))
    still = plant(np.zeros((1, 1)), np.zeros((1, 2)), np.zeros((3, 1)))
    tests = residual_tests(still, [u], [e + u[:, :1] + u[:, 1:]])
    names = {"outputs": ["a", "b", "c"], "inputs": ["p", "q"]}
    chosen = advice(tests, excitation([u], 5), np.full(3, 80.0), **names)
    given = advice(tests, excitation([u], 5), np.full(3, 80.0), **names, order_given=True)
    assert [s for s in chosen if "in 6 of 6 pairs" in s] == chosen
    assert "raise" not in chosen[0] and given[0].endswith("or raise identify_plant.order")


def test_a_fit_that_the_free_response_reaches_without_the_inputs_is_said_to_be_its_own():
    u, y = innovations_record(HEATER, 2000, 0.01, 4)
    passed, excited = residual_tests(HEATER, [u], [y]), excitation([u], 5)
    names = {"outputs": ["T1"], "inputs": ["p", "q"]}
    (sentence,) = advice(passed, excited, np.array([97.0]), still_percent=np.array([97.0]), **names)
    assert sentence.startswith("the fit of T1 on the hold-out, 97 %, is that of the free response alone")
    assert advice(passed, excited, np.array([97.0]), still_percent=np.array([20.0]), **names) == []


def test_errors_at_rounding_are_no_residuals():
    u = np.random.default_rng(0).integers(0, 2, (600, 2)).astype(float)
    y = simulate(HEATER, u, np.zeros(2))[1]
    # beyond the 25 lags a wave of 1e-10 of the movement is as coloured and as bound to an input as can be
    tests = residual_tests(HEATER, [u], [y + 1e-10 * u[:, :1]])
    assert tests.whiteness_passed.all() and tests.independence_passed.all()
    assert not residual_tests(HEATER, [u], [y + 1e-4 * u[:, :1]]).independence_passed.all()


def test_no_advice_where_everything_passed():
    u, y = innovations_record(HEATER, 4000, 0.1, 4)
    assert (
        advice(
            residual_tests(HEATER, [u], [y]),
            excitation([u], 5),
            np.array([80.0]),
            outputs=["T1"],
            inputs=["a", "b"],
        )
        == []
    )


def test_excitation_counts_what_a_sine_cannot_excite():
    t = np.arange(500.0)
    excited = excitation(
        [np.column_stack([np.sin(0.3 * t), np.random.default_rng(0).standard_normal(500)])], 6
    )
    # a sine spans two directions, whatever the number of lags
    assert excited.per_input_rank.tolist() == [2, 6]
    assert (excited.rank, excited.full) == (8, 12)


def test_bootstrap_gives_finite_stable_plants_whose_step_responses_hold_the_truth():
    u, y = innovations_record(HEATER, 1500, 0.1, 6)
    identified = identify([u], [y], sample_time_s=1.0, settings=Settings(order=2))
    family = bootstrap_spread([u], [y], identified, count=20, rng=np.random.default_rng(0))
    assert len(family) == 20
    assert max(np.abs(np.linalg.eigvals(member.A)).max() for member in family) < 1.0
    (_, low, high), true = spread_bands(identified.plant, family, 40), step_response(HEATER, 40)
    width = high - low
    assert (width[5:] > 0).all()
    # 20 members: their range holds some 90 %; one width more on either side is far outside chance
    assert ((true >= low - width - 1e-9) & (true <= high + width + 1e-9)).all()


def coupled_heaters(rng):
    """Two zones that warm each other by some per cent; gains in °C per percent about 0.6."""
    tau, gain, shared = rng.uniform(30, 70, 2), rng.uniform(0.4, 0.8, 2), rng.uniform(0.02, 0.15, 2)
    A = np.diag(1 - 1 / tau) + np.diag(shared / tau) @ np.array([[0, 1.0], [1.0, 0]])
    return plant(A, np.diag(gain / tau), np.eye(2), b=[0.2, 0.2])


def machine_beside_a_drift(seed):
    """(plant, u, y) of 900 samples; u2 moves by 10 % every 200 samples, which a common random walk of the
    outputs hides, and u1 by 60 %."""
    rng = np.random.default_rng(seed)
    true = coupled_heaters(rng)
    first = np.concatenate([np.full(rng.integers(20, 100), rng.choice([20.0, 80.0])) for _ in range(45)])[
        :900
    ]
    u = np.column_stack([first, np.where((np.arange(900) // 200 + seed) % 2, 55.0, 45.0)])
    rest = np.linalg.solve(np.eye(2) - true.A, true.B @ u[0] + true.b)
    walk = np.cumsum(0.03 * rng.standard_normal(900))[:, None]
    return true, u, simulate(true, u, rest)[1] + walk + 0.1 * rng.standard_normal((900, 2))


def test_bands_of_gains_hold_the_truth_nine_times_in_ten_beside_a_drift_where_the_bootstrap_does_not():
    wide, narrow = [], []
    for seed in range(20):
        true, u, y = machine_beside_a_drift(seed)
        model = identify([u], [y], sample_time_s=1.0, settings=Settings(order=2))
        family = bootstrap_spread([u], [y], model, count=20, order=3, rng=np.random.default_rng(0))
        left_out = left_out_plants([u], [y], model)
        gain = step_response(true, 200)[-1]
        for plants, inside in (((), narrow), (left_out, wide)):
            _, low, high = spread_bands(model.plant, family, 200, level=0.9, left_out=plants)
            inside.append((low[-1] <= gain) & (gain <= high[-1]))
    # 80 gains of 20 machines, four of each alike: 99 % of binomials of 0.9 over 20 lie above 0.75
    assert np.mean(wide) >= 0.8
    assert np.mean(narrow) < np.mean(wide) - 0.1


def test_what_is_left_out_is_a_quarter_and_a_record_too_short_for_it_gives_no_plants():
    true, u, y = machine_beside_a_drift(0)
    model = identify([u], [y], sample_time_s=1.0, settings=Settings(order=2))
    assert len(left_out_plants([u[:450], u[450:]], [y[:450], y[450:]], model)) == 4
    assert left_out_plants([u[: model.past + 3]], [y[: model.past + 3]], model) == []


def test_a_quarter_that_alone_moves_an_input_is_not_left_out():
    true, u, _ = machine_beside_a_drift(0)
    rng = np.random.default_rng(0)
    u[:, 1] = 50.0
    u[300:420, 1] = rng.choice([20.0, 80.0], 120)
    rest = np.linalg.solve(np.eye(2) - true.A, true.B @ u[0] + true.b)
    y = simulate(true, u, rest)[1] + 0.1 * rng.standard_normal((900, 2))
    plants = left_out_plants([u], [y], identify([u], [y], sample_time_s=1.0, settings=Settings(order=2)))
    assert len(plants) == 3
    # without the passing over, the unknown column gave gains of 1e145
    assert max(np.abs(step_response(one, 200)).max() for one in plants) < 2.0


def test_bootstrap_is_repeatable_and_may_take_another_order():
    u, y = innovations_record(HEATER, 800, 0.1, 6)
    identified = identify([u], [y], sample_time_s=1.0, settings=Settings(order=2))
    first, second = (
        bootstrap_spread([u], [y], identified, count=2, order=3, rng=np.random.default_rng(1))
        for _ in range(2)
    )
    assert first[0].n == 3
    np.testing.assert_array_equal(first[1].A, second[1].A)


def test_masked_outputs_leave_simulation_and_residuals_defined():
    u, y = innovations_record(HEATER, 1000, 0.1, 7)
    y[100:120] = np.nan
    assert np.isfinite(simulated(HEATER, u, y)).all()
    assert residual_tests(HEATER, [u], [y]).whiteness_passed.all()


def test_too_few_samples_for_the_lags_are_refused():
    u, y = innovations_record(HEATER, 50, 0.1, 7)
    with pytest.raises(ValueError, match="50 samples do not carry 25 lags"):
        residual_tests(HEATER, [u], [y])


@pytest.mark.parametrize(
    ("name", "inputs", "outputs", "cut", "bar"),
    [
        ("dryer", slice(0, 1), slice(1, 2), 750, 8.0),
        ("evaporator", slice(0, 3), slice(3, 6), 5000, 38.0),
        ("glassfurnace", slice(1, 4), slice(4, 10), 1000, 36.0),
    ],
)
@pytest.mark.slow
def test_benchmark_sets_are_simulated_on_the_hold_out_as_well_as_published(
    shared, name, inputs, outputs, cut, bar
):
    record = np.loadtxt(shared(f"data/daisy_a/{name}.dat"))
    u, y = record[:, inputs], record[:, outputs]
    identified = identify(
        [u[:cut]], [y[:cut]], sample_time_s=1.0, settings=Settings(feedthrough=None, refinement="validated")
    )
    assert 100 - simulate_fit(identified.plant, [u[cut:]], [y[cut:]], means_removed=True).mean() <= bar


def test_two_heater_kit_is_simulated_and_predicted_on_the_last_third(shared):
    record = np.genfromtxt(shared("data/tclab_mlid_prbs/prbs.csv"), delimiter=",", skip_header=1)
    u, y, cut = record[:, 1:3], record[:, 3:5], int(0.7 * len(record))
    identified = identify([u[:cut]], [y[:cut]], sample_time_s=1.0)
    # plain MOESP of order 3 reaches 58 and 60 %
    assert (simulate_fit(identified.plant, [u[cut:]], [y[cut:]]) >= 62).all()
    assert (predict_fit(identified.plant, [u[cut:]], [y[cut:]], 60) >= 75).all()
