"""Finds the figures of each controller of the temperature loop that its rules need, in the figures of the
stages. They are for the controller as deployed, over all plants, at the 90 % quantile with the band of that
quantile."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.verdict.controllers import BY_NAME, YARDSTICKS, heading
from pipeline.verdict.digits import number
from pipeline.verdict.evidence import Figures, entry, gap_of, need, or_gap
from pipeline.verdict.rules import at_path, rows
from pipeline.verdict.verdict import OPEN, Figure, Missing, count_of

LOOP = "temperature"
# of the engineering cost; the spread of the judged plants changes the cost by more
ALLOWED_PERCENT = 10.0
REPEAT = "Run ./run dvc repro evaluate_temperature"
# figures of the scorecard with median and quantile
QUANTILES = (
    "settled_error",
    "peak",
    "settling",
    "heating",
    "overshoot",
    "at_limits",
    "energy",
    "travel",
    "dip",
    "cost",
)


def comparison(figures: Figures) -> Mapping[str, Any]:
    """Returns the figures of the comparison, with those that the stage `verdict` computes from the limits; {}
    if there are none."""
    compared, judged = figures.get("evaluate_temperature"), entry(figures.get("verdict"), "comparison")
    return {**compared, **(judged or {})} if isinstance(compared, Mapping) else {}


def names(figures: Figures) -> list[str]:
    """Returns the controllers with figures, in the declared order of simplicity, the reference last."""
    compared = comparison(figures)
    listed = list(entry(compared, "contestants") or {})
    ordered = [name for name in entry(compared, "order") or BY_NAME if name in listed]
    return sorted(dict.fromkeys([*ordered, *listed]), key=lambda name: name in YARDSTICKS)


def refused(figures: Figures) -> dict[str, str]:
    """Returns why controllers could not take part, by name."""
    judged, learned = (
        entry(comparison(figures), "refused"),
        entry(figures.get("learn_kernel"), "undetermined"),
    )
    standing = entry(comparison(figures), "contestants") or {}
    undetermined = {name: why for name, why in (learned or {}).items() if name not in standing}
    return {name: str(why) for name, why in {**(judged or {}), **undetermined}.items()}


def finite(value: Any) -> float:
    """Returns a number of the metrics. null, and anything that is not a number, gives infinity."""
    numeric = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if numeric and math.isfinite(value) else math.inf


def quantile(figures: Any) -> Figure | None:
    """Returns the 90 % quantile with its band; None if the figure does not exist."""
    if not isinstance(figures, Mapping) or "q90" not in figures:
        return None
    value = finite(figures["q90"])
    low, high = (finite(figures.get(end, figures["q90"])) for end in ("low", "high"))
    return Figure(value, min(low, value), max(high, value))


def of_controller(figures: Figures, name: str, undeclared: Sequence[str] = ()) -> dict[str, Figure | Missing]:
    """Returns {key: figure} of one controller. `undeclared`: outputs without low and high. Raises ValueError
    if a row of rules.toml has the key of a figure of the page."""
    own = entry(comparison(figures), "contestants", name)
    by_path = {key: row for key, row in rows(LOOP).items() if "." in row.figure}
    if taken := [
        key for key in (*QUANTILES, "disk", "delay_s", "crossings", "supervisor", "data") if key in by_path
    ]:
        raise ValueError(
            f"rules.toml: [{LOOP}.{taken[0]}] has the key of a figure of the page; give the row another key"
        )
    if own is None:
        keys = (*QUANTILES, "disk", "delay_s", "crossings", "supervisor", *by_path)
        return dict.fromkeys(keys, _without(figures, name)) | {"data": data(figures, name)}
    gap = Missing(OPEN, "This figure is not in the scorecard", REPEAT)
    return {
        **{key: quantile(entry(own, key)) or gap for key in QUANTILES},
        **{key: _margin(own, key) or _without_margin(own, gap) for key in ("disk", "delay_s")},
        **{
            key: at_path(figures, row.figure.format(controller=name), at_least=row.at_least is not None)
            for key, row in by_path.items()
        },
        "crossings": crossings(own, undeclared),
        "supervisor": false_stops(own),
        "data": data(figures, name),
    }


def _without(figures: Figures, name: str) -> Missing:
    """Returns why a controller has no figures: it was refused, or nothing was measured."""
    compared = figures.get("evaluate_temperature")
    if reason := refused(figures).get(name):
        return Missing("failed", reason)
    return gap_of(compared) or Missing(OPEN, f"{heading(name)} is not among what the stage measured", REPEAT)


def unstable(figures: Any) -> tuple[int, int]:
    """Returns (number of plants that the controller does not keep stable, number of plants)."""
    stable, of = (entry(figures, "stable", key) for key in ("count", "of"))
    return (of - stable, of) if isinstance(stable, int) and isinstance(of, int) else (0, 0)


def _margin(figures: Any, key: str) -> Figure | None:
    """Returns the margin below which a tenth of all plants lie; 0 if the loop of any plant is unstable, None
    if it was not measured. The worst plant is not used: the spread of the test set already includes gain,
    speed and delay, so the same uncertainty would count twice."""
    margin = entry(figures, "margins", key)
    if not isinstance(margin, Mapping) or "q10" not in margin:
        return None
    return count_of(0.0 if unstable(figures)[0] else finite(margin["q10"]))


def _without_margin(figures: Mapping[str, Any], gap: Missing) -> Missing:
    """Returns the reason why there is no margin. A controller that closes no loop has no margin to lose."""
    if "margins" in figures and figures["margins"] is None:
        return Missing("not applicable", "it closes no loop")
    return gap


def crossings(figures: Any, undeclared: Sequence[str] = ()) -> Figure | Missing:
    """Returns the number of cases in which a true output leaves its declared low or high."""
    if undeclared:
        names = ", ".join(undeclared)
        return Missing(
            OPEN,
            f"low and high of {names} are not declared",
            "Declare low and high below plant.outputs in params.yaml",
        )
    cases, of = (entry(figures, "crossings", key) for key in ("cases", "of"))
    if not isinstance(cases, int):
        return Missing(OPEN, "Crossings of the outputs’ limits are not in the scorecard", REPEAT)
    return count_of(float(cases))._replace(note=f"of {number(finite(of), 0)} cases")


def false_stops(figures: Any) -> Figure | Missing:
    """Returns the number of cases on healthy machines in which the supervisor stops using the controller."""
    found = entry(figures, "supervised")
    if isinstance(figures, Mapping) and "supervised" in figures and found is None:
        return Missing("not applicable", "it has no supervisor")
    left, of = (entry(found, key) for key in ("left", "cases"))
    if not isinstance(left, int):
        return Missing(OPEN, "What its supervisor does on healthy machines is not in the scorecard", REPEAT)
    return count_of(float(left))._replace(note=f"of {number(finite(of), 0)} cases")


# ---- the data


def data(figures: Figures, name: str) -> Figure | Missing:
    """Returns the samples of the record divided by those that a controller needs. The needed samples are
    those at which its estimator's uncertainty costs no more in closed loop than
    `learn_kernel.allowed_gap_percent` of the quadratic cost, or ALLOWED_PERCENT of the engineering cost. The
    extra cost falls as one over the samples. Undecided if the identified plant is not good enough to judge
    by."""
    learned, compared = figures.get("learn_kernel"), figures.get("evaluate_temperature")
    learned_from = BY_NAME[name].learned_from if name in BY_NAME else "plant"
    allowed = entry(learned, "allowed_gap_percent")
    if learned_from == "kernel":
        if entry(learned, "refused") and entry(learned, "samples_needed") is None:
            return Missing("failed", str(entry(learned, "refused")))
        gap = entry(learned, "candidates", entry(learned, "state") or "", "gap_on_window_model_percent")
        needed = [entry(learned, "samples_needed"), _for_gap(entry(learned, "samples"), gap, allowed)]
        return _of(learned, entry(learned, "samples"), max((n for n in needed if n), default=None))
    if learned_from == "trajectories":
        if reason := entry(learned, "predictive", "refused"):
            return Missing("failed", str(reason))
        own = entry(learned, "predictive")
        return _of(learned, entry(own, "samples"), entry(own, "samples_needed"))
    if learned_from == "window":
        return _of(learned, entry(learned, "samples"), entry(learned, "samples_needed_for_noise"))
    if learned_from == "plant":
        model, excess = figures.get("identify_plant"), entry(compared, "redesigned", name, "excess_percent")
        rows = entry(model, "rows")
        return _no_plant(model) or _of(model, rows, _for_gap(rows, excess, ALLOWED_PERCENT))
    if name in BY_NAME and BY_NAME[name].kind in ("model-based", "data-driven"):
        return Missing(OPEN, f"the row of {heading(name)} in controllers/table.py has no learned_from")
    return Missing("not applicable", f"{heading(name)} learns nothing from the record")


def _for_gap(samples: Any, excess: Any, allowed: Any) -> int | None:
    """Returns the number of samples at which an extra cost in percent falls to the allowed one."""
    if samples is None or excess is None or not allowed:
        return None
    return max(math.ceil(samples * excess / allowed), 1)


def _no_plant(model: Any) -> Missing | None:
    """Returns why an identified plant cannot be used to judge a record: its predictions are too poor, or a
    heater cools in it. Its bands then describe a wrong plant, and their width says nothing."""
    least = rows("identification")["ahead"].at_least
    ends = entry(model, "fit_holdout_ahead_band") or {}
    poor = [output for output, (_, high) in ends.items() if high < least]
    longer = "Record twice as long, or run the experiment in datasets/generate_probing"
    if poor:
        fit = number(entry(model, "fit_holdout_ahead", poor[0]), 0)
        return Missing(OPEN, f"{poor[0]} is predicted with a fit of {fit} % (limit {least:g} %)", longer)
    certain = [gain for gain in entry(model, "forbidden_gains") or () if gain["certain"]]
    if certain:
        gain = certain[0]
        return Missing(OPEN, f"{gain['input']} on {gain['output']} is {gain['reason']}", longer)
    return None


@or_gap
def _of(stage: Any, samples: Any, needed: Any) -> Figure | Missing:
    need(stage)
    if samples is None or not needed:
        return Missing(OPEN, "the number of samples that are needed is not known")
    ratio, more = samples / needed, max(needed - samples, 0)
    return count_of(ratio)._replace(
        note=f"{number(samples, 0)} of {number(needed, 0)} samples"
        + (f"; record {number(more, 0)} more" if more else "")
    )
