"""The printed material, as far as the setpoint loop needs it: best temperature and flow, their allowed range,
and the flows below and above which a line counts as under- or over-extruded.

Simulators, controllers and the classifier know only the published material. Another material is converted
where flows and temperatures are read and where setpoints are sent: its limits, borders and best values
correspond to the published ones, and values in between are interpolated. So a controller step of half the
width of the good band is half that width for any material.
"""

from typing import NamedTuple

import numpy as np

from pipeline.setpoint.published import BEST_TEMPERATURE

UNDER, GOOD, OVER = range(3)


class PrintedMaterial(NamedTuple):
    """Best temperature in °C and its allowed range; the range of good flow, and the range of flow that may be
    commanded, in percent of nominal. The best flow is 100 %."""

    best_temperature_degC: float
    temperature_range_degC: tuple[float, float]
    good_flow_percent: tuple[float, float]
    flow_limits_percent: tuple[float, float]

    def label(self, flow: np.ndarray) -> np.ndarray:
        """Returns the class of a flow in percent: UNDER below the good range, GOOD within it and on both
        borders, OVER above. The class of an unknown flow (NaN) has no meaning; the caller leaves it out."""
        low, high = self.good_flow_percent
        flow = np.asarray(flow)
        return (flow >= low).astype(np.int64) + (flow > high)

    def published_flow(self, flow: np.ndarray) -> np.ndarray:
        """Returns the published material's flow in percent that corresponds to a flow of this material. The
        map is linear in log flow between limits, borders and 100 %, and shifted beyond the limits."""
        return self._flow(flow, self, PLA)

    def own_flow(self, published: np.ndarray) -> np.ndarray:
        """The inverse of published_flow."""
        return self._flow(published, PLA, self)

    def published_temperature(self, temperature: np.ndarray) -> np.ndarray:
        """Returns the published material's temperature in °C that corresponds to a temperature of this
        material. The map is linear between the ends of the range and the best temperature, and shifted beyond
        the ends."""
        return _carried(temperature, self._degrees(), PLA._degrees())

    def own_temperature(self, published: np.ndarray) -> np.ndarray:
        """The inverse of published_temperature."""
        return _carried(published, PLA._degrees(), self._degrees())

    def _flow(self, flow: np.ndarray, one: "PrintedMaterial", other: "PrintedMaterial") -> np.ndarray:
        flow = np.asarray(flow, float)
        positive = np.where(flow > 0, flow, 1.0)
        carried = np.exp(_carried(np.log(positive), np.log(one._percents()), np.log(other._percents())))
        return np.where(flow > 0, carried, flow) if one != other else flow

    def _degrees(self) -> np.ndarray:
        low, high = self.temperature_range_degC
        return np.array([low, self.best_temperature_degC, high])

    def _percents(self) -> np.ndarray:
        (low, high), (good, bad) = self.flow_limits_percent, self.good_flow_percent
        return np.array([low, good, 100.0, bad, high])

    def limits(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Returns (lowest, highest) setpoint, each as flow in percent and temperature in °C."""
        low, high = zip(self.flow_limits_percent, self.temperature_range_degC, strict=True)
        return low, high


def _carried(x: np.ndarray, knots: np.ndarray, to: np.ndarray) -> np.ndarray:
    """Maps x from knots (k,), rising, to the knots `to` (k,): linear between, shifted beyond the ends."""
    x = np.asarray(x, float)
    between = np.interp(x, knots, to)
    below, above = np.where(x < knots[0], x - knots[0], 0.0), np.where(x > knots[-1], x - knots[-1], 0.0)
    return np.where(np.isfinite(x), between + below + above, x) if (knots != to).any() else x


# the material of Li and Pattinson 2025; 20 and 310 %, 180 and 240 °C are the edges of the published figures
PLA = PrintedMaterial(BEST_TEMPERATURE, (180.0, 240.0), (90.0, 110.0), (20.0, 310.0))
