"""Rules of the loop: would the controller work on the plants that the record leaves open?

Poles and margins over the model, its spread, and window models of resampled blocks of the record (bands.py);
the same on those of its newest part alone, the machine as it is now; and the worst of at least 1,000 sampled
plants, which the controller meets as deployed.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.runtime import bands
from pipeline.runtime.certificate import (
    GainBands,
    MarginsFound,
    Poles,
    Record,
    RuleResult,
    Rules,
    Violation,
    Worst,
    at_least,
    at_most,
    result,
)
from pipeline.runtime.certificate_evidence import Sampled, asked
from pipeline.runtime.machine import Exported
from pipeline.temperature.controllers.controller import Deployed
from pipeline.temperature.controllers.window import observer_form
from pipeline.temperature.plant import Plant, strictly_proper
from pipeline.temperature.test_set import scorecard

POLES_SHOWN = 12  # of each plant, the largest


class Shown(NamedTuple):
    """What the rules of the loop came to."""

    poles: tuple[Poles, ...] = ()
    margins: MarginsFound | None = None
    worst: Worst | None = None
    violations: tuple[Violation, ...] = ()
    bands: GainBands | None = None


def of_loop(
    exported: Exported, family: Sequence[Plant], sampled: Sampled, rules: Rules, rng: np.random.Generator
) -> tuple[Shown, list[RuleResult]]:
    """What was found, and the rules' results."""
    at, record = exported.machine.sample_time_s, sampled.of_record
    some = range(min(rules.poles_of, len(record.Theta)))
    plants = [("model", strictly_proper(exported.model))]
    plants += [("spread", strictly_proper(plant)) for plant in family]
    plants += [("record", observer_form(record.window(k), at)[0]) for k in some]
    margins = _margins([plant for _, plant in plants], exported.controller)
    plants.append(("newest", observer_form(sampled.of_newest.window(0), at)[0]))
    newest = _margins([plants[-1][1]], exported.controller)
    poles = tuple(_poles(of, plant, exported.controller) for of, plant in plants)
    worst, crossing = _worst(exported, [plant for of, plant in plants if of == "spread"], record, rules, rng)
    violations = tuple(
        Violation(signal.name, float(crossing[:, o].max()), int((crossing[:, o] > rules.crossing_degC).sum()))
        for o, signal in enumerate(exported.machine.outputs)
        if np.isfinite([signal.low, signal.high]).any()
    )
    shown = Shown(poles, margins, worst, violations)
    return shown, [
        _of_poles(poles, rules),
        _of_margin("disk_margin", margins.disk, newest.disk[0], rules.disk_margin, rules),
        _of_margin("delay_margin", margins.delay_s, newest.delay_s[0], rules.delay_margin_s, rules),
        *_of_worst(worst, crossing, rules),
    ]


def _poles(of: str, plant: Plant, controller: Deployed) -> Poles:
    whole = plant.A if controller.holds else scorecard.closed_loop(plant, controller.law)
    found = np.linalg.eigvals(whole)
    found = found[np.lexsort((-found.imag, -np.abs(found).round(10)))]
    shown = tuple((float(one.real), float(one.imag)) for one in found[:POLES_SHOWN])
    return Poles(of, float(np.abs(found).max()), shown)


def _of_poles(poles: Sequence[Poles], rules: Rules) -> RuleResult:
    """All of model and spread within the unit circle, and of the plants of the record and its newest part all
    but a share `rules.failing`: a resample's slowest pole may lie outside by chance."""
    declared = [one for one in poles if one.of in ("model", "spread")]
    sampled = [one for one in poles if one.of in ("record", "newest")]
    outside = [sum(one.radius >= 1 for one in part) for part in (declared, sampled)]
    worst = max(poles, key=lambda one: one.radius)
    return result(
        "poles",
        outside[0] == 0 and outside[1] <= rules.failing * len(sampled),
        worst.radius,
        1.0,
        "1",
        f"On {len(poles) - outside[1]} of {len(poles)} plants, model and spread among them, every pole lies "
        "within the unit circle.",
        f"On {outside[0]} of {len(declared)} plants of model and spread, and {outside[1]} of {len(sampled)} "
        f"of the record, a pole lies outside the unit circle, at {worst.radius:.4f}.",
    )


def _margins(plants: Sequence[Plant], controller: Deployed) -> MarginsFound:
    found = scorecard.margins(plants, controller.law, grid=60)
    disk = np.sort([one.disk for one in found])
    delay = np.sort([one.delay_s for one in found])
    tenth = len(found) // 10
    picked = [[float(part[k]) for k in (len(found) // 2, tenth, 0)] for part in (disk, delay)]
    late = [one if np.isfinite(one) else None for one in picked[1]]
    return MarginsFound(len(found), (picked[0][0], picked[0][1], picked[0][2]), (late[0], late[1], late[2]))


def _of_margin(
    name: str, found: Sequence[float | None], newest: float | None, limit: float, rules: Rules
) -> RuleResult:
    """`limit` of the median plant, and a share of it of nine in ten and of the newest record's; None is
    without end. What is told is the figure that is furthest below what is asked of it."""
    unit = {"disk_margin": "1", "delay_margin": "s"}[name]
    figures = [np.inf if one is None else one for one in (found[0], found[1], newest)]
    limits = [limit, rules.tail * limit, rules.tail * limit]
    worst = int(np.argmin(np.array(figures) - limits)) if np.isfinite(figures).any() else 0
    of = ("of the median plant", "that nine of ten plants reach", "on what the newest record alone shows")
    what = f"The {name.replace('_', ' ')}"
    told = [f"{figure:.3g}" if np.isfinite(figure) else "without end" for figure in figures]
    each = ", ".join(f"{one} {where}" for one, where in zip(told, of, strict=True))
    return at_least(
        name,
        figures[worst],
        limits[worst],
        unit,
        f"{what} is {each}.",
        f"{what} {of[worst]} is {told[worst]}, where {limits[worst]:g} is asked: {each}.",
    )


def _of_worst(worst: Worst, crossing: np.ndarray, rules: Rules) -> list[RuleResult]:
    allowed = rules.failing * worst.plants
    crossed = int((crossing > rules.crossing_degC).any(axis=1).sum())
    return [
        at_most(
            "settled_error",
            100 * worst.failing / worst.plants,
            100 * rules.failing,
            "% of plants",
            f"Of {worst.plants} plants that the record leaves open {worst.plants - worst.failing} settle "
            f"within {rules.settled_error_degC:g} °C, the worst at {worst.settled_error_degC[2]:.2g} °C.",
            f"{worst.failing} of {worst.plants} plants that the record leaves open do not settle within "
            f"{rules.settled_error_degC:g} °C, the worst by {worst.settled_error_degC[2]:.3g} °C.",
        ),
        at_most(
            "violations",
            100 * crossed / worst.plants,
            100 * allowed / worst.plants,
            "% of plants",
            f"On {worst.plants - crossed} of {worst.plants} plants no output crosses its limit by more than "
            f"{rules.crossing_degC:g} °C.",
            f"On {crossed} of {worst.plants} plants an output crosses its limit by more than "
            f"{rules.crossing_degC:g} °C, at most by {crossing.max():.3g} °C.",
        ),
    ]


def _worst(
    exported: Exported,
    spread: Sequence[Plant],
    sampled: bands.Predictors,
    rules: Rules,
    rng: np.random.Generator,
) -> tuple[Worst, np.ndarray]:
    """The sampled plants and the spread under the controller as deployed, and by how many °C each crosses
    limits (s, p)."""
    low, high = np.array([(one.low, one.high) for one in exported.machine.outputs]).T
    meets = asked(rules)
    parts = [bands.met(exported.controller, exported.model, sampled, meets, rng)]
    if spread:
        noise = np.sqrt(np.median(np.einsum("sii->si", sampled.covariance), axis=0))
        parts.append(bands.met_spread(exported.controller, exported.model, spread, meets, noise, rng))
    settled = np.concatenate([part.settled_error for part in parts])
    lowest, highest = (
        np.concatenate([getattr(part, side) for part in parts]) for side in ("lowest", "highest")
    )
    crossing = np.maximum(np.maximum(low - lowest, highest - high), 0.0)
    figures = [float(np.quantile(settled, share, method="higher")) for share in (0.5, 0.99, 1.0)]
    failing = int((settled > rules.settled_error_degC).sum())
    diverged = int((settled >= bands.DIVERGED).sum())
    return Worst(len(settled), (figures[0], figures[1], figures[2]), failing, diverged), crossing


def gain_bands(
    exported: Exported, record: Record, learning: bands.Learning, rules: Rules, rng: np.random.Generator
) -> GainBands:
    found = bands.bands(record.u, record.y, learning, resamples=rules.resamples, rng=rng)
    machine, N = exported.machine, learning.N
    inputs, outputs = [one.name for one in machine.inputs], [one.name for one in machine.outputs]
    on = [f"{name} {lag} before" for lag in range(1, N + 1) for name in inputs]
    on += [f"{name} {lag} before" for lag in range(1, N + 1) for name in outputs]
    on += [f"reference of {name}" for name in outputs]
    gain, low, high = (tuple(tuple(float(f"{one:.6g}") for one in row) for row in part) for part in found[:3])
    return GainBands(found.level, found.resamples, tuple(on), gain, low, high)
