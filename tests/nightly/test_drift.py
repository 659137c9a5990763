"""Drift, asked of the machine's own physics: what changed is named, what did not change raises nothing."""

import numpy as np
import pytest
import scipy.linalg

from pipeline.nightly import baseline, drift, mistakes
from pipeline.nightly.baseline import Baseline
from pipeline.store import artifacts
from pipeline.temperature.plant import Plant, plant, simulate
from pipeline.temperature.tracking import robust_observer_gain

SAMPLES, NOISE = 600, 0.1
SIGNALS = {"inputs": ["one", "two"], "outputs": ["left", "right"]}


def two_zones(*, gain=(1.0, 1.0), slower=(1.0, 1.0)) -> Plant:
    """60 and 90 s, 1.6 and 1.2 °C per percent, warming each other by a tenth; exact sampling at 1 s. The air
    around is at 20 °C."""
    tau = np.array([60.0, 90.0]) * slower
    F, G = np.array([[-1.1, 0.1], [0.1, -1.1]]) / tau[:, None], np.diag(np.array([1.6, 1.2]) * gain / tau)
    inputs = np.column_stack([G, 20.0 / tau])
    whole = scipy.linalg.expm(np.block([[F, inputs], [np.zeros((3, 5))]]))
    return plant(whole[:2, :2], whole[:2, 2:4], np.eye(2), b=whole[:2, 4])


MODEL = two_zones()._replace(K=robust_observer_gain(two_zones(), 1.0))
CAUSES = drift.causes(MODEL)


def heated(seed: int, samples: int = SAMPLES) -> np.ndarray:
    """Steps of 8 % every 20 s or more about 50 %."""
    bits = np.random.default_rng(seed).integers(0, 2, (-(-samples // 20), 2))
    return 50 + 8 * (2.0 * np.repeat(bits, 20, axis=0)[:samples] - 1)


def record(
    truth: Plant, seed: int, samples: int = SAMPLES, *, given=lambda u: u, air=0.0, read=lambda y: y
) -> tuple[np.ndarray, np.ndarray]:
    """A shift from equilibrium, with sensor noise of 0.1 °C: `given` is what the heaters give of the command,
    `air` (samples,) how much warmer it is, `read` what the sensors make of the temperature."""
    u = heated(seed, samples)
    # the air is one more input, which warms both zones by 1 °C a °C
    warms = (np.eye(2) - truth.A) @ np.ones((2, 1))
    both = truth._replace(B=np.hstack([truth.B, warms]), D=np.zeros((2, 3)))
    v = np.column_stack([given(u), np.broadcast_to(air, samples)])
    x0 = np.linalg.solve(np.eye(2) - truth.A, both.B @ v[0] + truth.b)
    noise = NOISE * np.random.default_rng([seed, 1]).standard_normal((samples, 2))
    return u, read(simulate(both, v, x0)[1]) + noise


@pytest.fixture(scope="module")
def machine() -> drift.ProductionModel:
    return drift.ProductionModel(MODEL, SAMPLES)


@pytest.fixture(scope="module")
def own(machine) -> Baseline:
    """Of four nights of the machine as it was, the air half a degree about what it is."""
    airs = (0.4, -0.3, 0.1, -0.5)
    nights = [[record(two_zones(), 900 + k, air=air)] for k, air in enumerate(airs)]
    return baseline.measured(machine, nights, baseline.Floors(0.03, 0.25))


def explained(machine, own, *segments) -> tuple[drift.DriftRecord, drift.Explanation]:
    return drift.explain_segments(machine, segments, own.scale, own.changes, own.usual(CAUSES))


def late(u: np.ndarray, by: tuple[int, int]) -> np.ndarray:
    return np.column_stack([drift.shifted(u[:, j], by[j]) for j in (0, 1)])


@pytest.mark.parametrize(
    ("truth", "spoilt", "kind", "channel", "value", "within"),
    [
        # of a share; three of its own deviations, a third of a percent here
        (two_zones(gain=(0.95, 1.0)), {}, "gain", 0, -0.05, 0.004),
        (two_zones(gain=(1.0, 1.1)), {}, "gain", 1, 0.10, 0.004),
        (two_zones(gain=(0.9, 0.9)), {}, "gain", -1, -0.10, 0.01),
        # of a rate, which falls to 1 / 1.05; a tenth of a second's sampling is lost on it
        (two_zones(slower=(1.05, 1.0)), {}, "time constant", 0, 1 / 1.05 - 1, 0.01),
        (two_zones(slower=(1.1, 1.1)), {}, "time constant", -1, 1 / 1.1 - 1, 0.01),
        # samples of a second
        (two_zones(), {"given": lambda u: late(u, (3, 0))}, "delay", 0, 3.0, 0.2),
        (two_zones(), {"given": lambda u: late(u, (0, 8))}, "delay", 1, 8.0, 0.3),
        # percent above which nothing more comes
        (two_zones(), {"given": lambda u: np.minimum(u, [100, 54])}, "saturation", 1, 54.0, 0.5),
        # °C: as well as the level of a night is known
        (two_zones(), {"read": lambda y: y + [1.5, 0]}, "offset", 0, 1.5, 0.2),
        (two_zones(), {"read": lambda y: y - [0, 1.5]}, "offset", 1, -1.5, 0.2),
    ],
)
def test_what_changed_is_named_and_measured(machine, own, truth, spoilt, kind, channel, value, within):
    for seed in (2, 3):
        _, told = explained(machine, own, record(truth, seed, **spoilt))
        fit = told.named[0].fit
        assert fit.cause == drift.DriftCause(kind, channel)
        assert fit.value == pytest.approx(value, abs=within)
        assert len(told.named) == 1


def test_two_changes_of_one_record_are_both_named(machine, own):
    both = record(two_zones(gain=(0.9, 1.0)), 4, given=lambda u: late(u, (0, 5)))
    named = {named.fit.cause: named.fit.value for named in explained(machine, own, both)[1].named}
    assert named[drift.DriftCause("gain", 0)] == pytest.approx(-0.1, abs=0.01)
    assert named[drift.DriftCause("delay", 1)] == pytest.approx(5.0, abs=0.3)


def a_sine(degC: float) -> np.ndarray:
    return degC * np.sin(2 * np.pi * np.arange(SAMPLES) / SAMPLES)


@pytest.mark.parametrize("air", [0.0, 3.0, -3.0, a_sine(5.0), np.linspace(-5.0, 5.0, SAMPLES)])
def test_a_machine_that_did_not_change_raises_nothing_whatever_the_air_does(machine, own, air):
    for seed in range(10, 14):
        assert explained(machine, own, record(two_zones(), seed, air=air))[1].named == []


def test_the_air_of_another_season_is_told_from_a_gain(machine, own):
    asked, told = explained(machine, own, record(two_zones(), 15, air=-15.0))
    assert told.named == []
    assert drift.levels(asked, told.changes)[0] == pytest.approx(
        -15.0, abs=0.5
    )  # the champion's air scatters


def test_a_change_below_what_matters_is_measured_as_that(machine, own):
    fit = explained(machine, own, record(two_zones(gain=(0.97, 1.0)), 16))[1].named[0].fit
    assert fit.cause == drift.DriftCause("gain", 0) and fit.value == pytest.approx(-0.03, abs=0.003)
    assert fit.deviation < 0.003  # so that 3 % are known to be no 4 %


def test_draughts_make_a_record_restless_and_no_machine_drifted(machine, own):
    rng = np.random.default_rng(5)
    for seed in (20, 21, 22):
        draught = np.zeros((SAMPLES, 1))
        for start in rng.integers(0, SAMPLES - 60, 3):
            draught[start : start + 40] = 3.0
        shift = record(two_zones(), seed, given=lambda u, taken=draught: u - taken)
        assert explained(machine, own, shift)[1].named == []


def test_one_heater_and_one_sensor_tell_a_gain_and_leave_the_air_in_doubt():
    lag = plant([[np.exp(-1 / 50)]], [[1.5 * (1 - np.exp(-1 / 50))]], [[1.0]], b=[20 * (1 - np.exp(-1 / 50))])

    def shift(truth: Plant, seed: int, offset: float = 0.0):
        u = heated(seed)[:, :1]
        x0 = np.linalg.solve(np.eye(1) - truth.A, truth.B @ u[0] + truth.b)
        rng = np.random.default_rng([seed, 1])
        return u, simulate(truth, u, x0)[1] + offset + NOISE * rng.standard_normal((SAMPLES, 1))

    one = drift.ProductionModel(lag, SAMPLES)
    known = baseline.measured(one, [[shift(lag, k)] for k in range(4)], baseline.Floors(0.03, 0.25))
    asked = drift.causes(lag)
    told = [
        drift.explain_segments(one, [record], known.scale, known.changes, known.usual(asked))
        for record in (shift(lag._replace(B=0.9 * lag.B), 40), shift(lag, 41, 1.5))
    ]
    assert [named.fit.cause for named in told[0][1].named] == [drift.DriftCause("gain", 0)]
    # a sensor alone cannot tell its own offset from the air around: that is the air's
    assert told[1][1].named == []
    assert drift.levels(told[1][0], told[1][1].changes)[0] == pytest.approx(1.5, abs=0.2)


def test_noise_is_that_from_one_sample_to_the_next():
    slow, rng = np.linspace(0, 50, 20_000)[:, None], np.random.default_rng(1)
    value, deviation = baseline.noise(slow + [0.1, 0.2] * rng.standard_normal((20_000, 2)))
    # log 0.01 and log 0.04, to four deviations
    np.testing.assert_allclose(value, np.log([0.01, 0.04]), atol=4 * deviation.max())
    assert deviation.max() < 0.05


def test_a_baseline_takes_up_what_its_own_records_hold_to_be_otherwise(machine):
    """As where a drift was accepted: another like it is no news, and the machine as before is."""
    nights = [[record(two_zones(gain=(0.9, 1.0)), 930 + k)] for k in range(3)]
    drifted = baseline.measured(machine, nights, baseline.Floors(0.03, 0.25))
    assert explained(machine, drifted, record(two_zones(gain=(0.9, 1.0)), 30))[1].named == []
    fit = explained(machine, drifted, record(two_zones(), 31))[1].named[0].fit
    assert fit.cause == drift.DriftCause("gain", 0) and fit.value == pytest.approx(1 / 0.9 - 1, abs=0.01)


def test_what_the_champions_own_model_gets_wrong_of_its_nights_is_no_change_of_a_later_one(machine):
    """The models that are identified without a night may get it right where the champion's own does not."""
    honest = two_zones(gain=(0.985, 1.0))
    right = drift.ProductionModel(honest._replace(K=robust_observer_gain(honest, 1.0)), SAMPLES)
    nights = [[record(honest, 940 + k)] for k in range(4)]
    floors = baseline.Floors(0.03, 0.25)
    blind = baseline.measured(machine, nights, floors, [right] * 4)
    gain = CAUSES.index(drift.DriftCause("gain", 0))
    np.testing.assert_allclose(blind.values[:, gain], [0.0] * 4 + [-0.015] * 4, atol=0.006)
    for seed in (50, 51):
        assert explained(machine, blind, record(honest, seed))[1].named == []


def test_a_baseline_comes_back_from_its_file(own, tmp_path):
    own = own._replace(changes=((drift.DriftCause("gain", 0), -0.1), (drift.DriftCause("offset", 1), 2.0)))
    artifacts.write_json(tmp_path / "own.json", own.to_json())
    again = Baseline.read(artifacts.read_json(tmp_path / "own.json"))
    assert again.changes == own.changes
    for before, after in zip(own.scale, again.scale, strict=True):
        np.testing.assert_array_equal(before, after)
    np.testing.assert_array_equal(own.values, again.values)


def test_a_baseline_of_version_2_is_read_as_one_of_version_3(own):
    none = [0.0, 0.0]
    by_name = {
        "gain": [0.01, 0.0],
        "rate": none,
        "delay": none,
        "cap": [1e9, 62.0],
        "offset": none,
        "late": none,
    }
    scale = {name: np.asarray(value).tolist() for name, value in own.scale._asdict().items()}
    before = own.to_json() | {"changes": dict(sorted(by_name.items())), "scale": dict(sorted(scale.items()))}
    again = Baseline.read(baseline.rewrite(before))
    expected = {(drift.DriftCause("gain", 0), 0.01), (drift.DriftCause("saturation", 1), 62.0)}
    assert {*again.changes} == expected
    for now, then in zip(again.scale, own.scale, strict=True):
        np.testing.assert_array_equal(now, then)


def test_every_rate_scaled_back_is_the_plant_again():
    there = drift.faster(drift.faster(MODEL, 0.25), -0.2)
    np.testing.assert_allclose(there.A, MODEL.A, atol=1e-10)  # expm and logm to rounding
    np.testing.assert_allclose(there.B, MODEL.B, atol=1e-10)
    gains = [np.linalg.solve(np.eye(2) - zones.A, zones.B) for zones in (MODEL, drift.faster(MODEL, 0.3))]
    np.testing.assert_allclose(*gains, rtol=1e-8)  # its steady gains stay


def test_a_first_order_lag_quickened_by_hand():
    # exp(-1 / 50) at twice the rate is exp(-2 / 50); B keeps the gain of 3
    lag = plant([[np.exp(-1 / 50)]], [[3 * (1 - np.exp(-1 / 50))]], [[1.0]])
    quick = drift.faster(lag, 1.0)
    assert quick.A[0, 0] == pytest.approx(np.exp(-2 / 50)) and quick.B[0, 0] == pytest.approx(
        3 * (1 - np.exp(-2 / 50))
    )


def test_a_shift_between_samples_is_a_straight_line():
    np.testing.assert_allclose(drift.shifted(np.array([0.0, 2.0, 4.0]), 0.5), [0.0, 1.0, 3.0])
    np.testing.assert_allclose(drift.shifted(np.array([0.0, 2.0, 4.0]), -1.0), [2.0, 4.0, 4.0])


def test_gaps_in_the_outputs_are_passed_over(machine, own):
    u, y = record(two_zones(gain=(0.9, 1.0)), 7)
    holed = y.copy()
    holed[200:210] = np.nan
    whole, gapped = (explained(machine, own, (u, part))[1].named[0].fit.value for part in (y, holed))
    assert gapped == pytest.approx(whole, abs=0.005)  # ten samples of 600 say little


def test_a_record_too_short_to_judge_is_refused(machine, own):
    with pytest.raises(
        ValueError,
        match="expected records of at least 96 samples to hold against the champion, with "
        "readings that are not masked, found 60; record longer",
    ):
        explained(machine, own, record(two_zones(), 8, samples=60))


# ---- mistakes of recording


def shifted_clock(u: np.ndarray, y: np.ndarray, late_s: int) -> tuple[np.ndarray, np.ndarray]:
    return (u[late_s:], y[:-late_s]) if late_s > 0 else (u[:late_s], y[-late_s:])


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda u, y: (u, y[:, ::-1]), "the sensors left and right are swapped"),
        (lambda u, y: (u[:, ::-1], y), "the inputs one and two are swapped"),
        (lambda u, y: (u, 1.8 * y + 32), "every sensor is in °F where °C is declared"),
        (lambda u, y: (u, y + [273.15, 0]), "left is in K where °C is declared"),
        (lambda u, y: (u / 100, y), "every input is in shares of 1 where percent is declared"),
        (lambda u, y: (u * [1, 0.1], y), "two is written 10 times too small"),
        (lambda u, y: (u, y * [0.1, 1]), "left is written 10 times too small"),
        (lambda u, y: shifted_clock(u, y, 20), "the clock of the outputs is 20 s late"),
        (lambda u, y: shifted_clock(u, y, -9), "the clock of the outputs is 9 s early"),
    ],
)  # fmt: skip
def test_a_mistake_in_a_record_is_named_and_undone(machine, own, spoil, words):
    good = record(two_zones(), 5)
    found = mistakes.found(machine, [spoil(*good)], own, **SIGNALS)
    assert found.words.removesuffix(" against that of the inputs") == words
    assert found.better >= mistakes.BETTER
    # what is undone is a record of the machine as it was
    assert explained(machine, own, *found.undone)[1].named == []


@pytest.mark.parametrize(
    ("truth", "spoilt"),
    [
        (two_zones(), {}),
        (two_zones(), {"air": 3.0}),
        (two_zones(gain=(0.85, 1.0)), {}),
        (two_zones(gain=(0.9, 0.9)), {}),
        (two_zones(slower=(1.2, 1.2)), {}),
        (two_zones(), {"given": lambda u: late(u, (20, 0))}),
        (two_zones(), {"given": lambda u: np.minimum(u, [45, 100])}),
        (two_zones(), {"read": lambda y: y + [20.0, 0]}),
        # a heater that gives a tenth of what it gave, and commands written ten times too large, look the same
        (two_zones(gain=(1.0, 0.1)), {}),
    ],
)
def test_a_drifted_machine_is_no_mistake_of_the_record(machine, own, truth, spoilt):
    for seed in (6, 7):
        assert mistakes.found(machine, [record(truth, seed, **spoilt)], own, **SIGNALS) is None


def test_sensors_that_are_scaled_down_explain_no_more_for_erring_less(machine, own):
    u, y = record(two_zones(), 5)
    likeliest = mistakes.likeliest(machine, [(u / 10, y)], own, **SIGNALS)
    assert likeliest.words == "every input is written 10 times too small"
    assert likeliest.left < mistakes.honest(own)


def test_a_record_that_is_wrong_in_two_ways_is_not_put_down_to_one(machine, own):
    """What is left with one undone is no honest record: it is not set aside for that one."""
    u, y = record(two_zones(), 9)
    assert mistakes.found(machine, [(u[:, ::-1] / 10, 1.8 * y + 32)], own, **SIGNALS) is None
