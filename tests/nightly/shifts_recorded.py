"""A made-up machine and the recordings of its shifts, CSV in a user's format, one a night.

Two heated zones (60 and 90 s, 1.6 and 1.2 °C per percent) warm each other, 20 °C around them give or take
0.5 °C a night, 0.1 °C of sensor noise.
"""

from pathlib import Path

import numpy as np
import scipy.linalg

from pipeline.store import artifacts, params
from pipeline.temperature.plant import Plant, hold_output, plant
from pipeline.temperature.probing import prbs, probe
from tests.nightly.toy_nights import SETTINGS

ROOT = Path(__file__).resolve().parents[2]
SAMPLES, REFERENCE, NOISE_DEGC, AMBIENT_DEGC = 600, np.array([120.0, 110.0]), 0.1, 20.0
TIME_CONSTANTS_S, GAINS = np.array([60.0, 90.0]), np.array([1.6, 1.2])


def machine(
    *,
    gain: tuple[float, float] = (1.0, 1.0),
    slower: tuple[float, float] = (1.0, 1.0),
    ambient: float = AMBIENT_DEGC,
) -> Plant:
    """Two zones: tau_i dy_i = K_i u_i + ambient + 0.1 (y_j - y_i) - (y_i - ambient), sampled each second;
    gains and time constants as shares of the nominal ones."""
    tau, K = TIME_CONSTANTS_S * slower, GAINS * gain
    F = np.array([[-1.1, 0.1], [0.1, -1.1]]) / tau[:, None]
    G = np.column_stack([np.diag(K) / tau[:, None], ambient / tau])
    whole = scipy.linalg.expm(np.block([[F, G], [np.zeros((3, 5))]]))
    return plant(whole[:2, :2], whole[:2, 2:4], np.eye(2), b=whole[:2, 4])


def recording(
    truth: Plant,
    seed: int,
    *,
    samples: int = SAMPLES,
    aim_degC: tuple[float, float] = (0.0, 0.0),
    dither: float = 8.0,
) -> dict[str, np.ndarray]:
    """A shift of the machine under its operator's loop, dithered, which aims so far beside the references:
    columns as a user's CSV has them."""
    rng = np.random.default_rng(seed)
    x0, u0 = hold_output(truth, REFERENCE)
    signal = prbs(rng, samples, 2, amplitude=dither, shortest=20)
    noise = NOISE_DEGC * rng.standard_normal((samples, 2))
    run = probe(
        truth,
        signal,
        (x0, u0, REFERENCE + aim_degC),
        (np.zeros(2), np.full(2, 100.0), 20.0),
        feedback=0.5 * np.eye(2),
        noise=noise,
    )
    return {
        "time_s": np.arange(samples, dtype=float),
        "heater_1": run.u[:, 0],
        "heater_2": run.u[:, 1],
        "sensor_1": run.y[:, 0],
        "sensor_2": run.y[:, 1],
    }


def a_night(
    seed: int, index: int, *, loop: dict | None = None, colder_degC: float = 0.0, **changes
) -> dict[str, np.ndarray]:
    """The recording of one night: `loop` are settings of `recording`, `changes` those of the machine."""
    rng = np.random.default_rng([seed, index])
    truth = machine(ambient=AMBIENT_DEGC - colder_degC + rng.uniform(-0.5, 0.5), **changes)
    return recording(truth, int(rng.integers(2**31)), **(loop or {}))


def write(path: Path, columns: dict[str, np.ndarray]) -> None:
    artifacts.write_csv(path, {name: np.round(values, 4) for name, values in columns.items()})


def settings() -> dict:
    """The project's own parameters, of both files, for this machine
    and small; section nightly as the tests have it."""
    found = params.read(ROOT / "params.yaml")
    signal = {"unit": "percent", "low": 0, "high": 100}
    found["plant"] = {
        "sample_time_s": 1.0, "inputs": [{"name": f"heater_{k}", **signal} for k in (1, 2)],
        "outputs": [{"name": f"sensor_{k}", "unit": "degC", "low": 0, "high": 300,
                     "reference": float(REFERENCE[k - 1])} for k in (1,
        2)],
    }  # fmt: skip
    found["execution"] |= {
        "jobs": 1
    }  # a night's recordings are few: workers would take longer to start than to work
    found["generate_probing"] |= {"source": "recordings", "samples": 100}
    found["panel"] |= {
        "steps": 150,
        "settled_steps": 40,
        "training": found["panel"]["training"] | {"plants": 6},
        "judging": found["panel"]["judging"] | {"plants": 6},
    }
    found["learn_kernel"] |= {"longest_window": 8}
    found["identify_plant"] |= {"max_order": 3}
    found["tune_weights"] |= {"practical_initial": 8, "practical_evaluations": 14}
    found["nightly"] = SETTINGS | {
        "loops": {
            "temperature": {
                "artifacts": ["datasets/identify_plant/plant.parquet", "datasets/learn_kernel/window.parquet",
                "datasets/tune_weights/weights.json"],
                "judge": "temperature", "cases": "", "recordings": "datasets/raw/temperature",
            }
        },
        "holdout": SETTINGS["holdout"] | {"starts_degC": [50, 90], "reference_offsets_degC": [0, -10],
        "seed": 901, "plants": 16, "controller": "varx_riccati"},
    }  # fmt: skip
    found["nightly"]["holdout"]["steps"] = 150
    return found
