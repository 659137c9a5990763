"""What the learners reach on the study's machine, each beside its bar."""

import numpy as np
import pytest

from pipeline.temperature import study
from pipeline.temperature.published import REFERENCE


@pytest.fixture(scope="module")
def record():
    """A record of the study's probing, noise-free, whose first row the
    learners leave out as they do the published one's."""
    u, y = study.data_sets(np.random.default_rng(3), 1650, 1)
    return u[1:, 0], y[1:, 0]


def test_the_optimum_and_the_observer_cost_what_the_notes_say():
    exact = study.exact()
    assert exact.optimal_J1000 == pytest.approx(151_875.28, abs=0.01)  # printed digits
    assert exact.optimal_J100 == pytest.approx(151_819.56, abs=0.01)
    assert exact.observer_J1000 <= 151_876  # the bar
    assert exact.observer_published_start_J1000 == pytest.approx(159_183, abs=1)
    assert exact.zero_history_gap == pytest.approx(8e-7, abs=1e-7)


def test_one_record_without_noise_gives_the_optimum_for_every_reference(record):
    result = study.noise_free(*record, np.random.default_rng(4))
    assert result.gap <= 1e-7  # the bars
    assert result.gap_window_6 <= 1e-7
    assert result.any_reference_gap <= 1e-7


def test_a_kernel_short_of_samples_for_any_reference_is_refused(record):
    with pytest.raises(ValueError, match="record 1 more"):
        study.kernel_of(record[0][:379], record[1][:379], 2)


@pytest.mark.parametrize(("noise", "window_bar", "kernel_bar"), [(0.1, 4e-6, 1.5e-4), (0.5, 1e-4, 1e-3)])
def test_both_routes_stand_sensor_noise(noise, window_bar, kernel_bar):
    """One data set here; twenty in the slow test."""
    u, y = study.data_sets(np.random.default_rng(1), 15_000, 1)
    gaps = study.under_noise(u[:, 0], y[:, 0], noise=noise, seed=0)
    assert gaps["window"][0] <= window_bar
    assert gaps["kernel"][0] <= kernel_bar
    assert gaps["kernel_predicted_state"][0] < gaps["kernel"][0]
    assert max(error for _, error in gaps.values()) < 2.0  # °C over the second half: 0.03 to 0.7 measured


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "window_bar", "kernel_bar"), [(0.1, 4e-6, 1.5e-4), (0.5, 1e-4, 1e-3)])
def test_both_routes_stand_sensor_noise_on_twenty_data_sets(noise, window_bar, kernel_bar):
    u, y = study.data_sets(np.random.default_rng(1), 15_000, 20)
    gaps = [study.under_noise(u[:, i], y[:, i], noise=noise, seed=i) for i in range(20)]
    assert max(f["window"][0] for f in gaps) <= window_bar
    assert np.median([f["kernel"][0] for f in gaps]) <= kernel_bar
    assert all(f["kernel"][0] < 1 for f in gaps)  # stable


def test_scaling_all_weights_changes_the_index_and_not_the_controller():
    scaled = study.scaled_weights(0.4)
    assert scaled.change_percent == pytest.approx(-60.0, abs=1e-9)  # J is linear in the weights
    assert scaled.gain_difference < 1e-12  # rounding


def test_the_index_of_the_tuner_is_the_known_optimum_at_equal_weights_and_more_elsewhere():
    theta = np.ones(12)
    best = study.tuning_objective(theta)
    assert best == pytest.approx(151_820, abs=1.0)  # the notes' optimum of (37)
    assert study.tuning_objective(0.3 * theta) == pytest.approx(best, rel=1e-12)
    for i in range(12):
        changed = theta.copy()
        changed[i] = 0.5
        assert study.tuning_objective(changed) > best


def test_noisy_data_sets_become_a_table_and_its_figures():
    work = [(noise, i) for noise in study.NOISE for i in range(3)]
    results = [
        {route: (10.0 * noise + i + k, 0.1 * i) for k, route in enumerate(study.ROUTES)} for noise, i in work
    ]
    results[0]["kernel"] = (float("inf"), float("nan"))
    table = study.rows(work, results)
    assert len(table["gap"]) == len(work) * len(study.ROUTES)
    figures = study.metrics(
        {}, study.Exact(1, 2, 3, 4, 5), study.NoiseFree(6, 7, 8), table, failures=9, starts=10
    )
    assert figures["window"]["noise_0_1"] == {
        "median_gap": 2.0,
        "worst_gap": 3.0,
        "median_error_degC": pytest.approx(0.1),
        "stable": 0,
        "of": 3,
    }
    kernel = figures["kernel"]["noise_0_1"]
    # an unstable one is the worst, and no number
    assert (kernel["worst_gap"], kernel["median_gap"], kernel["stable"]) == (None, 4.0, 0)
    assert (
        figures["kernel"]["gap"],
        figures["kernel"]["any_reference_gap"],
        figures["optimal"]["J1000"],
    ) == (6, 8, 1)
    assert figures["algorithm_1"] == {"failures": 9, "of": 10}


def test_the_study_s_panel_holds_every_cell_at_20_degrees():
    cases = study.study_panel(REFERENCE[None], noise=0.1, seeds=(3,), hold=5)
    np.testing.assert_array_equal(cases.x0, np.full((1, 6), 20.0))
    assert (cases.steps, cases.hold, cases.seed.tolist(), cases.noise.tolist()) == (1000, 5, [3], [0.1])
