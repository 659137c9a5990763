"""Compares every composer on one part with on-off control and full-part ILC. They are judged by the true flow
of a simulated machine, or by the forecast for a real one."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.deposition.drive import obeyed
from pipeline.deposition.extruder import Extruder, Routine, flow
from pipeline.deposition.learning import ilc, training
from pipeline.deposition.learning.training import LawSettings, Noise
from pipeline.deposition.parts.chain import forecast
from pipeline.deposition.parts.composition import Composed, LearnedLibrary, Stream, commands
from pipeline.deposition.parts.conformance import LineVolumes, reaches, volume_between

ON_OFF, FULL_PART_ILC = "on_off", "ilc"


class ComposerScore(NamedTuple):
    """One composer on one stream: r.m.s. error of its flow y (T,) in % of on-off control's, as judged and as
    predicted beforehand (NaN without a prediction), and the largest error of a printed line's volume in %
    (NaN if no line is long enough, or if the forecast of a real machine may not be believed)."""

    stream: int
    composer: str
    chosen: bool
    rms_percent_of_on_off: float
    predicted_percent: float
    worst_line_volume_percent: float
    y: np.ndarray


class Learning(NamedTuple):
    """One composer on one stream after a number of prints: r.m.s. error of its true flow in % of on-off
    control's."""

    stream: int
    composer: str
    prints: int
    rms_percent_of_on_off: float


class Judging(NamedTuple):
    """The data for judging composers: the nominal and the true extruders by material, the latter empty for a
    real machine; the laws' settings and the noise; the updates of full-part ILC; the bead's area, and the
    duration of the shortest line whose volume counts."""

    nominals: dict[str, Extruder]
    plants: dict[str, Extruder]
    laws: LawSettings
    noise: Noise
    updates: int
    bead_area_mm2: float
    shortest_s: float


def evaluate(
    learned: LearnedLibrary,
    composed: Composed,
    lines: LineVolumes,
    judging: Judging,
    rng: np.random.Generator,
) -> tuple[list[ComposerScore], list[Learning]]:
    """Returns the scores of all composers on all streams and, on a simulated machine, the error of full-part
    ILC after each of its prints.

    The true flow of a real machine is unknown. There a composer's score is the upper end of its forecast, its
    flow is the chain's, and full-part ILC is left out. The worst line of the chosen composer is then the
    farther end of its interval in `lines`, because the chain that made the command cannot measure its error.
    It is NaN if the forecast may not be believed.
    """
    scores, course, Ts, drive = [], [], judging.laws.sample_time_s, judging.laws.drive
    ends = np.maximum(np.abs(lines.low_percent), np.abs(lines.high_percent))
    for i, stream in enumerate(composed.streams):
        nominal, plant = judging.nominals[stream.material], judging.plants.get(stream.material)
        long_enough = (lines.tool == stream.tool) & (lines.duration_s >= judging.shortest_s - 1e-9)
        by_composer = _commands(learned, composed, stream, judging)
        if plant:
            learning = _full_part_ilc(plant, nominal, stream, judging, rng)
            by_composer[FULL_PART_ILC] = learning[-1]
            errors = [_true_error(plant, u, stream, judging) for u in (by_composer[ON_OFF], *learning)]
            course += [
                Learning(i, FULL_PART_ILC, prints, 100 * error / max(errors[0], 1e-12))
                for prints, error in enumerate(errors[1:], 1)
            ]
        predicted = {p.composer: p for p in composed.predictions if p.tool == stream.tool}
        yardstick = np.nan
        for name, u in by_composer.items():
            y = (
                flow(plant, u, sample_time_s=Ts, drive=drive)
                if plant
                else forecast(stream.learned.chain.extruder, u, sample_time_s=Ts)
            )
            error = float(np.linalg.norm(y - stream.r))
            yardstick = error if name == ON_OFF else yardstick
            off = ends if name == stream.composer and not plant else _off(composed, stream.tool, y, judging)
            known = long_enough.any() and (plant or stream.judged.judged)
            worst = float(off[long_enough].max()) if known else np.nan
            told = predicted.get(name)
            percent = told.high if told and not plant else 100 * error / max(yardstick, 1e-12)
            middle = told.median if told else np.nan
            scores.append(ComposerScore(i, name, name == stream.composer, percent, middle, worst, y))
    return scores, course


def learned_from(
    learned: LearnedLibrary, composed: Composed, judging: Judging, prints: Sequence[int]
) -> list[Learning]:
    """Returns the true error of every composer on every stream of a part that was composed after fewer
    trials; `prints` are those of each stream's material."""
    rows = []
    for i, (stream, count) in enumerate(zip(composed.streams, prints, strict=True)):
        plant = judging.plants[stream.material]
        by_composer = _commands(learned, composed, stream, judging)
        errors = {name: _true_error(plant, u, stream, judging) for name, u in by_composer.items()}
        yardstick = max(errors.pop(ON_OFF), 1e-12)
        rows += [Learning(i, name, count, 100 * error / yardstick) for name, error in errors.items()]
    return rows


def _commands(
    learned: LearnedLibrary, composed: Composed, stream: Stream, judging: Judging
) -> dict[str, np.ndarray]:
    """Returns the command (T,) of on-off control, by the gain known beforehand, and of every composer."""
    laws, gain = judging.laws, judging.nominals[stream.material].gain
    on_off = obeyed(stream.r / gain, laws.drive, sample_time_s=laws.sample_time_s)
    return {ON_OFF: on_off} | commands(learned, composed, stream, drive=laws.drive)


def _true_error(plant: Extruder, u: np.ndarray, stream: Stream, judging: Judging) -> float:
    """Returns the norm of the true flow's error for the command u (T,), mm^3/s."""
    laws = judging.laws
    y = flow(plant, u, sample_time_s=laws.sample_time_s, drive=laws.drive)
    return float(np.linalg.norm(y - stream.r))


def _full_part_ilc(
    plant: Extruder, nominal: Extruder, stream: Stream, judging: Judging, rng: np.random.Generator
) -> list[np.ndarray]:
    """Returns the command after the first print with on-off control and after each of `updates` trials of the
    full part, by the inverse of the identified model."""
    laws = judging.laws
    t = np.arange(len(stream.r)) * laws.sample_time_s
    part = Routine(t, stream.r, np.zeros(len(t)), np.zeros(len(t)), stream.r > 0, 0.0, (0.0, 0.0), 0.0)
    measure = training.simulated(plant, rng, judging.noise, steady_flow=float(stream.r.max()), settings=laws)
    law = training.model_inverse(part, laws)
    u0 = stream.r / nominal.gain
    trials = ilc.learn(law, measure, u0, stream.r, trials=judging.updates, rise=laws.rise)
    last = ilc.next_step(trials, stream.r, law, rise=laws.rise).u
    return [*(trial.u for trial in trials[1:]), last]


def _off(composed: Composed, tool: int, y: np.ndarray, judging: Judging) -> np.ndarray:
    """Returns by how much in % the volume of each line (L,) is off with the flow y (T,) of its tool; NaN for
    lines of other tools."""
    mine, start, stop = reaches(composed, tool)
    planned, off = judging.bead_area_mm2 * composed.lines.length, np.full(len(composed.lines.line), np.nan)
    made = volume_between(y, start, stop, sample_time_s=composed.sample_time_s)
    off[mine] = np.abs(100 * (made / planned[mine] - 1))
    return off
