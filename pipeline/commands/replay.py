"""`beadline replay`: a recording, and what a certified controller would have asked on it, sample by sample,
and why not; if the recording is off the support of what was learned, it says nothing."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.deploy import machine, replay, supervise, support
from pipeline.deploy.replay import GaplessLog
from pipeline.deploy.supervise import Exported, Signal
from pipeline.deploy.support import read_support
from pipeline.recordings.recordings import Source, Table, read
from pipeline.recordings.resampling import resample
from pipeline.store import artifacts, params
from pipeline.temperature.controllers.law import all_fed_forward
from pipeline.temperature.settings import Plant
from stages.ingest import Ingest

HOLD = 30  # samples that the law watches first
MESSAGES = 50_000  # of replay.mcap at most: a longer recording is thinned evenly
WATCHED = 10_000  # samples that the supervisor watches, in stretches of a long recording
STRETCH = 1_000


class ReplayedRecording(NamedTuple):
    """One recording replayed. By sample: time_s (T,), applied, wished, asked (T, m), why (T, m) of
    replay.WHY, measured, reference, target (T, p), off (T,) of support, cause (T,) of supervise.KINDS or -1.
    `abstains` if the recording is off support; `told` are sentences."""

    time_s: np.ndarray
    applied: np.ndarray
    wished: np.ndarray
    asked: np.ndarray
    why: np.ndarray
    measured: np.ndarray
    reference: np.ndarray
    target: np.ndarray
    off: np.ndarray
    cause: np.ndarray
    abstains: bool
    told: tuple[str, ...]


def temperatures(text: str) -> tuple[float, ...]:
    """(150.0, 160.0) of "150,160", the words of --reference; () of "". Raises ValueError."""
    try:
        degC = tuple(float(part) for part in text.split(",")) if text else ()
    except ValueError:
        degC = (math.nan,)
    if not all(abs(one) <= HOTTEST_DEGC for one in degC):
        raise ValueError(
            f"--reference: expected temperatures in °C of at most {HOTTEST_DEGC:g} such as 150,160, found "
            f"{text!r}; write one for each output, in order"
        )
    return degC


HOTTEST_DEGC = 2000.0


# ---- the recording


def recorded(path: Path, made: Exported) -> tuple[Table, str]:
    """The recording on the controller's sample time, with disturbances and `<output> reference` if it has
    them, and which columns references were. Raises ValueError naming a signal that is missing."""
    wired = made.machine
    sources, settings, time = _sources(made, [*wired.inputs, *wired.outputs])
    told = _sources(made, wired.disturbances)[0]
    inputs, outputs = [one.name for one in wired.inputs], [one.name for one in wired.outputs]
    raw, named = None, ""
    asked = [[_reference(one, ending) for one in sources if one.signal in outputs] for ending in ENDINGS]
    tried = [(also, ending) for also, ending in zip([*asked, []], [*ENDINGS, ""], strict=True)]
    for beside in [told, []] if told else [[]]:
        for also, ending in tried:
            try:
                raw, named = read(path, [*sources, *beside, *also], time=time, decimal=settings), ending
                break
            except ValueError:
                continue
        if raw is not None:
            break
    raw = raw or read(path, sources, time=time, decimal=settings)
    beside = [one.signal for one in told if one.signal in raw.signals]
    held = [*inputs, *beside, *(f"{name} reference" for name in outputs if named)]
    table = resample(raw, sample_time_s=wired.sample_time_s, inputs=held, outputs=outputs)
    return table, named


ENDINGS = ("_reference", "_target", "_setpoint", ".target")


def _reference(source: Source, ending: str) -> Source:
    stem = source.source.removesuffix(".temp") if ending == ".target" else source.source
    return source._replace(signal=f"{source.signal} reference", source=f"{stem}{ending}")


def _sources(made: Exported, signals: Sequence[Signal]) -> tuple[list[Source], str, str]:
    """Where a recording has these signals: as ingest.mapping says if params.yaml is of this
    machine, otherwise under their own names; the decimal mark and the clock."""
    plain = [Source(one.name, one.name, one.unit) for one in signals]
    if not Path(params.FILE).exists():
        return plain, "", ""
    settings = params.load(Ingest, "ingest")
    mapped = settings.mapping
    if not {one.name for one in signals} <= set(mapped):
        return plain, settings.decimal, ""
    return ([Source(one.name, *_of(mapped[one.name])) for one in signals], settings.decimal, settings.time)


def _of(mapped: Any) -> tuple[str, str, float, float]:
    return mapped.source, mapped.unit, mapped.scale, mapped.offset


def references(table: Table, named: str, made: Exported, reference: tuple[float, ...]) -> np.ndarray:
    """References (T, p) in °C: `reference` (p,) of --reference, else the recording's, else those of
    params.yaml."""
    outputs, T = [one.name for one in made.machine.outputs], len(table.time_s)
    if reference:
        if len(reference) != len(outputs):
            raise ValueError(
                f"--reference: expected {len(outputs)} temperatures in °C ({', '.join(outputs)}), found "
                f"{len(reference)}; write one for each output, in order"
            )
        return np.tile(reference, (T, 1))
    if named:
        return np.stack([table.values[f"{name} reference"] for name in outputs], axis=1)
    declared = params.load(Plant, "plant").outputs if Path(params.FILE).exists() else []
    if [one.name for one in declared] == outputs:
        return np.tile([one.reference for one in declared], (T, 1))
    raise ValueError(
        f"{table.recording}: it has no references ({outputs[0]}_reference and so on), expected some to be "
        f"asked for; write --reference with a temperature in °C for each of {', '.join(outputs)}"
    )


# ---- the replay


def replayed(
    made: Exported, within: support.Support | None, table: Table, r: np.ndarray
) -> ReplayedRecording:
    """Every segment by itself, from its first sample on in manual."""
    wired = made.machine
    u, y = (
        np.stack([table.values[one.name] for one in side], axis=1) for side in (wired.inputs, wired.outputs)
    )
    masked = np.stack([table.masked[one.name] for one in (*wired.inputs, *wired.outputs)], axis=1).any(axis=1)
    u, y, r = (_filled(part) for part in (u, y, r))
    forward, lacking = _forward(made, table)
    runs, offs, told = [], [], []
    observers = support.design_observers(within.spread, within.steps) if within else None
    cuts = np.flatnonzero(np.diff(table.segment)) + 1
    acts = u - forward
    logs = map(GaplessLog, *(np.split(part, cuts) for part in (acts, y, r)))
    for log, fed in zip(logs, np.split(forward, cuts), strict=True):
        offs.append(_check_log(within, log, observers))
        if offs[-1].abstains:
            runs.append((replay.Replayed(*[log.u + fed] * 3, log.r), np.zeros(log.u.shape, int)))
            continue
        run = replay.replayed(made.controller, made.model, log, hold=min(HOLD, len(log.u)), forward=fed)
        runs.append((run, replay.why(made.controller, log, run)))
    joined = replay.Replayed(*(np.concatenate(part) for part in zip(*(run for run, _ in runs), strict=True)))
    length = np.array([len(one.off) for one in offs])
    abstains = bool(length[[one.abstains for one in offs]].sum() > 0.5 * length.sum())
    cause = _causes(made, GaplessLog(acts, y, r), cuts)
    # of several segments the longest that is off speaks; of none the longest
    spoken = max(offs, key=lambda one: (one.abstains == abstains, len(one.off)))
    told += support.reasons(spoken)
    if within is None:
        told.append("The folder holds no support: whether the recording is off it is not known.")
    if lacking:
        told.append(f"The recording lacks {', '.join(lacking)}: nothing is fed forward for what they did.")
    if masked.any():
        told.append(f"{int(masked.sum())} samples lack a signal; the last value stands for it.")
    return ReplayedRecording(
        table.time_s, u, joined.wished, joined.asked, np.concatenate([why for _, why in runs]), y, r,
        joined.target, np.concatenate([one.off for one in offs]), cause, abstains, tuple(told),
    )  # fmt: skip


def _forward(made: Exported, table: Table) -> tuple[np.ndarray, list[str]]:
    """What the controller feeds forward (T, m), and the disturbances that the recording lacks."""
    names = [one.name for one in made.machine.disturbances]
    nothing = np.full(len(table.time_s), np.nan)
    told = [table.values.get(name, nothing) for name in names]
    d = np.stack(told, axis=1) if told else np.zeros((len(nothing), 0))
    lacking = [name for name in names if name not in table.values]
    return all_fed_forward(made.controller, d), lacking


def _check_log(
    within: support.Support | None, log: GaplessLog, observers: support.Observers | None
) -> support.SupportCheck:
    if within is None or observers is None:
        return support.SupportCheck(np.zeros(len(log.u), np.int8), np.zeros(3), 0.0, False, False)
    return support.check_log(within, log, observers)


def _filled(values: np.ndarray) -> np.ndarray:
    """The last number that there was; before the first the first. Raises ValueError if there is none."""
    missing = ~np.isfinite(values)
    if not missing.any():
        return values
    if missing.all(axis=0).any():
        raise ValueError("the recording holds a signal without any number; map another source")
    rows = np.where(missing, 0, np.arange(len(values))[:, None])
    first = (~missing).argmax(axis=0)
    rows = np.maximum(np.maximum.accumulate(rows, axis=0), first)
    return np.take_along_axis(values, rows, axis=0)


def _causes(made: Exported, log: GaplessLog, cuts: np.ndarray) -> np.ndarray:
    """The first cause (T,) that the supervisor has under the recorded inputs, as an index of
    supervise.KINDS; -1 if it has none, and at samples that it did not watch."""
    T, cause = len(log.u), np.full(len(log.u), -1, np.int8)
    starts = [0] if T <= WATCHED else np.linspace(0, T - STRETCH, WATCHED // STRETCH).astype(int)
    length = T if T <= WATCHED else STRETCH
    s = made.supervision
    for start in starts:
        k = supervise.kept(s)
        for t in range(int(start), int(start) + length):
            if t in cuts:
                k = supervise.kept(s)
            supervise.follow(s, k, log.y[t], None, int(k.counters[supervise.SAMPLES] >= HOLD))
            k.asked[:] = log.u[t]
            k.clock_s[1] += s.sample_time_s
            active = np.flatnonzero((k.since >= 0).any(axis=1))
            cause[t] = active[0] if len(active) else -1
    return cause


# ---- what is written


def summary(done: ReplayedRecording, made: Exported, path: Path) -> dict[str, Any]:
    """replay.json: shares of samples by what kept the law from its wish, off support, and causes."""
    T = len(done.time_s)
    difference = np.abs(done.asked - done.applied)[HOLD:]
    return {
        "recording": path.name,
        "controller": made.name,
        "controller_sha256": machine.controller_sha256(made),
        "simulated": made.simulated,
        "samples": T,
        "abstains": done.abstains,
        "off_support": {
            name: float((done.off & bit != 0).mean())
            for name, bit in (
                ("temperature", support.TEMPERATURE),
                ("command", support.COMMAND),
                ("forecast", support.FORECAST),
            )
        },
        "asked_otherwise_percent": None
        if done.abstains or not len(difference)
        else {one.name: float(difference[:, i].mean()) for i, one in enumerate(made.machine.inputs)},
        "held_back": {
            one.name: {
                word: float((done.why[:, i] == code).mean()) for code, word in enumerate(replay.WHY) if word
            }
            for i, one in enumerate(made.machine.inputs)
        },
        "causes": {
            kind: float((done.cause == k).mean())
            for k, kind in enumerate(supervise.KINDS)
            if (done.cause == k).any()
        },
        "notes": list(done.told),
    }


def signals(done: ReplayedRecording, made: Exported) -> dict[str, tuple[np.ndarray, str, str]]:
    """The columns of replay.mcap; if the replay abstains, what was asked is what was applied."""
    columns: dict[str, tuple[np.ndarray, str, str]] = {}
    asked = done.applied if done.abstains else done.asked
    for i, one in enumerate(made.machine.inputs):
        columns[f"{one.name}_applied"] = (done.applied[:, i], "percent", "as recorded")
        columns[f"{one.name}_asked"] = (asked[:, i], "percent", "what it would have asked")
        columns[f"{one.name}_why"] = (
            done.why[:, i] * (not done.abstains), "1", "what held it back: " + _codes(replay.WHY),
        )  # fmt: skip
    for j, one in enumerate(made.machine.outputs):
        columns[f"{one.name}_measured"] = (done.measured[:, j], "degC", "as recorded")
        columns[f"{one.name}_reference"] = (done.reference[:, j], "degC", "what was asked for")
        columns[f"{one.name}_target"] = (done.target[:, j], "degC", "the nearest that the inputs can hold")
    columns["off_support"] = (done.off, "1", "1 temperature, 2 command, 4 forecast, summed")
    columns["cause"] = (done.cause, "1", "of the supervisor: -1 none, " + _codes(supervise.KINDS))
    return columns


def _codes(names: Sequence[str]) -> str:
    return ", ".join(f"{code} {name}" for code, name in enumerate(names) if name)


def layout(made: Exported) -> dict[str, Any]:
    """A layout for Foxglove: temperatures, then commands, then what held them back."""

    def plot(title: str, names: Sequence[str]) -> dict[str, Any]:
        return {
            "title": title,
            "paths": [
                {"value": f"/replay.{name}", "enabled": True, "timestampMethod": "receiveTime"}
                for name in names
            ],
            "showXAxisLabels": True, "showYAxisLabels": True, "showLegend": True, "legendDisplay": "floating",
            "isSynced": True, "xAxisVal": "timestamp", "sidebarDimension": 240,
        }  # fmt: skip

    inputs, outputs = [one.name for one in made.machine.inputs], [one.name for one in made.machine.outputs]
    panels = {
        "Plot!temperatures": plot(
            "Temperatures", [f"{n}_{k}" for n in outputs for k in ("measured", "reference")]
        ),
        "Plot!commands": plot("Commands", [f"{n}_{k}" for n in inputs for k in ("applied", "asked")]),
        "Plot!why": plot("What held it back", [*(f"{n}_why" for n in inputs), "off_support", "cause"]),
    }
    first, second, third = panels
    lower = {"first": second, "second": third, "direction": "column", "splitPercentage": 60}
    return {
        "configById": panels,
        "globalVariables": {}, "userNodes": {}, "playbackConfig": {"speed": 1},
        "layout": {"first": first, "second": lower, "direction": "column", "splitPercentage": 40},
    }  # fmt: skip


def replay_recording(
    folder: Path, path: Path, out: Path, reference: tuple[float, ...] = ()
) -> tuple[ReplayedRecording, Exported, dict[str, Any]]:
    """Reads, replays and writes replay.mcap, layout.json and replay.json below `out`."""
    made = machine.read(folder)[0]
    within = read_support(folder, made)
    table, named = recorded(path, made)
    done = replayed(made, within, table, references(table, named, made, reference))
    told = summary(done, made, path)
    every = max(-(-len(done.time_s) // MESSAGES), 1)
    thinned = {
        name: (values[::every], unit, text) for name, (values, unit, text) in signals(done, made).items()
    }
    time = done.time_s[::every] - min(float(done.time_s[0]), 0.0)
    with artifacts.together(out) as place:
        artifacts.write_recording(place / "replay.mcap", time, thinned, topic="/replay")
        artifacts.write_json(place / "layout.json", layout(made))
        artifacts.write_json(place / "replay.json", told)
    return done, made, told
