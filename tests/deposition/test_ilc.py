"""The laws on plants that they were not fitted to, judged by the true flow; the convergence test, the limits
of the drive, and the loop with roll-back."""

import numpy as np
import pytest

from pipeline.deposition.drive import UNLIMITED, Drive, obeyed
from pipeline.deposition.extruder import Extruder, disturb, draw, flow, frequency_response, pressed, routine
from pipeline.deposition.learning import ilc, training
from pipeline.deposition.learning.trial_model import SMOOTHED_HZ
from pipeline.papers.deposition import causal_q
from tests.foreign import deposition as foreign_deposition
from tests.foreign import displacing
from tests.foreign import extruders as foreign_extruders
from tests.foreign.syringe import PneumaticSyringe

TS = 0.02
MATERIALS = {"A": Extruder(1.08, 2.7), "B": Extruder(0.89, 4.5)}
NOISE = {"white": 0.03, "drift": 0.01, "gain": 0.01}
HOELZLE = ilc.HoelzleSettings(learning_gain=0.25, fast_zero_s=0.03, order=2, cutoff_hz=3.0)
HOELZLE_Q = {"order": 2, "cutoff_hz": 3.0}
INVERSE = ilc.InverseSettings(identify_trials=3, floor=0.1, order=4, cutoff_hz=5.0)
F = np.linspace(0.0, 24.9, 2000)


def reference(ramp_s=0.15, sample_time_s=TS):
    phases = {"off_s": 4, "on_s": 6, "pause_s": 0.6, "tail_s": 8}
    return routine(**phases, speed=8.0, bead_area_mm2=0.304, ramp_s=ramp_s, sample_time_s=sample_time_s).r


R = reference()
STEADY = R.max()


def family(seed, count):
    rng = np.random.default_rng(seed)
    for name in ("AB" * count)[:count]:
        yield (
            name,
            draw(
                rng,
                gain=MATERIALS[name].gain,
                time_constant_s=MATERIALS[name].time_constant_s,
                steady_flow=STEADY,
            ),
        )


def machine(plant, seed=0, drive=UNLIMITED, noise=NOISE, sample_time_s=TS, run=flow):
    rng = np.random.default_rng(seed)

    def measure(u):
        y = run(plant, u, sample_time_s=sample_time_s, drive=drive)
        return ilc.Trial(
            obeyed(u, drive, sample_time_s=sample_time_s), disturb(y, rng, steady_flow=STEADY, **noise), y
        )

    return measure


def hoelzle_2009(nominal, q=ilc.zero_phase, drive=UNLIMITED):
    return ilc.hoelzle_law(R, nominal, q, HOELZLE, drive=drive, sample_time_s=TS)


def model_inverse(r=R, drive=UNLIMITED, sample_time_s=TS, **changes):
    return ilc.InverseLaw(r, INVERSE._replace(**changes), drive=drive, sample_time_s=sample_time_s)


def ratios(law, measure, nominal, trials, r=R, drive=UNLIMITED, rise=0.1):
    """Percent of trial 0, (trials + 1,), by the true flow."""
    done = ilc.learn(
        law, measure, obeyed(r / nominal.gain, drive, sample_time_s=TS), r, trials=trials, rise=rise
    )
    rows = ilc.table(done, r, steady=STEADY / nominal.gain, drive=drive, sample_time_s=TS, rise=rise)
    return 100 * np.array([row.ratio for row in rows])


# ---- Q


def test_the_zero_phase_filter_keeps_a_symmetric_pulse_symmetric_and_the_causal_one_delays_it():
    pulse = np.exp(-(((np.arange(401) - 200) / 15.0) ** 2))
    both, once = (q(pulse, order=4, cutoff_hz=3.0, sample_time_s=TS) for q in (ilc.zero_phase, causal_q))
    np.testing.assert_allclose(
        both, both[::-1], atol=1e-9
    )  # what the filter still rings at the padding's end
    assert np.argmax(both) == 200 and np.argmax(once) > 203


def test_a_sine_passes_the_zero_phase_filter_with_the_square_of_its_magnitude():
    t = np.arange(4000) * TS
    passed = ilc.zero_phase(np.sin(2 * np.pi * 2.0 * t), order=2, cutoff_hz=3.0, sample_time_s=TS)[1500:2500]
    gain = ilc.magnitude(np.array([2.0]), order=2, cutoff_hz=3.0, sample_time_s=TS)[0] ** 2
    np.testing.assert_allclose(
        passed, gain * np.sin(2 * np.pi * 2.0 * t[1500:2500]), atol=1e-9
    )  # the ends have died out


def test_a_cut_off_above_half_the_sampling_rate_is_refused():
    with pytest.raises(
        ValueError,
        match=(
            r"expected a cut-off between 0 and half the sampling rate, 5 Hz, but found 6 Hz; lower the "
            r"cut-off or sample faster"
        ),
    ):
        ilc.zero_phase(R, order=4, cutoff_hz=6.0, sample_time_s=0.1)


# ---- the convergence test


@pytest.mark.parametrize("delay_s, expected", [(0.0, 0.76), (0.1, 0.92), (0.12, 0.96), (0.15, 1.03)])
@pytest.mark.parametrize("name", "AB")
def test_gamma_of_the_papers_law_grows_with_unmodelled_delay_and_passes_one_at_150_ms(
    name, delay_s, expected
):
    nominal = MATERIALS[name]
    Q = ilc.magnitude(F, sample_time_s=TS, **HOELZLE_Q) ** 2
    P = frequency_response(nominal._replace(delay_s=delay_s), F, sample_time_s=TS)
    gamma = ilc.gamma(Q, ilc.hoelzle_filter(F, nominal, HOELZLE, sample_time_s=TS), P)
    assert gamma == pytest.approx(expected, abs=0.01)  # published to two digits, for their own discretisation
    assert (gamma > 1) == (delay_s == 0.15)


def test_gamma_is_the_factor_by_which_the_worst_sine_shrinks():
    nominal, plant = MATERIALS["A"], MATERIALS["A"]._replace(delay_s=0.15)
    L, P = (
        ilc.hoelzle_filter(F, nominal, HOELZLE, sample_time_s=TS),
        frequency_response(plant, F, sample_time_s=TS),
    )
    Q = ilc.magnitude(F, sample_time_s=TS, **HOELZLE_Q) ** 2
    worst = F[np.argmax(np.abs(Q * (1 - L * P)))]
    # the law's homogeneous part on a long sine: Q (u - L P u), away from the ends
    t = np.arange(6000) * TS
    u = np.sin(2 * np.pi * worst * t)
    y = flow(plant._replace(yield_=-1e6), u, sample_time_s=TS) - 1e6
    law = ilc.hoelzle_law(np.zeros(6000), nominal, ilc.zero_phase, HOELZLE, drive=UNLIMITED, sample_time_s=TS)
    after = law([ilc.Trial(u, y)])[2500:3500]
    assert np.sqrt(np.mean(after**2) / 0.5) == pytest.approx(
        ilc.gamma(Q, L, P), rel=0.01
    )  # a frequency on a grid of 0.012 Hz, 1000 samples of it


def test_gamma_of_the_model_inverse_stays_far_below_one_on_every_plant_of_the_family():
    Q = ilc.magnitude(F, order=4, cutoff_hz=5.0, sample_time_s=TS) ** 2
    for i, (name, plant) in enumerate(family(5, 12)):
        law, measure = model_inverse(), machine(plant, seed=i)
        law(ilc.learn(law, measure, R / MATERIALS[name].gain, R, trials=2, rise=0.1))
        L = ilc.inverse_filter(F, law.model.extruder, sample_time_s=TS)
        assert ilc.gamma(Q, L, frequency_response(plant, F, sample_time_s=TS)) < 0.8  # 0.1 to 0.4 are usual


# ---- the paper's law


@pytest.mark.parametrize("name", "AB")
def test_the_papers_law_on_the_nominal_plant_comes_below_20_percent_by_trial_8_and_to_4_to_6_at_30(name):
    percent = ratios(hoelzle_2009(MATERIALS[name]), machine(MATERIALS[name]), MATERIALS[name], 30)
    assert percent[8] < 20 and 4 <= percent[30] <= 6


@pytest.mark.parametrize("name", "AB")
def test_the_papers_law_survives_100_ms_and_diverges_at_150_ms_unless_rolled_back(name):
    nominal = MATERIALS[name]
    assert ratios(hoelzle_2009(nominal), machine(nominal._replace(delay_s=0.1)), nominal, 30)[30] <= 15
    late = nominal._replace(delay_s=0.15)
    alone = ratios(hoelzle_2009(nominal), machine(late), nominal, 120, rise=np.inf)
    assert alone[16] < 25 and alone[120] > 40 and alone[120] > 2 * alone[16]
    done = ilc.learn(hoelzle_2009(nominal), machine(late), R / nominal.gain, R, trials=120, rise=0.1)
    step = ilc.next_step(done, R, hoelzle_2009(nominal), rise=0.1)
    errors = [ilc.rms(R - trial.truth) for trial in done]
    # noise may pick a trial a little above the least true error
    assert errors[step.best] < 1.1 * min(errors) and 100 * max(errors[3:]) / errors[0] < 50


@pytest.mark.parametrize("name", "AB")
def test_a_causal_q_leaves_a_third_of_the_error(name):
    percent = ratios(
        hoelzle_2009(MATERIALS[name], causal_q),
        machine(MATERIALS[name], noise=dict.fromkeys(NOISE, 0.0)),
        MATERIALS[name],
        40,
        rise=np.inf,
    )
    assert percent.min() > 35


# ---- the model inverse


def test_of_one_trial_the_model_inverse_is_q_of_u_plus_l_e():
    plant, u = Extruder(1.2, 3.0, 0.1), R / 1.08
    y = flow(plant, u, sample_time_s=TS) + 0.05 * np.sin(np.arange(len(R)) / 20)
    law = model_inverse()
    u1 = law([ilc.Trial(u, y)])
    model = law.model.extruder
    plain = ilc.zero_phase(
        u + ilc.inverse(R - y, model._replace(yield_=0.0), sample_time_s=TS),
        order=4,
        cutoff_hz=5.0,
        sample_time_s=TS,
    )
    printing = R > 0  # outside the law leaves alone what no flow tells of
    # the sine stays in the yield, which is a few percent of the flow; both are brought through the same Q
    assert np.abs(u1 - plain)[printing].mean() < 0.05 * np.abs(plain)[printing].mean()


def test_the_inverse_presses_out_the_flow_that_is_asked_for():
    model, x = Extruder(1.2, 3.0, 0.113), ilc.zero_phase(R, order=4, cutoff_hz=5.0, sample_time_s=TS)
    u = ilc.inverse(x, model, sample_time_s=TS)
    np.testing.assert_allclose(
        pressed(model, u, sample_time_s=TS), x, atol=1e-4 * STEADY
    )  # EPSILON at 5 Hz, where |H| is K / 100


def test_the_model_inverse_on_a_dozen_plants_of_the_family():
    percent = np.array(
        [
            ratios(model_inverse(), machine(plant, seed=i), MATERIALS[name], 20)
            for i, (name, plant) in enumerate(family(11, 12))
        ]
    )
    assert percent[:, 2].max() <= 20 and percent[:, 3].max() <= 10  # the bars for 95 % and 90 % of 200 plants
    assert (
        np.median(percent[:, 15]) <= 1.5 and percent[:, 20].max() <= 3
    )  # 3 and 6 are asked for; 0.9 and 2 are usual


def test_the_model_inverse_within_ten_times_the_steady_command_and_half_second_ramps():
    r = reference(0.5)
    drives = {name: Drive(10 * STEADY / nominal.gain, np.inf, 0.0) for name, nominal in MATERIALS.items()}
    percent = [
        ratios(
            model_inverse(r, drives[name]),
            machine(plant, i, drives[name]),
            MATERIALS[name],
            15,
            r,
            drives[name],
        )[15]
        for i, (name, plant) in enumerate(family(12, 8))
    ]
    assert np.median(percent) <= 2 and max(percent) <= 6  # the bar is a median of 4


@pytest.mark.parametrize(
    "gain, time_constant_s, sample_time_s, ramp_s",
    [(0.5, 1.0, 0.02, 0.15), (2.0, 8.0, 0.02, 0.3), (1.08, 2.7, 0.01, 0.15), (0.89, 4.5, 0.05, 1.0)],
)
def test_other_materials_sample_times_and_ramps_are_learned_alike(
    gain, time_constant_s, sample_time_s, ramp_s
):
    r, rng, nominal = (
        reference(ramp_s, sample_time_s),
        np.random.default_rng(3),
        Extruder(gain, time_constant_s),
    )
    plant = draw(rng, gain=gain, time_constant_s=time_constant_s, steady_flow=STEADY)
    percent = ratios(
        model_inverse(r, sample_time_s=sample_time_s),
        machine(plant, 3, sample_time_s=sample_time_s),
        nominal,
        15,
        r,
    )
    assert percent[2] <= 20 and percent[3] <= 10 and percent[15] <= 3


def thinning(plant, u, *, sample_time_s, drive):
    """A plant that no model here can be: flow as pressure to the power 0.7."""
    x = flow(plant._replace(yield_=0.0), u, sample_time_s=sample_time_s, drive=drive) / STEADY
    return STEADY * x**0.7


def test_a_plant_of_another_kind_is_learned_because_the_first_learned_trial_is_identified_too():
    plant = Extruder(1.2, 3.0, 0.1, 4.5, 0.05)
    with_it = ratios(model_inverse(), machine(plant, run=thinning), MATERIALS["A"], 12)
    without = ratios(model_inverse(identify_trials=1), machine(plant, run=thinning), MATERIALS["A"], 12)
    assert with_it[2] < 12 and with_it[12] < 4 and without[12] > 3 * with_it[12]


def test_averaging_over_trials_goes_below_what_one_trial_at_a_time_can():
    name, plant = next(family(13, 1))
    averaged, last_only = (
        ratios(model_inverse(floor=floor), machine(plant), MATERIALS[name], 30)[10:].mean()
        for floor in (0.1, 1.0)
    )
    assert averaged < 0.6 * last_only  # sqrt(0.1 / 1.9) of the noise, plus what Q and the ramps leave


def test_a_pause_that_no_camera_sees_does_not_disturb_what_is_learned():
    name, plant = next(family(14, 1))
    measure = machine(plant)

    def blind(u):
        trial = measure(u)
        hidden = (np.arange(len(R)) * TS > 10.1) & (np.arange(len(R)) * TS < 10.5)
        return trial._replace(y=np.where(hidden, np.nan, trial.y))

    assert ratios(model_inverse(), blind, MATERIALS[name], 15)[15] < 4  # 1 where the pause is seen


def test_a_machine_of_third_order_is_learned_because_its_lag_is_identified():
    plant = foreign_deposition.plant("third_order", "B", 1)
    percent = foreign_deposition.learned_percent(plant, "B", 1)
    # 6 and still falling slowly where all that is late is taken for delay
    assert percent[5] < 4 and percent[15:].max() < 3


# ---- limits


def longer_routine(speed, pause_s):
    return routine(
        off_s=4, on_s=14, pause_s=pause_s, tail_s=8, speed=speed, bead_area_mm2=0.304, ramp_s=0.15,
        sample_time_s=TS,
    )  # fmt: skip


def third_order_learned(task, trials):
    """The law and its trials on a machine with lags of 0.06 and 0.17 s."""
    foreign, rng = (
        foreign_extruders.ForeignExtruder(
            "third_order", 0.998, 5.24, 5.24, 0.119, 2.44, lags_s=(0.0615, 0.173)
        ),
        np.random.default_rng(0),
    )

    def measure(u):
        y = foreign_extruders.flow(foreign, u, sample_time_s=TS)
        return ilc.Trial(u, foreign_extruders.seen(y, rng, steady_flow=task.r.max()), y)

    law = model_inverse(task.r, identify_trials=2)
    return law, ilc.learn(law, measure, task.r / 0.89, task.r, trials=trials, rise=0.1)


@pytest.mark.parametrize("speed, pause_s", [(8.0, 0.6), (5.0, 0.3)])
def test_a_machine_of_third_order_is_not_driven_wild_on_a_longer_routine(speed, pause_s):
    task = longer_routine(speed, pause_s)
    law, trials = third_order_learned(task, 12)
    assert law.model.extruder.lag_hz < 1.2  # the two lags, taken for one of 0.85 Hz
    error = np.array([ilc.rms(task.r - trial.truth) for trial in trials])
    assert error[-1] < 0.06 * error[0] and error[-1] < 1.5 * error[1:].min()
    # what the ramps need of a machine of these lags is 70 times the steady command
    assert max(np.abs(trial.u).max() for trial in trials) < 100 * trials[0].u.max()


def test_the_convergence_test_counts_where_q_ends(monkeypatch):
    task = longer_routine(8.0, 0.6)
    law, trials = third_order_learned(task, 2)
    rows = ilc.table(trials, task.r, steady=1.0, drive=UNLIMITED, sample_time_s=TS, rise=0.1)
    sequence = training.TrialSequence("model_inverse", task, trials, rows, law.model)
    settings = training.LawSettings(TS, UNLIMITED, HOELZLE, law.settings, 0.1)

    def gamma():
        rng, noise = np.random.default_rng(0), training.Noise(0.03, 0.01, 0.01)
        return training.convergence_of_model_inverse(sequence, rng, noise, plants=2, settings=settings)[0]

    ending = gamma()
    monkeypatch.setattr(ilc, "known_share", lambda f, model: np.ones_like(f))
    assert ending < 0.9 * gamma()


def test_the_inverse_of_a_slow_lag_is_bounded_and_a_fast_lag_is_inverted_as_it_was():
    slow, fast = Extruder(1.0, 5.0, 0.05, 0.85), Extruder(1.0, 5.0, 0.05, 5.0)
    lag = np.abs(frequency_response(slow, F, sample_time_s=TS))
    lag /= np.abs(frequency_response(slow._replace(lag_hz=np.inf), F, sample_time_s=TS))
    share = ilc.known_share(F, slow)
    assert (share / lag)[F < 15].max() < 0.8 * ilc.LAG_INVERSE  # beyond, T has fallen below 1e-6
    assert share[F < 1].min() > 0.99 and share[F > 5].max() < 0.01
    assert ilc.known_share(F, fast)[F < 5].min() > 0.99
    assert (ilc.known_share(F, slow._replace(lag_hz=np.inf)) == 1).all()
    x = ilc.zero_phase(R, order=4, cutoff_hz=5.0, sample_time_s=TS)
    kept = ilc.known(np.stack([x, 2 * x]), fast, sample_time_s=TS)
    np.testing.assert_allclose(kept, [x, 2 * x], atol=1e-3 * STEADY)


def test_no_frequency_of_the_learned_command_has_more_than_three_times_what_the_model_asks_for():
    t = np.arange(len(R)) * TS
    x = ilc.zero_phase(R, order=4, cutoff_hz=5.0, sample_time_s=TS)
    np.testing.assert_allclose(ilc.bounded(x, 2.9 * x, sample_time_s=TS), 2.9 * x, atol=1e-9)
    np.testing.assert_allclose(ilc.bounded(x, 30 * x, sample_time_s=TS), 3 * x, atol=1e-9)
    wild = x + 2 * STEADY * np.sin(2 * np.pi * 4.0 * t) * np.hanning(len(t))
    limited = ilc.bounded(x, wild, sample_time_s=TS)
    assert np.abs(limited - x).max() < 0.1 * STEADY  # of 2 x steady
    assert not ilc.bounded(np.zeros_like(x), wild, sample_time_s=TS).any()


def test_what_is_learned_right_beside_a_frequency_that_is_asked_for_is_kept():
    t = np.arange(2000) * TS
    asked, learned = (np.sin(2 * np.pi * f * t) * np.hanning(len(t)) for f in (4.0, 4.0 + SMOOTHED_HZ / 4))
    np.testing.assert_allclose(ilc.bounded(asked, learned, sample_time_s=TS), learned, atol=0.02)
    far = np.sin(2 * np.pi * (4.0 + 4 * SMOOTHED_HZ) * t) * np.hanning(len(t))
    assert np.abs(ilc.bounded(asked, far, sample_time_s=TS)).max() < 0.1


def test_what_a_law_learns_of_a_disturbed_trial_is_bounded_by_what_its_model_asks_for():
    t, law = np.arange(len(R)) * TS, model_inverse()
    truth = flow(Extruder(1.2, 3.3, 0.08), R / 1.08, sample_time_s=TS)
    shaken = truth + STEADY * np.sin(2 * np.pi * 4.0 * t) * np.hanning(len(t))
    u = law([ilc.Trial(R / 1.08, shaken, truth)])
    model = law.model.extruder
    x = law._smooth(ilc.wanted(R, model.yield_, sample_time_s=TS), model)
    alone = ilc.inverse(x, model, sample_time_s=TS)
    assert np.abs(u).max() < 1.5 * np.abs(alone).max()  # 6 without the bound


def test_a_limit_just_above_the_steady_command_leaves_no_more_than_any_command_within_it_must():
    plant, amplitude = foreign_deposition.plant("plain", "B", 2), 3 * STEADY / MATERIALS["B"].gain
    drive = Drive(amplitude, np.inf, 0.0)
    exact = Extruder(plant.gain, plant.tau_up_s, plant.delay_s)
    assert 2 < amplitude * plant.gain / STEADY < 2.2  # this plant's steady command is larger than the nominal
    u = ilc.command(R, R, exact, drive=drive, sample_time_s=TS)
    error = ilc.rms(R - foreign_extruders.flow(plant, u, sample_time_s=TS))
    # by another method: a bounded quadratic program
    assert error <= 1.01 * foreign_deposition.reachable_error(plant, u, drive)


def test_the_forecast_says_what_the_limit_will_leave():
    name, plant = "B", next(p for n, p in family(16, 2) if n == "B")
    for times in (5, 20):
        drive = Drive(times * STEADY / MATERIALS[name].gain, np.inf, 0.0)
        law, u0 = model_inverse(drive=drive), obeyed(R / MATERIALS[name].gain, drive, sample_time_s=TS)
        percent = ratios(law, machine(plant, drive=drive), MATERIALS[name], 8, drive=drive)[8]
        forecast = ilc.actuator_headroom(
            R, u0, law.model.extruder, order=4, cutoff_hz=5.0, drive=drive, sample_time_s=TS
        )
        assert percent == pytest.approx(100 * forecast.ratio, abs=3.0)  # the bar


def test_the_peak_that_a_ramp_needs_follows_the_rule_of_thumb():
    model = Extruder(0.89, 4.5, 0.1)
    headroom = ilc.actuator_headroom(
        reference(0.5),
        reference(0.5) / 0.89,
        model,
        order=4,
        cutoff_hz=5.0,
        drive=Drive(99.0, np.inf, 0.0),
        sample_time_s=TS,
    )
    assert headroom.peak / headroom.steady == pytest.approx(
        1 + 4.5 / 0.5, rel=0.1
    )  # the steepest point lies half way up: 0.5 + tau / t_ramp


def test_a_command_never_leaves_its_limit_and_ends_nearer_than_one_that_is_cut():
    model, limit = Extruder(0.89, 4.5, 0.1), 5 * STEADY / 0.89
    x = ilc.zero_phase(R, order=4, cutoff_hz=5.0, sample_time_s=TS)
    u = ilc.command(x, R, model, drive=Drive(limit, np.inf, 0.0), sample_time_s=TS)
    cut = np.clip(ilc.inverse(x, model, sample_time_s=TS), -limit, limit)
    assert np.abs(u).max() <= limit
    assert np.abs(u[: round(1 / TS)]).max() < 1e-3 * STEADY  # at rest, long before the line
    near, far = (ilc.rms(R - flow(model, v, sample_time_s=TS)) for v in (u, cut))
    assert near < 0.5 * far


def test_limits_that_no_law_can_meet_are_refused_with_the_ramp_that_would_do():
    model = Extruder(0.89, 4.5)
    u0 = R / 0.89
    for times, sentence in (
        (
            2,
            r"need a peak command of 2\d\.\d x steady and the limit is 2\.0 x, so no law comes below \d\d% "
            r"of the error of trial 0; ramps of 4\.50 s would do",
        ),
        (
            0.9,
            r"the limit is 0\.9 x, .*; no ramp would do: print slower, or raise the limit "
            r"above the steady command",
        ),
    ):
        drive = Drive(times * STEADY / 0.89, np.inf, 0.0)
        headroom = ilc.actuator_headroom(R, u0, model, order=4, cutoff_hz=5.0, drive=drive, sample_time_s=TS)
        with pytest.raises(ValueError, match=sentence):
            ilc.check_headroom(headroom, drive=drive, worst_ratio=0.2)
    wide = ilc.actuator_headroom(
        R, u0, model, order=4, cutoff_hz=5.0, drive=Drive(100 * STEADY, np.inf, 0.0), sample_time_s=TS
    )
    ilc.check_headroom(wide, drive=Drive(100 * STEADY, np.inf, 0.0), worst_ratio=0.2)
    assert wide.ratio < 0.01  # what a Q of 5 Hz takes off these ramps


@pytest.mark.parametrize(
    ("amplitude", "speed"), [(3.0, np.inf), (np.inf, 0.7), (np.inf, 6.0), (1.5, 40.0), (50.0, 0.2)]
)
def test_the_ramp_that_would_do_is_the_shortest_whose_peak_and_speed_the_drive_can_follow(amplitude, speed):
    """In multiples of the steady command: the peak is 1 + tau / ramp, reached over the ramp."""
    model, steady = Extruder(0.89, 4.5), STEADY / 0.89
    drive = Drive(amplitude * steady, speed * steady, 0.0)
    found = ilc.actuator_headroom(
        R, R / 0.89, model, order=4, cutoff_hz=5.0, drive=drive, sample_time_s=TS
    ).ramp_s
    ramps = np.geomspace(1e-2, 1e3, 200_001)
    peaks = 1 + 4.5 / ramps
    would_do = (peaks <= amplitude) & (peaks / ramps <= speed)
    assert found == pytest.approx(ramps[would_do][0], rel=1e-3)


def test_a_drive_without_limits_needs_no_ramp():
    headroom = ilc.actuator_headroom(
        R, R / 0.89, Extruder(0.89, 4.5), order=4, cutoff_hz=5.0, drive=UNLIMITED, sample_time_s=TS
    )
    assert headroom.ramp_s == 0.0


# ---- the loop


def test_a_rise_is_followed_by_the_best_command_and_the_machine_that_gives_the_old_error_is_the_same():
    # the best is 1; trial 2 rises above 40 + 10; 3 repeats the best and gives what it gave
    risen = ilc.judge([100.0, 40.0, 55.0], rise=0.1)
    assert risen == ilc.LearningState([0, 1], 1, [False, False, True], [], True, share=0.5, drifts=False)
    same = ilc.judge([100.0, 40.0, 55.0, 41.0], rise=0.1)
    assert same == ilc.LearningState([0, 1, 3], 1, [False, False, True, False], [], False, 0.5, drifts=False)
    after = ilc.judge([100.0, 40.0, 55.0, 41.0, 39.0], rise=0.1)
    assert (after.keep, after.best, after.share) == ([0, 1, 3, 4], 4, 0.75)


def test_a_trial_worse_than_the_best_halves_the_share_and_a_new_best_gives_half_of_it_back():
    learned = [100.0, 40.0, 30.0, 20.0]
    assert ilc.judge([*learned, 22.9], rise=0.1).share == 1.0  # within 1.1 x 20 + 1
    assert ilc.judge([*learned, 23.1], rise=0.1).share == 0.5
    assert ilc.judge([*learned, 23.1, 19.0], rise=0.1).share == 0.75
    assert ilc.judge([*learned, 23.1, 19.0, 18.0, 17.0], rise=0.1).share == 1.0
    # the second in a row: the best command is sent again
    state = ilc.judge([*learned, 24.0, 24.0], rise=0.1)
    assert (state.share, state.repeat, state.best, state.keep) == (0.25, True, 3, [0, 1, 2, 3, 4, 5])
    # it gives its error: the law went too far. It does not: the machine drifts, and the law goes on alone
    same = ilc.judge([*learned, 24.0, 24.0, 21.0], rise=0.1)
    assert (same.share, same.repeat, same.drifts) == (0.25, False, False)
    drifting = ilc.judge([*learned, 24.0, 24.0, 25.0, 24.0, 26.0], rise=0.1)
    assert (drifting.share, drifting.repeat, drifting.drifts) == (1.0, False, True)


def test_a_law_that_is_never_rolled_back_always_goes_its_whole_way():
    assert ilc.judge([100.0, 40.0, 30.0, 20.0, 90.0, 300.0], rise=np.inf).share == 1.0


def test_the_error_that_repeats_leaves_out_white_noise_and_the_scale_of_one_picture():
    rng = np.random.default_rng(1)
    for flow_, tolerance in ((R, 0.01), (foreign_ripple(), 0.04)):
        noisy = 1.015 * flow_ + STEADY * 0.03 * rng.standard_normal(len(R))
        noisy[100:130] = np.nan
        assert ilc.repeating_error(R, noisy) == pytest.approx(ilc.rms(R - flow_), abs=tolerance * STEADY)
    assert ilc.repeating_error(R, 0.8 * R) > 0.15 * ilc.rms(R)


def foreign_ripple():
    return R * (1 + 0.1 * np.sin(np.arange(len(R)) * TS * 2 * np.pi / 4))


def test_a_machine_that_gives_another_error_for_the_best_command_has_changed():
    # 2 rises, and so does the best command again in 3: what is left is 2 and 3, of which 3 is the better
    changed = ilc.judge([100.0, 40.0, 75.0, 70.0], rise=0.1)
    assert changed == ilc.LearningState([2, 3], 3, [False, False, True, True], [2], False, 1.0, drifts=False)
    # trials are held against the machine as it is now: 65 is no rise, 81 is
    assert ilc.judge([100.0, 40.0, 75.0, 70.0, 65.0], rise=0.1).keep == [2, 3, 4]
    assert ilc.judge([100.0, 40.0, 75.0, 70.0, 81.0], rise=0.1).repeat
    twice = ilc.judge([100.0, 40.0, 75.0, 70.0, 30.0, 45.0, 46.0], rise=0.1)
    assert (twice.restarts, twice.keep, twice.best) == ([2, 5], [5, 6], 5)


def test_what_the_trials_scatter_anyway_is_no_rise():
    scattered = [100.0, 30.0, 8.0, 17.0, 9.0, 16.0, 8.0, 17.0]
    assert not ilc.judge([*scattered, 21.0], rise=0.1).repeat  # beyond 8 + 10, within 12.5 + 3 x 8.4
    assert ilc.judge([*scattered, 43.0], rise=0.1).repeat
    assert ilc.judge([*scattered, 26.0], rise=0.1).repeat  # within that, but three times the best
    assert ilc.judge([100.0, 30.0, 5.0, 5.1, 4.9, 5.0, 5.2, 5.0, 18.0], rise=0.1).repeat
    creeping = [100.0, 30.0, *(5 + 1.5 * j for j in range(7)), 15.5]
    assert ilc.judge(creeping, rise=0.1).repeat


def test_the_law_of_a_changed_machine_is_given_its_trials_alone_and_after_one_rise_half_its_step():
    r, given = np.ones(4), []

    def law(trials):
        given.append([float(trial.u[0]) for trial in trials])
        return trials[-1].u + 2

    def step(*errors):
        return ilc.next_step(
            [ilc.Trial(np.full(4, float(j)), r - error) for j, error in enumerate(errors)], r, law, rise=0.1
        )

    again = step(1.0, 0.4, 0.9)
    assert (again.best, again.rolled_back, again.restarts) == (1, True, [])
    np.testing.assert_array_equal(again.u, np.full(4, 1.0))  # the best command
    half = step(1.0, 0.4, 0.9, 0.41)
    np.testing.assert_array_equal(half.u, np.full(4, 3.0))  # best 1, law 3 + 2, half way
    changed = step(1.0, 0.4, 0.9, 0.8)
    assert (changed.restarts, changed.best, given[-1]) == ([2], 3, [2.0, 3.0])
    np.testing.assert_array_equal(changed.u, np.full(4, 5.0))


@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_a_gain_that_steps_is_learned_anew_within_three_trials_and_learning_goes_on(factor):
    name, plant = next(family(17, 1))
    old, new = machine(plant), machine(plant._replace(gain=factor * plant.gain), seed=1)
    count = iter(range(40))
    measure = lambda u: (old if next(count) < 10 else new)(u)  # noqa: E731
    done = ilc.learn(model_inverse(), measure, R / MATERIALS[name].gain, R, trials=20, rise=0.1)
    percent = np.array([100 * ilc.rms(R - t.truth) / ilc.rms(R - done[0].truth) for t in done])
    assert ilc.state_of(done, R, rise=0.1).restarts == [10]
    assert len(done) == 21 and percent[10] > 25 and percent[12:].max() <= 5 and percent[20] < 2.5


@pytest.mark.parametrize("drift", [-0.01, 0.01])
def test_a_gain_that_drifts_one_percent_a_trial_is_followed_and_no_change_is_called(drift):
    name, plant = next(family(18, 1))
    count = iter(range(40))

    def measure(u):
        j = next(count)
        return machine(plant._replace(gain=plant.gain * (1 + drift) ** j), seed=j)(u)

    done = ilc.learn(model_inverse(), measure, R / MATERIALS[name].gain, R, trials=30, rise=0.1)
    percent = np.array([100 * ilc.rms(R - t.truth) / ilc.rms(R - done[0].truth) for t in done])
    # a mean over the trials would be 20 % behind at the end
    assert np.median(percent[10:]) < 3 and percent[10:].max() < 6
    assert ilc.state_of(done, R, rise=0.1).restarts == []


def test_one_spoilt_trial_is_left_out_and_taken_for_no_change():
    name, plant = next(family(19, 1))
    count, whole = iter(range(40)), machine(plant)

    def measure(u):
        trial = whole(u)
        return trial._replace(y=0.6 * trial.y) if next(count) == 8 else trial

    done = ilc.learn(model_inverse(), measure, R / MATERIALS[name].gain, R, trials=15, rise=0.1)
    state = ilc.state_of(done, R, rise=0.1)
    percent = [100 * ilc.rms(R - t.truth) / ilc.rms(R - done[0].truth) for t in done]
    assert state.restarts == [] and 8 not in state.keep
    np.testing.assert_array_equal(done[9].u, done[ilc.state_of(done[:9], R, rise=0.1).best].u)
    assert max(percent[9:]) < 4


def test_a_folder_of_trials_continues_where_the_loop_left():
    name, plant = next(family(17, 1))
    # the trials before the rise, the repeat, and those of the machine that changed
    old, new = machine(plant), machine(plant._replace(gain=1.3 * plant.gain), seed=1)
    count = iter(range(9))
    measure = lambda u: (old if next(count) < 5 else new)(u)  # noqa: E731
    done = ilc.learn(model_inverse(), measure, R / MATERIALS[name].gain, R, trials=8, rise=0.1)
    for j in range(1, 9):
        np.testing.assert_array_equal(ilc.next_step(done[:j], R, model_inverse(), rise=0.1).u, done[j].u)


# plants of the seed on which the loop was built, which left their best behind
@pytest.mark.parametrize("kind, number", [("filament", 1), ("filament", 7), ("auger", 1), ("auger", 2)])
def test_learning_stays_at_its_best_on_an_extruder_whose_drive_is_not_declared(kind, number):
    percent = learned_by_displacing(kind, number, drive=False)
    assert np.median(percent[20:]) <= 1.3 * percent.min()


def learned_by_displacing(kind, number, *, drive):
    """Percent of trial 0, (31,), by the true flow, of a drawn displacing extruder."""
    kinds = (*displacing.STEADY_KINDS[:2], *displacing.CHANGING_KINDS)
    time_constant_s = np.exp(np.random.default_rng([11, 1000 + number]).uniform(np.log(0.15), np.log(2)))
    e = displacing.drawn(
        kind, np.random.default_rng([1, kinds.index(kind), number]), gain=1.0,
        time_constant_s=float(time_constant_s), steady_flow=STEADY,
    )  # fmt: skip
    limits = Drive(e.speed_limit, e.acceleration, 0.0) if drive else UNLIMITED
    rng, count = np.random.default_rng([1, 77, kinds.index(kind), number]), iter(range(31))

    def measure(u):
        true = displacing.flow(e, u, sample_time_s=TS, trial=next(count), rng=rng)
        return ilc.Trial(u, foreign_extruders.seen(true, rng, steady_flow=STEADY), true)

    done = ilc.learn(model_inverse(drive=limits), measure, R, R, trials=30, rise=0.1)
    return 100 * np.array([ilc.rms(R - t.truth) for t in done]) / ilc.rms(R - done[0].truth)


@pytest.mark.parametrize("number", range(3))
def test_a_pneumatic_syringe_that_cannot_suck_does_not_diverge_though_no_drive_is_declared(number):
    rng = np.random.default_rng([3, number])
    fill_s, vent_s, yield_mm, most = rng.uniform([0.3, 0.3, 0.05, 1.5], [1.5, 1.5, 0.3, 3.0])
    foreign = PneumaticSyringe(fill_s=fill_s, vent_s=vent_s, yield_mm=yield_mm)
    time_s = np.arange(len(R)) * TS

    def measure(u):
        true = foreign.flow(time_s, np.clip(u, 0.0, most * foreign.level))
        return ilc.Trial(u, foreign_extruders.seen(true, rng, steady_flow=STEADY), true)

    done = ilc.learn(model_inverse(), measure, R, R, trials=30, rise=0.1)
    errors = np.array([ilc.rms(R - t.truth) for t in done])
    assert errors[20:].max() <= 1.3 * errors.min()


def test_the_table_says_what_each_trial_was():
    u, r = np.array([0.0, 2.0, -2.0, 1.0]), np.ones(4)
    trials = [ilc.Trial(u, r - 0.5, r - 0.4), ilc.Trial(u / 2, np.array([0.9, np.nan, 1.1, 0.9]), r - 0.1)]
    first, second = ilc.table(
        trials, r, steady=0.5, drive=Drive(2.0, np.inf, 0.0), sample_time_s=TS, rise=0.1
    )
    assert first == ilc.TrialRow(0, pytest.approx(0.4), pytest.approx(0.5), 1.0, 4.0, 0.5, False)
    assert second == ilc.TrialRow(
        1, pytest.approx(0.1), pytest.approx(0.1), pytest.approx(0.25), 2.0, 0.0, False
    )


def test_a_trial_of_another_length_or_without_flow_is_refused_by_number():
    trials = [ilc.Trial(R, R), ilc.Trial(R[:-1], R[:-1])]
    with pytest.raises(
        ValueError,
        match=(
            r"trial 1: expected command and flow of 1230 samples, as the reference has, .* but found "
            r"\(1229,\)"
        ),
    ):
        ilc.next_step(trials, R, model_inverse(), rise=0.1)
    with pytest.raises(
        ValueError, match=r"trial 0: .* with 0 observable; leave the trial out or record it again"
    ):
        ilc.next_step([ilc.Trial(R, np.full(1230, np.nan))], R, model_inverse(), rise=0.1)
