"""Folders of images with a CSV beside them: what comes out of a sound one, and what a damaged one gets."""

import shutil
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.recordings.images import read_image
from pipeline.recordings.nozzle_frames import figures, read_log, stretches
from pipeline.setpoint.frames import key_area
from tests.nozzle_folders import FLOWS, SHOTS, expected, folder, images, notes, read, rows, scenes, table

COUNT = 2 * len(FLOWS) * SHOTS


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    return folder(tmp_path_factory.mktemp("frames") / "raw")


@pytest.fixture
def copy(made, tmp_path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "raw"))


def _flat(path: Path, lines: list[dict[str, str]]) -> None:
    """All images in a folder that no line names."""
    (path / "imgs").mkdir()
    for line in lines:
        name = line["img_path"].replace("/", "-")
        (path / line["img_path"]).rename(path / "imgs" / name)
        line["img_path"] = f"set/{name}"
    table(path / "log.csv", lines)


# ---- sound folders


def test_key_areas_from_files_are_those_of_the_frames_themselves(made):
    found = read(made)
    # PNG keeps every bit
    np.testing.assert_array_equal(found.images, expected())
    np.testing.assert_array_equal(found.valid, expected().any(axis=(1, 2)))
    assert found.valid.mean() > 0.5, "a test on rejected frames alone shows nothing"
    np.testing.assert_array_equal(found.flow, np.tile(np.repeat(FLOWS, SHOTS), 2))
    np.testing.assert_array_equal(found.temperature, 210.0)


def test_class_print_and_segment_of_an_example_by_hand(copy):
    lines = [
        dict(row, flow_rate=flow)
        for row, flow in zip(
            rows()[:9], ("89.9", "90", "90", "110", "110.1", "110.1", "90", "90", "90"), strict=True
        )
    ]
    for line in lines[7:]:
        line["print_id"] = "b"
    lines[2]["target_hotend"] = "200"
    table(copy / "log.csv", lines)
    found = read(copy)
    assert found.label.tolist() == [0, 1, 1, 1, 2, 2, 1, 1, 1]
    assert found.prints == ("0", "b")
    assert found.print_number.tolist() == [0] * 7 + [1] * 2
    # a new flow, a new temperature, both, a flow, a flow, and another print at the same settings
    assert found.segment.tolist() == [0, 1, 2, 3, 4, 4, 5, 6, 6]
    assert found.source[4] == f"{copy / 'log.csv'}: line 6, print0/image-4.png"


def test_a_print_in_two_files_is_one_print(copy):
    lines = rows()
    table(copy / "log.csv", lines[:4])
    table(copy / "more.csv", [dict(line, print_id=line["print_id"] + ".0") for line in lines[4:]])
    assert read(copy).prints == ("0", "1")


def test_prints_that_take_turns_in_a_file_are_put_one_behind_the_other(copy):
    lines = rows()
    table(copy / "log.csv", [line for both in zip(lines[:9], lines[9:], strict=True) for line in both])
    found = read(copy)
    np.testing.assert_array_equal(found.images, expected())
    assert found.print_number.tolist() == [0] * 9 + [1] * 9
    assert len(set(found.segment)) == 6


@pytest.mark.parametrize(
    "write",
    [
        lambda path, lines: table(path / "log.csv", lines, mark="\ufeff", end="\r\n"),
        lambda path, lines: table(path / "log.csv", [{k: v.replace(".", ",") if k == "hotend" else v for k,
        v in line.items()} for line in lines], separator=";"),
        lambda path, lines: table(path / "log.csv", [dict(line, img_path=line["img_path"].replace("/",
        "\\")) for line in lines]),
        lambda path, lines: table(path / "log.csv", [dict(line,
        img_path="C:\\data\\caxton_dataset\\" + line["img_path"].replace("/", "\\")) for line in lines]),
        lambda path, lines: table(path / "log.csv", [dict(line,
        img_path="./" + line["img_path"]) for line in lines]),
        lambda path, lines: table(path / "log.csv", [dict(line,
        img_path="/home/me/caxton/" + line["img_path"]) for line in lines]),
        lambda path, lines: table(path / "log.csv", [{name.upper(): text for name,
        text in line.items()} for line in lines]),
        lambda path, lines: table(path / "log.csv", [{f" {name.replace('_', ' ').title()}": text for name,
        text in line.items()} for line in lines]),
        lambda path, lines: table(path / "log.csv", [{"": str(k), **dict(reversed(line.items())),
        "remark": "Zoë"} for k, line in enumerate(lines)]),
        lambda path, lines: table(path / "log.csv", [dict(line, timestamp=str(1602163930 + k)) for k,
        line in enumerate(lines)]),
        lambda path, lines: table(path / "log.csv", [dict(line,
        timestamp=f"2020-10-08T13:12:{k:02d}.123456+00:00") for k, line in enumerate(lines)]),
        lambda path, lines: table(path / "log.csv", [dict(line,
        timestamp=f"10/08/2020 1:12:{k:02d} PM") for k, line in enumerate(lines)]),
        lambda path, lines: table(path / "log.csv", [dict(line, timestamp="NaT") for line in lines]),
        lambda path, lines: (table(path / "log.csv", lines), (path / "again").symlink_to(".")),
        lambda path, lines: table(path / "logs/log.csv", lines),
        lambda path, lines: _flat(path, lines),
        lambda path, lines: [table(path / f"print{k}/log.csv", [dict(r,
        img_path=r["img_path"].split("/")[1]) for r in lines[9 * k : 9 * k + 9]]) for k in (0, 1)],
    ],
    ids=["mark and CRLF", "semicolons and decimal commas", "back-slashes", "another computer's folders",
    "a dot", "an absolute path", "upper case", "names with blanks", "another order, an index and a remark",
    "seconds since 1970", "ISO with a zone", "an American clock", "no times", "a link that leads back",
    "CSV in a folder of its own", "images in a folder of another name", "CSV beside its images"],
)  # fmt: skip
def test_however_the_file_is_written_the_frames_are_the_same(copy, write):
    (copy / "log.csv").unlink()
    write(copy, rows())
    found = read(copy)
    np.testing.assert_array_equal(found.images, expected())
    assert found.prints == ("0", "1")


def test_a_file_without_the_optional_columns_is_one_print_and_says_what_it_lacks(copy):
    (copy / "log.csv").unlink()
    lines = [{name: row[name] for name in ("img_path", "flow_rate", "hotend")} for row in rows()]
    table(copy / "night 1.csv", lines[:9])
    table(copy / "night 2.csv", lines[9:])
    found = read(copy, tip=(175.0, 175.0))
    assert found.prints == ("night 1", "night 2")
    said = notes(found)
    for lacked in (
        "print_id (the file is one print)",
        "nozzle_tip_x",
        "timestamp",
        "travel_direction_deg",
        "no target_hotend",
    ):
        assert lacked in said
    # a measured temperature changes from frame to frame, and ends no segment
    assert len(set(found.segment)) == 6


@pytest.mark.parametrize("kind", ["colour", "16 bit", "16 bit colour", "transparent", "jpeg", "tiff", "bmp"])
def test_depth_colour_and_format_of_the_pictures_do_not_matter(made, copy, kind):
    ending = {"jpeg": ".jpg", "tiff": ".tif", "bmp": ".bmp"}.get(kind, ".png")
    lines = rows()[:9]
    for line in lines:
        frame = cv2.imread(str(copy / line["img_path"]), cv2.IMREAD_GRAYSCALE)
        frame = frame.astype(np.uint16) << 8 if "16" in kind else frame
        frame = cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR) if "colour" in kind else frame
        line["img_path"] = line["img_path"].replace(".png", ending)
        frame = np.dstack([frame] * 3 + [0 * frame]) if kind == "transparent" else frame
        cv2.imwrite(str(copy / line["img_path"]), frame, [cv2.IMWRITE_JPEG_QUALITY, 100])
    table(copy / "log.csv", lines)
    found = read(copy).images.astype(int)
    # colour is one level off in rounding, which equalisation may
    # stretch; a JPEG of quality 100 is good to two
    assert np.abs(found - expected()[:9]).mean() <= {
        "colour": 1,
        "16 bit colour": 1,
        "transparent": 1,
        "jpeg": 4,
    }.get(kind, 0)


def test_pictures_of_another_size_in_a_print_are_read_as_they_are(copy):
    valid = int(np.flatnonzero(expected().any(axis=(1, 2)))[0])
    path, lines = copy / rows()[valid]["img_path"], rows()
    wide = cv2.copyMakeBorder(
        cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), 30, 90, 200, 10, cv2.BORDER_REPLICATE
    )
    cv2.imwrite(str(path), wide)
    for name, shift in (("nozzle_tip_x", 200), ("nozzle_tip_y", 30)):
        lines[valid][name] = f"{float(lines[valid][name]) + shift:.2f}"
    table(copy / "log.csv", lines)
    # what is seen around the tip is the same; equalisation counts a few more pixels of the border
    assert np.abs(read(copy).images.astype(int) - expected()).mean() < 1


def test_a_direction_column_is_obeyed(copy):
    directions = np.repeat([round(scene.direction_deg) for scene in scenes()], SHOTS)
    directions[4] = (directions[4] + 60) % 360
    table(
        copy / "log.csv",
        [
            dict(row, travel_direction_deg=f"{direction}")
            for row, direction in zip(rows(), directions, strict=True)
        ],
    )
    found = read(copy)
    # the front end looks within its leeway of 6 degrees, in whole ones
    assert np.all(np.abs((found.angle_deg - directions + 180) % 360 - 180) <= 6.5)


def test_what_was_cut_before_is_not_cut_again_and_what_changed_is(copy, monkeypatch):
    first = read(copy)
    # a piece of the memo is a print's, so that the other print's stays
    name = rows()[0]["img_path"]
    cv2.imwrite(str(copy / name), cv2.flip(cv2.imread(str(copy / name), cv2.IMREAD_GRAYSCALE), 1))
    cut = []
    find = key_area.find_in
    monkeypatch.setattr(
        key_area, "find_in", lambda *arguments, **settings: cut.append(1) or find(*arguments, **settings)
    )
    second = read(copy)
    assert len(cut) == 9
    np.testing.assert_array_equal(second.images[1:], first.images[1:])
    assert (second.images[0] != first.images[0]).any()
    read(copy)
    assert len(cut) == 9


def test_a_damaged_entry_of_the_memo_is_made_again(copy):
    first = read(copy)
    for entry in (copy.parent / "memo").iterdir():
        entry.write_bytes(entry.read_bytes()[:-20])
    np.testing.assert_array_equal(read(copy).images, first.images)


def test_memory_is_that_of_one_picture_not_of_all(tmp_path):
    rng = np.random.default_rng(1)
    lines = []
    for k in range(40):
        row = dict(
            rows()[0], img_path=f"image-{k}.png", nozzle_tip_x="640", nozzle_tip_y="360", timestamp=f"{k}"
        )
        (tmp_path / "raw").mkdir(exist_ok=True)
        cv2.imwrite(
            str(tmp_path / "raw" / row["img_path"]), np.full((720, 1280), rng.integers(256), np.uint8)
        )
        lines.append(row)
    lines[0]["img_path"] = str(images(tmp_path / "raw") or rows()[0]["img_path"])
    table(tmp_path / "raw/log.csv", lines)
    tracemalloc.start()
    read(tmp_path / "raw", tip=(175, 175))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # 40 pictures are 37 MB; tables and key areas are a tenth of that
    assert peak < 12e6


@pytest.mark.slow
def test_two_workers_give_what_one_gives(made, tmp_path):
    one, two = (read(made, jobs=jobs, memo=tmp_path / str(jobs)) for jobs in (1, 2))
    np.testing.assert_array_equal(one.images, two.images)
    assert (one.reasons, one.source, one.notes) == (two.reasons, two.source, two.notes)


def test_stretches_of_an_example_by_hand():
    settings = np.array([[1, 2], [1, 2], [1, np.nan], [1, np.nan], [1, 2]])
    assert stretches(settings).tolist() == [0, 0, 1, 1, 2]


# ---- other people's


def test_the_real_log_is_read_and_its_own_classes_contradict_ours(shared):
    log = read_log(shared("data/caxton_print0_log/caxton_print0_early.csv"))
    assert len(log.line) == 1676
    # runs of (flow, target temperature) in the file, counted by a
    # shell: cut -d, -f4-7 | uniq | wc -l, less the header
    assert log.setting.max() + 1 == 21
    # 113 percent is called good there and over here
    assert np.count_nonzero((log.flow == 113) & (log.label == 1)) == 138


def test_the_real_frames_in_a_folder_as_users_have_them(shared, tmp_path):
    tips = {
        "0021": (614, 550),
        "0022": (637, 551),
        "1011": (571, 511),
        "1111": (450, 515),
        "1221": (453, 518),
        "2011": (434, 514),
        "2120": (581, 497),
        "2122": (573, 518),
    }
    lines = []
    for k, (name, tip) in enumerate(tips.items()):
        (tmp_path / "raw").mkdir(exist_ok=True)
        shutil.copy(shared(f"data/caxton_samples/full/sample{name}.jpg"), tmp_path / "raw")
        flow, heat = (50, 100, 150)[int(name[0])], (190, 210, 230)[int(name[3])]
        lines.append(
            {
                "img_path": f"data/full/sample{name}.jpg",
                "flow_rate": f"{flow}",
                "target_hotend": f"{heat}",
                "nozzle_tip_x": f"{tip[0]}",
                "nozzle_tip_y": f"{tip[1]}",
                "print_id": f"{k}",
                "flow_rate_class": name[0],
            }
        )
    table(tmp_path / "raw/log.csv", lines)
    found = read(tmp_path / "raw")
    valid = dict(zip(tips, found.valid.tolist(), strict=True))
    assert valid["1011"]
    assert not any(valid[name] for name in ("0021", "0022", "1111", "1221", "2120"))
    rejected = figures(found)["rejected"]
    assert sum(rejected.values()) == 8 - sum(valid.values())
    assert rejected["no fresh line"] == 5 and set(rejected) <= {"no fresh line", "several lines"}
    # the same picture cut out around its nozzle, with the tip of the whole one
    shutil.copy(shared("data/caxton_samples/cropped/sample1011.jpg"), tmp_path / "raw/sample1011.jpg")
    with pytest.raises(
        ValueError, match=r"none of 2 frames can be learned from.*320 x 320 px but found \(571, 511\)"
    ):
        table(tmp_path / "raw/log.csv", [lines[2], dict(lines[2], img_path="gone.jpg")])
        read(tmp_path / "raw")


def test_the_decoder_s_complaints_about_padding_do_not_reach_the_terminal(shared, capfd):
    read_image(shared("data/caxton_samples/full/sample1011.jpg"))
    assert capfd.readouterr().err == ""
