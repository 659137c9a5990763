"""The plant: what it simulates, what can be seen and moved in it, where it rests, and what it refuses."""

import re
import tomllib

import control
import numpy as np
import pytest

from pipeline.temperature import plant as plants
from pipeline.temperature.plant import (
    at_disturbances,
    baam,
    bandwidth_rad_s,
    clip_spectral_radius,
    controllability,
    hold_output,
    hold_state,
    markov_parameters,
    observability,
    observable_part,
    plant,
    simulate,
    strictly_proper,
)

# a plant with everything in it: offsets, feed-through, two inputs for one output
SMALL = plant(
    [[0.5, 0.1], [0.0, 0.8]], [[1.0, 0.0], [0.5, 2.0]], [[1.0, 3.0]], D=[[0.25, 0.0]], b=[1.0, -1.0], d=[10.0]
)


def test_feed_through_as_one_sample_of_delay_answers_one_sample_late_and_is_strictly_proper():
    rng = np.random.default_rng(3)
    whole = plant(
        0.9 * np.eye(2),
        rng.standard_normal((2, 3)),
        rng.standard_normal((2, 2)),
        [[0.5, -1.0, 0.0], [0.0, 0.0, 0.0]],
        [0.1, 0.2],
        [3.0, 4.0],
    )
    proper, u = strictly_proper(whole), rng.standard_normal((50, 3))
    assert not proper.D.any()
    assert proper.n == whole.n + 1  # as many states as D has rank
    y = simulate(proper, u, np.zeros(3))[1]
    late = np.vstack([np.zeros((1, 3)), u[:-1]])
    expected = simulate(whole._replace(D=np.zeros((2, 3))), u, np.zeros(2))[1] + late @ whole.D.T
    np.testing.assert_allclose(y, expected, rtol=0, atol=1e-12)  # rounding
    assert strictly_proper(proper) is proper


def test_disturbances_held_at_a_level_are_part_of_the_offsets():
    rng = np.random.default_rng(4)
    whole = plant(0.9 * np.eye(2), rng.standard_normal((2, 3)), np.eye(2), rng.standard_normal((2, 3)))
    u, room = rng.standard_normal((20, 2)), 21.0
    told = simulate(whole, np.hstack([u, np.full((20, 1), room)]), np.zeros(2))[1]
    untold = simulate(at_disturbances(whole, 2, np.array([room])), u, np.zeros(2))[1]
    np.testing.assert_allclose(untold, told, rtol=1e-12)  # rounding


def test_the_study_s_machine_is_the_one_of_its_tables(shared):
    table = tomllib.loads(shared("spec/baam.toml").read_text())["plant"]
    for name in "ABC":
        np.testing.assert_array_equal(getattr(baam(), name), table[name])


def test_the_study_s_machine_nearly_integrates():
    slowest = np.abs(np.linalg.eigvals(baam().A)).max()
    # printed digits of the temperature notes' "open-loop pole at 1 + its band"
    assert slowest == pytest.approx(1.00000285, abs=1e-8)


def test_two_steps_by_hand():
    x, y = simulate(SMALL, np.array([[2.0, 0.0], [0.0, 1.0]]), np.array([4.0, 2.0]))
    # x1 = (2 + 0.2 + 2 + 1, 1.6 + 1 - 1), y0 = 4 + 6 + 0.5 + 10, y1 = 5.2 + 4.8 + 10
    np.testing.assert_allclose(x[1], [5.2, 1.6], rtol=1e-15)  # rounding of three sums
    np.testing.assert_allclose(x[2], [0.5 * 5.2 + 0.16 + 1, 0.8 * 1.6 + 2 - 1], rtol=1e-15)
    np.testing.assert_allclose(y[:, 0], [20.5, 20.0], rtol=1e-15)


def test_markov_parameters_are_the_response_to_a_unit_pulse():
    machine, lags = baam(), 7
    h = markov_parameters(machine, lags)
    for channel in range(machine.m):
        pulse = np.zeros((lags + 1, machine.m))
        pulse[0, channel] = 1.0
        # rounding of numbers near 1
        np.testing.assert_allclose(
            h[:, :, channel], simulate(machine, pulse, np.zeros(machine.n))[1][1:], atol=1e-14
        )


def test_the_study_s_machine_shows_every_state_and_obeys_in_every_state():
    assert observability(baam()) == controllability(baam()) == (6, "")


def test_a_state_that_never_shows_fails_with_a_reason():
    rank, hidden = observability(SMALL._replace(C=np.array([[0.0, 1.0]])))
    assert rank == 1
    assert re.match(
        r"the plant is not observable: rank 1 of 2, smallest singular values \[.*\]; add a sensor, or lower",
        hidden,
    )
    rank, deaf = controllability(SMALL._replace(B=np.array([[1.0, 0.0], [0.0, 0.0]])))
    assert rank == 1
    assert "not controllable: rank 1 of 2" in deaf
    assert controllability(SMALL._replace(B=np.zeros((2, 2))))[0] == 0


def test_the_holding_input_holds_every_cell():
    machine, x = baam(), np.full(6, 20.0)
    u = hold_state(machine, x)
    states, _ = simulate(machine, np.tile(u, (1000, 1)), x)
    np.testing.assert_allclose(states, 20.0, atol=1e-9)  # 1,000 steps of rounding at 20 °C
    assert np.linalg.norm(u) <= np.linalg.norm(
        hold_state(machine._replace(B=machine.B * [1, 1, 1, 1, 1, 1, 0]), x)
    )


@pytest.mark.parametrize(
    "machine", [baam(), SMALL, baam()._replace(b=np.linspace(-1, 1, 6), d=np.linspace(5, -5, 5))]
)
def test_the_holding_input_of_an_output_rests_there_and_is_the_smallest(machine):
    y = np.linspace(40.0, 60.0, machine.p)
    x, u = hold_output(machine, y)
    np.testing.assert_allclose(machine.A @ x + machine.B @ u + machine.b, x, atol=1e-11)  # rounding at 60 °C
    # rounding times the gain of 5e5 of the study's machine at rest
    np.testing.assert_allclose(machine.C @ x + machine.D @ u + machine.d, y, atol=1e-8)
    # smallest: the map from u to y at rest is surjective here, and its pseudo-inverse gives the least norm
    rest = machine.C @ np.linalg.inv(np.eye(machine.n) - machine.A)
    expected = np.linalg.pinv(rest @ machine.B + machine.D) @ (y - machine.d - rest @ machine.b)
    # both lose the digits of that gain, far below a percent of duty
    np.testing.assert_allclose(u, expected, atol=1e-6)


def test_an_integrator_holds_its_output_too():
    x, u = hold_output(plant([[1.0]], [[2.0]], [[1.0]]), np.array([150.0]))
    np.testing.assert_allclose([x[0], u[0]], [150.0, 0.0], atol=1e-10)  # rounding at 150 °C


def test_stored_plants_come_back_as_they_were():
    family = [SMALL._replace(K=np.array([[0.1], [0.2]]), sample_time_s=2.0), SMALL]
    arrays = plants.stored(family)
    assert all(unit and meaning for _, unit, meaning in arrays.values())
    for before, after in zip(
        family, plants.restored({name: values for name, (values, _, _) in arrays.items()}), strict=True
    ):
        for one, other in zip(before, after, strict=True):
            np.testing.assert_array_equal(one, other)


def test_a_matrix_of_the_wrong_shape_is_named():
    with pytest.raises(
        ValueError,
        match=re.escape("plant: b should have shape (2,) but has (3,); A is (2, 2), B (2, 2), C (1, 2)"),
    ):
        plant(SMALL.A, SMALL.B, SMALL.C, b=np.zeros(3))
    with pytest.raises(
        ValueError,
        match="plant: C holds a number that is not finite; identify the plant again on a clean record",
    ):
        plant(SMALL.A, SMALL.B, [[np.nan, 1.0]])


# ---- python-control


def test_control_s_forced_response_is_the_simulation():
    machine, rng = baam(), np.random.default_rng(0)
    u, x0 = rng.standard_normal((40, 7)), rng.standard_normal(6)
    system = control.ss(machine.A, machine.B, machine.C, machine.D, machine.sample_time_s)
    response = control.forced_response(system, np.arange(40) * machine.sample_time_s, u.T, x0)
    # rounding of 40 steps
    np.testing.assert_allclose(response.outputs.T, simulate(machine, u, x0)[1], atol=1e-11)


def test_the_observable_part_answers_as_the_whole():
    late = SMALL._replace(
        A=np.block([[SMALL.A, np.zeros((2, 1))], [np.ones((1, 2)), np.full((1, 1), 0.5)]]),
        B=np.vstack([SMALL.B, np.ones((1, SMALL.m))]),
        C=np.hstack([SMALL.C, np.zeros((SMALL.p, 1))]),
        b=np.r_[SMALL.b, 3.0],
        K=np.vstack([SMALL.K, np.ones((1, SMALL.p))]),
    )
    part = observable_part(late)
    assert part.n == 2 and observability(part) == (2, "") and observability(late)[0] == 2
    assert markov_parameters(part, 30) == pytest.approx(markov_parameters(late, 30), abs=1e-12)
    assert observable_part(SMALL) is SMALL


def test_the_bandwidth_of_a_first_order_plant_is_one_over_its_time_constant():
    a = np.exp(-1 / 200.0)
    first = plant([[a]], [[1 - a]], [[1.0]], sample_time_s=1.0)
    assert bandwidth_rad_s(first) == pytest.approx(1 / 200.0, rel=0.02)
    slower = first._replace(sample_time_s=3.0)
    assert bandwidth_rad_s(slower) == pytest.approx(1 / 600.0, rel=0.02)
    both = plant(np.diag([a, a**4]), np.diag([1 - a, 2 * (1 - a**4)]), np.eye(2))
    assert bandwidth_rad_s(both) == pytest.approx(4 / 200.0, rel=0.03)  # the stronger one is the faster
    assert bandwidth_rad_s(plant([[0.0]], [[1.0]], [[1.0]])) is None
    for restless in (1.0, 1.01):
        assert bandwidth_rad_s(plant([[restless]], [[1.0]], [[1.0]])) is None


def test_a_plant_with_dead_times_has_its_slow_pole_drawn_back_and_its_dead_times_kept():
    lag = np.zeros((4, 4))
    lag[0, 0], lag[0, 3] = 1.001, -0.5
    lag[2, 1] = lag[3, 2] = 1.0  # three samples of dead time: a chain without a modal basis
    clipped = clip_spectral_radius(lag, 0.999)
    assert np.sort(np.abs(np.linalg.eigvals(clipped)))[-1] <= 0.999
    np.testing.assert_allclose(clipped[1:], lag[1:], atol=1e-12)
    np.testing.assert_allclose(clipped[0], [0.999, 0, 0, -0.5], atol=5e-3)
