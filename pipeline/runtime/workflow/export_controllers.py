"""What export_controllers does.

The controller that the temperature loop's verdict recommends is rebuilt as it was judged, certified and
written; the setpoint loop's eyes and filter are written for a machine without jax (export_setpoint.py); of
the deposition loop the commands that compose wrote are named."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.runtime import bands, certificate, certify, machine, supervisor, support
from pipeline.runtime.certificate import Certificate
from pipeline.runtime.export import vectors
from pipeline.runtime.machine import Exported
from pipeline.runtime.replay import Log
from pipeline.runtime.workflow import exports, replay
from pipeline.runtime.workflow.settings import ExportControllers
from pipeline.store import artifacts
from pipeline.temperature import tables
from pipeline.temperature.controllers import controller
from pipeline.temperature.controllers.problem import DesignProblem
from pipeline.temperature.controllers.table import BY_NAME, design_controllers
from pipeline.temperature.identification.segments import segments, without_gaps
from pipeline.temperature.settings import Panel, Plant, TemperatureRules
from pipeline.temperature.test_set import cases, panel

FALLBACK = "pi_simc"  # the safe mode "pi"; where the machine allows none, inputs are held
NEWEST = 0.25  # of a single recording, its end, stands for the machine as it is now


class Judged(NamedTuple):
    """What evaluate_temperature read, and its summary: what a controller is rebuilt from."""

    machine: Plant
    setting: cases.CaseConditions
    problem: DesignProblem
    weights: Mapping[str, Mapping[str, Any]]
    summary: Mapping[str, Any]
    simulated: bool


def chosen(winner: str | None, said: str) -> tuple[str, str]:
    """The contestant that the verdict names, and why there is none where there is none; `said` is what the
    verdict says."""
    if not winner:
        return "", f"The verdict names no controller to run: {said}"
    if winner == "hold":
        return "", "Doing nothing is recommended: there is no controller to export."
    return winner, ""


def exported(judged: Judged, name: str) -> Exported:
    """The contestant as it was judged, with its safe mode, its supervisor and the machine it is for."""
    designs, refused = design_controllers(judged.problem, judged.weights)
    if name not in designs:
        raise ValueError(
            f"datasets/evaluate_temperature/summary.json: {name} is recommended but cannot be designed "
            f"({refused.get(name, 'it is none of this version')}); make it again with ./run dvc repro "
            "evaluate_temperature"
        )
    problem, design = judged.problem, designs[name]
    wired = wired_to(judged.machine)
    noise = judged.setting.rehearsal.noise
    safe = cases.deploy(designs[FALLBACK], judged.setting) if FALLBACK in designs else None
    watched = supervisor.supervision(design.model, problem.family, wired, noise)
    return Exported(
        name,
        wired,
        cases.deploy(design, judged.setting),
        design.model,
        safe,
        watched,
        judged.simulated,
        machine.plants_sha256([problem.plant]),
        machine.plants_sha256(problem.family[1:]),
    )


def wired_to(declared: Plant) -> machine.Machine:
    """Section `plant` as a controller knows it."""
    low, high = cases.output_limits(declared)
    return machine.Machine(
        tuple(machine.Signal(one.name, one.unit, one.low, one.high) for one in declared.inputs),
        tuple(
            machine.Signal(one.name, one.unit, float(least), float(most))
            for one, least, most in zip(declared.outputs, low, high, strict=True)
        ),
        declared.sample_time_s,
    )


# ---- the certificate


def evidence(path: str, declared: Plant) -> certificate.Record:
    """The record of ingest in pieces without a missing sample; the newest are those of the last recording,
    of a single one its last quarter."""
    table = artifacts.read_table(path, tables.record(declared.acting, declared.outputs))
    inputs, outputs = ([one.name for one in signals] for signals in (declared.inputs, declared.outputs))
    u, y, names = segments(table, inputs, outputs)
    pieces = list(zip(*without_gaps(u, y, names), strict=True))
    last = [piece[2] == pieces[-1][2] for piece in pieces]
    if all(last):
        longest = max(range(len(pieces)), key=lambda i: len(pieces[i][0]))
        a, b, name = pieces[longest]
        cut = round((1 - NEWEST) * len(a))
        pieces[longest : longest + 1] = [(a[:cut], b[:cut], name), (a[cut:], b[cut:], name)]
        last[longest : longest + 1] = [False, True]
        last = [flag and i == longest + 1 for i, flag in enumerate(last)]
    wired = wired_to(declared)
    learned, newest = (
        [piece for piece, flag in zip(pieces, last, strict=True) if flag == new] for new in (False, True)
    )
    return certificate.Record(
        wired.inputs,
        wired.outputs,
        wired.sample_time_s,
        [piece[0] for piece in learned],
        [piece[1] for piece in learned],
        [piece[0] for piece in newest],
        [piece[1] for piece in newest],
    )


def asked(
    judged: Judged, rules: TemperatureRules, settings: ExportControllers, seen: certificate.Record
) -> certificate.Rules:
    """What the certificate asks: those of the judging half's constant references that the record reaches,
    from where the record is coolest, within the settled error and with the margins of the verdict. What lies
    further off was rehearsed only. Where the record reaches none, all are asked, and refused."""
    judging, setting = judged.setting.rehearsal.judging, judged.setting
    constants = sorted({int(judging.asked[row, 0]) for row in np.flatnonzero(judging.kind == "constant")})
    every = np.array([judging.references[index].H[:, 0] for index in constants])
    y = np.concatenate([*seen.y, *seen.newest_y])
    low, high = y.min(axis=0), y.max(axis=0)
    near = (every >= low - REACH * (high - low)) & (every <= high + REACH * (high - low))
    return certificate.Rules(
        references=every[near.all(axis=1)] if near.all(axis=1).any() else every,
        start=np.quantile(y, COOLEST, axis=0),
        steps=judging.steps // 2,
        settled=min(setting.settled, judging.steps // 4),
        settled_error_degC=rules.settled_error_degC,
        disk_margin=rules.disk_margin,
        delay_margin_s=rules.delay_margin_s,
        plants=settings.plants,
        resamples=settings.resamples,
    )


REACH = 0.25  # of the recorded span, beyond which no reference is certified
COOLEST = 0.05  # quantile of the recorded temperatures


def certified(
    made: Exported, judged: Judged, rules: TemperatureRules, settings: ExportControllers, path: str
) -> Certificate:
    """The certificate on the record at `path`."""
    seen, rng = evidence(path, judged.machine), np.random.default_rng(settings.seed)
    asks, how = asked(judged, rules, settings, seen), learning(made.name, judged)
    return certify.certify(made, judged.problem.family[1:], seen, asks, rng, learning=how)


def learning(name: str, judged: Judged) -> bands.Learning | None:
    """How the gains of a contestant were learned from the record; None where they are those of a model."""
    problem, of = judged.problem, BY_NAME[name].learned_from
    if of == "window":
        N = problem.window.N
    elif of == "kernel" and problem.kernel is not None:
        N = problem.kernel.N
    else:
        return None
    effort = float(judged.weights[name]["effort_weight"])
    p, m = problem.plant.p, problem.plant.m
    return bands.Learning(of, N, np.ones(p), np.full(m, effort), problem.gamma)


# ---- support


def supported(made: Exported, judged: Judged, declared: Panel, seed: int, path: str) -> support.Support:
    """What a replay holds a recording against: plants drawn anew from the spread forecast; honest logs are
    those of the judging half under this controller."""
    family, half = judged.problem.family, judged.setting.rehearsal.judging
    rng = np.random.default_rng(seed)
    spread = cases.spread_of(declared) if judged.simulated else cases.spread_around(declared, family[0])
    plants = panel.padded(panel.drawn(family, FORECASTING, spread, cells=False, rng=rng))
    aimed = panel.aims(made.controller.law, panel.rests(made.model, half, judged.setting.limits), half)
    run, noise = panel.rolled_out(made.controller, half, aimed), panel.noise_of(half)[: half.hold]
    honest = []
    for case in np.unique(np.linspace(0, len(half.plant) - 1, HONEST_LOGS).astype(int)):
        plant, still = half.plants[half.plant[case]], np.ones((half.hold, 1))
        held = plant.C @ half.x0[case] + plant.d + noise[:, case]
        parts = (still * half.u0[case], run.u[:, case]), (held, run.measured[:, case]), (
            still * run.r[0, case], run.r[:, case],
        )  # fmt: skip
        honest.append(Log(*(np.concatenate(part) for part in parts)))
    seen = evidence(path, judged.machine)
    recorded = [
        Log(u, y, y) for u, y in zip([*seen.u, *seen.newest_u], [*seen.y, *seen.newest_y], strict=True)
    ]
    return support.support(plants, honest, judged.setting.rehearsal.noise, recorded)


FORECASTING, HONEST_LOGS = 24, 200  # plants, and logs at most

# ---- what runs is what was judged


def replayed(made: Exported, judged: Judged, trajectories: Mapping[str, np.ndarray]) -> float:
    """The largest difference in percent between what `made` asks for in the deciding case of the panel and
    what trajectories.parquet says that the judged contestant was given there."""
    every, case = judged.setting.rehearsal.judging, int(judged.summary["deciding"]["case"])
    rows = (trajectories["contestant"] == made.name) & (trajectories["case_name"] == "deciding")
    applied = np.stack([trajectories[f"{one.name}_applied"][rows] for one in made.machine.inputs], axis=1)
    if len(applied) != every.steps:
        raise ValueError(
            f"datasets/evaluate_temperature/trajectories.parquet: the deciding case of {made.name} should "
            f"have {every.steps} steps but has {len(applied)}; make it again with ./run dvc repro "
            "evaluate_temperature"
        )
    return float(np.abs(commands(made, every, case) - applied).max())


def commands(made: Exported, every: panel.Cases, case: int) -> np.ndarray:
    """Commands (steps, m) of the law, a sample at a time, in one case of a panel."""
    running, noise = controller.RunningController(made.controller, made.model), panel.noise_of(every)[:, case]
    plant, x, u = every.plants[every.plant[case]], every.x0[case], every.u0[case]
    held, first = plant.C @ x + plant.d, every.references[every.asked[case, 0]]
    for t in range(every.hold):
        running.watch(u, held + noise[t], first.H @ first.w0)
    running.hand_over(held + noise[every.hold], at=every.starts[every.start[case]])
    given = np.empty((every.steps, len(u)))
    for t in range(every.steps):
        number = every.asked[case, np.flatnonzero(every.begin[case] <= t)[-1]]
        reference = every.references[number]
        r = reference if len(reference.w0) > 1 else reference.H[:, 0]
        u = given[t] = running.step(plant.C @ x + plant.d + noise[every.hold + t], r, t)
        x = plant.A @ x + plant.B @ u + plant.b
    return given


SAME = 1e-9  # of an input's range, by which commands in another order of sums may differ


def check_same(made: Exported, difference: float) -> None:
    """Raises ValueError where what would be exported is not what was judged."""
    span = max(one.high - one.low for one in made.machine.inputs)
    if not difference <= SAME * span:
        raise ValueError(
            f"datasets/evaluate_temperature/trajectories.parquet: {made.name} asks for commands "
            f"{difference:g} percent away from those that were judged; expected at most {SAME * span:g}; "
            "make it again with ./run dvc repro evaluate_temperature"
        )


def of_python(made: Exported, code: str) -> float:
    """The largest difference in percent between the exported file, run as it stands, and the object, over the
    samples of golden.csv: limits, faults and hand-overs."""
    module: dict[str, Any] = {"__name__": "exported"}
    exec(compile(code, "exported.py", "exec"), module)
    asked, at = vectors.script(made, episodes=2, steps=160, rng=np.random.default_rng(2)), vectors.start(made)
    wired = {
        "plant_sha256": made.plant_sha256,
        "sample_time_s": made.machine.sample_time_s,
        "input_unit": machine.PERCENT,
        "output_unit": machine.DEGC,
        "rehearsal": made.simulated,
    }
    one = vectors.played(lambda: supervisor.Supervised(made, rehearsal=True), made.model, at, asked)
    other = vectors.played(lambda: module["controller"](**wired), made.model, at, asked)
    return float(np.abs(one.u - other.u).max())


# ---- the files


class Written(NamedTuple):
    """What is told of one loop: its contestant, its certificate in short or None with why there is none,
    files with their SHA-256, and largest differences by what was compared, in `unit`."""

    contestant: str
    certificate: dict[str, Any] | None
    why: str
    files: dict[str, str]
    largest_difference: dict[str, float]
    unit: str


def write_temperature(
    folder: Path, made: Exported, shown: Certificate, within: support.Support, differences: dict[str, float]
) -> Written:
    """controller.json, arrays.safetensors, certificate.json, support.safetensors, c/ and python/; of one that
    was refused the certificate alone."""
    if shown.verdict != "passed":
        artifacts.write_text(folder / machine.CERTIFICATE, certificate.to_json(shown))
        return Written(made.name, brief(shown), refusal(shown), {}, differences, "percent")
    machine.write(folder, made, shown)
    replay.write_support(folder, within, shown.controller_sha256)
    for name, text in exports.files(made, shown, "c", "", None).items():
        artifacts.write_text(folder / "c" / name, text)
    code = exports.files(made, shown, "python", "", None)["controller.py"]
    artifacts.write_text(folder / "python" / "controller.py", code)
    differences = differences | {"python": of_python(made, code)}
    return Written(made.name, brief(shown), "", hashes(folder), differences, "percent")


def refusal(shown: Certificate) -> str:
    first = next(one for one in shown.rules if one.name == shown.first_failed)
    return f"The certificate is refused by its rule {first.name.replace('_', ' ')}. {first.sentence}"


def brief(shown: Certificate) -> dict[str, Any]:
    """What the metrics keep of a certificate."""
    return {
        "sha256": certificate.sha256(shown),
        "verdict": shown.verdict,
        "first_failed": shown.first_failed,
        "evidence": shown.evidence,
        "controller_sha256": shown.controller_sha256,
        "plant_sha256": shown.plant_sha256,
        "spread_sha256": shown.spread_sha256,
        "sample_time_s": shown.sample_time_s,
        "rules": [
            {key: getattr(one, key) for key in ("name", "passed", "found", "limit", "unit")}
            for one in shown.rules
        ],
    }


def hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of each file below a folder of the stage, by its path below that of the stage."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder.parent).as_posix(): artifacts.sha256(path) for path in files}


def deposition(files: Sequence[str]) -> Written:
    """The commands that compose wrote; they are exported there."""
    there = {path: artifacts.sha256(path) for path in files if artifacts.exists(path)}
    why = "Commands are played as compose wrote them: there is no law to certify."
    return Written("composed commands", None, why, there, {}, "mm")


def metrics(loops: Mapping[str, Written]) -> dict[str, Any]:
    """reports/metrics/export_controllers.json."""
    return {loop: written._asdict() for loop, written in loops.items()}


def nothing(why: str) -> Written:
    return Written("", None, why, {}, {}, "percent")
