"""Every composer on one part beside on-off control and beside learning the whole structure, judged by the
true flow of the machine; on a real one, by the forecast."""

from typing import NamedTuple

import numpy as np

from pipeline.deposition import ilc, training
from pipeline.deposition.chain import forecast
from pipeline.deposition.composition import Composed, Learned, Stream, commands
from pipeline.deposition.conformance import line_volumes
from pipeline.deposition.extruder import Extruder, Routine, flow
from pipeline.deposition.training import Noise, Settings

ON_OFF, WHOLE = "on_off", "ilc"


class Score(NamedTuple):
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


def evaluate(
    learned: Learned,
    composed: Composed,
    *,
    nominals: dict[str, Extruder],
    plants: dict[str, Extruder],
    rng: np.random.Generator,
    noise: Noise,
    updates: int,
    bead_area_mm2: float,
    shortest_s: float,
    s: Settings,
) -> list[Score]:
    """Scores of all composers on all streams. `plants` are the true machines by material, empty where there
    is only a real one: then the identified chain forecasts the flow, and the whole structure is not learned.
    Volumes count for lines of at least shortest_s."""
    scores = []
    for i, stream in enumerate(composed.streams):
        nominal, plant = nominals[stream.material], plants.get(stream.material)
        chain = next(k.chain.extruder for k in learned.materials if k.material == stream.material)
        asked = {ON_OFF: np.clip(stream.r / nominal.gain, -s.limit, s.limit)} | commands(
            learned, composed, stream, limit=s.limit
        )
        if plant:
            asked[WHOLE] = _learned(plant, nominal, stream, rng, noise, updates, s)
        predicted = {
            p.composer: p.rms_percent_of_on_off for p in composed.predictions if p.tool == stream.tool
        }
        yardstick = np.nan
        for name, u in asked.items():
            y = (
                flow(plant, u, sample_time_s=s.sample_time_s, limit=s.limit)
                if plant
                else forecast(chain, u, sample_time_s=s.sample_time_s)
            )
            error = float(np.linalg.norm(y - stream.r))
            yardstick = error if name == ON_OFF else yardstick
            worst = _worst_line(learned, composed, i, y, bead_area_mm2, shortest_s)
            percent = 100 * error / max(yardstick, 1e-12)
            scores.append(
                Score(i, name, name == stream.composer, percent, predicted.get(name, np.nan), worst, y)
            )
    return scores


def _learned(
    plant: Extruder,
    nominal: Extruder,
    stream: Stream,
    rng: np.random.Generator,
    noise: Noise,
    updates: int,
    s: Settings,
) -> np.ndarray:
    """The command after `updates` trials of the whole structure by our law."""
    t = np.arange(len(stream.r)) * s.sample_time_s
    whole = Routine(t, stream.r, np.zeros(len(t)), np.zeros(len(t)), stream.r > 0, 0.0, (0.0, 0.0), 0.0)
    measure = training.simulated(plant, rng, noise, steady_flow=float(stream.r.max()), s=s)
    law = training.ours(whole, s)
    trials = ilc.learn(
        law, measure, training.on_off(stream.r, nominal), stream.r, trials=updates, rise=s.rise
    )
    return ilc.next_step(trials, stream.r, law, rise=s.rise).u


def _worst_line(
    learned: Learned, composed: Composed, i: int, y: np.ndarray, bead_area_mm2: float, shortest_s: float
) -> float:
    """Largest error in % of the volume of a line of stream i under the flow y."""
    mine = composed._replace(
        streams=(*composed.streams[:i], composed.streams[i]._replace(y=y), *composed.streams[i + 1 :])
    )
    volumes = line_volumes(mine, learned.library, bead_area_mm2=bead_area_mm2)
    judged = (volumes.tool == composed.streams[i].tool) & (volumes.duration_s >= shortest_s - 1e-9)
    return float(np.abs(volumes.error_percent[judged]).max()) if judged.any() else float("nan")
