"""Both stages that compare contestants, on six plants of the study's machine: what is told follows from the
rows, who cannot take part is named, and what was asked twice is answered twice alike."""

import json
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import pipeline.store.execution
from pipeline.papers.study import data_sets
from pipeline.store import artifacts, params
from pipeline.temperature import tables
from pipeline.temperature.controllers import predictive, table, window
from pipeline.temperature.controllers.kernel import regress
from pipeline.temperature.controllers.problem import DesignProblem
from pipeline.temperature.controllers.table import BY_NAME, CONTROLLERS
from pipeline.temperature.plant import baam
from pipeline.temperature.settings import Panel, Plant, Tracking, TuneWeights
from pipeline.temperature.test_set import best, controller_search, evaluation, panel, scorecard
from pipeline.temperature.test_set.evaluation import redesigned
from stages import evaluate_temperature, tune_weights
from stages.evaluate_temperature import EvaluateTemperature

FILE = Path(__file__).resolve().parents[2] / "params.yaml"
# the study's machine is no printer
EVERYBODY = [contestant.name for contestant in CONTROLLERS if contestant.name != "printer_pid"]


def section(kind, name: str):
    return params.load(kind, name, FILE)


class Small(NamedTuple):
    machine: Plant
    setting: panel.CaseConditions
    problem: DesignProblem

    @property
    def weights(self) -> dict[str, dict[str, float]]:
        """Every parameter at its declared start."""
        return {
            one.name: {
                p.name: p.start * (self.problem.effect if p.of_effect else 1.0) for p in one.parameters
            }
            for one in CONTROLLERS
            if one.parameters
        }


@cache
def small(inputs: int = 7) -> Small:
    """The study's machine with its first inputs, six plants in each half, and what a record of 1,500 samples
    of slight noise teaches."""
    machine = section(Plant, "plant")
    machine = machine.model_copy(update={"inputs": machine.inputs[:inputs]})
    truth = baam()._replace(B=baam().B[:, :inputs], D=baam().D[:, :inputs])
    halves = section(Panel, "panel")
    half = {"plants": 6, "starts_degC": [120.0, 150.0], "reference_offsets_degC": [0.0]}
    halves = halves.model_copy(
        update={
            "steps": 120,
            "settled_steps": 20,
            "judging": halves.judging.model_copy(update=half | {"sinusoid_steps": 120}),
            "training": halves.training.model_copy(update=half | {"length": 1.0}),
        }
    )
    u, _ = data_sets(np.random.default_rng(7), 1500, 1)
    u, x, y = u[:, 0, :inputs], np.full(6, 50.0), []
    for applied in u:
        y.append(truth.C @ x)
        x = truth.A @ x + truth.B @ applied
    y = np.array(y) + 0.01 * np.random.default_rng(8).standard_normal((1500, 5))
    long = window.learn([u], [y], longest=8, gain_spread=0.05)
    kernel = regress(window.predicted_tuples(long, [u], [y]))
    models = {
        "plant": truth,
        "family": [truth, truth],
        "window": long,
        "kernel": kernel,
        "trajectories": predictive.learn([u], [y], long.N, 10, gain_spread=0.05),
        "printer_pid": (),
    }
    tracking = section(Tracking, "tracking")
    rehearsal = panel.from_declaration(halves, machine, truth, [truth])
    setting = panel.conditions(
        section(TuneWeights, "tune_weights"), machine, tracking, halves, rehearsal, [truth, truth]
    )
    problem = panel.design_problem(models, tracking, setting, truth)
    return Small(machine, setting, problem)


class Compared(NamedTuple):
    cases: dict
    trajectories: dict
    summary: dict


def judged(
    given: Small, weights=None, *, jobs: int = 1, execution: params.Execution | None = None
) -> Compared:
    execution = execution or params.Execution(backend="loky", jobs=jobs, scheduler="")
    panel = section(Panel, "panel")
    loaded = evaluate_temperature.EvaluationInputs(
        given.machine,
        panel,
        given.setting,
        given.problem,
        given.weights if weights is None else weights,
        simulated=True,
    )
    settings = section(EvaluateTemperature, "evaluate_temperature").model_copy(update={"cost_curve": False})
    return Compared(*evaluate_temperature.compare(settings, loaded, execution))


def written(result: Compared, machine: Plant, folder: Path) -> dict[str, bytes]:
    """The bytes of all files of the stage."""
    artifacts.write_table(folder / "cases.parquet", tables.CASES, result.cases)
    shown = tables.trajectories(machine.inputs, machine.outputs)
    artifacts.write_table(folder / "trajectories.parquet", shown, result.trajectories)
    artifacts.write_json(folder / "figures.json", result.summary)
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def given():
    return small()


@pytest.fixture(scope="module")
def result(given):
    return judged(given)


@pytest.fixture(scope="module")
def stored(result, given, tmp_path_factory):
    """cases.parquet and figures.json, read back, and what the limits of section report make of them."""
    folder = tmp_path_factory.mktemp("evaluate_temperature")
    written(result, given.machine, folder)
    rows = artifacts.read_table(folder / "cases.parquet", tables.CASES)
    seed = section(EvaluateTemperature, "evaluate_temperature").seed
    summary = json.loads((folder / "figures.json").read_text())
    return rows, summary | best.best_by_limits(summary, rows, params.read(FILE)["report"], seed)


def of(rows, name: str) -> dict[str, np.ndarray]:
    mine = rows["contestant"] == name
    return {key: column[mine] for key, column in rows.items()}


# ---- what is told follows from the rows


def test_every_contestant_meets_the_same_cases_and_doing_nothing_is_among_them(stored):
    rows, summary = stored
    assert summary["order"] == [name for name in EVERYBODY if name != "exact_model"]
    assert list(summary["contestants"]) == EVERYBODY and summary["order"][0] == "hold"
    shared = ("case", "plant", "kind", "start_degC")
    first = of(rows, "hold")
    assert len(first["case"]) == summary["cases"] == 6 * (2 + 4) and summary["plants"] == 6
    for name in EVERYBODY:
        for key in shared:
            np.testing.assert_array_equal(of(rows, name)[key], first[key])
    assert summary["contestants"]["hold"]["settling"]["q90"] is None


@pytest.mark.parametrize("name", EVERYBODY)
def test_the_deciding_figures_of_the_summary_are_those_of_the_rows(stored, name):
    rows, summary = stored
    settings, mine = section(EvaluateTemperature, "evaluate_temperature"), of(rows, name)
    moves = np.isin(mine["kind"], ["ramp", "sinusoid", "disturbed"])
    cold = (mine["kind"] == "constant") & (mine["start_degC"] == mine["start_degC"].min())
    alone = {
        "settling": ~moves & ~cold,
        "heating": cold,
        "overshoot": ~moves,
        "at_limits": ~cold,
        "dip": mine["kind"] == "disturbed",
    }
    assert np.isnan(mine["settling_s"][moves]).all() and np.isnan(mine["overshoot_degC"][moves]).all()
    for figure, column in evaluation.FIGURES.items():
        applies = alone.get(figure, np.ones(len(moves), bool))
        values = np.where(np.isnan(mine[column]), np.inf, mine[column])[applies]
        told = summary["contestants"][name][figure]
        ranked = np.sort(values)
        middle = int(np.round((len(ranked) - 1) / 2 - 1e-9)), int(np.round((len(ranked) - 1) / 2 + 1e-9))
        assert told["median"] in [number(ranked[place]) for place in middle], figure
        assert told["q90"] == number(ranked[round(0.9 * (len(ranked) - 1))]), figure
        assert told["worst"] == number(ranked[-1]), figure
        band, _ = scorecard.banded(
            values, mine["plant"][applies], seed=settings.seed, resamples=settings.resamples
        )
        assert (told["low"], told["high"]) == (number(band["low"]), number(band["high"])), figure
        worst = told["worst_case"]
        at = np.flatnonzero(mine["case"] == worst["case"])[0]
        assert number(np.where(np.isnan(mine[column]), np.inf, mine[column])[at]) == told["worst"]
        assert (worst["plant"], worst["kind"]) == (mine["plant"][at], mine["kind"][at])
    never = np.isnan(np.where(cold, mine["heating_s"], mine["settling_s"])[~moves]).mean()
    assert summary["contestants"][name]["never_settled_percent"] == pytest.approx(100 * never)


def number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def without(rows, plant: int | None):
    """{contestant: costs}, and the plant of each case, of all plants but one."""
    first = of(rows, "hold")["plant"]
    left = np.ones(len(first), bool) if plant is None else first != plant
    names = [name for name in EVERYBODY if name != "exact_model"]
    return {name: of(rows, name)["cost"][left] for name in names}, first[left]


def test_best_pair_and_deciding_plant_follow_from_the_costs_of_the_rows(stored):
    rows, summary = stored
    seed, able = section(EvaluateTemperature, "evaluate_temperature").seed, summary["best_reason"]["passes"]
    costs, plant = without(rows, None)
    assert summary["best"] == scorecard.chosen(costs, plant, able, seed=seed)[0]
    # nobody was tuned here, so that the first row of each kind answers for it
    two = ("subspace_lqg", "learned_kernel")
    kind = plant % len(panel.STRUCTURES)
    pair = scorecard.pair(*two, costs, plant, kind, seed=seed)
    assert {key: summary["pair"][key] for key in pair} == pair
    decides = scorecard.deciding_plant(costs[two[0]], costs[two[1]], plant)
    assert summary["deciding"]["plant"] == decides
    others, left = without(rows, decides)
    assert summary["deciding"]["best_without"] == scorecard.chosen(others, left, able, seed=seed)[0]
    rest = scorecard.pair(*two, others, left, left % len(panel.STRUCTURES), seed=seed)
    assert summary["deciding"]["pair_without"] == rest["winner"]


def test_a_contestant_passes_by_its_ninety_percent_quantiles_and_breaks_a_rule_by_any_one_of_them(stored):
    _, summary = stored
    limits = summary["limits"] | {"settling_s": 1e6, "delay_margin_s": 1e-3}
    good = summary["contestants"]["subspace_lqg"] | {"crossings": {"cases": 0}, "margins": None}
    ruled = ("settled_error", "peak", "settling", "heating", "overshoot", "at_limits")
    good |= {name: {"q90": 0.0} for name in ruled}
    assert best.passes(good, limits)
    for name in ruled:
        for beyond in (1e7, None):
            assert not best.passes(good | {name: {"q90": beyond}}, limits), name
    assert not best.passes(good | {"crossings": {"cases": 1}}, limits)
    margins = {"disk": {"q10": 0.01, "median": 0.9}, "delay_s": {"q10": None, "median": None}}
    assert not best.passes(good | {"margins": margins}, limits)


def test_of_two_controllers_of_one_structure_that_pass_the_one_that_bears_more_may_be_named():
    def margins(disk, delay_s):
        return {"margins": {"disk": {"q10": disk}, "delay_s": {"q10": delay_s}}}

    both = {"pi_simc": True, "pi": True}
    found = {"pi_simc": margins(0.45, 1.0), "pi": margins(0.6, None)}
    assert best.fragile(("pi_simc", "pi"), found, both) == "pi_simc"
    # the larger loss counts: a third of the delay margin, against a tenth of the disk margin
    found = {"pi_simc": margins(0.54, 1.5), "pi": margins(0.6, 1.0)}
    assert best.fragile(("pi_simc", "pi"), found, both) == "pi"
    assert best.fragile(("pi_simc", "pi"), found, both | {"pi": False}) == ""


def test_the_least_margins_of_a_search_are_those_of_the_weakest_tenth_of_the_training_plants(given):
    """A candidate that bears enough on the identified plant and on nine plants in ten fails with the
    tenth."""
    training = given.setting.rehearsal.training
    design = BY_NAME["pi"].design(given.problem, {"gain_factor": 0.5, "reset_factor": 1.5})
    rests = panel.rests(design.model, training, given.setting.limits)
    found = sorted(one.disk for one in scorecard.margins(training.plants, design.law, grid=80))
    tenth = found[round(0.1 * (len(found) - 1))]
    least = section(TuneWeights, "tune_weights").model_copy(
        update={"least_disk_margin": tenth, "least_delay_margin_s": 0.0}
    )
    assert np.isfinite(controller_search._cost(design, rests, least, given.setting))
    asked = least.model_copy(update={"least_disk_margin": (tenth + found[-1]) / 2})
    with pytest.raises(ValueError, match="on the weakest tenth of plants the disk margin is"):
        controller_search._cost(design, rests, asked, given.setting)


def test_the_shown_trajectories_are_of_a_typical_and_of_the_deciding_case(stored, result, given):
    rows, summary = stored
    shown = {key: np.array(column) for key, column in result.trajectories.items()}
    assert set(shown["case_name"]) == {"typical", "deciding"}
    steps, output = given.setting.rehearsal.judging.steps, given.machine.outputs[0].name
    assert len(shown["time_s"]) == 2 * steps * len(EVERYBODY)
    mine = (shown["contestant"] == "subspace_lqg") & (shown["case_name"] == "deciding")
    deciding = of(rows, "subspace_lqg")
    at = summary["deciding"]["case"]
    assert deciding["kind"][at] == summary["deciding"]["kind"]
    # the mean of the first output is one of those of which the worst counts
    late = np.abs((shown[output] - shown[f"{output}_reference"])[mine][-20:].mean())
    assert late <= deciding["settled_error_degC"][at] + 1e-9
    for signal in given.machine.inputs:
        applied = shown[f"{signal.name}_applied"][mine]
        assert applied.min() >= signal.low - 1e-9 and applied.max() <= signal.high + 1e-9


# ---- who takes part


def test_each_name_stands_once():
    assert len(BY_NAME) == len(CONTROLLERS)


@pytest.mark.parametrize(
    ("standing", "tuned_costs", "pair"),
    [
        ("subspace_lqg varx_riccati learned_kernel predictive_control", {}, "subspace_lqg learned_kernel"),
        (
            "subspace_lqg varx_riccati learned_kernel predictive_control",
            {"subspace_lqg": 2.2, "varx_riccati": 2.1, "learned_kernel": 2.0, "predictive_control": 1.9},
            "varx_riccati predictive_control",
        ),
        ("pi subspace_lqg predictive_control", {"pi": 1.0}, "subspace_lqg predictive_control"),
        ("subspace_lqg varx_riccati", {"learned_kernel": 1.0}, "subspace_lqg varx_riccati"),
        ("subspace_lqg", {}, "subspace_lqg learned_kernel"),
        ("hold pi", {}, "subspace_lqg learned_kernel"),
    ],
)
def test_each_kind_answers_by_the_one_that_stands_and_that_its_search_found_cheapest(
    standing, tuned_costs, pair
):
    assert table.answering_pair(standing.split(), tuned_costs) == tuple(pair.split())


def test_with_three_inputs_for_five_outputs_pi_is_refused_with_the_reason_and_the_others_go_on():
    few = small(3)
    weights = {name: values for name, values in few.weights.items() if name != "pi"}
    summary = judged(few, weights).summary
    why = "PI needs an input for each of the 5 outputs; found 3 inputs"
    assert summary["refused"] == {"pi_simc": why, "pi": why}
    assert set(summary["order"]) >= {"hold", "subspace_lqg", "varx_riccati", "learned_kernel"}


def test_where_the_record_determines_no_data_driven_controller_the_pair_is_of_two_model_based_ones(given):
    direct = {"learned_kernel": "too noisy; record longer", "predictive_control": "too short; record longer"}
    problem = given.problem._replace(kernel=None, trajectories=None, undetermined=direct)
    weights = {name: values for name, values in given.weights.items() if name not in direct}
    summary = judged(given._replace(problem=problem), weights).summary
    assert summary["refused"] == direct
    assert (summary["pair"]["a"], summary["pair"]["b"]) == ("subspace_lqg", "varx_riccati")


def test_one_whose_search_never_worked_is_refused_and_the_others_go_on(given):
    weights = {name: values for name, values in given.weights.items() if name != "varx_riccati"}
    summary = judged(given, weights).summary
    reason = "it could not be tuned: no candidate of its search kept the least margins of tune_weights"
    assert summary["refused"] == {"varx_riccati": reason}
    assert "varx_riccati" not in summary["contestants"] and "learned_kernel" in summary["contestants"]


def test_where_nobody_can_be_designed_the_stage_says_so_with_each_reason(given, monkeypatch):
    def no(problem, values):
        raise ValueError("too short")

    rows = [one if one.name == "hold" else one._replace(design=no) for one in CONTROLLERS]
    monkeypatch.setattr(table, "CONTROLLERS", rows)
    sentence = "found none: .*subspace_lqg: too short; .*record the machine longer, or change its inputs"
    with pytest.raises(ValueError, match=sentence):
        judged(given)


# ---- the same twice


def test_one_job_and_two_write_the_same_bytes(given, result, tmp_path):
    one = written(result, given.machine, tmp_path / "one")
    two = written(judged(given, jobs=2), given.machine, tmp_path / "two")
    assert one == two and len(one) == 3


def test_two_workers_of_a_cluster_write_the_bytes_of_one_machine(given, result, cluster, tmp_path):
    one = written(result, given.machine, tmp_path / "one")
    assert written(judged(given, execution=cluster.execution), given.machine, tmp_path / "two") == one


def test_a_killed_worker_of_a_cluster_costs_time_and_no_byte(
    given, result, mortal_cluster, tmp_path, monkeypatch
):
    workers = mortal_cluster.workers
    monkeypatch.setattr(pipeline.store.execution, "run_all", mortal_cluster.killing(workers[1]))
    made = judged(given, execution=mortal_cluster.execution)
    assert [worker.is_alive() for worker in workers] == [True, False]
    one = written(result, given.machine, tmp_path / "one")
    assert written(made, given.machine, tmp_path / "two") == one and len(one) == 3


# ---- tune_weights


@pytest.fixture(scope="module")
def tuned(given):
    return tuning_of(given)


class Tuned(NamedTuple):
    weights: dict
    history: dict
    refused: dict


def tuning_of(given: Small, jobs: int = 1) -> Tuned:
    settings = section(TuneWeights, "tune_weights").model_copy(
        update={"practical_initial": 4, "practical_evaluations": 9}
    )
    execution = params.Execution(backend="loky", jobs=jobs, scheduler="")
    results, refused = tune_weights.search_all(settings, given.problem, given.setting, execution)
    weights = {
        name: controller_search.tuned_values(name, result, given.problem) for name, result in results.items()
    }
    return Tuned(weights, tune_weights.candidates(results), refused)


def test_every_contestant_is_searched_with_the_same_budget_from_its_declared_start(given, tuned):
    rows = {key: np.array(column) for key, column in tuned.history.items()}
    searched = [one.name for one in CONTROLLERS if one.parameters]
    assert list(tuned.weights) == searched
    for name in searched:
        mine = rows["contestant"] == name
        np.testing.assert_array_equal(rows["evaluation"][mine], np.arange(1, 10))
        assert rows["chosen"][mine].sum() == 1
        start = ", ".join(f"{key} {value:.4g}" for key, value in given.weights[name].items())
        assert rows["values"][mine][0] == start
        assert tuned.weights[name]["evaluations"] == 9


def test_a_chosen_candidate_is_no_dearer_than_the_start_and_lies_within_its_bounds(given, tuned):
    for name, values in tuned.weights.items():
        if values["cost_at_start"] is not None:
            assert values["cost"] <= values["cost_at_start"], name
        low, _, high = table.bounds(BY_NAME[name], given.problem)
        theta = np.array([values[p.name] for p in BY_NAME[name].parameters])
        assert (theta >= low * (1 - 1e-12)).all() and (theta <= high * (1 + 1e-12)).all(), name
        share = np.log(theta / low) / np.log(high / low)
        beside = [p.name for p, place in zip(BY_NAME[name].parameters, share, strict=True)
                  if min(place, 1 - place) <= controller_search.AT_BOUND]  # fmt: skip
        assert values["at_bound"] == beside, name


def test_what_was_tuned_is_what_is_judged(given, tuned):
    summary = judged(given, tuned.weights).summary
    for name, values in tuned.weights.items():
        told = summary["contestants"][name]["tuned"]
        assert told == {p.name: values[p.name] for p in BY_NAME[name].parameters}


def test_a_contestant_that_cannot_be_designed_is_refused_by_its_search_and_the_others_are_tuned():
    made = tuning_of(small(3))
    assert made.refused == {"pi": "PI needs an input for each of the 5 outputs; found 3 inputs"}
    assert {"subspace_lqg", "varx_riccati"} <= made.weights.keys()


def test_one_of_whose_candidates_none_works_is_refused_with_the_last_reason_and_the_others_are_tuned(given):
    shaky = given.problem.window._replace(Theta=-given.problem.window.Theta)
    made = tuning_of(given._replace(problem=given.problem._replace(window=shaky)))
    assert "the disk margin is" in made.refused["varx_riccati"]
    assert {"pi", "subspace_lqg"} <= made.weights.keys()


# ---- weights

SEARCHED = {"cost": 1.0, "cost_at_start": None, "failed": 0, "evaluations": 1, "at_bound": []}


@pytest.mark.parametrize(
    ("stored", "message"),
    [
        ({"practical": {"q": [1.0] * 5, "r": [1.0] * 7}}, "contestants: Field required"),
        ({"contestants": {}}, "contestants: .* at least 1 item"),
        ([], "valid dictionary"),
        ({"contestants": {"pi": SEARCHED | {"q": 3}}}, r"contestants\.pi\.q: .* valid list"),
        ({"contestants": {"pi": 3}}, r"contestants\.pi: .* valid dictionary"),
        ({"contestants": {"pi": {"gain_factor": 1.0}}}, r"contestants\.pi\.cost: Field required"),
        ({"contestants": {"pi": SEARCHED | {"gain_factor": float("nan")}}}, "gain_factor: .* finite number"),
        ({"contestants": {"pi": SEARCHED | {"gain_factor": -1.0}}}, "gain_factor: .* greater than 0"),
    ],
)
def test_weights_that_are_none_are_refused_in_a_sentence(tmp_path, stored, message):
    path = tmp_path / "weights.json"
    path.write_text(json.dumps(stored))
    with pytest.raises(ValueError, match=message) as refusal:
        evaluate_temperature.read_weights(path)
    assert str(path) in str(refusal.value) and "\n" not in str(refusal.value)


def test_a_kernel_that_was_tuned_and_is_no_longer_determined_is_named_as_refused(given):
    problem = given.problem._replace(kernel=None, undetermined={"learned_kernel": "record longer"})
    designs, refused = table.design_controllers(problem, given.weights)
    assert "learned_kernel" not in designs
    assert refused == {"learned_kernel": "record longer"}


def test_a_reference_that_the_declared_machine_cannot_hold_is_named_with_what_binds(given):
    halves = section(Panel, "panel")
    half = {"plants": 2, "starts_degC": [120.0]}
    halves = halves.model_copy(
        update={name: getattr(halves, name).model_copy(update=half) for name in ("judging", "training")}
    )
    truth = given.problem.plant
    assert panel.from_declaration(halves, given.machine, baam(), [truth]).infeasible == []
    weak = [signal.model_copy(update={"high": 0.5}) for signal in given.machine.inputs]
    missed = panel.from_declaration(
        halves, given.machine.model_copy(update={"inputs": weak}), baam(), [truth]
    ).infeasible
    assert [one["output"] for one in missed]
    for one in missed:
        assert one["reachable_degC"] < one["asked_degC"] - 0.1
        assert one["binding"].endswith("at 0.5 percent")


def test_what_the_bands_of_a_plant_leave_open_of_a_loop_grows_with_the_bands(given):
    def found(spread: float):
        gains = 1 + spread * np.random.default_rng(3).standard_normal(6)
        one = given.problem.plant
        family = [one, *(one._replace(B=gain * one.B) for gain in gains)]
        weights = given.weights["subspace_lqg"]
        problem = given.problem._replace(family=family)
        return redesigned("subspace_lqg", problem, weights, given.setting)

    small, large = found(0.02), found(0.3)
    assert found(0.0) == (0.0, 0, 6)
    assert small[0] < 0.01 and small[1] == 0 < large[1]


def test_a_resample_of_the_record_that_gives_another_controller_is_counted(given):
    """Of three plants that the record cannot tell apart one has its first two heaters exchanged."""
    one = given.problem.plant
    exchanged = one._replace(B=one.B[:, [1, 0, 2, 3, 4, 5, 6]])
    problem = given.problem._replace(family=[one, one, exchanged, one])
    found = redesigned("pi", problem, {"gain_factor": 1.0, "reset_factor": 1.0}, given.setting)
    assert found == (0.0, 1, 3)


def test_the_margin_that_is_judged_is_that_of_the_plant_that_a_tenth_lie_below():
    found = [scorecard.Margins(0.1 * k, float("inf") if k > 5 else float(k), True) for k in range(11)]
    told = evaluation._margin_figures(found)
    assert told is not None
    assert told["disk"] == {"q10": 0.1, "median": 0.5, "worst": 0.0}
    assert told["delay_s"] == {"q10": 1.0, "median": 5.0, "worst": 0.0}
