"""A classifier with its calibration: class probabilities of key areas and of windows, and the distance of a
key area from what was learned."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
import scipy.special

from pipeline.setpoint.frames.familiar import medians
from pipeline.setpoint.vision import calibration
from pipeline.setpoint.vision.calibration import (
    ClassifierCalibration,
    ClassifierOutputs,
    Reliability,
    WindowTruth,
)
from pipeline.setpoint.vision.classifier import Labelled, predict
from pipeline.setpoint.vision.vision_transformer import Classifier
from pipeline.setpoint.vision.window_flow import WindowFlow, window_flow

BINS = 10  # of reliability diagrams


class CalibratedClassifier(NamedTuple):
    network: Classifier
    calibration: ClassifierCalibration


class FrameReadings(NamedTuple):
    """For n key areas: class probabilities (n, 3); distance, how unfamiliar each is (n,); log(flow / 100 %)
    (n,) and its standard deviation (n,) as the network gives them. calibration.window_flow combines them into
    a window's flow."""

    prob: np.ndarray
    distance: np.ndarray
    log_flow: np.ndarray
    deviation: np.ndarray


def read_frames(
    model: CalibratedClassifier, images: np.ndarray, temperature_degC: np.ndarray
) -> FrameReadings:
    """Returns what key areas (n, 16, 48) at temperatures (n,) show. The distance is the squared Mahalanobis
    distance of features and appearance from those learned."""
    prediction = predict(model.network, images, temperature_degC)
    prob = np.exp(calibration.log_probabilities(prediction.logits, model.calibration.temperature))
    features = np.hstack([prediction.features, calibration.appearance(images)])
    return FrameReadings(
        prob / prob.sum(axis=1, keepdims=True),
        calibration.mahalanobis(model.calibration.familiar, features),
        prediction.log_flow.astype(float),
        prediction.deviation.astype(float),
    )


def classify(
    model: CalibratedClassifier, images: np.ndarray, temperature_degC: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns class probabilities (n, 3) of key areas (n, 16, 48) at temperatures (n,), and how unfamiliar
    each is (n,), as `read_frames`."""
    return read_frames(model, images, temperature_degC)[:2]


def outputs(network: Classifier, data: Labelled, valid: np.ndarray, looks: np.ndarray) -> ClassifierOutputs:
    """Returns the network's outputs on n frames, valid (n,) or not, with looks (n, measures). Features are
    those of the head, joined with the appearance of the key areas."""
    prediction = predict(network, data.key_area, data.temperature_degC)
    return ClassifierOutputs(
        prediction.logits,
        np.hstack([prediction.features, calibration.appearance(data.key_area)]),
        np.asarray(prediction.log_flow, float),
        np.asarray(prediction.deviation, float),
        data.label,
        np.asarray(data.flow_percent, float),
        np.asarray(data.temperature_degC, float),
        data.segment,
        np.asarray(valid, bool),
        looks,
    )


class WindowPredictions(NamedTuple):
    """For w windows: `seen`, flow and the class probabilities that follow from it; `hard` (w, 3), shares of
    the counted classes; `truth` at their middle frames; `rows` (w, length) of the frames; `any_valid` (w,),
    whether a frame is valid."""

    seen: WindowFlow
    hard: np.ndarray
    truth: WindowTruth
    rows: np.ndarray
    any_valid: np.ndarray

    def take(self, some: np.ndarray) -> "WindowPredictions":
        seen, truth = WindowFlow(*(a[some] for a in self.seen)), WindowTruth(*(a[some] for a in self.truth))
        return WindowPredictions(seen, self.hard[some], truth, self.rows[some], self.any_valid[some])


def joined_windows(several: Sequence[WindowPredictions]) -> WindowPredictions:
    """Returns these windows, concatenated in order."""
    seen, hard, truth, rows, any_valid = zip(*several, strict=True)
    return WindowPredictions(
        WindowFlow(*map(np.concatenate, zip(*seen, strict=True))),
        np.concatenate(hard),
        WindowTruth(*map(np.concatenate, zip(*truth, strict=True))),
        np.concatenate(rows),
        np.concatenate(any_valid),
    )


def window_predictions(
    fitted: ClassifierCalibration, frames: ClassifierOutputs, *, length: int
) -> WindowPredictions:
    """Returns the predictions of the windows with `length` frames of one segment; 1/3 for each class if no
    frame is valid."""
    rows = calibration.windows(frames.segment, length=length)
    log_p, valid = calibration.log_probabilities(frames.logits, fitted.temperature)[rows], frames.valid[rows]
    looks, middle = medians(frames.looks, rows), rows[:, length // 2]
    truth = frames.label, frames.flow_percent, frames.temperature_degC, frames.segment
    return WindowPredictions(
        seen=window_flow(frames.log_flow[rows], frames.deviation[rows], valid, looks, fitted.flow),
        hard=calibration.hard_shares(log_p, valid),
        truth=WindowTruth(*(column[middle] for column in truth)),
        rows=rows,
        any_valid=valid.any(axis=1),
    )


def reliabilities(
    fitted: ClassifierCalibration, frames: ClassifierOutputs, windows: WindowPredictions
) -> dict[tuple[str, str], Reliability]:
    """Returns reliabilities by (image or window, method). Images: before and after calibration. Windows: the
    paper's hard counts, and the probabilities that follow from the flow seen."""
    v, some = frames.valid, windows.any_valid
    images = {
        "raw": scipy.special.softmax(frames.logits[v], axis=1),
        "calibrated": np.exp(calibration.log_probabilities(frames.logits[v], fitted.temperature)),
    }
    methods = {"hard_counts": windows.hard, "flow": windows.seen.prob}
    return {
        ("image", name): calibration.reliability(prob, frames.label[v], bins=BINS)
        for name, prob in images.items()
    } | {
        ("window", name): calibration.reliability(prob[some], windows.truth.label[some], bins=BINS)
        for name, prob in methods.items()
    }


def foreign_images(key_area: np.ndarray) -> dict[str, np.ndarray]:
    """Returns key areas (n, 16, 48) as no bead looks: out of focus, slightly and strongly, and with the
    rectangle lying across the line."""
    blurred = {
        name: np.stack([cv2.GaussianBlur(a, (0, 0), sigma) for a in key_area])
        for name, sigma in (("slight_blur", 1.5), ("blur", 2.5))
    }
    return blurred | {
        "transposed": np.stack(
            [
                cv2.resize(np.ascontiguousarray(a.T), a.shape[::-1], interpolation=cv2.INTER_AREA)
                for a in key_area
            ]
        )
    }


def foreign_detection(
    model: CalibratedClassifier, frames: ClassifierOutputs, data: Labelled
) -> dict[str, Any]:
    """Returns, for each kind of foreign picture, the AUROC of the distance and the share detected; and the
    share of familiar pictures called foreign."""
    v, fitted = frames.valid, model.calibration
    familiar = calibration.mahalanobis(fitted.familiar, frames.features[v])
    figures: dict[str, Any] = {"false_alarms": float(np.mean(familiar > fitted.foreign_above))}
    for name, images in foreign_images(data.key_area[v]).items():
        shown = predict(model.network, images, data.temperature_degC[v])
        scores = calibration.mahalanobis(
            fitted.familiar, np.hstack([shown.features, calibration.appearance(images)])
        )
        figures[name] = {
            "auroc": calibration.auroc(familiar, scores),
            "found": float(np.mean(scores > fitted.foreign_above)),
        }
    return figures


def yardstick_classes(learned: Labelled, data: Labelled) -> dict[str, np.ndarray]:
    """Returns the classes (n,) of the frames `data` by two references: a support vector machine on the
    profile, and the width. Both are fitted to valid frames that the network learned."""
    from pipeline.setpoint.vision import yardsticks  # imported here, since classifying does not need it

    machine = yardsticks.fit_profile_machine(
        learned.key_area, learned.temperature_degC, learned.label, learned.segment
    )
    rule = yardsticks.fit_width_rule(learned.key_area, learned.label)
    prob = yardsticks.profile_probabilities(machine, data.key_area, data.temperature_degC)
    return {"svc": prob.argmax(axis=1), "width": yardsticks.width_class(rule, data.key_area)}
