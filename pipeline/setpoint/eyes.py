"""A classifier with its calibration: what it says of key areas and of
windows, and how well it knows what it does not know."""

from typing import Any, NamedTuple

import cv2
import numpy as np
import scipy.special

from pipeline.setpoint import calibration, yardsticks
from pipeline.setpoint.calibration import Calibration, Reliability, Seen
from pipeline.setpoint.classifier import Labelled, predict
from pipeline.setpoint.vision_transformer import Classifier

BINS = 10  # of reliability diagrams


class Eyes(NamedTuple):
    network: Classifier
    known: Calibration


def see(eyes: Eyes, images: np.ndarray, temperature_degC: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Class probabilities (n, 3) of key areas (n, 16, 48) at temperatures (n,), and how foreign each is (n,):
    squared Mahalanobis distance of features and appearance."""
    found = predict(eyes.network, images, temperature_degC)
    p = np.exp(calibration.log_probabilities(found.logits, eyes.known.temperature))
    features = np.hstack([found.features, calibration.appearance(images)])
    return p / p.sum(axis=1, keepdims=True), calibration.mahalanobis(eyes.known.familiar, features)


def look(network: Classifier, data: Labelled, valid: np.ndarray) -> Seen:
    """What the network sees of n frames, valid (n,) or not."""
    return calibration.seen(predict(network, data.key_area, data.temperature_degC), data, valid)


class Said(NamedTuple):
    """Of w windows: p (w, 3) by summed logarithms, by hard counts and by the mean probability; true class
    (w,), flow-constant segment (w,), rows (w, length), any valid (w,)."""

    p: np.ndarray
    hard: np.ndarray
    mean: np.ndarray
    label: np.ndarray
    rows: np.ndarray
    seen: np.ndarray


def windows_said(known: Calibration, frames: Seen, *, length: int) -> Said:
    """What is said of the windows of `length` frames of one segment and
    class; those without a valid frame say 1/3 each."""
    rows = calibration.windows(frames.segment, frames.label, length=length).rows
    log_p, valid = calibration.log_probabilities(frames.logits, known.temperature)[rows], frames.valid[rows]
    total = np.where(valid[:, :, None], np.exp(log_p), 0).sum(axis=1)
    m = valid.sum(axis=1)[:, None]
    return Said(
        calibration.window_probabilities(log_p, valid, known.correlation),
        calibration.hard_shares(log_p, valid),
        np.where(m > 0, total / np.maximum(m, 1), 1 / 3), frames.label[rows[:, 0]], rows, valid.any(axis=1),
    )  # fmt: skip


def reliabilities(known: Calibration, frames: Seen, *, length: int) -> dict[tuple[str, str], Reliability]:
    """By (image or window, method): before and after calibration, and the paper's hard counts."""
    v, says = frames.valid, windows_said(known, frames, length=length)
    images = {
        "raw": scipy.special.softmax(frames.logits[v], axis=1),
        "calibrated": np.exp(calibration.log_probabilities(frames.logits[v], known.temperature)),
    }
    windows = {"hard_counts": says.hard, "mean": says.mean, "log_sum": says.p}
    found = {
        ("image", name): calibration.reliability(p, frames.label[v], bins=BINS) for name, p in images.items()
    }
    return found | {
        ("window", name): calibration.reliability(p[says.seen], says.label[says.seen], bins=BINS)
        for name, p in windows.items()
    }


def foreign(key_area: np.ndarray) -> dict[str, np.ndarray]:
    """Key areas (n, 16, 48) as no bead looks: a lens out of focus, little and
    much, and a rectangle that lies across the line."""
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


def knows_not(eyes: Eyes, frames: Seen, data: Labelled) -> dict[str, Any]:
    """By kind of foreign picture the AUROC of the distance, beside those of the energy and of 1 - max p, and
    the share found; and the share of familiar ones called foreign."""
    v, known = frames.valid, eyes.known
    familiar = calibration.mahalanobis(known.familiar, frames.features[v])
    plain = -scipy.special.softmax(frames.logits[v], axis=1).max(axis=1)
    figures: dict[str, Any] = {"false_alarms": float(np.mean(familiar > known.foreign_above))}
    for name, images in foreign(data.key_area[v]).items():
        shown = predict(eyes.network, images, data.temperature_degC[v])
        scores = calibration.mahalanobis(
            known.familiar, np.hstack([shown.features, calibration.appearance(images)])
        )
        figures[name] = {
            "auroc": calibration.auroc(familiar, scores),
            "found": float(np.mean(scores > known.foreign_above)),
            "energy_auroc": calibration.auroc(calibration.energy(frames.logits[v]),
            calibration.energy(shown.logits)),
            "max_p_auroc": calibration.auroc(plain, -scipy.special.softmax(shown.logits, axis=1).max(axis=1)),
        }  # fmt: skip
    return figures


class Beside(NamedTuple):
    """The yardsticks' classes of n frames (n,): support vector machine on the profile, width; and the share
    of windows that the machine's counts name rightly."""

    svc: np.ndarray
    width: np.ndarray
    svc_window_accuracy: float


def beside(learned: Labelled, data: Labelled, says: Said, valid: np.ndarray) -> Beside:
    """Both yardsticks, fitted on the valid frames that the network
    learned, on the frames `data` and their windows."""
    machine = yardsticks.fit_profile_machine(
        learned.key_area, learned.temperature_degC, learned.label, learned.segment
    )
    rule = yardsticks.fit_width_rule(learned.key_area, learned.label)
    p = yardsticks.profile_probabilities(machine, data.key_area, data.temperature_degC)
    counts = calibration.hard_shares(np.log(p + 1e-12)[says.rows], valid[says.rows]).argmax(axis=1)
    return Beside(
        p.argmax(axis=1),
        yardsticks.width_class(rule, data.key_area),
        float(np.mean((counts == says.label)[says.seen])),
    )
