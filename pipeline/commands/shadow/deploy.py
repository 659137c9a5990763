"""The default controller and the trained classifier, as the stages left them, ready to decide."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from pipeline.commands.levels_files import LEVELS_FILE, RecordedLevels, restore_levels
from pipeline.commands.shadow.decide import DeployedLoop, Looks, WatchOptions, deployed
from pipeline.recordings.nozzle_frames import Topics
from pipeline.setpoint import levels
from pipeline.setpoint.agents.files import restore_published
from pipeline.setpoint.controllers import CONTROLLERS, build_controllers
from pipeline.setpoint.frames.files import restore_camera
from pipeline.setpoint.recordings import read_options
from pipeline.setpoint.settings import EvaluateSetpoint, SetpointMaterial, TrainClassifier
from pipeline.setpoint.simulation.recorded import window_tables
from pipeline.setpoint.tables import WINDOW_PARTS, WINDOWS
from pipeline.setpoint.vision.calibrated_classifier import CalibratedClassifier
from pipeline.setpoint.vision.files import restore_classifier
from pipeline.setpoint.vision.window_flow import WindowFlow, window_flow
from pipeline.store import artifacts, params

# what a printer can be told: percent of flow, degC; pictures a second; seconds
BOUNDS = {"--flow": (1.0, 1000.0), "--temperature": (0.0, 600.0), "--rate": (0.05, 100.0),
          "--hold": (5.0, 3600.0)}  # fmt: skip


WEIGHTS = "datasets/train_classifier/weights.safetensors"
CAMERA = "datasets/train_classifier/known_camera.parquet"


class Ready(NamedTuple):
    """What decides; where recordings have what we need; the tip of the settings."""

    deployed: DeployedLoop
    topics: Topics
    tip: tuple[float, float] | None


class TrainedClassifier(NamedTuple):
    """The classifier of train_classifier, the digest of its weights, and section `train_classifier`."""

    model: CalibratedClassifier
    digest: str
    view: TrainClassifier


def trained() -> TrainedClassifier:
    """Raises ValueError, one sentence, if the stage has not run."""
    view = params.load(TrainClassifier, "train_classifier")
    model = restore_classifier(WEIGHTS, "datasets/train_classifier/calibration.parquet")
    return TrainedClassifier(model, artifacts.sha256(WEIGHTS), view)


def ready(levels_file: str | None) -> Ready:
    """The default of evaluate_setpoint with the classifier of train_classifier, and the levels of this
    camera: of `levels_file`, or if that is empty of LEVELS_FILE, if it is there; None for those that were
    judged. Raises ValueError, one sentence, if a stage has not run."""
    settings = params.load(EvaluateSetpoint, "evaluate_setpoint")
    model, digest, view = trained()
    name = str(artifacts.read_json("datasets/evaluate_setpoint/choice.json")["name"])
    table = artifacts.read_table("datasets/train_classifier/windows.parquet", WINDOWS)
    windows = window_tables(table, WINDOW_PARTS)
    agents = restore_published("datasets/papers/train_agent/weights.safetensors")
    learn = windows["learn"]
    flow = partial(window_flow, fitted=model.calibration.flow)
    proof = model.calibration.proof
    looks = Looks(flow, restore_camera(CAMERA), proof, model.calibration.foreign_above)
    if levels_file is not None and (levels_file or artifacts.exists(LEVELS_FILE)):
        recorded = restore_levels(levels_file or LEVELS_FILE, digest)
        learn = levels.table(recorded.levels, recorded.windows, learn.flow_edges)
        corrected = partial(of_camera, flow, recorded.levels)
        proof = proof._replace(known_from=known_from(recorded))
        looks = Looks(corrected, recorded.camera, proof, recorded.foreign_above)
    rows = [row for row in CONTROLLERS if row.name == name]
    built = build_controllers(settings.baselines, agents, learn, rows)
    if name not in built:
        raise ValueError(
            f"datasets/evaluate_setpoint/choice.json: the default {name!r} is no controller of this version; "
            "make it again with ./run dvc repro evaluate_setpoint"
        )
    options = read_options(view)
    spec = (name, built[name].controller, built[name].parameters)
    material = params.load(SetpointMaterial, "setpoint_material").material()
    return Ready(deployed(model, spec, looks, settings, view, material), options.topics, options.tip_px)


def known_from(recorded: RecordedLevels) -> int:
    """Windows by which a camera with levels is told from others."""
    return len(recorded.windows.seen) if recorded.camera is None else 2 * len(recorded.camera.scores)


def of_camera(
    flow: Callable[..., WindowFlow],
    of: levels.Levels,
    log_flow: np.ndarray,
    deviation: np.ndarray,
    valid: np.ndarray,
    looks: np.ndarray,
) -> WindowFlow:
    """What `flow` gives of windows (E, W), corrected by the levels of this camera. What looks say is of the
    camera that the classifier learned from, and left out here."""
    unknown = np.full_like(looks, np.nan)
    seen = levels.corrected(of, flow(log_flow, deviation, valid, unknown).flow_seen)
    some = np.isfinite(seen)
    prob = np.full((len(seen), 3), 1 / 3)
    prob[some] = levels.probabilities(of, seen[some])
    return WindowFlow(seen, np.where(some, of.spread, np.nan), prob)


def asked(flow: float, temperature: float | None, tip: str, *, once: bool, settings: Ready) -> WatchOptions:
    """What the command line says, checked; if it says none, the best temperature of the material and the tip
    of the settings."""
    bounded("--flow", flow)
    if temperature is None:
        temperature = settings.deployed.material.best_temperature_degC
    bounded("--temperature", temperature)
    return WatchOptions(flow, temperature, pixel(tip) if tip else settings.tip, once)


def bounded(flag: str, value: float) -> float:
    """The value of a flag. Raises ValueError if it lies outside BOUNDS."""
    low, high = BOUNDS[flag]
    if not low <= value <= high:
        raise ValueError(
            f"{flag}: expected {low:g} to {high:g}, found {value:g}; write a number in that range"
        )
    return value


def pixel(text: str) -> tuple[float, float]:
    """(571, 511) of "571,511"."""
    try:
        x, y = map(float, text.split(","))
    except ValueError:
        x, y = -1.0, -1.0
    if not (0 <= x <= 1e5 and 0 <= y <= 1e5):
        raise ValueError(
            f"--tip: expected two numbers of pixels such as 571,511, found {text!r}; "
            "write X,Y without a blank"
        )
    return x, y
