"""From a record to a plant: window, dead time, feed-through, order and refinement chosen on the
identification data by stated rules, then one fit on all of it.

The rules, each with its reason:
window twice the lags of Akaike's criterion (corrected for few samples) over VARX models: long enough to
whiten; and Schwarz's lags, for records that say little feed-through with and without u(t), where
`feedthrough` is None and Schwarz's criterion of the one-step predictor prefers it largest order singular
values, in units of the noise, above what coefficient errors alone reach: sqrt(2) (sqrt(rows) + sqrt(columns))
of the noise matrix dead time none; the lags at which the largest model's impulse response stays under 5 % of
its peak; those under a quarter that Wald's test finds silent too order of all these, the fewest parameters
whose error in simulation of left-out blocks (geometric mean) is within 2 % of the best refinement where
`refinement` is "validated": prediction-error fits of the chosen model, where one takes more than 5 % off the
error on the left-out blocks; for simulation only where that beats prediction by a fifth
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from pipeline.temperature.order import (
    WORTH_REFINING,
    WORTH_THE_NOISE,
    Candidate,
    Structure,
    cross_validate,
    dead_time,
    feedthrough_shows,
    fit,
    longest_window,
    noise_edge,
    shifted,
    simplest,
    tested_dead_times,
    windows,
    with_delays,
)
from pipeline.temperature.plant import Plant
from pipeline.temperature.refinement import drives, estimate_state, simulation_form
from pipeline.temperature.subspace import Segments, complete_runs, gapless, lagged, realise, subspace

EXACT_RANK = 1e-7  # singular values of a noise-free record below this share of the largest are rounding


class Identified(NamedTuple):
    """An identified plant and how it was chosen. order: states without those of the delays; past: window;
    order_table: candidates with their errors.

    delays are the dead times in the plant, in samples for each input; silent marks
    inputs that no output answers. x0 has the initial state of each segment, or of
    each piece where masked inputs cut one (`gapless`).
    """

    plant: Plant
    order: int
    past: int
    delays: tuple[int, ...]
    silent: tuple[bool, ...]
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


def name_of(names: Sequence[str], letter: str, j: int) -> str:
    return names[j] if names else f"{letter}{j + 1}"


def check_outputs(y: Segments, *, names: Sequence[str] = ()) -> None:
    """Raises ValueError where an output never moves: no model of it is possible."""
    rows = np.vstack(y)
    for j in range(rows.shape[1]):
        seen = rows[np.isfinite(rows[:, j]), j]
        if seen.size == 0 or np.ptp(seen) <= 1e-12 * np.abs(seen).max():
            shown = f"{seen[0]:g} in every sample" if seen.size else "missing in every sample"
            raise ValueError(
                f"output {name_of(names, 'y', j)} is constant ({shown}), so no model of it is possible; "
                "check the sensor, or leave it out of plant.outputs"
            )


def check_inputs(u: Segments, *, offset: bool = True, names: Sequence[str] = ()) -> None:
    """Raises ValueError where an input is constant or a linear combination of the
    others: its column of B is then not identified."""
    rows = np.vstack(u)
    rows = rows[np.isfinite(rows).all(axis=1)]
    if not len(rows):
        raise ValueError(
            "no sample has all inputs, so no plant can be run over the record; "
            "check plant.inputs and the mapping"
        )
    largest = np.abs(rows).max(axis=0)
    rows = rows - rows.mean(axis=0) if offset else rows
    size = np.sqrt(np.mean(rows**2, axis=0))
    for j in range(rows.shape[1]):
        if size[j] <= max(1e-9 * largest[j], np.finfo(float).tiny):
            raise ValueError(
                f"input {name_of(names, 'u', j)} is constant, so its column of B is not identified; "
                "excite it, or leave it out of the inputs"
            )
    scaled = rows / size
    for j in range(1, rows.shape[1]):
        weights = np.linalg.lstsq(scaled[:, :j], scaled[:, j], rcond=None)[0]
        if np.linalg.norm(scaled[:, j] - scaled[:, :j] @ weights) < 1e-6 * np.linalg.norm(scaled[:, j]):
            others = ", ".join(name_of(names, "u", k) for k in range(j) if abs(weights[k]) > 1e-6)
            raise ValueError(
                f"input {name_of(names, 'u', j)} is a linear combination of {others}, "
                "so its column of B is not identified; move it independently, or leave it out"
            )


def within_limits(
    u: Segments, limits: tuple[Sequence[float], Sequence[float]], *, names: Sequence[str] = ()
) -> tuple[list[np.ndarray], list[str]]:
    """The inputs that the actuators could follow, min(max(u, low), high), and a
    sentence for each input that was asked beyond its limits.

    Clipping at a known limit loses nothing; masking the same samples would cut
    the record wherever the actuator stands at its stop.
    """
    low, high = (np.asarray(side, float) for side in limits)
    m, said = u[0].shape[1], []
    if low.shape != (m,) or high.shape != (m,) or not (low < high).all():
        raise ValueError(
            f"limits: expected {m} low and {m} high limits with low < high but found {low.tolist()} and "
            f"{high.tolist()}; give one pair for each input"
        )
    rows = np.vstack(u)
    for j in range(m):
        beyond = int(((rows[:, j] < low[j]) | (rows[:, j] > high[j])).sum())
        if beyond:
            said.append(
                f"{name_of(names, 'u', j)} was asked beyond {low[j]:g}..{high[j]:g} in {beyond} of "
                f"{len(rows)} samples: the limit is taken as its input there"
            )
    return [np.clip(a, low, high) for a in u], said


def identify(
    u: Segments,
    y: Segments,
    *,
    sample_time_s: float,
    order: int | None = None,
    past: int | None = None,
    feedthrough: bool | None = False,
    offset: bool = True,
    refinement: Literal["none", "prediction", "simulation", "validated"] = "none",
    max_order: int = 12,
    max_radius: float | None = None,
    blocks: int = 5,
    limits: tuple[Sequence[float], Sequence[float]] | None = None,
    names: Sequence[str] = (),
) -> Identified:
    """The plant that a record shows, by the rules at the head of this module; u segments (T, m), y segments
    (T, p), NaN where a sample is masked.

    PBSID makes the start, in innovation form. `refinement` "prediction" or "simulation" moves it to the least
    errors of that kind; "validated" does so only where the left-out blocks prefer it. `feedthrough` None lets
    the data decide. `limits` (low, high) of the actuators clip u; `max_radius` bounds every pole. Works in
    closed loop, unless refined on simulation errors. Raises ValueError for a constant or collinear input, a
    constant output, a record too short for the order, and shapes that do not agree.
    """
    u, y, cut, notes = _prepared(u, y, order, past, offset, limits, names)
    m = u[0].shape[1]
    pasts, exact = _windows(u, y, order, past, offset)
    direct = (feedthrough,)
    if feedthrough is None:
        direct = (False, True) if feedthrough_shows(u, y, pasts[0], offset) else (False,)
    structure, kind, table = (
        Structure(pasts[0], direct[-1], offset, (0,) * m),
        refinement.replace("none", "subspace"),
        [],
    )
    if exact:
        sub = subspace(lagged(u, y, pasts[0], feedthrough=direct[-1], offset=offset, exact=True), pasts[0])
        rank = max(int((sub.singular_values > EXACT_RANK * sub.singular_values[0]).sum()), 1)
        exact = (
            rank <= max_order
        )  # else no rank but a nonlinearity without noise, and the order is a choice as with noise
    if exact:
        notes.append(
            f"the record is noise-free: {pasts[0]} past samples predict it to rounding, "
            "and the order is a rank"
        )
        order, kind = order or rank, kind.replace("validated", "subspace")
    elif order is None or refinement == "validated":
        structures = [structure._replace(past=n, feedthrough=d) for n in pasts for d in direct]
        chosen, table = _choose(
            u,
            y,
            structures,
            order,
            max_order,
            refinement == "validated",
            {"blocks": blocks, "max_radius": max_radius},
        )
        order, structure, kind = (
            chosen.order,
            chosen.structure,
            chosen.fit if refinement == "validated" else kind,
        )
    if feedthrough is None:
        notes.append(
            f"direct feed-through {'kept' if structure.feedthrough else 'left out'} as the data prefer"
        )
    found = _fit_all(u, y, structure, exact, order, kind, sample_time_s, table, max_radius)
    return found._replace(dropped_rows=found.dropped_rows + cut, notes=notes + _remarks(found, names))


def refit(
    u: Segments,
    y: Segments,
    found: Identified,
    *,
    max_radius: float | None = None,
    limits: tuple[Sequence[float], Sequence[float]] | None = None,
    names: Sequence[str] = (),
) -> Identified:
    """What was chosen on a part of the record (window, feed-through, dead times, order, refinement) fitted to
    all of it, nothing chosen anew; as `identify` otherwise."""
    u, y, cut, notes = _prepared(u, y, found.order, found.past, found.offset, limits, names)
    structure = Structure(found.past, found.feedthrough, found.offset, found.delays)
    exact = (
        not found.order_table
        and windows(lagged(u, y, found.past, feedthrough=found.feedthrough, offset=found.offset))[1]
    )
    again = _fit_all(
        u,
        y,
        structure,
        exact,
        found.order,
        found.fit,
        found.plant.sample_time_s,
        found.order_table,
        max_radius,
    )
    return again._replace(dropped_rows=again.dropped_rows + cut, notes=notes + _remarks(again, names))


def _prepared(
    u, y, order, past, offset, limits, names
) -> tuple[list[np.ndarray], list[np.ndarray], int, list[str]]:
    """The record as it can be identified, checked: clipped at the limits, cut at masked inputs; how many
    samples that cost, and what was done, a sentence each."""
    u, y = [np.atleast_2d(np.asarray(a, float)) for a in u], [np.atleast_2d(np.asarray(b, float)) for b in y]
    _check_shapes(u, y)
    whole = sum(map(len, u))
    u, notes = within_limits(u, limits, names=names) if limits is not None else (u, [])
    u, y = gapless(u, y)
    cut = whole - sum(map(len, u))
    _check_length(u, y, order, past)
    check_inputs(u, offset=offset, names=names)
    check_outputs(y)
    return (
        u,
        y,
        cut,
        notes + ([f"{cut} samples with a masked input, or without any output, were cut out"] if cut else []),
    )


def _windows(u, y, order, past, offset) -> tuple[tuple[int, ...], bool]:
    """The windows to try, each long enough for the order asked, and whether the record is noise-free."""
    if past:
        return (past,), False
    longest = longest_window(u, y)
    pasts, exact = windows(
        lagged(u, y, min(longest, 6), offset=offset)
    )  # a few lags tell whether the record is noise-free
    if not exact:
        pasts, exact = windows(lagged(u, y, longest, offset=offset))
    least = -(-(order or 1) // y[0].shape[1])
    return tuple(sorted({max(n, least) for n in pasts}, reverse=True)), exact


def _choose(u, y, structures, order, max_order, validated, settings) -> tuple[Candidate, list[Candidate]]:
    """The candidate that the rules take, and the table: structures and orders of the
    subspace fit, then the refined fits of the winner."""
    table = []
    for structure in structures:
        data = lagged(u, y, structure.past, feedthrough=structure.feedthrough, offset=structure.offset)
        sub = subspace(data, structure.past)
        orders, delays, furthest = [order], {structure.delays}, max(data.past // 2, 1)
        if order is None:
            largest = max(
                1,
                min(
                    int((sub.singular_values > noise_edge(data, structure.past)).sum()),
                    max_order,
                    len(sub.singular_values),
                ),
            )
            orders = range(1, largest + 1)
            model = realise(data, sub.basis[:largest], 1.0)
            quiet = np.minimum(tested_dead_times(data, furthest)[0], dead_time(model, furthest, 0.25))
            delays |= {dead_time(model, furthest), tuple(quiet.tolist())}
        for d in sorted(delays):
            table += cross_validate(
                u,
                y,
                orders,
                structure._replace(delays=d),
                ("subspace",),
                singular_values=sub.singular_values,
                **settings,
            )
    if not table:
        raise ValueError(
            f"the record is too short to choose a model by leaving out one of {settings['blocks']} blocks: "
            f"{sum(map(len, u))} samples do not carry a window of"
            f" {structures[-1].past} without one; record longer, or give order and past"
        )
    chosen = simplest(table)
    if validated:
        known = {row.order: row.singular_value for row in table if row.structure == chosen.structure}
        values = np.array([known.get(n, np.nan) for n in range(1, chosen.order + 1)])
        refined = cross_validate(
            u,
            y,
            [chosen.order],
            chosen.structure,
            ("prediction", "simulation"),
            singular_values=values,
            **settings,
        )
        table += refined
        best = min(
            refined,
            key=lambda row: row.error * (1 - WORTH_THE_NOISE) ** (row.fit == "prediction"),
            default=chosen,
        )
        chosen = best if best.error < (1 - WORTH_REFINING) * chosen.error else chosen
    return chosen, table


def _fit_all(u, y, structure, exact, order, kind, sample_time_s, table, max_radius) -> Identified:
    """One fit of the chosen model on all of the record."""
    past, rest = structure.past, {"feedthrough": structure.feedthrough, "offset": structure.offset}
    us, ys = shifted(u, y, structure.delays)
    data = lagged(us, ys, past, **rest, exact=exact)
    sub = subspace(data, past)
    if order > len(sub.singular_values):
        raise ValueError(
            f"order {order} needs a longer window: {past} past samples give at most "
            f"{len(sub.singular_values)} states; raise past"
        )
    plant = realise(data, sub.basis[:order], sample_time_s)
    plant = with_delays(
        fit(kind, plant, us, ys, max_iterations=30, max_radius=max_radius, **rest), structure.delays
    )
    model = simulation_form(plant, [])
    return Identified(
        plant=plant,
        order=order,
        past=past,
        delays=structure.delays,
        silent=(False,) * plant.m if exact else tested_dead_times(data, past)[1],
        feedthrough=structure.feedthrough,
        offset=structure.offset,
        fit=kind,
        singular_values=sub.singular_values,
        noise_edge=noise_edge(data, past),
        order_table=table,
        x0=[estimate_state(model, drives("simulation", a, b), b) for a, b in zip(u, y, strict=True)],
        rows=data.rows,
        dropped_rows=data.dropped_rows,
        notes=[],
    )


def _remarks(found: Identified, names: Sequence[str]) -> list[str]:
    """What a user should know of the fit, a sentence each."""
    said = []
    if found.dropped_rows:
        said.append(f"{found.dropped_rows} rows touch a masked sample and were left out of the fit")
    said += [
        f"dead time of {name_of(names, 'u', j)}: {delay} samples beyond the one of sampling"
        for j, delay in enumerate(found.delays)
        if delay
    ]
    said += [
        f"no output answers {name_of(names, 'u', j)} (99.9 %): leave it out, or excite it more"
        for j in range(found.plant.m)
        if found.silent[j]
    ]
    determined = int((found.singular_values > found.noise_edge).sum())
    if found.order > max(determined, 1) and not found.order_table:
        said.append(
            f"order {found.order} was asked but the record determines {determined} states above its noise; "
            "the others fit noise"
        )
    radius = float(np.abs(np.linalg.eigvals(found.plant.A)).max())
    if radius > 1:
        said.append(
            f"the largest pole is at {radius:.5f}, outside the unit circle; refine with a limit, "
            "or record longer, before simulating far ahead"
        )
    return said


def _check_shapes(u: Segments, y: Segments) -> None:
    if not u or len(u) != len(y):
        raise ValueError(
            f"identify: expected as many segments of u as of y, at least one, but found {len(u)} and {len(y)}"
        )
    for k, (a, b) in enumerate(zip(u, y, strict=True)):
        if (
            a.ndim != 2
            or b.ndim != 2
            or len(a) != len(b)
            or a.shape[1] != u[0].shape[1]
            or b.shape[1] != y[0].shape[1]
            or 0 in (a.shape[1], b.shape[1])
        ):
            raise ValueError(
                f"identify: segment {k} has u of shape {a.shape} and y of shape {b.shape}; "
                f"expected (T, {u[0].shape[1]}) and (T, {y[0].shape[1]}), one column at least"
            )


def _check_length(u: Segments, y: Segments, order: int | None, past: int | None) -> None:
    """Six complete samples for each unknown of the smallest window that carries the order, and as many
    unbroken windows as there are unknowns."""
    if not u:
        raise ValueError(
            "the record is empty: no sample has all inputs beside at least one output; check the mapping, "
            "and what was masked"
        )
    p, q = y[0].shape[1], u[0].shape[1] + y[0].shape[1]
    lags = max(2, -(-(order or 1) // p) + 1)
    lengths = np.array([len(w) for w in complete_runs(u, y)])
    needed, samples = 6 * lags * q, int(lengths.sum())
    if samples < needed:
        raise ValueError(
            f"the record is too short for order {order or 1}: expected at least {needed} complete samples, "
            f"found {samples}; record {needed - samples} samples more"
        )
    lags = past or lags
    windows, unknowns = int(np.maximum(lengths - lags, 0).sum()), (lags + 1) * q + 1
    if windows < unknowns:
        raise ValueError(
            f"the segments are too short for a window of {lags} samples: "
            f"the longest complete stretch has {lengths.max()}, and {windows} windows do not determine"
            f" {unknowns} unknowns; record longer without gaps"
        )


def rows(found: Identified) -> dict[str, list]:
    """The table by which the order was chosen, as columns: every candidate,
    or the singular values alone where they decided."""
    structure = Structure(found.past, found.feedthrough, found.offset, found.delays)
    shown_rows = [row for row in found.order_table if row.structure == structure]
    tried = {row.order: row for row in shown_rows if row.fit == found.fit or row.order != found.order}
    shown = [k for k in range(1, len(found.singular_values) + 1) if k <= 30 or k in tried]
    return {
        "order": np.array(shown, np.int32),
        "singular_value": found.singular_values[np.array(shown) - 1],
        "noise_edge": np.full(len(shown), found.noise_edge),
        "parameters": [tried[k].parameters if k in tried else 0 for k in shown],
        "error": np.array([tried[k].error if k in tried else np.nan for k in shown]),
        "chosen": [k == found.order for k in shown],
    }
