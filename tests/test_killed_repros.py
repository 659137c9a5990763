"""`./run dvc` after a DVC that was killed while it wrote."""

import os
import shutil
import subprocess

import pytest


@pytest.fixture
def dvc(root, tmp_path):
    """dvc(table of locks) runs `./run dvc status` of a copy with a uv that does nothing: what was said, and
    the table afterwards, None where it is gone."""
    shutil.copy(root / "run", tmp_path / "run")
    uv = tmp_path / "bin/uv"
    uv.parent.mkdir()
    uv.write_text("#!/bin/sh\nexit 0\n")
    uv.chmod(0o755)
    rwlock = tmp_path / ".dvc/tmp/rwlock"
    rwlock.parent.mkdir(parents=True)

    def run(content: str, command: str = "dvc") -> tuple[str, str | None]:
        rwlock.write_text(content)
        ended = subprocess.run(
            ["./run", command, "status"], cwd=tmp_path, capture_output=True, text=True,
            env=os.environ | {"PATH": f"{uv.parent}{os.pathsep}{os.environ['PATH']}"},
        )  # fmt: skip
        assert ended.returncode == 0
        return ended.stderr, rwlock.read_text() if rwlock.exists() else None

    return run


def test_an_empty_table_of_locks_is_removed_and_said(dvc):
    said, left = dvc("")
    assert left is None
    assert "run: .dvc/tmp/rwlock was left half written by a killed DVC and is removed" in said


def test_a_table_that_holds_locks_stays_and_other_commands_touch_none(dvc):
    held = '{"read": {}, "write": {"/a": {"pid": 1, "cmd": "dvc repro"}}}'
    assert dvc(held) == ("", held)
    assert dvc("", "python") == ("", "")
