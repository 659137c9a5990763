"""What the stages before left for tuning and judging: read once, checked, and made into the problem that
contestants are designed from."""

from pathlib import Path
from typing import Any, NamedTuple

from pipeline.store import artifacts
from pipeline.temperature import plant
from pipeline.temperature.controllers import kernel, window
from pipeline.temperature.controllers.printer_pid import HeaterPid
from pipeline.temperature.workflow import cases, contestants
from pipeline.temperature.workflow.cases import Setting
from pipeline.temperature.workflow.settings import Panel, Tracking, TuneWeights
from pipeline.temperature.workflow.settings import Plant as Machine


class Learned(NamedTuple):
    """What the stages before left: the identified plant, the window model, the kernel (None where the record
    did not determine it), the plant's spread, and the printer's own PIDs (none where no recording tells
    them)."""

    model: plant.Plant
    window: window.Window
    kernel: kernel.Regression | None
    spread: list[plant.Plant]
    printer_pid: tuple[HeaterPid, ...] = ()


def read_learned(
    model_path: str | Path,
    spread_path: str | Path | None,
    learned_folder: str | Path,
    printer_pid_path: str | Path | None,
    machine: Machine,
) -> Learned:
    """What the stages before wrote. `learned_folder` has a kernel only where the record determines one;
    without a path there is no spread, or no PID of a printer.

    Raises ValueError for a file of another machine than `machine`, as an earlier run leaves it."""
    window_path, kernel_path = (
        Path(learned_folder) / "window.parquet",
        Path(learned_folder) / "kernel.parquet",
    )
    m, p = len(machine.inputs), len(machine.outputs)
    plants = {"D": (None, p, m)}
    return Learned(
        plant.strictly_proper(
            plant.restored(artifacts.read_arrays(model_path, "plant", 1, shapes=plants))[0]
        ),
        window.restored(
            artifacts.read_arrays(window_path, "window", 1, shapes={"Theta": (p, None), "covariance": (p, p)})
        ),
        kernel.restored(artifacts.read_arrays(kernel_path, "kernel", 1))
        if artifacts.exists(kernel_path)
        else None,
        [
            plant.strictly_proper(one)
            for one in plant.restored(artifacts.read_arrays(spread_path, "spread", 1, shapes=plants))
        ]
        if spread_path
        else [],
        _heater_pids(artifacts.read_json(printer_pid_path).get("heaters", []), machine)
        if printer_pid_path
        else (),
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


class Posed(NamedTuple):
    """What contestants are tuned on, judged on, and designed from."""

    rehearsal: cases.Rehearsal
    setting: Setting
    problem: contestants.Problem


def posed(
    learned: Learned,
    machine: Machine,
    panel: Panel,
    tracking: Tracking,
    tuning: TuneWeights,
    record: str | Path,
    *,
    simulated: bool,
) -> Posed:
    """The same for tuning, judging and export. A simulated machine is the study's; otherwise cases follow
    from the record of ingest."""
    truth = plant.baam()._replace(sample_time_s=machine.sample_time_s) if simulated else None
    family = [learned.model, *learned.spread]
    rehearsal = cases.rehearsed(panel, machine, truth, family, str(record))
    setting = cases.shared(tuning, machine, tracking, panel, rehearsal, family)
    return Posed(rehearsal, setting, problem(learned, tracking, setting, truth))


def problem(
    learned: Learned, tracking: Tracking, setting: Setting, truth: plant.Plant | None
) -> contestants.Problem:
    """What contestants are designed from: the same for tuning and for judging, whatever the length of their
    cases."""
    return contestants.Problem(
        plant=learned.model,
        family=[learned.model, *learned.spread],
        window=learned.window,
        kernel=learned.kernel,
        truth=truth,
        limits=setting.limits,
        gamma=tracking.gamma,
        exact_tau=tracking.observer_tau,
        horizon=setting.rehearsal.judging.steps,
        noise=setting.rehearsal.noise,
        printer_pid=learned.printer_pid,
    )
