"""Trials -> learned commands: reads datasets/raw/deposition if the source is recordings; writes
datasets/train_ilc: trials.parquet, lessons.parquet, filmed.parquet, models.json, recordings of the first and
the last trial, frames of these with the measured edges, and, for a real machine, the command of the next one
in next/."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import stages
from pipeline.deposition.settings import Camera, Printer, PrinterMaterial, TrainIlc, trial_conditions
from pipeline.deposition.tables import FILMED, LESSONS, TRIALS
from pipeline.store import artifacts, params

if TYPE_CHECKING:
    import numpy as np

    from pipeline.deposition.camera import readings, trial_flow
    from pipeline.deposition.extruder import Extruder, Routine
    from pipeline.deposition.learning.ilc import Trial
    from pipeline.recordings.trial_files import TrialRecording

# the readings of a recording are remembered; this code decides what they are
MEMO, PIPELINE = Path("datasets/memo/train_ilc"), Path(__file__).resolve().parents[1] / "pipeline"
READERS = ("deposition/camera", "recordings")
Sections = tuple[TrainIlc, Printer, Camera]
# trial sequences and measured trials by (material, number of the routine), models and figures by material
Results = tuple[dict[tuple[str, int], list], dict[tuple[str, int], list], dict[str, dict], dict[str, dict]]

# figures of control that git keeps and that runs are compared by
METRICS = (
    "*.gamma*",
    "*.*.last_ratio",
    "*.*.best_ratio",
    "*.*.trials",
    "*.*.saturated",
    "*.pixels.flow_error*",
    "*.pixels.rejected_percent",
)


def main() -> None:
    import numpy as np
    from joblib import delayed
    from tqdm import tqdm

    from pipeline.deposition.camera import trial_flow
    from pipeline.deposition.learning import training
    from pipeline.recordings import plain_files, trial_files
    from pipeline.store.execution import run_all

    with artifacts.stage("train_ilc") as out:
        settings, printer = params.load(TrainIlc, "train_ilc"), params.load(Printer, "printer")
        camera, execution = params.load(Camera, "camera"), params.load(params.Execution, "execution")
        routines, laws = printer.training_routines(), settings.laws(printer)
        prospects = {
            material.name: training.prospects(
                material.nominal, routines, np.random.default_rng([settings.seed, 0, 0]), laws,
                plants=settings.family_plants, steady_flow=printer.steady_flow,
                worst_ratio=settings.worst_ratio,
            )
            for material in printer.materials
        }  # fmt: skip
        (out / "recordings").mkdir()
        if settings.source == "recordings":
            folder = Path("datasets/raw/deposition")
            plain_files.check_plain_files(folder)
            paths = trial_files.trial_paths(folder)
            recordings = [trial_files.open_trial(path, **camera.recording) for path in paths]
            results = [learn_from_recordings(recordings, folder, out / "next", (settings, printer, camera))]
            paths = trial_files.first_and_last(recordings)
        else:
            camera, kinds = camera.straight(), ("flow", "pixels") if settings.pixel_trials else ("flow",)
            # workers of a cluster work in other folders
            place, sections = (out / "recordings").resolve(), (settings, printer, camera)
            jobs = [(place, sections, index, kind) for index in range(len(prospects)) for kind in kinds]
            work = run_all([delayed(simulate)(*job) for job in jobs], execution)
            results = list(tqdm(work, total=len(jobs), desc="train_ilc: materials, in flow and in pictures"))
            paths = sorted((out / "recordings").glob("*.mcap"))
        sequences, measured, models, figures = training.join([({}, {}, {}, prospects), *results])
        artifacts.write_table(out / "trials.parquet", TRIALS, training.trial_rows(sequences))
        artifacts.write_table(out / "lessons.parquet", LESSONS, training.sample_rows(sequences))
        artifacts.write_table(out / "filmed.parquet", FILMED, trial_flow.filmed_rows(measured))
        artifacts.write_json(out / "models.json", models)
        frames = (out / "frames").resolve()
        rows = run_all([delayed(show_frames)(path.resolve(), frames, camera) for path in paths], execution)
        artifacts.write_json(frames / "frames.json", [row for of_path in rows for row in of_path])
        artifacts.write_metrics("train_ilc", figures, METRICS)


def simulate(folder: Path, sections: Sections, index: int, kind: str) -> Results:
    """Material `index` on a machine drawn from the family: in "flow", measured with noise, by the paper's law
    and by the model inverse; in "pixels", by the latter through recordings in `folder`."""
    import numpy as np
    from tqdm import tqdm

    from pipeline.deposition import extruder
    from pipeline.deposition.learning import training

    settings, printer, _ = sections
    material, seed = printer.materials[index], [settings.seed, index]
    nominal, rng = material.nominal, np.random.default_rng(seed)
    K, tau = nominal.gain, nominal.time_constant_s
    plant = extruder.draw(rng, gain=K, time_constant_s=tau, steady_flow=printer.steady_flow)
    routines = printer.training_routines()
    # of what the camera sees, and of what does not repeat in pictures and in flow; of plants
    rngs = [np.random.default_rng([*seed, number]) for number in range(1, 5)]
    updates = {"flow": settings.trials * (len(routines) + 2), "pixels": settings.pixel_trials}[kind]
    title, place = f"train_ilc: {material.name} in {kind}", 1 + 2 * index + (kind == "pixels")
    with tqdm(total=updates, desc=title, position=place, mininterval=2, leave=False) as bar:
        if kind == "pixels":
            return learn_in_pictures(folder, sections, material, plant, routines[0], rngs[:2], bar)
        by_routine, figures, models = training.learn_in_flow(
            nominal, plant, routines, rngs[2:], settings.shares, trials=settings.trials,
            plants=settings.family_plants, settings=settings.laws(printer), on_step=lambda _: bar.update(),
        )  # fmt: skip
    sequences = {(material.name, number): of_routine for number, of_routine in by_routine.items()}
    return sequences, {}, {material.name: models}, {material.name: figures}


def learn_in_pictures(
    folder: Path, sections: Sections, material: PrinterMaterial, plant: Extruder, routine: Routine,
    rngs: Sequence[np.random.Generator], bar: Any,
) -> Results:  # fmt: skip
    """The model inverse on the reference routine of a simulated machine, the flow measured from pictures.
    Every trial is one recording in `folder`, written and read back; the first and the last are kept. `rngs`
    draw what the camera sees, and what does not repeat."""
    from pipeline.deposition.camera import rendering, trial_flow
    from pipeline.deposition.learning import training
    from pipeline.recordings.trial_files import TrialConditions, TrialSignals, open_trial, write_trial

    (settings, printer, camera), measured = sections, []
    laws, name = settings.laws(printer), material.name
    film = rendering.SimulatedCamera(rendering.SCENES[camera.scene], rngs[0])
    calibration = rendering.calibrate(film, camera.known_widths_mm, rngs[0], camera.mounting)

    def measure(u: np.ndarray) -> Trial:
        number, law = len(measured), "pixels" if measured else "on_off"
        path = folder / f"{name}_{number:02d}.mcap"
        known = trial_conditions(printer, camera, material, routine, number, law, calibration[:2])
        pictures, applied, truth = rendering.simulate_trial(
            plant, film, routine, u, rngs[1], noise=settings.shares._asdict(), drive=laws.drive,
            sample_time_s=laws.sample_time_s, **camera.film(printer),
        )  # fmt: skip
        signals = TrialSignals(routine.time_s, routine.position, routine.speed, applied, truth)
        write_trial(path, TrialConditions(**known), pictures, signals, encoding=camera.encoding)
        recording = open_trial(path, **camera.recording)
        earlier, values = [trial.latency for trial in measured], read(recording, camera)
        measured.append(measure_trial(recording, values, earlier, routine, printer, camera))
        if number > 1:
            (folder / f"{name}_{number - 1:02d}.mcap").unlink()
        return measured[-1].trial

    sequence = training.run_trials(
        "pixels", training.model_inverse(routine, laws), measure, routine, material.nominal,
        trials=settings.pixel_trials, settings=laws, on_step=lambda _: bar.update(),
    )  # fmt: skip
    figures = training.figures(sequence, rise=laws.rise) | trial_flow.flow_errors(measured, routine)
    figures, models = figures | trial_flow.latency_figures(measured), {"calibration": calibration._asdict()}
    return {(name, 0): [sequence]}, {(name, 0): measured}, {name: models}, {name: {"pixels": figures}}


def learn_from_recordings(
    recordings: Sequence[TrialRecording], folder: Path, following: Path, sections: Sections
) -> Results:
    """The trials of `folder`, and in `following` the command of the next trial of every material and routine,
    on-off control's if there is none yet."""
    from pipeline.deposition import drive, extruder
    from pipeline.deposition.camera import trial_flow
    from pipeline.deposition.learning import training
    from pipeline.recordings import trial_files

    settings, printer, camera = sections
    routines, laws, results = printer.training_routines(), settings.laws(printer), ({}, {}, {}, {})
    groups = trial_files.group_trials(recordings, folder, **printer.expected_trials(routines))
    values = {one.path: read(one, camera, MEMO) for one in recordings}
    scale = (abs(camera.mm_per_px), 0.0)
    following.mkdir()
    for material in printer.materials:
        figures: dict[str, Any] = {}
        models: dict[str, Any] = {"nominal": extruder.to_json(material.nominal)}
        of_routines: list[list[trial_flow.MeasuredTrial]] = []
        for index, routine in enumerate(routines):
            of_routines.append([])
            for one in groups.get((material.name, index), []):
                earlier = [other.latency for path, other in values.items() if path != one.path]
                measured = measure_trial(one, values[one.path], earlier, routine, printer, camera)
                of_routines[-1].append(measured)
        first = [(m[0].trial, r) for m, r in zip(of_routines, routines, strict=True) if m]
        with artifacts.about(f"{folder}: material {material.name}"):
            figures["command_kind"] = check_kind(first, material, printer) if first else ""
        for index, (routine, measured) in enumerate(zip(routines, of_routines, strict=True)):
            # the first routine that is recorded is shown on the pages
            key, end = (material.name, index), f"_{index}" if "pixels" in figures else ""
            trials, number = [one.trial for one in measured], len(measured)
            law = "model_inverse" if measured else "on_off"
            with artifacts.about(f"{folder}: material {material.name}, routine {index}"):
                sequence, u, of_step = training.resume(trials, routine, material.nominal, laws)
            name = f"{material.name}_routine_{index}_trial_{number:02d}"
            known = trial_conditions(printer, camera, material, routine, number, law, scale)
            said = trial_files.TrialConditions(**known)
            sent = drive.sent(u, printer.kind, sample_time_s=printer.sample_time_s)
            trial_files.write_command(
                following / name, said, time_s=routine.time_s, command_mm=sent, speed=printer.kind == "speed"
            )
            figures[f"routine_{index}"] = {"next": name} | of_step
            if sequence:
                results[0][key], results[1][key] = [sequence], measured
                of_sequence = training.figures(sequence, rise=laws.rise)
                figures[f"pixels{end}"] = of_sequence | trial_flow.latency_figures(measured)
                models[f"identified{end}"] = training.model_figures(sequence.model)
        results[2][material.name], results[3][material.name] = models, figures
    return results


def check_kind(
    first: Sequence[tuple[Trial, Routine]], material: PrinterMaterial, printer: Printer
) -> str:  # fmt: skip
    """The sentence that names what the machine answers to, if the first trials of all routines fit that
    better than printer.command; "" otherwise. Raises ValueError with it if nothing can be learned so."""
    from pipeline.deposition import drive
    from pipeline.deposition.learning import command_kind

    Ts = printer.sample_time_s
    squares = command_kind.errors(
        [drive.sent(trial.u, printer.kind, sample_time_s=Ts) for trial, _ in first],
        [trial.y for trial, _ in first], [routine.r for _, routine in first],
        gain=material.gain_mm3_per_s_per_mm, time_constant_s=material.time_constant_s, sample_time_s=Ts,
    )  # fmt: skip
    sentence, hopeless = command_kind.wrong_kind(squares, printer.kind)
    if hopeless:
        raise ValueError(sentence)
    return sentence


def read(recording: TrialRecording, camera: Camera, memo: Path | None = None) -> readings.Readings:
    """The readings of a recording's frames, out of the memo if it holds them."""
    from pipeline.deposition.camera import readings
    from pipeline.recordings import trial_files

    mounting = camera.mounting

    def measure() -> readings.Readings:
        with artifacts.about(recording.path):
            return readings.read(recording.frames, recording.signals["position_mm"], mounting)

    if memo is None:
        return measure()
    code = [PIPELINE / name for name in READERS]
    values = trial_files.recall(memo, recording.path, camera.looks, code, measure)
    return readings.Readings.from_values(values)


def measure_trial(
    recording: TrialRecording, values: readings.Readings, earlier: Sequence[readings.Latency],
    routine: Routine, printer: Printer, camera: Camera,
) -> trial_flow.MeasuredTrial:  # fmt: skip
    """The trial of a recording on the clock of its routine, from the readings of its frames; the camera's
    latency from section `camera`, or from this recording and `earlier` ones. Raises ValueError, naming the
    file, if it says nothing of its conditions or shows no bead."""
    from pipeline.deposition import drive
    from pipeline.deposition.camera import flow, readings, trial_flow
    from pipeline.recordings import trial_files

    known, mounting = trial_files.check_conditions(recording), camera.mounting
    scale, late = known.scale, readings.latency_of_camera(camera.latency_s, [*earlier, values.latency])
    with artifacts.about(recording.path):
        measured = trial_flow.measure_trial(
            values, recording.signals, routine, mounting, scale=scale,
            view=flow.View(known.mm_per_px, known.nozzle_column), nozzle_mm=printer.nozzle_mm, latency=late,
            contact_angle_deg=known.contact_angle_deg, width_deviation_mm=camera.width_deviation_mm,
        )  # fmt: skip
    u = drive.command(measured.trial.u, printer.kind, sample_time_s=printer.sample_time_s)
    return measured._replace(trial=measured.trial._replace(u=u))


def show_frames(path: Path, folder: Path, camera: Camera) -> list[dict[str, Any]]:
    """Writes a few frames of a recording with the measured edges drawn in as JPEG to `folder`, and returns a
    row for each: where it is from, what was measured, and why it was rejected."""
    from pipeline.deposition.camera.excerpts import excerpts
    from pipeline.recordings import trial_files

    recording, rows = trial_files.open_trial(path, **camera.recording), []
    frames, signals, known = recording.frames, recording.signals, recording.conditions
    if known is None:
        return rows
    for number, picture, row in excerpts(frames, signals, camera.mounting, scale=known.scale):
        name = f"{path.stem}_{number:05d}.jpg"
        artifacts.write_jpeg(folder / name, picture)
        head = {"file": name, "place": row["place"], "material": known.material, "trial": known.trial}
        rows.append(head | {"recording": path.name, "topic": frames.topic} | row)
    return rows


if __name__ == "__main__":
    stages.run(main, "train_ilc", loop="deposition")
