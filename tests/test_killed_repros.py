"""`./run dvc` after a DVC that was killed while it wrote: what benchmarks.killed_repros found."""

import numpy as np
import pytest

from benchmarks.killed_repros import Kill, Played, moments, played, told
from pipeline.store import artifacts
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


def test_a_call_goes_on_behind_what_an_earlier_one_wrote(tmp_path):
    asked = {"commit": "abc", "stages": ["ingest"], "seed": 1}
    done = Played(asked, [([Kill(3.0, True, 2), Kill(9.5, False, 4)], []), ([], ["dvc.lock"])])
    path = tmp_path / "killed.json"
    artifacts.write_json(path, told(done, {"datasets/ingest/a": "0"}, 12.0))
    again = played(path, asked)
    assert again == done and told(again, {}, 12.0)["kills"] == 2
    assert played(path, asked | {"commit": "other"}).repros == []


def test_moments_lie_within_the_quickest_repro_seen():
    whole_s = [100.0]
    at = moments(np.random.default_rng(0), whole_s)
    assert max(next(at)[0] for _ in range(200)) > 90
    whole_s.append(20.0)
    assert 15 < max(next(at)[0] for _ in range(200)) <= 20
