"""Two controllers on the very same cases: what the data-driven one saves against each of the others, with a
sign-flip test over plants (pipeline/statistics.py)."""

from typing import Any

import numpy as np

from pipeline.report.shared.digits import THIN, count, number, short
from pipeline.report.shared.pictures import ORDER
from pipeline.report.shared.sources import Sources, Table
from pipeline.report.shared.verdict import Missing
from pipeline.report.temperature.answers import CONTROLLERS, LABELS, noise
from pipeline.statistics import Paired, paired

LEVEL = 0.05
# what is compared: column of the scorecard, and what makes a cost above zero of it
COSTS = (
    (
        "Cost on the yardstick, unclipped",
        lambda table, rows: 1.0 + table["regret"][rows],
    ),  # J / J*, of which J* is the same for both
    ("R.m.s. tracking error, as deployed", lambda table, rows: table["tracking_degC"][rows]),
)


def compared(sources: Sources) -> dict[str, Any]:
    """A row for each of the others and each cost; every case is one plant, start,
    reference and seed, and cases of a plant are one block."""
    table = sources.tables["scorecard"]
    if isinstance(table, Missing):
        return {"missing": table, "rows": [], "finding": ""}
    mine, level = CONTROLLERS["data_driven"], noise(sources)
    rows, sentences = [], []
    for name in (name for name in ORDER if name != mine):
        for what, cost in COSTS:
            pair = _paired(table, name, mine, level, cost)
            if pair is None:
                continue
            rows.append({"name": name, "title": LABELS[name][0], "what": what, **_row(pair)})
            if name == CONTROLLERS["model_based"]:
                sentences.append(_sentence(what, pair))
    gap = None if rows else Missing("not measured", "no two controllers ran the same cases with finite costs")
    return {"missing": gap, "rows": rows, "finding": " ".join(sentences)}


def _paired(table: Table, other: str, mine: str, level: float, cost: Any) -> Paired | None:
    """Costs of the two in the same order of cases; None where one of them lost a run, or ran other cases."""
    rows = {name: (table["controller"] == name) & (table["noise_degC"] == level) for name in (other, mine)}
    cases = {
        name: np.column_stack(
            [table[key][one].astype(float) for key in ("plant", "start_degC", "reference_degC", "seed")]
        )
        for name, one in rows.items()
    }
    if (
        not len(cases[mine])
        or cases[mine].shape != cases[other].shape
        or not (cases[mine] == cases[other]).all()
    ):
        return None
    theirs, ours = (np.asarray(cost(table, rows[name]), float) for name in (other, mine))
    if not (
        np.isfinite(theirs).all() and np.isfinite(ours).all() and (theirs > 0).all() and (ours > 0).all()
    ):
        return None
    blocks = [f"{plant:g}" for plant in cases[mine][:, 0]]
    # the draws are for more blocks than all signs can be tried of; a fixed generator keeps the page the same
    return paired(theirs, ours, blocks, rng=np.random.default_rng(0))


def _row(pair: Paired) -> dict[str, Any]:
    word = "less" if pair.improvement_percent >= 0 else "more"
    chance = min(pair.p, 1 - pair.p)
    return {
        "saved": f"{short(abs(pair.improvement_percent), 2)}{THIN}% {word}",
        "band": f"{_signed(pair.low_percent)} to {_signed(pair.high_percent)}",
        "p": f"{short(chance, 2)}" if chance >= 1e-4 else "< 0.0001",
        "cases": f"{number(pair.cases, 0)} on {count(pair.blocks, 'plant')}",
        "sure": chance < LEVEL,
    }


def _signed(percent: float) -> str:
    """Positive: the data-driven one costs less."""
    text = short(abs(percent), 2)
    return f"−{text}" if percent < 0 and text != "0" else text


def _sentence(what: str, pair: Paired) -> str:
    row = _row(pair)
    name = what.split(",")[0]
    if not row["sure"]:
        return (
            f"{name}: no difference beyond chance between data-driven and model-based ({row['saved']}, p = "
            f"{row['p']})."
        )
    return (
        f"{name}: on the same {row['cases']} data-driven has {row['saved']} than model-based (90{THIN}% "
        f"interval {row['band']}{THIN}%)."
    )
