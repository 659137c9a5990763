"""The readers of the smaller formats, by the name that `file_format` gives."""

from collections.abc import Callable
from pathlib import Path

from pipeline.recordings.formats import WholeTable
from pipeline.recordings.klipper_logs import load_klippy
from pipeline.recordings.matlab_files import load_matlab
from pipeline.recordings.printer_logs import load_moonraker, load_serial_log
from pipeline.recordings.spreadsheets import load_spreadsheet

LOADERS: dict[str, Callable[[Path], WholeTable]] = {
    "klippy.log": load_klippy,
    "serial.log": load_serial_log,
    "Moonraker JSON": load_moonraker,
    "xlsx": load_spreadsheet,
    "MATLAB": load_matlab,
}
