"""The basis-signal library: segments cut where a hand-made command
changes, the nearest of what is lacking, and refusals."""

import numpy as np
import pytest

from pipeline.deposition.parts.basis import compose
from pipeline.deposition.parts.library import Training, build, check, demarcate, learned, nearest, segment
from tests.deposition.trained import AREA, NOZZLE, PLANT, TS, protocol, trainings


def lookup(library, task, material, nozzle_mm, *, speed, pause_s):
    """The nearest column for one task, the factor on its signal and its predicted error in percent."""
    columns, column, factor, error = nearest(
        library, task, material, nozzle_mm, np.array([speed]), np.array([pause_s])
    )
    return columns[column[0]], factor[0], error[0]


def handmade(material="A", speed=8.0, pause_s=0.6, level=2.0, noise=0.0):
    """A command as learning would end with, its edges known: Start from 0.4 s before to 0.2 s after, Corner
    0.3 s before to 0.2 s after, Stop 0.4 s and 0.3 s."""
    task = protocol(speed, pause_s)
    t, u = task.time_s, np.zeros(len(task.time_s))
    a, (b, c), d = task.start_s, task.pause_s, task.stop_s
    u[(t >= a) & (t < d)] = level * speed
    edge = 1e-9
    u[(t >= a - 0.4 - edge) & (t < a + 0.2 - edge)] = 12 * speed
    u[(t >= b - 0.3 - edge) & (t < b - edge)] = -4 * speed
    u[(t >= b - edge) & (t < c - edge)] = 0.5 * speed
    u[(t >= c - edge) & (t < c + 0.2 - edge)] = 9 * speed
    u[(t >= d - 0.4 - edge) & (t < d + 0.3 - edge)] = -11 * speed
    rng = np.random.default_rng(0)
    u = u + noise * speed * rng.standard_normal((3, len(u)))
    return Training(material, NOZZLE, task, u, np.tile(task.r, (3, 1)))


# ---- segmentation


def test_the_marks_enclose_every_task_of_a_handmade_command():
    marks = demarcate([handmade()], sample_time_s=TS)
    # a 3 Hz filter both ways smears an edge over some 0.2 to 0.3 s, never past it inwards
    for task, (before, after) in {"Start": (0.4, 0.2), "Corner": (0.3, 0.2), "Stop": (0.4, 0.3)}.items():
        assert before <= marks[task][0] <= before + 0.3, task
        assert after <= marks[task][1] <= after + 0.3, task


def test_noise_on_the_command_hardly_moves_the_marks():
    quiet, loud = (
        demarcate([handmade()], sample_time_s=TS),
        demarcate([handmade(noise=0.2)], sample_time_s=TS),
    )
    for task in quiet:
        np.testing.assert_allclose(
            loud[task], quiet[task], atol=0.1
        )  # s; cut on the raw command the noise alone would exceed 2 % of the peak


def test_a_vibration_that_the_filter_takes_out_does_not_move_the_marks():
    training = handmade()
    t = training.routine.time_s
    # a tenth of the peak at 12 Hz, for a second up to the Start: on
    # the command as it is, the Start would begin with it
    shaken = training._replace(
        u=training.u
        + 10
        * np.sin(2 * np.pi * 12 * t)
        * ((t > training.routine.start_s - 1.6) & (t < training.routine.start_s - 0.4))
    )
    assert (
        demarcate([shaken], sample_time_s=TS)["Start"][0]
        < demarcate([training], sample_time_s=TS)["Start"][0] + 0.1
    )


def test_all_materials_are_cut_at_the_same_points():
    library = build([handmade("A"), handmade("B", level=3.0)], sample_time_s=TS)
    for task in ("Start", "Corner", "Stop"):
        cuts = {(b.lead, len(b.signal)) for b in library.columns if b.task == task}
        assert len(cuts) == 1


def test_the_segments_put_together_again_are_the_command():
    training = handmade()
    marks = demarcate([training], sample_time_s=TS)
    cut = {basis.task: basis for basis in segment(training, marks, sample_time_s=TS)}
    u, routine = np.zeros_like(training.r), training.routine
    u[round(routine.start_s / TS) : round(routine.stop_s / TS)] = cut["Steady-State"].signal[0]
    for task, event in (("Corner", routine.pause_s[0]), ("Start", routine.start_s), ("Stop", routine.stop_s)):
        at = round(event / TS) - cut[task].lead
        u[at : at + len(cut[task].signal)] = cut[task].signal
    np.testing.assert_allclose(
        u, learned(training)[0], atol=1e-12
    )  # the handmade plateaus are flat: rounding of their mean
    assert cut["No-Flow"].signal.tolist() == [0.0]


def test_a_command_that_does_not_settle_is_refused():
    expected = (
        r"segment: the command of A at 8 mm/s with a pause of 0.6 s does not settle on its plateaus \(3 "
        r"sigma .*\); lengthen the plateaus to 3 time constants"
    )
    for on_s in (0.4, 0.6, 1.0):  # Start, Corner and Stop take a second and more
        task = protocol(on_s=on_s)
        u = compose(PLANT, task.r, sample_time_s=TS)
        with pytest.raises(ValueError, match=expected):
            demarcate(
                [Training("A", NOZZLE, task, np.tile(u, (3, 1)), np.tile(task.r, (3, 1)))], sample_time_s=TS
            )


def test_the_learned_command_is_the_mean_of_the_best_trials():
    training = handmade()
    y = np.stack([training.r * 0.5, training.r * 1.001, training.r])
    u, mean = learned(
        training._replace(
            u=np.stack([training.u[0] * k for k in (9, 1, 3)]), y=y + 0.1 * np.array([0, 0, 0])[:, None]
        )
    )
    np.testing.assert_allclose(u, 3 * training.u[0])  # only the last: a tenth above no error is no error
    np.testing.assert_allclose(mean, training.r)


# ---- what is lacking


def test_what_was_trained_is_found_with_no_error():
    library = build([handmade(speed=s, pause_s=p) for s in (8.0, 5.0) for p in (0.6, 0.3)], sample_time_s=TS)
    for basis in library.columns:
        column, factor, error = lookup(library, *basis[:3], speed=basis.speed, pause_s=basis.pause_s)
        assert factor == 1.0 and error == 0.0 and column is basis


def test_a_speed_between_costs_nothing_on_a_linear_command_and_scales_it():
    library = build([handmade(speed=s) for s in (8.0, 5.0)], sample_time_s=TS)
    _, factor, error = lookup(library, "Start", "A", NOZZLE, speed=12.0, pause_s=0.6)
    assert factor == 1.5 and error < 0.1  # the handmade commands are proportional to speed


def test_a_pause_that_was_not_trained_comes_with_its_predicted_error():
    library = build(trainings(PLANT), sample_time_s=TS)
    column, _, error = lookup(library, "Corner", "A", NOZZLE, speed=8.0, pause_s=0.2)
    assert column.pause_s == 0.3 and 10 < error < 60  # notes: an untrained pause costs 27-37 %


def test_a_corner_of_no_pause_is_the_steady_state():
    library = build([handmade()], sample_time_s=TS)
    column, _, error = lookup(library, "Corner", "A", NOZZLE, speed=8.0, pause_s=0.0)
    assert column.signal.tolist() == [pytest.approx(16.0)] and error == 0.0


def test_one_speed_cannot_predict_another():
    library = build([handmade()], sample_time_s=TS)
    assert np.isnan(lookup(library, "Start", "A", NOZZLE, speed=4.0, pause_s=0.0)[2])


def test_no_routine_makes_no_library():
    with pytest.raises(ValueError, match="library: expected at least one learned routine but found none"):
        build([], sample_time_s=TS)


# ---- assumptions 1-4


def test_the_assumptions_are_figures_that_see_what_breaks_them():
    trained = [handmade(speed=s, pause_s=p) for s in (8.0, 5.0) for p in (0.6, 0.3)]
    figures = [c.percent for c in check(trained, build(trained, sample_time_s=TS))]
    assert (
        figures[0] == pytest.approx(0, abs=1e-9)
        and figures[1] == pytest.approx(0, abs=1e-9)
        and figures[2] == pytest.approx(0, abs=1e-9)
    )
    assert figures[3] > 10  # a Corner of 0.3 s is not that of 0.6 s
    # the first plateau 2 % higher; every second trial 1 % more flow; a Start that jumps

    risen = [
        x._replace(u=x.u * np.where(x.routine.time_s < x.routine.pause_s[0] - 0.5, 1.02, 1.0))
        for x in trained
    ]
    assert check(risen, build(risen, sample_time_s=TS))[1].percent == pytest.approx(2, abs=0.1)
    scattered = [x._replace(y=x.y * np.array([1, 1, 1.01])[:, None]) for x in trained]
    # 1 % over the share of the time that prints, the difference of two trials over root 2
    share = np.sqrt(np.mean((trained[0].r / trained[0].r.max()) ** 2))
    assert check(scattered, build(scattered, sample_time_s=TS))[0].percent == pytest.approx(
        share / np.sqrt(2), rel=0.1
    )


def test_the_bead_area_times_the_speed_is_the_wanted_flow():
    training = handmade()
    assert training.r.max() == pytest.approx(AREA * 8.0) and training.speed == 8.0 and training.pause_s == 0.6
