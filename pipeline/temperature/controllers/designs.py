"""How each controller of the house is designed from a problem, at the values of its search."""

from collections.abc import Mapping

from pipeline.temperature import tracking
from pipeline.temperature.controllers import baseline, controller, kernel, window
from pipeline.temperature.controllers import printer_pid as klipper
from pipeline.temperature.controllers.problem import Design, DesignProblem, unit_weights, weights


def hold(problem: DesignProblem, values: Mapping[str, float]) -> Design:
    return Design(
        tracking.still_law(problem.plant.m, problem.plant.p), problem.plant, governed=False, holds=True
    )


def printer_pid(problem: DesignProblem, values: Mapping[str, float]) -> Design | None:
    if not problem.printer_pid:
        return None
    limits = problem.limits.low, problem.limits.high
    made = klipper.controller(problem.printer_pid, problem.plant, limits)
    return Design(made.design(*unit_weights(problem)), made.model, governed=False)


def pi(problem: DesignProblem, values: Mapping[str, float]) -> Design:
    made = baseline.controller(
        problem.plant,
        (problem.limits.low, problem.limits.high),
        horizon=problem.horizon,
        family=problem.family,
        noise_degC=problem.noise,
        tuning=baseline.Tuning(**values),
    )
    return Design(made.design(*unit_weights(problem)), made.model)


def subspace_lqg(problem: DesignProblem, values: Mapping[str, float]) -> Design:
    made = tracking.model_based(problem.plant, problem.gamma, tau=values["observer_tau"])
    law = made.design(*weights(problem, values), values["integral"])
    return Design(law, made.model, lambda: made.design(*unit_weights(problem)))


def varx_riccati(problem: DesignProblem, values: Mapping[str, float]) -> Design:
    made, N = window.controller(problem.window, problem.gamma), problem.window.N
    law = controller.compact(made.design(*weights(problem, values), values["integral"]), N)
    model = made.model._replace(sample_time_s=problem.plant.sample_time_s)
    return Design(law, model, lambda: made.design(*unit_weights(problem)))


def learned_kernel(problem: DesignProblem, values: Mapping[str, float]) -> Design | None:
    """Its steady inputs come from the window that was learned from the same record."""
    if problem.kernel is None:
        return None
    made = kernel.controller(problem.kernel, problem.gamma, window.observer_form(problem.window)[0])
    law = made.design(*weights(problem, values), values["integral"])
    model = made.model._replace(sample_time_s=problem.plant.sample_time_s)
    return Design(
        controller.compact(law, problem.kernel.N), model, lambda: made.design(*unit_weights(problem))
    )


def exact_model(problem: DesignProblem, values: Mapping[str, float]) -> Design | None:
    if problem.truth is None:
        return None
    made = tracking.model_based(problem.truth, problem.gamma, tau=values["observer_tau"])
    law = made.design(*weights(problem, values), values["integral"])
    paper = tracking.exact_model(problem.truth, problem.gamma, tau=problem.exact_tau)
    return Design(law, made.model, lambda: paper.design(*unit_weights(problem)))
