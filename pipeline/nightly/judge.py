"""A controller's files -> evidence: the temperature loop on a frozen panel of plants that nothing was learned
from; any loop from a file of costs by case."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import joblib
import numpy as np

from pipeline.deposition.tables import SCORES
from pipeline.nightly import inputs
from pipeline.nightly.decision import CaseCosts
from pipeline.nightly.settings import HoldOut, Nightly, NightlyLoop, PromotionRule
from pipeline.recordings import recording_folders
from pipeline.recordings.isolated import Budget
from pipeline.recordings.recording_folders import RecordingTable
from pipeline.setpoint import tables as setpoint_tables
from pipeline.store import artifacts, params
from pipeline.temperature import plant, tables
from pipeline.temperature.controllers import table, window
from pipeline.temperature.controllers.problem import Design
from pipeline.temperature.settings import Panel, Tracking, TuneWeights, recorded
from pipeline.temperature.settings import Plant as Machine
from pipeline.temperature.test_set import evaluation, panel
from stages.identify_plant import IdentifyPlant, identify
from stages.ingest import Ingest, recording_wish
from stages.tune_weights import read_models

MEMO = Path("datasets/memo/panel")
PAGE = "page"  # of nightly.holdout.controller: the contestant that the page names


class Judge(NamedTuple):
    """`measure(folder, contestant)`: the evidence on a controller whose files lie below the folder (datasets,
    or champion/<loop>); of the temperature loop, on the contestant of that name, or if it is empty on the one
    that nightly.holdout.controller names. `allowed(champion)`: how much worse each guard may be."""

    measure: Callable[..., CaseCosts]
    allowed: Callable[[CaseCosts], dict[str, float]]


def judge(loop: NightlyLoop, settings: Nightly) -> Judge:
    if loop.judge == "cases":
        name = loop.cases.removeprefix("datasets/")
        return Judge(lambda folder, _="": _cases(folder / name)[0], lambda _: _cases(Path(loop.cases))[1])
    percent = settings.rule.worst_case_percent / 100
    if loop.judge in ("deposition", "setpoint"):
        measure = {"deposition": _deposition, "setpoint": _setpoint}[loop.judge]
        return Judge(
            lambda folder, _="": measure(folder),
            lambda champion: {name: percent * value for name, value in champion.guards.items()},
        )
    return Judge(_temperature(settings), lambda champion: _allowed(champion, settings.rule))


def _cases(path: Path) -> tuple[CaseCosts, dict[str, float]]:
    """{"panel": name, "cases": {case: {"block": name, "cost": number}}, "guards":
    {guard: {"value": number, "allowed": number}}}."""
    declared = artifacts.read_json(path)
    try:
        cases = {
            name: (str(case["block"]), float(case["cost"]) if case["cost"] is not None else np.inf)
            for name, case in declared["cases"].items()
        }
        guards = {name: float(guard["value"]) for name, guard in declared["guards"].items()}
        allowed = {name: float(guard["allowed"]) for name, guard in declared["guards"].items()}
        evidence = CaseCosts(str(declared["panel"]), cases, guards)
    except KeyError as error:
        raise ValueError(f"{path}: {_EXPECTED}, found no {error}; let its stage write it") from None
    except (TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"{path}: {_EXPECTED}, found another form ({error}); mend its stage") from None
    wrong = [f"{name} costs {cost:g}" for name, (_, cost) in cases.items() if not cost > 0]
    for name, figures in (("value", guards), ("allowed", allowed)):
        wrong += [f"{name} {figure:g} of {guard}" for guard, figure in figures.items() if np.isnan(figure)]
    if wrong or not cases:
        raise ValueError(
            f"{path}: expected cases with costs above 0, and guards with numbers, found "
            f"{wrong[0] if wrong else 'no case'}; mend its stage"
        )
    return evidence, allowed


_EXPECTED = "expected panel, cases with block and cost, and guards with value and allowed"


def _deposition(folder: Path) -> CaseCosts:
    """Of each part program and material, none of which was trained on: the error of the flow that the chosen
    composer leaves, as its stage scored it. Guard: the worst line, if one is judged."""
    table = artifacts.read_table(folder / "compose_parts/scores.parquet", SCORES)
    rows = [k for k, chosen in enumerate(table["chosen"]) if chosen]
    cases = {
        f"{table['part'][k]}, {table['material'][k]}": (
            f"{table['part'][k]}, {table['material'][k]}",
            max(float(table["rms_percent_of_on_off"][k]), 1e-3),
        )
        for k in rows
    }
    # missing if no line is long enough, or its forecast is not judged: that is no good line
    lines = [float(volume) for k in rows if np.isfinite(volume := table["worst_line_volume_percent"][k])]
    guards = {"worst_line_volume_percent": max(lines)} if lines else {}
    return CaseCosts(joblib.hash(sorted(cases)), cases, guards)


def _setpoint(folder: Path) -> CaseCosts:
    """Of each case of each simulator that counts: the share of runs that the chosen controller does not
    settle, plus one point. Guards: the worst case, and the slowest."""
    table = artifacts.read_table(folder / "evaluate_setpoint/scoreboard.parquet", setpoint_tables.SCOREBOARD)
    chosen = artifacts.read_json(folder / "evaluate_setpoint/choice.json")
    rows = [k for k, name in enumerate(table["controller"]) if name == chosen["name"] and table["counts"][k]]
    lost = {
        f"{table['simulator'][k]}: {table['case'][k]}": 101.0 - float(table["settled_percent"][k])
        for k in rows
    }
    slow = np.nanmax([table["p90_steps"][k] for k in rows], initial=0.0)
    return CaseCosts(
        joblib.hash(sorted(lost)),
        {name: (name, cost) for name, cost in lost.items()},
        {"worst_unsettled_percent": max(lost.values(), default=np.nan), "slowest_p90_steps": float(slow)},
    )


# ---- the temperature loop


def _allowed(champion: CaseCosts, rule: PromotionRule) -> dict[str, float]:
    holdout = champion.guards.get("holdout_error_degC", 0.0)
    return {
        "worst_case": champion.guards["worst_case"] * rule.worst_case_percent / 100,
        "settled_error_degC": rule.settled_error_degC,
        "holdout_error_degC": holdout * rule.holdout_error_percent / 100,
    }


class FrozenPanel(NamedTuple):
    """What every controller of the temperature loop is judged on, night after night: plants, starts,
    references and noise, which are both halves of `rehearsal`, and the hold-out recordings; `name` is the
    hash of all that they were made from."""

    name: str
    machine: Machine
    tracking: Tracking
    settings: Panel
    tuning: TuneWeights
    rehearsal: panel.Rehearsal
    records: list[tuple[np.ndarray, np.ndarray]]


class NotComparable(ValueError):
    """A controller that cannot be designed from its files, in one sentence."""


# besides plant.parquet and window.parquet: what some contestants are designed from
DESIGNED_FROM = {
    "printer_pid": "ingest/printer_pid.json",
    "pi_simc": "identify_plant/spread.parquet",
    "pi": "identify_plant/spread.parquet",
    "learned_kernel": "learn_kernel/kernel.parquet",
    "predictive_control": "learn_kernel/trajectories.parquet",
}


def _temperature(settings: Nightly) -> Callable[..., CaseCosts]:
    """Closed loop on every plant of the frozen panel, as deployed; prediction on the hold-out recordings."""
    frozen = frozen_panel(settings.holdout)
    own = settings.holdout.controller
    return lambda folder, contestant="": _closed_loop(frozen, folder, contestant or own, settings.rule)


def frozen_panel(holdout: HoldOut) -> FrozenPanel:
    """Plants drawn, with the seed of section `nightly.holdout`, around the true plant or around those of the
    hold-out recordings, as far away as section `panel` says."""
    machine, tracking = (
        recorded(params.load(Machine, "plant"), "datasets/ingest/record.parquet"),
        params.load(Tracking, "tracking"),
    )
    settings, tuning = params.load(Panel, "panel"), params.load(TuneWeights, "tune_weights")
    simulated = not _is_recorded()
    records = [] if simulated else _holdout_records(holdout, machine)
    truth = plant.baam()._replace(sample_time_s=machine.sample_time_s)
    nominal = [truth] if simulated else _panel_plants(Path(holdout.recordings), records, machine)
    spread = panel.spread_of(settings) if simulated else panel.spread_around(settings, nominal[0])
    rng = np.random.default_rng(holdout.seed)
    plants = plant.padded(panel.drawn(nominal, holdout.plants, spread, cells=simulated, rng=rng))
    noise = np.full(len(machine.outputs), holdout.noise_degC)
    asked = panel.asked(
        plants,
        _questions(holdout, machine),
        noise=noise,
        seed=holdout.seed,
        steps=holdout.steps,
        hold=settings.hold_steps,
        cells=simulated,
    )
    made_from = (
        holdout.model_dump(),
        [tuple(map(np.asarray, matrices)) for matrices in plants],
        machine.model_dump(),
        tracking.model_dump(),
        settings.model_dump(exclude={"training", "judging"}),
        {key: value for key, value in tuning.model_dump().items() if key.startswith("allow_")},
    )
    rehearsal = panel.Rehearsal(asked, asked, settings.band_degC, None, 0.0, noise, [], "declared")
    return FrozenPanel(joblib.hash(made_from), machine, tracking, settings, tuning, rehearsal, records)


def _questions(holdout: HoldOut, machine: Machine) -> panel.Questions:
    reference = np.array([output.reference for output in machine.outputs])
    return panel.Questions(
        np.array([start * np.ones_like(reference) for start in holdout.starts_degC]),
        np.array([reference + offset for offset in holdout.reference_offsets_degC]),
        None,
        None,
        None,
    )


def _closed_loop(frozen: FrozenPanel, folder: Path, contestant: str, rule: PromotionRule) -> CaseCosts:
    result = judged(frozen, folder, contestant)
    asked = frozen.rehearsal.judging
    references = [asked.references[index].H[0, 0] for index in asked.asked[:, 0]]
    evidence = {
        f"plant {p}, {start:g} °C to {r:g} °C": (f"plant {p}", float(cost))
        for p, start, r, cost in zip(
            asked.plant, asked.starts[asked.start, 0], references, result.costs, strict=True
        )
    }
    by_plant = [result.costs[asked.plant == p].mean() for p in np.unique(asked.plant)]
    # as the page asks: stable on every plant, and the margin of the one that a tenth of them lie below
    disk = float(np.quantile([margin.disk for margin in result.margins], 0.1, method="nearest"))
    guards = {
        "worst_case": float(np.max(by_plant)),
        "settled_error_degC": float(result.figures.settled_error.max()),
        "margin_short_of_least": max(rule.least_disk_margin - disk, 0.0),
        "unstable_plants": float(sum(not margin.stable for margin in result.margins)),
    }
    predictor = _predictor(folder, contestant, frozen.machine)
    error = _prediction_error(predictor, frozen.records)
    return CaseCosts(
        frozen.name, evidence, guards | ({"holdout_error_degC": error} if error is not None else {})
    )


def judged(frozen: FrozenPanel, folder: Path, name: str) -> evaluation.ControllerOutcome:
    """The contestant `name` whose files lie below `folder`, as it would be deployed: its own governor,
    today's limits. Raises NotComparable if it cannot be designed from them."""
    try:
        design, setting = _designed(frozen, folder, name)
    except ValueError as reason:
        raise NotComparable(str(reason)) from None
    # the gap to the optimum is for pages
    return evaluation.evaluate(name, design._replace(plain=None), setting)[1]


def _designed(frozen: FrozenPanel, folder: Path, name: str) -> tuple[Design, panel.CaseConditions]:
    machine, tracking, path = frozen.machine, frozen.tracking, folder / "tune_weights/weights.json"
    spread, pid = folder / "identify_plant/spread.parquet", folder / "ingest/printer_pid.json"
    models = read_models(
        folder / "identify_plant/plant.parquet",
        spread if spread.exists() else None,
        folder / "learn_kernel",
        pid if pid.exists() else None,
        machine,
    )
    setting = panel.conditions(
        frozen.tuning, machine, tracking, frozen.settings, frozen.rehearsal, models["family"]
    )
    stored = artifacts.read_json(path)
    tuned, tuned_for = stored.get("contestants", {}).get(name, {}), stored.get("design", {})
    values = {one.name: tuned.get(one.name) for one in table.BY_NAME[name].parameters}
    if None in values.values():
        raise ValueError(
            f"{path}: expected the tuned parameters of {name}, {', '.join(values)}, found "
            f"{', '.join(tuned) or 'none'}; let tune_weights tune it"
        )
    # what it was tuned for, not what it is judged by
    problem = panel.design_problem(models, tracking, setting, None)._replace(
        horizon=int(tuned_for.get("horizon_steps", frozen.settings.steps)),
        noise=np.array(tuned_for.get("noise_degC", frozen.rehearsal.noise), float),
    )
    design = table.BY_NAME[name].design(problem, values)
    if design is None:
        raise ValueError(f"{folder}: expected what {name} is designed from, found that its record has none")
    return design, setting


def identified(folder: Path) -> plant.Plant:
    """The plant that was identified with a controller whose files lie below `folder`."""
    return plant.restored(artifacts.read_arrays(folder / "identify_plant/plant.parquet", "plant", 1))[0]


def _predictor(folder: Path, name: str, machine: Machine) -> plant.Plant:
    """The model that a contestant predicts with: the window if it was learned from one."""
    if table.BY_NAME[name].learned_from not in ("window", "kernel", "trajectories"):
        return identified(folder)
    long = window.restored(artifacts.read_arrays(folder / "learn_kernel/window.parquet", "window", 1))
    return window.predictor(long, machine.sample_time_s)


def _holdout_records(h: HoldOut, machine: Machine) -> list[tuple[np.ndarray, np.ndarray]]:
    """The hold-out recordings as gapless segments. Raises ValueError if there is none that can be read."""
    if not Path(h.recordings).is_dir():
        raise ValueError(
            f"{h.recordings}: expected recordings that nothing is trained on, found none; "
            "put one of the machine as commissioned there"
        )
    records = read_records(Path(h.recordings), machine)
    return [pair for result in records.values() for pair in segments(result.record, machine)]


def measure_shares(settings: Nightly, paths: Sequence[str]) -> dict[str, dict[str, float]]:
    """How much of each of these recordings of the temperature loop is learned from: samples with every
    signal, in gapless stretches."""
    folders = [loop.recordings for loop in settings.loops.values() if loop.judge == "temperature"]
    own = [path for path in paths if folders and inputs.within(path, folders[0])]
    if not own or not _is_recorded():
        return {}
    machine = recorded(params.load(Machine, "plant"), "datasets/ingest/record.parquet")
    results = read_records(Path(folders[0]), machine, broken={})
    within = {path: path.removeprefix(f"{folders[0]}/") for path in own}
    return {path: _share(results[name], machine) for path, name in within.items() if name in results}


def _share(result: RecordingTable, machine: Machine) -> dict[str, float]:
    kinds, messages = result.quality["kind"], result.quality["message"]
    cut = [float(str(message).partition(" %")[0]) for message in messages[kinds == "cut"]]
    cut_percent = min(max(cut, default=0.0), 99.0)
    whole = len(result.record["time_s"]) / (1 - cut_percent / 100)
    used = sum(np.isfinite(y).all(axis=1).sum() for _, y in segments(result.record, machine))
    masked = np.mean([column for name, column in result.record.items() if name.endswith("_masked")])
    shares = {"used": 100 * used / whole, "masked": 100 * masked, "cut": cut_percent}
    return {f"{name}_percent": round(float(share), 1) for name, share in shares.items()}


def _is_recorded() -> bool:
    return params.value("generate_probing.source", one_of=("simulated", "recordings")) == "recordings"


def read_records(
    folder: Path, machine: Machine, broken: dict[str, str] | None = None
) -> dict[str, RecordingTable]:
    """{recording: what was read of it} below a folder, read as the stage `ingest` reads, through its memo;
    reasons of those that cannot be read go to `broken`. Raises ValueError for the first of them if there is
    none."""
    settings = params.load(Ingest, "ingest")
    results = recording_folders.read_folder(
        folder,
        recording_wish(settings, machine, settings.mapping),
        params.load(params.Execution, "execution"),
        memo=Path("datasets/memo/ingest"),
        budget=Budget(settings.longest_s, settings.largest_mb),
    )
    read = [result for result in results if not result.passed_over]
    reasons = {result.name: result.reason for result in read if result.reason}
    if reasons and broken is None:
        raise ValueError(next(iter(reasons.values())))
    (broken if broken is not None else {}).update(reasons)
    return {result.name: result for result in read if not result.reason}


def segments(
    record: dict[str, np.ndarray], machine: Machine, *, masked: bool = True
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Inputs (T, m) and outputs (T, p) of each gapless stretch; NaN if an output was not measured, or is
    masked, unless `masked` is false."""
    u, y = (
        np.stack(
            [np.where(record[f"{s.name}_masked"] & hide, np.nan, record[s.name]) for s in signals], axis=1
        ).astype(float)
        for signals, hide in ((machine.inputs, True), (machine.outputs, masked))
    )
    cuts = np.flatnonzero(np.diff(record["segment"])) + 1
    pairs = []
    for a, b in zip(np.split(u, cuts), np.split(y, cuts), strict=True):
        # inputs without gaps: what lies between two is a segment of its own
        edges = np.flatnonzero(np.diff(np.concatenate([[0], np.isfinite(a).all(axis=1).astype(int), [0]])))
        pairs += [(a[i:j], b[i:j]) for i, j in zip(edges[::2], edges[1::2], strict=True) if j - i >= 30]
    return pairs


def _panel_plants(
    folder: Path, records: list[tuple[np.ndarray, np.ndarray]], machine: Machine
) -> list[plant.Plant]:
    """The plants of the hold-out recordings: identified from them alone by the method of the stage
    `identify_plant`, and its spread around; kept, since neither changes from night to night."""
    settings = params.load(IdentifyPlant, "identify_plant")
    path = MEMO / f"{joblib.hash((records, settings.model_dump(), machine.model_dump()))}.parquet"
    if not path.exists():
        wish = recording_wish(params.load(Ingest, "ingest"), machine, params.load(Ingest, "ingest").mapping)
        columns, _, _ = recording_folders.join([*read_records(folder, machine).values()], wish, strict=False)
        schema, record = tables.record(machine.acting, machine.outputs), MEMO / "record.parquet"
        names = [column.name for column in schema.columns]
        artifacts.write_table(record, schema, {name: columns[name] for name in names})
        try:
            nominal, spread, _, _ = identify(settings, machine, str(record))
        except ValueError as error:
            why = str(error).removeprefix(f"{record}: ")
            raise ValueError(f"{folder}: the hold-out records do not determine the machine: {why}") from None
        plants = plant.padded([plant.strictly_proper(one) for one in (nominal, *spread)])
        artifacts.write_arrays(path, "holdout_plants", 1, plant.stored(plants))
    return plant.restored(artifacts.read_arrays(path, "holdout_plants", 1))


def _prediction_error(model, records: list[tuple[np.ndarray, np.ndarray]]) -> float | None:
    """Root mean square one-step error in °C on the hold-out recordings, None if there are none."""
    if not records:
        return None
    from pipeline.temperature.identification import validation

    errors = np.vstack(validation.one_step_errors(model, [u for u, _ in records], [y for _, y in records]))
    return float(np.sqrt(np.nanmean(errors**2)))
