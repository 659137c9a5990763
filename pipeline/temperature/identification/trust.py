"""How far an identified plant can be trusted, as figures with bands and as columns: fits beside what they
must beat, step responses, poles, excitation."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.optimize

from pipeline.temperature.identification.drift import simulated_with_drift
from pipeline.temperature.identification.first_order import StepModels, of_step_responses, simc_pid
from pipeline.temperature.identification.subspace import Segments
from pipeline.temperature.identification.validation import (
    RecordExcitation,
    Residuals,
    banded,
    predicted_ahead,
    simulated,
    spread_bands,
    steady_gain,
    step_response,
)
from pipeline.temperature.plant import Plant

LEVEL = 0.9  # of every band here
ENDS = ((1 - LEVEL) / 2, (1 + LEVEL) / 2)


class Holdout(NamedTuple):
    """What held-out segments say of a plant, fits in percent.

    simulated, ahead: predictions (T, p) of each segment, the second NaN over its start-up; fit, ahead_fit (3,
    p): value and the ends of its 90 % band; held_fit (p,): the last value seen so many steps before, held,
    over the rows of ahead_fit. NaN where no segment outlasts the start-up. free_mean_fit (3, p): of the
    same simulation with the mean of each segment's error taken off, what another ambient alone would cost.
    Its start is the simulation's: one fitted beside a free mean lets slow modes draw any ramp.
    drift_fit (3, p): of the simulation with a drift tracked up to so many steps before, NaN without one.
    """

    simulated: list[np.ndarray]
    ahead: list[np.ndarray]
    fit: np.ndarray
    ahead_fit: np.ndarray
    held_fit: np.ndarray
    free_mean_fit: np.ndarray
    drift_fit: np.ndarray


class Steps(NamedTuple):
    """Responses to unit steps, beside their bands over a family of
    plants: response, low, high (K, p, m) at samples (K,).

    first_order: models of the plant's responses and the family's, (1 + family, p, m).
    gain, peak, time_constant, delay (3, p, m): value and the ends of its band. gain is the steady value, or
    the last one of a plant that is an integrator to the record; peak is the largest excursion at samples.
    Times are in samples, NaN where `significant` (p, m) is False: the band of the peak holds zero, so that
    not even the sign of the effect is known.
    """

    samples: np.ndarray
    response: np.ndarray
    low: np.ndarray
    high: np.ndarray
    gain: np.ndarray
    peak: np.ndarray
    time_constant: np.ndarray
    delay: np.ndarray
    significant: np.ndarray
    first_order: StepModels


class ForbiddenGain(NamedTuple):
    """A steady effect that physics forbids: of `input` on `output`, in °C per percent with its band, and why.
    `certain`: the whole band is forbidden, not the value alone."""

    output: str
    input: str
    gain: float
    low: float
    high: float
    certain: bool
    reason: str


def held(y: np.ndarray, steps: int) -> np.ndarray:
    """The last value of y (T, p) seen at or before t - steps, NaN before there is
    one: what a prediction `steps` ahead must beat."""
    last = np.maximum.accumulate(np.where(np.isfinite(y), np.arange(len(y))[:, None], -1), axis=0)
    late = np.vstack([np.full((steps, y.shape[1]), -1), last])[: len(y)]
    return np.where(late >= 0, np.take_along_axis(y, np.maximum(late, 0), axis=0), np.nan)


def fit_with_band(
    y: Segments, predicted: Segments, *, block: int, rng: np.random.Generator, draws: int = 400
) -> np.ndarray:
    """NRMSE (3, p) in percent over the samples where both are seen: value, and the ends of its 90 % band by
    resampling blocks of samples (Kuensch 1989).

    Blocks of `block` samples keep the colour of the errors; they are shortened where
    fewer than ten fit, and joined where more than 200 do.
    """
    y, predicted = np.vstack(y), np.vstack(predicted)
    mask = np.isfinite(y) & np.isfinite(predicted)
    mean = np.where(mask, y, 0.0).sum(axis=0) / np.maximum(mask.sum(axis=0), 1)
    size = max(min(block, len(y) // 10), len(y) // 200, 1)
    parts = [
        np.add.reduceat(np.where(mask, part, 0.0) ** 2, np.arange(0, len(y), size), axis=0)
        for part in (y - predicted, y - mean)
    ]
    drawn = rng.integers(0, len(parts[0]), (draws, len(parts[0])))
    error, spread = (np.vstack([part.sum(axis=0), part[drawn].sum(axis=1)]) for part in parts)
    fit = np.where(
        mask.any(axis=0), 100.0 * (1.0 - np.sqrt(error / np.maximum(spread, np.finfo(float).tiny))), np.nan
    )
    return np.vstack([fit[0], np.quantile(fit[1:], ENDS, axis=0)])


def holdout(
    plant: Plant,
    u: Segments,
    y: Segments,
    steps: int,
    *,
    block: int,
    rng: np.random.Generator,
    drift: float = 0.0,
) -> Holdout:
    """Simulation and prediction `steps` ahead of held-out segments, beside holding the last value; `block` as
    in `fit_with_band`, `drift` the rate of an identified one."""
    simulations = [simulated(plant, a, b) for a, b in zip(u, y, strict=True)]
    skip, ahead = max(3 * plant.n, 30) + steps, []  # the start-up of `predict_fit`
    for a, b in zip(u, y, strict=True):
        forecast = predicted_ahead(plant, a, b, steps) if len(a) > skip else np.full(b.shape, np.nan)
        forecast[:skip] = np.nan
        ahead.append(forecast)
    last = [
        np.where(np.isfinite(forecast), held(b, steps), np.nan) for b, forecast in zip(y, ahead, strict=True)
    ]
    free = [_mean_removed(b, a) for a, b in zip(simulations, y, strict=True)]
    drifting = [
        simulated_with_drift(plant, a, b, drift, steps) if drift else np.full(b.shape, np.nan)
        for a, b in zip(u, y, strict=True)
    ]
    fits = [
        fit_with_band(y, part, block=block, rng=rng) for part in (simulations, ahead, last, free, drifting)
    ]
    return Holdout(simulations, ahead, fits[0], fits[1], fits[2][0], *fits[3:])


def fit_of_held_inputs(plant: Plant, u: Segments, y: Segments) -> np.ndarray:
    """NRMSE (p,) in percent of the free response alone: every input held at its mean in each segment, the
    initial state fitted as in `simulated`."""
    free = [simulated(plant, np.broadcast_to(a.mean(axis=0), a.shape), b) for a, b in zip(u, y, strict=True)]
    return fit_with_band(y, free, block=1, rng=np.random.default_rng(0), draws=1)[0]


def _mean_removed(y: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """The prediction moved by the mean of its error, output by output."""
    seen = np.isfinite(y)
    error = np.where(seen, y - predicted, 0.0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    return predicted + error


def residual_lags(u: Segments) -> int:
    """As many lags as `residual_tests` can carry, at most 25."""
    return max(min(25, sum(map(len, u)) // 4), 1)


def horizon(plant: Plant, longest: int) -> int:
    """Samples until every step response stays within 5 % of its
    output's largest one, and a third more; at most `longest`.

    Of a plant with a pole outside the unit circle, three of its time constants: later there is nothing else
    to see. A mode whose time constant is longer than `longest`, the record, is an integrator to it, and is
    followed over a tenth: the record shows ten such stretches, and of one as long as itself no sign (of the
    study's plant, 16 of 35 signs at one and 1 of them wrong, 22 at the other and none).
    """
    radius = np.abs(np.linalg.eigvals(plant.A)).max()
    if not _settles(plant, longest):
        longest = max(longest // 10, 20)
    longest = min(longest, int(np.ceil(3 / np.log(radius)))) if radius > 1 + 1e-9 else longest
    r = step_response(plant, longest)
    away = (np.abs(r - r[-1]) > 0.05 * np.abs(r).max(axis=(0, 2))[:, None]).any(axis=(1, 2))
    return int(min(max(np.flatnonzero(away).max(initial=0) * 4 // 3, 20), longest))


def _settles(plant: Plant, longest: int) -> bool:
    """Whether every mode decays, or grows, by 63 % within `longest` samples: others are integrators to a
    record of that length."""
    radius = np.abs(np.linalg.eigvals(plant.A)).max()
    return bool(abs(np.log(max(radius, np.finfo(float).tiny))) * longest >= 1)


def two_points(responses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Time constant 1.5 (t63 - t28) and delay t63 - tau (p, m), in samples, of responses (T,
    p, m) (Smith 1972); t28 and t63 are when 28.3 and 63.2 % of the largest excursion are
    first reached, between samples by a straight line.
    """
    peak = np.take_along_axis(responses, np.abs(responses).argmax(axis=0)[None], axis=0)[0]
    share = responses / np.where(peak == 0, 1.0, peak)

    def reached(level):
        after = np.argmax(share >= level, axis=0)
        here, before = (
            np.take_along_axis(share, np.maximum(k, 0)[None], axis=0)[0] for k in (after, after - 1)
        )
        rise = np.where(after > 0, here - before, 1.0)
        return np.where(after > 0, after - (here - level) / np.where(rise > 0, rise, 1.0), 0.0)

    t28, t63 = reached(0.283), reached(0.632)
    tau = 1.5 * (t63 - t28)
    return tau, np.maximum(t63 - tau, 0.0)


def steps(
    nominal: Plant,
    family: Sequence[Plant],
    longest: int,
    *,
    points: int = 120,
    left_out: Sequence[Plant] = (),
) -> Steps:
    """Step responses of a plant over its `horizon`, at most `points` + 1 of each, with gain, peak, time
    constant and delay, beside the family's; `left_out` as in `spread_bands`."""
    samples = horizon(nominal, longest)
    bands = spread_bands(nominal, family, samples + 1, level=LEVEL, left_out=left_out)
    at = np.abs(bands.nominal).argmax(axis=0)[None]
    peak = np.concatenate([np.take_along_axis(part, at, axis=0) for part in bands[:3]])
    gain = np.stack([part[-1] for part in bands[:3]])
    if _settles(nominal, longest) and np.abs(np.linalg.eigvals(nominal.A)).max() < 1:
        own, *rest = (steady_gain(plant) for plant in (nominal, *family, *left_out))
        gain = np.stack([own, *banded(own, rest[: len(family)], rest[len(family) :], LEVEL)])
    significant = peak[1] * peak[2] > 0
    responses = [step_response(plant, samples + 1) for plant in (nominal, *family)]
    shapes = np.stack([two_points(part) for part in responses])  # (1 + family, 2, p, m)
    times = np.where(significant, np.concatenate([shapes[:1], np.quantile(shapes[1:], ENDS, axis=0)]), np.nan)
    grid = np.arange(0, samples + 1, -(-samples // points))
    response, low, high = (part[grid] for part in bands[:3])
    # equal ratios: what a controller meets first counts as much as what a drift does in the end
    ratios = np.unique(np.geomspace(1, samples, points).round().astype(int))
    models = of_step_responses(ratios, np.stack([part[ratios] for part in responses], axis=1))
    return Steps(grid, response, low, high, gain, peak, times[:, 0], times[:, 1], significant, models)


# no heated part outlives it: an input whose whole range moves an output by more was not identified
LARGEST_RISE_DEGC = 2000.0


def forbidden_gains(
    steps: Steps,
    outputs: Sequence[str],
    inputs: Sequence[str],
    heats: Sequence[bool],
    ranges: Sequence[float],
) -> list[ForbiddenGain]:
    """The effects of inputs that `heats` marks which are negative, or which over the input's range (percent)
    are larger than `LARGEST_RISE_DEGC`."""
    flagged = []
    for j, name in enumerate(inputs):
        for o, output in enumerate(outputs if heats[j] else ()):
            gain, low, high = (float(part) for part in steps.gain[:, o, j])
            largest = LARGEST_RISE_DEGC / ranges[j]
            if gain < 0:
                flagged.append(ForbiddenGain(output, name, gain, low, high, high < 0, "a heater that cools"))
            elif gain > largest:
                reason = f"more than {LARGEST_RISE_DEGC:g} °C over the input's range"
                flagged.append(ForbiddenGain(output, name, gain, low, high, low > largest, reason))
    return flagged


def input_levels(u: Segments, *, bands: int = 8) -> np.ndarray:
    """R.m.s. level (bands, m) of each input within equal bands from 0 to pi rad a sample, over the segments
    of at least four samples a band."""
    power, samples = np.zeros((bands, u[0].shape[1])), 0
    for a in u:
        if len(a) >= 4 * bands:
            lines = 2.0 * np.abs(np.fft.rfft(a, axis=0)[1:]) ** 2 / len(a)
            power, samples = (
                power + np.stack([part.sum(axis=0) for part in np.array_split(lines, bands)]),
                samples + len(a),
            )
    return np.sqrt(power / max(samples, 1))


# ---- as columns


def holdout_rows(
    measured: Segments, predictions: Holdout, outputs: Sequence[str], sample_time_s: float
) -> dict[str, np.ndarray]:
    """Measured, simulated and predicted outputs of the held-out segments."""
    columns = {
        "segment": np.repeat(np.arange(len(measured), dtype=np.int32), [len(y) for y in measured]),
        "time_s": np.concatenate([sample_time_s * np.arange(len(y)) for y in measured]),
    }
    for channel, name in enumerate(outputs):
        for kind, part in (
            ("measured", measured),
            ("simulated", predictions.simulated),
            ("ahead", predictions.ahead),
        ):
            columns[f"{name}_{kind}"] = np.concatenate([y[:, channel] for y in part])
    return columns


def residual_rows(tests: Residuals, outputs: Sequence[str], inputs: Sequence[str]) -> dict[str, list]:
    """Every correlation with its 99 % band: of each output's residuals
    with themselves, then with each input."""
    lags, table = tests.autocorrelation.shape[1] - 1, []
    for o, output in enumerate(outputs):
        table += [
            (output, output, k, c, tests.band, tests.whiteness_passed[o])
            for k, c in enumerate(tests.autocorrelation[o])
        ]
        for j, name in enumerate(inputs):
            mine = zip(range(-lags, lags + 1), tests.cross_correlation[o, j], strict=True)
            table += [
                (output, name, k, c, tests.cross_band[o, j], tests.independence_passed[o, j]) for k, c in mine
            ]
    return dict(
        zip(
            ("output", "against", "lag", "correlation", "band", "passed"),
            map(list, zip(*table, strict=True)),
            strict=True,
        )
    )


def step_rows(
    steps: Steps, outputs: Sequence[str], inputs: Sequence[str], sample_time_s: float
) -> dict[str, np.ndarray | list]:
    """The responses of `steps`, input by input within output by output."""
    pairs, count = [(o, j) for o in range(len(outputs)) for j in range(len(inputs))], len(steps.samples)
    columns = {
        "output": [outputs[o] for o, _ in pairs for _ in range(count)],
        "input": [inputs[j] for _, j in pairs for _ in range(count)],
        "time_s": np.tile(sample_time_s * steps.samples, len(pairs)),
    }
    return columns | {
        name: np.concatenate([getattr(steps, name)[:, o, j] for o, j in pairs])
        for name in ("response", "low", "high")
    }


def dynamics_rows(
    steps: Steps, outputs: Sequence[str], inputs: Sequence[str], sample_time_s: float
) -> dict[str, np.ndarray | list]:
    """Gain, peak, time constant and delay of `steps`, in the same order."""
    columns = {
        "output": [name for name in outputs for _ in inputs],
        "input": [*inputs] * len(outputs),
        "seen": steps.significant.ravel().tolist(),
    }
    for name, part in (
        ("gain", steps.gain),
        ("peak", steps.peak),
        ("time_constant_s", sample_time_s * steps.time_constant),
        ("delay_s", sample_time_s * steps.delay),
    ):
        columns |= {name: part[0].ravel(), f"{name}_low": part[1].ravel(), f"{name}_high": part[2].ravel()}
    return columns


def first_order_rows(
    steps: Steps, outputs: Sequence[str], inputs: Sequence[str], sample_time_s: float
) -> dict[str, np.ndarray | list]:
    """A first-order model with delay for every pair, in the order of `step_rows`, with bands over the family,
    and the PID that SIMC makes of it; missing where not even the sign of its gain is known."""
    models, columns = steps.first_order, {"output": [o for o in outputs for _ in inputs]}
    columns |= {"input": [*inputs] * len(outputs)}
    banded = [
        np.concatenate([part[:1], np.quantile(part[1:], ENDS, axis=0)]).reshape(3, -1)
        for part in (models.gain, sample_time_s * models.time_constant, sample_time_s * models.delay)
    ]
    seen = (banded[0][1] * banded[0][2] > 0) & (banded[0][0] * banded[0][1] > 0) & steps.significant.ravel()
    columns["seen"] = seen.tolist()
    for name, part in zip(("gain", "time_constant_s", "delay_s"), banded, strict=True):
        shown = part if name == "gain" else np.where(seen, part, np.nan)
        columns |= {name: shown[0], f"{name}_low": shown[1], f"{name}_high": shown[2]}
    columns["fit_percent"] = np.where(seen, models.fit_percent[0].ravel(), np.nan)
    pids = [
        simc_pid(gain, tau, delay, sample_time_s=sample_time_s) if known else (np.nan,) * 3
        for known, gain, tau, delay in zip(seen, *(part[0] for part in banded), strict=True)
    ]
    return columns | dict(zip(("Kp", "Ki", "Kd"), np.array(pids, float).T, strict=True))


def pole_rows(nominal: Plant, family: Sequence[Plant]) -> dict[str, np.ndarray]:
    """Poles of the plant (member 0), largest first, and of a family; `pole` is the number of the plant's pole
    that each belongs to, -1 for one too many.

    Poles belong together where the sum of their distances is least (Kuhn 1955).
    """
    mine = np.linalg.eigvals(nominal.A)
    mine = mine[np.lexsort((-mine.imag, -np.abs(mine).round(12)))]
    table = [(0, k, pole.real, pole.imag) for k, pole in enumerate(mine)]
    for i, plant in enumerate(family, 1):
        poles = np.linalg.eigvals(plant.A)
        of_mine, of_theirs = scipy.optimize.linear_sum_assignment(np.abs(mine[:, None] - poles))
        number = np.full(len(poles), -1)
        number[of_theirs] = of_mine
        table += [(i, int(k), pole.real, pole.imag) for k, pole in zip(number, poles, strict=True)]
    member, pole, real, imag = zip(*table, strict=True)
    return {
        "member": np.array(member, np.int32),
        "pole": np.array(pole, np.int32),
        "real": np.array(real),
        "imag": np.array(imag),
    }


def level_rows(levels: np.ndarray, inputs: Sequence[str]) -> dict[str, np.ndarray | list]:
    """The levels of `input_levels`, band by band within input by input."""
    edges = np.linspace(0, np.pi, len(levels) + 1)
    return {
        "input": [name for name in inputs for _ in levels],
        "low_rad": np.tile(edges[:-1], len(inputs)),
        "high_rad": np.tile(edges[1:], len(inputs)),
        "level": levels.T.ravel(),
    }


# ---- as figures by name; None where there is none


def fit_figures(judged: Holdout, outputs: Sequence[str]) -> dict[str, dict | None]:
    """Fits on the hold-out by output, with their bands and what they must beat; those
    ahead are None where no segment was long enough, that of a drift where there is none."""
    named = {
        "fit_holdout": judged.fit,
        "fit_holdout_free_mean": judged.free_mean_fit,
        "fit_holdout_drift": judged.drift_fit,
        "fit_holdout_ahead": judged.ahead_fit,
    }
    figures = {key: dict(zip(outputs, part[0].tolist(), strict=True)) for key, part in named.items()}
    figures |= {
        f"{key}_band": dict(zip(outputs, part[1:].T.tolist(), strict=True)) for key, part in named.items()
    }
    figures["fit_holdout_held"] = dict(zip(outputs, judged.held_fit.tolist(), strict=True))
    return {key: part if np.isfinite(list(part.values())).all() else None for key, part in figures.items()}


def outcome_figures(
    tests: Residuals, excited: RecordExcitation, outputs: Sequence[str], inputs: Sequence[str]
) -> dict[str, dict]:
    """Which tests passed, and how far the inputs excite."""
    lags = excited.full // len(inputs)
    alone = {
        name: {"rank": int(rank), "level": float(level)}
        for name, rank, level in zip(inputs, excited.per_input_rank, excited.levels, strict=True)
    }
    return {
        "whiteness_passed": dict(zip(outputs, tests.whiteness_passed.tolist(), strict=True)),
        "independence_passed": {
            name: dict(zip(inputs, row, strict=True))
            for name, row in zip(outputs, tests.independence_passed.tolist(), strict=True)
        },
        "excitation": {
            "rank": excited.rank,
            "full": excited.full,
            "condition": excited.condition if np.isfinite(excited.condition) else None,
            "lags": lags,
            "inputs": alone,
        },
    }
