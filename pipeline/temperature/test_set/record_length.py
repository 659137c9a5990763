"""Cost against the length of the record: the cost of controllers learned from the beginning of the record
only, with the weights tuned on the whole record, and the length at which two of them change places."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.temperature.controllers.problem import Design
from pipeline.temperature.test_set import panel

SHARES = (0.125, 0.25, 0.5, 1.0)  # of the samples of the record
PLANTS = 10  # of the judging half: two of each structure
RESAMPLES = 500


def beginning(signal: Sequence[np.ndarray], share: float) -> list[np.ndarray]:
    """Returns the first `share` of all samples of the segments (T, k), in the order in which they were
    recorded."""
    left = round(share * sum(map(len, signal)))
    pieces = []
    for piece in signal:
        pieces.append(piece[: max(left, 0)])
        left -= len(piece)
    return [piece for piece in pieces if len(piece)]


def few_plants(setting: panel.CaseConditions) -> panel.CaseConditions:
    """Returns the conditions with the first PLANTS plants of the judging half."""
    judging = setting.rehearsal.judging
    count = min(PLANTS, len(judging.plants))
    cases = panel.some(judging, tuple(np.unique(judging.kind)), count)
    return setting._replace(rehearsal=setting.rehearsal._replace(judging=cases))


def plant_costs(design: Design, setting: panel.CaseConditions) -> np.ndarray:
    """Returns the logarithm of the mean cost on each plant of the judging half (plants,), as deployed."""
    cases = setting.rehearsal.judging
    played = panel.play(design, panel.rests(design.model, cases, setting.limits), cases, setting)[1]
    costs = panel.costs(played, setting.allowance).reshape(len(cases.plants), -1)
    return np.log(np.maximum(costs.mean(axis=1), 1e-9))


def curves(
    costs: Sequence[Mapping[str, np.ndarray]], samples: Sequence[int], pair: tuple[str, str], *, seed: int
) -> dict[str, Any]:
    """Returns the cost of each controller at each length: the geometric mean over plants with the ends of its
    90 % band, None if it could not be learned. Also returns the length at which the pair changes places.
    `costs`: for each length and controller, the logarithms (plants,) of `plant_costs`."""
    names = list(dict.fromkeys(name for one in costs for name in one))
    plants = max((len(values) for one in costs for values in one.values()), default=0)
    drawn = np.random.default_rng(seed).integers(0, plants, (RESAMPLES, plants))
    shown: dict[str, dict[str, list[float | None]]] = {}
    for name in names:
        ends = [
            np.quantile(one[name][drawn].mean(axis=1), [0.05, 0.95]) if name in one else None for one in costs
        ]
        shown[name] = {
            "cost": [float(np.exp(one[name].mean())) if name in one else None for one in costs],
            "low": [None if end is None else float(np.exp(end[0])) for end in ends],
            "high": [None if end is None else float(np.exp(end[1])) for end in ends],
        }
    both = [k for k, one in enumerate(costs) if set(pair) <= one.keys()]
    crossing = None
    if len(both) > 1:
        ratio = np.array([costs[k][pair[0]] - costs[k][pair[1]] for k in both])
        crossing = _crossing(ratio, np.array([samples[k] for k in both]), drawn)
    return {
        "samples": list(samples),
        "plants": plants,
        "pair": list(pair),
        "controllers": shown,
        "crossing": crossing,
    }


def _crossing(ratio: np.ndarray, samples: np.ndarray, drawn: np.ndarray) -> dict[str, Any]:
    """Returns the length at which the mean over plants of the log-ratio (lengths, plants) of two costs last
    changes its sign, with the ends of the 90 % interval over resampled plants (`drawn`). None means outside
    the tried lengths. `share`: share of the resamples that cross within them."""
    here = _last_change(ratio.mean(axis=1), samples)
    found = np.array([_last_change(ratio[:, row].mean(axis=1), samples) or np.nan for row in drawn])
    within = found[np.isfinite(found)]
    share = len(within) / len(found)
    # an end lies within the record only if fewer than 5 % of the resamples do not cross at all
    ends = np.quantile(within, [0.05, 0.95]).tolist() if here and share > 0.95 else [None, None]
    return {"samples": here, "low": ends[0], "high": ends[1], "share": share}


def _last_change(ratio: np.ndarray, samples: np.ndarray) -> float | None:
    """Returns the length at which a curve (lengths,) last goes through zero, interpolated linearly over the
    logarithm of the length; None if it never does."""
    changes = np.flatnonzero(np.sign(ratio[1:]) * np.sign(ratio[:-1]) < 0)
    if not len(changes):
        return None
    k = int(changes[-1])
    way = ratio[k] / (ratio[k] - ratio[k + 1])
    return float(samples[k] * (samples[k + 1] / samples[k]) ** way)
