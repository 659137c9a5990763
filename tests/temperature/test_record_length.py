"""Cost against record length: what is learned from, and where two curves change places, by hand."""

import numpy as np
import pytest

from pipeline.temperature.test_set.record_length import beginning, curves

FLAT = np.zeros(8)
SAMPLES = (100, 200, 400, 800)


def costs(model, data):
    """Logarithms of costs of two controllers on eight plants at each length; None if one was not learned."""
    pairs = zip(model, data, strict=True)
    return [{k: v + FLAT for k, v in zip("ab", one, strict=True) if v is not None} for one in pairs]


def test_the_beginning_is_cut_in_the_order_of_the_segments():
    pieces = [np.arange(6.0)[:, None], np.arange(4.0)[:, None]]
    assert [len(piece) for piece in beginning(pieces, 0.5)] == [5]
    assert [len(piece) for piece in beginning(pieces, 0.8)] == [6, 2]
    assert [len(piece) for piece in beginning(pieces, 1.0)] == [6, 4]


def test_two_curves_change_places_on_the_straight_line_over_the_logarithm_of_the_length():
    found = curves(costs((0, 0, 0, 0), (0.4, 0.2, -0.2, -0.3)), SAMPLES, ("a", "b"), seed=1)
    crossing = found["crossing"]
    assert crossing["samples"] == pytest.approx(200 * np.sqrt(2), rel=1e-12)
    # all plants agree, so that the interval is that point
    assert (crossing["low"], crossing["high"], crossing["share"]) == (
        pytest.approx(crossing["samples"]),
        pytest.approx(crossing["samples"]),
        1.0,
    )
    assert found["controllers"]["b"]["cost"] == pytest.approx(np.exp([0.4, 0.2, -0.2, -0.3]))


def test_the_interval_covers_the_crossing_of_plants_that_differ():
    """90 % over 60 panels of 20 plants: 0.04 is a standard deviation."""
    held = []
    for seed in range(60):
        own = 0.3 * np.random.default_rng(seed).standard_normal(20)
        panel = [{"a": np.zeros(20), "b": level + own} for level in (0.4, 0.2, -0.2, -0.4)]
        crossing = curves(panel, SAMPLES, ("a", "b"), seed=1)["crossing"]
        if crossing["low"] is not None:
            held.append(crossing["low"] <= 200 * np.sqrt(2) <= crossing["high"])
    assert len(held) > 55 and abs(np.mean(held) - 0.9) < 0.1


def test_without_a_change_or_beyond_the_record_nothing_is_said():
    never = curves(costs((0, 0, 0, 0), (0.4, 0.3, 0.2, 0.1)), SAMPLES, ("a", "b"), seed=1)["crossing"]
    assert never == {"samples": None, "low": None, "high": None, "share": 0.0}
    # half of the plants never cross: the interval has no end within the record
    halves = np.repeat([0.0, 0.5], 4)
    panel = [{"a": FLAT, "b": level + halves} for level in (0.4, 0.2, -0.2, -0.3)]
    open_ended = curves(panel, SAMPLES, ("a", "b"), seed=1)["crossing"]
    assert open_ended["samples"] is not None and open_ended["low"] is None and open_ended["share"] < 0.95


def test_one_that_could_not_be_learned_has_no_cost_at_that_length():
    found = curves(costs((0.5, 0, 0, 0), (None, 0.2, -0.2, -0.3)), SAMPLES, ("a", "b"), seed=1)
    assert found["controllers"]["b"]["cost"][0] is None and found["controllers"]["b"]["low"][0] is None
    assert found["crossing"]["samples"] == pytest.approx(200 * np.sqrt(2))
    alone = curves(costs((0, 0, 0, 0), (None, None, None, 0.1)), SAMPLES, ("a", "b"), seed=1)
    assert alone["crossing"] is None
