"""Nozzle frames -> classifier of the flow: reads datasets/render_frames, or datasets/raw/setpoint; writes
datasets/train_classifier: weights.safetensors and calibration.parquet of the vision transformer,
classified.parquet and reliability.parquet of the frames it is judged on, course.parquet, windows.parquet for
the simulator, frames for the page, and known_camera.parquet, by which frames of other cameras are foreign."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

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
CHECKPOINTS = Path("datasets/memo/train_classifier")
# the code that decides where a training ends, beside its data and settings
VISION = Path(__file__).parents[1] / "pipeline/setpoint/vision"
CODE = (VISION / "classifier.py", VISION / "vision_transformer.py")
TRANSFORMER, CNN = "vision transformer", "convolutional network"
# figures of control that git keeps and that runs are compared by
METRICS = (
    "*_accuracy",
    "right_70_150",
    "images",
    "windows",
    "ece_*",
    "conformal.coverage",
    "conformal.held",
    "out_of_distribution.false_alarms",
    "out_of_distribution.*.found",
)


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

        by_part, windows, read, recordings = load_parts(settings, execution, material)
        curves = train(settings, by_part)
        model, judged = assess(settings, by_part, curves[TRANSFORMER].best, curves[CNN].best)
        predict = partial(assessment.predict_windows, model, window=settings.window)
        recorded = assessment.window_tables(each(windows, predict))
        store_classifier(out, settings.size, model)
        classified = assessment.classified(judged, by_part["judged"].flow)
        artifacts.write_table(out / "classified.parquet", CLASSIFIED, classified)
        reliability = assessment.reliability(judged, window=settings.window)
        artifacts.write_table(out / "reliability.parquet", RELIABILITY, reliability)
        columns = assessment.curves(curves)
        artifacts.write_table(out / "course.parquet", CLASSIFIER_CURVE, columns)
        losses = ("training_loss", "held_out_loss", "held_out_accuracy")
        artifacts.write_learning_curve(out / "live", columns, of="learner", step="epoch", figures=losses)
        artifacts.write_table(out / "windows.parquet", WINDOWS, window_rows(recorded))
        write_frames(out / "frames", settings, model, recordings, by_part["judged"].print_number, material)
        if recordings is None:
            camera = camera_files.restore_camera(RENDERED / camera_files.CAMERA_FILE)
        else:
            camera = fit_recorded_camera(recordings.surroundings, recordings.segment, length=settings.window)
        camera_files.store_camera(out / camera_files.CAMERA_FILE, camera)
        artifacts.write_metrics("train_classifier", figures(settings, model, judged, curves, read), METRICS)


# ---- frames


def load_parts(
    settings: TrainClassifier, execution: Execution, material: Any
) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any], Any]:
    """LabelledFrames by part of FRAME_PARTS; those whose windows stand for the camera, by part of
    WINDOW_PARTS; what was read, counted (`windows_apart`: whether no print of a folder is in both); and the
    NozzleFrames of a folder of recordings, or None.

    No segment is in two parts of FRAME_PARTS, none in two of WINDOW_PARTS, and no rendered one in both. In a
    folder the windows of learn, choose and judge are of prints of their own, taken from those to learn from,
    if these are enough; else they are not apart: of the prints for calibration, held_out and judged.
    """
    if settings.source == "recordings":
        from pipeline.setpoint.recordings import read_parts

        return read_parts(RAW, settings, WINDOW_PARTS, execution, material)
    from pipeline.setpoint.frames.files import restore_frames
    from pipeline.setpoint.frames.rendered import standing_out
    from pipeline.setpoint.vision.parts import counted

    rendered = restore_frames(RENDERED, (*FRAME_PARTS, *WINDOW_PARTS))
    rendered = {part: standing_out(frames, settings.least_score) for part, frames in rendered.items()}
    by_part = {part: rendered[part] for part in FRAME_PARTS}
    return by_part, {part: rendered[part] for part in WINDOW_PARTS}, counted(by_part), None


# ---- training


def train(
    settings: TrainClassifier, by_part: Mapping[str, Any], checkpoints: Path = CHECKPOINTS
) -> dict[str, Any]:
    """The TrainState of the vision transformer of settings.size, and of the small CNN, which learns from
    fewer frames. A training that was killed goes on from its last epoch.

    Raises ValueError, nothing trained, if the other parts do not suffice for what is fitted and judged
    afterwards.
    """
    from concurrent.futures import ThreadPoolExecutor

    import jax
    import joblib
    import numpy as np

    from pipeline.setpoint.vision import classifier
    from pipeline.setpoint.vision.assessment import fewer
    from pipeline.setpoint.vision.classifier import Labelled, TrainingSettings
    from pipeline.setpoint.vision.files import SIZES, train_from_checkpoint
    from pipeline.setpoint.vision.parts import check_parts
    from pipeline.setpoint.vision.vision_transformer import convolutional, vision_transformer

    check_parts(
        by_part,
        recorded=settings.source == "recordings",
        window=settings.window,
        coverage=settings.coverage,
        confidence=settings.confidence,
    )
    learned, held_out = (Labelled(*by_part[part].labelled()) for part in ("learned", "held_out"))
    augment = {"along_bead": classifier.along_bead, "adr": classifier.adr}[settings.augmentation]
    rngs = [np.random.default_rng([settings.seed, stream]) for stream in (10, 11)]
    transformer, cnn = vision_transformer(SIZES[settings.size], rngs[0]), convolutional(rngs[1])
    untrained = {
        TRANSFORMER: (transformer, getattr(settings, settings.size), learned),
        CNN: (cnn, settings.cnn, fewer(learned)),
    }
    code = [artifacts.sha256(path) for path in CODE]
    trainings: dict[str, Callable[[], Any]] = {}
    for i, (name, (network, recipe, data)) in enumerate(untrained.items()):
        inputs = settings.size, settings.augmentation, settings.seed, recipe.model_dump()
        what = (name, *inputs, [a.tobytes() for some in (data, held_out) for a in some], code)
        training = partial(
            classifier.train,
            learned=data,
            held_out=held_out,
            settings=TrainingSettings(**recipe.model_dump(exclude={"epochs"})),
            key=jax.random.fold_in(jax.random.key(settings.seed), i),
            augment=augment,
        )
        state = classifier.untrained(network, epochs=recipe.epochs)
        checkpoint = checkpoints / f"{joblib.hash(what)}.safetensors"
        trainings[name] = partial(train_from_checkpoint, training, state, name, checkpoint)
    # at the same time: neither keeps both cores busy, and neither knows of the other
    with ThreadPoolExecutor(len(trainings)) as pool:
        running = {name: pool.submit(training) for name, training in trainings.items()}
    return {name: training.result() for name, training in running.items()}


# ---- what it is worth


def each(parts: Mapping[str, Any], work: Callable[[Any], Any]) -> dict[str, Any]:
    """work of each part, on every core at once; what comes out does not depend on the cores."""
    import os
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return dict(zip(parts, pool.map(work, parts.values()), strict=True))


def assess(settings: TrainClassifier, by_part: Mapping[str, Any], network: Any, cnn: Any) -> tuple[Any, Any]:
    """The CalibratedClassifier, and its Assessment on the part that it is judged on."""
    from pipeline.setpoint.vision import assessment, calibrated_classifier, calibration
    from pipeline.setpoint.vision.classifier import Labelled
    from pipeline.setpoint.vision.parts import all_frames

    parts = {part: by_part[part] for part in ("learned", "calibration", "judged")}
    data = {
        part: all_frames(frames, recorded=settings.source == "recordings") for part, frames in parts.items()
    }
    outputs = each(
        {part: (data[part], frames.valid) for part, frames in parts.items()},
        lambda part: calibrated_classifier.outputs(network, *part),
    )
    fitted = calibration.calibrate(
        outputs["learned"],
        outputs["calibration"],
        length=settings.window,
        promise=calibration.Promise(settings.coverage, settings.confidence, settings.coverage_by_flow),
        false_alarms=settings.false_alarms,
    )
    learned = Labelled(*by_part["learned"].labelled())
    judged = assessment.assess(
        fitted, outputs["judged"], cnn, learned, data["judged"], window=settings.window
    )
    return calibrated_classifier.CalibratedClassifier(network, fitted), judged


def figures(
    settings: TrainClassifier, model: Any, judged: Any, curves: Mapping[str, Any], read: dict[str, Any]
) -> dict[str, Any]:
    from pipeline.setpoint.vision import assessment
    from pipeline.setpoint.vision.vision_transformer import parameters

    return assessment.figures(model.network, judged, window=settings.window, coverage=settings.coverage) | {
        "size": settings.size,
        "augmentation": settings.augmentation,
        "source": settings.source,
        "parameters": parameters(model.network),
        "cnn_parameters": parameters(curves[CNN].best),
        "epochs": {name: int(state.epoch) for name, state in curves.items()},
        "best_epoch": {name: int(state.best_epoch) for name, state in curves.items()},
        "data": read,
    }


def write_frames(
    folder: Path, settings: TrainClassifier, model: Any, recordings: Any, prints: Any, material: Any
) -> None:
    """frames.json with a row for each frame of the page, and its JPEG: real ones of the prints with these
    numbers, from which nothing was learned; rendered ones if there are no recordings."""
    import numpy as np

    from pipeline.recordings import nozzle_frames
    from pipeline.setpoint.recordings import read_options
    from pipeline.setpoint.vision import gallery

    if recordings is None:
        rng = np.random.default_rng([settings.seed, 9])
        examples = gallery.render_examples(model, rng, least_score=settings.least_score)
    else:
        judged = np.isin(recordings.print_number, prints) | (recordings.print_number < 0)
        groups = gallery.group_frames(model, recordings)
        groups = groups._replace(group=np.where(judged, groups.group, ""))
        chosen = gallery.choose_frames(groups, recordings)
        pictures = nozzle_frames.pictures(
            [recordings.picture[i] for i in chosen], read_options(settings, material).topics
        )
        examples = (
            (
                gallery.draw_recorded(picture, recordings, i),
                gallery.describe_recorded(model, groups, recordings, i, judged, material),
            )
            for i, picture in zip(chosen, pictures, strict=True)
        )
    rows = []
    for picture, row in examples:
        name = f"frame_{len(rows):02d}.jpg"
        artifacts.write_jpeg(folder / name, picture)
        rows.append({"file": name} | row)
    artifacts.write_json(folder / "frames.json", rows)


if __name__ == "__main__":
    stages.run(main, "train_classifier", loop="setpoint")
