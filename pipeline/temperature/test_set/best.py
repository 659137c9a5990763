"""Chooses the best controller of the temperature loop from the costs of all cases and the limits of section
`report`, and whether it is still the best without the plant that decides. The comparison itself has no
limits."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.temperature.test_set.scorecard import chosen

# limits that a simulation of the temperature loop can check
CHECKED = (
    "settled_error_degC",
    "peak_error_degC",
    "settling_s",
    "heating_s",
    "overshoot_degC",
    "at_limits_percent",
    "disk_margin",
    "delay_margin_s",
)
# pairs of controllers of one structure: if both pass, only the one with the larger margins may be best
SAME_STRUCTURE = (("pi_simc", "pi"),)


def best_by_limits(
    compared: Mapping[str, Any], table: Mapping[str, np.ndarray], declared: Mapping[str, Any], seed: int
) -> dict[str, Any]:
    """Returns those figures of evaluate_temperature that depend on the limits: `limits`, `best`,
    `best_reason`, `deciding` with the best controller without that plant, and `bears_less`: {name: the more
    robust controller of the same structure}.

    `table` has the cases, one row per controller and case; `declared` has the limits of section `report`.
    """
    order, limits = compared["order"], limits_of(compared["pace"], declared)
    able = {name: passes(compared["contestants"][name], limits) for name in order}
    known = {name: compared["contestants"][name]["margins"] is not None for name in order}
    weaker = {fragile(pair, compared["contestants"], known): pair for pair in SAME_STRUCTURE}
    bears_less = {name: pair[1 - pair.index(name)] for name, pair in weaker.items() if name}
    eligible = {name: held and not able.get(bears_less.get(name, ""), False) for name, held in able.items()}
    rows = {name: table["contestant"] == name for name in order}
    # a missing cost is infinite
    costs = {
        name: np.where(np.isnan(table["cost"][at]), np.inf, table["cost"][at]) for name, at in rows.items()
    }
    plant = table["plant"][rows[order[0]]]
    rest = plant != compared["deciding"]["plant"]
    best, nearest, against = chosen(costs, plant, eligible, seed=seed)
    others = {name: values[rest] for name, values in costs.items()}
    reason = {
        "passes": able,
        "leading": chosen(costs, plant, dict.fromkeys(order, True), seed=seed)[0],
        "nearest": nearest,
        "improvement_percent": against.improvement_percent if against else None,
        "p": against.p if against else None,
    }
    without = chosen(others, plant[rest], eligible, seed=seed)[0]
    deciding = {**compared["deciding"], "best_without": without}
    return {
        "limits": limits,
        "best": best,
        "best_reason": reason,
        "deciding": deciding,
        "bears_less": bears_less,
    }


def fragile(pair: tuple[str, str], figures: Mapping[str, Any], able: Mapping[str, bool]) -> str:
    """Returns the less robust of two controllers of one structure that both pass; "" if not both pass.
    Margins are compared at the 10 % quantile over the plants. The less robust controller has the smaller
    ratio of its margin to the other's."""
    if not all(able.get(name, False) for name in pair):
        return ""
    ends = [figures[name]["margins"] for name in pair]
    ratios = [
        (one[key]["q10"] or np.inf) / (other[key]["q10"] or np.inf)
        for one, other in (ends, ends[::-1])
        for key in ("disk", "delay_s")
    ]
    ratios = np.nan_to_num(ratios, nan=1.0)
    return pair[0] if ratios[:2].min() < ratios[2:].min() else pair[1]


def limits_of(pace: Mapping[str, Any], declared: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the limits for this machine. `pace` has the settling time that counts if none is declared, the
    shortest time from cold, which is added to it for heating up, the share of the declared delay margin that
    is required of a fast machine, and in words where they come from."""
    settling_s = declared["settling_s"] or pace["settling_s"]
    return {name: declared[name] for name in CHECKED} | {
        "settling_s": settling_s,
        "heating_s": declared["heating_s"] or settling_s + pace.get("heat_up_s", 0.0),
        "delay_margin_s": pace["delay_margin_share"] * declared["delay_margin_s"],
        "source": pace["source"],
    }


def passes(figures: Mapping[str, Any], limits: Mapping[str, Any]) -> bool:
    """Returns whether a controller passes the limits that a simulation can check: its figures at the 90 %
    quantile over all cases, stability on every plant, its margins, if it has any, at the 10 % quantile over
    the plants, and no crossing of the output limits in any case."""
    quantiles = {
        "settled_error": limits["settled_error_degC"],
        "peak": limits["peak_error_degC"],
        "settling": limits["settling_s"],
        "heating": limits["heating_s"],
        "overshoot": limits["overshoot_degC"],
        "at_limits": limits["at_limits_percent"],
    }
    held = all(
        figures[name]["q90"] is not None and figures[name]["q90"] <= limit
        for name, limit in quantiles.items()
    )
    margins, stable = figures["margins"], figures["stable"]
    robust = margins is None or (
        stable["count"] == stable["of"]
        and (margins["disk"]["q10"] or 0.0) >= limits["disk_margin"]
        and (margins["delay_s"]["q10"] is None or margins["delay_s"]["q10"] >= limits["delay_margin_s"])
    )
    return held and robust and figures["crossings"]["cases"] == 0
