"""`beadline shadow`: what it decides, what it writes, and how it ends. The reader of key areas is a rule on
the bead's width, none of ours."""

import ast
import errno
import json
import os
import re
import signal
import subprocess
import sys
import textwrap
import time
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from pipeline.commands import shadow
from pipeline.commands.shadow import decision_log
from pipeline.commands.shadow.decide import DeployedLoop, WatchOptions
from pipeline.commands.shadow.windows import FrameWindows
from pipeline.recordings import watch_sources
from pipeline.recordings.watch_sources import CameraFrame, Folder, RecordingSource
from pipeline.setpoint.agents import flow_filter
from pipeline.setpoint.deployment import deployment
from pipeline.setpoint.frames import familiar
from pipeline.setpoint.material import PLA, PrintedMaterial
from pipeline.setpoint.simulation import actuation
from pipeline.setpoint.vision.calibrated_classifier import FrameReadings
from pipeline.setpoint.vision.proof import CameraProof
from pipeline.setpoint.vision.window_flow import KNOTS_PERCENT, FlowCalibration, window_flow
from pipeline.store import artifacts
from tests.nozzle_folders import ANY
from tests.setpoint.test_flow_filter import fitted

ROOT = Path(__file__).resolve().parents[2]
GIF = Path("/work/shared/data/fast_caxton_frames/nozzle_video.gif")
TIP, FRAMES = (120.0, 90.0), 8
MEASURES = len(familiar.NAMES)
# to which every picture is familiar
ANY_CAMERA = familiar.KnownCamera(
    np.zeros(MEASURES), np.ones(MEASURES), np.eye(MEASURES), np.full(100, 1e300)
)
PROVEN = CameraProof(0.9, 0.8, 0.6, 400, 40, 400, False)


def picture(seed: int, half_width: float = 9.0) -> np.ndarray:
    """A nozzle above a bright line to the right of the tip, on noise."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:180, :240].astype(float)
    line = 140 * (np.abs(y - TIP[1]) < half_width) * (x > TIP[0])
    nozzle = 50 * ((np.abs(x - TIP[0]) < (TIP[1] - y) * 0.6 + 4) & (y < TIP[1] - 2))
    return np.clip(40 + line + nozzle + 6 * rng.standard_normal(y.shape), 0, 255).astype(np.uint8)


def by_width(images: np.ndarray, temperature: np.ndarray) -> FrameReadings:
    """Flow by the rows of the key area that the line fills; never foreign."""
    rows = (images.mean(axis=2) > 180).sum(axis=1)
    named = np.where(rows < 7, 0, np.where(rows > 13, 2, 1))
    prob = np.where(named[:, None] == np.arange(3), 0.9, 0.05)
    # what moves between any two pictures, so that a window is none that stands still
    log_flow = np.log(np.maximum(rows, 1) / 9.0) + 1e-4 * images.mean(axis=(1, 2))
    return FrameReadings(prob, np.zeros(len(rows)), log_flow, np.full(len(rows), 0.08))


def deployed(**changes) -> DeployedLoop:
    costs = {"move_cost": 0.2, "move_fixed_cost": 0.0, "outside_cost": 2.0, "border_std": 1.0}
    parameters = fitted(accuracy=0.8, hazard=0.02, known_start_share=0.0, **costs)
    limits = actuation.SetpointLimits(
        np.array([20.0, 180.0]), np.array([310.0, 240.0]), np.array([10.0, 20.0]), np.array([40.0, 40.0])
    )

    def judge(*window, flows):
        return deployment.judge_window(*window, flows=flows, least_frames=4, foreign_above=9.0)

    knots = np.log(np.array(KNOTS_PERCENT) / 100)
    made = DeployedLoop(
        read=by_width,
        window_flow=partial(window_flow, fitted=FlowCalibration(knots, np.ones(len(knots)), 0.5)),
        known=ANY_CAMERA,
        proof=PROVEN,
        name="Bayes",
        controller=flow_filter.flow_filter(2, 9),
        parameters=parameters,
        window=FRAMES,
        least_score=10.0,
        judge=judge,
        limits=limits,
        settle_s=0.5,
        tip_tolerance_px=8.0,
    )
    return made._replace(**changes)


ASKED = WatchOptions(flow=100.0, temperature=210.0, tip=TIP, once=True)


def fill(folder: Path, pictures, *, period_s: float = 0.05, begin: int = 0) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for k, one in enumerate(pictures, begin):
        path = folder / f"f{k}.png"
        path.write_bytes(one if isinstance(one, bytes) else cv2.imencode(".png", one)[1].tobytes())
        os.utime(path, ns=(int(1e18 + k * period_s * 1e9),) * 2)


def rows(out: Path) -> list[dict]:
    found = []
    for path in sorted(out.glob("decisions-*.mcap")):
        with path.open("rb") as stream:
            found += [json.loads(message.data) for _, _, message in make_reader(stream).iter_messages()]
    return found


def watch(
    source, out: Path, *, asked: WatchOptions = ASKED, deployed_as: DeployedLoop | None = None, stopped=None
):
    late = time.monotonic() + 300
    return shadow.watch(
        source, deployed_as or deployed(), asked, out, place="the camera",
        stopped=stopped or (lambda: time.monotonic() > late),
    )  # fmt: skip


# ---- what it decides


def test_a_thin_line_asks_for_more_and_a_broad_one_for_less(tmp_path):
    for name, half_width, sign in (("thin", 2.0, 1), ("good", 6.0, 0), ("broad", 9.5, -1)):
        fill(tmp_path / name, [picture(k, half_width) for k in range(3 * FRAMES)])
        watched = watch(Folder(tmp_path / name), tmp_path / f"out {name}")
        last = rows(tmp_path / f"out {name}")[-1]
        assert (watched.decisions, watched.changes, watched.held, last["reason"]) == (
            3,
            3 * abs(sign),
            0,
            "acts",
        )
        assert np.sign(last["would_flow_move_percent"]) == sign
        assert (last["valid"], last["used"]) == (FRAMES, FRAMES)
        low, median, high = (last[f"belief_{key}_percent"] for key in ("low", "flow", "high"))
        assert low < median < high


def test_each_window_names_its_frames_and_why_one_does_not_count(tmp_path):
    pictures = [picture(k) for k in range(FRAMES)]
    pictures[5], pictures[7] = np.full((180, 240), 90, np.uint8), b"\x89PNG broken"
    fill(tmp_path / "in", pictures)
    watch(Folder(tmp_path / "in", clock=lambda: 1000 * time.monotonic()), tmp_path / "out")
    (row,) = rows(tmp_path / "out")
    reasons = {frame["name"]: frame["reason"] for frame in row["frames"]}
    assert list(reasons) == [f"f{k}.png" for k in range(FRAMES)]
    assert reasons["f5.png"].startswith("no fresh line") and "cannot be read" in reasons["f7.png"]
    assert sum(not reason for reason in reasons.values()) == row["valid"] == FRAMES - 2


def test_what_is_foreign_stands_still_or_moved_is_held_with_the_reason(tmp_path):
    def foreign(images, temperature):
        return by_width(images, temperature)._replace(distance=np.full(len(images), 99.0))

    fill(tmp_path / "a", [picture(k) for k in range(FRAMES)])
    watch(Folder(tmp_path / "a"), tmp_path / "out a", deployed_as=deployed(read=foreign))
    fill(tmp_path / "b", [picture(0)] * FRAMES)
    watch(Folder(tmp_path / "b"), tmp_path / "out b")
    shifted = [np.roll(picture(k), (0, 14), (0, 1)) for k in range(FRAMES, 2 * FRAMES)]
    fill(tmp_path / "c", [*(picture(k) for k in range(FRAMES)), *shifted])
    no_move = deployed()
    watch(Folder(tmp_path / "c"), tmp_path / "out c", deployed_as=no_move)
    said = [rows(tmp_path / f"out {name}")[-1] for name in "abc"]
    assert [row["reason"] for row in said[:2]] == ["out of distribution", "too few valid frames"]
    assert all(row["would"] == "hold" and row["would_flow_move_percent"] == 0 for row in said[:2])
    assert said[2]["reason"] in ("tip moved", "acts")


def test_the_controller_is_told_what_the_print_did_and_never_more(tmp_path):
    """Where the recording's setpoint moves, the window of both is dropped, frames pass while the melt
    follows, and the controller hears of the move; what it would have moved itself it never hears of."""
    heard = []
    inner = flow_filter.flow_filter(2, 9)

    def act(parameters, memory, observation, key):
        import jax

        jax.debug.callback(lambda move: heard.append(float(move)), observation.flow_move)
        return inner.act(parameters, memory, observation, key)

    frames = [CameraFrame(str(k), k * 0.1, picture(k), 80.0 if k < 20 else 95.0) for k in range(60)]

    class Given:
        waits_for, lacks, ended, rest_s = "", "a picture", True, 0.0

        def frames(self):
            given, frames[:] = frames[:], []
            yield from given

    watch(Given(), tmp_path, deployed_as=deployed(controller=inner._replace(act=act)))
    said = rows(tmp_path)
    assert heard == [0.0, 0.0, 15.0, *[0.0] * (len(said) - 3)]
    assert [row["flow_setpoint_percent"] for row in said] == [80, 80, *[95] * (len(said) - 2)]
    assert any("moved from 80 to 95 %; 4 frames fill no window" in note for note in said[2]["notes"])
    assert any("5 frames passed while the melt followed" in note for note in said[2]["notes"])


def test_a_move_is_cut_to_the_limits(tmp_path):
    fill(tmp_path / "in", [picture(k, 2.0) for k in range(4 * FRAMES)])
    watch(Folder(tmp_path / "in"), tmp_path / "out", asked=ASKED._replace(flow=308.0))
    assert rows(tmp_path / "out")[-1]["would"].startswith("flow +2 % (to 310 %)")
    watch(Folder(tmp_path / "in"), tmp_path / "beyond", asked=ASKED._replace(flow=400.0))
    assert any("outside the controller's limits" in note for row in rows(tmp_path / "beyond")
               for note in row["notes"])  # fmt: skip


# twice as thick a line is good, and a hotter nozzle
OTHER = PrintedMaterial(250.0, (220.0, 280.0), (85.0, 120.0), (20.0, 310.0))


def test_another_material_is_seen_and_answered_as_what_it_stands_for(tmp_path):
    """115 % of it is good, as 107 % of the published one is; and what the published one would be sent is sent
    as a flow of it."""
    stands = float(OTHER.published_flow(np.array(115.0)))
    assert 90 < stands < 110
    fill(tmp_path / "in", [picture(k, 2.0) for k in range(4 * FRAMES)])
    asked = ASKED._replace(flow=115.0, temperature=250.0)
    told = []

    def read(images, temperature):
        told.append(float(temperature.mean()))
        return by_width(images, temperature)

    as_published = ASKED._replace(flow=stands, temperature=210.0)
    watch(Folder(tmp_path / "in"), tmp_path / "a", asked=as_published, deployed_as=deployed(read=read))
    watch(
        Folder(tmp_path / "in"), tmp_path / "b", asked=asked, deployed_as=deployed(read=read, material=OTHER)
    )
    assert told == pytest.approx([210.0] * 8)
    for one, other in zip(rows(tmp_path / "a"), rows(tmp_path / "b"), strict=True):
        assert one["reason"] == other["reason"] == "acts"
        sent = one["flow_setpoint_percent"] + one["would_flow_move_percent"]
        assert other["flow_setpoint_percent"] == 115.0
        assert other["would_flow_move_percent"] == pytest.approx(OTHER.own_flow(np.array(sent)) - 115.0)
        assert other["would_flow_move_percent"] > one["would_flow_move_percent"] > 0
        for key in ("flow_seen_percent", "belief_flow_percent"):
            assert other[key] == pytest.approx(OTHER.own_flow(np.array(one[key])), rel=0.01)
            assert other[key] != one[key]
    assert "inside 85 to 120 % with" in (tmp_path / "b/index.html").read_text()
    assert "inside 90 to 110 % with" in (tmp_path / "a/index.html").read_text()


def test_the_published_material_is_itself():
    flow = np.array([20.0, 90.0, 97.3, 110.0, 310.0])
    assert np.array_equal(PLA.own_flow(flow), flow)


def test_once_ends_where_a_camera_has_shown_a_window_and_where_nothing_is_there(tmp_path, monkeypatch):
    class Camera(watch_sources.Snapshots):
        def frames(self):
            yield CameraFrame("snapshot", 0.1 * (self.count + 1), picture(self.count))
            self.count += 1

    assert watch(Camera("http://127.0.0.1:9/", 100.0), tmp_path / "a").decisions == 1
    monkeypatch.setattr(shadow, "IN_VAIN_S", 0.2)
    with pytest.raises(OSError, match="the folder .*none is not there yet; start the camera first, or"):
        watch(Folder(tmp_path / "none"), tmp_path / "b")


def test_where_there_was_no_window_it_says_why(tmp_path, monkeypatch):
    monkeypatch.setattr(shadow, "SILENT_S", 0.2)
    monkeypatch.setattr(watch_sources, "SETTLE_S", 0.2)

    def said(source) -> str:
        return shadow.summary_lines(watch(source, tmp_path / "out"), "in")

    (tmp_path / "in").mkdir()
    assert "in: 0 frames, no window of them: it lacks a picture (.jpg, .jpeg," in said(
        Folder(tmp_path / "in")
    )
    fill(tmp_path / "in", [b"\x89PNG and no more"])
    assert (
        f"in: 1 frame, no window of them: expected {FRAMES} frames in a row at one flow; f0.png: the image "
        "cannot be read: a picture of 16 bytes without its end; nothing was sent"
    ) in said(Folder(tmp_path / "in"))
    for name, topics in (("/flow", "/flow"), ("", "no messages")):
        path = tmp_path / "no.mcap"
        with path.open("wb") as stream:
            writer = Writer(stream)
            writer.start()
            if name:
                schema = writer.register_schema("a", "jsonschema", b"{}")
                writer.add_message(writer.register_channel(name, "json", schema), 1, b"{}", 1)
            writer.finish()
        assert f"0 frames, no window of them: it lacks a topic with images; it holds {topics};" in said(
            RecordingSource(path, ANY)
        )


def test_a_decision_that_changes_nothing_is_told_apart_from_one_that_is_held(tmp_path):
    (tmp_path / "in").mkdir()
    fill(tmp_path / "in", [picture(k) for k in range(FRAMES)])
    still = deployed()
    still = still._replace(limits=still.limits._replace(per_action=np.zeros(2)))
    watched = watch(Folder(tmp_path / "in"), tmp_path / "out", deployed_as=still)
    assert (watched.decisions, watched.changes, watched.held) == (1, 0, 0)
    assert "1 decision: 0 would have changed a setpoint, 0 held" in shadow.summary_lines(watched, "in")


# ---- which frames make a window


def shown(*times: float) -> list[CameraFrame]:
    return [CameraFrame(f"at {t:g}", t, "no picture") for t in times]


def windows_of(frames: list[CameraFrame], length: int = 4) -> tuple[list[list[float]], list[str]]:
    windows = FrameWindows(length, settle_s=6.0)
    full = [[one.time_s for one in window] for frame in frames if (window := windows.add(frame))]
    return full, windows.taken_notes()


def test_a_gap_begins_a_window_anew():
    full, notes = windows_of(shown(0, 0.1, 0.2, 9.0, 9.1, 9.2, 9.3))
    assert full == [[9.0, 9.1, 9.2, 9.3]]
    assert windows_of(shown(0, 9.0))[1] == ["no frame came for 9 s; 1 frame fills no window"]
    assert notes == ["no frame came for 8.8 s; 3 frames fill no window"]


def test_a_frame_that_is_late_is_left_out_and_a_clock_set_back_is_followed():
    full, notes = windows_of(shown(5.0, 5.1, 4.9, 5.2, 5.3))
    assert full == [[5.0, 5.1, 5.2, 5.3]]
    assert notes == ["at 4.9 is 0.2 s older than the frame before"]
    full, notes = windows_of(shown(5.0, 5.1, *np.arange(10) / 10))
    assert full == [[0.4, 0.5, 0.6, 0.7]]
    assert "time went back by 4.7 s; 2 frames fill no window" in notes
    assert windows_of(shown(np.nan, np.inf, 0, 1, 2, 3))[0] == [[0, 1, 2, 3]]


def test_ten_thousand_notes_are_told_in_few():
    notes = windows_of(shown(5.0, *([4.0, 4.0, 5.0] * 3000)))[1]
    assert len(notes) == 21 and "notes before these" in notes[0]
    windows = FrameWindows(4, settle_s=6.0)
    windows.notes = [""] * 21
    assert windows.taken_notes()[0] == "1 note before these"


# ---- what it writes


def test_the_page_asks_for_nothing_and_says_that_nothing_is_sent(tmp_path):
    (tmp_path / "in").mkdir()
    fill(tmp_path / "in", [picture(k) for k in range(FRAMES)])
    (tmp_path / "in/f3.png").rename(tmp_path / "in/<b>f3&.png")
    watch(Folder(tmp_path / "in"), tmp_path / "out")
    page = (tmp_path / "out/index.html").read_text()
    assert "Nothing is sent to the printer." in page
    assert not re.search(
        r"""(src|href|action)=["'](?!data:)|https?://|@import|url\(|<script|<form|<b>f3""", page
    )
    assert "default-src 'none'" in page and 'http-equiv="refresh"' not in page
    assert "The watch has ended." in page and "Belief over the flow" in page


def test_one_frame_is_no_frames(tmp_path):
    (tmp_path / "in").mkdir()
    fill(tmp_path / "in", [picture(0)])
    said = shadow.summary_lines(watch(Folder(tmp_path / "in"), tmp_path / "out"), "in")
    assert "in: 1 frame, no window of them" in said
    of = deployed()
    watch(Folder(tmp_path / "in"), tmp_path / "one", deployed_as=of._replace(window=1))
    page = (tmp_path / "one/index.html").read_text()
    assert "1 of 1 frame counts, 1 shows a line" in page


def test_while_it_runs_the_page_refreshes_itself_and_says_what_it_waits_for(tmp_path):
    seen = []

    def stopped():
        page = tmp_path / "out/index.html"
        seen.append(page.read_text() if page.exists() else "")
        return any("is not there yet" in text for text in seen)

    watch(Folder(tmp_path / "none"), tmp_path / "out", asked=ASKED._replace(once=False), stopped=stopped)
    assert all('http-equiv="refresh"' in text for text in seen if text)
    assert rows(tmp_path / "out") == []


def test_the_mcap_is_what_a_viewer_needs_and_a_second_watch_writes_beside_the_first(tmp_path):
    fill(tmp_path / "in", [picture(k) for k in range(2 * FRAMES)])
    watch(Folder(tmp_path / "in"), tmp_path / "out")
    first = (tmp_path / "out/decisions-0000.mcap").read_bytes()
    watch(Folder(tmp_path / "in"), tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "decisions-0000.mcap", "decisions-0001.mcap", "index.html",
    ]  # fmt: skip
    # the same frames, the same bytes
    assert first == (tmp_path / "out/decisions-0000.mcap").read_bytes()
    assert first == (tmp_path / "out/decisions-0001.mcap").read_bytes()
    with (tmp_path / "out/decisions-0000.mcap").open("rb") as stream:
        reader = make_reader(stream)
        messages = list(reader.iter_messages())
        assert list(reader.iter_metadata())[0].metadata["sent"] == "nothing"
    schema, channel, message = messages[0]
    assert (channel.topic, channel.message_encoding, schema.encoding) == ("/decision", "json", "jsonschema")
    declared = json.loads(schema.data)["properties"]
    assert set(json.loads(message.data)) == set(declared)
    assert message.log_time == int(1e18 + (FRAMES - 1) * 0.05e9)


def test_files_are_closed_and_begun_while_the_watch_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(decision_log, "MOST", 2)
    fill(tmp_path / "in", [picture(k) for k in range(5 * FRAMES)])
    watch(Folder(tmp_path / "in"), tmp_path / "out")
    assert [row["decision"] for row in rows(tmp_path / "out")] == [1, 2, 3, 4, 5]
    assert len(list((tmp_path / "out").glob("*.mcap"))) == 3


def test_a_full_disk_costs_no_decision(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(decision_log, "EVERY_S", 0.0)
    full, real = [False], artifacts._on_disk

    def on_disk(path):
        if full[0] and path.is_file():
            raise OSError(errno.ENOSPC, "No space left on device")
        real(path)

    monkeypatch.setattr(artifacts, "_on_disk", on_disk)
    count = [0]

    def rule(images, temperature):
        count[0] += 1
        full[0] = count[0] in (2, 3)
        return by_width(images, temperature)

    fill(tmp_path / "in", [picture(k) for k in range(4 * FRAMES)])
    watch(Folder(tmp_path / "in"), tmp_path / "out", deployed_as=deployed(read=rule))
    assert [row["decision"] for row in rows(tmp_path / "out")] == [1, 2, 3, 4]
    assert "No space left on device" in capsys.readouterr().err
    assert [path for path in (tmp_path / "out").iterdir() if path.name.startswith(".")] == []
    full[0] = True
    with pytest.raises(
        OSError, match="index.html cannot be written .No space left on device.; free some space"
    ):
        watch(Folder(tmp_path / "in"), tmp_path / "out")


# ---- as it runs

DRIVER = """
    import sys, time
    from pathlib import Path
    from pipeline.commands import shadow
    from pipeline.recordings.watch_sources import source
    from tests.nozzle_folders import ANY
    from tests.setpoint.test_shadow import ASKED, deployed
    with shadow.until_told() as stopped:
        watched = shadow.watch(source(sys.argv[1], ANY, rate_hz=50.0), deployed(), ASKED._replace(once=False),
                               Path(sys.argv[2]), place="in", stopped=stopped)
    print(shadow.summary_lines(watched, "in"))
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_told_to_end_it_ends_with_all_written(tmp_path, number):
    fill(tmp_path / "in", [picture(k) for k in range(3 * FRAMES + 3)])
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(DRIVER), str(tmp_path / "in"), str(tmp_path / "out")],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    late = time.monotonic() + 300
    while "Decision 3" not in (page.read_text() if (page := tmp_path / "out/index.html").exists() else ""):
        assert time.monotonic() < late and process.poll() is None
        time.sleep(0.1)
    process.send_signal(number)
    said, wrong = process.communicate(timeout=300)
    assert (process.returncode, wrong) == (0, "")
    # it may be told before it has looked at the last three, which fill no window
    assert re.search(r"2[4-7] frames, 3 decisions:", said) and "nothing was sent" in said
    assert [row["decision"] for row in rows(tmp_path / "out")] == [1, 2, 3]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["decisions-0000.mcap", "index.html"]


WRITER = """
    import sys, time
    from pathlib import Path
    import numpy as np
    from mcap.writer import Writer
    from pipeline.recordings import images
    from tests.setpoint.test_shadow import picture
    with open(sys.argv[1], "wb") as stream:
        writer = Writer(stream, chunk_size=150_000)
        writer.start()
        text = images.IMAGE.encode()
        camera = writer.register_channel(
            "/cam", "cdr", writer.register_schema("sensor_msgs/msg/Image", "ros2msg", text))
        for k in range(60):
            stamp = round(k * 5e7)
            head = images.header(stamp, "nozzle")
            writer.add_message(camera, stamp, images.image(head, picture(k)), stamp)
            stream.flush()
            time.sleep(0.02)
        late = time.monotonic() + 300
        while not Path(sys.argv[1] + ".go").exists() and time.monotonic() < late:
            time.sleep(0.05)
        writer.finish()
"""


def test_a_recording_is_watched_while_another_process_writes_it(tmp_path):
    """The writer closes its file only when decisions were seen: who needs a footer waits for ever."""
    path, out = tmp_path / "a.mcap", tmp_path / "out"
    process = subprocess.Popen([sys.executable, "-c", textwrap.dedent(WRITER), str(path)], cwd=ROOT)
    late, before_the_footer = time.monotonic() + 300, []

    def stopped():
        page = (out / "index.html").read_text() if (out / "index.html").exists() else ""
        if not before_the_footer and "Decision 5" in page:
            before_the_footer.append(path.read_bytes()[-8:])
            Path(f"{path}.go").touch()
        return time.monotonic() > late

    watched = watch(RecordingSource(path, ANY), out, stopped=stopped)
    process.wait(timeout=300)
    assert before_the_footer and before_the_footer[0] != b"\x89MCAP0\r\n"
    assert (watched.frames, watched.decisions) == (60, 60 // FRAMES)
    assert [row["decision"] for row in rows(out)] == list(range(1, 60 // FRAMES + 1))
    assert rows(out)[0]["frames"][0]["name"] == "/cam 1"


FILLER = """
    import sys, time
    import cv2
    from pathlib import Path
    done, frames = cv2.imreadmulti(sys.argv[1])
    folder = Path(sys.argv[2])
    folder.mkdir()
    began, late = time.monotonic(), time.monotonic() + 300
    for k, frame in enumerate(frames):
        time.sleep(max(0.0, began + k / 10 - time.monotonic()))
        # no frame of the next window before this one is decided
        while len(list(folder.parent.glob("decided *"))) < k // 20 and time.monotonic() < late:
            time.sleep(0.01)
        data = cv2.imencode(".jpg", frame)[1].tobytes()
        with open(folder / f"f{k}.jpg", "wb", buffering=0) as stream:
            stream.write(data[: len(data) // 2])
            stream.write(data[len(data) // 2 :])
"""


@pytest.mark.skipif(not GIF.exists(), reason="the nozzle video is not on this machine")
def test_the_nozzle_video_is_watched_at_the_rate_of_its_camera(tmp_path):
    """100 frames of a real nozzle at 10 Hz, written by another process: each window is decided as soon as
    its last frame is there, before another comes, and no window is lost."""
    there = []

    def rule(images, temperature):
        there.append(len(list((tmp_path / "in").iterdir())))
        (tmp_path / f"decided {len(there)}").touch()
        return by_width(images, temperature)

    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(FILLER), str(GIF), str(tmp_path / "in")], cwd=ROOT
    )
    late = time.monotonic() + 300
    out = tmp_path / "out"
    watched = watch(
        Folder(tmp_path / "in"), out, deployed_as=deployed(read=rule, window=20),
        asked=WatchOptions(100.0, 210.0, (299.0, 188.0), once=False),
        stopped=lambda: len(there) == 5 or time.monotonic() > late,
    )  # fmt: skip
    process.wait(timeout=300)
    assert (watched.decisions, len(rows(out))) == (5, 5)
    times = [frame["time_s"] for row in rows(out) for frame in row["frames"]]
    assert np.diff(times).min() > 0
    assert there == [20, 40, 60, 80, 100]


def test_nothing_in_the_watch_could_send():
    """The modules of the watch import nothing that opens a connection, a port or a process; the one that
    reads snapshots names no method and no body."""
    files = [
        *sorted((ROOT / "pipeline/commands/shadow").glob("*.py")),
        ROOT / "pipeline/recordings/watch_sources.py",
    ]
    for path in files:
        tree = ast.parse(path.read_text())
        plain = [node for node in ast.walk(tree) if isinstance(node, ast.Import)]
        froms = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
        names = {alias.name.split(".")[0] for node in plain for alias in node.names}
        names |= {str(node.module).split(".")[0] for node in froms}
        assert not names & {
            "socket",
            "serial",
            "subprocess",
            "requests",
            "paho",
            "ftplib",
            "smtplib",
            "asyncio",
        }
        if path.name != "watch_sources.py":
            assert not names & {"urllib", "http"}
        calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
        requests = [call for call in calls if ast.unparse(call.func).endswith(".request")]
        assert len(requests) == (path.name == "watch_sources.py")
        assert all(ast.unparse(call.args[0]) == "'GET'" and len(call.args) == 2 for call in requests)
        assert all({word.arg for word in call.keywords} == {"headers"} for call in requests)
