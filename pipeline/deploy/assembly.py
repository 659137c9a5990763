"""Assembles a controller of the comparison for export, with its safe mode, its supervisor and its machine,
and plays it on healthy machines of the test set. As long as the supervisor finds no fault there, the exported
controller behaves exactly as the law, so the law's figures apply to it."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy.linalg

from pipeline.deploy.machine import canonical, plants_sha256
from pipeline.deploy.supervise import (
    DOOR_S,
    MISSING_FOR,
    SPACING,
    WINDOWS,
    Exported,
    Machine,
    Supervised,
    Supervision,
)
from pipeline.temperature.controllers.law import Plant
from pipeline.temperature.controllers.problem import Design
from pipeline.temperature.plant import markov_parameters, strictly_proper
from pipeline.temperature.test_set import panel
from pipeline.temperature.test_set.panel import CaseConditions, deploy
from pipeline.temperature.test_set.scorecard import closed_loop
from pipeline.temperature.tracking import reached_state, riccati

LEAK = 0.9999  # of the drift, kept a step
RESTLESS = 1e8  # condition of I - A above which a plant has no rest of its own
WEAK_SHARE = 1e-3  # of the largest effect of inputs; with less they do not count as holding a temperature
HURRIED = 0.1  # fraction of an innovation by which the drift follows in manual
# control that takes over in the safe mode: the machine's own, or a PI in its place
OWN_CONTROL = ("printer_pid", "pi", "pi_simc")


def own_control(designs: Mapping[str, Design]) -> Design | None:
    """Returns the first of OWN_CONTROL that keeps its model stable. If there is none, the heaters go off in
    the safe mode."""
    for name in OWN_CONTROL:
        if name in designs:
            loop = closed_loop(designs[name].model, designs[name].law)
            if np.abs(np.linalg.eigvals(loop)).max() < 1:
                return designs[name]
    return None


def assemble(
    name: str,
    design: Design,
    fallback: Design | None,
    machine: Machine,
    setting: CaseConditions,
    family: Sequence[Plant],
    *,
    simulated: bool,
) -> Exported:
    """Returns the controller as it was judged. `fallback`: the safe mode "own"; None: the heaters go off.
    `family`: the identified plant, then its spread."""
    return canonical(
        Exported(
            name,
            machine,
            deploy(design, setting),
            design.model,
            deploy(fallback, setting) if fallback else None,
            supervision(design.model, machine, setting.rehearsal.noise),
            simulated,
            plants_sha256(family[:1]),
            plants_sha256(family[1:]),
        )
    )


def supervision(
    model: Plant, machine: Machine, noise_degC: np.ndarray, *, drift: float = 0.05, follows: float = 0.3
) -> Supervision:
    """Returns the supervisor's parameters. Its observer solves the stationary Riccati equation: each step,
    outputs are disturbed by `follows` times the sensors' noise (p,), along the states that inputs reach, and
    the drift by `drift` times the noise. Raises ValueError if the noise is no number above zero."""
    noise = np.broadcast_to(np.asarray(noise_degC, float), (model.p,)).copy()
    if not (np.isfinite(noise).all() and (noise > 0).all()):
        raise ValueError(
            f"supervision: expected the sensors' noise in degC above zero, found {noise}; estimate it from "
            "a hold of the record"
        )
    plant = strictly_proper(model)
    n, m, p = plant.n, plant.m, plant.p
    likely, sensors = reached_state(plant), np.diag(np.maximum(noise, 1e-3) ** 2)
    A = np.block([[plant.A, likely], [np.zeros((p, n)), LEAK * np.eye(p)]])
    C = np.hstack([plant.C, np.zeros((p, p))])
    moved = likely * follows * noise
    P = riccati(A.T, C.T, scipy.linalg.block_diag(moved @ moved.T, np.diag((drift * noise) ** 2)), sensors)
    M = P @ C.T @ np.linalg.inv(C @ P @ C.T + sensors)
    held, rest = held_state(plant, likely)
    pulses = np.abs(markov_parameters(plant, 60)).max(axis=0)
    shares = pulses / np.maximum(pulses.max(axis=1, keepdims=True), 1e-300)
    of_input = (shares + 1e-6 * pulses / max(pulses.max(), 1e-300)).argmax(axis=0)
    others = np.setdiff1d(np.arange(p), of_input)
    span = np.array([one.high - one.low for one in machine.inputs])
    drifts = markov_parameters(plant._replace(B=likely), 60).sum(axis=0)
    lost = np.linalg.pinv(markov_parameters(plant, 60).sum(axis=0)) @ drifts
    unsure, spread = np.empty((WINDOWS * SPACING + 1, p)), P - M @ C @ P
    for age in range(len(unsure)):
        unsure[age] = np.sqrt(np.maximum(np.diag(C @ spread @ C.T), 0.0))
        spread = A @ spread @ A.T
    return Supervision(
        A=A,
        B=np.vstack([plant.B, np.zeros((p, m))]),
        C=C,
        b=np.r_[plant.b, np.zeros(p)],
        d=plant.d,
        L=A @ M,
        M=M,
        hurried=np.vstack([np.zeros((n, p)), HURRIED * np.eye(p) - (A @ M)[n:]]),
        unsure=unsure,
        wander=np.cumsum((2 * unsure) ** 2, axis=0),
        start=np.vstack([held, np.zeros((p, p))]),
        start_0=np.r_[rest, np.zeros(p)],
        low=np.array([one.low for one in machine.inputs]),
        high=np.array([one.high for one in machine.inputs]),
        coldest=np.array([one.low for one in machine.outputs]),
        hottest=np.array([one.high for one in machine.outputs]),
        noise_degC=noise,
        of_input=np.r_[of_input, others],
        input_of=np.r_[np.arange(m), pulses[others].argmax(axis=1)],
        heat=lost / span[:, None],
        missing_for=max(MISSING_FOR, int(np.ceil(DOOR_S / machine.sample_time_s))),
        sample_time_s=machine.sample_time_s,
        reach_degC=max(0.5, 3 * float(noise.max())),
    )


def held_state(plant: Plant, likely: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns N (n, p) and x (n,) of the state N y + x, which inputs hold for long at outputs y (p,):

        x = A x + B u + b,  C x + d = y

    Then the parts behind the sensors of a machine that is found warm, walls or a barrel, are warm too.
    Directions that no input holds, and plants without a rest, are moved along `likely` (n, p), with C likely
    = I.
    """
    slow = np.eye(plant.n) - plant.A
    if np.linalg.cond(slow) > RESTLESS:
        return likely, -likely @ plant.d
    moved, rest = np.linalg.solve(slow, plant.B), np.linalg.solve(slow, plant.b)
    N = moved @ np.linalg.pinv(plant.C @ moved, rcond=WEAK_SHARE)
    N += likely @ (np.eye(plant.p) - plant.C @ N)
    return N, rest - N @ (plant.C @ rest + plant.d)


KINDS = ("sequence", "disturbed")  # set-point changes, and a door, a fan and another room
PLANTS = 5  # one of each structure


def play(exported: Exported, cases: panel.Cases) -> dict[str, Any]:
    """Plays the controller sample by sample on some of `cases`. Returns their number, in how many the law
    was left, for what percentage of samples, and the first reason, with its plant, in the first of those
    cases."""
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
