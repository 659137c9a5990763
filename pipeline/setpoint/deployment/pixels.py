"""The closed loop through pixels: setpoints -> heater and melt -> rendered frames -> key areas -> classifier
-> window -> hold or controller -> setpoints."""

from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pipeline.setpoint.deployment import deployment
from pipeline.setpoint.deployment.deployment import JudgedWindow
from pipeline.setpoint.frames import familiar, key_area, nozzle_scene
from pipeline.setpoint.published import FLOW_MOVES, LAMBDA, TEMPERATURE_MOVES
from pipeline.setpoint.simulation import actuation
from pipeline.setpoint.simulation.actuation import ACTS, SetpointLimits, Waits
from pipeline.setpoint.simulation.simulator import Observation, SetpointController

# of the nozzle, for the alarm that the camera moved: at least LOOKS frames of a window are looked at; what is
# less alike, or hardly more than at home, is not the nozzle elsewhere
TEMPLATE_PX, REACH_PX, LOOKS, LIKENESS, ADVANTAGE = 80, 30, 5, 0.4, 0.12

# ---- the machine


class MachineDynamics(NamedTuple):
    """Heater: first order, heater_s, after heater_delay_s. Melt: melt_s at 210 °C is how long it empties,
    longer by `softening` per °C below."""

    heater_s: float
    heater_delay_s: float
    melt_s: float
    softening_per_degC: float


class Running(NamedTuple):
    """State of E machines: temperature (E,) °C, stored (E,) the volume already in the melt, in percent of
    nominal flow times s, and the targets on their way to the heater, oldest first (E, delay)."""

    temperature: np.ndarray
    stored: np.ndarray
    coming: np.ndarray


def at_rest(machine: MachineDynamics, flow: np.ndarray, temperature: np.ndarray, *, tick_s: float) -> Running:
    """Machines that have long been fed flow (E,) in percent at temperature (E,) in °C."""
    temperature = np.asarray(temperature, float)
    delay = round(machine.heater_delay_s / tick_s)
    return Running(
        temperature, flow * _melt_s(machine, temperature), np.repeat(temperature[:, None], delay + 1, axis=1)
    )


def tick(
    machine: MachineDynamics,
    state: Running,
    feed: np.ndarray,
    target: np.ndarray,
    running: np.ndarray,
    *,
    tick_s: float,
) -> tuple[Running, np.ndarray]:
    """The next state and the mean flow (E,) out of the nozzle over a tick,
    for those that run (E,) bool; the others stand still.

        T' = (target(t - delay) - T) / heater_s
        V' = feed - V / tau(T)    flow = V / tau    tau = melt_s exp(-softening (T - 210))

    What is fed leaves, later, and a melt that heats up lets go of what it holds. Both are exact for inputs
    that are constant over the tick.
    """
    tau = _melt_s(machine, state.temperature)
    stored = feed * tau + (state.stored - feed * tau) * np.exp(-tick_s / tau)
    flow = feed - (stored - state.stored) / tick_s
    coming = np.concatenate([state.coming[:, 1:], target[:, None]], axis=1)
    temperature = coming[:, 0] + (state.temperature - coming[:, 0]) * np.exp(-tick_s / machine.heater_s)
    now = Running(temperature, stored, coming)
    return Running(
        *(np.where(running.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in zip(now, state, strict=True))
    ), flow


def _melt_s(machine: MachineDynamics, temperature: np.ndarray) -> np.ndarray:
    return machine.melt_s * np.exp(-machine.softening_per_degC * (temperature - 210.0))


# ---- what befalls it


class PixelDisturbances(NamedTuple):
    """Of E episodes, counted in decisions: the feed is multiplied by clog (E,) from clog_at (E,) on; the
    camera moves by shift_px (E, 2) at shift_at (E,); for burst_for (E,) decisions from burst_at (E,) the
    picture is blurred by blur_px (E,)."""

    clog: np.ndarray
    clog_at: np.ndarray
    shift_px: np.ndarray
    shift_at: np.ndarray
    blur_px: np.ndarray
    burst_at: np.ndarray
    burst_for: np.ndarray


def calm(episodes: int) -> PixelDisturbances:
    """Nothing befalls E episodes; `_replace` what is to."""
    zero, never = np.zeros(episodes), np.full(episodes, np.iinfo(int).max)
    return PixelDisturbances(zero + 1, never, np.zeros((episodes, 2)), never, zero, never, zero)


def _filmed(frames: np.ndarray, d: PixelDisturbances, i: int, decision: int) -> np.ndarray:
    """The frames (n, h, w) of episode i as a disturbed camera gives them."""
    burst = 0 <= decision - d.burst_at[i] < d.burst_for[i]
    h, w = frames.shape[1:]
    if burst and d.blur_px[i] > 0:
        frames = np.stack([cv2.GaussianBlur(f, (0, 0), d.blur_px[i]) for f in frames])
    if decision >= d.shift_at[i]:
        by = np.float32([[1, 0, d.shift_px[i, 0]], [0, 1, d.shift_px[i, 1]]])
        frames = np.stack([cv2.warpAffine(f, by, (w, h), borderMode=cv2.BORDER_REPLICATE) for f in frames])
    return frames


# ---- the loop


class Episodes(NamedTuple):
    """E episodes of D decisions. Truth: flow and temperature (E, D + 1), means over the window that each
    decision was made on, and over one after the last.

    Per decision (E, D): time_s at the window's end, setpoint and sent (E, D, 2) flow and target before, and
    the change that was sent, windows (each field (E, D, ...)), segment number; clipped (E, 4) as in
    actuation.Setpoints.
    """

    flow: np.ndarray
    temperature: np.ndarray
    time_s: np.ndarray
    setpoint: np.ndarray
    sent: np.ndarray
    windows: JudgedWindow
    segment: np.ndarray
    clipped: np.ndarray


class PixelLoop(NamedTuple):
    """What is closed into a loop, and how it is deployed.

    The machine; the classifier classify(images (n, 16, 48), temperature (n,)) -> class probabilities (n, 3),
    out-of-distribution scores (n,), log(flow / 100 %) (n,) and its deviation (n,);
    frames a window at frame_rate_hz, waits, limits, and the rule of the window, judge(P, valid, scores,
    tip_moved, flows=) -> Window; the least ridge score of a key area, how far the nozzle may be from where
    its tip was calibrated, and how long a segment's conditions last on average. window_flow(log_flow,
    deviation, valid, looks), each (E, W), looks (E, measures), -> flow_seen, spread and class probabilities
    of windows. foreign(looks) -> (E,) whether windows are of no camera that is known; None where the camera
    cannot be judged, and all is held (`deployment.camera_guard`).
    """

    machine: MachineDynamics
    classify: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, ...]]
    frames: int
    frame_rate_hz: float
    waits: Waits
    limits: SetpointLimits
    judge: Callable[..., JudgedWindow]
    least_score: float
    tip_tolerance_px: float
    segment_mean_s: float
    window_flow: Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]
    foreign: Callable[[np.ndarray], np.ndarray] | None


def _answer(
    controller: SetpointController,
    parameters: Any,
    memory: Any,
    shown: Observation,
    keys: jax.Array,
    reason: np.ndarray,
) -> tuple[Any, np.ndarray]:
    """Memory, and the change (E, 2) wanted of flow and target; the target's only where lambda's clock allows
    it, none where the window is held."""
    shown = Observation(*(jnp.asarray(a, jnp.int32 if a.dtype.kind == "i" else jnp.float32) for a in shown))
    memory, (q, u) = _decided(controller, parameters, memory, shown, jnp.asarray(reason, jnp.int32), keys)
    wanted = np.stack(
        [
            np.asarray(FLOW_MOVES)[q],
            np.where(shown.step % LAMBDA == 0, np.asarray(TEMPERATURE_MOVES)[u], 0.0),
        ],
        axis=1,
    )
    return memory, np.where((reason == ACTS)[:, None], wanted, 0.0)


_decided = eqx.filter_jit(jax.vmap(actuation.decide, (None, None, 0, 0, 0, 0)))


class _Cameras(NamedTuple):
    """The cameras of E episodes, changed in place: generators; the segments on the plate; templates of the
    nozzles, cut from the first frames, where the tip was calibrated; when each segment ends (E,) in s, and
    its number (E,)."""

    rngs: list[np.random.Generator]
    segments: list
    templates: list
    ends: np.ndarray
    numbers: np.ndarray


def run(
    controller: SetpointController,
    parameters: Any,
    start: np.ndarray,
    loop: PixelLoop,
    disturbances: PixelDisturbances,
    *,
    decisions: int,
    rng: np.random.Generator,
) -> Episodes:
    """Episodes from the setpoints start (E, 2), at rest there.

    A window whose classes cannot be told apart is no reason to act, but it is evidence: the controller is
    shown it and remembers, and its answer is not sent. Of windows held for another reason it hears nothing.
    Lambda's clock counts the windows that were acted on, so that a hold does not cost the temperature its
    action. Each episode draws from its own generator: what it meets does not depend on the others.
    """
    E, tick_s = len(start), 1.0 / loop.frame_rate_hz
    if len(disturbances.clog) != E:
        raise ValueError(
            f"pixels.run: expected disturbances of {E} episodes, found {len(disturbances.clog)}; "
            f"make them by calm({E})"
        )
    cameras = _Cameras(rng.spawn(E), [None] * E, [None] * E, np.zeros(E), np.zeros(E, int))
    keys = jax.random.split(jax.random.key(int(rng.integers(2**31))), E)
    setpoints = actuation.setpoints(start, loop.limits)
    running = at_rest(loop.machine, *setpoints.value.T, tick_s=tick_s)
    memory = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (E, *jnp.shape(leaf))), controller.start())
    time_s, change = np.zeros(E), np.zeros((E, 2))
    acted, since, seen = np.zeros(E, int), np.zeros(E), np.full(E, np.nan)
    steps: list[tuple] = []
    for decision in range(decisions + 1):
        clog = np.where(decision >= disturbances.clog_at, disturbances.clog, 1.0)
        ticks = np.rint(actuation.wait_after(change, loop.waits) / tick_s).astype(int) * (decision > 0)
        running, flow, temperature = _filmed_window(loop, running, setpoints.value, clog, ticks)
        time_s = time_s + (ticks + loop.frames) * tick_s
        if decision == decisions:
            break
        _renew_segments(cameras, time_s, loop.segment_mean_s)
        areas = _window_areas(cameras, flow, temperature, loop, disturbances, decision)
        window = deployment.camera_seen(_judged(loop, areas, temperature), seen, areas.looks, loop.foreign)
        seen = window.flow_seen
        step_keys = jax.vmap(jax.random.fold_in, (0, None))(keys, decision)
        shown = Observation(
            window.p,
            window.label,
            window.flow_seen,
            since,
            temperature.mean(axis=1),
            setpoints.value[:, 1],
            acted,
        )
        memory, wanted = _answer(controller, parameters, memory, shown, step_keys, window.reason)
        acts = window.reason == ACTS
        before, setpoints = setpoints, actuation.moved(setpoints, wanted, time_s, loop.limits)
        change = setpoints.value - before.value
        means = flow.mean(axis=1), temperature.mean(axis=1)
        steps.append((*means, time_s, before.value, change, window, cameras.numbers.copy()))
        since = np.where(acts, 0.0, since) + change[:, 0]
        acted = acted + acts
    flows, temperatures, times, values, changes, windows, segments = zip(*steps, strict=True)
    return Episodes(
        flow=np.stack([*flows, flow.mean(axis=1)], axis=1),
        temperature=np.stack([*temperatures, temperature.mean(axis=1)], axis=1),
        time_s=np.stack(times, axis=1),
        setpoint=np.stack(values, axis=1),
        sent=np.stack(changes, axis=1),
        windows=JudgedWindow(*(np.stack(field, axis=1) for field in zip(*windows, strict=True))),
        segment=np.stack(segments, axis=1),
        clipped=setpoints.clipped,
    )


def _judged(loop: PixelLoop, areas: "_WindowAreas", temperature: np.ndarray) -> JudgedWindow:
    """What the windows of E episodes say, at the temperatures (E, W) of their frames."""
    E = len(temperature)
    P, scores, *flows = loop.classify(areas.images.reshape(-1, *key_area.SHAPE), temperature.ravel())
    shown = P.reshape(E, -1, 3), areas.valid, scores.reshape(E, -1), areas.tip_moved
    log_flow, deviation = (a.reshape(E, -1) for a in flows)
    return loop.judge(*shown, flows=lambda counts: loop.window_flow(log_flow, deviation, counts, areas.looks))


def _filmed_window(
    loop: PixelLoop, state: Running, setpoint: np.ndarray, clog: np.ndarray, ticks: np.ndarray
):
    """The machines after a wait of ticks (E,) and a window of frames, at setpoints (E, 2) with the flow times
    clog (E,); flow and temperature (E, W) of each frame."""
    feed, target, tick_s = setpoint[:, 0] * clog, setpoint[:, 1], 1.0 / loop.frame_rate_hz
    state, _, _ = _advance(loop.machine, state, feed, target, ticks, tick_s)
    return _advance(loop.machine, state, feed, target, np.full(len(feed), loop.frames), tick_s)


def _renew_segments(cameras: _Cameras, time_s: np.ndarray, segment_mean_s: float) -> None:
    """A new segment where the old one has ended by time_s (E,)."""
    for i in np.flatnonzero(time_s > cameras.ends):
        cameras.segments[i] = _next_segment(cameras.segments[i], cameras.rngs[i])
        cameras.ends[i] = time_s[i] + cameras.rngs[i].exponential(segment_mean_s)
        cameras.numbers[i] += 1


def _advance(
    machine: MachineDynamics,
    state: Running,
    feed: np.ndarray,
    target: np.ndarray,
    ticks: np.ndarray,
    tick_s: float,
):
    """The state after ticks (E,), and the flow and temperature (E, most) of each tick."""
    flows, temperatures = np.zeros((2, len(feed), ticks.max(initial=0)))
    for k in range(ticks.max(initial=0)):
        state, flows[:, k] = tick(machine, state, feed, target, k < ticks, tick_s=tick_s)
        temperatures[:, k] = state.temperature
    return state, flows, temperatures


def _next_segment(segment, rng: np.random.Generator):
    """New conditions on the same machine: nozzle, calibrated tip and the plate's brightness stay."""
    new = nozzle_scene.draw_segment(rng)
    if segment is None:
        return new
    brighter = float(segment.ground.mean()) - float(new.ground.mean())
    ground = np.clip(new.ground + brighter, 0, 255).astype(np.uint8)
    return new._replace(nozzle=segment.nozzle, mask=segment.mask, tip=segment.tip, ground=ground)


class _WindowAreas(NamedTuple):
    """Key areas (E, W, 16, 48) uint8, whether they are valid (E, W), whether the nozzle is elsewhere than
    where it was calibrated (E,), and how the windows look (E, measures)."""

    images: np.ndarray
    valid: np.ndarray
    tip_moved: np.ndarray
    looks: np.ndarray


def _window_areas(
    cameras: _Cameras,
    flow: np.ndarray,
    temperature: np.ndarray,
    loop: PixelLoop,
    disturbances: PixelDisturbances,
    decision: int,
) -> _WindowAreas:
    """What the cameras show of flow and temperature (E, W)."""
    images, valid, moved, looks = [], [], [], []
    for i, segment in enumerate(cameras.segments):
        scene = nozzle_scene.render(segment, flow[i], temperature[i], cameras.rngs[i])
        frames, tip = _filmed(scene.frames, disturbances, i, decision), segment.tip
        areas = key_area.find_all(
            frames, tip, least_score=loop.least_score, directions_deg=segment.direction_deg
        )
        if cameras.templates[i] is None:
            cameras.templates[i] = key_area.nozzle_template(scene.frames[0], tip, size_px=TEMPLATE_PX)
        some = frames[:: max(1, len(frames) // LOOKS)]
        nozzle = key_area.drift(some, cameras.templates[i], tip, reach_px=REACH_PX)
        images.append(areas.images)
        valid.append(areas.valid)
        looks.append(familiar.of_window(frames, np.array(tip), areas))
        moved.append(
            np.hypot(*nozzle.offset_px) > loop.tip_tolerance_px
            and nozzle.correlation >= LIKENESS
            and nozzle.advantage >= ADVANTAGE
        )
    return _WindowAreas(np.stack(images), np.stack(valid), np.array(moved), np.stack(looks))


def settled_since(episodes: Episodes) -> np.ndarray:
    """The decision (E,) from which each episode is inside 90-110 % and 210 +- 5 °C, by the true flow, to its
    end; D + 1 where it ends outside."""
    inside = (np.abs(episodes.flow - 100.0) <= 10.0 + 1e-3) & (
        np.abs(episodes.temperature - 210.0) <= 5.0 + 1e-3
    )
    out = ~inside[:, ::-1]
    return np.where(out.any(axis=1), inside.shape[1] - out.argmax(axis=1), 0)
