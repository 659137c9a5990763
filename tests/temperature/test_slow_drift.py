"""What is not recorded, as a slow random walk beside the outputs."""

import numpy as np
import pytest

from pipeline.temperature.identification.drift import simulated_with_drift, tracked
from pipeline.temperature.identification.model_choice import Settings, identify
from pipeline.temperature.identification.refinement import simulated


def test_the_drift_is_the_mean_over_its_warm_up_and_then_exponential_smoothing():
    error = np.random.default_rng(0).standard_normal((60, 2))
    drift = tracked(error, 0.1)
    assert np.isnan(drift[0]).all()
    for t in range(1, 11):
        np.testing.assert_allclose(drift[t], error[:t].mean(axis=0), rtol=1e-12)  # rounding
    for t in range(11, 60):
        np.testing.assert_allclose(drift[t], drift[t - 1] + 0.1 * (error[t - 1] - drift[t - 1]), rtol=1e-12)


def test_the_drift_knows_nothing_of_later_errors_and_passes_over_masked_ones():
    error = np.random.default_rng(1).standard_normal((80, 1))
    other = error.copy()
    other[40:] += 100.0
    np.testing.assert_array_equal(tracked(error, 0.05, 7)[:47], tracked(other, 0.05, 7)[:47])
    masked = error.copy()
    masked[20:30] = np.nan
    left = np.delete(error, np.s_[20:30], axis=0)
    np.testing.assert_allclose(tracked(masked, 0.05)[31:], tracked(left, 0.05)[21:], rtol=1e-12)  # rounding


def _room(rng, *, wanders: bool) -> tuple[np.ndarray, np.ndarray]:
    """A heater of 50 samples in a room that wanders by some °C, and for the last third is 9 °C warmer; or in
    one that stays."""
    T, x, y = 3000, 60.0, np.empty((3000, 1))
    u = np.repeat(rng.uniform(10, 60, (T // 40, 1)), 40, axis=0)
    room = 21.0 + np.where(np.arange(T) >= 2 * T // 3, 9.0, 0.0) + 0.08 * np.cumsum(rng.standard_normal(T))
    room = room if wanders else np.full(T, 21.0)
    for t in range(T):
        y[t] = x + 0.05 * rng.standard_normal()
        x += 0.04 * u[t, 0] - 0.02 * (x - room[t])
    return u, y


def _fit(y: np.ndarray, predicted: np.ndarray) -> float:
    seen = np.isfinite(predicted[:, 0])
    return 100 * (
        1 - np.linalg.norm((y - predicted)[seen]) / np.linalg.norm((y - y[seen].mean(axis=0))[seen])
    )


@pytest.mark.parametrize("seed", [1, 2])
def test_a_hold_out_on_a_warmer_day_is_not_lost(seed):
    u, y = _room(np.random.default_rng(seed), wanders=True)
    identified = identify(
        [u[:2000]], [y[:2000]], sample_time_s=1.0, settings=Settings(refinement="validated")
    )
    assert 0 < identified.drift < 1
    assert any("drifts" in note for note in identified.notes)
    raw = _fit(y[2000:], simulated(identified.plant, u[2000:], y[2000:]))
    ahead = 20
    drifting = simulated_with_drift(identified.plant, u[2000:], y[2000:], identified.drift, ahead)
    # 9 °C on outputs that move by some 20 °C: more than a quarter of the movement is the day's
    assert _fit(y[2000:], drifting) > raw + 10


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_no_drift_is_found_in_a_room_that_stays_as_it_is(seed):
    u, y = _room(np.random.default_rng(seed), wanders=False)
    assert identify([u], [y], sample_time_s=1.0, settings=Settings(refinement="validated")).drift == 0
