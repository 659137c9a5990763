"""Pressure advance: its command by hand, what it is tuned to, its intervals, and the lines for slicers."""

import math

import numpy as np
import pytest

from pipeline.deposition.drive import UNLIMITED, Drive, follows
from pipeline.deposition.extruder import Extruder, ramp
from pipeline.deposition.parts import pressure_advance
from pipeline.deposition.parts.chain import forecast
from pipeline.deposition.parts.composition import COMPOSERS, ToolShare, learn
from pipeline.deposition.parts.pressure_advance import PressureAdvance, TunedAdvance
from tests.deposition.trained import NOMINAL, PLANT, TS, learned, protocol
from tests.foreign import parts as foreign_parts

T = np.arange(200) * TS


def command(r, *numbers, sample_time_s=TS):
    return pressure_advance.command(PressureAdvance(*numbers), r, sample_time_s=sample_time_s)


def test_a_level_a_slope_and_a_lead_by_hand():
    slope = 3.0 * T
    inside = slice(20, 170)
    np.testing.assert_allclose(command(np.full(200, 2.0), 0.5, 1.3, 0.1, 0.2)[inside], 4.0)
    np.testing.assert_allclose(command(slope, 0.5, 0.0, 0.0, 0.0)[inside], slope[inside] / 0.5)
    # e + advance de/dt: of a slope the advance is sent ahead of the flow by as much, and so is a lead
    np.testing.assert_allclose(
        command(slope, 0.5, 1.3, 0.1, 0.2)[inside], 3.0 * (T[inside] + 1.3 + 0.2) / 0.5
    )


def test_the_window_is_a_triangle_as_wide_as_the_smooth_time():
    step = (T >= 2.0) * 1.0
    smoothed = command(np.repeat(step, 20), 1.0, 0.0, 0.2, 0.0, sample_time_s=TS / 20)
    t = np.arange(len(smoothed)) * TS / 20
    np.testing.assert_allclose(smoothed[:-400], ramp(t - 2.0, 0.1)[:-400], atol=0.01)
    wide = np.flatnonzero((smoothed[:-400] > 1e-6) & (smoothed[:-400] < 1 - 1e-6)) * TS / 20
    assert np.ptp(wide) == pytest.approx(0.2, abs=0.004)


def test_rows_are_commands_of_their_own():
    both = np.stack([protocol().r, protocol(5.0).r])
    made = command(both, 0.9, 2.7, 0.1, 0.05)
    np.testing.assert_allclose(made[1], command(both[1], 0.9, 2.7, 0.1, 0.05), atol=1e-12)


def tuned_on(plant, **settings):
    """Tuned on a chain that is the plant, with what the trials of PLANT missed."""
    material = learned(PLANT).materials[0]
    chain = material.chain._replace(extruder=material.chain.extruder._make((*plant, 1.0, 0.0, 1.0, 1.0)))
    wanted = [protocol().r, protocol(5.0, 0.3).r]
    return pressure_advance.tune(chain, material.missed, wanted, sample_time_s=TS, **settings)


def test_on_a_first_order_extruder_with_a_delay_the_numbers_are_its_own():
    plant = Extruder(0.9, 3.1, delay_s=0.12)
    tuned = tuned_on(plant, lead=True).tuned
    # the flow is seen at the samples, the command held between them: half a sample later
    assert tuned.gain == pytest.approx(0.9, rel=2e-3) and tuned.advance_s == pytest.approx(3.1, rel=5e-3)
    assert tuned.lead_s == pytest.approx(0.12 + TS / 2, abs=2e-3) and tuned.smooth_s == 0.04
    r = protocol(8.0, 0.4).r
    on_off, by_advance = (
        np.linalg.norm(forecast(plant, u, sample_time_s=TS) - r)
        for u in (r / NOMINAL.gain, command(r, *tuned))
    )
    assert by_advance < 0.02 * on_off


def test_without_a_lead_the_smooth_time_makes_up_for_a_little_delay_and_stays_within_klipper_s_bounds():
    low, tuned, high = tuned_on(Extruder(0.9, 3.1, delay_s=0.12), lead=False)
    assert tuned.lead_s == low.lead_s == high.lead_s == 0.0 and tuned.smooth_s == pytest.approx(0.2)
    assert tuned_on(Extruder(0.9, 3.1), lead=False).tuned.smooth_s < 0.1


def test_the_command_of_a_part_is_what_the_drive_can_follow():
    drive, material = Drive(5.0, 8.0, 0.0), learned(PLANT).materials[0]
    share = ToolShare(0, material, protocol().r, None, None)
    for name, advance in material.advances.items():
        u = COMPOSERS[name](learned(PLANT).library, share, drive)
        assert follows(u, drive, sample_time_s=TS)
        free = COMPOSERS[name](learned(PLANT).library, share, UNLIMITED)
        np.testing.assert_array_equal(free, command(protocol().r, *advance.tuned))
        assert not follows(free, drive, sample_time_s=TS)


@pytest.mark.parametrize(("kind", "material"), [("up_down", "A"), ("exponent", "B"), ("compressible", "A")])
def test_on_foreign_extruders_no_other_numbers_are_better_and_the_intervals_hold_the_best(kind, material):
    rng = np.random.default_rng([40, len(kind), ord(material)])
    plant = foreign_parts.plant_of(kind, rng, material)
    trainings = foreign_parts.train(plant, material, rng)
    low, tuned, high = learn(trainings, sample_time_s=TS).materials[0].advances["pressure_advance"]
    r = [trainings[0].r, trainings[3].r]

    def error(numbers):
        return math.hypot(*(np.linalg.norm(plant(command(one, *numbers), 0) - one) for one in r))

    found = {
        (gain, advance): error((gain * tuned.gain, advance * tuned.advance_s, tuned.smooth_s, 0.0))
        for gain in (0.97, 0.99, 1.0, 1.01, 1.03)
        for advance in (0.8, 0.9, 0.95, 1.0, 1.05, 1.1, 1.25)
    }
    gain, advance = min(found, key=found.get)
    assert found[1.0, 1.0] < 1.05 * found[gain, advance] and 0.95 <= advance <= 1.05
    assert low.advance_s <= tuned.advance_s <= high.advance_s < 1.25 * low.advance_s
    assert low.gain <= tuned.gain <= high.gain < 1.25 * low.gain


def test_the_lines_are_those_that_klipper_marlin_and_orcaslicer_take():
    low, tuned, high = (
        PressureAdvance(*one, 0.0) for one in ((0.8, 0.04, 0.03), (0.9, 0.05, 0.04), (1.0, 0.06, 0.2))
    )
    made = pressure_advance.slicer_settings(TunedAdvance(low, tuned, high), 0.99)
    assert made["Klipper"] == "SET_PRESSURE_ADVANCE ADVANCE=0.0500 SMOOTH_TIME=0.040"
    assert made["Marlin"] == "M900 K0.0500"
    assert made["OrcaSlicer"].endswith("pressure_advance = 0.0500; filament_flow_ratio = 1.1000")
    assert made["pressure_advance_s"] == [0.04, 0.05, 0.06] and made["smooth_time_s"] == [0.03, 0.04, 0.2]
    assert made["flow_ratio"] == pytest.approx([0.99, 1.1, 0.99 / 0.8])  # a lower gain needs more
