"""`./run beadline COMMAND`: what is not a stage."""

import argparse
import sys
from pathlib import Path

from pipeline import artifacts, params


def accept(_: argparse.Namespace) -> None:
    """Mark the figures of this run as good: later reports show their differences against them."""
    metrics = {path.stem: artifacts.read_json(path) for path in sorted(Path("reports/metrics").glob("*.json")) if path.stem != "report"}
    if not metrics:
        raise ValueError("reports/metrics: expected the figures of a run, found none; run ./run dvc repro first")
    files = sorted(
        path
        for path in Path("datasets").rglob("*")
        if path.is_file() and path.parts[1] not in {"memo"} and not path.parts[1].startswith(".")
    )
    hashes = {path.as_posix(): artifacts.sha256(path) for path in [*files, Path("pipeline"), Path("stages")]}
    artifacts.write_json("reports/accepted.json", {"metrics": metrics, "params": params.read("params.yaml"), "hashes": hashes})
    print(f"reports/accepted.json: accepted {len(metrics)} stages' figures and {len(hashes)} artifacts; commit it to keep it")


def verify(_: argparse.Namespace) -> None:
    """Hold what the pages say they were made from against the files as they are now; what no longer matches is named, with exit status 1."""
    read = artifacts.read_json("reports/metrics/report.json")["read"]
    wrong = []
    for path, recorded in read.items():
        if not Path(path).exists():
            wrong.append(f"{path} is gone")
        elif artifacts.sha256(path) != recorded:
            wrong.append(f"{path} has changed since")
    if wrong:
        raise ValueError(f"reports: {len(wrong)} of {len(read)} sources no longer match the pages: {'; '.join(wrong)}; run ./run dvc repro")
    print(f"reports: all {len(read)} sources are as the pages say")


def inspect(arguments: argparse.Namespace) -> None:
    """What is in a recording: signals, rates, jitter, gaps, ranges, damage; and a mapping to paste into params.yaml."""
    from pipeline.recordings import inspect as describe

    print(describe(arguments.file))


def compose(arguments: argparse.Namespace) -> None:
    """A part program into plunger commands: signal and tasks as CSV, and whether it will print, line by line."""
    from pipeline import composing
    from pipeline.printer import Printer

    if arguments.out.exists() and not arguments.out.is_dir():
        raise ValueError(f"--out {arguments.out}: should be a folder but is a file; name a folder, which is made where it is missing")
    learned = composing.read_learned("datasets/segment_library/library.parquet", "datasets/segment_library/learned.json")
    part = composing.compose(arguments.part, learned, params.load(Printer, "printer"), params.load(composing.ComposeParts, "compose_parts"))
    arguments.out.mkdir(parents=True, exist_ok=True)
    files = composing.write(part, arguments.out)
    print(composing.told(part))
    print("written: " + ", ".join(str(file) for file in files))


def main() -> None:
    parser = argparse.ArgumentParser(prog="beadline", description="Extrusion-printer recordings into controllers that can be trusted.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    commands.add_parser("accept", help=accept.__doc__).set_defaults(run=accept)
    commands.add_parser("verify", help=verify.__doc__).set_defaults(run=verify)
    command = commands.add_parser("inspect", help=inspect.__doc__)
    command.add_argument("file", type=Path)
    command.set_defaults(run=inspect)
    command = commands.add_parser("compose", help=compose.__doc__)
    command.add_argument("part", type=Path, help="the part program (G-code)")
    command.add_argument("--out", type=Path, default=Path("."), help="folder for signal, tasks and report")
    command.set_defaults(run=compose)
    arguments = parser.parse_args()
    try:
        arguments.run(arguments)
    except (ValueError, OSError) as error:
        print(f"beadline: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()
