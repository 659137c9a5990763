"""New recordings before anything learns from them: what cannot be read or is not what it says goes to
quarantine; what has changed since the champion was made is drift."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.nightly import champion, drift, judge, pictures
from pipeline.nightly.camera_drift import Change
from pipeline.nightly.inputs import quarantine
from pipeline.nightly.remembered import DriftMemory
from pipeline.nightly.settings import Drift, Loop, Nightly
from pipeline.report.shared.night import (
    ClosedLoopChange,
    InnovationChange,
    LoopDrift,
    NightDrift,
    ParameterChange,
    RecordingFigures,
)
from pipeline.store import artifacts, params
from pipeline.temperature.workflow.settings import Plant

REFERENCE = "reference.json"  # in the champion's folder
PIECES = 4  # into which a single record of the champion is cut, to stand for nights
NIGHTS = 12  # of the champion's own recordings that a new one is held against
# mean squared error, in the champion's own, from which a record is asked whether it is what it says
GROSS = 3.0
UNDONE = 0.5  # share of that error which undoing a mistake must leave at most
# mean offset of the champion's own nights, in units of drift.offset_degC, up to which they count as a
# closed loop at the references
SETTLED = 5.0
PARTS = 4  # of a record, whose scatter tells how well its closed-loop figures are known


class Reference(NamedTuple):
    """What the champion's own recordings said: estimates under its own and the slow observer, one a night,
    their closed-loop figures, and the model."""

    model: Any
    asked: list[drift.Cause]
    own: list[drift.Estimate]
    slow: list[drift.Estimate]
    loop: list[dict[str, list[list[float]]]]


class Screening(NamedTuple):
    """Of one night: the drift of every loop, and what the next night must remember of it."""

    drift: NightDrift
    memory: DriftMemory


def look(
    settings: Nightly,
    champions: Collection[str],
    new: Mapping[str, Mapping[str, str]],
    memory: DriftMemory,
    *,
    night: int,
) -> Screening:
    """New recordings {loop: {path: digest}} held against those of each loop's champion; `champions` are the
    loops that have one, `memory` is that of the night before. A loop's alarms say nothing of another loop."""
    pending = set(memory.pending)
    loops = {
        name: _loop_drift(settings, name, list(new.get(name, ())), pending, has_champion=name in champions)
        for name in settings.loops
    }
    drift = NightDrift(loops)
    if not any(new.values()):
        # nothing was recorded: what was found last still stands
        for alarm in memory.alarms:
            loops.setdefault(alarm.loop, LoopDrift.none(alarm.loop)).alarms.append(alarm)
        return Screening(drift, memory)
    # what each loop recorded since its alarm: a person may accept that as how things are
    since = dict(memory.drifted)
    for name in (name for name, recorded in new.items() if recorded):
        raised = [alarm.recording for alarm in drift.of(name).alarms]
        since[name] = list(dict.fromkeys([*since.get(name, []), *raised])) if raised else []
    keys = tuple(alarm.key for alarm in (*drift.watched, *drift.alarms))
    return Screening(drift, DriftMemory(keys, tuple(drift.alarms), since, night))


def _loop_drift(
    settings: Nightly, name: str, paths: Sequence[str], pending: set[str], *, has_champion: bool
) -> LoopDrift:
    """Drift of one loop by its new recordings; none where there is no new one, or nothing to hold it
    against."""
    loop = settings.loops[name]
    if not paths:
        return LoopDrift.none(name)
    if loop.judge == "temperature" and loop.recordings and _recorded():
        return _temperature(settings, name, paths, pending, has_champion=has_champion)
    if loop.judge == "deposition":
        return pictures.trials_drift(settings.drift, name, paths, _read(champion.FOLDER / name), pending)
    if loop.judge == "setpoint":
        prints = pictures.NewPrints(loop.recordings, paths, _read(champion.FOLDER / name))
        return pictures.prints_drift(settings.drift, name, prints, pending)
    return LoopDrift.none(name)


def _temperature(
    settings: Nightly, name: str, new: Sequence[str], pending: set[str], *, has_champion: bool
) -> LoopDrift:
    """Drift of the temperature loop; what cannot be read, or is not what it says, is set aside."""
    drifted, folder = LoopDrift.none(name), settings.loops[name].recordings
    machine, broken = params.load(Plant, "plant"), {}
    if not Path(folder).is_dir():
        return drifted
    records = judge.record_segments(Path(folder), machine, broken=broken)
    for path, reason in broken.items():
        if f"{folder}/{path}" in new:
            drifted.quarantined[f"{folder}/{path}"] = quarantine(f"{folder}/{path}", name, reason)
    good = [
        path
        for path in new
        if path not in drifted.quarantined and records.get(path.removeprefix(f"{folder}/"))
    ]
    if not has_champion or not good:
        return drifted
    reference = _champions_reference(champion.FOLDER / name)
    if reference is None:
        drifted.notes.append(
            f"{name}: the champion has no reference of its own recordings: drift was not measured"
        )
        return drifted
    for path in good:
        segments = records[path.removeprefix(f"{folder}/")]
        if reason := _mistake(path, segments, reference, machine):
            drifted.quarantined[path] = quarantine(path, name, reason)
            continue
        try:
            measured = _measure(settings.drift, segments, reference, machine)
        except ValueError as error:
            drifted.notes.append(f"{path}: {error}")
            continue
        drifted.figures[path] = measured.figures
        drifted = pictures.with_alarms(
            drifted, settings.drift, path, measured.causes, pending, measured.consequences
        )
    return drifted


def _mistake(path: str, segments: Sequence, reference: Reference, machine: Plant) -> str:
    """Why a recording is not what it says it is; empty where it is."""
    u, y = max(segments, key=lambda pair: len(pair[0]))
    suspects = drift.mistakes(
        reference.model,
        u,
        y,
        inputs=[i.name for i in machine.inputs],
        outputs=[o.name for o in machine.outputs],
        scale=np.exp(0.5 * np.mean([night.log_variance for night in reference.own], axis=0)),
        gross=GROSS,
    )
    if len(suspects) < 2 or suspects[1].error_share >= UNDONE:
        return ""
    return (
        f"{path}: {suspects[1].words}: undone, the record fits the champion's model "
        f"{1 / suspects[1].error_share:.0f} times better; mend it and put it back"
    )


# ---- the champion's own recordings


def reference(loop: Loop, folder: Path, only: Sequence[str] = ()) -> dict[str, Any] | None:
    """What the recordings that a challenger was made of say of its own model, for
    champion/<loop>/reference.json: a night's figures mean something only beside those of nights
    that are known to be good; `only` these recordings, or prints, where any are named. None
    where the loop has no recordings, or too short ones."""
    if not loop.recordings or not Path(loop.recordings).is_dir():
        return None
    if loop.judge in ("deposition", "setpoint"):
        figures_of = {"deposition": pictures.of_trials, "setpoint": pictures.of_prints}[loop.judge]
        rows = figures_of(Path(loop.recordings), NIGHTS, only)
        return {"schema": "reference", "version": 1, "camera": rows} if rows else None
    if loop.judge != "temperature" or not _recorded():
        return None
    machine = params.load(Plant, "plant")
    records = judge.record_segments(Path(loop.recordings), machine, broken={})
    named = [path.removeprefix(f"{loop.recordings}/") for path in only] or sorted(records)
    nights = [records[path] for path in named if records.get(path)][-NIGHTS:]
    if len(nights) == 1:
        nights = [
            [(part, other)]
            for u, y in nights[0]
            for part, other in zip(np.array_split(u, PIECES), np.array_split(y, PIECES), strict=True)
        ]
    model = judge.identified(folder)
    asked, samples = drift.causes(model), int(np.median([sum(len(u) for u, _ in night) for night in nights]))
    try:
        own, slow = (
            [drift.estimate(model, night, asked, K) for night in nights]
            for K in (drift.observer(model, samples), drift.slow_observer(model, samples))
        )
    except ValueError:
        return None
    both = {
        "own": [list(map(np.ndarray.tolist, estimate)) for estimate in own],
        "slow": [list(map(np.ndarray.tolist, estimate)) for estimate in slow],
    }
    return {
        "schema": "reference",
        "version": 1,
        **both,
        "loop": [_closed_loop(night, machine) for night in nights],
    }


def _read(folder: Path) -> dict[str, Any]:
    return artifacts.read_json(folder / REFERENCE) if (folder / REFERENCE).exists() else {}


def _champions_reference(folder: Path) -> Reference | None:
    fields = _read(folder)
    if not fields:
        return None
    own, slow = (
        [drift.Estimate(*map(np.array, estimate)) for estimate in fields[key]] for key in ("own", "slow")
    )
    model = judge.identified(folder)
    return Reference(model, drift.causes(model), own, slow, fields["loop"])


def _recorded() -> bool:
    return params.value("generate_probing.source", one_of=("simulated", "recordings")) == "recordings"


def _closed_loop(
    segments: Sequence[tuple[np.ndarray, np.ndarray]], machine: Plant
) -> dict[str, list[list[float]]]:
    """Offset of each output from its reference after the first third in °C, root mean square of each input
    and its share of samples at a limit, both in percent: [figures, their standard deviations], from PARTS of
    the record, which are longer than what a loop remembers."""
    u, y = (np.concatenate([pair[k] for pair in segments]) for k in (0, 1))
    reference, low, high = (
        np.array([o.reference for o in machine.outputs]),
        *np.array([(i.low, i.high) for i in machine.inputs]).T,
    )
    late, limited = (y - reference)[len(y) // 3 :], 100.0 * ((u <= low + 1e-9) | (u >= high - 1e-9))
    effort = np.sqrt((u**2).mean(axis=0))
    return {
        "offset_degC": _mean(late),
        "effort_percent": [
            effort.tolist(),
            (np.array(_mean(u**2)[1]) / np.maximum(2 * effort, 1e-9)).tolist(),
        ],
        "at_limits_percent": _mean(limited),
    }


def _mean(values: np.ndarray) -> list[list[float]]:
    """Mean (k,) of values (T, k) that are there, and its standard deviation from the means of PARTS."""
    parts = np.ma.masked_invalid(values)
    means = np.ma.stack([part.mean(axis=0) for part in np.array_split(parts, PARTS)])
    return [
        parts.mean(axis=0).filled(0.0).tolist(),
        (means.std(axis=0, ddof=1) / np.sqrt(PARTS)).filled(0.0).tolist(),
    ]


# ---- the new one against them


class Measured(NamedTuple):
    """Of one recording: figures for the page, causes of an alarm, and what follows from them in words."""

    figures: RecordingFigures
    causes: list[Change]
    consequences: list[str]


class Moved(NamedTuple):
    """Of one observer: its estimate on the new recording, and how far that is from the champion's nights."""

    estimate: drift.Estimate
    shift: drift.Shift


def _measure(limits: Drift, segments: Sequence, reference: Reference, machine: Plant) -> Measured:
    """The plant's parameters first. Where they have not changed, noise, offsets and the closed loop are
    causes of their own; where they have, what the closed loop does is a consequence."""
    inputs, outputs = [i.name for i in machine.inputs], [o.name for o in machine.outputs]
    samples = sum(len(u) for u, _ in segments)
    own = _moved(segments, reference, reference.own, drift.observer(reference.model, samples))
    slow = _moved(segments, reference, reference.slow, drift.slow_observer(reference.model, samples))
    causes = _plant(limits, own, slow, reference.asked, inputs)
    explained = bool(causes)
    innovation, noise_causes = _innovation(limits, own.estimate, reference.own, outputs)
    loop = _loop(limits, _closed_loop(segments, machine), reference.loop, inputs, outputs)
    parameters = _parameters(own.shift, reference.asked, inputs)
    return Measured(
        RecordingFigures(parameters, innovation, loop.figures, loop.not_applicable),
        causes if explained else [*noise_causes, *loop.causes],
        [cause.words for cause in loop.causes] if explained else [],
    )


def _moved(
    segments: Sequence, reference: Reference, nights: Sequence[drift.Estimate], K: np.ndarray
) -> Moved:
    variance = np.exp(np.mean([night.log_variance for night in nights], axis=0))
    estimate = drift.estimate(reference.model, segments, reference.asked, K, variance)
    return Moved(estimate, _shift(estimate, nights, "change", "deviation"))


def _innovation(
    limits: Drift, estimate: drift.Estimate, nights: Sequence[drift.Estimate], outputs: Sequence[str]
) -> tuple[dict[str, InnovationChange], list[Change]]:
    """Noise and mean of the one-step errors, output by output, and what of both is more than matters."""
    noise = _shift(estimate, nights, "log_variance", "log_variance_deviation")
    mean = _shift(estimate, nights, "mean", "mean_deviation")
    grown, moved = np.expm1(0.5 * (noise.value - noise.reference)), mean.value - mean.reference
    figures = {
        output: InnovationChange(
            100 * float(grown[i]), float(noise.sigmas[i]), float(moved[i]), float(mean.sigmas[i])
        )
        for i, output in enumerate(outputs)
    }
    causes, spread = [], np.exp(0.5 * noise.reference)
    for i, output in enumerate(outputs):
        percent = 100 * grown[i]
        if abs(percent) >= limits.noise_percent:
            word = "grown" if percent > 0 else "fallen"
            words = f"the noise of {output} has {word} by {abs(percent):.0f} %"
            causes.append(Change(f"noise of {output}", words, float(noise.sigmas[i])))
        if abs(moved[i]) >= limits.noise_percent / 100 * spread[i]:
            words = (
                f"{output} reads {moved[i]:+.3g} °C a step from what the model expects of it: its offset, or "
                "the heat lost around it, has changed"
            )
            causes.append(Change(f"offset of {output}", words, float(mean.sigmas[i])))
    return figures, causes


def _shift(
    estimate: drift.Estimate, nights: Sequence[drift.Estimate], value: str, deviation: str
) -> drift.Shift:
    return drift.shift(
        getattr(estimate, value),
        getattr(estimate, deviation),
        np.array([getattr(night, value) for night in nights]),
        np.array([getattr(night, deviation) for night in nights]),
    )


def _parameters(
    shifted: drift.Shift, asked: Sequence[drift.Cause], inputs: Sequence[str]
) -> dict[str, ParameterChange]:
    """{cause: change in percent, half of its 90 % band, sigmas}; time constants from rates."""
    change, band = _percent(shifted, asked), 100 * 1.645 * shifted.deviation
    return {
        f"{cause.kind} from {inputs[cause.channel] if cause.channel >= 0 else 'all inputs'}": (
            ParameterChange(float(percent), float(half), float(sigmas))
        )
        for cause, percent, half, sigmas in zip(asked, change, band, shifted.sigmas, strict=True)
    }


def _percent(shifted: drift.Shift, asked: Sequence[drift.Cause]) -> np.ndarray:
    change = shifted.value - shifted.reference
    return 100 * np.array(
        [
            1 / (1 + max(c, -0.9)) - 1 if cause.kind == "time constant" else c
            for c, cause in zip(change, asked, strict=True)
        ]
    )


def _plant(
    limits: Drift, own: Moved, slow: Moved, asked: Sequence[drift.Cause], inputs: Sequence[str]
) -> list[Change]:
    """The likeliest cause among those that moved by what matters: the input by the champion's own observer,
    gain or time constant by the slow one, both where neither can tell."""
    percent, sigmas = _percent(own.shift, asked), own.shift.sigmas
    fits = (np.abs(percent) >= limits.parameter_percent) & (np.abs(sigmas) >= limits.watch_sigmas)
    named = drift.named(
        fits, drift.explained(own.shift, own.estimate), drift.explained(slow.shift, slow.estimate)
    )
    if not named:
        return []
    channel = asked[named[0]].channel
    where = inputs[channel] if channel >= 0 else "every input"
    sentences = {
        "gain": "the gain from {} has changed by {:+.1f} %",
        "time constant": "the time constants of what answers to {} have changed by {:+.1f} %",
    }
    words = ", or ".join(sentences[asked[k].kind].format(where, percent[k]) for k in named) + (
        ": this record cannot tell which" if len(named) == 2 else ""
    )
    surest = max((float(sigmas[k]) for k in range(len(asked)) if asked[k].channel == channel), key=abs)
    return [Change(f"plant at {where}", words, surest)]


class LoopChanges(NamedTuple):
    """Of the closed loop: figures by name, causes of an alarm, and why it was not asked (empty where it
    was)."""

    figures: dict[str, ClosedLoopChange]
    causes: list[Change]
    not_applicable: str = ""


def _loop(
    limits: Drift,
    now: Mapping[str, list[list[float]]],
    before: Sequence[Mapping[str, list[list[float]]]],
    inputs: Sequence[str],
    outputs: Sequence[str],
) -> LoopChanges:
    """Offset, effort and share at limits against the champion's own nights; not asked where
    those nights were not settled at the references."""
    # (nights, 2, signals): figures and their deviations
    usual = {key: np.array([night[key] for night in before]) for key in now}
    offset = usual["offset_degC"][:, 0].mean(axis=0)
    unsure = np.sqrt((usual["offset_degC"][:, 1] ** 2).mean(axis=0) / len(before))
    if (np.abs(offset) > SETTLED * limits.offset_degC + 2 * unsure).any():
        return LoopChanges(
            {}, [], "the champion's own recordings are not of a loop settled at the references"
        )
    figures, causes = {}, []
    effort, at_limits = "points of effort more than it did", "points more of the time than it was"
    words = {
        "offset_degC": ("settles", "°C from where it did", limits.offset_degC, outputs),
        "effort_percent": ("needs", effort, limits.effort_percent, inputs),
        "at_limits_percent": ("is at a limit", at_limits, limits.at_limits_points, inputs),
    }
    for key, (verb, rest, least, names) in words.items():
        # a figure counts as known to a sixth of what matters at best, so that
        # nights that agree by chance make no alarm of a trifle
        own = np.maximum([*usual[key][:, 1], now[key][1]], least / 6)
        # a few parts of one night say little of how well a mean is known: those of all nights say it
        # together; a short or restless night is known less well
        pooled = np.maximum(np.sqrt((own**2).mean(axis=0)), own[-1])
        moved = drift.shift(
            np.array(now[key][0]), pooled, usual[key][:, 0], own[:-1], freedom=(PARTS - 1) * len(own)
        )
        for name, by, sigmas in zip(names, moved.value - moved.reference, moved.sigmas, strict=True):
            figures[f"{name} {key}"] = ClosedLoopChange(float(by), float(sigmas))
            if abs(by) >= least:
                sentence = f"closed loop: {name} {verb} {by:+.2g} {rest}"
                causes.append(Change(f"{key} of {name}", sentence, float(sigmas)))
    return LoopChanges(figures, causes)
