"""Where a night's work goes: commits, branches on which promotions wait, merges, the way back, and what of a
night no commit holds; on the toy project."""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from pipeline.cli import render_night
from pipeline.nightly import accepting, branches, champion, inputs, merging, night, processes, remembered
from pipeline.nightly.records import Champion, ChampionState, Installed
from pipeline.nightly.settings import Nightly
from pipeline.recordings import excluded
from pipeline.store import artifacts, params
from pipeline.verdict import verdict
from tests.nightly.toy_nights import ROOT, SETTINGS, Project, entered

# each brings the mean of all nearer to 10, the truth: 10.7, 10.35, 9.875
BETTER = [[10.4] * 3, [10.0] * 6, [9.4] * 12]


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """The project after its first night, whose champion is in production; promotions wait from now on."""
    return Project(tmp_path_factory.mktemp("nights") / "toy").make().promoted()


@pytest.fixture
def project(first, tmp_path, monkeypatch):
    return entered(first, tmp_path / "toy", monkeypatch)


@pytest.fixture
def by_branch(project):
    project.set(promotion="branch")
    project.run("git", "commit", "-qam", "promotions wait for a person")
    return project


def runs(state: ChampionState) -> list[str]:
    return [line.run for line in state.history]


# ---- promotions that wait


@pytest.mark.slow
def test_three_promotions_without_a_merge_are_all_in_the_history_that_the_printed_command_merges(
    by_branch, tmp_path
):
    before, head = by_branch.production(), by_branch.head()
    for k, values in enumerate(BETTER):
        by_branch.record(f"shift_{k}", values)
        status, summary = night.nightly(render_night)
        assert status == night.OK and "promoted toy on branch nightly" in summary, summary
        # in production is what was there, and the night judges against that
        assert by_branch.production() == before and by_branch.head() == head
        assert champion.read().champions["toy"].run == "night-0001"
    page = (by_branch.folder / "reports/nightly.html").read_text()
    assert "Promoted on branch nightly, not yet in production: toy." in page and "To go back: " not in page
    assert "To put it into production: ./run beadline nightly --merge nightly." in page
    waits = champion.of_branch("nightly")
    assert runs(waits) == ["night-0001", "night-0002", "night-0003", "night-0004"]
    assert [line.before for line in waits.history] == [None, "night-0001", "night-0002", "night-0003"]
    assert len(processes.git("rev-list", f"{head}..nightly").split()) == 3

    # by git alone, in a clean clone
    by_branch.run("git", "clone", "-q", str(by_branch.folder), str(tmp_path / "clone"))
    clone = Project(tmp_path / "clone")
    clone.run("git", "merge", "-q", "--ff-only", "origin/nightly")
    clone.run(sys.executable, "-m", "dvc", "cache", "dir", str(by_branch.folder / ".dvc/cache"))
    clone.run(sys.executable, "-m", "dvc", "checkout", "-q")
    assert clone.champion()["run"] == "night-0004"

    # by the command that the night prints, where nights run: with its dvc.lock, metrics and recordings
    assert [path for path in processes.changed(untracked="all") if path.startswith(("dvc.lock", "datasets/"))]
    command = re.search(r"\./run beadline (nightly --merge nightly) ", summary)
    assert command, summary
    merged = by_branch.beadline(*command[1].split())
    assert merged.returncode == 0 and "nothing new" in merged.stdout, merged
    assert by_branch.champion()["run"] == "night-0004" and by_branch.dirty() == []
    assert by_branch.production() == clone.production() != before
    assert runs(champion.read()) == ["night-0001", "night-0002", "night-0003", "night-0004"]
    # what is merged waits no more, and the next promotion follows on it
    assert not branches.waiting(settings()).champions
    assert "toy is night-0003 again" in night.rollback("", "")


def settings():
    return params.load(Nightly, "nightly")


@pytest.mark.slow
def test_a_challenger_no_better_than_the_one_that_waits_is_not_put_before_it(by_branch):
    by_branch.record("good", BETTER[0] + BETTER[1])  # 10.35
    assert "promoted toy" in night.nightly(render_night)[1]
    by_branch.record("poor", [11.0] * 3)  # 10.48: better than 11, and no better than what waits
    status, summary = night.nightly(render_night)
    assert status == night.OK and "no better than that of night-0002, which waits on the branch" in summary
    assert "on branch nightly waits night-0002 (toy)" in summary and "promoted" not in summary
    assert runs(champion.of_branch("nightly")) == ["night-0001", "night-0002"]
    (by_branch.folder / "datasets/raw/toy/poor.csv").unlink()
    assert "that of night-0002, byte for byte, which waits" in night.nightly(render_night)[1]
    assert by_branch.champion()["run"] == "night-0001" == champion.read().champions["toy"].run


@pytest.mark.slow
def test_promotions_of_two_loops_wait_beside_each_other(by_branch):
    other = SETTINGS["loops"]["toy"] | {
        "artifacts": ["datasets/other/cases.json"],
        "cases": "datasets/other/cases.json",
    }
    other["recordings"] = ""
    by_branch.set(promotion="branch", loops=SETTINGS["loops"] | {"other": other})
    by_branch.run("git", "commit", "-qam", "another loop")

    def score(cost: float) -> None:
        cases = {f"case {k}": {"block": f"plant {k}", "cost": cost + 0.001 * k} for k in range(8)}
        artifacts.write_json("datasets/other/cases.json", {"panel": "other 1", "cases": cases, "guards": {}})

    score(9.0)
    by_branch.run("git", "add", "-f", "datasets/other")
    by_branch.run("git", "commit", "-qm", "its first score")
    assert "promoted other" in night.nightly(render_night)[1]
    by_branch.record("good", BETTER[0])
    assert "promoted toy" in night.nightly(render_night)[1]
    waits = champion.of_branch("nightly").champions
    assert {name: one.run for name, one in waits.items()} == {"other": "night-0002", "toy": "night-0003"}
    assert "toy is night-0003, other is night-0002" in merging.merge("nightly")
    assert by_branch.production_of("other") and float(
        by_branch.production()["learn/model.json"]
    ) == pytest.approx(10.7)
    assert by_branch.dirty() == []


@pytest.mark.slow
def test_the_branch_only_moves_forward_though_its_promotion_was_squashed_or_production_went_on(by_branch):
    by_branch.record("shift_0", BETTER[0])
    night.nightly(render_night)
    tip = processes.git("rev-parse", "nightly")
    (by_branch.folder / "notes.md").write_text("production went on")
    by_branch.run("git", "add", "notes.md")
    by_branch.run("git", "commit", "-qm", "notes")
    by_branch.record("shift_1", BETTER[1])
    night.nightly(render_night)
    head, then = by_branch.head(), processes.git("rev-parse", "nightly")
    assert processes.contains(then, tip) and processes.contains(then, head)
    assert processes.git("show", "nightly:notes.md") == "production went on"
    # a person takes it over in one commit of his own
    merging.merge("nightly")
    by_branch.run("git", "reset", "-q", "--soft", head)
    by_branch.run("git", "commit", "-qm", "squashed")
    assert not branches.waiting(settings()).champions
    by_branch.record("shift_2", BETTER[2])
    assert "promoted toy" in night.nightly(render_night)[1]
    last = processes.git("rev-parse", "nightly")
    assert processes.contains(last, then) and processes.contains(last, by_branch.head())
    assert runs(champion.of_branch("nightly")) == ["night-0001", "night-0002", "night-0003", "night-0004"]


def test_a_fresh_clone_knows_what_waits_on_the_remote(by_branch, tmp_path):
    waits = champion.read()
    there = waits.champions["toy"]._replace(run="night-0002", when="2030-01-01T00:00:00+00:00")
    there = there._replace(
        installed=there.installed._replace(folder=there.installed.folder | {"md5": "0.dir"})
    )
    artifacts.write_json(
        champion.FILE, champion.in_production(waits, "toy", there, event="promoted").to_json()
    )
    processes.commit([str(champion.FILE)], "waits", branch="nightly")
    by_branch.run("git", "checkout", "-q", "--", ".")
    by_branch.run("git", "clone", "-q", str(by_branch.folder), str(tmp_path / "clone"))
    os.chdir(tmp_path / "clone")
    found = branches.waiting(settings())
    assert {name: one.run for name, one in found.champions.items()} == {"toy": "night-0002"}
    assert found.tip == processes.git("rev-parse", "origin/nightly")


def test_of_two_histories_a_loop_goes_on_with_the_one_that_holds_the_other():
    def of(run: str) -> Champion:
        return Champion(run, f"2030-01-0{run[-1]}T00:00:00+00:00", "", Installed({"md5": f"{run}.dir"}))

    def state(*lines: tuple[str, str, str]) -> ChampionState:
        made = ChampionState()
        for loop, run, event in lines:
            made = champion.in_production(made, loop, of(run), event=event)
        return made

    base = [("a", "n1", "first champion"), ("b", "n2", "first champion")]
    theirs = state(*base, ("a", "n3", "promoted"), ("b", "n4", "promoted"))
    assert branches.joined(state(*base), theirs) == theirs
    assert branches.joined(theirs, state(*base)) == theirs
    # production of a went on here: what waited for it was held against another champion
    both = branches.joined(state(*base, ("a", "n5", "promoted")), theirs)
    assert {loop: one.run for loop, one in both.champions.items()} == {"a": "n5", "b": "n4"}
    assert [line.run for line in both.history] == ["n1", "n2", "n3", "n4", "n5"]


def test_the_later_candidate_goes_on_and_one_older_than_the_champion_goes(tmp_path):
    def of(run: str) -> Champion:
        return Champion(run, run, "", Installed({"md5": f"{run}.dir"}))

    mine = ChampionState({}, (), {"a": of("n2"), "b": of("n2")})
    theirs = champion.in_production(ChampionState({}, (), {"a": of("n1")}), "b", of("n3"), event="promoted")
    both = branches.joined(mine, theirs)
    assert {loop: one.run for loop, one in both.candidates.items()} == {"a": "n2"}
    # the pointers that a merge left are those of what is there
    (tmp_path / "champion").mkdir()
    (tmp_path / "champion/b.candidate.dvc").write_text("outs: []")
    champion.write_state(both, tmp_path)
    pointers = sorted(path.name for path in (tmp_path / "champion").glob("*.dvc"))
    assert pointers == ["a.candidate.dvc", "b.dvc"]
    assert (tmp_path / "champion/.gitignore").read_text() == "/b\n/a.candidate\n"


# ---- merges


def test_a_merge_that_would_overwrite_what_somebody_changed_here_names_it_and_changes_nothing(by_branch):
    by_branch.run("git", "switch", "-q", "-c", "other")
    (by_branch.folder / "learn.py").write_text("# theirs\n")
    by_branch.run("git", "commit", "-qam", "theirs")
    by_branch.run("git", "switch", "-q", "main")
    (by_branch.folder / "learn.py").write_text("# mine, half done\n")
    (by_branch.folder / "mine.txt").write_text("half done")
    by_branch.run("git", "add", "mine.txt")
    before, head = by_branch.dirty(), by_branch.head()
    with pytest.raises(
        ValueError, match=r"learn.py: expected as it was committed, found changed here, and other "
    ):
        merging.merge("other")
    assert by_branch.dirty() == before and by_branch.head() == head and not merging.PLACE.exists()
    by_branch.run("git", "checkout", "-q", "--", "learn.py")
    assert "other is merged: toy is night-0001" in merging.merge("other")
    assert (by_branch.folder / "learn.py").read_text() == "# theirs\n"
    assert by_branch.dirty() == ["A  mine.txt"]
    assert merging.merge("other") == "other has nothing that is not here already"


def test_a_merge_that_conflicts_is_given_up_with_the_file_named(by_branch):
    for branch, text in (("other", "# theirs\n"), ("main", "# ours\n")):
        by_branch.run("git", "switch", "-q", *(("-c", branch) if branch == "other" else (branch,)))
        (by_branch.folder / "learn.py").write_text(text)
        by_branch.run("git", "commit", "-qam", text)
    with pytest.raises(ValueError, match=r"other and this branch both changed learn.py; merge them by hand"):
        merging.merge("other")
    assert by_branch.dirty() == [] and processes.git("worktree", "list").count("\n") == 0


def test_what_only_the_other_side_made_anew_is_taken_from_it(by_branch):
    """Somebody's accepted run must not be undone by a night that changed nothing of it."""
    lock = by_branch.folder / "dvc.lock"
    by_branch.run("git", "switch", "-q", "-c", "other")
    lock.write_text(lock.read_text() + "# an accepted run\n")
    (by_branch.folder / "datasets/raw/toy/theirs.csv").write_text("10")
    by_branch.run("git", "add", "-A")
    by_branch.run("git", "commit", "-qm", "accepted")
    by_branch.run("git", "switch", "-q", "main")
    (by_branch.folder / "notes.md").write_text("ours")
    by_branch.run("git", "add", "-A")
    by_branch.run("git", "commit", "-qm", "notes")
    before = by_branch.production()
    merging.merge("other")
    assert lock.read_text().endswith("# an accepted run\n") and by_branch.dirty() == []
    assert (by_branch.folder / "datasets/raw/toy/theirs.csv").exists() and by_branch.production() == before


def test_a_merge_that_was_killed_half_way_is_done_by_the_next_one_and_stops_no_night(by_branch):
    by_branch.run("git", "switch", "-q", "-c", "other")
    (by_branch.folder / "learn.py").write_text((by_branch.folder / "learn.py").read_text() + "# theirs\n")
    by_branch.record("theirs", [11.0])
    by_branch.run("git", "add", "-A")
    by_branch.run("git", "commit", "-qm", "theirs")
    by_branch.run("git", "switch", "-q", "main")
    head, before = by_branch.head(), by_branch.production()
    for killed_at in ("update-ref", "merge"):
        with pytest.MonkeyPatch.context() as killed:

            def git(*words, at=killed_at, killed=killed, **more):
                if words[0] == at:
                    killed.setattr(merging, "_remove", lambda: None)  # nobody tidies after a kill
                    raise KeyboardInterrupt
                return processes.git(*words, **more)

            killed.setattr(merging, "git", git)
            with pytest.raises(KeyboardInterrupt):
                merging.merge("other")
        assert by_branch.head() == head and by_branch.production() == before
    assert merging.PLACE.exists()
    status, summary = night.nightly(render_night)
    assert status == night.OK, summary
    assert "other is merged" in merging.merge("other") and not merging.PLACE.exists()
    assert by_branch.head() == processes.git("rev-parse", "other") and by_branch.production() == before
    assert [
        path for path in processes.changed() if not path.startswith(("dvc.lock", "reports/metrics"))
    ] == []


def test_lists_of_what_is_excluded_are_joined(by_branch):
    raw = by_branch.folder / "datasets/raw/toy"
    for branch, name in (("other", "theirs"), ("main", "ours")):
        by_branch.run("git", "switch", "-q", *(("-c", branch) if branch == "other" else (branch,)))
        by_branch.record(name, [99.0])
        excluded.exclude(raw / f"{name}.csv", raw, "far off")
        by_branch.run("git", "add", "-A")
        by_branch.run("git", "commit", "-qm", name)
    merging.merge("other")
    assert set(excluded.read_list(raw)) == {"ours.csv", "theirs.csv"} and by_branch.dirty() == []


# ---- where a commit would be lost, and what no commit holds


def test_a_detached_head_is_refused_in_a_sentence_unless_promotions_go_to_a_branch(project):
    project.run("git", "checkout", "-q", "--detach")
    project.record("second", [9.0] * 3)
    before = project.production()
    status, summary = night.nightly(render_night)
    assert (
        status == night.FAILED and "found a detached HEAD, where the night's commit would be lost" in summary
    )
    assert project.production() == before
    for by_hand in (lambda: night.rollback("", ""), lambda: merging.merge("main")):
        with pytest.raises(ValueError, match="found a detached HEAD"):
            by_hand()
    project.set(promotion="branch")
    status, summary = night.nightly(render_night)
    assert status == night.OK and "on branch nightly waits" in summary and project.production() == before
    assert runs(champion.of_branch("nightly"))[-1] == champion.of_branch("nightly").champions["toy"].run


def test_the_branch_of_promotions_cannot_be_the_one_in_production(by_branch):
    by_branch.set(promotion="branch", branch="main")
    status, summary = night.nightly(render_night)
    assert status == night.FAILED and "nightly.branch: expected a branch apart from" in summary
    by_branch.set(promotion="branch", branch="a..b")
    status, summary = night.nightly(render_night)
    assert status == night.FAILED and "nightly.branch: expected the name of a branch, found 'a..b'" in summary


def test_a_branch_that_is_checked_out_in_another_worktree_is_not_moved_under_it(by_branch):
    by_branch.run("git", "branch", "nightly")
    place = by_branch.folder.parent / "elsewhere"
    by_branch.run("git", "worktree", "add", "-q", str(place), "nightly")
    by_branch.record("second", BETTER[0])
    status, summary = night.nightly(render_night)
    assert status == night.FAILED and f"found nightly, which is checked out in {place}" in summary
    assert by_branch.run("git", "-C", str(place), "status", "--porcelain").stdout == ""
    shutil.rmtree(place)  # git still lists it
    status, summary = night.nightly(render_night)
    assert status == night.OK and "promoted toy on branch nightly" in summary


@pytest.mark.parametrize("word", ["merge", "cherry-pick"])
def test_nothing_is_rolled_back_while_something_is_half_done_in_git(project, word):
    for branch in ("other", "main"):
        project.run("git", "checkout", "-q", *(["-b"] if branch == "other" else []), branch)
        Path("note").write_text(branch)
        project.run("git", "add", "note")
        project.run("git", "commit", "-qm", branch)
    project.run("git", word, "other", check=False)
    head, production = project.head(), project.production()
    for by_hand in (lambda: night.rollback("", ""), lambda: accepting.accept("toy", "meant")):
        with pytest.raises(ValueError, match=f"a {word} is under way in git"):
            by_hand()
    status, summary = night.nightly(render_night)
    assert status == night.FAILED and f"a {word} is under way in git" in summary
    project.run("git", word, "--abort")
    assert project.head() == head and project.production() == production


def test_what_lay_uncommitted_is_told_and_remembered_by_its_whole_name(project):
    project.set(watch_h=48)
    project.run("git", "mv", "evaluate.py", "judge it.py")
    text = (project.folder / "dvc.yaml").read_text().replace("evaluate.py", "'judge it.py'")
    (project.folder / "dvc.yaml").write_text(text.replace("python 'judge it.py'", 'python "judge it.py"'))
    (project.folder / "learn.py").write_text(
        (project.folder / "learn.py").read_text() + "import glob  # only to differ\n"
    )
    lock = project.folder / "dvc.lock"
    lock.write_text(lock.read_text() + "\n")
    project.record("second", [9.0] * 3)
    status, summary = night.nightly(render_night)
    assert status == night.OK, summary
    names = ["dvc.yaml", "evaluate.py", "judge it.py", "learn.py", "params.yaml"]
    assert project.champion()["lineage"]["uncommitted"] == names
    told = "not committed: dvc.yaml, evaluate.py, judge it.py and 2 more; no commit alone makes this"
    assert told in summary and told in (project.folder / "reports/nightly.html").read_text()


@pytest.mark.parametrize(
    "name", ["a b.py", "ü.py", 'quo"te.py', "new\nline.py", " leading.py", "dvc.lock", "x -> y.py"]
)
def test_a_changed_path_is_named_whole_whatever_its_characters(tmp_path, monkeypatch, name):
    project = Project(tmp_path)
    monkeypatch.chdir(tmp_path)
    project.run("git", "init", "-q", "-b", "main")
    for file in (name, "zz.py"):
        (tmp_path / file).write_text("1")
    project.run("git", "add", "-A")
    project.run("git", "-c", "user.name=S", "-c", "user.email=s@e", "commit", "-qm", "files")
    (tmp_path / name).write_text("2")
    assert processes.changed() == [name]
    project.run("git", "mv", "zz.py", "moved.py")
    assert set(processes.changed()) == {name, "zz.py", "moved.py"}
    (tmp_path / "new.py").write_text("")
    assert processes.changed("new.py") == [] and processes.changed("new.py", untracked="all") == ["new.py"]


# ---- the way back


def put(state: ChampionState, run: str, loop: str = "toy", event: str = "promoted") -> ChampionState:
    return champion.in_production(
        state, loop, Champion(run, run, "", Installed({"md5": f"{loop} {run}"})), event=event
    )


def back(state: ChampionState, run: str = "", loop: str = "") -> ChampionState:
    for name, former in champion.earlier(state, run, loop).items():
        state = champion.in_production(state, name, former, event="rolled back", when="by hand")
    return state


def present(state: ChampionState, loop: str = "toy") -> str:
    return state.champions[loop].run


def test_rollback_twice_goes_two_back_and_what_was_rolled_back_is_not_come_back_to():
    state = ChampionState()
    for run in ("n1", "n2", "n3"):
        state = put(state, run)
    once = back(state)
    assert present(once) == "n2" and present(back(once)) == "n1"
    with pytest.raises(ValueError, match="expected an earlier champion to go back to, found none"):
        back(back(once))
    # after n4 was promoted in the place of n3, the one before it is n2
    later = put(once, "n4")
    assert present(back(later)) == "n2" and present(back(back(later))) == "n1"
    # one that was left is put back by its name alone; before it is what it then replaced
    again = back(later, "n3")
    assert present(again) == "n3" and present(back(again)) == "n4"
    assert present(back(back(state, "n1"), "n3")) == "n3"


def test_rollback_takes_back_the_last_promotions_of_all_loops_in_their_order():
    state = ChampionState()
    for loop, run in (("a", "n1"), ("b", "n1"), ("b", "n2"), ("a", "n3"), ("b", "n4")):
        state = put(state, run, loop)
    course = []
    for _ in range(3):
        state = back(state)
        course.append((present(state, "a"), present(state, "b")))
    assert course == [("n3", "n2"), ("n1", "n2"), ("n1", "n1")]
    assert present(back(put(state, "n5", "a"), loop="a"), "a") == "n1"


def test_an_accepted_drift_is_the_same_champion_on_the_way_back():
    state = put(put(ChampionState(), "n1"), "n2")
    accepted = state.champions["toy"]._replace(installed=Installed({"md5": "with another reference"}))
    state = champion.in_production(state, "toy", accepted, event="drift accepted")
    assert present(back(state)) == "n1"


@pytest.mark.slow
def test_two_rollbacks_put_the_files_of_the_first_champion_back_bit_by_bit(project):
    first = project.production()
    for k in range(2):
        project.record(f"shift_{k}", BETTER[k])
        assert "promoted toy" in night.nightly(render_night)[1]
    # what a full disk is told to run frees no controller that one may go back to
    project.run(sys.executable, "-m", "dvc", "gc", "--all-commits", "--force", "--quiet")
    assert "toy is night-0002 again" in night.rollback("", "")
    assert "toy is night-0001 again" in night.rollback("", "")
    assert project.production() == first and project.dirty() == []
    project.set(watch_h=40)
    assert "was rolled back by hand" in night.nightly(render_night)[1]


def test_champion_pointer_and_files_are_on_the_disk_before_the_commit(project, monkeypatch):
    """In the order of the calls: every file that the commit speaks of is synced before git is asked."""
    done: list[str] = []
    sync, ask = os.fsync, processes.git

    def synced(descriptor: int) -> None:
        done.append(os.path.relpath(os.readlink(f"/proc/self/fd/{descriptor}"), project.folder))
        sync(descriptor)

    def asked(*words, **more):
        done.append(f"git {words[0]}")
        return ask(*words, **more)

    monkeypatch.setattr(os, "fsync", synced)
    state = champion.read()
    champion.write(put(state, "night-0009"))
    monkeypatch.setattr(processes, "git", asked)
    processes.commit(champion.paths(), "promoted")
    before = done[: done.index("git commit-tree")]
    md5 = state.champions["toy"].installed.files["learn/model.json"]
    for path in ("champion.json", "champion/toy.dvc", "champion/toy/learn/model.json", "champion", "."):
        assert path in before, before
    champion.write(state)
    assert f".dvc/cache/files/md5/{md5[:2]}/{md5[2:]}" in done


# ---- what git or DVC keeps is left where it lies


def with_deposition(project: Project, **changes) -> Path:
    """A loop whose recordings are looked at without a champion; its folder."""
    loop = {
        "judge": "deposition", "cases": "", "recordings": "datasets/raw/deposition",
        "artifacts": ["datasets/segment_library/library.parquet"],
    }  # fmt: skip
    project.set(loops=SETTINGS["loops"] | {"deposition": loop}, **changes)
    change_params(project)
    raw = project.folder / "datasets/raw/deposition"
    raw.mkdir(parents=True, exist_ok=True)
    undecided = verdict.Verdict("deposition", verdict.OPEN, "Undecided (simulation).", "", "", "", "", None)
    verdict.write({"deposition": undecided}, project.folder / "datasets/verdict")
    project.run("git", "add", "-A")
    project.run("git", "commit", "-qm", "another loop")
    return raw


def change_params(project: Project, **nightly) -> None:
    """Keys of section nightly changed, beside the sections that the pages of the other loops go by."""
    sections = params.read(ROOT / "params.yaml")
    sections["nightly"] = json.loads((project.folder / "params.yaml").read_text())["nightly"] | nightly
    (project.folder / "params.yaml").write_text(json.dumps(sections, indent=1))


BROKEN = b"\x89MCAP0\r\n half a file"


@pytest.mark.parametrize("kept_by", ["git", "DVC"])
def test_a_recording_that_git_or_dvc_keeps_stays_is_excluded_and_alarms_once(project, kept_by):
    raw = with_deposition(project)
    (raw / "kept.mcap").write_bytes(BROKEN)
    if kept_by == "DVC":
        project.run(sys.executable, "-m", "dvc", "add", "-q", "datasets/raw/deposition")
    project.run("git", "add", "-A")
    project.run("git", "commit", "-qm", "a recording")
    (raw / "dropped.mcap").write_bytes(BROKEN)
    status, summary = night.nightly(render_night)
    assert status == night.QUARANTINED and f"kept.mcap ({kept_by} keeps it" not in summary
    assert (
        f"({kept_by} keeps it: it stays, and is listed in datasets/raw/deposition/excluded.yaml)" in summary
    )
    assert (raw / "kept.mcap").read_bytes() == BROKEN and not (raw / "dropped.mcap").exists()
    assert (inputs.QUARANTINE / "deposition/dropped.mcap").exists()
    entry = excluded.read_list(raw)["kept.mcap"]
    assert entry["sha256"] == artifacts.sha256(raw / "kept.mcap") and "kept.mcap" in entry["reason"]
    assert excluded.readable([raw / "kept.mcap", raw / "other.mcap"], raw) == [raw / "other.mcap"]
    # the list is committed with the recordings, and no night speaks of it again
    assert project.dirty() == []
    assert "nothing new" in night.nightly(render_night)[1]
    change_params(project, watch_h=40)
    status, summary = night.nightly(render_night)
    assert status == night.OK and "kept.mcap" not in summary
    # mended, it is a new recording, and looked at again
    (raw / "kept.mcap").write_bytes(BROKEN + b" mended")
    assert night.nightly(render_night)[0] == night.QUARANTINED


def test_who_keeps_a_recording_goes_by_its_own_name_and_not_by_a_pattern(project):
    kept, dropped = project.record("shift 1", [11.0]), project.record("shift [1]", [11.0])
    project.run("git", "add", str(kept))
    assert inputs.keeper(kept.relative_to(project.folder)) == "git"
    assert inputs.keeper(dropped.relative_to(project.folder)) == ""
    inputs.quarantine(str(dropped.relative_to(project.folder)), "toy", "far off")
    assert kept.exists() and (inputs.QUARANTINE / "toy/shift [1].csv").exists()


# ---- the schedule of GitHub, step by step on this machine


SCHEDULE = ROOT / "schedules/github-nightly.yml"


class Runner:
    """GitHub's machine for one job: a clone that is new every night, a cache that outlives it, and the steps
    of the workflow file in their order, each where its condition holds."""

    def __init__(self, place: Path, origin: Path):
        self.place, self.origin, self.jobs = place, origin, 0
        self.steps = yaml.safe_load(SCHEDULE.read_text(encoding="utf-8"))["jobs"]["nightly"]["steps"]

    def job(self, before_push: Callable[[], None] = lambda: None) -> tuple[Project, dict[str, int]]:
        """The clone after the job, and the exit status of the steps that have a name."""
        self.jobs += 1
        clone = Project(self.place / f"job {self.jobs}")
        clone.env |= {"GITHUB_REF_NAME": "main"}
        ended: dict[str, int] = {}
        good = True
        for step in self.steps:
            condition = step.get("if", "")
            assert condition in ("", "always()", "always() && steps.push.outcome == 'success'")
            if not (good if not condition else ended["push"] == 0 if "push" in condition else True):
                continue
            if "uses" in step:
                self.use(step["uses"].partition("@")[0], clone, step.get("with", {}))
                continue
            if step.get("id") == "push":
                before_push()
            status = clone.run("bash", "-e", "-o", "pipefail", "-c", step["run"], check=False)
            ended[step.get("id", step["run"])] = status.returncode
            good = good and status.returncode == 0
            self.said = status.stdout + status.stderr
        return clone, ended

    def use(self, action: str, clone: Project, given: dict) -> None:
        if action == "actions/checkout":
            shutil.rmtree(clone.folder)
            clone.folder.parent.mkdir(exist_ok=True)
            subprocess.run(
                ["git", "clone", "-q", str(self.origin), str(clone.folder)], check=True, env=clone.env
            )
            return
        if not action.startswith("actions/cache/"):
            assert action in ("actions/setup-python", "actions/upload-artifact")
            return
        # the newest entry whose key begins so; an entry is never written twice
        key = self.place / "cache" / given["key"].partition("-${{")[0]
        entry = key / str(self.jobs)
        for path in (path for path in given["path"].split() if not path.startswith("~")):
            if action.endswith("/save") and (clone.folder / path).exists():
                assert not (entry / path).exists()
                shutil.copytree(clone.folder / path, entry / path, symlinks=True)
            elif action.endswith("/restore") and key.exists():
                newest = max(key.iterdir(), key=lambda saved: int(saved.name))
                if (newest / path).exists():
                    shutil.copytree(newest / path, clone.folder / path, dirs_exist_ok=True)


@pytest.fixture
def hosted(project, tmp_path):
    """The project on a server: a bare repository and a remote of DVC; a runner of its schedule."""
    raw = with_deposition(project, remote="store")
    project.run(sys.executable, "-m", "dvc", "remote", "add", "-q", "-d", "store", str(tmp_path / "remote"))
    (project.folder / "run").write_text(
        "#!/bin/sh\n"
        f'case $1 in dvc) shift; exec "{sys.executable}" -m dvc "$@";; '
        f'beadline) shift; exec "{sys.executable}" -m pipeline.cli "$@";; esac\n'
    )
    (project.folder / "run").chmod(0o755)
    project.run("git", "add", "-A")
    project.run("git", "commit", "-qm", "a remote")
    project.run(sys.executable, "-m", "dvc", "push", "-q")
    project.run("git", "clone", "-q", "--bare", str(project.folder), str(tmp_path / "origin.git"))
    project.run("git", "remote", "add", "origin", str(tmp_path / "origin.git"))
    project.run("git", "fetch", "-q")
    project.raw = raw
    return project, Runner(tmp_path / "hosted", tmp_path / "origin.git")


def pushed(project: Project, message: str) -> None:
    """A commit of a person, on the server."""
    project.run("git", "add", "-A")
    project.run("git", "commit", "-qm", message)
    project.run("git", "pull", "-q", "--no-rebase", "--no-edit", "origin", "main")
    project.run("git", "push", "-q", "origin", "HEAD:main")


@pytest.mark.slow
def test_the_schedule_keeps_what_a_night_remembers_after_status_4_and_merges_what_was_pushed_meanwhile(
    hosted,
):
    project, runner = hosted
    (project.raw / "kept.mcap").write_bytes(BROKEN)
    project.record("second", [9.0] * 3)
    pushed(project, "recordings")

    def meanwhile() -> None:
        (project.folder / "notes.md").write_text("pushed while the night ran")
        pushed(project, "notes")

    clone, ended = runner.job(before_push=meanwhile)
    assert ended["night"] == night.QUARANTINED and ended["push"] == 0, runner.said
    # the promotion is on the server, beside the commit that came meanwhile
    project.run("git", "fetch", "-q")
    shown = json.loads(project.run("git", "show", "origin/main:champion.json").stdout)
    assert shown["champions"]["toy"]["run"] == "night-0002"
    assert project.run("git", "show", "origin/main:notes.md").stdout == "pushed while the night ran"
    assert (
        "kept.mcap" in project.run("git", "show", "origin/main:datasets/raw/deposition/excluded.yaml").stdout
    )

    # what was dropped on that machine alone, and what drift had been seen, is there the next night
    last = json.loads((clone.folder / ".beadline/last.json").read_text())
    assert last["night"] == 2
    memory = runner.place / "cache/nightly-memory/1"
    aside = memory / "datasets/quarantine/deposition"
    aside.mkdir(parents=True)
    (aside / "dropped.mcap").write_bytes(BROKEN)
    last["drift"] = {"pending": ["toy: gain"], "alarms": [], "drifted": {}, "night": 2}
    (memory / ".beadline/last.json").write_text(json.dumps(last))
    clone, ended = runner.job()
    assert ended["night"] == night.OK and ended["push"] == 0, runner.said
    assert (clone.folder / "datasets/quarantine/deposition/dropped.mcap").read_bytes() == BROKEN
    now = json.loads((clone.folder / ".beadline/last.json").read_text())
    assert now["night"] == 3 and now["drift"]["pending"] == ["toy: gain"]


@pytest.mark.slow
def test_a_night_of_the_schedule_whose_push_fails_is_repeated_and_loses_no_promotion(hosted):
    project, runner = hosted
    project.record("second", [9.0] * 3)
    pushed(project, "recordings")
    hook = runner.origin / "hooks/pre-receive"
    hook.write_text("#!/bin/sh\nexit 1\n")
    hook.chmod(0o755)
    clone, ended = runner.job()
    assert ended["night"] == 0 and ended["push"] != 0
    assert clone.champion()["run"] == "night-0002" and not (runner.place / "cache/nightly-memory").exists()
    hook.unlink()
    clone, ended = runner.job()
    assert ended == {"./run dvc pull --allow-missing": 0, "night": 0, "push": 0}, runner.said
    assert (
        clone.run("git", "show", "origin/main:champion.json").stdout
        == (clone.folder / "champion.json").read_text()
    )
    assert clone.champion()["run"] == "night-0002"


@pytest.mark.slow
def test_promotions_of_the_schedule_wait_on_the_servers_branch_one_on_top_of_another(hosted):
    project, runner = hosted
    change_params(project, promotion="branch")
    for k in range(2):
        project.record(f"shift_{k}", BETTER[k])
        pushed(project, f"shift {k}")
        _, ended = runner.job()
        assert ended["night"] == 0 and ended["push"] == 0, runner.said
    project.run("git", "fetch", "-q")
    assert runs(champion.of_branch("origin/nightly")) == ["night-0001", "night-0002", "night-0003"]
    assert runs(champion.of_branch("origin/main")) == ["night-0001"]
    project.run("git", "merge", "-q", "--ff-only", "origin/nightly")
    project.run(sys.executable, "-m", "dvc", "pull", "-q", "champion/toy.dvc")
    assert project.production()["learn/model.json"] == b"10.35"


def test_the_schedule_saves_what_it_restores_whatever_the_nights_status():
    steps = yaml.safe_load(SCHEDULE.read_text(encoding="utf-8"))["jobs"]["nightly"]["steps"]

    def of(action: str) -> list[tuple[str, str]]:
        return sorted(
            (step["with"]["key"], step["with"]["path"])
            for step in steps
            if step.get("uses", "").startswith(f"actions/cache/{action}@")
        )

    assert of("save") == of("restore") and len(of("save")) == 2
    assert all("always()" in step["if"] for step in steps if "cache/save" in step.get("uses", ""))
    assert not any("--force" in step.get("run", "") for step in steps)


# ---- a night with one new recording


WIRING = yaml.safe_load((ROOT / "dvc.yaml").read_text(encoding="utf-8"))["stages"]


def depending_on(place: str) -> set[str]:
    """The stages that may run again where something below `place` is new, by the project's own wiring."""

    def outs(stage: str) -> list[str]:
        every = [*WIRING[stage].get("outs", []), *WIRING[stage].get("metrics", [])]
        return [out if isinstance(out, str) else next(iter(out)) for out in every]

    touched, stages = [place], set()
    while touched:
        here = touched.pop()
        for stage in WIRING.keys() - stages:
            deps = WIRING[stage].get("deps", [])
            if any(f"{dep}/".startswith(f"{here}/") or f"{here}/".startswith(f"{dep}/") for dep in deps):
                stages.add(stage)
                touched += outs(stage)
    return stages


@pytest.mark.parametrize(
    ("loop", "stages"),
    [
        (
            "temperature",
            "ingest identify_plant learn_kernel generate_probing tune_weights evaluate_temperature "
            "certify verdict export_controllers report",
        ),
        ("deposition", "train_ilc segment_library compose_parts verdict export_controllers report"),
        ("setpoint", "train_classifier evaluate_setpoint certify verdict export_controllers report"),
    ],
)
def test_a_new_recording_reruns_the_stages_of_its_own_loop_and_the_pages(loop, stages):
    assert depending_on(f"datasets/raw/{loop}") == set(stages.split())


def test_a_new_recording_reruns_in_a_night_only_the_stages_that_read_it(project):
    """By DVC itself: of two chains the one runs, and of that not what its results leave as it was."""
    (project.folder / "apart.py").write_text(
        "import pathlib; p = pathlib.Path('datasets/apart'); p.mkdir(parents=True, exist_ok=True);"
        "n = len(list(pathlib.Path('datasets/raw/other').glob('*.csv'))); (p / 'n').write_text(str(n))"
    )
    wiring = yaml.safe_load((project.folder / "dvc.yaml").read_text())
    wiring["stages"]["apart"] = {
        "cmd": "python apart.py", "deps": ["apart.py", "datasets/raw/other"], "outs": ["datasets/apart"],
    }  # fmt: skip
    (project.folder / "dvc.yaml").write_text(yaml.safe_dump(wiring))
    (project.folder / "datasets/raw/other").mkdir()
    (project.folder / "datasets/raw/other/first.csv").write_text("1")
    project.run("git", "add", "-A")
    project.run("git", "commit", "-qm", "two chains")
    night.nightly(render_night)
    project.record("second", [11.0] * 3)  # the mean is as before
    status, summary = night.nightly(render_night)
    assert status == night.OK, summary
    log = (project.folder / f".beadline/logs/{remembered.nights()[-1].run}.log").read_text()
    assert re.findall(r"Running stage '(\w+)'", log) == ["learn"]
