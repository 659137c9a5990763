"""The nightly job's mechanics, on a toy project in a git repository of its own: what a scheduler meets."""

import datetime
import fcntl
import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from pipeline.cli import render_night
from pipeline.nightly import (
    champion,
    guarding,
    inputs,
    night,
    processes,
    remembered,
    reporting,
    screening,
    watch,
)
from pipeline.nightly.records import Champion
from tests.nightly.toy_nights import Project, entered

TOMORROW = datetime.timedelta(days=1)


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """The project after its first night: mean 11, the champion of night-0001."""
    return Project(tmp_path_factory.mktemp("nights") / "toy").make().promoted()


@pytest.fixture
def project(first, tmp_path, monkeypatch):
    """A copy of it, and this process in it, as the job is."""
    return entered(first, tmp_path / "toy", monkeypatch)


def test_a_night_without_new_data_plays_no_stage_and_commits_nothing(project, started):
    head = project.head()
    ended = project.night()
    assert ended.returncode == 0 and "nothing new" in ended.stdout
    assert project.head() == head and project.dirty() == []
    # it is done in seconds because it starts no DVC that plays stages
    started.clear()
    assert "nothing new" in night.nightly(render_night)[1]
    assert started and not [command for command in started if "repro" in command]


def test_a_better_challenger_is_promoted_and_the_champion_before_it_comes_back_bit_by_bit(project, started):
    before, name = project.production(), project.champion()["folder"]["md5"]
    project.record("second", [9.0, 9.0, 9.0])  # the mean of all is 10, the truth
    status, summary = night.nightly(render_night)
    assert status == night.OK and "promoted toy" in summary
    assert project.production() != before and project.champion()["run"] == "night-0002"
    assert project.champion()["files"] == champion.md5s(project.folder / "champion/toy")
    assert project.dirty() == []

    started.clear()
    assert "toy is night-0001 again" in night.rollback("", "")
    # nothing is learned again
    assert started and not [command for command in started if "repro" in command]
    assert (
        project.production() == before
        and project.champion()["folder"]["md5"] == name
        and project.dirty() == []
    )
    # and the night after does not promote again what somebody has just rolled back
    (project.folder / "learn.py").write_text(
        (project.folder / "learn.py").read_text() + "# other code, same model\n"
    )
    status, summary = night.nightly(render_night)
    assert (
        status == night.OK
        and "was rolled back by hand" in summary
        and project.champion()["run"] == "night-0001"
    )


@pytest.mark.slow
def test_a_worse_challenger_changes_nothing_but_the_report(project):
    before = project.production()
    project.record("second", [30.0])
    status, summary = night.nightly(render_night)
    assert status == night.OK and "kept" in summary and "no better" in summary
    assert (
        project.production() == before and project.champion()["run"] == "night-0001" and project.dirty() == []
    )
    metrics = json.loads((project.folder / "reports/metrics/nightly.json").read_text())
    assert (
        metrics["decision"] == "kept"
        and metrics["champion"]["toy"]["run"] == "night-0001"
        and metrics["decisions"]["toy"]["paired"]["p"] == 1.0
    )


def test_a_night_with_bad_data_leaves_the_last_good_run_and_the_next_night_works(project):
    lock, learned = (
        (project.folder / name).read_bytes() for name in ("dvc.lock", "datasets/learn/model.json")
    )
    bad = project.record("bad", ["x"])
    status, summary = night.nightly(render_night)
    assert status == night.FAILED and "bad.csv: expected numbers, found none; mend the file" in summary
    assert (project.folder / "dvc.lock").read_bytes() == lock and (
        project.folder / "datasets/learn/model.json"
    ).read_bytes() == learned
    assert "bad.csv" in (project.folder / "reports/nightly.html").read_text()
    bad.unlink()
    project.record("second", [9.0, 9.0, 9.0])
    assert night.nightly(render_night)[0] == night.OK and project.champion()["run"] == "night-0003"


@pytest.mark.parametrize(("times", "versioned_by"), [(1, "git"), (2, "git"), (1, "dvc")])
def test_what_changes_while_the_stages_run_is_learned_whole_or_not_at_all(
    project, monkeypatch, times, versioned_by
):
    if versioned_by == "dvc":
        project.run("git", "rm", "-rq", "--cached", "datasets/raw/toy")
        project.run(sys.executable, "-m", "dvc", "add", "-q", "datasets/raw/toy")
        project.run("git", "add", "datasets/raw")
        project.run("git", "commit", "-q", "-m", "recordings are dvc's")
    project.record("second", [9.0])
    lock, learn, late = (project.folder / "dvc.lock").read_bytes(), night._reproduce, iter(range(times))

    def meanwhile(*given):
        reproduced = learn(*given)
        for k in itertools.islice(late, 1):  # after stage learn has read, as a printer that goes on recording
            project.record(f"late_{k}", [9.0])
            project.set(watch_h=48 + k)
        return reproduced

    monkeypatch.setattr(night, "_reproduce", meanwhile)
    status, summary = night.nightly(render_night)
    if times == 1:
        assert status == night.OK, summary
        assert status == night.OK and "promoted toy" in summary
        assert json.loads((project.folder / "datasets/learn/model.json").read_text()) == (33 + 18) / 5
        assert remembered.nights()[-1].notes[:1] == (
            "datasets/raw/toy/late_0.csv, params.yaml changed while the stages ran: "
            "the night began once again",
        )
        assert sorted(project.champion()["lineage"]["recordings"]["toy"]) == [
            f"datasets/raw/toy/{name}.csv" for name in ("first", "late_0", "second")
        ]
        assert "nothing new" in night.nightly(render_night)[1]
        return
    assert (
        status == night.FAILED
        and "datasets/raw/toy/late_1.csv changed again while the stages ran; start the night when" in summary
    )
    assert (project.folder / "dvc.lock").read_bytes() == lock and project.champion()["run"] == "night-0001"
    assert night.nightly(render_night)[0] == night.OK and project.champion()["run"] == "night-0003"


def test_a_recording_that_comes_while_others_are_judged_is_looked_at_tonight_or_new_the_next_night(
    project, monkeypatch
):
    project.record("second", [9.0])
    look, judge = screening.look, night._judge

    def looked(*given, **more):
        monkeypatch.setattr(screening, "look", look)
        project.record("while_looking", [9.2])
        return look(*given, **more)

    def judged(*given):
        project.record("while_judging", [9.5])
        return judge(*given)

    monkeypatch.setattr(screening, "look", looked)
    monkeypatch.setattr(night, "_judge", judged)
    assert night.nightly(render_night)[0] == night.OK
    tonight = remembered.nights()[-1].new_recordings["toy"]
    assert tonight == ["datasets/raw/toy/second.csv", "datasets/raw/toy/while_looking.csv"]
    monkeypatch.setattr(night, "_judge", judge)
    assert night.nightly(render_night)[0] == night.OK
    assert remembered.nights()[-1].new_recordings == {"toy": ["datasets/raw/toy/while_judging.csv"]}


@pytest.mark.parametrize("lock", [None, "schema: '2.0'\nstages: {}\n", ""])
def test_going_back_leaves_recordings_that_dvc_has_not_seen_alone(project, lock):
    project.run("git", "rm", "-rq", "--cached", "datasets/raw/toy")
    project.run(sys.executable, "-m", "dvc", "add", "-q", "datasets/raw/toy")
    if lock is not None:
        (project.folder / "dvc.lock").write_text(lock)
    guarding.remember_before()
    late, model = project.record("late", [9.0]), project.folder / "datasets/learn/model.json"
    model.write_text("0")
    assert guarding.back_to_before() == [] and late.read_text() == "9.0"
    assert model.read_text() == ("11.0" if lock is None else "0")


def test_code_that_changes_while_the_stages_run_ends_the_night(project, monkeypatch):
    learn = night._reproduce

    def meanwhile(*given):
        reproduced = learn(*given)
        (project.folder / "learn.py").write_text(
            (project.folder / "learn.py").read_text() + "# pulled meanwhile\n"
        )
        return reproduced

    project.record("second", [9.0])
    monkeypatch.setattr(night, "_reproduce", meanwhile)
    status, summary = night.nightly(render_night)
    assert (
        status == night.FAILED
        and "learn.py changed while the stages ran" in summary
        and project.champion()["run"] == "night-0001"
    )


@pytest.mark.slow
def test_an_empty_folder_is_a_failed_night_with_its_cause(project):
    shutil.rmtree(project.folder / "datasets/raw/toy")
    (project.folder / "datasets/raw/toy").mkdir()
    before = project.production()
    status, summary = night.nightly(render_night)
    assert status == night.FAILED and "datasets/raw/toy" in summary
    assert project.production() == before and project.champion()["run"] == "night-0001"


def test_a_second_night_at_the_same_time_is_refused_and_changes_nothing(project):
    (project.folder / ".beadline").mkdir(exist_ok=True)
    descriptor = os.open(project.folder / ".beadline/lock", os.O_RDWR | os.O_CREAT)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    project.record("second", [9.0, 9.0, 9.0])
    assert night.nightly(render_night)[0] == night.BUSY
    assert project.champion()["run"] == "night-0001"
    os.close(descriptor)
    assert night.nightly(render_night)[0] == night.OK


@pytest.mark.slow
def test_on_a_full_disk_the_champion_stays_and_the_cause_is_reported(project, monkeypatch):
    project.record("second", [9.0, 9.0, 9.0])

    copy = shutil.copyfile

    def full(source, target):
        if "champion" in str(target):
            raise OSError(28, "No space left on device", str(target))
        return copy(source, target)

    before = project.production()
    with monkeypatch.context() as broken:
        broken.setattr(champion.shutil, "copyfile", full)
        status, summary = night.nightly(render_night)
    assert status == night.FAILED and "No space left on device" in summary
    assert project.production() == before and project.champion()["run"] == "night-0001"
    assert night.nightly(render_night)[0] == night.OK and project.champion()["run"] == "night-0003"


def test_too_little_room_ends_the_night_before_it_begins(project):
    project.set(least_free_mb=1e7)
    status, summary = night.nightly(render_night)
    assert (
        status == night.FAILED
        and "nightly.least_free_mb" in summary
        and project.champion()["run"] == "night-0001"
    )


@pytest.mark.slow
def test_a_clock_that_was_set_back_is_said_and_does_not_make_the_last_success_older(project):
    success = remembered.last().success
    project.record("second", [9.0, 9.0, 9.0])
    status, summary = night.nightly(render_night, datetime.datetime.fromisoformat(success) - 0.5 * TOMORROW)
    assert (
        status == night.OK
        and "the clock was set back" in summary
        and project.champion()["run"] == "night-0002"
    )
    assert remembered.last().success == success


def test_one_night_by_a_clock_of_another_century_does_not_hold_the_watchdog_for_good(project):
    today = datetime.datetime.fromisoformat(remembered.last().success) + TOMORROW
    for _ in range(2):
        night.nightly(render_night, datetime.datetime(2100, 1, 1, tzinfo=datetime.UTC))
        assert remembered.last().success.startswith("2100")
        assert night.nightly(render_night, today)[0] == night.OK
        status, summary = reporting.watchdog(today)
        assert status == night.OK and f"the last success was at {today.isoformat()}" in summary
    night.nightly(render_night, datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC))
    assert (
        night.nightly(render_night, today)[0] == night.OK and remembered.last().success == today.isoformat()
    )


def test_a_promotion_that_was_killed_before_its_commit_never_was(project):
    """Between champion.json and the commit: everything new lies there, and HEAD knows none of it."""
    before, head = project.production(), project.head()
    model = project.folder / "datasets/learn/model.json"
    model.write_text("10.0")
    files = champion.install("toy", ["datasets/learn/model.json"], {})
    killed = Champion("night-0002", "2030-01-01T00:00:00+00:00", "killed", files)
    champion.write(champion.in_production(champion.read(), "toy", killed, event="promoted"))
    guarding.RUNNING.touch()
    assert project.production() != before
    (project.folder / "datasets/learn/model.json").write_text("11.0")
    status, summary = night.nightly(render_night)
    assert status == night.OK and "the night before was killed" in summary
    assert (
        project.production() == before
        and project.champion()["run"] == "night-0001"
        and project.head() == head
    )


@pytest.mark.slow
def test_gits_lock_left_by_a_killed_night_does_not_stop_the_next_one(project):
    guarding.RUNNING.touch()
    (project.folder / ".git/index.lock").touch()
    (project.folder / ".git/refs/heads/main.lock").touch()
    project.record("second", [9.0, 9.0, 9.0])
    status, summary = night.nightly(render_night)
    assert (
        status == night.OK
        and "was left by a killed git" in summary
        and project.champion()["run"] == "night-0002"
    )


@pytest.mark.slow
def test_a_lock_of_a_git_that_died_by_day_leaves_no_promotion_staged_backwards(project):
    lock = project.folder / ".git/index.lock"
    lock.touch()  # as old as a git that may be at work
    project.record("second", [9.0] * 3)
    assert (
        night.nightly(render_night)[0] == night.OK
        and project.champion()["run"] == "night-0002"
        and lock.exists()
    )
    os.utime(lock, (time.time() - 7200,) * 2)
    project.record("third", [10.0])
    _, summary = night.nightly(render_night)
    assert "index.lock was left by a killed git and is removed" in summary and not lock.exists()
    assert not [line for line in project.dirty() if "champion" in line]


@pytest.mark.parametrize("content", ["", '{"write": {"/a": {"pi'])
def test_what_a_killed_dvc_left_half_written_stops_no_night(project, content):
    """DVC itself refuses to start ever after."""
    rwlock = project.folder / ".dvc/tmp/rwlock"
    rwlock.write_text(content)
    project.record("second", [9.0] * 3)
    status, summary = night.nightly(render_night)
    assert status == night.OK and "rwlock was left half written by a killed DVC and is removed" in summary
    assert project.champion()["run"] == "night-0002" and json.loads(rwlock.read_text()) is not None


def test_a_commit_leaves_alone_what_the_user_has_staged(project):
    (project.folder / "mine.txt").write_text("half done")
    project.run("git", "add", "mine.txt")
    project.record("second", [9.0, 9.0, 9.0])
    assert night.nightly(render_night)[0] == night.OK
    assert project.dirty() == ["A  mine.txt"]


@pytest.mark.slow
def test_a_promotion_on_a_branch_waits_for_a_person(project):
    before = project.production()
    project.set(promotion="branch")
    project.record("second", [9.0, 9.0, 9.0])
    status, summary = night.nightly(render_night)
    assert status == night.OK and "git merge nightly" in summary
    assert project.production() == before and project.champion()["run"] == "night-0001"
    project.run("git", "add", "-A")
    project.run("git", "stash", "-q")
    project.run("git", "merge", "-q", "nightly")
    project.run(sys.executable, "-m", "dvc", "checkout", "-q")
    assert project.champion()["run"] == "night-0002" and project.production()["learn/model.json"] == b"10.0"


@pytest.mark.slow
def test_nights_of_two_branches_are_merged_by_one_command(project):
    project.run("git", "checkout", "-q", "-b", "other")
    project.record("other", [9.5, 9.5, 9.5])
    assert night.nightly(render_night)[0] == night.OK and project.champion()["run"] == "night-0002"
    project.run("git", "checkout", "-q", "main")
    project.run(sys.executable, "-m", "dvc", "checkout", "-q")
    project.record("mine", [9.4, 9.4, 9.4])
    assert night.nightly(render_night)[0] == night.OK
    assert project.run("git", "merge", "other", check=False).returncode != 0  # by itself git cannot
    project.run("git", "merge", "--abort")
    merged = project.beadline("nightly", "--merge", "other")
    assert merged.returncode == 0, merged
    assert json.loads((project.folder / "datasets/learn/model.json").read_text()) == pytest.approx(
        np.mean([11, 9.5, 9.4])
    )
    assert {line.run for line in champion.read().history} >= {
        "night-0001",
        "night-0002",
    } and project.dirty() == []


def test_the_watchdog_wakes_somebody_when_the_last_success_is_old(project):
    project.set(
        watch_h=0.0001,  # a third of a second
        alarm=f"{sys.executable} -c \"import sys,shutil; shutil.copy(sys.argv[1], 'woken.json')\"",
    )
    time.sleep(0.5)
    status, summary = reporting.watchdog()
    assert status == night.FAILED and "nightly.watch_h allows 0.0001 h" in summary
    woken = json.loads((project.folder / "woken.json").read_text())
    assert woken["kind"] == "watch" and "last success was" in woken["reasons"][0]


@pytest.mark.slow
def test_a_failed_night_wakes_somebody_and_an_alarm_that_fails_does_not_hide_it(project):
    project.set(alarm="no-such-command", webhook="http://127.0.0.1:9/none")
    project.record("bad", ["x"])
    status, summary = night.nightly(render_night)
    assert (
        status == night.FAILED
        and "bad.csv" in summary
        and "nightly.alarm" in summary
        and "nightly.webhook" in summary
    )
    assert json.loads(watch.ALARM.read_text())["kind"] == "failed"


def test_rollback_of_an_unknown_loop_names_the_loops(project):
    with pytest.raises(
        ValueError,
        match=r"champion.json: expected a loop with a champion, found foo; loops with a champion are: toy$",
    ):
        night.rollback("", "foo")
    assert not guarding.RUNNING.exists()


def test_rollback_to_what_is_in_production_is_no_rollback(project):
    head = project.head()
    with pytest.raises(ValueError, match="champion.json: night-0001 is in production already"):
        night.rollback("night-0001", "")
    assert project.head() == head and not guarding.RUNNING.exists()


def test_rollback_to_an_unknown_run_names_the_known_ones(project):
    with pytest.raises(
        ValueError,
        match=r"expected a champion of night-0099 to go back to, found none; known are: night-0001 \(toy\)",
    ):
        night.rollback("night-0099", "")
    assert not guarding.RUNNING.exists()  # refused, not killed: the next night has nothing to mend


@pytest.mark.slow
def test_artifacts_are_pushed_to_a_remote_and_a_fresh_clone_pulls_the_champion(project, tmp_path):
    project.run(sys.executable, "-m", "dvc", "remote", "add", "-q", "store", str(tmp_path / "remote"))
    project.run("git", "commit", "-qam", "a remote")
    project.set(remote="store")
    project.record("second", [9.0, 9.0, 9.0])
    assert night.nightly(render_night)[0] == night.OK
    project.run("git", "commit", "-qam", "parameters")
    project.run("git", "clone", "-q", str(project.folder), str(tmp_path / "clone"))
    clone = Project(tmp_path / "clone")
    clone.run(sys.executable, "-m", "dvc", "pull", "-q", "-r", "store")
    assert clone.production() == project.production()


@pytest.mark.slow
def test_killed_at_twenty_random_moments_the_champion_is_whole_and_the_next_night_works(project):
    """SIGKILL at moments spread over a night that promotes, or would."""
    rng = np.random.default_rng(7)
    (project.folder / "slow.txt").write_text("0.5")
    project.run("git", "add", "slow.txt")
    project.run("git", "commit", "-qm", "a stage that takes a while")
    began = time.monotonic()
    project.record("warm", [11.0])
    night.nightly(render_night)
    whole_s = time.monotonic() - began
    for k, share in enumerate(rng.uniform(0.02, 1.0, 20)):
        before = project.champion()
        project.record(f"kill {k}", [9.9 - 0.1 * k, 10.1 + 0.05 * k])
        child = project.start()
        time.sleep(share * whole_s)
        child.send_signal(signal.SIGKILL)
        child.communicate()
        now = project.champion()
        assert now["run"] == before["run"] or now["run"] > before["run"]
        status, summary = night.nightly(render_night)
        assert status == night.OK, f"after a kill at {share:.2f} of a night: {summary}"
        present = project.champion()
        assert champion.md5s(project.folder / "champion/toy") == present["files"] and project.dirty() == []
        assert not processes.orphans()
    subprocess.run(["git", "fsck", "--strict"], check=True, capture_output=True)


@pytest.mark.slow
@pytest.mark.parametrize("file", ["params.yaml", "params.expert.yaml"])
def test_a_change_of_either_file_of_parameters_is_something_new(tmp_path, monkeypatch, file):
    monkeypatch.chdir(tmp_path)
    Path("dvc.yaml").write_text("stages: {}")
    Path("params.yaml").write_text("learn: {window: 1}")
    Path("params.expert.yaml").write_text("learn: {seed: 1}")

    def depended_on() -> str:
        return inputs.digest(inputs.contents(inputs.Hashes({}), inputs.sources()))

    before = depended_on()
    assert depended_on() == before
    Path(file).write_text("learn: {other: 2}")
    assert depended_on() != before
