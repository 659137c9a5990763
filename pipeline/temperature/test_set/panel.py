"""The test set (panel) for controllers: plants that were not used for learning or tuning, the cases run on
them, and the figures computed from the runs. Every controller is simulated as it runs on a machine (law.py).

Plants are drawn uniformly around a nominal one. They vary in each input's gain, the speed of the whole plant,
extra heat loss, a sample of delay on every input in a part of them, a lag before every input if the model is
too slow to show it, and the ambient. Four in five also have a structure that no controller's model has
(STRUCTURES). Cases of each plant: constant references from several starts, the coldest first, a ramp, a
sinusoid, a sequence of references, and a door, a fan and another room while a reference is held; with sensor
noise.

On the study's machine the cases are the declared ones. On a user's recordings they follow from the record by
stated defaults (scenario_defaults.py).
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from pipeline.temperature.controllers.feed_forward import Told
from pipeline.temperature.controllers.governor import OutputLimits, governor
from pipeline.temperature.controllers.law import (
    ActuatorLimits,
    Aim,
    Deployed,
    FeedForward,
    Governor,
    Reference,
    Rest,
    Strength,
    aim,
    all_fed_forward,
    batch_step,
    constant,
    deployed,
    feasible_target,
    handed_over,
    ramp,
    rest,
    sinusoid,
    watched,
)
from pipeline.temperature.controllers.problem import Design, DesignProblem
from pipeline.temperature.plant import Plant, hold_output, hold_state, padded, simulate
from pipeline.temperature.settings import Half, Panel, Tracking, TuneWeights
from pipeline.temperature.settings import Plant as Machine
from pipeline.temperature.test_set.scenario_defaults import (
    REACHED_DEGC,
    Infeasible,
    MachineScale,
    defaults,
    heat_up_s,
    machine_scale,
    unreachable,
)
from pipeline.temperature.tracking import Law, reached_state

RESTLESS = 1e-8  # reciprocal condition number of I - A below which a plant has no steady state of its own
# the surroundings get colder while a reference is held: from, until (shares of the run), and by which share
# of the rise: a door, a part fan, another room
DOOR, FAN, ROOM = (0.1, 0.15, 0.15), (0.3, 0.5, 0.08), (0.6, 1.0, 0.03)
MOVES = ("ramp", "sinusoid", "disturbed")  # cases without a step of the reference
GLANCE = 5  # samples: shorter excursions from the band are the controller's response to noise


class Structure(NamedTuple):
    """What a machine has but no model here. `wall`: a slow wall returns this share of the outputs' mean rise
    since the start, with a time constant of `slower` runs. `radiates`: share of the rise lost by radiation if
    the outputs are a whole rise above the start. `carried`: material carries heat from each output to the
    next, this share of how much more the former has warmed, LATE of a run before. `step_degC`: resolution of
    the sensors. `duty`: resolution of the inputs as a share of what holds the first reference; the first DEAD
    steps have no effect."""

    wall: float = 0.0
    slower: float = 0.5
    radiates: float = 0.0
    carried: float = 0.0
    step_degC: float = 0.0
    duty: float = 0.0


# the plants have these in turn
STRUCTURES = (
    Structure(),
    Structure(wall=0.1),
    Structure(radiates=0.1),
    Structure(carried=0.1),
    Structure(step_degC=0.25, duty=0.01),
)
LATE, DEAD = 0.03, 3
# the largest series lag of a plant, as a share of its quickest time constant of heat. For comparison: a
# cartridge in its bore 2 to 13 s, a sensor 1 to 5 s, a hot end identified as one mode 130 to 430 s
LAG = 0.05


class PlantSpread(NamedTuple):
    """How far plants differ from the nominal one. `input_gain`: gains 1 +- input_gain each. `slower`: A' = I
    + (A - I) / (1 + d), B' = B / (1 + d), d within +- slower, in the modes of heat. `extra_heat_loss`: A - l
    I, l from 0 to extra_heat_loss a step. `delayed`: share of plants with all inputs one step late.
    `ambient_degC`: ambient +- ambient_degC. `lag`: all inputs pass a lag of 0 to `lag` times the plant's
    quickest time constant of heat, less the lag that the plant already has. Every heater in its bore and
    every sensor has such a lag, but a model without so quick a mode does not contain it."""

    input_gain: float
    slower: float
    extra_heat_loss: float
    delayed: float
    ambient_degC: float
    lag: float = 0.0


def delayed(plant: Plant, late: bool, lag: float = 0.0) -> Plant:
    """Returns the plant with m more states h, the previous input. If `late`, the inputs act through h, one
    sample later. Otherwise h is carried along unused, so that both kinds have the same order. With a `lag` of
    at least one sample, h' = k h + (1 - k) u with k = exp(-1 / lag) acts in place of u: a first-order lag in
    series that adds no delay itself. A shorter lag is ignored. Feed-through must already be a delay
    (plant.strictly_proper)."""
    n, m, kept = plant.n, plant.m, np.exp(-1 / lag) if lag >= 1 else 0.0
    A, B = np.zeros((n + m, n + m)), np.zeros((n + m, m))
    A[:n, :n], A[n:, n:], B[n:] = plant.A, kept * np.eye(m), (1 - kept) * np.eye(m)
    if late:
        A[:n, n:] = plant.B
    else:
        A[:n, n:], B[:n] = kept * plant.B, (1 - kept) * plant.B
    return plant._replace(
        A=A,
        B=B,
        C=np.hstack([plant.C, np.zeros((plant.p, m))]),
        b=np.r_[plant.b, np.zeros(m)],
        K=np.vstack([plant.K, np.zeros((m, plant.p))]),
    )


def varied(
    plant: Plant,
    *,
    gains: np.ndarray,
    slower: float,
    loss: float,
    ambient: float,
    late: bool,
    cells: bool,
    lag: float = 0.0,
) -> Plant:
    """Returns one plant of the spread. If the ambient rises by `ambient` °C, the steady state rises as much
    in every cell (if the states are `cells`) or else in every output. In an identified plant only the modes
    of heat slow down (`paced`). `lag`: share of the plant's quickest time constant of heat; the lag that the
    plant already has is subtracted."""
    identity = np.eye(plant.n)
    pace = identity / (1 + slower) if cells else paced(plant.A, slower)
    A = identity + pace @ (plant.A - identity)
    warmer = np.ones(plant.n) if cells else reached_state(plant) @ np.ones(plant.p)
    b = pace @ plant.b + (identity - A) @ warmer * ambient
    changed = plant._replace(A=A - loss * identity, B=pace @ plant.B * gains, b=b)
    whole = lag * quickest(changed.A)
    return delayed(changed, late, whole - lag_held(changed, round(whole) + 2))


def quickest(A: np.ndarray) -> float:
    """Returns the time constant in samples of the quickest mode of heat of A (n, n); 0 if none decays."""
    sizes = [abs(value) for value in np.linalg.eigvals(A) if _of_heat(value)]
    return float(-1 / np.log(min(sizes))) if sizes and min(sizes) < 1 else 0.0


def lag_held(plant: Plant, samples: int) -> float:
    """Returns how many samples of lag and dead time a plant has: how much its pulse response falls short of
    its peak before the peak, sum (1 - h_k / h_peak) with h_k = sum |C A^k B|, k < samples."""
    acting, response = plant.B, np.empty(samples)
    for k in range(samples):
        response[k] = np.abs(plant.C @ acting).sum()
        acting = plant.A @ acting
    peak = int(response.argmax())
    return float(np.sum(1 - response[:peak] / response[peak]))


def paced(A: np.ndarray, slower: float) -> np.ndarray:
    """Returns the pace P (n, n) with which A' = I + P (A - I), B' = P B, b' = P b have the steady state of A,
    B, b and heat up 1 + slower times as slowly.

    A mode of heat has an eigenvalue l with Re l > 0.3 and |Im l| <= |1 - Re l|: overdamped, or hardly less. P
    is 1 / (1 + slower) on the invariant subspace of these modes and 1 on that of the others. The others
    (delays, sensor noise, oscillations) are not heat, and I + (A - I) / (1 + slower) would make them
    unstable.
    """
    n = len(A)
    T, Z, slow = scipy.linalg.schur(A, output="complex", sort=_of_heat)
    # A = Z [T1 X; 0 T2] Z*: with T1 S - S T2 = -X the columns Z [I S; 0 I] span both subspaces
    decoupled = np.eye(n, dtype=complex)
    if 0 < slow < n:
        decoupled[:slow, slow:] = scipy.linalg.solve_sylvester(
            T[:slow, :slow], -T[slow:, slow:], -T[:slow, slow:]
        )
    basis = Z @ decoupled
    share = np.where(np.arange(n) < slow, 1 / (1 + slower), 1.0)
    return (basis * share @ np.linalg.inv(basis)).real


def _of_heat(eigenvalue: complex) -> bool:
    return bool(eigenvalue.real > 0.3 and abs(eigenvalue.imag) <= abs(1 - eigenvalue.real))


def drawn(
    nominal: Sequence[Plant],
    count: int,
    spread: PlantSpread,
    *,
    cells: bool,
    rng: np.random.Generator,
    holdable: Callable[[Plant], bool] = lambda _: True,
) -> list[Plant]:
    """Returns `count` plants around the nominal ones in turn. A plant that is not `holdable` is moved half as
    far from its nominal one, and half as far again, because a plant that no controller can hold cannot
    compare controllers."""
    plants, lags = [], rng.spawn(1)[0].uniform(0, spread.lag, count)
    for k in range(count):
        plant = nominal[k % len(nominal)]
        gains = 1 + spread.input_gain * rng.uniform(-1, 1, plant.m)
        slower, loss, ambient, late = rng.uniform(-1, 1), rng.uniform(), rng.uniform(-1, 1), rng.uniform()
        for near in NEARER:
            found = varied(
                plant,
                gains=1 + near * (gains - 1) if near < 1 else gains,
                slower=near * spread.slower * slower,
                loss=near * spread.extra_heat_loss * loss,
                ambient=near * spread.ambient_degC * ambient,
                late=late < spread.delayed,
                cells=cells,
                lag=near * lags[k],
            )
            if holdable(found):
                break
        plants.append(found)
    return plants


NEARER = (1.0, 0.5, 0.25, 0.125, 0.0)  # tried shares of the spread


def corners(nominal: Sequence[Plant], spread: PlantSpread) -> tuple[list[Plant], Strength]:
    """Returns the family that the governor guards, each plant in time and one sample late, and the range of
    strength of its inputs."""
    family = [delayed(plant, late) for plant in nominal for late in (False, True)]
    weakest = (1 - spread.input_gain) / (1 + spread.slower)
    strongest = (1 + spread.input_gain) / (1 - spread.slower)
    return padded(family), Strength(weakest, strongest, spread.input_gain)


# ---- what they are asked


class Questions(NamedTuple):
    """The cases for every plant, by zone. starts (a, p) and constant references (j, p) in °C: each start with
    each reference. From the middle start: ramp (r (p,), slope (p,) in °C a step), sinusoid (mean (p,),
    amplitude (p,), period in steps), and sequence (g, p) of references for equal times. Held at the first
    reference: a door, a fan and another room."""

    starts: np.ndarray
    constants: np.ndarray
    ramp: tuple[np.ndarray, np.ndarray] | None
    sinusoid: tuple[np.ndarray, np.ndarray, float] | None
    sequence: np.ndarray | None


class Cases(NamedTuple):
    """The cases of all plants, plant by plant: `each` cases per plant, s in all. A case is held at y0 by u0
    from state x0 for `hold` samples, then runs `steps` samples under the controller.

    `begin` (s, g): step at which the g-th reference of a case begins; `asked` (s, g): its index in
    `references`. `noise`: (p,) in °C, generated from `seed`; `start` (s,): index of the start, 0 the coldest.
    `warms` (plants, n): what surroundings 1 °C warmer add to the state per step; `outside` (steps, s): by how
    many °C they are warmer; `rise`: °C from the coldest start to the first reference. `structure` (plants,
    6): the Structure of each plant; `carries` (plants, p, n): what warms one output by 1 °C. `told` (steps,
    s, q): the measured disturbances less their mean; `pushed` (steps, s, p): their effect on the outputs in
    °C.
    """

    plants: list[Plant]
    plant: np.ndarray
    each: int
    kind: np.ndarray
    start: np.ndarray
    starts: np.ndarray
    x0: np.ndarray
    u0: np.ndarray
    references: list[Reference]
    begin: np.ndarray
    asked: np.ndarray
    noise: np.ndarray
    seed: int
    steps: int
    hold: int
    warms: np.ndarray
    outside: np.ndarray
    rise: float
    structure: np.ndarray
    carries: np.ndarray
    told: np.ndarray
    pushed: np.ndarray

    @property
    def cold(self) -> np.ndarray:
        """Whether a case (s,) starts from cold."""
        return (self.kind == "constant") & (self.start == 0)


def asked(
    plants: Sequence[Plant],
    questions: Questions,
    *,
    noise: np.ndarray,
    seed: int,
    steps: int,
    hold: int,
    cells: bool,
    limits: ActuatorLimits | None = None,
    structures: Sequence[Structure] = STRUCTURES,
    told: Told | None = None,
) -> Cases:
    """Returns the cases of every plant; plants have one of `structures` in turn. If states are `cells`, a
    start holds every cell at one temperature; otherwise it holds every output there, or as near as `limits`
    allow. The coldest start may leave the limits, because a machine that is just switched on need not be
    held. `noise` (p,) in °C; `told`: the measured disturbances."""
    starts = np.vstack([questions.starts, questions.constants[:1]])
    references = [constant(r) for r in questions.constants]
    rows = [("constant", a, [j]) for a in range(len(questions.starts)) for j in range(len(references))]
    middle = len(questions.starts) // 2
    if questions.ramp is not None:
        rows.append(("ramp", middle, [len(references)]))
        references.append(ramp(*questions.ramp))
    if questions.sinusoid is not None:
        rows.append(("sinusoid", middle, [len(references)]))
        references.append(sinusoid(*questions.sinusoid))
    if questions.sequence is not None:
        rows.append(("sequence", middle, [len(references) + g for g in range(len(questions.sequence))]))
        references += [constant(r) for r in questions.sequence]
    rows.append(("disturbed", len(questions.starts), [0]))
    most = max(len(row[2]) for row in rows)
    begin = np.array(
        [[g * steps // len(row[2]) if g < len(row[2]) else steps for g in range(most)] for row in rows]
    )
    which = np.array([[row[2][min(g, len(row[2]) - 1)] for g in range(most)] for row in rows])
    x0, u0 = [], []
    for plant in plants:
        for name, a, _ in rows:
            state, held = _held(
                plant, starts[a], cells and name != "disturbed", limits if a or len(starts) < 3 else None
            )
            x0.append(state)
            u0.append(held)
    count, kind = len(plants), np.array([row[0] for row in rows])
    rise = max(float((questions.constants[0] - questions.starts[0]).mean()), 0.0)
    outside = np.outer(surroundings(steps, rise), kind == "disturbed")
    signal, push = (
        np.einsum("tq,s->tsq", part, kind == "disturbed") for part in pushed(told, steps, plants[0].p)
    )
    return Cases(
        list(plants),
        np.repeat(np.arange(count), len(rows)),
        len(rows),
        np.tile(kind, count),
        np.tile([row[1] for row in rows], count),
        starts,
        np.array(x0),
        np.array(u0),
        references,
        np.tile(begin, (count, 1)),
        np.tile(which, (count, 1)),
        np.asarray(noise, float),
        seed,
        steps,
        hold,
        np.stack([warmed(plant, cells=cells) for plant in plants]),
        np.tile(outside, count),
        rise,
        np.array([structures[k % len(structures)] for k in range(count)]),
        np.stack([carrying(plant) for plant in plants]),
        np.tile(signal, (1, count, 1)),
        np.tile(push, (1, count, 1)),
    )


def pushed(told: Told | None, steps: int, p: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the measured disturbances less their mean (steps, q), and their effect on the outputs in °C
    (steps, p). While the part fan of `surroundings` is on, disturbances go to their highest level one after
    the other, and stay there until it is off."""
    if told is None:
        return np.zeros((steps, 0)), np.zeros((steps, p))
    q = len(told.high)
    first, last = FAN[0], FAN[1]
    t = np.arange(steps)[:, None] / steps
    signal = (told.high - told.mean) * ((t >= first + (last - first) / (q + 1) * np.arange(q)) & (t < last))
    return signal, simulate(told.effect, signal, np.zeros(told.effect.n))[1]


def surroundings(steps: int, rise: float) -> np.ndarray:
    """Returns by how many °C (steps,) the surroundings are warmer, for a machine `rise` °C warmer than they
    are."""
    t = np.arange(steps) / steps
    on = [share * ((t >= first) & (t < last)) for first, last, share in (DOOR, FAN, ROOM)]
    return -rise * np.sum(on, axis=0)


def warmed(plant: Plant, *, cells: bool) -> np.ndarray:
    """Returns what surroundings 1 °C warmer add to the state (n,) per step, in a plant of `delayed`, so that
    every cell, or every output, becomes 1 °C warmer in the steady state."""
    inner = _undelayed(plant)
    warmer = np.ones(inner.n) if cells else reached_state(inner) @ np.ones(inner.p)
    return np.r_[warmer - inner.A @ warmer, np.zeros(plant.n - inner.n)]


def carrying(plant: Plant) -> np.ndarray:
    """Returns, for each output, what must be added to the state (p, n) per step in a plant of `delayed`, so
    that this output alone becomes 1 °C warmer in the steady state."""
    inner = _undelayed(plant)
    warmer = reached_state(inner)
    return np.pad((warmer - inner.A @ warmer).T, ((0, 0), (0, plant.n - inner.n)))


def _undelayed(plant: Plant) -> Plant:
    """Returns the plant of `delayed` without the stored inputs."""
    n = plant.n - plant.m
    return plant._replace(
        A=plant.A[:n, :n], B=plant.A[:n, n:] + plant.B[:n], C=plant.C[:, :n], b=plant.b[:n], K=plant.K[:n]
    )


def _held(
    plant: Plant, y: np.ndarray, cells: bool, limits: ActuatorLimits | None
) -> tuple[np.ndarray, np.ndarray]:
    """Returns state and input of a plant of `delayed`, held at outputs y (p,), or at cells of y[0] °C. If
    inputs would have to leave `limits`, it rests under the nearest inputs within them."""
    inner = _undelayed(plant)
    if cells:
        x = np.full(inner.n, y[0])
        u = hold_state(inner, x)
    else:
        x, u = hold_output(inner, y)
    if limits is None:
        return np.r_[x, u], u
    within, balance = np.clip(u, limits.low, limits.high), np.eye(inner.n) - inner.A
    # a plant that nearly integrates drifts slowly, and its steady state would be no useful start
    if np.any(within != u) and np.linalg.cond(balance) < 1 / RESTLESS:
        x = np.linalg.solve(balance, inner.B @ within + inner.b)
    return np.r_[x, within], within


# ---- what comes out


class Rollout(NamedTuple):
    """The signals of a simulation, each (steps, s, .): true outputs y, the reference r and the target y_star,
    inputs wished and applied, and the measured outputs."""

    y: np.ndarray
    r: np.ndarray
    target: np.ndarray
    wished: np.ndarray
    u: np.ndarray
    measured: np.ndarray


def rests(model: Plant, cases: Cases, limits: ActuatorLimits) -> list[Rest]:
    """Returns where a plant rests under each reference of the cases, then at each start."""
    return [rest(model, reference, limits) for reference in _wanted(cases)]


def aims(law: Law, at: Sequence[Rest], cases: Cases) -> list[Aim]:
    """Returns the Aim of a law for each Rest of `rests`."""
    return [aim(law, one, reference) for one, reference in zip(at, _wanted(cases), strict=True)]


def _wanted(cases: Cases) -> list[Reference]:
    return [*cases.references, *(constant(y) for y in cases.starts)]


def noise_of(cases: Cases) -> np.ndarray:
    """Returns the sensor noise (hold + steps, s, p), the same for every controller."""
    shape = (cases.hold + cases.steps, len(cases.plant), len(cases.noise))
    return cases.noise * np.random.default_rng(cases.seed).standard_normal(shape)


def schedule(cases: Cases, aimed: Sequence[Aim]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns r, y* (steps, s, p) and feed (steps, s, m) of every case."""
    steps, s = cases.steps, len(cases.plant)
    p, m = aimed[0].Y.shape[0], aimed[0].feed.shape[0]
    r, target, feed = np.empty((steps, s, p)), np.empty((steps, s, p)), np.empty((steps, s, m))
    for index, reference in enumerate(cases.references):
        w = reference.states(steps)
        parts = w @ reference.H.T, w @ aimed[index].Y.T, w @ aimed[index].feed.T
        for g in range(cases.begin.shape[1]):
            mine = np.flatnonzero((cases.asked[:, g] == index) & (cases.begin[:, g] < steps))
            for first in np.unique(cases.begin[mine, g]):
                rows = mine[cases.begin[mine, g] == first]
                for array, part in zip((r, target, feed), parts, strict=True):
                    array[first:, rows] = part[: steps - first, None]
    return r, target, feed


def rolled_out(controller: Deployed, cases: Cases, aimed: Sequence[Aim]) -> Rollout:
    """Simulates every case at once under one controller; `aimed` from `aims`."""
    r, target, feed = schedule(cases, aimed)
    usual = 0.0 if controller.forward is None else controller.forward.mean
    held, forward = held_readings(cases), all_fed_forward(controller, cases.told + usual)
    state = watched(controller, None, cases.u0, held[0], r[0])
    for measured in held[1:-1]:
        state = watched(controller, state, cases.u0, measured, r[0])
    state = handed_over(controller, state, held[-1], [aimed[len(cases.references) + a] for a in cases.start])

    def drive(t: int, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        nonlocal state
        applied, wished, state = batch_step(controller, state, measured, r[t], feed[t], target[t], forward[t])
        if not np.abs(state.z).max(initial=0.0) < 1e9:
            state = state._replace(z=np.clip(np.nan_to_num(state.z), -1e9, 1e9))
        return applied, wished

    return simulated(cases, drive, r, target)


def held_readings(cases: Cases) -> np.ndarray:
    """Returns the measurements (hold + 1, s, p) while the machines are held. The last one is taken when the
    controller takes over."""
    C, d = (np.stack([getattr(plant, name) for plant in cases.plants])[cases.plant] for name in ("C", "d"))
    held = np.einsum("spn,sn->sp", C, cases.x0) + d
    return in_steps(held + noise_of(cases)[: cases.hold + 1], cases.structure[cases.plant, 4][:, None])


def simulated(
    cases: Cases,
    drive: Callable[[int, np.ndarray], tuple[np.ndarray, np.ndarray]],
    r: np.ndarray,
    target: np.ndarray,
) -> Rollout:
    """Simulates every machine at once from where it is held. drive(t, measured (s, p)) returns the inputs (s,
    m) applied and wished. The structure of a machine changes what is measured, what its inputs do, and the
    surroundings."""
    count, each, (steps, s, p), m = len(cases.plants), cases.each, r.shape, cases.u0.shape[1]
    A, B, C = (
        np.stack([getattr(plant, name) for plant in cases.plants]).transpose(0, 2, 1) for name in "ABC"
    )
    b, d = (np.stack([getattr(plant, name) for plant in cases.plants])[:, None] for name in "bd")
    wall_share, slower, radiates, carried, step_degC, duty = cases.structure[cases.plant].T
    # the last case of each plant is held at the first reference
    duty = (duty * np.abs(cases.u0[each - 1 :: each]).max(axis=1)[cases.plant])[:, None]
    warms, pace = cases.warms[cases.plant], 1 / (slower * steps)
    carries, late = carried[:, None, None] * cases.carries[cases.plant], max(round(LATE * steps), 1)
    flows = bool(carried.any()) and p > 1
    x, wall, rise = cases.x0, np.zeros(s), max(cases.rise, 1.0)
    noise = noise_of(cases)[cases.hold :]
    y, measured = np.empty((steps, s, p)), np.empty((steps, s, p))
    applied, wished = np.empty((steps, s, m)), np.empty((steps, s, m))
    for t in range(steps):
        y[t] = (np.matmul(x.reshape(count, each, -1), C) + d).reshape(-1, p) + cases.pushed[t]
        measured[t] = in_steps(y[t] + noise[t], step_degC[:, None])
        applied[t], wished[t] = drive(t, measured[t])
        given = in_steps(applied[t], duty)
        given = np.where(np.abs(given) < DEAD * duty, 0.0, given)
        x = np.matmul(x.reshape(count, each, -1), A) + np.matmul(given.reshape(count, each, m), B) + b
        warmer = np.clip((y[t] - y[0]).mean(axis=1), -1e4, 1e4)
        wall += pace * (warmer - wall)
        outside = cases.outside[t] + wall_share * wall - radiates * warmer**2 / rise
        x = x.reshape(s, -1) + warms * outside[:, None]
        if flows and t >= late:
            warmed_by = np.clip(y[t - late] - y[0], -1e4, 1e4)
            x += np.einsum("sp,spn->sn", warmed_by[:, :-1] - warmed_by[:, 1:], carries[:, 1:])
        if not np.abs(x).max() < 1e9:
            x = np.clip(np.nan_to_num(x), -1e9, 1e9)
    return Rollout(y, r, target, wished, applied, measured)


def some(cases: Cases, kinds: Sequence[str], plants: int) -> Cases:
    """Returns the cases of these kinds, the disturbed one among them, on the first `plants` plants."""
    keep = np.isin(cases.kind, kinds) & (cases.plant < plants)
    rows = ("plant", "kind", "start", "x0", "u0", "begin", "asked")
    return cases._replace(
        plants=cases.plants[:plants],
        each=int(keep[: cases.each].sum()),
        outside=cases.outside[:, keep],
        told=cases.told[:, keep],
        pushed=cases.pushed[:, keep],
        **{name: getattr(cases, name)[keep] for name in rows},
    )


def in_steps(values: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Rounds values to whole steps; unchanged if the step is 0."""
    return np.where(step > 0, step * np.round(values / np.where(step > 0, step, 1.0)), values)


class Figures(NamedTuple):
    """An engineer's figures of each case (s,), from true outputs, worst zone, in °C, steps or percent.
    Settling, or heating from the coldest start, is inf if the outputs are outside the band at the end. Both,
    and overshoot, are NaN if the reference makes no step. The time at limits is NaN from the coldest start;
    the dip is NaN if no door, fan or room disturbs."""

    settled_error: np.ndarray
    settled_zone: np.ndarray
    peak: np.ndarray
    settling: np.ndarray
    heating: np.ndarray
    overshoot: np.ndarray
    at_limits: np.ndarray
    energy: np.ndarray
    travel: np.ndarray
    dip: np.ndarray
    rms: np.ndarray
    crossing: np.ndarray
    outside: np.ndarray


def figures(
    rollout: Rollout,
    cases: Cases,
    *,
    limits: ActuatorLimits,
    low: np.ndarray,
    high: np.ndarray,
    band: float,
    settled: int = 100,
) -> Figures:
    """Computes the figures of a simulation.

    Settled error: |mean of the last `settled` steps - r|. Peak: largest |y - r| of the later half of them.
    Settling and heating: the last step outside `band` °C of the target, for at least GLANCE steps, counted
    from each new reference; the longest of them. Overshoot: past the target in the direction of the step. At
    limits: share of (input, step) whose wished input is outside the limits. Energy: mean input. Travel: mean
    |u(t+1) - u(t)| of the input that moves most. Dip: largest |y - r| of all steps. Crossing: how far y lies
    beyond low, high (p,). Outside: steps outside the band; near its edge, a fifth of it wide, steps count in
    part, so that the figure is smooth.
    """
    error = rollout.y - rollout.r
    late = np.abs(error[-settled:].mean(axis=0))
    off = rollout.y - rollout.target
    beyond = np.abs(off).max(axis=2)
    moving = np.isin(cases.kind, MOVES)
    settling, overshoot = np.zeros(len(cases.plant)), np.zeros(len(cases.plant))
    ends = np.column_stack([cases.begin[:, 1:], np.full(len(cases.plant), cases.steps)])
    for first, after in {
        (int(a), int(b)) for a, b in zip(cases.begin.ravel(), ends.ravel(), strict=True) if a < b
    }:
        rows = np.flatnonzero(((cases.begin == first) & (ends == after)).any(axis=1))
        outside = lasting(beyond[first:after, rows] > band)
        last = np.where(outside.any(axis=0), len(outside) - outside[::-1].argmax(axis=0), 0).astype(float)
        last[outside[-1]] = np.inf
        settling[rows] = np.maximum(settling[rows], last)
        way = np.where(off[first, rows] <= 0, 1.0, -1.0)
        past = (way * off[first:after, rows]).max(axis=(0, 2))
        overshoot[rows] = np.maximum(overshoot[rows], past)
    settling[moving], overshoot[moving] = np.nan, np.nan
    cold = cases.cold
    wished = (rollout.wished < limits.low - 1e-9) | (rollout.wished > limits.high + 1e-9)
    return Figures(
        late.max(axis=1),
        late.argmax(axis=1),
        np.abs(error[-((settled + 1) // 2) :]).max(axis=(0, 2)),
        np.where(cold, np.nan, settling),
        np.where(cold, settling, np.nan),
        overshoot,
        np.where(cold, np.nan, 100.0 * wished.mean(axis=(0, 2))),
        rollout.u.mean(axis=(0, 2)),
        np.abs(np.diff(rollout.u, axis=0)).mean(axis=0).max(axis=1),
        np.where(cases.kind == "disturbed", np.abs(error).max(axis=(0, 2)), np.nan),
        np.sqrt((error**2).mean(axis=(0, 2))),
        np.maximum((rollout.y - high).max(axis=(0, 2)), (low - rollout.y).max(axis=(0, 2))),
        np.clip((beyond - band) / (0.2 * band) + 0.5, 0.0, 1.0).sum(axis=0),
    )


def lasting(outside: np.ndarray) -> np.ndarray:
    """Returns the parts of `outside` (steps, s) that last GLANCE steps or more, or exist from the first
    step."""
    padded = np.pad(outside, ((GLANCE - 1, 0), (0, 0)), constant_values=True)
    ends = np.array(np.lib.stride_tricks.sliding_window_view(padded, GLANCE, axis=0).all(axis=-1))
    lasts = ends.copy()
    for k in range(1, GLANCE):
        lasts[:-k] |= ends[k:]
    return lasts


def costs(results: Figures, allowance: Mapping[str, float]) -> np.ndarray:
    """Returns the declared cost of each case (s,): the sum of figure / allowance over the figures that apply,
    at most 1e4. `allowance`: by the names of Figures, the value that counts as a cost of one. `rms` counts if
    the reference makes no step, `outside` and `overshoot` if it does."""
    one = {name: getattr(results, name) / unit for name, unit in allowance.items()}
    moving = np.isnan(results.overshoot)
    response = np.where(moving, one["rms"], one["outside"] + np.nan_to_num(one["overshoot"]))
    total = response + one["settled_error"] + np.nan_to_num(one["at_limits"]) + one["energy"] + one["travel"]
    return np.minimum(np.nan_to_num(total, nan=1e4, posinf=1e4), 1e4)


class Rehearsal(NamedTuple):
    """The two halves of the test set, and what follows from this machine's record: the band and the settling
    limit (None: as declared), the shortest time from cold to the first reference, noise (p,) in °C, and
    references out of reach. `source` says in words where the cases come from."""

    judging: Cases
    training: Cases
    band_degC: float
    settling_s: float | None
    heat_up_s: float
    noise: np.ndarray
    infeasible: list[dict[str, Any]]
    source: str


class CaseConditions(NamedTuple):
    """The conditions that all controllers share when they are tuned and judged: the simulation (`rehearsal`),
    limits of inputs and outputs (low, high (p,) in °C), the governor, the integrator's limit in °C, the
    settled window in steps, the allowances of the cost, the discount, the sample time, and the feed-forward
    of measured disturbances.

    `faster`: share of the declared delay margins that is required here. It is below 1 for a machine that must
    settle sooner than the panel's. For example, the whole response of a hair dryer is over within 1 s.
    """

    rehearsal: Rehearsal
    limits: ActuatorLimits
    output_limits: tuple[np.ndarray, np.ndarray]
    governor: Governor
    integral_limit: float
    settled: int
    allowance: dict[str, float]
    gamma: float
    sample_time_s: float
    faster: float
    forward: FeedForward | None


def conditions(
    tuning: TuneWeights,
    machine: Machine,
    tracking: Tracking,
    settings: Panel,
    rehearsal: Rehearsal,
    family: Sequence[Plant],
    told: Told | None = None,
) -> CaseConditions:
    """Returns the conditions. `family`: the identified plant first, then its spread; `told`: the measured
    disturbances."""
    band = rehearsal.band_degC / settings.band_degC
    late = (rehearsal.settling_s or settings.settling_s) / settings.settling_s
    # the allowance scales with the settling limit and with the band
    allowance = {
        "outside": tuning.allow_settling_s * late / machine.sample_time_s,
        "overshoot": tuning.allow_overshoot_degC * band,
        "settled_error": tuning.allow_settled_error_degC * band,
        "at_limits": tuning.allow_at_limits_percent,
        "energy": tuning.allow_effort_percent,
        "travel": tuning.allow_travel_percent,
        "rms": tuning.allow_overshoot_degC * band,
    }
    # an overshoot within the noise cannot be forecast
    overshoot = max(tracking.governor_overshoot_degC * band, 3 * float(rehearsal.noise.max()))
    return CaseConditions(
        rehearsal,
        input_limits(machine),
        output_limits(machine),
        watchdog(machine, settings, family, rehearsal.noise, overshoot),
        tracking.integral_limit_degC * band,
        round(settings.settled_steps * rehearsal.judging.steps / settings.steps),
        allowance,
        tracking.gamma,
        machine.sample_time_s,
        min(late, 1.0),
        told.forward if told else None,
    )


def design_problem(
    models: Mapping[str, Any], tracking: Tracking, setting: CaseConditions, truth: Plant | None
) -> DesignProblem:
    """Returns the problem from which controllers are designed. It is the same for tuning and for judging,
    whatever the length of their cases. `models` has plant, family, window, kernel and printer_pid."""
    return DesignProblem(
        **models,
        truth=truth,
        limits=setting.limits,
        gamma=tracking.gamma,
        exact_tau=tracking.observer_tau,
        horizon=setting.rehearsal.judging.steps,
        noise=setting.rehearsal.noise,
    )


def deploy(design: Design, setting: CaseConditions) -> Deployed:
    """Returns a controller with the conditions that all controllers share."""
    return deployed(
        design.law,
        setting.limits,
        integral_limit=setting.integral_limit,
        governor=setting.governor if design.governed else None,
        holds=design.holds,
        forward=setting.forward,
    )


def play(
    design: Design, rests: Sequence[Rest], half: Cases, setting: CaseConditions
) -> tuple[Rollout, Figures]:
    """Simulates a controller, as deployed, on one half of the panel; `rests` from `rests` of its model."""
    rollout = rolled_out(deploy(design, setting), half, aims(design.law, rests, half))
    low, high = setting.output_limits
    return rollout, figures(
        rollout,
        half,
        limits=setting.limits,
        low=low,
        high=high,
        band=setting.rehearsal.band_degC,
        settled=setting.settled,
    )


def input_limits(machine: Machine) -> ActuatorLimits:
    low, high = np.array([(i.low, i.high) for i in machine.inputs], float).T
    rate = np.array([i.rate_percent_per_s or np.inf for i in machine.inputs]) * machine.sample_time_s
    return ActuatorLimits(low, high, rate)


def output_limits(machine: Machine) -> tuple[np.ndarray, np.ndarray]:
    """Returns low, high (p,) in °C; -inf and inf if none is declared."""
    low = [-np.inf if o.low is None else o.low for o in machine.outputs]
    high = [np.inf if o.high is None else o.high for o in machine.outputs]
    return np.array(low), np.array(high)


def watchdog(
    machine: Machine, settings: Panel, family: Sequence[Plant], noise: np.ndarray, overshoot: float
) -> Governor:
    """Returns the governor of all controllers. It guards the identified plant, in time and one sample late,
    with input strengths in the range of the panel's spread. Its margin to a limit is three standard
    deviations of the sensors' noise."""
    low, high = output_limits(machine)
    guarded, strength = corners(family[:1], spread_of(settings))
    limits = OutputLimits(low, high, 3 * noise, overshoot)
    return governor(guarded, input_limits(machine), limits, strength)


def spread_of(settings: Panel) -> PlantSpread:
    return PlantSpread(
        settings.input_gain,
        settings.slower,
        settings.extra_heat_loss_per_step,
        settings.delayed,
        settings.ambient_degC,
    )


def spread_around(settings: Panel, identified: Plant) -> PlantSpread:
    """Returns the declared spread with a lag, and with an extra heat loss of at most a fifth of the slowest
    mode's. The study's machine is known to have no such lag."""
    spread, slowest = spread_of(settings), 1 - np.abs(np.linalg.eigvals(identified.A)).max()
    return spread._replace(
        extra_heat_loss=float(np.clip(0.2 * slowest, 0.0, spread.extra_heat_loss)), lag=LAG
    )


def from_declaration(settings: Panel, machine: Machine, truth: Plant, family: Sequence[Plant]) -> Rehearsal:
    """Returns the test set of the study's machine. Controllers are judged around the true plant and tuned
    around the identified family, so that none can profit from errors of one identification."""
    reference = np.array([o.reference for o in machine.outputs])
    noise, limits = np.full(len(reference), settings.noise_degC), input_limits(machine)
    judging, training = (
        _half(
            settings,
            half,
            around,
            _questions(half, reference, settings.steps),
            noise,
            cells=cells,
            steps=settings.steps,
            declared=spread_of(settings),
            held=None if cells else limits,
        )
        for half, around, cells in ((settings.judging, [truth], True), (settings.training, family, False))
    )
    missed = unreachable(truth, (limits.low, limits.high), reference, *output_limits(machine))
    cold = settings.judging.starts_degC[0] * np.ones_like(reference)
    return Rehearsal(
        judging,
        training,
        settings.band_degC,
        None,
        heat_up_s(family[0], cold, reference, limits.high),
        noise,
        _infeasible(machine, missed),
        "declared",
    )


def _questions(half: Half, reference: np.ndarray, steps: int) -> Questions:
    def by_offset(offsets: Sequence[float]) -> np.ndarray:
        return np.array([reference + offset for offset in offsets])

    ones, slope = np.ones_like(reference), half.ramp_degC_per_step
    return Questions(
        np.array([start * ones for start in half.starts_degC]),
        by_offset(half.reference_offsets_degC),
        (reference - slope * steps, slope * ones) if slope else None,
        (reference - 3 * half.sinusoid_degC, half.sinusoid_degC * ones, float(half.sinusoid_steps))
        if half.sinusoid_degC
        else None,
        by_offset(half.sequence_offsets_degC) if half.sequence_offsets_degC else None,
    )


def _half(
    settings: Panel,
    half: Half,
    around: Sequence[Plant],
    questions: Questions,
    noise: np.ndarray,
    *,
    cells: bool,
    steps: int,
    declared: PlantSpread,
    limits: ActuatorLimits | None = None,
    told: Told | None = None,
    held: ActuatorLimits | None = None,
) -> Cases:
    """Returns one half of the panel: cases of at most `steps`, on plants around those of `around` that
    differ as in `declared`. Starts are held within `limits`, and every constant reference can be held within
    `held`."""
    rng = np.random.default_rng(half.seed)
    scaled = PlantSpread(*(half.spread * value for value in declared))._replace(
        delayed=min(half.spread * declared.delayed, 1.0)
    )

    def holdable(plant: Plant) -> bool:
        at = [feasible_target(plant, r, held.low, held.high) for r in questions.constants] if held else []
        return all(np.abs(target.miss).max() <= REACHED_DEGC for target in at)

    plants = drawn(padded(around), half.plants, scaled, cells=cells, rng=rng, holdable=holdable)
    return asked(
        plants,
        questions,
        noise=noise,
        seed=half.seed,
        steps=round(half.length * steps),
        hold=settings.hold_steps,
        cells=cells,
        limits=limits,
        told=told,
    )


# largest variation of the ambient as a share of the recorded span, if recordings do not differ by more: a
# record that spans 12 °C is not from a room that may be 8 °C warmer
AMBIENT_SHARE = 0.25
HOLDABLE = (1.0, 0.75, 0.5, 0.25, 0.1)  # tried shares of that variation


def _ambient(
    spread: PlantSpread,
    scale: MachineScale,
    identified: Plant,
    limits: ActuatorLimits,
    references: np.ndarray,
) -> float:
    """Returns by how many °C the ambient of a plant may differ: the panel's value, but at most AMBIENT_SHARE
    of the recorded span, and no more than leaves the references (j, p) within reach of the inputs: beyond
    that no controller could hold them. It is at least the difference found between recordings of the same
    machine."""

    def missed(warmer: float) -> float:
        moved = identified._replace(d=identified.d + warmer)
        at = [feasible_target(moved, r, limits.low, limits.high) for r in references]
        return max(float(np.abs(target.miss).max()) for target in at)

    most = min(spread.ambient_degC, AMBIENT_SHARE * float(np.min(scale.high_degC - scale.low_degC)))
    tolerated = missed(0.0) + REACHED_DEGC
    held = [
        share * most for share in HOLDABLE if max(map(missed, (share * most, -share * most))) <= tolerated
    ]
    return max(max(held, default=0.0), float(np.max(scale.ambient_degC_spread)))


def from_record(
    settings: Panel,
    machine: Machine,
    family: Sequence[Plant],
    u: Sequence[np.ndarray],
    y: Sequence[np.ndarray],
    recordings: Sequence[int],
    told: Told | None = None,
) -> Rehearsal:
    """Returns the test set of a user's machine. Both halves lie around plants of the identified family.
    Starts, references, band, settling limit and length follow from the record: segments u (T, m and more:
    disturbances follow the inputs) in percent and y (T, p) in °C, as from segments.without_gaps.

    The spread of plants is a bootstrap of the record, every second member for each half, and around each the
    panel's input gains, pace and delay. The ambient differs by `_ambient`. The extra heat loss is at most a
    fifth of the slowest mode's.
    """
    identified = family[0]
    u = [a[:, : len(machine.inputs)] for a in u]
    (low, high), limits = output_limits(machine), input_limits(machine)
    scale = machine_scale(u, y, identified, machine.sample_time_s, recordings)
    asked = defaults(
        scale,
        identified,
        (limits.low, limits.high),
        np.array([o.reference for o in machine.outputs]),
        low,
        high,
        machine.sample_time_s,
    )
    spread = spread_around(settings, identified)
    spread = spread._replace(ambient_degC=_ambient(spread, scale, identified, limits, asked.references))
    lower = asked.references[-1]
    amplitude_degC, period_steps = asked.sinusoid
    swing = asked.references.mean(axis=0), amplitude_degC, float(period_steps)
    questions = Questions(
        asked.starts, asked.references, (lower, asked.ramp_degC_per_step), swing, asked.sequence
    )
    training = Questions(asked.starts, asked.references[:1], None, None, asked.sequence)
    judging, trained = (
        _half(
            settings,
            half,
            around,
            question,
            scale.noise_degC,
            cells=False,
            steps=asked.steps,
            declared=spread,
            limits=limits,
            told=told,
        )
        for half, around, question in (
            (settings.judging, family[1::2], questions),
            (settings.training, family[::2], training),
        )
    )
    return Rehearsal(
        judging,
        trained,
        asked.band_degC,
        asked.settling_s,
        heat_up_s(identified, asked.starts[0], asked.references[0], limits.high),
        scale.noise_degC,
        _infeasible(machine, asked.infeasible),
        "from the record",
    )


def _infeasible(machine: Machine, missed: list[Infeasible]) -> list[dict[str, Any]]:
    """Returns the references out of reach, and which limit prevents each."""
    return [
        {
            "output": machine.outputs[one.output].name,
            "asked_degC": one.asked_degC,
            "reachable_degC": one.reachable_degC,
            "binding": _binding(machine, one),
        }
        for one in missed
    ]


def _binding(machine: Machine, one: Infeasible) -> str:
    """Returns in words what keeps a reference out of reach."""
    if one.input is None:
        return {"inputs": "fewer inputs than references"}.get(one.limit, f"the declared {one.limit} limit")
    signal = machine.inputs[one.input]
    limit = signal.low if one.limit == "low" else signal.high
    return f"{signal.name} at {limit:g} {signal.unit}"
