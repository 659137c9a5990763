"""papers.html: each table and figure of the papers has its row, a verdict is what its rule says, figures come
from the results and never from prose, and the results are what the second pipeline makes."""

import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

from pipeline.deposition.learning.ilc import Trial
from pipeline.papers import camera as papers_camera
from pipeline.papers import deposition as papers_deposition
from pipeline.papers import published, search_agent, train_agent
from pipeline.papers import setpoint as papers_setpoint
from pipeline.papers import temperature as papers_temperature
from pipeline.papers.study import exact_gains
from pipeline.papers.study_draws import read_published
from pipeline.report.papers import derived, figures, page, rows
from pipeline.report.papers.rows import FAILS, HOLDS, OPEN, SHAPE, VERDICTS
from pipeline.report.shared.sources import Sources
from pipeline.setpoint.agents.files import restore_published
from pipeline.store import params
from pipeline.temperature.plant import baam
from pipeline.temperature.tracking import gains
from pipeline.verdict.verdict import Missing

ROOT = Path(__file__).resolve().parents[2]
SEEDS = {
    "temperature": "seeds/seed1_zavrakli_output_feedback_rl.txt",
    "setpoint": "seeds/seed2_li_pattinson_uncertainty_rl.txt",
    "deposition": "seeds/seed3_hoelzle_ilc_basis_library.txt",
}
PAPERS = {
    name: (str(ROOT / f"datasets/papers/{name}.toml"), str(ROOT / f"datasets/papers/{name}.json"))
    for name in SEEDS
}
OTHERS = {name: str(ROOT / f"datasets/papers/{name}.json") for name in ("reproduce_study", "relearned")}
METRICS = {
    "train_classifier": {"image_accuracy": 0.75, "window_accuracy": 0.9, "data": {"valid_share": 0.94}}
}


def printed(name):
    return tomllib.loads(Path(PAPERS[name][0]).read_text(encoding="utf-8"))


SEARCHED = ROOT / "datasets/papers/search_agent.json"


def results(name):
    return json.loads(Path(PAPERS[name][1]).read_text())


def sources(metrics=METRICS):
    gap = Missing("not measured", "nothing ran")
    return Sources(None, metrics, {"course": gap, "classified": gap}, {}, {}, None, "")


# ---- nothing of a paper is left out


@pytest.mark.parametrize("name", SEEDS)
def test_every_table_and_figure_of_a_paper_has_its_row_and_a_verdict(name):
    told = printed(name)
    paper = rows.read(*PAPERS[name], METRICS)
    places = {row.at for row in paper.rows}
    for caption in told["paper"]["captions"]:
        assert any(re.fullmatch(rf"{re.escape(caption)}(?: \(.*|, .*)?", at) for at in places), caption
    assert {row.verdict for row in paper.rows} <= set(VERDICTS)
    assert all(row.why for row in paper.rows if row.verdict in (OPEN,) and row.ours == "")


@pytest.mark.parametrize("name", SEEDS)
def test_the_captions_listed_are_those_of_the_papers_text(name, shared):
    text = shared(SEEDS[name]).read_text(encoding="utf-8")
    found = {
        f"{'Table' if kind.lower() == 'table' else 'Figure'} {number}"
        for kind, number in re.findall(
            r"(?m)^\s*(Figure|Fig\.|Table|TABLE) ((?:A\.)?\d+|[IVX]+)(?=[:.]|\s*$)", text
        )
    }
    assert found == set(printed(name)["paper"]["captions"])


@pytest.mark.parametrize("name", SEEDS)
def test_numbers_that_are_printed_stand_in_the_papers_text(name, shared):
    # 183.436.2 is one of the spellings
    text = re.sub(r"[.,\s]", "", shared(SEEDS[name]).read_text(encoding="utf-8"))
    for row in printed(name)["row"]:
        if row["rule"] == "digits" and "places" in row:
            for value in rows._list(row["printed"]):
                spellings = {f"{value:.{row['places']}f}", f"{value:g}", f"{value:.4f}".rstrip("0")}
                assert any(spelling.replace(".", "") in text for spelling in spellings), (row["at"], value)


# ---- verdicts


def made(ours, other=None, **row):
    found = {"ours": ours, "other": other}
    asked = {"at": "Figure 1", "what": "x", "ours": "ours"} | row
    return rows._row(asked, found, {}, "here")


def judged(ours, **row):
    return made(ours, **row).verdict


@pytest.mark.parametrize(
    ("ours", "verdict"),
    [(0.0376, HOLDS), (0.03764, HOLDS), (0.03769, HOLDS), (0.0375, FAILS), (0.0377, FAILS), (2.87, FAILS)],
)
def test_digits_hold_where_ours_rounded_or_cut_is_what_is_printed(ours, verdict):
    assert judged(ours, rule="digits", printed=0.0376, places=4) == verdict
    assert judged([0.0376, ours], rule="digits", printed=[0.0376, 0.0376], places=4) == verdict


@pytest.mark.parametrize(
    ("rule", "ours", "verdict"),
    [
        ({"rule": "at_most", "printed": 20}, 20.0, HOLDS),
        ({"rule": "at_most", "printed": 20}, 20.1, FAILS),
        ({"rule": "at_most", "printed": "small", "bound": 1}, 2.0, FAILS),
        ({"rule": "at_most", "printed": "small", "our_bound": 1}, 1.0, SHAPE),
        ({"rule": "at_most", "printed": "small", "our_bound": 1}, 2.0, FAILS),
        ({"rule": "at_least", "printed": "fluctuate", "bound": 5}, [5.0, 8.0], HOLDS),
        ({"rule": "at_least", "printed": "fluctuate", "bound": 5}, [4.0, 8.0], FAILS),
        ({"rule": "at_least", "printed": "all", "bound": 95}, 94.9, FAILS),
        ({"rule": "at_least", "printed": "all", "bound": 95}, 95.0, HOLDS),
        ({"rule": "within", "printed": 100, "percent": 1, "shape_percent": 10}, 101.0, HOLDS),
        ({"rule": "within", "printed": 100, "percent": 1, "shape_percent": 10}, 92.0, SHAPE),
        ({"rule": "within", "printed": 100, "percent": 1, "shape_percent": 10}, 89.0, FAILS),
        ({"rule": "within", "printed": 100, "percent": 1}, 102.0, FAILS),
        ({"rule": "same", "printed": ["Stop", "Start"]}, ["Stop", "Start"], HOLDS),
        ({"rule": "same", "printed": ["Stop", "Start"]}, ["Start", "Stop"], FAILS),
        ({"rule": "claim", "printed": "so"}, True, HOLDS),
        ({"rule": "claim", "printed": "so"}, False, FAILS),
        ({"rule": "shape", "printed": "so"}, True, SHAPE),
        ({"rule": "shape", "printed": "so"}, False, FAILS),
        ({"rule": "not_judged", "printed": 1}, 1, OPEN),
    ],
)
def test_a_rule_says_what_it_says(rule, ours, verdict):
    assert judged(ours, **rule) == verdict


def test_a_table_holds_only_with_all_of_its_entries():
    entries = [
        {"name": "a", "printed": 1, "ours": "ours"},
        {"name": "b", "printed": 0.01, "places": 2, "ours": "b"},
    ]
    row = {"at": "Table 1", "what": "x", "rule": "entries", "entries": entries}
    for b, verdict in ((0.01, HOLDS), (0.1, FAILS)):
        assert rows._row(row, {"ours": 1, "b": b}, {}, "here").verdict == verdict


def test_a_change_mends_a_row_only_if_the_rows_own_rule_holds_with_it():
    row = {"rule": "digits", "printed": 1.5, "places": 2}
    assert (made(1.95, **row).changed, made(1.95, **row).mended) == ("", False)
    with_change = made(1.95, 1.504, changed="other", **row)
    assert (with_change.verdict, with_change.changed, with_change.mended) == (FAILS, "1.50", True)
    nearest = made(1.95, 1.53, changed="other", **row)
    assert (nearest.verdict, nearest.changed, nearest.mended) == (FAILS, "1.53", False)


@pytest.mark.parametrize(
    ("mark", "printed", "marks"),
    [
        ({"x": 100}, 7.5, [("Figure 1", 0, 100, 7.5)]),
        ({"x": 100}, [7.5, 8.5], [("Figure 1", 0, 100, 7.5), ("Figure 1", 0, 100, 8.5)]),
        ({"x": [0, 73]}, [0.95, 0.46], [("Figure 1", 0, 0, 0.95), ("Figure 1", 0, 73, 0.46)]),
        ({"y": 100, "panel": 2, "figure": "8"}, [95, 40], [("8", 2, 95, 100), ("8", 2, 40, 100)]),
    ],
)
def test_a_mark_stands_where_the_paper_prints_the_value(mark, printed, marks):
    assert made(1, rule="not_judged", printed=printed, mark=mark).marks == marks


def test_a_value_that_the_paper_prints_without_a_place_is_a_line():
    ((figure, panel, x, y),) = made(1, rule="not_judged", printed=75, mark={"panel": 2}).marks
    assert (figure, panel, y) == ("Figure 1", 2, 75) and np.isnan(x)


@pytest.mark.parametrize("name", SEEDS)
def test_every_mark_is_drawn_in_its_figure_and_no_other(name):
    paper = rows.read(*PAPERS[name], METRICS)
    tables = {"course": None, "classified": None}
    marks = [mark for row in paper.rows for mark in row.marks if not mark[0].startswith("Figure 5 (b)")]
    drawn = {one["at"]: one for one in figures.pictures(name, paper.results, tables, marks)}
    for at, picture in drawn.items():
        for i, panel in enumerate(picture["panels"]):
            assert panel.count('class="printed"') == sum((at, i) == mark[:2] for mark in marks), (at, i)
    with pytest.raises(ValueError, match="expected a figure and panel for each mark"):
        figures.pictures(name, paper.results, tables, [("Figure 99", 0, 1.0, 1.0)])


@pytest.mark.parametrize("name", SEEDS)
def test_a_row_that_does_not_hold_names_the_change_that_mends_it_or_why_none_does(name):
    for row in rows.read(*PAPERS[name], METRICS).rows:
        if row.verdict == FAILS:
            assert row.why, row.at
            assert row.mended or re.search(
                r"misprint|[Nn]o change|[Nn]one|no draw|draws|lie below|rows further|agree", row.why
            ), row


def test_what_the_run_lacks_is_open_and_what_the_results_lack_or_a_wrong_rule_is_refused_by_its_row():
    row = {"at": "Figure 5", "what": "x", "printed": 1, "rule": "at_most", "ours": "run:train_classifier.a.b"}
    made = rows._row(row, {}, {"train_classifier": Missing("failed", "it stopped")}, "here")
    assert (made.verdict, made.ours) == (OPEN, "not measured in this run")
    with pytest.raises(ValueError, match=r"here, Figure 5: expected a.b among the results"):
        rows._row(row | {"ours": "a.b"}, {"a": {}}, {}, "here")
    with pytest.raises(ValueError, match=r"here, Figure 5: expected one of the rules .* found 'roughly'"):
        rows._row(row | {"rule": "roughly"}, {}, {}, "here")


# ---- prose has no numbers of its own

# references to places of a paper, and matrices
REFERENCES = (
    r"(?:Figures?|Tables?|Sections?|Equations?|Algorithm|phase|case|trial) [\d.]+(?: (?:to|and) [\d.]+)*",
    r"\(\d+\)(?: (?:to|and) \(\d+\))*",
    r"\(8/3\) I",
    r"1-norm",
    r"\{[^{}]*\}",
    r"\|[^|]*\|",
)


@pytest.mark.parametrize("name", SEEDS)
def test_no_number_is_typed_in_what_is_said_of_ours(name):
    told = printed(name)
    for text in [told["paper"]["told"], *(row.get("why", "") for row in told["row"])]:
        rest = re.sub("|".join(REFERENCES), "", text)
        assert not re.search(r"\d", rest), text


# ---- the page


def test_the_page_shows_every_row_of_every_paper_and_counts_them():
    text = page.render(sources(), PAPERS, OTHERS)
    papers = [rows.read(*files, METRICS) for files in PAPERS.values()]
    assert text.count('<td class="at" role="cell">') == sum(len(paper.rows) for paper in papers)
    counts = [sum(paper.count(verdict) for paper in papers) for verdict in VERDICTS]
    mended = sum(row.verdict == FAILS and row.mended for paper in papers for row in paper.rows)
    assert page.decision(papers) == (
        f"Of {sum(counts)} tables, figures and numbers {counts[0]} hold, {counts[1]} in shape, {mended} only "
        f"with a named change, {counts[2] - mended} do not; {counts[3]} cannot be judged."
    )
    assert page.decision(papers) in text
    labels = re.findall(r'role="img" aria-label="([^"]*)"', text)
    assert len(labels) > 40 and all(re.search(r"\d", label) for label in labels)
    assert text.count("<article>") > 25 and ">nan" not in text and "None" not in text


def test_a_paper_whose_files_are_not_there_is_a_hole_that_says_how_to_make_them(tmp_path):
    gone = {"temperature": (PAPERS["temperature"][0], str(tmp_path / "temperature.json"))}
    text = page.render(sources(), gone, OTHERS)
    assert (
        "./run dvc repro datasets/papers/dvc.yaml:temperature" in text and "No paper is set beside us" in text
    )


def test_the_confusion_of_the_classes_is_counted_in_percent_of_the_true_class():
    table = {
        "label": np.array([0, 0, 1, 2]),
        "named": np.array([0, 1, 1, 0]),
        "temperature_degC": np.array([190.4, 209.0, 211.0, 189.0]),
    }
    heads, shares = derived.confusion(table)
    assert heads[1:] == ["insufficient", "optimal", "excessive"]
    assert shares == [
        ["insufficient", "50", "50", "0"],
        ["optimal", "0", "100", "0"],
        ["excessive", "100", "0", "0"],
    ]
    heads, right = derived.by_temperature(table)
    assert heads[1:] == ["190 °C", "210 °C"]
    assert right == [["insufficient", "100", "0"], ["optimal", "", "100"], ["excessive", "0", ""]]


def test_two_renderings_are_the_same_bytes():
    assert page.render(sources(), PAPERS, OTHERS) == page.render(sources(), PAPERS, OTHERS)


@pytest.mark.parametrize(
    ("width", "theme", "rules"),
    [
        (390, "light", None),
        (1280, "light", {"rules": {"color-contrast": {"enabled": False}}}),
        pytest.param(1280, "light", {}, marks=pytest.mark.slow),
        pytest.param(390, "light", {}, marks=pytest.mark.slow),
        pytest.param(1280, "dark", {"runOnly": ["color-contrast"]}, marks=pytest.mark.slow),
    ],
)
def test_nothing_overflows_texts_can_be_read_and_axe_finds_nothing(browser, tmp_path, width, theme, rules):
    (tmp_path / "papers.html").write_text(page.render(sources(), PAPERS, OTHERS), encoding="utf-8")
    context = browser.new_context(viewport={"width": width, "height": 800}, color_scheme=theme)
    shown = context.new_page()
    shown.goto(f"file://{tmp_path}/papers.html")
    shown.evaluate("document.querySelectorAll('details').forEach(one => one.open = true)")
    assert shown.evaluate("document.documentElement.scrollWidth") <= width
    small = """() => [...document.querySelectorAll("svg.plot text")].filter(e =>
        parseFloat(getComputedStyle(e).fontSize) * e.ownerSVGElement.getBoundingClientRect().width
        / e.ownerSVGElement.viewBox.baseVal.width < 11).length"""
    assert shown.evaluate(small) == 0
    violations = []
    if rules is not None:
        axe = pytest.importorskip("axe_playwright_python.sync_playwright")
        options = {"resultTypes": ["violations"]} | rules
        violations = axe.Axe().run(shown, options=options).response["violations"]
    context.close()
    assert [(one["id"], one["nodes"][0]["html"][:120]) for one in violations] == []


# ---- the results are what the second pipeline makes: a cheap row of each paper


def test_r_s_generator_draws_the_studys_record():
    u, y = papers_temperature.record(300)
    _, stored_u, stored_y = read_published(str(ROOT / "datasets/published"))
    np.testing.assert_allclose(u, stored_u[:300], atol=1e-10)
    np.testing.assert_allclose(y, stored_y[:300], atol=1e-10)


def test_the_runs_of_the_temperature_paper_are_those_on_file():
    K0, *_ = read_published(str(ROOT / "datasets/published"))
    text, script = papers_temperature.model_based(K0)
    found = results("temperature")
    for name in ("identity", "tuned"):
        for mine, stored in ((text, found["model_based"]), (script, found["by_script"]["model_based"])):
            for figure in ("y", "error", "J100", "J1000"):
                assert stored[name][figure] == pytest.approx(mine[name][figure], rel=1e-9), (name, figure)


def test_a_learned_gain_that_is_the_models_ends_where_the_optimum_does():
    plant = baam()
    K, K_r = exact_gains(plant, gains(plant, np.eye(5), np.eye(7), published.GAMMA), 6)
    run = papers_temperature.data_driven(published.IDENTITY[0], np.hstack([K, K_r]))
    assert np.linalg.norm(run.y[99] - published.REFERENCE) == pytest.approx(0.0195, abs=5e-4)
    # the script's count of the first stage: y(0) is taken for 50 °C, and the effort is whole
    first = ((50.0 - published.REFERENCE) ** 2).sum() + (run.u[0] ** 2).sum()
    assert run.J[0] == pytest.approx(first)


def test_the_index_is_3_discounted_by_hand():
    y, u = np.vstack([published.REFERENCE + 1, published.REFERENCE]), np.array([[0.0] * 7, [2.0] * 7])
    weights = np.full(5, 0.5), np.full(7, 0.25)
    assert papers_temperature.discounted(y, u, weights) == pytest.approx([2.5, 2.5 + 0.99 * 7])


def test_algorithm_1_as_printed_needs_an_admissible_gain_which_the_scripts_draw_is_not():
    K0, *_ = read_published(str(ROOT / "datasets/published"))
    best = gains(baam(), np.eye(5), np.eye(7), published.GAMMA)
    found = papers_temperature.policy_iteration(published.IDENTITY, papers_temperature.ADMISSIBLE)
    np.testing.assert_allclose(found.K, np.hstack([best.K_x, best.K_r]), atol=1e-4)
    drawn = papers_temperature.policy_iteration(published.IDENTITY, K0)
    assert not published.stabilises(baam(), drawn.K[:, :6])


def test_the_search_of_the_paper_returns_the_least_that_it_tried_and_beats_its_first_points():
    tried = []

    def F(theta):
        tried.append(float(((theta - 0.2) ** 2).sum()))
        return tried[-1]

    theta = papers_temperature.bayesian_optimisation(F, np.random.default_rng(3))
    assert len(tried) == papers_temperature.BO_EVALUATIONS
    assert ((theta - 0.2) ** 2).sum() == min(tried) < min(tried[: papers_temperature.BO_INITIAL])
    low, high = papers_temperature.BOUNDS
    assert (low <= theta).all() and (theta <= high).all()


def test_the_temperature_results_are_made_of_the_rows_and_the_stop_that_they_name():
    u, y = papers_temperature.record(360)
    few, many = papers_temperature.squares(u, y, (200, 300))
    alone = papers_temperature.squares(u[:207], y[:207], (200,))[0]
    # the same normal equations, whether or not more rows follow, up to the basis of the windows
    assert np.linalg.norm(few.gram) == pytest.approx(np.linalg.norm(alone.gram), rel=1e-6)
    assert np.trace(many.gram) > np.trace(few.gram)
    found = results("temperature")
    assert found["by_script"]["data_driven"]["rows"] == papers_temperature.SAMPLES + papers_temperature.LENGTH
    assert found["settings"]["rows"] == papers_temperature.SAMPLES


def test_value_iteration_on_data_ends_at_one_gain_from_any_kernel():
    u, y = papers_temperature.record(2600)
    (data,) = papers_temperature.squares(u, y, (2500,))
    size = len(data.V) + 7
    W = np.random.default_rng(1).standard_normal((size, size))
    (K, _), (other, _) = (
        papers_temperature.value_iteration(data, published.IDENTITY, 1e-6, H_0) for H_0 in (None, W.T @ W)
    )
    np.testing.assert_allclose(other, K, atol=1e-4)


def test_algorithm_1_as_printed_misses_from_a_third_of_random_gains():
    found = papers_temperature.random_starts(40)
    assert 5 <= found["missed"] <= 25
    assert sum(found["by_policies"].values()) == 40 - found["missed"]


def test_the_bandwidth_the_gain_and_the_ranks_are_the_machines():
    assert papers_temperature.machine() == pytest.approx(results("temperature")["machine"])


def test_the_deposition_results_are_made_by_the_law_on_its_nominal_machine():
    found, task = results("deposition"), papers_deposition.trained()
    nominal = papers_deposition.MATERIALS["A"]
    ratio = papers_deposition.ratios(papers_deposition.learned(nominal, nominal, task.r), task)
    assert found["learning"]["A"]["ratio"] == pytest.approx(ratio, abs=1e-3)
    assert found["settings"] == json.loads(json.dumps(papers_deposition.table_1()))
    # a Q that runs forward only is another law
    causal = papers_deposition.learned(nominal, nominal, task.r, papers_deposition.causal_q)
    assert min(papers_deposition.ratios(causal, task)) > 2 * min(ratio)


def test_an_error_is_of_the_measured_flow_a_mm_of_travel_while_the_gantry_moves():
    task = papers_deposition.trained()._replace(r=np.zeros(3), speed=np.array([8.0, 4.0, 0.0]))
    first, then = (
        Trial(np.zeros(3), np.array(y), np.full(3, 99.0)) for y in ([8.0, 4.0, 7.0], [4.0, 2.0, 70.0])
    )
    assert papers_deposition.ratios([first, then], task) == pytest.approx([100.0, 50.0])


def test_the_ramps_that_give_the_printed_effort_do():
    effort = results("deposition")["learning"]["effort"]
    task = papers_deposition.trained(effort["changed_ramp_s"])
    A, B = (
        papers_deposition.learned(one, one, task.r)[papers_deposition.TRIALS].u[task.r > 0]
        for one in papers_deposition.MATERIALS.values()
    )
    assert np.sqrt((B**2).mean() / (A**2).mean()) == pytest.approx(effort["changed_ratio"], rel=1e-6)
    assert effort["changed_ratio"] == pytest.approx(papers_deposition.PRINTED_EFFORT, abs=0.005)


def test_the_part_with_all_five_tasks_has_them_in_both_materials():
    counts = results("deposition")["five_tasks"]["counts"]
    assert min(counts.values()) > 0 and results("deposition")["tic_tac_toe"]["counts"]["corner"] == 0
    tools = {row["tool"] for row in results("deposition")["five_tasks"]["path"]}
    assert tools == {0, 1}


def test_the_setpoint_results_are_of_the_settings_in_force():
    settings = params.load(search_agent.TrainAgent, "train_agent", ROOT / params.PAPERS)
    found, searched = results("setpoint"), json.loads(SEARCHED.read_text(encoding="utf-8"))
    how = search_agent.training(settings, searched["best"])
    assert found["guesses"] == json.loads(json.dumps(train_agent.guesses(how)))
    assert found["table_2"] == pytest.approx(papers_setpoint.table_2(how))
    assert found["arithmetic"] == json.loads(json.dumps(papers_setpoint.arithmetic()))


def test_all_pages_tell_the_same_figures_of_one_agent():
    """The search, the kept agent that the setpoint page shows, and the papers' page. An agent of an earlier
    search stays where it did better on the validation runs than the best of this one."""
    searched = json.loads(SEARCHED.read_text(encoding="utf-8"))
    phase_4 = results("setpoint")["agents"]["phase_4"]
    kept = json.loads((ROOT / "datasets/papers/train_agent/figures.json").read_text(encoding="utf-8"))
    earlier = kept["kept_from"] == "an earlier search"
    assert earlier == (kept["validated_stay"] > searched["kept"]["validated_stay"])
    for name in ("settled", "stay"):
        assert phase_4["starts_70"][name] == kept["phase4"][name]
        assert earlier or kept["phase4"][name] == searched["kept"][name]
        assert phase_4["starts_100"][name] == kept["phase4_at_1"][name]
    assert results("setpoint")["search"] == searched


def test_a_single_start_is_told_by_its_own_runs():
    class Path_:
        flow = np.array([[200.0] * 41 + [100.0, 80.0] * 30, [200.0] * 41 + [100.0, 90.0] * 30])
        temperature = np.full((2, 101), 210.0)
        shares = np.full((2, 101, 3), 1 / 3)

    told = papers_setpoint.single(Path_, shown=False)
    assert (told["least"], told["most"], told["flow_range"]) == (85.0, 100.0, 15.0)
    assert told["rests_at"] == pytest.approx(92.5, abs=0.5) and "run" not in told


def test_one_run_from_each_start_all_settled_is_counted_by_repeats():
    starts = papers_setpoint.trials.starts(2, accuracy=1.0)
    q, u = (np.asarray(a, float)[:, None] for a in (starts.flow, starts.temperature))
    settled = np.ones(len(q), bool)
    # of two repeats the second fails from 60 % and 190 °C
    settled[np.flatnonzero((q[:, 0] == 60) & (u[:, 0] == 190))[1]] = False
    found = papers_setpoint.together(q, u, settled)
    assert (found["a_1"], found["all"]) == (50.0, 50.0)
    assert {found[f"a_{i}"] for i in range(2, 7)} == {100.0}


def test_the_nearest_draw_has_the_figures_that_it_is_said_to_have(monkeypatch):
    monkeypatch.setattr(papers_setpoint, "DRAWS", 200)
    network = restore_published(str(ROOT / "datasets/papers/train_agent/weights.safetensors")).networks[-1]
    found = papers_setpoint.draws(network, "case_2", 0.7)
    printed = papers_setpoint.PRINTED_RUNS["case_2"]
    near = [
        abs(found["nearest"][name] / value - 1) <= papers_setpoint.NEAR for name, value in printed.items()
    ]
    assert sum(near) == found["nearest_has"] <= found["figures"] == 4
    assert found["all"] == 0 or found["nearest_has"] == 4
    for name, is_near in zip(printed, near, strict=True):
        assert not is_near or found["percent"][name] > 0


@pytest.mark.parametrize(("right_of_adr", "helping"), [(range(8), 16), ([*range(1, 5), 6], 0)])
def test_adr_helps_only_if_it_gains_more_than_chance_over_segments(monkeypatch, right_of_adr, helping):
    """Eight segments of five pictures; a network is here the segments that it names right."""
    pictures = np.zeros((40, len(papers_camera.SHAKES_PX), 16, 48), np.uint8)
    segment, label = np.repeat(np.arange(8), 5), np.ones(40, int)
    truth = (np.full(40, 210.0), label, np.full(40, 100.0), segment)
    judged = papers_camera.Filmed(pictures[:, 0], pictures[:, 0], pictures, truth)
    none, adr = list(range(4)), list(right_of_adr)
    learned = {papers_camera.unchanged: none}
    monkeypatch.setattr(papers_camera, "learned", lambda parts, name, way, epochs: learned.get(way, adr))
    monkeypatch.setattr(
        papers_camera, "named", lambda network, seen: np.isin(seen.segment, network).astype(int)
    )
    found = papers_camera.robustness([judged] * 3, {"mask": none, "mask_adr": adr})
    assert (found["ways"], found["helping"], found["helps"]) == (16, helping, helping > 0)
    assert found["best"]["gains"] == pytest.approx(100 * len(adr) / 8 - 50)


def test_one_record_that_raises_the_curve_of_a_controller_is_named():
    """Against the raw costs: each that is more than ten times the median of its length, and no other."""
    found = json.loads((ROOT / "datasets/papers/relearned.json").read_text(encoding="utf-8"))
    said = page._by_length(str(ROOT / "datasets/papers/relearned.json"))["apart"]
    high = [
        (int(samples), name, cost)
        for samples, answered in found["curve"]["answers"].items()
        for name, costs in answered["costs"].items()
        for cost in costs
        if name in found["curve"]["controllers"] and cost > 10 * sorted(costs)[len(costs) // 2]
    ]
    assert [row[:3] for row in said] == high
    assert (60000, "subspace_lqg") in [row[:2] for row in said]


@pytest.mark.parametrize(
    ("winners", "sentence"),
    [
        (
            [{"subspace_lqg": 2, "None": 1}, {"varx_riccati": 2, "subspace_lqg": 1}],
            "The model-based controller wins from records of 25 min (2 of 3) and 100 min (3 of 3). "
            "No length turns the answer round.",
        ),
        (
            [{"subspace_lqg": 2, "None": 1}, {"learned_kernel": 3}],
            "The model-based controller wins from records of 25 min (2 of 3). "
            "The data-driven controller wins from records of 100 min (3 of 3).",
        ),
        (
            [{"None": 3}, {"predictive_control": 1, "learned_kernel": 1, "None": 1}],
            "The data-driven controller wins from records of 100 min (2 of 3). "
            "The other lengths decide nothing.",
        ),
        ([{"None": 2, "pi": 1}, {"None": 3}], "No length gives one kind most of the records."),
    ],
)
def test_the_kind_that_wins_most_records_of_a_length_is_said(winners, sentence):
    """By hand; a kind wins by whichever of its controllers answered, a baseline counts for neither."""
    answers = {
        str(samples): {"records": 3, "pair_winner": won}
        for samples, won in zip((1500, 6000), winners, strict=True)
    }
    assert page._pair_by_length(answers, 1.0) == sentence
