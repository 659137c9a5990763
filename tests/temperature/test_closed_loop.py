"""Feedback in a record: recognised where it is, not called where it is not, and handled."""

import tracemalloc

import numpy as np
import pytest

from pipeline.temperature.identification.closed_loop import closed_loop
from pipeline.temperature.identification.model_choice import Settings, identify


def heater(kind, seed, T=1500):
    """One heater of gain 2 and 60 samples under a PI, or a plan of steps, or steps with feed-through 0.5."""
    rng, x, integral = np.random.default_rng(seed), 0.0, 0.0
    u, y = np.empty((T, 1)), np.empty((T, 1))
    plan = np.repeat(rng.uniform(10, 60, T // 50 + 1), 50)
    for t in range(T):
        direct = 0.5 * plan[t] if kind == "direct" else 0.0
        y[t] = x + direct + 0.1 * rng.standard_normal()
        e = 1.5 * plan[t] - y[t, 0]
        integral += 0.02 * e
        u[t] = e + integral if kind == "pi" else plan[t]
        x += (2.0 * u[t, 0] - x) / 60
    return [u], [y]


@pytest.mark.parametrize("seed", range(5))
def test_a_pi_loop_is_recognised_and_a_plan_is_not_called_one(seed):
    assert closed_loop(*heater("pi", seed), 10).closed
    assert not closed_loop(*heater("steps", seed), 10).closed


@pytest.mark.parametrize("seed", range(5))
def test_feed_through_is_not_taken_for_feedback(seed):
    assert not closed_loop(*heater("direct", seed), 10).closed


@pytest.mark.parametrize(("kind", "closed"), [("pi", True), ("steps", False)])
def test_of_a_long_record_stretches_are_tested_and_memory_does_not_grow_with_it(kind, closed):
    u, y = heater(kind, 1, 120_000)
    peak = {}
    for rows in (60_000, 120_000):
        tracemalloc.start()
        assert closed_loop([u[0][:rows]], [y[0][:rows]], 20).closed == closed
        peak[rows] = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak[120_000] < 1.5 * peak[60_000]


def test_only_inputs_are_tested_for_feedback_not_measured_disturbances():
    u, y = heater("pi", 1)
    plan = np.random.default_rng(0).standard_normal(u[0].shape)
    assert closed_loop([np.hstack([plan, u[0]])], y, 10).closed
    assert not closed_loop([np.hstack([plan, u[0]])], y, 10, inputs=1).closed


def test_a_closed_loop_record_gets_no_feed_through_no_simulation_fit_and_a_sentence():
    chosen = identify(*heater("pi", 2), sample_time_s=1.0, settings=Settings(refinement="validated"))
    assert chosen.feedback.closed
    assert chosen.feedthrough == (False,)
    assert {row.fit for row in chosen.order_table} <= {"subspace", "prediction"}
    assert any("closed loop" in note for note in chosen.notes)
    gain = chosen.plant.C @ np.linalg.solve(np.eye(chosen.plant.n) - chosen.plant.A, chosen.plant.B)
    # 1,500 samples of a loop that hides the plant: 10 %, the controller's inverse has the other sign
    assert gain[0, 0] == pytest.approx(2.0, rel=0.1)
