"""The page of the certificate and the last lines of page one: what leaves the house, and why where nothing
does."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from pipeline.report.certificate import exported
from pipeline.report.certificate.page import judged_margins
from pipeline.store import artifacts, params
from pipeline.temperature.settings import Plant
from pipeline.verdict import decide, identification
from pipeline.verdict.decide import trust_first
from pipeline.verdict.evidence import Evidence
from pipeline.verdict.settings import ReportRules
from pipeline.verdict.verdict import FAILED, OPEN, PASSED, Verdict
from tests.report import made_certificate
from tests.report.made import main
from tests.report.test_pages import Page

PAGE, INDEX = Path("reports/certificate.html"), Path("reports/index.html")


def test_a_passed_certificate_of_a_simulated_plant_is_a_simulation(project):
    made_certificate.write()
    main()
    page, first = Page(PAGE).text, Page(INDEX).text
    assert "Certificate passed (simulation)." in page and "May run" not in page + first
    digest = artifacts.sha256(made_certificate.PATH)
    for text in (page, first):
        whole = " ".join(text.split())
        assert "temperature/controller.json" in whole
        assert digest[:8] in text and "44444444" in text
    assert "one of two files" in " ".join(page.split())
    assert "On 2 plants the largest pole is of size 0.9975: stable." in page
    assert "unlimited" in page and "1.1e-13 percent" in page
    assert "disk margin : passed 0.85 ≥ 0.2" in page
    assert "<b>told</b>" not in PAGE.read_text()


def test_a_certificate_of_recordings_says_no_more_than_page_one(project):
    made_certificate.write(evidence="recorded")
    shown = SimpleNamespace(metrics={"export_controllers": artifacts.read_figures("export_controllers")})
    ready = Verdict("temperature", PASSED, "Ready for a supervised trial.", "", "", "", "", "pi")
    line = exported.lines(shown, ready)[0]
    assert (line["state"], line["word"], line["why"]) == (PASSED, "May run.", "")
    for verdict in (
        ready._replace(winner="varx_riccati"),
        trust_first(ready, ready._replace(decision="Do not trust this model.", state=FAILED)),
    ):
        line = exported.lines(shown, verdict)[0]
        assert (line["state"], line["word"]) == (OPEN, "Certificate passed, not ready.")
        assert line["why"] == f"Page one says: {verdict.decision} {verdict.lead}".strip()
    # the pages of a machine whose page one names no such controller
    main()
    assert "May run" not in Page(PAGE).text + Page(INDEX).text
    assert "Certificate passed, not ready." in Page(PAGE).text
    assert "simulated: not for a real machine" not in Page(PAGE).text


def test_margins_of_the_plants_that_page_one_judges_on_stand_beside_the_certificate_s():
    def told(margins: object) -> str:
        judged = {"plants": 60, "contestants": {"pi": {"margins": margins}}}
        exports = {"temperature": {"contestant": "pi"}}
        return judged_margins(
            SimpleNamespace(metrics={"export_controllers": exports, "evaluate_temperature": judged})
        )

    found = {"disk": {"q10": 0.541, "worst": 0.272}, "delay_s": {"q10": 1.06, "worst": None}}
    assert told(found).endswith(
        "The temperature page has the margins on the test set, 60 other plants: disk margin 0.541 of the "
        "weakest tenth and 0.272 of the worst, delay margin 1.06 s and unlimited."
    )
    # nothing is claimed of what was not judged
    assert (told(None), told({"disk": found["disk"]})) == ("", "")
    assert judged_margins(SimpleNamespace(metrics={})) == ""


def test_a_model_that_nobody_may_trust_exports_nothing(monkeypatch):
    passed = Verdict("temperature", PASSED, "Ready.", "", "", "", "", "pi")
    doubted = passed._replace(decision="Do not trust this model.", state=FAILED)
    monkeypatch.setattr(decide, "decide", lambda *_, **__: passed)
    monkeypatch.setattr(identification, "trust", lambda _: doubted)
    machine, rules = params.load(Plant, "plant"), params.load(ReportRules, "report")
    for source, winner in (("recordings", None), ("simulated", "pi")):
        run = Evidence({}, {}, machine, rules, {"generate_probing": {"source": source}})
        assert decide.verdict(run).winner == winner


def test_a_refused_certificate_names_its_first_failed_rule_and_no_file(project):
    made_certificate.write("disk_margin")
    main()
    page, first = Page(PAGE).text, Page(INDEX).text
    assert "Certificate refused. First failed rule: disk margin." in page
    assert "Nothing of this loop is exported." in page
    assert "Not asked, because disk_margin failed." in page
    assert [part in page for part in ("disk margin : failed", "settled error : not measured")] == [True, True]
    assert "Certificate refused." in first and "temperature/controller.json" not in first


@pytest.mark.parametrize("lost", [made_certificate.PATH, "datasets/export_controllers/figures.json"])
def test_where_nothing_was_exported_both_pages_say_so(project, lost):
    Path(lost).unlink()
    main()
    assert "export_controllers is not there" in Page(PAGE).text
    assert ("Nothing was exported." in Page(INDEX).text) == lost.endswith("figures.json")
