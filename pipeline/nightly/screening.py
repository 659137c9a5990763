"""New recordings before anything learns from them: what cannot be read or is not what it says goes to
quarantine; what has changed since the champion was made is drift."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.nightly import champion, drift, judge, pictures
from pipeline.nightly.inputs import aside
from pipeline.nightly.settings import Drift, Loop, Nightly
from pipeline.store import artifacts, params
from pipeline.temperature.workflow.settings import Plant

REFERENCE = "reference.json"  # in the champion's folder
PIECES = 4  # into which a single record of the champion is cut, to stand for nights
NIGHTS = 12  # of the champion's own recordings that a new one is held against
GROSS = (
    3.0  # mean squared error, in the champion's own, from which a record is asked whether it is what it says
)
UNDONE = 0.5  # share of that error which undoing a mistake must leave at most
SETTLED = 5.0  # mean offset of the champion's own nights, in units of drift.offset_degC, up to which they count as a closed loop at the references


PARTS = 4  # of a record, whose scatter tells how well its closed-loop figures are known


class Reference(NamedTuple):
    """What the champion's own recordings said: estimates under its own and the slow observer, one a night,
    their closed-loop figures, and the model."""

    model: Any
    asked: list[drift.Cause]
    own: list[drift.Estimate]
    slow: list[drift.Estimate]
    loop: list[dict[str, list[list[float]]]]


def look(
    settings: Nightly,
    state: Mapping[str, Any],
    new: Mapping[str, Mapping[str, str]],
    memory: Mapping[str, Any],
    *,
    night: int,
) -> dict[str, Any]:
    """{"alarms": [{loop, kind, cause, figures}], "watched": what would be one if it stayed, "figures": by
    recording, "quarantined": {path: reason}, "memory": for the next night}."""
    found: dict[str, Any] = {"alarms": [], "watched": [], "figures": {}, "quarantined": {}, "notes": []}
    for name, loop in settings.loops.items():
        if loop.judge == "temperature" and loop.recordings and _recorded():
            _temperature(
                settings,
                name,
                loop.recordings,
                name in state["champions"],
                list(new.get(name, {})),
                memory,
                found,
            )
        elif loop.judge in ("deposition", "setpoint") and new.get(name):
            cameras = pictures.trials_of if loop.judge == "deposition" else pictures.nozzle_of
            pending = set(memory.get("pending", []))
            cameras(
                settings.drift,
                name,
                loop.recordings,
                list(new[name]),
                _read(champion.FOLDER / name),
                pending,
                found,
            )
    if not any(new.values()):
        found["memory"] = dict(memory)
        # nothing was recorded: what was found last still stands
        found["alarms"] = list(memory.get("alarms", []))
        return found
    # what each loop recorded since its alarm: a person may accept that as how things are
    since = dict(memory.get("drifted", {}))
    for name in (name for name, recorded in new.items() if recorded):
        raised = [one["recording"] for one in found["alarms"] if one["loop"] == name]
        since[name] = list(dict.fromkeys([*since.get(name, []), *raised])) if raised else []
    pending = [one["key"] for one in [*found["watched"], *found["alarms"]]]
    found["memory"] = {"pending": pending, "alarms": found["alarms"], "drifted": since, "night": night}
    return found


def _temperature(
    settings: Nightly,
    name: str,
    folder: str,
    has_champion: bool,
    new: Sequence[str],
    memory: Mapping[str, Any],
    found: dict[str, Any],
) -> None:
    machine, broken = params.load(Plant, "plant"), {}
    if not new or not Path(folder).is_dir():
        return
    records = judge.record_segments(Path(folder), machine, broken=broken)
    for path, reason in broken.items():
        if f"{folder}/{path}" in new:
            found["quarantined"][f"{folder}/{path}"] = aside(f"{folder}/{path}", name, reason)
    good = [
        path
        for path in new
        if path not in found["quarantined"] and records.get(path.removeprefix(f"{folder}/"))
    ]
    if not has_champion or not good:
        return
    reference = _kept(champion.FOLDER / name)
    if reference is None:
        found["notes"].append(
            f"{name}: the champion has no reference of its own recordings: drift was not measured"
        )
        return
    scale = np.exp(0.5 * np.mean([one.log_variance for one in reference.own], axis=0))
    names = {"inputs": [i.name for i in machine.inputs], "outputs": [o.name for o in machine.outputs]}
    for path in good:
        segments = records[path.removeprefix(f"{folder}/")]
        u, y = max(segments, key=lambda pair: len(pair[0]))
        suspects = drift.mistakes(reference.model, u, y, scale=scale, gross=GROSS, **names)
        if len(suspects) > 1 and suspects[1].left < UNDONE:
            reason = f"{path}: {suspects[1].words}: undone, the record fits the champion's model {1 / suspects[1].left:.0f} times better; mend it and put it back"
            found["quarantined"][path] = aside(path, name, reason)
            continue
        try:
            _measure(
                settings.drift,
                name,
                path,
                segments,
                reference,
                machine,
                set(memory.get("pending", [])),
                found,
            )
        except ValueError as error:
            found["notes"].append(f"{path}: {error}")


# ---- the champion's own recordings


def reference(loop: Loop, folder: Path, only: Sequence[str] = ()) -> dict[str, Any] | None:
    """What the recordings that a challenger was made of say of its own model, for
    champion/<loop>/reference.json: a night's figures mean something only beside those of nights
    that are known to be good; `only` these recordings, or prints, where any are named. None
    where the loop has no recordings, or too short ones."""
    if not loop.recordings or not Path(loop.recordings).is_dir():
        return None
    if loop.judge in ("deposition", "setpoint"):
        known = {"deposition": pictures.of_trials, "setpoint": pictures.of_prints}[loop.judge](
            Path(loop.recordings), NIGHTS, only
        )
        return {"schema": "reference", "version": 1, "camera": known} if known else None
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
    _, model, _ = judge.controller(folder, "model_based", 0.99)
    asked, samples = drift.causes(model), int(np.median([sum(len(u) for u, _ in night) for night in nights]))
    try:
        own, slow = (
            [drift.estimate(model, night, asked, K) for night in nights]
            for K in (drift.observer(model, samples), drift.slow_observer(model, samples))
        )
    except ValueError:
        return None
    both = {
        "own": [list(map(np.ndarray.tolist, one)) for one in own],
        "slow": [list(map(np.ndarray.tolist, one)) for one in slow],
    }
    return {
        "schema": "reference",
        "version": 1,
        **both,
        "loop": [_closed_loop(night, machine) for night in nights],
    }


def _read(folder: Path) -> dict[str, Any]:
    return artifacts.read_json(folder / REFERENCE) if (folder / REFERENCE).exists() else {}


def _kept(folder: Path) -> Reference | None:
    kept = _read(folder)
    if not kept:
        return None
    own, slow = ([drift.Estimate(*map(np.array, one)) for one in kept[key]] for key in ("own", "slow"))
    _, model, _ = judge.controller(folder, "model_based", 0.99)
    return Reference(model, drift.causes(model), own, slow, kept["loop"])


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


def _measure(
    limits: Drift,
    loop: str,
    path: str,
    segments: Sequence,
    reference: Reference,
    machine: Plant,
    pending: set[str],
    found: dict[str, Any],
) -> None:
    inputs, outputs = [i.name for i in machine.inputs], [o.name for o in machine.outputs]
    samples = sum(len(u) for u, _ in segments)
    estimates = []
    for known, K in (
        (reference.own, drift.observer(reference.model, samples)),
        (reference.slow, drift.slow_observer(reference.model, samples)),
    ):
        variance = np.exp(np.mean([one.log_variance for one in known], axis=0))
        one = drift.estimate(reference.model, segments, reference.asked, K, variance)
        estimates.append((one, _shift(one, known, "change", "deviation")))
    (own, shifted), (slow, slower) = estimates
    figures: dict[str, Any] = {"parameters": _parameters(shifted, reference.asked, inputs)}
    causes = _plant(limits, shifted, own, slower, slow, reference.asked, inputs)
    explained = bool(causes)
    noise = _shift(own, reference.own, "log_variance", "log_variance_deviation")
    mean = _shift(own, reference.own, "mean", "mean_deviation")
    figures["innovation"] = {
        output: {"noise_percent": 100 * float(np.expm1(0.5 * (noise.value - noise.reference)[i])),
        "noise_sigmas": float(noise.sigmas[i]),
                 "mean_degC": float((mean.value - mean.reference)[i]), "mean_sigmas": float(mean.sigmas[i])}
        for i, output in enumerate(outputs)
    }  # fmt: skip
    spread = np.exp(0.5 * noise.reference)
    for i, output in enumerate(outputs):
        grown, moved = (
            100 * np.expm1(0.5 * (noise.value - noise.reference)[i]),
            (mean.value - mean.reference)[i],
        )
        if abs(grown) >= limits.noise_percent and not explained:
            causes.append(
                (
                    f"noise of {output}",
                    f"the noise of {output} has {'grown' if grown > 0 else 'fallen'} by {abs(grown):.0f} %",
                    float(noise.sigmas[i]),
                )
            )
        if abs(moved) >= limits.noise_percent / 100 * spread[i] and not explained:
            words = f"{output} reads {moved:+.3g} °C a step from what the model expects of it: its offset, or the heat lost around it, has changed"
            causes.append((f"offset of {output}", words, float(mean.sigmas[i])))
    loop_figures, consequences = _loop(
        limits, _closed_loop(segments, machine), reference.loop, inputs, outputs
    )
    figures["closed_loop"] = loop_figures
    causes += consequences if not explained else []
    found["figures"][path] = figures
    pictures.raised(
        limits,
        loop,
        path,
        causes,
        [words for _, words, _ in consequences] if explained else [],
        pending,
        found,
    )


def _shift(one: drift.Estimate, known: Sequence[drift.Estimate], value: str, deviation: str) -> drift.Shift:
    return drift.shift(
        getattr(one, value),
        getattr(one, deviation),
        np.array([getattr(k, value) for k in known]),
        np.array([getattr(k, deviation) for k in known]),
    )


def _parameters(
    shifted: drift.Shift, asked: Sequence[drift.Cause], inputs: Sequence[str]
) -> dict[str, dict[str, float]]:
    """{cause: change in percent, half of its 90 % band, sigmas}; time constants from rates."""
    change, band = _percent(shifted, asked), 100 * 1.645 * shifted.deviation
    return {
        f"{cause.kind} from {inputs[cause.channel] if cause.channel >= 0 else 'all inputs'}": {
            "percent": float(p),
            "band_percent": float(b),
            "sigmas": float(s),
        }
        for cause, p, b, s in zip(asked, change, band, shifted.sigmas, strict=True)
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
    limits: Drift,
    shifted: drift.Shift,
    own: drift.Estimate,
    slower: drift.Shift,
    slow: drift.Estimate,
    asked: Sequence[drift.Cause],
    inputs: Sequence[str],
) -> list:
    """The likeliest cause among those that moved by what matters: the input by the champion's own observer,
    gain or time constant by the slow one, both where neither can tell."""
    percent = _percent(shifted, asked)
    fits = (np.abs(percent) >= limits.parameter_percent) & (np.abs(shifted.sigmas) >= limits.watch_sigmas)
    found = drift.named(fits, drift.explained(shifted, own), drift.explained(slower, slow))
    if not found:
        return []
    where = inputs[asked[found[0]].channel] if asked[found[0]].channel >= 0 else "every input"
    said = {
        "gain": "the gain from {} has changed by {:+.1f} %",
        "time constant": "the time constants of what answers to {} have changed by {:+.1f} %",
    }
    words = ", or ".join(said[asked[k].kind].format(where, percent[k]) for k in found) + (
        ": this record cannot tell which" if len(found) == 2 else ""
    )
    sigmas = max(
        (float(shifted.sigmas[k]) for k in range(len(asked)) if asked[k].channel == asked[found[0]].channel),
        key=abs,
    )
    return [(f"plant at {where}", words, sigmas)]


def _loop(
    limits: Drift,
    now: Mapping[str, list[list[float]]],
    before: Sequence[Mapping[str, list[list[float]]]],
    inputs: Sequence[str],
    outputs: Sequence[str],
) -> tuple[dict, list]:
    """Offset, effort and share at limits against the champion's own nights; not asked where
    those nights were not settled at the references."""
    known = {
        key: np.array([night[key] for night in before]) for key in now
    }  # (nights, 2, signals): figures and their deviations
    offset, unsure = (
        known["offset_degC"][:, 0].mean(axis=0),
        np.sqrt((known["offset_degC"][:, 1] ** 2).mean(axis=0) / len(before)),
    )
    if (np.abs(offset) > SETTLED * limits.offset_degC + 2 * unsure).any():
        return {
            "not_applicable": "the champion's own recordings are not of a loop settled at the references"
        }, []
    figures, causes = {}, []
    words = {"offset_degC": ("settles", "°C from where it did", limits.offset_degC, outputs), "effort_percent": ("needs", "points of effort more than it did", limits.effort_percent, inputs),
             "at_limits_percent": ("is at a limit", "points more of the time than it was",
             limits.at_limits_points, inputs)}  # fmt: skip
    for key, (verb, rest, least, names) in words.items():
        # a figure counts as known to a sixth of what matters at best, so that
        # nights that agree by chance make no alarm of a trifle
        own = np.maximum([*known[key][:, 1], now[key][1]], least / 6)
        # a few parts of one night say little of how well a mean is known: those of all nights say it
        # together; a short or restless night is known less well
        pooled = np.maximum(np.sqrt((own**2).mean(axis=0)), own[-1])
        moved = drift.shift(
            np.array(now[key][0]), pooled, known[key][:, 0], own[:-1], freedom=(PARTS - 1) * len(own)
        )
        for name, by, sigmas in zip(names, moved.value - moved.reference, moved.sigmas, strict=True):
            figures[f"{name} {key}"] = {"moved": float(by), "sigmas": float(sigmas)}
            if abs(by) >= least:
                causes.append(
                    (f"{key} of {name}", f"closed loop: {name} {verb} {by:+.2g} {rest}", float(sigmas))
                )
    return figures, causes
