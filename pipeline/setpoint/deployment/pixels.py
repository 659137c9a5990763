"""The closed loop through pixels: setpoints -> heater and melt -> rendered frames -> key areas -> classifier
-> window -> controller, or no action -> setpoints."""

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

# for the alarm that the camera moved: at least LOOKS frames of a window are searched for the nozzle; a place
# with less than LIKENESS, or hardly more than at home (ADVANTAGE), does not count as the nozzle
TEMPLATE_PX, REACH_PX, LOOKS, LIKENESS, ADVANTAGE = 80, 30, 5, 0.4, 0.12

# ---- the machine


class MachineDynamics(NamedTuple):
    """Heater: first order with time constant `heater_s`, after the delay `heater_delay_s`. Melt: it empties
    with time constant `melt_s` at 210 °C, longer by the factor exp(softening_per_degC) per °C below."""

    heater_s: float
    heater_delay_s: float
    melt_s: float
    softening_per_degC: float


class Running(NamedTuple):
    """State of E machines: `temperature` (E,) °C; `stored` (E,), volume already in the melt, in percent of
    nominal flow times s; `coming` (E, delay + 1), targets on their way to the heater, oldest first."""

    temperature: np.ndarray
    stored: np.ndarray
    coming: np.ndarray


def at_rest(machine: MachineDynamics, flow: np.ndarray, temperature: np.ndarray, *, tick_s: float) -> Running:
    """Returns machines in steady state at flow (E,) in percent and temperature (E,) in °C."""
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
    """Returns the next state, and the mean flow (E,) out of the nozzle over a tick. Machines with `running`
    (E,) false keep their state.

        T' = (target(t - delay) - T) / heater_s
        V' = feed - V / tau(T)    flow = V / tau    tau = melt_s exp(-softening (T - 210))

    All that is fed leaves, but later; a melt that heats up releases part of its content. Both solutions are
    exact if the inputs are constant over the tick.
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
    """Disturbances of E episodes, with times counted in decisions. The feed is multiplied by `clog` (E,) from
    `clog_at` (E,) on. The camera moves by `shift_px` (E, 2) at `shift_at` (E,). The picture is blurred by
    `blur_px` (E,) for `burst_for` (E,) decisions from `burst_at` (E,)."""

    clog: np.ndarray
    clog_at: np.ndarray
    shift_px: np.ndarray
    shift_at: np.ndarray
    blur_px: np.ndarray
    burst_at: np.ndarray
    burst_for: np.ndarray


def calm(episodes: int) -> PixelDisturbances:
    """Returns E episodes without disturbances. Add one with `_replace`."""
    zero, never = np.zeros(episodes), np.full(episodes, np.iinfo(int).max)
    return PixelDisturbances(zero + 1, never, np.zeros((episodes, 2)), never, zero, never, zero)


def _filmed(frames: np.ndarray, d: PixelDisturbances, i: int, decision: int) -> np.ndarray:
    """Returns the frames (n, h, w) of episode i with the camera's disturbances."""
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
    """E episodes of D decisions. True `flow` and `temperature` (E, D + 1): means over the window on which
    each decision was made, and over one window after the last decision.

    For each decision (E, D): `time_s` at the window's end; `setpoint` (E, D, 2), flow and target before;
    `sent` (E, D, 2), the change that was sent; `windows`, each field (E, D, ...); `segment`, its number.
    `clipped` (E, 4) as in actuation.Setpoints.
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
    """The parts of the loop, and how it is deployed.

    `classify(images (n, 16, 48), temperature (n,))`: returns class probabilities (n, 3), out-of-distribution
    scores (n,), log(flow / 100 %) (n,) and its standard deviation (n,). `frames`: in a window, at
    `frame_rate_hz`. `judge(P, valid, scores, tip_moved, flows=)`: the rule of the window, returns a
    JudgedWindow. `least_score`: least ridge score of a key area. `tip_tolerance_px`: allowed distance of the
    nozzle from its calibrated tip. `segment_mean_s`: mean duration of a segment's conditions.
    `window_flow(log_flow, deviation, valid, looks)`, each (E, W), looks (E, measures): returns flow_seen,
    spread and class probabilities of windows. `foreign(looks)`: (E,), whether windows come from an unknown
    camera; None if the camera cannot be judged, and then nothing is sent (`deployment.camera_guard`).
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
    """Returns the memory and the requested change (E, 2) of flow and target. The target changes only when
    lambda's clock allows it. Both are zero if the window does not allow an action."""
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
    """The cameras of E episodes, changed in place: random generators; the segments on the plate; nozzle
    templates, cut from the first frames, where the tip was calibrated; the end of each segment (E,) in s, and
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
    """Simulates episodes that start at rest at the setpoints start (E, 2).

    If a window must not be acted on (its reason is not ACTS), nothing is sent, and the controller's memory is
    kept as it was. Lambda's clock counts only the windows that led to an action, so that a blocked window
    does not cost the temperature its action. Each episode has its own random generator and does not depend on
    the others. Raises ValueError if `disturbances` has another number of episodes.
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
    """Returns the judged windows of E episodes, at the temperatures (E, W) of their frames."""
    E = len(temperature)
    P, scores, *flows = loop.classify(areas.images.reshape(-1, *key_area.SHAPE), temperature.ravel())
    shown = P.reshape(E, -1, 3), areas.valid, scores.reshape(E, -1), areas.tip_moved
    log_flow, deviation = (a.reshape(E, -1) for a in flows)
    return loop.judge(*shown, flows=lambda counts: loop.window_flow(log_flow, deviation, counts, areas.looks))


def _filmed_window(
    loop: PixelLoop, state: Running, setpoint: np.ndarray, clog: np.ndarray, ticks: np.ndarray
):
    """Returns the machines after a wait of `ticks` (E,) and a window of frames, at `setpoint` (E, 2) with the
    flow times `clog` (E,); and flow and temperature (E, W) of each frame."""
    feed, target, tick_s = setpoint[:, 0] * clog, setpoint[:, 1], 1.0 / loop.frame_rate_hz
    state, _, _ = _advance(loop.machine, state, feed, target, ticks, tick_s)
    return _advance(loop.machine, state, feed, target, np.full(len(feed), loop.frames), tick_s)


def _renew_segments(cameras: _Cameras, time_s: np.ndarray, segment_mean_s: float) -> None:
    """Starts a new segment if the old one has ended by time_s (E,)."""
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
    """Returns the state after `ticks` (E,), and the flow and temperature (E, most) of each tick."""
    flows, temperatures = np.zeros((2, len(feed), ticks.max(initial=0)))
    for k in range(ticks.max(initial=0)):
        state, flows[:, k] = tick(machine, state, feed, target, k < ticks, tick_s=tick_s)
        temperatures[:, k] = state.temperature
    return state, flows, temperatures


def _next_segment(segment, rng: np.random.Generator):
    """Draws new conditions on the same machine: nozzle, calibrated tip and the plate's brightness are
    kept."""
    new = nozzle_scene.draw_segment(rng)
    if segment is None:
        return new
    brighter = float(segment.ground.mean()) - float(new.ground.mean())
    ground = np.clip(new.ground + brighter, 0, 255).astype(np.uint8)
    return new._replace(nozzle=segment.nozzle, mask=segment.mask, tip=segment.tip, ground=ground)


class _WindowAreas(NamedTuple):
    """Key areas (E, W, 16, 48) uint8; whether they are valid (E, W); whether the nozzle has left its
    calibrated place (E,); and the measures of the windows' looks (E, measures)."""

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
    """Renders what the cameras see at flow and temperature (E, W), and cuts the key areas."""
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
    """Returns the decision (E,) from which each episode keeps within 90-110 % true flow and 210 +- 5 °C to
    its end; D + 1 if it ends outside."""
    inside = (np.abs(episodes.flow - 100.0) <= 10.0 + 1e-3) & (
        np.abs(episodes.temperature - 210.0) <= 5.0 + 1e-3
    )
    out = ~inside[:, ::-1]
    return np.where(out.any(axis=1), inside.shape[1] - out.argmax(axis=1), 0)
