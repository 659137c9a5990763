"""Real frames for the page, where the classifier learned from recordings: some that it named rightly, the
worst that it named wrongly, some that were rejected or are foreign, with the share of each and the reason."""

import collections
import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.setpoint.frames import key_area
from pipeline.setpoint.material import Material
from pipeline.setpoint.vision import calibrated_classifier
from pipeline.setpoint.vision.calibrated_classifier import CalibratedClassifier
from pipeline.setpoint.workflow import frame_images, frame_mcap
from pipeline.setpoint.workflow.frame_folder import NozzleFrames, ReadOptions, read_options
from pipeline.setpoint.workflow.settings import TrainClassifier
from pipeline.setpoint.workflow.train_classifier import shown as rendered_frames
from pipeline.store import artifacts

ACCEPTED, WRONG, REJECTED, FOREIGN = "accepted", "wrong", "rejected", "foreign"
# frames of each group on the page
MOST = 4


class Shown(NamedTuple):
    """What was made of n frames: group (n) of the four; probabilities (n, 3), NaN where rejected; distance
    (n,) from what was learned."""

    group: np.ndarray
    prob: np.ndarray
    distance: np.ndarray


def grouped(model: CalibratedClassifier, frames: NozzleFrames) -> Shown:
    """Each frame in one group: rejected by the front end, foreign to the classifier, named wrongly, or
    accepted."""
    prob, distance = np.full((len(frames.valid), 3), np.nan), np.full(len(frames.valid), np.nan)
    some = np.flatnonzero(frames.valid)
    if len(some):
        prob[some], distance[some] = calibrated_classifier.classify(
            model, frames.images[some], frames.temperature[some]
        )[:2]
    named = np.where(frames.valid, np.nan_to_num(prob).argmax(axis=1), -1)
    group = np.where(named == frames.label, ACCEPTED, WRONG)
    group = np.where(distance > model.calibration.foreign_above, FOREIGN, group)
    return Shown(np.where(frames.valid, group, REJECTED), prob, distance)


def chosen(shown: Shown, frames: NozzleFrames) -> list[int]:
    """Rows of the frames for the page: accepted ones of each class in turn, the wrong ones that were surest
    first, rejected ones of each reason in turn, the commonest first, foreign ones furthest first."""
    sure = np.nan_to_num(shown.prob).max(axis=1)
    kinds = [reason.partition(":")[0] for reason in frames.reasons]
    order = [kind for kind, _ in collections.Counter(k for k in kinds if k).most_common()]

    def of(group: str) -> np.ndarray:
        return np.flatnonzero(shown.group == group)

    # of those at which a line was looked for: the others have no picture, or no tip
    accepted, rejected = of(ACCEPTED), np.flatnonzero((shown.group == REJECTED) & np.isfinite(frames.score))
    by_class = [_spread(accepted[frames.label[accepted] == c]) for c in range(3)]
    by_reason = [_spread(np.array([i for i in rejected if kinds[i] == kind], int)) for kind in order]
    wrong, foreign = of(WRONG), of(FOREIGN)
    return [
        *_in_turn(by_class),
        *wrong[np.argsort(-sure[wrong], kind="stable")][:MOST].tolist(),
        *_in_turn(by_reason),
        *foreign[np.argsort(-shown.distance[foreign], kind="stable")][:MOST].tolist(),
    ]


def _spread(rows: np.ndarray) -> list[int]:
    """At most MOST of the rows, evenly spread."""
    return rows[np.linspace(0, len(rows) - 1, min(MOST, len(rows))).round().astype(int)].tolist()


def _in_turn(lists: Sequence[list[int]]) -> list[int]:
    """The first of each list, then the second of each, MOST in all."""
    turns = itertools.chain.from_iterable(itertools.zip_longest(*lists))
    return [row for row in turns if row is not None][:MOST]


def write_frames(
    settings: TrainClassifier,
    material: Material,
    model: CalibratedClassifier,
    frames: NozzleFrames | None,
    prints: np.ndarray,
    folder: Path,
) -> list[dict[str, Any]]:
    """A row for each frame of the page, with its JPEG in `folder`: real ones of the prints of these numbers,
    rendered ones where there are no recorded `frames`."""
    if frames is None:
        return rendered_frames(settings, model, folder)
    return write_gallery(model, frames, np.unique(prints), read_options(settings, material), folder)


def write_gallery(
    model: CalibratedClassifier, frames: NozzleFrames, prints: np.ndarray, options: ReadOptions, folder: Path
) -> list[dict[str, Any]]:
    """JPEGs of the chosen frames of the prints of these numbers, which nothing was learned from, with their
    key areas drawn in; returns a row for each, in the order of the page."""
    mine = np.isin(frames.print_number, prints) | (frames.print_number < 0)
    shown = grouped(model, frames)
    shown = shown._replace(group=np.where(mine, shown.group, ""))
    rows: list[dict[str, Any]] = []
    picked = chosen(shown, frames)
    for i, picture in zip(picked, pictures([frames.picture[i] for i in picked], options), strict=True):
        name, share = f"frame_{len(rows):02d}.jpg", float((shown.group[mine] == shown.group[i]).mean())
        artifacts.write_jpeg(folder / name, _drawn(picture, frames, i))
        rows.append({"file": name, "share": share} | _row(model, shown, frames, i, options.material))
    return rows


def _row(
    model: CalibratedClassifier, shown: Shown, frames: NozzleFrames, i: int, material: Material
) -> dict[str, Any]:
    group, valid = str(shown.group[i]), bool(frames.valid[i])
    foreign = "foreign: further from what was learned than allowed" if group == FOREIGN else ""
    numbers = {
        "score": frames.score[i], "direction_deg": frames.angle_deg[i],
        "flow_percent": material.own_flow(frames.flow[i]),
        "temperature_degC": material.own_temperature(frames.temperature[i]),
        "distance": shown.distance[i],
    }  # fmt: skip
    return {
        "place": group,
        "group": group,
        "source": frames.source[i],
        "reason": frames.reasons[i] or foreign,
        **{name: float(value) if np.isfinite(value) else None for name, value in numbers.items()},
        "label": int(frames.label[i]),
        "named": int(shown.prob[i].argmax()) if valid else None,
        "p": shown.prob[i].tolist() if valid else None,
        "foreign_above": model.calibration.foreign_above,
    }


def _drawn(picture: np.ndarray, frames: NozzleFrames, i: int) -> np.ndarray:
    """The crop with the key area of frame i."""
    figures = (getattr(frames, name)[i] for name in ("angle_deg", "miss_px", "score", "padded_share"))
    area = key_area.KeyArea(frames.images[i], *map(float, figures), frames.reasons[i])
    return key_area.drawn(picture, (float(frames.tip[i, 0]), float(frames.tip[i, 1])), area)


def pictures(where: Iterable[tuple[Path, int]], options: ReadOptions) -> list[np.ndarray]:
    """The gray pictures of (image, -1) or (recording, place among its frames). Raises ValueError where one
    cannot be read any more."""
    where = list(where)
    films = {
        path: frame_mcap.frames_at(path, options.topics, [k for one, k in where if one == path])
        for path in {path: None for path, k in where if k >= 0}
    }
    return [films[path][k] if k >= 0 else frame_images.read_image(path) for path, k in where]
