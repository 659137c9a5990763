"""The table of contestants: every controller of the temperature comparison, the simplest first.

A new contestant is its own file in pipeline/temperature/, its line in CONTESTANTS, and its settings. Tuning
and judging design from this table, and the pages take heading, mark and explanation from it. Methods are
imported where one is designed: a page loads none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from pipeline.temperature.controllers.governor import Limits
    from pipeline.temperature.controllers.kernel import Regression
    from pipeline.temperature.controllers.printer_pid import HeaterPid
    from pipeline.temperature.controllers.window import Window
    from pipeline.temperature.plant import Plant
    from pipeline.temperature.tracking import Law


class Problem(NamedTuple):
    """What a controller may be designed from.

    `plant` is identified, its feed-through a delay, `family` its spread, and `window` learned from the
    record. `kernel` is None where the record does not determine it, `truth` where nobody knows the plant,
    `printer_pid` empty where no recording tells the PID of a printer. `gamma` is the discount, `exact_tau`
    the paper's observer, `horizon` in steps, `noise` (p,) in °C."""

    plant: Plant
    family: list[Plant]
    window: Window
    kernel: Regression | None
    truth: Plant | None
    limits: Limits
    gamma: float
    exact_tau: float
    horizon: int
    noise: np.ndarray
    printer_pid: tuple[HeaterPid, ...] = ()

    @property
    def effect(self) -> float:
        """°C^2 per percent^2 by which the strongest input of the median output moves it in a step: the scale
        of an effort weight."""
        from pipeline.temperature.plant import markov_parameters

        strongest = np.abs(markov_parameters(self.plant, min(self.horizon, 50))).max(axis=(0, 2))
        return float(max(np.median(strongest), 1e-6)) ** 2


class Design(NamedTuple):
    """A contestant's law, and the plant on which its steady inputs are computed. `plain` designs the same
    without integrator at the weights of the yardstick, and is None where weights mean nothing to it.
    `governed`: the governor watches it. `holds`: it does nothing."""

    law: Law
    model: Plant
    plain: Callable[[], Law] | None = None
    governed: bool = True
    holds: bool = False


class Parameter(NamedTuple):
    """What a search may set, between low and high, from the declared start; times the problem's effect where
    `of_effect`."""

    name: str
    low: float
    start: float
    high: float
    of_effect: bool = False


EFFORT = Parameter("effort_weight", 0.3, 5.0, 3e3, of_effect=True)
OBSERVER = Parameter("observer_tau", 0.01, 1.0, 100.0, of_effect=True)
INTEGRAL = Parameter("integral", 0.004, 0.04, 0.4)
Values = Mapping[str, float]


def weights(problem: Problem, values: Values) -> tuple[np.ndarray, np.ndarray]:
    """diag(Q) = 1 and diag(R) = effort_weight: only their ratio acts."""
    return np.ones(problem.plant.p), np.full(problem.plant.m, values["effort_weight"])


def _unit(problem: Problem) -> tuple[np.ndarray, np.ndarray, float]:
    return np.ones(problem.plant.p), np.ones(problem.plant.m), 0.0


def _hold(problem: Problem, values: Values) -> Design:
    from pipeline.temperature.tracking import still_law

    return Design(still_law(problem.plant.m, problem.plant.p), problem.plant, governed=False, holds=True)


def _printer_pid(problem: Problem, values: Values) -> Design | None:
    from pipeline.temperature.controllers import printer_pid

    if not problem.printer_pid:
        return None
    limits = problem.limits.low, problem.limits.high
    made = printer_pid.controller(problem.printer_pid, problem.plant, limits)
    return Design(made.design(*_unit(problem)), made.model, governed=False)


def _pi(problem: Problem, values: Values) -> Design:
    from pipeline.temperature.controllers import baseline

    made = baseline.controller(
        problem.plant,
        (problem.limits.low, problem.limits.high),
        horizon=problem.horizon,
        family=problem.family,
        noise_degC=problem.noise,
        tuning=baseline.Tuning(**values),
    )
    return Design(made.design(*_unit(problem)), made.model)


def _subspace_lqg(problem: Problem, values: Values) -> Design:
    from pipeline.temperature import tracking

    made = tracking.model_based(problem.plant, problem.gamma, tau=values["observer_tau"])
    law = made.design(*weights(problem, values), values["integral"])
    return Design(law, made.model, lambda: made.design(*_unit(problem)))


def _varx_riccati(problem: Problem, values: Values) -> Design:
    from pipeline.temperature.controllers import controller, window

    made, N = window.controller(problem.window, problem.gamma), problem.window.N
    law = controller.compact(made.design(*weights(problem, values), values["integral"]), N)
    return Design(law, made.model, lambda: made.design(*_unit(problem)))


def _learned_kernel(problem: Problem, values: Values) -> Design | None:
    """Its steady inputs come from the window that was learned from the same record."""
    from pipeline.temperature.controllers import controller, kernel, window

    if problem.kernel is None:
        return None
    made = kernel.controller(problem.kernel, problem.gamma, window.observer_form(problem.window)[0])
    law = made.design(*weights(problem, values), values["integral"])
    return Design(controller.compact(law, problem.kernel.N), made.model, lambda: made.design(*_unit(problem)))


def _exact_model(problem: Problem, values: Values) -> Design | None:
    from pipeline.temperature import tracking

    if problem.truth is None:
        return None
    made = tracking.model_based(problem.truth, problem.gamma, tau=values["observer_tau"])
    law = made.design(*weights(problem, values), values["integral"])
    paper = tracking.exact_model(problem.truth, problem.gamma, tau=problem.exact_tau)
    return Design(law, made.model, lambda: paper.design(*_unit(problem)))


class Contestant(NamedTuple):
    """A controller of the comparison: how it is designed, and what the pages say of it.

    `heading` and `method` stand above its column, `explanation` among the words of the page, below `word`
    where the heading alone would say too little. `design` gives None where the record does not allow it, and
    raises ValueError where the machine does not: the page shows that sentence in its column. `parameters` are
    what its search may set; none, and nothing is searched. `learned_from` says whose need of samples is its
    own: the identified plant, the window, or the kernel.

    `role`: the pair that is answered for itself is model_based against data_driven. A yardstick is shown
    beside the others and is never the best. `mark` is the class of its mark; one without takes the next free
    shape.
    """

    name: str
    heading: str
    method: str
    explanation: str
    design: Callable[[Problem, Values], Design | None]
    parameters: tuple[Parameter, ...] = ()
    learned_from: Literal["plant", "window", "kernel", ""] = ""
    role: Literal["data_driven", "model_based", "indirect", "baseline", "yardstick", ""] = ""
    word: str = ""
    mark: Literal["dd", "mb", "bl", ""] = ""
    hollow: bool = False


CONTESTANTS = (
    Contestant("hold", "Hold", "do nothing", "The inputs stay as they were handed over.", _hold),
    # only where a recording is a Klipper log
    Contestant(
        "printer_pid",
        "Printer",
        "its own PID",
        "Klipper’s PID with the gains of the printer’s configuration, as its log has them, at our sample "
        "time. It is not tuned and aims at no target: it starts at the input of the hold, and its "
        "integral rests while the duty is at a limit.",
        _printer_pid,
        word="The printer’s own PID",
    ),
    Contestant(
        "pi_simc",
        "PI, SIMC",
        "PI per zone",
        "One PI controller a zone by SIMC’s rule from the identified model, with the same steady input, "
        "limits, governor and hand-over as the others.",
        _pi,
        learned_from="plant",
        role="baseline",
        mark="bl",
    ),
    Contestant(
        "pi",
        "PI, tuned",
        "PI per zone",
        "The same, its gains and reset times tuned by the same search as the others, which keeps the least "
        "margins of tune_weights; SIMC’s rule need not, so that it may be the cheaper one.",
        _pi,
        (Parameter("gain_factor", 0.02, 1.0, 10.0), Parameter("reset_factor", 0.1, 1.0, 20.0)),
        learned_from="plant",
        mark="bl",
        hollow=True,
    ),
    Contestant(
        "subspace_lqg",
        "subspace + LQG",
        "model-based",
        "A plant model is identified from the record; an observer estimates its state, "
        "and the Riccati equation gives the gains.",
        _subspace_lqg,
        (EFFORT, OBSERVER, INTEGRAL),
        learned_from="plant",
        role="model_based",
        word="subspace + LQG, model-based",
        mark="mb",
    ),
    Contestant(
        "varx_riccati",
        "VARX + Riccati",
        "data-driven, indirect",
        "A long window of past inputs and outputs predicts the next output; the Riccati equation does the "
        "rest. No order, no state to choose.",
        _varx_riccati,
        (EFFORT, INTEGRAL),
        learned_from="window",
        role="indirect",
        word="VARX + Riccati, data-driven and indirect",
        mark="dd",
        hollow=True,
    ),
    Contestant(
        "learned_kernel",
        "learned kernel",
        "data-driven, Algorithm 2",
        "Algorithm 2 of the study: the value of state and action is fitted to the record directly, "
        "and the gain is read off it. Its state is what the window predicts.",
        _learned_kernel,
        (EFFORT, INTEGRAL),
        learned_from="kernel",
        role="data_driven",
        word="learned kernel, Algorithm 2, data-driven and direct",
        mark="dd",
    ),
    Contestant(
        "exact_model",
        "Exact model",
        "told the truth",
        "The model-based controller, told the true plant. The plants that it is judged on differ from that "
        "one too, so that it is a yardstick and no bound: another may be cheaper.",
        _exact_model,
        (EFFORT, OBSERVER, INTEGRAL),
        role="yardstick",
        mark="mb",
        hollow=True,
    ),
)
BY_NAME = {contestant.name: contestant for contestant in CONTESTANTS}
PAIR = ("subspace_lqg", "learned_kernel")
INDIRECT = "varx_riccati"
