"""The plant family: each block of the chain against its closed form, the draws within their ranges, the noise
at its shares, the routine by its protocol."""

import math

import numpy as np
import pytest

from pipeline.deposition.drive import Drive
from pipeline.deposition.extruder import (
    Extruder,
    backlash,
    disturb,
    draw,
    flow,
    frequency_response,
    lagged,
    pressed,
    ramp,
    routine,
)

TS = 0.02
A = Extruder(1.08, 2.7)
STEADY = 2.432


def reference(**changes):
    settings = {
        "off_s": 4,
        "on_s": 6,
        "pause_s": 0.6,
        "tail_s": 8,
        "speed": 8.0,
        "bead_area_mm2": 0.304,
        "ramp_s": 0.15,
        "sample_time_s": TS,
    }
    return routine(**{**settings, **changes})


# ---- the chain


def test_the_nominal_step_response_is_first_order_at_every_sample():
    y = flow(A, np.full(500, 2.0), sample_time_s=TS)
    np.testing.assert_allclose(
        y, 2.0 * 1.08 * (1 - np.exp(-np.arange(500) * TS / 2.7)), atol=1e-12
    )  # rounding


def test_delay_and_lag_between_samples_equal_a_simulation_two_hundred_times_finer():
    u = np.random.default_rng(0).standard_normal(300)
    fine = lagged(np.repeat(u, 200), 0.073, 4.0, TS / 200).reshape(-1, 200).mean(axis=1)
    np.testing.assert_allclose(lagged(u, 0.073, 4.0, TS), fine, atol=1e-7)  # rounding of a pole at 1 - 1e-3


def test_a_delay_of_two_and_a_half_samples_halves_each_sample():
    u = np.array([1.0, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(lagged(u, 0.05, math.inf, TS), [0, 0, 0.5, 0.5, 0], atol=1e-12)  # rounding


@pytest.mark.parametrize(
    "extruder",
    [
        A,
        Extruder(0.5, 8.0, 0.113),
        Extruder(2.0, 1.0, 0.05, 3.0),
        Extruder(0.9, 4.5, 0.1, 6.0, creep_share=0.12),
    ],
)
def test_the_frequency_response_is_the_transform_of_the_pulse_response(extruder):
    pulse = pressed(extruder, np.eye(1, 16384)[0], sample_time_s=TS)
    f = np.fft.rfftfreq(16384, TS)
    # the creep's tail after 327 s is e^-16
    np.testing.assert_allclose(
        frequency_response(extruder, f, sample_time_s=TS), np.fft.rfft(pulse), atol=1e-6 * extruder.gain
    )


def test_a_play_of_two_by_hand():
    np.testing.assert_array_equal(
        backlash(np.array([0.5, 2.0, 3.0, 2.5, 1.5, 0.0, -3.0]), 2.0), [0, 1, 2, 2, 2, 1, -2]
    )


def test_the_output_of_a_play_stays_within_half_of_it():
    x = np.cumsum(np.random.default_rng(1).standard_normal(1000))
    y = backlash(x, 1.5)
    assert np.abs(x - y).max() <= 0.75 + 1e-12  # rounding
    assert np.all((np.diff(y) == 0) | (np.abs(np.abs(x - y)[1:] - 0.75) < 1e-12))  # it moves only when pushed


def test_below_the_yield_nothing_flows_and_above_it_the_yield_is_missing():
    plant = A._replace(yield_=0.2)
    assert flow(plant, np.full(3000, 0.18), sample_time_s=TS).max() == 0.0  # 1.08 x 0.18 < 0.2
    assert flow(plant, np.full(3000, 1.0), sample_time_s=TS)[-1] == pytest.approx(
        0.88, abs=1e-6
    )  # e^-22 of the step is left


def test_the_drive_cuts_the_command_at_its_limit():
    u = np.linspace(-9, 9, 500)
    np.testing.assert_array_equal(
        flow(A, u, sample_time_s=TS, drive=Drive(3.0, np.inf, 0.0)),
        flow(A, np.clip(u, -3, 3), sample_time_s=TS),
    )


def test_creep_holds_back_its_share_of_the_gain_and_gives_it_late():
    y = flow(A._replace(creep_share=0.12), np.ones(10000), sample_time_s=TS)
    assert y[1000] == pytest.approx(
        1.08 * (1 - 0.88 * np.exp(-20 / 2.7) - 0.12 * np.exp(-1)), abs=1e-9
    )  # 20 s: closed form
    assert y[-1] == pytest.approx(1.08, rel=1e-4)  # e^-10 of 12 % is left


def test_the_chain_is_nearly_the_same_at_another_sample_time():
    plant = Extruder(1.2, 3.0, 0.113, 4.0, 0.05, 0.1)
    coarse, fine = (
        flow(plant, reference(sample_time_s=ts).r / 1.08, sample_time_s=ts) for ts in (TS, TS / 10)
    )
    # the command is held for 20 ms instead of 2 ms: 9 ms later on a slope of 2.4 mm^3/s in 3 s
    np.testing.assert_allclose(coarse, fine[::10], atol=0.012)


def test_several_commands_at_once_press_what_each_presses_alone():
    u = np.random.default_rng(2).standard_normal((3, 200))
    plant = Extruder(1.2, 3.0, 0.113, 4.0, 0.05)
    np.testing.assert_array_equal(
        pressed(plant, u, sample_time_s=TS), [pressed(plant, row, sample_time_s=TS) for row in u]
    )


# ---- draws and noise


def test_draws_cover_their_ranges_and_keep_to_them():
    rng = np.random.default_rng(3)
    plants = [draw(rng, gain=1.08, time_constant_s=2.7, steady_flow=STEADY) for _ in range(400)]
    for off in ([p.gain / 1.08 - 1 for p in plants], [p.time_constant_s / 2.7 - 1 for p in plants]):
        assert 0.1 <= np.abs(off).min() and np.abs(off).max() <= 0.3
        assert 140 < np.sum(np.array(off) > 0) < 260  # six standard deviations of a fair coin
    for values, low, high in (
        ([p.delay_s for p in plants], 0.05, 0.15),
        ([p.lag_hz for p in plants], 3.0, 6.0),
        ([p.play * p.gain / STEADY for p in plants], 0.01, 0.04),
        ([p.yield_ / STEADY for p in plants], 0.02, 0.10),
    ):
        assert (
            low <= min(values) < low + 0.05 * (high - low)
            and high - 0.05 * (high - low) < max(values) <= high
        )


def test_the_same_seed_draws_the_same_plant_and_the_same_noise():
    def both(seed):
        rng = np.random.default_rng(seed)
        plant = draw(rng, gain=1.08, time_constant_s=2.7, steady_flow=STEADY)
        return plant, disturb(
            np.ones(50), rng, steady_flow=STEADY, white=0.03, drift=0.01, gain=0.01
        ).tobytes()

    assert both(7) == both(7) and both(7) != both(8)


@pytest.mark.parametrize("share", [{"white": 0.03}, {"drift": 0.01}, {"gain": 0.01}])
def test_each_kind_of_noise_has_its_share_of_the_steady_flow(share):
    rng, shares = np.random.default_rng(4), {"white": 0.0, "drift": 0.0, "gain": 0.0} | share
    errors = [disturb(np.full(300, STEADY), rng, steady_flow=STEADY, **shares) - STEADY for _ in range(800)]
    # 800 trials: the r.m.s. of one number a trial is known to 2.5 %, that of a walk to about twice that
    assert np.sqrt(np.mean(np.square(errors))) / STEADY == pytest.approx(next(iter(share.values())), rel=0.12)


# ---- the training routine


def test_the_wanted_flow_is_the_bead_area_times_the_speed_while_printing():
    task = reference()
    inside = (task.time_s > 4.2) & (task.time_s < 16.4)
    np.testing.assert_allclose(task.r[inside], 0.304 * task.speed[inside], atol=1e-9)  # rounding
    assert np.array_equal(task.printing, task.r > 0)


def test_the_reference_protocol_by_hand():
    task = reference()
    assert len(task.r) == 1230  # 24.6 s at 50 Hz
    assert (task.start_s, task.pause_s, task.stop_s) == (4.0, (10.0, 10.6), 16.6)
    assert task.r[: round(3.85 / TS)].max() == 0 and task.r[round(16.76 / TS) :].max() == 0
    assert task.r[round(4 / TS)] == pytest.approx(STEADY / 2)  # ramps are centred on the events
    assert task.r[round(10.3 / TS)] == 0 and task.speed[round(10.3 / TS)] == 0
    assert task.speed[0] == task.speed[-1] == 8.0  # ooze is laid on the line
    # the last sample is at 24.58 s; halves of ramps take 0.6 s off; trapezia of a curve of 0.15 s
    assert task.position[-1] == pytest.approx((24.58 - 0.6) * 8.0, abs=1e-3)


def test_a_ramp_is_a_step_after_two_moving_averages():
    t = np.arange(-4000, 4001) * 1e-4
    box = np.ones(1501) / 1501
    step = np.convolve(np.convolve(t >= 0, box, "same"), box, "same")
    inside = np.abs(t) < 0.2
    np.testing.assert_allclose(
        ramp(t, 0.15)[inside], step[inside], atol=2e-3
    )  # the boxes are whole samples wide


def test_a_ramp_longer_than_the_phase_before_the_start_is_refused():
    with pytest.raises(
        ValueError, match=r"expected a ramp above 0 s and at most 4 s.*but found 5 s; shorten the ramp"
    ):
        reference(ramp_s=5.0)
