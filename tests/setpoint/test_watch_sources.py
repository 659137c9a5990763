"""Sources of a watch: folders that fill, recordings that grow, cameras over HTTP that fail."""

import contextlib
import http.server
import os
import re
import socket
import socketserver
import threading
import time

import cv2
import numpy as np
import pytest

from pipeline.recordings import watch_sources
from pipeline.recordings.mcap_files import GrowingMcap
from pipeline.recordings.nozzle_frames import Topics
from pipeline.recordings.watch_sources import COPY, Folder, RecordingSource, Snapshots, display_name, source
from tests.mcap_writing import LZ4, NO, ZSTD, Written, chunks
from tests.nozzle_folders import ANY


def picture(seed: int, ending: str = ".jpg", shape=(60, 80)) -> bytes:
    noise = np.random.default_rng(seed).integers(0, 256, shape, np.uint8)
    return cv2.imencode(ending, cv2.GaussianBlur(noise, (0, 0), 2))[1].tobytes()


def reasons(shown) -> list[str]:
    return ["" if isinstance(one.frame, np.ndarray) else one.frame for one in shown]


# ---- folders


def test_pictures_come_once_in_the_order_in_which_they_were_written(tmp_path):
    for k, name in enumerate(["b-9.jpg", "b-10.png", "a.bmp", ".hidden.jpg", "notes.txt", "x.tmp"]):
        (tmp_path / name).write_bytes(picture(k, f".{name.rpartition('.')[2]}") if k < 3 else b"x")
        os.utime(tmp_path / name, ns=(10**18, 10**18 + (k > 1) * 10**9))
    here = Folder(tmp_path)
    shown = list(here.frames())
    assert [one.name for one in shown] == ["b-9.jpg", "b-10.png", "a.bmp"]
    assert [one.time_s for one in shown] == [1e9, 1e9, 1e9 + 1]
    assert reasons(shown) == ["", "", ""]
    assert list(here.frames()) == []
    assert here.ended


@pytest.mark.parametrize("ending", [".jpg", ".png", ".bmp"])
def test_a_picture_that_is_half_written_is_waited_for_and_then_taken_whole(tmp_path, ending):
    now, data = [0.0], picture(1, ending)
    here = Folder(tmp_path, clock=lambda: now[0])
    for part in (0, len(data) // 3, len(data) - 3):
        (tmp_path / f"a{ending}").write_bytes(data[:part])
        now[0] += 1.5
        assert list(here.frames()) == []
        assert not here.ended
    (tmp_path / f"a{ending}").write_bytes(data)
    assert reasons(here.frames()) == [""]


def test_a_broken_picture_is_told_once_it_grows_no_more(tmp_path):
    now = [0.0]
    here = Folder(tmp_path, clock=lambda: now[0])
    (tmp_path / "a.jpg").write_bytes(picture(1)[:-200])
    (tmp_path / "b.png").write_text("no picture")
    (tmp_path / "c.jpg").write_bytes(picture(2))
    assert [one.name for one in here.frames()] == ["c.jpg"]
    now[0] = 1.0
    assert list(here.frames()) == []
    now[0] = 2.5
    broken = sorted(here.frames())
    assert [one.name for one in broken] == ["a.jpg", "b.png"]
    assert all(reason.startswith("the image cannot be read: ") for reason in reasons(broken))
    now[0] = 9.0
    assert list(here.frames()) == []


def test_a_camera_that_stands_still_shows_copies(tmp_path):
    for k in range(3):
        (tmp_path / f"{k}.jpg").write_bytes(picture(1))
        os.utime(tmp_path / f"{k}.jpg", (k, k))
    assert reasons(Folder(tmp_path).frames()) == ["", COPY, COPY]


def test_a_folder_that_is_not_there_is_waited_for(tmp_path):
    here = Folder(tmp_path / "new")
    assert list(here.frames()) == []
    assert "is not there yet" in here.waits_for
    (tmp_path / "new/below").mkdir(parents=True)
    (tmp_path / "new/below/a.jpg").write_bytes(picture(1))
    assert [one.name for one in here.frames()] == ["below/a.jpg"]
    assert here.waits_for == ""


# ---- recordings


def recording(count: int, compression=ZSTD, **options) -> bytes:
    """Frames at 10 Hz on /cam in JSON, and setpoints that move at frame 5."""
    import base64

    made = Written(compression, **options)
    camera = made.topic("/cam", "json", "foxglove.CompressedImage", "jsonschema", b"{}")
    told = made.topic("/set", "json")
    for k in range(count):
        if k % 5 == 0:
            made.message(told, k / 10, {"flow_percent": 80.0 + 4 * k, "temperature_degC": 200, "tip_x_px": 40,
                                        "tip_y_px": 30})  # fmt: skip
        made.message(camera, k / 10, {
            "timestamp": {"sec": 0, "nsec": k}, "frame_id": "", "format": "png",
            "data": base64.b64encode(picture(k, ".png")).decode(),
        })  # fmt: skip
    return made.bytes()


@pytest.mark.parametrize("compression", [NO, ZSTD, LZ4])
def test_a_recording_is_read_as_it_grows_however_it_is_cut(tmp_path, compression):
    content = recording(20, compression, chunk_size=20_000)
    path, shown = tmp_path / "a.mcap", []
    here = RecordingSource(path, ANY)
    assert list(here.frames()) == []
    assert "is not there yet" in here.waits_for
    before_the_end = 0
    for end in range(0, len(content) + 1777, 1777):
        path.write_bytes(content[:end])
        shown += here.frames()
        before_the_end = len(shown) if end < len(content) * 0.9 else before_the_end
    assert before_the_end > 10
    assert here.ended and here.damage == []
    assert [one.time_s for one in shown] == [k / 10 for k in range(20)]
    assert [one.flow for one in shown] == [80.0] * 5 + [100.0] * 5 + [120.0] * 5 + [140.0] * 5
    assert {(one.temperature, one.tip) for one in shown} == {(200.0, (40.0, 30.0))}
    assert all((one.frame == cv2.imdecode(np.frombuffer(picture(k, ".png"), np.uint8), 0)).all()
               for k, one in enumerate(shown))  # fmt: skip


def test_room_that_is_not_filled_yet_is_waited_for(tmp_path):
    content = recording(10, NO)
    half = chunks(content)[0][2]
    (tmp_path / "a.mcap").write_bytes(content[:half] + bytes(5000))
    here = RecordingSource(tmp_path / "a.mcap", ANY)
    assert len(list(here.frames())) == 10
    assert not here.ended and here.damage == []
    (tmp_path / "a.mcap").write_bytes(content)
    assert list(here.frames()) == []
    assert here.ended


@pytest.mark.parametrize("compression", [NO, ZSTD])
def test_a_damaged_chunk_is_left_out_and_told(tmp_path, compression):
    content = bytearray(recording(40, compression, chunk_size=20_000))
    places = chunks(bytes(content))
    content[(places[1][1] + places[1][2]) // 2] ^= 1
    (tmp_path / "a.mcap").write_bytes(content)
    here = RecordingSource(tmp_path / "a.mcap", ANY)
    shown = list(here.frames())
    assert 20 < len(shown) < 40 and here.ended
    assert len(here.damage) == 1 and "was left out" in here.damage[0]


def test_a_length_that_is_garbled_costs_a_chunk_not_the_watch(tmp_path):
    content = bytearray(recording(40, ZSTD, chunk_size=20_000))
    start = chunks(bytes(content))[1][0]
    content[start + 7] = 0x7F
    (tmp_path / "a.mcap").write_bytes(content)
    here = RecordingSource(tmp_path / "a.mcap", ANY)
    assert 20 < len(list(here.frames())) < 40
    assert "is more than the 536870912 bytes" in here.damage[0]


def test_a_recording_that_is_begun_anew_is_read_anew(tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(recording(20))
    here = RecordingSource(path, ANY)
    assert len(list(here.frames())) == 20
    path.write_bytes(recording(5))
    assert len(list(here.frames())) == 5
    assert "begun anew" in here.damage[0]


def test_what_is_no_recording_is_refused(tmp_path):
    (tmp_path / "a.mcap").write_text("t_s,u\n1,2\n")
    with pytest.raises(ValueError, match=r"a.mcap: the bytes at offset 0 should be MCAP's"):
        list(RecordingSource(tmp_path / "a.mcap", ANY).frames())


def test_of_two_cameras_one_is_looked_at(tmp_path):
    made = Written(ZSTD)
    for name in ("/cam", "/bed"):
        channel = made.topic(name, "json", "foxglove.CompressedImage", "jsonschema", b"{}")
        made.message(channel, 1.0, {"timestamp": {"sec": 0, "nsec": 0}, "format": "png", "data": ""})
    (tmp_path / "a.mcap").write_bytes(made.bytes())
    here = RecordingSource(tmp_path / "a.mcap", Topics("/bed", "", {}))
    assert [one.name for one in here.frames()] == ["/bed 1"]
    assert "/cam holds images too" in here.damage[0]


def test_a_number_that_no_printer_is_told_is_no_setpoint(tmp_path):
    made = Written(ZSTD)
    told, camera = (
        made.topic("/set", "json"),
        made.topic("/cam", "json", "foxglove.CompressedImage", "jsonschema", b"{}"),
    )
    made.message(told, 1.0, {"flow_percent": 90, "temperature_degC": 210})
    made.message(told, 1.1, {"flow_percent": -5, "temperature_degC": 1e9})
    made.message(told, 1.2, b"{")
    made.message(camera, 2.0, {"timestamp": {"sec": 0, "nsec": 0}, "format": "png", "data": "!"})
    (tmp_path / "a.mcap").write_bytes(made.bytes())
    here = RecordingSource(tmp_path / "a.mcap", ANY)
    (shown,) = here.frames()
    assert (shown.flow, shown.temperature) == (90.0, 210.0)
    assert shown.frame.startswith("the image cannot be read: ")
    assert "a message of /set cannot be read" in here.damage[0]


def test_a_chunk_inside_a_chunk_ends(tmp_path):
    whole = recording(5, NO)
    begin, data, end = chunks(whole)[0]
    record = whole[begin:end]
    inner = record * 2
    head = whole[begin + 9 : data - 8]
    body = bytearray(head) + len(inner).to_bytes(8, "little") + inner
    body[16:24], body[24:28] = len(inner).to_bytes(8, "little"), bytes(4)
    nested = b"\x06" + len(body).to_bytes(8, "little") + bytes(body)
    (tmp_path / "a.mcap").write_bytes(whole[:begin] + nested)
    file = GrowingMcap(tmp_path / "a.mcap")
    assert list(file.messages(lambda channel: True)) == []


# ---- snapshots


@pytest.fixture
def guard(monkeypatch):
    """Every address that anything connects to or looks up."""
    asked: list = []
    for name in ("connect", "connect_ex", "sendto"):
        real = getattr(socket.socket, name)

        def tell(self, *arguments, real=real, **named):
            asked.append(arguments[-1])
            return real(self, *arguments, **named)

        monkeypatch.setattr(socket.socket, name, tell)
    real_look_up = socket.getaddrinfo

    def look_up(host, *arguments, **named):
        asked.append((host,))
        return real_look_up(host, *arguments, **named)

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    monkeypatch.setenv("http_proxy", "http://192.0.2.1:9")
    monkeypatch.setenv("HTTP_PROXY", "http://192.0.2.1:9")
    return asked


@pytest.fixture
def camera():
    """A camera whose answers are `script`, one a request: (status, headers, body, bytes promised,
    seconds)."""

    class Answer(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.server.asked.append(f"{self.command} {self.path} {self.headers.get('Authorization', '')}")
            status, headers, body, promised, seconds = self.server.script.pop(0)
            time.sleep(seconds)
            if status == 0:  # hangs up
                self.close_connection = True
                return
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(body) if promised is None else promised))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *arguments):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Answer)
    server.daemon_threads = True
    server.asked, server.script = [], []
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield server
    server.shutdown()
    server.server_close()


def said(body=b"", status=200, headers=None, promised=None, seconds=0.0):
    return (status, headers or {"Content-Type": "image/jpeg"}, body, promised, seconds)


def test_a_camera_that_fails_in_the_middle_is_asked_again_and_nobody_else_is(camera, guard, monkeypatch):
    monkeypatch.setattr(watch_sources, "TIMEOUT_S", 0.3)
    monkeypatch.setattr(watch_sources, "LARGEST_PICTURE", 1 << 20)
    away = {"Location": "http://192.0.2.7/elsewhere", "Content-Type": "text/html"}
    camera.script[:] = [
        said(picture(0)), said(b"", 404), said(b"", 503), said(picture(1), seconds=0.8), said(status=0),
        said(picture(2)[:-99], promised=len(picture(2))), said(b"", 302, away), said(b"<html>", 200),
        said(b"", 200), said(b"x" * (2 << 20)),
        said(b"--", 200, {"Content-Type": "multipart/x-mixed-replace"}),
        said(picture(2)[:-99]), said(picture(3)), said(picture(3)), said(picture(4)),
    ]  # fmt: skip
    here = Snapshots(f"http://me:secret@127.0.0.1:{camera.server_port}/?action=snapshot#a", 50.0)
    states, shown = [], []
    for _ in range(len(camera.script)):
        shown += here.frames()
        states.append(here.waits_for)
    whole = [isinstance(one.frame, np.ndarray) for one in shown]
    assert whole == [True, False, False, True, False, True]
    assert reasons(shown)[4] == COPY
    told = ("404", "503", "timed out", "closed connection", "(IncompleteRead|broke off)", "302")
    for state, words in zip(states[1:7], told, strict=True):
        assert re.search(f"(does not answer|answers) .*{words}", state)
    assert "longer than 1 MB" in states[9] and "is a stream of pictures" in states[10]
    assert "secret" not in "".join(states) and here.waits_for == ""
    assert {line.split()[0] for line in camera.asked} == {"GET"}
    assert camera.asked[0] == "GET /?action=snapshot Basic bWU6c2VjcmV0"
    assert {address[0] for address in guard if isinstance(address, tuple)} <= {"127.0.0.1"}
    assert guard, "the guard sees connections"


@pytest.mark.parametrize(
    ("at_once", "drop"),
    [(b"", b"H"), (b"HTTP/1.1 200 OK\r\nX-A: ", b"a"), (b"HTTP/1.1 200 OK\r\n\r\n", b"x")],
)
@pytest.mark.usefixtures("must_end")
def test_a_camera_that_drips_is_given_up(monkeypatch, at_once, drop):
    """In the line of its status, in its headers, or in its picture."""
    monkeypatch.setattr(watch_sources, "TIMEOUT_S", 0.3)
    ended = threading.Event()

    class Drip(socketserver.BaseRequestHandler):
        def handle(self):
            with contextlib.suppress(OSError):
                self.request.sendall(at_once)
                while not ended.wait(0.05):
                    self.request.sendall(drop)

    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Drip) as server:
        server.daemon_threads = True
        threading.Thread(target=server.serve_forever, daemon=True).start()
        here = Snapshots(f"http://127.0.0.1:{server.server_address[1]}/", 5.0)
        assert list(here.frames()) == []
        ended.set()
        server.shutdown()
    assert "took more than 0.3 s" in here.waits_for


def test_a_page_in_place_of_a_picture_and_an_empty_answer_are_told(camera):
    html = {"Content-Type": "text/html; charset=utf-8"}
    camera.script[:] = [said(b"<html>log in", 200, html), said(b""), said(picture(0))]
    here = Snapshots(f"http://127.0.0.1:{camera.server_port}/", 50.0)
    assert list(here.frames()) == []
    assert "it shows text/html, no picture; name the address of a snapshot" in here.waits_for
    assert list(here.frames()) == [] and "its answer is empty" in here.waits_for
    assert len(list(here.frames())) == 1 and here.waits_for == ""


def test_nobody_at_the_address_is_waited_for():
    here = Snapshots("http://127.0.0.1:9/", 5.0)
    assert list(here.frames()) == []
    assert "http://127.0.0.1:9/ does not answer" in here.waits_for


@pytest.mark.parametrize(
    "place", ["ftp://a/b", "http://", "http://a:b/", "file:///etc/passwd", "rtsp://u:p@c/"]
)
def test_an_address_that_is_none_is_refused_without_its_secret(place):
    with pytest.raises(ValueError, match="expected the address of a snapshot") as refused:
        source(place, ANY, rate_hz=5.0)
    assert "u:p" not in str(refused.value)


def test_a_file_that_is_no_recording_is_refused(tmp_path):
    (tmp_path / "a.png").write_bytes(picture(0, ".png"))
    with pytest.raises(ValueError, match=r"a.png: expected a folder of pictures.* found another file; name"):
        source(str(tmp_path / "a.png"), ANY, rate_hz=5.0)
    (tmp_path / "of.mcap").mkdir()
    assert isinstance(source(str(tmp_path / "of.mcap"), ANY, rate_hz=5.0), Folder)


def test_the_kind_of_a_source_is_told_by_its_name(tmp_path):
    assert isinstance(source("http://127.0.0.1/", ANY, rate_hz=5.0), Snapshots)
    assert isinstance(source(str(tmp_path / "A.MCAP"), ANY, rate_hz=5.0), RecordingSource)
    assert isinstance(source(str(tmp_path), ANY, rate_hz=5.0), Folder)
    assert display_name("http://me:secret@cam/a?b") == "http://cam/a?b"
    assert display_name("C:/a") == "C:/a"
