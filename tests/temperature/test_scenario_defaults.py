"""What a rehearsal on somebody's record asks: scales near the machine's own, cases that the machine itself
can hold, references beyond reach named with what keeps them away."""

import numpy as np
import pytest

from pipeline.temperature.controllers import baseline
from pipeline.temperature.controllers.law import feasible_target
from pipeline.temperature.identification.model_choice import Settings, identify
from pipeline.temperature.plant import plant
from pipeline.temperature.test_set.scenario_defaults import (
    STEPS,
    CaseDefaults,
    MachineScale,
    defaults,
    machine_scale,
    steady_map,
)
from pipeline.temperature.tracking import aimed
from tests.temperature import small_machines
from tests.temperature.small_machines import BED, CHAMBER, HOT_END, KIT, MACHINES, SmallMachine

each_machine = pytest.mark.parametrize("machine", MACHINES, ids=lambda machine: machine.name)


def scale_of(machine: SmallMachine) -> MachineScale:
    of = small_machines.identified(machine)
    return machine_scale([of.u], [of.y], of.plant, machine.sample_time_s, [0])


def cases_of(machine: SmallMachine, reference=None, low=-np.inf, high=np.inf) -> CaseDefaults:
    asked = np.asarray(machine.reference if reference is None else reference, float)
    return defaults(
        scale_of(machine),
        small_machines.identified(machine).plant,
        (np.zeros(machine.m), np.full(machine.m, 100.0)),
        asked,
        np.full(machine.p, low),
        np.full(machine.p, high),
        machine.sample_time_s,
    )


def held_by(machine: SmallMachine, wanted: np.ndarray) -> np.ndarray:
    """Inputs of the zones' own heaters that hold the true machine at `wanted` (p,) °C, others at zero;
    by Newton's steps on its own balance of heat."""
    u = np.zeros(machine.m)
    u[: machine.p] = machine.centre[: machine.p]
    for _ in range(20):
        y = small_machines.true_outputs(small_machines.at_rest(machine, u))
        J = np.column_stack(
            [
                small_machines.true_outputs(small_machines.at_rest(machine, u + 0.01 * one)) - y
                for one in np.eye(machine.m)[: machine.p]
            ]
        )
        u[: machine.p] += np.linalg.solve(J / 0.01, wanted - y)
    return u


def hottest(machine: SmallMachine) -> np.ndarray:
    heaters = np.r_[np.full(machine.p, 100.0), np.zeros(machine.m - machine.p)]
    return small_machines.true_outputs(small_machines.at_rest(machine, heaters))


# ---- the machine


@each_machine
def test_the_time_constant_is_that_of_the_machine_s_own_step(machine):
    """From switched off to the record's centre: 63 % of the way, less the dead time."""
    scale, state, u = scale_of(machine), small_machines.at_rest(machine, np.zeros(machine.m)), machine.centre
    start, end = (
        small_machines.true_outputs(small_machines.at_rest(machine, np.asarray(level, float)))
        for level in (np.zeros(machine.m), u)
    )
    reached, t = np.full(machine.p, np.nan), 0
    while np.isnan(reached).any():
        share = (small_machines.true_outputs(state) - start) / (end - start)
        reached = np.where(np.isnan(reached) & (share >= 0.632), t * machine.sample_time_s, reached)
        state, t = small_machines.advanced(machine, state, np.asarray(u, float)), t + 1
    # zones that heat each other rise in two ways, of which a record shows one more than the other
    np.testing.assert_allclose(scale.time_constant_s, reached - scale.delay_s, rtol=0.35)


@each_machine
def test_the_delay_is_transport_and_lag_together(machine):
    scale, sample = scale_of(machine), machine.sample_time_s
    least = np.asarray(machine.delay_s)
    # what lies between heater and sensor, masses in series too, is at most some tenths of the time constant
    assert (scale.delay_s >= least - 1.5 * sample).all()
    assert (scale.delay_s < 0.2 * scale.time_constant_s).all()


@each_machine
def test_the_noise_is_that_of_the_sensor_and_its_converter(machine):
    """White noise and rounding to steps together, as variances; a model of few states adds some more."""
    expected = np.sqrt(machine.noise_degC**2 + np.asarray(machine.step_degC) ** 2 / 12)
    noise = scale_of(machine).noise_degC
    assert (noise > 0.8 * expected).all() and (noise < 1.7 * expected).all()


def test_a_model_that_is_far_off_makes_no_sensor_noisy():
    """Its errors of one step are some 50 °C; the readings wander by 0.1 °C from one to the next."""
    of = small_machines.identified(BED)
    off = of.plant._replace(d=of.plant.d + 50.0, K=np.zeros_like(of.plant.K))
    off = off._replace(A=0.5 * off.A)
    noise = machine_scale([of.u], [of.y], off, BED.sample_time_s, [0]).noise_degC
    expected = np.sqrt(np.mean(np.diff(of.y, axis=0) ** 2, axis=0))
    np.testing.assert_allclose(noise, expected, rtol=1e-12)
    assert (noise < 3 * scale_of(BED).noise_degC).all()


def test_a_spike_of_a_sensor_widens_neither_range_nor_noise():
    of = small_machines.identified(HOT_END)
    y = of.y.copy()
    y[900] = 900.0
    sane, spiked = (machine_scale([of.u], [part], of.plant, 1.0, [0]) for part in (of.y, y))
    np.testing.assert_allclose(
        spiked.high_degC, sane.high_degC, atol=0.5
    )  # a sample further down the quantile
    np.testing.assert_allclose(spiked.noise_degC, sane.noise_degC, rtol=0.25)


def test_another_room_shows_as_a_spread_of_ambient_and_one_recording_as_none():
    rooms = (18.0, 26.0)
    pairs = [small_machines.record(KIT._replace(room_degC=room), seed) for seed, room in enumerate(rooms)]
    u, y = [a for a, _ in pairs], [b for _, b in pairs]
    fit = identify(u, y, sample_time_s=1.0, settings=Settings(refinement="validated", recordings=(0, 1)))
    scale = machine_scale(u, y, fit.plant, 1.0, [0, 1])
    # radiation makes the colder machine's gain higher, which hides some
    np.testing.assert_allclose(scale.ambient_degC_spread, 8.0, rtol=0.15)
    np.testing.assert_array_equal(machine_scale(u, y, fit.plant, 1.0, [0, 0]).ambient_degC_spread, 0.0)


def test_a_drift_counts_as_no_longer_than_the_record_that_shows_it():
    rng, u = np.random.default_rng(1), np.repeat([[0.0], [40.0], [0.0], [40.0]], 100, axis=0)
    y = np.cumsum(np.full((400, 1), 0.05), axis=0) + 0.01 * np.cumsum(u, axis=0)
    y = y + 0.05 * rng.standard_normal(y.shape)
    model = plant([[1.0 - 1e-6]], [[0.01]], [[1.0]])
    assert machine_scale([u], [y], model, 1.0, [0]).time_constant_s[0] <= 400


# ---- the cases


@each_machine
def test_what_is_asked_can_be_held_by_the_machine_itself(machine):
    """Starts and references as true steady states of heaters from 0 to 100 %; the model says so, the machine
    knows."""
    cases = cases_of(machine)
    for wanted in (*cases.starts, *cases.references, *cases.sequence):
        u = held_by(machine, wanted)
        # the machine's losses grow with temperature: near the room a linear model is off by some percent
        assert (u > -5).all() and (u < 100).all()


@each_machine
def test_no_start_lies_below_the_room(machine):
    # noise and a converter's steps are all that a record is below its room
    assert (cases_of(machine).starts > machine.room_degC - 1.0).all()


@each_machine
def test_the_declared_reference_stays_where_it_can_be_held(machine):
    cases = cases_of(machine)
    np.testing.assert_array_equal(cases.references[0], machine.reference)
    assert cases.infeasible == []
    assert (cases.references[1] < cases.references[0]).all()


@each_machine
def test_a_reference_beyond_reach_names_the_zone_s_own_heater_at_its_upper_limit(machine):
    """60 °C above what its heater holds at 100 %, the other zones as declared; a bed at 100 % heats its
    chamber above what was asked of that, which is named too."""
    asked = np.asarray(machine.reference, float)
    asked[0] = hottest(machine)[0] + 60.0
    if machine.m > machine.p:  # a fan cools: the linear model holds a hotter end than the machine does
        asked[0] += 60.0
    cases = cases_of(machine, asked)
    first, *others = cases.infeasible
    assert (first.output, first.input, first.limit) == (0, 0, "high")
    assert cases.references[0, 0] < first.reachable_degC < first.asked_degC
    assert [(entry.input, entry.limit) for entry in others] == ([(1, "low")] if machine is CHAMBER else [])


def test_a_zone_beyond_reach_pulls_no_other_above_its_reference():
    """Least squares would heat the chamber to 157 °C, to help the bed. A bed that is held back for its
    headroom heats the chamber less, and that is named too."""
    cases = cases_of(CHAMBER, [240.0, 150.0])
    bed, chamber = cases.infeasible
    assert (bed.output, bed.input, chamber.output, chamber.input) == (0, 0, 1, 1)
    assert chamber.reachable_degC == pytest.approx(150.0, abs=0.1)  # what counts as reached
    assert cases.references[0, 1] < 150.0


def test_the_judged_reference_can_be_held_with_fifteen_percent_less_gain():
    cases, of = cases_of(BED, [200.0]), small_machines.identified(BED)
    G, g = steady_map(of.plant)
    needed = (cases.references[0] - g) / (0.85 * G[:, 0])
    assert 99.0 < needed[0] <= 100.0 + 1e-6


def test_a_declared_limit_of_an_output_is_named_and_kept():
    cases = cases_of(BED, [95.0], low=10.0, high=90.0)
    (only,) = cases.infeasible
    assert only.input is None and only.limit == "output high"
    assert (only.asked_degC, only.reachable_degC) == (95.0, pytest.approx(90.0))
    assert cases.references.max() == pytest.approx(90.0 - cases.band_degC)


def test_fewer_inputs_than_references_are_named_as_that():
    machine = plant(np.diag([0.95, 0.95]), [[0.1], [0.1]], np.eye(2))
    two = np.ones(2)
    scale = MachineScale(20 * two, two, 0 * two, 100 * two, 0.1 * two, 0 * two)
    limits = np.zeros(1), np.full(1, 100.0)
    cases = defaults(scale, machine, limits, np.array([50.0, 80.0]), -np.inf * two, np.inf * two, 1.0)
    assert [(entry.input, entry.limit) for entry in cases.infeasible] == [(None, "inputs")]


def test_a_fan_that_should_do_less_than_nothing_is_named_at_its_lower_limit():
    machine = plant([[0.95]], [[-0.05]], [[1.0]], b=[5.0])  # 100 °C with the fan off, 1 °C less a percent
    one = np.ones(1)
    scale = MachineScale(20 * one, one, 0 * one, 100 * one, 0.1 * one, 0 * one)
    limits = np.zeros(1), np.full(1, 100.0)
    (only,) = defaults(scale, machine, limits, np.array([120.0]), -np.inf * one, np.inf * one, 1.0).infeasible
    assert (only.input, only.limit) == (0, "low")
    assert only.reachable_degC == pytest.approx(100.0)


@each_machine
def test_pi_settles_the_machine_itself_within_the_rule(machine):
    """From the lower start to the declared reference within the band by `settling_s`, and it stays there: the
    rule is neither out of reach nor beside the point."""
    cases, of = cases_of(machine), small_machines.identified(machine)
    r, limits = cases.references[0], (np.zeros(machine.m), np.full(machine.m, 100.0))
    pairs = baseline.pairing(of.plant, *limits, horizon=cases.steps, noise_degC=of.noise_degC)
    target = feasible_target(of.plant, r, *limits)
    law = aimed(baseline.pi_law(pairs, inputs=machine.m), r, target.u, target.y)
    start = small_machines.at_rest(machine, np.clip(held_by(machine, cases.starts[0]), 0, 100))
    run = small_machines.driven(machine, law, start, r, cases.steps)
    outside = np.flatnonzero((np.abs(run.y - r) > cases.band_degC).any(axis=1))
    settled_s = (outside.max() + 1) * machine.sample_time_s
    assert settled_s < cases.settling_s
    assert settled_s > 0.05 * cases.settling_s


@each_machine
def test_eight_time_constants_fit_and_the_settled_window_lies_after_the_rule(machine):
    cases, tau = cases_of(machine), scale_of(machine).time_constant_s.max()
    assert STEPS[0] <= cases.steps <= STEPS[1]
    assert cases.steps * machine.sample_time_s >= 8 * tau
    assert 5 / 6 * cases.steps * machine.sample_time_s > cases.settling_s


@each_machine
def test_ramp_and_sinusoid_lie_between_the_two_references_with_the_heat_they_need(machine):
    cases, tau = cases_of(machine), scale_of(machine).time_constant_s.max()
    higher, lower = cases.references
    np.testing.assert_allclose(lower + cases.steps * cases.ramp_degC_per_step, higher)
    amplitude, period = cases.sinusoid
    assert cases.steps >= 2 * period
    # a first-order machine of the slowest lag needs hypot(1, omega tau) of what holding still does
    needed = amplitude * np.hypot(1, 2 * np.pi * tau / (period * machine.sample_time_s))
    assert (needed <= np.abs(higher - lower) / 2 * 1.01).all()  # a whole number of steps


def test_the_band_is_that_of_noise_or_span_and_at_most_one_degree():
    one = np.ones(1)
    machine, limits = plant([[0.95]], [[0.05]], [[1.0]]), (np.zeros(1), np.full(1, 100.0))

    def band(noise, span):
        scale = MachineScale(20 * one, one, 0 * one, span * one, noise * one, 0 * one)
        return defaults(scale, machine, limits, 0.5 * span * one, -np.inf * one, np.inf * one, 1.0).band_degC

    assert band(0.1, 10.0) == pytest.approx(0.3)
    assert band(0.01, 60.0) == pytest.approx(0.6)
    assert band(0.1, 300.0) == band(2.0, 10.0) == 1.0


def test_a_case_has_at_most_three_thousand_steps_however_slow_the_machine():
    one = np.ones(1)
    machine, limits = plant([[0.9999]], [[0.0001]], [[1.0]]), (np.zeros(1), np.full(1, 100.0))
    scale = MachineScale(10_000 * one, one, 0 * one, 80 * one, 0.1 * one, 0 * one)
    cases = defaults(scale, machine, limits, 50 * one, -np.inf * one, np.inf * one, 1.0)
    assert cases.steps == 3000


def test_an_integrating_machine_has_references_too():
    """A furnace without loss by its model: any temperature is held by next to nothing."""
    one = np.ones(1)
    machine, limits = plant([[1.0]], [[0.01]], [[1.0]]), (np.zeros(1), np.full(1, 100.0))
    scale = MachineScale(500 * one, one, 20 * one, 80 * one, 0.1 * one, 0 * one)
    cases = defaults(scale, machine, limits, 60 * one, -np.inf * one, np.inf * one, 1.0)
    assert cases.infeasible == [] and cases.references[0, 0] == 60.0
    assert np.isfinite(cases.starts).all()
