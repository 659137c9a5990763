"""`./run dvc` after a DVC that was killed while it wrote."""

import pytest

from tests import fake_uv


@pytest.fixture
def dvc(root, tmp_path):
    """dvc(table of locks) runs `./run dvc status` of a copy with a DVC that does nothing: what was said, and
    the table afterwards, None where it is gone."""
    fake_uv.furnish(tmp_path, root)
    rwlock = tmp_path / ".dvc/tmp/rwlock"
    rwlock.parent.mkdir(parents=True)

    def run(content: str, command: str = "dvc") -> tuple[str, str | None]:
        rwlock.write_text(content)
        ended = fake_uv.run(tmp_path, command, "status")
        assert ended.returncode == 0, ended.stderr
        return ended.stderr, rwlock.read_text() if rwlock.exists() else None

    return run


def test_an_empty_table_of_locks_is_removed_and_said(dvc):
    said, left = dvc("")
    assert left is None
    assert "run: .dvc/tmp/rwlock was left half written by a killed DVC and is removed" in said


def test_a_table_that_holds_locks_stays_and_other_commands_touch_none(dvc):
    held = '{"read": {}, "write": {"/a": {"pid": 1, "cmd": "dvc repro"}}}'
    assert dvc(held) == ("", held)
    assert dvc("", "beadline") == ("", "")
