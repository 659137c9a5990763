"""Exported controllers in the normal life of heated machines that the product did not draw, and under faults.

    ./run --group dev python -m tests.foreign.normal_life --seeds 1-12 --hours 100

`make` walks the owner's path from two recordings to the exported C, `live` counts how often its supervisor
leaves the law on a healthy machine, `suffer` says what it does when something breaks. Exported folders stay
under BEADLINE_LIVES, if that is set, and are made once a seed.
"""

import argparse
import ctypes
import json
import os
import re
import resource
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.deploy.supervise import KINDS, MODES
from tests.foreign import thermal_machines
from tests.foreign.thermal_machines import FAN, Machine, draw, pointer, sampled
from tests.mission import toy_temperature

HERE = Path(__file__).parent
KEPT = "BEADLINE_LIVES"
FAULTS = (
    "no fault", "sensor open", "sensor out of range", "sensor still", "sensor still with its noise",
    "heater stuck on", "heater half", "heater off", "reference out of reach",
)  # fmt: skip
# not of the six: the sensor is seen only by the heat that the machine seems to lose
SLOW = ("sensor near its set-point", "sensor drifts")
RECORDS = ("quiet", "moved", "declared")  # what fan, feed and screw did while the owner recorded
# causes that name the fault, by the kinds of the supervisor
NAMES = {
    "sensor open": {"sensor_open"},
    "sensor out of range": {"sensor_open"},
    "sensor still": {"sensor_still", "sensor_deaf"},
    "sensor still with its noise": {"sensor_deaf", "sensor_still"},
    "heater stuck on": {"heater_stuck_on"},
    "heater half": {"heater_weak"},
    "heater off": {"heater_weak", "sensor_still", "sensor_deaf"},
    "reference out of reach": {"reference_out_of_reach"},
    **dict.fromkeys(SLOW, {"heater_weak", "sensor_deaf", "sensor_still"}),
}
COLD = 30  # samples in manual
PATIENCE_S = 1800.0  # after which a person acknowledges
ACTS_WITHIN, OFF_WITHIN = 31, 25  # samples from where a fault shows; of a heater that is stuck on
# whose files are taken where the owner's path ends without one
CANDIDATES = ("subspace_lqg", "varx_riccati", "pi", "pi_simc")
QUICK = {
    key: value for key, value in toy_temperature.TOY.items() if key.split(".")[0] != "panel"
} | {
    "panel.judging.plants": 6,
    "panel.judging.starts_degC": [20],
    "panel.judging.sequence_offsets_degC": [0, 5],
    "panel.training.plants": 4,
    "panel.training.starts_degC": [20],
    "panel.training.sequence_offsets_degC": [],
}  # fmt: skip


# ---- from the record to the exported C


def make(seed: int, folder: Path, *, records: str = RECORDS[0]) -> dict[str, Any]:
    """The owner's path for the machine of a seed in an empty folder: two recordings, `init`, limits and
    references, the stages up to the export. Fan and feed or screw rest in the recordings (`records` "quiet"),
    move unrecorded ("moved"), or move and are recorded beside, which `init` declares ("declared").

    Writes c/ (the exported C, or that of a controller that was not exported, so that its supervisor is judged
    all the same) and made.json, which it returns: controller, whether it was exported, why not, CPU s."""
    begin, project, machine = _cpu_s(), folder / "project", draw(seed)
    found: dict[str, Any] = {
        "seed": seed,
        "structure": machine.structure,
        "controller": None,
        "exported": False,
    }
    toy_temperature.begin(project)
    rng = np.random.default_rng([seed, 1])
    for name, recording in (("steps", thermal_machines.record), ("evening", thermal_machines.evening)):
        recorded, beside = recording(machine, rng, disturbed=records != "quiet"), records == "declared"
        thermal_machines.write_csv(folder / f"{name}.csv", machine, recorded, disturbed=beside)
    try:
        declare(project, machine, [folder / "evening.csv", folder / "steps.csv"])
        toy_temperature.play(project, *toy_temperature.stages_between("ingest", "export_controllers"))
        found |= _read_exported(project)
    except toy_temperature.Refused as refused:
        found["why"] = str(refused)
    if found["controller"]:
        shutil.copytree(project / found.pop("folder"), folder / "c")
    shutil.rmtree(project)
    found["cpu_s"] = round(_cpu_s() - begin, 1)
    (folder / "made.json").write_text(json.dumps(found, indent=1))
    return found


def declare(project: Path, machine: Machine, logs: list[Path]) -> None:
    """`init` on the recordings, and what its owner writes: limits, references."""
    toy_temperature.beadline(project, "init", *(str(log.resolve()) for log in logs), "--copy")
    outputs = toy_temperature.declared(project, "plant")["outputs"]
    allowed = [
        output | {"reference": float(r), "low": float(low), "high": float(high)}
        for output, r, low, high in zip(
            outputs, machine.reference_degC, machine.low_degC, machine.high_degC, strict=True
        )
    ]
    toy_temperature.declare(project, QUICK | {"plant.outputs": allowed})


def _read_exported(project: Path) -> dict[str, Any]:
    exported = json.loads((project / "datasets/export_controllers/exported.json").read_text())["temperature"]
    if exported["files"]:
        at = "datasets/export_controllers/temperature/c"
        return {"controller": exported["contestant"], "exported": True, "why": "", "folder": at}
    certified = json.loads((project / "datasets/certify/certified.json").read_text())["temperature"]
    found = {"why": exported["why"], "certify": {k: v["why"] for k, v in certified.items()}}
    for name in (exported["contestant"], *CANDIDATES):
        at = f"datasets/certify/temperature/{name}/c"
        if name and (project / at).exists():
            return found | {"controller": name, "folder": at}
    return found


def exported_folder(seed: int, *, records: str = RECORDS[0]) -> Path:
    """The folder that `make` filled for a seed; kept under BEADLINE_LIVES, if that is set."""
    kept = os.environ.get(KEPT)
    folder = Path(kept or tempfile.mkdtemp(prefix="lives_")) / f"{records}_{seed}"
    if not (folder / "made.json").exists():
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        make(seed, folder, records=records)
    return folder


# ---- a life


class Life(NamedTuple):
    """A row a sample: set-points, readings and sensors before noise and steps (T, p) in degC, commands (T, m)
    in percent, modes (T,), the first cause's kind and signal (T,), -1 for none, whether a person acknowledged
    (T,), and the signal of a fault with the samples at which it began and from which it shows, -1 for
    never."""

    target: np.ndarray
    reading: np.ndarray
    sensor: np.ndarray
    command: np.ndarray
    mode: np.ndarray
    cause: np.ndarray
    signal: np.ndarray
    acknowledged: np.ndarray
    struck: int  # the signal of the fault
    began: int
    shows: int


def build(folder: Path) -> ctypes.CDLL:
    """The exported C of a folder linked with the machine's."""
    library, sources = folder / "life.so", [HERE / "normal_life.c", HERE / "thermal_machine.c"]
    read = [folder / "c/controller.c", *sources]
    if not library.exists() or library.stat().st_mtime < max(path.stat().st_mtime for path in read):
        new = library.with_suffix(f".{os.getpid()}")
        command = [*thermal_machines.COMPILE, f"-I{folder / 'c'}", f"-I{HERE}", "-o", str(new)]
        subprocess.run([*command, *map(str, sources), "-lm"], check=True, timeout=300)
        new.replace(library)
    return ctypes.CDLL(str(library))


def sample_time_s(folder: Path) -> float:
    """That of an exported controller, which `init` proposed."""
    found = re.search(r"#define BEADLINE_SAMPLE_TIME_S (\S+)", (folder / "c/machine.h").read_text())
    if not found:
        raise ValueError(f"{folder}/c/machine.h tells no sample time")
    return float(found[1])


def told(folder: Path, machine: Machine, outside: np.ndarray) -> np.ndarray:
    """What the exported C is told of what acts from outside (T, 4): (T, q) in the order of its machine.h."""
    header = (folder / "c/machine.h").read_text()
    names = [name.lower() for name in re.findall(r"#define DISTURBANCE_(\w+) \d+", header)]
    columns = {name: (column, 1.0) for name, (column, _) in machine.recorded.items()}
    columns["fan"] = FAN, 100.0  # percent, as written
    signals = [outside[:, columns[name][0]] * columns[name][1] for name in names]
    return np.column_stack(signals) if signals else np.zeros((len(outside), 1))


def scenario(
    machine: Machine, seed: int, hours: float, nth: int
) -> tuple[np.ndarray, np.ndarray, int, np.random.Generator]:
    """Set-points (T, p), what acts from outside (T, 4), the seed of the noise, and the generator."""
    rng = np.random.default_rng([seed, 2, nth])
    r, outside = thermal_machines.life(machine, rng, hours)
    return r, outside, int(rng.integers(2**40)), rng


def play(
    folder: Path, seed: int, hours: float, *, fault: str = "no fault", nth: int = 0, after_h: float = 0.0
) -> Life:
    """The nth normal life of the machine of a seed under an exported controller; a fault begins at a random
    instant of its second half, `after_h` before the end at least."""
    machine, dt = draw(seed), sample_time_s(folder)
    r, outside, noise, rng = scenario(machine, seed, hours, nth)
    rows = np.arange(int(len(r) * machine.sample_time_s / dt)) * dt / machine.sample_time_s
    r, outside, machine = r[rows.astype(int)], outside[rows.astype(int)], sampled(machine, dt)
    T, m = len(r), len(machine.inputs)
    signal = int(rng.integers(m))
    earliest = int(T * rng.uniform(0.5, max(1 - after_h / hours, 0.5)))
    kind = (FAULTS + SLOW).index(fault)
    amount = {"reference out of reach": machine.high_degC[signal] + 10.0, SLOW[0]: 0.3, SLOW[1]: 0.1}
    beyond = float(amount.get(fault, -55.0))
    parts = machine.parts
    visible = np.maximum(3 * np.array(parts.step[:m]), 4 * np.array(parts.noise[:m]))
    y, sensor, u = np.zeros((T, m)), np.zeros((T, m)), np.zeros((T, m))
    modes, causes, signals, acknowledged = (np.zeros(T, np.int8) for _ in range(4))
    at = (ctypes.c_int * 2)()
    numbers = [ctypes.c_void_p(a.ctypes.data) for a in (modes, causes, signals, acknowledged)]
    result = build(folder).normal_life(
        ctypes.byref(parts), ctypes.c_double(machine.room_degC), ctypes.c_uint64(noise), T, COLD,
        round(PATIENCE_S / dt), pointer(r), pointer(outside), kind, signal, earliest, ctypes.c_double(beyond),
        pointer(visible), *map(pointer, (y, sensor, u)), *numbers, at,
        pointer(told(folder, machine, outside)),
    )  # fmt: skip
    if result:
        raise RuntimeError(f"machine {seed}: a call of the exported controller ended with result {result}")
    return Life(r, y, sensor, u, modes, causes, signals, acknowledged, signal, at[0], at[1])


def live(folder: Path, seed: int, hours: float, *, nth: int = 0) -> dict[str, Any]:
    """Figures of a normal life without a fault."""
    begin, life = time.process_time(), play(folder, seed, hours, nth=nth)
    machine = sampled(draw(seed), sample_time_s(folder))
    starts, ends = _runs(life.mode != 0, life.acknowledged)
    lengths = (ends - starts) * machine.sample_time_s
    causes = [_cause(life, a, b) for a, b in zip(starts, ends, strict=True)]
    named = {name: causes.count(name) for name in sorted(set(causes))}
    error, (own, own_target) = life.sensor - life.target, own_life(seed, hours, nth)
    changed = np.r_[True, (np.diff(life.target, axis=0) != 0).any(axis=1)]
    own_changed = np.r_[True, (np.diff(own_target, axis=0) != 0).any(axis=1)]
    past = life.sensor > machine.high_degC
    return {
        "hours": hours,
        "false_safe_modes": len(starts),
        "named": named,
        "safe_s_median": round(float(np.median(lengths)), 1) if len(lengths) else 0.0,
        "safe_s_longest": round(float(lengths.max()), 1) if len(lengths) else 0.0,
        "under_law_percent": round(100 * float((life.mode == 0).mean()), 2),
        "acknowledged": int(life.acknowledged.sum()),
        "crossings": int((np.diff(past.astype(int), axis=0) > 0).sum()),
        "rms_degC": _rms(error),
        "rms_settled_degC": _rms(_settled(error, changed, machine.sample_time_s)),
        "rms_settled_under_law_degC": _rms(
            _settled(error, changed | (life.mode != 0), machine.sample_time_s)
        ),
        "own_control_rms_degC": _rms(own),
        "own_control_rms_settled_degC": _rms(_settled(own, own_changed, draw(seed).sample_time_s)),
        "travel_percent_a_sample": np.abs(np.diff(life.command, axis=0)).mean(axis=0).round(3).tolist(),
        "cpu_s": round(time.process_time() - begin, 2),
    }


def own_life(seed: int, hours: float, nth: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors and set-points (T, p) of the same life under the machine's own control, at its sample time."""
    machine = draw(seed)
    r, outside, noise, _ = scenario(machine, seed, hours, nth)
    y, _ = thermal_machines.control(
        machine, thermal_machines.start(machine, noise), machine.own_control, r, outside
    )
    return y - r, r


def _rms(error: np.ndarray) -> list[float]:
    return np.sqrt((error**2).mean(axis=0)).round(2).tolist() if len(error) else []


def _settled(error: np.ndarray, changed: np.ndarray, sample_time_s: float) -> np.ndarray:
    """Errors from 15 min after the last change (T,) on: of set-points, or of the mode."""
    t = np.arange(len(error))
    return error[(t - np.maximum.accumulate(np.where(changed, t, 0))) * sample_time_s >= 900]


def _runs(safe: np.ndarray, acknowledged: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First samples of the safe modes, and those after their last; an acknowledgement ends one."""
    parted = safe.astype(int).copy()
    edges = np.diff(np.r_[0, parted, 0])
    starts, ends = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
    again = np.flatnonzero(acknowledged[:-1] & safe[1:]) + 1
    return np.sort(np.r_[starts, again]), np.sort(np.r_[ends, again])


def _cause(life: Life, begin: int, end: int) -> str:
    """What a safe mode was for at last: its first cause is an alarm while the cause is sought."""
    kinds = life.cause[begin:end]
    return KINDS[kinds[-1]] if len(kinds) and kinds[-1] >= 0 else "none"


def suffer(folder: Path, seed: int, fault: str, *, nth: int = 0, hours: float = 6.0) -> dict[str, Any]:
    """Figures of a fault in a normal life: samples from where it shows to where the law is left and to where
    the mode is off, modes and causes that followed within 600 samples, and degC past the limits."""
    machine, begin = draw(seed), time.process_time()
    life = play(folder, seed, hours, fault=fault, nth=nth, after_h=2.0)
    found: dict[str, Any] = {"fault": fault, "signal": life.struck + 1, "named": False}
    found |= {"began": life.began >= 0, "shows": life.shows >= 0}
    if life.began < 0:
        return found
    shows = life.shows if life.shows >= 0 else len(life.mode)
    safe = life.mode[life.began :] != 0
    off = (life.command[life.began :] <= 0).all(axis=1) & (life.mode[life.began :] == MODES.index("off"))
    left = life.began + int(safe.argmax()) if safe.any() else None
    found["left_after"] = None if left is None else left - shows
    found["off_after"] = life.began + int(off.argmax()) - shows if off.any() else None
    if left is not None:
        rows = slice(left, left + 600)
        found["modes"] = [MODES[k] for k in dict.fromkeys(life.mode[rows].tolist())]
        pairs = zip(life.cause[rows].tolist(), life.signal[rows].tolist(), strict=True)
        causes = [(KINDS[k], signal) for k, signal in dict.fromkeys(pairs) if k >= 0]
        found["causes"] = [f"{kind} {signal + 1}" if signal >= 0 else kind for kind, signal in causes]
        found["named"] = any(kind in NAMES[fault] and j in (life.struck, -1) for kind, j in causes)
    above = (life.sensor - life.target)[life.began :, life.struck]
    found["above_target_degC"] = round(float(above.max()), 1)
    found["past_limit_degC"] = round(float((life.sensor[life.began :] - machine.high_degC).max()), 1)
    found["in_time"] = _in_time(found, fault)
    found["cpu_s"] = round(time.process_time() - begin, 2)
    return found


def _in_time(found: dict[str, Any], fault: str) -> bool | None:
    """Whether the law was left within 31 samples from where the fault shows, or the heaters went off within
    25 if one is stuck on; None if it never showed."""
    if not found["shows"]:
        return None
    if fault == "heater stuck on":
        return found["off_after"] is not None and found["off_after"] <= OFF_WITHIN
    return found["left_after"] is not None and found["left_after"] <= ACTS_WITHIN


# ---- the table


def _cpu_s() -> float:
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in both)


def _seeds(text: str) -> list[int]:
    """1-3,7 -> 1 2 3 7"""
    ends = [[int(end) for end in part.split("-")] for part in text.split(",")]
    return [seed for first, *last in ends for seed in range(first, (last or [first])[0] + 1)]


def judge(seed: int, hours: float, trials: int, *, records: str = RECORDS[0]) -> dict[str, Any]:
    """All figures of a machine: {"made", "life", "faults"}."""
    folder = exported_folder(seed, records=records)
    made = json.loads((folder / "made.json").read_text())
    if not made["controller"]:
        return {"made": made, "life": None, "faults": []}
    life = live(folder, seed, hours)
    faults = [suffer(folder, seed, x, nth=10 + k) for x in FAULTS[1:] + SLOW for k in range(trials)]
    return {"made": made, "life": life, "faults": faults}


def fault_table(rows: list[dict[str, Any]]) -> list[str]:
    """A line a fault: how often it began and showed; of those that showed, how often the supervisor left the
    law in time (heater stuck on: was off), named the fault, and had every heater off in time; how often it
    left the law before the fault showed, perhaps for another reason; the median of samples until it acted."""
    lines = ["| fault | began | showed | in time | named | off in time | left before | samples |"]
    lines += ["|---|---|---|---|---|---|---|---|"]
    for fault in FAULTS[1:] + SLOW:
        ones = [one for row in rows for one in row["faults"] if one["fault"] == fault and one["began"]]
        shown = [one for one in ones if one["shows"]]
        key = "off_after" if fault == "heater stuck on" else "left_after"
        after = [one[key] for one in shown if one[key] is not None]
        counts = [
            len(ones),
            len(shown),
            sum(bool(one["in_time"]) for one in shown),
            sum(one["named"] for one in shown),
            sum(one["off_after"] is not None and one["off_after"] <= ACTS_WITHIN for one in shown),
            sum(one["left_after"] is not None and one["left_after"] < 0 for one in ones),
        ]
        middle = f"{np.median(after):g}" if after else "-"
        lines.append(f"| {fault} | {' | '.join(map(str, counts))} | {middle} |")
    return lines


def machine_table(rows: list[dict[str, Any]]) -> list[str]:
    """A line a machine: its controller and its normal life."""
    lines = [
        "| seed | machine | controller | hours | false safe modes | median s | longest s | under law % "
        "| crossings | rms settled | under law | own control | travel | make s | life s | causes |",
        "|" + "---|" * 16,
    ]
    for row in rows:
        made, life = row["made"], row["life"]
        begin = f"| {made['seed']} | {made['structure']} | {made['controller'] or 'none'}"
        begin += "" if made["exported"] or not made["controller"] else " (not exported)"
        if not life:
            lines.append(f"{begin} |" + " |" * 10 + f" {made['cpu_s']} | | |")
            continue
        names = (
            "hours", "false_safe_modes", "safe_s_median", "safe_s_longest", "under_law_percent", "crossings",
            "rms_settled_degC", "rms_settled_under_law_degC", "own_control_rms_settled_degC",
            "travel_percent_a_sample",
        )  # fmt: skip
        cells = [" ".join(f"{v:g}" for v in np.ravel(life[name])) for name in names]
        causes = ", ".join(f"{name} {count}" for name, count in life["named"].items())
        lines.append(f"{begin} | {' | '.join(cells)} | {made['cpu_s']} | {life['cpu_s']} | {causes} |")
    return lines


def print_machine(row: dict[str, Any], *, whole: bool = False) -> None:
    print("", *machine_table([row]), "", *fault_table([row]), sep="\n")
    if row["made"].get("why"):
        print(f"\n{row['made']['why']}")
        for name, why in row["made"].get("certify", {}).items():
            print(f"  {name}: {why or 'measured'}")
    for one in row["faults"] if whole else []:
        print("  ", json.dumps(one))
    print(flush=True)


def print_totals(rows: list[dict[str, Any]]) -> None:
    alive = [row for row in rows if row["life"]]
    exported = sum(row["made"]["exported"] for row in rows)
    hours = sum(row["life"]["hours"] for row in alive)
    false = sum(row["life"]["false_safe_modes"] for row in alive)
    crossings = sum(row["life"]["crossings"] for row in alive)
    print("\nAll machines", "", *machine_table(rows), "", *fault_table(alive), "", sep="\n")
    print(f"{len(rows)} machines, {exported} exported, {len(alive)} played.")
    print(f"{false} false safe modes in {hours:g} h, {crossings} crossings of limits.")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=_seeds, default=_seeds("1-12"))
    parser.add_argument("--hours", type=float, default=100.0)
    parser.add_argument("--trials", type=int, default=2, help="of each fault")
    parser.add_argument("--records", choices=RECORDS, default=RECORDS[0], help="what fan, feed, screw did")
    parser.add_argument("--whole", action="store_true", help="print every fault")
    parser.add_argument("--only-make", action="store_true")
    asked = parser.parse_args()
    judged = []
    for seed in asked.seeds:
        if asked.only_make:
            print((exported_folder(seed, records=asked.records) / "made.json").read_text(), flush=True)
            continue
        judged.append(judge(seed, asked.hours, asked.trials, records=asked.records))
        print_machine(judged[-1], whole=asked.whole)
    if judged:
        print_totals(judged)


if __name__ == "__main__":
    main()
