"""Nozzle frames -> classifier of the flow: reads datasets/render_frames, or datasets/raw/setpoint; writes
datasets/train_classifier: weights.safetensors and calibration.parquet of the vision transformer,
classified.parquet and reliability.parquet of the frames it is judged on, course.parquet, windows.parquet for
the simulator, frames for the page, and known_camera.parquet, by which frames of other cameras are foreign."""

from pathlib import Path

import stages
from pipeline.setpoint.workflow import camera_files, gallery, known_camera, parts, train_classifier
from pipeline.setpoint.workflow.classifier_files import store_classifier
from pipeline.setpoint.workflow.settings import SetpointMaterial, TrainClassifier
from pipeline.setpoint.workflow.tables import CLASSIFIED, CLASSIFIER_CURVE, RELIABILITY, WINDOWS
from pipeline.setpoint.workflow.windows import window_rows
from pipeline.store import artifacts, params


def main() -> None:
    with artifacts.stage("train_classifier") as out:
        settings, execution = (
            params.load(TrainClassifier, "train_classifier"),
            params.load(params.Execution, "execution"),
        )
        material = params.load(SetpointMaterial, "setpoint_material").material()
        found = parts.parts(settings, "datasets/render_frames", "datasets/raw/setpoint", execution, material)
        by_part = found.frames
        networks = train_classifier.trained(settings, by_part)
        judged = train_classifier.judged(settings, by_part, networks)
        windows = train_classifier.recorded(settings, judged.model, found.windows)
        store_classifier(out, settings, judged.model)
        artifacts.write_table(
            out / "classified.parquet",
            CLASSIFIED,
            train_classifier.classified(judged, by_part["judged"].flow),
        )
        artifacts.write_table(
            out / "reliability.parquet", RELIABILITY, train_classifier.reliability_rows(settings, judged)
        )
        curves = train_classifier.curve_rows(networks)
        artifacts.write_table(out / "course.parquet", CLASSIFIER_CURVE, curves)
        artifacts.write_learning_curve(
            out / "live",
            curves,
            of="learner",
            step="epoch",
            figures=("training_loss", "held_out_loss", "held_out_accuracy"),
        )
        artifacts.write_table(out / "windows.parquet", WINDOWS, window_rows(windows))
        prints = by_part["judged"].print_number
        artifacts.write_json(
            out / "frames/frames.json",
            gallery.write_frames(settings, material, judged.model, found.recorded, prints, out / "frames"),
        )
        camera = known_camera.known(Path("datasets/render_frames"), found.recorded, length=settings.window)
        camera_files.store_camera(out / camera_files.FILE, camera)
        artifacts.write_metrics(
            "train_classifier", train_classifier.metrics(settings, judged, networks, found.read)
        )


if __name__ == "__main__":
    stages.run(main, "train_classifier", loop="setpoint")
