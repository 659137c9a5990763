"""The stage on a small project: what the pages say, what they do with missing and hostile input, their size,
and that equal inputs give equal bytes."""

import base64
import hashlib
import json
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from pipeline.report.shared.page import environment
from pipeline.store import artifacts
from tests.report import made
from tests.report.made import main

INDEX, TEMPERATURE, IDENTIFICATION, DEPOSITION, SETPOINT = (
    Path(f"reports/{name}.html")
    for name in ("index", "temperature", "identification", "deposition", "setpoint")
)
CERTIFICATE, PAPERS = Path("reports/certificate.html"), Path("reports/papers.html")
RUNS, WORDS = BESIDE = Path("reports/runs.html"), Path("reports/words.html")
PAGES = (INDEX, TEMPERATURE, IDENTIFICATION, DEPOSITION, SETPOINT, CERTIFICATE, PAPERS, *BESIDE)


class Page(HTMLParser):
    """Tags with attributes, ids, text above the list of files at the foot, and the addresses that a page
    points to; every white space in the text is a plain one."""

    def __init__(self, path):
        super().__init__()
        self.tags, self.ids, self.links, self.words = [], [], [], []
        self.style = self.hidden = self.foot = False  # or script
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attributes):
        found, self.style = dict(attributes), tag in ("style", "script")
        self.foot |= found.get("class") == "prov"
        # what only a script shows, beside its word
        self.hidden = found.get("class") == "meanings" or (self.hidden and tag in ("div", "dt", "dd"))
        self.tags.append((tag, found))
        self.ids += [found["id"]] if "id" in found else []
        self.links += [
            found[key]
            for key in ("href", "src", "xlink:href", "action", "data", "poster", "srcset")
            if found.get(key)
        ]

    def handle_data(self, data):
        self.words += [] if self.style or self.hidden or self.foot else [data]

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())


def figures():
    return json.loads(Path("datasets/report/figures.json").read_text())


def change(stage, **values):
    """Metrics of a stage with some dotted keys changed."""
    found = artifacts.read_figures(stage)
    for dotted, value in values.items():
        *path, last = dotted.split("__")
        place = found
        for key in path:
            place = place[key]
        place[last] = value
    artifacts.write_metrics(stage, found)


def change_all(**changed):
    """The same figures for every contestant, so that no other one passes in the place of the best."""
    compared = artifacts.read_figures("evaluate_temperature")
    for name in compared["contestants"]:
        compared["contestants"][name] |= changed
    artifacts.write_metrics("evaluate_temperature", compared)


def test_equal_inputs_give_equal_bytes(project):
    main()
    first = [path.read_bytes() for path in (*PAGES, Path("datasets/report/figures.json"))]
    main()
    assert first == [path.read_bytes() for path in (*PAGES, Path("datasets/report/figures.json"))]


def test_the_title_of_page_one_is_the_verdict(project):
    main()
    text = INDEX.read_text(encoding="utf-8")
    decision = re.search(r"<h1.*?>(.*?)</h1>", text)[1]
    assert decision.rstrip(".") in re.search(r"<title>(.*?)</title>", text)[1]


def test_a_failed_rule_fails_the_verdict_and_its_row_only(project):
    change_all(settled_error=made.figure(0.72, 0.61, 0.84))
    main()
    page = Page(INDEX).text
    assert "Pass (simulation): deposition and setpoint; fail: temperature." in page
    assert (
        "First failed rule: settled error. Subspace + LQG settles 0.72 °C from its reference at the "
        "90 % quantile of all cases; the rule allows 0.50 °C." in page
    )
    page = Page(TEMPERATURE)
    assert "No contestant passes; subspace + LQG comes closest." in page.text
    failed = [found["id"] for _, found in page.tags if found.get("class", "").startswith("fail ")]
    assert failed == ["answer-settled_error"]
    assert figures()["verdict"]["winner"] is None


@pytest.mark.parametrize(
    "path",
    [
        "datasets/evaluate_temperature/cases.parquet",
        "datasets/evaluate_temperature/trajectories.parquet",
        "datasets/identify_plant/plant.parquet",
        "datasets/identify_plant/order.parquet",
        "datasets/identify_plant/holdout.parquet",
        "datasets/tune_weights/weights.json",
        "datasets/ingest/record.parquet",
        "datasets/ingest/quality.parquet",
        "datasets/probe_machine/figures.json",
        "datasets/ingest/figures.json",
        "datasets/identify_plant/figures.json",
        "datasets/learn_kernel/figures.json",
        "datasets/tune_weights/figures.json",
        "datasets/evaluate_temperature/figures.json",
    ],
)
@pytest.mark.parametrize("how", ["missing", "broken"])
def test_an_artifact_that_is_missing_or_broken_is_said_so_in_its_place(
    project, reports, render_only, path, how
):
    whole = "".join((reports / page.name).read_text() for page in (INDEX, TEMPERATURE))
    if how == "missing":
        Path(path).unlink()
    else:
        Path(path).write_bytes(b"{")
    render_only("index", "temperature")
    text = "".join(page.read_text() for page in (INDEX, TEMPERATURE))
    assert f"<tr><td><code>{path}</code></td>" in text
    assert f"<tr><td><code>{path}</code></td>" not in whole
    assert path not in figures()["read"]
    assert len(re.findall("not measured|failed", text.lower())) > len(
        re.findall("not measured|failed", whole.lower())
    )


def test_with_nothing_at_all_the_pages_are_there_and_every_place_says_not_measured(project):
    for path in [*Path("datasets").rglob("*.parquet"), *Path("datasets").rglob("*.json")]:
        path.unlink()
    main()
    page = Page(INDEX).text
    assert "Undecided (simulation)." in page
    assert figures()["verdict"]["winner"] is None
    assert Page(TEMPERATURE).text.lower().count("not measured") > 10


def test_data_driven_controllers_that_were_refused_are_shown_as_failed_with_their_sentences(project):
    why = "the record does not determine the kernel; record longer"
    change("learn_kernel", refused=why, samples_needed=None)
    compared = artifacts.read_figures("evaluate_temperature")
    compared["refused"] = {"learned_kernel": why, "predictive_control": "too few stretches; record longer"}
    for name in compared["refused"]:
        del compared["contestants"][name]
    compared["pair"] = compared["pair"] | {"b": "varx_riccati"}
    artifacts.write_metrics("evaluate_temperature", compared)
    main()
    for path in (INDEX, TEMPERATURE):
        text = Page(path).text
        assert "No data-driven controller; two model-based ones: subspace + LQG" in text, path
        assert re.search(r"subspace \+ LQG(, 6.2 % lower cost| costs 6.2 % less)", text), path
    assert "earned kernel is refused: the record does not determine the kernel; record longer." in text
    assert "redictive control is refused: too few stretches; record longer." in text
    # learning again from the same record would refuse again: no page advises it
    for path in PAGES:
        assert "dvc repro learn_kernel" not in Page(path).text, path


def test_never_settling_is_said_in_words(project):
    change_all(settling=made.figure(None, 12.0, None))
    main()
    text = TEMPERATURE.read_text()
    assert '<span class="v">never settles</span><span class="b">12\u202fs to never</span>' in text
    assert "Subspace + LQG never settles at the 90 % quantile of all cases" in Page(INDEX).text


def test_hostile_text_from_the_data_is_escaped_and_isolated(project):
    main()
    for path in PAGES:
        page = Page(path)
        assert not any(tag in ("iframe", "object", "embed") for tag, _ in page.tags)
        # one script, ours, and no other may run
        assert re.findall(r"<script[^>]*>(.*?)</script>", path.read_text(encoding="utf-8"), re.DOTALL) == [
            str(environment().globals["script"])
        ]
        assert [tag for tag, _ in page.tags].count("script") == 1
        allowed = base64.b64encode(hashlib.sha256(environment().globals["script"].encode()).digest()).decode()
        assert (
            "default-src 'none'; style-src 'unsafe-inline'; img-src data:; "
            f"script-src 'sha256-{allowed}' 'strict-dynamic';" in path.read_text(encoding="utf-8")
        )
        assert all(
            found["src"].startswith("data:image/jpeg;base64,") for tag, found in page.tags if tag == "img"
        )
        assert not any(name.startswith("on") for _, attributes in page.tags for name in attributes)
    text = TEMPERATURE.read_text(encoding="utf-8")
    assert "&lt;script&gt;" in text
    for found in re.finditer("&lt;script&gt;", text):
        before = text[: found.start()]
        assert before.rfind("<bdi") > before.rfind("</bdi>")


def test_no_address_leaves_the_folder_and_every_link_leads_somewhere(project):
    main()
    pages = {path.name: Page(path) for path in PAGES}
    for name, page in pages.items():
        assert len(page.ids) == len(set(page.ids)), name
        for link in page.links:
            if link.startswith("data:image/jpeg;base64,"):
                continue
            file, _, place = link.partition("#")
            # what stands behind its # is a view: test_viewer holds it against what the viewer has
            if file == "viewer.html":
                assert Path("reports/viewer.html").exists()
                continue
            if file == "machine.js":  # ./run writes it
                continue
            if file and file not in pages:
                assert (Path("reports") / file).exists(), link
                continue
            assert not place or place in pages[file or name].ids, link
        css = " ".join(re.findall(r"<style>(.*?)</style>", (Path("reports") / name).read_text(), re.DOTALL))
        assert not re.search(r"url\(|@import|https?:", css)


def test_every_picture_states_something_and_no_figure_is_nan(project):
    main()
    for path in PAGES:
        for tag, attributes in Page(path).tags:
            if tag == "svg" and attributes.get("role") == "img":
                assert re.search(r"\d|not measured|failed", attributes["aria-label"]), attributes[
                    "aria-label"
                ]
        assert not re.search(r"\bnan\b|\binf\b|None", path.read_text().split("</style>")[1])


def test_a_long_record_is_thinned_and_keeps_its_peak(project):
    machine = made.declared(project)
    columns = made.record(machine, 200_000, "long.mcap")
    columns["zone_1"][123_456] = 999.0
    artifacts.write_table(
        "datasets/ingest/record.parquet", made.tables.record(machine.inputs, machine.outputs), columns
    )
    main()
    size = figures()["bytes"]
    # the limits of the pages: 1 MB and 1.5 MB
    assert size["index"] <= 1_000_000 and size["temperature"] <= 1_500_000
    assert "zone_1: 40.0 to 999" in TEMPERATURE.read_text()


def test_a_hundred_recordings_with_their_findings_stay_within_the_sizes(project):
    machine = made.declared(project)
    columns = made.record(machine, 100_000, "x")
    columns["recording"] = [f"a rather long name of a recording {i // 1000:03d}.mcap" for i in range(100_000)]
    columns["segment"] = np.repeat(np.arange(100), 1000).astype(np.int32)
    artifacts.write_table(
        "datasets/ingest/record.parquet", made.tables.record(machine.inputs, machine.outputs), columns
    )
    rows = 100 * 20
    flaws = {
        "recording": columns["recording"][::50][:rows],
        "signal": ["zone_1"] * rows,
        "kind": ["spike"] * rows,
        "count": [1] * rows,
    }
    flaws |= {
        "start_s": np.arange(rows) * 50.0,
        "end_s": np.arange(rows) * 50.0 + 5,
        "message": ["a spike that stands alone"] * rows,
    }
    artifacts.write_table("datasets/ingest/quality.parquet", made.tables.QUALITY, flaws)
    main()
    size = figures()["bytes"]
    assert size["index"] <= 1_000_000 and max(size.values()) <= 1_500_000


def test_first_run_equal_runs_and_a_moved_figure(project):
    main()
    assert "First run: nothing to compare with." in Page(INDEX).text
    accepted = made.accepted(
        figures=figures()["figures"],
        winner="subspace_lqg",
        metrics={
            path.parent.name: artifacts.read_json(path) for path in Path("datasets").glob("*/figures.json")
        },
        params=made.params.read("params.yaml"),
        hashes={str(p): artifacts.sha256(p) for p in Path("datasets").rglob("*") if p.is_file()}
        | {f: artifacts.sha256(f) for f in ("pipeline", "stages")},
    )
    artifacts.write_json("reports/accepted.json", accepted)
    main()
    page = Page(INDEX).text
    # deposition has no figures here
    assert "No figure moved beyond its noise. Nothing else changed." in page
    assert "accepted run of 2026-11-20" in page and "first run" not in page
    assert "This run beside the accepted one of 2026-11-20" in Page(RUNS).text
    assert "Since 2026-11-20" in Page(TEMPERATURE).text

    change(
        "evaluate_temperature",
        contestants__subspace_lqg__settled_error=made.figure(0.45, 0.41, 0.49),
        contestants__subspace_lqg__settling=made.figure(2.0, 1.0, 3.0),
        contestants__subspace_lqg__overshoot=made.figure(0.6, 0.4, 1.0),
    )
    Path("params.yaml").write_text(
        Path("params.yaml").read_text().replace("  disk_margin: 0.4", "  disk_margin: 0.41", 1)
    )
    Path("pipeline/code.py").write_text("2\n")
    main()
    page = Page(INDEX).text
    moved = "settled error, worst zone +0.35 °C · worse; settling"
    assert re.search(r"2 of \d+ figures moved beyond their noise. Changed: .*one parameter, code", page)
    assert re.search(f"Temperature: 2 of \\d+ figures moved: {re.escape(moved)} ", page)
    page = Page(RUNS).text
    assert "report.disk_margin 0.4 0.41" in page
    assert re.search("Overshoot at most .* within noise", page)
    page = Page(TEMPERATURE).text
    assert "+0.35 °C · worse" in page and "within noise" in page


def test_a_broken_accepted_run_is_said_so(project):
    Path("reports/accepted.json").write_text("{")
    main()
    assert "The accepted run cannot be read." in Page(INDEX).text


def test_an_accepted_run_of_another_version_is_refused_in_one_sentence_with_the_remedy(project):
    run = made.accepted()
    del run["winner"]
    artifacts.write_json("reports/accepted.json", run)
    main()
    sentence = (
        "The accepted run cannot be read. reports/accepted.json was written by another version of beadline; "
        "accept a run of this version with ./run beadline accept."
    )
    assert sentence in Page(INDEX).text and sentence in Page(RUNS).text


def test_a_signal_of_another_schema_is_shown_as_failed_not_read(project):
    artifacts.write_arrays(
        "datasets/evaluate_temperature/cases.parquet", "other", 1, {"table": (np.eye(3), "1", "criterion")}
    )
    main()
    assert (
        "Failed. datasets/evaluate_temperature/cases.parquet holds schema other version 1 but cases "
        "version 1 is expected" in Page(TEMPERATURE).text
    )


def test_a_page_needs_no_simulator_and_starts_fast():
    heavy = (
        "jax",
        "equinox",
        "scipy.stats",
        "pipeline.setpoint.simulation.simulator",
        "pipeline.temperature.plant",
    )
    said = (
        "import sys, pathlib, importlib, pipeline.report.runs.commits\n"
        "for page in pathlib.Path('pipeline/report').glob('*/page.py'):\n"
        "    importlib.import_module('.'.join(page.with_suffix('').parts))\n"
        f"print([name for name in {heavy!r} if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", said],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).resolve().parents[2],
    )
    assert done.stdout.strip() == "[]"
