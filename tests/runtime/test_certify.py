"""What is certified is what was judged: commands, files and words of the stage, on six plants of the study's
machine."""

from functools import cache

import numpy as np
import pytest

from pipeline.runtime import assembly, certified, checks
from pipeline.runtime.export import c
from pipeline.runtime.machine import Exported, check
from pipeline.temperature.controllers.table import BY_NAME, design_controllers
from stages import certify
from tests.runtime.deployed_machines import exported
from tests.temperature.test_evaluate_temperature import judged, small


@cache
def deciding(name: str) -> tuple[np.ndarray, ...]:
    """Outputs, references and applied inputs of the case that decided the comparison."""
    played = {key: np.asarray(values) for key, values in judged(small()).trajectories.items()}
    rows = (played["contestant"] == name) & (played["case_name"] == "deciding")
    inputs, outputs = (
        [one.name for one in side] for side in (small().machine.inputs, small().machine.outputs)
    )
    columns = outputs, [f"{one}_reference" for one in outputs], [f"{one}_applied" for one in inputs]
    return tuple(np.stack([played[column][rows] for column in part], axis=1) for part in columns)


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


def test_a_case_that_none_of_the_judging_half_begins_like_is_not_the_judged_one():
    y, r, applied = deciding("pi")
    half = small().setting.rehearsal.judging
    assert checks.judged_difference(made("pi"), half, y + 1.0, r, applied) == np.inf


def test_an_exported_machine_is_the_declared_one():
    one, declared = made("pi"), small().machine
    check(one)
    assert [signal.name for signal in one.machine.inputs] == [signal.name for signal in declared.inputs]
    assert [(o.low, o.high) for o in one.machine.outputs] == [(o.low, o.high) for o in declared.outputs]
    assert one.simulated and one.fallback is not None


def test_only_learned_gains_have_bands():
    of = small()

    def route(name):
        return assembly.gain_route(of.problem, BY_NAME[name].learned_from, of.weights.get(name, {}))

    assert route("subspace_lqg") is None and route("pi_simc") is None
    assert route("varx_riccati").route == "window"
    assert route("learned_kernel").N == of.problem.kernel.N


def test_c_with_other_golden_vectors_is_refused():
    of = exported()
    files = c.code(of, certified.PLACE) | {"golden.csv": "0.0\n1,2,3\n"}
    if checks.find_compiler():
        with pytest.raises(ValueError, match="the exported C of lqg does not pass its golden vectors"):
            checks.check_compiled(of, files)
