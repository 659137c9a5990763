"""What train_classifier does with its four parts: networks trained with checkpoints, calibrated, judged
beside their yardsticks; tables, metrics and a few frames of it."""

import contextlib
import functools
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import cv2
import jax
import joblib
import numpy as np
from tqdm import tqdm

from pipeline.setpoint.frames import key_area, nozzle_scene
from pipeline.setpoint.simulation.recorded import WindowTable
from pipeline.setpoint.vision import calibrated_classifier, calibration, classifier
from pipeline.setpoint.vision.calibrated_classifier import (
    CalibratedClassifier,
    WindowPredictions,
    YardstickClasses,
)
from pipeline.setpoint.vision.calibration import ClassifierOutputs, Promise, WindowTruth
from pipeline.setpoint.vision.classifier import Labelled, TrainingSettings, TrainState
from pipeline.setpoint.vision.vision_transformer import (
    Classifier,
    convolutional,
    from_named_arrays,
    named_arrays,
    parameters,
    vision_transformer,
)
from pipeline.setpoint.workflow.classifier_files import CLASSIFIER_SCHEMA, SIZES
from pipeline.setpoint.workflow.render_frames import LabelledFrames
from pipeline.setpoint.workflow.settings import TrainClassifier
from pipeline.setpoint.workflow.windows import edges
from pipeline.store import artifacts
from pipeline.store.artifacts import read_weights, write_weights

AUGMENTATIONS = {"along_bead": classifier.along_bead, "adr": classifier.adr}
# of the yardstick that is fitted beside the networks, yardsticks.fit_profile_machine
FOLDS = 3
# yardsticks, the small CNN among them, learn from one frame in so many: they take ten times as long a frame
EVERY = 3
MEMO = Path("datasets/memo/train_classifier")


# ---- training


class Trained(NamedTuple):
    """The two networks at their best epoch, and the learning curves of both."""

    network: Classifier
    cnn: Classifier
    curves: dict[str, TrainState]


def trained(
    settings: TrainClassifier, by_part: Mapping[str, LabelledFrames], checkpoints: Path = MEMO
) -> Trained:
    """The vision transformer of settings.size, and the small CNN on one frame in EVERY; a
    training that was killed goes on from its last epoch.

    Raises ValueError, nothing trained, where the other parts do not
    suffice for what is fitted and judged afterwards.
    """
    _check_parts(settings, by_part)
    learned, held_out = (Labelled(*by_part[part].labelled()) for part in ("learned", "held_out"))
    key, size = jax.random.key(settings.seed), SIZES[settings.size]
    untrained = {
        "vision transformer": (
            vision_transformer(size, np.random.default_rng([settings.seed, 10])),
            getattr(settings, settings.size),
        ),
        "convolutional network": (convolutional(np.random.default_rng([settings.seed, 11])), settings.cnn),
    }
    trainings: dict[str, Callable[[], TrainState]] = {}
    to_learn = {"vision transformer": learned, "convolutional network": fewer(learned)}
    for i, (name, (network, recipe)) in enumerate(untrained.items()):
        inputs = settings.size, settings.augmentation, settings.seed, recipe.model_dump()
        what = (name, *inputs, [a.tobytes() for data in (to_learn[name], held_out) for a in data], _code())
        train = functools.partial(
            classifier.train,
            learned=to_learn[name],
            held_out=held_out,
            settings=TrainingSettings(**recipe.model_dump(exclude={"epochs"})),
            key=jax.random.fold_in(key, i),
            augment=AUGMENTATIONS[settings.augmentation],
        )
        state = classifier.untrained(network, epochs=recipe.epochs)
        trainings[name] = functools.partial(
            _resumed, train, state, name, checkpoints / f"{joblib.hash(what)}.safetensors"
        )
    # at the same time: neither keeps both cores busy, and neither knows of the other
    with ThreadPoolExecutor(len(trainings)) as pool:
        running = {name: pool.submit(training) for name, training in trainings.items()}
    curves = {name: training.result() for name, training in running.items()}
    return Trained(curves["vision transformer"].best, curves["convolutional network"].best, curves)


def fewer(learned: Labelled) -> Labelled:
    """Of each class one frame in EVERY: what the yardsticks learn from."""
    of_class = (np.flatnonzero(learned.label == c)[::EVERY] for c in range(3))
    return learned.take(np.sort(np.concatenate([*of_class])))


def _resumed(train: Callable, state: TrainState, name: str, checkpoint: Path) -> TrainState:
    """train(state, on_step=...) from the checkpoint, where there is one; it is written after each epoch."""
    with contextlib.suppress(ValueError):  # there is none yet, or it is damaged: from the beginning
        state = from_named_arrays(state, read_weights(checkpoint, CLASSIFIER_SCHEMA)[0])
    with tqdm(
        total=len(state.history),
        initial=int(state.epoch),
        desc=f"train_classifier: {name}",
        unit="epoch",
        mininterval=2,
    ) as bar:

        def on_step(state: TrainState) -> None:
            epoch = int(state.epoch)
            write_weights(checkpoint, CLASSIFIER_SCHEMA, named_arrays(state), {"epoch": str(epoch)})
            bar.set_postfix(held_out=f"{float(state.history[epoch - 1, 2]):.3f}", refresh=False)
            bar.update()

        return train(state, on_step=on_step)


def _check_parts(settings: TrainClassifier, by_part: Mapping[str, LabelledFrames]) -> None:
    """Raises ValueError where a class is learned in too few stretches for the yardstick's folds, a part has
    no window, or too few segments have one for the sets that are asked for (calibration.conformal_level)."""
    of = "prints" if settings.source == "recordings" else "segments"
    learned = Labelled(*by_part["learned"].labelled())
    for c, name in enumerate(classifier.CLASS_NAMES):
        stretches = len(np.unique(learned.segment[learned.label == c]))
        if stretches < FOLDS:
            raise ValueError(
                f"expected at least {FOLDS} stretches of constant settings of class {c}, {name}, "
                f"to learn from, found {stretches}; "
                "record more prints, "
                f"or raise train_classifier.{of}.learned"
            )
    for part in ("judged", "calibration"):
        data = _all(settings, by_part[part])
        rows = calibration.windows(data.segment, data.label, length=settings.window).rows
        if not len(rows):
            raise ValueError(
                f"expected {settings.window} frames in a row at one class in the frames for {part}, "
                f"found none in {len(data.label)}; "
                "record longer stretches, "
                "or lower train_classifier.window"
            )
    calibrated, needed = (
        len(np.unique(data.segment[rows[:, 0]])),
        int(np.ceil(np.log(1 - settings.confidence) / np.log(settings.coverage))),
    )
    if calibrated < needed:
        raise ValueError(
            f"expected windows of at least log(1 - confidence) / log(coverage) = {needed} "
            f"{of} to calibrate with, "
            f"found {calibrated}; add {of}, raise "
            f"train_classifier.{of}.calibration, or lower train_classifier.coverage or confidence"
        )


def _code() -> list[str]:
    """What decides where a training ends, beside its data and settings."""
    return [
        artifacts.sha256(Path(__file__).parents[1] / name)
        for name in ("classifier.py", "vision_transformer.py")
    ]


# ---- what it is worth


class Judged(NamedTuple):
    """The calibrated classifier; the judged frames, its outputs on them, and its windows; the small CNN's
    classes and the yardsticks'."""

    model: CalibratedClassifier
    data: Labelled
    frames: ClassifierOutputs
    windows: WindowPredictions
    cnn: np.ndarray
    yardsticks: YardstickClasses


def _all(settings: TrainClassifier, frames: LabelledFrames) -> Labelled:
    """All frames, rejected ones too; of a folder, what errs together is a print."""
    return Labelled(
        frames.images,
        frames.temperature,
        frames.label,
        frames.flow,
        frames.print_number if settings.source == "recordings" else frames.segment,
    )


OUTPUTS_OF = ("learned", "calibration", "judged")
Given = TypeVar("Given")
Made = TypeVar("Made")


def _each(parts: Mapping[str, Given], work: Callable[[Given], Made]) -> dict[str, Made]:
    """work of each part, on every core at once; what comes out does not depend on the cores."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return dict(zip(parts, pool.map(work, parts.values()), strict=True))


def judged(settings: TrainClassifier, by_part: Mapping[str, LabelledFrames], networks: Trained) -> Judged:
    """The networks calibrated on one part and judged on another, beside their yardsticks."""
    learned, data = fewer(Labelled(*by_part["learned"].labelled())), _all(settings, by_part["judged"])
    parts = {part: (_all(settings, by_part[part]), by_part[part].valid) for part in OUTPUTS_OF}
    outputs = _each(parts, lambda part: calibrated_classifier.outputs(networks.network, *part))
    fitted = calibration.calibrate(
        outputs["learned"],
        outputs["calibration"],
        length=settings.window,
        promise=Promise(settings.coverage, settings.confidence, settings.coverage_by_flow),
        false_alarms=settings.false_alarms,
    )
    windows = calibrated_classifier.window_predictions(fitted, outputs["judged"], length=settings.window)
    cnn = classifier.predict(networks.cnn, data.key_area, data.temperature_degC).logits.argmax(axis=1)
    return Judged(
        CalibratedClassifier(networks.network, fitted),
        data,
        outputs["judged"],
        windows,
        cnn,
        calibrated_classifier.yardstick_classes(learned, data, windows, by_part["judged"].valid),
    )


def metrics(
    settings: TrainClassifier, result: Judged, networks: Trained, read: dict[str, Any]
) -> dict[str, Any]:
    """Accuracies with their 95 % intervals by segment, also by flow; calibration, what is held, what is
    foreign."""
    frames, valid, fitted = result.frames, result.frames.valid, result.model.calibration
    named = {
        "image": frames.logits.argmax(axis=1),
        "svc_image": result.yardsticks.svc,
        "cnn_image": result.cnn,
        "width_image": result.yardsticks.width,
    }
    prob, truth = judged_windows(result)
    right = prob.argmax(axis=1) == truth.label
    shares = {
        name: calibration.share_by_segment((classes == frames.label)[valid], frames.segment[valid])
        for name, classes in named.items()
    } | {"window": calibration.share_by_segment(right, truth.segment)}
    uniform = calibration.uniform_share(right, truth)
    errors = calibrated_classifier.reliabilities(fitted, frames, length=settings.window)
    sets = calibration.sets(prob, truth.label, fitted.level)
    return {
        **{f"{name}_accuracy": share.percent / 100 for name, share in shares.items()},
        "svc_window_accuracy": result.yardsticks.svc_window_accuracy,
        "intervals_percent": {name: [share.low, share.high] for name, share in shares.items()},
        "right_70_150": _finite(uniform),
        "by_flow": [_finite(row) for row in calibration.by_flow(right, truth)],
        "coverage_by_flow": [
            _finite(row)
            for row in calibration.by_flow(
                calibration.holds_true_class(prob, truth.label, fitted.level), truth
            )
        ],
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
        "conformal": {"asked": settings.coverage, "coverage": sets.coverage, "held": sets.held,
        "windows": len(right)},
        "out_of_distribution": calibrated_classifier.foreign_detection(result.model, frames, result.data),
        "size": settings.size, "augmentation": settings.augmentation, "source": settings.source,
        "parameters": parameters(networks.network),
        "cnn_parameters": parameters(networks.cnn),
        "epochs": {name: int(state.epoch) for name, state in networks.curves.items()},
        "best_epoch": {name: int(state.best_epoch) for name, state in networks.curves.items()},
        "data": read,
    }  # fmt: skip


def judged_windows(result: Judged) -> tuple[np.ndarray, WindowTruth]:
    """Probabilities (w, 3) and truth of the judged windows that have a valid frame."""
    windows = result.windows
    return windows.seen.prob[windows.any_valid], WindowTruth(
        *(column[windows.any_valid] for column in windows.truth)
    )


def _finite(row: NamedTuple) -> dict[str, float | None]:
    """A row for JSON: None where there is no figure."""
    return {name: value if np.isfinite(value) else None for name, value in row._asdict().items()}


def classified(result: Judged, flow: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of schema CLASSIFIED: the valid frames of the judged part, flow (n,) the true one."""
    frames, fitted = result.frames, result.model.calibration
    prob = np.clip(np.exp(calibration.log_probabilities(frames.logits, fitted.temperature)), 0, 1)
    columns = {
        "segment": frames.segment, "flow_percent": flow, "temperature_degC": result.data.temperature_degC,
        "label": frames.label,
        "p_under": prob[:, 0], "p_good": prob[:, 1], "p_over": prob[:, 2],
        "named": frames.logits.argmax(axis=1),
        "named_cnn": result.cnn,
        "named_svc": result.yardsticks.svc, "named_width": result.yardsticks.width,
        "distance": calibration.mahalanobis(fitted.familiar, frames.features),
    }  # fmt: skip
    return {name: values[frames.valid] for name, values in columns.items()}


def reliability_rows(settings: TrainClassifier, result: Judged) -> dict[str, list]:
    """Columns of schema RELIABILITY."""
    columns: dict[str, list] = {
        name: [] for name in ("of", "method", "low", "high", "count", "confidence", "accuracy")
    }
    bins = calibrated_classifier.reliabilities(
        result.model.calibration, result.frames, length=settings.window
    )
    for (of, method), reliability in bins.items():
        n = len(reliability.count)
        high = np.append(reliability.edges[1:], 1.0)
        for name, values in zip(
            columns,
            (
                [of] * n,
                [method] * n,
                reliability.edges,
                high,
                reliability.count,
                reliability.confidence,
                reliability.accuracy,
            ),
            strict=True,
        ):
            columns[name] += list(values)
    return columns


def curve_rows(networks: Trained) -> dict[str, list]:
    """Columns of schema CLASSIFIER_CURVE."""
    rows = [
        (name, epoch + 1, *(float(v) for v in state.history[epoch]))
        for name, state in networks.curves.items()
        for epoch in range(int(state.epoch))
    ]
    return dict(
        zip(
            ("learner", "epoch", "training_loss", "held_out_loss", "held_out_accuracy"),
            map(list, zip(*rows, strict=True)),
            strict=True,
        )
    )


def recorded(
    settings: TrainClassifier, model: CalibratedClassifier, by_part: Mapping[str, LabelledFrames]
) -> dict[str, WindowTable]:
    """The windows of WINDOW_PARTS as the simulator draws them again; of a folder, windows at one flow."""

    def of(frames: LabelledFrames) -> WindowPredictions:
        truth = frames.temperature, frames.label, frames.flow, frames.segment
        outputs = calibrated_classifier.outputs(model.network, Labelled(frames.images, *truth), frames.valid)
        return calibrated_classifier.window_predictions(model.calibration, outputs, length=settings.window)

    windows = _each(by_part, of)
    bins = edges([of.truth.flow_percent[of.any_valid] for of in windows.values()])
    return {
        part: calibration.recorded(of.seen, of.truth.flow_percent, of.truth.segment, flow_edges=bins)
        for part, of in windows.items()
    }


# ---- a few frames for the page


class Shown(NamedTuple):
    """A rendered frame for the page: its place there, the picture, tip and key area, and the truth."""

    place: str
    frame: np.ndarray
    tip: tuple[float, float]
    area: key_area.KeyArea
    flow: float
    temperature: float


def shown(settings: TrainClassifier, model: CalibratedClassifier, folder: Path) -> list[dict[str, Any]]:
    """Writes rendered frames with their key areas drawn in as JPEG, two of each
    class, the first rejected ones and a blurred one, and returns a row for each:
    truth, what was named, score, and why it was rejected."""
    rng = np.random.default_rng([settings.seed, 9])
    rows: list[dict[str, Any]] = []
    wanted = {"under": 2, "good": 2, "over": 2, "rejected": 3}
    for i in range(200):
        if not any(wanted.values()):
            break
        flow, temperature = (
            nozzle_scene.draw_class_flow(rng, i % 3, 1),
            np.array([nozzle_scene.TEMPERATURES[i % 5]]),
        )
        scene = nozzle_scene.render(nozzle_scene.draw_segment(rng), flow, temperature, rng)
        frame, direction = scene.frames[0], scene.direction_deg
        area = key_area.find(frame, scene.tip, least_score=settings.least_score, direction_deg=direction)
        place = "rejected" if area.reason else ("under", "good", "over")[int(nozzle_scene.label(flow)[0])]
        if wanted[place] == 0:
            continue
        wanted[place] -= 1
        one = Shown(place, frame, scene.tip, area, float(flow[0]), float(temperature[0]))
        rows.append(_row(model, folder, len(rows), one))
        if place == "good" and wanted["good"] == 0:
            soft = cv2.GaussianBlur(frame, (0, 0), 5.0)
            area = key_area.find(soft, scene.tip, least_score=settings.least_score, direction_deg=direction)
            one = one._replace(place="out of focus", frame=soft, area=area)
            rows.append(_row(model, folder, len(rows), one))
    return rows


def _row(model: CalibratedClassifier, folder: Path, number: int, one: Shown) -> dict[str, Any]:
    name, area, limit = f"frame_{number:02d}.jpg", one.area, model.calibration.foreign_above
    artifacts.write_jpeg(folder / name, key_area.drawn(one.frame, one.tip, area))
    prob, score = calibrated_classifier.classify(model, area.image[None], np.array([one.temperature]))
    valid = not area.reason
    foreign = "foreign: further from what was learned than allowed" if score[0] > limit else ""
    return {
        "file": name,
        "place": one.place,
        "reason": area.reason or foreign,
        "score": area.score,
        "direction_deg": area.angle_deg,
        "flow_percent": one.flow,
        "temperature_degC": one.temperature,
        "label": int(nozzle_scene.label(one.flow)),
        "named": int(prob[0].argmax()) if valid else None,
        "p": prob[0].tolist() if valid else None,
        "distance": float(score[0]) if valid else None,
        "foreign_above": limit,
    }
