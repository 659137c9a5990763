"""Identification held against published figures, against peers on the same hold-outs, and against simple
competitors on records that no linear model made.

`./run --group peers python -m benchmarks.identification` writes its part of benchmarks/results.json; with
`foreign` behind it, it prints the records of tests/foreign. The peers are nfoursid, sippy_unipi and
python-control; one that is not installed is left out with a line. Data sets come from BEADLINE_SHARED, by
default ../shared. Times are CPU seconds.
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

from benchmarks import results
from benchmarks.results import Row
from pipeline.papers.published import K_DATA
from pipeline.papers.study import study_probe, study_signal
from pipeline.temperature.identification.model_choice import Settings, identify
from pipeline.temperature.identification.order import LARGEST_RADIUS, stabilised
from pipeline.temperature.identification.subspace import lagged, realise, subspace
from pipeline.temperature.plant import Plant, baam, markov_parameters
from pipeline.temperature.plant import plant as make_plant
from tests.foreign.records import RECORDS
from tests.temperature.fits import predict_fit, resampled, simulate_fit
from tests.temperature.moesp import moesp, varx

SHARED = Path(os.environ.get("BEADLINE_SHARED", "../shared")) / "data"
FOREIGN_SEEDS = (20, 21, 22)
LOWEST = -100.0  # a fit below this is a failure, however far below
AMPLITUDES = np.arange(100.0, 0.0, -10.0)
HOLD_OUT_BARS = {"dryer": 8.0, "evaporator": 38.0, "glass_furnace": 36.0}
MARKOV_BARS = {0.1: 2e-3, 0.5: 1.5e-2}


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
            basis = subspace(data, past)[0]
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


def rows(hold_outs: dict[str, dict], study: dict[str, dict]) -> list[Row]:
    """Ours beside each peer on records that nothing was fitted to, error and seconds; then the study's
    plant."""
    out = []
    for name, one in hold_outs.items():
        peers = [
            f"{peer} failed"
            if "failed" in one[peer]
            else f"{peer} {one[peer]['error_percent']:g} % in {one[peer]['s']:g} s"
            for peer in PEERS
            if peer in one
        ]
        bar = f"limit {one['bar']:g} %" if "bar" in one else ""
        measured = f"{one['error_percent']:g} % in {one['ours_s']:g} s"
        out.append(Row(f"error on the hold-out of `{name}`", measured, "; ".join(peers), bar))
    for name, one in study.items():
        if isinstance(one, dict) and "worst_error" in one:
            order = f"order six found in {one['order_six']} of {one['of']}"
            out.append(
                Row(
                    f"the study's plant, {name.replace('_', ' ')}: worst error of the Markov parameters",
                    f"{one['worst_error']:.2g} in {one['median_s']:g} s",
                    f"at most {one['bar']:g}",
                    order,
                )
            )
    return out


def main() -> None:
    if sys.argv[1:] == ["foreign"]:
        for name in RECORDS:
            for seed in FOREIGN_SEEDS:
                print(f"{name}_{seed}", json.dumps(foreign(name, seed)), flush=True)
        return
    peers = installed_peers()
    hold_outs = {name: hold_out(name, *record, peers) for name, record in records().items()}
    for name, bar in HOLD_OUT_BARS.items():
        hold_outs[name]["bar"] = bar
    results.write("identification", rows(hold_outs, study_plant()))


if __name__ == "__main__":
    main()
