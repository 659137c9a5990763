"""`beadline calibrate tip`: the page, what it says of a frame, and a click in a real browser."""

import functools
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.setpoint.frames import key_area
from tests.nozzle_folders import LEAST, expected, scenes
from tests.report.conftest import expect
from tests.setpoint.test_frame_mcap import film, foreign


def declare(least_score: float | str) -> None:
    Path("params.yaml").write_text(f"train_classifier: {{least_score: {least_score}}}\n")


@pytest.fixture
def calibrate(beadline):
    """calibrate("a.png", "--tip", "1,2"): status, what was printed, and what was said of errors."""
    declare(LEAST)
    return functools.partial(beadline, "calibrate", "tip")


@pytest.fixture
def picture(tmp_path) -> tuple[str, np.ndarray, tuple[float, float]]:
    """A frame with a line, below another name than it has in a page."""
    k = int(np.flatnonzero(expected().any(axis=(1, 2)))[0])
    scene = scenes()[k // 3]
    frame = scene.frames[k % 3]
    cv2.imwrite(str(tmp_path / "a<b>&.png"), frame)
    return "a<b>&.png", frame, tuple(map(float, np.round(scene.tip)))


def test_the_command_says_what_the_front_end_sees(calibrate, picture):
    name, frame, tip = picture
    found = key_area.find(frame, tip, least_score=LEAST)
    status, said, wrong = calibrate(name, "--tip", f"{tip[0]:g},{tip[1]:g}")
    assert (status, wrong) == (0, "")
    assert (
        f"{name}: accepted; line at {found.angle_deg:.0f} degrees (0 right, 90 down), "
        f"score {found.score:.1f} of at least 10 gray levels" in said
    )
    assert f"train_classifier:\n  tip_px: [{tip[0]:g}, {tip[1]:g}]\n" in said
    page = Path("a<b>&.tip.html").read_text()
    assert "<strong>accepted</strong>" in page
    declare(200)
    status, said, _ = calibrate(name, "--tip", f"{tip[0]:g},{tip[1]:g}")
    assert "rejected, no fresh line" in said
    assert "<strong>rejected</strong>: no fresh line" in Path("a<b>&.tip.html").read_text()


def test_the_page_asks_for_nothing_and_holds_foreign_names_as_text(calibrate, picture):
    assert calibrate(picture[0])[0] == 0
    page = Path("a<b>&.tip.html").read_text()
    assert not re.search(r"""(src|href)=["'](?!data:)|https?://|@import|url\(""", page)
    assert "a&lt;b&gt;&amp;.png" in page
    assert "<b>" not in page
    first = Path("a<b>&.tip.html").read_bytes()
    calibrate(picture[0])
    assert Path("a<b>&.tip.html").read_bytes() == first


def test_the_middle_frame_of_a_recording_will_do(calibrate, tmp_path):
    film(tmp_path / "night.mcap")
    status, said, _ = calibrate("night.mcap")
    assert status == 0
    assert "night.tip.html: open it in a browser" in said


def test_of_two_cameras_the_one_of_the_parameters_is_shown(calibrate, tmp_path):
    foreign(tmp_path / "night.mcap", other="/bed/camera")
    assert (
        "name the one of the nozzle's camera (params.yaml: train_classifier.topics.image)"
        in calibrate("night.mcap")[2]
    )
    Path("params.yaml").write_text(f"train_classifier: {{least_score: {LEAST}, topics: {{image: /cam}}}}\n")
    assert calibrate("night.mcap")[0] == 0


@pytest.mark.parametrize("kind", ["16 bit", "colour"])
def test_deep_and_coloured_pictures_will_do(calibrate, picture, kind):
    frame = (
        picture[1].astype(np.uint16) << 8
        if kind == "16 bit"
        else cv2.cvtColor(picture[1], cv2.COLOR_GRAY2BGR)
    )
    cv2.imwrite("b.png", frame)
    assert "accepted" in calibrate("b.png", "--tip", "{:g},{:g}".format(*picture[2]))[1]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["gone.png"],
        "gone.png: expected a whole picture (JPEG, PNG, TIFF, BMP, WebP), found no such file or directory"),
        (["."], "is a directory"), (["text.png"], "found 6 bytes that are no whole picture"),
        (["cut.jpg"], "without its end"),
        (["small.png"], "small.png: frame: expected at least 64 x 64 px but found 40 x 50"),
        (["talk.mcap"], "talk.mcap"), (["gone.mcap"], "gone.mcap is missing"),
        (["a<b>&.png", "--tip", "400,10"],
        "expected x, y inside the frame of 350 x 350 px but found (400, 10)"),
        (["a<b>&.png", "--tip=-1,10"], "found (-1, 10)"),
        (["a<b>&.png", "--tip", "nan,10"], "found (nan, 10)"),
        (["a<b>&.png", "--tip", "40"], "--tip: expected two numbers of pixels such as 571,511, found '40'"),
        (["a<b>&.png", "--tip", "a,b"], "found 'a,b'"),
    ],
)  # fmt: skip
def test_bad_input_is_one_sentence(calibrate, picture, arguments, said):
    Path("text.png").write_text("no png")
    Path("talk.mcap").write_text("t_s,u\n1,2\n2,3\n")
    Path("cut.jpg").write_bytes(cv2.imencode(".jpg", picture[1])[1].tobytes()[:-300])
    cv2.imwrite("small.png", picture[1][:50, :40])
    before = sorted(Path().iterdir())
    status, printed, wrong = calibrate(*arguments)
    assert (status, printed) == (1, "")
    # libpng and OpenCV speak for themselves
    assert [line for line in wrong.splitlines() if line.startswith("beadline: ")] == [wrong.splitlines()[-1]]
    assert said in wrong
    assert "; " in wrong
    assert sorted(Path().iterdir()) == before


def test_a_least_score_that_is_no_number_is_refused(calibrate, picture):
    declare("high")
    assert (
        "params.yaml: train_classifier.least_score should be a number of gray levels (could not convert "
        "string to float: 'high'); write one" in calibrate(picture[0])[2]
    )


# ---- in a browser


@pytest.fixture
def page(browser, calibrate, picture):
    """The page of the picture, open in the browser, with what it asked for and said."""
    calibrate(picture[0])
    shown = browser.new_page(viewport={"width": 1000, "height": 900})
    shown.asked, shown.wrong = [], []
    shown.on("request", lambda request: shown.asked.append(request.url))
    shown.on("pageerror", lambda error: shown.wrong.append(str(error)))
    shown.goto(Path("a<b>&.tip.html").absolute().as_uri())
    yield shown
    shown.close()


def test_a_click_shows_and_copies_the_pixel_under_it(page):
    box = page.locator("#picture").bounding_box()
    # the middle of pixel (140, 210), however large the picture is shown
    page.mouse.click(box["x"] + 140.5 * box["width"] / 350, box["y"] + 210.5 * box["height"] / 350)
    assert box["width"] == pytest.approx(box["height"], rel=1e-6), "the picture is a square"
    assert page.locator("#lines").inner_text() == "train_classifier:\n  tip_px: [140, 210]"
    # the clipboard answers later
    expect(page.locator("#done")).to_have_text("copied")
    assert page.locator("#command").inner_text().endswith("--tip 140,210")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowUp")
    assert page.locator("#lines").inner_text() == "train_classifier:\n  tip_px: [141, 209]"
    # the cross stands on the middle of the pixel, to half a pixel of the screen
    cross = page.locator("#cross").bounding_box()
    at = (
        (cross["x"] + cross["width"] / 2 - box["x"]) * 350 / box["width"],
        (cross["y"] + cross["height"] / 2 - box["y"]) * 350 / box["height"],
    )
    assert at == pytest.approx((141.5, 209.5), abs=0.5)
    assert page.wrong == []
    assert [url for url in page.asked if not url.startswith(("file:", "data:"))] == []


def test_the_loupe_shows_the_pixels_around_the_tip(page, picture):
    box = page.locator("#picture").bounding_box()
    page.mouse.click(box["x"] + 100.5 * box["width"] / 350, box["y"] + 120.5 * box["height"] / 350)
    page.mouse.move(5, 5)
    # a corner of the loupe, 10 px left of and above the tip
    shown = page.evaluate("Array.from(loupe.getImageData(6, 6, 1, 1).data)")
    assert shown[:3] == [picture[1][110, 90]] * 3
