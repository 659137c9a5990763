"""Settings for printers that run Klipper or Kalico, and the module with which the controller runs a heater.
The owner's own PID, limits and max_temp are not changed."""

from pathlib import Path

from pipeline.deploy import to_python
from pipeline.deploy.certificate import Certificate, sha256
from pipeline.deploy.machine import check, check_certificate
from pipeline.deploy.supervise import PERCENT, Exported, Signal

FILE = "beadline.cfg"  # never printer.cfg: that one is the owner's
MODULE = Path(__file__).parent / "templates" / "beadline.py.txt"  # for klippy/extras/
SECTIONS = ("extruder", "heater_bed")


def settings(exported: Exported, certificate: Certificate, *, section: str) -> str:
    """Returns the text of FILE, which printer.cfg includes: the section of the module.

    Raises ValueError for a machine with more than one heater or sensor, for an unknown section, and if the
    certificate was not passed, or belongs to another controller.
    """
    check(exported)
    check_certificate(exported, certificate)
    one_heater(exported)
    if section not in SECTIONS:
        raise ValueError(
            f"section {section}: expected one of {', '.join(SECTIONS)}, the heaters that both firmwares "
            "control; name one of them"
        )
    heater, sensor = exported.machine.inputs[0], exported.machine.outputs[0]
    lines = [
        f"# {heater.name} and {sensor.name}: controller {exported.name} in place of the PID of [{section}],",
        "# which stays in printer.cfg and goes on if this one fails",
        f"# certificate {sha256(certificate)}",
        "[beadline]",
        f"heater: {section}",
        f"plant: {exported.plant_sha256}",
        *(_disturbance_line(one, section) for one in exported.machine.disturbances),
        *(["# rehearsal: True  # the plant was simulated: never on a printer"] if exported.simulated else []),
    ]
    return "\n".join(lines) + "\n"


def _disturbance_line(signal: Signal, section: str) -> str:
    """Returns the line with the source of a disturbance, chosen by its unit. An owner may change it to
    another fan or extruder, or none."""
    sources = {PERCENT: "fan", "mm/s": section if section == "extruder" else "none"}
    return f"disturbance_{signal.name}: {sources.get(signal.unit, 'none')}  # in {signal.unit}"


def module(exported: Exported, certificate: Certificate) -> dict[str, str]:
    """Returns the two files for klippy/extras/ with which the controller itself runs the heater. Raises
    ValueError as `settings` does."""
    one_heater(exported)
    return {
        MODULE.stem: MODULE.read_text(encoding="utf-8"),
        "beadline_controller.py": to_python.text(exported, certificate),
    }


def one_heater(exported: Exported) -> None:
    """Raises ValueError for a machine that Klipper's control of one heater cannot run."""
    inputs, outputs = ([one.name for one in side] for side in exported.machine[:2])
    if (len(inputs), len(outputs)) != (1, 1):
        raise ValueError(
            f"controller {exported.name}: Klipper and Kalico control one heater by one sensor, but this "
            f"machine has inputs {', '.join(inputs)} and outputs {', '.join(outputs)}; export it to c or "
            "python"
        )
    heater = exported.machine.inputs[0]
    if heater.low != 0 or heater.high > 100:
        raise ValueError(
            f"input {heater.name}: Klipper's duty goes from 0 to max_power, at most 100 percent, but the "
            f"machine declares {heater.low:g} to {heater.high:g} percent; declare the heater's own limits"
        )
