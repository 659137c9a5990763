"""Functions that design each built-in controller from a problem, with the values of its search."""

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from pipeline.temperature import tracking
from pipeline.temperature.controllers import baseline, kernel, predictive, window
from pipeline.temperature.controllers import printer_pid as klipper
from pipeline.temperature.controllers.law import compact
from pipeline.temperature.controllers.problem import Design, DesignProblem, unit_weights, weights
from pipeline.temperature.plant import strictly_proper
from pipeline.temperature.tracking import Law

UNDETERMINED = "the record does not determine it"


def hold(problem: DesignProblem, values: Mapping[str, float]) -> Design:
    return Design(
        tracking.still_law(problem.plant.m, problem.plant.p), problem.plant, governed=False, holds=True
    )


def printer_pid(problem: DesignProblem, values: Mapping[str, float]) -> Design | None:
    if not problem.printer_pid:
        return None
    limits = problem.limits.low, problem.limits.high
    law = klipper.law_of_printer(problem.printer_pid, problem.plant, limits)
    return Design(law, problem.plant, governed=False)


def pi(problem: DesignProblem, values: Mapping[str, float]) -> Design:
    pairs = baseline.pairing(
        problem.plant,
        problem.limits.low,
        problem.limits.high,
        horizon=problem.horizon,
        family=problem.family,
        noise_degC=problem.noise,
        **values,
    )
    return Design(baseline.pi_law(pairs, inputs=problem.plant.m), problem.plant)


def subspace_lqg(problem: DesignProblem, values: Mapping[str, float]) -> Design:
    tau = values["observer_tau"]
    law = partial(tracking.model_based, problem.plant, gamma=problem.gamma, tau=tau)
    return Design(
        law(*weights(problem, values), values["integral"]), problem.plant, lambda: law(*unit_weights(problem))
    )


def varx_riccati(problem: DesignProblem, values: Mapping[str, float]) -> Design:
    return _of_window(problem, values, partial(window.law, problem.window), problem.window.N)


def learned_kernel(problem: DesignProblem, values: Mapping[str, float]) -> Design:
    """Designs the learned kernel. Its steady inputs come from the window model of the same record."""
    if problem.kernel is None:
        raise ValueError(problem.undetermined.get("learned_kernel", UNDETERMINED))
    return _of_window(problem, values, partial(kernel.law, problem.kernel), problem.kernel.N)


def predictive_control(problem: DesignProblem, values: Mapping[str, float]) -> Design:
    """Designs predictive control. Its steady inputs come from the window model, as for the learned kernel."""
    if problem.trajectories is None:
        raise ValueError(problem.undetermined.get("predictive_control", UNDETERMINED))
    return _of_window(problem, values, partial(predictive.law, problem.trajectories), problem.trajectories.N)


def _of_window(
    problem: DesignProblem, values: Mapping[str, float], law: Callable[..., Law], N: int
) -> Design:
    """Returns the design of law(Q, R, gamma, integral=...) on a window of N samples."""
    (q, r), (ones_q, ones_r, _) = weights(problem, values), unit_weights(problem)
    made = law(np.diag(q), np.diag(r), problem.gamma, integral=values["integral"])
    model, _ = window.observer_form(problem.window, problem.plant.sample_time_s)
    return Design(compact(made, N), model, lambda: law(np.diag(ones_q), np.diag(ones_r), problem.gamma))


def exact_model(problem: DesignProblem, values: Mapping[str, float]) -> Design | None:
    """Designs the controller from the true plant. Without integrator it is the paper's controller: Riccati
    gains and the observer (8)."""
    if problem.truth is None:
        return None
    plant, gamma = strictly_proper(problem.truth), problem.gamma
    q, r = weights(problem, values)
    law = tracking.model_based(plant, q, r, values["integral"], gamma=gamma, tau=values["observer_tau"])
    L = tracking.observer_gain(plant, problem.exact_tau)
    best = partial(tracking.gains, plant, np.eye(plant.p), np.eye(plant.m), gamma)
    return Design(law, plant, lambda: tracking.observer_law(plant, best(), L))
