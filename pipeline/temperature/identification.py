"""From a record to a plant: window, dead time, feed-through, order and refinement chosen on the identification data by stated rules, then one fit on all of it.

The rules, each with its reason:
  window        Akaike's criterion (corrected for few samples) over the lags of a VARX model: long enough to whiten, not longer than the record supports
  feed-through  Schwarz's criterion with and without u(t), where `feedthrough` is None
  largest order singular values, in units of the noise, above what coefficient errors alone reach: sqrt(2) (sqrt(rows) + sqrt(columns)) of the noise matrix
  dead time     lags at which the largest model's impulse response stays under 5 % of its peak, kept only where the cross-validation below prefers it
  order         the fewest parameters whose error in simulation of left-out blocks is within one standard error (of the paired differences), or 2 %, of the best
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from pipeline.temperature.order import Candidate, cross_validate, fit, shifted, simplest, with_delays
from pipeline.temperature.plant import Plant, markov_parameters
from pipeline.temperature.refinement import drives, estimate_state, simulation_form
from pipeline.temperature.subspace import (
    Lagged,
    Segments,
    Varx,
    complete_runs,
    lagged,
    moesp,
    moesp_singular_values,
    one_step,
    realise,
    subspace,
    varx,
)

__all__ = ["Candidate", "Identified", "Varx", "check_inputs", "identify", "moesp", "moesp_singular_values", "varx"]

NOISE_FREE = 1e-10  # share of the outputs' power that a noise-free record's one-step errors stay under
EXACT_RANK = 1e-7  # singular values of a noise-free record below this share of the largest are rounding
WIDEST = 360  # columns of the lagged record: the cost of a fit grows with their square


class Identified(NamedTuple):
    """An identified plant and how it was chosen. order: states without those of the delays; past: window; order_table: candidates with their errors.

    x0 has the initial state of each segment, or of each piece where masked inputs cut one (`gapless`).
    """

    plant: Plant
    order: int
    past: int
    delays: tuple[int, ...]
    feedthrough: bool
    offset: bool
    fit: str
    singular_values: np.ndarray
    noise_edge: float
    order_table: list[Candidate]
    x0: list[np.ndarray]
    rows: int
    dropped_rows: int
    notes: list[str]


def check_outputs(y: Segments, *, names: Sequence[str] = ()) -> None:
    """Raises ValueError where an output never moves: no model of it is possible."""
    rows = np.vstack(y)
    for j in range(rows.shape[1]):
        seen = rows[np.isfinite(rows[:, j]), j]
        if seen.size == 0 or np.ptp(seen) == 0:
            shown = f"{seen[0]:g} in every sample" if seen.size else "missing in every sample"
            raise ValueError(
                f"output {names[j] if names else f'y{j + 1}'} is constant ({shown}), so no model of it is possible; check the sensor, or leave it out of plant.outputs"
            )


def check_inputs(u: Segments, *, offset: bool = True, names: Sequence[str] = ()) -> None:
    """Raises ValueError where an input is constant or a linear combination of the others: its column of B is then not identified."""
    rows = np.vstack(u)
    rows = rows[np.isfinite(rows).all(axis=1)]
    rows = rows - rows.mean(axis=0) if offset else rows
    size = np.sqrt(np.mean(rows**2, axis=0))
    for j in range(rows.shape[1]):
        if size[j] <= 1e-9 * max(np.abs(np.vstack(u)[:, j]).max(initial=0.0), 1e-300):
            raise ValueError(f"input {names[j] if names else f'u{j + 1}'} is constant, so its column of B is not identified; excite it, or leave it out of the inputs")
    scaled = rows / size
    for j in range(1, rows.shape[1]):
        weights = np.linalg.lstsq(scaled[:, :j], scaled[:, j], rcond=None)[0]
        if np.linalg.norm(scaled[:, j] - scaled[:, :j] @ weights) < 1e-6 * np.linalg.norm(scaled[:, j]):
            others = ", ".join(names[k] if names else f"u{k + 1}" for k in range(j) if abs(weights[k]) > 1e-6)
            raise ValueError(
                f"input {names[j] if names else f'u{j + 1}'} is a linear combination of {others}, so its column of B is not identified; move it independently, or leave it out"
            )


def gapless(u: Segments, y: Segments) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The segments cut where an input is masked: no plant can be run over an unknown input. Pieces of one sample, or without a single y, are dropped."""
    us, ys = [], []
    for a, b in zip(u, y, strict=True):
        edges = np.flatnonzero(np.diff(np.r_[0, np.isfinite(a).all(axis=1), 0]))
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            if stop - start > 1 and np.isfinite(b[start:stop]).any():
                us.append(a[start:stop])
                ys.append(b[start:stop])
    return us, ys


def longest_window(u: Segments, y: Segments) -> int:
    """Most lags that leave four complete windows for each unknown of a VARX model, within the width that is paid for."""
    q, lengths = u[0].shape[1] + y[0].shape[1], np.array([len(w) for w in complete_runs(u, y)])
    supported = [past for past in range(2, WIDEST // q + 1) if np.maximum(lengths - past, 0).sum() >= 4 * q * past]
    return max(supported, default=2)


def choose_past(data: Lagged) -> tuple[int, bool]:
    """Window: twice the lags with the least corrected Akaike criterion (Bauer 2005: the window of a subspace method must outgrow the order's criterion).

    True beside the shortest window that predicts to rounding, where there is one: the record is noise-free. The errors of every lag stand in the one factor.
    """
    p, whole, best = data.p, np.sum(data.R[:, data.now_y] ** 2), (np.inf, 1)
    for past in range(1, data.past + 1):
        k = past * (data.m + p)
        errors = data.R[k:, data.now_y]
        if np.sum(errors**2) < NOISE_FREE * whole:
            return past, True
        count, numbers = p * k + p * (p + 1) / 2, data.rows * p
        if numbers > count + 1:
            criterion = data.rows * np.linalg.slogdet(errors.T @ errors / data.rows)[1] + 2 * count * numbers / (numbers - count - 1)
            best = min(best, (criterion, past))
    return min(2 * best[1], data.past), False


def choose_feedthrough(u: Segments, y: Segments, past: int, offset: bool) -> bool:
    """Whether Schwarz's criterion of the one-step predictor falls when u(t) is added to it."""
    criterion = []
    for feedthrough in (False, True):
        data = lagged(u, y, past, feedthrough=feedthrough, offset=offset)
        coefficients, errors = one_step(data, past)
        criterion.append(data.rows * np.linalg.slogdet(errors.T @ errors / data.rows)[1] + np.log(data.rows) * coefficients.size)
    return bool(criterion[1] < criterion[0])


def dead_time(plant: Plant, longest: int) -> tuple[int, ...]:
    """Samples, for each input, beyond the one that every strictly proper plant has, before any output answers with 5 % of its peak impulse response."""
    h = np.abs(markov_parameters(plant, 10 * longest))
    started = (h >= 0.05 * h.max(axis=0)).any(axis=1)
    return tuple(min(int(np.argmax(started[:, j])), longest) for j in range(plant.m))


def noise_edge(data: Lagged, past: int) -> float:
    """sqrt(2) (sqrt(past p) + sqrt(past (m+p))): above what the coefficients' error alone puts into the singular values.

    A matrix of independent unit noise of that shape stays under the bracket; here each error stands in up to `past` rows, which adds some tenth (measured).
    """
    return float(np.sqrt(2) * (np.sqrt(past * data.p) + np.sqrt(past * (data.m + data.p))))


def identify(
    u: Segments,
    y: Segments,
    *,
    sample_time_s: float,
    order: int | None = None,
    past: int | None = None,
    method: Literal["pbsid", "moesp"] = "pbsid",
    feedthrough: bool | None = False,
    offset: bool = True,
    refinement: Literal["none", "prediction", "simulation", "validated"] = "none",
    max_order: int = 12,
    blocks: int = 5,
) -> Identified:
    """The plant that a record shows, by the rules at the head of this module; u segments (T, m), y segments (T, p), NaN where a sample is masked.

    `refinement` "prediction" or "simulation" moves the subspace plant to the least errors of that kind; "validated" does so only where the left-out blocks prefer
    it by more than one standard error. `feedthrough` None lets the data decide. Works in closed loop, unless refined on simulation errors.
    Raises ValueError for a constant or collinear input, a record too short for the order, and shapes that do not agree.
    """
    u, y = [np.atleast_2d(a) for a in u], [np.atleast_2d(b) for b in y]
    _check_shapes(u, y)
    m, p = u[0].shape[1], y[0].shape[1]
    whole = sum(map(len, u))
    u, y = gapless(u, y)
    cut = whole - sum(map(len, u))
    _check_length(sum(len(w) for w in complete_runs(u, y)), order, m, p)
    check_inputs(u, offset=offset)
    notes = [f"{cut} samples with a masked input, or without any output, were cut out"] if cut else []
    longest = longest_window(u, y)
    exact = False
    if past is None:
        past, exact = choose_past(lagged(u, y, min(longest, 6), offset=offset))  # a few lags tell whether the record is noise-free
        past, exact = (past, exact) if exact else choose_past(lagged(u, y, longest, offset=offset))
    if feedthrough is None:
        feedthrough = choose_feedthrough(u, y, past, offset)
        notes.append(f"direct feed-through {'kept' if feedthrough else 'left out'} by Schwarz's criterion")
    data = lagged(u, y, past, feedthrough=feedthrough, offset=offset, exact=exact)
    sub, edge = subspace(data, past), noise_edge(data, past)
    settings = {"past": past, "feedthrough": feedthrough, "offset": offset}
    delays, kind, table = (0,) * m, "subspace" if refinement == "validated" else refinement.replace("none", "subspace"), []
    if exact:
        notes.append(f"the record is noise-free: {past} past samples predict it to rounding, and the order is a rank")
        order = order or int((sub.singular_values > EXACT_RANK * sub.singular_values[0]).sum())
    elif order is None or refinement == "validated":
        chosen, table = _choose(u, y, data, sub, edge, order, max_order, blocks, refinement == "validated", settings)
        order, delays, kind = chosen.order, chosen.delays, chosen.fit if refinement == "validated" else kind
    found = _fit_all(u, y, data, sub, edge, order, delays, kind, method, settings, sample_time_s, table, notes)
    return found._replace(dropped_rows=found.dropped_rows + cut)


def _choose(u, y, data, sub, edge, order, max_order, blocks, validated, settings) -> tuple[Candidate, list[Candidate]]:
    """The candidate that the rules take, and the table: orders and dead times of the subspace fit, then the refined fits of the winner."""
    m = data.m
    if order is None:
        largest = max(1, min(int((sub.singular_values > edge).sum()), max_order, len(sub.singular_values)))
        orders = range(1, largest + 1)
        delays = sorted({(0,) * m, dead_time(realise(data, sub.basis[:largest], 1.0), max(data.past // 2, 1))})
    else:
        orders, delays = [order], [(0,) * m]
    settings = settings | {"blocks": blocks, "singular_values": sub.singular_values}
    table = [row for d in delays for row in cross_validate(u, y, orders, d, ("subspace",), **settings)]
    chosen = simplest(table)
    if validated:
        refined = cross_validate(u, y, [chosen.order], chosen.delays, ("prediction", "simulation"), **settings)
        table += refined
        for row in sorted(refined, key=lambda row: row.error)[:1]:
            gain = np.subtract(chosen.errors, row.errors)
            chosen = row if gain.mean() > gain.std(ddof=1) / np.sqrt(len(gain)) else chosen
    return chosen, table


def _fit_all(u, y, data, sub, edge, order, delays, kind, method, settings, sample_time_s, table, notes) -> Identified:
    """One fit of the chosen model on all of the record."""
    rest = {"feedthrough": settings["feedthrough"], "offset": settings["offset"]}
    if order > len(sub.singular_values):
        raise ValueError(
            f"order {order} needs a longer window: {data.past} past samples give at most {len(sub.singular_values)} states; raise past"
        )
    us, ys = shifted(u, y, delays)
    if any(delays):
        data = lagged(us, ys, settings["past"], **rest)
        sub_delayed = subspace(data, data.past)
    else:
        sub_delayed = sub
    if method == "moesp":
        plant = moesp(us, ys, data.past, order, sample_time_s=sample_time_s, **rest)[0]
    else:
        plant = realise(data, sub_delayed.basis[:order], sample_time_s)
    plant = with_delays(fit(kind, plant, us, ys, max_iterations=30, **rest), delays)
    model = simulation_form(plant, [])
    x0 = [
        estimate_state(model, drives("simulation", a, np.nan_to_num(b)), b) if np.isfinite(a).all() else np.full(plant.n, np.nan)
        for a, b in zip(u, y, strict=True)
    ]
    if data.dropped_rows:
        notes.append(f"{data.dropped_rows} rows touch a masked sample and were left out of the fit")
    radius = float(np.abs(np.linalg.eigvals(plant.A)).max())
    if radius > 1:
        notes.append(
            f"the largest pole is at {radius:.5f}, outside the unit circle; refine with a limit, or record longer, before simulating far ahead"
        )
    return Identified(
        plant,
        order,
        data.past,
        delays,
        rest["feedthrough"],
        rest["offset"],
        kind,
        sub.singular_values,
        edge,
        table,
        x0,
        data.rows,
        data.dropped_rows,
        notes,
    )


def _check_shapes(u: Segments, y: Segments) -> None:
    if not u or len(u) != len(y):
        raise ValueError(f"identify: expected as many segments of u as of y, at least one, but found {len(u)} and {len(y)}")
    for k, (a, b) in enumerate(zip(u, y, strict=True)):
        if a.ndim != 2 or b.ndim != 2 or len(a) != len(b) or a.shape[1] != u[0].shape[1] or b.shape[1] != y[0].shape[1]:
            raise ValueError(
                f"identify: segment {k} has u of shape {a.shape} and y of shape {b.shape}; expected (T, {u[0].shape[1]}) and (T, {y[0].shape[1]})"
            )


def _check_length(samples: int, order: int | None, m: int, p: int) -> None:
    """As many complete samples as ten for each unknown of the smallest window that carries the order."""
    lags = max(2, -(-(order or 1) // p) + 1)
    needed = 10 * lags * (m + p)
    if samples < needed:
        raise ValueError(
            f"the record is too short for order {order or 1}: expected at least {needed} complete samples, found {samples}; record {needed - samples} samples more"
        )


def rows(found: Identified) -> dict[str, list]:
    """The table by which the order was chosen, as columns: every candidate, or the singular values alone where they decided."""
    tried = {row.order: row for row in found.order_table if row.fit == found.fit or row.order != found.order}
    shown = [k for k in range(1, len(found.singular_values) + 1) if k <= 30 or k in tried]
    return {
        "order": np.array(shown, np.int32),
        "singular_value": found.singular_values[np.array(shown) - 1],
        "noise_edge": np.full(len(shown), found.noise_edge),
        "parameters": [tried[k].parameters if k in tried else 0 for k in shown],
        "error": np.array([tried[k].error if k in tried else np.nan for k in shown]),
        "chosen": [k == found.order for k in shown],
    }
