"""The owner of a printer, from klippy.log to prints under the exported controller, in the firmwares' trees.

    ./run --group dev python -m tests.klipper.owner --seeds 901-920

Nothing is edited by hand: the log of an evening's print, `init`, the experiment of `experiment temperature`
printed from the virtual SD card, the stages, and the exported files as they are written, in both firmwares.
"""

import argparse
import json
import re
import resource
import shutil
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tests.foreign.hot_end import Parts
from tests.foreign.normal_life import QUICK
from tests.klipper import trees
from tests.mission import toy_temperature

CALIBRATE = [["gcode", "PID_CALIBRATE HEATER=extruder TARGET=210"], ["gcode", "SAVE_CONFIG"]]
TARGET_DEGC = 210.0
FANS = (0, 50, 100)  # percent
FEEDS_W = (0.0, 5.0, 10.0)
PLAYED_S, REST_S = 600, 240
STEADY_DUTY = 0.85  # above it the heater has nothing left


class Printer(NamedTuple):
    """A hot end, and the heat that a mm of its filament takes away."""

    seed: int
    parts: Parts
    feed_J_per_mm: float


def draw(seed: int) -> Printer:
    """20 to 60 W, a thermistor of 1 to 5 s, convection, radiation, fan."""
    rng = np.random.default_rng([seed, 39])
    parts = Parts(
        power_W=rng.uniform(20, 60),
        cartridge_J_per_K=rng.uniform(2, 6),
        block_J_per_K=rng.uniform(8, 25),
        cartridge_to_block_W_per_K=rng.uniform(0.6, 1.5),
        convection_W=rng.uniform(0.008, 0.02),
        fan=rng.uniform(0.15, 0.8),
        radiation_W_per_K4=rng.uniform(1e-11, 6e-11),
        cold_end_W_per_K=rng.uniform(0.005, 0.03),
        room_degC=rng.uniform(17, 28),
        thermistor_s=rng.uniform(1, 5),
        step_degC=float(rng.choice([0.05, 0.1, 0.25])),
        noise_degC=rng.uniform(0.02, 0.1),
    )
    return Printer(seed, parts, rng.uniform(0.9, 1.6))


def steady_duty(printer: Printer, fan_percent: float, feed_W: float) -> float:
    """The share of its power that holds TARGET_DEGC."""
    p, above = printer.parts, TARGET_DEGC - printer.parts.room_degC
    lost = p.convection_W * (1 + p.fan * fan_percent / 100) * above**1.25 + feed_W
    lost += p.radiation_W_per_K4 * ((TARGET_DEGC + 273.15) ** 4 - (p.room_degC + 273.15) ** 4)
    lost += p.cold_end_W_per_K * (TARGET_DEGC - p.cold_end_degC)
    return lost / p.power_W


def evening(printer: Printer, minutes: float = 40.0) -> str:
    """A print as a slicer writes it: a first layer without a fan, then a fan by layer, lines and travels."""
    rng = np.random.default_rng([printer.seed, 40])
    largest = 0.7 * min(10.0, (0.8 - steady_duty(printer, 100, 0.0)) * printer.parts.power_W)
    largest = max(largest, 1.0) / printer.feed_J_per_mm
    lines, passed = ["M83", f"M109 S{TARGET_DEGC:g}"], 0.0
    while passed < 60 * minutes:
        if passed:
            lines.append(f"M106 S{rng.choice([0, 128, 255])}")
        speed, layer_s = largest * rng.uniform(0.1, 1.0), rng.uniform(40, 150)
        passed += layer_s + 10
        lines += [f"G1 E{speed:.4f} F{60 * speed:.1f}"] * round(layer_s)
        lines += ["G4 P2500"] * 4
    return "\n".join([*lines, "M107", "M104 S0", ""])


def make(tree: trees.Tree, folder: Path, printer: Printer) -> dict[str, Any]:
    """The walk to the exported files, in an empty folder, and what came of it: made.json."""
    begin, project, rig = _cpu_s(), folder / "project", folder / "rig"
    found: dict[str, Any] = {"seed": printer.seed, "files": False, "why": ""}
    (rig / "gcodes").mkdir(parents=True)
    options = {"parts": printer.parts._asdict(), "feed_J_per_mm": printer.feed_J_per_mm, "seed": printer.seed}
    (rig / "gcodes/evening.gcode").write_text(evening(printer))
    trees.play(tree, rig, [*CALIBRATE, ["print", "evening.gcode"]], **options)
    toy_temperature.begin(project)
    log = str((rig / "klippy.log").resolve())
    try:
        toy_temperature.beadline(project, "init", log, "--copy")
        said = toy_temperature.beadline(project, "experiment", "temperature")
        found["experiment"] = said.splitlines()[0]
        shutil.copy(project / "first_experiment.gcode", rig / "gcodes/experiment.gcode")
        out = trees.play(tree, rig, [["print", "experiment.gcode"]], start_s=1e5, **options)
        found["hottest_degC"] = round(float(np.array(out["trace"])[:, 1].max()), 1)
        raw = project / "datasets/raw/temperature"
        shutil.copy(log, raw / "klippy.log")
        for one in (rig / "gcodes").iterdir():
            shutil.copy(one, raw / one.name)
        toy_temperature.declare(project, QUICK)
        toy_temperature.play(project, *toy_temperature.stages_between("ingest", "export_controllers"))
        exported = json.loads((project / "datasets/export_controllers/exported.json").read_text())
        found |= {"controller": exported["temperature"]["contestant"], "why": exported["temperature"]["why"]}
        found["files"] = bool(exported["temperature"]["files"])
        found["sample_time_s"] = toy_temperature.declared(project, "plant")["sample_time_s"]
        if found["files"]:
            at = str(project / "datasets/export_controllers/temperature")
            toy_temperature.beadline(
                project, "export", at, "--to", "klipper", "--out", str(folder / "klipper")
            )
        shutil.copytree(project / "datasets/certify", folder / "certify")
    except toy_temperature.Refused as refused:
        found["why"] = str(refused)
    found["cpu_s"] = round(_cpu_s() - begin, 1)
    (folder / "made.json").write_text(json.dumps(found, indent=1))
    return found


def printing(tree: trees.Tree, folder: Path, printer: Printer, exported: Path | None) -> dict[str, Any]:
    """Every fan with every filament for PLAYED_S from a hold, under the exported controller, or under
    PID_CALIBRATE's: worst dip and r.m.s. error of the block over what the heater has power for, shutdowns
    there, and whether the printer shut down where it has none."""
    folder.mkdir(parents=True)
    combinations = [(f, w) for f in FANS for w in FEEDS_W]
    combinations.sort(key=lambda one: steady_duty(printer, *one))
    within = [one for one in combinations if steady_duty(printer, *one) <= STEADY_DUTY]
    beyond = [one for one in combinations if one not in within][:1]
    settings = ""
    if exported:
        files = {one.name: one.read_text() for one in exported.iterdir()}
        settings = files.pop("beadline.cfg")
        tree = trees.with_module(tree, folder, {k: v for k, v in files.items() if k.endswith(".py")})
    steps = [*CALIBRATE, ["gcode", f"M104 S{TARGET_DEGC:g}"], ["wait", 480]]
    for fan, watts in (*within, *beyond):
        steps.append(["gcode", f"M106 S{round(2.55 * fan)}"])
        speed = watts / printer.feed_J_per_mm
        steps.append(["feed", speed, PLAYED_S] if watts else ["wait", PLAYED_S])
        steps += [["gcode", "M107"], ["wait", REST_S]]
    options = {"parts": printer.parts._asdict(), "feed_J_per_mm": printer.feed_J_per_mm, "seed": printer.seed}
    out = trees.play(tree, folder, [*steps, ["status", ["beadline"]]], config=settings, **options)
    trace = np.array(out["trace"])
    last_start = np.flatnonzero(np.diff(trace[:, 0], prepend=-1e9) > 2.5)[-1]
    trace = trace[last_start:]
    t, error = trace[:, 0] - trace[0, 0], trace[:, 1] - TARGET_DEGC
    began = t > 480
    ends = 480 + len(within) * (PLAYED_S + REST_S)
    part = began & (t < ends)
    states = [state[1] for state in out["states"]]
    stopped = states.index("shutdown") - len(CALIBRATE) - 2 if "shutdown" in states else None
    log = (folder / "klippy.log").read_text()
    return {
        "dip_degC": round(float(-error[part].min()), 2) if part.any() else None,
        "rms_degC": round(float(np.sqrt((error[part] ** 2).mean())), 3) if part.any() else None,
        "above_degC": round(float(error.max()), 2),
        "combinations": len(within),
        "shut_down_within": stopped is not None and stopped < 4 * len(within),
        "shut_down_beyond": None if not beyond else stopped is not None,
        "modes": re.findall(r"beadline: extruder, mode ([a-z ]+)\. (.*)", log),
        "said": out["states"][-1][0][:160] if stopped is not None else "",
        "cpu_s": round(out["cpu_s"], 1),
    }


def _cpu_s() -> float:
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in both)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", required=True)
    parser.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()) / "klipper_owners")
    given = parser.parse_args()
    first, _, last = given.seeds.partition("-")
    both = [trees.tree("kalico"), trees.tree("klipper")]
    for seed in range(int(first), int(last or first) + 1):
        printer, folder = draw(seed), given.out / str(seed)
        if not (folder / "made.json").exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            make(both[seed % 2], folder, printer)
        found = json.loads((folder / "made.json").read_text())
        for tree in both:
            for name, exported in (("pid", None), ("ours", folder / "klipper" if found["files"] else None)):
                if name == "ours" and exported is None:
                    continue
                shutil.rmtree(folder / f"{tree.name}_{name}", ignore_errors=True)
                found[f"{tree.name}_{name}"] = printing(
                    tree, folder / f"{tree.name}_{name}", printer, exported
                )
        (folder / "found.json").write_text(json.dumps(found, indent=1))
        print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main()
