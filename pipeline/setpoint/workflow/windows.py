"""The windows that controllers are trained and judged on, as columns of a table and back."""

import collections
from collections.abc import Sequence

import numpy as np

from pipeline.setpoint.simulation.recorded import WindowTable
from pipeline.setpoint.workflow.tables import FLOW_EDGES, WINDOW_PARTS


def edges(flows: Sequence[np.ndarray]) -> np.ndarray:
    """FLOW_EDGES, of which those are left out that would leave a bin
    without a window in any of several sets of flows (w,)."""
    bounds = [min(FLOW_EDGES[0], *(float(flow.min()) for flow in flows))]
    for edge in FLOW_EDGES[1:-1]:
        if all(((flow >= bounds[-1]) & (flow < edge)).any() for flow in flows):
            bounds.append(edge)
    while len(bounds) > 1 and not all((flow >= bounds[-1]).any() for flow in flows):
        bounds.pop()
    return np.array([*bounds, max(FLOW_EDGES[-1], *(float(flow.max()) for flow in flows))])


def window_rows(tables: dict[str, WindowTable]) -> dict[str, np.ndarray]:
    """The tables of WINDOW_PARTS as columns of schema WINDOWS; flows are missing of a classifier that names
    classes only."""
    columns = collections.defaultdict(list)
    for part, table in tables.items():
        columns["part"] += [part] * len(table.named)
        columns["flow_percent"].append(np.broadcast_to(table.flow, len(table.named)))
        columns["flow_bin"].append(table.flow_bin)
        columns["flow_low_percent"].append(table.flow_edges[table.flow_bin])
        columns["flow_high_percent"].append(table.flow_edges[table.flow_bin + 1])
        columns["segment"].append(table.segment)
        columns["named"].append(table.named)
        columns["flow_seen_percent"].append(np.broadcast_to(table.flow_seen, len(table.named)))
        columns["spread"].append(np.broadcast_to(table.spread, len(table.named)))
        for c, name in enumerate(("under", "good", "over")):
            columns[f"p_{name}"].append(table.shares[:, c])
    return {name: values if name == "part" else np.concatenate(values) for name, values in columns.items()}


def window_tables(columns: dict[str, np.ndarray]) -> dict[str, WindowTable]:
    """The reverse of `window_rows`. Raises ValueError where a part of WINDOW_PARTS has no window."""
    tables = {}
    for part in WINDOW_PARTS:
        rows = np.asarray(columns["part"] == part)
        if not rows.any():
            raise ValueError(
                f"recorded windows: expected some of each part, {', '.join(WINDOW_PARTS)}, but found none of "
                f"{part}; record them again with ./run dvc repro train_classifier"
            )
        bins, first = np.unique(columns["flow_bin"][rows], return_index=True)
        low, high = (columns[f"flow_{end}_percent"][rows][first] for end in ("low", "high"))
        shares = np.stack([columns[f"p_{name}"][rows] for name in ("under", "good", "over")], axis=1)
        tables[part] = WindowTable(
            shares,
            columns["named"][rows],
            np.searchsorted(bins, columns["flow_bin"][rows]),
            columns["segment"][rows],
            np.append(low, high[-1]),
            columns["flow_seen_percent"][rows],
            columns["spread"][rows],
            columns["flow_percent"][rows],
        )
    return tables
