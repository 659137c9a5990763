"""A replay says what the object would have asked, to the last digits, and says nothing of another machine."""

from functools import cache

import numpy as np
import pytest

from pipeline.deploy import replay, support
from pipeline.deploy.replay import GaplessLog
from pipeline.papers.study import data_sets
from pipeline.temperature import tracking
from pipeline.temperature.controllers import baseline, governor, window
from pipeline.temperature.controllers import law as laws
from pipeline.temperature.controllers.law import (
    ActuatorLimits,
    Deployed,
    RunningController,
    compact,
    deployed,
)
from pipeline.temperature.plant import Plant, baam, padded
from pipeline.temperature.test_set import panel

LIMITS = ActuatorLimits(np.zeros(7), np.full(7, 100.0), np.full(7, np.inf))
SLOW = LIMITS._replace(rate=np.full(7, 4.0))
REFERENCE = np.array([150.0, 160.0, 170.0, 175.0, 180.0])
SPREAD = panel.PlantSpread(0.15, 0.2, 0.005, 0.5, 8.0)
NOISE = np.full(5, 0.1)


def guard() -> laws.Governor:
    family, strength = panel.corners([baam()], SPREAD)
    outputs = governor.OutputLimits(np.full(5, -np.inf), np.full(5, 190.0), np.full(5, 0.3), 0.5)
    return governor.governor(family, LIMITS, outputs, strength)


@cache
def ready(name: str) -> tuple[Deployed, Plant]:
    if name == "pi":
        pairs = baseline.pairing(baam(), LIMITS.low, LIMITS.high, horizon=600)
        return deployed(baseline.pi_law(pairs, inputs=7), SLOW, integral_limit=1.0), baam()
    if name == "window":
        u, y = data_sets(np.random.default_rng(1), 1500, 1)
        learned = window.learn([u[:, 0]], [y[:, 0]], longest=4)
        law = compact(window.law(learned, np.eye(5), np.eye(7), 0.99, integral=0.05), learned.N)
        model = window.observer_form(learned)[0]
        return deployed(law, LIMITS, integral_limit=1.0, governor=guard()), model
    law = tracking.model_based(baam(), np.ones(5), np.ones(7), 0.05, gamma=0.99, tau=1.0)
    return deployed(law, LIMITS, integral_limit=1.0, governor=guard()), baam()


@cache
def log(steps: int = 700) -> GaplessLog:
    """The study's machine under random heat about its rest, with references in steps."""
    rng, plant = np.random.default_rng(3), baam()
    x = np.full(6, 150.0)
    u0 = np.linalg.lstsq(plant.B, x - plant.A @ x, rcond=None)[0]
    u = np.clip(u0 + np.repeat(rng.uniform(-1, 1, (steps // 20, 7)), 20, axis=0), 0, 100)
    y = np.empty((len(u), 5))
    for t in range(len(u)):
        y[t] = plant.C @ x + plant.d + NOISE * rng.standard_normal(5)
        x = plant.A @ x + plant.B @ u[t]
    r = np.where(np.arange(len(u))[:, None] < 300, REFERENCE, REFERENCE - 6)
    return GaplessLog(u, y, r)


def by_the_object(made: Deployed, model: Plant, of: GaplessLog, hold: int) -> np.ndarray:
    """Commands of the object where at each sample what was recorded is applied in the place of what it asks:
    an object of its own for each sample would take minutes, so that its state is carried on."""
    asked = of.u.copy()
    running = RunningController(made, model)
    for t in range(hold):
        running.watch(of.u[t], of.y[t], of.r[t])
    running.hand_over(of.y[hold])
    for t in range(hold, len(of.u)):
        before = running._state
        asked[t] = running.step(of.y[t], of.r[t], t)
        feed, y_star, _ = running._now
        law, u = made.law, of.u[t][None]
        wished = feed - law.K @ before.z[0] - law.D @ of.y[t] - law.K_r @ before.xi[0]
        x = before.x if made.governor is None else laws.observed(made.governor, before.x, u, of.y[t][None])
        xi = laws._integrated(made, before.xi, (y_star - of.y[t])[None], u, wished[None])
        z = laws._remembered(made, before.z, u, of.y[t][None], of.r[t][None])
        running._state = laws.ControllerState(z, xi, u, x)
    return asked


@pytest.mark.parametrize("name", ["pi", "window", "lqg"])
def test_a_replay_asks_what_the_object_would_have_asked(name, monkeypatch):
    made, model = ready(name)
    # chunks of the governor much shorter than the log, so that their seams lie in it
    monkeypatch.setattr(replay, "SIDE_BY_SIDE", 40)
    run = replay.replayed(made, model, log(), hold=30)
    expected = by_the_object(made, model, log(), 30)
    assert np.abs(run.asked - expected).max() < 1e-9 * 100
    held = replay.why(made, log(), run)
    assert {"pi": "rate", "window": "governor", "lqg": "governor"}[name] in {
        replay.WHY[k] for k in np.unique(held)
    }
    np.testing.assert_array_equal(held[np.abs(run.asked - run.wished).max(axis=1) == 0], 0)


@pytest.mark.parametrize("name", ["pi", "lqg"])
def test_a_replay_feeds_forward_as_the_object_does(name):
    made, model = ready(name)
    of, rng = log(), np.random.default_rng(8)
    forward = np.repeat(rng.uniform(-3, 3, (len(of.u) // 50, 7)), 50, axis=0)
    running, asked = RunningController(made, model), of.u.copy()
    for t in range(len(of.u)):
        running.forward = forward[t]
        if t < 30:
            running.watch(of.u[t], of.y[t], of.r[t])
            continue
        if t == 30:
            running.hand_over(of.y[t])
        asked[t] = running.step(of.y[t], of.r[t], t, of.u[t])
    inner = of._replace(u=of.u - forward)
    run = replay.replayed(made, model, inner, hold=30, forward=forward)
    assert np.abs(run.asked - asked).max() < 1e-7
    assert np.abs(run.asked - replay.replayed(made, model, of, hold=30).asked).max() > 1


def test_states_are_the_recursion_sample_by_sample():
    rng = np.random.default_rng(0)
    A, drive, z = (
        0.9 * np.linalg.qr(rng.standard_normal((4, 4)))[0],
        rng.standard_normal((1203, 4)),
        np.ones(4),
    )
    walked = support.scanned(A, drive, z)
    for t in range(1203):
        np.testing.assert_allclose(walked[t], z, atol=1e-11)
        z = A @ z + drive[t]


def test_a_reference_that_never_holds_still_is_refused():
    made, model = ready("pi")
    moving = log()._replace(r=log().y)
    with pytest.raises(
        ValueError, match="the references take 7.. values, expected at most 500 that are held"
    ):
        replay.replayed(made, model, moving)


# ---- support


@cache
def within() -> support.Support:
    rng = np.random.default_rng(5)
    plants = padded(panel.drawn([baam()], 8, SPREAD, cells=True, rng=rng))
    parts = np.array_split(np.arange(len(log().u)), 3)
    return support.support(plants, [GaplessLog(*(part[rows] for part in log())) for rows in parts], NOISE)


def checked(of: GaplessLog) -> support.SupportCheck:
    return support.check_log(within(), of, support.design_observers(within().spread, within().steps))


def test_a_log_of_the_machine_is_on_support_and_one_wired_wrong_is_not():
    assert not checked(log()).abstains
    for wrong in (
        log()._replace(u=log().u[:, [1, 0, 2, 3, 4, 5, 6]] * 3),
        log()._replace(u=log().u / 100),
        log()._replace(y=1.8 * log().y + 32),
    ):
        found = checked(wrong)
        assert found.abstains and found.off.any()


def test_what_leaves_its_range_is_off_at_that_sample():
    hot = log().y.copy()
    hot[400] += 40.0
    off = checked(log()._replace(y=hot)).off
    np.testing.assert_array_equal(np.flatnonzero(off & support.TEMPERATURE), [400])


def still(noise_degC: float = 0.1, steps: int = 700) -> GaplessLog:
    """The machine at rest under constant heat, where the other log is in the middle."""
    rng = np.random.default_rng(7)
    y = log().y.mean(axis=0) + noise_degC * rng.standard_normal((steps, 5))
    return GaplessLog(np.tile(log().u.mean(axis=0), (steps, 1)), y, np.tile(REFERENCE, (steps, 1)))


@pytest.mark.parametrize("noise_degC", [0.0, 0.1, 0.2])
def test_a_log_in_which_nothing_moves_is_judged_by_its_ranges_alone(noise_degC):
    found = checked(still(noise_degC))
    assert (found.still, found.abstains) == (True, False)
    assert not (found.off & support.FORECAST).any()
    assert support.reasons(found) == [support.STILL_TOLD]
    hot = checked(still(noise_degC)._replace(y=still(noise_degC).y + 100.0))
    assert hot.still and hot.abstains
    assert not checked(log()).still and support.reasons(checked(log())) == []


def test_a_log_is_not_still_where_only_its_inputs_move():
    dead = still()._replace(u=log().u)
    found = checked(dead)
    assert found.abstains and not found.still


def test_a_log_too_short_for_a_forecast_says_so():
    few = GaplessLog(*(part[: 2 * within().steps] for part in log()))
    found = checked(few)
    assert (found.short, found.still, found.abstains) == (True, False, False)
    assert support.reasons(found) == [support.SHORT_TOLD]


def test_what_honest_logs_leave_is_no_less_than_the_sensors_noise():
    explained_whole = support.FamilyForecasts(np.arange(4), np.zeros((3, 4, 5)), np.zeros((4, 5)))
    np.testing.assert_allclose(support._rest([explained_whole], NOISE), NOISE, rtol=1e-6)
