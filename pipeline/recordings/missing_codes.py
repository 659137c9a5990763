"""Finds numbers that loggers, converters and sensors write instead of a missing value."""

import numpy as np

# no machine has these values
_SENTINELS = (-9999.0, -999.0, -99999.0, 9999.0, 99999.0, -32768.0, 32767.0, 65535.0, 3276.7, -3276.8, 6553.5,
              -999.9, -9999.9, 999.9, 9999.9, 1e30, -1e30, 9.9e37)  # fmt: skip
# a machine may have these: a DS18B20 after its start (85) and without a wire (-127), converters at their
# end, thermocouples without a wire
_DOUBTFUL = (85.0, 850.0, -127.0, 127.0, 999.0, 888.8, 1370.0, 1372.0, 2000.0, 2048.0, -2048.0, 3000.0,
             4095.0, 4096.0, 8191.0, -200.0, -273.15, -50.0)  # fmt: skip
_CODES = np.array([*_SENTINELS, *_DOUBTFUL])
FEWEST = 2  # a code repeats exactly
LARGEST_SHARE = 0.5
# a signal of fewer levels is a plan, a state or a set-point, in which 85 is as good as any
FEWEST_LEVELS = 12
# a code differs from its neighbours by more than this many of the signal's largest steps
JUMP_OVER_STEPS = 3.0
# the signal itself may be near the code now and then
JUMPING_SHARE = 0.85


def missing_codes(values: np.ndarray) -> list[float]:
    """Returns the codes for missing values among the finite values (n,) of a signal, in the order in which
    they first appear.

    A sentinel such as -9999 counts if it repeats and lies outside the other values by more than their range.
    Another number counts if the signal jumps there and back, nearly each time by more than JUMP_OVER_STEPS of
    the largest steps of the other values. These must have many levels.
    """
    candidates = np.isin(values, _CODES)
    if not candidates.any():
        return []
    codes, ordinary = [], values[~candidates]
    for code in dict.fromkeys(values[candidates].tolist()):
        at = values == code
        if not FEWEST <= np.count_nonzero(at) <= LARGEST_SHARE * len(values) or len(ordinary) < FEWEST_LEVELS:
            continue
        if code in _SENTINELS:
            far = max(ordinary.min() - code, code - ordinary.max()) > np.ptp(ordinary)
        else:
            far = _jumps(values, at, ordinary)
        if far:
            codes.append(code)
    return codes


def _jumps(values: np.ndarray, at: np.ndarray, ordinary: np.ndarray) -> bool:
    """Returns whether stretches of a code begin and end with a jump that the ordinary values never make."""
    steps = np.abs(np.diff(ordinary))
    resting = np.mean(steps == 0) > 0.9
    if resting or len(np.unique(ordinary)) <= FEWEST_LEVELS:
        return False
    edges = np.flatnonzero(at[1:] != at[:-1])
    jumps = np.abs(values[edges + 1] - values[edges])
    far = jumps > JUMP_OVER_STEPS * np.quantile(steps, 0.999)
    return len(jumps) >= 2 * FEWEST - 1 and bool(np.mean(far) >= JUMPING_SHARE)
