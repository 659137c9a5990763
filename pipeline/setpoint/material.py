"""What is printed, as far as the setpoint loop must know it: where its temperature and flow belong, how far
they may go, and from where a line is called under- or over-extruded.

Plain numbers, handed on as an argument: a page or a worker can name them without a simulator.
"""

from typing import NamedTuple

import numpy as np

UNDER, GOOD, OVER = range(3)


class Material(NamedTuple):
    """Best temperature in °C and the range that may be commanded; the flow that is good, and the flow that
    may be commanded, in percent of nominal. The best flow is 100 %."""

    best_temperature_degC: float
    temperature_range_degC: tuple[float, float]
    good_flow_percent: tuple[float, float]
    flow_limits_percent: tuple[float, float]

    def label(self, flow: np.ndarray) -> np.ndarray:
        """Class of a flow in percent: UNDER below the good ones, GOOD with both borders, OVER above; a flow
        that is not known (NaN) has none, and is for the caller to leave out."""
        low, high = self.good_flow_percent
        flow = np.asarray(flow)
        return (flow >= low).astype(np.int64) + (flow > high)

    def limits(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """(lowest, highest) setpoint, each flow in percent and temperature in °C."""
        low, high = zip(self.flow_limits_percent, self.temperature_range_degC, strict=True)
        return low, high


# as Li and Pattinson 2025 printed it; 20 and 310 %, 180 and 240 °C are the edges of the published figures
PLA = Material(210.0, (180.0, 240.0), (90.0, 110.0), (20.0, 310.0))
