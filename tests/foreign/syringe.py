"""A pneumatic syringe with a paste that has a yield stress, integrated in steps of 1 ms."""

from typing import NamedTuple

import numpy as np

STEP_S = 0.001


class PneumaticSyringe(NamedTuple):
    """The regulator's set-point u (in mm, as its knob is scaled) -> flow q in mm^3/s.

    p' = (u(t - valve_s) - p) / (fill_s if it rises, vent_s if it falls)     the air above the paste
    c' = (p - c) / paste_s                                                   the paste itself is compressed
    q  = gain level ((c - yield_mm) / level)^exponent above the yield, else 0
    """

    gain: float = 1.0
    level: float = 2.4
    valve_s: float = 0.06
    fill_s: float = 0.85
    vent_s: float = 0.70
    paste_s: float = 0.05
    yield_mm: float = 0.12
    exponent: float = 1.1

    def flow(self, time_s: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Flow (T,) at time_s (T,), evenly spaced, under the set-point u (T,) held between samples, from
        rest."""
        fine = np.arange(time_s[0], time_s[-1] + STEP_S / 2, STEP_S)
        at = np.searchsorted(time_s, fine - self.valve_s + 1e-9, side="right") - 1
        held = np.where(at < 0, 0.0, np.asarray(u, float)[np.maximum(at, 0)])
        air = paste = 0.0
        pressed = np.empty(len(fine))
        for k, value in enumerate(held.tolist()):
            air += STEP_S * (value - air) / (self.fill_s if value > air else self.vent_s)
            paste += STEP_S * (air - paste) / self.paste_s
            pressed[k] = paste
        over = np.maximum(pressed - self.yield_mm, 0.0)
        return np.interp(time_s, fine, self.gain * self.level * (over / self.level) ** self.exponent)
