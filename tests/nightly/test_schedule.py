"""schedules/github-nightly.yml, played step by step on this machine: the server is a bare repository and a
folder for DVC."""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from pipeline.nightly import champion, reporting
from tests.conftest import ROOT
from tests.nightly.toy_nights import Project

STEPS = yaml.safe_load((ROOT / "schedules/github-nightly.yml").read_text(encoding="utf-8"))["jobs"][
    "nightly"
]["steps"]
RUN = f"""#!/bin/sh
case $1 in
dvc) shift; exec "{sys.executable}" -m dvc "$@";;
beadline) shift; exec "{sys.executable}" -m pipeline.cli "$@";;
esac
"""


class Runner:
    """GitHub's machine for the job: a clone that is new every night, and a cache that outlives it."""

    def __init__(self, place: Path, origin: Path):
        self.place, self.origin, self.jobs, self.printed = place, origin, 0, ""

    def work(self, before_push: Callable[[], None] = lambda: None) -> tuple[Project, dict[str, int]]:
        """The clone after the job, and the exit status of the steps that have a name."""
        self.jobs += 1
        clone, ended, good = Project(self.place / f"job {self.jobs}"), {}, True
        clone.env |= {"GITHUB_REF_NAME": "main"}
        for step in STEPS:
            condition = step.get("if", "")
            assert condition in ("", "always()", "always() && steps.push.outcome == 'success'")
            if (not condition and not good) or ("push" in condition and ended["push"]):
                continue
            if "uses" in step:
                self.use(step["uses"].partition("@")[0], clone, step.get("with", {}))
                continue
            if step.get("id") == "push":
                before_push()
            shell = clone.run("bash", "-e", "-o", "pipefail", "-c", step["run"], check=False)
            self.printed = shell.stdout + shell.stderr
            ended[step.get("id", "pull")] = shell.returncode
            good = good and shell.returncode == 0
        return clone, ended

    def use(self, action: str, clone: Project, given: dict) -> None:
        if action == "actions/checkout":
            clone.folder.rmdir()
            subprocess.run(
                ["git", "clone", "-q", str(self.origin), str(clone.folder)], check=True, env=clone.env
            )
        if not action.startswith("actions/cache/"):
            assert action in ("actions/checkout", "actions/setup-python", "actions/upload-artifact")
            return
        # the newest entry whose key begins so; an entry is never written twice
        entries = self.place / "cache" / given["key"].partition("-${{")[0]
        newest = max(entries.glob("*"), key=lambda entry: int(entry.name), default=None)
        for path in (path for path in given["path"].split() if not path.startswith("~")):
            if action.endswith("/save") and (clone.folder / path).exists():
                shutil.copytree(clone.folder / path, entries / str(self.jobs) / path, symlinks=True)
            elif action.endswith("/restore") and newest and (newest / path).exists():
                shutil.copytree(newest / path, clone.folder / path, dirs_exist_ok=True)


def push(project: Project, message: str) -> None:
    """A commit of a person, on the server."""
    project.run("git", "add", "-A")
    project.run("git", "commit", "-qm", message)
    project.run("git", "pull", "-q", "--no-rebase", "--no-edit", "origin", "main")
    project.run("git", "push", "-q", "origin", "HEAD:main")


def get_production(project: Project, branch: str = "main") -> list[str]:
    """The runs of the toy's champions on the server, the oldest first."""
    project.run("git", "fetch", "-q", "origin")
    state = json.loads(project.run("git", "show", f"origin/{branch}:champion.json").stdout)
    return [line["run"] for line in state["history"]]


@pytest.fixture
def hosted(project, tmp_path):
    """The project of a person, and a runner, with one server."""
    project.run("dvc", "remote", "add", "-q", "-d", "store", str(tmp_path / "remote"))
    project.set(remote="store")
    Path("run").write_text(RUN)
    Path("run").chmod(0o755)
    project.run("git", "add", "-A")
    project.run("git", "commit", "-qm", "a remote")
    project.run("dvc", "push", "-q")
    project.run("git", "clone", "-q", "--bare", str(project.folder), str(tmp_path / "origin.git"))
    project.run("git", "remote", "add", "origin", str(tmp_path / "origin.git"))
    return project, Runner(tmp_path / "hosted", tmp_path / "origin.git")


@pytest.mark.slow
def test_the_job_merges_what_was_pushed_meanwhile_and_remembers_the_night(hosted):
    project, runner = hosted
    project.record("better", [9.0, 9.0, 9.0])
    push(project, "a recording")

    def work_meanwhile():
        Path("notes.md").write_text("pushed while the night ran")
        push(project, "notes")

    clone, ended = runner.work(work_meanwhile)
    assert ended == {"pull": 0, "night": reporting.OK, "push": 0}, runner.printed
    assert get_production(project) == ["night-0001", "night-0002"]
    assert project.run("git", "show", "origin/main:notes.md").stdout == "pushed while the night ran"
    assert clone.production()["learn/model.json"] == b"10.0"
    # the next machine has the memory and the champion
    clone, ended = runner.work()
    assert ended == {"pull": 0, "night": reporting.OK, "push": 0}, runner.printed
    last = json.loads((clone.folder / ".beadline/memory.json").read_text())
    assert last["night"] == 3 and last["idle"] == 1
    assert clone.production()["learn/model.json"] == b"10.0"


@pytest.mark.slow
def test_a_job_whose_push_fails_is_repeated_and_one_whose_merge_conflicts_fails(hosted):
    project, runner = hosted
    project.record("better", [9.0, 9.0, 9.0])
    push(project, "a recording")

    def conflict():
        metrics = project.folder / "reports/metrics/learn.json"
        metrics.write_text('{"mean": "by hand"}')
        push(project, "figures by hand")

    clone, ended = runner.work(conflict)
    assert ended["night"] == reporting.OK and ended["push"] != 0
    assert clone.champion()["run"] == "night-0002" and get_production(project) == ["night-0001"]
    # the memory of that night is not kept: the next one promotes again
    assert not (runner.place / "cache/nightly-memory").exists()
    clone, ended = runner.work()
    assert ended == {"pull": 0, "night": reporting.OK, "push": 0}, runner.printed
    assert get_production(project) == ["night-0001", "night-0002"]


@pytest.mark.slow
def test_promotions_of_the_job_wait_on_the_server_s_branch_until_a_person_merges(hosted):
    project, runner = hosted
    project.set(promotion="branch", remote="store")
    push(project, "a person decides")
    for k, value in enumerate((9.5, 9.0)):
        project.record(f"better {k}", [value, value])
        push(project, f"recording {k}")
        _, ended = runner.work()
        assert ended == {"pull": 0, "night": reporting.OK, "push": 0}, runner.printed
    assert get_production(project) == ["night-0001"]
    assert get_production(project, "nightly")[-1] == "night-0003"
    project.run("git", "merge", "-q", "--no-edit", "origin/nightly")
    project.run("dvc", "pull", "-q", "champion/toy.dvc")
    assert project.champion()["run"] == "night-0003"
    assert champion.md5s(Path("champion/toy")) == champion.read().champions["toy"].files


def test_the_job_saves_what_it_restores_whatever_the_night_s_status():
    def list_caches(action: str) -> list[tuple[str, str]]:
        used = [step for step in STEPS if step.get("uses", "").startswith(f"actions/cache/{action}@")]
        return sorted((step["with"]["key"], step["with"]["path"]) for step in used)

    assert list_caches("save") == list_caches("restore") and len(list_caches("save")) == 2
    assert all("always()" in step["if"] for step in STEPS if "cache/save" in step.get("uses", ""))
    assert not any("--force" in step.get("run", "") for step in STEPS)
