"""Records that no linear model of finite order made: simulated machines with nonlinear losses, dead times,
diffusion, quantised sensors, feedback, poor excitation.

Each function takes a generator and gives u (T, m) as a logger would have it and y (T, p); the identification
benchmark holds its rules against them.
"""

from collections.abc import Callable

import numpy as np
import scipy.signal


def levels(rng: np.random.Generator, T: int, m: int, hold: int, low: float, high: float) -> np.ndarray:
    """Random levels, each held for a random time about `hold` samples, every input on its own clock."""
    u = np.empty((T, m))
    for j in range(m):
        t = 0
        while t < T:
            stop = t + 1 + int(rng.exponential(hold))
            u[t:stop, j], t = rng.uniform(low, high), stop
    return u


def coloured(rng: np.random.Generator, T: int, m: int, pole: float) -> np.ndarray:
    return scipy.signal.lfilter([np.sqrt(1 - pole**2)], [1, -pole], rng.standard_normal((T, m)), axis=0)


def quantised(y: np.ndarray, step: float) -> np.ndarray:
    return step * np.round(y / step)


def hot_end(rng):
    """A printer's hot end, 0.5 s: PID on a thermistor of 0.1 °C, set-points every
    minute, radiation, a fan, flow as the second input."""
    T, y, u = 1700, np.empty((1700, 1)), np.empty((1700, 2))
    target, flow = levels(rng, T, 1, 120, 181, 230)[:, 0], levels(rng, T, 1, 60, 0, 12)[:, 0]
    block, tip, wire, integral, measured, last = 200.0, 198.0, np.full(4, 60.0), 60.0, 198.0, 198.0
    for t in range(T):
        measured = quantised(tip + 0.08 * rng.standard_normal(), 0.1)
        raw = 8 * (target[t] - measured) + integral - 12 * (measured - last)
        integral, last = integral + 0.15 * (target[t] - measured) * (0 <= raw <= 100), measured
        u[t], y[t] = [np.clip(raw, 0, 100), flow[t]], measured
        wire = np.r_[u[t, 0], wire[:-1]]
        loss = (
            0.0025 * (block - 25) + 1.2e-11 * ((block + 273) ** 4 - 298**4) + 0.0003 * flow[t] * (block - 25)
        )
        block += 0.5 * (0.022 * wire[-1] - loss) + 0.02 * rng.standard_normal()
        tip += 0.5 * 0.25 * (block - tip)
    return u, y


def power_station(rng):
    """Two hundred samples of five slow inputs, one of them without any effect, three outputs with drift."""
    T = 200
    u = levels(rng, T, 5, 12, -1, 1) + 0.3 * coloured(rng, T, 5, 0.7)
    A = np.array([[0.9, 0.05, 0, 0], [0, 0.8, 0.1, 0], [0, 0, 0.6, 0.1], [0.05, 0, 0, 0.95]])
    B, C = rng.standard_normal((4, 5)) * [1, 0.5, 0, 0.7, 0.3], rng.standard_normal((3, 4))
    x, y = np.zeros(4), np.empty((T, 3))
    for t in range(T):
        y[t] = C @ x
        x = A @ x + B @ np.tanh(u[t]) + 0.15 * rng.standard_normal(4)
    return u, y + 0.1 * rng.standard_normal(y.shape)


def flexible(rng, T, modes, periodic=0, pole=0.0, noise=0.02, direct=0.0):
    """Lightly damped modes (frequency in rad/sample, damping ratio,
    gain) under a coloured or periodic input."""
    u = coloured(rng, periodic or T, 1, pole)
    u = np.tile(u, (T // len(u) + 1, 1))[:T]
    y = direct * u[:, 0]
    for frequency, damping, gain in modes:
        p = np.exp(frequency * (-damping + 1j * np.sqrt(1 - damping**2)))
        y = y + gain * scipy.signal.lfilter([0, 1], [1, -2 * p.real, abs(p) ** 2], u[:, 0])
    e = noise * np.std(y) * coloured(rng, T, 1, 0.5)[:, 0]
    return u, (y + e)[:, None]


def robot_arm(rng):
    """Torque to acceleration of a flexible arm: periodic input, three modes, direct feed-through."""
    return flexible(
        rng,
        1024,
        [(0.25, 0.02, 0.3), (0.6, 0.03, -0.2), (1.3, 0.03, 0.15)],
        periodic=256,
        noise=0.05,
        direct=0.3,
    )


def flutter(rng):
    """Two close modes under a strongly coloured input."""
    return flexible(rng, 1024, [(0.35, 0.04, 1.0), (0.55, 0.03, -0.8)], pole=0.95, noise=0.05)


def disc_player_arm(rng):
    """Two inputs, two outputs in closed loop, lightly damped modes on
    a double integrator's skirt, 2,048 samples."""
    T = 2048
    modes = [np.exp(w * (-z + 1j)) for w, z in ((0.08, 0.3), (0.45, 0.02), (0.9, 0.015), (1.6, 0.02))]
    A = np.zeros((8, 8))
    for k, p in enumerate(modes):
        A[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [[p.real, p.imag], [-p.imag, p.real]]
    B, C = rng.standard_normal((8, 2)), rng.standard_normal((2, 8)) * np.repeat([1.0, 0.3, 0.2, 0.15], 2)
    r, x, u, y = coloured(rng, T, 2, 0.8), np.zeros(8), np.empty((T, 2)), np.empty((T, 2))
    e = 0.3 * coloured(rng, T, 2, 0.6)
    K = 0.02 * (C @ B).T
    for t in range(T):
        y[t] = C @ x + e[t]
        u[t] = r[t] - K @ y[t]
        x = A @ x + B @ u[t]
    return u, y


def ball_and_beam(rng):
    """A double integrator with a rolling nonlinearity, held by hand: 1,000
    samples of the beam's angle and the ball's place."""
    T, x, v, wanted = 1000, 0.0, 0.0, levels(rng, 1000, 1, 60, -0.3, 0.3)[:, 0]
    u, y, angle = np.empty((T, 1)), np.empty((T, 1)), 0.0
    for t in range(T):
        y[t] = quantised(x + 0.002 * rng.standard_normal(), 0.001)
        angle += (
            0.5 * (np.clip(1.2 * (wanted[t] - x) - 1.6 * v, -0.3, 0.3) - angle) + 0.01 * rng.standard_normal()
        )
        u[t] = angle
        v += 0.1 * (7.0 * np.sin(angle) - 0.15 * v) * 0.7
        x = np.clip(x + 0.1 * v, -0.6, 0.6)
    return u, y


def heat_exchanger(rng):
    """Liquid flow to outlet temperature: gain that falls with flow, 12
    samples of dead time, 4,000 samples."""
    T, x, y = 4000, np.array([97.0, 97.0]), np.empty((4000, 1))
    u = levels(rng, T, 1, 25, 0.1, 0.7)
    drift = 0.02 * np.cumsum(rng.standard_normal(T))
    for t in range(T):
        y[t] = quantised(x[1] + 0.05 * rng.standard_normal(), 0.02)
        steady = 90 + 6.0 / (1 + 3 * u[max(t - 12, 0), 0]) + 0.1 * drift[t]
        x[0] += 0.05 * (steady - x[0])
        x[1] += 0.15 * (x[0] - x[1])
    return u, y


def wall(rng):
    """A wall of twenty layers between two temperatures, heat flow as output, 1,680 samples, slow weather."""
    T, n = 1680, 20
    weather = np.column_stack(
        [
            10 + 8 * np.sin(np.arange(T) / 40) + 3 * coloured(rng, T, 1, 0.98)[:, 0],
            20 + levels(rng, T, 1, 60, -2, 2)[:, 0],
        ]
    )
    x, y = np.linspace(10, 20, n), np.empty((T, 1))
    for t in range(T):
        for _ in range(4):
            x = x + 0.2 * (np.r_[weather[t, 0], x[:-1]] - 2 * x + np.r_[x[1:], weather[t, 1]])
        y[t] = 2.0 * (weather[t, 1] - x[-1]) + 0.15 * coloured(rng, 1, 1, 0.0)[0, 0]
    return weather + 0.02 * rng.standard_normal(weather.shape), y


def titration(rng):
    """pH of a stirred tank, acid and base flow in, strongly nonlinear at its neck, 2,001 samples."""
    T, u, y = (
        2001,
        np.column_stack([levels(rng, 2001, 1, 60, 16.0, 18.0), levels(rng, 2001, 1, 15, 15.0, 17.0)]),
        np.empty((2001, 1)),
    )
    x = 0.0
    for t in range(T):
        x += 0.03 * ((u[t, 1] - u[t, 0]) - x)
        y[t] = 7 + 2.5 * np.arcsinh(8 * x) / np.arcsinh(8) + 0.03 * rng.standard_normal()
    return u, y


def steam_generator(rng):
    """Four inputs, four outputs, 9,600 samples: a drum whose level integrates and
    swells, its level held by a PI loop, dead times."""
    T = 9600
    u, y = np.empty((T, 4)), np.empty((T, 4))
    asked = np.column_stack([levels(rng, T, 3, 80, -1, 1) + 0.1 * coloured(rng, T, 3, 0.9)])
    pressure = oxygen = level = flow = integral = 0.0
    slow = 0.003 * np.cumsum(rng.standard_normal(T))
    for t in range(T):
        y[t] = [pressure, oxygen, level, flow]
        y[t] += [0.02, 0.1, 0.05, 0.05] * rng.standard_normal(4)
        integral -= 0.002 * y[t, 2]
        u[t] = [asked[t, 0], asked[t, 1], -0.2 * y[t, 2] + integral, asked[t, 2]]
        fuel, air, feed, demand = u[max(t - 4, 0), 0], u[max(t - 2, 0), 1], u[t, 2], u[t, 3]
        steam = demand * (1 + 0.2 * pressure)
        pressure += 0.01 * (fuel - steam - 0.5 * pressure + slow[t])
        oxygen += 0.08 * (air - 0.8 * fuel - oxygen) + 0.02 * rng.standard_normal()
        level += 0.02 * (feed - 0.6 * flow) + 0.15 * 0.05 * (demand - flow)
        flow += 0.05 * (steam - flow)
    return u, y


def relay_bed(rng):
    """A heated bed under an on-off controller: the input is a limit cycle, moved by the set-point only."""
    T, x, y, u, on = 2400, np.array([40.0, 40.0]), np.empty((2400, 1)), np.empty((2400, 1)), False
    target = levels(rng, T, 1, 300, 45, 75)[:, 0]
    for t in range(T):
        y[t] = quantised(x[1] + 0.05 * rng.standard_normal(), 0.06)
        on = y[t, 0] < target[t] - 0.4 if not on else y[t, 0] < target[t] + 0.4
        u[t] = 100.0 * on
        x = x + [
            0.02 * u[t, 0] - 0.008 * (x[0] - 22) - 0.02 * (x[0] - x[1]),
            0.03 * (x[0] - x[1]) - 0.004 * (x[1] - 22),
        ]
    return u, y


def two_heaters(rng):
    """Another two-heater board, 600 samples of steps: radiation, draughts, ambient drift, sensors of 0.3 °C,
    heaters that clip what is asked beyond 0-100."""
    T, H, S, y = 600, np.array([22.0, 22.0]), np.array([22.0, 22.0]), np.empty((600, 2))
    u = np.round(levels(rng, T, 2, 50, -25, 125))
    ambient = 22 + 0.03 * np.cumsum(rng.standard_normal(T))
    for t in range(T):
        y[t] = quantised(S + 0.1 * rng.standard_normal(2), 0.32)
        late = np.clip(u[max(t - 1, 0)], 0, 100)
        loss = 0.006 * (H - ambient[t]) + 6e-12 * ((H + 273) ** 4 - (ambient[t] + 273) ** 4)
        H = H + [0.012, 0.0075] * late - loss + 0.006 * (H[::-1] - H)
        S = S + (H - S) / 18
    return u, y


def ganged_zones(rng):
    """Three heaters of which two are switched together, but for a tenth of a per cent of rounding."""
    T, x, y = 1500, np.full(3, 60.0), np.empty((1500, 3))
    u = levels(rng, T, 2, 60, 20, 60)
    u = np.column_stack([u, quantised(0.8 * u[:, 0] + 5, 0.1)])
    for t in range(T):
        y[t] = x + 0.1 * rng.standard_normal(3)
        x = (
            x
            + 0.03 * u[t] * [1, 0.8, 1.2]
            - 0.012 * (x - 20)
            + 0.01 * (np.roll(x, 1) - x)
            + 0.01 * (np.roll(x, -1) - x)
        )
    return u, y


def unstable_reactor(rng):
    """An exothermic reactor about its unstable point, held by a PI loop
    with dead time; set-points move, 2,000 samples."""
    T, x, y, u, integral = 2000, 0.0, np.empty((2000, 1)), np.empty((2000, 1)), 0.0
    target = levels(rng, T, 1, 40, -1, 1)[:, 0]
    for t in range(T):
        y[t] = x + 0.02 * rng.standard_normal()
        e = target[t] - y[t, 0]
        integral += 0.02 * e
        u[t] = np.clip(0.9 * e + integral, -2, 2)
        x = x + 0.03 * np.sin(x) + 0.12 * u[max(t - 2, 0), 0] + 0.01 * rng.standard_normal()
    return u, y


def barrel(rng):
    """Five zones, five heaters under PI loops, set-points moved one after
    another, saturation, screw heat that nobody records."""
    T, x, y, u, integral = 3000, np.full(5, 150.0), np.empty((3000, 5)), np.empty((3000, 5)), np.full(5, 35.0)
    target, screw = levels(rng, T, 5, 400, 140, 190), 0.3 * levels(rng, T, 1, 500, 0, 1)[:, 0]
    metal = x.copy()
    for t in range(T):
        y[t] = quantised(x + 0.1 * rng.standard_normal(5), 0.1)
        raw = 3 * (target[t] - y[t]) + integral
        integral += 0.01 * (target[t] - y[t]) * ((raw > 0) & (raw < 100))
        u[t] = np.clip(raw, 0, 100)
        spread = np.r_[metal[1:], metal[-1]] + np.r_[metal[0], metal[:-1]] - 2 * metal
        metal = metal + 0.02 * u[t] - 0.005 * (metal - 25) + 0.02 * spread + screw[t] * 0.3
        x = x + 0.1 * (metal - x)
    return u, y


def staircase(rng):
    """One oven, six long steps and nothing else: heats faster than it cools."""
    T, x, y = 900, np.array([25.0, 25.0]), np.empty((900, 1))
    u = np.repeat(rng.permutation([10.0, 50.0, 30.0, 70.0, 20.0, 60.0]), 150)[:, None]
    for t in range(T):
        y[t] = quantised(x[1] + 0.1 * rng.standard_normal(), 0.25)
        steady = 25 + 1.4 * u[t, 0]
        x[0] += (0.03 if steady > x[0] else 0.018) * (steady - x[0])
        x[1] += 0.2 * (x[0] - x[1])
    return u, y


def winding(rng):
    """Tension of a web between two reels: what the drives are given acts within the sample, and a slow mode
    of the reels' radii behind it, 2,500 samples of 0.1 s."""
    T = 2500
    u = levels(rng, T, 3, 25, -1, 1) + 0.05 * rng.standard_normal((T, 3))
    x, y = np.zeros(3), np.empty((T, 2))
    for t in range(T):
        y[t, 0] = x[0] + 0.6 * u[t, 0] - 0.4 * u[t, 1] + 0.03 * rng.standard_normal()
        y[t, 1] = x[1] + 0.3 * x[2] + 0.5 * u[t, 2] + 0.03 * rng.standard_normal()
        x = np.array([0.8, 0.7, 0.985]) * x + [
            0.15 * u[t, 0] - 0.1 * u[t, 1],
            0.2 * u[t, 2],
            0.02 * (u[t, 0] - u[t, 2]) + 0.005 * rng.standard_normal(),
        ]
    return u, y


def tube_exchanger(rng):
    """Outlet temperatures of both sides of a tube exchanger: half of each inlet's step passes within a
    sample, the rest through its wall, 1,500 samples."""
    T, wall_degC, y = 1500, 50.0, np.empty((1500, 2))
    u = np.column_stack([80 + levels(rng, T, 1, 40, -8, 8)[:, 0], 20 + levels(rng, T, 1, 55, -5, 5)[:, 0]])
    for t in range(T):
        y[t] = [0.45 * u[t, 0] + 0.55 * wall_degC, 0.5 * u[t, 1] + 0.5 * wall_degC]
        y[t] += 0.1 * rng.standard_normal(2)
        wall_degC += 0.04 * (u[t, 0] - wall_degC) + 0.05 * (u[t, 1] - wall_degC)
    return u, y


def drying(rng):
    """Moisture and air temperature of a band dryer: air answers in 3 samples, the bed in 150; 867 samples."""
    T, x, y = 867, np.array([0.0, 0.0, 0.0]), np.empty((867, 3))
    u = levels(rng, T, 3, 30, -1, 1)
    for t in range(T):
        y[t] = [x[0], x[1] - 0.3 * x[0], 0.5 * x[1] + 0.2 * x[2]]
        y[t] += [0.05, 0.02, 0.03] * rng.standard_normal(3)
        x = x + [
            (u[t, 0] + 0.3 * u[t, 2] - x[0]) / 3,
            (0.8 * x[0] - u[t, 1] - x[1]) / 150 + 0.002 * rng.standard_normal(),
            (u[t, 2] - x[2]) / 40,
        ]
    return u, y


def wandering_ambient(rng):
    """A heater and its block in a room whose temperature nobody records and that wanders, 3,000 samples."""
    T, x, y = 3000, np.array([60.0, 60.0]), np.empty((3000, 1))
    u, room = levels(rng, T, 1, 60, 10, 60), 22 + 0.08 * np.cumsum(rng.standard_normal(T))
    for t in range(T):
        y[t] = x[1] + 0.05 * rng.standard_normal()
        x = x + [0.05 * u[t, 0] - 0.02 * (x[0] - room[t]) - 0.03 * (x[0] - x[1]), 0.04 * (x[0] - x[1])]
    return u, y


def _in_room(rng, *, recorded: bool):
    T, x, y = 3000, np.array([60.0, 60.0]), np.empty((3000, 2))
    u = levels(rng, T, 2, 70, 10, 60)
    room = 21 + 1.5 * coloured(rng, T, 1, 0.995)[:, 0] + np.where(np.arange(T) >= 0.7 * T, 9.0, 0.0)
    for t in range(T):
        y[t] = x + 0.05 * rng.standard_normal(2)
        x = x + [0.04, 0.03] * u[t] - 0.015 * (x - room[t]) + 0.01 * (x[::-1] - x)
    seen = room + 0.1 * rng.standard_normal(T)
    return (np.column_stack([u, seen]) if recorded else u), y


def another_day(rng):
    """Two heaters; the room's temperature is recorded as third input, and the last 30 % is a day 9 °C
    warmer."""
    return _in_room(rng, recorded=True)


def another_day_unrecorded(rng):
    """The same day, its room's temperature not recorded: only what is about the mean can be foretold."""
    return _in_room(rng, recorded=False)


RECORDS: dict[str, Callable[[np.random.Generator], tuple[np.ndarray, np.ndarray]]] = {
    f.__name__: f
    for f in (
        hot_end,
        power_station,
        robot_arm,
        flutter,
        disc_player_arm,
        ball_and_beam,
        heat_exchanger,
        wall,
        titration,
        steam_generator,
        relay_bed,
        two_heaters,
        ganged_zones,
        unstable_reactor,
        barrel,
        staircase,
        winding,
        tube_exchanger,
        drying,
        wandering_ambient,
        another_day,
        another_day_unrecorded,
    )
}
