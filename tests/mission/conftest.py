"""What the mission's tests share: a copy of this checkout at toy sizes in a repository of its own, in which
`./run` works with the environment of this process, and results that are made once for all workers."""

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from pipeline.store import artifacts, params
from tests.foreign import two_zones

ROOT = Path(__file__).resolve().parents[2]
# what an owner's project is made of; tests and documents are no part of it
PARTS = (
    "run", "pyproject.toml", "uv.lock", ".python-version", "README.md", ".dvcignore", ".gitignore",
    "dvc.yaml", "params.yaml", "params.expert.yaml", "pipeline", "stages", "datasets",
)  # fmt: skip
# made by stages, or by nights: none of it is copied
MADE = ("memo", "*.tmp", "__pycache__")


class Project:
    """A copy of the checkout in a folder. `run` is its own ./run, with the environment of this process."""

    def __init__(self, folder: Path):
        self.folder = folder
        ours = ("GIT_", "DVC_", "BEADLINE_")
        self.env = {key: value for key, value in os.environ.items() if not key.startswith(ours)} | {
            "PYTHONPATH": str(folder), "UV_NO_SYNC": "1", "UV_PROJECT_ENVIRONMENT": sys.prefix,
            "PYTHONDONTWRITEBYTECODE": "1", "GIT_CONFIG_GLOBAL": "/dev/null",
            "GIT_CONFIG_SYSTEM": "/dev/null",
            "PATH": f"{os.environ['PATH']}{os.pathsep}{ROOT / '.uv/bin'}",
        }  # fmt: skip

    def make(self) -> "Project":
        self.folder.mkdir(parents=True)
        for name in PARTS:
            if (ROOT / name).is_dir():
                shutil.copytree(ROOT / name, self.folder / name, ignore=shutil.ignore_patterns(*MADE))
            elif (ROOT / name).exists():
                shutil.copy(ROOT / name, self.folder / name)
        for stage in params_of(self.folder / "dvc.yaml")["stages"]:
            shutil.rmtree(self.folder / "datasets" / stage, ignore_errors=True)
        for command in (
            ("git", "init", "-q", "-b", "main"),
            ("git", "config", "user.email", "somebody@example.com"),
            ("git", "config", "user.name", "Somebody"),
            (sys.executable, "-m", "dvc", "init", "-q"),
        ):
            self.command(*command)
        (self.folder / ".dvc/config").write_text((ROOT / ".dvc/config").read_text())
        return self

    def command(
        self, *command: str, check: bool = True, cwd: Path | None = None, **outside: str
    ) -> subprocess.CompletedProcess:
        ended = subprocess.run(
            command,
            check=False,
            cwd=cwd or self.folder,
            env=self.env | outside,
            capture_output=True,
            text=True,
        )
        if check and ended.returncode:  # no AssertionError: a set-up that fails is no expected failure
            raise RuntimeError(f"{command}: {ended.stdout}{ended.stderr}")
        return ended

    def run(self, *command: str, check: bool = True, **outside: str) -> subprocess.CompletedProcess:
        """`./run COMMAND`, with these variables set outside."""
        return self.command("./run", *command, check=check, **outside)

    def beadline(self, *arguments: str, check: bool = True) -> subprocess.CompletedProcess:
        return self.run("python", "-m", "pipeline.cli", *arguments, check=check)

    def declare(self, changes: Mapping[str, Any]) -> "Project":
        """Sets dotted keys of params.yaml or params.expert.yaml, wherever they stand."""
        path = self.folder / "params.yaml"
        files = params.files(path)
        for dotted, value in changes.items():
            sections = files[params.home(dotted, path)]
            *parents, key = dotted.split(".")
            for parent in parents:
                sections = sections[parent]
            sections[key] = value
        for name, sections in files.items():
            Path(name).write_text(yaml.safe_dump(sections, sort_keys=False, allow_unicode=True))
        return self

    def keep_stages(self, *names: str) -> "Project":
        """dvc.yaml with these stages alone."""
        path = self.folder / "dvc.yaml"
        stages = params_of(path)["stages"]
        path.write_text(yaml.safe_dump({"stages": {name: stages[name] for name in names}}, sort_keys=False))
        return self

    def commit(self) -> "Project":
        self.command("git", "add", "-A")
        self.command("git", "commit", "-q", "-m", "the project")
        return self

    def made(self) -> dict[str, str]:
        """SHA-256 of all that stages made, and of dvc.lock: a left-over is a file too many."""
        raw = {self.folder / "datasets" / name for name in ("raw", "memo", "holdout", *UNMADE)}
        paths = [self.folder / "dvc.lock", *(self.folder / "datasets").rglob("*")]
        paths += (self.folder / "reports").rglob("*")
        return {
            path.relative_to(self.folder).as_posix(): artifacts.sha256(path)
            for path in sorted(paths)
            if path.is_file() and path.name != "machine.js" and not raw & {*path.parents}
        }

    def unmade(self) -> "Project":
        """Nothing made, nothing remembered, nothing in DVC's cache."""
        for stage in params_of(self.folder / "dvc.yaml")["stages"]:
            shutil.rmtree(self.folder / "datasets" / stage, ignore_errors=True)
        for name in ("datasets/memo", "reports", ".dvc/cache", ".dvc/tmp"):
            shutil.rmtree(self.folder / name, ignore_errors=True)
        (self.folder / "dvc.lock").unlink(missing_ok=True)
        return self

    def copy(self, folder: Path) -> "Project":
        shutil.copytree(self.folder, folder, symlinks=True)
        return Project(folder)


UNMADE = ("kept", "papers", "parts", "published")


def params_of(path: Path) -> dict[str, Any]:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


# ---- an owner's machine of two zones

STAGES = ("probe_machine", "ingest", "identify_plant", "learn_kernel", "generate_probing", "tune_weights")
TOY = {
    "execution.jobs": 1,
    "generate_probing.samples": 200,
    "identify_plant.max_order": 4,
    "identify_plant.refinement": "none",
    "identify_plant.feedthrough": "none",
    "identify_plant.spread_plants": 20,
    "learn_kernel.longest_window": 8,
    "panel.steps": 200,
    "panel.settled_steps": 40,
    "panel.judging.plants": 6,
    "panel.judging.starts_degC": [50],
    "panel.judging.reference_offsets_degC": [0],
    "panel.judging.sequence_offsets_degC": [0, -5],
    "panel.training.plants": 4,
    "panel.training.starts_degC": [50],
    "panel.training.sequence_offsets_degC": [],
    "tune_weights.practical_initial": 8,
    "tune_weights.practical_evaluations": 10,
}


@pytest.fixture(scope="session")
def owner(made_once) -> Project:
    """A project that an owner began from two recordings, `beadline init` and one repro of the temperature
    loop up to its tuned controllers. Shared: copy it before you change it."""

    def make(folder: Path) -> None:
        project = Project(folder).make().keep_stages(*STAGES)
        shutil.rmtree(folder / "datasets/raw/temperature")
        logs = [
            two_zones.write_csv(
                folder / f"logs/shift_{k}.csv", two_zones.record_shift(np.random.default_rng(k))
            )
            for k in range(2)
        ]
        project.beadline("init", *map(str, logs), "--copy", "--force")
        shutil.rmtree(folder / "logs")
        # what no recording tells, and init asks an owner for
        outputs = params_of(folder / "params.yaml")["plant"]["outputs"]
        allowed = [output | {"low": 0, "high": 280} for output in outputs]
        project.declare(TOY | {"plant.outputs": allowed}).commit()
        project.run("dvc", "repro")

    return Project(made_once("owner", make))
