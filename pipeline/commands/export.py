"""`beadline export`: a certified controller in the form that a machine can run, or what sees and decides in
the setpoint loop. The stage export_controllers writes the same files."""

import re
from pathlib import Path

from pipeline.deploy import certificate, machine, to_c, to_klipper, to_python, to_setpoint, vectors
from pipeline.deploy.certificate import Certificate
from pipeline.deploy.supervise import Exported
from pipeline.store import artifacts

SIMULATED = "Pass (simulation): it was made for a simulated plant, and runs only if `rehearsal` is set."
UNCERTIFIED = (
    "It has no certificate: evaluate_setpoint judged it with the camera's watch, held windows, waits and "
    "limits, which are not in these files."
)
TRIAL = "May run: its certificate was passed on recordings of the machine."

# where the files of each form go, and how to go back
PLACING = {
    "c": """Copy this there
    cp controller.c controller.h machine.h tables.h FIRMWARE/
    Call it as above, and keep the firmware's own control beside it.

Go back
    Call the firmware's own control again, then
    rm FIRMWARE/controller.c FIRMWARE/controller.h FIRMWARE/machine.h FIRMWARE/tables.h
""",
    "python": """Copy this there
    cp controller.py PROGRAM/
    Call controller(...) of that file. It needs numpy.

Go back
    Let your own control run again, then
    rm PROGRAM/controller.py
""",
    "klipper": """Nothing that you have is replaced: your PID, max_power and max_temp stay in printer.cfg.

Copy this there
    cp beadline.py beadline_controller.py KLIPPER/klippy/extras/
    cp beadline.cfg CONFIG/
    sed -i '1i [include beadline.cfg]' CONFIG/printer.cfg
    Restart Klipper: sudo systemctl restart klipper
    beadline.cfg names the heater that it controls, extruder or heater_bed: correct that line if it is wrong.

Go back
    sed -i '/^\\[include beadline.cfg\\]$/d' CONFIG/printer.cfg
    rm CONFIG/beadline.cfg KLIPPER/klippy/extras/beadline.py KLIPPER/klippy/extras/beadline_controller.py
    Restart Klipper: sudo systemctl restart klipper

KLIPPER is the folder of Klipper (often ~/klipper), CONFIG that of printer.cfg (often ~/printer_data/config).
""",
}


def files(made: Exported, shown: Certificate, to: str) -> dict[str, str]:
    """The files of one form, name to text. Raises ValueError, naming what is missing, if the machine or
    the certificate does not allow it."""
    if to == "c":
        texts = to_c.files(made, shown, vectors.golden(made))
        return texts | {"README.txt": f"{texts['README.txt']}\n{PLACING[to]}"}
    if to == "python":
        return {"controller.py": to_python.text(made, shown), "README.txt": PLACING[to]}
    section_text = to_klipper.settings(made, shown, section=klipper_section(made))
    return {to_klipper.FILE: section_text, **to_klipper.module(made, shown), "README.txt": PLACING[to]}


def klipper_section(made: Exported) -> str:
    """The heater's section of printer.cfg: that of the bed if a signal is called after the bed, as `init`
    names them (heater_bed.pwm), else that of the extruder."""
    names = (one.name.casefold() for one in (*made.machine.inputs, *made.machine.outputs))
    extruder, bed = to_klipper.SECTIONS
    return bed if any("bed" in re.split(r"[^a-z]+", name) for name in names) else extruder


def export(folder: Path, to: str, out: Path | None) -> str:
    """Writes the files of one form, and says which and of what."""
    target = folder / to if out is None else out
    if target.exists() and not target.is_dir():
        raise ValueError(
            f"--out {target}: should be a folder but is a file; name a folder, which is made if it is missing"
        )
    if shows_frames(folder):
        return _export_readers(folder, to, target)
    made, shown = machine.read(folder)
    texts = files(made, shown, to)
    with artifacts.together(target) as place:
        for name, text in texts.items():
            artifacts.write_text(place / name, text)
    written = ", ".join(str(target / name) for name in sorted(texts))
    word = SIMULATED if made.simulated else TRIAL
    digest = certificate.sha256(shown)
    return f"{made.name}, certificate {digest[:12]}. {word}\nwritten: {written}"


def shows_frames(folder: Path) -> bool:
    """Whether a controller's folder is that of the setpoint loop, whose recordings are frames."""
    return (folder / next(iter(to_setpoint.FILES))).exists() and not (folder / machine.CONTROLLER).exists()


def _export_readers(folder: Path, to: str, target: Path) -> str:
    """Writes classifier and filter with their readers in Python."""
    if to != "python":
        raise ValueError(
            f"{folder}: classifier and filter of the setpoint loop run in Python alone, found --to "
            f"{to}; write --to python"
        )
    files = to_setpoint.FILES
    made = {name: artifacts.read_weights(folder / name, schema)[0] for name, (schema, _) in files.items()}
    with artifacts.together(target) as place:
        to_setpoint.write(place, made)
    written = ", ".join(str(path) for path in sorted(target.iterdir()) if path.is_file())
    return f"{', '.join(name.partition('.')[0] for name in files)}. {UNCERTIFIED}\nwritten: {written}"
