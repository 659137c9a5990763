"""One panel, one yardstick: costs and margins against hand-made cases, and what a record is enough for."""

import re

import numpy as np
import pytest
import scipy.linalg
import scipy.signal

from pipeline.papers.published import GAMMA, REFERENCE, TAU
from pipeline.papers.study import data_sets, panel
from pipeline.temperature.controllers import window as window_route
from pipeline.temperature.controllers.kernel import window_law
from pipeline.temperature.plant import Plant, baam, plant
from pipeline.temperature.test_set import scorecard
from pipeline.temperature.test_set.scorecard import (
    CommonCost,
    Margins,
    closed_loop,
    cost,
    is_stable,
    law_response,
    margins,
    optimum,
    simulate,
)
from pipeline.temperature.tracking import Law, aimed, gains, observer_gain, observer_law

I5, I7 = np.eye(5), np.eye(7)
YARDSTICK = CommonCost(np.ones(5), np.ones(7), GAMMA)


def static(gain: float) -> Law:
    """u = gain (r - y), without memory."""
    empty = np.zeros((0, 1))
    return Law(
        np.zeros((0, 0)),
        empty,
        empty,
        empty,
        np.zeros(0),
        np.zeros((1, 0)),
        np.full((1, 1), gain),
        np.full((1, 1), -gain),
        np.zeros(1),
        empty,
        empty,
        np.zeros(0),
    )


def observer(q=1.0, r=1.0, tau=TAU, integral=0.0, machine=None) -> Law:
    machine = machine or baam()
    return observer_law(
        machine, gains(machine, q * I5, r * I7, GAMMA), observer_gain(machine, tau), integral=integral
    )


def spread(machine: Plant) -> list[Plant]:
    """The plant, with stronger and weaker inputs, and with more heat lost."""
    return [
        machine,
        machine._replace(B=1.15 * machine.B),
        machine._replace(B=0.85 * machine.B),
        machine._replace(A=machine.A - 0.005 * np.eye(machine.n)),
    ]


def scenarios(plants=None, noise=(0.0,), seeds=(1,), steps=60, hold=5, starts=(20.0,), references=None):
    references = [REFERENCE] if references is None else references
    return panel(
        plants or [baam()],
        starts=starts,
        references=references,
        noise=noise,
        seeds=seeds,
        steps=steps,
        hold=hold,
        cells=True,
    )


# ---- the panel


def test_a_panel_is_every_combination_and_noise_free_ones_once():
    cases = scenarios(
        spread(baam()),
        noise=(0.0, 0.1),
        seeds=(1, 2, 3),
        starts=(20.0, 70.0),
        references=[REFERENCE, REFERENCE - 15],
    )
    assert len(cases.r) == 4 * 2 * 2 * (1 + 3)
    assert (cases.noise == 0).all(axis=(0, 2)).sum() == 4 * 2 * 2
    np.testing.assert_array_equal(np.bincount(cases.plant), np.full(4, 16))


@pytest.mark.parametrize("cells", [True, False])
def test_every_scenario_starts_at_rest_where_it_says(cells):
    plants = spread(baam()._replace(b=np.linspace(-1, 1, 6), d=np.linspace(2, -2, 5)))
    cases = panel(
        plants,
        starts=[20.0, 90.0],
        references=[REFERENCE],
        noise=[0.0],
        seeds=[0],
        steps=5,
        hold=0,
        cells=cells,
    )
    for i, x0, u0, start in zip(cases.plant, cases.x0, cases.u0, np.tile([20.0, 90.0], 4), strict=True):
        # rounding at 90 °C
        np.testing.assert_allclose(plants[i].A @ x0 + plants[i].B @ u0 + plants[i].b, x0, atol=1e-10)
        np.testing.assert_allclose(x0 if cells else plants[i].C @ x0 + plants[i].d, start, atol=1e-8)


def test_every_controller_sees_the_same_noise_of_the_level_asked_for():
    levels = (0.0, 0.1, 0.5)
    noise = scenarios(noise=levels, seeds=(1, 2), steps=2000).noise
    np.testing.assert_array_equal(noise, scenarios(noise=levels, seeds=(1, 2), steps=2000).noise)
    # 10,000 draws: seven standard deviations
    np.testing.assert_allclose(noise.std(axis=(0, 2)), [0.0, 0.1, 0.1, 0.5, 0.5], rtol=0.05)
    np.testing.assert_allclose(noise[:, 3:], 5 * noise[:, 1:3], atol=1e-15)
    assert abs(np.corrcoef(noise[:, 1].ravel(), noise[:, 2].ravel())[0, 1]) < 0.07


# ---- simulation


def test_a_run_by_hand():
    """y = x, x+ = 0.5 x + u, u = 0.4 (r - y) from a hold at 10 with u0 =
    5: x = 10, 5 + 0.4 x 90 = 41, 20.5 + 23.6 = 44.1."""
    machine = plant([[0.5]], [[1.0]], [[1.0]])
    cases = panel(
        [machine], starts=[10.0], references=[[100.0]], noise=[0.0], seeds=[0], steps=3, hold=4, cells=False
    )
    y, u = simulate(cases, static(0.4))
    np.testing.assert_allclose(y[:, 0, 0], [10.0, 41.0, 44.1], rtol=1e-12)  # rounding
    np.testing.assert_allclose(u[:, 0, 0], [36.0, 23.6, 22.36], rtol=1e-12)
    error = np.array([90.0, 59.0, 55.9])
    expected = (0.9 ** np.arange(3)) @ (2 * error**2 + 3 * u[:, 0, 0] ** 2)
    assert cost(cases, (y, u), CommonCost(np.array([2.0]), np.array([3.0]), 0.9))[0] == pytest.approx(
        expected, rel=1e-12
    )


def test_a_cost_counts_true_outputs_and_applied_inputs():
    cases = scenarios(steps=3)
    run = np.tile(REFERENCE + 2.0, (3, 1, 1)), np.full((3, 1, 7), 100.0)
    assert cost(cases, run, YARDSTICK)[0] == pytest.approx(
        (1 + 0.99 + 0.99**2) * (5 * 4.0 + 7 * 1e4), rel=1e-14
    )


def test_a_law_aimed_at_the_hold_does_not_move_it():
    cases = scenarios(references=[baam().C @ np.full(6, 20.0)], hold=10)
    learned = window_law(np.random.default_rng(0).normal(size=(7, 24)) * 0.01, I7[:, :5], np.zeros(7), 2)
    law = aimed(learned, cases.r[0], cases.u0[0], cases.r[0])
    _, u = simulate(cases, law)
    np.testing.assert_allclose(u[0], cases.u0, atol=1e-10)  # hand-over without a bump: rounding at 20 °C


# ---- cost and regret


def test_nothing_is_cheaper_than_the_optimum_and_the_observer_is_nearly_as_cheap():
    plants = spread(baam())
    cases = scenarios(plants, steps=1500, starts=(20.0, 45.0))
    best = optimum(cases, YARDSTICK)
    for law in (observer(), observer(q=0.5), observer(r=0.5)):
        # 0.99^1500 of a cost
        assert ((cost(cases, simulate(cases, law), YARDSTICK) / best - 1) > -1e-12).all()
    nominal = cases.plant == 0
    mine = cost(cases, simulate(cases, observer()), YARDSTICK) / best - 1
    assert mine[nominal].max() < 1e-5
    assert mine[~nominal].max() > 1e-3


# ---- margins


def delayed(machine: Plant, samples: int) -> Plant:
    """The plant whose outputs reach the controller `samples` later."""
    for _ in range(samples):
        A = scipy.linalg.block_diag(machine.A, np.zeros((machine.p, machine.p)))
        A[machine.n :, : machine.n] = machine.C
        machine = plant(
            A,
            np.vstack([machine.B, np.zeros((machine.p, machine.m))]),
            np.hstack([np.zeros((machine.p, machine.n)), np.eye(machine.p)]),
        )
    return machine


def first_unstable_delay(machine: Plant, law: Law, *, most: int) -> float:
    return next(
        (
            k
            for k in range(most)
            if np.abs(np.linalg.eigvals(closed_loop(delayed(machine, k), law))).max() >= 1
        ),
        np.inf,
    )


@pytest.mark.parametrize(
    ("q", "r", "theirs"), [(1.0, 1.0, 0.8169267314140494), (0.01, 1.0, 1.2776318872718104)]
)
def test_the_disk_margin_of_many_channels_is_control_s(q, r, theirs):
    """The smaller margin of the loops at the plant's outputs and at its inputs, against control.disk_margins.

    Both bound the structured singular value from above. Ours balances the channels by Osborne's scaling,
    theirs finds the best scaling (AB13MD of SLICOT). Ours stays in the pipeline: it takes 0.01 s a loop and
    theirs 0.7 s on the same grid, after 0.7 s for the import of control, and every trial of the search for
    practical weights asks for one. `theirs` is the smaller of control.disk_margins(G * K, omega)[0] and of
    K * G, by control 0.10.2 with slycot 0.7.1 on the grid of `margins`: 60 frequencies in a geometric row
    from 1e-4 to 0.3 rad, and 60 in a linear one from there to pi. slycot is not installed any more: control
    would use it elsewhere too, unasked.
    """
    machine, law = baam(), observer(q, r)
    ours = margins([machine], law, grid=120)[0].disk
    # ours is smaller, by 0.003 % and by 0.84 %
    assert ours == pytest.approx(theirs, rel=0.01)
    # the best scaling gives the largest margin; 1e-4 for where their search ends
    assert ours <= theirs * (1 + 1e-4)


def test_the_disk_margin_of_the_textbook_loop():
    """L = 25 / (s^3 + 10 s^2 + 10 s + 10): alpha = 0.46 (Seiler, Packard, Gahinet 2020, section II), sampled
    so fast that its hold costs half a percent."""
    A, B, C, _, _ = scipy.signal.cont2discrete(scipy.signal.tf2ss([25.0], [1.0, 10.0, 10.0, 10.0]), 0.002)
    # printed digits
    assert margins([plant(A, B, C, sample_time_s=0.002)], static(1.0), grid=2000)[0].disk == pytest.approx(
        0.46, abs=0.005
    )


@pytest.mark.parametrize(("a", "b", "k"), [(0.9, 0.5, 0.6), (0.5, 1.0, 1.2), (1.0, 0.1, 3.0)])
def test_the_disk_margin_of_a_first_order_loop_in_closed_form(a, b, k):
    """S - 1/2 = (z - a - bk) / (2 (z - a + bk)) is largest at z = 1 or z = -1."""
    expected = 2 * min(abs(z - a + b * k) / abs(z - a - b * k) for z in (1, -1))
    # the grid starts at 1e-4 rad
    assert margins([plant([[a]], [[b]], [[1.0]])], static(k))[0].disk == pytest.approx(expected, rel=1e-3)


def test_with_fewer_inputs_than_outputs_what_the_integrator_holds_unseen_is_no_mode_of_the_loop():
    """Step by step: plant and memory come to rest as fast as the largest eigenvalue says, while two
    directions of xi, which move none of the three inputs, stay where they are."""
    machine = baam()._replace(B=baam().B[:, :3], D=baam().D[:, :3])
    law = observer_law(
        machine, gains(machine, I5, np.eye(3), GAMMA), observer_gain(machine, TAU), integral=0.02
    )
    x, z, xi = np.ones(machine.n), np.zeros(machine.n), np.ones(5)
    sizes = []
    for _ in range(8000):
        y = machine.C @ x
        u = -law.K @ z - law.D @ y - law.K_r @ xi
        x, z, xi = machine.A @ x + machine.B @ u, law.A @ z + law.B_u @ u + law.B_y @ y, xi - law.integral * y
        sizes.append(np.linalg.norm(x))
    radius = np.abs(np.linalg.eigvals(closed_loop(machine, law))).max()
    assert radius < 1
    assert np.linalg.norm(xi) > 0.1
    # the next mode, 0.9972 beside 0.9978, still has a hundredth of it: a thousandth of that a step
    assert (sizes[7000] / sizes[6000]) ** 1e-3 == pytest.approx(radius, abs=1e-5)
    assert margins([machine], law)[0].stable


@pytest.mark.parametrize("integral", [0.0, 0.02])
@pytest.mark.parametrize(
    ("q", "r", "tau"),
    [
        (1.0, 1.0, 0.002),
        (0.1, 1.0, 0.002),
        (0.01, 1.0, 0.002),
        (1.0, 3.0, 2.0),
        (1.0, 10.0, 2.0),
        (3.0, 0.3, 0.002),
    ],
)
def test_the_delay_margin_is_where_more_delay_destabilises(q, r, tau, integral):
    law = observer(q, r, tau, integral)
    margin, first = margins([baam()], law)[0].delay_s, first_unstable_delay(baam(), law, most=30)
    assert first >= margin - 1e-9  # a margin never promises too much
    # and little too little: a grid of 400 frequencies costs a few percent
    assert first <= np.ceil(1.08 * margin + 1e-9)


def test_the_delay_margin_is_counted_in_seconds():
    machine = plant([[0.9]], [[0.5]], [[1.0]])
    one, slow = margins([machine, machine._replace(sample_time_s=4.0)], static(0.6))
    assert slow.delay_s == pytest.approx(4 * one.delay_s, rel=1e-12)
    assert first_unstable_delay(machine, static(0.6), most=20) == np.ceil(one.delay_s)


def test_a_loop_whose_gain_stays_below_one_bears_any_delay():
    assert margins([plant([[0.5]], [[1.0]], [[1.0]])], static(0.3))[0].delay_s == np.inf


def test_an_unstable_loop_has_no_margin():
    steady = plant([[0.5]], [[1.0]], [[1.0]])
    unstable = plant([[3.5]], [[1.0]], [[1.0]])
    assert margins([unstable], static(2.0)) == [Margins(0.0, 0.0, False)]
    # beside others, each has its own
    found = margins([unstable, steady, unstable], static(1.0))
    assert found == [Margins(0.0, 0.0, False), *margins([steady], static(1.0)), Margins(0.0, 0.0, False)]


@pytest.mark.parametrize("radius", [0.0, 0.5, 1 - 1e-6, 1.0, 1 + 1e-6, 3.0])
def test_a_matrix_is_stable_if_its_largest_eigenvalue_is_inside_the_unit_circle(radius: float):
    """In a basis in which it first grows a thousandfold."""
    rng = np.random.default_rng(2)
    eigenvalues = radius * np.r_[1.0, rng.uniform(-1, 1, 7)]
    A = np.diag(eigenvalues) + 10.0 * np.triu(rng.standard_normal((8, 8)), 1)
    assert is_stable(A) == (radius < 1)


@pytest.mark.parametrize("integral", [0.0, 0.02])
def test_the_frequency_response_of_a_law_is_its_answer_to_a_sinusoid(integral):
    law, omega = observer(tau=2.0, integral=integral), 0.7
    steps = 8000
    direction = np.linspace(1, 2, 5)
    z, xi, u = np.zeros(6, complex), np.zeros(5, complex), None
    if integral:  # start the integrator on its steady oscillation: alone it forgets nothing
        xi = -integral * direction / (np.exp(1j * omega) - 1)
    for t in range(steps):
        y = direction * np.exp(1j * omega * t)
        u = -(law.K @ z + law.D @ y + law.K_r @ xi)
        z, xi = law.A @ z + law.B_u @ u + law.B_y @ y, xi - integral * y
    expected = (
        -law_response(law, np.array([np.exp(1j * omega)]))[0] @ direction * np.exp(1j * omega * (steps - 1))
    )
    # the slowest pole of the law is 0.9973: 4e-10 of the start is left
    np.testing.assert_allclose(u, expected, atol=1e-8)


# ---- what a record is enough for


@pytest.fixture(scope="module")
def learned():
    """Record, and window, from 1,500 slightly noisy samples of the study's probing."""
    u, y = data_sets(np.random.default_rng(7), 1500, 1)
    u, y = u[:, 0], y[:, 0] + 0.05 * np.random.default_rng(0).standard_normal((1500, 5))
    return u, y, window_route.learn([u], [y], longest=8)


def check_run(model, steps):
    return panel(
        [window_route.predictor(model)],
        starts=[20.0],
        references=[REFERENCE],
        noise=[0.0],
        seeds=[0],
        steps=steps,
        hold=0,
        cells=False,
    )


def test_a_longer_record_is_asked_for_where_noise_costs_too_much(learned):
    u, y, long = learned
    run = check_run(long, 200)

    def law(u, y):
        half = window_route.learn(u, y, longest=long.N)
        return window_route.law(half, np.diag(YARDSTICK.q), np.diag(YARDSTICK.r), YARDSTICK.gamma)

    rule = {
        "whole": scorecard.optimum(run, YARDSTICK)[0],
        "samples": long.samples,
        "least": 2 * long.Theta.shape[1],
    }
    half_gap, at_least = scorecard.sufficiency([u], [y], law, YARDSTICK, run, allowed=0.01, **rule)
    assert 0 < half_gap < 0.01
    assert at_least >= rule["least"]
    _, needed = scorecard.sufficiency([u], [y], law, YARDSTICK, run, allowed=half_gap / 20, **rule)
    assert needed == pytest.approx(10 * long.samples, abs=1)  # half of the gap, over a twentieth of it


def test_the_state_of_algorithm_2_is_chosen_from_the_record_and_refusals_are_kept(learned):
    u, y, long = learned
    candidates = scorecard.kernel_candidates(
        [u], [y], long, YARDSTICK, check_run(long, 200), largest=3, offset=False
    )
    assert [c.state for c in candidates] == ["window of 1", "window of 2", "window of 3", "predicted state"]
    gaps = {c.state: c.gap for c in candidates}
    assert min(gaps["window of 2"], gaps["predicted state"]) < min(0.01, gaps["window of 1"])
    less = window_route.learn([u[:300]], [y[:300]], longest=4)
    short = scorecard.kernel_candidates(
        [u[:300]], [y[:300]], less, YARDSTICK, check_run(less, 50), largest=2, offset=False
    )
    refused = {c.state: c for c in short}["window of 2"]
    assert (refused.learned, refused.gap) == (None, float("inf"))
    assert re.search(r"expected at least 496 samples .* record 198 more", refused.refusal)
