"""Nights that only screen: the champion is made once from four good shifts, later nights hold their recording
against it. Quiet nights, creeping and stepping faults, true mistakes of recording, of the machines and
operators of `benchmarks.shifts`.

`nice ./run python -m benchmarks.screened_nights` plays all of them and prints bars beside figures;
`--only gain_creep_5,delay_3_s --machine walls --operator integrating --seed 2` plays these.
`--show` prints every night. Results go to benchmarks/results/nights.json, a key each machine and seed.

What a fault is, is known here: the night when it passes its key's limit in `nightly.drift`, kind and
channel. Found is an alarm by two nights after that, and none while it is below EARLY of the limit.
"""

import argparse
import json
import os
import re
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from benchmarks import nights, shifts
from benchmarks.shifts import Fault, Surroundings
from pipeline.nightly import inputs, screening
from pipeline.nightly.remembered import DriftMemory
from pipeline.nightly.settings import Nightly
from pipeline.report.shared.night import Alarm
from pipeline.store import artifacts, params
from pipeline.temperature import identification, plant

RAW, CHAMPION = Path("datasets/raw/temperature"), Path("champion/temperature")
LOOP = "temperature"
GOOD = 4  # shifts that the champion is made of
ORDER = 6  # up to which models are asked; `walls` has eight states
CREEP, STEP_AT = 20, 4  # nights of a creep; the night of a step, after three quiet ones
LATE = 2  # nights after the limit is passed by which an alarm must have come
EARLY = 0.8  # share of the limit below which an alarm is a false one: estimates scatter
QUIET = ("quiet", "ambient_3", "ambient_within_5")  # what the bar of no alarm is asked of
# the key of nightly.drift that a fault is held against, the first that there is, and what counts where there
# is none
KEYS: Mapping[str, tuple[tuple[str, ...], float]] = {
    "gain": (("gain_percent", "parameter_percent"), 4.0),
    "time constant": (("time_constant_percent", "parameter_percent"), 4.0),
    "offset": (("sensor_degC", "offset_degC"), 0.5),
    "saturation": (("saturation_points", "at_limits_points"), 10.0),
    "noise": (("noise_percent",), 50.0),
    "delay": (("delay_s",), 2.0),
}
# how an alarm names a kind, where it has no field of that name
WORDS = {
    "gain": r"\bgain\b",
    "time constant": r"time constant",
    "delay": r"\bdelay|\blater\b|dead time",
    "saturation": r"no longer gives|saturat|at a limit|more than \d+ %",
    "noise": r"\bnoise\b",
    "offset": r"\boffset\b|\breads\b",
}


class Scenario(NamedTuple):
    """So many nights of faults and surroundings by night (1 is the first); kind, channel and size by night of
    the fault in the unit of its key, empty where there is none. `size` None: measured on the record."""

    nights: int
    fault: Callable[[int], Fault]
    around: Callable[[int, np.random.Generator], Surroundings]
    kind: str = ""
    channel: str = ""
    size: Callable[[int], float] | None = None


# ---- surroundings


def _steady(_: int, rng: np.random.Generator) -> Surroundings:
    return shifts.calm(shifts.AMBIENT_DEGC + rng.uniform(-0.5, 0.5))


def _another_ambient(_: int, rng: np.random.Generator) -> Surroundings:
    return shifts.calm(shifts.AMBIENT_DEGC + rng.uniform(-3.0, 3.0))


def _drifting_ambient(k: int, rng: np.random.Generator) -> Surroundings:
    """+-5 °C within the record: on odd nights a slow sine, on even ones a ramp up or down."""
    t = np.arange(shifts.SAMPLES) / shifts.SAMPLES
    sine = np.sin(2 * np.pi * (rng.uniform(0.5, 1.5) * t + rng.uniform(0, 1)))
    moved = sine if k % 2 else rng.choice([-1.0, 1.0]) * (2 * t - 1)
    return Surroundings(shifts.AMBIENT_DEGC + 5.0 * moved, np.zeros(shifts.SAMPLES))


def _restless(k: int, rng: np.random.Generator) -> Surroundings:
    """Two to four draughts of 20 to 60 s, each of which takes 2 to 4 % of a heater from both zones."""
    ambient, draught = _steady(k, rng).ambient_degC, np.zeros(shifts.SAMPLES)
    for _ in range(rng.integers(2, 5)):
        start, length = rng.integers(0, shifts.SAMPLES - 60), rng.integers(20, 61)
        draught[start : start + length] = rng.uniform(2.0, 4.0)
    return Surroundings(ambient, draught)


# ---- faults


def _creep(k: int) -> float:
    return min(k / CREEP, 1.0)


def _step(k: int) -> float:
    return float(k >= STEP_AT)


def _crept(name: str, by: float, kind: str) -> Scenario:
    return Scenario(
        CREEP + LATE, lambda k: Fault(**{name: (1.0 + by * _creep(k), 1.0)}), _steady, kind, "heater_1",
        lambda k: abs(100 * by) * _creep(k),
    )  # fmt: skip


def _stepped(fault: Callable[[float], Fault], kind: str, channel: str, size: float | None) -> Scenario:
    return Scenario(
        STEP_AT + LATE + 2, lambda k: fault(_step(k)), _steady, kind, channel,
        None if size is None else lambda k: size * _step(k),
    )  # fmt: skip


def scenarios() -> dict[str, Scenario]:
    def quiet(around) -> Scenario:
        return Scenario(20, lambda _: Fault(), around)

    return {
        "quiet": quiet(_steady),
        "ambient_3": quiet(_another_ambient),
        "ambient_within_5": quiet(_drifting_ambient),
        "restless": quiet(_restless),
        "gain_creep_5": _crept("gain", -0.05, "gain"),
        "gain_creep_10": _crept("gain", -0.10, "gain"),
        "tau_creep_5": _crept("slower", 0.05, "time constant"),
        "tau_step_5": _stepped(lambda s: Fault(slower=(1 + 0.05 * s, 1.0)), "time constant", "heater_1", 5.0),
        "sensor_up_1.5": _stepped(lambda s: Fault(sensor_degC=(1.5 * s, 0.0)), "offset", "sensor_1", 1.5),
        "sensor_down_1.5": _stepped(lambda s: Fault(sensor_degC=(0.0, -1.5 * s)), "offset", "sensor_2", 1.5),
        "heater_capped_78": _stepped(
            lambda s: Fault(cap_percent=(100.0, 100.0 - 22.0 * s)), "saturation", "heater_2", None
        ),
        "noise_2": _stepped(lambda s: Fault(noise=(1.0 + s, 1.0)), "noise", "sensor_1", 100.0),
        "delay_3_s": _stepped(lambda s: Fault(delay_s=(int(3 * s), 0)), "delay", "heater_1", 3.0),
        "delay_8_s": _stepped(lambda s: Fault(delay_s=(0, int(8 * s))), "delay", "heater_2", 8.0),
    }


# ---- mistakes of recording


class Mistaken(NamedTuple):
    """A good shift written down wrongly, and what the reason beside it in quarantine must say (regex)."""

    name: str
    written: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]
    reason: str


def _scaled(name: str, factor: float) -> Callable:
    return lambda c: c | {name: factor * c[name]}


def _fahrenheit(*names: str) -> Callable:
    return lambda c: c | {name: 1.8 * c[name] + 32 for name in names}


def _swapped(c: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return c | {"sensor_1": c["sensor_2"], "sensor_2": c["sensor_1"]}


def _clock(late_s: int) -> Callable:
    """Outputs stamped so much later than they were read; a few rows of the ends are lost."""

    def shifted(c: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        now, then = (slice(late_s, None), slice(None, -late_s)) if late_s > 0 else (
            slice(None, late_s), slice(-late_s, None))  # fmt: skip
        return {name: values[then if name.startswith("sensor") else now] for name, values in c.items()}

    return shifted


def mistaken() -> list[Mistaken]:
    """Twenty."""
    tens = [("heater_1", 0.1), ("heater_2", 0.1), ("heater_1", 0.1), ("sensor_1", 0.1), ("sensor_2", 10.0)]
    ten = r".*(\b10\b|\b0\.1\b|tenth|\bhigh 300)"
    return [
        *[Mistaken("°F, all", _fahrenheit("sensor_1", "sensor_2"), "every sensor.*°F")] * 3,
        *[Mistaken(f"°F, {n}", _fahrenheit(n), f"{n}.*°F") for n in ("sensor_1", "sensor_2", "sensor_1")],
        *[Mistaken("swapped sensors", _swapped, "sensor_1 and sensor_2 are swapped")] * 4,
        *[Mistaken(f"{name} x {factor:g}", _scaled(name, factor), name + ten) for name, factor in tens],
        *[Mistaken(f"clock {late:+d} s", _clock(late), _late(late)) for late in (5, 10, 20, -20, 60)],
    ]


def explains(one: Mistaken, reason: str) -> bool:
    """Whether the reason beside a record that was set aside says what is wrong with it."""
    return bool(re.search(one.reason, reason, re.IGNORECASE))


def _late(seconds: int) -> str:
    """The clock is blamed, and the seconds are right to two."""
    said = "|".join(str(abs(seconds) + by) for by in (-2, -1, 0, 1, 2))
    return rf"(clock|late|earl|shift).*\b({said})(\.\d+)? s"


# ---- the champion


def commissioned(folder: Path, machine: str, operator: str, seed: int) -> None:
    """The champion's folder, from GOOD shifts; the working directory is in `folder` afterwards."""
    folder.mkdir(parents=True)
    os.chdir(folder)
    Path("params.yaml").write_text(yaml.safe_dump(nights.settings()))
    good = [_shift(machine, operator, Fault(), _steady, 0, [seed, 900 + k]) for k in range(GOOD)]
    for k, columns in enumerate(good):
        nights.write(RAW / f"good_{k}.csv", columns)
    u, y = (
        [np.column_stack([columns[f"{kind}_1"], columns[f"{kind}_2"]]) for columns in good]
        for kind in ("heater", "sensor")
    )
    model = identification.identify(
        u, y, sample_time_s=1.0, settings=identification.Settings(max_order=ORDER),
        names=["heater_1", "heater_2"],
    ).plant  # fmt: skip
    artifacts.write_arrays(CHAMPION / "identify_plant/plant.parquet", "plant", 1, plant.stored([model]))
    artifacts.write_json(
        CHAMPION / screening.REFERENCE,
        screening.reference(params.load(Nightly, "nightly").loops[LOOP], CHAMPION),
    )
    for path in RAW.glob("good_*.csv"):
        path.unlink()


def _shift(
    machine: str, operator: str, fault: Fault, around: Callable, night: int, seed: Sequence[int]
) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    surroundings = around(night, rng)
    return shifts.record(shifts.MACHINES[machine], shifts.OPERATORS[operator], fault, surroundings, rng)


# ---- nights


class Told(NamedTuple):
    """What one night said: alarms, and the reason of a recording that was set aside, if it was."""

    alarms: list[Alarm]
    aside: str


def screened(columns: dict[str, np.ndarray], memory: DriftMemory, night: int) -> tuple[Told, DriftMemory]:
    """One recording held against the champion, by the memory of the nights before; the
    memory goes through JSON, as the job's does."""
    path = RAW / f"shift_{night:03d}.csv"
    nights.write(path, columns)
    try:
        looked = screening.look(
            params.load(Nightly, "nightly"),
            {LOOP},
            {LOOP: {str(path): f"digest {night}"}},
            memory,
            night=night,
        )
    finally:
        path.unlink(missing_ok=True)
        for aside in (inputs.QUARANTINE / LOOP).glob("*"):
            aside.unlink()
    written = json.loads(json.dumps(looked.memory.written()))
    aside = looked.drift.quarantined.get(str(path), "")
    return Told(list(looked.drift.of(LOOP).alarms), aside), DriftMemory.read(written)


def blamed(alarm: Alarm) -> tuple[set[str], str]:
    """Kinds (two where the night could not tell) and channel that an alarm names."""
    kinds, channel = getattr(alarm, "kind", ""), getattr(alarm, "channel", "")
    if kinds:
        return set(kinds.split(" or ")), channel
    named = re.findall(r"\b(?:heater|sensor)_\d\b", f"{alarm.key} {alarm.cause}")
    text = f"{alarm.key} {alarm.cause}"
    return {kind for kind, words in WORDS.items() if re.search(words, text)}, named[0] if named else ""


def played(
    name: str, scenario: Scenario, machine: str, operator: str, seed: int, *, show: bool
) -> dict[str, Any]:
    """The nights of one scenario, and what came of them."""
    known = params.load(Nightly, "nightly").drift
    key, limit = _limit(scenario.kind, known)
    memory, told, sizes = DriftMemory(), [], []
    drawn = [seed, sum(name.encode()), int(operator == "integrating")]
    for k in range(1, scenario.nights + 1):
        columns = _shift(machine, operator, scenario.fault(k), scenario.around, k, [*drawn, k])
        sizes.append(_size(scenario, k, columns))
        said, memory = screened(columns, memory, k)
        told.append(said)
        if show:
            print(f"    {name} {k} size {sizes[-1]:.3g}: {said}", flush=True)
    return _outcome(scenario, told, sizes, key, limit)


def _limit(kind: str, drift: Any) -> tuple[str, float]:
    """The key of nightly.drift that a kind is held against, and its value."""
    if not kind:
        return "", np.inf
    names, otherwise = KEYS[kind]
    name = next((name for name in names if hasattr(drift, name)), "")
    return (name, getattr(drift, name)) if name else (f"no key {names[0]}", otherwise)


def _size(scenario: Scenario, k: int, columns: Mapping[str, np.ndarray]) -> float:
    """The fault in the unit of its key; of a capped heater the share of the record, in percent, in which
    more was asked of it than it gives."""
    if scenario.size:
        return scenario.size(k)
    caps = zip(("heater_1", "heater_2"), scenario.fault(k).cap_percent, strict=True)
    return max(100 * float(np.mean(columns[name] > cap)) for name, cap in caps)


def _outcome(
    scenario: Scenario, told: Sequence[Told], sizes: Sequence[float], key: str, limit: float
) -> dict[str, Any]:
    aside = [(k, one.aside) for k, one in enumerate(told, 1) if one.aside]
    alarmed = [k for k, one in enumerate(told, 1) if one.alarms]
    first = alarmed[0] if alarmed else None
    said = [f"{alarm.cause} [{alarm.sigmas:g}]" for alarm in told[first - 1].alarms] if first else []
    found: dict[str, Any] = {"alarm": first, "nights_with_alarm": len(alarmed), "said": said}
    found |= {"set_aside": len(aside), "set_aside_why": aside[0] if aside else None}
    if not scenario.kind:
        return found | {"passed": not alarmed and not aside}
    over = next((k for k, size in enumerate(sizes, 1) if size > limit), None)
    kinds, channel = blamed(told[first - 1].alarms[0]) if first else (set(), "")
    right = scenario.kind in kinds and len(kinds) <= 2 and channel == scenario.channel
    in_time = over is not None and first is not None and first <= over + LATE
    early = first is not None and sizes[first - 1] < EARLY * limit
    return found | {
        "key": key, "limit": limit, "over_limit": over, "size_at_alarm": sizes[first - 1] if first else None,
        "in_time": in_time and not early, "early": early, "right": right,
        "passed": in_time and not early and right and not aside,
    }  # fmt: skip


def mistakes(machine: str, operator: str, seed: int, *, show: bool) -> dict[str, Any]:
    """Each of the twenty, and whether it was set aside for what it is."""
    rows = []
    for k, one in enumerate(mistaken()):
        good = _shift(machine, operator, Fault(), _steady, 0, [seed, 500 + k])
        said, _ = screened(one.written(good), DriftMemory(), 1)
        right = explains(one, said.aside)
        rows.append({"mistake": one.name, "set_aside": bool(said.aside), "right": right, "said": said.aside})
        if show:
            print(f"    {rows[-1]} {said.alarms}", flush=True)
    n = sum(row["right"] for row in rows)
    wrong = [row for row in rows if not row["right"]]
    return {"of": len(rows), "right": n, "wrong": wrong, "passed": n == len(rows)}


# ---- the table


def _row(operator: str, name: str, found: Mapping[str, Any]) -> str:
    mark = "ok  " if found["passed"] else "FAIL"
    if name == "mistakes":
        tail = f"{found['right']} of {found['of']} set aside for what they are"
    elif "limit" not in found:
        tail = f"{found['nights_with_alarm']} nights with an alarm, {found['set_aside']} set aside"
        tail += f"; {found['said'][0][:100]}" if found["said"] else ""
    else:
        early, right = " (early)" if found["early"] else "", "right" if found["right"] else "wrong"
        tail = (
            f"over {found['key']} {found['limit']:g} in night {found['over_limit']}, "
            f"alarm in {found['alarm']}{early}, {right}, "
            f"{found['set_aside']} set aside; {(found['said'] or ['silent'])[0][:100]}"
        )
    return f"  {mark} {operator[:8]} {name:18s} {tail}"


def _bars(found: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Figures beside the bars, over all operators of one machine and seed."""
    rows = [(key.split(" ", 1)[1], value) for key, value in found.items()]
    restless = [value for name, value in rows if name == "restless"]
    still = [value for name, value in rows if name in QUIET]
    faults = [value for _, value in rows if "limit" in value]
    wrong = [value for _, value in rows if "of" in value]
    set_right, of = sum(v["right"] for v in wrong), sum(v["of"] for v in wrong)
    return [
        f"alarms in {20 * len(still)} quiet nights: {sum(v['nights_with_alarm'] for v in still)} (bar 0), "
        f"set aside: {sum(v['set_aside'] for v in still)} (bar 0); "
        f"in {20 * len(restless)} with draughts: {sum(v['nights_with_alarm'] for v in restless)} (no bar)",
        f"faults found in time: {sum(v['in_time'] for v in faults)} of {len(faults)} (bar all)",
        f"kind and channel right: {sum(v['right'] for v in faults)} of {len(faults)} (bar 90 %)",
        f"set aside among faults: {sum(v['set_aside'] for v in faults)} (bar 0)",
        f"mistakes set aside for what they are: {set_right} of {of} (bar all)",
    ]


def machine_played(
    machine: str, operators: Sequence[str], seed: int, only: Sequence[str], *, show: bool
) -> dict[str, Any]:
    """{operator scenario: what came of it}; `only` these scenarios, where any are named."""
    asked = {name: one for name, one in scenarios().items() if not only or name in only}
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="screened-") as place:
        for operator in operators:
            began = time.monotonic()
            commissioned(Path(place) / operator, machine, operator, seed)
            for name, one in asked.items():
                found[f"{operator} {name}"] = played(name, one, machine, operator, seed, show=show)
                print(_row(operator, name, found[f"{operator} {name}"]), flush=True)
            if not only or "mistakes" in only:
                found[f"{operator} mistakes"] = mistakes(machine, operator, seed, show=show)
                print(_row(operator, "mistakes", found[f"{operator} mistakes"]), flush=True)
            print(f"  {operator}: {time.monotonic() - began:.0f} s", flush=True)
            os.chdir(nights.ROOT)
    return found


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", default="", help="names with commas between; mistakes is one")
    parser.add_argument("--machine", choices=[*shifts.MACHINES, "all"], default="all")
    parser.add_argument("--operator", choices=[*shifts.OPERATORS, "all"], default="all")
    parser.add_argument("--seed", type=int, nargs="+", default=[1])
    parser.add_argument("--show", action="store_true", help="every night")
    a = parser.parse_args()
    only = [name for name in a.only.split(",") if name]
    if unknown := set(only) - {*scenarios(), "mistakes"}:
        parser.error(
            f"{sorted(unknown)[0]} is no scenario; there are {', '.join([*scenarios(), 'mistakes'])}"
        )
    machines = list(shifts.MACHINES) if a.machine == "all" else [a.machine]
    operators = list(shifts.OPERATORS) if a.operator == "all" else [a.operator]
    play_and_keep(a.seed, machines, operators, only, show=a.show)


def play_and_keep(
    seeds: Sequence[int],
    machines: Sequence[str] = tuple(shifts.MACHINES),
    operators: Sequence[str] = tuple(shifts.OPERATORS),
    only: Sequence[str] = (),
    *,
    show: bool = False,
) -> None:
    """Plays and prints; a machine and seed that were played whole are kept in the results."""
    for seed in seeds:
        for machine in machines:
            print(f"{machine}, seed {seed}", flush=True)
            found = machine_played(machine, operators, seed, only, show=show)
            bars = _bars(found)
            print("\n".join(f"  = {bar}" for bar in bars), flush=True)
            if only or len(operators) < len(shifts.OPERATORS):
                continue
            known = json.loads(nights.RESULTS.read_text()) if nights.RESULTS.exists() else {}
            kept = {"bars": bars, "scenarios": found}
            artifacts.write_json(nights.RESULTS, known | {f"screened_{machine}_seed_{seed}": kept})


if __name__ == "__main__":
    main()
