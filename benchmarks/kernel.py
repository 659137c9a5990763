"""Our kernel beside the published form of Algorithm 2, vectorised: CPU seconds on one
core and peak memory above the imports, in one run.

`./run python -m benchmarks.kernel` prints the figures beside the bars and writes
benchmarks/results/kernel.json. Each figure is the median of several fresh processes; the
naive form, a minute and more, has one. Both forms get the same tuples (N = 6, 15,000 samples, the
study's reference, mu = 1e-4) and make 500 iterations.

What holds the ratio: half of the kernel's time is its Gram matrix, a quarter the 500 products with G, which
is read from memory each time. The first stands beside BLAS syrk on a matrix of its size that is there
already, in turns in one process.
"""

import json
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import scipy.linalg.blas

from pipeline.temperature.half_vector import quadratic_gram
from pipeline.temperature.kernel import Tuples, regress, tuples, tuples_with_reference, value_iteration
from pipeline.temperature.plant import baam
from pipeline.temperature.published import GAMMA, REFERENCE
from pipeline.temperature.study import data_sets
from pipeline.temperature.tracking import gains
from tests.temperature import naive

RESULTS = Path(__file__).parent / "results" / "kernel.json"
SAMPLES, ITERATIONS, REPEATS = 15_000, 500, 5
I5, I7 = np.eye(5), np.eye(7)


def explicit() -> Tuples:
    """The study's whole problem on its scaled data, with its reference in the state."""
    u, y = data_sets(np.random.default_rng(1), SAMPLES, 1)
    return tuples_with_reference([u[:, 0] / 1000], [y[:, 0] / 1000], 6, REFERENCE / 1000, I5)


def short() -> Tuples:
    """500 complete windows of 2, for any reference."""
    u, y = data_sets(np.random.default_rng(1), 502, 1)
    return tuples([u[:, 0]], [y[:, 0]], 2)


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


def kernel_2() -> Callable[[], object]:
    data = short()
    return lambda: value_iteration(regress(data), I5, I7, GAMMA)


def retune_2() -> Callable[[], object]:
    """New weights on what the data say: no pass over them."""
    learned = regress(short())
    rng = np.random.default_rng(2)
    q, r = rng.uniform(0.01, 1.0, 5), rng.uniform(0.01, 0.4, 7)
    return lambda: value_iteration(learned, np.diag(q), np.diag(r), GAMMA)


def riccati_pair() -> Callable[[], object]:
    plant = baam()
    return lambda: gains(plant, I5, I7, GAMMA)


# the case; how many processes; how often it is repeated in one, of which the median counts
CASES = {
    "kernel_6": (kernel_6, REPEATS, 1),
    "naive_6": (naive_6, 1, 1),
    "kernel_2": (kernel_2, REPEATS, 5),
    "retune_2": (retune_2, REPEATS, 15),
    "riccati": (riccati_pair, REPEATS, 200),
}


def syrk_share() -> float:
    """The rate of our Gram matrix of half-vectors (N = 6, 15,000 samples) as a share of BLAS syrk's on the
    half-vectors made before: the median of pairs."""
    rank = regress(explicit(), mu=1e-4).rank
    rng = np.random.default_rng(3)
    z = rng.normal(size=(rank, SAMPLES))
    row, column = np.triu_indices(rank)
    half_vectors = np.asfortranarray(z[row] * z[column])
    shares = []
    for _ in range(REPEATS):
        seconds = []
        for work in (lambda: scipy.linalg.blas.dsyrk(1.0, half_vectors), lambda: quadratic_gram(z)):
            started = time.process_time()
            work()
            seconds.append(time.process_time() - started)
        shares.append(seconds[0] / seconds[1])
    return statistics.median(shares)


def peak_MB() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(name: str) -> dict[str, float]:
    """In this process: CPU seconds (median over `repeats`, the first left out where there are several), and
    peak memory above the imports and above the tuples."""
    case, _, repeats = CASES[name]
    quadratic_gram(np.ones((2, 4)))
    imports = peak_MB()
    work = case()
    tuples_made, seconds, result = peak_MB(), [], None
    for _ in range(repeats):
        started = time.process_time()
        result = work()
        seconds.append(time.process_time() - started)
    iterations = getattr(result, "iterations", None)
    if name == "kernel_6" and iterations != ITERATIONS:
        raise ValueError(f"kernel_6 should make {ITERATIONS} iterations but made {iterations}")
    return {
        "cpu_s": statistics.median(seconds[1:] or seconds),
        "above_imports_MB": peak_MB() - imports,
        "of_which_data_MB": tuples_made - imports,
    }


def fresh(name: str) -> dict[str, float]:
    """`measure` in processes of their own, one BLAS thread each: the median of each figure."""
    runs = [in_process(name) for _ in range(CASES[name][1])]
    return {key: statistics.median(run[key] for run in runs) for key in runs[0]}


def in_process(name: str) -> dict[str, float]:
    environment = os.environ | dict.fromkeys(
        ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"
    )
    command = [sys.executable, "-m", "benchmarks.kernel", name]
    return json.loads(
        subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout
    )


def bars(measured: dict[str, dict[str, float]]) -> list[tuple[str, float, float, bool]]:
    """Figure, value, bar, and whether more is better."""
    return [
        (
            "N = 6, 15,000 samples, 500 iterations: times faster than the naive form",
            measured["naive_6"]["cpu_s"] / measured["kernel_6"]["cpu_s"],
            60.0,
            True,
        ),
        ("its Gram matrix: share of BLAS syrk's rate", measured["syrk"]["share"], 0.9, True),
        (
            "N = 6, 15,000 samples: GB above the imports",
            measured["kernel_6"]["above_imports_MB"] / 1024,
            0.6,
            False,
        ),
        ("N = 2, 500 samples: s", measured["kernel_2"]["cpu_s"], 0.05, False),
        ("new weights: ms", 1000 * measured["retune_2"]["cpu_s"], 30.0, False),
        ("Riccati gains of a pair (Q, R): ms", 1000 * measured["riccati"]["cpu_s"], 1.0, False),
    ]


def main() -> None:
    if len(sys.argv) > 1:
        print(json.dumps({"share": syrk_share()} if sys.argv[1] == "syrk" else measure(sys.argv[1])))
        return
    measured = {}
    for name in CASES:
        print(f"{name} ...", file=sys.stderr, flush=True)
        measured[name] = fresh(name)
    for name, figures in measured.items():
        print(
            f"{name:10} {figures['cpu_s']:10.4f} CPU s {figures['above_imports_MB']:8.0f} "
            "MB above the imports"
        )
    table = bars(measured | {"syrk": in_process("syrk")})
    for figure, value, bar, more in table:
        held = value >= bar if more else value <= bar
        print(
            f"{figure}: {value:.3g}, bar {'at least' if more else 'at most'} {bar:g}: "
            f"{'held' if held else 'MISSED'}"
        )
    result = {
        "command": "./run python -m benchmarks.kernel",
        "machine": {"cores": os.cpu_count(), "blas_threads": 1},
        "cases": {
            name: {key: float(f"{value:.3g}") for key, value in figures.items()}
            for name, figures in measured.items()
        },
        "figures": [
            {
                "figure": figure,
                "value": float(f"{value:.3g}"),
                "bar": bar,
                "better": "more" if more else "less",
            }
            for figure, value, bar, more in table
        ],
    }
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
