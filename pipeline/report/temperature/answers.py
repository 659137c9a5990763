"""Metrics of the stages -> the figures of each contestant that the rules are asked of: as deployed, over all
plants, at the 90 % quantile with the band of that quantile. No page, no file."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.report.temperature.contestants import BY_NAME, YARDSTICKS, heading
from pipeline.verdict.digits import number
from pipeline.verdict.verdict import OPEN, Figure, Missing

Metrics = Mapping[str, Any]  # {stage: its metrics, or why there are none}
REPEAT = "Run ./run dvc repro evaluate_temperature"
# figures of the scorecard that come as median and quantile
QUANTILES = ("settled_error", "settling", "overshoot", "at_limits", "energy", "cost")


def entry(data: Any, *names: str) -> Any:
    """data[name][name]...; None where any of them is not there."""
    for name in names:
        data = data.get(name) if isinstance(data, Mapping) else None
    return data


def comparison(metrics: Metrics) -> Mapping[str, Any]:
    """The metrics of the comparison; {} where there are none."""
    compared = metrics.get("evaluate_temperature")
    return compared if isinstance(compared, Mapping) else {}


def judged(metrics: Metrics) -> list[str]:
    """Contestants with figures, in the declared order of simplicity, the yardstick last."""
    compared = comparison(metrics)
    names = list(entry(compared, "contestants") or {})
    declared = [name for name in entry(compared, "order") or BY_NAME if name in names]
    listed = [*declared, *(name for name in names if name not in declared)]
    return [name for name in listed if name not in YARDSTICKS] + [n for n in listed if n in YARDSTICKS]


def refused(metrics: Metrics) -> dict[str, str]:
    """Why contestants could not take part, by name."""
    reasons = {name: str(why) for name, why in (entry(comparison(metrics), "refused") or {}).items()}
    kernel = entry(metrics.get("learn_kernel"), "refused")
    if kernel and "learned_kernel" not in (entry(comparison(metrics), "contestants") or {}):
        reasons.setdefault("learned_kernel", str(kernel))
    return reasons


def finite(value: Any) -> float:
    """A number of the metrics; null, and what is no number, is without end."""
    numeric = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if numeric and math.isfinite(value) else math.inf


def quantile(figures: Any) -> Figure | None:
    """The 90 % quantile with its band; None where the figure is not there."""
    if not isinstance(figures, Mapping) or "q90" not in figures:
        return None
    value = finite(figures["q90"])
    low, high = (finite(figures.get(end, figures["q90"])) for end in ("low", "high"))
    return Figure(value, min(low, value), max(high, value))


def of_contestant(metrics: Metrics, name: str, undeclared: Sequence[str] = ()) -> dict[str, Figure | Missing]:
    """{key: figure} of one contestant; `undeclared` are outputs without low and high."""
    figures = entry(comparison(metrics), "contestants", name)
    if figures is None:
        gap = _without(metrics, name)
        keys = (*QUANTILES, "disk", "delay_s", "crossings")
        return dict.fromkeys(keys, gap) | {"data": data(metrics, name)}
    gap = Missing(OPEN, "This figure is not in the scorecard", REPEAT)
    return {
        **{key: quantile(entry(figures, key)) or gap for key in QUANTILES},
        **{key: _margin(figures, key) or _without_margin(figures, gap) for key in ("disk", "delay_s")},
        "crossings": crossings(figures, undeclared),
        "data": data(metrics, name),
    }


def _without(metrics: Metrics, name: str) -> Missing:
    """Why a contestant has no figures: refused, or nothing was measured."""
    compared = metrics.get("evaluate_temperature")
    if reason := refused(metrics).get(name):
        return Missing("failed", reason)
    if isinstance(compared, Missing):
        return compared
    return Missing(OPEN, f"{heading(name)} is not among what the stage measured", REPEAT)


def unstable(figures: Any) -> tuple[int, int]:
    """(plants that a contestant does not hold stable, plants)."""
    stable, of = (entry(figures, "stable", key) for key in ("count", "of"))
    return (of - stable, of) if isinstance(stable, int) and isinstance(of, int) else (0, 0)


def _margin(figures: Any, key: str) -> Figure | None:
    """A margin of the median plant; none where a plant's loop is unstable. The panel's spread has gain, speed
    and delay in it: a margin on its worst plant would ask for the same doubt twice."""
    margin = entry(figures, "margins", key)
    if not isinstance(margin, Mapping) or "median" not in margin:
        return None
    median = 0.0 if unstable(figures)[0] else finite(margin["median"])
    return Figure(median, median, median)


def _without_margin(figures: Mapping[str, Any], gap: Missing) -> Missing:
    """A contestant that closes no loop has no margin to lose."""
    if "margins" in figures and figures["margins"] is None:
        return Missing("not applicable", "it closes no loop")
    return gap


def crossings(figures: Any, undeclared: Sequence[str] = ()) -> Figure | Missing:
    """Cases in which a true output leaves its declared low or high."""
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
    return Figure(float(cases), float(cases), float(cases), note=f"of {number(finite(of), 0)} cases")


# ---- the data


def data(metrics: Metrics, name: str) -> Figure | Missing:
    """Samples of the record over the samples that a contestant needs: for its noise, and for its unknowns."""
    learned = metrics.get("learn_kernel")
    learned_from = BY_NAME[name].learned_from if name in BY_NAME else "plant"
    if learned_from == "kernel":
        if entry(learned, "refused") and entry(learned, "samples_needed") is None:
            return Missing("failed", str(entry(learned, "refused")))
        return _of(learned, entry(learned, "samples"), entry(learned, "samples_needed"))
    if learned_from == "window":
        noise, past = entry(learned, "samples_needed_for_noise"), entry(learned, "window")
        needed = None if noise is None or past is None else max(noise, _unknowns(metrics, past))
        return _of(learned, entry(learned, "samples"), needed)
    if learned_from == "plant":
        return _model_data(metrics)
    return Missing("not applicable", f"{heading(name)} learns nothing from the record")


def _unknowns(metrics: Metrics, past: int) -> int:
    """Unknowns of one output's regression on `past` samples of every signal and a constant."""
    model = metrics.get("identify_plant")
    return past * sum(len(entry(model, key) or ()) for key in ("delays", "fit_holdout")) + 1


def _model_data(metrics: Metrics) -> Figure | Missing:
    """The model has fewer unknowns than the window, so that noise asks no more of it; its
    own first step, a long VARX, asks for its unknowns."""
    model = metrics.get("identify_plant")
    past, needed = entry(model, "past"), entry(model, "samples_needed")
    noise = entry(metrics.get("learn_kernel"), "samples_needed_for_noise")
    if needed is None and past is not None and noise is not None:
        needed = max(noise, _unknowns(metrics, past))
    return _of(model, entry(model, "rows"), needed)


def _of(stage: Any, samples: Any, needed: Any) -> Figure | Missing:
    if isinstance(stage, Missing):
        return stage
    if samples is None or not needed:
        return Missing(OPEN, "the number of samples that are needed is not known")
    ratio, more = samples / needed, max(needed - samples, 0)
    note = f"{number(samples, 0)} of {number(needed, 0)} samples" + (
        f"; record {number(more, 0)} more" if more else ""
    )
    return Figure(ratio, ratio, ratio, note=note)
