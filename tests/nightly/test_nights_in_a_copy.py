"""Nights of a toy project: what they use, what they change, and what they leave alone."""

import datetime
import fcntl
import json
import os
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from pipeline.cli import render_night
from pipeline.nightly import by_hand, champion, night, processes, remembered, reporting, worktree
from pipeline.store import artifacts
from tests.nightly.toy_nights import DVC, SETTINGS, Project, entered

OTHER = """
  other:
    cmd: python other.py
    deps: [other.py, datasets/raw/other]
    outs: [datasets/other: {persist: true}]
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
"""
PAGES_STAGE = """
import json, pathlib
costs = []
for name in ("evaluate", "other"):
    cases = json.loads(pathlib.Path(f"datasets/{name}/cases.json").read_text())["cases"]
    costs.append(f"{cases['case 0']['cost']:g}")
pathlib.Path("datasets/pages.txt").write_text(" ".join(costs))
"""


def run(status: int = reporting.OK) -> str:
    """The summary of a night that ends with this status, and leaves nothing on its table."""
    ended, summary = night.nightly(render_night)
    assert ended == status, summary
    assert not worktree.COPY.exists() and not Path(".beadline/landing.json").exists()
    assert "mistake of this program" not in summary
    return summary


def learned() -> float:
    return json.loads(Path("datasets/learn/model.json").read_text())


# ---- what is used


def test_a_new_recording_and_uncommitted_files_are_used_and_all_is_on_the_disk_before_the_commit(
    project, monkeypatch
):
    (project.folder / "learn.py").write_text(Path("learn.py").read_text() + "\nimport helper\n")
    (project.folder / "helper.py").write_text("assert True")
    project.record("new", [9.0, 9.0, 9.0])
    written, on_disk, write, move = [], [], champion._write_through, night.landing.move
    monkeypatch.setattr(champion, "_write_through", lambda path: written.append(path.name) or write(path))
    monkeypatch.setattr(night.landing, "move", lambda *to: on_disk.extend(written) or move(*to))
    summary, present = run(), champion.read().champions["toy"]
    assert "promoted toy" in summary and "not committed: learn.py" in summary
    assert learned() == 10.0 and project.production()["learn/model.json"] == b"10.0"
    assert present.lineage["uncommitted"] == ["learn.py"]
    assert {md5[2:] for md5 in (present.md5, *present.files.values())} <= {*on_disk}
    # the commit names the recording, and what was made of it
    paths = project.run("git", "show", "--name-only", "--format=", "HEAD").stdout.split()
    assert {"datasets/raw/toy/new.csv", "dvc.lock", "champion.json", "champion/toy.dvc"} <= {*paths}
    assert all(
        path.startswith(("reports/metrics/", "datasets/raw", "champion", "dvc.lock")) for path in paths
    )
    assert project.dirty() == [" M learn.py", "?? helper.py"] and not list(Path().glob("**/.venv"))
    tags = project.run("git", "tag", "--points-at", "HEAD").stdout.split()
    assert tags == ["production/toy/night-0002"]


def test_recordings_that_dvc_keeps_are_used_and_their_pointer_moves(project):
    project.run("git", "rm", "-rq", "--cached", "datasets/raw/toy")
    project.run("dvc", "add", "-q", "datasets/raw/toy")
    project.run("git", "add", "-A")
    project.run("git", "commit", "-qm", "recordings are kept by DVC")
    pointer = Path("datasets/raw/toy.dvc").read_text()
    project.record("new", [9.0, 9.0, 9.0])
    assert "promoted toy" in run()
    assert learned() == 10.0 and Path("datasets/raw/toy.dvc").read_text() != pointer
    assert project.dirty() == [] and project.run("dvc", "status", "-q").returncode == 0


def test_the_remote_is_reached_by_a_path_of_this_project_and_a_clone_has_the_champion(project, tmp_path):
    project.run("dvc", "remote", "add", "-q", "--local", "store", "../store")
    project.set(remote="store")
    project.run("git", "commit", "-qam", "a remote")
    project.record("new", [9.0, 9.0, 9.0])
    assert "promoted toy" in run()
    project.run("git", "clone", "-q", str(project.folder), str(tmp_path / "clone"))
    clone = Project(tmp_path / "clone")
    clone.run("dvc", "remote", "add", "-q", "-d", "store", str(tmp_path / "store"))
    clone.run("dvc", "pull", "-q")
    assert clone.production() == project.production()
    # one that cannot be reached fails the night, whose commit stays, and the next one tries again
    project.set(remote="nowhere")
    project.record("better", [9.0, 10.0, 11.0, 8.0])
    assert "is not on the remote" in run(reporting.FAILED)
    project.set(remote="store")
    assert "nothing new" not in run()


def test_idle_nights_are_counted_and_a_change_of_code_or_parameters_is_something_new(project):
    assert "no new recording: drift was not measured" in run()
    assert "no new recording for 2 nights" in run()
    for idle, file in enumerate(("learn.py", "params.yaml", "params.expert.yaml"), 3):
        Path(file).write_text(Path(file).read_text() + "\n# another comment\n")
        summary = run()
        assert f"no new recording for {idle} nights" in summary and "nothing new" not in summary
        assert "not committed: " in summary and file in summary
    assert remembered.read().nights[-1].idle == 5 and "nothing new" in run()
    project.record("new", [9.0])
    assert "no new recording" not in run()


def test_a_recording_that_is_not_used_says_which_parameter_would_use_it(project):
    loop = {"judge": "deposition", "cases": "", "recordings": "datasets/raw/deposition", "artifacts": ["a"]}
    project.set(loops=SETTINGS["loops"] | {"deposition": loop})
    sections = json.loads(Path("params.yaml").read_text())
    sections["train_ilc"]["source"] = "simulated"
    Path("params.yaml").write_text(json.dumps(sections))
    Path("datasets/raw/deposition").mkdir()
    Path("datasets/raw/deposition/trial.mcap").write_bytes(b"x")
    sentence = (
        "datasets/raw/deposition/trial.mcap is not used, for train_ilc.source is simulated; set "
        "train_ilc.source: recordings in params.yaml to learn from what is recorded"
    )
    night.nightly(render_night)
    assert sentence in remembered.read().nights[-1].notes
    sections["train_ilc"]["source"] = "recordings"
    Path("params.yaml").write_text(json.dumps(sections))
    night.nightly(render_night)
    assert not any("is not used" in note for note in remembered.read().nights[-1].notes)


# ---- promote, keep, roll back


def test_a_dry_run_names_what_is_new_and_changes_nothing(project):
    idle = project.beadline("nightly", "--dry-run")
    assert (idle.returncode, idle.stderr) == (0, "") and "a run would do nothing" in idle.stdout
    project.record("new", [9.0, 9.0])
    files = project.run("git", "status", "--porcelain").stdout
    new = project.beadline("nightly", "--dry-run")
    assert "new recordings: " in new.stdout and "new" in new.stdout.split("recordings: ")[1]
    assert "learn and compare toy" in new.stdout
    assert project.run("git", "status", "--porcelain").stdout == files


def test_a_worse_challenger_stays_out_and_rollback_goes_back_bit_by_bit_for_good(project):
    one, head = project.production(), project.head()
    worse = project.record("worse", [30.0])
    assert "kept" in run() and "the challenger is no better" in remembered.read().nights[-1].reasons[0]
    assert project.production() == one and learned() == 15.75
    assert project.head() != head and champion.read().champions["toy"].run == "night-0001"
    assert project.dirty() == []
    worse.unlink()
    project.record("better", [9.5, 9.5])
    run()
    two = project.production()
    project.record("best", [9.0])
    run()
    assert len({str(files) for files in (one, two, project.production())}) == 3
    before = project.run("git", "rev-parse", "HEAD").stdout
    foretold = project.beadline("nightly", "--rollback", "--dry-run")
    assert foretold.stdout == "rollback, dry run: toy would be night-0003 again; nothing was changed\n"
    assert project.run("git", "rev-parse", "HEAD").stdout == before
    assert by_hand.rollback("", "").startswith("rollback: toy is night-0003 again")
    assert project.production() == two
    by_hand.rollback("", "")
    assert project.production() == one and project.dirty() == []
    Path("learn.py").write_text(Path("learn.py").read_text() + "# the same challenger again\n")
    assert "which was rolled back by hand" in run() and project.production() == one
    for to, loop, sentence in (
        ("night-0001", "", "night-0001 is in production already"),
        ("night-0042", "", "known are: night-0001 \\(toy\\), night-0003 \\(toy\\)"),
        ("", "other", "found other; loops with a champion are: toy"),
    ):
        with pytest.raises(ValueError, match=sentence):
            by_hand.rollback(to, loop)
    words = ("night-0001", "toy", "toy/night-0001", "production/toy/night-0001", "")
    assert [by_hand.named(word) for word in words] == [
        *(("night-0001", ""), ("", "toy"), *2 * [("night-0001", "toy")], ("", ""))
    ]


def test_a_champion_whose_files_no_cache_and_no_remote_has_is_not_gone_back_to(project):
    project.record("better", [9.0, 9.0, 9.0])
    run()
    after, earlier = project.production(), champion.read().history[0].champion
    for md5 in (earlier.files["learn/weights.bin"], earlier.md5):  # a file, and the list of them all
        Path(".dvc/cache/files/md5", md5[:2], md5[2:]).unlink()
        with pytest.raises(ValueError, match="is not what it was in night-0001; bring DVC's cache"):
            by_hand.rollback("", "")
        assert project.production() == after and project.dirty() == [] and not worktree.COPY.exists()


@pytest.fixture(scope="module")
def second_loop(first, tmp_path_factory):
    """The project with a second loop, and a page that belongs to both, after the night that promoted both."""
    two = Project(tmp_path_factory.mktemp("two") / "toy")
    two.run("cp", "-a", f"{first.folder}/.", ".")
    texts = {"dvc.yaml": DVC + OTHER, "other.py": OTHER_STAGE, "pages.py": PAGES_STAGE}
    for name, text in texts.items() | {("datasets/raw/other/a.csv", "13")}:
        (two.folder / name).parent.mkdir(exist_ok=True)
        (two.folder / name).write_text(text)
    own = {"judge": "cases", "cases": "datasets/other/cases.json", "recordings": "datasets/raw/other"}
    two.set(loops=SETTINGS["loops"] | {"other": own | {"artifacts": ["datasets/other/cases.json"]}})
    two.run("git", "add", "-A")
    two.run("git", "commit", "-q", "-m", "a second loop")
    return two.promoted("other")


@pytest.fixture
def two(second_loop, tmp_path, monkeypatch):
    return entered(second_loop, tmp_path / "toy", monkeypatch)


def test_a_loop_that_fails_stops_no_other_and_is_told_until_it_is_mended(two):
    before, bad = two.production_of("other"), Path("datasets/raw/other/bad.csv")
    bad.write_text("x")
    two.record("better", [9.0, 9.0, 9.0])
    summary = run(reporting.FAILED)
    assert "promoted toy" in summary and "other: failed, its champion stays" in summary
    assert "bad.csv: expected numbers" in summary
    assert "bad.csv" in artifacts.read_json(".beadline/alarm.json")["text"]
    # the page of both is made of what went well, and of the other as it was
    assert two.production_of("other") == before and Path("datasets/pages.txt").read_text() == "1 4"
    assert "Failed: other. Promoted: toy." in Path("reports/nightly.html").read_text()
    run(reporting.FAILED)
    bad.write_text("7")
    assert "promoted other" in run()
    assert "nothing new" in run()


def test_half_a_loop_is_put_back_and_costs_that_are_none_are_told(two):
    two.record("better", [9.0, 9.0, 9.0])  # `learn` goes well, and what follows from it does not
    Path("evaluate.py").write_text("raise SystemExit('evaluate: the disk of cases is gone')")
    Path("datasets/raw/other/good.csv").write_text("7")
    summary = run(reporting.FAILED)
    assert "promoted other" in summary and "evaluate: the disk of cases is gone" in summary
    assert learned() == 11.0 and champion.read().champions["toy"].run == "night-0001"
    two.run("git", "checkout", "-q", "evaluate.py")
    Path("other.py").write_text(OTHER_STAGE.replace("1 + abs(mean - 10)", "mean - mean"))
    summary = run(reporting.FAILED)
    assert "promoted toy" in summary and "other: it cannot be judged, and its champion stays" in summary
    (two.folder / "pages.py").write_text("raise SystemExit('pages: broken')")
    assert "pages: broken" in run(reporting.FAILED)


# ---- the owner at work meanwhile


def during_the_stages(monkeypatch, act) -> None:
    """Calls `act` in the project when the stages have run in the copy."""
    reproduce = night.reproducing.reproduce

    def and_act(*arguments, **settings):
        made = reproduce(*arguments, **settings)
        with worktree.contextlib.chdir(Path("../..")):
            act()
        return made

    monkeypatch.setattr(night.reproducing, "reproduce", and_act)


def test_what_the_owner_commits_edits_and_stages_meanwhile_stays(project, monkeypatch):
    def work():
        Path("notes.md").write_text("one")
        project.run("git", "add", "notes.md")
        project.run("git", "commit", "-qm", "notes")
        Path("notes.md").write_text("two")
        project.run("git", "add", "notes.md")
        Path("reports/metrics/learn.json").write_text("edited")
        project.record("later", [50.0])
        # a young recording may still grow: what is used of it is what was there
        Path("datasets/raw/toy/better.csv").open("a").write("\n50.0")

    during_the_stages(monkeypatch, work)
    project.record("better", [9.0, 9.0, 9.0])
    summary = run()
    assert "promoted toy" in summary
    assert "reports/metrics/learn.json was edited meanwhile and is left as it is" in summary
    history = project.run("git", "log", "--format=%s", "-3").stdout.splitlines()
    assert history[0].startswith("nightly night-0002: promoted toy") and history[1] == "notes"
    states = {"M  notes.md", " M reports/metrics/learn.json", "?? datasets/raw/toy/later.csv"}
    states.add(" M datasets/raw/toy/better.csv")
    assert {*project.dirty()} == states and learned() == 10.0


@pytest.mark.parametrize("act", ["commits", "switches", "records"])
def test_what_the_night_is_made_from_changes_meanwhile_and_nothing_is_changed(project, monkeypatch, act):
    recording = project.record("old", [9.0, 9.0, 9.0])
    os.utime(recording, (1e9, 1e9))

    def commit():
        Path("learn.py").write_text(Path("learn.py").read_text() + "# later\n")
        project.run("git", "commit", "-qam", "other code")

    acts = {
        "commits": (commit, "learn.py was committed while the night ran"),
        "switches": (
            lambda: project.run("git", "switch", "-qc", "experiment"),
            "refs/heads/experiment was checked out while the night ran",
        ),
        "records": (
            lambda: recording.open("a").write("\n50.0\n"), "old.csv changed while the stages ran"
        ),
    }  # fmt: skip
    before, main = project.production(), project.head()
    with monkeypatch.context() as context:
        during_the_stages(context, acts[act][0])
        assert acts[act][1] in run(reporting.FAILED)
    assert project.production() == before and learned() == 11.0
    assert recording.read_text().endswith("50.0\n") == (act == "records")
    assert (
        not project.run("git", "tag", "--contains", main)
        .stdout.replace("production/toy/night-0001", "")
        .strip()
    )
    project.run("git", "switch", "-q", "main")
    recording.write_text("9.0\n9.0\n9.0")
    assert "promoted toy" in run()


def test_a_second_night_is_refused_and_so_is_half_a_merge(project):
    with Path(".beadline/lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        status, summary = night.nightly(render_night)
        assert status == reporting.BUSY == 75 and "another night is at work" in summary
    project.run("git", "switch", "-qc", "other")
    project.set(watch_h=1)
    project.run("git", "commit", "-qam", "other")
    project.run("git", "switch", "-q", "main")
    project.set(watch_h=2)
    project.run("git", "commit", "-qam", "main")
    project.run("git", "merge", "-q", "other", check=False)
    run(reporting.FAILED)
    project.run("git", "checkout", "-q", "--ours", "params.yaml")
    assert "a merge is half done in git" in run(reporting.FAILED)


def test_promotions_on_a_branch_touch_nothing_and_are_merged_by_git(project, tmp_path):
    project.run("git", "init", "-q", "--bare", str(tmp_path / "server"))
    project.run("git", "remote", "add", "origin", str(tmp_path / "server"))
    project.set(promotion="branch")
    project.run("git", "commit", "-qam", "a person decides")
    before, head = project.production(), project.head()
    for k, value in enumerate((9.5, 9.0)):
        project.record(f"better {k}", [value, value])
        summary = run()
        assert "promoted toy on branch nightly" in summary and "git merge nightly" in summary
        # the branch has the night's proposal over what is in production, and only moves forward
        assert project.run("git", "ls-remote", "origin", "nightly").stdout[:40] == (
            project.run("git", "rev-parse", "nightly").stdout.strip()
        )
    assert project.production() == before and project.head() == head and learned() == 11.0
    assert len(project.run("git", "rev-list", "main..nightly").stdout.split()) == 2
    for path in Path("datasets/raw/toy").glob("better*"):
        path.unlink()  # git brings them again
    project.run("git", "merge", "-q", "nightly")
    Path("learn.py").write_text(Path("learn.py").read_text() + "# something new\n")
    run()
    present = champion.read().champions["toy"]
    assert present.run == "night-0003" and champion.md5s(Path("champion/toy")) == present.files
    project.set(promotion="branch", branch="main")
    assert "expected a branch apart from the one that is in production" in run(reporting.FAILED)


# ---- kills, disks, clocks, broken files


@pytest.mark.slow
def test_killed_at_random_moments_all_is_as_before_or_as_after(project):
    """The kill ends the night and what it started. HEAD and production are those of one of the two, or a note
    says that the landing is to be finished; the next night runs through."""
    rng = np.random.default_rng(7)
    project.record("warm", [10.9])
    began = datetime.datetime.now(datetime.UTC)
    assert project.night().returncode == 0
    whole_s = (datetime.datetime.now(datetime.UTC) - began).total_seconds()
    for k, share in enumerate(rng.uniform(0.05, 1.0, int(os.environ.get("BEADLINE_KILLS", "8")))):
        head, production, data = project.head(), project.production(), learned()
        project.record(f"kill {k}", [9.9 - 0.1 * k, 10.1 + 0.05 * k])
        child = project.start(start_new_session=True)
        try:
            child.wait(share * whole_s)
        except subprocess.TimeoutExpired:
            # what dvc runs has a session of its own, and goes on: as when the memory's guard kills the night
            os.killpg(child.pid, 9)
        child.communicate()
        lands = Path(".beadline/landing.json").exists()
        if not lands and project.head() == head:
            assert (project.production(), learned()) == (production, data)
        status, summary = night.nightly(render_night)
        assert status == reporting.OK, f"after a kill at {share:.2f} of a night: {summary}"
        present = champion.read().champions["toy"]
        assert champion.md5s(Path("champion/toy")) == present.files and project.dirty() == []
        lock = Path("dvc.lock").read_bytes()
        assert project.run("git", "show", "HEAD:dvc.lock").stdout.encode() == lock
        assert project.run("dvc", "status", "-q").returncode == 0
    subprocess.run(["git", "fsck", "--strict"], check=True, capture_output=True)


def test_the_stages_of_a_night_that_is_killed_end_with_it(project):
    Path("slow.txt").write_text("3600")
    project.record("better", [9.0])
    child = project.start()

    def find_running() -> list[str]:
        """Command lines of the processes that work in the copy."""
        found = []
        for entry in Path("/proc").glob("[0-9]*"):
            try:
                if Path(os.readlink(entry / "cwd")).is_relative_to(worktree.COPY.resolve()):
                    found.append((entry / "cmdline").read_text())
            except OSError:
                continue
        return found

    def wait_for(stages: bool) -> None:
        for _ in range(600):
            if any("learn.py" in words for words in find_running()) == stages:
                return
            time.sleep(0.1)

    wait_for(stages=True)
    assert find_running()
    child.kill()  # the night alone: what DVC runs has a session of its own
    child.communicate()
    wait_for(stages=False)
    assert find_running() == []
    Path("slow.txt").write_text("0")
    assert "the night before was killed" in run() and not worktree.OLD.exists()


def test_the_lock_of_a_git_that_works_stays_and_that_of_one_that_was_killed_goes(project):
    lock = Path(".git/index.lock")
    Path("learn.py").write_text(Path("learn.py").read_text() + "# other code\n")
    editing = subprocess.Popen(
        ["git", "commit", "-aq"],
        env=os.environ | {"GIT_EDITOR": "sleep 60 #"},
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    while not lock.exists():
        time.sleep(0.05)
    processes.remove_stale_locks()
    assert lock.exists()
    os.killpg(editing.pid, 9)
    editing.wait()
    assert lock.exists()
    processes.remove_stale_locks()
    assert not lock.exists()


@pytest.mark.parametrize(
    ("step", "then"),
    [("_bring_files", "night"), ("checkout", "rollback"), ("follow", "night"), ("exchange", "rollback")],
)
def test_killed_between_the_commit_and_its_end_the_next_one_finishes(project, monkeypatch, step, then):
    place = {"_bring_files": night.landing, "exchange": champion, "follow": champion}.get(step, worktree)
    before = project.production()
    project.record("better", [9.0, 9.0, 9.0])
    real, calls = getattr(place, step), []

    def kill(*arguments):
        # the first calls are those of the copy, or of a clean start
        calls.append(arguments)
        if project.head() != began:
            raise KeyboardInterrupt
        return real(*arguments)

    began = project.head()
    with monkeypatch.context() as context, pytest.raises(KeyboardInterrupt):
        context.setattr(place, step, kill)
        night.nightly(render_night)
    assert project.head() != began and Path(".beadline/landing.json").exists()
    assert project.production() == before
    if then == "night":
        run()
        assert project.production()["learn/model.json"] == b"10.0"
    else:
        by_hand.rollback("", "")
        assert project.production() == before
    assert learned() == 10.0 and project.dirty() == []
    assert champion.md5s(Path("champion/toy")) == champion.read().champions["toy"].files


def test_a_note_whose_commit_never_landed_is_forgotten(project, monkeypatch):
    project.record("better", [9.0, 9.0, 9.0])

    def kill(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as context, pytest.raises(KeyboardInterrupt):
        context.setattr(night.landing, "move", kill)
        night.nightly(render_night)
    lock = Path(".git/refs/heads/main.lock")
    lock.touch()  # as git leaves it if it is killed there
    Path(".beadline/index.lock").touch()
    assert "the night before was killed" in run() and not lock.exists()
    assert champion.read().champions["toy"].run == "night-0002" and project.dirty() == []


@pytest.mark.parametrize("room_mb", [0.3, 1.5, 3.0])
def test_a_full_disk_is_a_failed_night_that_says_so(project, tmp_path, room_mb):
    """The project on a disk of its own, which fills up in the night."""
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=24m", "tmpfs", disk], check=False).returncode:
        pytest.skip("no disk may be mounted here; run it as root to fill one")
    try:
        project.record("better", [9.0, 9.0, 9.0])
        subprocess.run(["cp", "-a", f"{project.folder}/.", disk], check=True)
        full = Project(disk)
        before, head = full.production(), full.head()
        free = os.statvfs(disk).f_bavail * os.statvfs(disk).f_frsize
        (disk / ".git/filler").write_bytes(b"0" * int(free - room_mb * 1e6))
        ended = full.night()
        assert ended.returncode == reporting.FAILED, ended
        assert "o space left on device" in ended.stderr or "nightly.least_free_mb" in ended.stderr
        assert full.production() == before and full.head() == head
        (disk / ".git/filler").unlink()
        ended = full.night()
        assert ended.returncode == 0 and "promoted toy" in ended.stdout, ended
    finally:
        subprocess.run(["umount", "-l", disk], check=True)


def test_a_broken_memory_is_told_by_the_watchdog_and_set_aside_by_the_night(project):
    for text in ("", '{"night": "one"}', "<<<<<<< HEAD", '{"nights": {}}'):
        remembered.FILE.write_text(text)
        status, summary = reporting.watchdog()
        assert status == reporting.FAILED and str(remembered.FILE) in summary and remembered.FILE.exists()
    assert f"it is set aside as {remembered.FILE}.broken" in run()
    assert "nothing new" in run()
