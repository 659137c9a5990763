"""The workflow's promises, by `./run dvc repro` on an owner's project: what has not changed is not made
again, and the bytes depend on the inputs alone."""

import os
import re
import shutil
import signal
import subprocess
import time
import tomllib

import numpy as np
import pytest

from tests.foreign import two_zones

# what another shell may have set, for other kernels of NumPy, OpenBLAS, OpenCV and XLA, and other threads
OUTSIDE = {
    "OPENBLAS_CORETYPE": "Prescott",
    "NPY_DISABLE_CPU_FEATURES": "AVX2 FMA3",
    "XLA_FLAGS": "--xla_cpu_max_isa=SSE4_2",
    "OPENCV_CPU_DISABLE": "AVX2",
    "OPENBLAS_NUM_THREADS": "2",
    "OMP_NUM_THREADS": "2",
    "NPROC": "1",
}
# how packages that `./run pytest` installs are imported, if not by their own name
IMPORTED = {"axe-playwright-python": "axe_playwright_python", "pytest-xdist": "xdist"}
FORBID = """
import sys

class Forbidden:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {names!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}: only ./run pytest installs it", name=name)

sys.meta_path.insert(0, Forbidden())
"""


@pytest.fixture
def project(owner, tmp_path):
    """A copy of the owner's project, all of it made."""
    return owner.copy(tmp_path / "project")


@pytest.fixture
def fresh(project):
    """The same with nothing made."""
    return project.unmade()


@pytest.fixture
def before_pytest(root, tmp_path):
    """A folder for PYTHONPATH that hides the packages of the group `dev` from every process."""
    declared = tomllib.loads((root / "pyproject.toml").read_text())
    core = {re.split(r"[^\w-]", name)[0] for name in declared["project"]["dependencies"]}
    dev = {re.split(r"[^\w-]", name)[0] for name in declared["dependency-groups"]["dev"]} - core
    names = {IMPORTED.get(name, name.replace("-", "_")) for name in dev}
    folder = tmp_path / "before_pytest"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(FORBID.format(names=names))
    return folder


def stages_run(said: str) -> list[str]:
    return re.findall(r"Running stage '(\w+)'", said)


def test_a_second_repro_does_nothing(owner, project):
    said = project.run("dvc", "repro").stdout
    assert stages_run(said) == []
    assert "up to date" in said
    assert project.made() == owner.made()


def test_one_more_recording_runs_only_what_follows_from_it(project):
    recording = two_zones.record_shift(np.random.default_rng(2))
    two_zones.write_csv(project.folder / "datasets/raw/temperature/shift_2.csv", recording)
    ended = project.run("dvc", "repro", "identify_plant")
    assert stages_run(ended.stdout) == ["ingest", "identify_plant"]
    # of the three recordings one is read, and two are remembered
    assert re.search(r"\b1 recordings? read, 2\b", ended.stdout + ended.stderr)


def wait_for_end(group: int) -> None:
    """Returns when no process of the group is left: who is killed is not gone at once, and DVC takes its lock
    for held as long as its number is in use."""
    for _ in range(3000):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    raise RuntimeError(f"a process of group {group} outlives its kill")


def test_a_repro_that_is_killed_leaves_what_the_next_one_needs(owner, fresh):
    for stage in ("ingest", "learn_kernel"):
        with subprocess.Popen(
            ["./run", "dvc", "repro"], cwd=fresh.folder, env=fresh.env, text=True, bufsize=1,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
        ) as child:  # fmt: skip
            reached = any(f"Running stage '{stage}'" in line for line in child.stdout)
            os.killpg(child.pid, signal.SIGKILL)
        assert reached and child.returncode == -signal.SIGKILL
        wait_for_end(child.pid)
    fresh.run("dvc", "repro")
    assert fresh.made() == owner.made()


def test_other_kernels_one_core_and_no_pytest_change_no_byte(owner, fresh, before_pytest):
    """The owner's project was made in this process's environment, after `./run pytest`."""
    taskset = ("taskset", "-c", str(min(os.sched_getaffinity(0)))) if shutil.which("taskset") else ()
    path = f"{before_pytest}{os.pathsep}{fresh.folder}"
    hidden = fresh.command("./run", "python", "-c", "import hypothesis", check=False, PYTHONPATH=path)
    assert "only ./run pytest installs it" in hidden.stderr
    fresh.command(*taskset, "./run", "dvc", "repro", PYTHONPATH=path, **OUTSIDE)
    assert fresh.made() == owner.made()


def test_an_empty_table_of_locks_is_healed(owner, project):
    table = project.folder / ".dvc/tmp/rwlock"
    table.write_text("")
    ended = project.run("dvc", "repro", "ingest")
    assert "left half written by a killed DVC" in ended.stderr
    assert project.made() == owner.made()


def test_a_stage_that_fails_leaves_the_last_good_results(owner, project):
    broken = project.folder / "datasets/raw/temperature/broken.csv"
    broken.write_text("no table at all")
    project.declare({"ingest.strict": True})
    ended = project.run("dvc", "repro", check=False)
    assert ended.returncode != 0
    (sentence,) = [line for line in ended.stderr.splitlines() if line.startswith("ingest: ")]
    assert broken.name in sentence
    assert project.made() == owner.made()
    broken.unlink()
    project.declare({"ingest.strict": False})
    assert stages_run(project.run("dvc", "repro").stdout) == []
