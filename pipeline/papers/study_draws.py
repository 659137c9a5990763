"""The published random data behind the temperature study's figures."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from pipeline.store import artifacts


def read_published(folder: str | Path = "datasets/published") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reads K0 (7, 11) of the study, and its probing log as inputs (15000, 7) and outputs (15000, 5). Raises
    ValueError if the files cannot be read."""
    try:
        K0 = np.loadtxt(Path(folder) / "algorithm1_K0_seed10.csv", delimiter=",", ndmin=2)
        log = pq.read_table(Path(folder) / "probing_log_seed1.parquet")
        u, y = (
            np.column_stack([log[f"{letter}{i}"].to_numpy() for i in range(1, count + 1)])
            for letter, count in (("u", 7), ("y", 5))
        )
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(
            f"{folder}: the study's draws cannot be read ({artifacts.reason(error)}); "
            f"restore them with `git checkout {folder}`"
        ) from None
    return K0, u, y
