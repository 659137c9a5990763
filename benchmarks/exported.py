"""Exported code against the object over 100,000 steps: limits, faults, hand-overs, saves; with stack, cycles
and sanitizers.

`./run python -m benchmarks.exported` writes benchmarks/results/exported.json. The laws are the tuned
contestants on the study's machine, from datasets/ (identify_plant, learn_kernel, tune_weights, ingest). Each
episode is played by the object and by the C, both in closed loop. `own` is by how much the object differs
from itself when its readings move by 1e-9 degC: where that is more than its gains explain, the loop itself
magnifies rounding (a law that swings between its limits may double it every sample), and the episode is
counted apart. `step_us` is the median over episodes beside whatever else the CPU had to do.
"""

import argparse
import importlib.util
import json
import re
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed

from pipeline.runtime import supervisor
from pipeline.runtime.export import c, python, vectors
from pipeline.runtime.machine import Exported, Machine, Signal, plants_sha256
from pipeline.store import artifacts, params
from pipeline.temperature import plant
from pipeline.temperature.workflow import cases, evaluate_temperature, learned
from pipeline.temperature.workflow.settings import Panel, Plant, Tracking, TuneWeights
from tests.runtime.deployed_machines import passed

RESULTS = "benchmarks/results/exported.json"
STEPS = 250  # of an episode
LAWS = {"subspace_lqg": 300, "learned_kernel": 60, "pi": 40}  # episodes of each: 100,000 steps
FLAGS = "-std=c99 -pedantic -Wall -Wextra -Werror"


def contestants() -> dict[str, Exported]:
    """The study's tuned contestants as they leave the house."""
    machine, tracking = params.load(Plant, "plant"), params.load(Tracking, "tracking")
    panel, tuning = params.load(Panel, "panel"), params.load(TuneWeights, "tune_weights")
    made = learned.read_learned(
        "datasets/identify_plant/plant.parquet",
        "datasets/identify_plant/spread.parquet",
        "datasets/learn_kernel",
        "datasets/ingest/printer_pid.json",
        machine,
    )
    family = [made.model, *made.spread]
    rehearsal = cases.rehearsed(panel, machine, plant.baam(), family, "datasets/ingest/record.parquet")
    setting = cases.shared(tuning, machine, tracking, panel, rehearsal, family)
    problem = learned.problem(made, tracking, setting, plant.baam())
    weights = evaluate_temperature.read_weights("datasets/tune_weights/weights.json", machine)
    designs = evaluate_temperature.designed(problem, weights)[0]
    wired = Machine(
        tuple(Signal(i.name, "percent", float(i.low), float(i.high)) for i in machine.inputs),
        tuple(Signal(o.name, "degC", float(o.low or 0), float(o.high or 0)) for o in machine.outputs),
        machine.sample_time_s,
    )
    watched = supervisor.supervision(made.model, family, wired, rehearsal.noise)
    return {
        name: Exported(
            name,
            wired,
            cases.as_deployed(designs[name], setting),
            designs[name].model,
            cases.as_deployed(designs["pi_simc"], setting),
            watched,
            True,
            plants_sha256([made.model]),
            plants_sha256(made.spread),
        )
        for name in LAWS
    }


def built(of: Exported, folder: Path) -> dict[str, Any]:
    """The C compiled, its warnings none; bytes of stack on the deepest path, of state and of constants."""
    folder.mkdir(parents=True)
    for name, text in c.code(of, "0" * 64).items():
        (folder / name).write_text(text)
    for target in ("test_controller", "sanitized"):
        subprocess.run(["make", "-s", target], cwd=folder, check=True)
    subprocess.run(f"cc {FLAGS} -O2 -fstack-usage -c controller.c", shell=True, cwd=folder, check=True)
    frames = [line.split("\t") for line in (folder / "controller.su").read_text().splitlines()]
    size = subprocess.run(["size", "controller.o"], cwd=folder, capture_output=True, text=True, check=True)
    text, data = map(int, size.stdout.splitlines()[1].split()[:2])
    return {
        "stack_bytes_of_all_functions": sum(int(frame[1]) for frame in frames),
        "largest_frame_bytes": max(int(frame[1]) for frame in frames),
        "code_and_constants_bytes": text + data,
    }


def one_episode(of: Exported, folder: Path, number: int) -> dict[str, Any]:
    """An episode by the object, by the C, and by the C with sanitizers."""
    rng = np.random.default_rng([number, 21])
    script, at = vectors.episode(of, STEPS, rng), vectors.start(of)

    def make() -> supervisor.Supervised:
        return supervisor.Supervised(of, rehearsal=True)

    done = vectors.played(make, of.model, at, script)
    golden = folder / f"golden_{number}.csv"
    golden.write_text(vectors.as_csv(at, script, done))
    ran = subprocess.run(["./test_controller", golden.name], cwd=folder, capture_output=True, text=True)
    clean = subprocess.run(["./sanitized", golden.name], cwd=folder, capture_output=True, text=True)
    golden.unlink()
    figures = json.loads(ran.stdout)
    own = None
    if ran.returncode:
        own = vectors.determined(of, make, script, replays=12).differs
    return figures | {
        "number": number,
        "sanitizers_said": clean.stderr != "" or not clean.stdout,
        "own": own,
        "modes": sorted(set(done.mode.tolist())),
        "causes": int(np.bitwise_or.reduce(done.causes)),
        "at_limits": bool(((done.u == 0) | (done.u == 100)).any()),
    }


def exported_python(of: Exported, episodes: int) -> float:
    """Largest difference of the Python file from the object."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "exported_controller.py"
        path.write_text(python.text(of, passed(of)))
        spec = importlib.util.spec_from_file_location("exported_controller", path)
        assert spec and spec.loader
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    script = vectors.script(of, episodes=episodes, steps=STEPS, rng=np.random.default_rng(3))
    whose = {
        "plant_sha256": of.plant_sha256,
        "sample_time_s": of.machine.sample_time_s,
        "input_unit": "percent",
        "output_unit": "degC",
    }
    at = vectors.start(of)
    ours = vectors.played(lambda: supervisor.Supervised(of, rehearsal=True), of.model, at, script)
    theirs = vectors.played(lambda: module.controller(**whose, rehearsal=True), of.model, at, script)
    return float(np.abs(ours.u - theirs.u).max())


def measured_on() -> dict[str, str]:
    """The processor and the compiler of cycles and bytes."""
    said = subprocess.run(["cc", "--version"], capture_output=True, text=True, check=True).stdout
    cpu = re.findall(r"model name\s*: (.+)", Path("/proc/cpuinfo").read_text())[0]
    return {"cpu": cpu, "compiler": said.splitlines()[0] + " -O2"}


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Of one law's episodes; those that rounding decides apart."""
    agree = [row for row in rows if row["own"] is None]
    apart = [row for row in rows if row["own"] is not None]
    rounding = [row for row in apart if row["own"] > vectors.OWN_GAINS]
    beside = [row for row in apart if row["own"] <= vectors.OWN_GAINS]
    causes = int(np.bitwise_or.reduce([row["causes"] for row in rows]))
    return {
        "steps": sum(row["rows"] for row in rows),
        "episodes": len(rows),
        "largest_difference_of_range": max(row["largest_difference"] for row in agree),
        "episodes_whose_loop_magnifies_rounding": [row["number"] for row in rounding],
        "their_largest_difference_of_range": max(
            (row["largest_difference"] for row in rounding), default=0.0
        ),
        "episodes_that_differ_beside": [row["number"] for row in beside],
        "largest_difference_beside_of_range": max((row["largest_difference"] for row in beside), default=0.0),
        "sanitizers_said": sum(row["sanitizers_said"] for row in rows),
        "modes": sorted({mode for row in rows for mode in row["modes"]}),
        "kinds": [kind for i, kind in enumerate(supervisor.KINDS) if causes >> i & 1],
        "episodes_at_limits": sum(row["at_limits"] for row in rows),
        "state_bytes": rows[0]["state_bytes"],
        "step_us": round(float(np.median([row["step_us"] for row in rows])), 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--share", type=float, default=1.0, help="of the episodes, for a first look")
    share = parser.parse_args().share
    results: dict[str, Any] = {}
    hertz = float(re.findall(r"cpu MHz\s*: ([\d.]+)", Path("/proc/cpuinfo").read_text())[0]) * 1e6
    for name, of in contestants().items():
        began = time.perf_counter()
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary) / name
            size = built(of, folder)
            count = max(round(share * LAWS[name]), 1)
            rows = Parallel(2)(delayed(one_episode)(of, folder, number) for number in range(count))
        found = summary(rows)
        found["step_cycles"] = round(found["step_us"] * 1e-6 * hertz)
        results[name] = {**found, **size, "python_largest_difference": exported_python(of, 4)}
        print(name, json.dumps(results[name]), f"{time.perf_counter() - began:.0f} s", flush=True)
        steps = sum(one["steps"] for one in results.values())
        artifacts.write_json(RESULTS, {"steps": steps, **measured_on(), "laws": results})


if __name__ == "__main__":
    main()
