"""The table of contestants: every controller of the temperature comparison, in the order of the pages.

A new controller is its own file in pipeline/temperature/, its line in CONTESTANTS, and its settings. The
stage designs from this table, and the pages take heading, mark and explanation from it. Methods are imported
where one is designed: a page loads none.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from pipeline.temperature.workflow.settings import EvaluateTemperature

if TYPE_CHECKING:
    from pipeline.temperature.kernel import Regression
    from pipeline.temperature.plant import Plant
    from pipeline.temperature.printer_pid import HeaterPid
    from pipeline.temperature.tracking import Controller
    from pipeline.temperature.window import Window


class Problem(NamedTuple):
    """What a controller may be designed from.

    `plant` is identified and `window` learned from the record. `kernel` is None where the record does not
    determine it, `truth` where nobody knows the plant, `printer_pid` empty where no recording tells the
    PID of a printer. `limits` low and high (m,) in percent; `gamma` the
    discount; `observer_tau` tuned, `exact_tau` for the true plant; `horizon` in steps.
    """

    plant: Plant
    window: Window
    kernel: Regression | None
    truth: Plant | None
    limits: tuple[np.ndarray, np.ndarray]
    gamma: float
    observer_tau: float
    exact_tau: float
    horizon: int
    settings: EvaluateTemperature
    printer_pid: tuple[HeaterPid, ...] = ()


def _model_based(problem: Problem) -> Controller:
    from pipeline.temperature import tracking

    return tracking.model_based(problem.plant, problem.gamma, tau=problem.observer_tau)


def _window(problem: Problem) -> Controller:
    from pipeline.temperature import window

    return window.controller(problem.window, problem.gamma)


def _kernel(problem: Problem) -> Controller | None:
    """Its feasible targets come from the window that was learned from the same record."""
    from pipeline.temperature import kernel, window

    if problem.kernel is None:
        return None
    return kernel.controller(problem.kernel, problem.gamma, window.predictor(problem.window))


def _baseline(problem: Problem) -> Controller:
    from pipeline.temperature import baseline

    return baseline.controller(problem.plant, problem.limits, horizon=problem.horizon)


def _printer_pid(problem: Problem) -> Controller | None:
    from pipeline.temperature import printer_pid

    if not problem.printer_pid:
        return None
    return printer_pid.controller(problem.printer_pid, problem.plant, problem.limits)


def _exact_model(problem: Problem) -> Controller | None:
    from pipeline.temperature import tracking

    if problem.truth is None:
        return None
    return tracking.exact_model(problem.truth, problem.gamma, tau=problem.exact_tau)


class Contestant(NamedTuple):
    """A controller of the comparison: how it is designed, and what the pages say of it.

    `heading` and `method` stand above its column, `explanation` among the words of the page, below `word`
    where the heading alone would say too little. `design` gives None where the record does not allow it, and
    raises ValueError where the machine does not: the page shows that sentence in its column. `learned_from`
    says whose need of samples is its own: the identified plant, the window, or the kernel.

    `role`: the verdict chooses among the three roles. Without a role a controller is shown, judged and can be
    the best of a row. A yardstick is shown beside the others and is never the best of a row. `mark` is the
    class of its mark; one without takes the next free shape.
    """

    name: str
    heading: str
    method: str
    explanation: str
    design: Callable[[Problem], Controller | None]
    learned_from: Literal["plant", "window", "kernel", ""]
    role: Literal["data_driven", "model_based", "baseline", "yardstick", ""] = ""
    word: str = ""
    mark: Literal["dd", "mb", "bl", ""] = ""
    hollow: bool = False


CONTESTANTS = (
    Contestant(
        "model_based",
        "Model-based",
        "model + Riccati",
        "A plant model is identified from the record; an observer estimates its state, "
        "and the Riccati equation gives the gains.",
        _model_based,
        "plant",
        role="model_based",
        mark="mb",
    ),
    # the data-driven route: the record alone ranks it before the kernel
    Contestant(
        "window",
        "Data-driven",
        "window + Riccati",
        "A long window of past inputs and outputs predicts the next output; the Riccati equation does the "
        "rest. No order, no state to choose.",
        _window,
        "window",
        role="data_driven",
        word="Data-driven, window",
        mark="dd",
    ),
    Contestant(
        "kernel",
        "Kernel",
        "Algorithm 2",
        "Algorithm 2 of the study: the value of state and action is fitted to the record directly, "
        "and the gain is read off it.",
        _kernel,
        "kernel",
        mark="dd",
        hollow=True,
    ),
    Contestant(
        "baseline",
        "Baseline",
        "PI per zone",
        "One PI controller a zone, tuned by SIMC from the identified model, with the same feasible target.",
        _baseline,
        "plant",
        role="baseline",
        mark="bl",
    ),
    # only where a recording is a Klipper log
    Contestant(
        "printer_pid",
        "Printer",
        "its own PID",
        "Klipper’s PID with the gains of the printer’s configuration, as its log has them, at our sample "
        "time. It is not tuned and aims at no target: it starts at the input of the hold, and its "
        "integral rests while the duty is at a limit.",
        _printer_pid,
        "",
        word="The printer’s own PID",
    ),
    Contestant(
        "exact_model",
        "Exact model",
        "told the truth",
        "The model-based controller, told the true plant: what a perfect identification would give.",
        _exact_model,
        "",
        role="yardstick",
        mark="mb",
        hollow=True,
    ),
)


class Designed(NamedTuple):
    """The controllers that the record and the machine allow, in the table's order, each by its name in the
    table; `refused` says by name why others cannot be designed."""

    controllers: list[Controller]
    refused: dict[str, str]


def controllers(problem: Problem, contestants: tuple[Contestant, ...] = CONTESTANTS) -> Designed:
    """Every contestant designed for `problem`. One whose design raises ValueError is refused with that
    reason, and the others go on."""
    designed, refused = [], {}
    for contestant in contestants:
        try:
            controller = contestant.design(problem)
        except ValueError as reason:
            refused[contestant.name] = str(reason)
            continue
        if controller is not None:
            designed.append(controller._replace(name=contestant.name))
    return Designed(designed, refused)
