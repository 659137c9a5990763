"""How hot a family of plants gets under given inputs, open loop and around a running controller: the highest
and the lowest of every output, with what the family itself does not hold.

Open loop, an output of one member is linear in the inputs: what is left of its state, and the answer R_j to
each input alone from now on, M_j to that input's moves away from its last value. Its bounds are
y +- (g sum_j |R_j| + sum_j |M_j(t) - M_j(t - delay)| + ambient (1 - e^(-t / tau)) + band), g the doubt about
gains, which act on all heat from now on: exact in the gains, no narrower in the rest.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.temperature.identification.refinement import Predictor, estimate_state, respond, simulation_form
from pipeline.temperature.identification.subspace import Segments, gapless
from pipeline.temperature.identification.validation import one_step_errors, simulated
from pipeline.temperature.plant import Plant
from pipeline.temperature.tracking import Law

TAIL = 3000  # samples at the end of the record that the present state is taken from
LATEST = 20  # samples at its very end by which each member is set right
STORED = 6e6  # numbers of a family's responses that are held at once; beyond, every k-th sample is looked at
SURE = 0.99  # share of the record's simulation errors that the band holds
SIGMAS = 3.0  # of the sensor's noise


class Doubt(NamedTuple):
    """What a family identified from one record does not hold: input gains that are 1 +- input_gain times as
    large from now on, an ambient that moves by +- ambient_degC, inputs that act up to delay_steps later."""

    input_gain: float
    ambient_degC: float
    delay_steps: int


class Start(NamedTuple):
    """Where the record leaves the machine: its last inputs u (m,) and outputs y (p,), and state x (n,) and
    bias (p,) of each member."""

    u: np.ndarray
    y: np.ndarray
    x: list[np.ndarray]
    bias: list[np.ndarray]


class Answers(NamedTuple):
    """A family's outputs at the samples `at` (k,): `free` (members, k, p) without any input; `step`, `ramp`
    and `probe` (members, m, k, p) to one percent of each input alone, held from the start, risen along the
    ramp, or played as the probing signal. `peak` (members, p, m): the largest |probe|.
    """

    at: np.ndarray
    free: np.ndarray
    step: np.ndarray
    ramp: np.ndarray
    probe: np.ndarray
    peak: np.ndarray


class Extremes(NamedTuple):
    """Highest and lowest (p,) of every output over a family, in °C."""

    highest: np.ndarray
    lowest: np.ndarray


def start(family: Sequence[Plant], u: Segments, y: Segments) -> Start:
    """The end of a record u (T, m), y (T, p), masked samples NaN. Raises ValueError where no stretch of it
    has all inputs."""
    us, ys = gapless(u, y)
    if not us:
        raise ValueError("no stretch of the record has all inputs, so nobody knows where the machine stands")
    last_u, last_y = us[-1][-TAIL:], ys[-1][-TAIL:]
    x, bias = [], []
    for member in family:
        model, v = simulation_form(member, []), np.hstack([last_u, np.ones((len(last_u), 1))])
        states, shown = respond(model, v, estimate_state(model, v, last_y))
        x.append(model.F @ states[-1] + model.G @ v[-1])
        bias.append(_mean(last_y[-LATEST:] - shown[-LATEST:]))
    return Start(last_u[-1], _mean(last_y[-LATEST:]), x, bias)


def _mean(rows: np.ndarray) -> np.ndarray:
    """Mean (p,) of what is measured; 0 where nothing is."""
    measured = np.isfinite(rows)
    return np.where(measured, rows, 0.0).sum(axis=0) / np.maximum(measured.sum(axis=0), 1)


class Band(NamedTuple):
    """Of each output (p,) in °C: standard deviation of the sensor's noise, and what the model's simulation
    missed of the record at most, noise included."""

    noise: np.ndarray
    error: np.ndarray

    @property
    def width(self) -> np.ndarray:
        return np.maximum(self.error, SIGMAS * self.noise)


def band(model: Plant, u: Segments, y: Segments) -> Band:
    """Of the record that the model was identified from; a stretch too short for its state is passed over."""
    us, ys = gapless(u, y)
    long_enough = [k for k, a in enumerate(us) if len(a) > 3 * model.n] or [
        int(np.argmax(list(map(len, us))))
    ]
    us, ys = [us[k] for k in long_enough], [ys[k] for k in long_enough]
    errors = np.vstack([b - simulated(model, a, b) for a, b in zip(us, ys, strict=True)])
    with np.errstate(over="ignore", invalid="ignore"):
        ahead = np.nanstd(np.vstack(one_step_errors(model, us, ys)), axis=0)
    # a predictor that runs away says nothing of the noise: what simulation misses is then its upper end
    noise = np.fmin(ahead, np.nanstd(errors, axis=0))
    return Band(noise, np.nanquantile(np.abs(errors), SURE, axis=0))


# ---- open loop


def answers(
    family: Sequence[Plant], begin: Start, ramp: np.ndarray, signal: np.ndarray, *, stored: float = STORED
) -> Answers:
    """The family's answers over the experiment: ramp (T,) from 0 to 1, signal (T, m) of one percent."""
    samples, m = signal.shape
    p = family[0].p
    stride = int(np.ceil(3 * len(family) * m * p * samples / stored))
    at = np.unique(np.r_[np.arange(0, samples, stride), samples - 1])
    none = np.column_stack([np.zeros((samples, m)), np.ones(samples)])
    free, step, rise, probe, peak = [], [], [], [], []
    for member, x0, bias in zip(family, begin.x, begin.bias, strict=True):
        free.append((respond(simulation_form(member, []), none, x0)[1] + bias)[at])
        own = [_alone(member, np.ones((samples, m))), _alone(member, np.tile(ramp[:, None], (1, m)))]
        own.append(_alone(member, signal))
        peak.append(np.abs(own[2]).max(axis=1).T)
        for parts, part in zip((step, rise, probe), own, strict=True):
            parts.append(part[:, at])
    return Answers(at, *(np.stack(part) for part in (free, step, rise, probe, peak)))


def _alone(plant: Plant, signal: np.ndarray) -> np.ndarray:
    """Outputs (m, T, p) to each column of signal (T, m) alone, from zero and without offsets."""
    zero = np.zeros(plant.n)
    return np.stack(
        [
            respond(Predictor(plant.A, plant.B[:, [j]], plant.C, plant.D[:, [j]], []), signal[:, [j]], zero)[
                1
            ]
            for j in range(plant.m)
        ]
    )


def truncated(whole: Answers, samples: int) -> Answers:
    """The answers over the first `samples` samples."""
    last = int(np.searchsorted(whole.at, samples - 1, side="right"))
    step, ramp, probe = (part[:, :, :last] for part in (whole.step, whole.ramp, whole.probe))
    peak = np.abs(probe).max(axis=2).transpose(0, 2, 1)
    return Answers(whole.at[:last], whole.free[:, :last], step, ramp, probe, peak)


def ambient(doubt: Doubt, at: np.ndarray, fastest: float) -> np.ndarray:
    """How far the ambient may have moved each output at the samples `at`: (k,) in °C."""
    return doubt.ambient_degC * -np.expm1(-at / max(fastest, 1e-9))


def open_loop(
    family: Answers,
    begin: Start,
    centre: np.ndarray,
    amplitude: np.ndarray,
    *,
    doubt: Doubt,
    fastest: float,
    width: np.ndarray,
) -> Extremes:
    """Extremes under the ramp from the last inputs to `centre` (m,) and the signal of `amplitude` (m,) about
    it; `width` (p,) is the band of noise and model error."""
    moves = (centre - begin.u)[:, None, None] * family.ramp + amplitude[:, None, None] * family.probe
    of_each = begin.u[:, None, None] * family.step + moves
    moved = ambient(doubt, family.at, fastest)[:, None] + width
    return _bounds(family.free, of_each, moves, family.at, doubt, moved)


def forecast(
    family: Sequence[Plant], begin: Start, u: np.ndarray, *, doubt: Doubt, fastest: float, width: np.ndarray
) -> Extremes:
    """Extremes under the inputs u (T, m) themselves, every sample looked at."""
    at = np.arange(len(u))
    none = np.column_stack([np.zeros_like(u), np.ones(len(u))])
    moved = ambient(doubt, at, fastest)[:, None] + width
    highest, lowest = np.full(len(width), -np.inf), np.full(len(width), np.inf)
    for member, x0, bias in zip(family, begin.x, begin.bias, strict=True):
        free = respond(simulation_form(member, []), none, x0)[1] + bias
        answer, moves = _alone(member, u), _alone(member, u - begin.u)
        own = _bounds(free[None], answer[None], moves[None], at, doubt, moved)
        highest, lowest = np.maximum(highest, own.highest), np.minimum(lowest, own.lowest)
    return Extremes(highest, lowest)


def _bounds(
    free: np.ndarray, of_each: np.ndarray, moves: np.ndarray, at: np.ndarray, doubt: Doubt, moved: np.ndarray
) -> Extremes:
    """Extremes of free (members, k, p) and what each input adds, of_each (members, m, k, p), with the doubt
    about its gain, and about the delay of its moves, of the same shape; moved (k, p) is what may come from
    elsewhere."""
    reach = doubt.input_gain * np.abs(of_each).sum(axis=1) + moved
    if doubt.delay_steps:
        lags = np.maximum(doubt.delay_steps / np.maximum(np.diff(at), 1), 1.0)[:, None]
        reach[:, 1:] += lags * np.abs(np.diff(moves, axis=2)).sum(axis=1)
    middle = free + of_each.sum(axis=1)
    return Extremes((middle + reach).max(axis=(0, 1)), (middle - reach).min(axis=(0, 1)))


# ---- around a running controller


class ForecastLoop(NamedTuple):
    """A controller at work: its law, aimed at reference r (p,), and the inputs' limits low and high (m,)."""

    law: Law
    reference: np.ndarray
    low: np.ndarray
    high: np.ndarray


def closed_loop(
    family: Sequence[Plant],
    loop: ForecastLoop,
    dither: np.ndarray,
    noise: np.ndarray,
    *,
    doubt: Doubt,
    disturbance: np.ndarray,
    stop: Extremes | None = None,
) -> tuple[Extremes, float]:
    """Extremes of the true outputs while dither (T, m) is added to the commands of a controller that holds
    the reference, and the largest share of (sample, input) at a limit over the members; noise (T, p) is what
    the controller measures beside them.

    Every member runs with all gains up, all down, and each alone up and down; with the ambient as it was, or
    moved by `disturbance` (T,) up with the gains and down with them; its inputs on time, and late. It starts
    at rest, held by the law; a member that the law cannot hold there starts as near as it can. The forecast
    ends where an output leaves `stop`.
    """
    m = family[0].m
    gains = np.vstack([np.zeros((3, m)), np.ones(m), -np.ones(m), np.eye(m), -np.eye(m)])
    ambients = np.r_[0.0, 1.0, -1.0, 1.0, -1.0, np.zeros(2 * m)]
    n = max(member.n for member in family)
    plants = [
        one._replace(B=one.B * scale, D=one.D * scale)
        for one in (_padded(member, n) for member in family)
        for scale in 1 + doubt.input_gain * gains
    ]
    driven = dither, noise, np.tile(ambients, len(family)), disturbance
    runs = [_run(plants, loop, driven, late, stop) for late in sorted({0, doubt.delay_steps})]
    highest, lowest = (pick([run[k] for run in runs], axis=0) for k, pick in ((0, np.max), (1, np.min)))
    return Extremes(highest, lowest), max(run[2] for run in runs)


def _padded(plant: Plant, n: int) -> Plant:
    """The plant with n states, those added at rest and unseen."""
    more = n - plant.n
    return plant._replace(
        A=np.pad(plant.A, (0, more)),
        B=np.pad(plant.B, ((0, more), (0, 0))),
        C=np.pad(plant.C, ((0, 0), (0, more))),
        b=np.pad(plant.b, (0, more)),
        K=np.pad(plant.K, ((0, more), (0, 0))),
    )


def _run(
    plants: Sequence[Plant],
    loop: ForecastLoop,
    driven: tuple[np.ndarray, ...],
    late: int,
    stop: Extremes | None,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Highest and lowest (p,), and the largest limited share, of plants of one order, run side by side."""
    law, r = loop.law, loop.reference
    dither, noise, ambients, disturbance = driven
    A, B, C, D = (np.stack([getattr(plant, name) for plant in plants]) for name in "ABCD")
    b, d = (np.stack([getattr(plant, name) for plant in plants]) for name in "bd")
    rest = [_at_rest(plant, loop) for plant in plants]
    x, z, xi, u = (np.stack(part) for part in zip(*rest, strict=True))
    waiting = [u.copy() for _ in range(late)]
    highest, lowest = np.full(len(r), -np.inf), np.full(len(r), np.inf)
    limited = np.zeros(len(plants))
    for t in range(len(dither)):
        y = np.einsum("kpn,kn->kp", C, x) + np.einsum("kpm,km->kp", D, u) + d
        y += (disturbance[t] * ambients)[:, None]
        highest, lowest = np.maximum(highest, y.max(axis=0)), np.minimum(lowest, y.min(axis=0))
        if not np.abs(y).max() < 1e6:  # a loop that runs away has left every limit
            break
        if stop is not None and ((highest > stop.highest) | (lowest < stop.lowest)).any():
            break
        measured = y + noise[t]
        wanted = -z @ law.K.T - measured @ law.D.T - (r + xi) @ law.K_r.T - law.k + dither[t]
        applied = np.clip(wanted, loop.low, loop.high)
        limited += (applied != wanted).mean(axis=1)
        z = z @ law.A.T + applied @ law.B_u.T + measured @ law.B_y.T + r @ law.B_r.T + law.c
        # an integrator that would push a cut command further rests (conditional integration)
        moved = law.integral * (r - measured)
        further = ((-moved @ law.K_r.T) * (wanted - applied)).max(axis=1) > 0
        xi = xi + np.where(further[:, None], 0.0, moved)
        waiting.append(applied)
        u = waiting.pop(0)
        x = np.einsum("kij,kj->ki", A, x) + np.einsum("kij,kj->ki", B, u) + b
    return highest, lowest, float(limited.max() / len(dither))


def _at_rest(plant: Plant, loop: ForecastLoop) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """State, memory, integrator and input of a plant that the law holds with its outputs as near the
    reference as its integrator can bring them."""
    law, r = loop.law, loop.reference
    balance = np.eye(plant.n) - plant.A
    if np.linalg.cond(balance) > 1e13:
        balance = balance + 1e-9 * np.eye(plant.n)
    gain = plant.C @ np.linalg.solve(balance, plant.B) + plant.D
    offset = plant.C @ np.linalg.solve(balance, plant.b) + plant.d
    # the law at rest on its reference asks for u = held - K_r xi
    held = -law.k - law.D @ r - law.K_r @ r
    z = np.zeros(len(law.A))
    if len(law.A):
        z = np.linalg.solve(np.eye(len(law.A)) - law.A, law.B_u @ held + law.B_y @ r + law.B_r @ r + law.c)
        held = held - law.K @ z
    xi = np.linalg.lstsq(gain @ -law.K_r, r - offset - gain @ held, rcond=1e-9)[0]
    u = np.clip(held - law.K_r @ xi, loop.low, loop.high)
    return np.linalg.solve(balance, plant.B @ u + plant.b), z, xi, u
