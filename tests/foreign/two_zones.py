"""A machine of two heated zones in plain numpy, with the proportional loop of its operator. It shares no code
with pipeline/temperature: zones lose heat through a common frame that stores heat too, and each sensor lags.
"""

from pathlib import Path

import numpy as np

STEP_S, SAMPLES = 0.1, 600
REFERENCES_DEGC = np.array([120.0, 110.0])
# of the zones: seconds, °C a percent of power; of the frame: seconds; of the sensors: seconds
ZONE_S, GAIN_DEGC = np.array([60.0, 90.0]), np.array([1.6, 1.2])
FRAME_S, SENSOR_S = 300.0, 1.5


def record_shift(
    rng: np.random.Generator,
    *,
    samples: int = SAMPLES,
    gain: tuple[float, float] = (1.0, 1.0),
    air_degC: float = 20.0,
    dither_percent: float = 8.0,
    noise_degC: float = 0.1,
) -> dict[str, np.ndarray]:
    """Columns of a shift at 1 Hz: the operator's loop holds the references, its command is dithered every
    20 to 40 s. `gain`: each heater's, as a share of what it is."""
    power = GAIN_DEGC * gain
    # the zones begin at rest, with the frame halfway between them and the air
    zone = REFERENCES_DEGC.copy()
    frame = 0.5 * (zone.mean() + air_degC)
    sensor = zone.copy()
    rest = np.clip(((zone - air_degC) + 0.2 * (zone - frame)) / GAIN_DEGC, 0, 100)
    dither, until = np.zeros(2), np.zeros(2)
    columns: dict[str, list[float]] = {
        name: [] for name in ("time_s", "heater_1_pct", "heater_2_pct", "zone_1_C", "zone_2_C")
    }
    for t in range(samples):
        for k in np.flatnonzero(until <= t):
            dither[k] = dither_percent * rng.choice((-1.0, 1.0))
            until[k] = t + rng.integers(20, 41)
        read = sensor + noise_degC * rng.standard_normal(2)
        heater = np.clip(rest + dither + 0.5 * (REFERENCES_DEGC - read), 0, 100)
        for name, value in zip(columns, (float(t), *heater, *read), strict=True):
            columns[name].append(value)
        for _ in range(round(1.0 / STEP_S)):
            flow = power * heater - (zone - air_degC) - 0.2 * (zone - frame)
            frame += STEP_S / FRAME_S * ((zone - frame).sum() - (frame - air_degC))
            zone = zone + STEP_S * flow / ZONE_S
            sensor = sensor + STEP_S * (zone - sensor) / SENSOR_S
    return {name: np.array(values) for name, values in columns.items()}


def freeze(columns: dict[str, np.ndarray], name: str, after: float) -> dict[str, np.ndarray]:
    """The same with a sensor that repeats its last reading once this share of the shift is over."""
    at = int(after * len(columns[name]))
    frozen = columns[name].copy()
    frozen[at:] = frozen[at]
    return columns | {name: frozen}


def write_csv(path: Path, columns: dict[str, np.ndarray]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    table = np.column_stack(list(columns.values()))
    np.savetxt(path, table, fmt="%.4f", delimiter=",", header=",".join(columns), comments="")
    return path
