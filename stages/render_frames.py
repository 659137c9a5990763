"""Nozzle frames with their labels: renders them, cuts their key areas and writes
datasets/render_frames/<part>.safetensors, frames.json with how many, and known_camera.parquet; no part where
the frames are recordings. A classifier that is trained anew renders nothing anew."""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

from pydantic import Field

import stages
from pipeline.setpoint.settings import Counts
from pipeline.setpoint.tables import FRAME_PARTS, WINDOW_PARTS
from pipeline.store import artifacts, params
from pipeline.store.params import Execution, Section

# segments that a worker renders in one go: three at each temperature
AT_ONCE = 15
# parts whose windows are read with what lies around their beads
MEASURED = ("calibration", "judged")
# the place of the known camera's segments among the seeds of this stage
CAMERA_STREAM = 20


class Sweeps(Section):
    """Segments whose windows over the whole range of flows stand for the camera in the simulator: those that
    controllers are trained and tuned on, that the default is chosen on, and that are judged on. Many
    segments, as what a segment adds stays with its windows."""

    learn: int = Field(ge=1, le=10_000)
    choose: int = Field(ge=1, le=10_000)
    judge: int = Field(ge=1, le=10_000)


class SweepWindows(Section):
    """Windows of each of these segments in a bin of the flow, on average."""

    learn: float = Field(gt=0, le=100)
    choose: float = Field(gt=0, le=100)
    judge: float = Field(gt=0, le=100)


class RenderFrames(Section):
    """Section `render_frames`: segments are counted in fifteens, three at each of the five temperatures."""

    seed: int = Field(ge=0, le=2**31)
    segments: Counts
    frames: Counts
    sweeps: Sweeps
    sweep_windows: SweepWindows
    camera_segments: int = Field(ge=240, le=10_000)


def main() -> None:
    with artifacts.stage("render_frames") as out:
        settings = params.load(RenderFrames, "render_frames")
        execution = params.load(Execution, "execution")
        source = params.value("train_classifier.source", one_of=("simulated", "recordings"))
        simulated = source == "simulated"
        import numpy as np

        from pipeline.setpoint.frames import familiar, files

        by_part = render(settings, execution) if simulated else {}
        files.store_frames(out, by_part)
        artifacts.write_json(out / "frames.json", counts(by_part))
        if simulated:
            measures = render_camera(settings, execution)
            camera = familiar.fit_camera(
                measures, np.arange(len(measures)), false_alarms=familiar.FALSE_ALARMS
            )
            files.store_camera(out / files.CAMERA_FILE, camera)


def render(settings: RenderFrames, execution: Execution) -> dict[str, Any]:
    """LabelledFrames by part of FRAME_PARTS and of WINDOW_PARTS, which share no segment; their segments are
    numbered through. Frames of every score are kept: how far a line must stand out is decided later."""
    import numpy as np

    from pipeline.setpoint.frames.rendered import joined

    calls = [*segment_calls(settings), *sweep_calls(settings)]
    pieces: dict[str, list[Any]] = {}
    rendered = run([call for _, call in calls], execution, "render_frames")
    for (part, _), frames in zip(calls, rendered, strict=True):
        pieces.setdefault(part, []).append(frames)
    parts = {part: joined(several) for part, several in pieces.items()}
    first = np.cumsum([0, *(int(frames.segment.max()) + 1 for frames in parts.values())])
    return {
        part: frames._replace(print_number=frames.print_number + shift, segment=frames.segment + shift)
        for (part, frames), shift in zip(parts.items(), first, strict=False)
    }


def segment_calls(settings: RenderFrames) -> Iterator[tuple[str, tuple[Callable, tuple, dict]]]:
    """(part, call) of the segments of FRAME_PARTS, AT_ONCE a call, every temperature as often as another."""
    import numpy as np
    from joblib import delayed

    from pipeline.setpoint.frames import nozzle_scene
    from pipeline.setpoint.frames.rendered import filmed

    counts, frames = settings.segments.model_dump(), settings.frames.model_dump()
    for k, part in enumerate(FRAME_PARTS):
        draw = nozzle_scene.draw_judged_flow if part == "judged" else nozzle_scene.draw_flow
        flow = draw(np.random.default_rng((settings.seed, k)), AT_ONCE * counts[part])
        for i in range(counts[part]):
            some = flow[AT_ONCE * i : AT_ONCE * (i + 1)]
            seed = (settings.seed, k, i)
            yield part, delayed(filmed)(seed, some, frames[part], measured=part in MEASURED)


def sweep_calls(settings: RenderFrames) -> Iterator[tuple[str, tuple[Callable, tuple, dict]]]:
    """(part, call) of the segments of WINDOW_PARTS, each at many flows."""
    from joblib import delayed

    from pipeline.setpoint.frames.rendered import swept

    counts, windows = settings.sweeps.model_dump(), settings.sweep_windows.model_dump()
    for k, part in enumerate(WINDOW_PARTS):
        for i in range(counts[part]):
            seed = (settings.seed, len(FRAME_PARTS) + k, i)
            yield part, delayed(swept)(seed, windows[part], settings.frames.judged)


def render_camera(settings: RenderFrames, execution: Execution) -> Any:
    """(segments, measures) of rendered segments, each seen in one window at one flow."""
    import numpy as np
    from joblib import delayed

    from pipeline.setpoint.frames.rendered import camera_window

    seeds = [(settings.seed, CAMERA_STREAM, i) for i in range(settings.camera_segments)]
    calls = [delayed(camera_window)(seed) for seed in seeds]
    return np.array([*run(calls, execution, "render_frames: known camera")])


def run(calls: list, execution: Execution, words: str) -> Iterable[Any]:
    """The results of the calls in their order, with a bar of progress."""
    from tqdm import tqdm

    from pipeline.store.execution import run_all

    return tqdm(run_all(calls, execution), total=len(calls), desc=words, mininterval=2)


def counts(by_part: dict[str, Any]) -> dict[str, dict[str, int]]:
    """Frames and segments of each part."""
    return {
        part: {"frames": len(frames.valid), "segments": len({*frames.segment.tolist()})}
        for part, frames in by_part.items()
    }


if __name__ == "__main__":
    stages.run(main, "render_frames", loop="setpoint")
