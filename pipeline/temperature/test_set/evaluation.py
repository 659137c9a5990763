"""Evaluates controllers as they would be deployed, on plants that were not used for learning or tuning:
figures of each, what separates model-based from data-driven, and which plant decides."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from pipeline.temperature.controllers import table
from pipeline.temperature.controllers.problem import Design, DesignProblem
from pipeline.temperature.controllers.table import BY_NAME
from pipeline.temperature.plant import Plant
from pipeline.temperature.settings import Plant as Machine
from pipeline.temperature.test_set import panel, scorecard

FIGURES = {
    "settled_error": "settled_error_degC",
    "peak": "peak_degC",
    "settling": "settling_s",
    "heating": "heating_s",
    "overshoot": "overshoot_degC",
    "at_limits": "at_limits_percent",
    "energy": "energy_percent",
    "travel": "travel_percent",
    "dip": "dip_degC",
    "cost": "cost",
    "rms": "rms_degC",
}
CONVENTION = (
    "Q = R = I, discounted {gamma:g} a step, unclipped, without integrator and governor, from a plant at "
    "rest, noise-free, against the Riccati law of the same plant that knows the state"
)


OF_SEARCH = ("at_bound", "evaluations", "cost", "cost_at_start", "failed", "q", "r")  # not parameters


class ControllerOutcome(NamedTuple):
    """One controller over all cases: its figures and costs, its margins on every plant, its gaps in percent
    on the plants (None if it has no weights), and the rollout."""

    figures: panel.Figures
    costs: np.ndarray
    margins: list[scorecard.Margins]
    gaps: np.ndarray | None
    rollout: panel.Rollout


def evaluate(name: str, design: Design, setting: panel.CaseConditions) -> tuple[str, ControllerOutcome]:
    """Evaluates one controller on the judging half. Returns its name and outcome."""
    cases = setting.rehearsal.judging
    rollout, figures = panel.play(design, panel.rests(design.model, cases, setting.limits), cases, setting)
    margins = [] if design.holds else scorecard.margins(cases.plants, design.law, grid=80)
    return name, ControllerOutcome(
        figures, panel.costs(figures, setting.allowance), margins, _gaps(design, setting), rollout
    )


def _gaps(design: Design, setting: panel.CaseConditions) -> np.ndarray | None:
    """Returns J / J* - 1 in percent on every plant, by CONVENTION; inf if the loop is unstable there. Returns
    None if the controller has no weights, or no design at the weights of the convention."""
    if design.plain is None:
        return None
    try:
        law = design.plain()
    except ValueError:  # no minimum at the weights of the common cost, although there is one at its own
        return None
    cases, (p, m) = setting.rehearsal.judging, (design.model.p, design.model.m)
    first = np.flatnonzero(cases.kind == "constant")[:1]
    rows = first + cases.each * np.arange(len(cases.plants))
    scenarios = scorecard.Scenarios(
        cases.plants,
        np.arange(len(cases.plants)),
        cases.x0[rows],
        cases.u0[rows],
        np.repeat(cases.references[cases.asked[rows[0], 0]].H.T, len(rows), axis=0),
        cases.steps,
        cases.hold,
    )
    yardstick = scorecard.CommonCost(np.ones(p), np.ones(m), setting.gamma)
    run = scorecard.simulate(scenarios, law)
    J, best = scorecard.cost(scenarios, run, yardstick), scorecard.optimum(scenarios, yardstick)
    gaps = 100.0 * (J / best - 1)
    return np.where(np.isfinite(gaps) & (gaps < 1e6), gaps, np.inf)


# ---- figures of one controller


def _columns(one: ControllerOutcome, setting: panel.CaseConditions) -> dict[str, np.ndarray]:
    """Returns the figures of FIGURES by column of the table, in its units."""
    f = one.figures
    return {
        "settled_error_degC": f.settled_error,
        "peak_degC": f.peak,
        "settling_s": f.settling * setting.sample_time_s,
        "heating_s": f.heating * setting.sample_time_s,
        "overshoot_degC": f.overshoot,
        "at_limits_percent": f.at_limits,
        "energy_percent": f.energy,
        "travel_percent": f.travel,
        "dip_degC": f.dip,
        "cost": one.costs,
        "rms_degC": f.rms,
    }


def summarise(
    one: ControllerOutcome,
    setting: panel.CaseConditions,
    tuned: Mapping[str, Any],
    *,
    seed: int,
    resamples: int,
) -> dict[str, Any]:
    """Returns the figures of a controller over all cases, with the parameters that its search found."""
    cases, columns = setting.rehearsal.judging, _columns(one, setting)
    figures = {}
    for name, column in FIGURES.items():
        band, worst = scorecard.banded(columns[column], cases.plant, seed=seed, resamples=resamples)
        figures[name] = {
            **{key: _number(value) for key, value in band.items()},
            "worst_case": _case(cases, worst),
        }
    steps = np.fmax(one.figures.settling, one.figures.heating)
    crossing, noise = one.figures.crossing, setting.rehearsal.noise.max()
    return {
        **figures,
        "never_settled_percent": 100.0 * float(np.isinf(steps[~np.isnan(steps)]).mean()),
        "crossings": {
            "cases": int((crossing > 3 * noise).sum()),
            "of": len(crossing),
            "worst_degC": _number(max(float(crossing.max()), 0.0)),
        },
        "gap": _gap(one, setting),
        "margins": _margin_figures(one.margins),
        "stable": {"count": sum(margin.stable for margin in one.margins), "of": len(one.margins)},
        "tuned": {key: value for key, value in tuned.items() if key not in OF_SEARCH},
        "at_bound": tuned.get("at_bound", []),
        "evaluations": tuned.get("evaluations", 0),
    }


def _gap(one: ControllerOutcome, setting: panel.CaseConditions) -> dict[str, Any] | None:
    if one.gaps is None:
        return None
    median, q90 = np.quantile(one.gaps, [0.5, 0.9], method="nearest")
    return {
        "median_percent": _number(median),
        "q90_percent": _number(q90),
        "convention": CONVENTION.format(gamma=setting.gamma),
    }


def _margin_figures(margins: list[scorecard.Margins]) -> dict[str, Any] | None:
    """Returns the 10 % quantile of the margins over the plants, the median and the worst; None for unlimited
    delay margins."""
    if not margins:
        return None
    result = {}
    for key in ("disk", "delay_s"):
        values = np.array([getattr(margin, key) for margin in margins])
        result[key] = {
            "q10": _number(np.quantile(values, 0.1, method="nearest")),
            "median": _number(np.quantile(values, 0.5, method="nearest")),
            "worst": _number(values.min()),
        }
    return result


def _case(cases: panel.Cases, index: int) -> dict[str, Any]:
    return {
        "case": index,
        "plant": int(cases.plant[index]),
        "kind": str(cases.kind[index]),
        "start_degC": float(cases.starts[cases.start[index]].mean()),
    }


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) and abs(value) < 1e6 else None


# ---- the comparison


def decide(
    results: Mapping[str, ControllerOutcome],
    entrants: list[str],
    summary: Mapping[str, Any],
    setting: panel.CaseConditions,
    tuned: Mapping[str, float],
    seed: int,
) -> dict[str, Any]:
    """Returns the answer for the pair (model-based or data-driven), the plant that decides it, and the pair's
    winner without this plant. `tuned`: costs of the searches, by controller."""
    block = setting.rehearsal.judging.plant
    costs = {name: results[name].costs for name in entrants}
    a, b = table.answering_pair(entrants, tuned)
    one, two = a, b
    if not (a in costs and b in costs):
        one, two = entrants[max(len(entrants) - 2, 0)], entrants[-1]
    index = scorecard.deciding_plant(costs[one], costs[two], block)
    rest = block != index
    without = {name: values[rest] for name, values in costs.items()}
    # plants have one structure in turn
    kind = block % len(panel.STRUCTURES)
    pair = _pair(a, b, costs, block, kind, summary, seed)
    mine = np.flatnonzero(block == index)
    worst = mine[
        np.abs(np.log(np.maximum(costs[one][mine], 1e-9) / np.maximum(costs[two][mine], 1e-9))).argmax()
    ]
    return {
        "pair": pair,
        "deciding": {
            **_case(setting.rehearsal.judging, int(worst)),
            "pair_without": _pair(a, b, without, block[rest], kind[rest], summary, seed)["winner"]
            if pair["p"] is not None
            else None,
        },
    }


def _pair(
    a: str, b: str, costs: Mapping[str, np.ndarray], block: np.ndarray, kind: np.ndarray, summary, seed: int
) -> dict[str, Any]:
    """Returns the pair's answer; without figures if one of the two is refused."""
    if a not in costs or b not in costs:
        unknown = dict.fromkeys(("winner", "difference", "low", "high", "p", "kept"))
        plants = len(np.unique(block))
        return {"a": a, "b": b, **unknown, "by_structure": [], "plants": plants, "figures": {}}
    figures = summary["contestants"]
    return {
        **scorecard.pair(a, b, costs, block, kind, seed=seed),
        "plants": len(np.unique(block)),
        "figures": {
            name: [figures[one][name]["q90"] for one in (a, b)]
            for name in ("settling", "heating", "overshoot", "settled_error", "cost")
        },
    }


# ---- tables


def typical_case(results: Mapping[str, ControllerOutcome], entrants: Sequence[str]) -> int:
    """Returns the case of median cost under the first controller that does something."""
    costs = results[next((name for name in entrants if name != "hold"), entrants[0])].costs
    return int(np.argsort(costs, kind="stable")[len(costs) // 2])


def case_columns(
    results: Mapping[str, ControllerOutcome], setting: panel.CaseConditions, zones: Sequence[str]
) -> dict[str, Any]:
    """Returns the cases as columns: one row per controller and case."""
    cases, count = setting.rehearsal.judging, len(results)
    columns = [_columns(one, setting) for one in results.values()]
    crossing = np.concatenate([np.maximum(one.figures.crossing, 0.0) for one in results.values()])
    limited = np.isfinite(np.concatenate(setting.output_limits)).any()
    return {
        "contestant": [name for name in results for _ in cases.plant],
        "case": np.tile(np.arange(len(cases.plant)), count).astype(np.int32),
        "plant": np.tile(cases.plant, count).astype(np.int32),
        "kind": np.tile(cases.kind, count).tolist(),
        "start_degC": np.tile(cases.starts.mean(axis=1)[cases.start], count),
        "settled_zone": [zones[zone] for one in results.values() for zone in one.figures.settled_zone],
        **{
            name: np.concatenate([np.where(np.isfinite(c[name]), c[name], np.nan) for c in columns])
            for name in columns[0]
        },
        "crossing_degC": crossing if limited else np.full(len(crossing), np.nan),
    }


def trajectory_columns(
    results: Mapping[str, ControllerOutcome],
    shown: Mapping[str, int],
    setting: panel.CaseConditions,
    machine: Machine,
) -> dict[str, Any]:
    """Returns the cases {label: number} under every controller, as columns."""
    time_s = setting.sample_time_s * np.arange(setting.rehearsal.judging.steps)
    parts = [
        (name, label, one.rollout, case) for name, one in results.items() for label, case in shown.items()
    ]
    columns: dict[str, Any] = {
        "contestant": [name for name, *_ in parts for _ in time_s],
        "case_name": [label for _, label, *_ in parts for _ in time_s],
        "time_s": np.tile(time_s, len(parts)),
    }
    for k, output in enumerate(machine.outputs):
        columns[output.name] = np.concatenate([run.y[:, case, k] for *_, run, case in parts])
        columns[f"{output.name}_reference"] = np.concatenate([run.r[:, case, k] for *_, run, case in parts])
    for k, signal in enumerate(machine.inputs):
        columns[f"{signal.name}_command"] = np.concatenate(
            [run.wished[:, case, k] for *_, run, case in parts]
        )
        columns[f"{signal.name}_applied"] = np.concatenate([run.u[:, case, k] for *_, run, case in parts])
    return columns


REDESIGNS = 7  # plants of the spread from which a controller is designed again
BROKEN = 2.0  # times the cost: from there on, an equally plausible record gives a different controller


def redesigned(
    name: str, problem: DesignProblem, values: Mapping[str, float], setting: panel.CaseConditions
) -> tuple[float, int, int]:
    """Returns how much the uncertainty of the identified plant can change a controller's cost, how many
    plants give a controller that costs BROKEN times as much or none, and out of how many plants. J is the
    mean cost of the controller on the training cases. J_k is that of the same controller designed from plant
    k of the spread, for REDESIGNS plants. The first value is the median of max(J_k / J - 1, 0).

    A PI controller uses gain and lag of a plant, a model-based one uses all of it. So each is charged with
    the uncertainty of what it uses. The spread is resampled in blocks, so it includes the colour of the
    residuals.
    """
    cases = setting.rehearsal.training

    def cost(plant: Plant) -> float:
        try:
            made = BY_NAME[name].design(problem._replace(plant=plant), values)
        except ValueError:  # no such controller for this plant
            return float("inf")
        if made is None:
            return float("inf")
        figures = panel.play(made, panel.rests(made.model, cases, setting.limits), cases, setting)[1]
        return float(panel.costs(figures, setting.allowance).mean())

    own = cost(problem.plant)
    ratios = np.array([cost(plant) for plant in problem.family[1 : 1 + REDESIGNS]]) / own
    if not ratios.size:
        return float("inf"), 0, 0
    excess = float(np.quantile(np.maximum(ratios - 1.0, 0.0), 0.5, method="nearest"))
    return excess, int((ratios >= BROKEN).sum()), len(ratios)
