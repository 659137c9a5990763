"""The panel: plants within the declared spread, cases that stay with theirs, runs and figures by hand."""

import numpy as np
import pytest

from pipeline.papers.published import GAMMA, REFERENCE, TAU
from pipeline.temperature.controllers.law import (
    ActuatorLimits,
    constant,
    deployed,
    feasible_target,
    ramp,
    sinusoid,
)
from pipeline.temperature.plant import baam, padded, plant, simulate
from pipeline.temperature.test_set import panel
from pipeline.temperature.test_set.panel import Cases, Figures, PlantSpread, Questions, Rollout
from pipeline.temperature.test_set.scorecard import closed_loop
from pipeline.temperature.tracking import Law, gains, observer_gain, observer_law, still_law

SPREAD = PlantSpread(input_gain=0.15, slower=0.2, extra_heat_loss=0.005, delayed=0.5, ambient_degC=8.0)
ANYTHING = ActuatorLimits(np.full(7, -np.inf), np.full(7, np.inf), np.full(7, np.inf))


def static(gain: float) -> Law:
    """u = gain (r - y), without memory."""
    return still_law(1, 1)._replace(D=np.full((1, 1), gain), K_r=np.full((1, 1), -gain))


def asked(plants, starts, references, *, steps, hold=1, noise=0.0, seed=1, cells=False, **kinds) -> Cases:
    """Without structure and without the disturbed case, which the tests ask for by themselves."""
    made = asked_all(plants, starts, references, steps, hold, noise, seed, cells, (panel.Structure(),), kinds)
    keep = made.kind != "disturbed"
    own = ("plant", "kind", "start", "x0", "u0", "begin", "asked")
    parts = {name: getattr(made, name)[keep] for name in own}
    return made._replace(
        each=made.each - 1,
        outside=made.outside[:, keep],
        told=made.told[:, keep],
        pushed=made.pushed[:, keep],
        **parts,
    )


def asked_all(plants, starts, references, steps, hold, noise, seed, cells, structures, kinds) -> Cases:
    questions = Questions(
        np.array(starts, float),
        np.array(references, float),
        kinds.get("ramp"),
        kinds.get("sinusoid"),
        kinds.get("sequence"),
    )
    return panel.asked(
        [panel.delayed(one, late=False) for one in plants],
        questions,
        noise=np.full(plants[0].p, noise),
        seed=seed,
        steps=steps,
        hold=hold,
        cells=cells,
        structures=structures,
    )


# ---- plants


def test_a_late_plant_does_a_sample_later_what_the_other_does_at_once():
    rng = np.random.default_rng(1)
    u = rng.uniform(0, 10, (50, 7))
    at_once, late = (
        simulate(panel.delayed(baam(), is_late), u, np.r_[np.full(6, 20.0), np.zeros(7)])[1]
        for is_late in (False, True)
    )
    np.testing.assert_allclose(at_once, simulate(baam(), u, np.full(6, 20.0))[1], rtol=1e-12)  # rounding
    shifted = simulate(baam(), np.vstack([np.zeros(7), u[:-1]]), np.full(6, 20.0))[1]
    np.testing.assert_allclose(late, shifted, rtol=1e-12)


ONE_MODE = plant([[0.99]], [[0.01]], [[1.0]], b=[0.2])  # 100 samples, 20 °C where nothing heats it


@pytest.mark.parametrize("late", [False, True])
def test_a_lag_in_series_keeps_the_steady_state_and_is_behind_by_its_time_constant(late):
    behind = panel.delayed(ONE_MODE, late, lag=5.0)
    u = np.full((4000, 1), 50.0)
    at_once, lagged = (
        simulate(one, u, np.r_[20.0, np.zeros(one.n - 1)])[1][:, 0]
        for one in (panel.delayed(ONE_MODE, late), behind)
    )
    np.testing.assert_allclose([at_once[-1], lagged[-1]], 70.0, atol=1e-9)
    assert (lagged[1:] <= at_once[1:]).all() and (np.diff(lagged) >= -1e-9).all()
    # the lag misses sum k^(t + 1) = k / (1 - k) samples of 50 °C, k = exp(-1 / 5)
    missed = 50.0 / np.expm1(1 / 5)
    np.testing.assert_allclose((at_once - lagged).sum(), missed, rtol=1e-9)


def test_a_lag_below_a_sample_is_none():
    for late in (False, True):
        for one, other in zip(
            panel.delayed(ONE_MODE, late), panel.delayed(ONE_MODE, late, 0.99), strict=True
        ):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("late", [False, True])
def test_a_machine_with_a_lag_that_is_held_stays_where_it_is(late):
    machine = panel.delayed(ONE_MODE, late, 5.0)
    cases = lag_cases([machine], start=60.0)
    y = simulate(machine, np.tile(cases.u0[0], (50, 1)), cases.x0[0])[1]
    np.testing.assert_allclose(y, 60.0, atol=1e-9)


def test_machines_with_and_without_lag_run_together_as_they_run_alone():
    machines = [panel.delayed(ONE_MODE, late, lag) for late, lag in ((False, 0.0), (False, 5.0), (True, 3.0))]
    together, *alone = (lagging(some) for some in (machines, *([one] for one in machines)))
    np.testing.assert_allclose(together, np.hstack(alone), rtol=1e-12)  # rounding
    assert np.abs(np.diff(together[20])).min() > 0.1  # they differ


def lag_cases(machines: list, start: float) -> Cases:
    """Held at `start` °C, then towards 100 °C."""
    return panel.asked(
        machines,
        Questions(np.array([[start]]), np.array([[100.0]]), None, None, None),
        noise=np.zeros(1),
        seed=1,
        steps=50,
        hold=1,
        cells=False,
        structures=(panel.Structure(),),
    )


def lagging(machines: list) -> np.ndarray:
    """True outputs (steps, machines) from 20 °C under a proportional law."""
    law, cases = static(0.5), lag_cases(machines, start=20.0)
    limits = ActuatorLimits(np.zeros(1), np.full(1, 200.0), np.full(1, np.inf))
    aims = panel.aims(law, panel.rests(ONE_MODE, cases, limits), cases)
    run = panel.rolled_out(deployed(law, limits, integral_limit=1.0), cases, aims)
    return run.y[:, cases.kind == "constant", 0]


def test_a_plant_is_given_the_lag_that_it_does_not_hold():
    """A model of one mode of 100 samples; with 2 samples of dead time; and one with a mode of 2 samples
    beside, which leaves no room."""
    rng, spread = np.random.default_rng, PlantSpread(0.0, 0.0, 0.0, 0.0, 0.0, lag=0.1)
    dead = plant(
        [[0.99, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]], [[0.0], [0.0], [0.01]], [[1.0, 0.0, 0.0]]
    )
    quick = plant([[0.99, 0.01], [0.0, 0.6]], [[0.0], [0.4]], [[1.0, 0.0]])

    def lags(machine) -> np.ndarray:
        drawn = panel.drawn([machine], 400, spread, cells=False, rng=rng(1))
        kept = np.array([one.A[-1, -1] for one in drawn])
        return np.array([-1 / np.log(k) if k else 0.0 for k in kept])

    one, two, none = lags(ONE_MODE), lags(dead), lags(quick)
    assert one.max() <= 9.95 and one.max() > 9.7 and (one[one > 0] >= 1).all()  # 0.1 / -ln 0.99
    assert abs((one > 0).mean() - 0.9) < 0.05
    np.testing.assert_allclose(two[one > 3.1], one[one > 3.1] - 2, rtol=1e-9)
    assert not two[one < 3].any() and not none.any()


def test_a_plant_that_nobody_can_hold_is_drawn_nearer_and_the_others_stay():
    """A mode of a million samples whose state lies far from zero: with a little more loss it heats by itself,
    and inputs from 0 to 100 cannot take that away."""
    machine = plant([[1 - 1e-6]], [[0.5]], [[1.0]])._replace(b=np.array([-0.151]), d=np.array([1e5]))
    spread, limits = PlantSpread(0.15, 0.1, 1e-4, 0.0, 8.0), (np.zeros(1), np.full(1, 100.0))

    def holdable(one) -> bool:
        target = feasible_target(one, np.array([150.0]), *limits)
        return bool(np.abs(target.miss).max() <= 0.1)

    far, near = (
        panel.drawn([machine], 20, spread, cells=False, rng=np.random.default_rng(3), holdable=asked)
        for asked in (lambda _: True, holdable)
    )
    held = [holdable(one) for one in far]
    assert not all(held) and all(map(holdable, near))
    for one, other, stays in zip(far, near, held, strict=True):
        assert np.array_equal(one.A, other.A) == stays and np.array_equal(one.b, other.b) == stays


def test_a_lag_is_drawn_apart_from_what_else_a_plant_differs_by():
    without, lagged = (
        panel.drawn([ONE_MODE], 20, SPREAD._replace(lag=lag), cells=False, rng=np.random.default_rng(3))
        for lag in (0.0, 0.1)
    )
    for one, other in zip(without, lagged, strict=True):
        assert one.A[0, 0] == other.A[0, 0] and one.b[0] == other.b[0]
        np.testing.assert_allclose(one.A[0, 1:] + one.B[0], other.A[0, 1:] + other.B[0], rtol=1e-12)


@pytest.fixture(scope="module")
def drawn():
    return panel.drawn([baam()], 400, SPREAD, cells=True, rng=np.random.default_rng(1))


def test_every_plant_lies_within_the_declared_spread_and_together_they_fill_it(drawn):
    """Gains, speed, loss and ambient are read back off the matrices. That 400 draws leave a fiftieth of a
    range empty at one end has a chance of 0.98^400 = 3e-4."""
    truth, identity = baam(), np.eye(6)
    late = np.array([not one.B[:6].any() for one in drawn])
    rows = []
    for one, is_late in zip(drawn, late, strict=True):
        A, B, b = one.A[:6, :6], one.A[:6, 6:] if is_late else one.B[:6], one.b[:6]
        pace = A[0, 1] / truth.A[0, 1]
        loss = (identity + (truth.A - identity) * pace - A)[0, 0]
        gain = B.sum(axis=0) / truth.B.sum(axis=0) / pace
        np.testing.assert_allclose(A, identity + (truth.A - identity) * pace - loss * identity, atol=1e-12)
        np.testing.assert_allclose(B, truth.B * gain * pace, atol=1e-12)
        ambient = (b - truth.b * pace) / ((identity - A - loss * identity) @ np.ones(6))
        np.testing.assert_allclose(ambient, ambient[0], rtol=1e-6)  # of every cell; 1e-16 over 1e-3
        rows.append([*(gain - 1) / 0.15, (1 / pace - 1) / 0.2, 2 * loss / 0.005 - 1, ambient[0] / 8.0])
    rows = np.array(rows)
    assert np.abs(rows).max() < 1 + 1e-6
    assert (rows.min(axis=0) < -0.96).all() and (rows.max(axis=0) > 0.96).all()
    # half of 400: ten is a standard deviation
    assert abs(late.sum() - 200) < 40


def test_the_same_seed_draws_the_same_plants_and_another_others(drawn):
    again, other = (
        panel.drawn([baam()], 3, SPREAD, cells=True, rng=np.random.default_rng(seed)) for seed in (1, 2)
    )
    for one, same, different in zip(drawn, again, other, strict=False):
        np.testing.assert_array_equal(one.A, same.A)
        assert not np.array_equal(one.A, different.A)


def test_plants_of_different_order_do_after_padding_what_they_did_before():
    small, large = plant([[0.9]], [[1.0]], [[1.0]]), plant(np.diag([0.9, 0.5]), [[1.0], [1.0]], [[1.0, 1.0]])
    u = np.random.default_rng(1).uniform(0, 1, (20, 1))
    for before, after in zip((small, large), padded([small, large]), strict=True):
        assert after.n == 2
        np.testing.assert_allclose(
            simulate(after, u, np.zeros(2))[1], simulate(before, u, np.zeros(before.n))[1], rtol=1e-12
        )


# ---- cases


def test_the_cases_of_a_plant_stay_one_block_and_every_start_meets_every_reference():
    cases = asked(
        [baam(), baam(), baam()],
        [np.full(5, 20.0), np.full(5, 45.0), np.full(5, 90.0)],
        [REFERENCE, REFERENCE - 15],
        steps=60,
        cells=True,
        ramp=(REFERENCE - 15, np.full(5, 0.025)),
        sinusoid=(REFERENCE - 9, np.full(5, 3.0), 600.0),
        sequence=REFERENCE + np.array([[0.0], [-5.0], [5.0]]),
    )
    assert cases.each == 3 * 2 + 3
    np.testing.assert_array_equal(cases.plant, np.repeat([0, 1, 2], 9))
    for index in range(3):
        mine = cases.plant == index
        asked_of_it = list(zip(cases.kind[mine], cases.start[mine], cases.asked[mine, 0], strict=True))
        assert len(set(asked_of_it)) == 9
        assert {(start, r) for kind, start, r in asked_of_it if kind == "constant"} == {
            (start, r) for start in range(3) for r in range(2)
        }
        # what moves starts in the middle
        assert {start for kind, start, _ in asked_of_it if kind != "constant"} == {1}


@pytest.mark.parametrize("cells", [True, False])
def test_every_case_begins_at_rest_where_it_says(cells):
    plants = panel.drawn([baam()], 4, SPREAD, cells=cells, rng=np.random.default_rng(3))
    cases = panel.asked(
        plants,
        Questions(np.array([np.full(5, 20.0), np.full(5, 90.0)]), REFERENCE[None], None, None, None),
        noise=np.zeros(5),
        seed=1,
        steps=60,
        hold=1,
        cells=cells,
    )
    for index, x, u, start in zip(cases.plant, cases.x0, cases.u0, cases.start, strict=True):
        one, y = plants[index], cases.starts[start]
        # rounding at 90 °C
        np.testing.assert_allclose(one.A @ x + one.B @ u + one.b, x, atol=1e-9)
        held = start == len(cases.starts) - 1  # at the first reference
        np.testing.assert_allclose(
            x[:6] if cells and not held else one.C @ x + one.d, y[0] if not held else y, atol=1e-8
        )


def test_every_controller_measures_the_same_noise_of_the_level_asked_for():
    cases = asked([baam()] * 4, [np.full(5, 20.0)], [REFERENCE], steps=1000, cells=True)
    cases = cases._replace(noise=np.array([0.0, 0.1, 0.1, 0.5, 1.0]))
    noise = panel.noise_of(cases)
    np.testing.assert_array_equal(noise, panel.noise_of(cases))
    # 4,000 draws an output: a standard deviation to 1.1 %
    np.testing.assert_allclose(noise.std(axis=(0, 1)), cases.noise, rtol=0.05)


def test_a_sequence_asks_its_references_for_equal_times_a_ramp_ends_at_and_a_sinusoid_starts_at_its_own():
    machine = plant([[0.5]], [[1.0]], [[1.0]])
    cases = asked(
        [machine],
        [[10.0]],
        [[100.0]],
        steps=90,
        ramp=(np.array([55.0]), np.array([0.5])),
        sinusoid=(np.array([80.0]), np.array([4.0]), 40.0),
        sequence=np.array([[50.0], [70.0], [60.0]]),
    )
    law = still_law(1, 1)
    limits = ActuatorLimits(np.zeros(1), np.full(1, 1000.0), np.full(1, np.inf))
    r, target, feed = panel.schedule(cases, panel.aims(law, panel.rests(machine, cases, limits), cases))
    by_kind = {kind: r[:, k, 0] for k, kind in enumerate(cases.kind)}
    t = np.arange(90)
    np.testing.assert_allclose(by_kind["constant"], 100.0)
    np.testing.assert_allclose(by_kind["ramp"], 55.0 + 0.5 * t, rtol=1e-12)
    # 90 turns of a rotation, each to the last bit
    np.testing.assert_allclose(by_kind["sinusoid"], 80.0 + 4.0 * np.sin(2 * np.pi * t / 40), rtol=1e-12)
    np.testing.assert_array_equal(by_kind["sequence"], np.repeat([50.0, 70.0, 60.0], 30))
    # all of it can be held: on the ramp the law without memory or gain is fed what rests there, half of y and
    # the rise of the next step
    np.testing.assert_allclose(target, r, atol=1e-3)  # the tolerance of the target
    np.testing.assert_allclose(feed[:, 1, 0], 0.5 * by_kind["ramp"] + 0.5, atol=2e-3)


# ---- runs


def test_a_run_by_hand():
    """y = x, x+ = 0.5 x + u, u = 50 + 0.4 (100 - y) from a hold at 10, no more than 80: 86 is cut, and y =
    10, 5 + 80, 42.5 + 56, 49.25 + 50.6."""
    machine = plant([[0.5]], [[1.0]], [[1.0]])
    cases = asked([machine], [[10.0]], [[100.0]], steps=4, hold=3)
    limits, law = ActuatorLimits(np.zeros(1), np.full(1, 80.0), np.full(1, np.inf)), static(0.4)
    run = panel.rolled_out(
        deployed(law, limits, integral_limit=1.0),
        cases,
        panel.aims(law, panel.rests(machine, cases, limits), cases),
    )
    np.testing.assert_allclose(run.y[:, 0, 0], [10.0, 85.0, 98.5, 99.85], rtol=1e-4)  # that of the target
    np.testing.assert_allclose(run.wished[:, 0, 0], [86.0, 56.0, 50.6, 50.06], rtol=1e-4)
    np.testing.assert_allclose(run.u[:, 0, 0], [80.0, 56.0, 50.6, 50.06], rtol=1e-4)


def test_doing_nothing_leaves_every_plant_where_it_was_held():
    cases = asked([baam()], [np.full(5, 60.0)], [REFERENCE], steps=200, noise=0.5, cells=True)
    law = still_law(7, 5)
    limits = ActuatorLimits(np.zeros(7), np.full(7, 100.0), np.full(7, np.inf))
    run = panel.rolled_out(
        deployed(law, limits, integral_limit=1.0, holds=True),
        cases,
        panel.aims(law, panel.rests(baam(), cases, limits), cases),
    )
    # rounding, over 200 steps of a plant with a mode that grows by 1e-4 a step
    np.testing.assert_allclose(run.y[:, 0], np.tile(baam().C @ np.full(6, 60.0), (200, 1)), atol=1e-8)
    assert np.ptp(run.u, axis=0).max() == 0


def test_a_law_without_integral_action_settles_on_its_target_from_any_hold():
    """Nothing of the hand-over stays with it."""
    cases = asked([baam()], [np.full(5, 20.0), np.full(5, 90.0)], [REFERENCE], steps=2000, cells=True)
    law = observer_law(baam(), gains(baam(), np.eye(5), np.eye(7), GAMMA), observer_gain(baam(), TAU))
    limits = ActuatorLimits(np.zeros(7), np.full(7, 100.0), np.full(7, np.inf))
    run = panel.rolled_out(
        deployed(law, limits, integral_limit=1.0),
        cases,
        panel.aims(law, panel.rests(baam(), cases, limits), cases),
    )
    # 1e-3 °C of the target's own tolerance, and what is left of the slowest mode after 2,000 steps
    np.testing.assert_allclose(run.y[-1], [REFERENCE, REFERENCE], atol=2e-3)


@pytest.mark.parametrize("integral", [0.0, 0.02])
def test_what_runs_within_its_limits_is_the_closed_loop_of_which_the_margins_are(integral):
    """Two runs from states that differ by 1: their difference obeys scorecard.closed_loop."""
    law = observer_law(
        baam(), gains(baam(), np.eye(5), np.eye(7), GAMMA), observer_gain(baam(), TAU), integral=integral
    )
    controller = deployed(law, ANYTHING, integral_limit=np.inf)
    cases = asked([baam()], [np.full(5, 20.0)], [REFERENCE], steps=40, hold=1, cells=True)
    limits = ActuatorLimits(np.zeros(7), np.full(7, 100.0), np.full(7, np.inf))
    aims = panel.aims(law, panel.rests(baam(), cases, limits), cases)
    moved = cases._replace(x0=cases.x0 + np.r_[np.ones(6), np.zeros(7)])
    difference = panel.rolled_out(controller, moved, aims).y - panel.rolled_out(controller, cases, aims).y
    dx, dy = np.ones(6), baam().C @ np.ones(6)
    dz = law.A @ law.start_y @ dy + law.B_y @ dy
    dxi = controller.back @ (law.K @ dz + law.D @ dy)
    state, loop = np.concatenate([dx, dz, dxi] if integral else [dx, dz]), closed_loop(baam(), law)
    for t in range(40):
        # rounding at 200 °C
        np.testing.assert_allclose(difference[t, 0], baam().C @ state[:6], atol=1e-9)
        state = loop @ state


# ---- what no model holds


def played(structure: panel.Structure, steps: int, law: Law) -> tuple[panel.Rollout, Cases]:
    """A machine with y+ = 0.9 y + 0.1 u + 2, 20 °C where nothing heats it, from 20 °C and held at 100 °C."""
    machine = plant([[0.9]], [[0.1]], [[1.0]], b=[2.0])
    cases = asked_all([machine], [[20.0]], [[100.0]], steps, 1, 0.0, 1, False, (structure,), {})
    limits = ActuatorLimits(np.zeros(1), np.full(1, 200.0), np.full(1, np.inf))
    controller = deployed(law, limits, integral_limit=1.0)
    return panel.rolled_out(
        controller, cases, panel.aims(law, panel.rests(machine, cases, limits), cases)
    ), cases


def test_a_door_a_fan_and_another_room_cool_a_held_machine_by_their_shares_of_its_rise():
    run, cases = played(panel.Structure(), 2000, still_law(1, 1))
    assert list(cases.kind) == ["constant", "disturbed"]
    y = run.y[:, 1, 0]
    # 80 °C warmer than from where it starts: in the end 15 %, 8 % and 3 % of that colder
    ends = [y[int(2000 * share) - 1] for share in (0.1, 0.15, 0.3, 0.5, 0.6, 1.0)]
    np.testing.assert_allclose(ends, [100, 88, 100, 93.6, 100, 97.6], atol=1e-3)
    np.testing.assert_allclose(run.y[-1, 0], 100.0, atol=1e-3)


@pytest.mark.parametrize(
    ("structure", "ends"),
    [
        # 80 °C of heat; the wall passes on a tenth of the rise y - 20: y - 20 = 80 + 0.1 (y - 20)
        (panel.Structure(wall=0.1, slower=0.02), 20 + 80 / 0.9),
        # y - 20 = 80 - 0.1 (y - 20)^2 / 80
        (panel.Structure(radiates=0.1), 20 + 80 * (np.sqrt(1 + 4 * 0.1) - 1) / 0.2),
    ],
)
def test_a_slow_wall_and_radiation_end_where_their_equations_say(structure, ends):
    run, _ = played(structure, 3000, still_law(1, 1))
    np.testing.assert_allclose(run.y[-1, 0, 0], ends, atol=1e-3)


def test_material_carries_heat_from_one_output_to_the_next_and_later():
    twice = plant(0.9 * np.eye(2), 0.1 * np.eye(2), np.eye(2), b=[2.0, 2.0])
    flows = (panel.Structure(carried=0.1),)
    cases = asked_all([twice], [[20.0, 20.0]], [[100.0, 60.0]], 2000, 1, 0.0, 1, False, flows, {})
    limits = ActuatorLimits(np.zeros(2), np.full(2, 200.0), np.full(2, np.inf))
    law = still_law(2, 2)
    aims = panel.aims(law, panel.rests(twice, cases, limits), cases)
    y = panel.rolled_out(deployed(law, limits, integral_limit=1.0), cases, aims).y[:, 0]
    # the second one's rise: r = 40 + 0.1 (80 - r)
    np.testing.assert_allclose(y[-1], [100.0, 20 + 48 / 1.1], atol=1e-3)
    late = int(panel.LATE * 2000)
    np.testing.assert_allclose(y[late - 1, 1], 60.0, atol=0.1)  # nothing of it has come yet


def test_a_sensor_in_steps_is_what_is_measured_and_a_duty_in_steps_what_heats():
    run, _ = played(panel.Structure(step_degC=0.25, duty=0.1), 50, static(0.3))
    measured, y = run.measured[:, 0, 0], run.y[:, 0, 0]
    np.testing.assert_array_equal(measured, 0.25 * np.round(y / 0.25))
    # 80 percent hold the reference: the heater gives whole steps of 8
    given = (y[1:] - 0.9 * y[:-1] - 2.0) / 0.1
    steps = np.round(run.u[:-1, 0, 0] / 8)
    np.testing.assert_allclose(given, 8 * np.where(steps < panel.DEAD, 0, steps), atol=1e-9)
    assert np.abs(given - run.u[:-1, 0, 0]).max() > 1


def test_a_loop_that_swings_around_its_reference_has_a_peak_and_no_settled_error():
    cases = asked([MACHINE], [[20.0]], [[100.0]], steps=9)
    result = figures_of([20.0, 60, 103, 98, 102, 98, 102, 98, 102], cases, r=100.0, settled=4)
    assert (result.settled_error[0], result.peak[0]) == (0.0, 2.0)


# ---- figures


def figures_of(y, cases: Cases, *, wished=None, r=None, target=None, band=1.0, settled=3) -> Figures:
    """Of outputs y (steps,) of the one case."""
    y = np.array(y, float)[:, None, None]
    r = np.broadcast_to(np.array(r, float), (1, 1, len(y))).T
    target = r if target is None else np.broadcast_to(np.array(target, float), (1, 1, len(y))).T
    wished = np.zeros_like(y) if wished is None else np.array(wished, float)[:, None, None]
    limits = ActuatorLimits(np.zeros(1), np.full(1, 100.0), np.full(1, np.inf))
    return panel.figures(
        Rollout(y, r, target, wished, np.clip(wished, 0, 100), y),
        cases,
        limits=limits,
        low=np.full(1, 0.0),
        high=np.full(1, 102.0),
        band=band,
        settled=settled,
    )


MACHINE = plant([[0.5]], [[1.0]], [[1.0]])


def test_an_engineer_s_figures_by_hand():
    cases = asked([MACHINE], [[20.0]], [[100.0]], steps=9)
    y = [20.0, 60, 103, 100.5, 98, 100.5, 100.5, 99.8, 100.3]
    wished = [120.0, 50, -10, 5, 5, 5, 5, 5, 5]
    result = figures_of(y, cases, wished=wished, r=100.0)
    # in the band from sample 3 on, but for a glance; from cold: no settling of its own, no time at limits
    assert result.heating[0] == 3 and np.isnan([result.settling[0], result.at_limits[0]]).all()
    assert result.overshoot[0] == pytest.approx(3.0)
    assert result.settled_error[0] == pytest.approx(0.2)  # |mean(0.5, -0.2, 0.3)|
    assert result.peak[0] == pytest.approx(0.3)  # of the last two
    # commands as applied 100, 50, 0, 5 and then still
    assert result.travel[0] == pytest.approx((50 + 50 + 5) / 8)
    warm = figures_of(y, cases._replace(start=np.array([1])), wished=wished, r=100.0)
    assert warm.settling[0] == 3 and np.isnan(warm.heating[0])
    assert warm.at_limits[0] == pytest.approx(100 * 2 / 9)
    assert result.energy[0] == pytest.approx((100 + 50 + 6 * 5) / 9)
    assert result.rms[0] == pytest.approx(np.sqrt(((np.array(y) - 100) ** 2).mean()))
    assert result.crossing[0] == pytest.approx(1.0)  # 103 against 102
    # 4 samples outside by far, none on the edge of 0.1 either side
    assert result.outside[0] == pytest.approx(4.0)


@pytest.mark.parametrize(("samples", "settled"), [(4, 2.0), (5, 27.0)])
def test_what_leaves_the_band_for_fewer_than_five_samples_has_settled(samples, settled):
    y = np.full(60, 100.0)
    y[:2], y[22 : 22 + samples] = 20.0, 102.0
    cases = asked([MACHINE], [[20.0]], [[100.0]], steps=60)
    assert figures_of(y, cases, r=100.0).heating[0] == settled


def test_settling_is_of_the_reachable_target_and_the_settled_error_of_the_reference():
    cases = asked([MACHINE], [[20.0]], [[100.0]], steps=6)
    result = figures_of([20.0, 90, 90, 90, 90, 90], cases, r=100.0, target=90.0)
    assert (result.heating[0], result.settled_error[0]) == (1.0, 10.0)


def test_a_run_that_ends_outside_the_band_never_settles_and_cooling_overshoots_downwards():
    cases = asked([MACHINE], [[100.0]], [[20.0]], steps=4)
    result = figures_of([100.0, 50, 15, 30], cases, r=20.0)
    assert (result.heating[0], result.overshoot[0]) == (np.inf, 5.0)
    assert figures_of([20.5] * 4, cases, r=20.0).heating[0] == 0


def test_a_sequence_counts_settling_and_overshoot_from_each_new_reference():
    cases = asked([MACHINE], [[20.0]], [[50.0]], steps=12, sequence=np.array([[50.0], [70.0], [60.0]]))
    only = cases._replace(
        plants=cases.plants,
        plant=cases.plant[1:],
        each=1,
        kind=cases.kind[1:],
        start=cases.start[1:],
        begin=cases.begin[1:],
        asked=cases.asked[1:],
    )
    r = np.repeat([50.0, 70.0, 60.0], 4)
    # within 1 °C after 1, 3 and 2 samples of each; past it by 0, 0.5 (up) and 2 (down)
    y = [20.0, 50, 50, 50, 50, 60, 65, 70.5, 70.5, 58, 60, 60]
    result = figures_of(y, only, r=r)
    assert (result.settling[0], result.overshoot[0]) == (3.0, 2.0)
    # what is outside when the next reference comes never settled, whatever it does later
    assert figures_of([20.0, 50, 50, 50, 50, 60, 65, 68, 70, 60, 60, 60], only, r=r).settling[0] == np.inf


@pytest.mark.parametrize("kind", ["ramp", "sinusoid"])
def test_a_moving_reference_has_a_root_mean_square_and_no_settling(kind):
    moving = {"ramp": (np.array([50.0]), np.array([1.0])), "sinusoid": (np.array([50.0]), np.ones(1), 8.0)}
    cases = asked([MACHINE], [[20.0]], [[50.0]], steps=8, **{kind: moving[kind]})
    only = cases._replace(plant=cases.plant[1:], each=1, kind=cases.kind[1:], start=cases.start[1:],
                          begin=cases.begin[1:], asked=cases.asked[1:])  # fmt: skip
    make = {"ramp": ramp, "sinusoid": sinusoid}[kind]
    reference = make(*moving[kind])
    r = (reference.states(8) @ reference.H.T)[:, 0]
    result = figures_of(r + 2.0, only, r=r)
    assert np.isnan(result.settling[0]) and np.isnan(result.overshoot[0])
    assert result.rms[0] == pytest.approx(2.0)
    assert constant(np.array([50.0])).states(8).std() == 0


def test_the_declared_cost_by_hand_and_no_more_than_ten_thousand():
    allowance = {"outside": 15.0, "overshoot": 2.0, "settled_error": 0.5, "at_limits": 10.0}
    allowance |= {"energy": 10.0, "travel": 5.0, "rms": 4.0}
    nan = np.nan
    rows = Figures(
        settled_error=np.array([0.5, 1.0, np.inf]),
        settled_zone=np.zeros(3, int),
        peak=np.zeros(3),
        settling=np.array([30.0, nan, np.inf]),
        heating=np.full(3, nan),
        overshoot=np.array([1.0, nan, 1e300]),
        at_limits=np.array([20.0, nan, 0.0]),
        energy=np.array([5.0, 10.0, 0.0]),
        travel=np.array([10.0, 0.0, 0.0]),
        dip=np.full(3, nan),
        rms=np.array([9.0, 2.0, 1.0]),
        crossing=np.zeros(3),
        outside=np.array([45.0, 600.0, 1.0]),
    )
    # a reference that moves costs its r.m.s., one that stands its time outside and its overshoot
    expected = [3 + 0.5 + 1 + 2 + 0.5 + 2, 0.5 + 2 + 0 + 1, 1e4]
    np.testing.assert_allclose(panel.costs(rows, allowance), expected)
