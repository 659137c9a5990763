"""support.safetensors of a controller's folder."""

from pathlib import Path

import numpy as np

from pipeline.deploy import machine, support
from pipeline.deploy.supervise import Exported
from pipeline.store import artifacts

SUPPORT = "support.safetensors"


def write_support(folder: Path, within: support.Support, controller_sha256: str) -> None:
    """support.safetensors of a controller's folder."""
    plants = {
        f"spread.{name}": np.stack([np.asarray(getattr(one, name), float) for one in within.spread])
        for name in within.spread[0]._fields
    }
    numbers = {k: np.asarray(v, float) for k, v in within._asdict().items() if k != "spread"}
    artifacts.write_weights(
        folder / SUPPORT, "support 2", plants | numbers, {"controller": controller_sha256}
    )


def read_support(folder: Path, made: Exported) -> support.Support | None:
    """What `write_support` wrote; None where there is none. Raises ValueError where it is of another
    controller."""
    if not artifacts.exists(folder / SUPPORT):
        return None
    arrays, about = artifacts.read_weights(folder / SUPPORT, "support 2")
    if about.get("controller") != machine.controller_sha256(made):
        raise ValueError(f"{folder / SUPPORT}: it is of another controller than the folder; export it again")
    names = type(made.model)._fields
    plants = tuple(
        type(made.model)(*(arrays[f"spread.{name}"][i] for name in names))
        for i in range(len(arrays["spread.A"]))
    )
    return support.Support(
        arrays["temperature_low"],
        arrays["temperature_high"],
        arrays["command_low"],
        arrays["command_high"],
        plants,
        arrays["noise"],
        int(arrays["steps"]),
        float(arrays["furthest"]),
        arrays["rest"],
        arrays["allowed"],
    )
