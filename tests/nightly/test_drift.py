"""Drift, asked of the machine's own physics: what changed is named, what did not change raises nothing."""

import numpy as np
import pytest
import scipy.linalg

from pipeline.nightly import drift
from pipeline.temperature.plant import Plant, plant, simulate
from pipeline.temperature.tracking import robust_observer_gain

SAMPLES, NOISE = 1200, 0.1


def two_zones(*, gain=(1.0, 1.0), slower=(1.0, 1.0)) -> Plant:
    """60 and 90 s, 1.6 and 1.2 °C per percent, warming each other by a tenth; exact sampling at 1 s."""
    tau = np.array([60.0, 90.0]) * slower
    F, G = np.array([[-1.1, 0.1], [0.1, -1.1]]) / tau[:, None], np.diag(np.array([1.6, 1.2]) * gain / tau)
    whole = scipy.linalg.expm(np.block([[F, G], [np.zeros((2, 4))]]))
    return plant(whole[:2, :2], whole[:2, 2:], np.eye(2))


MODEL = two_zones()._replace(K=robust_observer_gain(two_zones(), 1.0))
CAUSES = drift.causes(MODEL)


def record(truth: Plant, seed: int, samples: int = SAMPLES) -> tuple[np.ndarray, np.ndarray]:
    """Steps of 8 % every 20 s or more about 50 %, in equilibrium before; sensor noise of 0.1 °C."""
    rng = np.random.default_rng(seed)
    u = 50 + 8 * (2.0 * np.repeat(rng.integers(0, 2, (-(-samples // 20), 2)), 20, axis=0)[:samples] - 1)
    x0 = np.linalg.solve(np.eye(truth.n) - truth.A, truth.B @ np.full(2, 50.0))
    return u, simulate(truth, u, x0)[1] + NOISE * rng.standard_normal((samples, 2))


def shifts(truth: Plant, seed: int, K: np.ndarray) -> tuple[drift.Shift, np.ndarray]:
    before = [drift.estimate(MODEL, [record(two_zones(), 900 + k)], CAUSES, K) for k in range(4)]
    variance = np.exp(np.mean([estimate.log_variance for estimate in before], axis=0))
    now = drift.estimate(MODEL, [record(truth, seed)], CAUSES, K, variance)
    shift = drift.shift(
        now.change,
        now.deviation,
        np.array([estimate.change for estimate in before]),
        np.array([estimate.deviation for estimate in before]),
    )
    return shift, drift.explained(shift, now)


def test_the_change_of_a_gain_is_measured_to_a_percent():
    for share, channel in ((0.9, 0), (1.1, 1)):
        gain = [1.0, 1.0]
        gain[channel] = share
        shift, explained = shifts(two_zones(gain=tuple(gain)), 1, drift.observer(MODEL, SAMPLES))
        assert CAUSES[int(explained.argmax())] == drift.Cause("gain", channel)
        # three of its own deviations, which are below a percent here
        assert (
            abs(shift.value[channel] - shift.reference[channel] - (share - 1))
            < 3 * shift.deviation[channel] + 0.002
        )
        assert abs(shift.sigmas[channel]) > 6


@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({"slower": (1.1, 1.1)}, drift.Cause("time constant", -1)),
        ({"gain": (0.9, 0.9)}, drift.Cause("gain", -1)),
        ({"slower": (1.1, 1.0)}, drift.Cause("time constant", 0)),
        ({"gain": (1.0, 1.1)}, drift.Cause("gain", 1)),
    ],
)
def test_a_longer_time_constant_is_told_from_a_lower_gain(changes, cause):
    for seed in (2, 3):
        (own, mine), (_, slow) = (
            shifts(two_zones(**changes), seed, K)
            for K in (drift.observer(MODEL, SAMPLES), drift.slow_observer(MODEL, SAMPLES))
        )
        named = drift.named(np.abs(own.value - own.reference) > 0.04, mine, slow)
        assert [CAUSES[k] for k in named] == [cause]
        # of 10 %, to a fifth: rates fall to 1 / 1.1
        assert abs(own.value - own.reference)[named[0]] == pytest.approx(0.1, abs=0.02)


def test_a_plant_that_did_not_change_raises_nothing_in_forty_nights():
    K = drift.observer(MODEL, SAMPLES)
    sigmas = np.array([shifts(two_zones(), 10 + k, K)[0].sigmas for k in range(40)])
    # of 40 x 6 figures the largest normal one would be about 2.9; 4 leaves the night's alarm of 6 far away
    assert np.abs(sigmas).max() < 4
    assert 0.3 < np.sqrt((sigmas**2).mean()) < 1.3


def test_every_rate_scaled_back_is_the_plant_again():
    there = drift.faster(drift.faster(MODEL, 0.25), -0.2)
    np.testing.assert_allclose(there.A, MODEL.A, atol=1e-10)  # expm and logm to rounding
    np.testing.assert_allclose(there.B, MODEL.B, atol=1e-10)
    gains = [np.linalg.solve(np.eye(2) - zones.A, zones.B) for zones in (MODEL, drift.faster(MODEL, 0.3))]
    np.testing.assert_allclose(*gains, rtol=1e-8)  # its steady gains stay


def test_a_first_order_lag_quickened_by_hand():
    # exp(-1 / 50) at twice the rate is exp(-2 / 50); B keeps the gain of 3
    lag = plant([[np.exp(-1 / 50)]], [[3 * (1 - np.exp(-1 / 50))]], [[1.0]])
    quick = drift.faster(lag, 1.0)
    assert quick.A[0, 0] == pytest.approx(np.exp(-2 / 50)) and quick.B[0, 0] == pytest.approx(
        3 * (1 - np.exp(-2 / 50))
    )


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda u, y: (u, y[:, ::-1]), "the sensors left and right are swapped"),
        (lambda u, y: (u[:, ::-1], y), "the inputs one and two are swapped"),
        (lambda u, y: (u, 1.8 * y + 32), "every sensor is in °F where °C is declared"),
        (lambda u, y: (u, y + [273.15, 0]), "left is in K where °C is declared"),
        (lambda u, y: (u / 100, y), "every input is in shares of 1 where percent is declared"),
    ],
)
def test_a_mistake_in_a_record_is_named(spoil, words):
    u, y = spoil(*record(two_zones(), 5))
    mistakes = drift.mistakes(
        MODEL, u, y, inputs=["one", "two"], outputs=["left", "right"], scale=np.full(2, NOISE), gross=3.0
    )
    assert mistakes[1].words == words and mistakes[1].error_share < 0.5


@pytest.mark.parametrize("truth", [two_zones(), two_zones(gain=(0.85, 1.0)), two_zones(slower=(1.2, 1.2))])
def test_a_drifted_plant_is_no_mistake_of_the_record(truth):
    u, y = record(truth, 6)
    mistakes = drift.mistakes(
        MODEL, u, y, inputs=["one", "two"], outputs=["left", "right"], scale=np.full(2, NOISE), gross=3.0
    )
    assert len(mistakes) == 1 or mistakes[1].error_share > 0.5


def test_gaps_in_the_outputs_are_passed_over():
    u, y = record(two_zones(gain=(0.9, 1.0)), 7)
    holed = y.copy()
    holed[200:210] = np.nan
    K = drift.observer(MODEL, SAMPLES)
    whole, gapped = (drift.estimate(MODEL, [(u, part)], CAUSES, K).change[0] for part in (y, holed))
    assert gapped == pytest.approx(whole, abs=0.01)  # ten samples of 1200 say little


def test_a_record_too_short_to_judge_is_refused():
    u, y = record(two_zones(), 8, samples=60)
    with pytest.raises(
        ValueError,
        match="expected records of at least 96 samples to hold against the champion, found 60; record longer",
    ):
        drift.estimate(MODEL, [(u, y)], CAUSES, drift.observer(MODEL, 60))
