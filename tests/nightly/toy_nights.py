"""A project of two fast stages in a repository of its own, on which the nightly job's mechanics are played:
learn the mean of all recordings, and judge it on eight cases."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from pipeline.store import params

ROOT = Path(__file__).resolve().parents[2]

LEARN = """
import json, pathlib, sys, time
values = []
for path in sorted(pathlib.Path("datasets/raw/toy").rglob("*.csv")):
    try:
        values += [float(line) for line in path.read_text().split()]
    except ValueError:
        sys.exit(f"learn: {path}: expected numbers, found none; mend the file")
if not values:
    sys.exit("learn: datasets/raw/toy: expected at least one recording, found none; copy one there")
time.sleep(float(pathlib.Path("slow.txt").read_text()) if pathlib.Path("slow.txt").exists() else 0)
out = pathlib.Path("datasets/learn")
out.mkdir(parents=True, exist_ok=True)
(out / "model.json").write_text(json.dumps(sum(values) / len(values)))
(out / "weights.bin").write_bytes(bytes(range(256)) * 4000 + str(values).encode())
metrics = pathlib.Path("reports/metrics/learn.json")
metrics.parent.mkdir(parents=True, exist_ok=True)
metrics.write_text(json.dumps({"mean": sum(values) / len(values), "samples": len(values)}))
"""

# the true mean is 10; a case costs 1 and how far the model is from it
EVALUATE = """
import json, pathlib
model = json.loads(pathlib.Path("datasets/learn/model.json").read_text())
cases = {f"case {k}": {"block": f"plant {k}", "cost": 1 + abs(model - 10) + 0.001 * k} for k in range(8)}
out = pathlib.Path("datasets/evaluate")
out.mkdir(parents=True, exist_ok=True)
guards = {"worst": {"value": abs(model - 10), "allowed": 0.1}, "unstable": {"value": 0, "allowed": 0}}
(out / "cases.json").write_text(json.dumps({"panel": "toy 1", "cases": cases, "guards": guards}))
"""

DVC = """
stages:
  learn:
    cmd: python learn.py
    deps: [learn.py, datasets/raw/toy]
    outs: [datasets/learn: {persist: true}]
    metrics: [reports/metrics/learn.json: {cache: false, persist: true}]
  evaluate:
    cmd: python evaluate.py
    deps: [evaluate.py, datasets/learn/model.json]
    outs: [datasets/evaluate: {persist: true}]
"""

# the project's own keys, so that a new one is here at once; what a toy needs otherwise stands below
SECTIONS = params.read(ROOT / "params.yaml")
SETTINGS = SECTIONS["nightly"] | {
    "promotion": "at_once", "branch": "nightly", "remote": "", "longest_h": 0.1, "least_free_mb": 1,
    "watch_h": 36, "alarm": "", "webhook": "", "heartbeat": "",
    "loops": {
        "toy": {
            "artifacts": ["datasets/learn/model.json", "datasets/learn/weights.bin",
            "datasets/evaluate/cases.json"], "judge": "cases",
            "cases": "datasets/evaluate/cases.json", "recordings": "datasets/raw/toy",
        }
    },
}  # fmt: skip
SETTINGS["rule"] |= {"least_disk_margin": 0.5}
SETTINGS["holdout"] |= {
    "starts_degC": [20], "reference_offsets_degC": [0], "plants": 8, "steps": 300
}  # fmt: skip


class Project:
    """The toy project in a folder; `night` runs the job as a scheduler would, in a process of its own."""

    def __init__(self, folder: Path):
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        ours = ("GIT_", "DVC_", "BEADLINE_")
        self.env = {key: value for key, value in os.environ.items() if not key.startswith(ours)} | {
            "PYTHONPATH": str(ROOT), "DVC_NO_ANALYTICS": "1", "GIT_CONFIG_GLOBAL": "/dev/null",
            "GIT_CONFIG_SYSTEM": "/dev/null",
            "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        }  # fmt: skip

    def make(self) -> "Project":
        self.run("git", "init", "-q", "-b", "main")
        self.run("git", "config", "user.email", "somebody@example.com")
        self.run("git", "config", "user.name", "Somebody")
        self.run(sys.executable, "-m", "dvc", "init", "-q")
        self.run(sys.executable, "-m", "dvc", "config", "core.analytics", "false")
        for name, text in {
            "learn.py": LEARN,
            "evaluate.py": EVALUATE,
            "dvc.yaml": DVC,
            "params.expert.yaml": "{}\n",
            ".gitignore": "/reports/*.html\n",
        }.items():
            (self.folder / name).write_text(text)
        self.set()
        self.record("first", [11.0, 11.0, 11.0])
        self.run("git", "add", "-A")
        self.run("git", "commit", "-q", "-m", "the project")
        return self

    def set(self, loops_on: dict[str, bool] | None = None, **changes) -> None:
        """params.yaml with these keys of section nightly changed; JSON is YAML. `loops_on`: section loops."""
        sections = SECTIONS | {"nightly": SETTINGS | changes}
        sections["loops"] = sections["loops"] | (loops_on or {})
        (self.folder / "params.yaml").write_text(json.dumps(sections, indent=1))

    def record(self, name: str, values: list[float]) -> Path:
        path = self.folder / "datasets/raw/toy" / f"{name}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(map(str, values)))
        return path

    def run(self, *command: str, check: bool = True) -> subprocess.CompletedProcess:
        ended = subprocess.run(
            command, check=False, cwd=self.folder, env=self.env, capture_output=True, text=True
        )
        assert not check or ended.returncode == 0, f"{command}: {ended.stdout}{ended.stderr}"
        return ended

    def beadline(self, *arguments: str) -> subprocess.CompletedProcess:
        return self.run(sys.executable, "-m", "pipeline.cli", *arguments, check=False)

    def start(self, **how) -> subprocess.Popen:
        """A night under way; `how` is handed to Popen."""
        return subprocess.Popen(
            [sys.executable, "-m", "pipeline.cli", "nightly"],
            cwd=self.folder,
            env=self.env,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            **how,
        )

    def night(self) -> subprocess.CompletedProcess:
        return self.beadline("nightly")

    def promoted(self, loop: str = "toy") -> "Project":
        """The project after a night that put what it learned into production."""
        ended = self.night()
        assert ended.returncode == 0 and f"promoted {loop}" in ended.stdout, ended
        return self

    def head(self) -> str:
        return self.run("git", "rev-parse", "HEAD").stdout.strip()

    def champion(self) -> dict:
        """As the last commit has it."""
        return self.champion_of("toy")

    def champion_of(self, loop: str) -> dict:
        shown = self.run("git", "show", "HEAD:champion.json", check=False)
        return json.loads(shown.stdout)["champions"].get(loop, {}) if shown.returncode == 0 else {}

    def production(self) -> dict[str, bytes]:
        return self.production_of("toy")

    def production_of(self, loop: str) -> dict[str, bytes]:
        folder = self.folder / "champion" / loop
        return {
            path.relative_to(folder).as_posix(): path.read_bytes()
            for path in sorted(folder.rglob("*"))
            if path.is_file()
        }

    def dirty(self) -> list[str]:
        return self.run("git", "status", "--porcelain").stdout.splitlines()


def entered(project: Project, place: Path, monkeypatch) -> Project:
    """A copy of a project at `place`, and this process in it, as the job is."""
    shutil.copytree(project.folder, place, symlinks=True)
    copy = Project(place)
    monkeypatch.chdir(copy.folder)
    for name in ("PATH", "PYTHONPATH", "DVC_NO_ANALYTICS", "GIT_CONFIG_GLOBAL", "GIT_CONFIG_SYSTEM"):
        monkeypatch.setenv(name, copy.env[name])
    return copy
