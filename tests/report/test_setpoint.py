"""The page of the setpoint loop on made-up artifacts: the verdict against figures made by hand, undecided
shares, what is missing, hostile text, sizes."""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from pipeline.report.setpoint import why as setpoint_why
from pipeline.setpoint.agents.criteria import harm_bar
from pipeline.setpoint.tables import CLASSIFIED, PATHS
from pipeline.store import artifacts, params
from pipeline.verdict import setpoint as setpoint_verdict
from pipeline.verdict.verdict import Figure, Question, state
from tests.report import made, made_setpoint
from tests.report.made import main
from tests.report.test_pages import Page, change, figures

PAGE, INDEX = Path("reports/setpoint.html"), Path("reports/index.html")
ARTIFACTS = [
    *(f"datasets/train_classifier/{name}" for name in ("reliability.parquet", "frames/frames.json")),
    *(f"datasets/evaluate_setpoint/{name}" for name in ("scoreboard.parquet", "paths.parquet",
    "decisions.parquet", "choice.json")),
]  # fmt: skip


def page():
    main()
    return Page(PAGE).text


def lost(**percent):
    """The made-up controllers with other shares of lost runs: name
    with _ for a space -> (least, more a case)."""
    return made_setpoint.LOST | {name.replace("_", " "): pair for name, pair in percent.items()}


PAIRED = (
    "Model-based against data-driven: the Bayes filter brings 41.0 points more of its runs to the target and "
    "keeps them there than the paper's agent on the same 600 segments, five cases (90 % interval 38.5–43.5 "
    "points)."
)


def test_the_default_is_named_with_its_worst_case_and_the_pair_is_answered(project):
    text = page()
    # by hand: 100 - 1.5 (0.2 + 3 x 0.1) = 99.25
    assert "Pass (simulation): the model-based controller “Bayes filter”. All seven rules passed." in text
    assert (
        "In its worst case (classified windows, sticky, half clog) 99.2 % of 2,100 runs, worth 2,100 that "
        f"share nothing, settle and stay. {PAIRED}" in text.replace("  ", " ")
    )
    title = re.search(r"<title>(.*?) ·", PAGE.read_text())[1]
    assert title == "Setpoint: Pass (simulation): the model-based controller “Bayes filter”"


def test_page_one_and_the_report_s_file_answer_which_of_the_pair_is_better(project):
    main()
    assert (
        "Bayes filter, 41.0 points more runs settle and stay than by the paper's agent (38.5–43.5)."
        in Page(INDEX).text
    )
    assert figures()["verdicts"]["setpoint"]["answer"].replace("\u202f", " ") == PAIRED


def test_a_pair_that_is_not_told_apart_says_how_many_more_segments_would_tell(project):
    pair = made_setpoint.PAIR | {"difference": 1.0, "low": -2.0, "high": 4.0, "winner": None, "needed": 4800}
    made_setpoint.choice(pair=pair)
    assert (
        "Model-based against data-driven: undecided between the Bayes filter and the paper's agent on the "
        "same 600 segments, five cases (90 % interval −2.0 to 4.0 points); 4,800 more segments would tell."
    ) in page()
    made_setpoint.choice(pair=pair | {"needed": None})
    assert "no number of segments would tell." in page()
    made_setpoint.choice(
        pair=pair | {"difference": -9.0, "low": -12.0, "high": -6.0, "winner": "paper's agent"}
    )
    assert "the paper's agent brings 9.0 points more of its runs" in page()
    made_setpoint.choice(pair={"a": "Bayes filter", "b": "paper's agent", "cases": 0, "segments": 600})
    assert "Model-based against data-driven: not measured." in page()


def test_what_may_be_claimed_stands_in_the_verdict_and_on_page_one(project):
    claim = (
        "The classifier is trained and judged on rendered frames: eight real pictures "
        "allow no claim about real printers."
    )
    assert claim in page() and "nothing is claimed about a real printer" in Page(INDEX).text
    sections = params.read("params.yaml")
    sections["train_classifier"]["source"] = "recordings"
    Path("params.yaml").write_text(yaml.safe_dump(sections))
    assert claim not in page() and "recordings of datasets/raw/setpoint, split by print" in Page(PAGE).text


@pytest.mark.parametrize(
    ("name", "called"),
    [("sequential test", "the baseline “sequential test”"),
     ("paper's agent", "the data-driven controller “paper's agent”")],
)  # fmt: skip
def test_whoever_is_the_default_is_called_by_its_kind(project, name, called):
    made_setpoint.scoreboard(lost(**{name.replace(" ", "_"): (0.1, 0.1)}))
    made_setpoint.choice(name)
    assert f"Pass (simulation): {called}. All seven rules passed." in page()


@pytest.mark.parametrize(
    ("metric", "value", "rule", "sentence"),
    [
        ("ece_window", 0.05, "calibrated, a window",
        "Stated and true shares of right answers differ by 0.050 on average; 0.04 is allowed."),
        ("intervals_percent__image", [70.0, 72.0], "right, an image",
        "The classifier is right on 79.7 % of the frames of new segments; 78 % are asked for."),
    ],
)  # fmt: skip
def test_the_first_failed_rule_is_said_in_words(project, metric, value, rule, sentence):
    change("train_classifier", **{metric: value})
    text = page()
    assert (
        f"Fail (simulation). First failed rule: {rule}. "
        f"{sentence} By runs that settle and stay the model-based controller “Bayes filter” comes closest."
        in text
    )
    assert PAGE.read_text().count('<tr class="fail"><th scope="row"><a') == 1
    # page one says which loops passed, and of this one why not
    assert (
        re.search(r"<h1.*?>(.*?)</h1>", INDEX.read_text())[1]
        == "Pass (simulation): temperature and deposition; fail: setpoint."
    )
    assert f"First failed rule: {rule}. {sentence}" in Page(INDEX).text


def test_too_few_runs_leave_a_rule_undecided_and_say_how_many_more_segments_would_tell(project):
    made_setpoint.scoreboard(lost(Bayes_filter=(0.5, 0.3)), runs=100)
    text = page()
    # of 97 % 190 runs are needed; 600 segments were judged: 600 (190 / 100 - 1) = 540
    assert (
        "98.6 % of its runs settle; 97 % are asked for. Undecided: these runs are worth 100 that share "
        "nothing, of 190; about 540 more segments would decide." in text
    )
    assert setpoint_verdict.undecided(
        Question(0, "", "", "%", 97.0, True, ""), Figure(97.0, 96.0, 98.0), {}
    ).endswith("no number of segments would decide.")


def test_a_rule_is_one_threshold_on_the_estimate():
    """It is the limit itself: 97 % is passed at 97 %. At most 1 % of harm takes 570 runs."""
    for value, n_eff, limit, at_least, expected in (
        (97.0, 190, 97.0, True, "passed"), (96.9, 190, 97.0, True, "failed"),
        (99.9, 189, 97.0, True, "undecided"), (10.0, 189, 97.0, True, "undecided"),
        (1.0, 570, 1.0, False, "passed"), (1.1, 570, 1.0, False, "failed"),
        (0.0, 569, 1.0, False, "undecided"),
    ):  # fmt: skip
        held, words = setpoint_verdict.threshold(Figure(value, 0.0, 100.0), n_eff, limit, at_least=at_least)
        question = Question(0, "", "", "%", words["limit"], at_least, "")
        assert state(question, held) == expected, (value, n_eff)


@pytest.mark.parametrize("how", ["missing", "broken"])
@pytest.mark.parametrize(
    "paths", [ARTIFACTS[:-3], ARTIFACTS[-3:-1], ARTIFACTS[-1:]], ids=["most", "paths and decisions", "choice"]
)
def test_what_is_missing_or_broken_is_said_in_its_place(project, paths, how):
    for path in paths:
        Path(path).unlink() if how == "missing" else Path(path).write_bytes(b"{")
    text = page()
    for path in paths:
        name, kept = Path(path).name, "datasets/papers" in path
        stage = path.split("/")[2 if kept else 1]
        remedy = "git checkout datasets/papers" if kept else f"./run dvc repro {stage}"
        broken = (
            f"{path} is not whole JSON" if name.endswith("json") else f"{path} is not a whole Parquet file"
        )
        missing = f"{name} of {stage} is not there. Run {remedy}."
        assert (broken if how == "broken" else missing) in text, path


def test_before_the_stages_ran_the_page_and_the_card_say_so(project):
    stages = {*made_setpoint.metrics()} - {"train_agent"} | {"papers/train_agent"}
    for path in [*ARTIFACTS, *(f"datasets/{stage}/figures.json" for stage in stages)]:
        Path(path).unlink()
    text = page()
    assert "Undecided (simulation). No controller was chosen." in text
    assert (
        "Run ./run dvc repro evaluate_setpoint." in text
        and "Pass (simulation): the model-based" not in Page(INDEX).text
    )
    # what was not measured takes no headline from a loop that was
    assert (
        "Pass (simulation): temperature and deposition; not measured: setpoint."
        in INDEX.read_text().split("</h1>")[0]
    )


def test_a_choice_of_somebody_who_was_not_judged_is_no_choice(project):
    made_setpoint.choice("nobody")
    assert "No controller was chosen. The choice names a controller that was not judged." in page()


def test_names_and_reasons_from_the_data_are_escaped_and_isolated(project):
    made_setpoint.decisions(why=f"held: {made_setpoint.HOSTILE}")
    page()
    text = PAGE.read_text()
    assert "<script>alert" not in text and "<img src=http" not in text
    assert text.count("&lt;script&gt;") >= 2


def test_every_controller_stands_in_every_case_and_its_worst_case_is_bold(project):
    page()
    text = PAGE.read_text()
    tables = re.findall(r'<table class="tab board">.*?</table>', text, re.DOTALL)
    assert len(tables) == 4 and [table.count("<tr><th") for table in tables] == [5, 5, 5, 3]
    bold = [table.count('<td class="low"') for table in tables]
    # of doing nothing all cases are alike; the first one is taken
    assert bold == [1, 3, 0, 0]
    # the agent settles in 100 - 15 - 10 x 2 % of its sticky clogs, and recovers one point less
    assert "recover 64.0" in tables[1] and "n_eff 2,100" in tables[1]
    # it leaves +-10, 15 and 25 % from in-band starts in 12.5, 6.2 and 1.6 % of its runs
    assert "beyond 10: 12.5" in tables[2] and "beyond 15: 6.2" in tables[2] and "beyond 25: 1.6" in tables[2]
    assert "beyond" not in tables[0] + tables[1] + tables[3]


def test_the_card_sets_the_default_beside_the_other_of_the_pair_and_doing_nothing(project):
    page()
    first = Page(INDEX)
    card = first.text[first.text.index("Nozzle camera to") :]
    assert "Pass (simulation): the model-based controller “Bayes filter”." in card
    assert "99.2 %" in card.split("Settles")[1]
    assert first.links.count("setpoint.html") >= 2


def test_how_a_figure_moved_since_the_accepted_run_is_said(project):
    accepted = made.accepted(metrics={"evaluate_setpoint": artifacts.read_figures("evaluate_setpoint")})
    name, recorded = made_setpoint.DEFAULT, {"recorded, sticky": {"settled": 99.4}}  # within that of today
    accepted["metrics"]["evaluate_setpoint"][name]["recorded"] = recorded
    accepted["metrics"]["evaluate_setpoint"][name]["paper"]["accuracy 0.7"]["settled"] = 97.0
    artifacts.write_json("reports/accepted.json", accepted)
    text = page()
    # 99.8 % now
    assert "+2.8 points · better" in text and "new" in text
    assert text.count("points · better") == 1 and "within noise" in text


# ---- first, no harm


def harm_rules(project):
    """State and text of the rule for what learned and for the baseline, and the page's text."""
    text = page()
    row = PAGE.read_text().split('<a href="#harm">Does no harm</a>')[1].split("</tr>")[0]
    return re.findall(r'<span class="vh">(.*?): </span>(.*?)</td>', row), text


def test_a_default_that_spoils_good_prints_fails_by_the_case_most_beyond_its_bar(project):
    # by hand: beyond 25 in (30 + 4 hard) / 2 / 8 %: 1.9 of at most 1 from 100 %, 2.1 of 2 in band
    made_setpoint.scoreboard(lost(Bayes_filter=(30.0, 4.0)))
    rules, text = harm_rules(project)
    assert rules == [("passed", "0.9\u202f%"), ("failed", "1.9\u202f%")]
    assert (
        "First failed rule: does no harm. Judged is the model-based controller “Bayes filter”: from good "
        "starts, perfect, 1.9 % of its runs leave ±25 %; at most 1 % may. With doing nothing 0.0 % do."
    ) in text


def test_a_camera_of_another_scale_bars_nobody():
    bars = {
        case: harm_bar(case, perfect=1.0, in_band=2.0)
        for case in ("perfect", "in band", "in band, another camera", "recorded, sticky")
    }
    assert list(bars.values()) == [1.0, 2.0, None, None]


def test_harm_without_a_declared_bar_is_not_measured_and_does_not_pass(project):
    sections = params.read("params.yaml")
    del sections["evaluate_setpoint"]["most_harmed"]
    Path("params.yaml").write_text(yaml.safe_dump(sections))
    rules, text = harm_rules(project)
    assert rules == [("not measured", "not measured")] * 2 and "First undecided rule: does no harm." in text


def test_harm_stands_beside_recovery_in_minutes_and_who_may_not_run_last(project):
    text = page()
    # the filter leaves ±10 % in 0.2 / 2 % and recovers 100 - 0.2 - 2 x 0.1 - 1 = 98.6 %,
    # doing nothing 100 - 90 - 2 - 1 = 7 %
    for said in (
        "Bayes filter takes 0.0 % of good prints beyond ±25 % of flow (perfect start; at most 1 % may be), "
        "and 0.1 % beyond ±10 %. It recovers 98.6 %",
        "Doing nothing takes 0.0 % of good prints beyond ±25 % of flow (perfect start; at most 1 % may be), "
        "and 0.0 % beyond ±10 %. It recovers 7.0 %",
    ):
        assert said in text
    table = PAGE.read_text().split('tight harms"')[1].split("</table>")[0]
    rows = [re.sub(r"<.*?>|\s+", " ", row) for row in table.split("<tr>")[2:]]
    assert len(rows) == 4 and "sequential test" in rows[-1] and "may not run" in rows[-1]
    assert sum("may not run" in row for row in rows) == 1
    # 12 decisions of a wait of 6 s and 20 frames at 20 Hz; the deadline is 30 decisions
    assert "95 % back after 1.4 min (deadline 3.5 min)" in text
    assert "divided into pools that share none" in text and "n_eff 2,100" in text


def test_the_default_is_judged_though_another_is_better_and_says_who_may_not_run(project):
    made_setpoint.choice(
        "sequential test",
        refused={"Bayes filter": "leaves +-25 % in 24.6 % of the runs (in band), of at most 2 %"},
        sentence="sequential test is the default: nothing else may run.",
    )
    text = page()
    # by hand: 100 - (0.1 + 3 x 1.5) = 95.4 % settle in its worst case
    assert "First failed rule: settles, worst case." in text
    assert "“sequential test”: in its worst case" in text and "95.4 % of its runs settle" in text
    assert (
        "Why this default: sequential test is the default: nothing else may run. May not run: Bayes filter "
        "leaves ±25 % in 24.6 % of the runs (in band), of at most 2 %."
    ) in text


def test_how_many_frames_of_good_prints_are_named_good_stands_on_the_page(project):
    table = artifacts.read_table("datasets/train_classifier/classified.parquet", CLASSIFIED)
    good = table["label"] == 1
    percent = 100 * (table["named"][good] == 1).mean()
    assert f"Of {good.sum()} frames of good prints {percent:.0f} % are classified as good." in page()


# ---- what the camera sees, by flow


def test_windows_of_all_flows_are_held_against_no_bar(project):
    """The rule asks for flows from 70 to 150 %; an image's bar is of all flows."""
    figures = artifacts.read_figures("train_classifier") | {"window_accuracy": 0.5, "image_accuracy": 0.5}
    artifacts.write_metrics("train_classifier", figures)
    main()
    assert len(re.findall(r'class="num bad">50.0', PAGE.read_text())) == 1


def test_the_page_says_whether_the_classifier_may_judge(project):
    said = "right in 88 % of 300 windows of 300 rendered segments never learned from: may judge"
    assert f"The classifier: {said}." in page()
    said = "cannot judge this camera: right in 61 % of 48 windows of 4 prints never learned from"
    change("train_classifier", proof={"verdict": said})
    assert f"The classifier: {said}." in page()


def test_heads_of_few_own_pictures_have_no_yardsticks(project):
    change("train_classifier", svc_image_accuracy=None, width_image_accuracy=None)
    text = page()
    assert "Vision transformer" in text and "Support vector machine" not in text


def test_right_is_told_by_flow_the_worst_bin_first(project):
    text = page()
    assert (
        "Worst bin: 105–110 % of flow, 40 % right (36–43), 200 windows; the ideal reader reaches 62 % there. "
        "It lies beside a border of the classes. Worst away from the borders: 70–75 % of flow, 90 % right"
    ) in text
    assert (
        "If every flow from 70 to 150 % were as frequent: 82.5 % (80.1–84.9); the ideal reader 88.0 %."
        in text
    )
    assert "every segment carries a width bias of 5 %" in text
    table = PAGE.read_text().split("tight by-flow")[1].split("</table>")[0]
    places = re.findall(r'<th scope="row" class="v">(\d+)–', table)
    assert places[:4] == ["105", "85", "90", "110"] and len(places) == 16
    assert table.count('<tr class="beside">') == 4
    chart = PAGE.read_text().split('aria-labelledby="by-flow"')[1].split("</svg>")[0]
    assert chart.count('class="bin"') == 12 and chart.count('class="bin beside"') == 4
    # the share over all flows is no rule of the verdict
    assert "93.1" not in PAGE.read_text().split('<table class="rules')[1].split("</table>")[0]


def test_the_ideal_reader_is_named_of_rendered_beads_only(project):
    change("train_classifier", source="recordings")
    assert "ideal reader" not in page()


def test_without_figures_by_flow_the_page_says_so_and_the_rule_is_open(project):
    change("train_classifier", by_flow=None, right_70_150=None)
    text = page()
    assert "First undecided rule: right, 70–150 % of flow." in text
    section = PAGE.read_text().split('aria-labelledby="by-flow"')[1].split("</section>")[0]
    assert "Not measured" in section and '<svg class="plot' not in section


# ---- the figures themselves


def test_stretches_of_held_windows_end_where_the_reason_changes():
    why = [
        "good 0.9; no change",
        "x held: tip moved",
        "y held: tip moved",
        "z held: out of distribution",
        "good 0.9; flow -5 %",
    ]
    mine = {"held": np.array([False, True, True, True, False]), "why": np.array(why)}
    assert setpoint_why._alike(mine) == [(1, 3), (3, 4)]
    assert setpoint_why.reason(why[1]) == "tip moved"


def test_cases_are_said_in_words():
    assert (
        setpoint_verdict.case_text(("recorded", "recorded, sticky, clog"), whole=True)
        == "Classified windows, sticky, clog"
    )
    assert setpoint_verdict.case_text(("paper", "accuracy 0.7, gain 0.6")) == "accuracy 70\u202f%, gain 0.6"


def test_two_hundred_starts_and_a_thousand_decisions_stay_within_the_size_of_a_page(project):
    made_setpoint.decisions(steps=1000)
    rows = 40_000
    table = {
        "controller": ["Bayes filter"] * rows,
        "simulator": ["paper"] * rows,
        "case": ["accuracy 0.7"] * rows,
        "start": np.repeat(np.arange(200), 200),
        "step": np.tile(np.arange(200), 200),
    }
    walk = 100 + 20 * np.random.default_rng(0).standard_normal(rows)
    artifacts.write_table(
        "datasets/evaluate_setpoint/paths.parquet",
        PATHS,
        table | {"flow_percent": walk, "temperature_degC": 210 + walk / 20},
    )
    main()
    # the limit of a page: 1.5 MB
    assert figures()["bytes"]["setpoint"] <= 1_500_000
