"""Foreign extruders that learn the reference routine, and the least error that a limited drive allows."""

import numpy as np
import scipy.optimize

from pipeline.deposition.drive import UNLIMITED, Drive, obeyed
from pipeline.deposition.extruder import Extruder, routine
from pipeline.deposition.learning import ilc
from tests.foreign.extruders import CHANGING, STATIC, ForeignExtruder, drawn, flow, seen

TS, AREA, SPEED, TRIALS, RISE = 0.02, 0.304, 8.0, 30, 0.1
STEADY = AREA * SPEED
MATERIALS = {"A": Extruder(1.08, 2.7), "B": Extruder(0.89, 4.5)}
ROUTINE = routine(
    off_s=4, on_s=6, pause_s=0.6, tail_s=8, speed=SPEED, bead_area_mm2=AREA, ramp_s=0.15, sample_time_s=TS
)
INVERSE = ilc.InverseSettings(identify_trials=3, floor=0.1, order=4, cutoff_hz=5.0)


def plant(kind: str, material: str, number: int) -> ForeignExtruder:
    """One plant, the same in every benchmark."""
    rng = np.random.default_rng([7, (STATIC + CHANGING).index(kind), "AB".index(material), number])
    nominal = MATERIALS[material]
    return drawn(kind, rng, gain=nominal.gain, time_constant_s=nominal.time_constant_s, steady_flow=STEADY)


def reachable_error(extruder: ForeignExtruder, start: np.ndarray, drive: Drive) -> float:
    """The least r.m.s. error of the true flow within the drive, found from the command `start` (T,): a
    bounded quadratic program on the lifted response of the plant, its speed limit by an augmented
    Lagrangian."""
    h, n, step = _pulse_response(extruder), len(start), drive.speed_mm_per_s * TS
    H = np.fft.rfft(h, 2 * n)
    pressed = lambda u: np.fft.irfft(H * np.fft.rfft(u, 2 * n), 2 * n)[:n]  # noqa: E731
    transposed = lambda e: np.fft.irfft(np.conj(H) * np.fft.rfft(e, 2 * n), 2 * n)[:n]  # noqa: E731

    def cost(u, multiplier, weight):
        x = pressed(u)
        e = np.maximum(x, 0) - ROUTINE.r
        value, gradient = e @ e / 2, transposed(e * (x > 0))
        if np.isfinite(step):
            w = np.diff(u, prepend=0.0) + multiplier / weight
            over = weight * (np.maximum(w - step, 0) + np.minimum(w + step, 0))
            value += over @ over / 2 / weight
            gradient = gradient + over - np.append(over[1:], 0.0)
        return value, gradient

    u, multiplier, weight = start, np.zeros(n), 1.0
    for _ in range(8 if np.isfinite(step) else 1):
        u = scipy.optimize.minimize(
            cost,
            u,
            args=(multiplier, weight),
            jac=True,
            method="L-BFGS-B",
            bounds=[(-drive.amplitude_mm, drive.amplitude_mm)] * n,
            options={"maxiter": 800, "maxfun": 1600, "ftol": 1e-10, "gtol": 1e-7, "maxcor": 30},
        ).x
        w = np.diff(u, prepend=0.0) + multiplier / weight
        multiplier = weight * (np.maximum(w - step, 0) + np.minimum(w + step, 0))
        weight = min(2 * weight, 50.0)
    within = obeyed(u, drive, sample_time_s=TS)
    return min(
        ilc.rms(ROUTINE.r - flow(extruder, v, sample_time_s=TS, trial=TRIALS)) for v in (within, start)
    )


def _pulse_response(extruder: ForeignExtruder) -> np.ndarray:
    """Flow (T,) after one sample of 1 mm, far above the end of the flow at zero."""
    far = extruder._replace(yield_=-1e3, soft=1e-6)
    pulse = np.zeros(len(ROUTINE.r))
    rest = flow(far, pulse, sample_time_s=TS)
    pulse[0] = 1.0
    return flow(far, pulse, sample_time_s=TS) - rest


def learned_percent(extruder: ForeignExtruder, material: str, seed: int) -> np.ndarray:
    """R.m.s. error of the true flow after each update by the model inverse (TRIALS + 1,), percent of trial
    0's."""
    r, nominal = ROUTINE.r, MATERIALS[material]
    rng, count = np.random.default_rng([8, seed]), iter(range(TRIALS + 1))

    def measure(u: np.ndarray) -> ilc.Trial:
        applied = obeyed(u, UNLIMITED, sample_time_s=TS)
        truth = flow(extruder, applied, sample_time_s=TS, trial=next(count))
        return ilc.Trial(applied, seen(truth, rng, steady_flow=STEADY), truth)

    law = ilc.InverseLaw(r, INVERSE, drive=UNLIMITED, sample_time_s=TS)
    trials = ilc.learn(law, measure, r / nominal.gain, r, trials=TRIALS, rise=RISE)
    rows = ilc.table(trials, r, steady=STEADY / nominal.gain, drive=UNLIMITED, sample_time_s=TS, rise=RISE)
    return 100 * np.array([row.ratio for row in rows])
