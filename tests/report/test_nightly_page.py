"""The nightly page in a browser: an alarm night as it is shown, wide and
narrow, light and dark; hostile names do nothing."""

import pytest

from pipeline.nightly.records import ChampionState, Night, from_json
from pipeline.nightly.settings import Nightly
from pipeline.report.nightly import page as nightly_page
from pipeline.store import params
from tests.conftest import ROOT
from tests.report.conftest import MACHINE

FILE = "datasets/raw/temperature/shift_<b>8</b>.csv"
CAUSE = "the gain from heater_1 has changed by -15.1 %"
DRIFT = {
    "parameters": {f"{what} from {who}": {"percent": -15.1, "band_percent": 0.7,
    "sigmas": -9.4} for what in ("gain", "time constant") for who in ("heater_1", "all inputs")},
    "innovation": {f"sensor_{k}": {"noise_percent": 76.8, "noise_sigmas": 7.2, "mean_degC": -2.0,
    "mean_sigmas": -6.2} for k in (1, 2)},
    "closed_loop": {"sensor_1 offset_degC": {"moved": -1.4, "sigmas": -1.1},
    "heater_1 effort_percent": {"moved": 9.4, "sigmas": 5.1}},
}  # fmt: skip
JUDGED = {
    "decision": "kept",
    "reasons": ["the challenger is better by 0.1 % (-0.1 to 0.2 %, p = 0.03); at least 5 % is worth a change",
    f"drift: {CAUSE}; what the panel stands for has changed"],
    "paired": {"improvement_percent": 0.1, "low_percent": -0.1, "high_percent": 0.2, "p": 0.03, "cases": 168,
    "blocks": 21},
    "guards": {"worst_case": {"champion": 17.6, "challenger": 18.9, "allowed": 0.9},
    "unstable_plants": {"champion": 0.0, "challenger": 0.0, "allowed": 0.0}},
}  # fmt: skip
ALARM = {
    "number": 2, "run": "night-0002", "when": "2030-01-09T02:00:00+00:00", "outcome": "kept",
    "notes": ["the clock was set back by 3 h"], "seconds": 8.0,
    "new_recordings": {"temperature": [FILE]},
    "decisions": {"temperature": JUDGED},
    "reasons": [],
    "drift": {
        "alarms": [{"loop": "temperature", "key": "k", "recording": FILE, "cause": CAUSE, "sigmas": -9.4,
        "consequences": ["closed loop: sensor_1 settles -1.4 °C off"]}],
        "watched": [], "figures": {FILE: DRIFT}, "notes": [],
        "quarantined": {FILE: f"{FILE}: 3 columns, 5 expected <script>alert(1)</script>"},
    },
}  # fmt: skip
FIRST = ALARM | {
    "number": 1, "run": "night-0001", "when": "2030-01-08T02:00:00+00:00", "outcome": "promoted",
    "notes": [],
    "decisions": {"temperature": {"decision": "first champion",
    "reasons": ["there was no champion to compare with"], "guards": {}}},
    "drift": {},
}  # fmt: skip
ENTRY = {
    "run": "night-0001",
    "when": FIRST["when"],
    "folder": {"md5": "0123456789abcdef"},
    "lineage": {"commit": "fedcba9876543210"},
}
STATE = {
    "champions": {"temperature": ENTRY},
    "history": [
        {
            "when": FIRST["when"],
            "loop": "temperature",
            "run": "night-0001",
            "event": "promoted",
            "before": "",
            "why": "first",
            "champion": ENTRY,
        }
    ],
}


@pytest.fixture
def alarm(tmp_path):
    """The folder with the page of an alarm night."""
    settings = params.load(Nightly, "nightly", ROOT / "params.yaml")
    nights = [from_json(Night, row) for row in (FIRST, ALARM)]
    html = nightly_page.render(nights, from_json(ChampionState, STATE), settings)
    (tmp_path / "nightly.html").write_text(html, encoding="utf-8")
    (tmp_path / "machine.js").write_text(MACHINE)
    return tmp_path


@pytest.mark.parametrize(("width", "theme"), [(1280, "light"), (390, "dark")])
def test_an_alarm_night_fits_asks_for_nothing_and_is_open_to_all(open_page, alarm, width, theme):
    axe = pytest.importorskip(
        "axe_playwright_python.sync_playwright", reason="axe is not installed; uv sync installs it"
    )
    page = open_page("nightly", folder=alarm, width=width, theme=theme)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    beside = page.url.replace("nightly.html", "machine.js")
    assert [url for url in page.asked if not url.startswith("data:")] == [
        page.url,
        beside,
    ] and page.console == []
    wcag = {"runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa"]}
    violations = axe.Axe().run(page, options=wcag).response["violations"]
    assert [(v["id"], [node["html"][:120] for node in v["nodes"]]) for v in violations] == []


def test_an_alarm_night_says_cause_consequence_and_what_stays(open_page, alarm):
    page = open_page("nightly", folder=alarm)
    assert (
        page.locator("h1").inner_text().replace("\n", " ") == "The machine has drifted; the champions stay."
    )
    text = page.locator("body").inner_text()
    assert (
        "the gain from heater_1 has changed by −15.1\u202f%" in text
        and "as a consequence, closed loop: sensor_1 settles −1.4\u202f°C off" in text
    )
    assert './run beadline nightly --accept-drift temperature "WHY"' in text
    # the cause stands once in the night's row, and file names are text
    row = page.locator("#nights ~ div tbody tr").first.inner_text()
    assert row.count("has changed by") == 1 and "<b>8</b>" in text
    # a figure that is worse than allowed is marked
    assert page.locator("td.bad", has_text="18.9").count() == 1


def test_a_sensor_that_stands_still_is_the_pages_first_sentence_and_its_first_alarm():
    dead = {
        "loop": "temperature", "key": "k", "recording": FILE, "sigmas": 99.9, "kind": "sensor",
        "cause": "sensor_2 stands still at 110.0 °C while heater_2 heats.", "channel": "sensor_2",
    }  # fmt: skip
    measured = ALARM["drift"]
    night = ALARM | {"drift": measured | {"alarms": [*measured["alarms"], dead]}}
    settings = params.load(Nightly, "nightly", ROOT / "params.yaml")
    html = nightly_page.render(
        [from_json(Night, FIRST), from_json(Night, night)], from_json(ChampionState, STATE), settings
    )
    assert "Check sensor_2 before the machine heats again; the champions stay." in html
    assert html.index("sensor_2 stands still at 110.0") < html.index("gain from heater_1 has changed")
    assert "Alarm: a sensor stands still." in html and "99.9" not in html
    assert "--accept-drift" not in html
