"""The chosen model, judged on the part of the record that did not choose it."""

from typing import NamedTuple

import numpy as np

from pipeline.temperature.identification import trust, validation
from pipeline.temperature.identification.model_choice import Identified

Segments = list[np.ndarray]


class ModelJudgement(NamedTuple):
    """The chosen model on the last part of the record, and what the first part excites; `still` (p,): its fit
    with the inputs held."""

    holdout: trust.Holdout
    residuals: validation.Residuals
    excitation: validation.RecordExcitation
    samples: int
    still: np.ndarray


def judge(
    chosen: Identified,
    first: tuple[Segments, Segments],
    last: tuple[Segments, Segments],
    *,
    ahead_steps: int,
    rng: np.random.Generator,
) -> ModelJudgement:
    """The model that (u, y) of `first` chose, on (u, y) of `last`."""
    closed = chosen.feedback is not None and chosen.feedback.closed
    return ModelJudgement(
        trust.holdout(chosen.plant, *last, ahead_steps, block=2 * chosen.past, rng=rng, drift=chosen.drift),
        validation.residual_tests(chosen.plant, *last, lags=trust.residual_lags(last[0]), closed=closed),
        validation.excitation(first[0], chosen.past),
        sum(map(len, last[0])),
        trust.fit_of_held_inputs(chosen.plant, *last),
    )
