"""What evaluate_temperature does: every temperature controller judged on one panel of plants, starts,
references and noise."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from pipeline.store import artifacts
from pipeline.store.tables import Schema
from pipeline.temperature import judging, kernel, plant, scorecard, window
from pipeline.temperature.printer_pid import HeaterPid
from pipeline.temperature.workflow import contestants, tables
from pipeline.temperature.workflow.settings import EvaluateTemperature, Panel, Tracking
from pipeline.temperature.workflow.settings import Plant as Machine


class Learned(NamedTuple):
    """What the stages before left: the identified plant, the window model, the kernel (None where the record
    did not determine it), the tuned weights, the plant's spread, and the printer's own PIDs (none where no
    recording tells them)."""

    model: plant.Plant
    window: window.Window
    kernel: kernel.Regression | None
    weights: dict[str, np.ndarray]
    spread: list[plant.Plant]
    printer_pid: tuple[HeaterPid, ...] = ()


class Judged(NamedTuple):
    """Every controller on the panel: rows of the scorecard, one featured scenario as (schema, columns),
    figures by controller, and why others were refused.

    `without_feed_forward`: those that aim at the feasible target in the unclipped run too. `own_integral`:
    the share a step, the largest of the outputs', of those whose integral action is not the one declared for
    all.
    """

    scorecard: dict[str, Any]
    trajectories: tuple[Schema, dict[str, Any]]
    summary: dict[str, Any]
    refused: dict[str, str]
    without_feed_forward: list[str]
    own_integral: dict[str, float]


def check(settings: EvaluateTemperature, panel: Panel) -> None:
    """Raises ValueError where the noise of the report is none of the panel's."""
    if settings.report_noise_degC not in panel.noise_degC:
        raise ValueError(
            "params.expert.yaml: evaluate_temperature.report_noise_degC is "
            f"{settings.report_noise_degC:g} but must "
            "be one of panel.noise_degC "
            f"{panel.noise_degC}; "
            "change one of the two"
        )


def read_learned(
    model_path: str,
    spread_path: str,
    weights_path: str,
    learned_folder: str | Path,
    printer_pid_path: str,
    machine: Machine,
) -> Learned:
    """What the stages before wrote. `learned_folder` has a kernel only where the record determines one.

    Raises ValueError for a file of another machine than `machine`, as an earlier run leaves it."""
    window_path, kernel_path = (
        Path(learned_folder) / "window.parquet",
        Path(learned_folder) / "kernel.parquet",
    )
    m, p = len(machine.inputs), len(machine.outputs)
    plants = {"D": (None, p, m)}
    weights = artifacts.read_json(weights_path)["practical"]
    for key, count, what in (("q", p, "outputs"), ("r", m, "inputs")):
        if len(weights[key]) != count:
            raise ValueError(
                f"{weights_path}: practical.{key} has {len(weights[key])} weights but the machine in "
                f"params.yaml has {count} {what}, so that the file is of another machine or another run; "
                f"{artifacts.remedy(weights_path)}"
            )
    return Learned(
        plant.restored(artifacts.read_arrays(model_path, "plant", 1, shapes=plants))[0],
        window.restored(
            artifacts.read_arrays(window_path, "window", 1, shapes={"Theta": (p, None), "covariance": (p, p)})
        ),
        kernel.restored(artifacts.read_arrays(kernel_path, "kernel", 1))
        if artifacts.exists(kernel_path)
        else None,
        {name: np.array(w) for name, w in weights.items()},
        [
            plant.strictly_proper(one)
            for one in plant.restored(artifacts.read_arrays(spread_path, "spread", 1, shapes=plants))
        ],
        _heater_pids(artifacts.read_json(printer_pid_path).get("heaters", []), machine),
    )


def _heater_pids(pids: list[dict[str, Any]], machine: Machine) -> tuple[HeaterPid, ...]:
    """Those of heaters whose duty is an input of the machine and whose temperature an output."""
    inputs, outputs = [i.name for i in machine.inputs], [o.name for o in machine.outputs]
    return tuple(
        HeaterPid(
            inputs.index(pid["input"]),
            outputs.index(pid["output"]),
            *(pid[key] for key in ("Kp", "Ki", "Kd", "most_percent", "smooth_s")),
        )
        for pid in pids
        if pid["input"] in inputs and pid["output"] in outputs
    )


def judged(
    settings: EvaluateTemperature,
    machine: Machine,
    tracking: Tracking,
    panel: Panel,
    learned: Learned,
    *,
    simulated: bool,
) -> Judged:
    """The controllers on the judging half of the panel: at the yardstick's weights
    unclipped, and at the tuned weights as deployed."""
    inputs, outputs = [i.name for i in machine.inputs], [o.name for o in machine.outputs]
    limits = tuple(np.array([(i.low, i.high) for i in machine.inputs]).T)
    yardstick = scorecard.Yardstick(
        np.full(len(outputs), tracking.yardstick_q),
        np.full(len(inputs), tracking.yardstick_r),
        tracking.gamma,
    )
    truth = plant.baam()._replace(sample_time_s=machine.sample_time_s) if simulated else None
    scenarios = _scenarios(machine, panel, learned, truth)
    q, r = learned.weights["q"], learned.weights["r"]
    problem = contestants.Problem(
        plant=learned.model,
        window=learned.window,
        kernel=learned.kernel,
        truth=truth,
        limits=limits,
        gamma=tracking.gamma,
        observer_tau=float(learned.weights["observer_tau"]),
        exact_tau=tracking.observer_tau,
        horizon=panel.steps,
        settings=settings,
        printer_pid=learned.printer_pid,
    )
    designed, refused = _designed(problem, [(yardstick.q, yardstick.r, 0.0), (q, r, tracking.integral)])
    deployment = judging.Deployment(limits, panel.band_degC, tracking.integral, tracking.integral_limit_degC)
    results = [
        judging.judge(controller, scenarios, yardstick=yardstick, q=q, r=r, deployment=deployment)
        for controller in tqdm(designed, desc="evaluate_temperature: controllers", mininterval=2)
    ]
    summary = {
        "noise_degC": settings.report_noise_degC,
        "scenarios": len(scenarios.r),
        "plants": len(scenarios.plants),
        "controllers": {
            result.name: judging.summary(result, scenarios, noise=settings.report_noise_degC)
            for result in results
        },
    }
    shown = judging.trajectories(
        results, scenarios, inputs, outputs, noise=settings.report_noise_degC, yardstick=yardstick
    )
    return Judged(
        judging.rows(results, scenarios, outputs),
        (tables.trajectories(machine.inputs, machine.outputs), shown),
        summary,
        refused,
        without_feed_forward=[made.name for made in designed if not made.own_feed_forward],
        own_integral=_own_integral(results, tracking.integral),
    )


def _own_integral(results: list[judging.Judged], declared: float) -> dict[str, float]:
    shares = {result.name: float(np.max(result.law.integral)) for result in results}
    return {name: share for name, share in shares.items() if share != declared}


def _designed(
    problem: contestants.Problem, designs: list[tuple[np.ndarray, np.ndarray, float]]
) -> contestants.Designed:
    """The controllers that have a law for each (q, r, integral). Raises ValueError where there is none."""
    made = contestants.controllers(problem)
    refused = made.refused | judging.refusals(made.controllers, designs)
    designed = [controller for controller in made.controllers if controller.name not in refused]
    if not designed:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in refused.items())
        raise ValueError(
            "evaluate_temperature: expected a controller that can be designed, "
            f"found none: {reasons}; record the machine longer, "
            "or change its inputs in section plant of params.yaml"
        )
    return contestants.Designed(designed, refused)


def _scenarios(
    machine: Machine, panel: Panel, learned: Learned, truth: plant.Plant | None
) -> scorecard.Panel:
    """The judging half of the panel: around the true plant where it is known, else the identified spread."""
    plants = learned.spread
    if truth is not None:
        plants = plant.spread(
            truth, input_gain=panel.input_gain, extra_heat_loss=panel.extra_heat_loss_per_step
        )
    reference = np.array([o.reference for o in machine.outputs])
    return scorecard.panel(
        plants,
        starts=panel.judging.starts_degC,
        references=[reference + offset for offset in panel.judging.reference_offsets_degC],
        noise=panel.noise_degC,
        seeds=panel.judging.seeds,
        steps=panel.steps,
        hold=panel.hold_steps,
        cells=truth is not None,
    )
