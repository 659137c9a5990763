"""Designs the next experiment: the inputs to play on a machine so that the record teaches most about gains
and time constants, while no output of any plant of the identified family leaves its limits.

centre: A linear programme over the family: the centre and the common share of the wanted amplitudes that keep
    every output within its limits at a few instants. First the largest share is found. Then, at ENOUGH of it,
    the centre whose temperatures are nearest to the references.
signal: A random binary sequence that holds for a share of the fastest time constant of its input, or
    a multisine up to a few times its corner frequency: no power where the plant does not respond.
amplitude: Scaled down until the forecast (`forecast`) over the whole experiment stays within the limits; then
    inputs that can move more without leaving them are increased, one by one. If a long experiment allows
    little, a shorter one is tried, because a machine that hardly settles drifts away with time.
teaches: Fisher information of gain and time constant of each pair with a clear effect, on first-order models.

Forecast, open loop: an output of one member is linear in the inputs. It is the sum of what remains of its
state, the response R_j to each input alone from now on, and M_j to that input's moves away from its last
value. Its bounds are

    y +- (g sum_j |R_j| + sum_j |M_j(t) - M_j(t - delay)| + ambient (1 - e^(-t / tau)) + band)

with g the uncertainty of the gains, which acts on all heat from now on. The bounds are exact in the gains,
and conservative in the other terms.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize

from pipeline.temperature.controllers.law import feasible_target
from pipeline.temperature.identification.first_order import response
from pipeline.temperature.identification.order import LARGEST_RADIUS, stabilised
from pipeline.temperature.identification.refinement import (
    Predictor,
    estimate_state,
    one_step_errors,
    respond,
    simulated,
    simulation_form,
)
from pipeline.temperature.identification.subspace import Segments, gapless
from pipeline.temperature.identification.validation import horizon, step_response, two_points
from pipeline.temperature.plant import Plant, padded, strictly_proper
from pipeline.temperature.tracking import Law, aimed, gains

TAIL = 3000  # samples at the end of the record from which the present state is estimated
LATEST = 20  # samples at its very end from which the bias of each member is computed
STORED = 6e6  # numbers of a family's responses kept at once; beyond it only every k-th sample is kept
SURE = 0.99  # share of the record's simulation errors that the band holds
SIGMAS = 3.0  # standard deviations of the sensor's noise


class Wish(NamedTuple):
    """The requested experiment: at most `samples` samples of this kind of signal, amplitudes of at most
    `amplitude_percent`, inputs that change by at most `rate_percent_per_step` and are held for at least
    `shortest_steps`. Also the uncertainty that a family identified from one record does not cover: gains 1 +-
    doubt_input_gain times as large from now on, an ambient that moves by +- doubt_ambient_degC, and inputs
    that act up to doubt_delay_steps later."""

    samples: int
    signal: Literal["multisine", "prbs"]
    amplitude_percent: float
    rate_percent_per_step: float
    shortest_steps: int
    doubt_input_gain: float
    doubt_ambient_degC: float
    doubt_delay_steps: int


class Start(NamedTuple):
    """The machine at the end of the record: its last inputs u (m,) and outputs y (p,), and state x (n,) and
    bias (p,) of each member."""

    u: np.ndarray
    y: np.ndarray
    x: list[np.ndarray]
    bias: list[np.ndarray]


class Answers(NamedTuple):
    """A family's outputs at the samples `at` (k,). `free` (members, k, p): without any input. `step`, `ramp`
    and `probe` (members, m, k, p): response to one percent of each input alone, held from the start, raised
    along the ramp, or played as the probing signal. `peak` (members, p, m): the largest |probe|."""

    at: np.ndarray
    free: np.ndarray
    step: np.ndarray
    ramp: np.ndarray
    probe: np.ndarray
    peak: np.ndarray


class Extremes(NamedTuple):
    """Highest and lowest values (p,) of every output over a family, in °C."""

    highest: np.ndarray
    lowest: np.ndarray


def start(family: Sequence[Plant], u: Segments, y: Segments) -> Start:
    """Returns the state of the machine at the end of a record u (T, m), y (T, p); masked samples are NaN.
    Raises ValueError if no stretch of the record has all inputs."""
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
    """Returns the mean (p,) of the measured values; 0 if nothing is measured."""
    measured = np.isfinite(rows)
    return np.where(measured, rows, 0.0).sum(axis=0) / np.maximum(measured.sum(axis=0), 1)


class Band(NamedTuple):
    """For each output (p,) in °C: `noise`, the standard deviation of the sensor's noise, and `error`, the
    largest simulation error of the model on the record (quantile SURE), noise included."""

    noise: np.ndarray
    error: np.ndarray

    @property
    def width(self) -> np.ndarray:
        return np.maximum(self.error, SIGMAS * self.noise)


def band(model: Plant, u: Segments, y: Segments) -> Band:
    """Computes the Band from the record of the identification. Stretches too short for the model's state are
    skipped."""
    us, ys = gapless(u, y)
    long_enough = [k for k, a in enumerate(us) if len(a) > 3 * model.n] or [
        int(np.argmax(list(map(len, us))))
    ]
    us, ys = [us[k] for k in long_enough], [ys[k] for k in long_enough]
    errors = np.vstack([b - simulated(model, a, b) for a, b in zip(us, ys, strict=True)])
    with np.errstate(over="ignore", invalid="ignore"):
        ahead = np.nanstd(np.vstack(one_step_errors(model, us, ys)), axis=0)
    # an unstable predictor does not show the noise; the simulation error is then its upper limit
    noise = np.fmin(ahead, np.nanstd(errors, axis=0))
    return Band(noise, np.nanquantile(np.abs(errors), SURE, axis=0))


# ---- open loop


def answers(
    family: Sequence[Plant], begin: Start, ramp: np.ndarray, signal: np.ndarray, *, stored: float = STORED
) -> Answers:
    """Computes the family's responses over the experiment. ramp (T,): from 0 to 1; signal (T, m): of one
    percent. `stored`: how many numbers may be kept; beyond it only every k-th sample is."""
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
    """Returns the outputs (m, T, p) for each column of signal (T, m) alone, from zero and without offsets."""
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
    """Returns the responses over the first `samples` samples."""
    last = int(np.searchsorted(whole.at, samples - 1, side="right"))
    step, ramp, probe = (part[:, :, :last] for part in (whole.step, whole.ramp, whole.probe))
    peak = np.abs(probe).max(axis=2).transpose(0, 2, 1)
    return Answers(whole.at[:last], whole.free[:, :last], step, ramp, probe, peak)


def ambient(family: "Family", at: np.ndarray) -> np.ndarray:
    """Returns how far in °C the ambient may have moved each output at the samples `at` (k,)."""
    return family.asked.doubt_ambient_degC * -np.expm1(-at / max(family.pace.fastest, 1e-9))


def open_loop(family: "Family", reach: Answers, centre: np.ndarray, amplitude: np.ndarray) -> Extremes:
    """Returns the extremes for a ramp from the last inputs to `centre` (m,) and the signal of `amplitude`
    (m,) around it."""
    begin = family.begin
    moves = (centre - begin.u)[:, None, None] * reach.ramp + amplitude[:, None, None] * reach.probe
    return _bounds(family, reach.free, begin.u[:, None, None] * reach.step + moves, moves, reach.at)


def forecast(family: "Family", u: np.ndarray) -> Extremes:
    """Returns the extremes for the inputs u (T, m) themselves, over every sample."""
    at, begin = np.arange(len(u)), family.begin
    none = np.column_stack([np.zeros_like(u), np.ones(len(u))])
    of_members = []
    for member, x0, bias in zip(family.plants, begin.x, begin.bias, strict=True):
        free = respond(simulation_form(member, []), none, x0)[1] + bias
        answer, moves = _alone(member, u), _alone(member, u - begin.u)
        of_members.append(_bounds(family, free[None], answer[None], moves[None], at))
    highest, lowest = zip(*of_members, strict=True)
    return Extremes(np.max(highest, axis=0), np.min(lowest, axis=0))


def _bounds(
    family: "Family", free: np.ndarray, of_each: np.ndarray, moves: np.ndarray, at: np.ndarray
) -> Extremes:
    """Returns the extremes of free (members, k, p) plus the response to each input, of_each (members, m, k,
    p). Includes the uncertainty of the gains (on of_each), of the delay (on moves, of the same shape) and of
    the ambient, and the band of noise and model error."""
    asked = family.asked
    moved = ambient(family, at)[:, None] + family.band.width
    reach = asked.doubt_input_gain * np.abs(of_each).sum(axis=1) + moved
    if asked.doubt_delay_steps:
        lags = np.maximum(asked.doubt_delay_steps / np.maximum(np.diff(at), 1), 1.0)[:, None]
        reach[:, 1:] += lags * np.abs(np.diff(moves, axis=2)).sum(axis=1)
    middle = free + of_each.sum(axis=1)
    return Extremes((middle + reach).max(axis=(0, 1)), (middle - reach).min(axis=(0, 1)))


# ---- around a running controller


def closed_loop(
    family: "Family",
    law: Law,
    r: np.ndarray,
    dither: np.ndarray,
    noise: np.ndarray,
    *,
    stop: Extremes | None = None,
) -> tuple[Extremes, float]:
    """Returns the extremes of the true outputs while dither (T, m) is added to the commands of a law that is
    aimed at r (p,) and holds it; and the largest share of (sample, input) at a limit over the members. noise
    (T, p): added to the outputs that the controller measures.

    Every member runs with unchanged gains and the ambient unchanged, up and down (`ambient`); with all gains
    and the ambient up, and all down; and with each gain alone up and down. Its inputs act on time, and late.
    It starts at rest, held by the law. A member that the law cannot hold there starts as near as it can. The
    forecast ends when an output leaves `stop`.
    """
    m, asked = family.model.m, family.asked
    gains = np.vstack([np.zeros((3, m)), np.ones(m), -np.ones(m), np.eye(m), -np.eye(m)])
    ambients = np.r_[0.0, 1.0, -1.0, 1.0, -1.0, np.zeros(2 * m)]
    plants = [
        one._replace(B=one.B * scale, D=one.D * scale)
        for one in padded(family.plants)
        for scale in 1 + asked.doubt_input_gain * gains
    ]
    disturbance = np.outer(ambient(family, np.arange(len(dither))), np.tile(ambients, len(family.plants)))
    held = law, r, (family.low, family.high)
    late = sorted({0, asked.doubt_delay_steps})
    runs = [_run(plants, held, (dither, noise, disturbance), steps, stop) for steps in late]
    highest, lowest, limited = zip(*runs, strict=True)
    return Extremes(np.max(highest, axis=0), np.min(lowest, axis=0)), max(limited)


def _run(
    plants: Sequence[Plant],
    held: tuple[Law, np.ndarray, tuple[np.ndarray, np.ndarray]],
    driven: tuple[np.ndarray, np.ndarray, np.ndarray],
    late: int,
    stop: Extremes | None,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Simulates plants of one order side by side. Returns the highest and lowest outputs (p,), and the
    largest limited share. held: law, reference, limits of the inputs; driven: dither, noise, and how much the
    ambient moves each plant (T, plants); late: samples by which inputs act later."""
    (law, r, (low, high)), (dither, noise, disturbance) = held, driven
    A, B, C, D = (np.stack([getattr(plant, name) for plant in plants]) for name in "ABCD")
    b, d = (np.stack([getattr(plant, name) for plant in plants]) for name in "bd")
    rest = [_at_rest(plant, law, r, low, high) for plant in plants]
    x, z, xi, u = (np.stack(part) for part in zip(*rest, strict=True))
    waiting = [u.copy() for _ in range(late)]
    highest, lowest = np.full(len(r), -np.inf), np.full(len(r), np.inf)
    limited = np.zeros(len(plants))
    for t in range(len(dither)):
        y = np.einsum("kpn,kn->kp", C, x) + np.einsum("kpm,km->kp", D, u) + d
        y += disturbance[t][:, None]
        highest, lowest = np.maximum(highest, y.max(axis=0)), np.minimum(lowest, y.min(axis=0))
        if not np.abs(y).max() < 1e6:  # an unstable loop has left every limit
            break
        if stop is not None and ((highest > stop.highest) | (lowest < stop.lowest)).any():
            break
        measured = y + noise[t]
        wanted = -z @ law.K.T - measured @ law.D.T - (r + xi) @ law.K_r.T - law.k + dither[t]
        applied = np.clip(wanted, low, high)
        limited += (applied != wanted).mean(axis=1)
        z = z @ law.A.T + applied @ law.B_u.T + measured @ law.B_y.T + r @ law.B_r.T + law.c
        # an integrator that would push a limited command further rests (conditional integration)
        moved = law.integral * (r - measured)
        further = ((-moved @ law.K_r.T) * (wanted - applied)).max(axis=1) > 0
        xi = xi + np.where(further[:, None], 0.0, moved)
        waiting.append(applied)
        u = waiting.pop(0)
        x = np.einsum("kij,kj->ki", A, x) + np.einsum("kij,kj->ki", B, u) + b
    return highest, lowest, float(limited.max() / len(dither))


def _at_rest(
    plant: Plant, law: Law, r: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns state, memory, integrator and input of a plant that the law holds, with its outputs as near the
    reference as its integrator can bring them."""
    balance = np.eye(plant.n) - plant.A
    if np.linalg.cond(balance) > 1e13:
        balance = balance + 1e-9 * np.eye(plant.n)
    gain = plant.C @ np.linalg.solve(balance, plant.B) + plant.D
    offset = plant.C @ np.linalg.solve(balance, plant.b) + plant.d
    # at rest at its reference the law commands u = held - K_r xi
    held = -law.k - law.D @ r - law.K_r @ r
    z = np.zeros(len(law.A))
    if len(law.A):
        z = np.linalg.solve(np.eye(len(law.A)) - law.A, law.B_u @ held + law.B_y @ r + law.B_r @ r + law.c)
        held = held - law.K @ z
    xi = np.linalg.lstsq(gain @ -law.K_r, r - offset - gain @ held, rcond=1e-9)[0]
    u = np.clip(held - law.K_r @ xi, low, high)
    return np.linalg.solve(balance, plant.B @ u + plant.b), z, xi, u


ENOUGH = 0.5  # of the largest safe amplitude: the rest is given up to come nearer to the references
SEEN = 0.05  # of an output's largest effect: pairs below it are ignored
HOLD = 0.5  # of the fastest time constant: the shortest hold of a binary sequence
CORNERS = 3.0  # times the corner frequency: the highest line of a multisine
LINES = 12  # least number for each input in a multisine: fewer can be predicted from their own past
SWITCHES = 20  # least number of holds in an experiment, so that inputs move independently
DRAWS = 30  # random sets of phases tried for a multisine; the flattest is taken
USEFUL = 0.3  # largest expected standard error of an input's strongest gain; beyond it nothing is learned
STEPS = 6  # halvings of each search for an amplitude
FAIR = 0.4  # of the wanted amplitudes: a shorter experiment is tried below it


class Pace(NamedTuple):
    """Time constants and delays (p, m) in samples and gains (p, m) in °C per percent, as medians over the
    family. `seen` (p, m): pairs with a clear effect; `fastest`, `slowest`: time constants of those."""

    time_constant: np.ndarray
    delay: np.ndarray
    gain: np.ndarray
    seen: np.ndarray
    fastest: float
    slowest: float


class Lesson(NamedTuple):
    """What an experiment would teach. `information`: smallest eigenvalue of the Fisher information of the
    logarithms of gain and time constant over all pairs with a clear effect. `gain_error`,
    `time_constant_error` (p, m): their expected standard errors as shares, NaN for other pairs."""

    information: float
    gain_error: np.ndarray
    time_constant_error: np.ndarray


class Experiment(NamedTuple):
    """An experiment. `u` (T, m): inputs to play; empty, with a `reason`, if no safe experiment teaches
    anything. `extremes`: of every output over the family, in °C. `target` (p,): temperatures that the model
    holds at the `centre`."""

    u: np.ndarray
    reason: str
    extremes: Extremes
    centre: np.ndarray
    amplitude: np.ndarray
    target: np.ndarray
    lesson: Lesson | None

    @property
    def written(self) -> bool:
        return not self.reason


class Dither(NamedTuple):
    """The signal u (T, m) to add to the commands of the running controller; empty, with a `reason`, if it is
    not safe. Also the extremes, the amplitude (m,), and the share of commands at a limit."""

    u: np.ndarray
    reason: str
    extremes: Extremes
    amplitude: np.ndarray
    limited: float


class Family(NamedTuple):
    """The identified plants, the model first; their pace; the state of the machine at the end of the record;
    the band of noise and model error. Then the task: `asked`, the requested experiment with the uncertainty
    that the plants do not cover; limits of inputs low and high (m,) in percent and of outputs y_low and
    y_high (p,) in °C; the references (p,); a given centre (m,) or None; the names of inputs and outputs."""

    plants: Sequence[Plant]
    pace: Pace
    begin: Start
    band: Band
    asked: Wish
    low: np.ndarray
    high: np.ndarray
    y_low: np.ndarray
    y_high: np.ndarray
    reference: np.ndarray
    centre: list[float] | None
    inputs: Sequence[str]
    outputs: Sequence[str]

    @property
    def model(self) -> Plant:
        return self.plants[0]

    def seconds(self, samples: float) -> float:
        return samples * self.model.sample_time_s


def family_of(
    plants: Sequence[Plant],
    record: tuple[Segments, Segments],
    asked: Wish,
    limits: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    reference: np.ndarray,
    *,
    centre: list[float] | None = None,
    names: tuple[Sequence[str], Sequence[str]],
) -> Family:
    """Returns the family for experiments on the machine of this record (u, y). limits: low and high of the
    inputs, then of the outputs; names: of inputs, then of outputs.

    A pole of the model outside the unit circle is moved onto it, as in the bootstrap, because no heated part
    heats itself. If the machine does run away, the model misses the record, and the band shows it. Raises
    ValueError if no stretch of the record has all inputs.
    """
    plants = [stabilised(plant, LARGEST_RADIUS) for plant in plants]
    speed = pace(plants, limits[1] - limits[0], asked.samples)
    begin, width = start(plants, *record), band(plants[0], *record)
    return Family(plants, speed, begin, width, asked, *limits, reference, centre, *names)


def pace(plants: Sequence[Plant], reach: np.ndarray, longest: int) -> Pace:
    """Returns how fast the family responds. reach (m,): range of each input; longest: samples of an
    experiment."""
    samples = horizon(plants[0], longest)
    responses = [step_response(plant, samples + 1) for plant in plants]
    tau, delay = (np.median(part, axis=0) for part in zip(*map(two_points, responses), strict=True))
    peaks = [np.take_along_axis(part, np.abs(part).argmax(axis=0)[None], axis=0)[0] for part in responses]
    gain = np.median(peaks, axis=0)
    effect = np.abs(gain) * reach
    seen = (effect > SEEN * effect.max(axis=1, keepdims=True)) & (tau > 0)
    shown = np.maximum(tau[seen], 1.0) if seen.any() else np.ones(1)
    return Pace(np.maximum(tau, 1.0), delay, gain, seen, float(shown.min()), float(shown.max()))


# ---- the signal


def signal(rng: np.random.Generator, samples: int, asked: Wish, speed: Pace) -> np.ndarray:
    """Returns a signal (samples, m) of amplitude 1 and about zero mean, with its power at the frequencies to
    which the outputs respond."""
    # the fastest time constant of each input's clear effects; the fastest of all if it has none
    tau = np.where(speed.seen, speed.time_constant, np.inf).min(axis=0)
    tau = np.where(np.isfinite(tau), tau, speed.fastest)
    if asked.signal == "prbs":
        shortest = asked.shortest_steps
        holds = np.clip(np.round(HOLD * tau), shortest, max(samples // SWITCHES, shortest))
        return np.column_stack([_binary(rng, samples, int(hold)) for hold in holds])
    return np.column_stack([_flattest(rng, samples, own) for own in _lines(samples, CORNERS / tau)])


def _binary(rng: np.random.Generator, samples: int, hold: int) -> np.ndarray:
    """Returns +-1 in holds of equal length, as many up as down, in random order."""
    count = -(-samples // hold)
    bits = rng.permutation(np.arange(count) % 2)
    return np.repeat(2.0 * bits - 1.0, hold)[:samples]


def _lines(samples: int, highest: np.ndarray) -> list[np.ndarray]:
    """Returns the frequency lines of each input, up to its highest frequency in rad a sample; at least LINES
    each. No two inputs share a line."""
    m = len(highest)
    last = np.ceil(highest * samples / (2 * np.pi))
    last = np.clip(last, min(LINES * m, (samples - 1) // 2), (samples - 1) // 2).astype(int)
    return [np.arange(1 + j, end + 1, m) for j, end in enumerate(last)]


def _flattest(rng: np.random.Generator, samples: int, lines: np.ndarray) -> np.ndarray:
    """Returns the sum of these lines in equal power, scaled to a peak of 1. Of DRAWS random sets of phases it
    takes the one with the smallest peak."""
    best, least = np.zeros(samples), np.inf
    for _ in range(DRAWS):
        spectrum = np.zeros(samples // 2 + 1, complex)
        spectrum[lines] = np.exp(2j * np.pi * rng.random(len(lines)))
        drawn = np.fft.irfft(spectrum, samples)
        peak = np.abs(drawn).max()
        if peak < least * np.abs(drawn).std():
            best, least = drawn / peak, peak / drawn.std()
    return best


def shaped(family: "Family", rng: np.random.Generator, samples: int, ramp: int) -> np.ndarray:
    """Returns the signal (samples, m) of amplitude 1 from the end of the ramp on, within the rate of the
    inputs at the requested amplitude."""
    raw, rate = signal(rng, samples, family.asked, family.pace), family.asked.rate_percent_per_step
    step = rate / max(family.asked.amplitude_percent, rate / 2)
    out, last = np.zeros_like(raw), np.zeros(raw.shape[1])
    for t in range(ramp, len(raw)):
        last = np.clip(raw[t], last - step, last + step)
        out[t] = last
    return out


# ---- centre and amplitudes


def caps(family: Family, reach: Answers) -> np.ndarray:
    """Returns the wanted amplitudes (m,): the smallest of the requested one, half of the input's range, and
    what moves an output by half of the range that its limits leave beside band and ambient. 0 if they leave
    nothing."""
    spare = family.y_high - family.y_low - 2 * (family.band.width + family.asked.doubt_ambient_degC)
    peak = reach.peak.max(axis=0) * (1 + family.asked.doubt_input_gain)
    room = np.maximum(spare, 0.0)[:, None] / 2 / np.maximum(peak, np.finfo(float).tiny)
    return np.minimum(
        np.minimum(family.asked.amplitude_percent, (family.high - family.low) / 2), room.min(axis=0)
    )


def programme(
    family: Family, reach: Answers, cap: np.ndarray, least: float | None
) -> tuple[np.ndarray, float] | None:
    """Returns the centre (m,) and the share of the wanted amplitudes by a linear programme. Returns None if
    no centre is within the limits even without a signal.

    Unknowns [centre; w >= |centre|; q >= |y - reference|; share]. Without `least` the share is maximised;
    with it the distance q from the references is minimised at a share of at least that.
    """
    m, p, begin, g = len(cap), len(family.y_low), family.begin, family.asked.doubt_input_gain
    instants = np.unique(np.linspace(0, len(reach.at) - 1, 7).round().astype(int)[1:])
    rise = reach.ramp[:, :, instants].transpose(0, 2, 3, 1).reshape(-1, m)
    from_step = (reach.step[:, :, instants] * begin.u[:, None, None]).transpose(0, 2, 3, 1).reshape(-1, m)
    at_u = reach.free[:, instants].reshape(-1) + from_step.sum(axis=1)
    swing = (1 + g) * np.repeat(reach.peak[:, None], len(instants), axis=1).reshape(-1, m) @ cap
    moved = ambient(family, reach.at[instants])[:, None] + family.band.width
    # `rise` assumes a ramp from zero; what the last inputs add to that decays
    beside = np.abs(from_step - rise * begin.u).sum(axis=1)
    slack = np.tile(moved[None], (len(reach.free), 1, 1)).reshape(-1) + g * beside
    count = len(at_u)
    high, low = (np.tile(side, count // p) for side in (family.y_high, family.y_low))
    none = np.zeros((count, p))
    # y = at_u + rise (centre - u), and its uncertainty
    upper = np.hstack([rise, g * np.abs(rise), none, swing[:, None]])
    lower = np.hstack([-rise, g * np.abs(rise), none, swing[:, None]])
    rows = [upper, lower]
    right = [high - slack - at_u + rise @ begin.u, at_u - slack - low - rise @ begin.u]
    end = slice(count // len(reach.free) - p, count // len(reach.free))  # the model's last instant
    eye, wide = np.eye(m), np.zeros((m, p))
    for sign in (1.0, -1.0):
        rows.append(np.hstack([sign * eye, -eye, wide, np.zeros((m, 1))]))
        right.append(np.zeros(m))
        rows.append(np.hstack([sign * rise[end], np.zeros((p, m)), -np.eye(p), np.zeros((p, 1))]))
        right.append(sign * (family.reference - at_u[end] + rise[end] @ begin.u))
        rows.append(np.hstack([sign * eye, 0 * eye, wide, cap[:, None]]))
        right.append(family.high if sign > 0 else -family.low)
    cost = np.r_[
        np.zeros(2 * m), np.zeros(p) if least is None else np.ones(p), -1.0 if least is None else 0.0
    ]
    bounds = [(None, None)] * m + [(0, None)] * (m + p) + [(least or 0.0, 1.0)]
    found = scipy.optimize.linprog(cost, np.vstack(rows), np.concatenate(right), bounds=bounds)
    if found.x is None:
        return None
    return np.clip(found.x[:m], family.low, family.high), float(found.x[-1])


def centres(family: Family, reach: Answers, cap: np.ndarray) -> list[np.ndarray]:
    """Returns the centres (m,) to try, in this order. If a centre is given, only that one. Otherwise that of
    the linear programme, then the inputs that hold the references by the model, then the last inputs."""
    if family.centre is not None:
        return [np.clip(family.centre, family.low, family.high)]
    held = feasible_target(family.model, family.reference, family.low, family.high).u
    fallback = [held, np.clip(family.begin.u, family.low, family.high)]
    widest = programme(family, reach, cap, None)
    if widest is None:
        return fallback
    nearest = programme(family, reach, cap, ENOUGH * widest[1])
    return [(nearest or widest)[0], *fallback]


def within(extremes: Extremes, family: Family) -> bool:
    return bool((extremes.highest <= family.y_high).all() and (extremes.lowest >= family.y_low).all())


def safe_amplitude(family: Family, reach: Answers, centre: np.ndarray, cap: np.ndarray) -> np.ndarray:
    """Returns the largest amplitudes (m,) found within the limits: first a common share of `cap`, then each
    input as far beyond that as possible. Returns 0 if even the centre alone leaves the limits."""
    room = np.minimum(cap, np.maximum(np.minimum(family.high - centre, centre - family.low), 0.0))

    def largest(amplitude, toward):
        """Returns the safe share, 0 to 1, of the way from `amplitude` to `toward`."""
        safe, beyond = 0.0, 1.0
        if within(open_loop(family, reach, centre, toward), family):
            return 1.0
        for _ in range(STEPS):
            middle = (safe + beyond) / 2
            tried = amplitude + middle * (toward - amplitude)
            allowed = within(open_loop(family, reach, centre, tried), family)
            safe, beyond = (middle, beyond) if allowed else (safe, middle)
        return safe

    amplitude = largest(0.0 * room, room) * room
    if not amplitude.any() or (amplitude == room).all():
        return amplitude
    # the weakest first: it costs the others least
    for j in np.argsort(reach.peak.max(axis=(0, 1)) * room):
        toward = amplitude.copy()
        toward[j] = room[j]
        amplitude = amplitude + largest(amplitude, toward) * (toward - amplitude)
    return amplitude


# ---- what it teaches


def lesson(u: np.ndarray, speed: Pace, noise: np.ndarray) -> Lesson:
    """Returns what inputs u (T, m) about rest would teach. With z the first-order response of one pair, dy /
    d log K = z, and dy / d log tau follows by central differences. A constant of each output is projected
    out. noise (p,) in °C."""
    information, errors = np.inf, np.full((2, *speed.seen.shape), np.nan)
    for o, pairs in enumerate(speed.seen):
        inputs = np.flatnonzero(pairs)
        if not inputs.size:
            continue
        columns = []
        for j in inputs:
            tau, late, K = speed.time_constant[o, j], speed.delay[o, j], speed.gain[o, j]
            up, down = (K * response(u[:, j], tau * scale, late, 1.0) for scale in (1.01, 0.99))
            columns += [(up + down) / 2, (up - down) / 0.02]
        J = np.column_stack(columns)
        J = (J - J.mean(axis=0)) / max(noise[o], 1e-6)
        values, vectors = np.linalg.eigh(J.T @ J)
        information = min(information, float(values[0]))
        variance = (vectors**2 / np.maximum(values, 1e-300)).sum(axis=1)
        errors[:, o, inputs] = np.sqrt(variance).reshape(-1, 2).T
    return Lesson(max(information, 0.0) if np.isfinite(information) else 0.0, errors[0], errors[1])


def expected_gap(model: Plant, taught: Lesson, gamma: float) -> float:
    """Returns the expected J / J* - 1, to second order, of linear-quadratic gains (Q = R = I) designed after
    the experiment: the sum over its expected errors of each input's gain and of the time constants, one at a
    time. The cost is that of initial states B, which unit pulses of the inputs reach."""
    plant = strictly_proper(model)
    Q, R = np.eye(plant.p), np.eye(plant.m)

    def cost(K: np.ndarray) -> float:
        closed = np.sqrt(gamma) * (plant.A - plant.B @ K)
        if np.abs(np.linalg.eigvals(closed)).max() >= 1:
            return np.inf
        P = scipy.linalg.solve_discrete_lyapunov(closed.T, plant.C.T @ Q @ plant.C + K.T @ R @ K)
        return float(np.trace(plant.B.T @ P @ plant.B))

    def designed(other: Plant) -> float:
        return cost(gains(other, Q, R, gamma).K_x)

    of_gain = np.nan_to_num(np.nanmin(np.where(np.isnan(taught.gain_error), 10.0, taught.gain_error), axis=0))
    of_gain = np.minimum(of_gain, 0.9)
    pace_errors = taught.time_constant_error[np.isfinite(taught.time_constant_error)]
    of_pace = float(np.minimum(np.median(pace_errors), 0.9)) if pace_errors.size else 0.0
    balance = np.eye(plant.n) - plant.A
    others = [
        plant._replace(B=plant.B * (1 + of_gain[j] * (np.arange(plant.m) == j))) for j in range(plant.m)
    ]
    others.append(plant._replace(A=np.eye(plant.n) - balance / (1 + of_pace), B=plant.B / (1 + of_pace)))
    best = designed(plant)
    return float(sum(designed(other) / best - 1 for other in others))


# ---- the experiment


def design(family: Family, rng: np.random.Generator) -> Experiment:
    """Tries the requested length, and shorter ones by halving, until a safe experiment moves every input by a
    fair share of its wanted amplitude. Returns the tried experiment that teaches most."""
    if reason := _nothing_left(family):
        nothing, unknown = np.zeros((0, family.model.m)), np.full(family.model.p, np.nan)
        still = np.zeros(family.model.m)
        return Experiment(nothing, reason, Extremes(unknown, unknown), still, still, unknown, None)
    samples, speed = family.asked.samples, family.pace
    rise = ramp_samples(family, samples)
    ramp = np.clip((1.0 + np.arange(samples)) / rise, 0.0, 1.0)
    played = shaped(family, rng, samples, rise)
    whole = answers(family.plants, family.begin, ramp, played)
    tries = []
    shortest = min(max(4 * rise, int(5 * speed.fastest), 50), family.asked.samples)
    while samples >= shortest:
        reach = truncated(whole, samples) if samples < family.asked.samples else whole
        tried = _designed(family, reach, (ramp[:samples], played[:samples], rise))
        tries.append(tried)
        if tried.written and (tried.amplitude >= FAIR * caps(family, reach)).all():
            break
        samples //= 2
    taught = [one.lesson.information if one.written and one.lesson is not None else 0.0 for one in tries]
    return tries[int(np.argmax(taught))]


def _nothing_left(family: Family) -> str:
    """Returns why no experiment can be forecast: the model itself misses the record by more than the limits
    are apart. Empty if it does not."""
    spare = family.y_high - family.y_low - 2 * family.band.width
    o = int(np.argmin(np.where(np.isfinite(spare), spare, -np.inf)))
    if spare[o] > 0:
        return ""
    return (
        f"the model's simulation misses the record of {family.outputs[o]} by "
        f"{min(family.band.width[o], 1e4):.3g} degC, more than its limits leave: mend the identification"
    )


def ramp_samples(family: Family, samples: int) -> int:
    """Returns the samples of the ramp: the widest range of an input within the rate, at most half of the
    experiment."""
    needed = np.ceil((family.high - family.low).max() / family.asked.rate_percent_per_step)
    return int(max(min(needed, samples / 2), 1))


def _designed(family: Family, reach: Answers, shapes: tuple[np.ndarray, np.ndarray, int]) -> Experiment:
    """Returns the experiment of one length; shapes: ramp (T,), signal (T, m), and the sample at which the
    ramp ends."""
    ramp, played, rise = shapes
    cap = caps(family, reach)
    tried = centres(family, reach, cap)
    for centre in tried:
        amplitude = safe_amplitude(family, reach, centre, cap)
        if amplitude.any():
            break
    else:
        return _left(family, reach, tried[0])
    begin = family.begin
    for _ in range(STEPS):
        u = np.clip(
            begin.u + ramp[:, None] * (centre - begin.u) + amplitude * played, family.low, family.high
        )
        extremes = forecast(family, u)
        if within(extremes, family):
            break
        amplitude = 0.9 * amplitude  # between the samples of the search it was hotter
    else:
        return _left(family, reach, centre)
    taught = lesson(u[rise:], family.pace, family.band.noise)
    target = reach.free[0, -1] + begin.u @ reach.step[0, :, -1]
    target = target + (centre - begin.u) @ reach.ramp[0, :, -1]
    reason = _teaches_little(family, amplitude, taught)
    return Experiment(u[: 0 if reason else None], reason, extremes, centre, amplitude, target, taught)


def _teaches_little(family: Family, amplitude: np.ndarray, taught: Lesson) -> str:
    """Returns why an experiment is not worth playing; empty if it is."""
    error = np.where(np.isnan(taught.gain_error), np.inf, taught.gain_error).min(axis=0)
    weak = np.flatnonzero((error > USEFUL) & family.pace.seen.any(axis=0))
    if not weak.size:
        return ""
    j = int(weak[error[weak].argmax()])
    return (
        f"{family.inputs[j]} may move by {amplitude[j]:.2g} percent within the limits, which would "
        f"leave its gain unknown by {100 * min(error[j], 10.0):.0f} % or more; widen plant.outputs low and "
        "high, or measure with less noise"
    )


def _left(family: Family, reach: Answers, centre: np.ndarray) -> Experiment:
    """Returns the refusal of an experiment whose centre alone leaves a limit, with the output that leaves it
    most."""
    still = np.zeros(family.model.m)
    extremes = open_loop(family, reach, centre, still)
    above, below = extremes.highest - family.y_high, family.y_low - extremes.lowest
    hot = above.max() >= below.max()
    o = int((above if hot else below).argmax())
    reached, limit = (extremes.highest[o], family.y_high[o]) if hot else (extremes.lowest[o], family.y_low[o])
    radius = np.abs(np.linalg.eigvals(family.model.A)).max()
    slow = -np.log(max(radius, np.finfo(float).tiny)) * reach.at[-1] < 1.0
    why = (
        "the machine hardly settles by itself, so that small errors grow"
        if slow
        else f"{family.band.width[o]:.3g} degC of it are noise and model error, "
        f"{family.asked.doubt_ambient_degC:g} ambient"
    )
    reason = (
        f"without its controller {family.outputs[o]} may {'reach' if hot else 'fall to'} "
        f"{np.clip(reached, -1e4, 1e4):.0f} degC within {family.seconds(reach.at[-1] + 1):.0f} s even with "
        f"no signal played, and its limit is {limit:g} degC: {why}"
    )
    nothing = np.zeros((0, family.model.m))
    return Experiment(nothing, reason, extremes, centre, still, extremes.highest * np.nan, None)


# ---- around the running controller


def dither(family: Family, law: Law, rng: np.random.Generator) -> Dither:
    """Returns the signal to add to the commands of a controller such as `law`, which holds the references or
    the nearest that the inputs can hold. Its amplitudes are halved until the forecast over the family stays
    within the limits."""
    m, samples = family.model.m, family.asked.samples
    rise = ramp_samples(family, samples)
    played = shaped(family, rng, samples, rise)
    target = feasible_target(family.model, family.reference, family.low, family.high)
    law = aimed(law, target.y, target.u, target.y)
    noise = family.band.noise * rng.standard_normal((samples, family.model.p))
    wanted = np.full(m, min(family.asked.amplitude_percent, *((family.high - family.low) / 2)))
    nothing, wide = np.zeros((0, m)), SIGMAS * family.band.noise
    for share in [0.5**k for k in range(STEPS)] + [0.0]:
        stop = Extremes(family.y_high - wide, family.y_low + wide) if share else None
        extremes, limited = closed_loop(family, law, target.y, share * wanted * played, noise, stop=stop)
        extremes = Extremes(extremes.highest + wide, extremes.lowest - wide)
        if share and within(extremes, family):
            return Dither(share * wanted * played, "", extremes, share * wanted, limited)
    if within(extremes, family):
        reason = f"a dither of {wanted.max() * 0.5 ** (STEPS - 1):.2g} percent already leaves the limits"
        return Dither(nothing, reason, extremes, 0.0 * wanted, limited)
    o = int(np.maximum(extremes.highest - family.y_high, family.y_low - extremes.lowest).argmax())
    low, high = (np.clip(side[o], -1e4, 1e4) for side in (extremes.lowest, extremes.highest))
    reason = (
        f"over the family the controller itself lets {family.outputs[o]} go from {low:.0f} to "
        f"{high:.0f} degC, and its limits are {family.y_low[o]:g} and {family.y_high[o]:g}"
    )
    return Dither(nothing, reason, extremes, 0.0 * wanted, limited)
