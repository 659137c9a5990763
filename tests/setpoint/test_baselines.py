"""Controllers without learning: moves by hand, the Bayes filter against brute force,
and the trial's figures on the paper's simulator."""

import itertools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from pipeline.setpoint.agents import agent, bayes, camera_watch, trials
from pipeline.setpoint.agents.baselines import (
    Proportional,
    SequentialTest,
    nearest,
    nothing,
    proportional,
    sequential_test,
    temperature_move,
)
from pipeline.setpoint.evaluation import judging
from pipeline.setpoint.published import FLOW_MOVES, TEMPERATURE_MOVES
from pipeline.setpoint.simulation.recorded import recorded_windows
from pipeline.setpoint.simulation.simulator import FLOW_LIMITS, STAND, Observation, nominal, paper_windows
from tests.setpoint.synthetic import synthetic_flow_table, synthetic_table

KEY = jax.random.key(0)
PURE = {0: [0.76, 0.17, 0.07], 1: [0.15, 0.7, 0.15], 2: [0.07, 0.17, 0.76]}  # the mean window of each class
ROBUST = bayes.CameraErrorModel(
    accuracies=[0.7, 0.97],
    gains=[1.0, 0.65],
    width_bias_levels=5,
    width_bias_std=0.055,
    floor=0.03,
    smoothing=4.0,
    segment_mean_decisions=12.0,
    mode_switch_probability=3e-4,
    window_repeat_probability=0.3,
    hazard=6e-4,
    move_cost=0.38,
    outside_cost=5.0,
)
WIDE = jnp.asarray(bayes.PRIOR, jnp.float32)
EXACT = {"accuracy": 0.7, "hazard": 0.0, "move_cost": 0.0, "outside_cost": 0.0}


def seen(named, *, shares=None, move=0.0, target=210.0, step=0):
    return Observation(
        jnp.array(shares or PURE[named]),
        jnp.array(named),
        jnp.array(jnp.nan),
        jnp.array(move),
        jnp.array(target),
        jnp.array(target),
        jnp.array(step),
    )


def moves(controller, parameters, classes):
    """The flow moves in percent that answer these classes, one after the other."""
    act, memory, answers, move = jax.jit(controller.act), controller.start(), [], 0.0
    for t, named in enumerate(classes):
        memory, action = act(parameters, memory, seen(named, move=move, step=t), KEY)
        move = FLOW_MOVES[int(action.flow)]
        answers.append(move)
    return answers


@pytest.fixture(scope="module")
def table():
    return synthetic_table(np.random.default_rng(100), segments=30, windows=10)


# ---- moves by hand


def test_the_temperature_goes_to_210_by_the_largest_steps_and_rests_there():
    answers = {
        target: TEMPERATURE_MOVES[int(temperature_move(seen(1, target=target)))]
        for target in (180.0, 190.0, 198.0, 204.0, 206.0, 210.0, 213.3, 215.0, 230.0)
    }
    assert answers == {
        180.0: 20,
        190.0: 20,
        198.0: 10,
        204.0: 10,
        206.0: 0,
        210.0: 0,
        213.3: 0,
        215.0: 0,
        230.0: -20,
    }


def test_of_two_moves_as_near_the_smaller_is_taken():
    assert [
        FLOW_MOVES[int(nearest(FLOW_MOVES, wanted))]
        for wanted in (-30.0, -7.6, -7.5, -2.5, 2.4, 2.6, 7.5, 8.0)
    ] == [-10, -10, -5, 0, 0, 5, 5, 10]


def test_proportional_moves_by_its_gain_times_the_difference_and_filtered_it_waits():
    assert moves(proportional(), Proportional(gain=10.0, time_constant=1.0), [0, 1, 2]) == [
        5,
        0,
        -5,
    ]  # 6.9, 0, -6.9
    # y = 0.69 (1 - 0.75^k) reaches 0.25 at k = 2 and 5 % follows; what is kept of it is 0.75 of y
    assert moves(proportional(), Proportional(gain=10.0, time_constant=4.0), [0, 0, 0]) == [0, 5, 5]


def test_the_sequential_test_moves_when_one_class_leads_good_by_its_threshold():
    parameters = SequentialTest(
        accuracy=0.7, threshold=3.0, cap=4.7
    )  # log (0.7 / 0.15) = 1.54 a window: two to move, three to the cap
    assert moves(sequential_test(), parameters, [0, 0, 0, 1, 1, 1]) == [0, 10, 10, 10, 0, 0]
    assert moves(sequential_test(), parameters, [2, 1, 2, 2]) == [0, 0, 0, -10]
    assert moves(sequential_test(), parameters, [1] * 50 + [0] * 5) == [0] * 54 + [
        10
    ]  # the cap lets under come back: three to be level, two to lead


# ---- the Bayes filter


def test_the_exact_filter_is_bayes_rule_over_every_start():
    parameters, controller, update = bayes.class_filter(**EXACT), bayes.bayes(1), jax.jit(bayes.filter_update)
    rng, state = np.random.default_rng(0), controller.start()
    flow, prior = bayes.GRID.copy(), bayes.PRIOR.copy()
    for t in range(12):
        move = float(rng.choice(FLOW_MOVES)) if t else 0.0
        named = int(rng.integers(3))
        flow = np.clip(flow + move, 20, 310)
        true = np.where(flow < 90, 0, np.where(flow > 110, 2, 1))
        prior = prior * np.where(true == named, 0.7, 0.15)
        state = update(parameters, state, seen(named, move=move))
    expected = np.zeros(len(bayes.GRID))
    np.add.at(expected, np.rint((flow - 20) / bayes.SPACING).astype(int), prior / prior.sum())
    np.testing.assert_allclose(state.belief[0], expected, atol=1e-6)  # float32


def test_a_part_of_a_spacing_moves_the_mean_by_as_much_and_loses_nothing():
    belief = jnp.zeros((2, len(bayes.GRID))).at[0, 40].set(0.3).at[1, 50].set(0.7)
    for move in (-6.0, -0.5, 0.0, 1.2, 6.0):
        moved = np.asarray(bayes.predict_shift(belief, jnp.float32(move)))
        np.testing.assert_allclose(moved.sum(axis=1), [0.3, 0.7], rtol=1e-6)
        np.testing.assert_allclose(
            moved @ bayes.GRID / moved.sum(axis=1), bayes.GRID[[40, 50]] + move, rtol=1e-6
        )
    np.testing.assert_allclose(
        np.asarray(bayes.predict_shift(belief, jnp.float32(400.0)))[:, -1], [0.3, 0.7], rtol=1e-6
    )


def test_the_move_is_the_one_with_the_least_expected_loss():
    parameters = bayes.class_filter(accuracy=0.7, hazard=0.0, move_cost=0.4, outside_cost=5.0)
    belief = np.zeros((1, len(bayes.GRID)))
    belief[0, [28, 32]] = 0.75, 0.25  # 90 and 100 %
    # |q + a - 100| + 5 outside + 0.4 |a|: at a = 0 7.5, at + 5 5 + 2, at + 10 2.5 +
    # 4, at - 10 17.5 + 3.75 + 4, at - 5 12.5 + 3.75 + 2
    np.testing.assert_allclose(
        bayes.expected_loss(parameters, jnp.asarray(belief, jnp.float32)),
        [25.25, 18.25, 7.5, 7.0, 6.5],
        rtol=1e-6,
    )


def _beliefs(episodes: int, hypotheses: int) -> jnp.ndarray:
    belief = np.random.default_rng(3).dirichlet(np.full(hypotheses * len(bayes.GRID), 0.3), episodes)
    return jnp.asarray(belief.reshape(episodes, hypotheses, -1), jnp.float32)


def test_a_belief_is_led_on_by_the_same_bytes_however_many_are_with_it():
    """A product of many episodes is cut by the CPU's second cache, and sums what is left in another order."""
    belief, many = _beliefs(800, 18), jax.jit(jax.vmap(bayes.led, (None, 0)))
    transition = jnp.asarray(np.random.default_rng(4).dirichlet(np.ones(18), 18), jnp.float32)
    together = many(transition, belief)
    np.testing.assert_allclose(together, jnp.einsum("kh,ekn->ehn", transition, belief), rtol=1e-5)
    apart = np.concatenate([many(transition, few) for few in np.split(belief, 200)])
    assert np.asarray(together).tobytes() == apart.tobytes()


def test_no_product_of_the_filter_sums_more_terms_than_every_cpu_sums_at_once(table):
    """Of the program of the expected loss, as it is compiled for many episodes."""
    parameters = bayes.robust_filter(table, ROBUST)
    hypotheses = len(parameters.gains)
    many = jax.jit(jax.vmap(bayes.expected_loss, (None, 0, None)))
    text = many.lower(parameters, _beliefs(32, hypotheses), 0.0).compile().as_text()
    shapes = {
        name: [int(n) for n in sizes.split(",") if n]
        for name, sizes in re.findall(r"(\S+?)(?: =|:) \w+\[([\d,]*)\]", text.replace("%", ""))
    }
    products = re.findall(r" dot\(%?(\S+), .*lhs_contracting_dims=\{([\d,]+)\}", text)
    sums = [np.prod([shapes[left][int(axis)] for axis in axes.split(",")]) for left, axes in products]
    assert sums and max(sums) <= agent.SHORT
    # what the products of all hypotheses at once would sum
    assert hypotheses * len(bayes.GRID) > agent.SHORT


def test_evidence_sums_to_one_for_every_flow_and_transitions_for_every_hypothesis(table):
    parameters = bayes.robust_filter(table, ROBUST)
    assert parameters.evidence.shape == (14, bayes.CODES, len(bayes.GRID))
    # codes of classes and of flows are of different cameras; float32
    for block in (slice(0, bayes.CLASS_CODES), slice(bayes.CLASS_CODES, None)):
        np.testing.assert_allclose(parameters.evidence[:, block].sum(axis=1), 1.0, rtol=1e-5)
    np.testing.assert_allclose(parameters.transition.sum(axis=1), 1.0, rtol=1e-6)
    np.testing.assert_allclose(parameters.after_jump.sum(axis=1), 1.0, rtol=1e-6)
    assert float(parameters.evidence.min()) > 0  # nothing is ever ruled out


def test_codes_tell_the_classes_apart_and_rise_with_the_flow():
    all_shares = [
        np.array(p) / sum(p) for p in itertools.product([0.0, 0.1, 0.5, 1.0], repeat=3) if sum(p) > 0
    ]
    for shares, named in itertools.product(all_shares, range(3)):
        assert (
            named * bayes.LEVELS
            <= int(bayes.code(jnp.asarray(shares), jnp.asarray(named), jnp.array(jnp.nan)))
            < (named + 1) * bayes.LEVELS
        )
    leaning = [
        int(bayes.code(jnp.array([a, 0.8, 0.2 - a]), jnp.array(1), jnp.array(jnp.nan)))
        for a in (0.2, 0.15, 0.1, 0.05, 0.0)
    ]
    assert leaning == sorted(leaning)
    assert leaning[0] < leaning[-1]


def test_codes_of_flows_are_aligned_to_the_borders_of_good():
    shares = jnp.full(3, 1 / 3)
    flow = np.array([10.0, 20.5, 60.0, 89.9, 90.1, 100.0, 109.9, 110.1, 150.0, 309.0, 900.0])
    codes = np.array([int(bayes.code(shares, jnp.array(1), jnp.float32(q))) for q in flow])
    assert (np.diff(codes) >= 0).all()
    assert (codes >= bayes.CLASS_CODES).all()
    assert (codes < bayes.CODES).all()
    np.testing.assert_array_equal(bayes.CODE_CLASS[codes], [0, 0, 0, 0, 1, 1, 1, 2, 2, 2, 2])


def test_recorded_evidence_of_flows_is_the_camera_s_own_error_about_each_flow():
    """Segments of 4 %, windows of 6 %: the evidence without a bias spreads by 6 %, by hypothesis it is
    shifted by the segments' 4 %, whatever was declared."""
    table = synthetic_flow_table(
        np.random.default_rng(3), segments=500, windows=8, segment_std=0.04, window_std=0.06
    )
    evidence = bayes.recorded_evidence(
        table, width_bias_std=0.1, width_bias_levels=5, floor=1e-6, smoothing=3.5
    )[:, bayes.CLASS_CODES :]
    middle = np.log(90) + (np.arange(bayes.FLOW_CODES) - bayes.FIRST_GOOD + 0.5) * bayes.FLOW_CODE_WIDTH
    inside = (bayes.GRID > 40) & (bayes.GRID < 200)
    mean = np.einsum("hcn,c->hn", evidence, middle)[:, inside] - np.log(bayes.GRID[inside])
    std = np.sqrt(
        np.einsum("hcn,c->hn", evidence, middle**2)[:, inside]
        - np.einsum("hcn,c->hn", evidence, middle)[:, inside] ** 2
    )
    # bins of 2.5 % and their smoothing add 2.6 % in squares; 60 windows a flow give 0.9 % to a mean
    np.testing.assert_allclose(std[2], np.hypot(0.06, 0.026), atol=0.012)
    z, weight = bayes.bias_levels(5)
    np.testing.assert_allclose(mean.mean(axis=1), z * 0.04, atol=0.008)
    np.testing.assert_array_equal([z.min(), z.max()], [-3.0, 3.0])
    assert weight.sum() == pytest.approx(1.0)
    # beyond two deviations 1 part of 4 in a hundred lies in a normal distribution, and more here
    assert 0.04 < weight[np.abs(z) > 2].sum() < 0.15


def test_a_segment_that_lies_far_off_is_not_taken_for_a_flow_that_changed():
    """Ten quiet windows, then ten of a segment that is 2.4 deviations wider: 60 prints of 60 are left alone
    (of levels that end at 1.5 deviations 8 in 10 are moved); a flow that jumps to 140 % is corrected."""
    table = synthetic_flow_table(np.random.default_rng(5), segments=300, windows=8)
    model = ROBUST._replace(segment_mean_decisions=15.0, width_bias_levels=7, gains=[1.0], border_std=4.0)
    model = model._replace(move_fixed_cost=4.0, outside_cost=20.0, known_start_share=0.7)
    parameters = bayes.robust_filter(table, model)

    @jax.jit
    def moves(line):
        def window(state, flow_seen):
            state = bayes.filter_update(parameters, state, seen_flow(flow_seen))
            return state, jnp.argmin(bayes.expected_loss(parameters, state.belief))

        return jax.lax.scan(window, bayes.initial_state(len(parameters.gains)), line)[1]

    seen = 100 * np.exp(np.random.default_rng(0).normal(0, 0.05, (60, 20)))
    later = np.arange(20) >= 10
    wide, jumped = (
        np.asarray(jax.vmap(moves)(jnp.asarray(seen * np.where(later, flow, 1.0), jnp.float32)))
        for flow in (1.13, 1.4)
    )
    assert (wide != STAND).any(axis=1).mean() <= 0.05
    assert (jumped[:, 13:] < STAND).mean() > 0.95


def test_the_prior_of_the_start_holds_what_is_known_of_the_print():
    prior = bayes.start_prior(known_start_share=0.6, known_start_std=0.05)
    assert prior.sum() == pytest.approx(1.0)
    near = np.abs(bayes.GRID - 100) <= 15
    wide = bayes.PRIOR[near].sum()
    assert prior[near].sum() == pytest.approx(0.6 + 0.4 * wide, abs=0.005)  # three deviations
    np.testing.assert_allclose(
        bayes.start_prior(known_start_share=0.0, known_start_std=0.05), bayes.PRIOR, rtol=1e-12
    )
    parameters = bayes.class_filter(**EXACT, known_start_share=0.6, known_start_std=0.05)
    state = bayes.filter_update(parameters, bayes.initial_state(1), seen(1))
    good = np.abs(bayes.GRID - 100) <= 10 + 1e-3
    posterior = prior * np.where(good, 0.7, 0.15)
    np.testing.assert_allclose(state.belief[0], posterior / posterior.sum(), atol=1e-6)


def test_beliefs_of_the_start_are_densities_of_ratios_with_sum_one():
    assert bayes.GRID[0] == 20.0 and np.all(np.diff(bayes.GRID) == bayes.SPACING)
    assert bayes.GRID[-1] == FLOW_LIMITS[1] and FLOW_LIMITS[0] == 20.0
    assert bayes.PRIOR.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(bayes.PRIOR * bayes.GRID, bayes.PRIOR[0] * bayes.GRID[0])
    found = bayes.start_prior(known_start_share=0.7, known_start_std=0.1)
    near = scipy.stats.lognorm.pdf(bayes.GRID, 0.1, scale=100.0)
    np.testing.assert_allclose(found, 0.7 * near / near.sum() + 0.3 * bayes.PRIOR, atol=1e-12)
    sharp = bayes.start_prior(known_start_share=1.0, known_start_std=0.0)  # half a spacing then
    near = scipy.stats.lognorm.pdf(bayes.GRID, 0.0125, scale=100.0)
    np.testing.assert_allclose(sharp, near / near.sum(), atol=1e-12)


def test_the_robust_filter_begins_with_a_belief_of_sum_one_over_its_ways_of_erring(table):
    own = bayes.robust_filter(table, ROBUST)
    assert np.asarray(own.prior).sum() == pytest.approx(1.0, abs=1e-5)
    ways = np.asarray(own.prior).sum(axis=1).reshape(2, -1)  # by gain
    np.testing.assert_allclose(ways[0], ways[1], rtol=1e-5)
    z = np.linspace(-3.0, 3.0, 5)
    weight = scipy.stats.t.pdf(z, 4) / scipy.stats.t.pdf(z, 4).sum()
    expected = np.r_[1.0, 1.0, 5 * weight] / 7
    np.testing.assert_allclose(2 * ways[0], expected, rtol=1e-4)


def test_a_jump_of_the_flow_spreads_the_belief_over_every_flow_by_the_hazard():
    own = bayes.class_filter(accuracy=0.7, hazard=0.2, move_cost=0.0, outside_cost=0.0)
    at = int(np.argmin(np.abs(bayes.GRID - 100.0)))
    known = bayes.initial_state(1)._replace(
        belief=jnp.zeros((1, len(bayes.GRID))).at[0, at].set(1.0), windows=jnp.int32(3)
    )
    found = np.asarray(bayes.filter_update(own, known, seen(1)).belief)[0]
    before = 0.8 * (np.arange(len(bayes.GRID)) == at) + 0.2 * bayes.PRIOR
    good = (bayes.GRID >= 90.0) & (bayes.GRID <= 110.0)
    expected = before * np.where(good, 0.7, 0.15)
    np.testing.assert_allclose(found, expected / expected.sum(), atol=1e-5)


def test_a_fixed_cost_leaves_a_print_alone_that_may_well_be_good():
    belief = np.zeros((1, len(bayes.GRID)))
    belief[0, 30] = 1.0  # 95 %: a miss of 5
    free = bayes.class_filter(**EXACT)
    dear = bayes.class_filter(**EXACT, move_fixed_cost=5.5)
    assert FLOW_MOVES[int(bayes.expected_loss(free, jnp.asarray(belief)).argmin())] == 5
    assert FLOW_MOVES[int(bayes.expected_loss(dear, jnp.asarray(belief)).argmin())] == 0
    np.testing.assert_allclose(
        bayes.expected_loss(dear, jnp.asarray(belief)) - bayes.expected_loss(free, jnp.asarray(belief)),
        [5.5, 5.5, 0.0, 5.5, 5.5],
        rtol=1e-5,
    )


def test_the_fixed_cost_is_of_a_correction_not_of_each_of_its_moves():
    """A miss of 40 is worth four moves of 10 at a fixed cost of 12, though one move alone gains 10."""
    belief = np.zeros((1, len(bayes.GRID)))
    belief[0, 16] = 1.0  # 60 %
    parameters = bayes.class_filter(**EXACT, move_fixed_cost=12.0)
    np.testing.assert_allclose(
        bayes.expected_loss(parameters, jnp.asarray(belief)), [62.0, 57.0, 40.0, 47.0, 12.0], rtol=1e-5
    )


def test_a_border_known_to_within_some_percent_makes_a_rest_beside_it_dear():
    belief = np.zeros((1, len(bayes.GRID)))
    belief[0, 29] = 1.0  # 92.5 %
    hard = bayes.class_filter(**{**EXACT, "outside_cost": 20.0})
    soft = hard._replace(border_std=4.0)
    at_rest = [float(bayes.expected_loss(f, jnp.asarray(belief))[2]) for f in (hard, soft)]
    assert at_rest[0] == pytest.approx(7.5)
    assert at_rest[1] == pytest.approx(7.5 + 20 * scipy.stats.norm.cdf(-2.5 / 4), abs=0.01)


WATCHED = ROBUST._replace(segment_mean_decisions=15.0, width_bias_levels=7, gains=[1.0])


@pytest.fixture(scope="module")
def watching():
    """A filter that watches a camera of 5 % a segment and 5 % a window."""
    table = synthetic_flow_table(np.random.default_rng(5), segments=300, windows=8)
    return bayes.watching_filter(table, WATCHED)


def _held(watching, *, noise, seed=0, decisions=200, prints=200):
    """Share of prints at 100 % that are held as the camera is not the table's, by decision."""
    rng = np.random.default_rng(seed)
    bias = np.repeat(rng.normal(0, 0.05, (prints, decisions // 20)), 20, axis=1)
    seen = 100 * np.exp(bias + rng.normal(0, noise, bias.shape))

    @jax.jit
    def one(line):
        def window(state, flow_seen):
            state = bayes.filter_update(watching, state, seen_flow(flow_seen))
            return state, bayes.strange(watching, state)

        return jax.lax.scan(window, bayes.initial_state(len(watching.gains)), line)[1]

    return np.asarray(jax.vmap(one)(jnp.asarray(seen, jnp.float32)))


def seen_flow(flow_seen):
    still, home = jnp.float32(0.0), jnp.float32(210.0)
    return Observation(jnp.full(3, 1 / 3), jnp.int32(1), flow_seen, still, home, home, jnp.int32(0))


def test_the_table_s_own_camera_is_hardly_ever_taken_for_another(watching):
    # 1.4 % by calibration on 2,000 prints; of 400 new ones the deviation is 0.6 points
    held = np.concatenate([_held(watching, noise=0.05, seed=seed).any(axis=1) for seed in (0, 1)])
    assert held.mean() <= 0.03


def test_a_camera_with_larger_errors_than_the_table_s_is_found_within_twenty_decisions(watching):
    """Noise twice as large holds 13 nats in 20 windows, of 3.5 that 95 % at 2 % false alarms take; three
    times as large 50."""
    assert _held(watching, noise=0.15)[:, :20].any(axis=1).mean() >= 0.95
    twice = _held(watching, noise=0.1)
    assert twice[:, :20].any(axis=1).mean() >= 0.6
    assert twice.any(axis=1).mean() >= 0.95


def test_a_camera_whose_segments_are_short_is_no_other():
    """Each window a segment: errors of hypot(5, 8) = 9.4 %, which are the table's own; of long segments alone
    they would be another camera's."""
    of = camera_watch.Errors(np.full(len(camera_watch.KNOTS_PERCENT), 0.05), 0.08)
    state, update = camera_watch.start(), jax.jit(camera_watch.update)
    for error in np.random.default_rng(1).normal(0, np.hypot(0.05, 0.08), 100):
        state = update(of, state, jnp.float32(100 * np.exp(error)), jnp.float32(0))
    assert float(camera_watch.greatest(state)[0]) > 5.0
    assert not bool(camera_watch.strange(state, 3.0, 6.0))
    assert bool(camera_watch.strange(state._replace(excused=-state.excused), 3.0, 6.0))


def test_a_camera_that_hardly_varies_is_found_and_one_that_comes_back_is_released(watching):
    assert _held(watching, noise=0.005)[:, :20].any(axis=1).mean() >= 0.95
    of = camera_watch.Errors(watching.window_noise, watching.segment_bias)
    state = camera_watch.start()._replace(strength=np.full(len(camera_watch.OTHER), 99.0, np.float32))
    state = camera_watch.limited(state, watching.unlikely_limit, watching.likely_limit)
    assert bool(camera_watch.strange(state, watching.unlikely_limit, watching.likely_limit))
    rng, update = np.random.default_rng(2), jax.jit(camera_watch.update)
    for flow_seen in 100 * np.exp(rng.normal(0, 0.05, 60)):
        state = update(of, state, jnp.float32(flow_seen), jnp.float32(0))
    assert not bool(camera_watch.strange(state, watching.unlikely_limit, watching.likely_limit))


def test_what_the_controller_moves_itself_is_no_other_camera(watching):
    """100 % to 140 and back by tens, seen exactly; told of no move, the same windows are another camera's."""
    of, update = (
        camera_watch.Errors(watching.window_noise, watching.segment_bias),
        jax.jit(camera_watch.update),
    )
    moves = np.tile(np.repeat([10.0, -10.0], 4), 4)
    noise = np.random.default_rng(3).normal(0, 0.05, len(moves))
    greatest = {}
    for told in (1.0, 0.0):
        state = camera_watch.start()
        for move, flow, error in zip(moves, 100 + np.cumsum(moves), noise, strict=True):
            state = update(of, state, jnp.float32(flow * np.exp(error)), jnp.float32(told * move))
        greatest[told] = float(camera_watch.greatest(state)[0])
    assert greatest[1.0] < float(watching.unlikely_limit) < greatest[0.0]


def test_noise_is_that_of_the_flow_without_its_tails():
    rng = np.random.default_rng(4)
    flow = np.exp(rng.uniform(np.log(20), np.log(310), 20_000))
    within = rng.normal(0, np.where(flow < 60, 0.10, 0.05))
    within[::50] = 1.0  # windows that show anything
    of = camera_watch.errors(flow, within, 0.04)
    at = camera_watch.KNOTS_PERCENT
    np.testing.assert_allclose(of.noise[at >= 100], 0.055, atol=0.006)
    np.testing.assert_allclose(of.noise[at <= 30], 0.095, atol=0.01)


def test_windows_of_classes_only_never_tell_another_camera(watching, table):
    state, update = bayes.initial_state(len(watching.gains)), jax.jit(bayes.filter_update)
    for k in range(20):
        state = update(watching, state, seen(k % 3))
    assert not np.asarray(state.watch.strength).any()
    classes_only = bayes.watching_filter(table, WATCHED)
    assert np.isinf(classes_only.unlikely_limit)


def test_going_on_in_one_direction_is_no_correction_of_its_own():
    parameters = bayes.class_filter(
        accuracy=0.7, hazard=0.0, move_cost=0.0, outside_cost=0.0, move_fixed_cost=4.0
    )
    belief = np.zeros((1, len(bayes.GRID)))
    belief[0, list(bayes.GRID).index(95.0)] = 1.0
    belief = jnp.asarray(belief, jnp.float32)
    np.testing.assert_allclose(
        bayes.expected_loss(parameters, belief), [19.0, 14.0, 5.0, 4.0, 9.0], rtol=1e-6
    )
    after_up, after_down = (bayes.expected_loss(parameters, belief, move) for move in (10.0, -10.0))
    np.testing.assert_allclose(after_up, [19.0, 14.0, 5.0, 0.0, 5.0], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(after_down, [15.0, 10.0, 5.0, 4.0, 9.0], rtol=1e-6)


def test_nothing_never_moves_the_flow_and_brings_the_temperature_home():
    assert moves(nothing(), (), [0, 2, 0, 2]) == [0, 0, 0, 0]
    _, action = nothing().act((), (), seen(0, target=190.0), KEY)
    assert TEMPERATURE_MOVES[int(action.temperature)] == 20


def test_a_thin_looking_segment_is_told_from_a_low_flow_by_its_end(table):
    """Two hundred good windows, then three that lean to under: a segment that looks thin explains them, and
    the flow stays; eight that name under move it."""
    controller, parameters = bayes.bayes(14), bayes.robust_filter(table, ROBUST)
    act, memory = jax.jit(controller.act), controller.start()
    answers = []
    for shares in [[0.02, 0.96, 0.02]] * 200 + [[0.1, 0.89, 0.01]] * 3 + [[0.9, 0.1, 0.0]] * 8:
        memory, action = act(
            parameters, memory, seen(int(np.argmax(shares)), shares=shares, step=len(answers)), KEY
        )
        answers.append(FLOW_MOVES[int(action.flow)])
    assert not any(answers[20:203])
    assert answers[-1] > 0


def test_a_weak_extruder_moves_its_own_hypothesis_by_less_and_asks_for_more(table):
    blind = np.full((2, bayes.CODES, len(bayes.GRID)), 1 / bayes.CODES)
    parameters = bayes.Filter(
        jnp.asarray(blind),
        jnp.eye(2),
        jnp.eye(2),
        jnp.array([1.0, 0.5]),
        jnp.zeros(2),
        0.0,
        0.0,
        0.0,
        0.0,
        WIDE,
    )
    belief = jnp.zeros((2, len(bayes.GRID))).at[:, 16].set(0.5)  # 60 %, either way of following
    after = np.asarray(
        bayes.filter_update(
            parameters, bayes.FilterState(belief, jnp.int32(-1), jnp.int32(1)), seen(1, move=10.0)
        ).belief
    )
    np.testing.assert_allclose(after @ bayes.GRID / after.sum(axis=1), [70.0, 65.0], rtol=1e-6)
    # from 60 % a correction of 40 ends at 100 where the extruder follows and at 80 where it follows by half,
    # one of 80 at 140 and 100, one of 10 at 70 and 65; moves of 5 end at 65 and 62.5
    np.testing.assert_allclose(
        np.asarray(bayes.expected_loss(parameters, belief))[2:], [40.0, 36.25, 10.0], rtol=1e-6
    )


def test_an_extruder_that_follows_by_half_is_found_out(table):
    """Moves of + 10 % from 60 %: the windows name good four moves later where the
    extruder follows, eight later where it follows by half."""
    parameters = bayes.robust_filter(table, ROBUST._replace(gains=[1.0, 0.5]))
    state, one = bayes.bayes(14).start(), jax.jit(bayes.filter_update)
    for k in range(24):
        named = 0 if k < 8 else 1 if k < 12 else 2
        state = one(parameters, state, seen(named, move=10.0 if k else 0.0, step=k))
    weak = float(state.belief[7:].sum())
    state = bayes.bayes(14).start()
    for k in range(14):
        named = 0 if k < 4 else 1 if k < 6 else 2
        state = one(parameters, state, seen(named, move=10.0 if k else 0.0, step=k))
    assert weak > 0.8
    assert float(state.belief[7:].sum()) < 0.6


def test_a_window_that_repeats_is_a_weaker_witness_by_the_rule_and_one_that_differs_a_full_one():
    evidence = np.full((1, bayes.CODES, len(bayes.GRID)), 0.01)
    parameters = bayes.Filter(
        evidence=jnp.asarray(evidence, jnp.float32).at[:, :, 32].set(0.2),
        transition=jnp.ones((1, 1)),
        after_jump=jnp.ones((1, 1)),
        gains=jnp.ones(1),
        window_repeat_probability=jnp.array([0.4]),
        hazard=0.0,
        move_cost=0.0,
        outside_cost=0.0,
        move_fixed_cost=0.0,
        prior=WIDE,
    )
    start = bayes.FilterState(
        jnp.full((1, len(bayes.GRID)), 1 / len(bayes.GRID)), jnp.int32(-1), jnp.int32(1)
    )

    def ratio(state):
        return float(state.belief[0, 32] / state.belief[0, 10])

    first = bayes.filter_update(parameters, start, seen(1))
    assert ratio(first) == pytest.approx(20.0, rel=1e-5)  # 0.2 / 0.01: nothing came before it
    same, other = (bayes.filter_update(parameters, first, seen(named)) for named in (1, 2))
    assert ratio(same) / ratio(first) == pytest.approx((0.4 + 0.6 * 0.2) / (0.4 + 0.6 * 0.01), rel=1e-5)
    assert ratio(other) / ratio(first) == pytest.approx(20.0, rel=1e-5)
    moved = bayes.filter_update(
        parameters, first, seen(1, move=5.0)
    )  # what stood at 95 % is at 100 now: a repeat after a move is a full witness
    assert float(moved.belief[0, 32] / moved.belief[0, 10]) == pytest.approx(20.0, rel=1e-5)
    assert int(first.last_code) == int(bayes.code(seen(1).shares, seen(1).named, jnp.array(jnp.nan)))


def test_a_jump_of_the_flow_leaves_open_how_the_extruder_follows(table):
    parameters = bayes.robust_filter(table, ROBUST._replace(hazard=1.0))
    sure = bayes.FilterState(bayes.bayes(14).start().belief.at[7:].set(0.0), jnp.int32(-1), jnp.int32(1))
    blind = parameters._replace(evidence=jnp.ones_like(parameters.evidence))
    shares = np.asarray(bayes.filter_update(blind, sure, seen(1)).belief.sum(axis=1)).reshape(2, 7)
    np.testing.assert_allclose(shares.sum(axis=1), 0.5, rtol=1e-5)
    np.testing.assert_allclose(shares[0], shares[1], rtol=1e-5)


def test_the_paper_s_windows_show_the_codes_that_their_evidence_says():
    u = jax.random.uniform(KEY, (20_000, 3))
    for flow, named in ((50.0, 0), (100.0, 1), (200.0, 2)):
        drawn = jax.vmap(
            lambda one, flow=flow: paper_windows().draw(
                (), nominal(flow, 210.0, accuracy=1.0), flow, 0.0, one
            )
        )(u)
        codes = np.bincount(np.asarray(bayes.code(*drawn)), minlength=bayes.CLASS_CODES) / len(u)
        said = bayes.class_evidence(0.999)[0, : bayes.CLASS_CODES, int(np.argmin(np.abs(bayes.GRID - flow)))]
        # 20,000 draws: a deviation of 0.0035 at most; the evidence's
        # floor of 1 % moves a level by as much as 0.004
        np.testing.assert_allclose(codes, said, atol=0.015)
        assert codes[named * bayes.LEVELS : (named + 1) * bayes.LEVELS].sum() == pytest.approx(1.0)


# ---- figures


def score(controller, parameters, windows, conditions, seed=0):
    return trials.evaluate(
        controller,
        jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), parameters),
        windows,
        conditions,
        jax.random.key(seed),
    )


def test_the_robust_filter_holds_its_bars_on_the_paper_s_windows_with_a_clog(table):
    controller, parameters = bayes.bayes(14), bayes.robust_filter(table, ROBUST)
    windows, conditions = judging.cases(recorded_windows(table), runs=6, segment_mean_decisions=10.0)[
        "accuracy 0.7, clog"
    ]
    found = score(controller, parameters, windows, conditions)
    # 98.5 and 96.9 on 2,100 runs; of 126 runs the deviation is 1.5 points
    assert found.settled.percent >= 95
    assert found.recovered.percent >= 94
    assert found.stay.percent >= 90


@pytest.mark.slow
def test_the_trial_s_figures_come_out():
    """Section 2 of the notes, 21 starts x 100 runs at accuracy 0.7: settled, stay,
    median; deviations of 2,100 runs are 1 point at most, the rest is how the trial's
    controllers were set, which the notes do not say."""
    paper, rough = paper_windows(), trials.starts(100, accuracy=0.7)
    exact = score(bayes.bayes(1), bayes.class_filter(**EXACT), paper, rough)
    assert exact.settled.percent >= 99.5
    assert exact.stay.percent >= 99
    assert exact.median_steps == pytest.approx(9, abs=1)
    leaking = score(bayes.bayes(1), bayes.class_filter(**{**EXACT, "hazard": 0.02}), paper, rough)
    assert leaking.settled.percent == pytest.approx(92, abs=4)
    assert leaking.stay.percent == pytest.approx(50, abs=8)
    assert leaking.median_steps == pytest.approx(21, abs=3)
    plain = score(proportional(), Proportional(gain=20.0, time_constant=1.0), paper, rough)
    assert plain.settled.percent == pytest.approx(17, abs=4)
    assert plain.stay.percent == 0
    test = score(sequential_test(), SequentialTest(accuracy=0.7, threshold=2.98, cap=4.62), paper, rough)
    assert test.settled.percent >= 99
    assert test.median_steps == pytest.approx(11, abs=1)
    assert test.p90_steps == pytest.approx(30, abs=4)
    one = jnp.ones_like(rough.flow)
    clogged = score(
        bayes.bayes(1), bayes.class_filter(**EXACT), paper, rough._replace(clog=0.6 * one, clog_step=60 * one)
    )
    assert clogged.recovered.percent == pytest.approx(1.5, abs=1)


@pytest.mark.slow
def test_the_robust_filter_holds_every_bar_of_the_default(table):
    controller, parameters = bayes.bayes(14), bayes.robust_filter(table, ROBUST)
    unseen = recorded_windows(synthetic_table(np.random.default_rng(11), segments=30, windows=10))
    for number, (case, (windows, conditions)) in enumerate(
        judging.cases(unseen, runs=100, segment_mean_decisions=10.0).items()
    ):
        found = score(controller, parameters, windows, conditions, seed=number)
        assert found.settled.percent >= 97, case
        assert found.stay.percent >= 90, case
        assert found.flow_error <= {"recorded, fresh": 2.0, "recorded, sticky": 5.0}.get(case, np.inf), case


def test_the_least_flow_that_can_be_has_the_first_code_and_the_largest_the_last():
    low, high = FLOW_LIMITS
    bin_wide = float(np.exp(bayes.FLOW_CODE_WIDTH))

    def coded(flow: float) -> int:
        return int(bayes.code(jnp.ones(3) / 3, jnp.int32(1), jnp.float32(flow))) - bayes.CLASS_CODES

    assert (coded(1.001 * low), coded(0.999 * high)) == (0, bayes.FLOW_CODES - 1)
    # and a bin further from either end another one
    assert coded(low * bin_wide * 1.001) == 1 and coded(0.999 * high / bin_wide) == bayes.FLOW_CODES - 2


def test_a_segment_without_a_bias_has_one_level_that_is_sure():
    levels, weights = bayes.bias_levels(1)
    assert (levels.tolist(), weights.tolist()) == ([0.0], [1.0])


def test_the_noise_of_windows_stands_at_the_flow_of_their_segment():
    table = synthetic_flow_table(np.random.default_rng(4), segments=40, windows=5)
    flow, within = bayes._window_noise(table)
    order = np.argsort(table.segment, kind="stable")
    np.testing.assert_allclose(flow, np.asarray(table.flow)[order][::5].repeat(4), rtol=1e-6)
    assert abs(np.std(within) / 0.05 - 1) < 0.2  # 160 of them, two of a window each


def test_quiet_prints_are_drawn_from_segments_near_100_percent_and_moved_as_often_up_as_down():
    table = synthetic_flow_table(np.random.default_rng(4), segments=60, windows=5)
    far = (np.asarray(table.flow) < bayes.QUIET_FLOWS[0]) | (np.asarray(table.flow) > bayes.QUIET_FLOWS[1])
    assert far.any() and not far.all()
    # segments far from 100 % show ten times what they are: no quiet print may
    odd = table._replace(flow_seen=np.where(far, 10.0 * table.flow_seen, table.flow))
    flow, within = np.array([50.0, 100.0]), np.array([3.0, 1e-6])
    seen, moves = bayes._quiet_prints(odd, flow, within, np.random.default_rng(0))
    still = seen[: bayes.QUIET_PRINTS // 2]
    np.testing.assert_allclose(still, 100.0, rtol=1e-3)
    stirred = moves[bayes.QUIET_PRINTS // 2 :]
    # one sets out in five decisions of a hundred, and goes back in the next
    assert abs((stirred[:, 2:] != 0).mean() - (1 - (1 - bayes.TRIED) ** 2)) < 0.01
    away = np.cumsum(stirred, axis=1)
    away = away[np.isin(away, (-10.0, -5.0, 5.0, 10.0))]
    assert abs(np.mean(away > 0) - 0.5) < 0.05 and abs(np.mean(np.abs(away) > 7) - 0.5) < 0.05
    # where no segment stands there, all of them are drawn from
    all_far = odd._replace(flow=np.full(len(far), 300.0), flow_seen=np.full(len(far), 300.0))
    assert np.isfinite(
        bayes._quiet_prints(all_far, np.array([300.0]), np.array([1e-6]), np.random.default_rng(0))[0]
    ).all()
