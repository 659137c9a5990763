"""Learn controllers from the record alone: reads datasets/ingest/record.parquet; writes
datasets/learn_kernel/window.parquet and, if the record determines them, kernel.parquet and
trajectories.parquet: what the data say whatever the weights, so that new weights need no pass over the
data."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

from pydantic import Field

import stages
from pipeline.store import artifacts, params
from pipeline.store.params import Section
from pipeline.temperature import tables
from pipeline.temperature.settings import Panel, Plant, Tracking, recorded

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from pipeline.temperature.controllers.feed_forward import Told
    from pipeline.temperature.controllers.kernel import Regression
    from pipeline.temperature.controllers.predictive import Trajectories
    from pipeline.temperature.controllers.window import WindowModel
    from pipeline.temperature.test_set.scorecard import CommonCost, KernelCandidate, Scenarios
    from pipeline.temperature.tracking import Law

    Segments = Sequence[np.ndarray]


class LearnKernel(Section):
    """Section `learn_kernel`."""

    longest_window: int = Field(ge=1, le=200)
    largest_kernel_window: int = Field(ge=1, le=10)
    longest_horizon: int = Field(ge=5, le=200)
    offset: bool
    gain_spread: float = Field(ge=0, le=1)
    allowed_gap_percent: float = Field(gt=0, le=100)


RECORD = "datasets/ingest/record.parquet"
COLD_SHARE = 0.1  # quantile of the recorded temperatures at which a check run starts on somebody's machine


def read_record(machine: Plant) -> tuple[list[np.ndarray], list[np.ndarray], Told | None]:
    """Segments u (T, m) and y (T, p), and what disturbances do. Window and kernel know inputs alone: y is as
    it would be with every disturbance at its mean."""
    from pipeline.temperature.controllers import feed_forward
    from pipeline.temperature.identification.segments import segments, without_gaps

    table = artifacts.read_table(RECORD, tables.record(machine.acting, machine.outputs))
    pieces = segments(table, [s.name for s in machine.acting], [o.name for o in machine.outputs])
    if not machine.disturbances:
        return pieces[0], pieces[1], None
    m, (acting, y, _) = len(machine.inputs), without_gaps(*pieces)
    told = feed_forward.learn(acting, y, m)
    return [a[:, :m] for a in acting], feed_forward.at_mean(told, acting, y, m), told


# figures of control that git keeps and that runs are compared by
METRICS = (
    "window",
    "samples*",
    "half_record_gap_percent",
    "rank",
    "condition",
    "candidates.*.gap_on_window_model_percent",
    "predictive.horizon",
    "predictive.samples_needed",
    "predictive.half_record_excess_percent",
)


class LearnedFromRecord(NamedTuple):
    """What one record says, whatever the weights: None, and in `undetermined` why, by controller, if the
    record does not determine it; and the figures of the stage."""

    window: WindowModel
    kernel: Regression | None
    trajectories: Trajectories | None
    undetermined: dict[str, str]
    figures: dict[str, Any]


def main() -> None:
    with artifacts.stage("learn_kernel") as out:
        from pipeline.temperature.controllers import feed_forward, window
        from pipeline.temperature.identification import model_choice

        settings = params.load(LearnKernel, "learn_kernel")
        machine = recorded(params.load(Plant, "plant"), RECORD)
        u, y, told = read_record(machine)
        with artifacts.about(RECORD):
            model_choice.check_inputs(u, offset=settings.offset, names=[i.name for i in machine.inputs])
            model_choice.check_outputs(y, names=[o.name for o in machine.outputs])
        learned = learn(settings, machine, u, y)
        artifacts.write_arrays(out / "window.parquet", "window", 1, window.stored(learned.window))
        if told is not None:
            artifacts.write_arrays(out / "feed_forward.parquet", "feed_forward", 1, feed_forward.stored(told))
        for name in ("kernel", "trajectories"):
            if (part := getattr(learned, name)) is not None:
                artifacts.write_arrays(out / f"{name}.parquet", name, 1, part.stored())
        shown = learned.figures | {"forward": forward_figures(machine, told)}
        artifacts.write_metrics("learn_kernel", shown, METRICS)


def learn(settings: LearnKernel, machine: Plant, u: Segments, y: Segments) -> LearnedFromRecord:
    """The window, the kernel and the trajectories of a record, and whether it is long enough for them. Raises
    ValueError if it is too short for a window."""
    import numpy as np

    from pipeline.temperature.controllers import window
    from pipeline.temperature.plant import hold_output
    from pipeline.temperature.test_set import scorecard
    from pipeline.temperature.test_set.scorecard import CommonCost, Scenarios

    tracking, panel = params.load(Tracking, "tracking"), params.load(Panel, "panel")
    simulated = params.value("generate_probing.source", one_of=("simulated", "recordings")) == "simulated"
    yardstick = CommonCost(
        np.full(len(machine.outputs), tracking.yardstick_q),
        np.full(len(machine.inputs), tracking.yardstick_r),
        tracking.gamma,
    )
    # candidates are compared on a run from the panel's first training start on the simulated machine, and
    # from the cold end of what was recorded on another
    start_degC = (
        panel.training.starts_degC[0] if simulated else float(np.nanquantile(np.vstack(y), COLD_SHARE))
    )
    long = window.learn(
        u, y, longest=settings.longest_window, offset=settings.offset, gain_spread=settings.gain_spread
    )
    model = window.predictor(long)
    x0, u0 = hold_output(model, np.full(model.p, start_degC))
    r = np.array([[o.reference for o in machine.outputs]], float)
    scenarios = Scenarios([model], np.zeros(1, int), x0[None], u0[None], r, panel.steps, hold=0)

    def law_of_half(u: Segments, y: Segments) -> Law:
        half = window.learn(u, y, longest=long.N, offset=settings.offset, gain_spread=settings.gain_spread)
        return window.law(half, np.diag(yardstick.q), np.diag(yardstick.r), yardstick.gamma)

    # never fewer samples than twice the numbers of one output's predictor: below that the half-record test
    # itself means nothing
    half_gap, needed = scorecard.sufficiency(
        u,
        y,
        law_of_half,
        yardstick,
        scenarios,
        whole=scorecard.optimum(scenarios, yardstick)[0],
        samples=long.samples,
        least=2 * (long.Theta.shape[1] + settings.offset),
        allowed=settings.allowed_gap_percent / 100,
    )
    trajectories, predictive = learn_trajectories(settings, u, y, long, yardstick, scenarios)
    candidates = scorecard.kernel_candidates(
        u, y, long, yardstick, scenarios, largest=settings.largest_kernel_window, offset=settings.offset
    )
    best = min(candidates, key=lambda candidate: candidate.gap)
    reasons = {
        "learned_kernel": None if best.learned else best.refusal,
        "predictive_control": predictive["refused"],
    }
    undetermined = {name: reason for name, reason in reasons.items() if reason}
    shown = figures(settings, long, half_gap, needed, candidates, best)
    shown |= {"undetermined": undetermined, "predictive": predictive}
    return LearnedFromRecord(long, best.learned, trajectories, undetermined, shown)


def learn_trajectories(
    settings: LearnKernel,
    u: Segments,
    y: Segments,
    long: WindowModel,
    yardstick: CommonCost,
    scenarios: Scenarios,
) -> tuple[Trajectories | None, dict[str, Any]]:
    """The factors of predictive control on the window of `long`, with the horizon that the record carries,
    and whether the record is long enough for its noise; None and why, if the record does not determine
    them."""
    import numpy as np

    from pipeline.temperature.controllers import predictive
    from pipeline.temperature.test_set import scorecard

    m, p = u[0].shape[1], y[0].shape[1]

    def learn(u: Segments, y: Segments) -> Trajectories:
        return predictive.learn(u, y, long.N, T, gain_spread=settings.gain_spread)

    def law(learned: Trajectories) -> Law:
        return predictive.law(learned, np.diag(yardstick.q), np.diag(yardstick.r), yardstick.gamma)

    try:
        T = predictive.horizon(long.samples, len(u), long.N, m, p, longest=settings.longest_horizon)
        learned = learn(u, y)
        run = scorecard.simulate(scenarios, law(learned))
        half_excess, needed = scorecard.sufficiency(
            u,
            y,
            lambda half_u, half_y: law(learn(half_u, half_y)),
            yardstick,
            scenarios,
            whole=scorecard.cost(scenarios, run, yardstick)[0],
            samples=learned.samples,
            least=2 * predictive.ROWS * (1 + long.N * (m + p) + T * m),
            allowed=settings.allowed_gap_percent / 100,
        )
    except ValueError as refusal:
        return None, {"refused": str(refusal)}
    return learned, {
        "refused": None,
        "horizon": T,
        "samples": learned.samples,
        "samples_needed": needed,
        "half_record_excess_percent": 100 * half_excess,
    }


def forward_figures(machine: Plant, told: Told | None) -> dict[str, Any]:
    """By disturbance and input what makes up for it in percent a unit, its deviation, and whether it is fed
    forward."""
    if told is None:
        return {}
    return {
        one.name: {
            heater.name: {
                "gain": float(told.gain[i, k]),
                "deviation": None if math.isnan(told.deviation[i, k]) else float(told.deviation[i, k]),
                "fed_forward": bool(told.forward.gain[i, k]),
            }
            for i, heater in enumerate(machine.inputs)
        }
        for k, one in enumerate(machine.disturbances)
    }


def figures(
    settings: LearnKernel,
    long: WindowModel,
    half_gap: float,
    needed: int,
    candidates: list[KernelCandidate],
    best: KernelCandidate,
) -> dict[str, Any]:
    kernel = best.learned
    return {
        "window": long.N,
        "samples": long.samples,
        "allowed_gap_percent": settings.allowed_gap_percent,
        "half_record_gap_percent": 100 * half_gap,
        "samples_needed_for_noise": needed,
        "state": best.state if kernel else None,
        "refused": None if kernel else best.refusal,
        "rank": kernel.rank if kernel else None,
        "identifiable": kernel.unknowns if kernel else None,
        "samples_needed": kernel.unknowns if kernel else None,
        "condition": kernel.condition if kernel else None,
        "candidates": {
            c.state: {
                "gap_on_window_model_percent": 100 * c.gap if c.gap < float("inf") else None,
                "refusal": c.refusal or None,
            }
            for c in candidates
        },
    }


if __name__ == "__main__":
    stages.run(main, "learn_kernel", loop="temperature")
