"""Reads recordings of nozzle frames for this loop: the options of recordings/nozzle_frames.py from section
`train_classifier`, and the front end with its cache of results for the same frames and code."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import joblib
import numpy as np

from pipeline.recordings import nozzle_frames
from pipeline.recordings.nozzle_frames import NozzleFrames, ReadOptions, Topics
from pipeline.setpoint.frames import familiar, front_end, key_area
from pipeline.setpoint.frames.front_end import FrameKeyAreas
from pipeline.setpoint.frames.rendered import LabelledFrames
from pipeline.setpoint.material import PLA, PrintedMaterial
from pipeline.setpoint.settings import TrainClassifier
from pipeline.store import artifacts
from pipeline.store.params import Execution
from pipeline.store.tables import FLOAT, NONE, TEXT, Column, Schema, bytes_of

MEMO = Path("datasets/memo/train_classifier")
HERE = Path(__file__).parents[1]
# the code that determines the content of a cache entry
CODE = (
    "setpoint/recordings.py", "setpoint/frames/front_end.py", "setpoint/frames/key_area.py",
    "setpoint/frames/travel.py", "setpoint/frames/familiar.py", "recordings/images.py",
    "recordings/nozzle_frames.py",
)  # fmt: skip
KEY_AREAS = Schema(
    "key_areas",
    2,
    (
        Column(
            "image", bytes_of(key_area.SHAPE[0] * key_area.SHAPE[1]), NONE, "16 x 48 gray levels, row by row"
        ),
        Column("angle_deg", FLOAT, "deg", "direction of the line, 0 right, 90 down", nullable=True),
        Column("miss_px", FLOAT, "px", "by which the line passes beside the tip", nullable=True),
        Column("score", FLOAT, NONE, "ridge in gray levels", nullable=True),
        Column("padded_share", FLOAT, NONE, "share of the crop outside the frame", nullable=True),
        Column("tip_x_px", FLOAT, "px", "where the tip was taken to be", nullable=True),
        Column("tip_y_px", FLOAT, "px", "where the tip was taken to be", nullable=True),
        Column(
            "surroundings",
            bytes_of(4 * len(familiar.NAMES)),
            NONE,
            "measures of familiar.NAMES, single precision, NaN where not taken",
        ),
        Column("reason", TEXT, NONE, "why there is no key area; empty where there is one"),
        Column("digest", TEXT, NONE, "of the frame: equal frames have equal ones"),
    ),
)


def read_options(
    settings: TrainClassifier, material: PrintedMaterial = PLA, memo: Path = MEMO
) -> ReadOptions:
    """Returns the reading options that section `train_classifier` sets, for a material."""
    mapping = {name: (m.source, m.unit, m.scale, m.offset) for name, m in settings.topics.mapping.items()}
    topics = Topics(settings.topics.image, settings.topics.time, mapping)
    stated = settings.constants.hotend
    return ReadOptions(
        settings.tip_px,
        FrontEnd(settings.least_score, memo.resolve()),
        topics,
        material,
        np.nan if stated is None else stated,
    )


def read_frames(
    folder: Path, settings: TrainClassifier, execution: Execution, material: PrintedMaterial = PLA
) -> tuple[NozzleFrames, LabelledFrames, np.ndarray]:
    """Reads all frames of a user's folder (n). Returns them; those with a known class and temperature; and
    which these are (n,)."""
    frames = nozzle_frames.read_folder(folder, read_options(settings, material), execution)
    nozzle_frames.check(folder, frames)
    usable = (frames.label >= 0) & np.isfinite(frames.temperature)
    truth = frames.label, frames.flow, frames.temperature, frames.print_number, frames.segment
    seen = frames.valid, np.array(frames.reasons, object), frames.score, frames.surroundings
    return frames, LabelledFrames(frames.images, *truth, *seen).take(usable), usable


class FrontEnd(NamedTuple):
    """front_end.py with the least score of a line in gray levels, and the folder of its cache."""

    least_score: float
    memo: Path

    @property
    def remedies(self) -> dict[str, str]:
        return front_end.REMEDIES

    def find(
        self, frames: Iterable[np.ndarray | str], tips: np.ndarray, directions_deg: np.ndarray
    ) -> FrameKeyAreas:
        return front_end.find_key_areas(frames, tips, directions_deg, least_score=self.least_score)

    def remember(self, what: tuple[Any, ...], count: int, find: Callable[[], FrameKeyAreas]) -> FrameKeyAreas:
        """Returns find() of `count` frames, or the cached result for the same `what`. A cache entry is named
        by the hash of everything that determines its content."""
        code = [artifacts.sha256(HERE / name) for name in CODE]
        entry = self.memo / f"{joblib.hash((what, self.least_score, code))}.parquet"
        areas = read_memo(entry, count)
        if areas is None:
            areas = find()
            write_memo(entry, areas)
        return areas


def write_memo(entry: Path, areas: FrameKeyAreas) -> None:
    columns = {
        "image": [image.tobytes() for image in areas.images],
        **{name: getattr(areas, name) for name in ("angle_deg", "miss_px", "score", "padded_share")},
        "tip_x_px": areas.tip[:, 0],
        "tip_y_px": areas.tip[:, 1],
        "surroundings": [row.astype("<f4").tobytes() for row in areas.surroundings],
        "reason": areas.reasons,
        "digest": areas.digests,
    }
    artifacts.write_table(entry, KEY_AREAS, columns)


def read_memo(entry: Path, count: int) -> FrameKeyAreas | None:
    """Returns a cache entry for `count` frames; None if it does not exist, is damaged (checksums of its
    pages), or has another number of frames."""
    try:
        table = artifacts.read_table(entry, KEY_AREAS)
    except ValueError:
        return None
    if len(table["image"]) != count:
        return None
    images = np.frombuffer(b"".join(table["image"]), np.uint8).reshape(-1, *key_area.SHAPE)
    measures = np.frombuffer(b"".join(table["surroundings"]), "<f4").reshape(-1, len(familiar.NAMES))
    return FrameKeyAreas(
        images=images,
        **{name: table[name] for name in ("angle_deg", "miss_px", "score", "padded_share")},
        tip=np.column_stack([table["tip_x_px"], table["tip_y_px"]]),
        surroundings=measures,
        reasons=table["reason"].tolist(),
        digests=table["digest"].tolist(),
    )
