"""The spread of a classifier of few own pictures."""

import numpy as np

from pipeline.setpoint.vision.calibrated_classifier import WindowPredictions
from pipeline.setpoint.vision.calibration import WindowTruth
from pipeline.setpoint.vision.own_pictures import spread_growth, stretch, widen
from pipeline.setpoint.vision.window_flow import (
    KNOTS_PERCENT,
    NO_CORRECTION,
    FlowCalibration,
    WindowFlow,
    class_probabilities,
    window_flow,
)


def predictions(rng: np.random.Generator, *, error: float, spread: float, n: int = 400) -> WindowPredictions:
    """Windows that state a spread and err by another, every tenth without a valid frame."""
    flow, valid = rng.uniform(60, 160, n), np.arange(n) % 10 > 0
    seen = np.where(valid, flow * np.exp(error * rng.standard_normal(n)), np.nan)
    prob = np.full((n, 3), 1 / 3)
    prob[valid] = class_probabilities(np.log(seen[valid] / 100), np.full(valid.sum(), spread))
    truth = WindowTruth(np.zeros(n, int), flow, np.full(n, 210.0), np.arange(n))
    shown = WindowFlow(seen, np.where(valid, spread, np.nan), prob)
    return WindowPredictions(shown, prob, truth, np.arange(n)[:, None], valid)


def test_a_print_that_is_read_quite_wrongly_widens_the_others_little():
    windows = predictions(np.random.default_rng(3), error=0.12, spread=0.12)
    wrong = windows.seen.flow_seen * np.where(np.arange(400) < 32, 3.0, 1.0)
    assert spread_growth(windows._replace(seen=windows.seen._replace(flow_seen=wrong))) < 1.3


def test_after_the_stretch_error_over_spread_is_one():
    windows = predictions(np.random.default_rng(0), error=0.24, spread=0.12)
    growth = spread_growth(windows)
    assert np.isclose(growth, 2.0, rtol=0.1)
    assert np.isclose(spread_growth(windows._replace(seen=widen(windows.seen, growth))), 1.0)


def test_a_wider_spread_leaves_the_flow_and_makes_the_classes_less_sure():
    seen = predictions(np.random.default_rng(1), error=0.1, spread=0.05).seen
    wider = widen(seen, 3.0)
    np.testing.assert_array_equal(wider.flow_seen, seen.flow_seen)
    assert wider.prob.max(axis=1).mean() < seen.prob.max(axis=1).mean()
    np.testing.assert_allclose(wider.prob.sum(axis=1), 1.0)
    np.testing.assert_array_equal(wider.prob[np.isnan(seen.flow_seen)], 1 / 3)


def test_a_stretched_calibration_states_the_same_flows_with_so_much_more_spread():
    knots = np.log(np.array(KNOTS_PERCENT) / 100)
    plain = FlowCalibration(knots, np.ones(len(knots)), 0.2, NO_CORRECTION._replace(explained=0.03))
    rng, valid = np.random.default_rng(2), np.ones((5, 4), bool)
    frames = 0.2 * rng.standard_normal((5, 4)), np.full((5, 4), 0.1), valid
    looks = np.where(np.arange(5)[:, None] < 3, 0.0, np.full((5, len(NO_CORRECTION.mean)), np.nan))
    before, after = (window_flow(*frames, looks, of) for of in (plain, stretch(plain, 1.7)))
    np.testing.assert_array_equal(after.flow_seen, before.flow_seen)
    np.testing.assert_allclose(after.spread, 1.7 * before.spread)
