"""The record of ingest as the learners take it, and the draws behind the temperature study's figures."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from pipeline.store import artifacts
from pipeline.temperature.workflow import tables


def read_published(folder: str | Path = "datasets/published") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The draws behind the temperature study's figures: K0 (7, 11), and its probing
    log as inputs (15000, 7) and outputs (15000, 5)."""
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


def read_record(
    path: str | Path, inputs: Sequence, outputs: Sequence
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The record of ingest as segments u (T, m) and y (T, p), masked samples as NaN; a
    segment ends at a gap and at the end of a recording. `inputs` has what acts on the outputs, disturbances
    after the inputs."""
    return read_recordings(path, inputs, outputs)[:2]


def read_recordings(
    path: str | Path, inputs: Sequence, outputs: Sequence
) -> tuple[list[np.ndarray], list[np.ndarray], list[str]]:
    """As `read_record`, and the recording that each segment is from."""
    table = artifacts.read_table(path, tables.record(inputs, outputs))
    columns = [
        np.stack([np.where(table[f"{s.name}_masked"], np.nan, table[s.name]) for s in signals], axis=1)
        for signals in (inputs, outputs)
    ]
    first = (table["recording"][1:] != table["recording"][:-1]) | (
        table["segment"][1:] != table["segment"][:-1]
    )
    starts = np.flatnonzero(first) + 1
    recordings = [str(table["recording"][start]) for start in np.r_[0, starts]]
    return np.split(columns[0], starts), np.split(columns[1], starts), recordings
