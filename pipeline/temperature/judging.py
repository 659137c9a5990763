"""Controllers of the temperature loop on one panel, judged on plants that nothing was learned from."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.temperature import kernel
from pipeline.temperature import window as window_route
from pipeline.temperature.plant import Plant
from pipeline.temperature.scorecard import (
    Figures,
    Margins,
    Panel,
    PanelRun,
    Yardstick,
    cost,
    feed_forward,
    figures,
    margins,
    optimum,
    panel,
    regret,
    simulate,
)
from pipeline.temperature.tracking import Controller, Law, feasible_target

Limits = tuple[np.ndarray, np.ndarray]
Targets = dict[bytes, tuple[np.ndarray, np.ndarray]]


class Deployment(NamedTuple):
    """How a law runs on the machine: limits of the inputs in percent, the band in °C that counts as settled,
    the integrator's share a step, and the largest error in °C that it sees."""

    limits: Limits
    band: float
    integral: float
    integral_limit: float


class Judged(NamedTuple):
    """One controller on the panel, run twice.

    `unclipped`, at the yardstick's weights: regret (scenarios,), and the share of commands outside the limits
    in percent. `deployed`, clipped, aimed at feasible targets, integrator on: figures, and the margins of
    `law` with each plant.
    """

    name: str
    regret: np.ndarray
    outside_percent: np.ndarray
    figures: Figures
    margins: list[Margins]
    unclipped: PanelRun
    deployed: PanelRun
    law: Law


def refusals(
    compared: Sequence[Controller], designs: Sequence[tuple[np.ndarray, np.ndarray, float]]
) -> dict[str, str]:
    """The controllers that have no law for one of these (q, r, integral), each with the reason. A learned
    kernel may have no minimum at other weights."""
    refused = {}
    for controller in compared:
        for q, r, integral in designs:
            try:
                controller.design(q, r, integral)
            except ValueError as reason:
                refused[controller.name] = str(reason)
    return refused


def targets(model: Plant, references: np.ndarray, limits: Limits) -> Targets:
    """The feasible steady (u, y) of every reference (scenarios, p) on
    the panel, by the controller's own model."""
    by_reference = {}
    for r in np.unique(references, axis=0):
        aim = feasible_target(model, r, *limits)
        by_reference[r.tobytes()] = (aim.u, aim.y)
    return by_reference


def judge(
    controller: Controller,
    scenarios: Panel,
    *,
    yardstick: Yardstick,
    q: np.ndarray,
    r: np.ndarray,
    deployment: Deployment,
) -> Judged:
    """One controller run on the panel twice: designed for the yardstick's weights and unclipped, and designed
    for (q, r) and clipped, as it would be deployed."""
    limits = deployment.limits
    plain = controller.design(yardstick.q, yardstick.r, 0.0)
    aims = targets(controller.model, scenarios.r, limits)
    unclipped = simulate(
        scenarios,
        plain,
        feed_forward(scenarios, plain, None if controller.own_feed_forward else aims),
        limits=None,
    )
    outside = (unclipped.command < limits[0]) | (unclipped.command > limits[1])
    law = controller.design(q, r, deployment.integral)
    deployed = simulate(
        scenarios,
        law,
        feed_forward(scenarios, law, None if law.conditional else aims),
        limits=limits,
        integral_band=deployment.integral_limit,
    )
    sample_time_s = scenarios.plants[0].sample_time_s
    return Judged(
        controller.name,
        regret(cost(scenarios, unclipped, yardstick), optimum(scenarios, yardstick)),
        100.0 * outside.mean(axis=(0, 2)),
        figures(scenarios, deployed, limits=limits, band=deployment.band, sample_time_s=sample_time_s),
        margins(scenarios.plants, law),
        unclipped,
        deployed,
        law,
    )


def summary(judged: Judged, scenarios: Panel, *, noise: float) -> dict[str, dict[str, float | str | None]]:
    """Median and 90 % band over starts, references and seeds on the nominal plant at one noise level, and the
    worst over every plant of the panel."""
    nominal, level = scenarios.plant == 0, scenarios.noise == noise
    columns = {
        "gap_percent": 100.0 * judged.regret,
        **{
            name: getattr(judged.figures, name)
            for name in (
                "settled_error_degC",
                "settling_s",
                "overshoot_degC",
                "at_limits_percent",
                "tracking_degC",
                "effort_percent",
            )
        },
        "outside_limits_percent": judged.outside_percent,
    }
    result: dict[str, dict] = {}
    for name, values in columns.items():
        # a run that never settles is infinitely late: it sorts last, and shows as null
        typical, worst = (
            np.where(np.isnan(values[rows]), np.inf, values[rows]) for rows in (nominal & level, level)
        )
        low, median, high = np.quantile(typical, [0.05, 0.5, 0.95], method="nearest")
        result[name] = {
            key: _number(value)
            for key, value in (("median", median), ("low", low), ("high", high), ("worst", worst.max()))
        }
    for name in ("disk", "delay_s"):
        values = np.array([getattr(margin, name) for margin in judged.margins])
        result[name] = {
            "median": _number(values[0]),
            "low": _number(values.min()),
            "high": _number(values[0]),
            "worst": _number(values.min()),
        }
    worst = np.where(nominal & level, judged.figures.settled_error_degC, -1.0).argmax()
    result["settled_error_degC"]["zone"] = int(judged.figures.settled_zone[worst])
    result["stable_plants"] = {
        "count": sum(margin.stable for margin in judged.margins),
        "of": len(judged.margins),
    }
    return result


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


class Sufficiency(NamedTuple):
    """Whether the record of `samples` is long enough.

    `half_gap` is the extra cost of a controller learned from half of the record, on the model learned from
    all of it. The excess falls as one over the samples. At `needed` samples it would be the excess allowed.
    """

    half_gap: float
    samples: int
    needed: int


class CheckRun(NamedTuple):
    """The noise-free run on which candidates are compared: from temperature `start` to `reference` (p,), both
    in °C, over `steps`."""

    start: float
    reference: np.ndarray
    steps: int

    def on(self, model: Plant) -> Panel:
        return panel(
            [model],
            starts=[self.start],
            references=[self.reference],
            noise=[0.0],
            seeds=[0],
            steps=self.steps,
            hold=0,
            cells=False,
        )


def sufficiency(
    u: Sequence[np.ndarray],
    y: Sequence[np.ndarray],
    learned: window_route.Window,
    yardstick: Yardstick,
    check: CheckRun,
    *,
    allowed: float,
    offset: bool,
    gain_spread: float,
) -> Sufficiency:
    """Whether the record is long enough for its noise, by the record alone. A controller is learned from each
    half of it and judged by the model learned from all of it."""
    scenarios = check.on(window_route.predictor(learned))
    best = optimum(scenarios, yardstick)
    gaps = []
    for part in (0, 1):
        half_u, half_y = (
            [rows[part * len(rows) // 2 : (part + 1) * len(rows) // 2] for rows in signal]
            for signal in (u, y)
        )
        half = window_route.learn(half_u, half_y, longest=learned.N, offset=offset, gain_spread=gain_spread)
        law = window_route.law(half, np.diag(yardstick.q), np.diag(yardstick.r), yardstick.gamma)
        run = simulate(scenarios, law, feed_forward(scenarios, law, None), limits=None)
        gaps.append(regret(cost(scenarios, run, yardstick), best)[0])
    half_gap = float(np.mean(gaps))
    # never fewer than twice the numbers of one output's predictor:
    # below that the half-record test itself means nothing
    needed = max(
        np.ceil(learned.samples * min(half_gap / 2 / allowed, 1e3)), 2 * (learned.Theta.shape[1] + offset)
    )
    return Sufficiency(half_gap, learned.samples, int(needed))


class Candidate(NamedTuple):
    """One state that Algorithm 2 was tried on: the regression, the gap of its gain on the window's model, and
    the reason of a refusal. The gap of a refused candidate is infinite."""

    state: str
    learned: kernel.Regression | None
    gap: float
    refusal: str


def kernel_candidates(
    u: Sequence[np.ndarray],
    y: Sequence[np.ndarray],
    long: window_route.Window,
    yardstick: Yardstick,
    check: CheckRun,
    *,
    largest: int,
    offset: bool,
) -> list[Candidate]:
    """Algorithm 2 on windows of 1 to `largest` samples and on the predicted state, all from one record. The
    model of the long window judges each.

    Without noise the shortest window that holds the plant's state is exact. With noise longer windows are
    biased; the predicted state is not.
    """
    model = window_route.predictor(long)
    scenarios = check.on(model)
    best = optimum(scenarios, yardstick)
    tried = [
        (f"window of {N}", lambda N=N: kernel.tuples(u, y, N, offset=offset)) for N in range(1, largest + 1)
    ]
    tried.append(("predicted state", lambda: window_route.predicted_tuples(long, u, y, offset=offset)))
    candidates = []
    for state, features in tried:
        try:
            learned = kernel.regress(features())
            law = kernel.controller(learned, yardstick.gamma, model).design(yardstick.q, yardstick.r, 0.0)
        except ValueError as refusal:
            candidates.append(Candidate(state, None, float("inf"), str(refusal)))
            continue
        run = simulate(scenarios, law, feed_forward(scenarios, law, None), limits=None)
        gap = float(regret(cost(scenarios, run, yardstick), best)[0])
        candidates.append(Candidate(state, learned, gap if np.isfinite(gap) else float("inf"), ""))
    return candidates


def rows(judged: Sequence[Judged], scenarios: Panel, zones: Sequence[str]) -> dict[str, list | np.ndarray]:
    """The scorecard as columns: one row a controller and scenario."""
    count = len(judged)
    columns: dict[str, list | np.ndarray] = {
        "controller": [j.name for j in judged for _ in scenarios.seed],
        "plant": np.tile(scenarios.plant, count).astype(np.int32),
        "start_degC": np.tile(scenarios.start, count),
        "reference_degC": np.tile(scenarios.r[:, 0], count),
        "noise_degC": np.tile(scenarios.noise, count),
        "seed": np.tile(scenarios.seed, count),
        "regret": np.concatenate([np.where(np.isfinite(j.regret), j.regret, np.nan) for j in judged]),
        "outside_percent": np.concatenate([j.outside_percent for j in judged]),
        "settled_zone": [zones[zone] for j in judged for zone in j.figures.settled_zone],
    }
    for name in Figures._fields:
        if name != "settled_zone":
            columns[name] = np.concatenate([getattr(j.figures, name) for j in judged])
    return columns


def featured(scenarios: Panel, noise: float) -> int:
    """The scenario that the pictures show: nominal plant, first start, reference and seed, at this noise."""
    return int(np.flatnonzero((scenarios.plant == 0) & (scenarios.noise == noise))[0])


def trajectories(
    judged: Sequence[Judged],
    scenarios: Panel,
    inputs: Sequence[str],
    outputs: Sequence[str],
    *,
    noise: float,
    yardstick: Yardstick,
) -> dict[str, list | np.ndarray]:
    """The featured scenario under every controller, in both modes, as columns. Beside it stand the 5th, 50th
    and 95th percentile of the worst zone's error over all runs on the nominal plant."""
    i, alike = featured(scenarios, noise), (scenarios.plant == 0) & (scenarios.noise == noise)
    runs = [
        (j.name, mode, run)
        for j in judged
        for mode, run in (("unclipped", j.unclipped), ("deployed", j.deployed))
    ]
    time_s = scenarios.plants[0].sample_time_s * np.arange(scenarios.steps)
    discount = yardstick.gamma ** np.arange(scenarios.steps)
    stages = [
        discount * ((run.y[:, i] - scenarios.r[i]) ** 2 @ yardstick.q + run.u[:, i] ** 2 @ yardstick.r)
        for _, _, run in runs
    ]
    columns: dict[str, list | np.ndarray] = {
        "controller": [name for name, _, _ in runs for _ in time_s],
        "mode": [mode for _, mode, _ in runs for _ in time_s],
        "time_s": np.tile(time_s, len(runs)),
        "cost": np.concatenate([np.cumsum(stage) for stage in stages]),
    }
    worst = [
        np.quantile(
            np.abs(run.y[:, alike] - scenarios.r[alike]).max(axis=2),
            [0.05, 0.5, 0.95],
            axis=1,
            method="nearest",
        )
        for _, _, run in runs
    ]
    columns |= {
        f"error_{name}_degC": np.concatenate([percentiles[k] for percentiles in worst])
        for k, name in enumerate(("low", "median", "high"))
    }
    for channel, name in enumerate(outputs):
        columns[name] = np.concatenate([run.y[:, i, channel] for _, _, run in runs])
    for channel, name in enumerate(inputs):
        columns[f"{name}_command"] = np.concatenate([run.command[:, i, channel] for _, _, run in runs])
        columns[f"{name}_applied"] = np.concatenate([run.u[:, i, channel] for _, _, run in runs])
    return columns
