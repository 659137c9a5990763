"""What a part will come to, as an interval: chains that the trials cannot tell apart, and what they all missed
on routines left out, carried to the part by kind of event and time since it; or why it is not judged."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.ndimage

from pipeline.deposition.chain import Chain, records, simulate
from pipeline.deposition.library import Training

# a sample belongs to the last event: to Start or Stop this long after it, to a Corner, a gap of at most this,
# so long after flow is wanted again
NEAR_S = 1.0
# an event begins this long ahead of its middle, as its ramp does; bins of the time since it
AHEAD_S, BIN_S = 0.2, 0.2
EVENTS = START, CORNER, STOP, STEADY, OFF = range(5)
NAMES = ("start", "corner", "stop", "steady", "off")
BINS = 12
# a residual above so many times what repeated trials of one command scatter is not noise
FACTOR = 2.5
QUANTILES = (0.05, 0.5, 0.95)


def places(r: np.ndarray, sample_time_s: float) -> np.ndarray:
    """Place (T,) of each sample of a wanted flow r (T,): event x BINS + bin of the time since it.

    Flow is wanted where r is above half of the most within NEAR_S / 2; it starts and stops there, and a gap
    of at most NEAR_S is a Corner. Later than NEAR_S after it all is steady or off.
    """
    n, near = len(r), round(NEAR_S / sample_time_s)
    on = r > 0.5 * np.maximum(scipy.ndimage.maximum_filter1d(r, near + 1, mode="constant"), 1e-12)
    edges = np.flatnonzero(np.diff(on.astype(int), prepend=0))
    rises, falls = edges[on[edges]], edges[~on[edges]]
    ahead = round(AHEAD_S / sample_time_s)
    follows = np.append(rises, n + 2 * near)[np.searchsorted(rises, falls)]
    short = follows - falls <= near
    event = np.where(on, STEADY, OFF)
    since = np.zeros(n, int)
    ends = {k: (START, k + near) for k in np.setdiff1d(rises, follows[short]).tolist()}
    for k, gap, until in zip(falls.tolist(), short.tolist(), follows.tolist(), strict=True):
        ends[k] = (CORNER, until + near) if gap else (STOP, k + near)
    for k in sorted(ends):
        kind, end = ends[k]
        begin = max(k - ahead, 0)
        event[begin:end] = kind
        since[begin:end] = np.arange(min(end, n) - begin)
    return event * BINS + np.minimum(since // round(BIN_S / sample_time_s), BINS - 1)


def mean_by_place(e: np.ndarray, seen: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Mean (..., places) of errors e (..., T) over the samples of each place (T,) that were seen (..., T); 0
    where none was."""
    one = np.zeros((len(EVENTS) * BINS, e.shape[-1]))
    one[place, np.arange(e.shape[-1])] = 1.0
    count = np.where(seen, 1.0, 0.0) @ one.T
    return (np.where(seen, e, 0.0) @ one.T) / np.maximum(count, 1.0)
