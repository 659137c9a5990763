"""The small project as the working directory, and the browser."""

import shutil

import pytest

from tests.report import made


@pytest.fixture
def project(tmp_path, monkeypatch):
    """The working directory with every artifact in it."""
    monkeypatch.chdir(tmp_path)
    for folder in ("pipeline", "stages"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "code.py").write_text("1\n")
    made.write(tmp_path)
    return tmp_path


@pytest.fixture
def chromium():
    """Path of the browser, or the reason why there is none."""
    found = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if not found:
        pytest.skip("no Chromium on this machine; install it to see the pages in a browser")
    return found
