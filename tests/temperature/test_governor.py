"""The governor: what it allows against brute force, what it learns from a record, and its bars on plants
of the panel."""

from functools import cache

import numpy as np
import pytest

from pipeline.papers.published import REFERENCE
from pipeline.temperature import tracking
from pipeline.temperature.controllers import baseline
from pipeline.temperature.controllers.governor import OutputLimits, governor, instants
from pipeline.temperature.controllers.law import (
    ActuatorLimits,
    Deployed,
    Governor,
    Strength,
    corrected,
    deployed,
    evidence,
    governed,
    observed,
    predicted,
    started,
)
from pipeline.temperature.plant import Plant, baam
from pipeline.temperature.plant import plant as make_plant
from pipeline.temperature.test_set import panel

LIMITS = ActuatorLimits(np.zeros(7), np.full(7, 100.0), np.full(7, np.inf))
SPREAD = panel.PlantSpread(input_gain=0.15, slower=0.2, extra_heat_loss=0.005, delayed=0.5, ambient_degC=8.0)
NOISE = 0.1
ONE = ActuatorLimits(np.zeros(1), np.full(1, 10.0), np.full(1, np.inf))
HEATER = make_plant([[0.95]], [[0.5]], [[1.0]])


@cache
def study_guard(above: float = 80.0) -> Governor:
    family, strength = panel.corners([baam()], SPREAD)
    outputs = OutputLimits(np.zeros(5), REFERENCE + above, np.full(5, 3 * NOISE), 0.5)
    return governor(family, LIMITS, outputs, strength)


def heater_guard(strength: Strength, *, high: float = 100.0, rate: float = np.inf) -> Governor:
    family = [panel.delayed(HEATER, late) for late in (False, True)]
    outputs = OutputLimits(np.full(1, -np.inf), np.full(1, high), np.full(1, 0.3), 1e3)
    return governor(family, ONE._replace(rate=np.full(1, rate)), outputs, strength)


def law(name: str) -> tracking.Law:
    if name == "pi":
        return baseline.pi_law(baseline.pairing(baam(), LIMITS.low, LIMITS.high, horizon=600), inputs=7)
    return tracking.model_based(baam(), np.ones(5), np.ones(7), 0.1, gamma=0.99, tau=1.0)


def played(ready: Deployed, asked: panel.Cases, model: Plant) -> panel.Rollout:
    at = panel.rests(model, asked, ready.limits)
    return panel.rolled_out(ready, asked, panel.aims(ready.law, at, asked))


# ---- what it allows


def forecast(plant: Plant, x: np.ndarray, u: np.ndarray, low: np.ndarray, rate: np.ndarray, steps: int):
    """Outputs (steps, p) from state x when u is applied, then inputs that fall to `low` at `rate`."""
    y = np.empty((steps, plant.p))
    for t in range(steps):
        x = plant.A @ x + plant.B @ u + plant.b
        y[t] = plant.C @ x + plant.d
        u = np.maximum(low, u - rate)
    return y


@pytest.mark.parametrize("rate", [np.inf, 2.0])
def test_the_command_can_still_be_stopped_below_the_limit_and_a_larger_one_cannot(rate: float):
    """By simulation of the strongest member; the law asks for everything."""
    high, strength = 60.0, Strength(0.7, 1.4, 0.0)
    family = heater_guard(strength, high=high, rate=rate)
    memory = started(family, np.full((1, 1), 57.0))
    most, low = np.full((1, 1), 10.0), np.zeros((1, 1))
    u = governed(family, memory, most, np.full((1, 1), 100.0), low, most)[0]
    stopped = []
    for plant in (panel.delayed(HEATER, late) for late in (False, True)):
        strong = plant._replace(B=1.4 * plant.B)
        x = np.r_[57.0, 0.0]
        ahead = int(instants([plant])[-1])
        stopped.append(
            forecast(strong, x, u, np.zeros(1), u / np.ceil(10.0 / rate) if rate < 10 else u, ahead)
        )
    highest = max(y.max() for y in stopped)
    # what the margin of 0.3 °C leaves; the rows look at seven instants, between which the peak may lie
    assert highest <= high
    assert highest > high - 0.3 - 0.05
    assert 0.0 < u[0] < 10.0


def test_a_command_that_touches_no_row_is_left_as_it_is():
    family = study_guard()
    memory = started(family, np.tile(REFERENCE - 60.0, (3, 1)))
    u = np.random.default_rng(1).uniform(5.0, 15.0, (3, 7))
    after = governed(family, memory, u, np.tile(REFERENCE, (3, 1)), np.zeros((3, 7)), np.full((3, 7), 100.0))
    np.testing.assert_array_equal(after, u)


def test_one_row_is_met_by_the_least_change():
    """Two inputs that heat one output by 2 and 1: the nearest command lies along (2, 1)."""
    plant = make_plant([[0.9]], [[2.0, 1.0]], [[1.0]])
    limits = ActuatorLimits(np.zeros(2), np.full(2, 50.0), np.full(2, np.inf))
    outputs = OutputLimits(np.full(1, -np.inf), np.full(1, 100.0), np.zeros(1), 1e3)
    family = governor([plant], limits, outputs, Strength(1.0, 1.0, 0.0))
    memory = started(family, np.full((1, 1), 50.0))
    most, low = np.full((1, 2), 50.0), np.zeros((1, 2))
    u = governed(family, memory, most, np.full((1, 1), 90.0), low, most)[0]
    # 0.9 50 + 2 u1 + u2 = 100 at the point of the line nearest to (50, 50)
    np.testing.assert_allclose(u, 50.0 - (150.0 - 55.0) / 5 * np.array([2.0, 1.0]), rtol=1e-9)


def test_what_is_far_too_hot_comes_back_as_the_law_says_and_gets_no_hotter():
    """3 degC above: 0.95 60 + 0.5 u = 60 at u = 6; below that the command is the law's."""
    outputs = OutputLimits(np.full(1, -np.inf), np.full(1, 100.0), np.zeros(1), 0.5)
    family = governor([HEATER], ONE, outputs, Strength(1.0, 1.0, 0.0))
    memory = started(family, np.full((2, 1), 60.0))
    most, low, target = np.full((2, 1), 10.0), np.zeros((2, 1)), np.full((2, 1), 57.0)
    u = governed(family, memory, np.array([[10.0], [4.0]]), target, low, most)
    np.testing.assert_allclose(u[:, 0], [6.0, 4.0], rtol=1e-9)


def test_a_zone_that_its_own_heater_cannot_warm_is_not_warmed_by_its_neighbours():
    """Two zones that heat each other by a third. Zone 2 is 8 degC too cold and cools at its heater's full
    power; zone 1 has arrived, and stays with what its law asks."""
    plant = make_plant(
        np.diag([0.95, 0.95]), np.array([[0.3, 0.1], [0.1, 0.3]]), np.eye(2), b=np.array([0.1, 0.1])
    )
    limits = ActuatorLimits(np.zeros(2), np.array([20.0, 2.5]), np.full(2, np.inf))
    outputs = OutputLimits(np.full(2, -np.inf), np.full(2, 80.0), np.full(2, 0.3), 0.5)
    family = governor([plant], limits, outputs, Strength(1.0, 1.0, 0.0))
    memory = started(family, np.array([[50.0, 37.0]]))
    asked, target = np.array([[7.16, 2.5]]), np.array([[50.0, 45.0]])
    u = governed(family, memory, asked, target, np.zeros((1, 2)), limits.high[None])
    np.testing.assert_allclose(u, asked, rtol=1e-9)


def test_cases_are_governed_alike_alone_and_among_many():
    family, rng = study_guard(), np.random.default_rng(2)
    y = REFERENCE + rng.uniform(-60, 1, (40, 5))
    memory = predicted(family, started(family, y), rng.uniform(0, 30, (40, 7)))
    u, target = rng.uniform(0, 60, (40, 7)), np.tile(REFERENCE, (40, 1))
    low, high = np.zeros((40, 7)), np.full((40, 7), 100.0)
    together = governed(family, memory, u, target, low, high)
    for k in range(40):
        one = slice(k, k + 1)
        alone = governed(family, memory[:, one], u[one], target[one], low[one], high[one])
        np.testing.assert_allclose(alone, together[one], rtol=0, atol=1e-9 * 100)


def test_a_case_that_is_cramped_from_both_sides_is_governed_alike_alone_and_among_many():
    """Two heaters as identified, each of which cools the other zone at first: drawing one zone from its wall
    pushes the other onto its own in the same sweep."""
    model = make_plant([[0.90, 0.06], [0.05, 0.92]], [[0.30, -0.12], [-0.10, 0.25]], np.eye(2))
    limits = ActuatorLimits(np.zeros(2), np.full(2, 100.0), np.full(2, np.inf))
    spread = panel.PlantSpread(0.2, 0.3, 0.01, 0.5, 5.0)
    family, strength = panel.corners([model], spread)
    outputs = OutputLimits(np.zeros(2), np.full(2, 75.0), np.full(2, 0.3), 0.2)
    guard, rng = governor(family, limits, outputs, strength), np.random.default_rng(4)
    y, u = rng.uniform(35, 45, (200, 2)), rng.uniform(0, 100, (200, 2))
    memory = predicted(guard, started(guard, y), rng.uniform(0, 100, (200, 2)))
    target = y + rng.uniform(-1, 1, (200, 2))
    low, high = np.zeros((200, 2)), np.full((200, 2), 100.0)
    together = governed(guard, memory, u, target, low, high)
    alone = [governed(guard, memory[:, [k]], u[[k]], target[[k]], low[[k]], high[[k]])[0] for k in range(200)]
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-9 * 100)


# ---- what it learns


def driven(truth: Plant, family: Governor, u: np.ndarray) -> np.ndarray:
    """The memory after inputs u (T, m) were played on the true plant from rest at zero, noise of 0.1 °C."""
    rng, x = np.random.default_rng(3), np.zeros(truth.n)
    memory = started(family, np.zeros((1, truth.p)))
    for now in u:
        y = truth.C @ x + truth.d + NOISE * rng.standard_normal(truth.p)
        memory = observed(family, memory, now[None], y[None])
        x = truth.A @ x + truth.B @ now + truth.b
    y = truth.C @ x + truth.d + NOISE * rng.standard_normal(truth.p)
    return corrected(family, memory, y[None])


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("gain", [0.75, 1.0, 1.3])
def test_a_record_tells_the_delay_and_bounds_the_strength(late: bool, gain: float):
    strength = Strength(0.7, 1.4, 0.0)
    truth = panel.delayed(HEATER._replace(B=gain * HEATER.B), late)
    memory = driven(truth, heater_guard(strength), np.repeat([[10.0], [0.0], [8.0]], 10, axis=0))
    least, _, most, counts = evidence(heater_guard(strength), memory)
    assert counts[:, 0].tolist() == ([False, True] if late else [True, False])
    share = (strength.strongest - gain) / (strength.strongest - strength.weakest)
    mine = int(late)
    assert least[mine, 0, 0] <= share <= most[mine, 0, 0]
    # of 0..1 before: steps of 3.5 °C from strongest to weakest, each doubted by 1.2 °C both ways, leave 0.69,
    # and smaller innovations after them a little more
    assert most[mine, 0, 0] - least[mine, 0, 0] < 0.8


def test_a_quiet_record_tells_nothing_of_strength():
    """At rest, heat lost looks like a weak input: it must not be taken for one."""
    lossy = panel.delayed(HEATER._replace(A=HEATER.A - 0.02, b=np.array([0.1])), False)
    family = heater_guard(Strength(0.7, 1.4, 0.0))
    least, _, _, counts = evidence(family, driven(lossy, family, np.full((40, 1), 0.5)))
    assert counts.all()
    assert least.max() < 0.05


def test_a_steady_disagreement_vanishes_from_the_forecast():
    """A plant that loses more heat than any member says: in time the next output is forecast exactly."""
    lossy = HEATER._replace(A=HEATER.A - 0.02)
    truth, family = panel.delayed(lossy, False), heater_guard(Strength(0.7, 1.4, 0.0))
    u, x = np.full(1, 8.0), np.zeros(2)
    memory, errors = started(family, np.zeros((1, 1))), []
    for _ in range(400):
        y = truth.C @ x
        n = truth.n
        ahead = memory[0, 0, :n] @ family.see[0, :n, :1] + family.offset[0]
        errors.append(abs(ahead[0] - y[0]))
        memory = observed(family, memory, u[None], y[None])
        x = truth.A @ x + truth.B @ u
    # it is 2.7 °C a step off at first, and a drift that leaks 1e-4 a step leaves a hundredth of that
    assert max(errors[:5]) > 1.0
    assert max(errors[-50:]) < 0.03


# ---- its bars, on plants of the panel


def undisturbed(plants, questions, noise, steps: int, *, hold: int, cells: bool) -> panel.Cases:
    """Constant references alone, on plants of the guarded family: none has a structure of its own."""
    asked = panel.asked(
        plants,
        questions,
        noise=noise,
        seed=6,
        steps=steps,
        hold=hold,
        cells=cells,
        structures=(panel.Structure(),),
    )
    return panel.some(asked, ("constant",), len(plants))


def bars(
    name: str, starts: tuple[float, ...], guard: Governor, steps: int
) -> tuple[panel.Rollout, panel.Cases]:
    plants = panel.drawn([baam()], 12, SPREAD, cells=True, rng=np.random.default_rng(6))
    questions = panel.Questions(np.outer(starts, np.ones(5)), REFERENCE[None], None, None, None)
    asked = undisturbed(plants, questions, np.full(5, NOISE), steps, hold=30, cells=True)
    ready = deployed(law(name), LIMITS, integral_limit=1.0, governor=guard)
    return played(ready, asked, baam()), asked


@pytest.mark.parametrize("name", ["lqg", "pi"])
def test_from_cold_no_plant_overshoots_by_a_degree_or_dips_and_all_settle_on_the_reference(name: str):
    out, _ = bars(name, (20.0, 90.0), study_guard(), 350)
    assert out.u.min() >= 0.0 and out.u.max() <= 100.0
    assert (out.y - REFERENCE).max() <= 1.0
    assert (out.y[0] - out.y.min(axis=0)).max() <= 0.5
    # the bar; noise of 0.1 °C leaves 0.01 in a mean of 100 samples
    assert np.abs(out.y[-100:].mean(axis=0) - REFERENCE).max() <= 0.05


def test_the_same_law_without_its_governor_overshoots_by_tens_of_degrees():
    plants = panel.drawn([baam()], 4, SPREAD, cells=True, rng=np.random.default_rng(6))
    questions = panel.Questions(np.full((1, 5), 20.0), REFERENCE[None], None, None, None)
    asked = undisturbed(plants, questions, np.full(5, NOISE), 40, hold=30, cells=True)
    design = law("lqg")
    out = played(deployed(design, LIMITS, integral_limit=1.0), asked, baam())
    assert (out.y - REFERENCE).max() > 20.0


@pytest.mark.parametrize("name", ["lqg", "pi"])
def test_an_output_limit_three_degrees_above_the_reference_is_never_crossed(name: str):
    out, _ = bars(name, (20.0, 90.0), study_guard(above=3.0), 120)
    assert (out.y - REFERENCE).max() <= 3.0


def test_a_reference_above_the_limit_is_approached_up_to_the_limit():
    out, _ = bars("lqg", (90.0,), study_guard(above=-4.0), 200)
    beyond = out.y - (REFERENCE - 4.0)
    assert beyond.max() <= NOISE
    # margin of 0.3 °C, what noise keeps a strict limit off, and heaters that warm two zones
    assert np.abs(out.y[-50:].mean(axis=0) - (REFERENCE - 4.0)).max() < 2.0


def test_dead_time_does_not_make_it_hunt():
    """A slow heater with 8 samples of dead time, half the plants a sample later still: it overshoots less,
    and settles no later than the law by itself."""
    delay, share = 8, 1 - np.exp(-1 / 60)
    A = np.zeros((delay + 1, delay + 1))
    A[0, :2] = 1 - share, 2 * share
    A[1:-1, 2:] = np.eye(delay - 1)
    slow = make_plant(
        A, np.eye(delay + 1)[:, -1:], np.eye(delay + 1)[:1], b=np.r_[22 * share, np.zeros(delay)]
    )
    limits = ActuatorLimits(np.zeros(1), np.full(1, 100.0), np.full(1, np.inf))
    # no part of it is quicker: a dead time that is a chain of states has no other speed
    spread = SPREAD._replace(input_gain=0.3, slower=0.0, extra_heat_loss=0.0005, ambient_degC=3.0)
    plants = panel.drawn([slow], 10, spread, cells=False, rng=np.random.default_rng(7))
    questions = panel.Questions(np.array([[25.0], [90.0]]), np.array([[60.0]]), None, None, None)
    asked = undisturbed(plants, questions, np.full(1, 0.05), 600, hold=40, cells=False)
    family, strength = panel.corners([slow], spread)
    outputs = OutputLimits(np.full(1, -np.inf), np.full(1, 250.0), np.full(1, 0.15), 0.5)
    guard = governor(family, limits, outputs, strength)
    design = tracking.model_based(slow, np.ones(1), np.full(1, 0.01), 0.05, gamma=0.999, tau=0.1)
    results = []
    for one in (None, guard):
        out = played(deployed(design, limits, integral_limit=1.0, governor=one), asked, slow)
        results.append(
            panel.figures(out, asked, limits=limits, low=np.zeros(1), high=np.full(1, 250.0), band=1.0)
        )
    alone, watched = results
    up = asked.start == 0
    assert watched.overshoot[up].max() < 0.4 * alone.overshoot[up].max()
    settling, by_itself = (np.fmax(one.settling, one.heating) for one in (watched, alone))
    assert np.median(settling) <= np.median(by_itself)
    assert settling.max() <= 1.3 * by_itself.max()
    assert watched.settled_error.max() <= 0.05
