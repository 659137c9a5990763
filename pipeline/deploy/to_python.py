"""A controller as one Python file that needs numpy only.

The file is made of the project's own definitions (sources.py) and of the controller's arrays. What has no
place beside a machine (design, moving references, scipy) is not in it. `controller(...)` in that file gives
the object, and refuses another plant, unit or sample time; a simulated one runs only as a rehearsal.
"""

import base64
from typing import Any, NamedTuple

import numpy as np

from pipeline.deploy import standalone
from pipeline.deploy.certificate import Certificate, sha256
from pipeline.deploy.machine import Exported, check, check_certificate
from pipeline.deploy.sources import LIBRARIES, Place, gathered

HOME = standalone.__name__
ENTRIES: list[Place] = [("pipeline.deploy.supervised", "Supervised")]
REPLACED: dict[Place, Place] = {
    ("pipeline.temperature.controllers.controller", "_triangular"): (HOME, "_triangular")
}
ORDER = [
    "pipeline.temperature.plant",
    "pipeline.temperature.tracking",
    HOME,
    "pipeline.temperature.controllers.governor",
    "pipeline.temperature.controllers.controller",
    "pipeline.deploy.supervisor",
    "pipeline.deploy.supervised",
    "pipeline.deploy.signals",
    "pipeline.deploy.machine",
]
LINE = 100


class Stored(NamedTuple):
    """Arrays one after the other as little-endian bytes, and the expression that rebuilds each."""

    parts: list[bytes]
    types: set[type]

    def expression(self, value: Any, indent: str) -> str:
        """Python text that rebuilds `value`: records, arrays, numbers, text."""
        deeper = indent + "    "
        if isinstance(value, tuple) and hasattr(value, "_asdict"):
            self.types.add(type(value))
            fields = "".join(
                f"{deeper}{name}={self.expression(part, deeper)},\n" for name, part in value._asdict().items()
            )
            return f"{type(value).__name__}(\n{fields}{indent})"
        if isinstance(value, tuple):
            return "(" + "".join(f"{self.expression(part, deeper)}, " for part in value).rstrip() + ")"
        if isinstance(value, np.ndarray):
            return self.array(value)
        if isinstance(value, np.generic):
            value = value.item()
        if isinstance(value, float) and not np.isfinite(value):
            return f'float("{value}")'
        if value is None or isinstance(value, bool | int | float | str):
            return repr(value)
        raise ValueError(f"an exported file holds records, arrays, numbers and text but found {type(value)}")

    def array(self, value: np.ndarray) -> str:
        """In the order in which it lies in memory: products of matrices round by that."""
        kind = {"f": "<f8", "i": "<i8", "u": "<i8", "b": "|b1"}[value.dtype.kind]
        start = sum(map(len, self.parts))
        axes = np.argsort([-stride for stride in value.strides], kind="stable")
        lying = value.transpose(axes)
        self.parts.append(np.ascontiguousarray(lying, kind).tobytes())
        turned = (
            "" if np.array_equal(axes, range(value.ndim)) else f".transpose{tuple(np.argsort(axes).tolist())}"
        )
        return f"_array({start}, {tuple(lying.shape)}, {kind!r}){turned}"


def text(exported: Exported, certificate: Certificate) -> str:
    """The file. Raises ValueError where the certificate was not passed, or is of another controller."""
    check(exported)
    check_certificate(exported, certificate)
    return code(exported, sha256(certificate))


def code(exported: Exported, certificate_sha256: str) -> str:
    """The file, whatever its certificate says."""
    stored = Stored([], set())
    rebuilt = stored.expression(exported, "")
    entries = ENTRIES + sorted((kind.__module__, kind.__name__) for kind in stored.types)
    definitions = gathered(entries, REPLACED, ORDER)
    return "\n".join(
        [
            _head(exported, certificate_sha256),
            "# ---- the project's own definitions\n\n",
            definitions + "\n\n",
            "# ---- this controller\n\n",
            _arrays(b"".join(stored.parts)),
            f"EXPORTED = {rebuilt}\n",
            _TAIL,
        ]
    )


def _head(exported: Exported, certificate_sha256: str) -> str:
    machine = exported.machine
    names = "".join(
        f"    {kind} {one.name}, {one.unit}, {one.low:g} to {one.high:g}\n"
        for kind, signals in (("input", machine.inputs), ("output", machine.outputs))
        for one in signals
    )
    imports = "\n".join(dict.fromkeys(line for line in LIBRARIES.values() if "numpy" not in line))
    return (
        f'"""Controller {exported.name} of one machine, sampled every {machine.sample_time_s:g} s:\n\n'
        f"{names}\nGenerated; do not edit. Needs numpy. `controller(...)` gives the object: in manual "
        "`watch` each sample,\n"
        'then `hand_over` once, then `step` each sample.\n"""\n\n'
        "from __future__ import annotations\n\nimport base64\n"
        f"{imports}\n\nimport numpy as np\n\n"
        f'CERTIFICATE_SHA256 = "{certificate_sha256}"\n'
        f'PLANT_SHA256 = "{exported.plant_sha256}"\n'
        f'SPREAD_SHA256 = "{exported.spread_sha256}"\n'
        f"SIMULATED = {exported.simulated}\n"
        f"SAMPLE_TIME_S = {machine.sample_time_s!r}\n"
        f'INPUT_UNIT, OUTPUT_UNIT = "{machine.inputs[0].unit}", "{machine.outputs[0].unit}"\n\n'
    )


def _arrays(data: bytes) -> str:
    coded = base64.b64encode(data).decode()
    lines = "\n".join(f'    "{coded[at : at + LINE]}"' for at in range(0, len(coded), LINE))
    return (
        f"_BYTES = base64.b64decode(\n{lines}\n)\n\n\n"
        "def _array(start, shape, kind):\n"
        '    """One array of the controller."""\n'
        "    count = int(np.prod(shape))\n"
        "    return np.frombuffer(_BYTES, kind, count, start).reshape(shape).copy()\n\n\n"
    )


_TAIL = '''
def controller(*, plant_sha256, sample_time_s, input_unit, output_unit, rehearsal=False):
    """The controller, for the machine it is certified for. Raises ValueError for another one, and for a
    simulated one outside a rehearsal."""
    for what, expected, found in (
        ("plant", PLANT_SHA256, plant_sha256),
        ("sample time in s", SAMPLE_TIME_S, sample_time_s),
        ("unit of inputs", INPUT_UNIT, input_unit),
        ("unit of outputs", OUTPUT_UNIT, output_unit),
    ):
        if found != expected:
            raise ValueError(
                f"controller {EXPORTED.name}: its certificate is of another {what}: expected {expected}, "
                f"found {found}; certify a controller for this machine"
            )
    return Supervised(EXPORTED, rehearsal=rehearsal)
'''
