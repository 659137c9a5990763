"""Measures a controller on its record, for its certificate. There are three questions, in the declared order
of certificate.RULES: is the record of this machine, is the evidence sufficient, and would the controller
work? certificate.py then compares the results with the limits.

Evidence: names, units, sample time and limits of the record must be the machine's. The record needs enough
samples, inputs that move independently, and references within its range. The controller's model must explain
its newest part.

Loop: poles and margins over the model, its spread, and window models of resampled blocks of the record
(bands.py); the same for the newest part alone, the machine as it is now; and the worst of at least 1,000
sampled plants with the controller as deployed.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from pipeline.deploy import bands
from pipeline.deploy.certificate import (
    LOOP,
    VERSION,
    Certificate,
    EvidenceRecord,
    MeasuredController,
    RuleResult,
    Rules,
    Segments,
    at_least,
    at_most,
    result,
)
from pipeline.deploy.machine import controller_sha256
from pipeline.deploy.supervise import Exported, Machine
from pipeline.temperature.controllers.law import Deployed, Plant
from pipeline.temperature.controllers.window import learn, observer_form, predictor
from pipeline.temperature.identification.validation import one_step_errors, predicted_ahead
from pipeline.temperature.plant import strictly_proper
from pipeline.temperature.test_set import panel, scorecard
from pipeline.temperature.tracking import robust_observer_gain

NEWEST = 0.25  # fraction at the end of a single recording that represents the machine as it is today
SHORTEST = 100  # least samples of a piece between two missing ones
REACH = 0.25  # of the recorded span, beyond which no reference is certified
COOLEST = 0.05  # quantile of the recorded temperatures


def cut_at_missing(
    u: Sequence[np.ndarray], y: Sequence[np.ndarray], recordings: Sequence[int]
) -> tuple[list[np.ndarray], list[np.ndarray], list[int]]:
    """Returns the pieces (T, m), (T, p) and the recording of each, cut where a sample of an output is missing
    (NaN). Pieces shorter than SHORTEST samples are left out."""
    parts = [
        (inputs[run], outputs[run], number)
        for inputs, outputs, number in zip(u, y, recordings, strict=True)
        for run in np.ma.clump_unmasked(np.ma.masked_invalid(outputs.sum(axis=1)))
        if run.stop - run.start >= min(SHORTEST, len(outputs))
    ]
    return [a for a, _, _ in parts], [b for _, b, _ in parts], [number for *_, number in parts]


def split_newest(
    u: Sequence[np.ndarray], y: Sequence[np.ndarray], recordings: Sequence[int]
) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """Returns u, y, newest u, newest y. Takes pieces (T, m), (T, p) without missing samples, and the
    recording of each. The newest pieces are those of the last recording; if there is only one, the last
    quarter of its longest piece."""
    pieces, new = list(zip(u, y, strict=True)), [number == recordings[-1] for number in recordings]
    if all(new):
        longest = max(range(len(pieces)), key=lambda i: len(pieces[i][0]))
        a, b = pieces[longest]
        cut = round((1 - NEWEST) * len(a))
        pieces[longest : longest + 1] = [(a[:cut], b[:cut]), (a[cut:], b[cut:])]
        new = [i == longest + 1 for i in range(len(pieces))]
    learned, newest = (
        [piece for piece, flag in zip(pieces, new, strict=True) if flag == wanted] for wanted in (False, True)
    )
    return [a for a, _ in learned], [b for _, b in learned], [a for a, _ in newest], [b for _, b in newest]


def require(half: panel.Cases, record: EvidenceRecord, settled: int, plants: int, resamples: int) -> Rules:
    """Returns how each controller is measured: on the constant references of the judging half that the record
    reaches, starting where the record is coolest. References further away were only simulated. If the record
    reaches none, all are taken, and the certificate is refused."""
    constants = sorted({int(half.asked[row, 0]) for row in np.flatnonzero(half.kind == "constant")})
    references = np.array([half.references[index].H[:, 0] for index in constants])
    y = np.concatenate([*record.y, *record.newest_y])
    low, high = y.min(axis=0), y.max(axis=0)
    near = (references >= low - REACH * (high - low)) & (references <= high + REACH * (high - low))
    return Rules(
        references=references[near.all(axis=1)] if near.all(axis=1).any() else references,
        start=np.quantile(y, COOLEST, axis=0),
        steps=half.steps // 2,
        settled=min(settled, half.steps // 4),
        plants=plants,
        resamples=resamples,
    )


def measure(
    exported: Exported,
    family: Sequence[Plant],
    record: EvidenceRecord,
    rules: Rules,
    models: WindowModels,
    rng: np.random.Generator,
    *,
    learning: bands.GainRoute | None = None,
    delay_share: float = 1.0,
    conditions: str = "",
) -> MeasuredController:
    """Returns what the certificate of a controller states before its limits are known.

    `family`: spread of the identified plant; `models`: what window_models drew from the record with `rng`,
    which is copied; `learning`: how gains were learned from the record, and if given, bands of them are
    measured; `delay_share`: fraction of a declared delay margin that is required of this machine;
    `conditions`: the certificate's sentence.
    """
    rng = copy.deepcopy(rng)
    results = of_signals(exported, record, rules)
    figures, fields = {}, {}
    draft = _draft(exported, record)._replace(conditions=conditions)
    if not all(one.passed for one in results):
        return MeasuredController(draft._replace(rules=tuple(results)), {})
    results = [*results, *models.results]
    if models.noise_degC is not None:
        names = [one.name for one in exported.machine.outputs]
        noise_degC = models.noise_degC.tolist()
        figures["noise"] = {
            "degC": noise_degC, "outputs": names, "settled": rules.settled, "limit": rules.noise
        }  # fmt: skip
        if models.of_newest is None:
            results.append(no_newest(record, rules))
    with np.errstate(all="ignore"):  # what diverges is a finding
        if models.of_record is not None and models.of_newest is not None:
            unexplained, more = of_newest(exported, record, models.of_newest, rules)
            results, figures = [*results, unexplained], figures | more
            if all(one.passed for one in results):
                fields, loop, more = of_loop(exported, family, models.of_record, models.of_newest, rules, rng)
                results, figures = [*results, *loop], figures | more
                figures["delay_margin"]["share"] = delay_share
                if learning is not None:
                    fields["bands"] = gain_bands(exported, record, learning, rules, rng)
    return MeasuredController(draft._replace(rules=tuple(results), **fields), figures)


def _draft(exported: Exported, record: EvidenceRecord) -> Certificate:
    return Certificate(
        VERSION,
        LOOP,
        exported.name,
        controller_sha256(exported),
        exported.plant_sha256,
        exported.spread_sha256,
        "simulated" if exported.simulated else "recorded",
        float(exported.machine.sample_time_s),
        exported.machine.inputs,
        exported.machine.outputs,
        (sum(map(len, record.u)), sum(map(len, record.newest_u))),
        poles=(),
        margins=None,
        worst=None,
        violations=(),
        bands=None,
        rules=(),
        verdict="refused",
        first_failed=None,
        conditions="",
    )


# ---- is the record of this machine?

LAGS = 5  # of errors and inputs from which a coloured error could have been predicted
# fraction of the largest allowed command; a record that never exceeds it is in another unit (0..1)
SCALE = 0.015


def of_signals(exported: Exported, record: EvidenceRecord, rules: Rules) -> list[RuleResult]:
    machine = exported.machine
    pairs = [*zip(machine.inputs, record.inputs, strict=False)]
    pairs += [*zip(machine.outputs, record.outputs, strict=False)]
    names = [[one.name for one in (*of.inputs, *of.outputs)] for of in (machine, record)]
    wrong = [f"{a} is recorded as {b}" for a, b in zip(*names, strict=False) if a != b]
    if len(names[0]) != len(names[1]):
        wrong = [f"{len(names[0])} are expected and {len(names[1])} recorded"]
    units = [f"{a.name} is in {a.unit}, recorded in {b.unit}" for a, b in pairs if a.unit != b.unit]
    at = {machine.sample_time_s, record.sample_time_s, exported.model.sample_time_s}
    return [
        result(
            "signals",
            not wrong,
            None,
            None,
            "",
            "The record has the machine's signals in the machine's order.",
            f"The record is of other signals: {', '.join(wrong)}.",
        ),
        result(
            "units",
            not units,
            None,
            None,
            "",
            "Units are the machine's.",
            f"Units differ: {', '.join(units)}.",
        ),
        result(
            "sample_time",
            len(at) == 1,
            float(record.sample_time_s),
            float(machine.sample_time_s),
            "s",
            f"Machine, model and record are sampled every {machine.sample_time_s:g} s.",
            f"Machine, record and model are sampled every {machine.sample_time_s:g}, "
            f"{record.sample_time_s:g} and {exported.model.sample_time_s:g} s.",
        ),
        _of_limits(exported, record),
    ]


def _of_limits(exported: Exported, record: EvidenceRecord) -> RuleResult:
    """Checks that recorded inputs lie within the limits of the command, and that they are not fractions of
    1."""
    rows, inputs = np.vstack([*record.u, *record.newest_u]), exported.machine.inputs
    low, high = np.array([(one.low, one.high) for one in inputs]).T
    span = high - low
    beyond = np.maximum(low - rows.min(axis=0), rows.max(axis=0) - high) / span
    share = (rows.max(axis=0) - low) / span
    over, small = int(beyond.argmax()), int(share.argmax())
    if beyond[over] > 1e-3:
        bad = (
            f"{inputs[over].name} was recorded up to {100 * beyond[over]:.3g} % of its range beyond its "
            "limits: the record is in another unit, or of other limits."
        )
        return result("limits", False, 100 * beyond[over], 0.1, "% of range", "", bad)
    return at_least(
        "limits",
        100 * share[small],
        100 * SCALE,
        "% of range",
        "Recorded inputs lie within the limits of the commands.",
        f"No recorded input reaches {100 * SCALE:g} % of its range: so look shares of 0 to 1 that are "
        "recorded as percent.",
    )


# ---- does the evidence hold?


class WindowModels(NamedTuple):
    """Results of the record itself, the same for every controller: window models of the whole record, one for
    each resample, and of its newest part alone (None if the record has too few samples); results of the rules
    that use no limit of section `report`; and noise (p,) in °C one step ahead."""

    of_record: bands.Predictors | None
    of_newest: bands.Predictors | None
    results: list[RuleResult]
    noise_degC: np.ndarray | None


def window_models(
    machine: Machine, record: EvidenceRecord, rules: Rules, rng: np.random.Generator
) -> WindowModels:
    """Returns the models, and the results of the rules samples, excitation, reach and room. Raises ValueError
    if the arrays of the record do not have the machine's number of signals."""
    _check(machine, record, rules)
    with np.errstate(all="ignore"):  # what diverges is a finding
        return _window_models(machine, record, rules, rng)


def _window_models(
    machine: Machine, record: EvidenceRecord, rules: Rules, rng: np.random.Generator
) -> WindowModels:
    u = [*_levelled(record.u, record.newest_u), *record.newest_u]
    y = [*_levelled(record.y, record.newest_y), *record.newest_y]
    longest = _longest(u, y, rules)
    if longest < 1:
        return WindowModels(None, None, [_too_few(sum(map(len, u)), u, y, rules)], None)
    N = learn(u, y, longest=longest, offset=True).N
    data = bands.rows(u, y, N)
    unknowns = 1 + data.w.shape[1]
    results = [
        at_least(
            "samples",
            len(data.w) / unknowns,
            rules.samples,
            "for each unknown",
            f"{len(data.w)} windows of {N} samples carry {unknowns} unknowns an output.",
            f"{len(data.w)} windows of {N} samples are too few for {unknowns} unknowns an output.",
        ),
        _of_excitation(machine, record, N, rules),
        _of_reach(machine, record, rules),
    ]
    if not all(one.passed for one in results):
        return WindowModels(None, None, results, None)
    of = bands.moments(data, max(2 * N, 10))
    sampled = bands.predictors(of, bands.drawn(of, rules.plants, rng), data)
    newest = record.newest_u, record.newest_y
    own = _own_model(*newest, min(N, _longest(*newest, rules)), rules.ahead)
    noise_degC = np.sqrt(np.median(np.einsum("sii->si", sampled.covariance), axis=0))
    room = _of_room(sampled, [one.name for one in machine.outputs], rules)
    return WindowModels(sampled, own, [*results, room], noise_degC)


def _check(machine: Machine, record: EvidenceRecord, rules: Rules) -> None:
    m, p = len(machine.inputs), len(machine.outputs)
    for what, parts, count in (
        ("u", record.u, m),
        ("newest_u", record.newest_u, m),
        ("y", record.y, p),
        ("newest_y", record.newest_y, p),
    ):
        if not parts or any(part.ndim != 2 or part.shape[1] != count for part in parts):
            shapes = [part.shape for part in parts]
            raise ValueError(
                f"certificate: expected segments {what} of {count} columns but found "
                f"shapes {shapes}; give the record of the machine that the controller is for"
            )
        if not all(np.isfinite(part).all() for part in parts):
            raise ValueError(
                f"certificate: {what} holds samples that are missing; cut the record into "
                "segments without them"
            )
    if np.shape(rules.references)[1:] != (p,) or np.shape(rules.start) != (p,):
        raise ValueError(
            f"certificate: expected references (g, {p}) and a start ({p},) but found "
            f"{np.shape(rules.references)} and {np.shape(rules.start)}; give one temperature an output"
        )


def _levelled(learned: Segments, newest: Segments) -> list[np.ndarray]:
    """Returns the learned segments, shifted to the mean of the newest ones. This gives each its own constant
    in every regression (Frisch-Waugh). With one constant for both, a change of room temperature would look
    like an integrator."""
    return [part - np.vstack(learned).mean(axis=0) + np.vstack(newest).mean(axis=0) for part in learned]


def _longest(u: Segments, y: Segments, rules: Rules) -> int:
    """Returns the longest window with at least `rules.samples` samples for each unknown; 0 if there is
    none."""
    m, p = u[0].shape[1], y[0].shape[1]
    for N in range(rules.longest_window, 0, -1):
        if sum(max(len(a) - N, 0) for a in u) >= rules.samples * (1 + N * (m + p)):
            return N
    return 0


def _too_few(samples: int, u: Segments, y: Segments, rules: Rules) -> RuleResult:
    unknowns = 1 + u[0].shape[1] + y[0].shape[1]
    bad = f"{samples} samples are too few for the {unknowns} unknowns of the shortest window."
    return result("samples", False, samples / unknowns, rules.samples, "for each unknown", "", bad)


def _of_excitation(machine: Machine, record: EvidenceRecord, N: int, rules: Rules) -> RuleResult:
    """Checks the part of each input that neither the past nor other inputs predict, in the learned record and
    in the newest, as a fraction of its range."""
    inputs = machine.inputs
    span = np.array([one.high - one.low for one in inputs])
    least = np.full(len(inputs), np.inf)
    for u, y in ((record.u, record.y), (record.newest_u, record.newest_y)):
        own = _own_moves(u, y, min(N, 3))
        least = np.minimum(least, own / span)
    worst = int(least.argmin())
    return at_least(
        "excitation",
        100 * least[worst],
        100 * rules.moves,
        "% of range",
        "Every input moves by itself, in the record and in the newest one.",
        f"{inputs[worst].name} moves by itself by {100 * least[worst]:.2g} % of its range only: its effect "
        "cannot be told from what it follows.",
    )


def _own_moves(u: Segments, y: Segments, N: int) -> np.ndarray:
    """Returns the standard deviation (m,) of the part of each input that the window, the present outputs and
    the other inputs do not predict. The part that a controller derives from its measurements shows nothing of
    the plant."""
    try:
        data = bands.rows(u, y, N)
    except ValueError:
        return np.zeros(u[0].shape[1])
    m, own = data.u.shape[1], []
    for j in range(m):
        columns = np.hstack([np.ones((len(data.w), 1)), data.w, data.y, np.delete(data.u, j, axis=1)])
        if len(columns) <= columns.shape[1]:
            return np.zeros(m)
        size = np.maximum(np.linalg.norm(columns, axis=0), np.finfo(float).tiny)
        left = data.u[:, j] - columns / size @ np.linalg.lstsq(columns / size, data.u[:, j], rcond=1e-10)[0]
        own.append(left.std())
    return np.array(own)


def _of_reach(machine: Machine, record: EvidenceRecord, rules: Rules) -> RuleResult:
    rows = np.vstack([*record.y, *record.newest_y])
    low, high = np.quantile(rows, [0.001, 0.999], axis=0)
    span = np.maximum(high - low, np.finfo(float).tiny)
    beyond = np.maximum(low - rules.references, rules.references - high) / span
    output = int(beyond.max(axis=0).argmax())
    return at_most(
        "reach",
        float(beyond.max()),
        rules.reach,
        "of the recorded span",
        "The references lie where the record was taken.",
        f"A reference of {machine.outputs[output].name} lies {beyond.max():.2g} of the recorded "
        "span beyond what was recorded.",
    )


def _of_room(sampled: bands.Predictors, outputs: Sequence[str], rules: Rules) -> RuleResult:
    """Checks that the cold machine is at a possible room temperature. A reading in °F or K is not."""
    (low, high), (coldest, hottest) = _extrapolated(sampled, len(outputs)), rules.extrapolated_degC
    off = np.maximum(low - hottest, coldest - high)
    said = "With its inputs off, drawn out from where it was"
    worst = int(off.argmax())
    return at_most(
        "room",
        float(off[worst]),
        0.0,
        "degC outside what a room may be",
        f"{said} recorded, it is at what a room may be.",
        f"{said} recorded, it is at {low[worst]:.0f} to {high[worst]:.0f} °C on {outputs[worst]}, which is "
        "no room: the sensor is in another unit, or something heats that is not recorded.",
    )


def _extrapolated(sampled: bands.Predictors, p: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the 95 % band (p,) of the outputs at rest without inputs, over the window models."""
    N = sampled.N
    m = sampled.Theta.shape[2] // N - p
    of_y = sampled.Theta[:, :, N * m :].reshape(len(sampled.Theta), p, N, p).sum(axis=2)
    balance = np.eye(p) - of_y
    fine = np.linalg.cond(balance) < 1e12
    at_rest = np.linalg.solve(balance[fine], sampled.theta_0[fine][:, :, None])[:, :, 0]
    low, high = np.quantile(at_rest, [0.025, 0.975], axis=0)
    return low, high


def of_newest(
    exported: Exported, record: EvidenceRecord, own: bands.Predictors, rules: Rules
) -> tuple[RuleResult, dict[str, dict[str, Any]]]:
    """Compares the model with the newest record, next to that record's own window model. Returns the result
    of the rule unexplained, and the figures of the rules coloured and newest."""
    outputs, model = [one.name for one in exported.machine.outputs], _following(exported.model)
    u, y = record.newest_u, record.newest_y
    missed = _unexplained(model, own, u, y, rules.ahead)
    worst = int(missed.argmax())
    foretold = _foretold(model, u, y)
    colour = int(foretold.argmax())
    unexplained = at_most(
        "unexplained",
        float(missed[worst]),
        rules.unexplained,
        f"of the movement in {rules.ahead} steps missed",
        "The newest record is explained by the model.",
        f"The model misses {100 * missed[worst]:.0f} % of what {outputs[worst]} did within {rules.ahead} "
        "steps in the newest record: the plant is another one, or a sensor, unit or sample time is.",
    )
    return unexplained, {
        "coloured": {"degC": float(foretold[colour]), "output": outputs[colour]},
        "newest": {"degC": _settled_on_newest(exported, own, rules)},
    }


def no_newest(record: EvidenceRecord, rules: Rules) -> RuleResult:
    """Returns the rule unexplained, refused because the newest record is too short for a window model of its
    own."""
    samples = sum(map(len, record.newest_u))
    bad = f"The newest record has {samples} samples, too few to hold the model against it."
    return result("unexplained", False, None, rules.unexplained, "", "", bad)


def _settled_on_newest(exported: Exported, own: bands.Predictors, rules: Rules) -> float:
    """Returns the settled error in °C of the controller on the window model of the newest record alone,
    without noise."""
    quiet = own._replace(covariance=np.zeros_like(own.covariance))
    steps, rng = reference_steps(rules), np.random.default_rng(0)
    return float(bands.met(exported.controller, exported.model, quiet, steps, rng).settled_error[0])


def _following(model: Plant) -> Plant:
    """Returns the model with a stable observer gain: its own, or a robust one if its own is not stable."""
    model = strictly_proper(model)
    if np.abs(np.linalg.eigvals(model.A - model.K @ model.C)).max() < 1:
        return model
    return model._replace(K=robust_observer_gain(model, 1.0))


def _own_model(u: Segments, y: Segments, N: int, ahead: int) -> bands.Predictors | None:
    """Returns the window model of these segments alone; None if they are too short."""
    if N < 1 or not any(len(a) > 4 * ahead for a in u):
        return None
    data = bands.rows(u, y, N)
    of = bands.moments(data, len(data.w))
    return bands.predictors(of, np.ones((1, len(of.starts))), data)


def _unexplained(model: Plant, own: bands.Predictors, u: Segments, y: Segments, ahead: int) -> np.ndarray:
    """Returns the fraction (p,) of the outputs' movement over `ahead` steps that the model misses, beyond
    what a window model of the same segments misses."""
    of_own = predictor(own.window(0), model.sample_time_s)
    squares, first = np.zeros((3, y[0].shape[1])), 2 * ahead
    count, N = 0, own.N
    for a, b in zip(u, y, strict=True):
        if len(a) <= 4 * ahead:
            continue
        errors = [b - _bounded(predicted_ahead(plant, a, b, ahead)) for plant in (model, of_own)]
        moved = b[ahead:] - b[:-ahead]
        for k, part in enumerate((errors[0][first:], errors[1][first:], moved[first - ahead :])):
            # about the mean: another room temperature is not another plant
            squares[k] += len(part) * part.var(axis=0)
        count += len(b) - first
    by_model, by_own, moved = squares / count
    by_own = by_own * (1 + 2 * N * (model.m + model.p) / count)  # it was fitted to these
    return np.sqrt(np.maximum(by_model - by_own, 0.0) / np.maximum(moved, np.finfo(float).tiny))


def _bounded(predicted: np.ndarray) -> np.ndarray:
    return np.clip(np.nan_to_num(predicted, nan=bands.DIVERGED), -bands.DIVERGED, bands.DIVERGED)


def _foretold(model: Plant, u: Segments, y: Segments) -> np.ndarray:
    """Returns the standard deviation (p,) in °C of the part of the one-step errors that errors and inputs of
    the LAGS samples before predict, minus what as many parameters predict by chance."""
    errors = [_bounded(part) for part in one_step_errors(model, u, y)]
    inputs = [a - a.mean(axis=0) for a in u]
    keep = [k for k, part in enumerate(errors) if len(part) > 2 * LAGS]
    data = bands.rows([inputs[k] for k in keep], [errors[k] for k in keep], LAGS)
    z = np.hstack([np.ones((len(data.w), 1)), data.w])
    p = data.y.shape[1]
    if len(z) <= 2 * z.shape[1]:
        return np.full(p, np.inf)
    left = data.y - z @ np.linalg.lstsq(z, data.y, rcond=1e-10)[0]
    inflated = len(z) / (len(z) - z.shape[1])
    return np.sqrt(np.maximum(data.y.var(axis=0) - inflated * (left**2).mean(axis=0), 0.0))


def reference_steps(rules: Rules) -> bands.ReferenceSteps:
    """Returns the reference steps that sampled plants must follow."""
    return bands.ReferenceSteps(
        np.asarray(rules.references, float), np.asarray(rules.start, float), rules.steps, rules.settled
    )


# ---- would the controller work?

POLES_SHOWN = 12  # of each plant, the largest


def of_loop(
    exported: Exported,
    family: Sequence[Plant],
    of_record: bands.Predictors,
    of_newest: bands.Predictors,
    rules: Rules,
    rng: np.random.Generator,
) -> tuple[dict[str, Any], list[RuleResult], dict[str, dict[str, Any]]]:
    """Returns fields of the certificate; results of the rules poles and violations; and the figures of the
    rules disk_margin, delay_margin and settled_error."""
    at = exported.machine.sample_time_s
    some = range(min(rules.poles_of, len(of_record.Theta)))
    plants = [("model", strictly_proper(exported.model))]
    plants += [("spread", strictly_proper(plant)) for plant in family]
    plants += [("record", observer_form(of_record.window(k), at)[0]) for k in some]
    margins = _margins([plant for _, plant in plants], exported.controller)
    plants.append(("newest", observer_form(of_newest.window(0), at)[0]))
    newest = _margins([plants[-1][1]], exported.controller)
    poles = tuple(_poles(of, plant, exported.controller) for of, plant in plants)
    spread = [plant for of, plant in plants if of == "spread"]
    settled, crossing = _settled_and_crossing(exported, spread, of_record, rules, rng)
    violations = tuple(
        {
            "output": signal.name,
            "worst_degC": float(crossing[:, o].max()),
            "plants": int((crossing[:, o] > rules.crossing_degC).sum()),
        }
        for o, signal in enumerate(exported.machine.outputs)
        if np.isfinite([signal.low, signal.high]).any()
    )
    worst = _worst(settled)
    fields = {"poles": poles, "margins": margins, "worst": worst, "violations": violations}
    figures = {
        name: {"margins": [found[0], found[1], of_newest[0]], "tail": rules.tail}
        for name, found, of_newest in (
            ("disk_margin", margins["disk"], newest["disk"]),
            ("delay_margin", margins["delay_s"], newest["delay_s"]),
        )
    }
    figures["settled_error"] = {"degC": settled.tolist(), "failing": rules.failing}
    return fields, [_of_poles(poles, rules), _of_violations(crossing, rules)], figures


def _poles(of: str, plant: Plant, controller: Deployed) -> dict[str, Any]:
    whole = plant.A if controller.holds else scorecard.closed_loop(plant, controller.law)
    found = np.linalg.eigvals(whole)
    found = found[np.lexsort((-found.imag, -np.abs(found).round(10)))]
    shown = [[float(one.real), float(one.imag)] for one in found[:POLES_SHOWN]]
    return {"of": of, "radius": float(np.abs(found).max()), "poles": shown}


def _of_poles(poles: Sequence[dict[str, Any]], rules: Rules) -> RuleResult:
    """Checks that all poles of model and spread lie within the unit circle. Of the plants of the record and
    its newest part a fraction `rules.failing` may fail, because a resample's slowest pole may lie outside by
    chance."""
    declared = [one for one in poles if one["of"] in ("model", "spread")]
    sampled = [one for one in poles if one["of"] in ("record", "newest")]
    outside = [sum(one["radius"] >= 1 for one in part) for part in (declared, sampled)]
    worst = max(poles, key=lambda one: one["radius"])
    return result(
        "poles",
        outside[0] == 0 and outside[1] <= rules.failing * len(sampled),
        worst["radius"],
        1.0,
        "1",
        f"On {len(poles) - outside[1]} of {len(poles)} plants, model and spread among them, every pole lies "
        "within the unit circle.",
        f"On {outside[0]} of {len(declared)} plants of model and spread, and {outside[1]} of {len(sampled)} "
        f"of the record, a pole lies outside the unit circle, at {worst['radius']:.4f}.",
    )


def _margins(plants: Sequence[Plant], controller: Deployed) -> dict[str, Any]:
    found = scorecard.margins(plants, controller.law, grid=60)
    picked = len(found) // 2, len(found) // 10, 0
    disk, delay = (np.sort([getattr(one, name) for one in found]) for name in ("disk", "delay_s"))
    return {
        "plants": len(found),
        "disk": [float(disk[k]) for k in picked],
        "delay_s": [float(delay[k]) if np.isfinite(delay[k]) else None for k in picked],
    }


def _of_violations(crossing: np.ndarray, rules: Rules) -> RuleResult:
    plants, crossed = len(crossing), int((crossing > rules.crossing_degC).any(axis=1).sum())
    return at_most(
        "violations",
        100 * crossed / plants,
        100 * (rules.failing * plants) / plants,
        "% of plants",
        f"On {plants - crossed} of {plants} plants no output crosses its limit by more than "
        f"{rules.crossing_degC:g} °C.",
        f"On {crossed} of {plants} plants an output crosses its limit by more than "
        f"{rules.crossing_degC:g} °C, at most by {crossing.max():.3g} °C.",
    )


def _settled_and_crossing(
    exported: Exported,
    spread: Sequence[Plant],
    sampled: bands.Predictors,
    rules: Rules,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Returns settled errors (s,) in °C of the sampled plants and of the spread with the controller as
    deployed, and by how many °C each crosses limits (s, p)."""
    low, high = np.array([(one.low, one.high) for one in exported.machine.outputs]).T
    steps = reference_steps(rules)
    parts = [bands.met(exported.controller, exported.model, sampled, steps, rng)]
    if spread:
        noise = np.sqrt(np.median(np.einsum("sii->si", sampled.covariance), axis=0))
        parts.append(bands.met_spread(exported.controller, exported.model, spread, steps, noise, rng))
    settled = np.concatenate([part.settled_error for part in parts])
    lowest, highest = (
        np.concatenate([getattr(part, side) for part in parts]) for side in ("lowest", "highest")
    )
    return settled, np.maximum(np.maximum(low - lowest, highest - high), 0.0)


def _worst(settled: np.ndarray) -> dict[str, Any]:
    """Returns quantiles of the settled errors. The number of failing plants depends on the limit
    (certificate.decide) and is 0 until then."""
    figures = [float(np.quantile(settled, share, method="higher")) for share in (0.5, 0.99, 1.0)]
    diverged = int((settled >= bands.DIVERGED).sum())
    return {"plants": len(settled), "settled_error_degC": figures, "failing": 0, "diverged": diverged}


def gain_bands(
    exported: Exported,
    record: EvidenceRecord,
    learning: bands.GainRoute,
    rules: Rules,
    rng: np.random.Generator,
) -> dict[str, Any]:
    found = bands.bands(record.u, record.y, learning, resamples=rules.resamples, rng=rng)
    machine, N = exported.machine, learning.N
    inputs, outputs = [one.name for one in machine.inputs], [one.name for one in machine.outputs]
    on = [f"{name} {lag} before" for lag in range(1, N + 1) for name in inputs]
    on += [f"{name} {lag} before" for lag in range(1, N + 1) for name in outputs]
    on += [f"reference of {name}" for name in outputs]
    gain, low, high = ([[float(f"{one:.6g}") for one in row] for row in part] for part in found[:3])
    return {
        "level": found.level, "resamples": found.resamples, "on": on, "gain": gain, "low": low, "high": high
    }  # fmt: skip
