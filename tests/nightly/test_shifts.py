"""The machines and operators that nights are played on: each fault does what its name says, so that a night
is blamed for nothing that was not there."""

import numpy as np
import pytest

from benchmarks import screened_nights, shifts
from benchmarks.shifts import Fault
from pipeline.report.shared.night import Alarm

NO_FAULT = Fault()
STILL = shifts.Operator(0.0, 0.0)  # dithers, and answers to nothing
QUIET = shifts.calm(shifts.AMBIENT_DEGC)


def shift(fault=NO_FAULT, *, operator="proportional", machine="walls", around=QUIET, seed=1):
    rng = np.random.default_rng(seed)
    return shifts.record(shifts.MACHINES[machine], shifts.OPERATORS[operator], fault, around, rng)


@pytest.mark.parametrize("machine", shifts.MACHINES)
@pytest.mark.parametrize("operator", shifts.OPERATORS)
def test_a_good_shift_stays_at_the_references_within_what_the_dither_moves(machine, operator):
    columns = shift(machine=machine, operator=operator)
    for name, reference in zip(("sensor_1", "sensor_2"), shifts.REFERENCE_DEGC, strict=True):
        # 8 % of dither held for a minute move a zone by at most 1.6 * 8 / (1 + 0.5 * 1.6) = 7 °C
        assert np.abs(columns[name] - reference).max() < 7.5
        assert abs(columns[name].mean() - reference) < 2.5


def test_an_integrating_operator_reads_the_reference_off_a_wrong_sensor_and_a_proportional_one_does_not():
    """With 1.5 °C too much on the sensor, the integrator takes it away by its input; the other lets
    1.5 / (1 + 0.5 K) of it stand, K between 1 and 1.6 °C a percent."""
    wrong, by = Fault(sensor_degC=(1.5, 0.0)), {}
    for operator in shifts.OPERATORS:
        good, bad = (shift(fault, operator=operator) for fault in (Fault(), wrong))
        by[operator] = [(bad[name] - good[name]).mean() for name in ("sensor_1", "heater_1")]
    assert abs(by["integrating"][0]) < 0.1 and by["integrating"][1] < -1.0
    assert 0.7 < by["proportional"][0] < 1.2 and by["proportional"][1] == pytest.approx(
        -0.5 * by["proportional"][0], rel=0.05
    )


def test_a_delayed_input_is_answered_so_much_later():
    """The same shift in open loop: what one heater does comes 8 s later, the rest at once."""
    plain, late = (
        shifts.record(
            shifts.MACHINES["linear"], STILL, Fault(delay_s=delay, noise=(0.0, 0.0)), QUIET,
            np.random.default_rng(1),
        )
        for delay in ((0, 0), (8, 0))
    )  # fmt: skip
    np.testing.assert_array_equal(late["heater_1"], plain["heater_1"])
    # zone 2 hears of heater 1 through zone 1 alone, which adds 0.1 / 1.1 of what it does there
    np.testing.assert_allclose(late["sensor_1"][308:], plain["sensor_1"][300:-8], atol=0.15)
    assert np.abs(late["sensor_1"] - plain["sensor_1"]).max() > 1.0


@pytest.mark.parametrize("operator", shifts.OPERATORS)
def test_more_is_asked_of_a_capped_heater_than_it_gives_for_a_tenth_of_the_record(operator):
    columns = shift(Fault(cap_percent=(100.0, 78.0)), operator=operator)
    assert (columns["heater_2"] > 78.0).mean() > 0.1  # the limit of nightly.drift.at_limits_points


def test_what_is_commanded_beyond_the_cap_heats_nothing():
    free, capped = (
        shifts.record(
            shifts.MACHINES["linear"], STILL, Fault(cap_percent=(100.0, cap)), QUIET, np.random.default_rng(1)
        )
        for cap in (100.0, 78.0)
    )
    np.testing.assert_array_equal(free["heater_2"], capped["heater_2"])
    lost = (np.maximum(free["heater_2"] - 78.0, 0.0)).mean()
    # 1.2 °C a percent over 1.1 of loss and coupling; what came before the record counts too
    assert (free["sensor_2"] - capped["sensor_2"]).mean() == pytest.approx(1.1 * lost, rel=0.3)


def test_a_clock_that_is_late_moves_the_outputs_against_the_inputs():
    good = {"heater_1": np.arange(10.0), "sensor_1": np.arange(10.0)}
    late, early = (screened_nights._clock(seconds)(good) for seconds in (3, -3))
    np.testing.assert_array_equal(late["heater_1"] - late["sensor_1"], 3.0)
    np.testing.assert_array_equal(early["heater_1"] - early["sensor_1"], -3.0)


def test_an_alarm_is_held_against_kind_channel_and_night():
    scenario = screened_nights.scenarios()["gain_creep_5"]
    sizes = [scenario.size(k) for k in range(1, scenario.nights + 1)]

    def outcome(night, cause):
        told = [screened_nights.Told([], "") for _ in sizes]
        told[night - 1] = screened_nights.Told([Alarm("temperature", "", "", cause, 6.0)], "")
        return screened_nights._outcome(scenario, told, sizes, "parameter_percent", 4.0)

    right = "the gain from heater_1 has changed by -4.3 %"
    assert outcome(18, right)["passed"]
    assert outcome(18, f"{right}, or the time constants of what answers to heater_1")["passed"]
    assert not outcome(22, right)["in_time"]  # 5 % is over 4 % from night 17 on
    assert outcome(3, right)["early"]
    assert not outcome(18, "the gain from heater_2 has changed by -4.3 %")["right"]
    assert not outcome(18, "sensor_1 reads +1.5 °C: its offset has changed")["right"]


def test_there_are_twenty_mistakes_and_a_right_reason_is_told_from_a_wrong_one():
    mistakes = screened_nights.mistaken()
    assert len(mistakes) == 20
    late = next(one for one in mistakes if one.name == "clock +20 s")
    assert screened_nights.explains(late, "x.csv: the outputs' clock is 19 s late; mend it")
    assert not screened_nights.explains(late, "x.csv: the outputs' clock is 5 s late; mend it")
    tenth = next(one for one in mistakes if one.name == "heater_1 x 0.1")
    assert screened_nights.explains(tenth, "heater_1 is a tenth of what is declared")
    assert not screened_nights.explains(tenth, "sensor_1 is in °F where °C is declared")
