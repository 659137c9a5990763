"""The licences of what the lock installs, as docs/licences.md.

`./run python .ci/licences.py --record` writes the page from the packages' own metadata; without `--record` it
says in which lines the page differs, and ends with 1. Packages that only other machines, a GPU, a cluster,
the documents or the peers of speed need are named without a licence: they are not installed here.
"""

import importlib.metadata
import sys
import tomllib
from pathlib import Path
from typing import NamedTuple

from packaging.markers import Marker

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs/licences.md"
HOME, GROUP = "beadline", "dev"
# what a classifier says in many words
SHORT = {
    "Apache Software License": "Apache-2.0", "BSD License": "BSD", "MIT License": "MIT",
    "ISC License (ISCL)": "ISC", "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "Python Software Foundation License": "PSF-2.0", "The Unlicense (Unlicense)": "Unlicense",
    "Apache 2.0": "Apache-2.0", "Apache License, Version 2.0": "Apache-2.0",
    "Apache License 2.0": "Apache-2.0", "Apache-2": "Apache-2.0", "Apache 2": "Apache-2.0",
    "Modified BSD License": "BSD-3-Clause",
}  # fmt: skip
UNKNOWN = "not said in its metadata"


class Package(NamedTuple):
    """One of the lock: whether the default environment has it, and its licence there."""

    name: str
    version: str
    licence: str | None


def locked(text: str) -> list[Package]:
    """Every package of uv.lock's text, with licences of those that `./run` installs here."""
    packages = tomllib.loads(text)["package"]
    of = {package["name"]: package for package in packages}
    home = of[HOME]
    waiting = [*home["dependencies"], *home["dev-dependencies"][GROUP]]
    installed: set[str] = set()
    while waiting:
        wanted = waiting.pop()
        if "marker" in wanted and not Marker(wanted["marker"]).evaluate():
            continue
        package = of[wanted["name"]]
        extras = [
            package.get("optional-dependencies", {}).get(extra, []) for extra in wanted.get("extra", [])
        ]
        waiting += [inner for extra in extras for inner in extra]
        if package["name"] not in installed:
            installed.add(package["name"])
            waiting += package.get("dependencies", [])
    return [
        Package(one["name"], one["version"], licence(one["name"]) if one["name"] in installed else None)
        for one in packages
        if one["name"] != HOME
    ]


def licence(name: str) -> str:
    """As the package's metadata says it: the expression, else the classifiers, else the first short line.

    Raises ValueError for a package that is not installed.
    """
    try:
        about = importlib.metadata.metadata(name)
    except importlib.metadata.PackageNotFoundError:
        raise ValueError(
            f"uv.lock: {name} is not in the environment, which should follow the lock; run ./run true"
        ) from None
    if expression := about.get("License-Expression"):
        return expression
    named = [
        line.rsplit(" :: ", 1)[1]
        for line in about.get_all("Classifier") or []
        if line.startswith("License :: ") and not line.endswith("OSI Approved")
    ]
    if named:
        return ", ".join(sorted({SHORT.get(one, one) for one in named}))
    first = (about.get("License") or "").strip().split("\n")[0].strip()
    return SHORT.get(first, first) if 0 < len(first) <= 60 else UNKNOWN


def page(packages: list[Package]) -> str:
    """The page: packages by name, and behind them those that are not installed."""
    here = [one for one in packages if one.licence is not None]
    apart = [one for one in packages if one.licence is None]
    lines = [
        "# Licences of the packages",
        "",
        f"Written by `./run python .ci/licences.py --record` from uv.lock and the packages' metadata: "
        f"{len(here)} that `./run` installs, and for `./run pytest` the group dev.",
        "",
        "To be read by whoever passes them on (GPL, EPL, MPL, or not said): "
        + "; ".join(f"{one.name} ({one.licence})" for one in here if _asks(one.licence or ""))
        + ".",
        "",
        "| package | version | licence |",
        "|---|---|---|",
        *(f"| {one.name} | {one.version} | {(one.licence or '').replace('|', '/')} |" for one in here),
        "",
        f"Locked but not installed by `./run` ({len(apart)}; a GPU, a cluster, S3, documents, peers, "
        "other systems): " + ", ".join(f"{one.name} {one.version}" for one in apart) + ".",
        "",
    ]
    return "\n".join(lines)


def _asks(licence: str) -> bool:
    """Whether a licence asks more than its text to be passed on, or is not known."""
    return licence == UNKNOWN or any(word in licence for word in ("GPL", "General Public", "EPL", "MPL"))


def differences(before: str, now: str) -> list[str]:
    """Lines that only one of two pages has."""
    old, new = before.splitlines(), now.splitlines()
    return [f"- {line}" for line in old if line not in new] + [f"+ {line}" for line in new if line not in old]


def main() -> None:
    now = page(locked((ROOT / "uv.lock").read_text()))
    if "--record" in sys.argv:
        PAGE.write_text(now)
        return
    found = differences(PAGE.read_text() if PAGE.exists() else "", now)
    if found:
        print("\n".join(found))
        sys.exit(
            "docs/licences.md does not follow uv.lock; write it by ./run python .ci/licences.py --record, "
            "and read what is new"
        )


if __name__ == "__main__":
    main()
