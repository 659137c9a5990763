"""`./run beadline init` on thirty recordings of other people's machines (tests/foreign/headers.py): does it
tell what is controlled, what controls and what disturbs, so that an owner has at most four lines to edit?"""

import re
import unicodedata
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import yaml

from tests.foreign.headers import HEADERS, ROLES, Column, Header, Recording
from tests.mission.toy_temperature import Refused, beadline, begin

MOST_LINES = 4
# a role that a column has -> the sections of plant in which it may stand; "" is none
MAY_STAND = {
    "time": {""},
    "output": {"outputs"},
    "setpoint": {""},
    "input": {"inputs"},
    "disturbance": {"disturbances"},
    "ignore": {""},
    "melt": {"", "outputs"},
    "load": {"", "disturbances"},
}


class Judgement(NamedTuple):
    """Set-points and others that stand among the outputs, or speeds and others among the inputs, and one
    sentence for each line that the owner must edit."""

    setpoints_as_outputs: list[str]
    speeds_as_inputs: list[str]
    lines: list[str]


def recording_of(header: Header) -> Recording:
    return header.make(np.random.default_rng(zlib.crc32(header.name.encode())))


def _plain(name: str) -> str:
    """Without its last brackets, in which a unit stands; "zone_temps.data[0]" keeps its index."""
    return re.sub(r"^#\s*|\s*[\[(](?!\d+[\])])[^\[\]()]*[\])]$", "", name.strip())


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name.strip()).casefold()


def find(columns: Sequence[Column], source: str) -> Column | None:
    """The column that a mapping's source names, with or without its unit."""
    for shape in (str, _plain):
        found = [
            column
            for column in columns
            if _folded(shape(source)) in [_folded(shape(name)) for name in column.name.split("|")]
        ]
        if len(found) == 1:
            return found[0]
    return None


def judge(recording: Recording, plant: Mapping[str, Any], ingest: Mapping[str, Any]) -> Judgement:
    """Of what `init` wrote into the sections plant and ingest."""
    mapping = ingest["mapping"]
    stands: dict[str, tuple[str, Mapping[str, Any]]] = {}
    lines: list[str] = []
    for section in ("outputs", "inputs", "disturbances"):
        for signal in plant.get(section) or []:
            entry = mapping.get(signal["name"]) or {"source": signal["name"]}
            column = find(recording.columns, str(entry["source"]))
            if column is None:
                lines.append(f"{section}: {entry['source']} is no column")
            else:
                stands[column.name] = section, entry
    setpoints, speeds = [], []
    for column in recording.columns:
        section, entry = stands.get(column.name, ("", {}))
        allowed = MAY_STAND[column.role] | (set() if column.moving or column.role != "disturbance" else {""})
        if section not in allowed:
            lines.append(f"{column.name}: {column.role} is in {section or 'no section'}")
        elif section in ("outputs", "inputs") and column.scale and not _same_scale(column.scale, entry):
            lines.append(
                f"{column.name}: scale and offset are {entry.get('scale')}, {entry.get('offset')}, not "
                f"{column.scale[0]:.4g}, {column.scale[1]:.4g}"
            )
        if section == "outputs" and column.role == "setpoint":
            setpoints.append(column.name)
        if section == "inputs" and column.speed:
            speeds.append(column.name)
    lines += _wrong_clock(recording, plant.get("sample_time_s") or 0.0, ingest.get("time") or "")
    return Judgement(setpoints, speeds, lines)


def _wrong_clock(recording: Recording, sample_time_s: float, time: str) -> list[str]:
    """One line at most: every file has a column of the time. "" is: found by its name."""
    column = find(recording.columns, time) if time else None
    if time and (column is None or column.role != "time"):
        return [f"ingest.time: {time}, but a column has the time, with a row every {recording.step_s} s"]
    if not 0.9 * recording.step_s <= sample_time_s <= 20 * recording.step_s:
        return [f"sample_time_s: {sample_time_s} of a recording with a row every {recording.step_s} s"]
    return []


def _same_scale(wanted: tuple[float, float], entry: Mapping[str, Any]) -> bool:
    scale, offset = float(entry.get("scale", 1.0)), float(entry.get("offset", 0.0))
    return abs(scale - wanted[0]) <= 0.02 * wanted[0] and abs(offset - wanted[1]) <= 0.5


def proposal(header: Header, recording: Recording, folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """The sections plant and ingest that `init` writes in a new folder. Raises Refused."""
    begin(folder)
    (folder / header.file).write_bytes(recording.content)
    beadline(folder, "init", header.file, "--copy")
    sections = yaml.safe_load((folder / "params.yaml").read_text(encoding="utf-8"))
    return sections["plant"], sections["ingest"]


@pytest.mark.parametrize("header", HEADERS, ids=[header.name for header in HEADERS])
def test_an_owner_edits_few_lines_after_init(header, tmp_path):
    recording, said = recording_of(header), ""
    try:
        plant, ingest = proposal(header, recording, tmp_path / "project")
    except Refused as refused:
        said = str(refused)
    if said:
        # most of these files hold all that is needed; a refusal is right only where the table says so
        says_what_to_do = bool(header.remedy) and re.search(header.remedy, said) is not None
        assert says_what_to_do, f"refused: {said}"
        return
    judged = judge(recording, plant, ingest)
    assert judged.setpoints_as_outputs == []
    assert judged.speeds_as_inputs == []
    assert len(judged.lines) <= MOST_LINES, f"{len(judged.lines)} lines to edit:\n" + "\n".join(judged.lines)


# ---- the table and its judge


def test_every_recording_of_the_table_has_a_loop_and_a_clock():
    assert len(HEADERS) == len({header.name for header in HEADERS}) == 30
    for header in HEADERS:
        recording = recording_of(header)
        names, roles = zip(*((column.name, column.role) for column in recording.columns), strict=True)
        assert set(roles) <= set(ROLES) and {"time", "output", "setpoint", "input"} <= set(roles), header.name
        assert len(set(names)) == len(names), header.name
        assert 1200 <= len(recording.columns[0].cells) <= 3000, header.name


def told(recording: Recording, roles: Mapping[str, str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """A proposal that puts each role of a column into a section."""
    sections, mapping = {"sample_time_s": recording.step_s}, {}
    for i, column in enumerate(recording.columns):
        if section := roles.get(column.role):
            sections.setdefault(section, []).append({"name": f"s{i}"})
            scale, offset = column.scale or (1.0, 0.0)
            mapping[f"s{i}"] = {"source": column.name.split("|")[0], "scale": scale, "offset": offset}
    return sections, {"mapping": mapping, "time": ""}


RIGHT = {"output": "outputs", "input": "inputs", "disturbance": "disturbances"}


@pytest.mark.parametrize("header", HEADERS, ids=[header.name for header in HEADERS])
def test_the_judge_has_nothing_against_the_right_proposal(header):
    recording = recording_of(header)
    assert judge(recording, *told(recording, RIGHT)) == ([], [], [])


def test_the_judge_sees_setpoints_speeds_and_what_is_missing():
    (header,) = [header for header in HEADERS if header.name == "battenfeld"]
    recording = recording_of(header)
    judged = judge(recording, *told(recording, {"setpoint": "outputs", "disturbance": "inputs"}))
    assert judged.setpoints_as_outputs == [f"T{k}_SOLL" for k in (1, 2, 3, 4)]
    assert judged.speeds_as_inputs == ["N_SCHNECKE"]
    assert len(judged.lines) == 4 + 4 + 4 + 1  # outputs, set-points, inputs, the screw
    plant, ingest = told(recording, RIGHT)
    ingest["mapping"]["s1"]["scale"] = 10.0
    assert judge(recording, plant | {"sample_time_s": 0.002}, ingest).lines == [
        "T1_IST: scale and offset are 10.0, 0.0, not 1, 0",
        "sample_time_s: 0.002 of a recording with a row every 2.0 s",
    ]
    plant, ingest = told(recording, RIGHT)
    (line,) = judge(recording, plant, ingest | {"time": "every 1.0 s"}).lines
    assert line.startswith("ingest.time: every 1.0 s, but a column has the time")
