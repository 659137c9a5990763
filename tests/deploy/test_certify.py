"""What is certified is what was judged: commands, files and words of the stage, on six plants of the study's
machine."""

from functools import cache

import numpy as np
import pytest

from pipeline.deploy import assembly, bands, certificate, checks, to_c
from pipeline.deploy import certify as measuring
from pipeline.deploy.machine import check
from pipeline.deploy.supervise import Exported
from pipeline.temperature.controllers.feed_forward import Told
from pipeline.temperature.controllers.table import BY_NAME, design_controllers
from pipeline.temperature.plant import plant
from pipeline.temperature.settings import Input, Output, Plant, PlantSignal
from stages import certify
from tests.deploy.deployed_machines import exported
from tests.temperature.test_evaluate_temperature import judged, small


@cache
def deciding(name: str) -> tuple[int, np.ndarray, np.ndarray]:
    """Number, true outputs and applied inputs of the case that decided the comparison."""
    result = judged(small())
    played = {key: np.asarray(values) for key, values in result.trajectories.items()}
    rows = (played["contestant"] == name) & (played["case_name"] == "deciding")
    outputs = [played[one.name][rows] for one in small().machine.outputs]
    applied = [played[f"{one.name}_applied"][rows] for one in small().machine.inputs]
    return result.summary["deciding"]["case"], np.stack(outputs, axis=1), np.stack(applied, axis=1)


@cache
def made(name: str) -> Exported:
    of = small()
    designs, _ = design_controllers(of.problem, of.weights)
    wired = certify.wire(of.machine)
    return assembly.assemble(
        name, designs[name], designs["pi_simc"], wired, of.setting, of.problem.family, simulated=True
    )


@pytest.mark.parametrize("name", ["pi", "subspace_lqg", "varx_riccati", "learned_kernel"])
def test_the_exported_law_gives_the_judged_commands_of_the_deciding_case(name):
    half = small().setting.rehearsal.judging
    difference = checks.judged_difference(made(name), half, *deciding(name))
    assert difference <= 1e-9 * 100
    checks.check_same(made(name), difference)


def test_a_law_that_was_changed_since_is_not_exported():
    one, half = made("subspace_lqg"), small().setting.rehearsal.judging
    law = one.controller.law
    changed = one._replace(controller=one.controller._replace(law=law._replace(K=1.001 * law.K)))
    difference = checks.judged_difference(changed, half, *deciding("subspace_lqg"))
    with pytest.raises(ValueError, match=r"subspace_lqg gives commands .* percent away from those that were"):
        checks.check_same(changed, difference)


def test_commands_of_another_case_are_not_those_that_were_judged():
    case, outputs, applied = deciding("pi")
    half = small().setting.rehearsal.judging
    others = [row for row, plant in enumerate(half.plant) if plant != half.plant[case]]
    difference = checks.judged_difference(made("pi"), half, others[0], outputs, applied)
    with pytest.raises(ValueError, match="pi gives commands"):
        checks.check_same(made("pi"), difference)


def test_an_exported_machine_is_the_declared_one():
    one, declared = made("pi"), small().machine
    check(one)
    assert [signal.name for signal in one.machine.inputs] == [signal.name for signal in declared.inputs]
    assert [(o.low, o.high) for o in one.machine.outputs] == [(o.low, o.high) for o in declared.outputs]
    assert one.simulated and one.fallback is not None


def test_only_learned_gains_have_bands():
    of = small()

    def route(name):
        return bands.gain_route(of.problem, BY_NAME[name].learned_from, of.weights.get(name, {}))

    assert route("subspace_lqg") is None and route("pi_simc") is None
    assert route("varx_riccati").route == "window"
    assert route("learned_kernel").N == of.problem.kernel.N


def test_c_with_other_golden_vectors_is_refused():
    of = exported()
    files = to_c.code(of, certificate.PLACE) | {"golden.csv": "0.0\n1,2,3\n"}
    if checks.find_compiler():
        with pytest.raises(ValueError, match="the exported C of lqg does not pass its golden vectors"):
            checks.check_compiled(of, files)


def test_a_record_is_cut_where_a_sample_of_an_output_is_missing():
    u, y = np.arange(500.0)[:, None], np.stack([np.arange(500.0), np.ones(500)], axis=1)
    y[300, 1] = y[350, 0] = np.nan
    inputs, outputs, numbers = measuring.cut_at_missing([u, u[:50]], [y, y[:50]], [0, 1])
    assert [(part[0, 0], part[-1, 0]) for part in inputs] == [(0, 299), (351, 499), (0, 49)]
    assert all(np.isfinite(part).all() for part in outputs) and numbers == [0, 0, 1]


def test_the_certificate_says_what_is_fed_forward_and_what_is_not():
    heater = Input(name="heater", unit="percent", low=0, high=100)
    hot_end = Output(name="hotend", unit="degC", reference=210, low=0, high=280)
    declared = Plant(inputs=[heater], outputs=[hot_end], sample_time_s=1.0)
    assert "Put the printed G-code beside klippy.log" in certify.conditions(declared, None)
    fan, room = PlantSignal(name="fan", unit="percent"), PlantSignal(name="room", unit="degC")
    declared = declared.model_copy(update={"disturbances": [fan, room]})
    effect = plant([[0.9]], [[0.0, 0.0]], [[1.0]])
    told = Told(
        effect, np.zeros(2), np.ones(2), np.array([[0.129, 0.2]]), np.array([[0.006, 0.5]]), np.zeros(2)
    )
    said = certify.conditions(declared, told)
    assert "Fed forward: fan (heater +0.129 ± 0.0099 % for each percent), with 90 % bands. Tell" in said
    assert "The record does not tell what these do: room. Nothing makes up for it. What dist" in said
    assert certify.conditions(declared, None).startswith("The record does not tell what these do: fan, room.")
