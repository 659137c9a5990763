"""PI on machines that `Plant` did not make: ten simulated small ones, each identified from its own record,
and records of real ones."""

import numpy as np
import pytest

from pipeline.temperature.controllers import baseline
from pipeline.temperature.controllers.law import feasible_target
from pipeline.temperature.identification.model_choice import identify
from pipeline.temperature.plant import strictly_proper
from pipeline.temperature.test_set.scorecard import closed_loop
from pipeline.temperature.tracking import aimed
from tests.temperature import small_machines
from tests.temperature.fits import resampled
from tests.temperature.small_machines import HOT_END, KIT, MACHINES

each_machine = pytest.mark.parametrize("machine", MACHINES, ids=lambda machine: machine.name)


def limits(inputs: int) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros(inputs), np.full(inputs, 100.0)


def pi_of(of: small_machines.IdentifiedMachine) -> baseline.Pairing:
    return baseline.pairing(
        of.plant, *limits(of.plant.m), horizon=600, family=of.family, noise_degC=of.noise_degC
    )


def steady_gains(machine: small_machines.SmallMachine) -> np.ndarray:
    """°C a percent (p, m) of the machine itself about the record's centre."""
    centre = np.asarray(machine.centre)
    rest = small_machines.true_outputs(small_machines.at_rest(machine, centre))
    raised = [
        small_machines.true_outputs(small_machines.at_rest(machine, centre + one)) - rest
        for one in np.eye(machine.m)
    ]
    return np.column_stack(raised)


def test_the_machine_keeps_its_balance_of_heat():
    """At rest what a heater gives is what the room takes: by hand, 50 % of 0.4 W a percent against losses at
    the temperatures of block and nozzle."""
    x = small_machines.at_rest(HOT_END, np.array([50.0])).x[:2]
    above, fourth = x - 22.0, (x + 273.15) ** 4 - 295.15**4
    lost = np.dot(HOT_END.loss, above) + np.dot(HOT_END.radiates, fourth)
    np.testing.assert_allclose(lost, 20.0, rtol=1e-6)  # the Newton steps end where they stop


def test_a_sensor_says_whole_steps_of_its_converter():
    _, y = small_machines.record(KIT._replace(samples=200))
    np.testing.assert_allclose(y / 0.32, np.round(y / 0.32), atol=1e-9)  # rounding of the division


@each_machine
def test_pi_of_a_record_has_the_machine_s_sign_and_its_own_heater(machine):
    pairs = pi_of(small_machines.identified(machine))
    gains = steady_gains(machine)
    np.testing.assert_array_equal(pairs.inputs, range(machine.p))  # heaters are numbered as their zones
    truth = gains[np.arange(machine.p), pairs.inputs]
    assert (np.sign(pairs.gain) == np.sign(truth)).all()
    assert np.isfinite(pairs.gain).all() and np.isfinite(pairs.reset).all()
    # radiation and fans make a machine's gain differ by some 20 % over the range of its record
    np.testing.assert_allclose(pairs.slope * pairs.time_constant, truth, rtol=0.3)


@each_machine
@pytest.mark.parametrize("start", ("cold", "centre"))
def test_pi_of_a_record_settles_the_machine_itself(machine, start):
    """True temperatures over the last sixth of 1500 samples: on the reference, at rest, never far above."""
    of = small_machines.identified(machine)
    r, low, high = np.asarray(machine.reference), *limits(machine.m)
    target = feasible_target(of.plant, r, low, high)
    law = aimed(baseline.pi_law(pi_of(of), inputs=machine.m), r, target.u, target.y)
    u = np.zeros(machine.m) if start == "cold" else np.asarray(machine.centre)
    run = small_machines.driven(machine, law, small_machines.at_rest(machine, u), r, 1500)
    last = run.y[-250:]
    # a sensor of 0.5 °C steps leaves its loop 0.25 °C either side
    assert np.abs(last.mean(axis=0) - r).max() < 0.25
    assert np.ptp(last, axis=0).max() < 1.0
    # a converter's noise moves an input by NOISE_SHARE a standard deviation: six of them, either side
    assert np.ptp(run.u[-250:], axis=0).max() < 12 * baseline.NOISE_SHARE * 100
    if start == "cold":
        assert (run.y - r).max() < 3.0


# ---- records of real machines


def real_pairs(u: np.ndarray, y: np.ndarray) -> tuple[baseline.Pairing, small_machines.IdentifiedMachine]:
    of = small_machines.identified_record(u, y, 1.0, None)
    return pi_of(of), of


@pytest.mark.parametrize("kit", ("energy_balance_mimo", "second_order_mimo"))
def test_pi_of_a_real_two_heater_kit_heats_to_warm(shared, kit):
    path = shared(f"data/tclab_apmonitor/{kit}.csv")
    sample = 1.0 if kit == "energy_balance_mimo" else 3.0
    pairs, _ = real_pairs(*resampled(path, sample, ([1, 2], [3, 4])))
    np.testing.assert_array_equal(pairs.inputs, [0, 1])
    assert (pairs.gain > 0).all()
    # by hand some 5 to 20 %/°C; slopes between single samples gave 25 and 525
    assert (pairs.gain < 40).all()
    assert (pairs.reset * sample > 30).all() and np.isfinite(pairs.reset).all()


def test_pi_of_a_real_kit_s_binary_record_heats_to_warm(shared):
    record = np.genfromtxt(shared("data/tclab_mlid_prbs/prbs.csv"), delimiter=",", skip_header=1)
    pairs, _ = real_pairs(record[:, 1:3], record[:, 3:5])
    np.testing.assert_array_equal(pairs.inputs, [0, 1])
    # the published gains of such kits are 0.3 to 0.8 °C/%, and the heaters are not alike
    assert (pairs.gain > 2).all() and (pairs.gain < 60).all()


def test_pi_of_one_real_kit_holds_another(shared):
    """Two kits of one make, recorded by other people in other rooms: PI of the first on the model of the
    second is stable, with half as much gain again too."""
    path = shared("data/tclab_apmonitor/energy_balance_mimo.csv")
    pairs, _ = real_pairs(*resampled(path, 1.0, ([1, 2], [3, 4])))
    record = np.genfromtxt(shared("data/tclab_mlid_prbs/prbs.csv"), delimiter=",", skip_header=1)
    _, of = real_pairs(record[:, 1:3], record[:, 3:5])
    for factor in (1.0, 1.5):
        law = baseline.pi_law(pairs._replace(gain=factor * pairs.gain), inputs=2)
        loop = closed_loop(strictly_proper(of.plant), law)
        assert np.abs(np.linalg.eigvals(loop)).max() < 1


def test_pi_of_a_real_hair_dryer_is_that_of_its_dead_time(shared):
    """Three samples of dead time as documented, and a gain of 0.9."""
    record = np.loadtxt(shared("data/daisy_a/dryer.dat"))
    pairs, _ = real_pairs(record[:, :1], record[:, 1:])
    assert pairs.gain[0] > 0
    np.testing.assert_allclose(pairs.delay[0], 2.5, atol=0.5)  # three lags, the first of them the sampler's
    np.testing.assert_allclose(pairs.slope * pairs.time_constant, 0.95, rtol=0.2)


def test_pi_of_a_real_evaporator_has_the_sign_of_the_identified_steady_gains(shared):
    record = np.loadtxt(shared("data/daisy_a/evaporator.dat"))[:3000]
    pairs, of = real_pairs(record[:, :3], record[:, 3:])
    steady = of.plant.C @ np.linalg.solve(np.eye(of.plant.n) - of.plant.A, of.plant.B) + of.plant.D
    assert (np.sign(pairs.gain) == np.sign(steady[np.arange(3), pairs.inputs])).all()
    assert np.isfinite(pairs.reset).all()


def test_a_real_furnace_with_fewer_inputs_than_outputs_is_refused(shared):
    record = np.loadtxt(shared("data/daisy_a/glassfurnace.dat"))
    of = identify([record[:, 1:4]], [record[:, 4:]], sample_time_s=1.0)
    with pytest.raises(ValueError, match="PI needs an input for each of the 6 outputs; found 3 inputs"):
        baseline.pairing(of.plant, *limits(3), horizon=600)
