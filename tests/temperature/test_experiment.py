"""The next experiment: safe on the truth, forecast on the family, refused with a reason, worth playing."""

import sys

import numpy as np
import pandas
import pytest
import yaml

from pipeline import cli
from pipeline.store import artifacts, params
from pipeline.temperature import experiment
from pipeline.temperature.controllers import baseline
from pipeline.temperature.controllers.law import feasible_target
from pipeline.temperature.plant import hold_output, plant, simulate
from pipeline.temperature.settings import GenerateProbing, Plant, Tracking
from stages import generate_probing
from tests.temperature.test_propose_params import tree  # noqa: F401  the params files as shipped

ASKED = experiment.Wish(1500, "prbs", 5.0, 5.0, 1, 0.15, 8.0, 1)
ROOM, TAU, LATE = 25.0, 120.0, 3
HOLDS_200 = 38.0  # percent: left alone at 50 it would reach 255 °C


def hot_end(gain=1.0, tau=TAU):
    """A hot end that 38 % holds at 200 °C, its duty LATE samples late."""
    A = np.diag([1 - 1 / tau, *np.zeros(LATE)])
    A[0, 1] = (200 - ROOM) / HOLDS_200 * gain / tau
    A[1:LATE, 2:] += np.eye(LATE - 1)
    B = np.zeros((1 + LATE, 1))
    B[-1] = 1.0
    return plant(A, B, np.eye(1, 1 + LATE), b=[ROOM / tau, *np.zeros(LATE)])


def integrator(drift=0.0):
    """A block so well lagged that it keeps its heat: 20 % holds it at 100 °C, or nearly."""
    return plant([[1 - 1e-6]], [[0.05]], [[1.0]], b=[-0.05 * 20 + 1e-6 * 100 + drift])


def record_of(truth, y0, samples=1500, noise=0.1, moves=8.0, feedback=0.0):
    """u (T, 1), y (T, 1) about what holds y0, at the end at rest; and the true state there."""
    rng = np.random.default_rng(0)
    x, u0 = hold_output(truth, np.array([y0]))
    signal = moves * np.repeat(rng.choice([-1.0, 1.0], samples // 50), 50)
    signal[-600:] = 0.0
    u, y = np.empty((samples, 1)), np.empty((samples, 1))
    for t in range(samples):
        y[t] = truth.C @ x + truth.d
        u[t] = np.clip(u0 + signal[t] + feedback * (y0 - y[t]), 0, 100)
        x = truth.A @ x + truth.B @ u[t] + truth.b
    return u, y + noise * rng.standard_normal(y.shape), x


def wanted(family, reference, low, high, **asked):
    """The family, asked for an experiment about the reference within these limits."""
    return family._replace(
        asked=family.asked._replace(**asked),
        reference=np.array([reference]),
        y_low=np.array([low]),
        y_high=np.array([high]),
    )


def family_of(plants, u, y):
    limits = np.zeros(1), np.full(1, 100.0), np.zeros(1), np.full(1, 300.0)
    names = ["heater"], ["zone"]
    return experiment.family_of(plants, ([u], [y]), ASKED, limits, np.full(1, 200.0), names=names)


def pi_of(model, horizon):
    pairs = baseline.pairing(model, np.zeros(1), np.full(1, 100.0), horizon=horizon)
    return baseline.pi_law(pairs, inputs=1)


@pytest.fixture(scope="module")
def heated():
    """The hot end's record, its family, and the true state at its end."""
    u, y, x = record_of(hot_end(), 200.0)
    plants = [hot_end(), hot_end(0.96, 114.0), hot_end(1.04, 126.0)]
    return family_of(plants, u, y), x


def of_model(family, **doubt):
    """The family's first member alone, without a band and with these doubts alone."""
    none = {"doubt_input_gain": 0.0, "doubt_ambient_degC": 0.0, "doubt_delay_steps": 0}
    return family._replace(
        plants=family.plants[:1],
        begin=family.begin._replace(x=family.begin.x[:1], bias=family.begin.bias[:1]),
        band=experiment.Band(np.zeros(1), np.zeros(1)),
        asked=family.asked._replace(**(none | doubt)),
    )


def design(family, high, **more):
    return experiment.design(wanted(family, 200.0, 0.0, high, **more), np.random.default_rng(1))


# ---- safe


@pytest.mark.parametrize("high", [215.0, 230.0, 260.0])
@pytest.mark.parametrize("gain", [0.85, 1.0, 1.15])
def test_a_hot_end_at_38_percent_is_never_driven_above_its_limit(heated, high, gain):
    family, x = heated
    tried = design(family, high)
    assert tried.written
    # from now on the heater has another gain, which is what is doubted
    y = simulate(hot_end(), gain * tried.u, x)[1]
    warmed = ASKED.doubt_ambient_degC * -np.expm1(
        -np.arange(len(y)) / TAU
    )  # by an ambient that moved at the start
    assert (y[:, 0] + warmed).max() <= high
    assert tried.extremes.lowest <= y.min() and y.max() <= tried.extremes.highest


def test_what_is_written_starts_at_the_last_inputs_and_keeps_rate_and_range(heated):
    tried = design(heated[0], 260.0)
    steps = np.diff(np.vstack([heated[0].begin.u, tried.u]), axis=0)
    assert np.abs(steps).max() <= 5.0 + 1e-9  # percent a step; rounding
    assert tried.u.min() >= 0 and tried.u.max() <= 100


def test_a_lower_limit_takes_a_smaller_amplitude_or_a_cooler_centre_and_still_teaches(heated):
    wide, tight = design(heated[0], 260.0), design(heated[0], 215.0)
    assert wide.amplitude > tight.amplitude or wide.target > tight.target
    assert abs(wide.target[0] - 200.0) < 1.0  # reachable with margin: the reference itself
    assert tight.lesson.gain_error[0, 0] < experiment.USEFUL


def test_the_forecast_of_a_member_is_its_simulation_within_the_doubt(heated):
    family, x = heated
    tried = design(family, 260.0)
    exact = experiment.forecast(of_model(family), tried.u)
    y = simulate(hot_end(), tried.u, x)[1]
    # the state at the end of the record is estimated from outputs with 0.1 °C of noise
    np.testing.assert_allclose([exact.highest[0], exact.lowest[0]], [y.max(), y.min()], atol=0.1)


def test_doubt_about_gains_is_exact_a_forecast_with_it_equals_the_worst_member(heated):
    family, _ = heated
    u = np.repeat([[38.0], [43.0], [33.0]], 300, axis=0)
    bound = experiment.forecast(of_model(family, doubt_input_gain=0.15), u)
    more = experiment.forecast(of_model(family), 1.15 * u)
    np.testing.assert_allclose(bound.highest, more.highest, rtol=1e-12)  # the same sums in another order


# ---- refused, with a reason


def test_what_hardly_settles_is_refused_open_loop_and_offered_around_its_controller():
    u, y, _ = record_of(integrator(), 100.0, feedback=1.0, moves=3.0)
    plants = [integrator(), integrator(0.1), integrator(-0.1)]
    family = family_of(plants, u, y)
    family = wanted(family, 100.0, 60.0, 140.0)
    tried = experiment.design(family, np.random.default_rng(1))
    assert not tried.written and not len(tried.u)
    assert "without its controller zone may" in tried.reason and "hardly settles by itself" in tried.reason
    law = pi_of(plants[0], 300)
    added = experiment.dither(family, law, np.random.default_rng(1))
    assert not added.reason and added.amplitude.min() > 0
    assert 60 <= added.extremes.lowest.min() and added.extremes.highest.max() <= 140


def test_a_dither_that_the_controller_cannot_hold_is_refused(heated):
    family, _ = heated
    law = pi_of(hot_end(), 600)
    added = experiment.dither(wanted(family, 200.0, 199.9, 200.1), law, np.random.default_rng(1))
    assert not len(added.u) and "its limits are 199.9 and 200.1" in added.reason


def test_a_limit_that_the_machine_may_leave_with_no_signal_at_all_is_refused_with_output_and_figure(heated):
    # the reference is below what the ambient alone may add, and a limit at both sides leaves no other centre
    tried = experiment.design(wanted(heated[0], 200.0, 195.0, 206.0), np.random.default_rng(1))
    assert not tried.written
    assert "even with no signal played" in tried.reason and "zone" in tried.reason


def test_an_amplitude_that_teaches_nothing_is_not_written(heated):
    family, _ = heated
    noisy = family._replace(band=family.band._replace(noise=np.array([500.0]), error=np.array([0.1])))
    # a sensor of 500 °C noise whose band is set aside: safe, but of no use
    noisy = noisy._replace(band=experiment.Band(np.array([30.0]), np.array([0.1])))
    tried = design(noisy, 320.0, samples=120)
    assert not tried.written and "would leave its gain unknown" in tried.reason


def test_without_declared_limits_nothing_is_written_and_the_reason_says_what_to_declare(tree):  # noqa: F811
    text = (tree / "params.yaml").read_text().replace("reference: 150, low: 0, high: 250", "reference: 150")
    (tree / "params.yaml").write_text(text)
    loaded = [
        params.load(model, section)
        for model, section in (
            (GenerateProbing, "generate_probing"),
            (Plant, "plant"),
            (Tracking, "tracking"),
        )
    ]
    commands, dither, figures = generate_probing.design(*loaded, [], [], [])
    assert not commands and not dither
    for key in ("next_experiment", "closed_loop"):
        assert figures[key]["reason"] == "declare low and high of sensor_1 under plant.outputs"


def test_a_machine_without_an_input_for_each_output_is_offered_no_dither_and_told_why(tree):  # noqa: F811
    sections = yaml.safe_load((tree / "params.yaml").read_text())
    sections["plant"]["inputs"] = sections["plant"]["inputs"][:1]
    sections["plant"]["outputs"] = [
        {"name": f"zone_{k}", "unit": "degC", "reference": 60, "low": 0, "high": 150} for k in (1, 2)
    ]
    (tree / "params.yaml").write_text(yaml.safe_dump(sections))
    machine = params.load(Plant, "plant")
    A = np.diag([0.98, 0.99])
    two = plant(A, [[0.02], [0.01]], np.eye(2), b=(np.eye(2) - A) @ np.full(2, ROOM))
    u = 30 + 5 * np.repeat(np.random.default_rng(0).choice([-1.0, 1.0], (12, 1)), 50, axis=0)
    y = simulate(two, u, hold_output(two, np.full(2, 55.0))[0])[1]
    y += 0.05 * np.random.default_rng(1).standard_normal(y.shape)
    settings = params.load(GenerateProbing, "generate_probing")
    tracking_section = params.load(Tracking, "tracking")
    commands, dither, figures = generate_probing.design(
        settings, machine, tracking_section, [two, two], [u], [y]
    )
    assert figures["next_experiment"]["written"], figures["next_experiment"]["reason"]
    assert list(commands) == ["time_s", "heater_1"] and not dither
    assert "PI needs an input for each of the 2 outputs" in figures["closed_loop"]["reason"]
    artifacts.write_metrics("generate_probing", figures)  # every figure is one that JSON knows


# ---- worth playing


def test_power_lies_where_the_plant_answers():
    speed = experiment.Pace(
        np.array([[100.0]]), np.zeros((1, 1)), np.ones((1, 1)), np.ones((1, 1), bool), 100, 100
    )
    for kind in ("prbs", "multisine"):
        asked = ASKED._replace(signal=kind)
        signal = experiment.signal(np.random.default_rng(0), 4000, asked, speed)[:, 0]
        assert abs(signal.mean()) < 0.02 and np.abs(signal).max() == pytest.approx(1.0)
        power = np.abs(np.fft.rfft(signal)) ** 2
        slow = 2 * np.pi * np.arange(len(power)) / 4000 < 10 / 100.0  # ten times the corner frequency
        # white noise has 3 % of its power there
        assert power[slow].sum() > 0.85 * power.sum(), kind


def test_band_limited_amplitude_teaches_more_than_the_white_signal_of_the_same_amplitude(heated):
    family, _ = heated
    rng, noise = np.random.default_rng(0), family.band.noise
    own = experiment.signal(rng, 1500, ASKED, family.pace)
    white = rng.choice([-1.0, 1.0], (1500, 1))
    assert (
        experiment.lesson(own, family.pace, noise).information
        > 5 * experiment.lesson(white, family.pace, noise).information
    )


def test_the_expected_errors_are_those_of_fitted_first_order_models():
    rng, tau, K = np.random.default_rng(2), 60.0, 2.0
    speed = experiment.Pace(
        np.array([[tau]]), np.zeros((1, 1)), np.array([[K]]), np.ones((1, 1), bool), tau, tau
    )
    u = experiment.signal(rng, 1500, ASKED, speed)
    truth = experiment.response(u[:, 0], tau, 0.0, 1.0)
    slope = (experiment.response(u[:, 0], 1.01 * tau, 0.0, 1.0) - truth) / 0.01
    J = np.column_stack([K * truth, K * slope, np.ones(len(truth))])
    errors = []
    for _ in range(400):
        y = K * truth + 0.5 * rng.standard_normal(len(truth))
        errors.append(np.linalg.lstsq(J, y - K * truth, rcond=None)[0][:2])
    expected = experiment.lesson(u, speed, np.array([0.5]))
    # the spread of 400 draws is known within 4 %; the slope is a one-sided difference
    np.testing.assert_allclose(
        np.std(errors, axis=0), [expected.gain_error[0, 0], expected.time_constant_error[0, 0]], rtol=0.12
    )


def test_exact_knowledge_leaves_no_gap_and_a_wrong_gain_leaves_one(heated):
    family, _ = heated
    nothing = np.zeros((1, 1))
    assert experiment.expected_gap(
        family.model, experiment.Lesson(1.0, nothing, nothing), 0.99
    ) == pytest.approx(0)
    wrong = experiment.Lesson(1.0, np.full((1, 1), 0.3), nothing)
    assert experiment.expected_gap(family.model, wrong, 0.99) > 1e-4


# ---- a feasible target with all the slack there is


def test_a_target_in_the_middle_of_the_limits_is_found():
    weak = plant([[0.9]], [[1e-7]], [[1.0]], b=[2.0])
    target = feasible_target(weak, np.array([20.0]), np.zeros(1), np.full(1, 100.0))
    assert target.slack <= 49.0 and abs(target.miss[0]) < 1e-2


# ---- without any model


def test_a_first_experiment_is_a_staircase_with_stops_below_the_limits(tree, monkeypatch, capsys):  # noqa: F811
    monkeypatch.setattr(sys, "argv", ["beadline", "experiment", "temperature", "--hold", "120"])
    cli.main()
    text = capsys.readouterr().out
    assert "nobody has forecast" in text and "Stop at: sensor_1 187.5 °C" in text
    table = pandas.read_csv("first_experiment.csv")
    heaters = table[[f"heater_{k}" for k in range(1, 7)] + ["motor"]]
    assert (heaters.gt(0).sum(axis=1) <= 1).all()  # one at a time
    assert heaters.max().max() == 20 and (heaters.iloc[[0, -1]] == 0).all(axis=None)
    assert (table["sensor_1_stop_degC"] == 187.5).all() and table["start_s"].diff().iloc[1] == 120


def test_without_declared_limits_there_is_no_first_experiment(tree, monkeypatch, capsys):  # noqa: F811
    text = (tree / "params.yaml").read_text().replace("reference: 150, low: 0, high: 250", "reference: 150")
    (tree / "params.yaml").write_text(text)
    monkeypatch.setattr(sys, "argv", ["beadline", "experiment", "temperature"])
    with pytest.raises(SystemExit):
        cli.main()
    assert "plant.outputs: sensor_1 should have low and high" in capsys.readouterr().err
    assert not (tree / "first_experiment.csv").exists()
