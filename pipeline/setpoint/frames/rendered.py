"""Rendered nozzle frames with their labels. Worker processes import this module, so it imports no learner."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.setpoint.frames import familiar, nozzle_scene

# bins of the true flow in percent: fine around 100 %, which controllers
# must find, wide at flows where all windows look alike
FLOW_EDGES = np.concatenate(
    [[20.0, 35, 50, 60, 70], np.arange(75, 125, 2.5), np.arange(125, 150, 5.0), np.arange(150, 311, 40.0)]
)
# range in which a controller stays; with few windows it would see the same random window again and again
FINE = (75.0, 125.0)
# a line with a score below LEAST_SCORE is none, whatever the user's least score; to learn a camera, frames
# with a score below CAMERA_SCORE gray levels are not measured
LEAST_SCORE, CAMERA_SCORE = 0.0, 10.0


class LabelledFrames(NamedTuple):
    """n frames: key areas (n, 16, 48) uint8; class and true flow in percent (n,); temperature (n,) in °C;
    print and segment (n,); `valid` (n,), and the reason if not; `score` (n,), the line's ridge in gray
    levels; `surroundings` (n, measures) of familiar.NAMES, NaN for frames that were not measured."""

    images: np.ndarray
    label: np.ndarray
    flow: np.ndarray
    temperature: np.ndarray
    print_number: np.ndarray
    segment: np.ndarray
    valid: np.ndarray
    reasons: np.ndarray
    score: np.ndarray
    surroundings: np.ndarray

    def take(self, rows: np.ndarray) -> "LabelledFrames":
        return LabelledFrames(*(a[rows] for a in self))

    def labelled(self) -> tuple[np.ndarray, ...]:
        """Returns images, temperature, class, flow and segment of the valid frames, as a learner needs
        them."""
        some = self.take(self.valid)
        return some.images, some.temperature, some.label, some.flow, some.segment


def filmed(seed: Sequence[int], flow: np.ndarray, frames: int, *, measured: bool) -> LabelledFrames:
    """Renders a segment at each flow (n,) in percent, with the temperatures in turn. `measured`: also
    measures the surroundings."""
    rng = np.random.default_rng(seed)
    pieces = []
    for percent, degrees in zip(flow, np.resize(nozzle_scene.TEMPERATURES, len(flow)), strict=True):
        scene = nozzle_scene.render(nozzle_scene.draw_segment(rng), np.full(frames, percent), degrees, rng)
        pieces.append(_labelled(scene, measured=measured))
    return joined(pieces)


def swept(seed: Sequence[int], windows: float, frames: int) -> LabelledFrames:
    """Renders one segment at one temperature over all bins of the flow, in windows of `frames` frames, each
    with its own flow.

    `windows`: mean number in each bin within FINE; in other bins at most one.
    """
    rng = np.random.default_rng(seed)
    segment, degrees = nozzle_scene.draw_segment(rng), rng.choice(nozzle_scene.TEMPERATURES)
    flows = []
    for low, high in itertools.pairwise(FLOW_EDGES):
        count = int((windows if FINE[0] <= low < FINE[1] else min(windows, 1.0)) + rng.random())
        flows.append(rng.uniform(low, high, count))
    flow = np.repeat(np.concatenate(flows), frames)
    return _labelled(nozzle_scene.render(segment, flow, degrees, rng), measured=True)


def _labelled(scene: nozzle_scene.RenderedFrames, *, measured: bool) -> LabelledFrames:
    """Returns the labelled frames of one segment."""
    areas = nozzle_scene.key_areas(scene, least_score=LEAST_SCORE)
    number, reasons = np.zeros(len(scene.flow), int), np.array(areas.reasons, object)
    truth = nozzle_scene.label(scene.flow), scene.flow, scene.temperature, number, number
    least = CAMERA_SCORE if measured else np.inf
    looks = familiar.of_frames(scene.frames, scene.tip, areas, least_score=least)
    return LabelledFrames(areas.images, *truth, areas.valid, reasons, areas.score, looks)


def joined(several: Sequence[LabelledFrames]) -> LabelledFrames:
    """Concatenates these frames and numbers their prints and segments consecutively."""
    shift, pieces = 0, []
    for one in several:
        pieces.append(one._replace(print_number=one.print_number + shift, segment=one.segment + shift))
        shift += int(one.segment.max(initial=0)) + 1
    return LabelledFrames(*(np.concatenate(columns) for columns in zip(*pieces, strict=True)))


def standing_out(frames: LabelledFrames, least_score: float) -> LabelledFrames:
    """Returns the frames; those with a line below `least_score` gray levels are marked not valid."""
    faint = frames.valid & ~(frames.score >= least_score)
    reasons = frames.reasons.copy()
    reasons[faint] = f"no fresh line: it stands out by less than {least_score:g} gray levels"
    images = np.where(faint[:, None, None], np.uint8(0), frames.images)
    return frames._replace(images=images, valid=frames.valid & ~faint, reasons=reasons)


def camera_window(seed: Sequence[int]) -> np.ndarray:
    """Returns the measures (measures,) of a few frames of one new segment at one flow, drawn from the whole
    range. They show how the rendering camera looks."""
    rng = np.random.default_rng(seed)
    flow = np.full(familiar.FRAMES + 1, np.exp(rng.uniform(*np.log(nozzle_scene.FLOWS))))
    segment, degrees = nozzle_scene.draw_segment(rng), rng.choice(nozzle_scene.TEMPERATURES)
    scene = nozzle_scene.render(segment, flow, degrees, rng)
    areas = nozzle_scene.key_areas(scene, least_score=CAMERA_SCORE)
    return familiar.of_window(scene.frames, np.array(scene.tip), areas)


def flow_edges(flows: Sequence[np.ndarray]) -> np.ndarray:
    """Returns FLOW_EDGES without those that would leave a bin empty in any of several sets of flows (w,)."""
    bounds = [min(FLOW_EDGES[0], *(float(flow.min()) for flow in flows))]
    for edge in FLOW_EDGES[1:-1]:
        if all(((flow >= bounds[-1]) & (flow < edge)).any() for flow in flows):
            bounds.append(edge)
    while len(bounds) > 1 and not all((flow >= bounds[-1]).any() for flow in flows):
        bounds.pop()
    return np.array([*bounds, max(FLOW_EDGES[-1], *(float(flow.max()) for flow in flows))])
