"""What a window says, and what the deployed controller would do about it. Nothing is sent."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pipeline.recordings.watch_sources import CameraFrame
from pipeline.setpoint.agents import flow_filter
from pipeline.setpoint.deployment import deployment
from pipeline.setpoint.deployment.deployment import JudgedWindow, camera_guard, camera_seen
from pipeline.setpoint.deployment.pixels import ADVANTAGE, LIKENESS, LOOKS, REACH_PX, TEMPLATE_PX
from pipeline.setpoint.frames import familiar, key_area
from pipeline.setpoint.frames.familiar import KnownCamera
from pipeline.setpoint.frames.front_end import FrameKeyAreas, find_key_areas
from pipeline.setpoint.material import PLA, PrintedMaterial
from pipeline.setpoint.published import FLOW_MOVES, LAMBDA, TEMPERATURE_MOVES
from pipeline.setpoint.settings import EvaluateSetpoint, TrainClassifier
from pipeline.setpoint.simulation import actuation
from pipeline.setpoint.simulation.actuation import ACTS, FOREIGN, SetpointLimits
from pipeline.setpoint.simulation.simulator import Observation, SetpointController
from pipeline.setpoint.vision.calibrated_classifier import CalibratedClassifier, FrameReadings, read_frames
from pipeline.setpoint.vision.proof import CameraProof
from pipeline.store.printable import printable

# frames of a window that the page shows
SHOWN = 3


class DrawnFrame(NamedTuple):
    """A frame's crop (350, 350, 3) uint8 RGB with the key area drawn in; the reason if it was rejected."""

    name: str
    picture: np.ndarray
    reason: str


class WatchOptions(NamedTuple):
    """What a person says of the print: flow in percent and temperature in degC if the source does not say
    them, the tip (x, y) in px or None, and whether to end where the source does."""

    flow: float
    temperature: float
    tip: tuple[float, float] | None
    once: bool


class DeployedLoop(NamedTuple):
    """What decides.

    read(images (n, 16, 48), temperature (n,)) -> what n key areas show; window_flow(log_flow, deviation,
    valid, looks), each (E, W), looks (E, measures) -> flow_seen in percent, spread and class probabilities of
    windows, those of this camera if levels were recorded; how the known camera looks, and what is proven
    of it (`proof`): if it cannot be judged all is held; the default controller with its name and
    parameters, frames of a window, the front end's least score, how a window is judged, the limits, how long
    after a move of the setpoint frames are of no use, how far the nozzle may be from where its tip was. All
    of it is of the published material; `material` is the one that is printed.
    """

    read: Callable[[np.ndarray, np.ndarray], FrameReadings]
    window_flow: Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]
    known: KnownCamera | None
    proof: CameraProof
    name: str
    controller: SetpointController
    parameters: Any
    window: int
    least_score: float
    judge: Callable[..., JudgedWindow]
    limits: SetpointLimits
    settle_s: float
    tip_tolerance_px: float
    material: PrintedMaterial = PLA


class ShadowDecision(NamedTuple):
    """One window: what was seen, what it would do, and what the page shows of it; setpoint, would and flow
    seen are of the material that is printed. belief (N,) over flow_filter.GRID, flows of the published one,
    or None if the controller has none; pictures are of some of its frames."""

    number: int
    time_s: float
    judged: JudgedWindow
    setpoint: tuple[float, float]
    would: np.ndarray
    belief: np.ndarray | None
    names: list[str]
    reasons: list[str]
    pictures: list[DrawnFrame]
    row: dict[str, Any]


class Looks(NamedTuple):
    """What is known of this printer's camera: what makes a window's flow, as DeployedLoop has it; how it
    looks, what is proven of it, and the distance that is foreign there."""

    window_flow: Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]
    known: KnownCamera | None
    proof: CameraProof
    foreign_above: float


def deployed(
    model: CalibratedClassifier,
    spec: tuple[str, SetpointController, Any],
    looks: Looks,
    settings: EvaluateSetpoint,
    view: TrainClassifier,
    material: PrintedMaterial,
) -> DeployedLoop:
    """The loop as it is deployed through pixels, without a machine."""
    q = settings.pixels
    judge = partial(deployment.judge_window, least_frames=q.least_frames, foreign_above=looks.foreign_above)
    limits = deployment.deployed_limits(q.per_action, q.per_minute)
    read = partial(read_frames, model)
    eye = read, looks.window_flow, looks.known, looks.proof
    return DeployedLoop(
        *eye, *spec, view.window, view.least_score, judge, limits, q.wait_s, q.tip_tolerance_px, material
    )


class Mind:
    """What the controller remembers, in the place of the one that would act: its memory, the number of
    windows it would have acted on, and the setpoint at the last window that it was shown."""

    def __init__(self, deployed: DeployedLoop) -> None:
        self.deployed = deployed
        self.memory = deployed.controller.start()
        self.acted, self.shown_flow, self.last_seen, self.number = 0, np.nan, np.nan, 0
        self.template: np.ndarray | None = None
        self.decide_jit = eqx.filter_jit(actuation.decide)
        self.key = jax.random.key(0)

    def decide(
        self, window: list[CameraFrame], asked: WatchOptions, first_s: float, notes: list[str]
    ) -> ShadowDecision:
        """The decision that this window asks for; the memory is changed as a deployed controller's is."""
        temperature = np.array([_known(shown.temperature, asked.temperature) for shown in window])
        setpoint = (_known(window[-1].flow, asked.flow), float(temperature[-1]))
        tips = np.array([_tip(shown, asked) for shown in window])
        areas = find_key_areas(
            [shown.frame for shown in window],
            tips,
            np.array([shown.direction_deg for shown in window]),
            least_score=self.deployed.least_score,
        )
        material = self.deployed.material
        seen_at = material.published_temperature(temperature)
        judged = self._judged(areas, seen_at, self._tip_moved(window, tips, notes), notes)
        would = self._answer(judged, setpoint, float(seen_at.mean()), notes)
        judged = _own(judged, material)
        self.number += 1
        time_s = window[-1].time_s - first_s
        belief = believed(self.memory)
        pictures = _pictures(window, areas)
        row = _row(self.number, time_s, judged, would, setpoint, window, areas, notes)
        low, median, high = (None, None, None) if belief is None else belief_range(belief, material)
        row |= {"belief_flow_percent": median, "belief_low_percent": low, "belief_high_percent": high}
        names = [shown.name for shown in window]
        return ShadowDecision(
            self.number, time_s, judged, setpoint, would, belief, names, areas.reasons, pictures, row
        )

    def _judged(
        self, areas: FrameKeyAreas, temperature: np.ndarray, tip_moved: bool, notes: list[str]
    ) -> JudgedWindow:
        """What the frames say together."""
        of = self.deployed
        valid = np.array([not reason for reason in areas.reasons])
        readings, looks = (
            of.read(areas.images, temperature),
            familiar.median(areas.surroundings.astype(float)),
        )
        judged = of.judge(
            readings.prob[None],
            valid[None],
            readings.distance[None],
            np.array([tip_moved]),
            flows=lambda counts: of.window_flow(
                readings.log_flow[None], readings.deviation[None], counts, looks[None]
            ),
        )
        was, guard = judged.reason[0], camera_guard(of.known, of.proof)
        judged = camera_seen(judged, np.array([self.last_seen]), looks[None], guard)
        self.last_seen = judged.flow_seen[0]
        if of.known is not None and judged.reason[0] == FOREIGN != was:
            notes.append(f"the pictures are none of the known camera: {familiar.unlike(of.known, looks)}")
        return judged

    def _answer(
        self, judged: JudgedWindow, setpoint: tuple[float, float], temperature: float, notes: list[str]
    ) -> np.ndarray:
        """(2,) the change of flow in percent and target in degC that would be sent, within the limits, 0 if
        the window is held. Setpoint and change are of the material that is printed, window and temperature of
        the published one."""
        if judged.reason[0] != ACTS:
            return np.zeros(2)
        material = self.deployed.material
        published = _published(material, setpoint)
        move = published[0] - self.shown_flow if np.isfinite(self.shown_flow) else 0.0
        self.shown_flow = published[0]
        shown = Observation(
            shares=jnp.asarray(judged.p[0], jnp.float32),
            named=jnp.int32(judged.label[0]),
            flow_seen=jnp.float32(judged.flow_seen[0]),
            flow_move=jnp.float32(move),
            temperature=jnp.float32(temperature),
            target=jnp.float32(published[1]),
            step=jnp.int32(self.acted),
        )
        self.memory, action = self.decide_jit(
            self.deployed.controller,
            self.deployed.parameters,
            self.memory,
            shown,
            jnp.int32(judged.reason[0]),
            jax.random.fold_in(self.key, self.number),
        )
        heats = self.acted % LAMBDA == 0
        wanted = np.array(
            [FLOW_MOVES[int(action.flow)], TEMPERATURE_MOVES[int(action.temperature)] if heats else 0.0]
        )
        self.acted += 1
        limits = self.deployed.limits
        inside = np.clip(published, limits.low, limits.high)
        if (inside != published).any():
            notes.append(
                f"the setpoint {setpoint[0]:g} %, {setpoint[1]:g} degC lies outside the controller's limits"
            )
        at = actuation.setpoints(inside[None], limits)
        after = actuation.moved(at, wanted[None], np.zeros(1), limits).value[0]
        return _own_setpoint(material, after) - _own_setpoint(material, inside)

    def _tip_moved(self, window: list[CameraFrame], tips: np.ndarray, notes: list[str]) -> bool:
        """Whether the nozzle is elsewhere than on the first frame of the watch."""
        seen = [(i, shown.frame) for i, shown in enumerate(window) if isinstance(shown.frame, np.ndarray)]
        if not seen or not np.isfinite(tips[seen[0][0]]).all():
            return False
        some = [frame for _, frame in seen[:: max(1, len(seen) // LOOKS)]]
        tip = (float(tips[seen[0][0], 0]), float(tips[seen[0][0], 1]))
        try:
            if self.template is None:
                self.template = key_area.nozzle_template(some[0], tip, size_px=TEMPLATE_PX)
            some = [frame for frame in some if frame.shape[:2] == some[0].shape[:2]]
            nozzle = key_area.drift(some, self.template, tip, reach_px=REACH_PX)
        except ValueError as error:
            notes.append(f"whether the camera moved is not known: {error}")
            return False
        return bool(
            np.hypot(*nozzle.offset_px) > self.deployed.tip_tolerance_px
            and nozzle.correlation >= LIKENESS
            and nozzle.advantage >= ADVANTAGE
        )


def _published(material: PrintedMaterial, setpoint: tuple[float, float]) -> np.ndarray:
    """(2,) flow in percent and target in degC of the published material that stand for a setpoint."""
    return np.array(
        [
            material.published_flow(np.array(setpoint[0])),
            material.published_temperature(np.array(setpoint[1])),
        ]
    )


def _own_setpoint(material: PrintedMaterial, published: np.ndarray) -> np.ndarray:
    """The inverse of _published."""
    return np.array([material.own_flow(published[0]), material.own_temperature(published[1])])


def _own(judged: JudgedWindow, material: PrintedMaterial) -> JudgedWindow:
    """The flow that windows show, and its deviation, as of the material that is printed."""
    seen, step = judged.flow_seen, np.exp(judged.spread)
    if material == PLA:
        return judged
    own = np.log(material.own_flow(seen * step) / material.own_flow(seen / step)) / 2
    return judged._replace(flow_seen=material.own_flow(seen), spread=own)


def _pictures(window: list[CameraFrame], areas: FrameKeyAreas) -> list[DrawnFrame]:
    """Some frames of the window with the key area drawn in."""
    pictures = []
    for i in np.unique(np.linspace(0, len(window) - 1, SHOWN).astype(int)):
        frame, reason = window[i].frame, areas.reasons[i]
        if isinstance(frame, str) or not np.isfinite(areas.angle_deg[i]):
            continue
        figures = (float(column[i]) for column in (areas.angle_deg, areas.miss_px, areas.score))
        area = key_area.KeyArea(areas.images[i], *figures, float(areas.padded_share[i]), reason)
        tip = (float(areas.tip[i, 0]), float(areas.tip[i, 1]))
        pictures.append(DrawnFrame(window[i].name, key_area.drawn(frame, tip, area), reason))
    return pictures


def _known(said: float, otherwise: float) -> float:
    return float(said) if np.isfinite(said) else otherwise


def _tip(shown: CameraFrame, asked: WatchOptions) -> tuple[float, float]:
    """The tip of the command line or the settings, or else the recording's."""
    return shown.tip if asked.tip is None else asked.tip


def believed(memory: Any) -> np.ndarray | None:
    """The belief (N,) over the flows flow_filter.GRID of a controller that has one."""
    if isinstance(memory, tuple) or np.shape(memory)[-1:] != flow_filter.GRID.shape or not np.any(memory):
        return None
    total = np.asarray(memory, float).reshape(-1, len(flow_filter.GRID)).sum(axis=0)
    return total / total.sum()


def belief_range(belief: np.ndarray, material: PrintedMaterial) -> tuple[float, float, float]:
    """The flows in percent, of a material, below which 5, 50 and 95 % of the belief lie."""
    low, median, high = np.interp([0.05, 0.5, 0.95], np.cumsum(belief), material.own_flow(flow_filter.GRID))
    return float(low), float(median), float(high)


def _row(
    number: int,
    time_s: float,
    judged: JudgedWindow,
    would: np.ndarray,
    setpoint: tuple[float, float],
    window: list[CameraFrame],
    areas: FrameKeyAreas,
    notes: list[str],
) -> dict[str, Any]:
    """The fields of decision_log.FIELDS but those of the belief."""
    acts = judged.reason[0] == ACTS
    return {
        "decision": number, "time_s": _number(time_s), "reason": actuation.REASONS[judged.reason[0]],
        "would": would_words(would, setpoint) if acts else "hold",
        "why": deployment.why(time_s, judged, 0, would),
        "flow_setpoint_percent": _number(setpoint[0]), "target_degC": _number(setpoint[1]),
        "would_flow_move_percent": float(would[0]), "would_temperature_move_degC": float(would[1]),
        **{f"p_{name}": float(p) for name, p in zip(deployment.CLASSES, judged.p[0], strict=True)},
        "flow_seen_percent": _number(judged.flow_seen[0]), "spread": _number(judged.spread[0]),
        "distance": _number(judged.score[0]), "valid": int(judged.valid[0]), "used": int(judged.used[0]),
        "notes": [printable(note) for note in notes],
        "frames": [
            {"name": printable(shown.name), "time_s": shown.time_s, "valid": not reason,
             "reason": printable(reason), "score": _number(score), "angle_deg": _number(angle)}
            for shown, reason, score, angle in zip(
                window, areas.reasons, areas.score, areas.angle_deg, strict=True)
        ],
    }  # fmt: skip


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def would_words(would: np.ndarray, setpoint: tuple[float, float]) -> str:
    """ "flow -5 % (to 95 %)", "change nothing"."""
    moves = [
        f"{name} {change:+.4g} {unit} (to {at + change:.4g} {unit})"
        for name, change, at, unit in zip(("flow", "temperature"), would, setpoint, ("%", "°C"), strict=True)
        if change
    ]
    return ", ".join(moves) or "change nothing"
