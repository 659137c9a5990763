"""What train_ilc does for its materials: a simulated machine trained in flow and in pictures, or
the trials of a real one and the command of the next."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from joblib import delayed
from tqdm import tqdm

from pipeline.deposition.camera import bead
from pipeline.deposition.drive import obeyed
from pipeline.deposition.extruder import Extruder, Routine, draw
from pipeline.deposition.learning import ilc, training
from pipeline.deposition.learning.ilc import Trial
from pipeline.deposition.learning.training import LawSettings, Noise, TrainingCase, TrialSequence, on_off
from pipeline.deposition.workflow import laws, trial_files, trial_readings, trial_video
from pipeline.deposition.workflow.settings import Camera, Material, Printer, TrainIlc
from pipeline.deposition.workflow.trial_video import MeasuredTrial, SimulatedMachine
from pipeline.reading.excluded import readable
from pipeline.reading.plain_files import check_plain_files
from pipeline.store.artifacts import about
from pipeline.store.execution import run_all
from pipeline.store.params import Execution

# an extruder is known to 30 %: what is off by this factor is a unit, a scale or a picture of
# another size, and the next command would be off as much
WRONG_GAIN = 3.0


class Work(NamedTuple):
    """Section train_ilc and what it shares with others."""

    settings: TrainIlc
    laws: LawSettings
    noise: Noise
    printer: Printer
    camera: Camera


class Part(NamedTuple):
    """What came of one material, or of all: trial sequences and measured trials by material and number of
    the routine, models and metrics by material."""

    sequences: dict[tuple[str, int], list[TrialSequence]]
    measured: dict[tuple[str, int], list[MeasuredTrial]]
    models: dict[str, dict[str, Any]]
    metrics: dict[str, dict[str, Any]]


def trained(
    settings: TrainIlc, printer: Printer, camera: Camera, execution: Execution, *, recorded: str, out: Path
) -> Part:
    """Every material, simulated in flow and in pictures with recordings in out/recordings; or the trials in
    `recorded`, and in out/next the command of the next one."""
    work = Work(settings, laws.law_settings(settings, printer), laws.noise(settings), printer, camera)
    (out / "recordings").mkdir()
    if settings.source == "recordings":
        return recordings(recorded, out / "next", work)
    # workers of a cluster work in other folders
    folder = (out / "recordings").resolve()
    calls = [
        delayed(simulate)(folder, work, i, kind)
        for i in range(len(printer.materials))
        for kind in (("flow", "pixels") if settings.pixel_trials else ("flow",))
    ]
    return joined(
        tqdm(
            run_all(calls, execution), total=len(calls), desc="train_ilc: materials, in flow and in pictures"
        )
    )


def shown(
    settings: TrainIlc, camera: Camera, execution: Execution, *, recorded: str, out: Path
) -> list[dict[str, Any]]:
    """A few frames of the first and the last trial of each material in out/frames, and a row for each."""
    paths = sorted((out / "recordings").glob("*.mcap"))
    camera = trial_video.simulated(camera) if settings.source == "simulated" else camera
    if settings.source == "recordings":
        paths = trial_video.first_and_last(_trials(Path(recorded)), camera)
    folder = (out / "frames").resolve()
    frames = run_all(
        [delayed(trial_video.shown)(path.resolve(), folder, camera) for path in paths], execution
    )
    return [row for rows in frames for row in rows]


def joined(parts: Iterable[Part]) -> Part:
    """All parts as one; dictionaries of one material are put together."""
    joint = Part({}, {}, {}, {})
    for part in parts:
        for key, sequences in part.sequences.items():
            joint.sequences.setdefault(key, []).extend(sequences)
        joint.measured.update(part.measured)
        for mine, others in ((joint.models, part.models), (joint.metrics, part.metrics)):
            for name, values in others.items():
                mine.setdefault(name, {}).update(values)
    return joint


def _nominal(material: Material) -> Extruder:
    return Extruder(material.gain_mm3_per_s_per_mm, material.time_constant_s)


def _model(model: ilc.TrialModel | None) -> dict[str, float] | None:
    if model is None:
        return None
    e = model.extruder
    return {
        "gain": e.gain, "time_constant_s": e.time_constant_s, "delay_s": e.delay_s,
        "lag_hz": e.lag_hz, "yield": e.yield_, "noise": model.noise,
        "fit_percent": model.fit_percent,
    }  # fmt: skip


# ---- a simulated machine


def simulate(folder: Path, work: Work, index: int, kind: str) -> Part:
    """Material `index` on a machine drawn from the family: in "flow", measured with noise, by the paper's law
    and by the model inverse; in "pixels", through recordings in `folder`."""
    material, routines = work.printer.materials[index], work.printer.trained()
    nominal = _nominal(material)
    plant = draw(
        np.random.default_rng([work.settings.seed, index]),
        gain=nominal.gain,
        time_constant_s=nominal.time_constant_s,
        steady_flow=work.printer.steady_flow,
    )
    case = TrainingCase(nominal, plant, routines)
    rngs = tuple(np.random.default_rng([work.settings.seed, index, number]) for number in range(1, 5))
    before = _before(nominal, routines, work)
    in_flow = kind == "flow"
    updates = work.settings.trials * (len(routines) + 2) if in_flow else work.settings.pixel_trials
    with tqdm(
        total=updates,
        desc=f"train_ilc: {material.name} in {kind}",
        position=1 + 2 * index + (kind == "pixels"),
        mininterval=2,
        leave=False,
    ) as bar:

        def on_step(_: Trial) -> None:
            bar.update()

        if in_flow:
            return _in_flow(material, case, rngs[2:], work, before, on_step)
        return _in_pictures(folder, material, case, rngs[:2], work, on_step)


def _in_flow(
    material: Material,
    case: TrainingCase,
    rngs: tuple[np.random.Generator, np.random.Generator],
    work: Work,
    before: dict[str, Any],
    on_step: Callable[[Trial], None],
) -> Part:
    """Both laws on the measured flow of a simulated machine. `rngs` draw what does not repeat, and the plants
    of the convergence test."""
    name, rise = material.name, work.laws.rise
    sequences = training.train(
        case, rngs[0], work.noise, trials=work.settings.trials, settings=work.laws, on_step=on_step
    )
    hoelzle, reference, *others, hoelzle_nominal = sequences
    after = training.convergence_of_model_inverse(
        reference, rngs[1], work.noise, plants=work.settings.family_plants, settings=work.laws
    )
    figures = before | {
        "gamma_model_inverse": after.nominal, "gamma_model_inverse_worst": after.family.max(),
        "hoelzle_2009_nominal": training.figures(hoelzle_nominal, rise=rise),
        "hoelzle_2009": training.figures(hoelzle, rise=rise),
        "model_inverse": training.figures(reference, rise=rise),
        "other_routines": [training.figures(sequence, rise=rise) for sequence in others],
    }  # fmt: skip
    by_routine = {(name, 0): [hoelzle_nominal, hoelzle, reference]} | {
        (name, i): [sequence] for i, sequence in enumerate(others, 1)
    }
    models = {
        "nominal": laws.plain(case.nominal),
        "plant": laws.plain(case.plant),
        "identified": _model(reference.model),
    }
    return Part(by_routine, {}, {name: models}, {name: figures})


def _in_pictures(
    folder: Path,
    material: Material,
    case: TrainingCase,
    rngs: tuple[np.random.Generator, np.random.Generator],
    work: Work,
    on_step: Callable[[Trial], None],
) -> Part:
    """The model inverse on the reference routine of a simulated machine, the flow measured from pictures.

    Every trial is one recording in `folder`, written and read back; those of the first and last trial are
    kept. `rngs` draw what the camera sees, and what does not repeat.
    """
    name, camera, routine = material.name, trial_video.simulated(work.camera), case.routines[0]
    scene = trial_video.scene(camera, rngs[0])
    calibration = trial_video.calibrate(scene, camera, rngs[0])
    machine = SimulatedMachine(case.plant, work.printer, camera, scene, work.noise)
    measured: list[MeasuredTrial] = []

    def measure(u: np.ndarray) -> Trial:
        j = len(measured)
        path = folder / f"{name}_{j:02d}.mcap"
        conditions = trial_video.conditions(
            material,
            routine,
            j,
            "pixels" if j else "on_off",
            printer=work.printer,
            camera=camera,
            calibration=calibration,
        )
        trial_video.simulate_recording(path, conditions, machine, routine, u, rngs[1])
        earlier = [one.latency for one in measured]
        measured.append(
            trial_video.measure_trial(path, routine, printer=work.printer, camera=camera, earlier=earlier)
        )
        if j > 1:
            (folder / f"{name}_{j - 1:02d}.mcap").unlink()
        return measured[-1].trial

    sequence = training.run_trials(
        "pixels",
        training.model_inverse(routine, work.laws),
        measure,
        routine,
        case.nominal,
        trials=work.settings.pixel_trials,
        settings=work.laws,
        on_step=on_step,
    )
    figures = training.figures(sequence, rise=work.laws.rise) | _flow_errors(measured, routine)
    told = trial_video.latency_figures(measured)
    return Part(
        {(name, 0): [sequence]},
        {(name, 0): measured},
        {name: {"calibration": calibration._asdict()}},
        {name: {"pixels": figures | told}},
    )


def _before(nominal: Extruder, routines: Sequence[Routine], work: Work) -> dict[str, Any]:
    """What is known before anything runs: gamma of the paper's law on the nominal model and over the family,
    and the headroom of the drive over each routine."""
    settings = work.settings
    convergence = training.convergence(
        nominal,
        np.random.default_rng([settings.seed, 0, 0]),
        plants=settings.family_plants,
        steady_flow=work.printer.steady_flow,
        settings=work.laws,
    )
    headrooms = [
        training.actuator_headroom(routine, nominal, worst_ratio=settings.worst_ratio, settings=work.laws)
        for routine in routines
    ]
    return {
        "gamma": convergence.nominal,
        "gamma_worst": convergence.family.max(),
        "gamma_above_1_percent": 100 * np.mean(convergence.family > 1),
        "actuator_headroom": [
            {"peak_over_steady": one.peak / one.steady, "least_ratio": one.ratio, "ramp_s": one.ramp_s}
            for one in headrooms
        ],
    }


def _flow_errors(measured: Sequence[MeasuredTrial], routine: Routine) -> dict[str, float]:
    """How well pictures measure the flow, over all trials: r.m.s. error in % of the steady flow, in the
    whole trial and around its pause, and frames without a bead."""
    errors = np.array([one.flow.flow - one.trial.truth for one in measured]) / routine.r.max()
    near = (routine.time_s > routine.pause_s[0] - 0.3) & (routine.time_s < routine.pause_s[1] + 0.3)
    trial, corner = (100 * np.sqrt(np.mean(part**2, axis=1)) for part in (errors, errors[:, near]))
    frames = sum(one.frames for one in measured)
    rejected = sum(sum(one.rejected.values()) for one in measured)
    return {
        "flow_error_percent": float(np.median(trial)),
        "flow_error_corner_percent": float(np.median(corner)),
        "rejected_percent": 100 * rejected / frames,
    }


# ---- trials of a real machine


def _recorded(
    folder: Path, printer: Printer, camera: Camera, routines: Sequence[Routine]
) -> dict[tuple[str, int], list[MeasuredTrial]]:
    """The trials that lie in `folder`, by (material, number of the routine) in the order of their numbers.

    Raises ValueError, naming the file, for an unknown material, nozzle or
    routine, and where a trial is missing or there twice.
    """
    check_plain_files(folder)
    by_routine: dict[tuple[str, int], dict[int, tuple[Path, MeasuredTrial]]] = {}
    told = {path: trial_video.told_latency(path, camera, trial_readings.MEMO) for path in _trials(folder)}
    for path in told:
        conditions = trial_readings.opened(path, camera).conditions
        if conditions is None:
            raise ValueError(
                f"{path}: expected the metadata record {trial_files.SCHEMA} with material "
                "and trial, found none; "
                "copy it from the command in datasets/train_ilc/next"
            )
        number, material = conditions.trial, conditions.material
        index = _routine(path, conditions, printer, routines)
        trials = by_routine.setdefault((material, index), {})
        if number in trials:
            raise ValueError(
                f"{path}: trial {number} of material {material} is in {trials[number][0]} too; "
                "keep one of the two"
            )
        measured = trial_video.measure_trial(
            path,
            routines[index],
            printer=printer,
            camera=camera,
            memo=trial_readings.MEMO,
            earlier=[latency for other, latency in told.items() if other != path],
        )
        trials[number] = (path, measured)
    for (material, index), trials in by_routine.items():
        lacking = sorted(set(range(max(trials))) - set(trials))
        if lacking:
            raise ValueError(
                f"{folder}: trial {lacking[0]} of material {material}, routine {index}, "
                f"is missing beside trial {max(trials)}; add it, "
                "or renumber the others"
            )
    return {key: [trials[j][1] for j in sorted(trials)] for key, trials in sorted(by_routine.items())}


def _trials(folder: Path) -> list[Path]:
    return readable(sorted(folder.rglob("[!.]*.mcap")), folder)


def _routine(
    path: Path, conditions: trial_files.Conditions, printer: Printer, routines: Sequence[Routine]
) -> int:
    names = [material.name for material in printer.materials]
    if conditions.material not in names:
        raise ValueError(
            f"{path}: material {conditions.material} is not among printer.materials {', '.join(names)}; "
            "add it to params.yaml, "
            "or take the file away"
        )
    if conditions.nozzle != f"{printer.nozzle_mm:g}":
        raise ValueError(
            f"{path}: expected a nozzle of {printer.nozzle_mm:g} mm (printer.nozzle_mm), "
            f"found {conditions.nozzle}; "
            "what one nozzle learned does not hold for another"
        )
    for index, routine in enumerate(routines):
        if (
            abs(routine.speed.max() - conditions.speed_mm_per_s) < 1e-6
            and abs(routine.pause_s[1] - routine.pause_s[0] - conditions.pause_s) < 1e-6
        ):
            return index
    asked = ", ".join(f"{r.speed.max():g} mm/s with {r.pause_s[1] - r.pause_s[0]:g} s" for r in routines)
    raise ValueError(
        f"{path}: expected one of the routines of train_ilc ({asked}), "
        f"found {conditions.speed_mm_per_s:g} mm/s with a pause of "
        f"{conditions.pause_s:g} s; add that routine to printer.routines in params.expert.yaml"
    )


def _resume(
    measured: Sequence[MeasuredTrial], routine: Routine, nominal: Extruder, settings: LawSettings
) -> tuple[TrialSequence | None, ilc.Step]:
    """What was learned in the trials so far, and what follows: trial 0 is on-off control."""
    u0 = on_off(routine.r, nominal)
    trials = [one.trial for one in measured]
    if not trials:
        first = obeyed(u0, settings.drive, sample_time_s=settings.sample_time_s)
        return None, ilc.Step(first, 0, False, [])
    law = training.model_inverse(routine, settings)
    step = ilc.next_step(trials, routine.r, law, rise=settings.rise)
    gain_ratio = law.model.extruder.gain / nominal.gain if law.model else 1.0
    if not 1 / WRONG_GAIN < gain_ratio < WRONG_GAIN:
        raise ValueError(
            f"the trials show {gain_ratio:.3g} times the gain of printer.materials; "
            "check the units of the command, "
            "the calibration and the frames' size, or write the gain as it is"
        )
    rows = ilc.table(
        trials,
        routine.r,
        steady=float(u0.max()),
        drive=settings.drive,
        sample_time_s=settings.sample_time_s,
        rise=settings.rise,
    )
    return TrialSequence("pixels", routine, trials, rows, law.model), step


def recordings(folder: Path, following: Path, work: Work) -> Part:
    """The trials in `folder`, and in `following` the command of the next trial of every
    material and routine, on-off where there is none yet."""
    printer, camera = work.printer, work.camera
    routines, part = printer.trained(), Part({}, {}, {}, {})
    by_routine = _recorded(Path(folder), printer, camera, routines)
    px = abs(camera.mm_per_px)
    following.mkdir()
    for material in printer.materials:
        nominal = _nominal(material)
        figures = _before(nominal, routines, work)
        models: dict[str, Any] = {"nominal": laws.plain(nominal)}
        for index, routine in enumerate(routines):
            key = (material.name, index)
            measured = by_routine.get(key, [])
            with about(f"{folder}: material {material.name}, routine {index}"):
                sequence, step = _resume(measured, routine, nominal, work.laws)
            name = f"{material.name}_routine_{index}_trial_{len(measured):02d}"
            conditions = trial_video.conditions(
                material,
                routine,
                len(measured),
                "model_inverse" if measured else "on_off",
                printer=printer,
                camera=camera,
                calibration=bead.Calibration(px, 0.0, 0.0, np.zeros(0)),
            )
            trial_files.write_command(following / name, conditions, time_s=routine.time_s, command_mm=step.u)
            figures[f"routine_{index}"] = {
                "next": name,
                "best_trial": step.best,
                "rolled_back": step.rolled_back,
                "restarts": step.restarts,
            }
            if sequence:
                part.sequences[key], part.measured[key] = [sequence], list(measured)
                figures["pixels" if index == 0 else f"pixels_{index}"] = training.figures(
                    sequence, rise=work.laws.rise
                ) | trial_video.latency_figures(measured)
                models["identified" if index == 0 else f"identified_{index}"] = _model(sequence.model)
        part.metrics[material.name], part.models[material.name] = figures, models
    return part
