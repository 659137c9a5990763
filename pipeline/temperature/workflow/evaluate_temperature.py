"""What evaluate_temperature does: every contestant, tuned, as it would be deployed, on plants that nobody
learned or tuned on; which is best, what tells model-based and data-driven apart, and which plant decides."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from joblib import delayed
from tqdm import tqdm

from pipeline.store import artifacts
from pipeline.store.execution import run_all
from pipeline.store.params import Execution
from pipeline.temperature.test_set import comparison, panel, scorecard
from pipeline.temperature.workflow import contestants, tune_weights
from pipeline.temperature.workflow.cases import Rehearsal, Setting, faster, played
from pipeline.temperature.workflow.settings import EvaluateTemperature, Panel, TemperatureRules
from pipeline.temperature.workflow.settings import Plant as Machine

FIGURES = {
    "settled_error": "settled_error_degC",
    "settling": "settling_s",
    "overshoot": "overshoot_degC",
    "at_limits": "at_limits_percent",
    "energy": "energy_percent",
    "cost": "cost",
    "rms": "rms_degC",
}
CONVENTION = (
    "Q = R = I, discounted {gamma:g} a step, unclipped, without integrator and governor, from a plant at "
    "rest, noise-free, against the Riccati law of the same plant that knows the state"
)


KERNEL_UNDETERMINED = "the record does not determine the kernel (learn_kernel says why)"


class JudgedContestant(NamedTuple):
    """One contestant over all cases, its margins on every plant, its gaps in percent on the plants (None
    where weights mean nothing to it), and the rollout."""

    figures: panel.Figures
    costs: np.ndarray
    margins: list[scorecard.Margins]
    gaps: np.ndarray | None
    rollout: panel.Rollout


class Judged(NamedTuple):
    """Every contestant on the panel: rows of the cases, two cases as trajectories, and the summary."""

    cases: dict[str, Any]
    trajectories: dict[str, Any]
    summary: dict[str, Any]


def read_weights(path: str, machine: Machine) -> dict[str, dict[str, Any]]:
    """The tuned parameters by contestant. Raises ValueError for a file of another machine or of an older
    version, and for a parameter that is no number above 0."""
    stored = artifacts.read_json(path)
    weights = stored.get("contestants") if isinstance(stored, dict) else None
    if not isinstance(weights, dict) or not weights:
        keys = ", ".join(stored) if isinstance(stored, dict) and not weights else ""
        raise ValueError(
            f"{path}: expected contestants with their tuned parameters, found {keys or 'none'}, as in a file "
            f"of an older version or not of tune_weights; {artifacts.remedy(path)}"
        )
    for name, values in weights.items():
        if not isinstance(values, dict):
            raise ValueError(
                f"{path}: expected parameters by name in contestants.{name}, found {values}; "
                f"{artifacts.remedy(path)}"
            )
        for key, count, what in (
            ("q", len(machine.outputs), "outputs"),
            ("r", len(machine.inputs), "inputs"),
        ):
            if not isinstance(values.get(key, []), list):
                raise ValueError(
                    f"{path}: expected a list of weights in contestants.{name}.{key}, found {values[key]}; "
                    f"{artifacts.remedy(path)}"
                )
            if len(values.get(key, [0] * count)) != count:
                raise ValueError(
                    f"{path}: contestants.{name}.{key} has {len(values[key])} weights but the machine in "
                    f"params.yaml has {count} {what}, so that the file is of another machine or another run; "
                    f"{artifacts.remedy(path)}"
                )
        for parameter in contestants.BY_NAME[name].parameters if name in contestants.BY_NAME else ():
            value = values.get(parameter.name)
            if not (isinstance(value, int | float) and 0 < value < float("inf")):
                raise ValueError(
                    f"{path}: expected contestants.{name}.{parameter.name} to be a number above 0, found "
                    f"{value}; {artifacts.remedy(path)}"
                )
    return weights


def resolved(rules: TemperatureRules, panel: Panel, rehearsal: Rehearsal) -> TemperatureRules:
    """The rules with a settling time: as declared, else as the record says, else the panel's; and with a
    fast machine's delay margin (cases.faster)."""
    settling = rules.settling_s or rehearsal.settling_s or panel.settling_s
    delay_margin_s = faster(panel, rehearsal) * rules.delay_margin_s
    return rules.model_copy(update={"settling_s": settling, "delay_margin_s": delay_margin_s})


def designed(
    problem: contestants.Problem, weights: Mapping[str, Mapping[str, Any]]
) -> tuple[dict[str, contestants.Design], dict[str, str]]:
    """Every contestant that the record and the machine allow, at its tuned parameters, and by name why others
    are refused. Raises ValueError where there is none but doing nothing."""
    designs, refused = {}, {}
    for one in contestants.CONTESTANTS:
        values = {
            parameter.name: weights.get(one.name, {}).get(parameter.name) for parameter in one.parameters
        }
        if None in values.values():
            if reason := untuned(one, problem):
                refused[one.name] = reason
            continue
        try:
            design = one.design(problem, values)
        except ValueError as reason:
            refused[one.name] = str(reason)
            continue
        if design is not None:
            designs[one.name] = design
        elif one.role == "data_driven":
            refused[one.name] = KERNEL_UNDETERMINED
    if set(designs) <= {"hold"}:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in refused.items())
        raise ValueError(
            "evaluate_temperature: expected a controller that can be designed, "
            f"found none: {reasons}; record the machine longer, "
            "or change its inputs in section plant of params.yaml"
        )
    return designs, refused


def untuned(one: contestants.Contestant, problem: contestants.Problem) -> str:
    """Why a contestant has no tuned parameters; empty where it is no contestant here."""
    start = tune_weights.bounds(one, problem)[1]
    try:
        values = {parameter.name: value for parameter, value in zip(one.parameters, start, strict=True)}
        design = one.design(problem, values)
    except ValueError as reason:
        return str(reason)
    if design is None:
        return KERNEL_UNDETERMINED if one.role == "data_driven" else ""
    return "it could not be tuned: no candidate of its search kept the least margins of tune_weights"


def judged(
    settings: EvaluateTemperature,
    machine: Machine,
    setting: Setting,
    problem: contestants.Problem,
    weights: Mapping[str, Mapping[str, Any]],
    rules: TemperatureRules,
    execution: Execution,
) -> Judged:
    """Every contestant on the judging half of the panel."""
    designs, refused = designed(problem, weights)
    calls = [delayed(judged_one)(name, design, setting) for name, design in designs.items()]
    results = dict(
        tqdm(
            run_all(calls, execution),
            total=len(calls),
            desc="evaluate_temperature: contestants",
            mininterval=2,
        )
    )
    results = {name: results[name] for name in designs}
    entrants = [name for name in results if contestants.BY_NAME[name].role != "yardstick"]
    summary = {
        **_asked(settings, machine, setting, rules),
        "contestants": {
            name: _summary(one, setting, settings) | _tuned(weights.get(name, {}))
            for name, one in results.items()
        },
        "order": entrants,
        "refused": refused,
    }
    decision = _decided(results, entrants, summary, rules, setting, settings.seed)
    summary |= decision
    shown = {"typical": _typical(results, entrants), "deciding": decision["deciding"]["case"]}
    return Judged(
        _rows(results, setting, [o.name for o in machine.outputs]),
        _trajectories(results, shown, setting, machine),
        summary,
    )


def judged_one(name: str, design: contestants.Design, setting: Setting) -> tuple[str, JudgedContestant]:
    """One contestant on the judging half, with its name."""
    cases = setting.rehearsal.judging
    rollout, figures = played(design, panel.rests(design.model, cases, setting.limits), cases, setting)
    margins = [] if design.holds else scorecard.margins(cases.plants, design.law, grid=80)
    return name, JudgedContestant(
        figures, panel.costs(figures, setting.allowance), margins, _gaps(design, setting), rollout
    )


def _gaps(design: contestants.Design, setting: Setting) -> np.ndarray | None:
    """J / J* - 1 in percent on every plant, by CONVENTION; inf where the loop is unstable there."""
    if design.plain is None:
        return None
    try:
        law = design.plain()
    except ValueError:  # no minimum at the yardstick's weights, though there is one at its own
        return None
    cases, (p, m) = setting.rehearsal.judging, (design.model.p, design.model.m)
    first = np.flatnonzero(cases.kind == "constant")[:1]
    rows = first + cases.each * np.arange(len(cases.plants))
    scenarios = scorecard.Panel(
        cases.plants,
        np.arange(len(cases.plants)),
        cases.x0[rows],
        cases.u0[rows],
        np.repeat(cases.references[cases.asked[rows[0], 0]].H.T, len(rows), axis=0),
        np.zeros(len(rows)),
        np.zeros(len(rows), int),
        np.zeros(len(rows)),
        cases.steps,
        cases.hold,
    )
    yardstick = scorecard.Yardstick(np.ones(p), np.ones(m), setting.gamma)
    run = scorecard.simulate(scenarios, law)
    J, best = scorecard.cost(scenarios, run, yardstick), scorecard.optimum(scenarios, yardstick)
    gaps = 100.0 * scorecard.regret(J, best)
    return np.where(np.isfinite(gaps) & (gaps < 1e6), gaps, np.inf)


# ---- the summary


def _asked(
    settings: EvaluateTemperature, machine: Machine, setting: Setting, rules: TemperatureRules
) -> dict[str, Any]:
    rehearsal = setting.rehearsal
    return {
        "simulated": rehearsal.source == "declared",
        "plants": len(rehearsal.judging.plants),
        "cases": len(rehearsal.judging.plant),
        "noise_degC": rehearsal.noise.tolist(),
        "seed": rehearsal.judging.seed,
        "steps": rehearsal.judging.steps,
        "settled_steps": setting.settled,
        "sample_time_s": setting.sample_time_s,
        "band_degC": rehearsal.band_degC,
        "limits": rules.model_dump() | {"source": rehearsal.source},
        "outputs_limited": all(o.low is not None and o.high is not None for o in machine.outputs),
        "infeasible": rehearsal.infeasible,
    }


def _columns(one: JudgedContestant, setting: Setting) -> dict[str, np.ndarray]:
    """The figures of FIGURES by column of the table, in its units."""
    f = one.figures
    return {
        "settled_error_degC": f.settled_error,
        "settling_s": f.settling * setting.sample_time_s,
        "overshoot_degC": f.overshoot,
        "at_limits_percent": f.at_limits,
        "energy_percent": f.energy,
        "cost": one.costs,
        "rms_degC": f.rms,
    }


def _summary(one: JudgedContestant, setting: Setting, settings: EvaluateTemperature) -> dict[str, Any]:
    cases, columns = setting.rehearsal.judging, _columns(one, setting)
    figures = {}
    for name, column in FIGURES.items():
        band = comparison.banded(
            columns[column], cases.plant, seed=settings.seed, resamples=settings.resamples
        )
        figures[name] = {
            **{key: _number(getattr(band, key)) for key in ("median", "q90", "low", "high", "worst")},
            "worst_case": _case(cases, band.worst_case),
        }
    constant = ~np.isnan(one.figures.settling)
    crossing, noise = one.figures.crossing, setting.rehearsal.noise.max()
    return {
        **figures,
        "never_settled_percent": 100.0 * float(np.isinf(one.figures.settling[constant]).mean()),
        "crossings": {
            "cases": int((crossing > 3 * noise).sum()),
            "of": len(crossing),
            "worst_degC": _number(max(float(crossing.max()), 0.0)),
        },
        "gap": _gap(one, setting),
        "margins": _margin_figures(one.margins),
        "stable": {"count": sum(margin.stable for margin in one.margins), "of": len(one.margins)},
    }


def _gap(one: JudgedContestant, setting: Setting) -> dict[str, Any] | None:
    if one.gaps is None:
        return None
    median, q90 = np.quantile(one.gaps, [0.5, 0.9], method="nearest")
    return {
        "median_percent": _number(median),
        "q90_percent": _number(q90),
        "convention": CONVENTION.format(gamma=setting.gamma),
    }


def _margin_figures(margins: list[scorecard.Margins]) -> dict[str, Any] | None:
    """The worst disk margin in `scorecard.Margins`, unlimited delay margins as null."""
    if not margins:
        return None
    result = {}
    for key in ("disk", "delay_s"):
        values = np.array([getattr(margin, key) for margin in margins])
        result[key] = {
            "median": _number(np.quantile(values, 0.5, method="nearest")),
            "worst": _number(values.min()),
        }
    return result


def _tuned(values: Mapping[str, Any]) -> dict[str, Any]:
    kept = ("at_bound", "evaluations", "cost", "cost_at_start", "failed", "q", "r")
    return {
        "tuned": {key: value for key, value in values.items() if key not in kept},
        "at_bound": values.get("at_bound", []),
        "evaluations": values.get("evaluations", 0),
    }


def _case(cases: panel.Cases, index: int) -> dict[str, Any]:
    return {
        "case": index,
        "plant": int(cases.plant[index]),
        "kind": str(cases.kind[index]),
        "start_degC": float(cases.starts[cases.start[index]].mean()),
    }


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) and abs(value) < 1e6 else None


def passes(figures: Mapping[str, Any], rules: TemperatureRules) -> bool:
    """Whether a contestant's figures hold the rules that a rehearsal can ask, at the 90 % quantile over all
    cases; stable on every plant, and margins of the median one."""
    limits = {
        "settled_error": rules.settled_error_degC,
        "settling": rules.settling_s,
        "overshoot": rules.overshoot_degC,
        "at_limits": rules.at_limits_percent,
    }
    quantiles = all(
        figures[name]["q90"] is not None and figures[name]["q90"] <= limit for name, limit in limits.items()
    )
    margins, stable = figures["margins"], figures["stable"]
    robust = margins is None or (
        stable["count"] == stable["of"]
        and (margins["disk"]["median"] or 0.0) >= rules.disk_margin
        and (margins["delay_s"]["median"] is None or margins["delay_s"]["median"] >= rules.delay_margin_s)
    )
    return quantiles and robust and figures["crossings"]["cases"] == 0


def _decided(
    results: Mapping[str, JudgedContestant],
    entrants: list[str],
    summary: Mapping[str, Any],
    rules: TemperatureRules,
    setting: Setting,
    seed: int,
) -> dict[str, Any]:
    """Best, the pair, and the plant that decides, with both answers without it."""
    block = setting.rehearsal.judging.plant
    costs = {name: results[name].costs for name in entrants}
    able = {name: passes(summary["contestants"][name], rules) for name in entrants}
    choice = comparison.chosen(costs, block, able, seed=seed)
    a, b = contestants.PAIR
    b = b if b in costs else contestants.INDIRECT
    one = two = None
    if a in costs and b in costs:
        one, two = a, b
    elif len(entrants) > 1:
        one, two = entrants[-2:]
    index = comparison.deciding_plant(costs[one], costs[two], block)
    rest = block != index
    without = {name: values[rest] for name, values in costs.items()}
    again = comparison.chosen(without, block[rest], able, seed=seed)
    pair = _pair(a, b, costs, block, summary, seed)
    mine = np.flatnonzero(block == index)
    worst = mine[
        np.abs(np.log(np.maximum(costs[one][mine], 1e-9) / np.maximum(costs[two][mine], 1e-9))).argmax()
    ]
    return {
        "best": choice.best,
        "best_reason": {
            "passes": able,
            "leading": comparison.chosen(costs, block, dict.fromkeys(entrants, True), seed=seed).best,
            "nearest": choice.nearest,
            "improvement_percent": choice.against.improvement_percent if choice.against else None,
            "p": choice.against.p if choice.against else None,
        },
        "pair": pair,
        "deciding": {
            **_case(setting.rehearsal.judging, int(worst)),
            "best_without": again.best,
            "pair_without": _pair(a, b, without, block[rest], summary, seed)["winner"]
            if pair["p"] is not None
            else None,
        },
    }


def _pair(
    a: str, b: str, costs: Mapping[str, np.ndarray], block: np.ndarray, summary, seed: int
) -> dict[str, Any]:
    """The pair's answer; without figures where one of the two is refused."""
    if a not in costs or b not in costs:
        return {"a": a, "b": b, "winner": None, "difference": None, "low": None, "high": None, "p": None,
                "plants": len(np.unique(block)), "figures": {}}  # fmt: skip
    figures = summary["contestants"]
    return {
        **comparison.pair(a, b, costs, block, seed=seed)._asdict(),
        "plants": len(np.unique(block)),
        "figures": {
            name: [figures[one][name]["q90"] for one in (a, b)]
            for name in ("settling", "overshoot", "settled_error", "cost")
        },
    }


# ---- tables


def _typical(results: Mapping[str, JudgedContestant], entrants: list[str]) -> int:
    """The case of median cost under the first entrant that does something."""
    costs = results[next((name for name in entrants if name != "hold"), entrants[0])].costs
    return int(np.argsort(costs, kind="stable")[len(costs) // 2])


def _rows(results: Mapping[str, JudgedContestant], setting: Setting, zones: list[str]) -> dict[str, Any]:
    """The cases as columns: one row a contestant and case."""
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


def _trajectories(
    results: Mapping[str, JudgedContestant], shown: Mapping[str, int], setting: Setting, machine: Machine
) -> dict[str, Any]:
    """The shown cases under every contestant, as columns."""
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
