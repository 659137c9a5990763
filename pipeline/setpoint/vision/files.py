"""Stores the results of train_classifier, the classifier with its calibration, in two files, and restores
them."""

import contextlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from tqdm import tqdm

from pipeline.setpoint.frames.familiar import NAMES
from pipeline.setpoint.vision import calibration
from pipeline.setpoint.vision.calibrated_classifier import CalibratedClassifier
from pipeline.setpoint.vision.calibration import ClassifierCalibration
from pipeline.setpoint.vision.classifier import TrainState
from pipeline.setpoint.vision.proof import CameraProof
from pipeline.setpoint.vision.vision_transformer import (
    PAPER,
    SMALL,
    Classifier,
    from_named_arrays,
    named_arrays,
    vision_transformer,
)
from pipeline.setpoint.vision.window_flow import KNOTS_PERCENT, FlowCalibration, LookCorrection
from pipeline.store import artifacts
from pipeline.store.artifacts import read_weights, write_weights

SIZES = {"small": SMALL, "paper": PAPER}
CLASSIFIER_SCHEMA, CALIBRATION = "classifier 2", ("classifier_calibration", 3)


def store_classifier(folder: Path, size: str, model: CalibratedClassifier) -> None:
    """Writes weights.safetensors, and calibration.parquet with everything that was fitted after training."""
    write_weights(
        folder / "weights.safetensors", CLASSIFIER_SCHEMA, named_arrays(model.network), {"size": size}
    )
    fitted = model.calibration
    numbers = {
        "temperature": (np.array(fitted.temperature), "1", "logits of single images are divided by it"),
        "foreign_above": (
            np.array(fitted.foreign_above),
            "1",
            "squared Mahalanobis distance above which a frame is foreign",
        ),
        "means": (fitted.familiar.means, "1", "mean features of the three classes"),
        "whitening": (fitted.familiar.whitening, "1", "inverse Cholesky factor of their covariance"),
        "flow_shown": (
            fitted.flow.shown,
            "1",
            "log(flow / 100 %) that frames show on average at the flows of calibration.KNOTS_PERCENT",
        ),
        "flow_scale": (fitted.flow.scale, "1", "deviations of frames are multiplied by it there"),
        "flow_correlation": (np.array(fitted.flow.correlation), "1", "of the errors of a window's frames"),
        **{
            f"looks_{name}": (np.asarray(value), "1", f"window_flow.LookCorrection.{name}")
            for name, value in fitted.flow.looks._asdict().items()
        },
        **{
            f"proof_{name}": (np.array(float(value)), "1", f"proof.CameraProof.{name}")
            for name, value in fitted.proof._asdict().items()
        },
    }
    artifacts.write_arrays(folder / "calibration.parquet", *CALIBRATION, numbers)


def restore_network(weights_path: str) -> tuple[Classifier, str]:
    """Returns the network that `store_classifier` wrote, and its size. Raises ValueError if the file has no
    known size."""
    arrays, about = read_weights(weights_path, CLASSIFIER_SCHEMA)
    if about.get("size") not in SIZES:
        raise ValueError(
            f"{weights_path} should say its size, {' or '.join(SIZES)}, but says {about.get('size')}; "
            f"{artifacts.remedy(weights_path)}"
        )
    with artifacts.about(weights_path):
        network = from_named_arrays(
            vision_transformer(SIZES[about["size"]], np.random.default_rng(0)), arrays
        )
    return network, about["size"]


def restore_classifier(weights_path: str, calibration_path: str) -> CalibratedClassifier:
    """Returns the classifier that `store_classifier` wrote."""
    network, _ = restore_network(weights_path)
    knots, measures = (len(KNOTS_PERCENT),), (len(NAMES),)
    shapes = {"flow_shown": knots, "flow_scale": knots}
    shapes |= {f"looks_{name}": measures for name in ("mean", "deviation", "weight")}
    fitted = artifacts.read_arrays(calibration_path, *CALIBRATION, shapes=shapes)
    looks = LookCorrection(
        *(fitted[f"looks_{name}"] for name in ("mean", "deviation", "weight")),
        float(fitted["looks_explained"]),
    )
    right, low, least, *counts, rendered = (float(fitted[f"proof_{name}"]) for name in CameraProof._fields)
    proof = CameraProof(right, low, least, *map(int, counts), bool(rendered))
    correlation = float(fitted["flow_correlation"])
    return CalibratedClassifier(
        network,
        ClassifierCalibration(
            float(fitted["temperature"]),
            calibration.Familiar(fitted["means"], fitted["whitening"]),
            float(fitted["foreign_above"]),
            FlowCalibration(fitted["flow_shown"], fitted["flow_scale"], correlation, looks),
            proof,
        ),
    )


def train_from_checkpoint(train: Callable, state: TrainState, checkpoint: Path) -> TrainState:
    """Returns train(state, on_step=...), continued from the checkpoint if there is one. Writes the checkpoint
    after each epoch."""
    with contextlib.suppress(ValueError):  # no checkpoint, or a damaged one: start from the beginning
        state = from_named_arrays(state, read_weights(checkpoint, CLASSIFIER_SCHEMA)[0])
    done, words = int(state.epoch), "train_classifier"
    with tqdm(total=len(state.history), initial=done, desc=words, unit="epoch", mininterval=2) as bar:

        def on_step(state: TrainState) -> None:
            epoch = int(state.epoch)
            arrays = named_arrays(state)
            write_weights(checkpoint, CLASSIFIER_SCHEMA, arrays, {"epoch": str(epoch)})
            bar.set_postfix(held_out=f"{float(state.history[epoch - 1, 2]):.3f}", refresh=False)
            bar.update()

        return train(state, on_step=on_step)
