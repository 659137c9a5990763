"""A few frames for the report page, with their key areas drawn in. They are rendered ones, or real ones if
the classifier learned from recordings: some classified correctly, the worst misclassified, some rejected or
foreign, with the share of each group and the reason."""

import collections
import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from pipeline.setpoint.frames import key_area, nozzle_scene
from pipeline.setpoint.material import PrintedMaterial
from pipeline.setpoint.vision import calibrated_classifier
from pipeline.setpoint.vision.calibrated_classifier import CalibratedClassifier

ACCEPTED, WRONG, REJECTED, FOREIGN = "accepted", "wrong", "rejected", "foreign"
# frames of each group on the page
MOST = 4
FURTHER = "foreign: further from what was learned than allowed"


# ---- of recordings: frames of recordings/nozzle_frames.py


class Groups(NamedTuple):
    """Results for n frames: `group` (n), one of the four; probabilities (n, 3), NaN if rejected; `distance`
    (n,) from what was learned."""

    group: np.ndarray
    prob: np.ndarray
    distance: np.ndarray


def classified_frames(model: CalibratedClassifier, frames: Any) -> tuple[np.ndarray, np.ndarray]:
    """Returns probabilities (n, 3) and distance (n,) of n frames; NaN for frames that are not valid."""
    prob, distance = np.full((len(frames.valid), 3), np.nan), np.full(len(frames.valid), np.nan)
    some = np.flatnonzero(frames.valid)
    if len(some):
        prob[some], distance[some] = calibrated_classifier.classify(
            model, frames.images[some], frames.temperature[some]
        )[:2]
    return prob, distance


def group_frames(prob: np.ndarray, distance: np.ndarray, foreign_above: float, frames: Any) -> Groups:
    """Puts each frame in one group: rejected by the front end, foreign to the classifier, misclassified, or
    accepted."""
    named = np.where(frames.valid, np.nan_to_num(prob).argmax(axis=1), -1)
    group = np.where(named == frames.label, ACCEPTED, WRONG)
    group = np.where(distance > foreign_above, FOREIGN, group)
    return Groups(np.where(frames.valid, group, REJECTED), prob, distance)


def choose_frames(groups: Groups, frames: Any) -> list[int]:
    """Returns the rows of the frames for the page: accepted ones of each class in turn; misclassified ones,
    the most confident first; rejected ones of each reason in turn, the commonest first; foreign ones, the
    furthest first."""
    sure = np.nan_to_num(groups.prob).max(axis=1)
    kinds = [reason.partition(":")[0] for reason in frames.reasons]
    order = [kind for kind, _ in collections.Counter(k for k in kinds if k).most_common()]

    def of(group: str) -> np.ndarray:
        return np.flatnonzero(groups.group == group)

    # only frames that were searched for a line: the others have no picture, or no tip
    accepted, rejected = of(ACCEPTED), np.flatnonzero((groups.group == REJECTED) & np.isfinite(frames.score))
    by_class = [_spread(accepted[frames.label[accepted] == c]) for c in range(3)]
    by_reason = [_spread(np.array([i for i in rejected if kinds[i] == kind], int)) for kind in order]
    wrong, foreign = of(WRONG), of(FOREIGN)
    return [
        *_in_turn(by_class),
        *wrong[np.argsort(-sure[wrong], kind="stable")][:MOST].tolist(),
        *_in_turn(by_reason),
        *foreign[np.argsort(-groups.distance[foreign], kind="stable")][:MOST].tolist(),
    ]


def _spread(rows: np.ndarray) -> list[int]:
    """Returns at most MOST of the rows, evenly spread."""
    return rows[np.linspace(0, len(rows) - 1, min(MOST, len(rows))).round().astype(int)].tolist()


def _in_turn(lists: Sequence[list[int]]) -> list[int]:
    """Returns the first of each list, then the second of each, MOST in all."""
    turns = itertools.chain.from_iterable(itertools.zip_longest(*lists))
    return [row for row in turns if row is not None][:MOST]


def describe_recorded(
    model: CalibratedClassifier,
    groups: Groups,
    frames: Any,
    i: int,
    judged: np.ndarray,
    material: PrintedMaterial,
) -> dict[str, Any]:
    """Returns the row of frame i: its group, the group's share among the `judged` frames (n,), and its
    results."""
    group, valid = str(groups.group[i]), bool(frames.valid[i])
    numbers = {
        "score": frames.score[i], "direction_deg": frames.angle_deg[i],
        "flow_percent": material.own_flow(frames.flow[i]),
        "temperature_degC": material.own_temperature(frames.temperature[i]),
        "distance": groups.distance[i],
    }  # fmt: skip
    return {
        "share": float((groups.group[judged] == groups.group[i]).mean()),
        "place": group,
        "group": group,
        "source": frames.source[i],
        "reason": frames.reasons[i] or (FURTHER if group == FOREIGN else ""),
        **{name: float(value) if np.isfinite(value) else None for name, value in numbers.items()},
        "label": int(frames.label[i]),
        "named": int(groups.prob[i].argmax()) if valid else None,
        "p": groups.prob[i].tolist() if valid else None,
        "foreign_above": model.calibration.foreign_above,
    }


def draw_recorded(picture: np.ndarray, frames: Any, i: int) -> np.ndarray:
    """Draws the crop with the key area of frame i."""
    figures = (getattr(frames, name)[i] for name in ("angle_deg", "miss_px", "score", "padded_share"))
    area = key_area.KeyArea(frames.images[i], *map(float, figures), frames.reasons[i])
    return key_area.drawn(picture, (float(frames.tip[i, 0]), float(frames.tip[i, 1])), area)


# ---- rendered


def render_examples(
    model: CalibratedClassifier, rng: np.random.Generator, *, least_score: float
) -> Iterator[tuple[np.ndarray, dict[str, Any]]]:
    """Yields (picture, row) of rendered frames with their key areas drawn in: two of each class, the first
    three rejected ones, and a blurred one. A row has the truth, the predicted class, the score, and the
    reason of rejection."""
    wanted = {"under": 2, "good": 2, "over": 2, "rejected": 3}
    for i in range(200):
        if not any(wanted.values()):
            break
        flow = nozzle_scene.draw_class_flow(rng, i % 3, 1)
        temperature = np.array([nozzle_scene.TEMPERATURES[i % 5]])
        scene = nozzle_scene.render(nozzle_scene.draw_segment(rng), flow, temperature, rng)
        frame, direction = scene.frames[0], scene.direction_deg
        area = key_area.find(frame, scene.tip, least_score=least_score, direction_deg=direction)
        place = "rejected" if area.reason else ("under", "good", "over")[int(nozzle_scene.label(flow)[0])]
        if wanted[place] == 0:
            continue
        wanted[place] -= 1
        truth = float(flow[0]), float(temperature[0])
        yield key_area.drawn(frame, scene.tip, area), _rendered_row(model, place, area, *truth)
        if place == "good" and wanted["good"] == 0:
            soft = cv2.GaussianBlur(frame, (0, 0), 5.0)
            area = key_area.find(soft, scene.tip, least_score=least_score, direction_deg=direction)
            yield key_area.drawn(soft, scene.tip, area), _rendered_row(model, "out of focus", area, *truth)


def _rendered_row(
    model: CalibratedClassifier, place: str, area: key_area.KeyArea, flow: float, temperature: float
) -> dict[str, Any]:
    limit = model.calibration.foreign_above
    prob, score = calibrated_classifier.classify(model, area.image[None], np.array([temperature]))
    valid = not area.reason
    return {
        "place": place,
        "reason": area.reason or (FURTHER if score[0] > limit else ""),
        "score": area.score,
        "direction_deg": area.angle_deg,
        "flow_percent": flow,
        "temperature_degC": temperature,
        "label": int(nozzle_scene.label(np.array(flow))),
        "named": int(prob[0].argmax()) if valid else None,
        "p": prob[0].tolist() if valid else None,
        "distance": float(score[0]) if valid else None,
        "foreign_above": limit,
    }
