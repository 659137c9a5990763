"""How many branches of the methods their tests take.

`./run --group peers python -m benchmarks.branches` runs the tests of the four folders of `METHODS` under
coverage, each folder as a process of its own and two at a time, and writes benchmarks/results/branches.json:
branches and those taken by module, and the lines from which an arrow (12->15: from line 12 to 15) was never
followed. Methods are the modules of these folders themselves; what reads files and parameters for them
(`workflow/`) is not counted. `--tests tests/runtime` runs fewer tests, and prints only. Left out are tests
that starve a process they start of disk or rights: coverage's own notes would be what fails there.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from pipeline.store import artifacts

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks/results/branches.json"
STARVED = "on_a_machine_that_runs_out"
METHODS = ("temperature", "deposition", "setpoint", "runtime")
CONFIG = """[run]
branch = true
parallel = true
data_file = {folder}/taken
source = {source}
omit = */workflow/*
sigterm = true
disable_warnings = no-data-collected,module-not-measured,module-not-imported
"""


def measured(tests: list[str]) -> tuple[dict[str, Any], int]:
    """What coverage says of these tests, as JSON, and the worst status of those that ran them."""
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "coverage.ini"
        source = ",".join(str(ROOT / "pipeline" / name) for name in METHODS)
        config.write_text(CONFIG.format(folder=folder, source=source))
        told, rc = Path(folder) / "told.json", f"--rcfile={config}"
        under = [sys.executable, "-m", "coverage"]

        def tested(one: str) -> int:
            # no workers: what one of them had taken was once lost with its end
            asked = ["pytest", "-n", "0", "-k", f"not {STARVED}", one]
            return subprocess.run([*under, "run", rc, "-m", *asked], cwd=ROOT).returncode

        with ThreadPoolExecutor(2) as pool:
            ended = max(map(abs, pool.map(tested, tests)))
        for step in (["combine", "-q", rc], ["json", "-q", rc, "-o", str(told)]):
            subprocess.run([*under, *step], cwd=ROOT, check=True)
        return json.loads(told.read_text()), ended


def table(told: Mapping[str, Any]) -> dict[str, Any]:
    """Branches, those taken, and the arrows not followed, by module and in all; modules without a branch are
    left out."""
    modules = {}
    for path, one in sorted(told["files"].items()):
        of = one["summary"]
        if of["num_branches"]:
            modules[path.removeprefix("pipeline/").removesuffix(".py")] = {
                "branches": of["num_branches"],
                "taken": of["covered_branches"],
                "not_taken": [f"{a}->{b}" if b > 0 else f"{a}->end" for a, b in one["missing_branches"]],
            }
    branches, taken = (sum(one[name] for one in modules.values()) for name in ("branches", "taken"))
    return {
        "branches": branches,
        "taken": taken,
        "share_taken": round(taken / max(branches, 1), 4),
        "modules": modules,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--tests", nargs="*", metavar="PATH")
    asked = parser.parse_args()
    told, ended = measured(asked.tests or [f"tests/{name}" for name in METHODS])
    result = table(told)
    for name, one in sorted(
        result["modules"].items(), key=lambda item: item[1]["taken"] - item[1]["branches"]
    ):
        print(f"{name:45} {one['taken']:4} of {one['branches']:4}  {' '.join(one['not_taken'][:12])}")
    print(f"{result['taken']} of {result['branches']} branches: {100 * result['share_taken']:.1f} %")
    if ended:
        sys.exit(f"the tests ended with {ended}: nothing is written; mend them first")
    if not asked.tests:
        artifacts.write_json(RESULTS, result)


if __name__ == "__main__":
    main()
