"""Certify every controller of the temperature loop that a verdict could name, and prepare the files of each:
reads what evaluate_temperature read and wrote, and of the setpoint loop what train_classifier, train_agent
and evaluate_setpoint wrote. No limit of section `report` enters: what is measured is compared with the limits
by the stages verdict and export_controllers (pipeline/deploy/certificate.py).

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
from pipeline.temperature import tables
from pipeline.temperature.settings import Plant
from stages.evaluate_temperature import EvaluationInputs, load_problem, wire
from stages.tune_weights import read_told

if TYPE_CHECKING:
    import numpy as np

    from pipeline.deploy.certificate import EvidenceRecord, Rules
    from pipeline.deploy.certify import WindowModels
    from pipeline.deploy.replay import GaplessLog
    from pipeline.deploy.supervise import Machine
    from pipeline.temperature.controllers.feed_forward import Told
    from pipeline.temperature.controllers.problem import Design
    from pipeline.temperature.plant import Plant as PlantModel

RECORD = "datasets/ingest/record.parquet"
# the conditions that a certificate names
UNDISTURBED = (
    "No fan, feed or other disturbance is declared: what one does to the temperatures is not shown, and "
    "nothing makes up for it. Put the printed G-code beside klippy.log and run init again, or record a "
    "column and name it in plant.disturbances."
)
# what the setpoint loop's files are made of: without them the temperature loop is certified alone
SEEN = (
    "datasets/train_classifier/weights.safetensors",
    "datasets/papers/train_agent/weights.safetensors",
    "datasets/evaluate_setpoint/choice.json",
)
NOT_ASKED = "Not asked: loops.{} is false."


class Certify(Section):
    """Section `certify`: the seed of everything that is drawn, how many plants of the record's window
    models each controller meets, and how often the record is resampled for the bands of learned gains."""

    seed: int = Field(ge=0, le=2**31)
    plants: int = Field(ge=20, le=100_000)
    resamples: int = Field(ge=20, le=10_000)


class Common(NamedTuple):
    """What is made once for all controllers: the machine, the record, what it shows by itself, and the
    rules."""

    machine: Machine
    record: EvidenceRecord
    rules: Rules
    models: WindowModels
    generator: np.random.Generator  # as the window models left it: every controller goes on with a copy
    plants: list[PlantModel]  # which forecast a recording
    recorded: list[GaplessLog]  # the machine's own record, which is on support whatever the plants say
    conditions: str


def main() -> None:
    with artifacts.stage("certify") as out:
        settings, loops = params.load(Certify, "certify"), params.load(params.Loops, "loops")
        temperature: dict[str, Any] = {}
        setpoint = {"controller": "", **_not_measured(NOT_ASKED.format("setpoint"))}
        if loops.temperature:
            temperature = certify_temperature(out / "temperature", settings)
        if loops.setpoint:
            lacking = [path for path in SEEN if not artifacts.exists(path)]
            setpoint |= _not_measured(f"Not measured: {lacking[0]} is missing." if lacking else "")
            if not lacking:
                setpoint = certify_setpoint(out / "setpoint", settings.seed)
        artifacts.write_json(out / "certified.json", {"temperature": temperature, "setpoint": setpoint})


# ---- temperature


def certify_temperature(folder: Path, settings: Certify) -> dict[str, dict[str, Any]]:
    """By controller: whether it was measured, why not, and the largest differences between what was judged
    and what would be exported."""
    from joblib import delayed
    from tqdm import tqdm

    from pipeline.store.execution import run_all
    from pipeline.temperature.controllers.table import CONTROLLERS, design_controllers

    loaded = load_problem()
    designs, refused = design_controllers(loaded.problem, loaded.weights)
    names = [one.name for one in CONTROLLERS if one.kind != "reference"]
    found = {name: _not_measured(refused[name]) for name in names if name in refused}
    names = [name for name in names if name in designs and not designs[name].holds]
    common = prepare(loaded, settings)
    certify = delayed(certify_controller)
    calls = [certify(folder / name, name, designs, loaded, common) for name in names]
    results = run_all(calls, params.load(params.Execution, "execution"))
    return found | dict(tqdm(results, total=len(calls), desc="certify: controllers", mininterval=2))


def prepare(loaded: EvaluationInputs, settings: Certify) -> Common:
    """What no controller changes."""
    import numpy as np

    from pipeline.deploy import certify, support
    from pipeline.deploy.certificate import EvidenceRecord
    from pipeline.deploy.replay import GaplessLog
    from pipeline.temperature.controllers import feed_forward
    from pipeline.temperature.identification.segments import segments, without_gaps
    from pipeline.temperature.test_set import panel

    declared, family = loaded.machine, loaded.problem.family
    machine, schema = wire(declared), tables.record(declared.acting, declared.outputs)
    names = ([signal.name for signal in side] for side in (declared.acting, declared.outputs))
    pieces = without_gaps(*segments(artifacts.read_table(RECORD, schema), *names))
    acting, y, recordings = certify.cut_at_missing(*pieces)
    u = [piece[:, : len(declared.inputs)] for piece in acting]
    m = len(declared.inputs)
    # what the controllers are given, not what these pieces would say
    told = read_told()
    undisturbed = feed_forward.at_mean(told, acting, y, m)
    parts = certify.split_newest(u, undisturbed, recordings)
    record = EvidenceRecord(machine.inputs, machine.outputs, machine.sample_time_s, *parts)
    setting, rng = loaded.setting, np.random.default_rng(settings.seed)
    half = setting.rehearsal.judging
    rules = certify.require(half, record, setting.settled, settings.plants, settings.resamples)
    models = certify.window_models(machine, record, rules, rng)
    if loaded.simulated:
        spread = panel.spread_of(loaded.panel)
    else:
        spread = panel.spread_around(loaded.panel, loaded.problem.plant)
    plants = support.forecasting_plants(family, spread, np.random.default_rng(settings.seed))
    recorded = [GaplessLog(*log) for log in zip(u, y, y, strict=True)]
    return Common(machine, record, rules, models, rng, plants, recorded, conditions(declared, told))


def conditions(declared: Plant, told: Told | None) -> str:
    """What the controller knows of disturbances, in words, and what of them it makes up for."""
    names = ", ".join(one.name for one in declared.disturbances)
    if not names:
        return UNDISTURBED
    if told is None:
        return f"The record does not tell what these do: {names}. Nothing makes up for it."
    learned, left = [], []
    for k, one in enumerate(declared.disturbances):
        moved = [
            f"{heater.name} {told.gain[i, k]:+.3g} ± {1.645 * told.deviation[i, k]:.2g} %"
            for i, heater in enumerate(declared.inputs)
            if told.forward.gain[i, k]
        ]
        if moved:
            unit = "unit" if one.unit == "1" else one.unit
            learned.append(f"{one.name} ({', '.join(moved)} for each {unit})")
        else:
            left.append(one.name)
    sentences = []
    if learned:
        sentences.append(f"Fed forward: {'; '.join(learned)}, with 90 % bands. Tell them to the controller.")
    if left:
        sentences.append(
            f"The record does not tell what these do: {', '.join(left)}. Nothing makes up for it."
        )
    return " ".join([*sentences, "What disturbances did was taken off the record."])


def certify_controller(
    folder: Path, name: str, designs: dict[str, Design], loaded: EvaluationInputs, common: Common
) -> tuple[str, dict[str, Any]]:
    """Measures one controller and writes its folder; its name, and what certified.json says of it."""
    from pipeline.deploy import (
        assembly,
        bands,
        certificate,
        certify,
        checks,
        machine,
        support,
        to_c,
        to_python,
        vectors,
    )
    from pipeline.deploy.support import write_support
    from pipeline.temperature.controllers.table import BY_NAME

    setting, problem, half = loaded.setting, loaded.problem, loaded.setting.rehearsal.judging
    design, fallback, family = designs[name], assembly.own_control(designs), problem.family
    route = bands.gain_route(problem, BY_NAME[name].learned_from, loaded.weights.get(name, {}))
    try:
        made = assembly.assemble(
            name, design, fallback, common.machine, setting, family, simulated=loaded.simulated
        )
        machine.check(made)
        difference = checks.judged_difference(made, half, *judged_case(name, loaded.machine))
        checks.check_same(made, difference)
        measured = certify.measure(
            made,
            family[1:],
            common.record,
            common.rules,
            common.models,
            common.generator,
            learning=route,
            delay_share=setting.faster,
            conditions=common.conditions,
        )
        honest = support.honest_logs(made, half, setting.limits)
        within = support.support(common.plants, honest, setting.rehearsal.noise, common.recorded)
        sources = to_c.code(made, certificate.PLACE) | {"golden.csv": vectors.golden(made)}
        checks.check_compiled(made, sources)
        code = to_python.code(made, certificate.PLACE)
        differences = {"judged": difference, "python": checks.python_difference(made, code)}
    except ValueError as reason:
        return name, _not_measured(str(reason))
    certificate.write(folder, measured)
    machine.write_controller(folder, made)
    write_support(folder, within, measured.draft.controller_sha256)
    for file, text in sources.items():
        artifacts.write_text(folder / "c" / file, text)
    artifacts.write_text(folder / "python" / "controller.py", code)
    return name, {"measured": True, "why": "", "largest_difference": differences}


def _not_measured(why: str) -> dict[str, Any]:
    return {"measured": False, "why": why, "largest_difference": {}}


def judged_case(name: str, declared: Plant) -> tuple[int, np.ndarray, np.ndarray]:
    """The number of the case that decided the comparison, its true outputs (steps, p) in °C, and the applied
    inputs (steps, m) in percent."""
    import numpy as np

    schema = tables.trajectories(declared.inputs, declared.outputs)
    played = artifacts.read_table("datasets/evaluate_temperature/trajectories.parquet", schema)
    rows = (played["contestant"] == name) & (played["case_name"] == "deciding")
    case = artifacts.read_figures("evaluate_temperature")["deciding"]["case"]
    outputs = np.stack([played[one.name][rows] for one in declared.outputs], axis=1)
    return case, outputs, np.stack([played[f"{one.name}_applied"][rows] for one in declared.inputs], axis=1)


# ---- setpoint


def certify_setpoint(folder: Path, seed: int) -> dict[str, Any]:
    """The files of the default controller, which have no certificate, and how far they are from the
    networks."""
    from pipeline.deploy import to_setpoint
    from pipeline.setpoint.agents.files import restore_published
    from pipeline.setpoint.controllers import build_controllers
    from pipeline.setpoint.settings import EvaluateSetpoint
    from pipeline.setpoint.simulation.recorded import window_tables
    from pipeline.setpoint.tables import WINDOW_PARTS, WINDOWS
    from pipeline.setpoint.vision.files import restore_classifier

    model = restore_classifier(
        "datasets/train_classifier/weights.safetensors", "datasets/train_classifier/calibration.parquet"
    )
    columns = artifacts.read_table("datasets/train_classifier/windows.parquet", WINDOWS)
    learned = window_tables(columns, WINDOW_PARTS)["learn"]
    agent = restore_published("datasets/papers/train_agent/weights.safetensors")
    baselines = params.load(EvaluateSetpoint, "evaluate_setpoint").baselines
    default = str(artifacts.read_json("datasets/evaluate_setpoint/choice.json")["name"])
    built = build_controllers(baselines, agent, learned).get(default)
    return to_setpoint.write_checked(folder, default, model, built and built.parameters, seed)


if __name__ == "__main__":
    stages.run(main, "certify")
