"""The table of controllers: every controller of the temperature comparison, the simplest first.

A new controller is its own file in this folder and a row in CONTROLLERS. Tuning, evaluation and certificate
design controllers from this table; pages take heading, mark, kind and explanation from it. The module of a
method is imported only when it is designed, so a page imports none.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from pipeline.temperature.controllers.problem import Design, DesignProblem

Values = Mapping[str, float]


class TuningParameter(NamedTuple):
    """A parameter that a search may set between low and high, beginning at `start`. With `of_effect` all
    three are multiplied by the problem's effect."""

    name: str
    low: float
    start: float
    high: float
    of_effect: bool = False


EFFORT = TuningParameter("effort_weight", 0.3, 5.0, 3e3, of_effect=True)
OBSERVER = TuningParameter("observer_tau", 0.01, 1.0, 100.0, of_effect=True)
INTEGRAL = TuningParameter("integral", 0.004, 0.04, 0.4)


class TemperatureController(NamedTuple):
    """A controller of the comparison: how it is designed, and its description on the pages.

    `heading` and `method` stand above its column, and `explanation` in the page's list of terms, under `word`
    if the heading alone says too little. `design` returns None if the record does not allow the controller.
    It raises ValueError if the machine does not; the page shows the message in its column. `parameters` are
    those that its search may set; without any there is no search. `learned_from` names the model whose
    required number of samples applies: the identified plant, the window, the kernel, or the trajectories.

    `kind` is declared here and never guessed from a name: model-based (a model is identified and then
    inverted or optimised), data-driven (the law is learned from the record without such a model), baseline,
    or reference. A reference is shown beside the others and is never the best. `mark` is the class of its
    mark in charts; a controller without one gets the next free shape.
    """

    name: str
    heading: str
    method: str
    explanation: str
    design: Callable[[DesignProblem, Values], Design | None]
    kind: Literal["model-based", "data-driven", "baseline", "reference"]
    parameters: tuple[TuningParameter, ...] = ()
    learned_from: Literal["plant", "window", "kernel", "trajectories", ""] = ""
    word: str = ""
    mark: Literal["dd", "mb", "bl", ""] = ""
    hollow: bool = False


def in_file(file: str, function: str = "design") -> Callable[[DesignProblem, Values], Design | None]:
    """Returns a function of a file in pipeline/temperature/controllers, which is imported when it first
    designs."""
    return functools.partial(_design, f"pipeline.temperature.controllers.{file}", function)


def _design(module: str, function: str, problem: DesignProblem, values: Values) -> Design | None:
    return getattr(importlib.import_module(module), function)(problem, values)


CONTROLLERS = (
    TemperatureController(
        "hold",
        "Hold",
        "do nothing",
        "The inputs stay as they were handed over.",
        in_file("designs", "hold"),
        "baseline",
    ),
    # only if a recording is a Klipper log
    TemperatureController(
        "printer_pid",
        "Printer",
        "its own PID",
        "Klipper’s PID with the gains of the printer’s configuration, as its log has them, at our sample "
        "time. It is not tuned and aims at no target: it starts at the input of the hold, and its "
        "integral rests while the duty is at a limit.",
        in_file("designs", "printer_pid"),
        "baseline",
        word="The printer’s own PID",
    ),
    TemperatureController(
        "pi_simc",
        "PI, SIMC",
        "PI per zone",
        "One PI controller a zone by SIMC’s rule from the identified model, with the same steady input, "
        "limits, governor and hand-over as the others.",
        in_file("designs", "pi"),
        "baseline",
        learned_from="plant",
        mark="bl",
    ),
    TemperatureController(
        "pi",
        "PI, tuned",
        "PI per zone",
        "The same, its gains and reset times tuned by the same search as the others, which keeps the least "
        "margins of tune_weights; SIMC’s rule need not, so that it may be the cheaper one.",
        in_file("designs", "pi"),
        "baseline",
        (TuningParameter("gain_factor", 0.02, 1.0, 10.0), TuningParameter("reset_factor", 0.1, 1.0, 20.0)),
        learned_from="plant",
        mark="bl",
        hollow=True,
    ),
    TemperatureController(
        "subspace_lqg",
        "subspace + LQG",
        "model-based",
        "A plant model is identified from the record; an observer estimates its state, "
        "and the Riccati equation gives the gains.",
        in_file("designs", "subspace_lqg"),
        "model-based",
        (EFFORT, OBSERVER, INTEGRAL),
        learned_from="plant",
        word="subspace + LQG, model-based",
        mark="mb",
    ),
    TemperatureController(
        "varx_riccati",
        "VARX + Riccati",
        "model-based, least squares",
        "A long window of past inputs and outputs predicts the next output; the Riccati equation does the "
        "rest. No order, no state to choose.",
        in_file("designs", "varx_riccati"),
        "model-based",
        (EFFORT, INTEGRAL),
        learned_from="window",
        word="VARX + Riccati, model-based by least squares",
        mark="mb",
        hollow=True,
    ),
    TemperatureController(
        "learned_kernel",
        "learned kernel",
        "data-driven, Algorithm 2",
        "Algorithm 2 of the study: the value of state and action is fitted to the record directly, "
        "and the gain is read off it. Its state is what the window predicts.",
        in_file("designs", "learned_kernel"),
        "data-driven",
        (EFFORT, INTEGRAL),
        learned_from="kernel",
        word="learned kernel, Algorithm 2, data-driven and direct",
        mark="dd",
    ),
    TemperatureController(
        "predictive_control",
        "predictive control",
        "data-driven, DeePC",
        "Data-enabled predictive control: coming inputs and outputs are weighted sums of stretches of the "
        "record, and the weights are those of least cost. What the sums leave unexplained counts as zero, so "
        "that it is a least-squares predictor of many steps with a horizon.",
        in_file("designs", "predictive_control"),
        "data-driven",
        (EFFORT, INTEGRAL),
        learned_from="trajectories",
        word="predictive control (DeePC), data-driven and direct",
        mark="dd",
        hollow=True,
    ),
    TemperatureController(
        "exact_model",
        "Exact model",
        "told the truth",
        "The model-based controller, told the true plant. The plants that it is judged on differ from that "
        "one too, so that it is a yardstick and no bound: another may be cheaper.",
        in_file("designs", "exact_model"),
        "reference",
        (EFFORT, OBSERVER, INTEGRAL),
    ),
)
BY_NAME = {controller.name: controller for controller in CONTROLLERS}
UNTUNED = "it could not be tuned: no candidate of its search kept the least margins of tune_weights"


def bounds(
    controller: TemperatureController, problem: DesignProblem
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the lowest, start and highest value of each parameter (d,)."""
    scale = [problem.effect if one.of_effect else 1.0 for one in controller.parameters]
    table = np.array([(one.low, one.start, one.high) for one in controller.parameters]).T * scale
    return table[0], table[1], table[2]


def parameters(controller: TemperatureController, theta: Iterable[float]) -> dict[str, float]:
    """Returns the values theta (d,) by the names of the controller's parameters."""
    return dict(zip([one.name for one in controller.parameters], theta, strict=True))


def answering_pair(standing: Iterable[str], tuned_costs: Mapping[str, float]) -> tuple[str, str]:
    """Returns the model-based and the data-driven controller that answer "model-based or data-driven?". Of
    each kind it takes the one of `standing` with the lowest cost in its search on the training plants. So the
    plants that compare the two do not influence which two are compared. If no data-driven one is in
    `standing`, the second model-based one takes its place. A kind with none in `standing` is represented by
    its first row."""
    standing = set(standing)

    def ranked(kind: str) -> list[str]:
        names = [one.name for one in CONTROLLERS if one.kind == kind]
        able = [name for name in names if name in standing]
        return sorted(able, key=lambda name: tuned_costs.get(name, np.inf)) or names[:1]

    model_based, data_driven = ranked("model-based"), ranked("data-driven")
    if data_driven[0] not in standing and len(model_based) > 1:
        return model_based[0], model_based[1]
    return model_based[0], data_driven[0]


def design_controllers(
    problem: DesignProblem, tuned: Mapping[str, Mapping[str, Any]]
) -> tuple[dict[str, Design], dict[str, str]]:
    """Returns every controller that the record and the machine allow, at its tuned parameters, and the
    reasons for refusing others, by name. Raises ValueError if only "hold" is left."""
    designs, refused = {}, {}
    for controller in CONTROLLERS:
        values: dict[str, Any] = {
            one.name: tuned.get(controller.name, {}).get(one.name) for one in controller.parameters
        }
        untuned = None in values.values()
        if untuned:
            values = parameters(controller, bounds(controller, problem)[1])
        try:
            design = controller.design(problem, values)
        except ValueError as reason:
            refused[controller.name] = str(reason)
            continue
        if design is None:
            continue
        if untuned:
            refused[controller.name] = UNTUNED
        else:
            designs[controller.name] = design
    if set(designs) <= {"hold"}:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in refused.items())
        raise ValueError(
            f"expected a controller that can be designed, found none: {reasons}; record the machine longer, "
            "or change its inputs in section plant of params.yaml"
        )
    return designs, refused
