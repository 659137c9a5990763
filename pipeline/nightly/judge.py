"""A controller's files -> evidence: the temperature loop on a frozen panel of plants that nothing was learned
from; any loop from a file of costs by case."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import joblib
import numpy as np

from pipeline.deposition.workflow.tables import SCORES
from pipeline.nightly.decision import Evidence
from pipeline.nightly.settings import HoldOut, Loop, Nightly, Rule
from pipeline.setpoint.workflow import tables
from pipeline.store import artifacts, params
from pipeline.temperature.workflow import ingest
from pipeline.temperature.workflow.settings import Panel, Plant, Tracking

MEMO = Path(".beadline/panel")


class Judge(NamedTuple):
    """`measure(folder)`: the evidence on a controller whose files lie below it (datasets, or
    champion/<loop>); `allowed(champion)`: how much worse each guard may be."""

    measure: Callable[[Path], Evidence]
    allowed: Callable[[Evidence], dict[str, float]]


def judge(loop: Loop, settings: Nightly) -> Judge:
    if loop.judge == "cases":
        name = loop.cases.removeprefix("datasets/")
        return Judge(lambda folder: _cases(folder / name)[0], lambda _: _cases(Path(loop.cases))[1])
    percent = settings.rule.worst_case_percent / 100
    if loop.judge in ("deposition", "setpoint"):
        measure = {"deposition": _deposition, "setpoint": _setpoint}[loop.judge]
        return Judge(
            measure, lambda champion: {name: percent * value for name, value in champion.guards.items()}
        )
    return Judge(_temperature(settings), lambda champion: _allowed(champion, settings.rule))


def _cases(path: Path) -> tuple[Evidence, dict[str, float]]:
    """{"panel": name, "cases": {case: {"block": name, "cost": number}}, "guards":
    {guard: {"value": number, "allowed": number}}}."""
    declared = artifacts.read_json(path)
    try:
        cases = {
            name: (str(case["block"]), float(case["cost"]) if case["cost"] is not None else np.inf)
            for name, case in declared["cases"].items()
        }
        guards = {name: float(guard["value"]) for name, guard in declared["guards"].items()}
        return Evidence(str(declared["panel"]), cases, guards), {
            name: float(guard["allowed"]) for name, guard in declared["guards"].items()
        }
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path}: expected panel, cases with block and cost, and guards with value and allowed, "
            f"found no {error}; let its stage write them"
        ) from None


def _deposition(folder: Path) -> Evidence:
    """Of each part program and material, none of which was trained on: the error of the flow that the chosen
    composer leaves, as its stage scored it. Guard: the worst line."""
    table = artifacts.read_table(folder / "compose_parts/scores.parquet", SCORES)
    rows = [k for k, chosen in enumerate(table["chosen"]) if chosen]
    cases = {
        f"{table['part'][k]}, {table['material'][k]}": (
            f"{table['part'][k]}, {table['material'][k]}",
            max(float(table["rms_percent_of_on_off"][k]), 1e-3),
        )
        for k in rows
    }
    worst = np.nanmax([table["worst_line_volume_percent"][k] for k in rows], initial=0.0)
    return Evidence(joblib.hash(sorted(cases)), cases, {"worst_line_volume_percent": float(worst)})


def _setpoint(folder: Path) -> Evidence:
    """Of each case of each simulator that counts: the share of runs that the chosen controller does not
    settle, plus one point. Guards: the worst case, and the slowest."""
    table, chosen = (
        artifacts.read_table(folder / "evaluate_setpoint/scoreboard.parquet", tables.SCOREBOARD),
        artifacts.read_json(folder / "evaluate_setpoint/choice.json"),
    )
    rows = [k for k, name in enumerate(table["controller"]) if name == chosen["name"] and table["counts"][k]]
    lost = {
        f"{table['simulator'][k]}: {table['case'][k]}": 101.0 - float(table["settled_percent"][k])
        for k in rows
    }
    slow = np.nanmax([table["p90_steps"][k] for k in rows], initial=0.0)
    return Evidence(
        joblib.hash(sorted(lost)),
        {name: (name, cost) for name, cost in lost.items()},
        {"worst_unsettled_percent": max(lost.values()), "slowest_p90_steps": float(slow)},
    )


# ---- the temperature loop


def _allowed(champion: Evidence, rule: Rule) -> dict[str, float]:
    holdout = champion.guards.get("holdout_error_degC", 0.0)
    return {
        "worst_case": champion.guards["worst_case"] * rule.worst_case_percent / 100,
        "settled_error_degC": rule.settled_error_degC,
        "holdout_error_degC": holdout * rule.holdout_error_percent / 100,
    }


class FrozenPanel(NamedTuple):
    """What every controller of the temperature loop is judged on, night after night; `name` is the hash of
    all that it was made from."""

    name: str
    machine: Plant
    tracking: Tracking
    band_degC: float
    plants: list
    scenarios: Any
    allowance: Any
    records: list[tuple[np.ndarray, np.ndarray]]

    @property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        low, high = np.array([(i.low, i.high) for i in self.machine.inputs]).T
        return low, high


def _temperature(settings: Nightly) -> Callable[[Path], Evidence]:
    """Closed loop on every plant of the frozen panel, from starts and to references of section
    `nightly.holdout`, with its seeds; prediction on the hold-out recordings."""
    panel = _frozen_panel(settings.holdout)
    return lambda folder: _closed_loop(panel, folder, settings)


def _frozen_panel(holdout: HoldOut) -> FrozenPanel:
    from pipeline.temperature import plant, scorecard

    machine, tracking = params.load(Plant, "plant"), params.load(Tracking, "tracking")
    panel, weights = params.load(Panel, "panel"), params.read()["tune_weights"]
    allowance = scorecard.Allowance(
        *(float(weights[f"allow_{name}"]) for name in scorecard.Allowance._fields[:-1]), 0.0
    )
    simulated = params.value("generate_probing.source", one_of=("simulated", "recordings")) == "simulated"
    records = [] if simulated else _holdout_records(holdout, machine)
    if simulated:
        plants = plant.spread(
            plant.baam()._replace(sample_time_s=machine.sample_time_s),
            input_gain=panel.input_gain,
            extra_heat_loss=panel.extra_heat_loss_per_step,
        )
        # between the declared plants: the panel that the stages judge on has the ends
        plants = plant.spread(
            plants[0], input_gain=0.6 * panel.input_gain, extra_heat_loss=0.6 * panel.extra_heat_loss_per_step
        )
    else:
        plants = _panel_plants(records, machine)
    reference = np.array([output.reference for output in machine.outputs])
    scenarios = scorecard.panel(
        plants, starts=holdout.starts_degC,
        references=[reference + offset for offset in holdout.reference_offsets_degC],
        noise=[holdout.noise_degC], seeds=holdout.seeds,
        steps=holdout.steps, hold=panel.hold_steps, cells=simulated,
    )  # fmt: skip
    name = joblib.hash(
        (
            holdout.model_dump(),
            [tuple(map(np.asarray, matrices)) for matrices in plants],
            machine.model_dump(),
            tracking.model_dump(),
            panel.model_dump(),
            tuple(allowance),
        )
    )
    return FrozenPanel(name, machine, tracking, panel.band_degC, plants, scenarios, allowance, records)


def _closed_loop(panel: FrozenPanel, folder: Path, settings: Nightly) -> Evidence:
    from pipeline.temperature import judging, scorecard

    scenarios, limits, tracking = panel.scenarios, panel.limits, panel.tracking
    made, predictor, weight = controller(folder, settings.holdout.controller, tracking.gamma)
    law = made.design(weight["q"], weight["r"], tracking.integral)
    aims = judging.targets(made.model, scenarios.r, limits)
    rollout = scorecard.simulate(
        scenarios,
        law,
        scorecard.feed_forward(scenarios, law, aims),
        limits=limits,
        integral_band=tracking.integral_limit_degC,
    )
    figures = scorecard.figures(
        scenarios, rollout, limits=limits, band=panel.band_degC, sample_time_s=panel.machine.sample_time_s
    )
    costs = _costs(panel, figures)
    cases = {
        f"plant {p}, {start:g} °C to {r:g} °C, seed {seed}": (f"plant {p}", float(cost))
        for p, start, r, seed, cost in zip(
            scenarios.plant, scenarios.start, scenarios.r[:, 0], scenarios.seed, costs, strict=True
        )
    }
    by_plant = [np.mean(np.array(costs)[scenarios.plant == p]) for p in np.unique(scenarios.plant)]
    margins = scorecard.margins(panel.plants, law, grid=80)
    smallest = min(margin.disk for margin in margins)
    guards = {
        "worst_case": float(np.max(by_plant)),
        "settled_error_degC": float(figures.settled_error_degC.max()),
        "margin_short_of_least": max(settings.rule.least_disk_margin - smallest, 0.0),
        "unstable_plants": float(sum(not margin.stable for margin in margins)),
    }
    error = _prediction_error(predictor, panel.records)
    return Evidence(panel.name, cases, guards | ({"holdout_error_degC": error} if error is not None else {}))


def _costs(panel: FrozenPanel, figures: Any) -> list[float]:
    """The engineering cost of each case; infinite where it fails."""
    from pipeline.temperature import scorecard

    costs, longest_s = [], panel.scenarios.steps * panel.machine.sample_time_s
    for i in range(len(panel.scenarios.plant)):
        of_case = type(figures)(*(figure[i : i + 1] for figure in figures))
        plant_of_case = panel.scenarios.plant[i : i + 1]
        try:
            costs.append(
                scorecard.engineering_cost(of_case, plant_of_case, panel.allowance, longest_s=longest_s)
            )
        except ValueError:
            costs.append(np.inf)
    return costs


def controller(folder: Path, which: str, gamma: float):
    """The controller whose files lie below `folder`, the model that it predicts with, and its weights."""
    from pipeline.temperature import plant, tracking, window

    weights = {
        name: np.array(value)
        for name, value in artifacts.read_json(folder / "tune_weights/weights.json")["practical"].items()
    }
    model = plant.restored(artifacts.read_arrays(folder / "identify_plant/plant.parquet", "plant", 1))[0]
    if which == "model_based":
        return tracking.model_based(model, gamma, tau=float(weights["observer_tau"])), model, weights
    long = window.restored(artifacts.read_arrays(folder / "learn_kernel/window.parquet", "window", 1))
    return window.controller(long, gamma), window.predictor(long, model.sample_time_s), weights


def _holdout_records(h: HoldOut, machine: Plant) -> list[tuple[np.ndarray, np.ndarray]]:
    """The hold-out recordings as gapless segments. Raises ValueError where there is none that can be read."""
    if not Path(h.recordings).is_dir():
        raise ValueError(
            f"{h.recordings}: expected recordings that nothing is trained on, found none; "
            "put one of the machine as commissioned there"
        )
    segments = record_segments(Path(h.recordings), machine)
    return [pair for pairs in segments.values() for pair in pairs]


def record_segments(
    folder: Path, machine: Plant, *, broken: dict[str, str] | None = None
) -> dict[str, list[tuple[np.ndarray, np.ndarray]]]:
    """{recording: [(u, y), ...]} below a folder, read as the stage `ingest` reads, through its memo; reasons
    of those that cannot be read go to `broken`."""
    declared: dict[str, Any] = params.read()["ingest"]
    mapping = {
        name: (m["source"], m["unit"], float(m["scale"]), float(m["offset"]))
        for name, m in declared["mapping"].items()
    }
    spec = ingest.IngestSpec(
        machine, mapping, declared["time"], float(declared["max_gap_s"]), declared["decimal"]
    )
    results = ingest.process(
        folder,
        spec,
        params.load(params.Execution, "execution"),
        memo=Path("datasets/memo/ingest"),
        budget=ingest.Budget(float(declared["longest_s"]), float(declared["largest_mb"])),
    )
    segments = {}
    for result in results:
        if result.reason:
            if broken is None:
                raise ValueError(result.reason)
            broken[result.name] = result.reason
            continue
        segments[result.name] = _segments(result.record, machine)
    return segments


def _segments(record: dict[str, np.ndarray], machine: Plant) -> list[tuple[np.ndarray, np.ndarray]]:
    u, y = (
        np.stack(
            [np.where(record[f"{s.name}_masked"], np.nan, record[s.name]) for s in signals], axis=1
        ).astype(float)
        for signals in (machine.inputs, machine.outputs)
    )
    cuts = np.flatnonzero(np.diff(record["segment"])) + 1
    pairs = []
    for a, b in zip(np.split(u, cuts), np.split(y, cuts), strict=True):
        # inputs without gaps: what lies between two is a segment of its own
        edges = np.flatnonzero(np.diff(np.concatenate([[0], np.isfinite(a).all(axis=1).astype(int), [0]])))
        pairs += [(a[i:j], b[i:j]) for i, j in zip(edges[::2], edges[1::2], strict=True) if j - i >= 30]
    return pairs


def _panel_plants(records: list[tuple[np.ndarray, np.ndarray]], machine: Plant):
    """The plants of the hold-out recordings: identified from them alone, and a bootstrap family around; kept,
    since neither recordings nor method change from night to night."""
    from pipeline.temperature import identification, plant, validation

    p = params.read()["identify_plant"]
    key = joblib.hash((records, p["max_order"], p["offset"], p["spread_plants"], p["seed"]))
    path = MEMO / f"{key}.parquet"
    if path.exists():
        return plant.restored(artifacts.read_arrays(path, "holdout_plants", 1))
    u, y = [a for a, _ in records], [b for _, b in records]
    names = [i.name for i in machine.inputs]
    u, _ = identification.within_limits(
        u, tuple(zip(*((i.low, i.high) for i in machine.inputs), strict=True)), names=names
    )
    settings = identification.Settings(offset=p["offset"], max_order=p["max_order"])
    fit = identification.identify(u, y, sample_time_s=machine.sample_time_s, settings=settings, names=names)
    family = validation.bootstrap_spread(
        u, y, fit, count=p["spread_plants"], order=fit.order, rng=np.random.default_rng(p["seed"])
    )
    plants = [plant.strictly_proper(one) for one in (fit.plant, *family)]
    artifacts.write_arrays(path, "holdout_plants", 1, plant.stored(plants))
    return plant.restored(artifacts.read_arrays(path, "holdout_plants", 1))


def _prediction_error(model, records: list[tuple[np.ndarray, np.ndarray]]) -> float | None:
    """Root mean square one-step error in °C on the hold-out recordings, None where there are none."""
    if not records:
        return None
    from pipeline.temperature import validation

    errors = np.vstack(validation.one_step_errors(model, [u for u, _ in records], [y for _, y in records]))
    return float(np.sqrt(np.nanmean(errors**2)))
