"""One plant of the family, trained by the model inverse on two speeds and two pauses,
for the tests of what is made of learned trials."""

import functools

import numpy as np

from pipeline.deposition.drive import UNLIMITED
from pipeline.deposition.extruder import Extruder, disturb, flow, routine
from pipeline.deposition.learning import ilc
from pipeline.deposition.parts.composition import LearnedLibrary, learn
from pipeline.deposition.parts.library import Training

TS, AREA, NOZZLE, RAMP = 0.02, 0.304, 0.6, 0.15
NOMINAL = Extruder(1.08, 2.7)
PLANT = Extruder(0.92, 3.2, delay_s=0.113, lag_hz=4.3, play=0.06, yield_=0.15)
CREEPING = PLANT._replace(creep_share=0.12)
INVERSE = ilc.InverseSettings(identify_trials=3, floor=0.1, order=4, cutoff_hz=5.0)
SPEEDS, PAUSES = (8.0, 5.0), (0.6, 0.3)


def protocol(speed=8.0, pause_s=0.6, ramp_s=RAMP, on_s=6, gantry_ramp_s=0.0):
    return routine(
        off_s=4,
        on_s=on_s,
        pause_s=pause_s,
        tail_s=8,
        speed=speed,
        bead_area_mm2=AREA,
        ramp_s=ramp_s,
        gantry_ramp_s=gantry_ramp_s,
        sample_time_s=TS,
    )


@functools.cache
def trainings(plant: Extruder, material: str = "A", updates: int = 12) -> tuple[Training, ...]:
    rng, out = np.random.default_rng(5), []
    for speed in SPEEDS:
        for pause in PAUSES:
            training_routine = protocol(speed, pause, on_s=11)
            steady_flow = float(training_routine.r.max())
            law = ilc.InverseLaw(training_routine.r, INVERSE, drive=UNLIMITED, sample_time_s=TS)

            def measure(u, steady_flow=steady_flow):
                y = flow(plant, u, sample_time_s=TS)
                return ilc.Trial(
                    u, disturb(y, rng, steady_flow=steady_flow, white=0.03, drift=0.01, gain=0.01), y
                )

            trials = ilc.learn(
                law, measure, training_routine.r / NOMINAL.gain, training_routine.r, trials=updates, rise=0.1
            )
            out.append(
                Training(
                    material,
                    NOZZLE,
                    training_routine,
                    np.array([t.u for t in trials]),
                    np.array([t.y for t in trials]),
                )
            )
    return tuple(out)


@functools.cache
def learned(plant: Extruder) -> LearnedLibrary:
    """What was learned of the plant as material A, and the same under the name of B."""
    made = learn(trainings(plant), sample_time_s=TS)
    columns = made.library.columns + tuple(basis._replace(material="B") for basis in made.library.columns)
    return made._replace(
        library=made.library._replace(columns=columns),
        materials=(*made.materials, made.materials[0]._replace(material="B")),
    )


def percent_of_on_off(plant: Extruder, u: np.ndarray, r: np.ndarray) -> float:
    on_off = flow(plant, r / NOMINAL.gain, sample_time_s=TS) - r
    return 100 * float(np.linalg.norm(flow(plant, u, sample_time_s=TS) - r) / np.linalg.norm(on_off))
