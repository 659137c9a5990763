"""The pages in headless Chromium: what fits, what overflows, what is asked of the network, what the console says; skipped where there is
no browser."""

import html
import json
import re
import subprocess
from pathlib import Path

import pytest

from stages.report import main

OPTIONS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--host-resolver-rules=MAP * ~NOTFOUND",
    "--enable-logging=stderr",
    "--v=0",
]
# a page in a frame of the parent's own origin, so that the parent may measure it at any width and in any theme
FRAME = """<!doctype html><body style="margin:0"><iframe id="f" width="{width}" height="800" style="border:0" srcdoc="{page}"></iframe><pre id="out"></pre><script>
const f = document.getElementById("f");
f.onload = () => {{
  const d = f.contentDocument, w = f.contentWindow, root = d.documentElement;
  const last = [...d.querySelectorAll(".answers tbody tr")].at(-1);
  const wide = [...d.body.querySelectorAll("*")].filter(e => !e.closest("svg, .scroll, .vh") && e.getBoundingClientRect().right > {width} + 1);
  const hidden = [...d.querySelectorAll(".answers tbody tr")].filter(r => !r.getBoundingClientRect().height);
  document.getElementById("out").textContent = JSON.stringify({{
    scroll: root.scrollWidth, answers: last ? last.getBoundingClientRect().bottom : 0, wide: wide.map(e => e.outerHTML.slice(0, 120)), hidden: hidden.length,
    paper: w.getComputedStyle(d.body).backgroundColor, requests: w.performance.getEntriesByType("resource").map(e => e.name),
  }});
}};
</script></body>"""


def run(chromium, tmp_path, *arguments):
    done = subprocess.run(
        [chromium, *OPTIONS, f"--user-data-dir={tmp_path / 'profile'}", *arguments], capture_output=True, text=True, timeout=60, check=True
    )
    return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line]


def measured(chromium, tmp_path, page, *, width, theme="light"):
    """What Chromium says of a page at a width and in a theme, and the lines of its console."""
    text = page.read_text(encoding="utf-8").replace('<html lang="en">', f'<html lang="en" data-theme="{theme}">')
    frame = tmp_path / "frame.html"
    frame.write_text(FRAME.format(width=width, page=html.escape(text, quote=True)), encoding="utf-8")
    dom, console = run(chromium, tmp_path, "--window-size=1400,900", "--virtual-time-budget=5000", "--dump-dom", f"file://{frame}")
    return json.loads(html.unescape(re.search(r'<pre id="out">(.*?)</pre>', dom, re.DOTALL)[1])), console


@pytest.mark.parametrize("name", ["index.html", "temperature.html", "identification.html", "deposition.html"])
@pytest.mark.parametrize(("width", "theme"), [(1280, "light"), (1024, "dark"), (390, "light")])
def test_nothing_overflows_nothing_is_fetched_and_the_console_is_silent(project, chromium, tmp_path, name, width, theme):
    main()
    found, console = measured(chromium, tmp_path, Path("reports") / name, width=width, theme=theme)
    assert found["scroll"] <= width and found["wide"] == []
    assert found["requests"] == [] and console == []
    assert found["paper"] == {"light": "rgb(255, 255, 255)", "dark": "rgb(18, 21, 25)"}[theme]
    # no row of the answers is lost at any width
    assert found["hidden"] == 0


def test_the_twelve_answers_end_within_the_first_screen(project, chromium, tmp_path):
    main()
    found, _ = measured(chromium, tmp_path, Path("reports/index.html"), width=1280)
    assert 0 < found["answers"] <= 800


def test_a_page_prints_to_a4_landscape(project, chromium, tmp_path):
    main()
    for name in ("index", "temperature", "identification", "deposition"):
        run(
            chromium,
            tmp_path,
            "--no-pdf-header-footer",
            f"--print-to-pdf={tmp_path / name}.pdf",
            f"file://{Path('reports').resolve() / name}.html",
        )
        pdf = (tmp_path / f"{name}.pdf").read_bytes()
        box = re.search(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", pdf)
        # 297 x 210 mm in points
        assert abs(float(box[1]) - 842) < 2 and abs(float(box[2]) - 595) < 2


def luminance(colour):
    channels = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.03928 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize("theme", [0, 1])
def test_every_text_colour_reaches_four_and_a_half_to_one_on_every_ground(root, theme):
    style = (root / "pipeline/report/templates/style.css").read_text(encoding="utf-8")
    block = re.findall(r"--paper:#.*?\}", style, re.DOTALL)[theme]
    colours = {
        key: "#" + "".join(c * (2 if len(value) == 3 else 1) for c in value) for key, value in re.findall(r"--(\w+):#([0-9a-f]+)", block)
    }
    for ground in ("paper", "surface", "band", "calm"):
        for ink in ("ink", "muted", "blue", "red"):
            light, dark = sorted((luminance(colours[ground]), luminance(colours[ink])), reverse=True)
            # WCAG 2 AA for text
            assert (light + 0.05) / (dark + 0.05) >= 4.5, (ink, ground)
