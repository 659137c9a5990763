"""The controller as it runs on the machine: a law with its limits, target, integrator, governor and
hand-over.

All controllers have this form. `step` runs one sample on a machine, and `batch_step` the same sample of many
cases at once, so the simulated controllers are those that a machine would run.

With memory z, measured y, and the reference r(t) = H w(t), w(t+1) = F w(t) (seed 1, (2)):

    u = feed w - K z - D y - K_r xi, cut to low..high and to `rate` a step, then by the governor
    xi(t+1) = xi + integral (clip(y* - y) + clip(beyond(P (u - u wished))))
    z(t+1) = A z + B_u u + B_y y + B_r r + c

For measured disturbances d, F (d - mean d) is added to u before u is cut. The law remembers u without this
part (FeedForward).

The target y* = Y w is the reference, or the nearest one that the inputs can hold. P = pinv(-K_r) turns the
difference between applied and wished input into the change of reference in °C that would have caused it
(back-calculation). Only the part beyond the integrator's own limit acts. The memory takes the applied input,
not the wished one.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

# ---- exported to the letter from here on


class Plant(NamedTuple):
    """x(t+1) = A x + B u + b + K e
    y = C x + D u + d + e

    Seed 1, (1), with an offset and the innovation form of an identified model.

    A (n, n), B (n, m), C (p, n), D (p, m), b (n,), d (p,), K (n, p) the Kalman gain; one step is
    `sample_time_s` seconds, u in percent of duty, y in °C.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    b: np.ndarray
    d: np.ndarray
    K: np.ndarray
    sample_time_s: float = 1.0

    @property
    def n(self) -> int:
        return self.A.shape[0]

    @property
    def m(self) -> int:
        return self.B.shape[1]

    @property
    def p(self) -> int:
        return self.C.shape[0]


class Law(NamedTuple):
    """A control law, with memory z, measured y, reference r and the input that was really applied (clipped or
    not).

    u = -K z - D y - K_r (r + xi) - k
    z(t+1) = A z + B_u u_applied + B_y y + B_r r + c
    xi(t+1) = xi + integral (r - y)

    Shapes for a memory of size q: A (q, q), B_u (q, m), B_y (q, p), B_r (q, p), c (q,), K (m, q), D (m, p),
    K_r (m, p), k (m,). It takes over from a plant that was held by u0 at y0 with z = start_u u0 + start_y y0
    + start and xi = 0.

    `integral`: share of the error that xi adds per step. This is the outer integrator, or the law's own
    integral action, whose gain is then in K_r. It is (p,) if outputs have different shares; there must then
    be at least as many inputs as outputs. No eigenvalue of A may be 1, because `aimed` solves (I - A) z for
    the memory at rest. Integral action belongs in xi.

    `conditional`: the law aims at no target. xi starts where -K_r xi is u0 and adds every error in full, but
    rests while the command is cut. -K_r xi is kept within the limits (conditional integration).
    """

    A: np.ndarray
    B_u: np.ndarray
    B_y: np.ndarray
    B_r: np.ndarray
    c: np.ndarray
    K: np.ndarray
    D: np.ndarray
    K_r: np.ndarray
    k: np.ndarray
    start_u: np.ndarray
    start_y: np.ndarray
    start: np.ndarray
    integral: float | np.ndarray = 0.0
    conditional: bool = False


# ---- the target


class Target(NamedTuple):
    """A steady state x (n,), u (m,) within the limits, with y (p,) as near the reference as the limits allow.
    `miss` (p,) is y - r in °C; `slack` is the distance of u from the nearest limit in percent."""

    x: np.ndarray
    u: np.ndarray
    y: np.ndarray
    miss: np.ndarray
    slack: float


def feasible_target(
    plant: Plant, r: np.ndarray, low: np.ndarray, high: np.ndarray, *, tolerance: float = 1e-3
) -> Target:
    """Minimises |C x + D u + d - r|^2 over x = A x + B u + b, low <= u <= high. Among equal solutions it
    takes one that keeps all inputs as far from their limits as possible.

    The unlimited optimum requests negative heat from heaters. With this target instead, the same gains settle
    on the reference (temperature notes, 6). The slack may add at most `tolerance` °C to the miss.
    """
    nearest = _steady(plant, r, low, high, 0.0)
    reach, slack, step = np.linalg.norm(nearest.miss) + tolerance, 0.0, (high - low).min() / 4
    widest = 0.49 * (high - low).min()
    while step > 1e-3:
        wider = _steady(plant, r, low, high, slack + step)
        # `widest` is the largest possible slack: u near the middle of its limits
        if slack + step <= widest and np.linalg.norm(wider.miss) <= reach:
            nearest, slack = wider, slack + step
        else:
            step /= 2
    return nearest


def _steady(plant: Plant, r: np.ndarray, low: np.ndarray, high: np.ndarray, slack: float) -> Target:
    """Solves the bounded least squares over u, with the state eliminated."""
    per_u, at_rest = state_at_rest(plant)
    rows = np.vstack([plant.C @ per_u + plant.D, LIGHT * np.eye(plant.m)])
    right = np.concatenate([r - plant.d - plant.C @ at_rest, np.zeros(plant.m)])
    slack = min(slack, 0.49 * (high - low).min())
    u = bounded_least_squares(rows, right, low + slack, high - slack)
    x = per_u @ u + at_rest
    y = plant.C @ x + plant.D @ u + plant.d
    return Target(x, u, y, y - r, slack)


def state_at_rest(plant: Plant) -> tuple[np.ndarray, np.ndarray]:
    """Returns X (n, m), x (n,) with the state at rest under constant inputs u: X u + x = (I - A)^-1 (B u +
    b). A plant that only integrates is assumed to leak 1e-9 a step."""
    balance = _leaking(np.eye(plant.n) - plant.A)
    return np.linalg.solve(balance, plant.B), np.linalg.solve(balance, plant.b)


# °C of miss that one percent of an input counts as: among equally good inputs the smaller wins
LIGHT = 1e-6
# relative sizes below which a gradient (of the sum of its terms), and a fall of the cost, may be rounding
ROUNDING, FALL = 1e-13, 1e-15


def bounded_least_squares(A: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Returns x (n,) that minimises |A x - b|^2 within low..high (n,); A (rows, n), b (rows,). Uses
    bounded-variable least squares (Stark and Parker 1995) with the same steps as
    scipy.optimize.lsq_linear(method="bvls"), so that an exported file needs numpy only.

    One difference: a variable at a limit is released only if its gradient is larger than rounding can make
    it. If more inputs than outputs are free, many solutions are equally good, and the first one found is
    taken. Otherwise rounding would choose, and would choose differently on another CPU, and in C.
    """
    x = np.linalg.lstsq(A, b, rcond=-1)[0]
    if np.all((x >= low) & (x <= high)):
        return x
    at = np.zeros(len(x))
    at[x <= low], at[x >= high] = -1, 1
    x = np.where(at < 0, low, np.where(at > 0, high, x))
    _settle_free(A, b, low, high, x, at)
    miss = A @ x - b
    cost, g = 0.5 * np.dot(miss, miss), A.T @ miss
    for _ in range(len(x)):
        doubt = ROUNDING * (np.abs(A).T @ (np.abs(A) @ np.abs(x) + np.abs(b)))
        if np.max(g * at - doubt) <= 0:
            break
        at[np.argmax(g * at - doubt)] = 0
        while _moved_until_bound(A, b, low, high, x, at):
            pass
        miss = A @ x - b
        before, cost, g = cost, 0.5 * np.dot(miss, miss), A.T @ miss
        if before - cost < FALL * before:
            break
    return x


def _settle_free(
    A: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray, x: np.ndarray, at: np.ndarray
) -> None:
    """Solves the least squares of the free variables. Puts those that leave their limits at them, until none
    does."""
    while (at == 0).any():
        free = np.flatnonzero(at == 0)
        z = np.linalg.lstsq(A[:, free], b - A.dot(x * (at != 0)), rcond=None)[0]
        below, above = z < low[free], z > high[free]
        x[free] = np.where(below, low[free], np.where(above, high[free], z))
        at[free[below]], at[free[above]] = -1, 1
        if not (below | above).any():
            break


def _moved_until_bound(
    A: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray, x: np.ndarray, at: np.ndarray
) -> bool:
    """Moves x to the least-squares solution of the free variables, or until one reaches a limit. Returns
    whether one did."""
    free = np.flatnonzero(at == 0)
    z = np.linalg.lstsq(A[:, free], b - A.dot(x * (at != 0)), rcond=None)[0]
    below, above = np.flatnonzero(z < low[free]), np.flatnonzero(z > high[free])
    beyond = np.r_[below, above]
    if not beyond.size:
        x[free] = z
        return False
    wall = np.r_[low[free][below], high[free][above]]
    share = (wall - x[free][beyond]) / (z[beyond] - x[free][beyond])
    first = int(np.argmin(share))
    x_free = x[free].copy()
    x_free *= 1 - share[first]
    x_free += share[first] * z
    x[free] = x_free
    at[free[beyond[first]]] = -1 if first < below.size else 1
    return True


# ---- the governor: what it is, and what it remembers


class ActuatorLimits(NamedTuple):
    """low (m,) <= u <= high (m,) in percent, changing by at most `rate` (m,) percent a step; inf means no
    limit."""

    low: np.ndarray
    high: np.ndarray
    rate: np.ndarray


class Strength(NamedTuple):
    """The range of input gains relative to a member's. All inputs act `weakest` to `strongest` times as
    strongly. In addition, each input may differ from the others by a factor within 1 +- `each`."""

    weakest: float
    strongest: float
    each: float


class Governor(NamedTuple):
    """A family of f plants with their observers, and the rows of their forecasts; `governor` makes it.

    A member remembers s = [x, w, xi, v] of size q = 2 (n + p). x is its state at its strongest inputs. w
    (p,), in °C a step, is a drift that the member cannot explain, so that a constant error vanishes
    (offset-free prediction). xi and v are how much smaller x and w would be at its weakest inputs. Before y
    is measured, s forecasts [C x + d, C xi]:

            s <- s + [e, clip(e + lambda C xi), C xi, clip(C xi)] correct,   s(t+1) = s move + u push + rest

    with innovation e = y - C x - d, lambda in 0..1 between strongest and weakest, and an observer of the
    stationary Riccati equation. w and v use errors up to `surprise` only: a larger error belongs to a
    transient, and there to the strength of the inputs.

    The forecast of output j, h instants ahead and at its strongest, is s ahead + above + strongest u rise, if
    the lowest inputs are applied from the next step on. With the highest inputs, `below` and `fall` take the
    places of `above` and `rise`. The second half of `ahead` forecasts how much less it is at its weakest.
    Rows run over outputs, then instants, of which the first is now.

    Shapes: see (f, q, 2 p), offset (f, p), correct (f, 4 p, q), move (f, q, q), push (f, m, q), rest (f, q),
    start (f, p, q), start_0 (f, q), ahead (f, q, 2 p h), above, below (f, p h), rise, fall (f, m, p h). low,
    high, surprise, doubt (p,) in °C; low and high have their margins already subtracted. `doubt` is how far
    an innovation may be off for reasons other than the strength of the inputs.
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


# repeats over all outputs, and over both sides: inputs mostly move one output each, so a few suffice
SWEEPS, ROUNDS = 8, 2
# percent: smaller differences and violations of rows are ignored, so that a case takes the same steps alone
# as among many
EXACT = 1e-9
# a member does not count if its squares of innovations are this many times those of the best member
CONTRADICTED = 4.0
# an output has arrived if it is within this many overshoots of its target
ARRIVED = 2.0
# an input that moves an output by less than this share of the strongest one is not changed for it
LEAST_EFFECT = 0.05


def started(family: Governor, y: np.ndarray) -> np.ndarray:
    """Returns the memory (f, s, q + 4 p) of the members at measured outputs y (s, p): s of Governor, then
    four sums per output, of -e C xi, (C xi)^2, |C xi| and e^2, in which older samples are forgotten."""
    memory = np.matmul(y, family.start) + family.start_0[:, None]
    return np.concatenate([memory, np.zeros((*memory.shape[:2], 4 * y.shape[1]))], axis=2)


def corrected(family: Governor, memory: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns the memory after outputs y (s, p) are measured."""
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
    """Returns the corrected memory one sample later, after inputs u (s, m)."""
    q = family.start.shape[2]
    after = memory.copy()
    after[:, :, :q] = np.matmul(memory[:, :, :q], family.move) + np.matmul(u, family.push)
    after[:, :, :q] += family.rest[:, None]
    return after


def observed(family: Governor, memory: np.ndarray, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns the memory one sample after y (s, p) was measured and inputs u (s, m) were applied."""
    return predicted(family, corrected(family, memory, y), u)


def evidence(family: Governor, memory: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns least, middle, most (f, s, p) and counts (f, s), from the innovations of each member and case.

    middle: where the inputs act between strongest (0) and weakest (1), by least squares. least and most: the
    same, if every innovation is off by up to `doubt` in the worse direction. counts: False for a member whose
    squares are more than CONTRADICTED times those of the best member and more than noise.
    """
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
    """Returns commands (s, m) within low..high (s, m) that are as near to u (s, m) as the rows allow.
    `memory`: corrected by the measured outputs; `y_star` (s, p): targets in °C.

    Projects onto the most violated row of each output in turn. For a high limit only inputs whose lowering
    helps are lowered; for a low limit only inputs whose raising helps are raised. The high limit is applied
    last. A limit that cannot be kept is kept as far as those inputs allow.
    """
    q, rows = family.start.shape[2], family.above.shape[1]
    least, middle, most, counts = evidence(family, memory)
    ahead = np.matmul(memory[:, :, :q], family.ahead)
    free, lacks = (
        part.reshape(*part.shape[:2], y_star.shape[1], -1)
        for part in (ahead[:, :, :rows], ahead[:, :, rows:])
    )
    # the present output is measured; the strength of the inputs is uncertain only for the future
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
    # if inputs are raised for one output and lowered for another, other inputs may replace them
    both = np.intersect1d(raised, lowered, assume_unique=True)
    if both.size:
        below, above, one = below.of(both), above.of(both), u[both]
        for _ in range(ROUNDS):
            one = -_projected(below, -one, -high[both])[0]
            one = _projected(above, one, low[both])[0]
        u[both] = one
    return u


def _walls(family: Governor, now: np.ndarray, y_star: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns floor and cap (f, s, p) in °C of outputs that are forecast at `now` (f, s, p). They are the
    limits low and high, and `overshoot` below and above the target, or `near` once the output has arrived at
    it.

    An output up to a further `overshoot` outside must return, so that small errors of the forecast do not add
    up. An output farther outside is brought back by the law. If it is too hot, it may get no hotter. If it is
    far too cold, it has no floor but `low`: to keep it from cooling, inputs of other outputs would have to
    heat, which the caps of those outputs forbid, and both would oscillate.
    """
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
    """The forecast seen from above, or negated from below. bare (f, s, p, h): forecast without the command;
    strength (f, s, p) times u rows (f, m, p h): effect of the command; counts (f, s): members that count;
    wall (f, s, p)."""

    bare: np.ndarray
    strength: np.ndarray
    rows: np.ndarray
    counts: np.ndarray
    wall: np.ndarray

    def of(self, cases: np.ndarray) -> "_Side":
        bare, strength, rows, counts, wall = self
        return _Side(bare[:, cases], strength[:, cases], rows, counts[:, cases], wall[:, cases])


def _projected(side: _Side, u: np.ndarray, low: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns u (s, m) of `governed` for one side, with bare + strength rows u <= wall if that can be kept,
    and the cases that a row changed."""
    driven = np.matmul(u, side.rows).reshape(side.bare.shape)
    over = side.bare + side.strength[..., None] * driven > side.wall[..., None]
    touched = np.flatnonzero((over.any(axis=(2, 3)) & side.counts).any(axis=0))
    if touched.size:
        u = u.copy()
        u[touched] = _swept(side.of(touched), u[touched], low[touched])
    return u, touched


def _swept(side: _Side, u: np.ndarray, low: np.ndarray) -> np.ndarray:
    """Returns the projections of `governed` for cases in which a row is violated: u, low (s, m)."""
    f, s, p, h = side.bare.shape
    m = u.shape[1]
    rows = side.rows.reshape(f, m, p, h)
    # an input that hardly moves an output is not changed for it
    helps = np.where(rows > LEAST_EFFECT * np.maximum(rows, 0.0).max(axis=1, keepdims=True), rows, 0.0)
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
            # an output violated only in another case waits for the next sweep, as it would alone
            step = np.where(at_fault[:, j] & (most > EXACT), most, 0.0) / np.where(size > 0, size, np.inf)
            u = np.maximum(u - step[:, None] * direction, low)
    return u


# ---- references


class Reference(NamedTuple):
    """r(t) = H w(t) in °C, w(t+1) = F w(t), w(0) = w0. w0[0] is 1 and stays constant. F (k, k), H (p, k), w0
    (k,)."""

    F: np.ndarray
    H: np.ndarray
    w0: np.ndarray

    def states(self, steps: int) -> np.ndarray:
        """Returns w (steps, k)."""
        w = np.empty((steps, len(self.w0)))
        w[0] = self.w0
        for t in range(1, steps):
            w[t] = self.F @ w[t - 1]
        return w


def constant(r: np.ndarray) -> Reference:
    """Returns the constant reference r (p,) °C."""
    return Reference(np.eye(1), np.asarray(r, float)[:, None], np.ones(1))


def ramp(r: np.ndarray, slope: np.ndarray) -> Reference:
    """Returns the reference r + slope t: r (p,) °C, slope (p,) °C a step."""
    return Reference(np.array([[1.0, 0.0], [1.0, 1.0]]), np.column_stack([r, slope]), np.array([1.0, 0.0]))


def sinusoid(mean: np.ndarray, amplitude: np.ndarray, period: float) -> Reference:
    """Returns the reference mean + amplitude sin(2 pi t / period): mean, amplitude (p,) °C, period in
    steps."""
    c, s = np.cos(2 * np.pi / period), np.sin(2 * np.pi / period)
    F = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    return Reference(
        F, np.column_stack([mean, np.zeros_like(amplitude), amplitude]), np.array([1.0, 1.0, 0.0])
    )


def same(reference: Reference, r: np.ndarray | Reference) -> bool:
    """Returns whether r, a Reference or a constant (p,) °C, equals `reference`."""
    if isinstance(r, Reference):
        return r is reference or all(map(np.array_equal, r, reference))
    return len(reference.w0) == 1 and bool((reference.H[:, 0] == r).all())


# ---- what a law rests at


class Rest(NamedTuple):
    """Inputs U w and outputs Y w at which a plant rests while the reference is H w: U (m, k), Y (p, k).

    `miss` (p,) is y* - r of the constant part in °C. `binding`: if the reference is out of reach, the inputs
    (index, limit in percent) that are at a limit.
    """

    U: np.ndarray
    Y: np.ndarray
    miss: np.ndarray
    binding: tuple[tuple[int, float], ...]


def rest(model: Plant, reference: Reference, limits: ActuatorLimits, *, tolerance: float = 0.01) -> Rest:
    """Returns where `model` rests under the reference. The constant part is a bounded quadratic programme
    (feasible_target). The moving part solves the regulator equations X F = A X + B U, C X = H (Francis
    1977)."""
    target = feasible_target(model, reference.H[:, 0], limits.low, limits.high)
    Y = reference.H.copy()
    Y[:, 0] = 0.0
    U = np.zeros((model.m, Y.shape[1])) if Y.shape[1] == 1 else _regulated(model, reference.F, Y)
    U[:, 0] += target.u
    Y[:, 0] = target.y
    binding = ()
    if np.abs(target.miss).max() > tolerance:
        binding = tuple(
            (i, float(limit))
            for i, u in enumerate(target.u)
            for limit in (limits.low[i], limits.high[i])
            if abs(u - limit) < 1e-6 * (limits.high[i] - limits.low[i])
        )
    return Rest(U, Y, target.miss, binding)


class Aim(NamedTuple):
    """feed (m, k) and Y (p, k) of the module's formula, which aim a law at a Rest."""

    feed: np.ndarray
    Y: np.ndarray


def aim(law: Law, at: Rest, reference: Reference) -> Aim:
    """Returns the Aim of a law at a Rest: feed = U + K Z + D Y, with the law's memory Z w on the way, Z F = A
    Z + B_u U + B_y Y + B_r H + [c 0]. A conditional law aims at no target: it gets the reference itself, and
    its own integral replaces the feed."""
    if law.conditional:
        return Aim(-law.K_r @ reference.H, reference.H)
    drive = law.B_u @ at.U + law.B_y @ at.Y + law.B_r @ reference.H
    drive[:, 0] += law.c
    Z = _sylvester(law.A, reference.F, drive)
    return Aim(at.U + law.K @ Z + law.D @ at.Y, at.Y)


def _triangular(F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns S, V with F = V S V*, S upper triangular and V unitary. Takes one eigenvalue at a time; its
    eigenvector becomes the next column of V (Golub and Van Loan 2013, 7.1)."""
    k = len(F)
    S, V = F + 0j, np.eye(k) + 0j
    for j in range(k - 1):
        value = np.linalg.eigvals(S[j:, j:])[0]
        v = np.linalg.svd(S[j:, j:] - value * np.eye(k - j))[2][-1].conj()
        Q = np.eye(k) + 0j
        Q[j:, j:] = np.linalg.qr(np.column_stack([v, np.eye(k - j)]))[0]
        S, V = Q.conj().T @ S @ Q, V @ Q
    return np.triu(S), V


def _sylvester(A: np.ndarray, F: np.ndarray, G: np.ndarray) -> np.ndarray:
    """Returns X (n, k) with X F = A X + G, column by column of F's Schur form. A mode of A that F excites is
    assumed to leak 1e-9 a step."""
    if not len(A):
        return G
    if len(F) == 1:
        return np.linalg.solve(_leaking(F[0, 0] * np.eye(len(A)) - A), G)
    S, V = _triangular(F)
    X, right = np.zeros(G.shape, complex), G @ V
    for j in range(len(S)):
        X[:, j] = np.linalg.solve(_leaking(S[j, j] * np.eye(len(A)) - A), right[:, j] - X[:, :j] @ S[:j, j])
    return (X @ V.conj().T).real


def _regulated(model: Plant, F: np.ndarray, H: np.ndarray) -> np.ndarray:
    """Returns U (m, k) with which the outputs follow H w, of least norm in each column of F's Schur form."""
    S, V = _triangular(F)
    X, U = np.zeros((model.n, len(S)), complex), np.zeros((model.m, len(S)), complex)
    wanted = H @ V
    for j in range(len(S)):
        past = X[:, :j] @ S[:j, j]
        resolvent = np.linalg.solve(
            _leaking(S[j, j] * np.eye(model.n) - model.A), np.column_stack([model.B, -past])
        )
        response = model.C @ resolvent[:, :-1] + model.D
        U[:, j] = np.linalg.pinv(response) @ (wanted[:, j] - model.C @ resolvent[:, -1])
        X[:, j] = resolvent[:, :-1] @ U[:, j] + resolvent[:, -1]
    return (U @ V.conj().T).real


def _leaking(balance: np.ndarray) -> np.ndarray:
    return balance + 1e-9 * np.eye(len(balance)) if np.linalg.cond(balance) > 1e13 else balance


# ---- the law, a sample at a time


AS_WISHED = 1e-9  # of an input's range: a command this near to the wished one counts as equal


class FeedForward(NamedTuple):
    """The feed-forward that compensates measured disturbances d: it adds F (d - mean d + lead e) to the
    inputs. F = `gain` (m, q) in percent per unit of each disturbance; `mean` (q,), at which nothing is added;
    `lead` (q,) in samples. The kick e of each disturbance follows its changes, because an input acts later
    than the disturbance:

    e(t) = FADES e(t-1) + d(t) - d(t-1)
    """

    gain: np.ndarray
    mean: np.ndarray
    lead: np.ndarray


FADES = 0.5  # share of a kick that is left one sample later


class Deployed(NamedTuple):
    """A law with the conditions under which it runs. `integral_limit` in °C: the largest error, and the
    largest back-calculated shift, that the integrator takes. `back` (p, m): P of the module's formula.
    `shift`: k if the memory is a plain shift by k entries, otherwise 0.

    `holds`: no control; the input at hand-over is kept.
    """

    law: Law
    limits: ActuatorLimits
    integral_limit: float
    back: np.ndarray
    shift: int
    governor: Governor | None
    holds: bool = False
    forward: FeedForward | None = None


def deployed(
    law: Law,
    limits: ActuatorLimits,
    *,
    integral_limit: float,
    governor: Governor | None = None,
    holds: bool = False,
    forward: FeedForward | None = None,
) -> Deployed:
    back = np.linalg.pinv(-law.K_r) if np.any(law.K_r) else np.zeros(law.K_r.T.shape)
    return Deployed(law, limits, integral_limit, back, _shift(law.A), governor, holds, forward)


def fed_forward(controller: Deployed, disturbances: np.ndarray, kick: np.ndarray | float = 0.0) -> np.ndarray:
    """Returns F (d - mean d + lead e) (..., m) in percent for disturbances d (..., q) and kicks e. For an
    unknown disturbance (NaN) the mean is taken."""
    m = controller.law.D.shape[0]
    if controller.forward is None or controller.holds:
        return np.zeros((*np.shape(disturbances)[:-1], m))
    gain, mean, lead = controller.forward
    return np.where(np.isnan(disturbances), 0.0, disturbances - mean + lead * kick) @ gain.T


def kicked(kick: np.ndarray, before: np.ndarray, disturbances: np.ndarray) -> np.ndarray:
    """Returns the kick e (..., q) one sample later. If a disturbance is unknown (NaN), before or now, its
    kick only fades."""
    moved = disturbances - before
    return FADES * kick + np.where(np.isnan(moved), 0.0, moved)


def all_fed_forward(controller: Deployed, disturbances: np.ndarray) -> np.ndarray:
    """Returns the feed-forward (T, ..., m) for disturbances (T, ..., q), sample by sample."""
    kick = np.zeros(np.shape(disturbances))
    if controller.forward is not None and controller.forward.lead.any():
        before = disturbances[0]
        for t in range(1, len(disturbances)):
            kick[t] = kicked(kick[t - 1], before, disturbances[t])
            before = np.where(np.isnan(disturbances[t]), before, disturbances[t])
    return fed_forward(controller, disturbances, kick)


def compact(law: Law, N: int) -> Law:
    """Returns the same law of a window of N past inputs and outputs (kernel.window_law) with a memory of N m
    numbers instead of N (m+p). z_i is the part of the coming command that the lags from i on already
    determine. It starts where the window would.

        z_i(t+1) = z_{i+1}(t) + K^u_i u(t) + K^y_i y(t), u = -z_1 - ...
    """
    m, p = law.D.shape
    of_u, of_y = (
        part.reshape(m, N, -1).transpose(1, 0, 2) for part in (law.K[:, : N * m], law.K[:, N * m :])
    )
    left_u, left_y = (part[::-1].cumsum(axis=0)[::-1].reshape(N * m, -1) for part in (of_u, of_y))
    return law._replace(
        A=np.eye(N * m, k=m),
        B_u=of_u.reshape(N * m, m),
        B_y=of_y.reshape(N * m, p),
        B_r=np.zeros((N * m, p)),
        c=np.zeros(N * m),
        K=np.eye(m, N * m),
        start_u=left_u,
        start_y=left_y,
        start=np.zeros(N * m),
    )


def _shift(A: np.ndarray) -> int:
    """Returns k if A is a plain shift by k, otherwise 0."""
    k = int(np.flatnonzero(A[0])[0]) if len(A) and A[0].any() else 0
    return k if k and np.array_equal(A, np.eye(len(A), k=k)) else 0


class ControllerState(NamedTuple):
    """All that a controller remembers, to be saved and restored: z (s, q), xi (s, p), the last applied input
    u (s, m), and the memory x (f, s, n) of the governor's family. s: cases at once, 1 on a machine."""

    z: np.ndarray
    xi: np.ndarray
    u: np.ndarray
    x: np.ndarray


def watched(
    controller: Deployed,
    state: ControllerState | None,
    u: np.ndarray,
    y: np.ndarray,
    r: np.ndarray,
    forward: np.ndarray | float = 0.0,
) -> ControllerState:
    """Returns the state after one sample in manual. `u` (s, m): inputs applied; `y` (s, p): outputs measured
    before; `r` (s, p): reference; `forward` (s, m): the feed-forward at this sample. `state` is None at the
    first sample."""
    law, family, acts = controller.law, controller.governor, u - forward
    if state is None:
        z = acts @ law.start_u.T + y @ law.start_y.T + law.start
        x = np.zeros((0, len(u), 0)) if family is None else started(family, y)
        state = ControllerState(z, np.zeros(y.shape), u, x)
    x = state.x if family is None else observed(family, state.x, acts, y)
    return ControllerState(_remembered(controller, state.z, acts, y, r), state.xi, u, x)


def handed_over(
    controller: Deployed,
    state: ControllerState,
    y: np.ndarray,
    here: Sequence[Aim],
    forward: np.ndarray | float = 0.0,
) -> ControllerState:
    """Returns the state in which the law takes over from manual without a bump. xi starts so that the law,
    aimed at the present outputs, continues with the manual input, up to `integral_limit`. `here`: an Aim at
    the y of each case. A conditional law starts its integral action at that input. A law without integral
    action could neither keep such a start nor let it decay, so its state stays unchanged."""
    law = controller.law
    if controller.holds or not np.any(law.integral):
        return state
    acts = state.u - forward
    if law.conditional:
        return state._replace(xi=acts @ controller.back.T)
    feed = np.array([one.feed[:, 0] for one in here])
    wished = feed - state.z @ law.K.T - y @ law.D.T
    most = controller.integral_limit
    return state._replace(xi=np.clip((acts - wished) @ controller.back.T, -most, most))


def batch_step(
    controller: Deployed,
    state: ControllerState,
    y: np.ndarray,
    r: np.ndarray,
    feed: np.ndarray,
    y_star: np.ndarray,
    forward: np.ndarray | float = 0.0,
    applied: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, ControllerState]:
    """Returns the inputs (s, m) to apply, the wished inputs, and the state one sample later. `y` (s, p):
    measured; `r` (s, p): reference; `feed` (s, m): feed w; `y_star` (s, p): target; `forward` (s, m):
    feed-forward; `applied` (s, m): the inputs that the machine gets, if they differ."""
    law = controller.law
    if controller.holds:
        return state.u, state.u, state
    wished = feed - state.z @ law.K.T - y @ law.D.T - state.xi @ law.K_r.T
    u, x = _allowed(controller, state, wished, y, y_star, forward)
    given = u if applied is None else applied
    acts = given - forward
    x = x if controller.governor is None else predicted(controller.governor, x, acts)
    xi = _integrated(controller, state.xi, y_star - y, acts, wished)
    after = ControllerState(_remembered(controller, state.z, acts, y, r), xi, given, x)
    return u, wished + forward, after


def _allowed(
    controller: Deployed,
    state: ControllerState,
    wished: np.ndarray,
    y: np.ndarray,
    y_star: np.ndarray,
    forward: np.ndarray | float,
) -> tuple[np.ndarray, np.ndarray]:
    """Returns inputs (s, m) as near to `wished` plus `forward` as the limits and the governor allow, and the
    governor's memory corrected by y (s, p)."""
    limits, family = controller.limits, controller.governor
    low = np.maximum(limits.low, np.minimum(state.u - limits.rate, limits.high))
    high = np.minimum(limits.high, np.maximum(state.u + limits.rate, limits.low))
    u = np.minimum(np.maximum(wished + forward, low), high)
    if family is None:
        return u, state.x
    x = corrected(family, state.x, y)
    return governed(family, x, u - forward, y_star, low - forward, high - forward) + forward, x


def _integrated(controller: Deployed, xi, error, u, wished):
    """Returns xi (s, p) one sample later, by the module's formula or by conditional integration (Law)."""
    law, most = controller.law, controller.integral_limit
    if law.conditional:
        after = xi + law.integral * error
        # equal to the wished command except for rounding, because a replay sums in another order
        inside = np.abs(u - wished) <= AS_WISHED * (controller.limits.high - controller.limits.low)
        within = (
            np.clip(-after @ law.K_r.T, controller.limits.low, controller.limits.high) @ controller.back.T
        )
        return np.where(inside @ (law.K_r != 0), within, xi)
    if not np.any(law.integral):
        return xi
    shift = (u - wished) @ controller.back.T
    beyond = shift - np.minimum(np.maximum(shift, -most), most)
    clipped = [np.minimum(np.maximum(one, -most), most) for one in (error, beyond)]
    return xi + law.integral * (clipped[0] + clipped[1])


def _remembered(controller: Deployed, z, u, y, r):
    """Returns z (s, q) one sample later."""
    law = controller.law
    after = u @ law.B_u.T + y @ law.B_y.T + r @ law.B_r.T + law.c
    if controller.shift:
        after[:, : -controller.shift] += z[:, controller.shift :]
    else:
        after += z @ law.A.T
    return after


# ---- what a machine runs

INPUTS, REFERENCES = "inputs in percent", "references in °C"


def numbers(
    values: np.ndarray | float, shape: tuple[int, ...], what: str, *, finite: bool = False
) -> np.ndarray:
    """Returns `values` as a float array. Raises ValueError if it does not have this shape, or if `finite` is
    set and a value is not finite. `what` names the values in the message."""
    array = np.asarray(values, float)
    if array.shape != shape:
        raise ValueError(
            f"the controller expects {shape[0] if shape else 'one'} {what} but was given an array of shape "
            f"{array.shape}; give it those of the machine that it was designed for, in the order of section "
            "plant, NaN for a sensor that does not answer"
        )
    if finite and not np.isfinite(array).all():
        raise ValueError(
            f"the controller expects finite {what} but was given {array}; keep the last ones that were"
        )
    return array


def _shapes(controller: Deployed) -> dict[str, tuple[int, ...]]:
    """Returns the shapes of ControllerState on one machine."""
    (m, p), family = controller.law.D.shape, controller.governor
    x = (0, 1, 0) if family is None else (len(family.start), 1, family.start.shape[2] + 4 * p)
    return dict(zip(ControllerState._fields, ((1, len(controller.law.A)), (1, p), (1, m), x), strict=True))


class RunningController:
    """One controller on one machine, a sample at a time.

    In manual, call `watch` each sample; then `hand_over` once, then `step` each sample. A reference is (p,)
    °C, or a Reference that starts at the sample where it is first given. When the reference changes, the
    controller computes its aim on `model` and keeps the last AIMS of them. `saved` returns all other memory
    as arrays; after `restore` it continues with identical results. `binding`: if the reference is out of
    reach, the inputs (index, limit in percent) that prevent it.
    """

    AIMS = 64

    def __init__(self, controller: Deployed, model: Plant):
        self.controller, self.model = controller, model
        self.binding: tuple[tuple[int, float], ...] = ()
        self._aims: dict[bytes, tuple[Rest, Aim]] = {}
        self._state: ControllerState | None = None
        self._reference: Reference | None = None
        self._w, self._t = np.zeros(0), 0
        self.forward = np.zeros(len(controller.law.D))
        q = 0 if controller.forward is None else len(controller.forward.mean)
        # disturbances now and one sample ago, and the kick one sample ago
        self._told, self._before, self._kick = np.full(q, np.nan), np.full(q, np.nan), np.zeros(q)

    def tell(self, disturbances: np.ndarray) -> None:
        """Sets the disturbances d (q,) from this sample on; NaN for an unknown one."""
        if self.controller.forward is not None:
            self._told = np.array(disturbances, float)
            self._feed_forward()

    def _feed_forward(self) -> None:
        kick = kicked(self._kick, self._before, self._told)
        self.forward = fed_forward(self.controller, self._told, kick)

    def _passed(self) -> None:
        """Advances the feed-forward by one sample. If no disturbance was ever given, keeps `forward` as it
        is."""
        if np.isnan(self._told).all() and np.isnan(self._before).all():
            return
        self._kick = kicked(self._kick, self._before, self._told)
        self._before = np.where(np.isnan(self._told), self._before, self._told)
        self._feed_forward()

    def watch(self, u: np.ndarray, y: np.ndarray, r: np.ndarray) -> None:
        """Takes one sample in manual: inputs u (m,) applied, outputs y (p,) measured before, reference r
        (p,). Raises ValueError, and remembers nothing, if their number is wrong or one is not finite."""
        m, p = self.controller.law.D.shape
        u, r = numbers(u, (m,), INPUTS, finite=True), numbers(r, (p,), REFERENCES, finite=True)
        self._state = watched(
            self.controller, self._state, u[None], self._measured(y)[None], r[None], self.forward
        )
        self._passed()

    def hand_over(self, y: np.ndarray, at: np.ndarray | None = None) -> None:
        """Hands over from manual to the law without a bump, at outputs y (p,) measured now. `at` (p,): where
        the machine is, if not at y. Raises ValueError if `watch` was never called."""
        y = self._measured(y)
        here = self._aimed(constant(y if at is None else at))[1]
        self._state = handed_over(self.controller, self._remembers(), y[None], [here], self.forward)

    def step(
        self, y: np.ndarray, r: np.ndarray | Reference, t: int, applied: np.ndarray | None = None
    ) -> np.ndarray:
        """Returns inputs u (m,) to apply, from outputs y (p,) measured at sample t under reference r, as in
        `batch_step`. `applied` (m,): the inputs that the machine gets, if they differ. Raises ValueError if y
        or r is not finite or has the wrong shape, if t decreases, or if `watch` was never called."""
        y, state = self._measured(y), self._remembers()
        feed, y_star, now = (part[None] for part in self._target(r, t))
        given = None if applied is None else applied[None]
        u, _, self._state = batch_step(
            self.controller, state, y[None], now, feed, y_star, self.forward, given
        )
        self._passed()
        return u[0].copy()

    def saved(self) -> dict[str, np.ndarray]:
        """Returns all memory as arrays. Raises ValueError before the first `watch`."""
        arrays = self._remembers()._asdict()
        arrays |= {"told": self._told, "before": self._before, "kick": self._kick}
        if self._reference is not None:
            arrays |= {**self._reference._asdict(), "w": self._w, "t": np.array(self._t)}
        return {name: np.array(part) for name, part in arrays.items()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Continues from the arrays that another controller of the same law and governor `saved`. Raises
        ValueError if the arrays do not fit this law and governor, or are not finite."""
        state, told = ControllerState._fields, ("told", "before", "kick")
        mine = {name: np.array(arrays[name]) for name in (*state, *told) if name in arrays}
        given = {name: part.shape for name, part in mine.items()}
        expected = _shapes(self.controller) | dict.fromkeys(told, self._kick.shape)
        if given != expected:
            raise ValueError(
                f"the controller expects to be restored from arrays of shapes {expected} but was given "
                f"{given}; restore what a controller of the same law and governor saved"
            )
        if lost := [name for name in state if not np.isfinite(mine[name]).all()]:
            raise ValueError(
                f"the controller expects finite numbers to be restored from but {', '.join(lost)} has some "
                "that are not; restore an older save, or start with watch"
            )
        self._told, self._before, self._kick = (mine[name] for name in told)
        if len(self._kick):
            self._feed_forward()
        self._state = ControllerState(*(mine[name] for name in state))
        self._reference = None
        if "w" in arrays:
            reference = Reference(*(np.array(arrays[name]) for name in Reference._fields))
            self._moved(self._turned(reference, int(arrays["t"])), np.array(arrays["w"]))

    def _remembers(self) -> ControllerState:
        if self._state is None:
            raise ValueError("the controller has seen no sample; call watch with each sample in manual first")
        return self._state

    def _measured(self, y: np.ndarray) -> np.ndarray:
        y = numbers(y, self.controller.law.D.shape[1:], "temperatures in °C")
        if not np.isfinite(y.sum()):
            raise ValueError(
                f"the controller expects finite temperatures in °C but measured {y}; "
                "go to manual until every sensor answers"
            )
        return y

    def _target(self, r: np.ndarray | Reference, t: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns feed (m,), target y* (p,) and reference (p,) at sample t."""
        mine = self._reference
        if mine is not None and t < self._t:
            raise ValueError(f"sample {t} comes after sample {self._t}; count samples upwards")
        if not isinstance(r, Reference):
            r = numbers(r, self.controller.law.D.shape[1:], REFERENCES)
        if mine is None or not same(mine, r):
            mine = self._turned(r if isinstance(r, Reference) else constant(r), t)
        if len(self._w) > 1:
            w = self._w
            for _ in range(t - self._t):
                w = mine.F @ w
            self._moved(mine, w)
        self._t = t
        return self._now

    def _turned(self, reference: Reference, t: int) -> Reference:
        mine = Reference(*(np.array(part, float) for part in reference))
        numbers(mine.H @ mine.w0, self.controller.law.D.shape[1:], REFERENCES, finite=True)
        at, self._aim = self._aimed(mine)
        self._reference = mine
        self.binding, self._t = at.binding, t
        self._moved(mine, mine.w0)
        return mine

    def _moved(self, reference: Reference, w: np.ndarray) -> None:
        self._w = w
        self._now = self._aim.feed @ w, self._aim.Y @ w, reference.H @ w

    def _aimed(self, reference: Reference) -> tuple[Rest, Aim]:
        key = reference.F.tobytes() + reference.H.tobytes()
        if key not in self._aims:
            at = rest(self.model, reference, self.controller.limits)
            if len(self._aims) >= self.AIMS:
                del self._aims[next(iter(self._aims))]
            self._aims[key] = at, aim(self.controller.law, at, reference)
        return self._aims[key]
