"""`beadline inspect --json`: a recording as JSON."""

import json
from pathlib import Path

from pipeline.recordings.inspection import look
from pipeline.recordings.proposals import propose, yaml_lines


def as_json(path: str | Path) -> str:
    """The recording's format, signals with unit and range, findings, and the lines to paste into params.yaml.
    Raises ValueError if nothing can be read."""
    looked = look(Path(path))
    proposal = propose(looked.signals, looked.groups, looked.time) if looked.signals else None
    signals = [
        {
            "source": signal.source,
            "unit": signal.unit,
            "numbers": len(signal.values),
            "least": float(signal.values.min()) if len(signal.values) else None,
            "largest": float(signal.values.max()) if len(signal.values) else None,
        }
        for signal in looked.signals
    ]
    findings = [{"kind": note.kind, "message": note.message} for note in looked.notes]
    proposed = yaml_lines(proposal) if proposal else []
    return json.dumps(
        {
            "file": str(path),
            "format": looked.kind,
            "signals": signals,
            "findings": findings,
            "proposed_yaml": "\n".join(proposed),
        }
    )
