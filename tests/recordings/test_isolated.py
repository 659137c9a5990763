"""A call in a child costs itself alone, whatever it does to the process."""

import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest

from pipeline.recordings import isolated as module
from pipeline.recordings.isolated import Budget, isolated

BUDGET = Budget(30.0, 500.0)


@pytest.mark.parametrize(
    ("work", "arguments", "budget", "sentence"),
    [
        (signal.pause, (), Budget(0.2, 500.0), "x.mcap: reading it takes longer than the 0.2 s"),
        (bytes, (800 << 20,), BUDGET, "x.mcap: reading it needs more memory than the 500 MB"),
        (np.ones, (10**9,), BUDGET, "raise ingest.largest_mb in params.expert.yaml"),
        (os.abort, (), BUDGET, "x.mcap: reading it ended the process that read it (SIGABRT)"),
        (os._exit, (3,), BUDGET, "(exit status 3); copy the recording again"),
        (sum, (5,), BUDGET, "(TypeError: 'int' object is not iterable)"),
        (int, ("x",), BUDGET, "invalid literal for int"),
    ],
)
def test_what_ends_or_exhausts_the_child_is_one_sentence_and_the_next_call_is_served(
    work, arguments, budget, sentence
):
    with pytest.raises(ValueError, match=".") as refused:
        isolated(work, *arguments, shown="x.mcap", budget=budget)
    assert sentence in str(refused.value)
    assert "\n" not in str(refused.value)
    assert isolated(len, "abc", shown="x", budget=BUDGET) == 3


def test_one_child_serves_call_after_call():
    assert len({isolated(os.getpid, shown="x", budget=BUDGET) for _ in range(5)}) == 1


def test_a_warm_child_works_in_the_folder_of_its_caller(tmp_path, monkeypatch):
    """A night measures the same names in the project and in its copy."""
    for name in ("project", "copy"):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        assert isolated(os.getcwd, shown="x", budget=BUDGET) == str(tmp_path / name)


def test_what_a_call_prints_is_no_reply(capfd):
    assert isolated(os.system, "echo hello", shown="x", budget=BUDGET) == 0
    assert capfd.readouterr().out == ""


def test_an_error_of_the_disk_stays_one_and_is_no_fault_of_the_file(tmp_path):
    with pytest.raises(OSError, match="not-there"):
        isolated(os.stat, str(tmp_path / "not-there"), shown="x", budget=BUDGET)


def test_a_reply_is_data_and_never_code():
    """What comes back is parsed as JSON: nothing a file did to the child runs here."""
    assert "pickle.loads" not in Path(module.__file__).read_text().split("# ---- in the child")[0]
    assert isolated(json.loads, '{"a": [1, 2.5, null]}', shown="x", budget=BUDGET) == {"a": [1, 2.5, None]}
