"""beadline: recordings of an extrusion printer into controllers, loop by loop."""

import importlib
from collections.abc import Callable, Mapping
from typing import Any


def import_when_used(package: str, places: Mapping[str, str]) -> Callable[[str], Any]:
    """The `__getattr__` of a package whose public names stand in other modules.

    `places` has for each public name "module:name" below `package`. The module is imported when its name is
    used first, so that `import package` loads no method. Raises AttributeError for any other name.
    """

    def attribute(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, _, inner = places[name].partition(":")
        return getattr(importlib.import_module(f"{package}.{module}"), inner)

    return attribute
