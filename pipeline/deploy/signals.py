"""The machine that a controller is wired to: its signals, their units and limits, and its sample time."""

from typing import NamedTuple

PERCENT, DEGC = "percent", "degC"


class Signal(NamedTuple):
    """An input with the limits of its command, or an output with its declared limits, -inf and inf where
    none is."""

    name: str
    unit: str
    low: float
    high: float


class Machine(NamedTuple):
    """What a controller is wired to: its signals in order, the time between two samples, and the measured
    disturbances that it is told."""

    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    sample_time_s: float
    disturbances: tuple[Signal, ...] = ()
