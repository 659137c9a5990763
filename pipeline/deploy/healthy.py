"""A controller with its supervisor on healthy machines of the test set: as long as the supervisor finds no
fault there, what runs is the law, and the law's figures are those of what runs."""

from typing import Any

import numpy as np

from pipeline.deploy.supervise import Exported, Supervised
from pipeline.temperature.test_set import panel

KINDS = ("sequence", "disturbed")  # set-point changes, and a door, a fan and another room
PLANTS = 5  # one of each structure


def play(exported: Exported, cases: panel.Cases) -> dict[str, Any]:
    """How many of `cases` there are, in how many the law was left, the share of their samples that it was
    left for, in percent, and the first reason of the first of them with its plant. A sample at a time."""
    cases = panel.some(cases, KINDS, PLANTS)
    made = exported.controller.forward
    running = [Supervised(exported, rehearsal=True) for _ in cases.plant]
    at_rest = panel.rests(exported.model, cases, exported.controller.limits)
    r, target, _ = panel.schedule(cases, panel.aims(exported.controller.law, at_rest, cases))
    held = panel.held_readings(cases)
    told = cases.told + (0.0 if made is None else made.mean)
    for measured in held[:-1]:
        for k, one in enumerate(running):
            one.watch(cases.u0[k], measured[k], r[0, k])
    for k, one in enumerate(running):
        one.hand_over(held[-1, k])
    left, first = np.zeros(len(running), int), [""] * len(running)

    def drive(t: int, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u = np.empty_like(cases.u0)
        for k, one in enumerate(running):
            one.tell(told[t, k])
            decision = one.step(measured[k], r[t, k], t * exported.machine.sample_time_s)
            u[k] = decision.u
            if decision.mode != "law":
                left[k] += 1
                first[k] = first[k] or decision.causes[0].sentence
        return u, u

    panel.simulated(cases, drive, r, target)
    at = int(np.argmax(left > 0))
    return {
        "cases": len(left),
        "left": int((left > 0).sum()),
        "percent": 100.0 * float(left.mean()) / cases.steps,
        "why": first[at],
        "plant": int(cases.plant[at]) if left.any() else None,
    }
