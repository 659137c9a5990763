"""`beadline replay` of recorded frames: the loop of `beadline shadow`, if CONTROLLER's folder holds the
classifier and the filter that evaluate_setpoint judged."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pipeline.commands.shadow import deploy
from pipeline.deploy import to_setpoint
from pipeline.setpoint.agents.flow_filter import FlowFilter
from pipeline.store import artifacts


def ready(folder: Path) -> deploy.Ready:
    """The loop that evaluate_setpoint judged, without the levels of a camera, which were not exported. Raises
    ValueError if the folder's numbers are others, and if a stage has not run."""
    judged = deploy.ready(None)
    name, decides = judged.deployed.name, judged.deployed.parameters
    if not isinstance(decides, FlowFilter):
        raise ValueError(
            f"datasets/evaluate_setpoint/choice.json: expected a controller with a filter, found {name!r}, "
            "so what was exported is not what it judged; export again with ./run dvc repro export_controllers"
        )
    for file, arrays in to_setpoint.weights(deploy.trained().model, decides).items():
        _check(folder / file, to_setpoint.FILES[file][0], arrays)
    return judged


def _check(path: Path, schema: str, judged: Mapping[str, np.ndarray]) -> None:
    """Raises ValueError naming the first array of a file that is not as it was judged."""
    found, _ = artifacts.read_weights(path, schema)
    for name in sorted({*found, *judged}):
        if name in found and name in judged and np.array_equal(found[name], judged[name]):
            continue
        raise ValueError(
            f"{path}: expected the numbers that evaluate_setpoint judged, found others in {name}; make the "
            "folder again with ./run dvc repro export_controllers, or replay in the project it was made in"
        )
