"""A controller and its certificate in a folder: what is written is read bit by bit, and nothing that was
changed, is missing, or is of another machine passes."""

import hashlib
import json

import numpy as np
import pytest

from pipeline.deploy import machine
from pipeline.deploy.supervise import Exported, Signal
from tests.deploy.deployed_machines import LAWS, exported, passed, refused


def same(a, b) -> bool:
    """Equal records, arrays bit by bit."""
    if isinstance(a, tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    return np.array_equal(a, b, equal_nan=True) if isinstance(a, np.ndarray) else a == b


@pytest.mark.parametrize("kind", LAWS)
def test_a_controller_is_read_as_it_was_written(kind, tmp_path):
    of = exported(kind)
    machine.write(tmp_path, of, passed(of))
    again, certificate = machine.read(tmp_path)
    assert same(again, of)
    assert certificate == passed(of)


def test_the_certificate_holds_the_digest_of_both_files(tmp_path):
    of = exported()
    machine.write(tmp_path, of, passed(of))
    both = (tmp_path / "controller.json").read_bytes() + (tmp_path / "arrays.safetensors").read_bytes()
    assert hashlib.sha256(both).hexdigest() == machine.controller_sha256(of)


@pytest.mark.parametrize("name", ["controller.json", "arrays.safetensors"])
def test_a_controller_that_was_changed_after_it_was_certified_is_refused(name, tmp_path):
    of = exported()
    machine.write(tmp_path, of, passed(of))
    data = bytearray((tmp_path / name).read_bytes())
    at = data.rindex(b'"heater_1"') + 8 if name.endswith("json") else len(data) - 9
    data[at] ^= 1
    (tmp_path / name).write_bytes(bytes(data))
    with pytest.raises(ValueError, match="were changed since, export the controller again"):
        machine.read(tmp_path)


@pytest.mark.parametrize("name", ["controller.json", "arrays.safetensors", "certificate.json"])
def test_a_missing_file_is_named(name, tmp_path):
    of = exported()
    machine.write(tmp_path, of, passed(of))
    (tmp_path / name).unlink()
    with pytest.raises(ValueError, match=f"{name} is missing"):
        machine.read(tmp_path)


def test_a_folder_that_is_none_or_of_another_version_is_refused_in_one_sentence(tmp_path):
    with pytest.raises(ValueError, match="is no folder; give a CONTROLLER folder"):
        machine.read(tmp_path / "nothing")
    (tmp_path / "controller.json").write_text(json.dumps({"version": 0}))
    with pytest.raises(ValueError, match="expected a controller of version 1 but found 0"):
        machine.read(tmp_path)


# ---- no certificate, no export


def test_nothing_is_written_without_a_passed_certificate(tmp_path):
    of = exported()
    with pytest.raises(ValueError, match="its certificate was refused by rule poles"):
        machine.write(tmp_path / "controller", of, refused(of, "poles"))
    assert not (tmp_path / "controller").exists()


@pytest.mark.parametrize(
    "what, changed",
    [
        ("plant", {"plant_sha256": "0" * 64}),
        ("spread", {"spread_sha256": "0" * 64}),
        ("contestant", {"controller": "pi"}),
        ("sample time in s", {"sample_time_s": 0.3}),
        ("evidence", {"evidence": "recorded"}),
        ("controller", {"controller_sha256": "0" * 64}),
        ("units", {"outputs": tuple(one._replace(unit="K") for one in exported().machine.outputs)}),
        ("units", {"inputs": exported().machine.inputs[::-1]}),
    ],
)
def test_a_certificate_of_another_machine_is_refused_by_name(what, changed):
    of = exported()
    with pytest.raises(ValueError, match=f"the certificate is of another {what}: expected "):
        machine.check_certificate(of, passed(of)._replace(**changed))


# ---- machines that the law cannot be wired to


def wired(of: Exported, **changed) -> Exported:
    return of._replace(machine=of.machine._replace(**changed))


def first(signals: tuple[Signal, ...], **changed) -> tuple[Signal, ...]:
    return (signals[0]._replace(**changed), *signals[1:])


INPUTS, OUTPUTS = exported().machine.inputs, exported().machine.outputs


@pytest.mark.parametrize(
    "changed, sentence",
    [
        ({"inputs": INPUTS[:1]}, r"the law has 2 inputs but the machine names 1 \(heater_1\)"),
        ({"outputs": ()}, r"the law has 2 outputs but the machine names 0 \(none\)"),
        ({"inputs": first(INPUTS, high=np.inf)}, "input heater_1: the limit high is missing"),
        ({"inputs": first(INPUTS, low=np.nan)}, "input heater_1: the limit low is missing"),
        ({"outputs": first(OUTPUTS, low=np.nan)}, "output sensor_1: the limit low is missing"),
        ({"inputs": first(INPUTS, low=100.0, high=0.0)}, "input heater_1: limits are crossed, low 100 is"),
        ({"outputs": first(OUTPUTS, low=300.0)}, "output sensor_1: limits are crossed"),
        (
            {"inputs": first(INPUTS, high=80.0)},
            "the machine declares 0 to 80 percent but the law keeps 0 to 100",
        ),
        ({"inputs": first(INPUTS, unit="W")}, "input heater_1: expected unit percent but found 'W'"),
        ({"outputs": first(OUTPUTS, unit="K")}, "output sensor_1: expected unit degC but found 'K'"),
        ({"outputs": first(OUTPUTS, name="heater_1")}, "signal 'heater_1' should be a name used once"),
        ({"sample_time_s": 0.3}, "the machine is sampled every 0.3 s but the model every 1 s"),
        ({"sample_time_s": 0.0}, "the sample time should be above zero but is 0 s"),
    ],
)
def test_a_machine_that_the_law_cannot_be_wired_to_is_refused_by_name(changed, sentence):
    with pytest.raises(ValueError, match=sentence):
        machine.check(wired(exported(), **changed))


def test_a_law_or_model_of_another_machine_is_refused():
    of, one = exported(), exported(zones=1)
    with pytest.raises(ValueError, match="the fallback has 1 inputs and 1 outputs but 2 and 2 are expected"):
        machine.check(of._replace(fallback=one.controller))
    with pytest.raises(ValueError, match="the model has 1 inputs and 1 outputs but the law 2 and 2"):
        machine.check(of._replace(model=one.model))
