"""How good the trained classifier is on frames that it has not seen, compared with simpler reference
methods."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from pipeline.setpoint.frames.nozzle_scene import label
from pipeline.setpoint.frames.rendered import LabelledFrames, flow_edges
from pipeline.setpoint.simulation.recorded import WindowTable
from pipeline.setpoint.vision import calibrated_classifier, calibration
from pipeline.setpoint.vision.calibrated_classifier import CalibratedClassifier, WindowPredictions
from pipeline.setpoint.vision.calibration import ClassifierCalibration, ClassifierOutputs, WindowTruth
from pipeline.setpoint.vision.classifier import Labelled, TrainState
from pipeline.setpoint.vision.parts import all_frames
from pipeline.setpoint.vision.proof import may_judge, verdict

# reference methods learn from one frame in EVERY, because they take ten times as long for each frame
EVERY = 3


class Assessment(NamedTuple):
    """The classifier's results on test frames; it learned from none of them."""

    fitted: ClassifierCalibration
    frames: ClassifierOutputs  # the classifier's outputs on these frames, including rejected ones
    windows: WindowPredictions
    yardsticks: dict[str, np.ndarray]  # (n,) classes by reference method; empty for few own pictures


def fewer(learned: Labelled) -> Labelled:
    """Returns one frame in EVERY of each class, from which the reference methods learn."""
    of_class = (np.flatnonzero(learned.label == c)[::EVERY] for c in range(3))
    return learned.take(np.sort(np.concatenate([*of_class])))


def assess(
    fitted: ClassifierCalibration,
    outputs: ClassifierOutputs,
    learned: Labelled,
    data: Labelled,
    *,
    window: int,
) -> Assessment:
    """Returns the assessment of the classifier's `outputs` on the frames `data`, compared with reference
    methods that learn from `learned`."""
    windows = calibrated_classifier.window_predictions(fitted, outputs, length=window)
    others = calibrated_classifier.yardstick_classes(fewer(learned), data)
    return Assessment(fitted, outputs, windows, others)


def figures(of: Assessment) -> dict[str, Any]:
    """Returns accuracies with their 95 % intervals by segment, also by flow; calibration errors; and whether
    the classifier may be used for control."""
    frames, valid, proof = of.frames, of.frames.valid, of.fitted.proof
    named = {"image": frames.logits.argmax(axis=1)}
    named |= {f"{name}_image": classes for name, classes in of.yardsticks.items()}
    prob, truth = judged_windows(of.windows)
    right = prob.argmax(axis=1) == truth.label
    shares = {
        name: calibration.share_by_segment((classes == frames.label)[valid], frames.segment[valid])
        for name, classes in named.items()
    } | {"window": calibration.share_by_segment(right, truth.segment)}
    if "svc" in of.yardsticks:
        rows, votes = of.windows.rows, np.eye(3)[of.yardsticks["svc"]]
        counted = calibration.hard_shares(votes[rows], valid[rows])[of.windows.any_valid].argmax(axis=1)
        shares["svc_window"] = calibration.share_by_segment(counted == truth.label, truth.segment)
    errors = calibrated_classifier.reliabilities(of.fitted, frames, of.windows)
    return {
        **{f"{name}_accuracy": share.percent / 100 for name, share in shares.items()},
        "intervals_percent": {name: [share.low, share.high] for name, share in shares.items()},
        "right_70_150": _finite(calibration.uniform_share(right, truth)),
        "by_flow": [_finite(row) for row in calibration.by_flow(right, truth)],
        "images": int(valid.sum()), "windows": len(right),
        "judged_segments": len(np.unique(frames.segment)),
        "ece_image": errors["image", "calibrated"].error, "ece_image_raw": errors["image", "raw"].error,
        "ece_image_floor": errors["image", "calibrated"].floor,
        "ece_window": errors["window", "flow"].error,
        "ece_window_counts": errors["window", "hard_counts"].error,
        "ece_window_floor": errors["window", "flow"].floor,
        "temperature": of.fitted.temperature, "flow_correlation": of.fitted.flow.correlation,
        "proof": proof._asdict() | {"may_judge": may_judge(proof), "verdict": verdict(proof)},
    }  # fmt: skip


def judged_windows(windows: WindowPredictions) -> tuple[np.ndarray, WindowTruth]:
    """Returns probabilities (w, 3) and truth of the windows that have a valid frame."""
    some = windows.any_valid
    return windows.seen.prob[some], WindowTruth(*(column[some] for column in windows.truth))


def proven(
    fitted: ClassifierCalibration,
    windows: WindowPredictions,
    *,
    least: float,
    known_from: int,
    rendered: bool,
) -> ClassifierCalibration:
    """Returns the calibration with its proof, from windows of segments or prints that were not learned from.
    The class of a window is the one in which its flow seen lies, because the loop acts on this flow. The most
    probable class would not do: that of good is the narrowest, and if the spread is wide, it is never the
    largest."""
    _, truth = judged_windows(windows)
    named = label(windows.seen.flow_seen[windows.any_valid])
    proof = calibration.prove(named, truth, least=least, known_from=known_from, rendered=rendered)
    return fitted._replace(proof=proof)


def _finite(row: NamedTuple) -> dict[str, float | None]:
    """Returns a row for JSON, with None for figures that are not finite."""
    return {name: value if np.isfinite(value) else None for name, value in row._asdict().items()}


def classified(of: Assessment) -> dict[str, np.ndarray]:
    """Returns columns of schema CLASSIFIED: the valid frames of the test part."""
    frames, fitted = of.frames, of.fitted
    prob = np.clip(np.exp(calibration.log_probabilities(frames.logits, fitted.temperature)), 0, 1)
    columns = {
        "segment": frames.segment, "flow_percent": frames.flow_percent,
        "temperature_degC": frames.temperature_degC,
        "label": frames.label,
        "p_under": prob[:, 0], "p_good": prob[:, 1], "p_over": prob[:, 2],
        "named": frames.logits.argmax(axis=1),
        "distance": calibration.mahalanobis(fitted.familiar, frames.features),
    }  # fmt: skip
    return {name: values[frames.valid] for name, values in columns.items()}


def reliability(of: Assessment) -> dict[str, list]:
    """Returns columns of schema RELIABILITY."""
    columns: dict[str, list] = {
        name: [] for name in ("of", "method", "low", "high", "count", "confidence", "accuracy")
    }
    bins = calibrated_classifier.reliabilities(of.fitted, of.frames, of.windows)
    for (unit, method), one in bins.items():
        n, high = len(one.count), np.append(one.edges[1:], 1.0)
        rows = ([unit] * n, [method] * n, one.edges, high, one.count, one.confidence, one.accuracy)
        for name, values in zip(columns, rows, strict=True):
            columns[name] += list(values)
    return columns


def window_tables(windows: Mapping[str, WindowPredictions]) -> dict[str, WindowTable]:
    """Returns the windows of each part as tables from which the simulator draws, in flow bins that all parts
    have."""
    bins = flow_edges([of.truth.flow_percent[of.any_valid] for of in windows.values()])
    return {
        part: calibration.recorded(of.seen, of.truth.flow_percent, of.truth.segment, flow_edges=bins)
        for part, of in windows.items()
    }


def predict_windows(
    model: CalibratedClassifier, frames: LabelledFrames, *, window: int, recorded: bool
) -> WindowPredictions:
    """Returns the model's predictions for windows of rendered segments, or of recorded prints."""
    data = all_frames(frames, recorded=recorded)
    outputs = calibrated_classifier.outputs(model.network, data, frames.valid, frames.surroundings)
    return calibrated_classifier.window_predictions(model.calibration, outputs, length=window)


def curve(state: TrainState | None) -> dict[str, list]:
    """Returns columns of schema CLASSIFIER_CURVE: a row for each epoch if the network was trained, else no
    row."""
    history = [] if state is None else np.asarray(state.history, float)[: int(state.epoch)].tolist()
    rows = [("vision transformer", epoch + 1, *row) for epoch, row in enumerate(history)]
    names = ("learner", "epoch", "training_loss", "held_out_loss", "held_out_accuracy")
    return {name: [row[i] for row in rows] for i, name in enumerate(names)}
