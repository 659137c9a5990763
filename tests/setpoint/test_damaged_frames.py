"""Damaged folders of images: what is counted and left out while the others go on, and what is refused, with
file, line, expected, found and remedy."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.recordings.nozzle_frames import check, figures
from tests.nozzle_folders import FLOWS, SHOTS, expected, folder, images, notes, read, rows, table

COUNT = 2 * len(FLOWS) * SHOTS


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    return folder(tmp_path_factory.mktemp("frames") / "raw")


@pytest.fixture
def copy(made, tmp_path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "raw"))


def refusal(path: Path, **settings) -> str:
    with pytest.raises(ValueError, match="; ") as refused:
        read(path, **settings)
    assert "\n" not in str(refused.value)
    return str(refused.value)


# ---- damaged ones: counted, the others go on


def test_missing_images_are_counted_with_the_first_line_and_the_others_go_on(copy):
    for k in (3, 7):
        (copy / rows()[k]["img_path"]).unlink()
    found = read(copy)
    assert [i for i, reason in enumerate(found.reasons) if reason == "the image is missing"] == [3, 7]
    assert (
        f"log.csv: 2 of {COUNT} frames were left out: the image is missing, the first line 5, "
        "print0/image-3.png" in notes(found)
    )
    others = np.delete(np.arange(COUNT), [3, 7])
    np.testing.assert_array_equal(found.images[others], expected()[others])
    assert not found.images[3].any()


def _spoil(content: bytes, kind: str) -> bytes:
    jpeg = cv2.imencode(".jpg", cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE))[
        1
    ].tobytes()
    half = len(jpeg) // 2
    return {
        "empty": b"", "text": b"no picture",
        "page": b"<!DOCTYPE html><html><body>404 Not Found</body></html>",
        "cut PNG": content[: len(content) // 2], "cut JPEG": jpeg[:half],
        "JPEG without its last byte": jpeg[:-1],
        "JPEG of zeros": jpeg[:half] + bytes(half), "JPEG with a hole": jpeg[:half] + jpeg[half + 400 :],
        "floats": cv2.imencode(".tif", np.ones((80, 80), np.float32))[1].tobytes(),
        "no pixels": cv2.imencode(".png", np.zeros((1, 1), np.uint8))[1].tobytes(),
    }[kind]  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("empty", "an empty file"), ("text", "10 bytes that are no whole picture"),
        ("page", "no whole picture, beginning with 3c 21"), ("cut PNG", "no whole picture"),
        ("cut JPEG", "without its end"),
        ("JPEG without its last byte", "without its end"), ("JPEG of zeros", "without its end"),
        ("JPEG with a hole", "Corrupt JPEG data"), ("floats", "float32"),
        ("no pixels", "at least 64 x 64 px"),
    ],
)  # fmt: skip
def test_an_image_that_cannot_be_used_is_left_out_with_its_reason(copy, kind, said):
    path = copy / rows()[4]["img_path"]
    path.write_bytes(_spoil(path.read_bytes(), kind))
    found = read(copy)
    assert said in found.reasons[4]
    assert not found.valid[4]
    assert (
        f"1 of {COUNT} frames were left out: {found.reasons[4].partition(':')[0]}, the first line 6, "
        "print0/image-4.png" in notes(found)
    )
    np.testing.assert_array_equal(np.delete(found.images, 4, 0), np.delete(expected(), 4, 0))


def test_sixteen_bits_of_which_a_camera_fills_twelve_are_named(copy):
    path = copy / rows()[4]["img_path"]
    cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(np.uint16) << 4)
    found = read(copy)
    assert "the frame cannot be used: its 16 bits hold" in found.reasons[4]
    assert "over all of 0 to 65535" in notes(found)


def test_a_line_that_is_there_twice_counts_once(copy):
    table(copy / "log.csv", [*rows(), *rows()[9:12]])
    found = read(copy)
    assert found.reasons[-3:] == ["an earlier line lists the image"] * 3
    np.testing.assert_array_equal(found.images[:COUNT], expected())
    assert (
        f"3 of {COUNT + 3} frames were left out: an earlier line lists the image, the first line 20"
        in notes(found)
    )


def test_copies_of_a_frame_under_other_names_count_once(copy):
    valid = np.flatnonzero(expected().any(axis=(1, 2)))
    first, later = (copy / rows()[k]["img_path"] for k in (valid[0], valid[-1]))
    later.write_bytes(first.read_bytes())
    found = read(copy)
    assert found.reasons[valid[-1]] == "the frame is a copy of another"
    assert "a camera that runs" in notes(found)


@pytest.mark.parametrize(
    ("column", "reason"),
    [("flow_rate", "no flow is known"), ("target_hotend", "no temperature is known"),
    ("print_id", "no print is named"), ("img_path", "no image is named"),
     ("nozzle_tip_x", "no tip is known")],
)  # fmt: skip
def test_an_empty_field_leaves_out_its_line_alone(copy, column, reason):
    lines = rows()
    lines[4][column] = ""
    table(copy / "log.csv", lines)
    found = read(copy)
    left_out = [i for i, why in enumerate(found.reasons) if why == reason]
    assert [found.source[i].partition("line ")[2].partition(",")[0] for i in left_out] == ["6"]
    assert figures(found)["rejected"][reason] == 1


def test_labels_that_contradict_the_flow_are_reported_and_the_flow_is_taken(copy):
    table(copy / "log.csv", [dict(row, flow_rate_class="1") for row in rows()])
    found = read(copy)
    assert found.label.tolist() == np.tile(np.repeat([0, 1, 2], SHOTS), 2).tolist()
    assert (
        f"contradicts flow_rate in {COUNT * 2 // 3} of {COUNT} lines, the first line 2: "
        "class 1 at 60 percent, which is class 0" in notes(found)
    )


@pytest.mark.parametrize(
    ("column", "said"),
    [
        (
            "flow_rate",
            "no flow is known, the first line 2, print0/image-0.png; fill it in, in percent of nominal",
        ),
        ("target_hotend", "no temperature is known, the first line 2, print0/image-0.png; fill it in"),
        (
            "print_id",
            "no print is named, the first line 2, print0/image-0.png; fill in print_id, "
            "or remove that column",
        ),
        ("img_path", "no image is named, the first line 2, no image; fill in img_path"),
        (
            "nozzle_tip_y",
            "no tip is known, the first line 2, print0/image-0.png; "
            "find it with ./run beadline calibrate tip",
        ),
    ],
)
def test_an_empty_column_is_refused_with_what_to_do(copy, column, said):
    table(copy / "log.csv", [dict(row, **{column: ""}) for row in rows()])
    assert said in refusal(copy)


def test_files_that_no_line_names_are_counted(copy):
    table(copy / "log.csv", rows()[:12])
    (copy / "settings.xlsx").write_bytes(b"PK")
    (copy / "README.md").write_text("as they came")
    found = read(copy)
    assert len(found.valid) == 12
    assert (
        f"{copy}: 7 files are named by no CSV and were not read, the first print1/image-3.png; list them"
        in notes(found)
    )


@pytest.mark.parametrize("tip", ["NaN", "inf", "-1", "1e300"])
def test_a_tip_that_is_no_place_in_the_picture_leaves_out_its_line(copy, tip):
    lines = rows()
    lines[4]["nozzle_tip_x"] = tip
    table(copy / "log.csv", lines)
    found = read(copy)
    assert not found.valid[4]
    assert "1 of 18 frames were left out: " in notes(found)
    assert "calibrate tip" in notes(found)
    np.testing.assert_array_equal(np.delete(found.images, 4, 0), np.delete(expected(), 4, 0))


def test_notes_of_a_table_name_their_file(copy):
    (copy / "log.csv").write_bytes(
        (copy / "log.csv").read_bytes().replace(b"bed", "Bett, nördlich".encode("cp1252").replace(b",", b" "))
        + bytes(40)
    )
    assert f"{copy / 'log.csv'}: byte " in notes(read(copy))


# ---- refused


def test_what_a_csv_is_refused_for(copy):
    def of(**changes) -> str:
        lines = rows()
        for column, text in changes.items():
            lines[4][column] = text
        table(copy / "log.csv", lines)
        return refusal(copy)

    assert "log.csv: line 6, column flow_rate should be a number but is 'high'" in of(flow_rate="high")
    assert "log.csv: line 6: expected flow_rate within 0 and 1000 (percent of nominal), found -5" in of(
        flow_rate="-5"
    )
    assert "log.csv: line 6: expected target_hotend within 0 and 600 (degC), found 2100" in of(
        target_hotend="2100"
    )
    assert "found it 3.15 s before line 5" in of(timestamp="2020-10-08T13:12:00-00")
    assert "line 6, time timestamp should be" in of(timestamp="yesterday")
    assert (
        "line 6: expected print0/image-3.png once, found it here with 100 percent and 230 degC in "
        "print '0' and in line 5" in of(img_path="print0/image-3.png", target_hotend="230")
    )
    assert "line 6, time timestamp should be" in of(timestamp="1602163930")
    assert "convert it, or remove that column" in of(timestamp="1602163930")
    assert "line 6: a quotation mark is opened there and never closed; remove or close it" in of(
        img_path='"print0/image-4.png'
    )
    for column, needed in (("flow_rate", "flow_rate"), ("img_path", "img_path")):
        table(
            copy / "log.csv", [{name: text for name, text in row.items() if name != column} for row in rows()]
        )
        assert f"log.csv: expected a column {needed}, found none" in refusal(copy)
    table(
        copy / "log.csv",
        [{name: text for name, text in row.items() if "hotend" not in name} for row in rows()],
    )
    assert "expected a column target_hotend or hotend" in refusal(copy)
    table(
        copy / "log.csv",
        [{name: text for name, text in row.items() if name != "nozzle_tip_y"} for row in rows()],
    )
    assert "expected both nozzle_tip_x and nozzle_tip_y, found one" in refusal(copy)


@pytest.mark.parametrize("label", ["3", "-1", "0.5"])
def test_a_label_outside_the_classes_is_refused_with_its_line(copy, label):
    lines = [dict(row, flow_rate_class="1") for row in rows()]
    lines[2]["flow_rate_class"] = label
    table(copy / "log.csv", lines)
    assert (
        f"log.csv: line 4: expected flow_rate_class within 0 and 2 (0 under, 1 good, 2 over), found {label}"
        in refusal(copy)
    )


def test_a_folder_without_anything_to_read_is_refused(tmp_path):
    (tmp_path / "raw").mkdir()
    (tmp_path / "raw/README.md").write_text("nothing here yet")
    assert "expected a CSV with its images, or MCAP recordings, found neither" in refusal(tmp_path / "raw")
    (tmp_path / "raw/log.csv").write_text(",".join(rows()[0]) + "\n")
    assert "a header and no data" in refusal(tmp_path / "raw")


def test_a_link_to_nowhere_is_refused_by_its_name(copy):
    (copy / "night.mcap").symlink_to("gone.mcap")
    assert "night.mcap is a link to what is not there; copy the file itself" in refusal(copy)


def test_a_folder_without_one_usable_frame_is_refused_with_the_reason(copy):
    assert "the tip of these pictures with ./run beadline calibrate tip" in refusal(copy, tip=(900.0, 100.0))
    for name in ("print0", "print1"):
        shutil.rmtree(copy / name)
    said = refusal(copy)
    assert (
        f"none of {COUNT} frames can be learned from: {copy / 'log.csv'}: "
        f"{COUNT} of {COUNT} frames were left out: the image is missing, the first line 2" in said
    )
    table(
        copy / "log.csv", [{name: text for name, text in row.items() if "tip" not in name} for row in rows()]
    )
    images(copy)
    assert "no tip is known" in refusal(copy)


def test_one_print_allows_no_honest_split_and_every_class_is_needed(made):
    found = read(made)
    check(made, found)
    with pytest.raises(
        ValueError,
        match=(
            r"no honest split: expected valid frames of at least 2 prints.*found 1 \(0\); add another "
            r"print"
        ),
    ):
        check(made, found._replace(valid=found.valid & (found.print_number == 0)))
    with pytest.raises(
        ValueError,
        match=(
            r"found none of class 2, over \(above 110 %\), in \d+ with flow_rate 60 to 100 percent.*; "
            r"add prints"
        ),
    ):
        check(made, found._replace(valid=found.valid & (found.label < 2)))
