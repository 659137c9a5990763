"""What repeats from trial to trial: the weights that are chosen, the gain that is followed, and what is
learned of nothing seen."""

import numpy as np
import pytest

from pipeline.deposition.extruder import Extruder, flow, routine
from pipeline.deposition.learning.ilc import zero_phase
from pipeline.deposition.learning.trial_filter import FIRST, WEIGHTS, gain_forecasts, repeating
from pipeline.deposition.learning.trial_model import TrialModel

TS = 0.02
R = routine(
    off_s=4, on_s=6, pause_s=0.6, tail_s=8, speed=8.0, bead_area_mm2=0.304, ramp_s=0.15, sample_time_s=TS
).r
MODEL = TrialModel(Extruder(1.0, 2.0, 0.1), 0.07, 90.0)


def smooth(x):
    return zero_phase(x, order=4, cutoff_hz=5.0, sample_time_s=TS)


def repeats(y, u=None, floor=0.1):
    u = np.tile(R, (len(y), 1)) if u is None else u
    return repeating(u, np.array(y), R, MODEL, floor=floor, smooth=smooth, sample_time_s=TS)


def trials(count, seed=0, gain=lambda j: 1.0, bump=lambda j: 1.0, noise=0.03):
    """Flows of the model with a bump that repeats, and white noise; gain and bump by trial."""
    rng, x = np.random.default_rng(seed), flow(MODEL.extruder, R, sample_time_s=TS)
    shape = 0.3 * np.exp(-(((np.arange(len(R)) - 400) / 20.0) ** 2))
    spread = noise * R.max()
    return [gain(j) * (x + bump(j) * shape) + spread * rng.standard_normal(len(R)) for j in range(count)]


def bump_of(one):
    return float(one.disturbance[400])


def test_a_static_machine_is_averaged_over_all_trials_and_its_gain_is_one():
    one = repeats(trials(20))
    assert (one.weight, one.follower) == (0.1, 0)
    assert bump_of(one) == pytest.approx(0.3, abs=0.05)  # 0.07 of noise, over ten trials
    assert one.gain == pytest.approx(1.0, abs=0.003)


def test_noise_alone_hardly_ever_chooses_to_follow():
    chosen = [repeats(trials(12, seed=seed)) for seed in range(40)]
    assert sum(one.weight > 0.1 for one in chosen) <= 1 and sum(one.follower > 0 for one in chosen) <= 6
    assert max(abs(np.log(one.gain)) for one in chosen) < 0.02


def test_a_disturbance_that_grows_is_followed_with_a_larger_weight():
    y = trials(20, bump=lambda j: 1 + 0.3 * j)
    following, mean = repeats(y), repeats(y, floor=1.0)
    assert following.weight in WEIGHTS
    assert mean.weight == 1.0  # the law's own least weight is the least of all
    assert bump_of(following) == pytest.approx(0.3 * (1 + 0.3 * 19), rel=0.15)


@pytest.mark.parametrize("drift", [-0.01, 0.01, 0.02])
def test_a_gain_that_drifts_is_forecast_for_the_next_trial(drift):
    one = repeats(trials(20, gain=lambda j: (1 + drift) ** j))
    assert one.follower > 0
    assert one.gain == pytest.approx((1 + drift) ** 20, rel=2 * abs(drift))  # two trials of the drift


def test_the_mean_of_a_drifting_gain_is_the_first_forecast_and_a_line_is_met_by_the_slopes():
    forecasts = gain_forecasts(0.01 * np.arange(30.0))
    assert forecasts[0, 30] == pytest.approx(0.145) and forecasts[:, 0].tolist() == [0.0] * 4
    np.testing.assert_allclose(forecasts[2:, 30], 0.30, atol=0.01)
    assert forecasts[1, 30] == pytest.approx(0.28, abs=1e-3)  # a level alone is two trials late


def test_the_first_trials_are_taken_in_full_and_tell_no_gain():
    y = trials(FIRST, gain=lambda j: 1.2, noise=0.0)
    one = repeats(y)
    assert (one.gain, one.weight) == (1.0, 0.1)
    x = flow(MODEL.extruder, R, sample_time_s=TS)
    np.testing.assert_allclose((x + one.disturbance)[R > 0], y[-1][R > 0], atol=1e-12)


def test_nothing_is_learned_where_nothing_was_seen():
    y = trials(6, noise=0.0)
    for one in y:
        one[380:420] = np.nan
    learned = repeats(y).disturbance
    assert np.all(learned[380:420] == 0) and learned[440] > 0.002
