"""Pipes, sockets, devices and links out of the recordings are refused by name, before anything opens them."""

import os
import socket
import subprocess
from pathlib import Path

import pytest

from pipeline.recordings.plain_files import check_plain_file, check_plain_files, is_partial, wait_until_still


@pytest.fixture
def raw(tmp_path) -> Path:
    folder = tmp_path / "datasets/raw"
    (folder / "temperature").mkdir(parents=True)
    (folder / "temperature/good.csv").write_text("time_s,u\n0,1\n")
    return folder


def test_a_pipe_a_socket_and_a_folder_below_with_one_are_refused_by_name(raw):
    os.mkfifo(raw / "temperature/pipe.csv")
    with pytest.raises(ValueError, match=r"temperature/pipe\.csv is a named pipe .*remove it"):
        check_plain_files(raw)
    with pytest.raises(ValueError, match="is a named pipe"):
        check_plain_file(raw / "temperature/pipe.csv")
    (raw / "temperature/pipe.csv").unlink()
    (raw / "temperature/day").mkdir()
    here = Path.cwd()
    os.chdir(raw / "temperature/day")  # a socket's path is short
    try:
        with socket.socket(socket.AF_UNIX) as made:
            made.bind("s")
            with pytest.raises(ValueError, match=r"day/s is a socket"):
                check_plain_files(raw)
    finally:
        os.chdir(here)


def test_a_link_to_a_device_and_links_out_of_the_folder_are_refused(raw, tmp_path):
    link = raw / "temperature/link.csv"
    outside = tmp_path / "outside.csv"
    outside.write_text("secret")
    for target, sentence in (
        ("/dev/zero", "leads out of raw to /dev/zero"),
        (outside, "leads out of raw"),
        (tmp_path, "leads out of raw"),
        (raw / "nothing", "is not there; remove the link"),
        (link, "remove the link"),
    ):
        link.symlink_to(target)
        with pytest.raises(ValueError, match=sentence):
            check_plain_files(raw)
        link.unlink()


def test_links_inside_and_a_folder_of_recordings_on_another_disk_are_taken(raw, tmp_path):
    (raw / "temperature/again.csv").symlink_to("good.csv")
    disk = tmp_path / "disk"
    disk.mkdir()
    (disk / "film.mcap").write_bytes(b"")
    (raw / "deposition").symlink_to(disk)
    (raw / "setpoint").mkdir()
    (raw / "setpoint/images").symlink_to(disk)
    check_plain_files(raw)
    check_plain_files(raw / "deposition")
    os.mkfifo(disk / "pipe.mcap")
    with pytest.raises(ValueError, match=r"deposition/pipe\.mcap is a named pipe"):
        check_plain_files(raw)


def test_a_thousand_files_are_listed_and_none_is_asked_for_by_its_path(raw, monkeypatch):
    """The list of a folder tells what each file is; a question a file would be a thousand."""
    for k in range(1000):
        (raw / f"temperature/{k}.csv").touch()
    asked = []
    for name in ("stat", "lstat", "resolve"):
        ask = getattr(Path, name)
        monkeypatch.setattr(
            Path, name, lambda path, *rest, ask=ask, **how: asked.append(path) or ask(path, *rest, **how)
        )
    check_plain_files(raw)
    assert 0 < len(asked) < 20


def test_run_refuses_a_pipe_by_name_before_dvc_can_hang_on_it(root, raw, tmp_path):
    """DVC would open the pipe and wait for ever; the refusal comes before it starts."""
    os.mkfifo(raw / "temperature/pi\x1b[31mpe.csv")
    environment = os.environ | {"BEADLINE_CPUINFO": "/dev/null"}
    ended = subprocess.run(
        [root / "run", "dvc", "status"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert ended.returncode == 1
    assert "run: datasets/raw/temperature/pi\\x1b[31mpe.csv is a named pipe (FIFO)" in ended.stderr
    assert "\x1b" not in ended.stderr


# ---- copies that are not complete


@pytest.mark.parametrize(
    "name",
    ["a.csv.part", "a.csv.crdownload", "A.PART", "~$rig.xlsx", "Thumbs.db", ".DS_Store", "desktop.ini"],
)
def test_names_of_copies_and_of_a_systems_own_files_are_no_recordings(name):
    assert is_partial(name)
    assert not is_partial("part.csv")
    assert not is_partial("thumbs.csv")


def test_a_file_that_changed_a_moment_ago_is_waited_for_ten_seconds_at_most(tmp_path):
    old, new, growing = (tmp_path / name for name in ("old.csv", "new.csv", "growing.csv"))
    for path, age in ((old, 60), (new, 4), (growing, 1)):
        path.write_text("time_s,T1\n")
        os.utime(path, (1000 - age, 1000 - age))
    slept = []

    def grow(seconds: float) -> None:
        slept.append(seconds)
        growing.write_text("time_s,T1\n0,1\n")

    paths = [old, new, growing]
    assert wait_until_still(paths, rest_s=10.0, clock=lambda: 1000.0, sleep=grow) == [growing]
    assert slept == [9.0]
    os.utime(growing, (1060, 1060))  # a clock that is set wrong is not waited for
    assert wait_until_still(paths, rest_s=10.0, clock=lambda: 1050.0, sleep=grow) == []
    assert wait_until_still(paths, rest_s=10.0, clock=lambda: 2000.0, sleep=grow) == []
    assert slept == [9.0]


def test_a_file_that_is_renamed_while_it_is_waited_for_is_passed_over(tmp_path):
    path = tmp_path / "rig.csv"
    path.write_text("time_s,T1\n")
    os.utime(path, (999, 999))
    assert wait_until_still([path], rest_s=10.0, clock=lambda: 1000.0, sleep=lambda _: path.unlink()) == [
        path
    ]


def test_a_bag_that_grows_is_waited_for_by_its_files(tmp_path):
    part = tmp_path / "bag/bag_0.mcap"
    part.parent.mkdir()
    part.write_bytes(b"1")
    os.utime(part, (999, 999))
    grown = wait_until_still(
        [part.parent], rest_s=10.0, clock=lambda: 1000.0, sleep=lambda _: part.write_bytes(b"12")
    )
    assert grown == [part.parent]
