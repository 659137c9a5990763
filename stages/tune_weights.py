"""Tune every controller by itself, by Bayesian optimisation, as it would be deployed: reads what
identify_plant and learn_kernel wrote; writes datasets/tune_weights/weights.json and history.parquet. New
weights rerun no stage of data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import stages
from pipeline.store import artifacts, params
from pipeline.store.params import Execution
from pipeline.temperature import tables
from pipeline.temperature.settings import Panel, Plant, Tracking, TuneWeights, recorded

if TYPE_CHECKING:
    from pipeline.temperature.controllers.feed_forward import Told
    from pipeline.temperature.controllers.printer_pid import HeaterPid
    from pipeline.temperature.controllers.problem import DesignProblem
    from pipeline.temperature.test_set.panel import CaseConditions
    from pipeline.temperature.test_set.tuning import SearchResult

# what disturbances do, if some are measured
TOLD = "datasets/learn_kernel/feed_forward.parquet"


def read_models(
    plant_path: str | Path,
    spread_path: str | Path | None,
    learned_folder: str | Path,
    printer_pid_path: str | Path | None,
    machine: Plant,
) -> dict[str, Any]:
    """The plant, its family, what was learned and PIDs of a printer that controllers are designed from.
    `learned_folder` has kernel and trajectories only if the record determines them, and otherwise says why;
    without a path there is no spread, or no PID. Raises ValueError for a file of another machine than
    `machine`, as an earlier run leaves it."""
    from pipeline.temperature.controllers import kernel, predictive, window
    from pipeline.temperature.plant import restored, strictly_proper

    m, p = len(machine.inputs), len(machine.outputs)
    learned, square = Path(learned_folder), {"D": (None, p, m)}
    model = artifacts.read_arrays(plant_path, "plant", 1, shapes=square)
    spread = restored(artifacts.read_arrays(spread_path, "spread", 1, shapes=square)) if spread_path else []
    long = artifacts.read_arrays(
        learned / "window.parquet", "window", 1, shapes={"Theta": (p, None), "covariance": (p, p)}
    )
    direct = {
        name: restore(artifacts.read_arrays(learned / f"{name}.parquet", name, 1))
        for name, restore in (("kernel", kernel.restored), ("trajectories", predictive.restored))
        if artifacts.exists(learned / f"{name}.parquet")
    }
    figures = learned / "figures.json"
    family = [strictly_proper(one) for one in (restored(model)[0], *spread)]
    return {
        "plant": family[0],
        "family": family,
        "window": window.restored(long),
        "kernel": direct.get("kernel"),
        "trajectories": direct.get("trajectories"),
        "undetermined": artifacts.read_json(figures).get("undetermined", {})
        if artifacts.exists(figures)
        else {},
        "printer_pid": heater_pids(artifacts.read_json(printer_pid_path), machine)
        if printer_pid_path
        else (),
    }


def heater_pids(stored: Mapping[str, Any], machine: Plant) -> tuple[HeaterPid, ...]:
    """The PIDs of heaters whose duty is an input of the machine and whose temperature is an output."""
    from pipeline.temperature.controllers.printer_pid import HeaterPid

    inputs, outputs = [i.name for i in machine.inputs], [o.name for o in machine.outputs]
    return tuple(
        HeaterPid(
            inputs.index(pid["input"]),
            outputs.index(pid["output"]),
            *(pid[key] for key in ("Kp", "Ki", "Kd", "most_percent", "smooth_s")),
        )
        for pid in stored.get("heaters", [])
        if pid["input"] in inputs and pid["output"] in outputs
    )


def read_told() -> Told | None:
    """What measured disturbances do, as learn_kernel found it; None if it found nothing."""
    from pipeline.temperature.controllers import feed_forward

    if not artifacts.exists(TOLD):
        return None
    return feed_forward.restored(artifacts.read_arrays(TOLD, "feed_forward", 1))


def load_design_problem(
    machine: Plant, panel: Panel, tracking: Tracking, tuning: TuneWeights, *, simulated: bool
) -> tuple[CaseConditions, DesignProblem]:
    """What controllers are tuned and judged on, and what they are designed from. A simulated machine is the
    study's; otherwise cases follow from the record of ingest."""
    from pipeline.temperature.identification.segments import segments, without_gaps
    from pipeline.temperature.plant import baam
    from pipeline.temperature.test_set.panel import conditions, design_problem, from_declaration, from_record

    models = read_models(
        "datasets/identify_plant/plant.parquet",
        "datasets/identify_plant/spread.parquet",
        "datasets/learn_kernel",
        "datasets/ingest/printer_pid.json",
        machine,
    )
    truth, family, told = None, models["family"], read_told()
    if simulated:
        truth = baam()._replace(sample_time_s=machine.sample_time_s)
        rehearsal = from_declaration(panel, machine, truth, family)
    else:
        schema = tables.record(machine.acting, machine.outputs)
        record = artifacts.read_table("datasets/ingest/record.parquet", schema)
        u, y, recordings = segments(
            record, [s.name for s in machine.acting], [o.name for o in machine.outputs]
        )
        rehearsal = from_record(panel, machine, family, *without_gaps(u, y, recordings), told)
    setting = conditions(tuning, machine, tracking, panel, rehearsal, family, told)
    return setting, design_problem(models, tracking, setting, truth)


def search_all(
    settings: TuneWeights, problem: DesignProblem, setting: CaseConditions, execution: Execution
) -> tuple[dict[str, SearchResult], dict[str, str]]:
    """The best parameters of every controller that has some, and by name why others are refused: "" if the
    record does not allow the controller."""
    from joblib import delayed
    from tqdm import tqdm

    from pipeline.store.execution import run_all
    from pipeline.temperature.controllers.table import CONTROLLERS
    from pipeline.temperature.test_set.controller_search import search

    calls = [delayed(search)(one.name, settings, problem, setting) for one in CONTROLLERS if one.parameters]
    outcomes = dict(
        tqdm(run_all(calls, execution), total=len(calls), desc="tune_weights: controllers", mininterval=2)
    )
    refused = {name: outcome for name, outcome in outcomes.items() if isinstance(outcome, str)}
    results = {name: outcome for name, outcome in outcomes.items() if not isinstance(outcome, str)}
    if not results:
        raise ValueError(
            "tune_weights: expected a controller that can be designed, found none: "
            + "; ".join(f"{name}: {reason}" for name, reason in refused.items())
            + "; record the machine longer, or change its inputs in section plant of params.yaml"
        )
    return results, refused


def candidates(results: Mapping[str, SearchResult]) -> dict[str, Sequence]:
    """The candidates of all searches as columns, one row a candidate."""
    from pipeline.temperature.controllers.table import BY_NAME, parameters

    rows = []
    for name, result in results.items():
        history = result.history
        for k, theta in enumerate(history.theta):
            values = parameters(BY_NAME[name], theta)
            rows.append(
                {
                    "contestant": name,
                    "evaluation": k + 1,
                    "cost": history.cost[k],
                    "incumbent": history.incumbent[k],
                    "values": ", ".join(f"{key} {value:.4g}" for key, value in values.items()),
                    "chosen": bool((theta == result.theta).all()),
                    "failure": history.failed[k],
                }
            )
    return {column.name: [row[column.name] for row in rows] for column in tables.TUNING.columns}


# figures of control that git keeps and that runs are compared by
METRICS = ("contestants.*.cost*", "contestants.*.failed")


def main() -> None:
    with artifacts.stage("tune_weights") as out:
        from pipeline.temperature.test_set.controller_search import tuned_values

        settings = params.load(TuneWeights, "tune_weights")
        machine = recorded(params.load(Plant, "plant"), "datasets/ingest/record.parquet")
        tracking, panel = params.load(Tracking, "tracking"), params.load(Panel, "panel")
        simulated = params.value("generate_probing.source", one_of=("simulated", "recordings")) == "simulated"
        setting, problem = load_design_problem(machine, panel, tracking, settings, simulated=simulated)
        results, refused = search_all(settings, problem, setting, params.load(Execution, "execution"))
        tuned = {name: tuned_values(name, result, problem) for name, result in results.items()}
        design = {"horizon_steps": problem.horizon, "noise_degC": problem.noise.tolist()}
        artifacts.write_json(out / "weights.json", {"design": design, "contestants": tuned})
        history = candidates(results)
        artifacts.write_table(out / "history.parquet", tables.TUNING, history)
        artifacts.write_learning_curve(
            out / "live", history, of="contestant", step="evaluation", figures=("cost", "incumbent")
        )
        figures = {
            name: {key: value for key, value in values.items() if key not in ("q", "r")}
            for name, values in tuned.items()
        }
        reasons = {name: reason for name, reason in refused.items() if reason}
        artifacts.write_metrics("tune_weights", {"contestants": figures, "refused": reasons}, METRICS)


if __name__ == "__main__":
    stages.run(main, "tune_weights", loop="temperature")
