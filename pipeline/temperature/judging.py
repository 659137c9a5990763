"""What a record is enough for, judged by the model learned from all of it: whether it is long enough, and the
state on which Algorithm 2 is learned."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.temperature.controllers import kernel
from pipeline.temperature.controllers import window as window_route
from pipeline.temperature.plant import Plant
from pipeline.temperature.test_set.scorecard import (
    CommonCost,
    Scenarios,
    cost,
    optimum,
    panel,
    regret,
    simulate,
)


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

    def on(self, model: Plant) -> Scenarios:
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
    learned: window_route.WindowModel,
    yardstick: CommonCost,
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
        run = simulate(scenarios, law)
        gaps.append(regret(cost(scenarios, run, yardstick), best)[0])
    half_gap = float(np.mean(gaps))
    # never fewer than twice the numbers of one output's predictor:
    # below that the half-record test itself means nothing
    needed = max(
        np.ceil(learned.samples * min(half_gap / 2 / allowed, 1e3)), 2 * (learned.Theta.shape[1] + offset)
    )
    return Sufficiency(half_gap, learned.samples, int(needed))


class KernelCandidate(NamedTuple):
    """One state that Algorithm 2 was tried on: the regression, the gap of its gain on the window's model, and
    the reason of a refusal. The gap of a refused candidate is infinite."""

    state: str
    learned: kernel.Regression | None
    gap: float
    refusal: str


def kernel_candidates(
    u: Sequence[np.ndarray],
    y: Sequence[np.ndarray],
    long: window_route.WindowModel,
    yardstick: CommonCost,
    check: CheckRun,
    *,
    largest: int,
    offset: bool,
) -> list[KernelCandidate]:
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
            candidates.append(KernelCandidate(state, None, float("inf"), str(refusal)))
            continue
        run = simulate(scenarios, law)
        gap = float(regret(cost(scenarios, run, yardstick), best)[0])
        candidates.append(KernelCandidate(state, learned, gap if np.isfinite(gap) else float("inf"), ""))
    return candidates
