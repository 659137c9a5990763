"""Checks that what is exported is what was judged: the rebuilt controller against the judged commands, the
Python file against the object, the compiled C against its golden vectors."""

import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.deploy import vectors
from pipeline.deploy.supervise import DEGC, PERCENT, Exported, Supervised
from pipeline.temperature.controllers.law import RunningController, all_fed_forward
from pipeline.temperature.test_set import panel

SAME = 1e-9  # of an input's range: allowed difference if sums are computed in another order
COMPILERS = ("cc", "gcc", "clang")


def judged_difference(
    made: Exported, cases: panel.Cases, case: int, outputs: np.ndarray, applied: np.ndarray
) -> float:
    """Returns the largest difference in percent between the commands of `made`, sample by sample, and the
    commands `applied` (steps, m) of the judged controller in that case, for the same outputs (steps, p)."""
    return float(np.abs(commands(made, cases, case, outputs, applied) - applied).max())


def commands(
    made: Exported, cases: panel.Cases, case: int, outputs: np.ndarray, applied: np.ndarray
) -> np.ndarray:
    """Returns commands (steps, m) of the law, sample by sample, in one case of a test set with true outputs
    `outputs` (steps, p) and inputs `applied` (steps, m). The law remembers those inputs, not its own
    commands. Otherwise an active output limiter would amplify a rounding difference sample by sample, until
    it is as large as the limits."""
    running, held = RunningController(made.controller, made.model), panel.held_readings(cases)[:, case]
    u, first = cases.u0[case], cases.references[cases.asked[case, 0]]
    noise, step_degC = panel.noise_of(cases)[cases.hold :, case], cases.structure[cases.plant[case], 4]
    measured = panel.in_steps(outputs + noise, step_degC)
    for reading in held[:-1]:
        running.watch(u, reading, first.H @ first.w0)
    running.hand_over(held[-1], at=cases.starts[cases.start[case]])
    given, forward = np.empty((cases.steps, len(u))), forward_of(made, cases, case)
    for t in range(cases.steps):
        number = cases.asked[case, np.flatnonzero(cases.begin[case] <= t)[-1]]
        reference = cases.references[number]
        r = reference if len(reference.w0) > 1 else reference.H[:, 0]
        running.forward = forward[t]
        given[t] = running.step(measured[t], r, t, applied[t])
    return given


def forward_of(made: Exported, cases: panel.Cases, case: int) -> np.ndarray:
    """Returns what is fed forward (steps, m) in one case."""
    usual = 0.0 if made.controller.forward is None else made.controller.forward.mean
    return all_fed_forward(made.controller, cases.told[:, case] + usual)


def check_same(made: Exported, difference: float) -> None:
    """Raises ValueError if the rebuilt controller is not the judged one."""
    span = max(one.high - one.low for one in made.machine.inputs)
    if not difference <= SAME * span:
        raise ValueError(
            f"datasets/evaluate_temperature/trajectories.parquet: {made.name} gives commands "
            f"{difference:g} percent away from those that were judged; expected at most {SAME * span:g}; "
            "make it again with ./run dvc repro evaluate_temperature"
        )


def python_difference(made: Exported, code: str) -> float:
    """Returns the largest difference in percent between the exported file, run as it is, and the object, over
    the samples of a script with limits, faults and hand-overs."""
    module: dict[str, Any] = {"__name__": "exported"}
    exec(compile(code, "exported.py", "exec"), module)
    script = vectors.script(made, episodes=2, steps=160, rng=np.random.default_rng(2))
    at = vectors.start(made)
    wired = {
        "plant_sha256": made.plant_sha256,
        "sample_time_s": made.machine.sample_time_s,
        "input_unit": PERCENT,
        "output_unit": DEGC,
        "rehearsal": made.simulated,
    }
    one = vectors.played(lambda: Supervised(made, rehearsal=True), made, at, script)
    other = vectors.played(lambda: module["controller"](**wired), made, at, script)
    return float(np.abs(one.u - other.u).max())


def find_compiler() -> str | None:
    """Returns the name of a C compiler on this computer, if make is installed too; else None."""
    return next((name for name in COMPILERS if shutil.which(name) and shutil.which("make")), None)


def check_compiled(made: Exported, files: Mapping[str, str]) -> None:
    """Compiles the exported C and plays golden.csv, if this computer has a compiler and make. Raises
    ValueError if it does not compile, or gives other commands."""
    compiler = find_compiler()
    if compiler is None:
        return
    with tempfile.TemporaryDirectory() as folder:
        for name, text in files.items():
            (Path(folder) / name).write_text(text, encoding="utf-8")
        # without -Werror: a compiler's warning is no fault of the controller
        command = ["make", "-s", "test", f"CC={compiler}", "STRICT=-std=c99", "CFLAGS=-O0"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)
    if done.returncode:
        lines = (done.stderr or done.stdout).strip().splitlines() or ["no output"]
        raise ValueError(
            f"the exported C of {made.name} does not pass its golden vectors with {compiler}: {lines[0]}; "
            "run make test in its folder c/"
        )
