"""What the smaller formats begin with: logs of printers, spreadsheets, MATLAB files, bags."""

import re
import zipfile
from pathlib import Path

# the configuration that a klippy.log begins with after a rollover has some 30 kB
OPENING_BYTES = 1 << 17
METADATA = "metadata.yaml"
_KLIPPY = (b"Starting Klippy", b"Start printer at", b"===== Config file =====", b"== Log rollover at")
_STATS = re.compile(rb"^(INFO:root:)?Stats \d+\.\d+: .*=", re.MULTILINE)
# OctoPrint's serial.log, with a firmware's temperature report among its first lines
_REPORT = re.compile(rb"^.*\bRecv:.*[\s:]T\d?:\s*-?\d", re.MULTILINE)
_SERIAL = re.compile(rb"^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} - (Recv|Send|Changing|Connect)", re.MULTILINE)


def is_bag(path: Path) -> bool:
    """Whether a folder is a ROS 2 bag."""
    return path.is_dir() and (path / METADATA).is_file()


def other_format(path: Path, start: bytes) -> str:
    """ "xlsx", "MATLAB", "Moonraker JSON", "klippy.log" or "serial.log", by the first 512 bytes and, of a
    text, what follows; "" for anything else."""
    if start.startswith(b"PK\x03\x04"):
        return "xlsx" if _is_workbook(path) else ""
    if start.startswith(b"MATLAB 5.0"):
        return "MATLAB"
    if b"\0" in start:
        return ""
    with path.open("rb") as stream:
        opening = stream.read(OPENING_BYTES)
    if opening.lstrip()[:1] == b"{":
        return "Moonraker JSON" if b'"temperatures"' in opening else ""
    if any(mark in opening for mark in _KLIPPY) or _STATS.search(opening):
        return "klippy.log"
    return "serial.log" if _REPORT.search(opening) or _SERIAL.match(opening) else ""


def _is_workbook(path: Path) -> bool:
    """Whether a zip file is a workbook; of a damaged one the name tells."""
    try:
        with zipfile.ZipFile(path) as archive:
            return "xl/workbook.xml" in archive.namelist()
    except (zipfile.BadZipFile, OSError, NotImplementedError, ValueError):
        return path.suffix.casefold() in (".xlsx", ".xlsm")
