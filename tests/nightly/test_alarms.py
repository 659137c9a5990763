"""Whatever goes wrong in a night, somebody is told, in bounded time, and no secret with it."""

import html
import http.server
import json
import os
import sys
import threading
import time
from pathlib import Path

import pytest

from pipeline.cli import render_night
from pipeline.nightly import night, promoting, remembered, reporting, reproducing, watch, worktree
from pipeline.nightly.records import Night
from pipeline.nightly.settings import Nightly
from tests.nightly.toy_nights import SETTINGS, Project


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """The project after its first night; its alarm copies the JSON file to woken.json."""
    project = Project(tmp_path_factory.mktemp("alarms") / "toy").make()
    project.set(alarm=f"{sys.executable} -c \"import sys,shutil; shutil.copy(sys.argv[1], 'woken.json')\"")
    (project.folder / ".gitignore").write_text("/reports/*.html\n/woken.json\n")
    project.run("git", "commit", "-qam", "an alarm")
    return project.promoted()


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(watch, "PAUSE_S", 0.01)


def told(project: Project, *words: str) -> None:
    """Status 1, alarm, command and page all name these; production is that of the first night."""
    before, woken = project.production(), project.folder / "woken.json"
    woken.unlink(missing_ok=True)
    status, summary = night.nightly(render_night)
    alarm, page = json.loads(woken.read_text()), html.unescape(Path("reports/nightly.html").read_text())
    assert status == reporting.FAILED and alarm["kind"] == "failed"
    for word in words:
        assert all(word in text for text in (summary, str(alarm["reasons"]), page)), (word, summary)
    assert "Traceback" not in summary
    assert project.production() == before and project.champion()["run"] == "night-0001"


# ---- what goes wrong


@pytest.mark.parametrize(
    ("file", "content", "words"),
    [
        ("params.yaml", b"nightly: {", ["params.yaml"]),
        ("params.yaml", b"\xff\xfe", ["params.yaml"]),
        ("dvc.yaml", b"<<<<<<< HEAD\n", ["dvc.yaml: expected stages"]),
        ("dvc.lock", b"stages: [", ["dvc.lock: expected stages"]),
        (
            "champion.json",
            b'{"champions": {"toy": {}}}',
            ["champions.toy.run of another form", "good commit"],
        ),
    ],
)
def test_a_broken_file_is_named_and_somebody_is_woken_as_the_last_commit_says(project, file, content, words):
    Path(file).write_bytes(content)
    if file == "champion.json":
        project.run("git", "commit", "-qam", "broken")
        status, summary = night.nightly(render_night)
        assert status == reporting.FAILED and all(word in summary for word in words)
        return
    told(project, *words)
    assert reporting.watchdog()[0] == (reporting.FAILED if file == "params.yaml" else reporting.OK)


def test_bad_data_an_empty_folder_and_a_name_that_is_no_text_are_told(project):
    bad = project.record("bad", ["x"])
    told(project, "learn: datasets/raw/toy/bad.csv: expected numbers, found none; mend the file")
    bad.unlink()
    (project.folder / "datasets/raw/toy/first.csv").rename(project.folder / "first.csv")
    told(project, "expected at least one recording, found none")
    (project.folder / "first.csv").rename(project.folder / "datasets/raw/toy/first.csv")
    odd = os.fsencode(project.folder / "datasets/raw/toy") + b"/\xff.csv"
    Path(os.fsdecode(odd)).write_text("9")
    told(project, "expected a name in UTF-8")
    os.unlink(odd)
    os.mkfifo("datasets/raw/toy/pipe.csv")
    told(project, "found a pipe or a device")


def test_stages_that_take_too_long_and_a_disk_without_room_are_told(project):
    alarm = json.loads(Path("params.yaml").read_text())["nightly"]["alarm"]
    project.set(alarm=alarm, longest_h=0.001)
    Path("slow.txt").write_text("3600")
    project.record("second", [9.5])
    told(project, "dvc repro --keep-going was ended after 0.001 h (nightly.longest_h)")
    project.set(alarm=alarm, least_free_mb=1e7)
    told(project, "nightly.least_free_mb")


@pytest.mark.parametrize(
    ("place", "name"),
    [(worktree, "take"), (reproducing, "reproduce"), (promoting, "judge_all"), (night.landing, "commit"),
     (remembered, "write")],
)  # fmt: skip
def test_a_mistake_of_this_program_is_told_in_a_sentence_with_its_traceback_in_the_log(
    project, monkeypatch, place, name
):
    def break_down(*_, **__):
        raise KeyError("unforeseen")

    project.record("better", [9.0, 9.0, 9.0])
    with monkeypatch.context() as context:
        context.setattr(place, name, break_down)
        status, summary = night.nightly(render_night)
    assert status == reporting.FAILED and "a mistake of this program (KeyError: 'unforeseen')" in summary
    assert "unforeseen" in Path(".beadline/logs/night-0002.log").read_text()
    assert "unforeseen" in Path("woken.json").read_text()
    # a night that could not be remembered has promoted all the same
    promoted = name == "write"
    assert project.champion()["run"] == ("night-0002" if promoted else "night-0001")


def test_a_night_that_cannot_even_begin_wakes_the_command_by_its_input(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path(".beadline").write_text("a file in the place of the folder")
    command = f"{sys.executable} -c \"import sys; open('heard','w').write(sys.stdin.read())\""
    monkeypatch.setenv("BEADLINE_ALARM", command)
    status, summary = night.nightly(render_night)
    assert status == reporting.FAILED and ".beadline: expected the folder" in summary
    assert ".beadline: expected the folder" in json.loads(Path("heard").read_text())["text"]


# ---- who is told


class Server:
    """A server on this machine: what it was asked, and how it answers."""

    def __init__(self, *answers: int, hangs: bool = False, location: str = ""):
        self.asked: list[tuple[str, str, bytes]] = []
        statuses, outer = list(answers), self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self):
                length = int(self.headers.get("Content-Length") or 0)
                outer.asked.append((self.command, self.path, self.rfile.read(length)))
                while hangs:  # a header byte by byte: the socket's own limit never ends this
                    self.wfile.write(b"X")
                    time.sleep(0.05)
                sends_on = location and self.path != location
                self.send_response(302 if sends_on else statuses.pop(0) if statuses else 200)
                if sends_on:
                    self.send_header("Location", location)
                self.end_headers()

            do_POST = do_GET

            def log_message(self, *_):
                pass

        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}/hook/s3cret?token=t0ken"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()


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
@pytest.mark.parametrize("kind", ["hangs", "refuses", "fails", "sends on", "no URL", "no server", "file"])
def test_a_server_that_does_not_answer_takes_a_bounded_time_and_its_url_is_not_told(
    tmp_path, monkeypatch, quick, kind
):
    monkeypatch.chdir(tmp_path)
    url = {
        "hangs": lambda: Server(hangs=True).url,
        "fails": lambda: Server(404, 404, 404, 404).url,
        "sends on": lambda: Server(location="/there").url,
        "refuses": lambda: "http://127.0.0.1:9/hook/s3cret?token=t0ken",
        "no URL": lambda: "s3cret-t0ken",
        "no server": lambda: "http://user:t0ken@s3cret:nan/",
        "file": lambda: Path("t0ken").absolute().as_uri() if Path("t0ken").write_text("s3cret") else "",
    }[kind]()
    if kind == "hangs":
        monkeypatch.setattr(watch, "ASKED_S", 0.5)
    troubles = watch.wake("failed", ["no room"], {}, watch.Routes(webhook=url))
    beats = watch.beat(watch.Routes(heartbeat=url))
    assert len(troubles) == 1 and "nightly.webhook" in troubles[0]
    # a heartbeat may be sent on: it has no body that is lost
    assert len(beats) == (kind != "sends on")
    assert "s3cret" not in str(troubles + beats).replace("http://s3cret", "")
    assert "t0ken" not in str(troubles + beats)


@pytest.mark.usefixtures("must_end")
def test_an_alarm_command_that_hangs_is_ended_and_does_not_tell_its_arguments(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(watch, "COMMAND_S", 0.5)
    # a child of its own keeps the error output open beyond the command's end
    code = "import time,subprocess; subprocess.Popen(['sleep','3600']); time.sleep(3600)"
    command = f'{sys.executable} -c "{code}" t0ken'
    (trouble,) = watch.wake("failed", ["no room"], {}, watch.Routes(alarm=command))
    assert "was ended after 0.5 s" in trouble and "t0ken" not in trouble


def test_a_webhook_of_the_parameters_stands_in_no_state_file_and_on_no_page(project, quick):
    server = Server()
    project.set(webhook=server.url, heartbeat=server.url, alarm="no-such-command --token t0ken")
    project.record("bad", ["x"])
    status, summary = night.nightly(render_night)
    assert status == reporting.FAILED and [method for method, _, _ in server.asked] == ["POST"]
    assert "no-such-command could not be started" in summary
    Path("datasets/raw/toy/bad.csv").unlink()
    assert night.nightly(render_night)[0] == reporting.OK and server.asked[-1][0] == "GET"
    shown = summary + Path("reports/nightly.html").read_text()
    assert "s3cret" not in shown and "t0ken" not in shown and "no-such-command" in shown
    files = [path for path in Path(".beadline").rglob("*") if path.is_file()]
    assert files and not any(b"s3cret" in path.read_bytes() for path in files)
    # if the parameters are broken, the address is that of the last commit
    project.run("git", "commit", "-qam", "addresses")
    assert watch.find_routes(None).webhook == server.url


def test_a_file_name_is_no_tag_mention_picture_or_emphasis_in_a_chat(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name = "<!channel> @all ![x](http://server/picture) & *b* _i_ `c` ~s~ <http://server|shift_12>.csv"
    watch.wake("failed", [name], {}, watch.Routes())
    alarm = json.loads(watch.ALARM.read_text())
    assert alarm["reasons"] == [name]
    assert "&lt;!channel&gt;" in alarm["text"] and "&amp; " in alarm["text"] and "shift_12" in alarm["text"]
    for markup in ("<", "@all", "](", "*b", "b*", "_i", "i_", "`", "~"):
        assert markup not in alarm["text"]


def test_used_shares_are_said_in_the_summary():
    used = {"datasets/raw/t/shift_12.mcap": (61.4, 2.0, 38.0), "b.csv": (100.0, 0.0, 0.0)}
    keys = ("used_percent", "masked_percent", "cut_percent")
    shares = {path: dict(zip(keys, share, strict=True)) for path, share in used.items()}
    summary = reporting.summarise(Night(1, "night-0001", "", "kept", used=shares), [])
    assert "used 61 % of shift_12.mcap, masked, cut" in summary and "used 100 % of b.csv |" in summary


# ---- what is no setting


@pytest.mark.parametrize("artifact", ["/etc/passwd", "~/x", "datasets/../../x"])
def test_an_artifact_outside_the_project_is_refused(artifact):
    changed = SETTINGS["loops"]["toy"] | {"artifacts": ["datasets/evaluate/cases.json", artifact]}
    with pytest.raises(ValueError, match="must lie in the project's folder"):
        Nightly.model_validate(SETTINGS | {"loops": {"toy": changed}})


@pytest.mark.parametrize("name", ["../evil", "a/b", ".hidden", "toy.candidate", "-x", "two words"])
def test_a_loop_whose_name_is_no_folder_in_champion_is_refused(name):
    with pytest.raises(ValueError, match=f"has loop '{name}'"):
        Nightly.model_validate(SETTINGS | {"loops": {name: SETTINGS["loops"]["toy"]}})
