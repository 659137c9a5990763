"""Reference methods that a network must beat: the bead's width by Otsu's threshold with two limits, and a
support vector machine on the bead's profile."""

from typing import NamedTuple

import cv2
import numpy as np
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import StratifiedGroupKFold, cross_val_predict
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC


class WidthRule(NamedTuple):
    """Class 0 below `low`, 2 from `high` on, 1 between. Widths are in rows of the key area."""

    low: float
    high: float


class ProfileMachine(NamedTuple):
    """A support vector machine on profiles, and the logistic map from its three decision values to
    probabilities."""

    machine: Pipeline
    probability: LogisticRegression


def widths(images: np.ndarray) -> np.ndarray:
    """Returns the width of the bead (n,) in each key area (n, 16, 48): the mean over its columns of the
    number of rows at or above Otsu's threshold."""
    return np.array(
        [
            np.mean(image >= cv2.threshold(image, 0, 255, cv2.THRESH_OTSU)[0]) * image.shape[0]
            for image in images
        ]
    )


def fit_width_rule(images: np.ndarray, label: np.ndarray) -> WidthRule:
    """Returns the two limits that classify most key areas (n, 16, 48) with labels (n,) 0 1 2 correctly. The
    search is exact: it covers every pair of widths that occur."""
    width = widths(images)
    order = np.argsort(width, kind="stable")
    w, y = width[order], np.asarray(label)[order]
    # right answers if the first i are class 0, the first j classes 0
    # and 1: gains of moving a limit past one more image
    first = np.concatenate([[0], np.cumsum((y == 0).astype(int) - (y == 1))])
    second = np.concatenate([[0], np.cumsum((y == 1).astype(int) - (y == 2))])
    edges = np.concatenate([[-np.inf], (w[1:] + w[:-1]) / 2, [np.inf]])
    # ties cannot be told apart: a limit lies only where the width changes
    usable = np.concatenate([[True], w[1:] > w[:-1], [True]])
    first, second, edges = first[usable], second[usable], edges[usable]
    best = np.maximum.accumulate(first)
    j = int(np.argmax(best + second))
    return WidthRule(float(edges[int(np.argmax(first[: j + 1]))]), float(edges[j]))


def width_class(rule: WidthRule, images: np.ndarray) -> np.ndarray:
    """Returns the classes (n,) of key areas (n, 16, 48)."""
    width = widths(images)
    return (width >= rule.low).astype(np.int64) + (width >= rule.high)


def profiles(images: np.ndarray, temperature: np.ndarray) -> np.ndarray:
    """Returns profiles (n, 17): the mean of each row of the key areas (n, 16, 48), and the temperature (n,)
    in degC."""
    return np.column_stack([images.mean(axis=2), temperature])


def fit_profile_machine(
    images: np.ndarray, temperature: np.ndarray, label: np.ndarray, segment: np.ndarray, *, folds: int = 3
) -> ProfileMachine:
    """Fits the machine (Gaussian kernel, C = 1) to all images. Its probabilities are fitted to decision
    values from `folds` folds, for segments that the machine had not seen."""
    x = profiles(images, temperature)
    machine = make_pipeline(StandardScaler(), SVC(decision_function_shape="ovr"))
    unseen = cross_val_predict(
        machine, x, label, groups=segment, cv=StratifiedGroupKFold(folds), method="decision_function"
    )
    return ProfileMachine(machine.fit(x, label), LogisticRegression(max_iter=1000).fit(unseen, label))


def profile_probabilities(fitted: ProfileMachine, images: np.ndarray, temperature: np.ndarray) -> np.ndarray:
    """Returns the probabilities of the classes 0 1 2 (n, 3)."""
    return fitted.probability.predict_proba(fitted.machine.decision_function(profiles(images, temperature)))
