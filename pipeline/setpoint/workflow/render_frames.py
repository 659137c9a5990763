"""Rendered nozzle frames with their labels, segment by segment; what workers run, so it knows no learner."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.setpoint import nozzle_scene
from pipeline.setpoint.workflow.tables import FLOW_EDGES

FINE = (75.0, 125.0)  # in which a controller stays, and would see one window's chance again and again


class LabelledFrames(NamedTuple):
    """n frames: key areas (n, 16, 48) uint8, class and true flow in percent (n,), temperature (n,) in °C,
    print and segment (n,), valid (n,) and the reason why not."""

    images: np.ndarray
    label: np.ndarray
    flow: np.ndarray
    temperature: np.ndarray
    print_number: np.ndarray
    segment: np.ndarray
    valid: np.ndarray
    reasons: np.ndarray

    def take(self, rows: np.ndarray) -> "LabelledFrames":
        return LabelledFrames(*(a[rows] for a in self))

    def labelled(self) -> tuple[np.ndarray, ...]:
        """Of the valid ones what a learner needs: images, temperature, class, segment."""
        some = self.take(self.valid)
        return some.images, some.temperature, some.label, some.segment


def rendered(seed: Sequence[int], frames: int, least_score: float) -> LabelledFrames:
    """A segment of each of the 15 combinations."""
    scene = nozzle_scene.data_set(
        np.random.default_rng(seed), segments=1, frames=frames, least_score=least_score
    )
    return LabelledFrames(
        scene.images,
        scene.label,
        scene.flow,
        scene.temperature,
        scene.segment,
        scene.segment,
        scene.valid,
        np.array(scene.reasons, object),
    )


def swept(seed: Sequence[int], windows: float, frames: int, least_score: float) -> LabelledFrames:
    """One segment's conditions, all at one temperature, over all bins of the
    flow: windows of `frames` frames with a flow each.

    windows: how many in each bin within FINE on average; elsewhere no more than one.
    """
    rng = np.random.default_rng(seed)
    segment, degrees = nozzle_scene.draw_segment(rng), rng.choice(nozzle_scene.TEMPERATURES)
    pieces = []
    for low, high in itertools.pairwise(FLOW_EDGES):
        count = int((windows if FINE[0] <= low < FINE[1] else min(windows, 1.0)) + rng.random())
        if count == 0:
            continue
        flow, temperature = np.repeat(rng.uniform(low, high, count), frames), np.full(count * frames, degrees)
        areas = nozzle_scene.key_areas(
            nozzle_scene.render(segment, flow, temperature, rng), least_score=least_score
        )
        number = np.zeros(len(flow), int)
        pieces.append(
            LabelledFrames(
                areas.images,
                nozzle_scene.label(flow),
                flow,
                temperature,
                number,
                number,
                areas.valid,
                np.array(areas.reasons, object),
            )
        )
    return LabelledFrames(*(np.concatenate(columns) for columns in zip(*pieces, strict=True)))


def joined(several: Sequence[LabelledFrames]) -> LabelledFrames:
    """One behind the other, their prints and segments numbered on."""
    shift, pieces = 0, []
    for one in several:
        pieces.append(one._replace(print_number=one.print_number + shift, segment=one.segment + shift))
        shift += int(one.segment.max()) + 1
    return LabelledFrames(*(np.concatenate(columns) for columns in zip(*pieces, strict=True)))
