"""The setpoint loop's eyes and its filter for a machine without jax: classifier.safetensors with
flow_reader.py, filter.safetensors with flow_filter.py. Both readers need numpy only."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.runtime.export import flow_filter, flow_reader
from pipeline.setpoint import bayes
from pipeline.setpoint.calibrated_classifier import CalibratedClassifier
from pipeline.setpoint.published import FLOW_MOVES
from pipeline.setpoint.simulator import GOOD_BORDERS
from pipeline.setpoint.vision_transformer import VisionTransformer, named_arrays
from pipeline.setpoint.window_flow import KNOTS_PERCENT
from pipeline.store import artifacts

CLASSIFIER_SCHEMA, FILTER_SCHEMA = "flow classifier 1", "flow filter 1"
READERS = tuple(Path(reader.__file__) for reader in (flow_reader, flow_filter))


class Exported(NamedTuple):
    """Arrays of classifier.safetensors and of filter.safetensors, and the readers, name to text."""

    classifier: dict[str, np.ndarray]
    filter: dict[str, np.ndarray]
    readers: dict[str, str]


def exported(model: CalibratedClassifier, parameters: bayes.Filter) -> Exported:
    readers = {path.name: path.read_text(encoding="utf-8") for path in READERS}
    return Exported(classifier_arrays(model), filter_arrays(parameters), readers)


def write(folder: str | Path, made: Exported) -> None:
    """The four files."""
    folder = Path(folder)
    about = {"reader": "flow_reader.py"}
    artifacts.write_weights(folder / "classifier.safetensors", CLASSIFIER_SCHEMA, made.classifier, about)
    artifacts.write_weights(folder / "filter.safetensors", FILTER_SCHEMA, made.filter, {})
    for name, text in made.readers.items():
        artifacts.write_text(folder / name, text)


def classifier_arrays(model: CalibratedClassifier) -> dict[str, np.ndarray]:
    """Weights, form and calibration. Raises ValueError for a network that the reader does not know."""
    body = model.network.body
    if not isinstance(body, VisionTransformer):
        raise ValueError(
            f"the exported reader knows a vision transformer but the classifier is a {type(body).__name__}; "
            "train one with train_classifier.size small or paper"
        )
    fitted = model.calibration
    return named_arrays(model.network) | {
        "patch": np.array(body.patch),
        "heads": np.array(body.blocks[0].heads),
        "layers": np.array(len(body.blocks)),
        "temperature": np.array(fitted.temperature),
        "flow_knots": np.log(np.array(KNOTS_PERCENT) / 100),
        "flow_shown": np.asarray(fitted.flow.shown, float),
        "flow_scale": np.asarray(fitted.flow.scale, float),
        "flow_correlation": np.array(fitted.flow.correlation),
        "foreign_above": np.array(fitted.foreign_above),
        "means": np.asarray(fitted.familiar.means, float),
        "whitening": np.asarray(fitted.familiar.whitening, float),
    }


def filter_arrays(parameters: bayes.Filter) -> dict[str, np.ndarray]:
    """The filter's tables, and the grid, codes and moves that they are of."""
    tables = {
        name: np.asarray(value, float)
        for name, value in parameters._asdict().items()
        if np.all(np.isfinite(value))
    }
    return tables | {
        "grid": bayes.GRID,
        "grid_prior": bayes.PRIOR,
        "class_codes": np.array(bayes.CLASS_CODES),
        "levels": np.array(bayes.LEVELS),
        "faintest": np.array(bayes.FAINTEST),
        "first_good": np.array(bayes.FIRST_GOOD),
        "flow_code_width": np.array(float(bayes.FLOW_CODE_WIDTH)),
        "good_border": np.array(float(GOOD_BORDERS[0])),
        "corrections": np.asarray(bayes.CORRECTIONS, float),
        "begins": np.asarray(bayes.BEGINS),
        "flow_moves": np.array(FLOW_MOVES),
    }
