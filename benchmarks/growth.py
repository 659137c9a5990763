"""How time and memory grow with what is asked: samples, recordings, the length of a trial, materials, plants,
lines of G-code.

`./run python -m benchmarks.growth` prints a line a sweep and writes its part of
benchmarks/results.json. Each size is a process of its own: CPU
seconds of it and its children (the quickest of up to five), and the most memory above what it held before the
work began. The exponent is the slope of log time over log size; beside it the steepest step between two
neighbouring sizes, because what does not grow flattens the first. `materials`, `plants` and `lines` need the
artifacts of a finished run.

The kernel stands beside the published form of Algorithm 2, vectorised (`tests/temperature/naive.py`), on the
same tuples: N = 6, 15,000 samples, 500 iterations, each form in a process of its own.

Kernel and identification get a machine of two heaters; settings are those of params.yaml. One plant is nine
cases, here of 60 steps instead of 600.
"""

import contextlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.signal

from benchmarks import results
from benchmarks.results import Row
from pipeline.papers.published import GAMMA, REFERENCE, tuples_with_reference
from pipeline.papers.study import data_sets
from pipeline.store import artifacts, params
from pipeline.temperature.controllers.kernel import Tuples, quadratic_gram, regress, value_iteration
from tests.temperature import naive

ROOT = Path(__file__).resolve().parents[1]
LIMIT = 1.1  # of the exponent: linear, and ten percent
LIMIT_S = 300.0  # of one size, on the clock
ENOUGH_S, MOST = 0.5, 5  # a size is repeated until it took so many CPU seconds, and so often at most
STEPS = 60
# the honest peer of the kernel is not the form of the paper: a review measured 12.3 s against our 1.08 s
PLAIN_NUMPY = (
    "25 plain lines of NumPy (unique products, one Cholesky, G once) took 11 times as long as ours "
    "(review of commit 630ec7c, on another machine)."
)
Work = Callable[[], object]


class Sweep(NamedTuple):
    """What grows, in which unit, the sizes, and what makes the work of one size: `begin(size, folder)` is not
    measured, what it returns is. `GB` is what the largest size needs beside what is in use."""

    what: str
    unit: str
    sizes: tuple[int, ...]
    begin: Callable[[int, Path], Work]
    GB: float = 1.0


# ---- what is measured


def two_heaters(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """u, y (samples, 2) of two zones that warm each other, probed by random levels; noise of 0.1 °C."""
    rng = np.random.default_rng(23)
    u = rng.uniform(30.0, 60.0, (samples, 2))
    heat = u @ np.array([[1.8, 0.5], [0.4, 2.1]])
    zones = [
        scipy.signal.lfilter([0, 1 - pole], [1, -pole], heat[:, j]) for j, pole in enumerate((0.97, 0.95))
    ]
    return u, 22.0 + np.column_stack(zones) + 0.1 * rng.standard_normal((samples, 2))


def kernel(samples: int, folder: Path) -> Work:
    from pipeline.temperature.controllers.kernel import tuples

    u, y = two_heaters(samples)
    return lambda: value_iteration(regress(tuples([u], [y], 2, offset=True)), np.eye(2), np.eye(2), 0.9)


def identification(samples: int, folder: Path) -> Work:
    from pipeline.temperature.identification.model_choice import Settings, identify

    u, y = two_heaters(samples)
    settings = Settings(feedthrough=None, refinement="validated")
    return lambda: identify([u], [y], sample_time_s=1.0, settings=settings)


def ingestion(rows: int, folder: Path) -> Work:
    from benchmarks import reading_speed

    path = folder / "csv_checked"
    reading_speed.write(path, "csv_checked", rows)
    return lambda: reading_speed.checked(path)


def write_recording(path: Path, seed: int, samples: int) -> None:
    """A CSV of the machine of params.yaml with signals of its names."""
    from pipeline.temperature.settings import Plant

    machine = params.load(Plant, "plant")
    names = [signal.name for signal in [*machine.acting, *machine.outputs]]
    values = np.random.default_rng([23, seed]).normal(50.0, 5.0, (samples, len(names)))
    table = np.column_stack([np.arange(samples) * machine.sample_time_s, values])
    np.savetxt(path, table, "%.4f", ",", header=",".join(["t_s", *names]), comments="")


def recordings(count: int, folder: Path) -> Work:
    """So many CSV of 300 samples, none read before."""
    from pipeline.recordings.isolated import Budget
    from pipeline.recordings.recording_folders import join, read_folder
    from pipeline.temperature.settings import Plant
    from stages.ingest import Ingest, recording_wish

    machine, settings = params.load(Plant, "plant"), params.load(Ingest, "ingest")
    raw = folder / "raw"
    raw.mkdir()
    for k in range(count):
        write_recording(raw / f"{k:05}.csv", k, 300)
    wish = recording_wish(settings, machine, {})  # our own names
    execution, calls = params.load(params.Execution, "execution"), iter(range(MOST + 1))
    budget = Budget(settings.longest_s, settings.largest_mb)

    def work() -> int:
        memo = folder / f"memo_{next(calls)}"
        results = read_folder(raw, wish, execution, memo=memo, budget=budget)
        record, _, _ = join(results, wish, strict=True)
        return len(record["time_s"])

    return work


def trial(samples: int, folder: Path) -> Work:
    """The command of the next trial after three of so many samples at 50 Hz, the model identified anew."""
    from pipeline.deposition.extruder import Extruder, flow, routine
    from pipeline.deposition.learning import ilc
    from pipeline.deposition.settings import Printer

    printer = params.load(Printer, "printer")
    step, fixed_s = printer.sample_time_s, 8.0
    r = routine(
        off_s=3.0, on_s=max(samples * step - fixed_s, 4.0), pause_s=0.6, tail_s=3.0,
        speed=printer.speed_mm_per_s, bead_area_mm2=printer.bead_area_mm2, ramp_s=0.15, sample_time_s=step,
    ).r  # fmt: skip
    plant, rng, settings = Extruder(1.08, 2.7), np.random.default_rng(23), ilc.InverseSettings(3, 0.1, 4, 5.0)
    made = []
    for share in (1.0, 0.9, 1.1):
        u = share * r / plant.gain
        Q = flow(plant, u, sample_time_s=step)
        made.append(ilc.Trial(u, Q + 0.01 * r.max() * rng.standard_normal(len(r)), Q))
    return lambda: ilc.next_step(
        made, r, ilc.InverseLaw(r, settings, drive=printer.limits, sample_time_s=step), rise=0.05
    )


def materials(count: int, folder: Path) -> Work:
    """The library of so many materials, each with all trials of one of the two that were trained on."""
    from pipeline.deposition.parts import composition, stored
    from pipeline.deposition.settings import Printer
    from pipeline.deposition.tables import LESSONS
    from stages.segment_library import SegmentLibrary

    printer, settings = params.load(Printer, "printer"), params.load(SegmentLibrary, "segment_library")
    samples = artifacts.read_table("datasets/train_ilc/lessons.parquet", LESSONS)
    known = stored.trainings(samples, settings.law, printer.training_routines(), printer.nozzle_mm)
    names = sorted({one.material for one in known})
    many = [
        one._replace(material=f"{k:04}")
        for k in range(count)
        for one in known
        if one.material == names[k % len(names)]
    ]
    return lambda: composition.learn(many, sample_time_s=printer.sample_time_s)


def plants(count: int, folder: Path) -> Work:
    """Subspace + LQG as deployed on so many plants of the judging half, with its figures."""
    from pipeline.temperature.controllers.table import design_controllers
    from pipeline.temperature.settings import Panel, Plant, Tracking, TuneWeights
    from pipeline.temperature.test_set import panel
    from stages.evaluate_temperature import read_weights
    from stages.tune_weights import load_design_problem

    machine, tracking = params.load(Plant, "plant"), params.load(Tracking, "tracking")
    tuning, asked = params.load(TuneWeights, "tune_weights"), params.load(Panel, "panel")
    judging = asked.judging.model_copy(update={"plants": count})
    asked = asked.model_copy(update={"judging": judging, "steps": STEPS, "settled_steps": 10})
    setting, problem = load_design_problem(machine, asked, tracking, tuning, simulated=True)
    weights = read_weights("datasets/tune_weights/weights.json").contestants
    tuned = {name: values.model_dump() for name, values in weights.items()}
    design = design_controllers(problem, tuned)[0]["subspace_lqg"]
    half = setting.rehearsal.judging
    at = panel.rests(design.model, half, setting.limits)
    return lambda: panel.play(design, at, half, setting)


def lines(count: int, folder: Path) -> Work:
    """Composed from the file to the job, in a process of its own."""
    from benchmarks import gcode

    text = gcode.slicer_job(count)
    return lambda: gcode.watched("compose", text)


DECADES = (1_000, 10_000, 100_000, 1_000_000)
SWEEPS = {
    "kernel": Sweep("kernel of two heaters, N = 2", "samples", (*DECADES, 10_000_000), kernel, 8.0),
    "identification": Sweep("identification of two heaters", "samples", DECADES, identification, 6.0),
    "ingestion": Sweep("ingestion of a CSV of 12 columns, checked", "samples", DECADES, ingestion, 2.0),
    "recordings": Sweep("ingestion of recordings", "recordings", (10, 100, 1_000), recordings, 2.0),
    "trial": Sweep("next command of a trial", "samples", DECADES, trial, 3.0),
    "materials": Sweep("library of materials", "materials", (1, 10, 100), materials, 2.0),
    "plants": Sweep("a contestant judged on plants", "plants", (60, 600, 6_000), plants, 6.0),
    "lines": Sweep("G-code composed", "lines", DECADES, lines, 2.0),
}


# ---- how


def high_water_MB(pid: int | str = "self") -> float:
    """The largest memory of a process since it began, or was last asked to forget."""
    told = Path(f"/proc/{pid}/status").read_text().splitlines()
    return int(next(line for line in told if line.startswith("VmHWM")).split()[1]) / 1024


def children() -> list[int]:
    """Children that are alive: readers of recordings stay for the next file."""
    told = [path.read_text().split() for path in Path("/proc/self/task").glob("*/children")]
    return [int(pid) for pids in told for pid in pids]


def cpu_s() -> float:
    """CPU seconds of this process and of its children, alive (in ticks of 10 ms) or ended."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    ticks = 0
    for pid in children():
        with contextlib.suppress(OSError):
            ticks += sum(map(int, Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[11:13]))
    return time.process_time() + ended.ru_utime + ended.ru_stime + ticks / os.sysconf("SC_CLK_TCK")


def point(name: str, size: int) -> dict[str, Any]:
    """In this process: {size, cpu_s, above_MB}. The smallest size is done before, so that imports and first
    calls are paid for."""
    sweep = SWEEPS[name]
    with tempfile.TemporaryDirectory() as first, tempfile.TemporaryDirectory() as folder:
        sweep.begin(sweep.sizes[0], Path(first))()
        work, taken, result = sweep.begin(size, Path(folder)), [], None
        Path("/proc/self/clear_refs").write_text("5")
        before = high_water_MB()
        while not taken or (sum(taken) < ENOUGH_S and len(taken) < MOST):
            result = None  # or two would be held at once
            started = cpu_s()
            result = work()
            taken.append(cpu_s() - started)
        above = max([high_water_MB() - before, *map(high_water_MB, children())])
    if name == "lines" and isinstance(result, dict):  # its process says so itself, above its imports
        return {"size": size, "cpu_s": result["cpu_seconds"], "above_MB": result["mb_above_imports"]}
    return {"size": size, "cpu_s": min(taken), "above_MB": above}


def free_GB() -> float:
    lines = Path("/proc/meminfo").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("MemAvailable")).split()[1]) / 2**20


def apart(name: str, size: int) -> dict[str, Any]:
    """`point` in a process of its own; a size that cannot be measured here says why."""
    sweep = SWEEPS[name]
    if size == sweep.sizes[-1] and free_GB() < sweep.GB:
        return {"size": size, "why": f"needs {sweep.GB:g} GB, {free_GB():.1f} GB are free"}
    command = [sys.executable, "-m", "benchmarks.growth", "--point", name, str(size)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, cwd=ROOT)
    except subprocess.TimeoutExpired:
        return {"size": size, "why": f"took longer than {LIMIT_S:g} s"}
    if done.returncode:
        said = done.stderr.strip().splitlines() or [f"ended with status {done.returncode}"]
        return {"size": size, "why": said[-1][:200]}
    row = json.loads(done.stdout.splitlines()[-1])
    return {"size": size, "cpu_s": float(f"{row['cpu_s']:.3g}"), "above_MB": round(row["above_MB"], 1)}


class Growth(NamedTuple):
    """The exponent of time over size, and the steepest step: its exponent, and to which size it leads."""

    exponent: float
    steepest: float
    steepest_to: int


def fitted(sizes: np.ndarray, seconds: np.ndarray) -> Growth:
    """The exponent k of seconds ~ size^k by least squares in the logarithms, and of each step alone.

    Raises ValueError for fewer than two sizes, which have no slope."""
    x, y = np.log(np.asarray(sizes, float)), np.log(np.asarray(seconds, float))
    if len(x) < 2:
        raise ValueError(f"fitted: expected two sizes or more, found {len(x)}; measure another")
    steps = np.diff(y) / np.diff(x)
    return Growth(float(np.polyfit(x, y, 1)[0]), float(steps.max()), int(sizes[int(steps.argmax()) + 1]))


def swept(name: str, points: list[dict[str, Any]]) -> dict[str, Any]:
    """A sweep's rows with its fit; without a fit where fewer than two sizes could be measured."""
    sweep = SWEEPS[name]
    known = [row for row in points if row.get("cpu_s")]
    out = {"what": sweep.what, "unit": sweep.unit, "points": points, "limit": LIMIT}
    if len(known) < 2:
        return out
    fit = fitted(np.array([row["size"] for row in known]), np.array([row["cpu_s"] for row in known]))
    last, before = known[-1], known[-2]
    more_kB = 1024 * (last["above_MB"] - before["above_MB"]) / (last["size"] - before["size"])
    return out | {
        "exponent": round(fit.exponent, 3),
        "steepest": round(fit.steepest, 3),
        "steepest_to": fit.steepest_to,
        "kB_more_a_unit": float(f"{max(more_kB, 0.0):.3g}"),
    }


# ---- the kernel beside the published form

SAMPLES, ITERATIONS = 15_000, 500
I5, I7 = np.eye(5), np.eye(7)


def explicit() -> Tuples:
    """The study's whole problem on its scaled data, with its reference in the state."""
    u, y = data_sets(np.random.default_rng(1), SAMPLES, 1)
    return tuples_with_reference([u[:, 0] / 1000], [y[:, 0] / 1000], 6, REFERENCE / 1000, I5)


def kernel_6() -> Callable[[], object]:
    data = explicit()
    # every row in the Gram matrix: none is dropped or thinned out on the way into it
    assert len(data.s) == SAMPLES - 6
    return lambda: value_iteration(
        regress(data, mu=1e-4), I5, I7, GAMMA, tolerance=0.0, max_iterations=ITERATIONS
    )


def naive_6() -> Callable[[], object]:
    data = explicit()
    return lambda: naive.value_iteration(
        data.s, data.u, data.e, data.s_next, I5, I7, GAMMA, mu=1e-4, iterations=ITERATIONS
    )


def peak_MB() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


FORMS = {"kernel": kernel_6, "naive": naive_6}


def form(name: str) -> dict[str, float]:
    """In this process: CPU seconds and MB above the imports of one form."""
    quadratic_gram(np.ones((2, 4)))
    imports, work = peak_MB(), FORMS[name]()
    started = time.process_time()
    work()
    return {"cpu_s": time.process_time() - started, "above_MB": peak_MB() - imports}


def forms() -> dict[str, dict[str, float]]:
    """`form` in processes of their own, one BLAS thread each."""
    one_thread = os.environ | dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
    out = {}
    for name in FORMS:
        command = [sys.executable, "-m", "benchmarks.growth", "--form", name]
        done = subprocess.run(command, cwd=ROOT, env=one_thread, check=True, capture_output=True, text=True)
        out[name] = json.loads(done.stdout.splitlines()[-1])
    return out


# ---- the rows


def rows(sweeps: dict[str, dict[str, Any]], found: dict[str, dict[str, float]]) -> list[Row]:
    """A row a sweep, then the kernel."""
    out = []
    for one in sweeps.values():
        known = [row for row in one["points"] if row.get("cpu_s")]
        size = f"{known[0]['size']:,} to {known[-1]['size']:,} {one['unit']}"
        last = f"largest {known[-1]['cpu_s']:g} CPU s, {known[-1]['above_MB']:,.0f} MB"
        note = f"steepest step {one['steepest']:.2f}; {last}"
        met = "met" if one["exponent"] <= one["limit"] else "missed"
        beside = f"at most {one['limit']:g}: {met}"
        out.append(Row(f"{one['what']}, {size}", f"exponent {one['exponent']:.2f}", beside, note))
    ours, naive = found["kernel"], found["naive"]
    out.append(
        Row(
            f"kernel, N = 6, {SAMPLES:,} samples, {ITERATIONS} iterations",
            f"{ours['cpu_s']:.2f} s, {ours['above_MB']:,.0f} MB",
            f"{naive['cpu_s']:.0f} s, {naive['above_MB']:,.0f} MB (Kronecker form, vectorised)",
            f"{naive['cpu_s'] / ours['cpu_s']:.0f} times faster than that form. {PLAIN_NUMPY}",
        )
    )
    return out


def main() -> None:
    if sys.argv[1:2] == ["--point"]:
        print(json.dumps(point(sys.argv[2], int(sys.argv[3]))))
        return
    if sys.argv[1:2] == ["--form"]:
        print(json.dumps(form(sys.argv[2])))
        return
    sweeps = {}
    for name, sweep in SWEEPS.items():
        sweeps[name] = swept(name, [apart(name, size) for size in sweep.sizes])
        print(f"{name:15} {sweeps[name]}", flush=True)
    results.write("growth", rows(sweeps, forms()))


if __name__ == "__main__":
    main()
