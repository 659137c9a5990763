import base64
import json
import struct

import cv2
import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader

from pipeline.recordings.images import ImageMessage, gray, image, is_image, reader
from pipeline.recordings.images import header as header_of
from pipeline.recordings.messages import Channel, UnreadableMessage
from tests.mcap_writing import cdr

# A picture of 2 rows, [1 2 3] and [4 5 6], each with a byte of padding, taken at 7.000000500 s by "cam"; and
# PNGDATA as format "png" of the same camera.
# rosbags 0.11: serialize_ros1 (counter 9), serialize_cdr in both byte orders
ROS1 = (
    "0900000007000000f40100000300000063616d0200000003000000050000006d6f6e6f38000400000008000000010203000405"
    "0600"
)
ROS1_COMPRESSED = "0900000007000000f40100000300000063616d03000000706e6707000000504e4744415441"
CDR = (
    "0001000007000000f40100000400000063616d000200000003000000060000006d6f6e6f380000000400000008000000010203"
    "0004050600"
)
CDR_BIG = (
    "0000000000000007000001f40000000463616d000000000200000003000000066d6f6e6f380000000000000400000008010203"
    "0004050600"
)
CDR_COMPRESSED = "0001000007000000f40100000400000063616d0004000000706e670007000000504e4744415441"
# foxglove-schemas-protobuf 0.3 and google.protobuf 7.36: the descriptor set and a message of each
PROTOBUF = "0a05080710f40315030000001d0200000022056d6f6e6f382d04000000320801020300040506003a0363616d"
PROTOBUF_COMPRESSED = "0a05080710f4031207504e47444154411a03706e67220363616d"
TIMESTAMP_FILE = (
    "Cv8BCh9nb29nbGUvcHJvdG9idWYvdGltZXN0YW1wLnByb3RvEg9nb29nbGUucHJvdG9idWYiOwoJVGltZXN0YW1wEhgKB3NlY2"
    "9uZHMYASABKANSB3NlY29uZHMSFAoFbmFub3MYAiABKAVSBW5h"
    "bm9zQoUBChNjb20uZ29vZ2xlLnByb3RvYnVmQg5UaW1lc3RhbXBQcm90b1ABWjJnb29nbGUuZ29sYW5nLm9yZy9wcm90b2J1Zi"
    "90eXBlcy9rbm93bi90aW1lc3RhbXBwYvgBAaICA0dQQqoCHkdv"
    "b2dsZS5Qcm90b2J1Zi5XZWxsS25vd25UeXBlc2IGcHJvdG8z"
)
RAW_IMAGE_FILE = (
    "CucBChdmb3hnbG92ZS9SYXdJbWFnZS5wcm90bxIIZm94Z2xvdmUaH2dvb2dsZS9wcm90b2J1Zi90aW1lc3RhbXAucHJvdG8imA"
    "EKCFJhd0ltYWdlEi0KCXRpbWVzdGFtcBgBIAEoCzIaLmdvb2ds"
    "ZS5wcm90b2J1Zi5UaW1lc3RhbXASEAoIZnJhbWVfaWQYByABKAkSDQoFd2lkdGgYAiABKAcSDgoGaGVpZ2h0GAMgASgHEhAKCG"
    "VuY29kaW5nGAQgASgJEgwKBHN0ZXAYBSABKAcSDAoEZGF0YRgG"
    "IAEoDGIGcHJvdG8z"
)
COMPRESSED_IMAGE_FILE = (
    "CsUBCh5mb3hnbG92ZS9Db21wcmVzc2VkSW1hZ2UucHJvdG8SCGZveGdsb3ZlGh9nb29nbGUvcHJvdG9idWYvdGltZXN0YW1wLn"
    "Byb3RvInAKD0NvbXByZXNzZWRJbWFnZRItCgl0aW1lc3RhbXAY"
    "ASABKAsyGi5nb29nbGUucHJvdG9idWYuVGltZXN0YW1wEhAKCGZyYW1lX2lkGAQgASgJEgwKBGRhdGEYAiABKAwSDgoGZm9ybW"
    "F0GAMgASgJYgZwcm90bzM="
)
STAMP = {"sec": 7, "nsec": 500}
ROWS = base64.b64encode(bytes([1, 2, 3, 0, 4, 5, 6, 0])).decode()
JSON = json.dumps(
    {
        "timestamp": STAMP,
        "frame_id": "cam",
        "width": 3,
        "height": 2,
        "encoding": "mono8",
        "step": 4,
        "data": ROWS,
    }
).encode()
JSON_COMPRESSED = json.dumps(
    {"timestamp": STAMP, "frame_id": "cam", "format": "png", "data": base64.b64encode(b"PNGDATA").decode()}
).encode()
# builtin_interfaces/Time, frame, then as foxglove_msgs has its fields
FOXGLOVE_CDR = cdr(
    ("i", [7]),
    ("I", [500]),
    ("s", "cam"),
    ("I", [3, 2]),
    ("s", "mono8"),
    ("I", [4, 8]),
    ("B", [1, 2, 3, 0, 4, 5, 6, 0]),
)
FOXGLOVE_CDR_COMPRESSED = cdr(
    ("i", [7]), ("I", [500]), ("s", "cam"), ("I", [7]), ("B", b"PNGDATA"), ("s", "png")
)


def channel(encoding: str, name: str, schema: bytes = b"") -> Channel:
    return Channel(1, "/camera", encoding, {}, name, "", schema)


DESCRIPTORS = [
    base64.b64decode(TIMESTAMP_FILE) + base64.b64decode(file)
    for file in (RAW_IMAGE_FILE, COMPRESSED_IMAGE_FILE)
]
RAW = {
    "ros1": (channel("ros1", "sensor_msgs/Image"), bytes.fromhex(ROS1)),
    "cdr": (channel("cdr", "sensor_msgs/msg/Image"), bytes.fromhex(CDR)),
    "cdr big-endian": (channel("cdr", "sensor_msgs/msg/Image"), bytes.fromhex(CDR_BIG)),
    "cdr foxglove": (channel("cdr", "foxglove_msgs/msg/RawImage"), FOXGLOVE_CDR),
    "cdr idl": (channel("cdr", "sensor_msgs::msg::dds_::Image_"), bytes.fromhex(CDR)),
    "protobuf": (channel("protobuf", "foxglove.RawImage", DESCRIPTORS[0]), bytes.fromhex(PROTOBUF)),
    "json": (channel("json", "foxglove.RawImage"), JSON),
}
COMPRESSED = {
    "ros1": (channel("ros1", "sensor_msgs/CompressedImage"), bytes.fromhex(ROS1_COMPRESSED)),
    "cdr": (channel("cdr", "sensor_msgs/msg/CompressedImage"), bytes.fromhex(CDR_COMPRESSED)),
    "cdr foxglove": (channel("cdr", "foxglove_msgs/msg/CompressedImage"), FOXGLOVE_CDR_COMPRESSED),
    "protobuf": (
        channel("protobuf", "foxglove.CompressedImage", DESCRIPTORS[1]),
        bytes.fromhex(PROTOBUF_COMPRESSED),
    ),
    "json": (channel("json", "foxglove.CompressedImage"), JSON_COMPRESSED),
}


def rows(
    encoding: str,
    height: int,
    width: int,
    data: np.ndarray | bytes,
    *,
    step: int = 0,
    big_endian: bool = False,
) -> ImageMessage:
    return ImageMessage(0, encoding, height, width, step, big_endian, memoryview(bytes(data)))


def encoded(data: np.ndarray | bytes) -> ImageMessage:
    return ImageMessage(0, "png", 0, 0, 0, False, memoryview(bytes(data)))


# ---- messages


@pytest.mark.parametrize("form", RAW)
def test_a_raw_image_of_another_encoder_is_read_with_its_time_and_without_its_padding(form):
    picture = reader(RAW[form][0])(RAW[form][1])
    assert picture[:6] == (7_000_000_500, "mono8", 2, 3, 4, False)
    assert gray(picture).tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize("form", COMPRESSED)
def test_a_compressed_image_of_another_encoder_is_read_with_its_time_and_bytes(form):
    picture = reader(COMPRESSED[form][0])(COMPRESSED[form][1])
    assert (picture.stamp_ns, picture.encoding, picture.height) == (7_000_000_500, "png", 0)
    assert bytes(picture.data) == b"PNGDATA"


def test_a_mono8_frame_is_the_memory_of_its_message_and_cannot_be_written_to():
    message = np.frombuffer(bytes.fromhex(CDR), np.uint8)
    frame = gray(reader(RAW["cdr"][0])(message.tobytes()))
    assert not frame.flags.writeable
    assert np.shares_memory(gray(reader(RAW["cdr"][0])(memoryview(message))), message)


@pytest.mark.parametrize("form", RAW)
def test_a_message_compressed_by_itself_is_the_same_message(form):
    one, message = RAW[form]
    assert gray(reader(one)(zstandard.compress(message))).tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize("form", RAW)
def test_a_message_cut_anywhere_is_unreadable_or_the_same_but_never_a_crash(form):
    one, message = RAW[form]
    read = reader(one)
    for end in range(len(message)):
        try:
            frame = gray(read(message[:end]))
        except UnreadableMessage:
            continue
        assert frame.tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize("form", RAW)
def test_damaged_bytes_in_a_message_never_end_in_anything_but_a_frame_or_an_unreadable_message(form):
    one, message = RAW[form]
    read, rng = reader(one), np.random.default_rng(0)
    for _ in range(300):
        changed = bytearray(message)
        changed[rng.integers(len(message))] ^= 1 << int(rng.integers(8))
        try:
            gray(read(bytes(changed)))
        except UnreadableMessage as error:
            assert "\n" not in str(error)


def test_what_we_write_is_what_another_encoder_writes():
    frame = np.array([[1, 2, 3], [4, 5, 6]], np.uint8)
    wanted = bytes.fromhex(CDR)
    # the other message has rows of four bytes
    assert image(header_of(7_000_000_500, "cam"), frame)[:-14] == wanted[:-16]
    assert image(header_of(7_000_000_500, "cam"), frame)[-14:] == struct.pack("<II", 3, 6) + bytes(
        [1, 2, 3, 4, 5, 6]
    )


def test_a_topic_of_text_is_no_image_topic_and_is_refused_by_its_type():
    text = channel("cdr", "std_msgs/msg/String")
    assert not is_image(text)
    assert not is_image(channel("protobuf", "sensor_msgs/msg/Image"))
    with pytest.raises(
        ValueError,
        match=r"type 'std_msgs/msg/String' in 'cdr' are no images that are read; sensor_msgs Image and "
        r"CompressedImage",
    ):
        reader(text)


# ---- frames


@pytest.mark.parametrize(
    ("encoding", "order"),
    [
        ("rgb8", [0, 1, 2]),
        ("bgr8", [2, 1, 0]),
        ("8UC3", [2, 1, 0]),
        ("rgba8", [0, 1, 2, 3]),
        ("bgra8", [2, 1, 0, 3]),
    ],
)
def test_gray_of_a_colour_image_is_its_luma(encoding, order):
    rgba = np.random.default_rng(0).integers(0, 256, (4, 5, 4), dtype=np.uint8)
    step = 5 * len(order) + 3
    padded = np.zeros((4, step), np.uint8)
    padded[:, : step - 3] = rgba[..., order].reshape(4, -1)
    luma = rgba[..., :3] @ np.array([0.299, 0.587, 0.114])
    # cv2 rounds to whole levels after coefficients of 14 or 15 bits
    np.testing.assert_allclose(gray(rows(encoding, 4, 5, padded, step=step)), luma, atol=0.51)


@pytest.mark.parametrize("big_endian", [False, True])
def test_sixteen_bits_stay_sixteen_bits_in_either_byte_order(big_endian):
    values = np.array([[1, 256, 65535], [515, 0, 40000]], np.uint16)
    frame = gray(
        rows("mono16", 2, 3, values.astype(">u2" if big_endian else "<u2").tobytes(), big_endian=big_endian)
    )
    assert frame.dtype == np.uint16
    np.testing.assert_array_equal(frame, values)
    np.testing.assert_array_equal(gray(encoded(cv2.imencode(".png", values)[1])), values)


def test_gray_of_yuv_is_its_luma_byte():
    data = np.array([[[90, 1], [91, 2], [92, 3], [93, 4]]], np.uint8)
    assert gray(rows("yuv422", 1, 4, data)).tolist() == [[1, 2, 3, 4]]
    assert gray(rows("yuv422_yuy2", 1, 4, data)).tolist() == [[90, 91, 92, 93]]


def test_an_even_gray_surface_behind_a_bayer_filter_is_even_gray():
    for name in ("rggb", "bggr", "gbrg", "grbg"):
        assert np.unique(gray(rows(f"bayer_{name}8", 6, 8, np.full(48, 77, np.uint8)))).tolist() == [77]
    # a red surface: only the red sites see light, and its gray is 0.299 of
    # it; of the wrong pattern it would be blue's 0.114
    red = np.zeros((6, 8), np.uint8)
    red[::2, ::2] = 200
    np.testing.assert_allclose(gray(rows("bayer_rggb8", 6, 8, red))[2:-2, 2:-2], 0.299 * 200, atol=1)


@pytest.mark.parametrize("ending", [".png", ".jpg"])
def test_a_compressed_picture_is_decoded_whole_or_not_at_all(ending):
    frame = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (48, 64), dtype=np.uint8), (0, 0), 2)
    data = cv2.imencode(ending, frame)[1]
    # quality 95 is the default: at most a few levels off on a smooth picture
    np.testing.assert_allclose(gray(encoded(data)).astype(int), frame, atol=0 if ending == ".png" else 4)
    for end in (0, 10, len(data) // 2, len(data) - 3):
        with pytest.raises(UnreadableMessage, match=rf"its {end} bytes of format 'png' are no whole picture"):
            gray(encoded(data[:end]))


@pytest.mark.parametrize(
    ("picture", "reason"),
    [
        (rows("mono8", 2, 3, bytes(5)), "3 x 2 px mono8 in rows of 3 bytes do not go with 5 bytes of data"),
        (
            rows("rgb8", 2, 3, bytes(18), step=8),
            "3 x 2 px rgb8 in rows of 8 bytes do not go with 18 bytes of data",
        ),
        (rows("mono8", -2, 3, bytes(6)), "3 x -2 px"),
        (rows("mono8", 2, 0, bytes(6)), "0 x 2 px"),
        (rows("32FC1", 1, 1, bytes(4)), "the encoding '32FC1' is not read; mono8, mono16"),
    ],
)
def test_a_picture_that_does_not_agree_with_itself_is_refused(picture, reason):
    with pytest.raises(UnreadableMessage) as refusal:
        gray(picture)
    assert reason in str(refusal.value)


def test_the_frames_of_a_viewers_own_test_recording_are_read(shared):
    with shared("data/mcap_ros2/custom-camera-model.mcap").open("rb") as stream:
        frames = [
            gray(
                reader(
                    Channel(
                        of.id, of.topic, of.message_encoding, {}, schema.name, schema.encoding, schema.data
                    )
                )(message.data)
            )
            for schema, of, message in make_reader(stream).iter_messages(topics=["/image/compressed"])
        ]
    assert len(frames) == 10
    assert {frame.shape for frame in frames} == {frames[0].shape}
    assert frames[0].dtype == np.uint8
    assert frames[0].std() > 1
