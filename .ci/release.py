"""Is each file of datasets/papers made of the methods as they stand? A release needs that, `./run pytest`
does not: `./run python .ci/release.py` prints a line a stage and ends with 1 if one is older than its
method."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path.cwd()))

from pipeline.papers import made  # noqa: E402
from pipeline.store import artifacts  # noqa: E402


def main() -> None:
    recorded = artifacts.read_json(made.MADE)
    old = [
        stage
        for stage in made.stages()
        if made.changed(stage) or set(made.names(stage)) != set(recorded[stage]["of"])
    ]
    for stage in made.stages():
        print(f"{'old ' if stage in old else 'ok  '} {stage}: {made.sentence(stage)}")
    sys.exit(1 if old else 0)


if __name__ == "__main__":
    main()
