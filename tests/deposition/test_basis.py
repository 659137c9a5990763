"""The basis-function composer: the inverse of the chain that it is made from, whatever
is wanted; the weights of its docstring; limits."""

import numpy as np
import pytest

from pipeline.deposition.drive import Drive, at_limit, follows
from pipeline.deposition.extruder import Extruder, draw, lagged, ramp
from pipeline.deposition.parts import basis
from pipeline.deposition.parts.chain import IdentifiedExtruder
from tests.deposition.trained import TS, percent_of_on_off, protocol

STEADY = 2.432


def dashes(on_s=0.4, off_s=0.4, count=12, amount=STEADY):
    one = np.repeat([amount, 0.0], [round(on_s / TS), round(off_s / TS)])
    return basis.boxed(np.concatenate([np.zeros(200), np.tile(one, count), np.zeros(300)]), 0.15, TS)


@pytest.mark.parametrize("creep_share", [0.0, 0.12])
@pytest.mark.parametrize("seed", range(8))
def test_on_the_chain_that_it_knows_the_flow_is_the_wanted_flow(seed, creep_share):
    plant = draw(
        np.random.default_rng(seed),
        gain=1.08,
        time_constant_s=2.7,
        steady_flow=STEADY,
        creep_share=creep_share,
    )
    for r in (protocol().r, protocol(12.0, 0.2).r, dashes()):
        u = basis.compose(plant, r, sample_time_s=TS)
        # what is left: the dither that the time constant lets through, and what the lag swallowed for good
        assert percent_of_on_off(plant, u, r) < 0.6


def test_the_weights_are_those_of_the_docstring():
    K, tau, T, c = 1.1, 3.0, 20.0, 0.12
    t = np.arange(3000) * 0.001
    x = np.sin(2 * t) ** 2 * (t < 2.5)
    sigma = (1 - c) * T + c * tau
    rate = tau * T / (sigma * K)
    level = (tau + T - tau * T / sigma) / (sigma * K)
    a = np.exp(-0.001 / sigma)
    slow = np.zeros_like(x)
    for k in range(len(x) - 1):
        slow[k + 1] = a * slow[k] + (1 - a) * x[k]
    expected = rate * np.gradient(x, 0.001) + level * x + (1 / K - level) * slow
    u = basis._inverse(IdentifiedExtruder(K, tau, creep_share=c, creep_time_s=T), x / K, 0.001)
    np.testing.assert_allclose(
        u[:2400], expected[:2400], atol=0.01 * expected.max()
    )  # 1 ms steps against derivatives; the cut at 2.5 s left out


def test_the_ramp_is_that_of_the_routine_and_keeps_the_volume():
    step = basis.boxed(np.repeat([0.0, 1.0], 50), 0.15, TS)
    np.testing.assert_allclose(step[:80], ramp((np.arange(100) - 50) * TS, 0.15)[:80], atol=1e-12)
    x = np.zeros(200)
    x[70:73] = 2.0, 1.0, 5.0
    assert basis.boxed(x, 0.15, TS).sum() == pytest.approx(8.0, rel=1e-12)


def test_the_indicator_is_one_while_printing_and_through_short_gaps_and_lies_evenly():
    r = np.zeros(400)
    r[100:150] = r[170:220] = 1.0  # a gap of 0.4 s
    p = basis.loaded(r, 0.25, TS)
    np.testing.assert_allclose(p[100:220], 1.0, atol=1e-12)
    np.testing.assert_allclose(p[:320], p[:320][::-1], atol=1e-12)
    assert p[:76].max() < 1e-12 and p[245:].max() < 1e-12


def test_what_is_sent_ahead_arrives_in_time():
    plant = Extruder(1.0, 1.0, delay_s=0.113, lag_hz=4.0)
    x = dashes()
    for kernel, tolerance in (
        (basis.advance(plant, TS), 0.02),
        (basis.shift(plant, TS), 0.15),
    ):  # the shift leaves the lag's rounding of corners
        sent = np.convolve(x, kernel, "same")
        np.testing.assert_allclose(lagged(sent, plant.delay_s, plant.lag_hz, TS), x, atol=tolerance * STEADY)
        assert kernel.sum() == pytest.approx(1.0)
    assert basis.shift(plant, TS).min() == 0.0


def test_a_command_within_its_limit_comes_nearest_and_beats_cutting():
    plant, r = Extruder(0.9, 4.5, delay_s=0.1, lag_hz=4.0, play=0.05, yield_=0.1), protocol().r
    limit = 5 * STEADY / plant.gain
    drive = Drive(limit, np.inf, 0.0)
    within, cut = (
        basis.compose(plant, r, sample_time_s=TS, drive=drive),
        np.clip(basis.compose(plant, r, sample_time_s=TS), -limit, limit),
    )
    assert np.abs(within).max() <= limit
    assert percent_of_on_off(plant, within, r) < 0.5 * percent_of_on_off(plant, cut, r)
    free = basis.compose(plant, r, sample_time_s=TS)
    np.testing.assert_array_equal(
        basis.compose(plant, r, sample_time_s=TS, drive=Drive(np.abs(free).max() * 1.0001, np.inf, 0.0)), free
    )  # a limit that is not met changes nothing


def test_the_yield_is_loaded_over_as_long_as_the_drive_needs_and_the_flow_stays_exact(monkeypatch):
    plant = Extruder(0.9, 2.7, delay_s=0.1, lag_hz=4.0, play=0.02, yield_=0.24)
    r, drive = protocol(ramp_s=1.2, pause_s=3).r, Drive(10.0, 30.0, 0.0)
    assert not follows(basis.compose(plant, r, sample_time_s=TS), drive, sample_time_s=TS)
    u = basis.compose(plant, r, sample_time_s=TS, drive=drive)
    assert follows(u, drive, sample_time_s=TS) and percent_of_on_off(plant, u, r) < 0.2
    monkeypatch.setattr(basis, "LOAD_S", 1.0)  # the third of LOADS: nothing but the load is slower
    np.testing.assert_array_equal(u, basis.compose(plant, r, sample_time_s=TS))


def test_what_the_dither_takes_is_left_of_the_limits():
    plant = Extruder(0.9, 4.5, delay_s=0.1, lag_hz=4.0, play=0.2, yield_=0.1)
    drive = Drive(5 * STEADY / plant.gain, 40.0, 0.0)
    u = basis.compose(plant, protocol().r, sample_time_s=TS, drive=drive)
    # a dither that is cut is no dither: 16 % of the time where nothing is left for it
    assert np.mean(at_limit(u, drive, sample_time_s=TS)) < 0.03


def test_no_flow_wanted_is_no_command():
    assert not np.any(
        basis.compose(Extruder(1.0, 1.0, play=0.1, yield_=0.1), np.zeros(100), sample_time_s=TS)
    )
