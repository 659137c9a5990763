"""What leaves the house, a line a loop: the file, its certificate and its hash, from the metrics of
export_controllers."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.report.shared.sources import LARGEST_COPY, Sources
from pipeline.verdict.controllers import BY_NAME, in_a_sentence
from pipeline.verdict.digits import count
from pipeline.verdict.evidence import gap_of, known, lookup, need, or_gap
from pipeline.verdict.verdict import FAILED, OPEN, PASSED, Missing, Verdict

STAGE, LOOPS = "export_controllers", ("temperature", "deposition", "setpoint")
FOLDER = "datasets/export_controllers"
SIMULATED, MAY_RUN = "Certificate passed (simulation).", "May run."
NOT_READY = "Certificate passed, not ready."
REFUSED, NONE = "Certificate refused.", "No certificate."


@or_gap
def lines(sources: Sources, verdict: Verdict) -> list[dict[str, str]] | Missing:
    """A row a loop, or why there are none: whether a certificate passed, in words; the controller, the folder
    or the file to load with its SHA-256, how many files there are, the certificate's SHA-256, and why there
    is no more. A certificate says no more than the temperature loop's `verdict` on page one: it may run where
    that is passed, for this controller."""
    metrics = need(sources.metrics.get(STAGE) or Missing(OPEN, f"{STAGE} has not run"))
    return [_line(loop, metrics, verdict) for loop in LOOPS]


def _line(loop: str, metrics: Mapping[str, Any], verdict: Verdict) -> dict[str, str]:
    line = dict.fromkeys(("name", "file", "sha256", "files", "certificate", "why"), "")
    line |= {"loop": loop, "state": OPEN, "word": NONE}
    fields = lookup(metrics, loop, what=f"{loop} loop")
    if gap := gap_of(fields):
        return line | {"why": gap.sentence()}
    shown, files = fields.get("certificate"), dict(fields.get("files") or {})
    first = next(iter(files), "")
    main = next((path for path in files if path.endswith("controller.json")), first)
    name = str(fields.get("contestant") or "")
    line["why"] = str(fields.get("why") or "")
    if isinstance(shown, Mapping):
        passed, simulated = shown.get("verdict") == "passed", shown.get("evidence") == "simulated"
        line["state"] = PASSED if passed else FAILED
        line["word"] = REFUSED if not passed else SIMULATED if simulated else MAY_RUN
        line["certificate"] = str(shown.get("sha256") or "")
    if line["word"] == MAY_RUN and not (verdict.state == PASSED and verdict.winner == name):
        why = f"Page one says: {verdict.decision} {verdict.lead}".strip()
        line |= {"state": OPEN, "word": NOT_READY, "why": why}
    return line | {
        "name": in_a_sentence(name) if name in BY_NAME else name,
        "file": main if main.startswith("datasets/") or not main else f"{FOLDER}/{main}",
        "sha256": files.get(main, ""),
        "files": count(len(files), "file") if files else "",
    }


def link(sources: Sources, line: Mapping[str, str]) -> str:
    """Where a page finds the file: the copy of it in reports/data; "" where it is not there, or too large."""
    source = sources.read.get(line["file"])
    if source is not None:
        return source.link if source.link.startswith("data/") else ""
    path = Path(line["file"])
    small = bool(line["file"]) and path.is_file() and path.stat().st_size <= LARGEST_COPY
    return f"data/{line['loop']}.{path.name}" if small else ""


def copies(sources: Sources, lines: Sequence[Mapping[str, str]] | Missing) -> dict[str, bytes]:
    """Name in reports/data -> bytes of each file to load that `link` leads to."""
    found = {link(sources, line): line["file"] for line in known(lines, [])}
    return {place.removeprefix("data/"): Path(path).read_bytes() for place, path in found.items() if place}
