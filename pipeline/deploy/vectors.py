"""Golden vectors: what the Python object does on its own model, with noise, changed references, faults and
hand-overs.

A script says what happens to machine and controller at each sample. `played` runs it with any object that has
the methods of supervise.Supervised; the C test runs the same script with the exported code. Both close the
loop themselves. If recorded outputs were fed to a law that is unstable by itself, only rounding errors would
be compared.

    x(t+1) = A x + B (share u + extra) + b,   y = C x + d + add, or what `reading` says
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from pipeline.deploy.supervise import KINDS, MODES, Exported, Supervised
from pipeline.temperature.controllers.law import fed_forward
from pipeline.temperature.plant import hold_output, strictly_proper

# what is done at a sample: in manual; a step; before it hand over, restore, or acknowledge; begin anew
WATCH, STEP, HAND_OVER, RESTORE, ACKNOWLEDGE, BEGIN = range(6)
# readings that do not come from the plant: no number, and the previous reading once more
LOST, REPEATED = np.inf, -np.inf
TOLERANCE = 1e-9  # of each input's range
# largest change of an input, as a fraction of its range, if readings change by UNSURE: from a law's own gains
OWN_GAINS = 1e-6
UNSURE = 1e-9  # degC: smaller than the accuracy of any reading, larger than the rounding of any forecast


class Script(NamedTuple):
    """For each sample (T,): `do`, `t_s`, `told` (1: the controller reads back what was applied); `r`, `add`,
    `reading` (T, p) in degC, reading NaN for the plant's own; `manual`, `share`, `extra` (T, m);
    `disturbances` (T, q) that the controller gets, NaN if unknown. They reduce the inputs by what is fed
    forward for them."""

    do: np.ndarray
    t_s: np.ndarray
    told: np.ndarray
    r: np.ndarray
    add: np.ndarray
    reading: np.ndarray
    manual: np.ndarray
    share: np.ndarray
    extra: np.ndarray
    disturbances: np.ndarray


class Played(NamedTuple):
    """For each sample: requested inputs `u` (T, m), `mode` (T,) and `causes` (T,), one bit for each of
    KINDS."""

    u: np.ndarray
    mode: np.ndarray
    causes: np.ndarray


class EpisodeStart(NamedTuple):
    """Start of an episode: the model's state x (n,), the inputs u (m,) that hold it, and outputs y (p,)."""

    x: np.ndarray
    u: np.ndarray
    y: np.ndarray


def start(exported: Exported) -> EpisodeStart:
    """Returns the model at rest in the middle of its outputs' limits; if these are not declared, at a third
    of the inputs' range."""
    model, machine = strictly_proper(exported.model), exported.machine
    low, high = (np.array([getattr(one, side) for one in machine.inputs]) for side in ("low", "high"))
    bottom, top = (np.array([getattr(one, side) for one in machine.outputs]) for side in ("low", "high"))
    third = low + (high - low) / 3
    if np.isfinite(bottom).all() and np.isfinite(top).all():
        x, u = hold_output(model, (bottom + top) / 2)
        return EpisodeStart(x, np.clip(u, low, high), model.C @ x + model.d)
    x = np.linalg.lstsq(np.eye(model.n) - model.A, model.B @ third + model.b, rcond=None)[0]
    return EpisodeStart(x, third, model.C @ x + model.d)


def script(exported: Exported, *, episodes: int, steps: int, rng: np.random.Generator) -> Script:
    """Returns several episodes, one after the other."""
    return joined([episode(exported, steps, rng) for _ in range(episodes)])


def joined(parts: Sequence[Any]) -> Any:
    """Concatenates scripts, or results of scripts."""
    return type(parts[0])(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


MANUAL = 25


def episode(exported: Exported, steps: int, rng: np.random.Generator) -> Script:
    """Returns `steps` samples: MANUAL in manual, then the law with changing references, and in most episodes
    one fault for a while."""
    machine, at = exported.machine, start(exported)
    (m, p), T = (len(machine.inputs), len(machine.outputs)), machine.sample_time_s
    low, high = (np.array([getattr(one, side) for one in machine.inputs]) for side in ("low", "high"))
    noise = exported.supervision.noise_degC
    do = np.full(steps, STEP)
    do[:MANUAL], do[0], do[MANUAL] = WATCH, BEGIN, HAND_OVER
    do[rng.integers(MANUAL + 1, steps, 2)] = RESTORE
    reach = _reach(exported) if rng.random() < 0.5 else 150 * noise
    each = max(60, steps // 3)
    asked = at.y + rng.uniform(-1, 1, (-(-steps // each), p)) * reach
    r = np.repeat(asked, each, axis=0)[:steps]
    r[:MANUAL] = at.y
    made = Script(
        do=do,
        t_s=T * np.arange(steps),
        told=np.full(steps, int(rng.integers(2))),
        r=r,
        add=rng.normal(0, noise, (steps, p)),
        reading=np.full((steps, p), np.nan),
        manual=np.clip(at.u + 0.05 * (high - low) * rng.normal(size=(steps, m)), low, high),
        share=np.ones((steps, m)),
        extra=np.zeros((steps, m)),
        disturbances=_told(exported, steps, rng),
    )
    first = int(rng.integers(MANUAL + 20, max(steps - 40, MANUAL + 21)))
    if rng.random() < 0.7:  # shortly before the reference changes, as a fault shows then
        first = max(each - int(rng.integers(10)), MANUAL + 20)
    last = min(first + int(rng.integers(10, 80)), steps)
    fault(made, str(rng.choice(FAULTS)), slice(first, last), exported, rng)
    if last < steps and rng.random() < 0.5:
        made.do[last] = ACKNOWLEDGE
    return made


def _reach(exported: Exported) -> np.ndarray:
    """Returns how far (p,) in degC references may lie from the start: a little beyond the outputs' limits, so
    that the governor acts and some are out of reach."""
    bottom, top = (
        np.array([getattr(one, side) for one in exported.machine.outputs]) for side in ("low", "high")
    )
    span = np.where(np.isfinite(top - bottom), top - bottom, 300 * exported.supervision.noise_degC)
    return 0.52 * span


def _told(exported: Exported, steps: int, rng: np.random.Generator) -> np.ndarray:
    """Returns disturbances (T, q) in steps, each of which feeds forward at most a twentieth of an input's
    range. One in ten samples of the second half is unknown."""
    forward = exported.controller.forward
    if forward is None:
        return np.zeros((steps, len(exported.machine.disturbances)))
    span = np.array([one.high - one.low for one in exported.machine.inputs])
    most = 0.05 / np.maximum(np.abs(forward.gain / span[:, None]).sum(axis=0), 1e-9)
    levels = rng.uniform(-1, 1, (-(-steps // 20), len(most)))
    told = forward.mean + np.repeat(levels, 20, axis=0)[:steps] * np.minimum(most, 1e6)
    told[steps // 2 :][rng.random((steps - steps // 2, len(most))) < 0.1] = np.nan
    return told


FAULTS = ("none", "lost", "frozen", "frozen", "cold", "on", "on", "off", "off", "weak", "late", "jump")


def fault(made: Script, kind: str, when: slice, exported: Exported, rng: np.random.Generator) -> None:
    """Inserts a fault of one signal into a script."""
    m, p = made.manual.shape[1], made.r.shape[1]
    i, j = int(rng.integers(m)), int(rng.integers(p))
    high, T = exported.machine.inputs[i].high, exported.machine.sample_time_s
    if kind == "lost":
        made.reading[when, j] = LOST
    elif kind == "frozen":
        made.reading[when, j] = REPEATED
    elif kind == "cold":
        made.reading[when, j] = -300.0
    elif kind == "on":
        made.share[when, i], made.extra[when, i] = 0.0, high
    elif kind == "off":
        made.share[when, i] = 0.0
    elif kind == "weak":
        made.share[when, i] = 0.5
    elif kind == "late":
        made.t_s[when.start :] += 2.4 * T
    elif kind == "jump":
        made.t_s[when.start :] += 500.0 * T


def played(make: Any, exported: Exported, at: EpisodeStart, script: Script) -> Played:
    """Runs the script on the model of a controller, with the object that `make()` returns."""
    plant = strictly_proper(exported.model)
    forward = fed_forward(exported.controller, script.disturbances)
    T, m = script.manual.shape
    out = Played(np.zeros((T, m)), np.zeros(T, int), np.zeros(T, int))
    x, u, y = at.x, at.u, at.y
    one = make()
    for t in range(T):
        if script.do[t] == BEGIN:
            x, u, y, one = at.x, at.u, at.y, make()
        applied = script.share[t] * u + script.extra[t] if t else u
        y = _read(plant.C @ x + plant.d + script.add[t], script.reading[t], y)
        if script.do[t] in (WATCH, BEGIN):
            one.tell(script.disturbances[t])
            u = script.manual[t]
            one.watch(u, y, script.r[t])
        else:
            one.tell(script.disturbances[t])
            one = _before(one, make, script.do[t], y)
            one.tell(script.disturbances[t])
            told = applied if script.told[t] and script.do[t] != HAND_OVER else None
            decision = one.step(y, script.r[t], script.t_s[t], told)
            u = decision.u
            out.mode[t] = MODES.index(decision.mode)
            out.causes[t] = sum({1 << KINDS.index(cause.kind) for cause in decision.causes})
        out.u[t] = u
        x = plant.A @ x + plant.B @ (script.share[t] * u + script.extra[t] - forward[t]) + plant.b
    return out


def _read(measured: np.ndarray, reading: np.ndarray, before: np.ndarray) -> np.ndarray:
    y = np.where(np.isnan(reading), measured, reading)
    return np.where(reading == LOST, np.nan, np.where(reading == REPEATED, before, y))


def _before(one: Any, make: Any, do: int, y: np.ndarray) -> Any:
    """Does what must happen before the step: hand over, acknowledge or restore. Returns the object."""
    if do == HAND_OVER:
        one.hand_over(y)
    elif do == ACKNOWLEDGE:
        one.acknowledge()
    elif do == RESTORE:
        saved, one = one.saved(), make()
        one.restore(saved)
    return one


def as_csv(at: EpisodeStart, script: Script, done: Played) -> str:
    """Returns golden.csv: the start in its first line, then one line for each sample, with numbers that read
    back exactly."""
    lines = [",".join(map(repr, np.r_[at.x, at.u, at.y].tolist()))]
    columns = [script.do, script.told, done.mode, done.causes]
    for t in range(len(script.do)):
        whole = [str(int(column[t])) for column in columns]
        parts = (script.r, script.add, script.reading, script.manual, script.share, script.extra, done.u)
        parts += (script.disturbances,)
        numbers = np.concatenate([[script.t_s[t]], *(part[t] for part in parts)])
        lines.append(",".join(whole + list(map(repr, numbers.tolist()))))
    return "\n".join(lines) + "\n"


def play_often(exported: Exported, make: Any, script: Script, *, replays: int = 3) -> tuple[Played, float]:
    """Plays an episode, and `replays` more with readings moved by UNSURE up or down. Returns the first, and
    the largest change of the requested inputs as a fraction of an input's range; infinite if a mode or a
    cause differs. Stops at the first change above OWN_GAINS.

    If a law switches between its governor and its limits, the loop itself may amplify rounding, twofold in
    each sample. Then the object does not agree with itself, so neither another CPU nor C code can agree with
    it.
    """
    at, rng = start(exported), np.random.default_rng(0)
    span = np.array([signal.high - signal.low for signal in exported.machine.inputs])
    one, differs = played(make, exported, at, script), 0.0
    for _ in range(replays):
        shift = UNSURE * rng.choice([-1.0, 1.0], script.add.shape)
        other = played(make, exported, at, script._replace(add=script.add + shift))
        same = np.array_equal(one.mode, other.mode) and np.array_equal(one.causes, other.causes)
        differs = max(differs, float((np.abs(one.u - other.u) / span).max()) if same else np.inf)
        if differs > OWN_GAINS:
            break
    return one, differs


def golden(
    exported: Exported, *, episodes: int = 5, steps: int = 120, seed: int = 1, replays: int = 3
) -> str:
    """Returns golden.csv of a controller: the object's results in `episodes` episodes that do not amplify
    rounding, tested by `replays` of each. Raises ValueError if too few such episodes are found."""
    rng, scripts, done = np.random.default_rng(seed), [], []
    for _ in range(10 * episodes):
        asked = episode(exported, steps, rng)
        one, differs = play_often(
            exported, lambda: Supervised(exported, rehearsal=True), asked, replays=replays
        )
        if differs <= OWN_GAINS:
            scripts.append(asked)
            done.append(one)
        if len(done) == episodes:
            return as_csv(start(exported), joined(scripts), joined(done))
    raise ValueError(
        f"controller {exported.name}: expected {episodes} episodes that rounding does not decide but found "
        f"{len(done)} in {10 * episodes}; look at the targets of its model"
    )
