"""The governor: what keeps the predicted worst output of a family of plants within the limits of the
outputs, whatever the law asks for.

A braking distance in each output: the command moves as little as it must, so that from the next step on every
member of the family that the record has not contradicted could still be stopped below `high` by its lowest
inputs, and above `low` by its highest. In the terms of a reference governor (Garone, Di Cairano,
Kolmanovsky 2017): the reference moves to the one for which the law would have asked for that command, and
back-calculation tells the integrator.

A member does not know how strongly its inputs act, only within what range. Its forecast is linear in that
strength, so that it carries two: the strongest, and what lies between strongest and weakest; least squares on
its innovations tells, output by output, where between them the machine is. What a member explains worse than
another, whatever its strength (a delay that is not there), does not count for a while.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg

from pipeline.temperature.plant import Plant, markov_parameters
from pipeline.temperature.tracking import reached_state, riccati


class ActuatorLimits(NamedTuple):
    """low (m,) <= u <= high (m,) in percent, and at most `rate` (m,) percent a step; inf: none."""

    low: np.ndarray
    high: np.ndarray
    rate: np.ndarray


class OutputLimits(NamedTuple):
    """low, high (p,) in °C, -inf and inf where none is declared; `margin` (p,) in °C is kept from both, for
    the sensors' noise (three standard deviations); `overshoot` in °C: how far an output may be predicted
    beyond its target."""

    low: np.ndarray
    high: np.ndarray
    margin: np.ndarray
    overshoot: float


class Strength(NamedTuple):
    """All inputs act `weakest` to `strongest` times as they do on the member; beside that each input differs
    from the others by a factor within 1 +- `each`."""

    weakest: float
    strongest: float
    each: float


class Governor(NamedTuple):
    """A family of f plants with their observers, and the rows by which they look ahead; `governor` makes it.

    A member remembers s = [x, w, xi, v] of size q = 2 (n + p). x is its state at its strongest and w (p) in
    °C a step a drift that it cannot explain, so that steady disagreement vanishes (offset-free prediction);
    xi and v are by how much less x and w would be at its weakest. Before y is measured s forecasts
    [C x + d, C xi]:

        s <- s + [e, clip(e + lambda C xi), C xi, clip(C xi)] correct,   s(t+1) = s move + u push + rest

    with innovation e = y - C x - d, lambda in 0..1 between strongest and weakest, and an observer of the
    stationary Riccati equation. w and v see up to `surprise` only: what is larger belongs to a transient, and
    there to the strength of the inputs.

    Its output j, h instants ahead and at its strongest, is s ahead + above + strongest u rise, with lowest
    inputs from the next step on, and with `below` and `fall` in their places with highest; the second half of
    `ahead` tells what the weakest lacks. Rows run over outputs, then instants, of which the first is now.

    Shapes: see (f, q, 2 p), offset (f, p), correct (f, 4 p, q), move (f, q, q), push (f, m, q), rest (f, q),
    start (f, p, q), start_0 (f, q), ahead (f, q, 2 p h), above, below (f, p h), rise, fall (f, m, p h); low,
    high, surprise, doubt (p,) in °C, margins taken off: `doubt` is by how much an innovation may be off for
    reasons other than the inputs' strength.
    """

    see: np.ndarray
    offset: np.ndarray
    correct: np.ndarray
    move: np.ndarray
    push: np.ndarray
    rest: np.ndarray
    start: np.ndarray
    start_0: np.ndarray
    ahead: np.ndarray
    above: np.ndarray
    below: np.ndarray
    rise: np.ndarray
    fall: np.ndarray
    low: np.ndarray
    high: np.ndarray
    surprise: np.ndarray
    doubt: np.ndarray
    near: np.ndarray
    forgets: float
    strength: Strength
    overshoot: float


# steps ahead at most
LONGEST = 120
# shares of its peak from which on a pulse response is looked at, and up to which closely
REACHED, SHOULDER = 0.2, 0.9
# projections over all outputs, and over both sides: inputs mostly move one output each, so that a few suffice
SWEEPS, ROUNDS = 8, 2
# percent by which rows are equal, or missed: one case by itself takes the same steps as among many
EXACT = 1e-9
# share of what the innovations told that is forgotten a step, and of the drift, and with them the observer's
# constants: for a furthest look ahead of so many steps; a machine that needs more is watched as much longer
FORGETS, LEAK, UNHURRIED = 0.005, 1e-4, 16
# squares of innovations beyond those of the best member from which a member does not count
CONTRADICTED = 4.0
# overshoots from its target within which an output has arrived; how many it may go beyond it then, where the
# whole range of the inputs for one sample moves it by fewer overshoots than this
ARRIVED, LET_GO, BARELY = 2.0, 4.0, 20.0
# an input that moves an output by less than this share of the strongest one is not held back for it
WEAK = 0.05


def governor(
    family: Sequence[Plant],
    limits: ActuatorLimits,
    outputs: OutputLimits,
    strength: Strength,
    *,
    tau: float = 0.2,
    drift: float = 0.06,
) -> Governor:
    """The governor of a family of plants of one order (their feed-through made a delay), for inputs of any
    `strength` within its range.

    Innovations are doubted by the sensors' noise, a tenth of a degree at least. The observer takes process
    noise to come in by the inputs, sensors to be as much noisier as tau percent^2 of every input, and the
    drift w to wander a step by `drift` of what a percent of every input does at most: the same whatever the
    units. A machine that answers more slowly is watched as much longer, by the furthest instant ahead.
    """
    at, unsure = instants(family), np.maximum(outputs.margin, 0.1)
    slower = max(at[-1] / UNHURRIED, 1.0)
    members = [
        {
            **_watching(plant, strength, tau * slower**2, drift / slower, LEAK / slower),
            **_ahead(plant, limits, strength, at),
        }
        for plant in family
    ]
    return Governor(
        **{name: np.stack([member[name] for member in members]) for name in members[0]},
        low=outputs.low + outputs.margin,
        high=outputs.high - outputs.margin,
        surprise=3 * unsure,
        doubt=4 * unsure,
        near=_near(family[0], limits, outputs.overshoot, strength),
        forgets=FORGETS / slower,
        strength=strength,
        overshoot=outputs.overshoot,
    )


def _near(plant: Plant, limits: ActuatorLimits, overshoot: float, strength: Strength) -> np.ndarray:
    """How far (p,) in °C an output that has arrived at its target may be predicted beyond it.

    `overshoot` where one sample can do much. Where it can do little, the law's own small moves are as large
    as the forecast's errors, of which a tight wall would make a steady error.
    """
    pulse = np.abs(markov_parameters(plant, LONGEST)).max(axis=0)
    most = strength.strongest * pulse @ (limits.high - limits.low)
    return np.where(most < BARELY * overshoot, LET_GO, 1.0) * overshoot


def instants(family: Sequence[Plant]) -> np.ndarray:
    """Steps ahead at which the members are looked at: now; by steps of a quarter from that at which an
    output's pulse response is first at REACHED of its peak to that at which every output's is at its
    SHOULDER; and in ever wider steps from the first peak, to four times that after which the strongest of the
    slowest member is, 16 at least.

    Heat that is already on its way peaks in an output sooner than a pulse from now does: whoever looks from
    the pulse's peak on sees it only when it is past. Nearer than REACHED a command does so little that every
    error of the forecast would shut the inputs.
    """
    pulses = [np.abs(markov_parameters(plant, LONGEST)).max(axis=2) for plant in family]
    first = 1 + min(int(pulse.argmax(axis=0).min()) for pulse in pulses)
    peak = 1 + max(int(pulse.max(axis=1).argmax()) for pulse in pulses)
    last = min(max(4 * peak, 16), LONGEST)
    shares = [pulse / np.maximum(pulse.max(axis=0), 1e-300) for pulse in pulses]
    near = [1 + min(int((share >= REACHED).argmax(axis=0).min()) for share in shares)]
    full = 1 + max(int((share >= SHOULDER).argmax(axis=0).max()) for share in shares)
    while near[-1] < max(first, full):
        near.append(near[-1] + max(1, near[-1] // 4))
    between = np.r_[near, first, first + 2 ** np.arange(7)]
    return np.unique(np.r_[0, between[between < last], last])


def _drifting(plant: Plant, leak: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A, C of the state [x; w]: w (p) in °C a step warms the outputs along the state that inputs most likely
    reach; it leaks, so that no mode of it stands still unseen."""
    n, p = plant.n, plant.p
    A = np.block([[plant.A, reached_state(plant)], [np.zeros((p, n)), (1 - leak) * np.eye(p)]])
    return A, np.hstack([plant.C, np.zeros((p, p))])


def _watching(
    plant: Plant, strength: Strength, tau: float, drift: float, leak: float
) -> dict[str, np.ndarray]:
    """The part of a Governor by which one member follows the machine."""
    n, m, p = plant.n, plant.m, plant.p
    likely = reached_state(plant)
    A, C = _drifting(plant, leak)
    pulse = (np.abs(markov_parameters(plant, LONGEST)).max(axis=0) ** 2).sum(axis=1)
    noise = scipy.linalg.block_diag(plant.B @ plant.B.T, drift**2 * np.diag(pulse))
    sensors = tau * pulse.mean() * np.eye(p)
    P = riccati(A.T, C.T, noise, sensors)
    L = P @ C.T @ np.linalg.inv(C @ P @ C.T + sensors)
    less, none = strength.strongest - strength.weakest, np.zeros((p, m))
    quick, slow = (np.vstack(parts) for parts in ((L[:n], 0 * L[n:]), (0 * L[:n], L[n:])))
    one, other = np.array([[1.0], [0.0]]), np.array([[0.0], [1.0]])
    return {
        "see": scipy.linalg.block_diag(C, C).T,
        "offset": plant.d,
        "correct": np.hstack([np.kron(which, part) for which in (one, -other) for part in (quick, slow)]).T,
        "move": scipy.linalg.block_diag(A, A).T,
        "push": np.vstack([strength.strongest * plant.B, none, less * plant.B, none]).T,
        "rest": np.r_[plant.b, np.zeros(n + 2 * p)],
        "start": np.vstack([likely, np.zeros((n + 2 * p, p))]).T,
        "start_0": np.r_[-likely @ plant.d, np.zeros(n + 2 * p)],
    }


def _ahead(plant: Plant, limits: ActuatorLimits, strength: Strength, at: np.ndarray) -> dict[str, np.ndarray]:
    """The rows of a Governor of one member. A rate limit slows the stop: inputs go from u to the limit on a
    straight line that the slowest of them needs. An input that helps is taken to act less than one that
    hurts, by what `each` leaves open."""
    n, m, p = plant.n, plant.m, plant.p
    A, C = _drifting(plant)
    B, b = np.vstack([plant.B, np.zeros((p, m))]), np.r_[plant.b, np.zeros(p)]
    rows = {name: [] for name in ("x", "u", "left", "right")}
    power, driven, left, right = np.eye(n + p), np.zeros((n + p, m)), np.zeros((n + p, m)), np.zeros(n + p)
    for step in range(at[-1] + 1):
        if step in at:
            for name, part in zip(rows, (power, driven, left, right), strict=True):
                rows[name].append(C @ part)
        share = np.maximum(0.0, 1.0 - step * limits.rate / (limits.high - limits.low)) if step else 1.0
        power, driven = A @ power, A @ driven + B * share
        left, right = A @ left + B * (1.0 - share), A @ right + b
    x, u, left, right = (np.stack(rows[name], axis=1).reshape(p * len(at), -1) for name in rows)
    most, least = strength.strongest, strength.weakest
    rest, weaker = right[:, 0] + np.repeat(plant.d, len(at)), (1 - strength.each) / (1 + strength.each)
    return {
        "ahead": scipy.linalg.block_diag(x, x).T,
        "above": rest + most * left @ limits.low,
        "below": rest + least * left @ limits.high,
        "rise": np.where(u < 0, weaker * u, u).T,
        "fall": np.where(u < 0, u / weaker, u).T,
    }


# ---- what it remembers


def started(family: Governor, y: np.ndarray) -> np.ndarray:
    """Memory (f, s, q + 4 p) of the members at measured outputs y (s, p): s of Governor, then four sums an
    output, of -e C xi, (C xi)^2, |C xi| and e^2, older ones forgotten."""
    memory = np.matmul(y, family.start) + family.start_0[:, None]
    return np.concatenate([memory, np.zeros((*memory.shape[:2], 4 * y.shape[1]))], axis=2)


def corrected(family: Governor, memory: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The memory once outputs y (s, p) are measured."""
    q, p = family.start.shape[2], y.shape[1]
    s = memory[:, :, :q]
    forecast = np.matmul(s, family.see)
    e = y - family.offset[:, None] - forecast[:, :, :p]
    lacks = forecast[:, :, p:]
    after = np.empty_like(memory)
    sums = (1 - family.forgets) * memory[:, :, q:]
    for k, news in enumerate((-e * lacks, lacks * lacks, np.abs(lacks), e * e)):
        sums[:, :, k * p : (k + 1) * p] += news
    strength = np.clip(sums[:, :, :p] / (sums[:, :, p : 2 * p] + 1e-12), 0.0, 1.0)
    left = e + strength * lacks
    calm, lacks_calm = (np.minimum(np.maximum(v, -family.surprise), family.surprise) for v in (left, lacks))
    news = np.concatenate([e, calm, lacks, lacks_calm], axis=2)
    after[:, :, :q] = s + np.matmul(news, family.correct)
    after[:, :, q:] = sums
    return after


def predicted(family: Governor, memory: np.ndarray, u: np.ndarray) -> np.ndarray:
    """The corrected memory a sample on, inputs u (s, m) applied."""
    q = family.start.shape[2]
    after = memory.copy()
    after[:, :, :q] = np.matmul(memory[:, :, :q], family.move) + np.matmul(u, family.push)
    after[:, :, :q] += family.rest[:, None]
    return after


def observed(family: Governor, memory: np.ndarray, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The memory a sample after inputs u (s, m) were applied where y (s, p) was measured."""
    return predicted(family, corrected(family, memory, y), u)


def evidence(family: Governor, memory: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What the innovations tell of each member, case and output (f, s, p): the share of the way from
    strongest to weakest that the inputs are at least, by least squares, and at most, every innovation up to
    `doubt` off in the direction that matters; and whether the member counts (f, s). It does not where the
    best member's squares are a quarter of its own, and its own more than noise."""
    p = len(family.low)
    sums = memory[:, :, -4 * p :]
    product, square, size, own = (sums[:, :, k * p : (k + 1) * p] for k in range(4))
    share, doubt = 1 / (square + 1e-12), family.doubt * size + 1e-9
    middle = np.clip(product * share, 0.0, 1.0)
    rest = (own - middle * (2 * product - middle * square)).sum(axis=2)
    counts = rest <= CONTRADICTED * rest.min(axis=0) + (family.doubt**2).sum()
    least, most = (np.clip((product + off) * share, 0.0, 1.0) for off in (-doubt, doubt))
    return least, middle, most, counts


# ---- what it allows


def governed(
    family: Governor, memory: np.ndarray, u: np.ndarray, y_star: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Commands (s, m) as near to u (s, m) as the rows allow, within low..high (s, m); the memory corrected by
    what was measured, y_star (s, p) targets.

    Projections onto the most violated row of each output in turn. Only inputs whose lowering helps are
    lowered for a high limit, and raised for a low one; the high limit has the last word. What cannot be kept
    is kept as far as those inputs go.
    """
    q, rows = family.start.shape[2], family.above.shape[1]
    least, middle, most, counts = evidence(family, memory)
    ahead = np.matmul(memory[:, :, :q], family.ahead)
    free, lacks = (
        part.reshape(*part.shape[:2], y_star.shape[1], -1)
        for part in (ahead[:, :, :rows], ahead[:, :, rows:])
    )
    # where an output is, is measured: how strong the inputs are is in doubt for what is still to come
    free, lacks = free - (middle * lacks[..., 0])[..., None], lacks - lacks[..., :1]
    now = free[..., 0] + family.offset[:, None]
    floor, cap = _walls(family, now, y_star)
    per_member = (len(free), 1, *free.shape[2:])
    strongest, less = family.strength.strongest, family.strength.strongest - family.strength.weakest
    bare = -(free - most[..., None] * lacks) - family.below.reshape(per_member)
    below = _Side(bare, strongest - less * most, family.fall, counts, -floor)
    bare = free - least[..., None] * lacks + family.above.reshape(per_member)
    above = _Side(bare, strongest - less * least, family.rise, counts, cap)
    u, raised = _projected(below, -u, -high)
    u, lowered = _projected(above, -u, low)
    # where an input is lowered for one output and was raised for another, others may do what it did
    both = np.intersect1d(raised, lowered, assume_unique=True)
    if both.size:
        below, above, one = below.of(both), above.of(both), u[both]
        for _ in range(ROUNDS):
            one = -_projected(below, -one, -high[both])[0]
            one = _projected(above, one, low[both])[0]
        u[both] = one
    return u


def _walls(family: Governor, now: np.ndarray, y_star: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Floor and cap (f, s, p) in °C of outputs forecast `now` (f, s, p): low and high; and `overshoot` beyond
    the target, `near` where an output has arrived at it. What is up to a further `overshoot` off goes back,
    so that small errors of the forecast do not add up; what is further off comes back as the law says, and
    what is too hot gets no hotter. What is far too cold is left to the law: to keep it from cooling, inputs
    of other outputs would have to heat, which those outputs' caps forbid, and both would swing."""
    arriving, leaving = (
        np.where(sign * (y_star - now) < ARRIVED * family.overshoot, family.near, family.overshoot)
        for sign in (1.0, -1.0)
    )
    floor, cap = y_star - leaving, y_star + arriving
    return (
        np.maximum(family.low, np.where(now < floor - family.overshoot, -np.inf, floor)),
        np.minimum(family.high, np.where(now > cap + family.overshoot, now, cap)),
    )


class _Side(NamedTuple):
    """What is forecast from above, or negated from below: bare (f, s, p, h) without the command, of which
    strength (f, s, p) times u rows (f, m, p h) is to come; members that count (f, s); the wall (f, s, p)."""

    bare: np.ndarray
    strength: np.ndarray
    rows: np.ndarray
    counts: np.ndarray
    wall: np.ndarray

    def of(self, cases: np.ndarray) -> "_Side":
        bare, strength, rows, counts, wall = self
        return _Side(bare[:, cases], strength[:, cases], rows, counts[:, cases], wall[:, cases])


def _projected(side: _Side, u: np.ndarray, low: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """u (s, m) of `governed` for one side: bare + strength rows u <= wall where that can be kept; and which
    cases a row touched."""
    driven = np.matmul(u, side.rows).reshape(side.bare.shape)
    over = side.bare + side.strength[..., None] * driven > side.wall[..., None]
    touched = np.flatnonzero((over.any(axis=(2, 3)) & side.counts).any(axis=0))
    if touched.size:
        u = u.copy()
        u[touched] = _swept(side.of(touched), u[touched], low[touched])
    return u, touched


def _swept(side: _Side, u: np.ndarray, low: np.ndarray) -> np.ndarray:
    """The projections of `governed` for cases that a row touches: u, low (s, m)."""
    f, s, p, h = side.bare.shape
    m = u.shape[1]
    rows = side.rows.reshape(f, m, p, h)
    # what hardly moves an output is not shut for its sake
    helps = np.where(rows > WEAK * np.maximum(rows, 0.0).max(axis=1, keepdims=True), rows, 0.0)
    helps = np.maximum(helps, 0.0)
    least = np.matmul(low, helps.reshape(f, m, -1)) + np.matmul(u, (rows - helps).reshape(f, m, -1))
    room = (side.wall[..., None] - side.bare) / side.strength[..., None]
    room = np.where(side.counts[..., None, None], np.maximum(room, least.reshape(room.shape)), np.inf)
    helps = helps.transpose(2, 0, 3, 1).reshape(p, f * h, m)
    for _ in range(SWEEPS):
        over = np.matmul(u, side.rows).reshape(room.shape) - room
        at_fault = (over > EXACT).any(axis=(0, 3))  # (s, p)
        if not at_fault.any():
            break
        for j in np.flatnonzero(at_fault.any(axis=0)):
            excess = np.matmul(u, rows[:, :, j]) - room[:, :, j]
            excess = excess.transpose(1, 0, 2).reshape(s, f * h)
            most = excess.max(axis=1)
            worst = (excess >= most[:, None] - EXACT).argmax(axis=1)
            direction = helps[j, worst] * (u > low + EXACT)
            size = (direction**2).sum(axis=1)
            # an output that is at fault in another case alone waits for the next sweep, as it does by itself
            step = np.where(at_fault[:, j] & (most > EXACT), most, 0.0) / np.where(size > 0, size, np.inf)
            u = np.maximum(u - step[:, None] * direction, low)
    return u
