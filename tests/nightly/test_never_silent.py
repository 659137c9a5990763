"""Whatever goes wrong in a night, somebody is told, what is in production stays, and the next night works."""

import html
import http.server
import json
import os
import signal
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from pipeline.cli import render_night
from pipeline.nightly import champion, guarding, night, remembered, reporting, reproducing, watch
from pipeline.nightly.settings import Nightly
from pipeline.report.nightly import page
from pipeline.store import params
from tests.nightly.toy_nights import DVC, SECTIONS, SETTINGS, Project, entered

OTHER = """
  other:
    cmd: python other.py
    deps: [other.py, datasets/raw/other]
    outs: [datasets/other: {persist: true}]
    metrics: [reports/metrics/other.json: {cache: false, persist: true}]
  pages:
    cmd: python pages.py
    deps: [pages.py, datasets/evaluate, datasets/other]
    outs: [datasets/pages.txt]
"""
OTHER_STAGE = """
import json, pathlib, sys
values = []
for path in sorted(pathlib.Path("datasets/raw/other").glob("*.csv")):
    try:
        values += [float(line) for line in path.read_text().split()]
    except ValueError:
        sys.exit(f"other: {path}: expected numbers, found none; mend the file")
mean = sum(values) / len(values)
cases = {f"case {k}": {"block": f"plant {k}", "cost": 1 + abs(mean - 10) + 0.001 * k} for k in range(8)}
out = pathlib.Path("datasets/other")
out.mkdir(parents=True, exist_ok=True)
(out / "cases.json").write_text(json.dumps({"panel": "other 1", "cases": cases, "guards": {}}))
pathlib.Path("reports/metrics/other.json").write_text(json.dumps({"mean": mean}))
"""
PAGES_STAGE = """
import json, pathlib
costs = []
for name in ("evaluate", "other"):
    cases = json.loads(pathlib.Path(f"datasets/{name}/cases.json").read_text())["cases"]
    costs.append(f"{cases['case 0']['cost']:g}")
pathlib.Path("datasets/pages.txt").write_text(" ".join(costs))
"""
LOOPS = SETTINGS["loops"] | {
    "other": {
        "artifacts": ["datasets/other/cases.json"],
        "judge": "cases",
        "cases": "datasets/other/cases.json",
        "recordings": "datasets/raw/other",
    }
}


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """The project after its first night; its alarm copies the JSON file to woken.json."""
    project = Project(tmp_path_factory.mktemp("silent") / "toy").make()
    command = f"{sys.executable} -c \"import sys,shutil; shutil.copy(sys.argv[1], 'woken.json')\""
    project.set(alarm=command)
    (project.folder / ".gitignore").write_text("/reports/*.html\n/woken.json\n")
    project.run("git", "commit", "-qam", "an alarm")
    return project.promoted()


@pytest.fixture
def project(first, tmp_path, monkeypatch):
    return entered(first, tmp_path / "toy", monkeypatch)


@pytest.fixture(scope="module")
def second_loop(first, tmp_path_factory):
    """The project with a second loop, and a page that belongs to both, after the night that promoted both."""
    two = Project(tmp_path_factory.mktemp("two") / "toy")
    two.run("cp", "-a", f"{first.folder}/.", ".")
    (two.folder / "dvc.yaml").write_text(DVC + OTHER)
    (two.folder / "other.py").write_text(OTHER_STAGE)
    (two.folder / "pages.py").write_text(PAGES_STAGE)
    (two.folder / "datasets/raw/other").mkdir()
    (two.folder / "datasets/raw/other/a.csv").write_text("13")
    two.set(loops=LOOPS, alarm=json.loads((first.folder / "params.yaml").read_text())["nightly"]["alarm"])
    two.run("git", "add", "-A")
    two.run("git", "commit", "-q", "-m", "a second loop")
    return two.promoted("other")


@pytest.fixture
def two(second_loop, tmp_path, monkeypatch):
    return entered(second_loop, tmp_path / "toy", monkeypatch)


def told(project: Project, *words: str) -> None:
    """Status 1, alarm, command and page all name these; the champion is that of the first night."""
    before, woken = project.production(), project.folder / "woken.json"
    woken.unlink(missing_ok=True)
    status, summary = night.nightly(render_night)
    assert status == night.FAILED
    alarm, page_text = json.loads(woken.read_text()), html.unescape(Path("reports/nightly.html").read_text())
    assert alarm["kind"] == "failed" and alarm == json.loads(watch.ALARM.read_text())
    for word in words:
        assert word in summary and word in html.unescape(alarm["text"]) and word in page_text, (word, summary)
    assert "Traceback" not in summary
    assert project.production() == before and project.champion()["run"] == "night-0001"


def works_again(project: Project, run: str) -> None:
    project.record("better", [9.0, 9.0, 9.0])
    status, summary = night.nightly(render_night)
    assert status == night.OK and "promoted toy" in summary, summary
    assert project.champion()["run"] == run


# ---- state


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("last.json", ""),
        ("last.json", '{"night": 1, "drift": {"drifted": ["no"]}}'),
        ("nights.json", "<<<<<<< HEAD"),
        ("nights.json", None),
        ("last.json", None),
    ],
)
def test_broken_state_is_set_aside_and_costs_one_repeated_night(project, file, text):
    broken, aside = Path(".beadline", file), Path(f".beadline/{file}.broken")
    if text is None:
        broken.unlink()
        broken.mkdir()
    else:
        broken.write_text(text)
    told(project, f".beadline/{file}", f"set aside as .beadline/{file}.broken")
    assert aside.is_dir() if text is None else aside.read_text() == text
    assert [n.run for n in remembered.nights()][-1] == "night-0002"
    works_again(project, "night-0003")


BROKEN_LAST = [
    b"", b"\xff\xfe", b"[]", b"null", b"1", b"{}", b'{"night": "one"}', b'{"night": -1.5}',
    b'{"night": 1, "success": "yesterday"}', b'{"night": 1, "success": "2030-01-01T00:00:00"}',
    b'{"night": 1, "recordings": {"toy": 3}}', b'{"night": 1, "hashes": {"a": [1]}}',
    b'{"night": 1, "drift": []}', b'{"night": 1, "settings": 5}', b"[" * 100_000,
]  # fmt: skip


@pytest.mark.parametrize("content", BROKEN_LAST, ids=range(len(BROKEN_LAST)))
def test_no_content_of_the_memory_is_a_crash(tmp_path, monkeypatch, content):
    monkeypatch.chdir(tmp_path)
    Path(".beadline").mkdir()
    Path("reports/metrics").mkdir(parents=True)
    Path("reports/metrics/nightly.json").write_text('{"night": 41, "when": "2030-01-01T00:00:00+00:00"}')
    remembered.LAST.write_bytes(content)
    last, aside = remembered.opened()
    assert len(aside) == 1 and "last.json" in aside[0] and last.night == 41 and last.inputs is None
    assert remembered.opened() == (last, [])


@pytest.mark.parametrize(
    "content", ["", "{}", "[3]", '[{"night": 1}]', '[{"night": "1", "run": "n", "when": "", "outcome": ""}]']
)
def test_no_content_of_the_history_is_a_crash(tmp_path, monkeypatch, content):
    monkeypatch.chdir(tmp_path)
    Path(".beadline").mkdir()
    remembered.NIGHTS.write_text(content)
    assert len(remembered.opened()[1]) == 1 and remembered.nights() == []


def test_the_number_goes_on_where_only_the_history_is_left(project):
    remembered.LAST.unlink()
    Path("reports/metrics/nightly.json").unlink()
    last = remembered.last()
    assert last.night == 1 and last.success == remembered.nights()[0].when


@pytest.mark.parametrize("committed", [False, True])
def test_a_broken_champion_json_is_put_back_and_told(project, committed):
    whole = Path("champion.json").read_bytes()
    Path("champion.json").write_text("" if not committed else "<<<<<<< ours\n{}\n")
    if committed:
        project.run("git", "commit", "-qam", "a merge that went wrong")
    before = project.production()
    status, summary = night.nightly(render_night)
    assert status == night.FAILED and "champion.json is not whole JSON" in summary
    assert "put back to" in summary and json.loads(Path("woken.json").read_text())["kind"] == "failed"
    assert "champion.json" in Path("reports/nightly.html").read_text()
    assert project.production() == before and Path("champion.json").read_bytes() == whole
    assert project.dirty() == []
    works_again(project, "night-0003")


# ---- files that a person edits


@pytest.mark.parametrize(
    ("file", "content", "words"),
    [
        ("params.yaml", b"nightly: {\n", ["params.yaml: line 2"]),
        ("params.yaml", b"nightly:\n<<<<<<< HEAD\n  a: 1\n=======\n", ["params.yaml: line 2", "<<<<<<<"]),
        ("params.yaml", b"nightly: {watch_h: '\xe9'}\n", ["params.yaml: byte 20 is not UTF-8"]),
        ("params.yaml", b"nightly: {colour: 1}\n", ["nightly.colour is unknown"]),
        ("params.yaml", None, ["params.yaml is missing"]),
        ("dvc.yaml", None, ["dvc.yaml is missing"]),
        ("dvc.yaml", b"stages: [\n", ["dvc.yaml: line 2"]),
        ("dvc.lock", b"", []),
        ("dvc.lock", b"schema: '2.0'\n<<<<<<< HEAD\nstages: {}\n", ["dvc.lock: line 2", "HEAD -- dvc.lock"]),
        ("dvc.lock", b"[1]\n", ["dvc.lock: expected stages"]),
    ],
)  # fmt: skip
def test_a_broken_file_is_named_and_somebody_is_woken_by_what_was_last_known(project, file, content, words):
    whole = Path(file).read_bytes()
    if content is None:
        Path(file).unlink()
    else:
        Path(file).write_bytes(content)
    if not words:  # nothing is wrong with an empty dvc.lock: all is made anew
        assert night.nightly(render_night)[0] == night.OK
        return
    told(project, *words)
    Path(file).write_bytes(whole)
    assert night.nightly(render_night)[0] == night.OK


def test_broken_parameters_of_a_fresh_clone_wake_by_the_environment(project, monkeypatch):
    woken = json.loads(Path("params.yaml").read_text())["nightly"]["alarm"]
    remembered.LAST.unlink()
    Path("params.yaml").write_text("nightly: [\n")
    monkeypatch.setenv("BEADLINE_ALARM", woken)
    told(project, "params.yaml: line 2")


def test_markers_of_a_merge_that_were_committed_are_mended_by_the_command_that_is_named(project):
    whole = Path("dvc.lock").read_bytes()
    Path("dvc.lock").write_bytes(b"<<<<<<< HEAD\n" + whole)
    project.run("git", "commit", "-qam", "half a merge")
    summary = night.nightly(render_night)[1]
    command = summary[summary.index("git checkout") : summary.index(" -- dvc.lock")] + " -- dvc.lock"
    project.run(*command.split())
    assert Path("dvc.lock").read_bytes() == whole


# ---- mistakes of the program


def test_an_unforeseen_error_is_one_sentence_and_its_traceback_is_in_the_log(project, monkeypatch):
    project.record("better", [9.0, 9.0, 9.0])
    lock = Path("dvc.lock").read_bytes()
    with monkeypatch.context() as broken:
        broken.setattr(night, "_judge", lambda *_: {}["no such key"])
        told(project, "a mistake of this program (KeyError: 'no such key')", ".beadline/logs/night-0002.log")
    text = Path(".beadline/logs/night-0002.log").read_text()
    assert "Traceback (most recent call last)" in text and "Running stage" in text
    assert Path("dvc.lock").read_bytes() == lock and project.dirty() == ["?? datasets/raw/toy/better.csv"]
    works_again(project, "night-0003")


@pytest.mark.parametrize(
    ("module", "name"),
    [
        (page, "render"),
        (champion, "as_committed"),
        (remembered, "opened"),
        (remembered, "add"),
        (guarding, "locked"),
    ],
)
def test_an_error_at_any_edge_of_the_night_is_told(project, monkeypatch, module, name):
    project.record("second", [30.0])

    def broken(*_, **__):
        raise RuntimeError("a bug at the edge")

    with monkeypatch.context() as edge:
        edge.setattr(module, name, broken)
        told(project, "RuntimeError: a bug at the edge")
    assert night.nightly(render_night)[0] == night.OK


def test_a_commit_that_fails_leaves_the_champion_of_the_commit_before(project, monkeypatch):
    project.record("better", [9.0, 9.0, 9.0])

    def full(*_, **__):
        raise OSError(28, "No space left on device", ".git/objects")

    with monkeypatch.context() as disk:
        disk.setattr(night, "commit", full)
        told(project, "No space left on device")
    works_again(project, "night-0003")


# ---- loops


@pytest.mark.usefixtures("must_end")
def test_stages_that_take_too_long_are_ended_and_that_is_said(project):
    alarm = json.loads(Path("params.yaml").read_text())["nightly"]["alarm"]
    project.set(longest_h=0.001, alarm=alarm)
    Path("slow.txt").write_text("3600")
    project.record("second", [9.5])
    told(project, "dvc repro --keep-going was ended after 0.001 h (nightly.longest_h)")
    Path("slow.txt").unlink()
    project.set(alarm=alarm)
    works_again(project, "night-0003")


def test_a_loop_that_fails_stops_no_other_and_is_told(two):
    before, lock = two.production_of("other"), Path("dvc.lock").read_text()
    bad = Path("datasets/raw/other/bad.csv")
    bad.write_text("x")
    two.record("better", [9.0, 9.0, 9.0])
    status, summary = night.nightly(render_night)
    assert status == night.FAILED and "promoted toy" in summary
    assert "other: failed, its champion stays" in summary and "bad.csv: expected numbers" in summary
    alarm = json.loads(Path("woken.json").read_text())
    assert "bad.csv" in alarm["text"] and two.champion()["run"] == "night-0003"
    assert two.production_of("other") == before
    # what failed is as before, what did not is committed, and the page of both is made of the two
    stage = yaml_stages(Path("dvc.lock").read_text())
    assert stage["other"] == yaml_stages(lock)["other"] and stage["learn"] != yaml_stages(lock)["learn"]
    assert two.dirty() == ["?? datasets/raw/other/bad.csv"]
    assert Path("datasets/pages.txt").read_text() == "1 4"
    assert "Failed: other. Promoted: toy." in Path("reports/nightly.html").read_text()
    # told every night until it is mended
    assert night.nightly(render_night)[0] == night.FAILED
    bad.unlink()
    Path("datasets/raw/other/good.csv").write_text("7")
    status, summary = night.nightly(render_night)
    assert status == night.OK and "promoted other" in summary
    assert "nothing new" in night.nightly(render_night)[1]


def test_a_loop_that_cannot_be_judged_stops_no_other_and_is_told(two):
    before = two.production_of("other")
    stage = Path("other.py").read_text()
    Path("other.py").write_text(stage.replace("1 + abs(mean - 10)", "mean - mean"))
    two.run("git", "commit", "-qam", "costs of 0")
    two.record("better", [9.0, 9.0, 9.0])
    status, summary = night.nightly(render_night)
    assert status == night.FAILED and "promoted toy" in summary
    assert (
        "other: it cannot be judged, and its champion stays: datasets/other/cases.json: expected" in summary
    )
    assert "found case 0 costs 0" in summary and "found case 0 costs 0" in Path("woken.json").read_text()
    assert two.production_of("other") == before and two.champion()["run"] == "night-0003"
    assert "Failed: other. Promoted: toy." in Path("reports/nightly.html").read_text()
    assert night.nightly(render_night)[0] == night.FAILED  # told every night until it is mended
    Path("other.py").write_text(stage)
    two.run("git", "commit", "-qam", "costs again")
    Path("datasets/raw/other/good.csv").write_text("7")
    status, summary = night.nightly(render_night)
    assert status == night.OK and "promoted other" in summary


def test_the_stages_of_a_later_loop_run_where_an_earlier_one_fails_half_way(two):
    before, lock = two.production(), Path("dvc.lock").read_text()
    metrics = Path("reports/metrics/learn.json").read_bytes()
    two.record("better", [9.0, 9.0, 9.0])  # `learn` goes well, and what follows from it does not
    Path("evaluate.py").write_text("raise SystemExit('evaluate: the disk of cases is gone')")
    Path("datasets/raw/other/good.csv").write_text("7")
    status, summary = night.nightly(render_night)
    assert status == night.FAILED and "promoted other" in summary and "toy: failed" in summary
    assert "evaluate: the disk of cases is gone" in summary
    assert two.production() == before and two.champion()["run"] == "night-0001"
    # the loop that failed is as before the night, whole
    assert Path("datasets/learn/model.json").read_text() == "11.0"
    assert Path("reports/metrics/learn.json").read_bytes() == metrics
    now, then = yaml_stages(Path("dvc.lock").read_text()), yaml_stages(lock)
    assert now["learn"] == then["learn"] and now["other"] != then["other"]


def test_a_page_that_fails_alone_fails_the_night(two):
    (two.folder / "pages.py").write_text("raise SystemExit('pages: broken')")
    two.record("better", [9.0, 9.0, 9.0])
    status, summary = night.nightly(render_night)
    assert status == night.FAILED and "pages: broken" in summary and two.champion()["run"] == "night-0001"


def test_who_belongs_to_a_loop_is_read_off_the_wiring(two):
    wires = reproducing.wiring(params.load(Nightly, "nightly").loops)
    assert {stage: wires.loops(stage) for stage in wires.upstream} == {
        "learn": {"toy"}, "evaluate": {"toy"}, "other": {"other"}, "pages": {"toy", "other"},
    }  # fmt: skip


def yaml_stages(text: str) -> dict:
    import yaml

    return yaml.safe_load(text)["stages"]


@pytest.mark.slow
def test_killed_at_random_moments_of_a_night_that_loses_a_loop_both_champions_are_whole(two):
    rng = np.random.default_rng(11)
    Path("datasets/raw/other/bad.csv").write_text("x")
    began = time.monotonic()
    two.record("warm", [10.9])
    night.nightly(render_night)
    whole_s = time.monotonic() - began
    for k, share in enumerate(rng.uniform(0.02, 1.0, 8)):
        two.record(f"kill {k}", [9.9 - 0.1 * k, 10.1 + 0.05 * k])
        other = two.production_of("other")
        child = two.start()
        time.sleep(share * whole_s)
        child.send_signal(signal.SIGKILL)
        child.communicate()
        status, summary = night.nightly(render_night)
        assert status == night.FAILED and "bad.csv" in summary and "mistake" not in summary, summary
        assert champion.md5s(Path("champion/toy")) == two.champion()["files"]
        assert two.production_of("other") == other


# ---- who is told


class Server:
    """A server on this machine: what it was asked, and how it answers."""

    def __init__(self, *answers: int, hangs: bool = False):
        self.asked: list[tuple[str, str, bytes]] = []
        statuses, outer = list(answers), self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self):
                length = int(self.headers.get("Content-Length") or 0)
                outer.asked.append((self.command, self.path, self.rfile.read(length)))
                while hangs:  # a header byte by byte: the socket's own limit never ends this
                    self.wfile.write(b"X")
                    time.sleep(0.05)
                self.send_response(statuses.pop(0) if statuses else 200)
                self.end_headers()

            do_POST = do_GET

            def log_message(self, *_):
                pass

        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}/hook/s3cret?token=t0ken"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(watch, "PAUSE_S", 0.01)


def test_the_webhook_gets_a_text_and_is_tried_once_more(tmp_path, monkeypatch, quick):
    monkeypatch.chdir(tmp_path)
    server = Server(500, 200)
    details = {"night": "night-0007", "status": 1}
    assert watch.wake("failed", ["no room"], details, watch.Routes(webhook=server.url)) == []
    (method, path, body), again = server.asked
    assert again == (method, path, body) and method == "POST" and path == "/hook/s3cret?token=t0ken"
    assert json.loads(body)["text"] == "beadline: night-0007: failed: no room"
    assert json.loads(body) == json.loads(watch.ALARM.read_text())


@pytest.mark.usefixtures("must_end")
@pytest.mark.parametrize("kind", ["hangs", "refuses", "fails", "no URL", "no server", "file"])
def test_a_server_that_does_not_answer_takes_a_bounded_time_and_its_url_is_not_told(
    tmp_path, monkeypatch, quick, kind
):
    monkeypatch.chdir(tmp_path)
    url = {
        "hangs": lambda: Server(hangs=True).url,
        "fails": lambda: Server(404, 404, 404, 404).url,
        "refuses": lambda: "http://127.0.0.1:9/hook/s3cret?token=t0ken",
        "no URL": lambda: "s3cret-t0ken",
        "no server": lambda: "http://user:t0ken@s3cret:nan/",
        "file": lambda: Path("t0ken").absolute().as_uri() if Path("t0ken").write_text("s3cret") else "",
    }[kind]()
    if kind == "hangs":
        monkeypatch.setattr(watch, "ASKED_S", 0.5)
    troubles = watch.wake("failed", ["no room"], {}, watch.Routes(webhook=url, heartbeat=url)) + watch.beat(
        watch.Routes(heartbeat=url)
    )
    assert len(troubles) == 2 and "nightly.webhook" in troubles[0] and "nightly.heartbeat" in troubles[1]
    assert "s3cret" not in str(troubles).replace("http://s3cret", "") and "t0ken" not in str(troubles)


def test_an_alarm_that_is_sent_on_to_another_url_has_not_arrived(tmp_path, monkeypatch, quick):
    monkeypatch.chdir(tmp_path)

    class SendsOn(http.server.BaseHTTPRequestHandler):
        def do_GET(self):  # what a POST becomes on its way to another URL: without its body
            self.send_response(200 if self.path == "/there" else 302)
            self.send_header("Location", "/there")
            self.end_headers()

        do_POST = do_GET

        def log_message(self, *_):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), SendsOn)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    url = f"http://127.0.0.1:{server.server_port}/s3cret"
    (trouble,) = watch.wake("failed", ["no room"], {}, watch.Routes(webhook=url))
    assert "it sends on to another URL" in trouble and "s3cret" not in trouble
    assert watch.beat(watch.Routes(heartbeat=url)) == []


def test_where_no_alarm_can_be_written_the_command_reads_it_all_the_same(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path(".beadline").write_text("a file in the place of the folder")
    status, summary = night.nightly(render_night)
    assert status == night.FAILED and summary.startswith(
        "nightly: nightly failed | .beadline: expected the folder in which nights are remembered, "
        "found a file; move it away, and run it again"
    )
    code = "import sys; open('woken.json','w').write(sys.stdin.read())"
    (trouble,) = watch.wake(
        "failed", ["no room"] * 50_000, {}, watch.Routes(alarm=f'{sys.executable} -c "{code}"')
    )
    assert "the alarm could not be written" in trouble
    assert json.loads(Path("woken.json").read_text())["reasons"][-1] == "no room"


def test_a_recording_whose_name_is_no_text_is_named_and_the_night_after_its_renaming_works(project):
    odd = os.fsencode("datasets/raw/toy") + b"/caf\xe9.csv"
    Path(os.fsdecode(odd)).write_text("9")
    told(
        project,
        r"datasets/raw/toy/caf\xe9.csv: expected a name in UTF-8, found bytes that are none; rename it",
    )
    os.rename(odd, "datasets/raw/toy/café.csv")
    works_again(project, "night-0003")


@pytest.mark.parametrize(
    ("target", "words"),
    [
        ("/nowhere/b.csv", "b.csv: expected a file, found a link that leads nowhere; move it away"),
        ("b.csv", "b.csv: expected a file, found a link that leads nowhere; move it away"),  # to itself
        ("", "b.csv: expected a file, found a pipe or a device; move it away"),
        ("/proc/self/mem", "b.csv cannot be read (Input/output error); make it readable, or move it away"),
    ],
)
def test_a_recording_that_cannot_be_read_to_its_end_is_named_before_anything_waits_for_it(
    project, target, words
):
    odd = Path("datasets/raw/toy/b.csv")
    odd.symlink_to(target) if target else os.mkfifo(odd)
    told(project, words)


@pytest.mark.parametrize("artifact", ["../secret.json", "/etc/hostname", "datasets/../../x", "~/x"])
def test_an_artifact_outside_the_project_is_refused(artifact):
    changed = SETTINGS["loops"]["toy"] | {"artifacts": ["datasets/evaluate/cases.json", artifact]}
    with pytest.raises(ValueError, match="must lie in the project's folder"):
        Nightly.model_validate(SETTINGS | {"loops": {"toy": changed}})


@pytest.mark.parametrize("name", ["../evil", "a/b", ".hidden", "toy.candidate", "-x", "two words"])
def test_a_loop_whose_name_is_no_folder_in_champion_is_refused(name):
    with pytest.raises(ValueError, match=f"has loop '{name}'"):
        Nightly.model_validate(SETTINGS | {"loops": {name: SETTINGS["loops"]["toy"]}})


@pytest.mark.usefixtures("must_end")
def test_an_alarm_command_that_hangs_is_ended_and_does_not_tell_its_arguments(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(watch, "COMMAND_S", 0.5)
    # a child of its own keeps the error output open beyond the command's end
    code = "import time,subprocess; subprocess.Popen(['sleep','3600']); time.sleep(3600)"
    command = f'{sys.executable} -c "{code}" t0ken'
    (trouble,) = watch.wake("failed", ["no room"], {}, watch.Routes(alarm=command))
    assert "was ended after 0.5 s" in trouble and "t0ken" not in trouble


def test_the_heartbeat_beats_after_a_good_night_and_not_after_a_failed_one(project, monkeypatch, quick):
    server = Server()
    monkeypatch.setenv("BEADLINE_HEARTBEAT", server.url)  # the environment wins over the parameters
    assert "nothing new" in night.nightly(render_night)[1]
    assert [method for method, _, _ in server.asked] == ["GET"]
    Path("dvc.lock").write_text("<<<<<<< HEAD\n")
    assert night.nightly(render_night)[0] == night.FAILED and len(server.asked) == 1
    assert "s3cret" not in Path("reports/nightly.html").read_text()


def test_urls_of_the_parameters_are_not_printed(project, quick):
    url = "http://127.0.0.1:9/hook/s3cret"
    project.set(webhook=url, heartbeat=url, alarm="no-such-command --token t0ken")
    project.record("bad", ["x"])
    status, summary = night.nightly(render_night)
    assert status == night.FAILED and "nightly.webhook: http://127.0.0.1: Connection refused" in summary
    shown = summary + Path("reports/nightly.html").read_text()
    assert "s3cret" not in shown and "t0ken" not in shown and "no-such-command" in shown
    remembered_files = [path for path in Path(".beadline").rglob("*") if path.is_file()]
    assert remembered_files and not any(b"s3cret" in path.read_bytes() for path in remembered_files)
    # if the parameters are broken, the address is that of the last commit
    project.run("git", "commit", "-qam", "addresses")
    known = remembered.last().known()
    assert (known.webhook, known.heartbeat) == (url, url)


def test_a_file_name_is_no_tag_mention_or_picture_in_a_chat(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name = "<!channel> @all ![x](http://server/picture) & <http://server|shift>.csv"
    watch.wake("failed", [name], {}, watch.Routes())
    alarm = json.loads(watch.ALARM.read_text())
    assert alarm["reasons"] == [name]
    assert "&lt;!channel&gt;" in alarm["text"] and "<" not in alarm["text"]
    assert "@all" not in alarm["text"] and "](" not in alarm["text"] and "&amp; &lt;" in alarm["text"]


@pytest.mark.parametrize(
    "file", [".beadline/last.json", ".beadline/nights.json", "params.yaml", "champion.json"]
)
def test_the_watchdog_sees_broken_files(project, file):
    text = Path(file).read_text()
    Path(file).write_text(text[: len(text) // 2])
    alarm = "BEADLINE_ALARM" if "last" in file else ""
    if alarm:
        os.environ[alarm] = json.loads(Path("params.yaml").read_text())["nightly"]["alarm"]
    try:
        status, summary = reporting.watchdog()
    finally:
        os.environ.pop(alarm, None)
    assert status == night.FAILED and Path(file).name in summary
    assert file.split("/")[-1] in json.loads(Path("woken.json").read_text())["reasons"][0]
    assert Path(file).exists()  # a night may be at work: looking changes nothing


# ---- recordings that nobody reads


def test_a_recording_that_is_not_used_says_which_parameter_would_use_it(project):
    sections = json.loads(Path("params.yaml").read_text()) | {
        "train_ilc": SECTIONS["train_ilc"] | {"source": "simulated"}
    }
    sections["nightly"]["loops"]["deposition"] = {
        "artifacts": ["datasets/train_ilc/models.json"], "judge": "deposition", "cases": "",
        "recordings": "datasets/raw/deposition",
    }  # fmt: skip
    Path("params.yaml").write_text(json.dumps(sections))
    Path("datasets/raw/deposition").mkdir()
    Path("datasets/raw/deposition/trial.mcap").write_bytes(b"x")
    night.nightly(render_night)
    sentence = (
        "datasets/raw/deposition/trial.mcap is not used, for train_ilc.source is simulated; set "
        "train_ilc.source: recordings in params.yaml to learn from what is recorded"
    )
    assert sentence in remembered.nights()[-1].notes
    settings = params.load(Nightly, "nightly").loops["deposition"]
    sections["train_ilc"]["source"] = "recordings"
    Path("params.yaml").write_text(json.dumps(sections))
    assert night._unused(settings, ["datasets/raw/deposition/trial.mcap"]) == ""
