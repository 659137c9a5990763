"""What train_classifier does with its four parts: networks trained with checkpoints, calibrated, judged
beside their yardsticks; tables, metrics and a few frames of it."""

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jax
import joblib
import numpy as np
from tqdm import tqdm

from pipeline.setpoint import calibration, classifier, eyes, key_area, nozzle_scene
from pipeline.setpoint.calibration import Seen as CalibrationSeen
from pipeline.setpoint.classifier import Labelled, State
from pipeline.setpoint.eyes import Beside, Eyes, Said
from pipeline.setpoint.recorded import WindowTable
from pipeline.setpoint.vision_transformer import (
    Classifier,
    convolutional,
    from_named_arrays,
    named_arrays,
    parameters,
    vision_transformer,
)
from pipeline.setpoint.workflow.classifier_files import CLASSIFIER_SCHEMA, SIZES
from pipeline.setpoint.workflow.render_frames import Seen
from pipeline.setpoint.workflow.settings import Recipe, TrainClassifier
from pipeline.setpoint.workflow.windows import edges
from pipeline.statistics import wilson
from pipeline.store import artifacts
from pipeline.store.artifacts import read_weights, write_weights

AUGMENTATIONS = {"along_bead": classifier.along_bead, "adr": classifier.adr}
# of the yardstick that is fitted beside the networks, yardsticks.fit_profile_machine
FOLDS = 3
MEMO = Path("datasets/memo/train_classifier")


# ---- training


class Trained(NamedTuple):
    """The two networks at their best epoch, and the course of both."""

    network: Classifier
    cnn: Classifier
    course: dict[str, State]


def trained(p: TrainClassifier, found: Mapping[str, Seen], checkpoints: Path = MEMO) -> Trained:
    """The vision transformer of p.size and the small CNN, trained alike; a
    training that was killed goes on from its last epoch.

    Raises ValueError, nothing trained, where the other parts do not
    suffice for what is fitted and judged afterwards.
    """
    _check_parts(p, found)
    learned, held_out = Labelled(*found["learned"].labelled()), Labelled(*found["held_out"].labelled())
    key = jax.random.key(p.seed)
    untrained = {
        "vision transformer": (
            vision_transformer(SIZES[p.size], np.random.default_rng([p.seed, 10])),
            getattr(p, p.size),
        ),
        "convolutional network": (convolutional(np.random.default_rng([p.seed, 11])), p.cnn),
    }
    course = {
        name: _trained(name, network, recipe, p, learned, held_out, jax.random.fold_in(key, i), checkpoints)
        for i, (name, (network, recipe)) in enumerate(untrained.items())
    }
    return Trained(course["vision transformer"].best, course["convolutional network"].best, course)


def _trained(
    name: str,
    network: Classifier,
    recipe: Recipe,
    p: TrainClassifier,
    learned: Labelled,
    held_out: Labelled,
    key: jax.Array,
    checkpoints: Path,
) -> State:
    what = (
        name,
        p.size,
        p.augmentation,
        p.seed,
        recipe.model_dump(),
        [a.tobytes() for data in (learned, held_out) for a in data],
        _code(),
    )
    path = checkpoints / f"{joblib.hash(what)}.safetensors"
    state = classifier.untrained(network, epochs=recipe.epochs)
    with contextlib.suppress(ValueError):  # there is none yet, or it is damaged: from the beginning
        state = from_named_arrays(state, read_weights(path, CLASSIFIER_SCHEMA)[0])
    with tqdm(
        total=recipe.epochs,
        initial=int(state.epoch),
        desc=f"train_classifier: {name}",
        unit="epoch",
        mininterval=2,
    ) as bar:

        def on_step(state: State) -> None:
            write_weights(path, CLASSIFIER_SCHEMA, named_arrays(state), {"epoch": str(int(state.epoch))})
            bar.set_postfix(held_out=f"{float(state.history[int(state.epoch) - 1, 2]):.3f}", refresh=False)
            bar.update()

        settings = recipe.model_dump(exclude={"epochs"})
        return classifier.train(
            state,
            learned,
            held_out,
            key=key,
            augment=AUGMENTATIONS[p.augmentation],
            on_step=on_step,
            **settings,
        )


def _check_parts(p: TrainClassifier, found: Mapping[str, Seen]) -> None:
    """Raises ValueError where a class is learned in too few stretches for the yardstick's folds, a part has
    no window, or too few segments have one for the sets that are asked for (calibration.conformal_level)."""
    of = "prints" if p.source == "recordings" else "segments"
    learned = Labelled(*found["learned"].labelled())
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
        data = _all(p, found[part])
        rows = calibration.windows(data.segment, data.label, length=p.window).rows
        if not len(rows):
            raise ValueError(
                f"expected {p.window} frames in a row at one class in the frames for {part}, "
                f"found none in {len(data.label)}; "
                "record longer stretches, "
                "or lower train_classifier.window"
            )
    there, needed = (
        len(np.unique(data.segment[rows[:, 0]])),
        int(np.ceil(np.log(1 - p.confidence) / np.log(p.coverage))),
    )
    if there < needed:
        raise ValueError(
            f"expected windows of at least log(1 - confidence) / log(coverage) = {needed} "
            f"{of} to calibrate with, "
            f"found {there}; add {of}, raise "
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
    """The eyes; the judged frames and what the network sees of them; its
    windows; the small CNN's classes and the yardsticks."""

    eyes: Eyes
    data: Labelled
    frames: CalibrationSeen
    says: Said
    cnn: np.ndarray
    yardsticks: Beside


def _all(p: TrainClassifier, seen: Seen) -> Labelled:
    """All frames, rejected ones too; of a folder, what errs together is a print."""
    return Labelled(
        seen.images,
        seen.temperature,
        seen.label,
        seen.print_number if p.source == "recordings" else seen.segment,
    )


def judged(p: TrainClassifier, found: Mapping[str, Seen], networks: Trained) -> Judged:
    learned, data = Labelled(*found["learned"].labelled()), _all(p, found["judged"])
    looks = {
        part: eyes.look(networks.network, _all(p, found[part]), found[part].valid)
        for part in ("learned", "calibration", "judged")
    }
    known = calibration.calibrate(
        looks["learned"],
        looks["calibration"],
        length=p.window,
        coverage=p.coverage,
        confidence=p.confidence,
        false_alarms=p.false_alarms,
    )
    says = eyes.windows_said(known, looks["judged"], length=p.window)
    cnn = classifier.predict(networks.cnn, data.key_area, data.temperature_degC).logits.argmax(axis=1)
    return Judged(
        Eyes(networks.network, known),
        data,
        looks["judged"],
        says,
        cnn,
        eyes.beside(learned, data, says, found["judged"].valid),
    )


def metrics(p: TrainClassifier, done: Judged, networks: Trained, read: dict[str, Any]) -> dict[str, Any]:
    """Accuracies with their 95 % intervals (Wilson, as if frames and windows were
    independent), calibration, what is held, what is foreign."""
    frames, says, some, known = done.frames, done.says, done.frames.valid, done.eyes.known
    named = {
        "image": frames.logits.argmax(axis=1),
        "svc_image": done.yardsticks.svc,
        "cnn_image": done.cnn,
        "width_image": done.yardsticks.width,
    }
    right = {name: (classes == frames.label)[some] for name, classes in named.items()} | {
        "window": (says.p.argmax(axis=1) == says.label)[says.seen]
    }
    errors = {way: found for way, found in eyes.reliabilities(known, frames, length=p.window).items()}
    sets = calibration.sets(says.p[says.seen], says.label[says.seen], known.level)
    return {
        **{f"{name}_accuracy": float(np.mean(hits)) for name, hits in right.items()},
        "svc_window_accuracy": done.yardsticks.svc_window_accuracy,
        "intervals_percent": {name: [wilson(hits).low, wilson(hits).high] for name, hits in right.items()},
        "images": int(some.sum()), "windows": int(says.seen.sum()),
        "judged_segments": len(np.unique(frames.segment)),
        "ece_image": errors["image", "calibrated"].error, "ece_image_raw": errors["image", "raw"].error,
        "ece_image_floor": errors["image", "calibrated"].floor,
        "ece_window": errors["window", "log_sum"].error,
        "ece_window_counts": errors["window", "hard_counts"].error,
        "ece_window_mean": errors["window", "mean"].error,
        "ece_window_floor": errors["window", "log_sum"].floor,
        "temperature": known.temperature, "window_correlation": known.correlation,
        "conformal_level": known.level,
        "conformal": {"asked": p.coverage, "coverage": sets.coverage, "held": sets.held,
        "windows": int(says.seen.sum())},
        "out_of_distribution": eyes.knows_not(done.eyes, frames, done.data),
        "size": p.size, "augmentation": p.augmentation, "source": p.source,
        "parameters": parameters(networks.network),
        "cnn_parameters": parameters(networks.cnn),
        "epochs": {name: int(state.epoch) for name, state in networks.course.items()},
        "best_epoch": {name: int(state.best_epoch) for name, state in networks.course.items()},
        "data": read,
    }  # fmt: skip


def classified(done: Judged, flow: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of schema CLASSIFIED: the valid frames of the judged part, flow (n,) the true one."""
    frames, known = done.frames, done.eyes.known
    p = np.clip(np.exp(calibration.log_probabilities(frames.logits, known.temperature)), 0, 1)
    columns = {
        "segment": frames.segment, "flow_percent": flow, "temperature_degC": done.data.temperature_degC,
        "label": frames.label,
        "p_under": p[:, 0], "p_good": p[:, 1], "p_over": p[:, 2], "named": frames.logits.argmax(axis=1),
        "named_cnn": done.cnn,
        "named_svc": done.yardsticks.svc, "named_width": done.yardsticks.width,
        "distance": calibration.mahalanobis(known.familiar, frames.features),
    }  # fmt: skip
    return {name: values[frames.valid] for name, values in columns.items()}


def reliability_rows(p: TrainClassifier, done: Judged) -> dict[str, list]:
    """Columns of schema RELIABILITY."""
    columns: dict[str, list] = {
        name: [] for name in ("of", "method", "low", "high", "count", "confidence", "accuracy")
    }
    for (of, method), found in eyes.reliabilities(done.eyes.known, done.frames, length=p.window).items():
        n = len(found.count)
        high = np.append(found.edges[1:], 1.0)
        for name, values in zip(
            columns,
            ([of] * n, [method] * n, found.edges, high, found.count, found.confidence, found.accuracy),
            strict=True,
        ):
            columns[name] += list(values)
    return columns


def course_rows(networks: Trained) -> dict[str, list]:
    """Columns of schema COURSE."""
    rows = [
        (name, epoch + 1, *(float(v) for v in state.history[epoch]))
        for name, state in networks.course.items()
        for epoch in range(int(state.epoch))
    ]
    return dict(
        zip(
            ("learner", "epoch", "training_loss", "held_out_loss", "held_out_accuracy"),
            map(list, zip(*rows, strict=True)),
            strict=True,
        )
    )


def recorded(p: TrainClassifier, known: Eyes, several: Mapping[str, Seen]) -> dict[str, WindowTable]:
    """The windows of "learn" and "judge" as the simulator draws them
    again; of a folder, windows at one flow."""
    looks = {
        part: eyes.look(
            known.network, Labelled(seen.images, seen.temperature, seen.label, seen.segment), seen.valid
        )
        for part, seen in several.items()
    }
    said = {part: eyes.windows_said(known.known, frames, length=p.window) for part, frames in looks.items()}
    flows = {part: several[part].flow[says.rows[:, 0]] for part, says in said.items()}
    bins = edges([flows[part][says.seen] for part, says in said.items()])
    return {
        part: calibration.recorded(
            calibration.log_probabilities(looks[part].logits, known.known.temperature)[says.rows],
            looks[part].valid[says.rows],
            flows[part],
            looks[part].segment[says.rows[:, 0]], correlation=known.known.correlation, flow_edges=bins,
        )
        for part, says in said.items()
    }  # fmt: skip


# ---- a few frames for the page


def shown(p: TrainClassifier, known: Eyes, folder: Path) -> list[dict[str, Any]]:
    """Writes rendered frames with their key areas drawn in as JPEG, two of each
    class, the first rejected ones and a blurred one, and returns a row for each:
    truth, what was named, score, and why it was rejected."""
    rng = np.random.default_rng([p.seed, 9])
    rows: list[dict[str, Any]] = []
    wanted = {"under": 2, "good": 2, "over": 2, "rejected": 3}
    for i in range(200):
        if not any(wanted.values()):
            break
        flow, temperature = (
            nozzle_scene.draw_flow(rng, i % 3, 1),
            np.array([nozzle_scene.TEMPERATURES[i % 5]]),
        )
        made = nozzle_scene.render(nozzle_scene.draw_segment(rng), flow, temperature, rng)
        found = key_area.find(
            made.frames[0], made.tip, least_score=p.least_score, direction_deg=made.direction_deg
        )
        place = "rejected" if found.reason else ("under", "good", "over")[int(nozzle_scene.label(flow)[0])]
        if wanted[place] == 0:
            continue
        wanted[place] -= 1
        rows.append(
            _row(
                known,
                folder,
                len(rows),
                place,
                made.frames[0],
                made.tip,
                found,
                float(flow[0]),
                float(temperature[0]),
            )
        )
        if place == "good" and wanted["good"] == 0:
            soft = cv2.GaussianBlur(made.frames[0], (0, 0), 5.0)
            found = key_area.find(soft, made.tip, least_score=p.least_score, direction_deg=made.direction_deg)
            rows.append(
                _row(
                    known,
                    folder,
                    len(rows),
                    "out of focus",
                    soft,
                    made.tip,
                    found,
                    float(flow[0]),
                    float(temperature[0]),
                )
            )
    return rows


def _row(
    known: Eyes,
    folder: Path,
    number: int,
    place: str,
    frame: np.ndarray,
    tip,
    found,
    flow: float,
    temperature: float,
) -> dict[str, Any]:
    name = f"frame_{number:02d}.jpg"
    artifacts.write_jpeg(folder / name, key_area.drawn(frame, tip, found))
    p, score = eyes.see(known, found.image[None], np.array([temperature]))
    valid = not found.reason
    return {
        "file": name, "place": place,
        "reason": found.reason or ("foreign: further from what was learned than allowed" if score[0] > known.known.foreign_above else ""),
        "score": found.score, "direction_deg": found.angle_deg, "flow_percent": flow,
        "temperature_degC": temperature,
        "label": int(nozzle_scene.label(flow)),
        "named": int(p[0].argmax()) if valid else None, "p": p[0].tolist() if valid else None,
        "distance": float(score[0]) if valid else None, "foreign_above": known.known.foreign_above,
    }  # fmt: skip
