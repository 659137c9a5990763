"""A sweep: what is refused before its first experiment, what is told when some fail, and its picture over the
parameter's value with repeats."""

import json
import math
import re
import sys
from pathlib import Path

import pytest

from pipeline import cli
from pipeline.nightly import sweeping
from pipeline.report.runs import sweep
from pipeline.report.runs.sweep import Layout, Point, Sweep
from pipeline.store import artifacts
from tests.report import made
from tests.report.made_runs import Made, make, metrics
from tests.report.test_pages import Page
from tests.report.test_runs import command

METRIC = "tune_weights:practical.cost"
DVC = """
stages:
  learn_kernel: {cmd: a, outs: [datasets/learn_kernel: {persist: true}]}
  tune_weights:
    cmd: b
    deps: [datasets/learn_kernel/kernel.parquet]
    outs: [datasets/tune_weights]
    metrics: [reports/metrics/tune_weights.json: {cache: false}]
  report: {cmd: c, deps: [datasets/tune_weights], outs: [reports/index.html]}
  train_agent: {cmd: d, outs: [datasets/train_agent]}
"""


@pytest.fixture
def ran(tmp_path, monkeypatch):
    """A project whose experiments cost 1.5; a list of the names of those that ran."""
    monkeypatch.chdir(tmp_path)
    made.declared(tmp_path)
    Path("dvc.yaml").write_text(DVC)
    artifacts.write_metrics("tune_weights", {"practical": {"cost": 2.0, "share at 0.9": 1, "none": None}})
    names = []
    monkeypatch.setattr(sweeping, "dvc", lambda *words, log: names.append(words[words.index("--name") + 1]))
    told = json.dumps({"practical": {"cost": 1.5, "share at 0.9": 0.25}})
    monkeypatch.setattr(sweeping, "git", lambda verb, *_: "0123" if verb == "rev-parse" else told)
    return names


@pytest.mark.parametrize(
    ("target", "metric", "sentence"),
    [
        ("tune_weights", "cost", "expected a metric as STAGE:dotted.key"),
        ("tune_weights", "tune_weights:", "expected a metric as STAGE:dotted.key"),
        ("tune_weight", METRIC, r"--target tune_weight: expected a stage of dvc.yaml; did you mean tune_we"),
        ("tune_weights", "tune:practical.cost", r"--metric tune: expected a stage of dvc.yaml"),
        ("tune_weights", "tune_weights:practical.costs",
         r"tune_weights.json has no figure practical.costs; did you mean practical.cost or"),
        ("tune_weights", "tune_weights:practical", r"has no figure practical; did you mean"),
        ("learn_kernel", METRIC, r"runs without tune_weights, so that .* be the same in every experiment"),
        ("train_agent", "train_agent:loss", r"metrics/train_agent.json: expected the figures of a run"),
    ],
)  # fmt: skip
def test_a_wrong_target_or_metric_is_refused_before_the_first_experiment(ran, target, metric, sentence):
    with pytest.raises(ValueError, match=sentence):
        sweeping.sweep(["tune_weights.seed=1,2"], target, metric)
    assert ran == [] and not Path("reports/sweep.csv").exists()


@pytest.mark.parametrize("key", ["practical.cost", "practical.none", "practical.share at 0.9"])
@pytest.mark.parametrize("target", ["tune_weights", "report"])
def test_a_figure_of_the_target_or_of_a_stage_before_it_is_taken_null_and_names_with_dots_too(
    ran, key, target
):
    sweeping.check(target, f"tune_weights:{key}")


def test_without_the_wiring_or_with_a_broken_one_it_says_what_to_do(ran):
    Path("dvc.yaml").write_text("stages: [")
    with pytest.raises(ValueError, match="dvc.yaml: expected stages with deps and outs .* restore the file"):
        sweeping.check("tune_weights", METRIC)
    Path("dvc.yaml").unlink()
    with pytest.raises(ValueError, match="dvc.yaml is missing; run this in the root of the project"):
        sweeping.check("tune_weights", METRIC)


def test_every_experiment_is_named_by_whole_keys_and_the_page_cuts_no_name(ran):
    settings = ["tune_weights.seed=1,2", "train_agent.seed=3", "generate_probing.samples=9000"]
    text = sweeping.sweep(settings, "tune_weights", METRIC)
    names = [
        f"sweep-tune_weights_seed-{seed}-train_agent_seed-3-generate_probing_samples-9000" for seed in (1, 2)
    ]
    page = Path("reports/sweep.html").read_text()
    assert ran == names
    for name in names:
        assert name in text and f"<bdi>{name}</bdi>" in page
    assert Path("reports/sweep.csv").read_text().splitlines() == [
        "experiment,tune_weights.seed,train_agent.seed,generate_probing.samples,tune_weights:practical.cost",
        f"{names[0]},1,3,9000,1.5",
        f"{names[1]},2,3,9000,1.5",
    ]


def test_one_that_fails_leaves_the_others_and_its_sentence_and_the_sweep_ends_in_it(ran, monkeypatch):
    def dvc(*words, log):
        if "tune_weights.seed=2" in " ".join(words):
            raise ValueError("dvc exp failed: <b>no room</b>")

    monkeypatch.setattr(sweeping, "dvc", dvc)
    with pytest.raises(ValueError, match=r"1 of 3 experiments failed, the others are in .*seed-2: dvc exp"):
        sweeping.sweep(["tune_weights.seed=1,2,3"], "tune_weights", METRIC)
    assert [row.split(",")[-1] for row in Path("reports/sweep.csv").read_text().split()[1:]] == [
        "1.5", "nan", "1.5"
    ]  # fmt: skip
    page = Page(Path("reports/sweep.html")).text
    assert "Not measured. dvc exp failed: <b>no room</b>" in page and "One experiment gave no figure" in page


# ---- the picture


def swept(keys, *rows):
    points = tuple(Point(f"e{k}", tuple(values), figure) for k, (*values, figure) in enumerate(rows))
    return Sweep(METRIC, keys, points)


REPEATED = swept(
    ("tune_weights.seed", "tune_weights.budget"),
    ("1", "30", 3.0), ("2", "30", 5.0), ("3", "30", 4.5),
    ("1", "60", 2.0), ("2", "60", 1.0), ("3", "60", math.nan),
)  # fmt: skip


def test_seeds_repeat_where_another_parameter_runs_along_the_axis():
    assert sweep.layout(REPEATED) == Layout("tune_weights.budget", (), ("tune_weights.seed",))
    alone = swept(("train_agent.seed",), ("1", 1.0), ("2", 2.0))
    assert sweep.layout(alone) == Layout("train_agent.seed", (), ())
    two = swept(("a.law", "a.budget", "a.fixed"), ("p", "1", "7", 1.0), ("q", "2", "7", 2.0))
    assert sweep.layout(two) == Layout("a.law", ("a.budget",), ())


def test_a_line_joins_the_medians_of_the_repeats_at_the_parameters_values():
    (line,) = sweep.series(REPEATED)
    # by hand: the median of 3, 5, 4.5, and of 2 and 1; the one that failed counts in none
    assert (line.places, line.medians) == ([30.0, 60.0], [4.5, 1.5]) and len(line.dots) == 5
    picture = sweep.picture(REPEATED)
    assert picture.count("<circle") == 5
    across = [float(x) for x in re.findall(r'cx="([\d.]+)"', picture)]
    assert across[0] == across[1] == across[2] < across[3] == across[4]
    assert re.findall(r">(30|60)</text>", picture) == ["30", "60"]
    assert "lowest at tune_weights.budget 60, 1.5" in picture
    assert "medians of at most 3 repeats over tune_weights.seed" in sweep.caption(REPEATED)


@pytest.mark.parametrize(
    ("values", "places"),
    [
        (("1", "10", "2"), [1.0, 10.0, 2.0]),
        (("1e-3", "1", "10"), [0.001, 1.0, 10.0]),
        (("loky", "dask", "loky"), [0.0, 1.0, 0.0]),
        (("1", "inf", "2"), [0.0, 1.0, 2.0]),
        (("5", "5.0", "5"), [5.0, 5.0, 5.0]),
    ],
)
def test_numbers_lie_at_their_value_and_words_side_by_side(values, places):
    axis, at = sweep.axis(values)
    assert [at[value] for value in values] == places
    assert ((axis.at(places) >= 0) & (axis.at(places) <= 1)).all() and axis.high > axis.low
    assert axis.log == (values[0] == "1e-3")


def test_an_empty_sweep_and_one_of_equal_figures_say_so():
    assert "Not measured." in sweep.picture(swept(("a.b",), ("1", math.nan)))
    assert sweep.finding(swept(("a.b",), ("1", 2.0), ("2", 2.0))).endswith("is 2.000 in every experiment")


def test_what_is_remembered_comes_back_and_what_is_no_sweep_is_left_out(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sweep.remember(REPEATED)
    sweep.remember(REPEATED)
    (back,) = sweep.remembered()[0]
    assert (back.metric, back.keys, back.points[:5]) == (METRIC, REPEATED.keys, REPEATED.points[:5])
    assert math.isnan(back.points[5].figure)
    rows = [sweep.written(REPEATED), 3, {"metric": "a"}, {"metric": "a", "keys": ["k"], "points": [{}]}]
    assert len(sweep.read(rows)) == 1 and sweep.read("no list") == []
    sweep.FILE.write_text("{")
    sweeps, troubles = sweep.remembered()
    assert sweeps == [] and "Sweeps are left out: .beadline/sweeps.json" in troubles[0]


def test_the_sweeps_stand_on_the_page_of_the_runs_with_their_metric_as_a_column(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tuned = {"reports/metrics/tune_weights.json": {"practical": {"cost": 1.25}}}
    make([Made("one", {**metrics(), **tuned}), Made("two", {**metrics(), **tuned}, "e0")])
    sweep.remember(REPEATED._replace(keys=("tune_weights.seed", f"x.{made.HOSTILE}")))
    command()
    page = Page(Path("reports/runs.html"))
    assert f"{METRIC} over tune_weights.seed" in page.text and f"{METRIC} metric" in page.text
    assert "1.25" in page.text and not any(tag == "img" for tag, _ in page.tags)


def test_the_command_refuses_before_it_asks_dvc(ran, monkeypatch, capsys):
    words = ["beadline", "sweep", "-S", "tune_weights.seed=1,2", "--target", "tune_weights"]
    monkeypatch.setattr(sys, "argv", [*words, "--metric", "tune_weights:practical.cots"])
    with pytest.raises(SystemExit):
        cli.main()
    assert "has no figure practical.cots; did you mean practical.cost" in capsys.readouterr().err
    assert ran == []
