"""The judge: the same cases for both, seeds of its own, and figures that a worse controller cannot hide."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from pipeline.deposition.workflow.tables import SCORES
from pipeline.nightly import judge
from pipeline.nightly.decision import KEPT, PROMOTED, Evidence, decide
from pipeline.nightly.settings import Loop, Nightly
from pipeline.setpoint.workflow import tables
from pipeline.store import artifacts, params
from pipeline.temperature import plant, window
from pipeline.temperature.plant import baam, simulate
from tests.nightly.toy_nights import SETTINGS

TEMPERATURE = {
    "judge": "temperature", "cases": "", "recordings": "datasets/raw/temperature",
    "artifacts": ["datasets/identify_plant/plant.parquet", "datasets/learn_kernel/window.parquet",
    "datasets/tune_weights/weights.json"],
}  # fmt: skip


@pytest.fixture
def project(tmp_path, root, monkeypatch):
    """params.yaml with a small panel, and controllers of the study's machine below `datasets` (weights 1 and
    1) and `champion/temperature` (inputs cost a thousand times as much: it creeps)."""
    declared = params.read(root / "params.yaml")
    declared["nightly"] = SETTINGS | {
        "loops": {"temperature": TEMPERATURE},
        "holdout": SETTINGS["holdout"] | {"steps": 120},
    }
    (tmp_path / "params.yaml").write_text(yaml.safe_dump(declared))
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(1)
    u = rng.uniform(-5, 5, (800, 7))
    y = simulate(baam(), u, np.zeros(6))[1] + 0.05 * rng.standard_normal((800, 5))
    long = window.learn([u], [y], longest=4)
    for folder, r in (("datasets", 1.0), ("champion/temperature", 1000.0)):
        artifacts.write_arrays(f"{folder}/identify_plant/plant.parquet", "plant", 1, plant.stored([baam()]))
        artifacts.write_arrays(f"{folder}/learn_kernel/window.parquet", "window", 1, window.stored(long))
        artifacts.write_json(
            f"{folder}/tune_weights/weights.json",
            {"practical": {"q": [1.0] * 5, "r": [r] * 7, "observer_tau": 1.0}},
        )
    return params.load(Nightly, "nightly")


def test_both_are_judged_on_the_same_cases_and_the_same_noise_every_time(project):
    judged = judge.judge(project.loops["temperature"], project)
    challenger, champion, again = (
        judged.measure(Path(folder)) for folder in ("datasets", "champion/temperature", "datasets")
    )
    assert (
        challenger == again
        and challenger.panel == champion.panel
        and list(challenger.cases) == list(champion.cases)
    )
    # nominal, 7 inputs up and down, and more heat loss
    assert len({block for block, _ in challenger.cases.values()}) == 16
    # the one that creeps costs more in every block, and the rule says so both ways round
    rule = {"allowed": dict.fromkeys(champion.guards, 1e9), "alarms": [], "seed": 1}
    assert decide(champion, challenger, project.rule, **rule).decision == PROMOTED
    assert decide(challenger, champion, project.rule, **rule).decision == KEPT


def test_another_panel_has_another_name(project):
    other = project.model_copy(update={"holdout": project.holdout.model_copy(update={"seeds": [902]})})
    first, second = (
        judge.judge(settings.loops["temperature"], settings).measure(Path("datasets"))
        for settings in (project, other)
    )
    assert first.panel != second.panel


def test_a_controller_that_destabilises_a_plant_says_so(project):
    learned = window.restored(artifacts.read_arrays("datasets/learn_kernel/window.parquet", "window", 1))
    Theta = learned.Theta.copy()
    Theta[:, : 7 * learned.N] *= -1  # every heater taken for a cooler
    artifacts.write_arrays(
        "datasets/learn_kernel/window.parquet", "window", 1, window.stored(learned._replace(Theta=Theta))
    )
    assert (
        judge.judge(project.loops["temperature"], project).measure(Path("datasets")).guards["unstable_plants"]
        > 0
    )


def test_a_part_s_chosen_composer_is_its_case(project):
    columns = {
        "part": ["a", "a", "b"], "material": ["A", "A", "A"], "composer": ["basis", "on_off", "basis"],
        "chosen": [True, False, True],
        "rms_percent_of_on_off": [1.0, 100.0, 2.0], "predicted_percent": [1.0, np.nan, 2.0],
        "worst_line_volume_percent": [0.5, 90.0, np.nan],
    }  # fmt: skip
    artifacts.write_table("datasets/compose_parts/scores.parquet", SCORES, columns)
    evidence = judge.judge(
        Loop(artifacts=["x"], judge="deposition", cases="", recordings=""), project
    ).measure(Path("datasets"))
    assert evidence.cases == {"a, A": ("a, A", 1.0), "b, A": ("b, A", 2.0)} and evidence.guards == {
        "worst_line_volume_percent": 0.5
    }


def test_a_setpoint_case_costs_the_runs_that_do_not_settle(project):
    rows = [
        ("ours", "paper", "calm", True, 99.0, 12.0),
        ("ours", "recorded", "clog", True, 95.0, 30.0),
        ("ours", "recorded", "other", False, 10.0, 50.0),
        ("pid", "paper", "calm", True, 50.0, 9.0),
    ]
    named = {
        "controller": [r[0] for r in rows], "simulator": [r[1] for r in rows], "case": [r[2] for r in rows],
        "counts": [r[3] for r in rows],
        "settled_percent": [r[4] for r in rows], "p90_steps": [r[5] for r in rows],
    }  # fmt: skip
    filler = {
        column.name: ["agent"] * 4
        if str(column.type) == "string"
        else np.ones(4, int)
        if "int" in str(column.type)
        else np.ones(4)
        for column in tables.SCOREBOARD.columns
    }
    artifacts.write_table("datasets/evaluate_setpoint/scoreboard.parquet", tables.SCOREBOARD, filler | named)
    artifacts.write_json("datasets/evaluate_setpoint/choice.json", {"name": "ours"})
    evidence = judge.judge(Loop(artifacts=["x"], judge="setpoint", cases="", recordings=""), project).measure(
        Path("datasets")
    )
    assert {name: cost for name, (_, cost) in evidence.cases.items()} == {
        "paper: calm": 2.0,
        "recorded: clog": 6.0,
    }
    assert evidence.guards == {"worst_unsettled_percent": 6.0, "slowest_p90_steps": 30.0}


def test_a_file_of_cases_that_lacks_its_costs_is_refused(project):
    artifacts.write_json(
        "datasets/cases.json", {"panel": "a", "cases": {"one": {"block": "b"}}, "guards": {}}
    )
    loop = Loop(artifacts=["datasets/cases.json"], judge="cases", cases="datasets/cases.json", recordings="")
    with pytest.raises(
        ValueError,
        match="expected panel, cases with block and cost, and guards with value and allowed, found no 'cost'",
    ):
        judge.judge(loop, project).measure(Path("datasets"))


@pytest.mark.parametrize("loop", ["deposition", "setpoint"])
def test_a_guard_may_be_worse_by_the_percentage_that_is_declared_and_no_more(project, loop):
    """5 % of 2.0 is 0.1: 2.1 passes and 2.11 does not."""
    settings = project.model_copy(
        update={"rule": project.rule.model_copy(update={"worst_case_percent": 5.0})}
    )
    judged = judge.judge(Loop(artifacts=["x"], judge=loop, cases="", recordings=""), settings)
    champion = Evidence("a", {f"part {k}": (f"part {k}", 2.0) for k in range(8)}, {"worst": 2.0})
    allowed = judged.allowed(champion)
    assert allowed == {"worst": pytest.approx(0.1)}
    better = champion._replace(cases={name: (block, 1.0) for name, (block, _) in champion.cases.items()})
    for guard, decision in ((2.1, PROMOTED), (2.11, KEPT)):
        decided = decide(
            champion,
            better._replace(guards={"worst": guard}),
            project.rule,
            allowed=allowed,
            alarms=[],
            seed=1,
        )
        assert decided.decision == decision, decided.reasons


def test_the_temperature_loop_allows_its_worst_case_and_its_hold_out_a_percentage(project):
    rule = project.rule.model_copy(update={"worst_case_percent": 5.0, "holdout_error_percent": 10.0})
    settings = project.model_copy(update={"rule": rule})
    champion = Evidence("a", {}, {"worst_case": 40.0, "holdout_error_degC": 0.5})
    allowed = judge.judge(project.loops["temperature"], settings).allowed(champion)
    assert allowed == {
        "worst_case": pytest.approx(2.0),
        "settled_error_degC": rule.settled_error_degC,
        "holdout_error_degC": pytest.approx(0.05),
    }
