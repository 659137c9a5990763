"""The width rule and the profile machine on key areas whose answer is known."""

import itertools

import numpy as np
import pytest

from pipeline.setpoint.vision import yardsticks


def bars(rows, rng, noise=8.0):
    """(n, 16, 48) key areas with a bright bar of the given number of rows in the middle."""
    images = np.full((len(rows), 16, 48), 60.0)
    for image, count in zip(images, rows, strict=True):
        first = (16 - count) // 2
        image[first : first + count] = 180.0
    return np.clip(images + noise * rng.standard_normal(images.shape), 0, 255).astype(np.uint8)


def test_the_width_is_the_number_of_bright_rows():
    rows = np.array([2, 5, 8, 11])
    np.testing.assert_allclose(yardsticks.widths(bars(rows, np.random.default_rng(0))), rows, atol=0.05)


def test_the_two_limits_are_the_best_of_all_pairs():
    rng = np.random.default_rng(1)
    label = rng.integers(0, 3, 60)
    rows = np.clip(np.round(4 + 3 * label + 2 * rng.standard_normal(60)), 1, 15).astype(int)
    images = bars(rows, rng)
    found = np.mean(yardsticks.width_class(yardsticks.fit_width_rule(images, label), images) == label)
    limits = np.concatenate([[-1.0], np.sort(yardsticks.widths(images)), [17.0]])
    width = yardsticks.widths(images)
    best = max(
        np.mean((width >= low).astype(int) + (width >= high) == label)
        for low, high in itertools.combinations_with_replacement(limits[::2], 2)
    )
    assert found >= best


def test_separate_widths_are_told_apart_without_error():
    rng = np.random.default_rng(2)
    label = np.repeat([0, 1, 2], 20)
    images = bars(np.array([4, 8, 12])[label], rng)
    rule = yardsticks.fit_width_rule(images, label)
    np.testing.assert_array_equal(yardsticks.width_class(rule, images), label)
    assert 4 < rule.low < 8 < rule.high < 12


def test_the_machine_tells_bars_apart_and_its_probabilities_are_probabilities():
    rng = np.random.default_rng(3)
    label, segment = np.tile(np.repeat([0, 1, 2], 10), 4), np.repeat(np.arange(12), 10)
    images = bars(np.array([6, 8, 10])[label], rng, noise=30.0)
    temperature = rng.choice([190.0, 210.0], len(label))
    fitted = yardsticks.fit_profile_machine(images, temperature, label, segment)
    p = yardsticks.profile_probabilities(fitted, images, temperature)
    np.testing.assert_allclose(p.sum(axis=1), 1)
    assert (p >= 0).all()
    assert np.mean(p.argmax(axis=1) == label) > 0.98  # bars two rows apart in means of 48 pixels of noise


def test_probabilities_are_as_sure_as_they_are_right_on_segments_not_seen():
    """Decision values of seen images are too far apart; the map is fitted on folds without their segments."""
    rng = np.random.default_rng(4)

    def draw(segments):
        label = np.repeat(np.arange(segments) % 3, 8)
        shade = np.repeat(30 * rng.standard_normal(segments), 8)  # of the whole segment
        rows = np.clip(np.round(8 + 1.2 * (label - 1) + 1.5 * rng.standard_normal(len(label))), 1, 15).astype(
            int
        )
        images = np.clip(bars(rows, rng).astype(float) + shade[:, None, None], 0, 255).astype(np.uint8)
        return images, np.full(len(label), 210.0), label, np.repeat(np.arange(segments), 8)

    fitted = yardsticks.fit_profile_machine(*draw(60))
    images, temperature, label, _ = draw(60)
    p = yardsticks.profile_probabilities(fitted, images, temperature)
    # 480 images of 60 segments know the rate of right answers to 0.04
    assert p.max(axis=1).mean() == pytest.approx(np.mean(p.argmax(axis=1) == label), abs=0.08)
