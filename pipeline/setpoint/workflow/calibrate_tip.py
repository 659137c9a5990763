"""`beadline calibrate-tip`: one page, for any browser, on which a click shows where the nozzle's tip is, and
what the front end makes of a frame with that tip."""

import base64
import html
import json
import shlex
import string
from pathlib import Path

import cv2
import numpy as np

from pipeline.setpoint import key_area
from pipeline.setpoint.workflow.frame_images import read_image
from pipeline.setpoint.workflow.frame_mcap import middle_frame
from pipeline.store import artifacts

# the lines that are pasted into params.yaml: section, key
PLACE = ("train_classifier", "tip_px")
# of the drawings: pixels of the page for one of the picture
CROP, AREA = 2, 8
RED, GREEN = (60, 60, 235), (90, 200, 60)


def calibrate(image: Path, out: Path, tip: str, *, least_score: float, topic: str) -> str:
    """Writes the page of a picture, or of the middle frame of `topic` of an MCAP recording, to `out`, and returns what
    is to be said of it; `tip` is "x,y" in px, or empty.

    Raises ValueError where the picture cannot be read, is too small, or has the tip outside.
    """
    tip_px = _pixel(tip) if tip else None
    frame = middle_frame(image, topic) if image.suffix.lower() == ".mcap" else read_image(image)
    # a picture that is too small is refused with or without a tip
    with artifacts.about(image):
        found = key_area.find(frame, tip_px or (0.0, 0.0), least_score=least_score)
    shown = "" if tip_px is None else _front_end(frame, tip_px, found, least_score)
    start = "null" if tip_px is None else json.dumps(list(tip_px))
    height, width = frame.shape
    command = json.dumps(f"./run beadline calibrate-tip {shlex.quote(str(image))} --tip ").replace(
        "<", "\\u003c"
    )
    values = {
        "name": html.escape(image.name), "picture": _embedded(_eight_bits(frame)), "width": width, "height": height, "tip": start,
        "command": command,
        "section": PLACE[0], "key": PLACE[1],
    }  # fmt: skip
    artifacts.write_text(out, string.Template(_PAGE).substitute(values, seen=shown))
    if tip_px is None:
        return f"{out}: open it in a browser and click on the nozzle's tip; it shows the lines to paste into params.yaml"
    verdict = f"rejected, {found.reason}" if found.reason else "accepted"
    return (
        f"{image}: {verdict}; line at {found.angle_deg:.0f} degrees (0 right, 90 down), score {found.score:.1f} of at least "
        f"{least_score:g} gray levels, "
        f"{100 * found.padded_share:.0f} percent of the crop outside the frame\n{PLACE[0]}:\n  {PLACE[1]}: [{tip_px[0]:g}, "
        f"{tip_px[1]:g}]\nwritten: {out}"
    )


def _front_end(
    frame: np.ndarray, tip_px: tuple[float, float], found: key_area.KeyArea, least_score: float
) -> str:
    """What the front end sees as a piece of HTML: the crop with tip and rectangle, the key area, and the verdict."""
    crop = key_area.crop(frame, tip_px)
    left, top, right, bottom = crop.inside
    seen = crop.gray // 3
    seen[top:bottom, left:right] = crop.gray[top:bottom, left:right]
    picture = cv2.cvtColor(
        cv2.resize(seen, None, fx=CROP, fy=CROP, interpolation=cv2.INTER_CUBIC), cv2.COLOR_GRAY2BGR
    )
    middle = key_area.SIDE // 2
    colour = RED if found.reason else GREEN
    corners = np.rint((key_area.corners(found.angle_deg, found.miss_px) + middle) * CROP).astype(np.int32)
    cv2.polylines(picture, [corners], True, colour, 2, cv2.LINE_AA)
    cv2.drawMarker(picture, (middle * CROP, middle * CROP), colour, cv2.MARKER_CROSS, 24, 2, cv2.LINE_AA)
    verdict = (
        f"<strong>rejected</strong>: {html.escape(found.reason)}"
        if found.reason
        else "<strong>accepted</strong>"
    )
    # the rectangle is looked at even where it is rejected: that shows why
    area = (
        found.image
        if not found.reason
        else key_area.find(frame, tip_px, least_score=-np.inf, direction_deg=found.angle_deg).image
    )
    enlarged = cv2.resize(area, None, fx=AREA, fy=AREA, interpolation=cv2.INTER_NEAREST)
    figures = {
        "direction of the line": f"{found.angle_deg:.0f}° (0 right, 90 down)",
        "passes beside the tip by": f"{found.miss_px:g} px",
        "score": f"{found.score:.1f} gray levels; at least {least_score:g} are asked for",
        "outside the frame": f"{100 * found.padded_share:.0f} % of the crop",
    }
    rows = "".join(f"<tr><th>{name}</th><td>{value}</td></tr>" for name, value in figures.items())
    dark = "; dark: outside the frame, its border repeated" if crop.padded_share else ""
    return (
        f"<section><h2>What the front end sees with the tip at {tip_px[0]:g}, {tip_px[1]:g}</h2><p>{verdict}</p><div class=row>"
        f'<figure><img alt="crop around the tip with the rectangle" src="{_embedded(picture)}"><figcaption>{key_area.SIDE} x '
        f"{key_area.SIDE} px around the tip{dark}</figcaption></figure>"
        f'<div><figure><img class=area alt="key area" src="{_embedded(enlarged)}"><figcaption>key area, 48 x 16, '
        f"from the tip outward</figcaption></figure><table>{rows}</table></div>"
        "</div></section>"
    )


def _pixel(text: str) -> tuple[float, float]:
    """(571, 511) of "571,511"."""
    try:
        x, y = map(float, text.split(","))
    except ValueError:
        raise ValueError(
            f"--tip: expected two numbers of pixels such as 571,511, found {text!r}; write X,Y without a blank"
        ) from None
    return x, y


def _eight_bits(frame: np.ndarray) -> np.ndarray:
    return frame if frame.dtype == np.uint8 else (frame >> 8).astype(np.uint8)


def _embedded(picture: np.ndarray) -> str:
    """A PNG inside the page."""
    return "data:image/png;base64," + base64.b64encode(cv2.imencode(".png", picture)[1]).decode()


_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>Nozzle tip of $name</title>
<style>
:root { color-scheme: light dark; --line: #8888; --mark: #e8372c }
body { font: 16px/1.45 system-ui, sans-serif; margin: 0 auto; max-width: 1320px; padding: 1rem 1.5rem 3rem }
h1 { font-size: 1.4rem; margin: 0 0 .3rem } h2 { font-size: 1.15rem; margin: 2rem 0 .3rem }
.row { display: flex; flex-wrap: wrap; gap: 1.5rem; align-items: flex-start }
#stage { position: relative; flex: 1 1 640px; cursor: crosshair; line-height: 0; outline-offset: 3px }
#stage img { width: 100%; height: auto; image-rendering: pixelated }
#cross { position: absolute; width: 33px; height: 33px; margin: -16.5px 0 0 -16.5px; pointer-events: none }
#side { flex: 0 0 272px } canvas { width: 264px; height: 264px; border: 1px solid var(--line); image-rendering: pixelated }
.bright #picture, .bright canvas { filter: brightness(3) }
pre { background: #8882; padding: .6rem .8rem; margin: .5rem 0; font-size: 1rem; white-space: pre-wrap; overflow-wrap: anywhere } button { font: inherit; padding: .25rem .8rem }
figure { margin: 0 } figure img { max-width: 100%; width: 525px } figure img.area { width: 384px; image-rendering: pixelated }
figcaption, .quiet { color: #777; font-size: .9rem } table { border-collapse: collapse; margin-top: 1rem } th, td { text-align: left; padding: .2rem 1rem .2rem 0; font-weight: normal }
</style>
<h1>Nozzle tip of <bdi>$name</bdi></h1>
<p>Click where the nozzle ends and the plastic comes out: the middle of its lower rim. Arrow keys move the cross by one pixel. <label><input type="checkbox" id="bright"> Brighter</label></p>
<div class="row">
<div id="stage" tabindex="0"><img id="picture" alt="nozzle camera frame, $width x $height px" src="$picture" width="$width" height="$height">
<svg id="cross" hidden viewBox="-16 -16 33 33"><path d="M-16 .5H-4M5 .5H17M.5-16V-4M.5 5V17" stroke="#e8372c" stroke-width="2"/><circle cx=".5" cy=".5" r="9" fill="none" stroke="#e8372c"/></svg></div>
<div id="side"><canvas id="loupe" width="33" height="33"></canvas>
<p id="at" class="quiet">33 px around the pointer; $width x $height px</p>
<pre id="lines">no tip yet</pre><button id="copy" disabled>Copy</button> <span id="done" class="quiet" role="status"></span>
<p class="quiet">Paste the lines into params.yaml. Then see what the front end makes of it:</p><pre id="command"></pre></div>
</div>
$seen
<script>
const id = name => document.getElementById(name), picture = id("picture"), loupe = id("loupe").getContext("2d");
const command = $command;
let tip = $tip;
id("command").textContent = command + "X,Y";
id("bright").addEventListener("change", event => document.body.classList.toggle("bright", event.target.checked));
function magnify(x, y) {
  loupe.imageSmoothingEnabled = false;
  loupe.fillStyle = "#888"; loupe.fillRect(0, 0, 33, 33);
  loupe.drawImage(picture, Math.round(x) - 16, Math.round(y) - 16, 33, 33, 0, 0, 33, 33);
  loupe.fillStyle = "#e8372c"; loupe.fillRect(16, 0, 1, 13); loupe.fillRect(16, 20, 1, 13); loupe.fillRect(0, 16, 13, 1); loupe.fillRect(20, 16, 13, 1);
  id("at").textContent = "33 px around x " + Math.round(x) + ", y " + Math.round(y) + "; $width x $height px";
}
function show() {
  if (!tip) return;
  const cross = id("cross").style;
  id("cross").removeAttribute("hidden");
  cross.left = (tip[0] + .5) / $width * 100 + "%"; cross.top = (tip[1] + .5) / $height * 100 + "%";
  id("lines").textContent = "$section:\\n  $key: [" + tip[0] + ", " + tip[1] + "]";
  id("command").textContent = command + tip[0] + "," + tip[1];
  id("copy").disabled = false;
  magnify(tip[0], tip[1]);
}
function copy() {
  const text = id("lines").textContent, area = document.createElement("textarea"), before = document.activeElement;
  area.value = text; document.body.append(area); area.select();
  const copied = document.execCommand("copy");
  area.remove();
  before.focus({preventScroll: true});
  id("done").textContent = copied ? "copied" : "not copied: select the lines and copy them";
}
function place(x, y) { tip = [Math.min(Math.max(x, 0), $width - 1), Math.min(Math.max(y, 0), $height - 1)]; show(); copy(); }
function at(event) {
  const box = picture.getBoundingClientRect();
  return [Math.floor((event.clientX - box.left) / box.width * $width), Math.floor((event.clientY - box.top) / box.height * $height)];
}
id("stage").addEventListener("click", event => { place(...at(event)); id("stage").focus({preventScroll: true}); });
id("stage").addEventListener("mousemove", event => magnify(...at(event)));
id("stage").addEventListener("mouseleave", show);
id("stage").addEventListener("keydown", event => {
  const by = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1]}[event.key];
  if (!by || !tip) return;
  event.preventDefault(); place(Math.round(tip[0]) + by[0], Math.round(tip[1]) + by[1]);
});
id("copy").addEventListener("click", copy);
picture.decode().then(show, show);
</script>
</html>
"""
