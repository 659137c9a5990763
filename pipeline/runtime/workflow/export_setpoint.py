"""The setpoint loop's part of export_controllers: its classifier and the tables of its filter, written for a
machine without jax."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np

from pipeline.runtime.export import setpoint
from pipeline.runtime.workflow.export_controllers import Written, hashes
from pipeline.setpoint.bayes import Filter
from pipeline.setpoint.calibrated_classifier import CalibratedClassifier, read_frames
from pipeline.setpoint.workflow.contestants import ControllerSpec

BELIEF = "our agent"  # sees what its own filter believes
FRAMES = 64  # drawn key areas on which reader and network are compared
WHY = "Classifier and filter have no certificate: what they show is judged by evaluate_setpoint."


def filter_of(name: str, specs: dict[str, ControllerSpec], belief: Filter) -> Filter | None:
    """The filter of the controller that is the default; None where it has none."""
    parameters = specs[name].parameters if name in specs else None
    return belief if name == BELIEF else parameters if isinstance(parameters, Filter) else None


def write(folder: Path, name: str, model: CalibratedClassifier, tables: Filter | None, seed: int) -> Written:
    """The four files of setpoint.write, and how far the reader is from the network."""
    if tables is None:
        return Written(name, None, f"{name} has no filter whose tables could be exported.", {}, {}, "1")
    setpoint.write(folder, setpoint.exported(model, tables))
    difference = of_reader(folder, model, np.random.default_rng(seed))
    return Written(name, None, WHY, hashes(folder), {"log_flow": difference}, "1")


def of_reader(folder: Path, model: CalibratedClassifier, rng: np.random.Generator) -> float:
    """The largest difference in log(flow / 100 %) between the exported reader and the network."""
    reader = _module(folder / "flow_reader.py")
    images = rng.integers(0, 256, (FRAMES, 16, 48)).astype(np.float32)
    temperature = rng.uniform(180.0, 240.0, FRAMES).astype(np.float32)
    weights = reader.read_safetensors(folder / "classifier.safetensors")
    shown = reader.outputs(weights, images, temperature)[1]
    return float(np.abs(shown - np.asarray(read_frames(model, images, temperature).log_flow)).max())


def _module(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("flow_reader", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
