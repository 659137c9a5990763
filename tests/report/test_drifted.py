"""Answer 11: what the nightly job measured last, or why nothing is known; and
that its figures are no dependency of the pages."""

import re
from pathlib import Path

from pipeline.store import artifacts, params
from pipeline.temperature.settings import Plant
from pipeline.verdict.decide import NEVER, decide
from pipeline.verdict.evidence import Evidence
from pipeline.verdict.settings import ReportRules
from pipeline.verdict.verdict import FAILED, PASSED, Missing
from tests.report import made
from tests.report.made import main
from tests.report.test_pages import DEPOSITION, INDEX, TEMPERATURE, Page, figures

NIGHT = Path("reports/metrics/nightly.json")
FIGURES = {
    "datasets/raw/temperature/a.mcap": {
        "parameters": {
            "gain of heater_1": {"percent": 3.2, "band_percent": 4.1, "sigmas": 1.3},
            "gain of heater_2": {"percent": -6.0, "band_percent": 20.0, "sigmas": -0.5},
        }
    }
}


def night(**drift):
    artifacts.write_json(
        NIGHT,
        {
            "run": "night-0003",
            "when": "2026-11-20T02:10:00+00:00",
            "drift": {"alarms": [], "watched": [], "figures": {}} | drift,
        },
    )
    main()
    text = Page(TEMPERATURE).text
    return re.search(r"Drift since commissioning (.*?) From [a-z_]+/?[a-z_]*", text)[1]


def test_before_the_first_night_drift_is_not_measured(project):
    main()
    assert "Not measured. The nightly job measures it and has not run." in Page(TEMPERATURE).text
    assert "Drift is not measured in any loop." in Page(INDEX).text
    assert "nightly.html" not in TEMPERATURE.read_text()


def test_no_alarm_passes_the_rule_and_names_what_moved_most_against_its_noise(project):
    assert (
        night(figures=FIGURES)
        == "None found. Largest change of the machine: gain of heater_1, 3.2 % ± 4.1. night-0003, 2026-11-20"
    )
    assert figures()["verdict"]["lead"] == "All rules passed on 6 simulated plants."
    assert 'href="nightly.html"' in TEMPERATURE.read_text()


def test_an_alarm_fails_the_rule_for_every_controller_and_gives_the_cause(project):
    found = night(
        figures=FIGURES, alarms=[{"cause": "the gain of heater_1 fell by 12 %", "loop": "temperature"}]
    )
    assert found.startswith("Drifted. The gain of heater_1 fell by 12 %.")
    said = figures()["verdict"]
    assert (said["state"], said["rule"], said["winner"]) == ("failed", "drift", None)
    assert (
        "First failed rule: drift. The machine has changed: the gain of heater_1 fell by 12 %."
        in Page(TEMPERATURE).text
    )


def test_an_alarm_of_another_loop_s_camera_changes_nothing_that_is_said_of_this_one(project):
    def shown():
        """The pages, but for the hash of the night's own file."""
        own = artifacts.sha256(NIGHT)[:16]
        return [page.read_text().replace(own, "") for page in (INDEX, TEMPERATURE, DEPOSITION)]

    night(figures=FIGURES)
    calm = shown()
    camera = {"loop": "setpoint", "cause": "the line stands out less", "sigmas": -9.0}
    night(figures=FIGURES, alarms=[camera], watched=[camera])
    assert shown() == calm


def test_what_is_watched_is_undecided_and_a_night_without_recordings_measures_nothing(project):
    assert night(watched=[{"loop": "temperature", "cause": "the noise of sensor_2 grew"}]).startswith(
        "Perhaps. The noise of sensor_2 grew; an alarm where"
    )
    assert night().startswith("Not measured. The last night had no new recording")
    assert figures()["verdict"]["lead"] == "Every rule measured so far passed on 6 simulated plants."


def test_a_broken_file_of_the_night_is_said_so(project):
    NIGHT.write_text("{")
    main()
    assert "nightly.json is not whole JSON" in Page(TEMPERATURE).text


def test_text_of_the_night_is_escaped(project):
    night(alarms=[{"loop": "temperature", "cause": "<script>alert(1)</script>"}])
    assert "<script>alert" not in INDEX.read_text() + TEMPERATURE.read_text()


def test_drift_is_judged_by_the_night_alone_and_a_drifted_machine_fails(project):
    main()
    stages = made.metrics()
    rules = params.load(ReportRules, "report")
    run = Evidence(stages, {}, params.load(Plant, "plant"), rules, {})
    open_drift = decide(run, drift=NEVER)
    drifted = decide(run, drift=Missing("failed", "The machine has changed"))
    assert (open_drift.state, drifted.state) == (PASSED, FAILED)
    assert drifted.lead == "First failed rule: drift." and "The machine has changed." in drifted.reason
