"""`beadline calibrate camera`: pictures of printed lines of known widths into section `camera` of
params.yaml, and a page that shows what was measured in them.
"""

import base64
import html
import json
import math
import shlex
import string
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from pipeline.deposition.camera import bead, ladder, line
from pipeline.deposition.camera.bead import BLOCK, FEWEST_BLOCKS
from pipeline.deposition.camera.ladder import Ladder, Rung
from pipeline.deposition.settings import Camera, Printer
from pipeline.recordings.images import Frames, image_topic
from pipeline.recordings.mcap_files import McapFile, TopicColumns, topics
from pipeline.store import artifacts, params
from pipeline.store.params_text import replaced

# frames of a recording that are measured, spread over it
SAMPLE = 12
# around the nozzle's rim so much more is not measured; so many columns of the turned picture lie before it
RIM, COLUMN = 1.15, 30
# a line may become so much wider than the widest one, and beside it the ground is looked at, px
WIDER, BESIDE_PX = 1.15, 36


class CalibrationRequest(NamedTuple):
    """What a person requests: pictures or recordings, the known widths in mm in their order, the tip
    (x, y) in px, and the distance of neighbouring lines in mm if one picture shows all (NaN else)."""

    images: Sequence[Path]
    widths_mm: Sequence[float]
    tip_px: tuple[float, float] | None
    pitch_mm: float


class Calibrated(NamedTuple):
    """What came of it: the ladder, the values of section `camera` that it sets, what was measured of each
    line with its known width and picture, and by what the size of a pixel was told."""

    ladder: Ladder
    values: dict[str, Any]
    rungs: list[tuple[float, np.ndarray, Rung]]
    scale_from: str


def calibrate(request: CalibrationRequest, out: Path, *, write: bool) -> str:
    """Writes the page to `out`, with `write` the values into params.yaml, and returns a summary. Raises
    ValueError if a picture cannot be read, shows fewer lines than widths are known, or contradicts them.
    """
    camera, printer = params.load(Camera, "camera"), params.load(Printer, "printer")
    pictures = [_frames(path, camera) for path in request.images]
    done = calibrated(pictures, request, camera, printer)
    lines = [f"{key}: {_shown(value)}" for key, value in done.values.items()]
    artifacts.write_text(out, _page(request, done, lines))
    written = "paste these lines into params.yaml, or run it again with --write"
    if write:
        path = Path(params.FILE)
        text = path.read_text(encoding="utf-8")
        for key, value in done.values.items():
            text = replaced(text, f"camera.{key}", [_shown(value)])
        artifacts.write_text(path, text)
        written = "written to params.yaml"
    table = "\n".join(
        f"  {known:g} mm: {px:.2f} px, looks {bias:+.2f} px wider"
        for known, px, bias in zip(*_columns(done.ladder), strict=True)
    )
    return (
        f"{len(done.rungs)} lines measured, repeated to {done.ladder.deviation_px:.2f} px; "
        f"{done.ladder.mm_per_px:.6g} mm per px, from {done.scale_from}\n{table}\n"
        + "camera:\n"
        + "".join(f"  {text}\n" for text in lines)
        + f"{written}; page: {out}"
        + (
            ""
            if request.tip_px
            else "; without --tip X,Y the nozzle's column and the direction stay as they are"
        )
    )


def calibrated(
    pictures: Sequence[Sequence[np.ndarray]], request: CalibrationRequest, camera: Camera, printer: Printer
) -> Calibrated:
    """The calibration from frames of each picture or recording: one line in each, in the order of the known
    widths; or all of them in a single one, matched by their order of width."""
    widths = list(request.widths_mm)
    together = len(pictures) == 1 and len(widths) > 1
    if not together and len(pictures) != len(widths):
        raise ValueError(
            f"calibrate-camera: expected one picture of all lines, or one for each of {len(widths)} widths, "
            f"but found {len(pictures)}; name them in the order of --widths"
        )
    rim_px = RIM * printer.nozzle_outer_mm / 2 / abs(camera.mm_per_px)
    measured: list[tuple[float, np.ndarray, Rung]] = []
    for k, frames in enumerate(pictures):
        for frame in frames:
            wanted = len(widths) if together else 1
            found = ladder.rungs(
                bead.gray(frame),
                wanted,
                tip=request.tip_px,
                hidden_px=rim_px,
                longest_blur_px=camera.longest_blur_px,
            )
            _check(request.images[k], found, widths if together else widths[k : k + 1])
            found = sorted(found, key=lambda rung: rung.width_px)
            known = sorted(widths) if together else widths[k : k + 1]
            measured += [(width, frame, rung) for width, rung in zip(known, found, strict=True)]
    scale, scale_from = _scale(measured, request, together)
    fitted = ladder.calibrated(
        np.array([width for width, _, _ in measured]),
        np.array([rung.width_px for _, _, rung in measured]),
        np.array([rung.angle_deg for _, _, rung in measured]),
        mm_per_px=scale,
        from_tip=request.tip_px is not None and not together,
    )
    return Calibrated(fitted, _values(fitted, measured, request, camera, printer), measured, scale_from)


def _check(path: Path, found: Sequence[Rung], widths: Sequence[float]) -> None:
    named = ", ".join(f"{width:g}" for width in widths)
    if len(found) < len(widths):
        raise ValueError(
            f"{path}: expected {len(widths)} line{'s' * (len(widths) > 1)} ({named} mm) but found "
            f"{len(found)} that stand out from their ground along their length; light them from one side, "
            "or name a picture each"
        )
    for rung in found:
        if rung.reason:
            raise ValueError(
                f"{path}: the line at {rung.found.x:.0f}, {rung.found.y:.0f} px ({named} mm) cannot be "
                f"measured: {rung.reason}; see that both of its edges are in the picture and sharp"
            )


def _scale(
    measured: Sequence[tuple[float, np.ndarray, Rung]], request: CalibrationRequest, together: bool
) -> tuple[float | None, str]:
    """Size of a pixel in mm from what has no edges, and what told it; None: the slope of the widths."""
    if not math.isnan(request.pitch_mm):
        if not together:
            raise ValueError(
                "calibrate-camera: --pitch needs one picture that shows all lines, but there are "
                f"{len(request.images)}; leave it out"
            )
        found = [rung.found for _, _, rung in measured[: len(request.widths_mm)]]
        return request.pitch_mm / ladder.pitch_px(found), "the pitch of the ladder"
    return None, "known over measured widths"


def _values(
    fitted: Ladder,
    measured: Sequence[tuple[float, np.ndarray, Rung]],
    request: CalibrationRequest,
    camera: Camera,
    printer: Printer,
) -> dict[str, Any]:
    """What section `camera` gets. Without a tip the line keeps its side and column; with it the line trails
    from the tip to higher columns."""
    shape = measured[0][1].shape[:2]
    light = [rung.found.contrast > 0 for _, _, rung in measured]
    values: dict[str, Any] = {
        "mm_per_px": math.copysign(round(fitted.mm_per_px, 8), camera.mm_per_px),
        "rotation_deg": round(fitted.rotation_deg, 2),
        "bead": "light" if all(light) else "dark" if not any(light) else "",
        "known_widths_mm": [round(float(width), 4) for width in fitted.known_mm],
        "edge_bias_px": [round(float(bias), 3) for bias in fitted.edge_bias_px],
    }
    if request.tip_px is None:
        return values
    direction = fitted.rotation_deg
    if len(request.images) == 1 and len(request.widths_mm) > 1:
        # of lines side by side none shows to which side it was printed: to where there is more of the picture
        a = math.radians(direction)
        middle = np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2]) - np.array(request.tip_px)
        direction += 180 if middle @ np.array([math.cos(a), math.sin(a)]) < 0 else 0
    half = 0.5 * WIDER * float(fitted.measured_px.max()) + BESIDE_PX
    hidden = math.ceil(RIM * printer.nozzle_outer_mm / 2 / fitted.mm_per_px)
    pose = line.Pose(direction, *request.tip_px, 0.0, 0.0, 0, 0)
    size = (int(shape[0]), int(shape[1]))
    first, last = (COLUMN + at for at in line.span(pose, size, (hidden, math.floor(math.hypot(*size))), half))
    if last - first < BLOCK * FEWEST_BLOCKS:
        raise ValueError(
            f"calibrate-camera: of the line from the tip at {request.tip_px[0]:g}, {request.tip_px[1]:g} px "
            f"on, towards {direction:.0f} degrees, only {max(last - first, 0)} columns lie in the picture "
            "with both edges; check --tip, or turn the camera"
        )
    return values | {
        "mm_per_px": -abs(values["mm_per_px"]),
        "rotation_deg": round(direction % 360, 2),
        "tip_px": [round(float(at), 1) for at in request.tip_px],
        "nozzle_column": COLUMN,
        "columns": [first, last],
    }


# ---- what was requested


def numbers(text: str, flag: str, example: str) -> list[float]:
    """[0.5, 0.9] of "0.5,0.9". Raises ValueError if that is no list of finite numbers."""
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = [math.nan]
    if not np.isfinite(found).all():
        raise ValueError(
            f"{flag}: expected numbers such as {example}, found {text!r}; write them without blanks"
        )
    return found


def pixel(text: str) -> tuple[float, float] | None:
    """(571, 511) of "571,511", None of an empty text."""
    if not text:
        return None
    found = numbers(text, "--tip", "571,511")
    if len(found) != 2:
        raise ValueError(f"--tip: expected two numbers of pixels such as 571,511, found {text!r}")
    return found[0], found[1]


# ---- pictures


def _frames(path: Path, camera: Camera) -> list[np.ndarray]:
    """The picture of a file in gray, or SAMPLE frames of an MCAP recording, spread over it."""
    if path.suffix.lower() == ".mcap":
        topic = image_topic(path, topics(path), camera.topics.image)
        frames = Frames(TopicColumns(McapFile(path), "log_time"), topic, camera.unreadable_share)
        wanted = set(np.linspace(0, len(frames) - 1, min(SAMPLE, len(frames))).astype(int).tolist())
        chosen = [frame for k, (_, frame) in enumerate(frames) if k in wanted]
        if not chosen:
            raise ValueError(f"{path}: expected frames but none can be read; copy the recording again")
        return chosen
    data = path.read_bytes()
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if picture is None:
        raise ValueError(
            f"{path}: expected a picture (JPEG, PNG, TIFF, BMP, WebP) or an MCAP recording but found "
            f"{len(data)} bytes that are neither; check the name, or copy it again"
        )
    with artifacts.about(path):
        return [bead.gray(picture)]


# ---- page


def _columns(fitted: Ladder) -> tuple[list[float], list[float], list[float]]:
    return fitted.known_mm.tolist(), fitted.measured_px.tolist(), fitted.edge_bias_px.tolist()


def _shown(value: Any) -> str:
    """As YAML on one line."""
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, list):
        return "[" + ", ".join(_shown(one) for one in value) + "]"
    return f"{value:.10g}"


def _page(request: CalibrationRequest, done: Calibrated, lines: Sequence[str]) -> str:
    """The page: the first picture to click on, each line with its measured edges, the table and the lines to
    paste."""
    first = done.rungs[0][1]
    figures = []
    for known, frame, rung in _one_each(done.rungs):
        turned = bead.drawn(line.turned(frame, rung.pose), rung.bead)
        figures.append(
            f'<figure><img alt="line of {known:g} mm, turned, with its measured edges" '
            f'src="{_embedded(cv2.cvtColor(turned, cv2.COLOR_RGB2BGR))}"><figcaption>{known:g} mm: '
            f"{rung.width_px:.2f} px at {rung.angle_deg:.1f}°</figcaption></figure>"
        )
    rows = "".join(
        f"<tr><td>{known:g} mm</td><td>{px:.2f} px</td><td>{bias:+.2f} px</td></tr>"
        for known, px, bias in zip(*_columns(done.ladder), strict=True)
    )
    images = " ".join(shlex.quote(str(path)) for path in request.images)
    widths = ",".join(f"{width:g}" for width in request.widths_mm)
    command = json.dumps(f"./run beadline calibrate camera {images} --widths {widths} --tip ")
    values = {
        "name": html.escape(", ".join(path.name for path in request.images)),
        "picture": _embedded(first if first.dtype == np.uint8 else (first >> 8).astype(np.uint8)),
        "width": first.shape[1],
        "height": first.shape[0],
        "tip": json.dumps(list(request.tip_px)) if request.tip_px else "null",
        "command": command.replace("<", "\\u003c"),
        "rows": rows,
        "figures": "".join(figures),
        "lines": html.escape("camera:\n" + "".join(f"  {text}\n" for text in lines)),
        "scale": f"{done.ladder.mm_per_px:.6g} mm per px, from {done.scale_from}; "
        f"repeated pictures scatter by {done.ladder.deviation_px:.2f} px",
    }
    template = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
    return string.Template(template).substitute(values)


def _one_each(rungs: Sequence[tuple[float, np.ndarray, Rung]]) -> list[tuple[float, np.ndarray, Rung]]:
    """The first picture of every known width."""
    first: dict[float, tuple[float, np.ndarray, Rung]] = {}
    for one in rungs:
        first.setdefault(one[0], one)
    return [first[width] for width in sorted(first)]


def _embedded(picture: np.ndarray) -> str:
    """A PNG inside the page."""
    return "data:image/png;base64," + base64.b64encode(cv2.imencode(".png", picture)[1].tobytes()).decode()
