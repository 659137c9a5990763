"""Nozzle frames in MCAP: our own form there and back, other machines'
topics, and what is damaged or missing."""

import base64
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.recordings.formats import Source
from pipeline.recordings.images import tables_of, write_frames
from pipeline.recordings.nozzle_frames import UNITS, Topics, figures, middle_frame, open_film
from pipeline.recordings.recordings import inspect
from pipeline.setpoint.frames import key_area
from tests.mcap_writing import Written
from tests.nozzle_folders import ANY, FLOWS, LEAST, SHOTS, expected, folder, read, scenes, table

COUNT = 2 * len(FLOWS) * SHOTS
RATE = 20.0
TIME = np.arange(COUNT) / RATE


def pictures():
    return (
        (k / RATE, frame) for k, frame in enumerate(frame for scene in scenes() for frame in scene.frames)
    )


def signals(**changes) -> dict[str, np.ndarray]:
    tips = np.repeat([np.round(scene.tip, 2) for scene in scenes()], SHOTS, axis=0)
    found = {
        "flow_percent": np.tile(np.repeat(FLOWS, SHOTS), 2), "temperature_degC": np.full(COUNT, 210.0),
        "print_id": np.repeat([4.0, 7.0], COUNT // 2),
        "tip_x_px": tips[:, 0], "tip_y_px": tips[:, 1],
    }  # fmt: skip
    return {name: values for name, values in (found | changes).items() if values is not None}


def film(path: Path, *, frames=None, encoding: str = "png", time_s=TIME, **changes) -> Path:
    """A recording of our own form: `frames` (time_s, (height, width)), and the signals on topic /setpoint."""
    found = signals(**changes)
    tables = tables_of(
        path,
        time_s,
        [(Source(name, f"/setpoint:{name}", UNITS[name]), found[name]) for name in UNITS if name in found],
    )
    write_frames(
        path,
        tables,
        {"/setpoint": "beadline_msgs/msg/Setpoint"},
        time_s,
        (encoding, pictures() if frames is None else frames),
    )
    return path


def refusal(path: Path, **settings) -> str:
    with pytest.raises(ValueError, match="; ") as refused:
        read(path, **settings)
    assert "\n" not in str(refused.value)
    return str(refused.value)


# ---- our own form


@pytest.mark.parametrize("encoding", ["raw", "png"])
def test_a_recording_gives_the_key_areas_of_its_frames_with_their_setpoints(tmp_path, encoding):
    film(tmp_path / "raw/a.mcap", encoding=encoding)
    found = read(tmp_path / "raw")
    np.testing.assert_array_equal(found.images, expected())
    np.testing.assert_array_equal(found.flow, np.tile(np.repeat(FLOWS, SHOTS), 2))
    assert found.prints == ("4", "7")
    assert found.label.tolist() == np.tile(np.repeat([0, 1, 2], SHOTS), 2).tolist()
    assert found.segment.tolist() == np.repeat(np.arange(6), SHOTS).tolist()


def test_a_recording_and_a_folder_of_the_same_frames_are_the_same_data(tmp_path):
    film(tmp_path / "mcap/a.mcap", print_id=np.repeat([0.0, 1.0], COUNT // 2))
    folder(tmp_path / "csv")
    one, other = read(tmp_path / "mcap"), read(tmp_path / "csv")
    for name in ("images", "label", "flow", "temperature", "print_number", "segment", "valid", "score"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert one.prints == other.prints


def test_beside_one_another_a_frame_counts_once(tmp_path):
    folder(tmp_path / "raw")
    film(tmp_path / "raw/a.mcap")
    (tmp_path / "raw/b.mcap").write_bytes((tmp_path / "raw/a.mcap").read_bytes())
    found = read(tmp_path / "raw")
    assert "b.mcap is another recording once more, byte for byte" in "\n".join(
        note.message for note in found.notes
    )
    assert figures(found)["frames"] == 2 * COUNT


def test_jpeg_frames_are_within_what_jpeg_loses(tmp_path):
    film(tmp_path / "raw/a.mcap", encoding="jpeg")
    found = read(tmp_path / "raw")
    # quality 95 is two to three gray levels off in noise, which equalisation stretches
    assert np.abs(found.images.astype(int) - expected())[found.valid].mean() < 8


def test_equal_input_gives_equal_bytes(tmp_path):
    assert film(tmp_path / "a.mcap").read_bytes() == film(tmp_path / "b.mcap").read_bytes()


def test_what_is_written_is_in_the_inspection(tmp_path):
    said = inspect(film(tmp_path / "a.mcap"))
    assert "/nozzle/image/compressed" in said
    assert "flow_percent" in said


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"encoding": "gif"}, "should be jpeg, png or raw but is 'gif'"),
        ({"flow_percent": np.full(3, 100.0)}, "one value for each of 18 times"),
        ({"flow_percent": np.full(COUNT, np.nan)}, "not finite at sample 0"),
        ({"frames": []}, "there is none; give at least one"),
    ],
)
def test_what_cannot_be_written_is_refused_and_leaves_nothing(tmp_path, changes, said):
    with pytest.raises(ValueError, match=said):
        film(tmp_path / "a.mcap", **changes)
    assert not list(tmp_path.iterdir())


# ---- setpoints


def test_a_setpoint_holds_until_the_next_and_nothing_is_known_before_the_first(tmp_path):
    film(
        tmp_path / "raw/a.mcap",
        frames=((k / 10, frame) for k, (_, frame) in enumerate(pictures())),
        time_s=np.array([0.35, 0.8]),
        flow_percent=np.array([80.0, 120.0]),
        temperature_degC=np.full(2, 200.0),
        print_id=None,
        tip_x_px=None,
        tip_y_px=None,
    )
    found = read(tmp_path / "raw", tip=(175, 175))
    # frames at 0, 0.1, ... 1.7 s
    assert found.reasons[:4] == ["no flow is known"] * 4
    assert found.flow[4:].tolist() == [80.0] * 4 + [120.0] * 10
    assert found.label.tolist() == [-1] * 4 + [0] * 4 + [2] * 10
    assert found.prints == ("a",)


def test_a_measured_temperature_ends_no_segment_and_is_said_to_be_one(tmp_path):
    long = np.arange(60) / RATE
    still = ((k / RATE, np.roll(frame, k, 1)) for k, (_, frame) in enumerate([*pictures()] * 4) if k < 60)
    film(
        tmp_path / "raw/a.mcap",
        frames=still,
        time_s=long,
        flow_percent=np.full(60, 100.0),
        temperature_degC=205 + np.sin(long),
        print_id=None,
        tip_x_px=None,
        tip_y_px=None,
    )
    found = read(tmp_path / "raw", tip=(175, 175))
    assert set(found.segment) == {0}
    assert "changes all the time" in "\n".join(note.message for note in found.notes)


# ---- other machines' topics


def foreign(path: Path, *, flow_share: bool = True, other: str = "") -> Path:
    """Foxglove JSON pictures beside numbers in JSON, with other names and units, the setpoints at 2 Hz;
    `other` is the topic of a camera that looks elsewhere."""
    made = Written()
    elsewhere = made.topic(other, "json", "foxglove.CompressedImage", "jsonschema", b"{}") if other else None
    camera = made.topic("/cam", "json", "foxglove.CompressedImage", "jsonschema", b"{}")
    printer = made.topic("/printer/state", "json")
    for k, (time, frame) in enumerate(pictures()):
        if k % SHOTS == 0:
            flow = FLOWS[k // SHOTS % 3]
            made.message(
                printer,
                10 + time,
                {"extruder": {"rate": flow / 100 if flow_share else flow}, "hotend_target": 210.0},
            )
        data = base64.b64encode(cv2.imencode(".png", frame)[1]).decode()
        made.message(
            camera,
            10 + time,
            {"timestamp": {"sec": 10, "nsec": 0}, "frame_id": "", "format": "png", "data": data},
        )
        if other:
            dark = base64.b64encode(cv2.imencode(".png", 0 * frame)[1]).decode()
            made.message(
                elsewhere,
                10 + time,
                {"timestamp": {"sec": 10, "nsec": 0}, "frame_id": "", "format": "png", "data": dark},
            )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(made.bytes())
    return path


MAPPING = {
    "flow_percent": ("/printer/state:extruder.rate", "percent", 100.0, 0.0),
    "temperature_degC": ("hotend_target", "degC", 1.0, 0.0),
}


def test_a_machine_s_own_topics_are_read_through_a_mapping(tmp_path):
    foreign(tmp_path / "raw/night.mcap")
    found = read(tmp_path / "raw", tip=(175, 175), topics=ANY._replace(mapping=MAPPING))
    np.testing.assert_allclose(
        found.flow, np.tile(np.repeat(FLOWS, SHOTS), 2), rtol=1e-12
    )  # 100 times a hundredth
    frames = [frame for scene in scenes() for frame in scene.frames]
    np.testing.assert_array_equal(
        found.images, [key_area.find(frame, (175, 175), least_score=LEAST).image for frame in frames]
    )
    assert found.prints == ("night",)


def test_of_two_cameras_the_one_that_is_named_is_read(tmp_path):
    foreign(tmp_path / "one/night.mcap")
    path = foreign(tmp_path / "two/night.mcap", other="/bed/camera")
    there = ANY._replace(mapping=MAPPING)
    one, two = (
        read(tmp_path / name, tip=(175, 175), topics=topics)
        for name, topics in (("one", there), ("two", there._replace(image="/cam")))
    )
    np.testing.assert_array_equal(two.images, one.images)
    assert two.valid.any()
    said = refusal(tmp_path / "two", tip=(175, 175), topics=there)
    assert (
        "2 topics have images (/bed/camera, /cam); name the one of the nozzle's camera (params.yaml: "
        "train_classifier.topics.image)" in said
    )
    np.testing.assert_array_equal(middle_frame(path, "/cam"), scenes()[3].frames[0])
    with pytest.raises(ValueError, match="2 topics have images"):
        middle_frame(path, "")


def test_signals_on_one_clock(tmp_path):
    frames, found, _ = open_film(foreign(tmp_path / "night.mcap"), ANY._replace(mapping=MAPPING))
    np.testing.assert_allclose(frames.time_s, 10 + TIME, atol=1e-9)  # nanoseconds
    np.testing.assert_allclose(found["flow_percent"][0], 10 + TIME[::SHOTS], atol=1e-9)
    assert set(found) == {"flow_percent", "temperature_degC"}


@pytest.mark.parametrize(
    ("topics", "said"),
    [
        (
            ANY,
            r"no message has a number 'flow_percent'.*map it in params.yaml: "
            r"train_classifier.topics.mapping.flow_percent",
        ),
        (
            ANY._replace(mapping={"flow": ("a", "percent", 1.0, 0.0)}),
            "params.yaml: train_classifier.topics.mapping.flow is no signal of nozzle frames; "
            "the nearest names are flow_percent",
        ),
        (
            ANY._replace(mapping={"flow_percent": ("a", "1", 1.0, 0.0)}),
            "topics.mapping.flow_percent.unit is 1 but flow_percent is in percent",
        ),
        (
            ANY._replace(mapping=MAPPING | {"print_id": ("/printer/state:job", "1", 1.0, 0.0)}),
            "no message has a number '/printer/state:job'",
        ),
        (ANY._replace(mapping=MAPPING, image="/camera"), "no topic /camera with images"),
    ],
)
def test_a_mapping_that_does_not_fit_is_refused_with_the_nearest_names(tmp_path, topics, said):
    foreign(tmp_path / "raw/night.mcap")
    with pytest.raises(ValueError, match=said):
        read(tmp_path / "raw", tip=(175, 175), topics=topics)


# ---- damaged ones


def test_a_recording_that_breaks_off_gives_what_is_whole(tmp_path):
    path = film(tmp_path / "raw/a.mcap", encoding="raw")
    content = path.read_bytes()
    path.write_bytes(content[: 2 * len(content) // 3])
    found = read(tmp_path / "raw")
    count = len(found.valid)
    assert SHOTS < count < COUNT
    np.testing.assert_array_equal(found.images, expected()[:count])
    assert any("a.mcap: " in note.message for note in found.notes)


def test_pictures_that_cannot_be_decoded_are_counted_and_the_others_go_on(tmp_path):
    def with_bad(count: int) -> Path:
        made = Written()
        camera = made.topic("/cam", "json", "foxglove.CompressedImage", "jsonschema", b"{}")
        printer = made.topic("/p", "json")
        for k, (time, frame) in enumerate(pictures()):
            made.message(printer, time, {"flow_percent": 100.0, "temperature_degC": 200.0})
            data = b"none" if k < count else cv2.imencode(".png", frame)[1].tobytes()
            made.message(
                camera,
                time,
                {
                    "timestamp": {"sec": 0, "nsec": 0},
                    "frame_id": "",
                    "format": "png",
                    "data": base64.b64encode(data).decode(),
                },
            )
        path = tmp_path / f"raw{count}/a.mcap"
        path.parent.mkdir()
        path.write_bytes(made.bytes())
        return path.parent

    found = read(with_bad(4), tip=(175, 175))
    assert len(found.valid) == COUNT - 4
    assert f"4 of {COUNT} frames of /cam cannot be decoded, the first at 0.000 s" in "\n".join(
        note.message for note in found.notes
    )
    assert "found none that can be decoded; record again" in refusal(with_bad(COUNT), tip=(175, 175))


def test_frames_without_a_usable_tip_are_refused_with_the_command(tmp_path):
    film(tmp_path / "raw/a.mcap", tip_x_px=None, tip_y_px=None)
    assert (
        f"a.mcap: {COUNT} of {COUNT} frames were left out: no tip is known, the first 0.000 s; "
        "find it with ./run beadline calibrate tip" in refusal(tmp_path / "raw")
    )
    assert "(400, 10)" in refusal(tmp_path / "raw", tip=(400, 10))


def test_files_that_are_no_such_recording_are_refused(tmp_path):
    (tmp_path / "raw").mkdir()
    path = tmp_path / "raw/a.mcap"
    path.write_bytes(b"")
    assert "a.mcap is empty" in refusal(tmp_path / "raw")
    path.write_bytes(b"\x89MCAP0\r\n" + bytes(50))
    assert "a.mcap" in refusal(tmp_path / "raw")
    table(path, [{"t_s": "1", "u": "2"}, {"t_s": "2", "u": "2"}])
    assert "a.mcap" in refusal(tmp_path / "raw")
    film(path, frames=((100 + time, frame) for time, frame in pictures()), time_s=100 + TIME)
    read(tmp_path / "raw")
    with pytest.raises(ValueError, match="do not overlap in time"):
        film(path, frames=((100 + time, frame) for time, frame in pictures()))


def test_what_was_looked_at_before_is_not_looked_at_again(tmp_path, monkeypatch):
    film(tmp_path / "raw/a.mcap")
    first = read(tmp_path / "raw")
    with monkeypatch.context() as inside:
        inside.setattr(key_area, "find", None)
        again = read(tmp_path / "raw")
    assert (again.reasons, again.source) == (first.reasons, first.source)
    np.testing.assert_array_equal(again.images, first.images)
    assert (read(tmp_path / "raw", tip=(170, 170)).images != first.images).any()


# ---- the middle frame


def test_the_middle_frame_is_in_the_middle(tmp_path):
    np.testing.assert_array_equal(middle_frame(film(tmp_path / "a.mcap"), ""), scenes()[3].frames[0])
    np.testing.assert_array_equal(middle_frame(foreign(tmp_path / "b.mcap"), ""), scenes()[3].frames[0])


def test_topics_have_defaults_of_the_same_names():
    assert {name: source.source for name, source in Topics("", "", {}).sources().items()}[
        "flow_percent"
    ] == "flow_percent"
