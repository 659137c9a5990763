""".ci/outs.py names each out whose bytes are not the accepted ones."""

import subprocess
import sys

import pytest

LOCK = """\
schema: '2.0'
stages:
  ingest:
    cmd: python -m stages.ingest
    deps:
    - {path: stages/ingest.py, md5: aa, size: 1}
    outs:
    - {path: datasets/ingest, md5: bb.dir, size: 2, nfiles: 1}
    - {path: reports/metrics/ingest.json, md5: cc, size: 3}
  report:
    cmd: python -m stages.report
    outs:
    - {path: reports/index.html, md5: dd, size: 4}
  nothing:
    cmd: 'true'
"""


@pytest.fixture
def compare(root, tmp_path):
    """compare(text of a dvc.lock, *options): exit status and what was printed."""

    def compare(text, *options):
        (tmp_path / "new.lock").write_text(text)
        ended = subprocess.run(
            [sys.executable, root / ".ci/outs.py", "new.lock", "dvc.lock", *options],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        return ended.returncode, ended.stdout + ended.stderr

    return compare


def test_outs_that_differ_are_named_and_code_may_change(compare, tmp_path):
    status, said = compare(LOCK)
    assert status == 1 and "there is no dvc.lock to compare with; write it by .ci/run --record" in said
    assert compare(LOCK, "--record") == (0, "")
    assert "deps" not in (tmp_path / "dvc.lock").read_text()
    assert compare(LOCK) == (0, "")
    assert compare(LOCK.replace("aa", "a2").replace("dd", "d2")) == (0, "")
    status, said = compare(LOCK.replace("cc", "c2").replace("datasets/ingest,", "datasets/other,"))
    assert status == 1
    assert said.splitlines() == [
        "ingest: datasets/ingest: accepted bb.dir, now none",
        "ingest: datasets/other: accepted none, now bb.dir",
        "ingest: reports/metrics/ingest.json: accepted cc, now c2",
        "failed: 3 outs differ from those of .ci/dvc.lock; if that is meant, write it anew by "
        ".ci/run --record",
    ]
