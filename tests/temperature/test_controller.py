"""The controller as it runs: limits, back-calculation, hand-over, moving references, and the object of a
machine against the vectorised form that judges."""

import io
import re
from functools import cache

import numpy as np
import pytest

from pipeline.papers import study
from pipeline.papers.published import REFERENCE
from pipeline.temperature import tracking
from pipeline.temperature.controllers import baseline, law, window
from pipeline.temperature.controllers.governor import OutputLimits, governor
from pipeline.temperature.controllers.law import (
    ActuatorLimits,
    ControllerState,
    Deployed,
    Governor,
    RunningController,
    aim,
    batch_step,
    compact,
    constant,
    deployed,
    handed_over,
    ramp,
    rest,
    sinusoid,
    watched,
)
from pipeline.temperature.plant import Plant, baam, hold_state
from pipeline.temperature.plant import plant as make_plant
from pipeline.temperature.test_set import panel
from pipeline.temperature.tracking import Law

LIMITS = ActuatorLimits(np.zeros(7), np.full(7, 100.0), np.full(7, np.inf))
SLOW = LIMITS._replace(rate=np.full(7, 3.0))
SPREAD = panel.PlantSpread(input_gain=0.15, slower=0.2, extra_heat_loss=0.005, delayed=0.5, ambient_degC=8.0)
ONE5, ONE7 = np.ones(5), np.ones(7)


def lqg(plant: Plant, *, tau: float = 1.0, integral: float = 0.05) -> Law:
    return tracking.model_based(plant, ONE5, ONE7, integral, gamma=0.99, tau=tau)


@cache
def guard() -> Governor:
    family, strength = panel.corners([baam()], SPREAD)
    outputs = OutputLimits(np.zeros(5), np.full(5, 250.0), np.full(5, 0.3), 0.5)
    return governor(family, LIMITS, outputs, strength)


def cases(
    plants: list[Plant], questions: panel.Questions, *, noise: float = 0.1, steps: int = 60
) -> panel.Cases:
    return panel.asked(
        plants,
        questions,
        noise=np.full(5, noise),
        seed=1,
        steps=steps,
        hold=20,
        cells=False,
        structures=(panel.Structure(),),
    )


def constants(*references: np.ndarray, starts: tuple[float, ...] = (90.0,)) -> panel.Questions:
    return panel.Questions(np.outer(starts, ONE5), np.stack(references), None, None, None)


def played(ready: Deployed, asked: panel.Cases, model: Plant) -> panel.Rollout:
    at = panel.rests(model, asked, ready.limits)
    return panel.rolled_out(ready, asked, panel.aims(ready.law, at, asked))


def exactly(plant: Plant) -> list[Plant]:
    """The plant itself, in the panel's form."""
    return [panel.delayed(plant, False)]


# ---- limits


def test_no_input_leaves_its_limits_and_none_moves_faster_than_its_rate():
    plants = panel.drawn([baam()], 6, SPREAD, cells=True, rng=np.random.default_rng(2))
    ready = deployed(lqg(baam()), SLOW, integral_limit=1.0, governor=guard())
    out = played(ready, cases(plants, constants(REFERENCE, starts=(20.0, 90.0))), baam())
    assert out.u.min() >= 0.0 and out.u.max() <= 100.0
    # of 3 percent a step; rounding only
    assert np.abs(np.diff(out.u, axis=0)).max() <= 3.0 + 1e-12
    assert (out.wished > 50).any()  # and the law did ask for more


HEATER = make_plant([[0.95]], [[0.5]], [[1.0]])


@pytest.mark.parametrize("aimed_high", [5.0, 50.0], ids=["target within reach", "target as asked"])
def test_back_calculation_ends_the_wind_up_of_the_integrator(aimed_high: float):
    """100 °C would need 10 percent, the input has 5, for 200 samples; then 30 °C, which 3 percent hold."""
    law = tracking.model_based(HEATER, np.ones(1), np.ones(1), 0.1, gamma=0.99, tau=1.0)
    narrow = ActuatorLimits(np.zeros(1), np.full(1, 5.0), np.full(1, np.inf))
    aims = [
        aim(law, rest(HEATER, constant(r), narrow._replace(high=np.full(1, aimed_high))), constant(r))
        for r in ([100.0], [30.0])
    ]
    outside = {}
    for back in (True, False):
        ready = deployed(law, narrow, integral_limit=1.0)
        if not back:
            ready = ready._replace(back=np.zeros_like(ready.back))
        y, outside[back] = np.array([[40.0]]), 0
        state = watched(ready, None, np.full((1, 1), 4.0), y, y)
        for t in range(400):
            now = aims[t // 200]
            u, _, state = batch_step(ready, state, y, now.Y.T, now.feed.T, now.Y.T)
            y = 0.95 * y + 0.5 * u
            outside[back] += t >= 200 and abs(y[0, 0] - 30.0) > 1.0
    # from 50 °C to 31 the input at rest needs 19 samples: log(29 / 50) / log(0.95) to 29 of 50 is 11
    assert outside[True] < 20
    assert outside[False] > 2 * outside[True]


def test_the_memory_takes_the_input_that_was_applied():
    law, p = lqg(baam()), baam()
    y, r = np.full((1, 5), 20.0), REFERENCE[None]
    u0 = hold_state(p, np.full(6, 20.0))[None]
    ready = deployed(law, LIMITS, integral_limit=1.0)
    state = watched(ready, None, u0, y, r)
    at = rest(p, constant(REFERENCE), LIMITS)
    feed = aim(law, at, constant(REFERENCE)).feed.T
    u, wished, after = batch_step(ready, state, y, r, feed, at.Y.T)
    assert np.abs(u - wished).max() > 10.0
    expected = law.A @ state.z[0] + law.B_u @ u[0] + law.B_y @ y[0] + law.B_r @ r[0] + law.c
    np.testing.assert_allclose(after.z[0], expected, rtol=1e-12)


def test_the_input_that_keeps_the_reference_out_of_reach_is_named():
    weak = LIMITS._replace(high=np.r_[np.full(4, 100.0), 0.01, 0.01, 100.0])
    controller = RunningController(deployed(lqg(baam()), weak, integral_limit=1.0), baam())
    controller.watch(np.zeros(7), np.full(5, 90.0), REFERENCE)
    controller.hand_over(np.full(5, 90.0))
    controller.step(np.full(5, 90.0), REFERENCE, 0)
    assert (5, 0.01) in controller.binding


# ---- hand-over


@pytest.mark.parametrize("name", ["lqg", "varx", "pi"])
def test_the_first_step_after_a_hand_over_at_the_reference_is_below_five_percent(name: str):
    contestant, law = laws()[name]
    plants = panel.drawn([baam()], 12, SPREAD, cells=True, rng=np.random.default_rng(3))
    asked = cases(plants, panel.Questions(REFERENCE[None], REFERENCE[None], None, None, None), steps=2)
    ready = deployed(law, LIMITS, integral_limit=1.0, governor=guard())
    out = played(ready, asked, contestant)
    held = np.clip(asked.u0, 0.0, 100.0)
    assert np.abs(out.u[0] - held).max() <= 5.0


def test_an_integrator_takes_over_the_input_of_manual_exactly_where_it_can():
    """PI and a plant with less gain: what the model's steady input lacks is in xi."""
    weaker = baam()._replace(B=0.9 * baam().B)
    law = laws()["pi"][1]
    start = np.full((1, 5), 160.0)
    asked = cases(exactly(weaker), panel.Questions(start, start, None, None, None), noise=0.0, steps=2)
    out = played(deployed(law, LIMITS, integral_limit=50.0), asked, baam())
    paired = np.abs(law.K_r).sum(axis=1) > 0
    np.testing.assert_allclose(out.wished[0, 0][paired], asked.u0[0][paired], atol=1e-9)


# ---- references that move


@pytest.mark.parametrize(
    "reference",
    [ramp(REFERENCE - 15, np.full(5, 0.025)), sinusoid(REFERENCE - 10, np.full(5, 3.0), 200.0)],
    ids=["ramp", "sinusoid"],
)
def test_a_moving_reference_is_followed_without_lag_on_the_exact_plant(reference):
    p = exactly(baam())[0]
    law = lqg(baam(), integral=0.0)
    at = rest(baam(), reference, LIMITS)
    target = aim(law, at, reference)
    ready = deployed(law, LIMITS, integral_limit=1.0)
    w = reference.states(3000)
    y0 = reference.H @ reference.w0
    x = np.r_[np.linalg.lstsq(baam().C, y0, rcond=None)[0], np.zeros(7)]
    state, errors = watched(ready, None, np.zeros((1, 7)), y0[None], y0[None]), []
    for t in range(3000):
        y, r = p.C @ x, reference.H @ w[t]
        errors.append(np.abs(y - r).max())
        u, _, state = batch_step(
            ready, state, y[None], r[None], (target.feed @ w[t])[None], (target.Y @ w[t])[None]
        )
        x = p.A @ x + p.B @ u[0] + p.b
    # the observer's slowest mode is 0.997 a step: of half a degree at the start 1e-4 are left
    assert max(errors[-300:]) < 1e-3


def test_references_are_what_their_formulas_say():
    t = np.arange(50)[:, None]
    moving = ramp(REFERENCE, np.arange(5) / 10)
    np.testing.assert_allclose(moving.states(50) @ moving.H.T, REFERENCE + t * np.arange(5) / 10)
    wave = sinusoid(REFERENCE, np.arange(5.0), 20.0)
    np.testing.assert_allclose(
        wave.states(50) @ wave.H.T, REFERENCE + np.arange(5.0) * np.sin(2 * np.pi * t / 20), atol=1e-9
    )


def test_a_limit_binds_from_a_hundredth_of_a_degree_on():
    one = make_plant([[0.9]], [[1.0]], [[1.0]])  # 10 °C a percent
    limits = ActuatorLimits(np.zeros(1), np.full(1, 10.0), np.full(1, np.inf))
    for beyond, binding in ((0.006, ()), (0.014, ((0, 10.0),))):
        assert rest(one, constant(np.array([100.0 + beyond])), limits).binding == binding


def test_conditional_integration_adds_the_error_where_no_limit_holds_it():
    law = laws()["pi"][1]._replace(conditional=True)
    ready = deployed(law, LIMITS, integral_limit=1.0)
    state = watched(ready, None, np.full((1, 7), 40.0), np.full((1, 5), 150.0), REFERENCE[None])
    state = handed_over(ready, state, np.full((1, 5), 150.0), [])
    assert np.any(law.integral)
    y_star, y = np.full((1, 5), 150.0), np.full((1, 5), 150.0) - 1e-3 * np.arange(5)
    u, wished, after = batch_step(ready, state, y, y_star, y_star @ law.D.T, y_star)
    np.testing.assert_array_equal(u, wished)
    np.testing.assert_allclose(after.xi - state.xi, law.integral * (y_star - y), atol=1e-9)


def test_the_compact_law_of_a_window_asks_for_what_the_window_asks_for_case_by_case():
    u, y = study.data_sets(np.random.default_rng(1), 1500, 1)
    learned = window.learn([u[:, 0]], [y[:, 0]], longest=4)
    law = window.law(learned, np.diag(ONE5), np.diag(ONE7), 0.99, integral=0.05)
    rng = np.random.default_rng(2)
    readings, target = 150 + rng.standard_normal((12, 3, 5)), np.tile(REFERENCE, (3, 1))
    inputs = []
    for form in (law, compact(law, learned.N)):
        ready = deployed(form, LIMITS, integral_limit=1.0)
        state = None
        for row in readings[:6]:
            state = watched(ready, state, np.full((3, 7), 0.4), row, target)
        asked = []
        for row in readings[6:]:
            applied, _, state = batch_step(ready, state, row, target, np.zeros((3, 7)), target)
            asked.append(applied)
        inputs.append(np.array(asked))
    np.testing.assert_allclose(*inputs, atol=1e-8)
    assert np.ptp(inputs[0]) > 0


def test_aims_of_references_that_came_by_are_kept_in_bounds():
    controller = in_control()
    for k in range(controller.AIMS + 3):
        controller.step(np.full(5, 150.0), REFERENCE + k, 6 + k)
    assert len(controller._aims) <= controller.AIMS


def test_a_sequence_reaches_every_reference():
    questions = panel.Questions(
        np.outer([90.0], ONE5),
        REFERENCE[None],
        None,
        None,
        np.stack([REFERENCE, REFERENCE - 5, REFERENCE + 5]),
    )
    asked = cases(exactly(baam()), questions, noise=0.0, steps=450)
    out = played(deployed(lqg(baam()), LIMITS, integral_limit=1.0, governor=guard()), asked, baam())
    for last in (149, 299, 449):
        assert np.abs(out.y[last, 1] - out.r[last, 1]).max() < 0.1  # a tenth of the band of 1 °C


# ---- the object of a machine


@cache
def laws() -> dict[str, tuple[Plant, Law]]:
    u, y = study.data_sets(np.random.default_rng(1), 1500, 1)
    learned = window.learn([u[:, 0]], [y[:, 0]], longest=4)
    varx = window.law(learned, np.diag(ONE5), np.diag(ONE7), 0.99, integral=0.05)
    pairs = baseline.pairing(baam(), LIMITS.low, LIMITS.high, horizon=600)
    return {
        "lqg": (baam(), lqg(baam())),
        "varx": (window.observer_form(learned)[0], compact(varx, learned.N)),
        "pi": (baam(), baseline.pi_law(pairs, inputs=7)),
    }


def replayed(ready: Deployed, asked: panel.Cases, model: Plant, case: int) -> np.ndarray:
    """Commands (steps, m) of the object that plays one case of the panel with the panel's noise."""
    controller, noise = RunningController(ready, model), panel.noise_of(asked)[:, case]
    plant, x = asked.plants[asked.plant[case]], asked.x0[case]
    held, commands = plant.C @ x + plant.d, np.empty((asked.steps, 7))
    for t in range(asked.hold):
        first = asked.references[asked.asked[case, 0]]
        controller.watch(asked.u0[case], held + noise[t], first.H @ first.w0)
    controller.hand_over(held + noise[asked.hold], at=asked.starts[asked.start[case]])
    for t in range(asked.steps):
        reference = asked.references[asked.asked[case, np.flatnonzero(asked.begin[case] <= t)[-1]]]
        r = reference if len(reference.w0) > 1 else reference.H[:, 0]
        u = commands[t] = controller.step(plant.C @ x + plant.d + noise[asked.hold + t], r, t)
        outside = asked.warms[asked.plant[case]] * asked.outside[t, case]
        x = plant.A @ x + plant.B @ u + plant.b + outside
    return commands


def every_kind() -> panel.Questions:
    return panel.Questions(
        np.outer([20.0, 45.0, 90.0], ONE5),
        np.stack([REFERENCE, REFERENCE - 15]),
        (REFERENCE - 15, np.full(5, 0.025)),
        (REFERENCE - 10, np.full(5, 3.0), 60.0),
        np.stack([REFERENCE, REFERENCE - 5, REFERENCE + 5]),
    )


@pytest.mark.parametrize(
    "name, count, governed, limits",
    [("lqg", 50, True, SLOW), ("varx", 50, True, LIMITS), ("pi", 100, False, SLOW)],
)
def test_the_object_asks_for_what_the_panel_judged(
    name: str, count: int, governed: bool, limits: ActuatorLimits
):
    """200 cases in all, of every kind."""
    model, law = laws()[name]
    plants = panel.drawn([baam()], -(-count // 9), SPREAD, cells=True, rng=np.random.default_rng(4))
    ready = deployed(law, limits, integral_limit=1.0, governor=guard() if governed else None)
    asked = cases(plants, every_kind(), steps=45)
    judged = played(ready, asked, model).u
    commands = np.stack([replayed(ready, asked, model, case) for case in range(count)], axis=1)
    assert set(asked.kind[:count]) == {"constant", "ramp", "sinusoid", "sequence", "disturbed"}
    # of the range of 100 percent: sums in another order differ in the last digits
    np.testing.assert_allclose(commands, judged[:, :count], rtol=0, atol=1e-9 * 100)


@pytest.mark.parametrize(
    "F",
    [
        ramp(ONE5, ONE5).F,
        sinusoid(ONE5, ONE5, 60.0).F,
        np.eye(3),
        np.random.default_rng(1).normal(size=(6, 6)),
    ],
    ids=["ramp", "sinusoid", "constants", "any"],
)
def test_a_reference_s_matrix_is_triangular_in_a_unitary_basis(F):
    """F = V S V*; numpy has no Schur form, and an exported file has numpy only."""
    S, V = law._triangular(F)
    np.testing.assert_array_equal(S, np.triu(S))
    np.testing.assert_allclose(V @ V.conj().T, np.eye(len(F)), atol=1e-12)
    np.testing.assert_allclose(V @ S @ V.conj().T, F, atol=1e-12)


@pytest.mark.parametrize("reference", [REFERENCE, sinusoid(REFERENCE, np.full(5, 3.0), 60.0)], ids=["r", "F"])
def test_a_restored_controller_goes_on_bit_by_bit(reference):
    rng = np.random.default_rng(5)
    ready = deployed(lqg(baam()), SLOW, integral_limit=1.0, governor=guard())
    first, second = RunningController(ready, baam()), RunningController(ready, baam())
    for _ in range(10):
        first.watch(np.full(7, 0.4), 150 + rng.standard_normal(5), REFERENCE)
    first.hand_over(np.full(5, 150.0))
    for t in range(20):
        first.step(150 + t + rng.standard_normal(5), reference, t)
    file = io.BytesIO()
    np.savez(file, **first.saved())
    file.seek(0)
    second.restore(dict(np.load(file)))
    for t in range(20, 40):
        y = 150 + t + rng.standard_normal(5)
        np.testing.assert_array_equal(second.step(y, reference, t), first.step(y, reference, t))


def test_reading_a_command_does_not_change_the_controller():
    controller = RunningController(deployed(lqg(baam()), LIMITS, integral_limit=1.0), baam())
    controller.watch(np.full(7, 0.4), np.full(5, 150.0), REFERENCE)
    controller.hand_over(np.full(5, 150.0))
    u = controller.step(np.full(5, 150.0), REFERENCE, 0)
    before = controller.saved()
    u[:] = 99.0
    np.testing.assert_array_equal(controller.saved()["u"], before["u"])


def test_what_a_controller_cannot_run_on_is_refused_in_a_sentence():
    controller = RunningController(deployed(lqg(baam()), LIMITS, integral_limit=1.0), baam())
    with pytest.raises(ValueError, match="call watch with each sample in manual first"):
        controller.step(np.full(5, 150.0), REFERENCE, 0)
    controller.watch(np.full(7, 0.4), np.full(5, 150.0), REFERENCE)
    with pytest.raises(ValueError, match="go to manual until every sensor answers"):
        controller.step(np.array([150.0, np.nan, 150.0, 150.0, 150.0]), REFERENCE, 0)
    controller.step(np.full(5, 150.0), REFERENCE, 7)
    with pytest.raises(ValueError, match=re.escape("sample 6 comes after sample 7; count samples upwards")):
        controller.step(np.full(5, 150.0), REFERENCE, 6)


def in_control(count: int = 5, *, governed: bool = False) -> RunningController:
    ready = deployed(lqg(baam()), LIMITS, integral_limit=1.0, governor=guard() if governed else None)
    controller = RunningController(ready, baam())
    controller.watch(np.full(7, 0.4), np.full(5, 150.0), REFERENCE)
    controller.step(np.full(5, 150.0), REFERENCE, count)
    return controller


@pytest.mark.parametrize(
    ("u", "y", "r", "message"),
    [
        (np.full(7, np.nan), np.full(5, 150.0), REFERENCE, "expects finite inputs in percent"),
        (np.full(7, 0.4), np.full(5, np.nan), REFERENCE, "go to manual until every sensor answers"),
        (np.full(7, 0.4), np.full(5, 150.0), REFERENCE * np.nan, "expects finite references in °C"),
        (np.full(3, 0.4), np.full(5, 150.0), REFERENCE, "expects 7 inputs in percent"),
        (np.full(7, 0.4), np.full(1, 150.0), REFERENCE, "expects 5 temperatures in °C"),
    ],
)
def test_a_sample_in_manual_that_is_none_is_refused_and_not_remembered(u, y, r, message):
    controller, other = in_control(), in_control()
    with pytest.raises(ValueError, match=message):
        controller.watch(u, y, r)
    for name, part in other.saved().items():
        np.testing.assert_array_equal(controller.saved()[name], part)


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        (REFERENCE[:3], "expects 5 references in °C"),
        (180.0, "expects 5 references in °C"),
        (constant(REFERENCE[:2]), "expects 5 references in °C"),
        (REFERENCE * np.nan, "expects finite references in °C"),
    ],
)
def test_a_reference_that_is_none_is_refused_and_the_last_one_stays(reference, message):
    controller, other = in_control(), in_control()
    with pytest.raises(ValueError, match=message):
        controller.step(np.full(5, 150.0), reference, 6)
    y = np.full(5, 151.0)
    np.testing.assert_array_equal(controller.step(y, REFERENCE, 6), other.step(y, REFERENCE, 6))


def test_time_that_runs_backwards_is_refused_with_a_new_reference_too():
    with pytest.raises(ValueError, match="sample 4 comes after sample 5; count samples upwards"):
        in_control().step(np.full(5, 150.0), REFERENCE + 1, 4)


@pytest.mark.parametrize("governed", [True, False])
def test_a_state_of_another_controller_is_refused(governed: bool):
    arrays = in_control(governed=not governed).saved()
    with pytest.raises(ValueError, match="restore what a controller of the same law and governor saved"):
        in_control(governed=governed).restore(arrays)
    own = in_control(governed=governed).saved()
    with pytest.raises(ValueError, match="restore what a controller of the same law and governor saved"):
        in_control(governed=governed).restore({"z": own["z"]})
    with pytest.raises(ValueError, match="restore what a controller of the same law and governor saved"):
        in_control(governed=governed).restore({name: own[name] for name in own if name != "told"})
    with pytest.raises(ValueError, match="but xi has some that are not"):
        in_control(governed=governed).restore(own | {"xi": own["xi"] * np.nan})


def test_a_state_is_four_arrays_and_what_was_told():
    controller = RunningController(deployed(lqg(baam()), LIMITS, integral_limit=1.0), baam())
    controller.watch(np.full(7, 0.4), np.full(5, 150.0), REFERENCE)
    assert tuple(controller.saved()) == (*ControllerState._fields, "told", "before", "kick")
