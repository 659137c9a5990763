"""Exported code against the object: C and Python ask for the same inputs over limits, faults and hand-overs,
and neither runs for another machine."""

import ast
import configparser
import ctypes
import importlib.util
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import scipy.optimize

from pipeline.commands import export
from pipeline.deploy import supervise, to_c, to_klipper, to_python, vectors
from pipeline.deploy.certificate import sha256
from pipeline.deploy.supervise import KINDS, MODES, Exported, Supervised
from pipeline.deploy.vectors import TOLERANCE
from pipeline.temperature.controllers import law
from pipeline.temperature.controllers.law import ramp, sinusoid
from pipeline.temperature.plant import Plant
from tests.deploy.deployed_machines import LAWS, block_and_sensor, exported, limits_of, passed, refused

COMPILER = shutil.which("cc")
needs_cc = pytest.mark.skipif(COMPILER is None, reason="no C compiler cc on this machine; install one")
EPISODES, STEPS = 8, 150


@cache
def golden(kind: str, episodes: int, steps: int, simulated: bool) -> str:
    """Of these machines no target is decided by rounding: inputs and outputs are as many."""
    return vectors.golden(exported(kind, simulated=simulated), episodes=episodes, steps=steps, replays=0)


def written(folder: Path, of: Exported, *, episodes: int = EPISODES, steps: int = STEPS) -> Path:
    """The exported C in a folder."""
    folder.mkdir(exist_ok=True)
    for name, text in to_c.files(of, passed(of), golden(of.name, episodes, steps, of.simulated)).items():
        (folder / name).write_text(text)
    return folder


def made(folder: Path, *targets: str) -> subprocess.CompletedProcess:
    return subprocess.run(["make", "-s", *targets], cwd=folder, capture_output=True, text=True)


def loaded(folder: Path, of: Exported) -> ModuleType:
    """The exported Python file as a module."""
    (folder / "exported_controller.py").write_text(to_python.text(of, passed(of)))
    spec = importlib.util.spec_from_file_location("exported_controller", folder / "exported_controller.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def whose(of: Exported) -> dict:
    return {
        "plant_sha256": of.plant_sha256,
        "sample_time_s": of.machine.sample_time_s,
        "input_unit": "percent",
        "output_unit": "degC",
    }


# ---- C


@needs_cc
@pytest.mark.parametrize("kind", LAWS)
def test_c_without_a_warning_asks_for_what_the_object_asked_for(kind, tmp_path):
    done = made(written(tmp_path, exported(kind)))
    assert done.returncode == 0, done.stdout + done.stderr
    figures = json.loads(done.stdout)
    assert figures["rows"] == EPISODES * STEPS
    assert figures["largest_difference"] <= TOLERANCE
    assert figures["modes_differ"] == figures["causes_differ"] == 0


@needs_cc
def test_the_golden_vectors_reach_limits_safe_modes_and_hand_overs():
    of = exported()
    script = vectors.script(of, episodes=EPISODES, steps=STEPS, rng=np.random.default_rng(4))
    done = vectors.played(lambda: Supervised(of, rehearsal=True), of, vectors.start(of), script)
    assert (done.u == 0).any() and (done.u == 100).any()
    assert len(set(done.mode)) >= 3 and np.bitwise_or.reduce(done.causes).bit_count() >= 4
    assert {vectors.HAND_OVER, vectors.RESTORE, vectors.BEGIN} <= set(script.do)


@needs_cc
@pytest.mark.parametrize(
    "kind, before, after",
    [
        ("lqg", "k->bad[j] >= REPEATED", "k->bad[j] > REPEATED"),
        ("lqg", "s->xi[j] += l->integral[j]", "s->xi[j] += 1.0001 * l->integral[j]"),
        ("tight", "u[i] = fmax(u[i] - most / size", "u[i] = fmax(u[i] - 1.001 * most / size"),
        ("tight", "cap_at = fmin(governor_high[j],", "cap_at = fmin(1e-4 + governor_high[j],"),
        ("tight", "lacks_now = dot(ahead[0]", "lacks_now = 1.01 * dot(ahead[0]"),
        ("lqg", "diagonal = A[k][k] > 0 ? -sqrt(size)", "diagonal = A[k][k] > 0 ? -1.001 * sqrt(size)"),
        ("lqg", "*c = *saved;", "c->law = saved->law;"),
        ("lqg", "supervisor_L[0], k->e", "supervisor_M[0], k->e"),
        ("lqg", "cross[v][i][f] += missed[w] * signature[v][f]", "cross[v][i][f] += missed[w]"),
        ("lqg", "best = fmin(best, largest(left_of", "best = fmin(best / 9, largest(left_of"),
    ],
)
def test_a_change_of_the_c_does_not_pass_its_golden_vectors(kind, before, after, tmp_path):
    written(tmp_path, exported(kind))
    code = (tmp_path / "controller.c").read_text()
    assert before in code
    (tmp_path / "controller.c").write_text(code.replace(before, after))
    assert made(tmp_path).returncode != 0


@needs_cc
def test_c_reads_and_writes_nothing_that_is_not_its_own(tmp_path):
    folder = written(tmp_path, exported("window"), episodes=3)
    built = made(folder, "sanitized")
    if built.returncode and "cannot find" in built.stderr:
        pytest.skip("the compiler has no sanitizers")
    assert built.returncode == 0, built.stderr
    done = subprocess.run(["./sanitized", "golden.csv"], cwd=folder, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@needs_cc
def test_the_c_allocates_nothing_and_asks_no_clock(tmp_path):
    folder = written(tmp_path, exported(), episodes=1)
    subprocess.run(["cc", "-std=c99", "-O2", "-c", "controller.c"], cwd=folder, check=True)
    symbols = subprocess.run(["nm", "-u", "controller.o"], cwd=folder, capture_output=True, text=True).stdout
    called = set(re.findall(r"U (\w+)", symbols))
    assert called <= {"erf", "exp", "log", "pow", "sqrt", "fmax", "fmin", "memcpy", "memset", "memmove",
                      "strcmp", "memcmp", "bcmp", "__stack_chk_fail", "_GLOBAL_OFFSET_TABLE_"}  # fmt: skip


@needs_cc
def test_the_c_refuses_every_other_machine_in_words(tmp_path):
    """Each refusal is tested by test_controller.c too, before each episode."""
    folder = written(tmp_path, exported(simulated=False), episodes=1)
    (folder / "ask.c").write_text(
        '#include "controller.h"\n#include <stdio.h>\n'
        "int main(void) { static beadline_controller c; beadline_machine m = {BEADLINE_PLANT_SHA256, "
        '"percent", "K", 1.0, 2, 2};\n puts(beadline_why(beadline_init(&c, &m, 0)));\n '
        'm.output_unit = "degC"; '
        "puts(beadline_why(beadline_init(&c, &m, 0)));\n m.sample_time_s = 0.3; "
        "puts(beadline_why(beadline_init(&c, &m, 0))); return 0; }\n"
    )
    subprocess.run(["cc", "-std=c99", "-o", "ask", "ask.c", "controller.c", "-lm"], cwd=folder, check=True)
    said = subprocess.run(["./ask"], cwd=folder, capture_output=True, text=True).stdout.splitlines()
    assert said == [
        "the certificate is of other units; convert the signals as machine.h says",
        "done",
        "the certificate is of another sample time; sample as machine.h says",
    ]


@needs_cc
def test_the_stack_is_told_and_its_readme_names_the_machine(tmp_path):
    of = exported(simulated=False)
    text = written(tmp_path, of, episodes=1).joinpath("README.txt").read_text()
    for part in (
        "heater_2, percent, 0 to 100",
        "sensor_1, degC, 0 to 250",
        sha256(passed(of)),
        of.plant_sha256,
    ):
        assert part in text
    assert "@" not in text and "simulated" not in text
    assert "plant was simulated" in to_c.readme(exported(), "")
    told = made(tmp_path, "stack")
    if "fstack-usage" in told.stderr:
        pytest.skip("the compiler does not tell its stack")
    bytes_of = json.loads(told.stdout)
    # forecasts of both sides alone: 2 members' worth of what FORECASTS rows of doubles take
    rows = len(of.controller.governor.above[0])
    assert 2 * 8 * rows < bytes_of["largest_frame_bytes"] < bytes_of["stack_bytes"] < 64_000


def test_the_c_names_certificate_plant_units_and_sample_time():
    of = exported()
    header = to_c.files(of, passed(of), "")["machine.h"]
    for text in (sha256(passed(of)), of.plant_sha256, '"percent"', '"degC"', "BEADLINE_SAMPLE_TIME_S 1.0"):
        assert text in header
    assert "#define BEADLINE_SIMULATED 1" in header and "#define OUTPUT_SENSOR_2 1" in header


def test_numbers_in_c_read_back_bit_by_bit():
    values = np.random.default_rng(1).normal(size=500) * 10.0 ** np.arange(-250, 250)
    text = to_c.table("values", values)
    numbers = [float(word) for word in re.findall(r"[-+\d.e]+(?=[,\n])", text.split("{", 1)[1])]
    assert numbers == values.tolist()


# ---- the target


def redundant(rng: np.random.Generator) -> tuple[Plant, np.ndarray]:
    """Six inputs that heat four outputs, and references (40, 4): some beyond what the inputs reach."""
    model = block_and_sensor(zones=4)
    more = model._replace(
        B=model.B @ np.hstack([np.eye(4), rng.uniform(0.1, 0.6, (4, 2))]), D=np.zeros((4, 6))
    )
    return more, rng.uniform(0, 320, (40, 4))


@pytest.mark.parametrize("slack", [0.0, 3.0, 20.0])
def test_the_target_is_the_bounded_least_squares_solution(slack):
    """As scipy has it, but for which of equally good inputs it is."""
    limits, rng = limits_of(6), np.random.default_rng(1)
    model, references = redundant(rng)
    G, rest = to_c.at_rest(model)
    for r in references:
        ours = law._steady(model, r, limits.low, limits.high, slack)
        theirs = scipy.optimize.lsq_linear(
            np.vstack([G, law.LIGHT * np.eye(6)]),
            np.r_[r - rest - model.d, np.zeros(6)],
            (limits.low + slack, limits.high - slack),
            method="bvls",
        )
        # a limit is met but for rounding
        assert ours.u.min() >= slack - 1e-12 and ours.u.max() <= 100 - slack + 1e-12
        # LIGHT costs up to 1e-12 of squared inputs
        assert abs(0.5 * ours.miss @ ours.miss - theirs.cost) < 1e-7 * (1 + theirs.cost)


@needs_cc
def test_which_of_equally_good_inputs_is_the_target_is_not_left_to_rounding(tmp_path):
    """By the object, by the object for references 1e-12 degC off, and by the C. Where what stood at a limit
    was set free for a gradient of rounding, two in sixty were another target."""
    of = exported("study")
    limits, target = of.controller.limits, compiled_target(tmp_path, of)
    for r in np.random.default_rng(3).uniform(0, 260, (60, 5)):
        u = law.feasible_target(of.model, r, limits.low, limits.high).u
        near = law.feasible_target(of.model, r + 1e-12, limits.low, limits.high).u
        # a percent of inputs of which 1e-9 of range is asked
        assert np.abs(near - u).max() < 1e-9 and np.abs(target(r) - u).max() < 1e-9


def compiled_target(folder: Path, of: Exported) -> Callable[[np.ndarray], np.ndarray]:
    """The C's own feasible target, inputs (m,) for a reference r (p,)."""
    for name, text in to_c.code(of, "0" * 64).items():
        (folder / name).write_text(text)
    (folder / "target.c").write_text(
        '#include "controller.c"\n'
        "void target(const double *r, double *u) { double y[OUTPUTS]; feasible_target(&the_law, r, u, y); }\n"
    )
    command = ["cc", "-std=c99", "-O2", "-w", "-shared", "-fPIC", "-o", "target.so", "target.c", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    called = ctypes.CDLL(str(folder / "target.so")).target

    def target(r: np.ndarray) -> np.ndarray:
        u = np.zeros(of.model.m)
        called(r.ctypes.data_as(ctypes.c_void_p), u.ctypes.data_as(ctypes.c_void_p))
        return u

    return target


# ---- Python


@pytest.mark.parametrize("kind", ["lqg", "window", "printer_pid", "tight"])
def test_the_python_file_is_the_object_bit_by_bit(kind, tmp_path):
    of = exported(kind)
    module = loaded(tmp_path, of)
    script = vectors.script(of, episodes=4, steps=STEPS, rng=np.random.default_rng(2))
    at = vectors.start(of)
    ours = vectors.played(lambda: Supervised(of, rehearsal=True), of, at, script)
    theirs = vectors.played(lambda: module.controller(**whose(of), rehearsal=True), of, at, script)
    assert np.array_equal(ours.u, theirs.u)
    assert np.array_equal(ours.mode, theirs.mode) and np.array_equal(ours.causes, theirs.causes)


def test_the_python_file_imports_numpy_and_the_language_only(tmp_path):
    of = exported()
    text = to_python.text(of, passed(of))
    nodes = [one for one in ast.walk(ast.parse(text)) if isinstance(one, ast.Import | ast.ImportFrom)]
    names = [one.module if isinstance(one, ast.ImportFrom) else one.names[0].name for one in nodes]
    assert set(names) == {
        "__future__", "base64", "collections.abc", "json", "numpy", "typing",
    }  # fmt: skip
    assert sha256(passed(of)) in text and of.plant_sha256 in text


@pytest.mark.parametrize(
    "what, changed",
    [
        ("plant", {"plant_sha256": "0" * 64}),
        ("sample time in s", {"sample_time_s": 0.3}),
        ("unit of inputs", {"input_unit": "W"}),
        ("unit of outputs", {"output_unit": "K"}),
    ],
)
def test_the_python_file_refuses_another_machine(what, changed, tmp_path):
    of = exported()
    with pytest.raises(ValueError, match=f"its certificate is of another {what}"):
        loaded(tmp_path, of).controller(**(whose(of) | changed), rehearsal=True)


def test_a_simulated_controller_runs_in_a_rehearsal_only(tmp_path):
    of = exported()
    module = loaded(tmp_path, of)
    with pytest.raises(ValueError, match="runs only with rehearsal=True"):
        module.controller(**whose(of))
    real = exported(simulated=False)
    assert loaded(tmp_path, real).controller(**whose(real)) is not None


def test_the_python_file_follows_a_reference_that_moves_as_the_object_does(tmp_path):
    of = exported()
    module, at = loaded(tmp_path, of), vectors.start(of)
    moves = ramp(at.y, np.full(2, 0.1)), sinusoid(at.y, np.ones(2), 40.0)
    for reference in moves:
        asked = []
        for one, r in (
            (Supervised(of, rehearsal=True), reference),
            (module.controller(**whose(of), rehearsal=True), module.Reference(*reference)),
        ):
            one.watch(at.u, at.y, at.y)
            one.hand_over(at.y)
            asked.append([one.step(at.y, r, float(t)).u for t in range(50)])
        assert np.array_equal(*asked) and np.ptp(asked[0], axis=0).min() > 0.1


def test_the_python_file_holds_to_the_letter_what_the_stages_run():
    of, parts = exported(), [to_python.exported_part(module) for module in (law, supervise)]
    text = to_python.code(of, "0" * 64)
    assert all(len(part) > 10_000 and part in text for part in parts)
    named = [{name for node in ast.parse(part).body for name in _names(node)} for part in parts]
    assert not named[0] & named[1]  # one file has one name for each


def _names(node: ast.stmt) -> list[str]:
    """What a statement of a module names."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return [node.name]
    return [one.id for one in ast.walk(node) if isinstance(one, ast.Name) and isinstance(one.ctx, ast.Store)]


@pytest.mark.parametrize("export", [lambda of, why: to_c.files(of, why, ""), to_python.text])
def test_nothing_is_exported_without_a_passed_certificate_of_this_controller(export):
    of = exported()
    with pytest.raises(ValueError, match="its certificate was refused by rule settled_error; nothing is exp"):
        export(of, refused(of, "settled_error"))
    with pytest.raises(ValueError, match="the certificate is of another plant"):
        export(of, passed(of)._replace(plant_sha256="0" * 64))
    with pytest.raises(ValueError, match="input heater_1: the limit high is missing"):
        bare = of.machine.inputs[0]._replace(high=np.inf)
        export(of._replace(machine=of.machine._replace(inputs=(bare, of.machine.inputs[1]))), passed(of))


# ---- Klipper and Kalico


def test_the_settings_name_what_the_module_reads():
    of = exported("told", zones=1)
    text = to_klipper.settings(of, passed(of), section="extruder")
    options = re.findall(r"^(?:# )?([a-z]\w+): ", text, re.M)
    assert options == ["heater", "plant", "disturbance_fan", "disturbance_feed", "rehearsal"]
    assert "# rehearsal: True  # the plant was simulated" in text and sha256(passed(of)) in text


@pytest.mark.parametrize("section", ["extruder", "heater_bed"])
def test_the_settings_replace_neither_the_owner_s_pid_nor_max_temp(section):
    of = exported(zones=1)
    read = configparser.RawConfigParser()
    read.read_string(to_klipper.settings(of, passed(of), section=section))
    assert read.sections() == ["beadline"] and set(read["beadline"]) == {"heater", "plant"}
    assert to_klipper.FILE != "printer.cfg"


@pytest.mark.parametrize(
    ("names", "section"),
    [
        (("heater_bed.pwm", "temperature_bed"), "heater_bed"), (("duty", "bed"), "heater_bed"),
        (("extruder.pwm", "temperature_extruder"), "extruder"), (("heater_1", "embedded_sensor"), "extruder"),
    ],
)  # fmt: skip
def test_the_heater_of_klipper_is_the_bed_s_if_a_signal_is_called_after_it(names, section):
    of = exported(zones=1)
    heater, sensor = (
        of.machine.inputs[0]._replace(name=names[0]),
        of.machine.outputs[0]._replace(name=names[1]),
    )
    of = of._replace(machine=of.machine._replace(inputs=(heater,), outputs=(sensor,)))
    assert export.klipper_section(of) == section


def test_the_readme_for_klipper_is_followed_there_and_back(tmp_path):
    """Its lines run as they stand; the owner's files are then what they were."""
    of, home = exported(zones=1), tmp_path / "export"
    extras, config = tmp_path / "klipper/klippy/extras", tmp_path / "config"
    for folder in (home, extras, config):
        folder.mkdir(parents=True)
    for name, text in export.files(of, passed(of), "klipper").items():
        (home / name).write_text(text)
    owned = "[extruder]\ncontrol = pid\npid_kp = 22.2\nmax_temp = 260\n\n#*# <--- SAVE_CONFIG --->\n"
    (config / "printer.cfg").write_text(owned)
    readme = (home / "README.txt").read_text().replace("KLIPPER/", f"{tmp_path}/klipper/")
    there, back = readme.replace("CONFIG/", f"{config}/").split("Go back\n")
    run = [re.findall(r"^    ((?:cp|sed|rm) .*)$", part, re.M) for part in (there, back)]
    assert [len(commands) for commands in run] == [3, 2]
    for command in run[0]:
        subprocess.run(["sh", "-ec", command], cwd=home, check=True)
    assert sorted(path.name for path in extras.iterdir()) == ["beadline.py", "beadline_controller.py"]
    assert (config / "printer.cfg").read_text() == "[include beadline.cfg]\n" + owned
    for command in run[1]:
        subprocess.run(["sh", "-ec", command], cwd=home, check=True)
    assert (config / "printer.cfg").read_text() == owned
    assert not list(extras.iterdir()) and [path.name for path in config.iterdir()] == ["printer.cfg"]


@pytest.mark.parametrize(("to", "place"), [("c", "FIRMWARE"), ("python", "PROGRAM")])
def test_the_readme_of_each_form_is_followed_there_and_back(tmp_path, to, place):
    of, home, target = exported(zones=1), tmp_path / "export", tmp_path / place
    home.mkdir(), target.mkdir()
    for name, text in export.files(of, passed(of), to).items():
        (home / name).write_text(text)
    there, back = (home / "README.txt").read_text().replace(f"{place}/", f"{target}/").split("Go back\n")
    for part, count in ((there, {"c": 4, "python": 1}[to]), (back, 0)):
        (command,) = re.findall(r"^    ((?:cp|rm) .*)$", part, re.M)
        subprocess.run(["sh", "-ec", command], cwd=home, check=True)
        assert len(list(target.iterdir())) == count


def test_klipper_gets_no_machine_that_it_cannot_control():
    of, two = exported(zones=1), exported(zones=2)
    with pytest.raises(
        ValueError, match="inputs heater_1, heater_2 and outputs sensor_1, sensor_2; export it"
    ):
        to_klipper.settings(two, passed(two), section="extruder")
    with pytest.raises(ValueError, match="section fan: expected one of extruder, heater_bed"):
        to_klipper.settings(of, passed(of), section="fan")
    with pytest.raises(ValueError, match="its certificate was refused by rule poles"):
        to_klipper.settings(of, refused(of, "poles"), section="extruder")


def test_kinds_and_modes_have_the_same_numbers_in_c():
    header = (to_c.TEMPLATES / "supervisor.h").read_text()
    kinds = re.findall(r"\b[A-Z][A-Z_]+\b(?=,)", header.split("enum {")[1].split("KINDS")[0])
    assert [name.lower() for name in kinds] == list(KINDS)
    modes = re.findall(r"MODE_(\w+)", header)
    assert [name.lower() for name in modes] == list(MODES)
