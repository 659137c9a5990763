"""A controller leaves the house as it was judged, and runs a machine that nobody here drew."""

import importlib.util
import json
import shutil
import subprocess
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np
import pytest

from tests.foreign.hot_end import HotEnd
from tests.mission.toy_temperature import beadline, exported_project, hot_end_project, hot_end_record  # noqa: F401  three of them are fixtures

pytestmark = pytest.mark.xdist_group("toy_temperature")
STEP_S = 1.0
COLD_S = 20  # samples in manual before the controller takes over
# °C from these seconds on: from cold, and two changes; the part fan goes on at the last time
SET_POINTS = ((0, 200.0), (500, 225.0), (900, 190.0))
FAN_S, END_S = 1300, 1600
WITHIN_DEGC, REACHED_S, SAFE_S = 2.0, 300, 60
SAME_PERCENT = 1e-6  # of an input, by which C and Python may differ in closed loop
needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc on this machine; install gcc")


class Played(NamedTuple):
    """A closed loop, a row a sample: time in s, set-point and measured temperature in °C, duty in percent,
    and the mode that the supervisor was in."""

    time_s: np.ndarray
    set_point: np.ndarray
    measured: np.ndarray
    duty: np.ndarray
    mode: list[str]


def load_python(folder: Path) -> ModuleType:
    """The exported Python file, imported by its path as on another machine."""
    spec = importlib.util.spec_from_file_location("exported_controller", folder / "python" / "controller.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def close_loop(module: ModuleType, machine: HotEnd, *, fan: bool) -> Played:
    """The exported controller on the hot end, from cold over the set-points."""
    controller = module.controller(
        plant_sha256=module.PLANT_SHA256, sample_time_s=STEP_S, input_unit="percent", output_unit="degC"
    )
    set_point = np.array([[degC for start, degC in SET_POINTS if start <= t][-1] for t in range(END_S)])
    measured, duty, mode = np.empty(COLD_S + END_S), np.zeros(COLD_S + END_S), ["manual"] * COLD_S
    for k in range(COLD_S):
        measured[k] = machine.read()
        controller.watch(np.zeros(1), measured[k : k + 1], set_point[:1])
        machine.advance(0.0, 0.0, STEP_S)
    for t in range(END_S):
        k = COLD_S + t
        measured[k] = machine.read()
        if t == 0:
            controller.hand_over(measured[k : k + 1])
        decision = controller.step(measured[k : k + 1], set_point[t : t + 1], float(t))
        duty[k], mode = decision.u[0], [*mode, decision.mode]
        machine.advance(duty[k], 100.0 if fan and t >= FAN_S else 0.0, STEP_S)
    return Played(
        np.arange(-COLD_S, END_S), np.append(np.full(COLD_S, 200.0), set_point), measured, duty, mode
    )


def safe_seconds(played: Played) -> float:
    return STEP_S * sum(mode not in ("law", "manual") for mode in played.mode)


def farthest_from_set_point(played: Played, start_s: float, end_s: float) -> float:
    """The largest distance from the set-point in °C between two times."""
    rows = (played.time_s >= start_s) & (played.time_s < end_s)
    return float(np.abs(played.measured - played.set_point)[rows].max())


@pytest.fixture(scope="module")
def exported(exported_project, tmp_path_factory) -> Path:  # noqa: F811
    """Both files, written by `./run beadline export`."""
    controller, out = "datasets/export_controllers/temperature", tmp_path_factory.mktemp("exported")
    for form in ("c", "python"):
        beadline(exported_project, "export", controller, "--to", form, "--out", str(out / form))
    return out


@pytest.fixture(scope="module")
def controller(exported) -> ModuleType:
    return load_python(exported)


@pytest.fixture(scope="module")
def without_fan(controller) -> Played:
    return close_loop(controller, HotEnd(np.random.default_rng(11)), fan=False)


@pytest.fixture(scope="module")
def with_fan(controller) -> Played:
    return close_loop(controller, HotEnd(np.random.default_rng(11)), fan=True)


# ---- a foreign machine


def test_the_exported_controller_heats_a_foreign_hot_end_from_cold_over_two_set_point_changes(without_fan):
    ends = [start for start, _ in SET_POINTS[1:]] + [END_S]
    for (start, degC), end in zip(SET_POINTS, ends, strict=True):
        assert farthest_from_set_point(without_fan, start + REACHED_S, end) <= WITHIN_DEGC, degC
    assert safe_seconds(without_fan) <= SAFE_S
    assert without_fan.measured.max() <= 225.0 + 5.0  # °C past the highest set-point


def test_the_exported_controller_keeps_a_foreign_hot_end_at_its_set_point_when_the_part_fan_goes_on(with_fan):
    assert safe_seconds(with_fan) <= SAFE_S
    assert farthest_from_set_point(with_fan, FAN_S + 120, END_S) <= WITHIN_DEGC


# ---- the files are the judged controller


def test_the_exported_python_gives_the_judged_commands(exported_project):  # noqa: F811
    """What the stage measured: the law in the case that decided, and the file beside the law."""
    told = json.loads((exported_project / "datasets/export_controllers/exported.json").read_text())
    differences = told["temperature"]["largest_difference"]
    assert set(differences) == {"judged", "python"}
    assert max(differences.values()) <= SAME_PERCENT
    named = json.loads((exported_project / "datasets/evaluate_temperature/summary.json").read_text())
    assert told["temperature"]["contestant"] in json.dumps(named)


def make(folder: Path, *flags: str) -> subprocess.CompletedProcess:
    """`make test` of the exported C, in a copy that may be written to."""
    command = ["make", "-s", "test", "CC=gcc", *flags]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)


@needs_gcc
def test_the_exported_c_compiles_by_its_own_makefile(exported, tmp_path):
    done = make(shutil.copytree(exported / "c", tmp_path / "c"))
    assert "error:" not in done.stderr


@needs_gcc
def test_the_exported_c_passes_its_golden_vectors(exported, tmp_path):
    done = make(shutil.copytree(exported / "c", tmp_path / "c"))
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads(done.stdout)["modes_differ"] == 0


DRIVER = """
#include "controller.h"
#include <stdio.h>
int main(void) {
    static beadline_controller c;
    beadline_machine machine = {BEADLINE_PLANT_SHA256, "percent", "degC", %(step)r, 1, 1};
    double t, y, r, u = 0.0;
    int begun = 0;
    beadline_decision d;
    if (beadline_init(&c, &machine, 0)) return 1;
    while (scanf("%%lf %%lf %%lf", &t, &y, &r) == 3) {
        if (t < 0) {
            if (beadline_watch(&c, &u, &y, &r)) return 2;
            continue;
        }
        if (!begun++ && beadline_hand_over(&c, &y)) return 3;
        if (beadline_step(&c, &y, &r, t, NULL, &d)) return 4;
        printf("%%.17g %%d\\n", d.u[0], d.mode);
    }
    return 0;
}
"""


@needs_gcc
@pytest.mark.parametrize("loop", ["without_fan", "with_fan"])
def test_the_exported_c_gives_the_commands_of_the_exported_python(exported, loop, tmp_path, request):
    """Fed with the temperatures that the foreign hot end had under the Python file."""
    played = request.getfixturevalue(loop)
    shutil.copytree(exported / "c", tmp_path / "c")
    (tmp_path / "c/driver.c").write_text(DRIVER % {"step": STEP_S})
    build = ["gcc", "-std=c99", "-O2", "-o", "driver", "driver.c", "controller.c", "-lm"]
    subprocess.run(build, cwd=tmp_path / "c", check=True, timeout=120)
    rows = zip(played.time_s, played.measured, played.set_point, strict=True)
    fed = "".join(f"{t:.17g} {y:.17g} {r:.17g}\n" for t, y, r in rows)
    done = subprocess.run(
        ["./driver"], cwd=tmp_path / "c", input=fed, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0
    duty, mode = np.array([line.split() for line in done.stdout.splitlines()], float).T
    np.testing.assert_allclose(duty, played.duty[COLD_S:], rtol=0, atol=SAME_PERCENT)
    in_law = np.array([name == "law" for name in played.mode[COLD_S:]])
    np.testing.assert_array_equal(mode == 0, in_law)
