"""Compare every temperature controller, tuned, as it would be deployed, on plants that nobody learned or
tuned on: reads what the temperature stages wrote; writes datasets/evaluate_temperature: cases.parquet,
trajectories.parquet, and its figures as figures.json and summary.json."""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from pydantic import Field, ValidationError

import stages
from pipeline.store import artifacts, params
from pipeline.store.params import Execution, Section
from pipeline.temperature import tables
from pipeline.temperature.settings import Panel, Plant, Tracking, TuneWeights, recorded
from stages.identify_plant import IdentifyPlant, choices
from stages.learn_kernel import LearnKernel, learn, read_record
from stages.tune_weights import load_design_problem

if TYPE_CHECKING:
    import numpy as np

    from pipeline.deploy.supervise import Machine
    from pipeline.temperature.controllers.problem import Design, DesignProblem
    from pipeline.temperature.test_set.evaluation import ControllerOutcome
    from pipeline.temperature.test_set.panel import CaseConditions


class EvaluateTemperature(Section):
    """Section `evaluate_temperature`: the seed of its tests, how often the plants are resampled for a band,
    and whether controllers are learned again from less of the record."""

    seed: int = Field(ge=0, le=2**31)
    resamples: int = Field(ge=20, le=100_000)
    cost_curve: bool


Positive = Annotated[float, Field(gt=0)]


class TunedValues(Section, extra="allow"):
    """The parameters of one controller by name, the weights q (p,) and r (m,) that they stand for, and what
    its search says of them."""

    __pydantic_extra__: dict[str, Positive]  # ty: ignore[incompatible-mutable-override]
    q: list[Positive] = []
    r: list[Positive] = []
    cost: float
    cost_at_start: float | None
    failed: int
    evaluations: int
    at_bound: list[str]


class Weights(Section):
    """datasets/tune_weights/weights.json: what the search was designed for, and its result by controller."""

    design: dict[str, Any] = {}
    contestants: dict[str, TunedValues] = Field(min_length=1)


def read_weights(path: str | Path) -> Weights:
    """What tune_weights wrote. Raises ValueError for a file of another version."""
    try:
        return Weights.model_validate(artifacts.read_json(path))
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise ValueError(f"{path}: {place}: {first['msg']}; {artifacts.remedy(path)}") from None


def wire(declared: Plant) -> Machine:
    """Section `plant` as a controller knows it."""
    from pipeline.deploy.supervise import Machine, Signal
    from pipeline.temperature.test_set import panel

    low, high = panel.output_limits(declared)
    return Machine(
        tuple(Signal(one.name, one.unit, one.low, one.high) for one in declared.inputs),
        tuple(
            Signal(one.name, one.unit, float(least), float(most))
            for one, least, most in zip(declared.outputs, low, high, strict=True)
        ),
        declared.sample_time_s,
        tuple(Signal(one.name, one.unit, -math.inf, math.inf) for one in declared.disturbances),
    )


class EvaluationInputs(NamedTuple):
    """What every controller is designed from and compared by: sections, the conditions of all cases, the
    problem, and the tuned parameters by controller."""

    machine: Plant
    panel: Panel
    setting: CaseConditions
    problem: DesignProblem
    weights: dict[str, dict[str, Any]]
    simulated: bool


def load_problem() -> EvaluationInputs:
    """The parameters, and what the stages before wrote: the same for the evaluation and for the
    certificate."""
    machine = recorded(params.load(Plant, "plant"), "datasets/ingest/record.parquet")
    panel = params.load(Panel, "panel")
    simulated = params.value("generate_probing.source", one_of=("simulated", "recordings")) == "simulated"
    setting, problem = load_design_problem(
        machine,
        panel,
        params.load(Tracking, "tracking"),
        params.load(TuneWeights, "tune_weights"),
        simulated=simulated,
    )
    weights = read_weights("datasets/tune_weights/weights.json").contestants
    tuned = {name: values.model_dump() for name, values in weights.items()}
    return EvaluationInputs(machine, panel, setting, problem, tuned, simulated)


def compare(
    settings: EvaluateTemperature, loaded: EvaluationInputs, execution: Execution
) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """Every controller on the judging half of the panel: the cases and two of them as trajectories, both as
    columns, and the summary."""
    from pipeline.temperature.controllers.table import BY_NAME
    from pipeline.temperature.test_set import evaluation

    machine, setting = loaded.machine, loaded.setting
    outcomes, supervised, refused = evaluate_all(loaded, execution)
    entrants = [name for name in outcomes if BY_NAME[name].kind != "reference"]
    summary: dict[str, Any] = {
        **conditions(machine, loaded.panel, setting),
        "contestants": {
            name: evaluation.summarise(
                outcome,
                setting,
                loaded.weights.get(name, {}),
                seed=settings.seed,
                resamples=settings.resamples,
            )
            | {"supervised": supervised[name]}
            for name, outcome in outcomes.items()
        },
        "order": entrants,
        "refused": refused,
    }
    tuned = {name: values.get("cost", math.inf) for name, values in loaded.weights.items()}
    summary |= evaluation.decide(outcomes, entrants, summary, setting, tuned, settings.seed)
    summary["redesigned"] = redesigns(entrants, loaded)
    pair = summary["pair"]["a"], summary["pair"]["b"]
    summary["cost_curve"] = cost_curve(loaded, pair, settings.seed) if settings.cost_curve else None
    typical = evaluation.typical_case(outcomes, entrants)
    drawn = {"typical": typical, "deciding": summary["deciding"]["case"]}
    return (
        evaluation.case_columns(outcomes, setting, [output.name for output in machine.outputs]),
        evaluation.trajectory_columns(outcomes, drawn, setting, machine),
        summary,
    )


def evaluate_all(
    loaded: EvaluationInputs, execution: Execution
) -> tuple[dict[str, ControllerOutcome], dict[str, dict[str, Any] | None], dict[str, str]]:
    """The outcome of every controller on the judging half of the panel, and what its supervisor found on
    healthy machines, by name; and by name why others are refused."""
    from joblib import delayed
    from tqdm import tqdm

    from pipeline.deploy.assembly import own_control
    from pipeline.store.execution import run_all
    from pipeline.temperature.controllers.table import design_controllers

    designs, refused = design_controllers(loaded.problem, loaded.weights)
    own = own_control(designs)
    calls = [delayed(judge)(name, design, own, loaded) for name, design in designs.items()]
    results = run_all(calls, execution)
    found = list(tqdm(results, total=len(calls), desc="evaluate_temperature: controllers", mininterval=2))
    outcomes, supervised = ({one[0]: one[part] for one in found} for part in (1, 2))
    return {name: outcomes[name] for name in designs}, supervised, refused


def judge(
    name: str, design: Design, own: Design | None, loaded: EvaluationInputs
) -> tuple[str, ControllerOutcome, dict[str, Any] | None]:
    """One controller alone and under its supervisor, which the one that does nothing has none of."""
    from pipeline.deploy import assembly
    from pipeline.temperature.test_set.evaluation import evaluate

    setting = loaded.setting
    _, outcome = evaluate(name, design, setting)
    if design.holds:
        return name, outcome, None
    made = assembly.assemble(
        name, design, own, wire(loaded.machine), setting, loaded.problem.family, simulated=loaded.simulated
    )
    return name, outcome, assembly.play(made, setting.rehearsal.judging)


def redesigns(names: list[str], loaded: EvaluationInputs) -> dict[str, dict[str, Any]]:
    """By controller that takes the identified plant, the extra cost in percent that the plant's bands leave
    open, None if it is without bound, and of how many resamples of the record another controller comes."""
    from pipeline.temperature.controllers.table import BY_NAME
    from pipeline.temperature.test_set.evaluation import redesigned

    found = {}
    for name in (name for name in names if BY_NAME[name].learned_from == "plant"):
        values = {one.name: loaded.weights[name][one.name] for one in BY_NAME[name].parameters}
        excess, broken, of = redesigned(name, loaded.problem, values, loaded.setting)
        percent = 100.0 * excess if excess < float("inf") else None
        found[name] = {"excess_percent": percent, "broken": broken, "of": of}
    return found


def cost_curve(loaded: EvaluationInputs, pair: tuple[str, str], seed: int) -> dict[str, Any]:
    """Cost against the length of the record, of every model-based and data-driven controller that was tuned;
    `refused` says by length and controller why one could not be learned."""
    from pipeline.temperature.controllers.table import CONTROLLERS
    from pipeline.temperature.test_set import record_length

    u, y, _ = read_record(loaded.machine)
    setting = record_length.few_plants(loaded.setting)
    kinds = ("model-based", "data-driven")
    asked = [one for one in CONTROLLERS if one.kind in kinds and one.name in loaded.weights]
    samples, costs, refused = [], [], {}
    for share in record_length.SHARES:
        part = [record_length.beginning(signal, share) for signal in (u, y)]
        learn_once = functools.cache(functools.partial(learn_from, loaded, *part))
        samples.append(sum(map(len, part[0])))
        costs.append({})
        for one in asked:
            try:
                problem = loaded.problem if share == 1 else learn_once(one.learned_from == "plant")
                design = one.design(problem, loaded.weights[one.name])
            except ValueError as reason:
                refused.setdefault(str(samples[-1]), {})[one.name] = str(reason)
            else:
                if design is not None:
                    costs[-1][one.name] = record_length.plant_costs(design, setting)
    return record_length.curves(costs, samples, pair, seed=seed) | {"refused": refused}


def learn_from(
    loaded: EvaluationInputs, u: list[np.ndarray], y: list[np.ndarray], of_plant: bool
) -> DesignProblem:
    """What a controller is designed from, its plant or what is learned from the record itself, again from
    segments u (T, m), y (T, p) as identify_plant and learn_kernel have it. Raises ValueError if they are too
    short."""
    from pipeline.temperature.identification import model_choice
    from pipeline.temperature.plant import observable_part, strictly_proper

    machine = loaded.machine
    if of_plant:
        rules = choices(params.load(IdentifyPlant, "identify_plant"), len(machine.inputs), range(len(u)))
        found = model_choice.identify(u, y, sample_time_s=machine.sample_time_s, settings=rules)
        return loaded.problem._replace(plant=strictly_proper(observable_part(found.plant)))
    learned = learn(params.load(LearnKernel, "learn_kernel"), machine, u, y)
    return loaded.problem._replace(
        **{key: part for key, part in learned._asdict().items() if key != "figures"}
    )


def conditions(machine: Plant, panel: Panel, setting: CaseConditions) -> dict[str, Any]:
    """What the cases have in common; `pace` resolves the limits that depend on the machine's own pace."""
    rehearsal = setting.rehearsal
    return {
        "simulated": rehearsal.source == "declared",
        "plants": len(rehearsal.judging.plants),
        "cases": len(rehearsal.judging.plant),
        "noise_degC": rehearsal.noise.tolist(),
        "seed": rehearsal.judging.seed,
        "steps": rehearsal.judging.steps,
        "settled_steps": setting.settled,
        "sample_time_s": setting.sample_time_s,
        "band_degC": rehearsal.band_degC,
        "pace": {
            "settling_s": rehearsal.settling_s or panel.settling_s,
            "heat_up_s": rehearsal.heat_up_s,
            "delay_margin_share": setting.faster,
            "source": rehearsal.source,
        },
        "outputs_limited": all(o.low is not None and o.high is not None for o in machine.outputs),
        "infeasible": rehearsal.infeasible,
    }


# figures of control that git keeps and that runs are compared by
METRICS = (
    "plants",
    "cases",
    "contestants.*.settled_error.q90",
    "contestants.*.peak.q90",
    "contestants.*.settling.q90",
    "contestants.*.heating.q90",
    "contestants.*.overshoot.q90",
    "contestants.*.at_limits.q90",
    "contestants.*.energy.median",
    "contestants.*.travel.q90",
    "contestants.*.dip.q90",
    "contestants.*.cost.median",
    "contestants.*.cost.q90",
    "contestants.*.never_settled_percent",
    "contestants.*.crossings.cases",
    "contestants.*.supervised.left",
    "contestants.*.supervised.cases",
    "contestants.*.margins",
    "contestants.*.stable.count",
)


def main() -> None:
    with artifacts.stage("evaluate_temperature") as out:
        settings = params.load(EvaluateTemperature, "evaluate_temperature")
        execution, loaded = params.load(Execution, "execution"), load_problem()
        cases, trajectories, summary = compare(settings, loaded, execution)
        artifacts.write_table(out / "cases.parquet", tables.CASES, cases)
        drawn = tables.trajectories(loaded.machine.inputs, loaded.machine.outputs)
        artifacts.write_table(out / "trajectories.parquet", drawn, trajectories)
        artifacts.write_json(out / "summary.json", summary)
        artifacts.write_metrics("evaluate_temperature", summary, METRICS)


if __name__ == "__main__":
    stages.run(main, "evaluate_temperature", loop="temperature")
