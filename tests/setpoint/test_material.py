"""What is printed: its classes, its limits, and the section that declares it."""

import numpy as np
import pydantic
import pytest

from pipeline.recordings import nozzle_frames
from pipeline.setpoint import published
from pipeline.setpoint.frames import nozzle_scene
from pipeline.setpoint.material import PLA, PrintedMaterial
from pipeline.setpoint.recordings import FrontEnd
from pipeline.setpoint.settings import SetpointMaterial
from pipeline.setpoint.simulation import simulator
from pipeline.store.params import Execution
from tests.nozzle_folders import ANY, LEAST, SHOTS, folder, read

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
    assert isinstance(PLA, PrintedMaterial)


def test_the_published_material_stands_for_itself_to_the_bit():
    flow, heat = (
        np.array([0.0, 5.0, 20.0, 99.7, 310.0, 400.0, np.nan]),
        np.array([20.0, 213.3, 260.0, np.nan]),
    )
    np.testing.assert_array_equal(PLA.published_flow(flow), flow)
    np.testing.assert_array_equal(PLA.own_temperature(heat), heat)


def test_limits_borders_and_best_values_stand_for_the_published_ones():
    petg = SetpointMaterial(**DECLARED).material()
    own = np.array([50.0, 95.0, 100.0, 105.0, 150.0])
    np.testing.assert_allclose(petg.published_flow(own), [20, 90, 100, 110, 310], rtol=1e-12)
    np.testing.assert_allclose(petg.published_temperature([220, 230, 240, 260]), [180, 195, 210, 240])
    # log flow is linear between: half way from 95 to 100 is half way from 90 to 100
    assert petg.published_flow(np.sqrt(95 * 100)) == pytest.approx(np.sqrt(90 * 100))
    # beyond the limits: by the same factor, and the same degrees
    assert petg.published_flow(300.0) == pytest.approx(620)
    assert petg.published_temperature(200.0) == pytest.approx(160)


def test_what_is_carried_there_comes_back_and_keeps_its_class():
    petg = SetpointMaterial(**DECLARED).material()
    flow, heat = np.linspace(1, 400, 799), np.linspace(0, 400, 401)
    np.testing.assert_allclose(petg.own_flow(petg.published_flow(flow)), flow, rtol=1e-12)
    np.testing.assert_allclose(petg.own_temperature(petg.published_temperature(heat)), heat, rtol=1e-12)
    assert (np.diff(petg.published_flow(flow)) > 0).all()
    away = np.min(np.abs(flow[:, None] - [95, 105]), axis=1) > 1e-6  # rounding at the borders themselves
    np.testing.assert_array_equal(PLA.label(petg.published_flow(flow))[away], petg.label(flow)[away])
    assert petg.published_flow(0.0) == 0 and np.isnan(petg.published_flow(np.nan))


def test_frames_of_a_folder_are_read_as_of_the_published_material(tmp_path):
    petg = SetpointMaterial(
        **{**DECLARED, "good_flow_percent": (50.0, 120.0), "flow_limits_percent": (20.0, 310.0)}
    )
    raw = folder(tmp_path / "raw")
    options = nozzle_frames.ReadOptions(None, FrontEnd(LEAST, tmp_path / "memo"), ANY, petg.material())
    here = Execution(backend="loky", jobs=1, scheduler="")
    found = nozzle_frames.read_folder(raw, options, here)
    plain = read(raw)
    # 60 and 100 % are good for it, 150 % is over; 210 degC stand 10 below the range, as 170 do for PLA
    own = np.tile(np.repeat([60.0, 100.0, 150.0], SHOTS), 2)
    np.testing.assert_array_equal(found.label, petg.material().label(own))
    assert set(found.label) == {1, 2} and set(plain.label) == {0, 1, 2}
    np.testing.assert_allclose(found.temperature, 170.0)
    np.testing.assert_allclose(petg.material().own_flow(found.flow), own)
    np.testing.assert_array_equal(found.images, plain.images)


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
