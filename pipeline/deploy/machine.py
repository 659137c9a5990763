"""A controller as exported: its machine, the law as it was judged, and the folder that holds both.

A folder CONTROLLER has three files. controller.json is for people and programs: names, units, limits, sample
time, controller name, hashes. arrays.safetensors has every array of the law, the governor, the model and the
supervisor, exactly. certificate.json states the measured results of the two; it holds the SHA-256 of

    cat controller.json arrays.safetensors | sha256sum

so that neither can be changed unnoticed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save as as_bytes

from pipeline.deploy import certificate as certificates
from pipeline.deploy.certificate import Certificate
from pipeline.deploy.supervise import DEGC, PERCENT, Exported, Signal, restored
from pipeline.store import artifacts
from pipeline.temperature.controllers.law import Plant

VERSION = 1
CONTROLLER, ARRAYS, CERTIFICATE = "controller.json", "arrays.safetensors", "certificate.json"
EXPORTED = "exported.json"  # beside the folders of the loops: what was exported, and if not, why


def plants_sha256(plants: Sequence[Plant]) -> str:
    """Returns the SHA-256 of plants: every array of each, its shape before its numbers as little-endian
    doubles."""
    digest = hashlib.sha256()
    for plant in plants:
        for name, value in plant._asdict().items():
            array = np.ascontiguousarray(value, "<f8")
            digest.update(f"{name} {array.shape}\n".encode() + array.tobytes())
    return digest.hexdigest()


# ---- what is refused


def check(exported: Exported) -> None:
    """Raises ValueError, naming the signal, if the controller cannot be wired to the machine: limits missing
    or crossed, a unit or a sample time that is not the law's, or too few signals."""
    machine, (m, p) = exported.machine, exported.controller.law.D.shape
    for kind, signals, count, unit in (
        ("input", machine.inputs, m, PERCENT),
        ("output", machine.outputs, p, DEGC),
    ):
        names = [signal.name for signal in signals]
        if len(names) != count:
            raise ValueError(
                f"controller {exported.name}: the law has {count} {kind}s but the machine names {len(names)} "
                f"({', '.join(names) or 'none'}); name every {kind} that the law was designed for, in order"
            )
        for signal in signals:
            _check_signal(signal, kind, unit)
    names = [signal.name for signal in (*machine.inputs, *machine.outputs, *machine.disturbances)]
    if twice := sorted({name for name in names if names.count(name) > 1 or not name.strip()}):
        raise ValueError(
            f"controller {exported.name}: signal {twice[0]!r} should be a name used once; give every input "
            "and output a name of its own"
        )
    forward, told = exported.controller.forward, len(machine.disturbances)
    if forward is not None and len(forward.mean) != told:
        raise ValueError(
            f"controller {exported.name}: it is told {len(forward.mean)} disturbances but the machine names "
            f"{told}; name every disturbance that it was learned with, in order"
        )
    _check_sample_time(exported)
    _check_limits(exported)


def _check_signal(signal: Signal, kind: str, unit: str) -> None:
    if signal.unit != unit:
        raise ValueError(
            f"{kind} {signal.name}: expected unit {unit} but found {signal.unit!r}; the law was learned in "
            f"{unit}, convert the signal"
        )
    missing = [side for side in ("low", "high") if np.isnan(getattr(signal, side))]
    if kind == "input":
        missing = [side for side in ("low", "high") if not np.isfinite(getattr(signal, side))]
    if missing:
        raise ValueError(
            f"{kind} {signal.name}: the limit {missing[0]} is missing; declare low and high in {unit}"
        )
    if not signal.low < signal.high:
        raise ValueError(
            f"{kind} {signal.name}: limits are crossed, low {signal.low:g} is not below high "
            f"{signal.high:g} {unit}; exchange or correct them"
        )


def _check_sample_time(exported: Exported) -> None:
    at, model = exported.machine.sample_time_s, exported.model.sample_time_s
    if not (np.isfinite(at) and at > 0):
        raise ValueError(
            f"controller {exported.name}: the sample time should be above zero but is {at:g} s; state the "
            "time between two samples"
        )
    if at != model:
        raise ValueError(
            f"controller {exported.name}: the machine is sampled every {at:g} s but the model every "
            f"{model:g} s; identify the plant at the machine's sample time"
        )


def _check_limits(exported: Exported) -> None:
    """Raises ValueError if the law does not keep the limits that the machine declares, or if the model has
    other signals."""
    inputs, (m, p) = exported.machine.inputs, exported.controller.law.D.shape
    for what, deployed in (("law", exported.controller), ("fallback", exported.fallback)):
        if deployed is None:
            continue
        if deployed.law.D.shape != (m, p):
            raise ValueError(
                f"controller {exported.name}: the {what} has {deployed.law.D.shape[0]} inputs and "
                f"{deployed.law.D.shape[1]} outputs but {m} and {p} are expected; design it for this machine"
            )
        for i, signal in enumerate(inputs):
            low, high = float(deployed.limits.low[i]), float(deployed.limits.high[i])
            if (low, high) != (signal.low, signal.high):
                raise ValueError(
                    f"input {signal.name}: the machine declares {signal.low:g} to {signal.high:g} percent "
                    f"but the {what} keeps {low:g} to {high:g}; design it again with the declared limits"
                )
    if (exported.model.m, exported.model.p) != (m, p):
        raise ValueError(
            f"controller {exported.name}: the model has {exported.model.m} inputs and {exported.model.p} "
            f"outputs but the law {m} and {p}; aim on a model of this machine"
        )


def check_certificate(exported: Exported, certificate: Certificate) -> None:
    """Raises ValueError if the certificate was not passed, or belongs to another controller, plant, spread,
    sample time or unit."""
    if certificate.verdict != "passed":
        raise ValueError(
            f"controller {exported.name}: its certificate was refused by rule {certificate.first_failed}; "
            "nothing is exported without a passed certificate"
        )
    mine, its = exported.machine, certificate
    pairs: tuple[tuple[str, Any, Any], ...] = (
        ("plant", exported.plant_sha256, its.plant_sha256),
        ("spread", exported.spread_sha256, its.spread_sha256),
        ("contestant", exported.name, its.controller),
        ("sample time in s", mine.sample_time_s, its.sample_time_s),
        ("units", _units(mine.inputs, mine.outputs), _units(its.inputs, its.outputs)),
        ("evidence", "simulated" if exported.simulated else "recorded", its.evidence),
        ("controller", controller_sha256(exported), its.controller_sha256),
    )
    for what, found, certified in pairs:
        if found != certified:
            raise ValueError(
                f"controller {exported.name}: the certificate is of another {what}: expected {certified}, "
                f"found {found}; certify this controller"
            )


def _units(inputs: Sequence[Signal], outputs: Sequence[Signal]) -> str:
    return ", ".join(f"{signal.name} in {signal.unit}" for signal in (*inputs, *outputs))


# ---- the folder


def write(folder: str | Path, exported: Exported, certificate: Certificate) -> None:
    """Writes the three files of a CONTROLLER folder. Raises ValueError, and writes nothing, if `check` or
    `check_certificate` refuses."""
    check(exported)
    check_certificate(exported, certificate)
    write_controller(folder, exported)
    artifacts.write_text(Path(folder) / CERTIFICATE, certificates.to_json(certificate))


def write_controller(folder: str | Path, exported: Exported) -> None:
    """Writes controller.json and arrays.safetensors."""
    text, arrays = parts(exported)
    artifacts.write_text(Path(folder) / CONTROLLER, text)
    artifacts.write_weights(Path(folder) / ARRAYS, "controller", arrays, {})


def read(folder: str | Path) -> tuple[Exported, Certificate]:
    """Returns the controller and certificate of a folder that `write` wrote. Raises ValueError if a file is
    missing, broken, or not the one that was certified."""
    folder = Path(folder)
    if not (folder / CONTROLLER).exists() and (why := _why_none(folder)):
        raise ValueError(f"{folder} has no {CONTROLLER}. {why}")
    if not folder.is_dir():
        raise ValueError(f"{folder} is no folder; give a CONTROLLER folder with {CONTROLLER}")
    about = artifacts.read_json(folder / CONTROLLER)
    version = about.get("version") if isinstance(about, dict) else None
    if version != VERSION:
        raise ValueError(
            f"{folder / CONTROLLER}: expected a controller of version {VERSION} but found {version}; export "
            "it again"
        )
    arrays = artifacts.read_weights(folder / ARRAYS, "controller")[0]
    text = json.dumps(artifacts.read_json(folder / CERTIFICATE), ensure_ascii=False)
    with artifacts.about(folder / CERTIFICATE):
        certificate = certificates.from_json(text)
    with artifacts.about(folder):
        digest = _digest(folder)
        if digest != certificate.controller_sha256:
            raise ValueError(
                f"the certificate is of a controller with SHA-256 {certificate.controller_sha256} but "
                f"{CONTROLLER} and {ARRAYS} have {digest}; they were changed since, export the controller "
                "again"
            )
        try:
            exported = restored(about, arrays)
        except KeyError as error:
            raise ValueError(f"{error.args[0]} is missing; export the controller again") from None
        check(exported)
        check_certificate(exported, certificate)
    return exported, certificate


def _why_none(folder: Path) -> str:
    """Returns why the stage export_controllers left no controller in its folder, in its own words; "" if it
    gave no reason."""
    stated = folder.parent / EXPORTED
    return artifacts.read_json(stated).get(folder.name, {}).get("why", "") if stated.exists() else ""


def controller_sha256(exported: Exported) -> str:
    """Returns the SHA-256 of controller.json and arrays.safetensors, one after the other, as `write` writes
    them."""
    text, arrays = parts(exported)
    return hashlib.sha256(text.encode() + packed(arrays)).hexdigest()


def packed(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Returns the bytes of arrays.safetensors."""
    return as_bytes(dict(sorted(arrays.items())), {"beadline": "schema=controller"})


def _digest(folder: Path) -> str:
    digest = hashlib.sha256()
    for name in (CONTROLLER, ARRAYS):
        digest.update((folder / name).read_bytes())
    return digest.hexdigest()


def parts(exported: Exported) -> tuple[str, dict[str, np.ndarray]]:
    """Returns the text of controller.json, and the arrays by dotted names."""
    machine, rate = exported.machine, exported.controller.limits.rate
    about = {
        "version": VERSION,
        "name": exported.name,
        "simulated": exported.simulated,
        "sample_time_s": machine.sample_time_s,
        "inputs": [
            _declared(one) | {"rate_percent_per_sample": _number(rate[i])}
            for i, one in enumerate(machine.inputs)
        ],
        "outputs": [_declared(one) for one in machine.outputs],
        "disturbances": [_declared(one) for one in machine.disturbances],
        "integral_limit_degC": float(exported.controller.integral_limit),
        "governor": exported.controller.governor is not None,
        "fallback": exported.fallback is not None,
        "plant_sha256": exported.plant_sha256,
        "spread_sha256": exported.spread_sha256,
    }
    text = json.dumps(about, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    names = ("controller", "model", "fallback", "supervision")
    return text, {k: v for name in names for k, v in _flatten(name, getattr(exported, name)).items()}


def canonical(exported: Exported) -> Exported:
    """Returns the controller with the memory order of its arrays as read from the files, because the rounding
    of matrix products depends on it."""
    text, arrays = parts(exported)
    return restored(json.loads(text), arrays)


def _declared(signal: Signal) -> dict[str, Any]:
    return {
        "name": signal.name,
        "unit": signal.unit,
        "low": _number(signal.low),
        "high": _number(signal.high),
    }


def _number(value: float) -> float | None:
    """Returns null for a limit that is not declared, since JSON has no infinity."""
    return float(value) if np.isfinite(value) else None


def _flatten(place: str, value: Any) -> dict[str, np.ndarray]:
    """Returns arrays and numbers of a record under dotted names; None is left out."""
    if value is None:
        return {}
    if not hasattr(value, "_asdict"):
        return {place: np.ascontiguousarray(value).reshape(np.shape(value))}
    fields = value._asdict().items()
    return {k: v for name, part in fields for k, v in _flatten(f"{place}.{name}", part).items()}
