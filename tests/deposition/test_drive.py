"""The drive: what it does with a command, and that nothing that is sent out or simulated asks for more."""

import numpy as np
import pytest

from pipeline.deposition.drive import UNLIMITED, Drive, at_limit, demand, follows, obeyed
from pipeline.deposition.extruder import Extruder, backlash, flow
from pipeline.deposition.learning import ilc
from pipeline.deposition.parts import basis
from tests.deposition.trained import AREA, TS

DRIVE = Drive(10.0, 20.0, 0.05)
STEP = DRIVE.speed_mm_per_s * TS
RNG = np.random.default_rng(3)


def hasty(rows=()):
    """Commands (..., 800) in mm that leave every limit: a walk with jumps."""
    jumps = 8.0 * RNG.standard_normal((*rows, 800)) * (RNG.random((*rows, 800)) < 0.05)
    return np.cumsum(0.3 * RNG.standard_normal((*rows, 800)) + jumps, axis=-1)


def test_the_drive_goes_towards_the_command_as_fast_as_it_can():
    u = hasty()
    y = obeyed(u, DRIVE, sample_time_s=TS)
    cut, before = np.clip(u, -10, 10), np.append(0.0, y[:-1])
    moved = y - before
    assert np.abs(y).max() <= 10 and np.abs(moved).max() <= STEP * (1 + 1e-9)
    # there where one sample is enough, else at full speed in its direction
    near = np.abs(cut - before) <= STEP
    assert 0.2 < near.mean() < 0.95
    np.testing.assert_array_equal(y[near], cut[near])
    np.testing.assert_allclose(moved[~near], STEP * np.sign((cut - before)[~near]), atol=1e-12)


def test_what_the_drive_did_it_can_do_again_and_rows_stand_alone():
    u = hasty((2, 3))
    y = obeyed(u, DRIVE, sample_time_s=TS)
    assert not follows(u, DRIVE, sample_time_s=TS) and follows(y, DRIVE, sample_time_s=TS)
    np.testing.assert_array_equal(obeyed(y, DRIVE, sample_time_s=TS), y)
    np.testing.assert_array_equal(y[1, 2], obeyed(u[1, 2], DRIVE, sample_time_s=TS))


def test_a_command_asks_for_its_peak_and_its_steepest_step_from_rest():
    command_mm, speed = demand(np.array([-0.5, 0.1, -3.0, -2.9]), sample_time_s=0.1)
    assert command_mm == 3.0 and speed == pytest.approx(31.0)
    assert demand(np.array([2.0, 2.0]), sample_time_s=0.1)[1] == pytest.approx(20.0)
    assert demand(np.zeros(0), sample_time_s=0.1) == (0.0, 0.0)


def test_samples_at_the_amplitude_and_at_the_speed_are_at_a_limit():
    u = np.array([0.4, 0.8, 1.0, 1.0, 10.0, 10.0])
    assert at_limit(u, DRIVE, sample_time_s=TS).tolist() == [True, True, False, False, True, True]
    assert not at_limit(u, UNLIMITED, sample_time_s=TS).any()


def test_an_unlimited_drive_changes_no_byte():
    u = hasty()
    assert obeyed(u, UNLIMITED, sample_time_s=TS).tobytes() == u.tobytes()
    plant = Extruder(1.0, 3.0, 0.1, 4.0, play=0.05, yield_=0.2)
    wide = Drive(1e9, 1e9, 0.0)
    assert (
        flow(plant, u, sample_time_s=TS).tobytes() == flow(plant, u, sample_time_s=TS, drive=wide).tobytes()
    )
    r = ilc.zero_phase(np.repeat([0.0, 2.0, 0.0], 300), order=4, cutoff_hz=5.0, sample_time_s=TS)
    free = ilc.command(r, r, plant, drive=UNLIMITED, sample_time_s=TS)
    assert free.tobytes() == ilc.inverse(r, plant, sample_time_s=TS).tobytes()
    composed = [basis.compose(plant, r, sample_time_s=TS, drive=drive) for drive in (UNLIMITED, wide)]
    assert composed[0].tobytes() == composed[1].tobytes()


def test_the_drives_backlash_lies_before_the_extruder_and_adds_to_its_play():
    u, plant = 2 + np.sin(np.arange(500) / 20), Extruder(1.0, 0.5)
    behind = flow(plant._replace(play=0.3), u, sample_time_s=TS)
    both = flow(plant._replace(play=0.2), u, sample_time_s=TS, drive=Drive(10, 1e3, 0.1))
    np.testing.assert_allclose(both, behind, atol=1e-12)
    alone = flow(plant, u, sample_time_s=TS, drive=Drive(10, 1e3, 0.1))
    np.testing.assert_array_equal(alone, flow(plant, backlash(u, 0.1), sample_time_s=TS))


PULSES = np.convolve(np.tile(np.repeat([0.0, AREA * 8, 0.0], 200), 2), np.ones(15) / 15, "same")


def test_a_learned_command_within_amplitude_and_speed_beats_one_that_is_obeyed_as_it_comes():
    model = Extruder(0.89, 4.5, 0.1)
    x = ilc.zero_phase(PULSES, order=4, cutoff_hz=5.0, sample_time_s=TS)
    u = ilc.command(x, PULSES, model, drive=DRIVE, sample_time_s=TS)
    assert follows(u, DRIVE, sample_time_s=TS)
    slewed = obeyed(ilc.inverse(x, model, sample_time_s=TS), DRIVE, sample_time_s=TS)
    near, cut = (np.linalg.norm(flow(model, v, sample_time_s=TS) - PULSES) for v in (u, slewed))
    assert near < 0.8 * cut
    # nearest within the amplitude alone, then slewed: it sets out too late
    crawling = DRIVE._replace(speed_mm_per_s=4.0)
    late = ilc.command(x, PULSES, model, drive=Drive(10.0, np.inf, 0.0), sample_time_s=TS)
    near, cut = (
        np.linalg.norm(flow(model, v, sample_time_s=TS) - PULSES)
        for v in (
            ilc.command(x, PULSES, model, drive=crawling, sample_time_s=TS),
            obeyed(late, crawling, sample_time_s=TS),
        )
    )
    assert near < 0.9 * cut
