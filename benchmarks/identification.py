"""Identification held against published figures and against peers on the same hold-outs: fits, times, Markov errors.

`./run python -m benchmarks.identification` prints the tables with their bars and writes benchmarks/results/identification.json. The peers are nfoursid, sippy_unipi and
python-control; one that is not installed is left out with a line. Data sets come from BEADLINE_SHARED, by default ../shared. Times are CPU seconds.
"""

import importlib.util
import json
import os
import time
from collections.abc import Callable
from pathlib import Path

import control
import numpy as np

from pipeline.temperature.identification import identify, moesp, moesp_singular_values
from pipeline.temperature.plant import Plant, baam, markov_parameters, simulate
from pipeline.temperature.plant import plant as make_plant
from pipeline.temperature.probing import study_probe, study_signal
from pipeline.temperature.published import K_DATA
from pipeline.temperature.validation import predict_fit, simulate_fit

SHARED = Path(os.environ.get("BEADLINE_SHARED", "../shared")) / "data"
RESULTS = Path(__file__).parent / "results" / "identification.json"
AMPLITUDES = np.arange(100.0, 0.0, -10.0)
PRINTED_SINGULAR_VALUES = np.array([69.8841, 14.9963, 3.6675, 1.9677, 0.3000, 0.2078])
PRINTED_POLES = np.sort_complex(np.array([0.961, 0.7455, 0.4758 + 0.200j, 0.4758 - 0.200j]))
ERR1 = {"dryer": (15, 4, 0.0150), "evaporator": (10, 4, 0.489), "glass_furnace": (10, 5, 0.496)}
HOLD_OUT_BARS = {"dryer": 8.0, "evaporator": 38.0, "glass_furnace": 36.0}
MARKOV_BARS = {0.1: 2e-3, 0.5: 1.5e-2}


def resampled(path: Path, sample_time_s: float, columns: tuple[list[int], list[int]]) -> tuple[np.ndarray, np.ndarray]:
    """Inputs held and outputs interpolated on a clock of `sample_time_s`: the makers' stamps are jittered."""
    record = np.genfromtxt(path, delimiter=",", skip_header=1)
    t = np.arange(0.0, record[-1, 0], sample_time_s)
    held = np.maximum(np.searchsorted(record[:, 0], t, side="right") - 1, 0)
    return record[held][:, columns[0]], np.column_stack([np.interp(t, record[:, 0], record[:, k]) for k in columns[1]])


def probed(seed: int, noise: float, samples: int = 15_000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    signal = study_signal(rng, samples, 7, amplitudes=AMPLITUDES, bandwidth=1.65, variance=1.5)
    found = study_probe(baam(), signal, K_DATA, x0=np.full(6, 50.0), noise=noise * rng.standard_normal((samples, 5)))
    return found.u, found.y


def records() -> dict[str, tuple[np.ndarray, np.ndarray, int]]:
    """u, y and the first sample of the hold-out of each set."""
    dryer, evaporator, glass = (np.loadtxt(SHARED / "daisy_a" / f"{name}.dat") for name in ("dryer", "evaporator", "glassfurnace"))
    prbs = np.genfromtxt(SHARED / "tclab_mlid_prbs" / "prbs.csv", delimiter=",", skip_header=1)
    balance = resampled(SHARED / "tclab_apmonitor" / "energy_balance_mimo.csv", 1.0, ([1, 2], [3, 4]))
    return {
        "dryer": (dryer[:, :1], dryer[:, 1:], 750),
        "glass_furnace": (glass[:, 1:4], glass[:, 4:], 1000),
        "evaporator": (evaporator[:, :3], evaporator[:, 3:], 5000),
        "two_heaters_prbs": (prbs[:, 1:3], prbs[:, 3:5], int(0.7 * len(prbs))),
        "two_heaters_steps": (*balance, int(0.7 * len(balance[0]))),
        "baam_0_1": (*probed(0, 0.1), 10_500),
    }


def timed(function: Callable, *arguments, **settings):
    start = time.process_time()
    return function(*arguments, **settings), time.process_time() - start


def nfoursid_plant(u: np.ndarray, y: np.ndarray, order: int) -> Plant:
    import pandas as pd
    from nfoursid.nfoursid import NFourSID

    inputs, outputs = [f"u{j}" for j in range(u.shape[1])], [f"y{j}" for j in range(y.shape[1])]
    frame = pd.DataFrame(np.hstack([u, y]), columns=inputs + outputs)
    found = NFourSID(frame, output_columns=outputs, input_columns=inputs, num_block_rows=10)
    found.subspace_identification()
    model, _ = found.system_identification(rank=order)
    return make_plant(model.a, model.b, model.c, model.d)


def sippy_plant(u: np.ndarray, y: np.ndarray, order: int) -> Plant:
    from sippy_unipi import system_identification

    model = system_identification(y.T, u.T, id_method="N4SID", SS_fixed_order=order, SS_f=10, SS_p=10)
    return make_plant(model.A, model.B, model.C, model.D)


def control_plant(u: np.ndarray, y: np.ndarray, order: int) -> Plant:
    """Markov parameters by python-control's least squares, realised by its eigensystem algorithm."""
    lags = max(20, 6 * order)
    H = control.markov(y.T, u.T, m=lags)
    model, _ = control.eigensys_realization(np.asarray(H).reshape(y.shape[1], u.shape[1], -1), order, m=lags // 2, n=lags // 2 - 1)
    return make_plant(model.A, model.B, model.C, model.D)


PEERS = {
    "nfoursid": ("nfoursid", nfoursid_plant),
    "sippy_unipi": ("sippy_unipi", sippy_plant),
    "python_control": ("control", control_plant),
}


def installed_peers() -> dict[str, Callable]:
    found = {}
    for name, (module, function) in PEERS.items():
        if importlib.util.find_spec(module) is None:
            print(f"{name} is not installed: left out")
        else:
            found[name] = function
    return found


def hold_out(name: str, u: np.ndarray, y: np.ndarray, cut: int, peers: dict[str, Callable]) -> dict:
    """Mean NRMSE over the outputs, means of the hold-out removed to score, for ours and each peer at our number of states, delays included; the peers get data without their means."""
    settings = {"sample_time_s": 1.0, "feedthrough": None, "refinement": "none" if name.startswith("baam") else "validated"}
    ours, seconds = timed(identify, [u[:cut]], [y[:cut]], **settings)
    test = ([u[cut:]], [y[cut:]])
    row = {"order": ours.order, "past": ours.past, "delays": list(ours.delays), "fit": ours.fit, "ours_s": round(seconds, 2)}
    row["ours_percent"] = simulate_fit(ours.plant, *test, means_removed=True).round(2).tolist()
    row["ours_raw_percent"] = simulate_fit(ours.plant, *test).round(2).tolist()
    row["error_percent"] = round(100 - float(np.mean(row["ours_percent"])), 2)
    if name == "two_heaters_prbs":
        row["sixty_ahead_percent"] = predict_fit(ours.plant, *test, 60).round(2).tolist()
    for peer, function in peers.items():
        mean_u, mean_y = u[:cut].mean(axis=0), y[:cut].mean(axis=0)
        try:
            found, seconds = timed(function, u[:cut] - mean_u, y[:cut] - mean_y, ours.plant.n)
            with np.errstate(all="ignore"):
                score = simulate_fit(found, [u[cut:] - mean_u], [y[cut:] - mean_y], means_removed=True)
            row[peer] = {"error_percent": round(100 - float(score.mean()), 2), "s": round(seconds, 2)}
        except (ValueError, np.linalg.LinAlgError, TypeError, ZeroDivisionError, control.ControlArgument) as failure:
            row[peer] = {"failed": str(failure)[:120]}
    return row


def parity(sets) -> dict:
    u, y, _ = sets["dryer"]
    poles = np.sort_complex(np.linalg.eigvals(moesp([u], [y], 15, 4)[0].A))
    out = {
        "singular_values_relative": float(np.abs(moesp_singular_values([u], [y], 15)[:6] / PRINTED_SINGULAR_VALUES - 1).max()),
        "pole_error": float(np.abs(poles - PRINTED_POLES).max()),
    }
    for name, (block_rows, order, published) in ERR1.items():
        u, y, _ = sets[name]
        found, x0 = moesp([u], [y], block_rows, order)
        err1 = np.linalg.norm(y - simulate(found, u, x0[0])[1], 1) / np.linalg.norm(y, 1)
        out[f"err1_{name}"] = {"ours": round(float(err1), 5), "published": published}
    return out


def markov_error(plant: Plant) -> float:
    true = markov_parameters(baam(), 100)
    return float(np.linalg.norm(markov_parameters(plant, 100) - true) / np.linalg.norm(true))


def study_plant(sets: int = 20) -> dict:
    out = {}
    for noise, bar in MARKOV_BARS.items():
        runs = [timed(identify, *([a] for a in probed(seed, noise)), sample_time_s=1.0) for seed in range(sets)]
        errors = [markov_error(found.plant) for found, _ in runs]
        out[f"noise_{noise}"] = {
            "order_six": sum(found.order == 6 for found, _ in runs),
            "of": sets,
            "worst_error": max(errors),
            "median_error": float(np.median(errors)),
            "bar": bar,
            "median_s": round(float(np.median([s for _, s in runs])), 3),
        }
    record = probed(0, 0.0)
    runs = [timed(identify, [record[0]], [record[1]], sample_time_s=1.0) for _ in range(5)]
    out["noise_free"] = {
        "order": runs[0][0].order,
        "error": markov_error(runs[0][0].plant),
        "bar": 1e-10,
        "best_s": round(min(s for _, s in runs), 3),
    }
    u, y = probed(0, 0.1)
    out["fixed_order_s"] = round(min(timed(identify, [u], [y], sample_time_s=1.0, order=6, past=24)[1] for _ in range(3)), 3)
    return out


def main() -> None:
    peers, sets = installed_peers(), records()
    result = {
        "parity": parity(sets),
        "hold_out": {name: hold_out(name, *record, peers) for name, record in sets.items()},
        "baam": study_plant(),
    }
    for name, bar in HOLD_OUT_BARS.items():
        result["hold_out"][name]["bar"] = bar
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps(result, indent=2) + "\n")
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
