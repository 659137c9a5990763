"""Exports the setpoint loop's classifier and filter for a machine without jax: classifier.safetensors with
flow_reader.py, and filter.safetensors with flow_filter.py. The readers need numpy only."""

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from pipeline.deploy import flow_filter as filter_reader
from pipeline.deploy import flow_reader
from pipeline.setpoint.agents import flow_filter
from pipeline.setpoint.agents.flow_filter import FlowFilter
from pipeline.setpoint.published import FLOW_MOVES
from pipeline.setpoint.simulation.simulator import GOOD_BORDERS
from pipeline.setpoint.vision.calibrated_classifier import CalibratedClassifier, read_frames
from pipeline.setpoint.vision.proof import may_judge, verdict
from pipeline.setpoint.vision.vision_transformer import named_arrays
from pipeline.setpoint.vision.window_flow import KNOTS_PERCENT
from pipeline.store import artifacts

CLASSIFIER_SCHEMA, FILTER_SCHEMA = "flow classifier 1", "flow filter 2"
# each file of weights with its schema and its reader
FILES = {
    "classifier.safetensors": (CLASSIFIER_SCHEMA, flow_reader),
    "filter.safetensors": (FILTER_SCHEMA, filter_reader),
}
Weights = dict[str, dict[str, np.ndarray]]  # arrays by name, of each file of FILES


def weights(model: CalibratedClassifier, decides: FlowFilter) -> Weights:
    """Returns the arrays of the classifier and of the filter."""
    return dict(zip(FILES, (classifier_arrays(model), filter_arrays(decides)), strict=True))


def write(folder: str | Path, made: Weights) -> None:
    """Writes each file of weights, and its reader beside it."""
    for name, arrays in made.items():
        schema, reader = FILES[name]
        source = Path(str(reader.__file__))
        artifacts.write_weights(Path(folder) / name, schema, arrays, {"reader": source.name})
        artifacts.write_text(Path(folder) / source.name, source.read_text(encoding="utf-8"))


def classifier_arrays(model: CalibratedClassifier) -> dict[str, np.ndarray]:
    """Returns weights, structure and calibration."""
    body, fitted = model.network.body, model.calibration
    return named_arrays(model.network) | {
        "patch": np.array(body.patch),
        "heads": np.array(body.blocks[0].heads),
        "layers": np.array(len(body.blocks)),
        "temperature": np.array(fitted.temperature),
        "flow_knots": np.log(np.array(KNOTS_PERCENT) / 100),
        "flow_shown": np.asarray(fitted.flow.shown, float),
        "flow_scale": np.asarray(fitted.flow.scale, float),
        "flow_correlation": np.array(fitted.flow.correlation),
        **{f"looks_{name}": np.asarray(value, float) for name, value in fitted.flow.looks._asdict().items()},
        "foreign_above": np.array(fitted.foreign_above),
        "means": np.asarray(fitted.familiar.means, float),
        "whitening": np.asarray(fitted.familiar.whitening, float),
    }


def filter_arrays(decides: FlowFilter) -> dict[str, np.ndarray]:
    """Returns the filter's values, with their grid, borders and moves."""
    return {name: np.asarray(value, float) for name, value in decides._asdict().items()} | {
        "grid": flow_filter.GRID,
        "outliers": np.array(flow_filter.OUTLIERS),
        "good": np.array(GOOD_BORDERS),
        "corrections": np.asarray(flow_filter.CORRECTIONS, float),
        "begins": np.asarray(flow_filter.BEGINS),
        "flow_moves": np.array(FLOW_MOVES),
    }


FRAMES = 64  # drawn key areas on which reader and network are compared
WHY = (
    "What sees and what decides have no certificate: evaluate_setpoint judged them with held windows, waits "
    "and limits, which are not in these files."
)


def write_checked(
    folder: Path, name: str, model: CalibratedClassifier, decides: Any, seed: int
) -> dict[str, Any]:
    """Writes the files of a default controller with this name and parameters; writes none if it is not a flow
    filter, or if the classifier cannot judge its camera. Returns why there is no certificate, and how far the
    reader differs from the network."""
    why = "" if isinstance(decides, FlowFilter) else f"{name} has no filter whose tables could be exported."
    if not may_judge(model.calibration.proof):
        why = f"The classifier {verdict(model.calibration.proof)}."
    if why:
        return {"controller": name, "measured": False, "why": why, "largest_difference": {}}
    write(folder, weights(model, decides))
    difference = {"log_flow": of_reader(folder, model, np.random.default_rng(seed))}
    return {"controller": name, "measured": True, "why": WHY, "largest_difference": difference}


def of_reader(folder: Path, model: CalibratedClassifier, rng: np.random.Generator) -> float:
    """Returns the largest difference in log(flow / 100 %) between the exported reader and the network."""
    reader = _module(folder / "flow_reader.py")
    weights = reader.read_safetensors(folder / "classifier.safetensors")
    images = rng.integers(0, 256, (FRAMES, 16, 48)).astype(np.float32)
    temperature = rng.uniform(180.0, 240.0, FRAMES).astype(np.float32)
    shown = reader.outputs(weights, images, temperature)[1]
    return float(np.abs(shown - np.asarray(read_frames(model, images, temperature).log_flow)).max())


def _module(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
