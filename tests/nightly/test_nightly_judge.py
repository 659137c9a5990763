"""The judge: the same cases for both, seeds of its own, and figures that a worse controller cannot hide."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from pipeline.deposition.tables import SCORES
from pipeline.nightly import judge, promoting
from pipeline.nightly.decision import FIRST, KEPT, PROMOTED, CaseCosts, decide
from pipeline.nightly.records import Champion, ChampionState, Night
from pipeline.nightly.settings import HoldOut, Nightly, NightlyLoop
from pipeline.report.nightly import page as nightly_page
from pipeline.setpoint import tables
from pipeline.store import artifacts, params
from pipeline.temperature import plant
from pipeline.temperature.controllers import window
from pipeline.temperature.controllers.table import CONTROLLERS as CONTESTANTS
from pipeline.temperature.plant import baam, simulate
from tests.nightly import shifts_recorded as nights
from tests.nightly.toy_nights import SETTINGS

TEMPERATURE = {
    "judge": "temperature", "cases": "", "recordings": "datasets/raw/temperature",
    "artifacts": ["datasets/identify_plant/plant.parquet", "datasets/learn_kernel/window.parquet",
    "datasets/tune_weights/weights.json"],
}  # fmt: skip


@pytest.fixture
def project(tmp_path, root, monkeypatch):
    """params.yaml with a small panel, and controllers of the study's machine below `datasets` (inputs cost 30
    times what errors do) and `champion/temperature` (a hundred thousand times: it creeps)."""
    declared = params.read(root / "params.yaml")
    declared["nightly"] = SETTINGS | {
        "loops": {"temperature": TEMPERATURE},
        "holdout": SETTINGS["holdout"] | {"steps": 120, "controller": "varx_riccati"},
    }
    (tmp_path / "params.yaml").write_text(yaml.safe_dump(declared))
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(1)
    u = rng.uniform(-5, 5, (800, 7))
    y = simulate(baam(), u, np.zeros(6))[1] + 0.05 * rng.standard_normal((800, 5))
    long = window.learn([u], [y], longest=4)
    for folder, r in (("datasets", 30.0), ("champion/temperature", 1e5)):
        artifacts.write_arrays(f"{folder}/identify_plant/plant.parquet", "plant", 1, plant.stored([baam()]))
        artifacts.write_arrays(f"{folder}/learn_kernel/window.parquet", "window", 1, window.stored(long))
        artifacts.write_json(
            f"{folder}/tune_weights/weights.json",
            {
                "contestants": {
                    "subspace_lqg": {"effort_weight": r, "observer_tau": 1.0, "integral": 0.02},
                    "varx_riccati": {"effort_weight": r, "integral": 0.02},
                }
            },
        )
    return params.load(Nightly, "nightly")


def change(settings: Nightly, section: str, **changes) -> Nightly:
    return settings.model_copy(update={section: getattr(settings, section).model_copy(update=changes)})


def measure(settings: Nightly, folder: str = "datasets", kind: str = "temperature") -> CaseCosts:
    """What the judge measures of the controller below `folder`."""
    loop = NightlyLoop(artifacts=["x"], judge=kind, cases="", recordings="")
    loop = settings.loops["temperature"] if kind == "temperature" else loop
    return judge.judge(loop, settings).measure(Path(folder))


def decided(champion: CaseCosts | None, challenger: CaseCosts, settings: Nightly, **allowed: float):
    return decide(champion, challenger, settings.rule, allowed=allowed, alarms=[], seed=1)


def test_both_are_judged_on_the_same_cases_and_the_same_noise_every_time(project):
    challenger, champion, again = map(
        measure, [project] * 3, ["datasets", "champion/temperature", "datasets"]
    )
    assert challenger == again and challenger.panel == champion.panel
    assert list(challenger.cases) == list(champion.cases)
    assert len({block for block, _ in challenger.cases.values()}) == project.holdout.plants
    # the one that creeps costs more in every block, and the rule says so both ways round
    allowed = dict.fromkeys(champion.guards, 1e9)
    assert decided(champion, challenger, project, **allowed).decision == PROMOTED
    assert decided(challenger, champion, project, **allowed).decision == KEPT
    # another panel has another name
    assert measure(change(project, "holdout", seed=902)).panel != challenger.panel
    # weights that hold another version's too are read as today's
    path = "datasets/tune_weights/weights.json"
    artifacts.write_json(path, artifacts.read_json(path) | {"practical": {"subspace_lqg": 3.0}})
    assert measure(project) == challenger


V01 = {"practical": {"q": [1.0] * 5, "r": [1.0] * 7, "observer_tau": 1.0}}
SUBSPACE = {"contestants": {"subspace_lqg": {"effort_weight": 1.0, "observer_tau": 1.0, "integral": 0.02}}}


@pytest.mark.parametrize(
    ("name", "weights", "sentence"),
    [
        ("pi", V01, "expected the tuned parameters of pi, .*, found none; let tune_weights tune it"),
        ("varx_riccati", SUBSPACE, "parameters of varx_riccati, effort_weight, integral, found none"),
        ("subspace_lqg", {"contestants": {"subspace_lqg": {"q": [1.0]}}}, "of subspace_lqg, .*, found q;"),
    ],
)
def test_a_champion_that_cannot_be_designed_is_named_and_stays(project, name, weights, sentence):
    settings = change(project, "holdout", controller=name)
    settings.loops["temperature"].artifacts.extend(promoting.OPTIONAL)
    for folder in ("datasets", "champion/temperature"):
        artifacts.write_arrays(f"{folder}/identify_plant/spread.parquet", "spread", 1, plant.stored([baam()]))
        artifacts.write_json(f"{folder}/tune_weights/weights.json", weights)
    with pytest.raises(judge.NotComparable, match=sentence) as refused:
        measure(settings, "champion/temperature")
    assert "\n" not in str(refused.value)
    present = Champion("night-0001", "", "", {"md5": "0"})
    state = ChampionState({"temperature": present})
    quiet = Night(2, "night-0002", "2030-01-01T02:00:00+00:00")
    decision = promoting.judge_loop(settings, "temperature", quiet, state, None)
    assert decision.decision == KEPT and "cannot be compared: " in decision.reasons[0]


def test_the_contestants_that_the_night_may_judge_are_all_but_doing_nothing_and_the_yardstick():
    names = HoldOut.model_fields["controller"].annotation.__args__
    assert set(names) == {one.name for one in CONTESTANTS} - {"hold", "exact_model"} | {judge.PAGE}


def test_a_recorded_machines_panel_is_drawn_around_its_hold_out_recordings_once_and_for_all(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    Path("params.yaml").write_text(yaml.safe_dump(nights.settings()))
    settings = params.load(Nightly, "nightly")
    nights.write(Path(settings.holdout.recordings) / "calm.csv", nights.a_night(1, 0))
    first, again = (judge.frozen_panel(settings.holdout) for _ in range(2))
    assert first.name == again.name and len(first.records) == 1
    truth = nights.machine()
    rises = [
        plant.markov_parameters(one, 200)[:, 0, 0].sum() / plant.markov_parameters(truth, 200)[:, 0, 0].sum()
        for one in first.rehearsal.judging.plants
    ]
    # 1 +- 0.15 of the input, at the side of which loss, speed and a sample of delay move little
    assert 0.6 < min(rises) < 0.95 and 1.02 < max(rises) < 1.3


def test_the_margin_that_guards_is_that_of_the_weakest_tenth_of_plants_as_the_page_asks(project):
    margins = judge.judged(judge.frozen_panel(project.holdout), Path("datasets"), "varx_riccati").margins
    guards = measure(change(project, "rule", least_disk_margin=1.9)).guards
    disks = sorted(margin.disk for margin in margins)
    assert guards["margin_short_of_least"] == 1.9 - disks[round(0.1 * (len(disks) - 1))]
    assert len({margin.disk for margin in margins}) == project.holdout.plants


def test_a_controller_that_destabilises_a_plant_says_so(project):
    path = "datasets/learn_kernel/window.parquet"
    learned = window.restored(artifacts.read_arrays(path, "window", 1))
    Theta = learned.Theta.copy()
    Theta[:, : 7 * learned.N] *= -1  # every heater taken for a cooler
    artifacts.write_arrays(path, "window", 1, window.stored(learned._replace(Theta=Theta)))
    assert measure(project).guards["unstable_plants"] > 0


def score(errors: list[float], lines: list[float]) -> None:
    """What compose_parts scored: of each part the chosen composer, and on-off control beside it."""
    parts = [chr(97 + k) for k in range(len(errors))]
    columns = {
        "part": parts + parts, "material": ["A"] * 2 * len(parts),
        "composer": ["basis"] * len(parts) + ["on_off"] * len(parts),
        "chosen": [True] * len(parts) + [False] * len(parts),
        "rms_percent_of_on_off": errors + [100.0] * len(parts),
        "predicted_percent": [np.nan] * 2 * len(parts),
        "worst_line_volume_percent": lines + [90.0] * len(parts),
    }  # fmt: skip
    artifacts.write_table("datasets/compose_parts/scores.parquet", SCORES, columns)


def test_a_part_s_chosen_composer_is_its_case(project):
    score([1.0, 2.0, 0.0], [0.5, np.nan, 0.2])
    evidence = measure(project, kind="deposition")
    # no case costs nothing
    assert evidence.cases == {"a, A": ("a, A", 1.0), "b, A": ("b, A", 2.0), "c, A": ("c, A", 1e-3)}
    assert evidence.guards == {"worst_line_volume_percent": 0.5}
    # a challenger whose lines are not judged has no worst line, and is no better for it
    score([1.0], [np.nan])
    unjudged = measure(project, kind="deposition")
    assert unjudged.guards == {}
    decision = decided(evidence, unjudged._replace(panel=evidence.panel), project)
    assert decision.decision == KEPT and "guard worst_line_volume_percent is inf" in str(decision.reasons)


def test_a_setpoint_case_costs_the_runs_that_do_not_settle(project):
    rows = [
        ("ours", "paper", "calm", True, 99.0, 12.0),
        ("ours", "recorded", "clog", True, 95.0, 30.0),
        ("ours", "recorded", "other", False, 10.0, 50.0),
        ("pid", "paper", "calm", True, 50.0, 9.0),
    ]
    keys = ("controller", "simulator", "case", "counts", "settled_percent", "p90_steps")
    named = dict(zip(keys, map(list, zip(*rows, strict=True)), strict=True))
    filler = {
        column.name: ["agent"] * 4 if str(column.type) == "string" else np.ones(4).astype(str(column.type))
        for column in tables.SCOREBOARD.columns
        if column.name not in named
    }
    artifacts.write_table("datasets/evaluate_setpoint/scoreboard.parquet", tables.SCOREBOARD, filler | named)
    artifacts.write_json("datasets/evaluate_setpoint/choice.json", {"name": "ours"})
    evidence = measure(project, kind="setpoint")
    costs = {name: cost for name, (_, cost) in evidence.cases.items()}
    assert costs == {"paper: calm": 2.0, "recorded: clog": 6.0}
    assert evidence.guards == {"worst_unsettled_percent": 6.0, "slowest_p90_steps": 30.0}


@pytest.mark.parametrize(
    ("cases", "guard", "found"),
    [
        ('{"one": {"block": "b"}}', "1", "found no 'cost'"),
        ('{"one": {"block": "b", "cost": 0}}', "1", "found one costs 0"),
        ('{"one": {"block": "b", "cost": NaN}}', "1", "found one costs nan"),
        ('{"one": {"block": "b", "cost": -1e308}}', "1", "found one costs -1e\\+308"),
        ('{"one": {"block": "b", "cost": "x"}}', "1", "found another form"),
        ('{"one": {"block": "b", "cost": 1}}', "NaN", "found value nan of unstable"),
        ('{"one": {"block": "b", "cost": 1}}', '"x"', "found another form"),
        ("{}", "1", "found no case"),
        ("[]", "1", "found another form"),
    ],
)
def test_a_file_of_cases_that_says_nothing_promotes_nothing(project, cases, guard, found):
    guards = f'{{"unstable": {{"value": {guard}, "allowed": 0}}}}'
    path = "datasets/cases.json"
    artifacts.write_text(path, f'{{"panel": "a", "cases": {cases}, "guards": {guards}}}')
    loop = NightlyLoop(artifacts=[path], judge="cases", cases=path, recordings="")
    with pytest.raises(ValueError, match=f"^datasets/cases.json: expected .*{found}"):
        judge.judge(loop, project).measure(Path("datasets"))


def costs(cost: float, **guards: float) -> CaseCosts:
    return CaseCosts("a", {f"case {k}": (f"plant {k}", cost) for k in range(8)}, guards)


def test_what_costs_the_same_is_no_better_by_nothing_and_not_by_minus_nothing(project):
    reasons = decided(costs(1.0), costs(1.0), project).reasons
    assert reasons == ["the challenger is no better: its cases cost 0.0 % more (0.0 to 0.0 %)"]


def test_a_first_champion_needs_a_case_and_a_count_of_unstable_plants(project):
    fit = costs(1.0, unstable_plants=0.0)
    unfit = (fit._replace(cases={}), fit._replace(guards={"unstable_plants": np.nan}))
    decisions = [decided(None, challenger, project).decision for challenger in (fit, *unfit)]
    assert decisions == [FIRST, KEPT, KEPT]


@pytest.mark.parametrize("loop", ["deposition", "setpoint"])
def test_a_guard_may_be_worse_by_the_percentage_that_is_declared_and_no_more(project, loop):
    """5 % of 2.0 is 0.1: 2.1 passes and 2.11 does not."""
    settings = change(project, "rule", worst_case_percent=5.0)
    judged = judge.judge(NightlyLoop(artifacts=["x"], judge=loop, cases="", recordings=""), settings)
    champion = costs(2.0, worst=2.0)
    allowed = judged.allowed(champion)
    assert allowed == {"worst": pytest.approx(0.1)}
    for guard, decision in ((2.1, PROMOTED), (2.11, KEPT)):
        assert decided(champion, costs(1.0, worst=guard), project, **allowed).decision == decision


def test_the_temperature_loop_allows_its_worst_case_and_its_hold_out_a_percentage(project):
    settings = change(project, "rule", worst_case_percent=5.0, holdout_error_percent=10.0)
    allowed = judge.judge(project.loops["temperature"], settings).allowed
    assert allowed(costs(1.0, worst_case=40.0, holdout_error_degC=0.5)) == {
        "worst_case": pytest.approx(2.0),
        "settled_error_degC": settings.rule.settled_error_degC,
        "holdout_error_degC": pytest.approx(0.05),
    }
    # what a champion did not measure may not be worse
    assert allowed(costs(1.0, worst_case=40.0))["holdout_error_degC"] == 0.0


def test_every_plant_start_and_reference_is_a_case_and_the_dearest_plant_guards(project):
    asked = {"starts_degC": [20.0, 60.0], "reference_offsets_degC": [0.0, 7.0], "plants": 3, "steps": 120}
    settings = change(project, "holdout", **asked)
    evidence = measure(settings)
    reference = judge.frozen_panel(settings.holdout).machine.outputs[0].reference
    assert set(evidence.cases) == {
        f"plant {p}, {start:g} °C to {reference + offset:g} °C"
        for p in range(3)
        for start in (20.0, 60.0)
        for offset in (0.0, 7.0)
    } | {f"plant {p}, {reference:g} °C to {reference:g} °C" for p in range(3)}  # disturbed there
    by_plant = [
        np.mean([cost for block, cost in evidence.cases.values() if block == f"plant {p}"]) for p in range(3)
    ]
    assert evidence.guards["worst_case"] == pytest.approx(max(by_plant)) and max(by_plant) > min(by_plant)


def test_the_hold_out_error_is_the_root_mean_square_of_one_step(project):
    rng, none = np.random.default_rng(3), np.zeros((400, 7))
    y = simulate(baam(), none, np.zeros(6))[1]
    noise = rng.uniform(0.2, 0.6, y.shape)  # of one sign: a cube would be another number
    predicted = judge._predictor(
        Path("datasets"), "subspace_lqg", judge.frozen_panel(project.holdout).machine
    )
    found = judge._prediction_error(predicted, [(none, y + noise)])
    assert 0.1 < found < 1.0
    twice = judge._prediction_error(predicted, [(none, y + noise), (none, y + noise)])
    assert twice == pytest.approx(found)
    assert judge._prediction_error(predicted, []) is None


def test_hold_out_records_are_cut_at_gaps_segments_and_masked_inputs(project):
    machine = judge.frozen_panel(project.holdout).machine
    n = 200
    record = {"segment": np.repeat([0, 1], [100, 100])}
    for one in (*machine.inputs, *machine.outputs):
        record |= {one.name: np.arange(n, dtype=float), f"{one.name}_masked": np.zeros(n, bool)}
    record[f"{machine.inputs[0].name}_masked"][[30, 60, 130]] = True
    record[f"{machine.outputs[0].name}_masked"][45] = True  # an output may miss
    pairs = judge.segments(record, machine)
    # 30 samples count, 29 do not
    assert [(int(u[0, 0]), len(u)) for u, _ in pairs] == [(0, 30), (61, 39), (100, 30), (131, 69)]
    assert all(np.isfinite(u).all() and len(u) == len(y) for u, y in pairs)
    record[f"{machine.inputs[0].name}_masked"][59] = True
    record[f"{machine.inputs[0].name}_masked"][31] = True
    assert (32, 27) not in [(int(u[0, 0]), len(u)) for u, _ in judge.segments(record, machine)]


def test_a_hold_out_recording_that_cannot_be_read_ends_the_judging_with_its_reason(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("params.yaml").write_text(yaml.safe_dump(nights.settings()))
    settings = params.load(Nightly, "nightly")
    folder = Path(settings.holdout.recordings)
    with pytest.raises(ValueError, match="expected recordings that nothing is trained on, found none"):
        judge.frozen_panel(settings.holdout)
    nights.write(folder / "calm.csv", nights.a_night(1, 0))
    (folder / "torn.csv").write_text("time_s,heater_1\n0,abc\n")
    with pytest.raises(ValueError, match="torn.csv"):
        judge.frozen_panel(settings.holdout)


def test_a_controller_is_designed_for_what_it_was_tuned_for_not_for_the_nights_cases(project, monkeypatch):
    """PI's gains depend on the horizon that its responses are followed over: a night of shorter cases would
    judge another PI than the pages."""
    artifacts.write_arrays("datasets/identify_plant/spread.parquet", "spread", 1, plant.stored([baam()] * 2))
    path = "datasets/tune_weights/weights.json"
    stored = artifacts.read_json(path)
    designed_for = []
    pi = judge.table.BY_NAME["pi_simc"]

    def watched(problem, values):
        designed_for.append((problem.horizon, problem.noise.tolist()))
        return pi.design(problem, values)

    monkeypatch.setitem(judge.table.BY_NAME, "pi_simc", pi._replace(design=watched))
    frozen = judge.frozen_panel(project.holdout)
    artifacts.write_json(path, stored | {"design": {"horizon_steps": 450, "noise_degC": [0.3] * 5}})
    judge.judged(frozen, Path("datasets"), "pi_simc")
    artifacts.write_json(path, stored)  # of a version that did not say so
    judge.judged(frozen, Path("datasets"), "pi_simc")
    assert designed_for[0] == (450, [0.3] * 5)
    assert designed_for[1][0] == frozen.settings.steps != frozen.rehearsal.judging.steps


def test_figures_beyond_meaning_are_words_in_the_night_s_sentences(project):
    decision = decided(costs(1.0, worst_case=1.0), costs(np.inf, worst_case=np.inf), project)
    assert decision.reasons[0] == (
        "the challenger is no better: its cases cost beyond 1,000 % more (beyond 1,000 % to beyond 1,000 %)"
    )
    page = nightly_page.render(
        [Night(1, "night-0001", "2030-01-01T02:00:00+00:00", decisions={"temperature": decision})],
        ChampionState(),
        project,
    )
    assert "cases cost beyond 1,000\u202f% more" in page and "99,900" not in page and "99900" not in page
