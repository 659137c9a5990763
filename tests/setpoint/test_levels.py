"""The correction for another camera, judged on cameras of structures that it does not assume: powers,
offsets, saturation, and such as see nothing."""

import numpy as np
import pytest

from pipeline.setpoint import levels
from pipeline.setpoint.levels import LevelWindows

FLOWS = (60.0, 80.0, 100.0, 125.0, 160.0)
CAMERAS = {
    "as it is": lambda q: q,
    "wider": lambda q: 1.25 * q,
    "power": lambda q: 100 * (q / 100) ** 0.6,
    "offset": lambda q: 0.6 * q + 45,
    "width is a root": lambda q: 100 * np.sqrt(0.2 + 0.8 * q / 100),
    "saturating": lambda q: 150 * (1 - np.exp(-q / 90)),
}


def record(camera, rng, *, flows=FLOWS, windows=45, segment=0.03, window=0.05) -> LevelWindows:
    """Windows of levels held for a minute; each level is a segment with an error of its own."""
    flow = np.repeat(flows, windows)
    error = np.repeat(segment * rng.standard_normal(len(flows)), windows)
    return LevelWindows(camera(flow) * np.exp(error + window * rng.standard_normal(len(flow))), flow)


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_new_print_is_told_within_the_spread(camera):
    """Over 60 recordings: the corrected flow of new windows of new segments, between the outer levels, lies
    within two spreads in at least nine of ten, and the correction is off by little."""
    see, inside, off = CAMERAS[camera], [], []
    for seed in range(60):
        rng = np.random.default_rng([seed, 7])
        found = levels.fit(record(see, rng))
        new = rng.uniform(65, 150, 40)
        shows = see(new) * np.exp(0.03 * rng.standard_normal(40) + 0.05 * rng.standard_normal(40))
        miss = np.log(levels.corrected(found, shows) / new)
        inside.append(np.mean(np.abs(miss) < 2 * found.spread))
        off.append(abs(np.log(levels.corrected(found, see(100.0)) / 100.0)))
    assert np.mean(inside) > 0.9
    assert np.percentile(off, 90) < 0.09, (
        "three of the segment's errors: the bent ones flatten to half the slope"
    )


def test_without_errors_the_borders_move_to_where_the_camera_shows_them():
    for camera in ("wider", "power"):
        windows = record(CAMERAS[camera], np.random.default_rng(0), segment=0, window=1e-4)
        found = levels.fit(windows)
        assert found.straight
        for border in (90.0, 110.0):
            assert levels.shown(found, border) == pytest.approx(CAMERAS[camera](border), rel=1e-3)
            assert levels.corrected(found, levels.shown(found, border)) == pytest.approx(border)


def test_a_bend_that_no_line_follows_is_followed_in_pieces():
    def bend(q):
        return np.where(q < 100, q, 100 * (q / 100) ** 0.4)

    found = levels.fit(record(bend, np.random.default_rng(1), segment=0.002, window=0.02))
    assert not found.straight
    assert levels.corrected(found, np.array([80.0, bend(125.0)])) == pytest.approx([80, 125], rel=0.01)


def test_a_level_with_outliers_is_taken_at_its_middle():
    windows = record(CAMERAS["wider"], np.random.default_rng(2), segment=0)
    seen = windows.seen.copy()
    seen[np.arange(len(seen)) % 3 == 0] = 300.0
    seen[0] = np.nan
    found = levels.fit(windows._replace(seen=seen))
    assert levels.corrected(found, 125.0) == pytest.approx(100, rel=0.08)


@pytest.mark.parametrize(
    ("camera", "said"),
    [
        (lambda q: 100 + 0 * q, "does not see flow"),
        (lambda q: 100 * (q / 100) ** -0.5, "does not see flow"),
        (lambda q: 100 * (q / 100) ** 0.1, "does not see flow"),
        (lambda q: np.where(q == 100, 60, q), "found 60 at 60 %, 80 at 80 %, 60 at 100 %"),
    ],
)
def test_a_camera_that_does_not_see_flow_is_refused(camera, said):
    for seed in range(20):
        with pytest.raises(
            ValueError, match="this camera does not see flow: expected .*; look at a frame"
        ) as e:
            levels.fit(record(camera, np.random.default_rng(seed), segment=0.005, window=0.02))
        assert said.partition("found")[0] in str(e.value)


def test_noise_as_large_as_the_steps_is_refused():
    refused = 0
    for seed in range(20):
        try:
            levels.fit(record(CAMERAS["as it is"], np.random.default_rng(seed), window=0.5, segment=0.3))
        except ValueError:
            refused += 1
    assert refused >= 16


def test_too_little_is_refused():
    few = record(CAMERAS["as it is"], np.random.default_rng(0), flows=(80.0, 120.0))
    with pytest.raises(ValueError, match="at least 3 levels of flow, found 2 .80 %, 120 %.; hold five"):
        levels.fit(few)
    short = record(CAMERAS["as it is"], np.random.default_rng(0), windows=4)
    with pytest.raises(ValueError, match="at least 5 windows that show a flow at 60 %, found 4 of 4"):
        levels.fit(short)
    blind = record(CAMERAS["as it is"], np.random.default_rng(0))
    seen = np.where(blind.flow == 125, np.nan, blind.seen)
    with pytest.raises(ValueError, match="at 125 %, found 0 of 45"):
        levels.fit(blind._replace(seen=seen))
