"""Certify every controller of the temperature loop that a verdict could name, and prepare the files of each:
reads what evaluate_temperature read and wrote, and of the setpoint loop what train_classifier, train_agent
and evaluate_setpoint wrote. No limit of section `report` enters: what is measured is compared with the limits
by the stages verdict and export_controllers (pipeline/runtime/certified.py).

Writes datasets/certify: temperature/<controller>/ (measured.json, controller.json, arrays.safetensors,
support.safetensors, c/, python/; the place of the certificate's SHA-256 is marked), setpoint/, and
certified.json, which says which controllers were measured and why others were not."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pydantic import Field

import stages
from pipeline.store import artifacts, params
from pipeline.store.params import Section

if TYPE_CHECKING:
    import numpy as np

    from pipeline.runtime.bands import GainRoute
    from pipeline.runtime.certificate import EvidenceRecord, Rules
    from pipeline.runtime.certificate_evidence import WindowModels
    from pipeline.runtime.machine import Exported
    from pipeline.runtime.signals import Machine
    from pipeline.runtime.support import Support
    from pipeline.temperature.plant import Plant as PlantModel
    from pipeline.temperature.workflow import cases
    from pipeline.temperature.workflow.contestants import Design, Problem
    from pipeline.temperature.workflow.settings import Panel, Plant

RECORD = "datasets/ingest/record.parquet"
FALLBACK = "pi_simc"  # the safe mode "pi"; if the machine allows none, the inputs are held
REACH = 0.25  # of the recorded span, beyond which no reference is certified
COOLEST = 0.05  # quantile of the recorded temperatures
# stands in the exported files for the SHA-256 of the certificate, which depends on the limits
PLACE = "@certificate@"
NO_FEED_FORWARD = (
    "The machine declares disturbances ({names}), which an exported controller cannot read yet: none is "
    "certified. Remove plant.disturbances to certify controllers that do without them."
)
NO_SETPOINT = "Not asked: loops.setpoint is false."


class Certify(Section):
    """Section `certify`: the seed of everything that is drawn, how many plants of the record's window
    models each controller meets, and how often the record is resampled for the bands of learned gains."""

    seed: int = Field(ge=0, le=2**31)
    plants: int = Field(ge=20, le=100_000)
    resamples: int = Field(ge=20, le=10_000)


class Evaluated(NamedTuple):
    """What the controllers were designed from and judged on, the same for all of them."""

    declared: Plant
    panel: Panel
    setting: cases.Setting
    problem: Problem
    weights: dict[str, Any]
    simulated: bool


class Common(NamedTuple):
    """What is made once for all controllers: the machine, the record, what it shows by itself, and the
    rules."""

    machine: Machine
    record: EvidenceRecord
    rules: Rules
    models: WindowModels
    generator: np.random.Generator  # as the window models left it: every controller goes on with a copy
    plants: list[PlantModel]  # which forecast a recording


def main() -> None:
    with artifacts.stage("certify") as out:
        settings, loops = params.load(Certify, "certify"), params.load(params.Loops, "loops")
        temperature, setpoint = {}, {"controller": "", "why": NO_SETPOINT, "largest_difference": {}}
        if loops.temperature:
            temperature = certify_temperature(out / "temperature", settings)
        if loops.setpoint:
            setpoint = certify_setpoint(out / "setpoint", settings.seed)
        artifacts.write_json(out / "certified.json", {"temperature": temperature, "setpoint": setpoint})


# ---- temperature


def certify_temperature(folder: Path, settings: Certify) -> dict[str, dict[str, Any]]:
    """By controller: whether it was measured, why not, and the largest differences between what was judged
    and what would be exported."""
    from joblib import delayed
    from tqdm import tqdm

    from pipeline.store.execution import run_all
    from pipeline.temperature.workflow.contestants import CONTESTANTS
    from pipeline.temperature.workflow.evaluate_temperature import designed

    evaluated = load()
    designs, refused = designed(evaluated.problem, evaluated.weights)
    names = [one.name for one in CONTESTANTS if one.role != "yardstick" and one.name != "hold"]
    found = {name: _not_measured(refused[name]) for name in names if name in refused}
    names = [name for name in names if name in designs]
    if disturbances := [one.name for one in evaluated.declared.disturbances]:
        why = NO_FEED_FORWARD.format(names=", ".join(disturbances))
        return found | {name: _not_measured(why) for name in names}
    common = prepare(evaluated, settings)
    calls = [
        delayed(certify_controller)(folder / name, name, designs, evaluated, common, settings)
        for name in names
    ]
    results = run_all(calls, params.load(params.Execution, "execution"))
    return found | dict(tqdm(results, total=len(calls), desc="certify: controllers", mininterval=2))


def load() -> Evaluated:
    """Parameters, and what the stages before wrote."""
    from pipeline.temperature.workflow import evaluate_temperature, learned
    from pipeline.temperature.workflow.settings import Panel, Plant, Tracking, TuneWeights

    machine, panel = params.load(Plant, "plant"), params.load(Panel, "panel")
    simulated = params.value("generate_probing.source", one_of=("simulated", "recordings")) == "simulated"
    made = learned.read_learned(
        "datasets/identify_plant/plant.parquet",
        "datasets/identify_plant/spread.parquet",
        "datasets/learn_kernel",
        "datasets/ingest/printer_pid.json",
        machine,
    )
    posed = learned.posed(
        made,
        machine,
        panel,
        params.load(Tracking, "tracking"),
        params.load(TuneWeights, "tune_weights"),
        RECORD,
        simulated=simulated,
    )
    weights = evaluate_temperature.read_weights("datasets/tune_weights/weights.json", machine)
    return Evaluated(machine, panel, posed.setting, posed.problem, weights, simulated)


def prepare(evaluated: Evaluated, settings: Certify) -> Common:
    import numpy as np

    from pipeline.runtime import certificate_evidence, certify, support_logs
    from pipeline.runtime.certificate import EvidenceRecord
    from pipeline.temperature.workflow import cases
    from pipeline.temperature.workflow.record import read_recordings

    declared, family = evaluated.declared, evaluated.problem.family
    machine = wire(declared)
    segments = certify.split_newest(*read_recordings(RECORD, declared.inputs, declared.outputs))
    record = EvidenceRecord(machine.inputs, machine.outputs, machine.sample_time_s, *segments)
    rules, rng = require(evaluated, settings, record), np.random.default_rng(settings.seed)
    models = certificate_evidence.window_models(machine, record, rules, rng)
    if evaluated.simulated:
        spread = cases.spread_of(evaluated.panel)
    else:
        spread = cases.spread_around(evaluated.panel, evaluated.problem.plant)
    plants = support_logs.forecasting_plants(family, spread, np.random.default_rng(settings.seed))
    return Common(machine, record, rules, models, rng, plants)


def wire(declared: Plant) -> Machine:
    """Section `plant` as a controller knows it."""
    from pipeline.runtime.signals import Machine, Signal
    from pipeline.temperature.workflow import cases

    low, high = cases.output_limits(declared)
    return Machine(
        tuple(Signal(one.name, one.unit, one.low, one.high) for one in declared.inputs),
        tuple(
            Signal(one.name, one.unit, float(least), float(most))
            for one, least, most in zip(declared.outputs, low, high, strict=True)
        ),
        declared.sample_time_s,
    )


def require(evaluated: Evaluated, settings: Certify, record: EvidenceRecord) -> Rules:
    """How each controller is measured: on the constant references of the judging half that the record
    reaches, from where the record is coolest. References further off were simulated only. If the record
    reaches none, all are taken, and the certificate is refused."""
    import numpy as np

    from pipeline.runtime.certificate import Rules

    setting, half = evaluated.setting, evaluated.setting.rehearsal.judging
    constants = sorted({int(half.asked[row, 0]) for row in np.flatnonzero(half.kind == "constant")})
    references = np.array([half.references[index].H[:, 0] for index in constants])
    y = np.concatenate([*record.y, *record.newest_y])
    low, high = y.min(axis=0), y.max(axis=0)
    near = (references >= low - REACH * (high - low)) & (references <= high + REACH * (high - low))
    return Rules(
        references=references[near.all(axis=1)] if near.all(axis=1).any() else references,
        start=np.quantile(y, COOLEST, axis=0),
        steps=half.steps // 2,
        settled=min(setting.settled, half.steps // 4),
        plants=settings.plants,
        resamples=settings.resamples,
    )


def certify_controller(
    folder: Path,
    name: str,
    designs: dict[str, Design],
    evaluated: Evaluated,
    common: Common,
    settings: Certify,
) -> tuple[str, dict[str, Any]]:
    """Measures one controller and writes its folder; its name, and what certified.json says of it."""
    from pipeline.runtime import certified, certify, checks, machine, support_file
    from pipeline.runtime.export import c, python, vectors

    setting, half = evaluated.setting, evaluated.setting.rehearsal.judging
    try:
        made = rebuild(name, designs, evaluated, common.machine)
        machine.check(made)
        difference = checks.judged_difference(made, half, *judged_trajectory(name, evaluated.declared))
        checks.check_same(made, difference)
        measured = certify.measure(
            made,
            evaluated.problem.family[1:],
            common.record,
            common.rules,
            common.models,
            common.generator,
            learning=gain_route(name, evaluated),
            delay_share=setting.faster,
        )
        within = supported(made, evaluated, common)
        code = c.code(made, PLACE) | {"golden.csv": vectors.golden(made)}
        checks.check_compiled(made, code)
        text = python.code(made, PLACE)
        differences = {"judged": difference, "python": checks.python_difference(made, text)}
    except ValueError as reason:
        return name, _not_measured(str(reason))
    certified.write(folder, measured)
    machine.write_controller(folder, made)
    support_file.write_support(folder, within, measured.draft.controller_sha256)
    for file, part in (
        {f"c/{file}": part for file, part in code.items()} | {"python/controller.py": text}
    ).items():
        artifacts.write_text(folder / file, part)
    return name, {"measured": True, "why": "", "largest_difference": differences}


def _not_measured(why: str) -> dict[str, Any]:
    return {"measured": False, "why": why, "largest_difference": {}}


def rebuild(name: str, designs: dict[str, Design], evaluated: Evaluated, wired: Machine) -> Exported:
    """The controller as it was judged, with its safe mode, its supervisor and the machine it is for."""
    from pipeline.runtime import machine, supervisor
    from pipeline.temperature.workflow import cases

    setting, family, design = evaluated.setting, evaluated.problem.family, designs[name]
    safe = cases.as_deployed(designs[FALLBACK], setting) if FALLBACK in designs else None
    return machine.Exported(
        name,
        wired,
        cases.as_deployed(design, setting),
        design.model,
        safe,
        supervisor.supervision(design.model, family, wired, setting.rehearsal.noise),
        evaluated.simulated,
        machine.plants_sha256(family[:1]),
        machine.plants_sha256(family[1:]),
    )


def judged_trajectory(name: str, declared: Plant) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Outputs and references (steps, p) in °C, and applied inputs (steps, m) in percent, of the case that
    decided the comparison."""
    import numpy as np

    from pipeline.temperature.workflow import tables

    schema = tables.trajectories(declared.inputs, declared.outputs)
    played = artifacts.read_table("datasets/evaluate_temperature/trajectories.parquet", schema)
    rows = (played["contestant"] == name) & (played["case_name"] == "deciding")
    outputs, inputs = [one.name for one in declared.outputs], [one.name for one in declared.inputs]
    y, r, u = (
        np.stack([played[column][rows] for column in columns], axis=1)
        for columns in (outputs, [f"{o}_reference" for o in outputs], [f"{i}_applied" for i in inputs])
    )
    return y, r, u


def gain_route(name: str, evaluated: Evaluated) -> GainRoute | None:
    """How the gains of a controller were learned from the record; None if they are those of a model."""
    import numpy as np

    from pipeline.runtime.bands import GainRoute
    from pipeline.temperature.workflow.contestants import BY_NAME

    problem, route = evaluated.problem, BY_NAME[name].learned_from
    if route != "window" and route != "kernel":
        return None
    learned = problem.window if route == "window" else problem.kernel
    if learned is None:
        return None
    effort = float(evaluated.weights[name]["effort_weight"])
    p, m = problem.plant.p, problem.plant.m
    return GainRoute(route, learned.N, np.ones(p), np.full(m, effort), problem.gamma)


def supported(made: Exported, evaluated: Evaluated, common: Common) -> Support:
    """Where a recording is like those that this controller was learned from and judged on."""
    from pipeline.runtime import support, support_logs
    from pipeline.runtime.replay import Log

    setting, record = evaluated.setting, common.record
    recorded = [
        Log(u, y, y)
        for u, y in zip([*record.u, *record.newest_u], [*record.y, *record.newest_y], strict=True)
    ]
    honest = support_logs.honest_logs(made, setting.rehearsal.judging, setting.limits)
    return support.support(common.plants, honest, setting.rehearsal.noise, recorded)


# ---- setpoint


def certify_setpoint(folder: Path, seed: int) -> dict[str, Any]:
    """The files of the default controller, which have no certificate, and how far they are from the
    networks."""
    from pipeline.runtime import setpoint_checks
    from pipeline.setpoint.workflow import contestants
    from pipeline.setpoint.workflow.agent_files import restore_agents
    from pipeline.setpoint.workflow.classifier_files import restore_classifier
    from pipeline.setpoint.workflow.settings import EvaluateSetpoint
    from pipeline.setpoint.workflow.tables import WINDOWS
    from pipeline.setpoint.workflow.windows import window_tables

    model = restore_classifier(
        "datasets/train_classifier/weights.safetensors", "datasets/train_classifier/calibration.parquet"
    )
    windows = window_tables(artifacts.read_table("datasets/train_classifier/windows.parquet", WINDOWS))
    agents = restore_agents("datasets/train_agent/weights.safetensors")
    baselines = params.load(EvaluateSetpoint, "evaluate_setpoint").baselines
    specs = contestants.controllers(contestants.Problem(baselines, agents, windows["learn"]))
    default = str(artifacts.read_json("datasets/evaluate_setpoint/choice.json")["name"])
    decides = setpoint_checks.decider(default, specs, agents)
    return setpoint_checks.write(folder, default, model, decides, seed)


if __name__ == "__main__":
    stages.run(main, "certify")
