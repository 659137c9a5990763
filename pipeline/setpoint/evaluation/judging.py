"""Compares setpoint controllers on the same cases (21 wrong starts, clogs, and good starts that must not be
disturbed) on recorded segments, and chooses the default controller.

The figures depend on which segments a classifier happened to record. So segments are divided into pools that
share none, with equally many runs on each pool. The variation between pools, compared with that of
independent runs, shows how many independent runs the segments are worth (`effective`).
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pipeline.setpoint.agents.criteria import CLOG_STEP, NO_CONTROL, STEPS, harm_bar
from pipeline.setpoint.agents.score import Outcomes, outcomes
from pipeline.setpoint.agents.trials import STARTS, good_starts, starts
from pipeline.setpoint.controllers import of_kind
from pipeline.setpoint.published import BEST_FLOW
from pipeline.setpoint.simulation.recorded import WindowTable, recorded_windows
from pipeline.setpoint.simulation.simulator import (
    EpisodeConditions,
    SetpointController,
    WindowSource,
    paper_windows,
    rollout,
)
from pipeline.statistics import mean_of_pools, pooled_share

GOOD_STARTS = np.linspace(92.5, 107.5, STARTS)  # percent: flows of good prints
# scale and exponent: it shows 12 % more at 100 %, and ratios smaller than they are
OTHER_CAMERA = (1.12, 0.8)
# percentage points within which the worst cases of two controllers count as equal
ALIKE_POINTS = 2.0


class Case(NamedTuple):
    """Conditions (n,); persistence 0 selects the paper's windows. For the flow q the camera shows 100 scale
    (q / 100)^exponent percent. `good`: runs begin at good starts, and disturbing them is what counts."""

    conditions: EpisodeConditions
    scale: float = 1.0
    exponent: float = 1.0
    good: bool = False


# ---- what is asked


def all_cases(runs: int, *, segment_mean_decisions: float) -> dict[str, Case]:
    """Returns every case by name, with `runs` from each of 21 starts. First, classes that are right in 70 %
    of windows, on the paper's simulator. Then recorded windows: "fresh", with a new segment for each window,
    and "sticky", with segments that last segment_mean_decisions. Some clog to a factor of 0.6 or 0.75 at step
    60. Then good starts, with a correct camera and with a camera of another scale."""
    fresh = starts(runs, accuracy=0.7)
    one = jnp.ones_like(fresh.flow)
    lasting = {"persistence": segment_mean_decisions * one}
    sticky = fresh._replace(**lasting)
    clog, half_clog = ({"clog": left * one, "clog_step": CLOG_STEP * one} for left in (0.6, 0.75))
    perfect, in_band = (
        good_starts(flows, runs)._replace(**lasting) for flows in (np.full(STARTS, BEST_FLOW), GOOD_STARTS)
    )
    return {
        "accuracy 0.7": Case(fresh._replace(persistence=0.0 * one)),
        "recorded, fresh, clog": Case(fresh._replace(**clog)),
        "recorded, sticky": Case(sticky),
        "recorded, sticky, clog": Case(sticky._replace(**clog)),
        "recorded, sticky, half clog": Case(sticky._replace(**half_clog)),
        "perfect": Case(perfect, good=True),
        "in band": Case(in_band, good=True),
        "in band, another camera": Case(in_band, *OTHER_CAMERA, good=True),
    }


def counts(case: str) -> bool:
    """Returns whether a case begins at wrong starts. Controllers are ranked by those; good starts show
    harm."""
    return not case.startswith(("perfect", "in band"))


class DistortedWindows(NamedTuple):
    """Recorded windows, and how the camera changes the flow that they show."""

    recorded: WindowSource
    scale: jax.Array
    exponent: jax.Array


def shown_by(recorded: WindowSource, case: Case) -> WindowSource:
    """Returns the windows of this case: the paper's if conditions.persistence is 0, else recorded ones at the
    flow that the camera shows for the true one. One compiled program serves all cases."""
    return WindowSource(
        _shown, DistortedWindows(recorded, jnp.float32(case.scale), jnp.float32(case.exponent))
    )


def _shown(table: DistortedWindows, conditions: EpisodeConditions, flow, segment, u) -> tuple[jax.Array, ...]:
    seen = BEST_FLOW * table.scale * (flow / BEST_FLOW) ** table.exponent
    paper = paper_windows().draw((), conditions, flow, segment, u)
    recorded = table.recorded.draw(table.recorded.table, conditions, seen, segment, u)
    return tuple(jnp.where(conditions.persistence > 0, *pair) for pair in zip(recorded, paper, strict=True))


# ---- runs on pools of segments


def pools(tables: Sequence[WindowTable], size: int) -> list[list[WindowSource]]:
    """Divides each table's segments into pools of `size` that share none; `size` is reduced if needed, so
    that each table has at least two. The sources differ only in the errors of their segments and share one
    compiled program. A table with classes only is one pool, because the errors of its segments are
    unknown."""
    sources = [recorded_windows(table) for table in tables]
    arrays = [{name: np.asarray(a) for name, a in source.table._asdict().items()} for source in sources]
    room = {name: max(len(own[name]) for own in arrays) for name in arrays[0]}
    size = max(min(size, *(len(own["bias"]) // 2 for own in arrays)), 1)

    def filled(name: str, a: np.ndarray) -> np.ndarray:
        # padding is never drawn: no flow lies beyond infinity, and `seen` gives the number of real windows
        fill = np.inf if name == "log_flow" else 0
        return np.pad(a, [(0, room[name] - len(a)), *[(0, 0)] * (a.ndim - 1)], constant_values=fill)

    def pool(source: WindowSource, own: dict[str, np.ndarray], bias: np.ndarray) -> WindowSource:
        wide = {name: filled(name, a) for name, a in own.items() if name not in ("bias", "seen")}
        wide |= {"bias": np.sort(bias), "seen": np.array([own["seen"][0], size], np.int32)}
        return source._replace(table=source.table._replace(**jax.tree.map(jnp.asarray, wide)))

    made = []
    for source, own in zip(sources, arrays, strict=True):
        dealt = np.random.default_rng(0).permutation(own["bias"])
        parts = dealt[: len(dealt) // size * size].reshape(-1, size)
        made.append([pool(source, own, part) for part in parts])
    return made


class Runs(NamedTuple):
    """Flow and temperature (P, n, STEPS + 1) of n runs on each of P pools; the start comes first."""

    flow: np.ndarray
    temperature: np.ndarray


def simulate(
    controller: SetpointController,
    parameters: Any,
    case: Case,
    segments: Sequence[WindowSource],
    key: jax.Array,
) -> Runs:
    """Simulates the runs (n,) of a case on each pool of `pools`. With the same key every controller gets the
    same random numbers."""
    trajectories = [
        _simulated(controller, parameters, shown_by(pool, case), case.conditions, jax.random.fold_in(key, k))
        for k, pool in enumerate(segments)
    ]
    return Runs(*(np.stack(a) for a in zip(*trajectories, strict=True)))


@eqx.filter_jit
def _simulated(controller, parameters, windows: WindowSource, conditions: EpisodeConditions, key):
    trajectory = rollout(controller, parameters, windows, conditions, key, steps=STEPS)
    return trajectory.flow, trajectory.temperature


def become(of: Runs) -> Outcomes:
    """Returns the outcomes of all runs, pool by pool (P n,)."""
    return outcomes(*(a.reshape(-1, STEPS + 1) for a in of))


# ---- the choice


class DefaultChoice(NamedTuple):
    """The default controller. `worst`: percentage of its runs that reach and keep the target in its worst
    case, on segments not used to choose it. `refused`: controllers that may not run, each with the reason.
    `sentence`: why it is the default."""

    name: str
    worst: float
    case: str
    refused: dict[str, str]
    sentence: str


Judged = Mapping[str, Outcomes]  # what became of one controller's runs, by case


def choose(
    judged: Mapping[str, Judged], segments: int, *, simplest_first: Sequence[str], bars: Mapping[str, float]
) -> DefaultChoice:
    """Returns the default controller: among those that disturb good prints no more than allowed, the simplest
    whose worst case lies within ALIKE_POINTS of the best.

    A controller is refused if, from good starts, it leaves +-25 % significantly more often than bars[case]
    percent. `segments`: number of pools that the runs are on. Raises ValueError if all are refused.
    """
    refused = {name: why for name, of in judged.items() if (why := harmful(of, segments, bars))}
    worst = {
        name: worst_case(judged[name]) for name in simplest_first if name in judged and name not in refused
    }
    if not worst:
        raise ValueError(
            f"choose: expected a contestant that does no harm, found none of {', '.join(judged)}; "
            f'add "{NO_CONTROL}"'
        )
    best = max(share for share, _ in worst.values())
    name = next(name for name, (share, _) in worst.items() if share >= best - ALIKE_POINTS)
    share, case = worst[name]
    others = [f"{other} {value:.1f} % ({where})" for other, (value, where) in worst.items() if other != name]
    beside = f"; of the others that may run: {', '.join(others)}" if others else "; nothing else may run"
    sentence = (
        f"{name} is the default: on the segments to choose on {share:.1f} % of its runs settle and stay in "
        f"its worst case ({case}){beside}."
    )
    return DefaultChoice(name, share, case, refused, sentence)


def worst_case(judged: Judged) -> tuple[float, str]:
    """Returns the lowest percentage of runs that reach and keep the target, and its case; of equal ones the
    first."""
    shares = [(100.0 * float(of.stay.mean()), case) for case, of in judged.items() if counts(case)]
    return min(shares, key=lambda pair: pair[0])


def harmful(judged: Judged, segments: int, bars: Mapping[str, float]) -> str:
    """Returns in which case a controller leaves +-25 % significantly more often than its limit, in words;
    else ""."""
    for case, bar in bars.items():
        share = pooled_share(judged[case].beyond[:, -1].reshape(segments, -1))
        if share.low > bar:
            return f"leaves +-25 % in {share.percent:.1f} % of the runs ({case}), of at most {bar:g} %"
    return ""


def harm_limits(cases: Sequence[str], *, perfect: float, in_band: float) -> dict[str, float]:
    """Returns, by case, the percentage of runs that may leave +-25 %. With a camera of another scale harm is
    reported but has no limit, because no controller can detect the scale."""
    limits = {name: harm_bar(name, perfect=perfect, in_band=in_band) for name in cases}
    return {name: limit for name, limit in limits.items() if limit is not None}


def compare(judged: Mapping[str, Judged], pools: int, *, segments: int) -> dict[str, Any]:
    """Compares the first model-based controller (a) with the first data-driven one (b). `difference`: by how
    many points more runs of a reach and keep the target, averaged over the cases from wrong starts, with its
    90 % interval. Both have the same pools and random numbers, run by run. `winner`: None if the interval
    contains zero. `needed`: how many more segments would decide; None if decided, or if no number would."""
    a, b = of_kind("model-based"), of_kind("data-driven")
    pair: dict[str, Any] = {"a": a, "b": b, "cases": 0, "segments": segments}
    if pools < 2 or not {a, b} <= judged.keys():
        return pair
    gaps = [of.stay.astype(float) - judged[b][case].stay for case, of in judged[a].items() if counts(case)]
    gap = mean_of_pools(100.0 * np.mean(gaps, axis=0).reshape(pools, -1).mean(axis=1), level=0.9)
    told, half = gap.low > 0 or gap.high < 0, (gap.high - gap.low) / 2
    needed = segments * ((half / gap.value) ** 2 - 1) if gap.value else np.inf
    return pair | {
        "cases": len(gaps),
        "difference": gap.value,
        "low": gap.low,
        "high": gap.high,
        "winner": (a if gap.value > 0 else b) if told else None,
        "needed": None if told or not np.isfinite(needed) else int(np.ceil(needed)),
    }
