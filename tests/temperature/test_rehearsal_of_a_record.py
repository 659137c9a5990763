"""What a rehearsal on somebody's record asks, of which plants, and under which governor."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.store import params
from pipeline.temperature.controllers import baseline, governor
from pipeline.temperature.controllers import law as laws
from pipeline.temperature.plant import plant as linear
from pipeline.temperature.plant import strictly_proper
from pipeline.temperature.settings import Panel, Tracking, TuneWeights
from pipeline.temperature.settings import Plant as Machine
from pipeline.temperature.test_set import panel
from pipeline.temperature.test_set.scenario_defaults import steady_map
from tests.temperature import small_machines
from tests.temperature.small_machines import BED

FILE = Path(__file__).resolve().parents[2] / "params.yaml"


def settings() -> Panel:
    declared = params.load(Panel, "panel", FILE)
    few = {half: getattr(declared, half).model_copy(update={"plants": 6}) for half in ("judging", "training")}
    return declared.model_copy(update=few)


def owner(reference: float) -> Machine:
    return Machine.model_validate(
        {
            "inputs": [{"name": "heater", "unit": "percent", "low": 0, "high": 100}],
            "outputs": [{"name": "bed", "unit": "degC", "reference": reference, "low": 0, "high": 150}],
            "sample_time_s": BED.sample_time_s,
        }
    )


@pytest.fixture(scope="module")
def family():
    of = small_machines.identified(BED)
    return [strictly_proper(one) for one in (of.plant, *of.family)]


def rehearsal(family, reference: float = 70.0, **more: float) -> panel.Rehearsal:
    u, y = small_machines.record(BED)
    second = ([u], [y + more["warmer"]]) if "warmer" in more else ([], [])
    numbers = [0, 1][: 1 + len(second[0])]
    return panel.from_record(settings(), owner(reference), family, [u, *second[0]], [y, *second[1]], numbers)


def shared(family, judged: panel.Rehearsal) -> panel.CaseConditions:
    tuning, tracking = params.load(TuneWeights, "tune_weights", FILE), params.load(Tracking, "tracking", FILE)
    return panel.conditions(tuning, owner(70.0), tracking, settings(), judged, family)


def test_no_plant_starts_where_its_inputs_could_not_hold_it(family):
    """But for the coldest reading of the record, which a machine that is switched on need not be held at."""
    judged = rehearsal(family).judging
    held = judged.start > 0
    assert judged.u0[held].min() >= 0 and judged.u0[held].max() <= 100
    for k, plant in enumerate(judged.plants):
        rows = judged.plant == k
        after = judged.x0[rows] @ plant.A.T + judged.u0[rows] @ plant.B.T + plant.b
        # rounding of a solve with I - A, whose condition is some 1e4
        np.testing.assert_allclose(after, judged.x0[rows], rtol=1e-8, atol=1e-7)


def test_both_halves_have_the_lag_that_a_model_of_one_mode_does_not_hold():
    one = linear([[0.99]], [[0.01]], [[1.0]], b=[0.2])
    of = rehearsal([one, one])
    for half in (of.training, of.judging):
        kept = np.array([each.A[-1, -1] for each in half.plants])
        assert (kept > 0).sum() >= 3
        # a twentieth of 100 samples, of a plant that is at most a fifth slower
        assert kept.max() <= np.exp(-1 / (panel.LAG * 1.21 * 100))


def test_the_machine_of_the_study_is_known_to_have_no_lag_in_series():
    assert panel.spread_of(settings()).lag == 0.0
    assert panel.spread_around(settings(), linear([[0.99]], [[0.01]], [[1.0]])).lag == panel.LAG


def test_a_slow_bed_has_its_own_time_band_and_length(family):
    judged = rehearsal(family)
    assert judged.settling_s is not None and 600 < judged.settling_s < 1500  # three times some 300 s
    assert judged.judging.steps * BED.sample_time_s > 2 * judged.settling_s
    assert judged.band_degC < 1.0
    assert shared(family, judged).faster == 1.0  # slower than the study's machine: its delay margin stays


def test_a_reference_out_of_reach_is_named_with_the_heater_at_its_limit(family):
    far = rehearsal(family, reference=145.0)
    (entry,) = far.infeasible
    assert entry["output"] == "bed" and entry["binding"] == "heater at 100 percent"
    assert entry["reachable_degC"] < 145.0
    assert far.judging.references[0].H[0, 0] < entry["reachable_degC"]


def test_the_ambient_differs_by_as_much_as_recordings_do(family):
    """Twelve degrees between two recordings are more than the eight of the panel."""

    def ambients(of: panel.Rehearsal) -> float:
        rests = [steady_map(plant)[1][0] for plant in of.judging.plants]
        return float(np.ptp(rests))

    assert ambients(rehearsal(family, warmer=12.0)) > ambients(rehearsal(family))


@pytest.mark.parametrize("slower", (-0.2, 0.2))
def test_a_faster_plant_keeps_its_steady_gains_and_what_rings_stays_stable(slower):
    """By hand: 0.99 becomes 1 - 0.01 / (1 + slower); -0.85 in the same formula would be -1.31 at -20 %."""
    A = np.diag([0.99, -0.85]) + np.array([[0.0, 0.3], [0.0, 0.0]])
    pace = panel.paced(A, slower)
    after = np.eye(2) + pace @ (A - np.eye(2))
    np.testing.assert_allclose(
        np.sort(np.linalg.eigvals(after)), [-0.85, 1 - 0.01 / (1 + slower)], rtol=1e-12
    )
    B = np.array([[1.0], [0.5]])
    np.testing.assert_allclose(
        np.linalg.solve(np.eye(2) - after, pace @ B), np.linalg.solve(np.eye(2) - A, B), rtol=1e-9
    )


def test_the_governor_is_the_same_in_other_units_of_the_inputs(family):
    """Percent or tenths of a percent: what it allows is the same heat."""
    y, target, noise = np.full((1, 1), 40.0), np.full((1, 1), 70.0), np.array([0.3])
    allowed = []
    for unit in (1.0, 10.0):
        guarded = [panel.delayed(family[0]._replace(B=family[0].B / unit), late) for late in (False, True)]
        limits = laws.ActuatorLimits(np.zeros(1), np.full(1, 100.0 * unit), np.full(1, np.inf))
        outputs = governor.OutputLimits(np.full(1, -np.inf), np.full(1, 40.4), noise, 0.5)
        made = governor.governor(guarded, limits, outputs, laws.Strength(0.7, 1.4, 0.15))
        memory = laws.started(made, y)
        for _ in range(20):
            memory = laws.observed(made, memory, np.full((1, 1), 20.0 * unit), y)
        asked = limits.high[None], limits.low[None], limits.high[None]
        allowed.append(laws.governed(made, memory, asked[0], target, *asked[1:]) / unit)
    assert 0 < allowed[0][0, 0] < 100
    np.testing.assert_allclose(allowed[1], allowed[0], rtol=1e-6)  # two Riccati equations solved to 1e-9


def test_the_governor_holds_no_output_of_a_slow_machine_off_its_reference(family):
    judged = rehearsal(family)
    setting, asked = shared(family, judged), judged.judging
    pairs = baseline.pairing(
        family[0],
        setting.limits.low,
        setting.limits.high,
        horizon=600,
        family=family,
        noise_degC=judged.noise,
    )
    law = baseline.pi_law(pairs, inputs=1)
    aims = panel.aims(law, panel.rests(family[0], asked, setting.limits), asked)
    errors, overshoots = [], []
    for guard in (None, setting.governor):
        deployed = laws.deployed(law, setting.limits, integral_limit=setting.integral_limit, governor=guard)
        figures = panel.figures(
            panel.rolled_out(deployed, asked, aims),
            asked,
            limits=setting.limits,
            low=np.zeros(1),
            high=np.full(1, 150.0),
            band=judged.band_degC,
            settled=setting.settled,
        )
        errors.append(figures.settled_error.max())
        overshoots.append(np.nanmax(figures.overshoot))
    # a twentieth of the band; it was 0.9 °C while the forecast's doubt counted at the target
    assert errors[1] <= errors[0] + 0.05 * judged.band_degC
    assert overshoots[1] <= overshoots[0] + 0.05 * judged.band_degC
