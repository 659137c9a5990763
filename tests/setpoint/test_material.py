"""What is printed: its classes, its limits, and the section that declares it."""

import numpy as np
import pydantic
import pytest

from pipeline.setpoint import nozzle_scene, published, simulator
from pipeline.setpoint.material import PLA, Material
from pipeline.setpoint.workflow.settings import SetpointMaterial

DECLARED = {
    "best_temperature_degC": 240.0,
    "temperature_range_degC": (220.0, 260.0),
    "good_flow_percent": (95.0, 105.0),
    "flow_limits_percent": (50.0, 150.0),
}


def test_both_borders_are_good():
    assert PLA.label(np.array([89.9, 90.0, 110.0, 110.1])).tolist() == [0, 1, 1, 2]
    petg = SetpointMaterial(**DECLARED).material()
    assert petg.label(np.array([94.0, 95.0, 105.0, 106.0])).tolist() == [0, 1, 1, 2]
    assert petg.limits() == ((50.0, 220.0), (150.0, 260.0))


def test_the_published_material_is_what_the_scenes_and_the_simulator_are_of():
    assert published.BEST_TEMPERATURE == PLA.best_temperature_degC
    assert (simulator.FLOW_LIMITS, simulator.TEMPERATURE_LIMITS) == (
        PLA.flow_limits_percent,
        PLA.temperature_range_degC,
    )
    assert nozzle_scene.BORDERS == PLA.good_flow_percent
    assert isinstance(PLA, Material)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"best_temperature_degC": 270.0}, r"\[220, 260\]; the best lies between the two"),
        ({"good_flow_percent": (101.0, 105.0)}, "100 lies between the first two"),
        ({"flow_limits_percent": (96.0, 150.0)}, "and they between the limits"),
        ({"temperature_range_degC": (20.0, 260.0)}, "greater than or equal to 100"),
    ],
)
def test_a_material_that_contradicts_itself_is_refused(wrong, words):
    with pytest.raises(pydantic.ValidationError, match=words):
        SetpointMaterial(**{**DECLARED, **wrong})
