"""`beadline calibrate tip`: one page, for any browser, on which a click shows where the nozzle's tip is, and
what the front end makes of a frame with that tip."""

import base64
import html
import json
import shlex
import string
from pathlib import Path

import cv2
import numpy as np

from pipeline.recordings.images import read_image
from pipeline.recordings.nozzle_frames import middle_frame
from pipeline.setpoint.frames import key_area
from pipeline.store import artifacts

# the lines that are pasted into params.yaml: section, key
PLACE = ("train_classifier", "tip_px")
# of the drawings: pixels of the page for one of the picture
CROP, AREA = 2, 8
RED, GREEN = (60, 60, 235), (90, 200, 60)


def calibrate(image: Path, out: Path, tip: str, *, least_score: float, topic: str) -> str:
    """Writes the page of a picture, or of the middle frame of `topic` of an MCAP recording, to `out`, and
    returns a summary; `tip` is "x,y" in px, or empty.

    Raises ValueError if the picture cannot be read, is too small, or has the tip outside.
    """
    tip_px = _pixel(tip) if tip else None
    frame = middle_frame(image, topic) if image.suffix.lower() == ".mcap" else read_image(image)
    # a picture that is too small is refused with or without a tip
    with artifacts.about(image):
        area = key_area.find(frame, tip_px or (0.0, 0.0), least_score=least_score)
    shown = "" if tip_px is None else _front_end(frame, tip_px, area, least_score)
    start = "null" if tip_px is None else json.dumps(list(tip_px))
    height, width = frame.shape
    command = json.dumps(f"./run beadline calibrate tip {shlex.quote(str(image))} --tip ").replace(
        "<", "\\u003c"
    )
    values = {
        "name": html.escape(image.name),
        "picture": _embedded(_eight_bits(frame)),
        "width": width,
        "height": height,
        "tip": start,
        "command": command,
        "section": PLACE[0],
        "key": PLACE[1],
    }
    artifacts.write_text(out, string.Template(_page()).substitute(values, front_end=shown))
    if tip_px is None:
        return (
            f"{out}: open it in a browser and click on the nozzle's tip; "
            "it shows the lines to paste into params.yaml"
        )
    verdict = f"rejected, {area.reason}" if area.reason else "accepted"
    return (
        f"{image}: {verdict}; line at {area.angle_deg:.0f} degrees (0 right, 90 down), "
        f"score {area.score:.1f} of at least {least_score:g} gray levels, "
        f"{100 * area.padded_share:.0f} percent of the crop outside the frame\n"
        f"{PLACE[0]}:\n  {PLACE[1]}: [{tip_px[0]:g}, {tip_px[1]:g}]\nwritten: {out}"
    )


def _front_end(
    frame: np.ndarray, tip_px: tuple[float, float], area: key_area.KeyArea, least_score: float
) -> str:
    """What the front end makes of a frame, as a piece of HTML: the crop with tip and rectangle, the key area,
    and the verdict."""
    crop = key_area.crop(frame, tip_px)
    left, top, right, bottom = crop.inside
    gray = crop.gray // 3
    gray[top:bottom, left:right] = crop.gray[top:bottom, left:right]
    picture = cv2.cvtColor(
        cv2.resize(gray, None, fx=CROP, fy=CROP, interpolation=cv2.INTER_CUBIC), cv2.COLOR_GRAY2BGR
    )
    middle = key_area.SIDE // 2
    colour = RED if area.reason else GREEN
    corners = np.rint((key_area.corners(area.angle_deg, area.miss_px) + middle) * CROP).astype(np.int32)
    cv2.polylines(picture, [corners], True, colour, 2, cv2.LINE_AA)
    cv2.drawMarker(picture, (middle * CROP, middle * CROP), colour, cv2.MARKER_CROSS, 24, 2, cv2.LINE_AA)
    verdict = (
        f"<strong>rejected</strong>: {html.escape(area.reason)}"
        if area.reason
        else "<strong>accepted</strong>"
    )
    # the rectangle is looked at even if it is rejected: that shows why
    image = (
        area.image
        if not area.reason
        else key_area.find(frame, tip_px, least_score=-np.inf, direction_deg=area.angle_deg).image
    )
    enlarged = cv2.resize(image, None, fx=AREA, fy=AREA, interpolation=cv2.INTER_NEAREST)
    figures = {
        "direction of the line": f"{area.angle_deg:.0f}° (0 right, 90 down)",
        "passes beside the tip by": f"{area.miss_px:g} px",
        "score": f"{area.score:.1f} gray levels; at least {least_score:g} are asked for",
        "outside the frame": f"{100 * area.padded_share:.0f} % of the crop",
    }
    rows = "".join(f"<tr><th>{name}</th><td>{value}</td></tr>" for name, value in figures.items())
    dark = "; dark: outside the frame, its border repeated" if crop.padded_share else ""
    return (
        f"<section><h2>What the front end sees with the tip at {tip_px[0]:g}, {tip_px[1]:g}</h2>"
        f"<p>{verdict}</p><div class=row>"
        f'<figure><img alt="crop around the tip with the rectangle" src="{_embedded(picture)}">'
        f"<figcaption>{key_area.SIDE} x {key_area.SIDE} px around the tip{dark}</figcaption></figure>"
        f'<div><figure><img class=area alt="key area" src="{_embedded(enlarged)}">'
        "<figcaption>key area, 48 x 16, from the tip outward</figcaption></figure>"
        f"<table>{rows}</table></div></div></section>"
    )


def _pixel(text: str) -> tuple[float, float]:
    """(571, 511) of "571,511"."""
    try:
        x, y = map(float, text.split(","))
    except ValueError:
        raise ValueError(
            f"--tip: expected two numbers of pixels such as 571,511, found {text!r}; "
            "write X,Y without a blank"
        ) from None
    return x, y


def _page() -> str:
    """The page's template, beside this file."""
    return Path(__file__).with_name("page.html").read_text(encoding="utf-8")


def _eight_bits(frame: np.ndarray) -> np.ndarray:
    return frame if frame.dtype == np.uint8 else (frame >> 8).astype(np.uint8)


def _embedded(picture: np.ndarray) -> str:
    """A PNG inside the page."""
    return "data:image/png;base64," + base64.b64encode(cv2.imencode(".png", picture)[1]).decode()
