"""Folders of nozzle frames for tests, as users have them: pictures of
the synthetic scene, and the CSV beside them."""

import functools
from pathlib import Path

import cv2
import numpy as np

from pipeline.recordings import nozzle_frames
from pipeline.recordings.nozzle_frames import Topics
from pipeline.setpoint.frames import key_area, nozzle_scene
from pipeline.setpoint.material import PLA
from pipeline.setpoint.recordings import FrontEnd
from pipeline.store.params import Execution

LEAST = 10.0
ANY = Topics(image="", time="", mapping={})
FLOWS, SHOTS = (60.0, 100.0, 150.0), 3


@functools.cache
def scenes(prints: int = 2) -> tuple[nozzle_scene.RenderedFrames, ...]:
    """Three segments, one of each class, for each print."""
    rng = np.random.default_rng(5)
    return tuple(
        nozzle_scene.render(nozzle_scene.draw_segment(rng), np.full(SHOTS, flow), 210.0, rng)
        for _ in range(prints)
        for flow in FLOWS
    )


def rows(prints: int = 2) -> list[dict[str, str]]:
    """A line for each frame, in the columns of CAXTON."""
    found = []
    for k, scene in enumerate(scenes(prints)):
        for shot in range(SHOTS):
            number = k % 3 * SHOTS + shot
            found.append({
                "img_path": f"print{k // 3}/image-{number}.png",
                "timestamp": f"2020-10-08T13:12:{number:02d}-{5 * number:02d}",
                "flow_rate": f"{scene.flow[0]:g}", "feed_rate": "100", "z_offset": "0.0",
                "target_hotend": "210.0", "hotend": f"{209 + number / 10:g}", "bed": "60.0",
                "nozzle_tip_x": f"{scene.tip[0]:.2f}", "nozzle_tip_y": f"{scene.tip[1]:.2f}",
                "print_id": str(k // 3), "img_num": str(number),
            })  # fmt: skip
    return found


def images(folder: Path, prints: int = 2) -> None:
    for row, frame in zip(
        rows(prints), (frame for scene in scenes(prints) for frame in scene.frames), strict=True
    ):
        path = folder / row["img_path"]
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), frame)


def table(
    path: Path, lines: list[dict[str, str]], *, separator: str = ",", end: str = "\n", mark: str = ""
) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    text = end.join([separator.join(lines[0]), *(separator.join(line.values()) for line in lines)])
    path.write_bytes((mark + text + end).encode())
    return path


def folder(path: Path, prints: int = 2) -> Path:
    """Images, and one CSV of all prints."""
    images(path, prints)
    table(path / "log.csv", rows(prints))
    return path


def read(
    path: Path, *, tip=None, topics: Topics = ANY, jobs: int = 1, memo: Path | None = None
) -> nozzle_frames.NozzleFrames:
    front_end = FrontEnd(LEAST, (memo or path.parent / "memo").resolve())
    how = nozzle_frames.ReadOptions(tip, front_end, topics, PLA)
    return nozzle_frames.read_folder(path, how, Execution(backend="loky", jobs=jobs, scheduler=""))


def expected() -> np.ndarray:
    """The key areas of all frames, cut without any file between; two
    decimals of the tip are what the CSV holds."""
    found = [
        key_area.find(frame, tuple(np.round(scene.tip, 2)), least_score=LEAST)
        for scene in scenes()
        for frame in scene.frames
    ]
    return np.array([one.image for one in found])


def notes(found: nozzle_frames.NozzleFrames) -> str:
    return "\n".join(note.message for note in found.notes)
