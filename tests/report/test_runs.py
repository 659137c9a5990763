"""The page of the runs from a git of many: kinds, figures of three loops, parameters, curves, reasons,
hostile names, time and size; and in a browser what is chosen, compared and drawn."""

import hashlib
import json
import math
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pipeline import cli
from pipeline.report.runs import collected, curves, figures
from pipeline.report.shared.verdict import Figure, Question, ReportRules
from pipeline.store import artifacts, params
from pipeline.store.printable import printable
from tests.report import made
from tests.report.conftest import MACHINE, expect, loaded
from tests.report.made_runs import Made, lock, make, metrics, parameters
from tests.report.test_pages import Page

PAGE = Path("reports/runs.html")
OTHER = "{}.json has no such figure: of an earlier version, or edited"
NIGHT = {"reports/metrics/nightly.json": {"run": "night-0007", "decision": "promoted"}}


def command(*arguments):
    """`beadline runs` under today's rules, whatever parameters the last revision has."""
    Path(params.EXPERT).unlink(missing_ok=True)
    made.declared(Path())
    before, sys.argv = sys.argv, ["beadline", "runs", *arguments]
    try:
        cli.main()
    finally:
        sys.argv = before


@pytest.fixture
def empty(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def asked():
    return figures.columns(params.load(ReportRules, "report", made.ROOT / "params.yaml"))


def found(*runs):
    """The runs of a git of these."""
    make(runs)
    return collected.collected(100, asked()).runs


def data(text=None):
    """What the page hands to its script."""
    text = PAGE.read_text() if text is None else text
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text)[1])


# ---- what stands in the table


def test_accepted_runs_nights_experiments_and_others_stand_in_order_with_figures_of_three_loops(empty):
    runs = found(
        Made("plain", metrics(30.0)),
        Made("good", {**metrics(26.0), "reports/accepted.json": "{}"}),
        Made("a night", {**metrics(25.0), **NIGHT}),
        Made("tried", metrics(24.0, stay=90.0), name="warm-owl", base=1),
    )
    assert [(run.kind, run.name, run.subject) for run in runs] == [
        ("revision", "", "plain"),
        ("accepted", "", "good"),
        ("night", "night-0007", "a night"),
        ("experiment", "warm-owl", "tried"),
    ]
    own = runs[-1].measured
    # by hand: the winner's figure as the pages show it, the part in use, the least case, the barred one
    assert {key: tuple(figure[:3]) for key, figure in own.figures.items()} == {
        "temperature.settling": (24.0, 0.9 * 24, pytest.approx(1.1 * 24)),
        "temperature.cost": (3.0, pytest.approx(2.7), pytest.approx(3.3)),
        "temperature.disk": (0.5, 0.5, 0.5),
        "deposition.flow_error_percent": (2.5,) * 3,
        "deposition.line_volume_percent": (2.0,) * 3,
        "deposition.learned_percent": (2.0,) * 3,
        "setpoint.settled": (75.0,) * 3,
        "setpoint.stay": (90.0, 81.0, 99.0),
        "setpoint.harm": (0.5, 0.1, 4.0),
        "setpoint.right_70_150": (82.5, 78.0, 87.0),
    }
    assert own.controllers == {"temperature": "pi_simc", "setpoint": "Bayes, robust"}
    assert own.verdicts == {"temperature": "passed", "deposition": "open", "setpoint": "failed"}


def test_a_night_that_committed_nothing_stands_there_with_its_reason_and_a_committed_one_once(empty):
    make([Made("a night", {**metrics(), **NIGHT})])
    rows = [
        {"run": "night-0006", "when": "2023-11-13T02:00:00+00:00", "outcome": "kept", "reasons": ["alike"]},
        {"run": "night-0007", "when": "2023-11-15T02:00:00+00:00", "outcome": "promoted"},
        {"run": "night-0008", "when": "no time", "outcome": "failed"},
        "no night",
    ]
    artifacts.write_json(collected.NIGHTS, rows)
    told = collected.collected(9, asked())
    assert [run.name for run in told.runs] == ["night-0006", "night-0007"] and told.troubles == []
    reason = "this night ended as kept, and committed no figures"
    assert set(told.runs[0].measured.missing.values()) == {reason}
    collected.NIGHTS.write_text("{")
    command()
    assert "Nights without a commit are left out: .beadline/nights.json" in Page(PAGE).text


def test_files_that_are_not_committed_come_last_and_equal_ones_do_not_come_twice(empty):
    make([Made("one", metrics(26.0))])
    assert [run.kind for run in collected.collected(9, asked()).runs] == ["revision"]
    for path, content in metrics(20.0).items():
        artifacts.write_json(path, content)
    runs = collected.collected(9, asked()).runs
    assert [run.kind for run in runs] == ["revision", "files"]
    assert runs[-1].measured.figures["temperature.settling"].value == 20.0


@pytest.mark.parametrize(
    ("files", "key", "reason"),
    [
        ({}, "setpoint.stay", "there is no evaluate_setpoint.json"),
        ({"evaluate_setpoint": "{"}, "setpoint.stay", "evaluate_setpoint.json is empty, or damaged"),
        ({"evaluate_setpoint": "[]"}, "setpoint.stay", "evaluate_setpoint.json is empty, or damaged"),
        ({"evaluate_setpoint": '{"default": {"a": 1}, "cases": {"a": {"stay": "much"}}}'},
         "setpoint.stay", OTHER.format("evaluate_setpoint")),
        ({"evaluate_setpoint": '{"default": 3, "cases": [1], "harm": {"perfect": 2}}'},
         "setpoint.harm", OTHER.format("evaluate_setpoint")),
        ({"evaluate_setpoint": '{"cases": {"a": {"stay": NaN, "settled": true}}}'},
         "setpoint.settled", OTHER.format("evaluate_setpoint")),
        ({"evaluate_setpoint": "[" * 100000}, "setpoint.stay", "evaluate_setpoint.json is empty, or damaged"),
        ({"report": {"verdict": {"winner": "data_driven"}, "figures": {"window": {"disk": 1}}}},
         "temperature.settling", "of an earlier comparison, which did not judge controllers as deployed"),
        ({"report": {"verdict": [], "verdicts": {"setpoint": 3}, "figures": {"pi": 3}},
          "evaluate_temperature": {"contestants": {"pi": [1]}, "best": "pi"}},
         "temperature.cost", OTHER.format("evaluate_temperature")),
    ],
)  # fmt: skip
def test_what_is_missing_damaged_or_of_another_version_is_not_measured_and_says_why(
    empty, files, key, reason
):
    files = {f"reports/metrics/{name}.json": content for name, content in files.items()}
    runs = found(Made("odd", {**files, "reports/metrics/ingest.json": "{}"}))
    assert key not in runs[0].measured.figures and runs[0].measured.missing[key] == reason
    command()
    page = Page(PAGE).text
    assert "not measured" in page and reason in page


def test_an_earlier_version_of_the_setpoint_loop_is_read_without_its_bands(empty):
    old = {
        "default": "filter",
        "worst": 95.0,
        "filter": {
            "paper": {"accuracy 1": {"settled": 100.0, "stay": 99.0}},
            "recorded": {"recorded, sticky": {"settled": 97.0, "stay": 95.0}},
            "pixels": {"calm": {"settled": 10.0}},
        },
    }
    runs = found(Made("old", {"reports/metrics/evaluate_setpoint.json": old}))
    assert runs[0].measured.figures["setpoint.settled"][:3] == (97.0,) * 3
    assert runs[0].measured.figures["setpoint.stay"][:3] == (95.0,) * 3


# ---- experiments and parameters


def chain(weights, judged):
    """The dvc.lock of two stages, the second of which reads what the first makes."""
    return lock(
        tune_weights=({"params": "1"}, {"datasets/tune_weights": weights}),
        evaluate_temperature=(
            {"datasets/tune_weights/weights.parquet": "w"},
            {"datasets/evaluate_temperature": judged},
        ),
        report=({"datasets/evaluate_temperature": judged}, {"reports/index.html": judged}),
        evaluate_setpoint=({"datasets/levels": "l"}, {"datasets/evaluate_setpoint": "s"}),
    )


def test_figures_of_stages_that_an_experiment_did_not_run_again_are_not_taken_for_its_own(empty):
    base = {**metrics(), "dvc.lock": chain("a.dir", "b.dir")}
    stopped, whole = (
        {"dvc.lock": chain("c.dir", "b.dir")},
        {"dvc.lock": chain("c.dir", "d.dir"), **metrics(22.0)},
    )
    runs = found(Made("base", base), Made("x", stopped, "stopped"), Made("y", whole, "whole"))
    gone = runs[1].measured
    assert (
        gone.missing["temperature.settling"]
        == "evaluate_temperature was not run again after tune_weights changed"
    )
    # the setpoint loop reads nothing of what changed
    assert gone.figures["setpoint.stay"].value == 71.0 and gone.verdicts == {}
    assert runs[2].measured.figures["temperature.settling"].value == 22.0


def test_parameters_stand_under_todays_names_and_the_page_hands_over_each_value(empty):
    old = {"params.yaml": "printer: {limit_mm: 8}\nreport: {gap_percent: 1}\n"}
    runs = found(
        Made("old", {**metrics(30.0), **old}),
        Made("new", {**metrics(), **parameters()}),
        Made("tried", {**metrics(24.0), **parameters(budget=90)}, "warm", base=1),
        Made("last", {**metrics(25.0), **parameters(budget="no\ttab")}),
    )
    # one key was renamed since, the other retired
    assert runs[0].parameters == {"printer.drive.amplitude_mm": "8"}
    assert runs[2].parameters["tune_weights.budget"] == "90"
    command()
    told, held = data(), {}
    for run, entry in zip(runs, told["runs"], strict=True):
        for key, value in zip(entry["changes"][::2], entry["changes"][1::2], strict=True):
            name = told["texts"][key]
            held = {k: v for k, v in held.items() if k != name} | (
                {} if value < 0 else {name: told["texts"][value]}
            )
        assert held == dict(run.parameters)
    # what the experiment changed is a column, and nothing else is
    assert re.findall(r"<bdi>([a-z_.]+)</bdi><small>parameter", PAGE.read_text()) == ["tune_weights.budget"]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("a: [", "params.yaml cannot be read"),
        ("- 1\n", "params.yaml cannot be read"),
        ("a: {b: 1}\nb: *none\n", "params.yaml cannot be read"),
        ("a: [" + ", ".join("{b: 1}" for _ in range(6000)) + "]", "params.yaml has more than 5000 values"),
    ],
)
def test_parameters_that_cannot_be_read_are_told_and_the_figures_stay(empty, text, reason):
    runs = found(Made("odd", {**metrics(), "params.yaml": text}))
    assert (runs[0].parameters, runs[0].no_parameters) == ({}, reason)
    assert runs[0].measured.figures["setpoint.stay"].value == 71.0


def test_an_alias_of_another_section_is_followed(empty):
    text = "a: &here {b: 1}\nc: *here\n"
    assert collected.parameters([text.encode(), None]) == ({"a.b": "1", "c.b": "1"}, "")


def test_a_metric_that_is_asked_for_is_a_column_more_and_a_wrong_name_is_refused(empty, capsys):
    tuned = {"reports/metrics/tune_weights.json": {"contestants": {"pi": {"cost": 4.25}}}}
    make([Made("one", {**metrics(), **tuned})])
    command("--also", "tune_weights:contestants.pi.cost", "--also", "tune_weights:contestants.none")
    page = Page(PAGE).text
    assert "tune_weights:contestants.pi.cost metric" in page and " 4.25 " in page
    assert "tune_weights.json has no such figure" in page
    with pytest.raises(SystemExit):
        command("--also", "cost")
    assert "expected a metric as STAGE:dotted.key" in capsys.readouterr().err


# ---- curves


def cached(folder):
    """Tables of the temperature and deposition loops in DVC's cache, and the dvc.lock that names them."""
    time_s = np.arange(0.0, 50.0)
    heat = pd.DataFrame(
        {
            "contestant": "pi_simc",
            "case_name": "deciding",
            "time_s": time_s,
            "zone_1": 100 - 80 * 0.9**time_s,
            "zone_1_reference": 100.0,
        }
    )
    trials = pd.DataFrame(
        {"material": "A", "law": "model_inverse", "trial": [0, 0, 1, 1], "ratio": [1.0, 1.0, 0.25, 0.35]}
    )
    outs = {}
    for stage, name, table in (
        ("evaluate_temperature", "trajectories.parquet", heat),
        ("train_ilc", "trials.parquet", trials),
    ):
        table.to_parquet(folder / "made.parquet")
        files = [((folder / "made.parquet").read_bytes(), name)]
        listed = []
        for content, own in files:
            md5 = hashlib.md5(content, usedforsecurity=False).hexdigest()
            artifacts.write_text(curves.CACHE / md5[:2] / "x", "")
            (curves.CACHE / md5[:2] / md5[2:]).write_bytes(content)
            listed.append({"md5": md5, "relpath": own})
        text = json.dumps(listed)
        md5 = f"{hashlib.md5(text.encode(), usedforsecurity=False).hexdigest()}.dir"
        artifacts.write_text(curves.CACHE / md5[:2] / md5[2:], text)
        outs[stage] = ({}, {f"datasets/{stage}": md5})
    return lock(**outs), heat


def test_curves_are_those_of_the_artifacts_and_what_is_not_in_the_cache_is_told(empty):
    text, heat = cached(empty)
    runs = found(Made("one", {**metrics(), "dvc.lock": text}), Made("two", metrics(30.0)))
    told = curves.curves(runs[0], {})
    assert [curve.name for curve in told.curves] == [
        "Temperature of zone_1, deciding case",
        "Flow error left by trial, material A",
    ]
    np.testing.assert_array_equal(told.curves[0].y, heat["zone_1"])
    # the mean of two routines, in percent
    np.testing.assert_allclose(told.curves[1].y, [100.0, 30.0], rtol=1e-12)
    assert "evaluate_setpoint/paths.parquet is not in DVC’s cache here; git checkout" in told.why
    # both revisions have that dvc.lock, so that both have one file
    packed = curves.packed(runs, {})
    assert len(packed.files) == 1 and packed.places[0] == packed.places[1]


def test_a_run_that_judged_no_controller_has_no_curve_of_one_and_says_so(empty):
    text, _ = cached(empty)
    runs = found(Made("one", {"reports/metrics/ingest.json": "{}", "dvc.lock": text}))
    told = curves.curves(runs[0], {})
    assert [curve.name for curve in told.curves] == ["Flow error left by trial, material A"]
    assert "no controller of the temperature loop has figures in this run" in told.why


def test_a_damaged_table_leaves_its_curve_out_and_says_so(empty):
    text, _ = cached(empty)
    for path in curves.CACHE.rglob("*"):
        if path.is_file() and path.read_bytes()[:4] == b"PAR1":
            path.write_bytes(b"PAR1 and nothing else")
    runs = found(Made("one", {**metrics(), "dvc.lock": text}))
    told = curves.curves(runs[0], {})
    assert told.curves == []
    assert "trajectories.parquet is damaged, or of another version" in told.why


def test_curves_beyond_the_room_are_left_out_and_told(empty, monkeypatch):
    text, _ = cached(empty)
    runs = found(Made("one", {**metrics(), "dvc.lock": text}))
    monkeypatch.setattr(curves, "LARGEST", 100)
    packed = curves.packed(runs, {})
    assert packed.files == {} and packed.why == ["there is no room for more curves beside this page"]


# ---- the whole page


def test_hostile_names_do_nothing(empty):
    bad = '"><script>alert(1)</script><img/src=x>'
    odd = metrics(24.0, winner=bad)
    odd["reports/metrics/evaluate_setpoint.json"]["default"] = made.HOSTILE
    make([
        Made(made.HOSTILE, metrics()),
        Made(made.HOSTILE, {**odd, **parameters(budget=made.HOSTILE)}, name=bad.replace(" ", "")),
    ])  # fmt: skip
    command()
    page = Page(PAGE)
    scripts = [attributes for tag, attributes in page.tags if tag == "script"]
    assert len(scripts) == 3 and not any("src" in attributes for attributes in scripts)
    assert not any(tag == "img" for tag, _ in page.tags)
    assert not any(name.startswith("on") for _, attributes in page.tags for name in attributes)
    assert data()["runs"][1]["who"][2] == printable(made.HOSTILE)


def test_the_same_runs_give_the_same_bytes(empty):
    text, _ = cached(empty)
    make([
        Made("one", {**metrics(), **parameters(), "dvc.lock": text}),
        Made("tried", {**metrics(24.0), **parameters(seed=2)}, "b"),
        Made("tried", {**metrics(23.0), **parameters(seed=3)}, "a"),
    ])  # fmt: skip
    command()
    first = {path.name: path.read_bytes() for path in (PAGE, *sorted(Path("reports/runs").iterdir()))}
    shutil.rmtree("reports/runs")
    command()
    assert first == {path.name: path.read_bytes() for path in (PAGE, *sorted(Path("reports/runs").iterdir()))}
    assert set(first) > {"runs.html", "uPlot.js"}


def test_a_thousand_runs_take_a_few_processes_and_the_page_stays_bounded(empty, capsys, started):
    runs = [Made("base", {**metrics(), **parameters()})]
    for k in range(1100):
        own = {**metrics(20 + k / 100, stay=50 + k / 50), **parameters(seed=k, budget=k % 7)}
        runs.append(Made(f"tried {k}", own, f"sweep-{k}"))
    make(runs)
    started.clear()
    command()
    # no git for each run
    assert 0 < len(started) < 20
    assert "1000 runs" in capsys.readouterr().out
    told = data()
    assert len(told["runs"]) == 1000 and PAGE.stat().st_size < 4_000_000
    # the newest are taken
    assert told["runs"][-1]["name"] == "sweep-1099"


@pytest.mark.parametrize("made_git", [False, True])
def test_without_a_git_or_a_run_it_says_so_and_writes_nothing(empty, monkeypatch, capsys, made_git):
    if made_git:
        make([Made("other", {"a": "a"})])
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(empty.parent))
    with pytest.raises(SystemExit):
        command()
    sentence = "git has no revision of it; commit the figures" if made_git else "the history cannot be read"
    assert sentence in capsys.readouterr().err and not PAGE.exists()


# ---- in a browser


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder of reports with the page of five runs."""
    root = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        text, _ = cached(root)
        base = {**metrics(26.0, 71.0), **parameters(), "dvc.lock": text}
        make([
            Made("old", {"reports/metrics/report.json": "{"}),
            Made("good", {**base, "reports/accepted.json": "{}"}),
            Made("tried 90", {**metrics(40.0, 80.0), **parameters(budget=90)}, "budget-90", base=1),
            Made("tried 120", {**metrics(50.0, 85.0), **parameters(budget=120)}, "budget-120", base=1),
            Made("now", {**metrics(30.0, 95.0, flow=2.0), **parameters(seed=9)}),
        ])  # fmt: skip
        command()
        Path("reports/machine.js").write_text(MACHINE)
    return root / "reports"


def opened(browser, folder, where="", **view):
    page = loaded(browser, folder, "runs", **view)
    if where:
        page.goto(f"file://{folder}/runs.html{where}")
        page.reload()
    if view.get("script", True):
        page.wait_for_selector("html[data-ready]")
    return page


@pytest.fixture
def show(browser, folder):
    pages = []

    def shown(where="", **view):
        pages.append(opened(browser, folder, where, **view))
        return pages[-1]

    yield shown
    for page in pages:
        page.context.close()


VIEWS = [(390, "light"), (1280, "light"), (1440, "dark"), (390, "dark")]


@pytest.mark.parametrize(("width", "theme"), VIEWS)
def test_nothing_overflows_no_request_leaves_axe_is_content_and_letters_are_legible(show, width, theme):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe is not installed")
    page = show(width=width, theme=theme)
    page.wait_for_selector("html[data-curve]")
    assert page.evaluate("document.documentElement.scrollWidth") <= width and page.console == []
    assert all(url.startswith("file://") for url in page.asked)
    wide = """width => [...document.querySelectorAll("body *")].filter(e =>
        !e.closest("svg, .scroll, .box, .vh, dialog, .tip") &&
        e.getBoundingClientRect().right > width + 1).map(e => e.outerHTML.slice(0, 120))"""
    assert page.evaluate(wide, width) == []
    # on the screen: letters of a picture shrink with it
    letters = """() => [...document.querySelectorAll("#cloud svg text, .swept svg text")].map(text =>
        parseFloat(getComputedStyle(text).fontSize) * text.getScreenCTM().a)"""
    sizes = page.evaluate(letters)
    assert len(sizes) > 5 and min(sizes) >= 11
    assert axe.Axe().run(page, options={"resultTypes": ["violations"]}).response["violations"] == []


def test_without_a_script_the_table_reads_and_says_what_it_cannot_do(show):
    page = show(script=False)
    rows = page.locator("#runs tbody tr")
    assert rows.count() == 5
    said = " ".join(rows.last.inner_text().split())
    assert "not measured" in said and "report.json" not in said and "there is no evaluate_setpoint" in said
    assert "Without a script the table does not sort" in page.locator("main").inner_text()
    expect(page.locator("#two")).not_to_be_visible()


def column(page, title):
    heads = page.locator("#runs thead th").all_inner_texts()
    at = next(k for k, head in enumerate(heads) if head.startswith(title))
    return page.locator(f"#runs tbody tr:visible > :nth-child({at + 1})").all_inner_texts()


def test_the_table_sorts_and_the_filters_leave_kinds_and_words(show):
    page = show()
    page.locator("#runs th button", has_text="Settling").click()
    assert column(page, "Settling") == ["26.0", "30.0", "40.0", "50.0", "not measured"]
    page.get_by_label("accepted").uncheck()
    page.get_by_label("Only rows with").fill("tried 120")
    expect(page.get_by_text("1 of 5 runs", exact=True)).to_be_visible()
    assert column(page, "Settling") == ["50.0"]
    page.wait_for_function("location.hash.includes('find=tried+120')")


def side(page):
    """{row: its cells} of the comparison."""
    rows = page.locator("#side tbody tr").all()
    return {
        row.locator("th").inner_text().split("\n")[0]: row.locator("td").all_inner_texts() for row in rows
    }


def test_two_runs_stand_side_by_side_with_bands_changes_and_parameters(show):
    page = show()
    told = side(page)
    # the last run beside the accepted one; bands of 10 % either way of 26 and 30 overlap
    assert told["Settling"] == ["26\u202fs\n23.4–28.6", "30\u202fs\n27–33", "within noise"]
    assert told["Stays, worst case"][2] == "+24\u202fpoints · better"
    assert told["Worst flow error of a part"] == [
        "2.5\u202f%\nno band", "2\u202f%\nno band", "\u22120.5\u202fpoints · better"
    ]  # fmt: skip
    assert told["tune_weights.seed"] == ["1", "9"] and "tune_weights.budget" not in told
    page.get_by_label("Run B", exact=True).select_option("budget-120")
    told = side(page)
    assert told["Settling"][2] == "+24\u202fs · worse" and told["tune_weights.budget"] == ["60", "120"]
    page.get_by_label("Run B", exact=True).select_option(index=4)
    assert side(page)["Stays, worst case"][1] == "Not measured: there is no evaluate_setpoint.json"
    assert "there is no params.yaml" in page.locator("#side").inner_text()


def test_the_address_restores_what_is_chosen_and_an_unknown_run_is_told(show):
    page = show("#a=budget-90&b=nobody&x=parameter%20tune_weights.budget&y=temperature.settling")
    assert page.get_by_label("Run A", exact=True).input_value() == "budget-90"
    assert "There is no run nobody here." in page.locator("#side").inner_text()
    assert page.get_by_label("Across", exact=True).input_value() == "parameter tune_weights.budget"


def test_curves_of_both_runs_are_drawn_with_the_values_of_the_artifact(show):
    page = show()
    page.wait_for_selector("html[data-curve='Temperature of zone_1, deciding case']")
    chart = page.locator(".chartbox [role=img]")
    chart.focus()
    for _ in range(4):
        page.keyboard.press("ArrowRight")
    words = page.locator(".keyab b").all_inner_texts()
    # 100 - 80 x 0.9^4; both runs have these artifacts
    assert words == ["47.51 at 4"] * 2
    page.get_by_label("Curve", exact=True).select_option("Flow error left by trial, material A")
    page.wait_for_selector("html[data-curve='Flow error left by trial, material A']")
    page.wait_for_function("location.hash.includes('curve=Flow')")


def test_a_scatter_has_a_point_a_run_at_its_values_and_makes_it_run_b(show):
    page = show("#x=parameter%20tune_weights.budget&y=temperature.settling")
    cloud = page.locator("#cloud svg[role=img]")
    assert cloud.locator(".p").count() == 4 and cloud.locator(".med").count() == 1
    cloud.focus()
    for _ in range(4):
        page.keyboard.press("ArrowRight")
    told = page.locator(".said-now").inner_text().replace("\u202f", " ")
    assert told.startswith("budget-120 experiment") and "Settling (temperature) 50 s" in told
    assert "Parameter tune_weights.budget 120" in told
    page.keyboard.press("Enter")
    assert page.get_by_label("Run B", exact=True).input_value() == "budget-120"
    # higher values lie further right and further up
    place = "e => [e.getBoundingClientRect().x, -e.getBoundingClientRect().y]"
    ninety, most = (cloud.locator(".p").nth(k).evaluate(place) for k in (2, 3))
    assert ninety[0] < most[0] and ninety[1] < most[1]


def test_a_cell_is_marked_on_the_side_of_its_limit_on_which_it_fails():
    def cell(value: float, limit: float, *, at_least: bool) -> figures.Cell:
        question = Question(0, "disk", "Disk margin", "", limit, at_least, "", beyond="unlimited")
        return figures.cell(Figure(value, value, value), question)

    assert [cell(v, 0.4, at_least=True).bad for v in (0.39, 0.4, 0.41)] == [True, False, False]
    assert [cell(v, 0.4, at_least=False).bad for v in (0.39, 0.4, 0.41)] == [False, False, True]
    assert cell(-0.123456789, 1.0, at_least=False) == figures.Cell("\N{MINUS SIGN}0.123", -0.123457)
    # a figure without end sorts last and says so; a column without a limit marks nothing
    assert cell(math.inf, 0.4, at_least=True) == figures.Cell("unlimited")
    assert cell(math.inf, 0.4, at_least=False) == figures.Cell("unlimited", "", True)
    assert not cell(1e9, math.inf, at_least=False).bad
    assert figures.cell(None, Question(0, "k", "t", "", 1.0, False, "")) == figures.Cell("not measured")
