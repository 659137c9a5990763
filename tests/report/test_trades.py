"""What a controller trades, plant by plant, and which stages were made
anew: against figures made by hand and dvc.yaml."""

import re
from pathlib import Path

import numpy as np
import yaml

from pipeline.report.index import workflow
from pipeline.report.temperature import pairs, trades
from pipeline.store import artifacts
from stages.report import main
from tests.report import made
from tests.report.test_pages import INDEX as PAGE_ONE
from tests.report.test_pages import TEMPERATURE, Page


def test_the_front_holds_whom_no_other_beats_in_both():
    points = {
        "cheap": (1.0, 5.0),
        "good": (3.0, 1.0),
        "between": (2.0, 2.0),
        "beaten": (2.5, 2.5),
        "worst": (3.0, 5.0),
    }
    assert trades.front(points) == ["cheap", "between", "good"]
    # two that are equal do not beat one another
    assert trades.front({"a": (1.0, 1.0), "b": (1.0, 1.0)}) == ["a", "b"]


def test_the_hardest_plant_is_the_last_one_with_its_largest_gap(project):
    made.write(project, worst={"window": 110.0})
    main()
    labels = re.findall(r'aria-label="(Data-driven: worst run of the easiest[^"]*)"', TEMPERATURE.read_text())
    # by hand: 110 (0.01 + 0.99 plant + 0.0001 seed), plants 0 and 1, seeds to 3
    assert [label.replace("\u202f", " ") for label in labels] == [
        "Data-driven: worst run of the easiest plant 1.1 %, of the hardest 110 %; 1 of 2 plants beyond 50 %"
    ]


def test_the_drawn_stages_are_those_of_dvc_yaml_and_read_what_they_read_there(root):
    stages = yaml.safe_load((root / "dvc.yaml").read_text())["stages"]
    written = {
        path: stage
        for stage, entry in stages.items()
        for kind in ("outs", "metrics")
        for out in entry.get(kind, [])
        for path in out
    }
    reads = {
        stage: {
            written[path] for dep in entry["deps"] for path in written if f"{dep}/".startswith(f"{path}/")
        }
        for stage, entry in stages.items()
        if stage != "report"
    }
    assert {stage: set(found) for stage, found in workflow.READS.items()} == reads, (
        "add the stage to READS in pipeline/report/index/workflow.py"
    )


def test_no_two_stages_share_a_place_and_every_arrow_points_right():
    at = workflow.places(workflow.READS)
    assert len(set(at.values())) == len(at)
    assert all(at[read][0] < at[stage][0] for stage, found in workflow.READS.items() for read in found)
    # evaluate_temperature reads identify_plant by way of tune_weights too: one arrow is enough
    assert workflow.reduced(workflow.READS)["evaluate_temperature"] == ["learn_kernel", "tune_weights"]


def test_a_stage_is_as_accepted_made_anew_or_not_there(project):
    main()
    assert "No run was accepted yet: nothing says what is new." in Page(PAGE_ONE).text
    metrics = {
        path.stem: artifacts.read_json(path)
        for path in Path("reports/metrics").glob("*.json")
        if path.stem != "report"
    }
    hashes = {
        path.as_posix(): artifacts.sha256(path) for path in Path("datasets").rglob("*") if path.is_file()
    }
    artifacts.write_json("reports/accepted.json", {"metrics": metrics, "params": {}, "hashes": hashes})
    main()
    assert "The results of 13 of 13 stages are those of the accepted run, to the byte." in Page(PAGE_ONE).text
    artifacts.write_json(
        "datasets/tune_weights/weights.json", {"practical": {"q": [1.0, 3.0], "r": [0.1, 0.2]}}
    )
    Path("datasets/segment_library/library.parquet").unlink()
    main()
    text = PAGE_ONE.read_text()
    assert "New results begin at tune_weights." in text
    assert "Made anew: tune_weights; not there: segment_library; as accepted: " in text


# ---- the candidates of the tuning


def test_the_front_of_the_candidates_is_drawn_with_chosen_default_and_optimum_and_says_what_was_bought(
    project,
):
    main()
    text = Page(TEMPERATURE).text
    # of the small project: practical candidates (10 %, 9 °C), (12 %, 5 °C;
    # chosen) and one that failed; default (11 %, 8 °C)
    assert (
        "The chosen weights have less error for more effort than the default ones: "
        "5.00 °C at 12.0 % of effort against 8.00 °C at 11.0 %. "
        "It lies on the front."
    ) in text
    label = re.search(
        r'aria-label="(The declared engineering cost: 2 candidates[^"]*)"', TEMPERATURE.read_text()
    )[1].replace("\u202f", " ")
    assert label == (
        "The declared engineering cost: 2 candidates, 2 on the front; chosen 5.00 °C at 12.0 % of effort; "
        "default 8.00 °C at 11.0 % of effort; "
        "optimum 4.00 °C at 30.0 % of effort"
    )


def test_a_chosen_candidate_above_the_front_says_by_how_much():
    # at effort 3 or less the least error is 2: 2.5 lies 25 % above
    points = np.array([[1.0, 4.0], [2.0, 2.0], [3.0, 2.5], [4.0, 1.0], [4.0, 3.0]])
    edge = points[trades._best(points)]
    np.testing.assert_array_equal(edge, [[1.0, 4.0], [2.0, 2.0], [4.0, 1.0]])
    assert (
        trades._beyond({"chosen": (3.0, 2.5)}, edge).replace("\u202f", " ")
        == "No candidate of its effort has less than 2.00 °C: it lies 25 % above the front."
    )


# ---- two controllers on the same cases


def cases(factor, *, plants=6, seeds=3):
    """A scorecard of two controllers on the same cases: the
    model-based one costs `factor` (plants,) times as much."""
    rows = [(plant, seed) for plant in range(plants) for seed in range(seeds)]
    plant, seed = (np.array(column) for column in zip(*rows, strict=True))
    both = {
        "plant": np.tile(plant, 2),
        "seed": np.tile(seed, 2),
        "start_degC": np.full(2 * len(rows), 20.0),
        "reference_degC": np.full(2 * len(rows), 150.0),
    }
    ours = 1.0 + 0.01 * seed
    return both | {
        "controller": np.array(["window"] * len(rows) + ["model_based"] * len(rows)),
        "noise_degC": np.full(2 * len(rows), 0.1),
        "tracking_degC": np.concatenate([ours, ours * np.asarray(factor)[plant]]),
    }


def tracking(runs):
    return runs["tracking_degC"]


def test_the_paired_saving_is_that_of_the_costs_ratio_over_plants():
    pair = pairs._paired(cases(np.full(6, 2.0)), "model_based", "window", 0.1, tracking)
    # half the cost in every case, and one sign pattern of 2^6 does as well
    np.testing.assert_allclose([pair.improvement_percent, pair.p], [50.0, 1 / 64], rtol=1e-12)
    assert (pair.cases, pair.blocks) == (18, 6)
    saving = pairs._saving(pair)
    assert (saving.saved.replace("\u202f", " "), saving.cases, saving.sure) == (
        "50 % less",
        "18 on six plants",
        True,
    )


def test_a_difference_that_changes_its_sign_from_plant_to_plant_is_chance():
    pair = pairs._paired(cases([2.0, 0.5, 2.0, 0.5, 2.0, 0.5]), "model_based", "window", 0.1, tracking)
    assert abs(pair.improvement_percent) < 1e-9 and not pairs._saving(pair).sure
    assert pairs._sentence("Error, as deployed", pair).startswith("Error: no difference beyond chance")


def test_other_cases_or_a_lost_run_are_no_pair():
    table = cases(np.full(6, 2.0))
    assert pairs._paired(table | {"seed": np.arange(36)}, "model_based", "window", 0.1, tracking) is None
    lost = table["tracking_degC"].copy()
    lost[0] = np.inf
    assert pairs._paired(table | {"tracking_degC": lost}, "model_based", "window", 0.1, tracking) is None
