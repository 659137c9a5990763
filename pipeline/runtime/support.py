"""Where a recording is off the support of what a controller was learned from and judged on: temperatures and
commands beyond what was seen, and outputs that no plant of its spread would have had.

Plants of the spread each forecast the outputs a few samples ahead, every one from its own observer and with
the inputs that were applied. How much they differ among themselves is what the spread leaves open, there and
then. The machine's miss e (p,) of their mean is held against it,

    d^2 = e' (S + R)^-1 e,   S the forecasts' covariance (p, p), R what the sensors' noise adds,

and a forecast is off where d is larger than nearly always on the controller's own plants. A log is off
support where more of its forecasts are off than of an honest log, or its signals leave their ranges.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg

from pipeline.runtime.replay import BLOCK, Log, scanned
from pipeline.temperature.governor import instants
from pipeline.temperature.plant import Plant, markov_parameters
from pipeline.temperature.tracking import reached_state, riccati

TEMPERATURE, COMMAND, FORECAST = 1, 2, 4
BEYOND = 0.1  # of a range: signals may leave it by so much
NEARLY_ALL = 0.99  # of the forecasts on honest plants are no further off
HONEST = 0.95  # of honest logs have no larger share of forecasts that are off
LEAST_SHARE = 0.05  # and a log is never off for fewer
TAU, DRIFT, LEAK, UNHURRIED = 0.2, 0.06, 1e-4, 16  # of the observers, as of the governor's
AT_ONCE = 4  # forecasts begin so often within the steps that one goes
MOST_SAMPLES = 60_000  # of a long log forecasts are judged in stretches, so many samples in all
STRETCH = 2_000


class Support(NamedTuple):
    """low, high (p,) in °C of temperatures and (m,) in percent of commands; `spread` are the plants that
    forecast, `steps` samples ahead, with sensors' noise (p,) in °C; `furthest` d is allowed, and `allowed`
    the share of forecasts that may be further off in an honest log."""

    temperature_low: np.ndarray
    temperature_high: np.ndarray
    command_low: np.ndarray
    command_high: np.ndarray
    spread: tuple[Plant, ...]
    noise: np.ndarray
    steps: int
    furthest: float
    allowed: float


class Forecasts(NamedTuple):
    """Forecasts of a log: the sample at which each begins (a,), and how far off it is, d (a,)."""

    start: np.ndarray
    d: np.ndarray


def horizon(spread: Sequence[Plant]) -> int:
    """Samples after which an input has shown what it does: the furthest instant of the governor."""
    return int(instants(spread)[-1])


def forecasts(watches: Sequence["Watch"], log: Log, noise: np.ndarray, steps: int) -> Forecasts:
    """Forecasts over `steps` samples, AT_ONCE of them under way at a time; none in the first 2 `steps`, while
    the observers find the machine."""
    start = np.arange(2 * steps, len(log.u) - steps, max(steps // AT_ONCE, 1))
    if not len(start):
        return Forecasts(start, np.zeros(0))
    told = np.stack([_told(one, log, start, steps) for one in watches])
    mean = told.mean(axis=0)
    apart = told - mean
    S = np.einsum("kai,kaj->aij", apart, apart) / (len(watches) - 1)
    e = log.y[start + steps] - mean
    near = S + np.diag((NOISES * noise) ** 2)
    return Forecasts(start, np.sqrt(np.einsum("ai,ai->a", e, np.linalg.solve(near, e[..., None])[..., 0])))


NOISES = 2.0  # deviations: of the sample that is forecast, and of those from which


class Watch(NamedTuple):
    """An observer L of the state [x; w] of one plant: w (p,) in °C a step is a drift that the plant does not
    explain, so that a steady disagreement (another ambient, more heat lost) vanishes from its forecasts, as
    in temperature.governor. `first` (n, p) finds x of the first outputs."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    b: np.ndarray
    d: np.ndarray
    L: np.ndarray
    first: np.ndarray


def watched_by(plant: Plant, steps: int) -> Watch:
    """Process noise comes in by the inputs, sensors are TAU percent^2 of every input noisier, and the drift
    wanders a step by DRIFT of what a percent of every input does at most."""
    n, p, slower = plant.n, plant.p, max(steps / UNHURRIED, 1.0)
    likely = reached_state(plant)
    A = np.block([[plant.A, likely], [np.zeros((p, n)), (1 - LEAK) * np.eye(p)]])
    C = np.hstack([plant.C, np.zeros((p, p))])
    pulse = (np.abs(markov_parameters(plant, steps)).max(axis=0) ** 2).sum(axis=1)
    noise = scipy.linalg.block_diag(plant.B @ plant.B.T, (DRIFT / slower) ** 2 * np.diag(pulse))
    sensors = TAU * slower**2 * pulse.mean() * np.eye(p)
    P = riccati(A.T, C.T, noise, sensors)
    L = A @ P @ C.T @ np.linalg.inv(C @ P @ C.T + sensors)
    none = np.zeros((p, plant.m))
    return Watch(A, np.vstack([plant.B, none]), C, np.r_[plant.b, np.zeros(p)], plant.d, L, likely)


def _told(watch: Watch, log: Log, start: np.ndarray, steps: int) -> np.ndarray:
    """Outputs (a, p) that a plant forecasts `steps` samples after each start (a,)."""
    moved, states = watch.A - watch.L @ watch.C, np.empty((len(start), len(watch.A)))
    x = np.r_[watch.first @ (log.y[0] - watch.d), np.zeros(len(watch.C))]
    for first in range(0, len(log.u), BLOCK):
        rows = slice(first, first + BLOCK)
        inside = np.flatnonzero((start >= first) & (start < first + BLOCK))
        drive = log.u[rows] @ watch.B.T + (log.y[rows] - watch.d) @ watch.L.T + watch.b
        walked = scanned(moved, drive, x)
        states[inside], x = walked[start[inside] - first], walked[-1]
    for step in range(steps):
        states = states @ watch.A.T + log.u[start + step] @ watch.B.T + watch.b
    return states @ watch.C.T + watch.d


def support(
    spread: Sequence[Plant], honest: Sequence[Log], noise_degC: np.ndarray, seen: Sequence[Log] = ()
) -> Support:
    """Of logs of the controller's own plants, whose sensors have noise (p,); the ranges are those of the logs
    that were `seen`, too. Raises ValueError where no log is long enough."""
    steps = horizon(spread)
    watches = [watched_by(one, steps) for one in spread]
    runs = [forecasts(watches, log, noise_degC, steps) for log in honest if len(log.u) > 4 * steps]
    if not runs:
        raise ValueError(
            f"support: expected a log of more than {4 * steps} samples to tell what an honest one is, found "
            "none; record longer"
        )
    furthest = float(np.quantile(np.concatenate([run.d for run in runs]), NEARLY_ALL))
    shares = [float((run.d > furthest).mean()) for run in runs]
    ranges = []
    for parts in ([log.y for log in (*honest, *seen)], [log.u for log in (*honest, *seen)]):
        low, high = (
            getattr(np, side)([getattr(part, side)(axis=0) for part in parts], axis=0)
            for side in ("min", "max")
        )
        ranges += [low - BEYOND * (high - low), high + BEYOND * (high - low)]
    allowed = max(float(np.quantile(shares, HONEST)), LEAST_SHARE)
    return Support(*ranges, tuple(spread), np.asarray(noise_degC, float), steps, furthest, allowed)


class Told(NamedTuple):
    """What is said of a log: by sample (T,) the sum of TEMPERATURE, COMMAND and FORECAST, and the share of
    forecasts that are off; `abstains`: a replay of it says nothing of this controller."""

    off: np.ndarray
    forecasts_off: float
    abstains: bool


def watches_of(within: Support) -> list[Watch]:
    """The observers of the plants that forecast: the same for every log."""
    return [watched_by(one, within.steps) for one in within.spread]


def told(within: Support, log: Log, watches: Sequence[Watch]) -> Told:
    """Where a log is off support, by `watches_of` it. One too short for a forecast is judged by its ranges
    alone."""
    off = np.zeros(len(log.u), np.int8)
    for low, high, values, kind in (
        (within.temperature_low, within.temperature_high, log.y, TEMPERATURE),
        (within.command_low, within.command_high, log.u, COMMAND),
    ):
        off[((values < low) | (values > high)).any(axis=1)] |= kind
    count, every = 0, max(within.steps // AT_ONCE, 1)
    missed = 0
    for first, part in _stretches(log):
        run = forecasts(watches, part, within.noise, within.steps)
        count += len(run.d)
        for start in first + run.start[run.d > within.furthest]:
            missed += 1
            off[start + within.steps - every : start + within.steps] |= FORECAST
    outside = float((off & (TEMPERATURE | COMMAND) != 0).mean()) if len(off) else 0.0
    share = missed / count if count else 0.0
    return Told(off, share, share > within.allowed or outside > LEAST_SHARE)


def _stretches(log: Log) -> list[tuple[int, Log]]:
    """The log whole, or of a long one stretches evenly apart, each with its first sample."""
    T = len(log.u)
    if T <= MOST_SAMPLES:
        return [(0, log)]
    firsts = np.linspace(0, T - STRETCH, MOST_SAMPLES // STRETCH).astype(int)
    return [(int(at), Log(*(part[at : at + STRETCH] for part in log))) for at in firsts]
