"""Named arrays of a learner as safetensors: what they are of, for which architecture, and the state of a training that was interrupted."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import safetensors
from safetensors.numpy import load_file, save_file

from pipeline import artifacts


def write_weights(path: str | Path, name: str, arrays: Mapping[str, np.ndarray], about: Mapping[str, str]) -> None:
    """Arrays of any shape and kind, each with its bits as they are; `about` is what a reader must know to use them. Equal arrays give equal bytes."""
    metadata = {"schema": name, **about}
    # the library writes metadata in the order of a hash that differs from process to process; one key holds all
    packed = {"beadline": "\n".join(f"{key}={metadata[key]}" for key in sorted(metadata))}
    with artifacts.beside(path) as temporary:
        save_file({key: np.asarray(array, order="C") for key, array in sorted(arrays.items())}, temporary, packed)


def read_weights(path: str | Path, name: str) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Arrays and `about` of `write_weights`. Raises ValueError where the file is missing, broken, or of another schema."""
    remedy = artifacts.remedy(path)
    try:
        arrays = load_file(path)
        with safetensors.safe_open(path, "numpy") as file:
            lines = (file.metadata() or {}).get("beadline", "").splitlines()
    except FileNotFoundError:
        raise ValueError(f"{path} is missing; {remedy}") from None
    except (OSError, safetensors.SafetensorError, ValueError) as error:
        raise ValueError(f"{path} holds no whole weights ({error}); {remedy}") from None
    about = dict(line.partition("=")[::2] for line in lines)
    found = about.pop("schema", "none")
    if found != name:
        raise ValueError(f"{path} should hold weights of {name} but has schema {found}; {remedy}")
    return arrays, about
