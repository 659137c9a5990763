"""Probing signals stay within their limits, excite what they claim, and
the window route learns from 2,000 gentle samples."""

import re

import numpy as np
import pytest

from pipeline.papers.published import GAMMA, K_DATA, REFERENCE
from pipeline.papers.study import gap, study_panel, study_probe, study_signal
from pipeline.temperature.controllers import window as window_route
from pipeline.temperature.controllers.law import feasible_target
from pipeline.temperature.plant import baam, simulate
from pipeline.temperature.probing import excitation, multisine, prbs, probe

LOW, HIGH = np.zeros(7), np.full(7, 100.0)


def gentle(signal, *, rate=5.0, noise=0.1, seed=0, low=None, high=None):
    """Probing of +-5 % around the study's feasible target, with a little feedback from what is measured."""
    target, rng = feasible_target(baam(), REFERENCE, LOW, HIGH), np.random.default_rng(seed)
    low, high = target.u - 5 if low is None else low, target.u + 5 if high is None else high
    disturbance = noise * rng.standard_normal((len(signal), 5))
    recorded = probe(
        baam(),
        signal,
        (target.x, target.u, target.y),
        (low, high, rate),
        feedback=0.2 * np.eye(7, 5),
        noise=disturbance,
    )
    return recorded, target


def test_a_multisine_stays_within_its_amplitude_and_reaches_it():
    signal = multisine(np.random.default_rng(0), 999, 3, amplitude=4.0)
    np.testing.assert_allclose(np.abs(signal).max(axis=0), 4.0, rtol=1e-12)  # scaled to it; rounding
    np.testing.assert_allclose(signal.mean(axis=0), 0.0, atol=1e-12)


def test_the_inputs_of_a_multisine_share_no_line_and_each_has_equal_power_in_its_own():
    samples = 600
    power = np.abs(np.fft.rfft(multisine(np.random.default_rng(0), samples, 3, amplitude=1.0), axis=0)) ** 2
    on = power > 1e-9 * power.max()
    assert on.sum(axis=1).max() == 1
    for channel in range(3):
        # equal power; rounding
        np.testing.assert_allclose(
            power[on[:, channel], channel], power[on[:, channel], channel].mean(), rtol=1e-9
        )


def test_a_prbs_has_two_levels_and_switches_no_faster_than_told():
    signal = prbs(np.random.default_rng(0), 1001, 4, amplitude=5.0, shortest=3)
    assert signal.shape == (1001, 4)
    assert set(np.unique(signal)) == {-5.0, 5.0}
    assert (np.flatnonzero(np.diff(signal, axis=0).any(axis=1)) % 3 == 2).all()
    assert abs(np.corrcoef(signal[::3].T) - np.eye(4)).max() < 0.25  # 334 draws: 4.5 standard deviations


@pytest.mark.parametrize("rate", [1.0, 3.0, 100.0])
@pytest.mark.parametrize("kind", ["prbs", "multisine"])
def test_a_probe_keeps_amplitude_rate_and_machine_limits(kind, rate):
    rng = np.random.default_rng(1)
    signal = (
        prbs(rng, 500, 7, amplitude=5.0, shortest=2)
        if kind == "prbs"
        else multisine(rng, 500, 7, amplitude=5.0)
    )
    target = feasible_target(baam(), REFERENCE, LOW, HIGH)
    low, high = np.maximum(LOW, target.u - 5), np.minimum(HIGH, target.u + 5)
    run, _ = gentle(signal, rate=rate, low=low, high=high)
    assert (run.u >= low).all()
    assert (run.u <= high).all()
    # rounding of the sum of two inputs
    assert np.abs(np.diff(np.vstack([target.u, run.u]), axis=0)).max() <= rate + 1e-12
    assert 0 < run.limited <= 1


def test_what_a_probe_records_is_what_was_applied_and_measured():
    run, target = gentle(prbs(np.random.default_rng(1), 300, 7, amplitude=5.0, shortest=1), noise=0.0)
    np.testing.assert_array_equal(run.y, simulate_from(run.u, target.x))


def simulate_from(u, x):
    y = np.empty((len(u), 5))
    for t in range(len(u)):
        y[t] = baam().C @ x + baam().d
        x = baam().A @ x + baam().B @ u[t] + baam().b
    return y


def test_feedback_reads_measured_outputs_only():
    """Two runs whose first measurement differs by the sensor alone
    differ in the first input by feedback times it."""
    signal = np.zeros((1, 7))
    quiet, target = gentle(signal, noise=0.0)
    shown = gentle(signal, noise=1.0, seed=3)[0]
    difference = shown.y[0] - quiet.y[0]
    # the target is met within 1e-8 °C
    np.testing.assert_allclose(shown.u[0] - target.u, -0.2 * np.r_[difference, 0, 0], atol=1e-9)


def test_an_unlimited_probe_counts_no_sample_as_limited():
    assert (
        gentle(prbs(np.random.default_rng(1), 50, 7, amplitude=1.0, shortest=1), noise=0.0, rate=100.0)[
            0
        ].limited
        == 0.0
    )


@pytest.mark.parametrize("seed", range(3))
def test_two_thousand_gentle_samples_leave_a_gap_of_at_most_15_millionths(seed):
    run, _ = gentle(prbs(np.random.default_rng(seed), 2000, 7, amplitude=5.0, shortest=1), seed=100 + seed)
    assert np.abs(run.y - REFERENCE).max() < 60.0  # the study's own probing swings the plant by 70 to 190 °C
    law = window_route.law(window_route.learn([run.u], [run.y], longest=12), np.eye(5), np.eye(7), GAMMA)
    # the bar; 1.0e-5 measured
    assert gap(law, study_panel(REFERENCE[None], noise=0.1, seeds=(seed,), hold=24))[0] <= 1.5e-5


def test_the_study_s_signal_is_a_sinusoid_at_the_bandwidth_and_draws():
    settings = {"amplitudes": np.array([2.0]), "bandwidth": 1.65, "variance": 0.0}
    signal = study_signal(np.random.default_rng(0), 20, 2, **settings)
    # rounding
    np.testing.assert_allclose(signal, np.tile(2 * np.sin(1.65 * np.arange(20))[:, None], 2), atol=1e-14)
    noise = study_signal(
        np.random.default_rng(0), 20_000, 1, amplitudes=np.array([0.0]), bandwidth=1.65, variance=1.5
    )
    assert noise.var() == pytest.approx(1.5, rel=0.05)  # 20,000 draws: five standard deviations of 1 %


def test_redrawn_frequencies_are_nearly_white_and_fixed_ones_are_lines():
    settings = {"amplitudes": np.arange(100.0, 0.0, -10.0), "bandwidth": 1.65, "variance": 0.0}
    flat = []
    for redrawn in (True, False):
        power = (
            np.abs(
                np.fft.rfft(
                    study_signal(np.random.default_rng(0), 4096, 1, redrawn=redrawn, **settings)[:, 0]
                )
            )
            ** 2
        )
        flat.append(np.sort(power)[::-1][:40].sum() / power.sum())
    assert flat[1] > 0.9  # 40 of 2,049 lines hold nearly all of ten sinusoids
    assert flat[0] < 0.6


def test_the_study_s_probe_reads_the_true_state():
    rng = np.random.default_rng(0)
    signal, x0 = rng.normal(size=(30, 7)), np.full(6, 50.0)
    run = study_probe(baam(), signal, K_DATA, x0=x0, noise=np.zeros((30, 5)))
    x, y = simulate(baam(), run.u, x0)
    np.testing.assert_allclose(run.y, y, atol=1e-11)  # rounding at 50 °C
    np.testing.assert_allclose(run.u, signal - x[:-1] @ K_DATA.T, atol=1e-11)
    batch = study_probe(
        baam(), np.stack([signal, -signal], axis=1), K_DATA, x0=x0, noise=np.zeros((30, 2, 5))
    )
    np.testing.assert_allclose(batch.u[:, 0], run.u, atol=1e-11)


def test_a_white_signal_excites_every_order_and_a_sinusoid_only_two():
    white = excitation(np.random.default_rng(0).normal(size=(500, 2)), 5)
    assert (white.rank, white.full) == (10, 10)
    assert 1 < white.condition < 10
    sinusoid = excitation(np.sin(2 * np.pi * 50 / 500 * np.arange(500))[:, None], 5)
    assert (sinusoid.rank, sinusoid.condition) == (2, float("inf"))
    assert excitation(np.ones((100, 1)), 3).rank == 0


def test_the_level_of_a_frequency_lands_in_its_band_with_its_r_m_s_value():
    u = np.stack(
        [
            3 * np.sin(2 * np.pi * 50 / 800 * np.arange(800)),
            2 * np.cos(2 * np.pi * 330 / 800 * np.arange(800)),
        ],
        axis=1,
    )
    level = excitation(u, 1, bands=8).level
    expected = np.zeros((8, 2))
    # lines 1-50 are the first of eight bands, 301-350 the seventh
    expected[0, 0], expected[6, 1] = (3 / np.sqrt(2), 2 / np.sqrt(2))
    np.testing.assert_allclose(level, expected, atol=1e-12)  # whole periods: rounding


def test_too_short_a_record_is_refused_with_how_many_more():
    with pytest.raises(
        ValueError,
        match=re.escape(
            "excitation of order 12 with 7 inputs expects at least 96 samples, found 90; record 6 more"
        ),
    ):
        excitation(np.zeros((90, 7)), 12)
