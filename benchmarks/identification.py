"""Identification held against published figures, against peers on the same hold-outs, and against simple
competitors on records that no linear model made.

`./run python -m benchmarks.identification` prints the tables with their bars and writes
benchmarks/results/identification.json; with `foreign` behind it, only the last table, into
identification_foreign.json; with `speed`, only how many times faster than nfoursid, into `speed` of the
results. The peers are nfoursid, sippy_unipi and python-control; one that is not installed
is left out with a line. Data sets come from BEADLINE_SHARED, by default ../shared. Times are CPU seconds.
"""

import importlib.util
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import control
import numpy as np

from benchmarks.foreign_records import RECORDS
from benchmarks.moesp import moesp, moesp_singular_values, varx
from pipeline.temperature.identification import Settings, identify
from pipeline.temperature.order import LARGEST_RADIUS, stabilised
from pipeline.temperature.plant import Plant, baam, markov_parameters, simulate
from pipeline.temperature.plant import plant as make_plant
from pipeline.temperature.probing import study_probe, study_signal
from pipeline.temperature.published import K_DATA
from pipeline.temperature.subspace import Segments, lagged, realise, subspace
from pipeline.temperature.validation import predicted_ahead, simulated

SHARED = Path(os.environ.get("BEADLINE_SHARED", "../shared")) / "data"
RESULTS = Path(__file__).parent / "results" / "identification.json"
FOREIGN_RESULTS = RESULTS.with_name("identification_foreign.json")
FOREIGN_SEEDS = (20, 21, 22)
LOWEST = -100.0  # a fit below this is a failure, however far below
AMPLITUDES = np.arange(100.0, 0.0, -10.0)
PRINTED_SINGULAR_VALUES = np.array([69.8841, 14.9963, 3.6675, 1.9677, 0.3000, 0.2078])
PRINTED_POLES = np.sort_complex(np.array([0.961, 0.7455, 0.4758 + 0.200j, 0.4758 - 0.200j]))
ERR1 = {"dryer": (15, 4, 0.0150), "evaporator": (10, 4, 0.489), "glass_furnace": (10, 5, 0.496)}
HOLD_OUT_BARS = {"dryer": 8.0, "evaporator": 38.0, "glass_furnace": 36.0}
MARKOV_BARS = {0.1: 2e-3, 0.5: 1.5e-2}


def nrmse(y: np.ndarray, predicted: np.ndarray, *, means_removed: bool = False) -> np.ndarray:
    """Fit of each output in percent, 100 (1 - |y - ŷ| / |y - mean y|); NaN in y is left out. With
    `means_removed` the mean of the error is taken off first."""
    mask = np.isfinite(y)
    error = np.where(mask, y - predicted, np.nan)
    error = error - np.nanmean(error, axis=0) if means_removed else error
    spread = np.where(mask, y, np.nan) - np.nanmean(np.where(mask, y, np.nan), axis=0)
    return 100.0 * (
        1.0
        - np.sqrt(
            np.nansum(error**2, axis=0) / np.maximum(np.nansum(spread**2, axis=0), np.finfo(float).tiny)
        )
    )


def simulate_fit(plant: Plant, u: Segments, y: Segments, *, means_removed: bool = False) -> np.ndarray:
    """NRMSE (p,) in percent of free simulation over the segments, the
    initial state of each fitted as in `simulated`."""
    predicted = [simulated(plant, a, b, means_removed=means_removed) for a, b in zip(u, y, strict=True)]
    return nrmse(np.vstack(y), np.vstack(predicted), means_removed=means_removed)


def predict_fit(plant: Plant, u: Segments, y: Segments, steps: int) -> np.ndarray:
    """NRMSE (p,) in percent `steps` samples ahead, over the samples
    after the start-up of `predicted_ahead`."""
    skip = max(3 * plant.n, 30) + steps
    if all(len(a) <= skip for a in u):
        raise ValueError(
            f"predict_fit: expected a segment longer than {skip} samples for {steps} steps ahead; "
            "hold out a longer part, or fewer steps"
        )
    pairs = [
        (b[skip:], predicted_ahead(plant, a, b, steps)[skip:])
        for a, b in zip(u, y, strict=True)
        if len(a) > skip
    ]
    return nrmse(np.vstack([b for b, _ in pairs]), np.vstack([e for _, e in pairs]))


def resampled(
    path: Path, sample_time_s: float, columns: tuple[list[int], list[int]]
) -> tuple[np.ndarray, np.ndarray]:
    """Inputs held and outputs interpolated on a clock of `sample_time_s`: the makers' stamps are jittered."""
    record = np.genfromtxt(path, delimiter=",", skip_header=1)
    t = np.arange(0.0, record[-1, 0], sample_time_s)
    held = np.maximum(np.searchsorted(record[:, 0], t, side="right") - 1, 0)
    return record[held][:, columns[0]], np.column_stack(
        [np.interp(t, record[:, 0], record[:, k]) for k in columns[1]]
    )


def probed(seed: int, noise: float, samples: int = 15_000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    signal = study_signal(rng, samples, 7, amplitudes=AMPLITUDES, bandwidth=1.65, variance=1.5)
    recorded = study_probe(
        baam(), signal, K_DATA, x0=np.full(6, 50.0), noise=noise * rng.standard_normal((samples, 5))
    )
    return recorded.u, recorded.y


def records() -> dict[str, tuple[np.ndarray, np.ndarray, int]]:
    """u, y and the first sample of the hold-out of each set."""
    dryer, evaporator, glass = (
        np.loadtxt(SHARED / "daisy_a" / f"{name}.dat") for name in ("dryer", "evaporator", "glassfurnace")
    )
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
    peer = NFourSID(frame, output_columns=outputs, input_columns=inputs, num_block_rows=10)
    peer.subspace_identification()
    model, _ = peer.system_identification(rank=order)
    return make_plant(model.a, model.b, model.c, model.d)


def sippy_plant(u: np.ndarray, y: np.ndarray, order: int) -> Plant:
    from sippy_unipi import system_identification

    model = system_identification(y.T, u.T, id_method="N4SID", SS_fixed_order=order, SS_f=10, SS_p=10)
    return make_plant(model.A, model.B, model.C, model.D)


def control_plant(u: np.ndarray, y: np.ndarray, order: int) -> Plant:
    """Markov parameters by python-control's least squares, realised by its eigensystem algorithm."""
    lags = max(20, 6 * order)
    H = control.markov(y.T, u.T, m=lags)
    model, _ = control.eigensys_realization(
        np.asarray(H).reshape(y.shape[1], u.shape[1], -1), order, m=lags // 2, n=lags // 2 - 1
    )
    return make_plant(model.A, model.B, model.C, model.D)


PEERS = {
    "nfoursid": ("nfoursid", nfoursid_plant),
    "sippy_unipi": ("sippy_unipi", sippy_plant),
    "python_control": ("control", control_plant),
}


def installed_peers() -> dict[str, Callable]:
    peers = {}
    for name, (module, function) in PEERS.items():
        if importlib.util.find_spec(module) is None:
            print(f"{name} is not installed: left out")
        else:
            peers[name] = function
    return peers


def hold_out(name: str, u: np.ndarray, y: np.ndarray, cut: int, peers: dict[str, Callable]) -> dict:
    """Mean NRMSE over the outputs, means of the hold-out removed to score, for ours and each peer at our
    number of states, delays included; the peers get data without their means."""
    settings = Settings(feedthrough=None)
    validated = settings._replace(refinement="validated")
    ours, seconds = timed(identify, [u[:cut]], [y[:cut]], sample_time_s=1.0, settings=validated)
    rough, rough_seconds = timed(identify, [u[:cut]], [y[:cut]], sample_time_s=1.0, settings=settings)
    test = ([u[cut:]], [y[cut:]])
    row = {
        "order": ours.order,
        "past": ours.past,
        "delays": list(ours.delays),
        "fit": ours.fit,
        "ours_s": round(seconds, 2),
    }
    row["ours_percent"] = simulate_fit(ours.plant, *test, means_removed=True).round(2).tolist()
    row["ours_raw_percent"] = simulate_fit(ours.plant, *test).round(2).tolist()
    row["error_percent"] = round(100 - float(np.mean(row["ours_percent"])), 2)
    row["unrefined"] = {
        "error_percent": round(100 - float(simulate_fit(rough.plant, *test, means_removed=True).mean()), 2),
        "s": round(rough_seconds, 2),
    }
    if name == "two_heaters_prbs":
        row["sixty_ahead_percent"] = predict_fit(ours.plant, *test, 60).round(2).tolist()
    for peer, function in peers.items():
        mean_u, mean_y = u[:cut].mean(axis=0), y[:cut].mean(axis=0)
        try:
            model, seconds = timed(function, u[:cut] - mean_u, y[:cut] - mean_y, ours.plant.n)
            with np.errstate(all="ignore"):
                score = simulate_fit(model, [u[cut:] - mean_u], [y[cut:] - mean_y], means_removed=True)
            if not np.isfinite(score).all():
                raise ValueError("the simulation of the hold-out is not finite")
            row[peer] = {"error_percent": round(100 - float(score.mean()), 2), "s": round(seconds, 2)}
        except (
            ValueError,
            np.linalg.LinAlgError,
            TypeError,
            ZeroDivisionError,
            control.ControlArgument,
        ) as failure:
            row[peer] = {"failed": str(failure)[:120]}
    return row


def parity(sets) -> dict:
    u, y, _ = sets["dryer"]
    poles = np.sort_complex(np.linalg.eigvals(moesp([u], [y], 15, 4)[0].A))
    out = {
        "singular_values_relative": float(
            np.abs(moesp_singular_values([u], [y], 15)[:6] / PRINTED_SINGULAR_VALUES - 1).max()
        ),
        "pole_error": float(np.abs(poles - PRINTED_POLES).max()),
    }
    for name, (block_rows, order, published) in ERR1.items():
        u, y, _ = sets[name]
        model, x0 = moesp([u], [y], block_rows, order)
        err1 = np.linalg.norm(y - simulate(model, u, x0[0])[1], 1) / np.linalg.norm(y, 1)
        out[f"err1_{name}"] = {"ours": round(float(err1), 5), "published": published}
    return out


def markov_error(plant: Plant) -> float:
    true = markov_parameters(baam(), 100)
    return float(np.linalg.norm(markov_parameters(plant, 100) - true) / np.linalg.norm(true))


def study_plant(sets: int = 20) -> dict:
    out = {}
    for noise, bar in MARKOV_BARS.items():
        for refinement in ("none", "validated"):
            settings = {"sample_time_s": 1.0, "settings": Settings(refinement=refinement)}
            runs = [timed(identify, *([a] for a in probed(seed, noise)), **settings) for seed in range(sets)]
            errors = [markov_error(identified.plant) for identified, _ in runs]
            out[f"noise_{noise}_{refinement}"] = {
                "order_six": sum(identified.order == 6 for identified, _ in runs),
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
    out["fixed_order_s"] = round(
        min(
            timed(identify, [u], [y], sample_time_s=1.0, settings=Settings(order=6, past=24))[1]
            for _ in range(3)
        ),
        3,
    )
    return out


def score(plant: Plant, u: np.ndarray, y: np.ndarray) -> list[float]:
    """Mean hold-out fit over the outputs in percent, the means of the errors removed, and as it is."""
    try:
        with np.errstate(all="ignore"):
            fits = [simulate_fit(plant, [u], [y], means_removed=removed) for removed in (True, False)]
    except np.linalg.LinAlgError:
        return [LOWEST, LOWEST]
    return [round(float(np.maximum(np.nan_to_num(fit, nan=LOWEST), LOWEST).mean()), 1) for fit in fits]


def arx_plant(u: np.ndarray, y: np.ndarray, past: int) -> Plant:
    """The least-squares ARX model of `past` lags, its window as the state."""
    fit, m, p = varx([u], [y], past), u.shape[1], y.shape[1]
    q, size = m + p, past * (m + p)
    A, B, C, b = (
        np.zeros((size, size)),
        np.zeros((size, m)),
        np.concatenate([fit.B, fit.A], axis=2).transpose(1, 0, 2).reshape(p, size),
        np.zeros(size),
    )
    A[m:q], A[q:, :-q], B[:m], b[m:q] = C, np.eye(size - q), np.eye(m), fit.constant
    return make_plant(A, B, C, None, b, fit.constant)


def arx_lags(u: np.ndarray, y: np.ndarray, price: Callable[[int], float]) -> int:
    """Lags, up to 20, with the least criterion rows log det S + price(rows) x coefficients."""
    p, tried = y.shape[1], []
    for past in range(1, 21):
        features = past * (u.shape[1] + p)
        if len(u) - past < 2 * features:
            break
        fit = varx([u], [y], past)
        S = fit.covariance * (fit.rows - features - 1) / fit.rows
        tried.append((fit.rows * np.linalg.slogdet(S)[1] + price(fit.rows) * p * features, past))
    return min(tried)[1]


def subspace_plants(u: np.ndarray, y: np.ndarray) -> Iterator[tuple[str, Plant]]:
    """Every plain subspace model of order 1 to 12: windows 5 to 40 and past-output MOESP of 10 and 15 block
    rows, poles drawn into the unit circle."""
    for past in (5, 10, 20, 40):
        for feedthrough in (False, True):
            try:
                data = lagged([u], [y], past, feedthrough=feedthrough)
            except ValueError:
                continue
            basis = subspace(data, past).basis
            for order in range(1, min(12, len(basis)) + 1):
                yield "n4sid", stabilised(realise(data, basis[:order], 1.0), LARGEST_RADIUS)
    for block_rows in (10, 15):
        for order in range(1, 13):
            try:
                yield "moesp", stabilised(moesp([u], [y], block_rows, order, offset=True)[0], LARGEST_RADIUS)
            except ValueError:
                continue


def foreign(name: str, seed: int) -> dict:
    """Ours by its own rule, ARX by Akaike's and Schwarz's criteria, and the subspace models that are best on
    the hold-out itself, which nobody could choose."""
    u, y = RECORDS[name](np.random.default_rng(seed))
    cut = int(0.7 * len(u))
    train, test = (u[:cut], y[:cut]), (u[cut:], y[cut:])
    ours, seconds = timed(
        identify,
        *([a] for a in train),
        sample_time_s=1.0,
        settings=Settings(feedthrough=None, refinement="validated"),
    )
    row = {
        "samples": len(u),
        "inputs": u.shape[1],
        "outputs": y.shape[1],
        "order": ours.order,
        "past": ours.past,
        "delays": list(ours.delays),
        "feedthrough": ours.feedthrough,
        "fit": ours.fit,
        "s": round(seconds, 1),
        "ours": score(ours.plant, *test),
        "arx_akaike": score(arx_plant(*train, arx_lags(*train, lambda rows: 2.0)), *test),
        "arx_schwarz": score(arx_plant(*train, arx_lags(*train, np.log)), *test),
    }
    for kind, scores in subspace_plants(*train):
        best, now = row.setdefault(f"best_{kind}", [LOWEST, LOWEST]), score(scores, *test)
        row[f"best_{kind}"] = max(best, now)
    return row


def speed(rounds: int = 3) -> dict:
    """CPU seconds on the study's record (10,500 samples, 0.1 °C of noise) as it comes and without refinement,
    and how many times faster than nfoursid: the median of rounds in which they take turns."""
    if importlib.util.find_spec("nfoursid") is None:
        sys.exit("benchmarks.identification: nfoursid is not installed; start with ./run --group peers")
    u, y = (signal[:10_500] for signal in probed(0, 0.1))
    order = identify([u], [y], sample_time_s=1.0, settings=Settings(feedthrough=None)).plant.n
    taken: dict[str, list[float]] = {"validated": [], "none": [], "nfoursid": []}
    for _ in range(rounds):
        for refinement in ("validated", "none"):
            settings = Settings(feedthrough=None, refinement=refinement)
            taken[refinement].append(timed(identify, [u], [y], sample_time_s=1.0, settings=settings)[1])
        taken["nfoursid"].append(timed(nfoursid_plant, u - u.mean(axis=0), y - y.mean(axis=0), order)[1])
    return {
        **{f"{name}_s": round(float(np.median(seconds)), 3) for name, seconds in taken.items()},
        **{
            f"times_faster_{name}": round(float(np.median(np.divide(taken["nfoursid"], taken[name]))), 2)
            for name in ("validated", "none")
        },
    }


def main() -> None:
    if "foreign" in sys.argv[1:]:
        result = {f"{name}_{seed}": foreign(name, seed) for name in RECORDS for seed in FOREIGN_SEEDS}
        FOREIGN_RESULTS.write_text(json.dumps(result, indent=1) + "\n")
        for name, row in result.items():
            print(
                f"{name:20s}",
                *(
                    f"{key} {row[key]}"
                    for key in ("ours", "arx_akaike", "arx_schwarz", "best_n4sid", "best_moesp")
                    if key in row
                ),
            )
        return
    if sys.argv[1:] == ["speed"]:
        result = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
        result["speed"] = speed()
        print(json.dumps(result["speed"], indent=2))
        RESULTS.write_text(json.dumps(result, indent=2) + "\n")
        return
    peers, sets = installed_peers(), records()
    kept = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    result = {
        **{name: kept[name] for name in ("speed",) if name in kept},
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
