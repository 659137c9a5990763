"""Finds where a recording is outside the conditions (the support) for which a controller was learned and
judged: temperatures and commands beyond those of the record, and outputs that no plant of its spread would
give.

Plants of the spread forecast the outputs a few samples ahead, each from its own observer and with the applied
inputs. f_k (p,) is how much more plant k of K forecasts than the mean of all, and e (p,) the machine's
deviation from that mean. Two questions follow.

Sample by sample: is e larger than the plants differ? S (p, p) is the covariance of the f_k, R the part that
sensor noise adds:

    d^2 = e' (S + R)^-1 e

A forecast is off if d is larger than nearly always on the controller's own plants.

For the log as a whole: the machine is one plant all the time. If it belonged to the spread, one mixture c
(K,) would explain all its deviations, with a rest as large as on honest logs:

    e = sum_k c_k f_k + rest,   c ~ N(0, I / (K - 1))

The most likely c is a ridge regression. `misfit` is the mean square of the rest, `departure` the mean square
of c, in units of the spread. Swapped sensors give a large misfit; a gain far from the spread gives a large
departure.

Every observer takes a constant disagreement for a change of surroundings (another ambient, more heat lost).
So a log in which nothing moves cannot show which sensor is which, or what a heater's percent means. It is
judged by its ranges alone.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.deploy import machine
from pipeline.deploy.replay import GaplessLog
from pipeline.deploy.supervise import Exported
from pipeline.store import artifacts
from pipeline.temperature.controllers.governor import instants, observer
from pipeline.temperature.controllers.law import ActuatorLimits, Plant
from pipeline.temperature.plant import padded
from pipeline.temperature.test_set import panel

TEMPERATURE, COMMAND, FORECAST = 1, 2, 4
BEYOND = 0.1  # of a range: signals may leave it by so much
NEARLY_ALL = 0.99  # fraction of the forecasts on honest plants within the limit
HONEST = 0.96  # fraction of honest logs that keep every limit
LEAST_SHARE = 0.05  # fraction of a log outside the ranges, above which the log is off support
LEAST_FIGURES = (0.05, 1.5, 1.0)  # least limits of figures, whatever the honest logs show
FEW, FEW_LOGS = 1.5, 30
ENOUGH = 100
STILL = 3.0  # times `rest`: if outputs, measured and computed from inputs, vary less, nothing moves
TAU, DRIFT, LEAK, UNHURRIED = 0.2, 0.06, 1e-4, 16  # of the observers, as of the governor's
AT_ONCE = 4  # forecasts that run at the same time
MOST_SAMPLES = 60_000  # longer logs are judged in stretches with this many samples in total
STRETCH = 2_000
BLOCK = 1 << 17  # samples whose states are held at once, of all plants


class Support(NamedTuple):
    """Low and high limits of temperatures (p,) in °C and of commands (m,) in percent. `spread`: the plants
    that forecast `steps` samples ahead; `noise` (p,): of the sensors in °C; `furthest`: largest allowed d;
    `rest` (p,): in °C, what honest logs leave unexplained; `allowed` (3,): limits of a log's `figures`."""

    temperature_low: np.ndarray
    temperature_high: np.ndarray
    command_low: np.ndarray
    command_high: np.ndarray
    spread: tuple[Plant, ...]
    noise: np.ndarray
    steps: int
    furthest: float
    rest: np.ndarray
    allowed: np.ndarray


class FamilyForecasts(NamedTuple):
    """Forecasts of a log: `start` (a,), the sample at which each begins; `apart` (K, a, p), how much more
    each plant forecasts than their mean; `miss` (a, p), the machine's deviation from the mean, in °C."""

    start: np.ndarray
    apart: np.ndarray
    miss: np.ndarray


def horizon(spread: Sequence[Plant]) -> int:
    """Returns the number of samples after which an input has shown its effect: the furthest instant of the
    governor, for the median plant. Further ahead, surroundings and uncertainty of the plants would hide
    errors."""
    return int(np.median([instants([one])[-1] for one in spread]))


def forecasts(observers: "Observers", log: GaplessLog, steps: int) -> FamilyForecasts:
    """Returns forecasts over `steps` samples, AT_ONCE of them running at a time. None starts in the first 2
    `steps`, while the observers find the machine's state."""
    start = np.arange(2 * steps, len(log.u) - steps, max(steps // AT_ONCE, 1))
    outputs = _forecast(observers, log, start, steps)
    mean = outputs.mean(axis=0)
    return FamilyForecasts(start, outputs - mean, log.y[start + steps] - mean)


def distances(run: FamilyForecasts, noise: np.ndarray) -> np.ndarray:
    """Returns d (a,) of every forecast, with sensor noise (p,)."""
    S = np.einsum("kai,kaj->aij", run.apart, run.apart) / (len(run.apart) - 1)
    near = S + np.diag((NOISES * noise) ** 2)
    whitened = np.linalg.solve(near, run.miss[..., None])[..., 0]
    return np.sqrt(np.einsum("ai,ai->a", run.miss, whitened))


NOISES = 2.0  # factor on the noise: that of the forecast sample, and of those from which it is forecast


def fit_mixture(run: FamilyForecasts, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the mixture c (K,) of the plants that explains all forecasts best, with each output in units of
    `rest` (p,), and the rest (a, p) in °C:

        c = (w F'F + (K - 1) I)^-1 w F'e

    The rest is similar from one forecast to the next, so a long log counts as one of ENOUGH forecasts, w =
    ENOUGH / their number. Otherwise small constant errors would look like another machine.
    """
    K = len(run.apart)
    F, weight = (run.apart / rest).reshape(K, -1), min(ENOUGH / len(run.start), 1.0)
    c = np.linalg.solve(weight * F @ F.T + (K - 1) * np.eye(K), weight * F @ (run.miss / rest).ravel())
    return c, run.miss - np.tensordot(c, run.apart, axes=1)


def figures(run: FamilyForecasts, noise: np.ndarray, furthest: float, rest: np.ndarray) -> np.ndarray:
    """Returns for a log the fraction of forecasts further off than `furthest`, its misfit, and its
    departure."""
    if not len(run.start):
        return np.zeros(3)
    c, left = fit_mixture(run, rest)
    return np.array(
        [(distances(run, noise) > furthest).mean(), ((left / rest) ** 2).mean(), (len(c) - 1) * (c**2).mean()]
    )


class Observers(NamedTuple):
    """Observers L of the states [x; w] of K plants, stacked. w (p,) in °C a step is a drift that the plant
    does not explain. It removes a constant disagreement (another ambient, more heat lost) from the forecasts,
    as the governor's does. `first` (K, n, p) finds x from the first outputs."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    b: np.ndarray
    d: np.ndarray
    L: np.ndarray
    first: np.ndarray


def design_observers(spread: Sequence[Plant], steps: int) -> Observers:
    """Returns the observers of plants of one order; they are the same for every log."""
    return Observers(
        *(np.stack(part) for part in zip(*(_design_observer(one, steps) for one in spread), strict=True))
    )


def _design_observer(plant: Plant, steps: int) -> tuple[np.ndarray, ...]:
    """Returns the governor's observer, made slower for forecasts over more `steps`."""
    slower = max(steps / UNHURRIED, 1.0)
    A, C, M = observer(plant, tau=TAU * slower**2, drift=DRIFT / slower, leak=LEAK, lags=steps)
    none = np.zeros((plant.p, plant.m))
    likely = A[: plant.n, plant.n :]
    return A, np.vstack([plant.B, none]), C, np.r_[plant.b, np.zeros(plant.p)], plant.d, A @ M, likely


def scanned(A: np.ndarray, drive: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Returns z (..., T + 1, q) with z(0) = first (..., q) and z(t+1) = A z(t) + drive(t); A (..., q, q),
    drive (..., T, q)."""
    *sides, T, q = drive.shape
    z = np.empty((*sides, T + 1, q))
    z[..., 0, :] = first
    for t in range(T):
        z[..., t + 1, :] = np.matmul(A, z[..., t, :, None])[..., 0] + drive[..., t, :]
    return z


def _forecast(observers: Observers, log: GaplessLog, start: np.ndarray, steps: int) -> np.ndarray:
    """Returns the outputs (K, a, p) that the plants forecast `steps` samples after each start (a,)."""
    K, p = observers.d.shape
    away = (log.y[0] - observers.d)[..., None]
    x = np.concatenate([np.matmul(observers.first, away)[..., 0], np.zeros((K, p))], axis=1)
    moved, states = observers.A - observers.L @ observers.C, np.empty((K, len(start), x.shape[1]))
    B, b, L = observers.B.swapaxes(1, 2), observers.b[:, None], observers.L.swapaxes(1, 2)
    for first in range(0, len(log.u), BLOCK // K):
        rows = slice(first, first + BLOCK // K)
        inside = np.flatnonzero((start >= rows.start) & (start < rows.stop))
        drive = np.matmul(log.u[rows], B) + np.matmul(log.y[rows] - observers.d[:, None], L) + b
        walked = scanned(moved, drive, x)
        states[:, inside], x = walked[:, start[inside] - first], walked[:, -1]
    for step in range(steps):
        states = np.matmul(states, observers.A.swapaxes(1, 2)) + np.matmul(log.u[start + step], B) + b
    return np.matmul(states, observers.C.swapaxes(1, 2)) + observers.d[:, None]


def support(
    spread: Sequence[Plant],
    honest: Sequence[GaplessLog],
    noise_degC: np.ndarray,
    seen: Sequence[GaplessLog] = (),
) -> Support:
    """Returns the support from logs of the controller's own plants, with sensor noise (p,), and from
    recordings of the machine that were `seen`; these are on support whatever the plants forecast. Raises
    ValueError if no log is long enough."""
    steps = horizon(spread)
    observers, noise = design_observers(spread, steps), np.asarray(noise_degC, float)
    groups = [
        [forecasts(observers, log, steps) for log in logs if len(log.u) > 4 * steps]
        for logs in (honest, [piece for log in seen for piece in _pieces(log, steps)])
    ]
    groups = [runs for runs in groups if runs]
    if not groups:
        raise ValueError(
            f"support: expected a log of more than {4 * steps} samples to tell what an honest one is, found "
            "none; record longer"
        )
    furthest = max(
        float(np.quantile(np.concatenate([distances(run, noise) for run in runs]), NEARLY_ALL))
        for runs in groups
    )
    rest = np.max([_rest(runs, noise) for runs in groups], axis=0)
    limits = [
        _seldom_above(np.array([figures(run, noise, furthest, rest) for run in runs])) for runs in groups
    ]
    ranges = []
    for parts in ([log.y for log in (*honest, *seen)], [log.u for log in (*honest, *seen)]):
        low, high = (
            getattr(np, side)([getattr(part, side)(axis=0) for part in parts], axis=0)
            for side in ("min", "max")
        )
        ranges += [low - BEYOND * (high - low), high + BEYOND * (high - low)]
    allowed = np.max([LEAST_FIGURES, *limits], axis=0)
    return Support(*ranges, tuple(spread), noise, steps, furthest, rest, allowed)


def _pieces(log: GaplessLog, steps: int) -> list[GaplessLog]:
    """Returns a recording whole, and in up to PIECES parts, each long enough to be judged alone. The limits
    of a mixture and of its rest depend on the length."""
    count = min(max(len(log.u) // (5 * steps), 1), PIECES)
    parts = [GaplessLog(*part) for part in zip(*(np.array_split(one, count) for one in log), strict=True)]
    return [log, *parts] if count > 1 else parts


PIECES = 8


def _rest(runs: Sequence[FamilyForecasts], noise: np.ndarray) -> np.ndarray:
    """Returns the standard deviation (p,) in °C of what mixtures leave of honest logs. It is at least the
    sensors' noise; with few forecasts mixtures leave less than that."""
    rest, least = NOISES * noise, noise + 1e-9
    for _ in range(3):
        left = [(fit_mixture(run, np.maximum(rest, least))[1] ** 2).mean(axis=0) for run in runs]
        rest = np.sqrt(np.mean(left, axis=0))
    return np.maximum(rest, least)


def _seldom_above(found: np.ndarray) -> np.ndarray:
    """Returns limits (k,), all at one quantile, that few new logs exceed, from the figures (n, k) of honest
    logs. With many logs, a fraction HONEST keeps all limits; with few, the limits are FEW times the largest
    figures."""
    n = len(found)
    if n < FEW_LOGS:
        return FEW * found.max(axis=0)
    ranked = np.sort(found, axis=0)
    kept = [(found <= limits).all(axis=1).mean() >= HONEST for limits in ranked]
    return ranked[int(np.argmax(kept))]


class SupportCheck(NamedTuple):
    """Result for a log. `off` (T,): by sample the sum of TEMPERATURE, COMMAND and FORECAST; `figures` (3,):
    relative to their limits, above 1 off support, 0 if the log is judged by its ranges alone; `outside`:
    fraction of samples outside the ranges; `abstains`: a replay of the log says nothing of this controller;
    `still`: so little moves that swapped or rescaled signals could not be detected; `short`: too short for a
    forecast."""

    off: np.ndarray
    figures: np.ndarray
    outside: float
    abstains: bool
    still: bool
    short: bool = False


def check_log(within: Support, log: GaplessLog, observers: Observers) -> SupportCheck:
    """Returns where a log is off support, by the observers of its plants. A log too short for a forecast is
    judged by its ranges alone."""
    off = np.zeros(len(log.u), np.int8)
    for low, high, values, kind in (
        (within.temperature_low, within.temperature_high, log.y, TEMPERATURE),
        (within.command_low, within.command_high, log.u, COMMAND),
    ):
        off[((values < low) | (values > high)).any(axis=1)] |= kind
    every, runs = max(within.steps // AT_ONCE, 1), []
    for first, part in _stretches(log):
        runs.append(forecasts(observers, part, within.steps))
        far = distances(runs[-1], within.noise) > within.furthest
        for start in first + runs[-1].start[far]:
            off[start + within.steps - every : start + within.steps] |= FORECAST
    joined = FamilyForecasts(
        *(np.concatenate(part, axis=-2 if part[0].ndim > 1 else 0) for part in zip(*runs, strict=True))
    )
    outside = float((off & (TEMPERATURE | COMMAND) != 0).mean()) if len(off) else 0.0
    if still := not any(_moves(within, part) for _, part in _stretches(log)):
        off &= ~np.int8(FORECAST)
        return SupportCheck(off, np.zeros(3), outside, outside > LEAST_SHARE, still)
    over = figures(joined, within.noise, within.furthest, within.rest) / within.allowed
    off_support = bool((over > 1).any()) or outside > LEAST_SHARE
    return SupportCheck(off, over, outside, off_support, still, not len(joined.start))


def _moves(within: Support, log: GaplessLog) -> bool:
    """Returns whether an output moved, or its inputs would have moved it on a plant of the spread."""
    plant = within.spread[0]
    drive = (log.u - log.u.mean(axis=0)) @ plant.B.T
    answer = scanned(plant.A, drive, np.zeros(plant.n)) @ plant.C.T
    return any(bool((part.std(axis=0) > STILL * within.rest).any()) for part in (log.y, answer))


def reasons(checked: SupportCheck) -> list[str]:
    """Returns why a log is off support, the strongest reason first, and what could not be determined from
    it."""
    found = [(checked.outside / LEAST_SHARE, OUTSIDE)] + list(zip(checked.figures, OF_FIGURES, strict=True))
    over = sorted((one for one in found if one[0] > 1), key=lambda one: -one[0])
    unknown = [text for so, text in ((checked.still, STILL_TOLD), (checked.short, SHORT_TOLD)) if so]
    return [sentence.format(times) for times, sentence in over] + unknown


OUTSIDE = "Temperatures or commands lie outside what was seen, {:.2g} times as often as they may."
OF_FIGURES = (
    "Forecasts miss by more than the plants of the spread differ, {:.2g} times as often as they may.",
    "What no plant of the spread explains is {:.2g} times what it may be: signals may be swapped, or the "
    "machine is another.",
    "Gains or time constants lie outside the spread, by {:.2g} times of what they may.",
)
STILL_TOLD = (
    "Next to nothing moves in the recording: swapped sensors or heaters, a wrong unit or another gain could "
    "not be told from it."
)
SHORT_TOLD = (
    "The recording is too short for a forecast: swapped sensors or heaters, a wrong unit or another gain "
    "could not be told from it."
)


def _stretches(log: GaplessLog) -> list[tuple[int, GaplessLog]]:
    """Returns the whole log, or evenly spaced stretches of a long one, each with the index of its first
    sample."""
    T = len(log.u)
    if T <= MOST_SAMPLES:
        return [(0, log)]
    firsts = np.linspace(0, T - STRETCH, MOST_SAMPLES // STRETCH).astype(int)
    return [(int(at), GaplessLog(*(part[at : at + STRETCH] for part in log))) for at in firsts]


FORECASTING, HONEST_LOGS = 24, 200  # plants, and logs at most


def forecasting_plants(
    family: Sequence[Plant], spread: panel.PlantSpread, rng: np.random.Generator
) -> list[Plant]:
    return padded(panel.drawn(family, FORECASTING, spread, cells=False, rng=rng))


def honest_logs(made: Exported, half: panel.Cases, limits: ActuatorLimits) -> list[GaplessLog]:
    """Returns logs of cases of the judging half with the controller as deployed, including the hold."""
    aims = panel.aims(made.controller.law, panel.rests(made.model, half, limits), half)
    run, held = panel.rolled_out(made.controller, half, aims), panel.held_readings(half)[:-1]
    logs = []
    for case in np.unique(np.linspace(0, len(half.plant) - 1, HONEST_LOGS).astype(int)):
        still = np.ones((half.hold, 1))
        parts = (still * half.u0[case], run.u[:, case]), (held[:, case], run.measured[:, case]), (
            still * run.r[0, case], run.r[:, case],
        )  # fmt: skip
        logs.append(GaplessLog(*(np.concatenate(part) for part in parts)))
    return logs


# ---- the file

SUPPORT = "support.safetensors"


def write_support(folder: Path, within: Support, controller_sha256: str) -> None:
    """Writes support.safetensors of a controller's folder."""
    plants = {
        f"spread.{name}": np.stack([np.asarray(getattr(one, name), float) for one in within.spread])
        for name in within.spread[0]._fields
    }
    numbers = {k: np.asarray(v, float) for k, v in within._asdict().items() if k != "spread"}
    artifacts.write_weights(
        folder / SUPPORT, "support 2", plants | numbers, {"controller": controller_sha256}
    )


def read_support(folder: Path, made: Exported) -> Support | None:
    """Returns what `write_support` wrote; None if there is none. Raises ValueError if it belongs to another
    controller."""
    if not artifacts.exists(folder / SUPPORT):
        return None
    arrays, about = artifacts.read_weights(folder / SUPPORT, "support 2")
    if about.get("controller") != machine.controller_sha256(made):
        raise ValueError(f"{folder / SUPPORT}: it is of another controller than the folder; export it again")
    names = type(made.model)._fields
    plants = tuple(
        type(made.model)(*(arrays[f"spread.{name}"][i] for name in names))
        for i in range(len(arrays["spread.A"]))
    )
    return Support(
        arrays["temperature_low"],
        arrays["temperature_high"],
        arrays["command_low"],
        arrays["command_high"],
        plants,
        arrays["noise"],
        int(arrays["steps"]),
        float(arrays["furthest"]),
        arrays["rest"],
        arrays["allowed"],
    )
