"""What every test may ask for: the repository's root, other people's data (or the reason why not), and slow
tests only when they are asked for."""

import os
import shutil
import sys
from pathlib import Path

import hypothesis
import pytest

from pipeline import cli

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT / os.environ.get("BEADLINE_SHARED", "../shared")

# the same examples in every run, and no folder of remembered ones
hypothesis.settings.register_profile("repeatable", derandomize=True, database=None, deadline=None)
hypothesis.settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def root() -> Path:
    return ROOT


@pytest.fixture(scope="session")
def browser():
    """Debian's Chromium, or the reason why there is none."""
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="playwright is not installed; uv sync installs it"
    )
    found = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if not found:
        pytest.skip("no Chromium on this machine; install it to see the pages in a browser")
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=found, args=["--no-sandbox", "--disable-gpu"])
        yield started
        started.close()


@pytest.fixture(scope="session")
def shared():
    """shared("data/tclab_mlid_prbs/prbs.csv"): the path of other
    people's data; the test is skipped where it is absent."""

    def path(name: str) -> Path:
        if not (SHARED / name).exists():
            pytest.skip(
                f"{name} is not in BEADLINE_SHARED ({os.environ.get('BEADLINE_SHARED', '../shared')})"
            )
        return SHARED / name

    return path


@pytest.fixture(scope="session")
def cluster(tmp_path_factory):
    """A dask scheduler and two workers on loopback; nobody kills them."""
    from tests.cluster import Cluster

    made = Cluster(tmp_path_factory.mktemp("cluster"))
    yield made
    made.stop()


@pytest.fixture
def mortal_cluster(tmp_path):
    """One of its own for a test that kills."""
    from tests.cluster import Cluster

    made = Cluster(tmp_path)
    yield made
    made.stop()


@pytest.fixture
def beadline(tmp_path, monkeypatch, capfd):
    """beadline("inspect", "a.csv") in an empty folder: status, what was printed, and what was said of
    errors."""
    monkeypatch.chdir(tmp_path)

    def command(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["beadline", *arguments])
        status = 0
        try:
            cli.main()
        except SystemExit as ended:
            status = ended.code
        return status, *capfd.readouterr()

    return command


def pytest_collection_modifyitems(config, items):
    """Slow tests run with -m slow, those of the full mission with -m full, or when they are named by ::."""
    if config.option.markexpr or any("::" in argument for argument in config.args):
        return
    slow = [item for item in items if item.get_closest_marker("slow") or item.get_closest_marker("full")]
    if slow:
        config.hook.pytest_deselected(items=slow)
        items[:] = [item for item in items if item not in slow]
