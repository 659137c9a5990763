"""A classifier from a few pictures of the user's own. The features of the shipped network are kept, and new
heads are fitted to them by ridge regression (Hoerl and Kennard 1970)

    W = (Z'Z + penalty I)^-1 Z' (y - mean y)    Z: features minus their mean, in standard deviations

for the three classes as 0 and 1, and for log(flow / 100 %). Each print is predicted by heads, and its windows
by a calibration, that did not learn from it. The spread is then enlarged by their errors: with few prints, a
calibration learns the errors of its own windows, but not those of the next print.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.special

from pipeline.setpoint.frames.rendered import LabelledFrames
from pipeline.setpoint.vision import calibrated_classifier, calibration
from pipeline.setpoint.vision.calibrated_classifier import CalibratedClassifier, WindowPredictions
from pipeline.setpoint.vision.calibration import ClassifierOutputs
from pipeline.setpoint.vision.classifier import CLASS_NAMES
from pipeline.setpoint.vision.parts import all_frames
from pipeline.setpoint.vision.vision_transformer import LOG_DEVIATION, Classifier
from pipeline.setpoint.vision.window_flow import FlowCalibration, WindowFlow, class_probabilities

# with at least this many stretches of constant settings the network itself is trained
TRAINED_FROM = 2000
PENALTY = 10.0
# prints are left out one at a time, many prints in this many groups; each class must be in at least this many
# prints, because two are left out at a time
MOST_GROUPS, LEAST_PRINTS = 12, 3
# fraction of the windows whose errors determine how much the spread is enlarged
COVERED = 0.8


class Heads(NamedTuple):
    """Scores of the classes and log flow: features W + b, with W (f, 4) and b (4,). `deviation`: of log
    flow."""

    W: np.ndarray
    b: np.ndarray
    deviation: float


class OwnClassifier(NamedTuple):
    """`model`: the classifier trained on all prints. `frames` and `windows`: outputs of heads that had not
    learned from the same print. `distance` (n,): of its frames from those of the other prints."""

    model: CalibratedClassifier
    frames: ClassifierOutputs
    windows: WindowPredictions
    distance: np.ndarray


def learn(network: Classifier, frames: LabelledFrames, *, window: int, false_alarms: float) -> OwnClassifier:
    """Returns the shipped network with heads for the frames of a folder. Raises ValueError if a class is in
    too few prints, or if no print has enough frames for a window."""
    check(frames)
    data = all_frames(frames, recorded=True)
    outputs = calibrated_classifier.outputs(network, data, frames.valid, frames.surroundings)
    group = np.unique(frames.print_number, return_inverse=True)[1] % MOST_GROUPS
    unlearned = read_apart(outputs, group)
    fitted = calibration.calibrate(unlearned, unlearned, length=window, false_alarms=false_alarms)
    distance = _distances(outputs, group)
    above = calibration.foreign_above(distance[frames.valid], false_alarms=false_alarms)
    pieces = []
    for one in np.unique(group):
        mine, others = np.flatnonzero(group == one), np.flatnonzero(group != one)
        inner = read_apart(outputs.take(others), group[others])
        of_others = calibration.calibrate(inner, inner, length=window, false_alarms=false_alarms)
        seen = calibrated_classifier.window_predictions(of_others, unlearned.take(mine), length=window)
        pieces.append(seen._replace(rows=mine[seen.rows]))
    windows = calibrated_classifier.joined_windows(pieces)
    growth = spread_growth(windows)
    heads = fit_heads(outputs.take(outputs.valid))
    fitted = fitted._replace(foreign_above=above, flow=stretch(fitted.flow, growth))
    model = CalibratedClassifier(with_heads(network, heads), fitted)
    return OwnClassifier(model, unlearned, windows._replace(seen=widen(windows.seen, growth)), distance)


def spread_growth(windows: WindowPredictions) -> float:
    """Returns the factor on the spread with which a share COVERED of the windows has errors no larger than
    Gaussian ones would be; these windows were not learned from. It uses a quantile, so that one print that is
    read quite wrongly does not widen all others."""
    some = windows.any_valid
    error = np.log(windows.seen.flow_seen[some] / windows.truth.flow_percent[some])
    within = np.quantile(np.abs(error) / windows.seen.spread[some], COVERED)
    return float(within / scipy.special.ndtri((1 + COVERED) / 2))


def stretch(flow: FlowCalibration, by: float) -> FlowCalibration:
    """Returns the calibration with a spread `by` times as large."""
    return flow._replace(
        scale=by * flow.scale, looks=flow.looks._replace(explained=by * flow.looks.explained)
    )


def widen(seen: WindowFlow, by: float) -> WindowFlow:
    """Returns the same flows with a spread `by` times as large, and the class probabilities that follow."""
    some, prob = np.isfinite(seen.flow_seen), seen.prob.copy()
    prob[some] = class_probabilities(np.log(seen.flow_seen[some] / 100), by * seen.spread[some])
    return WindowFlow(seen.flow_seen, by * seen.spread, prob)


def check(frames: LabelledFrames) -> None:
    """Raises ValueError if a class has valid frames in fewer than LEAST_PRINTS prints."""
    for c, name in enumerate(CLASS_NAMES):
        prints = len(np.unique(frames.print_number[frames.valid & (frames.label == c)]))
        if prints < LEAST_PRINTS:
            raise ValueError(
                f"expected class {c}, {name}, in at least {LEAST_PRINTS} prints, found it in {prints}; "
                "record more prints with flows of every class"
            )


def fit_heads(learned: ClassifierOutputs) -> Heads:
    """Fits heads to the features of valid frames."""
    X = _features(learned)
    Y = np.column_stack([np.eye(calibration.CLASSES)[learned.label], np.log(learned.flow_percent / 100)])
    mean, deviation = X.mean(axis=0), X.std(axis=0) + 1e-6
    Z = (X - mean) / deviation
    W = np.linalg.solve(Z.T @ Z + PENALTY * np.eye(Z.shape[1]), Z.T @ (Y - Y.mean(axis=0)))
    residual = Y[:, -1] - Y[:, -1].mean() - Z @ W[:, -1]
    W /= deviation[:, None]
    return Heads(W, Y.mean(axis=0) - mean @ W, max(float(residual.std()), 0.02))


def _features(outputs: ClassifierOutputs) -> np.ndarray:
    """Returns the features that the network's last layers see, without the appearance stored beside them."""
    return outputs.features[:, : -calibration.appearance(np.zeros((1, 16, 48))).shape[1]]


def read(heads: Heads, outputs: ClassifierOutputs) -> ClassifierOutputs:
    """Returns the outputs of these heads for frames."""
    said = _features(outputs) @ heads.W + heads.b
    deviation = np.full(len(said), heads.deviation)
    return outputs._replace(logits=said[:, :-1], log_flow=said[:, -1], deviation=deviation)


def read_apart(outputs: ClassifierOutputs, group: np.ndarray) -> ClassifierOutputs:
    """Returns outputs for all frames (n,). The heads for each group learned from all other groups."""
    rows, pieces = [], []
    for one in np.unique(group):
        mine = group == one
        heads = fit_heads(outputs.take(outputs.valid & ~mine))
        rows.append(np.flatnonzero(mine))
        pieces.append(read(heads, outputs.take(mine)))
    order = np.argsort(np.concatenate(rows))
    return ClassifierOutputs(*(np.concatenate(column)[order] for column in zip(*pieces, strict=True)))


def _distances(outputs: ClassifierOutputs, group: np.ndarray) -> np.ndarray:
    """Returns the distance (n,) of each frame from the frames of the other groups."""
    distance = np.zeros(len(group))
    for one in np.unique(group):
        others = outputs.take(outputs.valid & (group != one))
        familiar = calibration.fit_familiar(others.features, others.label)
        distance[group == one] = calibration.mahalanobis(familiar, outputs.features[group == one])
    return distance


def with_heads(network: Classifier, heads: Heads) -> Classifier:
    """Returns the network with these heads in place of its own."""
    middle, reach = LOG_DEVIATION
    z = np.arctanh((np.log(heads.deviation) - middle) / reach)
    flow_W = np.column_stack([heads.W[:, -1], np.zeros(len(heads.W))])
    classes, flow = network.head.classes, network.flow_head.flow
    new = heads.W[:, :-1], heads.b[:-1], flow_W, np.array([heads.b[-1], z])
    return eqx.tree_at(
        lambda net: (net.head.classes.W, net.head.classes.b, net.flow_head.flow.W, net.flow_head.flow.b),
        network,
        tuple(
            jnp.asarray(value, old.dtype)
            for value, old in zip(new, (classes.W, classes.b, flow.W, flow.b), strict=True)
        ),
    )
