"""What the benchmark measures, by hand; and a person's two controllers hold a drawn machine."""

import shutil

import numpy as np
import pytest

from tests.foreign import benchmark, thermal_machines
from tests.foreign.thermal_machines import draw, quiet

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc on this machine; install gcc")


def test_settling_counts_to_the_last_sample_outside_the_band():
    y, r = np.array([[0.0], [8.0], [10.5], [12.0], [10.2], [9.9]]), np.full((6, 1), 10.0)
    assert benchmark.settling_s(y, r, 1.0, 2.0) == 8.0
    assert benchmark.settling_s(y, r, 2.5, 2.0) == 2.0
    assert benchmark.settling_s(y[:4], r[:4], 1.0, 2.0) == np.inf


def test_overshoot_is_past_the_reference_seen_from_the_start_in_the_worst_zone():
    y, r = np.array([[0.0, 30.0], [11.0, 19.0], [10.0, 17.0]]), np.tile([10.0, 20.0], (3, 1))
    assert benchmark.overshoot_degC(y, r, y[0]) == 3.0
    assert benchmark.overshoot_degC(y[:1], r[:1], y[0]) == 0.0


def test_least_squares_find_an_arx_model_and_its_order():
    rng, u, y = np.random.default_rng(3), np.zeros((4000, 1)), np.zeros((4000, 1))
    u[:, 0] = rng.uniform(0, 100, len(u))
    for k in range(2, len(y)):
        y[k] = 3.0 + 1.2 * y[k - 1] - 0.3 * y[k - 2] + 0.05 * u[k - 1] + 0.02 * u[k - 2]
        y[k] += 0.01 * rng.standard_normal()
    n, theta, sigma = benchmark.fit_arx([u], [y])
    assert n == 2
    np.testing.assert_allclose(theta[:, 0], [3.0, 1.2, -0.3, 0.05, 0.02], atol=0.02)
    assert sigma[0, 0] == pytest.approx(1e-4, rel=0.1)


def test_a_person_holds_a_machine_by_pi_and_by_arx_with_lqg(tmp_path):
    """Both settle from cold; the tuned PI overshoots by less than the share that is allowed, and settles no
    later than the untuned one."""
    machine, rng, logs = draw(1), np.random.default_rng([1, 1]), [tmp_path / "a.csv", tmp_path / "b.csv"]
    thermal_machines.write_csv(logs[0], machine, thermal_machines.record(machine, rng))
    thermal_machines.write_csv(logs[1], machine, thermal_machines.evening(machine, rng))
    T = round(1800 / machine.sample_time_s)
    r, outside, band = np.tile(machine.reference_degC, (T, 1)), quiet(machine, T), 2.05
    first, tuned = (
        benchmark.close(machine, benchmark.pi(machine, gains), r, outside)
        for gains in (machine.own_control, benchmark.tune_pi(machine))
    )
    _, _, act = benchmark.tune_lqg(machine, logs)
    model_based = benchmark.close(machine, act, r, outside)
    settled = [benchmark.settling_s(y, r, band, machine.sample_time_s) for y in (first, tuned, model_based)]
    assert settled[1] <= settled[0]
    assert settled[2] < 1.5 * settled[1]
    assert benchmark.overshoot_degC(tuned, r, tuned[0]) < 0.03 * (r[0] - machine.room_degC)
