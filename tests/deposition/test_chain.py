"""The identified chain: simulation of many at once against one at a time, backlash by blocks against the
walk, parameters found, creep where there is creep."""

import numpy as np
import pytest

from pipeline.deposition import extruder
from pipeline.deposition.chain import backlash, forecast, identify, simulate
from pipeline.deposition.extruder import Extruder
from tests.deposition.trained import CREEPING, PLANT, TS, learned, trainings


@pytest.mark.parametrize("length", [1, 2, 7, 100, 1001])
def test_backlash_by_blocks_is_the_walk(length):
    rng = np.random.default_rng(length)
    x = np.cumsum(rng.standard_normal((3, length)), axis=1)
    play = np.array([0.0, 1.0, 5.0])
    expected = [extruder.backlash(row, width) for row, width in zip(x, play, strict=True)]
    np.testing.assert_array_equal(backlash(x, play), expected)
    np.testing.assert_array_equal(
        backlash(np.tile(x, (40, 1)), np.tile(play, 40)), np.tile(expected, (40, 1))
    )  # many rows take the other way


def test_many_extruders_at_once_flow_as_each_alone():
    rng = np.random.default_rng(0)
    u = np.cumsum(rng.standard_normal((2, 600)), axis=1) * 0.3
    family = [
        extruder.draw(rng, gain=1.08, time_constant_s=2.7, steady_flow=2.4, creep_share=c)
        for c in (0.0, 0.12, 0.0)
    ] + [Extruder(1.0, 2.0)]
    flows = simulate(family, u, sample_time_s=TS)
    for one, rows in zip(family, flows, strict=True):
        for command, y in zip(u, rows, strict=True):
            np.testing.assert_allclose(
                y, extruder.flow(one, command, sample_time_s=TS), atol=1e-9
            )  # rounding, and what a lag keeps for 2 s
    np.testing.assert_array_equal(
        forecast(family[0], u[0], sample_time_s=TS), simulate(family[:1], u[:1], sample_time_s=TS)[0, 0]
    )


def test_the_chain_of_the_plant_is_found_from_noisy_trials():
    chain = learned(PLANT).materials[0].chain
    assert "creep" not in chain.structure and chain.trials == sum(len(t.u) for t in trainings(PLANT))
    e = chain.extruder
    # 52 trials with 1 % gain noise each leave some 0.2 %; delay and
    # lag trade against each other, their sum does not
    assert e.gain == pytest.approx(PLANT.gain, rel=0.01)
    assert e.time_constant_s == pytest.approx(PLANT.time_constant_s, rel=0.01)
    assert e.yield_ == pytest.approx(PLANT.yield_, abs=0.015 * 2.43)
    late = [x.delay_s + extruder.DAMPING / (np.pi * x.lag_hz) for x in (e, PLANT)]
    assert late[0] == pytest.approx(late[1], abs=0.005)  # a quarter of a sample
    assert (
        chain.residual_percent < 3.5 and 0 < chain.held_out_percent < 0.8
    )  # the noise of a trial is 3 % white; 12 of them averaged


def test_creep_is_found_where_there_is_creep():
    chain = learned(CREEPING).materials[0].chain
    assert "creep" in chain.structure
    assert chain.extruder.creep_share == pytest.approx(
        0.12, abs=0.03
    )  # share and time trade against each other within 30 s of trial


def test_samples_that_were_not_observed_do_not_matter():
    holed = []
    for t in trainings(PLANT)[:2]:
        y = t.y.copy()
        y[:, 300:340] = np.nan
        holed.append(t._replace(y=y))
    gappy, complete = (
        identify(holed, sample_time_s=TS).extruder,
        identify(trainings(PLANT)[:2], sample_time_s=TS).extruder,
    )
    assert gappy.gain == pytest.approx(complete.gain, rel=0.01) and gappy.time_constant_s == pytest.approx(
        complete.time_constant_s, rel=0.01
    )


def test_trials_that_tell_nothing_are_refused():
    t = trainings(PLANT)[0]
    with pytest.raises(ValueError, match="identify: expected routines of at least two trials each but found"):
        identify([t._replace(u=t.u[:1], y=t.y[:1])], sample_time_s=TS)
    with pytest.raises(
        ValueError, match="identify: expected commands that press but found a sum of u <= 0; check the sign"
    ):
        identify([t._replace(u=-t.u)], sample_time_s=TS)
