"""The paper's simulator and reward against their printed values and by hand, a clog in mid-episode, and
windows drawn again from a record."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from pipeline.setpoint.simulation.recorded import WindowTable, recorded_windows
from pipeline.setpoint.simulation.simulator import (
    FLOW_MOVES,
    GOOD,
    OVER,
    TEMPERATURE_MOVES,
    Action,
    Observation,
    SetpointController,
    first_history,
    flow_class,
    nominal,
    paper_state,
    paper_windows,
    remembered,
    reward,
    rollout,
)
from tests.setpoint.synthetic import synthetic_flow_table, synthetic_table

STEPS, N = 30, 2000  # one shape, so that everything runs in one compiled program


def scripted() -> SetpointController:
    """Moves that its parameters (T, 2) say, whatever it sees; its memory counts."""

    def act(moves, t, observation, key):
        return t + 1, Action(moves[t, 0], moves[t, 1])

    return SetpointController(lambda: jnp.zeros((), jnp.int32), act)


SCRIPTED = scripted()


def machine(flow, temperature, *, accuracy=1.0, **changes):
    """N episodes, their starts taken in turn."""
    conditions = nominal(np.resize(flow, N), np.resize(temperature, N), accuracy=accuracy)
    return conditions._replace(**{name: jnp.full(N, value, jnp.float32) for name, value in changes.items()})


def played(moves, conditions, windows=None, seed=0):
    """The trajectory of moves (T, 2), indices, as numpy arrays."""
    return jax.tree.map(
        np.asarray,
        rollout(
            SCRIPTED,
            jnp.asarray(moves),
            windows or paper_windows(),
            conditions,
            jax.random.key(seed),
            steps=len(moves),
        ),
    )


def standing():
    return np.full((STEPS, 2), 2)


# ---- reward


@pytest.mark.parametrize(
    ("flow", "temperature", "a", "b", "printed"),
    [
        (110, 205, 40, 20, 0.394),
        (110, 215, 40, 20, 0.285),
        (105, 210, 20, 10, 0.3536),
        (200, 210, 20, 10, -0.8104),
    ],
)
def test_the_reward_has_its_check_values(flow, temperature, a, b, printed):
    assert float(reward(flow, temperature, a=a, b=b)) == pytest.approx(
        printed, abs=6e-4 if abs(printed) < 0.395 and printed != 0.3536 else 6e-5
    )  # printed digits


def test_the_reward_is_highest_at_its_centre_and_the_same_on_opposite_sides():
    assert float(reward(100.0, 210.0, a=20, b=10)) == 1.0
    d = np.random.default_rng(0).normal(0, 30, (2, 200))
    one, other = (np.asarray(reward(100 + s * d[0], 210 + s * d[1], a=40, b=10)) for s in (1, -1))
    np.testing.assert_allclose(one, other, atol=1e-5)  # float32
    assert (one < 1).all()
    assert (one > -1).all()


# ---- the paper's simulator


def test_the_temperature_follows_its_target_by_a_fifth_and_the_target_moves_at_every_tenth_decision_only():
    moves = standing()
    moves[:, 1] = 3  # + 10 degC, asked at every decision
    run = played(moves, machine(100.0, 190.0))
    np.testing.assert_array_equal(run.target[0], [190.0] + [200.0] * 10 + [210.0] * 10 + [220.0] * 10)
    u_hat = [190.0]
    for target in run.target[0, 1:]:
        u_hat.append(u_hat[-1] + (target - u_hat[-1]) / 5)
    np.testing.assert_allclose(run.temperature[0], u_hat, atol=1e-3)  # float32 at 200


def test_the_flow_moves_at_once_and_setpoints_stay_in_their_limits():
    rng = np.random.default_rng(0)
    moves = np.stack([rng.integers(0, 5, STEPS), rng.integers(0, 5, STEPS)], axis=1)
    run = played(moves, machine([30.0, 300.0], [190.0, 230.0]))
    for k, start in enumerate((30.0, 300.0)):
        flow, target = start, (190.0, 230.0)[k]
        for t, (q, u) in enumerate(moves):
            flow = min(max(flow + FLOW_MOVES[q], 20.0), 310.0)
            target = min(max(target + TEMPERATURE_MOVES[u], 180.0), 240.0) if t % 10 == 0 else target
            assert run.flow[k, t + 1] == flow
            assert run.target[k, t + 1] == target


def test_classes_include_both_borders_of_the_good_band():
    np.testing.assert_array_equal(
        flow_class(jnp.array([20.0, 89.9, 90.0, 100.0, 110.0, 110.1])), [0, 0, 1, 1, 1, 2]
    )


def test_windows_are_right_as_often_as_their_accuracy_and_wrong_ones_share_alike():
    run = played(standing(), machine(60.0, 210.0, accuracy=0.7))
    share = np.bincount(run.named.ravel(), minlength=3) / run.named.size
    np.testing.assert_allclose(
        share, [0.7, 0.15, 0.15], atol=4 * np.sqrt(0.21 / run.named.size)
    )  # four deviations of 60,000 draws


def test_shares_are_clipped_noisy_decays_from_the_class():
    run = played(standing(), machine(60.0, 210.0))
    p_hat = run.shares / run.shares.max(axis=2, keepdims=True)
    assert (run.named == 0).all()
    assert (p_hat[..., 0] == 1).all()
    np.testing.assert_allclose(run.shares.sum(axis=2), 1.0, atol=1e-6)  # float32
    draws = np.random.default_rng(0).normal(0, 0.15, 10**6)
    for i in (1, 2):
        expected = np.clip(np.exp(-1.5 * i) + draws, 0, 1)
        # four deviations of 60,000 draws of deviation 0.15
        assert p_hat[..., i].mean() == pytest.approx(expected.mean(), abs=2.5e-3)
        assert p_hat[..., i].std() == pytest.approx(expected.std(), abs=2.5e-3)
    assert abs(np.corrcoef(p_hat[..., 1].ravel(), p_hat[..., 2].ravel())[0, 1]) < 4 / np.sqrt(60_000)


def test_the_paper_s_state_is_thirty_classes_three_shares_and_two_temperatures():
    history = first_history()
    for named in (2, 0):
        history = remembered(history, jnp.array(named))
    seen = Observation(
        jnp.array([0.5, 0.3, 0.2]),
        jnp.array(0),
        jnp.array(jnp.nan),
        jnp.array(0.0),
        jnp.array(205.0),
        jnp.array(210.0),
        jnp.array(2),
    )
    np.testing.assert_allclose(
        paper_state(history, seen), [1 / 3] * 28 + [2 / 3, 0, 1, 0.6, 0.4, 205, 210], rtol=1e-6
    )  # float32


def test_the_same_key_gives_the_same_bytes_and_another_key_others():
    conditions = machine([60.0, 200.0], 210.0, accuracy=0.7)
    one, same, other = (played(standing(), conditions, seed=seed) for seed in (0, 0, 1))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(same), strict=True):
        assert a.tobytes() == b.tobytes()
    assert (one.shares != other.shares).any()


# ---- what befalls the machine


def test_a_clog_scales_the_flow_from_its_step_on():
    moves = standing()
    moves[12:, 0] = 4
    clogged = played(moves, machine(100.0, 210.0, clog=0.6, clog_step=10))
    np.testing.assert_allclose(clogged.flow[0, :11], [100.0] * 10 + [60.0], rtol=1e-6)
    np.testing.assert_allclose(clogged.flow[0, 13:], 60 + 6 * np.arange(1, 19), rtol=1e-6)


# ---- recorded windows


def test_a_drawn_window_is_one_of_its_flow_bin_and_all_of_them_come():
    table = synthetic_table(np.random.default_rng(0), segments=4, windows=3)
    run = played(standing(), machine(101.0, 210.0), recorded_windows(table))
    here = table.flow_bin == np.searchsorted(table.flow_edges, 101.0, side="right") - 1
    drawn = {tuple(row) for row in run.shares.reshape(-1, 3)}
    assert drawn == {tuple(row) for row in np.asarray(table.shares[here], np.float32)}


def drawn_flows(table, flow, u):
    """shares, named and flow_seen of windows drawn at a flow by u (n, 4): three of a window, its segment."""
    windows, conditions = recorded_windows(table), nominal(flow, 210.0, accuracy=1.0)
    return jax.vmap(lambda one: windows.draw(windows.table, conditions, jnp.float32(flow), one[3], one[:3]))(
        jnp.asarray(u, jnp.float32)
    )


def test_windows_that_show_flows_err_as_the_table_s_segments_and_windows_do():
    table = synthetic_flow_table(
        np.random.default_rng(0), segments=600, windows=8, segment_std=0.06, window_std=0.03
    )
    u = np.random.default_rng(1).random((4000, 4))
    shares, named, seen = drawn_flows(table, 101.0, u)
    error = np.log(np.asarray(seen) / 101.0)
    assert error.std() == pytest.approx(np.hypot(0.06, 0.03), rel=0.1)
    u[:, 3] = 0.9  # one segment, of the upper tenth: its bias stays, its windows differ
    _, _, one = drawn_flows(table, 101.0, u)
    error = np.log(np.asarray(one) / 101.0)
    assert error.std() == pytest.approx(0.03, rel=0.2)  # 40 windows: 11 %
    # the camera's mean error about 101 % is of some 45 segments: 0.9 %, and the quantile of as many
    assert error.mean() == pytest.approx(0.06 * scipy.stats.norm.ppf(0.9), abs=0.03)
    assert len(np.unique(one)) > 3900  # a window drawn twice is no picture that stands still
    # the shares are those of N(log flow_seen, spread^2) between 90 and 110 %
    spread = float(table.spread[0])
    under = scipy.stats.norm.cdf((np.log(90) - np.log(np.asarray(seen))) / spread)
    over = scipy.stats.norm.sf((np.log(110) - np.log(np.asarray(seen))) / spread)
    np.testing.assert_allclose(np.asarray(shares)[:, [0, 2]], np.stack([under, over], axis=1), atol=1e-5)
    np.testing.assert_array_equal(named, np.asarray(shares).argmax(axis=1))


def test_a_table_with_some_flows_only_is_refused():
    table = synthetic_flow_table(np.random.default_rng(0), segments=200, windows=1)
    seen = table.flow_seen.copy()
    seen[3] = np.nan
    with pytest.raises(ValueError, match="expected flow_seen, spread and flow of all 200 windows.*found 199"):
        recorded_windows(table._replace(flow_seen=seen))


@pytest.mark.parametrize("with_flows", [False, True])
def test_a_sticky_segment_keeps_its_look_when_the_flow_moves_to_another_bin(with_flows):
    # in both bins segment 7 always looks thin and segment 3 always thick: what shows flows shows them
    # exp(2) times too small or too large, so that none is taken for good or for the other
    flow = np.array([60.0, 60.0, 140.0, 140.0])
    shown = (flow * np.exp([-2.0, 2.0, -2.0, 2.0]), np.full(4, 0.07), flow)
    table = WindowTable(
        np.array([[0.8, 0.2, 0.0], [0.0, 0.2, 0.8]] * 2),
        np.array([0, 2, 0, 2]),
        np.array([0, 0, 1, 1]),
        np.array([7, 3, 7, 3]),
        np.array([20.0, 100.0, 310.0]),
        *(shown if with_flows else ()),
    )
    moves = standing()
    moves[:, 0] = 4
    windows = recorded_windows(table)
    changed = np.diff(played(moves, machine(50.0, 210.0, persistence=10), windows).named, axis=1) != 0
    assert changed.mean() == pytest.approx(
        0.5 / 10, abs=0.004
    )  # a new segment in one of ten decisions, and half of those look alike; four deviations
    fresh = np.diff(played(moves, machine(50.0, 210.0), windows).named, axis=1) != 0
    assert fresh.mean() == pytest.approx(0.5, abs=0.01)


def test_the_synthetic_table_errs_as_real_classifiers_do():
    table = synthetic_table(np.random.default_rng(1), segments=60, windows=20)
    low, high = table.flow_edges[table.flow_bin], table.flow_edges[table.flow_bin + 1]
    true = np.where(high <= 90, 0, np.where(low >= 110, 2, 1))
    right = table.named == true
    assert 0.28 < right[(low >= 80) & (high <= 90)].mean() < 0.48  # 38 % on the trial's classifier
    assert right[(low >= 95) & (high <= 105)].mean() > 0.95
    assert np.abs(table.named - true).max() == 1  # under and over are never swapped
    border = (low >= 80) & (high <= 90)
    by_segment = [
        right[border & (table.segment == s) & (table.flow_bin == b)].mean()
        for s in range(60)
        for b in np.unique(table.flow_bin[border])
    ]
    assert np.std(by_segment) > 2 * np.sqrt(
        0.25 / 20
    )  # errors persist: independent ones would scatter the means of 20 by half of that


def spoilt(**fields):
    return synthetic_table(np.random.default_rng(0), segments=2, windows=2)._replace(**fields)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (
            spoilt(named=np.zeros(3, int)),
            r"expected shares \(n, 3\) and as many classes, flow bins and segments, found \(188, 3\), 3, "
            r"188, 188; record them in one go",
        ),
        (
            spoilt(shares=np.full((188, 3), 0.5)),
            r"expected shares from 0 to 1 with sum 1, found others; "
            r"normalise each window's shares over its classes",
        ),
        (spoilt(shares=np.full((188, 3), np.nan)), r"expected shares from 0 to 1 with sum 1"),
        (
            spoilt(flow_bin=np.zeros(188, int)),
            r"no window for flows from 30 to 40 % \(46 empty bins\); record them, or widen the bins",
        ),
        (spoilt(flow_bin=np.arange(188)), r"expected flow bins 0 to 46, found 0 to 187"),
        (
            spoilt(flow_edges=np.linspace(310, 20, 48)),
            r"expected rising flow edges, found some that fall; sort the bins",
        ),
    ],
)
def test_a_table_that_cannot_be_drawn_from_is_refused(table, message):
    with pytest.raises(ValueError, match=message):
        recorded_windows(table)


# ---- as deployed


def up_by(index, at):
    moves = standing()
    moves[at, 0] = index
    return moves


@pytest.mark.parametrize("wait_s, named", [(3.0, GOOD), (6.0, OVER)])
def test_a_picture_that_comes_early_shows_the_line_of_before_the_move(wait_s, named):
    """A move from 105 to 115 %: after 3.5 s half of what a picture shows was laid since, 110 %; after 6.5 s
    all but a tenth."""
    run = played(up_by(4, 0), machine(105.0, 210.0, wait_s=wait_s, view_s=7.0))
    np.testing.assert_allclose(run.flow[0, 1:5], 115.0)
    assert run.named[0, 1] == named and run.named[0, 2] == OVER


def test_the_travel_of_a_minute_is_limited_as_in_the_loop_through_pixels():
    """Moves of 10 at every decision of 4 s: ten are sent, then none until the first is a minute old."""
    moves = standing()
    moves[:, 0] = 4
    run = played(moves, machine(20.0, 210.0, wait_s=3.0))
    sent = np.diff(run.flow[0])
    np.testing.assert_allclose(sent[:15], [10.0] * 10 + [0.0] * 5, atol=1e-4)
    np.testing.assert_allclose(sent[15:25], 10.0, atol=1e-4)
