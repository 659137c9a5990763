"""The readers of the smaller formats, by the name that `file_format` gives."""

from collections.abc import Callable
from pathlib import Path

from pipeline.reading.klipper_logs import load_klippy
from pipeline.reading.matlab_files import load_matlab
from pipeline.reading.printer_logs import load_moonraker, load_serial_log
from pipeline.reading.spreadsheets import load_spreadsheet
from pipeline.reading.whole_tables import WholeTable

LOADERS: dict[str, Callable[[Path], WholeTable]] = {
    "klippy.log": load_klippy,
    "serial.log": load_serial_log,
    "Moonraker JSON": load_moonraker,
    "xlsx": load_spreadsheet,
    "MATLAB": load_matlab,
}
