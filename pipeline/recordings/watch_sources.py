"""Reads the frames of a running camera from a folder that fills with pictures, an MCAP recording that grows,
or snapshots over HTTP.

A source is read again and again and returns what is new. Half-written data is left for the next call. A
broken picture is returned as a frame with the reason. A source that does not exist yet is waited for.
"""

import base64
import contextlib
import hashlib
import http.client
import os
import re
import threading
import time
import urllib.parse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.recordings import images
from pipeline.recordings.images import UNREADABLE, decode, read_image
from pipeline.recordings.mcap_files import GrowingMcap, Message
from pipeline.recordings.messages import Channel, Decode, decoder, fields, plain
from pipeline.recordings.nozzle_frames import Topics

PICTURES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
# an incomplete picture that has not grown for this long is broken
SETTLE_S = 2.0
# pause between two looks at a folder or a recording
LOOK_S = 0.05
# for one snapshot: longest wait in seconds, and most bytes that are read
TIMEOUT_S, LARGEST_PICTURE = 2.0, 32 << 20
COPY = "the frame is a copy of the one before"
# the range of a printer's settings; a number beyond it is no setpoint
PLAUSIBLE = {"flow_percent": (0.0, 1000.0), "temperature_degC": (0.0, 600.0)}


class CameraFrame(NamedTuple):
    """A frame (height, width) uint8 or uint16, or the reason why there is none, at time_s of its source's
    clock. `flow`: percent; `temperature`: degC; `direction_deg`: travel direction in degrees; `tip`: (x, y)
    in px. They are NaN, and print_id is "", if the source does not give them."""

    name: str
    time_s: float
    frame: np.ndarray | str
    flow: float = np.nan
    temperature: float = np.nan
    direction_deg: float = np.nan
    tip: tuple[float, float] = (np.nan, np.nan)
    print_id: str = ""


def source(place: str, topics: Topics, *, rate_hz: float) -> "FrameSource":
    """Returns the source that a path or an address names. Raises ValueError if the address cannot be used, or
    if a file is not a recording."""
    if re.match(r"[a-zA-Z][a-zA-Z0-9+.-]*://", place):
        return Snapshots(place, rate_hz)
    if place.lower().endswith(".mcap") and not Path(place).is_dir():
        return RecordingSource(Path(place), topics)
    if Path(place).is_file():
        raise ValueError(
            f"{place}: expected a folder of pictures, a recording (.mcap) or an address, found another file; "
            "name the folder that it is in"
        )
    return Folder(Path(place))


def display_name(place: str) -> str:
    """Returns a source's name to show: an address without user and password."""
    return _without_secret(urllib.parse.urlsplit(place)) if "://" in place else place


# ---- a folder that fills


class Folder:
    """Pictures of a folder in the order in which they were written. A file is read once, as soon as it is
    whole."""

    def __init__(self, path: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self.path, self.clock, self.rest_s = path, clock, LOOK_S
        self.lacks = f"a picture ({', '.join(PICTURES)})"
        self.waits_for, self.ended = f"the folder {path} is not there yet", False
        self.done: set[str] = set()
        self.unfinished: dict[str, tuple[int, float]] = {}
        self.before = b""

    def frames(self) -> Iterator[CameraFrame]:
        if not self.path.is_dir():
            self.waits_for = f"the folder {self.path} is not there yet"
            return
        self.waits_for = ""
        came = sorted(self._new(), key=lambda entry: (entry[1], _number_key(entry[0])))
        for name, written_ns, size in came:
            frame = self._picture(name, written_ns / 1e9, size)
            if frame is not None:
                self.done.add(name)
                self.unfinished.pop(name, None)
                yield frame
        self.ended = not self.unfinished

    def _new(self) -> Iterator[tuple[str, int, int]]:
        """Yields (name relative to the folder, time when it was written in ns, bytes) of pictures not yet
        read."""
        began = time.monotonic()
        for root, folders, names in os.walk(self.path):
            folders[:] = [name for name in folders if not name.startswith(".")]
            below = os.path.relpath(root, self.path)
            for name in names:
                inside = name if below == "." else f"{below}/{name}"
                if name.startswith(".") or not name.lower().endswith(PICTURES) or inside in self.done:
                    continue
                with contextlib.suppress(OSError):  # a camera may remove its oldest
                    about = os.stat(os.path.join(root, name))
                    yield inside, about.st_mtime_ns, about.st_size
        # a folder with very many files is searched less often
        self.rest_s = max(LOOK_S, 5 * (time.monotonic() - began))

    def _picture(self, name: str, time_s: float, size: int) -> CameraFrame | None:
        """Returns the frame of a picture, None if the file is still being written."""
        path = self.path / name
        try:
            data = path.read_bytes()
            if not _has_end(data):
                raise ValueError(f"found a picture of {len(data)} bytes without its end")
            frame, digest = read_image(path), hashlib.blake2b(data, digest_size=16).digest()
        except FileNotFoundError:
            return CameraFrame(name, time_s, f"{UNREADABLE}: it was removed")
        except (OSError, ValueError) as error:
            previous = self.unfinished.get(name, (-1, 0.0))
            if previous[0] != size:
                self.unfinished[name] = (size, self.clock())
                return None
            if self.clock() - previous[1] < SETTLE_S:
                return None
            return CameraFrame(name, time_s, f"{UNREADABLE}: {str(error).partition('found ')[2] or error}")
        copy, self.before = digest == self.before, digest
        return CameraFrame(name, time_s, COPY if copy else frame)


def _number_key(name: str) -> list:
    """Returns a sort key that puts image-9 before image-10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def _has_end(data: bytes) -> bool:
    """Returns whether a JPEG or PNG has its end mark. Other formats are left to the decoder."""
    if data.startswith(b"\xff\xd8"):
        return data.rfind(b"\xff\xd9", max(0, len(data) - 4096)) > 0
    return b"IEND" in data[-64:] if data.startswith(b"\x89PNG") else bool(data)


# ---- a recording that grows


class RecordingSource:
    """Frames of the image topic, with the setpoints that applied when they were taken."""

    def __init__(self, path: Path, where: Topics) -> None:
        self.path, self.where, self.rest_s = path, where, LOOK_S
        self.file, self.ended = GrowingMcap(path), False
        self.waits_for = f"the recording {path} is not there yet"
        self.sources = where.sources()
        self.signals: dict[str, float] = {}
        self.decoders: dict[int, tuple[list[str], Decode] | None] = {}
        self.reads: dict[int, images.Read] = {}
        self.camera, self.others = where.image, set()
        self.before, self.count, self.others_held = b"", 0, set()

    @property
    def lacks(self) -> str:
        """What the recording lacks, in words: a topic with images; and the topics that it has."""
        topics = sorted(self.others_held)
        named = f"{', '.join(topics[:5])}{', ...' if len(topics) > 5 else ''}" if topics else "no messages"
        return f"a topic with images; it holds {named}"

    @property
    def damage(self) -> list[str]:
        return self.file.damage

    def frames(self) -> Iterator[CameraFrame]:
        try:
            for message in self.file.messages(lambda channel: True):
                if not images.is_image(message.channel):
                    self.others_held.add(message.channel.topic)
                    self._hold(message)
                elif self._is_camera(message.channel):
                    yield self._frame(message)
            self.waits_for, self.ended = "", self.file.ended
        except (FileNotFoundError, IsADirectoryError):
            self.waits_for = f"the recording {self.path} is not there yet"
        except OSError as error:
            self.waits_for = f"{self.path} cannot be read ({error.strerror})"

    def _is_camera(self, channel: Channel) -> bool:
        """Returns whether the channel is on the image topic: that of the settings, or else the first with
        images. Another image topic is reported once."""
        self.camera = self.camera or channel.topic
        if channel.topic != self.camera and channel.topic not in self.others:
            self.others.add(channel.topic)
            self.file.damage.append(
                f"{self.path}: {channel.topic} holds images too and is not looked at; {self.camera} is "
                "(train_classifier.topics.image)"
            )
        return channel.topic == self.camera

    def _frame(self, message: Message) -> CameraFrame:
        self.count += 1
        name, stamp = f"{self.camera} {self.count}", message.log_time
        try:
            if message.channel.id not in self.reads:
                self.reads[message.channel.id] = images.reader(message.channel)
            picture = self.reads[message.channel.id](message.data)
            if self.where.time == "publish_time":
                stamp = message.publish_time
            elif self.where.time not in ("", "log_time"):
                stamp = picture.stamp_ns
            frame, self.before = _new_frame(picture.data, self.before, lambda: images.gray(picture))
        except ValueError as error:
            frame = f"{UNREADABLE}: {error}"
        number = self.signals.get("print_id", np.nan)
        flow, temperature, direction, x, y = (
            self.signals.get(name, np.nan)
            for name in ("flow_percent", "temperature_degC", "travel_direction_deg", "tip_x_px", "tip_y_px")
        )
        print_id = f"{number:g}" if np.isfinite(number) else ""
        return CameraFrame(name, stamp / 1e9, frame, flow, temperature, direction, (x, y), print_id)

    def _hold(self, message: Message) -> None:
        """Keeps the values of our signals in a message."""
        number = message.channel.id
        if number not in self.decoders:
            self.decoders[number] = self._decoder(message)
        if (reader := self.decoders[number]) is None:
            return
        names, decode = reader
        try:
            values = decode([plain(message.data)])[0]
        except ValueError:
            self.file.damage.append(f"{self.path}: a message of {message.channel.topic} cannot be read")
            return
        for name, value in zip(names, values, strict=True):
            at = self.sources[name]
            value = float(value) * at.scale + at.offset
            low, high = PLAUSIBLE.get(name, (-np.inf, np.inf))
            if np.isfinite(value) and low <= value <= high:
                self.signals[name] = value

    def _decoder(self, message: Message) -> tuple[list[str], Decode] | None:
        """Returns our signals in a channel, and the function that decodes them; None if it has none."""
        channel = message.channel
        try:
            names = set(fields(channel, [message.data]))
            places = {
                name: field
                for name, at in self.sources.items()
                for topic, colon, field in [at.source.rpartition(":")]
                if field in names and (not colon or topic == channel.topic)
            }
            return (list(places), decoder(channel, list(places.values()))) if places else None
        except (ValueError, RecursionError):
            return None


# ---- snapshots over HTTP


class Snapshots:
    """A picture for each request. Only the given address is requested, without a proxy."""

    def __init__(self, address: str, rate_hz: float) -> None:
        parts = urllib.parse.urlsplit(address)
        try:
            port = parts.port
        except ValueError:
            port = -1
        if parts.scheme not in ("http", "https") or not parts.hostname or port == -1:
            raise ValueError(
                f"{_without_secret(parts)}: expected the address of a snapshot such as "
                "http://127.0.0.1:8080/?action=snapshot, found another; look it up in the camera's settings"
            )
        self.shown, self.parts, self.port = _without_secret(parts), parts, port
        self.headers = {"User-Agent": "beadline", "Connection": "close"}
        if parts.username is not None:
            pair = f"{urllib.parse.unquote(parts.username)}:{urllib.parse.unquote(parts.password or '')}"
            self.headers["Authorization"] = f"Basic {base64.b64encode(pair.encode()).decode()}"
        self.period_s, self.rest_s, self.ended = 1 / rate_hz, 0.0, False
        self.waits_for, self.lacks = f"{self.shown} has not answered yet", "a picture"
        self.count, self.before = 0, b""

    def frames(self) -> Iterator[CameraFrame]:
        """Yields one picture, or none if the camera does not answer. The rate sets the time between
        pictures."""
        began = time.monotonic()
        try:
            data = self._answer()
            self.count += 1
            frame, self.before = _new_frame(data, self.before, lambda: _decode(data))
            self.waits_for = ""
            yield CameraFrame(f"snapshot {self.count}", time.time(), frame)
        except (OSError, http.client.HTTPException) as error:
            self.waits_for = f"{self.shown} does not answer with a picture ({error or type(error).__name__})"
        self.rest_s = max(0.0, self.period_s - (time.monotonic() - began))

    def _answer(self) -> bytes:
        """Returns the bytes of one answer, whole. The connection is closed if the camera answers too slowly,
        in its headers too."""
        kinds = {"http": http.client.HTTPConnection, "https": http.client.HTTPSConnection}
        connection = kinds[self.parts.scheme](self.parts.hostname or "", self.port, timeout=TIMEOUT_S)
        late = threading.Event()

        def hang_up() -> None:
            late.set()
            with contextlib.suppress(OSError):  # the camera may have done so
                line.shutdown(2)  # in both directions

        connection.connect()
        line = connection.sock
        # the timeout of the connection is that of one packet, and comes first
        alarm = threading.Timer(1.2 * TIMEOUT_S, hang_up)
        alarm.start()
        try:
            address = self.parts._replace(scheme="", netloc="", fragment="", path=self.parts.path or "/")
            connection.request("GET", address.geturl(), headers=self.headers)
            return _read_picture(connection.getresponse())
        finally:
            alarm.cancel()
            connection.close()
            if late.is_set():
                raise TimeoutError(f"its answer took more than {TIMEOUT_S:g} s")


def _read_picture(answer: http.client.HTTPResponse) -> bytes:
    """Returns the picture of an answer. Raises OSError with the reason if it has none, or not a whole one."""
    kind = answer.headers.get_content_type()
    data = b"" if kind.startswith("multipart/") else answer.read(LARGEST_PICTURE + 1)
    problems = (
        (answer.status // 100 != 2, f"it says {answer.status} {answer.reason}"),
        (kind.startswith("multipart/"), "it is a stream of pictures; name the address of a single one"),
        (
            kind.startswith("text/") and "Content-Type" in answer.headers,
            f"it shows {kind}, no picture; name the address of a snapshot",
        ),
        (len(data) > LARGEST_PICTURE, f"its answer is longer than {LARGEST_PICTURE >> 20} MB"),
        (answer.length, f"its answer broke off {answer.length} bytes before its end"),
        (not data, "its answer is empty"),
    )
    for is_so, problem in problems:
        if is_so:
            raise OSError(problem)
    return data


def _decode(data: bytes) -> np.ndarray:
    if not _has_end(data):
        raise ValueError(f"a picture of {len(data)} bytes without its end")
    return decode(data)


def _new_frame(
    content: bytes | memoryview, previous: bytes, decode: Callable[[], np.ndarray]
) -> tuple[np.ndarray | str, bytes]:
    """Returns the decoded frame, or the reason why there is none, and the digest of its content. `previous`:
    digest of the previous frame."""
    digest = hashlib.blake2b(content, digest_size=16).digest()
    try:
        return COPY if digest == previous else decode(), digest
    except ValueError as error:
        return f"{UNREADABLE}: {error}", digest


def _without_secret(parts: urllib.parse.SplitResult) -> str:
    """Returns an address to show: no user, no password."""
    return parts._replace(netloc=parts.netloc.rpartition("@")[2]).geturl()


# `frames` yields the new frames since the last call; `waits_for`: why no frame can come, "" if one may;
# `lacks`: what an existing source does not contain; `ended`: nothing more will come; `rest_s`: how long to
# wait before the next call
FrameSource = Folder | RecordingSource | Snapshots
