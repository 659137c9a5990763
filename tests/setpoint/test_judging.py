"""Scores of trajectories made by hand, the cases that controllers meet, and the choice of the default."""

import jax.numpy as jnp
import numpy as np
import pytest

from pipeline.setpoint.judging import START_FLOWS, START_TEMPERATURES, cases, choose, starts
from pipeline.setpoint.recorded import recorded_windows
from pipeline.setpoint.score import Score, judge
from pipeline.statistics import Share, wilson
from tests.setpoint.synthetic import synthetic_table


def path(*pieces):
    """Flow (201,) that takes each value from its step on."""
    flow = np.empty(201)
    for step, value in pieces:
        flow[step:] = value
    return flow


def run(*flows, temperature=210.0):
    flow = np.stack(flows)
    return flow, np.broadcast_to(temperature, flow.shape)


def test_settled_staying_and_recovered_are_what_the_notes_define():
    flows = [
        path((0, 60), (7, 95)),  # settles at step 7 and stays
        path((0, 60), (90, 95)),  # at the last step that counts
        path((0, 60), (91, 95)),  # one too late, so that it neither settles nor stays
        path((0, 60), (7, 95), (150, 111), (151, 95)),  # leaves for one step later on
        path((0, 60), (7, 95), (99, 89), (100, 95)),  # out within the dwell
        path((0, 60), (7, 95), (110, 80), (121, 95)),  # out before 120: settled, not recovered
        path((0, 100), (60, 60), (75, 90)),  # a clog made good at step 75, on the border
    ]
    score = judge(*run(*flows))
    assert score.settled.percent == pytest.approx(100 * 5 / 7)
    assert score.stay.percent == pytest.approx(100 * 3 / 7)
    assert score.recovered.percent == pytest.approx(100 * 4 / 7)
    assert score.median_steps == 7  # of 7, 90, 7, 7, 75
    assert score.p90_steps == pytest.approx(84)  # 0.6 of the way from 75 to 90
    assert score.worst_start == (60.0, 210.0, pytest.approx(100 * 4 / 6))


def test_a_temperature_out_of_its_band_is_not_settled():
    warm = np.where(np.arange(201) < 12, 215.1, 215.0)
    assert judge(*run(path((0, 100)), temperature=warm)).median_steps == 12
    assert judge(*run(path((0, 100)), temperature=215.1)).settled.percent == 0
    assert np.isnan(judge(*run(path((0, 100)), temperature=215.1)).median_steps)


def test_overshoot_counts_the_far_side_of_the_start_until_the_clog_only():
    score = judge(*run(path((0, 300), (20, 85), (30, 100), (60, 60), (75, 100))))
    assert score.overshoot_p95 == 15
    assert judge(*run(path((0, 30), (20, 130), (30, 100)))).overshoot_p95 == 30
    assert judge(*run(path((0, 30), (20, 99)))).overshoot_p95 == 0


def test_the_flow_error_is_the_mean_distance_over_the_second_hundred_steps():
    score = judge(*run(path((0, 60), (100, 95), (150, 105)), path((0, 60), (100, 98))))
    assert score.flow_error == pytest.approx(3.5)


def test_wilson_s_interval_by_hand():
    # 81 of 263: 0.2553 to 0.3662, the example of Newcombe (1998), whose digits these are
    share = wilson(np.arange(263) < 81)
    np.testing.assert_allclose(share, [100 * 81 / 263, 25.53, 36.62], atol=5e-3)
    assert wilson(np.ones(10, bool)).high == pytest.approx(100.0)  # rounding
    assert wilson(np.zeros(10, bool)).low == pytest.approx(0.0, abs=1e-12)


def test_every_start_comes_as_often_in_every_case():
    all_cases = cases(
        recorded_windows(synthetic_table(np.random.default_rng(0), segments=1, windows=1)),
        runs=3,
        segment_mean_decisions=10.0,
    )
    assert len(all_cases) == 12
    for _, conditions in all_cases.values():
        pairs, counts = np.unique(
            np.stack([conditions.flow, conditions.temperature]), axis=1, return_counts=True
        )
        assert set(map(tuple, pairs.T)) == {(q, u) for q in START_FLOWS for u in START_TEMPERATURES}
        assert set(counts) == {3}
    clogged = [
        name
        for name, (_, c) in all_cases.items()
        if (c.clog == jnp.float32(0.6)).all() and (c.clog_step == 60).all()
    ]
    weak = [name for name, (_, c) in all_cases.items() if (c.gain == jnp.float32(0.6)).all()]
    assert clogged == [name for name in all_cases if name.endswith("clog")]
    assert weak == [name for name in all_cases if name.endswith("gain 0.6")]
    assert (starts(1, accuracy=0.7).accuracy == jnp.float32(0.7)).all()


def scored(stay):
    share = Share(stay, stay - 1, stay + 1)
    return Score(
        100, Share(100, 99, 100), share, Share(100, 99, 100), 7.0, 19.0, 10.0, 1.5, (30.0, 190.0, 95.0)
    )


def test_the_default_is_the_best_in_its_worst_case_and_the_margin_is_said():
    scores = {
        "fast": {"calm": scored(100.0), "clog": scored(60.0)},
        "robust": {"calm": scored(97.0), "clog": scored(96.5)},
    }
    choice = choose(scores)
    assert (choice.name, choice.worst, choice.case, choice.margin) == ("robust", 96.5, "clog", 36.5)
    assert choice.sentence == (
        "robust is the default: in its worst case (clog) 96.5 % of the runs settle and stay, "
        "36.5 points more than of fast in its worst (clog, 60.0 %)."
    )
    assert choose({"only": scores["fast"]}).sentence.endswith(
        "60.0 % of the runs settle and stay; nothing else was judged."
    )


def test_of_two_with_one_worst_case_the_better_mean_wins():
    assert (
        choose(
            {"a": {"x": scored(90.0), "y": scored(95.0)}, "b": {"x": scored(99.0), "y": scored(90.0)}}
        ).name
        == "b"
    )


def test_controllers_judged_on_different_cases_are_not_compared():
    with pytest.raises(
        ValueError,
        match=(
            r"expected every controller judged on the same cases, found \[\['x'\], \['y'\]\]; judge all "
            r"on all"
        ),
    ):
        choose({"a": {"x": scored(90.0)}, "b": {"y": scored(90.0)}})


def test_short_trajectories_are_refused():
    short = np.full((1, 101), 100.0)
    with pytest.raises(
        ValueError, match=r"expected trajectories of 200 decisions, found 100; roll out with steps=200"
    ):
        judge(short, short)
