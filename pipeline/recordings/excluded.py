"""Lists recordings that stay in their folder but that no stage reads: excluded.yaml in their loop's folder.

Files that git or DVC keeps must not be moved: a clone has them again, and a commit would delete them for
everybody. A nightly run that excludes a recording therefore lists it. The list is in the folder of the
recordings. The stages depend on it as on them, and it is committed with them, so every clone leaves out the
same files. An entry counts only while the recording has the content that was refused. A recording that was
repaired is read again.
"""

from collections.abc import Iterable
from pathlib import Path

import yaml

from pipeline.store import artifacts

FILE = "excluded.yaml"
HEAD = """\
# Recordings that stay where they lie though no stage reads them: path below this folder, digest, and why.
# An entry counts while the recording has this content. Mend the recording, or take its lines out.
"""


# "sha256" of the recording that was refused, and the "reason"

Exclusion = dict[str, str]


def read_list(folder: str | Path) -> dict[str, Exclusion]:
    """Returns {path below the folder: exclusion}; empty if there is no list. Raises ValueError if the list
    cannot be read."""
    path = Path(folder) / FILE
    try:
        return parse(path.read_text(encoding="utf-8")) if path.is_file() else {}
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def parse(text: str) -> dict[str, Exclusion]:
    """Returns the entries of a list. Raises ValueError if the text is not such a list."""
    try:
        entries = yaml.safe_load(text) or {}
        return {str(name): {key: str(e[key]) for key in ("sha256", "reason")} for name, e in entries.items()}
    except (yaml.YAMLError, AttributeError, KeyError, TypeError) as error:
        raise ValueError(
            "expected paths, each with sha256 and reason, found something else "
            f"({' '.join(str(error).split())[:200]}); mend the list, or take it away: the next night looks "
            "at its recordings again"
        ) from None


def write(folder: str | Path, entries: dict[str, Exclusion]) -> None:
    """Writes the list, in the order of the paths."""
    ordered = {name: entries[name] for name in sorted(entries)}
    text = yaml.safe_dump(ordered, sort_keys=False, allow_unicode=True, width=1000)
    artifacts.write_text(Path(folder) / FILE, HEAD + text)


def exclude(path: str | Path, folder: str | Path, reason: str) -> None:
    """Adds a recording below `folder`, a file or the folder of a bag, with its present content to the
    list."""
    name = Path(path).relative_to(folder).as_posix()
    write(folder, read_list(folder) | {name: {"sha256": artifacts.sha256(path), "reason": reason}})


def exclusions(folder: str | Path) -> frozenset[Path]:
    """Returns the recordings below `folder` that are listed and still have the content that was refused."""
    folder = Path(folder)
    return frozenset(
        folder / name
        for name, entry in read_list(folder).items()
        if (folder / name).exists() and artifacts.sha256(folder / name) == entry["sha256"]
    )


def readable(paths: Iterable[Path], folder: str | Path) -> list[Path]:
    """Returns those of `paths`, files or bags below `folder`, that are not excluded, in their order."""
    left_out = exclusions(folder)
    return [path for path in paths if path not in left_out and not left_out.intersection(path.parents)]
