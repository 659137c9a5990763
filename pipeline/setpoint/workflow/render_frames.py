"""Rendered nozzle frames with their labels, in seven parts that share no segment: the four of the classifier
and the three whose windows stand for it in the simulator. Workers run it, so it knows no learner."""

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from joblib import delayed
from tqdm import tqdm

from pipeline.setpoint.frames import nozzle_scene
from pipeline.setpoint.workflow.settings import RenderFrames
from pipeline.setpoint.workflow.tables import FLOW_EDGES, WINDOW_PARTS
from pipeline.store.artifacts import read_weights, write_weights
from pipeline.store.execution import run_all
from pipeline.store.params import Execution

PARTS = ("learned", "held_out", "calibration", "judged")
FRAMES_SCHEMA = "frames 1"
# segments that a worker renders in one go: three at each temperature
AT_ONCE = 15
# in which a controller stays, and would see one window's chance again and again
FINE = (75.0, 125.0)
# a line that stands out less than its darker flank is none, whatever the least score
LEAST_SCORE = 0.0


class LabelledFrames(NamedTuple):
    """n frames: key areas (n, 16, 48) uint8, class and true flow in percent (n,), temperature (n,) in °C,
    print and segment (n,), valid (n,) and the reason why not; score (n,) in gray levels of the line's
    ridge."""

    images: np.ndarray
    label: np.ndarray
    flow: np.ndarray
    temperature: np.ndarray
    print_number: np.ndarray
    segment: np.ndarray
    valid: np.ndarray
    reasons: np.ndarray
    score: np.ndarray

    def take(self, rows: np.ndarray) -> "LabelledFrames":
        return LabelledFrames(*(a[rows] for a in self))

    def labelled(self) -> tuple[np.ndarray, ...]:
        """Of the valid ones what a learner needs: images, temperature, class, flow, segment."""
        some = self.take(self.valid)
        return some.images, some.temperature, some.label, some.flow, some.segment


def rendered(settings: RenderFrames, execution: Execution) -> dict[str, LabelledFrames]:
    """The parts of PARTS and of WINDOW_PARTS, their segments numbered through. Frames of every score are
    kept: how far a line must stand out is not decided here."""
    calls = [*_segments(settings), *_sweeps(settings)]
    results = run_all([call for _, call in calls], execution)
    shown = tqdm(results, total=len(calls), desc="render_frames", mininterval=2)
    by_part: dict[str, list[LabelledFrames]] = {}
    for (part, _), frames in zip(calls, shown, strict=True):
        by_part.setdefault(part, []).append(frames)
    parts = {part: joined(pieces) for part, pieces in by_part.items()}
    first = np.cumsum([0, *(int(frames.segment.max()) + 1 for frames in parts.values())])
    return {
        part: frames._replace(print_number=frames.print_number + shift, segment=frames.segment + shift)
        for (part, frames), shift in zip(parts.items(), first, strict=False)
    }


def _segments(settings: RenderFrames) -> Iterator[tuple[str, tuple]]:
    """(part, call) of the segments of PARTS, AT_ONCE a call, every temperature as often as the others."""
    counts, frames = settings.segments.model_dump(), settings.frames.model_dump()
    for k, part in enumerate(PARTS):
        draw = nozzle_scene.draw_judged_flow if part == "judged" else nozzle_scene.draw_flow
        flow = draw(np.random.default_rng((settings.seed, k)), AT_ONCE * counts[part])
        for i in range(counts[part]):
            some = flow[AT_ONCE * i : AT_ONCE * (i + 1)]
            yield part, delayed(filmed)((settings.seed, k, i), some, frames[part])


def _sweeps(settings: RenderFrames) -> Iterator[tuple[str, tuple]]:
    """(part, call) of the segments of WINDOW_PARTS, each at many flows."""
    counts, windows = settings.sweeps.model_dump(), settings.sweep_windows.model_dump()
    for k, part in enumerate(WINDOW_PARTS):
        for i in range(counts[part]):
            seed = (settings.seed, len(PARTS) + k, i)
            yield part, delayed(swept)(seed, windows[part], settings.frames.judged)


def filmed(seed: Sequence[int], flow: np.ndarray, frames: int) -> LabelledFrames:
    """A segment at each flow (n,) in percent, with the temperatures in turn."""
    temperature = np.resize(nozzle_scene.TEMPERATURES, len(flow))
    rng = np.random.default_rng(seed)
    scene = nozzle_scene.filmed(rng, flow, temperature, frames=frames, least_score=LEAST_SCORE)
    reasons = np.array(scene.reasons, object)
    truth = scene.label, scene.flow, scene.temperature, scene.segment, scene.segment
    return LabelledFrames(scene.images, *truth, scene.valid, reasons, scene.score)


def swept(seed: Sequence[int], windows: float, frames: int) -> LabelledFrames:
    """One segment's conditions, all at one temperature, over all bins of the
    flow: windows of `frames` frames with a flow each.

    windows: how many in each bin within FINE on average; elsewhere no more than one.
    """
    rng = np.random.default_rng(seed)
    segment, degrees = nozzle_scene.draw_segment(rng), rng.choice(nozzle_scene.TEMPERATURES)
    flows = []
    for low, high in itertools.pairwise(FLOW_EDGES):
        count = int((windows if FINE[0] <= low < FINE[1] else min(windows, 1.0)) + rng.random())
        flows.append(rng.uniform(low, high, count))
    flow = np.repeat(np.concatenate(flows), frames)
    scene = nozzle_scene.render(segment, flow, degrees, rng)
    areas = nozzle_scene.key_areas(scene, least_score=LEAST_SCORE)
    number, reasons = np.zeros(len(flow), int), np.array(areas.reasons, object)
    truth = nozzle_scene.label(flow), flow, scene.temperature, number, number
    return LabelledFrames(areas.images, *truth, areas.valid, reasons, areas.score)


def joined(several: Sequence[LabelledFrames]) -> LabelledFrames:
    """One behind the other, their prints and segments numbered on."""
    shift, pieces = 0, []
    for one in several:
        pieces.append(one._replace(print_number=one.print_number + shift, segment=one.segment + shift))
        shift += int(one.segment.max(initial=0)) + 1
    return LabelledFrames(*(np.concatenate(columns) for columns in zip(*pieces, strict=True)))


def standing_out(frames: LabelledFrames, least_score: float) -> LabelledFrames:
    """The frames, those not valid whose line stands out by less than least_score gray levels."""
    faint = frames.valid & ~(frames.score >= least_score)
    reasons = frames.reasons.copy()
    reasons[faint] = f"no fresh line: it stands out by less than {least_score:g} gray levels"
    images = np.where(faint[:, None, None], np.uint8(0), frames.images)
    return frames._replace(images=images, valid=frames.valid & ~faint, reasons=reasons)


# ---- to files and back


def store_frames(folder: Path, by_part: dict[str, LabelledFrames]) -> None:
    """<part>.safetensors of each part; of the reasons only that there is one."""
    for part, frames in by_part.items():
        arrays = frames._asdict()
        del arrays["reasons"]
        write_weights(folder / f"{part}.safetensors", FRAMES_SCHEMA, arrays, {"part": part})


def counts(by_part: dict[str, LabelledFrames]) -> dict[str, dict[str, int]]:
    """Frames and segments of each part."""
    return {
        part: {"frames": len(frames.valid), "segments": len(np.unique(frames.segment))}
        for part, frames in by_part.items()
    }


def restore_frames(folder: Path) -> dict[str, LabelledFrames]:
    """What `store_frames` wrote."""
    found = {}
    for part in (*PARTS, *WINDOW_PARTS):
        arrays, _ = read_weights(folder / f"{part}.safetensors", FRAMES_SCHEMA)
        reasons = np.where(arrays["valid"], "", "no fresh line: darker than its flank, or cut by the frame")
        found[part] = LabelledFrames(**arrays, reasons=reasons.astype(object))
    return found
