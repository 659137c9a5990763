"""The viewer: what its files hold, where the other pages lead, and, in headless Chromium, what it draws,
reads, keeps in the address and writes as CSV."""

import base64
import contextlib
import csv
import html
import io
import json
import re
import urllib.parse
from pathlib import Path

import numpy as np
import pytest

from pipeline.report.shared import page as shared_page
from pipeline.report.shared.sources import Declared, SourceFile, collect, linked
from pipeline.report.temperature.judgement import judgement
from pipeline.report.viewer import packed
from pipeline.report.viewer import page as viewer_page
from pipeline.report.viewer.series import Event, Key, SeriesLine, ViewerTable
from pipeline.store import artifacts, params
from pipeline.temperature import tables
from pipeline.temperature.settings import Plant
from pipeline.verdict.settings import ReportRules
from tests.report.conftest import expect, loaded, timers_fired


def manifest(folder):
    text = (folder / "viewer.html").read_text(encoding="utf-8")
    return json.loads(re.search(r'<script type="application/json" id="series">(.*?)</script>', text)[1])


def columns(text):
    """{name: (where each run begins, values)} of a file of columns."""
    found = re.findall(r'beadlineSeries\("([^"]+)",(\d),(\[[\d,]*\]),"([^"]*)"\);', text)
    return {
        name: (json.loads(at), np.frombuffer(base64.b64decode(data), f"<f{size}"))
        for name, size, at, data in found
    }


# ---- the files


SHOWN = ViewerTable(
    "toy",
    "Toy",
    "",
    ("time_s", "time", "s"),
    (Key("who", "Who"), Key("trial", "Trial")),
    (SeriesLine("y", "y", "degC", "y", "Y"), SeriesLine("r", "r", "degC", "y", "Y", beside="y")),
    books=1,
)


def toy(time):
    """Two runs of `who` a in turns with one of b; r is the same in all."""
    n = len(time)
    rng = np.random.default_rng(1)
    order = np.argsort(np.tile(np.arange(n), 3), kind="stable")
    table = {
        "who": np.repeat(np.array(["a", "b", "a"], object), n),
        "trial": np.repeat(np.array([0, 0, 10], np.int32), n),
        "time_s": np.tile(time, 3),
        "y": rng.normal(size=3 * n),
        "r": np.tile(np.linspace(0, 1, n), 3),
    }
    table["y"][5] = np.nan
    return {name: values[order] for name, values in table.items()}


@pytest.mark.parametrize("time", [0.02 * np.arange(50), np.cumsum(np.random.default_rng(2).random(50))])
def test_a_packed_table_has_every_sample_of_every_run_as_float32_and_its_times_to_the_last_bit(time):
    table = toy(time)
    entry, files = packed.packed(SHOWN, table, 10**6)
    found = {name: values for text in files.values() for name, values in columns(text).items()}
    assert entry["keys"][1]["values"] == ["0", "10"] and [len(book["runs"]) for book in entry["books"]] == [
        2,
        1,
    ]
    for book in entry["books"]:
        for place, (codes, n, *grid) in enumerate(book["runs"]):
            key = [each["values"][code] for each, code in zip(entry["keys"], codes, strict=True)]
            mine = (table["who"] == key[0]) & (table["trial"] == int(key[1]))
            for i, name in enumerate(("y", "r")):
                at, values = found[f"{book['name']}.{i}"]
                np.testing.assert_array_equal(values[at[place] :][:n], table[name][mine].astype("f4"))
            if grid:
                x = grid[0] + grid[1] * np.arange(n)
            else:
                at, values = found[f"{book['name']}.x"]
                x = values[at[place] :][:n]
            np.testing.assert_array_equal(x, time)
    # an equal column of two runs is stored once
    assert len(found["toy.0.1"][1]) == len(time) and len(found["toy.0.0"][1]) == 2 * len(time)


def test_a_regular_time_is_one_that_start_and_step_give_to_the_bit():
    assert packed.regular(0.02 * np.arange(9)) == (0.0, 0.02)
    assert packed.regular(np.array([0.0, 1.0, 2.5])) is None
    assert packed.regular(np.array([0.0])) is None
    # the same to nine digits is not the same
    assert packed.regular(0.1 * np.arange(9) + 1e-12 * (np.arange(9) == 4)) is None


def test_what_has_no_room_is_left_out_whole_and_counted():
    table = toy(np.arange(50.0))
    whole = packed.packed(SHOWN, table, 10**6)
    sizes = [len(text) for text in whole.files.values()]
    entry, files = packed.packed(SHOWN, table, sizes[0])
    assert list(files) == list(whole.files)[:1] and sum(map(len, files.values())) <= sizes[0]
    assert entry["runs_left_out"] == 1 and len(entry["books"]) == 1
    shown = SHOWN._replace(events=lambda rows: [Event(float(k), float(k), "x") for k in range(1500)])
    entry, _ = packed.packed(shown, table, 10**6)
    assert sum(len(events) for _, events in entry["events"]) == packed.MOST_EVENTS
    assert entry["events_left_out"] == 3 * 1500 - packed.MOST_EVENTS


def test_what_no_float32_holds_is_infinite_and_a_table_without_rows_has_no_book():
    table = toy(np.arange(3.0))
    table["y"][0] = 1e300
    _, files = packed.packed(SHOWN, table, 10**6)
    assert np.isinf(columns(files["toy.0.js"])["toy.0.0"][1][0])
    empty = {name: values[:0] for name, values in table.items()}
    entry, files = packed.packed(SHOWN, empty, 10**6)
    assert entry["books"] == [] and files == {} and entry["rows"] == 0


def test_a_small_table_is_copied_beside_the_page_and_a_large_one_linked(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = Path("datasets/ingest/record.parquet")
    path.parent.mkdir(parents=True)
    path.write_bytes(b"x" * 1000)
    read = {path.as_posix(): SourceFile("record", path.as_posix(), "ingest", "0")}
    [source] = linked(read).values()
    assert source.link == "data/ingest.record.parquet" and packed.size_of(source) == "1 kB"
    for bound in ("LARGEST_COPY", "LARGEST_COPIES"):
        with monkeypatch.context() as tight:
            tight.setattr(f"pipeline.report.shared.sources.{bound}", 999)
            [source] = linked(read).values()
            assert source.link == "../datasets/ingest/record.parquet"


def test_the_folder_holds_what_this_run_wrote_and_nothing_older(project):
    from tests.report.made import main

    main()
    first = {file.name: file.read_bytes() for file in Path("reports/data").iterdir()}
    Path("reports/data/old.0.js").write_text("old")
    main()
    assert {file.name: file.read_bytes() for file in Path("reports/data").iterdir()} == first
    assert {"uPlot.js", "record.0.js", "trajectories.0.js"} <= set(first)
    assert first["uPlot.js"].startswith(b"/*!\nThe MIT License")
    assert sum(map(len, first.values())) <= packed.LARGEST


def test_a_stage_that_fails_leaves_the_old_folder(project):
    artifacts.write_folder("reports/data", {"a.js": "1", "b.js": b"2"})
    with pytest.raises(SystemExit), artifacts.stage("report"):
        artifacts.write_folder("reports/data", {"a.js": "3"})
        raise ValueError("bad input")
    assert {file.name: file.read_text() for file in Path("reports/data").iterdir()} == {
        "a.js": "1",
        "b.js": "2",
    }
    artifacts.write_folder("reports/data", {"a.js": "3"})
    assert [file.name for file in Path("reports/data").iterdir()] == ["a.js"]


def test_without_its_artifacts_the_page_says_what_is_missing(project):
    from tests.report.made import main

    for name in ("evaluate_temperature/trajectories", "train_ilc/lessons"):
        Path(f"datasets/{name}.parquet").unlink()
    main()
    text = Path("reports/viewer.html").read_text(encoding="utf-8").split('<details class="prov">')[0]
    names = [table["name"] for table in manifest(Path("reports"))["tables"]]
    assert "trajectories" not in names and "lessons" not in names and "record" in names
    assert text.count("trajectories.parquet of evaluate_temperature is not there") == 2


# ---- links of the other pages


def test_a_series_that_has_no_room_is_listed_and_the_others_are_shown(project, monkeypatch):
    from tests.report.made import main

    monkeypatch.setattr(packed, "LARGEST", 60_000)
    monkeypatch.setattr("pipeline.report.shared.sources.LARGEST_COPIES", 1000)
    main()
    tables = [table["name"] for table in manifest(Path("reports"))["tables"]]
    text = Path("reports/viewer.html").read_text(encoding="utf-8")
    assert 0 < len(tables) < len(shared_page.IN_VIEWER)
    assert "runs have no room here: see the Parquet file." in text
    viewers = [file for file in Path("reports/data").iterdir() if file.name != "curves.json"]
    assert sum(file.stat().st_size for file in viewers) <= 60_000


def test_every_link_into_the_viewer_names_a_series_a_value_and_a_line_that_it_has(reports):
    tables = {table["name"]: table for table in manifest(reports)["tables"]}
    linked = set()
    for name in ("index", "temperature", "identification", "deposition", "setpoint"):
        text = (reports / f"{name}.html").read_text(encoding="utf-8")
        for state in re.findall(r'href="viewer\.html#([^"]*)"', text):
            asked = urllib.parse.parse_qs(html.unescape(state))
            table = tables[asked.pop("t")[0]]
            linked.add(table["name"])
            assert set(asked.pop("y", [])) <= {line["name"] for line in table["lines"]}
            assert asked.pop("p", ["unit"]) == ["unit"]
            for key in table["keys"]:
                assert set(asked.pop(key["name"], [])) <= set(key["values"])
            assert not asked
    assert linked == set(shared_page.IN_VIEWER) == set(tables)


def test_every_link_of_the_viewer_leads_to_a_file_or_a_place_of_its_own(reports):
    text = (reports / "viewer.html").read_text(encoding="utf-8").split('<details class="prov">')[0]
    links = re.findall(r'<a [^>]*href="([^"]*)"', text)
    beside = [link for link in links if link.startswith("data/")]
    assert len(set(beside)) == len(shared_page.IN_VIEWER)
    for link in links:
        file, _, place = link.partition("#")
        assert (reports / (file or "viewer.html")).exists(), link
        assert not place or f'id="{place}"' in text, link
    assert not re.search(r"url\(|@import|https?:", " ".join(re.findall(r"<style>(.*?)</style>", text, re.S)))


# ---- in the browser


@pytest.fixture
def view(browser, reports):
    """view(state, ...): the viewer at an address, ready."""
    pages = []

    def opened(state="", folder=reports, **how):
        page = loaded(browser, folder, "viewer", **how)
        pages.append(page)
        if state:
            page.goto("about:blank")
            page.goto(f"file://{folder}/viewer.html#{state}")
        if how.get("script", True):
            page.wait_for_selector("#viewer[data-ready]")
        return page

    yield opened
    for page in pages:
        page.context.close()


def saved(page):
    """The CSV that the button gives: names, and rows of numbers."""
    with page.expect_download() as waited:
        page.get_by_role("button", name="CSV").click()
    rows = list(csv.reader(io.StringIO(Path(waited.value.path()).read_text(encoding="utf-8"))))
    return rows[0], np.array([[float(cell or "nan") for cell in row] for row in rows[1:]])


def test_no_two_lines_of_a_picture_differ_by_their_colour_alone(view):
    page = view()
    dashes = page.evaluate("""[...document.querySelectorAll("path[d='M0 5H26']")].map(path =>
        path.getAttribute("stroke-dasharray"))""")
    assert len(dashes) >= 3 and len(set(dashes)) == len(dashes)


def test_the_csv_is_the_artifact_over_the_time_that_is_seen(view, reports):
    machine = params.load(Plant, "plant", reports.parent / "params.yaml")
    path = reports.parent / "datasets/evaluate_temperature/trajectories.parquet"
    table = artifacts.read_table(path, tables.trajectories(machine.inputs, machine.outputs))
    page = view(
        "t=trajectories&case_name=typical&contestant=pi&contestant=learned_kernel&y=zone_1&y=heater_2_applied"
        "&x=3.5,40"
    )
    names, rows = saved(page)
    assert names == [
        "time_s",
        "zone_1 [degC] typical | pi",
        "zone_1 [degC] typical | learned_kernel",
        "zone_1_reference [degC] typical | pi",
        "heater_2_applied [percent] typical | pi",
        "heater_2_applied [percent] typical | learned_kernel",
    ]
    for i, name in enumerate(names[1:], 1):
        mine = (table["contestant"] == name.split(" | ")[1]) & (table["case_name"] == "typical")
        mine &= (table["time_s"] >= 3.5) & (table["time_s"] <= 40)
        np.testing.assert_array_equal(rows[:, 0], table["time_s"][mine])
        np.testing.assert_array_equal(rows[:, i].astype("f4"), table[name.split(" ")[0]][mine].astype("f4"))


def test_the_address_restores_what_was_shown(view):
    page = view("t=record&y=zone_1&y=heater_1")
    page.get_by_label("zone 2", exact=True).check()
    expect(page.locator("#viewer")).to_have_attribute("data-ready", "3")
    page.locator(".plots").focus()
    for key in ("+", "+", "Shift+ArrowRight", "ArrowRight", "ArrowRight"):
        page.keyboard.press(key)
    timers_fired(page)
    told, state = page.locator(".at").inner_text(), page.evaluate("location.hash")
    assert "x=" in state and "c=" in state and "y=zone_2" in state
    again = view(state[1:])
    timers_fired(again)
    assert again.locator(".at").inner_text() == told and again.evaluate("location.hash") == state
    for what in (".drawn h2", ".drawn li"):
        assert again.locator(what).all_inner_texts() == page.locator(what).all_inner_texts()
    pixels = "[...document.querySelectorAll('canvas')].map(canvas => canvas.toDataURL())"
    assert again.evaluate(pixels) == page.evaluate(pixels)


def test_the_cursor_reads_the_values_of_the_artifact_in_all_pictures(view):
    page = view("t=trajectories&case_name=typical&contestant=pi&y=zone_1&y=zone_2&x=0,59")
    box = page.locator(".u-over").first.bounding_box()
    page.mouse.move(box["x"] + box["width"] * 10 / 59, box["y"] + 40)
    # of the small project: 80 / 2^t - 0.05 below 101 and 102 °C, at 10 s
    assert page.locator(".at b").inner_text() == "10\u202fs"
    values = page.locator(".drawn li b").all_inner_texts()
    assert values == ["100.972\u202f°C", "101\u202f°C", "101.972\u202f°C", "102\u202f°C"]


def test_dragging_zooms_every_picture_and_a_double_click_shows_all(view):
    page = view("t=record&y=zone_1&y=heater_1")
    box = page.locator(".u-over").first.bounding_box()
    page.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 40)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 60, steps=4)
    page.mouse.up()
    timers_fired(page)
    low, high = (float(v) for v in re.search(r"x=([\d.]+),([\d.]+)", page.evaluate("location.hash")).groups())
    # a quarter to a half of 399 s, to two pixels
    assert abs(low - 99.75) < 2 and abs(high - 199.5) < 2
    page.mouse.dblclick(box["x"] + 100, box["y"] + 40)
    timers_fired(page)
    assert "x=" not in page.evaluate("location.hash")


def test_a_difference_is_the_one_less_the_other_and_asks_for_one_unit(view):
    a, b = "true_mm3_per_s|A|0|model_inverse|1", "true_mm3_per_s|A|0|hoelzle_2009|1"
    state = "t=lessons&material=A&routine=0&law=hoelzle_2009&law=model_inverse&trial=1&y=true_mm3_per_s"
    page = view(f"{state}&diff={a}&diff={b}")
    names, rows = saved(page)
    place = {name: i for i, name in enumerate(names)}
    one, other = (
        rows[:, place[f"true_mm3_per_s [mm^3/s] A | 0 | {law} | 1"]]
        for law in ("model_inverse", "hoelzle_2009")
    )
    # of float32 values, in float32
    np.testing.assert_array_equal(rows[:, -1].astype("f4"), one.astype("f4") - other.astype("f4"))
    assert names[-1].startswith("difference ") and np.ptp(rows[:, -1]) > 0.5
    other = view(f"{state}&y=command_mm&diff={a}&diff=command_mm|A|0|hoelzle_2009|1")
    assert "A difference needs one unit" in other.locator(".told").inner_text()


def test_what_an_address_asks_for_in_vain_is_said(view):
    page = view("t=trajectories&contestant=nobody&y=nothing")
    told = page.locator(".told").inner_text()
    assert '"nobody" is not among Contestant.' in told and '"nothing" is not among the lines.' in told
    assert page.locator(".drawn").count() == 1


def test_a_folder_without_its_data_says_so(view, reports, tmp_path):
    (tmp_path / "viewer.html").write_bytes((reports / "viewer.html").read_bytes())
    (tmp_path / "machine.js").write_bytes((reports / "machine.js").read_bytes())
    (tmp_path / "data").mkdir()
    (tmp_path / "data/uPlot.js").write_bytes((reports / "data/uPlot.js").read_bytes())
    page = view("t=record", folder=tmp_path)
    assert (
        "data/record.0.js cannot be read. It belongs beside this page" in page.locator(".told").inner_text()
    )


@pytest.mark.parametrize("width", [390, 1280, 1440])
@pytest.mark.parametrize("theme", ["light", "dark"])
def test_nothing_overflows_nothing_is_fetched_and_axe_finds_nothing(view, reports, width, theme):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright")
    page = view("t=trajectories&y=zone_1&y=heater_1_applied", width=width, height=900, theme=theme)
    page.locator(".events summary").click()
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    wide = """width => [...document.querySelectorAll("body *")].filter(e =>
        !e.closest("svg, .scroll, .vh, dialog, .tip") &&
        e.getBoundingClientRect().right > width + 1).map(e => e.outerHTML.slice(0, 120))"""
    assert page.evaluate(wide, width) == [] and page.console == []
    assert all(url.startswith((f"file://{reports}/", "about:")) for url in page.asked)
    assert min(page.evaluate(SMALLEST)) >= 11
    violations = axe.Axe().run(page, options={"resultTypes": ["violations"]}).response["violations"]
    assert [(found["id"], found["nodes"][0]["html"][:200]) for found in violations] == []


def test_letters_of_the_pictures_have_eleven_px_on_a_phone(view):
    page = view("t=lessons", width=390)
    page.add_init_script(DRAWN)
    page.goto(page.url.split("#")[0] + "#t=signals")
    page.reload()
    page.wait_for_selector("#viewer[data-ready]")
    page.wait_for_function("window.letters.length > 10")
    sizes = page.evaluate("window.letters")
    # axes 12, numbers of lines 12, events 11 px of the screen
    assert len(sizes) > 10 and min(sizes) >= 11


DRAWN = """window.letters = [];
const draw = CanvasRenderingContext2D.prototype.fillText;
CanvasRenderingContext2D.prototype.fillText = function (...given) {
    window.letters.push(parseFloat(this.font.match(/([\\d.]+)px/)[1]) / devicePixelRatio);
    return draw.apply(this, given);
};"""
SMALLEST = """() => [...document.querySelectorAll("main *")].filter(e => e.getClientRects().length &&
    [...e.childNodes].some(n => n.nodeType === 3 && n.textContent.trim()))
    .map(e => parseFloat(getComputedStyle(e).fontSize))"""


def test_without_a_script_the_picture_of_the_deciding_case_stands(view):
    page = view(script=False, width=390)
    svg = page.locator(".still svg[role=img]")
    expect(svg).to_be_visible()
    assert "The deciding case" in svg.get_attribute("aria-label")
    # letters of the picture are 12 of its 360 units
    assert 12 * svg.bounding_box()["width"] / 360 >= 11
    expect(page.locator("#viewer")).not_to_be_visible()
    expect(page.locator("#tables ~ .scroll a").first).to_be_visible()


def test_paper_is_light_and_has_the_pictures(view):
    page = view("t=trajectories", theme="dark", width=1280)
    pdf = page.pdf(prefer_css_page_size=True)
    assert pdf.startswith(b"%PDF")
    # and back to the screen's colours
    assert page.evaluate("document.documentElement.dataset.theme") is None
    page.emulate_media(media="print")
    expect(page.locator(".choose")).not_to_be_visible()
    expect(page.locator(".drawn canvas")).to_be_visible()


def test_the_keys_reach_and_move_everything(view):
    page = view("t=trajectories&case_name=typical&contestant=pi&y=zone_1")
    reached = set()
    for _ in range(60):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("document.activeElement.className || document.activeElement.tagName"))
    assert {"plots", "SELECT", "INPUT", "BUTTON", "SUMMARY"} <= reached
    page.locator(".plots").focus()
    page.keyboard.press("ArrowRight")
    first = page.locator(".at b").inner_text()
    page.keyboard.press("ArrowRight")
    assert page.locator(".at b").inner_text() != first
    assert "zone" in page.locator("[aria-live]").inner_text()


def test_hostile_text_is_text(view):
    page = view("t=record&recording=%3Cimg%20src%3Dx%20onerror%3Dalert(1)%3E")
    assert "<img" in page.locator(".told").inner_text() and page.console == []


# ---- a million points


@pytest.fixture(scope="module")
def million(tmp_path_factory):
    """The pages of a record of 250,000 samples of four signals."""
    from stages import report
    from tests.report import conftest, made

    folder = tmp_path_factory.mktemp("million")
    with contextlib.chdir(folder):
        for name in ("pipeline", "stages"):
            (folder / name).mkdir()
            (folder / name / "code.py").write_text("1\n")
        made.write(folder, samples=250_000)
        declared = Declared(
            params.load(ReportRules, "report"), params.load(Plant, "plant"), params.read("params.yaml")
        )
        sources = collect(declared, report.FIGURES, report.FOLDERS, "accepted.json", ("pipeline",))
        made_page = viewer_page.render(sources, judgement(sources))
        artifacts.write_text("reports/viewer.html", made_page.text)
        artifacts.write_folder("reports/data", made_page.files)
        Path("reports/machine.js").write_text(conftest.MACHINE)
    return folder / "reports"


STROKES = """window.strokes = 0;
for (const drawn of [Path2D, CanvasRenderingContext2D])
    for (const name of ["lineTo", "moveTo", "rect", "arc", "fillRect"].filter(n => drawn.prototype[n])) {
        const draw = drawn.prototype[name];
        drawn.prototype[name] = function (...given) { window.strokes += 1; return draw.apply(this, given); };
    }"""
DRAWN_TWICE = "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"


def test_a_million_points_are_drawn_by_the_columns_of_the_screen_opened_and_zoomed(view, million):
    """What a picture costs is the strokes of its columns of pixels, however many samples lie behind them."""
    page = view(folder=million)
    page.add_init_script(STROKES)
    page.goto("about:blank")
    page.goto(f"file://{million}/viewer.html#t=record&y=zone_1&y=zone_2&y=heater_1&y=heater_2")
    page.wait_for_selector("#viewer[data-ready='4']")
    page.evaluate(DRAWN_TWICE)
    opened = page.evaluate("strokes")
    page.locator(".tools button", has_text="+").click()
    page.evaluate(DRAWN_TWICE)
    zoomed = page.evaluate("strokes") - opened
    # 4 lines of at most 1,280 columns: in, lowest, highest and out of each; twice that for axes and redraws
    assert 4 * 100 < opened < 8 * 4 * 1280 and 4 * 100 < zoomed < 8 * 4 * 1280


def test_no_peak_of_a_million_points_is_lost(view, million):
    """One sample far above the others is one column of pixels."""
    page = view("t=record&y=zone_1", folder=million)
    top = """() => { const c = document.querySelector('canvas'), g = c.getContext('2d');
        const d = g.getImageData(0, 0, c.width, c.height).data, ink = [];
        for (let x = 0; x < c.width; x++) { let n = 0; for (let y = 0; y < c.height; y++) {
            const i = 4 * (y * c.width + x); if (d[i + 3] > 128 && d[i] < 60) n++; } ink.push(n); }
        return ink; }"""
    ink = np.array(page.evaluate(top))
    inner = ink[60:-40]
    # a sinusoid of 40 s in 250,000: every column of pixels holds whole periods, from crest to trough
    assert inner.min() > 0.8 * inner.max() and inner.max() > 200


# ---- what is chosen, and what happened


def test_choosing_series_values_lines_and_a_difference_redraws_and_is_kept_in_the_address(view):
    page = view()
    page.get_by_label("Series").select_option("lessons")
    page.wait_for_selector("h2:has-text('true flow')")
    page.get_by_role("checkbox", name="trial 0").uncheck()
    expect(page.locator(".told")).to_contain_text("No run has all of what is chosen", use_inner_text=True)
    page.get_by_role("checkbox", name="trial 1").check()
    page.get_by_role("checkbox", name="trial 2").check()
    page.get_by_role("checkbox", name="measured flow").uncheck()
    page.get_by_label("Difference: of").select_option(label="1 true flow, The paper’s law, trial 1")
    page.wait_for_selector("h2:has-text('Difference')")
    expect(page.locator(".drawn")).to_have_count(2)
    page.get_by_label("Pictures", exact=True).select_option("unit")
    timers_fired(page)
    kept = urllib.parse.parse_qs(page.evaluate("location.hash")[1:])
    assert kept["trial"] == ["1", "2"] and kept["y"] == ["true_mm3_per_s"] and kept["p"] == ["unit"]
    assert [line.rsplit("|", 1)[1] for line in kept["diff"]] == ["1", "2"]
    assert page.console == []


def test_events_stand_beside_the_cursor_and_lead_to_their_time(view):
    page = view("t=record&y=zone_1&x=200,300")
    page.locator(".events summary").click()
    # of the small project: samples 100 to 109 of the first output are masked
    page.locator(".events li", has_text="zone 1 masked").get_by_role("button").click()
    expect(page.locator(".at")).to_contain_text(re.compile(r"^100\s*s"), use_inner_text=True)
    assert "zone 1 masked" in page.locator(".at").inner_text()
    timers_fired(page)
    low, high = map(float, re.search(r"x=([\d.]+),([\d.]+)", page.evaluate("location.hash")).groups())
    assert low <= 100 <= high and high - low == pytest.approx(100)
    page.locator(".plots").focus()
    for _ in range(12):
        page.keyboard.press("ArrowRight")
    expect(page.locator(".at")).to_contain_text(re.compile(r"^112\s*s"), use_inner_text=True)
    assert "masked" not in page.locator(".at").inner_text()


def test_a_line_breaks_where_nothing_was_measured(view):
    """Of the hold-out samples 5 to 8 of zone_2 are missing: their column of pixels has no ink."""
    page = view("t=holdout&segment=0&y=zone_2_measured&x=4,9")
    ink = page.evaluate("""() => { const u = document.querySelector('.u-over').getBoundingClientRect();
        const c = document.querySelector('canvas'), box = c.getBoundingClientRect(), s = devicePixelRatio;
        const d = c.getContext('2d').getImageData((u.left - box.left + u.width * 0.45) * s,
            (u.top - box.top) * s, u.width * 0.1 * s, u.height * s).data;
        let n = 0; for (let i = 0; i < d.length; i += 4) if (d[i + 3] > 128 && d[i] < 60) n++; return n; }""")
    assert ink == 0
    page.locator(".plots").focus()
    page.keyboard.press("ArrowRight")
    assert page.locator(".drawn li b").inner_text() == "missing"
