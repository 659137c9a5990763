"""Exports a controller as one Python file that needs numpy only.

The file holds verbatim the two modules that the stages run: controllers/law.py and supervise.py. After them
come the text of controller.json, the arrays, and `controller(...)`, which returns the object. It refuses
another plant, unit or sample time. A controller made for a simulated plant runs only with rehearsal=True.
"""

import base64
from pathlib import Path

from pipeline.deploy import supervise
from pipeline.deploy.certificate import Certificate, sha256
from pipeline.deploy.machine import check, check_certificate, packed, parts
from pipeline.deploy.supervise import Exported
from pipeline.temperature.controllers import law

TEMPLATE = Path(__file__).with_name("templates") / "controller.py.txt"
MARK = "# ---- exported to the letter from here on\n"  # in both modules, after their imports
LINE = 100


def text(exported: Exported, certificate: Certificate) -> str:
    """Returns the file. Raises ValueError if the certificate was not passed, or belongs to another
    controller."""
    check(exported)
    check_certificate(exported, certificate)
    return code(exported, sha256(certificate))


def code(exported: Exported, certificate_sha256: str) -> str:
    """Returns the file, whatever its certificate says."""
    machine, (about, arrays) = exported.machine, parts(exported)
    coded = base64.b64encode(packed(arrays)).decode()
    values = {
        "contestant": exported.name,
        "sample_time": f"{machine.sample_time_s:g}",
        "signals": "".join(
            f"    {kind} {one.name}, {one.unit}, {one.low:g} to {one.high:g}\n"
            for kind, signals in (("input", machine.inputs), ("output", machine.outputs))
            for one in signals
        ),
        "certificate": certificate_sha256,
        "law": exported_part(law),
        "supervise": exported_part(supervise),
        "about": "\n".join(f"    {line!r}" for line in about.splitlines()),
        "arrays": "\n".join(f'    "{coded[at : at + LINE]}"' for at in range(0, len(coded), LINE)),
    }
    made = TEMPLATE.read_text(encoding="utf-8")
    for name, value in values.items():
        made = made.replace(f"@{name}@", value)
    return made


def exported_part(module: object) -> str:
    """Returns the text of a module after MARK."""
    return Path(str(vars(module)["__file__"])).read_text(encoding="utf-8").partition(MARK)[2]
