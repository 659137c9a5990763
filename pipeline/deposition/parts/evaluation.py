"""Every composer on one part, beside on-off control and full-part ILC; judged by the true flow of the
machine, on a real one by the forecast."""

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
    predicted beforehand (NaN where nothing predicts it), and the largest error of a printed line's volume in
    % (NaN where no line is long enough)."""

    stream: int
    composer: str
    chosen: bool
    rms_percent_of_on_off: float
    predicted_percent: float
    worst_line_volume_percent: float
    y: np.ndarray


class Judging(NamedTuple):
    """What composers are judged by: the nominal and the true extruders by material, the latter empty where
    there is only a real machine; the laws' settings and the noise; the updates of full-part ILC; the bead's
    area, and the shortest line whose volume counts."""

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
) -> list[ComposerScore]:
    """Scores of all composers on all streams.

    On a real machine nobody knows the true flow: a composer scores the upper end of its forecast, its flow is
    the chain's, and full-part ILC is left out. The worst line of the chosen composer is the farther end of
    its interval in `lines`, for the flow of the chain that made the command is no measure of it; there is
    none if the forecast may not be believed.
    """
    scores, Ts, drive = [], judging.laws.sample_time_s, judging.laws.drive
    ends = np.maximum(np.abs(lines.low_percent), np.abs(lines.high_percent))
    for i, stream in enumerate(composed.streams):
        nominal, plant = judging.nominals[stream.material], judging.plants.get(stream.material)
        long_enough = (lines.tool == stream.tool) & (lines.duration_s >= judging.shortest_s - 1e-9)
        by_composer = {ON_OFF: obeyed(stream.r / nominal.gain, drive, sample_time_s=Ts)} | commands(
            learned, composed, stream, drive=drive
        )
        if plant:
            by_composer[FULL_PART_ILC] = _full_part_ilc(plant, nominal, stream, judging, rng)
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
    return scores


def _full_part_ilc(
    plant: Extruder, nominal: Extruder, stream: Stream, judging: Judging, rng: np.random.Generator
) -> np.ndarray:
    """The command after `updates` trials of the full part by the inverse of the identified model."""
    laws = judging.laws
    t = np.arange(len(stream.r)) * laws.sample_time_s
    part = Routine(t, stream.r, np.zeros(len(t)), np.zeros(len(t)), stream.r > 0, 0.0, (0.0, 0.0), 0.0)
    measure = training.simulated(plant, rng, judging.noise, steady_flow=float(stream.r.max()), settings=laws)
    law = training.model_inverse(part, laws)
    u0 = stream.r / nominal.gain
    trials = ilc.learn(law, measure, u0, stream.r, trials=judging.updates, rise=laws.rise)
    return ilc.next_step(trials, stream.r, law, rise=laws.rise).u


def _off(composed: Composed, tool: int, y: np.ndarray, judging: Judging) -> np.ndarray:
    """By how much in % the volume of each line (L,) is off under the flow y (T,) of its tool; NaN for the
    lines of others."""
    mine, start, stop = reaches(composed, tool)
    planned, off = judging.bead_area_mm2 * composed.lines.length, np.full(len(composed.lines.line), np.nan)
    made = volume_between(y, start, stop, sample_time_s=composed.sample_time_s)
    off[mine] = np.abs(100 * (made / planned[mine] - 1))
    return off
