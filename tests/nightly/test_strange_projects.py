"""Projects in an odd state, and owners at work: a night uses what it can, or ends in one sentence and changes
nothing."""

import json
import os
import shutil
from pathlib import Path

import pytest

from pipeline.cli import render_night
from pipeline.nightly import by_hand, champion, inputs, night, reporting, worktree
from pipeline.nightly import screening as screens
from pipeline.nightly.records import NightDrift
from tests.nightly.test_nights_in_a_copy import during_the_stages, learned, run
from tests.nightly.toy_nights import Project


def observe(project: Project) -> tuple:
    """All that a night that is refused must not change."""
    files = {path: path.read_bytes() for path in Path("datasets").rglob("*") if path.is_file()}
    references = project.run("git", "for-each-ref").stdout
    return project.head(), references, project.dirty(), project.production(), files


def quarantining(monkeypatch, name: str) -> None:
    """The night sets the recording of this name aside, and finds no drift."""

    def look(settings, champions, new, memory):
        paths = [path for path in new.get("toy", ()) if name in path]
        return NightDrift(
            quarantined={path: inputs.quarantine(path, "toy", f"{path} is broken") for path in paths}
        )

    monkeypatch.setattr(screens, "look", look)


def move_away(folder: str, elsewhere: Path) -> None:
    """`folder` becomes a link to where its files lie now."""
    shutil.move(folder, elsewhere)
    Path(folder).symlink_to(elsewhere)


@pytest.mark.parametrize("folder", ["datasets/raw", "datasets/raw/toy"])
def test_recordings_behind_a_link_are_used_and_one_that_is_set_aside_is_kept(
    project, tmp_path, monkeypatch, folder
):
    project.record("old", [9.0, 9.0, 9.0])
    project.record("broken", [50.0])
    for path in Path("datasets/raw/toy").iterdir():
        os.utime(path, (1e9, 1e9))
    before = learned()
    move_away(folder, tmp_path / "elsewhere")
    assert f"{folder} is a link, but the last commit has files below it" in run(reporting.FAILED)
    assert learned() == before
    project.run("git", "add", folder)
    project.run("git", "commit", "-qm", "recordings lie elsewhere")
    quarantining(monkeypatch, "broken")
    assert "broken.csv is broken" in run(reporting.QUARANTINED)
    assert learned() == 10.0 and champion.read().champions["toy"].run == "night-0003"
    assert (inputs.QUARANTINE / "toy/broken.csv").read_text() == "50.0"
    assert Path(folder).is_symlink() and Path("datasets/raw/toy/old.csv").read_text() == "9.0\n9.0\n9.0"
    assert project.dirty() == []
    assert "nothing new" in run()


def test_a_recording_that_is_a_link_is_used_and_stays_one(project, tmp_path):
    (tmp_path / "far.csv").write_text("9.0\n9.0\n9.0")
    os.utime(tmp_path / "far.csv", (1e9, 1e9))
    link = Path("datasets/raw/toy/far.csv")
    link.symlink_to("../../../../far.csv")
    assert "promoted toy" in run()
    assert learned() == 10.0 and os.readlink(link) == "../../../../far.csv"
    assert project.dirty() == ["?? datasets/raw/toy/far.csv"]


def test_recordings_on_another_disk_are_used_and_stay_files(project, monkeypatch):
    recording = project.record("new", [9.0, 9.0, 9.0])
    for path in Path("datasets/raw/toy").iterdir():
        os.utime(path, (1e9, 1e9))
    tracked = Path("datasets/raw/toy/first.csv")
    tracked.write_text("11.0\n11.0\n11.0\n")
    os.utime(tracked, (1e9, 1e9))

    def refuse(*_, **__):
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(worktree.os, "link", refuse)
    assert "promoted toy" in run()
    assert learned() == 10.0 and not recording.is_symlink() and not tracked.is_symlink()
    assert tracked.read_text() == "11.0\n11.0\n11.0\n"
    assert "120000" not in project.run("git", "ls-tree", "-r", "HEAD").stdout


NAMES = ("two\nlines", "<!channel>", " *[1]* ", "-rf", "'\"$(id)", ":(top)x")


def test_any_name_of_a_recording_is_a_name(project, monkeypatch):
    for name in NAMES:
        project.record(name, [9.5])
        project.record("broken" + name, [50.0])
    quarantining(monkeypatch, "broken")
    summary = run(reporting.QUARANTINED)
    assert "promoted toy" in summary and "\n" not in summary and learned() == 10.0
    assert "<!channel>" not in json.loads(Path(".beadline/alarm.json").read_text())["text"]
    paths = project.run("git", "show", "-z", "--name-only", "--format=", "HEAD").stdout.split("\0")
    for name in NAMES:
        assert (inputs.QUARANTINE / f"toy/broken{name}.csv").exists()
        assert f"datasets/raw/toy/{name}.csv" in paths
    assert project.dirty() == []


def test_parameters_that_the_owner_edits_meanwhile_are_those_of_the_next_night(project, monkeypatch):
    during_the_stages(monkeypatch, lambda: project.set(watch_h=12))
    project.record("better", [9.0, 9.0, 9.0])
    assert "promoted toy" in run()
    assert project.dirty() == [" M params.yaml"] and learned() == 10.0
    assert "watch_h" not in project.run("git", "show", "HEAD").stdout
    summary = run()
    assert "nothing new" not in summary and "not committed: params.yaml" in summary


def test_a_lock_of_git_that_does_not_go_ends_night_and_rollback_in_a_sentence(project, monkeypatch):
    project.record("better", [9.0, 9.0, 9.0])
    run()
    project.record("best", [9.5])
    lock, before = Path(".git/index.lock"), observe(project)
    lock.touch()
    lock.chmod(0o444)
    monkeypatch.setattr(worktree, "LOCKED_S", 1)
    assert ".git/index.lock is there: git works in the project, or was killed" in run(reporting.FAILED)
    with pytest.raises(ValueError, match=r"index\.lock is there.*remove the file if no git runs"):
        by_hand.rollback("", "")
    assert lock.exists()
    lock.unlink()
    assert observe(project) == before
    assert "nothing new" not in run()


def test_a_lock_that_comes_while_the_night_lands_is_waited_for_until_the_next_night(project, monkeypatch):
    lock = Path(".git/index.lock")
    project.record("better", [9.0, 9.0, 9.0])
    before = project.production()
    with monkeypatch.context() as context:
        during_the_stages(context, lock.touch)
        status, summary = night.nightly(render_night)
    assert status == reporting.FAILED and "index.lock" in summary
    assert project.production() == before
    lock.unlink()
    run()
    assert project.dirty() == [] and project.production()["learn/model.json"] == b"10.0" and learned() == 10.0


def test_production_that_somebody_changed_or_deleted_comes_back(project):
    before = project.production()
    Path("champion/toy/learn/model.json").write_text("0")
    assert "nothing new" in run() and project.production() == before
    shutil.rmtree("champion")
    assert "nothing new" in run() and project.production() == before
    project.record("better", [9.0, 9.0, 9.0])
    assert "promoted toy" in run() and project.production()["learn/model.json"] == b"10.0"
    assert champion.md5s(Path("champion/toy")) == champion.read().champions["toy"].files


def test_a_file_in_the_place_of_the_copy_is_named_and_what_a_link_there_leads_to_stays(project, tmp_path):
    project.record("better", [9.0, 9.0, 9.0])
    before = observe(project)
    worktree.COPY.write_text("mine")
    status, summary = night.nightly(render_night)
    assert status == reporting.FAILED
    assert ".beadline/copy: expected the folder in which a night works, found a file" in summary
    with pytest.raises(ValueError, match="found a file; move it away"):
        by_hand.rollback("", "")
    assert observe(project) == before and worktree.COPY.read_text() == "mine"
    worktree.COPY.unlink()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/file").write_text("mine")
    worktree.COPY.symlink_to(tmp_path / "mine")
    assert "promoted toy" in run()
    assert (tmp_path / "mine/file").read_text() == "mine"


def test_a_link_to_a_folder_below_the_recordings_is_as_it_is_by_hand(project, tmp_path):
    """No stage reads behind it, nor does the night; so that nothing is new because of it."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/more.csv").write_text("50.0")
    Path("datasets/raw/toy/mine").symlink_to(tmp_path / "mine")
    Path("datasets/raw/toy/again").symlink_to(".")
    project.record("better", [9.0, 9.0, 9.0])
    assert "promoted toy" in run() and learned() == 10.0
    assert "nothing new" in run() and (tmp_path / "mine/more.csv").read_text() == "50.0"


@pytest.mark.parametrize("promotion", ["at_once", "branch"])
def test_on_a_detached_head_nothing_is_lost(project, promotion):
    project.set(promotion=promotion)
    project.run("git", "commit", "--allow-empty", "-qam", promotion)
    project.run("git", "switch", "-q", "--detach")
    project.record("better", [9.0, 9.0, 9.0])
    before = observe(project)
    if promotion == "at_once":
        assert "found a detached HEAD" in run(reporting.FAILED)
        assert observe(project) == before
    else:
        assert "promoted toy on branch nightly" in run()
        assert project.head() == before[0] and project.production() == before[3]
    with pytest.raises(ValueError, match="found a detached HEAD"):
        by_hand.rollback("", "")
