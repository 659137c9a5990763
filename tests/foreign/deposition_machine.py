"""A deposition machine of another maker: its gantry, extruder and camera, and its recorder with topics, units
and a clock of its own. It is told what an owner is told: a command as CSV, the routine of params.yaml, and
the metadata record to copy."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from mcap.reader import make_reader

from tests.foreign.bead_camera import BeadCamera
from tests.foreign.syringe import PneumaticSyringe
from tests.mcap_writing import NO, Written, cdr

RECORD = "beadline.trial"
# the calendar's clock of the recorder, and how long before the routine it begins
EPOCH_S, EARLY_S = 1_750_000_000.37, 0.6
SIGNALS_HZ = 100
IMAGE = """std_msgs/Header header
string format
uint8[] data
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
# params.yaml: camera.topics, for this recorder
TOPICS = {
    "image": "/head/camera",
    "time": "",
    "mapping": {
        "position_mm": {"source": "/axes:x_m", "unit": "mm", "scale": 1000.0, "offset": 0.0},
        "speed_mm_per_s": {"source": "/axes:v_m_per_s", "unit": "mm/s", "scale": 1000.0, "offset": 0.0},
        "command_mm": {"source": "/regulator:set_um", "unit": "mm", "scale": 0.001, "offset": 0.0},
    },
}


class Printed(NamedTuple):
    """One print: clock time_s (T,), planned and true flow (T,) in mm^3/s."""

    time_s: np.ndarray
    planned: np.ndarray
    true: np.ndarray

    @property
    def error(self) -> float:
        """R.m.s. of true less planned flow, mm^3/s."""
        return float(np.sqrt(np.mean((self.true - self.planned) ** 2)))


class DepositionMachine(NamedTuple):
    """Extruder and camera on a gantry. It plays off_s, on_s, pause_s, on_s and tail_s at one speed."""

    extruder: PneumaticSyringe
    camera: BeadCamera
    bead_area_mm2: float
    ramp_s: float
    frames_hz: float = 20.0

    def print(self, routine: Mapping[str, float], time_s: np.ndarray, u: np.ndarray) -> Printed:
        """The command u (T,) at time_s (T,) played on a routine of params.yaml."""
        start, halt, go, stop = _events(routine)
        speed = routine["speed_mm_per_s"]
        on = [self._ramp(time_s - event) for event in (start, halt, go, stop)]
        planned = self.bead_area_mm2 * speed * (on[0] - on[1] + on[2] - on[3])
        return Printed(time_s, planned, self.extruder.flow(time_s, u))

    def record(
        self, path: Path, command: Path, routine: Mapping[str, float], rng: np.random.Generator
    ) -> Printed:
        """Plays command.csv and writes its recording, with the metadata record of command.mcap, to path."""
        time_s, u = np.loadtxt(command.with_suffix(".csv"), delimiter=",", skiprows=1).T
        printed = self.print(routine, time_s, u)
        speed, x = self._gantry(routine, time_s)
        made = Written(NO)
        with command.with_suffix(".mcap").open("rb") as stream:
            for record in make_reader(stream).iter_metadata():
                if record.name == RECORD:
                    made.writer.add_metadata(RECORD, dict(record.metadata))
        axes, regulator = made.topic("/axes", "json"), made.topic("/regulator", "json")
        image = made.topic(
            TOPICS["image"], "cdr", "sensor_msgs/msg/CompressedImage", "ros2msg", IMAGE.encode()
        )
        start = EPOCH_S + EARLY_S - time_s[0]
        messages = []
        for t in np.arange(time_s[0] - EARLY_S, time_s[-1] + 0.2, 1 / SIGNALS_HZ):
            place, pace = np.interp(t, time_s, x) / 1000, np.interp(t, time_s, speed) / 1000
            held = (
                float(u[min(int(np.searchsorted(time_s, t + 1e-9)), len(u)) - 1]) if t >= time_s[0] else 0.0
            )
            messages.append((t, axes, {"x_m": place, "v_m_per_s": pace}))
            messages.append((t, regulator, {"set_um": 1000 * held}))
        for t, picture in self.camera.frames(time_s, printed.true, x, hz=self.frames_hz, rng=rng):
            messages.append((t, image, _compressed(start + t, picture)))
        for t, channel, data in sorted(messages, key=lambda message: message[0]):
            made.message(channel, start + t, data)
        path.write_bytes(made.bytes())
        return printed

    def _gantry(self, routine: Mapping[str, float], time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Speed in mm/s and position in mm (T,): it runs from the beginning, and rests in the pause."""
        _, halt, go, _ = _events(routine)
        speed = routine["speed_mm_per_s"] * (1 - self._ramp(time_s - halt) + self._ramp(time_s - go))
        step = np.diff(time_s, prepend=time_s[0])
        return speed, np.cumsum((speed + np.roll(speed, 1)) / 2 * step)

    def _ramp(self, t: np.ndarray) -> np.ndarray:
        """A step at 0 averaged twice over ramp_s, as params.yaml says of the wanted flow."""
        fine = np.linspace(-0.5, 0.5, 41) * self.ramp_s
        once = [np.clip((t - shift) / self.ramp_s + 0.5, 0, 1) for shift in fine]
        return np.trapezoid(once, fine, axis=0) / self.ramp_s


def _events(routine: Mapping[str, float]) -> np.ndarray:
    """When the line starts, halts, goes on and stops, s."""
    return np.cumsum([routine[key] for key in ("off_s", "on_s", "pause_s", "on_s")])


def _compressed(stamp_s: float, picture: np.ndarray) -> bytes:
    """sensor_msgs/CompressedImage in CDR."""
    data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
    seconds, rest = divmod(round(stamp_s * 1e9), 10**9)
    head = cdr(("i", [seconds]), ("I", [rest]), ("s", "head"), ("s", "jpeg"), ("I", [len(data)]))
    return head + data
