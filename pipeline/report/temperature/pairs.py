"""Two controllers on the very same cases: what the data-driven one saves against each of the others, with a
sign-flip test over plants (pipeline/statistics.py)."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pandas as pd

from pipeline.report.shared.digits import LARGEST, THIN, count, number, short
from pipeline.report.shared.sources import Sources, Table
from pipeline.report.shared.verdict import Missing
from pipeline.report.temperature.answers import CONTROLLERS, LABELS, noise
from pipeline.statistics import Paired, paired

LEVEL = 0.05
# what makes two runs the same case
CASE = ["plant", "start_degC", "reference_degC", "seed"]
# what is compared: column of the scorecard, and what makes a cost above zero of it
COSTS = (
    # J / J*, of which J* is the same for both
    ("Cost on the yardstick, unclipped", lambda runs: 1.0 + runs["regret"]),
    ("R.m.s. tracking error, as deployed", lambda runs: runs["tracking_degC"]),
)


class Saving(NamedTuple):
    """What the data-driven controller saves, with its band, the chance of it, and on how many cases."""

    saved: str
    band: str
    p: str
    cases: str
    sure: bool


class Against(NamedTuple):
    """A row of the page: which controller, which cost, and what is saved against it."""

    name: str
    title: str
    what: str
    saving: Saving


class Comparison(NamedTuple):
    missing: Missing | None
    rows: list[Against]
    finding: str


def compared(sources: Sources) -> Comparison:
    """A row for each of the others and each cost; every case is one plant, start,
    reference and seed, and cases of a plant are one block."""
    table = sources.tables["scorecard"]
    if isinstance(table, Missing):
        return Comparison(table, [], "")
    mine, level = CONTROLLERS["data_driven"], noise(sources)
    rows, sentences = [], []
    for name in (name for name in LABELS if name != mine):
        for what, cost in COSTS:
            pair = _paired(table, name, mine, level, cost)
            if pair is None:
                continue
            rows.append(Against(name, LABELS[name][0], what, _saving(pair)))
            if name == CONTROLLERS["model_based"]:
                sentences.append(_sentence(what, pair))
    gap = None if rows else Missing("not measured", "no two controllers ran the same cases with finite costs")
    return Comparison(gap, rows, " ".join(sentences))


def _paired(
    table: Table, other: str, mine: str, level: float, cost: Callable[[pd.DataFrame], pd.Series]
) -> Paired | None:
    """Costs of the two, case by case; None where one of them lost a run, or ran other cases."""
    runs = pd.DataFrame(table)
    runs = runs[runs["controller"].isin([other, mine]) & (runs["noise_degC"] == level)]
    costs = cost(runs).groupby([runs[key] for key in [*CASE, "controller"]]).mean().unstack("controller")
    if not {other, mine} <= set(costs) or not (np.isfinite(costs) & (costs > 0)).all(axis=None):
        return None
    blocks = [f"{plant:g}" for plant in costs.index.get_level_values("plant")]
    # the draws are for more blocks than all signs can be tried of; a fixed generator keeps the page the same
    return paired(costs[other].to_numpy(), costs[mine].to_numpy(), blocks, rng=np.random.default_rng(0))


# a saving of more than this is against one that costs beyond 1,000 % more, as an unstable one does
MOST = 100.0 - 100.0 / (1.0 + LARGEST["%"] / 100.0)


def _apart(pair: Paired) -> bool:
    """Whether the costs lie so far apart that their ratio is no measure, as of an unstable one."""
    return not -LARGEST["%"] <= pair.improvement_percent <= MOST


def _saving(pair: Paired) -> Saving:
    word = "less" if pair.improvement_percent >= 0 else "more"
    chance = min(pair.p, 1 - pair.p)
    saved = f"{short(abs(pair.improvement_percent), 2)}{THIN}% {word}"
    ends = f"{_signed(pair.low_percent)} to {_signed(pair.high_percent)}"
    return Saving(
        saved=f"{word}: beyond {number(LARGEST['%'], 0)}{THIN}% apart" if _apart(pair) else saved,
        band="none" if _apart(pair) else ends,
        p=f"{short(chance, 2)}" if chance >= 1e-4 else "< 0.0001",
        cases=f"{number(pair.cases, 0)} on {count(pair.blocks, 'plant')}",
        sure=chance < LEVEL,
    )


def _signed(percent: float) -> str:
    """Positive: the data-driven one costs less."""
    text = short(abs(percent), 2)
    return f"−{text}" if percent < 0 and text != "0" else text


def _sentence(what: str, pair: Paired) -> str:
    saving = _saving(pair)
    name = what.split(",")[0]
    if _apart(pair):
        word, most = saving.saved.split(":")[0], number(LARGEST["%"], 0)
        return f"{name}: data-driven has {word} than model-based, beyond {most}{THIN}% apart."
    if not saving.sure:
        return (
            f"{name}: no difference beyond chance between data-driven and model-based ({saving.saved}, p = "
            f"{saving.p})."
        )
    return (
        f"{name}: on the same {saving.cases} data-driven has {saving.saved} than model-based (90{THIN}% "
        f"interval {saving.band}{THIN}%)."
    )
