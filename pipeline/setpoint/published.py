"""Values of Li and Pattinson 2025: the target, the shaping of the reward, the moves and the simulator. They
are plain numbers, so that a page can use them without a simulator."""

import math

BEST_FLOW, BEST_TEMPERATURE = 100.0, 210.0  # q* in percent of nominal, u* in °C
ROTATION = math.pi * 70 / 180  # theta of table 2
PHASES = (
    (40.0, 20.0),
    (40.0, 10.0),
    (20.0, 10.0),
)  # semi-axes (a, b) of the three phases of shaping; the fourth keeps the last

FLOW_MOVES, TEMPERATURE_MOVES = (
    (-10.0, -5.0, 0.0, 5.0, 10.0),
    (-20.0, -10.0, 0.0, 10.0, 20.0),
)  # (5), percent and °C
LAMBDA = 10  # flow actions to one temperature action (table 2)
# our guesses: the paper prints no values
DELTA = 5.0  # of (6), in steps
ALPHA, SIGMA = 1.5, 0.15  # of (7)
