"""Nozzle frames -> classifier of the flow: reads datasets/render_frames, or datasets/raw/setpoint and the
shipped network's weights; writes datasets/train_classifier: weights.safetensors and calibration.parquet of
the vision transformer, classified.parquet and reliability.parquet of the frames it is judged on,
course.parquet, windows.parquet for the simulator, frames for the page, and known_camera.parquet, by which
frames of other cameras are foreign."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import stages
from pipeline.setpoint.settings import SetpointMaterial, TrainClassifier
from pipeline.setpoint.tables import (
    CLASSIFIED,
    CLASSIFIER_CURVE,
    FRAME_PARTS,
    RELIABILITY,
    WINDOW_PARTS,
    WINDOWS,
)
from pipeline.store import artifacts, params
from pipeline.store.params import Execution

RENDERED, RAW = Path("datasets/render_frames"), Path("datasets/raw/setpoint")
# the network whose features few own pictures are read by
SHIPPED = "datasets/kept/train_classifier/weights.safetensors"
CHECKPOINTS = Path("datasets/memo/train_classifier")
# the code that decides where a training ends, beside its data and settings
VISION = Path(__file__).parents[1] / "pipeline/setpoint/vision"
CODE = (VISION / "classifier.py", VISION / "vision_transformer.py")
# figures of control that git keeps and that runs are compared by
METRICS = (
    "*_accuracy",
    "right_70_150",
    "images",
    "windows",
    "ece_*",
    "proof.*",
    "out_of_distribution.false_alarms",
    "out_of_distribution.*.found",
)


class Learned(NamedTuple):
    """The CalibratedClassifier, not proven yet; its Assessment; WindowPredictions by part of WINDOW_PARTS, of
    segments or prints that it had not learned from; the TrainState of the network, None if none was trained;
    and more figures."""

    model: Any
    judged: Any
    windows: dict[str, Any]
    trained: Any
    figures: dict[str, Any]


def main() -> None:
    with artifacts.stage("train_classifier") as out:
        settings = params.load(TrainClassifier, "train_classifier")
        execution = params.load(Execution, "execution")
        material = params.load(SetpointMaterial, "setpoint_material").material()
        from pipeline.setpoint.frames import files as camera_files
        from pipeline.setpoint.frames.familiar import fit_recorded_camera
        from pipeline.setpoint.simulation.recorded import window_rows
        from pipeline.setpoint.vision import assessment
        from pipeline.setpoint.vision.files import store_classifier

        rendered = settings.source == "simulated"
        if rendered:
            learned, pictures = learn_rendered(settings)
            camera = camera_files.restore_camera(RENDERED / camera_files.CAMERA_FILE)
            known_from = 0 if camera is None else 2 * len(camera.scores)
        else:
            learned, pictures, recordings = learn_recordings(settings, execution, material)
            looks = recordings.surroundings, recordings.segment
            camera, known_from = fit_recorded_camera(*looks, length=settings.window)
        fitted = assessment.proven(
            learned.model.calibration,
            learned.judged.windows,
            least=settings.least_right,
            known_from=known_from,
            rendered=rendered,
        )
        judged, model = learned.judged._replace(fitted=fitted), learned.model._replace(calibration=fitted)
        store_classifier(out, learned.figures["size"], model)
        artifacts.write_table(out / "classified.parquet", CLASSIFIED, assessment.classified(judged))
        artifacts.write_table(out / "reliability.parquet", RELIABILITY, assessment.reliability(judged))
        columns = assessment.curve(learned.trained)
        artifacts.write_table(out / "course.parquet", CLASSIFIER_CURVE, columns)
        losses = ("training_loss", "held_out_loss", "held_out_accuracy")
        artifacts.write_learning_curve(out / "live", columns, of="learner", step="epoch", figures=losses)
        windows = window_rows(assessment.window_tables(learned.windows))
        artifacts.write_table(out / "windows.parquet", WINDOWS, windows)
        write_frames(out / "frames", pictures)
        camera_files.store_camera(out / camera_files.CAMERA_FILE, camera)
        more = learned.figures | {"source": settings.source}
        artifacts.write_metrics("train_classifier", assessment.figures(judged) | more, METRICS)


# ---- what is learned from


def learn_rendered(settings: TrainClassifier) -> tuple[Learned, Iterator[tuple[Any, dict[str, Any]]]]:
    """What is learned from rendered frames, and pictures of some of them for the page. No segment is in two
    parts."""
    import numpy as np

    from pipeline.setpoint.frames.files import restore_frames
    from pipeline.setpoint.frames.rendered import standing_out
    from pipeline.setpoint.vision import gallery
    from pipeline.setpoint.vision.parts import counted

    rendered = restore_frames(RENDERED, (*FRAME_PARTS, *WINDOW_PARTS))
    rendered = {part: standing_out(frames, settings.least_score) for part, frames in rendered.items()}
    by_part, windows = ({part: rendered[part] for part in parts} for parts in (FRAME_PARTS, WINDOW_PARTS))
    learned = learn_network(settings, by_part, windows, counted(by_part))
    rng = np.random.default_rng([settings.seed, 9])
    return learned, gallery.render_examples(learned.model, rng, least_score=settings.least_score)


def learn_recordings(
    settings: TrainClassifier, execution: Execution, material: Any
) -> tuple[Learned, Iterator[tuple[Any, dict[str, Any]]], Any]:
    """What is learned from a folder of recordings, pictures of some frames of prints that nothing, or nothing
    that judges them, was learned from, and its NozzleFrames: heads for the shipped network, from
    own_pictures.TRAINED_FROM stretches of constant settings on a network.

    No print is in two parts.
    """
    import numpy as np

    from pipeline.recordings import nozzle_frames
    from pipeline.setpoint.recordings import read_frames
    from pipeline.setpoint.vision import gallery
    from pipeline.setpoint.vision.own_pictures import TRAINED_FROM
    from pipeline.setpoint.vision.parts import deal_prints

    frames, labelled, usable = read_frames(RAW, settings, execution, material)
    read = nozzle_frames.figures(frames)
    if len(np.unique(labelled.segment)) < TRAINED_FROM:
        learned, prob, distance = learn_heads(settings, labelled, usable, read)
        shown = usable
    else:
        shares = settings.prints.model_dump() | dict.fromkeys(WINDOW_PARTS, 1)
        with artifacts.about(RAW):
            by_part = deal_prints(labelled, shares, np.random.default_rng(settings.seed))
        windows = {part: by_part.pop(part) for part in WINDOW_PARTS}
        learned = learn_network(settings, by_part, windows, read)
        prob, distance = gallery.classified_frames(learned.model, frames)
        shown = np.isin(frames.print_number, by_part["judged"].print_number) | (frames.print_number < 0)
    return learned, show_recorded(settings, learned.model, frames, (prob, distance), shown, material), frames


def show_recorded(
    settings: TrainClassifier, model: Any, frames: Any, said: tuple[Any, Any], shown: Any, material: Any
) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Picture and row of some of the frames `shown` (n,), of which was said: probabilities (n, 3), distance
    (n,)."""
    import numpy as np

    from pipeline.recordings import nozzle_frames
    from pipeline.setpoint.recordings import read_options
    from pipeline.setpoint.vision import gallery

    groups = gallery.group_frames(*said, model.calibration.foreign_above, frames)
    groups = groups._replace(group=np.where(shown, groups.group, ""))
    chosen = gallery.choose_frames(groups, frames)
    topics = read_options(settings).topics
    pictures = nozzle_frames.pictures([frames.picture[i] for i in chosen], topics)
    for i, picture in zip(chosen, pictures, strict=True):
        row = gallery.describe_recorded(model, groups, frames, i, shown, material)
        yield gallery.draw_recorded(picture, frames, i), row


def learn_heads(
    settings: TrainClassifier, labelled: Any, usable: Any, read: dict[str, Any]
) -> tuple[Learned, Any, Any]:
    """Heads for the shipped network from the frames `labelled`, those `usable` (n,) of a folder; and for all
    n frames what was said of them without learning from their print: probabilities (n, 3), distance (n,)."""
    import numpy as np

    from pipeline.setpoint.vision import calibration, own_pictures
    from pipeline.setpoint.vision.assessment import Assessment
    from pipeline.setpoint.vision.files import restore_network
    from pipeline.setpoint.vision.parts import deal_prints
    from pipeline.setpoint.vision.vision_transformer import parameters

    network, size = restore_network(SHIPPED)
    with artifacts.about(RAW):
        own = own_pictures.learn(
            network, labelled, window=settings.window, false_alarms=settings.false_alarms
        )
        shares = dict.fromkeys(WINDOW_PARTS, 1.0)
        dealt = deal_prints(labelled, shares, np.random.default_rng([settings.seed, 1]))
    windows = {
        part: own.windows.take(np.isin(own.windows.truth.segment, frames.print_number))
        for part, frames in dealt.items()
    }
    fitted = own.model.calibration
    prob, distance = np.full((len(usable), 3), np.nan), np.full(len(usable), np.nan)
    rows = np.flatnonzero(usable)[labelled.valid]
    logits = own.frames.logits[labelled.valid]
    prob[rows] = np.exp(calibration.log_probabilities(logits, fitted.temperature))
    distance[rows] = own.distance[labelled.valid]
    figures = {
        "learned": "heads for the shipped network",
        "size": size,
        "parameters": parameters(network),
        "data": read,
    }
    judged = Assessment(fitted, own.frames, own.windows, {})
    return Learned(own.model, judged, windows, None, figures), prob, distance


def learn_network(
    settings: TrainClassifier, by_part: Mapping[str, Any], windows: Mapping[str, Any], read: dict[str, Any]
) -> Learned:
    """The vision transformer of settings.size from LabelledFrames by part of FRAME_PARTS; what it shows of
    those by part of WINDOW_PARTS; `read` is what was read, counted."""
    from pipeline.setpoint.vision import assessment
    from pipeline.setpoint.vision.vision_transformer import parameters

    trained = train(settings, by_part)
    model, judged, foreign = assess(settings, by_part, trained.best)
    recorded = settings.source == "recordings"
    predict = partial(assessment.predict_windows, model, window=settings.window, recorded=recorded)
    predictions = each(windows, predict)
    figures = {
        "learned": "the network",
        "size": settings.size,
        "augmentation": settings.augmentation,
        "parameters": parameters(trained.best),
        "epochs": {"vision transformer": int(trained.epoch)},
        "best_epoch": {"vision transformer": int(trained.best_epoch)},
        "out_of_distribution": foreign,
        "data": read,
    }
    return Learned(model, judged, predictions, trained, figures)


# ---- training


def train(settings: TrainClassifier, by_part: Mapping[str, Any], checkpoints: Path = CHECKPOINTS) -> Any:
    """The TrainState of the vision transformer of settings.size. A training that was killed goes on from its
    last epoch.

    Raises ValueError, nothing trained, if the other parts do not suffice for what is fitted and judged
    afterwards.
    """
    import jax
    import joblib
    import numpy as np

    from pipeline.setpoint.vision import classifier
    from pipeline.setpoint.vision.classifier import Labelled, TrainingSettings
    from pipeline.setpoint.vision.files import SIZES, train_from_checkpoint
    from pipeline.setpoint.vision.parts import check_parts
    from pipeline.setpoint.vision.vision_transformer import vision_transformer

    check_parts(by_part, recorded=settings.source == "recordings", window=settings.window)
    learned, held_out = (Labelled(*by_part[part].labelled()) for part in ("learned", "held_out"))
    recipe = getattr(settings, settings.size)
    inputs = settings.size, settings.augmentation, settings.seed, recipe.model_dump()
    data = [array.tobytes() for some in (learned, held_out) for array in some]
    checkpoint = joblib.hash((*inputs, data, [artifacts.sha256(path) for path in CODE]))
    training = partial(
        classifier.train,
        learned=learned,
        held_out=held_out,
        settings=TrainingSettings(**recipe.model_dump(exclude={"epochs"})),
        key=jax.random.fold_in(jax.random.key(settings.seed), 0),
        augment={"along_bead": classifier.along_bead, "adr": classifier.adr}[settings.augmentation],
    )
    network = vision_transformer(SIZES[settings.size], np.random.default_rng([settings.seed, 10]))
    state = classifier.untrained(network, epochs=recipe.epochs)
    return train_from_checkpoint(training, state, checkpoints / f"{checkpoint}.safetensors")


# ---- what it is worth


def each(parts: Mapping[str, Any], work: Callable[[Any], Any]) -> dict[str, Any]:
    """work of each part, on every core at once; what comes out does not depend on the cores."""
    import os
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return dict(zip(parts, pool.map(work, parts.values()), strict=True))


def assess(
    settings: TrainClassifier, by_part: Mapping[str, Any], network: Any
) -> tuple[Any, Any, dict[str, Any]]:
    """The CalibratedClassifier, its Assessment on the part that it is judged on, and how foreign pictures are
    detected."""
    from pipeline.setpoint.vision import assessment, calibrated_classifier, calibration
    from pipeline.setpoint.vision.classifier import Labelled
    from pipeline.setpoint.vision.parts import all_frames

    parts = {part: by_part[part] for part in ("learned", "calibration", "judged")}
    data = {
        part: all_frames(frames, recorded=settings.source == "recordings") for part, frames in parts.items()
    }
    outputs = each(
        {part: (data[part], frames.valid, frames.surroundings) for part, frames in parts.items()},
        lambda part: calibrated_classifier.outputs(network, *part),
    )
    fitted = calibration.calibrate(
        outputs["learned"], outputs["calibration"], length=settings.window, false_alarms=settings.false_alarms
    )
    learned, model = (
        Labelled(*by_part["learned"].labelled()),
        calibrated_classifier.CalibratedClassifier(network, fitted),
    )
    judged = assessment.assess(fitted, outputs["judged"], learned, data["judged"], window=settings.window)
    foreign = calibrated_classifier.foreign_detection(model, outputs["judged"], data["judged"])
    return model, judged, foreign


def write_frames(folder: Path, pictures: Iterable[tuple[Any, dict[str, Any]]]) -> None:
    """frames.json with a row for each frame of the page, and its JPEG."""
    rows = []
    for picture, row in pictures:
        name = f"frame_{len(rows):02d}.jpg"
        artifacts.write_jpeg(folder / name, picture)
        rows.append({"file": name} | row)
    artifacts.write_json(folder / "frames.json", rows)


if __name__ == "__main__":
    stages.run(main, "train_classifier", loop="setpoint")
