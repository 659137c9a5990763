"""What the trained classifier is worth on frames that it has not seen, beside its yardsticks."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from pipeline.setpoint.frames.rendered import LabelledFrames, flow_edges
from pipeline.setpoint.simulation.recorded import WindowTable
from pipeline.setpoint.vision import calibrated_classifier, calibration, classifier
from pipeline.setpoint.vision.calibrated_classifier import (
    CalibratedClassifier,
    WindowPredictions,
    YardstickClasses,
)
from pipeline.setpoint.vision.calibration import ClassifierCalibration, ClassifierOutputs, WindowTruth
from pipeline.setpoint.vision.classifier import Labelled, TrainState
from pipeline.setpoint.vision.parts import all_frames
from pipeline.setpoint.vision.vision_transformer import Classifier

# yardsticks, the small CNN among them, learn from one frame in so many: they take ten times as long a frame
EVERY = 3


class Assessment(NamedTuple):
    """The classifier on the frames that it is judged on."""

    fitted: ClassifierCalibration
    data: Labelled  # the frames, rejected ones too
    frames: ClassifierOutputs  # of the classifier on them
    windows: WindowPredictions
    cnn: np.ndarray  # (n,) classes named by the small CNN
    yardsticks: YardstickClasses


def fewer(learned: Labelled) -> Labelled:
    """One frame in EVERY of each class: what the yardsticks learn from."""
    of_class = (np.flatnonzero(learned.label == c)[::EVERY] for c in range(3))
    return learned.take(np.sort(np.concatenate([*of_class])))


def assess(
    fitted: ClassifierCalibration,
    outputs: ClassifierOutputs,
    cnn: Classifier,
    learned: Labelled,
    data: Labelled,
    *,
    window: int,
) -> Assessment:
    """The classifier's `outputs` on the frames `data`, beside yardsticks that learn from `learned`."""
    windows = calibrated_classifier.window_predictions(fitted, outputs, length=window)
    return Assessment(
        fitted,
        data,
        outputs,
        windows,
        classifier.predict(cnn, data.key_area, data.temperature_degC).logits.argmax(axis=1),
        calibrated_classifier.yardstick_classes(fewer(learned), data, windows, outputs.valid),
    )


def figures(network: Classifier, of: Assessment, *, window: int, coverage: float) -> dict[str, Any]:
    """Accuracies with their 95 % intervals by segment, also by flow; calibration, sets, and how foreign
    pictures are detected."""
    frames, valid, fitted = of.frames, of.frames.valid, of.fitted
    named = {
        "image": frames.logits.argmax(axis=1),
        "svc_image": of.yardsticks.svc,
        "cnn_image": of.cnn,
        "width_image": of.yardsticks.width,
    }
    prob, truth = judged_windows(of)
    right = prob.argmax(axis=1) == truth.label
    shares = {
        name: calibration.share_by_segment((classes == frames.label)[valid], frames.segment[valid])
        for name, classes in named.items()
    } | {"window": calibration.share_by_segment(right, truth.segment)}
    errors = calibrated_classifier.reliabilities(fitted, frames, length=window)
    sets = calibration.sets(prob, truth.label, fitted.level)
    covered = calibration.holds_true_class(prob, truth.label, fitted.level)
    return {
        **{f"{name}_accuracy": share.percent / 100 for name, share in shares.items()},
        "svc_window_accuracy": of.yardsticks.svc_window_accuracy,
        "intervals_percent": {name: [share.low, share.high] for name, share in shares.items()},
        "right_70_150": _finite(calibration.uniform_share(right, truth)),
        "by_flow": [_finite(row) for row in calibration.by_flow(right, truth)],
        "coverage_by_flow": [_finite(row) for row in calibration.by_flow(covered, truth)],
        "images": int(valid.sum()), "windows": len(right),
        "judged_segments": len(np.unique(frames.segment)),
        "ece_image": errors["image", "calibrated"].error, "ece_image_raw": errors["image", "raw"].error,
        "ece_image_floor": errors["image", "calibrated"].floor,
        "ece_window": errors["window", "flow"].error,
        "ece_window_log_sum": errors["window", "log_sum"].error,
        "ece_window_counts": errors["window", "hard_counts"].error,
        "ece_window_mean": errors["window", "mean"].error,
        "ece_window_floor": errors["window", "flow"].floor,
        "temperature": fitted.temperature, "window_correlation": fitted.correlation,
        "flow_correlation": fitted.flow.correlation, "conformal_level": fitted.level,
        "conformal": {"asked": coverage, "coverage": sets.coverage, "held": sets.held, "windows": len(right)},
        "out_of_distribution": calibrated_classifier.foreign_detection(
            CalibratedClassifier(network, fitted), frames, of.data
        ),
    }  # fmt: skip


def judged_windows(of: Assessment) -> tuple[np.ndarray, WindowTruth]:
    """Probabilities (w, 3) and truth of the judged windows that have a valid frame."""
    some = of.windows.any_valid
    return of.windows.seen.prob[some], WindowTruth(*(column[some] for column in of.windows.truth))


def _finite(row: NamedTuple) -> dict[str, float | None]:
    """A row for JSON: None if there is no figure."""
    return {name: value if np.isfinite(value) else None for name, value in row._asdict().items()}


def classified(of: Assessment, flow: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of schema CLASSIFIED: the valid frames of the judged part, flow (n,) the true one."""
    frames, fitted = of.frames, of.fitted
    prob = np.clip(np.exp(calibration.log_probabilities(frames.logits, fitted.temperature)), 0, 1)
    columns = {
        "segment": frames.segment, "flow_percent": flow, "temperature_degC": of.data.temperature_degC,
        "label": frames.label,
        "p_under": prob[:, 0], "p_good": prob[:, 1], "p_over": prob[:, 2],
        "named": frames.logits.argmax(axis=1),
        "named_cnn": of.cnn,
        "named_svc": of.yardsticks.svc, "named_width": of.yardsticks.width,
        "distance": calibration.mahalanobis(fitted.familiar, frames.features),
    }  # fmt: skip
    return {name: values[frames.valid] for name, values in columns.items()}


def reliability(of: Assessment, *, window: int) -> dict[str, list]:
    """Columns of schema RELIABILITY."""
    columns: dict[str, list] = {
        name: [] for name in ("of", "method", "low", "high", "count", "confidence", "accuracy")
    }
    bins = calibrated_classifier.reliabilities(of.fitted, of.frames, length=window)
    for (unit, method), one in bins.items():
        n, high = len(one.count), np.append(one.edges[1:], 1.0)
        rows = ([unit] * n, [method] * n, one.edges, high, one.count, one.confidence, one.accuracy)
        for name, values in zip(columns, rows, strict=True):
            columns[name] += list(values)
    return columns


def window_tables(windows: Mapping[str, WindowPredictions]) -> dict[str, WindowTable]:
    """The windows of each part as the simulator draws them again, in bins of the flow that all parts have."""
    bins = flow_edges([of.truth.flow_percent[of.any_valid] for of in windows.values()])
    return {
        part: calibration.recorded(of.seen, of.truth.flow_percent, of.truth.segment, flow_edges=bins)
        for part, of in windows.items()
    }


def predict_windows(model: CalibratedClassifier, frames: LabelledFrames, *, window: int) -> WindowPredictions:
    """What the model says of windows of the frames at one flow."""
    outputs = calibrated_classifier.outputs(model.network, all_frames(frames, recorded=False), frames.valid)
    return calibrated_classifier.window_predictions(model.calibration, outputs, length=window)


def curves(trained: Mapping[str, TrainState]) -> dict[str, list]:
    """Columns of schema CLASSIFIER_CURVE: a row for each epoch of each network."""
    rows = [
        (name, epoch + 1, *(float(v) for v in state.history[epoch]))
        for name, state in trained.items()
        for epoch in range(int(state.epoch))
    ]
    names = ("learner", "epoch", "training_loss", "held_out_loss", "held_out_accuracy")
    return dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))
