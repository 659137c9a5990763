"""The temperature loop's part of a night: new recordings held against those of the champion. A record that is
not what it says is set aside, and what it says of the machine, put right, counts all the same."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.nightly import baseline, drift, judge, mistakes, pictures, sensors
from pipeline.nightly.baseline import Baseline
from pipeline.nightly.camera_drift import CameraChange
from pipeline.nightly.drift import CauseFit, DriftCause, DriftRecord, Explanation, ProductionModel, Segments
from pipeline.nightly.inputs import quarantine
from pipeline.nightly.records import (
    SENSOR,
    Alarm,
    ClosedLoopChange,
    InnovationChange,
    LoopDrift,
    ParameterChange,
    RecordingFigures,
)
from pipeline.nightly.settings import DriftLimits, NightlyLoop
from pipeline.store import artifacts, params
from pipeline.temperature.identification import model_choice
from pipeline.temperature.settings import Plant, PlantSignal, recorded
from pipeline.temperature.tables import set_point_of

REFERENCE = "reference.json"  # in the champion's folder
PIECES = 4  # into which a single record of the champion is cut, to stand for nights
NIGHTS = 12  # of the champion's own recordings that a new one is held against
# a rival so far past its limit, in units of it, is said before the likeliest cause, which is within its own
AHEAD = 2.0
LONGEST = 7200  # samples of a record that are asked, its last ones
POOLED = 3  # nights over which an estimate is pooled
# sigmas from which on nights that each leave a change unnamed name it together; it is past its limit besides
TOGETHER = 4.0
CONTRADICTED = 9.0  # squares of deviations from their mean, for each night but one: beyond, they disagree
# several nights tell how the air around scatters from one to the next, pieces of one do not
NIGHTS_FLOORS, PIECES_FLOORS = baseline.Floors(0.03, 0.25), baseline.Floors(0.2, 2.0)
# mean offset of the champion's own nights, in units of drift.offset_degC, up to which they count as a
# closed loop at the references
SETTLED = 5.0
FOLDS = 4  # models that are identified without some of the champion's nights
# no machine changes by more within a night: then the record is in doubt
MOST_GAIN_PERCENT, MOST_OFFSET_DEGC = 80.0, 50.0
ROOM_DEGC, COLDEST_DEGC, HOTTEST_DEGC = 20.0, -30.0, 60.0  # of the champion's nights; of any room
UNEXPLAINED = 3.0  # by so much more than an honest record may leave, a record leaves what no cause explains
LIKELY, WORTH_NAMING = 4.0, 1.5  # times that a record fits better with a mistake undone
SHORTEST = 60  # samples of a stretch at one set-point that can settle
PARTS = 4  # of a record, whose scatter tells how well its closed-loop figures are known


class ProductionReference(NamedTuple):
    """What the champion's own recordings said of its model, and their closed-loop figures; `steps` (p,) are
    those of the sensors in °C. `digest` is that of reference.json, by which the memory of the nights knows it
    again."""

    machine: ProductionModel
    own: Baseline
    loop: list[dict[str, list[list[float]]]]
    steps: np.ndarray
    digest: str


class Estimate(NamedTuple):
    """A change that one night named: size in the unit of its limit, and its standard deviation."""

    amount: float
    deviation: float


class RecordingChange(NamedTuple):
    """A change of one recording: kind and channel for a machine to read, words for a person, the estimate and
    the limit that it is held against."""

    kind: str
    channel: str
    words: str
    estimate: Estimate
    limit: float

    @property
    def key(self) -> str:
        kind = self.kind.split(" or ")[0]
        return f"{kind} of {self.channel}" if self.channel else kind


class NightChanges(NamedTuple):
    """Of one night, by the key of the change: what it named, and where it named nothing in calm air, what
    each change would be as if it alone had come about."""

    named: dict[str, Estimate]
    seeming: dict[str, Estimate]


Nights = list[NightChanges]  # the last one last


# ---- the champion's own recordings


def reference(loop: NightlyLoop, folder: Path, only: Sequence[str] = ()) -> dict[str, Any] | None:
    """champion/<loop>/reference.json of the model below `folder`, from the loop's recordings, or `only` those
    named; None where they are none, or too short."""
    machine = recorded(params.load(Plant, "plant"), "datasets/ingest/record.parquet")
    records = judge.read_records(Path(loop.recordings), machine, {})
    named = [path.removeprefix(f"{loop.recordings}/") for path in only] or sorted(records)
    kept = [records[path].record for path in named if path in records]
    kept = [one for one in kept if judge.segments(one, machine)][-NIGHTS:]
    nights = [_last(judge.segments(one, machine)) for one in kept]
    floors = NIGHTS_FLOORS if len(nights) > 1 else PIECES_FLOORS
    if len(nights) == 1:
        nights = [
            [(part, other)]
            for u, y in nights[0]
            for part, other in zip(np.array_split(u, PIECES), np.array_split(y, PIECES), strict=True)
        ]
        kept = _cut(kept[0])
    try:
        production = ProductionModel(judge.identified(folder), _samples(nights))
        # of recordings that are named, the champion's model is not made
        own = baseline.measured(production, nights, floors, None if only else _without_each(machine, nights))
    except ValueError:
        return None
    return {
        "schema": "reference",
        "version": baseline.VERSION,
        "samples": _samples(nights),
        "own": own.to_json(),
        "loop": [_closed_loop(one, machine) for one in kept],
        "steps": sensors.steps(nights).tolist(),
    }


def _cut(record: Mapping[str, np.ndarray]) -> list[dict[str, np.ndarray]]:
    """The record's last LONGEST samples in PIECES."""
    parts = {name: np.array_split(column[-LONGEST:], PIECES) for name, column in record.items()}
    return [{name: columns[k] for name, columns in parts.items()} for k in range(PIECES)]


def _without_each(machine: Plant, nights: Sequence[Segments]) -> list[ProductionModel]:
    """For each night a model that was identified without it, as a new night's is: what such a model gets
    wrong of it is no change of the machine. Nights share FOLDS models. Raises ValueError where the others do
    not determine one."""
    own = params.read()["identify_plant"]
    settings = model_choice.Settings(offset=own["offset"], max_order=own["max_order"])
    names, folds = [signal.name for signal in machine.inputs], min(FOLDS, len(nights))
    models = []
    for fold in range(folds):
        others = [pair for k, night in enumerate(nights) if k % folds != fold for pair in night]
        u, y = [pair[0] for pair in others], [pair[1] for pair in others]
        found = model_choice.identify(
            u, y, sample_time_s=machine.sample_time_s, settings=settings, names=names
        )
        models.append(ProductionModel(found.plant, _samples(nights)))
    return [models[k % folds] for k in range(len(nights))]


def _read_reference(folder: Path) -> ProductionReference | None:
    path = folder / REFERENCE
    fields = artifacts.read_json(path) if path.exists() else {}
    if fields.get("version") != baseline.VERSION:
        return None
    machine = ProductionModel(judge.identified(folder), fields["samples"])
    steps = np.array(fields.get("steps", [np.inf] * machine.plant.p))
    return ProductionReference(
        machine, Baseline.read(fields["own"]), fields["loop"], steps, artifacts.sha256(path)
    )


def _last(segments: Segments) -> Segments:
    """The last LONGEST samples of a record: they tell enough, and a night has other things to do."""
    kept, left = [], LONGEST
    for u, y in reversed(segments):
        if left > 0:
            kept.append((u[-left:], y[-left:]))
            left -= len(u)
    return kept[::-1]


def _samples(nights: Sequence[Segments]) -> int:
    """Of a typical night."""
    return int(np.median([sum(len(u) for u, _ in night) for night in nights]))


# ---- a night's recordings


class SignalNames(NamedTuple):
    """Names of the machine's signals."""

    inputs: list[str]
    outputs: list[str]


def look(
    limits: DriftLimits,
    name: str,
    folder: str,
    new: Sequence[str],
    champion: Path | None,
    pending: set[str],
    recent: Mapping[str, Any],
) -> tuple[LoopDrift, dict[str, Any] | None]:
    """Drift of loop `name` by its new recordings below `folder`, against the champion's, and what the next
    night must remember of this one (see `DriftMemory.recent`); `recent` is what the nights before named. A
    recording that cannot be read, or is not what it says, is set aside."""
    drifted = LoopDrift.none(name)
    if not Path(folder).is_dir():
        return drifted, None
    machine, broken = recorded(params.load(Plant, "plant"), "datasets/ingest/record.parquet"), {}
    records = judge.read_records(Path(folder), machine, broken)
    for path, reason in broken.items():
        if f"{folder}/{path}" in new:
            _silent(drifted, f"{folder}/{path}", reason, [output.name for output in machine.outputs])
            drifted.quarantined[f"{folder}/{path}"] = quarantine(f"{folder}/{path}", name, reason)
    good = {
        path: records[within]
        for path in new
        if path not in drifted.quarantined and (within := path.removeprefix(f"{folder}/")) in records
    }
    if champion is None or not good:
        return drifted, None
    held = _read_reference(champion)
    if held is None:
        drifted.notes.append(
            f"{name}: the champion has no reference of its own recordings that this version reads: drift was "
            "not measured; the next promotion makes one"
        )
        return drifted, None
    nights = _nights(recent, held.digest)
    for path, result in good.items():
        if _stand_still(drifted, path, result.record, held, machine):
            continue
        segments = _last(judge.segments(result.record, machine))
        if not segments:
            continue
        try:
            drifted = _one(limits, drifted, path, result.record, held, machine, nights, pending)
        except ValueError as error:
            drifted.notes.append(f"{path}: {error}")
    recent = {
        "nights": [_rounded(night.named) for night in nights],
        "seeming": [_rounded(night.seeming) for night in nights],
    }
    return drifted, {"reference": held.digest, **recent}


def _nights(recent: Mapping[str, Any], digest: str) -> Nights:
    """The nights before, where they were held against the same reference."""
    if recent.get("reference") != digest:
        return []
    named = recent.get("nights", [])
    seeming = recent.get("seeming", [{}] * len(named))
    return [
        NightChanges(_estimates(one), _estimates(other)) for one, other in zip(named, seeming, strict=True)
    ]


def _estimates(night: Mapping[str, Sequence[float]]) -> dict[str, Estimate]:
    return {key: Estimate(*pair) for key, pair in night.items()}


def _rounded(night: Mapping[str, Estimate]) -> dict[str, list[float]]:
    return {key: [round(float(part), 6) for part in estimate] for key, estimate in night.items()}


def _least(limits: DriftLimits, explained: Explanation, held: ProductionReference, names: SignalNames) -> str:
    """The smallest changes of a gain and of an offset that would have been an alarm tonight, of the signal
    that is known least."""
    words = []
    for article, kind, unit in (("a", "gain", "%"), ("an", "offset", "°C")):
        sizes = {
            _name(fit.cause, names): _limit(limits, fit.cause)
            + limits.limit_sigmas * _amount(fit, held, ()).deviation
            for fit in (*explained.others, *(named.fit for named in explained.named))
            if fit.cause.kind == kind and fit.cause.channel >= 0
        }
        worst = max(sizes, key=sizes.__getitem__)
        words.append(f"{article} {kind} of {worst} from {sizes[worst]:.1f} {unit} on")
    return " and ".join(words)


def _silent(drifted: LoopDrift, path: str, reason: str, outputs: Sequence[str]) -> None:
    """An alarm for a recording that cannot be read because a sensor gives no number in it."""
    for output in outputs:
        if f"should hold numbers for {output} but all of its" in reason:
            _doubt(drifted, path, output, f"{output} gives no number.")


def _stand_still(
    drifted: LoopDrift, path: str, record: dict[str, np.ndarray], held: ProductionReference, machine: Plant
) -> bool:
    """Whether a sensor gives no number or stands still in a recording: then that is an alarm, the recording
    is set aside, and nothing else is asked of it. Readings in °F or K are out of limits as well: no alarm."""
    readings = _last(judge.segments(record, machine, masked=False))
    noise = np.exp(held.own.noise.mean(axis=0) / 2)
    found = sensors.faults(held.machine.plant, machine, readings, noise=noise, steps=held.steps)
    if not found:
        return False
    if all(fault.kind == sensors.OPEN for fault in found):
        names = SignalNames([i.name for i in machine.inputs], [o.name for o in machine.outputs])
        mistake = mistakes.found(held.machine, readings, held.own, inputs=names.inputs, outputs=names.outputs)
        if mistake:
            drifted.quarantined[path] = quarantine(path, drifted.loop, f"{path}: {mistake.reason}")
            return True
    for fault in found:
        _doubt(drifted, path, fault.output, fault.sentence)
    reason = f"{path}: {found[0].sentence} It says nothing of the machine"
    drifted.quarantined[path] = quarantine(path, drifted.loop, reason)
    return True


def _doubt(drifted: LoopDrift, path: str, output: str, sentence: str) -> None:
    cause = f"{sentence} Check the sensor and its wiring before the machine heats again"
    key = f"{drifted.loop}: sensor {output}"
    drifted.alarms.append(Alarm(drifted.loop, key, path, cause, 99.9, (), SENSOR, output))


def _one(
    limits: DriftLimits,
    drifted: LoopDrift,
    path: str,
    record: dict[str, np.ndarray],
    held: ProductionReference,
    machine: Plant,
    nights: Nights,
    pending: set[str],
) -> LoopDrift:
    """The loop's drift with what one recording says; it joins `nights`."""
    segments, closed_loop = _last(judge.segments(record, machine)), _closed_loop(record, machine)
    names = SignalNames([i.name for i in machine.inputs], [o.name for o in machine.outputs])
    mistake = mistakes.found(held.machine, segments, held.own, inputs=names.inputs, outputs=names.outputs)
    if mistake:
        drifted.quarantined[path] = quarantine(path, drifted.loop, f"{path}: {mistake.reason}")
        segments, closed_loop = mistake.undone, {}
    measured = _measure(limits, segments, held, closed_loop, names)
    if not mistake and (doubt := _doubtful(measured, segments, held, names)):
        if doubt.wrong:
            drifted.quarantined[path] = quarantine(path, drifted.loop, f"{path}: {doubt.words}")
            return drifted
        if not measured.found:
            drifted.notes.append(f"{path}: {doubt.words}, and no single change explains it")
        measured = measured._replace(
            found=[one._replace(words=f"{one.words}; or {doubt.words}") for one in measured.found]
        )
    drifted.figures[path] = measured.figures
    drifted.notes.append(f"{Path(path).name} would have shown {measured.figures.least}")
    nights.append(NightChanges({found.key: found.estimate for found in measured.found}, measured.seeming))
    del nights[:-POOLED]
    singly = [
        (found, _past_limit([night.named.get(found.key) for night in nights], found.limit))
        for found in measured.found
    ]
    pooled = [
        (found, _past_limit([found.estimate], found.limit)) for found in together(limits, nights, held, names)
    ]
    told = [cause.words for cause in measured.loop]
    alarms, watched = list(drifted.alarms), list(drifted.watched)
    for found, sure in (*pooled, *singly):
        if abs(found.estimate.amount) < found.limit and sure < limits.limit_sigmas:
            continue
        estimate = found.estimate
        sigmas = float(np.clip(estimate.amount / max(estimate.deviation, 1e-9), -999.0, 999.0))
        alarm = Alarm(
            drifted.loop, f"{drifted.loop}: {found.key}", path, found.words, round(sigmas, 1), tuple(told),
            found.kind, found.channel,
        )  # fmt: skip
        (alarms if sure >= limits.limit_sigmas else watched).append(alarm)
    drifted = drifted._replace(alarms=alarms, watched=watched)
    if alarms or watched:
        return drifted
    return pictures.with_alarms(drifted, limits, path, measured.loop, pending)


def _past_limit(estimates: Sequence[Estimate | None], limit: float) -> float:
    """How surely a change is past its limit, in sigmas: the largest of the last nights' evidence together, of
    the last one, the last two, and so on while they agree in sign (Page's test; Page 1954)."""
    largest, total, sign = -np.inf, 0.0, 0.0
    for k, estimate in enumerate(reversed(estimates), 1):
        if estimate is None or sign * estimate.amount < 0:
            break
        sign = np.sign(estimate.amount)
        total += (abs(estimate.amount) - limit) / max(estimate.deviation, 1e-9)
        largest = max(largest, total / np.sqrt(k))
    return float(largest)


def together(
    limits: DriftLimits, nights: Nights, held: ProductionReference, names: SignalNames
) -> list[RecordingChange]:
    """What the last nights name together where the last one by itself names nothing: the change whose mean
    over two or more of them, weighted by what each knows, explains most (fixed effects; Basseville and
    Nikiforov 1993, ch. 2.4). Empty where none is TOGETHER sigmas from none."""
    causes = drift.causes(held.machine.plant)
    usual, best = held.own.usual(causes), (TOGETHER**2, [])
    for count in range(2, len(nights) + 1):
        means = [
            (cause, mean)
            for cause in causes
            if (mean := _mean_of(nights[-count:], _key(cause, names)))
            and _worth(mean) > 2 * count * usual[cause]
        ]
        means.sort(key=lambda one: -_worth(one[1]))
        if means and (most := _worth(means[0][1])) > best[0]:
            rivals = [one for one in means if most - _worth(one[1]) < drift.RIVALS]
            best = most, [_said(limits, cause, mean, names) for cause, mean in rivals]
    return [_likeliest(best[1])] if best[1] else []


def _mean_of(nights: Nights, key: str) -> Estimate | None:
    """Mean of a change over the nights that know of it, weighted by what they know; None where the last one
    does not, no other does, or they contradict each other (Cochran 1954): what came may have gone."""
    known = [night.named.get(key) or night.seeming.get(key) for night in nights]
    if nights[-1].seeming.get(key) is None or sum(one is not None for one in known) < 2:
        return None
    weights = np.array([1 / max(one.deviation, 1e-9) ** 2 for one in known if one])
    amounts = np.array([one.amount for one in known if one])
    mean = float(weights @ amounts / weights.sum())
    if weights @ (amounts - mean) ** 2 > CONTRADICTED * (len(amounts) - 1):
        return None
    return Estimate(mean, float(weights.sum() ** -0.5))


def _worth(estimate: Estimate) -> float:
    """What a change explains: its sigmas from none, squared."""
    return (estimate.amount / estimate.deviation) ** 2


# ---- one recording


class RecordingDrift(NamedTuple):
    """Of one recording: figures for the page, what changed, what each change would be where none is named,
    and what the closed loop does otherwise beyond what those changes and the air around bring. `misfit` is
    the mean squared error that is left, in that of the champion's own."""

    figures: RecordingFigures
    found: list[RecordingChange]
    seeming: dict[str, Estimate]
    loop: list[CameraChange]
    misfit: float


class Doubt(NamedTuple):
    """That a record may not be of this machine, in words; `wrong`: it is set aside, and no cause is named."""

    words: str
    wrong: bool


def _doubtful(
    measured: RecordingDrift, segments: Segments, held: ProductionReference, names: SignalNames
) -> Doubt | None:
    """None where the causes that were named can be, and explain the record. A heater that is dead looks like
    commands that are written too large: a gain that fell is told with the mistake beside it."""
    cannot_be = [one for one in measured.found if _cannot_be(one)]
    unexplained = measured.misfit > UNEXPLAINED * mistakes.honest(held.own)
    if not cannot_be and not unexplained and len(measured.found) < drift.MOST:
        return None
    likeliest = mistakes.likeliest(
        held.machine, segments, held.own, inputs=names.inputs, outputs=names.outputs
    )
    words = "this record does not fit the machine"
    if likeliest.better >= WORTH_NAMING:
        words += (
            f": likeliest mistake: {likeliest.words}; undone, it fits {likeliest.better:.0f} times better"
        )
    fell = [one for one in cannot_be if one.kind.startswith("gain") and one.estimate.amount < 0]
    return Doubt(words, likeliest.better >= LIKELY and not fell)


def _cannot_be(found: RecordingChange) -> bool:
    """Whether no machine changes so within a night."""
    kind, amount = found.kind.split(" or ")[0], found.estimate.amount
    if kind == "ambient":
        return not COLDEST_DEGC < ROOM_DEGC + amount < HOTTEST_DEGC
    return abs(amount) > {"gain": MOST_GAIN_PERCENT, "offset": MOST_OFFSET_DEGC}.get(kind, np.inf)


def _measure(
    limits: DriftLimits,
    segments: Segments,
    held: ProductionReference,
    closed_loop: Mapping[str, list[list[float]]],
    names: SignalNames,
) -> RecordingDrift:
    own, asked = held.own, drift.causes(held.machine.plant)
    record, explained = drift.explain_segments(
        held.machine, segments, own.scale, own.changes, own.usual(asked)
    )
    found = [_found(limits, named, record, held, segments, names) for named in explained.named]
    noise, louder = _noise(limits, record, explained, held, names)
    air = drift.levels(record, explained.changes)[0]
    if abs(air) > limits.ambient_degC:
        found.append(_air(limits, air, record, held))
    effect = drift.moved(record, own.changes, explained.changes) + abs(air)
    loop = _loop(limits, closed_loop, held, names, effect, asked=not found)
    parameters = _parameters(record, explained, held, names)
    least = _least(limits, explained, held, names)
    figures = RecordingFigures(parameters, noise, loop.figures, loop.not_applicable, least)
    seeming = _seeming(record, explained, held, names)
    samples = sum(int(one.measured.sum()) for one in record.segments)
    misfit = float(explained.left @ explained.left) / max(samples, 1)
    return RecordingDrift(figures, [*found, *louder], seeming, loop.causes, misfit)


def _seeming(
    record: DriftRecord, explained: Explanation, held: ProductionReference, names: SignalNames
) -> dict[str, Estimate]:
    """What each change would be as if it alone had come about, where none is named and the air is calm: what
    restless air does to a level is much the same every night, and no mean takes it away. A cap has no size
    to take a mean of."""
    if explained.named or not record.room.calm:
        return {}
    fits = [fit for fit in explained.others if fit.cause.kind != "saturation"]
    return {_key(fit.cause, names): _amount(fit, held, ()) for fit in fits}


def _name(cause: DriftCause, names: SignalNames) -> str:
    of = names.outputs if cause.kind in ("offset", "late sensor") else names.inputs
    return of[cause.channel] if cause.channel >= 0 else "every input"


def _amount(fit: CauseFit, held: ProductionReference, segments: Segments) -> Estimate:
    """A fit in the unit of its limit: percent, s, °C, or percent of the record."""
    cause, value, deviation = fit.cause, fit.value, fit.deviation
    if cause.kind == "saturation":
        least, most = (drift.above(segments, cause.channel, value + side * deviation) for side in (1, -1))
        return Estimate(drift.above(segments, cause.channel, value), max((most - least) / 2, 0.5))
    at = drift.causes(held.machine.plant).index(cause)
    among = drift.shift(
        np.array([value]), np.array([deviation]),
        held.own.values[:, [at]], held.own.deviations[:, [at]],
    )  # fmt: skip
    moved, deviation = float(among.value[0] - among.reference[0]), float(among.deviation[0])
    if cause.kind == "gain":
        return Estimate(100 * moved, 100 * deviation)
    if cause.kind == "time constant":
        longer = 1 / (1 + max(moved, -0.9))
        return Estimate(100 * (longer - 1), 100 * deviation * longer**2)
    if cause.kind in ("delay", "late sensor"):
        step = held.machine.plant.sample_time_s
        return Estimate(moved * step, deviation * step)
    return Estimate(moved, deviation)


def _found(
    limits: DriftLimits,
    named: drift.NamedCause,
    record: DriftRecord,
    held: ProductionReference,
    segments: Segments,
    names: SignalNames,
) -> RecordingChange:
    """What is said of a named change, and of what the record cannot tell it from."""
    told = []
    for fit in (named.fit, *named.rivals):
        told.append(_said(limits, fit.cause, _amount(fit, held, segments), names, fit.value))
    return _likeliest(told)


def _said(
    limits: DriftLimits, cause: DriftCause, estimate: Estimate, names: SignalNames, cap: float = np.nan
) -> RecordingChange:
    """A change in words; `cap` in percent is the level of a saturation."""
    name = _name(cause, names)
    words = _words(cause, estimate.amount, name, cap)
    return RecordingChange(_kind(cause), name, words, estimate, _limit(limits, cause))


def _likeliest(told: Sequence[RecordingChange]) -> RecordingChange:
    """Rivals, the likeliest first, as one: where one of them is far past its own limit and the likeliest is
    not, it is said first."""
    first = max(told, key=_past)
    if _past(first) < AHEAD or _past(told[0]) >= 1:
        first = told[0]
    told = [first, *(one for one in told if one is not first)]
    rest = ": this record cannot tell which" if len(told) > 1 else ""
    kinds = dict.fromkeys(one.kind for one in told)
    return first._replace(kind=" or ".join(kinds), words=", or ".join(one.words for one in told) + rest)


def _past(found: RecordingChange) -> float:
    """The change in units of its limit."""
    return abs(found.estimate.amount) / found.limit


def _limit(limits: DriftLimits, cause: DriftCause) -> float:
    return {
        "gain": limits.parameter_percent, "time constant": limits.time_constant_percent,
        "delay": limits.delay_s, "offset": limits.offset_degC, "saturation": limits.at_limits_points,
    }[_kind(cause)]  # fmt: skip


def _key(cause: DriftCause, names: SignalNames) -> str:
    return f"{_kind(cause)} of {_name(cause, names)}"


def _kind(cause: DriftCause) -> str:
    return "delay" if cause.kind == "late sensor" else cause.kind


def _words(cause: DriftCause, amount: float, name: str, cap: float) -> str:
    kind = cause.kind
    if kind == "gain":
        return f"the gain from {name} has changed by {amount:+.1f} %"
    if kind == "time constant":
        return f"the time constants of what answers to {name} have changed by {amount:+.1f} %"
    if kind == "saturation":
        return (
            f"{name} no longer gives more than {cap:.0f} %: more was asked of it in {amount:.0f} % of "
            "the record"
        )
    if kind == "offset":
        return (
            f"{name} reads {amount:+.1f} °C from what it did: its offset, or the heat lost there, has changed"
        )
    verb, word = ("reads" if kind == "late sensor" else "acts"), ("later" if amount > 0 else "earlier")
    clock = ", or the clock of the outputs is off against that of the inputs" if cause.channel < 0 else ""
    return f"{name} {verb} {abs(amount):.1f} s {word} than it did{clock}"


def _air(limits: DriftLimits, air: float, record: DriftRecord, held: ProductionReference) -> RecordingChange:
    word = "warmer" if air > 0 else "colder"
    words = (
        f"it is {abs(air):.0f} °C {word} around the machine than on the champion's own nights, or every "
        "sensor reads so much from what it did"
    )
    deviation = float(np.hypot(drift.air_deviation(record), held.own.scale.ambient))
    return RecordingChange("ambient", "", words, Estimate(air, deviation), limits.ambient_degC)


def _noise(
    limits: DriftLimits,
    record: DriftRecord,
    explained: Explanation,
    held: ProductionReference,
    names: SignalNames,
) -> tuple[dict[str, InnovationChange], list[RecordingChange]]:
    """Noise of each output, and by how many degrees of its steady level it is off what the champion's nights
    had; then the noises that have changed."""
    value, deviation = baseline.noise(drift.by_output(record, explained.left))
    noise = drift.shift(value, deviation, held.own.noise, held.own.noise_deviation)
    air, own = drift.levels(record, held.own.changes)
    ratio = np.exp(0.5 * (noise.value - noise.reference))
    figures, found = {}, []
    for i, output in enumerate(names.outputs):
        percent, sigmas = 100 * float(ratio[i] - 1), float(noise.sigmas[i])
        level = air + own[i]
        known = np.hypot(held.own.scale.ambient, held.own.scale.level[i])
        figures[output] = InnovationChange(percent, sigmas, float(level), float(level / known))
        word = "grown" if percent > 0 else "fallen"
        words = f"the noise of {output} has {word} by {abs(percent):.0f} %"
        # of a logarithm of a variance
        estimate = Estimate(percent, 50 * float(ratio[i] * noise.deviation[i]))
        if abs(percent) > 0.5 * limits.noise_percent and abs(sigmas) >= drift.SURE:
            found.append(RecordingChange("noise", output, words, estimate, limits.noise_percent))
    return figures, found


def _parameters(
    record: DriftRecord, explained: Explanation, held: ProductionReference, names: SignalNames
) -> dict[str, ParameterChange]:
    """{cause: change in percent, half of its 90 % band, sigmas} of gains and time constants: what was named,
    and what the others seem beside it."""
    fits = {fit.cause: fit for fit in (*explained.others, *(named.fit for named in explained.named))}
    changes = {}
    for cause in drift.causes(held.machine.plant):
        if cause.kind in ("gain", "time constant"):
            percent, deviation = _amount(fits[cause], held, ())
            changes[f"{cause.kind} from {_name(cause, names).replace('every input', 'all inputs')}"] = (
                ParameterChange(percent, 1.645 * deviation, percent / max(deviation, 1e-9))
            )
    return changes


# ---- the closed loop


def _closed_loop(record: Mapping[str, np.ndarray], machine: Plant) -> dict[str, list[list[float]]]:
    """Offset of each output from its set-point where it is settled in °C, root mean square of each input and
    its share of samples at a limit, both in percent, and the settled set-points in °C: [figures, their
    standard deviations], from PARTS of the record, which are longer than what a loop remembers. Empty where
    nothing is settled."""
    u, y = (_last_of(record, signals) for signals in (machine.inputs, machine.outputs))
    wanted = np.column_stack(
        [
            record.get(set_point_of(o.name), np.full(len(record["time_s"]), o.reference))[-LONGEST:]
            for o in machine.outputs
        ]
    )
    settled = _settled(wanted)
    if settled.sum() < PARTS * SHORTEST:
        return {}
    low, high = np.array([(i.low, i.high) for i in machine.inputs]).T
    limited = 100.0 * ((u <= low + 1e-9) | (u >= high - 1e-9))
    mean_square, deviation = np.array(_mean(u**2))
    effort = np.sqrt(mean_square)
    return {
        "offset_degC": _mean((y - wanted)[settled]),
        "effort_percent": [effort.tolist(), (deviation / np.maximum(2 * effort, 1e-9)).tolist()],
        "at_limits_percent": _mean(limited),
        "set_point_degC": [wanted[settled].mean(axis=0).tolist(), [0.0] * len(machine.outputs)],
    }


def _last_of(record: Mapping[str, np.ndarray], signals: Sequence[PlantSignal]) -> np.ndarray:
    """(T, k) of the last LONGEST samples; NaN where one is masked."""
    columns = [np.where(record[f"{s.name}_masked"], np.nan, record[s.name]) for s in signals]
    return np.column_stack(columns)[-LONGEST:].astype(float)


def _settled(wanted: np.ndarray) -> np.ndarray:
    """Where (T,) a loop has had time to reach its set-points (T, p): the last two thirds of a stretch of
    SHORTEST samples or more in which none is changed. No set-point, or 0, is a heater that is off."""
    changes = np.flatnonzero((np.diff(wanted, axis=0) != 0).any(axis=1)) + 1
    edges = [0, *changes.tolist(), len(wanted)]
    settled = np.zeros(len(wanted), bool)
    for begin, end in itertools.pairwise(edges):
        if end - begin >= SHORTEST:
            settled[begin + (end - begin) // 3 : end] = True
    return settled & (wanted > 0).all(axis=1)


def _mean(values: np.ndarray) -> list[list[float]]:
    """Mean (k,) of values (T, k) that are there, and its standard deviation from the means of PARTS."""
    parts = np.ma.masked_invalid(values)
    means = np.ma.stack([part.mean(axis=0) for part in np.array_split(parts, PARTS)])
    return [
        parts.mean(axis=0).filled(0.0).tolist(),
        (means.std(axis=0, ddof=1) / np.sqrt(PARTS)).filled(0.0).tolist(),
    ]


class LoopChanges(NamedTuple):
    """Of the closed loop: figures by name, what has changed, and why it was not asked, if it was not."""

    figures: dict[str, ClosedLoopChange]
    causes: list[CameraChange]
    not_applicable: str = ""


def _loop(
    limits: DriftLimits,
    now: Mapping[str, list[list[float]]],
    held: ProductionReference,
    names: SignalNames,
    effect: np.ndarray,
    *,
    asked: bool,
) -> LoopChanges:
    """Offset, effort and share at limits against the champion's own nights; not asked where those were not
    settled at the references. `effect` (p,) are the °C that the changes of the machine and the air around
    bring: what they explain is not counted again; `asked` is whether the machine is as it was."""
    nights = [night for night in held.loop if night]
    if not now or not nights:
        return LoopChanges({}, [], "no stretch is settled at a set-point")
    usual = {key: np.array([night[key] for night in nights]) for key in now}
    offset = usual["offset_degC"][:, 0].mean(axis=0)
    unsure = np.sqrt((usual["offset_degC"][:, 1] ** 2).mean(axis=0) / len(nights))
    if (np.abs(offset) > SETTLED * limits.offset_degC + 2 * unsure).any():
        return LoopChanges(
            {}, [], "the champion's own recordings are not of a loop settled at the references"
        )
    figures, causes = {}, []
    aims = usual["set_point_degC"][:, 0]
    elsewhere = np.abs(now["set_point_degC"][0] - aims).min(axis=0).max() > limits.offset_degC
    for key, (sentence, least, allowed) in _asked(limits, held, names, effect).items():
        if elsewhere and key != "offset_degC":  # other set-points take other duties
            continue
        of = names.outputs if key == "offset_degC" else names.inputs
        moved = _loop_shift(now[key], usual[key], least)
        for k, (name, by) in enumerate(zip(of, moved.value - moved.reference, strict=True)):
            figures[f"{name} {key}"] = ClosedLoopChange(float(by), float(moved.sigmas[k]))
            beyond = abs(by) - least - (allowed[k] if asked else 0.0)
            if beyond > 0:
                words = f"closed loop: {name} {sentence.format(f'{by:+.2g}')}"
                sigmas = float(moved.sigmas[k]) * beyond / abs(by) if asked else float(moved.sigmas[k])
                causes.append(CameraChange(f"{key} of {name}", words, sigmas))
    return LoopChanges(figures, causes)


def _asked(
    limits: DriftLimits, held: ProductionReference, names: SignalNames, effect: np.ndarray
) -> dict[str, tuple[str, float, np.ndarray]]:
    """By figure of the closed loop: its sentence, what matters, and what the machine's changes may bring."""
    plant = held.machine.plant
    steady = np.abs(plant.C @ np.linalg.solve(np.eye(plant.n) - plant.A, plant.B) + plant.D)
    strongest = steady.argmax(axis=0)
    points = effect[strongest] / np.maximum(steady[strongest, np.arange(plant.m)], 1e-9)
    none = np.zeros(plant.m)
    return {
        "offset_degC": ("settles {} °C from where it did", limits.offset_degC, effect),
        "effort_percent": ("needs {} points of effort more than it did", limits.effort_percent, points),
        "at_limits_percent": (
            "is at a limit {} points more of the time than it was", limits.at_limits_points, none,
        ),
    }  # fmt: skip


def _loop_shift(now: list[list[float]], usual: np.ndarray, least: float) -> drift.Shift:
    """Of one figure against those of the champion's nights (nights, 2, signals)."""
    # a figure counts as known to a sixth of what matters at best, so that
    # nights that agree by chance make no alarm of a trifle
    own = np.maximum([*usual[:, 1], now[1]], least / 6)
    # a few parts of one night say little of how well a mean is known: those of all nights say it
    # together; a short or restless night is known less well
    pooled = np.maximum(np.sqrt((own**2).mean(axis=0)), own[-1])
    return drift.shift(np.array(now[0]), pooled, usual[:, 0], own[:-1], freedom=(PARTS - 1) * len(own))
