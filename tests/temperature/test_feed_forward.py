"""Measured disturbances: what they do is learned from the record, taken off it, and made up for."""

import numpy as np
import pytest

from pipeline.temperature.controllers import feed_forward
from pipeline.temperature.controllers.law import (
    ActuatorLimits,
    FeedForward,
    RunningController,
    all_fed_forward,
    batch_step,
    constant,
    deployed,
    fed_forward,
    rest,
    watched,
)
from pipeline.temperature.controllers.law import aim as aimed
from pipeline.temperature.plant import plant
from pipeline.temperature.test_set import panel
from pipeline.temperature.tracking import model_based, still_law
from tests.foreign import thermal_machines
from tests.foreign.thermal_machines import FAN, at_rest, draw, quiet

HOT_ENDS = (1, 7, 13, 19, 25, 31)  # seeds whose machine is a hot end with fan and feed


def record(samples: int = 6000, noise: float = 0.05) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Heater and fan (T, 2), outputs (T, 1), and outputs as they would be with the fan at its mean."""
    rng = np.random.default_rng(3)
    heater = np.repeat(rng.uniform(20, 60, samples // 60), 60)
    fan = np.repeat(rng.choice([0.0, 100.0], samples // 200), 200)
    y, alone = np.full(samples, 100.0), np.full(samples, 100.0)
    for t in range(1, samples):
        e = rng.normal(0, noise)
        y[t] = 0.98 * y[t - 1] + 0.05 * heater[t - 1] - 0.006 * (fan[t - 1] - fan.mean()) + e
        alone[t] = 0.98 * alone[t - 1] + 0.05 * heater[t - 1] + e
    return np.column_stack([heater, fan]), y[:, None], alone[:, None]


def test_what_a_fan_did_is_taken_off_the_record_and_what_a_heater_did_stays():
    acting, y, alone = record()
    told = feed_forward.learn([acting], [y], 1)
    undisturbed = feed_forward.at_mean(told, [acting], [y], 1)[0]
    later = slice(500, None)  # the fan's first state is taken as one of long standing
    assert np.abs(y - alone)[later].max() > 10
    assert np.abs(undisturbed - alone)[later].max() < 1.0


def test_the_gain_is_the_ratio_of_the_steady_gains_by_hand():
    acting, y, _ = record()
    told = feed_forward.learn([acting], [y], 1)
    assert told.gain == pytest.approx(0.006 / 0.05, rel=0.05)
    assert 0 < told.deviation[0, 0] < 0.2 * told.gain[0, 0]
    assert told.mean == pytest.approx(acting[:, 1].mean()) and told.high == 100.0
    assert np.array_equal(told.forward.gain, told.gain)


@pytest.mark.parametrize("lag", [0.0, 3.0, 6.0])
def test_the_lead_makes_up_for_a_heater_that_acts_later(lag):
    """Power passes a cartridge of `lag` samples, the fan takes its heat at once. What is missing after a step
    is the fan's effect over the lag, and the kick, which fades by half, adds twice its lead."""
    acting, y, _ = record()
    heater, fan = acting.T
    rng, stored = np.random.default_rng(4), 40.0
    for t in range(1, len(y)):
        stored += (heater[t - 1] - stored) / (lag + 1)
        y[t] = 0.98 * y[t - 1, 0] + 0.05 * stored - 0.006 * fan[t - 1] + rng.normal(0, 0.05) + 0.01
    told = feed_forward.learn([acting], [y], 1)
    assert told.lead == pytest.approx([lag / 2], abs=0.4)


def test_a_disturbance_that_does_nothing_is_not_fed_forward():
    acting, y, _ = record()
    rng = np.random.default_rng(4)
    idle = np.repeat(rng.uniform(0, 1, len(y) // 100), 100)
    forward = feed_forward.learn([np.column_stack([acting, idle])], [y], 1).forward
    assert forward.gain[0, 0] > 0.1 and forward.gain[0, 1] == 0.0


@pytest.mark.parametrize(
    "useless",
    [
        lambda acting: 0 * acting[:, :1] + 50.0,
        lambda acting: 2.0 * acting[:, :1] + 3.0,
        lambda acting: 0 * acting[:, :1],
    ],
    ids=["always 50", "the duty again", "always 0"],
)
def test_what_stands_still_or_repeats_the_heater_is_neither_taken_off_nor_fed_forward(useless):
    acting, y, _ = record()
    alone = feed_forward.learn([acting], [y], 1)
    told = feed_forward.learn([np.column_stack([acting, useless(acting)])], [y], 1)
    assert told.gain[0, 0] == pytest.approx(alone.gain[0, 0]) and told.forward.gain[0, 1] == 0.0
    assert not told.effect.B[:, 1].any() and not told.effect.D[:, 1].any()
    assert feed_forward.learn([np.column_stack([acting[:, :1], useless(acting)])], [y], 1) is None


def test_a_short_piece_of_the_record_does_not_shorten_the_window():
    acting, y, _ = record()
    pieces = feed_forward.learn([acting, acting[:3]], [y, y[:3]], 1)
    assert np.array_equal(pieces.effect.A, feed_forward.learn([acting], [y], 1).effect.A)


def test_none_is_learned_without_disturbances_and_from_a_short_record():
    acting, y, _ = record()
    assert feed_forward.learn([acting[:, :1]], [y], 1) is None
    assert feed_forward.learn([np.zeros((30, 2))], [np.zeros((30, 1))], 1) is None
    assert feed_forward.at_mean(None, [acting], [y], 1)[0] is y


def test_what_is_stored_is_what_was_learned():
    acting, y, _ = record(3000)
    told = feed_forward.learn([acting], [y], 1)
    arrays = {name: array for name, (array, _, _) in feed_forward.stored(told).items()}
    again = feed_forward.restored(arrays)
    for one, other in zip(told[1:], again[1:], strict=True):
        assert np.array_equal(one, other)
    assert np.array_equal(told.effect.A, again.effect.A)


def test_gains_of_foreign_hot_ends_are_within_a_fifth():
    """Of six machines, two gains each: at most two further off than a fifth."""
    shares = np.array([share for seed in HOT_ENDS for share in learned_of_needed(seed)])
    assert (np.abs(shares - 1) <= 0.2).sum() >= len(shares) - 2 and len(shares) == 12


def learned_of_needed(seed: int) -> list[float]:
    """Learned gains of two evenings as shares of the duty that holds the machine's reference with each
    disturbance at its largest, less that without."""
    machine, rng = draw(seed), np.random.default_rng([seed, 1])
    units = {
        column: (largest, 100.0 if column == FAN else 1.0) for column, largest in machine.recorded.values()
    }
    every, acting, y = max(1, round(1 / machine.sample_time_s)), [], []
    for _ in range(2):
        log = thermal_machines.evening(machine, rng, 60, disturbed=True)
        beside = [log.outside[:, column] * unit for column, (_, unit) in units.items()]
        signals, count = np.column_stack([log.duty_percent, *beside]), len(log.time_s) // every * every
        acting.append(signals[:count].reshape(-1, every, signals.shape[1]).mean(axis=1))
        y.append(log.reading_degC[:count].reshape(-1, every, 1).mean(axis=1))
    shares = []
    for gain, (column, (largest, unit)) in zip(
        feed_forward.learn(acting, y, 1).gain[0], units.items(), strict=True
    ):
        off, on = quiet(machine, 1)[0], quiet(machine, 1)[0]
        on[column] = largest
        watt = [at_rest(machine.parts, machine.reference_degC, tuple(one))[1][0] for one in (off, on)]
        shares.append(gain * largest * unit * machine.parts.power[0] / (100 * (watt[1] - watt[0])))
    return shares


def test_the_test_set_moves_what_is_told_to_its_highest_level():
    effect = plant([[0.9]], [[-0.006]], [[1.0]])
    told = feed_forward.Told(
        effect, np.array([40.0]), np.array([100.0]), np.ones((1, 1)), np.zeros((1, 1)), np.zeros(1)
    )
    signal, push = panel.pushed(told, 1000, 1)
    first, last = (int(1000 * share) for share in panel.FAN[:2])
    assert set(signal[first:last, 0]) == {60.0} and not signal[:first].any() and not signal[last:].any()
    assert push[last - 1, 0] == pytest.approx(-0.006 * 60 / 0.1)
    assert not panel.pushed(None, 10, 2)[1].any()


@pytest.mark.parametrize("short", [1.0, 0.0])
def test_on_the_test_set_a_disturbance_moves_the_machine_by_what_is_not_made_up_for(short):
    """With nothing fed forward, by all of it; with the exact gain by nothing, in the end of its time."""
    law, effect = still_law(1, 1), plant([[0.98]], [[-0.006]], [[1.0]])
    told = feed_forward.Told(
        effect, np.zeros(1), np.array([100.0]), np.full((1, 1), 0.12), np.zeros((1, 1)), np.zeros(1)
    )
    machine = panel.delayed(HEATER, late=False)
    questions = panel.Questions(np.array([[25.0]]), np.array([[75.0]]), None, None, None)
    cases = panel.asked(
        [machine], questions, noise=np.zeros(1), seed=1, steps=4000, hold=5, cells=False, told=told,
        structures=(panel.Structure(),),
    )  # fmt: skip
    cases = cases._replace(outside=0 * cases.outside)
    limits = ActuatorLimits(np.zeros(1), np.full(1, 100.0), np.full(1, np.inf))
    forward = FeedForward((1 - short) * told.gain, told.mean, told.lead)
    controller = deployed(law, limits, integral_limit=1.0, forward=forward)
    aims = panel.aims(law, panel.rests(HEATER, cases, limits), cases)
    y = panel.rolled_out(controller, cases, aims).y[:, cases.kind == "disturbed", 0]
    assert y[int(panel.FAN[1] * 4000) - 1] == pytest.approx(75.0 - short * 0.006 * 100 / 0.02, abs=0.1)


# ---- in the law

HEATER = plant([[0.98]], [[0.05]], [[1.0]], d=[25.0], K=[[0.1]])


def ready(rate: float = np.inf, forward: FeedForward | None = None):
    limits = ActuatorLimits(np.zeros(1), np.full(1, 100.0), np.full(1, rate))
    law = model_based(HEATER, np.ones(1), np.full(1, 0.1), 0.05, gamma=0.99, tau=1.0)
    return deployed(law, limits, integral_limit=1.0, forward=forward)


def dip(controller, told: bool) -> float:
    """The largest error after a fan of 100 % that takes 0.6 °C a step."""
    running = RunningController(controller, HEATER)
    x, r, errors = 75.0, np.full(1, 100.0), []
    for t in range(400):
        y, fan = np.array([x + 25.0]), 100.0 * (t >= 200)
        if told:
            running.tell([fan])
        u = np.array([30.0])
        if t < 30:
            running.watch(u, y, r)
        else:
            if t == 30:
                running.hand_over(y)
            u = running.step(y, r, t)
        errors.append(abs(y[0] - 100.0))
        x = 0.98 * x + 0.05 * u[0] - 0.006 * fan
    return max(errors[200:])


def test_a_fan_that_is_made_up_for_leaves_no_dip():
    controller = ready(forward=FeedForward(np.array([[0.12]]), np.zeros(1), np.zeros(1)))
    assert dip(controller, told=False) > 1.0
    assert dip(controller, told=True) < 0.01


def test_a_command_with_what_is_fed_forward_keeps_limits_and_rate():
    controller = ready(4.0, FeedForward(np.array([[5.0]]), np.zeros(1), np.zeros(1)))
    running, r = RunningController(controller, HEATER), np.full(1, 100.0)
    running.watch(np.array([30.0]), np.array([100.0]), r)
    running.hand_over(np.array([100.0]))
    given = []
    for t in range(60):
        running.tell([10.0 * (t >= 10)])
        given.append(running.step(np.array([100.0]), r, t)[0])
    assert max(given) <= 100.0 and np.abs(np.diff(given)).max() <= 4.0 + 1e-9
    assert given[-1] > given[5] + 40


def test_batch_and_running_feed_forward_alike():
    controller = ready(forward=FeedForward(np.array([[0.12]]), np.full(1, 30.0), np.full(1, 2.0)))
    running, r = RunningController(controller, HEATER), np.full(1, 100.0)
    at = aimed(controller.law, rest(HEATER, constant(r), controller.limits), constant(r))
    state, rng = None, np.random.default_rng(1)
    fans = 100.0 * (np.arange(80) % 20 > 9)[:, None]
    fans[33] = np.nan
    for t, (fan, fed) in enumerate(zip(fans, all_fed_forward(controller, fans), strict=True)):
        y, forward = np.array([100.0 + rng.normal()]), fed[None]
        running.tell(fan)
        if t < 20:
            u = np.array([30.0 + t])
            running.watch(u, y, r)
            state = watched(controller, state, u[None], y[None], r[None], forward)
        else:
            one = running.step(y, r, t)
            feed, target = at.feed.T, at.Y.T
            other, _, state = batch_step(controller, state, y[None], r[None], feed, target, forward)
            assert one == pytest.approx(other[0], abs=1e-9)
            # one that is saved and restored goes on alike
            again = RunningController(controller, HEATER)
            again.restore(running.saved())
            running = again


def test_a_disturbance_that_is_not_known_is_taken_at_its_mean():
    controller = ready(forward=FeedForward(np.array([[0.12, 1.0]]), np.array([30.0, 2.0]), np.zeros(2)))
    assert fed_forward(controller, np.array([np.nan, 3.0])) == pytest.approx([1.0])
    assert fed_forward(controller, np.array([40.0, np.nan])) == pytest.approx([1.2])
