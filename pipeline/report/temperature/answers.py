"""Artifacts -> the answers of page one: median and 90 % band of each figure, for each controller."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from pipeline.report.shared.digits import DASH, number
from pipeline.report.shared.sources import Sources, Table, lookup
from pipeline.report.shared.verdict import ROLES, Figure, Missing, Question
from pipeline.temperature.workflow.contestants import CONTESTANTS

# role on page one -> the controller's name in the artifacts
CONTROLLERS = {
    role: next(contestant.name for contestant in CONTESTANTS if contestant.role == role) for role in ROLES
}
# controllers in the order of the pages, each with heading and method
LABELS = {contestant.name: (contestant.heading, contestant.method) for contestant in CONTESTANTS}
# shown beside the others, never the best of them
YARDSTICKS = {contestant.name for contestant in CONTESTANTS if contestant.role == "yardstick"}
LEARNED_FROM = {contestant.name: contestant.learned_from for contestant in CONTESTANTS}
RUNS = {
    "gap_percent": ("regret", 100.0),
    "settled_error_degC": ("settled_error_degC", 1.0),
    "settling_s": ("settling_s", 1.0),
    "overshoot_degC": ("overshoot_degC", 1.0),
    "at_limits_percent": ("at_limits_percent", 1.0),
}


def all_answers(sources: Sources, asked: list[Question]) -> dict[str, dict[str, Figure | Missing]]:
    """{controller: {key: figure}} of every controller that was judged,
    and of the three roles whether they were or not."""
    judged = lookup(sources.metrics["evaluate_temperature"], "controllers", what="the scorecard")
    names = list(dict.fromkeys([*CONTROLLERS.values(), *([] if isinstance(judged, Missing) else judged)]))
    return {
        name: {question.key: _answer(sources, judged, name, question) for question in asked} for name in names
    }


def without_figures(sources: Sources, name: str) -> Missing | None:
    """Why a controller has no figures. None where it could not take part: nobody knows the true plant.

    The kernel's place stays where the record does not determine one.
    """
    refused = lookup(sources.metrics["evaluate_temperature"], f"refused.{name}")
    if isinstance(refused, Missing) and LEARNED_FROM[name] == "kernel":
        refused = lookup(sources.metrics["learn_kernel"], "refused")
        if isinstance(refused, Missing):
            return Missing("not measured", "there is no kernel", "Run ./run dvc repro learn_kernel")
    return None if isinstance(refused, Missing) else Missing("failed", str(refused))


def aimed_unclipped(sources: Sources, where: str) -> str:
    """ "Baseline has no feed-forward of its own and aims at the feasible target here too."; empty where every
    controller has its own."""
    listed = lookup(sources.metrics["evaluate_temperature"], "without_feed_forward")
    names = [] if isinstance(listed, Missing) else [LABELS[name][0] for name in LABELS if name in listed]
    if not names:
        return ""
    *others, last = names
    if others:
        every = f"{', '.join(others)} and {last}"
        return f"{every} have no feed-forward of their own and aim at the feasible target {where} too."
    return f"{last} has no feed-forward of its own and aims at the feasible target {where} too."


def own_integral(sources: Sources) -> str:
    """ " (Baseline: its own)" where some controller's integral action is not the declared one; empty where
    all have that."""
    shares = lookup(sources.metrics["evaluate_temperature"], "own_integral")
    if isinstance(shares, Missing):
        return ""
    own = [f"{LABELS[name][0]}: {'its own' if shares[name] else 'none'}" for name in LABELS if name in shares]
    return f" ({'; '.join(own)})" if own else ""


def _answer(sources: Sources, judged: Any, name: str, question: Question) -> Figure | Missing:
    if question.key == "data":
        return _data(sources, name)
    of_controller = lookup(judged, name, what=f"{LABELS.get(name, (name,))[0]}")
    if isinstance(of_controller, Missing):
        return without_figures(sources, name) or of_controller
    if question.key == "worst_case_gap_percent":
        return worst_case(sources.tables["scorecard"], name, noise(sources), of_controller.get("gap_percent"))
    figures = of_controller.get(question.key)
    if figures is None:
        return Missing(
            "not measured",
            f"{question.title} is not in the scorecard",
            "Run ./run dvc repro evaluate_temperature",
        )
    note = _zone(sources, figures) if question.key == "settled_error_degC" else ""
    return Figure(
        *(_finite(figures.get(end)) for end in ("median", "low", "high")),
        runs=_runs(sources, name, question.key),
        note=note,
    )


def _finite(value: float | None) -> float:
    return math.inf if value is None else float(value)


def _zone(sources: Sources, figures: Mapping) -> str:
    zone = figures.get("zone")
    return sources.zone(zone) if isinstance(zone, int) else f"zone {zone}" if zone else ""


def noise(sources: Sources) -> float:
    """The noise level that the figures were judged at, in °C."""
    level = lookup(sources.tables["summary"], "noise_degC")
    if not isinstance(level, Missing):
        return level
    return sources.declared.everything.get("evaluate_temperature", {}).get(
        "report_noise_degC", sources.declared.panel.noise_degC[0]
    )


def _mine(table: Table, name: str, noise: float) -> np.ndarray:
    return (table["controller"] == name) & (table["noise_degC"] == noise)


def _runs(sources: Sources, name: str, key: str) -> tuple[float, ...]:
    """The repetitions on the nominal plant, a run that never settles as infinity."""
    table = sources.tables["scorecard"]
    if isinstance(table, Missing) or key not in RUNS:
        return ()
    column, factor = RUNS[key]
    values = factor * table[column][_mine(table, name, noise(sources)) & (table["plant"] == 0)]
    return tuple(np.where(np.isnan(values), math.inf, values).tolist())


def worst_case(table: Table | Missing, name: str, noise: float, summary: Mapping | None) -> Figure | Missing:
    """The largest gap over plants, starts and references, in percent;
    its band is over the seeds of the noise."""
    if isinstance(table, Missing):
        worst = (summary or {}).get("worst")
        return table if worst is None else Figure(worst, worst, worst)
    runs = pd.DataFrame(table)[_mine(table, name, noise)]
    if runs.empty:
        return Missing("not measured", f"the scorecard has no run of {name} at {noise:g} °C of noise")
    gap = 100.0 * runs["regret"].fillna(math.inf)
    worst = gap.groupby(runs["seed"]).max().to_numpy()
    low, value, high = np.quantile(worst, [0.05, 0.5, 0.95], method="nearest")
    return Figure(
        float(value), float(low), float(high), tuple(worst.tolist()), f"{runs['plant'].nunique()} plants"
    )


def _data(sources: Sources, name: str) -> Figure | Missing:
    """Samples of the record over the samples that a controller needs: for its noise, and for its unknowns."""
    learned, machine = sources.metrics["learn_kernel"], sources.declared.machine
    learned_from = LEARNED_FROM.get(name, "")
    if learned_from == "kernel":
        needed, samples = lookup(learned, "samples_needed"), lookup(learned, "samples")
        if isinstance(needed, Missing) and isinstance(learned, dict) and learned.get("refused"):
            return Missing("failed", str(learned["refused"]))
        return _of(samples, needed)
    if learned_from == "window":
        samples, noise, past = (
            lookup(learned, key) for key in ("samples", "samples_needed_for_noise", "window")
        )
        missing = next((part for part in (samples, noise, past) if isinstance(part, Missing)), None)
        unknowns = 0 if missing else past * (len(machine.inputs) + len(machine.outputs)) + 1
        return missing or _of(samples, max(noise, unknowns))
    if learned_from == "plant":
        return _model_data(sources)
    return Missing("not applicable", f"{LABELS.get(name, (name,))[0]} learns nothing from the record")


def _model_data(sources: Sources) -> Figure | Missing:
    """The model has fewer unknowns than the window, so that noise asks no more of it; its
    own first step, a long VARX, asks for its unknowns.
    """
    identified, machine = sources.metrics["identify_plant"], sources.declared.machine
    samples, past = lookup(identified, "rows"), lookup(identified, "past")
    needed = lookup(identified, "samples_needed")
    if isinstance(needed, Missing) and not isinstance(past, Missing):
        noise = lookup(sources.metrics["learn_kernel"], "samples_needed_for_noise")
        needed = (
            noise
            if isinstance(noise, Missing)
            else max(noise, past * (len(machine.inputs) + len(machine.outputs)) + 1)
        )
    return _of(samples, needed)


def _of(samples: Any, needed: Any) -> Figure | Missing:
    missing = next((part for part in (samples, needed) if isinstance(part, Missing)), None)
    if missing or not needed:
        return missing or Missing("not measured", "the number of samples that are needed is not known")
    ratio, more = samples / needed, max(needed - samples, 0)
    note = f"{number(samples, 0)} of {number(needed, 0)}" + (
        f" samples; record {number(more, 0)} more." if more else ""
    )
    return Figure(ratio, ratio, ratio, note=note)


def repetitions(sources: Sources) -> str:
    """ "24 runs: 3 starts x 2 references x 4 seeds"."""
    half = sources.declared.panel.judging
    parts = len(half.starts_degC), len(half.reference_offsets_degC), len(half.seeds)
    return f"{math.prod(parts)} runs: {parts[0]} starts × {parts[1]} references × {parts[2]} seeds"


def featured(sources: Sources) -> str:
    """The scenario of the pictures, in words."""
    panel = sources.declared.panel
    offset = panel.judging.reference_offsets_degC[0]
    references = [o.reference + offset for o in sources.declared.machine.outputs]
    ends = f"{number(min(references), 0)}{DASH}{number(max(references), 0)}"
    return (
        f"nominal plant, held at {panel.judging.starts_degC[0]:g} °C, then sent to {ends} °C; sensor noise "
        f"{noise(sources):g} °C"
    )
