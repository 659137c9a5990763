"""Page one in a browser: one screen, whatever state the loops are in and however long their sentences are;
and the pages with a hundred recordings."""

import contextlib
from pathlib import Path

import numpy as np
import pytest

from pipeline.report.deposition import page as deposition_page
from pipeline.report.identification import page as identification_page
from pipeline.report.setpoint import page as setpoint_page
from pipeline.report.temperature import page as temperature_page
from pipeline.store import artifacts
from pipeline.temperature import tables
from tests.report import made, made_setpoint
from tests.report.conftest import MACHINE, populate
from tests.report.test_pages import change, change_all

LONG = "the recording of the third night stops in the middle of a line, and nobody knows why " * 6


def fine():
    pass


def temperature_failed():
    change_all(settled_error=made.figure(0.72, 0.61, 0.84))


def deposition_failed():
    made.deposition(
        {
            "on_off": (100.0, None, 60.0),
            "priority": (12.0, 11.0, 9.0),
            "basis": (7.0, 2.5, 1.0),
            "ilc": (6.5, None, 0.5),
        }
    )


def setpoint_failed():
    change("train_classifier", ece_window=0.05)


def all_failed():
    temperature_failed()
    deposition_failed()
    setpoint_failed()


def one_missing():
    for path in Path("datasets/evaluate_setpoint").iterdir():
        path.unlink()


def nothing():
    for path in [*Path("datasets").rglob("*.parquet"), *Path("datasets").rglob("*.json")]:
        path.unlink()


def long_sentences():
    all_failed()
    made_setpoint.choice("x" * 300)
    artifacts.write_json(
        "reports/metrics/nightly.json",
        {
            "run": "night-0003",
            "when": "2026-11-20T02",
            "drift": {"alarms": [{"loop": "temperature", "cause": LONG}]},
        },
    )
    Path("datasets/evaluate_temperature/figures.json").write_text("{")


STATES = (
    fine,
    temperature_failed,
    deposition_failed,
    setpoint_failed,
    all_failed,
    one_missing,
    nothing,
    long_sentences,
)


@pytest.fixture
def page_one(tmp_path, monkeypatch):
    """page_one(change): the folder of index.html of the small project
    after a change; the other pages are left out."""
    for module in (deposition_page, identification_page, setpoint_page, temperature_page):
        monkeypatch.setattr(module, "render", lambda *_: "")

    def built(changed):
        with contextlib.chdir(tmp_path):
            populate(tmp_path)
            changed()
            made.main()
        return tmp_path / "reports"

    return built


# screens on which page one does not scroll, and the phone on which it takes at most three
SCREENS, PHONE = ((1280, 800), (1440, 900)), (390, 844)
WIDEST = 'body, body * { font-family: "DejaVu Sans", "Verdana" !important }'


@pytest.mark.parametrize("changed", STATES)
def test_page_one_is_one_screen_and_three_of_a_phone_in_the_widest_font(page_one, open_page, changed):
    folder = page_one(changed)
    (folder / "machine.js").write_text(MACHINE)
    for width, height in (*SCREENS, PHONE):
        page = open_page("index", width=width, height=height, folder=folder)
        page.add_style_tag(content=WIDEST)
        size = page.evaluate("[document.documentElement.scrollWidth, document.documentElement.scrollHeight]")
        assert size[0] <= width, (width, size)
        assert size[1] <= (3 if width == PHONE[0] else 1) * height, (width, size)
    assert (folder / "index.html").stat().st_size <= 150_000


def hundred(folder):
    """A record of a hundred recordings of an hour each, with a finding in every one of them."""
    machine = made.declared(folder)
    parts = [made.record(machine, 3600, f"night_{k:03d}.mcap") for k in range(100)]
    whole = {key: np.concatenate([np.asarray(part[key]) for part in parts]) for key in parts[0]}
    whole["recording"], whole["segment"] = (
        [name for part in parts for name in part["recording"]],
        np.repeat(np.arange(100, dtype=np.int32), 3600),
    )
    artifacts.write_table(
        "datasets/ingest/record.parquet", tables.record(machine.inputs, machine.outputs), whole
    )
    names = [f"night_{k:03d}.mcap" for k in range(100)]
    flaws = {
        "recording": names,
        "signal": ["zone_1"] * 100,
        "kind": ["spike"] * 100,
        "start_s": [10.0] * 100,
        "end_s": [12.0] * 100,
        "count": [2] * 100,
        "message": ["2 samples stand out"] * 100,
    }
    artifacts.write_table("datasets/ingest/quality.parquet", tables.QUALITY, flaws)


def test_with_a_hundred_recordings_the_pages_stay_small(project):
    hundred(project)
    made.main()
    sizes = {path.stem: path.stat().st_size for path in Path("reports").glob("*.html")}
    # the bars of the pages
    assert sizes.pop("index") <= 150_000 and max(sizes.values()) <= 1_500_000, sizes
