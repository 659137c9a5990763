"""The record in the form for identification and learning: segments of inputs and outputs."""

from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.temperature.identification.model_choice import gapless


def segments(
    table: Mapping[str, np.ndarray], inputs: Sequence[str], outputs: Sequence[str]
) -> tuple[list[np.ndarray], list[np.ndarray], list[str]]:
    """Returns segments u (T, m) and y (T, p) of the table of ingest, with masked samples as NaN, and the
    recording of each segment.

    A segment ends at a gap and at the end of a recording. `inputs` names the signals that act on the outputs:
    first the inputs, then the disturbances.
    """
    u, y = (
        np.stack([np.where(table[f"{name}_masked"], np.nan, table[name]) for name in names], axis=1)
        for names in (inputs, outputs)
    )
    recording, segment = table["recording"], table["segment"]
    starts = np.flatnonzero((recording[1:] != recording[:-1]) | (segment[1:] != segment[:-1])) + 1
    return np.split(u, starts), np.split(y, starts), [str(recording[start]) for start in np.r_[0, starts]]


def without_gaps(
    u: Sequence[np.ndarray], y: Sequence[np.ndarray], recordings: Sequence[str]
) -> tuple[list[np.ndarray], list[np.ndarray], list[int]]:
    """Returns segments without a missing input, and the number of each segment's recording."""
    names = list(dict.fromkeys(recordings))
    pieces = [
        (a, b, names.index(name))
        for one, other, name in zip(u, y, recordings, strict=True)
        for a, b in zip(*gapless([one], [other]), strict=True)
    ]
    return [a for a, _, _ in pieces], [b for _, b, _ in pieces], [number for *_, number in pieces]


def split(
    u: Sequence[np.ndarray], y: Sequence[np.ndarray], last_share: float
) -> tuple[tuple[list[np.ndarray], list[np.ndarray]], tuple[list[np.ndarray], list[np.ndarray]]]:
    """Returns (u, y) of the first part of every segment, and of its last part, which has the share
    `last_share`."""
    cuts = [round(len(segment) * (1 - last_share)) for segment in u]
    first = [[segment[:cut] for segment, cut in zip(signal, cuts, strict=True)] for signal in (u, y)]
    last = [[segment[cut:] for segment, cut in zip(signal, cuts, strict=True)] for signal in (u, y)]
    return (first[0], first[1]), (last[0], last[1])
