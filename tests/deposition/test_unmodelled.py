"""What a model does not know, as a multiplicative uncertainty: against the deviation that was put in, and
what it adds to the convergence test."""

import numpy as np
import pytest

from pipeline.deposition.extruder import Extruder, flow, frequency_response, routine
from pipeline.deposition.learning import ilc
from pipeline.deposition.learning.trial_model import TrialModel, unmodelled

TS = 0.02
R = routine(
    off_s=4, on_s=6, pause_s=0.6, tail_s=8, speed=8.0, bead_area_mm2=0.304, ramp_s=0.15, sample_time_s=TS
).r
MODEL = Extruder(1.0, 2.0, 0.1)
F = np.linspace(0.0, 25.0, 500)
NOISE = 0.03 * R.max()


def delta(plant, noise=NOISE, u=R):
    y = flow(plant, u, sample_time_s=TS) + noise * np.random.default_rng(0).standard_normal(len(u))
    return unmodelled(TrialModel(MODEL, noise, 90.0), [u], [y], F, sample_time_s=TS)


def test_a_gain_that_is_off_by_a_fifth_is_an_uncertainty_of_a_fifth_where_the_command_excites():
    known = delta(MODEL._replace(gain=1.2))
    assert known[F < 0.6].min() > 0.15 and known[F < 0.6].max() < 0.25
    assert np.all(known[F > 10] == 0)  # nothing is said where nothing was asked


def test_the_model_itself_leaves_little():
    assert delta(MODEL)[F < 0.5].max() < 0.05


def test_the_uncertainty_of_another_time_constant_is_that_of_its_frequency_response():
    other = MODEL._replace(time_constant_s=2.6)
    P, true = (frequency_response(e, F, sample_time_s=TS) for e in (MODEL, other))
    near = (F > 0.3) & (F < 1)
    np.testing.assert_allclose(
        delta(other, noise=1e-4)[near], np.abs(true / P - 1)[near], rtol=0.35
    )  # smoothed over half a hertz


def test_samples_that_no_camera_saw_count_for_nothing():
    y = flow(MODEL, R, sample_time_s=TS)
    y[300:320] = np.nan
    assert unmodelled(TrialModel(MODEL, 1e-6, 99.0), [R], [y], F, sample_time_s=TS).max() == 0.0


def test_gamma_with_an_uncertainty_is_the_worst_over_its_phases():
    Q, L, P = 0.9 * np.ones(3), np.array([1.0, 1.1, 0.9j]), np.array([1.0, 0.8, 1.0])
    d = np.array([0.2, 0.4, 0.1])
    turned = d * np.exp(1j * np.linspace(0, 2 * np.pi, 2000))[:, None]
    worst = np.abs(Q * (1 - L * P * (1 + turned))).max()
    assert ilc.gamma(Q, L, P, d) == pytest.approx(worst, rel=1e-5)
    assert ilc.gamma(Q, L, P) == ilc.gamma(Q, L, P, np.zeros(3))
