"""What train_ilc does for its materials: a simulated machine taught in flow and in pictures, or the
trials of a real one and the command of the next."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from joblib import delayed
from tqdm import tqdm

from pipeline.deposition import bead, ilc, training
from pipeline.deposition.extruder import Extruder, Routine, draw
from pipeline.deposition.ilc import Trial
from pipeline.deposition.training import Lesson, Noise, Run, Settings, on_off, ours, run
from pipeline.deposition.workflow import laws, trial_files, trial_video
from pipeline.deposition.workflow.settings import Camera, Material, Printer, TrainIlc
from pipeline.deposition.workflow.trial_video import Watched
from pipeline.store.artifacts import about
from pipeline.store.execution import run_all
from pipeline.store.params import Execution

# an extruder is known to 30 %: what is off by this factor is a unit, a scale or a picture of
# another size, and the next command would be off as much
WRONG_GAIN = 3.0


class Work(NamedTuple):
    """Section train_ilc and what it shares with others."""

    p: TrainIlc
    settings: Settings
    noise: Noise
    printer: Printer
    camera: Camera


class Part(NamedTuple):
    """What came of one material, or of all, by material and number of the routine: runs,
    what was filmed, models and metrics by material."""

    runs: dict[tuple[str, int], list[Run]]
    watched: dict[tuple[str, int], list[Watched]]
    models: dict[str, dict[str, Any]]
    metrics: dict[str, dict[str, Any]]


def trained(
    p: TrainIlc, printer: Printer, camera: Camera, execution: Execution, *, recorded: str, out: Path
) -> Part:
    """Every material, simulated in flow and in pictures with recordings in out/recordings; or the trials in
    `recorded`, and in out/next the command of the next one."""
    work = Work(p, laws.settings(p, printer), laws.noise(p), printer, camera)
    (out / "recordings").mkdir()
    calls = [
        delayed(simulate)(out / "recordings", work, i, kind)
        for i in range(len(printer.materials))
        for kind in ("flow", "pixels")
    ]
    if p.source == "recordings":
        calls = [delayed(recordings)(recorded, out / "next", work)]
    return joined(
        tqdm(
            run_all(calls, execution), total=len(calls), desc="train_ilc: materials, in flow and in pictures"
        )
    )


def shown(
    p: TrainIlc, camera: Camera, execution: Execution, *, recorded: str, out: Path
) -> list[dict[str, Any]]:
    """A few frames of the first and the last trial of each material in out/frames, and a row for each."""
    kept = sorted((out / "recordings").glob("*.mcap"))
    if p.source == "recordings":
        kept = trial_video.first_and_last(sorted(Path(recorded).rglob("[!.]*.mcap")), camera)
    frames = run_all([delayed(trial_video.shown)(path, out / "frames", camera) for path in kept], execution)
    return [row for rows in frames for row in rows]


def joined(parts: Iterable[Part]) -> Part:
    """All parts as one; dictionaries of one material are put together."""
    whole = Part({}, {}, {}, {})
    for part in parts:
        for key, found in part.runs.items():
            whole.runs.setdefault(key, []).extend(found)
        whole.watched.update(part.watched)
        for mine, others in ((whole.models, part.models), (whole.metrics, part.metrics)):
            for name, found in others.items():
                mine.setdefault(name, {}).update(found)
    return whole


def _nominal(material: Material) -> Extruder:
    return Extruder(material.gain_mm3_per_s_per_mm, material.time_constant_s)


def _model(found: ilc.TrialModel | None) -> dict[str, float] | None:
    if found is None:
        return None
    e = found.extruder
    return {
        "gain": e.gain, "time_constant_s": e.time_constant_s, "delay_s": e.delay_s, "yield": e.yield_,
        "noise": found.noise,
        "fit_percent": found.fit_percent,
    }  # fmt: skip


# ---- a simulated machine


def simulate(folder: Path, work: Work, index: int, kind: str) -> Part:
    """Material `index` on a machine drawn from the family: in "flow", measured with noise, by the paper's law
    and by ours; in "pixels", through recordings in `folder`."""
    material, routines = work.printer.materials[index], work.printer.trained()
    nominal, steady = _nominal(material), work.printer.steady_flow
    plant = draw(
        np.random.default_rng([work.p.seed, index]),
        gain=nominal.gain,
        time_constant_s=nominal.time_constant_s,
        steady_flow=steady,
    )
    lesson, s, name = Lesson(nominal, plant, routines), work.settings, material.name
    rngs = tuple(np.random.default_rng([work.p.seed, index, number]) for number in range(1, 5))
    before = _before(nominal, routines, work)
    updates = work.p.trials * (len(routines) + 2) if kind == "flow" else work.p.pixel_trials
    with tqdm(
        total=updates,
        desc=f"train_ilc: {name} in {kind}",
        position=1 + 2 * index + (kind == "pixels"),
        mininterval=2,
        leave=False,
    ) as bar:
        if kind == "pixels":
            done, seen, calibration = _pictures(
                folder,
                material,
                lesson,
                rngs[:2],
                work.noise,
                trials=work.p.pixel_trials,
                printer=work.printer,
                camera=work.camera,
                s=s,
                on_step=lambda _: bar.update(),
            )
            figures = {"pixels": training.figures(done, rise=s.rise) | _seen(seen, routines[0])}
            return Part(
                {(name, 0): [done]},
                {(name, 0): seen},
                {name: {"calibration": calibration._asdict()}},
                {name: figures},
            )
        taught = training.teach(
            lesson, rngs[2], work.noise, trials=work.p.trials, s=s, on_step=lambda _: bar.update()
        )
    after = training.convergence_of_ours(taught[1], rngs[3], work.noise, plants=work.p.family_plants, s=s)
    figures = before | {
        "gamma_ours": after.nominal, "gamma_ours_worst": after.family.max(),
        "paper": training.figures(taught[-1], rise=s.rise),
        "paper_on_machine": training.figures(taught[0], rise=s.rise),
        "ours": training.figures(taught[1], rise=s.rise),
        "other_routines": [training.figures(done, rise=s.rise) for done in taught[2:-1]],
    }  # fmt: skip
    runs = {(name, 0): [taught[-1], *taught[:2]]} | {
        (name, i): [done] for i, done in enumerate(taught[2:-1], 1)
    }
    models = {
        "nominal": laws.plain(nominal),
        "plant": laws.plain(plant),
        "identified": _model(taught[1].model),
    }
    return Part(runs, {}, {name: models}, {name: figures})


def _before(nominal: Extruder, routines: Sequence[Routine], work: Work) -> dict[str, Any]:
    """What is known before anything runs: gamma of the paper's law on the nominal model and over the family,
    and the authority of the drive over each routine."""
    s, steady = work.settings, work.printer.steady_flow
    found = training.convergence(
        nominal,
        np.random.default_rng([work.p.seed, 0, 0]),
        plants=work.p.family_plants,
        steady_flow=steady,
        s=s,
    )
    has = [training.authority(routine, nominal, worst_ratio=work.p.worst_ratio, s=s) for routine in routines]
    return {
        "gamma": found.nominal, "gamma_worst": found.family.max(),
        "gamma_above_1_percent": 100 * np.mean(found.family > 1),
        "authority": [{"peak_over_steady": a.peak / a.steady, "least_ratio": a.ratio,
        "ramp_s": a.ramp_s} for a in has],
    }  # fmt: skip


def _seen(seen: Sequence[Watched], routine: Routine) -> dict[str, float]:
    """How well the pictures told the flow, over all trials: r.m.s. error in % of the steady flow, in the
    whole trial and around its pause, and frames without a bead."""
    errors = np.array([w.flow.flow - w.trial.truth for w in seen]) / routine.r.max()
    near = (routine.time_s > routine.pause_s[0] - 0.3) & (routine.time_s < routine.pause_s[1] + 0.3)
    whole, corner = (100 * np.sqrt(np.mean(part**2, axis=1)) for part in (errors, errors[:, near]))
    frames = sum(w.frames for w in seen)
    return {
        "flow_error_percent": float(np.median(whole)), "flow_error_corner_percent": float(np.median(corner)),
        "rejected_percent": 100 * sum(sum(w.rejected.values()) for w in seen) / frames,
    }  # fmt: skip


def _pictures(
    folder: Path,
    material: Material,
    lesson: Lesson,
    rngs: tuple[np.random.Generator, np.random.Generator],
    noise: Noise,
    *,
    trials: int,
    printer: Printer,
    camera: Camera,
    s: Settings,
    on_step: Callable[[Trial], None],
) -> tuple[Run, list[Watched], bead.Calibration]:
    """Our law on the reference routine of a simulated machine, the flow measured from pictures: every trial
    is one recording in `folder`, written and read back; those of the first and last trial are kept. `rngs`
    draw what the camera sees, and what does not repeat."""
    routine, seen = lesson.routines[0], []
    looks = trial_video.scene(camera, rngs[0])
    calibration = trial_video.calibrate(looks, camera, rngs[0])

    def measure(u: np.ndarray) -> Trial:
        j = len(seen)
        path = folder / f"{material.name}_{j:02d}.mcap"
        known = trial_video.conditions(
            material,
            routine,
            j,
            "pixels" if j else "on_off",
            printer=printer,
            camera=camera,
            calibration=calibration,
        )
        trial_video.film(
            path,
            known,
            lesson.plant,
            routine,
            u,
            printer=printer,
            camera=camera,
            scene=looks,
            noise=noise,
            rng=rngs[1],
        )
        seen.append(trial_video.watch(path, routine, printer=printer, camera=camera))
        if j > 1:
            (folder / f"{material.name}_{j - 1:02d}.mcap").unlink()
        return seen[-1].trial

    done = run(
        "pixels", ours(routine, s), measure, routine, lesson.nominal, trials=trials, s=s, on_step=on_step
    )
    return done, seen, calibration


# ---- trials of a real machine


def _recorded(
    folder: Path, printer: Printer, camera: Camera, routines: Sequence[Routine]
) -> dict[tuple[str, int], list[Watched]]:
    """The trials that lie in `folder`, by (material, number of the routine) in the order of their numbers.

    Raises ValueError, naming the file, for an unknown material, nozzle or
    routine, and where a trial is missing or there twice.
    """
    found: dict[tuple[str, int], dict[int, tuple[Path, Watched]]] = {}
    for path in sorted(file for file in folder.rglob("*.mcap") if not file.name.startswith(".")):
        known = trial_files.read_trial(path, unreadable_share=camera.unreadable_share).conditions
        if known is None:
            raise ValueError(
                f"{path}: expected the metadata record {trial_files.SCHEMA} with material "
                "and trial, found none; "
                "copy it from the command in datasets/train_ilc/next"
            )
        key = (known.material, _routine(path, known, printer, routines))
        done = found.setdefault(key, {})
        if known.trial in done:
            raise ValueError(
                f"{path}: trial {known.trial} of material {known.material} is in {done[known.trial][0]} too; "
                "keep one of the two"
            )
        done[known.trial] = (path, trial_video.watch(path, routines[key[1]], printer=printer, camera=camera))
    for (material, index), done in found.items():
        lacking = sorted(set(range(max(done))) - set(done))
        if lacking:
            raise ValueError(
                f"{folder}: trial {lacking[0]} of material {material}, routine {index}, "
                f"is missing beside trial {max(done)}; add it, "
                "or renumber the others"
            )
    return {key: [done[j][1] for j in sorted(done)] for key, done in sorted(found.items())}


def _routine(path: Path, known: trial_files.Conditions, printer: Printer, routines: Sequence[Routine]) -> int:
    names = [material.name for material in printer.materials]
    if known.material not in names:
        raise ValueError(
            f"{path}: material {known.material} is not among printer.materials {', '.join(names)}; "
            "add it to params.yaml, "
            "or take the file away"
        )
    if known.nozzle != f"{printer.nozzle_mm:g}":
        raise ValueError(
            f"{path}: expected a nozzle of {printer.nozzle_mm:g} mm (printer.nozzle_mm), "
            f"found {known.nozzle}; "
            "what one nozzle learned does not hold for another"
        )
    for index, routine in enumerate(routines):
        if (
            abs(routine.speed.max() - known.speed_mm_per_s) < 1e-6
            and abs(routine.pause_s[1] - routine.pause_s[0] - known.pause_s) < 1e-6
        ):
            return index
    asked = ", ".join(f"{r.speed.max():g} mm/s with {r.pause_s[1] - r.pause_s[0]:g} s" for r in routines)
    raise ValueError(
        f"{path}: expected one of the routines of train_ilc ({asked}), "
        f"found {known.speed_mm_per_s:g} mm/s with a pause of "
        f"{known.pause_s:g} s; add that routine to printer.routines in params.expert.yaml"
    )


def _resume(
    watched: Sequence[Watched], routine: Routine, nominal: Extruder, s: Settings
) -> tuple[Run | None, ilc.Step]:
    """What was learned in the trials so far, and what follows: trial 0 is on-off control."""
    u0 = on_off(routine.r, nominal)
    done = [one.trial for one in watched]
    if not done:
        return None, ilc.Step(u0, 0, False, False)
    law = ours(routine, s)
    step = ilc.next_step(done, routine.r, law, rise=s.rise)
    found = law.model.extruder.gain / nominal.gain if law.model else 1.0
    if not 1 / WRONG_GAIN < found < WRONG_GAIN:
        raise ValueError(
            f"the trials show {found:.3g} times the gain of printer.materials; "
            "check the units of the command, "
            "the calibration and the frames' size, or write the gain as it is"
        )
    rows = ilc.table(done, routine.r, steady=float(u0.max()), limit=s.limit, rise=s.rise)
    return Run("pixels", routine, done, rows, law.model), step


def recordings(folder: Path, following: Path, work: Work) -> Part:
    """The trials in `folder`, and in `following` the command of the next trial of every
    material and routine, on-off where there is none yet."""
    printer, camera, s = work.printer, work.camera, work.settings
    routines, whole = printer.trained(), Part({}, {}, {}, {})
    seen = _recorded(Path(folder), printer, camera, routines)
    px = abs(camera.mm_per_px)
    following.mkdir()
    for material in printer.materials:
        nominal = _nominal(material)
        figures = _before(nominal, routines, work)
        models: dict[str, Any] = {"nominal": laws.plain(nominal)}
        for index, routine in enumerate(routines):
            watched = seen.get((material.name, index), [])
            with about(f"{folder}: material {material.name}, routine {index}"):
                done, step = _resume(watched, routine, nominal, s)
            name = f"{material.name}_routine_{index}_trial_{len(watched):02d}"
            known = trial_video.conditions(
                material,
                routine,
                len(watched),
                "ours" if watched else "on_off",
                printer=printer,
                camera=camera,
                calibration=bead.Calibration(px, 0.0, 0.0, np.zeros(0)),
            )
            trial_files.write_command(following / name, known, time_s=routine.time_s, command_mm=step.u)
            figures[f"routine_{index}"] = {
                "next": name,
                "best_trial": step.best,
                "rolled_back": step.rolled_back,
                "stopped": step.stopped,
            }
            if done:
                whole.runs[material.name, index], whole.watched[material.name, index] = [done], list(watched)
                figures["pixels" if index == 0 else f"pixels_{index}"] = training.figures(done, rise=s.rise)
                models["identified" if index == 0 else f"identified_{index}"] = _model(done.model)
        whole.metrics[material.name], whole.models[material.name] = figures, models
    return whole
