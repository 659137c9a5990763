"""A controller on a machine with its supervisor round it: the object that runs, a sample at a time. What is
wrong, and which mode follows, is found by supervisor.py.
"""

from __future__ import annotations

import numpy as np

from pipeline.runtime import innovations
from pipeline.runtime.machine import Exported
from pipeline.runtime.supervisor import (
    ACTIVE,
    ALARMED,
    ALL_INPUTS,
    CHANGED,
    CLOCKED,
    HELD_SHARE,
    HOLD,
    KINDS,
    LAW,
    MODE,
    MODEL,
    MODES,
    OF_INPUT,
    OF_OUTPUT,
    OFF_MODE,
    PI,
    REACH,
    SAMPLES,
    SETTLED_DEGC,
    STEPS,
    Cause,
    Decision,
    _loudest,
    followed,
    kept,
    mode_of,
    said,
    sentence,
    timed,
    verified,
)
from pipeline.temperature.controllers.controller import Reference, RunningController, constant, rest


class Supervised:
    """A controller on one machine with its supervisor, a sample at a time.

    As controller.RunningController: in manual, `watch` each sample; then `hand_over` once, then `step` each
    sample. Where a cause asks for a safe mode, the law watches, and takes over again without a bump when the
    cause has been gone for its declared time, or after `acknowledge`.
    """

    def __init__(self, exported: Exported, *, rehearsal: bool = False):
        if exported.simulated and not rehearsal:
            raise ValueError(
                f"controller {exported.name}: it was made for a simulated plant and runs only with "
                "rehearsal=True; learn it from recordings of the machine, or rehearse"
            )
        self.exported, self.supervision = exported, exported.supervision
        self.law = RunningController(exported.controller, exported.model)
        self.pi = None if exported.fallback is None else RunningController(exported.fallback, exported.model)
        self.kept = kept(self.supervision)
        self.memory = innovations.remembered(self.supervision.watch, self.supervision.bank)
        self._reference: Reference | None = None
        self._w, self._Y, self._beyond = np.zeros(1), np.zeros((0, 1)), np.zeros(0)
        self._out: list[int] = []
        self._in_reach = np.full(len(exported.machine.outputs), np.nan)

    def watch(self, u: np.ndarray, y: np.ndarray, r: np.ndarray) -> None:
        """One sample in manual, as RunningController has it; what is wrong is told by the first `step`."""
        u, y = np.asarray(u, float), np.asarray(y, float)
        r_now, y_star = self._target(r)
        k = self.kept
        filled = followed(self.supervision, k, self.memory, y, y_star, None, 0)
        k.clock_s[1] += self.supervision.sample_time_s
        k.asked[:] = k.held[:] = u
        self.law.watch(u, filled, r_now)

    def hand_over(self, y: np.ndarray) -> None:
        """From manual to the law without a bump, at outputs y (p,) measured now."""
        self.law.hand_over(np.where(np.isfinite(y), y, self.kept.expected))

    def acknowledge(self) -> None:
        """A person has mended what was wrong: every cause is forgotten, and what was taken from it."""
        k = self.kept
        k.since[:] = k.last[:] = -1.0
        k.counters[ACTIVE] = k.counters[CHANGED] = 0
        for part in (k.lacks, k.stuck, k.absurd, k.error, k.waited):
            part[:] = 0.0
        k.counters[SAMPLES], k.counters[ALARMED] = 0, -1
        innovations.rested(self.memory)

    def step(
        self, y: np.ndarray, r: np.ndarray | Reference, t_s: float, applied: np.ndarray | None = None
    ) -> Decision:
        """What to apply from outputs y (p,) measured at t_s on the machine's clock, NaN where a sensor gives
        none, under reference r; `applied` (m,) are the inputs that acted since the last sample, where the
        machine reads them back. Raises ValueError for another number of them, before any watch, and where r
        is not finite."""
        s, k = self.supervision, self.kept
        y = np.asarray(y, float)
        if y.shape != k.y.shape:
            raise ValueError(
                f"the supervisor expects {len(k.y)} temperatures but was given an array of shape {y.shape}; "
                "give NaN for a sensor that does not answer"
            )
        if not k.counters[CLOCKED]:
            k.clock_s[0], k.counters[CLOCKED] = t_s - s.sample_time_s, 1
        samples = timed(s, k, t_s)
        r_now, y_star = self._target(r)
        filled = followed(s, k, self.memory, y, y_star, applied, samples)
        if self._out:
            j = int(self._beyond.argmax())
            said(k, REACH, j, self._beyond[j])
            if not np.isfinite(self._in_reach).all():
                self._in_reach = filled
            r = r_now = self._in_reach
        if k.counters[MODE] in (LAW, PI) and not self._out:
            verified(s, k, filled, y_star)
        u, mode = self._driven(filled, r, r_now, y_star)
        return Decision(u.copy(), MODES[mode], self._causes(t_s) if mode != LAW else ())

    def _driven(self, y, r, r_now, y_star) -> tuple[np.ndarray, int]:
        """Inputs of the mode, and the mode; the law watches where it does not drive."""
        s, k = self.supervision, self.kept
        before, mode, n = k.counters[MODE], mode_of(s, k), int(k.counters[STEPS])
        if mode == PI and self.pi is None:
            mode = HOLD
        if mode == LAW:
            if before != LAW:
                self.law.hand_over(y)
            u = self.law.step(y, r, n)
            held, off = k.held, (y - y_star).tolist()
            if -SETTLED_DEGC < min(off) and max(off) < SETTLED_DEGC:
                held += HELD_SHARE * (u - held)
        else:
            u = self._safe(mode, before, y, r_now, n)
            self.law.watch(u, y, r_now)
        k.asked[:], k.counters[MODE] = u, mode
        return u, mode

    def _safe(self, mode: int, before: int, y: np.ndarray, r: np.ndarray, n: int) -> np.ndarray:
        limits = self.exported.controller.limits
        if mode == OFF_MODE:
            return limits.low.copy()
        if mode == PI and self.pi is not None:
            if before != PI:
                self.pi.watch(self.kept.asked, y, r)
                self.pi.hand_over(y)
            return self.pi.step(y, r, n)
        return np.minimum(np.maximum(self.kept.held, limits.low), limits.high)

    def _target(self, r: np.ndarray | Reference) -> tuple[np.ndarray, np.ndarray]:
        """The reference r and the target y* (p,) now: the nearest that the inputs can hold."""
        mine = self._reference
        if isinstance(r, Reference):
            same = mine is not None and (r is mine or all(map(np.array_equal, r, mine)))
        else:
            r = np.asarray(r, float)
            same = mine is not None and len(self._w) == 1 and bool((mine.H[:, 0] == r).all())
        if mine is None or not same:
            mine = r if isinstance(r, Reference) else constant(r)
            at = rest(self.exported.model, mine, self.exported.controller.limits)
            self._reference, self._w = mine, np.array(mine.w0, float)
            self._Y, r0 = at.Y, mine.H @ mine.w0
            outside = np.maximum(r0 - self.supervision.high, self.supervision.low - r0)
            self._beyond = np.maximum(np.abs(at.miss), outside)
            self._out = [int(j) for j in np.flatnonzero(self._beyond > self.supervision.reach_degC)]
            if not self._out:
                self._in_reach = r0
            self._now = mine.H @ self._w, self._Y @ self._w
        elif len(self._w) > 1:
            self._w = mine.F @ self._w
            self._now = mine.H @ self._w, self._Y @ self._w
        return self._now

    def _causes(self, t_s: float) -> tuple[Cause, ...]:
        """Every cause that is there, the first of KINDS first."""
        k, machine = self.kept, self.exported.machine
        found = []
        for kind, signal in zip(*np.nonzero(k.since >= 0), strict=True):
            names = machine.inputs if kind in OF_INPUT else machine.outputs
            of = kind in OF_INPUT or kind in OF_OUTPUT or kind == REACH
            if k.other[kind, signal] == ALL_INPUTS:
                of = False
            words = sentence(machine, kind, signal, k.amount[kind, signal], k.other[kind, signal])
            since = t_s - (k.clock_s[1] - k.since[kind, signal])
            found.append(Cause(KINDS[kind], names[signal].name if of else "machine", words, since))
        if not found:
            j = _loudest(self.memory)
            words = f"{machine.outputs[j].name} is not what any plant of the spread shows; why is sought."
            since = t_s - k.counters[ALARMED] * self.supervision.sample_time_s
            found.append(Cause(KINDS[MODEL], machine.outputs[j].name, words, float(since)))
        return tuple(found)

    def saved(self) -> dict[str, np.ndarray]:
        """All that it remembers, as arrays. Raises ValueError before the first watch."""
        arrays = {f"law.{name}": part for name, part in self.law.saved().items()}
        if self.pi is not None and self.kept.counters[MODE] == PI:
            arrays |= {f"pi.{name}": part for name, part in self.pi.saved().items()}
        for group in (self.kept, self.memory):
            arrays |= {name: np.array(part) for name, part in group._asdict().items()}
        mine = {"beyond": self._beyond, "in_reach": self._in_reach, "Y": self._Y, "w": self._w}
        mine |= {} if self._reference is None else self._reference._asdict()
        return arrays | {f"aim.{name}": np.array(part) for name, part in mine.items()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Goes on from what another of the same controller `saved`. Raises ValueError where its arrays are
        not of this controller."""
        mine = self.kept._asdict() | self.memory._asdict()
        for name, part in mine.items():
            if name not in arrays or np.shape(arrays[name]) != part.shape:
                found = np.shape(arrays[name]) if name in arrays else "none"
                raise ValueError(
                    f"the supervisor expects to be restored from {name} of shape {part.shape} but was given "
                    f"{found}; restore what a supervisor of the same controller saved"
                )
        for prefix, runner in (("law.", self.law), ("pi.", self.pi)):
            own = {
                name.removeprefix(prefix): part for name, part in arrays.items() if name.startswith(prefix)
            }
            if own and runner is not None:
                runner.restore(own)
        for name, part in mine.items():
            part[...] = arrays[name]
        aim = {
            name.removeprefix("aim."): np.array(arrays[name]) for name in arrays if name.startswith("aim.")
        }
        self._reference = Reference(*(aim[name] for name in Reference._fields))
        self._w, self._Y, self._beyond, self._in_reach = (
            aim[name] for name in ("w", "Y", "beyond", "in_reach")
        )
        self._out = [int(j) for j in np.flatnonzero(self._beyond > self.supervision.reach_degC)]
        self._now = self._reference.H @ self._w, self._Y @ self._w
