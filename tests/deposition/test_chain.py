"""The identified chain: simulation of many at once against one at a time, backlash by blocks against the
walk, parameters found, creep where there is creep."""

import numpy as np
import pytest

from pipeline.deposition import extruder
from pipeline.deposition.extruder import Extruder, backlash
from pipeline.deposition.parts.chain import IdentifiedExtruder, forecast, identify, simulate
from tests.deposition.trained import CREEPING, PLANT, TS, learned, trainings
from tests.foreign import extruders as foreign_extruders


def walk(x, play):
    """Play of full width `play` on x (T,), sample by sample."""
    y, out = 0.0, []
    for value in x.tolist():
        y = min(max(y, value - play / 2), value + play / 2)
        out.append(y)
    return out


@pytest.mark.parametrize("length", [1, 2, 7, 100, 1001])
def test_backlash_by_blocks_is_the_walk(length):
    rng = np.random.default_rng(length)
    x = np.cumsum(rng.standard_normal((3, length)), axis=1)
    play = np.array([0.0, 1.0, 5.0])
    expected = [walk(row, width) for row, width in zip(x, play, strict=True)]
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


def driven(kind: str, **changes):
    """Trials of a foreign extruder under the commands that the plant of the tests was taught."""
    rng = np.random.default_rng(3)
    plant = foreign_extruders.drawn(kind, rng, gain=1.0, time_constant_s=3.0, steady_flow=2.432)
    plant = plant._replace(**changes)
    out = []
    for t in trainings(PLANT):
        rows = [foreign_extruders.flow(plant, u, sample_time_s=TS) for u in t.u[[0, 4, 6, 8]]]
        seen = [foreign_extruders.seen(y, rng, steady_flow=float(t.r.max())) for y in rows]
        out.append(t._replace(u=t.u[[0, 4, 6, 8]], y=np.array(seen)))
    return plant, out


@pytest.mark.parametrize(
    ("kind", "extra"),
    [("plain", None), ("up_down", "fall"), ("exponent", "exponent"), ("third_order", "second_lag")],
)
def test_the_structure_of_an_extruder_that_the_chain_did_not_draw_is_found_and_no_other(kind, extra):
    changes = {"exponent": 1.25} if kind == "exponent" else {}
    plant, trained = driven(kind, **changes)
    chain = identify(trained, sample_time_s=TS)
    assert set(chain.structure) - {"lag"} == ({extra} if extra else set())
    e = chain.extruder
    # one trial in four of those that a machine learns in: a few times the deviation of a full set
    assert e.fall_ratio == pytest.approx(plant.tau_down_s / plant.tau_up_s, abs=0.01)
    assert e.exponent == pytest.approx(plant.exponent, abs=0.02)
    assert e.second_lag_s == pytest.approx(max(plant.lags_s, default=0.0), abs=0.08)


def test_a_flow_that_falls_otherwise_than_it_rises_is_walked_sample_by_sample():
    rng = np.random.default_rng(1)
    u = rng.standard_normal((3, 60))
    e = IdentifiedExtruder(1.5, 2.0, fall_ratio=0.5)
    flows = simulate([e], u, sample_time_s=TS)[0]
    for row, y in zip(u, flows, strict=True):
        p = 0.0
        for value, flow in zip(row, y, strict=True):
            assert flow == pytest.approx(max(1.5 * p, 0.0), abs=1e-12)
            tau = 2.0 if value > p else 1.0
            p = value + (p - value) * np.exp(-TS / tau)
    # few rows are walked in plain numbers, many in arrays
    many = simulate([e], np.tile(u, (20, 1)), sample_time_s=TS)[0]
    np.testing.assert_allclose(many, np.tile(flows, (20, 1)), atol=1e-12)


def test_members_are_chains_that_the_trials_cannot_tell_from_the_best():
    chain, t = learned(PLANT).materials[0].chain, trainings(PLANT)[0]
    made = simulate(chain.members, t.u[-1:], sample_time_s=TS)[:, 0]
    best = forecast(chain.extruder, t.u[-1], sample_time_s=TS)
    apart = np.sqrt(np.mean((made - best) ** 2, axis=1)) / t.r.max()
    assert len(made) == 32 and 1e-4 < np.median(apart) < 0.01  # some tenths of a percent, as trials scatter
    # they lie to all sides of the best
    np.testing.assert_allclose(made.mean(axis=0), best, atol=0.005 * t.r.max())


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
