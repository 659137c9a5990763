"""From frames to a setpoint: what holds and why, limits that no action passes,
and the wait and window that measurements ask for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from pipeline.setpoint.deployment.deployment import camera_seen, judge_window, why
from pipeline.setpoint.simulation.actuation import (
    ACTS,
    FEW,
    FOREIGN,
    REASONS,
    STILL,
    TIP,
    UNPROVEN,
    SetpointLimits,
    Waits,
    at_rest,
    decide,
    moved,
    setpoints,
    still,
    wait_after,
)
from pipeline.setpoint.simulation.simulator import Action, SetpointController
from pipeline.setpoint.vision.window_flow import WindowFlow

LIMITS = SetpointLimits(
    np.array([20.0, 180.0]), np.array([310.0, 240.0]), np.array([10.0, 20.0]), np.array([60.0, 30.0])
)
UNDER = np.array([0.9, 0.08, 0.02])


def under(counts: np.ndarray) -> WindowFlow:
    """80 % of flow in windows in which a frame counts."""
    some = counts.any(axis=1)
    prob = np.where(some[:, None], UNDER, 1 / 3)
    return WindowFlow(np.where(some, 80.0, np.nan), np.where(some, 0.07, np.nan), prob)


RULES = {"flows": under, "least_frames": 8, "foreign_above": 5.0}


def one(p=UNDER, frames=20, valid=20, foreign=0, moved=False, **rules):
    """One window of equal frames, the first `valid` of them valid, the first
    `foreign` of them with a score beyond the limit."""
    P, ok, score = np.tile(p, (1, frames, 1)), np.zeros((1, frames), bool), np.ones((1, frames))
    ok[:, :valid], score[:, :foreign] = True, 9.0
    return judge_window(P, ok, score, np.array([moved]), **{**RULES, **rules})


# ---- what holds


anything = st.floats(allow_nan=True, allow_infinity=True, width=64)


@settings(max_examples=100)
@given(st.data())
def test_whatever_arrives_the_shares_are_a_distribution_and_an_action_rests_on_enough_proper_frames(data):
    E, W = data.draw(st.integers(1, 4)), data.draw(st.integers(0, 12))
    P = data.draw(
        arrays.arrays(float, (E, W, 3), elements=st.one_of(anything, st.sampled_from([0.0, 1.0, 1 / 3])))
    )
    proper = data.draw(arrays.arrays(bool, (E, W)))
    P[proper] = UNDER
    valid, score = (
        data.draw(arrays.arrays(bool, (E, W))),
        data.draw(arrays.arrays(float, (E, W), elements=anything)),
    )
    tip = data.draw(arrays.arrays(bool, E))
    got = judge_window(P, valid, score, tip, **RULES)
    np.testing.assert_allclose(got.p.sum(axis=1), 1.0, atol=1e-12)  # rounding of three shares
    assert (got.p >= 0).all()
    may = (np.isfinite(P).all(axis=2) & valid & (score <= 5.0)).sum(axis=1) >= 8
    assert not ((got.reason == ACTS) & (~may | tip)).any()


def test_twenty_frames_by_hand():
    P = np.tile(UNDER, (1, 20, 1))
    P[0, 15:] = [0.1, 0.8, 0.1]
    got = judge_window(P, np.ones((1, 20), bool), np.ones((1, 20)), np.array([False]), **RULES)
    np.testing.assert_array_equal(got.p[0], UNDER)
    assert (got.flow_seen[0], got.spread[0]) == (80.0, 0.07)
    assert (got.label[0], got.used[0], got.reason[0]) == (0, 20, ACTS)


@pytest.mark.parametrize(
    ("window", "reason"),
    [
        ({}, ACTS),
        ({"valid": 8}, ACTS),
        ({"valid": 7}, FEW),
        ({"frames": 0, "valid": 0}, FEW),
        ({"p": np.full(3, np.nan)}, FEW),
        ({"p": np.array([2.0, -0.5, -0.5])}, FEW),
        ({"foreign": 12}, ACTS),
        ({"foreign": 13}, FOREIGN),
        ({"moved": True}, TIP),
    ],
    ids=["sound", "just enough", "one too few", "empty", "NaN", "no distribution", "some odd", "odd", "tip"],
)
def test_a_window_is_held_for_its_own_reason(window, reason):
    assert one(**window).reason[0] == reason, REASONS[reason]


def test_windows_do_not_see_each_other():
    rng = np.random.default_rng(0)
    P, valid, score = (
        rng.dirichlet(np.ones(3), (6, 20)),
        rng.random((6, 20)) < 0.6,
        rng.exponential(3.0, (6, 20)),
    )
    tip = rng.random(6) < 0.3
    together = judge_window(P, valid, score, tip, **RULES)
    for i in range(6):
        alone = judge_window(P[i : i + 1], valid[i : i + 1], score[i : i + 1], tip[i : i + 1], **RULES)
        for a, b in zip(alone, together, strict=True):
            np.testing.assert_array_equal(a[0], b[i])


def test_windows_of_the_wrong_shape_are_refused():
    with pytest.raises(
        ValueError,
        match=r"expected probabilities \(E, W, 3\), .* found \(20, 3\), \(20,\), .*; give one row a window",
    ):
        judge_window(np.ones((20, 3)) / 3, np.ones(20, bool), np.ones(20), np.array([False]), **RULES)
    with pytest.raises(ValueError, match="least_frames of at least 1, found 0; an empty window says nothing"):
        one(least_frames=0)


# ---- limits


@settings(max_examples=100)
@given(st.data())
def test_no_sequence_of_actions_leaves_the_box_or_passes_the_slew_of_an_action_or_of_any_minute(data):
    n = data.draw(st.integers(1, 25))
    start = np.array([[data.draw(st.floats(20, 310)), data.draw(st.floats(180, 240))]])
    changes = data.draw(
        arrays.arrays(
            float, (n, 1, 2), elements=st.one_of(anything, st.sampled_from([-10.0, 10.0, 20.0, -300.0]))
        )
    )
    times = np.cumsum(data.draw(arrays.arrays(float, n, elements=st.floats(0, 40))))
    state, sent = setpoints(start, LIMITS), []
    for change, time in zip(changes, times, strict=True):
        after = moved(state, change, np.array([time]), LIMITS)
        sent.append((after.value - state.value)[0])
        assert ((after.value >= LIMITS.low) & (after.value <= LIMITS.high)).all()
        asked_and_sent = np.array_equal(after.value - state.value, change) or np.allclose(
            after.value - state.value, change, atol=1e-9
        )
        assert asked_and_sent or (after.clipped > state.clipped).any()  # what was cut is counted
        state = after
    sent = np.abs(sent)
    assert (sent <= LIMITS.per_action + 1e-9).all()  # rounding of value - value
    for i in range(n):
        assert (
            sent[(times > times[i] - 60) & (times <= times[i])][: n - i].sum(axis=0)
            <= LIMITS.per_minute + 1e-9
        ).all()


def test_limits_by_hand():
    state = setpoints(np.array([[300.0, 210.0], [100.0, 210.0]]), LIMITS)
    for i in range(7):
        state = moved(
            state,
            np.array([[25.0, 0.0], [-10.0, np.nan if i == 0 else 0.0]]),
            np.array([7.0 * i, 7.0 * i]),
            LIMITS,
        )
    np.testing.assert_array_equal(state.value, [[310.0, 210.0], [40.0, 210.0]])
    # first: each of 7 is cut to one action, 6 meet the box. second: the first is no number, six of -10 use
    # the 60 of a minute up, none is cut
    np.testing.assert_array_equal(state.clipped, [[7, 0, 6, 0], [0, 0, 0, 1]])
    state = moved(state, np.array([[0.0, 0.0], [-10.0, 0.0]]), np.array([49.0, 49.0]), LIMITS)
    np.testing.assert_array_equal(state.clipped[1], [0, 1, 0, 1])
    state = moved(
        state, np.array([[0.0, 0.0], [-10.0, 0.0]]), np.array([67.0, 67.0]), LIMITS
    )  # the move at 7 s is a minute old
    np.testing.assert_array_equal(state.value[1], [30.0, 210.0])
    assert len(REASONS) == STILL + 1


def test_a_start_outside_the_box_is_refused():
    with pytest.raises(
        ValueError,
        match=(
            r"expected a start within \[ 20. 180.\] to \[310. 240.\] .* found \[330. 210.\]; bring the "
            r"machine there by hand"
        ),
    ):
        setpoints(np.array([[100.0, 210.0], [330.0, 210.0]]), LIMITS)


# ---- wait and window


def test_the_wait_is_the_longest_that_any_move_asks_for():
    change = np.array([[0.0, 0.0], [5.0, 0.0], [0.0, -10.0], [-5.0, 20.0]])
    np.testing.assert_array_equal(wait_after(change, Waits(3.0, 8.0, 0.5)), [0.5, 3.0, 8.0, 8.0])
    np.testing.assert_array_equal(wait_after(change, Waits(6.0, 6.0, 6.0)), 6.0)  # as published


# ---- why it acted


def test_the_strip_says_what_was_seen_and_why_it_was_held():
    assert (
        why(12.5, one(), 0, np.array([10.0, 0.0]))
        == "  12.5 s: 20 frames valid, 20 count, flow 80 %, under 0.90; flow +10 %"
    )
    assert why(0.0, one(), 0, np.zeros(2)).endswith("no change")
    assert why(3.0, one(valid=3), 0, np.zeros(2)).endswith("score 1; held: too few valid frames")


# ---- windows that show flows, and cameras that do not look


def test_a_window_that_shows_a_flow_is_not_held_for_two_classes():
    def flows(counts):
        assert counts.shape == (1, 20)
        return np.array([91.0]), np.array([0.07]), np.array([[0.44, 0.55, 0.01]])

    got = one(p=np.array([0.5, 0.49, 0.01]), flows=flows)
    assert (got.reason[0], got.label[0]) == (ACTS, 1)
    assert (got.flow_seen[0], got.spread[0]) == (91.0, 0.07)
    assert one(valid=3, flows=lambda counts: flows(counts)).reason[0] == FEW
    assert "flow 91 %" in why(0.0, got, 0, np.zeros(2))


def test_a_camera_that_repeats_its_reading_to_the_last_bit_stands_still():
    seen = np.array([91.0, 91.0, np.nan, 91.0])
    np.testing.assert_array_equal(
        still(seen, np.array([91.0, 91.0001, np.nan, np.nan])), [STILL, ACTS, ACTS, ACTS]
    )
    assert REASONS[STILL] == "the picture stands still"


@pytest.mark.parametrize(
    ("reason", "remembers"), [(ACTS, True), (UNPROVEN, False), (FEW, False), (STILL, False)]
)
def test_a_controller_remembers_the_windows_that_are_not_held(reason, remembers):
    counts = SetpointController(
        lambda: jnp.int32(0),
        lambda parameters, memory, observation, key: (memory + 1, Action(jnp.int32(0), jnp.int32(0))),
    )
    memory, _ = decide(counts, (), jnp.int32(3), None, jnp.int32(reason), jax.random.key(0))
    assert int(memory) == (4 if remembers else 3)


def test_a_window_of_no_known_camera_is_held_and_keeps_a_reason_that_it_has():
    """Of five windows the first is familiar, the second foreign, the third both foreign and still, the fourth
    was held before, of the fifth no frame was measured."""
    window = judge_window(
        np.tile(UNDER, (5, 20, 1)), np.ones((5, 20), bool), np.zeros((5, 20)), np.arange(5) == 3, **RULES
    )._replace(flow_seen=np.array([90.0, 91.0, 92.0, 93.0, 94.0]))
    last = np.array([np.nan, 90.0, 92.0, np.nan, np.nan])
    looks = np.array([[0.0], [9.0], [9.0], [9.0], [np.nan]])
    seen = camera_seen(window, last, looks, lambda looks: looks[:, 0] > 5)
    assert seen.reason.tolist() == [ACTS, FOREIGN, STILL, TIP, ACTS]
    assert camera_seen(window, last, looks, None).reason.tolist() == [UNPROVEN] * 5


def test_jax_and_numpy_take_the_same_limits():
    rng = np.random.default_rng(0)
    lead = setpoints(np.tile([100.0, 210.0], (3, 1)), LIMITS)
    other = at_rest(jnp.asarray(lead.value, jnp.float32), remembered=64)
    for t in range(12):
        change = rng.choice([-10.0, -5.0, 0.0, 5.0, 10.0, np.nan], (3, 2))
        lead = moved(lead, change, np.full(3, 7.0 * t), LIMITS)
        other = moved(other, jnp.asarray(change, jnp.float32), jnp.full(3, 7.0 * t), LIMITS)
        np.testing.assert_allclose(other.value, lead.value, rtol=1e-6)
    np.testing.assert_array_equal(other.clipped, lead.clipped)


def test_no_move_is_sent_while_more_lie_within_the_minute_than_are_remembered():
    state = at_rest(np.array([100.0, 210.0]), remembered=3)
    wide = LIMITS._replace(per_minute=np.array([1e6, 1e6]))
    for t in range(5):
        state = moved(state, np.array([5.0, 0.0]), np.array(float(t)), wide)
    assert state.value[0] == 115.0
    assert state.clipped[1] == 2
    assert moved(state, np.array([5.0, 0.0]), np.array(70.0), wide).value[0] == 120.0
