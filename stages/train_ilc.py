"""Trials -> learned commands: reads datasets/raw/deposition where the source is recordings; writes datasets/train_ilc: trials.parquet, lessons.parquet, filmed.parquet,
models.json, recordings of the first and the last trial, frames of these with the measured edges, and, for a real machine, the command of the next one in next/."""

from pathlib import Path

from joblib import delayed
from tqdm import tqdm

from pipeline import artifacts, filming, learning, params, schemas
from pipeline.deposition import training
from pipeline.execution import run_all
from pipeline.learning import TrainIlc
from pipeline.printer import Camera, Printer


def main() -> None:
    with artifacts.stage("train_ilc") as out:
        p, printer, camera, execution = (
            params.load(TrainIlc, "train_ilc"), params.load(Printer, "printer"), params.load(Camera, "camera"), params.load(params.Execution, "execution"),
        )  # fmt: skip
        work = learning.Work(p, p.settings(printer), p.noise.shares(), printer, camera)
        (out / "recordings").mkdir()
        calls = [
            delayed(learning.simulate)(out / "recordings", work, i, kind)
            for i in range(len(printer.materials))
            for kind in ("flow", "pixels")
        ]
        if p.source == "recordings":
            calls = [delayed(learning.recordings)("datasets/raw/deposition", out / "next", work)]
        found = learning.joined(tqdm(run_all(calls, execution), total=len(calls), desc="train_ilc: materials, in flow and in pictures"))
        artifacts.write_table(out / "trials.parquet", schemas.TRIALS, training.rows(found.runs))
        artifacts.write_table(out / "lessons.parquet", schemas.LESSONS, training.lessons(found.runs))
        artifacts.write_table(out / "filmed.parquet", schemas.FILMED, filming.rows(found.watched))
        artifacts.write_json(out / "models.json", found.models)
        kept = sorted((out / "recordings").glob("*.mcap"))
        if p.source == "recordings":
            kept = filming.first_and_last(sorted(Path("datasets/raw/deposition").rglob("[!.]*.mcap")), camera)
        frames = run_all([delayed(filming.shown)(path, out / "frames", camera) for path in kept], execution)
        artifacts.write_json(out / "frames/frames.json", [row for rows in frames for row in rows])
        artifacts.write_metrics("train_ilc", found.metrics)


if __name__ == "__main__":
    main()
