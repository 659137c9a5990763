"""The small project as the working directory, its pages built once, and the browser."""

import contextlib
from pathlib import Path

import pytest

from tests.report import made

MACHINE = """window.beadline = {"machine": {"cpu": "Some CPU @ 3.00GHz", "cores": 2, "pins": "avx2", \
"version": "0.1.0", "commit": "abc12345", "changed": true, "locked": "1", "date": "2026-11-22T07:00:00Z"}};
"""


def populate(folder):
    """Every artifact and two files of code."""
    for name in ("pipeline", "stages"):
        (folder / name).mkdir()
        (folder / name / "code.py").write_text("1\n")
    made.write(folder)


@pytest.fixture
def project(tmp_path, monkeypatch):
    """The working directory with every artifact in it."""
    monkeypatch.chdir(tmp_path)
    populate(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def reports(tmp_path_factory):
    """The folder of the small project's pages, which nobody changes."""
    from stages.report import main

    folder = tmp_path_factory.mktemp("built")
    with contextlib.chdir(folder):
        populate(folder)
        main()
        Path("reports/machine.js").write_text(MACHINE)  # as ./run does
    return folder / "reports"


@pytest.fixture
def open_page(browser, reports):
    """open_page(name, width, theme, script): a page in a browser of its own; what it
    asked for, and what it said, in .asked and .said."""
    contexts = []

    def opened(name, *, width=1280, height=800, theme="light", script=True, folder=reports):
        context = browser.new_context(
            viewport={"width": width, "height": height}, color_scheme=theme, java_script_enabled=script
        )
        contexts.append(context)
        page = context.new_page()
        page.asked, page.said = [], []
        page.on("request", lambda request: page.asked.append(request.url))
        page.on("console", lambda message: page.said.append(message.text))
        page.on("pageerror", lambda error: page.said.append(str(error)))
        page.on("dialog", lambda dialog: page.said.append(dialog.message))
        page.goto(f"file://{folder}/{name}.html")
        return page

    yield opened
    for context in contexts:
        context.close()
