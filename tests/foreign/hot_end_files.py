"""A recording of the foreign hot end in each format that the product reads, without a line of its readers."""

import io
from collections.abc import Callable

import numpy as np
import pandas
import pyarrow as pa
import pyarrow.parquet as pq
import scipy.io

from tests.foreign.hot_end import Record
from tests.mcap_writing import Written, cdr
from tests.recordings.klipper_machine import EXTRUDER, config_lines
from tests.recordings.test_spreadsheets import sheet, workbook

NAMES = ("time_s", "heater_pct", "hotend_C")
STATE = "float64 heater_pct\nfloat64 hotend_C\n"


def columns(record: Record) -> dict[str, np.ndarray]:
    return dict(zip(NAMES, (record.time_s, record.duty_percent, record.temperature_degC), strict=True))


def write_parquet(record: Record) -> bytes:
    stream = io.BytesIO()
    pq.write_table(pa.table(columns(record)), stream)
    return stream.getvalue()


def write_mcap(record: Record) -> bytes:
    """ROS 2: CDR messages of a type whose definition stands in the file."""
    made = Written()
    topic = made.topic("/hot_end", "cdr", "machine/msg/State", "ros2msg", STATE.encode())
    for time_s, duty, degC in zip(*columns(record).values(), strict=True):
        made.message(topic, 1_700_000_000.0 + time_s, cdr(("d", [duty, degC])))
    return made.bytes()


def write_klippy_log(record: Record) -> bytes:
    """Stats lines have a tenth of a second, a tenth of a degree and a thousandth of the duty."""
    lines = ["Starting Klippy...", "Start printer at Sat Jul 12 10:00:00 2025 (1752314400.0 100.0)"]
    lines += config_lines([EXTRUDER])
    for (time_s, duty, degC), target in zip(
        zip(*columns(record).values(), strict=True), record.target_degC, strict=True
    ):
        lines.append(
            f"Stats {100 + time_s:.1f}: gcodein=0 mcu: mcu_awake=0.014 mcu_task_avg=0.000022 "
            f"bytes_write={900 + int(time_s)} send_seq=1 freq=180003476 sysload=1.40 "
            f"print_time={93 + time_s:.3f} buffer_time=2.417 print_stall=0 "
            f"extruder: target={target:.0f} temp={degC:.1f} pwm={duty / 100:.3f}"
        )
    return ("\n".join(lines) + "\n").encode()


def write_xlsx(record: Record) -> bytes:
    rows = zip(*(column.tolist() for column in columns(record).values()), strict=True)
    return workbook(sheet([NAMES, *rows]))


def write_mat(record: Record) -> bytes:
    stream = io.BytesIO()
    scipy.io.savemat(stream, columns(record))
    return stream.getvalue()


def write_csv(record: Record) -> bytes:
    return pandas.DataFrame(columns(record)).to_csv(index=False).encode()


FORMATS: dict[str, Callable[[Record], bytes]] = {
    "log.csv": write_csv,
    "log.parquet": write_parquet,
    "log.mcap": write_mcap,
    "klippy.log": write_klippy_log,
    "log.xlsx": write_xlsx,
    "log.mat": write_mat,
}
