"""The small project as the working directory, its pages built once, and the browser."""

import contextlib
import importlib
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.report import made

PAGES = (
    *("about", "certificate", "deposition", "identification", "index", "papers"),
    *("runs", "setpoint", "temperature", "viewer"),
)
MACHINE = """window.beadline = {"machine": {"cpu": "Some CPU @ 3.00GHz", "cores": 2, "pins": "avx2", \
"version": "0.1.0", "commit": "abc12345", "changed": true, "locked": "1", "date": "2026-11-22T07:00:00Z"}};
"""


def populate(folder):
    """Every artifact and two files of code."""
    for name in ("pipeline", "stages"):
        (folder / name).mkdir()
        (folder / name / "code.py").write_text("1\n")
    made.write(folder)


@pytest.fixture(scope="session")
def populated(tmp_path_factory):
    """The folder with every artifact in it, which nobody changes."""
    folder = tmp_path_factory.mktemp("populated")
    with contextlib.chdir(folder):
        populate(folder)
    return folder


@pytest.fixture
def project(populated, tmp_path, monkeypatch):
    """The working directory with every artifact in it."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(populated, tmp_path, dirs_exist_ok=True)
    return tmp_path


@pytest.fixture
def render_only(monkeypatch):
    """render_only("deposition"): the stage report renders the pages of these modules alone, and leaves the
    others empty. Its verdicts and its figures are those of a whole run."""
    empty = SimpleNamespace(text="", files={})

    def render(*names):
        modules = {name: importlib.import_module(f"pipeline.report.{name}.page") for name in PAGES}
        assert set(names) <= set(modules)
        for other in set(modules) - set(names):
            for function in [name for name in vars(modules[other]) if name.startswith("render")]:
                blank = empty if other == "viewer" else ""
                monkeypatch.setattr(modules[other], function, lambda *_, blank=blank: blank)
        made.main()

    return render


@pytest.fixture(scope="session")
def reports(populated, tmp_path_factory):
    """The folder of the small project's pages, which nobody changes."""
    from tests.report.made import main

    folder = tmp_path_factory.mktemp("built")
    shutil.copytree(populated, folder, dirs_exist_ok=True)
    with contextlib.chdir(folder):
        main()
        Path("reports/machine.js").write_text(MACHINE)  # as ./run does
    return folder / "reports"


def expect(shown):
    """Playwright's assertions about a locator or a page, which wait until they hold: a page's script works
    beside the test."""
    from playwright import sync_api

    sync_api.expect.set_options(timeout=30_000)
    return sync_api.expect(shown)


def timers_fired(page):
    """Waits until timers of less than 0.2 s that the page has set have fired: those of one page fire in the
    order of their times, however slow the machine is."""
    page.evaluate("() => new Promise(done => setTimeout(done, 200))")


def loaded(browser, folder, name, *, width=1280, height=800, theme="light", script=True, folded=False):
    """A page in a browser context of its own, what it folds opened unless `folded`; the addresses that it
    asked for in .asked, the messages of its console in .console."""
    context = browser.new_context(
        viewport={"width": width, "height": height}, color_scheme=theme, java_script_enabled=script
    )
    page = context.new_page()
    page.asked, page.console = [], []
    page.on("request", lambda request: page.asked.append(request.url))
    page.on("console", lambda message: page.console.append(message.text))
    page.on("pageerror", lambda error: page.console.append(str(error)))
    page.on("dialog", lambda dialog: page.console.append(dialog.message))
    page.goto(f"file://{folder}/{name}.html")
    if script and not folded:
        page.evaluate("document.querySelectorAll('details.more').forEach(one => { one.open = true; })")
    return page


@pytest.fixture
def open_page(browser, reports):
    """open_page(name, width, theme, script): a page that the test may change."""
    pages = []

    def opened(name, *, folder=reports, **view):
        pages.append(loaded(browser, folder, name, **view))
        return pages[-1]

    yield opened
    for page in pages:
        page.context.close()


@pytest.fixture(scope="module")
def shown(request, browser, reports):
    """A page of the small project that several tests look at and none changes: its parameter is
    (name, width, theme)."""
    name, width, theme = request.param
    page = loaded(browser, reports, name, width=width, theme=theme)
    yield page
    page.context.close()


@pytest.fixture(scope="module")
def unscripted(request, browser, reports):
    """The page that its parameter names, in a browser that runs no script."""
    page = loaded(browser, reports, request.param, script=False)
    yield page
    page.context.close()
