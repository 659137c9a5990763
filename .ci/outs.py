"""The outs of a dvc.lock against those of an accepted one.

`./run python .ci/outs.py NEW ACCEPTED` names the outs that differ and ends with 1; with --record it writes
ACCEPTED. Only outs are compared: code may change as long as it writes the same bytes. The pages are left out,
as they show the digest of the code.
"""

import sys
from pathlib import Path

from ruamel.yaml import YAML

from pipeline.store import artifacts, params_text

PAGES = "report"
ANEW = "if that is meant, write it anew by .ci/run --record"


def outs(path: Path) -> dict[str, dict[str, str]]:
    """{stage: {out: md5}} of a dvc.lock."""
    stages = YAML(typ="safe").load(path.read_text(encoding="utf-8"))["stages"]
    return {
        stage: {out["path"]: out["md5"] for out in entry["outs"]}
        for stage, entry in sorted(stages.items())
        if entry.get("outs") and stage != PAGES
    }


def differences(accepted: dict[str, dict[str, str]], new: dict[str, dict[str, str]]) -> list[str]:
    """A line for each out that only one of the two has, or whose bytes differ."""
    before = {(stage, path): md5 for stage, paths in accepted.items() for path, md5 in paths.items()}
    after = {(stage, path): md5 for stage, paths in new.items() for path, md5 in paths.items()}
    return [
        f"{stage}: {path}: accepted {before.get((stage, path), 'none')}, "
        f"now {after.get((stage, path), 'none')}"
        for stage, path in sorted(before | after)
        if before.get((stage, path)) != after.get((stage, path))
    ]


def record(path: Path, new: dict[str, dict[str, str]]) -> None:
    """Writes the outs in the form of a dvc.lock."""
    stages = {
        stage: {"outs": [{"path": out, "md5": md5} for out, md5 in paths.items()]}
        for stage, paths in new.items()
    }
    artifacts.write_text(path, params_text.written({"schema": "2.0", "stages": stages}))


def main() -> None:
    new, accepted = outs(Path(sys.argv[1])), Path(sys.argv[2])
    if "--record" in sys.argv:
        record(accepted, new)
        return
    if not accepted.exists():
        sys.exit(f"failed: there is no {accepted.name} to compare with; write it by .ci/run --record")
    problems = differences(outs(accepted), new)
    if problems:
        print("\n".join(problems))
        sys.exit(f"failed: {len(problems)} outs differ from those of .ci/{accepted.name}; {ANEW}")


if __name__ == "__main__":
    main()
