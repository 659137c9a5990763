import io
import json
import struct
import tracemalloc
import zlib
from pathlib import Path

import cv2
import numpy as np
import pandas
import pytest
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from pipeline.recordings import images, trial_files
from pipeline.recordings.images import ENCODERS
from pipeline.recordings.recordings import read
from pipeline.recordings.trial_files import (
    COMMAND,
    FLOW,
    POSITION,
    SPEED,
    TrialConditions,
    TrialRecording,
    TrialSignals,
    read_trial,
    write_command,
    write_trial,
)
from tests.mcap_writing import NO, ZSTD, Written, cdr, chunks, flipped

CONDITIONS = TrialConditions(
    material="A",
    nozzle="0.6 mm",
    trial=3,
    law="model_inverse",
    routine=2,
    speed_mm_per_s=8.0,
    off_s=4.0,
    on_s=6.0,
    pause_s=0.6,
    tail_s=8.0,
    bead_area_mm2=0.304,
    px_per_mm=125.1,
    offset_px=-0.7,
    contact_angle_deg=90.0,
    mm_per_px=-0.008,
    nozzle_column=60.5,
)
TIME = np.arange(100) * 0.02
SIGNALS = {
    "time_s": TIME,
    "position_mm": 8 * TIME,
    "speed_mm_per_s": np.full(100, 8.0),
    "command_mm": np.sin(TIME) / 3,
    "flow_mm3_per_s": np.cos(TIME) / 7,
}


def picture(k: int, height: int = 48, width: int = 64, dtype=np.uint8) -> np.ndarray:
    """A bright bar with noise, another one for each k."""
    rng = np.random.default_rng(k)
    rows = np.arange(height)[:, None]
    bar = np.where(abs(rows - height / 2 - k % 5) < height / 6, 150.0, 60.0)
    frame = cv2.GaussianBlur(bar + rng.normal(0, 4, (height, width)), (0, 0), 1)
    return np.rint(frame * (1 if dtype == np.uint8 else 200)).astype(dtype)


def pictures(count: int = 60, **kind):
    return ((k / 30, picture(k, **kind)) for k in range(count))


def written(path: Path, encoding: str = "raw", frames=None, **changes) -> Path:
    conditions = changes.pop("conditions", CONDITIONS)
    signals = TrialSignals(**(SIGNALS | changes))
    write_trial(path, conditions, pictures() if frames is None else frames, signals, encoding=encoding)
    return path


def opened(path: Path, **settings) -> TrialRecording:
    return read_trial(path, **({"unreadable_share": 0.1} | settings))


def refusal(path: Path, **settings) -> str:
    with pytest.raises(ValueError, match=path.name) as refused:
        list(opened(path, **settings).frames)
    assert "\n" not in str(refused.value)
    return str(refused.value)


# ---- round trips


@pytest.mark.parametrize(
    ("encoding", "dtype"), [("raw", np.uint8), ("raw", np.uint16), ("png", np.uint8), ("png", np.uint16)]
)
def test_pixels_times_signals_and_conditions_come_back_as_they_were(tmp_path, encoding, dtype):
    trial = opened(written(tmp_path / "trial.mcap", encoding, pictures(dtype=dtype)))
    assert trial.conditions == CONDITIONS
    assert trial.notes == []
    assert set(trial.signals) == {"position_mm", "speed_mm_per_s", "command_mm", "flow_mm3_per_s"}
    for name, (time, values) in trial.signals.items():
        np.testing.assert_allclose(time, TIME, atol=1e-9)  # times are whole nanoseconds
        np.testing.assert_array_equal(values, SIGNALS[name])
    assert len(trial.frames) == 60
    for k, (time, frame) in enumerate(trial.frames):
        assert time == trial.frames.time_s[k] == pytest.approx(k / 30, abs=1e-9)
        assert frame.dtype == dtype
        np.testing.assert_array_equal(frame, picture(k, dtype=dtype))
    assert k == 59
    assert trial.frames.notes() == []


def test_jpeg_is_off_by_a_few_levels_at_most(tmp_path):
    trial = opened(written(tmp_path / "trial.mcap", "jpeg"))
    off = np.array([frame.astype(int) - picture(k) for k, (_, frame) in enumerate(trial.frames)])
    # quality 95 divides the coefficients of a block by 1 to 12: half of that,
    # times what 64 of them add up to at worst in practice
    assert abs(off).max() <= 6
    assert off.std() < 1
    # no bias: the width of a bead hangs on half levels
    assert abs(off.mean()) < 0.05


def test_frames_can_be_walked_again_and_two_walks_at_once_do_not_disturb_each_other(tmp_path):
    frames = opened(written(tmp_path / "trial.mcap")).frames
    pairs = list(zip(frames, frames, strict=True))
    assert len(pairs) == 60
    for (_, one), (_, other) in pairs:
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("encoding", ["raw", "jpeg", "png"])
def test_equal_input_gives_equal_bytes(tmp_path, encoding):
    one, other = (written(tmp_path / f"{name}.mcap", encoding).read_bytes() for name in ("one", "other"))
    assert one == other
    for secret in (b"/tmp", tmp_path.name.encode()):
        assert secret not in one


def test_any_clock_of_our_recordings_is_the_same_clock(tmp_path):
    path = written(tmp_path / "trial.mcap", "jpeg")
    for clock in ("log_time", "publish_time", "header.stamp"):
        trial = opened(path, time=clock)
        np.testing.assert_allclose(trial.signals["command_mm"][0], TIME, atol=1e-9)
        assert (
            [time for time, _ in trial.frames]
            == trial.frames.time_s.tolist()
            == opened(path).frames.time_s.tolist()
        )


def test_memory_is_that_of_a_few_chunks_however_long_the_trial(tmp_path):
    frame = picture(0, 480, 640)
    tracemalloc.start()
    path = written(tmp_path / "trial.mcap", "raw", ((k / 100, frame) for k in range(150)))
    writing = tracemalloc.get_traced_memory()[1]
    tracemalloc.reset_peak()
    assert sum(1 for _ in opened(path).frames) == 150
    reading = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert path.stat().st_size > 46e6
    # a chunk holds 1 MB and a frame; the writer has four copies of it at a time, the reader the twenty
    # messages of each channel that tell what is in it
    assert writing < 10e6
    assert reading < 12e6


# ---- others open it


@pytest.mark.parametrize("encoding", ["raw", "jpeg", "png"])
def test_the_mcap_package_finds_standard_images_and_schemas_that_say_all(tmp_path, encoding):
    path = written(tmp_path / "trial.mcap", encoding)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert (reader.get_header().profile, reader.get_header().library) == ("ros2", "beadline")
        (metadata,) = reader.iter_metadata()
        messages = list(reader.iter_messages())
    assert metadata.name == "beadline.trial"
    assert {
        "material": "A",
        "trial": "3",
        "schema_version": "1",
        "px_per_mm": "125.1",
    }.items() <= metadata.metadata.items()
    assert len(messages) == 360
    assert sorted(message.log_time for _, _, message in messages) == [
        message.log_time for _, _, message in messages
    ]
    assert {channel.message_encoding for _, channel, _ in messages} == {"cdr"}
    assert {schema.encoding for schema, _, _ in messages} == {"ros2msg"}
    assert all(
        b"MSG: std_msgs/Header" in schema.data and b"MSG: builtin_interfaces/Time" in schema.data
        for schema, _, _ in messages
    )
    images = [
        (schema.name, message.data)
        for schema, _, message in messages
        if schema.name.startswith("sensor_msgs/msg/")
    ]
    frame, stamp = picture(1), [("i", [0]), ("I", [33333333]), ("s", "nozzle")]
    if encoding == "raw":
        expected = cdr(
            *stamp,
            ("I", [48, 64]),
            ("s", "mono8"),
            ("B", [0]),
            ("I", [64, 48 * 64]),
            ("B", frame.ravel().tolist()),
        )
    else:
        ending, settings = ENCODERS[encoding]
        data = cv2.imencode(ending, frame, settings)[1].tolist()
        expected = cdr(*stamp, ("s", encoding), ("I", [len(data)]), ("B", data))
    assert images[1] == (f"sensor_msgs/msg/{'Image' if encoding == 'raw' else 'CompressedImage'}", expected)


def test_the_reader_of_numeric_recordings_reads_the_signals_by_their_schemas(tmp_path):
    raw = read(written(tmp_path / "trial.mcap"), [POSITION, SPEED, COMMAND, FLOW])
    for name, (time, values) in raw.signals.items():
        np.testing.assert_allclose(time, TIME, atol=1e-9)
        np.testing.assert_array_equal(values, SIGNALS[name])


# ---- the next trial's command


def test_the_next_command_is_written_as_csv_and_mcap_alike(tmp_path):
    write_command(
        tmp_path / "trial_0.4", CONDITIONS._replace(trial=4), time_s=TIME, command_mm=SIGNALS["command_mm"]
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["trial_0.4.csv", "trial_0.4.mcap"]
    table = pandas.read_csv(tmp_path / "trial_0.4.csv")
    assert list(table) == ["time_s", "displacement_mm"]
    np.testing.assert_array_equal(table["displacement_mm"], SIGNALS["command_mm"])
    time, values = read(tmp_path / "trial_0.4.mcap", [COMMAND]).signals["command_mm"]
    np.testing.assert_allclose(time, TIME, atol=1e-9)
    np.testing.assert_array_equal(values, SIGNALS["command_mm"])
    with (tmp_path / "trial_0.4.mcap").open("rb") as stream:
        assert next(make_reader(stream).iter_metadata()).metadata["trial"] == "4"


# ---- a machine's own recording

MAPPED = [
    POSITION._replace(source="/stage:x_m", scale=1e3),
    SPEED._replace(source="/stage:v"),
    COMMAND._replace(source="/pump/command:target"),
]


def machine_recording(
    images: list[tuple[str, str, bytes]],
    *,
    start_s: float = 1.7e9,
    published_s: float = 0.0,
    compression=ZSTD,
) -> bytes:
    """JSON stage at 50 Hz and pump at 10 Hz from `start_s` on; images
    (encoding, type, message) at 10 Hz on /camera."""
    made = Written(compression)
    stage, pump = made.topic("/stage", "json"), made.topic("/pump/command", "json")
    cameras = {}
    for encoding, kind, _ in images:
        cameras.setdefault((encoding, kind), None)
    for encoding, kind in cameras:
        cameras[encoding, kind] = made.topic(
            "/camera", encoding, kind, "ros2msg" if encoding == "cdr" else "", b"uint8 unused"
        )
    for k in range(100):
        made.message(stage, start_s + k / 50, {"x_m": 0.008 * k / 50, "v": 8.0})
        if k % 5 == 0:
            made.message(pump, start_s + k / 50, {"target": k / 50})
            if k // 5 < len(images):
                encoding, kind, message = images[k // 5]
                made.message(
                    cameras[encoding, kind], start_s + k / 50 + 0.001, message, start_s + k / 50 + published_s
                )
    return made.bytes()


def image_at(stamp_ns: int, frame: np.ndarray) -> tuple[str, str, bytes]:
    return "cdr", "sensor_msgs/msg/Image", images.image(images.header(stamp_ns, "cam"), frame)


def ros1_at(frame: np.ndarray) -> tuple[str, str, bytes]:
    head = struct.pack("<IIII3s", 0, 0, 0, 3, b"cam") + struct.pack(
        "<III5sBI", *frame.shape, 5, b"mono8", 0, frame.shape[1]
    )
    return "ros1", "sensor_msgs/Image", head + struct.pack("<I", frame.size) + frame.tobytes()


@pytest.mark.parametrize("compression", [NO, ZSTD])
@pytest.mark.parametrize("form", ["cdr", "ros1"])
def test_a_machines_own_topics_units_and_calendar_are_read_by_the_mapping(tmp_path, form, compression):
    path = tmp_path / "machine.mcap"
    frames = [picture(k) for k in range(20)]
    path.write_bytes(
        machine_recording(
            [image_at(0, frame) if form == "cdr" else ros1_at(frame) for frame in frames],
            compression=compression,
        )
    )
    trial = opened(path, sources=MAPPED)
    assert trial.conditions is None
    np.testing.assert_allclose(trial.signals["position_mm"][1], 8 * TIME, rtol=1e-12)
    np.testing.assert_allclose(
        trial.signals["command_mm"][0], np.arange(20) / 10, atol=1e-6
    )  # a double of 1.7e9 s has steps of 0.24 us
    np.testing.assert_allclose(trial.frames.time_s, np.arange(20) / 10 + 0.001, atol=1e-6)
    assert [note.kind for note in trial.notes] == ["clock", "outside", "conditions"]
    for (_, read_back), frame in zip(trial.frames, frames, strict=True):
        np.testing.assert_array_equal(read_back, frame)


def test_a_machines_clock_may_be_the_time_of_publishing(tmp_path):
    path = tmp_path / "machine.mcap"
    path.write_bytes(machine_recording([image_at(0, picture(k)) for k in range(20)], published_s=0.0))
    trial = opened(path, sources=MAPPED, time="publish_time")
    np.testing.assert_allclose(trial.frames.time_s, np.arange(20) / 10, atol=1e-6)
    assert [time for time, _ in trial.frames] == trial.frames.time_s.tolist()


def test_a_topic_whose_recorder_was_restarted_gives_the_frames_of_both_channels(tmp_path):
    path = tmp_path / "machine.mcap"
    path.write_bytes(
        machine_recording(
            [image_at(0, picture(k)) for k in range(12)] + [ros1_at(picture(k)) for k in range(12, 20)]
        )
    )
    frames = list(opened(path, sources=MAPPED).frames)
    assert len(frames) == 20
    np.testing.assert_array_equal([frame for _, frame in frames], [picture(k) for k in range(20)])


# ---- bad input


def test_frames_and_command_without_a_common_time_are_refused_with_both_ranges(tmp_path):
    with pytest.raises(
        ValueError,
        match=(
            r"the frames run from 5.000 to 6.967 s but signals from 0.000 to 1.980 s, so they do not "
            r"overlap in time; record both"
        ),
    ):
        written(tmp_path / "trial.mcap", frames=((time + 5, frame) for time, frame in pictures()))
    assert list(tmp_path.iterdir()) == []
    made = Written()
    stage, camera = (
        made.topic("/gantry", "json"),
        made.topic("/camera", "cdr", "sensor_msgs/msg/Image", "ros2msg", b"uint8 unused"),
    )
    plunger = made.topic("/plunger", "json")
    for k in range(10):
        made.message(stage, k / 10, {"position_mm": k, "speed_mm_per_s": 8})
        made.message(plunger, 20 + k / 10, {"displacement_mm": k})
        made.message(camera, k / 10, image_at(0, picture(k))[2])
    path = tmp_path / "machine.mcap"
    path.write_bytes(made.bytes())
    assert (
        "the frames run from 0.000 to 0.900 s but command_mm from 20.000 to 20.900 s, "
        "so they do not overlap in time" in refusal(path)
    )


def test_frames_outside_the_command_are_counted(tmp_path):
    trial = opened(written(tmp_path / "trial.mcap", frames=((time + 1, frame) for time, frame in pictures())))
    # 60 frames from 1 to 2.967 s, the command ends at 1.98 s: frames 30 to 59 come after it
    assert [note.message for note in trial.notes] == ["30 of 60 frames lie before or after the command"]


def test_a_recording_without_images_or_command_is_refused_with_what_it_has(tmp_path):
    path = tmp_path / "trial.mcap"
    write_command(tmp_path / "trial", CONDITIONS, time_s=TIME, command_mm=TIME)
    assert (
        "there is no image topic; it has /plunger (beadline_msgs/msg/Plunger in cdr); "
        "images are read as sensor_msgs Image" in refusal(path)
    )
    made = Written()
    camera = made.topic("/camera", "cdr", "sensor_msgs/msg/Image", "ros2msg", b"uint8 unused")
    made.message(camera, 0.0, image_at(0, picture(0))[2])
    path.write_bytes(made.bytes())
    message = refusal(path)
    assert "no message has a number '/gantry:position_mm'" in message
    assert "map position_mm to the topic that has it" in message
    written(path)
    sources = [POSITION, SPEED, COMMAND._replace(source="/plunger:displacement"), FLOW]
    message = refusal(path, sources=sources)
    assert (
        "no message has a number '/plunger:displacement'; the nearest names are /plunger:displacement_mm"
        in message
    )
    assert "map command_mm to" in message
    assert (
        "there is no topic /camera with images; it has /gantry (beadline_msgs/msg/Gantry in cdr)"
        in refusal(path, image="/camera")
    )


def test_a_recording_in_another_format_is_not_passed_over(tmp_path):
    (tmp_path / "trial_0.mcap").write_bytes(b"")
    (tmp_path / "notes.txt").write_text("of the evening")
    assert trial_files.trial_paths(tmp_path) == [tmp_path / "trial_0.mcap"]
    (tmp_path / "trial_1.CSV").write_text("time_s,command_mm")
    with pytest.raises(
        ValueError, match=r"trial_1\.CSV: expected a trial as MCAP .* found \.CSV; record the"
    ):
        trial_files.trial_paths(tmp_path)


def test_of_two_cameras_one_must_be_named(tmp_path):
    path = tmp_path / "trial.mcap"
    made = Written()
    stage, plunger = made.topic("/gantry", "json"), made.topic("/plunger", "json")
    cameras = [
        made.topic(name, "cdr", "sensor_msgs/msg/Image", "ros2msg", b"uint8 unused")
        for name in ("/left", "/right")
    ]
    for k in range(10):
        made.message(stage, k / 10, {"position_mm": k, "speed_mm_per_s": 8})
        made.message(plunger, k / 10, {"displacement_mm": k})
        for i, camera in enumerate(cameras):
            made.message(camera, k / 10, image_at(0, picture(k + 20 * i))[2])
    path.write_bytes(made.bytes())
    assert "2 topics have images (/left, /right); name the one of the nozzle's camera" in refusal(path)
    np.testing.assert_array_equal(
        [frame for _, frame in opened(path, image="/right").frames], [picture(k + 20) for k in range(10)]
    )


def test_frames_of_changing_size_are_refused_in_writing_and_in_reading(tmp_path):
    with pytest.raises(
        ValueError,
        match=r"frame 1 is \(24, 64\) of uint8 but the first is \(48, 64\) of uint8; write one size",
    ):
        written(tmp_path / "trial.mcap", frames=iter([(0.0, picture(0)), (0.1, picture(1, height=24))]))
    assert list(tmp_path.iterdir()) == []
    path = tmp_path / "machine.mcap"
    path.write_bytes(
        machine_recording(
            [image_at(0, picture(k, height=24 if k == 12 else 48)) for k in range(20)], start_s=0.0
        )
    )
    message = refusal(path, sources=MAPPED)
    assert (
        "the frame of /camera at 1.201 s is 64 x 24 px of 8 bits but the first is 64 x 48 px of 8; "
        "record a trial at one size" in message
    )


@pytest.mark.parametrize("clock", ["log_time", "publish_time"])
def test_frames_that_cannot_be_decoded_are_left_out_and_counted_until_they_are_too_many(tmp_path, clock):
    frames = [image_at(0, picture(k)) for k in range(20)]
    # one that is cut off, one whose rows are not all there
    frames[3] = (*frames[3][:2], frames[3][2][:30])
    frames[11] = (*frames[11][:2], frames[11][2][:-500])
    path = tmp_path / "machine.mcap"
    path.write_bytes(machine_recording(frames, start_s=0.0))
    trial = opened(path, sources=MAPPED, time=clock)
    pictures = [frame for _, frame in trial.frames]
    np.testing.assert_array_equal(pictures, [picture(k) for k in range(20) if k not in (3, 11)])
    assert trial.frames.unreadable == 2
    (note,) = trial.frames.notes()
    assert note.message.startswith("2 of 20 frames of /camera cannot be decoded, the first at 0.30")
    assert "2 of 20 frames of /camera cannot be decoded, the first at 0.30" in refusal(
        path, sources=MAPPED, unreadable_share=0.09
    )
    assert list(opened(path, sources=MAPPED, time=clock).frames)[-1][0] == trial.frames.time_s[-1]


def test_a_jpeg_that_is_cut_off_is_no_frame(tmp_path):
    data = cv2.imencode(".jpg", picture(0))[1]
    intact_bytes, cut = (
        images.image_bytes(images.header(0, "cam"), "jpeg", part) for part in (data, data[:-200])
    )
    path = tmp_path / "machine.mcap"
    path.write_bytes(
        machine_recording(
            [("cdr", "sensor_msgs/msg/CompressedImage", cut if k == 5 else intact_bytes) for k in range(20)],
            start_s=0.0,
        )
    )
    trial = opened(path, sources=MAPPED)
    assert sum(1 for _ in trial.frames) == 19
    assert trial.frames.unreadable == 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"command_mm": np.where(TIME == TIME[7], np.nan, 0.0)},
        "command_mm is not finite at sample 7; leave that sample out"),
        ({"command_mm": TIME[:-1]},
        r"command_mm should have one value for each of 100 times but has shape \(99,\)"),
        ({"time_s": TIME[::-1]}, "time_s should run forward from 0 or later"),
        ({"time_s": TIME - 1}, "time_s should run forward from 0 or later"),
        ({"frames": iter([])}, "a trial should have frames but there is none; give at least one"),
        ({"frames": iter([(1.0, picture(0)), (1.0, picture(1))])},
        "frame 1 is at 1 s but frames should run forward"),
        ({"frames": iter([(np.nan, picture(0))])}, "frame 0 is at nan s but frames should run forward"),
        ({"frames": iter([(0.0, np.zeros((4, 4, 3), np.uint8))])},
        r"frame 0 should be \(height, width\) of uint8 or uint16 but is \(4, 4, 3\) of uint8; make it gray"),
        ({"frames": pictures(dtype=np.uint16), "encoding": "jpeg"},
        r"frame 0 should be \(height, width\) of uint8 but is \(48, 64\) of uint16"),
        ({"encoding": "gif"}, "the encoding should be jpeg, png or raw but is 'gif'; name one of them"),
    ],
)  # fmt: skip
def test_what_is_not_a_trial_is_not_written_and_the_last_good_one_stays(tmp_path, changes, message):
    path = tmp_path / "trial.mcap"
    path.write_bytes(b"the last good one")
    with pytest.raises(ValueError, match=f"trial.mcap: {message}"):
        written(path, **changes)
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [
        ("trial.mcap", b"the last good one")
    ]


def test_a_generator_that_fails_leaves_nothing_behind(tmp_path):
    def failing():
        yield 0.0, picture(0)
        raise RuntimeError("the camera is gone")

    with pytest.raises(RuntimeError, match="the camera is gone"):
        written(tmp_path / "trial.mcap", frames=failing())
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_is_no_recording_is_refused_in_one_sentence(tmp_path):
    path = tmp_path / "trial.mcap"
    assert "is missing" in refusal(path)
    path.write_bytes(b"")
    assert "is empty (0 bytes)" in refusal(path)
    path.write_text("time_s,u\n0,1\n")
    assert "begin no mcap file" in refusal(path)
    table = tmp_path / "trial.csv"
    table.write_text("time_s,u\n0,1\n")
    assert "is a table but a trial should be an MCAP recording with frames" in refusal(table)
    assert "is a folder" in refusal(tmp_path)
    path.write_bytes(Written().bytes())
    assert "it has no whole message (it was closed before any message came)" in refusal(path)


# ---- damage


@pytest.fixture(scope="module")
def large(tmp_path_factory) -> bytes:
    """Five chunks with frames of 480 x 640."""
    return written(
        tmp_path_factory.mktemp("large") / "trial.mcap",
        "raw",
        ((k / 7, picture(k, 480, 640)) for k in range(14)),
    ).read_bytes()


def intact(trial: TrialRecording) -> int:
    """How many frames came out; each is the one that was written at its time, and so are the samples."""
    time, command = trial.signals["command_mm"]
    np.testing.assert_array_equal(command, SIGNALS["command_mm"][np.rint(time * 50).astype(int)])
    count = 0
    for time, frame in trial.frames:
        count += 1
        assert zlib.crc32(frame) == zlib.crc32(picture(round(time * 7), 480, 640))
    return count


def test_60_of_60_bit_flips_inside_chunks_are_detected_and_the_other_chunks_kept(tmp_path, large):
    parts, path, rng, detected = chunks(large), tmp_path / "trial.mcap", np.random.default_rng(0), 0
    assert len(parts) >= 4
    for _ in range(60):
        offset, start, end = parts[rng.integers(len(parts))]
        path.write_bytes(flipped(large, int(rng.integers(start, end)), int(rng.integers(8))))
        trial = opened(path)
        detected += any(f"at byte {offset} was left out" in note.message for note in trial.notes)
        assert trial.conditions == CONDITIONS
        assert 14 - 5 <= len(trial.frames)  # a chunk holds at most four frames and a bit
    assert detected == 60
    assert intact(trial) == len(trial.frames)


def test_bit_flips_in_the_conditions_are_detected(tmp_path, large):
    path, rng = tmp_path / "trial.mcap", np.random.default_rng(1)
    first, last = large.index(b"beadline.trial") - 13, chunks(large)[0][0]
    for place in rng.integers(first, last, 40):
        path.write_bytes(flipped(large, int(place), int(rng.integers(8))))
        try:
            trial = opened(path)
        except ValueError as error:
            assert "\n" not in str(error)
        else:
            # a flip in the name of the CRC itself leaves the conditions as they were, and they are read
            assert (
                trial.conditions == CONDITIONS
                if trial.conditions
                else any(note.kind == "conditions" for note in trial.notes)
            )


def test_every_complete_chunk_of_a_truncated_trial_is_recovered_and_counted(tmp_path, large):
    parts, path = chunks(large), tmp_path / "trial.mcap"
    # the mcap package counts the frames in each chunk of the whole file; channel 4 is that of the images
    records = [
        record
        for record in StreamReader(io.BytesIO(large), emit_chunks=True).records
        if isinstance(record, Chunk)
    ]
    held = [
        sum(isinstance(record, Message) and record.channel_id == 4 for record in breakup_chunk(chunk))
        for chunk in records
    ]
    assert sum(held) == 14
    for end in np.random.default_rng(2).integers(parts[0][2], parts[-1][2], 8):
        complete = sum(part[2] <= end for part in parts)
        path.write_bytes(large[:end])
        trial = opened(path)
        assert any(
            f"{complete} whole chunks and" in note.message for note in trial.notes if note.kind == "truncated"
        )
        assert trial.conditions == CONDITIONS
        assert len(trial.frames) == sum(held[:complete]) == intact(trial)
    path.write_bytes(large[: parts[0][2] - 1])
    assert "it has no whole message" in refusal(path)


def test_a_chunk_of_frames_alone_that_is_lost_leaves_the_signals_whole(tmp_path):
    """Signals first, frames in chunks behind them: as recorders write that have a buffer for each topic."""
    stream = io.BytesIO()
    writer = Writer(stream, compression=CompressionType.NONE, chunk_size=1)
    writer.start("", "test")
    stage, plunger = (
        writer.register_channel("/gantry", "json", 0),
        writer.register_channel("/plunger", "json", 0),
    )
    camera = writer.register_channel(
        "/camera", "cdr", writer.register_schema("sensor_msgs/msg/Image", "ros2msg", b"")
    )
    for k in range(10):
        writer.add_message(
            stage, k * 10**8, json.dumps({"position_mm": k, "speed_mm_per_s": 8}).encode(), k * 10**8
        )
        writer.add_message(plunger, k * 10**8, json.dumps({"displacement_mm": k}).encode(), k * 10**8)
    for k in range(10):
        writer.add_message(camera, k * 10**8, image_at(0, picture(k))[2], k * 10**8)
    writer.finish()
    content = stream.getvalue()
    _, start, _ = chunks(content)[-3]
    path = tmp_path / "machine.mcap"
    path.write_bytes(flipped(content, start + 900, 3))
    trial = opened(path)
    assert trial.signals["command_mm"][1].tolist() == list(range(10))
    assert [round(10 * time) for time, _ in trial.frames] == [0, 1, 2, 3, 4, 5, 6, 8, 9]
    assert [note.kind for note in trial.notes] == ["damage", "conditions"]


def test_conditions_of_another_version_or_with_a_gap_are_refused(tmp_path):
    pairs = {"schema_version": "1"} | {name: str(value) for name, value in CONDITIONS._asdict().items()}
    assert trial_files._conditions(tmp_path, pairs, []) == CONDITIONS
    for change, message in [
        ({"schema_version": "2"}, "have version 2 but 1 is read"),
        ({"pause_s": "short"}, "could not convert string to float: 'short'"),
        ({"crc32": "00000000"}, "say 00000000, so they are damaged"),
    ]:
        with pytest.raises(ValueError, match=message):
            trial_files._conditions(tmp_path, pairs | change, [])
    with pytest.raises(ValueError, match="the trial's conditions lack pause_s"):
        trial_files._conditions(
            tmp_path, {name: value for name, value in pairs.items() if name != "pause_s"}, []
        )
