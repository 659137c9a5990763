"""The run of a commit, a tag, a branch or a DVC experiment, as git has it: metrics and parameters."""

import json
import subprocess
from typing import Any

import yaml

from pipeline.report.runs.page import Run
from pipeline.store import params

METRICS = "reports/metrics"


def run_of(name: str) -> Run:
    """The run that git has under a name. Raises ValueError if there is no such commit, or none of its
    metrics."""
    commit = commit_of(name)
    files = git("ls-tree", "--name-only", commit, f"{METRICS}/").split()
    metrics = {
        path.rsplit("/", 1)[1].removesuffix(".json"): _parsed(name, commit, path)
        for path in files
        if path.endswith(".json")
    }
    if not metrics:
        raise ValueError(f"{name}: commit {commit[:8]} has no {METRICS}; name a commit that holds a run")
    parameters: dict[str, Any] = {}
    for path in (params.FILE, params.EXPERT):
        parameters |= _parsed(name, commit, path) if git("ls-tree", commit, path) else {}
    shown = commit[:8] if commit.startswith(name) else f"{name} ({commit[:8]})"
    return Run(shown, metrics, parameters)


def git(*arguments: str) -> str:
    """What git printed. Raises ValueError with its reason if it fails."""
    try:
        return subprocess.run(["git", *arguments], capture_output=True, check=True).stdout.decode(
            errors="replace"
        )
    except FileNotFoundError:
        raise ValueError("git is not installed; install it to compare commits") from None
    except subprocess.CalledProcessError as error:
        raise ValueError(" ".join(error.stderr.decode(errors="replace").split())) from None


def commit_of(name: str) -> str:
    """The hash of a commit; an experiment's name stands at the end of its ref, refs/exps/xx/yyy/NAME."""
    experiments = git("for-each-ref", "--format=%(objectname) %(refname)", "refs/exps").splitlines()
    named = [line.split(" ", 1)[0] for line in experiments if line.endswith(f"/{name}")]
    if named:
        return named[-1]
    try:
        return git("rev-parse", "--verify", "--quiet", "--end-of-options", f"{name}^{{commit}}").strip()
    except ValueError:
        raise ValueError(
            f"{name}: expected a commit, a tag, a branch or a DVC experiment, found none of this name; "
            "git log --oneline and ./run dvc exp list show the names"
        ) from None


def _parsed(name: str, commit: str, path: str) -> dict:
    """A file of a commit; JSON is read as JSON, else YAML."""
    text = git("show", f"{commit}:{path}")
    try:
        data = json.loads(text) if path.endswith(".json") else yaml.safe_load(text)
    except (ValueError, yaml.YAMLError, RecursionError):
        data = None
    if not isinstance(data, dict):
        raise ValueError(f"{name}: {path} of commit {commit[:8]} cannot be read; name another commit")
    return data
