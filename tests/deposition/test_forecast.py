"""Forecasts: where a sample stands, what is carried to a part, whether the truth lies within, and what is not
judged with its reason."""

import numpy as np
import pytest
from scipy.ndimage import uniform_filter1d

from pipeline.deposition.extruder import flow
from pipeline.deposition.parts import forecast
from pipeline.deposition.parts.composition import learn
from pipeline.deposition.parts.forecast import BINS, CORNER, OFF, START, STEADY, STOP
from tests.deposition.trained import PLANT, TS, learned, protocol, trainings
from tests.foreign import parts as foreign_parts

MATERIAL = learned(PLANT).materials[0]


def judged(r, missed=MATERIAL.missed):
    return forecast.judged(missed, MATERIAL.covered, r, sample_time_s=TS)


def test_each_sample_of_the_routine_stands_at_its_event():
    task = protocol(8.0, 0.6)
    place = forecast.places(task.r, TS)

    def at(time_s):
        where = place[round(time_s / TS)]
        return where // BINS, where % BINS

    begin, (halt, go), end = task.start_s, task.pause_s, task.stop_s
    assert at(begin - 0.5)[0] == OFF and at(begin + 3)[0] == STEADY and at(end + 2)[0] == OFF
    assert at(begin + 0.5)[0] == START and at(end + 0.5)[0] == STOP
    # a gap of 0.6 s is one Corner until a second after it
    assert at((halt + go) / 2)[0] == at(go + 0.9)[0] == CORNER and at(go + 1.1)[0] == STEADY
    # an event begins 0.2 s ahead of its middle: 0.5 s after it is in the fourth bin of 0.2 s
    assert at(begin + 0.5)[1] == 3


def test_a_dip_that_does_not_reach_zero_is_a_corner():
    r = np.ones(500)
    r[:50] = r[450:] = 0.0
    r[200:210] = 0.2
    assert forecast.places(r, TS)[205] // BINS == CORNER


def test_the_true_error_lies_within_the_interval_and_the_interval_is_narrow():
    task = protocol(6.5, 0.45)
    u, on_off = trainings(PLANT)[0].u[-1], task.r / MATERIAL.on_off_gain
    u = np.interp(task.time_s, trainings(PLANT)[0].routine.time_s, u)

    def flows(command):
        return forecast.flows(MATERIAL.chain, MATERIAL.missed, command, task.r, sample_time_s=TS)

    low, median, high = forecast.error_percent(flows(u), flows(on_off), task.r)
    made, first = (flow(PLANT, command, sample_time_s=TS) - task.r for command in (u, on_off))
    true = 100 * np.linalg.norm(made) / np.linalg.norm(first)
    assert low <= true <= high
    assert low < median < high < 1.1 * low + 3


def test_what_was_missed_is_carried_to_its_event_in_proportion_to_the_flow():
    r = protocol(8.0, 0.6).r
    missed = MATERIAL.missed._replace(by_place=np.zeros((1, len(forecast.EVENTS) * BINS)))
    missed.by_place[0, START * BINS : (START + 1) * BINS] = -0.1
    u = trainings(PLANT)[0].u[-1][: len(r)]
    plain = forecast.flows(
        MATERIAL.chain, missed._replace(by_place=0 * missed.by_place), u, r, sample_time_s=TS
    )
    carried = forecast.flows(MATERIAL.chain, missed, u, r, sample_time_s=TS)
    place = forecast.places(r, TS) // BINS
    np.testing.assert_array_equal(carried[:, place != START], plain[:, place != START])
    # members carry none, all, and twice of it
    added = (carried - plain)[:3][:, np.flatnonzero(place == START)[-10:]] / r.max()
    np.testing.assert_allclose(added, np.repeat([[0.0], [0.1], [0.2]], 10, axis=1), atol=1e-12)


def test_the_ends_of_rows_that_come_one_by_one_are_those_of_the_interval():
    values = np.random.default_rng(4).standard_normal((7, 40))
    kept = values.copy()
    low, _, high = forecast.interval(values)
    np.testing.assert_array_equal(forecast.ends(iter(values)), (low, high))
    np.testing.assert_array_equal(values, kept)


def test_the_routines_themselves_are_judged():
    assert all(judged(t.r) == forecast.ForecastJudgement(True, "", "") for t in trainings(PLANT))


@pytest.mark.parametrize(
    ("r", "reason", "trial"),
    [
        (
            protocol(100.0, 0.6).r,
            "the part prints at 100 mm/s, trained were 5 to 8 mm/s",
            "speed_mm_per_s: 100",
        ),
        (protocol(2.0, 0.6).r, "the part prints at 2 mm/s", "speed_mm_per_s: 2"),
        (protocol(8.0, 0.6, ramp_s=0.05).r, "changes 2.6 times as fast as in any routine", "printer.ramp_s"),
        (protocol(8.0, 0.1).r[:0], "", ""),
    ],
)
def test_what_was_not_trained_is_not_judged(r, reason, trial):
    if not len(r):  # two runs with a gap of 0.1 s
        r = np.zeros(600)
        r[100:300] = r[305:500] = 2.4
        r = uniform_filter1d(r, 5)
        reason, trial = "fast as in any routine", "printer.ramp_s"
    told = judged(r)
    assert not told.judged and reason in told.reason and trial in told.trial


def test_a_residual_above_the_scatter_of_repeated_trials_is_not_judged():
    assert judged(trainings(PLANT)[0].r, MATERIAL.missed._replace(ratio=4.9)).judged
    told = judged(trainings(PLANT)[0].r, MATERIAL.missed._replace(ratio=6.0, event="stop"))
    assert not told.judged and "misses stop by 6.0 times" in told.reason and "--verify" in told.trial


def test_a_machine_that_changes_while_it_learns_is_not_judged_and_one_that_does_not_is():
    assert MATERIAL.missed.changed < forecast.CHANGED
    stepped = [
        t._replace(y=t.y * np.where(np.arange(len(t.y)) > 8, 1.2, 1.0)[:, None]) for t in trainings(PLANT)
    ]
    missed = forecast.missed(stepped, MATERIAL.chain, sample_time_s=TS)
    told = judged(stepped[0].r, missed)
    assert not told.judged and "the machine changed while it learned" in told.reason


def test_two_trials_tell_no_scatter():
    few = [t._replace(u=t.u[:2], y=t.y[:2]) for t in trainings(PLANT)]
    told = judged(few[0].r, forecast.missed(few, MATERIAL.chain, sample_time_s=TS))
    assert not told.judged and told.trial == "run more trials"


def test_an_extruder_whose_law_the_chain_lacks_is_told_from_one_that_it_has():
    """Thixotropic ink: its starts are missed by far more than trials scatter."""
    rng = np.random.default_rng(0)
    plant = foreign_parts.plant_of("thixotropic", rng, "A")
    strange = learn(foreign_parts.train(plant, "A", rng), sample_time_s=TS).materials[0].missed
    assert strange.ratio > 2 * MATERIAL.missed.ratio
