"""`./run --group peers python -m benchmarks` runs the eight benchmarks, each in a process of its own, an hour
and more on two idle cores; `... benchmarks gcode ilc` runs these. Each writes its part of
benchmarks/results.json and docs/reference/benchmarks.md. `--render` runs nothing and writes the page. Exit
status 1 if one failed."""

import subprocess
import sys

from benchmarks import results


def main() -> None:
    if sys.argv[1:] == ["--render"]:
        results.put_in_page()
        return
    names = sys.argv[1:] or list(results.TITLES)
    if unknown := [name for name in names if name not in results.TITLES]:
        sys.exit(f"benchmarks: {unknown[0]} is no benchmark; choose among {', '.join(results.TITLES)}")
    commands = {name: [sys.executable, "-m", f"benchmarks.{name}"] for name in names}
    failed = [
        name for name, command in commands.items() if subprocess.run(command, cwd=results.ROOT).returncode
    ]
    sys.exit(f"benchmarks: failed: {', '.join(failed)}" if failed else 0)


if __name__ == "__main__":
    main()
