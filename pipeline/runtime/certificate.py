"""The certificate of a controller: what was shown of it, on what evidence, and whether it may leave.

Three questions, asked in the declared order of RULES; the first rule that fails refuses.

Is the record of this machine? Names, units, sample time, enough samples, inputs that move by themselves.
Does the evidence hold? The newest record must be explained by the model that the controller was made on.
Would it work? Poles and margins over the spread, and the worst of at least 1,000 plants that the record
leaves open (bands.py): window models of resampled blocks, which the controller meets as deployed.

Words are of what was shown: "recorded" or "simulated" evidence.
"""

import hashlib
import json
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from pipeline.runtime import bands
from pipeline.runtime.machine import Exported, Signal, controller_sha256
from pipeline.temperature import scorecard
from pipeline.temperature.controller import Deployed
from pipeline.temperature.plant import Plant, strictly_proper
from pipeline.temperature.tracking import robust_observer_gain
from pipeline.temperature.validation import one_step_errors, predicted_ahead
from pipeline.temperature.window import learn, observer_form, predictor

VERSION, LOOP = 1, "temperature"
Segments = Sequence[np.ndarray]
POLES_SHOWN = 12  # of each plant, the largest
LAGS = 5  # of errors and inputs from which a coloured error could have been foretold
# share of the largest command that is allowed: a record that never leaves it is in another unit (0..1)
SCALE = 0.015


class Record(NamedTuple):
    """What a certificate rests on: signals as recorded, and the segments that were learned from, u (T, m), y
    (T, p); `newest` segments come from the machine as it is now, by the wires that the controller will have.
    All are without gaps. `cold_degC` (p,) is what the sensors read of the cold machine, None where nobody
    looked."""

    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    sample_time_s: float
    u: list[np.ndarray]
    y: list[np.ndarray]
    newest_u: list[np.ndarray]
    newest_y: list[np.ndarray]
    cold_degC: np.ndarray | None = None


class Rules(NamedTuple):
    """What is asked. From rest at `start` (p,) °C the references (g, p) °C are asked for, `steps` each; over
    the last `settled` of them the mean error may be `settled_error_degC`, beyond the limits of outputs
    `crossing_degC`. In a share `failing` of the plants either may be more.

    Margins hold on nine of ten plants of family and record. `samples` are those for each unknown of a
    window model. `moves` is the least share of an input's range that it moves by itself. Of the newest
    record's movement over `ahead` steps the model may miss `unexplained` beyond what the record's own window
    model misses, and of errors of one step no more than the settled error allowed may be foretold by errors
    and inputs before. On the window model of the newest record alone twice that error is allowed.
    `noise`: the deviation of a settled mean as a share of the settled error allowed. A cold machine is as
    warm as its room, `room_degC`; where no cold reading is given, the record's window models must not
    contradict `extrapolated_degC` at rest without inputs, wider by what a line from hot to cold misses.
    `reach`: by how much of the recorded span references may lie beyond it.
    """

    references: np.ndarray
    start: np.ndarray
    steps: int = 300
    settled: int = 50
    settled_error_degC: float = 0.5
    crossing_degC: float = 1.0
    failing: float = 0.1
    disk_margin: float = 0.2
    delay_margin_s: float = 0.0
    plants: int = 1000
    poles_of: int = 24
    resamples: int = 200
    longest_window: int = 24
    samples: float = 5.0
    moves: float = 0.002
    ahead: int = 20
    unexplained: float = 0.5
    noise: float = 0.3
    room_degC: tuple[float, float] = (5.0, 45.0)
    extrapolated_degC: tuple[float, float] = (-50.0, 110.0)
    reach: float = 0.5


class RuleResult(NamedTuple):
    """One rule: what was found, the limit, and a sentence. `asked` is False where an earlier one refused."""

    name: str
    passed: bool
    found: float | None
    limit: float | None
    unit: str
    sentence: str
    asked: bool = True


class Poles(NamedTuple):
    """The largest poles of one closed loop, [real, imaginary]; `of` is "model", "spread" or "record"."""

    of: str
    radius: float
    poles: tuple[tuple[float, float], ...]


class MarginsFound(NamedTuple):
    """MIMO disk margin and delay margin over family and record: median, the one that nine of ten reach, and
    the least; a delay margin without end is None."""

    plants: int
    disk: tuple[float, float, float]
    delay_s: tuple[float | None, float | None, float | None]


class Worst(NamedTuple):
    """Over `plants` sampled plants: settled error in °C, median, 99 % quantile and worst, how many settle
    worse than allowed, and how many did not stay finite."""

    plants: int
    settled_error_degC: tuple[float, float, float]
    failing: int
    diverged: int


class Violation(NamedTuple):
    """By how many °C a sampled plant crosses a limit of an output at most, and how many do by more than
    allowed."""

    output: str
    worst_degC: float
    plants: int


class GainBands(NamedTuple):
    """Bands of the learned gains u = -K w - K_r r at `level`, by `resamples` of the record: rows by input,
    columns `on` a signal so many samples before, or a reference."""

    level: float
    resamples: int
    on: tuple[str, ...]
    gain: tuple[tuple[float, ...], ...]
    low: tuple[tuple[float, ...], ...]
    high: tuple[tuple[float, ...], ...]


class Certificate(NamedTuple):
    """What was shown of a controller. Fields that no rule came to are empty or None."""

    version: int
    loop: str
    controller: str
    controller_sha256: str
    plant_sha256: str
    spread_sha256: str
    evidence: Literal["simulated", "recorded"]
    sample_time_s: float
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    samples: tuple[int, int]
    poles: tuple[Poles, ...]
    margins: MarginsFound | None
    worst: Worst | None
    violations: tuple[Violation, ...]
    bands: GainBands | None
    rules: tuple[RuleResult, ...]
    verdict: Literal["passed", "refused"]
    first_failed: str | None


# ---- certify


def certify(
    exported: Exported,
    family: Sequence[Plant],
    record: Record,
    rules: Rules,
    rng: np.random.Generator,
    *,
    learning: bands.Learning | None = None,
) -> Certificate:
    """The certificate of a controller on its record; `family` is the spread of the identified plant.

    `learning` says how gains were learned, where a record's bands of them are wanted. Raises ValueError where
    the arrays of the record do not have the machine's number of signals.
    """
    _check(exported, record, rules)
    with np.errstate(all="ignore"):  # what diverges is a finding
        return _certified(exported, family, record, rules, rng, learning)


def _certified(
    exported: Exported,
    family: Sequence[Plant],
    record: Record,
    rules: Rules,
    rng: np.random.Generator,
    learning: bands.Learning | None,
) -> Certificate:
    results = [*_of_signals(exported, record, rules)]
    shown = _Shown()
    if all(one.passed for one in results):
        sampled, of_evidence = _of_evidence(exported, record, rules, rng)
        results += of_evidence
        if sampled is not None and all(one.passed for one in results):
            shown, of_loop = _of_loop(exported, family, sampled, rules, rng)
            results += of_loop
            if learning is not None:
                shown = shown._replace(bands=_gain_bands(exported, record, learning, rules, rng))
    done = {one.name for one in results}
    first = next((one.name for one in results if not one.passed), None)
    results += [
        RuleResult(name, False, None, None, "", f"Not asked, because {first} failed.", False)
        for name in RULES
        if name not in done
    ]
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
        shown.poles,
        shown.margins,
        shown.worst,
        shown.violations,
        shown.bands,
        tuple(results),
        "passed" if first is None else "refused",
        first,
    )


RULES = (
    "signals",
    "units",
    "sample_time",
    "limits",
    "samples",
    "excitation",
    "reach",
    "noise",
    "room",
    "unexplained",
    "coloured",
    "newest",
    "poles",
    "disk_margin",
    "delay_margin",
    "settled_error",
    "violations",
)


class _Shown(NamedTuple):
    poles: tuple[Poles, ...] = ()
    margins: MarginsFound | None = None
    worst: Worst | None = None
    violations: tuple[Violation, ...] = ()
    bands: GainBands | None = None


def _check(exported: Exported, record: Record, rules: Rules) -> None:
    m, p = exported.controller.law.D.shape
    for what, parts, count in (
        ("u", record.u, m),
        ("newest_u", record.newest_u, m),
        ("y", record.y, p),
        ("newest_y", record.newest_y, p),
    ):
        if not parts or any(part.ndim != 2 or part.shape[1] != count for part in parts):
            shapes = [part.shape for part in parts]
            raise ValueError(
                f"certificate of {exported.name}: expected segments {what} of {count} columns but found "
                f"shapes {shapes}; give the record of the machine that the controller is for"
            )
        if not all(np.isfinite(part).all() for part in parts):
            raise ValueError(
                f"certificate of {exported.name}: {what} holds samples that are missing; cut the record into "
                "segments without them"
            )
    if np.shape(rules.references)[1:] != (p,) or np.shape(rules.start) != (p,):
        raise ValueError(
            f"certificate of {exported.name}: expected references (g, {p}) and a start ({p},) but found "
            f"{np.shape(rules.references)} and {np.shape(rules.start)}; give one temperature an output"
        )


def _at_most(name: str, found: float, limit: float, unit: str, good: str, bad: str) -> RuleResult:
    return _result(name, bool(found <= limit), found, limit, unit, good, bad)


def _at_least(name: str, found: float, limit: float, unit: str, good: str, bad: str) -> RuleResult:
    return _result(name, bool(found >= limit), found, limit, unit, good, bad)


def _result(
    name: str, passed: bool, found: float | None, limit: float | None, unit: str, good: str, bad: str
) -> RuleResult:
    return RuleResult(name, passed, _finite(found), _finite(limit), unit, good if passed else bad)


def _finite(value: float | None) -> float | None:
    """JSON knows no infinity."""
    return None if value is None or not np.isfinite(value) else float(value)


# ---- is the record of this machine?


def _of_signals(exported: Exported, record: Record, rules: Rules) -> list[RuleResult]:
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
        _result(
            "signals",
            not wrong,
            None,
            None,
            "",
            "The record has the machine's signals in the machine's order.",
            f"The record is of other signals: {', '.join(wrong)}.",
        ),
        _result(
            "units",
            not units,
            None,
            None,
            "",
            "Units are the machine's.",
            f"Units differ: {', '.join(units)}.",
        ),
        _result(
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


def _of_limits(exported: Exported, record: Record) -> RuleResult:
    """Whether recorded inputs lie within the limits of the command, and are no share of them."""
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
        return _result("limits", False, 100 * beyond[over], 0.1, "% of range", "", bad)
    return _at_least(
        "limits",
        100 * share[small],
        100 * SCALE,
        "% of range",
        "Recorded inputs lie within the limits of the commands.",
        f"No recorded input reaches {100 * SCALE:g} % of its range: so look shares of 0 to 1 that are "
        "recorded as percent.",
    )


# ---- does the evidence hold?


def _of_evidence(
    exported: Exported, record: Record, rules: Rules, rng: np.random.Generator
) -> tuple[bands.Predictors | None, list[RuleResult]]:
    u = [*_levelled(record.u, record.newest_u), *record.newest_u]
    y = [*_levelled(record.y, record.newest_y), *record.newest_y]
    outputs = [one.name for one in exported.machine.outputs]
    longest = _longest(u, y, rules)
    if longest < 1:
        return None, [_too_few(sum(map(len, u)), u, y, rules)]
    N = learn(u, y, longest=longest, offset=True).N
    data = bands.rows(u, y, N)
    unknowns = 1 + data.w.shape[1]
    results = [
        _at_least(
            "samples",
            len(data.w) / unknowns,
            rules.samples,
            "for each unknown",
            f"{len(data.w)} windows of {N} samples carry {unknowns} unknowns an output.",
            f"{len(data.w)} windows of {N} samples are too few for {unknowns} unknowns an output.",
        ),
        _of_excitation(exported, record, N, rules),
        _of_reach(exported, record, rules),
    ]
    if not all(one.passed for one in results):
        return None, results
    of = bands.moments(data, max(2 * N, 10))
    sampled = bands.predictors(of, bands.drawn(of, rules.plants, rng), data)
    results += [
        _of_noise(sampled, outputs, rules),
        _of_room(record, sampled, outputs, rules),
        *_of_newest(exported, record, N, rules),
    ]
    return sampled, results


def _levelled(learned: Segments, newest: Segments) -> list[np.ndarray]:
    """The learned segments about the mean of the newest: a constant for each in every regression
    (Frisch-Waugh). With one for both, a room that differs between them looks like an integrator."""
    return [part - np.vstack(learned).mean(axis=0) + np.vstack(newest).mean(axis=0) for part in learned]


def _longest(u: Segments, y: Segments, rules: Rules) -> int:
    """The longest window for which there are `rules.samples` for each unknown."""
    m, p = u[0].shape[1], y[0].shape[1]
    for N in range(rules.longest_window, 0, -1):
        if sum(max(len(a) - N, 0) for a in u) >= rules.samples * (1 + N * (m + p)):
            return N
    return 0


def _too_few(samples: int, u: Segments, y: Segments, rules: Rules) -> RuleResult:
    unknowns = 1 + u[0].shape[1] + y[0].shape[1]
    bad = f"{samples} samples are too few for the {unknowns} unknowns of the shortest window."
    return _result("samples", False, samples / unknowns, rules.samples, "for each unknown", "", bad)


def _of_excitation(exported: Exported, record: Record, N: int, rules: Rules) -> RuleResult:
    """The part of each input that no past and no other input foretells, in the learned record and in the
    newest, as a share of its range."""
    inputs = exported.machine.inputs
    span = np.array([one.high - one.low for one in inputs])
    least = np.full(len(inputs), np.inf)
    for u, y in ((record.u, record.y), (record.newest_u, record.newest_y)):
        own = _own_moves(u, y, min(N, 3))
        least = np.minimum(least, own / span)
    worst = int(least.argmin())
    return _at_least(
        "excitation",
        100 * least[worst],
        100 * rules.moves,
        "% of range",
        "Every input moves by itself, in the record and in the newest one.",
        f"{inputs[worst].name} moves by itself by {100 * least[worst]:.2g} % of its range only: its effect "
        "cannot be told from what it follows.",
    )


def _own_moves(u: Segments, y: Segments, N: int) -> np.ndarray:
    """Deviation (m,) of what the window, the outputs now and the other inputs do not foretell of each input:
    what a controller makes of its measurements tells nothing of the plant."""
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


def _of_reach(exported: Exported, record: Record, rules: Rules) -> RuleResult:
    rows = np.vstack([*record.y, *record.newest_y])
    low, high = np.quantile(rows, [0.001, 0.999], axis=0)
    span = np.maximum(high - low, np.finfo(float).tiny)
    beyond = np.maximum(low - rules.references, rules.references - high) / span
    output = int(beyond.max(axis=0).argmax())
    return _at_most(
        "reach",
        float(beyond.max()),
        rules.reach,
        "of the recorded span",
        "The references lie where the record was taken.",
        f"A reference of {exported.machine.outputs[output].name} lies {beyond.max():.2g} of the recorded "
        "span beyond what was recorded.",
    )


def _of_noise(sampled: bands.Predictors, outputs: Sequence[str], rules: Rules) -> RuleResult:
    deviation = np.sqrt(np.median(np.einsum("sii->si", sampled.covariance), axis=0))
    share = deviation / np.sqrt(rules.settled) / rules.settled_error_degC
    worst = int(share.argmax())
    return _at_most(
        "noise",
        float(share[worst]),
        rules.noise,
        "of the settled error",
        f"One step ahead, noise is {deviation[worst]:.2g} °C at most.",
        f"Noise of {deviation[worst]:.3g} °C on {outputs[worst]} hides the settled error that is allowed.",
    )


def _of_room(record: Record, sampled: bands.Predictors, outputs: Sequence[str], rules: Rules) -> RuleResult:
    """A cold machine is as warm as its room. A reading in °F or K is not."""
    if record.cold_degC is not None:
        low = high = np.asarray(record.cold_degC, float)
        limit, said = rules.room_degC, "A cold machine reads"
    else:
        low, high = _extrapolated(sampled, len(outputs))
        limit, said = (
            rules.extrapolated_degC,
            "With its inputs off, drawn out from where it was recorded, it is at",
        )
    off = np.maximum(low - limit[1], limit[0] - high)
    worst = int(off.argmax())
    return _at_most(
        "room",
        float(off[worst]),
        0.0,
        "degC beyond a room",
        f"{said} what a room may be.",
        f"{said} {low[worst]:.0f} to {high[worst]:.0f} °C on {outputs[worst]}, which is no room: "
        "the sensor is in another unit, or something heats that is not recorded.",
    )


def _extrapolated(sampled: bands.Predictors, p: int) -> tuple[np.ndarray, np.ndarray]:
    """The band of 95 % (p,) of the outputs at rest without inputs, over the window models."""
    N = sampled.N
    m = sampled.Theta.shape[2] // N - p
    of_y = sampled.Theta[:, :, N * m :].reshape(len(sampled.Theta), p, N, p).sum(axis=2)
    balance = np.eye(p) - of_y
    fine = np.linalg.cond(balance) < 1e12
    at_rest = np.linalg.solve(balance[fine], sampled.theta_0[fine][:, :, None])[:, :, 0]
    low, high = np.quantile(at_rest, [0.025, 0.975], axis=0)
    return low, high


def _of_newest(exported: Exported, record: Record, N: int, rules: Rules) -> list[RuleResult]:
    """The newest record against the model, beside what a window model of its own makes of it."""
    outputs, model = [one.name for one in exported.machine.outputs], _following(exported.model)
    u, y = record.newest_u, record.newest_y
    own = _own_model(u, y, min(N, _longest(u, y, rules)), rules.ahead)
    if own is None:
        bad = f"The newest record has {sum(map(len, u))} samples, too few to hold the model against it."
        return [_result("unexplained", False, None, rules.unexplained, "", "", bad)]
    missed = _unexplained(model, own, u, y, rules.ahead)
    worst = int(missed.argmax())
    foretold = _foretold(model, u, y)
    colour = int(foretold.argmax())
    return [
        _at_most(
            "unexplained",
            float(missed[worst]),
            rules.unexplained,
            f"of the movement in {rules.ahead} steps",
            "The newest record is explained by the model.",
            f"The model misses {100 * missed[worst]:.0f} % of what {outputs[worst]} did within {rules.ahead} "
            "steps in the newest record: the plant is another one, or a sensor, unit or sample time is.",
        ),
        _at_most(
            "coloured",
            float(foretold[colour]),
            rules.settled_error_degC,
            "degC",
            f"Of errors of one step {foretold[colour]:.2g} °C at most could have been foretold.",
            f"Of the errors of one step of {outputs[colour]} {foretold[colour]:.2g} °C could have been "
            "foretold: the model misses what the newest record shows.",
        ),
        _on_newest(exported, own, rules),
    ]


def _on_newest(exported: Exported, own: bands.Predictors, rules: Rules) -> RuleResult:
    """The controller on the window model of the newest record alone, without noise."""
    quiet = own._replace(covariance=np.zeros_like(own.covariance))
    met = bands.met(exported.controller, exported.model, quiet, _asked(rules), np.random.default_rng(0))
    found = float(met.settled_error[0])
    return _at_most(
        "newest",
        found,
        2 * rules.settled_error_degC,
        "degC",
        f"On what the newest record alone shows it settles within {found:.2g} °C.",
        f"On what the newest record alone shows it does not settle: {found:.3g} °C remain.",
    )


def _following(model: Plant) -> Plant:
    """The model with a gain that follows its outputs: its own, or one that is stable where its own is not."""
    model = strictly_proper(model)
    if np.abs(np.linalg.eigvals(model.A - model.K @ model.C)).max() < 1:
        return model
    return model._replace(K=robust_observer_gain(model, 1.0))


def _own_model(u: Segments, y: Segments, N: int, ahead: int) -> bands.Predictors | None:
    """The window model of these segments alone; None where they are too short."""
    if N < 1 or not any(len(a) > 4 * ahead for a in u):
        return None
    data = bands.rows(u, y, N)
    of = bands.moments(data, len(data.w))
    return bands.predictors(of, np.ones((1, len(of.starts))), data)


def _unexplained(model: Plant, own: bands.Predictors, u: Segments, y: Segments, ahead: int) -> np.ndarray:
    """Share (p,) of the outputs' movement over `ahead` steps that the model misses beyond what a window model
    of the same segments misses."""
    of_own = predictor(own.window(0), model.sample_time_s)
    squares, first = np.zeros((3, y[0].shape[1])), 2 * ahead
    count, N = 0, own.N
    for a, b in zip(u, y, strict=True):
        if len(a) <= 4 * ahead:
            continue
        errors = [b - _bounded(predicted_ahead(plant, a, b, ahead)) for plant in (model, of_own)]
        moved = b[ahead:] - b[:-ahead]
        for k, part in enumerate((errors[0][first:], errors[1][first:], moved[first - ahead :])):
            # about the mean: another room is not another plant
            squares[k] += len(part) * part.var(axis=0)
        count += len(b) - first
    by_model, by_own, moved = squares / count
    by_own = by_own * (1 + 2 * N * (model.m + model.p) / count)  # it was fitted to these
    return np.sqrt(np.maximum(by_model - by_own, 0.0) / np.maximum(moved, np.finfo(float).tiny))


def _bounded(predicted: np.ndarray) -> np.ndarray:
    return np.clip(np.nan_to_num(predicted, nan=bands.DIVERGED), -bands.DIVERGED, bands.DIVERGED)


def _foretold(model: Plant, u: Segments, y: Segments) -> np.ndarray:
    """Deviation (p,) in °C of the part of one-step errors that errors and inputs of the LAGS samples before
    foretell, less what as many numbers foretell by chance."""
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


# ---- would it work?


def _of_loop(
    exported: Exported,
    family: Sequence[Plant],
    sampled: bands.Predictors,
    rules: Rules,
    rng: np.random.Generator,
) -> tuple[_Shown, list[RuleResult]]:
    at = exported.machine.sample_time_s
    some = range(min(rules.poles_of, len(sampled.Theta)))
    plants = [("model", strictly_proper(exported.model))]
    plants += [("spread", strictly_proper(plant)) for plant in family]
    plants += [("record", observer_form(sampled.window(k), at)[0]) for k in some]
    poles = tuple(_poles(of, plant, exported.controller) for of, plant in plants)
    margins = _margins([plant for _, plant in plants], exported.controller)
    worst, crossing = _worst(exported, [plant for of, plant in plants if of == "spread"], sampled, rules, rng)
    violations = tuple(
        Violation(signal.name, float(crossing[:, o].max()), int((crossing[:, o] > rules.crossing_degC).sum()))
        for o, signal in enumerate(exported.machine.outputs)
        if np.isfinite([signal.low, signal.high]).any()
    )
    shown = _Shown(poles, margins, worst, violations)
    return shown, [
        _of_poles(poles, rules),
        _at_least(
            "disk_margin",
            margins.disk[1],
            rules.disk_margin,
            "1",
            f"Nine of ten plants have a disk margin of {margins.disk[1]:.2f} or more.",
            f"A tenth of the plants has a disk margin below {margins.disk[1]:.2g}.",
        ),
        _of_delay(margins, rules),
        *_of_worst(worst, crossing, rules),
    ]


def _poles(of: str, plant: Plant, controller: Deployed) -> Poles:
    whole = plant.A if controller.holds else scorecard.closed_loop(plant, controller.law)
    found = np.linalg.eigvals(whole)
    found = found[np.lexsort((-found.imag, -np.abs(found).round(10)))]
    shown = tuple((float(one.real), float(one.imag)) for one in found[:POLES_SHOWN])
    return Poles(of, float(np.abs(found).max()), shown)


def _of_poles(poles: Sequence[Poles], rules: Rules) -> RuleResult:
    """All of model and spread within the unit circle, and of the record's plants all but a share
    `rules.failing`: a resample's slowest pole may lie outside by chance."""
    declared = [one for one in poles if one.of != "record"]
    sampled = [one for one in poles if one.of == "record"]
    outside = [sum(one.radius >= 1 for one in part) for part in (declared, sampled)]
    worst = max(poles, key=lambda one: one.radius)
    return _result(
        "poles",
        outside[0] == 0 and outside[1] <= rules.failing * len(sampled),
        worst.radius,
        1.0,
        "1",
        f"On {len(poles) - outside[1]} of {len(poles)} plants, model and spread among them, every pole lies "
        "within the unit circle.",
        f"On {outside[0]} of {len(declared)} plants of model and spread, and {outside[1]} of {len(sampled)} "
        f"of the record, a pole lies outside the unit circle, at {worst.radius:.4f}.",
    )


def _margins(plants: Sequence[Plant], controller: Deployed) -> MarginsFound:
    found = scorecard.margins(plants, controller.law, grid=60)
    disk = np.sort([one.disk for one in found])
    delay = np.sort([one.delay_s for one in found])
    tenth = len(found) // 10
    picked = [[float(part[k]) for k in (len(found) // 2, tenth, 0)] for part in (disk, delay)]
    late = [one if np.isfinite(one) else None for one in picked[1]]
    return MarginsFound(len(found), (picked[0][0], picked[0][1], picked[0][2]), (late[0], late[1], late[2]))


def _of_delay(margins: MarginsFound, rules: Rules) -> RuleResult:
    tenth = np.inf if margins.delay_s[1] is None else margins.delay_s[1]
    return _at_least(
        "delay_margin",
        tenth,
        rules.delay_margin_s,
        "s",
        "No delay makes it unstable." if np.isinf(tenth) else f"Nine of ten plants stand {tenth:.3g} s more.",
        f"On a tenth of the plants a delay of {tenth:.2g} s more makes it unstable.",
    )


def _of_worst(worst: Worst, crossing: np.ndarray, rules: Rules) -> list[RuleResult]:
    allowed = rules.failing * worst.plants
    crossed = int((crossing > rules.crossing_degC).any(axis=1).sum())
    return [
        _at_most(
            "settled_error",
            100 * worst.failing / worst.plants,
            100 * rules.failing,
            "% of plants",
            f"Of {worst.plants} plants that the record leaves open {worst.plants - worst.failing} settle "
            f"within {rules.settled_error_degC:g} °C, the worst at {worst.settled_error_degC[2]:.2g} °C.",
            f"{worst.failing} of {worst.plants} plants that the record leaves open do not settle within "
            f"{rules.settled_error_degC:g} °C, the worst by {worst.settled_error_degC[2]:.3g} °C.",
        ),
        _at_most(
            "violations",
            100 * crossed / worst.plants,
            100 * allowed / worst.plants,
            "% of plants",
            f"Limits of outputs are kept within {rules.crossing_degC:g} °C, but on {crossed} plants.",
            f"On {crossed} of {worst.plants} plants an output crosses its limit by more than "
            f"{rules.crossing_degC:g} °C, at most by {crossing.max():.3g} °C.",
        ),
    ]


def _worst(
    exported: Exported,
    spread: Sequence[Plant],
    sampled: bands.Predictors,
    rules: Rules,
    rng: np.random.Generator,
) -> tuple[Worst, np.ndarray]:
    """The sampled plants and the spread under the controller as deployed, and by how many °C each crosses
    limits (s, p)."""
    low, high = np.array([(one.low, one.high) for one in exported.machine.outputs]).T
    asked = _asked(rules)
    parts = [bands.met(exported.controller, exported.model, sampled, asked, rng)]
    if spread:
        noise = np.sqrt(np.median(np.einsum("sii->si", sampled.covariance), axis=0))
        parts.append(bands.met_spread(exported.controller, exported.model, spread, asked, noise, rng))
    settled = np.concatenate([part.settled_error for part in parts])
    lowest, highest = (
        np.concatenate([getattr(part, side) for part in parts]) for side in ("lowest", "highest")
    )
    crossing = np.maximum(np.maximum(low - lowest, highest - high), 0.0)
    figures = [float(np.quantile(settled, share, method="higher")) for share in (0.5, 0.99, 1.0)]
    failing = int((settled > rules.settled_error_degC).sum())
    diverged = int((settled >= bands.DIVERGED).sum())
    return Worst(len(settled), (figures[0], figures[1], figures[2]), failing, diverged), crossing


def _asked(rules: Rules) -> bands.Asked:
    return bands.Asked(
        np.asarray(rules.references, float), np.asarray(rules.start, float), rules.steps, rules.settled
    )


def _gain_bands(
    exported: Exported, record: Record, learning: bands.Learning, rules: Rules, rng: np.random.Generator
) -> GainBands:
    found = bands.bands(record.u, record.y, learning, resamples=rules.resamples, rng=rng)
    machine, N = exported.machine, learning.N
    inputs, outputs = [one.name for one in machine.inputs], [one.name for one in machine.outputs]
    on = [f"{name} {lag} before" for lag in range(1, N + 1) for name in inputs]
    on += [f"{name} {lag} before" for lag in range(1, N + 1) for name in outputs]
    on += [f"reference of {name}" for name in outputs]
    gain, low, high = (tuple(tuple(float(f"{one:.6g}") for one in row) for row in part) for part in found[:3])
    return GainBands(found.level, found.resamples, tuple(on), gain, low, high)


# ---- as JSON


def to_json(certificate: Certificate) -> str:
    """Canonical JSON: sorted keys, no blanks; limits that are not declared are null."""
    return json.dumps(
        _plain(certificate), sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    )


def sha256(certificate: Certificate) -> str:
    """Of the canonical JSON."""
    return hashlib.sha256(to_json(certificate).encode()).hexdigest()


def from_json(text: str) -> Certificate:
    """Raises ValueError where the text is no certificate of this version, saying what is missing."""
    try:
        about = json.loads(text)
    except ValueError as error:
        raise ValueError(f"the certificate is no JSON ({error}); certify the controller again") from None
    version = about.get("version") if isinstance(about, dict) else None
    if version != VERSION:
        raise ValueError(
            f"expected a certificate of version {VERSION} but found {version}; certify the controller again"
        )
    missing = [name for name in Certificate._fields if name not in about]
    if missing:
        raise ValueError(f"the certificate has no {missing[0]}; certify the controller again")
    try:
        return _read(about)
    except (TypeError, KeyError, ValueError) as error:
        raise ValueError(f"the certificate cannot be read ({error}); certify the controller again") from None


def _read(about: dict[str, Any]) -> Certificate:
    def signals(entries: list[dict[str, Any]]) -> tuple[Signal, ...]:
        return tuple(
            Signal(
                one["name"],
                one["unit"],
                -np.inf if one["low"] is None else one["low"],
                np.inf if one["high"] is None else one["high"],
            )
            for one in entries
        )

    margins, worst = about["margins"], about["worst"]
    made = {name: about[name] for name in Certificate._fields}
    made |= {
        "inputs": signals(about["inputs"]),
        "outputs": signals(about["outputs"]),
        "samples": tuple(about["samples"]),
        "poles": tuple(
            Poles(one["of"], one["radius"], tuple((a, b) for a, b in one["poles"])) for one in about["poles"]
        ),
        "margins": margins
        and MarginsFound(margins["plants"], tuple(margins["disk"]), tuple(margins["delay_s"])),
        "worst": worst and Worst(**(worst | {"settled_error_degC": tuple(worst["settled_error_degC"])})),
        "violations": tuple(Violation(**one) for one in about["violations"]),
        "bands": about["bands"]
        and GainBands(**{name: _tuples(part) for name, part in about["bands"].items()}),
        "rules": tuple(RuleResult(**one) for one in about["rules"]),
    }
    certificate = Certificate(**made)
    first = next((one.name for one in certificate.rules if not one.passed), None)
    if certificate.first_failed != first or certificate.verdict != ("refused" if first else "passed"):
        raise ValueError(f"its verdict {certificate.verdict} is not that of its rules")
    if tuple(one.name for one in certificate.rules) != RULES:
        raise ValueError("its rules are not those of this version")
    return certificate


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _plain(value: Any) -> Any:
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return {name: _plain(part) for name, part in value._asdict().items()}
    if isinstance(value, tuple | list):
        return [_plain(part) for part in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value
