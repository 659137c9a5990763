"""`beadline calibrate levels`: recordings of a camera that shows flow in its own way, in folders and as MCAP,
and such as do not suffice. What reads key areas is a rule on the bead's width."""

import re
from functools import partial

import numpy as np
import pytest

from pipeline.commands import record_levels
from pipeline.commands.levels_files import restore_levels
from pipeline.commands.record_levels import Eye, Protocol
from pipeline.commands.shadow.decide import Mind
from pipeline.commands.shadow.deploy import of_camera
from pipeline.recordings.watch_sources import CameraFrame, Folder
from pipeline.setpoint import levels
from pipeline.setpoint.material import PrintedMaterial
from tests.setpoint.test_shadow import ASKED, FRAMES, TIP, by_width, deployed, fill, picture

FLOWS, HOLD, RATE = (60.0, 80.0, 100.0, 125.0, 160.0), 6.0, 10
PROTOCOL = Protocol(FLOWS, hold_s=HOLD, settle_s=1.0, temperature=210.0, tip=TIP)
EYE = Eye(by_width, deployed().window_flow, FRAMES, least_score=10.0, weights="ab" * 32, false_alarms=0.03)


def half_width(flow: float) -> float:
    """Of this camera: a tenth broader than the rule believes, and less so for broad beads."""
    return 6.6 * (flow / 100) ** 0.8


def film(seed: int, flows=FLOWS, told: bool = False, see=half_width) -> list[CameraFrame]:
    rng = np.random.default_rng(seed)
    frames = []
    for k, flow in enumerate(flows):
        for i in range(int(HOLD * RATE)):
            shown = picture(1000 * seed + len(frames), see(flow) * np.exp(0.04 * rng.standard_normal()))
            time_s = k * HOLD + i / RATE
            frames.append(CameraFrame(str(len(frames)), time_s, shown, flow if told else np.nan))
    return frames


class Given:
    """A source that has ended."""

    waits_for, lacks, ended, rest_s = "", "a picture", True, 0.0

    def __init__(self, frames: list[CameraFrame]):
        self.left = frames

    def frames(self):
        left, self.left = self.left, []
        yield from left


@pytest.fixture(scope="module")
def recorded():
    return record_levels.record(Given(film(1)), PROTOCOL, EYE, place="the camera")


def test_the_levels_of_a_film_are_told_apart_and_corrected(recorded, tmp_path):
    found, told = recorded
    assert [level.flow for level in told] == sorted(FLOWS)
    # six seconds less one in which the melt follows, in windows of 8 frames
    assert {level.windows for level in told} == {6}
    assert [level.corrected for level in told] == pytest.approx(FLOWS, rel=0.1)
    assert np.mean([level.named for level in told]) > 0.9
    assert found.levels.spread < 0.15
    words = record_levels.write(found, told, tmp_path / "levels.parquet", "the <b>camera")
    assert "30 windows at 5 levels" in words
    page = (tmp_path / "levels.html").read_text()
    assert "the &lt;b&gt;camera" in page
    assert not re.search(r"""(src|href|action)=["']|https?://|@import|url\(|<script""", page)
    low, high = levels.shown(found.levels, np.array([90.0, 110.0]))
    assert f"This camera shows {low:.0f} %" in page and f"{high:.0f} % where it is 110 %" in page


def test_a_recording_that_says_its_flow_needs_no_clock(recorded):
    """Held in another order, and one of them twice as long: the recording's own setpoint counts."""
    frames = film(1, told=True)
    late = [shown._replace(time_s=shown.time_s + 40.0 * (shown.flow > 90)) for shown in frames]
    by_setpoint, _ = record_levels.record(Given(late), PROTOCOL, EYE, place="a")
    assert by_setpoint.windows.seen == pytest.approx(recorded[0].windows.seen)


def test_a_folder_of_pictures_is_a_recording(tmp_path, recorded):
    frames = film(1)
    fill(tmp_path / "in", [shown.frame for shown in frames], period_s=1 / RATE)
    found, _ = record_levels.record(Folder(tmp_path / "in"), PROTOCOL, EYE, place="in")
    assert found.windows.seen == pytest.approx(recorded[0].windows.seen)


def test_levels_of_another_material_are_kept_as_what_they_stand_for(tmp_path, recorded):
    """Held at other flows that stand for the same ones of the published material, the same pictures give the
    same correction; what a person is told is of what was printed."""
    other = PrintedMaterial(250.0, (220.0, 280.0), (85.0, 120.0), (20.0, 310.0))
    flows = tuple(float(other.own_flow(np.array(flow))) for flow in FLOWS)
    degrees = []

    def read(images, temperature):
        degrees.append(float(temperature.mean()))
        return by_width(images, temperature)

    eye = EYE._replace(read=read, material=other)
    protocol = PROTOCOL._replace(flows=flows, temperature=250.0)
    found, told = record_levels.record(Given(film(1)), protocol, eye, place="the camera")
    assert degrees == pytest.approx([210.0] * len(degrees))
    assert found.windows.flow == pytest.approx(recorded[0].windows.flow)
    assert found.levels.log_flow == pytest.approx(recorded[0].levels.log_flow)
    assert [level.flow for level in told] == pytest.approx(sorted(flows))
    words = record_levels.write(found, told, tmp_path / "levels.parquet", "a", other)
    assert "the borders of good, 85 and 120 %" in words
    low = float(other.own_flow(levels.shown(found.levels, np.array([90.0])))[0])
    assert f"This camera shows {low:.0f} % where the flow is 85 %" in (tmp_path / "levels.html").read_text()


def test_levels_go_to_a_file_and_back_and_not_to_another_classifier(recorded, tmp_path):
    found = recorded[0]
    record_levels.write(*recorded, tmp_path / "levels.parquet", "a")
    back = restore_levels(tmp_path / "levels.parquet", EYE.weights)
    assert np.array_equal(back.levels.log_flow, found.levels.log_flow)
    assert (back.levels.spread, back.weights) == (found.levels.spread, found.weights)
    assert np.array_equal(back.windows.seen, found.windows.seen)
    assert (back.camera is None) == (found.camera is None)
    with pytest.raises(ValueError, match="another classifier saw .abababab, .* is cdcdcdcd.; record"):
        restore_levels(tmp_path / "levels.parquet", "cd" * 32)


def test_the_watch_corrects_what_it_sees_and_says_so(recorded):
    """The same window of a bead at 100 %: without levels it is over, with them good."""
    window = [
        CameraFrame(str(k), k / RATE, picture(9000 + k, half_width(100.0) * 1.05)) for k in range(FRAMES)
    ]
    plain = Mind(deployed()).decide(window, ASKED, 0.0, [])
    corrected = partial(of_camera, deployed().window_flow, recorded[0].levels)
    with_levels = Mind(deployed(window_flow=corrected)).decide(window, ASKED, 0.0, [])
    assert plain.row["flow_seen_percent"] > 108
    assert with_levels.row["flow_seen_percent"] == pytest.approx(105, rel=0.06)
    assert with_levels.judged.label[0] == 1
    assert with_levels.row["spread"] == recorded[0].levels.spread


def test_a_controller_learns_from_the_levels_in_place_of_the_classifier(recorded):
    found = recorded[0]
    edges = np.array([50.0, 70.0, 90.0, 110.0, 130.0, 170.0])
    table = levels.table(found.levels, found.windows, edges)
    assert np.bincount(table.flow_bin).tolist() == [len(found.windows.seen)] * 5
    error = np.log(table.flow_seen / table.flow)
    assert abs(error.mean()) < 0.03 and 0.01 < error.std() < 0.15
    assert table.shares.sum(axis=1) == pytest.approx(1)
    assert (table.named[table.flow_bin == 2] == 1).mean() > 0.8


@pytest.mark.parametrize(
    ("frames", "said"),
    [
        (film(2, FLOWS[:2], told=True), "the camera: expected at least 3 levels of flow, found 2"),
        (film(3, told=True, see=lambda flow: 6.0), "the camera: this camera does not see flow"),
        ([one._replace(frame=np.full((180, 240), 90, np.uint8)) for one in film(4)],
         "at least 5 windows that show a flow at 60 %, found 0 of 6"),
        ([one._replace(flow=50.0) for one in film(5, FLOWS[:1])], "expected windows of 8 frames at 5 flows"),
        ([one._replace(time_s=one.time_s / 1000) for one in film(6)],
         "0 flows in them; record all of --flows, and copy pictures with their times (cp -p)"),
        ([], "the camera: expected frames of a printer's camera, found none: it lacks a picture; name"),
    ],
    ids=["two levels", "blind", "no line", "other flows", "copied without their times", "empty"],
)  # fmt: skip
def test_what_does_not_suffice_is_refused_in_one_sentence(frames, said):
    with pytest.raises(ValueError, match=re.escape(said)) as refused:
        record_levels.record(Given(frames), PROTOCOL, EYE, place="the camera")
    assert "; " in str(refused.value)


def test_a_place_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(ValueError, match="none is missing; name the folder of pictures, or the recording"):
        record_levels.source_of(tmp_path / "none", lambda path: None)
