"""Two hundred random heated machines of another structure than our model. Does the next experiment, designed
on what a short noisy record tells, stay within the declared limits when the true machine plays it? Does it
teach as much as what was written before, which nobody had forecast?

`./run python -m benchmarks.experiment` prints the figures and writes benchmarks/results/experiment.json. With
`--first N --count M` only those machines are played; what the other pieces found is kept in that file.

The machines are thermal networks in continuous time: masses with heat capacity, losses to an ambient of 15 to
35 °C and conductances between them, each heater behind a transport delay of up to 30 s, gains over three
decades. They are solved by matrix exponentials on a grid four times finer than the samples.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.signal

from pipeline.temperature import experiment, forecast, identification
from pipeline.temperature.experiment import Family, Limits, Names, Wish
from pipeline.temperature.probing import multisine, prbs
from pipeline.temperature.validation import bootstrap_spread

RESULTS = Path(__file__).parent / "results" / "experiment.json"
MACHINES, RECORDED, LONGEST, FINE = 200, 1200, 1500, 4
AMPLITUDE, RATE = 5.0, 5.0
DOUBT = forecast.Doubt(0.15, 8.0, 1)  # as params.expert.yaml has them
SPAN_DEGC = 10.0  # what a machine must have to be counted among those for which an experiment is wanted
BARS = {"crossings": 0, "written_percent": 90.0, "information_ratio": 0.5}


class Machine(NamedTuple):
    """Masses with heat capacity (k,), losses (k,) to the ambient, conductances (k, k) between them; heating
    (k, m) by a percent of each input, its delay_s (m,); the first p masses have sensors with this noise."""

    capacity: np.ndarray
    loss: np.ndarray
    conductance: np.ndarray
    heating: np.ndarray
    delay_s: np.ndarray
    outputs: int
    ambient: float
    noise: float
    sample_time_s: float
    high: np.ndarray
    reference: np.ndarray

    @property
    def inputs(self) -> int:
        return self.heating.shape[1]


def network(machine: Machine) -> np.ndarray:
    """F of dT/dt = F (T - ambient) + heating u / capacity."""
    between = machine.conductance - np.diag(machine.conductance.sum(axis=1))
    return (between - np.diag(machine.loss)) / machine.capacity[:, None]


def steady_gain(machine: Machine) -> np.ndarray:
    """(p, m) in °C per percent."""
    drive = machine.heating / machine.capacity[:, None]
    return np.linalg.solve(-network(machine), drive)[: machine.outputs]


def play(machine: Machine, u: np.ndarray, before: np.ndarray | None = None) -> np.ndarray:
    """True outputs (T, p) under u (T, m), held between samples, after it was at rest for ever under `before`
    (the first row where None)."""
    before = u[0] if before is None else before
    h, m = machine.sample_time_s / FINE, machine.inputs
    fine = np.repeat(u, FINE, axis=0)
    lags = np.round(machine.delay_s / h).astype(int)
    late = [np.r_[np.full(lags[j], before[j]), fine[:, j]][: len(fine)] for j in range(m)]
    drive = machine.heating / machine.capacity[:, None]
    rest = np.linalg.solve(-network(machine), drive @ before)
    eigenvalues, V = np.linalg.eig(network(machine))
    eigenvalues, V = eigenvalues.real, V.real  # a network of conductances oscillates nowhere
    a = np.exp(eigenvalues * h)
    into = np.linalg.solve(V, drive) * ((a - 1) / eigenvalues)[:, None]
    moved = np.column_stack(late) - before
    modes = np.stack(
        [scipy.signal.lfilter([0.0, 1.0], [1.0, -a[k]], moved @ into[k]) for k in range(len(a))], axis=1
    )
    states = rest + modes @ V.T
    return machine.ambient + states[::FINE, : machine.outputs]


def machine_of(rng: np.random.Generator) -> Machine:
    """A random machine; its limit lies anywhere between the ambient and what its heaters can reach."""
    p, m = int(rng.integers(1, 5)), int(rng.integers(1, 5))
    k = max(p, m) + int(rng.integers(0, 3))
    tau = np.exp(rng.uniform(np.log(20), np.log(300))) * rng.uniform(0.5, 2.0, k)
    loss = rng.uniform(0.5, 1.5, k)
    between = np.triu(rng.uniform(0.0, 0.4, (k, k)) * (rng.random((k, k)) < 0.5), 1)
    between[np.arange(k - 1), np.arange(1, k)] += 0.1  # neighbours touch
    heating = np.zeros((k, m))
    heating[np.arange(m) % k, np.arange(m)] = 1.0
    heating += 0.2 * rng.random((k, m)) * (rng.random((k, m)) < 0.3)
    # gains over three decades: 0.01 to 10 °C per percent
    heating *= np.exp(rng.uniform(np.log(0.01), np.log(10)))
    machine = Machine(
        tau * loss, loss, between + between.T, heating, rng.uniform(0, 30, m) * (rng.random(m) < 0.7), p,
        rng.uniform(15, 35), np.exp(rng.uniform(np.log(0.03), np.log(0.3))), float(tau.min() / 8),
        np.zeros(p), np.zeros(p),
    )  # fmt: skip
    hottest = 100 * steady_gain(machine).sum(axis=1)
    high = machine.ambient + hottest * rng.uniform(0.2, 1.0, p)
    reference = machine.ambient + (high - machine.ambient) * rng.uniform(0.2, 0.95, p)
    return machine._replace(high=high, reference=reference)


def recorded(machine: Machine, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """What an operator recorded: holds about a level that warms the machine to a third or a half of what its
    limit allows."""
    m, slowest = machine.inputs, (machine.capacity / machine.loss).max() / machine.sample_time_s
    share = ((steady_gain(machine) @ np.full(m, 1.0)) / (machine.high - machine.ambient)).max()
    level = rng.uniform(0.3, 0.5) / share * rng.uniform(0.6, 1.0, m)
    hold = max(int(slowest / 3), 5)
    draws = rng.uniform(-1.0, 1.0, (-(-RECORDED // hold), m))
    u = np.clip(level * (1 + 0.5 * np.repeat(draws, hold, axis=0)[:RECORDED]), 0, 100)
    return u, play(machine, u)


def identified(machine: Machine, u: np.ndarray, y: np.ndarray, seed: int) -> Family:
    """As the stage identifies, with fewer orders."""
    settings = identification.Settings(max_order=8, refinement="validated", inputs=machine.inputs)
    found = identification.identify([u], [y], sample_time_s=machine.sample_time_s, settings=settings)
    rng = np.random.default_rng(seed)
    spread = bootstrap_spread([u], [y], found, count=20, order=found.order + 1, rng=rng)
    plants = [found.plant, *spread]
    names = Names(
        [f"heater_{j}" for j in range(machine.inputs)], [f"zone_{o}" for o in range(machine.outputs)]
    )
    return experiment.family_of(
        plants, ([u], [y]), reach=np.full(machine.inputs, 100.0), longest=LONGEST, doubt=DOUBT, names=names
    )


def information(machine: Machine, signal: np.ndarray) -> float:
    """Smallest eigenvalue of the Fisher information of the logarithms of every input's gain and of every
    zone's heat capacity, which is its time constant, from `signal` (T, m) played about rest on the truth."""
    rest = np.zeros(machine.inputs)
    columns = [
        (play(machine, signal * (np.arange(machine.inputs) == j), rest) - machine.ambient).ravel()
        for j in range(machine.inputs)
    ]
    for o in range(machine.outputs):
        own = np.arange(len(machine.capacity)) == o
        others = [machine._replace(capacity=machine.capacity * scale**own) for scale in (1.01, 1 / 1.01)]
        sides = [play(other, signal, rest) for other in others]
        columns.append(((sides[0] - sides[1]) / (2 * np.log(1.01))).ravel())
    J = np.column_stack(columns) / machine.noise
    return float(np.linalg.eigvalsh(J.T @ J)[0])


def beyond(machine: Machine, y: np.ndarray) -> float:
    """How far y (T, p) leaves the declared limits, 0 °C and the machine's own above; negative inside."""
    return float(max((y - machine.high).max(), (0.0 - y).max()))


def another_day(machine: Machine, u: np.ndarray, played: np.ndarray) -> float:
    """How far the truth leaves its limits under `played` (T, m) after the record u where all that is doubted
    comes true at once: every gain 15 % larger from now on and the ambient 8 °C warmer in the end; or both the
    other way."""
    drift = DOUBT.ambient_degC * np.linspace(0, 1, len(played))[:, None]
    return max(
        beyond(
            machine,
            play(machine, np.vstack([u, (1 + sign * DOUBT.input_gain) * played]))[len(u) :] + sign * drift,
        )
        for sign in (1.0, -1.0)
    )


def judged(seed: int) -> dict[str, Any]:
    """One machine from its record to what the truth does under the experiment."""
    rng = np.random.default_rng([seed, 17])
    machine = machine_of(rng)
    u, true = recorded(machine, rng)
    y = true + machine.noise * rng.standard_normal(true.shape)
    m, p = machine.inputs, machine.outputs
    span = float(min((machine.high - machine.ambient).min(),
                     (100 * steady_gain(machine).sum(axis=1)).min()))  # fmt: skip
    row = {"machine": seed, "inputs": m, "outputs": p, "span_degC": span, "noise_degC": machine.noise}
    low = np.full(p, 0.0)
    limits = Limits(np.zeros(m), np.full(m, 100.0), RATE, low, machine.high)
    wish = Wish(machine.reference, AMPLITUDE, LONGEST, "prbs", 1)
    try:
        family = identified(machine, u, y, seed)
        tried = experiment.design(family, wish, limits, rng)
    except (ValueError, np.linalg.LinAlgError) as error:
        return row | {"written": False, "reason": str(error)}
    row |= {"written": tried.written, "reason": tried.reason}
    if not tried.written:
        return row
    after = play(machine, np.vstack([u, tried.u]))[len(u) :]
    rise = experiment.ramp_samples(limits, LONGEST)
    ours = information(machine, tried.u[rise:] - tried.centre)
    unsafe = {
        "multisine": multisine(rng, LONGEST, m, amplitude=AMPLITUDE),
        "prbs": prbs(rng, LONGEST, m, amplitude=AMPLITUDE, shortest=1),
        "same_signal": AMPLITUDE * experiment.signal(rng, LONGEST, wish, family.pace),
    }
    middle = play(machine, np.tile(np.full(m, 50.0), (LONGEST, 1)), u[-1])
    return row | {
        "beyond_degC": beyond(machine, after),
        "beyond_another_day_degC": another_day(machine, u, tried.u),
        "forecast_covers": bool(
            (after <= tried.extremes.highest).all() and (after >= tried.extremes.lowest).all()
        ),
        "unsafe_beyond_degC": float((middle - machine.high).max()),
        "samples": len(tried.u),
        "amplitude_percent": tried.amplitude.tolist(),
        "information_ratio": {name: ours / information(machine, s) for name, s in unsafe.items()},
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures of all machines played."""
    written = [row for row in rows if row["written"]]
    wanted = [row for row in rows if row["span_degC"] >= SPAN_DEGC]
    ratios = {
        name: np.array([row["information_ratio"][name] for row in written])
        for name in ("multisine", "prbs", "same_signal")
    }
    return {
        "machines": len(rows),
        "written": len(written),
        "crossings": sum(row["beyond_degC"] > 0 for row in written),
        "worst_beyond_degC": max((row["beyond_degC"] for row in written), default=None),
        "crossings_another_day": sum(row["beyond_another_day_degC"] > 0 for row in written),
        "forecast_covers": sum(row["forecast_covers"] for row in written),
        "unsafe_crossings": sum(row["unsafe_beyond_degC"] > 0 for row in written),
        "with_span": len(wanted),
        "written_percent": 100 * sum(row["written"] for row in wanted) / max(len(wanted), 1),
        "information_ratio": {
            name: {
                "median": float(np.median(ratio)),
                "q10": float(np.quantile(ratio, 0.1)),
                "least": float(ratio.min()),
                "at_least_half_percent": 100 * float((ratio >= BARS["information_ratio"]).mean()),
            }
            for name, ratio in ratios.items()
            if len(ratio)
        },
        "bars": BARS,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=MACHINES)
    arguments = parser.parse_args()
    played = range(arguments.first, min(arguments.first + arguments.count, MACHINES))
    began = time.process_time()
    rows = [judged(seed) for seed in played]
    cpu = time.process_time() - began
    before = json.loads(RESULTS.read_text())["rows"] if RESULTS.exists() else []
    rows = sorted(
        [row for row in before if row["machine"] not in played] + rows, key=lambda row: row["machine"]
    )
    found = summary(rows)
    print(json.dumps(found, indent=2), f"{cpu:.0f} s of one core for {len(played)} machines", sep="\n")
    RESULTS.write_text(json.dumps({**found, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
