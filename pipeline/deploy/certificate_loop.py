"""Rules of the loop: would the controller work on the plants that the record leaves open?

Poles and margins over the model, its spread, and window models of resampled blocks of the record (bands.py);
the same on those of its newest part alone, the machine as it is now; and the worst of at least 1,000 sampled
plants, which the controller meets as deployed.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.deploy import bands
from pipeline.deploy.certificate import EvidenceRecord, RuleResult, Rules, at_most, result
from pipeline.deploy.certificate_evidence import reference_steps
from pipeline.deploy.supervise import Exported
from pipeline.temperature.controllers.law import Deployed, Plant
from pipeline.temperature.controllers.window import observer_form
from pipeline.temperature.plant import strictly_proper
from pipeline.temperature.test_set import scorecard

POLES_SHOWN = 12  # of each plant, the largest


def of_loop(
    exported: Exported,
    family: Sequence[Plant],
    of_record: bands.Predictors,
    of_newest: bands.Predictors,
    rules: Rules,
    rng: np.random.Generator,
) -> tuple[dict[str, Any], list[RuleResult], dict[str, dict[str, Any]]]:
    """Fields of the certificate; results of the rules poles and violations; and the figures of the rules
    disk_margin, delay_margin and settled_error."""
    at = exported.machine.sample_time_s
    some = range(min(rules.poles_of, len(of_record.Theta)))
    plants = [("model", strictly_proper(exported.model))]
    plants += [("spread", strictly_proper(plant)) for plant in family]
    plants += [("record", observer_form(of_record.window(k), at)[0]) for k in some]
    margins = _margins([plant for _, plant in plants], exported.controller)
    plants.append(("newest", observer_form(of_newest.window(0), at)[0]))
    newest = _margins([plants[-1][1]], exported.controller)
    poles = tuple(_poles(of, plant, exported.controller) for of, plant in plants)
    spread = [plant for of, plant in plants if of == "spread"]
    settled, crossing = _settled_and_crossing(exported, spread, of_record, rules, rng)
    violations = tuple(
        {
            "output": signal.name,
            "worst_degC": float(crossing[:, o].max()),
            "plants": int((crossing[:, o] > rules.crossing_degC).sum()),
        }
        for o, signal in enumerate(exported.machine.outputs)
        if np.isfinite([signal.low, signal.high]).any()
    )
    worst = _worst(settled)
    fields = {"poles": poles, "margins": margins, "worst": worst, "violations": violations}
    figures = {
        name: {"margins": [found[0], found[1], of_newest[0]], "tail": rules.tail}
        for name, found, of_newest in (
            ("disk_margin", margins["disk"], newest["disk"]),
            ("delay_margin", margins["delay_s"], newest["delay_s"]),
        )
    }
    figures["settled_error"] = {"degC": settled.tolist(), "failing": rules.failing}
    return fields, [_of_poles(poles, rules), _of_violations(crossing, rules)], figures


def _poles(of: str, plant: Plant, controller: Deployed) -> dict[str, Any]:
    whole = plant.A if controller.holds else scorecard.closed_loop(plant, controller.law)
    found = np.linalg.eigvals(whole)
    found = found[np.lexsort((-found.imag, -np.abs(found).round(10)))]
    shown = [[float(one.real), float(one.imag)] for one in found[:POLES_SHOWN]]
    return {"of": of, "radius": float(np.abs(found).max()), "poles": shown}


def _of_poles(poles: Sequence[dict[str, Any]], rules: Rules) -> RuleResult:
    """All of model and spread within the unit circle, and of the plants of the record and its newest part all
    but a share `rules.failing`: a resample's slowest pole may lie outside by chance."""
    declared = [one for one in poles if one["of"] in ("model", "spread")]
    sampled = [one for one in poles if one["of"] in ("record", "newest")]
    outside = [sum(one["radius"] >= 1 for one in part) for part in (declared, sampled)]
    worst = max(poles, key=lambda one: one["radius"])
    return result(
        "poles",
        outside[0] == 0 and outside[1] <= rules.failing * len(sampled),
        worst["radius"],
        1.0,
        "1",
        f"On {len(poles) - outside[1]} of {len(poles)} plants, model and spread among them, every pole lies "
        "within the unit circle.",
        f"On {outside[0]} of {len(declared)} plants of model and spread, and {outside[1]} of {len(sampled)} "
        f"of the record, a pole lies outside the unit circle, at {worst['radius']:.4f}.",
    )


def _margins(plants: Sequence[Plant], controller: Deployed) -> dict[str, Any]:
    found = scorecard.margins(plants, controller.law, grid=60)
    picked = len(found) // 2, len(found) // 10, 0
    disk, delay = (np.sort([getattr(one, name) for one in found]) for name in ("disk", "delay_s"))
    return {
        "plants": len(found),
        "disk": [float(disk[k]) for k in picked],
        "delay_s": [float(delay[k]) if np.isfinite(delay[k]) else None for k in picked],
    }


def _of_violations(crossing: np.ndarray, rules: Rules) -> RuleResult:
    plants, crossed = len(crossing), int((crossing > rules.crossing_degC).any(axis=1).sum())
    return at_most(
        "violations",
        100 * crossed / plants,
        100 * (rules.failing * plants) / plants,
        "% of plants",
        f"On {plants - crossed} of {plants} plants no output crosses its limit by more than "
        f"{rules.crossing_degC:g} °C.",
        f"On {crossed} of {plants} plants an output crosses its limit by more than "
        f"{rules.crossing_degC:g} °C, at most by {crossing.max():.3g} °C.",
    )


def _settled_and_crossing(
    exported: Exported,
    spread: Sequence[Plant],
    sampled: bands.Predictors,
    rules: Rules,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Settled errors (s,) in °C of the sampled plants and of the spread under the controller as deployed, and
    by how many °C each crosses limits (s, p)."""
    low, high = np.array([(one.low, one.high) for one in exported.machine.outputs]).T
    steps = reference_steps(rules)
    parts = [bands.met(exported.controller, exported.model, sampled, steps, rng)]
    if spread:
        noise = np.sqrt(np.median(np.einsum("sii->si", sampled.covariance), axis=0))
        parts.append(bands.met_spread(exported.controller, exported.model, spread, steps, noise, rng))
    settled = np.concatenate([part.settled_error for part in parts])
    lowest, highest = (
        np.concatenate([getattr(part, side) for part in parts]) for side in ("lowest", "highest")
    )
    return settled, np.maximum(np.maximum(low - lowest, highest - high), 0.0)


def _worst(settled: np.ndarray) -> dict[str, Any]:
    """How many plants fail is decided by the limit (certified.py): 0 until then."""
    figures = [float(np.quantile(settled, share, method="higher")) for share in (0.5, 0.99, 1.0)]
    diverged = int((settled >= bands.DIVERGED).sum())
    return {"plants": len(settled), "settled_error_degC": figures, "failing": 0, "diverged": diverged}


def gain_bands(
    exported: Exported,
    record: EvidenceRecord,
    learning: bands.GainRoute,
    rules: Rules,
    rng: np.random.Generator,
) -> dict[str, Any]:
    found = bands.bands(record.u, record.y, learning, resamples=rules.resamples, rng=rng)
    machine, N = exported.machine, learning.N
    inputs, outputs = [one.name for one in machine.inputs], [one.name for one in machine.outputs]
    on = [f"{name} {lag} before" for lag in range(1, N + 1) for name in inputs]
    on += [f"{name} {lag} before" for lag in range(1, N + 1) for name in outputs]
    on += [f"reference of {name}" for name in outputs]
    gain, low, high = ([[float(f"{one:.6g}") for one in row] for row in part] for part in found[:3])
    return {
        "level": found.level, "resamples": found.resamples, "on": on, "gain": gain, "low": low, "high": high
    }  # fmt: skip
