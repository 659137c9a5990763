"""What the pages were made on: `run` writes it beside them, accept keeps it, and a
page says "another CPU" where nothing else differs."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from pipeline import cli
from pipeline.report.shared.sources import machine
from pipeline.store import artifacts, params
from tests import fake_uv
from tests.report import made
from tests.report.made import main
from tests.report.test_pages import change

HERE = {
    "cpu": "Here 9000",
    "cores": 2,
    "pins": "avx2",
    "version": "0.1.0",
    "commit": "abc12345",
    "changed": True,
    "locked": "1",
    "date": "2026-11-22T07:00:00Z",
}
THERE = HERE | {"cpu": "There 3000", "commit": "0123abcd", "changed": False}
JS = Path("reports/machine.js")


def write(facts):
    JS.parent.mkdir(exist_ok=True)
    JS.write_text(f"window.beadline = {json.dumps({'machine': facts})};\n")


@pytest.fixture
def house(tmp_path, root):
    """house(*command, cpuinfo): ./run of a copy in which DVC only prints its command; the facts that were
    written, or None."""
    fake_uv.furnish(tmp_path, root)

    def run(*command, cpuinfo=None):
        outside = {}
        if cpuinfo is not None:
            (tmp_path / "cpuinfo").write_text(cpuinfo)
            outside["BEADLINE_CPUINFO"] = str(tmp_path / "cpuinfo")
        path = tmp_path / JS
        if path.is_file():
            path.unlink()
        done = fake_uv.run(tmp_path, *command, **outside)
        assert done.returncode == 0, done.stderr
        assert fake_uv.asked(tmp_path).startswith(f"uv run --frozen --project {tmp_path} ")
        assert fake_uv.asked(tmp_path).endswith(" ".join(command))
        assert not list(tmp_path.rglob("*.tmp"))
        return machine(path) or None

    return run


def git(folder, *arguments):
    subprocess.run(
        ["git", "-c", "user.name=a", "-c", "user.email=a@b", *arguments],
        cwd=folder,
        check=True,
        capture_output=True,
    )


@pytest.mark.parametrize(
    "command",
    ["dvc repro", "dvc repro report", "dvc exp run -S a.b=1", "beadline nightly", "--extra gpu dvc repro"],
)
def test_a_command_that_makes_pages_says_on_what(house, tmp_path, command):
    found = house(*command.split())
    assert list(found) == list(HERE)
    assert (
        found["pins"] in ("avx2", "none")
        and found["cores"] >= 1
        and found["cpu"]
        and found["commit"] == "none"
        and not found["changed"]
    )
    assert found["version"] in (tmp_path / "pyproject.toml").read_text()
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", found["date"])


@pytest.mark.parametrize(
    "command", ["dvc exp show", "dvc status", "beadline accept", "beadline nightly --watch", "pytest"]
)
def test_no_other_command_does(house, command):
    assert house(*command.split()) is None


def test_another_environment_is_told_from_another_cpu(house, tmp_path):
    before = house("dvc", "repro")["locked"]
    assert (
        house("dvc", "repro", "-f")["locked"] == before != house("--extra", "gpu", "dvc", "repro")["locked"]
    )
    (tmp_path / "uv.lock").write_text("other\n")
    assert house("dvc", "repro")["locked"] != before


def test_the_commit_and_what_is_changed_on_it_are_said(house, tmp_path):
    (tmp_path / "pipeline/code.py").write_text("1\n")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "first")
    found = house("dvc", "repro")
    assert re.fullmatch("[0-9a-f]{8}", found["commit"]) and found["changed"] is False
    (tmp_path / "pipeline/code.py").write_text("2\n")
    assert house("dvc", "repro") | {"date": ""} == found | {"changed": True, "date": ""}
    git(tmp_path, "checkout", "-q", "pipeline")
    assert house("dvc", "repro")["changed"] is False


@pytest.mark.parametrize(
    "name",
    [
        '"}};alert(1);//',
        "</script><script>alert(1)</script>",
        "%s%n%d\\u0022\\",
        "$(touch hit)`touch hit`",
        "µ\x1b[31m\x00é",
        "x" * 10_000,
        "",
    ],
)
def test_no_name_of_a_cpu_breaks_out_of_its_text(house, tmp_path, name):
    found = house("dvc", "repro", cpuinfo=f"model name\t: {name}\nflags\t\t: fpu avx2 fma\n")
    assert re.fullmatch(r"[A-Za-z0-9 ()@.,:/_+-]{1,80}", found["cpu"]) and found["pins"] == "avx2"
    assert not list(tmp_path.rglob("hit")) and (tmp_path / JS).read_text().count("\n") == 1


def test_a_reports_that_is_no_folder_stops_nothing(house, tmp_path):
    (tmp_path / "reports").write_text("")
    assert house("dvc", "repro") is None


# ---- accept


def accept(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["beadline", "accept"])
    cli.main()
    return artifacts.read_json("reports/accepted.json")


def test_accept_keeps_the_machine_and_none_where_none_is_said(project, monkeypatch):
    main()
    assert accept(monkeypatch)["machine"] == {}
    write(THERE)
    assert accept(monkeypatch)["machine"] == THERE


@pytest.mark.parametrize(
    "text",
    [
        "",
        "window.beadline = {};\n",
        "window.beadline = {]};",
        'window.beadline = {"machine": 3};',
        "alert(1)",
    ],
)
def test_accept_refuses_what_is_no_such_file_in_one_sentence(project, monkeypatch, capsys, text):
    main()
    JS.write_text(text)
    with pytest.raises(SystemExit):
        accept(monkeypatch)
    said = capsys.readouterr().err
    assert said.startswith("beadline: reports/machine.js: expected") and said.endswith(
        "run ./run dvc repro, which writes it anew\n"
    )


# ---- the pages


@pytest.fixture
def accepted(project, monkeypatch):
    """A run that was accepted on another CPU, and after it one figure that moved."""
    main()
    write(THERE)
    accept(monkeypatch)
    change("evaluate_temperature", contestants__subspace_lqg__settling=made.figure(9.0, 8.5, 9.5))
    write(HERE)
    main()
    return project


def first_page(open_page, folder):
    """What page one says of the accepted run, when machine.js has come or is known to be missing."""
    page = open_page("index", folder=folder / "reports")
    page.wait_for_load_state()
    return page.locator("section:has(> #changed)").inner_text()


ALONE = "Nothing but the CPU differs from the accepted run: There 3000 then, Here 9000 now."


@pytest.mark.parametrize("stage", ["train_ilc", "train_classifier"])
def test_recordings_that_may_have_changed_unseen_are_not_called_the_cpu(project, monkeypatch, stage):
    file = next(file for file, sections in params.files().items() if "source" in (sections.get(stage) or {}))
    sections = params.files()[file]
    sections[stage]["source"] = "recordings"
    artifacts.write_text(file, yaml.safe_dump(sections))
    write(THERE)
    main()
    accept(monkeypatch)
    write(HERE)
    main()
    assert "There 3000" not in (project / "reports/index.html").read_text()


def test_a_page_says_that_nothing_but_the_cpu_differs(open_page, accepted):
    section = first_page(open_page, accepted)
    assert ALONE in section
    assert "figures moved with the machine alone." in section and "moved beyond their noise" not in section


def test_pins_alone_and_both_are_said_too(open_page, accepted):
    write(THERE | {"pins": "none"})
    assert "Nothing but the pins differ from the accepted run: pins avx2 then, pins none now." in first_page(
        open_page, accepted
    )
    write(HERE | {"pins": "none"})
    assert (
        "Nothing but CPU and pins differ from the accepted run: There 3000, pins avx2 then, "
        "Here 9000, pins none now." in first_page(open_page, accepted)
    )


def parameter():
    Path("params.yaml").write_text(
        Path("params.yaml").read_text().replace("disk_margin: 0.4", "disk_margin: 0.41", 1)
    )


def code():
    Path("stages/code.py").write_text("2\n")


def record():
    path = "datasets/ingest/record.parquet"
    accepted = artifacts.read_json("reports/accepted.json")
    artifacts.write_json(
        "reports/accepted.json", accepted | {"hashes": accepted["hashes"] | {path: "0" * 64}}
    )


def broken_form():
    artifacts.write_json(
        "reports/accepted.json", artifacts.read_json("reports/accepted.json") | {"machine": ["</script>"]}
    )


def as_before(open_page, folder):
    section = first_page(open_page, folder)
    assert "Nothing but" not in section
    assert re.search(r"1 of \d+ figures moved beyond their noise\.", section)


@pytest.mark.parametrize("differs", [parameter, code, record, broken_form])
def test_a_page_is_as_before_where_anything_else_differs(open_page, accepted, differs):
    differs()
    main()
    as_before(open_page, accepted)


def test_a_page_is_as_before_on_the_same_machine_with_other_packages_and_where_none_is_said(
    open_page, accepted
):
    for text in (THERE, HERE | {"locked": "2"}):
        write(text)
        as_before(open_page, accepted)
    JS.write_text("1\n")
    as_before(open_page, accepted)
    JS.unlink()
    as_before(open_page, accepted)


def test_the_pages_are_the_same_bytes_wherever_they_are_made(accepted):
    pages = {path: path.read_bytes() for path in Path("reports").glob("*.html")}
    write(THERE | {"pins": "none"})
    main()
    assert pages == {path: path.read_bytes() for path in Path("reports").glob("*.html")}
    assert all(b"Here 9000" not in text for text in pages.values())


def test_hostile_facts_of_the_accepted_run_stay_text(open_page, accepted):
    hostile = "</script><img src=x onerror='window.hit=1'>\"'&"
    found = artifacts.read_json("reports/accepted.json")
    artifacts.write_json("reports/accepted.json", found | {"machine": THERE | {"cpu": hostile}})
    main()
    page = open_page("index", folder=accepted / "reports")
    page.wait_for_load_state()
    assert f"the accepted run: {hostile} then, Here 9000 now." in page.locator("main").inner_text()
    assert page.evaluate("window.hit") is None and page.console == []


def test_without_the_file_a_page_says_the_same_and_the_browser_alone_remarks_on_it(
    open_page, reports, tmp_path
):
    shutil.copy(reports / "certificate.html", tmp_path)
    alone, beside = open_page("certificate", folder=tmp_path), open_page("certificate")
    for page in (alone, beside):
        page.wait_for_load_state()
        column, dates = page.locator("[data-run-column]"), page.locator("[data-made]")
        assert dates.count()
        assert column.evaluate_all("cells => cells.map(cell => cell.checkVisibility())") == (
            [page is beside] * column.count()
        )
        assert set(dates.all_inner_texts()) == ({"22 Nov 2026"} if page is beside else {""})
        column.evaluate_all("cells => cells.forEach(cell => cell.remove())")
    assert alone.locator("main").inner_text() == beside.locator("main").inner_text()
    assert alone.locator(".made").count() == 0 and alone.console == [
        "Failed to load resource: net::ERR_FILE_NOT_FOUND"
    ]
    assert beside.locator(".made").inner_text().startswith("Last run on ")
