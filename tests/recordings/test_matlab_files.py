import io
import struct
import zlib

import numpy as np
import pytest
import scipy.io

from pipeline.recordings.formats import file_format
from pipeline.recordings.recordings import Source, inspect, read

TIME, HEAT = np.arange(60) * 0.5, np.arange(60) % 7 * 10.0


def saved(content: dict, **options) -> bytes:
    stream = io.BytesIO()
    scipy.io.savemat(stream, content, **options)
    return stream.getvalue()


def write(tmp_path, content: bytes):
    path = tmp_path / "rig.mat"
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("options", [{}, {"do_compression": True}, {"oned_as": "column"}])
def test_vectors_matrices_and_structures_are_columns_on_the_vector_that_is_a_time(tmp_path, options):
    both = np.column_stack([HEAT, HEAT[::-1]])
    content = {"t": TIME, "u": both, "log": {"T1": 20 + TIME, "name": "rig"}, "Ts": 0.5}
    path = write(tmp_path, saved(content, **options))
    assert file_format(path) == "MATLAB"
    raw = read(path, [Source("y", "log.T1", "degC"), Source("u", "u_2", "percent")])
    np.testing.assert_array_equal(raw.signals["y"][0], TIME)
    np.testing.assert_array_equal(raw.signals["y"][1], 20 + TIME)
    np.testing.assert_array_equal(raw.signals["u"][1], HEAT[::-1])
    assert "Ts (one number, 0.5)" in inspect(path)


def test_a_matrix_of_which_samples_are_columns_is_turned(tmp_path):
    raw = read(
        write(tmp_path, saved({"t": TIME, "y": np.vstack([TIME, HEAT])})), [Source("y", "y_2", "degC")]
    )
    np.testing.assert_array_equal(raw.signals["y"][1], HEAT)


def test_without_a_time_the_sample_time_must_be_declared(tmp_path):
    path = write(tmp_path, saved({"u": HEAT, "y": TIME}))
    with pytest.raises(ValueError, match="no column is called like a time"):
        read(path, [Source("y", "y", "degC")])
    raw = read(path, [Source("y", "y", "degC")], time="every 2 s")
    np.testing.assert_array_equal(raw.signals["y"][0], np.arange(60) * 2.0)


def test_version_7_3_is_refused_with_the_remedy(tmp_path):
    path = write(tmp_path, b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512) + b"\x89HDF\r\n\x1a\n")
    with pytest.raises(ValueError, match=r"MATLAB 7.3 file \(HDF5\) .* save it with save\(..., '-v7'\)"):
        read(path, [Source("y", "y", "degC")])


@pytest.mark.parametrize("share", [0.2, 0.6, 0.95])
def test_a_truncated_file_is_refused_in_one_sentence(tmp_path, share):
    content = saved({"t": TIME, "u": HEAT, "y": TIME}, do_compression=True)
    path = write(tmp_path, content[: int(share * len(content))])
    with pytest.raises(ValueError) as refused:
        read(path, [Source("y", "y", "degC")])
    assert str(refused.value).startswith(str(path)) and "\n" not in str(refused.value)


@pytest.mark.parametrize("compressed", [True, False])
def test_a_garbled_file_is_read_or_refused(tmp_path, compressed):
    content = saved({"t": TIME, "log": {"u": HEAT, "y": TIME}}, do_compression=compressed)
    rng = np.random.default_rng(0)
    for _ in range(150):
        changed = bytearray(content)
        changed[rng.integers(128, len(changed))] ^= 1 << rng.integers(0, 8)
        path = write(tmp_path, bytes(changed))
        try:
            read(path, [Source("y", "log.y", "degC")])
        except ValueError as refused:
            assert str(refused).startswith(str(path))


def test_a_variable_that_unpacks_to_gigabytes_is_refused_before_it_is(tmp_path):
    packer = zlib.compressobj()
    packed = b"".join(packer.compress(bytes(1 << 20)) for _ in range(600)) + packer.flush()
    content = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + struct.pack("<II", 15, len(packed)) + packed
    with pytest.raises(ValueError, match="the file unpacks to more than 512 MB"):
        read(write(tmp_path, content), [Source("y", "y", "degC")])


def test_files_that_end_the_process_of_another_reader_are_read_or_refused(tmp_path):
    """Cells and structures with several bytes changed: scipy.io.loadmat ended with a segmentation fault."""
    content = saved({"t": TIME, "log": {"u": HEAT, "y": TIME}, "c": np.array([1, "x"], object)})
    rng = np.random.default_rng(1)
    for k in range(600):
        changed = bytearray(content)
        for _ in range(k % 7 + 1):
            changed[rng.integers(128, len(changed))] = rng.integers(0, 256)
        path = write(tmp_path, bytes(changed))
        try:
            read(path, [Source("y", "log.y", "degC")])
        except ValueError as refused:
            assert str(refused).startswith(str(path))


def test_entries_of_a_structure_and_of_a_cell_have_a_name_each(tmp_path):
    zones = np.array([{"T": TIME}, {"T": HEAT}], object)
    path = write(tmp_path, saved({"t": TIME, "zones": zones, "runs": np.array([TIME, HEAT[:5]], object)}))
    text = inspect(path)
    for name in ("zones_1.T", "zones_2.T", "runs_1"):
        assert name in text


def test_a_signal_on_a_clock_of_its_own_is_not_read_on_that_of_another(tmp_path):
    content = {"u": {"t": TIME, "v": HEAT}, "y": {"t": TIME + 0.25, "v": HEAT}}
    path = write(tmp_path, saved(content))
    np.testing.assert_array_equal(read(path, [Source("u", "u.v", "percent")]).signals["u"][0], TIME)
    with pytest.raises(ValueError, match=r"column y.v should hold numbers but .* a clock of its own, y.t;"):
        read(path, [Source("y", "y.v", "degC")])
    content["y"]["t"] = TIME
    raw = read(write(tmp_path, saved(content)), [Source("y", "y.v", "degC")])
    np.testing.assert_array_equal(raw.signals["y"][0], TIME)


def test_an_array_of_eighty_dimensions_is_no_column(tmp_path):
    shape = struct.pack("<82i", 60, *[1] * 81)
    body = struct.pack("<IIII", 6, 8, 6, 0) + struct.pack("<II", 5, len(shape)) + shape
    body += struct.pack("<HH4s", 1, 1, b"X") + struct.pack("<II", 9, HEAT.nbytes) + HEAT.tobytes()
    content = saved({"t": TIME, "u": HEAT}) + struct.pack("<II", 14, len(body)) + body
    path = write(tmp_path, content)
    np.testing.assert_array_equal(read(path, [Source("u", "u", "percent")]).signals["u"][1], HEAT)
    with pytest.raises(ValueError, match="column X should hold numbers but holds an array of 82 dimensions"):
        read(path, [Source("u", "X", "percent")])
