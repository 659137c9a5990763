"""A controller on a machine with its supervisor round it: the object that runs, a sample at a time. What is
wrong, and which mode follows, is found by supervisor.py.
"""

from __future__ import annotations

import numpy as np

from pipeline.deploy.machine import Exported
from pipeline.deploy.supervisor import (
    ACTIVE,
    KINDS,
    LAW,
    MODE,
    MODES,
    OF_INPUT,
    OFF,
    OWN,
    REACH,
    RUNS,
    SAMPLES,
    Cause,
    Decision,
    choose_mode,
    follow,
    kept,
    pass_time,
    say,
    sentence,
)
from pipeline.temperature.controllers.controller import Reference, RunningController, constant, rest


def _numbers(
    values: np.ndarray | float, shape: tuple[int, ...], what: str, *, finite: bool = False
) -> np.ndarray:
    """An array of a shape. Raises ValueError for another, and if `finite` is asked for and one is not."""
    array = np.asarray(values, float)
    if array.shape != shape:
        raise ValueError(
            f"the supervisor expects {shape[0] if shape else 'one'} {what} but was given an array of shape "
            f"{array.shape}; give one a signal, NaN for a sensor that does not answer"
        )
    if finite and not np.isfinite(array).all():
        raise ValueError(
            f"the supervisor expects finite {what} but was given {array}; keep the last that was"
        )
    return array


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
        self.own = None if exported.fallback is None else RunningController(exported.fallback, exported.model)
        self.kept = kept(self.supervision)
        self._reference: Reference | None = None
        self._w, self._Y, self._beyond = np.zeros(1), np.zeros((0, 1)), np.zeros(0)
        self._out: list[int] = []
        self._in_reach = np.full(len(exported.machine.outputs), np.nan)

    def tell(self, disturbances: np.ndarray) -> None:
        """The measured disturbances (q,) from this sample on, in the machine's order, NaN where one gives no
        number. Raises ValueError for another number of them."""
        told = _numbers(disturbances, (len(self.exported.machine.disturbances),), "disturbances")
        self.law.tell(told)

    def watch(self, u: np.ndarray, y: np.ndarray, r: np.ndarray) -> None:
        """One sample in manual, as RunningController has it; what is wrong is told by the first `step`.
        Raises ValueError as `step` does, and if inputs u (m,) are not finite; it then remembers nothing."""
        k = self.kept
        y = self._accepted(y, r)
        u = _numbers(u, k.asked.shape, "inputs in percent", finite=True)
        r_now, _ = self._target(r)
        filled = follow(self.supervision, k, y, None, 0)
        k.asked[:] = u
        k.clock_s[1] += self.supervision.sample_time_s
        k.forward[:] = self.law.forward
        self.law.watch(u, filled, r_now)

    def hand_over(self, y: np.ndarray) -> None:
        """From manual to the law without a bump, at outputs y (p,) measured now."""
        self.law.hand_over(np.where(np.isfinite(y), y, self.kept.expected))

    def acknowledge(self) -> None:
        """A person has mended what was wrong: every cause is forgotten."""
        k = self.kept
        k.since[:] = k.last[:] = -1.0
        k.counters[ACTIVE] = 0
        for part in (k.amount, k.returns, k.shown, k.missing):
            part[:] = 0
        k.age[:] = -1

    def step(
        self, y: np.ndarray, r: np.ndarray | Reference, t_s: float, applied: np.ndarray | None = None
    ) -> Decision:
        """What to apply from outputs y (p,) measured at t_s on the machine's clock, NaN where a sensor gives
        none, under reference r; `applied` (m,) are the inputs that acted since the last sample, where the
        machine reads them back. Raises ValueError for another number of them, before any watch, and where r
        or t_s is not finite, and remembers nothing."""
        s, k = self.supervision, self.kept
        y = self._accepted(y, r)
        _numbers(t_s, (), "time in s", finite=True)
        applied = None if applied is None else _numbers(applied, k.asked.shape, "inputs in percent")
        if not k.counters[SAMPLES]:
            raise ValueError("the supervisor has seen no sample; call watch with each sample in manual first")
        samples = pass_time(s, k, t_s)
        r_now, _ = self._target(r)
        filled = follow(s, k, y, applied, samples)
        if self._out:
            j = int(self._beyond.argmax())
            say(k, REACH, j, self._beyond[j])
            if not np.isfinite(self._in_reach).all():
                self._in_reach = filled
            r = r_now = self._in_reach
        u, mode = self._drive(filled, r, r_now)
        return Decision(u.copy(), MODES[mode], self._causes(t_s) if mode != LAW else ())

    def _accepted(self, y: np.ndarray, r: np.ndarray | Reference) -> np.ndarray:
        """Outputs y (p,), NaN where a sensor gives none. Raises ValueError for another number of them, or if
        the reference r is not p finite numbers."""
        p = self.kept.y.shape
        _numbers(r.H @ r.w0 if isinstance(r, Reference) else r, p, "references in °C", finite=True)
        return _numbers(y, p, "temperatures")

    def _drive(self, y: np.ndarray, r: np.ndarray | Reference, r_now: np.ndarray) -> tuple[np.ndarray, int]:
        """Inputs of the mode, and the mode; the law watches where it does not drive."""
        k, mode = self.kept, choose_mode(self.supervision, self.kept)
        before, n = k.counters[MODE], int(k.counters[RUNS])
        if mode == LAW:
            if before != LAW:
                self.law.hand_over(y)
            u = self.law.step(y, r, n)
        else:
            u = self._safe(mode, before, y, r_now, n)
            self.law.watch(u, y, r_now)
        k.asked[:], k.forward[:], k.counters[MODE] = u, self.law.forward, mode
        k.counters[RUNS] += 1
        return u, mode

    def _safe(self, mode: int, before: int, y: np.ndarray, r: np.ndarray, n: int) -> np.ndarray:
        """Inputs of a safe mode; off, too, if there is no control of the machine's own."""
        if mode == OFF or self.own is None:
            return self.exported.controller.limits.low.copy()
        if before != OWN:
            self.own = RunningController(self.own.controller, self.own.model)
            self.own.forward = self.law.forward
            self.own.watch(self.kept.asked, y, r)
            self.own.hand_over(y)
        self.own.forward = self.law.forward
        return self.own.step(y, r, n)

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
            outside = np.maximum(r0 - self.supervision.hottest, self.supervision.coldest - r0)
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
        k, machine, causes = self.kept, self.exported.machine, []
        for kind, signal in zip(*np.nonzero(k.since >= 0), strict=True):
            names = machine.inputs if kind in OF_INPUT else machine.outputs
            words = sentence(self.supervision, machine, int(kind), int(signal), float(k.amount[kind, signal]))
            since = t_s - (k.clock_s[1] - k.since[kind, signal])
            causes.append(Cause(KINDS[kind], names[signal].name, words, float(since)))
        return tuple(causes)

    def saved(self) -> dict[str, np.ndarray]:
        """All that it remembers, as arrays. Raises ValueError before the first watch."""
        arrays = {f"law.{name}": part for name, part in self.law.saved().items()}
        if self.own is not None and self.kept.counters[MODE] == OWN:
            arrays |= {f"own.{name}": part for name, part in self.own.saved().items()}
        arrays |= {name: np.array(part) for name, part in self.kept._asdict().items()}
        aimed = {"beyond": self._beyond, "in_reach": self._in_reach, "Y": self._Y, "w": self._w}
        aimed |= {} if self._reference is None else self._reference._asdict()
        return arrays | {f"aim.{name}": np.array(part) for name, part in aimed.items()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Goes on from what another of the same controller `saved`. Raises ValueError where its arrays are
        not of this controller, and stays as it was."""
        memory = self.kept._asdict()
        for name, part in memory.items():
            if name not in arrays or np.shape(arrays[name]) != part.shape:
                given = np.shape(arrays[name]) if name in arrays else "none"
                raise ValueError(
                    f"the supervisor expects to be restored from {name} of shape {part.shape} but was given "
                    f"{given}; restore what a supervisor of the same controller saved"
                )
        parts: dict[str, dict[str, np.ndarray]] = {"law": {}, "own": {}, "aim": {}}
        for name, part in arrays.items():
            if "." in name:
                parts[name.partition(".")[0]][name.partition(".")[2]] = np.array(part)
        aim = parts["aim"]
        if lost := {*Reference._fields, "w", "Y", "beyond", "in_reach"} - set(aim):
            raise ValueError(
                f"the supervisor expects to be restored from aim.{', aim.'.join(sorted(lost))}; "
                "restore what a supervisor of the same controller saved"
            )
        law, own = RunningController(self.law.controller, self.law.model), self.own
        law.restore(parts["law"])
        if own is not None and arrays["counters"][MODE] == OWN:
            own = RunningController(own.controller, own.model)
            own.restore(parts["own"])
        self.law, self.own = law, own
        for name, part in memory.items():
            part[...] = arrays[name]
        self.law.forward = self.kept.forward.copy()
        self._reference = Reference(*(aim[name] for name in Reference._fields))
        self._w, self._Y, self._beyond, self._in_reach = (
            aim[name] for name in ("w", "Y", "beyond", "in_reach")
        )
        self._out = [int(j) for j in np.flatnonzero(self._beyond > self.supervision.reach_degC)]
        self._now = self._reference.H @ self._w, self._Y @ self._w
