"""Synthetic nozzle frames: what their truth promises, what stays within a segment, and how hard they are."""

import numpy as np
import pytest

from pipeline.setpoint.frames import nozzle_scene, rendered
from pipeline.setpoint.frames.key_area import find
from pipeline.setpoint.vision import yardsticks

LEAST = 10.0


def frames_of(rng, segments, flow, temperature=210.0):
    return [
        nozzle_scene.render(nozzle_scene.draw_segment(rng), np.asarray(flow, float), temperature, rng)
        for _ in range(segments)
    ]


def test_the_classes_are_those_of_the_paper_at_their_borders():
    assert nozzle_scene.label(np.array([20.0, 89.999, 90.0, 100.0, 110.0, 110.001, 310.0])).tolist() == [
        0,
        0,
        1,
        1,
        1,
        2,
        2,
    ]


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others():
    first, again, other = (frames_of(np.random.default_rng(seed), 1, [100.0] * 3)[0] for seed in (4, 4, 5))
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)
    assert (first.frames != other.frames).any()
    assert first.frames.shape == (3, 350, 350)
    assert first.frames.dtype == np.uint8


def test_flow_and_temperature_are_given_frame_by_frame():
    made = frames_of(np.random.default_rng(6), 1, [60.0, 100.0, 200.0], np.array([190.0, 210.0, 230.0]))[0]
    assert made.flow.tolist() == [60.0, 100.0, 200.0]
    assert made.temperature.tolist() == [190.0, 210.0, 230.0]
    assert made.line.dtype == bool


def test_the_bead_is_a_stadium_of_the_flow_with_the_stated_spread():
    rng = np.random.default_rng(7)
    made = frames_of(rng, 120, [100.0, 100.0, 300.0])
    factors = np.array([[m.width_px[k] if m.line[k] else np.nan for k in range(3)] for m in made])
    # w = 8 px at 100 percent and 8 (3 - 0.1 x 2) = 22.4 px at 300 by
    # hand; 9.4 percent over 120 draws is 0.9 percent
    assert np.nanmean(factors[:, :2]) == pytest.approx(8.0, rel=0.03)
    assert np.nanmean(factors[:, 2]) == pytest.approx(22.4, rel=0.03)
    # two images of one segment differ by 8 percent each; 120 pairs know it to 7 percent of itself
    within = np.nanstd(factors[:, 0] - factors[:, 1]) / 8 / np.sqrt(2)
    assert within == pytest.approx(nozzle_scene.IMAGE_SPREAD, rel=0.2)
    assert np.nanstd(factors[:, :2]) / 8 == pytest.approx(np.hypot(0.05, 0.08), rel=0.2)
    # images of one segment are not independent: 0.05^2 / (0.05^2 + 0.08^2) = 0.28, known to 0.09
    both = factors[np.isfinite(factors[:, :2]).all(axis=1)]
    assert 0.05 < np.corrcoef(both[:, 0], both[:, 1])[0, 1] < 0.55


def test_a_drawn_bead_is_as_wide_as_its_truth_says(monkeypatch):
    monkeypatch.setattr(nozzle_scene, "SHADING", (0.0, 0.0))
    rng = np.random.default_rng(8)
    for flow in (60.0, 100.0, 160.0):
        segment = nozzle_scene.draw_segment(rng)._replace(
            noise=0.0, blur_px=0.3, contrast=100.0, specular=0.0
        )
        segment = segment._replace(
            ground=np.full_like(segment.ground, 40), texture=np.zeros_like(segment.texture)
        )
        made = nozzle_scene.render(segment, np.full(6, flow), 210.0, rng)
        far = segment.at[(segment.along > 40) & (segment.along < 120)]
        # area of the bright band by its length; edges that wander by 26
        # percent over 25 px leave 6 percent in the mean of six
        drawn = (made.frames.reshape(6, -1)[made.line][:, far] > 90).sum(axis=1) / 80
        assert drawn.mean() == pytest.approx(made.width_px[made.line].mean(), rel=0.15)


def test_one_frame_in_sixteen_has_no_line_and_the_front_end_rejects_it():
    rng = np.random.default_rng(9)
    made = frames_of(rng, 24, np.full(20, 100.0))
    line = np.concatenate([m.line for m in made])
    assert 1 - line.mean() == pytest.approx(nozzle_scene.EMPTY, abs=0.035)  # three deviations of 480 draws
    valid = np.concatenate([nozzle_scene.key_areas(m, least_score=LEAST).valid for m in made])
    assert valid[line].mean() > 0.97
    assert valid[~line].mean() < 0.35  # an older bead beside the empty path may pass for it


def test_the_line_leaves_the_tip_in_the_direction_that_the_segment_states():
    rng = np.random.default_rng(10)
    made = frames_of(rng, 40, [110.0])
    errors = [
        abs((find(m.frames[0], m.tip, least_score=LEAST).angle_deg - m.direction_deg + 180) % 360 - 180)
        for m in made
        if m.line[0]
    ]
    # without G-code: the sweep finds it but for the few whose older bead
    # is stronger; curvature turns it by up to 5 degrees
    assert np.mean(np.array(errors) < 8) > 0.85


@pytest.mark.parametrize("flow", [30.0, 60.0, 100.0, 200.0, 300.0])
def test_beads_of_every_flow_are_seen(flow):
    made = frames_of(np.random.default_rng(11), 15, [flow] * 3)
    valid = np.concatenate([nozzle_scene.key_areas(m, least_score=LEAST).valid[m.line] for m in made])
    assert valid.mean() > (0.8 if flow < 50 else 0.93)  # threads of 3 px stand out less


def test_heat_changes_the_look_a_little():
    rng = np.random.default_rng(12)
    segment = nozzle_scene.draw_segment(rng)
    bright = []
    for temperature in (190.0, 230.0):
        made = nozzle_scene.render(segment, np.full(20, 150.0), temperature, np.random.default_rng(1))
        bright.append(
            np.mean(
                [f.ravel()[segment.at[np.abs(segment.across) < 5]].mean() for f in made.frames[made.line]]
            )
        )
    assert 0.5 < bright[1] - bright[0] < 15  # gray levels of gloss


def test_flows_to_learn_have_one_density_across_the_borders_and_reach_everywhere():
    flow = nozzle_scene.draw_flow(np.random.default_rng(0), 200_000)
    assert flow.min() >= nozzle_scene.FLOWS[0]
    assert flow.max() <= nozzle_scene.FLOWS[1]
    density = np.histogram(flow, bins=np.arange(20.0, 311, 1.0))[0] / len(flow)
    for border in nozzle_scene.BORDERS:
        k = int(border - 20)
        # two counts of about 2,600 differ by 3 % of chance; the paper's shares leap by a factor of 3 and 10
        assert density[k - 1] == pytest.approx(density[k], rel=0.08)
    # half of them log-uniform: a hundredth of all lies in 2.7 % of flow, anywhere
    assert (np.histogram(np.log(flow), bins=50)[0] / len(flow)).min() > 0.009
    assert np.mean((flow > 70) & (flow < 150)) == pytest.approx(0.14 + 0.43, abs=0.02)


def test_flows_to_judge_are_uniform_where_controllers_work_in_equal_numbers_a_bin():
    flow = nozzle_scene.draw_judged_flow(np.random.default_rng(0), 640)
    counts = np.histogram(flow, bins=np.arange(70.0, 151, 5))[0]
    wide = np.histogram(np.exp(np.linspace(np.log(20), np.log(310), 321)[:-1]), bins=np.arange(70.0, 151, 5))[
        0
    ]
    assert np.abs(counts - 20 - wide).max() <= 3
    assert (flow < 70).sum() > 100
    assert (flow > 150).sum() > 70


@pytest.mark.parametrize("n", [1, 2, 15])
def test_few_flows_are_as_many_as_asked_for_and_fifteen_hold_every_class(n):
    for seed in range(20):
        flow = nozzle_scene.draw_flow(np.random.default_rng(seed), n)
        assert flow.shape == nozzle_scene.draw_judged_flow(np.random.default_rng(seed), n).shape == (n,)
        assert n < 15 or set(nozzle_scene.label(flow).tolist()) == {0, 1, 2}


def data_set(seed, *, segments, frames, measured=False):
    """So many segments of each class at each temperature, flows uniform within their class."""
    rng = np.random.default_rng(seed)
    flow = [nozzle_scene.draw_class_flow(rng, k // 5 % 3, 1)[0] for k in range(15 * segments)]
    made = rendered.filmed(seed, np.array(flow), frames, measured=measured)
    return rendered.standing_out(made, LEAST)


@pytest.mark.parametrize("measured", [False, True])
def test_filmed_segments_keep_their_flow_and_temperature(measured):
    made = data_set((13,), segments=2, frames=6, measured=measured)
    assert made.images.shape == (180, 16, 48) and made.images.dtype == np.uint8
    pairs, counts = np.unique(np.column_stack([made.label, made.temperature]), axis=0, return_counts=True)
    assert len(pairs) == 15 and set(counts) == {12}
    assert np.unique(made.segment).tolist() == list(range(30))
    for k in range(30):
        assert len(set(made.flow[made.segment == k])) == len(set(made.temperature[made.segment == k])) == 1
    np.testing.assert_array_equal(made.valid, [not r for r in made.reasons])
    assert (made.score[made.valid] >= LEAST).all() and not made.images[~made.valid].any()
    np.testing.assert_array_equal(made.label, nozzle_scene.label(made.flow))
    # of every five frames of a segment the first with a line is measured, where measures are asked for
    seen = np.isfinite(made.surroundings).all(axis=1).reshape(30, 6)
    first = np.zeros((30, 6), bool)
    for k, valid in enumerate(made.valid.reshape(30, 6)):
        first[k, np.flatnonzero(valid[:5])[:1]] = True
        first[k, 5] = valid[5]
    np.testing.assert_array_equal(seen, first & measured)


def image_accuracy(seed, *, train, test):
    seen, held_out = (data_set((seed, k), segments=s, frames=5) for k, s in enumerate((train, test)))
    v, w = seen.valid, held_out.valid
    fitted = yardsticks.fit_profile_machine(
        seen.images[v], seen.temperature[v], seen.label[v], seen.segment[v]
    )
    answers = yardsticks.profile_probabilities(fitted, held_out.images[w], held_out.temperature[w]).argmax(
        axis=1
    )
    return np.mean(answers == held_out.label[w])


def test_the_scenes_are_hard_for_the_profile_machine():
    # a sixth of the frozen figure's frames: some points less learned, 90 segments know them to 0.035
    assert 0.62 < image_accuracy(0, train=10, test=6) < 0.80


@pytest.mark.slow
def test_the_difficulty_is_frozen_on_the_profile_machine():
    found = [image_accuracy(seed, train=60, test=60) for seed in range(3)]
    # 0.745 when the numbers were set, 0.727 with the same numbers and other draws: a mean is known to 0.007
    assert 0.72 <= np.mean(found) <= 0.76
    assert np.ptp(found) < 0.05  # 900 segments know one seed's figure to 0.012
