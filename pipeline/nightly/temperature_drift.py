"""The temperature loop's part of a night: new recordings held against those of the champion. A record that is
not what it says is set aside, and what it says of the machine, put right, counts all the same."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.nightly import baseline, drift, judge, mistakes, pictures, sensors
from pipeline.nightly.baseline import Baseline
from pipeline.nightly.camera_drift import CameraChange
from pipeline.nightly.drift import CauseFit, DriftRecord, Explanation, ProductionModel, Segments
from pipeline.nightly.inputs import quarantine
from pipeline.nightly.records import SENSOR, Alarm, Memory, NightDrift
from pipeline.nightly.settings import DriftLimits, NightlyLoop
from pipeline.store import artifacts, params
from pipeline.temperature.identification import model_choice
from pipeline.temperature.settings import Plant, recorded
from pipeline.temperature.tables import set_point_of

REFERENCE = "reference.json"  # in the champion's folder
PIECES = 4  # into which a single record of the champion is cut, to stand for nights
NIGHTS = 12  # of the champion's own recordings that a new one is held against
# a rival so far past its limit, in units of it, is said before the likeliest cause, which is within its own
AHEAD = 2.0
LONGEST = 7200  # samples of a record that are asked, its last ones
POOLED = 3  # nights over which an estimate is pooled
# several nights tell how the air around scatters from one to the next, pieces of one do not
NIGHTS_FLOORS, PIECES_FLOORS = baseline.Floors(0.03, 0.25), baseline.Floors(0.2, 2.0)
# mean offset of the champion's own nights, in units of drift.offset_degC, up to which they count as a
# closed loop at the references
SETTLED = 5.0
FOLDS = 4  # models that are identified without some of the champion's nights
# no machine changes by more within a night: then the record is in doubt
MOST_GAIN_PERCENT, MOST_OFFSET_DEGC = 80.0, 50.0
FELL_PERCENT = -60.0  # a heater that gives so much less looks like commands that are written too large
ROOM_DEGC, COLDEST_DEGC, HOTTEST_DEGC = 20.0, -30.0, 60.0  # of the champion's nights; of any room
UNEXPLAINED = 3.0  # by so much more than an honest record may leave, a record leaves what no cause explains
LIKELY, WORTH_NAMING = 4.0, 1.5  # times that a record fits better with a mistake undone
SHORTEST = 60  # samples of a stretch at one set-point that can settle
PARTS = 4  # of a record, whose scatter tells how well its closed-loop figures are known


# by kind of cause: its limit in nightly.drift, and what is said of it; `size` is in the unit of the limit
SENTENCES = {
    "gain": ("parameter_percent", "the gain from {name} has changed by {size:+.1f} %"),
    "time constant": (
        "time_constant_percent",
        "the time constants of what answers to {name} have changed by {size:+.1f} %",
    ),
    "saturation": (
        "at_limits_points",
        "{name} no longer gives more than {value:.0f} %: more was asked of it in {size:.0f} % of the record",
    ),
    "offset": (
        "offset_degC",
        "{name} reads {size:+.1f} °C from what it did: its offset, or the heat lost there, has changed",
    ),
    "delay": ("delay_s", "{name} acts {late} than it did{clock}"),
    "late sensor": ("delay_s", "{name} reads {late} than it did{clock}"),
}


class ProductionReference(NamedTuple):
    """What the champion's own recordings said of its model, and their closed-loop figures. Of the sensors:
    `steps` (p,) in °C, and `reversals` (p,), the share of samples at which each turns back. `digest` is that
    of reference.json, by which the memory of the nights knows it again. Then the machine as it is declared,
    and the limits that changes are held against."""

    machine: ProductionModel
    own: Baseline
    loop: list[dict[str, list[list[float]]]]
    steps: np.ndarray
    reversals: np.ndarray
    digest: str
    plant: Plant
    limits: DriftLimits

    @property
    def signals(self) -> dict[str, list[str]]:
        """Names of inputs and outputs."""
        return {side: [one.name for one in getattr(self.plant, side)] for side in ("inputs", "outputs")}


class RecordingChange(NamedTuple):
    """A change of one recording: kind and channel for a machine to read, words for a person; size in the unit
    of its limit, the standard deviation of the size, and the limit."""

    kind: str
    channel: str
    words: str
    size: float
    deviation: float
    limit: float

    @property
    def key(self) -> str:
        kind = self.kind.split(" or ")[0]
        return f"{kind} of {self.channel}" if self.channel else kind


# ---- the champion's own recordings


def reference(loop: NightlyLoop, folder: Path, only: Sequence[str] = ()) -> dict[str, Any] | None:
    """champion/<loop>/reference.json of the model below `folder`, from the loop's recordings, or `only` those
    named; None if they are none, or too short."""
    machine = recorded(params.load(Plant, "plant"), "datasets/ingest/record.parquet")
    records = judge.read_records(Path(loop.recordings), machine, {})
    named = [path.removeprefix(f"{loop.recordings}/") for path in only] or sorted(records)
    kept = [records[path].record for path in named if path in records]
    kept = [one for one in kept if judge.segments(one, machine)][-NIGHTS:]
    floors = NIGHTS_FLOORS
    if len(kept) == 1:
        parts = {name: np.array_split(column[-LONGEST:], PIECES) for name, column in kept[0].items()}
        pieces = [{name: columns[k] for name, columns in parts.items()} for k in range(PIECES)]
        kept = [one for one in pieces if judge.segments(one, machine)]
        floors = PIECES_FLOORS
    nights = [_last(judge.segments(one, machine)) for one in kept]
    samples = int(np.median([sum(len(u) for u, _ in night) for night in nights])) if nights else 0
    try:
        production = ProductionModel(judge.identified(folder), samples)
        # of recordings that are named, the champion's model is not made
        without = None if only else _without_each(machine, nights, samples)
        own = baseline.measured(production, nights, floors, without)
    except ValueError:
        return None
    return {
        "schema": "reference",
        "version": baseline.VERSION,
        "samples": samples,
        "own": own.to_json(),
        "loop": [_closed_loop(one, machine) for one in kept],
        "steps": sensors.smallest_changes(nights).tolist(),
        "reversals": sensors.reversals(nights).tolist(),
    }


def _without_each(machine: Plant, nights: Sequence[Segments], samples: int) -> list[ProductionModel]:
    """For each night a model that was identified without it, as a new night's is: what such a model gets
    wrong of it is no change of the machine. Nights share FOLDS models. Raises ValueError if the others do
    not determine one."""
    own = params.read()["identify_plant"]
    settings = model_choice.Settings(offset=own["offset"], max_order=own["max_order"])
    names, folds = [signal.name for signal in machine.inputs], min(FOLDS, len(nights))
    models = []
    for fold in range(folds):
        pairs = [pair for k, night in enumerate(nights) if k % folds != fold for pair in night]
        u, y = ([pair[side] for pair in pairs] for side in (0, 1))
        model = model_choice.identify(
            u, y, sample_time_s=machine.sample_time_s, settings=settings, names=names
        )
        models.append(ProductionModel(model.plant, samples))
    return [models[k % folds] for k in range(len(nights))]


def read_reference(folder: Path, machine: Plant, limits: DriftLimits) -> ProductionReference | None:
    """That of a champion's folder; None if it has none that this version reads."""
    path = folder / REFERENCE
    fields = artifacts.read_json(path) if path.exists() else {}
    if fields.get("version") not in (baseline.BEFORE, baseline.VERSION):
        return None
    own = fields["own"] if fields["version"] == baseline.VERSION else baseline.rewrite(fields["own"])
    model = ProductionModel(judge.identified(folder), fields["samples"])
    return ProductionReference(
        model,
        Baseline.read(own),
        fields["loop"],
        np.array(fields.get("steps", [np.inf] * model.plant.p)),
        np.array(fields.get("reversals", [0.0] * model.plant.p)),
        artifacts.sha256(path),
        machine,
        limits,
    )


def _last(segments: Segments) -> Segments:
    """The last LONGEST samples of a record: they tell enough, and a night has other things to do."""
    ends = np.cumsum([len(u) for u, _ in segments])
    skips = [
        max(int(ends[-1] - LONGEST - (end - len(u))), 0) for end, (u, _) in zip(ends, segments, strict=True)
    ]
    return [(u[skip:], y[skip:]) for skip, (u, y) in zip(skips, segments, strict=True) if skip < len(u)]


# ---- a night's recordings


def look(
    findings: NightDrift,
    limits: DriftLimits,
    loop: str,
    folder: str,
    new: Sequence[str],
    champion: Path | None,
    memory: Memory,
) -> dict[str, Any]:
    """Adds to `findings` what the new recordings below `folder` say of the loop's machine, held against those
    of its champion; what the next night must remember of this one (see `Memory.recent`). A recording that
    cannot be read, or is not what it says, is set aside."""
    recent = memory.recent.get(loop, {})
    if not Path(folder).is_dir():
        return recent
    machine, broken = recorded(params.load(Plant, "plant"), "datasets/ingest/record.parquet"), {}
    records = judge.read_records(Path(folder), machine, broken)
    within = {path: path.removeprefix(f"{folder}/") for path in new}
    for path in (path for path in new if within[path] in broken):
        reason = broken[within[path]]
        for output in machine.outputs:
            if f"should hold numbers for {output.name} but all of its" in reason:
                _doubt(findings, loop, path, output.name, f"{output.name} gives no number.")
        findings.quarantined[path] = quarantine(path, loop, reason)
    good = {path: records[within[path]].record for path in new if within[path] in records}
    if champion is None or not good:
        return recent
    production = read_reference(champion, machine, limits)
    if production is None:
        findings.notes.append(
            f"{loop}: the champion has no reference of its own recordings that this version reads: drift was "
            "not measured; the next promotion makes one"
        )
        return recent
    nights = list(recent["nights"]) if recent.get("reference") == production.digest else []
    for path, record in good.items():
        try:
            if not _stand_still(findings, loop, path, record, production):
                _hold_against(findings, loop, path, record, production, nights, memory.pending)
        except ValueError as error:
            findings.notes.append(f"{path}: {error}")
    return {"reference": production.digest, "nights": nights}


def _stand_still(
    findings: NightDrift, loop: str, path: str, record: dict[str, np.ndarray], production: ProductionReference
) -> bool:
    """Whether a sensor gives no number or stands still in a recording: then that is an alarm, the recording
    is set aside, and nothing else is asked of it. Readings in °F or K are out of limits as well: if they are
    within them with that undone, and fit the model, it is a mistake of the record and no alarm."""
    readings = _last(judge.segments(record, production.plant, masked=False))
    noise = np.exp(production.own.noise.mean(axis=0) / 2)

    def find_faults(segments: Segments) -> list[sensors.SensorFault]:
        model = production.machine.plant
        return sensors.faults(
            model,
            production.plant,
            segments,
            noise=noise,
            steps=production.steps,
            reversals=production.reversals,
        )

    faults = find_faults(readings)
    if not faults:
        return False
    reason = f"{faults[0].sentence} It says nothing of the machine"
    if all(fault.kind == sensors.OPEN for fault in faults):
        mistake = mistakes.likeliest(production.machine, readings, production.own, **production.signals)
        if mistake.left <= mistakes.honest(production.own) and not find_faults(mistake.undone):
            reason = f"{mistake.words}: undone, the readings are within their limits; mend it and put it back"
            faults = []
    for fault in faults:
        _doubt(findings, loop, path, fault.output, fault.sentence)
    findings.quarantined[path] = quarantine(path, loop, f"{path}: {reason}")
    return True


def _doubt(findings: NightDrift, loop: str, path: str, output: str, sentence: str) -> None:
    cause = f"{sentence} Check the sensor and its wiring before the machine heats again"
    findings.alarms.append(Alarm(loop, f"{loop}: sensor {output}", path, cause, 99.9, (), SENSOR, output))


def _hold_against(
    findings: NightDrift,
    loop: str,
    path: str,
    record: dict[str, np.ndarray],
    production: ProductionReference,
    nights: list[dict[str, list[float]]],
    pending: Sequence[str],
) -> None:
    """Adds what one recording says of the machine to the findings; its changes join those of `nights`."""
    machine, limits = production.plant, production.limits
    segments, closed_loop = _last(judge.segments(record, machine)), _closed_loop(record, machine)
    if not segments:
        return
    mistake = mistakes.found(production.machine, segments, production.own, **production.signals)
    if mistake:
        findings.quarantined[path] = quarantine(path, loop, f"{path}: {mistake.reason}")
        segments, closed_loop = mistake.undone, {}
    measured = _measure(segments, production, closed_loop)
    changes = measured.changes
    if not mistake and (doubt := _find_doubt(measured, segments, production)):
        words, wrong = doubt
        if wrong:
            findings.quarantined[path] = quarantine(path, loop, f"{path}: {words}")
            return
        if not changes:
            findings.notes.append(f"{path}: {words}, and no single change explains it")
        changes = [change._replace(words=f"{change.words}; or {words}") for change in changes]
    findings.figures[path] = measured.figures
    findings.notes.append(f"{Path(path).name} would have shown {measured.figures['least']}")
    nights.append({one.key: [round(one.size, 6), round(one.deviation, 6)] for one in changes})
    del nights[:-POOLED]
    pooled = {one: past_limit([night.get(one.key) for night in nights], one.limit) for one in changes}
    said = [one for one in changes if abs(one.size) >= one.limit or pooled[one] >= limits.limit_sigmas]
    consequences = tuple(cause.words for cause in measured.loop)
    for one in said:
        sigmas = round(float(np.clip(one.size / max(one.deviation, 1e-9), -999.0, 999.0)), 1)
        alarm = Alarm(
            loop, f"{loop}: {one.key}", path, one.words, sigmas, consequences, one.kind, one.channel
        )
        (findings.alarms if pooled[one] >= limits.limit_sigmas else findings.watched).append(alarm)
    if not said:
        pictures.add_alarms(findings, limits, loop, path, measured.loop, pending)


def past_limit(estimates: Sequence[Sequence[float] | None], limit: float) -> float:
    """How surely a change is past its limit, in sigmas: the largest of the last nights' evidence together, of
    the last one, the last two, and so on while they agree in sign (Page's test; Page 1954). `estimates` are
    [size, standard deviation] of each night, None if it named nothing."""
    agreeing: list[Sequence[float]] = []
    for estimate in reversed(estimates):
        if estimate is None or (agreeing and estimate[0] * agreeing[0][0] < 0):
            break
        agreeing.append(estimate)
    evidence = np.cumsum([(abs(size) - limit) / max(deviation, 1e-9) for size, deviation in agreeing])
    return float(np.max(evidence / np.sqrt(np.arange(1, len(evidence) + 1)), initial=-np.inf))


# ---- one recording


class RecordingDrift(NamedTuple):
    """Of one recording: figures for the page, what changed, and what the closed loop does otherwise beyond
    what those changes and the air around bring. `misfit` is the mean squared error that is left, in that of
    the champion's own."""

    figures: dict[str, Any]
    changes: list[RecordingChange]
    loop: list[CameraChange]
    misfit: float


def _measure(
    segments: Segments, production: ProductionReference, closed_loop: Mapping[str, list[list[float]]]
) -> RecordingDrift:
    own = production.own
    record, explained = drift.explain_segments(
        production.machine,
        segments,
        own.scale,
        own.changes,
        own.usual(drift.causes(production.machine.plant)),
    )
    changes = [
        _join_rivals([_say(production, fit, segments) for fit in (named.fit, *named.rivals)])
        for named in explained.named
    ]
    air = drift.levels(record, explained.changes)[0]
    if abs(air) > production.limits.ambient_degC:
        changes.append(_say_air(production, air))
    effect = drift.moved(record, own.changes, explained.changes) + abs(air)
    figures, loop, not_applicable = _compare_loop(closed_loop, production, effect, unchanged=not changes)
    innovation, louder = _compare_noise(record, explained, production)
    fits = [*explained.others, *(named.fit for named in explained.named)]
    samples = sum(int(one.measured.sum()) for one in record.segments)
    shown = {
        "parameters": _tell_parameters(fits, production),
        "innovation": innovation,
        "closed_loop": figures,
        "not_applicable": not_applicable,
        "least": _tell_least(fits, production),
    }
    misfit = float(explained.left @ explained.left) / max(samples, 1)
    return RecordingDrift(shown, [*changes, *louder], loop, misfit)


def _find_doubt(
    measured: RecordingDrift, segments: Segments, production: ProductionReference
) -> tuple[str, bool] | None:
    """Why a record may not be of this machine, in words, and whether it is set aside; None if the causes that
    were named can be, and explain the record. A heater that is dead looks like commands that are written too
    large: a gain that fell is told with the mistake beside it."""
    impossible = [change for change in measured.changes if cannot_be(change.kind, change.size)]
    unexplained = measured.misfit > UNEXPLAINED * mistakes.honest(production.own)
    if not impossible and not unexplained and len(measured.changes) < drift.MOST:
        return None
    likeliest = mistakes.likeliest(production.machine, segments, production.own, **production.signals)
    words = "this record does not fit the machine"
    if likeliest.better >= WORTH_NAMING:
        words += (
            f": likeliest mistake: {likeliest.words}; undone, it fits {likeliest.better:.0f} times better"
        )
    gains = [change.size for change in measured.changes if change.kind.startswith("gain")]
    fell = any(size < FELL_PERCENT for size in gains)
    return words, likeliest.better >= LIKELY and not fell


def cannot_be(kind: str, size: float) -> bool:
    """Whether no machine changes so within a night."""
    kind = kind.split(" or ")[0]
    if kind == "ambient":
        return not COLDEST_DEGC < ROOM_DEGC + size < HOTTEST_DEGC
    return abs(size) > {"gain": MOST_GAIN_PERCENT, "offset": MOST_OFFSET_DEGC}.get(kind, np.inf)


def _name(fit: CauseFit, production: ProductionReference) -> str:
    signals = (
        production.plant.outputs if fit.cause.kind in ("offset", "late sensor") else production.plant.inputs
    )
    return signals[fit.cause.channel].name if fit.cause.channel >= 0 else "every input"


def _limit(fit: CauseFit, production: ProductionReference) -> float:
    return getattr(production.limits, SENTENCES[fit.cause.kind][0])


def _size(fit: CauseFit, production: ProductionReference, segments: Segments = ()) -> tuple[float, float]:
    """A fit and its standard deviation in the unit of its limit: percent, s, °C, or percent of the record."""
    cause, value, deviation = fit.cause, fit.value, fit.deviation
    if cause.kind == "saturation":
        least, at, most = (drift.above(segments, cause.channel, value + k * deviation) for k in (1, 0, -1))
        return at, max((most - least) / 2, 0.5)
    own, of = production.own, [drift.causes(production.machine.plant).index(cause)]
    among = drift.shift(
        np.array([value]), np.array([deviation]), own.values[:, of], own.deviations[:, of],
        nights=len(own.noise),
    )  # fmt: skip
    change, deviation = float(among.value[0] - among.reference[0]), float(among.deviation[0])
    if cause.kind == "time constant":
        longer = 1 / (1 + max(change, -0.9))
        return 100 * (longer - 1), 100 * deviation * longer**2
    unit = {"gain": 100.0, "offset": 1.0}.get(cause.kind, production.plant.sample_time_s)
    return change * unit, deviation * unit


def _say(production: ProductionReference, fit: CauseFit, segments: Segments) -> RecordingChange:
    kind, name = fit.cause.kind, _name(fit, production)
    size, deviation = _size(fit, production, segments)
    late = f"{abs(size):.1f} s {'later' if size > 0 else 'earlier'}"
    every = fit.cause.channel < 0 or (kind == "delay" and len(production.plant.inputs) == 1)
    clock = ", or the clock of the outputs is off against that of the inputs" if every else ""
    words = SENTENCES[kind][1].format(name=name, size=size, value=fit.value, late=late, clock=clock)
    kind = "delay" if kind == "late sensor" else kind
    return RecordingChange(kind, name, words, size, deviation, _limit(fit, production))


def _join_rivals(rivals: Sequence[RecordingChange]) -> RecordingChange:
    """Rivals, the likeliest first, as one: if one of them is far past its own limit and the likeliest is not,
    it is said first."""
    farthest = max(rivals, key=lambda one: abs(one.size) / one.limit)
    ahead = abs(farthest.size) >= AHEAD * farthest.limit and abs(rivals[0].size) < rivals[0].limit
    rivals = sorted(rivals, key=lambda one: ahead and one is not farthest)
    rest = ": this record cannot tell which" if len(rivals) > 1 else ""
    kinds = dict.fromkeys(one.kind for one in rivals)
    words = ", or ".join(one.words for one in rivals) + rest
    return rivals[0]._replace(kind=" or ".join(kinds), words=words)


def _say_air(production: ProductionReference, air: float) -> RecordingChange:
    words = (
        f"it is {abs(air):.0f} °C {'warmer' if air > 0 else 'colder'} around the machine than on the "
        "champion's own nights, or every sensor reads so much from what it did"
    )
    deviation = float(production.own.scale.ambient)
    return RecordingChange("ambient", "", words, air, deviation, production.limits.ambient_degC)


def _compare_noise(
    record: DriftRecord, explained: Explanation, production: ProductionReference
) -> tuple[dict[str, dict[str, float]], list[RecordingChange]]:
    """Noise of each output, and by how many degrees of its steady level it is off what the champion's nights
    had; then the noises that have changed."""
    value, deviation = baseline.noise(drift.by_output(record, explained.left))
    noise = drift.shift(value, deviation, production.own.noise, production.own.noise_deviation)
    air, own = drift.levels(record, production.own.changes)
    known = np.hypot(production.own.scale.ambient, production.own.scale.level)
    ratio, limit = np.exp(0.5 * (noise.value - noise.reference)), production.limits.noise_percent
    figures, louder = {}, []
    for i, output in enumerate(production.signals["outputs"]):
        percent, sigmas, level = 100 * float(ratio[i] - 1), float(noise.sigmas[i]), float(air + own[i])
        figures[output] = {
            "noise_percent": percent, "noise_sigmas": sigmas,
            "mean_degC": level, "mean_sigmas": level / float(known[i]),
        }  # fmt: skip
        if abs(percent) > 0.5 * limit and abs(sigmas) >= drift.SURE:
            word = "grown" if percent > 0 else "fallen"
            words = f"the noise of {output} has {word} by {abs(percent):.0f} %"
            # of a logarithm of a variance
            deviation_percent = 50 * float(ratio[i] * noise.deviation[i])
            louder.append(RecordingChange("noise", output, words, percent, deviation_percent, limit))
    return figures, louder


def _tell_parameters(
    fits: Sequence[CauseFit], production: ProductionReference
) -> dict[str, dict[str, float]]:
    """{cause: change in percent, half of its 90 % band, sigmas} of gains and time constants: what was named,
    and what the others seem beside it."""
    figures = {}
    order = drift.causes(production.machine.plant)
    for fit in sorted(fits, key=lambda fit: order.index(fit.cause)):
        if fit.cause.kind in ("gain", "time constant"):
            percent, deviation = _size(fit, production)
            name = f"{fit.cause.kind} from {_name(fit, production).replace('every input', 'all inputs')}"
            sigmas = percent / max(deviation, 1e-9)
            figures[name] = {"percent": percent, "band_percent": 1.645 * deviation, "sigmas": sigmas}
    return figures


def _tell_least(fits: Sequence[CauseFit], production: ProductionReference) -> str:
    """The smallest changes of a gain and of an offset that would have been an alarm tonight, of the signal
    that is known least."""
    words = []
    for article, kind, unit in (("a", "gain", "%"), ("an", "offset", "°C")):
        size, name = max(
            (
                _limit(fit, production) + production.limits.limit_sigmas * _size(fit, production)[1],
                _name(fit, production),
            )
            for fit in fits
            if fit.cause.kind == kind and fit.cause.channel >= 0
        )
        words.append(f"{article} {kind} of {name} from {size:.1f} {unit} on")
    return " and ".join(words)


# ---- the closed loop


def _closed_loop(record: Mapping[str, np.ndarray], machine: Plant) -> dict[str, list[list[float]]]:
    """Offset of each output from its set-point if it is settled in °C, root mean square of each input and
    its share of samples at a limit, both in percent, and the settled set-points in °C: [figures, their
    standard deviations], from PARTS of the record, which are longer than what a loop remembers. Empty where
    nothing is settled."""
    u, y = np.split(
        np.column_stack([
            np.where(record[f"{s.name}_masked"], np.nan, record[s.name]).astype(float)
            for s in (*machine.inputs, *machine.outputs)
        ])[-LONGEST:],
        [len(machine.inputs)],
        axis=1,
    )  # fmt: skip
    samples = len(record["time_s"])
    targets = [record.get(set_point_of(o.name), np.full(samples, o.reference)) for o in machine.outputs]
    wanted = np.column_stack(targets)[-LONGEST:]
    settled = _settled(wanted)
    if settled.sum() < PARTS * SHORTEST:
        return {}
    low, high = np.array([(i.low, i.high) for i in machine.inputs]).T
    mean_square, deviation = np.array(_mean(u**2))
    effort = np.sqrt(mean_square)
    return {
        "offset_degC": _mean((y - wanted)[settled]),
        "effort_percent": [effort.tolist(), (deviation / np.maximum(2 * effort, 1e-9)).tolist()],
        "at_limits_percent": _mean(100.0 * ((u <= low + 1e-9) | (u >= high - 1e-9))),
        "set_point_degC": [wanted[settled].mean(axis=0).tolist(), [0.0] * len(machine.outputs)],
    }


def _settled(wanted: np.ndarray) -> np.ndarray:
    """Where (T,) a loop has had time to reach its set-points (T, p): the last two thirds of a stretch of
    SHORTEST samples or more in which none is changed. No set-point, or 0, is a heater that is off."""
    changes = np.flatnonzero((np.diff(wanted, axis=0) != 0).any(axis=1)) + 1
    stretches = np.split(np.arange(len(wanted)), changes)
    late = [one[len(one) // 3 :] for one in stretches if len(one) >= SHORTEST]
    settled = np.isin(np.arange(len(wanted)), np.concatenate([[], *late]))
    return settled & (wanted > 0).all(axis=1)


def _mean(values: np.ndarray) -> list[list[float]]:
    """Mean (k,) of values (T, k) that are there, and its standard deviation from the means of PARTS."""
    parts = np.ma.masked_invalid(values)
    means = np.ma.stack([part.mean(axis=0) for part in np.array_split(parts, PARTS)])
    deviation = means.std(axis=0, ddof=1) / np.sqrt(PARTS)
    return [one.filled(0.0).tolist() for one in (parts.mean(axis=0), deviation)]


def _compare_loop(
    now: Mapping[str, list[list[float]]],
    production: ProductionReference,
    effect: np.ndarray,
    *,
    unchanged: bool,
) -> tuple[dict[str, dict[str, float]], list[CameraChange], str]:
    """Offset, effort and share at limits against the champion's own nights: figures by name, what has
    changed, and why it was not asked, if it was not. `effect` (p,) are the °C that the changes of the machine
    and the air around bring: what they explain is not counted again; `unchanged`: the machine is as it
    was."""
    limits, nights = production.limits, [night for night in production.loop if night]
    if not now or not nights:
        return {}, [], "no stretch is settled at a set-point"
    usual = {key: np.array([night[key] for night in nights]) for key in now}
    offset = usual["offset_degC"][:, 0].mean(axis=0)
    unsure = np.sqrt((usual["offset_degC"][:, 1] ** 2).mean(axis=0) / len(nights))
    if (np.abs(offset) > SETTLED * limits.offset_degC + 2 * unsure).any():
        return {}, [], "the champion's own recordings are not of a loop settled at the references"
    aims = usual["set_point_degC"][:, 0]
    elsewhere = np.abs(now["set_point_degC"][0] - aims).min(axis=0).max() > limits.offset_degC
    plant = production.machine.plant
    steady = np.abs(plant.C @ np.linalg.solve(np.eye(plant.n) - plant.A, plant.B) + plant.D)
    strongest = steady.argmax(axis=0)
    points = effect[strongest] / np.maximum(steady[strongest, np.arange(plant.m)], 1e-9)
    # by figure its sentence, what matters, and what the machine's changes may bring
    asked = {
        "offset_degC": ("settles {} °C from where it did", limits.offset_degC, effect),
        "effort_percent": ("needs {} points of effort more than it did", limits.effort_percent, points),
        "at_limits_percent": (
            "is at a limit {} points more of the time than it was", limits.at_limits_points, 0 * points,
        ),
    }  # fmt: skip
    figures, causes = {}, []
    for key, (sentence, least, allowed) in asked.items():
        if elsewhere and key != "offset_degC":  # other set-points take other duties
            continue
        moved = _shift_loop(now[key], usual[key], least)
        for k, name in enumerate(production.signals["outputs" if key == "offset_degC" else "inputs"]):
            by, sigmas = float(moved.value[k] - moved.reference[k]), float(moved.sigmas[k])
            figures[f"{name} {key}"] = {"moved": by, "sigmas": sigmas}
            beyond = abs(by) - least - (allowed[k] if unchanged else 0.0)
            if beyond > 0:
                words = f"closed loop: {name} {sentence.format(f'{by:+.2g}')}"
                sigmas *= beyond / abs(by) if unchanged else 1.0
                causes.append(CameraChange(f"{key} of {name}", words, sigmas))
    return figures, causes, ""


def _shift_loop(now: list[list[float]], usual: np.ndarray, least: float) -> drift.Shift:
    """Of one figure against those of the champion's nights (nights, 2, signals)."""
    # a figure counts as known to a sixth of what matters at best, so that
    # nights that agree by chance make no alarm of a trifle
    own = np.maximum([*usual[:, 1], now[1]], least / 6)
    # a few parts of one night say little of how well a mean is known: those of all nights say it
    # together; a short or restless night is known less well
    pooled = np.maximum(np.sqrt((own**2).mean(axis=0)), own[-1])
    return drift.shift(np.array(now[0]), pooled, usual[:, 0], own[:-1], freedom=(PARTS - 1) * len(own))
