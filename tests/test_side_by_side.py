"""A first `./run dvc repro`: the loops side by side, then the rest."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from pipeline.side_by_side import ENDS, new_loops
from tests import fake_uv


@pytest.fixture
def copy(root, tmp_path):
    """A project whose loops have no results."""
    fake_uv.furnish(tmp_path, root)
    for ends in ENDS.values():
        for end in ends:
            (tmp_path / "datasets" / end).rmdir()
    return tmp_path


def asked(loop: str) -> str:
    return f"{loop}: dvc --wait-for-lock repro {' '.join(ENDS[loop])}"


def start(copy: Path, dvc: str) -> subprocess.Popen[str]:
    """./run dvc repro with a DVC of this code, in the background."""
    fake_uv.write(copy / "fake/dvc/cli.py", dvc)
    return subprocess.Popen(
        ["./run", "dvc", "repro"],
        cwd=copy,
        env=fake_uv.environment(copy),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # a job in the background of a shell ignores SIGINT, and so does what it starts
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def test_loops_without_results_run_before_the_rest_and_each_line_names_its_loop(copy):
    ended = fake_uv.run(copy, "dvc", "repro")
    *loops, last = ended.stdout.splitlines()
    assert (ended.returncode, ended.stderr, last) == (0, "", "dvc repro")
    assert sorted(loops) == sorted(map(asked, ENDS))


def test_they_run_at_the_same_time(copy):
    """Each waits for the other two."""
    waits = """
import pathlib, time
def main(arguments):
    pathlib.Path(arguments[-1] + ".started").touch()
    while len(arguments) > 1 and len(list(pathlib.Path().glob("*.started"))) < 3:
        time.sleep(0.01)
    return 0
"""
    with start(copy, waits) as started:
        assert started.wait(timeout=60) == 0


def test_a_loop_that_has_results_or_is_off_is_left_to_the_rest(copy):
    (copy / "datasets/compose_parts").mkdir()
    *loops, last = fake_uv.run(copy, "dvc", "repro").stdout.splitlines()
    assert (sorted(loops), last) == ([asked("setpoint"), asked("temperature")], "dvc repro")
    text = (copy / "params.yaml").read_text()
    (copy / "params.yaml").write_text(text.replace("  setpoint: true", "  setpoint: false"))
    assert fake_uv.run(copy, "dvc", "repro").stdout == "dvc repro\n"


@pytest.mark.parametrize("command", ["dvc repro -f", "dvc repro train_ilc", "dvc repro --dry", "dvc status"])
def test_every_other_command_is_one_dvc(copy, command):
    assert fake_uv.run(copy, *command.split()).stdout == f"{command}\n"


def test_a_small_machine_runs_one_loop_after_the_other(tmp_path, monkeypatch):
    memory, on = tmp_path / "meminfo", dict.fromkeys(ENDS, True)
    memory.write_text("MemTotal:  8000000 kB\nMemAvailable:   3999999 kB\n")
    assert new_loops(on, tmp_path, memory) == {}
    memory.write_text("MemAvailable:   4000000 kB\n")
    assert new_loops(on, tmp_path, memory) == ENDS
    assert new_loops(on, tmp_path, tmp_path / "none") == ENDS
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    assert new_loops(on, tmp_path, memory) == {}


def test_a_loop_that_fails_stops_no_other_and_its_status_is_that_of_run(copy):
    fails = """
import sys
def main(arguments):
    if "compose_parts" in arguments:
        print("train_ilc: no trial", file=sys.stderr)
        return 7
    print("dvc", *arguments)
    return 0
"""
    fake_uv.write(copy / "fake/dvc/cli.py", fails)
    ended = fake_uv.run(copy, "dvc", "repro")
    assert ended.returncode == 7
    assert sorted(ended.stdout.splitlines()) == [asked("setpoint"), asked("temperature")]
    assert ended.stderr.splitlines() == [
        "deposition: train_ilc: no trial",
        "run: deposition ended with status 7, see its lines above",
    ]


def test_of_a_progress_bar_the_last_state_is_shown_and_what_dvc_says_at_every_end_is_not(copy):
    draws = """
import sys
def main(arguments):
    if "compose_parts" in arguments:
        sys.stderr.write("\\rtrials: 10%\\rtrials: 100%\\x1b[A\\nno end")
        print("To track the changes with git, run:\\n\\n\\tgit add dvc.lock")
    return 0
"""
    fake_uv.write(copy / "fake/dvc/cli.py", draws)
    ended = fake_uv.run(copy, "dvc", "repro")
    assert (ended.stdout, ended.stderr) == ("", "deposition: trials: 100%\ndeposition: no end\n")


def test_an_interrupt_reaches_every_loop_once(copy):
    counts = """
import time
def main(arguments):
    try:
        print("works", flush=True)
        time.sleep(90)
    except KeyboardInterrupt:
        time.sleep(0.3)
        print("interrupted", flush=True)
        return 252
"""
    with start(copy, counts) as started:
        assert started.stdout is not None
        assert sorted(started.stdout.readline() for _ in ENDS) == [
            f"{loop}: works\n" for loop in sorted(ENDS)
        ]
        started.send_signal(signal.SIGINT)
        assert started.wait(timeout=60) == 252
        assert sorted(started.stdout.readlines()) == [f"{loop}: interrupted\n" for loop in sorted(ENDS)]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
@pytest.mark.skipif(sys.platform != "linux", reason="prctl is Linux's")
def test_no_dvc_outlives_run(copy, number):
    tells = "import os, time\ndef main(arguments):\n    print(os.getpid(), flush=True)\n    time.sleep(90)\n"
    with start(copy, tells) as started:
        assert started.stdout is not None
        pids = [int(started.stdout.readline().split(": ")[1]) for _ in ENDS]
        started.send_signal(number)
        assert started.wait(timeout=60) == -number
        until = time.monotonic() + 30
        while any(works(pid) for pid in pids):
            assert time.monotonic() < until, "a DVC of a loop still runs"
            time.sleep(0.01)


def works(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    # a child that nobody waited for
    return ") Z " not in Path(f"/proc/{pid}/stat").read_text()


def test_the_ends_are_those_of_the_workflow(root):
    """Together with what stands before them they are all stages of one loop, and no two loops share one."""
    stages = YAML(typ="safe").load((root / "dvc.yaml").read_text())["stages"]
    outs = {f"datasets/{name}": name for name in stages}

    def before(name: str) -> set[str]:
        made = {
            outs["/".join(dep.split("/")[:2])]
            for dep in stages[name]["deps"]
            if "/".join(dep.split("/")[:2]) in outs
        }
        return {name}.union(*map(before, made))

    for loop, ends in ENDS.items():
        of_loop = {
            name for name, stage in stages.items() if f"loops.{loop}" in map(str, stage.get("params", []))
        }
        assert set().union(*map(before, ends)) == of_loop


def test_a_project_without_git_or_datasets_is_no_obstacle(copy):
    shutil.rmtree(copy / "datasets")
    assert fake_uv.run(copy, "dvc", "repro").stdout.endswith("dvc repro\n")
