"""Hostile and damaged recordings: no traceback, bounded time and memory, one sentence each, and the good
recordings beside them are ingested."""

import os
from pathlib import Path

import numpy as np
import pytest

from pipeline.recordings import isolated as children
from pipeline.recordings import recording_folders
from pipeline.recordings.images import gray, reader
from pipeline.recordings.inspection import inspect
from pipeline.recordings.isolated import Budget, isolated
from pipeline.recordings.mcap_files import McapFile, topics
from pipeline.recordings.messages import UnreadableMessage
from pipeline.recordings.messages import ros_decoder as decoder
from pipeline.recordings.messages import ros_layout as layout
from pipeline.store import artifacts
from pipeline.store.printable import printable
from tests.recordings import damaging, hostile
from tests.temperature.test_ingest import INLINE, JOB, LOKY

BUDGET = Budget(60.0, 2000.0)
# they take seconds to minutes, up to their budget: with -m slow
SLOW = {
    "rows_1e9.parquet",
    "channels_1e6.mcap",
    "chunk_of_messages.mcap",
    "csv_line_200_MB.csv",
    "csv_commas_50_MB.csv",
    "csv_columns_1e6.csv",
    "csv_lines_alone.csv",
    "csv_quote.csv",
    "message_zstd_bomb.mcap",
    "message_lz4_bomb.mcap",
    "chunk_zstd_bomb.mcap",
    "chunk_zstd_lies.mcap",
    "chunk_lz4_bomb.mcap",
    "channels_of_one_topic.mcap",
    "json_list.mcap",
    "json_fields_3e5.mcap",
    "ros_many_types.mcap",
    "columns_2e4.parquet",
    "message_zstd_unknown.mcap",
    *hostile.SPARSE,
}
QUICK = [name for name in hostile.FILES if name not in SLOW]


def peak_mb(pid: int) -> float:
    status = Path(f"/proc/{pid}/status").read_text()
    return next(int(line.split()[1]) / 1024 for line in status.splitlines() if line.startswith("VmHWM"))


def test_there_are_sixty_hostile_files():
    assert len(hostile.FILES) + len(hostile.SPARSE) >= 60


@pytest.fixture(scope="module")
def raw(tmp_path_factory) -> Path:
    """A folder of hostile recordings."""
    folder = tmp_path_factory.mktemp("raw")
    for name in QUICK:
        hostile.write(folder, name)
    return folder


def test_inspect_answers_every_hostile_file_in_bounds_and_without_control_characters(raw):
    for name in QUICK:
        path = raw / name
        try:
            answer = isolated(inspect, path, shown=path, budget=BUDGET)
        except ValueError as refused:
            answer = str(refused)
            assert "\n" not in answer.strip()
            assert "ended the process" not in answer, answer
        assert not set(printable(answer)) & {"\x1b", "\x07", "\u202e", "\x9b"}, name


def test_good_recordings_among_hostile_ones_are_ingested_and_the_others_named_in_one_sentence(raw, tmp_path):
    good = {"a.csv": hostile.good_csv, "m.mcap": hostile.good_mcap, "z.parquet": hostile.good_parquet}
    for name, made in good.items():
        (raw / name).write_bytes(made() if name != "a.csv" else hostile.good_csv(start=21.0))
    results = recording_folders.read_folder(raw, JOB, LOKY, memo=tmp_path / "memo", budget=BUDGET)
    by_name = {result.name: result for result in results}
    assert all(by_name[name].reason == "" for name in good)
    assert sum(not result.reason for result in results) <= len(good) + 2  # numbers far away are still numbers
    for result in results:
        assert "\n" not in result.reason
        assert "ended the process" not in result.reason, result.reason
        assert "Traceback" not in result.reason
    quality = recording_folders.join(results, JOB, strict=False)[1]
    artifacts.write_table(tmp_path / "quality.parquet", JOB.quality, quality)


@pytest.mark.slow  # minutes, up to the budget of each
@pytest.mark.parametrize("name", sorted(SLOW))
def test_large_hostile_files_stay_within_a_minute_and_2_GB(tmp_path, name):
    path = hostile.write(tmp_path, name)
    while children._waiting:
        children._end(children._waiting.pop())
    isolated(len, "a fresh child, whose peak is its own", shown="x", budget=BUDGET)
    pid = children._waiting[0].process.pid
    try:
        isolated(inspect, path, shown=path, budget=BUDGET)
    except ValueError as refused:
        assert "ended the process" not in str(refused)
    if children._waiting and children._waiting[0].process.pid == pid:
        assert peak_mb(pid) < 2300  # the budget, and what the child takes itself


@pytest.mark.slow  # a second each, most of it the import of the loop
@pytest.mark.parametrize("name", sorted(n for n in [*QUICK, *hostile.SPARSE] if n.endswith(".mcap")))
def test_the_readers_of_the_camera_loops_refuse_hostile_recordings_within_the_same_memory(tmp_path, name):
    """They run in no child of their own: frames are decoded one by one, later, by whoever walks them."""
    path = hostile.write(tmp_path, name)
    with pytest.raises(ValueError, match=name) as refused:
        isolated(hostile.trial_frames, path, shown=path, budget=BUDGET)
    assert "more memory" not in str(refused.value)
    assert "ended the process" not in str(refused.value)


# ---- damage by chance


@pytest.mark.parametrize("kind", damaging.GOOD)
def test_damage_by_chance_gives_no_traceback_and_is_seen_where_there_are_checksums(tmp_path, kind):
    results = list(damaging.outcomes(tmp_path, kind, 60, seed=16))
    counts = {result: [name for at, name in results if at == result] for result, _ in results}
    assert damaging.ENDED not in counts, counts
    if kind in ("mcap", "parquet"):
        assert damaging.SILENT not in counts, counts
    # a broken digit in text without checksums is another digit
    assert counts.get(damaging.REFUSED) or counts.get(damaging.NOTED), counts


def test_a_child_killed_at_one_recording_costs_that_recording(tmp_path, monkeypatch):
    raw = tmp_path / "raw"
    raw.mkdir()
    (raw / "good.csv").write_bytes(hostile.good_csv())
    (raw / "killer.csv").write_bytes(hostile.good_csv(start=30.0))
    inside = recording_folders.isolated

    def killing(work, path, *arguments, shown, budget):
        if path.name == "killer.csv":
            return inside(os.abort, shown=shown, budget=budget)
        return inside(work, path, *arguments, shown=shown, budget=budget)

    monkeypatch.setattr(recording_folders, "isolated", killing)
    results = recording_folders.read_folder(raw, JOB, INLINE, memo=tmp_path / "memo", budget=BUDGET)
    assert [bool(result.reason) for result in results] == [False, True]
    assert "killer.csv: reading it ended the process that read it (SIGABRT)" in results[1].reason


# ---- the readers' own bounds, without a child


@pytest.mark.parametrize(
    ("definition", "sentence"),
    [
        ("float64[99999999999999] a", "elements in a, more than any message can hold"),
        ("string[1000000000] a", "more than 20000 parts"),
        ("State inner", "contains itself"),
    ],
)
def test_a_ros_definition_that_no_message_can_have_is_refused(definition, sentence):
    with pytest.raises(ValueError, match=sentence):
        layout(definition, "rig/State", version=2)


def test_a_long_array_costs_no_memory_and_its_elements_are_read(tmp_path):
    items = layout("float64[1000000] a\nfloat64 u", "rig/State", version=2)
    content = np.arange(1_000_001.0)
    message = b"\x00\x01\x00\x00" + content.tobytes()
    values = decoder(items, ["a[999999]", "a[3]", "u"], version=2)([message])
    np.testing.assert_array_equal(values, [[999_999.0, 3.0, 1_000_000.0]])


@pytest.mark.parametrize("name", ["png_1e5.mcap", "png_3e4.mcap", "jpeg_65535.mcap", "raw_1e5.mcap"])
def test_a_picture_that_promises_more_pixels_than_memory_is_unreadable(tmp_path, name):
    path = hostile.write(tmp_path, name)
    channel = topics(path)["/machine"].channels[0]
    file = McapFile(path)
    messages = next(file.batches(lambda one: True))[channel.id].data
    with pytest.raises(UnreadableMessage, match=r"its header says \d+ x \d+ px|do not go with"):
        gray(reader(channel)(messages[0]))
