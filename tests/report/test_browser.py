"""The pages in headless Chromium: what fits, what overflows, what is asked of the network, what the console
says, what sorts, enlarges and explains itself, what prints; skipped where there is no browser."""

import re

import pytest

from tests.report.conftest import MACHINE, expect

PAGES = ("index", "temperature", "identification", "deposition", "setpoint", "certificate")
BESIDE = ("runs", "words")
# name, width and theme of the pages that are loaded once for all tests that look at them
WIDE = [(name, 1280, "light") for name in (*PAGES, *BESIDE)]
DARK = [(name, 1024, "dark") for name in PAGES]
NARROW = [(name, 390, "light") for name in (*PAGES, *BESIDE)]
# A4 landscape less its margins, in px
SHEET = (1016, 703)


@pytest.mark.parametrize("shown", [*WIDE, *DARK, *NARROW], indirect=True, ids=str)
def test_nothing_overflows_nothing_is_fetched_but_the_machine_and_the_console_is_silent(shown, request):
    page, (name, width, theme) = shown, request.node.callspec.params["shown"]
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    wide = """width => [...document.querySelectorAll("body *")].filter(e =>
        !e.closest("svg, .scroll, .vh, dialog, .tip") &&
        e.getBoundingClientRect().right > width + 1).map(e => e.outerHTML.slice(0, 120))"""
    assert page.evaluate(wide, width) == []
    # the page itself and the pictures inside it; beside it what it was made on
    beside = page.url.replace(f"{name}.html", "machine.js")
    assert [url for url in page.asked if not url.startswith("data:")] == [
        page.url,
        beside,
    ] and page.console == []
    commit = "commit abc12345 with uncommitted changes"
    if name == "index":
        ran = f"beadline 0.1.0, {commit}, Some CPU @ 3.00GHz, pins avx2, 22 Nov 2026."
        assert page.locator("[data-run]").inner_text() == ran
    else:
        ran = f"Last run on Some CPU @ 3.00GHz, pins avx2, beadline 0.1.0, {commit}, 22 Nov 2026"
        assert page.locator("body > footer").inner_text() == ran
    paper = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert paper == {"light": "rgb(255, 255, 255)", "dark": "rgb(18, 21, 25)"}[theme]
    # no row of the answers is lost at any width
    assert all(box["height"] > 0 for box in map(box_of, page.locator(".answers tbody tr").all()))


def box_of(locator):
    return locator.bounding_box()


@pytest.mark.parametrize("shown", NARROW, indirect=True, ids=str)
def test_no_letter_of_a_chart_is_smaller_than_11_px_on_a_phone(shown):
    sizes = """() => [...document.querySelectorAll("main svg text")]
        .filter(text => text.getBoundingClientRect().width > 0)
        .map(text => {
            const turned = text.getScreenCTM();
            const scale = Math.hypot(turned.b, turned.d);
            return [parseFloat(getComputedStyle(text).fontSize) * scale, text.textContent];
        })"""
    found = shown.evaluate(sizes)
    assert [text for size, text in found if size < 10.99] == []


@pytest.mark.parametrize("shown", NARROW, indirect=True, ids=str)
def test_no_picture_scrolls_sideways_on_a_phone_but_in_the_second_level_of_detail(shown):
    wide = shown.evaluate(
        """() => [...document.querySelectorAll("main figure")]
        .filter(figure => !figure.closest("details") && figure.scrollWidth > figure.clientWidth + 1).length"""
    )
    assert wide == 0
    assert shown.evaluate("document.documentElement.scrollWidth") <= 390


@pytest.mark.parametrize(
    ("shown", "unscripted"), list(zip(WIDE, PAGES, strict=False)), indirect=True, ids=PAGES
)
def test_a_page_says_the_same_without_a_script(shown, unscripted):
    # a script adds the arrows of style sheets, which are no text, and the date of the run in its own column
    column = shown.locator("[data-run-column]")
    column.evaluate_all("cells => cells.forEach(cell => { cell.hidden = true; })")
    folded = shown.locator("details.more")
    folded.evaluate_all("all => all.forEach(one => { one.open = false; })")
    said = shown.locator("main").inner_text()
    folded.evaluate_all("all => all.forEach(one => { one.open = true; })")
    column.evaluate_all("cells => cells.forEach(cell => { cell.hidden = false; })")
    for run in shown.locator("[data-run]").all_inner_texts():
        said = said.replace(run, unscripted.locator("[data-run]").inner_text())
    assert said == unscripted.locator("main").inner_text()


def test_a_table_sorts_by_number_both_ways_and_back_and_what_has_no_value_stands_last(open_page):
    page = open_page("identification")
    place = page.locator("section", has=page.locator("#order")).last
    head = place.locator("th", has_text="Error on what was left out")
    cells = place.locator("tbody tr > :nth-child(4)")
    before = cells.all_inner_texts()
    # 50 %, 10 % and an order that was not tried
    assert [text.split("\u202f")[0] for text in before] == ["50.00", "10.00", "within noise"]
    head.locator("button").click()
    expect(head).to_have_attribute("aria-sort", "ascending")
    assert [text[:2] for text in cells.all_inner_texts()] == ["10", "50", "wi"]
    head.locator("button").press("Enter")
    expect(head).to_have_attribute("aria-sort", "descending")
    assert [text[:2] for text in cells.all_inner_texts()] == ["50", "10", "wi"]
    head.locator("button").press("Enter")
    expect(head).not_to_have_attribute("aria-sort", re.compile(""))
    assert cells.all_inner_texts() == before


def test_a_table_sorts_by_text_in_the_list_of_files_at_the_foot_of_a_page(open_page):
    page = open_page("words")
    page.locator(".prov summary").click()
    paths = page.locator(".prov tbody td:first-child")
    page.locator(".prov th button", has_text="File").click()
    expect(page.locator(".prov th", has_text="File")).to_have_attribute("aria-sort", "ascending")
    assert paths.all_inner_texts() == sorted(paths.all_inner_texts(), key=str.lower)


def pointed(page, section, picture, share):
    """The tip with the pointer over a picture at a share of its width."""
    svg = page.locator(f"section:has(> #{section}) svg.plot").nth(picture)
    svg.scroll_into_view_if_needed()
    box = box_of(svg)
    page.mouse.move(box["x"] + share * box["width"], box["y"] + box["height"] / 2)
    expect(page.locator(".tip")).to_be_visible()
    return page.locator(".tip").inner_text().replace(",", "")


def test_the_pointer_tells_time_and_value_as_they_are_in_the_artifact(open_page):
    page = open_page("temperature")
    seconds, *degrees = pointed(page, "worst-zone", 0, 0.2).split("\n")
    time = float(seconds.split("\u202f")[0])
    # the trajectories of the small project: 80 / 2^t - 0.05 below 102 °C, and the limit of 0.5 °C; a picture
    # is drawn to a tenth of a pixel, of which 174 are four decades, and to a second across
    low, high = (80 * 0.5**t - 0.05 for t in (int(time) + 1, int(time)))
    assert 1 < time < 20 and degrees
    for text in degrees:
        value = float(text.split("\u202f")[0])
        assert 0.97 * low <= value <= 1.03 * high or value == pytest.approx(0.5, rel=0.03), (time, value)
    assert seconds.endswith("s") and degrees[0].endswith("°C")


@pytest.mark.parametrize(
    ("name", "figure", "picture"),
    [("temperature", ".col figure", "svg.plot"), ("deposition", ".frames figure", "img")],
)
def test_a_picture_enlarges_zooms_and_closes(open_page, name, figure, picture):
    page = open_page(name)
    small = page.locator(figure).first
    small.locator("button.zoom").focus()
    page.keyboard.press("Enter")
    dialog, enlarged = page.locator("dialog"), page.locator("dialog .stage svg")
    expect(dialog).to_be_visible()
    assert box_of(enlarged)["width"] > 1.5 * box_of(small)["width"]
    assert enlarged.get_attribute("aria-label") == (
        small.locator(picture).get_attribute("aria-label") or small.locator(picture).get_attribute("alt")
    )
    # x, y, width and height of what is seen of it
    whole = enlarged.get_attribute("data-view")
    box = box_of(enlarged)
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.wheel(0, -200)
    page.wait_for_function(
        "whole => document.querySelector('dialog .stage > svg').dataset.view !== whole", arg=whole
    )
    assert float(enlarged.get_attribute("data-view").split()[2]) < float(whole.split()[2])
    page.keyboard.press("0")
    page.wait_for_function(
        """whole => document.querySelector('dialog .stage > svg').dataset.view.split(" ").map(Number).join()
            === whole.split(" ").map(Number).join()""",
        arg=whole,
    )
    page.keyboard.press("Escape")
    expect(dialog).not_to_be_visible()
    assert page.console == []


def test_the_keys_read_values_off_an_enlarged_picture(open_page):
    page = open_page("temperature")
    page.locator("section:has(> #worst-zone) button.zoom").first.click()
    page.keyboard.press("ArrowLeft")
    expect(page.locator(".tip")).to_be_visible()
    assert re.fullmatch(r"[\d.]+\u202fs(\n[\d.]+\u202f°C)+", page.locator(".tip").inner_text())


def test_a_word_explains_itself_to_pointer_and_keys_and_stands_in_the_list(open_page):
    page = open_page("temperature")
    word, tip = page.locator("#answer-disk a.term"), page.locator(".tip")
    word.hover()
    expect(tip).to_contain_text("before the loop oscillates", use_inner_text=True)
    page.keyboard.press("Escape")
    expect(tip).not_to_be_visible()
    page.mouse.move(5, 5)
    page.locator("#answer-overshoot a.term").focus()
    expect(tip).to_contain_text("past its reference", use_inner_text=True)
    word.click()
    expect(page).to_have_url(re.compile(r"words\.html#"))
    assert page.locator(":target dd").inner_text().endswith("from 2/3 to 3/2.")


@pytest.mark.parametrize("name", PAGES)
def test_a_page_prints_on_a4_landscape_and_no_figure_is_cut(open_page, name):
    page = open_page(name, width=SHEET[0], theme="dark")
    pdf = page.pdf(prefer_css_page_size=True)
    boxes = re.findall(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", pdf)
    # 297 x 210 mm in points
    assert boxes and all(abs(float(w) - 842) < 2 and abs(float(h) - 595) < 2 for w, h in boxes)
    page.emulate_media(media="print")
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    cut = """([width, height]) => [...document.querySelectorAll("svg[role=img], img")].filter(e => {
        const box = e.getBoundingClientRect(), kept = e.closest("figure, .card, tr, .mv");
        return box.right > width + 1 || !kept ||
            getComputedStyle(kept).breakInside !== "avoid" || kept.getBoundingClientRect().height > height;
    }).map(e => e.outerHTML.slice(0, 120))"""
    assert page.evaluate(cut, list(SHEET)) == []
    # page one is one sheet
    if name == "index":
        assert len(boxes) == 1
    assert not page.locator(".zoom:visible, .way:visible").count()


@pytest.mark.parametrize(
    "shown",
    [*WIDE, *DARK, *(pytest.param(view, marks=pytest.mark.slow) for view in NARROW)],
    indirect=True,
    ids=str,
)
def test_axe_finds_nothing_serious(shown, request):
    axe = pytest.importorskip(
        "axe_playwright_python.sync_playwright", reason="axe is not installed; uv sync installs it"
    )
    # a theme changes colours and nothing else
    dark = request.node.callspec.params["shown"] in DARK
    options = {"resultTypes": ["violations"]} | ({"runOnly": ["color-contrast"]} if dark else {})
    violations = axe.Axe().run(shown, options=options).response["violations"]
    serious = [
        (violation["id"], node["html"][:160], node["failureSummary"])
        for violation in violations
        if violation["impact"] in ("serious", "critical")
        for node in violation["nodes"]
    ]
    assert serious == []


@pytest.mark.parametrize("shown", WIDE, indirect=True, ids=str)
def test_every_picture_stands_where_a_link_leads_to_its_data(shown):
    page = shown
    lost = """() => [...document.querySelectorAll("main svg[role=img], main img")].filter(e => {
        const around = e.closest("article, section, .answers, main");
        return !around?.querySelector("a.from, a.in-viewer");
    }).map(e => e.closest("section, .answers")?.id + " " + e.outerHTML.slice(0, 160))"""
    assert page.evaluate(lost) == []
    # a table of figures too; what params.yaml declares has no
    # artifact, and a loop that is not measured no figure
    unsaid = """() => [
        ...document.querySelectorAll("main table.tab, main table.three, main .answers table")].filter(e =>
        !(e.closest("article, section, .answers").querySelector("a.from, a.in-viewer")) &&
        e.closest("section").getAttribute("aria-labelledby") !== "declared"
        && !e.querySelector(".hole")).map(e => e.outerHTML.slice(0, 160))"""
    assert page.evaluate(unsaid) == []


def test_text_from_the_data_runs_nothing_even_where_it_were_not_escaped(open_page, reports, tmp_path):
    text = (reports / "index.html").read_text(encoding="utf-8")
    hostile = (
        '<script>window.hit = 1</script><script src="evil.js"></script><img '
        'src="http://evil.example/x" onerror="window.hit = 2"><a href="javascript:window.hit=3">x</a>'
    )
    (tmp_path / "bad.html").write_text(text.replace("<main>", f"<main>{hostile}"), encoding="utf-8")
    (tmp_path / "machine.js").write_text(MACHINE)
    (tmp_path / "evil.js").write_text("window.hit = 4")
    page = open_page("bad", folder=tmp_path)
    assert page.evaluate("window.hit") is None
    # the browser refuses before it asks
    assert not any(url.startswith("http") and "evil" in url for url in page.asked) or all(
        "Content Security Policy" in message for message in page.console
    )
    page.locator("a", has_text="x").first.click()
    assert page.evaluate("window.hit") is None


@pytest.mark.parametrize(
    ("name", "closed"), [("deposition", ("frames", "lines")), ("setpoint", ("vision", "why"))]
)
def test_a_second_level_of_detail_is_closed_opens_at_its_heading_and_prints(open_page, name, closed):
    page = open_page(name, folded=True)
    inside = {
        heading: page.locator(f"details:has(> summary > #{heading}) > :not(summary)") for heading in closed
    }
    for found in inside.values():
        expect(found.first).not_to_be_visible()
    short = page.evaluate("document.documentElement.scrollHeight")
    page.locator(f"#{closed[1]}").click()
    expect(inside[closed[1]].first).to_be_visible()
    expect(inside[closed[0]].first).not_to_be_visible()
    # the page's own list of places leads into it
    page.locator(f".toc a[href='#{closed[0]}']").click()
    expect(inside[closed[0]].first).to_be_visible()
    # a fifth of the page at least, or a reader gains nothing
    assert page.evaluate("document.documentElement.scrollHeight") > 1.2 * short
    page.evaluate("document.querySelectorAll('details').forEach(one => { one.open = false; })")
    page.emulate_media(media="print")
    assert all(found.first.bounding_box()["height"] > 0 for found in inside.values())


def test_a_figure_beyond_its_limit_has_a_cross_and_never_a_colour_alone(reports, page_in_grey):
    """Of every figure that is vermillion: the cross before it, or a glyph or words in its own cell."""
    figures = "main td.bad, main td .bad:not(svg, svg *), main .cell-failed .v"
    alone = """figures => [...document.querySelectorAll(figures)].filter(e => {
        const { content, clipPath, width } = getComputedStyle(e, "::before");
        const cross = content !== "none" && clipPath.startsWith("polygon") && parseFloat(width) > 5;
        return !cross && !e.querySelector(".g") && !/worse|failed|rejected|refused/.test(e.textContent);
    }).map(e => e.outerHTML.slice(0, 120))"""
    counted = 0
    for name in PAGES:
        page = page_in_grey(name)
        assert page.evaluate(alone, figures) == [], name
        counted += page.locator(figures).count()
    assert counted


@pytest.fixture
def page_in_grey(open_page):
    """page_in_grey(name): a page as a grey screen or printer shows it."""

    def opened(name):
        page = open_page(name)
        page.evaluate("document.documentElement.style.filter = 'grayscale(1)'")
        return page

    return opened


def test_a_map_tells_too_little_from_too_much_by_its_line_and_not_by_colour_alone(open_page):
    page = open_page("deposition")
    drawn = """name => {
        const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
        path.setAttribute("class", name);
        document.querySelector(".plot.map").append(path);
        const style = getComputedStyle(path);
        return style.strokeWidth + " " + style.strokeDasharray;
    }"""
    looks = [page.evaluate(drawn, name) for name in ("lack2", "lack1", "right", "over1", "over2")]
    assert len(set(looks)) == 5 and all("none" not in look for look in looks[:2])


@pytest.mark.parametrize("name", [*PAGES, "viewer"])
def test_nothing_moves_by_itself_so_that_reduced_motion_has_nothing_left_to_reduce(open_page, name):
    page = open_page(name)
    for motion in ("no-preference", "reduce"):
        page.emulate_media(reduced_motion=motion)
        moving = """() => [...document.querySelectorAll("*")].filter(e => {
            const style = getComputedStyle(e);
            return style.animationName !== "none" || style.scrollBehavior !== "auto" ||
                style.transitionDuration.split(", ").some(time => parseFloat(time) > 0);
        }).map(e => e.outerHTML.slice(0, 80))"""
        assert page.evaluate(moving) == []
        assert page.evaluate("document.getAnimations().length") == 0


def luminance(colour):
    channels = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.03928 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize("theme", [0, 1])
def test_every_text_colour_reaches_four_and_a_half_to_one_on_every_ground(root, theme):
    style = (root / "pipeline/report/templates/style.css").read_text(encoding="utf-8")
    block = re.findall(r"--paper:#.*?\}", style, re.DOTALL)[theme]
    colours = {
        key: "#" + "".join(c * (2 if len(value) == 3 else 1) for c in value)
        for key, value in re.findall(r"--(\w+):#([0-9a-f]+)", block)
    }
    for ground in ("paper", "surface", "band", "calm"):
        for ink in ("ink", "muted", "blue", "red"):
            light, dark = sorted((luminance(colours[ground]), luminance(colours[ink])), reverse=True)
            # WCAG 2 AA for text
            assert (light + 0.05) / (dark + 0.05) >= 4.5, (ink, ground)
