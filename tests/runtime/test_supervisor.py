"""The supervisor on a machine of two zones that no stage made: quiet where the plant is honest, and every
fault named, with its safe mode and the way back."""

import numpy as np
import pytest

from pipeline.runtime import innovations, supervisor
from pipeline.runtime.machine import Exported
from pipeline.runtime.signals import Machine, Signal
from pipeline.runtime.supervised import Supervised
from pipeline.runtime.supervisor import SAFE, supervision
from pipeline.temperature.controllers import baseline, controller
from pipeline.temperature.controllers.governor import ActuatorLimits
from pipeline.temperature.plant import plant
from pipeline.temperature.test_set.panel import delayed

LOW, HIGH = np.zeros(2), np.full(2, 100.0)
NOISE, ROOM, R = 0.1, 20.0, np.array([150.0, 180.0])
# a zone cools by 2 % a sample towards the room; 45 and 55 percent hold the references
MODEL = plant([[0.98, 0.003], [0.002, 0.978]], np.diag([0.055, 0.065]), np.eye(2), d=[ROOM, ROOM])
WIRED = Machine(
    tuple(Signal(f"heater_{i}", "percent", 0.0, 100.0) for i in (1, 2)),
    tuple(Signal(f"zone_{i}", "degC", 0.0, 260.0) for i in (1, 2)),
    1.0,
)


def exported(**changed) -> Exported:
    made = baseline.controller(MODEL, (LOW, HIGH), horizon=400, noise_degC=np.full(2, NOISE))
    law = made.design(np.ones(2), np.ones(2), 0.0)
    deployed = controller.deployed(law, ActuatorLimits(LOW, HIGH, np.full(2, np.inf)), integral_limit=1.0)
    watched = supervision(MODEL, [MODEL], WIRED, np.full(2, NOISE), **changed)
    return Exported("pi", WIRED, deployed, made.model, deployed, watched, True, "", "")


class Run:
    """A plant that differs from the model as its spread allows: stronger heaters, and late by a sample."""

    def __init__(self, *, seed: int = 0, late: bool = True, gain=(1.1, 0.93), **changed):
        self.plant = delayed(MODEL._replace(B=MODEL.B * gain), late)
        self.rng, self.t, self.skew = np.random.default_rng(seed), 0, 0.0
        self.supervised = Supervised(exported(**changed), rehearsal=True)
        u = np.linalg.solve(MODEL.B * gain, (np.eye(2) - MODEL.A) @ (R - ROOM))
        self.x = np.r_[R - ROOM, u]
        for _ in range(30):
            self.supervised.watch(u, self.read(), R)
            self.advance(u)
        self.supervised.hand_over(self.read())

    def true(self) -> np.ndarray:
        return self.plant.C @ self.x + self.plant.d

    def read(self) -> np.ndarray:
        return self.true() + NOISE * self.rng.standard_normal(2)

    def advance(self, u: np.ndarray) -> None:
        self.x = self.plant.A @ self.x + self.plant.B @ u

    def go(self, steps: int, *, reading=None, command=None, r=None, applied: bool = False) -> list:
        """Decisions of `steps` samples; reading(y, k) and command(u, k) are what the fault makes of them."""
        decisions, told = [], None
        for k in range(steps):
            y = self.read()
            y = y if reading is None else reading(y.copy(), k)
            asked = R if r is None else r(k)
            decisions.append(self.supervised.step(y, asked, self.t + self.skew, told if applied else None))
            told = decisions[-1].u if command is None else command(decisions[-1].u.copy(), k)
            self.advance(told)
            self.t += 1
        return decisions


def steps_of(k: int) -> np.ndarray:
    return R + (8.0 if k // 60 % 2 else -4.0)


def first(decisions) -> tuple[int, supervisor.Cause]:
    """The sample of the first safe mode, and the cause named first ten samples later."""
    at = next(k for k, one in enumerate(decisions) if one.mode != "law")
    return at, decisions[min(at + 10, len(decisions) - 1)].causes[0]


def test_an_honest_plant_of_the_spread_is_left_to_the_law():
    for seed, late in ((1, True), (2, False)):
        run = Run(seed=seed, late=late)
        assert {one.mode for one in run.go(1500, r=steps_of)} == {"law"}


def test_what_the_plant_differs_by_is_learned():
    run = Run(seed=3, late=False, gain=(1.12, 1.0))
    before = run.supervised.memory.P[0, 0, 0]
    run.go(800, r=steps_of)
    theta, P = run.supervised.memory.theta, run.supervised.memory.P
    # two deviations of what is left open
    assert abs(theta[0, 0] - 0.12) < 2 * np.sqrt(P[0, 0, 0]) + 0.03 and P[0, 0, 0] < 0.5 * before


def frozen(y, k, held=[None]):  # noqa: B006, the fault remembers
    held[0] = y[1] if k == 0 else held[0]
    y[1] = held[0]
    return y


def put(j, value):
    def reading(y, k):
        y[j] = value(y[j], k)
        return y

    return reading


NOISY = np.random.default_rng(9).standard_normal(200)
SENSORS = {
    "sensor_nan": put(1, lambda y, k: np.nan),
    "out_of_range": put(1, lambda y, k: 400.0),
    "sensor_frozen": frozen,
    "sensor_offset": put(1, lambda y, k: y + 4.0),
    "sensor_noisy": put(1, lambda y, k: y + 1.2 * NOISY[k]),
    "thermal_runaway": put(1, lambda y, k: 25 + (y - 25) * np.exp(-(k + 1) / 8)),
}


@pytest.mark.parametrize("kind", SENSORS)
def test_a_faulty_sensor_is_named_and_its_safe_mode_asked_for(kind):
    run = Run(seed=5)
    run.go(200, r=steps_of)
    decisions = run.go(60, reading=SENSORS[kind])
    at, cause = first(decisions)
    assert (cause.kind, cause.signal) == (kind, "zone_2")
    # the sums of a noise whose signs take turns rise late
    assert at <= (12 if kind == "sensor_noisy" else 10) and decisions[at + 10].mode == SAFE[kind]
    assert abs(cause.since_s - 200) <= 20


HEATERS = {
    "heater_stuck_on": lambda u, k: np.r_[100.0, u[1]],
    "heater_stuck_off": lambda u, k: np.r_[0.0, u[1]],
    "heater_weak": lambda u, k: u * [0.5, 1.0],
}


@pytest.mark.parametrize("kind", HEATERS)
def test_a_faulty_heater_is_named_within_ten_samples(kind):
    run = Run(seed=6)
    run.go(200, r=steps_of)
    decisions = run.go(40, command=HEATERS[kind])
    at, cause = first(decisions)
    assert (cause.kind, cause.signal) == (kind, "heater_1") and at <= 10
    assert decisions[-1].mode == SAFE[kind]
    assert ("mains" in cause.sentence) == (kind == "heater_stuck_on")


def test_what_only_the_mains_can_stop_stays_until_a_person_acknowledges_it():
    run = Run(seed=6)
    run.go(100)
    run.go(40, command=HEATERS["heater_stuck_on"])
    assert {one.mode for one in run.go(400)} == {"off"}
    run.x[:2] = R - ROOM
    run.supervised.acknowledge()
    assert run.go(100)[-1].mode == "law"


def test_a_slow_sensor_is_seen_before_its_zone_errs_by_5_degC():
    run, slow = Run(seed=8), {}
    run.go(200, r=steps_of)

    def reading(y, k):
        slow["y"] = slow.get("y", y[0]) + (y[0] - slow.get("y", y[0])) / 12
        return np.r_[slow["y"] + NOISE * NOISY[k], y[1]]

    worst = []
    for k in range(60):
        decision = run.go(1, reading=lambda y, _, k=k: reading(y, k), r=lambda _: R + 8.0)[0]
        if decision.mode != "law":
            break
        worst.append(np.abs(run.true() - R - 8.0)[0] if k > 30 else 0.0)
    assert decision.mode != "law" and max(worst, default=0.0) < 5


def test_commands_that_are_not_applied_are_named_from_their_readback():
    run = Run(seed=9)
    run.go(50)
    decisions = run.go(20, command=lambda u, k: np.r_[u[0] + 20.0, u[1]], applied=True)
    at, cause = first(decisions)
    assert at == 1 and (cause.kind, cause.signal) == ("command_not_applied", "heater_1")


def test_a_late_sample_and_a_clock_that_jumps_are_told_apart():
    for gap_s, kind in ((3.0, "deadline_missed"), (-3600.0, "clock_jump"), (3600.0, "clock_jump")):
        run = Run(seed=10)
        run.go(50)
        run.skew = gap_s
        decision = run.go(1)[0]
        assert (decision.mode, decision.causes[0].kind) == ("hold", kind)
        assert f"{gap_s + 1:.3g} s" in decision.causes[0].sentence
        # by its own time, which a jump does not move
        assert run.go(45)[-1].mode == "law"


def test_a_reference_out_of_reach_leaves_the_last_one_that_was_not():
    run = Run(seed=11)
    run.go(60)
    decisions = run.go(80, r=lambda k: R + [0.0, 200.0])
    assert decisions[0].causes[0].kind == "reference_out_of_reach" and decisions[0].mode == "pi"
    assert decisions[0].causes[0].signal == "zone_2"
    np.testing.assert_allclose(run.true(), R, atol=1.0)  # ten deviations of the noise
    assert run.go(60)[-1].mode == "law"


def test_another_machine_than_the_model_s_is_said_to_be_one():
    run = Run(seed=12)
    run.go(200, r=steps_of)
    other = MODEL.B * [[0.4, 1.0], [1.0, 2.2]]
    run.plant = delayed(MODEL._replace(B=other), True)
    at, cause = first(run.go(40, r=lambda k: R + 6.0))
    assert at <= 10 and cause.kind == "model_no_longer_right"


def test_the_law_comes_back_without_a_bump():
    run = Run(seed=13)
    before = run.go(200)[-1].u
    assert run.go(20, reading=SENSORS["sensor_nan"])[-1].mode == "hold"
    decisions = run.go(60)
    modes = [one.mode for one in decisions]
    back = modes.index("law")
    # after back_s of 30 s, and there for good
    assert 29 <= back <= 31 and set(modes[back:]) == {"law"}
    jump = np.abs(decisions[back].u - decisions[back - 1].u).max()
    gain = np.abs(run.supervised.exported.controller.law.D).max()
    # what noise moves a proportional law by in one sample, and no more
    assert jump < 5 * gain * NOISE + 0.5 and np.abs(decisions[-1].u - before).max() < 10


def test_a_drift_that_its_observer_has_followed_is_seen_where_surroundings_cannot_take_so_much():
    s = exported().supervision
    np.testing.assert_allclose(s.heat, supervisor.HEAT * 100 * np.array([0.055, 0.065]), rtol=0.01)
    for step, kinds in ((1.2, {"sensor_offset"}), (0.8, set())):
        k, memory = supervisor.kept(s), innovations.remembered(s.watch, s.bank)
        innovations.drift(memory, 2)[1, 0] = -step * s.heat[1]
        for _ in range(20):
            supervisor.heated(s, k, memory)
        assert {supervisor.KINDS[kind] for kind in np.flatnonzero((k.since >= 0).any(axis=1))} == kinds
        # of two zones the one that drifts, and the observer freed of it
        assert k.since[supervisor.OFFSET, 0] < 0
        assert (innovations.drift(memory, 2)[1, 0] == 0) == bool(kinds)


def test_a_drift_that_its_observer_has_followed_stops_the_law_in_the_loop_too():
    run = Run(seed=4)
    assert {one.mode for one in run.go(100)} == {"law"}
    innovations.drift(run.supervised.memory, 2)[1, 0] -= 4 * run.supervised.exported.supervision.heat[1]
    decisions = run.go(3)
    assert {(cause.kind, cause.signal) for cause in decisions[-1].causes} == {("sensor_offset", "zone_2")}
    assert decisions[-1].mode == SAFE["sensor_offset"]


def test_what_is_watched_follows_from_noise_and_from_what_a_quarter_of_the_heat_does():
    """Gain asked for: 2 degC, or six deviations of noise; hysteresis: 5 degC, or six; time: ten times what a
    quarter of the heat takes for 2 degC, 20 s at least; error: 6 degC for so long."""
    quick, loud = (supervision(MODEL, [MODEL], WIRED, np.full(2, noise)) for noise in (NOISE, 1.0))
    for s, gain, hysteresis in ((quick, 2.0, 5.0), (loud, 6.0, 6.0)):
        np.testing.assert_allclose(s.gain_degC, gain)
        np.testing.assert_allclose(s.hysteresis_degC, hysteresis)
        np.testing.assert_allclose(s.check_s, 20.0)
        np.testing.assert_allclose(s.error_degC_s, 6.0 * s.check_s)
    # 25 % x 0.004 degC warms to 100 (1 - 0.999^n): 2 degC from the 21st sample on
    slow = plant(np.diag([0.999, 0.98]), np.diag([0.004, 0.065]), np.eye(2), d=[ROOM, ROOM])
    s = supervision(slow, [slow], WIRED, np.full(2, NOISE))
    np.testing.assert_allclose(s.check_s, [210.0, 20.0])
    # 25 % x 0.0004 degC never does: all of 200 samples, and one
    cold = plant(np.diag([0.999, 0.98]), np.diag([0.0004, 0.065]), np.eye(2), d=[ROOM, ROOM])
    np.testing.assert_allclose(supervision(cold, [cold], WIRED, np.full(2, NOISE)).check_s, [2010.0, 20.0])


def test_what_was_said_first_of_a_cause_stays_and_counts_once():
    k = supervisor.kept(exported().supervision)
    supervisor.said(k, supervisor.OFFSET, 1, 2.0, supervisor.ON)
    supervisor.said(k, supervisor.OFFSET, 1, 7.0)
    assert k.amount[supervisor.OFFSET, 1] == 2.0 and k.other[supervisor.OFFSET, 1] == supervisor.ON
    assert k.counters[supervisor.ACTIVE] == 1 and (k.since >= 0).sum() == 1


def test_only_a_sensor_that_counts_again_starts_the_observer_anew():
    s = exported().supervision
    for kind, starts in ((supervisor.OFFSET, True), (supervisor.DEADLINE, False)):
        k = supervisor.kept(s)
        supervisor.said(k, kind, 0, 2.0)
        k.clock_s[1] = s.back_s[kind]
        assert not supervisor.gone(s, k) and k.since[kind, 0] == 0
        k.clock_s[1] += 1.0
        assert supervisor.gone(s, k) == starts
        assert (k.since < 0).all() and k.counters[supervisor.ACTIVE] == 0


def test_from_the_alarm_on_the_machine_is_held_until_its_cause_is_decided():
    s = exported().supervision
    for counter, mode in ((-1, "pi"), (0, "hold"), (3, "hold")):
        k = supervisor.kept(s)
        supervisor.said(k, supervisor.REACH, 0, 2.0)
        k.counters[supervisor.ALARMED] = counter
        assert supervisor.MODES[supervisor.mode_of(s, k)] == mode
        k = supervisor.kept(s)
        k.counters[supervisor.ALARMED] = counter
        assert supervisor.MODES[supervisor.mode_of(s, k)] == ("law" if counter < 0 else "hold")


def test_a_moving_reference_that_is_given_anew_each_sample_goes_on():
    slow = controller.ramp(R, np.array([0.05, -0.03]))
    once, anew = Run(seed=6), Run(seed=6)
    same = once.go(40, r=lambda k: slow)
    copies = anew.go(40, r=lambda k: controller.Reference(*(part.copy() for part in slow)))
    for one, other in zip(same, copies, strict=True):
        np.testing.assert_array_equal(one.u, other.u)
    assert np.abs(same[-1].u - same[0].u).max() > 0.1
    # what readings are held against moves with it
    _, target = once.supervised._target(slow)
    np.testing.assert_array_equal(target, anew.supervised._target(slow)[1])
    np.testing.assert_allclose(target - R, 40 * np.array([0.05, -0.03]), atol=0.06)


BACK = {
    # how the law is left, and for how many samples
    "hold": ({"reading": put(1, lambda y, k: np.nan)}, 25),
    "pi": ({"r": lambda k: R + [0.0, 200.0]}, 25),
    "off": ({"command": lambda u, k: np.r_[u[0] + 20.0, u[1]], "applied": True}, 3),
}


def return_from(mode: str, *, handed: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """By how much the inputs (m,) move when the law takes over again, and by how much they should: what it
    aims at for its target less what it aims at for where the machine is."""
    run = Run(seed=21)
    law, kept = run.supervised.law, run.supervised.kept
    law.controller = law.controller._replace(integral_limit=1e3)
    run.go(150, r=steps_of)
    how, samples = BACK[mode]
    before = run.go(samples, **how)[-1]
    assert before.mode == mode
    if not handed:
        law.hand_over = lambda y: None
    for _ in range(45):
        readings, r = [], run.true() + 0.5  # from where the machine has got to, within the inputs' limits
        now = run.go(1, reading=lambda y, k, to=readings: to.append(y) or y, r=lambda k, r=r: r)[0]
        if now.mode == "law":
            break
        assert now.mode == mode
        before = now
    assert now.mode == "law"
    seen = np.where(kept.trusted > 0, readings[0], kept.expected)
    to, at = (
        controller.aim(law.controller.law, controller.rest(law.model, one, law.controller.limits), one).feed
        for one in map(controller.constant, (r, seen))
    )
    return now.u - before.u, (to - at)[:, 0]


@pytest.mark.parametrize("mode", BACK)
def test_the_law_comes_back_from_each_safe_mode_where_its_inputs_are(mode):
    moved, aimed = return_from(mode)
    np.testing.assert_allclose(moved, aimed, atol=1e-6)  # of 100 percent: the target is found to 1e-8
    moved, aimed = return_from(mode, handed=False)
    assert np.abs(moved - aimed).max() > 1.0


def test_what_is_saved_goes_on_bit_by_bit():
    one, other = Run(seed=14), Run(seed=14)
    one.go(40, r=steps_of)
    one.go(15, reading=SENSORS["sensor_offset"])
    other.supervised.restore(one.supervised.saved())
    for k in range(60):
        y = R + np.sin(k) + np.array([0.0, 3.0])
        a, b = (run.supervised.step(y, R, 55.0 + k) for run in (one, other))
        assert a.mode == b.mode and a.causes == b.causes
        np.testing.assert_array_equal(a.u, b.u)


def test_verify_heater_waits_its_time_and_then_adds_up_degrees_and_seconds():
    s = exported().supervision
    k = supervisor.kept(s)
    wait, limit = s.check_s[0], s.error_degC_s[0]
    y = R - [s.hysteresis_degC[0] + 10.0, 0.0]
    due = int(wait) + int(np.floor(limit / 10.0)) + 1  # 10 degC for 1 s a sample
    for t in range(1, due + 2):
        supervisor.verified(s, k, y, R)
        assert (k.since[supervisor.RUNAWAY, 0] >= 0) == (t >= due), t
    warming = supervisor.kept(s)
    for t in range(3 * due):  # it gains its degrees in time
        y = R - [200.0 - t * 1.5 * s.gain_degC[0] / wait, 0.0]
        supervisor.verified(s, warming, y, R)
    assert warming.since[supervisor.RUNAWAY, 0] < 0


def test_a_coarse_converter_may_repeat_itself():
    assert supervisor.repeats_at_most(1e-4, 0.1) == supervisor.REPEATS_LEAST
    # erf(0.1 / (2 sqrt 2 0.1)) = 0.3829 stay in one step: ln 1e-9 / ln 0.3829 repeats
    assert supervisor.repeats_at_most(0.1, 0.1) == pytest.approx(np.log(1e-9) / np.log(0.3829), rel=1e-3)
    assert supervisor.repeats_at_most(np.inf, 0.1) == np.inf


def test_a_signature_is_what_the_fault_does_to_the_innovation():
    """Two observers, one of a plant whose heater is off: what they differ by is the signature."""
    s = exported().supervision
    watch, memory = s.watch, innovations.remembered(s.watch, s.bank)
    x, u = np.zeros(len(watch.A)), np.array([40.0, 50.0])
    column = int(np.flatnonzero((s.bank.form == innovations.LESS) & (s.bank.signal == 0))[0])
    back = int(s.bank.back[column])
    memory.ring[:, :4] = np.r_[u, u]
    memory.gain[:], memory.age[0] = 1.0, 0
    off, Xb, rows = np.zeros(len(watch.A)), [], int(s.bank.back.max()) + 4
    memory.ahead[0] = rows
    for row in range(rows):
        since = row - int(s.bank.back.max())
        innovations._taken(watch, s.bank, memory)
        x = watch.F @ x + (since - 1 >= -back) * -(watch.B[:, 0] * u[0])
        off = x
        Xb.append(memory.Xb[:, column].copy())
        np.testing.assert_allclose(Xb[-1], off, atol=1e-9)  # the same sums in another order
    assert np.abs(off).max() > 0


def test_a_reading_that_is_no_number_is_seen_in_any_place():
    s = exported().supervision
    for j in (0, 1):
        k = supervisor.kept(s)
        supervisor.read(s, k, R)
        supervisor.read(s, k, put(j, lambda y, k: np.nan)(R + 0.1, 0))
        assert list(np.flatnonzero(k.since[supervisor.NAN] >= 0)) == [j]


def test_the_mode_is_safe_for_what_would_show_the_same():
    s = exported().supervision
    k = supervisor.kept(s)
    supervisor.said(k, supervisor.OFFSET, 0, 2.0)
    assert supervisor.MODES[supervisor.mode_of(s, k)] == "hold"
    k = supervisor.kept(s)
    supervisor.said(k, supervisor.OFFSET, 0, 2.0, supervisor.ON)
    assert supervisor.MODES[supervisor.mode_of(s, k)] == "off"
    words = supervisor.sentence(WIRED, supervisor.OFFSET, 0, 2.0, supervisor.ON)
    assert "zone_1 is off by +2.0 degC" in words and "heater stuck on would show the same" in words


def test_a_sensor_is_frozen_at_the_repeat_that_chance_does_not_allow():
    s = exported().supervision
    k = supervisor.kept(s)
    k.counters[supervisor.SAMPLES] = 21
    for y in (R, R + 0.1, R + 0.2):
        supervisor.read(s, k, y)
    most = int(np.ceil(supervisor.repeats_at_most(k.quantum[0], NOISE)))
    assert most > 5
    for repeat in range(1, most + 1):
        supervisor.read(s, k, R + [0.2, 0.3 + 0.1 * repeat])
        assert (k.since[supervisor.FROZEN, 0] >= 0) == (repeat == most), repeat
    assert k.since[supervisor.FROZEN, 1] < 0


def verdict_of(s, **costs) -> innovations.Verdict:
    """A verdict in which the named hypotheses cost so much, all others 1,000; cost and amplitude by
    "form_signal_number"."""
    cost, amplitude = np.full(len(s.bank.form), 1000.0), np.full(len(s.bank.form), 0.4)
    for name, (value, at) in costs.items():
        form, signal, number = name.rsplit("_", 2)
        wanted = (s.bank.form == getattr(innovations, form)) & (s.bank.signal == int(signal))
        k = np.flatnonzero(wanted)[int(number)]
        cost[k], amplitude[k] = value, at
    return innovations.Verdict(cost, amplitude, 1000.0, np.ones(2), np.full(2, 9.0))


def test_two_begins_of_one_cause_are_no_rivals(monkeypatch):
    """That a heater is weak from now on, or from a sample before, is the same cause: nothing to wait for."""
    s = exported().supervision
    other = {"STEP_1_0": (4.0, 2.0)}
    same = {"LESS_0_1": (4.0, 0.4)}
    for beside, decided in ((same, True), (other, False)):
        k, memory = supervisor.kept(s), innovations.remembered(s.watch, s.bank)
        k.counters[supervisor.ALARMED], memory.age[0] = supervisor.DECIDED_AFTER, 20
        told = verdict_of(s, LESS_0_0=(0.0, 0.4), **beside)
        monkeypatch.setattr(innovations, "judged", lambda bank, memory, told=told: told)
        assert supervisor.diagnosed(s, k, memory) == decided
        # at the latest it is said, with what would show the same
        k.counters[supervisor.ALARMED] = supervisor.DECIDED_BY
        assert supervisor.diagnosed(s, k, memory)
        assert k.since[supervisor.WEAK, 0] >= 0
        assert k.other[supervisor.WEAK, 0] == (-1 if decided else supervisor.OFFSET)


def test_a_reading_falls_faster_than_its_own_zone_can_cool():
    """Out of place is a sensor that falls by twice what its zone loses with the heater off, and ten
    deviations of its noise; the other zone's heat is none of its matter."""
    s = exported().supervision
    k = supervisor.kept(s)
    k.held[:] = 10.0, 60.0
    cooling = s.peak @ k.held
    assert cooling[1] > 2 * cooling[0]
    for j in (0, 1):
        limit = 2 * cooling[j] + 10 * NOISE
        for share, kind in ((1.05, supervisor.RUNAWAY), (0.95, supervisor.OFFSET)):
            told = verdict_of(s, **{f"RAMP_{j}_0": (0.0, -share * limit)})
            kinds, signals = supervisor._named(s, k, told)
            at = int(told.cost.argmin())
            assert (kinds[at], signals[at]) == (kind, j)


def test_what_explains_the_innovation_is_said_with_its_amount():
    s = exported().supervision
    k, memory = supervisor.kept(s), innovations.remembered(s.watch, s.bank)
    memory.f[:] = 4.0
    supervisor._explained(k, memory, (supervisor.OFFSET, 1, 3), 0.5, -1)
    assert k.amount[supervisor.OFFSET, 1] == 2.0  # 0.5 of the 4 degC that the hypothesis is off
    supervisor._explained(k, memory, (supervisor.OFF, 0, 3), 1.5, -1)
    assert k.amount[supervisor.OFF, 0] == 1.5 and k.lacks[0] == 1.0  # no heater lacks more than all
    # a reading that left its range in the very first sample has its reason
    k = supervisor.kept(s)
    supervisor.said(k, supervisor.RANGE, 1, 400.0)
    supervisor._explained(k, memory, (supervisor.OFFSET, 1, 3), 0.5, -1)
    assert k.since[supervisor.OFFSET, 1] < 0 and k.absurd[1] == 1.0


def test_a_cause_of_the_first_sample_is_told():
    supervised = Supervised(exported(), rehearsal=True)
    decision = supervised.step(np.r_[np.nan, R[1]], R, 0.0)
    supervised.kept.since[supervisor.NAN, 0] = 0.0
    assert [cause.kind for cause in supervised._causes(0.0)] == ["sensor_nan"]
    assert decision.mode == "hold" and decision.causes[0].signal == "zone_1"


def test_the_bank_is_followed_from_the_sample_of_the_alarm_on(monkeypatch):
    run, seen = Run(seed=15), []
    suspected = innovations.suspected
    monkeypatch.setattr(
        innovations, "suspected", lambda *of, alarmed: seen.append(alarmed) or suspected(*of, alarmed=alarmed)
    )
    for counter, alarmed in ((-1, False), (0, True), (3, True)):
        run.supervised.kept.counters[supervisor.ALARMED] = counter
        run.go(1)
        assert seen.pop() == alarmed


def test_where_a_sensor_counts_again_nothing_of_its_innovation_is_left():
    run = Run(seed=16)
    run.go(50)
    run.go(5, reading=SENSORS["sensor_nan"])
    active = run.supervised.kept.counters
    while active[supervisor.ACTIVE]:
        assert run.t < 120
        run.go(1)
    np.testing.assert_array_equal(run.supervised.kept.e, 0.0)


def test_a_drift_that_is_small_is_none_whatever_was_learned_of_the_plant():
    s = exported().supervision
    s = s._replace(watch=s.watch._replace(unexplained=0.0))
    for share, kinds in ((0.9, 0), (1.1, 1)):
        k, memory = supervisor.kept(s), innovations.remembered(s.watch, s.bank)
        memory.P[:] = 0.0
        memory.theta[1, 0] = 1.0
        innovations.drift(memory, 2)[1, :2] = share * s.heat[1], 0.5 * s.heat[1]
        supervisor.heated(s, k, memory)
        assert int((k.since >= 0).sum()) == kinds, share


def test_a_simulated_controller_runs_only_in_a_rehearsal():
    with pytest.raises(
        ValueError, match="pi: it was made for a simulated plant and runs only with rehearsal=True"
    ):
        Supervised(exported())


def test_bad_input_is_refused_in_a_sentence():
    with pytest.raises(ValueError, match=r"noise in degC above zero, found \[0. 0.\]"):
        supervision(MODEL, [MODEL], WIRED, np.zeros(2))
    for noise in ([NOISE, np.nan], [NOISE, 0.0], [-NOISE, NOISE], [NOISE, np.inf]):
        with pytest.raises(ValueError, match="noise in degC above zero"):
            supervision(MODEL, [MODEL], WIRED, np.array(noise))
    with pytest.raises(ValueError, match="declare the safe mode of every kind"):
        supervision(MODEL, [MODEL], WIRED, np.full(2, NOISE), modes={"sensor_nan": "law"})
    run = Run()
    with pytest.raises(ValueError, match=r"expects 2 temperatures but was given an array of shape \(3,\)"):
        run.supervised.step(np.zeros(3), R, 0.0)
    saved = Run(seed=2).supervised
    saved.step(R, R, 0.0)
    arrays = saved.saved() | {"theta": np.zeros(3)}
    with pytest.raises(ValueError, match="restored from theta of shape"):
        run.supervised.restore(arrays)
