"""Chooses a plant model from a record. Stated rules choose window, dead time, feed-through, order and
refinement together. Candidates are compared on data left out of the identification: blocks, or whole
recordings if there are several. The chosen model is then fitted once to all of the record.

The rules, with their reasons:

window: Twice the lags of Akaike's criterion (corrected for few samples) over VARX models, long enough to
    whiten the errors. Schwarz's lags are tried too, for records with little information. So is a window that
    spans the slowest mode of the longest one's model, if it is at least 1.5 times as long.
closed loop: Detected by `closed_loop`. PBSID and prediction-error fits stay consistent there. Fits to
    simulated outputs do not, so they are not tried. Candidates are also judged one step ahead.
feed-through: If `feedthrough` is None, models with and without u(t) are tried for the outputs whose one-step
    predictor is better with u(t) by Schwarz's criterion. In closed loop there is no feed-through, because a
    row of D would be the controller's inverse.
drift: Unrecorded slow changes become a state that hardly decays, identified with the rest of the order. For
    forecasts, a random walk is added to each output (`drift`) if the left-out blocks prefer it.
largest order: The number of singular values, in units of the noise, above the level that coefficient errors
    alone reach: sqrt(2) (sqrt(rows) + sqrt(columns)) of the noise matrix.
dead time: Three candidates: none; the lags at which the largest model's impulse response stays under 5 % of
    its peak; and the lags under 25 % of the peak that Wald's test finds silent too.
order: The fewest parameters whose error is within 2 % of the best. The error is that of
    simulating left-out blocks (geometric mean).
refinement: If `refinement` is "validated", the best candidates of the structures are refined by
    prediction-error fits. A refined fit is taken if it lowers the error on the left-out blocks by more than
    5 %, and the error about their means beyond chance (Student's t). A fit to simulated outputs is taken
    only if its error is at least a fifth below that of the fit to one-step predictions.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from pipeline.temperature.identification.closed_loop import ClosedLoop, closed_loop
from pipeline.temperature.identification.drift import chosen_rate
from pipeline.temperature.identification.order import (
    WORK,
    WORTH_THE_NOISE,
    Fit,
    ModelStructure,
    OrderCandidate,
    Validation,
    cross_validate,
    dead_time,
    feedthrough_shows,
    fit,
    longest_window,
    noise_edge,
    shifted,
    simplest,
    slow_window,
    tested_dead_times,
    windows,
    with_delays,
    worth_refining,
)
from pipeline.temperature.identification.refinement import (
    FitSettings,
    drives,
    estimate_state,
    simulation_form,
)
from pipeline.temperature.identification.subspace import (
    Lagged,
    Segments,
    complete_runs,
    gapless,
    lagged,
    realise,
    subspace,
)
from pipeline.temperature.plant import Plant

EXACT_RANK = 1e-7  # singular values of a noise-free record below this share of the largest are rounding


class Identified(NamedTuple):
    """An identified plant and how it was chosen. order: states without those of the delays; past: window in
    samples; order_table: candidates with their errors.

    delays: dead times in the plant, in samples for each input; silent: inputs that no output answers;
    feedthrough: outputs with a row of D. drift: rate per sample of a random walk beside the outputs, 0 for
    none. x0: initial state of each segment, or of each piece if masked inputs cut a segment (`gapless`).
    """

    plant: Plant
    order: int
    past: int
    delays: tuple[int, ...]
    silent: tuple[bool, ...]
    feedthrough: tuple[bool, ...]
    offset: bool
    fit: str
    singular_values: np.ndarray
    noise_edge: float
    order_table: list[OrderCandidate]
    x0: list[np.ndarray]
    rows: int
    dropped_rows: int
    notes: list[str]
    feedback: ClosedLoop | None = None
    drift: float = 0.0
    reasons: tuple[str, ...] = ()  # notes on the choice; they are among `notes` too


class Settings(NamedTuple):
    """The settings of `identify`. None leaves order, window `past` and feed-through to the data.

    `refinement` "prediction" or "simulation" refines the plant to the smallest errors of that kind.
    "validated" does so only if the left-out `blocks` prefer it. `recordings` labels the segments: if there
    are several recordings, whole ones are left out. The first `inputs` columns of u are moved by people or
    controllers (all columns if None); the others are measured disturbances.
    """

    order: int | None = None
    past: int | None = None
    feedthrough: bool | None = None
    offset: bool = True
    refinement: Literal["none", "prediction", "simulation", "validated"] = "none"
    max_order: int = 12
    blocks: int = 5
    recordings: tuple[int, ...] = ()
    inputs: int | None = None


DEFAULTS = Settings()


class ModelChoice(NamedTuple):
    """The model class of the one fit to all of the record. `exact`: the record is noise-free; `table`: the
    candidates that were compared."""

    structure: ModelStructure
    order: int
    fit: Fit
    exact: bool
    table: list[OrderCandidate]


def name_of(names: Sequence[str], letter: str, j: int) -> str:
    return names[j] if names else f"{letter}{j + 1}"


def check_outputs(y: Segments, *, names: Sequence[str] = ()) -> None:
    """Raises ValueError if an output never changes, because no model of it is possible."""
    rows = np.vstack(y)
    for j in range(rows.shape[1]):
        values = rows[np.isfinite(rows[:, j]), j]
        if values.size == 0 or np.ptp(values) <= 1e-12 * np.abs(values).max():
            shown = f"{values[0]:g} in every sample" if values.size else "missing in every sample"
            raise ValueError(
                f"output {name_of(names, 'y', j)} is constant ({shown}), so no model of it is possible; "
                "check the sensor, or leave it out of plant.outputs"
            )


def check_inputs(u: Segments, *, offset: bool = True, names: Sequence[str] = ()) -> None:
    """Raises ValueError if no sample has all inputs, or if an input is constant or a linear combination of
    the others: its column of B is then not identified."""
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
    """Returns the inputs that the actuators could follow, min(max(u, low), high), and a sentence for each
    input whose commands exceed its limits by more than a millionth of their range. Less than that is rounding
    of a scale.

    Clipping at a known limit loses nothing. Masking the same samples would cut the record wherever the
    actuator is at its limit.
    """
    (low, high), notes = (np.asarray(side, float) for side in limits), []
    rows, rounding = np.vstack(u), 1e-6 * (high - low)
    for j in range(len(low)):
        beyond = int(((rows[:, j] < low[j] - rounding[j]) | (rows[:, j] > high[j] + rounding[j])).sum())
        if beyond:
            notes.append(
                f"{name_of(names, 'u', j)} was asked beyond {low[j]:g}..{high[j]:g} in {beyond} of "
                f"{len(rows)} samples: the limit is taken as its input there"
            )
    return [np.clip(a, low, high) for a in u], notes


def identify(
    u: Segments,
    y: Segments,
    *,
    sample_time_s: float,
    settings: Settings = DEFAULTS,
    names: Sequence[str] = (),
) -> Identified:
    """Identifies the plant from a record, by the rules at the head of this module. `u`: segments (T, m); `y`:
    segments (T, p); a masked sample is NaN.

    Starts with PBSID, in innovation form. It works in closed loop, unless the plant is refined on simulation
    errors. Raises ValueError if an input is constant or collinear, an output is constant, or the record is
    too short for the order.
    """
    u, y, recordings, cut = _prepared(u, y, settings, names)
    choice, reasons, validation, feedback = _chosen(u, y, recordings, settings)
    fitted = _fit_all(u, y, choice, sample_time_s)
    rate = 0.0
    if choice.table:
        rate = chosen_rate(u, y, choice.structure, choice.order, choice.fit, validation)
    fitted = fitted._replace(feedback=feedback, drift=rate, reasons=tuple(reasons))
    return _remarked(fitted, cut, names)


def refit(u: Segments, y: Segments, identified: Identified, *, names: Sequence[str] = ()) -> Identified:
    """Fits the model chosen on a part of the record (window, feed-through, dead times, order, refinement) to
    all of it. Chooses nothing anew. Otherwise like `identify`."""
    past, offset, table = identified.past, identified.offset, identified.order_table
    settings = Settings(order=identified.order, past=past, offset=offset)
    u, y, _, cut = _prepared(u, y, settings, names)
    structure = ModelStructure(past, identified.feedthrough, offset, identified.delays)
    direct = any(structure.feedthrough)
    exact = not table and windows(lagged(u, y, past, feedthrough=direct, offset=offset))[1]
    choice = ModelChoice(structure, identified.order, identified.fit, exact, table)
    fitted = _fit_all(u, y, choice, identified.plant.sample_time_s)
    fitted = fitted._replace(feedback=identified.feedback, drift=identified.drift, reasons=identified.reasons)
    return _remarked(fitted, cut, names)


def _prepared(
    u: Segments, y: Segments, settings: Settings, names: Sequence[str]
) -> tuple[list[np.ndarray], list[np.ndarray], tuple[int, ...], int]:
    """Returns the record u, y, checked and cut at masked inputs; the recording of each piece; and how many
    samples were left out."""
    u, y = [np.atleast_2d(np.asarray(a, float)) for a in u], [np.atleast_2d(np.asarray(b, float)) for b in y]
    samples = sum(map(len, u))
    pieces = [gapless([a], [b]) for a, b in zip(u, y, strict=True)]
    labels = settings.recordings or (0,) * len(u)
    recordings = tuple(label for label, (a, _) in zip(labels, pieces, strict=True) for _ in a)
    u, y = [a for piece, _ in pieces for a in piece], [b for _, piece in pieces for b in piece]
    cut = samples - sum(map(len, u))
    _check_length(u, y, settings.order, settings.past)
    check_inputs(u, offset=settings.offset, names=names)
    check_outputs(y)
    return u, y, recordings, cut


def _chosen(
    u: Segments, y: Segments, recordings: tuple[int, ...], settings: Settings
) -> tuple[ModelChoice, list[str], Validation, ClosedLoop | None]:
    """Returns the choice made by the rules; a sentence for each choice that a user should know; how
    candidates were judged; and whether the inputs respond to the outputs (None for a noise-free record)."""
    pasts, exact = _windows(u, y, settings.order, settings.past, settings.offset)
    none = (False,) * y[0].shape[1]
    feedback = None if exact else closed_loop(u, y, pasts[0], offset=settings.offset, inputs=settings.inputs)
    closed = feedback is not None and feedback.closed
    direct = [(bool(settings.feedthrough),) * len(none)]
    if settings.feedthrough is None:
        # under feedback, u(t) contains the noise of y(t), so a row of D would be the controller's inverse
        shows = none if closed else feedthrough_shows(u, y, pasts[0], settings.offset)
        direct = [none, shows] if any(shows) else [none]
    structure = ModelStructure(pasts[0], direct[-1], settings.offset, (0,) * u[0].shape[1])
    choice = ModelChoice(
        structure, settings.order, settings.refinement.replace("none", "subspace"), False, []
    )
    validated, notes = settings.refinement == "validated", []
    validation = Validation(settings.blocks, recordings, closed)
    # a rank beyond max_order shows a nonlinearity without noise; the order is then chosen as with noise
    if exact and (rank := _exact_rank(u, y, structure)) <= settings.max_order:
        notes.append(
            f"the record is noise-free: {pasts[0]} past samples predict it to rounding, "
            "and the order is a rank"
        )
        kind = choice.fit.replace("validated", "subspace")
        choice = ModelChoice(structure, settings.order or rank, kind, True, [])
    elif settings.order is None or validated:
        structures = [structure._replace(past=n, feedthrough=d) for n in pasts for d in direct]
        best, table = _best_candidate(u, y, structures, settings, validation)
        choice = ModelChoice(best.structure, best.order, best.fit if validated else choice.fit, False, table)
    return choice, notes + _reasons(choice, direct, closed), validation, feedback


def _reasons(choice: ModelChoice, direct: list[tuple[bool, ...]], closed: bool) -> list[str]:
    """Returns a sentence on feed-through and one on feedback, if the record raises the question."""
    notes = []
    if len(direct) > 1:
        rows = sum(choice.structure.feedthrough)
        verb = f"kept in {rows} of {len(direct[0])} outputs" if rows else "left out"
        notes.append(f"direct feed-through {verb}, as the left-out blocks prefer")
    if closed:
        notes.append(
            "the record was taken in closed loop (inputs follow past errors of the outputs): candidates are "
            "judged one step ahead too, without feed-through and without fits to simulated outputs, which "
            "feedback biases; it flatters the hold-out fit of a simulation as well"
        )
    return notes


def _exact_rank(u: Segments, y: Segments, structure: ModelStructure) -> int:
    """Returns the order of a noise-free record: the number of singular values above rounding, at least 1."""
    data = lagged(
        u, y, structure.past, feedthrough=any(structure.feedthrough), offset=structure.offset, exact=True
    )
    _, values = subspace(data, structure.past)
    return max(int((values > EXACT_RANK * values[0]).sum()), 1)


def _windows(u, y, order, past, offset) -> tuple[tuple[int, ...], bool]:
    """Returns the windows to try, each long enough for the requested order, and whether the record is
    noise-free."""
    if past:
        return (past,), False
    longest = longest_window(u, y)
    # a few lags may already show that the record is noise-free
    pasts, exact = windows(lagged(u, y, min(longest, 6), offset=offset))
    if not exact:
        pasts, exact = windows(lagged(u, y, longest, offset=offset))
    least = -(-(order or 1) // y[0].shape[1])
    return tuple(sorted({max(n, least) for n in pasts}, reverse=True)), exact


def _best_candidate(
    u: Segments, y: Segments, structures: list[ModelStructure], settings: Settings, validation: Validation
) -> tuple[OrderCandidate, list[OrderCandidate]]:
    """Returns the candidate that the rules choose, and the table: structures and orders of the subspace fit,
    then refined fits of the best candidate of each structure, as many as `WORK` allows."""
    singular_values, table = {}, []
    structures = _with_slow_window(u, y, structures, settings)
    for structure in structures:
        data = lagged(u, y, structure.past, feedthrough=any(structure.feedthrough), offset=structure.offset)
        basis, values = subspace(data, structure.past)
        singular_values[structure.past, structure.feedthrough] = values
        orders, delays = _candidates(data, basis, values, structure, settings)
        for d in sorted(delays):
            delayed = structure._replace(delays=d)
            table += cross_validate(
                u, y, orders, delayed, ("subspace",), singular_values=values, validation=validation
            )
    if not table and validation.recordings:
        # the record without one recording is too short, so blocks of every recording are used instead
        return _best_candidate(u, y, structures, settings, validation._replace(recordings=()))
    if not table:
        raise ValueError(
            f"the record is too short to choose a model by leaving out one of {validation.blocks} blocks: "
            f"{sum(map(len, u))} samples do not carry a window of"
            f" {structures[-1].past} without one; record longer, or give order and past"
        )
    if settings.refinement != "validated":
        return simplest(table), table
    # a fit to simulated outputs would mistake feedback in u for an effect of u
    kinds: tuple[Fit, ...] = ("prediction",) if validation.closed else ("prediction", "simulation")
    entrants = []
    for start in _shortlist(u, table):
        values = singular_values[start.structure.past, start.structure.feedthrough]
        refined: list[OrderCandidate] = []
        for kind in kinds:
            # on a long record the second fit, which must win by a fifth, is tried if the first is no gain
            if refined and _work(u, start) > WORK / 20 and _better_fit(start, refined) is not start:
                break
            refined += cross_validate(
                u, y, [start.order], start.structure, (kind,), singular_values=values, validation=validation
            )
        table += refined
        entrants.append(_better_fit(start, refined))
    return simplest(entrants), table


def _with_slow_window(
    u: Segments, y: Segments, structures: list[ModelStructure], settings: Settings
) -> list[ModelStructure]:
    """Returns the structures, and copies with a window that spans the slowest mode of the longest structure's
    model, if that window is at least 1.5 times as long. One-step criteria stop at a window beyond which a
    slow mode gains them nothing."""
    first = max(structures, key=lambda structure: structure.past)
    if settings.past:
        return structures
    data = lagged(u, y, first.past, feedthrough=any(first.feedthrough), offset=first.offset)
    basis, values = subspace(data, first.past)
    determined = max(1, min(int((values > noise_edge(data, first.past)).sum()), settings.max_order))
    model = realise(data, basis[:determined], 1.0, first.feedthrough)
    past = slow_window(model, longest_window(u, y))
    if past < 1.5 * first.past:
        return structures
    longer = {structure.feedthrough: structure._replace(past=past) for structure in structures}
    return [*longer.values(), *structures]


def _shortlist(u: Segments, table: list[OrderCandidate]) -> list[OrderCandidate]:
    """Returns the best candidate of each structure, the best one first: as many as `WORK` allows, but at
    least one. Candidates whose error is 1.5 times the lowest or more are left out."""
    of: dict[ModelStructure, list[OrderCandidate]] = {}
    for row in table:
        of.setdefault(row.structure, []).append(row)
    first = simplest(table)
    best = sorted((simplest(rows) for rows in of.values()), key=lambda row: row.error)
    others = [row for row in best if row != first and row.error < 1.5 * best[0].error]
    taken, work = [], 0.0
    for row in [first, *others]:
        work += _work(u, row)
        if taken and work > WORK:
            break
        taken.append(row)
    return taken


def _work(u: Segments, row: OrderCandidate) -> float:
    """Returns the cost of one step of refinement, in multiplications."""
    return float(sum(map(len, u))) * (row.order * (row.order + u[0].shape[1])) ** 2


def _better_fit(start: OrderCandidate, refined: list[OrderCandidate]) -> OrderCandidate:
    """Returns the subspace candidate, or the best of its refined fits that are worth their cost."""
    return min(
        (row for row in refined if worth_refining(start, row)),
        key=lambda row: row.error * (1 - WORTH_THE_NOISE) ** (row.fit == "prediction"),
        default=start,
    )


def _candidates(
    data: Lagged, basis: np.ndarray, values: np.ndarray, structure: ModelStructure, settings: Settings
) -> tuple[Sequence[int], set[tuple[int, ...]]]:
    """Returns orders and dead times worth trying: the requested order, or those that stand out of the
    noise."""
    delays = {structure.delays}
    if settings.order is not None:
        return [settings.order], delays
    above_noise = int((values > noise_edge(data, structure.past)).sum())
    largest = max(1, min(above_noise, settings.max_order, len(values)))
    furthest = max(data.past // 2, 1)
    model = realise(data, basis[:largest], 1.0, structure.feedthrough)
    quiet = np.minimum(tested_dead_times(data, furthest)[0], dead_time(model, furthest, 0.25))
    return range(1, largest + 1), delays | {dead_time(model, furthest), tuple(quiet.tolist())}


def _fit_all(u: Segments, y: Segments, choice: ModelChoice, sample_time_s: float) -> Identified:
    """Fits the chosen model once to all of the record."""
    structure, order, kind, exact, table = choice
    past, settings = structure.past, FitSettings(structure.feedthrough, structure.offset, max_iterations=30)
    us, ys = shifted(u, y, structure.delays)
    data = lagged(us, ys, past, feedthrough=any(structure.feedthrough), offset=structure.offset, exact=exact)
    basis, singular_values = subspace(data, past)
    if order > len(singular_values):
        raise ValueError(
            f"order {order} needs a longer window: {past} past samples give at most "
            f"{len(singular_values)} states; raise past"
        )
    start = realise(data, basis[:order], sample_time_s, structure.feedthrough)
    plant = with_delays(fit(kind, start, us, ys, settings), structure.delays)
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
        singular_values=singular_values,
        noise_edge=noise_edge(data, past),
        order_table=table,
        x0=[estimate_state(model, drives("simulation", a, b), b) for a, b in zip(u, y, strict=True)],
        rows=data.rows,
        dropped_rows=data.dropped_rows,
        notes=[],
    )


def _remarked(fitted: Identified, cut: int, names: Sequence[str]) -> Identified:
    """Returns the fit with a sentence for each thing that a user should know; `cut` samples were left out."""
    remark = f"{cut} samples with a masked input, or without any output, were cut out"
    notes = [*([remark] if cut else []), *fitted.reasons]
    if fitted.dropped_rows:
        notes.append(f"{fitted.dropped_rows} rows touch a masked sample and were left out of the fit")
    notes += [
        f"dead time of {name_of(names, 'u', j)}: {delay} samples beyond the one of sampling"
        for j, delay in enumerate(fitted.delays)
        if delay
    ]
    notes += [
        f"no output answers {name_of(names, 'u', j)} (99.9 %): leave it out, or excite it more"
        for j in range(fitted.plant.m)
        if fitted.silent[j]
    ]
    if fitted.drift:
        notes.append(
            f"what is not recorded drifts: a level beside each output, tracked over {1 / fitted.drift:.0f} "
            "samples, foretells left-out blocks better; it serves forecasts, and controllers do not get it"
        )
    determined = int((fitted.singular_values > fitted.noise_edge).sum())
    if fitted.order > max(determined, 1) and not fitted.order_table:
        notes.append(
            f"order {fitted.order} was asked but the record determines {determined} states above its noise; "
            "the others fit noise"
        )
    radius = float(np.abs(np.linalg.eigvals(fitted.plant.A)).max())
    if radius > 1:
        notes.append(
            f"the largest pole is {radius - 1:.2g} outside the unit circle; refine with a limit, "
            "or record longer, before simulating far ahead"
        )
    return fitted._replace(dropped_rows=fitted.dropped_rows + cut, notes=notes)


def _check_length(u: Segments, y: Segments, order: int | None, past: int | None) -> None:
    """Checks for six complete samples per unknown of the smallest window that carries the order, and for as
    many unbroken windows as unknowns. Raises ValueError if there are fewer."""
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


def rows(identified: Identified) -> dict[str, list]:
    """Returns the table from which the order was chosen, as columns: every candidate, or only the singular
    values if they decided."""
    structure = ModelStructure(identified.past, identified.feedthrough, identified.offset, identified.delays)
    shown_rows = [row for row in identified.order_table if row.structure == structure]
    tried = {
        row.order: row for row in shown_rows if row.fit == identified.fit or row.order != identified.order
    }
    orders = [k for k in range(1, len(identified.singular_values) + 1) if k <= 30 or k in tried]
    return {
        "order": np.array(orders, np.int32),
        "singular_value": identified.singular_values[np.array(orders) - 1],
        "noise_edge": np.full(len(orders), identified.noise_edge),
        "parameters": [tried[k].parameters if k in tried else 0 for k in orders],
        "error": np.array([tried[k].error if k in tried else np.nan for k in orders]),
        "chosen": [k == identified.order for k in orders],
    }
