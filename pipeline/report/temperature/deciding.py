"""The case that decides the temperature loop: whose runs are drawn, which output, and for how long."""

import numpy as np

from pipeline.report.shared import charts
from pipeline.report.shared.sources import Sources
from pipeline.report.temperature.judgement import Judgement
from pipeline.report.temperature.pictures import list_drawn
from pipeline.verdict.evidence import Table, entry
from pipeline.verdict.temperature import comparison


def runs_of(sources: Sources, judged: Judgement, table: Table) -> tuple[dict[str, np.ndarray], str]:
    """Rows of the deciding case under everybody whom the temperature page draws, and the output that the
    subject of the verdict leaves furthest from its reference."""
    runs = {
        who: np.flatnonzero((table["contestant"] == who) & (table["case_name"] == "deciding"))
        for who in list_drawn(sources, judged)
    }
    runs = {who: rows for who, rows in runs.items() if len(rows)}
    names = [output.name for output in sources.declared.machine.outputs]
    if not runs:
        return {}, names[0]
    rows = runs.get(judged.subject, next(iter(runs.values())))
    settled = entry(comparison(sources.metrics), "settled_steps")
    last = rows[-(settled if isinstance(settled, int) else max(len(rows) // 10, 1)) :]
    apart = [float(np.abs(np.mean(table[name][last] - table[f"{name}_reference"][last]))) for name in names]
    return runs, names[int(np.argmax(np.nan_to_num(apart, nan=np.inf)))]


def until_settled(table: Table, runs: dict[str, np.ndarray], zone: str) -> float:
    """Three times as long as the slowest takes to come within 2 % of its way to a constant reference; to the
    end of one that moves."""
    rows = np.concatenate(list(runs.values()))
    time, away = table["time_s"][rows], np.abs(table[zone][rows] - table[f"{zone}_reference"][rows])
    if np.ptp(table[f"{zone}_reference"][rows]) > 0 or not np.isfinite(away).all():
        return float(time.max())
    outside = time[away > 0.02 * away.max()]
    return float(min(3 * outside.max(initial=0.0) + 1, time.max()))


def degrees(table: Table, rows: np.ndarray, zone: str) -> charts.Axis:
    """Room for a zone and its reference; what is lost runs along the edge."""
    values = np.concatenate([table[zone][rows], table[f"{zone}_reference"][rows]])
    values = values[np.isfinite(values) & (np.abs(values) < 1e4)]
    if not len(values):
        return charts.linear(0, 1)
    room = 0.05 * float(np.ptp(values)) or 1.0
    return charts.linear(float(values.min()) - room, float(values.max()) + room)
