import io
import struct

import numpy as np
import pytest
from mcap.records import Chunk
from mcap.stream_reader import StreamReader, breakup_chunk

from pipeline.recordings.recordings import Raw, Source, read
from tests.mcap_writing import LZ4, NO, ZSTD, Written, chunks, flipped, json_recording

SOURCES = [Source("heater_1", "heater_1", "percent"), Source("temperature_1", "temperature_1", "degC")]
SAMPLES = 1500


def opened(tmp_path, content: bytes) -> Raw:
    path = tmp_path / "recording.mcap"
    path.write_bytes(content)
    return read(path, SOURCES)


def kinds(raw: Raw) -> set[str]:
    return {note.kind for note in raw.notes}


def right(raw: Raw) -> bool:
    """Whether every sample that came out is the one that was written at its time."""
    time, heater = raw.signals["heater_1"]
    return np.array_equal(time, heater) and np.array_equal(raw.signals["temperature_1"][1], 20 + time / 8)


@pytest.mark.parametrize("compression", [NO, ZSTD, LZ4])
@pytest.mark.parametrize("chunked", [True, False])
def test_a_whole_file_gives_every_message_and_no_finding(tmp_path, compression, chunked):
    raw = opened(tmp_path, json_recording(SAMPLES, compression, use_chunking=chunked, enable_data_crcs=True))
    assert raw.messages == {"/machine": SAMPLES}
    assert raw.notes == []
    np.testing.assert_array_equal(raw.signals["heater_1"][0], np.arange(SAMPLES))
    assert right(raw)


@pytest.mark.parametrize("compression", [NO, ZSTD, LZ4])
def test_150_of_150_bit_flips_inside_chunks_are_detected_and_the_other_chunks_kept(tmp_path, compression):
    content = json_recording(SAMPLES, compression, chunk_size=4000, enable_data_crcs=True)
    parts = chunks(content)
    assert len(parts) > 10
    rng = np.random.default_rng(0)
    detected = 0
    for _ in range(150):
        offset, start, end = parts[rng.integers(len(parts))]
        place, bit = int(rng.integers(start, end)), int(rng.integers(8))
        raw = opened(tmp_path, flipped(content, place, bit))
        detected += "damage" in kinds(raw)
        assert right(raw)
        lost = SAMPLES - len(raw.signals["heater_1"][0])
        # one chunk of 4000 bytes holds some 50 messages; a flip in
        # bits that a decompressor passes over costs none
        assert lost < 100
        assert not lost or any(
            f"at byte {offset} was left out with its {lost} messages" in note.message for note in raw.notes
        )
    assert detected == 150


def test_bit_flips_in_the_head_of_a_chunk_cost_that_chunk_at_most(tmp_path):
    content = json_recording(SAMPLES, NO, chunk_size=4000)
    offset, start, _ = chunks(content)[4]
    for place in range(offset, start):
        for bit in (0, 6):
            raw = opened(tmp_path, flipped(content, place, bit))
            assert "damage" in kinds(raw)
            assert right(raw)
            assert SAMPLES - len(raw.signals["heater_1"][0]) < 100


@pytest.mark.parametrize("compression", [NO, ZSTD, LZ4])
def test_every_complete_chunk_of_a_truncated_file_is_recovered_and_counted(tmp_path, compression):
    content = json_recording(SAMPLES, compression, chunk_size=4000)
    parts = chunks(content)
    # the mcap package counts what each chunk of the whole file holds
    held = [
        len(breakup_chunk(record))
        for record in StreamReader(io.BytesIO(content), emit_chunks=True).records
        if isinstance(record, Chunk)
    ]
    held[0] -= 1  # the channel's own record
    assert sum(held) == SAMPLES
    for end in np.random.default_rng(1).integers(parts[0][2], parts[-1][2], 40):
        complete = sum(part[2] <= end for part in parts)
        raw = opened(tmp_path, content[:end])
        count = sum(held[:complete])
        assert raw.messages == {"/machine": count}
        assert any(
            note.message.endswith(f"{complete} whole chunks and {count} messages were recovered")
            for note in raw.notes
        )
        assert right(raw)
        np.testing.assert_array_equal(raw.signals["heater_1"][0], np.arange(count))


def test_a_file_without_a_whole_chunk_is_refused_in_one_sentence(tmp_path):
    content = json_recording(SAMPLES)
    for end in (1, 7, 8, 9, 40, 300):
        with pytest.raises(ValueError, match=r"recording\.mcap") as refusal:
            opened(tmp_path, content[:end])
        assert "\n" not in str(refusal.value)
        assert "again" in str(refusal.value)


def test_many_damaged_bytes_never_end_in_anything_but_a_sentence(tmp_path):
    rng = np.random.default_rng(2)
    content = np.frombuffer(json_recording(SAMPLES, chunk_size=4000), np.uint8)
    for _ in range(60):
        changed = content.copy()
        places = rng.integers(8, len(content), rng.integers(1, 200))
        changed[places] = rng.integers(0, 256, len(places))
        try:
            raw = opened(tmp_path, changed.tobytes())
        except ValueError as refusal:
            assert "\n" not in str(refusal)
        else:
            assert right(raw)


def test_a_chunk_that_asks_for_terabytes_is_damaged(tmp_path):
    content = json_recording(SAMPLES, ZSTD, chunk_size=4000)
    offset = chunks(content)[2][0]
    # the uncompressed size is the third number of the chunk's head
    raw = opened(tmp_path, flipped(content, offset + 9 + 16 + 5, 3))
    assert any("it says that it unpacks to" in note.message for note in raw.notes)


def test_channels_of_a_lost_first_chunk_come_from_the_summary(tmp_path):
    content = json_recording(SAMPLES, NO, chunk_size=4000)
    _, start, _ = chunks(content)[0]
    raw = opened(tmp_path, flipped(content, start + 100, 0))
    assert 0 < SAMPLES - len(raw.signals["heater_1"][0]) < 100
    assert right(raw)


def test_damage_in_messages_outside_chunks_is_refused_because_it_cannot_be_placed(tmp_path):
    content = json_recording(SAMPLES, use_chunking=False, enable_data_crcs=True)
    place = content.index(b'"heater_1": 700.0') + 13
    with pytest.raises(
        ValueError,
        match=r"the data section's CRC should be 0x\w+ but is 0x\w+, and its messages have no CRC of their "
        r"own",
    ):
        opened(tmp_path, flipped(content, place, 0))


def test_messages_without_any_crc_are_read_and_said_to_be_unchecked(tmp_path):
    raw = opened(tmp_path, json_recording(SAMPLES, use_chunking=False))
    assert [note.message for note in raw.notes] == [
        f"{SAMPLES} messages outside chunks have no CRC, so damage there would not be seen"
    ]
    raw = opened(tmp_path, json_recording(SAMPLES, enable_crcs=False))
    assert [note.kind for note in raw.notes] == ["unchecked"]


@pytest.mark.parametrize(
    ("old", "new", "how"),
    [(b"\r\n", b"\n", "CR LF to LF"), (b"\n", b"\r\n", "LF to CR LF"), (b"\r\n", b"\r", "CR LF to CR")],
)
def test_converted_line_ends_are_named_as_such(tmp_path, old, new, how):
    with pytest.raises(
        ValueError,
        match=rf"offset 0 should be 89 4d 43 41 50 30 0d 0a .* line ends were converted "
        rf"\({how}\).*\.gitattributes",
    ):
        opened(tmp_path, json_recording(SAMPLES).replace(old, new))


def test_an_unknown_compression_is_named(tmp_path):
    content = json_recording(SAMPLES, ZSTD).replace(
        struct.pack("<I", 4) + b"zstd", struct.pack("<I", 4) + b"brot"
    )
    with pytest.raises(ValueError, match="compression 'brot' is not known; zstd and lz4 are"):
        opened(tmp_path, content)


def test_two_channels_of_one_topic_are_joined_one_after_the_other_and_refused_at_the_same_time(tmp_path):
    def recorded(shift: int) -> bytes:
        made = Written()
        first, second = (made.topic("/machine", "json", device=name) for name in ("a", "b"))
        for k in range(10):
            made.message(first, k, {"heater_1": k, "temperature_1": 20 + k / 8})
        for k in range(shift, shift + 10):
            made.message(second, k + 0.5 * (shift < 10), {"heater_1": k, "temperature_1": 20 + k / 8})
        return made.bytes()

    raw = opened(tmp_path, recorded(20))
    assert len(raw.signals["heater_1"][0]) == 20
    assert kinds(raw) == {"channels"}
    with pytest.raises(
        ValueError,
        match="topic /machine comes from channels 1 and 2 at the same time, as if two devices had one name",
    ):
        opened(tmp_path, recorded(5))


def test_two_publishers_whose_clocks_differ_are_told_and_a_late_message_is_not(tmp_path):
    def recorded(late: list[int], behind_s: float) -> bytes:
        made = Written()
        channel = made.topic("/machine", "json")
        for k in range(200):
            made.message(
                channel,
                k,
                {"heater_1": k, "temperature_1": 20 + k / 8},
                published_s=k + 50 - behind_s * (k in late),
            )
        return made.bytes()

    assert kinds(opened(tmp_path, recorded([20, 90], 3.5))) == set()
    raw = opened(tmp_path, recorded(list(range(0, 200, 2)), 3.5))
    (note,) = [note for note in raw.notes if note.kind == "mixed"]
    assert note.count == 99
    assert (
        "two devices with clocks of their own seem to publish it; record each under a topic of its own"
        in note.message
    )


def cut_notes(raw: Raw) -> list[str]:
    return [note.message for note in raw.notes if note.kind == "cut"]


@pytest.mark.parametrize("statistics", [True, False])
def test_a_recording_of_which_a_twentieth_is_lost_says_how_much(tmp_path, statistics):
    content = json_recording(SAMPLES, NO, chunk_size=4000, use_statistics=statistics)
    parts = chunks(content)
    assert cut_notes(opened(tmp_path, content)) == []
    one = flipped(content, parts[4][1] + 50, 0)
    assert cut_notes(opened(tmp_path, one)) == []
    for _, start, _ in parts[5:10]:
        content = flipped(content, start + 50, 0)
    raw = opened(tmp_path, content)
    lost = SAMPLES - len(raw.signals["heater_1"][0])
    share = 100 * lost / SAMPLES
    assert share > 5
    assert cut_notes(raw) == [
        f"{share:.1f} % of the recording was left out (limit 5 %): {lost} of {SAMPLES} messages are lost; "
        "copy it again, or record it again"
    ]


@pytest.mark.parametrize(("chunk_size", "is_cut"), [(20_000, True), (2000, False)])
def test_a_file_that_ends_in_a_chunk_says_how_long_the_chunk_was(tmp_path, chunk_size, is_cut):
    content = json_recording(SAMPLES, NO, chunk_size=chunk_size)
    parts = chunks(content)
    # all chunks but the last, which is shorter than the others
    end = (parts[-2][1] + parts[-2][2]) // 2
    raw = opened(tmp_path, content[:end])
    notes = cut_notes(raw)
    assert bool(notes) == is_cut
    if is_cut:
        first, last = struct.unpack_from("<QQ", content, parts[-2][0] + 9)
        lost_s, rest_s = (last - first) / 1e9, raw.signals["heater_1"][0][-1]
        assert notes[0].startswith(f"{100 * lost_s / (lost_s + rest_s):.1f} % of the recording was left out")


def test_a_lost_chunk_whose_times_are_garbled_is_not_believed(tmp_path):
    content = json_recording(SAMPLES, NO, chunk_size=4000)
    parts = chunks(content)
    end = (parts[-2][1] + parts[-2][2]) // 2
    raw = opened(tmp_path, flipped(content, parts[-2][0] + 9 + 15, 5)[:end])
    assert cut_notes(raw) == []
