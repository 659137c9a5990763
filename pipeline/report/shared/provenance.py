"""What the pages say they were made from, held against the files as they are now and against dvc.lock."""

import hashlib
import html
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from pipeline.report.shared.sources import NIGHTLY, digest
from pipeline.store import artifacts, params

# what .dvcignore leaves out of every folder
IGNORED = {"__pycache__", ".venv", ".uv"}


class Check(NamedTuple):
    """What was held against what: how many things, and a sentence for each that does not match."""

    what: str
    count: int
    wrong: list[str]


def checks(report: str = "reports/metrics/report.json", lock: str = "dvc.lock") -> list[Check]:
    """Sources, parameters and code, the pages and their references, and dvc.lock. Raises ValueError where the
    report's metrics are missing or were written by an older version.
    """
    recorded = artifacts.read_json(report)
    if not {"read", "pages", "parameters", "code"} <= recorded.keys():
        raise ValueError(
            f"{report}: it does not say what the pages were made from; run ./run dvc repro report"
        )
    # the night that made these pages has written its own figures since
    files = [
        sentence
        for path, sha256 in recorded["read"].items()
        if path != NIGHTLY and (sentence := _held(path, sha256))
    ]
    written = {f"reports/{name}.html": sha256 for name, sha256 in recorded["pages"].items()}
    pages = [sentence for path, sha256 in written.items() if (sentence := _held(path, sha256))]
    return [
        Check("sources of the pages", len(recorded["read"]), files),
        Check("digests of parameters and code", 2, list(_settings(recorded))),
        Check("pages", len(written), pages),
        _references(written, recorded["read"]),
        _lock(Path(lock), recorded["read"]),
    ]


def _held(path: str, recorded: str) -> str:
    if not Path(path).exists():
        return f"{path} is gone"
    return "" if artifacts.sha256(path) == recorded else f"{path} has changed since"


def _settings(recorded: Mapping[str, Any]) -> Iterator[str]:
    if digest(params.read()) != recorded["parameters"]:
        yield f"{' or '.join(params.files())} has changed since"
    if digest({folder: artifacts.sha256(folder) for folder in ("pipeline", "stages")}) != recorded["code"]:
        yield "the code (pipeline, stages) has changed since"


def _references(pages: Mapping[str, str], read: Mapping[str, str]) -> Check:
    """Every link below a figure or a table leads to the bytes that were read: its title names the artifact
    and its hash. provenance.html has a row for each, with the whole hash."""
    link = re.compile(r'<a class="from" href="([^"]+)" title="([^"]+), SHA-256 ([0-9a-f]{8})">')
    row = re.compile(
        r'<tr id="from-[^"]+"><td><a class="from" href="([^"]+)"><code>([^<]+)</code></a></td>'
        r"<td>[^<]+</td><td>[^<]+</td><td><code>([0-9a-f]{64})</code></td></tr>"
    )
    # what is too large to lie beside the pages has its row without a link
    named = re.compile(
        r'<tr id="from-[^"]+"><td><span class="outside"><code>([^<]+)</code> of the project</span></td>'
        r"<td>[^<]+</td><td>[^<]+</td><td><code>([0-9a-f]{64})</code></td></tr>"
    )
    count, wrong, held = 0, [], {}
    for page in pages:
        text = Path(page).read_text(encoding="utf-8") if Path(page).exists() else ""
        unlinked = [("", *pair) for pair in named.findall(text)]
        for href, path, digits in link.findall(text) + row.findall(text) + unlinked:
            path, count = html.unescape(path), count + 1
            if not read.get(path, "").startswith(digits):
                wrong.append(f"{page} gives another hash of {path} than was read")
            if not href:
                continue
            place = (Path(page).parent / html.unescape(href)).as_posix()
            if place not in held:
                held[place] = artifacts.sha256(place) if Path(place).exists() else ""
            # the night that made these pages has written its own figures since
            if path != NIGHTLY and held[place] != read.get(path):
                wrong.append(f"{page} leads to {place}, which is not {path} as it was read")
    return Check("references of figures and tables", count, wrong)


# ---- dvc.lock


def _lock(path: Path, read: Mapping[str, str]) -> Check:
    """What every stage wrote, and what the report stage read, by the MD5 that DVC
    recorded; a source that no stage wrote is said so."""
    if not path.exists():
        return Check(
            "entries of dvc.lock", 0, [f"{path} is missing: nothing says which run the files are of"]
        )
    stages = (yaml.safe_load(path.read_text(encoding="utf-8")) or {}).get("stages", {})
    entries = [(entry, name) for name, stage in stages.items() for entry in stage.get("outs", [])]
    entries += [
        (entry, "report")
        for entry in stages.get("report", {}).get("deps", [])
        if entry["path"] not in {e["path"] for e, _ in entries}
    ]
    wrong = []
    for entry, stage in entries:
        place = Path(entry["path"])
        if not place.exists():
            wrong.append(f"{place} of {stage} is gone")
        elif "md5" in entry and md5(place) != entry["md5"]:
            wrong.append(f"{place} is not what dvc.lock has of {stage}")
    locked = [entry["path"] for entry, _ in entries]
    wrong += [
        f"{source} is in no entry of dvc.lock"
        for source in read
        if source != NIGHTLY and not any(f"{source}/".startswith(f"{path}/") for path in locked)
    ]
    return Check("entries of dvc.lock", len(entries), wrong)


def md5(path: Path) -> str:
    """As DVC 3 has it: of a file its bytes', of a folder the MD5 of the JSON list of its files' MD5s and
    relative names, with .dir behind."""
    if not path.is_dir():
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "md5").hexdigest()
    files = [
        file
        for file in path.rglob("*")
        if file.is_file() and not IGNORED & set(file.parts) and file.suffix != ".pyc"
    ]
    listed = sorted(
        ({"md5": md5(file), "relpath": file.relative_to(path).as_posix()} for file in files),
        key=lambda entry: entry["relpath"],
    )
    return hashlib.md5(json.dumps(listed, sort_keys=True).encode()).hexdigest() + ".dir"


def summary(checks: list[Check]) -> str:
    """One line for each check that held. Raises ValueError naming all that did not."""
    wrong = [sentence for check in checks for sentence in dict.fromkeys(check.wrong)]
    if wrong:
        raise ValueError(
            f"reports: {len(wrong)} of {sum(check.count for check in checks)} no longer match: "
            f"{'; '.join(wrong)}; run ./run dvc repro"
        )
    return "\n".join(f"{check.count:>5} {check.what}: all match" for check in checks)
