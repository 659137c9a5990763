"""An enlarged picture in headless Chromium: its axes, ticks and units stay, whatever is zoomed to, on a wide
screen and on a phone; skipped where there is no browser."""

import re

import pytest

WIDTHS = (1280, 390)
# a chart with two axes of numbers, one of them logarithmic in the second; every one has more panels behind it
NUMBERED = (("setpoint", "reliability"), ("deposition", "learning-error"), ("temperature", "record"))

# each label of an axis: its text, what the chart's own scale says of the place of its tick, its box on the
# screen, and the size of its letters
TICKS = """key => {
    const svg = document.querySelector("dialog .stage > svg");
    const [left, right, above, below, wide, tall] = svg.dataset.f.split(" ").map(Number);
    const [low, high, log] = svg.dataset[key].split(" ");
    const own = svg.querySelector(".drawn").getScreenCTM().inverse();
    return [...svg.querySelectorAll(`.${key}tick`)].map(text => {
        const line = key === "y"
            ? [...svg.querySelectorAll(".frame .tk")].find(one =>
                Math.abs(+one.getAttribute("y1") + 4.5 - +text.getAttribute("y")) < 0.01)
            : text.previousElementSibling;
        const box = line.getBoundingClientRect();
        const at = new DOMPoint((box.left + box.right) / 2, (box.top + box.bottom) / 2).matrixTransform(own);
        const share = key === "x"
            ? (at.x - left) / (wide - left - right) : (tall - below - at.y) / (tall - above - below);
        const means = log ? +low * (+high / +low) ** share : +low + share * (+high - +low);
        const letters = text.getBoundingClientRect();
        return [text.textContent, means, [letters.left, letters.right, letters.top, letters.bottom],
            parseFloat(getComputedStyle(text).fontSize) * Math.abs(text.getScreenCTM().a)];
    });
}"""


def enlarged(page, section, number=0):
    """The enlarged picture of a section."""
    page.locator(f"section[aria-labelledby={section}] figure:visible button.zoom").nth(number).press("Enter")
    return page.locator("dialog .stage > svg")


def value(text):
    """The number that a tick says."""
    return float(text.replace("\u2212", "-").replace(",", ""))


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize(("name", "section"), NUMBERED)
def test_axes_ticks_and_units_stay_with_an_enlarged_chart_however_far_it_is_zoomed(
    open_page, name, section, width
):
    page = open_page(name, width=width)
    svg = enlarged(page, section)
    units = svg.evaluate("svg => svg.dataset.u.split('|')")
    seen = {}
    for zoomed in range(3):
        stage = page.locator("dialog .stage").bounding_box()
        for key in "xy":
            ticks = page.evaluate(TICKS, key)
            assert len(ticks) >= 2, (zoomed, key)
            low, high = (float(end) for end in svg.get_attribute(f"data-{key}").split()[:2])
            for text, means, (left, right, top, bottom), size in ticks:
                # the text is rounded to its last digit, a picture to a tenth of a pixel of some 50 to 300
                assert value(text) == pytest.approx(means, rel=0.02, abs=0.004 * (high - low)), (zoomed, key)
                assert left >= stage["x"] - 1 and right <= stage["x"] + stage["width"] + 1
                assert top >= stage["y"] - 1 and bottom <= stage["y"] + stage["height"] + 1
                assert size >= 11
            numbers = [value(text) for text, *_ in ticks]
            span = max(numbers) - min(numbers)
            # zoomed to a part, the ticks are those of the part
            assert span < seen.get(key, float("inf"))
            seen[key] = span
        told = " ".join(svg.locator(".yt").all_text_contents())
        assert all(
            re.search(rf"(^|[\s(]){re.escape(unit)}", told) or name == "temperature" and unit == "percent"
            for unit in units
        ), (told, units)
        boxes = [text.bounding_box() for text in svg.locator(".yt").all()]
        assert boxes and all(box["x"] + box["width"] <= width for box in boxes)
        for _ in range(3):
            page.keyboard.press("+")
    page.keyboard.press("0")
    assert max(value(text) for text, *_ in page.evaluate(TICKS, "x")) > 0
    assert page.console == []


@pytest.mark.parametrize("width", WIDTHS)
def test_names_beside_an_enlarged_chart_stay_where_what_they_name_is_drawn(open_page, width):
    page = open_page("temperature", width=width)
    svg = enlarged(page, "plants", 1)
    names = "text:not(.xtick, .yt)"
    whole = set(svg.locator(f".frame {names}").all_text_contents())
    for _ in range(3):
        page.keyboard.press("+")
    seen = svg.locator(f".frame {names}")
    assert 0 < seen.count() < len(whole) and set(seen.all_text_contents()) < whole
    plot = svg.evaluate(
        "svg => { const box = svg.querySelector('#seen rect'); return ['x', 'y', 'width', 'height']"
        ".map(key => +box.getAttribute(key)); }"
    )
    # beside the plot, as high as a row of it
    for name in seen.all():
        x, y = (float(name.get_attribute(key)) for key in "xy")
        assert x <= plot[0] and plot[1] - 1 <= y <= plot[1] + plot[3] + 12
    assert svg.locator(".xtick").count() >= 2


@pytest.mark.parametrize("width", WIDTHS)
def test_the_ruler_of_an_enlarged_map_stays_and_measures_what_is_seen(open_page, width):
    page = open_page("deposition", width=width)
    svg = enlarged(page, "part-0")
    measured = """svg => {
        const ruler = svg.querySelector(".ruler"), box = ruler.getBoundingClientRect();
        return [box.left, box.right, box.width, parseFloat(ruler.nextElementSibling.textContent)];
    }"""
    *_, pixels, mm = svg.evaluate(measured)
    scale = pixels / mm
    for _ in range(4):
        page.keyboard.press("+")
    left, right, pixels, mm_now = svg.evaluate(measured)
    stage = page.locator("dialog .stage").bounding_box()
    assert left >= stage["x"] and right <= stage["x"] + stage["width"] and mm_now < mm
    # 1.5 a press
    assert pixels / mm_now == pytest.approx(1.5**4 * scale, rel=0.01)


def test_the_pointer_tells_the_same_value_at_a_place_of_the_data_whatever_the_zoom(open_page):
    page = open_page("temperature")
    svg = enlarged(page, "record")

    def told(text):
        """What the tip says at a tick of the axis below, and what the tick says."""
        box = svg.locator(".xtick", has_text=re.compile(f"^{re.escape(text)}$")).bounding_box()
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] - 30)
        return float(page.locator(".tip b").inner_text().split("\u202f")[0].replace(",", ""))

    for _ in range(3):
        page.keyboard.press("+")
        middle = svg.locator(".xtick").all_text_contents()[1]
        # the pointer stands on a whole pixel, of which a screen has a thousand
        reach = float(svg.get_attribute("data-x").split()[1])
        assert told(middle) == pytest.approx(value(middle), abs=0.01 * reach)
