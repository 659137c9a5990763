"""A controller learned from two recordings of a foreign hot end, in the normal life of that machine:
set-points, part fan, filament, another room. Its supervisor leaves the healthy machine to the law, and acts
on faults."""

import json
import shutil

import pytest

from tests.foreign import normal_life

HOURS = 50.0

# minutes: a controller is learned from two recordings, and plays 50 hours
pytestmark = [
    pytest.mark.full,
    pytest.mark.skipif(shutil.which("gcc") is None, reason="the exported C needs gcc"),
]


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The files of machine 1, whose owner declared the part fan and the filament as disturbances."""
    folder = tmp_path_factory.mktemp("life")
    made = normal_life.make(1, folder, records="declared")
    assert made["exported"], made["why"]
    return folder


def test_a_healthy_machine_is_left_to_the_law(exported):
    life = normal_life.live(exported, 1, HOURS)
    assert life["false_safe_modes"] <= 1 and life["under_law_percent"] >= 99.5
    assert life["crossings"] == 0
    assert life["rms_settled_degC"][0] <= life["own_control_rms_settled_degC"][0]


@pytest.mark.parametrize("fault", ["sensor open", "sensor out of range", "heater stuck on", "heater off"])
def test_a_fault_is_acted_on_in_time_and_named(exported, fault):
    for nth in range(3):
        told = normal_life.suffer(exported, 1, fault, nth=nth)
        assert told["began"] and told["in_time"] and told["named"], json.dumps(told)


def test_a_sensor_that_stands_still_is_told_at_the_next_set_point_change_at_the_latest(exported):
    """At rest a frozen sensor in steps of 0.25 °C cannot be told from a healthy one."""
    for nth in range(3):
        life = normal_life.play(exported, 1, 8.0, fault="sensor still", nth=nth, after_h=4.0)
        moved = [
            k for k in range(life.began + 1, len(life.target)) if abs(life.target[k] - life.target[k - 1]) > 4
        ]
        left = life.began + int((life.mode[life.began :] != 0).argmax())
        assert life.mode[left] == normal_life.MODES.index("off")
        assert left <= moved[0] + 31
