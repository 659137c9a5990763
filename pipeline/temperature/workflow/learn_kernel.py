"""What learn_kernel does: it learns the window model from the record alone, and the kernel where the record
determines it. New weights need no further pass over the data."""

from typing import Any, NamedTuple

import numpy as np

from pipeline.store import artifacts
from pipeline.temperature.controllers import window
from pipeline.temperature.identification import model_choice as identification
from pipeline.temperature.judging import Candidate, CheckRun, Sufficiency, kernel_candidates, sufficiency
from pipeline.temperature.test_set.scorecard import Yardstick
from pipeline.temperature.workflow.record import read_record
from pipeline.temperature.workflow.settings import LearnKernel, Panel, Plant, Tracking


class Learned(NamedTuple):
    """The window model, the best candidate for the kernel, and metrics."""

    window: window.Window
    best: Candidate
    metrics: dict[str, Any]


COLD_SHARE = 0.1  # quantile of the recorded temperatures at which a check run starts on somebody's machine


def learned(
    settings: LearnKernel, machine: Plant, tracking: Tracking, panel: Panel, path: str, *, simulated: bool
) -> Learned:
    """Window and kernel of the record in `path`. Raises ValueError where it has too little to learn from.

    Candidates are compared on a run from the panel's first training start on the `simulated` machine, and
    from the cold end of what was recorded on another."""
    yardstick = Yardstick(
        np.full(len(machine.outputs), tracking.yardstick_q),
        np.full(len(machine.inputs), tracking.yardstick_r),
        tracking.gamma,
    )
    u, y = read_record(path, machine.acting, machine.outputs)
    # window and kernel know inputs alone: what disturbances do counts as noise
    u = [a[:, : len(machine.inputs)] for a in u]
    with artifacts.about(path):
        identification.check_inputs(u, offset=settings.offset, names=[i.name for i in machine.inputs])
        identification.check_outputs(y, names=[o.name for o in machine.outputs])
    reference = np.array([o.reference for o in machine.outputs])
    start = panel.training.starts_degC[0] if simulated else float(np.nanquantile(np.vstack(y), COLD_SHARE))
    check = CheckRun(start, reference, panel.steps)
    long = window.learn(
        u, y, longest=settings.longest_window, offset=settings.offset, gain_spread=settings.gain_spread
    )
    record_test = sufficiency(
        u,
        y,
        long,
        yardstick,
        check,
        allowed=settings.allowed_gap_percent / 100,
        offset=settings.offset,
        gain_spread=settings.gain_spread,
    )
    candidates = kernel_candidates(
        u, y, long, yardstick, check, largest=settings.largest_kernel_window, offset=settings.offset
    )
    best = min(candidates, key=lambda candidate: candidate.gap)
    return Learned(long, best, _metrics(long, record_test, candidates, best))


def _metrics(
    long: window.Window, enough: Sufficiency, tried: list[Candidate], best: Candidate
) -> dict[str, Any]:
    kernel = best.learned
    return {
        "window": long.N,
        "samples": long.samples,
        "half_record_gap_percent": 100 * enough.half_gap,
        "samples_needed_for_noise": enough.needed,
        "state": best.state if kernel else None,
        "refused": None if kernel else best.refusal,
        "rank": kernel.rank if kernel else None,
        "identifiable": kernel.unknowns if kernel else None,
        "samples_needed": kernel.samples_needed if kernel else None,
        "condition": kernel.condition if kernel else None,
        "candidates": {
            c.state: {
                "gap_on_window_model_percent": 100 * c.gap if np.isfinite(c.gap) else None,
                "refusal": c.refusal or None,
            }
            for c in tried
        },
    }
