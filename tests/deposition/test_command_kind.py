"""What a machine answers to, from its first trial, on extruders of other physics."""

import numpy as np
import pytest

from pipeline.deposition import drive
from pipeline.deposition.extruder import routine
from pipeline.deposition.learning import command_kind
from tests.foreign import displacing, extruders
from tests.foreign.syringe import PneumaticSyringe

TS = 0.02
# two speeds, as the shipped routines have
WANTED = [
    routine(
        off_s=4, on_s=6, pause_s=0.6, tail_s=8, speed=speed, bead_area_mm2=0.304, ramp_s=0.15,
        sample_time_s=TS,
    ).r
    for speed in (8.0, 2.1)
]  # fmt: skip
STEADY = float(WANTED[0].max())


def squares(true, declared, number, kind="syringe"):
    """Of the on-off trials of one drawn machine, its time constant known to 30 %."""
    rng = np.random.default_rng([41, number, command_kind.KINDS.index(true)])
    if true == "pressure":
        fill_s, vent_s, yield_mm, exponent, valve_s = rng.uniform(
            [0.3, 0.3, 0.05, 0.9, 0.03], [1.5, 1.5, 0.3, 1.3, 0.1]
        )
        syringe = PneumaticSyringe(
            valve_s=valve_s, fill_s=fill_s, vent_s=vent_s, yield_mm=yield_mm, exponent=exponent
        )
        time_constant_s = (fill_s + vent_s) / 2 * rng.uniform(0.75, 1.3)
        run = lambda sent: syringe.flow(np.arange(len(sent)) * TS, sent)  # noqa: E731
    else:
        time_constant_s = float(np.exp(rng.uniform(np.log(0.2), np.log(1.5))))
        e = displacing.drawn(kind, rng, gain=1.0, time_constant_s=time_constant_s, steady_flow=STEADY)
        run = lambda sent: displacing.flow(e, sent, sample_time_s=TS, place=true == "place")  # noqa: E731
    noise = np.random.default_rng([9, number])
    sent = [drive.sent(r, declared, sample_time_s=TS) for r in WANTED]
    y = [
        extruders.seen(run(one), noise, steady_flow=float(r.max()))
        for one, r in zip(sent, WANTED, strict=True)
    ]
    return command_kind.errors(sent, y, WANTED, gain=1.0, time_constant_s=time_constant_s, sample_time_s=TS)


@pytest.mark.parametrize(
    "true, declared, says",
    [
        ("pressure", "speed", "this machine answers to its command as to a pressure, not to the speed of"),
        ("speed", "pressure", "this machine answers to the speed of its plunger, not to its command as to a"),
        ("place", "pressure", "this machine answers to the place of its plunger, not to its command as to a"),
        ("place", "speed", "this machine answers to the place of its plunger, not to the speed of"),
    ],
)
def test_another_kind_of_machine_is_named(true, declared, says):
    for number in range(3):
        sentence, hopeless = command_kind.wrong_kind(squares(true, declared, number), declared)
        assert sentence.startswith(says) and f"set printer.command to {true}" in sentence
        assert hopeless == (true == "place")


@pytest.mark.parametrize("true", ["pressure", "speed"])
def test_a_command_sent_as_a_place_to_a_machine_that_goes_on_is_refused(true):
    sentence, hopeless = command_kind.wrong_kind(squares(true, "place", 0), "place")
    assert hopeless and sentence.startswith(
        "this machine answers to the speed of its plunger or to a pressure, not to the place of its plunger; "
        "set printer.command to speed for filament or a screw, to pressure for compressed air, delete"
    )


@pytest.mark.parametrize(
    "kind, true", [("syringe", "speed"), ("filament", "speed"), ("auger", "place"), ("", "pressure")]
)
def test_the_kind_that_was_declared_is_not_questioned(kind, true):
    for number in range(3):
        assert command_kind.wrong_kind(squares(true, true, number, kind), true) == ("", False)


def test_a_speed_is_sent_as_its_place_and_read_back():
    v = np.random.default_rng(1).standard_normal(200)
    v[-1] = 0.0
    place = drive.sent(v, "place", sample_time_s=TS)
    assert place[0] == 0.0 and place[-1] == pytest.approx(TS * v.sum())
    np.testing.assert_allclose(drive.command(place + 7.0, "place", sample_time_s=TS), v, atol=1e-12)
    for kind in ("pressure", "speed"):
        assert drive.sent(v, kind, sample_time_s=TS) is v and drive.command(v, kind, sample_time_s=TS) is v
