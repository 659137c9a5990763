"""Calibrates a classifier: its temperature for one image, the flow of a window, the distance from what was
learned, and whether it is proven on prints that were not used to train it.

Everything is fitted on segments that the classifier never saw, and tested on further ones.
"""

import itertools
from typing import NamedTuple

import numpy as np
import scipy.fft
import scipy.linalg
import scipy.optimize
import scipy.special
import scipy.stats

from pipeline.setpoint.frames.familiar import medians, windows
from pipeline.setpoint.simulation.recorded import WindowTable
from pipeline.setpoint.vision.proof import CONFIDENCE, UNPROVEN, CameraProof
from pipeline.setpoint.vision.window_flow import FlowCalibration, WindowFlow, fit_flow
from pipeline.statistics import Share

CLASSES = 3


# ---- one image


def log_probabilities(logits: np.ndarray, temperature: float) -> np.ndarray:
    """Returns log softmax(logits / T) (n, 3). The higher T, the lower the confidence (Guo, Pleiss, Sun,
    Weinberger 2017)."""
    return scipy.special.log_softmax(np.asarray(logits, float) / temperature, axis=1)


def fit_temperature(logits: np.ndarray, label: np.ndarray) -> float:
    """Returns the T, between 1/20 and 20, that makes the labels (n,) most likely."""
    label = np.asarray(label)
    fit = scipy.optimize.minimize_scalar(
        lambda log_t: -log_probabilities(logits, np.exp(log_t))[np.arange(len(label)), label].mean(),
        bounds=(-3.0, 3.0),
        method="bounded",
    )
    return float(np.exp(fit.x))


# ---- a window of images


def hard_shares(log_p: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Returns p_c = w_c / w (w, 3), the shares of the most likely classes of the valid frames (Li and
    Pattinson 2025, eq. 4; the paper then scales by p / max p). Without a valid frame: 1/3 each."""
    named = np.where(valid, log_p.argmax(axis=2), -1)
    counts = (named[:, :, None] == np.arange(CLASSES)).sum(axis=1)
    m = valid.sum(axis=1)[:, None]
    return np.where(m > 0, counts / np.maximum(m, 1), 1 / CLASSES)


def recorded(
    seen: WindowFlow, flow: np.ndarray, segment: np.ndarray, *, flow_edges: np.ndarray
) -> WindowTable:
    """Returns w windows of segments (w,) printed at flow (w,) percent as a table from which the simulator
    draws. Windows without a valid frame are left out.

    `flow_edges`: (bins + 1,) in percent. Raises ValueError if a flow lies outside them.
    """
    flow, flow_edges = np.asarray(flow, float), np.asarray(flow_edges, float)
    outside = ~((flow >= flow_edges[0]) & (flow <= flow_edges[-1]))
    if outside.any():
        raise ValueError(
            f"flows are expected within {flow_edges[0]:g} .. {flow_edges[-1]:g} % but {outside.sum()} are "
            f"not, the first {flow[outside][0]:g}; widen the bins"
        )
    some = np.isfinite(seen.flow_seen)
    seen, flow = WindowFlow(*(values[some] for values in seen)), flow[some]
    flow_bin = np.clip(np.searchsorted(flow_edges, flow, side="right") - 1, 0, len(flow_edges) - 2)
    named = seen.prob.argmax(axis=1)
    bins = flow_bin, np.asarray(segment)[some], flow_edges
    return WindowTable(seen.prob, named, *bins, seen.flow_seen, seen.spread, flow)


# ---- how true the probabilities are


class Reliability(NamedTuple):
    """For each bin of the highest probability: mean confidence, fraction correct (NaN if empty), count, lower
    edge. `error`: expected calibration error; `floor`: the error that a perfectly calibrated classifier with
    these probabilities would show on as many samples."""

    confidence: np.ndarray
    accuracy: np.ndarray
    count: np.ndarray
    edges: np.ndarray
    error: float
    floor: float


def reliability(p: np.ndarray, label: np.ndarray, *, bins: int) -> Reliability:
    """Returns the reliability of probabilities p (n, 3), in `bins` bins of equal width between 1/3 and 1, the
    range of the highest of three probabilities (Guo et al. 2017):

        ECE = sum_b n_b / n |accuracy_b - confidence_b|

    If p were exact, the number correct in a bin would scatter with deviation sqrt(sum c (1 - c)). Its mean
    absolute value is sqrt(2 / pi) of that; the floor is the sum of these over all bins, divided by n.
    """
    p, label = np.asarray(p, float), np.asarray(label)
    edges = np.linspace(1 / CLASSES, 1.0, bins + 1)
    confidence, right = p.max(axis=1), p.argmax(axis=1) == label
    place = np.clip(np.searchsorted(edges, confidence, side="right") - 1, 0, bins - 1)
    count = np.bincount(place, minlength=bins)

    error = np.abs(np.bincount(place, right - confidence, bins)).sum() / max(len(label), 1)
    floor = np.sqrt(2 / np.pi * np.bincount(place, confidence * (1 - confidence), bins)).sum() / max(
        len(label), 1
    )
    with np.errstate(invalid="ignore"):
        means = [np.bincount(place, values, bins) / count for values in (confidence, right)]
    return Reliability(*means, count, edges[:-1], float(error), float(floor))


def share_by_segment(
    happened: np.ndarray, segment: np.ndarray, *, weight: np.ndarray | None = None, confidence: float = 0.95
) -> Share:
    """Returns the percentage of True among n images or windows, with its interval. Images of one segment (n,)
    err together, so segments are treated as the random sample. `weight` (n,), of mean 1, weighs each image.

    It is Wilson's interval for n_eff = p (1 - p) / V images (Korn and Graubard 1998). V is the variance of a
    ratio of sums over segments; a factor accounts for Student's t of few segments. n_eff is at most n; it is
    the number of segments if all values are True or all False. Without images: NaN.
    """
    happened, n = np.asarray(happened, float), len(happened)
    if n == 0:
        return Share(np.nan, np.nan, np.nan)
    _, place = np.unique(segment, return_inverse=True)
    clusters, inside = int(place.max()) + 1, (1 + confidence) / 2
    weight = np.ones(n) if weight is None else weight
    p, z = float((weight * happened).sum() / n), float(scipy.special.ndtri(inside))
    residual = np.bincount(place, weight * (happened - p))
    variance = (residual**2).sum() / n**2 * clusters / max(clusters - 1, 1)
    effective = float(clusters)
    if variance > 0 and clusters > 1:
        student = float(scipy.special.stdtrit(clusters - 1, inside))
        effective = min(p * (1 - p) / variance, n) * (z / student) ** 2
    centre = (p + z**2 / (2 * effective)) / (1 + z**2 / effective)
    half = z * np.sqrt(p * (1 - p) / effective + z**2 / (4 * effective**2)) / (1 + z**2 / effective)
    return Share(100 * p, float(100 * max(centre - half, 0.0)), float(100 * min(centre + half, 1.0)))


# ---- by flow


class WindowTruth(NamedTuple):
    """Truth of w windows: class (w,), flow in percent (w,), temperature in °C (w,) and segment (w,)."""

    label: np.ndarray
    flow_percent: np.ndarray
    temperature_degC: np.ndarray
    segment: np.ndarray


# bins of the true flow in percent by which a classifier is judged
JUDGED_PERCENT = tuple(np.arange(70.0, 151.0, 5.0))


class FlowShare(NamedTuple):
    """Windows with a true flow from `flow_low` to `flow_high` percent: their number, and the percentage of
    True with its 95 % interval by segment; NaN without windows."""

    flow_low: float
    flow_high: float
    windows: int
    percent: float
    low: float
    high: float


def by_flow(happened: np.ndarray, truth: WindowTruth) -> list[FlowShare]:
    """Returns the percentage of True (w,) in each bin of JUDGED_PERCENT."""
    rows = []
    for low, high in itertools.pairwise(JUDGED_PERCENT):
        here = (truth.flow_percent >= low) & (truth.flow_percent < high)
        share = share_by_segment(happened[here], truth.segment[here])
        rows.append(FlowShare(low, high, int(here.sum()), *share))
    return rows


def uniform_share(happened: np.ndarray, truth: WindowTruth) -> Share:
    """Returns the percentage of True (w,) as if the flows were uniform over JUDGED_PERCENT. It is the mean
    over the bins; its interval follows from the variances of the bins' percentages by segment. NaN if a bin
    has no window."""
    rows = by_flow(happened, truth)
    z = scipy.special.ndtri(0.975)
    mean = float(np.mean([row.percent for row in rows]))
    half = z * np.sqrt(np.sum([((row.high - row.low) / (2 * z)) ** 2 for row in rows])) / len(rows)
    return Share(mean, float(max(mean - half, 0.0)), float(min(mean + half, 100.0)))


# ---- distance from what was learned


class Familiar(NamedTuple):
    """Mean features of the three classes (3, f), and the whitening L^-1 (f, f) of their common covariance L
    L'."""

    means: np.ndarray
    whitening: np.ndarray


def fit_familiar(features: np.ndarray, label: np.ndarray) -> Familiar:
    """Fits one Gaussian to each class's features (n, f), with a common covariance (Lee, Lee, Lee and Shin
    2018) that is shrunk (Ledoit and Wolf 2004)."""
    features, label = np.asarray(features, float), np.asarray(label)
    means = np.array([features[label == c].mean(axis=0) for c in range(CLASSES)])
    from sklearn.covariance import LedoitWolf  # imported here, since classifying does not need it

    covariance = LedoitWolf(assume_centered=True).fit(features - means[label]).covariance_
    covariance += 1e-9 * np.trace(covariance) / len(covariance) * np.eye(len(covariance))
    L = np.linalg.cholesky(covariance)
    return Familiar(means, scipy.linalg.solve_triangular(L, np.eye(len(L)), lower=True))


BAND_ROWS, BAND_COLUMNS = (
    (0, 1, 2, 4, 8),
    (0, 1, 2, 4, 8, 16, 32),
)  # where octaves of spatial frequency begin in the cosine transform of a key area


def appearance(key_area: np.ndarray) -> np.ndarray:
    """Returns the log energy of key areas (n, 16, 48) in octaves of spatial frequency, across and along the
    bead (n, 34). Each area is first scaled to mean 0 and deviation 1.

    A network trained for width learns to ignore much else. Its features hardly change with blur or a wrong
    angle, but the energy in these bands does.
    """
    x = np.asarray(key_area, np.float32)
    x = x - x.mean(axis=(1, 2), keepdims=True)
    x /= np.sqrt((x**2).mean(axis=(1, 2), keepdims=True)) + 1
    energy = scipy.fft.dctn(x, axes=(1, 2), norm="ortho") ** 2
    bands = np.add.reduceat(np.add.reduceat(energy, BAND_ROWS, axis=1), BAND_COLUMNS, axis=2)
    return (
        np.log(bands + 0.01).reshape(len(x), -1)[:, 1:].astype(float)
    )  # 0.01 of 768: rounding to gray levels; the mean is left out


def mahalanobis(familiar: Familiar, features: np.ndarray) -> np.ndarray:
    """Returns min_c (f - mu_c)' Sigma^-1 (f - mu_c) (n,): how unfamiliar each image is."""
    white = np.asarray(features, float) @ familiar.whitening.T
    return np.min(
        [((white - mean) ** 2).sum(axis=1) for mean in familiar.means @ familiar.whitening.T], axis=0
    )


def foreign_above(scores: np.ndarray, *, false_alarms: float) -> float:
    """Returns the score that at most a fraction `false_alarms` of familiar images exceeds."""
    scores = np.sort(np.asarray(scores, float))
    return float(scores[int(np.ceil((1 - false_alarms) * len(scores))) - 1])


def auroc(familiar: np.ndarray, foreign: np.ndarray) -> float:
    """Returns the probability that the score of a foreign image exceeds that of a familiar one. A tie counts
    one half (Mann and Whitney 1947)."""
    return float(scipy.stats.mannwhitneyu(foreign, familiar).statistic / (len(familiar) * len(foreign)))


# ---- all of it together


class ClassifierOutputs(NamedTuple):
    """A network's outputs on n frames: logits (n, 3), features with appearance (n, f), log(flow / 100 %) (n,)
    and its standard deviation (n,). With the frames' label, flow in percent, temperature in °C, segment and
    validity (n,), and their looks (n, measures), NaN for frames that were not measured."""

    logits: np.ndarray
    features: np.ndarray
    log_flow: np.ndarray
    deviation: np.ndarray
    label: np.ndarray
    flow_percent: np.ndarray
    temperature_degC: np.ndarray
    segment: np.ndarray
    valid: np.ndarray
    looks: np.ndarray

    def take(self, rows: np.ndarray) -> "ClassifierOutputs":
        return ClassifierOutputs(*(a[rows] for a in self))


class ClassifierCalibration(NamedTuple):
    """Turns outputs into decisions: `temperature` of single images; `familiar` and `foreign_above`, the
    distance above which an image is foreign; `flow`, from the flows of frames to that of a window; `proof`,
    whether the classifier may be used at all."""

    temperature: float
    familiar: Familiar
    foreign_above: float
    flow: FlowCalibration
    proof: CameraProof


def calibrate(
    learned: ClassifierOutputs, unseen: ClassifierOutputs, *, length: int, false_alarms: float
) -> ClassifierCalibration:
    """Fits everything on segments that were `unseen` in training, except the familiar features, which come
    from `learned`. Windows have `length` frames. The result is not yet proven. Raises ValueError if no
    segment has `length` frames."""
    v = unseen.valid
    T = fit_temperature(unseen.logits[v], unseen.label[v])
    rows = windows(unseen.segment, length=length)
    if not len(rows):
        raise ValueError(
            f"expected a segment with {length} frames in a row but found none among {len(v)} frames; "
            "film longer ones, or take shorter windows"
        )
    looks = medians(unseen.looks, rows)
    middle = unseen.flow_percent[rows[:, length // 2]]
    flow = fit_flow(unseen.log_flow[rows], unseen.deviation[rows], v[rows], looks, middle)
    familiar = fit_familiar(learned.features[learned.valid], learned.label[learned.valid])
    distance = mahalanobis(familiar, unseen.features[v])
    above = foreign_above(distance, false_alarms=false_alarms)
    return ClassifierCalibration(T, familiar, above, flow, UNPROVEN)


def prove(
    named: np.ndarray, truth: WindowTruth, *, least: float, known_from: int, rendered: bool
) -> CameraProof:
    """Returns what the classes named (w,) prove about the classifier; the windows' segments or prints were
    not used to train it."""
    n, of_class = len(named), np.bincount(truth.label, minlength=CLASSES)
    weight = n / CLASSES / of_class[truth.label]
    share = share_by_segment(
        named == truth.label, truth.segment, weight=weight, confidence=2 * CONFIDENCE - 1
    )
    prints = len(np.unique(truth.segment))
    return CameraProof(share.percent / 100, share.low / 100, least, n, prints, known_from, rendered)
