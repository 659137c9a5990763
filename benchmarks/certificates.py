"""Does the certificate's gate hold back what would not work, and let through what would? And do its bands of
learned gains hold the gains?

`./run python -m benchmarks.certificates` prints both tables and writes benchmarks/results/certificates.json;
`gate` or `bands` behind it plays one of them; `--seed` of the gate, `--count` of its bad and of its good
controllers, `--jobs`.

gate: 300 bad controllers and 300 good ones, each with the record that it was made from and a newest record
through its own wires. Bad: unstable on its own true plant, or settled error over twice the limit there.
Good: every rule that can be asked of a true plant holds there with 20 % to spare, margins too. True plants
are written apart from `Plant`: zones of heat in watts, some with radiation, dead time, a sensor that lags and
coarse steps, and the study's machine redrawn. Only the draw knows which cause a controller has; a cause whose
controller works is no bad one and is drawn again.

unseen: bad controllers whose inputs are in another scale in all that was ever recorded, the newest record
too, which then came by other wires. No test of that record can tell them; how many pass is said.

bands: 200 fresh records of one machine; how often the band of each entry holds the gain that the same
regression finds in a record of 300,000 samples.
"""

import argparse
import json
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import joblib
import numpy as np

from pipeline.runtime import bands, certificate, certify
from pipeline.runtime.machine import Exported, Machine, Signal, plants_sha256
from pipeline.store import artifacts
from pipeline.temperature import (
    baseline,
    controller,
    identification,
    kernel,
    panel,
    scorecard,
    tracking,
    window,
)
from pipeline.temperature.governor import Governor, Limits, OutputLimits, governor
from pipeline.temperature.plant import Plant, hold_output, simulate, strictly_proper
from pipeline.temperature.plant import plant as make_plant

RESULTS = Path(__file__).parent / "results" / "certificates.json"
COUNT, SEED = 300, 53  # nothing was tuned on the cases of this seed
SAMPLED, COMPARED = 200, 20  # plants a certificate here; of so many cases one has all 1,000 beside them
CAUSES = (
    "few_samples",
    "noise",
    "wrong_unit",
    "swapped_sensor",
    "constant_reference",
    "stale_plant",
    "wrong_sample_time",
)
SETTLED_ERROR, CROSSING, DISK, DELAY_S, GAMMA = 0.5, 2.0, 0.4, 1.0, 0.99
SPARE, LATE = 0.8, 1.2
KELVIN = 273.15


# ---- true plants, apart from Plant


class Truth(NamedTuple):
    """Zones of heat: capacity (n,) J/K, loss (n,) W/K to the room, radiates (n,) W/K^4, between (n, n) W/K,
    power (n, m) W per percent; sensors see `sees` (p, n) of the masses, late by lag (p,) samples and `dead`
    samples, in steps of `step` °C, with `noise` °C. Every sample lasts `every` s."""

    capacity: np.ndarray
    loss: np.ndarray
    radiates: np.ndarray
    between: np.ndarray
    power: np.ndarray
    sees: np.ndarray
    lag: np.ndarray
    dead: int
    step: float
    noise: float
    room: float
    every: float
    kind: str

    @property
    def n(self) -> int:
        return len(self.capacity)

    @property
    def m(self) -> int:
        return self.power.shape[1]

    @property
    def p(self) -> int:
        return len(self.sees)


def drawn_truth(rng: np.random.Generator, kind: str) -> Truth:
    if kind == "study":
        return _study(rng)
    n = 1 if kind == "hot_end" and rng.uniform() < 0.6 else int(rng.integers(1, 4))
    capacity = rng.uniform(8.0, 30.0, n)
    tau = rng.uniform(25.0, 90.0, n)
    loss = capacity / tau
    rise = rng.uniform(150.0, 400.0, n)  # °C at full duty
    power = np.diag(loss * rise / 100.0)
    between = np.zeros((n, n))
    for i in range(n - 1):
        between[i, i + 1] = between[i + 1, i] = rng.uniform(0.05, 0.3) * min(loss[i], loss[i + 1])
    radiates = np.zeros(n)
    if kind == "hot_end":
        share = rng.uniform(0.2, 0.5)  # of the loss at 200 °C that is radiated
        radiates = share * loss * 180.0 / ((200 + KELVIN) ** 4 - (20 + KELVIN) ** 4)
        loss = (1 - share) * loss
    lag = rng.uniform(1.0, 6.0, n) if kind == "hot_end" or rng.uniform() < 0.5 else np.full(n, 0.2)
    step = float(rng.choice([0.02, 0.1, 0.25])) if kind == "hot_end" else 0.0
    return Truth(
        capacity,
        loss,
        radiates,
        between,
        power,
        np.eye(n),
        lag,
        int(rng.integers(0, 4)),
        step,
        float(rng.uniform(0.03, 0.15)),
        float(rng.uniform(18.0, 30.0)),
        1.0,
        kind,
    )


def _study(rng: np.random.Generator) -> Truth:
    """Six cells in a row and a screw whose motor warms some and cools others, five sensors that see more
    than one cell: the shape of the study's machine, its numbers drawn anew."""
    n, m = 6, 7
    capacity = rng.uniform(60.0, 120.0, n)
    loss = capacity / rng.uniform(120.0, 400.0, n)
    between = np.zeros((n, n))
    for i in range(n - 1):
        between[i, i + 1] = between[i + 1, i] = rng.uniform(0.1, 0.4) * loss[i]
    power = np.zeros((n, m))
    power[:, :n] = np.diag(capacity * rng.uniform(0.02, 0.05, n))
    power[:, n] = capacity * rng.uniform(-0.004, 0.004, n)
    sees = np.zeros((5, n))
    sees[:, :5] = np.eye(5)
    sees[3, 5], sees[3, 3] = 0.4, 0.6
    sees[4, 5], sees[4, 4] = 0.25, 0.75
    noise, room = float(rng.uniform(0.05, 0.12)), float(rng.uniform(18.0, 28.0))
    return Truth(
        capacity, loss, np.zeros(n), between, power, sees, np.full(5, 0.2), 0, 0.0, noise, room, 1.0, "study"
    )


class Running:
    """A true plant on its way: masses, sensors and what is on its way to the heaters."""

    def __init__(self, truth: Truth, mass: np.ndarray, u: np.ndarray):
        self.truth, self.mass = truth, mass.copy()
        self.sensor = truth.sees @ mass
        self.way = [u.copy() for _ in range(truth.dead)]
        self.substeps = int(np.ceil(truth.every / 0.5))

    def advance(self, u: np.ndarray) -> None:
        truth = self.truth
        self.way.append(u)
        heat_in = truth.power @ self.way.pop(0)
        dt = truth.every / self.substeps
        for _ in range(self.substeps):
            heat = heat_in - truth.loss * (self.mass - truth.room)
            heat = heat + truth.between @ self.mass - truth.between.sum(axis=1) * self.mass
            if truth.radiates.any():
                heat = heat - truth.radiates * ((self.mass + KELVIN) ** 4 - (truth.room + KELVIN) ** 4)
            self.mass = self.mass + dt * heat / truth.capacity
            self.sensor += (truth.sees @ self.mass - self.sensor) * (1 - np.exp(-dt / truth.lag))

    def measured(self, rng: np.random.Generator) -> np.ndarray:
        y = self.sensor + self.truth.noise * rng.standard_normal(self.truth.p)
        step = self.truth.step
        return np.round(y / step) * step if step else y

    def flat(self) -> np.ndarray:
        return np.concatenate([self.mass, self.sensor, *self.way])

    def at(self, x: np.ndarray) -> "Running":
        truth = self.truth
        other = Running(truth, x[: truth.n], np.zeros(truth.m))
        other.sensor = x[truth.n : truth.n + truth.p].copy()
        other.way = list(x[truth.n + truth.p :].reshape(truth.dead, truth.m).copy())
        return other


def held(truth: Truth, y: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Masses and inputs (m,) that hold sensors at y (p,); None where inputs would leave 2 to 90 %."""
    mass = np.linalg.lstsq(truth.sees, y, rcond=None)[0]
    heat = truth.loss * (mass - truth.room) - truth.between @ mass + truth.between.sum(axis=1) * mass
    heat = heat + truth.radiates * ((mass + KELVIN) ** 4 - (truth.room + KELVIN) ** 4)
    u = np.linalg.lstsq(truth.power, heat, rcond=None)[0]
    return (mass, u) if u.min() > 2.0 and u.max() < 90.0 else None


def linearised(truth: Truth, y: np.ndarray) -> Plant | None:
    """The true plant about sensors at y (p,), by differences."""
    at = held(truth, y)
    if at is None:
        return None
    here = Running(truth, *at)
    x0 = here.flat()

    def after(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        other = here.at(x)
        other.advance(u)
        return other.flat()

    base, size = after(x0, at[1]), 1e-4
    A = np.column_stack([(after(x0 + size * e, at[1]) - base) / size for e in np.eye(len(x0))])
    B = np.column_stack([(after(x0, at[1] + size * e) - base) / size for e in np.eye(truth.m)])
    C = np.zeros((truth.p, len(x0)))
    C[:, truth.n : truth.n + truth.p] = np.eye(truth.p)
    b = base - A @ x0 - B @ at[1]
    return make_plant(A, B, C, b=b, sample_time_s=truth.every)


# ---- records


class Draw(NamedTuple):
    """What a controller was made from and what it meets."""

    truth: Truth
    learned: tuple[np.ndarray, np.ndarray]
    newest: tuple[np.ndarray, np.ndarray]
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    recorded_every: float
    operating: np.ndarray
    span: float
    cold: np.ndarray


def probed(
    truth: Truth, operating: np.ndarray, samples: int, swing: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """u (T, m), y (T, p): each input between two levels about what holds the operating point, on holds of its
    own drawn length."""
    at = held(truth, operating)
    assert at is not None
    run, (T, m) = Running(truth, *at), (samples, truth.m)
    u, y = np.empty((T, m)), np.empty((T, truth.p))
    for j in range(m):
        t = 0
        while t < T:
            hold = int(rng.integers(4, 40))
            u[t : t + hold, j] = at[1][j] + swing * rng.uniform(-1, 1)
            t += hold
    u = np.clip(u, 0.0, 100.0)
    for t in range(T):
        y[t] = run.measured(rng)
        run.advance(u[t])
    return u, y


def held_by_pi(
    truth: Truth, operating: np.ndarray, samples: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """A record of a PI controller that holds one reference: its inputs answer noise, and nothing else."""
    at = held(truth, operating)
    assert at is not None
    run = Running(truth, *at)
    pair = np.linalg.pinv(truth.sees @ truth.power)
    gain = 0.15 * pair / np.abs(pair).max() * float(rng.uniform(1.0, 6.0))
    sums = np.zeros(truth.p)
    u, y = np.empty((samples, truth.m)), np.empty((samples, truth.p))
    for t in range(samples):
        y[t] = run.measured(rng)
        error = operating - y[t]
        sums = sums + error / 80.0
        u[t] = np.clip(at[1] + gain @ (error + sums), 0.0, 100.0)
        run.advance(u[t])
    return u, y


def drawn_case(rng: np.random.Generator, cause: str) -> Draw | None:
    """A machine with the record that a controller is to be made from; `cause` "" for an honest one."""
    kind = str(rng.choice(["zones", "hot_end", "study"], p=[0.5, 0.42, 0.08]))
    truth = drawn_truth(rng, kind)
    if cause == "swapped_sensor" and truth.p < 2:
        return None
    base = 160.0 if kind == "study" else float(rng.uniform(120.0, 220.0))
    operating = base + rng.uniform(-10.0, 10.0, truth.p)
    if held(truth, operating) is None:
        return None
    swing, samples, newest = float(rng.uniform(4.0, 9.0)), int(rng.integers(1200, 2400)), 500
    if kind == "study":
        samples, newest = samples + 1200, 900
    older = truth
    if cause == "few_samples":
        samples, newest, swing = int(rng.integers(30, 130)), int(rng.integers(30, 130)), 0.4 * swing
    if cause == "noise":
        truth = older = truth._replace(noise=float(rng.uniform(1.0, 8.0)))
        swing = 0.4 * swing
    if cause == "stale_plant":
        older = _changed(truth, rng)
        if held(older, operating) is None:
            return None
    fast = older
    if cause == "constant_reference":
        learned = held_by_pi(truth, operating, samples, rng)
        now = held_by_pi(truth, operating, newest, rng) if rng.uniform() < 0.5 else None
        if now is None:
            now = probed(truth, operating, newest, swing, rng)
    else:
        times = int(rng.choice([2, 3, 5])) if cause == "wrong_sample_time" else 1
        learned = probed(older, operating, samples, swing, rng)
        if times > 1:
            learned = learned[0][::times], learned[1][::times]
            if rng.uniform() < 0.4:  # or sampled too fast
                fast = older._replace(every=older.every / times, dead=older.dead * times)
                learned = probed(fast, operating, samples, swing, rng)
        today = truth._replace(room=truth.room + rng.uniform(-3, 3))
        if held(today, operating) is None:
            return None
        now = probed(today, operating, newest, swing, rng)
    inputs = tuple(Signal(f"heater_{j + 1}", "percent", 0.0, 100.0) for j in range(truth.m))
    outputs = tuple(Signal(f"zone_{j + 1}", "degC", 0.0, float(operating[j]) + 40.0) for j in range(truth.p))
    span = float(np.ptp(learned[1], axis=0).min())
    if cause == "swapped_sensor":
        order = np.roll(np.arange(truth.p), 1)
        learned = learned[0], learned[1][:, order]
    cold = truth.room + truth.noise * rng.standard_normal(truth.p)
    if cause in ("wrong_unit", "unseen_unit"):
        learned, now, cold = _other_unit(learned, now, cold, rng, unseen=cause == "unseen_unit")
    return Draw(truth, learned, now, inputs, outputs, truth.every, operating, span, cold)


def _changed(truth: Truth, rng: np.random.Generator) -> Truth:
    """The machine before somebody changed it: a heater of other power, more loss, a longer way."""
    which = rng.integers(0, 4)
    if which == 0:
        factor = np.exp(rng.uniform(np.log(0.15), np.log(0.6), truth.m))
        return truth._replace(power=truth.power * factor)
    if which == 1:
        return truth._replace(dead=max(truth.dead - int(rng.integers(2, 7)), 0), power=0.5 * truth.power)
    if which == 2:
        return truth._replace(loss=truth.loss * rng.uniform(0.2, 0.6), power=truth.power * 0.4)
    return truth._replace(power=truth.power[:, np.roll(np.arange(truth.m), 1)])


def _other_unit(learned, now, cold: np.ndarray, rng: np.random.Generator, *, unseen: bool):
    """Inputs as shares, of 255 or in tenths of a percent; temperatures in °F, K or tenths: in the learned
    record, and in half of the cases in all that was ever read. `unseen`: inputs in another scale in all that
    was ever recorded, which nothing can tell but a newest record by the controller's own wires."""
    scales = ((0.01, 1.0, 0.0), (2.55, 1.0, 0.0), (0.1, 1.0, 0.0))
    scales += ((1.0, 1.8, 32.0), (1.0, 1.0, KELVIN), (1.0, 0.1, 0.0))
    which = int(rng.integers(1, 3) if unseen else rng.integers(0, 6))
    of_u, of_y, offset = scales[which]
    everywhere = unseen or (rng.uniform() < 0.5 and which not in (1, 2))

    def told(record):
        return of_u * record[0], of_y * record[1] + offset

    if everywhere:
        return told(learned), told(now), of_y * cold + offset
    return told(learned), now, cold


# ---- controllers


def designed(case: Draw, rng: np.random.Generator) -> tuple[Exported, list[Plant]] | None:
    """A controller by one of the routes, and the spread of its plant; None where its own method refuses."""
    u, y = case.learned
    m, p = u.shape[1], y.shape[1]
    route = str(rng.choice(["pi", "lqg", "varx", "kernel"], p=[0.15, 0.3, 0.3, 0.25]))
    limits = Limits(np.zeros(m), np.full(m, 100.0), np.full(m, np.inf))
    effort = float(np.exp(rng.uniform(np.log(0.02), np.log(3.0))))
    integral = float(np.exp(rng.uniform(np.log(0.04), np.log(0.15))))
    longest = 6 if m > 3 else 12
    every = case.recorded_every
    try:
        learned = window.learn([u], [y], longest=longest, offset=True, gain_spread=0.05)
        q, r = np.ones(p), np.full(m, effort)
        if route in ("pi", "lqg"):
            found = identification.identify(
                [u],
                [y],
                sample_time_s=every,
                settings=identification.Settings(order=min(2 * p + 2, 8), past=longest, feedthrough=False),
            )
            model = strictly_proper(found.plant)
        else:
            model = window.observer_form(learned, every)[0]
        if route == "pi":
            made = baseline.controller(model, (limits.low, limits.high), horizon=300)
            law = made.design(q, r, integral)
        elif route == "lqg":
            law = tracking.model_based(model, GAMMA, tau=1.0).design(q, r, integral)
        elif route == "varx":
            law = controller.compact(window.controller(learned, GAMMA).design(q, r, integral), learned.N)
        else:
            H = kernel.regress(window.predicted_tuples(learned, [u], [y], offset=True))
            law = controller.compact(kernel.controller(H, GAMMA, model).design(q, r, integral), H.N)
        guard = _guard(model, limits, case) if rng.uniform() < 0.25 and m <= 3 else None
        made = controller.deployed(law, limits, integral_limit=2.0, governor=guard)
    except (ValueError, np.linalg.LinAlgError):
        return None
    family = _family(learned, u, y, every, rng)
    machine = Machine(case.inputs, case.outputs, every)
    return (
        Exported(
            route, machine, made, model, None, None, False, plants_sha256([model]), plants_sha256(family)
        ),
        family,
    )


def _guard(model: Plant, limits: Limits, case: Draw) -> Governor:
    spread = panel.Spread(0.15, 0.2, 0.0, 0.5, 5.0)
    family, strength = panel.corners([model], spread)
    low, high = np.array([(one.low, one.high) for one in case.outputs]).T
    return governor(family, limits, OutputLimits(low, high, np.full(len(low), 0.3), 0.5), strength)


def _family(learned, u, y, every: float, rng: np.random.Generator) -> list[Plant]:
    data = bands.rows([u], [y], learned.N)
    of = bands.moments(data, 2 * learned.N)
    found = bands.predictors(of, bands.drawn(of, 6, rng), data)
    return [window.observer_form(found.window(k), every)[0] for k in range(6)]


# ---- what it does on its true plant


class Outcome(NamedTuple):
    settled_error: float
    crossing: float
    disk: float
    delay_s: float
    radius: float

    @property
    def bad(self) -> bool:
        return self.radius >= 1.0 or self.settled_error > 2 * SETTLED_ERROR

    @property
    def good(self) -> bool:
        return (
            self.radius < 1.0
            and self.settled_error <= SPARE * SETTLED_ERROR
            and self.crossing <= SPARE * CROSSING
            and self.disk >= LATE * DISK
            and self.delay_s >= LATE * DELAY_S
        )


def asked(case: Draw) -> certificate.Rules:
    step = min(8.0, 0.35 * case.span)
    start = case.operating - step
    return certificate.Rules(
        references=np.stack([case.operating, case.operating - step / 2]),
        start=start,
        steps=320,
        settled=50,
        settled_error_degC=SETTLED_ERROR,
        crossing_degC=CROSSING,
        disk_margin=DISK,
        delay_margin_s=DELAY_S,
        longest_window=6 if len(case.inputs) > 3 else 12,
        poles_of=12,
        plants=SAMPLED,
        resamples=200,
    )


def outcome(exported: Exported, case: Draw, rules: certificate.Rules, rng: np.random.Generator) -> Outcome:
    """The controller on its true plant, as deployed, and the margins of the plant about its references."""
    at = held(case.truth, rules.start)
    local = linearised(case.truth, case.operating)
    if at is None or local is None:
        return Outcome(0.0, np.inf, 0.0, 0.0, 0.0)
    low = scorecard.margins([local], exported.controller.law, grid=60)[0]
    run, runs = Running(case.truth, *at), controller.RunningController(exported.controller, exported.model)
    for _ in range(3):
        runs.watch(at[1], run.measured(rng), rules.start)
        run.advance(at[1])
    runs.hand_over(run.measured(rng))
    highest, worst, t = np.full(case.truth.p, -np.inf), 0.0, 0
    limit = np.array([one.high for one in case.outputs])
    for r in rules.references:
        late = np.zeros(case.truth.p)
        for k in range(rules.steps):
            run.advance(runs.step(run.measured(rng), r, t))
            t += 1
            highest = np.maximum(highest, run.sensor)
            if k >= rules.steps - rules.settled:
                late += (run.sensor - r) / rules.settled
        worst = max(worst, float(np.abs(late).max()))
    crossing = float(np.maximum(highest - limit, 0.0).max())
    return Outcome(worst, crossing, low.disk, low.delay_s, low.radius)


class Judged(NamedTuple):
    cause: str
    kind: str
    route: str
    verdict: str
    first_failed: str
    outcome: Outcome
    seconds: float
    tried: int
    found: dict[str, float | None]
    verdict_of_1000: str | None


def judged(cause: str, seed: int) -> Judged:
    """The first controller of this cause from this seed on that really is bad (good where there is no cause),
    and its certificate's verdict."""
    tried = 0
    while True:
        rng = np.random.default_rng([seed, tried])
        tried += 1
        case = drawn_case(rng, cause)
        if case is None:
            continue
        rules = asked(case)
        with np.errstate(all="ignore"):  # what diverges is a finding
            made = designed(case, rng)
            real = made and outcome(made[0], case, rules, rng)
        if made is None or real is None:
            continue
        exported, family = made
        if not (real.bad if cause else real.good):
            if tried > 400:
                raise ValueError(f"{cause}: no such controller in {tried} draws")
            continue
        found, seconds = certified(exported, family, case, rules)
        all_of_them = None
        if seed % COMPARED == 0:
            all_of_them = certified(exported, family, case, rules._replace(plants=1000))[0].verdict
        return Judged(
            cause,
            case.truth.kind,
            exported.name,
            found.verdict,
            found.first_failed or "",
            real,
            seconds,
            tried,
            {one.name: one.found for one in found.rules if one.asked},
            all_of_them,
        )


def certified(exported: Exported, family, case: Draw, rules) -> tuple[certificate.Certificate, float]:
    (u, y), (nu, ny) = case.learned, case.newest
    record = certificate.Record(
        case.inputs, case.outputs, case.recorded_every, [u], [y], [nu], [ny], case.cold
    )
    started = time.process_time()
    found = certify.certify(exported, family, record, rules, np.random.default_rng(1))
    return found, time.process_time() - started


def listed(count: int, seed: int) -> list[tuple[str, int]]:
    """Cause and seed of every case: bad ones, good ones, unseen ones."""
    causes = [CAUSES[k % len(CAUSES)] for k in range(count)] + [""] * count
    causes += ["unseen_unit"] * max(count // 15, 2)
    return [(cause, seed * 100_000 + k) for k, cause in enumerate(causes)]


def gate(count: int = COUNT, *, seed: int = SEED, jobs: int = 2) -> dict:
    calls = [joblib.delayed(judged)(*one) for one in listed(count, seed)]
    return summarised(joblib.Parallel(n_jobs=jobs, verbose=1)(calls), seed)


def summarised(results: Sequence[Judged], seed: int) -> dict:
    unseen = [one for one in results if one.cause == "unseen_unit"]
    results = [one for one in results if one.cause != "unseen_unit"]
    bad, good = [one for one in results if one.cause], [one for one in results if not one.cause]
    return {
        "bad": {
            "count": len(bad),
            "passed": sum(one.verdict == "passed" for one in bad),
            "by_cause": {cause: _summary([one for one in bad if one.cause == cause]) for cause in CAUSES},
        },
        "good": {"count": len(good)}
        | _summary(good)
        | {"refused_percent": 100.0 * sum(one.verdict == "refused" for one in good) / len(good)},
        "unseen": _summary(unseen),
        "seed": seed,
        "sampled_plants": SAMPLED,
        "of_1000": _compared(results),
        "plants": dict(Counter(one.kind for one in results)),
        "routes": dict(Counter(one.route for one in results)),
        "seconds_per_certificate": float(np.mean([one.seconds for one in results])),
        "seconds_longest": float(np.max([one.seconds for one in results])),
        "cases": [
            [
                one.cause or "good",
                one.kind,
                one.route,
                one.verdict,
                one.first_failed,
                round(min(one.outcome.settled_error, 1e6), 3),
                round(one.outcome.radius, 4),
                round(one.outcome.disk, 3),
                round(min(one.outcome.delay_s, 1e6), 2),
                one.tried,
            ]
            for one in results
        ],
    }


def _compared(results: Sequence[Judged]) -> dict:
    """Whether 1,000 sampled plants would have said otherwise."""
    both = [one for one in results if one.verdict_of_1000]
    return {"cases": len(both), "other_verdict": sum(one.verdict != one.verdict_of_1000 for one in both)}


def _summary(results: list[Judged]) -> dict:
    return {
        "of": len(results),
        "passed": sum(one.verdict == "passed" for one in results),
        "first_failed": dict(Counter(one.first_failed for one in results if one.first_failed)),
        "unstable": sum(one.outcome.radius >= 1 for one in results),
        "drawn": sum(one.tried for one in results),
    }


# ---- bands

RECORDS, SAMPLES, LONG, LEVEL = 200, 2000, 300_000, 0.9
SWING, NOISE, RESAMPLES = 15.0, 0.1, 100
LEARNING = {
    route: bands.Learning(route, 4, np.ones(3), np.full(3, 0.3), GAMMA, spread)
    for route, spread in (("window", 0.0), ("kernel", 0.05))
}


def banded_machine() -> Plant:
    """Three zones of heat, as a linear plant: the record is drawn fast, and the same regression converges."""
    for seed in range(100):
        truth = drawn_truth(np.random.default_rng(seed), "zones")
        local = linearised(truth._replace(dead=0), np.full(truth.p, 180.0)) if truth.n == 3 else None
        if local is not None:
            return local
    raise ValueError("no machine of three zones that holds 180 °C was drawn")


def banded_record(plant: Plant, samples: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """u, y of inputs between drawn levels on holds of drawn length, from rest, noise of 0.1 °C."""
    u = np.empty((samples, plant.m))
    x, at = hold_output(plant, np.full(plant.p, 180.0))
    for j in range(plant.m):
        holds = rng.integers(4, 40, size=samples // 4 + 1)
        levels = at[j] + SWING * rng.uniform(-1, 1, len(holds))
        u[:, j] = np.repeat(levels, holds)[:samples]
    y = simulate(plant, u, x)[1]
    return u, y + NOISE * rng.standard_normal(y.shape)


def banded(plant: Plant, route: str, seed: int) -> np.ndarray:
    """The gain of one fresh record with its band (3, m, N (m+p) + p)."""
    rng = np.random.default_rng([7, seed])
    u, y = banded_record(plant, SAMPLES, rng)
    found = bands.bands([u], [y], LEARNING[route], resamples=RESAMPLES, level=LEVEL, rng=rng)
    return np.stack(found[:3])


def band_cover(jobs: int = 2) -> dict:
    plant, table = banded_machine(), {}
    for route, learning in LEARNING.items():
        started = time.process_time()
        u, y = banded_record(plant, LONG, np.random.default_rng(99))
        truth = bands.gain([u], [y], learning)
        calls = [joblib.delayed(banded)(plant, route, seed) for seed in range(RECORDS)]
        found = np.stack(joblib.Parallel(n_jobs=jobs)(calls))
        inside = ((found[:, 1] <= truth) & (truth <= found[:, 2])).mean(axis=0)
        spread = found[:, 0].std(axis=0)
        table[route] = {
            "entries": int(inside.size),
            "records": RECORDS,
            "resamples": RESAMPLES,
            "mean_cover_percent": 100 * float(inside.mean()),
            "least_cover_percent": 100 * float(inside.min()),
            "most_cover_percent": 100 * float(inside.max()),
            "bias_of_deviation": float(np.abs(found[:, 0].mean(axis=0) - truth).max() / spread.max()),
            "width_of_deviation": float(np.median((found[:, 2] - found[:, 1]).mean(axis=0) / spread)),
        }
        print(route, table[route], f"{time.process_time() - started:.0f} s")
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("which", nargs="*", default=["gate", "bands"])
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--count", type=int, default=COUNT)
    parser.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args()
    for name in ("gate", "bands"):
        if name not in arguments.which:
            continue
        started = time.time()
        if name == "gate":
            table = gate(arguments.count, seed=arguments.seed, jobs=arguments.jobs)
        else:
            table = band_cover(arguments.jobs)
        found = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {}
        artifacts.write_json(RESULTS, found | {name: table})
        shown = {key: value for key, value in table.items() if key != "cases"}
        print(json.dumps(shown, indent=1), f"{time.time() - started:.0f} s")


if __name__ == "__main__":
    main()
