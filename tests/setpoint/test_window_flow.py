"""The flow of a window: weights, spread and classes by hand; what frames shrink and repeat is found again."""

import numpy as np
import pytest

from pipeline.setpoint.frames import familiar
from pipeline.setpoint.vision.window_flow import (
    KNOTS_PERCENT,
    FlowCalibration,
    class_probabilities,
    fit_flow,
    window_flow,
)

KNOTS = np.log(np.array(KNOTS_PERCENT) / 100)
MEASURES = len(familiar.NAMES)


def unknown(windows: int) -> np.ndarray:
    """Looks of windows in which no frame was measured."""
    return np.full((windows, MEASURES), np.nan)


def test_the_flow_of_a_window_by_hand():
    # weights 100 and 25: (100 log 1.1 + 25 log 0.9) / 125; of frames that repeat each other nothing is won
    log_flow, deviation = (
        np.log([[1.1, 0.9, 5.0]] * 2 + [[1.0] * 3]),
        np.array([[0.1, 0.2, 0.1]] * 2 + [[0.1] * 3]),
    )
    valid = np.array([[True, True, False], [False] * 3, [True] * 3])
    fitted = FlowCalibration(KNOTS, np.full(len(KNOTS), 1.5), 0.4)
    found = window_flow(log_flow, deviation, valid, unknown(3), fitted)
    mean = (100 * np.log(1.1) + 25 * np.log(0.9)) / 125
    np.testing.assert_allclose(found.flow_seen, [100 * np.exp(mean), np.nan, 100])
    np.testing.assert_allclose(found.spread, [1.5 * np.sqrt(1.4 / 125), np.nan, 0.15 * np.sqrt(1.8 / 3)])
    np.testing.assert_allclose(found.prob[1], 1 / 3)
    same = window_flow(
        log_flow[2:], deviation[2:], valid[2:], unknown(1), FlowCalibration(KNOTS, np.ones(len(KNOTS)), 1.0)
    )
    np.testing.assert_allclose(same.spread, 0.1)


@pytest.mark.parametrize("log_flow", [-3.0, -0.5, -0.1, 0.0, 0.1, 0.5, 3.0])
def test_class_probabilities_are_the_normal_law_between_the_borders(log_flow):
    rng = np.random.default_rng(0)
    shown = 100 * np.exp(log_flow + 0.08 * rng.standard_normal(400_000))
    p = class_probabilities(np.array([log_flow]), np.array([0.08]))[0]
    share = [np.mean(shown < 90), np.mean((shown >= 90) & (shown <= 110)), np.mean(shown > 110)]
    np.testing.assert_allclose(p, share, atol=0.004)  # five deviations of 400,000 draws
    assert p.sum() == pytest.approx(1, abs=1e-12)
    assert (p >= 0).all()


def drawn(n: int, frames: int, seed: int):
    """Windows whose frames say 0.7 of the log flow, as a network that is sure of little does, with errors of
    segment and frame of 6 and 15 % in the flow, and half the deviation."""
    rng = np.random.default_rng(seed)
    flow = np.exp(rng.uniform(np.log(25), np.log(300), n))
    errors = 0.06 * rng.normal(size=(n, 1)) + 0.15 * rng.normal(size=(n, frames))
    log_flow = 0.7 * (np.log(flow / 100)[:, None] + errors)
    valid = rng.random((n, frames)) > 0.1
    return log_flow, np.full((n, frames), 0.7 * np.hypot(0.06, 0.15) / 2), valid, flow


def test_what_a_network_shrinks_towards_what_it_learned_is_undone_and_the_spread_is_true():
    *shown, flow = drawn(1000, 20, seed=0)
    fitted = fit_flow(*shown, unknown(1000), flow)
    assert fitted.correlation == pytest.approx(0.06**2 / (0.06**2 + 0.15**2), abs=0.03)
    log_flow, deviation, valid, flow = drawn(4000, 20, seed=1)
    for frames in (20, 8):
        first = (a[:, :frames] for a in (log_flow, deviation, valid))
        seen = window_flow(*first, unknown(len(flow)), fitted)
        z = np.log(seen.flow_seen / flow) / seen.spread
        for low, high in ((40, 70), (70, 90), (90, 110), (110, 150), (150, 250)):
            here = z[(flow > low) & (flow < high)]
            assert here.mean() == pytest.approx(0, abs=0.25)  # 1,000 windows know a knot to a tenth
            assert here.std() == pytest.approx(1, abs=0.15)


def test_the_map_rises_and_is_finite_where_nothing_was_seen_or_learned():
    log_flow, deviation, valid, flow = drawn(60, 5, seed=2)
    near = (flow > 60) & (flow < 150)
    blind = np.zeros_like(log_flow)
    for shown in (log_flow, blind):
        fitted = fit_flow(shown[near], deviation[near], valid[near], unknown(near.sum()), flow[near])
        assert np.isfinite(fitted.shown).all()
        assert (np.diff(fitted.shown) > 0).all()
        assert (fitted.scale > 0).all()
        seen = window_flow(shown, deviation, valid, unknown(60), fitted)
        some = valid.any(axis=1)
        assert np.isfinite(seen.flow_seen[some]).all()
        assert (seen.spread[some] > 0).all()
    # who sees nothing says so: no class is likelier than its share of the flows
    assert np.nanmin(seen.spread) > 0.15


def test_frames_that_are_not_valid_do_not_count_whatever_they_hold():
    log_flow, deviation, valid, flow = drawn(200, 6, seed=3)
    spoilt, looks = np.where(valid, log_flow, np.nan), unknown(200)
    for one in (
        fit_flow(spoilt, deviation, valid, looks, flow),
        fit_flow(log_flow, deviation, valid, looks, flow),
    ):
        found, sound = (window_flow(shown, deviation, valid, looks, one) for shown in (spoilt, log_flow))
        np.testing.assert_array_equal(found.flow_seen, sound.flow_seen)


def test_what_looks_move_is_taken_off_and_windows_without_looks_say_that_they_know_less():
    """Two measures move what a segment shows by 4 and 3 %; nothing else is wrong but 6 % a segment and 15 % a
    frame."""

    def looking(seed):
        log_flow, deviation, valid, flow = drawn(1500, 20, seed)
        looks = np.random.default_rng(100 + seed).normal(5.0, 2.0, (1500, MEASURES))
        moved = 0.04 * (looks[:, 3] - 5) / 2 - 0.03 * (looks[:, 7] - 5) / 2
        return log_flow + 0.7 * moved[:, None], deviation, valid, looks, flow

    fitted = fit_flow(*looking(4))
    assert fitted.looks.explained == pytest.approx(0.05, rel=0.15)
    *shown, looks, flow = looking(5)
    near = (flow > 60) & (flow < 180)
    errors = []
    for known in (looks, np.full_like(looks, np.nan)):
        seen = window_flow(*shown, known, fitted)
        errors.append(np.log(seen.flow_seen / flow)[near].std())
        z = np.log(seen.flow_seen / flow)[near] / seen.spread[near]
        assert z.std() == pytest.approx(1, abs=0.12)
    ideal = np.hypot(0.06, 0.15 / np.sqrt(18))
    assert errors[0] == pytest.approx(ideal, rel=0.06)
    assert errors[1] == pytest.approx(np.hypot(ideal, 0.05), rel=0.06)
    far = window_flow(*shown, looks + 1e6, fitted)
    np.testing.assert_allclose(np.log(far.flow_seen / flow)[near], 0, atol=1.5)


def test_few_windows_teach_nothing_of_looks():
    *shown, flow = drawn(80, 20, seed=6)
    assert not fit_flow(*shown, np.random.default_rng(0).normal(size=(80, MEASURES)), flow).looks.weight.any()
