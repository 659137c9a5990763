"""A part's gantry slows down until the drive follows its flow, and no further."""

import math
from pathlib import Path

import numpy as np
import pytest

from pipeline.deposition.parts import part
from pipeline.deposition.settings import ComposeParts, PlungerDrive, Printer
from pipeline.deposition.toolpath import gcode
from pipeline.store import params
from tests.deposition.trained import NOZZLE, PLANT, learned

ROOT = Path(__file__).parents[2]
PARTS = ROOT / "datasets" / "parts"
PRINTER = params.load(Printer, "printer", ROOT / "params.yaml").model_copy(
    update={
        "drive": PlungerDrive(amplitude_mm=10.0, speed_mm_per_s=20.0, backlash_mm=0.05),
        "nozzle_mm": NOZZLE,
    }
)


SETTINGS = params.load(ComposeParts, "compose_parts", ROOT / "params.yaml")


def machine(printer):
    """Gantry, part settings, library and the tools' materials of a printer."""
    materials = {material.tool: material.name for material in printer.materials}
    return printer.gantry, SETTINGS.of_part(printer), learned(PLANT), materials


def planned(name, printer=PRINTER):
    return part.plan_part(moves(name), *machine(printer), printer.longest_ramp_s)[0]


def sufficient_ramp(name, printer=PRINTER):
    return part.plan_part(moves(name), *machine(printer), part.LONGEST_RAMP_S)[1]


def moves(name):
    return gcode.parse((PARTS / f"{name}.gcode").read_bytes()).moves


def printed(name, plan):
    return plan.acceleration[moves(name).kind == gcode.Kind.EXTRUDE]


def test_ramps_lengthen_until_the_drive_follows_the_part_and_short_lines_need_longer_ones():
    long, short = (planned(name) for name in ("fig9", "dashes"))
    ramps = [8.0 / printed(name, plan).max() for name, plan in (("fig9", long), ("dashes", short))]
    assert 0.5 < ramps[0] < 1.7 and 1.3 * ramps[0] < ramps[1] < 4.0
    for name, ramp_s in zip(("fig9", "dashes"), ramps, strict=True):
        assert sufficient_ramp(name) == pytest.approx(ramp_s, rel=0.02)  # bisected to 1 %
    # travel stays as quick as the gantry goes
    assert long.acceleration.max() == PRINTER.acceleration_mm_per_s2
    assert part.slowed_to(long, moves("fig9")) == pytest.approx(8.0 / ramps[0])


@pytest.mark.parametrize("changes", [{"drive": None}, {"longest_ramp_s": None}])
def test_without_a_drive_or_where_ramps_are_not_to_lengthen_the_gantry_is_as_quick_as_it_goes(changes):
    plan = planned("dashes", PRINTER.model_copy(update=changes))
    assert np.all(plan.acceleration == PRINTER.acceleration_mm_per_s2)
    assert part.slowed_to(plan, moves("dashes")) is None
    assert all(
        np.array_equal(a.r, b.r)
        for a, b in zip(
            PRINTER.model_copy(update=changes).training_routines(),
            PRINTER.model_copy(update={"longest_ramp_s": None}).training_routines(),
            strict=True,
        )
    )


def test_ramps_end_at_the_longest_that_is_allowed_and_the_one_that_would_do_is_named_beyond():
    short = PRINTER.model_copy(update={"longest_ramp_s": 0.5})
    assert 8.0 / printed("dashes", planned("dashes", short)).max() == 0.5
    assert sufficient_ramp("dashes", short) > 1.0
    weak = PRINTER.model_copy(
        update={"drive": PlungerDrive(amplitude_mm=1.0, speed_mm_per_s=20.0, backlash_mm=0.05)}
    )
    # less than the steady command of its lines, about 2.6 mm
    assert sufficient_ramp("fig9", weak) == math.inf


def test_the_training_routines_lengthen_alike_and_rest_as_long_in_their_pause():
    quick, slow = (
        PRINTER.model_copy(update={"longest_ramp_s": None}).training_routines(),
        PRINTER.training_routines(),
    )
    for a, b in zip(quick, slow, strict=True):
        longer = (b.pause_s[1] - b.pause_s[0]) - (a.pause_s[1] - a.pause_s[0])
        assert 1.0 < longer < 2.0  # of material B, whose time constant is 4.5 s
        # 5 mm/s come in five eighths of the time, at the same acceleration
        assert np.abs(np.diff(b.speed)).max() / 0.02 == pytest.approx(8.0 / longer, rel=1e-6)
        assert b.r.max() == pytest.approx(a.r.max())
        assert (b.speed == 0).sum() >= (a.speed == 0).sum()
