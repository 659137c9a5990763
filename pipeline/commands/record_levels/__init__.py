"""`beadline calibrate levels`: a few flows, held for a minute each before a camera, become the correction of
what its windows show; and a page beside it."""

import html
import string
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.commands.levels_files import RecordedLevels, store_levels
from pipeline.recordings.watch_sources import CameraFrame, Folder, FrameSource, RecordingSource
from pipeline.setpoint import levels
from pipeline.setpoint.frames import familiar
from pipeline.setpoint.frames.familiar import FALSE_ALARMS, KnownCamera
from pipeline.setpoint.frames.front_end import find_key_areas
from pipeline.setpoint.levels import Levels, LevelWindows
from pipeline.setpoint.material import PLA, PrintedMaterial
from pipeline.setpoint.vision.calibrated_classifier import FrameReadings
from pipeline.setpoint.vision.calibration import foreign_above
from pipeline.setpoint.vision.window_flow import WindowFlow
from pipeline.store import artifacts
from pipeline.store.printable import counted, printable_page

# classes of the published material lie between these, in percent
BORDERS = np.array(PLA.good_flow_percent)
# the share of each hold, after the change of flow, in which the melt still follows
SETTLES = 1 / 6
# of the page's drawing
WIDTH, HEIGHT, MARGIN = 560, 360, 40


class Protocol(NamedTuple):
    """How it was recorded: flows in percent in their order, seconds that each was held, seconds after each
    change in which the melt follows, temperature in degC if the source has none, the tip in px."""

    flows: tuple[float, ...]
    hold_s: float
    settle_s: float
    temperature: float
    tip: tuple[float, float] | None


class Eye(NamedTuple):
    """What sees: read(images (n, 16, 48), temperature (n,)) -> what n key areas show; window_flow, what makes
    a window's flow of it; frames of a window; the front end's least score; the digest of its weights; the
    share of this camera's frames that may be called foreign; what is printed. It knows the published material
    alone: flows and temperatures of another enter and leave as what they stand for."""

    read: Callable[[np.ndarray, np.ndarray], FrameReadings]
    window_flow: Callable[..., WindowFlow]
    window: int
    least_score: float
    weights: str
    false_alarms: float
    material: PrintedMaterial = PLA


class Level(NamedTuple):
    """What was seen at one flow of the material that is printed: frames and those with a key area, windows,
    the median of what they show and of what it becomes, in percent, and the share of windows whose class is
    named rightly."""

    flow: float
    frames: int
    valid: int
    windows: int
    seen: float
    corrected: float
    named: float


class _Window(NamedTuple):
    """One window: its level and what it shows, in percent of the published material, its frames, the
    distances (m,) of those with a key area from what was learned, and how it looks (measures,)."""

    flow: float
    seen: float
    frames: int
    distance: np.ndarray
    looks: np.ndarray


def record(
    source: FrameSource, protocol: Protocol, eye: Eye, *, place: str
) -> tuple[RecordedLevels, list[Level]]:
    """The levels that the frames of a source show. Raises ValueError, one sentence, if they do not
    suffice."""
    windows = _windows(source, protocol, eye, place)
    with artifacts.about(place):
        seen = LevelWindows(
            np.array([window.seen for window in windows]), np.array([window.flow for window in windows])
        )
        fitted = levels.fit(seen)
    told = []
    for flow in np.unique(seen.flow):
        here = [window for window in windows if window.flow == flow]
        shows = np.array([window.seen for window in here])
        shows = shows[np.isfinite(shows)]
        corrected = levels.corrected(fitted, shows)
        right = np.digitize(corrected, BORDERS) == np.digitize(flow, BORDERS)
        told.append(
            Level(
                float(eye.material.own_flow(flow)),
                sum(window.frames for window in here),
                sum(len(window.distance) for window in here),
                len(here),
                float(eye.material.own_flow(np.median(shows))),
                float(eye.material.own_flow(np.median(corrected))),
                float(np.mean(right)),
            )
        )
    finite = np.isfinite(seen.seen)
    kept = LevelWindows(seen.seen[finite], seen.flow[finite])
    distances = np.concatenate([window.distance for window in windows])
    above = float(foreign_above(distances, false_alarms=eye.false_alarms))
    return RecordedLevels(fitted, kept, eye.weights, _camera(windows), above), told


def _camera(windows: Sequence[_Window]) -> KnownCamera | None:
    """How this camera looks, each window counted as a segment; None if there are too few to know it by."""
    looks = np.array([window.looks for window in windows])
    try:
        return familiar.fit_camera(looks, np.arange(len(looks)), false_alarms=FALSE_ALARMS)
    except ValueError:
        return None


def write(
    recorded: RecordedLevels, told: Sequence[Level], out: Path, place: str, material: PrintedMaterial = PLA
) -> str:
    """Writes the levels to `out` and a page beside it; what a person is told, in flows of what is printed."""
    page = out.with_suffix(".html")
    store_levels(out, recorded)
    artifacts.write_text(page, _page(recorded, told, place, material))
    low, high = material.own_flow(levels.shown(recorded.levels, BORDERS))
    thin, thick = material.good_flow_percent
    right, count = sum(one.named * one.windows for one in told), sum(one.windows for one in told)
    return (
        f"{place}: {count} windows at {len(told)} levels; corrected flow to "
        f"{100 * recorded.levels.spread:.0f} % (one deviation), classes right in "
        f"{100 * right / count:.0f} % of these windows\n"
        f"the borders of good, {thin:g} and {thick:g} %, are where this camera shows {low:.0f} and "
        f"{high:.0f} %\n"
        f"written: {out}, {page}"
    )


# ---- frames


def _windows(source: FrameSource, protocol: Protocol, eye: Eye, place: str) -> list[_Window]:
    """The windows of the levels, a few frames in memory at a time."""
    found: list[_Window] = []
    waiting: list[tuple[float, CameraFrame]] = []
    times: list[float] = []
    for flow, shown in _of_levels(_timed(_frames(source, place), times), protocol):
        if waiting and waiting[-1][0] != flow:
            waiting = []
        waiting.append((flow, shown))
        if len(waiting) == eye.window:
            found.append(_seen([one for _, one in waiting], flow, protocol, eye))
            waiting = []
    levels_found, span = len({window.flow for window in found}), max(times) - min(times)
    if not found or (levels_found < levels.LEAST_LEVELS and span < protocol.hold_s):
        raise ValueError(
            f"{place}: expected windows of {eye.window} frames at {len(protocol.flows)} flows, each held for "
            f"{protocol.hold_s:g} s, found {counted(len(times), 'frame')} within {span:.3g} s, "
            f"{counted(levels_found, 'flow')} in them; record all of --flows, and copy pictures with their "
            "times (cp -p)"
        )
    return found


def _timed(frames, times: list[float]):
    """The frames; their times are put into `times`."""
    for shown in frames:
        times.append(shown.time_s)
        yield shown


def _frames(source: FrameSource, place: str):
    """Every frame that a source has now. Raises ValueError if it has none."""
    count = 0
    while True:
        came = 0
        for shown in source.frames():
            came += 1
            yield shown
        count += came
        if source.waits_for or not came and (source.ended or not isinstance(source, Folder)):
            break
    if not count:
        why = source.waits_for or f"it lacks {source.lacks}"
        raise ValueError(
            f"{place}: expected frames of a printer's camera, found none: {why}; name a folder of pictures "
            "or an MCAP file"
        )


def _of_levels(frames, protocol: Protocol):
    """(flow, frame) of the frames of the levels, those left out in which the melt still follows. The flow is
    the recording's, if it has one; else that of the protocol by the time since the first frame."""
    first = changed = before = np.nan
    for shown in frames:
        first = shown.time_s if np.isnan(first) else first
        since = shown.time_s - first
        if np.isfinite(shown.flow):
            flow = shown.flow
        else:
            k = int(since // protocol.hold_s)
            if not 0 <= k < len(protocol.flows):
                continue
            flow = protocol.flows[k]
        if flow != before:
            changed, before = shown.time_s, flow
        told = any(abs(flow - one) < 0.5 for one in protocol.flows)
        if told and shown.time_s - changed >= protocol.settle_s:
            yield flow, shown


def _seen(window: Sequence[CameraFrame], flow: float, protocol: Protocol, eye: Eye) -> _Window:
    tips = np.array([shown.tip if protocol.tip is None else protocol.tip for shown in window])
    directions = np.array([shown.direction_deg for shown in window])
    areas = find_key_areas([shown.frame for shown in window], tips, directions, least_score=eye.least_score)
    valid = np.array([not reason for reason in areas.reasons])
    temperature = eye.material.published_temperature(
        np.array(
            [one.temperature if np.isfinite(one.temperature) else protocol.temperature for one in window]
        )
    )
    readings = eye.read(areas.images, temperature)
    # no looks: what they say is of the camera that the classifier learned from
    looks, unknown = (
        familiar.median(areas.surroundings.astype(float)),
        np.full((1, len(familiar.NAMES)), np.nan),
    )
    shown = eye.window_flow(readings.log_flow[None], readings.deviation[None], valid[None], unknown)
    flow = float(eye.material.published_flow(np.array(flow)))
    return _Window(flow, float(shown.flow_seen[0]), len(window), readings.distance[valid], looks)


def source_of(place: Path, recording: Callable[[Path], RecordingSource]) -> FrameSource:
    """A folder of pictures or an MCAP recording. Raises ValueError if there is none."""
    if not place.exists():
        raise ValueError(f"{place} is missing; name the folder of pictures, or the recording")
    return recording(place) if place.is_file() else Folder(place)


# ---- the page


def _page(recorded: RecordedLevels, told: Sequence[Level], place: str, material: PrintedMaterial) -> str:
    fitted = recorded.levels
    low, high = material.own_flow(levels.shown(fitted, BORDERS))
    rows = "".join(
        f"<tr><td>{one.flow:g}</td><td>{one.windows}</td><td>{one.valid} of {one.frames}</td>"
        f"<td>{one.seen:.0f}</td><td>{one.corrected:.0f}</td><td>{100 * one.named:.0f} %</td></tr>"
        for one in told
    )
    values = {
        "place": html.escape(place),
        "spread": f"{100 * fitted.spread:.0f}",
        "low": f"{low:.0f}",
        "high": f"{high:.0f}",
        "thin": f"{material.good_flow_percent[0]:g}",
        "thick": f"{material.good_flow_percent[1]:g}",
        "kind": "a line in the logarithms" if fitted.straight else "straight pieces from level to level",
        "rows": rows,
        "drawing": _drawing(fitted, recorded.windows, material),
    }
    template = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
    return printable_page(string.Template(template).substitute(values))


def _drawing(fitted: Levels, published: LevelWindows, material: PrintedMaterial) -> str:
    """Windows as dots over the flow commanded, and the curve; both axes logarithmic, in percent."""
    windows = LevelWindows(*(material.own_flow(column) for column in published))
    curve_flow = np.geomspace(windows.flow.min() / 1.1, windows.flow.max() * 1.1, 40)
    curve = material.own_flow(levels.shown(fitted, material.published_flow(curve_flow)))
    across = np.log([curve_flow[0], curve_flow[-1]])
    up = np.log([min(windows.seen.min(), curve.min()) / 1.05, max(windows.seen.max(), curve.max()) * 1.05])

    def x(flow: np.ndarray) -> np.ndarray:
        return MARGIN + (WIDTH - MARGIN - 5) * (np.log(flow) - across[0]) / (across[1] - across[0])

    def y(seen: np.ndarray) -> np.ndarray:
        return HEIGHT - MARGIN - (HEIGHT - MARGIN - 5) * (np.log(seen) - up[0]) / (up[1] - up[0])

    # dots of one level stand beside one another
    beside = np.linspace(-6, 6, 7)[np.arange(len(windows.flow)) % 7]
    dots = "".join(
        f'<circle cx="{a:.1f}" cy="{b:.1f}" r="2"/>'
        for a, b in zip(x(windows.flow) + beside, y(windows.seen), strict=True)
    )
    line = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x(curve_flow), y(curve), strict=True))
    ticks = "".join(
        f'<text x="{x(flow):.0f}" y="{HEIGHT - MARGIN + 18}" text-anchor="middle">{flow:g}</text>'
        for flow in np.unique(windows.flow)
    )
    marks = "".join(
        f'<line x1="{MARGIN}" x2="{WIDTH}" y1="{y(seen):.1f}" y2="{y(seen):.1f}" class="border"/>'
        f'<text x="{MARGIN - 4}" y="{y(seen) + 4:.1f}" text-anchor="end">{seen:.0f}</text>'
        for seen in material.own_flow(levels.shown(fitted, BORDERS))
    )
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="flow shown over flow commanded">'
        f'{marks}<polyline points="{line}"/>{dots}{ticks}'
        f'<text x="{WIDTH / 2}" y="{HEIGHT - 4}" text-anchor="middle">flow commanded, %</text></svg>'
    )
