"""How late a camera is: on a camera that shares no code with the renderer, whatever the extruder does."""

import math

import cv2
import numpy as np
import pytest

from pipeline.deposition.camera import readings
from pipeline.deposition.camera.readings import Latency
from pipeline.deposition.extruder import Extruder, flow, routine
from tests.foreign.camera import GROUNDS, Eye, trial

EYE = Eye(height=120, width=240, mm_per_px=0.02)
ROUTINE = routine(
    off_s=1, on_s=2, pause_s=0.6, tail_s=1, speed=8.0, bead_area_mm2=0.304, ramp_s=0.15, sample_time_s=0.02
)
# measured columns, px of a reading
FIRST, STEP_PX = 64, 4


def told(eye: Eye, delay_s: float = 0.1, seed: int = 3) -> Latency:
    """The latency of a short trial of an extruder with this delay."""
    plant = Extruder(1.0, 0.8, delay_s=delay_s, lag_hz=4.0, play=0.05, yield_=0.1)
    laid = flow(plant, ROUTINE.r / 1.08, sample_time_s=0.02)
    frames = list(
        trial(
            eye, ROUTINE.time_s, laid, ROUTINE.position, np.random.default_rng(seed), hz=30,
            contact_angle_deg=90.0,
        )
    )  # fmt: skip
    size = ((eye.width - FIRST) // STEP_PX, 12)
    signals = [cv2.resize(frame[:, FIRST:], size, interpolation=cv2.INTER_AREA) for _, frame in frames]
    return readings.estimate_latency(
        np.array([time for time, _ in frames]), np.array(signals),
        (ROUTINE.time_s, ROUTINE.position), step_mm=-STEP_PX * eye.mm_per_px,
    )  # fmt: skip


@pytest.mark.parametrize("ground", GROUNDS)
@pytest.mark.parametrize(("dark", "late_s"), [(False, 0.0), (True, 0.1), (False, 0.047)])
def test_the_latency_is_told_within_three_milliseconds_on_any_ground(ground, dark, late_s):
    one = told(EYE._replace(ground=ground, dark=dark, latency_s=late_s))
    assert one.latency_s == pytest.approx(late_s, abs=0.003)
    assert one.deviation_s < 0.003


def test_the_plant_s_delay_is_no_latency():
    assert [told(EYE, delay_s=delay).latency_s for delay in (0.0, 0.2)] == pytest.approx([0, 0], abs=0.003)


def test_pictures_of_noise_tell_no_latency():
    time = np.arange(150) / 30
    for seed in range(4):
        noise = np.random.default_rng(seed).normal(100, 3, (150, 12, 40))
        gantry = (ROUTINE.time_s, ROUTINE.position)
        assert readings.estimate_latency(time, noise, gantry, step_mm=-0.08) == readings.UNTOLD


def test_at_an_even_speed_no_latency_is_told():
    time = np.arange(0, 5, 0.02)
    ground = np.random.default_rng(1).normal(0, 10, 4000)
    frames = np.arange(0, 5, 1 / 30)
    signals = np.array(
        [[np.interp(8 * t + 0.08 * np.arange(40), np.arange(4000) * 0.02, ground)] for t in frames]
    )
    assert readings.estimate_latency(frames, signals, (time, 8 * time), step_mm=0.08) == readings.UNTOLD


def test_several_recordings_count_by_their_certainty_and_scatter():
    # by hand: weights 1 and 1/4 of 0.02 and 0.03 give 0.022; they part by less than they say
    one = readings.pool_latencies([Latency(0.02, 0.01), Latency(0.03, 0.02), readings.UNTOLD])
    assert one.latency_s == pytest.approx(0.022)
    assert one.deviation_s == pytest.approx(1 / math.sqrt(1 / 0.01**2 + 1 / 0.02**2))
    # two that contradict each other are as uncertain as they part
    assert readings.pool_latencies([Latency(0.0, 0.001), Latency(0.1, 0.001)]).deviation_s > 0.04
    assert readings.pool_latencies([]) == readings.UNTOLD
