"""One measured trial tells gain, time constant, total delay and yield: exactly without noise, within its own
deviations with it; up and down apart."""

import numpy as np
import pytest

from pipeline.deposition.extruder import Extruder, disturb, draw, flow, routine
from pipeline.deposition.learning.trial_model import deviations, identify, identify_with_lag, lag_delay_s

TS = 0.02
R = routine(
    off_s=4, on_s=6, pause_s=0.6, tail_s=8, speed=8.0, bead_area_mm2=0.304, ramp_s=0.15, sample_time_s=TS
).r
STEADY, U = R.max(), R / 1.08
TRUE = Extruder(1.3, 2.1, 0.133, yield_=0.15)
NOISE = {"white": 0.03, "drift": 0.01, "gain": 0.01}


def parameters(extruder):
    return np.array([extruder.gain, extruder.time_constant_s, extruder.delay_s, extruder.yield_])


def total(plant):
    """The parameters that a model without lag should find: below its
    corner a lag of damping 0.7 delays by 1.4 / w."""
    return parameters(plant._replace(delay_s=plant.delay_s + 1.4 / (2 * np.pi * plant.lag_hz)))


def test_without_noise_the_four_parameters_are_found():
    model = identify([U], [flow(TRUE, U, sample_time_s=TS)], sample_time_s=TS)
    np.testing.assert_allclose(
        parameters(model.extruder), parameters(TRUE), rtol=1e-4
    )  # the solver stops at 1e-7 of the cost
    assert model.fit_percent > 99.9


@pytest.mark.parametrize("lag_hz", [0.7, 3.0, 8.0])
def test_two_trials_of_which_one_was_learned_tell_delay_and_lag_apart(lag_hz):
    true, rng = TRUE._replace(lag_hz=lag_hz), np.random.default_rng(4)
    pushed = U + 1.7 * np.gradient(U, TS)
    y = [disturb(flow(true, u, sample_time_s=TS), rng, steady_flow=STEADY, **NOISE) for u in (U, pushed)]
    model = identify_with_lag([U, pushed], y, sample_time_s=TS)
    assert model.extruder.lag_hz == pytest.approx(lag_hz, rel=0.25)
    late = model.extruder.delay_s + lag_delay_s(model.extruder.lag_hz)
    assert late == pytest.approx(true.delay_s + lag_delay_s(lag_hz), abs=0.02)
    assert model.extruder.time_constant_s == pytest.approx(true.time_constant_s, rel=0.05)


def test_one_trial_leaves_the_lag_where_plungers_usually_have_it():
    true = TRUE._replace(delay_s=0.2)
    y = disturb(flow(true, U, sample_time_s=TS), np.random.default_rng(4), steady_flow=STEADY, **NOISE)
    model = identify_with_lag([U], [y], sample_time_s=TS).extruder
    assert 1.5 < model.lag_hz < 6
    assert model.delay_s + lag_delay_s(model.lag_hz) == pytest.approx(0.2, abs=0.04)


def test_a_flow_that_does_not_follow_the_command_is_refused_with_a_lag_too():
    noise = 0.5 + 0.5 * np.random.default_rng(0).random(len(R))
    with pytest.raises(ValueError, match=r"expected a flow that (follows|rises with) the command"):
        identify_with_lag([U], [noise], sample_time_s=TS)


@pytest.mark.parametrize(
    "gain, time_constant_s, delay_s", [(0.5, 1.0, 0.0), (2.0, 8.0, 0.3), (0.7, 15.0, 0.6)]
)
def test_no_guess_is_needed_for_any_material(gain, time_constant_s, delay_s):
    true = Extruder(gain, time_constant_s, delay_s, yield_=0.1)
    u = R / gain
    model = identify([u], [flow(true, u, sample_time_s=TS)], sample_time_s=TS)
    np.testing.assert_allclose(
        parameters(model.extruder), parameters(true), rtol=1e-3, atol=1e-4
    )  # the solver's stop; a delay at its bound


def test_on_plants_of_the_family_the_errors_are_as_large_as_their_deviations():
    z = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        plant = draw(rng, gain=1.08, time_constant_s=2.7, steady_flow=STEADY)
        y = disturb(flow(plant, U, sample_time_s=TS), rng, steady_flow=STEADY, **NOISE)
        model = identify([U], [y], sample_time_s=TS)
        assert model.noise / STEADY == pytest.approx(
            0.031, abs=0.004
        )  # white noise, and what of the drift no parameter takes
        sigma = deviations(model, [U], [y], drift=0.01, trial_gain=0.01, sample_time_s=TS)
        z.append((parameters(model.extruder) - total(plant)) / sigma)
    # 16 draws know a deviation to 18 %; the play, which the model lacks, adds to each
    assert np.all(np.sqrt(np.mean(np.square(z), axis=0)) < 1.8) and np.all(
        np.sqrt(np.mean(np.square(z), axis=0)) > 0.5
    )


def test_a_second_trial_halves_the_variance():
    rng = np.random.default_rng(1)
    y = [disturb(flow(TRUE, U, sample_time_s=TS), rng, steady_flow=STEADY, **NOISE) for _ in range(2)]
    settings = {"drift": 0.01, "trial_gain": 0.01, "sample_time_s": TS}
    model = identify([U], y[:1], sample_time_s=TS)
    one, two = deviations(model, [U], y[:1], **settings), deviations(model, [U, U], y, **settings)
    np.testing.assert_allclose(
        np.square(two) / np.square(one), 0.5, rtol=0.01
    )  # the same model: only the count changes


def test_samples_that_were_not_observable_are_left_out():
    y = flow(TRUE, U, sample_time_s=TS)
    y[500:560] = np.nan
    model = identify([U], [y], sample_time_s=TS)
    np.testing.assert_allclose(parameters(model.extruder), parameters(TRUE), rtol=1e-4)  # the solver's stop


def test_a_spiky_learned_command_does_not_hide_the_yield():
    u = U + 20 * np.diff(U, prepend=0.0) / TS * 0.1
    model = identify(
        [U, u], [flow(TRUE, U, sample_time_s=TS), flow(TRUE, u, sample_time_s=TS)], sample_time_s=TS
    )
    np.testing.assert_allclose(parameters(model.extruder), parameters(TRUE), rtol=1e-4)  # the solver's stop


@pytest.mark.parametrize(
    "u, y, sentence",
    [
        (
            [U, U],
            [R, np.full(1230, np.nan)],
            r"expected at least 50 observable samples of flow but trial 1 has 0",
        ),
        ([np.ones(1230)], [R], r"the command never moves"),
        ([U], [-R], r"expected a flow that rises with the command but found a best gain of -"),
        (
            [U],
            [np.random.default_rng(0).standard_normal(1230) ** 2],
            r"expected a flow that follows the command but the best model fits .* same trial and clock",
        ),
    ],
)
def test_a_trial_that_tells_nothing_is_refused(u, y, sentence):
    with pytest.raises(ValueError, match=sentence):
        identify_with_lag(u, y, sample_time_s=TS)
