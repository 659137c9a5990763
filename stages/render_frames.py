"""Nozzle frames with their labels: renders them, cuts their key areas and writes
datasets/render_frames/<part>.safetensors, frames.json with how many, and known_camera.parquet; no part where
the frames are recordings. A classifier that is trained anew renders nothing anew."""

import stages
from pipeline.setpoint.workflow import camera_files, known_camera, render_frames
from pipeline.setpoint.workflow.settings import RenderFrames
from pipeline.store import artifacts, params


def main() -> None:
    with artifacts.stage("render_frames") as out:
        settings = params.load(RenderFrames, "render_frames")
        execution = params.load(params.Execution, "execution")
        source = params.value("train_classifier.source", one_of=("simulated", "recordings"))
        by_part = render_frames.rendered(settings, execution) if source == "simulated" else {}
        render_frames.store_frames(out, by_part)
        artifacts.write_json(out / "frames.json", render_frames.counts(by_part))
        if source == "simulated":
            camera = known_camera.drawn(settings, execution)
            camera_files.store_camera(out / camera_files.FILE, camera)


if __name__ == "__main__":
    stages.run(main, "render_frames", loop="setpoint")
