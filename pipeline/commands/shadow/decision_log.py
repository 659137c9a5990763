"""Decisions of a watch as MCAP: JSON messages with a schema, one a window, in files that are whole at any
time."""

import json
import re
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from pipeline.store.artifacts import beside

TOPIC = "/decision"
# a file is closed after so many decisions, and until then written over at most every so many seconds
MOST, EVERY_S = 300, 5.0
_NUMBER, _TEXT, _TRUTH, _WHOLE = (
    {"type": ["number", "null"]}, {"type": "string"}, {"type": "boolean"}, {"type": "integer"},
)  # fmt: skip
# name -> (type, unit, meaning); numbers that are not known are null
FIELDS: dict[str, tuple[dict, str, str]] = {
    "decision": (_WHOLE, "1", "number of the window, from 1"),
    "time_s": (_NUMBER, "s", "of the window's last frame, since the first frame of the watch"),
    "reason": (_TEXT, "1", "why it would hold; 'acts' if it would not"),
    "would": (_TEXT, "1", "what it would have sent; nothing was sent"),
    "why": (_TEXT, "1", "the decision in one line"),
    "flow_setpoint_percent": (_NUMBER, "percent", "as the source or the command line says"),
    "target_degC": (_NUMBER, "degC", "as the source or the command line says"),
    "would_flow_move_percent": (_NUMBER, "percent", "change of the flow setpoint, within the limits"),
    "would_temperature_move_degC": (_NUMBER, "degC", "change of the target, within the limits"),
    "p_under": (_NUMBER, "1", "share of under-extruded"),
    "p_good": (_NUMBER, "1", "share of good"),
    "p_over": (_NUMBER, "1", "share of over-extruded"),
    "flow_seen_percent": (_NUMBER, "percent", "flow that the window shows, if the classifier gives one"),
    "spread": (_NUMBER, "1", "its relative standard deviation"),
    "belief_flow_percent": (_NUMBER, "percent", "median of the controller's belief"),
    "belief_low_percent": (_NUMBER, "percent", "5 % of the belief lie below"),
    "belief_high_percent": (_NUMBER, "percent", "5 % of the belief lie above"),
    "distance": (_NUMBER, "1", "median out-of-distribution score of the frames"),
    "valid": (_WHOLE, "1", "frames with a key area"),
    "used": (_WHOLE, "1", "frames that count"),
    "notes": ({"type": "array", "items": _TEXT}, "1", "what befell the source since the decision before"),
    "frames": (
        {"type": "array", "items": {"type": "object", "properties": {
            "name": _TEXT, "time_s": _NUMBER, "valid": _TRUTH, "reason": _TEXT, "score": _NUMBER,
            "angle_deg": _NUMBER,
        }}},
        "1", "the window's frames: name in the source, time, and why one has no key area",
    ),
}  # fmt: skip


def write_decisions(path: Path, rows: list[tuple[int, Mapping[str, Any]]], about: Mapping[str, str]) -> None:
    """One whole MCAP file of rows (log time in ns, {field of FIELDS: value}); `about` is its metadata.

    Raises OSError, one sentence, if it cannot be written: the file before stays.
    """
    properties = {
        name: kind | {"unit": unit, "description": meaning} for name, (kind, unit, meaning) in FIELDS.items()
    }
    schema = {"title": "beadline.shadow_decision", "type": "object", "properties": properties}
    with beside(path) as temporary:
        # by its name: only artifacts opens a file to write
        writer = Writer(str(temporary), compression=CompressionType.ZSTD, enable_data_crcs=True)
        writer.start(profile="", library="beadline")
        writer.add_metadata("beadline_shadow", dict(about))
        number = writer.register_schema(schema["title"], "jsonschema", json.dumps(schema).encode())
        channel = writer.register_channel(TOPIC, "json", number, {"schema_version": "1"})
        for sequence, (log_time, row) in enumerate(rows):
            data = json.dumps(row, ensure_ascii=False, allow_nan=False).encode()
            writer.add_message(channel, log_time, data, log_time, sequence)
        writer.finish()


class DecisionLog:
    """Files decisions-0000.mcap, decisions-0001.mcap, ... of a folder, numbered on from those that are
    there. What could not be written, as on a full disk, is kept and tried again; `trouble` says why.
    `written` are its files."""

    def __init__(self, folder: Path, about: Mapping[str, str]) -> None:
        self.folder, self.about = folder, about
        self.rows: list[tuple[int, Mapping[str, Any]]] = []
        self.saved, self.saved_at, self.trouble = 0, -EVERY_S, ""
        self.written: list[Path] = []
        names = [path.name for path in folder.glob("decisions-*.mcap")] if folder.is_dir() else []
        numbers = [int(found[1]) for name in names if (found := re.fullmatch(r"decisions-(\d+)\.mcap", name))]
        self.number = max(numbers, default=-1) + 1

    @property
    def path(self) -> Path:
        return self.folder / f"decisions-{self.number:04d}.mcap"

    def add(self, log_time: int, row: Mapping[str, Any]) -> None:
        self.rows.append((log_time, row))
        if len(self.rows) >= MOST or time.monotonic() - self.saved_at >= EVERY_S:
            self.write_down()

    def write_down(self) -> None:
        """Writes what is not written yet; the next file is begun if this one is full."""
        self.saved_at = time.monotonic()
        if self.saved == len(self.rows):
            return
        self.written.append(self.path)
        try:
            write_decisions(self.path, self.rows, self.about)
        except OSError as error:
            self.trouble = str(error)
            return
        self.trouble, self.saved = "", len(self.rows)
        if len(self.rows) >= MOST:
            self.rows, self.saved, self.number = [], 0, self.number + 1
